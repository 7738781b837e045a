r"""Residuals, predicted minus measured, with analytic derivatives: the mathematics of the measurements.

| kind | residual | rows |
|---|---|---|
| distance | `\|p_B - p_A\| - measured` | 1 |
| rotation angle | `angle(R_A^T R_B) - measured`, in [0, pi] | 1 |
| same point | `p_B - p_A` in the base frame, up to a rotation | 3 |
| position | `world_p_tool - measured` in the world frame | 3 |
| orientation | `Log(R_measured^T R_predicted)`: rotation vector in the tool frame | 3 |
| pose | orientation, then position | 6 |

Derivatives, with (w, v) the twist of a parameter at a configuration (see `kinematics`) and p the tool point:

    distance:        dl = u . (dp_B - dp_A)            Jia et al. (2019), Eq. (5); dp = w x p + v
    rotation angle:  dphi = k . (w_B - w_A)            the same, Eq. (21); k the unit axis of R_B R_A^T
    same point:      dp_B - dp_A - a x (p_B - p_A): all vectors may be turned by a rotation a of each column without
                     changing their lengths, so by one that undoes motions of the base (`kinematics.turning_of_base`)
    orientation:     dr = Jr^-1(r) R_predicted^T w     Jr the right Jacobian of SO(3), Sola et al. (2018), Eq. (144)

In the kernel of pairs `u . (w x p) = w . (p x u)`, so that p x u is computed once a pair, and the axis in the base
frame is half the sum over columns of `R_A[:, c] x R_B[:, c]`, which is `k sin(phi)`.

A *block* is a set of measurements of one kind. Its kernel fills a panel, shape (n_columns + 1, rows): the transposed
whitened Jacobian and, in its last row, the whitened residual. Panels are handed on chunk by chunk and never
stored for a whole block: `gram` and `triangle` reduce them as they come, `linearise` keeps them for those who want
to look at every row.

Measurements may share errors: with `y` the rows whitened by the noise of their own, and `L` how they follow from
errors `z ~ N(0, 1)` that they share, the covariance of y is 1 + L L^T. A `CorrelatedBlock` whitens them by
`1 - L G L^T`, where G = (1 + R)^-1 R^-T and R^T R = 1 + L^T L (Andrews 1968): of the size of z, not of y; L is sparse.
Where there are fewer rows than shared errors it whitens them by the Cholesky factor of 1 + L L^T.

References:
    Andrews (1968), A square root formulation of the Kalman covariance equations. AIAA Journal 6(6).
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
    Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics. arXiv:1812.01537.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.robot.kernels import LANES, fill_pairs, fill_poses, fill_same_points, walk_all
from fg_calib.robot.kinematics import SPAN, Chain, over_spans, turning_of_base
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CHUNK = 512
"""Measurements in one panel; a multiple of `LANES`."""

_KEPT = 10_000_000
"""Figures of a correlated block that are held at once; of a larger one the rows are worked out twice, in chunks."""


class Block(Protocol):
    """Measurements of one kind with one kernel."""

    @property
    def n(self) -> int:
        """Number of measurements."""

    @property
    def height(self) -> int:
        """Rows of residual of one measurement."""

    @property
    def n_configurations(self) -> int:
        """Configurations of one measurement: 1 for poses, 2 for pairs; each has joint columns of its own."""

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel, [column, row of a measurement, measurement], with measurements start to stop."""


