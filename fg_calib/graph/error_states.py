r"""Errors that measurements share, as states of a linear Gaussian system: eliminated exactly.

Rows y, whitened by their private noise, share errors `z ~ N(0, 1)` (joint readings of a configuration, measured poses
that pairs were formed from) through a sparse L: `y = A x + L z + e`, `e ~ N(0, 1)`. With S = 1 + L^T L, the posterior
mean of z for rows y is `Z = S^-1 L^T y`, and

    (y - L Z)^T (y - L Z) + Z^T Z = y^T (1 + L L^T)^-1 y,

so [y - L Z; Z] are rows of unit covariance that say the same. S is factored in the quickest of four ways: a dense
Cholesky factor of 1 + L L^T or of S, whichever is smaller; or a sparse factor, configurations ordered so that trees do
not fill and reference poses come last, or by minimum degree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from fg_calib.graph.noise_models import NoiseSource, RowNoise, whitening_of
from fg_calib.inputs import Booleans, Brief, Floats, Integers, SolverError
from fg_calib.measurements import Block, pack, residuals, unpack
from fg_calib.robot import SPAN, Chain, over_spans

Sparse = scipy.sparse.csr_array

MAX_DENSE = 2000
"""Rows, or states, up to which a dense factor is the quickest."""

MAX_FILL = 10
"""Entries of a dense S for each entry of L up to which it is the quickest at any size, as of all pairs."""

MAX_LOOP_STATES = 4000
"""States that loops of the graph of configurations couple, up to which a breadth-first order fills little."""

MAX_SPARSE = 15_000
"""Rows, or states, up to which graphs of many loops are eliminated at all: 0.4 s for 6 000, 8 s for 15 000."""

BATCH = 512
"""Right-hand sides that are solved for at once."""

N_PROBES = 64
"""Random vectors that estimate the trace of a large matrix; the estimate's sigma is below sqrt(2 n / 64) of n rows."""


CACHED_TRIANGLES = 4
"""Triangles of a set of rows that are kept: many ask what rows say at the start, at nominal and at the estimate."""

MIN_WEIGHT = 1e-12
"""A robust weight below this is taken for this."""


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
        return n_rows if self._has_few_rows else n_rows + n_states

    def whiten(self, rows: Floats) -> Floats:
        """Rows of unit covariance that say the same as `rows`, shape (n_rows, k), do: shape (n, k)."""
        if self._has_few_rows:
            return self._unit @ rows
        Z = self.posterior_mean(rows)
        return np.concatenate([rows - self.loadings @ Z, Z])

    def posterior_mean(self, rows: Floats) -> Floats:
        """Z = S^-1 L^T rows = L^T C^-1 rows, the posterior mean of the states, shape (n_states, k)."""
        L, (of_rows, solve) = self.loadings, self._factor
        out: Floats = L.T @ solve(rows) if of_rows else solve(L.T @ rows)
        return out

    def weigh(self, rows: Floats) -> Floats:
        """C^-1 rows with C = 1 + L L^T, shape (n_rows, k)."""
        of_rows, solve = self._factor
        return solve(rows) if of_rows else rows - self.loadings @ self.posterior_mean(rows)

    def solve(self, b: Floats) -> Floats:
        """S^-1 b, shape (n_states, k)."""
        L, (of_rows, solve) = self.loadings, self._factor
        return b - L.T @ solve(L @ b) if of_rows else solve(b)

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
    def _has_few_rows(self) -> bool:
        n_rows, n_states = self.loadings.shape
        return n_rows <= min(n_states, MAX_DENSE)

    @cached_property
    def _unit(self) -> Floats:
        """The inverse Cholesky factor of C."""
        L, one = self.loadings, np.eye(self.loadings.shape[0])
        factor = scipy.linalg.cholesky(one + (L @ L.T).toarray(), lower=True, check_finite=False)
        out: Floats = scipy.linalg.solve_triangular(factor, one, lower=True, check_finite=False)
        return out

    @cached_property
    def _factor(self) -> tuple[bool, Callable[[Floats], Floats]]:
        """Whether C is factored, not S; and what multiplies by the inverse."""
        L, width, (n_rows, n_states) = self.loadings, self.width, self.loadings.shape
        if self._has_few_rows:
            return True, lambda b: self._unit.T @ (self._unit @ b)
        if n_states <= MAX_DENSE or n_states**2 <= MAX_FILL * L.nnz:
            S = scipy.linalg.cho_factor(np.eye(n_states) + (L.T @ L).toarray(), check_finite=False)
            return False, lambda b: scipy.linalg.cho_solve(S, b, check_finite=False)
        graph = _configuration_graph(L, width)
        n_parts = csgraph.connected_components(graph, directed=False)[0]
        n_loops = (graph.nnz - graph.shape[0]) // 2 - graph.shape[0] + n_parts
        if n_loops * width <= MAX_LOOP_STATES:
            order = csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
            return False, _sparse_solver(L.T @ L, (order[:, None] * width + np.arange(width)).ravel())
        if min(n_rows, n_states) > MAX_SPARSE:
            raise _too_many(n_states)
        return n_rows < n_states, _sparse_solver(L @ L.T if n_rows < n_states else L.T @ L)


