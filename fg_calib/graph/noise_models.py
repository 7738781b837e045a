"""Noise of measurements at a linearisation point: private noise, and how rows follow from errors that others share.

Three sources of noise reach a row: the measurement's own; the measured poses, where a pair was formed from poses; and
the joint readings, through the row's derivatives in the joints. The last two belong to a configuration and are the same
in every measurement that it takes part in: *errors* of 1 sigma, numbered `configuration * width + slot`, with a slot a
joint, then six for the poses of each table (position, then orientation).

Noise acts on a length or an angle to second order: their rows are `M - measured`, M the mean of what would be
measured, with its slope and variance (see `measurements.moments`): at given parameters a row, scaled and shifted.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property

import numpy as np
import scipy.sparse

from fg_calib.inputs import Booleans, Floats, InputError, Integers, Record
from fg_calib.measurements import Block, Length, MeasurementBlock, Measurements, moments, residuals
from fg_calib.robot import Chain, forward, kernels, nearest_rotation, over_spans, rotation_angle, whiten_small

Sparse = scipy.sparse.csr_array

NoiseName = tuple[int, str]
"""Noise that is known up to a factor: its table and kind, or `JOINT_NOISE`."""

JOINT_NOISE: NoiseName = (-1, "joint")
"""Noise of the joint readings, which is one for all tables and kinds."""

MIN_SLOPE = 1e-3
"""Slope of a mean near a length of 0, at least: such a row says next to nothing."""

POSE_SLOTS = 6
"""Errors of a measured pose: of its position along the axes, then of its orientation about them."""

_MOMENTS = (moments.length_moments, moments.angle_moments)
"""Moments of lengths, of pairs and to anchors, and of rotation angles."""


class NoiseState(Record):
    """Estimated noise of the measurements on the way to a solution.

    Attributes:
        weights: Robust weight of each measurement of each block, in [0, 1]; None for 1.
        factors: Factors on the specified sigmas, by table and kind those of the measurements (or of the measured poses
            that pairs were formed from), and those of the joint readings; 1 where none is given.
    """

    weights: tuple[Floats, ...] | None = None
    factors: Mapping[NoiseName, float] = field(default_factory=dict)


class TableState(Record):
    """A table at a linearisation point.

    Attributes:
        measurements: The table.
        number: Its number.
        configurations: Its configurations among those of all tables, shape (n_configurations,).
        trig: Its readings, for the kernels.
        chain: The chain from its measurement frame.
        coordinates: Values of all landmark coordinates.
        width: Errors of one configuration.
        n_errors: Errors of all configurations of all tables.
    """

    measurements: Measurements
    number: int
    configurations: Integers
    trig: Floats
    chain: Chain
    coordinates: Floats
    width: int
    n_errors: int


class RowNoise:
    """The rows of a block and their noise: to second order of lengths and angles of pairs, else to first order.

    Args:
        block: The block.
        place: Its table at the linearisation point.
        state: Estimated noise.

    Attributes:
        factors: Factor on the specified sigma of each row's own kind, shape (residual_dim,).
        variance: Variance of each row's private noise, shape (n, residual_dim); of poses the diagonal of `private_at`.
        loading: Change of the rows per 1 sigma of each error that they follow from, shape (n, residual_dim, k).
        columns: Numbers of these errors, shape (n, k).
        n_of_joints: How many of the k are errors of joint readings, the first ones; others are of measured poses.
        excess: Mean of each row's noise, shape (n, residual_dim).
        slope: Derivative of each row's mean in what it is without noise, shape (n, residual_dim); None for 1.
    """

    def __init__(self, block: MeasurementBlock, place: TableState, state: NoiseState) -> None:
        self.block, self.place = block, place
        families = [name.partition(".")[0] for name in block.kind.names]
        self.factors: Floats = np.array([state.factors.get((block.table, family), 1.0) for family in families])
        self._sigma_joint = place.measurements.sigma_joint * state.factors.get(JOINT_NOISE, 1.0)
        self.variance: Floats = (block.sigma * self.factors) ** 2
        self._moments = _moments_of(block)
        self.excess: Floats = np.broadcast_to(0.0, self.variance.shape)
        self.slope: Floats | None = None
        self.columns, self.loading = np.zeros((block.n, 0), np.int64), np.zeros((*self.variance.shape, 0))
        if block.kind.ends and np.any(self._sigma_joint > 0.0):
            self._add_errors(self._joint_loading(), 0)
        self.n_of_joints = self.columns.shape[1]
        if block.formed:
            self._add_errors(self._pose_loading(), place.chain.n_joints + POSE_SLOTS * place.number)
        if self._moments:
            self._take_moments()

    @cached_property
    def as_measured(self) -> Block:
        """All rows as they were measured, to first order, not whitened."""
        s, p = self.block, self.place
        unit = residuals.unit_whitening(s.n, s.kind.residual_dim)
        return Block(s.kind, p.trig, s.ends, s.data, unit, p.coordinates[s.nuisances], s.source)

    def rows_at(self, rows: Integers | slice) -> Block:
        """Some of the rows, not whitened, in [m] and [rad]; of pairs scaled and shifted as their means are."""
        plain = residuals.rows_of(self.as_measured, rows)
        if self.slope is None:
            return plain
        slope, h = np.maximum(self.slope[rows], MIN_SLOPE), self.block.kind.residual_dim
        whitening = np.zeros(plain.whitening.shape)
        whitening[:, np.cumsum(np.arange(1, 1 + h)) - 1] = slope
        data = plain.data + self._off[rows] * (1.0 - 1.0 / slope) - self.excess[rows] / slope
        return replace(plain, data=data, whitening=whitening)

    def private_at(self, rows: Integers | slice) -> Floats:
        """Covariance of the private noise of some measurements, shape (m, residual_dim, residual_dim)."""
        if self.block.covariance is not None:
            return self.block.covariance[rows] * np.outer(self.factors, self.factors)
        return self.variance[rows][:, :, None] * np.eye(self.block.kind.residual_dim)

    def total_at(self, rows: Integers | slice) -> Floats:
        """Covariance of all noise of some measurements, shape (m, residual_dim, residual_dim)."""
        G = self.loading[rows]
        return self.private_at(rows) + G @ np.swapaxes(G, 1, 2)

    @property
    def sigma(self) -> Floats:
        """1 sigma of each row, all noise together, shape (n, residual_dim), [m] and [rad]."""
        return np.sqrt(self.variance + np.einsum("nhk,nhk->nh", self.loading, self.loading))

    def residual(self) -> Floats:
        """Residuals of all rows, shape (n, residual_dim), [m] and [rad]."""
        return np.asarray(self._off + self.excess, dtype=np.float64)

    def lengths(self) -> tuple[Floats, Integers]:
        """Mahalanobis length of each measurement's residual, and its number of rows, shapes (n,).

        Both are 0 for measurements that take no part.
        """
        used = self.block.used
        W = whitening_of(self.total_at(slice(None)), used)
        return np.linalg.norm(W @ np.where(used, self.residual(), 0.0)[:, :, None], axis=(1, 2)), used.sum(axis=1)

    def errors_at(self, rows: Integers, W: Floats | None = None, chosen: Booleans | None = None) -> Sparse:
        """How some rows follow from all errors, sparse, shape (m residual_dim, n_errors).

        Args:
            rows: The measurements.
            W: Matrix that multiplies their rows, shape (m, residual_dim, residual_dim); nothing if None.
            chosen: Which of the entries of `loading` are wanted, of a shape that goes with its rows; all if None.
        """
        G = self.loading[rows] if chosen is None else np.where(chosen, self.loading[rows], 0.0)
        G = G if W is None else W @ G
        taken, columns = G != 0.0, np.broadcast_to(self.columns[rows][:, None], G.shape)
        starts = np.concatenate([[0], np.cumsum(taken.sum(axis=2))])
        out = Sparse((G[taken], columns[taken], starts), shape=(G.shape[0] * G.shape[1], self.place.n_errors))
        out.sum_duplicates()  # in place
        return out

    @cached_property
    def _off(self) -> Floats:
        """Predicted minus measured, shape (n, residual_dim)."""
        return residuals.residual(self.as_measured, self.place.chain)

    def _add_errors(self, loading: Floats, first: int) -> None:
        """Add errors, loading of shape (n, residual_dim, ends, w), in the slots from the first on."""
        n, h, ends, w = loading.shape
        columns = self.place.configurations[self.block.ends][:, :, None] * self.place.width + first + np.arange(w)
        self.columns = np.hstack([self.columns, columns.reshape(n, ends * w)])
        self.loading = np.concatenate([self.loading, loading.reshape(n, h, ends * w)], axis=2)

    def _joint_loading(self) -> Floats:
        s, chain = self.block, self.place.chain.without_columns().with_joint_columns()
        loading = np.empty((s.n, s.kind.residual_dim, s.kind.ends, chain.n_joints))

        def load(rows: slice) -> None:
            J = residuals.linearise(residuals.rows_of(self.as_measured, rows), chain)[1]
            loading[rows] = J[:, :, : s.kind.ends * chain.n_joints].reshape(loading[rows].shape) * self._sigma_joint

        _over_rows(load, s.n)
        return loading

    def _pose_loading(self) -> Floats:
        """Loading of distances and angles by measured poses: minus at the first end, plus at the second.

        Directions are those predicted: those of measured poses would depend on the errors whose effect they give.
        """
        m, s = self.place.measurements, self.block
        poses = forward(self.place.chain.without_columns(), self.place.trig)
        p, R, (a, b) = poses.position, poses.rotation, s.ends.T
        axes = rotation_angle(np.swapaxes(R[a], 1, 2) @ R[b])[1]
        directions = _unit(p[b] - p[a]) @ self._world_R_base(p).T, _unit(axes)
        loading = np.zeros((s.n, s.kind.residual_dim, 2, POSE_SLOTS))
        for i, k in enumerate(self._moments):
            sigma = (m.sigma_position, m.sigma_orientation)[k]
            if sigma is not None:
                both = directions[k][:, None] * np.array([1.0, -1.0])[:, None]  # of predicted minus measured
                loading[:, i, :, 3 * k : 3 * k + 3] = self.factors[i] * both * sigma[s.ends]
        return loading

    def _world_R_base(self, p: Floats) -> Floats:  # noqa: N802 -- frames by their letters
        """The rotation that brings the predicted points nearest to the measured ones, shape (3, 3)."""
        m = self.place.measurements
        if m.position is None or m.test.all():
            return np.eye(3)
        measured, p = m.position[~m.test], p[~m.test]
        return nearest_rotation((measured - measured.mean(axis=0)).T @ (p - p.mean(axis=0)))

    def _take_moments(self) -> None:
        """Bias, slope and variance of distances and angles of pairs, to second order."""
        s, trace, off = self.block, self._traces(), self._off
        off = off - self.place.coordinates[s.nuisances[:, 3:]].sum(axis=1, keepdims=True)  # an instrument's, of anchors
        first, private = self.loading, np.zeros_like(self.variance) if s.formed else np.nan_to_num(self.variance)
        self.excess, slope, self.variance = (np.empty(self.variance.shape) for _ in range(3))
        self.loading, self.slope = np.empty(first.shape), slope

        def run(rows: slice) -> None:
            predicted, G = off[rows] + s.data[rows], first[rows]
            along, all_ways = np.einsum("nhk,nhk->nh", G, G), trace[s.ends[rows]].sum(axis=1)
            for i, k in enumerate(self._moments):
                across = np.maximum(all_ways[:, k] - along[:, i], 0.0) / 2.0
                found = _MOMENTS[k](predicted[:, i], along[:, i], across, private[rows, i])
                self.excess[rows, i], slope[rows, i] = found.excess, found.slope
                self.variance[rows, i] = np.maximum(found.variance - found.slope**2 * along[:, i], 0.0)
            self.loading[rows] = G * slope[rows][:, :, None]

        _over_rows(run, s.n)

    def _traces(self) -> Floats:
        """Variance of position and orientation at each configuration by shared errors, shape (n_configurations, 2)."""
        s, m = self.block, self.place.measurements
        trace = np.zeros((len(self.place.trig), 2))
        if self.n_of_joints:
            J = forward(self.place.chain.without_columns().with_joint_columns(), self.place.trig).jacobian
            J = J * self._sigma_joint
            trace += np.stack([np.sum(J[:, 3:] ** 2, axis=(1, 2)), np.sum(J[:, :3] ** 2, axis=(1, 2))], axis=1)
        for i, k in enumerate(self._moments if s.formed else ()):
            sigma = (m.sigma_position, m.sigma_orientation)[k]
            if sigma is not None:
                trace[:, k] += np.sum(sigma**2, axis=1) * self.factors[i] ** 2
        return trace


def reach(noises: Sequence[RowNoise], *, test: bool = False) -> Integers:
    """Number of train (or test) measurements that each error reaches, shape (n_errors,)."""
    total = np.zeros(noises[0].place.n_errors if noises else 0, dtype=np.int64)
    for noise in noises:
        rows = np.flatnonzero(noise.block.test) if test else noise.block.train
        total += np.bincount(noise.columns[rows][noise.loading[rows].any(axis=1)], minlength=len(total))
    return total


def same_everywhere(block: MeasurementBlock, sigma_joint: Floats) -> bool:
    """Whether the noise is the same at all parameters: noise of joint readings, and moments of pairs, are not."""
    return not _moments_of(block) and not (block.kind.ends and np.any(sigma_joint > 0.0))


def _moments_of(block: MeasurementBlock) -> list[int]:
    """Of each part which of `_MOMENTS` it has; empty of other kinds."""
    angles = [(part, part.code == kernels.ROTATION_ANGLE) for part in block.kind.parts]
    return [int(angle) for part, angle in angles if angle or (isinstance(part, Length) and part.ends)]


def whitening_of(covariance: Floats, used: Booleans) -> Floats:
    """W with W S W^T = 1 for the rows in use of each of many small covariances, lower triangular; zero for the others.

    Args:
        covariance: S, shape (n, residual_dim, residual_dim).
        used: Shape (n, residual_dim).

    Raises:
        InputError: Rounding leaves nothing of the noise along some direction.
    """
    W = np.empty(covariance.shape)
    C, mask = (np.require(given, requirements=["C", "W"]) for given in (covariance, used))  # as the kernel takes them
    if not all(over_spans(lambda start, stop: whiten_small(C, mask, start, stop, W), len(used))):
        found = "lost in rounding next to what errors of the joint readings do"
        hint = "is noise.joint or a length of the arm or of a table far too large, or other noise far too small?"
        raise InputError("noise", found, "figures nearer to each other", hint)
    return W


def _over_rows(run: Callable[[slice], None], n: int) -> None:
    """Work on n rows in spans, so that intermediate results stay in the processor's cache."""
    over_spans(lambda start, stop: run(slice(start, stop)), n)


def _unit(vectors: Floats) -> Floats:
    """Vectors of length 1 along others (zero for zero), shape (n, 3)."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300), dtype=np.float64)
