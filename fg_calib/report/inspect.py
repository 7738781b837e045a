"""Reports before a calibration: what a model can identify, and what a job holds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fg_calib import __version__
from fg_calib.diagnostics import MAX_ROWS, NEAR_SIGMAS, Disagreements, Inspection, SetupCheck
from fg_calib.inputs import checked
from fg_calib.io import Observability as Document
from fg_calib.io import fill_folder, write_text
from fg_calib.io import in_words as table_in_words
from fg_calib.job import Job
from fg_calib.observability import CORRELATED, Identifiability, Observability
from fg_calib.report import tables
from fg_calib.report.charts import write_charts
from fg_calib.report.figures import draw_observability
from fg_calib.report.tables import Section, line, quantities, section, table_of
from fg_calib.report.text import expected_tool_error

FILES = {
    "observability.json": b'{\n "schema": "fg-calib/observability/',
    **dict.fromkeys(("singular_values.svg", "groups.svg"), b"<svg"),
}
"""The files that `write_observability` may write, and how each begins."""


@checked
def observability_document(found: Identifiability) -> dict[str, Any]:
    """The content of `observability.json`."""
    document: dict[str, Any] = json.loads(TypeAdapter(Document).dump_json(found))
    return document


@checked
def write_observability(folder: Path | str, found: Identifiability) -> None:
    """Write `observability.json` and its figures into a folder, all of them or none.

    Raises:
        InputError: The folder cannot be written.
    """

    def write(into: Path) -> None:
        write_text(into / "observability.json", json.dumps(observability_document(found), indent=1) + "\n")
        write_charts(into, draw_observability(found))

    fill_folder(Path(folder), write, FILES)


@checked
def format_identifiability(found: Identifiability, width: int = tables.WIDTH) -> str:
    """`build_identifiability_report` as plain text."""
    return tables.plain_text(build_identifiability_report(found), width)


def build_identifiability_report(found: Identifiability) -> Group:
    """What can be identified, as in the paper's Tables 3 and 4, and why the rest cannot."""
    where = "random configurations" if found.kind == "structural" else "configurations"
    model = f"{found.model}, as poses of the board" if found.model == "pixels" else found.model
    known = f"With {', '.join(found.fixed)} known, as the robot's file says"
    return tables.report(
        line(f"{found.robot}: {model}, {found.kind}, {found.n_configurations} {where}", "bold"),
        *(line(f"NOT MODELLED: {m}", "bold red") for m in found.missing),
        *_classes(found),
        *([] if found.with_fixed_known is None else [line(""), line(known, "bold"), *_classes(found.with_fixed_known)]),
    )


def _classes(found: Identifiability) -> list[Table | Text | Section]:
    o = found.observability
    classes = {
        "Independent": o.named("independent"),
        "Relative": [f"[{' '.join(relation)}]" for group in o.relative for relation in group.relations],
        "Ineffective": o.named("ineffective"),
        "Kept": o.kept,
    }
    rows = [(name, ", ".join(members) or "None") for name, members in classes.items()]
    table = table_of(("Identifiability", "Kinematic parameters"), rows, left="ll", wrap=True)
    glossary = "independent: identifiable alone; relative: only in combination; ineffective: not identifiable"
    kept, dropped = o.singular_values[: o.rank], o.singular_values[o.rank :]
    gap = [line(f"gap of {o.gap:.1e}, then {len(dropped)} of at most {dropped[0]:.1e}")] if len(dropped) else []
    values = [line(" ".join(f"{v:.3g}" for v in kept) or "none"), *gap]
    practical = found.kind == "practical"
    return [
        *(line(f"rank {o.rank} of {len(o.names)} ({glossary})"), line(""), table),
        *section("Null-space directions", tables.lost_directions(found.lost)),
        *section("Singular values" + " (signal-to-noise ratios)" * practical, *values),
        *(_practical(o) if practical else []),
    ]


