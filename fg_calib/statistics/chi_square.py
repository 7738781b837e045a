"""Chi-square of the fitted rows and the priors: its degrees of freedom, its mean, and how probable it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fg_calib.graph.information import eliminated
from fg_calib.graph.problem import Problem, mahalanobis_distances
from fg_calib.graph.robust import effect
from fg_calib.graph.solver import Solution
from fg_calib.statistics.covariance import Spread
from fg_calib.statistics.goodness_of_fit import OUTLIER_WEIGHT

CONFIDENCE = 0.999
"""A sum of squares outside this central interval of its distribution is not by chance."""

FACTOR = 2.0
"""A reduced chi-square between 1 / FACTOR and FACTOR is good whatever its distribution: noise is never known better."""


@dataclass(frozen=True)
class ChiSquare:
    """Chi-square of the fitted rows and the priors.

    Attributes:
        value: Sum of squared whitened residuals; with a robust loss of what keeps at least half its weight.
        dof: Residuals and priors, less the determined directions.
        expected: Its mean; not `dof` where rows that share errors count as independent.
        bounds: Interval of the reduced chi-square that is taken as good.
        p_value: Probability of one as large, were the noise as stated; None where that is not known.
    """

    value: float
    dof: int
    expected: float
    bounds: tuple[float, float]
    p_value: float | None

    @property
    def too_large(self) -> bool:
        """Whether it is above what is taken as good."""
        return self.value > self.bounds[1] * self.dof

    @property
    def ratio(self) -> float:
        """It over its mean; 1 where nothing is expected."""
        return self.value / self.expected if self.expected > 0.0 else 1.0


def chi_square(solution: Solution, spread: Spread) -> ChiSquare:
    """Chi-square of a solution.

    Args:
        solution: The solution.
        spread: The covariance of what was estimated.
    """
    problem = solution.problem
    chi2, n_rows, of_loss = _weighted_chi2(solution)
    dof = (
        n_rows
        + problem.n_priors
        + problem.n_added
        + problem.n_known
        - spread.rank
        - eliminated(problem, solution.parameters).rank
    )
    expected = max(0.0, dof - spread.excess - (1.0 - of_loss) * n_rows)
    independent = _independent_dof(problem, dof, spread.rank)
    p_value = _p_value(solution, chi2, expected, independent)
    return ChiSquare(chi2, dof, expected, chi2_bounds(dof, expected, independent), p_value)


def chi2_bounds(dof: int, expected: float | None = None, independent: int | None = None) -> tuple[float, float]:
    """Interval of the reduced chi-square taken as good: its central `CONFIDENCE`, widened to `FACTOR` either way.

    Args:
        dof: Degrees of freedom that chi-square is divided by.
        expected: Mean of chi-square; `dof` if None.
        independent: Degrees of freedom of the noise behind it; `dof` if None.
    """
    if dof <= 0:
        return 0.0, np.inf
    k = max(1, min(dof, independent or dof))
    ratio = 1.0 if expected is None else expected / dof
    low, high = (2.0 * special.gammaincinv(k / 2.0, p) / k for p in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return ratio * min(float(low), 1.0 / FACTOR), max(1.0, ratio) * max(float(high), FACTOR)


def chi_square_of(value: float, dof: int, *, independent: bool) -> ChiSquare:
    """Chi-square of rows whose noise is as they are weighted by.

    Args:
        value: Sum of squared whitened residuals and priors.
        dof: Residuals and priors, less the determined directions.
        independent: Whether no rows share errors: where some may, nothing says how probable it is.
    """
    p_value = float(special.gammaincc(dof / 2.0, value / 2.0)) if independent and dof > 0 else None
    return ChiSquare(value, dof, float(max(dof, 0)), chi2_bounds(dof), p_value)


def _weighted_chi2(solution: Solution) -> tuple[float, int, float]:
    """Chi-square, the independent residuals in it, and what a robust loss makes of the mean of one of them.

    With a robust loss only measurements count that keep at least half their weight.
    """
    problem = solution.problem
    weights, chi2 = problem.state.weights, 2.0 * solution.weighted_cost
    if weights is None:
        return chi2, problem.n_independent, 1.0
    n_rows = n_kept = expected = 0.0
    distances = mahalanobis_distances(problem, solution.parameters)
    for series, w, (e, residual_dim) in zip(problem.data.series, weights, distances, strict=True):
        train, outlier = (residual_dim > 0) & ~series.test, w < OUTLIER_WEIGHT
        chi2 -= float(np.sum(w[train & outlier] * e[train & outlier] ** 2))
        kept = float(residual_dim[train & ~outlier].sum())
        n_rows, n_kept = n_rows + float(residual_dim[train].sum()), n_kept + kept
        expected += kept * effect(problem.options.loss, int(residual_dim.max(initial=1))).chi2
    of_loss = expected / n_kept if n_kept else 1.0
    return max(0.0, chi2), round(problem.n_independent * n_kept / max(n_rows, 1.0)), of_loss


def _p_value(solution: Solution, chi2: float, expected: float, independent: int) -> float | None:
    """Upper p-value of chi-square, scaled to its mean; None where weights or noise came from the residuals."""
    problem = solution.problem
    if problem.state.weights is not None or solution.estimated_noise is not None or expected <= 0.0 or independent <= 0:
        return None
    return float(special.gammaincc(independent / 2.0, chi2 / expected * independent / 2.0))


def _independent_dof(problem: Problem, dof: int, rank: int) -> int:
    """Degrees of freedom of the noise behind the residuals: pairs hold no more than the poses they come from."""
    if not (problem.formed and problem.missing_correlation) or len(problem.data.series) > 1:
        return dof
    each = 3 * problem.data.series[0].kind.residual_dim
    return min(dof, each * (problem.n_configurations - 1) + problem.n_priors - rank)
