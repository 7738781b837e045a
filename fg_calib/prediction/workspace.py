"""How far off the tool is expected to be all over the workspace, and where nothing was measured.

Configurations are drawn evenly within the joint limits. The expected error at each is that of `tool_error`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fg_calib.arrays import FrozenArrays
from fg_calib.prediction.tool_pose import ToolErrorModel, ToolErrors
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Joint, Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

N_DRAWN = 12_000
"""Configurations that are drawn."""

FAR = 0.15
"""Distance from the nearest measured position, in the radius of the workspace, beyond which nothing was measured."""

LEAST_WIDTH = 1e-3
"""Width that pictures of a workspace have at least, [m]: a tool on its arm's only axis stays where it is."""


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
        errors: At configurations that were drawn.
        radius: From the mean of the drawn positions to the farthest, [m].
        measured: Where the tool was measured, shape (m, 3), [m].
        fitted: Whether errors count after the best rigid fit, instead of in the base frame.
        joints: Joint by joint.
    """

    errors: ToolErrors
    radius: float
    measured: Floats
    fitted: bool
    joints: tuple[JointRange, ...]

    @property
    def position(self) -> Floats:
        """Where the tool is at configurations that were drawn, shape (n, 3), [m], from the base."""
        return self.errors.position

    @property
    def error(self) -> Floats:
        """RMS position error expected of each, shape (n,), [m]; nan where it depends on what is not determined."""
        return self.errors.of(self.fitted)[:, 0]

    @property
    def far(self) -> Booleans:
        """Whether no measured position is near the drawn ones, shape (n,)."""
        return self.far_from_measured(self.position)

    def far_from_measured(self, points: Floats) -> Booleans:
        """Whether no measured position is near points, shape (n, 3): shape (n,)."""
        return np.asarray(cKDTree(self.measured).query(points)[0] > FAR * self.radius)


def survey(robot: Robot, model: ToolErrorModel, readings: Floats, *, fitted: bool, n: int = N_DRAWN) -> Workspace:
    """Expected errors over the workspace, and where nothing was measured.

    A joint that turns without limits is taken to turn by +-180 degrees, one that slides without them between its lowest
    and its highest reading.

    Args:
        robot: The calibrated robot, with its limits.
        model: What is expected of its tool.
        readings: Of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        fitted: Whether errors count after the best rigid fit.
        n: Number of configurations that are drawn.
    """
    errors = model.at(random_readings(_bounded(robot, readings), n, np.random.default_rng(0)))
    radius = float(np.max(np.linalg.norm(errors.position - errors.position.mean(axis=0), axis=1), initial=0.0))
    joints = tuple(_range(joint, readings[:, i]) for i, joint in enumerate(robot.joints))
    return Workspace(errors, radius, pose(robot, readings).position, fitted, joints)


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
