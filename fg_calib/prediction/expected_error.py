"""How far off the calibrated arm's tool is expected to be, by the covariance of the estimate.

With (w, v) the derivatives of the tool's orientation and position in what was estimated (see `kinematics`) and Cov the
covariance, the mean square of the position error over n configurations is sum tr(v Cov v^T) / n, and that of the
orientation error the same of w. *Base* is in the robot's base frame. *Fitted* is after the rotation and shift that
bring the estimated points nearest to the true ones, to first order: the part of v that the six rigid motions of all
points can make is taken away, and the rotation found with it from w. It is what counts where the arm works relative to
what was seen, and it does not depend on the base, which measurements in an unknown frame say nothing of.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.problem import Problem
from fg_calib.measurements.build import Dataset
from fg_calib.observability.observed_quantities import ObservedQuantities
from fg_calib.robot.kinematics import forward
from fg_calib.statistics.covariance import TangentCovariance

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST = 1000
"""Configurations up to which all are looked at; of more, so many that are evenly spaced."""

_RCOND = 1e-10
"""Singular values of rigid motions below this share of the largest move no point."""


@dataclass(frozen=True)
class PoseRms:
    """Expected RMS errors of the tool; None where they depend on what is not determined.

    Attributes:
        position: [m].
        orientation: [rad].
    """

    position: float | None
    orientation: float | None


@dataclass(frozen=True)
class ExpectedError:
    """Expected errors of the tool over some configurations.

    Attributes:
        base: In the base frame.
        fitted: After the best rigid fit.
        at: Whether at the test configurations, or at the train ones for want of these.
        n: Number of configurations looked at.
        of: Number that there are.
        relative: Whether nothing measured says where the base is, so that `fitted` alone tells of the measurements.
    """

    base: PoseRms
    fitted: PoseRms
    at: Literal["test", "train"]
    n: int
    of: int
    relative: bool = False


def expected_error(problem: Problem, spread: TangentCovariance) -> ExpectedError:
    """Expected errors of the tool at the test configurations; at the train configurations without any.

    Args:
        problem: What was solved.
        spread: The covariance of its solution, what was left out to fix the gauge included.
    """
    data = problem.data
    there, at = judged_configurations(data)
    chosen = there[np.unique(np.linspace(0, len(there) - 1, MOST).round().astype(np.int64))]
    base, fitted = errors_at(spread, data.readings[chosen])
    relative = ObservedQuantities.of(problem).blind_to_base
    return ExpectedError(base, fitted, at, len(chosen), len(there), relative)


def judged_configurations(data: Dataset) -> tuple[Integers, Literal["test", "train"]]:
    """The test configurations of all tables, or the train ones for want of these, and which they are."""
    test = data.held_out
    return np.flatnonzero(test if test.any() else ~test), "test" if test.any() else "train"


def errors_at(spread: TangentCovariance, readings: Floats) -> tuple[PoseRms, PoseRms]:
    """Expected errors of the tool at joint readings, in the base frame and after the best rigid fit.

    Args:
        spread: The covariance at the estimate.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
    """
    variables = spread.variables
    at = forward(variables.chains[0].at(spread.parameters), variables.robot.trig(readings))
    jacobian = at.jacobian.copy()
    jacobian[:, :, variables.n_robot_columns :] = 0.0  # of where the base stands in the world, not of the arm
    return pose_rms(at.position, jacobian, spread.variance)


def pose_rms(points: Floats, jacobian: Floats, variance: Callable[[Floats], Floats]) -> tuple[PoseRms, PoseRms]:
    """Expected errors from derivatives, in the base frame and after the best rigid fit.

    Args:
        points: Tool points, shape (n, 3), [m].
        jacobian: (w, v) of each, shape (n, 6, n_columns).
        variance: Of linear functions of the columns, shape (m, n_columns), nan where not determined: shape (m,).
    """
    w, v = jacobian[:, :3], jacobian[:, 3:]
    v_fitted, turn = without_rigid_motion(points, v)
    w_fitted = w - turn
    rms = [_rms(variance(rows.reshape(-1, rows.shape[2]))) for rows in (v, w, v_fitted, w_fitted)]
    if rms[2] is None:  # points that are not determined fit nothing: orientations by their own best rotation
        rms[3] = _rms(variance((w - w.mean(axis=0)).reshape(-1, w.shape[2])))
    return PoseRms(*rms[:2]), PoseRms(*rms[2:])


def without_rigid_motion(points: Floats, derivative: Floats) -> tuple[Floats, Floats]:
    """Derivatives of points less the rigid motion of all of them that comes nearest, and its rotation.

    Args:
        points: Shape (n, 3), [m].
        derivative: Of the points in anything, shape (n, 3, m).

    Returns:
        Shapes (n, 3, m) and (3, m), the latter in [rad] of what it is differentiated by.
    """
    p = points - points.mean(axis=0)
    shifts = np.tile(np.eye(3), (len(p), 1))  # (3 n, 3)
    turns = np.cross(np.eye(3)[None], p[:, None]).transpose(0, 2, 1).reshape(-1, 3)  # axis x p, a column an axis
    motions = np.hstack([shifts, turns])
    flat, nearest = derivative.reshape(len(motions), -1), np.linalg.pinv(motions, rcond=_RCOND)
    found: Floats = nearest @ flat
    left: Floats = flat - motions @ found
    left = left - motions @ (nearest @ left)  # once more: rounding of the first time
    left[:, np.linalg.norm(left, axis=0) <= _RCOND * np.linalg.norm(flat, axis=0)] = 0.0
    return left.reshape(derivative.shape), found[3:]


def _rms(variance: Floats) -> float | None:
    """RMS length of vectors from the variances of their coordinates, shape (3 n,); None where one is unknown.

    A mean below 0 is what rounding leaves of far larger variances that cancel: that is not known either.
    """
    mean = float(np.mean(variance))
    return float(np.sqrt(3.0 * mean)) if 0.0 <= mean < np.inf else None
