"""How far off the tool is expected to be at any configuration, by the covariance of the estimate.

With (w, v) the derivatives of the tool's orientation and position in what was estimated and Cov the covariance, the
mean square of the position error at one configuration is tr(v Cov v^T), and that of the orientation error the same of
w (see `accuracy` for their mean over several). *Fitted* is what is left after the one rotation and shift that fit the
measured configurations best, and then hold all over the workspace: the part of the derivatives v at the measured
points that rigid motions G can make is G v, and the same motion is taken away everywhere else.

Errors of the joint readings are no part of that: of readings whose errors have sigma s, they are sum_j s_j^2 |v_j|^2,
v_j being the derivative of the tool's position in joint j, and independent of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.graph.factors import build_variables
from fg_calib.prediction.expected_error import without_rigid_motion
from fg_calib.robot.kinematics import Chain, forward
from fg_calib.statistics.covariance import TangentCovariance

Floats = NDArray[np.float64]

_MOST_MEASURED = 1000
"""Measured configurations that the rigid motion is fitted to; of more, so many that are evenly spaced."""

_AT_ONCE = 2000
"""Configurations that are looked at at once: derivatives of all would fill the memory."""


@dataclass(frozen=True)
class ToolErrors(FrozenArrays):
    """Expected RMS errors of the tool at configurations: position [m] and orientation [rad] in columns.

    Attributes:
        readings: The configurations, shape (n, n_joints), [rad] (prismatic: [m]).
        position: Where the tool is, from the base, shape (n, 3), [m].
        base: Errors in the base frame, shape (n, 2); nan where they depend on what is not determined.
        fitted: Errors after the best rigid fit of the measured configurations, shape (n, 2); nan likewise.
        joint_noise: What errors of the joint readings add, shape (n, 2); None where their noise is not known.
    """

    readings: Floats
    position: Floats
    base: Floats
    fitted: Floats
    joint_noise: Floats | None

    def of(self, fitted: bool) -> Floats:
        """Errors after the best rigid fit, or in the base frame, shape (n, 2)."""
        return self.fitted if fitted else self.base


@dataclass(frozen=True)
class ToolErrorModel(FrozenArrays):
    """What a covariance says of the tool's error anywhere.

    Attributes:
        spread: The covariance.
        chain: The arm from its base, at the estimate.
        sigma_joint: Of joint readings, shape (n_joints,), [rad] (prismatic: [m]); None where it is not known.
        centre: Mean of the measured points, shape (3,), [m].
        shift: How the best rigid fit moves it, in the columns, shape (3, n_columns).
        turn: How the best rigid fit turns about it, in the columns, shape (3, n_columns).
    """

    spread: TangentCovariance
    chain: Chain
    sigma_joint: Floats | None
    centre: Floats
    shift: Floats
    turn: Floats

    @classmethod
    def of(cls, spread: TangentCovariance, measured: Floats, sigma_joint: Floats | None = None) -> ToolErrorModel:
        """The model of a covariance.

        Args:
            spread: The covariance.
            measured: Readings of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
            sigma_joint: Of joint readings, shape (n_joints,); None where it is not known.
        """
        chain = build_variables(spread.variables.robot, [False]).chains[0].at(spread.parameters)
        nothing = np.zeros((3, spread.variables.n_columns))
        model = cls(spread, chain.with_joint_columns(), sigma_joint, np.zeros(3), nothing, nothing)
        evenly = np.linspace(0, len(measured) - 1, min(_MOST_MEASURED, len(measured)))
        points, motion, _ = model._derivatives(measured[np.unique(evenly.astype(np.int64))])
        w, v = motion[:, :3], motion[:, 3:]
        left, turn = without_rigid_motion(points, v)
        if not np.isfinite(spread.variance(left.reshape(3 * len(left), left.shape[2]))).all():
            turn = w.mean(axis=0)  # points that are not determined fit nothing: orientations by their own best rotation
        return cls(spread, model.chain, sigma_joint, points.mean(axis=0), (v - left).mean(axis=0), turn)

    def motions(self, readings: Floats, *, fitted: bool) -> tuple[Floats, Floats]:
        """Tool points, shape (n, 3), [m], and (w, v) in the columns, shape (n, 6, n_columns).

        Args:
            readings: Shape (n, n_joints), [rad] (prismatic: [m]).
            fitted: Whether less the best rigid fit, instead of in the base frame.
        """
        points, motion, _ = self._derivatives(readings)
        return points, self._without_fit(points, motion) if fitted else motion

    def at(self, readings: Floats) -> ToolErrors:
        """Expected errors at joint readings, shape (n, n_joints), [rad] (prismatic: [m])."""
        n = len(readings)
        position, base, fitted, noise = np.empty((n, 3)), np.empty((n, 2)), np.empty((n, 2)), np.zeros((n, 2))
        for rows in _parts(n):
            position[rows], motion, of_joints = self._derivatives(readings[rows])
            base[rows] = self._rms(motion)
            fitted[rows] = self._rms(self._without_fit(position[rows], motion))
            if self.sigma_joint is not None:
                noise[rows] = _lengths(np.square(of_joints * self.sigma_joint).sum(axis=2))
        return ToolErrors(readings, position, base, fitted, None if self.sigma_joint is None else noise)

    def _derivatives(self, readings: Floats) -> tuple[Floats, Floats, Floats]:
        """Tool points, and (w, v) in the columns and in the joints."""
        at = forward(self.chain, self.spread.variables.robot.trig(readings))
        n = self.chain.n_columns
        motion = np.zeros((len(readings), 6, self.spread.variables.n_columns))
        motion[:, :, :n] = at.jacobian[:, :, :n]
        return at.position, motion, at.jacobian[:, :, n:]

    def _without_fit(self, points: Floats, motion: Floats) -> Floats:
        moved = np.cross(self.turn[None], (points - self.centre)[:, :, None], axis=1) + self.shift
        left: Floats = motion - np.concatenate([np.broadcast_to(self.turn, moved.shape), moved], axis=1)
        return left

    def _rms(self, motion: Floats) -> Floats:
        return _lengths(self.spread.variance(motion.reshape(6 * len(motion), motion.shape[2])).reshape(-1, 6))


def _lengths(variance: Floats) -> Floats:
    """RMS lengths from the variances of (w, v), shape (n, 6): of v, then of w, shape (n, 2).

    A variance below 0 is what rounding leaves of far larger ones that cancel: that is not known either.
    """
    sums = variance.reshape(-1, 2, 3).sum(axis=2)[:, ::-1]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.where(sums >= 0.0, sums, np.nan)))


def _parts(n: int) -> Iterator[slice]:
    return (slice(start, start + _AT_ONCE) for start in range(0, n, _AT_ONCE))
