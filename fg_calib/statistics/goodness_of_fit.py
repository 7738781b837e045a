"""Goodness of fit: do the residuals look like the specified noise, kind by kind, row by row?

With C the covariance of the rows' noise, J their derivatives and Cov the covariance of a generalised least-squares
estimate (priors included), the residuals have covariance `A = C - J Cov J^T`, whatever errors the rows share (see
`residual_covariance`). So the *leverage* of a row, `J_i Cov J_i^T / sigma_i^2`, is what the fit takes off its variance,
and over the rows of one kind

    sum (r_i / sigma_i)^2    has mean  n - sum of leverage,  and variance  2 tr(A^2)  with A in units of sigma.

It is compared with a chi-square distribution of `nu = (tr A)^2 / tr(A^2)` degrees of freedom, scaled to that mean
(Satterthwaite 1946). p-values are upper ones: the probability that the specified noise makes a sum as large; near 0 the
residuals are too large, near 1 too small. A row with robust weight w counts as w rows. There is no p-value where
weights or noise came from the residuals, nor where rows share errors but are weighted as independent: then the mean is
that of all rows, shared among the kinds by leverage.

Rows that were predicted, never fitted, miss by their own noise and by what the estimate is off. Each kind is judged by
the sum of its studentised squares. All of them together are judged by `r^T A^-1 r`, which is sensitive where the arm is
well known although it may be off by more at others. Where the noise was estimated, this is a ratio of two variances
(F); with a robust loss measurements with suspect rows count for nothing.

References:
    Cook, Weisberg (1982), Residuals and Influence in Regression.
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import computed_field
from scipy import special

from fg_calib import measurements, robot
from fg_calib.graph import NoiseState, Solution, effect, mahalanobis_distances, noises_at
from fg_calib.inputs import Booleans, Figure, Floats, FrozenArrays, Integers, Probability, Record
from fg_calib.statistics.covariance import Spread
from fg_calib.statistics.priors import PriorFit
from fg_calib.statistics.residual_covariance import ResidualCovariance, RowModel
from fg_calib.statistics.residual_table import ALARM, MAX_OUTLIER_SHARE, ResidualTable, suspect_level

Codes = NDArray[np.int8]

MAX_INDEPENDENT, MAX_KEPT = 3000, 300_000
"""Rows up to which derivatives are kept, to look at parts of them again: without and with shared errors."""

MAX_WHITENED = 1000
"""Predicted rows up to which all are whitened together; of more, so many that are evenly spaced."""

OUTLIER_WEIGHT = 0.5
"""A row with a robust weight below this is an outlier."""

FLAGS = ("", "suspect", "outlier", "excluded", "test")
"""Flags of a row, in the order of the codes."""

LEAST_VARIANCE = 1e-6
"""Variance of a residual, over that of its noise, below which the row is met whatever was measured."""

CONFIDENCE = 0.999
"""A sum of squares outside this central interval of its distribution is not by chance."""

FACTOR = 2.0
"""A reduced chi-square between 1 / FACTOR and FACTOR is good whatever its distribution: noise is never known better."""

_CHUNK, _CHUNK_WITH_STATES = 4 * robot.SPAN, robot.SPAN // 4
"""Measurements whose rows are linearised at once: those with private noise alone, and others."""

_MEDIAN = 0.6744897501960817
"""Median of the size of a standard normal figure."""


class KindFit(Record):
    """The fitted rows of one kind of noise.

    Attributes:
        kind: `distance`, `angle`, `orientation`, `position`, `point`, or that of a custom kind.
        unit: `m`, `rad` or `px`.
        n: Number of scalar rows.
        specified_sigma_rms: Root mean square of their specified sigmas.
        factor: Factor on them, all noise together: 1 unless the noise was estimated.
        observed_over_specified: Observed over specified noise; nan where less than one degree of freedom is left.
        chi2: Sum of squared residuals over sigma, as it was taken.
        expected: Its mean, were the noise as taken: the rows' redundancy.
        p_value: Probability of a sum as large, were the noise as taken; None where it is not known.
        typical: Observed noise over noise as taken, from the median, which a few rows do not move.
        degrees: Degrees of freedom of chi-square.
        table: Number of its table.
        n_beyond: Rows with a |studentised residual| that none of a clean table has (`level`).
        cause: Why the sum is too large where the other rows are as specified: `outliers` of this kind, or of `others`.
    """

    kind: str
    unit: str
    n: int
    specified_sigma_rms: Figure
    factor: Figure
    observed_over_specified: Figure
    chi2: Figure
    expected: Figure
    p_value: Probability | None
    typical: Figure
    degrees: Figure
    table: int = 0
    n_beyond: int = 0
    cause: str = ""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def verdict(self) -> str:
        """Verdict of the test, as a key of `VERDICTS`."""
        ratio, p = self.observed_over_specified / self.factor, self.p_value
        if not np.isfinite(ratio):
            return "unknown"
        if p is None:  # weights or factors came from the residuals: their spread alone is known
            unlikely = abs(ratio - 1.0) > max(0.2, -special.ndtri(ALARM / 2.0) / np.sqrt(2.0 * self.degrees))
        else:
            unlikely = min(p, 1.0 - p) < ALARM / 2.0
        if not unlikely or abs(ratio - 1.0) < 0.05:
            return "as specified"
        return "too large" if ratio < 1.0 else self.cause or "too small"

    def level(self, n: int) -> float:
        """|studentised residual| above which one of n rows is suspect.

        That of the others' own noise where this is smaller than specified: beyond `t^2 chi2 / (nu - 1 + t^2)` a square
        is beyond the quantile t^2 of its ratio to the others' mean (externally studentised, Cook & Weisberg 1982).
        """
        level, nu = suspect_level(n), self.expected - 1.0
        if self.verdict != "too large" or nu < 1.0:
            return level
        t = float(special.stdtrit(nu, float(special.ndtr(level))))
        return min(level, float(t * np.sqrt(self.chi2 / (nu + t * t))))


VERDICTS = {
    "as specified": "as specified",
    "too large": "noise specified too large",
    "too small": "most rows too large: noise specified too small, or effects not modelled",
    "outliers": "few rows far too large: outliers",
    "others": "as specified once the outliers are left out",
    "unknown": "too few rows to tell",
}
"""Verdict on a fit by kind, in words."""

PREDICTION_VERDICTS = VERDICTS | {
    "as specified": "as expected",
    "too large": "smaller than expected",
    "too small": "larger than expected",
}
"""Verdict on predicted rows."""


class SuspectConfiguration(Record):
    """A configuration whose rows are too large together.

    Attributes:
        id: Its name, or that of a landmark.
        n: Scalar rows that it takes part in.
        chi2: Sum of their squared residuals over sigma.
        expected: Its mean, were the noise as specified.
    """

    id: str
    n: int
    chi2: Figure
    expected: Figure


class GrossErrors(Record):
    """The few measurements that make residuals of a fit too large.

    Attributes:
        n: How many there are.
        names: Of their configurations and groups, or of the pairs' two, the worst first.
        ratio: Reduced chi-square without them; of estimated noise its variance without them over that with them.
    """

    n: int
    names: tuple[str, ...]
    ratio: float


class PredictedFit(FrozenArrays):
    """How well the calibrated arm predicts the test rows.

    Attributes:
        kinds: The fit by kind; here chi-square is the sum of the squares of residuals over their own sigma, what the
            estimate may be off included.
        n_rows: Number of scalar rows.
        n: Number of them behind chi-square: evenly spaced ones if there are many to be whitened (`MAX_WHITENED`).
        n_measurements: Number of test measurements.
        n_outliers: Test measurements that a robust loss passes over as outliers.
        n_unknown: Rows not judged because they depend on what neither data nor priors determine.
        chi2: Sum of the squares of the rows, whitened by their noise and by what the estimate may be off.
        expected: Its mean, were the noise as taken and the arm known as well as is claimed.
        p_value: Probability of a sum as large.
        configurations: Configurations whose rows are too large together, the worst first.
        others: Chi-square of the rows of all others, over its mean.
    """

    kinds: tuple[KindFit, ...]
    n_rows: int
    n: int
    n_measurements: int
    n_outliers: int
    n_unknown: int
    chi2: Figure
    expected: Figure
    p_value: Probability
    configurations: tuple[SuspectConfiguration, ...]
    others: Figure = np.nan

    @property
    def has_outliers(self) -> bool:
        """Whether a few configurations alone make chi-square too large."""
        few = 0 < len(self.configurations) <= MAX_OUTLIER_SHARE * self.n_measurements
        return few and self.others <= FACTOR < self.chi2 / self.expected


class Goodness(FrozenArrays):
    """How well residuals and specified noise agree; arrays are in the order of the residual table, shape (n,).

    Attributes:
        kinds: The fit by kind.
        leverage: Variance of the row's prediction over its noise; nan where it has none.
        studentised: Residual over its own 1 sigma: of a fitted row less its leverage, of a predicted one more.
        weight: Robust weight of each row's measurement.
        flag: Flag of each row, in `FLAGS`.
        level: |studentised| above which a row is suspect.
        suspect: Rows that are too large, and outliers among the fitted ones.
        configurations: Suspect configurations among the fitted rows, the worst first.
        test: The predicted rows; None without any that can be judged.
        gross: The few gross errors in the fit; None if there are none, or it cannot be told.
        searched: Whether these were searched for, as far as the fit asks for it: not among too many rows.
    """

    kinds: tuple[KindFit, ...]
    leverage: Floats
    studentised: Floats
    weight: Floats
    flag: Codes
    level: float
    suspect: Booleans
    configurations: tuple[SuspectConfiguration, ...]
    test: PredictedFit | None
    gross: GrossErrors | None = None
    searched: bool = True

    def unknown(self, table: ResidualTable) -> Booleans:
        """Predicted rows that depend on what neither data nor priors determine, shape (n,)."""
        return table.test & (table.reason_code == 0) & ~np.isfinite(self.leverage)

    @property
    def gross_alone(self) -> bool:
        """Whether a few gross errors are all that is wrong with the fit."""
        return self.gross is not None and all(kind.verdict != "too small" for kind in self.kinds)


class Fit(Record):
    """How well a solution fits.

    Attributes:
        chi_square: Chi-square of the fitted rows and the priors.
        residuals: Every residual, before and after.
        goodness: Goodness of fit by kind, by row and by configuration.
        priors: Corrections against prior sigmas; None without priors.
    """

    chi_square: "ChiSquare"
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
    rows = RowStatistics(solution, spread, table)
    n, kinds = int(np.sum(table.reason_code == 0)), rows.fit_kinds()
    level, of = suspect_level(n), {(kind.table, kind.kind): kind.level(n) for kind in kinds}
    levels = np.array([of.get(group, level) for group in table.groups] or [level])[table.group]
    with np.errstate(invalid="ignore"):
        suspect, outlier = np.abs(rows.studentised) > levels, rows.weight < OUTLIER_WEIGHT
    which = {"excluded": table.reason_code != 0, "test": table.test, "outlier": outlier, "suspect": suspect}
    flag = np.select(list(which.values()), [np.int8(FLAGS.index(name)) for name in which], np.int8(0))
    suspect = (table.reason_code == 0) & (suspect | (outlier & table.used))
    configurations = rows.fitted.suspect_configurations() if not rows.robust else ()
    by_row = (rows.leverage, rows.studentised, rows.weight, flag)
    return Goodness(kinds, *by_row, level, suspect, configurations, rows.fit_predicted())


class JudgedRows(Record):
    """Rows that are judged together: those fitted, or those predicted.

    Attributes:
        table: All rows.
        rows: The judged rows.
        squares: Their squared residuals over sigma, by robust weight.
        means: Means of these.
        covariance: Of the residuals over sigma; None where that is not known.
        shared: Whether rows share errors of configurations.
    """

    table: ResidualTable
    rows: Integers
    squares: Floats
    means: Floats
    covariance: ResidualCovariance | None
    shared: bool

    def of_kind(self, code: int) -> Integers:
        """Places among the judged rows of one of the table's groups."""
        return np.flatnonzero(self.table.group[self.rows] == code)

    def degrees(self, chosen: Integers) -> float:
        """Degrees of freedom of some rows; where that is not known, no more than one configuration's errors."""
        means = self.means[chosen]
        square = float(means @ means) if self.covariance is None else self.covariance.square(chosen, means)
        nu = float(np.sum(means)) ** 2 / square if square > 0.0 else 1.0
        return nu if self.covariance is not None or not self.shared else min(nu, 3.0)

    def whitened(self, chosen: Integers) -> tuple[float, float]:
        """Sum of squares of some rows, whitened together where their covariance is known, and its mean."""
        if self.covariance is None or not len(chosen):
            return float(np.sum(self.squares[chosen])), float(len(chosen))
        z = np.sign(self.table.after[self.rows[chosen]]) * np.sqrt(self.squares[chosen])
        return self.covariance.whitened(z, chosen)

    def suspect_configurations(self) -> tuple[SuspectConfiguration, ...]:
        """Configurations whose rows are too large together, the least likely first."""
        chi2, expected = (self.table.sum_by_end(values, self.rows) for values in (self.squares, self.means))
        known, table = expected > 1e-3, self.table
        limit = ALARM / max(1, int(np.sum(known)))
        # No effective number of degrees of freedom is below 1, where the tail is heaviest.
        least, found = 2.0 * special.erfcinv(limit) ** 2, []
        for k in np.flatnonzero(known & (chi2 > least * expected)).tolist():
            ratio = chi2[k] / expected[k]
            mine = np.flatnonzero((table.a[self.rows] == k) | (table.b[self.rows] == k))
            p = upper_probability(ratio, max(1.0, self.degrees(mine)))
            if p < limit:
                one = SuspectConfiguration(table.names[k], len(mine), float(chi2[k]), float(expected[k]))
                found.append((p, -ratio, k, one))
        return tuple(one for *_, one in sorted(found))


