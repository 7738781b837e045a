"""Expected errors of the calibrated arm's tool, by the covariance of the estimate.

With (w, v) the derivatives of the tool's orientation and position in the estimate (see `kinematics`) and Cov its
covariance, the mean square of the position error at a configuration is tr(v Cov v^T), and that of the orientation error
tr(w Cov w^T). Over several configurations it is the mean of these. *Base* is in the robot's base frame. *Fitted* is
after the rotation and translation that bring the estimated points nearest to the true ones, to first order: the part of
v that the six rigid motions of all points can make is subtracted, and the rotation found with it from w. It counts
where the arm works relative to what was measured, and does not depend on the base, which measurements in an unknown
frame do not determine. Over the workspace, the rigid motion is that of the measured configurations.

Errors of the joint readings are not included: readings with errors of sigma s add sum_j s_j^2 |v_j|^2, where v_j is the
derivative of the tool's position in joint j.
"""

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from fg_calib.graph import Problem, build_variables
from fg_calib.inputs import Floats, FrozenArrays, Integers, Record
from fg_calib.measurements import Dataset
from fg_calib.observability import ObservedQuantities
from fg_calib.robot import Chain, Context, context_at, forward, without_rigid_motion
from fg_calib.statistics import TangentCovariance

MAX_CONFIGURATIONS = 1000
"""Configurations up to which all are looked at; of more, as many evenly spaced."""

MIN_JUDGED = 10
"""Test configurations below which the train ones are looked at: a rigid fit takes up the errors of few."""

_AT_ONCE = 500
"""Configurations at once: derivatives of all would fill the memory."""


class PoseRms(Record):
    """Expected RMS errors of the tool; None where they depend on what is not determined.

    Attributes:
        position: [m].
        orientation: [rad].
    """

    position: float | None
    orientation: float | None


class ExpectedError(Record):
    """Expected errors of the tool over some configurations.

    Attributes:
        base: In the base frame.
        fitted: After the best rigid fit.
        at: Whether at the test configurations, or at the train ones where these are few.
        n: Number of configurations looked at.
        of: Number of configurations that there are.
        relative: Whether no measurement determines the base, so that `fitted` alone describes the measurements.
    """

    base: PoseRms
    fitted: PoseRms
    at: Literal["test", "train"]
    n: int
    of: int
    relative: bool = False

    @property
    def measured(self) -> PoseRms:
        """What of it shows in the measurements."""
        return self.fitted if self.relative else self.base


def expected_error(problem: Problem, covariance: TangentCovariance) -> ExpectedError:
    """Expected errors of the tool at the test configurations, or at the train ones where these are few.

    Args:
        problem: The solved problem.
        covariance: The covariance of its solution, what was left out to fix the gauge included.
    """
    judged, at = judged_configurations(problem.data)
    chosen = _evenly(judged)
    base, fitted = errors_at(covariance, problem.data.readings[chosen], context_at(problem.data.context, chosen))
    return ExpectedError(base, fitted, at, len(chosen), len(judged), ObservedQuantities.of(problem).blind_to_base)


def judged_configurations(data: Dataset) -> tuple[Integers, Literal["test", "train"]]:
    """The test configurations of all tables, or the train ones where these are few; and which they are."""
    test = data.held_out
    enough = test.sum() >= min(MIN_JUDGED, len(test) - test.sum())
    return np.flatnonzero(test if enough else ~test), "test" if enough else "train"


