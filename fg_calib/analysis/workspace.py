"""How far off the tool is expected to be all over the workspace, and where nothing was measured.

Configurations are drawn evenly within the joint limits. The expected error at each is that of `accuracy`, in the base
frame; *fitted* it is what is left after the one rotation and shift that fit the measured configurations best, and then
hold all over the workspace: the part of the derivatives v at the measured points that rigid motions G can make is G v,
and the same motion is taken away everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fg_calib.analysis.accuracy import without_rigid_motion
from fg_calib.analysis.covariance import TangentCovariance
from fg_calib.arrays import FrozenArrays
from fg_calib.graph.factors import build_variables
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import forward, precompute_trig
from fg_calib.robot.model import Joint, Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

N_DRAWN = 12_000
"""Configurations that are drawn."""

_MOST_MEASURED = 1000
"""Measured configurations that the rigid motion is fitted to; of more, so many that are evenly spaced."""

FAR = 0.15
"""Distance from the nearest measured position, in the radius of the workspace, beyond which nothing was measured."""


@dataclass(frozen=True)
class JointRange(FrozenArrays):
    """Where a joint was read, and where it may be.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        limits: Lower and upper, infinite where it has none.
        range: The lowest and the highest reading.
        gap: The widest interval between its limits, or lowest and highest reading, without a reading.
    """

    name: str
    unit: str
    limits: tuple[float, float]
    range: tuple[float, float]
    gap: tuple[float, float]


@dataclass(frozen=True)
class Workspace(FrozenArrays):
    """Expected errors of the tool over the workspace.

    Attributes:
        position: Where the tool is at configurations that were drawn, shape (n, 3), [m], from the base.
        error: RMS error expected of each, shape (n,), [m]; nan where it depends on what is not determined.
        far: Whether no measured position is near, shape (n,).
        measured: Where the tool was measured, shape (m, 3), [m].
        fitted: Whether errors are after the best rigid fit, instead of in the base frame.
        joints: Joint by joint.
    """

    position: Floats
    error: Floats
    far: Booleans
    measured: Floats
    fitted: bool
    joints: tuple[JointRange, ...]


def survey(robot: Robot, spread: TangentCovariance, readings: Floats, *, fitted: bool, n: int = N_DRAWN) -> Workspace:
    """Expected errors over the workspace, and where nothing was measured.

    A joint that turns without limits is taken to turn by +-180 degrees, one that slides without them between its lowest
    and its highest reading.

    Args:
        robot: The calibrated robot, with its limits.
        spread: The covariance of its parameters.
        readings: Of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        fitted: Whether errors are wanted after the best rigid fit.
        n: Number of configurations that are drawn.
    """
    drawn = random_readings(_bounded(robot, readings), n, np.random.default_rng(0))
    some = readings[np.unique(np.linspace(0, len(readings) - 1, min(_MOST_MEASURED, len(readings))).astype(np.int64))]
    position, v = _shifts(spread, drawn)
    measured, v_measured = _shifts(spread, some)
    if fitted:
        left, turn = without_rigid_motion(measured, v_measured)
        moved = v_measured - left  # a rigid motion of the measured points: turn, and shift of their mean
        centre, shift = measured.mean(axis=0), moved.mean(axis=0)
        v = v - shift - np.cross(turn[None], (position - centre)[:, :, None], axis=1)
    variance = spread.variance(v.reshape(-1, v.shape[2])).reshape(-1, 3).sum(axis=1)
    with np.errstate(invalid="ignore"):
        error = np.sqrt(np.where(variance >= 0.0, variance, np.nan))
    points, _ = _shifts(spread, readings)
    radius = float(np.max(np.linalg.norm(position - position.mean(axis=0), axis=1), initial=0.0))
    far = np.asarray(cKDTree(points).query(position)[0] > FAR * radius)
    joints = tuple(_range(joint, readings[:, i]) for i, joint in enumerate(robot.joints))
    return Workspace(position, error, far, points, fitted, joints)


def _shifts(spread: TangentCovariance, readings: Floats) -> tuple[Floats, Floats]:
    """Tool points from the base, shape (n, 3), and their derivatives in the columns, shape (n, 3, n_columns)."""
    variables = spread.variables
    chain = build_variables(variables.robot, [False]).chains[0].at(spread.parameters)
    at = forward(chain, precompute_trig(variables.robot, readings))
    v = np.zeros((len(readings), 3, variables.n_columns))
    v[:, :, : at.jacobian.shape[2]] = at.jacobian[:, 3:]
    return at.position, v


def _bounded(robot: Robot, readings: Floats) -> Robot:
    """The robot with its readings as the limits of joints that slide without any."""
    ends = zip(robot.joints, readings.min(axis=0).tolist(), readings.max(axis=0).tolist(), strict=True)
    joints = [
        replace(joint, lower=low, upper=high)
        if joint.prismatic and not np.isfinite(joint.upper - joint.lower)
        else joint
        for joint, low, high in ends
    ]
    return replace(robot, joints=tuple(joints))


def _range(joint: Joint, readings: Floats) -> JointRange:
    inside = np.unique(readings)
    ends = [limit for limit in (joint.lower, joint.upper) if np.isfinite(limit)]
    places = np.unique(np.concatenate([inside, ends]))
    widest = int(np.argmax(np.diff(places))) if len(places) > 1 else 0
    gap = (float(places[widest]), float(places[min(widest + 1, len(places) - 1)]))
    return JointRange(joint.name, joint.unit, (joint.lower, joint.upper), (float(inside[0]), float(inside[-1])), gap)
