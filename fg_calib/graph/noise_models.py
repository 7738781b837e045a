"""Noise of measurements at a linearisation point: private noise, and how rows follow from errors that others share.

Three sources of noise reach a row: the measurement's own; the measured poses, where a pair was formed from poses; and
the joint readings, through the row's derivatives in the joints. The last two belong to a configuration and are the same
in every measurement that it takes part in.

Noise acts on a length or an angle to second order: rows of pairs are `M - measured`, M the mean of what would be
measured, with its slope and variance (see `measurements.moments`): at given parameters a row, scaled and shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fg_calib.inputs import Booleans, Floats, InputError, Integers
from fg_calib.measurements import (
    Block,
    MeasurementBlock,
    Measurements,
    Moments,
    angle_moments,
    length_moments,
    residuals,
    unit_whitening,
)
from fg_calib.robot import (
    SPAN,
    Chain,
    Poses,
    forward,
    kernels,
    nearest_rotation,
    over_spans,
    rotation_angle,
    whiten_small,
)

NoiseName = tuple[int, str]
"""Noise that is known up to a factor: its table and kind, or `JOINT_NOISE`."""

JOINT_NOISE: NoiseName = (-1, "joint")
"""Noise of the joint readings, which is one for all tables and kinds."""

MIN_SLOPE = 1e-3
"""Slope of a mean near a length of 0, at least: such a row says next to nothing."""

PRIVATE_SHARE = 1e-3
"""Share of a pair's variance that counts as private at least: errors of the poses are not all that there is."""

SECOND_ORDER_WEIGHT = 100.0
"""Factor on the second-order variance of pairs that are more than the errors they share: it is all that they have left
to say, and its distribution is not normal."""


@dataclass(frozen=True)
class NoiseState:
    """What has been learned of the measurements' noise on the way to a solution.

    Attributes:
        weights: Robust weight of each measurement of each series, in [0, 1]; None for 1.
        factors: Factors on the specified sigmas, by table and kind those of the measurements (or of the measured poses
            that pairs were formed from), and those of the joint readings; 1 where none is given.
        joint_errors: True joint values minus readings, where encoder noise is estimated, shape
            (n_configurations, n_joints), [rad] (prismatic: [m]); None for 0.
    """

    weights: tuple[Floats, ...] | None = None
    factors: Mapping[NoiseName, float] = field(default_factory=dict)
    joint_errors: Floats | None = None


class NoiseSource(NamedTuple):
    """How rows follow from errors of 1 sigma that belong to configurations.

    Attributes:
        name: `joints`, or `poses` of a table.
        ends: Configuration of each end, among those of all tables, shape (n, ends).
        loading: Change of the rows per error of each end, shape (n, residual_dim, ends, width).
    """

    name: str
    ends: Integers
    loading: Floats

    @property
    def variance(self) -> Floats:
        """Covariance that the source gives each measurement's rows, shape (n, residual_dim, residual_dim)."""
        n, residual_dim, ends, width = self.loading.shape
        flat = self.loading.reshape(n, residual_dim, ends * width)
        out: Floats = flat @ np.swapaxes(flat, 1, 2)
        return out

    def at(self, rows: Integers | slice) -> NoiseSource:
        """The source of some of the rows."""
        return self._replace(ends=self.ends[rows], loading=self.loading[rows])


@dataclass(frozen=True)
class TableState:
    """A table at a linearisation point.

    Attributes:
        measurements: The table.
        configurations: Its configurations among those of all tables, shape (n_configurations,).
        trig: Its readings, or the joint values that are estimated in their place, for the kernels.
        chain: The chain from its measurement frame.
        coordinates: Values of all landmark coordinates.
        joints_estimated: Whether true joint values are estimated: their errors then change no mean.
    """

    measurements: Measurements
    configurations: Integers
    trig: Floats
    chain: Chain
    coordinates: Floats
    joints_estimated: bool = False

    @cached_property
    def joints(self) -> Integers:
        """Joints whose readings have noise."""
        return np.flatnonzero(self.measurements.sigma_joint > 0.0)


