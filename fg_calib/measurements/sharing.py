r"""Errors that rows share: their covariance 1 + L L^T taken out of them, exactly at every size.

Rows y, each of unit variance of its own, share errors `z ~ N(0, 1)` through L, sparse. With S = 1 + L^T L and
`Z = S^-1 L^T A`, what the errors are for rows A at most likely, the rows `[A - L Z; Z]` are the whitened ones:

    (A - L Z)^T (A - L Z) + Z^T Z = A^T (1 + L L^T)^-1 A,   and   min over Z of the left side,

so they are those of a least-squares problem with z as further unknowns. Nothing is squared, and an error E of Z enters
the Gram matrix by `E^T S E` alone: less than `|R|^2` with the residual `R = L^T A - S Z`, since S >= 1.

Three ways to Z, for speed alone; the first two are dense and quicker where they are small:

- `_FewRows`: the inverse Cholesky factor of 1 + L L^T;
- `_FewErrors`: the Cholesky factor of S;
- `_Many`: conjugate gradients on S, many columns at once. Exact elimination would fill: random pairs leave a dense core
  of a good part of the poses. S is 1 and a sum over measurements, so what is left of it with blocks between
  configurations kept along a spanning forest alone is positive definite; eliminated from the leaves it gives D', and

      M = (D' + N) D'^-1 (D' + N)^T,   N the strictly lower blocks of S, in the order of elimination,

  is S itself if there are no loops (stars, chains, trees: one step), and symmetric Gauss-Seidel where there are. S is
  never multiplied by: with (Eisenstat 1981) v the new unknown and t = (1 + N)^-T v in units of D'^1/2, it acts on v
  as `t + (1 + N)^-1 (v + (D - 2) t)`.

References:
    Eisenstat (1981), Efficient implementation of a class of preconditioned conjugate gradient methods. SIAM Journal on
    Scientific and Statistical Computing 2(1).
    Hutchinson (1989), A stochastic estimator of the trace of the influence matrix for Laplacian smoothing splines.
    Communications in Statistics 18(3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse import csgraph

from fg_calib.errors import SolverError
from fg_calib.robot._numba import compiled, inlined
from fg_calib.robot.kinematics import over_processors

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Sparse = scipy.sparse.csr_array

MAX_DENSE = 2000
"""Rows, or errors, up to which dense matrices are quicker."""

FILLED = 10
"""Figures of a dense matrix of errors for each of L up to which it is quicker at any size: S is filled anyway, as of
all pairs, and takes no more memory than the rows."""

LANES = 16
"""Columns that take their steps together: at most, as the compiler need not know how many there are."""

EXACT = 1e-9
"""Bound of the error of the Gram matrix of whitened rows, as a share of it in any direction."""

MAX_EXACT = 1000
"""Rows, or errors, up to which products of covariances are formed."""

ROUGH = 1e-4
"""By how much residuals are reduced where what is sought is an estimate anyway."""

N_PROBES = 64
"""Random vectors that a trace is estimated with where it would take too many columns.

The estimate's sd is less than sqrt(2 n / 64) for n rows: an eighth of that of their chi-square."""

MANY_LOOPS = 5
"""Configurations that one is paired with, itself and the pair's other side counted, from which the forest does not
pay: with two pairs a pose steps are as many with it as without."""

_FIRST = 3e-8
"""By how much residuals are reduced before they are looked at; what is left by as much as it takes."""

_MOST_STEPS = 3000

_MOST_PASSES = 8

_AT_ONCE = 512
"""Variances that are worked out at once."""

_TINY = 1e-300


