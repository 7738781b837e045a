"""The figures of a calibration: each a list of captions and charts, for the page and for files of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fg_calib.prediction.workspace import LEAST_WIDTH, Workspace
from fg_calib.report.page.charts import (
    BOTTOM,
    LEFT,
    RAMP,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Scale,
    bars,
    colour,
    limits_of,
    matrix,
    short,
    whiskers,
)
from fg_calib.report.page.markup import add, figure, tag
from fg_calib.report.page.run import Run
from fg_calib.report.shown import SHOWN

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

Floats = NDArray[np.float64]
Figure = tuple[str, "Element"]
"""A caption, and the chart that it is of."""

_CELLS = 22
"""Cells along each side of a slice of the workspace."""

_SLAB = 0.12
"""Thickness of a slice, in the width of the workspace."""

_MOST_PARAMETERS = 40
"""Parameters of which correlations are shown: the most correlated ones."""

_MOST_SIGMA = 5.0
"""Residuals in their sigma, up to which a histogram tells them apart."""

_WORST = 5
"""Dots that are marked by name."""


def accuracy_bars(run: Run) -> Figure:
    """RMS residuals before and after, by kind."""
    rows = []
    for family, rms in run.result.residual_rms.get(run.judged_on, {}).items():
        if rms is None:
            continue
        factor, unit, _ = SHOWN.get(run.unit(family.partition(",")[0]), (1.0, "", 3))
        found = []
        for when, value in (("before", rms.before), ("after", rms.after)):
            size = np.nan if value is None else value * factor
            found.append((when, size, f"{size:.3g} {unit}" if np.isfinite(size) else "unknown"))
        rows.append((family, found))
    about = f"RMS residuals of {run.judged_on} rows before and after the calibration"
    return about, bars(rows, about)


def error_over_joints(run: Run) -> list[Figure]:
    """Residuals of configurations against the reading of each joint."""
    found, family = run.configurations, run.family
    if found is None or family is None:
        return []
    factor, unit, _ = SHOWN.get(run.unit(family), (1.0, "", 3))
    rms = found.rms[family] * factor
    worst = np.argsort(-np.nan_to_num(rms))[:_WORST].tolist()
    charts = []
    for i, joint in enumerate(run.robot.joints):
        turned, of_reading, _ = SHOWN[joint.unit]
        q = found.readings[:, i] * turned
        about = f"{family} residual over the reading of {joint.name}"
        names = f"{short(joint.name, 40)} [{of_reading}]", f"{family} residual [{unit}]"
        chart = Chart(limits_of(q), limits_of(rms, with_zero=True), names, about)
        chart.dots(q[~found.test], rms[~found.test], "a")
        chart.dots(q[found.test], rms[found.test], "b")
        for k in worst:
            if np.isfinite(rms[k]):
                chart.marked(q[k], rms[k], f"{found.ids[k]}: {rms[k]:.3g} {unit}")
        charts.append((f"{joint.name}: {_colours(found.test)}, rings the {len(worst)} largest", chart.svg))
    return charts


def _colours(test: NDArray[np.bool_]) -> str:
    """What the colours of dots mean."""
    return ", ".join(["blue fitted"] * (not test.all()) + ["orange held out"] * bool(test.any()))


def arm_ranges(workspace: Workspace) -> Figure:
    """Every joint's readings within its limits, and the widest gap."""
    row, left = 24.0, 92.0
    height = TOP + row * len(workspace.joints)
    about = "Where each joint was read, within its limits"
    svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(WIDTH)} {figure(height)}", role="img")
    for i, joint in enumerate(workspace.joints):
        ends = [v for v in (*joint.limits, *joint.range) if np.isfinite(v)]
        low, high = min(ends), max(ends)
        scale, y = Scale(low, high if high > low else low + 1.0, left, WIDTH - 10.0), TOP + row * i
        factor, unit, _ = SHOWN[joint.unit]
        add(svg, tag("text", short(joint.name), x=left - 6.0, y=y + 10.0, class_="tick end"))
        add(svg, tag("rect", x=left, y=y, width=WIDTH - 10.0 - left, height=12.0, class_="band"))
        start, end = scale(joint.range[0]), scale(joint.range[1])
        add(svg, tag("rect", x=start, y=y + 3.0, width=max(end - start, 1.0), height=6.0, class_="after"))
        gap = [scale(v) for v in joint.gap]
        words = f"{joint.name}: nothing between {joint.gap[0] * factor:.4g} and {joint.gap[1] * factor:.4g} {unit}"
        add(svg, tag("rect", tag("title", words), x=gap[0], y=y, width=gap[1] - gap[0], height=12.0, class_="gap"))
        add(svg, tag("text", f"{low * factor:.4g}", x=left, y=y + 21.0, class_="tick"))
        add(svg, tag("text", f"{high * factor:.4g} {unit}", x=WIDTH - 10.0, y=y + 21.0, class_="tick end"))
    return "pale: between the limits; blue: from the lowest to the highest reading; amber: the widest gap", svg