def _evenly(rows: Integers) -> Integers:
    """At most `MAX_CONFIGURATIONS` rows, evenly spaced."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, MAX_CONFIGURATIONS).round().astype(np.int64))]


def errors_at(
    covariance: TangentCovariance, readings: Floats, context: Context | None = None
) -> tuple[PoseRms, PoseRms]:
    """Expected errors over configurations, in the base frame and after the best rigid fit.

    Args:
        covariance: The covariance at the estimate.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        context: What effects depend on besides: see `Robot.trig`.
    """
    every = np.arange(len(readings))
    few = _evenly(every) if len(covariance.curves) else every
    points, motion, _ = tool_derivatives(covariance, base_chain(covariance), readings[few], context_at(context, few))
    return pose_rms(points, motion, covariance.variance)


def pose_rms(points: Floats, jacobian: Floats, variance: Callable[[Floats], Floats]) -> tuple[PoseRms, PoseRms]:
    """Expected errors from derivatives, in the base frame and after the best rigid fit.

    Args:
        points: Tool points, shape (n, 3), [m].
        jacobian: (w, v) of each as rows of a covariance, shape (n, 6, n_columns).
        variance: Of linear functions of the columns, shape (m, n_columns), nan where not determined: shape (m,).
    """
    w, v = jacobian[:, :3], jacobian[:, 3:]
    v_fitted, turn = without_rigid_motion(points, v)
    rms = [_rms(variance(rows.reshape(-1, rows.shape[2]))) for rows in (v, w, v_fitted, w - turn)]
    if rms[2] is None:  # points that are not determined fit nothing: orientations by their own best rotation
        rms[3] = _rms(variance((w - w.mean(axis=0)).reshape(-1, w.shape[2])))
    return PoseRms(*rms[:2]), PoseRms(*rms[2:])


def _rms(variance: Floats) -> float | None:
    """RMS length of vectors from the variances of their coordinates, shape (3 n,); None where one is unknown.

    A mean below 0 is the rounding of far larger variances that cancel: it is unknown too.
    """
    mean = float(np.mean(variance))
    return float(np.sqrt(3.0 * mean)) if 0.0 <= mean < np.inf else None


def base_chain(covariance: TangentCovariance) -> Chain:
    """The arm in its base frame, at the estimate, with derivatives in the joints too."""
    return build_variables(covariance.variables.robot, [False]).chains[0].at(covariance.parameters).with_joint_columns()


def tool_derivatives(
    covariance: TangentCovariance, chain: Chain, readings: Floats, context: Context | None = None
) -> tuple[Floats, Floats, Floats]:
    """Tool points, shape (n, 3), [m], and (w, v) as rows of the covariance, shape (n, 6, m), and in the joints.

    Args:
        covariance: The covariance.
        chain: From `base_chain`.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        context: What effects depend on besides: see `Robot.trig`.
    """
    trig = covariance.variables.robot.trig(readings, context, covariance.parameters)
    at = forward(chain, trig)
    motion = with_curve_errors(covariance, chain, trig, at.jacobian[:, :, : chain.n_columns])
    return at.position, motion, at.jacobian[:, :, chain.n_columns :]


def with_curve_errors(covariance: TangentCovariance, chain: Chain, trig: Floats, jacobian: Floats) -> Floats:
    """Derivatives in a chain's columns as rows of a covariance, shape (n, 6, n_columns + n_curves)."""
    v, curves = covariance.variables, covariance.curves
    rows = np.zeros((*jacobian.shape[:2], v.n_columns + len(curves)))
    rows[:, :, : chain.n_columns] = jacobian
    if len(curves):
        turns = forward(chain.without_columns().with_turn_columns(), trig).jacobian
        found, errors = chain.splines(trig), np.zeros((len(trig), v.robot.n_joints, rows.shape[2]))
        for one in (one for one in v.nuisance if one.kind == "curve"):
            knots, weights = found[one.number - 1]
            places = knots + one.columns.start - v.n_columns
            errors[:, one.number - 1] = np.einsum("nk,nkc->nc", weights, curves[places])
        rows += turns @ errors
    return rows


def predict_poses(
    covariance: TangentCovariance, readings: Floats, table: int | None = None, context: Context | None = None
) -> tuple[Floats, Floats, Floats]:
    """Tool points, shape (n, 3), [m], orientations, shape (n, 3, 3), and their joint covariance, shape (n, 6, 6).

    The covariance is of position, then of the rotation vector, along and about the axes of the frame; nan where it
    depends on what is not determined.

    Args:
        covariance: The covariance at the estimate.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        table: Number of the table in whose estimated measurement frame the poses are; the base frame if None.
        context: What effects depend on besides: see `Robot.trig`.
    """
    v = covariance.variables
    chain = build_variables(v.robot, [False]).chains[0] if table is None else v.chains[table]
    chain, trig = chain.at(covariance.parameters), v.robot.trig(readings, context, covariance.parameters)
    at, covariances = forward(chain, trig), np.empty((len(readings), 6, 6))
    for rows in _chunks(len(readings)):
        motion = with_curve_errors(covariance, chain, trig[rows], at.jacobian[rows])
        covariances[rows] = [covariance.covariance(one) for one in motion[:, [3, 4, 5, 0, 1, 2]]]
    return at.position, at.rotation, covariances


def _chunks(n: int) -> Iterator[slice]:
    return (slice(start, start + _AT_ONCE) for start in range(0, n, _AT_ONCE))


