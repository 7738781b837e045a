"""The figures of a calibration, of what is identifiable, and of expected errors over the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.inputs import Booleans, Floats
from fg_calib.io import Result
from fg_calib.observability import Identifiability
from fg_calib.prediction import PredictedErrors, ToolPoseUncertainty, predict_errors
from fg_calib.report.charts import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Plot,
    Whisker,
    bars,
    colour,
    legend,
    limits_of,
    matrix,
    short,
    whiskers,
)
from fg_calib.report.tables import SHOWN, in_words
from fg_calib.robot import Robot
from fg_calib.simulation import link_points
from fg_calib.statistics import TangentCovariance

if TYPE_CHECKING:
    import polars as pl

CELLS = 22
"""Cells along each side of a slice of the workspace."""

SLAB = 0.12
"""Thickness of a slice, in widths of the workspace."""

MAX_PARAMETERS = 40
"""Parameters whose correlations are shown: the most correlated ones."""

MAX_SIGMA = 5.0
"""Residuals in their sigma, up to which a histogram distinguishes them."""

WORST = 5
"""Dots that are marked by name."""

MIN_WIDTH_M = 1e-3
"""Least width of a slice."""


@dataclass(frozen=True)
class Drawn:
    """What figures are made of.

    Attributes:
        result: The result.
        robot: The calibrated robot.
        posterior: The covariance of its parameters.
        configurations: Every measured configuration; None if they were not saved.
        residuals: Every scalar residual; None if they were not saved.
    """

    result: Result
    robot: Robot
    posterior: TangentCovariance
    configurations: pl.DataFrame | None
    residuals: pl.DataFrame | None

    @property
    def split(self) -> str:
        """The rows that accuracy is shown of: `test` if there are any, else `train`."""
        return "test" if self.result.rms_after("test") else "train"

    @cached_property
    def readings(self) -> Floats:
        """Readings of the measured configurations, shape (n, n_joints), [rad] (prismatic: [m])."""
        assert self.configurations is not None
        return self.configurations.select(f"q{i + 1}" for i in range(self.robot.n_joints)).to_numpy()

    @cached_property
    def held_out(self) -> Booleans:
        """Which configurations were held out, shape (n,)."""
        assert self.configurations is not None
        return (self.configurations["split"] == "test").to_numpy()

    @cached_property
    def workspace(self) -> PredictedErrors | None:
        """Expected errors over the workspace; None where nothing says what was measured."""
        if self.configurations is None or not len(self.configurations):
            return None
        model = ToolPoseUncertainty.of(self.posterior, self.readings)
        return predict_errors(self.robot, model, self.readings, fitted=self.result.free_of_frame)

    @cached_property
    def rms(self) -> tuple[str, Floats] | None:
        """The kind of residual that is nearest to the tool's position, and its RMS by configuration, shape (n,)."""
        if self.configurations is None:
            return None
        kinds = [name.removeprefix("rms_") for name in self.configurations.columns if name.startswith("rms_")]
        for kind in sorted(kinds, key=lambda k: ["position", "distance", "point", "pixel", k].index(k)):
            values = self.configurations[f"rms_{kind}"].cast(float).fill_null(np.nan).to_numpy()
            if np.isfinite(values).any():
                return kind, values
        return None


def figures_of(drawn: Drawn) -> dict[str, Sequence[Chart]]:
    """All figures of a calibration by name; those that its tables lack are left out."""
    correlations, space = correlation_matrix(drawn), drawn.workspace
    if drawn.result.evaluated_only or (space is not None and space.unknown == 1.0):
        space = None
    every: dict[str, Sequence[Chart]] = {
        "accuracy": [accuracy_bars(drawn)],
        "joints": error_over_joints(drawn),
        "parameters": parameter_whiskers(drawn.result),
        "correlations": [] if correlations is None else [correlations],
        "residuals": residual_charts(drawn),
        "workspace": error_slices(space.errors.position, space.expected[:, 0], space.measured) if space else [],
    }
    return {name: charts for name, charts in every.items() if charts}


