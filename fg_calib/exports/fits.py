"""The nearest that an arm of fewer figures comes to a calibrated one: tool poses fitted over configurations.

What is minimised is the sum over configurations of

    |p - p'|^2 + L^2 |log(R R'^T)|^2

with p and R of the arm that is fitted, p' and R' of the calibrated one, and L the arm's length: an angle counts as what
it moves at the end of the arm. Both are fitted at some configurations and judged at others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import Poses, build_chain, forward, pose
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]

N_FITTED, N_JUDGED = 300, 1000
"""Configurations drawn within the joint limits to fit, and others to judge by."""

HOLD = 1e-2
"""What a change of a figure by 1 m or 1 rad counts beside a miss of the tool by 1 m: a fit that gains hundredths of a
millimetre by figures of metres is none. Of a UR10 off by 0.5 mm and 0.5 mrad, 1e-3 to 1e-1 give the same fit, 0.168 mm
RMS; 1e-4 gives 0.163 mm with d of 16 m."""


@dataclass(frozen=True)
class PoseErrors:
    """How far the tool of one arm is from that of another over some configurations.

    Attributes:
        position_rms: Of the tool point, [m].
        position_max: The largest, [m].
        rotation_rms: Of the angle that the tool is turned, [rad].
        rotation_max: The largest, [rad].
        n: Number of configurations.
    """

    position_rms: float
    position_max: float
    rotation_rms: float
    rotation_max: float
    n: int


def drawn(robot: Robot, n: int, seed: int) -> Floats:
    """Configurations within the joint limits, shape (n, n_joints), [rad] (prismatic: [m])."""
    return random_readings(robot, n, np.random.default_rng(seed))


def errors(found: Robot, wanted: Robot, readings: Floats, zeros: Floats | None = None) -> PoseErrors:
    """How far an arm is from another at joint readings.

    Args:
        found: The one.
        wanted: The other.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        zeros: What is added to the readings of the first, shape (n_joints,).
    """
    miss = _miss(poses(found, readings if zeros is None else readings + zeros), poses(wanted, readings))
    turn, shift = (np.linalg.norm(part, axis=1) for part in (miss[:, :3], miss[:, 3:]))
    rms = [float(np.sqrt(np.mean(part**2))) for part in (shift, turn)]
    return PoseErrors(rms[0], float(shift.max()), rms[1], float(turn.max()), len(readings))


def poses(robot: Robot, readings: Floats) -> Poses:
    """Tool poses without derivatives."""
    return forward(build_chain(robot), robot.trig(readings))


def fit_zeros(nominal: Robot, calibrated: Robot, readings: Floats) -> Floats:
    """What is to be added to joint readings so that the nominal arm comes nearest to the calibrated one.

    Where zeros act alike, such as those of two slides along one line, the least of them are taken.

    Args:
        nominal: The arm whose zeros are fitted.
        calibrated: Where the tool truly is.
        readings: To fit at, shape (n, n_joints), [rad] (prismatic: [m]).

    Returns:
        Shape (n_joints,), [rad] (prismatic: [m]).
    """
    at = poses(calibrated, readings)
    joints = slice(len(nominal.parameters), None)
    return _least_squares(
        lambda zeros: pose(nominal, readings + zeros), joints, np.zeros(nominal.n_joints), at, calibrated.reach, 0.0
    )


def fit_parameters(start: Robot, calibrated: Robot, readings: Floats) -> Robot:
    """The robot of one convention that comes nearest to a calibrated one, base and tool included.

    Args:
        start: A robot of the convention, near it.
        calibrated: Where the tool truly is.
        readings: To fit at, shape (n, n_joints), [rad] (prismatic: [m]).
    """
    at = poses(calibrated, readings)
    columns = slice(0, len(start.parameters))
    values = _least_squares(
        lambda x: pose(start.with_values(x), readings), columns, start.nominal, at, calibrated.reach, HOLD
    )
    return start.with_values(values)


def _least_squares(
    predict: Callable[[Floats], Poses], columns: slice, start: Floats, at: Poses, length: float, hold: float
) -> Floats:
    """The values that bring predicted poses nearest to given ones."""
    from scipy.optimize import least_squares

    weight = np.array([length] * 3 + [1.0] * 3)
    held = hold * np.eye(len(start))

    def residual(x: Floats) -> Floats:
        return np.concatenate([(weight * _miss(predict(x), at)).ravel(), held @ (x - start)])

    def jacobian(x: Floats) -> Floats:
        found = predict(x)
        J = found.jacobian[:, :, columns].copy()
        J[:, :3] = log_derivative(_miss(found, at)[:, :3]) @ J[:, :3]
        return np.vstack([(weight[:, None] * J).reshape(-1, len(start)), held])

    found = least_squares(residual, start, jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200)
    values: Floats = found.x
    return values


def _miss(found: Poses, wanted: Poses) -> Floats:
    """Rotation vectors of R R'^T, then p - p', shape (n, 6), [rad] and [m]."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(found.rotation @ np.swapaxes(wanted.rotation, 1, 2)).as_rotvec()
    return np.concatenate([turn, found.position - wanted.position], axis=1)


def log_derivative(v: Floats) -> Floats:
    """Derivative of the rotation vector v in a small turn from the left, shape (n, 3, 3).

    1 - [v]/2 + [v]^2 (1/t^2 - (1 + cos t)/(2 t sin t)), t = |v| (Chirikjian 2012, Stochastic Models, eq. 10.86).
    """
    angle = np.linalg.norm(v, axis=1)
    large = angle > 1e-3
    t = np.where(large, angle, 1.0)
    factor = np.where(large, 1.0 / t**2 - (1.0 + np.cos(t)) / (2.0 * t * np.sin(t)), 1.0 / 12.0 + angle**2 / 720.0)
    turning = np.swapaxes(np.cross(np.eye(3), v[:, None, :]), 1, 2)  # -[v]: column k is e_k x v
    derivative: Floats = np.eye(3) + 0.5 * turning + factor[:, None, None] * (turning @ turning)
    return derivative


def with_frames_of(robot: Robot, other: Robot, owners: tuple[int, ...]) -> Robot:
    """A robot with the parameters of another that belong to some owners (0: base, n + 1: tool)."""
    values = {p.name: p.nominal for p in other.parameters if p.owner in owners}
    return replace(robot, parameters=tuple(replace(p, nominal=values.get(p.name, p.nominal)) for p in robot.parameters))