@dataclass(frozen=True)
class SharedErrors:
    """How rows follow from errors that they share.

    Attributes:
        loadings: L, rows per 1 sigma of each error, shape (n_rows, n_errors).
        width: Errors that belong to one configuration, one after the other.
    """

    loadings: Sparse
    width: int = 1

    @property
    def n(self) -> int:
        """Number of rows that whitening returns."""
        n_rows, n_errors = self.loadings.shape
        return n_rows if self._is_short else n_rows + n_errors

    def whiten(self, rows: Floats) -> Floats:
        """Rows whose Gram matrix is that of some rows in their covariance, shape (n, m).

        Args:
            rows: Shape (n_rows, m).
        """
        return self._way.whiten(rows)

    def most_likely(self, rows: Floats) -> Floats:
        """Z, the posterior mean of the errors, shape (n_errors, m)."""
        return self._way.most_likely(rows)

    @cached_property
    def variances(self) -> Floats:
        """Posterior variances of the errors, the diagonal of S^-1, shape (n_errors,).

        Of many errors they take a solution each: minutes for 10^5.
        """
        return self._way.variances()

    def energy(self, E: Sparse) -> float:
        """`tr E^T (1 + L L^T)^-1 E` for a sparse E, shape (n_rows, k); estimated if large, see `N_PROBES`."""
        return self._way.energy(E)

    def roughly_weighed(self, rows: Floats) -> Floats:
        """`(1 + L L^T)^-1` times rows, shape (n_rows, m): where it takes steps, so few that `ROUGH` is left."""
        way = self._way
        Z = way.roughly(rows) if isinstance(way, _Many) else way.most_likely(rows)
        out: Floats = rows - self.loadings @ Z
        return out

    def products(self, roots: Sequence[Sparse]) -> tuple[Floats, Floats]:
        """What covariances E E^T and the inverse of that of the rows, C = 1 + L L^T, make together.

        Args:
            roots: E of each, sparse, shape (n_rows, k).

        Returns:
            `tr E_i^T C^-1 E_i`, shape (m,), and the squared Frobenius norms of `E_i^T C^-1 E_j`, shape (m, m);
            estimated if there are many errors and rows, see `N_PROBES`.
        """
        if min(self.loadings.shape) <= MAX_EXACT:
            return self._exact_products(roots)
        rng = np.random.default_rng(0)
        probed = [E @ rng.choice([-1.0, 1.0], size=(E.shape[1], N_PROBES)) for E in roots]
        found = [self.roughly_weighed(X) if E.nnz else X for E, X in zip(roots, probed, strict=True)]
        traces = np.array([np.vdot(X, Y) for X, Y in zip(probed, found, strict=True)])
        squares = np.array([[np.sum((E.T @ Y) ** 2) for Y in found] for E in roots])
        return traces / N_PROBES, 0.5 * (squares + squares.T) / N_PROBES

    def _exact_products(self, roots: Sequence[Sparse]) -> tuple[Floats, Floats]:
        """`products` by a dense matrix of the rows, or of the errors, whichever are fewer.

        With S = 1 + L^T L, C^-1 is 1 - L S^-1 L^T.
        """
        L, (n_rows, n_errors) = self.loadings, self.loadings.shape
        if n_rows <= n_errors:
            whiten = _FewRows(L).whiten
            middle = [whiten(whiten((E @ E.T).toarray()).T) for E in roots]
            return np.array([np.trace(V) for V in middle]), np.array([[np.vdot(V, U) for U in middle] for V in middle])
        inverse = _FewErrors(L).inverse
        by_error = [scipy.sparse.csr_array(L.T @ E) for E in roots]
        reached = [scipy.sparse.csr_array(E @ D.T) for E, D in zip(roots, by_error, strict=True)]  # E E^T L
        turned = [inverse @ (D @ D.T).toarray() for D in by_error]
        traces = [E.power(2).sum() - np.trace(F) for E, F in zip(roots, turned, strict=True)]
        squares = np.zeros((len(roots), len(roots)))
        for i, (E, H, F) in enumerate(zip(roots, reached, turned, strict=True)):
            for j in range(i, len(roots)):
                direct = (E.T @ roots[j]).power(2).sum() - 2.0 * (H.T @ reached[j]).multiply(inverse).sum()
                squares[i, j] = squares[j, i] = direct + np.vdot(F, turned[j].T)
        return np.array(traces), squares

    @property
    def _is_short(self) -> bool:
        n_rows, n_errors = self.loadings.shape
        return n_rows <= min(n_errors, MAX_DENSE)

    @cached_property
    def _way(self) -> _FewRows | _FewErrors | _Many:
        if self._is_short:
            return _FewRows(self.loadings)
        n = self.loadings.shape[1]
        few = n <= MAX_DENSE or n * n <= FILLED * self.loadings.nnz
        return _FewErrors(self.loadings) if few else _Many(self.loadings, self.width)


class _FewRows:
    def __init__(self, L: Sparse) -> None:
        factor = scipy.linalg.cholesky(np.eye(L.shape[0]) + (L @ L.T).toarray(), lower=True)
        self._L = L
        self._W: Floats = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)

    def whiten(self, rows: Floats) -> Floats:
        return self._W @ rows

    def most_likely(self, rows: Floats) -> Floats:
        Z: Floats = self._L.T @ (self._W.T @ (self._W @ rows))
        return Z

    def variances(self) -> Floats:
        out: Floats = 1.0 - np.sum((self._L.T @ self._W.T) ** 2, axis=1)
        return out

    def energy(self, E: Sparse) -> float:
        return float(np.sum((E.T @ self._W.T) ** 2))


