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

from fg_calib.analysis.covariance import Spread
from fg_calib.graph.problem import Problem, eliminated_terms
from fg_calib.graph.solver import Solution
from fg_calib.graph.whitening import joint_rows
from fg_calib.measurements import residuals
from fg_calib.measurements.residuals import CorrelatedBlock

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ALARM = 0.01
"""Probability of calling any reading of a clean table suspect."""

_SEEN = 1e-3
"""Share of a reading's variance below which the measurements say nothing of its error."""


@dataclass(frozen=True)
class JointValues:
    """Estimated joint values of the fitted configurations, of the joints that have noise.

    Attributes:
        configurations: Rows of the measurements, shape (n,).
        joints: Indices of the joints, shape (k,).
        names: Their names.
        reading: Shape (n, k), [rad] (prismatic: [m]).
        error: Estimate minus reading, in the same units, shape (n, k).
        sigma: 1 sigma of a reading as stated, shape (k,).
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
    problem, m = solution.problem, solution.problem.measurements
    joints = np.flatnonzero(m.sigma_joint > 0.0)
    if problem.joints is not None:
        rows, variance = problem.joints.configurations, _of_variables(solution, spread)
        q = problem.joints.values(problem.variables, solution.parameters)[np.ix_(rows, joints)]
        error = q - m.readings[np.ix_(rows, joints)]
    elif problem.adjustment.joint_errors is not None:
        rows, variance = _fitted(problem), _of_eliminated(solution, spread)
        error = problem.adjustment.joint_errors[np.ix_(rows, joints)]
    else:
        return None
    sigma = m.sigma_joint[joints]
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
        reading=m.readings[np.ix_(rows, joints)],
        error=error,
        sigma=sigma,
        studentised=studentised,
        suspects=tuple((int(i), int(k)) for i, k in zip(*np.unravel_index(worst, size.shape), strict=True)),
    )


def _fitted(problem: Problem) -> Integers:
    """Configurations of the fitted rows, in order."""
    if problem.pairs is None or problem.judgement is None:
        return np.flatnonzero(~problem.measurements.test)
    pairs = problem.pairs.select(problem.judgement.used & ~problem.pairs.test)
    return np.unique(np.concatenate([pairs.a, pairs.b]))


def _of_variables(solution: Solution, spread: Spread) -> Floats:
    """Variance of the estimated errors where joint values are variables, shape (n, k)."""
    problem = solution.problem
    assert problem.joints is not None
    left = eliminated_terms(problem, solution.parameters)
    remaining = spread.variance(left.follow) + np.sum(left.inverse**2, axis=1)
    sigma = problem.measurements.sigma_joint[problem.joints.joints]
    out: Floats = sigma**2 - remaining.reshape(-1, len(sigma))
    return out


def _of_eliminated(solution: Solution, spread: Spread) -> Floats:
    """The same where they are eliminated: with y the whitened rows and z = S^T y, S^T (1 - J Cov J^T) S."""
    problem = solution.problem
    block, chain = problem.blocks[0], problem.variables.chain.at(solution.parameters)
    assert isinstance(block, CorrelatedBlock)
    rows = _fitted(problem)
    sigma, values_vectors = problem.measurements.sigma_joint, np.linalg.eigh(spread.tangent)
    noisy = np.flatnonzero(sigma > 0.0)
    half = values_vectors[1] * np.sqrt(np.maximum(values_vectors[0], 0.0))
    if block.loadings:
        J = np.concatenate(list(block.chunks(chain)))[:, :-1]
        S = block.whiten(np.vstack([L.toarray() for L in block.loadings]))  # (n_rows, n_shared)
        of_z = np.sum(S**2, axis=0) - np.sum((S.T @ (J @ half)) ** 2, axis=1)
        share = of_z.reshape(len(rows), -1)[:, -len(noisy) :]
    else:
        (part,) = block.parts
        J = residuals.linearise(part, chain)[1]  # (n, height, n_columns)
        S = np.concatenate([J for _, J in joint_rows(part, chain, sigma)])[:, :, noisy]  # (n, height, k)
        share = np.sum(S**2, axis=1) - np.sum((np.swapaxes(S, 1, 2) @ (J @ half)) ** 2, axis=2)
    out: Floats = share * sigma[noisy] ** 2
    return out
