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

References:
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy import special

from fg_calib import residuals
from fg_calib.covariance import Spread
from fg_calib.factors import prior_rows
from fg_calib.kinematics import SPAN
from fg_calib.problem import PAIR_KINDS, POSE_KINDS, Problem, all_rows, pair_rows
from fg_calib.residual_table import FAMILIES, ROW_KINDS, ResidualTable
from fg_calib.residuals import Block, PoseBlock
from fg_calib.solver import Solution
from fg_calib.whitening import joint_rows

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]
Codes = NDArray[np.int8]

MAX_DENSE = 3000
"""Rows up to which the covariance of residuals is formed where they are weighted as independent but are not."""

MAX_KEPT = 300_000
"""Rows up to which derivatives and shared errors are kept, to look at parts of them again."""

ALARM = 0.01
"""Probability of calling any row of a clean table suspect; and any configuration."""

OUTLIER_WEIGHT = 0.5
"""A row with a robust weight below this is an outlier."""

FLAGS = ("", "suspect", "outlier", "excluded", "test")
"""What is said of a row, in the order of the codes."""

_CHUNK = 4 * SPAN


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

    @property
    def verdict(self) -> str:
        """What the figures say, as a key of `VERDICTS`."""
        ratio, p = self.seen_over_stated / self.factor, self.p_value
        if not np.isfinite(ratio):
            return "unknown"
        unlikely = abs(ratio - 1.0) > 0.2 if p is None else min(p, 1.0 - p) < ALARM / 2.0
        if not unlikely or abs(ratio - 1.0) < 0.05:
            return "as stated"
        if ratio < 1.0:
            return "too large"
        share = (self.typical**2 - 1.0) / (ratio**2 - 1.0)  # of the excess that rows have in common
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


