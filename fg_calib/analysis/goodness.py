"""Goodness of fit: do the residuals look like the noise that was stated, kind by kind, row by row?

With C the covariance of the rows' noise, J their derivatives and Cov the covariance of a generalised least-squares
estimate (priors included), the residuals have covariance `A = C - J Cov J^T`, whatever errors the rows share. So the
*leverage* of a row, `J_i Cov J_i^T / sigma_i^2`, is what the fit takes off its variance, and over the rows of one kind

    sum (r_i / sigma_i)^2    has mean  n - sum of leverage,  and variance  2 tr(A^2)  with A in units of sigma.

It is compared with a chi-square distribution of `nu = (tr A)^2 / tr(A^2)` degrees of freedom, scaled to that mean
(Satterthwaite 1946). p-values are upper ones: the probability that noise as stated makes a sum as large; near 0 the
residuals are too large, near 1 too small. C is `D + L L^T`, D diagonal and L sparse, so no n x n matrix is formed.

Rows weighted as independent although they share errors are another matter: with K the inverse of J^T W J and priors,
`A = (1 - J K J^T W) C (1 - J K J^T W)^T` and what the priors add. It is worked out for up to `MAX_DENSE` rows; beyond
that the mean is that of all rows, shared among the kinds by leverage, and there is no p-value.

A row with robust weight w counts as w rows. There is no p-value where weights or noise came from the residuals.

Rows that were predicted, never fitted, miss by their own noise and by what the estimate is off: `A = C + J Cov J^T`.
Each kind is judged by the sum of its studentised squares. All of them together are judged by `r^T A^-1 r`, which
sees what misses where the arm is well known although it may be off by more elsewhere. Where the noise was estimated,
this is a ratio of two variances (F); with a robust loss measurements that it would call outliers count for nothing.

Note:
    Predicted pairs that share the joint noise of a configuration with fitted ones count as independent of these: their
    p-values are then somewhat too large.

References:
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from scipy import special

from fg_calib.analysis.covariance import Spread
from fg_calib.analysis.predictions import predicted_points
from fg_calib.analysis.residual_table import FAMILIES, ROW_KINDS, ResidualTable
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.problem import Problem, all_rows, lengths, pair_rows
from fg_calib.graph.robust import tuning, weight
from fg_calib.graph.solver import Solution
from fg_calib.graph.whitening import PRIVATE_SHARE, joint_rows
from fg_calib.measurements import residuals
from fg_calib.measurements.residuals import Block, PoseBlock
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.kinematics import SPAN

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]
Codes = NDArray[np.int8]
Loadings = scipy.sparse.csr_array

MAX_DENSE = 3000
"""Rows up to which the covariance of residuals is formed where they are weighted as independent but are not."""

MAX_KEPT = 300_000
"""Rows up to which derivatives and shared errors are kept, to look at parts of them again."""

MAX_WHITENED = 1000
"""Predicted rows up to which all are whitened together; of more, so many that are evenly spaced."""

ALARM = 0.01
"""Probability of calling any row of a clean table suspect; and any configuration."""

OUTLIER_WEIGHT = 0.5
"""A row with a robust weight below this is an outlier."""

FLAGS = ("", "suspect", "outlier", "excluded", "test")
"""What is said of a row, in the order of the codes."""

_CHUNK = 4 * SPAN

_MEDIAN = 0.6744897501960817
"""Median of the size of a standard normal figure."""


@dataclass(frozen=True)
class KindFit:
    """The fitted rows of one kind of noise.

    Attributes:
        kind: `distance`, `angle`, `orientation`, `position`, or `point` for all that touched points give.
        unit: `m` or `rad`.
        n: Number of scalar rows.
        stated_sigma_rms: Root of the mean square of their sigmas as stated.
        factor: What they were multiplied by: 1 unless the noise was estimated.
        seen_over_stated: Noise seen over noise stated; nan where the fit leaves less than one degree of freedom.
        chi2: Sum of squared residuals over sigma, as it was taken.
        expected: Its mean, were the noise as taken: the rows' redundancy.
        p_value: Probability of a sum as large, were the noise as taken; None where it is not known.
        typical: Noise seen over noise taken, from the median, which a few rows do not move.
        largest: The largest |studentised residual|; nan where it is not known.
        degrees: Degrees of freedom of chi-square.
    """

    kind: str
    unit: str
    n: int
    stated_sigma_rms: float
    factor: float
    seen_over_stated: float
    chi2: float
    expected: float
    p_value: float | None
    typical: float
    largest: float
    degrees: float

    @property
    def verdict(self) -> str:
        """What the figures say, as a key of `VERDICTS`."""
        ratio, p = self.seen_over_stated / self.factor, self.p_value
        if not np.isfinite(ratio):
            return "unknown"
        if p is None:  # weights or factors came from the residuals: their spread alone is known
            unlikely = abs(ratio - 1.0) > max(0.2, -special.ndtri(ALARM / 2.0) / np.sqrt(2.0 * self.degrees))
        else:
            unlikely = min(p, 1.0 - p) < ALARM / 2.0
        if not unlikely or abs(ratio - 1.0) < 0.05:
            return "as stated"
        if ratio < 1.0:
            return "too large"
        share = (self.typical**2 - 1.0) / (ratio**2 - 1.0)  # of the excess that rows have in common
        if not self.largest > suspect_level(self.n) * np.sqrt(max(self.typical, 1.0) * ratio):
            return "too small"  # the median of few rows varies: none of them is far from the others
        return "outliers" if share < 0.35 else "too small" if share > 0.65 else "both"


VERDICTS = {
    "as stated": "as stated",
    "too large": "noise stated too large",
    "too small": "most rows too large: noise stated too small, or effects not modelled",
    "outliers": "few rows far too large: outliers",
    "both": "noise stated too small or effects not modelled, and outliers",
    "unknown": "too few rows to tell",
}
"""What a fit by kind means, in words."""

PREDICTION_VERDICTS = VERDICTS | {
    "as stated": "as expected",
    "too large": "smaller than expected",
    "too small": "most rows too large",
    "outliers": "few rows far too large",
    "both": "many rows too large, and few far too large",
}
"""The same of predicted rows."""


@dataclass(frozen=True)
class SuspectConfiguration:
    """A configuration whose rows are too large together.

    Attributes:
        configuration: Its row among the measurements; a touched group counts on from the number of configurations.
        n: Scalar rows that it takes part in.
        chi2: Sum of their squared residuals over sigma.
        expected: Its mean, were the noise as stated.
    """

    configuration: int
    n: int
    chi2: float
    expected: float


class OutlierCounts(NamedTuple):
    """Test and fitted measurements, and those among them that a robust loss takes for outliers; zeros without one."""

    test: int = 0
    of_test: int = 0
    fitted: int = 0
    of_fitted: int = 0


@dataclass(frozen=True)
class PredictedFit:
    """How well the calibrated arm predicts the test rows.

    Attributes:
        kinds: The fit by kind; here chi-square is the sum of the squares of residuals over their own sigma, what the
            estimate may be off included.
        n_rows: Number of scalar rows.
        n: Number of them behind chi-square: evenly spaced ones if there are many (`MAX_WHITENED`).
        outliers: Measurements that count for nothing because a robust loss would call them outliers.
        n_unknown: Rows not judged because they depend on what neither data nor priors determine.
        chi2: Sum of the squares of the rows, whitened by their noise and by what the estimate may be off.
        expected: Its mean, were the noise as taken and the arm known as well as is claimed.
        p_value: Probability of a sum as large.
        suspects: Rows of the table that are too large, the largest |studentised| first.
        configurations: Configurations whose rows are too large together, the worst first.
    """

    kinds: tuple[KindFit, ...]
    n_rows: int
    n: int
    outliers: OutlierCounts
    n_unknown: int
    chi2: float
    expected: float
    p_value: float
    suspects: Integers
    configurations: tuple[SuspectConfiguration, ...]


@dataclass(frozen=True)
class Goodness:
    """How well residuals and stated noise agree; arrays are in the order of the residual table, shape (n,).

    Attributes:
        kinds: The fit by kind.
        leverage: Variance of the row's prediction over its noise; nan where it has none.
        studentised: Residual over its own 1 sigma: of a fitted row less its leverage, of a predicted one more.
        weight: Robust weight of each row's measurement.
        flag: What is said of each row, in `FLAGS`.
        level: |studentised| above which a row is suspect.
        suspects: Fitted rows that are suspect or outliers, the largest |studentised| first.
        configurations: Suspect configurations among the fitted rows, the worst first.
        test: The predicted rows; None without any that can be judged.
    """

    kinds: tuple[KindFit, ...]
    leverage: Floats
    studentised: Floats
    weight: Floats
    flag: Codes
    level: float
    suspects: Integers
    configurations: tuple[SuspectConfiguration, ...]
    test: PredictedFit | None


def suspect_level(n: int) -> float:
    """|studentised residual| that the largest of n clean rows exceeds with a probability of `ALARM` (Sidak 1967)."""
    return float(special.ndtri(0.5 + 0.5 * (1.0 - ALARM) ** (1.0 / max(1, n))))


def judge_fit(solution: Solution, spread: Spread, table: ResidualTable) -> Goodness:
    """Goodness of fit by kind, by row and by configuration.

    Args:
        solution: The solution.
        spread: Its covariance.
        table: Its residuals.
    """
    rows = _Rows(solution, spread, table)
    weight = rows.weight
    level = suspect_level(int(np.sum(table.reason_code == 0)))
    with np.errstate(invalid="ignore"):
        suspicious = np.abs(rows.studentised) > level
    flag = np.zeros(table.n, dtype=np.int8)
    flag[suspicious] = FLAGS.index("suspect")
    flag[weight < OUTLIER_WEIGHT] = FLAGS.index("outlier")
    flag[table.test] = FLAGS.index("test")
    flag[table.reason_code != 0] = FLAGS.index("excluded")

    def worst_first(chosen: Booleans) -> Integers:
        found = np.flatnonzero(chosen)
        return found[np.argsort(-np.abs(rows.studentised[found]), kind="stable")]

    return Goodness(
        kinds=rows.kinds(),
        leverage=rows.leverage,
        studentised=rows.studentised,
        weight=weight,
        flag=flag,
        level=level,
        suspects=worst_first((flag == FLAGS.index("suspect")) | (flag == FLAGS.index("outlier"))),
        configurations=rows.fitted.configurations(),
        test=rows.predicted_fit(worst_first(suspicious & (flag == FLAGS.index("test")))),
    )


def kind_fits(solution: Solution, spread: Spread, table: ResidualTable) -> tuple[KindFit, ...]:
    """Goodness of fit by kind alone (see `judge_fit`)."""
    return _Rows(solution, spread, table).kinds()


@dataclass(frozen=True)
class _Part:
    """Rows that are judged together: those fitted, or those predicted.

    Attributes:
        table: All rows.
        rows: Those of the part.
        squares: Their squared residuals over sigma, by robust weight.
        means: Means of these.
        covariance: Of the residuals over sigma; None where that is not known.
        shared: Whether rows share errors of configurations.
        judged: Whether there are p-values, and configurations worth a look.
        n_ends: Number of configurations and groups.
        behind: Degrees of freedom behind the noise that rows were divided by, by kind; infinite where it was stated.
    """

    table: ResidualTable
    rows: Integers
    squares: Floats
    means: Floats
    covariance: _LowRank | _Dense | None
    shared: bool
    judged: bool
    n_ends: int
    behind: Floats

    def of_kind(self, code: int) -> Integers:
        """Places in the part of one of `FAMILIES`."""
        return np.flatnonzero(self.table.family[self.rows] == code)

    def degrees(self, chosen: Integers) -> float:
        """Degrees of freedom of some rows; where that is not known, no more than one configuration's errors."""
        if self.covariance is not None:
            trace, square = self.covariance.moments(chosen)
        else:
            v = self.means[chosen]
            trace, square = float(np.sum(v)), float(np.sum(v * v))
        nu = trace**2 / square if square > 0.0 else 1.0
        return nu if self.covariance is not None or not self.shared else min(nu, 3.0)

    def p_value(self, chosen: Integers, chi2: float) -> float:
        """Probability of a sum of squares as large."""
        ratio = chi2 / float(np.sum(self.means[chosen]))
        return upper_probability(ratio, self.degrees(chosen), self.degrees_behind(chosen))

    def degrees_behind(self, chosen: Integers) -> float:
        """Degrees of freedom behind the noise that some rows were divided by."""
        by_kind = np.bincount(self.table.family[self.rows[chosen]], self.means[chosen], len(FAMILIES))
        variance = float(np.sum(by_kind**2 / self.behind))
        return float(np.sum(by_kind)) ** 2 / variance if variance > 0.0 else np.inf

    def configurations(self) -> tuple[SuspectConfiguration, ...]:
        """Configurations whose rows are too large together, the least likely first."""
        if not self.judged:
            return ()  # outliers have been found already
        ends = np.stack([self.table.a[self.rows], self.table.b[self.rows]])
        there = ends >= 0
        chi2, expected, count = (
            np.sum(
                [np.bincount(end[use], values[use], self.n_ends) for end, use in zip(ends, there, strict=True)], axis=0
            )
            for values in (self.squares, self.means, np.ones(len(self.rows)))
        )
        looked_at = np.flatnonzero(expected > 1e-3)
        limit = ALARM / max(1, len(looked_at))
        # No effective number of degrees of freedom is below 1, where the tail is heaviest.
        found = []
        for k in looked_at[special.gammaincc(0.5, 0.5 * chi2[looked_at] / expected[looked_at]) < limit]:
            nu = max(1.0, self.degrees(np.flatnonzero(np.any(ends == k, axis=0))))
            ratio = chi2[k] / expected[k]
            if special.gammaincc(nu / 2.0, nu / 2.0 * ratio) < limit:
                strength = 0.5 * nu * (ratio - 1.0 - np.log(ratio))  # -log p, nearly; never underflows
                found.append(
                    (strength, SuspectConfiguration(int(k), int(count[k]), float(chi2[k]), float(expected[k])))
                )
        return tuple(one for _, one in sorted(found, key=lambda pair: -pair[0]))


