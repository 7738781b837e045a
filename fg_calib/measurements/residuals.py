"""Blocks of measurements: whitened residuals, predicted minus measured, with their analytic derivatives.

A *block* is a set of measurements of one kind; what a kind is and how it gives its derivatives stands in
`measurements.kinds`. One kernel fills a panel, shape (n_columns + 1, rows): the transposed whitened Jacobian and, in
its last row, the whitened residual. Panels are handed on chunk by chunk and never stored for a whole block: `triangle`
reduces them as they come, `linearise` keeps them for those who want to look at every row.

References:
    Andrews (1968), A square root formulation of the Kalman covariance equations. AIAA Journal 6(6).
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
    Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics. arXiv:1812.01537.
"""

from collections.abc import Iterator
from dataclasses import field, fields, replace

import numpy as np
from scipy.linalg import lapack

from fg_calib.inputs import Brief, Floats, Integers
from fg_calib.measurements.kind import Frames, Kind, checked_rows
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import LANES, Chain, fill, forward, over_spans, turning_of_base

CHUNK = 352
"""Measurements in one panel; a multiple of `LANES`, but not of 256: its rows would share places in the cache."""

QR_COLUMNS, QR_SHARE = 8, 30
"""Columns reduced together: as many, or one in `QR_SHARE` if more; for narrow panels four times as fast as numpy's."""

_NOTHING = np.zeros((0, 0)), np.zeros((0, 0, 0, 0)), np.zeros((0, 0, 0))
"""Arrays that `_given` gives for a kind that has a twin."""


class Block(Brief):
    """Measurements of one kind.

    Attributes:
        kind: Kind of measurement.
        trig: Readings, from `Robot.trig`, shape (n_configurations, n_joints, 2).
        ends: Row in `trig` of each end, shape (n, kind.ends).
        data: Measured values, as the kind has them, shape (n, kind.width); any number in a row without weight.
        whitening: Lower triangle, row by row, of a matrix that whitens a measurement's rows, shape (n, residual_dim *
            (residual_dim + 1) / 2); zero for a row that is not measured. See `pack`.
        nuisances: Values of the kind's nuisances, shape (n, kind.n_nuisances).
        source: The table that they are from, for messages.
    """

    kind: Kind
    trig: Floats
    ends: Integers
    data: Floats
    whitening: Floats
    nuisances: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    source: str = ""

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.ends)

    @property
    def residual_dim(self) -> int:
        """Rows of one measurement."""
        return self.kind.residual_dim


def pack(whitening: Floats) -> Floats:
    """Lower triangles, shape (n, d, d) with d the residual_dim, row by row: shape (n, d * (d + 1) / 2)."""
    rows, columns = np.tril_indices(whitening.shape[1])
    return np.ascontiguousarray(whitening[:, rows, columns])


def unpack(whitening: Floats, residual_dim: int) -> Floats:
    """Undo `pack`, shape (n, residual_dim, residual_dim)."""
    rows, columns = np.tril_indices(residual_dim)
    out = np.zeros((len(whitening), residual_dim, residual_dim))
    out[:, rows, columns] = whitening
    return out


def unit_whitening(n: int, residual_dim: int) -> Floats:
    """Whitening of rows that are not whitened; all of them are the same in memory."""
    unit = pack(np.eye(residual_dim)[None])
    return np.broadcast_to(unit, (n, unit.shape[1]))


def rows_of(block: Block, rows: slice | Integers) -> Block:
    """The measurements at `rows` of a block."""
    if isinstance(rows, slice) and rows.indices(block.n) == (0, block.n, 1):
        return block
    return replace(block, **{f.name: getattr(block, f.name)[rows] for f in fields(block)[2:-1]})


def residual(block: Block, chain: Chain) -> Floats:
    """Whitened residuals, shape (n, residual_dim)."""
    return linearise(block, chain.without_columns())[0]


def linearise(block: Block, chain: Chain) -> tuple[Floats, Floats]:
    """Whitened residuals and their derivatives, row by row.

    Returns:
        Residuals, shape (n, residual_dim), and derivatives, shape (n, residual_dim, n_columns + n_own): first in
        the chain's columns, then, if the chain has joint columns, in the joints of the measurement's first end, then of
        its second, then in its nuisances.
    """
    block, chain = _with_curves(block, chain)
    n_all = _n_columns(block, chain) + 1
    out = np.empty((block.n, block.residual_dim, n_all))

    def run(start: int, stop: int) -> None:
        for first, last, panel in panels(block, chain, start, stop):
            out[first:last] = panel[:, :, : last - first].transpose(2, 1, 0)

    over_spans(run, block.n)
    return out[:, :, -1], out[:, :, :-1]