def accuracy_bars(drawn: Drawn) -> Chart:
    """RMS residuals before and after, by kind."""
    rows = []
    for kind, rms in drawn.result.residual_rms[drawn.split].items():
        if rms is not None:
            unit = drawn.result.unit_of(kind)
            values = (("before", rms.before), ("after", rms.after))
            rows.append((kind, [(when, np.nan if v is None else v, in_words(v, unit)) for when, v in values]))
    return bars(rows, f"RMS residuals of {drawn.split} rows before and after the calibration")


def error_over_joints(drawn: Drawn) -> list[Chart]:
    """Residuals of configurations over the reading of each joint."""
    if drawn.rms is None or drawn.configurations is None:
        return []
    kind, values = drawn.rms
    factor, unit, _ = SHOWN.get(drawn.result.unit_of(kind), (1.0, "", 3))
    rms, test = values * factor, drawn.held_out
    worst = np.argsort(-np.nan_to_num(rms))[:WORST].tolist()
    charts = []
    for i, joint in enumerate(drawn.robot.joints):
        of_reading, shown, _ = SHOWN[joint.unit]
        q = drawn.readings[:, i] * of_reading
        names = f"{short(joint.name, 40)} [{shown}]", f"{kind} residual [{unit}]"
        plot = Plot(limits_of(q), limits_of(rms, with_zero=True), names)
        plot.dots(q[~test], rms[~test], "a")
        plot.dots(q[test], rms[test], "b")
        for k in worst:
            if np.isfinite(rms[k]):
                plot.ring(q[k], rms[k], f"{drawn.configurations['id'][k]}: {rms[k]:.3g} {unit}")
        charts.append(plot.chart(f"{joint.name}: {_colours(test)}, rings the {len(worst)} largest"))
    return charts


def _colours(test: Booleans) -> str:
    return ", ".join(["blue fitted"] * (not test.all()) + ["orange held out"] * bool(test.any()))


def parameter_whiskers(result: Result) -> list[Chart]:
    """Corrections with their sigmas and prior sigmas, lengths and angles apart."""
    charts = []
    for unit, what in (("m", "Lengths"), ("rad", "Angles")):
        factor, name, _ = SHOWN[unit]
        rows = [
            Whisker(p.name, *(np.nan if v is None else v * factor for v in (p.correction, p.sigma, p.prior_sigma)))
            for p in result.estimated
            if p.unit == unit
        ]
        if rows:
            charts.append(whiskers(rows, f"{what}: correction [{name}]", f"[{name}]"))
    return charts


def correlation_matrix(drawn: Drawn) -> Chart | None:
    """Correlations of the errors of parameters; None of fewer than two."""
    names, C = drawn.result.covariance.names, drawn.result.covariance.matrix
    variance = C.reshape(len(names), len(names)).diagonal()
    known = np.flatnonzero(np.isfinite(variance) & (variance > 0.0))
    if len(known) < 2:
        return None
    sigma = np.sqrt(variance[known])
    rho = C[np.ix_(known, known)] / np.outer(sigma, sigma)
    most = np.max(np.abs(np.where(np.eye(len(known)), 0.0, np.nan_to_num(rho))), axis=1)
    chosen = np.sort(np.argsort(-most, kind="stable")[:MAX_PARAMETERS])
    more = "" if len(chosen) == len(known) else f"; the {len(chosen)} most correlated of {len(known)}"
    below = np.where(np.tri(len(chosen), k=-1, dtype=np.bool_), rho[np.ix_(chosen, chosen)], np.nan)
    labels = [names[known[k]] for k in chosen]
    return matrix(labels, labels, below, f"Correlations of the errors: orange positive, blue negative{more}")


def residual_charts(drawn: Drawn) -> list[Chart]:
    """Studentised residuals: their distribution by kind, and row by row."""
    if drawn.residuals is None:
        return []
    rows = drawn.residuals.filter(drawn.residuals["excluded"].is_null()).with_row_index("number")
    values, test = rows["studentised"].cast(float).fill_null(np.nan).to_numpy(), (rows["split"] == "test").to_numpy()
    if not np.isfinite(values).any():
        return []
    charts, kinds = [], np.array([kind.partition(".")[0] for kind in rows["kind"].to_list()])
    for kind in dict.fromkeys(kinds.tolist()):
        mine = (kinds == kind) & np.isfinite(values)
        fitted = mine & ~test  # rows that were held out share the errors of the estimate
        chosen, which = (fitted, "fitted") if fitted.any() else (mine, "held-out")
        if chosen.any():
            beyond = int(np.sum(np.abs(values[chosen]) > MAX_SIGMA))
            more = f"; {beyond} beyond {MAX_SIGMA:g} are in the columns at the ends" if beyond else ""
            caption = f"{kind}: {int(chosen.sum())} {which} rows, and the normal distribution{more}"
            charts.append(_histogram(values[chosen], caption))
    return [*charts, _row_by_row(rows, values, test)]


