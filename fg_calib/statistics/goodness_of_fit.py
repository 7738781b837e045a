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

Rows that were predicted, never fitted, miss by their own noise and by what the estimate is off: `A = C + J Cov J^T`,
less what both have from errors of configurations that fitted rows took part in as well (`Errors.of_prediction`).
Each kind is judged by the sum of its studentised squares. All of them together are judged by `r^T A^-1 r`, which
sees what misses where the arm is well known although it may be off by more elsewhere. Where the noise was estimated,
this is a ratio of two variances (F); with a robust loss measurements that it would call outliers count for nothing.

A point that test rows alone touched is taken for the mean of what touched it, at B e with e the rows without it. With N
the derivatives of all rows in such points, `N B e` is what this adds to them, to derivatives and errors alike.

References:
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from pydantic import computed_field
from scipy import special

from fg_calib.arrays import Booleans, Figure, Floats, FrozenArrays, Integers
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.information import eliminated
from fg_calib.graph.noise import JOINT_NOISE, NoiseName
from fg_calib.graph.problem import Problem, mahalanobis_distances, noises_at
from fg_calib.graph.robust import effect, tuning, weight
from fg_calib.graph.solver import Solution
from fg_calib.measurements.residuals import squares_along
from fg_calib.robot.kinematics import SPAN
from fg_calib.statistics.covariance import Spread
from fg_calib.statistics.gross_errors import MOST_FEW, find_gross_errors
from fg_calib.statistics.low_rank import Dense, LowRank
from fg_calib.statistics.prior_consistency import PriorFit
from fg_calib.statistics.residual_covariance import Errors, Nuisances, half_of
from fg_calib.statistics.residual_table import ALARM, ResidualTable, suspect_level

Codes = NDArray[np.int8]
Loadings = scipy.sparse.csr_array

MAX_DENSE = 3000
"""Rows up to which the covariance of residuals is formed where they are weighted as independent but are not."""

MAX_KEPT = 300_000
"""Rows up to which derivatives and shared errors are kept, to look at parts of them again."""

MAX_WHITENED = 1000
"""Predicted rows up to which all are whitened together; of more, so many that are evenly spaced."""

OUTLIER_WEIGHT = 0.5
"""A row with a robust weight below this is an outlier."""

FLAGS = ("", "suspect", "outlier", "excluded", "test")
"""What is said of a row, in the order of the codes."""

LEAST_VARIANCE = 1e-6
"""Variance of a residual, over that of its noise, below which the row is met whatever was measured."""

MAX_TOGETHER = 200
"""Rows of one configuration up to which they may be one gross error."""

LEAST_GAIN = 0.3
"""Part of the excess of chi-square that is left at most without outliers, where more than these is wrong."""

_CHUNK, _FEW = 4 * SPAN, SPAN // 4

_MEDIAN = 0.6744897501960817
"""Median of the size of a standard normal figure."""


