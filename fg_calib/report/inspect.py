"""Reports before a calibration: what a model can identify, and what a job holds."""

import json
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import TypeAdapter
from rich.console import Group
from rich.table import Table

from fg_calib.diagnostics import MAX_ROWS, Inspection
from fg_calib.io import Observability as Document
from fg_calib.io import in_words as table_in_words
from fg_calib.job import Job
from fg_calib.observability import CORRELATED, Identifiability, Observability
from fg_calib.report import tables
from fg_calib.report.tables import Content, Section, line, section, table_of
from fg_calib.report.text import expected_tool_error
from fg_calib.robot import unit_of

COUNTS = {
    **{"": "name", "rows|>": "n_rows", "configurations|>": "n_configurations", "test rows|>": "n_test"},
    **{"train pairs|>": "n_pairs", "test pairs|>": "n_test_pairs", "repeats|>": "n_repeats"},
}
"""Counts of a table by their headings."""


def observability_document(found: Identifiability) -> dict[str, Any]:
    """The content of `observability.json`."""
    return json.loads(TypeAdapter(Document).dump_json(found))


def build_identifiability_report(found: Identifiability) -> Group:
    """Report identifiable parameters, as in the paper's Tables 3 and 4, and reasons for the rest."""
    where = "random configurations" if found.kind == "structural" else "configurations"
    known = line(f"With {', '.join(found.fixed)} known, as the robot's file says", "bold")
    return tables.report(
        line(f"{found.robot}: {found.model}, {found.kind}, {found.n_configurations} {where}", "bold"),
        *(line(f"NOT MODELLED: {m}", "bold red") for m in found.missing),
        *_classes(found),
        *([] if found.with_fixed_known is None else [line(""), known, *_classes(found.with_fixed_known)]),
    )


def _classes(found: Identifiability) -> Iterator[Content | Section]:
    o, practical = found.observability, found.kind == "practical"
    glossary = "independent: identifiable alone; relative: only in combination; ineffective: not identifiable"
    kept, dropped = o.singular_values[: o.rank], o.singular_values[o.rank :]
    values = [line(" ".join(f"{v:.3g}" for v in kept) or "none")]
    if len(dropped):
        values.append(line(f"gap of {o.gap:.1e}, then {len(dropped)} of at most {dropped[0]:.1e}"))
    relations = [f"[{' '.join(relation)}]" for group in o.relative for relation in group.relations]
    yield from (line(f"rank {o.rank} of {len(o.names)} ({glossary})"), line(""), _class_table(o, relations))
    yield from section("Null-space directions", tables.lost_directions(found.lost))
    yield from section("Singular values" + " (signal-to-noise ratios)" * practical, *values)
    if practical:
        indices = "  ".join(f"{name} {value:.4g}" for name, value in o.indices.items())
        combined = {name: " ".join(group.parameters) for group in o.relative for name in group.keep}
        rows = [(name, sigma, unit_of(name), combined.get(name, "")) for name, sigma in o.sigma.items()]
        sigmas = table_of(("", "sigma|q", "|unit", "stands for"), rows)
        correlated = table_of(("", "|+.3f"), [(f"{', '.join(c.parameters)}:", c.correlation) for c in o.correlations])
        yield from section("Observability indices", line(f"{indices}  condition number {o.condition_number:.4g}"))
        yield from section(f"Weak directions ({tables.WEAK})", tables.weak_directions(o))
        yield from section("Sigma of the kept parameters, the others at nominal", sigmas)
        yield from section(f"Correlations above {CORRELATED:g}", correlated)


def build_inspection_report(found: Inspection, job: Job) -> Group:
    """Report warnings, then what the tables hold and what they can determine."""
    words = [table_in_words(table) for table in job.tables]
    if len(words) > 1:
        words = [f"{table.measurements.source} ({of})" for table, of in zip(job.tables, words, strict=True)]
    ready = f"READY: nothing speaks against calibrating this job{', see the notes' * bool(found.cautions)}"
    evaluated = "all rows are test rows: the arm is evaluated as it is, nothing would be calibrated"
    o = found.identifiability.observability
    counts = f"{found.n_residuals} residuals and {found.n_priors} priors on {found.n_unknowns} unknowns"
    nominal = f"Residuals of the nominal arm, frame and tool fitted (median; at most {MAX_ROWS} configurations a table)"
    groups = [f"[{' '.join(group.parameters)}]" for group in o.relative]
    excluded = (f"{n} train pairs are excluded: {why.replace('_', ' ')}" for why, n in found.n_excluded.items())
    determined = f"What these rows can determine: {o.rank} of {len(o.names)} parameters"
    return tables.report(
        line(f"{found.robot}: {'; '.join(words)}"),
        *(line(f"LOOK AT THIS FIRST: {finding}", "bold red") for finding in found.findings),
        *([line(ready, "bold green")] if not found.findings else []),
        *([line(evaluated)] if found.evaluated else []),
        *section("Tables", _tables(found), *excluded),
        *section("Joint readings", _joints(found)),
        *section(nominal, _residuals(found)),
        *section(determined, line(f"{counts}: {found.dof} degrees of freedom"), _class_table(o, groups)),
        *section("Not identifiable from these rows", tables.lost_directions(found.identifiability.lost)),
        *section(tables.WEAKLY, tables.weak_directions(o)),
        *expected_tool_error(found.expected_error),
        *section("Notes", *found.cautions),
    )


