"""Covariances of standardised residuals, and what is asked of them: variances, moments, rows whitened together.

`D + L L^T + P S P^T` of n rows is never inverted as it stands where that can be helped. Errors that reach many rows
(those of a star's hub) are few; of the others only what belongs to a handful of rows is left, in blocks B of these.
With U the few errors and P, and K = S^-1 + U^T B^-1 U, the inverse is `B^-1 - B^-1 U K^-1 U^T B^-1` (Woodbury 1950).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse import csgraph

from fg_calib.graph.noise import PRIVATE_SHARE

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Loadings = scipy.sparse.csr_array

FEW = 16
"""Rows that an error may reach, or that blocks may have, to count as few."""

MOST_WIDE = 64
"""Errors that reach more than a few rows, at most, for these to be set apart."""

WORTH = 3
"""How many times as many rows as columns of U there must be for blocks to take less time than the whole matrix."""

SMALL = 256
"""Rows of whose whole matrix moments take less time than of its parts."""


class LowRank:
    """Covariance `D + L L^T + P S P^T` of standardised residuals.

    Args:
        P: Shape (n, n_columns).
        L: Sparse, shape (n, n_errors).
        own: Diagonal of D, shape (n,).
        sign: Diagonal of S, 1 or -1, shape (n_columns,).
    """

    def __init__(self, P: Floats, L: Loadings, own: Floats, sign: Floats) -> None:
        self._P, self._L, self._d, self._sign = P, L, own, sign
        self._p = (P * P) @ sign
        self._l = squares_of_rows(L)

    @property
    def diagonal(self) -> Floats:
        """Variances, shape (n,)."""
        out: Floats = self._d + self._l + self._p
        return out

    def over(self, scale: Floats) -> LowRank:
        """The same of rows divided by a scale, shape (n,)."""
        by = 1.0 / scale
        return LowRank(self._P * by[:, None], times(self._L, by), self._d * by**2, self._sign)

    def at(self, rows: Integers) -> LowRank:
        """The part at some rows."""
        if are_all(rows, len(self._d)):
            return self
        return LowRank(self._P[rows], self._L[rows], self._d[rows], self._sign)

    def moments(self, rows: Integers) -> tuple[float, float]:
        """Trace, and trace of the square, of the part at `rows`."""
        if len(self._d) <= SMALL:
            return Dense(self._whole).moments(rows)
        wide, narrow = self._by_reach
        P, w, N, p, of_l, d = self._P[rows], wide[rows], narrow[rows], self._p[rows], self._l[rows], self._d[rows]
        both = np.hstack([w, P])
        signs = np.concatenate([np.ones(w.shape[1]), self._sign])
        square = np.sum(d * d) + 2.0 * np.sum(d * (of_l + p)) + signs @ (both.T @ both) ** 2 @ signs
        square += _squared_norm_of_square(N) + 2.0 * np.sum((N.T @ both) ** 2 @ signs)
        return float(np.sum(d + of_l + p)), float(square)

    def whitened(self, z: Floats) -> tuple[float, float, float]:
        """Sum of the squares of all rows, whitened together; its mean, and its degrees of freedom.

        D counts as `PRIVATE_SHARE` of the noise at least.

        Args:
            z: The rows, shape (n,).
        """
        floor = np.maximum(PRIVATE_SHARE * (self._d + self._l) - self._d, 0.0)
        blocks = self._blocks()
        found = self._whitened_whole(z, floor) if blocks is None else self._whitened_in_blocks(z, floor, *blocks)
        chi2, added, squared = found
        if not floor.any():
            return chi2, float(len(z)), float(len(z))
        # less what was added: of tr B and tr B^2, B = 1 - (A + floor)^-1 floor
        expected = len(z) - added
        return chi2, expected, expected**2 / (expected - added + squared)

    @cached_property
    def _whole(self) -> Floats:
        """The matrix as it stands, shape (n, n)."""
        A: Floats = np.diag(self._d) + (self._P * self._sign) @ self._P.T + (self._L @ self._L.T).toarray()
        return A

    @cached_property
    def _by_reach(self) -> tuple[Floats, Loadings]:
        """The columns of L that reach many rows, if they are few, dense; and the others."""
        reach = np.bincount(self._L.indices, minlength=self._L.shape[1])
        wide = np.flatnonzero(reach > FEW)
        if not 0 < len(wide) <= MOST_WIDE:
            return np.zeros((len(self._d), 0)), self._L
        return self._L[:, wide].toarray(), Loadings(self._L[:, np.flatnonzero((reach > 0) & (reach <= FEW))])

    def _blocks(self) -> tuple[Integers, Integers, Loadings] | None:
        """Of each row its block and its place there, and the covariance by errors within blocks; None if not worth it.

        Returns:
            Shapes (n,), (n,) and (n, n).
        """
        wide, narrow = self._by_reach
        n = len(self._d)
        if n < WORTH * (wide.shape[1] + self._P.shape[1]):
            return None
        C = Loadings(narrow @ narrow.T)
        n_blocks, block = csgraph.connected_components(C, directed=False)
        sizes = np.bincount(block, minlength=n_blocks)
        if sizes.max(initial=0) > FEW:
            return None
        order, place = np.argsort(block, kind="stable"), np.empty(n, dtype=np.int64)
        place[order] = np.arange(n) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return block.astype(np.int64), place, C

    def _whitened_in_blocks(
        self, z: Floats, floor: Floats, block: Integers, place: Integers, C: Loadings
    ) -> tuple[float, float, float]:
        """As `_whitened_whole`, by blocks."""
        n_blocks, m = int(block.max(initial=-1)) + 1, int(place.max(initial=-1)) + 1
        B = np.zeros((n_blocks, m, m))
        B[:] = np.eye(m)
        B[block, place, place] = self._d + floor
        pairs = C.tocoo()
        B[block[pairs.row], place[pairs.row], place[pairs.col]] += pairs.data
        inverse = np.linalg.inv(B)

        def through(matrices: NDArray[Any], columns: Floats) -> Floats:
            padded = np.zeros((n_blocks, m, columns.shape[1]))
            padded[block, place] = columns
            out: Floats = (matrices @ padded)[block, place]
            return out

        U = np.hstack([self._by_reach[0], self._P])
        solved = through(inverse, np.hstack([U, z[:, None]]))
        Y, y = solved[:, :-1], solved[:, -1]
        signs = np.concatenate([np.ones(U.shape[1] - len(self._sign)), self._sign])
        K = np.diag(signs) + U.T @ Y
        of_z = U.T @ y
        chi2 = float(z @ y - of_z @ np.linalg.solve(K, of_z))
        root = np.zeros((n_blocks, m))
        root[block, place] = np.sqrt(floor)
        scaled, Y = inverse * root[:, :, None] * root[:, None, :], Y * np.sqrt(floor)[:, None]
        G, H = np.linalg.solve(K, Y.T @ Y), np.linalg.solve(K, Y.T @ through(scaled, Y))
        added = np.einsum("nii->", scaled) - np.trace(G)
        squared = np.sum(scaled**2) - 2.0 * np.trace(H) + np.sum(G * G.T)
        return chi2, float(added), float(squared)

    def _whitened_whole(self, z: Floats, floor: Floats) -> tuple[float, float, float]:
        """`z^T (A + F)^-1 z`, and trace and trace of the square of `(A + F)^-1 F`; F has the diagonal `floor`."""
        factor = scipy.linalg.cholesky(self._whole + np.diag(floor), lower=True)
        white = scipy.linalg.solve_triangular(factor, z, lower=True)
        if not floor.any():
            return float(white @ white), 0.0, 0.0
        lower = np.tril(scipy.linalg.lapack.dpotri(factor, lower=True)[0])  # of the inverse
        lower *= np.sqrt(floor)[:, None] * np.sqrt(floor)
        squared = 2.0 * np.vdot(lower, lower) - np.sum(np.diag(lower) ** 2)
        return float(white @ white), float(np.trace(lower)), float(squared)


class Dense:
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


def are_all(rows: Integers, n: int) -> bool:
    """Whether chosen rows are all of n, in their order."""
    return len(rows) == n and np.array_equal(rows, np.arange(n))


def times(L: Loadings, by: Floats) -> Loadings:
    """Rows of a sparse matrix, each times something, shape (n,)."""
    return Loadings((L.data * np.repeat(by, np.diff(L.indptr)), L.indices, L.indptr), shape=L.shape)


def squares_of_rows(L: Loadings) -> Floats:
    """Sum of the squares of each row of a sparse matrix, shape (n,)."""
    row = np.repeat(np.arange(L.shape[0]), np.diff(L.indptr))
    out: Floats = np.bincount(row, L.data**2, L.shape[0])  # type: ignore[assignment] # of floats where there are weights
    return out


def _squared_norm_of_square(N: Loadings) -> float:
    """Sum of the squares of `N N^T`, or of `N^T N`, which is the same, whichever takes fewer products."""
    by_row, by_column = np.diff(N.indptr), np.bincount(N.indices, minlength=N.shape[1])
    product = N @ N.T if np.sum(by_column**2) < np.sum(by_row**2) else N.T @ N
    return float(product.power(2).sum())