@dataclass(frozen=True)
class KindFit:
    """The fitted rows of one kind of noise.

    Attributes:
        kind: `distance`, `angle`, `orientation`, `position`, `point`, or that of a kind of one's own.
        unit: `m`, `rad` or `px`.
        n: Number of scalar rows.
        stated_sigma_rms: Root of the mean square of their sigmas as stated.
        factor: What they were multiplied by, all noise together: 1 unless the noise was estimated.
        seen_over_stated: Noise seen over noise stated; nan where the fit leaves less than one degree of freedom.
        chi2: Sum of squared residuals over sigma, as it was taken.
        expected: Its mean, were the noise as taken: the rows' redundancy.
        p_value: Probability of a sum as large, were the noise as taken; None where it is not known.
        typical: Noise seen over noise taken, from the median, which a few rows do not move.
        largest: The largest |studentised residual|; nan where it is not known.
        degrees: Degrees of freedom of chi-square.
        table: Number of its table.
        n_beyond: Rows with a |studentised residual| that none of a clean table has (`suspect_level`).
        spoilt: Whether rows of this kind are among the gross errors themselves.
        rest: The same of the rows without gross errors; None where there are none, or not few.
        own_sigma_rms: Root of the mean square of the sigmas as stated without the joints' noise; nan if not asked for.
        own_factor: What these were multiplied by.
    """

    kind: str
    unit: str
    n: int
    stated_sigma_rms: Figure
    factor: Figure
    seen_over_stated: Figure
    chi2: Figure
    expected: Figure
    p_value: float | None
    typical: Figure
    largest: Figure
    degrees: Figure
    table: int = 0
    n_beyond: int = 0
    spoilt: bool = False
    rest: KindFit | None = None
    own_sigma_rms: Figure = np.nan
    own_factor: Figure = 1.0

    @computed_field  # type: ignore[prop-decorator]
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
        if self.rest is not None and (without := self._without_gross_errors(self.rest)):
            return without
        far = self.largest > suspect_level(self.n) * np.sqrt(max(self.typical, 1.0) * ratio)
        if share > 0.65 or not far:
            return "too small"  # the median of few rows varies: perhaps none of them is far from the others
        many = self.n_beyond > MOST_FEW * self.n
        return "many" if many else "outliers" if share < 0.35 else "both"

    def _without_gross_errors(self, rest: KindFit) -> str:
        """What is said where gross errors are known; empty if they are not what is wrong."""
        if rest.verdict in ("as stated", "too large"):
            return "outliers" if self.spoilt else "others"
        gain = (self.seen_over_stated**2 - 1.0) * LEAST_GAIN
        return "both" if rest.seen_over_stated**2 - 1.0 < gain else ""


VERDICTS = {
    "as stated": "as stated",
    "too large": "noise stated too large",
    "too small": "most rows too large: noise stated too small, or effects not modelled",
    "outliers": "few rows far too large: outliers",
    "others": "as stated once the outliers are left out",
    "both": "noise stated too small or effects not modelled, and outliers",
    "many": "many rows far too large: something changed between them, or effects not modelled",
    "unknown": "too few rows to tell",
}
"""What a fit by kind means, in words."""