class RowStatistics:
    """The rows of a residual table with the variance of their residuals.

    Args:
        solution: The solution.
        spread: Its covariance.
        table: Its residuals.

    Attributes:
        leverage: See `Goodness`.
        studentised: See `Goodness`.
        weight: See `Goodness`.
        robust: Whether a robust loss weights the rows.
        fitted: The rows fitted.
        predicted: The rows predicted that can be judged.
    """

    def __init__(self, solution: Solution, spread: Spread, table: ResidualTable) -> None:
        problem, noises = solution.problem, solution.noises
        self.solution, self.spread, self.table = solution, spread, table
        self.robust, self._shared = problem.state.weights is not None, any(n.loading.shape[2] for n in noises)
        self.weight: Floats = np.ones(table.n) if self.robust else np.broadcast_to(1.0, table.n)
        for number, weights in enumerate(problem.state.weights or ()):
            mine = table.rows_of(number)
            self.weight[mine] = weights[table.measurement[mine]]
        fitted, test = np.flatnonzero(table.used), np.flatnonzero(table.test & (table.reason_code == 0))
        known = len(fitted) <= (MAX_KEPT if self._shared else MAX_INDEPENDENT)
        known &= not (self.robust or problem.rows.counted_as_private)
        keep = (table.used & known) | (table.test & (len(test) <= MAX_KEPT))
        self._model = RowModel(solution, noises)
        self._kept, self._errors = np.flatnonzero(keep), self._read(keep)
        w = self.weight
        variance = np.where(table.used, 1.0 - 2.0 * w, 1.0)  # in place, as of a million rows each array counts
        variance *= self.leverage
        variance += 1.0
        with np.errstate(invalid="ignore", divide="ignore"):
            self.studentised: Floats = table.after / (table.sigma * np.sqrt(np.maximum(variance, 1e-12)))
            squares = (table.after / table.sigma) ** 2
        self.studentised[variance < LEAST_VARIANCE] = np.nan
        covariance = self._of(fitted).with_errors(-self._model.of_all(spread.tangent)) if known else None
        chosen, tested = slice(None) if len(fitted) == table.n else fitted, squares[test]
        squares, variance = (np.multiply(w, values, out=values)[chosen] for values in (squares, variance))
        self.fitted = JudgedRows(table, fitted, squares, variance, covariance, self._shared)
        self.predicted = self._predict(test, tested)

    def _of(self, rows: Integers) -> ResidualCovariance:
        """Covariance of some of the kept rows, over sigma."""
        return self._errors.at(np.searchsorted(self._kept, rows))

    def _read(self, keep: Booleans) -> ResidualCovariance:
        """Leverage of every row; what the rows to keep follow from, over sigma."""
        table, tangent, model = self.table, self.spread.tangent, self._model
        self.leverage: Floats = np.full(table.n, np.nan)
        kept, asked, T = [model.errors(0, np.zeros(0, dtype=np.int64))], keep | table.test, model.of_all(tangent)
        for number, noise in enumerate(self.solution.noises):
            measured, last = noise.block.measured, table.rows_of(number).start
            step = _CHUNK if model.is_plain(number) else _CHUNK_WITH_STATES
            for start in range(0, noise.block.n, step):
                chunk = np.arange(start, min(start + step, noise.block.n))
                first, last = last, last + int(np.sum(measured[chunk]))
                rows = slice(first, last)
                if model.is_plain(number) and not asked[rows].any():
                    squares = measurements.squares_along(noise.rows_at(chunk), model.chain(number), self.spread.root)
                    of_rows = (squares + noise.variance[chunk])[measured[chunk]]
                    self.leverage[rows] = of_rows / table.sigma[rows] ** 2 - 1.0
                    continue
                found = model.errors(number, chunk).at(np.flatnonzero(measured[chunk])).over(table.sigma[rows])
                self.leverage[rows] = found.with_errors(T).diagonal - 1.0
                self.leverage[rows][table.test[rows] & np.isnan(self.spread.variance(model.of_core(found)))] = np.nan
                kept.append(found.at(np.flatnonzero(keep[rows])))
        self.leverage[~np.isfinite(self.leverage)] = np.nan
        return ResidualCovariance.joined(kept)

    def fit_kinds(self) -> tuple[KindFit, ...]:
        """The fit of the fitted rows by kind."""
        part, n_groups = self.fitted, len(self.table.groups)
        leverage = np.nan_to_num(self.weight[part.rows] * self.leverage[part.rows])
        by_kind: Floats = np.bincount(self.table.group[part.rows], leverage, n_groups).astype(np.float64)
        excess = self.spread.excess * by_kind / max(float(by_kind.sum()), 1e-300)
        known = not self.robust and self.solution.estimated_noise is None
        return tuple(self._fit_kinds(part, excess, known and (part.covariance is not None or not self._shared)))

    def fit_predicted(self) -> PredictedFit | None:
        """The fit of the predicted rows; None without any that can be judged."""
        part, table, n = self.predicted, self.table, len(self.predicted.rows)
        test = table.test & (table.reason_code == 0)
        able = test & (self.leverage >= LEAST_VARIANCE - 1.0)
        if not able.any():
            return None
        # np.unique takes a second for 10^6
        numbers = (np.sort(table.measurement_number[of]) for of in (part.rows, able))
        n_judged, n_measurements = (int(np.count_nonzero(np.diff(number, prepend=-1))) for number in numbers)
        chosen = np.arange(n)
        if part.covariance is not None and n:
            chosen = np.unique(np.linspace(0, n - 1, min(n, MAX_WHITENED)).round().astype(np.int64))
        (chi2, expected), configurations = part.whitened(chosen), part.suspect_configurations() * (not self.robust)
        nu = expected if part.covariance is not None and n else part.degrees(chosen)
        wrong = np.append(np.isin(table.names, [one.id for one in configurations]), False)  # the last without an end
        others, mean = part.whitened(chosen[~(wrong[table.a] | wrong[table.b])[part.rows[chosen]]])
        of_noise = self._degrees_of_noise(np.arange(len(self.fitted.rows)))
        kinds = tuple(self._fit_kinds(part, np.zeros(len(table.groups)), known=True))
        n_unknown = int(np.sum(~np.isfinite(self.leverage[test])))
        p_value = upper_probability(chi2 / expected, nu, of_noise) if n else 1.0
        counts = (n, len(chosen), n_measurements, n_measurements - n_judged, n_unknown)
        return PredictedFit(kinds, *counts, chi2, expected, p_value, configurations, others / max(mean, 1e-300))

    def _degrees_of_noise(self, fitted: Integers) -> float:
        """Degrees of freedom by which some fitted rows estimated their noise; infinite where it is specified."""
        estimated = self.solution.estimated_noise is not None and len(fitted)
        return max(1.0, self.fitted.degrees(fitted)) if estimated else np.inf

    def _fit_kinds(self, part: JudgedRows, excess: Floats, known: bool) -> Iterator[KindFit]:
        """The fit of each of the table's groups, whose chi-square has a mean lower by `excess`."""
        table = self.table
        for code, (number, family) in enumerate(table.groups):
            chosen = part.of_kind(code)
            if not len(chosen):
                continue
            rows = part.rows[chosen]
            total, mean = float(np.sum(part.squares[chosen])), float(np.sum(part.means[chosen]))
            expected, degrees, size = mean - excess[code], part.degrees(chosen), np.abs(self.studentised[rows])
            of_noise = np.inf if part is self.fitted else self._degrees_of_noise(self.fitted.of_kind(code))
            enough = expected >= 1.0
            variance, specified = (float(np.mean(v)) for v in (table.sigma[rows] ** 2, self._specified_variance[rows]))
            sigma, factor = float(np.sqrt(specified)), float(np.sqrt(variance / specified))
            ratio = factor * float(np.sqrt(total / expected)) if enough else np.nan
            p_value = upper_probability(total / mean, degrees, of_noise) if enough and known else None
            typical = float(np.nanmedian(size)) / _MEDIAN if enough else np.nan
            tests = (total, max(float(expected), 0.0), p_value, typical, degrees)
            fit = KindFit(family, table.unit(family), len(rows), sigma, factor, ratio, *tests, number)
            yield replace(fit, n_beyond=int(np.sum(size > fit.level(len(rows)))))

    @cached_property
    def _specified_variance(self) -> Floats:
        """Variance of each row by the noise as specified, shape (n,)."""
        variance, problem = self.table.sigma**2, replace(self.solution.problem, state=NoiseState())
        noises = noises_at(problem, self.solution.parameters) if self.solution.problem.state.factors else ()
        for number, noise in enumerate(noises):
            variance[self.table.rows_of(number)] = noise.sigma[noise.block.measured] ** 2
        return variance

    def _predict(self, test: Integers, squares: Floats) -> JudgedRows:
        """The predicted rows that can be judged: those known, and no outliers.

        Args:
            test: Predicted rows of the table.
            squares: Their squared residuals over sigma.
        """
        table = self.table
        judged = np.isfinite(self.leverage[test]) & ~(self.leverage[test] < LEAST_VARIANCE - 1.0)
        if self.robust:
            far = test[judged & (np.abs(self.studentised[test]) > suspect_level(len(test)))]
            judged &= ~np.isin(table.measurement_number[test], table.measurement_number[far])
        rows = test[judged]
        means, covariance = 1.0 + self.leverage[rows], None
        if np.isin(rows, self._kept).all():
            K, T = self._model.of_all(self.spread.actual), self._model.of_all(self.spread.tangent)
            predicted = self._of(rows).with_errors(K, T)
            means = predicted.diagonal
            covariance = predicted.over(np.sqrt(means))
            with np.errstate(invalid="ignore"):
                self.studentised[rows] = table.after[rows] / (table.sigma[rows] * np.sqrt(means))
        return JudgedRows(table, rows, squares[judged] / means, np.ones(len(rows)), covariance, self._shared)