class RowNoise:
    """The rows of a series and their noise, to first order.

    Args:
        series: The series.
        place: Its table at the linearisation point.
        state: What has been learned of the noise.

    Attributes:
        sources: Noise of the rows that belongs to configurations.
        factors: Factor on the specified sigma of each row's own kind, shape (residual_dim,).
        joint_factor: Factor on that of the joint readings.
    """

    def __init__(self, series: MeasurementBlock, place: TableState, state: NoiseState) -> None:
        self.series = series
        self.place = place
        families = [name.partition(".")[0] for name in series.kind.names]
        self.factors: Floats = np.array([state.factors.get((series.table, family), 1.0) for family in families])
        self.joint_factor = state.factors.get(JOINT_NOISE, 1.0)
        self._prepare()

    def _prepare(self) -> None:
        self.sources = self._joint_source()

    @cached_property
    def rows(self) -> Block:
        """All rows, not whitened, in [m] and [rad]."""
        return self.rows_at(slice(None))

    @cached_property
    def as_measured(self) -> Block:
        """All rows as they were measured, to first order."""
        s, p = self.series, self.place
        unit = unit_whitening(s.n, s.kind.residual_dim)
        return Block(s.kind, p.trig, s.ends, s.data, unit, p.coordinates[s.nuisances], s.source)

    def rows_at(self, rows: Integers | slice, moments: Moments | None = None) -> Block:
        """Some of the rows, not whitened.

        Args:
            rows: Which.
            moments: Their `moments_at`, where they are known.
        """
        return residuals.rows_of(self.as_measured, rows)

    def moments_at(self, rows: Integers | slice) -> Moments:
        """Bias by noise, slope of the mean and variance of the private noise of some rows, shapes (m, residual_dim)."""
        variance: Floats = (self.series.sigma[rows] * self.factors) ** 2
        return Moments(np.zeros_like(variance), np.ones_like(variance), variance)

    def own_at(self, rows: Integers | slice, moments: Moments | None = None) -> Floats:
        """Covariance of the private noise of some measurements, shape (m, residual_dim, residual_dim).

        Args:
            rows: Which.
            moments: Their `moments_at`, where they are known.
        """
        if self.series.covariance is not None:
            covariance: Floats = self.series.covariance[rows] * np.outer(self.factors, self.factors)
            return covariance
        variance = (moments or self.moments_at(rows)).variance
        out: Floats = variance[:, :, None] * np.eye(variance.shape[1])
        return out

    def total_at(self, rows: Integers | slice, moments: Moments | None = None) -> Floats:
        """Covariance of all noise of some measurements, shape (m, residual_dim, residual_dim)."""
        out: Floats = self.own_at(rows, moments) + sum(source.at(rows).variance for source in self.sources)
        return out

    @cached_property
    def total(self) -> Floats:
        """Covariance of all noise of each measurement, shape (n, residual_dim, residual_dim)."""
        return self.total_at(slice(None))

    @property
    def sigma(self) -> Floats:
        """1 sigma of each row, all noise together, shape (n, residual_dim), [m] and [rad]."""
        return self.figures()[2]

    def residual(self) -> Floats:
        """Residuals of all rows, shape (n, residual_dim), [m] and [rad]."""
        return self.figures()[0]

    def figures(self) -> tuple[Floats, Floats, Floats]:
        """Residual of each row, its bias by noise, and its 1 sigma, shapes (n, residual_dim), [m] and [rad]."""
        residual, excess, sigma = (np.empty((self.series.n, self.series.kind.residual_dim)) for _ in range(3))

        def run(rows: slice) -> None:
            moments = self.moments_at(rows)
            residual[rows], excess[rows] = self._residual_at(rows, moments), moments.excess
            sigma[rows] = np.sqrt(np.einsum("nii->ni", self.total_at(rows, moments)))

        _over_rows(run, self.series.n)
        return residual, excess, sigma

    def _residual_at(self, rows: slice, moments: Moments) -> Floats:
        return residuals.residual(self.rows_at(rows, moments), self.place.chain)

    def lengths(self) -> tuple[Floats, Integers]:
        """Mahalanobis length of each measurement's residual, and its number of rows, shapes (n,).

        Both are 0 for measurements that take no part.
        """
        used = self.series.used
        r = np.where(used, self.residual(), 0.0)
        W = whitening_of(self.total, used)
        return np.linalg.norm(W @ r[:, :, None], axis=(1, 2)), used.sum(axis=1)

    def private_diagonal(self, rows: Integers, carried: frozenset[str]) -> tuple[Floats, Floats]:
        """Variance of private noise as rows are weighted by it, and the part of it that is artificial.

        Args:
            rows: Measurements.
            carried: Names of the sources whose errors measurements share.

        Returns:
            Shapes (m, residual_dim).
        """
        variance = self.moments_at(rows).variance
        return variance, np.zeros_like(variance)

    def _joint_source(self) -> tuple[NoiseSource, ...]:
        p, s = self.place, self.series
        if not len(p.joints) or not s.kind.ends:
            return ()
        chain = p.chain.without_columns().with_joint_columns()
        sigma = p.measurements.sigma_joint[p.joints] * self.joint_factor
        loading = np.empty((s.n, s.kind.residual_dim, s.kind.ends, len(sigma)))

        def load(rows: slice) -> None:
            block = residuals.rows_of(self.as_measured, rows)
            J = residuals.linearise(block, chain)[1][:, :, : s.kind.ends * p.chain.n_joints]
            loading[rows] = J.reshape(*loading[rows].shape[:3], p.chain.n_joints)[..., p.joints] * sigma

        _over_rows(load, s.n)
        return (NoiseSource("joints", p.configurations[s.ends], loading),)