def _practical(o: Observability) -> list[Section]:
    """What is known of these configurations alone: indices, weak directions, sigmas."""
    indices = "  ".join(f"{name} {value:.4g}" for name, value in o.indices.items())
    combined = {name: " ".join(group.parameters) for group in o.relative for name in group.keep}
    rows = []
    for name, sigma in o.sigma.items():
        unit, shown = quantities(tables.unit_of(name), sigma)
        rows.append((name, shown, unit, combined.get(name, "")))
    correlated = [(f"{a}, {b}:", f"{rho:+.3f}") for a, b, rho in o.correlations]
    sigmas = table_of(("", "sigma", "", "stands for"), rows, left="lrll")
    return [
        *section("Observability indices", line(f"{indices}  condition number {o.condition_number:.4g}")),
        *section(f"Weak directions ({tables.WEAK})", tables.weak_directions(o)),
        *section("Sigma of the kept parameters, the others at nominal", sigmas),
        *section(f"Correlations above {CORRELATED:g}", table_of(("", ""), correlated)),
    ]


@checked
def format_inspection(found: Inspection, job: Job, width: int = tables.WIDTH) -> str:
    """`build_inspection_report` as plain text."""
    return tables.plain_text(build_inspection_report(found, job), width)


def build_inspection_report(found: Inspection, job: Job) -> Group:
    """What looks wrong, then what the tables hold and what they can determine."""
    words = [table_in_words(table) for table in job.tables]
    if len(words) > 1:
        words = [f"{table.measurements.source} ({of})" for table, of in zip(job.tables, words, strict=True)]
    ready = f"READY: nothing speaks against calibrating this job{', see the notes' * bool(found.cautions)}"
    evaluated = "all rows are test rows: the arm is evaluated as it is, nothing would be calibrated"
    o = found.identifiability.observability
    counts = f"{found.n_residuals} residuals and {found.n_priors} priors on {found.n_unknowns} unknowns"
    nominal = f"Residuals of the nominal arm, frame and tool fitted (median; at most {MAX_ROWS} configurations a table)"
    determined = f"What these rows can determine: {o.rank} of {len(o.names)} parameters"
    return tables.report(
        line(f"{found.robot}: {'; '.join(words)}"),
        *(line(f"LOOK AT THIS FIRST: {finding}", "bold red") for finding in found.findings),
        *([line(ready, "bold green")] if found.ready else []),
        *([line(evaluated)] if found.evaluated else []),
        *section("Tables", _tables(found), *_excluded_pairs(found)),
        *section("Joint readings", _joints(found)),
        *section(nominal, _residuals(found)),
        *section("Rows that disagree with the nominal arm", *_disagreements(found.disagreements)),
        *section(determined, line(f"{counts}: {found.dof} degrees of freedom"), _determined(o)),
        *section("Not identifiable from these rows", tables.lost_directions(found.identifiability.lost)),
        *section(tables.WEAKLY, tables.weak_directions(o)),
        *expected_tool_error(found.expected_error),
        *section("Notes", *found.cautions),
    )


def _tables(found: Inspection) -> Table:
    """Counts of each table, without empty columns."""
    columns: dict[str, list[Any]] = {
        "": [t.name for t in found.tables],
        "rows": [t.n_rows for t in found.tables],
        "configurations": [t.n_configurations for t in found.tables],
        "test rows": [t.n_test or "" for t in found.tables],
        "train pairs": [t.n_pairs or "" for t in found.tables],
        "test pairs": [t.n_test_pairs or "" for t in found.tables],
        "repeats": [t.n_repeats or "" for t in found.tables],
        "of": [", ".join(f"{n} {what}" for what, n in t.labels.items()) for t in found.tables],
        "residuals to fit": [", ".join(f"{n} {kind}" for kind, n in t.n_residuals.items()) for t in found.tables],
    }
    there = {heading: cells for heading, cells in columns.items() if any(cells)}
    left = "".join("l" if heading in ("", "of", "residuals to fit") else "r" for heading in there)
    return table_of(there, zip(*there.values(), strict=True), left=left, wrap=True)


def _excluded_pairs(found: Inspection) -> Iterator[str]:
    for t in found.tables:
        if t.n_near_singular:
            yield (
                f"{t.name}: {t.n_near_singular} of {t.n_pairs} train pairs are within {NEAR_SIGMAS:g} sigma of 0 or 180"
                " degrees, where norms are not differentiable: they tell little"
            )
    for reason, n in found.n_excluded.items():
        yield f"{n} train pairs are excluded: {reason.replace('_', ' ')}"


