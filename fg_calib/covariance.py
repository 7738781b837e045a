"""The covariance of the estimate, and what nothing determines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.factors import prior_rows
from fg_calib.observability import SUPPORT_TOLERANCE, determined
from fg_calib.problem import correlation, whitened_triangle
from fg_calib.robust import effect
from fg_calib.solver import Solution

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """The covariance in the tangent space of the variables, and the directions that nothing determines.

    Attributes:
        names: Named scalars, in the order of the columns (see `Variables.names`).
        n_robot_columns: Columns without the measurement frame's.
        tangent: Covariance of the determined part, shape (n_columns, n_columns).
        weighted: The same, were the rows' noise as they are weighted.
        loose: Undetermined directions at the estimate, orthonormal in changes of ordinary size, shape
            (n_loose, n_columns).
        loose_at_nominal: The same at the nominal parameters.
        scales: A change of ordinary size in each column.
        named_derivative: Of the named scalars in the columns.
        rank: Number of determined directions.
        excess: By how much the mean of chi-square is below its degrees of freedom, because rows that share errors are
            weighted as independent.
    """

    names: tuple[str, ...]
    n_robot_columns: int
    tangent: Floats
    weighted: Floats
    loose: Floats
    loose_at_nominal: Floats
    scales: Floats
    named_derivative: Floats
    rank: int
    excess: float

    def covariance(self, rows: Floats) -> Floats:
        """Covariance of linear functions of the columns, shape (m, n_columns); nan where undetermined."""
        with np.errstate(invalid="ignore"):  # a pose at a quarter turn of pitch has no derivative
            out: Floats = rows @ self.tangent @ rows.T
            size = np.linalg.norm(rows * self.scales, axis=1)
            share, share_at_nominal = (
                np.linalg.norm((rows * self.scales) @ loose.T, axis=1) for loose in (self.loose, self.loose_at_nominal)
            )
            unknown = (share > SUPPORT_TOLERANCE * size) & (share_at_nominal > SUPPORT_TOLERANCE * size)
        unknown |= ~np.isfinite(np.diag(out))
        out[unknown, :] = np.nan
        out[:, unknown] = np.nan
        return out

    def named(self) -> Floats:
        """Covariance of the robot's estimated parameters, shape (n_robot_columns, n_robot_columns)."""
        n = self.n_robot_columns
        return self.covariance(self.named_derivative[:n])


def spread_of(solution: Solution) -> Spread:
    """The covariance: that of the weighted least-squares estimate under the noise as it is taken to be.

    Where rows share errors but are weighted as independent, with H = J^T J and C their covariance, it is
    H^-1 (J^T C J) H^-1 (priors are rows of their own), unless independence was asked for. The mean of chi-square,
    tr C - tr(H^-1 J^T C J), is then below the degrees of freedom by tr(H^-1 J^T (C - 1) J). A robust loss loses some of
    what clean data hold: see `robust.Effect`.
    """
    problem, variables = solution.problem, solution.problem.variables
    scales = variables.scales

    def stacked(parameters: Floats) -> Floats:
        data = whitened_triangle(problem, parameters) / np.sqrt(effect(problem.settings.loss, problem.height).variance)
        rows = [data, prior_rows(variables, parameters)[1]]
        return np.vstack([*rows, np.zeros((variables.n_columns, variables.n_columns))]) * scales

    _, s, Vt = np.linalg.svd(stacked(solution.parameters), full_matrices=False)
    _, s_nominal, Vt_nominal = np.linalg.svd(stacked(solution.before), full_matrices=False)
    rank, rank_nominal = determined(s), determined(s_nominal)
    half = scales[:, None] * Vt[:rank].T / s[:rank]
    added = correlation(problem, solution.parameters)
    middle = np.zeros((rank, rank)) if added is None else half.T @ added @ half
    middle_of_sigma = np.eye(rank) + (middle if problem.approximate else 0.0)
    return Spread(
        names=variables.names,
        n_robot_columns=variables.n_robot_columns,
        tangent=half @ middle_of_sigma @ half.T,
        weighted=half @ half.T,
        loose=Vt[rank:],
        loose_at_nominal=Vt_nominal[rank_nominal:],
        scales=scales,
        named_derivative=variables.named_derivative(solution.parameters),
        rank=rank,
        excess=float(np.trace(middle)),
    )