def _sparse_solver(M: Sparse, order: Integers | None = None) -> Callable[[Floats], Floats]:
    """What multiplies by the inverse of 1 + M, by a sparse factor.

    Breadth-first orders, reversed, have the parent of a node of a tree after it: states of one measurement each, trees
    and graphs of few loops do not fill. Where loops are many, minimum degree leaves the smallest core.

    Args:
        M: Symmetric, shape (n, n).
        order: Order of elimination; minimum degree if None.
    """
    M = (M + scipy.sparse.eye_array(M.shape[0])).tocsr()
    place = slice(None) if order is None else order
    M = M if order is None else M[order][:, order]
    options = {"SymmetricMode": True, "Equil": False}
    by: Literal["MMD_AT_PLUS_A", "NATURAL"] = "MMD_AT_PLUS_A" if order is None else "NATURAL"
    factor = splu(M.tocsc(), permc_spec=by, diag_pivot_thresh=0.0, options=options)

    def solve(b: Floats) -> Floats:
        out = np.empty_like(b)
        out[place] = factor.solve(np.ascontiguousarray(b[place]))
        return out

    return solve


def _too_many(n_states: int) -> SolverError:
    found = f"{n_states} errors that pairs share in loops are too many to eliminate"
    return SolverError(f"pairs: {found}; use model pose with frame unknown, which holds the same, or a star or chain")