def _joints(found: Inspection) -> Table:
    rows = []
    for joint in found.joints:
        unit, least, most, low, high = quantities(
            joint.unit, joint.least, joint.most, *joint.limits, form="z.1f", none="-"
        )
        used = "" if joint.share is None else f"{100.0 * joint.share:.0f} %"
        outside = f"outside in {joint.n_outside} configurations" if joint.n_outside else ""
        rows.append((joint.name, least, most, unit, low, high, used, outside or "hardly moves" * joint.still))
    return table_of(("", "from", "to", "", "limits", "", "used", ""), rows, left="lrrlrrrl")


def _residuals(found: Inspection) -> Table:
    """Typical residuals before the calibration compared with the ones that noise and priors predict."""
    rows = []
    for check in found.setups:
        for one in check.residuals:
            values = quantities(one.unit, one.size, one.expected, form=".3g")
            name = f"{one.kind} of {check.table}" if check.table else one.kind
            rows.append((name, *values, f"{one.excess:.3g}", _judged(check, one.excess)))
    return table_of(("", "", "observed", "predicted", "ratio", ""), rows, left="llrrrl")


def _judged(check: SetupCheck, excess: float) -> str:
    if check.far:
        return "far too large" if excess > 1.0 else ""
    return "as noise and priors allow" if excess <= 2.0 else "larger than predicted, but not by far"


def _disagreements(found: Disagreements, most: int = 5) -> list[Table | str]:
    """Rows that disagree with the nominal arm, the farthest first."""
    rows = []
    for one in found.found[:most]:
        unit, *values = quantities(one.unit, one.size, one.expected, form=".3g")
        rows.append(("-".join(one.ends), one.table, one.of, one.kind, *values, unit, "test" * one.test))
    more = [f"and {len(found.found) - most} more"] if len(found.found) > most else []
    compared = [f"{found.n} of {found.of} were compared"] if rows and found.n < found.of else []
    return [table_of(("", "table", "of", "", "off by", "expected", "", ""), rows, left="llllrrll"), *more, *compared]


def _determined(o: Observability) -> Table:
    """Classes of the parameters."""
    classes = {
        "independent": ", ".join(o.named("independent")) or "none",
        "only in combination": ", ".join(f"[{' '.join(group.parameters)}]" for group in o.relative),
        "not identifiable": ", ".join(o.named("ineffective")),
    }
    return table_of(("", ""), [row for row in classes.items() if row[1]], left="ll", wrap=True)


@checked
def inspection_document(found: Inspection, job: Job) -> dict[str, Any]:
    """The content of `fg-calib inspect --json`: SI, null for what is unknown or infinite.

    { "schema": "fg-calib/inspection/1", "version", "robot", "ready", "findings", "cautions", "evaluated",
      "tables": [the fields of `TableSurvey`], "joints": [the fields of `JointRange`, with "share" and "still"],
      "residuals": [{"table", "kind", "unit", "size", "expected", "excess", "n"}],
      "explanations": [{"table", "mistakes"}],
      "disagreements": {"found": [the fields of `Disagreement`], "n", "of"},
      "n_residuals", "n_priors", "n_unknowns", "dof", "n_excluded": {reason: count},
      "observability": as observability.json,
      "expected_error": {"base": {"position", "orientation"}, "fitted": {...}, "at", "n", "of", "relative"} | null,
      "inputs": {path: sha256} }
    """
    counts = ("n_residuals", "n_priors", "n_unknowns", "dof", "n_excluded")
    keys = ("robot", "ready", "findings", "cautions", "evaluated", "tables", "expected_error", *counts)
    keys_of_residuals = ("kind", "unit", "size", "expected", "excess", "n")
    document: dict[str, Any] = tables.plain(
        {
            "schema": "fg-calib/inspection/1",
            "version": __version__,
            **{key: getattr(found, key) for key in keys},
            "joints": [tables.plain(joint) | {"share": joint.share, "still": joint.still} for joint in found.joints],
            "residuals": [
                {"table": check.table, **{key: getattr(one, key) for key in keys_of_residuals}}
                for check in found.setups
                for one in check.residuals
            ],
            "explanations": [
                {"table": check.table, "mistakes": one.mistakes} for check in found.setups for one in check.explanations
            ],
            "disagreements": found.disagreements,
            "observability": observability_document(found.identifiability),
            "inputs": job.inputs,
        }
    )
    return document
