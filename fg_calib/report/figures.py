"""The figures of a calibration, of what is identifiable, and of expected errors over the workspace."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib import robot, simulation
from fg_calib.inputs import Booleans, Floats, expect, pl
from fg_calib.report import charts
from fg_calib.report.charts import Chart, Plot, limits_of, standalone
from fg_calib.report.tables import figure, in_words, shown_in
from fg_calib.report.text import ReportData
from fg_calib.statistics import ParameterEstimate

CELLS = 22
"""Cells along each side of a slice of the workspace."""

SLAB = 0.12
"""Thickness of a slice, in widths of the workspace."""

MAX_PARAMETERS = 40
"""Parameters whose correlations are shown: the most correlated ones."""

MAX_SIGMA = 5.0
"""Largest residual, in its sigma, that a histogram distinguishes."""

MAX_STUDENTISED = 12.0
"""Residuals in their sigma, up to which rows are drawn where they are."""

MIN_TORQUE_RANGE = 1e-6
"""Range of torques that is more than rounding, [N m]."""

MAX_PRIOR = 1.5
"""Prior sigmas over the largest correction and its sigma, up to which they are drawn."""

WORST = 5
"""Dots that are marked by name."""


def figures_of(data: ReportData) -> dict[str, Sequence[Chart]]:
    """All figures of a calibration by name, in the order of the page; none where its tables lack them."""
    space = None if data.result.evaluated_only else data.workspace
    return {
        "parameters": list(parameter_whiskers(data)),
        "curves": list(error_curves(data)),
        "compliances": list(errors_over_torque(data)),
        "residuals": residual_charts(data),
        "joints": list(error_over_joints(data)),
        "correlations": correlation_matrix(data),
        "workspace": error_slices(space.errors.position, space.expected[:, 0], space.measured) if space else [],
    }


class Drawing(str):
    """An SVG image: notebooks show it, `Path.write_text` saves it."""

    __slots__ = ()

    def _repr_svg_(self) -> str:
        return str(self)


def draw(data: ReportData, name: str) -> Drawing:
    """A figure of a calibration by its name in `figures_of`.

    Raises:
        InputError: Its tables were not saved, or there is nothing to draw.
    """
    charts = figures_of(data)[name]
    expect(charts, name, "nothing to draw: its tables were not saved, or nothing of it was estimated")
    return Drawing(standalone(charts))


def error_over_joints(data: ReportData) -> Iterator[Chart]:
    """Signed residuals over the reading of each joint, where an error of the joint once a turn is a sine.

    Of positions it is the component along the joint's own motion, else each component of the kind that is nearest to
    the tool's position; a pair stands at the reading of its second configuration.
    """
    if data.rms is None or data.configurations is None or data.residuals is None:
        return
    kind, ids = data.rms[0], data.configurations["id"].to_list()
    if (errors := tool_errors(data)) is not None:
        size = np.linalg.norm(errors[1], axis=1, keepdims=True)  # on its axis a joint moves nothing
        at, signed = np.arange(len(ids)), -np.einsum("ni,nij->nj", errors[0], errors[1] / np.where(size, size, np.nan))
    else:
        rows = data.residuals.filter(data.residuals["excluded"].is_null())
        rows = rows.filter([name.partition(".")[0] == kind for name in rows["kind"]])
        place = {name: k for k, name in enumerate(ids)}
        at = np.array([place[b if b in place else a] for a, b in rows.select("a", "b").rows()])
        signed = np.repeat(rows["residual"].to_numpy()[:, None], data.robot.n_joints, axis=1)
    scale, test = shown_in(data.result.unit_of(kind)), data.held_out[at]
    for joint, readings, r in zip(data.robot.joints, data.readings[at].T, signed.T * scale.factor, strict=True):
        q, shown = readings * shown_in(joint.unit).factor, charts.without_outliers(r)
        names = f"{charts.short(joint.name, 40)} [{shown_in(joint.unit).unit}]", f"{kind} residual [{scale.unit}]"
        plot = Plot(limits_of(q), limits_of(shown, with_zero=True), names)
        plot.line((plot.x.low, plot.x.high), 0.0, "level")
        plot.dots(q[~test], shown[~test], "a")
        plot.dots(q[test], shown[test], "b")
        worst = [k for k in np.argsort(-np.abs(np.nan_to_num(r)))[:WORST].tolist() if np.isfinite(r[k])]
        for k in worst:
            plot.ring(q[k], shown[k], f"{ids[at[k]]}: {r[k]:+.3g} {scale.unit}")
        beyond = charts.cut(int(np.sum(np.abs(shown - r) > 0.0)))
        yield plot.chart(f"{joint.name}: {_colours(test)}, rings the {len(worst)} largest{beyond}")


def _colours(test: Booleans) -> str:
    return ", ".join(["blue fitted"] * (not test.all()) + ["orange held out"] * bool(test.any()))


def parameter_whiskers(data: ReportData) -> Iterator[Chart]:
    """Corrections with their sigmas and prior sigmas; each unit, base, tool and effects on axes of their own."""
    groups = dict[tuple[str, str], list[ParameterEstimate]]()
    for p in (p for p in data.result.estimated if robot.kind_of(p.name) != "curve"):
        what = {"base": "Base", "tool": "Tool"}.get(p.name.partition(".")[0], {"m": "Lengths"}.get(p.unit, "Angles"))
        what = "Effects of joints" if robot.kind_of(p.name) in robot.EFFECT_KINDS else what
        groups.setdefault((what, p.unit), []).append(p)
    for (what, unit), shown in groups.items():
        columns = [[p.correction for p in shown], [p.sigma for p in shown], [p.prior_sigma for p in shown]]
        value, sigma, prior = np.array(columns, dtype=np.float64) * shown_in(unit).factor
        name, spread, row = f"[{shown_in(unit).unit}]", np.nan_to_num(sigma), np.arange(float(len(shown)))
        prior = np.minimum(prior, MAX_PRIOR * (np.max(np.abs(value) + spread) or np.inf))
        limits = limits_of(value - spread, value + spread, [0.0], prior, -prior)
        plot = Plot(limits, [p.name for p in shown], (name, ""))
        for k in np.flatnonzero(np.isfinite(prior)).tolist():
            plot.box((-prior[k], prior[k]), (k - 0.4, k + 0.4), class_="band")
        for k in np.flatnonzero(np.isfinite(sigma)).tolist():
            plot.line((value[k] - sigma[k], value[k] + sigma[k]), k, "whisker")
        for known, kind in ((np.isfinite(sigma), "large a"), (np.isnan(sigma), "large b")):
            plot.dots(value[known], row[known], kind)
        yield plot.chart(f"{what}: correction {name}")


def error_curves(data: ReportData) -> Iterator[Chart]:
    """Error curves of joints over their range or a turn, with 2 sigma to both sides, and the fitted readings."""
    posterior, (unit, factor, *_) = data.posterior, shown_in("rad")
    for v in (v for v in posterior.variables.nuisance if v.kind == "curve"):
        joint, n = data.robot.joints[v.number - 1], len(v.places)
        low, high = (joint.lower, joint.upper) if joint.upper - joint.lower < 2.0 * np.pi else (-np.pi, np.pi)
        x = np.linspace(low, high, 2 * n + 1)
        knots, weights = robot.spline(x, n)
        turn = np.einsum("nk,nk->n", weights, posterior.parameters[v.places[knots]]) * factor
        errors = posterior.curves[v.columns.start - posterior.variables.n_columns + knots]
        variance = posterior.variance(np.einsum("nk,nkc->nc", weights, errors))
        band = turn + 2.0 * np.nan_to_num(np.sqrt(variance)) * factor * np.array([[-1.0], [1.0]])
        names = f"{charts.short(joint.name, 40)} [{unit}]", f"error [{unit}]"
        plot = Plot((low * factor, high * factor), limits_of(band), names)
        plot.curve(np.append(x, x[::-1]) * factor, np.append(band[0], band[1, ::-1]), "band")
        plot.curve(x * factor, turn)
        if data.configurations is not None:
            q = np.unique(np.round((data.readings[~data.held_out, v.number - 1] - low) % (2.0 * np.pi), 2)) + low
            plot.dots(q * factor, np.full(len(q), plot.y.low), "a")
        yield plot.chart(f"{joint.name}: error curve, and the readings of fitted rows")


def errors_over_torque(data: ReportData) -> Iterator[Chart]:
    """Errors of joints that give way over their torque, with their compliance and without it."""
    if (errors := joint_errors(data)) is None:
        return
    known = {p.name: p for p in data.result.parameters}
    for effect in (e for e in data.robot.effects if isinstance(e, robot.Compliance)):
        alone = replace(data.robot, effects=(effect,))
        for term, tau in zip(alone.terms[0], alone.trig(data.readings)[:, alone.n_joints :, 0].T, strict=True):
            if not term.name.endswith(".compliance") or np.ptp(tau) < MIN_TORQUE_RANGE:
                continue
            p, factor, ends = known[term.name], shown_in("rad/(N m)").factor, limits_of(tau)
            after, line = errors[:, term.owner - 1] * factor, p.estimate * np.array(ends) * factor
            taken, kept = p.estimate * tau * factor, charts.without_outliers(after)
            before, limits = after + taken, limits_of(kept, kept + taken, line)
            outside = np.any([(e < limits[0]) | (e > limits[1]) for e in (after, before)], axis=0)
            names = f"torque on {charts.short(data.robot.joints[term.owner - 1].name, 30)} [N m]", "error [urad]"
            plot = Plot(ends, limits, names)
            plot.dots(tau, np.clip(before, *limits), "b")
            plot.dots(tau, np.clip(after, *limits), "a")
            plot.curve(np.array(ends), line)
            value = f"{figure(p.estimate, p.unit, '.3g')} ± {in_words(p.sigma, p.unit, '.2g')}"
            yield plot.chart(f"{p.name}: {value}{charts.cut(int(outside.sum()))}")


def tool_errors(data: ReportData) -> tuple[Floats, Floats] | None:
    """Errors of the tool's position, measured minus predicted, and what joints move it by, in the base frame.

    Shapes (n, 3), [m], nan where there are none, and (n, 3, n_joints); None where no positions of the tool were
    measured: those of boards are along the camera's axes.
    """
    rows, table = data.residuals, data.configurations
    if rows is None or table is None or "rms_position" not in table.columns or "board" in data.result.model:
        return None
    place, error = {name: k for k, name in enumerate(table["id"])}, np.zeros((len(table), 3))
    for t, (label, _) in enumerate(data.result.tables):
        of_table = rows.filter(rows["table"] == label) if "table" in rows.columns else rows
        frame = data.result.frames.get(f"X({t})")
        world_R_base = np.eye(3) if frame is None else Rotation.from_quat(frame.quaternion_xyzw).as_matrix()
        for axis, along in zip("xyz", world_R_base, strict=True):
            some = of_table.filter(of_table["kind"] == f"position.{axis}")
            error[[place[name] for name in some["a"]]] -= np.outer(some["residual"], along)
    error[table["rms_position"].is_null()] = np.nan
    arm = data.robot.geometry
    return error, robot.forward(robot.build_chain(arm).with_joint_columns(), arm.trig(data.readings)).jacobian[:, 3:]


def joint_errors(data: ReportData) -> Floats | None:
    """Errors of joints, measured minus predicted, each as if it alone made those of the tool's position.

    Shape (n, n_joints), [rad] (prismatic: [m]), nan where there are none; None where no positions were measured.
    """
    if (errors := tool_errors(data)) is None:
        return None
    lever = np.sum(errors[1] ** 2, axis=1)
    return np.einsum("ni,nij->nj", *errors) / np.where(lever > 0.0, lever, np.nan)  # on its axis a joint moves nothing


def correlation_matrix(data: ReportData) -> list[Chart]:
    """Correlations of the errors of parameters; none of fewer than two."""
    names, C = data.result.covariance.names, data.result.covariance.matrix
    variance = C.reshape(len(names), len(names)).diagonal()
    known = np.flatnonzero(np.isfinite(variance) & (variance > 0.0))
    if len(known) < 2:
        return []
    sigma = np.sqrt(variance[known])
    rho = np.tril(C[np.ix_(known, known)] / np.outer(sigma, sigma), -1)
    chosen = np.sort(np.argsort(-np.max(np.abs(np.nan_to_num(rho + rho.T)), axis=1), kind="stable")[:MAX_PARAMETERS])
    more = "" if len(chosen) == len(known) else f"; the {len(chosen)} most correlated of {len(known)}"
    labels, rho = [names[known[k]] for k in chosen], rho[np.ix_(chosen, chosen)]
    plot = Plot(labels, labels, ("", ""))
    for (i, j), value in np.ndenumerate(rho):
        if abs(value) > 0.02:
            about = f"{labels[i]}, {labels[j]}: {value:+.2f}" if abs(value) > 0.5 else ""
            sides = (j - 0.46, j + 0.46), (i - 0.46, i + 0.46)
            plot.box(*sides, about, class_="plus" if value > 0.0 else "minus", opacity=f"{min(1.0, abs(value)):.2f}")
    return [plot.chart(f"Correlations of the errors: orange positive, blue negative{more}")]


def residual_charts(data: ReportData) -> list[Chart]:
    """Studentised residuals: their distribution by kind, and row by row."""
    if data.residuals is None:
        return []
    rows = data.residuals.filter(data.residuals["excluded"].is_null()).with_row_index("number")
    values, test = rows["studentised"].cast(float).fill_null(np.nan).to_numpy(), (rows["split"] == "test").to_numpy()
    found, kinds = [], np.array([kind.partition(".")[0] for kind in rows["kind"].to_list()])
    for kind in dict.fromkeys(kinds.tolist()):
        of_kind = (kinds == kind) & np.isfinite(values)
        fitted = of_kind & ~test  # rows that were held out share the errors of the estimate
        chosen, which = (fitted, "fitted") if fitted.any() else (of_kind, "held-out")
        if chosen.any():
            beyond = int(np.sum(np.abs(values[chosen]) > MAX_SIGMA))
            more = f"; {beyond} beyond {MAX_SIGMA:g} are in the columns at the ends" if beyond else ""
            caption = f"{kind}: {int(chosen.sum())} {which} rows, and the normal distribution{more}"
            found.append(_histogram(values[chosen], caption))
    return [*found, _row_by_row(rows, values, test)] if found else []


def _row_by_row(rows: "pl.DataFrame", values: Floats, test: Booleans) -> Chart:
    shown, order = np.clip(values, -MAX_STUDENTISED, MAX_STUDENTISED), np.arange(len(values), dtype=np.float64)
    plot = Plot((0.0, max(len(shown), 2)), limits_of(shown, [-4.0, 4.0]), ("row", "in its sigma"))
    for level in (-3.0, 3.0):
        plot.line((plot.x.low, plot.x.high), level, "level")
    plot.dots(order[~test], shown[~test], "a")
    plot.dots(order[test], shown[test], "b")
    suspects = rows.filter(rows["suspect"]).sort(rows.filter(rows["suspect"])["studentised"].abs(), descending=True)
    for row in suspects.head(4 * WORST).iter_rows(named=True):
        name = " ".join(str(row[key]) for key in ("kind", "a", "b", "of") if row.get(key))
        plot.ring(row["number"], shown[row["number"]], f"{name}: {row['studentised']:+.1f}")
    rings = ", rings suspicious" if len(suspects) else ""
    cut = f"; larger ones are drawn at {MAX_STUDENTISED:g}" if np.any(np.abs(values) > MAX_STUDENTISED) else ""
    return plot.chart(f"Residuals row by row: {_colours(test)}{rings}{cut}")


def _histogram(values: Floats, caption: str) -> Chart:
    """The distribution of residuals; the columns at the ends hold those beyond `MAX_SIGMA` too."""
    edges = np.linspace(-MAX_SIGMA, MAX_SIGMA, 41)
    density = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0] / (len(values) * np.diff(edges))
    limits = limits_of(density, [0.45], with_zero=True)
    plot = Plot((float(edges[0]), float(edges[-1])), limits, ("residual, in its sigma", "share per sigma"))
    for k in np.flatnonzero(density).tolist():
        plot.box((edges[k], edges[k + 1]), (0.0, density[k]), class_="column")
    x = np.linspace(-MAX_SIGMA, MAX_SIGMA, 81)
    plot.curve(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi))
    return plot.chart(caption)


def error_slices(position: Floats, error: Floats, measured: Floats) -> list[Chart]:
    """Expected error of the tool in three slices through the middle of the measured configurations.

    Args:
        position: Tool positions, shape (n, 3), [m].
        error: Expected error of each, shape (n,), [m]; nan where it is unknown.
        measured: Measured tool positions, shape (m, 3), [m].
    """
    if np.isnan(error).all():
        return []
    middle, low, high = np.median(measured, axis=0), position.min(axis=0), position.max(axis=0)
    width = max(float((high - low).max()), 1e-3)  # [m]
    half = SLAB * width / 2.0
    low, high = (0.5 * (low + high) + sign * 0.52 * width for sign in (-1.0, 1.0))  # all axes on one scale
    first, last = np.nanquantile(error, [0.05, 0.95]) * 1e3
    edges = np.linspace(first, max(last, first + 1e-9), len(charts.RAMP) + 1)
    found = []
    for across, up, through in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        inside, near = (np.abs(p[:, through] - middle[through]) < half for p in (position, measured))
        names = f"{'xyz'[across]} [m]", f"{'xyz'[up]} [m]"
        square = charts.WIDTH - charts.LEFT - charts.RIGHT + charts.TOP + charts.BOTTOM
        plot = Plot((low[across], high[across]), (low[up], high[up]), names, height=square)
        _draw_cells(plot, position[inside][:, [across, up]], error[inside] * 1e3, edges)
        for kind in ("halo", "measured"):
            plot.dots(measured[near, across], measured[near, up], kind)
        where = f"{'xyz'[through]} = {middle[through]:.3g} m, within {half:.2g} m"
        found.append(plot.chart(f"Expected error at {where}; dots: measured"))
    legend = Plot((edges[0], edges[-1]), [""], ("[mm]", ""))
    for colour, ends in zip(charts.RAMP, pairwise(edges.tolist()), strict=True):
        legend.box(ends, (-0.5, 0.5), fill=colour)
    return [*found, legend.chart("Colours of the expected error of the tool's position (RMS)")]


def _draw_cells(plot: Plot, at: Floats, error: Floats, edges: Floats) -> None:
    """A coloured cell at each place that configurations reach, by the RMS of their errors."""
    at, error = at[np.isfinite(error)], error[np.isfinite(error)]
    x, y = (np.linspace(s.low, s.high, CELLS + 1) for s in (plot.x, plot.y))
    n, squares = (np.histogram2d(at[:, 0], at[:, 1], [x, y], weights=w)[0] for w in (np.ones(len(at)), error**2))
    for i, j in np.argwhere(n > 0).tolist():
        colour = charts.RAMP[int(np.searchsorted(edges[1:-1], np.sqrt(squares[i, j] / n[i, j])))]
        plot.box((x[i], x[i + 1]), (y[j], y[j + 1]), fill=colour)


def arm_scene(data: ReportData) -> Mapping[str, Any] | None:
    """Data of `arm.js`: the measured configurations with the arm's shape and residual; None where unknown.

    Of more than 300 configurations these are as many that are evenly spaced, and the worst.
    """
    if data.rms is None or data.configurations is None:
        return None
    kind, rms = data.rms
    evenly = np.linspace(0, len(rms) - 1, min(300, len(rms))).astype(np.int64)
    chosen = np.unique(np.concatenate([evenly, np.argsort(-np.nan_to_num(rms))[:20]]))
    low, high = np.nanquantile(charts.without_outliers(rms), [0.0, 1.0]).tolist()
    items = [
        {
            "id": data.configurations["id"][k],
            "test": bool(data.held_out[k]),
            "value": float(f"{rms[k]:.4g}") if np.isfinite(rms[k]) else None,
            "links": np.round(points, 4).tolist(),
        }
        for k, points in zip(chosen.tolist(), simulation.link_points(data.robot, data.readings[chosen]), strict=True)
    ]
    return {"unit": shown_in(data.result.unit_of(kind)).unit, "family": kind, "low": low, "high": high, "items": items}
