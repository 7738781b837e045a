"""What residuals follow from at the estimate: noise, parameters, nuisances; and their covariance, in low rank.

See `goodness` for what is made of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.graph.information import eliminated, felt
from fg_calib.graph.noise import RowNoise
from fg_calib.graph.problem import Problem, at_parameters, says_where
from fg_calib.graph.rows import ErrorColumns
from fg_calib.measurements import residuals
from fg_calib.robot.kinematics import Chain
from fg_calib.statistics.low_rank import Loadings, LowRank, are_all, squares_of_rows, times

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Errors:
    """What residuals follow from.

    Attributes:
        J: Derivatives in the core, the nuisances following it, shape (n, n_columns).
        own: What nuisances are off by themselves, shape (n, n_nuisance): by errors of 1 sigma.
        private: Variance of each row's private noise, shape (n,).
        L: How rows follow from other noise, sparse, shape (n, n_errors): from errors of 1 sigma.
        felt: `L M^T`, M what the fit made of those errors (see `information.felt`), shape (n, n_columns + n_nuisance);
            no columns where fitted and predicted rows share none.
    """

    J: Floats
    own: Floats
    private: Floats
    L: Loadings
    felt: Floats

    @property
    def of_noise(self) -> Floats:
        """Variance of rows by noise alone, shape (n,)."""
        return self.private + squares_of_rows(self.L)

    def of_estimate(self, covariance: Floats) -> Floats:
        """P with P P^T the covariance of rows by what the estimate is off, shape (n, n_columns + n_nuisance).

        Args:
            covariance: Of the core.
        """
        return np.hstack([self.J @ half_of(covariance), self.own])

    def of_prediction(self, tangent: Floats, actual: Floats) -> LowRank:
        """Covariance of predicted rows, whose noise the estimate may have felt: `C + J K J^T - J Q^T - Q J^T`.

        With K what the estimate is off and e errors of rows, their covariance is -T M, so that Q = L M^T T; and
        `-P R^T - R P^T = ((P - R) (P - R)^T - (P + R) (P + R)^T) / 2`.

        Args:
            tangent: T, the covariance of the core by the noise that rows are weighted by.
            actual: K, its covariance.
        """
        P = self.of_estimate(actual)
        sign = np.ones(P.shape[1])
        if self.felt.shape[1]:
            half, n = half_of(tangent), len(tangent)
            A, B = self.of_estimate(tangent), np.hstack([self.felt[:, :n] @ half, self.felt[:, n:]])
            P = np.hstack([P, (A - B) / np.sqrt(2.0), (A + B) / np.sqrt(2.0)])
            sign = np.concatenate([sign, np.ones(A.shape[1]), -np.ones(A.shape[1])])
        return LowRank(P, self.L, self.private, sign)

    def of_fit(self, tangent: Floats) -> LowRank:
        """Covariance of fitted rows: `C - J T J^T`.

        Args:
            tangent: T, the covariance of the core.
        """
        P = self.of_estimate(tangent)
        return LowRank(P, self.L, self.private, -np.ones(P.shape[1]))

    def at(self, rows: Integers) -> Errors:
        """Those of some rows."""
        if are_all(rows, len(self.private)):
            return self
        return Errors(self.J[rows], self.own[rows], self.private[rows], self.L[rows], self.felt[rows])

    def over(self, sigma: Floats) -> Errors:
        """Those of rows divided by something, shape (n,)."""
        by = 1.0 / sigma
        J, own, felt = (values * by[:, None] for values in (self.J, self.own, self.felt))
        return Errors(J, own, self.private * by**2, times(self.L, by), felt)

    @classmethod
    def of_all(cls, parts: Sequence[Errors]) -> Errors:
        """Those of several rows, one after the other."""
        if len(parts) == 1:
            return parts[0]
        J, own, private, felt = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("J", "own", "private", "felt")
        )
        return cls(J, own, private, Loadings(scipy.sparse.vstack([part.L for part in parts])), felt)


class Nuisances:
    """Which errors rows follow from, nuisances being estimated, or means of what touched them, or known.

    Args:
        problem: The problem.
        parameters: The estimate.
        noises: The rows and their noise at the estimate.
    """

    def __init__(self, problem: Problem, parameters: Floats, noises: Sequence[RowNoise]) -> None:
        self._at = at_parameters(problem, parameters)
        self._noises, self._columns, self._n = noises, ErrorColumns(noises), problem.variables.n_columns
        there, n = self._at.columns >= 0, len(self._at.columns)
        self._follow, self._inverse = np.zeros((n, self._n)), np.zeros((n, 0))
        self._wanted = self._columns.predicted(noises)
        self._felt = felt(problem, parameters, self._columns, self._wanted)
        if there.any():
            left, of_nuisance = eliminated(problem, parameters), self._at.columns[there] - self._n
            self._inverse = np.zeros((n, left.rank))
            core, others = np.split(self._felt, [self._n])
            self._felt = np.vstack([core + left.follow.T @ others, left.inverse.T @ others])
            self._follow[there], self._inverse[there] = left.follow[of_nuisance], left.inverse[of_nuisance]
        series = problem.data.series
        self._apart = [says_where(problem.data, s) & ~there[s.nuisances].any(axis=1) for s in series]
        reserved = [s.n * s.kind.residual_dim * of.any() for s, of in zip(series, self._apart, strict=True)]
        unknowns = problem.data.unknowns
        said: Booleans = there | np.repeat(np.array(unknowns.known, dtype=np.bool_), unknowns.sizes)
        for s, of in zip(series, self._apart, strict=True):
            said[s.nuisances[of].ravel()] = True
        self._unsaid: list[Booleans] = [np.any(~said[s.nuisances], axis=1) for s in series]
        self._first = self._columns.n_errors + np.cumsum([0, *reserved])
        self._averaged = scipy.sparse.csr_array((n, int(self._first[-1])))
        for number, of in enumerate(self._apart):
            touches = np.flatnonzero(of)
            if len(touches):
                found, _ = self._nuisances_known(number, touches)
                place = series[number].nuisances[touches].ravel()
                share = 1.0 / np.bincount(place)[place]
                B = scipy.sparse.csr_array((share, (place, np.arange(len(place)))), shape=(n, len(place)))
                self._follow += np.asarray(B @ found.J)
                self._averaged = self._averaged + B @ found.L

    def none_in(self, number: int) -> bool:
        """Whether rows of a series follow from the core and from noise of their own alone."""
        noise = self._noises[number]
        return not (noise.sources or noise.series.nuisances.shape[1])

    def chain(self, number: int) -> Chain:
        """The chain of a series at the estimate."""
        return self._at.chains[self._noises[number].series.table]

    def nothing(self) -> Errors:
        """What no rows follow from."""
        felt = self._felt.shape[0] if len(self._wanted) else 0
        L = scipy.sparse.csr_array((0, int(self._first[-1])))
        return Errors(
            np.zeros((0, self._n)), np.zeros((0, self._inverse.shape[1])), np.zeros(0), L, np.zeros((0, felt))
        )

    def errors(self, number: int, rows: Integers) -> Errors:
        """What rows of a series follow from."""
        known, N = self._nuisances_known(number, rows)
        J, own, L = known.J, known.own, known.L
        if N.shape[1]:
            unsaid = np.repeat(self._unsaid[number][rows], len(J) // max(len(rows), 1))
            anywhere = np.where(unsaid, np.nan, 0.0)[:, None]  # a point that no row says anything of
            J, own, L = J + anywhere + N @ self._follow, N @ self._inverse, L + N @ self._averaged
        return Errors(J, own, known.private, L, L[:, self._wanted] @ self._felt.T if len(self._wanted) else known.felt)

    def _nuisances_known(self, number: int, rows: Integers) -> tuple[Errors, Loadings]:
        """The same if nuisances were known; derivatives in these, sparse, shape (n residual_dim, n_coordinates).

        The noise of touches whose mean a point is stands among L, after the errors of configurations.
        """
        noise, width = self._noises[number], int(self._first[-1])
        J = residuals.linearise(noise.rows_at(rows), self._at.chains[noise.series.table])[1]
        n, residual_dim = J.shape[:2]
        of_core, in_nuisances = J[:, :, : self._n].reshape(n * residual_dim, -1), J[:, :, self._n :]
        row = np.broadcast_to(np.arange(n * residual_dim).reshape(n, residual_dim, 1), in_nuisances.shape).ravel()
        place = np.broadcast_to(noise.series.nuisances[rows][:, None], in_nuisances.shape).ravel()
        N = scipy.sparse.csr_array((in_nuisances.ravel(), (row, place)), shape=(n * residual_dim, len(self._follow)))
        private = np.maximum(noise.moments_at(rows).variance, 0.0).ravel()
        apart = np.flatnonzero(np.repeat(self._apart[number][rows], residual_dim))
        L = self._columns.loading(noise, rows)
        L = scipy.sparse.csr_array((L.data, L.indices, L.indptr), shape=(n * residual_dim, width))
        if len(apart):
            column = self._first[number] + (rows[:, None] * residual_dim + np.arange(residual_dim)).ravel()[apart]
            L = L + scipy.sparse.csr_array((np.sqrt(private[apart]), (apart, column)), shape=L.shape)
            private[apart] = 0.0
        none = np.zeros((n * residual_dim, 0))
        return Errors(of_core, none, private, L, none), N


def half_of(covariance: Floats) -> Floats:
    """H with H H^T a covariance, shape (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    out: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return out
