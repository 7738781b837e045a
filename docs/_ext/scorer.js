// Sphinx's scores, but that explanations come before names of the reference.
var Scorer = {
  score: ([docname, title, anchor, description, score]) =>
    score + (docname === "glossary" ? 60 : docname.startsWith("generated/") ? -30 : docname === "ledger" ? -10 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
