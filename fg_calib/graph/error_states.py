r"""Errors that measurements share, as states of a linear Gaussian system: eliminated exactly.

Rows y, whitened by their private noise, share errors `z ~ N(0, 1)` (joint readings of a configuration, measured poses
that pairs were formed from) through a sparse L: `y = A x + L z + e`, `e ~ N(0, 1)`. With S = 1 + L^T L, the posterior
mean of z for rows y is `Z = S^-1 L^T y`, and

    (y - L Z)^T (y - L Z) + Z^T Z = y^T (1 + L L^T)^-1 y,

so [y - L Z; Z] are rows of unit covariance that say the same. A factor of S, or of 1 + L L^T where rows are fewer, is
dense where these are few or full, else sparse by minimum degree, which does not fill where pairs make a tree. Errors
that reach one measurement only are private noise.

Coefficients of error curves, over their prior sigma, are states too where rows share no errors; but rows, of residuals
r, are linearised at values z0 of theirs, and z0 + dz ~ N(0, 1). So `r + A x + L dz = e` has dz = -Z at x = 0 with
Z = S^-1 (L^T r + z0), and [r - L Z; z0 - Z] are the rows that are left; columns of A are treated alike, without z0. A
row depends on curves by the rotations of the joints at its ends alone, and each rotation on four splines: L = D B with
D block diagonal, so that L^T L = B^T (D^T D) B is a sum over measurements.

The second-order term of a pair formed from poses, `(e_j - e_i)^T H (e_j - e_i) / 2`, counts as private, of variance q.
For equal noise its correlation is at most 1/4 with that of a pair that shares a pose, and 0 with others: together all
have at most the variance of independent terms of `q (1 + (m_i + m_j - 2) / 4)` (Gershgorin), m_i the pairs of pose i.
This matters where pairs are more than the errors, so that second-order terms are all that they have left to say: there
`q m / 2`, m the smaller number, is about as much; pairs of a star or chain, which are fewer, have m <= 2.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from fg_calib.graph.noise_models import RowNoise, reach, whitening_of
from fg_calib.inputs import Booleans, Brief, Floats, Integers, Record, SolverError
from fg_calib.measurements import Block, pack, residuals, unpack
from fg_calib.robot import SPAN, Chain, Splines, add_gram, over_spans

Sparse = scipy.sparse.csr_array

MAX_DENSE = 2000
"""Rows, or states, up to which a dense factor is the quickest."""

MAX_FILL = 10
"""Entries of a dense S for each entry of L up to which it is the quickest at any size, as of all pairs."""

MAX_LOOP_STATES = 4000
"""States that loops of the graph of configurations couple, up to which a sparse factor of S fills little."""

MAX_SPARSE = 15_000
"""Rows, or states, up to which graphs of many loops are eliminated at all: 0.4 s for 6 000, 8 s for 15 000."""

BATCH = 512
"""Right-hand sides that are solved for at once."""

N_PROBES = 64
"""Random vectors that estimate the trace of a large matrix; the estimate's sigma is below sqrt(2 n / 64) of n rows."""

PRIVATE_SHARE = 1e-3
"""Share of a row's variance that counts as private at least: the errors that measurements share are not all."""

MIN_WEIGHT = 1e-12
"""A robust weight below this is taken for this."""