def parameter_whiskers(run: Run) -> list[Figure]:
    """Corrections with their sigmas and tolerances, lengths and angles apart."""
    charts = []
    for unit, what in (("m", "Lengths"), ("rad", "Angles")):
        factor, name, _ = SHOWN[unit]
        rows = [
            (p.name, p.correction * factor, _times(p.sigma, factor), _times(p.prior_sigma, factor))
            for p in run.result.parameters
            if p.identifiability != "fixed" and p.unit == unit
        ]
        if rows:
            charts.append((f"{what}: correction [{name}]", whiskers(rows, f"{what}: corrections", f"[{name}]")))
    return charts


def _times(value: float | None, factor: float) -> float:
    return np.nan if value is None else value * factor


def correlation_matrix(run: Run) -> Figure | None:
    """Correlations of the errors of parameters; None of fewer than two."""
    names, covariance = run.result.covariance.names, run.result.covariance.matrix
    C = np.array(covariance, dtype=np.float64).reshape(len(names), len(names))
    known = np.flatnonzero(np.isfinite(np.diag(C)) & (np.diag(C) > 0.0))
    if len(known) < 2:
        return None
    sigma = np.sqrt(np.diag(C)[known])
    rho = C[np.ix_(known, known)] / np.outer(sigma, sigma)
    most = np.max(np.abs(np.where(np.eye(len(known)), 0.0, np.nan_to_num(rho))), axis=1)
    chosen = np.sort(np.argsort(-most, kind="stable")[:_MOST_PARAMETERS])
    about = "Correlations of the errors of parameters: orange positive, blue negative"
    about += "" if len(chosen) == len(known) else f"; the {len(chosen)} most correlated of {len(known)}"
    return about, matrix([names[known[k]] for k in chosen], rho[np.ix_(chosen, chosen)], about)


def residual_charts(run: Run) -> list[Figure]:
    """Studentised residuals: how they are distributed, and row by row."""
    found = run.residuals
    if found is None or not np.isfinite(found.studentised).any():
        return []
    charts = []
    families = [kind.partition(".")[0] for kind in found.kinds]
    of_rows = np.array(families)[found.kind]
    for family in dict.fromkeys(families):
        mine = (of_rows == family) & np.isfinite(found.studentised)
        fitted = mine & ~found.test  # those held out share the errors of the estimate
        mine = fitted if fitted.any() else mine
        if mine.any():
            rows = "fitted" if fitted.any() else "held-out"
            about = f"{family}: {int(mine.sum())} {rows} rows, and the curve of noise"
            values = found.studentised[mine]
            beyond = int(np.sum(np.abs(values) > _MOST_SIGMA))
            about += f"; {beyond} beyond {_MOST_SIGMA:g} are in the columns at the ends" if beyond else ""
            charts.append((about, _histogram(values, family)))
    shown = np.clip(found.studentised, -12.0, 12.0)
    order = np.arange(len(shown), dtype=np.float64)
    about = f"Residuals in the order of {found.file}"
    chart = Chart((0.0, max(len(shown), 2)), limits_of(shown, [-4.0, 4.0]), ("row", "in its sigma"), about)
    for level in (-3.0, 3.0):
        chart.level(level)
    chart.dots(order[~found.test], shown[~found.test], "a")
    chart.dots(order[found.test], shown[found.test], "b")
    suspects = np.flatnonzero(found.suspect & np.isfinite(shown))
    for k in suspects[np.argsort(-np.abs(found.studentised[suspects]))][: 4 * _WORST].tolist():
        name = " ".join(filter(None, (found.kinds[found.kind[k]], found.a[k], found.b[k], found.of[k])))
        chart.marked(float(order[k]), float(shown[k]), f"{name}: {found.studentised[k]:+.1f}")
    rings = ", rings suspicious" if len(suspects) else ""
    cut = "; what is larger is drawn at 12" if np.any(np.abs(found.studentised) > 12.0) else ""
    charts.append((f"{about}: {_colours(found.test)}{rings}{cut}", chart.svg))
    return charts


def _histogram(values: Floats, family: str) -> Element:
    """How residuals are distributed; a column of its own at each end, in another colour, holds what is beyond."""
    most, end = _MOST_SIGMA, 0.5
    edges, beyond = np.linspace(-most, most, 41), np.abs(values) > most
    counts, _ = np.histogram(values[~beyond], edges)
    density = counts / (len(values) * (edges[1] - edges[0]))
    ends = [float(np.mean(beyond & (np.sign(values) == sign))) / end for sign in (-1.0, 1.0)]
    about = f"How {family} residuals are distributed"
    heights = limits_of(density, ends, [0.45], with_zero=True)
    chart = Chart((-most - end, most + end), heights, ("residual, in its sigma", "share per sigma"), about)
    for low, high, height in zip(edges[:-1], edges[1:], density, strict=True):
        if height > 0.0:
            chart.box(float(low), 0.0, float(high), float(height), class_="column")
    for sign, height in zip((-1.0, 1.0), ends, strict=True):
        if height > 0.0:
            chart.box(sign * most, 0.0, sign * (most + end), height, class_="beyond")
            words = f"{'<' if sign < 0.0 else '>'} {sign * most:g}".replace("-", "\N{MINUS SIGN}")
            where = "tick" if sign < 0.0 else "tick end"
            chart.text(chart.x(sign * (most + end)), chart.y(height) - 3.0, words, where)
    x = np.linspace(-most, most, 81)
    chart.curve(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), "curve")
    return chart.svg


