"""How large residuals are before any calibration, and how large noise and tolerances let them be.

An arm as drawn, its measurement frame and its tool fitted where they are unknown, misses what was measured by

    r = J e + n,    its length on average by the root of tr(J T^2 J^T + N)

with J the derivatives in the arm's estimated parameters, T their tolerances (`USUAL_LENGTH` and `USUAL_ANGLE` where
there are none) and N the covariance of the noise, that of the joint readings with it. The *excess* is the median length
over the median of what is expected: medians are not moved by a few gross errors.

Some rows suffice, and frames and tool are fitted in closed form: a look takes a millisecond, and nothing depends on
whether a calibration gets anywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.setup import Setup
from fg_calib.initialization import hand_eye as frames
from fg_calib.initialization.hand_eye import Frame, Unknown
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot
from fg_calib.robot.rotations import rotation_angle

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

USUAL_LENGTH, USUAL_ANGLE = 2e-3, 5e-3
"""1 sigma of true minus nominal where a parameter has no tolerance: 2 mm and 5 mrad (0.3 degrees)."""

_STEPS = (1, 7, 19)
"""Pairs are formed with the rows that follow at these distances, round the end."""


@dataclass(frozen=True)
class TypicalResidual:
    """Residuals of one kind of measurement before a calibration.

    Attributes:
        kind: `position`, `orientation`, `distance`, `angle`, `point` or `pixel`.
        unit: `m`, `rad` or `px`.
        size: Median of their lengths, [m] or [rad].
        expected: What noise and tolerances make of it.
        motion: How far the arm moves between these rows, [m] or [rad]: readings that hardly move it show nothing.
        n: Number of measurements.
    """

    kind: str
    unit: Literal["m", "rad", "px"]
    size: float
    expected: float
    motion: float
    n: int

    @property
    def excess(self) -> float:
        """Size over what is expected."""
        return self.size / self.expected


def fitted_residuals(setup: Setup) -> tuple[TypicalResidual, ...]:
    """Typical residuals by kind, frame and tool fitted; empty if there are too few rows for that."""
    return _typical_residuals(setup, None)


def residuals_at(setup: Setup, robot: Robot, world_T_base: Frame) -> tuple[TypicalResidual, ...]:
    """Typical residuals by kind at a robot and frame that were fitted elsewhere."""
    held = replace(setup, robot=robot, tool_rotation=False, tool_translation=np.zeros(3, dtype=np.bool_))
    return _typical_residuals(held, world_T_base)


def residuals_beside(setup: Setup, other: Setup) -> tuple[TypicalResidual, ...]:
    """Typical residuals by kind with tool and base as another table of the job alone says them."""
    flange = _Flange(other.robot, other.measurements)
    X, T = _frames_of(other, flange)
    robot = setup.robot
    values, tool = robot.nominal, robot.owned_by(robot.n_joints + 1)
    if tool:
        yaw, pitch, roll = Rotation.from_matrix(T.rotation).as_euler("ZYX")
        values[tool] = [*T.translation, yaw, pitch, roll]
    held = replace(setup, robot=robot.with_values(values), tool_rotation=False, tool_translation=np.zeros(3, np.bool_))
    of_base = setup.of_base and other.of_base and other.model in POSE_MODELS
    return _typical_residuals(held, X if of_base else None)


def _frames_of(setup: Setup, flange: _Flange) -> tuple[Frame, Frame]:
    """World_T_base and flange_T_tool that a table alone says."""
    m, free = setup.measurements, setup.tool_translation
    X, T = Frame(np.eye(3), np.zeros(3)), flange.tool
    if setup.model in POSE_MODELS:
        with_orientation, with_position = POSE_MODELS[setup.model]
        measured = (m.rotation if with_orientation else None, m.position if with_position else None)
        unknown = Unknown(setup.frame, setup.tool_rotation, free)
        return frames.start_from_poses((flange.rotation, flange.position), measured, (X, T), unknown)
    return X, Frame(T.rotation, _tool_point(setup, flange))


def _typical_residuals(setup: Setup, world_T_base: Frame | None) -> tuple[TypicalResidual, ...]:
    flange = _Flange(setup.robot, setup.measurements)
    if setup.model in POSE_MODELS:
        found = list(_pose_residuals(setup, flange, world_T_base))
    else:
        found = list(_pair_residuals(setup, flange))
    n_rows = sum(r.n * (1 if r.kind in ("distance", "angle") else 3) for r in found)
    if n_rows < 2 * setup.n_free + 6 or not all(np.isfinite([r.size, r.expected]).all() for r in found):
        return ()
    return tuple(found)


class _Flange:
    """The flange of the nominal arm at some readings, and how far it may be from there.

    Attributes:
        rotation: base_R_flange, shape (n, 3, 3).
        position: base_p_flange, shape (n, 3), [m].
        tool: The nominal tool frame.
        turns: Turns of the flange by 1 sigma of each parameter and reading, shape (n, 3, m), [rad].
        shifts: Its shifts, [m].
    """

    def __init__(self, robot: Robot, measurements: Measurements) -> None:
        tool = robot.owned_by(robot.n_joints + 1)  # in the order of FRAME_KINDS
        bare = robot.nominal
        x, y, z, yaw, pitch, roll = bare[tool] if tool else np.zeros(6)
        bare[tool] = 0.0
        at = pose(robot.with_values(bare), measurements.readings)
        self.rotation, self.position = at.rotation, at.position
        self.tool = Frame(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), np.array([x, y, z]))
        columns, sizes = [], []
        for i, p in enumerate(robot.parameters):
            if p.estimated and 1 <= p.owner <= robot.n_joints:
                columns.append(i)
                usual = USUAL_LENGTH if p.unit == "m" else USUAL_ANGLE
                sizes.append(p.tolerance if p.tolerance is not None else usual)
        columns += range(len(robot.parameters), len(robot.parameters) + robot.n_joints)
        J = at.jacobian[:, :, columns] * np.concatenate([sizes, measurements.sigma_joint])
        self.turns, self.shifts = J[:, :3], J[:, 3:]

    def tool_point(self, t: Floats) -> tuple[Floats, Floats]:
        """base_p of a point of the flange, shape (n, 3), [m], and its shifts, shape (n, 3, m)."""
        arm = self.rotation @ t
        return self.position + arm, self.shifts + np.cross(self.turns, arm[:, :, None], axis=1)


def _pose_residuals(setup: Setup, flange: _Flange, world_T_base: Frame | None) -> Iterator[TypicalResidual]:
    """Those of measured orientations and positions; frame and tool are fitted unless the frame is given."""
    m, (with_orientation, with_position) = setup.measurements, POSE_MODELS[setup.model]
    R_M = m.rotation if with_orientation else None
    p_M = m.position if with_position else None
    X, T = _frames_of(setup, flange) if world_T_base is None else (world_T_base, flange.tool)
    if R_M is not None:
        angle, _ = rotation_angle(np.swapaxes(R_M, 1, 2) @ X.rotation @ flange.rotation @ T.rotation)
        yield _typical("orientation", "rad", angle, flange.turns, m.sigma_orientation, _turn(flange.rotation))
    if p_M is not None:
        p, shifts = flange.tool_point(T.translation)
        off = p @ X.rotation.T + X.translation - p_M
        yield _typical("position", "m", np.linalg.norm(off, axis=1), shifts, m.sigma_position, _travel(p))


def _pair_residuals(setup: Setup, flange: _Flange) -> Iterator[TypicalResidual]:
    """Those of distances and angles between configurations, and of touched points."""
    m, (with_distance, with_angle) = setup.measurements, PAIR_MODELS[setup.model]
    pairs, t = _pairs_of(m), _tool_point(setup, flange)
    distances, angles = pairs.select(np.isfinite(pairs.distance)), pairs.select(np.isfinite(pairs.angle))
    if with_distance and distances.n_pairs:
        yield _distance_residual(distances, flange, t)
    if with_angle and angles.n_pairs:
        yield _angle_residual(angles, flange)
    if _touched(m) is not None and with_distance:
        yield from _touch_residuals(m, flange, t)


def _tool_point(setup: Setup, flange: _Flange) -> Floats:
    """The tool point that distances say, or touches where there are none, shape (3,), [m]."""
    m, free, pairs = setup.measurements, setup.tool_translation, _pairs_of(setup.measurements)
    distances, touched = pairs.select(np.isfinite(pairs.distance)), _touched(m)
    if PAIR_MODELS[setup.model][0] and distances.n_pairs:
        ends = (distances.a, distances.b, distances.distance)
        return frames.start_from_distances((flange.rotation, flange.position), *ends, flange.tool, free).translation
    return flange.tool.translation if touched is None else _touching_tool_point(flange, touched, free)


def _pairs_of(m: Measurements) -> Pairs:
    """The pairs measured, or some of poses."""
    return m.pairs if m.pairs is not None else _form_pairs(m)


def _touched(m: Measurements) -> Integers | None:
    """Which point each configuration touched; None where none touched any."""
    return None if m.groups is None or not np.any(m.groups.index >= 0) else m.groups.index


def _distance_residual(pairs: Pairs, flange: _Flange, t: Floats) -> TypicalResidual:
    """That of distances that the tool point `t` moves between configurations."""
    p, shifts = flange.tool_point(t)
    step = p[pairs.b] - p[pairs.a]
    length = np.linalg.norm(step, axis=1)
    along = np.einsum("ni,nim->nm", step / np.maximum(length, 1e-12)[:, None], shifts[pairs.b] - shifts[pairs.a])
    sigma = np.nan_to_num(pairs.sigma_distance)
    return _typical("distance", "m", np.abs(length - pairs.distance), along[:, None], sigma[:, None], _travel(p))


def _angle_residual(pairs: Pairs, flange: _Flange) -> TypicalResidual:
    """That of angles that the flange turns between configurations."""
    a, b = pairs.a, pairs.b
    angle, axis = rotation_angle(np.swapaxes(flange.rotation[a], 1, 2) @ flange.rotation[b])
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    along = np.einsum("nj,nij,nim->nm", axis, flange.rotation[a], flange.turns[b] - flange.turns[a])
    sigma = np.nan_to_num(pairs.sigma_angle)
    off = np.abs(angle - pairs.angle)
    return _typical("angle", "rad", off, along[:, None], sigma[:, None], _turn(flange.rotation))


def _form_pairs(m: Measurements) -> Pairs:
    """Pairs of measured poses, short motions and long ones; nan where positions or orientations were not measured."""
    n = m.n_configurations
    steps = np.array([step for step in _STEPS if step < n], dtype=np.int64)
    a = np.tile(np.arange(n), len(steps))
    b = (a + np.repeat(steps, n)) % n
    nothing = np.full(len(a), np.nan)

    def sigma(of_rows: Floats | None) -> Floats:
        return nothing if of_rows is None else np.sqrt(np.mean(of_rows[a] ** 2 + of_rows[b] ** 2, axis=1))

    distance = nothing if m.position is None else np.linalg.norm(m.position[b] - m.position[a], axis=1)
    angle = nothing if m.rotation is None else rotation_angle(np.swapaxes(m.rotation[a], 1, 2) @ m.rotation[b])[0]
    train = np.zeros(len(a), dtype=np.bool_)
    return Pairs(a, b, distance, angle, sigma(m.sigma_position), sigma(m.sigma_orientation), train)


def _touching_tool_point(flange: _Flange, index: Integers, free: Booleans) -> Floats:
    """The tool point that brings the points of each group nearest together, shape (3,), [m]."""
    t = flange.tool.translation.copy()
    p, _ = flange.tool_point(t)
    A, b = (np.concatenate([v[index == g] - v[index == g].mean(axis=0) for g in np.unique(index[index >= 0])])
            for v in (flange.rotation, p))  # fmt: skip
    t[free] -= np.linalg.lstsq(A.reshape(-1, 3)[:, free], b.ravel(), rcond=1e-10)[0]
    return t


def _touch_residuals(m: Measurements, flange: _Flange, t: Floats) -> Iterator[TypicalResidual]:
    """Tool points from the mean of their group, and the distances between these means."""
    assert m.groups is not None
    groups, index = m.groups, m.groups.index
    p, shifts = flange.tool_point(t)
    there = [g for g in range(groups.n_groups) if np.any(index == g)]
    means = {g: (p[index == g].mean(axis=0), shifts[index == g].mean(axis=0)) for g in there}
    rows = np.flatnonzero(index >= 0)
    off = np.array([p[k] - means[int(index[k])][0] for k in rows])
    moved = np.array([shifts[k] - means[int(index[k])][1] for k in rows])
    sigma = np.zeros(len(rows)) if m.sigma_point is None else np.nan_to_num(m.sigma_point[rows])
    on_axes = np.repeat(sigma[:, None], 3, axis=1)
    yield _typical("point", "m", np.linalg.norm(off, axis=1), moved, on_axes, _travel(p))
    pairs = groups.pairs.select(np.isin(groups.pairs.a, there) & np.isin(groups.pairs.b, there) & ~groups.pairs.test)
    if pairs.n_pairs:
        steps = [(means[b][0] - means[a][0], means[b][1] - means[a][1]) for a, b in zip(pairs.a, pairs.b, strict=True)]
        length = np.array([np.linalg.norm(v) for v, _ in steps])
        along = np.array([v @ s / max(float(np.linalg.norm(v)), 1e-12) for v, s in steps])
        sigma = np.nan_to_num(pairs.sigma_distance)
        off_distance = np.abs(length - pairs.distance)
        yield _typical("distance", "m", off_distance, along[:, None], sigma[:, None], _travel(p))


def _travel(p: Floats) -> float:
    """How far points, shape (n, 3), typically are from their mean."""
    return float(np.median(np.linalg.norm(p - p.mean(axis=0), axis=1)))


def _turn(rotation: Floats) -> float:
    """How far rotations, shape (n, 3, 3), typically are from the first, [rad]."""
    return float(np.median(rotation_angle(rotation[0].T @ rotation)[0]))


def _typical(
    kind: str, unit: Literal["m", "rad"], length: Floats, moved: Floats, sigma: Floats | None, motion: float
) -> TypicalResidual:
    """The median of lengths, shape (n,), beside that of what is expected.

    Args:
        kind: Of the measurements.
        unit: Of the lengths.
        length: Of each residual.
        moved: What each parameter's 1 sigma does to it, shape (n, residual_dim, m).
        sigma: Of the noise, shape (n, residual_dim); None for none.
        motion: How far the arm moves.
    """
    variance = np.sum(moved**2, axis=(1, 2)) + (0.0 if sigma is None else np.sum(sigma**2, axis=1))
    expected = max(float(np.median(np.sqrt(variance))), 1e-9)
    return TypicalResidual(kind, unit, float(np.median(length)), expected, motion, len(length))