@dataclass(frozen=True)
class PairBlock:
    """Distances and rotation angles of pairs.

    Attributes:
        trig: Readings, from `kinematics.precompute_trig`, shape (n_configurations, n_joints, 2).
        a: Row of each pair's first configuration in `trig`, shape (n,).
        b: Row of its second, shape (n,).
        measured: Distance and angle, shape (n, 2), [m], [rad]; any number where not measured.
        whitening: Lower triangle (w_dd, w_ad, w_aa) of a 2x2 matrix that whitens (distance, angle), shape (n, 3);
            zero for a row that is not measured.
        kinds: Whether distance and angle are wanted at all.
        bent: 1 sigma of what distance and angle have of their poses' errors beyond the first order, shape (n, 2), for
            those who look at shared errors; it is in the whitening.
    """

    trig: Floats
    a: Integers
    b: Integers
    measured: Floats
    whitening: Floats
    kinds: tuple[bool, bool] = (True, True)
    bent: Floats = field(default_factory=lambda: np.zeros((0, 2)))

    n_configurations = 2

    @property
    def n(self) -> int:
        """Number of pairs."""
        return len(self.a)

    @property
    def height(self) -> int:
        """Rows of one pair: distance, angle or both."""
        return sum(self.kinds)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with pairs start to stop."""
        fill_pairs(
            *arguments, turns, self.trig, self.a, self.b, self.measured, self.whitening, *self.kinds, start, stop, panel
        )


@dataclass(frozen=True)
class SamePointBlock:
    """Pairs whose tool points coincide: a distance of zero, which has no direction but three coordinates.

    Attributes:
        trig: Readings, shape (n_configurations, n_joints, 2).
        a: Row of each pair's first configuration, shape (n,).
        b: Row of its second, shape (n,).
        whitening: Whitens the 3-vector, lower triangular, shape (n, 3, 3), [1/m].
    """

    trig: Floats
    a: Integers
    b: Integers
    whitening: Floats

    n_configurations = 2
    height = 3

    @property
    def n(self) -> int:
        """Number of pairs."""
        return len(self.a)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with pairs start to stop."""
        ends = np.concatenate([self.a[start:stop], self.b[start:stop]])
        rotation, position = np.empty((len(ends), 3, 3)), np.empty((len(ends), 3))
        *chain, n_columns, _ = arguments
        jacobian = np.empty((len(ends), 6, n_columns))
        walk_all(*chain, n_columns, 0, self.trig, ends, 0, len(ends), rotation, position, jacobian)
        turning = turning_of_base(jacobian[:, :3], rotation)
        fill_same_points(*arguments, turns, self.trig, self.a, self.b, self.whitening, turning, start, stop, panel)


@dataclass(frozen=True)
class PoseBlock:
    """Measured positions, orientations or poses, in the frame that the chain starts in.

    Attributes:
        trig: Readings, shape (n_configurations, n_joints, 2).
        rows: Row of each measurement in `trig`, shape (n,).
        rotation: Measured world_R_tool, shape (n, 3, 3); any if orientation is not wanted.
        position: Measured world_p_tool, shape (n, 3), [m]; any if position is not wanted.
        whitening: Whitens (orientation, position), lower triangular, shape (n, height, height).
        kinds: Whether orientation and position are wanted.
    """

    trig: Floats
    rows: Integers
    rotation: Floats
    position: Floats
    whitening: Floats
    kinds: tuple[bool, bool] = (True, True)

    n_configurations = 1

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.rows)

    @property
    def height(self) -> int:
        """Rows of one measurement: 3 or 6."""
        return 3 * sum(self.kinds)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with measurements start to stop."""
        fill_poses(
            *arguments,
            turns,
            self.trig,
            self.rows,
            self.rotation,
            self.position,
            self.whitening,
            *self.kinds,
            start,
            stop,
            panel,
        )


@dataclass(frozen=True)
class CorrelatedBlock:
    """Blocks whose measurements share errors; every row counts as one measurement.

    Attributes:
        parts: The blocks, each whitened by the noise that its measurements do not share.
        loadings: Of each part's rows, measurement by measurement, per 1 sigma of the shared errors: sparse, shape
            (n * height, n_shared); none at all if nothing is shared.
        gain: G of the module, shape (n_shared, n_shared), where there are more rows than shared errors; else None.
        dense: Else the inverse Cholesky factor of 1 + L L^T, shape (n, n); None if nothing is shared.
        offsets: Taken from each part's rows before anything else, shape (n * height,); none at all if zero.
        spare: Share of each part's rows' own noise that is there for numerical safety alone, shape (n * height,).
    """

    parts: tuple[Block, ...]
    loadings: tuple[scipy.sparse.csr_array, ...] = ()
    gain: Floats | None = None
    dense: Floats | None = None
    offsets: tuple[Floats, ...] = ()
    spare: tuple[Floats, ...] = ()

    height = 1

    @property
    def n(self) -> int:
        """Number of rows."""
        return sum(part.n * part.height for part in self.parts)

    @property
    def n_spare(self) -> float:
        """How many degrees of freedom the rows have by `spare` alone: its trace over the rows' covariance."""
        if not self.spare:
            return 0.0
        spare = np.concatenate(self.spare)
        if self.dense is not None:
            return float(spare @ np.sum(self.dense**2, axis=0))
        if self.gain is None:
            return float(spare.sum())
        R = scipy.linalg.cholesky(_information(self.loadings))
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        explained = np.sum((self._loading @ inverse) ** 2, axis=1)
        return float(spare @ (1.0 - explained))

    def whiten(self, rows: Floats) -> Floats:
        """All rows of the parts, shape (n, m), with their correlation taken out."""
        if self.dense is not None:
            return self.dense @ rows
        if self.gain is None:
            return rows
        L = self._loading
        out: Floats = rows - L @ (self.gain @ (L.T @ rows))
        return out

    def chunks(self, chain: Chain) -> Iterator[Floats]:
        """[J r] with correlated rows whitened, chunk by chunk, shape (rows, n_columns + 1)."""
        if self.gain is None or self.n * (chain.n_columns + 1) <= _KEPT:
            yield self.whiten(np.concatenate([chunk for _, _, chunk in self._private_chunks(chain)]))
            return
        common = self._common(self._private_chunks(chain))
        shift = self.gain @ common  # (n_shared, n_columns + 1)
        for part, rows, chunk in self._private_chunks(chain):
            yield chunk - self.loadings[part][rows] @ shift

    def shared_errors(self, chain: Chain) -> Floats:
        """What the residuals say of the shared errors: their posterior mean at these parameters, shape (n_shared,)."""
        chunks = list(self._private_chunks(chain.without_columns()))
        if self.dense is not None:
            y = np.concatenate([chunk[:, -1] for _, _, chunk in chunks])
            out: Floats = self._loading.T @ (self.dense.T @ (self.dense @ y))
            return out
        if self.gain is None:
            return np.zeros(0)
        z: Floats = scipy.linalg.solve(_information(self.loadings), self._common(chunks)[:, -1], assume_a="pos")
        return z

    @property
    def _loading(self) -> scipy.sparse.csr_array:
        """L of all parts, shape (n, n_shared)."""
        return self.loadings[0] if len(self.loadings) == 1 else scipy.sparse.vstack(self.loadings, format="csr")

    def _common(self, chunks: Iterable[tuple[int, slice, Floats]]) -> Floats:
        """L^T [J r], shape (n_shared, n_columns + 1)."""
        terms = [self.loadings[part][rows].T @ chunk for part, rows, chunk in chunks]
        total: Floats = np.sum(terms, axis=0)
        return total

    def _private_chunks(self, chain: Chain) -> Iterator[tuple[int, slice, Floats]]:
        """Part, its rows, and [J r] before correlation is dealt with."""
        for i, part in enumerate(self.parts):
            for start in range(0, part.n, SPAN):
                stop = min(start + SPAN, part.n)
                r, J = linearise(rows_of(part, slice(start, stop)), chain)
                rows = slice(start * part.height, stop * part.height)
                r = r.ravel()
                if self.offsets:
                    r = r - self.offsets[i][rows]
                yield i, rows, np.column_stack([J.reshape(len(r), -1), r])


