"""The calibration report for people: verdict, statistics, residuals, parameters; lengths in mm, angles in degrees."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.arguments import checked
from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.diagnostics.verdict import chi2_in_words, predicted_in_words, probability
from fg_calib.graph.noise import JOINT_NOISE
from fg_calib.graph.solver import Solution
from fg_calib.measurements.table import Table
from fg_calib.prediction.expected_error import ExpectedError
from fg_calib.report.fit import goodness_of_fit, prediction, suspicious, with_joint_noise
from fg_calib.report.folds import folds
from fg_calib.report.identifiability import WEAK, lost_directions, weak_directions
from fg_calib.report.notes import notes
from fg_calib.report.parameters import combinations, parameters, tolerances
from fg_calib.report.shown import SHOWN
from fg_calib.report.summary import good, judged
from fg_calib.report.tables import WIDTH, in_order, indented, line, plain_table, plain_text, rounded, section
from fg_calib.report.tolerances import TITLE
from fg_calib.statistics.estimates import FrameEstimate
from fg_calib.statistics.estimates import JointErrors as JointValues
from fg_calib.statistics.estimates import LandmarkEstimate as PointEstimate


@checked
def format_report(solution: Solution, uncertainty: Uncertainty, width: int = WIDTH) -> str:
    """The report as plain text."""
    return plain_text(build_report(solution, uncertainty), width)


def build_report(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    """The report, to be printed by rich."""
    parts: list[RenderableType] = [
        _verdict(solution, uncertainty),
        *section("Fit statistics", _statistics(solution, uncertainty)),
        *section(
            f"Goodness of fit (1 sigma of a row{with_joint_noise(solution)})", *goodness_of_fit(solution, uncertainty)
        ),
        *prediction(solution, uncertainty),
        *folds(uncertainty),
        *_expected_error(uncertainty),
        *section("Residuals (RMS)", _residuals(solution, uncertainty)),
    ]
    if uncertainty.names or not solution.problem.evaluated:
        parts += section("Parameters", parameters(uncertainty))
    if solution.estimated_tolerances is not None:
        parts += section(TITLE, tolerances(solution.estimated_tolerances, uncertainty))
    if any(p.stands_for for p in uncertainty.parameters):
        parts += section("What kept parameters were estimated for", combinations(uncertainty))
    parts += suspicious(solution, uncertainty)
    parts += _joint_values(solution, uncertainty.joint_values)
    for frame, variable in zip(uncertainty.frames, solution.problem.variables.frames, strict=True):
        labels = solution.problem.data.labels
        which = "" if len(labels) == 1 else f" of {labels[variable.number]}"
        parts += section(f"Measurement frame (world_T_base{which})", _frame(frame))
    parts += _points(solution, uncertainty.points)
    if uncertainty.identifiability.lost:
        parts += section("What the data do not determine", lost_directions(uncertainty.identifiability.lost))
    weak = weak_directions(uncertainty.observability)
    if weak is not None:
        parts += section(f"What they determine badly ({WEAK})", weak)
    remarks = indented(notes(solution, uncertainty))
    if remarks:
        parts += section("Notes", *remarks)
    return Group(*parts)


def _verdict(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    problem, settings = solution.problem, solution.problem.options
    labels = problem.data.labels
    tables = [in_words(table) for table in problem.data.tables]
    if len(labels) > 1:
        tables = [f"{label} ({words})" for label, words in zip(labels, tables, strict=True)]
    what = f"{problem.robot.name}: {'; '.join(tables)}"
    touched = problem.data.n_train(lambda kind: kind.is_contact and kind.turned_back and kind.ends == 1)
    n_points = sum(v.letter == "L" for v in problem.variables.nuisance)
    what += f", {n_points} touched points" if touched else ""
    if problem.state.joint_errors is not None:
        what += ", joint values estimated"
    what += "" if settings.loss == "none" else f", loss {settings.loss}"
    lines: list[RenderableType] = [line(what)]
    if uncertainty.acceptance is not None:
        colour = {"pass": "bold green", "fail": "bold red"}.get(uncertainty.acceptance.verdict, "bold yellow")
        lines += [line(text, colour) for text in judged(uncertainty.acceptance.judgements)]
    lines += [line(f"DOUBTFUL: {finding}", "bold red") for finding in uncertainty.findings]
    if uncertainty.trustworthy:
        lines.append(line(f"{good(uncertainty.reservations)}: {solution.message}", "bold green"))
        lines += indented(uncertainty.reservations)
    if solution.problem.evaluated:
        lines.insert(1, line("EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated"))
        if uncertainty.p_value is not None:
            figures = chi2_in_words(uncertainty.chi2, uncertainty.expected_chi2, uncertainty.p_value)
            lines.append(line(f"test rows: {figures}"))
    test = uncertainty.goodness.test
    if test is not None and test.n:
        lines.append(line(predicted_in_words(test)))
    return Group(*lines)


def in_words(table: Table) -> str:
    """What a table is of."""
    kinds = [type(own.kind).__name__ for own in table.own]
    if table.model is None:
        return ", ".join(kinds)
    words = [table.model, *kinds]
    if table.uses_pairs and table.measurements.pairs is not None:
        words.append("measured pairs")
    elif table.uses_pairs and (table.measurements.position is not None or table.measurements.rotation is not None):
        words.append(f"pairs: {table.pairing}")
    elif table.unknown_frame:
        words.append("measurement frame unknown")
    return ", ".join(words)


def _statistics(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    problem = solution.problem
    rows = [("configurations", f"{problem.n_configurations}")]
    if problem.pair_series:
        rows.append(("pairs", f"{problem.n_pairs}"))
    touches = problem.data.n_train(lambda kind: kind.is_contact and kind.turned_back and kind.ends == 1)
    if touches:
        n_points = sum(v.letter == "L" for v in problem.variables.nuisance)
        between = problem.data.n_train(lambda kind: kind.ends == 0)
        rows += [("touches", f"{touches} of {n_points} points"), ("distances of points", f"{between}")]
    if problem.added:
        chi2 = 2.0 * sum(factor.error(solution.values) for factor in problem.added)
        rows.append(("added factors", f"{len(problem.added)} with {problem.n_added} rows, chi-square {chi2:.6g}"))
    reduced = uncertainty.reduced_chi2
    low, high = uncertainty.chi2_bounds
    determined = uncertainty.spread.rank
    rows += [
        ("residuals", f"{problem.n_residuals}, and {problem.n_priors} priors"),
        ("estimated", f"{len(problem.variables.all_scales)} unknowns, {determined} directions determined"),
        ("chi-square", f"{uncertainty.chi2:.6g} with {uncertainty.dof} degrees of freedom"),
        (
            "reduced chi-square",
            "unknown"
            if reduced is None
            else f"{reduced:.4g} (good from {low:.3g} to {high:.3g}){_of_p(uncertainty.p_value)}",
        ),
        (
            "solver",
            f"{solution.iterations} iterations, {solution.seconds:.2f} s,"
            f" cost {solution.initial_cost:.6g} -> {solution.cost:.6g}",
        ),
    ]
    table = plain_table(("", "left"), ("", "left"))
    table.show_header = False
    for row in rows:
        table.add_row(*row)
    return table


def _of_p(p: float | None) -> str:
    return "" if p is None else f", p-value {probability(p)}"


def _expected_error(uncertainty: Uncertainty) -> list[RenderableType]:
    """How far off the tool is expected to be, by the covariance."""
    doubtful = not uncertainty.trustworthy or bool(uncertainty.reservations)
    return expected_tool_error(uncertainty.expected_error, ", if model and noise were as stated" * doubtful)


def expected_tool_error(expected: ExpectedError | None, condition: str = "") -> list[RenderableType]:
    """The section on how far off the tool is expected to be; none where the arm was evaluated as it is.

    Args:
        expected: How far.
        condition: Words for the heading.
    """
    if expected is None:
        return []
    table = plain_table(
        ("", "left"), ("", "left"), ("in the base frame", "right"), ("after the best rigid fit", "right")
    )
    for kind, unit in (("position", "m"), ("orientation", "rad")):
        factor, shown, decimals = SHOWN[unit]
        values = (getattr(rms, kind) for rms in (expected.base, expected.fitted))
        table.add_row(kind, shown, *("unknown" if v is None else f"{v * factor:.{decimals}f}" for v in values))
    which = "" if expected.n == expected.of else f" of {expected.of}"
    return section(f"Expected tool error (RMS at {expected.n}{which} {expected.at} configurations{condition})", table)


def _residuals(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    residuals, labels = uncertainty.residuals, solution.problem.data.labels
    table = plain_table(
        ("", "left"), ("", "left"), *[(h, "right") for h in ("train before", "after", "test before", "after")]
    )
    for number, family in sorted(residuals.groups, key=lambda g: (in_order(residuals.families).index(g[1]), g[0])):
        rms = residuals.rms(number)
        if family not in rms["train"] and family not in rms["test"]:
            continue
        factor, shown, _ = SHOWN[residuals.unit(family)]
        figures = [
            f"{rms[split][family][when] * factor:.4f}" if family in rms[split] else "-"
            for split in ("train", "test")
            for when in ("before", "after")
        ]
        table.add_row(family if len(labels) == 1 else f"{family} of {labels[number]}", shown, *figures)
    return table


def _joint_values(solution: Solution, found: JointValues | None, limit: int = 5) -> list[RenderableType]:
    """How estimated joint values lie about their readings, joint by joint, and the readings that are suspect."""
    if found is None:
        return []
    sigma = "stated" if solution.problem.state.factors.get(JOINT_NOISE, 1.0) == 1.0 else "estimated"
    table = plain_table(("", "left"), *((h, "right") for h in (sigma, "", f"mean error / {sigma}", "scatter")))
    joints = solution.problem.robot.joints
    for k, name in enumerate(found.names):
        factor, shown, decimals = SHOWN[joints[found.joints[k]].unit]
        scatter = "-" if np.isnan(found.scatter[k]) else f"{found.scatter[k]:.3f}"
        table.add_row(name, f"{found.sigma[k] * factor:.{decimals}f}", shown, rounded(found.mean[k], 3, "+"), scatter)
    parts = section(f"Joint readings (estimate minus reading; scatter is 1 where all is as {sigma})", table)
    if not found.suspects:
        return parts
    wrong = plain_table(("", "left"), ("", "left"), ("error", "right"), ("", "left"), ("in its sigma", "right"))
    names = solution.problem.end_names
    for i, k in found.suspects[:limit]:
        factor, shown, decimals = SHOWN[joints[found.joints[k]].unit]
        error = rounded(found.error[i, k] * factor, decimals, "+")
        wrong.add_row(
            names[found.configurations[i] + 1], found.names[k], error, shown, f"{found.studentised[i, k]:+.1f}"
        )
    if len(found.suspects) > limit:
        wrong.add_row("", f"and {len(found.suspects) - limit} more")
    return parts + section("Suspicious joint readings", wrong)


_UNKNOWNS = {
    "point": "Touched points (from the base), mm",
    "target": "Targets (in the tool frame), mm",
    "anchor": "Anchors (in the base frame), mm",
    "offset": "What instruments add to every length, mm",
    "plane": "Planes (unit normal in the base frame, distance from the base in mm)",
    "board": "Boards (in the base frame: rotation vector in deg, position in mm)",
    "unknown": "Other unknowns, [m] and [rad]",
}
"""Heading of each kind of unknown."""

_FIGURE = (1.0, "", 7)


def _points(solution: Solution, points: Sequence[PointEstimate], limit: int = 8) -> list[RenderableType]:
    """Where touched points and other unknowns of the measurements are; of many the first, `result.json` has all."""
    parts: list[RenderableType] = []
    for kind, title in _UNKNOWNS.items():
        chosen = [p for p in points if p.kind == kind]
        table = plain_table(("", "left"), ("rows", "right"), ("estimate", "right"), ("", "left"), ("sigma", "right"))
        for p in chosen[:limit]:
            shown = [_FIGURE if kind == "unknown" else SHOWN.get(unit, _FIGURE) for unit in p.units]
            xyz = "  ".join(rounded(v * of[0], of[2]) for v, of in zip(p.xyz, shown, strict=True))
            of_each = zip(p.sigma, shown, strict=True)
            sigma = "  ".join(f"{v * of[0]:.{of[2]}f}" if np.isfinite(v) else "unknown" for v, of in of_each)
            table.add_row(p.name, f"{p.n}", xyz, "±", "known" if not p.sigma.any() else sigma)
        if len(chosen) > limit:
            table.add_row(f"and {len(chosen) - limit} more", "", "", "", "")
        parts += section(title, table) if chosen else []
    return parts


def _frame(frame: FrameEstimate) -> RenderableType:
    xyz = "  ".join(rounded(v * 1e3, 4) for v in frame.xyz)
    q = "  ".join(rounded(v, 8) for v in frame.quaternion_xyzw)

    def sigmas(values: Iterable[float], factor: float, decimals: int) -> str:
        return "  ".join(f"{v * factor:.{decimals}f}" if np.isfinite(v) else "unknown" for v in values)

    table = plain_table(("", "left"), ("", "right"), ("", "left"))
    table.show_header = False
    table.add_row("xyz", xyz, "mm")
    table.add_row("± along its axes", sigmas(frame.sigma[3:], 1e3, 4), "mm")
    table.add_row("quaternion xyzw", q, "")
    table.add_row("± about its axes", sigmas(frame.sigma[:3], 180.0 / np.pi, 5), "deg")
    return table
