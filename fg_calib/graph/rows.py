"""Whitened rows: those of one series, or of several whose measurements share errors.

An error that reaches one measurement only is that measurement's own: it is added to its private noise. What is left is
shared: with `y` the rows whitened by their private noise, and `L` how they follow from errors `z ~ N(0, 1)` of
configurations, the covariance of y is 1 + L L^T (see `error_states`).

Where true joint values are estimated the rows are linearised about them: with e the errors of the readings taken so far
and J their derivatives, the rows less J e are those of the readings themselves, and what the rows say of e is the
posterior mean of their part of z.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.arrays import Brief
from fg_calib.graph.error_states import SharedErrors
from fg_calib.graph.noise import RowNoise, Source, whitening_of
from fg_calib.measurements import residuals
from fg_calib.measurements.residuals import Block, pack, unpack
from fg_calib.robot.kinematics import SPAN, Chain, over_spans

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Sparse = scipy.sparse.csr_array

REMEMBERED = 4
"""Triangles of a set of rows that are kept: many ask what rows say at the start, at nominal and at the estimate."""

LEAST_WEIGHT = 1e-12
"""A robust weight below this is taken for this."""


@dataclass(frozen=True)
class At(Brief):
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

    def without_columns(self) -> At:
        """The same without derivatives."""
        return replace(self, chains=tuple(chain.without_columns() for chain in self.chains), n_columns=0, n_nuisance=0)


@dataclass(frozen=True)
class Part(Brief):
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

    def only(self, k: int) -> Part:
        """One of its measurements."""
        chunk = slice(k, k + 1)
        offset = None if self.offset is None else self.offset[chunk]
        return Part(residuals.rows_of(self.block, chunk), self.table, self.series, self.nuisances[chunk], offset)

    @property
    def is_plain(self) -> bool:
        """Whether its rows depend on the core alone, as the kernel computes them."""
        return self.nuisances.shape[1] == 0 and self.offset is None

    def at(self, at: At) -> Block:
        """The block with its nuisances' values."""
        if not self.nuisances.shape[1]:
            return self.block
        return replace(self.block, nuisances=at.coordinates[self.nuisances])

    def linearise(self, at: At) -> Iterator[Floats]:
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
class RowSet(Brief):
    """Whitened train rows; every row counts as one measurement where they share errors.

    Attributes:
        parts: The rows of each series.
        shared: How all their rows follow from shared errors; None if nothing is shared.
        configurations: Configurations whose errors are shared, in the order of the errors.
        joints: Place of the joints' errors among those of a configuration.
        spare: E with E E^T what of the rows' own noise is there for numerical safety alone; None if nothing is.
    """

    parts: tuple[Part, ...]
    shared: SharedErrors | None = None
    configurations: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    joints: int = 0
    spare: Sparse | None = None
    _triangles: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def n_rows(self) -> int:
        """Number of rows that `linearise` returns."""
        return sum(part.n_rows for part in self.parts) if self.shared is None else self.shared.n

    @property
    def n_spare(self) -> float:
        """How many degrees of freedom the rows have by `spare` alone: its trace over the rows' covariance."""
        if self.spare is None:
            return 0.0
        return float(self.spare.power(2).sum()) if self.shared is None else self.shared.energy(self.spare)

    @property
    def coordinates(self) -> Integers:
        """Nuisance coordinates that the rows depend on."""
        return np.unique(np.concatenate([part.nuisances.ravel() for part in self.parts]))

    def private(self, at: At) -> Floats:
        """[J r] before correlation is dealt with, shape (all rows, n_columns + n_nuisance + 1)."""
        return np.concatenate([chunk for part in self.parts for chunk in part.linearise(at)])

    def linearise(self, at: At) -> tuple[Floats, Floats]:
        """Whitened residuals, shape (n_rows,), and their derivatives, shape (n_rows, n_columns + n_nuisance)."""
        rows = self.private(at)
        if self.shared is not None:
            rows = self.shared.whiten(rows)
        return rows[:, -1], rows[:, :-1]

    def squared_norm(self, at: At) -> float:
        """Sum of squared whitened residuals."""
        free = at.without_columns()
        if self._kernel_alone:
            return residuals.squared_norm(self.parts[0].block, free.chains[self.parts[0].table])
        r, _ = self.linearise(free)
        return float(r @ r)

    def triangle(self, at: At) -> Floats:
        """R of a thin QR of [J r], shape (n_columns + n_nuisance + 1,) * 2; the last ones are remembered."""
        if at.mark not in self._triangles:
            for mark in list(self._triangles)[: 1 - REMEMBERED]:
                self._triangles.pop(mark, None)
            self._triangles[at.mark] = self._triangle(at)
        return self._triangles[at.mark].copy()

    def _triangle(self, at: At) -> Floats:
        if self._kernel_alone:
            return _padded(residuals.triangle(self.parts[0].block, at.chains[self.parts[0].table]), at.n_nuisance)
        chunks = self.parts[0].linearise(at) if self._one_by_one else iter([self._whitened(at)])
        R = np.zeros((at.n_columns + at.n_nuisance + 1,) * 2)
        for chunk in chunks:
            for start in range(0, len(chunk), 4 * SPAN):
                R = np.linalg.qr(np.vstack([R, chunk[start : start + 4 * SPAN]]), mode="r")  # type: ignore[assignment]
        return R

    def gram(self, at: At) -> Floats:
        """[J r]^T [J r], shape (n_columns + n_nuisance + 1,) * 2."""
        if self._kernel_alone:
            return _padded(residuals.gram(self.parts[0].block, at.chains[self.parts[0].table]), at.n_nuisance)
        rows = self._whitened(at)
        out: Floats = rows.T @ rows
        return out

    def most_likely(self, at: At) -> Floats:
        """What the residuals say of the shared errors, shape (n_configurations, width)."""
        if self.shared is None:
            return np.zeros((0, 0))
        r = self.private(at.without_columns())[:, -1:]
        return self.shared.most_likely(r)[:, 0].reshape(len(self.configurations), -1)

    def weighed(self, at: At) -> Floats:
        """C^-1 J, C the covariance of all rows whitened by their private noise, shape (all rows, n_all_columns)."""
        J = self.private(at)[:, :-1]
        return J if self.shared is None else J - self.shared.loadings @ self.shared.most_likely(J)

    def _whitened(self, at: At) -> Floats:
        rows = self.private(at)
        return rows if self.shared is None else self.shared.whiten(rows)

    @property
    def _one_by_one(self) -> bool:
        return self.shared is None and len(self.parts) == 1

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
) -> tuple[RowSet, ...]:
    """The train rows of series, whitened.

    Args:
        noises: The rows and their noise.
        sharing: Whether measurements share the errors of their configurations, or each counts as having its own.
        joint_errors: Errors of the readings that the rows are linearised about, where they are estimated, shape
            (n_configurations, n_joints); then they count as shared although only one measurement has them.
        weights: Robust weight of each measurement of each series; None for 1.
    """
    shares = ErrorColumns(noises, sharing, joint_errors is not None)
    gathered = [
        _part(i, noise, shares, joint_errors, None if weights is None else weights[i])
        for i, noise in enumerate(noises)
        if len(noise.series.train)
    ]
    together = [(part, *shared) for part, shared in gathered if shared and shared[0].nnz]
    alone = [RowSet((part,)) for part, shared in gathered if not (shared and shared[0].nnz)]
    return (*alone, shares.row_set(together)) if together else tuple(alone)