def _row_by_row(rows: pl.DataFrame, values: Floats, test: Booleans, most: float = 12.0) -> Chart:
    shown, order = np.clip(values, -most, most), np.arange(len(values), dtype=np.float64)
    plot = Plot((0.0, max(len(shown), 2)), limits_of(shown, [-4.0, 4.0]), ("row", "in its sigma"))
    for level in (-3.0, 3.0):
        plot.level(level)
    plot.dots(order[~test], shown[~test], "a")
    plot.dots(order[test], shown[test], "b")
    suspects = rows.filter(rows["suspect"]).sort(rows.filter(rows["suspect"])["studentised"].abs(), descending=True)
    for row in suspects.head(4 * WORST).iter_rows(named=True):
        name = " ".join(str(row[key]) for key in ("kind", "a", "b", "of") if row.get(key))
        plot.ring(row["number"], shown[row["number"]], f"{name}: {row['studentised']:+.1f}")
    rings = ", rings suspicious" if len(suspects) else ""
    cut = f"; larger ones are drawn at {most:g}" if np.any(np.abs(values) > most) else ""
    return plot.chart(f"Residuals row by row: {_colours(test)}{rings}{cut}")


def _histogram(values: Floats, caption: str) -> Chart:
    """The distribution of residuals; a column at each end holds those beyond `MAX_SIGMA`."""
    most, end = MAX_SIGMA, 0.5
    edges, beyond = np.linspace(-most, most, 41), np.abs(values) > most
    density = np.histogram(values[~beyond], edges)[0] / (len(values) * (edges[1] - edges[0]))
    ends = [float(np.mean(beyond & (np.sign(values) == sign))) / end for sign in (-1.0, 1.0)]
    heights = limits_of(density, ends, [0.45], with_zero=True)
    plot = Plot((-most - end, most + end), heights, ("residual, in its sigma", "share per sigma"))
    for low, high, height in zip(edges[:-1].tolist(), edges[1:].tolist(), density.tolist(), strict=True):
        if height > 0.0:
            plot.box(low, 0.0, high, height, class_="column")
    for sign, height in zip((-1.0, 1.0), ends, strict=True):
        if height > 0.0:
            plot.box(sign * most, 0.0, sign * (most + end), height, class_="beyond")
    x = np.linspace(-most, most, 81)
    plot.curve(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), "curve")
    return plot.chart(caption)


def error_slices(position: Floats, error: Floats, measured: Floats) -> list[Chart]:
    """Expected error of the tool in three slices through the middle of the measured configurations.

    Args:
        position: Tool positions, shape (n, 3), [m].
        error: Expected error of each, shape (n,), [m]; nan where it is unknown.
        measured: Measured tool positions, shape (m, 3), [m].
    """
    middle = np.median(measured, axis=0)
    low, high = position.min(axis=0), position.max(axis=0)
    width = max(float((high - low).max()), MIN_WIDTH_M)
    thick = SLAB * width
    low, high = (0.5 * (low + high) + sign * 0.52 * width for sign in (-1.0, 1.0))  # all axes on one scale
    ends = np.nanquantile(error, [0.05, 0.95]) * 1e3
    charts = []
    for across, up, through in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        inside = np.abs(position[:, through] - middle[through]) < thick / 2.0
        x, y = ((float(low[axis]), float(high[axis])) for axis in (across, up))
        names = f"{'xyz'[across]} [m]", f"{'xyz'[up]} [m]"
        plot = Plot(x, y, names, (WIDTH, WIDTH - LEFT - RIGHT + TOP + BOTTOM))
        _draw_cells(plot, position[inside][:, [across, up]], error[inside] * 1e3, ends)
        near = np.abs(measured[:, through] - middle[through]) < thick / 2.0
        for kind in ("halo", "measured"):
            plot.dots(measured[near, across], measured[near, up], kind)
        where = f"{'xyz'[through]} = {middle[through]:.3g} m, within {thick / 2.0:.2g} m"
        charts.append(plot.chart(f"Expected error at {where}; dots: measured"))
    caption = "Colours of the expected error of the tool's position (RMS)"
    return [*charts, legend(float(ends[0]), float(ends[1]), "mm", caption)]