def triangle(block: Block, chain: Chain) -> Floats:
    """R of a thin QR of [J r], shape (n_columns + 1, n_columns + 1)."""
    block, chain = _with_curves(block, chain)
    n_all = _n_columns(block, chain) + 1

    def run(start: int, stop: int) -> Floats:
        running = np.zeros((n_all, n_all), order="F")
        for _, _, panel in panels(block, chain, start, stop):
            rows = panel.reshape(n_all, -1).T
            running = with_rows(running, rows)
        return running

    with one_blas_thread:
        R: Floats = np.linalg.qr(np.vstack([*over_spans(run, block.n), np.zeros((n_all, n_all))]), mode="r")  # type: ignore[assignment]
    return R


def with_rows(R: Floats, rows: Floats) -> Floats:
    """R of a QR of the rows of R and some more; both, in Fortran's order, are overwritten."""
    width = min(max(QR_COLUMNS, len(R) // QR_SHARE), len(R))
    return np.asarray(lapack.dtpqrt(0, width, R, rows, overwrite_a=1, overwrite_b=1)[0])


def squares_along(block: Block, chain: Chain, directions: Floats) -> Floats:
    """Sum of the squares of each row's derivatives along directions, shape (n, residual_dim).

    Args:
        block: The measurements.
        chain: The chain.
        directions: Of all the columns together, one after the other, shape (n_columns, k).
    """
    block, chain = _with_curves(block, chain)
    out, along = np.empty((block.n, block.residual_dim)), np.ascontiguousarray(directions.T)

    def run(start: int, stop: int) -> None:
        for first, last, panel in panels(block, chain, start, stop):
            found = along @ panel[:-1].reshape(len(panel) - 1, panel[0].size)
            out[first:last] = np.einsum("kn,kn->n", found, found).reshape(panel.shape[1:])[:, : last - first].T

    with one_blas_thread:
        over_spans(run, block.n)
    return out


def _with_curves(block: Block, chain: Chain) -> tuple[Block, Chain]:
    """The block with error curves in its readings, and the chain without them."""
    chain, trig = chain.with_curves_in(block.trig)
    return (block if trig is block.trig else replace(block, trig=trig)), chain


def _n_columns(block: Block, chain: Chain) -> int:
    """Number of the chain's columns, and of those of a measurement's own."""
    kind = block.kind
    return chain.n_columns + (kind.ends * chain.n_joints if chain.joint_columns else 0) + kind.n_nuisances


def panels(block: Block, chain: Chain, start: int, stop: int) -> Iterator[tuple[int, int, Floats]]:
    """First and last measurement and the panel of each chunk; lanes without a measurement are zero."""
    arrays, twins = chain.arrays, block.kind.twins()
    size = min(CHUNK, -(-max(stop - start, 1) // LANES) * LANES)
    whole = np.zeros((_n_columns(block, chain) + 1, block.residual_dim, size))
    for first in range(start, stop, size):
        last = min(first + size, stop)
        width = -(-(last - first) // LANES) * LANES
        panel = whole if width == size else np.zeros((*whole.shape[:2], width))
        ends = np.ascontiguousarray(block.ends[first:last])
        data, whitening = (np.array(a[first:last], order="C") for a in (block.data, block.whitening))
        given = _NOTHING if len(twins) else _given(block, chain, slice(first, last))
        fill(arrays, block.trig, ends, data, whitening, twins, given, _turning(block, chain, ends), panel)
        yield first, last, panel


def _given(block: Block, chain: Chain, rows: slice) -> tuple[Floats, Floats, Floats]:
    """Residuals and derivatives in frames and nuisances, by the kind's numpy."""
    frames = frames_at(chain, block.trig, block.ends[rows])
    return checked_rows(block.kind, frames, block.data[rows], block.nuisances[rows], block.source)


def frames_at(chain: Chain, trig: Floats, ends: Integers) -> Frames:
    """Tool frames of the ends of measurements, as `Block` has them."""
    at = forward(chain.without_columns(), trig, ends.ravel())
    return Frames(at.rotation.reshape(*ends.shape, 3, 3), at.position.reshape(*ends.shape, 3))


def _turning(block: Block, chain: Chain, ends: Integers) -> Floats:
    """Turn of the base in each column, shape (3, n_columns), if the residuals are turned back by it; else (3, 0)."""
    if not block.kind.turned_back or chain.n_columns == 0:
        return np.zeros((3, 0))
    at = forward(replace(chain, joint_columns=False), block.trig, ends.T.ravel())
    return np.ascontiguousarray(turning_of_base(at.jacobian[:, :3], at.rotation))