def share_errors(noises: Sequence[RowNoise]) -> bool:
    """Whether errors of configurations that are not estimated reach more than one train measurement."""
    shares = ErrorColumns(noises, sharing=True, estimated=False)
    return any(shares.mask(source)[noise.series.train].any() for noise in noises for source in _not_estimated(noise))


def _not_estimated(noise: RowNoise) -> tuple[Source, ...]:
    """The sources of a series' noise but for estimated joint errors, which count as shared whatever is asked."""
    return tuple(s for s in noise.sources if not (noise.place.joints_estimated and s.name == "joints"))


def correlation_of(noises: Sequence[RowNoise], rows: Sequence[RowSet], at: At, follow: Floats) -> Floats:
    """J^T (C - 1) J of rows that share errors but are whitened as if they did not, shape (n_columns, n_columns).

    Args:
        noises: The rows of all series and their noise.
        rows: The whitened train rows.
        at: Where the derivatives J are wanted; C is the covariance of the whitened rows.
        follow: How the nuisance variables follow the core, shape (n_nuisance, n_columns): in J they do.
    """
    shares = ErrorColumns(noises, sharing=True, estimated=False)
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
    noises: Sequence[RowNoise], rows: Sequence[RowSet], at: At, errors: ErrorColumns, wanted: Integers
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