class _Rows:
    """The rows of a residual table with the variance of their residuals.

    Attributes:
        leverage: See `Goodness`.
        studentised: See `Goodness`.
        weight: See `Goodness`.
        fitted: The rows fitted, but for those of touched points.
    """

    def __init__(self, solution: Solution, spread: Spread, table: ResidualTable) -> None:
        problem = self._problem = solution.problem
        self._table = table
        self._spread = spread
        self._solution = solution
        self._robust = problem.adjustment.weights is not None
        weights = problem.adjustment.weights
        self._of_points = table.measurement >= _n_measured(problem)  # touches, and distances between points
        self.weight = np.ones(table.n)
        if weights is not None:
            self.weight[~self._of_points] = weights[table.measurement[~self._of_points]]
        point = _is_same_point(problem, table)
        fitted = np.flatnonzero(table.used & ~point & ~self._of_points)
        test = np.flatnonzero(table.test & (table.reason_code == 0) & ~point)
        self._shared = problem.common.poses or bool(np.any(problem.measurements.sigma_joint > 0.0))
        self._carried = problem.sharing == problem.common
        most = MAX_KEPT if self._carried and self._shared else MAX_DENSE
        keep = np.zeros(table.n, dtype=np.bool_)
        keep[fitted] = len(fitted) <= most and not self._robust
        keep[test] = len(test) <= MAX_KEPT
        keep &= ~self._of_points
        of_kept = np.flatnonzero(keep)
        L, J = self._read(keep)
        w, q = self.weight, self.leverage
        variance = 1.0 + q * (1.0 - 2.0 * np.where(table.used, w, 0.0))
        covariance = None
        if keep[fitted].all():
            here = np.searchsorted(of_kept, fitted)
            covariance = self._residual_covariance(fitted, J[here], None if L is None else L[here])
        if isinstance(covariance, _Dense):
            variance[fitted] = covariance.diagonal
        with np.errstate(invalid="ignore", divide="ignore"):
            self.studentised = table.after / (table.sigma * np.sqrt(np.maximum(variance, 1e-12)))
        self.studentised[variance < 1e-6] = np.nan  # a row that the fit meets whatever was measured
        # A point measured twice has three coordinates: as unlikely, not as large.
        squared = (table.after[point] / table.sigma[point]) ** 2
        self.studentised[point] = -special.ndtri(np.maximum(special.gammaincc(1.5, squared / 2.0), 1e-300) / 2.0)
        self.leverage[point] = np.nan
        self.studentised[self._of_points] = (table.after / table.sigma)[self._of_points]
        squares = (table.after / table.sigma) ** 2
        self.fitted = self._part(fitted, w[fitted] * squares[fitted], w[fitted] * variance[fitted], covariance)
        self.predicted, self._outliers, self._n_unknown = self._predict(test, squares, of_kept, J, L)

    def kinds(self) -> tuple[KindFit, ...]:
        """The fit of the fitted rows by kind."""
        part, leverage = self.fitted, self.weight[self.fitted.rows] * self.leverage[self.fitted.rows]
        excess = np.zeros(len(FAMILIES))
        if not self._carried and part.covariance is None and np.nansum(leverage) > 0.0:
            by_kind = [np.nansum(leverage[part.of_kind(code)]) for code in range(len(FAMILIES))]
            excess = self._spread.excess * np.array(by_kind) / np.nansum(leverage)
        known = not self._robust and self._solution.estimated_noise is None
        known &= part.covariance is not None or not self._shared
        found = [self._kind(part, code, float(excess[code]), known) for code in range(len(FAMILIES))]
        fits = [fit for fit in found if fit is not None]
        if np.any(self._of_points):
            fits.append(self._of_touched_points(fits))
        return tuple(fits)

    def predicted_fit(self, suspects: Integers) -> PredictedFit | None:
        """The fit of the predicted rows; None without any that can be judged.

        Args:
            suspects: The rows of the table among them that are too large.
        """
        part = self.predicted
        if not (len(part.rows) or self._outliers.test):
            return None
        chi2, expected, nu = self._whitened(part)
        behind = part.degrees_behind(np.arange(len(part.rows)))
        found = (self._kind(part, code, 0.0, True) for code in range(len(FAMILIES)))
        return PredictedFit(
            kinds=tuple(fit for fit in found if fit is not None),
            n_rows=len(part.rows),
            n=min(len(part.rows), MAX_WHITENED),
            outliers=self._outliers,
            n_unknown=self._n_unknown,
            chi2=chi2,
            expected=expected,
            p_value=upper_probability(chi2 / expected, nu, behind) if len(part.rows) else 1.0,
            suspects=suspects,
            configurations=part.configurations(),
        )

    def _whitened(self, part: _Part) -> tuple[float, float, float]:
        """Sum of the squares of the predicted rows, whitened together; its mean, and its degrees of freedom.

        What pairs formed from poses do not share counts as `PRIVATE_SHARE` of their variance at least, as in the fit.
        """
        chosen = np.unique(np.linspace(0, len(part.rows) - 1, MAX_WHITENED).round().astype(np.int64))
        if not isinstance(part.covariance, _LowRank) or not len(part.rows):
            return float(np.sum(part.squares)), float(np.sum(part.means)), part.degrees(np.arange(len(part.rows)))
        A, floor = part.covariance.dense(chosen)
        z = np.sign(self._table.after[part.rows[chosen]]) * np.sqrt(part.squares[chosen])
        factor = scipy.linalg.cholesky(A + np.diag(floor), lower=True)
        white = scipy.linalg.solve_triangular(factor, z, lower=True)
        expected = nu = float(len(chosen))
        if floor.any():  # less what was added: of tr B and tr B^2, B = 1 - (A + floor)^-1 floor
            half = scipy.linalg.solve_triangular(factor, np.diag(np.sqrt(floor)), lower=True)
            added, squared = float(np.vdot(half, half)), float(np.sum((half.T @ half) ** 2))
            expected, square = expected - added, expected - 2.0 * added + squared
            nu = expected**2 / square
        return float(white @ white), expected, nu

    def _part(self, rows: Integers, squares: Floats, means: Floats, covariance: _LowRank | _Dense | None) -> _Part:
        behind = np.full(len(FAMILIES), np.inf)
        n_ends = len(self._problem.measurements.end_names) - 1
        return _Part(self._table, rows, squares, means, covariance, self._shared, not self._robust, n_ends, behind)

    def _kind(self, part: _Part, code: int, excess: float, known: bool) -> KindFit | None:
        """The fit of one of `FAMILIES`, whose chi-square has a mean lower by `excess`; None if it has no rows."""
        chosen = part.of_kind(code)
        if not len(chosen):
            return None
        chi2, expected = float(np.sum(part.squares[chosen])), float(np.sum(part.means[chosen])) - excess
        rows, name, factor = part.rows[chosen], FAMILIES[code], float(_factors(self._problem)[code])
        enough = expected >= 1.0
        return KindFit(
            kind=name,
            unit="rad" if name in ("angle", "orientation") else "m",
            n=len(rows),
            stated_sigma_rms=float(np.sqrt(np.mean(self._table.sigma[rows] ** 2))) / factor,
            factor=factor,
            seen_over_stated=factor * float(np.sqrt(chi2 / expected)) if enough else np.nan,
            chi2=chi2,
            expected=max(expected, 0.0),
            p_value=part.p_value(chosen, chi2) if enough and known else None,
            typical=float(np.nanmedian(np.abs(self.studentised[rows]))) / _MEDIAN if enough else np.nan,
            largest=float(np.nanmax(np.abs(self.studentised[rows]))) if enough else np.nan,
            degrees=part.degrees(chosen),
        )

    def _of_touched_points(self, others: list[KindFit]) -> KindFit:
        """The fit of touches, and of distances between touched points, together.

        What all fitted rows and priors lose to the fit is its number of unknowns; these lose what the others leave.
        """
        table, problem, spread = self._table, self._problem, self._spread
        rows = np.flatnonzero(table.used & self._of_points)
        z = table.after[rows] / table.sigma[rows]
        P = prior_rows(problem.variables, self._solution.parameters)[1]
        lost = spread.rank + problem.variables.n_without_prior - float(np.sum((P @ spread.tangent) * P))
        lost -= sum(fit.n - fit.expected for fit in others)
        chi2, expected = float(z @ z), len(rows) - max(lost, 0.0)
        enough = expected >= 1.0
        return KindFit(
            kind="point",
            unit="m",
            n=len(rows),
            stated_sigma_rms=float(np.sqrt(np.mean(table.sigma[rows] ** 2))) if len(rows) else np.nan,
            factor=1.0,
            seen_over_stated=float(np.sqrt(chi2 / expected)) if enough else np.nan,
            chi2=chi2,
            expected=max(expected, 0.0),
            p_value=float(special.gammaincc(expected / 2.0, chi2 / 2.0)) if enough and not self._robust else None,
            typical=float(np.median(np.abs(z))) / _MEDIAN if len(rows) else np.nan,
            largest=float(np.max(np.abs(z))) if len(rows) else np.nan,
            degrees=max(expected, 1.0),
        )

    def _predict(
        self, test: Integers, squares: Floats, kept: Integers, J: Floats, L: Loadings | None
    ) -> tuple[_Part, OutlierCounts, int]:
        """The predicted rows that can be judged; `PredictedFit.outliers`, and how many rows are not known.

        Args:
            test: Predicted rows of the table.
            squares: Squared residuals over sigma of all rows.
            kept: Rows of the table that J and L are of.
            J: Derivatives over sigma.
            L: Errors that rows share, over sigma; None if there are none.
        """
        problem, of_points = self._problem, test[self._of_points[test]]
        others = test[~self._of_points[test]]
        unknown = ~np.isfinite(self.leverage[others])
        outlier = self._robust_weights(others) < OUTLIER_WEIGHT
        outliers = OutlierCounts()
        if self._robust:
            fitted = self.fitted.rows
            counted = (others[outlier], others, fitted[self.weight[fitted] < OUTLIER_WEIGHT], fitted)
            outliers = OutlierCounts(*(len(np.unique(self._table.measurement[rows])) for rows in counted))
        others = others[~unknown & ~outlier]
        rows = np.concatenate([others, of_points])
        means, covariance = 1.0 + np.nan_to_num(self.leverage[rows]), None
        if np.isin(others, kept).all():
            here, half = np.searchsorted(kept, others), _half(self._spread.actual)
            covariance = _LowRank(J[here] @ half, None if L is None else L[here])
            if len(of_points):
                touched = predicted_points(problem, self._solution.parameters, half, self._table, of_points)
                covariance = covariance.beside(_LowRank(*touched))
            means = covariance.diagonal
            covariance = covariance.over(np.sqrt(means))
            self.studentised[of_points] /= np.sqrt(means[len(others) :])
        part = self._part(rows, squares[rows] / means, np.ones(len(rows)), covariance)
        for kind in self._solution.estimated_noise or ():
            code = FAMILIES.index(kind)
            part.behind[code] = max(1.0, self.fitted.degrees(self.fitted.of_kind(code)))
        return part, outliers, int(np.sum(unknown))

    def _robust_weights(self, rows: Integers) -> Floats:
        """The weights that the loss would give to predicted rows, shape (n,)."""
        problem = self._problem
        if not self._robust or not len(rows):
            return np.ones(len(rows))
        loss, measurement = problem.options.loss, self._table.measurement[rows]
        e, height = lengths(problem, self._solution.parameters, of_test=True)
        n = len(e)
        more = np.bincount(measurement, self.leverage[rows], n) / np.maximum(np.bincount(measurement, minlength=n), 1)
        c = np.array([tuning(loss, max(h, 1)) for h in range(height.max(initial=0) + 1)])[height]
        out: Floats = weight(loss, e / np.sqrt(1.0 + np.nan_to_num(more)), c)[measurement]
        return out

    def _read(self, keep: Booleans) -> tuple[Loadings | None, Floats]:
        """Leverage of every row; shared errors (None without any) and derivatives over sigma of the rows to keep."""
        table, problem = self._table, self._problem
        parameters = self._solution.parameters
        block, chain = all_rows(problem, parameters), problem.variables.chain.at(parameters)
        loadings = _loadings(problem, parameters) if self._shared and keep.any() else None
        columns = _first_code(problem)
        self.leverage = np.full(table.n, np.nan)
        shared, derivatives = [], [np.zeros((0, chain.n_columns))]
        for start in range(0, block.n, _CHUNK):
            first, last = np.searchsorted(table.measurement, (start, min(start + _CHUNK, block.n)))
            rows = slice(int(first), int(last))
            part = residuals.rows_of(block, slice(start, start + _CHUNK))
            J = residuals.linearise(part, chain)[1]  # (n, height, n_columns)
            grid = (table.measurement[rows] - start) * block.height + (table.kind_code[rows] - columns)
            flat = J.reshape(J.shape[0] * block.height, J.shape[2])[grid] / table.sigma[rows, None]  # (rows, n_columns)
            leverage = np.einsum("ij,ij->i", flat @ self._spread.tangent, flat)
            leverage[table.test[rows]] = self._spread.variance(flat[table.test[rows]])
            self.leverage[rows] = leverage
            here = keep[rows]
            derivatives.append(flat[here])
            if loadings is not None:
                shared.append(loadings(part)[grid[here]].multiply(1.0 / table.sigma[rows][here, None]).tocsr())
        self.leverage[~np.isfinite(self.leverage)] = np.nan
        L = scipy.sparse.csr_array(scipy.sparse.vstack(shared)) if shared else None
        return L, np.concatenate(derivatives)

    def _residual_covariance(self, fitted: Integers, J: Floats, L: Loadings | None) -> _LowRank | _Dense:
        """Of the fitted rows, from their derivatives and shared errors over sigma."""
        if self._carried or L is None:
            return _LowRank(J @ _half(self._spread.tangent), L, sign=-1.0)
        LLt = (L @ L.T).toarray()
        C = LLt + np.diag(np.maximum(1.0 - np.diag(LLt), 0.0))
        measurement = self._table.measurement[fitted]
        weighted_as = np.where(measurement[:, None] == measurement, C, 0.0)
        WJ = np.linalg.solve(weighted_as, J)
        K = self._spread.weighted
        X = J @ (K @ (WJ.T @ C))
        covariance = K + K @ (WJ.T @ ((C - weighted_as) @ WJ)) @ K
        return _Dense(C - X - X.T + J @ covariance @ J.T)