@dataclass(frozen=True)
class SuspectConfiguration:
    """A configuration whose rows are too large together.

    Attributes:
        configuration: Its row among the measurements.
        n: Scalar rows that it takes part in.
        chi2: Sum of their squared residuals over sigma.
        expected: Its mean, were the noise as stated.
    """

    configuration: int
    n: int
    chi2: float
    expected: float


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
        suspects: Rows of the table that are suspect or outliers, the largest |studentised| first.
        configurations: Suspect configurations, the worst first.
    """

    kinds: tuple[KindFit, ...]
    leverage: Floats
    studentised: Floats
    weight: Floats
    flag: Codes
    level: float
    suspects: Integers
    configurations: tuple[SuspectConfiguration, ...]


def judge_fit(solution: Solution, spread: Spread, table: ResidualTable) -> Goodness:
    """Goodness of fit by kind, by row and by configuration.

    Args:
        solution: The solution.
        spread: Its covariance.
        table: Its residuals.
    """
    rows = _Rows(solution, spread, table)
    weight = rows.weight
    level = float(special.ndtri(0.5 + 0.5 * (1.0 - ALARM) ** (1.0 / max(1, int(np.sum(table.reason_code == 0))))))
    with np.errstate(invalid="ignore"):
        suspicious = np.abs(rows.studentised) > level
    flag = np.zeros(table.n, dtype=np.int8)
    flag[suspicious] = FLAGS.index("suspect")
    flag[weight < OUTLIER_WEIGHT] = FLAGS.index("outlier")
    flag[table.test] = FLAGS.index("test")
    flag[table.reason_code != 0] = FLAGS.index("excluded")
    suspects = np.flatnonzero((flag == FLAGS.index("suspect")) | (flag == FLAGS.index("outlier")))
    suspects = suspects[np.argsort(-np.abs(rows.studentised[suspects]), kind="stable")]
    return Goodness(
        kinds=rows.kinds(),
        leverage=rows.leverage,
        studentised=rows.studentised,
        weight=weight,
        flag=flag,
        level=level,
        suspects=suspects,
        configurations=rows.configurations(),
    )


def kind_fits(solution: Solution, spread: Spread, table: ResidualTable) -> tuple[KindFit, ...]:
    """Goodness of fit by kind alone (see `judge_fit`)."""
    return _Rows(solution, spread, table).kinds()


class _Rows:
    """The rows of a residual table with the variance of their residuals.

    Attributes:
        leverage: See `Goodness`.
        studentised: See `Goodness`.
        weight: See `Goodness`.
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
        self._fitted = np.flatnonzero(table.used & ~point & ~self._of_points)
        self._shared = problem.common.poses or bool(np.any(problem.measurements.sigma_joint > 0.0))
        self._carried = problem.sharing == problem.common
        most = MAX_KEPT if self._carried and self._shared else MAX_DENSE
        keep = len(self._fitted) <= most and not self._robust
        L, J = self._read(keep and self._shared, keep)
        w, q = self.weight, self.leverage
        variance = 1.0 + q * (1.0 - 2.0 * np.where(table.used, w, 0.0))
        self._covariance = None if J is None else self._residual_covariance(J, L)
        if isinstance(self._covariance, _Dense):
            variance[self._fitted] = self._covariance.diagonal
        with np.errstate(invalid="ignore", divide="ignore"):
            self.studentised = table.after / (table.sigma * np.sqrt(np.maximum(variance, 1e-12)))
        self.studentised[variance < 1e-6] = np.nan  # a row that the fit meets whatever was measured
        # A point measured twice has three coordinates: as unlikely, not as large.
        squared = (table.after[point] / table.sigma[point]) ** 2
        self.studentised[point] = -special.ndtri(np.maximum(special.gammaincc(1.5, squared / 2.0), 1e-300) / 2.0)
        self.leverage[point] = np.nan
        self.studentised[self._of_points] = (table.after / table.sigma)[self._of_points]
        z = (table.after / table.sigma)[self._fitted]
        self._squares = w[self._fitted] * z * z
        self._means = w[self._fitted] * variance[self._fitted]

    def kinds(self) -> tuple[KindFit, ...]:
        """The fit by kind."""
        table, fitted = self._table, self._fitted
        family = table.family[fitted]
        found = []
        leverage = np.nansum(self.weight[fitted] * self.leverage[fitted])
        for code, name in enumerate(FAMILIES):
            rows = np.flatnonzero(family == code)
            if not len(rows):
                continue
            chi2, expected = float(np.sum(self._squares[rows])), float(np.sum(self._means[rows]))
            if not self._carried and self._covariance is None:
                share = np.sum(self.leverage[fitted[rows]]) / leverage if leverage > 0.0 else 0.0
                expected -= self._spread.excess * float(share)
            enough = expected >= 1.0
            factor = float(_factors(self._problem)[code])
            studentised = np.abs(self.studentised[fitted[rows]])
            found.append(
                KindFit(
                    kind=name,
                    unit="m" if name in ("distance", "position") else "rad",
                    n=len(rows),
                    stated_sigma_rms=float(np.sqrt(np.mean(table.sigma[fitted[rows]] ** 2))) / factor,
                    factor=factor,
                    seen_over_stated=factor * float(np.sqrt(chi2 / expected)) if enough else np.nan,
                    chi2=chi2,
                    expected=max(expected, 0.0),
                    p_value=self._p_value(rows, chi2) if enough else None,
                    typical=float(np.nanmedian(studentised)) / 0.6744897501960817 if enough else np.nan,
                )
            )
        if self._of_points.any():
            found.append(self._of_touched_points(found))
        return tuple(found)

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
            typical=float(np.median(np.abs(z))) / 0.6744897501960817 if len(rows) else np.nan,
        )

    def configurations(self) -> tuple[SuspectConfiguration, ...]:
        """Configurations whose rows are too large together, the least likely first."""
        table, fitted, n = self._table, self._fitted, self._problem.measurements.n_configurations
        if self._robust:
            return ()  # outliers have been found already
        ends = [table.a[fitted]] if self._problem.pairs is None else [table.a[fitted], table.b[fitted]]
        chi2, expected, count = (
            np.sum([np.bincount(end, values, n) for end in ends], axis=0)
            for values in (self._squares, self._means, np.ones(len(fitted)))
        )
        there = np.flatnonzero(expected > 1e-3)
        limit = ALARM / max(1, len(there))
        # No effective number of degrees of freedom is below 1, where the tail is heaviest.
        found = []
        for k in there[special.gammaincc(0.5, 0.5 * chi2[there] / expected[there]) < limit]:
            rows = np.flatnonzero(np.any([end == k for end in ends], axis=0))
            nu = self._effective(rows)
            ratio = chi2[k] / expected[k]
            if special.gammaincc(nu / 2.0, nu / 2.0 * ratio) < limit:
                strength = 0.5 * nu * (ratio - 1.0 - np.log(ratio))  # -log p, nearly; never underflows
                found.append(
                    (strength, SuspectConfiguration(int(k), int(count[k]), float(chi2[k]), float(expected[k])))
                )
        return tuple(one for _, one in sorted(found, key=lambda pair: -pair[0]))

    def _effective(self, rows: Integers) -> float:
        """Degrees of freedom of some fitted rows; where that is not known, no more than one configuration's errors."""
        if self._covariance is not None:
            trace, square = self._covariance.moments(rows)
        else:
            v = self._means[rows]
            trace, square = float(np.sum(v)), float(np.sum(v * v))
        nu = max(1.0, trace**2 / square) if square > 0.0 else 1.0
        return nu if self._covariance is not None or not self._shared else min(nu, 3.0)

    def _p_value(self, rows: Integers, chi2: float) -> float | None:
        if self._robust or self._solution.estimated_noise is not None:
            return None
        if self._covariance is None and self._shared:
            return None
        if self._covariance is None:
            v = self._means[rows]
            trace, square = float(np.sum(v)), float(np.sum(v * v))
        else:
            trace, square = self._covariance.moments(rows)
        return float(special.gammaincc(0.5 * trace**2 / square, 0.5 * chi2 * trace / square))

    def _read(self, with_shared: bool, with_derivatives: bool) -> tuple[scipy.sparse.csr_array | None, Floats | None]:
        """Leverage of every row; shared errors and derivatives of the fitted rows over sigma, where wanted."""
        table, problem = self._table, self._problem
        parameters = self._solution.parameters
        block, chain = all_rows(problem, parameters), problem.variables.chain.at(parameters)
        loadings = _loadings(problem, parameters) if with_shared else None
        columns = _first_code(problem)
        fitted = np.zeros(table.n, dtype=np.bool_)
        fitted[self._fitted] = True
        self.leverage = np.full(table.n, np.nan)
        shared, derivatives = [], []
        for start in range(0, block.n, _CHUNK):
            first, last = np.searchsorted(table.measurement, (start, min(start + _CHUNK, block.n)))
            rows = slice(int(first), int(last))
            part = residuals.rows_of(block, slice(start, start + _CHUNK))
            J = residuals.linearise(part, chain)[1]  # (n, height, n_columns)
            grid = (table.measurement[rows] - start) * block.height + (table.kind_code[rows] - columns)
            flat = J.reshape(-1, J.shape[2])[grid] / table.sigma[rows, None]  # (rows, n_columns)
            self.leverage[rows] = np.einsum("ij,ij->i", flat @ self._spread.tangent, flat)
            here = fitted[rows]
            if with_derivatives:
                derivatives.append(flat[here])
            if loadings is not None:
                shared.append(loadings(part)[grid[here]].multiply(1.0 / table.sigma[rows][here, None]).tocsr())
        self.leverage[~np.isfinite(self.leverage)] = np.nan
        L = scipy.sparse.csr_array(scipy.sparse.vstack(shared)) if shared else None
        return L, np.concatenate(derivatives) if derivatives else None

    def _residual_covariance(self, J: Floats, L: scipy.sparse.csr_array | None) -> _LowRank | _Dense:
        if self._carried or L is None:
            values, vectors = np.linalg.eigh(self._spread.tangent)
            return _LowRank(J @ (vectors * np.sqrt(np.maximum(values, 0.0))), L)
        LLt = (L @ L.T).toarray()
        C = LLt + np.diag(np.maximum(1.0 - np.diag(LLt), 0.0))
        measurement = self._table.measurement[self._fitted]
        weighted_as = np.where(measurement[:, None] == measurement, C, 0.0)
        WJ = np.linalg.solve(weighted_as, J)
        K = self._spread.weighted
        X = J @ (K @ (WJ.T @ C))
        covariance = K + K @ (WJ.T @ ((C - weighted_as) @ WJ)) @ K
        return _Dense(C - X - X.T + J @ covariance @ J.T)


