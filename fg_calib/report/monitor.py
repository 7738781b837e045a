"""The report of `fg-calib check`: whether a calibration is still good, and what changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group
from rich.table import Table

from fg_calib.diagnostics import probability
from fg_calib.inputs import LIMITED
from fg_calib.monitoring import Check, Explanation
from fg_calib.report import tables
from fg_calib.report.tables import Content, figure, in_words, line, quantities, section, table_of

WORDS = {"pass": ("PASS", "bold green"), "fail": ("FAIL", "bold red")}
"""Word and style of each verdict."""

KINDS = {
    "zero": "zero of a joint",
    "zeros": "zeros of two joints",
    "tool": "the tool",
    "frame": "the measurement frame, or the base",
    "row": "gross errors of one configuration",
    "parameter": "",
}
"""What each kind of explanation changes."""

NO_ADVICE = (
    "no configurations are advised: random ones cannot be measured like these rows (pairs, contacts, fixed lengths), or"
    " do not distinguish these changes; another instrument may"
)


def named(parameters: Sequence[str]) -> str:
    """A change by its name: for several parameters together `theta2 + theta3`."""
    return " + ".join(parameters)


def check_document(found: Check) -> dict[str, Any]:
    """A check for programs, in [m] and [rad]."""
    document: dict[str, Any] = {"schema": "fg-calib/check/1", **tables.plain(found)}
    for e in document["explanations"]:
        for key in ("told_apart_from", "not_told_apart_from"):
            e[key] = [named(names) for names in e[key]]
    if document["advice"] is not None:
        document["advice"]["between"] = [named(names) for names in document["advice"]["between"]]
    return document


def build_check_report(found: Check, joint_units: Sequence[str]) -> Group:
    """A check for the terminal.

    Args:
        found: The check.
        joint_units: `rad` or `m` of each joint.
    """
    p = "" if found.p_value is None else f", p-value {probability(found.p_value)}"
    chi2 = f"chi-square {found.chi2:.5g} with {found.dof} degrees of freedom{p}, {found.n} measurements"
    sizes = [
        f"{name} {'none' if size is None else in_words(size, unit, '.2g')}"
        for (name, size), unit in zip(found.detectable.items(), joint_units, strict=True)
    ]
    explained: list[Content] = []
    if found.explanations:
        explained = [_changes(found.explanations), *_conclusions(found)]
    return tables.report(
        line(*WORDS.get(found.verdict, ("NOT EVALUATED", "bold yellow"))),
        *(*found.reasons, *found.cautions, chi2),
        *section("Errors of the calibrated arm (RMS)", _errors(found)),
        *section(
            "Joint offset changes that these rows show in 9 of 10 cases",
            *([] if found.verdict == "not_evaluated" else [", ".join(sizes)]),
        ),
        *section("What changed", *explained),
        *section("What to measure", *_advice(found, joint_units)),
    )


def _errors(found: Check) -> Table:
    rows = []
    for kind, rms in found.rms.items():
        unit = LIMITED.get(kind) or ("px" if kind == "pixel" else "m")
        rows.append((kind, *quantities(unit, rms, found.noise[kind], found.limits.get(kind), none="")))
    return table_of(("", "", "error", "specified noise", "limit"), rows, left="ll")


def _changes(explanations: Sequence[Explanation]) -> Table:
    rows = []
    for e in explanations:
        word = "may be" if e.likely and e.not_told_apart_from else "is" if e.likely else "is not: distinguishable"
        several = list(zip(e.change, e.sigma, e.units, strict=True)) if len(e.change) < 3 else []
        change = ", ".join(in_words(c, unit, "+") for c, _, unit in several)
        sigma = ", ".join(figure(s, unit) for _, s, unit in several)
        p = probability(e.p_value)
        rows.append((named(e.parameters), KINDS[e.kind], change, sigma, f"{e.chi2_drop:.4g}", p, word))
    headings = ("", "", "change", "sigma", "chi-square falls by", "p-value", "")
    return table_of(headings, rows, left="llrrrrl", wrap=True)


def _conclusions(found: Check) -> list[str]:
    likely = [e for e in found.explanations if e.likely]
    best, lines = likely[0], []
    if best.same:
        lines.append(f"{best.parameters[0]} is equivalent to {', '.join(best.same)} for every position of the tool")
    if len(likely) > 1:
        lines.append(f"not distinguishable by these rows: {', '.join(named(e.parameters) for e in likely)}")
        lines += ["do not deploy any of these changes yet", *([NO_ADVICE] if found.advice is None else [])]
    elif found.verdict == "fail" and found.deploy:
        update = f"update with --changed {best.parameters[0]}, check again"
        lines.append(f"no other single change explains the rows: {update}")
    elif found.verdict == "fail":
        lines.append("do not deploy: residuals above noise remain after the most likely change")
    return lines


def _advice(found: Check, joint_units: Sequence[str]) -> list[Content]:
    advice = found.advice
    if advice is None:
        return []
    rows = [
        (
            *(figure(x, unit, ".2f") for x, unit in zip(q, joint_units, strict=True)),
            figure(apart, "m", ".3f"),
            f"{sigma:.1f}",
        )
        for q, apart, sigma in zip(advice.readings, advice.apart, advice.sigma, strict=True)
    ]
    names = [f"q{i} [{tables.unit_shown(unit)}]" for i, unit in enumerate(joint_units, start=1)]
    said = (
        "measured like the rest, in the same table, these distinguish the changes"
        if advice.enough
        else "not even these distinguish all of them: measure more, spread over the whole workspace"
    )
    a, b = map(named, advice.between)
    least = f"{said} ({advice.needed:.1f} sigma are needed; least apart are {a} and {b})"
    return [table_of((*names, "apart [mm]", "together [sigma]"), rows, left="r"), least]
