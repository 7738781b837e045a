"""Random configurations that could be measured like the rows of a table, and what such rows would say.

They are predicted by the calibrated arm, with the table's targets, anchors, planes, boards and frame where the rows
there are have them. What an instrument cannot measure is left out: lengths to anchors and from planes, and places in
an image, must be as those of the rows there are. Nobody touches anything at random configurations: of touched points,
contacts with anchors and faces there are none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.graph.build import places_of
from fg_calib.graph.knowledge import coordinates_of
from fg_calib.graph.problem import Problem, problem_at, variables_of
from fg_calib.graph.variables import Variable, pose_of
from fg_calib.measurements.build import build_dataset
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import Table
from fg_calib.monitoring.new_data import Linear, linearised
from fg_calib.observability.random_configurations import at_configurations
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Pairing
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import build_chain, forward

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

N_CANDIDATES = 200
"""Configurations to choose from."""

LEAST_CANDIDATES = 20
"""Fewer are no choice."""

_N_DRAWN = 20_000
"""Random configurations of which those are taken that an instrument can measure."""

_BEYOND = 0.1
"""Part of the range of lengths, or of the image, that was measured, by which a candidate may be beyond it."""

_MOST_CORNERS = 12
"""Points of a board that an image of a candidate shows."""


@dataclass(frozen=True)
class Candidates(FrozenArrays):
    """Configurations that could be measured, and the whitened rows they would give.

    Attributes:
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        columns: Derivatives in the columns of the problem of the rows there are, shape (n, h, n_columns + n_nuisance).
        joints: Derivatives in the joints' zeros, shape (n, h, n_joints).
    """

    readings: Floats
    columns: Floats
    joints: Floats


def candidates(rows: Linear) -> Candidates | None:
    """Candidates for the first table that there are any for; None without any.

    Args:
        rows: The rows there are.
    """
    for number, table in enumerate(rows.placed.problem.data.tables):
        m = table.measurements
        if table.model is None or (m.groups is not None and m.position is None):
            continue
        drawn = _drawn(rows.placed.problem, number)
        if len(drawn[0]) >= LEAST_CANDIDATES:
            return _linearised(rows, number, *drawn)
    return None


def _drawn(problem: Problem, number: int) -> tuple[Floats, Table]:
    """Configurations that can be measured like the rows of a table, and a table of what they would measure."""
    table, robot = problem.data.tables[number], problem.robot
    n = N_CANDIDATES if table.model in (*POSE_MODELS, *PAIR_MODELS) else _N_DRAWN
    q = random_readings(robot, n, np.random.default_rng(0))
    if table.model == "pixels":
        return _images(problem, number, q)
    made = at_configurations(robot, table, q, places_of(problem, problem.start), table.measurements.source)
    seen = np.flatnonzero(_measurable(table, made.measurements))[:N_CANDIDATES]
    m = _with_noise(table.measurements, made.measurements.select(seen))
    if table.model in PAIR_MODELS and table.measurements.pairs is not None:
        m = _paired(table.measurements, m)
    return q[seen], replace(made, pairing=Pairing("star"), measurements=m)


def _measurable(table: Table, m: Measurements) -> Booleans:
    """Which of predicted measurements are like those of a table."""
    there, n = table.measurements, len(m.readings)
    if m.length is not None:  # of contacts with faces no length is stated
        return np.zeros(n, dtype=np.bool_) if there.length is None else _within(there.length, m.length)
    if table.model == "board" and there.position is not None and m.position is not None:
        far, seen = (np.linalg.norm(p, axis=1) for p in (there.position, m.position))
        ahead = m.position[:, 2] / np.maximum(seen, 1e-12) >= np.nanmin(there.position[:, 2] / np.maximum(far, 1e-12))
        found: Booleans = _within(far, seen) & ahead
        return found
    return np.ones(n, dtype=np.bool_)


def _within(measured: Floats, predicted: Floats) -> Booleans:
    """Whether figures are within the range of those measured, or little beyond; contacts have none."""
    low, high = np.nanmin(measured), np.nanmax(measured)
    slack = _BEYOND * (high - low)
    found: Booleans = np.asarray((predicted >= low - slack) & (predicted <= high + slack) & (high > low))
    return found


def _with_noise(there: Measurements, m: Measurements) -> Measurements:
    """Predicted measurements with the noise of those there are, RMS."""
    noise = {}
    for name in ("sigma_position", "sigma_orientation", "sigma_length"):
        stated, shape = getattr(there, name), getattr(m, name)
        if stated is not None and shape is not None:
            noise[name] = np.full_like(shape, np.sqrt(np.nanmean(stated**2)))
    if there.covariance is not None:
        noise["covariance"] = np.tile(there.covariance.mean(axis=0), (len(m.readings), 1, 1))
    return replace(m, sigma_joint=there.sigma_joint, **noise)


def _paired(there: Measurements, m: Measurements) -> Measurements:
    """Each configuration as a pair with the first one, with the noise of a table's pairs, RMS."""
    assert there.pairs is not None
    n = len(m.readings)
    figures = {}
    for name in ("distance", "angle"):
        sigma = getattr(there.pairs, f"sigma_{name}")[np.isfinite(getattr(there.pairs, name))]
        figures[f"sigma_{name}"] = np.full(n - 1, np.sqrt(np.mean(sigma**2)) if len(sigma) else np.nan)
    assert m.position is not None
    assert m.rotation is not None
    between = np.linalg.norm(m.position[1:] - m.position[0], axis=1)
    cosine = 0.5 * (np.einsum("nij,ij->n", m.rotation[1:], m.rotation[0]) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    pairs = {"a": np.zeros(n - 1, dtype=np.int64), "b": np.arange(1, n)}
    known = {name: np.isfinite(figures[f"sigma_{name}"]).any() for name in ("distance", "angle")}
    measured = {"distance": between, "angle": angle}
    pairs |= {name: figure for name, figure in measured.items() if known[name]}
    pairs |= {name: sigma for name, sigma in figures.items() if np.isfinite(sigma).any()}
    return Measurements.from_arrays(m.readings, pairs=pairs, sigma_joint=m.sigma_joint, source=m.source)


def _images(problem: Problem, number: int, q: Floats) -> tuple[Floats, Table]:
    """Configurations in which all corners of the first board are seen, and their images."""
    table = problem.data.tables[number]
    there, camera = table.measurements, table.camera
    assert camera is not None
    assert there.image is not None
    assert there.sigma_pixel is not None
    R, t = _seen_board(problem, number, q)
    corners = np.unique(there.image[:, 2:], axis=0)
    corners = corners[np.unique(np.linspace(0, len(corners) - 1, min(_MOST_CORNERS, len(corners))).astype(int))]
    points = t[:, None] + np.einsum("nij,cj->nci", R[:, :, :2], corners)  # (n, corners, 3)
    seen = camera.image(points.reshape(-1, 3))[0].reshape(len(q), -1, 2)
    facing = np.abs(np.einsum("ni,ni->n", R[:, :, 2], t)) > 0.2 * np.linalg.norm(t, axis=1)
    inside = _within(there.image[:, 0], seen[:, :, 0]) & _within(there.image[:, 1], seen[:, :, 1])
    chosen = np.flatnonzero(inside.all(axis=1) & (points[:, :, 2] > 0.0).all(axis=1) & facing)[:N_CANDIDATES]
    k = np.repeat(chosen, len(corners))
    label = there.labels.get("board")
    board = {} if label is None else {"board": [label.names[0]] * len(k)}
    m = Measurements.from_arrays(
        q[k],
        pixel=seen[chosen].reshape(-1, 2),
        corner=np.tile(corners, (len(chosen), 1)),
        sigma_pixel=float(np.sqrt(np.nanmean(there.sigma_pixel**2))),
        ids=[str(i) for i in k.tolist()],
        source=there.source,
        **board,
    )
    return q[chosen], replace(table, measurements=m)


def _seen_board(problem: Problem, number: int, q: Floats) -> tuple[Floats, Floats]:
    """Where a camera sees its first board from configurations, shapes (n, 3, 3) and (n, 3)."""
    table, robot = problem.data.tables[number], problem.robot
    if table.fixed_camera:
        poses = forward(build_chain(robot), robot.trig(q))
        frame = next((v for v in problem.variables.frames if v.symbol == f"X({number})"), None)
        X = pose_of(np.zeros(6) if frame is None else problem.start[frame.places])
        turn, shift = X.rotation().matrix(), X.translation()
        return turn @ poses.rotation, poses.position @ turn.T + shift
    seen = at_configurations(robot, table, q, places_of(problem, problem.start), "boards").measurements
    assert seen.rotation is not None
    assert seen.position is not None
    return seen.rotation, seen.position


def _linearised(rows: Linear, number: int, q: Floats, table: Table) -> Candidates:
    """What rows of candidates would say, by the columns of the rows there are."""
    whole = rows.placed.problem
    alone = _alone(whole, number, table)
    J, joints, _ = linearised(alone)
    wide = np.zeros((len(J), whole.variables.n_columns + whole.variables.n_nuisance))
    wide[:, _columns(whole, number, alone)] = J
    of = _candidate_of_rows(alone)
    counts = np.bincount(of[of >= 0], minlength=len(q))
    kept, h = np.flatnonzero(counts == counts.max()), int(counts.max())
    order = np.concatenate([np.flatnonzero(of == k) for k in kept])
    return Candidates(q[kept], wide[order].reshape(len(kept), h, -1), joints[order].reshape(len(kept), h, -1))


def _alone(whole: Problem, number: int, table: Table) -> Problem:
    """The problem of a table of candidates, everything where the rows there are have it; each error is a row's own."""
    robot, start = whole.robot, whole.start
    options = replace(whole.options, encoder="propagated", pair_errors="independent", loss="none")
    data = build_dataset(robot, [table])
    v = variables_of(robot, data, options)
    x = v.nominal()
    x[v.robot_span] = start[whole.variables.robot_span]
    for frame in v.frames:
        x[frame.places] = start[_frame(whole, number).places]
    for name in data.unknowns.keys:
        there, here = (coordinates_of(p, d.unknowns, name) for p, d in ((whole.variables, whole.data), (v, data)))
        if there is not None and here is not None:
            x[here] = start[there]
    return problem_at(robot, data, options, v, x)


def _frame(problem: Problem, number: int) -> Variable:
    """The measurement frame of a table."""
    return next(v for v in problem.variables.frames if v.symbol == f"X({number})")


def _columns(whole: Problem, number: int, alone: Problem) -> Integers:
    """Which columns of the rows there are those of a table of candidates are."""
    v, w = alone.variables, whole.variables
    found = np.zeros(v.n_columns + v.n_nuisance, dtype=np.int64)
    found[: v.n_robot_columns] = np.arange(v.n_robot_columns)
    for frame in v.frames:
        found[frame.columns] = np.arange(w.n_columns)[_frame(whole, number).columns]
    for name in alone.data.unknowns.keys:
        there, here = (coordinates_of(p.variables, p.data.unknowns, name) for p in (whole, alone))
        if there is not None and here is not None:
            found[here - v.nuisance_span.start + v.n_columns] = there - w.nuisance_span.start + w.n_columns
    return found


def _candidate_of_rows(problem: Problem) -> Integers:
    """Which configuration each whitened row is of, shape (n_rows,); of a pair the one that is not the first."""
    found = []
    for row_set in problem.rows:
        for part in row_set.parts:
            ends = problem.data.places[part.table][part.block.ends]
            found.append(np.repeat(ends.max(axis=1), part.block.residual_dim))
    return np.concatenate(found)