def correlate(
    parts: tuple[Block, ...],
    loadings: tuple[scipy.sparse.csr_array, ...],
    offsets: tuple[Floats, ...] = (),
    spare: tuple[Floats, ...] = (),
) -> CorrelatedBlock:
    """Blocks with the errors they share (see `CorrelatedBlock`)."""
    n_rows, n_shared = sum(L.shape[0] for L in loadings), loadings[0].shape[1]
    if n_rows <= n_shared:
        L = scipy.sparse.vstack(loadings, format="csr")
        factor = scipy.linalg.cholesky(np.eye(n_rows) + (L @ L.T).toarray(), lower=True)
        dense: Floats = scipy.linalg.solve_triangular(factor, np.eye(n_rows), lower=True)
        return CorrelatedBlock(parts, loadings, dense=dense, offsets=offsets, spare=spare)
    R = scipy.linalg.cholesky(_information(loadings))
    half = scipy.linalg.solve_triangular(np.eye(len(R)) + R, np.eye(len(R)))
    gain: Floats = scipy.linalg.solve_triangular(R, half.T).T
    return CorrelatedBlock(parts, loadings, gain, offsets=offsets, spare=spare)


def _information(loadings: tuple[scipy.sparse.csr_array, ...]) -> Floats:
    """1 + L^T L, shape (n_shared, n_shared)."""
    total = np.eye(loadings[0].shape[1])
    for L in loadings:
        total += (L.T @ L).toarray()
    return total


AnyBlock = Block | CorrelatedBlock


def rows_of(block: Block, rows: slice) -> Block:
    """The measurements at `rows` of a block.

    Raises:
        InputError: It is a `CorrelatedBlock`: its rows are whitened all together, so some of them are no block.
    """
    if isinstance(block, CorrelatedBlock):
        hint = "linearise and residual give all its rows, whitened together"
        raise InputError("rows_of", "a block whose rows share errors", "one of its parts", hint)
    parts = {f.name: getattr(block, f.name)[rows] for f in fields(block) if f.name not in ("trig", "kinds")}  # type: ignore[arg-type]
    part: Block = replace(block, **parts)  # type: ignore[type-var]
    return part