class _LowRank:
    """Covariance `D + L L^T + sign P P^T` of standardised residuals.

    Args:
        P: Shape (n, n_columns).
        L: Sparse, shape (n, n_shared); None for zero.
        own: Diagonal of D, shape (n,); what L leaves of 1 if None.
        sign: 1, or -1 for rows that P was fitted to.
    """

    def __init__(self, P: Floats, L: Loadings | None, own: Floats | None = None, sign: float = 1.0) -> None:
        self._P, self._L, self._sign = P, L, sign
        self._p = sign * np.sum(P * P, axis=1)
        self._l = np.zeros(len(P)) if L is None else np.asarray(L.multiply(L).sum(axis=1)).ravel()
        self._d = np.maximum(1.0 - self._l, 0.0) if own is None else own

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        out: Floats = self._d + self._l + self._p
        return out

    def over(self, scale: Floats) -> _LowRank:
        """The same of rows divided by a scale, shape (n,)."""
        by = 1.0 / scale
        L = None if self._L is None else scipy.sparse.csr_array(scipy.sparse.diags_array(by) @ self._L)
        return _LowRank(self._P * by[:, None], L, self._d * by**2, self._sign)

    def dense(self, rows: Integers) -> tuple[Floats, Floats]:
        """The part at `rows`, and what its D lacks to be `PRIVATE_SHARE` of the noise."""
        P, d, of_l = self._P[rows], self._d[rows], self._l[rows]
        A = np.diag(d) + self._sign * (P @ P.T)
        if self._L is not None:
            A += (self._L[rows] @ self._L[rows].T).toarray()
        return A, np.maximum(PRIVATE_SHARE * (d + of_l) - d, 0.0)

    def beside(self, other: _LowRank) -> _LowRank:
        """This one's rows, then those of another that may have further columns of P, and an L of its own."""
        more = other._P.shape[1] - self._P.shape[1]
        P = np.vstack([np.pad(self._P, ((0, 0), (0, more))), other._P])
        parts = (scipy.sparse.csr_array((len(c._P), 0)) if c._L is None else c._L for c in (self, other))
        L = scipy.sparse.block_diag(list(parts), format="csr")
        return _LowRank(P, L, np.concatenate([self._d, other._d]), self._sign)

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at `rows`."""
        P, p, of_l, d = self._P[rows], self._p[rows], self._l[rows], self._d[rows]
        square = np.sum(d * d) + 2.0 * np.sum(d * (of_l + p)) + np.sum((P.T @ P) ** 2)
        if self._L is not None:
            L = self._L[rows]
            square += (L.T @ L).power(2).sum() + 2.0 * self._sign * np.sum((L.T @ P) ** 2)
        return float(np.sum(d + of_l + p)), float(square)


class _Dense:
    """Covariance of standardised residuals, shape (n, n)."""

    def __init__(self, A: Floats) -> None:
        self._A = A

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        return np.diag(self._A).copy()

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at `rows`."""
        A = self._A[np.ix_(rows, rows)]
        return float(np.trace(A)), float(np.sum(A * A))


