"""Covariance of residuals: how each row follows from noise, parameters and landmarks, kept in low rank.

With C = D + L L^T the covariance of the noise, T that of the estimate (core and landmarks) and J the derivatives,
fitted residuals have the covariance `C - J T J^T`. Predicted ones have `C + J K J^T - J T F^T - F T J^T`, K what the
estimate is off, and -T F^T its covariance with the errors of configurations that fitted rows took part in as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from scipy.linalg import block_diag
from scipy.sparse import csgraph

from fg_calib.graph import PRIVATE_SHARE, Problem, RowNoise, felt, linear_system, reach
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
        d: Diagonal of D, the variance of private noise, shape (n,).
        L: How rows follow from other noise, sparse, shape (n, n_errors): from errors of 1 sigma.
        P: Derivatives in the core, landmarks following it, then in the landmarks' errors of 1 sigma at a given core.
            Where fitted and predicted rows share errors, then also `L F^T`, F what the fit made of those errors (see
            `graph.felt`). Shape (n, k).
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
        """The part at some rows."""
        return ResidualCovariance(self.d[rows], self.L[rows], self.P[rows], self.M)

    def over(self, sigma: Floats) -> ResidualCovariance:
        """The covariance of rows divided by their sigma, shape (n,)."""
        L = Sparse(
            (self.L.data / np.repeat(sigma, np.diff(self.L.indptr)), self.L.indices, self.L.indptr), shape=self.L.shape
        )
        return ResidualCovariance(self.d / sigma**2, L, self.P / sigma[:, None], self.M)

    @staticmethod
    def joined(parts: Sequence[ResidualCovariance]) -> ResidualCovariance:
        """Several groups of rows, one after the other, M still open."""
        d, P = np.concatenate([part.d for part in parts]), np.concatenate([part.P for part in parts])
        return ResidualCovariance(d, Sparse(scipy.sparse.vstack([part.L for part in parts])), P, np.zeros((0, 0)))

    def with_errors(self, K: Floats, T: Floats | None = None) -> ResidualCovariance:
        """The rows with M by the covariance of the estimate's errors.

        Args:
            K: Minus their covariance of fitted rows, their covariance of predicted ones (see `RowModel.of_all`).
            T: The covariance by the noise that rows are weighted by, where the estimate felt errors of these rows.
        """
        felt_, n = np.zeros_like(K) if T is None else -T, self.P.shape[1]
        return replace(self, M=np.block([[K, felt_], [felt_, np.zeros_like(K)]])[:n, :n])

    def split(self) -> ResidualCovariance:
        """The same covariance with errors of more than one in `FEW` rows among the columns of P."""
        many = FEW * np.bincount(self.L.indices, minlength=self.L.shape[1]) > len(self.d)
        P, M = np.hstack([self.P, self.L[:, many].toarray()]), block_diag(self.M, np.eye(int(many.sum())))
        return ResidualCovariance(self.d, self.L[:, ~many], P, M)

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at some rows."""
        part = self.at(rows).split()
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
        whole = self.at(rows)
        part, d = whole.split(), np.maximum(whole.d, PRIVATE_SHARE * (whole.d + row_squares(whole.L)))
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


class RowModel:
    """What the rows of every block follow from at the estimate.

    Args:
        problem: The problem.
        parameters: The estimate.
        noises: The rows and their noise at the estimate.
    """

    def __init__(self, problem: Problem, parameters: Floats, noises: Sequence[RowNoise]) -> None:
        self._at = problem.variables.at(parameters)
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
        located = estimated | np.repeat(
            np.array([item.known for item in unknowns.items], dtype=np.bool_), unknowns.sizes
        )
        self._nowhere: list[Booleans] = [np.any(~located[s.nuisances], axis=1) for s in blocks]
        self._n_errors = max((noise.place.n_errors for noise in noises), default=0)

    def is_plain(self, number: int) -> bool:
        """Whether rows of a block follow from the core and private noise alone."""
        noise = self._noises[number]
        return not (noise.loading.shape[2] or noise.series.nuisances.shape[1])

    def chain(self, number: int) -> Chain:
        """The chain of a block at the estimate."""
        return self._at.chains[self._noises[number].series.table]

    def empty(self) -> ResidualCovariance:
        """No rows."""
        n = self._follow.shape[1]
        P = np.zeros((0, 2 * n if len(self._common) else n))
        return ResidualCovariance(np.zeros(0), Sparse((0, self._n_errors)), P, np.zeros((0, 0)))

    def of_all(self, covariance: Floats) -> Floats:
        """The covariance of core and landmarks' errors, of that of the core: shape (n_all, n_all)."""
        return block_diag(covariance, np.eye(self._follow.shape[1] - self._n))

    def errors(self, number: int, rows: Integers) -> ResidualCovariance:
        """What the rows of some measurements of a block follow from; M is still open."""
        core, private, L, N = self._given_landmarks(number, rows)
        P = np.pad(core, ((0, 0), (0, self._follow.shape[1] - self._n)))
        if N.shape[1]:
            nowhere = np.repeat(self._nowhere[number][rows], len(P) // max(len(rows), 1))
            P = P + np.where(nowhere, np.nan, 0.0)[:, None] + N @ self._follow
        P = np.hstack([P, L[:, self._common] @ self._felt.T]) if len(self._common) else P
        return ResidualCovariance(private, L, P, np.zeros((0, 0)))

    def _given_landmarks(self, number: int, rows: Integers) -> tuple[Floats, Floats, Sparse, Sparse]:
        """J, private variance and L of rows were their landmarks known; derivatives in these, sparse."""
        noise = self._noises[number]
        J = residuals.linearise(noise.rows_at(rows), self.chain(number))[1]
        n, h = J.shape[:2]
        in_landmarks = J[:, :, self._n :]
        row = np.broadcast_to(np.arange(n * h).reshape(n, h, 1), in_landmarks.shape).ravel()
        place = np.broadcast_to(noise.series.nuisances[rows][:, None], in_landmarks.shape).ravel()
        N = Sparse((in_landmarks.ravel(), (row, place)), shape=(n * h, len(self._follow)))
        private = noise.variance[rows].ravel()
        L = noise.errors_at(rows)
        return J[:, :, : self._n].reshape(n * h, -1), private, L, N


def square_root(covariance: Floats) -> Floats:
    """H with H H^T a covariance, shape (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    out: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return out


def row_squares(L: Sparse) -> Floats:
    """Sum of the squares of each row of a sparse matrix, shape (n,)."""
    return np.asarray(L.power(2).sum(axis=1), dtype=np.float64).ravel()
