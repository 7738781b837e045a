"""Covariance of residuals: what each row follows from, noise, parameters and landmarks, kept in low rank.

With C = D + L L^T the covariance of the noise, T that of the estimate and J the derivatives, fitted residuals have the
covariance `C - J T J^T`. Predicted ones have `C + J K J^T - J Q^T - Q J^T`, K what the estimate is off and Q its
covariance with errors of configurations that fitted rows took part in as well. Where rows are weighted by W as
independent although they share errors, fitted ones have `(1 - J T J^T W) C (1 - J T J^T W)^T` and what the priors add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from fg_calib.graph import PRIVATE_SHARE, ErrorStates, Problem, RowNoise, at_parameters, felt, linear_system, says_where
from fg_calib.inputs import Booleans, Floats, Integers
from fg_calib.measurements import residuals
from fg_calib.robot import Chain

Sparse = scipy.sparse.csr_array

MANY_ROWS = 16
"""Rows that an error may reach in a covariance's sparse part; errors of more rows are in its low rank."""


@dataclass(frozen=True)
class ResidualCovariance:
    """Covariance `D + L L^T + P S P^T` of rows.

    Attributes:
        P: Parameters' share and errors of many rows, shape (n, k).
        L: Errors of few rows, sparse, shape (n, n_errors).
        d: Diagonal of D, shape (n,).
        sign: Diagonal of S, 1 or -1, shape (k,).
        noise: Variances by noise alone, shape (n,).
    """

    P: Floats
    L: Sparse
    d: Floats
    sign: Floats
    noise: Floats

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        out: Floats = self.d + row_squares(self.L) + (self.P * self.P) @ self.sign
        return out

    @classmethod
    def build(cls, P: Floats, L: Sparse, d: Floats, sign: Floats) -> ResidualCovariance:
        """The same covariance with errors that reach many rows, which would fill a sparse factor, among P."""
        columns = L.tocsc()
        many = np.diff(columns.indptr) > MANY_ROWS
        wide, noise = columns[:, many].toarray(), d + row_squares(L)
        return cls(np.hstack([P, wide]), columns[:, ~many].tocsr(), d, np.append(sign, np.ones(wide.shape[1])), noise)

    def at(self, rows: Integers) -> ResidualCovariance:
        """The part at some rows."""
        return ResidualCovariance(self.P[rows], self.L[rows], self.d[rows], self.sign, self.noise[rows])

    def over(self, scale: Floats) -> ResidualCovariance:
        """The covariance of rows divided by a scale, shape (n,)."""
        P, L, d, noise = self.P / scale[:, None], _scaled(self.L, scale), self.d / scale**2, self.noise / scale**2
        return ResidualCovariance(P, L, d, self.sign, noise)

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at some rows."""
        part = self.at(rows)
        P, L, d, sign = part.P, part.L, part.d, part.sign
        others = part.diagonal - d
        square = d @ d + 2.0 * d @ others + Sparse(L.T @ L).power(2).sum()
        square += 2.0 * np.sum((L.T @ P) ** 2 @ sign) + sign @ (P.T @ P) ** 2 @ sign
        return float(np.sum(d + others)), float(square)

    def whitened(self, z: Floats) -> tuple[float, float, float]:
        """Sum of the squares of all rows, whitened together; its mean, and its degrees of freedom.

        D counts as `PRIVATE_SHARE` of the noise at least.

        Args:
            z: The rows, shape (n,).
        """
        added = np.maximum(PRIVATE_SHARE * self.noise - self.d, 0.0)
        T = scipy.sparse.csc_array(self.L @ self.L.T + scipy.sparse.diags_array(self.d + added))
        factor, k = splu(T), self.P.shape[1]
        V, Tz = np.split(factor.solve(np.column_stack([self.P, z])), [k], axis=1)
        M = np.linalg.inv(np.diag(self.sign) + self.P.T @ V)  # C^-1 = T^-1 - V M V^T
        chi2, n = float(z @ Tz[:, 0] - (V.T @ z) @ M @ (V.T @ z)), float(len(z))
        if not added.any():
            return chi2, n, n
        root = np.sqrt(added)[:, None]
        part = csgraph.connected_components(T, directed=False)[1]  # rows of one part at a time: T^-1 couples no others
        order = np.argsort(part, kind="stable")
        place = np.empty(len(z), dtype=np.int64)
        place[order] = np.arange(len(z)) - np.searchsorted(part[order], part[order])
        unit = np.zeros((len(z), int(place.max()) + 1))
        unit[np.arange(len(z)), place] = root[:, 0]
        B, V = root * factor.solve(unit), root * V  # 1 - (B - V M V^T) has the moments of the sum
        K = M @ (V.T @ V)
        trace = float(B[np.arange(len(z)), place].sum() - np.trace(K))
        squares = np.vdot(B, B) - 2.0 * np.vdot(V @ M, root * factor.solve(root * V)) + np.vdot(K, K.T)
        expected = n - trace
        return chi2, expected, expected**2 / (expected - trace + float(squares))


@dataclass(frozen=True)
class RowErrors:
    """What rows follow from.

    Attributes:
        J: Derivatives in the core, landmarks following it, shape (n, n_columns).
        own: Landmarks' errors at a given core, of 1 sigma, shape (n, n_landmark_errors).
        private: Variance of each row's private noise, shape (n,).
        L: How rows follow from other noise, sparse, shape (n, n_errors): from errors of 1 sigma.
        felt: `L M^T`, M what the fit made of those errors (see `information.felt`), shape (n, n_columns +
            n_landmark_errors); no columns where fitted and predicted rows share none.
    """

    J: Floats
    own: Floats
    private: Floats
    L: Sparse
    felt: Floats

    @property
    def noise(self) -> Floats:
        """Variance of rows by noise alone, shape (n,)."""
        return self.private + row_squares(self.L)

    def at(self, rows: Integers) -> RowErrors:
        """What some of the rows follow from."""
        return RowErrors(*(getattr(self, f.name)[rows] for f in fields(self)))

    def over(self, sigma: Floats) -> RowErrors:
        """What rows divided by their sigma, shape (n,), follow from."""
        J, own, felt_ = (values / sigma[:, None] for values in (self.J, self.own, self.felt))
        return RowErrors(J, own, self.private / sigma**2, _scaled(self.L, sigma), felt_)

    @staticmethod
    def joined(parts: Sequence[RowErrors]) -> RowErrors:
        """What several groups of rows, one after the other, follow from."""
        J, own, private, felt_ = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("J", "own", "private", "felt")
        )
        return RowErrors(J, own, private, Sparse(scipy.sparse.vstack([part.L for part in parts])), felt_)

    def root(self, covariance: Floats) -> Floats:
        """P with P P^T the covariance of rows by what the estimate is off, shape (n, n_columns + n_landmark_errors).

        Args:
            covariance: Of the core.
        """
        return np.hstack([self.J @ square_root(covariance), self.own])

    def fitted(self, tangent: Floats) -> ResidualCovariance:
        """Covariance of fitted rows.

        Args:
            tangent: T, the covariance of the core.
        """
        P = self.root(tangent)
        return ResidualCovariance.build(P, self.L, self.private, -np.ones(P.shape[1]))

    def fitted_as_independent(self, tangent: Floats, measurement: Integers) -> ResidualCovariance:
        """Covariance of fitted rows that were weighted as if measurements shared no errors.

        Args:
            tangent: T, the covariance of the core by those weights.
            measurement: Number of each row's measurement, shape (n,).
        """
        C = (self.L @ self.L.T).toarray() + np.diag(self.private)
        weighted_as = np.where(measurement[:, None] == measurement, C, 0.0)
        P = self.root(tangent)
        weighed = np.linalg.solve(weighted_as, P)
        inner = np.eye(P.shape[1]) + weighed.T @ (C - weighted_as) @ weighed
        return _with_cross(P @ square_root(inner), P, C @ weighed, self.L, self.private)

    def predicted(self, tangent: Floats, actual: Floats) -> ResidualCovariance:
        """Covariance of predicted rows, whose errors the estimate may have felt.

        Args:
            tangent: T, the covariance of the core by the noise that rows are weighted by.
            actual: K, its covariance.
        """
        P = self.root(actual)
        if not self.felt.shape[1]:
            return ResidualCovariance.build(P, self.L, self.private, np.ones(P.shape[1]))
        n = len(tangent)
        felt_ = np.hstack([self.felt[:, :n] @ square_root(tangent), self.felt[:, n:]])
        return _with_cross(P, self.root(tangent), felt_, self.L, self.private)


def _with_cross(P: Floats, A: Floats, B: Floats, L: Sparse, d: Floats) -> ResidualCovariance:
    """Covariance `D + L L^T + P P^T - A B^T - B A^T`."""
    columns = np.hstack([P, (A - B) / np.sqrt(2.0), (A + B) / np.sqrt(2.0)])
    n, m = P.shape[1], A.shape[1]
    return ResidualCovariance.build(columns, L, d, np.concatenate([np.ones(n + m), -np.ones(m)]))


class RowModel:
    """What the rows of every block follow from at the estimate.

    Landmarks are estimated, known, or, where test rows alone touched them, the mean of what touched them: at B e with e
    those rows without the landmark. With N the derivatives in such landmarks, `N B e` is added to the rows.

    Args:
        problem: The problem.
        parameters: The estimate.
        noises: The rows and their noise at the estimate.
    """

    def __init__(self, problem: Problem, parameters: Floats, noises: Sequence[RowNoise]) -> None:
        self._at = at_parameters(problem, parameters)
        self._noises, self._columns, self._n = noises, ErrorStates(noises), problem.variables.n_columns
        estimated, n = self._at.columns >= 0, len(self._at.columns)
        self._follow, self._inverse = np.zeros((n, self._n)), np.zeros((n, 0))
        self._common = self._columns.predicted(noises)
        self._felt = felt(problem, parameters, self._columns, self._common)
        if estimated.any():
            left, column = linear_system(problem, parameters).left, self._at.columns[estimated] - self._n
            self._inverse = np.zeros((n, left.rank))
            core, others = np.split(self._felt, [self._n])
            self._felt = np.vstack([core + left.follow.T @ others, left.inverse.T @ others])
            self._follow[estimated], self._inverse[estimated] = left.follow[column], left.inverse[column]
        blocks, unknowns = problem.data.series, problem.data.unknowns
        self._means = [says_where(problem.data, s) & ~estimated[s.nuisances].any(axis=1) for s in blocks]
        located = estimated | np.repeat(np.array(unknowns.known, dtype=np.bool_), unknowns.sizes)
        for s, touches in zip(blocks, self._means, strict=True):
            located[s.nuisances[touches].ravel()] = True
        self._nowhere: list[Booleans] = [np.any(~located[s.nuisances], axis=1) for s in blocks]
        counts = [s.n * s.kind.residual_dim * of.any() for s, of in zip(blocks, self._means, strict=True)]
        self._first = self._columns.n_errors + np.cumsum([0, *counts])
        self._averaged = Sparse((n, int(self._first[-1])))
        for number, touches in enumerate(self._means):
            if touches.any():
                J, _, L, _ = self._given_landmarks(number, np.flatnonzero(touches))
                place = blocks[number].nuisances[touches].ravel()
                share = 1.0 / np.bincount(place)[place]
                B = Sparse((share, (place, np.arange(len(place)))), shape=(n, len(place)))
                self._follow += np.asarray(B @ J)
                self._averaged = self._averaged + B @ L

    def is_plain(self, number: int) -> bool:
        """Whether rows of a block follow from the core and private noise alone."""
        noise = self._noises[number]
        return not (noise.sources or noise.series.nuisances.shape[1])

    def chain(self, number: int) -> Chain:
        """The chain of a block at the estimate."""
        return self._at.chains[self._noises[number].series.table]

    def empty(self) -> RowErrors:
        """What no rows follow from."""
        J, own, felt_ = (np.zeros((0, k)) for k in (self._n, self._inverse.shape[1], self._felt_width))
        return RowErrors(J, own, np.zeros(0), Sparse((0, int(self._first[-1]))), felt_)

    @property
    def _felt_width(self) -> int:
        return self._felt.shape[0] if len(self._common) else 0

    def errors(self, number: int, rows: Integers) -> RowErrors:
        """What the rows of some measurements of a block follow from."""
        J, private, L, N = self._given_landmarks(number, rows)
        own = np.zeros((len(J), self._inverse.shape[1]))
        if N.shape[1]:
            nowhere = np.repeat(self._nowhere[number][rows], len(J) // max(len(rows), 1))
            J = J + np.where(nowhere, np.nan, 0.0)[:, None] + N @ self._follow
            own, L = N @ self._inverse, L + N @ self._averaged
        felt_ = L[:, self._common] @ self._felt.T if self._felt_width else np.zeros((len(J), 0))
        return RowErrors(J, own, private, L, felt_)

    def _given_landmarks(self, number: int, rows: Integers) -> tuple[Floats, Floats, Sparse, Sparse]:
        """J, private variance and L of rows were their landmarks known; derivatives in these, sparse.

        The noise of touches whose mean a point is stands among L, after the errors of configurations.
        """
        noise, width = self._noises[number], int(self._first[-1])
        J = residuals.linearise(noise.rows_at(rows), self.chain(number))[1]
        n, h = J.shape[:2]
        in_landmarks = J[:, :, self._n :]
        row = np.broadcast_to(np.arange(n * h).reshape(n, h, 1), in_landmarks.shape).ravel()
        place = np.broadcast_to(noise.series.nuisances[rows][:, None], in_landmarks.shape).ravel()
        N = Sparse((in_landmarks.ravel(), (row, place)), shape=(n * h, len(self._follow)))
        private = np.maximum(noise.moments_at(rows).variance, 0.0).ravel()
        L = self._columns.loading(noise, rows)
        L = Sparse((L.data, L.indices, L.indptr), shape=(n * h, width))
        mean = np.flatnonzero(np.repeat(self._means[number][rows], h))
        if len(mean):
            column = self._first[number] + (rows[:, None] * h + np.arange(h)).ravel()[mean]
            L = L + Sparse((np.sqrt(private[mean]), (mean, column)), shape=L.shape)
            private[mean] = 0.0
        return J[:, :, : self._n].reshape(n * h, -1), private, L, N


def square_root(covariance: Floats) -> Floats:
    """H with H H^T a covariance, shape (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    out: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return out


def row_squares(L: Sparse) -> Floats:
    """Sum of the squares of each row of a sparse matrix, shape (n,)."""
    return np.asarray(L.power(2).sum(axis=1), dtype=np.float64).ravel()


def _scaled(L: Sparse, scale: Floats) -> Sparse:
    """Rows of a sparse matrix, each divided by a scale, shape (n,)."""
    return Sparse((L.data / np.repeat(scale, np.diff(L.indptr)), L.indices, L.indptr), shape=L.shape)