def whitener_of(noise: RowNoise, part: Part) -> Floats:
    """What the train rows of a series were multiplied by to be whitened, shape (n, residual_dim, residual_dim)."""
    h, plain = part.block.residual_dim, noise.rows_at(noise.series.train)
    out: Floats = unpack(part.block.whitening, h) @ np.linalg.inv(unpack(plain.whitening, h))
    return out


def _part(
    number: int, noise: RowNoise, shares: ErrorColumns, joint_errors: Floats | None, weights: Floats | None
) -> tuple[Part, tuple[Sparse, Sparse] | None]:
    """The train rows of a series; how they follow from errors that they share, if any, and E of `RowSet.spare`."""
    series, train = noise.series, noise.series.train
    n, residual_dim = len(train), series.kind.residual_dim
    masks = {source.name: shares.mask(source)[train] for source in noise.sources}
    carried = frozenset(name for name, mask in masks.items() if mask.any())
    rows: Integers | slice = slice(None) if n == series.n else train
    diagonal = np.zeros((0, residual_dim))
    if carried:
        variance = noise.moments_at(rows).variance
        diagonal = np.maximum(variance + _at(noise.more_if_redundant(carried), train), _at(noise.least(), train))
    used = series.used[rows]
    W_is_wanted = bool(carried) or joint_errors is not None
    W = np.empty((n * W_is_wanted, residual_dim, residual_dim))
    measured = residuals.rows_of(noise.as_measured, rows)
    data, whitening = np.empty(measured.data.shape), np.empty(measured.whitening.shape)

    def whiten(start: int, stop: int) -> None:
        some = slice(start, stop)
        these = some if n == series.n else train[some]
        moments = noise.moments_at(these)
        plain = noise.rows_at(these, moments)
        private = noise.own_at(these, moments)
        if carried:
            private = private + (diagonal[some] - moments.variance)[:, :, None] * np.eye(residual_dim)
        for source in noise.sources:
            own = np.where(masks[source.name][some][:, None, :, None], 0.0, source.loading[these])
            own = own.reshape(stop - start, residual_dim, -1)
            private = private + own @ np.swapaxes(own, 1, 2)
        if weights is not None:  # noise of its own on top, so much that a measurement says no more than its weight
            more = 1.0 / np.maximum(weights[these], LEAST_WEIGHT) - 1.0
            private = private + more[:, None, None] * noise.total_at(these)
        white = whitening_of(private, used[some])
        data[some], whitening[some] = plain.data, pack(white @ unpack(plain.whitening, residual_dim))
        if W_is_wanted:
            W[some] = white

    for _ in over_spans(whiten, n):
        pass
    block = replace(measured, data=data, whitening=whitening)
    offset = None if joint_errors is None else _offset(noise, train, W, joint_errors)
    part = Part(block, series.table, number, series.nuisances[train], offset)
    if not carried:
        return part, None
    if any(name != "joints" for name in carried):
        E = block_diagonal(W * np.sqrt(np.maximum(diagonal - noise.bare(train), 0.0))[:, None])
    else:
        E = scipy.sparse.csr_array((n * residual_dim, 0))
    return part, (shares.loading(noise, train, W, masks), E)


def _at(values: Floats | float, rows: Integers) -> Floats | float:
    return values if isinstance(values, float) else values[rows]


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


class ErrorColumns:
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

    def mask(self, source: Source) -> Booleans:
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
        sources: Sequence[Source] | None = None,
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

    def row_set(self, together: Sequence[tuple[Part, Sparse, Sparse]]) -> RowSet:
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
        return RowSet(parts, SharedErrors(L, self.width), used, joints, spare if spare.nnz else None)


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