class PairNoise(RowNoise):
    """The noise of distances and angles of pairs to second order (see `measurements.moments`).

    Attributes:
        predicted: Distance and angle as the arm predicts them, 0 where the kind has none, shape (n, 2).
    """

    def _prepare(self) -> None:
        s = self.series
        self._parts = [_COMPONENT[part.code] for part in s.kind.parts if part.code is not None]
        self._both = np.ones(2)  # factors of distance and angle
        self._both[self._parts] = self.factors
        self.predicted = self._predict()
        self._formed = np.nan_to_num(self._formed_variance()) * self._both**2 if s.formed else None
        self._first_order = self._joint_source()
        self._traces = self._joint_trace()
        self.sources = ()
        self._kept: tuple[Moments, Floats] | None = None
        if s.n <= SPAN or s.formed or self._first_order:  # few, or asked for at once
            moments, _ = self._kept = self._all_moments()
            slope = moments.slope[:, :, None, None]
            self.sources = tuple(source._replace(loading=source.loading * slope) for source in self._first_order)
            if s.formed:
                self.sources += (self._pose_source(moments.slope),)
            self._first_order = ()

    def _predict(self) -> Floats:
        s, predicted = self.series, np.zeros((self.series.n, 2))

        def predict(rows: slice) -> None:
            block = residuals.rows_of(self.as_measured, rows)
            predicted[rows, self._parts] = residuals.residual(block, self.place.chain) + s.data[rows]

        _over_rows(predict, s.n)
        return predicted

    def moments_at(self, rows: Integers | slice) -> Moments:
        """Bias, slope and variance of some rows; computed on demand where all would fill the memory."""
        if self._kept is None:
            return self._work_out(rows)[0]
        moments = self._kept[0]
        return Moments(moments.excess[rows], moments.slope[rows], moments.variance[rows])

    def _all_moments(self) -> tuple[Moments, Floats]:
        excess, slope, variance, second = (np.empty((self.series.n, len(self._parts))) for _ in range(4))

        def run(rows: slice) -> None:
            found, second[rows] = self._work_out(rows)
            excess[rows], slope[rows], variance[rows] = found.excess, found.slope, found.variance

        _over_rows(run, self.series.n)
        return Moments(excess, slope, variance), second

    def _work_out(self, rows: Integers | slice) -> tuple[Moments, Floats]:
        """`moments_at`, and the second-order variance of pairs formed from poses (else 0)."""
        moments = self._moments(rows)
        excess, slope, left = moments.excess, moments.slope, moments.variance
        second = np.zeros(left.shape if self.series.formed else (1, left.shape[1]))
        if not self.place.joints_estimated:
            for source in self._first_order:
                left -= slope**2 * np.einsum("nii->ni", source.at(rows).variance)
        if self.series.formed:
            first = slope**2 * self._own(rows)[:, self._parts]
            second = np.maximum(left - first, 0.0)
            left -= first + 0.5 * second
        return Moments(excess, slope, left), second

    @property
    def _second_order(self) -> Floats:
        """Second-order variance of pairs formed from poses, shape (n, residual_dim)."""
        assert self._kept is not None
        return self._kept[1]

    def rows_at(self, rows: Integers | slice, moments: Moments | None = None) -> Block:
        """Some of the rows, not whitened, but scaled and shifted as their means are."""
        moments, plain = moments or self.moments_at(rows), residuals.rows_of(self.as_measured, rows)
        whitening = np.zeros(plain.whitening.shape)
        diagonal = np.cumsum(np.arange(1, 1 + len(self._parts))) - 1
        slope = np.maximum(moments.slope, MIN_SLOPE)
        off = self._narrow(self.predicted[rows]) - plain.data
        whitening[:, diagonal] = slope
        return replace(plain, data=plain.data + off * (1.0 - 1.0 / slope) - moments.excess / slope, whitening=whitening)

    def _residual_at(self, rows: slice, moments: Moments) -> Floats:
        out: Floats = self._narrow(self.predicted[rows]) - self.series.data[rows] + moments.excess
        return out

    def private_diagonal(self, rows: Integers, carried: frozenset[str]) -> tuple[Floats, Floats]:
        """Variance of private noise as rows are weighted by it, and the part of it that is artificial."""
        s, variance = self.series, self.moments_at(rows).variance
        bare, more = variance, np.zeros_like(variance)
        if s.formed:
            bare = 0.5 * self._second_order[rows]
            shared = [source for source in self.sources if source.name in carried]
            n_errors = len(np.unique(s.ends[s.train])) * sum(source.loading.shape[3] for source in shared)
            of_poses = any(source.name != "joints" for source in shared)
            if of_poses and len(s.train) * s.kind.residual_dim > n_errors:
                more = (SECOND_ORDER_WEIGHT - 1.0) * bare
        diagonal = np.maximum(variance + more, PRIVATE_SHARE * np.einsum("nii->ni", self.total[rows]))
        return diagonal, np.maximum(diagonal - bare, 0.0)

    @cached_property
    def _poses(self) -> Poses:
        """Predicted tool poses of the table's configurations."""
        return forward(self.place.chain.without_columns(), self.place.trig)

    def _narrow(self, both: Floats) -> Floats:
        """Of (distance, angle) those that the kind has."""
        return np.ascontiguousarray(both[:, self._parts])

    def _own(self, rows: Integers | slice) -> Floats:
        """First-order variance of some distances and angles as measured, 0 where the kind has none, shape (m, 2)."""
        if self._formed is not None:
            return self._formed[rows]
        sigma = self.series.sigma[rows]
        own = np.zeros((len(sigma), 2))
        own[:, self._parts] = np.where(np.isnan(sigma), 0.0, sigma**2 * self.factors**2)
        return own

    def _moments(self, rows: Integers | slice) -> Moments:
        """Mean and variance of the distances and angles that the kind has, shapes (n, residual_dim)."""
        s, m, factors = self.series, self.place.measurements, self._both**2
        ends, own = s.ends[rows], self._own(rows)
        along, trace = np.zeros_like(own), np.zeros_like(own)
        if s.formed:
            along, own = own, np.zeros_like(own)
            trace = np.stack([_trace(m.sigma_position, ends), _trace(m.sigma_orientation, ends)], axis=1) * factors
        if len(self._traces):
            trace = trace + self._traces[ends].sum(axis=1)
            along = along.copy()
            for source in self._first_order:
                along[:, self._parts] += np.einsum("nii->ni", source.at(rows).variance)
        across = np.maximum(trace - along, 0.0) / 2.0
        given = (self.predicted[rows], along, across, own)
        of = [_MOMENTS[k](*(v[:, k] for v in given)) for k in self._parts]
        return Moments(*(np.stack([getattr(m, name) for m in of], axis=1) for name in ("excess", "slope", "variance")))

    def _formed_variance(self) -> Floats:
        """Variance of distances and angles between measured poses, shape (n, 2); nan where not measured."""
        m, ends, both = self.place.measurements, self.series.ends, np.full((self.series.n, 2), np.nan)
        for k, sigma in enumerate((m.sigma_position, m.sigma_orientation)):
            if sigma is not None:
                both[:, k] = np.sum(self._directions[k] ** 2 * np.sum(sigma[ends] ** 2, axis=1), axis=1)
        return both

    @cached_property
    def _directions(self) -> tuple[Floats, Floats]:
        """Unit vectors from a to b in the measurement frame, and axes of the rotation from a to b in a, shapes (n, 3).

        As predicted: directions of measured poses would depend on the errors whose effect they are to say.
        """
        p, R, (a, b) = self._poses.position, self._poses.rotation, self.series.ends.T
        along = _unit(p[b] - p[a]) @ self._world_R_base().T
        return along, _unit(rotation_angle(np.swapaxes(R[a], 1, 2) @ R[b])[1])

    def _world_R_base(self) -> Floats:  # noqa: N802 -- frames by their letters
        """The rotation that brings the predicted points nearest to the measured ones, shape (3, 3)."""
        m = self.place.measurements
        if m.position is None or m.test.all():
            return np.eye(3)
        measured, p = m.position[~m.test], self._poses.position[~m.test]
        return nearest_rotation((measured - measured.mean(axis=0)).T @ (p - p.mean(axis=0)))

    def _pose_source(self, slopes: Floats) -> NoiseSource:
        """How the rows follow from the errors of the measured poses that the pairs were formed from.

        Of each kind a pose has three errors, along the axes, and a fourth, the square of its errors across: the latter
        lengthen all pairs of the pose. Half of the second-order variance of a pair is theirs, a quarter at either end;
        the other half, of the product of the errors at both ends, is private.

        Args:
            slopes: Slope of the mean of each row, shape (n, residual_dim).
        """
        m, s, n_parts = self.place.measurements, self.series, len(self._parts)
        G = np.zeros((s.n, n_parts, 2, n_parts, 4))  # row, quantity, end, its source, (axes, square)
        sign = np.array([1.0, -1.0])[:, None]  # of predicted minus measured in the error at a, at b
        for i, k in enumerate(self._parts):
            sigma = (m.sigma_position, m.sigma_orientation)[k]
            slope = slopes[:, i, None, None]
            if sigma is not None:
                G[:, i, :, i, :3] = self._both[k] * slope * sign * self._directions[k][:, None] * sigma[s.ends]
            G[:, i, :, i, 3] = -0.5 * np.sqrt(self._second_order[:, i, None])
        loading = G.reshape(s.n, n_parts, 2, 4 * n_parts)
        return NoiseSource(f"poses of table {s.table}", self.place.configurations[s.ends], loading)

    def _joint_trace(self) -> Floats:
        """Variance that joint noise gives each vector at one end, all directions together, shape (n_configurations, 2).

        No rows where there is none, or where true joint values are estimated.
        """
        if self.place.joints_estimated or not len(self.place.joints):
            return np.zeros((0, 2))
        J = forward(self.place.chain.without_columns().with_joint_columns(), self.place.trig).jacobian
        J = J * self.place.measurements.sigma_joint * self.joint_factor
        return np.stack([np.sum(J[:, 3:] ** 2, axis=(1, 2)), np.sum(J[:, :3] ** 2, axis=(1, 2))], axis=1)