class SchurComplement(Record):
    """The elimination of the error states that rows share.

    Attributes:
        loadings: L, change of each row per 1 sigma of each state, shape (n_rows, n_states).
        width: States of one configuration, which follow each other.
    """

    loadings: Sparse
    width: int = 1

    def __getstate__(self) -> dict[str, Any]:
        """All but factors, which functions hold."""
        return {"loadings": self.loadings, "width": self.width}

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.loadings.shape[1])

    def whiten(self, rows: Floats) -> Floats:
        """Rows of unit covariance that say the same as `rows`, shape (n_rows, k), do: shape (n, k)."""
        Z = self.posterior_mean(rows)
        return np.concatenate([rows - self.loadings @ Z, Z])

    def posterior_mean(self, rows: Floats) -> Floats:
        """Z = S^-1 L^T rows = L^T C^-1 rows, the posterior mean of the states, shape (n_states, k)."""
        L, (of_rows, solve) = self.loadings, self._factor
        return L.T @ solve(rows) if of_rows else solve(L.T @ rows)

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
        out = np.empty(self.n_states)
        for start in range(0, self.n_states, BATCH):
            unit = np.eye(self.n_states, min(BATCH, self.n_states - start), -start)
            out[start : start + BATCH] = np.sum(self.solve(unit) * unit, axis=0)
        return out

    def trace(self, E: Sparse) -> float:
        """`tr E^T C^-1 E` of a sparse E, shape (n_rows, k); of large systems an estimate, see `N_PROBES`."""
        if min(self.loadings.shape) > MAX_DENSE:
            signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(E.shape[1], N_PROBES))
            return float(np.sum(self.whiten(E @ signs) ** 2)) / N_PROBES
        common, total = scipy.sparse.csc_array(self.loadings.T @ E), float(E.power(2).sum())
        for start in range(0, common.shape[1], BATCH):
            D = common[:, start : start + BATCH].toarray()
            total -= float(np.vdot(D, self.solve(D)))
        return total

    @cached_property
    def _factor(self) -> tuple[bool, Callable[[Floats], Floats]]:
        """Whether C is factored, not S; and what multiplies by the inverse."""
        L, (n_rows, n_states) = self.loadings, self.loadings.shape
        if not n_states:
            return False, lambda b: b
        of_rows = n_rows <= min(n_states, MAX_DENSE)
        if min(n_rows, n_states) <= MAX_DENSE or n_states**2 <= MAX_FILL * L.nnz:
            M = (L @ L.T if of_rows else L.T @ L).toarray()
            dense = scipy.linalg.cho_factor(np.eye(len(M)) + M, check_finite=False)
            return of_rows, lambda b: scipy.linalg.cho_solve(dense, b, check_finite=False)
        graph = _configuration_graph(L, self.width)
        n_parts = csgraph.connected_components(graph, directed=False)[0]
        loops = ((graph.nnz - graph.shape[0]) // 2 - graph.shape[0] + n_parts) * self.width > MAX_LOOP_STATES
        if loops and min(n_rows, n_states) > MAX_SPARSE:
            found = f"{n_states} errors that pairs share in loops are too many to eliminate"
            way_out = "use model pose with frame unknown, which holds the same, or a star or chain"
            raise SolverError(f"pairs: {found}; {way_out}")
        of_rows = loops and n_rows < n_states
        M = (L @ L.T if of_rows else L.T @ L) + scipy.sparse.eye_array(n_rows if of_rows else n_states)
        options = {"SymmetricMode": True, "Equil": False}
        factor = splu(M.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return of_rows, lambda b: factor.solve(np.ascontiguousarray(b))


def _configuration_graph(L: Sparse, width: int) -> Sparse:
    """Which configurations measurements couple, shape (n, n), the diagonal included."""
    shape = (L.shape[0], L.shape[1] // width)
    pattern = Sparse((np.ones(L.nnz, dtype=np.int32), L.indices // width, L.indptr.copy()), shape=shape)
    pattern.sum_duplicates()  # in place
    return Sparse(pattern.T @ pattern)


class Curves(NamedTuple):
    """The error curves that are estimated.

    Attributes:
        first: First of each curve's coefficients, by the joint's index.
        values: Their values, shape (n_curves,), [rad].
        sigma: 1 sigma of each one's prior, shape (n_curves,), [rad].
    """

    first: Mapping[int, int]
    values: Floats
    sigma: Floats

    def at(self, each: Splines) -> "CurveSplines":
        """Their splines at configurations, from `Chain.splines`."""
        knots = np.stack([first + each[joint][0] for joint, first in self.first.items()], axis=1)
        weights: Floats = np.stack([each[joint][1] for joint in self.first], axis=1)
        return CurveSplines(np.array(list(self.first)), knots, weights, len(self.sigma))


class State(Brief):
    """The arm and the nuisance coordinates at some parameters.

    Attributes:
        chains: The chain from each table's measurement frame, by the table's number.
        coordinates: Values of all nuisance coordinates.
        columns: Jacobian column of each of them, -1 for those that are not estimated.
        n_columns: Number of columns of the core.
        n_nuisance: Number of columns of the nuisance variables.
        curves: The error curves that are estimated.
    """

    chains: tuple[Chain, ...]
    coordinates: Floats
    columns: Integers
    n_columns: int
    n_nuisance: int
    curves: Curves | None = None

    def without_columns(self) -> "State":
        """Copy without derivatives."""
        chains = tuple(chain.without_columns() for chain in self.chains)
        return replace(self, chains=chains, n_columns=0, n_nuisance=0, curves=None)

    def without_curves(self) -> "State":
        """Copy without derivatives in error curves, whose columns are the first nuisance columns."""
        n = 0 if self.curves is None else len(self.curves.sigma)
        return replace(self, columns=self.columns - n, n_nuisance=self.n_nuisance - n, curves=None)


class Eliminated(Brief):
    """A linear system A x = b with its nuisance columns eliminated; below they are called landmarks.

    Attributes:
        own: Part of the right-hand side that the landmark columns can explain, shape (rank,).
        A: The core's columns, minus what the landmark columns can explain of them, shape (m, n_core).
        b: The right-hand side, minus the same, shape (m,).
        follow: How the landmarks follow the core, shape (n_landmarks, n_core).
        spread: Multiplies by `inverse`.
        unknown: Which landmark columns have a share in a direction that nothing determines, shape (n_landmarks,).
    """

    own: Floats
    A: Floats
    b: Floats
    follow: Floats
    spread: Callable[[Floats], Floats]
    unknown: Booleans

    @property
    def rank(self) -> int:
        """Number of directions of the landmarks that the system determines."""
        return len(self.own)

    @cached_property
    def inverse(self) -> Floats:
        """S with S S^T the landmarks' covariance at a given core, shape (n_landmarks, rank)."""
        return self.spread(np.eye(self.rank))


class WhitenedBlock(Brief):
    """Train rows of one block, whitened by their private noise.

    Attributes:
        block: The rows.
        table: Which table they are from.
        number: Number of its measurement block.
        nuisances: Nuisance coordinates of each measurement, shape (n, kind.n_nuisances).
    """

    block: Block
    table: int
    number: int
    nuisances: Integers

    @property
    def n_rows(self) -> int:
        """Number of scalar rows."""
        return self.block.n * self.block.residual_dim

    def only(self, k: int) -> "WhitenedBlock":
        """One of its measurements."""
        one = slice(k, k + 1)
        return replace(self, block=residuals.rows_of(self.block, one), nuisances=self.nuisances[one])

    def weighted(self, weight: float) -> "WhitenedBlock":
        """Copy whose measurements count for so many times as much."""
        return replace(self, block=replace(self.block, whitening=self.block.whitening * np.sqrt(weight)))

    def at(self, at: State) -> Block:
        """The block with its nuisances' values."""
        return replace(self.block, nuisances=at.coordinates[self.nuisances]) if self.nuisances.size else self.block

    def linearise(self, at: State) -> Iterator[Floats]:
        """[J r] by all columns, nuisances' among them, chunk by chunk, shape (rows, n_columns + n_nuisance + 1)."""
        for rows, turns in self.apart(at):
            n = at.n_columns
            yield rows if turns is None else np.hstack([rows[:, :n], turns.loadings.toarray(), rows[:, n:]])

    def apart(self, at: State) -> "Iterator[tuple[Floats, CurveTurns | None]]":
        """[J r] by all columns but those of error curves, and derivatives in these as products, chunk by chunk."""
        chain, block, plain, n = at.chains[self.table], self.at(at), at.without_curves(), at.n_columns
        splines = chain.splines(block.trig)
        of_curves = at.curves and at.curves.at(splines)
        chain, trig = chain.with_curves_in(block.trig, splines)
        chain, block = chain if at.curves is None else chain.with_turn_columns(), replace(block, trig=trig)
        for first, last, panel in residuals.panels(block, chain, 0, block.n):
            J = panel[:, :, : last - first].transpose(2, 1, 0)  # and, last, r
            out = np.zeros((*J.shape[:2], n + plain.n_nuisance + 1))
            out[:, :, :n], out[:, :, -1] = J[:, :, :n], J[:, :, -1]
            for k, places in enumerate(self.nuisances[first:last].T if plain.n_nuisance else ()):
                rows = np.flatnonzero(plain.columns[places] >= 0)
                out[rows, :, plain.columns[places[rows]]] = J[rows, :, k - 1 - block.kind.n_nuisances]
            turns = of_curves and of_curves.turns(J[:, :, n:], block.ends[first:last], chain.n_joints)
            yield out.reshape(-1, out.shape[2]), turns

    def reduce(self, at: State) -> Iterator[Floats]:
        """Rows with the Gram matrix of [J r], few at a time."""
        if self.nuisances.size or at.curves is not None:
            yield from self.linearise(at)
            return
        R = residuals.triangle(self.block, at.chains[self.table])
        out = np.zeros((len(R), at.n_columns + at.n_nuisance + 1))
        out[:, : at.n_columns], out[:, -1] = R[:, :-1], R[:, -1]
        yield out


class CurveTurns(Brief):
    """Derivatives D of measurements in rotations of joints, and B of these in coefficients of error curves.

    Attributes:
        turns: D, whitened, by end and joint with a curve, which are k, shape (n, residual_dim, k).
        knots: Numbers of the coefficients that each rotation depends on, four each, shape (n, 4 k).
        weights: B, the derivatives of the rotations in these, shape (n, 4 k).
        n_curves: Number of coefficients.
    """

    turns: Floats
    knots: Integers
    weights: Floats
    n_curves: int

    @cached_property
    def splines(self) -> Sparse:
        """B as a matrix, shape (n k, n_curves)."""
        starts = np.arange(0, self.knots.size + 1, 4)
        return Sparse((self.weights.ravel(), self.knots.ravel(), starts), shape=(len(starts) - 1, self.n_curves))

    @property
    def loadings(self) -> Sparse:
        """L = D B, derivatives of the rows in the coefficients, shape (n residual_dim, n_curves)."""
        return Sparse(block_diagonal(self.turns) @ self.splines)

    def times(self, x: Floats) -> Floats:
        """L x, shape (n residual_dim, m)."""
        n, h, k = self.turns.shape
        return (self.turns @ (self.splines @ x).reshape(n, k, x.shape[1])).reshape(n * h, x.shape[1])

    def transposed_times(self, y: Floats) -> Floats:
        """L^T y, shape (n_curves, m)."""
        n, h, k = self.turns.shape
        of_turns = np.swapaxes(self.turns, 1, 2) @ y.reshape(n, h, y.shape[1])
        return np.asarray(self.splines.T @ of_turns.reshape(n * k, y.shape[1]))

    def renumbered(self, to: Integers, scale: Floats) -> "CurveTurns":
        """The same in other coefficients: number `to[i]`, and in units of `scale[i]`, for number i; -1 is not used."""
        return replace(self, knots=to[self.knots], weights=self.weights * scale[self.knots], n_curves=int(to[-1]) + 1)


class CurveSplines(NamedTuple):
    """How rotations of joints follow from error curves at some configurations.

    Attributes:
        joints: The joints that have a curve, shape (k,).
        knots: Numbers of the coefficients that each rotation depends on, shape (n_configurations, k, 4).
        weights: Its derivatives in these, shape (n_configurations, k, 4).
        n_curves: Number of coefficients.
    """

    joints: Integers
    knots: Integers
    weights: Floats
    n_curves: int

    def turns(self, J: Floats, ends: Integers, n_joints: int) -> CurveTurns:
        """How measurements follow from error curves.

        Args:
            J: Derivatives in rotations of all joints, end by end, then others, shape (n, residual_dim, m).
            ends: Configuration of each end, shape (n, n_ends).
            n_joints: Number of joints.
        """
        places = (np.arange(ends.shape[1])[:, None] * n_joints + self.joints).ravel()
        knots, weights, shape = self.knots[ends], self.weights[ends], (len(ends), 4 * len(places))
        return CurveTurns(np.take(J, places, axis=2), knots.reshape(shape), weights.reshape(shape), self.n_curves)


class WhitenedRows(Brief):
    """All train rows, whitened by their private noise.

    Attributes:
        parts: The rows of each block that has any, one after the other.
        states: How they follow from error states.
        configurations: Configurations that have error states, in the order of these.
        slots: Slots of the errors of a configuration (see `noise_models`), in the order of the states.
        shared: Which of all errors are states, shape (n_errors,).
        spare: E with E E^T the part of their private noise that is there for numerical safety alone.
        counted_as_private: Whether measurements share errors that count as private of each.
    """

    parts: tuple[WhitenedBlock, ...]
    states: SchurComplement
    configurations: Integers
    slots: Integers
    shared: Booleans
    spare: Sparse
    counted_as_private: bool = False

    @cached_property
    def n_spare(self) -> float:
        """How many degrees of freedom the rows have by `spare` alone: its trace over the rows' covariance."""
        return self.states.trace(self.spare) if self.spare.nnz else 0.0

    def with_readings(self, trigs: Sequence[Floats]) -> "WhitenedRows":
        """Copy with other readings for the kernels, those of each table."""
        parts = (replace(part, block=replace(part.block, trig=trigs[part.table])) for part in self.parts)
        return replace(self, parts=tuple(parts))

    def private(self, at: State) -> Floats:
        """[J r] before shared errors are dealt with, shape (n_rows, n_columns + n_nuisance + 1)."""
        empty = np.zeros((0, at.n_columns + at.n_nuisance + 1))
        return np.concatenate([empty, *(chunk for part in self.parts for chunk in part.linearise(at))])

    def linearise(self, at: State) -> tuple[Floats, Floats]:
        """Whitened residuals, shape (n,), and their derivatives, shape (n, n_columns + n_nuisance)."""
        rows = self.states.whiten(self.private(at))
        return rows[:, -1], rows[:, :-1]

    def square_root(self, at: State) -> Floats:
        """Rows with the Gram matrix of the whitened [J r], at most as many as columns."""
        n = at.n_columns + at.n_nuisance + 1
        if self.states.n_states:
            return _reduced(n, [self.states.whiten(self.private(at))])
        return _reduced(n, (chunk for part in self.parts for chunk in part.reduce(at)))

    def curve_loadings(self, at: State) -> Sparse:
        """Change of each row per 1 sigma of each coefficient of error curves, shape (n_rows, n_curves)."""
        if at.curves is None:
            return Sparse((sum(part.n_rows for part in self.parts), 0))
        each = [turns.loadings for part in self.parts for _, turns in part.apart(at) if turns]
        return Sparse(_stacked(each) * at.curves.sigma)

    def without_curves(self, at: State, variance: float = 1.0) -> Eliminated:
        """The rows with error curves eliminated, where no errors are shared.

        See the module's head. Coefficients on which no row depends keep their prior.

        Args:
            at: The state.
            variance: Of the rows, in units of that by which they were whitened.
        """
        assert at.curves is not None
        sigma, before = at.curves.sigma, at.curves.values / at.curves.sigma
        found = [(y, of) for part in self.parts for y, of in part.weighted(1.0 / variance).apart(at) if of]
        counts = sum((np.bincount(of.knots.ravel(), None, len(sigma)) for _, of in found), np.zeros(len(sigma)))
        seen, place = np.flatnonzero(counts), np.cumsum(counts > 0) - 1
        found = [(y, of.renumbered(place, sigma)) for y, of in found]
        S, b = np.eye(len(seen)), np.zeros((len(seen), at.n_columns + at.n_nuisance + 1 - len(sigma)))
        for y, of in found:
            add_gram(np.swapaxes(of.turns, 1, 2) @ of.turns, of.knots, of.weights, S)
            b += of.transposed_times(y)
        b[:, -1] += before[seen]
        C = scipy.linalg.cholesky(S.T, lower=True, overwrite_a=True, check_finite=False)  # in Fortran's order
        Z = scipy.linalg.cho_solve((C, True), b, check_finite=False)  # last, minus the step
        own, follow = -before, np.zeros((len(sigma), b.shape[1] - 1))
        own[seen], follow[seen] = -(Z[:, -1] @ C), -sigma[seen, None] * Z[:, :-1]
        left = [np.subtract(y, of.times(Z), out=y) for y, of in found]
        Z[:, -1] -= before[seen]
        rows = _reduced(b.shape[1], [*left, Z])

        def spread(y: Floats) -> Floats:
            out = y.reshape(len(sigma), -1).copy()
            out[seen] = scipy.linalg.solve_triangular(C, out[seen], trans="T", lower=True)
            return (sigma[:, None] * out).reshape(y.shape)

        return Eliminated(own, rows[:, :-1], -rows[:, -1], follow, spread, np.zeros(len(own), dtype=np.bool_))

    def with_curves_held(self, at: State) -> Eliminated:
        """The rows with error curves held, where no errors are shared; the last has the cost of the curves' priors."""
        assert at.curves is not None
        R, n = self.square_root(at.without_curves()), len(at.curves.sigma)
        b = np.append(-R[:, -1], np.linalg.norm(at.curves.values / at.curves.sigma))
        A, follow = np.pad(R[:, :-1], ((0, 1), (0, 0))), np.zeros((n, R.shape[1] - 1))
        return Eliminated(np.zeros(0), A, b, follow, lambda y: np.zeros((n, *y.shape[1:])), np.zeros(n, dtype=np.bool_))

    def posterior_mean(self, at: State) -> Floats:
        """Posterior mean of the error states, shape (n_configurations, n_slots), [sigma]."""
        r = self.private(at.without_columns())[:, -1:]
        return self.states.posterior_mean(r).reshape(len(self.configurations), len(self.slots))


def whitened_rows(
    noises: Sequence[RowNoise], *, sharing: bool, joints: bool, weights: Sequence[Floats] | None
) -> WhitenedRows:
    """The train rows of blocks, whitened.

    Args:
        noises: The rows and their noise.
        sharing: Whether measurements share the errors of their configurations, or each counts as having its own.
        joints: Whether errors of joint readings are states although only one measurement has them.
        weights: Robust weight of each measurement of each block; None for 1.
    """
    reached = reach(noises)
    width = noises[0].place.width if noises else 1
    of_joints = np.arange(len(reached)) % width < (noises[0].place.chain.n_joints if noises else 0)
    shared = (reached > 1) & sharing | of_joints & joints
    found = [
        _whiten(i, noise, shared, None if weights is None else weights[i])
        for i, noise in enumerate(noises)
        if len(noise.block.train)
    ]
    parts = tuple(part for part, _, _ in found)
    L = spare = Sparse((sum(part.n_rows for part in parts), 0))
    configurations = slots = np.zeros(0, dtype=np.int64)
    if shared.any():
        L = _stacked([L for _, L, _ in found])
        spare = Sparse(scipy.sparse.block_diag([E for _, _, E in found]))
        configuration, slot = np.divmod(L.indices, width)
        configurations, at = _ranks(configuration)
        slots, k = _ranks(slot)
        L = Sparse((L.data, at * len(slots) + k, L.indptr), shape=(L.shape[0], len(configurations) * len(slots)))
    return WhitenedRows(
        parts=parts,
        states=SchurComplement(L, max(len(slots), 1)),
        configurations=configurations,
        slots=slots,
        shared=shared,
        spare=spare,
        counted_as_private=bool(np.any((reached > 1) & ~shared)),
    )


def _reduced(n: int, chunks: Iterable[Floats]) -> Floats:
    """Rows with the Gram matrix of those of some chunks, as many as their n columns."""
    R = np.zeros((n, n), order="F")
    for chunk in chunks:
        for start in range(0, len(chunk), SPAN):
            R = residuals.with_rows(R, np.array(chunk[start : start + SPAN], order="F"))
    return R


def _ranks(numbers: Integers) -> tuple[Integers, Integers]:
    """The different numbers, ascending, and the place of each number among them."""
    present = np.bincount(numbers) > 0
    return np.flatnonzero(present), (np.cumsum(present) - 1)[numbers]


def _stacked(matrices: Sequence[Sparse]) -> Sparse:
    return Sparse(scipy.sparse.vstack(matrices)) if matrices else Sparse((0, 0))


def correlation_of(noises: Sequence[RowNoise], rows: WhitenedRows, J: Floats) -> Floats:
    """J^T (C - 1) J of rows that share errors but are whitened as if they did not, shape (n_columns, n_columns).

    Args:
        noises: The rows of all blocks and their noise.
        rows: The whitened train rows.
        J: Their derivatives, shape (n_rows, n_columns); C is the covariance of the whitened rows.
    """
    each = [(noises[part.number], whitener_of(noises[part.number], part)) for part in rows.parts]
    own = scipy.sparse.block_diag([block_diagonal(W @ noise.loading[noise.block.train]) for noise, W in each]).T @ J
    common = all_errors(noises, rows).T @ J
    return np.asarray(common.T @ common - own.T @ own)


def all_errors(noises: Sequence[RowNoise], rows: WhitenedRows) -> Sparse:
    """How whitened rows follow from all errors, states or not, shape (n_rows, n_errors)."""
    pairs = [(noises[part.number], part) for part in rows.parts]
    return _stacked([noise.errors_at(noise.block.train, whitener_of(noise, part)) for noise, part in pairs])


def whitener_of(noise: RowNoise, part: WhitenedBlock) -> Floats:
    """Matrices that whitened the train rows of a block, shape (n, residual_dim, residual_dim)."""
    h, plain = part.block.residual_dim, noise.rows_at(noise.block.train)
    return unpack(part.block.whitening, h) @ np.linalg.inv(unpack(plain.whitening, h))


def _whiten(
    number: int, noise: RowNoise, shared: Booleans, weights: Floats | None
) -> tuple[WhitenedBlock, Sparse, Sparse]:
    """The train rows of a block; how they follow from all errors that are states; and E of `WhitenedRows.spare`."""
    block, train = noise.block, noise.block.train
    n, h = len(train), block.kind.residual_dim
    rows: Integers | slice = slice(None) if n == block.n else train
    used, is_state = block.used[rows], shared[noise.columns[rows]]
    measured = residuals.rows_of(noise.as_measured, rows)
    data, whitening = np.empty(measured.data.shape), np.empty(measured.whitening.shape)
    carried = bool(is_state.any())
    W, artificial = np.empty((n * carried, h, h)), np.zeros((n * carried, h))
    if carried and noise.slope is not None:
        least = PRIVATE_SHARE * noise.sigma[rows] ** 2
        if block.formed:  # see the module's head
            n_pairs = np.bincount(block.ends[rows].ravel())[block.ends[rows]].min(axis=1, keepdims=True)
            least = np.maximum(least, 0.5 * n_pairs * noise.variance[rows])
        artificial = np.maximum(least - noise.variance[rows], 0.0)

    def whiten(start: int, stop: int) -> None:
        span = slice(start, stop)
        these = span if n == block.n else train[span]
        private, plain = noise.private_at(these), noise.rows_at(these)
        own = np.where(is_state[span][:, None], 0.0, noise.loading[these])
        private = private + own @ np.swapaxes(own, 1, 2)
        private = private + artificial[span][:, :, None] * np.eye(h) if carried else private
        if weights is not None:  # private noise on top, so much that a measurement says no more than its weight
            more = 1.0 / np.maximum(weights[these], MIN_WEIGHT) - 1.0
            private = private + more[:, None, None] * noise.total_at(these)
        white = whitening_of(private, used[span])
        data[span], whitening[span] = plain.data, pack(white @ unpack(plain.whitening, h))
        if carried:
            W[span] = white

    over_spans(whiten, n)
    part = WhitenedBlock(replace(measured, data=data, whitening=whitening), block.table, number, block.nuisances[train])
    if not carried:
        return part, Sparse((n * h, noise.place.n_errors)), Sparse((n * h, 0))
    E = W * np.sqrt(artificial)[:, None]
    return part, noise.errors_at(train, W, is_state[:, None]), block_diagonal(E) if E.any() else Sparse((n * h, 0))


def block_diagonal(blocks: Floats) -> Sparse:
    """Small matrices, shape (n, h, k), one after the other along the diagonal: shape (n h, n k)."""
    n, h, k = blocks.shape
    columns = np.broadcast_to(np.arange(n)[:, None, None] * k + np.arange(k), blocks.shape)
    return Sparse((blocks.ravel(), columns.ravel(), np.arange(n * h + 1) * k), shape=(n * h, n * k))