def upper_probability(ratio: float, nu: float, of_noise: float = np.inf) -> float:
    """Probability that a sum of squares exceeds its mean by a factor.

    Args:
        ratio: The factor.
        nu: Degrees of freedom of the sum.
        of_noise: Degrees of freedom that the variance in its mean was estimated from.
    """
    if np.isfinite(of_noise):
        return float(special.fdtrc(nu, of_noise, ratio))
    return float(special.gammaincc(nu / 2.0, nu / 2.0 * ratio))


class ChiSquare(Record):
    """Chi-square of the fitted rows and the priors.

    Attributes:
        value: Sum of squared whitened residuals; with a robust loss of what keeps at least half its weight.
        dof: Residuals and priors, less the determined directions.
        expected: Its mean; not `dof` where rows that share errors count as independent.
        bounds: Interval of the reduced chi-square that is taken as good.
        p_value: Probability of one as large, were the noise as specified; None where that is not known.
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
        """Ratio to its mean; 1 where nothing is expected."""
        return self.value / self.expected if self.expected > 0.0 else 1.0


def chi_square(solution: Solution, spread: Spread) -> ChiSquare:
    """Chi-square of a solution.

    Args:
        solution: The solution.
        spread: The covariance of what was estimated.
    """
    problem = solution.problem
    chi2, n_rows, of_loss = _weighted_chi2(solution)
    dof = n_rows + problem.n_priors + problem.n_added + (0 if problem.known is None else problem.known.n) - spread.rank
    dof -= solution.system.left.rank
    expected = max(0.0, dof - spread.excess - (1.0 - of_loss) * n_rows)
    known = dof > 0 and problem.state.weights is None
    known = known and solution.estimated_noise is None
    p_value = float(special.chdtrc(dof, chi2)) if known and not problem.rows.counted_as_private else None
    return ChiSquare(chi2, dof, expected, chi2_bounds(dof, expected), p_value)


def chi2_bounds(dof: int, expected: float | None = None) -> tuple[float, float]:
    """Interval of the reduced chi-square taken as good: its central `CONFIDENCE`, widened to `FACTOR` either way.

    Args:
        dof: Degrees of freedom.
        expected: Mean of chi-square; `dof` if None.
    """
    if dof <= 0:
        return 0.0, np.inf
    ratio = 1.0 if expected is None else expected / dof
    low, high = (2.0 * special.gammaincinv(dof / 2.0, p) / dof for p in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return ratio * min(float(low), 1.0 / FACTOR), max(1.0, ratio) * max(float(high), FACTOR)


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
    for block, w, (e, residual_dim) in zip(problem.data.blocks, weights, distances, strict=True):
        train, outlier = (residual_dim > 0) & ~block.test, w < OUTLIER_WEIGHT
        chi2 -= float(np.sum(w[train & outlier] * e[train & outlier] ** 2))
        kept = float(residual_dim[train & ~outlier].sum())
        n_rows, n_kept = n_rows + float(residual_dim[train].sum()), n_kept + kept
        expected += kept * effect(problem.options.loss, int(residual_dim.max(initial=1))).chi2
    of_loss = expected / n_kept if n_kept else 1.0
    return max(0.0, chi2), round(problem.n_independent * n_kept / max(n_rows, 1.0)), of_loss
