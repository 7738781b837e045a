"""The report of `fg-calib compare`: the estimators side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.arguments import checked
from fg_calib.baseline.comparison import Comparison, Estimate, PoseError
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import WIDTH, in_order, indented, line, plain_table, plain_text, rounded, section
from fg_calib.robot.model import Robot

_ESTIMATORS = {
    "graph": "graph",
    "graph-keep": "graph kept",
    "gauss-newton": "plain GN",
    "weighted-gauss-newton": "weighted GN",
    "scipy": "scipy",
}
"""Headings of `comparison.ESTIMATORS`."""

_POSE_ERROR: tuple[tuple[str, str, Callable[[PoseError], float]], ...] = (
    ("position, max", "m", lambda e: e.max),
    ("position, mean", "m", lambda e: e.mean),
    ("position, RMS", "m", lambda e: e.rms),
    ("orientation, RMS", "rad", lambda e: e.orientation_rms),
)


@checked
def format_comparison(comparison: Comparison, width: int = WIDTH) -> str:
    """`build_comparison_report` as plain text."""
    return plain_text(build_comparison_report(comparison), width)


def build_comparison_report(comparison: Comparison) -> RenderableType:
    """The estimators side by side: errors, residuals, effort, then the parameters that each found."""
    job = comparison.job
    title = f"{job.robot.name}: {job.model}, judged at {comparison.n_judged} {comparison.judged_on} configurations"
    parts: list[RenderableType] = [line(title)]
    parts += [line(f"DOUBTFUL: {finding}", "bold red") for finding in comparison.findings]
    parts += [line(""), _accuracy(comparison)]
    parts += section("Corrections (± sigma claimed)", _corrections(comparison))
    parts += section("Estimators", _estimators(comparison))
    return Group(*parts, *section("Notes", *indented(_comparison_notes(comparison))))


def _accuracy(comparison: Comparison) -> RenderableType:
    estimates = comparison.estimates
    headings = ("nominal", *(_ESTIMATORS[e.name] for e in estimates))
    table = plain_table(("", "left"), ("", "left"), *((heading, "right") for heading in headings))

    def row(label: str, unit: str, values: Iterable[float | None]) -> None:
        factor, shown, decimals = SHOWN[unit]
        figures = ("-" if v is None else _large(v * factor, decimals - 1) for v in values)
        table.add_row(f"  {label}", shown, *figures)

    errors = [comparison.errors_before, *(e.errors for e in estimates)]
    sections: tuple[tuple[str, list[PoseError | None]], ...] = (
        ("Real error in the base frame", [None if e is None else e.base for e in errors]),
        ("Real error after the best rigid fit", [None if e is None else e.fitted for e in errors]),
    )
    for heading, chosen in sections:
        if not any(chosen):
            continue
        table.add_row(line(heading, "bold"))
        for label, unit, figure in _POSE_ERROR:
            row(label, unit, [None if e is None else figure(e) for e in chosen])
    table.add_row(line("Error predicted by its sigmas", "bold"))
    row("position, RMS", "m", [None, *(e.predicted_rms for e in estimates)])
    row("after best rigid fit", "m", [None, *(e.predicted_fitted_rms for e in estimates)])
    before = estimates[0].residual_rms or {}
    for split in ("train", "test"):
        families = in_order(before.get(split, {}))
        if families:
            table.add_row(line(f"Residuals, {split} rows (RMS)", "bold"))
        for family in families:
            after = [None if e.residual_rms is None else e.residual_rms[split][family]["after"] for e in estimates]
            row(family, comparison.units[family], [before[split][family]["before"], *after])
    table.add_row(line("Effort", "bold"))
    ran = [e.robot is not None for e in estimates]
    table.add_row(
        "  parameters", "", "-", *(f"{len(e.sigma)}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row(
        "  iterations", "", "-", *(f"{e.iterations}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row(
        "  time", "ms", "-", *(f"{e.seconds * 1e3:.1f}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row("  converged", "", "-", *("yes" if e.converged else "NO" for e in estimates))
    return table


def _corrections(comparison: Comparison) -> RenderableType:
    job, estimates = comparison.job, comparison.estimates
    truth = [("truth", "right")] if job.truth is not None else []
    headings = [(_ESTIMATORS[e.name], "right") for e in estimates]
    table = plain_table(("", "left"), ("", "left"), *truth, *headings, wrap=True)
    for p in job.robot.parameters:
        if not p.estimated:
            continue
        factor, unit, decimals = SHOWN[p.unit]

        def correction(robot: Robot, name: str, factor: float = factor, decimals: int = decimals - 1) -> str:
            return _large(comparison.correction(robot, name) * factor, decimals, "+")

        def cell(e: Estimate, name: str, factor: float = factor, decimals: int = decimals - 1) -> str:
            if e.robot is None:
                return "-"
            if name not in e.sigma:
                return "held"
            sigma = e.sigma[name]
            claimed = _large(sigma * factor, decimals) if np.isfinite(sigma) else "unknown"
            return f"{correction(e.robot, name)} ±{claimed}"

        true = [correction(job.truth, p.name)] if job.truth is not None else []
        table.add_row(p.name, unit, *true, *(cell(e, p.name) for e in estimates))
    return table


def _large(value: float, decimals: int, sign: str = "") -> str:
    """A figure with `decimals`, or in powers of ten where an estimate went astray."""
    return rounded(value, decimals, sign) if abs(value) < 1e5 else f"{value:{sign}.1e}"


def _estimators(comparison: Comparison) -> RenderableType:
    table = plain_table(("", "left"), ("", "left"), wrap=True)
    table.show_header = False
    table.columns[0].no_wrap = True
    table.add_row("  nominal", "the arm before calibration, its tool and measurement frame fitted where unknown")
    for e in comparison.estimates:
        table.add_row(f"  {_ESTIMATORS[e.name]}", f"{e.description}; {e.message}")
    return table


def _comparison_notes(comparison: Comparison) -> Iterable[str]:
    if comparison.judged_on == "train":
        yield "no test rows: judged at the train configurations, which flatters every estimator"
    if comparison.errors_before is None:
        yield "the truth is not known: no real errors (key truth of a job)"
    if any(e.robot is not None and len(e.sigma) < len(comparison.estimates[0].sigma) for e in comparison.estimates):
        yield "where others are held a parameter stands for its combination with them: compare errors, not corrections"
    yield "predicted errors take what was held at nominal for known, so they may be too small in the base frame"
    yield "residuals are of the rows that the graph uses"