class _FewErrors:
    def __init__(self, L: Sparse) -> None:
        self._L = L
        self._factor = scipy.linalg.cho_factor(np.eye(L.shape[1]) + (L.T @ L).toarray())

    def whiten(self, rows: Floats) -> Floats:
        Z = self.most_likely(rows)
        return np.concatenate([rows - self._L @ Z, Z])

    def most_likely(self, rows: Floats) -> Floats:
        Z: Floats = scipy.linalg.cho_solve(self._factor, self._L.T @ rows)
        return Z

    def variances(self) -> Floats:
        return np.diag(self.inverse).copy()

    def energy(self, E: Sparse) -> float:
        common = self._L.T @ E
        return float(E.power(2).sum() - (common @ common.T).multiply(self.inverse).sum())

    @property
    def inverse(self) -> Floats:
        inverse: Floats = scipy.linalg.cho_solve(self._factor, np.eye(len(self._factor[0])))
        return inverse


class _Many:
    def __init__(self, L: Sparse, width: int) -> None:
        nodes = _pattern(L, width)
        graph = scipy.sparse.csr_array(nodes.T @ nodes)
        order, parent = _forest(graph)
        if graph.nnz > MANY_LOOPS * len(order):
            parent[:] = -1
        self._place = (order[:, None] * width + np.arange(width)).ravel()
        self._L = scipy.sparse.csr_array(L[:, self._place])
        self._S = scipy.sparse.csr_array(self._L.T @ self._L + scipy.sparse.eye_array(L.shape[1]))
        blocks = self._S.tobsr((width, width))
        blocks.sort_indices()
        figures, n = blocks.data.copy(), len(order)
        factor, diagonal = np.zeros((n, width, width)), np.zeros((n, width, width))
        eliminate_forest(blocks.indptr, blocks.indices, figures, parent, factor, diagonal)
        below = blocks.indices < np.repeat(np.arange(n), np.diff(blocks.indptr))
        starts = np.concatenate([[0], np.cumsum(below)])[blocks.indptr]
        N = scipy.sparse.bsr_array((figures[below], blocks.indices[below], starts), shape=self._S.shape).tocsr()
        each = np.arange(n + 1)
        middle = scipy.sparse.bsr_array((2.0 * np.eye(width) - diagonal, each[:-1], each)).tocsr()
        for matrix in (N, middle):
            matrix.eliminate_zeros()
        self._parts = tuple((M.indptr, M.indices, M.data) for M in (N, scipy.sparse.csr_array(N.T), middle))
        self._unit = np.linalg.inv(factor).astype(np.float64)  # of D'^-1/2

    def whiten(self, rows: Floats) -> Floats:
        Z = self._solve(rows)
        white = rows - self._L @ Z
        out = np.empty((len(rows) + len(Z), rows.shape[1]))
        out[: len(rows)], out[len(rows) + self._place] = white, Z
        return out

    def most_likely(self, rows: Floats) -> Floats:
        Z = np.empty((len(self._place), rows.shape[1]))
        Z[self._place] = self._solve(rows)
        return Z

    def roughly(self, rows: Floats) -> Floats:
        Z = np.empty((len(self._place), rows.shape[1]))
        Z[self._place] = self._steps(self._L.T @ rows, ROUGH)
        return Z

    def variances(self) -> Floats:
        n, out = len(self._place), np.zeros(len(self._place))
        least = 1.0 / self._S.diagonal()  # variances are no less
        for start in range(0, n, _AT_ONCE):
            chosen = np.arange(start, min(start + _AT_ONCE, n))
            unit = np.zeros((n, len(chosen)))
            unit[chosen, np.arange(len(chosen))] = 1.0
            found = self._conjugate(unit, partial(_missed_of_each, least[chosen]))
            out[self._place[chosen]] = np.sum(found * (unit + (unit - self._S @ found)), axis=0)
        return out

    def energy(self, E: Sparse) -> float:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(E.shape[1], N_PROBES))
        return float(np.sum(self.whiten(E @ signs) ** 2)) / N_PROBES

    def _solve(self, rows: Floats) -> Floats:
        """Z in the order of elimination.

        Orthonormal combinations of the columns are solved for, each to its own accuracy: a direction that is weak in
        the columns would drown in the errors of the others.
        """
        length = np.linalg.norm(rows, axis=0)
        by = np.where(length > 0.0, length, 1.0)
        triangle = np.linalg.qr(rows / by, mode="r")
        _, s, Vt = np.linalg.svd(triangle, full_matrices=False)
        kept = s > np.finfo(np.float64).eps * s.max(initial=0.0)
        apart = rows @ (Vt[kept].T / by[:, None] / s[kept])
        common, squares = self._L.T @ apart, apart.T @ apart

        def missed(Z: Floats, left: Floats) -> float:
            """Bound of the error of the Gram matrix, as a share of it, in any direction."""
            values, vectors = np.linalg.eigh(squares - Z.T @ (common + left))
            error = left @ (vectors / np.sqrt(np.maximum(values, _TINY)))
            return float(np.linalg.norm(error.T @ error, 2)) if error.size else 0.0

        Z: Floats = self._conjugate(common, missed) @ (s[kept, None] * Vt[kept] * length)
        return Z

    def _conjugate(self, b: Floats, missed: Callable[[Floats, Floats], float]) -> Floats:
        """`Z = S^-1 b`, so good that `missed`, of Z and its residual, is `EXACT`.

        Raises:
            SolverError: Rounding does not let it.
        """
        Z, left, tolerance = np.zeros_like(b), b, _FIRST
        for _ in range(_MOST_PASSES):
            Z = Z + self._steps(left, tolerance)
            left = b - self._S @ Z
            error = missed(Z, left)
            if error <= EXACT:
                return Z
            tolerance = max(_FIRST, 0.5 * float(np.sqrt(EXACT / error)))
        raise SolverError(
            f"errors that rows share: what rows say is known to {error:.1g}, expected {EXACT:.0g}; they are too large"
            " beside the rows' own noise"
        )

    def _steps(self, b: Floats, tolerance: float) -> Floats:
        """S^-1 b, roughly."""
        shape = (*self._unit.shape[:2], b.shape[1])
        scaled = (self._unit @ b.reshape(shape)).reshape(b.shape)

        together = np.array_split(scaled, max(1, -(-b.shape[1] // LANES)), axis=1)

        def run(k: int) -> Floats:
            x = np.array(together[k], order="C")
            conjugate_steps(*self._parts, x, tolerance, _MOST_STEPS)
            return x

        x = np.concatenate(list(over_processors(run, len(together))), axis=1).reshape(shape)
        out: Floats = (np.swapaxes(self._unit, 1, 2) @ x).reshape(b.shape)
        return out


def _missed_of_each(size: Floats, Z: Floats, left: Floats) -> float:
    """Bound of the error of `b^T S^-1 b`, as a share of its size, for each column apart."""
    return float(np.max(np.sum(left**2, axis=0) / size))


def _pattern(L: Sparse, width: int) -> Sparse:
    """Which configurations each row depends on, shape (n_rows, n_errors / width)."""
    shape = (L.shape[0], L.shape[1] // width)
    return scipy.sparse.csr_array((np.ones(len(L.indices), dtype=np.int32), L.indices // width, L.indptr), shape=shape)


def _forest(graph: Sparse) -> tuple[Integers, Integers]:
    """An order of the nodes of a graph, and the place in it of each one's parent, -1 for roots: parents come later."""
    n, labels = graph.shape[0], csgraph.connected_components(graph, directed=False)[1]
    roots = np.unique(labels, return_index=True)[1]
    coo = graph.tocoo()
    ends = np.concatenate([coo.coords[0], np.full(len(roots), n)]), np.concatenate([coo.coords[1], roots])
    joined = scipy.sparse.csr_array((np.ones(len(ends[0])), ends), shape=(n + 1, n + 1))
    found, above = csgraph.breadth_first_order(joined, n, directed=False)
    order = found[:0:-1].astype(np.int64)
    place = np.full(n + 1, -1)
    place[order] = np.arange(n)
    return order, place[above[order]]


@inlined
def _divide_right(X, G):  # type: ignore[no-untyped-def]
    """X G^-T in place of X, G lower triangular."""
    n = len(G)
    for c in range(n):
        for r in range(n):
            total = X[r, c]
            for m in range(c):
                total -= X[r, m] * G[c, m]
            X[r, c] = total / G[c, c]


@inlined
def _divide_left(G, X):  # type: ignore[no-untyped-def]
    """G^-1 X in place of X, G lower triangular."""
    n = len(G)
    for c in range(n):
        for r in range(n):
            total = X[r, c]
            for m in range(r):
                total -= G[r, m] * X[m, c]
            X[r, c] = total / G[r, r]


@inlined
def _cholesky(A):  # type: ignore[no-untyped-def]
    """The lower Cholesky factor in place of A."""
    n = len(A)
    for c in range(n):
        for r in range(c, n):
            total = A[r, c]
            for m in range(c):
                total -= A[r, m] * A[c, m]
            A[r, c] = total / A[c, c] if r > c else np.sqrt(total)
        for r in range(c):
            A[r, c] = 0.0


@compiled
def eliminate_forest(indptr, indices, blocks, parent, factor, diagonal):  # type: ignore[no-untyped-def]
    """Eliminate along a forest, and divide all blocks on and below the diagonal by the factors of both their ends.

    Args:
        indptr: Of the matrix by blocks.
        indices: Of the same, sorted.
        blocks: Its blocks, shape (n_blocks, w, w); those on and below the diagonal are replaced.
        parent: Of each node, a later one, or -1, shape (n,).
        factor: Filled: the lower Cholesky factor of what elimination leaves of each diagonal block, shape (n, w, w).
        diagonal: Filled: the diagonal blocks divided, shape (n, w, w).
    """
    w = factor.shape[1]
    for j in range(len(parent)):
        own, G = indptr[j], factor[j]
        while indices[own] < j:
            _divide_right(blocks[own], factor[indices[own]])
            own += 1
        G[:] = blocks[own]
        for k in range(indptr[j], own):
            if parent[indices[k]] == j:
                X = blocks[k]
                for r in range(w):
                    for c in range(w):
                        for m in range(w):
                            G[r, c] -= X[r, m] * X[c, m]
        _cholesky(G)
        for k in range(indptr[j], own + 1):
            _divide_left(G, blocks[k])
        _divide_right(blocks[own], G)
        diagonal[j] = blocks[own]


@compiled
def _length(x):  # type: ignore[no-untyped-def]
    """Sum of the squares of each column."""
    total = np.zeros(x.shape[1])
    for i in range(len(x)):
        for lane in range(len(total)):
            total[lane] += x[i, lane] ** 2
    return total


@inlined
def _take(starts, columns, figures, i, x, out):  # type: ignore[no-untyped-def]
    """Take row i of a sparse matrix times x off row i of out; four figures at once, as rows of blocks have them."""
    k, stop, row = starts[i], starts[i + 1], out[i]
    while k + 4 <= stop:
        a, b, c, d = x[columns[k]], x[columns[k + 1]], x[columns[k + 2]], x[columns[k + 3]]
        p, q, r, s = figures[k], figures[k + 1], figures[k + 2], figures[k + 3]
        for lane in range(len(row)):
            row[lane] -= p * a[lane] + q * b[lane] + r * c[lane] + s * d[lane]
        k += 4
    for j in range(k, stop):
        a, p = x[columns[j]], figures[j]
        for lane in range(len(row)):
            row[lane] -= p * a[lane]


@compiled
def conjugate_steps(below, above, middle, x, tolerance, most):  # type: ignore[no-untyped-def]
    """Conjugate gradients for `(N + D + N^T) x = b` as the module's head says, in units where D' = 1.

    Args:
        below: (indptr, indices, data) of N.
        above: Those of N^T.
        middle: Those of 2 - D.
        x: b, shape (n, m), which the solution takes the place of.
        tolerance: By how much the residual of each column is reduced.
        most: Steps that are enough.
    """
    n, m = x.shape
    for i in range(n):
        _take(*below, i, x, x)
    length, curve, step = _length(x), np.zeros(m), np.zeros(m)
    goal = tolerance**2 * length
    r, p, q, t = x.copy(), np.zeros_like(x), np.empty_like(x), np.empty_like(x)
    x[:] = 0.0
    for _ in range(most):
        if np.all(length <= goal):
            break
        for i in range(n - 1, -1, -1):
            for lane in range(m):
                p[i, lane] = r[i, lane] + step[lane] * p[i, lane]
                t[i, lane] = p[i, lane]
            _take(*above, i, t, t)
        curve[:] = 0.0
        for i in range(n):
            for lane in range(m):
                q[i, lane] = p[i, lane]
            _take(*middle, i, t, q)
            _take(*below, i, q, q)
            for lane in range(m):
                curve[lane] += p[i, lane] * (q[i, lane] + t[i, lane])
        step = np.where(length > goal, length / curve, 0.0)
        for i in range(n):
            for lane in range(m):
                x[i, lane] += step[lane] * p[i, lane]
                r[i, lane] -= step[lane] * (q[i, lane] + t[i, lane])
        new = _length(r)
        step = np.where(length > goal, new / length, 0.0)
        length = new
    for i in range(n - 1, -1, -1):
        _take(*above, i, x, x)
