r"""Errors that measurements share, as states of a linear Gaussian system: eliminated exactly.

Rows y, whitened by their private noise, share errors `z ~ N(0, 1)` (joint readings of a configuration, measured poses
that pairs were formed from) through a sparse L: `y = A x + L z + e`, `e ~ N(0, 1)`. With S = 1 + L^T L, the posterior
mean of z for rows y is `Z = S^-1 L^T y`, and

    (y - L Z)^T (y - L Z) + Z^T Z = y^T (1 + L L^T)^-1 y,

so [y - L Z; Z] are rows of unit covariance that say the same. S is factored in the quickest of four ways: a dense
Cholesky factor of 1 + L L^T or of S, whichever is smaller; a sparse factor, configurations ordered so that trees do not
fill and hubs come last; or conjugate gradients with the blocks of configurations as preconditioner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from fg_calib.errors import SolverError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Sparse = scipy.sparse.csr_array

MAX_DENSE = 2000
"""Rows, or states, up to which a dense factor is the quickest."""

MAX_FILL = 10
"""Entries of a dense S for each entry of L up to which it is the quickest at any size, as of all pairs."""

MAX_LOOP_STATES = 4000
"""States that loops of the graph of configurations couple, up to which a sparse factor is quicker than iterations."""

MAX_ITERATIVE_STATES, MAX_ITERATIONS = 20_000, 2000
"""States, and iterations, up to which graphs of many loops are eliminated at all."""

ITERATION_TOLERANCE = 1e-12
"""Relative residual at which conjugate gradients stop."""

BATCH = 512
"""Right-hand sides that are solved for at once."""

N_PROBES = 64
"""Random vectors that estimate the trace of a large matrix; the estimate's sigma is below sqrt(2 n / 64) of n rows."""


@dataclass(frozen=True)
class SchurComplement:
    """The elimination of the error states that rows share.

    Attributes:
        loadings: L, change of each row per 1 sigma of each state, shape (n_rows, n_states).
        width: States of one configuration, which follow each other.
    """

    loadings: Sparse
    width: int = 1

    @property
    def n(self) -> int:
        """Number of rows that `whiten` returns."""
        n_rows, n_states = self.loadings.shape
        return n_rows if self._has_fewer_rows else n_rows + n_states

    def whiten(self, rows: Floats) -> Floats:
        """Rows of unit covariance that say the same as `rows`, shape (n_rows, k), do: shape (n, k)."""
        if isinstance(self._factor, _DenseRows):
            return self._factor.whiten(rows)
        Z = self.posterior_mean(rows)
        return np.concatenate([rows - self.loadings @ Z, Z])

    def posterior_mean(self, rows: Floats) -> Floats:
        """Z = S^-1 L^T rows, the posterior mean of the states, shape (n_states, k)."""
        if isinstance(self._factor, _DenseRows):
            out: Floats = self.loadings.T @ self._factor.weigh(rows)
            return out
        return self._factor.solve(self.loadings.T @ rows)

    def weigh(self, rows: Floats) -> Floats:
        """C^-1 rows with C = 1 + L L^T, shape (n_rows, k)."""
        out: Floats = rows - self.loadings @ self.posterior_mean(rows)
        return out

    def solve(self, b: Floats) -> Floats:
        """S^-1 b, shape (n_states, k)."""
        return self._factor.solve(b)

    @cached_property
    def variances(self) -> Floats:
        """Posterior variances of the states, the diagonal of S^-1, shape (n_states,); many take a solution each."""
        n = self.loadings.shape[1]
        out = np.empty(n)
        for start in range(0, n, BATCH):
            chosen = np.arange(start, min(start + BATCH, n))
            unit = np.zeros((n, len(chosen)))
            unit[chosen, chosen - start] = 1.0
            out[chosen] = self.solve(unit)[chosen, chosen - start]
        return out

    def trace(self, E: Sparse) -> float:
        """`tr E^T C^-1 E` of a sparse E, shape (n_rows, k); of large systems an estimate, see `N_PROBES`."""
        if min(self.loadings.shape) <= MAX_DENSE:
            common = scipy.sparse.csc_array(self.loadings.T @ E)
            total = float(E.power(2).sum())
            for start in range(0, common.shape[1], BATCH):
                D = common[:, start : start + BATCH].toarray()
                total -= float(np.vdot(D, self.solve(D)))
            return total
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(E.shape[1], N_PROBES))
        return float(np.sum(self.whiten(E @ signs) ** 2)) / N_PROBES

    @property
    def _has_fewer_rows(self) -> bool:
        n_rows, n_states = self.loadings.shape
        return n_rows <= min(n_states, MAX_DENSE)

    @cached_property
    def _factor(self) -> _Factor:
        L, width = self.loadings, self.width
        if self._has_fewer_rows:
            return _DenseRows(L)
        n = L.shape[1]
        if n <= MAX_DENSE or n * n <= MAX_FILL * L.nnz:
            return _DenseStates(L)
        graph = _configuration_graph(L, width)
        n_parts = csgraph.connected_components(graph, directed=False)[0]
        n_loops = (graph.nnz - graph.shape[0]) // 2 - graph.shape[0] + n_parts
        return _SparseStates(L, width, graph) if n_loops * width <= MAX_LOOP_STATES else _Iterative(L, width)


