"""Estimated joint values beside their readings: how a wrong encoder reading, or a joint that is off, shows.

Where encoder noise is estimated, a reading q has an error e = q_true - q of 1 sigma as stated. What measurements say
of it varies by less: by `sqrt(sigma^2 - s^2)` with s the sigma of the joint value that is left. An estimated error over
that is *studentised*: 1 sigma of a healthy reading is 1, however little the measurements see of its joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.arrays import FrozenArrays
from fg_calib.graph.information import eliminated
from fg_calib.graph.solver import Solution
from fg_calib.statistics.covariance import Spread

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ALARM = 0.01
"""Probability of calling any reading of a clean table suspect."""

_SEEN = 1e-3
"""Share of a reading's variance below which the measurements say nothing of its error."""


@dataclass(frozen=True)
class JointValues(FrozenArrays):
    """Estimated joint values of the fitted configurations, of the joints that have noise.

    Attributes:
        configurations: Rows of the measurements, shape (n,).
        joints: Indices of the joints, shape (k,).
        names: Their names.
        reading: Shape (n, k), [rad] (prismatic: [m]).
        error: Estimate minus reading, in the same units, shape (n, k).
        sigma: 1 sigma of a reading as it is taken to be: as stated, or estimated, shape (k,).
        studentised: Error over its own 1 sigma, shape (n, k); nan where the measurements say nothing of it.
        suspects: (row, column) of errors that are too large, the worst first.
    """

    configurations: Integers
    joints: Integers
    names: tuple[str, ...]
    reading: Floats
    error: Floats
    sigma: Floats
    studentised: Floats
    suspects: tuple[tuple[int, int], ...]

    @property
    def mean(self) -> Floats:
        """Mean error of each joint, in sigma of a reading, shape (k,)."""
        out: Floats = (self.error / self.sigma).mean(axis=0)
        return out

    @property
    def scatter(self) -> Floats:
        """RMS of the studentised errors of each joint, 1 where all is as stated; nan if nothing is seen, shape (k,)."""
        seen = np.isfinite(self.studentised)
        n = seen.sum(axis=0)
        total = np.sum(np.where(seen, self.studentised, 0.0) ** 2, axis=0)
        return np.where(n > 0, np.sqrt(total / np.maximum(n, 1)), np.nan)


def joint_values(solution: Solution, spread: Spread) -> JointValues | None:
    """The estimated joint values of a solution; None where they were not estimated.

    Args:
        solution: The solution.
        spread: Its covariance.
    """
    problem, data = solution.problem, solution.problem.data
    if problem.state.joint_errors is None:
        return None
    joints = np.flatnonzero(data.sigma_joint > 0.0)
    sigma = problem.sigma_joint[joints]
    rows, variance = _variance(solution, spread, sigma)
    error = problem.state.joint_errors[np.ix_(rows, joints)]
    share = variance / sigma**2
    with np.errstate(invalid="ignore", divide="ignore"):
        studentised = np.where(share > _SEEN, error / np.sqrt(variance), np.nan)
    level = special.ndtri(0.5 + 0.5 * (1.0 - ALARM) ** (1.0 / max(1, studentised.size)))
    size = np.nan_to_num(np.abs(studentised))
    worst = np.argsort(-size, axis=None)[: int(np.sum(size > level))]
    return JointValues(
        configurations=rows,
        joints=joints,
        names=tuple(problem.robot.joints[j].name for j in joints),
        reading=data.readings[np.ix_(rows, joints)],
        error=error,
        sigma=sigma,
        studentised=studentised,
        suspects=tuple((int(i), int(k)) for i, k in zip(*np.unravel_index(worst, size.shape), strict=True)),
    )


def _variance(solution: Solution, spread: Spread, sigma: Floats) -> tuple[Integers, Floats]:
    """Configurations of the fitted rows, in order, and the variance of their estimated errors, shape (n, k).

    With Z = G r it is what r takes off their variance, less G J Cov J^T G^T.
    """
    problem = solution.problem
    values, vectors = np.linalg.eigh(spread.tangent)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    left, at = eliminated(problem, solution.parameters), problem.variables.at(solution.parameters)
    n = problem.variables.n_columns
    found, shares = [np.zeros(0, dtype=np.int64)], [np.zeros((0, len(sigma)))]
    for rows in problem.rows:
        if rows.shared is not None:
            J = rows.private(at)[:, :-1]
            J = np.hstack([(J[:, :n] + J[:, n:] @ left.follow) @ half, J[:, n:] @ left.inverse])
            Z = rows.shared.most_likely(J)
            of_z = (1.0 - rows.shared.variances - np.sum(Z**2, axis=1)).reshape(len(rows.configurations), -1)
            found.append(rows.configurations)
            shares.append(of_z[:, rows.joints : rows.joints + len(sigma)])
    configurations = np.concatenate(found)
    order = np.argsort(configurations)
    return configurations[order], np.concatenate(shares)[order] * sigma**2