def residual(block: AnyBlock, chain: Chain) -> Floats:
    """Whitened residuals, shape (n, height)."""
    return linearise(block, chain.without_columns())[0]


def linearise(block: AnyBlock, chain: Chain) -> tuple[Floats, Floats]:
    """Whitened residuals and their derivatives, row by row.

    Returns:
        The residuals, shape (n, height), and the derivatives, shape (n, height, n_columns + n_own): first in the
        chain's columns, then, if the chain has joint columns, in the joints of the measurement's first configuration,
        then of its second. A correlated block has no derivatives in the joints.
    """
    if isinstance(block, CorrelatedBlock):
        rows = np.concatenate(list(block.chunks(chain)))[:, None]
        return rows[:, :, -1], rows[:, :, :-1]
    n_all = _n_columns(block, chain) + 1
    out = np.empty((block.n, block.height, n_all))

    def run(start: int, stop: int) -> None:
        for first, last, panel in _panels(block, chain, start, stop):
            out[first:last] = panel[:, :, : last - first].transpose(2, 1, 0)

    for _ in over_spans(run, block.n):
        pass
    return out[:, :, -1], out[:, :, :-1]


def squared_norm(block: AnyBlock, chain: Chain) -> float:
    """Sum of squared whitened residuals."""
    free = chain.without_columns()
    if isinstance(block, CorrelatedBlock):
        return math.fsum(float(np.vdot(chunk, chunk)) for chunk in block.chunks(free))

    def run(start: int, stop: int) -> float:
        return math.fsum(float(np.vdot(panel, panel)) for _, _, panel in _panels(block, free, start, stop))

    return math.fsum(over_spans(run, block.n))


def gram(block: AnyBlock, chain: Chain) -> Floats:
    """[J r]^T [J r] of the block, shape (n_columns + 1, n_columns + 1)."""
    if isinstance(block, CorrelatedBlock):
        total: Floats = sum(chunk.T @ chunk for chunk in block.chunks(chain))  # type: ignore[assignment]
        return total
    n_all = _n_columns(block, chain) + 1

    def run(start: int, stop: int) -> Floats:
        total = np.zeros((n_all, n_all))
        for _, _, panel in _panels(block, chain, start, stop):
            rows = panel.reshape(n_all, -1)
            total += rows @ rows.T
        return total

    with one_blas_thread:
        return sum(over_spans(run, block.n), np.zeros((n_all, n_all)))


def triangle(block: AnyBlock, chain: Chain) -> Floats:
    """R of a thin QR of [J r], shape (n_columns + 1, n_columns + 1): `gram` without squaring the condition number."""
    if isinstance(block, CorrelatedBlock):
        R = np.zeros((chain.n_columns + 1, chain.n_columns + 1))
        for chunk in block.chunks(chain):
            R = _upper(np.vstack([R, chunk]))
        return R
    n_all = _n_columns(block, chain) + 1

    def run(start: int, stop: int) -> Floats:
        running = np.zeros((0, n_all))
        for _, _, panel in _panels(block, chain, start, stop):
            running = _upper(np.vstack([running, panel.reshape(n_all, -1).T]))
        return running

    with one_blas_thread:
        return _upper(np.vstack([*over_spans(run, block.n), np.zeros((n_all, n_all))]))


def _upper(A: Floats) -> Floats:
    """R of a thin QR."""
    R: Floats = np.linalg.qr(A, mode="r")  # type: ignore[assignment]
    return R


def _n_columns(block: Block, chain: Chain) -> int:
    return chain.n_columns + (block.n_configurations * chain.n_joints if chain.joint_columns else 0)


def _panels(block: Block, chain: Chain, start: int, stop: int) -> Iterator[tuple[int, int, Floats]]:
    """First and last measurement and the panel of each chunk; lanes without a measurement are zero."""
    arguments, turns = chain.arguments, chain.turns
    size = min(CHUNK, -(-(stop - start) // LANES) * LANES)
    whole = np.empty((_n_columns(block, chain) + 1, block.height, size))
    for first in range(start, stop, size):
        last = min(first + size, stop)
        width = -(-(last - first) // LANES) * LANES
        panel = whole if width == size else np.empty((*whole.shape[:2], width))
        block.fill(arguments, turns, first, last, panel)
        yield first, last, panel