class SharedErrors(SchurComplement):
    """The elimination with what the variance components of several origins ask for."""

    def most_likely(self, rows: Floats) -> Floats:
        """The posterior mean of the states."""
        return self.posterior_mean(rows)

    def roughly_weighed(self, rows: Floats) -> Floats:
        """C^-1 rows."""
        return self.weigh(rows)

    def energy(self, E: Sparse) -> float:
        """Trace of E^T C^-1 E."""
        return self.trace(E)

    def products(self, roots: Sequence[Sparse]) -> tuple[Floats, Floats]:
        """Traces of E_i^T C^-1 E_i, shape (k,), and squared Frobenius norms of E_i^T C^-1 E_j, shape (k, k)."""
        small = min(self.loadings.shape) <= MAX_DENSE
        rng = np.random.default_rng(0)
        probed = [E.toarray() if small else E @ rng.choice([-1.0, 1.0], size=(E.shape[1], N_PROBES)) for E in roots]
        found = [self.weigh(X) if E.nnz else X for E, X in zip(roots, probed, strict=True)]
        traces = np.array([np.vdot(X, Y) for X, Y in zip(probed, found, strict=True)])
        squares = np.array([[np.sum((E.T @ Y) ** 2) for Y in found] for E in roots])
        n = 1 if small else N_PROBES
        return traces / n, 0.5 * (squares + squares.T) / n


class _Factor(Protocol):
    """S^-1."""

    def solve(self, b: Floats) -> Floats: ...


class _DenseRows:
    """S^-1 = 1 - L^T C^-1 L by the inverse Cholesky factor of C = 1 + L L^T."""

    def __init__(self, L: Sparse) -> None:
        factor = scipy.linalg.cholesky(np.eye(L.shape[0]) + (L @ L.T).toarray(), lower=True)
        self._L = L
        self._W: Floats = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True)

    def whiten(self, rows: Floats) -> Floats:
        return self._W @ rows

    def weigh(self, rows: Floats) -> Floats:
        return self._W.T @ (self._W @ rows)

    def solve(self, b: Floats) -> Floats:
        out: Floats = b - self._L.T @ self.weigh(self._L @ b)
        return out


class _DenseStates:
    """S^-1 by a dense Cholesky factor of S."""

    def __init__(self, L: Sparse) -> None:
        self._factor = scipy.linalg.cho_factor(np.eye(L.shape[1]) + (L.T @ L).toarray())

    def solve(self, b: Floats) -> Floats:
        out: Floats = scipy.linalg.cho_solve(self._factor, b)
        return out


class _SparseStates:
    """S^-1 by a sparse factor: states of one measurement each, trees, graphs of few loops.

    Breadth-first orders, reversed, have the parent of a node of a tree after it: nothing fills.
    """

    def __init__(self, L: Sparse, width: int, graph: Sparse) -> None:
        order = csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        self._order = (order[:, None] * width + np.arange(width)).ravel()
        S = (L.T @ L + scipy.sparse.eye_array(L.shape[1])).tocsr()[self._order][:, self._order]
        options = {"SymmetricMode": True, "Equil": False}
        self._factor = splu(S.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)

    def solve(self, b: Floats) -> Floats:
        out = np.empty_like(b)
        out[self._order] = self._factor.solve(np.ascontiguousarray(b[self._order]))
        return out


class _Iterative:
    """S^-1 by conjugate gradients on all columns together, the blocks of configurations as preconditioner."""

    def __init__(self, L: Sparse, width: int) -> None:
        if L.shape[1] > MAX_ITERATIVE_STATES:
            raise _too_many(L.shape[1])
        self._S = scipy.sparse.csr_array(L.T @ L + scipy.sparse.eye_array(L.shape[1]))
        blocks, n = self._S.tobsr((width, width)), L.shape[1] // width
        row = np.repeat(np.arange(n), np.diff(blocks.indptr))
        diagonal = blocks.data[np.flatnonzero(row == blocks.indices)]
        inverse = scipy.sparse.bsr_array((np.linalg.inv(diagonal), np.arange(n), np.arange(n + 1)))
        self._preconditioner = inverse.tocsr()

    def solve(self, b: Floats) -> Floats:
        columns, triangle = np.linalg.qr(b.reshape(len(b), -1))  # a weak direction would drown in errors of the others
        x, r = np.zeros_like(columns), columns.copy()
        s = self._preconditioner @ r
        p, rho = s, np.sum(r * s, axis=0)
        goal = ITERATION_TOLERANCE**2 * np.sum(columns**2, axis=0)
        for _ in range(MAX_ITERATIONS):
            if np.all(np.sum(r * r, axis=0) <= goal):
                out: Floats = (x @ triangle).reshape(b.shape)
                return out
            q = self._S @ p
            alpha = np.where(rho > 0.0, rho / np.maximum(np.sum(p * q, axis=0), 1e-300), 0.0)
            x, r = x + alpha * p, r - alpha * q
            s = self._preconditioner @ r
            new = np.sum(r * s, axis=0)
            p, rho = s + new / np.maximum(rho, 1e-300) * p, new
        raise _too_many(len(b))


def _too_many(n_states: int) -> SolverError:
    found = f"{n_states} errors that pairs share in loops are too many to eliminate"
    return SolverError(f"pairs: {found}; use model pose with frame unknown, which holds the same, or a star or chain")


def _configuration_graph(L: Sparse, width: int) -> Sparse:
    """Which configurations measurements couple, shape (n, n), the diagonal included."""
    shape = (L.shape[0], L.shape[1] // width)
    pattern = Sparse((np.ones(L.nnz, dtype=np.int32), L.indices // width, L.indptr.copy()), shape=shape)
    pattern.sum_duplicates()  # in place
    return Sparse(pattern.T @ pattern)
