"""Covariance of residuals: how each row follows from noise, parameters and landmarks, kept in low rank.

With C = D + L L^T the covariance of the noise, T that of the estimate (core and landmarks) and J the derivatives,
fitted residuals have the covariance `C - J T J^T`. Predicted ones have `C + J K J^T - J T F^T - F T J^T`, K what the
estimate is off, and -T F^T its covariance with the errors of configurations that fitted rows took part in as well.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse
from scipy.linalg import block_diag
from scipy.sparse import csgraph

from fg_calib.graph import PRIVATE_SHARE, RowNoise, Solution, WhitenedBlock, all_errors, loss_variance, reach
from fg_calib.inputs import Booleans, Floats, Integers, Record
from fg_calib.robot import Chain

Sparse = scipy.sparse.csr_array

FEW = 4
"""An error of more than one in so many rows is one of a covariance's low rank."""


class ResidualCovariance(Record):
    """Covariance `D + L L^T + P M P^T` of rows.

    Attributes:
        d: Diagonal of D, the variance of private noise, shape (n,).
        L: How rows follow from other noise, sparse, shape (n, n_errors): from errors of 1 sigma.
        P: Derivatives in core and landmarks. Where fitted and predicted rows share errors, then also `L F^T`, F the
            estimate's sensitivity to those errors e, which move it by -K F e. Shape (n, k).
        M: Symmetric, shape (k, k).
    """

    d: Floats
    L: Sparse
    P: Floats
    M: Floats

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        return self.d + row_squares(self.L) + np.einsum("ij,ij->i", self.P @ self.M, self.P)

    def at(self, rows: Integers) -> "ResidualCovariance":
        """The part at some rows."""
        return ResidualCovariance(self.d[rows], self.L[rows], self.P[rows], self.M)

    def over(self, sigma: Floats) -> "ResidualCovariance":
        """The covariance of rows divided by their sigma, shape (n,)."""
        L = Sparse(scipy.sparse.diags_array(1.0 / sigma) @ self.L)
        return ResidualCovariance(self.d / sigma**2, L, self.P / sigma[:, None], self.M)

    @staticmethod
    def joined(parts: "Sequence[ResidualCovariance]") -> "ResidualCovariance":
        """Several groups of rows, one after the other, M still open."""
        d, P = np.concatenate([part.d for part in parts]), np.concatenate([part.P for part in parts])
        return ResidualCovariance(d, Sparse(scipy.sparse.vstack([part.L for part in parts])), P, np.zeros((0, 0)))

    def with_errors(self, K: Floats, T: Floats | None = None) -> "ResidualCovariance":
        """The rows with M by the covariance of the estimate's errors.

        Args:
            K: Minus their covariance of fitted rows, their covariance of predicted ones (see `RowModel.of_all`).
            T: Covariance by the noise that rows are weighted by, if the estimate depends on errors of these rows.
        """
        cross, n = np.zeros_like(K) if T is None else -T, self.P.shape[1]
        return replace(self, M=np.block([[K, cross], [cross, np.zeros_like(K)]])[:n, :n])

    def split(self) -> "ResidualCovariance":
        """Copy with errors of more than one in `FEW` rows among the columns of P; without those of none."""
        n = np.bincount(self.L.indices, minlength=self.L.shape[1])
        many, few = len(self.d) < FEW * n, (n > 0) & (len(self.d) >= FEW * n)
        P, M = np.hstack([self.P, self.L[:, many].toarray()]), block_diag(self.M, np.eye(int(many.sum())))
        return ResidualCovariance(self.d, self.L[:, few], P, M)

    def square(self, rows: Integers, variances: Floats) -> float:
        """Trace of the square of the part at some rows.

        Args:
            rows: The rows.
            variances: Their variances, shape (n_rows,).
        """
        part = self.at(rows).split()
        d, L, P, M = part.d, part.L, part.P, part.M
        if len(rows) < len(M):
            return float(np.sum((np.diag(d) + (L @ L.T).toarray() + P @ M @ P.T) ** 2))
        gram, PMP, LP = L @ L.T if L.shape[0] < L.shape[1] else L.T @ L, P.T @ P @ M, L.T @ P
        square = d @ (2.0 * variances - d) + gram.power(2).sum() + 2.0 * np.vdot(LP @ M, LP) + np.vdot(PMP, PMP.T)
        return float(square)

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
    """Linear model of every block's rows at the estimate.

    Test rows that touch a point which no train row touched are judged about their mean: with W what takes the mean of
    each coordinate off, W J and W L, their private noise one more column of L each.

    Args:
        solution: The solution.
        noises: The rows and their noise at the estimate.
    """

    def __init__(self, solution: Solution, noises: Sequence[RowNoise]) -> None:
        problem, parameters, left = solution.problem, solution.parameters, solution.system.left
        v, unknowns = problem.variables, problem.data.landmarks
        self._at, self._noises = v.at(parameters), noises
        self._follow = np.vstack([np.eye(v.n_columns), left.follow])
        self._alone = np.vstack([np.zeros((v.n_columns, left.rank)), left.inverse])
        self._common = np.flatnonzero((reach(noises) > 0) & (reach(noises, test=True) > 0))
        if len(self._common):  # how the estimate follows from errors e: dx = -K M e, K its covariance
            L = all_errors(problem.noises, problem.rows)[:, self._common]
            J = problem.rows.private(self._at)[:, :-1]
            self._sensitivity = (L.T @ problem.rows.states.weigh(J)).T / loss_variance(problem)
        known = np.repeat(np.array([item.known for item in unknowns.items], dtype=np.bool_), unknowns.sizes)
        self._nowhere: Booleans = (self._at.columns < 0) & ~known
        alone = [np.flatnonzero(self._nowhere[n.block.nuisances].any(axis=1) & n.block.kind.is_contact) for n in noises]
        counts = [len(rows) * noise.block.kind.residual_dim for rows, noise in zip(alone, noises, strict=True)]
        n_errors = max((noise.place.n_errors for noise in noises), default=0)
        self._of_alone, self._first = alone, n_errors + np.cumsum([0, *counts])

    def is_plain(self, number: int) -> bool:
        """Whether rows of a block follow from the core and private noise alone."""
        noise = self._noises[number]
        return not (noise.loading.shape[2] or noise.block.nuisances.shape[1])

    def chain(self, number: int) -> Chain:
        """The chain of a block at the estimate."""
        return self._at.chains[self._noises[number].block.table]

    def of_core(self, covariance: ResidualCovariance) -> Floats:
        """Derivatives of rows in the core, landmarks following it, shape (n, n_columns)."""
        return covariance.P[:, : len(self._follow)] @ self._follow

    def of_all(self, covariance: Floats) -> Floats:
        """The covariance of core and landmarks, of that of the core: shape (n_all, n_all)."""
        return self._follow @ covariance @ self._follow.T + self._alone @ self._alone.T

    def errors(self, number: int, rows: Integers) -> ResidualCovariance:
        """Covariance of the rows of some measurements of a block; M is still open."""
        alone, width = self._of_alone[number], int(self._first[-1])
        P, L = self._derivatives(number, rows)
        d, n = self._noises[number].variance[rows].ravel(), len(P) // max(len(rows), 1)
        L = Sparse((L.data, L.indices, L.indptr), shape=(len(P), width))
        mine = np.flatnonzero(np.repeat(np.isin(rows, alone), n))
        if len(mine):
            at = (np.searchsorted(alone, rows)[:, None] * n + np.arange(n)).ravel()[mine]
            P[mine], others = self._about_means(number, alone, at)
            kept = np.where(np.isin(np.arange(len(d)), mine), 0.0, 1.0)
            put = Sparse((np.ones(len(mine)), (mine, np.arange(len(mine)))), shape=(len(d), len(mine)))
            d, L = d * kept, Sparse(scipy.sparse.diags_array(kept) @ L + put @ others)
        P = np.hstack([P, L[:, self._common] @ self._sensitivity.T]) if len(self._common) else P
        return ResidualCovariance(d, L, P, np.zeros((0, 0)))

    def _about_means(self, number: int, alone: Integers, at: Integers) -> tuple[Floats, Sparse]:
        """W P and W L of touches of points that no train row touched, their rows `at`."""
        P, L = self._derivatives(number, alone)
        private = np.sqrt(self._noises[number].variance[alone].ravel())
        row, column = np.arange(len(private)), self._first[number] + np.arange(len(private))
        own = Sparse((private, (row, column)), shape=(len(private), int(self._first[-1])))
        L = Sparse((L.data, L.indices, L.indptr), shape=own.shape) + own
        coordinate = self._noises[number].block.nuisances[alone].ravel()
        same = (coordinate[at][:, None] == coordinate).astype(np.float64)
        W = (at[:, None] == row) - same / same.sum(axis=1, keepdims=True)
        return W @ P, Sparse(Sparse(W) @ L)

    def _derivatives(self, number: int, rows: Integers) -> tuple[Floats, Sparse]:
        """Derivatives of some measurements' rows in core and landmarks, and in errors."""
        noise = self._noises[number]
        nuisances, at = noise.block.nuisances[rows], replace(self._at, coordinates=noise.place.coordinates)
        chunks = WhitenedBlock(noise.rows_at(rows), noise.block.table, number, nuisances).linearise(at)
        P = np.concatenate([np.zeros((0, at.n_columns + at.n_nuisance + 1)), *chunks])[:, :-1]
        if not noise.block.kind.is_contact:
            P[np.repeat(self._nowhere[nuisances].any(axis=1), noise.block.kind.residual_dim)] = np.nan
        return P, noise.errors_at(rows)


def row_squares(L: Sparse) -> Floats:
    """Sum of the squares of each row of a sparse matrix, shape (n,)."""
    return np.asarray(L.power(2).sum(axis=1), dtype=np.float64).ravel()