class _LowRank:
    """Covariance `D + L L^T - P P^T` of standardised residuals, D what L leaves of a diagonal of 1.

    Args:
        P: Shape (n, n_columns).
        L: Sparse, shape (n, n_shared); None for zero.
    """

    def __init__(self, P: Floats, L: scipy.sparse.csr_array | None) -> None:
        self._P, self._L = P, L
        self._p = np.sum(P * P, axis=1)
        self._l = np.zeros(len(P)) if L is None else np.asarray(L.multiply(L).sum(axis=1)).ravel()

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        out: Floats = 1.0 - self._p
        return out

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at `rows`."""
        P, p, of_l = self._P[rows], self._p[rows], self._l[rows]
        d = np.maximum(1.0 - of_l, 0.0)
        square = np.sum(d * d) + 2.0 * np.sum(d * (of_l - p)) + np.sum((P.T @ P) ** 2)
        if self._L is not None:
            L = self._L[rows]
            square += (L.T @ L).power(2).sum() - 2.0 * np.sum((L.T @ P) ** 2)
        return float(np.sum(1.0 - p)), float(square)


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


def _loadings(problem: Problem, parameters: Floats) -> Callable[[Block], scipy.sparse.csr_array]:
    """How rows in [m] and [rad] follow from errors of 1 sigma that they share, sparse (n * height, ...)."""
    m, chain = problem.measurements, problem.variables.chain.at(parameters)
    if problem.pairs is not None:
        pairs = pair_rows(problem, parameters)
        return lambda part: pairs.loadings(part, problem.common)
    factors = np.repeat(np.array(problem.adjustment.factors)[list(POSE_KINDS[problem.settings.model])], 3)

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
    model = problem.settings.model
    if problem.pairs is not None:
        return 0 if PAIR_KINDS[model][0] else 1
    return ROW_KINDS.index("orientation.x" if POSE_KINDS[model][0] else "position.x")


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