def upper_probability(ratio: float, nu: float, behind: float = np.inf) -> float:
    """Probability that a sum of squares exceeds its mean by a factor.

    Args:
        ratio: The factor.
        nu: Degrees of freedom of the sum.
        behind: Degrees of freedom that the variance in its mean was estimated from.
    """
    if np.isfinite(behind):
        return float(special.fdtrc(nu, behind, ratio))
    return float(special.gammaincc(nu / 2.0, nu / 2.0 * ratio))


def _half(covariance: Floats) -> Floats:
    """H with H H^T a covariance, shape (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    out: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return out


def _loadings(problem: Problem, parameters: Floats) -> Callable[[Block], Loadings]:
    """How rows in [m] and [rad] follow from errors of 1 sigma that they share, sparse (n * height, ...)."""
    m, chain = problem.measurements, problem.variables.chain.at(parameters)
    if problem.pairs is not None:
        pairs = pair_rows(problem, parameters)
        return lambda part: pairs.loadings(part, problem.common)
    factors = np.repeat(np.array(problem.adjustment.factors)[list(POSE_MODELS[problem.options.model])], 3)

    def of_joints(part: Block) -> scipy.sparse.csr_array:
        assert isinstance(part, PoseBlock)
        J = np.concatenate([J for _, J in joint_rows(part, chain, m.sigma_joint)])  # (n, height, n_joints)
        J = J * factors[:, None]
        n, height, n_joints = J.shape
        columns = np.broadcast_to(part.rows[:, None, None] * n_joints + np.arange(n_joints), J.shape)
        shape = (n * height, m.n_configurations * n_joints)
        return scipy.sparse.csr_array((J.ravel(), columns.ravel(), np.arange(n * height + 1) * n_joints), shape=shape)

    return of_joints


def _n_measured(problem: Problem) -> int:
    """Number of pairs or poses, train and test: what comes after them in a residual table are touches."""
    return problem.measurements.n_configurations if problem.pairs is None else problem.pairs.n_pairs


def _first_code(problem: Problem) -> int:
    """Code in `ROW_KINDS` of a measurement's first row."""
    model = problem.options.model
    if problem.pairs is not None:
        return 0 if PAIR_MODELS[model][0] else 1
    return ROW_KINDS.index("orientation.x" if POSE_MODELS[model][0] else "position.x")


def _factors(problem: Problem) -> Floats:
    """What the stated sigma of each of `FAMILIES` is multiplied by."""
    factors = problem.adjustment.factors
    return np.array([*factors, 1.0, 1.0, 1.0] if problem.pairs is not None else [1.0, 1.0, *factors, 1.0])


def _is_same_point(problem: Problem, table: ResidualTable) -> Booleans:
    """Distances that stand for three coordinates of one point, shape (n,)."""
    if problem.judgement is None or not problem.judgement.same_point.any():
        return np.zeros(table.n, dtype=np.bool_)
    same = problem.judgement.same_point
    out: Booleans = np.zeros(table.n, dtype=np.bool_)
    of_pairs = table.measurement < len(same)
    out[of_pairs] = same[table.measurement[of_pairs]]
    out &= table.family == FAMILIES.index("distance")
    return out