def _configuration_graph(L: Sparse, width: int) -> Sparse:
    """Which configurations measurements couple, shape (n, n), the diagonal included."""
    shape = (L.shape[0], L.shape[1] // width)
    pattern = Sparse((np.ones(L.nnz, dtype=np.int32), L.indices // width, L.indptr.copy()), shape=shape)
    pattern.sum_duplicates()  # in place
    return Sparse(pattern.T @ pattern)


@dataclass(frozen=True)
class State(Brief):
    """The arm and the nuisance coordinates at some parameters.

    Attributes:
        chains: The chain from each table's measurement frame, by the table's number.
        coordinates: Values of all nuisance coordinates.
        columns: Jacobian column of each of them, -1 for those that are not estimated.
        n_columns: Number of columns of the core.
        n_nuisance: Number of columns of the nuisance variables.
    """

    chains: tuple[Chain, ...]
    coordinates: Floats
    columns: Integers
    n_columns: int
    n_nuisance: int

    @cached_property
    def mark(self) -> bytes:
        """What tells it from others."""
        arrays = [array for chain in self.chains for array in (*chain.arrays[:7], *chain.arrays[9:])]
        marks = [array.tobytes() for array in (*arrays, self.coordinates, self.columns)]
        return sha256(b"|".join([*marks, repr((self.n_columns, self.n_nuisance)).encode()])).digest()

    def without_columns(self) -> State:
        """The same without derivatives."""
        return replace(self, chains=tuple(chain.without_columns() for chain in self.chains), n_columns=0, n_nuisance=0)


@dataclass(frozen=True)
class WhitenedSeries(Brief):
    """Train rows of one series, whitened by their private noise.

    Attributes:
        block: The rows.
        table: Which table they are from.
        series: Which series.
        nuisances: Nuisance coordinates of each measurement, shape (n, kind.n_nuisances).
        offset: Taken from the whitened residuals before anything else, shape (n, residual_dim); None for zero.
    """

    block: Block
    table: int
    series: int
    nuisances: Integers
    offset: Floats | None = None

    @property
    def n_rows(self) -> int:
        """Number of scalar rows."""
        return self.block.n * self.block.residual_dim

    def only(self, k: int) -> WhitenedSeries:
        """One of its measurements."""
        chunk = slice(k, k + 1)
        offset = None if self.offset is None else self.offset[chunk]
        return WhitenedSeries(
            residuals.rows_of(self.block, chunk), self.table, self.series, self.nuisances[chunk], offset
        )

    @property
    def is_plain(self) -> bool:
        """Whether its rows depend on the core alone, as the kernel computes them."""
        return self.nuisances.shape[1] == 0 and self.offset is None

    def at(self, at: State) -> Block:
        """The block with its nuisances' values."""
        if not self.nuisances.shape[1]:
            return self.block
        return replace(self.block, nuisances=at.coordinates[self.nuisances])

    def linearise(self, at: State) -> Iterator[Floats]:
        """[J r] by all columns, nuisances' among them, chunk by chunk, shape (rows, n_columns + n_nuisance + 1)."""
        chain, block = at.chains[self.table], self.at(at)
        wide = at.n_columns + at.n_nuisance
        for start in range(0, block.n, SPAN):
            chunk = slice(start, start + SPAN)
            r, J = residuals.linearise(residuals.rows_of(block, chunk), chain)
            if self.offset is not None:
                r = r - self.offset[chunk]
            out = np.zeros((*r.shape, wide + 1))
            out[:, :, : at.n_columns], out[:, :, -1] = J[:, :, : at.n_columns], r
            if at.n_nuisance and self.nuisances.shape[1]:
                _scatter(out, J[:, :, at.n_columns :], at.columns[self.nuisances[chunk]])
            yield out.reshape(r.size, -1)


def _scatter(out: Floats, N: Floats, columns: Integers) -> None:
    """Put derivatives in nuisances, shape (n, residual_dim, k), in their columns, shape (n, k), of rows."""
    for k in range(N.shape[2]):
        there = np.flatnonzero(columns[:, k] >= 0)
        out[there, :, columns[there, k]] = N[there, :, k]


@dataclass(frozen=True)
class WhitenedBlock(Brief):
    """Whitened train rows; every row counts as one measurement where they share errors.

    Attributes:
        parts: The rows of each series.
        states: How all their rows follow from error states; None if nothing is shared.
        configurations: Configurations whose errors are shared, in the order of the errors.
        joints: Place of the joints' errors among those of a configuration.
        spare: E with E E^T what of the rows' own noise is there for numerical safety alone; None if nothing is.
    """

    parts: tuple[WhitenedSeries, ...]
    states: SchurComplement | None = None
    configurations: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    joints: int = 0
    spare: Sparse | None = None
    _triangles: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def n_rows(self) -> int:
        """Number of rows that `linearise` returns."""
        return sum(part.n_rows for part in self.parts) if self.states is None else self.states.n

    @property
    def n_spare(self) -> float:
        """How many degrees of freedom the rows have by `spare` alone: its trace over the rows' covariance."""
        if self.spare is None:
            return 0.0
        return float(self.spare.power(2).sum()) if self.states is None else self.states.trace(self.spare)

    @property
    def coordinates(self) -> Integers:
        """Nuisance coordinates that the rows depend on."""
        return np.unique(np.concatenate([part.nuisances.ravel() for part in self.parts]))

    def private(self, at: State) -> Floats:
        """[J r] before correlation is dealt with, shape (all rows, n_columns + n_nuisance + 1)."""
        return np.concatenate([chunk for part in self.parts for chunk in part.linearise(at)])

    def linearise(self, at: State) -> tuple[Floats, Floats]:
        """Whitened residuals, shape (n_rows,), and their derivatives, shape (n_rows, n_columns + n_nuisance)."""
        rows = self.private(at)
        if self.states is not None:
            rows = self.states.whiten(rows)
        return rows[:, -1], rows[:, :-1]

    def squared_norm(self, at: State) -> float:
        """Sum of squared whitened residuals."""
        free = at.without_columns()
        if self._kernel_alone:
            return residuals.squared_norm(self.parts[0].block, free.chains[self.parts[0].table])
        r, _ = self.linearise(free)
        return float(r @ r)

    def triangle(self, at: State) -> Floats:
        """R of a thin QR of [J r], shape (n_columns + n_nuisance + 1,) * 2; the last ones are remembered."""
        if at.mark not in self._triangles:
            for mark in list(self._triangles)[: 1 - CACHED_TRIANGLES]:
                self._triangles.pop(mark, None)
            self._triangles[at.mark] = self._triangle(at)
        return self._triangles[at.mark].copy()

    def _triangle(self, at: State) -> Floats:
        if self._kernel_alone:
            return _padded(residuals.triangle(self.parts[0].block, at.chains[self.parts[0].table]), at.n_nuisance)
        chunks = self.parts[0].linearise(at) if self._one_by_one else iter([self._whitened(at)])
        R = np.zeros((at.n_columns + at.n_nuisance + 1,) * 2)
        for chunk in chunks:
            for start in range(0, len(chunk), 4 * SPAN):
                R = np.linalg.qr(np.vstack([R, chunk[start : start + 4 * SPAN]]), mode="r")  # type: ignore[assignment]
        return R

    def posterior_mean(self, at: State) -> Floats:
        """Posterior mean of the error states, shape (n_configurations, width)."""
        if self.states is None:
            return np.zeros((0, 0))
        r = self.private(at.without_columns())[:, -1:]
        return self.states.posterior_mean(r)[:, 0].reshape(len(self.configurations), -1)

    def weighed(self, at: State) -> Floats:
        """C^-1 J, C the covariance of all rows whitened by their private noise, shape (all rows, n_all_columns)."""
        J = self.private(at)[:, :-1]
        return J if self.states is None else J - self.states.loadings @ self.states.posterior_mean(J)

    def _whitened(self, at: State) -> Floats:
        rows = self.private(at)
        return rows if self.states is None else self.states.whiten(rows)

    @property
    def _one_by_one(self) -> bool:
        return self.states is None and len(self.parts) == 1

    @property
    def _kernel_alone(self) -> bool:
        return self._one_by_one and self.parts[0].is_plain


def _padded(R: Floats, n_nuisance: int) -> Floats:
    """A square matrix of [J r] with columns and rows of zeros for the nuisances before its last."""
    if not n_nuisance:
        return R
    keep = np.append(np.arange(len(R) - 1), len(R) + n_nuisance - 1)
    out = np.zeros((len(R) + n_nuisance,) * 2)
    out[np.ix_(keep, keep)] = R
    return out


def whitened_rows(
    noises: Sequence[RowNoise], *, sharing: bool, joint_errors: Floats | None, weights: Sequence[Floats] | None
) -> tuple[WhitenedBlock, ...]:
    """The train rows of series, whitened.

    Args:
        noises: The rows and their noise.
        sharing: Whether measurements share the errors of their configurations, or each counts as having its own.
        joint_errors: Errors of the readings that the rows are linearised about, where they are estimated, shape
            (n_configurations, n_joints); then they count as shared although only one measurement has them.
        weights: Robust weight of each measurement of each series; None for 1.
    """
    shares = ErrorStates(noises, sharing, joint_errors is not None)
    gathered = [
        _whiten(i, noise, shares, joint_errors, None if weights is None else weights[i])
        for i, noise in enumerate(noises)
        if len(noise.series.train)
    ]
    together = [(part, *shared) for part, shared in gathered if shared and shared[0].nnz]
    alone = [WhitenedBlock((part,)) for part, shared in gathered if not (shared and shared[0].nnz)]
    return (*alone, shares.row_set(together)) if together else tuple(alone)


def share_errors(noises: Sequence[RowNoise]) -> bool:
    """Whether errors of configurations that are not estimated reach more than one train measurement."""
    shares = ErrorStates(noises, sharing=True, estimated=False)
    return any(shares.mask(source)[noise.series.train].any() for noise in noises for source in _not_estimated(noise))


def _not_estimated(noise: RowNoise) -> tuple[NoiseSource, ...]:
    """The sources of a series' noise but for estimated joint errors, which count as shared whatever is asked."""
    return tuple(s for s in noise.sources if not (noise.place.joints_estimated and s.name == "joints"))


def correlation_of(noises: Sequence[RowNoise], rows: Sequence[WhitenedBlock], at: State, follow: Floats) -> Floats:
    """J^T (C - 1) J of rows that share errors but are whitened as if they did not, shape (n_columns, n_columns).

    Args:
        noises: The rows of all series and their noise.
        rows: The whitened train rows.
        at: Where the derivatives J are wanted; C is the covariance of the whitened rows.
        follow: How the nuisance variables follow the core, shape (n_nuisance, n_columns): in J they do.
    """
    shares = ErrorStates(noises, sharing=True, estimated=False)
    n, own = at.n_columns, np.zeros((at.n_columns, at.n_columns))
    common = np.zeros((shares.n_errors, n))
    for part in (part for row_set in rows for part in row_set.parts):
        noise = noises[part.series]
        sources, train, residual_dim = _not_estimated(noise), noise.series.train, noise.series.kind.residual_dim
        wide = np.concatenate(list(part.linearise(at)))
        J = wide[:, :n] + wide[:, n:-1] @ follow
        W = whitener_of(noise, part)
        masks = {source.name: shares.mask(source)[train] for source in sources}
        common += shares.loading(noise, train, W, masks, sources).T @ J
        for source in sources:
            G = np.einsum("nhk,nkew->nhew", W, source.loading[train] * masks[source.name][:, None, :, None])
            each = np.einsum("nhew,nhp->newp", G, J.reshape(len(train), residual_dim, n)).reshape(-1, n)
            own += each.T @ each
    out: Floats = common.T @ common - own
    return out


def felt_errors(
    noises: Sequence[RowNoise], rows: Sequence[WhitenedBlock], at: State, errors: ErrorStates, wanted: Integers
) -> Floats:
    """J^T C^-1 L: what errors of 1 sigma make of the right-hand side, shape (n_columns + n_nuisance, len(wanted)).

    Args:
        noises: The rows of all series and their noise.
        rows: The whitened train rows.
        at: Where the derivatives J are wanted; C is the covariance that the rows are weighted by.
        errors: The errors of all configurations.
        wanted: Numbers of those that are asked for.
    """
    out = np.zeros((at.n_columns + at.n_nuisance, len(wanted)))
    for row_set in rows:
        J, start = row_set.weighed(at), 0
        for part in row_set.parts:
            noise = noises[part.series]
            L = errors.loading(noise, noise.series.train, whitener_of(noise, part))[:, wanted]
            out += (L.T @ J[start : start + part.n_rows]).T
            start += part.n_rows
    return out


def whitener_of(noise: RowNoise, part: WhitenedSeries) -> Floats:
    """What the train rows of a series were multiplied by to be whitened, shape (n, residual_dim, residual_dim)."""
    h, plain = part.block.residual_dim, noise.rows_at(noise.series.train)
    out: Floats = unpack(part.block.whitening, h) @ np.linalg.inv(unpack(plain.whitening, h))
    return out


def _whiten(
    number: int, noise: RowNoise, states: ErrorStates, joint_errors: Floats | None, weights: Floats | None
) -> tuple[WhitenedSeries, tuple[Sparse, Sparse] | None]:
    """The train rows of a series; how they follow from error states, if they do, and E of `WhitenedBlock.spare`."""
    series, train = noise.series, noise.series.train
    n, residual_dim = len(train), series.kind.residual_dim
    masks = {source.name: states.mask(source)[train] for source in noise.sources}
    carried = frozenset(name for name, mask in masks.items() if mask.any())
    diagonal, artificial = noise.private_diagonal(train, carried) if carried else (np.zeros((0, 0)),) * 2
    W_is_wanted = bool(carried) or joint_errors is not None
    W = np.empty((n * W_is_wanted, residual_dim, residual_dim))
    rows: Integers | slice = slice(None) if n == series.n else train
    used, measured = series.used[rows], residuals.rows_of(noise.as_measured, rows)
    data, whitening = np.empty(measured.data.shape), np.empty(measured.whitening.shape)

    def whiten(start: int, stop: int) -> None:
        span = slice(start, stop)
        these = span if n == series.n else train[span]
        moments = noise.moments_at(these)
        plain = noise.rows_at(these, moments)
        private = noise.own_at(these, moments)
        if carried:
            private = private + (diagonal[span] - moments.variance)[:, :, None] * np.eye(residual_dim)
        for source in noise.sources:
            own = np.where(masks[source.name][span][:, None, :, None], 0.0, source.loading[these])
            own = own.reshape(stop - start, residual_dim, -1)
            private = private + own @ np.swapaxes(own, 1, 2)
        if weights is not None:  # private noise on top, so much that a measurement says no more than its weight
            more = 1.0 / np.maximum(weights[these], MIN_WEIGHT) - 1.0
            private = private + more[:, None, None] * noise.total_at(these)
        white = whitening_of(private, used[span])
        data[span], whitening[span] = plain.data, pack(white @ unpack(plain.whitening, residual_dim))
        if W_is_wanted:
            W[span] = white

    for _ in over_spans(whiten, n):
        pass
    offset = None if joint_errors is None else _offset(noise, train, W, joint_errors)
    block = replace(measured, data=data, whitening=whitening)
    part = WhitenedSeries(block, series.table, number, series.nuisances[train], offset)
    if not carried:
        return part, None
    E = scipy.sparse.csr_array((n * residual_dim, 0))
    if any(name != "joints" for name in carried):
        E = block_diagonal(W * np.sqrt(artificial)[:, None])
    return part, (states.loading(noise, train, W, masks), E)


def _offset(noise: RowNoise, train: Integers, W: Floats, joint_errors: Floats) -> Floats:
    """What the errors of the readings alone make of whitened rows, to first order, shape (n, residual_dim)."""
    out = np.zeros((len(train), noise.series.kind.residual_dim))
    joints, sigma = noise.place.joints, noise.place.measurements.sigma_joint * noise.joint_factor
    for source in noise.sources:
        if source.name == "joints":
            J = source.loading[train] / sigma[joints]
            out += np.einsum("nhew,new->nh", J, joint_errors[source.ends[train]][..., joints])
    moved: Floats = (W @ out[:, :, None])[:, :, 0]
    return moved


def block_diagonal(blocks: Floats) -> Sparse:
    """Small matrices, shape (n, h, k), one after the other along the diagonal: shape (n h, n k)."""
    n, h, k = blocks.shape
    columns = np.broadcast_to(np.arange(n)[:, None, None] * k + np.arange(k), blocks.shape)
    return scipy.sparse.csr_array((blocks.ravel(), columns.ravel(), np.arange(n * h + 1) * k), shape=(n * h, n * k))


class ErrorStates:
    """The errors of all configurations, those of a configuration side by side, and which are shared.

    Args:
        noises: The rows of all series and their noise.
        sharing: Whether errors are shared at all.
        estimated: Whether those of the joints are estimated, and so count as shared.
    """

    def __init__(self, noises: Sequence[RowNoise], sharing: bool = True, estimated: bool = False) -> None:
        self._sharing, self._estimated = sharing, estimated
        self._first: dict[str, int] = {}
        self._reached: dict[str, Integers] = {}
        self.width = 0
        self._n = 1 + max((int(s.ends.max(initial=-1)) for noise in noises for s in noise.sources), default=-1)
        for noise in noises:
            train = noise.series.train
            for source in noise.sources:
                if source.name not in self._first:
                    self._first[source.name] = self.width
                    self._reached[source.name] = np.zeros(self._n, dtype=np.int64)
                    self.width += source.loading.shape[3]
                for end in source.ends[train].T:
                    self._reached[source.name] += np.bincount(end, minlength=self._n)

    @property
    def n_errors(self) -> int:
        """Number of errors of all configurations."""
        return self._n * self.width

    def mask(self, source: NoiseSource) -> Booleans:
        """Of which ends the errors are shared, shape (n, ends)."""
        if self._estimated and source.name == "joints":
            return np.ones(source.ends.shape, dtype=np.bool_)
        return (self._reached[source.name][source.ends] > 1) & self._sharing

    def predicted(self, noises: Sequence[RowNoise]) -> Integers:
        """Numbers of the errors that reach both train and test measurements."""
        found = [np.zeros(0, dtype=np.int64)]
        for noise in noises:
            for source in noise.sources:
                ends = np.unique(source.ends[noise.series.test])
                ends = ends[self._reached[source.name][ends] > 0]
                first = ends * self.width + self._first[source.name]
                found.append((first[:, None] + np.arange(source.loading.shape[3])).ravel())
        return np.unique(np.concatenate(found))

    def loading(
        self,
        noise: RowNoise,
        rows: Integers,
        W: Floats | None = None,
        masks: Mapping[str, Booleans] | None = None,
        sources: Sequence[NoiseSource] | None = None,
    ) -> Sparse:
        """How rows of a series follow from all errors, sparse, shape (n residual_dim, n_errors).

        Args:
            noise: The series' rows and their noise.
            rows: The measurements.
            W: What their rows are multiplied by, shape (n, residual_dim, residual_dim); nothing if None.
            masks: By source, of which ends errors are wanted, shape (n, ends); of all if None.
            sources: Those of the noise's sources that are wanted, of some of the rows perhaps; all if None.
        """
        n, residual_dim = len(rows), noise.series.kind.residual_dim
        found, columns = list[Floats](), list[Integers]()  # of each source, as many in each row
        for source in noise.sources if sources is None else sources:
            if masks is not None and not masks[source.name].any():
                continue
            ends, w = source.loading.shape[2:]
            G = source.loading[rows]
            if masks is not None:
                G = np.where(masks[source.name][:, None, :, None], G, 0.0)
            flat = G.reshape(n, residual_dim, ends * w)
            found.append((flat if W is None else W @ flat).reshape(-1, ends * w))
            first = source.ends[rows] * self.width + self._first[source.name]  # (n, ends)
            mine = (first[:, :, None] + np.arange(w)).reshape(n, 1, ends * w)
            columns.append(np.broadcast_to(mine, flat.shape).reshape(-1, ends * w))
        shape = (n * residual_dim, self.n_errors)
        if not found:
            return scipy.sparse.csr_array(shape)
        figures = np.hstack(found)
        chosen = figures != 0.0
        starts = np.concatenate([[0], np.cumsum(np.sum(chosen, axis=1))])
        out = scipy.sparse.csr_array((figures[chosen], np.hstack(columns)[chosen], starts), shape=shape)
        out.sum_duplicates()
        return out

    def row_set(self, together: Sequence[tuple[WhitenedSeries, Sparse, Sparse]]) -> WhitenedBlock:
        """The rows of several series that share errors."""
        L = _stacked([L for _, L, _ in together])
        place = np.zeros(self._n, dtype=L.indices.dtype)
        place[L.indices // self.width] = 1
        used = np.flatnonzero(place)
        place[used] = np.arange(len(used))
        columns = place[L.indices // self.width] * self.width + L.indices % self.width
        L = scipy.sparse.csr_array((L.data, columns, L.indptr), shape=(L.shape[0], len(used) * self.width))
        spare = _stacked([E for _, _, E in together], apart=True)
        joints = self._first.get("joints", 0)
        parts = tuple(part for part, _, _ in together)
        return WhitenedBlock(parts, SchurComplement(L, self.width), used, joints, spare if spare.nnz else None)


def _stacked(matrices: Sequence[Sparse], *, apart: bool = False) -> Sparse:
    """Sparse matrices one below the other, with the same columns or, `apart`, each with its own."""
    if len(matrices) == 1:
        return matrices[0]
    widths = [M.shape[1] * apart for M in matrices]
    rows, figures, first = (
        [0, *np.cumsum(n)] for n in ([M.shape[0] for M in matrices], [M.nnz for M in matrices], widths)
    )
    columns = np.concatenate([M.indices + c for M, c in zip(matrices, first, strict=False)])
    starts = np.concatenate([[0], *(M.indptr[1:] + k for M, k in zip(matrices, figures, strict=False))])
    shape = (rows[-1], first[-1] if apart else matrices[0].shape[1])
    return scipy.sparse.csr_array((np.concatenate([M.data for M in matrices]), columns, starts), shape=shape)