def workspace_slices(found: Workspace) -> list[Figure]:
    """Expected error of the tool in three slices through the middle of what was measured."""
    middle = np.median(found.measured, axis=0)
    low, high = found.position.min(axis=0), found.position.max(axis=0)
    width = max(float((high - low).max()), LEAST_WIDTH)
    thick = _SLAB * width
    low, high = (0.5 * (low + high) + sign * 0.52 * width for sign in (-1.0, 1.0))  # a cube: all axes on one scale
    ends = np.nanquantile(found.error, [0.05, 0.95]) * 1e3
    charts = []
    for across, up, through in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        inside = np.abs(found.position[:, through] - middle[through]) < thick / 2.0
        names = "xyz"[across], "xyz"[up]
        about = f"Expected error at {'xyz'[through]} = {middle[through]:.3g} m, within {thick / 2.0:.2g} m"
        chart = Chart(
            (float(low[across]), float(high[across])),
            (float(low[up]), float(high[up])),
            (f"{names[0]} [m]", f"{names[1]} [m]"),
            about,
            (WIDTH, WIDTH - LEFT - RIGHT + TOP + BOTTOM),
        )
        _draw_cells(chart, found.position[inside][:, [across, up]], found.error[inside] * 1e3, ends)
        near = np.abs(found.measured[:, through] - middle[through]) < thick / 2.0
        for kind in ("halo", "measured"):
            chart.dots(found.measured[near, across], found.measured[near, up], kind)
        charts.append((f"{about}; dots: measured", chart.svg))
    return [*charts, _legend(ends)]


def _draw_cells(chart: Chart, at: Floats, error: Floats, ends: Floats) -> None:
    """A coloured cell where configurations come to, by the RMS of their errors."""
    known = np.isfinite(error)
    x_edges, y_edges = (np.linspace(s.low, s.high, _CELLS + 1) for s in (chart.x, chart.y))
    n, _, _ = np.histogram2d(at[known, 0], at[known, 1], (x_edges, y_edges))
    squares, _, _ = np.histogram2d(at[known, 0], at[known, 1], (x_edges, y_edges), weights=error[known] ** 2)
    for i, j in np.argwhere(n > 0).tolist():
        rms = float(np.sqrt(squares[i, j] / n[i, j]))
        fill = colour((rms - ends[0]) / (ends[1] - ends[0] or 1.0))
        chart.box(float(x_edges[i]), float(y_edges[j]), float(x_edges[i + 1]), float(y_edges[j + 1]), fill=fill)


def _legend(ends: Floats) -> Figure:
    """The colours of the slices."""
    about = f"Colours from {ends[0]:.3g} to {ends[1]:.3g} mm"
    svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(WIDTH)} 50", role="img")
    wide = (WIDTH - 20.0) / len(RAMP)
    for k, fill in enumerate(RAMP):
        add(svg, tag("rect", x=10.0 + wide * k, y=4.0, width=wide + 0.5, height=16.0, fill=fill))
    for k in range(5):
        words = f"{ends[0] + (ends[1] - ends[0]) * k / 4.0:.3g}{' mm' * (k == 4)}"
        add(svg, tag("text", words, x=10.0 + (WIDTH - 20.0) * k / 4.0, y=36.0, class_=_place(k)))
    return f"{about}: what is expected of the tool's position (RMS)", svg


def _place(k: int) -> str:
    return f"tick{'' if k == 0 else ' end' if k == 4 else ' middle'}"


def figures_of(run: Run) -> dict[str, Sequence[Figure]]:
    """All figures by name; what the folder lacks has none."""
    matrix_of, found = correlation_matrix(run), run.workspace
    known = found is not None and not run.result.evaluated_only and bool(np.isfinite(found.error).any())
    every: dict[str, Sequence[Figure]] = {
        "accuracy": [accuracy_bars(run)],
        "joints": error_over_joints(run),
        "ranges": [] if found is None else [arm_ranges(found)],
        "parameters": parameter_whiskers(run),
        "correlations": [] if matrix_of is None else [matrix_of],
        "residuals": residual_charts(run),
        "workspace": workspace_slices(found) if known and found is not None else [],
    }
    return {name: charts for name, charts in every.items() if charts}