def _draw_cells(plot: Plot, at: Floats, error: Floats, ends: Floats) -> None:
    """A coloured cell at each place that configurations reach, by the RMS of their errors."""
    known = np.isfinite(error)
    edges = [np.linspace(s.low, s.high, CELLS + 1) for s in (plot.x, plot.y)]
    n, _, _ = np.histogram2d(at[known, 0], at[known, 1], edges)
    squares, _, _ = np.histogram2d(at[known, 0], at[known, 1], edges, weights=error[known] ** 2)
    for i, j in np.argwhere(n > 0).tolist():
        share = (np.sqrt(squares[i, j] / n[i, j]) - ends[0]) / (ends[1] - ends[0] or 1.0)
        x, y = edges[0][i : i + 2].tolist(), edges[1][j : j + 2].tolist()
        plot.box(x[0], y[0], x[1], y[1], fill=colour(float(share)))


def draw_observability(found: Identifiability) -> dict[str, Sequence[Chart]]:
    """The singular values and the null-space directions."""
    o = found.observability
    s = np.maximum(o.singular_values / (o.singular_values.max(initial=0.0) or 1.0), 1e-18)
    number, kept = np.arange(1.0, len(s) + 1.0), np.arange(len(s)) < o.rank
    plot = Plot((0.0, len(s) + 1.0), limits_of(np.log10(s)), ("number", "singular value / largest"), powers=True)
    plot.dots(number[kept], np.log10(s[kept]), "large a")
    plot.dots(number[~kept], np.log10(s[~kept]), "large b")
    rank = plot.chart(f"rank {o.rank} of {len(o.names)}: blue determined, orange not")
    figures: dict[str, Sequence[Chart]] = {"singular_values": [rank]}
    if found.lost:
        names = [name for name in o.names if any(name in lost.relation for lost in found.lost)]
        changes = np.array([[lost.relation.get(name, np.nan) for name in names] for lost in found.lost])
        reasons = [lost.reason.partition(":")[0] for lost in found.lost]
        caption = "Null-space directions: change of each parameter [m], [rad], orange positive, blue negative"
        figures["groups"] = [matrix(reasons, names, changes, caption)]
    return figures


def arm_scene(drawn: Drawn, most: int = 300) -> Mapping[str, Any] | None:
    """What `arm.js` draws: the measured configurations with the arm's shape and residual; None where unknown.

    Args:
        drawn: The calibration.
        most: Configurations that are shown; of more, as many that are evenly spaced, and the worst.
    """
    if drawn.rms is None or drawn.configurations is None or not len(drawn.configurations):
        return None
    kind, rms = drawn.rms
    evenly = np.linspace(0, len(rms) - 1, min(most, len(rms))).astype(np.int64)
    chosen = np.unique(np.concatenate([evenly, np.argsort(-np.nan_to_num(rms))[:20]]))
    factor, unit, _ = SHOWN.get(drawn.result.unit_of(kind), (1.0, "", 3))
    values, links = rms[chosen] * factor, link_points(drawn.robot, drawn.readings[chosen])
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.quantile(known, [0.0, 0.98])) if len(known) else (0.0, 1.0)
    items = [
        {
            "id": drawn.configurations["id"][k],
            "test": bool(drawn.held_out[k]),
            "value": float(f"{value:.4g}") if np.isfinite(value) else None,
            "links": np.round(points, 4).tolist(),
        }
        for k, value, points in zip(chosen.tolist(), values.tolist(), links, strict=True)
    ]
    return {"unit": unit, "family": kind, "low": low, "high": high, "items": items}