PREDICTION_VERDICTS = VERDICTS | {
    "as stated": "as expected",
    "too large": "smaller than expected",
    "too small": "most rows too large",
    "outliers": "few rows far too large",
    "others": "too large because of outliers of another kind",
    "both": "many rows too large, and few far too large",
    "many": "many rows far too large",
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
    chi2: Figure
    expected: Figure


@dataclass(frozen=True)
class GrossErrors:
    """The few measurements that spoil a fit.

    Attributes:
        n: How many there are.
        names: Of their configurations and groups, or of the pairs' two, the worst first.
        ratio: Reduced chi-square without them.
    """

    n: int
    names: tuple[str, ...]
    ratio: float


class OutlierCounts(NamedTuple):
    """Test and fitted measurements, and those among them that a robust loss takes for outliers; zeros without one."""

    test: int = 0
    of_test: int = 0
    fitted: int = 0
    of_fitted: int = 0


@dataclass(frozen=True)
class PredictedFit(FrozenArrays):
    """How well the calibrated arm predicts the test rows.

    Attributes:
        kinds: The fit by kind; here chi-square is the sum of the squares of residuals over their own sigma, what the
            estimate may be off included.
        n_rows: Number of scalar rows.
        n: Number of them behind chi-square: evenly spaced ones if there are many to be whitened (`MAX_WHITENED`).
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
    chi2: Figure
    expected: Figure
    p_value: Figure
    suspects: Integers
    configurations: tuple[SuspectConfiguration, ...]


@dataclass(frozen=True)
class Goodness(FrozenArrays):
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
        gross: The few gross errors that spoil the fit; None if there are none, or it cannot be told.
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
    gross: GrossErrors | None = None

    def unknown(self, table: ResidualTable) -> Booleans:
        """Predicted rows that depend on what neither data nor priors determine, shape (n,)."""
        found: Booleans = table.test & (table.reason_code == 0) & ~np.isfinite(self.leverage)
        return found

    @property
    def spoilt(self) -> bool:
        """Whether a few gross errors are all that is wrong with the fit."""
        fine = ("as stated", "too large", "outliers", "others", "unknown")
        return self.gross is not None and all(kind.verdict in fine for kind in self.kinds)


@dataclass(frozen=True)
class Fit:
    """How well a solution fits.

    Attributes:
        chi_square: Chi-square of the fitted rows and the priors.
        residuals: Every residual, before and after.
        goodness: Goodness of fit by kind, by row and by configuration.
        priors: Corrections against prior sigmas; None without priors.
    """

    chi_square: ChiSquare
    residuals: ResidualTable
    goodness: Goodness
    priors: PriorFit | None


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


def gross_errors(solution: Solution, spread: Spread, table: ResidualTable) -> Booleans | None:
    """Rows of the table that spoil the fit, few of it, shape (n,); None if there are none, or it cannot be told.

    Args:
        solution: The solution, or parameters near which the problem is linear.
        spread: The covariance there.
        table: The residuals there.
    """
    return _Rows(solution, spread, table).gross_errors()


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
    covariance: LowRank | Dense | None
    shared: bool
    judged: bool
    n_ends: int
    behind: Floats

    def of_kind(self, code: int) -> Integers:
        """Places in the part of one of the table's groups."""
        return np.flatnonzero(self.table.group[self.rows] == code)

    def degrees(self, chosen: Integers) -> float:
        """Degrees of freedom of some rows; where that is not known, no more than one configuration's errors."""
        if self.covariance is not None:
            trace, square = self.covariance.moments(chosen)
        else:
            v = self.means[chosen]
            trace = float(np.sum(v))
            v *= v
            square = float(np.sum(v))
        nu = trace**2 / square if square > 0.0 else 1.0
        return nu if self.covariance is not None or not self.shared else min(nu, 3.0)

    def p_value(self, chosen: Integers, chi2: float, degrees: float) -> float:
        """Probability of a sum of squares as large, with the rows' `degrees` of freedom."""
        ratio = chi2 / float(np.sum(self.means[chosen]))
        return upper_probability(ratio, degrees, self.degrees_behind(chosen))

    def degrees_behind(self, chosen: Integers) -> float:
        """Degrees of freedom behind the noise that some rows were divided by."""
        if not np.isfinite(self.behind).any():
            return np.inf
        by_kind = np.bincount(self.table.group[self.rows[chosen]], self.means[chosen], len(self.table.groups))
        variance = float(np.sum(by_kind**2 / self.behind))
        return float(np.sum(by_kind)) ** 2 / variance if variance > 0.0 else np.inf

    def configurations(self) -> tuple[SuspectConfiguration, ...]:
        """Configurations whose rows are too large together, the least likely first."""
        if not self.judged:
            return ()  # outliers have been found already
        place, end = self.table.row_ends(self.rows)
        chi2, expected = (np.bincount(end, v[place], self.n_ends) for v in (self.squares, self.means))
        count = np.bincount(end, minlength=self.n_ends)
        looked_at = np.flatnonzero(expected > 1e-3)
        limit = ALARM / max(1, len(looked_at))
        # No effective number of degrees of freedom is below 1, where the tail is heaviest.
        least = 2.0 * special.erfcinv(limit) ** 2
        found = []
        for k in looked_at[chi2[looked_at] > least * expected[looked_at]]:
            nu = max(1.0, self.degrees(np.unique(place[end == k])))
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
        fitted: The rows fitted.
        predicted: The rows predicted that can be judged.
    """

    def __init__(self, solution: Solution, spread: Spread, table: ResidualTable) -> None:
        problem = self._problem = solution.problem
        self._table = table
        self._spread = spread
        self._solution = solution
        self._noises = solution.noises
        self._robust = problem.state.weights is not None
        self.weight: Floats = np.broadcast_to(1.0, table.n)
        if self._robust:
            self.weight = np.ones(table.n)
        for number, weights in enumerate(problem.state.weights or ()):
            mine = table.series == number
            self.weight[mine] = weights[table.measurement[mine]]
        fitted, test = np.flatnonzero(table.used), np.flatnonzero(table.test & (table.reason_code == 0))
        self._shared = any(noise.sources for noise in self._noises)
        self._carried = not problem.missing_correlation
        most = MAX_KEPT if self._carried and self._shared else MAX_DENSE
        keep = np.zeros(table.n, dtype=np.bool_)
        keep[fitted] = len(fitted) <= most and not self._robust
        keep[test] = len(test) <= MAX_KEPT
        of_kept = np.flatnonzero(keep)
        all_kept = self._read(keep)
        w = self.weight
        variance = np.where(table.used, 1.0 - 2.0 * w, 1.0)  # in place, as of a million rows each array counts
        variance *= self.leverage
        variance += 1.0
        covariance, self._errors = None, None
        if keep[fitted].all():
            self._errors = all_kept.at(np.searchsorted(of_kept, fitted))
            covariance = self._residual_covariance(fitted, self._errors)
        if isinstance(covariance, Dense):
            variance[fitted] = covariance.diagonal
        self.studentised = np.sqrt(np.maximum(variance, 1e-12))
        with np.errstate(invalid="ignore", divide="ignore"):
            self.studentised *= table.sigma
            np.divide(table.after, self.studentised, out=self.studentised)
        self.studentised[variance < LEAST_VARIANCE] = np.nan
        squares = table.after / table.sigma
        squares *= squares
        of_test = squares[test]
        if self._robust:
            squares, variance = w * squares, w * variance
        if len(fitted) < table.n:
            squares, variance = squares[fitted], variance[fitted]
        self.fitted = self._part(fitted, squares, variance, covariance)
        self.predicted, self._outliers, self._n_unknown = self._predict(test, of_test, of_kept, all_kept)

    def kinds(self) -> tuple[KindFit, ...]:
        """The fit of the fitted rows by kind."""
        part, groups = self.fitted, range(len(self._table.groups))
        excess = np.zeros(len(groups))
        if not self._carried and part.covariance is None:
            leverage = self.weight[part.rows] * self.leverage[part.rows]
            by_kind = np.array([np.nansum(leverage[part.of_kind(code)]) for code in groups])
            excess = self._spread.excess * by_kind / by_kind.sum() if by_kind.sum() > 0.0 else excess
        known = not self._robust and self._solution.estimated_noise is None
        known &= part.covariance is not None or not self._shared
        found = (self._kind(part, code, float(excess[code]), known) for code in groups)
        return tuple(fit for fit in found if fit is not None)

    def gross_errors(self) -> Booleans | None:
        """Rows of the table that spoil the fit, few of it; None if there are none, or it cannot be told."""
        problem, rows = self._problem, self.fitted.rows
        if self._robust or not self._carried or self._errors is None:
            return None
        unknowns = self._spread.rank + self._errors.own.shape[1]
        dof = problem.n_independent + problem.n_priors + problem.n_added + problem.n_known - unknowns
        z = self._table.after[rows] / self._table.sigma[rows]
        found = find_gross_errors(
            z,
            self._errors,
            self._spread.tangent,
            self._units(),
            dof,
            prior_rows(problem.variables, self._solution.parameters),
        )
        if found is None:
            return None
        out = np.zeros(self._table.n, dtype=np.bool_)
        out[rows[found]] = True
        return out

    def _units(self) -> list[Integers]:
        """Places among the fitted rows of what may be one gross error: a measurement, all of one configuration."""
        rows = self.fitted.rows
        _, of = np.unique(self._measurement(rows), return_inverse=True)
        order = np.argsort(of, kind="stable")
        units = np.split(order, np.flatnonzero(np.diff(of[order])) + 1)
        ends = np.concatenate([self._table.a[rows], self._table.b[rows]])
        place = np.tile(np.arange(len(rows)), 2)[ends >= 0]
        ends = ends[ends >= 0]
        order = np.argsort(ends, kind="stable")
        of_ends = np.split(place[order], np.flatnonzero(np.diff(ends[order])) + 1)
        most = min(MAX_TOGETHER, MOST_FEW * len(rows))
        several = [those for those in of_ends if len(those) <= most and len(np.unique(of[those])) > 1]
        return [*units, *(np.unique(those) for those in several)]

    def predicted_fit(self, suspects: Integers) -> PredictedFit | None:
        """The fit of the predicted rows; None without any that can be judged.

        Args:
            suspects: The rows of the table among them that are too large.
        """
        part = self.predicted
        if not (len(part.rows) or self._outliers.test):
            return None
        chosen = self._chosen(part)
        chi2, expected, nu = self._whitened(part, chosen)
        behind = part.degrees_behind(np.arange(len(part.rows)))
        found = (self._kind(part, code, 0.0, True) for code in range(len(self._table.groups)))
        return PredictedFit(
            kinds=tuple(fit for fit in found if fit is not None),
            n_rows=len(part.rows),
            n=len(chosen),
            outliers=self._outliers,
            n_unknown=self._n_unknown,
            chi2=chi2,
            expected=expected,
            p_value=upper_probability(chi2 / expected, nu, behind) if len(part.rows) else 1.0,
            suspects=suspects,
            configurations=part.configurations(),
        )

    def _chosen(self, part: _Part) -> Integers:
        """Which of the predicted rows are looked at together: of many that are whitened some, evenly spaced."""
        n = len(part.rows)
        if part.covariance is None:
            return np.arange(n)
        return np.unique(np.linspace(0, n - 1, min(n, MAX_WHITENED)).round().astype(np.int64))

    def _whitened(self, part: _Part, chosen: Integers) -> tuple[float, float, float]:
        """Sum of the squares of the chosen predicted rows, whitened together; its mean, and its degrees of freedom.

        What pairs formed from poses do not share counts as `PRIVATE_SHARE` of their variance at least, as in the fit.
        """
        if not isinstance(part.covariance, LowRank) or not len(chosen):
            return float(np.sum(part.squares)), float(np.sum(part.means)), part.degrees(chosen)
        z = np.sign(self._table.after[part.rows[chosen]]) * np.sqrt(part.squares[chosen])
        return part.covariance.at(chosen).whitened(z)

    def _part(self, rows: Integers, squares: Floats, means: Floats, covariance: LowRank | Dense | None) -> _Part:
        behind = np.full(len(self._table.groups), np.inf)
        n_ends = len(self._table.names)
        return _Part(self._table, rows, squares, means, covariance, self._shared, not self._robust, n_ends, behind)

    def _kind(self, part: _Part, code: int, excess: float, known: bool) -> KindFit | None:
        """The fit of one of the table's groups, whose chi-square has a mean lower by `excess`; None without rows."""
        chosen = part.of_kind(code)
        if not len(chosen):
            return None
        chi2, expected = float(np.sum(part.squares[chosen])), float(np.sum(part.means[chosen])) - excess
        rows, (table, family) = part.rows[chosen], self._table.groups[code]
        factor = self._factor(rows, (table, family))
        enough, degrees = expected >= 1.0, part.degrees(chosen)
        size = np.abs(self.studentised[rows])
        n_beyond, largest = int(np.sum(size > suspect_level(len(rows)))), float(np.nanmax(size)) if enough else np.nan
        typical = float(np.nanmedian(size, overwrite_input=True)) / _MEDIAN if enough else np.nan
        return KindFit(
            kind=family,
            table=table,
            unit=self._table.unit(family),
            n=len(rows),
            stated_sigma_rms=float(np.sqrt(np.mean(self._table.sigma[rows] ** 2))) / factor,
            factor=factor,
            seen_over_stated=factor * float(np.sqrt(chi2 / expected)) if enough else np.nan,
            chi2=chi2,
            expected=max(expected, 0.0),
            p_value=part.p_value(chosen, chi2, degrees) if enough and known else None,
            typical=typical,
            largest=largest,
            degrees=degrees,
            n_beyond=n_beyond,
            own_sigma_rms=float(np.sqrt(np.mean(self._stated[1][rows] ** 2))),
            own_factor=self._problem.state.factors.get((table, family), 1.0),
        )

    def _factor(self, rows: Integers, group: NoiseName) -> float:
        """What the sigmas of rows of one group were multiplied by: RMS sigma as taken over RMS sigma as stated."""
        if group not in self._with_joint_noise:
            return self._problem.state.factors.get(group, 1.0)
        as_taken, as_stated = (float(np.mean(sigma[rows] ** 2)) for sigma in (self._table.sigma, self._stated[0]))
        return float(np.sqrt(as_taken / as_stated))

    @cached_property
    def _with_joint_noise(self) -> frozenset[NoiseName]:
        """Groups of rows that have noise of the joint readings."""
        return frozenset(
            (noise.series.table, name.partition(".")[0])
            for noise in self._noises
            if any(source.name == "joints" and source.loading.any() for source in noise.sources)
            for name in noise.series.kind.names
        )

    @cached_property
    def _stated(self) -> tuple[Floats, Floats]:
        """1 sigma of each row of the table with all noise as stated, and that without the joints', shapes (n,)."""
        problem, table, noises, total = self._problem, self._table, self._noises, self._table.sigma
        if problem.state.factors:
            as_stated = replace(problem, state=replace(problem.state, factors={}))
            noises = noises_at(as_stated, self._solution.parameters, at_readings=True)
            total = np.concatenate([noise.sigma[noise.series.measured] for noise in noises])
        if not self._with_joint_noise:
            return total, total
        own = total**2
        for number, noise in enumerate(noises):
            for source in noise.sources:
                if source.name == "joints":
                    own[table.rows_of(number)] -= np.einsum("nii->ni", source.variance)[noise.series.measured]
        return total, np.sqrt(np.maximum(own, 0.0))

    def _predict(
        self, test: Integers, squares: Floats, kept: Integers, of_kept: Errors
    ) -> tuple[_Part, OutlierCounts, int]:
        """The predicted rows that can be judged; `PredictedFit.outliers`, and how many rows are not known.

        Args:
            test: Predicted rows of the table.
            squares: Their squared residuals over sigma.
            kept: Rows of the table that `of_kept` is of.
            of_kept: What these follow from.
        """
        unknown = ~np.isfinite(self.leverage[test])
        outlier = self._robust_weights(test) < OUTLIER_WEIGHT
        outliers = OutlierCounts()
        if self._robust:
            fitted = self.fitted.rows
            counted = (test[outlier], test, fitted[self.weight[fitted] < OUTLIER_WEIGHT], fitted)
            outliers = OutlierCounts(*(len(np.unique(self._measurement(rows))) for rows in counted))
        judged = ~unknown & ~outlier & ~(self.leverage[test] < LEAST_VARIANCE - 1.0)
        rows = test[judged]
        means, covariance = 1.0 + self.leverage[rows], None
        if np.isin(rows, kept).all():
            found = of_kept.at(np.searchsorted(kept, rows))
            covariance = found.of_prediction(self._spread.tangent, self._spread.actual)
            means = covariance.diagonal
            covariance = covariance.over(np.sqrt(means))
            with np.errstate(invalid="ignore"):
                size = self._table.sigma[rows] * np.sqrt(means)
            self.studentised[rows] = self._table.after[rows] / size
        part = self._part(rows, squares[judged] / means, np.ones(len(rows)), covariance)
        estimated = set(self._solution.estimated_noise or ())
        for code, group in enumerate(self._table.groups):
            if group in estimated or (JOINT_NOISE in estimated and group in self._with_joint_noise):
                part.behind[code] = max(1.0, self.fitted.degrees(self.fitted.of_kind(code)))
        return part, outliers, int(np.sum(unknown))

    def _measurement(self, rows: Integers) -> Integers:
        """A number for the measurement of each of some rows."""
        out: Integers = self._table.series[rows].astype(np.int64) * 2**32 + self._table.measurement[rows]
        return out

    def _robust_weights(self, rows: Integers) -> Floats:
        """The weights that the loss would give to predicted rows, shape (n,)."""
        out, table = np.ones(len(rows)), self._table
        for number, noise in enumerate(self._noises if self._robust else ()):
            mine = np.flatnonzero(table.series[rows] == number)
            measurement = table.measurement[rows[mine]]
            e, residual_dim = noise.lengths()
            n = len(e)
            count = np.maximum(np.bincount(measurement, minlength=n), 1)
            more = np.bincount(measurement, np.nan_to_num(self.leverage[rows[mine]]), n) / count
            loss = self._problem.options.loss
            c = np.array([tuning(loss, max(h, 1)) for h in range(residual_dim.max(initial=0) + 1)])[residual_dim]
            out[mine] = weight(loss, e / np.sqrt(np.maximum(1.0 + more, LEAST_VARIANCE)), c)[measurement]
        return out

    def _read(self, keep: Booleans) -> Errors:
        """Leverage of every row; what the rows to keep follow from, over sigma."""
        table = self._table
        nuisances = Nuisances(self._problem, self._solution.parameters, self._noises)
        self.leverage = np.full(table.n, np.nan)
        kept, half = [], half_of(self._spread.tangent)
        asked = keep | table.test
        for number, noise in enumerate(self._noises):
            measured, last = noise.series.measured, table.rows_of(number).start
            step = _CHUNK if nuisances.none_in(number) else _FEW
            for start in range(0, noise.series.n, step):
                chunk = slice(start, min(start + step, noise.series.n))
                first, last = last, last + int(np.sum(measured[chunk]))
                rows = slice(first, last)
                if nuisances.none_in(number) and not asked[rows].any():  # they follow from the core and own noise alone
                    moments = noise.moments_at(chunk)
                    squares = squares_along(noise.rows_at(chunk, moments), nuisances.chain(number), half)
                    of_rows = (squares + np.maximum(moments.variance, 0.0))[measured[chunk]]
                    self.leverage[rows] = of_rows / table.sigma[rows] ** 2 - 1.0
                    continue
                grid = np.flatnonzero(measured[chunk])
                found = nuisances.errors(number, np.arange(chunk.start, chunk.stop)).at(grid).over(table.sigma[rows])
                leverage = np.einsum("ij,ij->i", found.J @ self._spread.tangent, found.J)
                leverage[table.test[rows]] = self._spread.variance(found.J[table.test[rows]])
                self.leverage[rows] = leverage + np.sum(found.own**2, axis=1) + (found.of_noise - 1.0)
                kept.append(found.at(np.flatnonzero(keep[rows])))
        self.leverage[~np.isfinite(self.leverage)] = np.nan
        return Errors.of_all(kept or [nuisances.nothing()])

    def _residual_covariance(self, fitted: Integers, found: Errors) -> LowRank | Dense:
        """Of the fitted rows, from what they follow from."""
        if self._carried:
            return found.of_fit(self._spread.tangent)
        C = (found.L @ found.L.T).toarray() + np.diag(found.private)
        measurement = self._measurement(fitted)
        weighted_as = np.where(measurement[:, None] == measurement, C, 0.0)
        J = np.hstack([found.J, found.own])
        WJ = np.linalg.solve(weighted_as, J)
        K = scipy.linalg.block_diag(self._spread.tangent, np.eye(found.own.shape[1]))
        X = J @ (K @ (WJ.T @ C))
        covariance = K + K @ (WJ.T @ ((C - weighted_as) @ WJ)) @ K
        return Dense(C - X - X.T + J @ covariance @ J.T)


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
    def reduced(self) -> float | None:
        """Chi-square over its degrees of freedom; None without any."""
        return self.value / self.dof if self.dof > 0 else None

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
