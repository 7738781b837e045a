"""What can be said of a job before it is solved, for people and for programs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rich.console import Group, RenderableType

from fg_calib import __version__
from fg_calib.arguments import checked
from fg_calib.diagnostics.inspection import Inspection, JointRange
from fg_calib.diagnostics.linearity import NEAR_SIGMAS
from fg_calib.diagnostics.nominal_residuals import MAX_ROWS
from fg_calib.diagnostics.setup_check import SetupCheck
from fg_calib.job import Job
from fg_calib.report.documents import observability_document
from fg_calib.report.identifiability import WEAK, lost_directions, weak_directions
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import WIDTH, indented, line, plain_table, plain_text, section
from fg_calib.report.text import expected_tool_error, in_words
from fg_calib.statistics.robust_screening import Disagreements

SCHEMA = "fg-calib/inspection/1"

_DECIMALS = {"m": 2, "rad": 3, "px": 2}
"""Decimals of typical residuals, which nobody needs to more."""


@checked
def format_inspection(found: Inspection, job: Job, width: int = WIDTH) -> str:
    """`build_inspection_report` as plain text."""
    return plain_text(build_inspection_report(found, job), width)


def build_inspection_report(found: Inspection, job: Job) -> RenderableType:
    """What is to be looked at first, then what the tables hold and what they can determine."""
    words = [in_words(table) for table in job.tables]
    if len(words) > 1:
        words = [f"{table.measurements.source} ({of})" for table, of in zip(job.tables, words, strict=True)]
    parts: list[RenderableType] = [line(f"{found.robot}: {'; '.join(words)}")]
    parts += [line(f"LOOK AT THIS FIRST: {finding}", "bold red") for finding in found.findings]
    if found.ready:
        what = "nothing speaks against calibrating this job" + ", see the notes" * bool(found.cautions)
        parts.append(line(f"READY: {what}", "bold green"))
    if found.evaluated:
        parts.append(line("all rows are test rows: the arm is taken as it is, nothing of it would be calibrated"))
    parts += section("Tables", _tables(found), *indented(_of_pairs(found)))
    parts += section("Joint readings", _joints(found))
    parts += _residuals(found)
    parts += _disagreements(found.disagreements)
    parts += _determined(found)
    o = found.identifiability.observability
    weak = weak_directions(o)
    if weak is not None:
        parts += section(f"What they determine badly ({WEAK})", weak)
    parts += expected_tool_error(found.expected_error, ", if model, noise and tolerances are as stated")
    if found.cautions:
        parts += section("Notes", *indented(found.cautions))
    return Group(*parts)


def _tables(found: Inspection) -> RenderableType:
    """Counts of each table; columns in which there is nothing are left out."""
    columns = {
        "rows": [f"{t.n_rows}" for t in found.tables],
        "configurations": [f"{t.n_configurations}" for t in found.tables],
        "test rows": [f"{t.n_test}" if t.n_test else "" for t in found.tables],
        "train pairs": [f"{t.n_pairs}" if t.n_pairs else "" for t in found.tables],
        "test pairs": [f"{t.n_test_pairs}" if t.n_test_pairs else "" for t in found.tables],
        "repeats": [f"{t.n_repeats}" if t.n_repeats else "" for t in found.tables],
        "near another": [f"{t.n_near}" if t.n_near else "" for t in found.tables],
        "of": [", ".join(f"{n} {what}{'s' * (n > 1)}" for what, n in t.labels.items()) for t in found.tables],
        "residuals to fit": [", ".join(f"{n} {kind}" for kind, n in t.n_residuals.items()) for t in found.tables],
    }
    there = {heading: cells for heading, cells in columns.items() if any(cells)}
    left = ("of", "residuals to fit")
    table = plain_table(("", "left"), *((h, "left" if h in left else "right") for h in there), wrap=True)
    for t, *cells in zip(found.tables, *there.values(), strict=True):
        table.add_row(t.name, *cells)
    return table


def _of_pairs(found: Inspection) -> Iterator[str]:
    for t in found.tables:
        if t.n_near_singular:
            yield (
                f"{t.name}: {t.n_near_singular} of {t.n_pairs} train pairs are within {NEAR_SIGMAS:g} sigma of 0 or"
                " 180 degrees, where noise of either sign acts the same way: that is counted with, but they tell little"
            )
    for reason, n in found.n_excluded.items():
        yield f"{n} train pairs take no part: {reason.replace('_', ' ')}"


def _joints(found: Inspection) -> RenderableType:
    limited = any(math.isfinite(v) for joint in found.joints for v in joint.limits)
    limits = (("limits", "right"), ("", "right"), ("used", "right")) if limited else ()
    table = plain_table(("", "left"), ("from", "right"), ("to", "right"), ("", "left"), *limits, ("", "left"))
    for joint in found.joints:
        factor, unit, _ = SHOWN[joint.unit]
        low, high = (f"{v * factor:.1f}" if math.isfinite(v) else "-" for v in joint.limits)
        used = "" if joint.share is None else f"{100.0 * joint.share:.0f} %"
        ends = (f"{v * factor:z.1f}" for v in (joint.least, joint.most))
        table.add_row(joint.name, *ends, unit, *((low, high, used) if limited else ()), _of_joint(joint))
    return table


def _of_joint(joint: JointRange) -> str:
    if joint.n_outside:
        return f"outside in {joint.n_outside} configurations"
    return "hardly moves" if joint.still else ""


def _residuals(found: Inspection) -> list[RenderableType]:
    """Typical residuals before calibration beside what noise and tolerances predict."""
    table = plain_table(
        *(("", "left"), ("", "left"), ("seen", "right"), ("predicted", "right"), ("ratio", "right")),
        ("", "left"),
    )
    for check in found.setups:
        for one in check.residuals:
            factor, unit, _ = SHOWN[one.unit]
            figures = (f"{v * factor:.{_DECIMALS[one.unit]}f}" for v in (one.size, one.expected))
            name = f"{one.kind} of {check.table}" if check.table else one.kind
            table.add_row(name, unit, *figures, f"{one.excess:.3g}", _of_excess(check, one.excess))
    if not table.rows:
        return []
    title = f"Residuals of the nominal arm, frame and tool fitted (median; at most {MAX_ROWS} configurations a table)"
    return section(title, table)


def _of_excess(check: SetupCheck, excess: float) -> str:
    if check.far:
        return "far too large" if excess > 1.0 else ""
    return "as noise and tolerances allow" if excess <= 2.0 else "larger than predicted, but not by far"


def _disagreements(found: Disagreements, limit: int = 5) -> list[RenderableType]:
    """Rows that disagree with the arm as drawn, the farthest first."""
    if not found.found:
        return []
    tables, labelled = len({one.table for one in found.found}) > 1, any(one.of for one in found.found)
    table = plain_table(
        *(("", "left"), *[("table", "left")] * tables, *[("of", "left")] * labelled, ("", "left")),
        *(("off by", "right"), ("expected", "right"), ("", "left"), ("", "left")),
    )
    for one in found.found[:limit]:
        factor, unit, _ = SHOWN[one.unit]
        figures = (f"{v * factor:.{_DECIMALS[one.unit]}f}" for v in (one.size, one.expected))
        names = [*[one.table] * tables, *[one.of] * labelled]
        table.add_row("-".join(one.ends), *names, one.kind, *figures, unit, "test" * one.test)
    if len(found.found) > limit:
        table.add_row(f"and {len(found.found) - limit} more")
    looked = "" if found.n >= found.of else f" ({found.n} of {found.of} were looked at)"
    return section(f"Rows that disagree with the arm as drawn{looked}", table)


def _determined(found: Inspection) -> list[RenderableType]:
    """Expected rank and classes, and why the rest is lost."""
    o = found.identifiability.observability
    table = plain_table(("", "left"), ("", "left"), wrap=True)
    table.show_header = False
    relative = [f"[{' '.join(group.parameters)}]" for group in o.relative]
    table.add_row("independent", ", ".join(o.named("independent")) or "none")
    for words, names in (("only together", relative), ("not at all", o.named("ineffective"))):
        if names:
            table.add_row(words, ", ".join(names))
    rows = f"{found.n_residuals} residuals and {found.n_priors} priors on {found.n_unknowns} unknowns"
    parts = section(
        f"What these rows can determine: {o.rank} of {len(o.names)} parameters",
        *(line(f"{rows}: {found.dof} degrees of freedom"), table),
    )
    if found.identifiability.lost:
        parts += section("What they do not determine", lost_directions(found.identifiability.lost))
    return parts


@checked
def inspection_document(found: Inspection, job: Job) -> dict[str, Any]:
    """What `fg-calib inspect --json` prints: SI, full precision, None for what is unknown or infinite.

    { "schema": "fg-calib/inspection/1", "version", "robot", "ready", "findings", "cautions", "evaluated",
      "tables": [the fields of `TableSurvey`],
      "joints": [{"name", "unit", "least", "most", "limits": [lower | null, upper | null], "share", "still",
                  "n_outside"}],
      "residuals": [{"table", "kind", "unit", "size", "expected", "excess", "n"}],
      "explanations": [{"table", "mistakes"}],
      "disagreements": {"found": [the fields of `Disagreement`], "n", "of"},
      "n_residuals", "n_priors", "n_unknowns", "dof", "n_excluded": {reason: count},
      "observability": as observability.json,
      "expected_error": {"base": {"position", "orientation"}, "fitted": {...}, "at", "n", "of", "relative"} | null,
      "inputs": {path: sha256} }
    """
    checks = found.setups
    residuals = [(check.table, one) for check in checks for one in check.residuals]
    return {
        "schema": SCHEMA,
        "version": __version__,
        "robot": found.robot,
        "ready": found.ready,
        "findings": list(found.findings),
        "cautions": list(found.cautions),
        "evaluated": found.evaluated,
        "tables": [asdict(table) for table in found.tables],
        "joints": [_joint(joint) for joint in found.joints],
        "residuals": [
            {"table": table, "kind": r.kind, "unit": r.unit, "size": r.size, "expected": r.expected,
             "excess": r.excess, "n": r.n}
            for table, r in residuals
        ],
        "explanations": [
            {"table": check.table, "mistakes": list(one.mistakes)} for check in checks for one in check.explanations
        ],
        "disagreements": {
            "found": [asdict(one) for one in found.disagreements.found],
            "n": found.disagreements.n,
            "of": found.disagreements.of,
        },
        "n_residuals": found.n_residuals,
        "n_priors": found.n_priors,
        "n_unknowns": found.n_unknowns,
        "dof": found.dof,
        "n_excluded": found.n_excluded,
        "observability": observability_document(found.identifiability),
        "expected_error": None if found.expected_error is None else asdict(found.expected_error),
        "inputs": job.inputs,
    }  # fmt: skip


def _joint(joint: JointRange) -> dict[str, Any]:
    return {
        "name": joint.name,
        "unit": joint.unit,
        "least": joint.least,
        "most": joint.most,
        "limits": [v if math.isfinite(v) else None for v in joint.limits],
        "share": joint.share,
        "still": joint.still,
        "n_outside": joint.n_outside,
    }