class ToolErrors(FrozenArrays):
    """Expected RMS errors of the tool at configurations: position [m] and orientation [rad] in columns.

    Attributes:
        readings: The configurations, shape (n, n_joints), [rad] (prismatic: [m]).
        position: Tool points in the base frame, shape (n, 3), [m].
        base: Errors in the base frame, shape (n, 2); nan where they depend on what is not determined.
        fitted: Errors after the best rigid fit of the measured configurations, shape (n, 2); nan likewise.
        joint_noise: Contribution of errors of the joint readings, shape (n, 2); None where their noise is not known.
    """

    readings: Floats
    position: Floats
    base: Floats
    fitted: Floats
    joint_noise: Floats | None


class ToolPoseUncertainty(FrozenArrays):
    """Expected errors of the tool at any configuration, by a covariance.

    Attributes:
        covariance: The covariance.
        chain: The arm in its base frame, at the estimate.
        sigma_joint: Of joint readings, shape (n_joints,), [rad] (prismatic: [m]); None where it is not known.
        centre: Mean of the measured points, shape (3,), [m].
        shift: How the best rigid fit moves it, as rows of the covariance, shape (3, m).
        turn: How the best rigid fit rotates about it, likewise.
    """

    covariance: TangentCovariance
    chain: Chain
    sigma_joint: Floats | None
    centre: Floats
    shift: Floats
    turn: Floats

    @classmethod
    def of(
        cls, covariance: TangentCovariance, measured: Floats, sigma_joint: Floats | None = None
    ) -> "ToolPoseUncertainty":
        """The model of a covariance.

        Args:
            covariance: The covariance.
            measured: Readings of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
            sigma_joint: Of joint readings, shape (n_joints,); None where it is not known.
        """
        chain = base_chain(covariance)
        points, motion, _ = tool_derivatives(covariance, chain, measured[_evenly(np.arange(len(measured)))])
        w, v = motion[:, :3], motion[:, 3:]
        left, turn = without_rigid_motion(points, v)
        if not np.isfinite(covariance.variance(left.reshape(3 * len(left), left.shape[2]))).all():
            turn = w.mean(axis=0)  # points that are not determined fit nothing: orientations by their own best rotation
        return cls(covariance, chain, sigma_joint, points.mean(axis=0), (v - left).mean(axis=0), turn)

    def motions(self, readings: Floats, context: Context, *, fitted: bool) -> Floats:
        """(w, v) as rows of the covariance, after the best rigid fit or in the base frame, shape (n, 6, m)."""
        points, motion, _ = tool_derivatives(self.covariance, self.chain, readings, context)
        return self._without_fit(points, motion) if fitted else motion

    def at(self, readings: Floats, context: Context | None = None) -> ToolErrors:
        """Expected errors at joint readings, shape (n, n_joints), [rad] (prismatic: [m]); context as `Robot.trig`'s."""
        n, context = len(readings), context or {}
        position, base, fitted, noise = np.empty((n, 3)), np.empty((n, 2)), np.empty((n, 2)), np.zeros((n, 2))
        for rows in _chunks(n):
            there = readings[rows], context_at(context, rows)
            position[rows], motion, of_joints = tool_derivatives(self.covariance, self.chain, *there)
            base[rows] = self._rms(motion)
            fitted[rows] = self._rms(self._without_fit(position[rows], motion))
            if self.sigma_joint is not None:
                noise[rows] = _lengths(np.square(of_joints * self.sigma_joint).sum(axis=2))
        return ToolErrors(readings, position, base, fitted, None if self.sigma_joint is None else noise)

    def _without_fit(self, points: Floats, motion: Floats) -> Floats:
        moved = np.cross(self.turn[None], (points - self.centre)[:, :, None], axis=1) + self.shift
        return np.asarray(motion - np.concatenate([np.broadcast_to(self.turn, moved.shape), moved], axis=1))

    def _rms(self, motion: Floats) -> Floats:
        return _lengths(self.covariance.variance(motion.reshape(6 * len(motion), motion.shape[2])).reshape(-1, 6))


def _lengths(variance: Floats) -> Floats:
    """RMS lengths of v, then of w, from the variances of (w, v), shape (n, 6): shape (n, 2); nan below 0 (rounding)."""
    sums = variance.reshape(-1, 2, 3).sum(axis=2)[:, ::-1]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.where(sums >= 0.0, sums, np.nan)))