def _tables(found: Inspection) -> Table:
    """Counts of each table, without empty columns."""
    columns = {heading: [getattr(t, key) or "" for t in found.tables] for heading, key in COUNTS.items()}
    columns["of"] = [", ".join(f"{n} {what}" for what, n in t.labels.items()) for t in found.tables]
    columns["residuals to fit"] = [", ".join(f"{n} {k}" for k, n in t.n_residuals.items()) for t in found.tables]
    filled = {heading: cells for heading, cells in columns.items() if any(cells)}
    return table_of(filled, zip(*filled.values(), strict=True))


def _joints(found: Inspection) -> Table:
    rows = []
    for joint in found.joints:
        used = "" if joint.share is None else f"{100.0 * joint.share:.0f} %"
        outside = f"outside in {joint.n_outside} configurations" if joint.n_outside else "hardly moves" * joint.still
        rows.append((joint.name, joint.least, joint.most, joint.unit, *joint.limits, used, outside))
    return table_of(("", "from|q:z.1f", "to|q:z.1f", "|unit", "limits|q:.1f|-", "|q:.1f|-", "used|>", ""), rows)


def _residuals(found: Inspection) -> Table:
    """Typical residuals before the calibration compared with the ones that noise and priors predict."""
    rows = []
    for check in found.setups:
        of = f" of {check.table}" * bool(check.table)
        for one in check.residuals:
            large = "far too large" if check.far else "larger than predicted, but not by far"
            judged = large if one.excess > 2.0 else "as noise and priors allow"
            rows.append((f"{one.kind}{of}", one.unit, one.size, one.expected, one.excess, judged))
    return table_of(("", "|unit", "observed|q:.3g", "predicted|q:.3g", "ratio|.3g", ""), rows)


def _class_table(o: Observability, relative: Sequence[str]) -> Table:
    """Classes of the parameters."""
    classes = {"Independent": o.named("independent"), "Relative": relative, "Ineffective": o.named("ineffective")}
    rows = [(name, ", ".join(members) or "None") for name, members in (classes | {"Kept": o.kept}).items()]
    return table_of(("Identifiability", "Kinematic parameters"), rows)


def inspection_document(found: Inspection, job: Job) -> dict[str, Any]:
    """The content of `fg-calib inspect --json`: SI, null for what is unknown or infinite.

    { "schema": "fg-calib/inspection/1", "version", "robot", "ready", "findings", "cautions", "evaluated",
      "tables": [the fields of `TableSurvey`], "joints": [the fields of `JointRange`, with "share" and "still"],
      "residuals": [{"table", "kind", "unit", "size", "expected", "excess", "n"}],
      "explanations": [{"table", "mistake"}],
      "disagreements": [{"name", "ratio", "test"}],
      "n_residuals", "n_priors", "n_unknowns", "dof", "n_excluded": {reason: count},
      "observability": as observability.json,
      "expected_error": {"base": {"position", "orientation"}, "fitted": {...}, "at", "n", "of", "relative"} | null,
      "inputs": {path: sha256} }
    """
    setups, counts = found.setups, ("n_residuals", "n_priors", "n_unknowns", "n_excluded")
    return tables.document_of(
        "inspection",
        found,
        "robot findings cautions evaluated tables disagreements expected_error dof",
        ready=not found.findings,
        **{key: getattr(found, key) for key in counts},
        joints=[vars(joint) | {"share": joint.share, "still": joint.still} for joint in found.joints],
        residuals=[{"table": of.table, "excess": one.excess, **vars(one)} for of in setups for one in of.residuals],
        explanations=[{"table": of.table, "mistake": one.mistake} for of in setups for one in of.explanations],
        observability=observability_document(found.identifiability),
        inputs=job.inputs,
    )