_COMPONENT = {kernels.DISTANCE: 0, kernels.ROTATION_ANGLE: 1}
"""Place of the moments of a pair's distance and angle, by the code of its kind."""

_MOMENTS = (length_moments, angle_moments)


def row_noise(series: MeasurementBlock, place: TableState, state: NoiseState) -> RowNoise:
    """The rows of a series and their noise."""
    return (PairNoise if _has_moments(series) else RowNoise)(series, place, state)


def same_everywhere(series: MeasurementBlock, sigma_joint: Floats) -> bool:
    """Whether the noise is the same at all parameters: noise of joint readings, and moments of pairs, are not."""
    return not _has_moments(series) and not (series.kind.ends and np.any(sigma_joint > 0.0))


def _has_moments(series: MeasurementBlock) -> bool:
    """Whether all its rows are distances and angles of pairs."""
    return all(part.code in _COMPONENT for part in series.kind.parts)


def whitening_of(covariance: Floats, used: Booleans) -> Floats:
    """W with W S W^T = 1 for the rows in use of each of many small covariances, lower triangular; zero for the others.

    Args:
        covariance: S, shape (n, residual_dim, residual_dim).
        used: Shape (n, residual_dim).

    Raises:
        InputError: Rounding leaves nothing of the noise along some direction.
    """
    if used.shape[1] == 1:
        with np.errstate(divide="ignore"):
            return np.where(used[:, :, None], 1.0 / np.sqrt(covariance), 0.0)
    W = np.empty(covariance.shape)
    C, mask = (np.require(given, requirements=["C", "W"]) for given in (covariance, used))  # as the kernel takes them
    if not all(over_spans(lambda start, stop: whiten_small(C, mask, start, stop, W), len(used))):
        found = "lost in rounding next to what errors of the joint readings do"
        hint = "is noise.joint or a length of the arm or of a table far too large, or other noise far too small?"
        raise InputError("noise", found, "figures nearer to each other", hint)
    return W


def _over_rows(run: Callable[[slice], None], n: int) -> None:
    """Work on n rows in spans, so that intermediate results stay in the processor's cache."""
    for _ in over_spans(lambda start, stop: run(slice(start, stop)), n):
        pass


def _trace(sigma: Floats | None, ends: Integers) -> Floats:
    """Variance of a difference between two configurations, all directions together, shape (n,)."""
    if sigma is None:
        return np.zeros(len(ends))
    both: Floats = np.sum(sigma**2, axis=1)[ends].sum(axis=1)
    return both


def _unit(vectors: Floats) -> Floats:
    """Vectors of length 1 along others (zero for zero), shape (n, 3)."""
    out: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return out
