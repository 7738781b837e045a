"""Covariance of residuals: how each row follows from noise, parameters and landmarks, kept in low rank.

With C = D + L L^T the covariance of the noise, T that of the estimate (core and landmarks) and J the derivatives,
fitted residuals have the covariance `C - J T J^T`. Predicted ones have `C + J K J^T - J T F^T - F T J^T`, K what the
estimate is off, and -T F^T its covariance with the errors of configurations that fitted rows took part in as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse import csgraph

from fg_calib.graph import PRIVATE_SHARE, Problem, RowNoise, at_parameters, felt, linear_system, reach, says_where
from fg_calib.inputs import Booleans, Floats, Integers
from fg_calib.measurements import residuals
from fg_calib.robot import Chain

Sparse = scipy.sparse.csr_array

FEW = 4
"""An error of more than one in so many rows is one of a covariance's low rank."""


@dataclass(frozen=True)
class ResidualCovariance:
    """Covariance `D + L L^T + P M P^T` of rows.

    Attributes:
        d: Diagonal of D, shape (n,).
        L: Sparse, shape (n, n_errors).
        P: Shape (n, k).
        M: Symmetric, shape (k, k).
    """

    d: Floats
    L: Sparse
    P: Floats
    M: Floats

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        out: Floats = self.d + row_squares(self.L) + np.einsum("ij,ij->i", self.P @ self.M, self.P)
        return out

    def at(self, rows: Integers) -> ResidualCovariance:
        """The part at some rows; errors of more than one in `FEW` of them are columns of P."""
        L = self.L[rows]
        many = FEW * np.bincount(L.indices, minlength=L.shape[1]) > len(rows)
        M = scipy.linalg.block_diag(self.M, np.eye(int(many.sum())))
        return ResidualCovariance(self.d[rows], L[:, ~many], np.hstack([self.P[rows], L[:, many].toarray()]), M)

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at some rows."""
        part = self.at(rows)
        d, L, P, M, variances = part.d, part.L, part.P, part.M, part.diagonal
        gram, PMP, LP = L @ L.T if L.shape[0] < L.shape[1] else L.T @ L, P.T @ P @ M, L.T @ P
        square = d @ (2.0 * variances - d) + gram.power(2).sum() + 2.0 * np.vdot(LP @ M, LP) + np.vdot(PMP, PMP.T)
        return float(np.sum(variances)), float(square)

    def whitened(self, z: Floats, rows: Integers) -> tuple[float, float]:
        """Sum of squares of some rows, whitened together, and its mean.

        D counts as `PRIVATE_SHARE` of the noise at least. D + L L^T falls into parts that share no errors.

        Args:
            z: The residuals, shape (n_rows,).
            rows: Which.
        """
        part, noise = self.at(rows), self.d[rows] + row_squares(self.L[rows])
        d = np.maximum(part.d, PRIVATE_SHARE * noise)
        T = (part.L @ part.L.T + scipy.sparse.diags_array(d)).tocsr()
        dense, columns = T.toarray(), np.column_stack([part.P, z])
        weighed, variances = np.empty(columns.shape), np.empty(len(z))
        label = csgraph.connected_components(T, directed=False)[1]
        size = np.bincount(label)[label]
        for n in np.unique(size):
            together = np.lexsort((label, size != n))[: np.sum(size == n)].reshape(-1, n)
            inverse = np.linalg.inv(dense[together[:, :, None], together[:, None]])
            weighed[together] = inverse @ columns[together]
            variances[together] = np.einsum("kii->ki", inverse)
        V, Tz = weighed[:, :-1], weighed[:, -1]
        G = part.M @ np.linalg.inv(np.eye(V.shape[1]) + part.P.T @ V @ part.M)  # C^-1 = T^-1 - V G V^T
        lost = (d - part.d) @ (variances - np.einsum("ij,ij->i", V @ G, V))
        return float(z @ Tz - (V.T @ z) @ G @ (V.T @ z)), float(len(z) - lost)


@dataclass(frozen=True)
class RowErrors:
    """What rows follow from.

    Attributes:
        J: Derivatives in the core, landmarks following it, then in the landmarks' errors of 1 sigma at a given core,
            shape (n, n_columns + n_landmark_errors).
        private: Variance of each row's private noise, shape (n,).
        L: How rows follow from other noise, sparse, shape (n, n_errors): from errors of 1 sigma.
        felt: `L M^T`, M what the fit made of those errors (see `graph.felt`), shape of J; no columns where fitted and
            predicted rows share none.
    """

    J: Floats
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
        s, L = sigma[:, None], self.L
        L = Sparse((L.data / np.repeat(sigma, np.diff(L.indptr)), L.indices, L.indptr), shape=L.shape)
        return RowErrors(self.J / s, self.private / sigma**2, L, self.felt / s)

    @staticmethod
    def joined(parts: Sequence[RowErrors]) -> RowErrors:
        """What several groups of rows, one after the other, follow from."""
        J, private, felt_ = (np.concatenate([getattr(p, name) for p in parts]) for name in ("J", "private", "felt"))
        return RowErrors(J, private, Sparse(scipy.sparse.vstack([part.L for part in parts])), felt_)

    def of_all(self, covariance: Floats) -> Floats:
        """The covariance of core and landmarks' errors, of that of the core: shape (n_all, n_all)."""
        return scipy.linalg.block_diag(covariance, np.eye(self.J.shape[1] - len(covariance)))

    def fitted(self, tangent: Floats) -> ResidualCovariance:
        """Covariance of fitted rows.

        Args:
            tangent: T, the covariance of the core.
        """
        return ResidualCovariance(self.private, self.L, self.J, -self.of_all(tangent))

    def predicted(self, tangent: Floats, actual: Floats) -> ResidualCovariance:
        """Covariance of predicted rows, whose errors the estimate may have felt.

        Args:
            tangent: T, the covariance of the core by the noise that rows are weighted by.
            actual: K, its covariance.
        """
        T, K = self.of_all(tangent), self.of_all(actual)
        if not self.felt.shape[1]:
            return ResidualCovariance(self.private, self.L, self.J, K)
        M = np.block([[K, -T], [-T, np.zeros_like(T)]])
        return ResidualCovariance(self.private, self.L, np.hstack([self.J, self.felt]), M)


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
        self._noises, self._n = noises, problem.variables.n_columns
        left = linear_system(problem, parameters).left
        of_landmarks, width = np.hstack([left.follow, left.inverse]), self._n + left.rank
        estimated, n = self._at.columns >= 0, len(self._at.columns)
        self._follow = np.zeros((n, width))
        self._follow[estimated] = of_landmarks[self._at.columns[estimated] - self._n]
        self._common = np.flatnonzero((reach(noises) > 0) & (reach(noises, test=True) > 0))
        core, landmarks = np.split(felt(problem, parameters, self._common), [self._n])
        self._felt = np.eye(width, self._n) @ core + of_landmarks.T @ landmarks
        blocks, unknowns = problem.data.blocks, problem.data.landmarks
        self._means = [says_where(problem.data, s) & ~estimated[s.nuisances].any(axis=1) for s in blocks]
        located = estimated | np.repeat(
            np.array([item.known for item in unknowns.items], dtype=np.bool_), unknowns.sizes
        )
        for s, touches in zip(blocks, self._means, strict=True):
            located[s.nuisances[touches].ravel()] = True
        self._nowhere: list[Booleans] = [np.any(~located[s.nuisances], axis=1) for s in blocks]
        counts = [s.n * s.kind.residual_dim * touches.any() for s, touches in zip(blocks, self._means, strict=True)]
        self._first = max((noise.place.n_errors for noise in noises), default=0) + np.cumsum([0, *counts])
        self._averaged = Sparse((n, int(self._first[-1])))
        for number in (number for number, touches in enumerate(self._means) if touches.any()):
            rows = np.flatnonzero(self._means[number])
            J, _, L, _ = self._given_landmarks(number, rows)
            place = blocks[number].nuisances[rows].ravel()
            B = Sparse((1.0 / np.bincount(place)[place], (place, np.arange(len(place)))), shape=(n, len(place)))
            self._follow[:, : self._n] += np.asarray(B @ J)
            self._averaged = self._averaged + B @ L

    def is_plain(self, number: int) -> bool:
        """Whether rows of a block follow from the core and private noise alone."""
        noise = self._noises[number]
        return not (noise.loading.shape[2] or noise.series.nuisances.shape[1])

    def chain(self, number: int) -> Chain:
        """The chain of a block at the estimate."""
        return self._at.chains[self._noises[number].series.table]

    def empty(self) -> RowErrors:
        """What no rows follow from."""
        n = self._follow.shape[1]
        felt_ = np.zeros((0, n if len(self._common) else 0))
        return RowErrors(np.zeros((0, n)), np.zeros(0), Sparse((0, int(self._first[-1]))), felt_)

    def errors(self, number: int, rows: Integers) -> RowErrors:
        """What the rows of some measurements of a block follow from."""
        core, private, L, N = self._given_landmarks(number, rows)
        J = np.pad(core, ((0, 0), (0, self._follow.shape[1] - self._n)))
        if N.shape[1]:
            nowhere = np.repeat(self._nowhere[number][rows], len(J) // max(len(rows), 1))
            J = J + np.where(nowhere, np.nan, 0.0)[:, None] + N @ self._follow
            L = L + N @ self._averaged
        felt_ = L[:, self._common] @ self._felt.T if len(self._common) else np.zeros((len(J), 0))
        return RowErrors(J, private, L, felt_)

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
        private = noise.variance[rows].ravel()
        L = noise.errors_at(rows)
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
