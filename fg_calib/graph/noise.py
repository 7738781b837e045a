"""The noise of rows at some parameters: what is a measurement's own, and what follows from errors that others share.

Three sources of noise reach a row: that of the measurement itself; that of the measured poses where a pair was formed
from poses; and that of the joint readings, through the row's derivatives in the joints. The last two belong to a
configuration and are the same in every measurement that it takes part in.

What noise does to a length or an angle is not linear: rows of pairs are `M - measured`, M the mean of what would be
measured, with its slope and variance (see `moments`). At given parameters that is an ordinary row, scaled and shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.moments import Moments, angle_moments, length_moments
from fg_calib.measurements.residuals import Block, unit_whitening
from fg_calib.measurements.table import MeasurementBlock
from fg_calib.robot import kernels
from fg_calib.robot.kernels import vector_variances, whiten_small
from fg_calib.robot.kinematics import (
    SPAN,
    Chain,
    Poses,
    common_axes,
    forward,
    over_spans,
    turning_of_base,
    turning_of_points,
)
from fg_calib.robot.rotations import nearest_rotation, rotation_angle

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

NoiseName = tuple[int, str]
"""A noise that is known up to a factor: its table and kind, or `JOINT_NOISE`."""

JOINT_NOISE: NoiseName = (-1, "joint")
"""That of the joint readings, which is one for all tables and kinds."""

LEAST_SLOPE = 1e-3
"""Slope of a mean, near a kink, that is taken for this at least: such a row says next to nothing."""

PRIVATE_SHARE = 1e-3
"""Share of a pair's variance that counts as its own at least: shared errors are not all there is."""

LEAST_BEND = 0.05
"""A row that what the parameters may be off bends by less than this many sigma is straight."""

BEND_MARGIN = 2.0
"""Factor on the variance that bends a row. The covariance of the parameters counts what bent rows seem to say of them
by a derivative that is there only at the estimate; with 1 the NEES of a SCARA's star is 1.05, with 2 about 1.02."""

MOST_BEND = 1.0
"""A fitted row is bent by no more sigma: what is off by more than that is for the optimum to find, and no noise."""

REDUNDANT = 100.0
"""Factor on what is not linear in pairs that are more than the errors they share: they have nothing else to say there,
and its distribution is not normal."""


@dataclass(frozen=True)
class NoiseState:
    """What has been learned of the measurements' noise on the way to a solution.

    Attributes:
        weights: Robust weight of each measurement of each series, in [0, 1]; None for 1.
        factors: What the stated sigmas are multiplied by, by table and kind those of the measurement itself (or of the
            measured poses that pairs were formed from), and those of the joint readings; 1 where none is given.
        joint_errors: True joint values less their readings, where encoder noise is estimated, shape
            (n_configurations, n_joints), [rad] (prismatic: [m]); None for 0.
        spread: A square root S of the parameters' covariance S S^T in the chain's columns, shape (n_columns, k), where
            what they may be off bends a row, or might bend a test row; None for 0.
    """

    weights: tuple[Floats, ...] | None = None
    factors: Mapping[NoiseName, float] = field(default_factory=dict)
    joint_errors: Floats | None = None
    spread: Floats | None = None


class Source(NamedTuple):
    """How rows follow from errors of 1 sigma that belong to configurations.

    Attributes:
        name: `joints`, or `poses` of a table.
        ends: Configuration of each end, among those of all tables, shape (n, ends).
        loading: The rows per error of each end, shape (n, residual_dim, ends, width).
    """

    name: str
    ends: Integers
    loading: Floats

    @property
    def variance(self) -> Floats:
        """What the source adds to the covariance of each measurement's rows, shape (n, residual_dim, residual_dim)."""
        n, residual_dim, ends, width = self.loading.shape
        flat = self.loading.reshape(n, residual_dim, ends * width)
        out: Floats = flat @ np.swapaxes(flat, 1, 2)
        return out

    def at(self, rows: Integers | slice) -> Source:
        """That of some of the rows."""
        return self._replace(ends=self.ends[rows], loading=self.loading[rows])


@dataclass(frozen=True)
class Place:
    """Where a series stands: its table, that table's configurations, and the arm there.

    Attributes:
        measurements: The table.
        configurations: Its configurations among those of all tables, shape (n_configurations,).
        trig: Its readings, or the joint values that are estimated in their place, for the kernels.
        chain: The chain from its measurement frame, at the parameters.
        coordinates: Values of all nuisance coordinates, at the parameters.
        joints_estimated: Whether true joint values are estimated, so that their errors bend no mean.
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
        place: Where it stands.
        state: What has been learned of the noise.

    Attributes:
        sources: What errors of configurations add to the noise that is each measurement's alone.
        factors: What the stated noise of each row's own kind is multiplied by, shape (residual_dim,).
        joint_factor: What that of the joint readings is multiplied by.
    """

    def __init__(self, series: MeasurementBlock, place: Place, state: NoiseState) -> None:
        self.series = series
        self.place = place
        families = [name.partition(".")[0] for name in series.kind.names]
        self.factors: Floats = np.array([state.factors.get((series.table, family), 1.0) for family in families])
        self.joint_factor = state.factors.get(JOINT_NOISE, 1.0)
        self._prepare(state)

    def _prepare(self, state: NoiseState) -> None:
        self.sources = self._of_joints(self.rows)

    @cached_property
    def rows(self) -> Block:
        """All rows, not whitened, in [m] and [rad]."""
        return self.rows_at(slice(None))

    def moments_at(self, rows: Integers | slice) -> Moments:
        """Of some measurements' rows what noise adds on average, the slope of their means, and variance of their own.

        Shapes (m, residual_dim), [m] and [rad]; the variance is of what is each measurement's alone.
        """
        variance: Floats = (self.series.sigma[rows] * self.factors) ** 2
        return Moments(np.zeros_like(variance), np.ones_like(variance), variance)

    def own_at(self, rows: Integers | slice, moments: Moments | None = None) -> Floats:
        """Covariance of what is each measurement's alone, of some, shape (m, residual_dim, residual_dim).

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
        """The same of all their noise together, shape (m, residual_dim, residual_dim)."""
        out: Floats = self.own_at(rows, moments) + sum(source.at(rows).variance for source in self.sources)
        return out

    @cached_property
    def total(self) -> Floats:
        """Covariance of each measurement's rows, all noise together, shape (n, residual_dim, residual_dim)."""
        return self.total_at(slice(None))

    @property
    def sigma(self) -> Floats:
        """1 sigma of each row, all noise together, shape (n, residual_dim), [m] and [rad]."""
        out = self._empty()

        def run(rows: slice) -> None:
            out[rows] = self._sigma_at(rows, self.moments_at(rows))

        _over_rows(run, len(out))
        return out

    def residual(self) -> Floats:
        """Of all rows, shape (n, residual_dim), [m] and [rad]."""
        out = self._empty()

        def run(rows: slice) -> None:
            out[rows] = self._residual_at(rows, self.moments_at(rows))

        _over_rows(run, len(out))
        return out

    def figures(self) -> tuple[Floats, Floats, Floats]:
        """Residual of each row, what noise adds to it on average, and its 1 sigma, shapes (n, residual_dim)."""
        residual, excess, sigma = self._empty(), self._empty(), self._empty()

        def run(rows: slice) -> None:
            moments = self.moments_at(rows)
            residual[rows], excess[rows] = self._residual_at(rows, moments), moments.excess
            sigma[rows] = self._sigma_at(rows, moments)

        _over_rows(run, self.series.n)
        return residual, excess, sigma

    def _residual_at(self, rows: slice, moments: Moments) -> Floats:
        return residuals.residual(self.rows_at(rows, moments), self.place.chain)

    def _sigma_at(self, rows: slice, moments: Moments) -> Floats:
        sigma: Floats = np.sqrt(np.einsum("nii->ni", self.total_at(rows, moments)))
        return sigma

    def _empty(self) -> Floats:
        """A figure of each row, to be filled."""
        return np.empty((self.series.n, self.series.kind.residual_dim))

    def lengths(self) -> tuple[Floats, Integers]:
        """Length of each measurement's residual whitened by all its noise, and its number of rows, shapes (n,).

        For measurements that take no part 0 and 0.
        """
        used = self.series.used
        r = np.where(used, self.residual(), 0.0)
        W = whitening_of(self.total, used)
        return np.linalg.norm(W @ r[:, :, None], axis=(1, 2)), used.sum(axis=1)

    @property
    def bends(self) -> bool:
        """Whether what the parameters may be off bends any row, or nearly so."""
        return False

    def more_if_redundant(self, shared: frozenset[str]) -> Floats | float:
        """What is added to the diagonal of `own` where there are more rows than errors that they share."""
        return 0.0

    def least(self) -> Floats | float:
        """What the diagonal of private noise is at least."""
        return 0.0

    def bare(self, rows: Integers) -> Floats:
        """Diagonal of what is private to measurements, but for what is there for numerical safety alone."""
        return self.moments_at(rows).variance

    def rows_at(self, rows: Integers | slice, moments: Moments | None = None) -> Block:
        """Some of the rows, not whitened.

        Args:
            rows: Which.
            moments: Their `moments_at`, where they are known.
        """
        return residuals.rows_of(self.as_measured, rows)

    @cached_property
    def as_measured(self) -> Block:
        """All rows as they were measured."""
        s, p = self.series, self.place
        unit = unit_whitening(s.n, s.kind.residual_dim)
        return Block(s.kind, p.trig, s.ends, s.data, unit, p.coordinates[s.nuisances], s.source)

    def _of_joints(self, rows: Block) -> tuple[Source, ...]:
        p, s = self.place, self.series
        if not len(p.joints) or not s.kind.ends:
            return ()
        chain = p.chain.without_columns().with_joint_columns()
        sigma = p.measurements.sigma_joint[p.joints] * self.joint_factor
        loading = np.empty((s.n, s.kind.residual_dim, s.kind.ends, len(sigma)))

        def load(some: slice) -> None:
            J = residuals.linearise(residuals.rows_of(rows, some), chain)[1][:, :, : s.kind.ends * p.chain.n_joints]
            loading[some] = J.reshape(*loading[some].shape[:3], p.chain.n_joints)[..., p.joints] * sigma

        _over_rows(load, s.n)
        return (Source("joints", p.configurations[s.ends], loading),)


class PairNoise(RowNoise):
    """The same of distances and angles of pairs, whose vectors noise lengthens (see `moments`).

    Attributes:
        predicted: Distance and angle as the arm predicts them, shape (n, 2).
    """

    def _prepare(self, state: NoiseState) -> None:
        s = self.series
        self._parts = [_COMPONENT[part.code] for part in s.kind.parts if part.code is not None]
        self._wanted = np.array([k in self._parts for k in (0, 1)])
        self._spread = state.spread
        wide = np.ones(2)
        wide[self._parts] = self.factors
        self._both = wide  # factors of distance and angle
        self.predicted = self._predict()
        self._formed = np.nan_to_num(self._formed_variance()) * wide**2 if s.formed else None
        joints = self._joint_sources = self._of_joints(self.as_measured)
        self._linear = self._wide(sum((of.variance for of in joints), np.zeros((s.n, 1, 1)))) if joints else None
        self._bent, self._traces = self._where_bent(), self._joint_trace()
        self.sources = ()
        self._kept: tuple[Moments, Floats] | None = None
        if s.n <= SPAN or s.formed or self._joint_sources:  # few, or asked for at once
            self._kept = self._all_moments()
            slope = self._kept[0].slope
            self.sources = tuple(
                source._replace(loading=source.loading * slope[:, :, None, None]) for source in self._joint_sources
            )
            if s.formed:
                self.sources += (self._of_poses(slope),)
            self._joint_sources, self._linear = (), None  # which nothing is worked out from any more

    def _predict(self) -> Floats:
        """Distance and angle as the arm predicts them, 0 where not wanted, shape (n, 2)."""
        s, predicted, plain, chain = self.series, np.zeros((self.series.n, 2)), self.as_measured, self.place.chain

        def predict(rows: slice) -> None:
            predicted[rows, self._parts] = residuals.residual(residuals.rows_of(plain, rows), chain) + s.data[rows]

        _over_rows(predict, s.n)
        return predicted

    def moments_at(self, rows: Integers | slice) -> Moments:
        """Of some rows; of very many they are worked out where they are asked for, or they would fill the memory."""
        if self._kept is None:
            return self._work_out(rows)[0]
        moments = self._kept[0]
        return Moments(moments.excess[rows], moments.slope[rows], moments.variance[rows])

    def _all_moments(self) -> tuple[Moments, Floats]:
        """`_work_out` of all rows."""
        excess, slope, variance, of_bending = (self._empty() for _ in range(4))

        def run(rows: slice) -> None:
            found, of_bending[rows] = self._work_out(rows)
            excess[rows], slope[rows], variance[rows] = found.excess, found.slope, found.variance

        _over_rows(run, self.series.n)
        return Moments(excess, slope, variance), of_bending

    def _work_out(self, rows: Integers | slice) -> tuple[Moments, Floats]:
        """`moments_at`, and of pairs formed from poses the variance that is not linear in their errors (else 0)."""
        moments = self._moments(rows)
        excess, slope, left = moments.excess, moments.slope, moments.variance
        of_bending = np.zeros(left.shape if self.series.formed else (1, left.shape[1]))
        if not self.place.joints_estimated:
            left -= slope**2 * self._diagonals(self._joint_sources, rows)
        if self.series.formed:
            of_measured = slope**2 * self._own(rows)[:, self._parts]
            of_bending = np.maximum(left - of_measured, 0.0)
            left -= of_measured + 0.5 * of_bending
        return Moments(excess, slope, left), of_bending

    @property
    def _bent_variance(self) -> Floats:
        """Variance of pairs formed from poses that is not linear in their errors, shape (n, residual_dim)."""
        assert self._kept is not None
        return self._kept[1]

    def rows_at(self, rows: Integers | slice, moments: Moments | None = None) -> Block:
        """Some of the rows, not whitened, but scaled and shifted as their means are."""
        moments, plain = moments or self.moments_at(rows), residuals.rows_of(self.as_measured, rows)
        whitening = np.zeros(plain.whitening.shape)
        diagonal = np.cumsum(np.arange(1, 1 + self.series.kind.residual_dim)) - 1
        slope = np.maximum(moments.slope, LEAST_SLOPE)
        off = self._narrow(self.predicted[rows]) - plain.data
        whitening[:, diagonal] = slope
        return replace(plain, data=plain.data + off * (1.0 - 1.0 / slope) - moments.excess / slope, whitening=whitening)

    def _residual_at(self, rows: slice, moments: Moments) -> Floats:
        out: Floats = self._narrow(self.predicted[rows]) - self.series.data[rows] + moments.excess
        return out

    def more_if_redundant(self, shared: frozenset[str]) -> Floats | float:
        """What is added to the diagonal of `own` where there are more rows than errors that they share."""
        s = self.series
        sources = [source for source in self.sources if source.name in shared]
        if not s.formed or not any(source.name != "joints" for source in sources):
            return 0.0
        n_errors = len(np.unique(s.ends[s.train])) * sum(source.loading.shape[3] for source in sources)
        n_rows = len(s.train) * s.kind.residual_dim
        return 0.5 * (REDUNDANT - 1.0) * self._bent_variance if n_rows > n_errors else 0.0

    def least(self) -> Floats | float:
        """What the diagonal of private noise is at least."""
        out: Floats = PRIVATE_SHARE * np.einsum("nii->ni", self.total)
        return out

    def bare(self, rows: Integers) -> Floats:
        """Diagonal of what is private to measurements, but for what is there for numerical safety alone."""
        if not self.series.formed:
            return super().bare(rows)
        out: Floats = 0.5 * self._bent_variance[rows]
        return out

    def bent_by(self, spread: Floats, sigmas: float) -> Booleans:
        """Which rows some uncertainty of the parameters bends by so many sigma, shape (n, residual_dim).

        Args:
            spread: A square root of the parameters' covariance, shape (n_columns, k).
            sigmas: By how many sigma at least.
        """
        bent = np.zeros((self.series.n, 2), dtype=np.bool_)
        rows, across = self._noticed(spread, sigmas)
        bent[rows] = across > 0.0
        out: Booleans = bent[:, self._parts]
        return out

    def may_fold(self, spread: Floats) -> Booleans:
        """Which rows some uncertainty of the parameters may fold, shape (n, residual_dim).

        Half the way to 0, or of an angle to half a turn, is then less than that uncertainty (and this more than the
        noise): the vector may as well point the other way, and a descent may end with the wrong one.

        Args:
            spread: A square root of the parameters' covariance, shape (n_columns, k).
        """
        f, train = self.predicted, np.flatnonzero(~self.series.test)
        folds, is_near = np.zeros(f.shape, dtype=np.bool_), np.zeros(len(f), dtype=np.bool_)
        if not len(train):
            return folds[:, self._parts]
        spread_of = self._spread_by(spread)
        largest = 4.0 * np.sum(spread_of(_evenly(train)), axis=0).max(axis=0)

        def look(rows: slice) -> None:
            from_kink = np.stack([f[rows, 0], np.minimum(f[rows, 1], np.pi - f[rows, 1])], axis=1)
            is_near[rows] = np.any((from_kink**2 / 4.0 < largest) & self._wanted, axis=1)

        _over_rows(look, len(f))
        near = np.flatnonzero(is_near)
        for start in range(0, len(near), SPAN):
            rows = near[start : start + SPAN]
            across, along = spread_of(rows)
            noise = 4.0 * self._own(rows)
            folds[rows] = across + along > np.maximum(f[rows] ** 2 / 4.0, noise)
            folds[rows, 1] |= along[:, 1] > np.maximum((np.pi - f[rows, 1]) ** 2 / 4.0, noise[:, 1])
        return folds[:, self._parts]

    def derivatives_along(self, chosen: tuple[Integers, Integers], spread: Floats) -> Floats:
        """Derivatives of the predicted figures of some rows along the parameters' spread, shape (m, k).

        Args:
            chosen: Row, and place in it, of each figure, shape (m,).
            spread: A square root of the parameters' covariance, shape (n_columns, k).
        """
        rows, part = chosen
        J = residuals.linearise(residuals.rows_of(self.as_measured, rows), self.place.chain)[1]
        out: Floats = J[np.arange(len(rows)), part] @ spread
        return out

    def ways_around(self, chosen: tuple[Integers, Integers], spread: Floats) -> Floats:
        """The least steps along the spread that turn the vectors of some rows around, shape (m, k), [sigma].

        Of an angle beyond a quarter turn that is the vector's other way about half a turn, else about 0.

        Args:
            chosen: Row, and place in it, of each figure, shape (m,).
            spread: A square root of the parameters' covariance, shape (n_columns, k).
        """
        along, f = self.derivatives_along(chosen, spread), self._narrow(self.predicted)[chosen]
        way = 2.0 * np.where(self.about_half_a_turn()[chosen], np.pi - f, -f)
        out: Floats = way[:, None] * along / np.maximum(np.sum(along**2, axis=1, keepdims=True), 1e-300)
        return out

    def about_half_a_turn(self) -> Booleans:
        """Which rows are angles nearer to half a turn than to 0, shape (n, residual_dim)."""
        near = np.stack([np.zeros(self.series.n, dtype=np.bool_), self.predicted[:, 1] > 0.5 * np.pi], axis=1)
        out: Booleans = near[:, self._parts]
        return out

    @cached_property
    def _poses(self) -> Poses:
        """Predicted tool poses of the table's configurations."""
        return forward(self.place.chain.without_columns(), self.place.trig)

    def _narrow(self, both: Floats) -> Floats:
        """Of (distance, angle) those that the kind has."""
        return np.ascontiguousarray(both[:, self._parts])

    def _wide(self, covariance: Floats) -> Floats:
        """Variances of (distance, angle) of covariances of those that the kind has, shape (n, 2)."""
        out = np.zeros((self.series.n, 2))
        out[:, self._parts] = np.einsum("nii->ni", covariance)
        return out

    def _diagonals(self, sources: tuple[Source, ...], rows: Integers | slice) -> Floats:
        """What sources add to the variance of some rows, shape (n, residual_dim)."""
        zero = np.zeros(self.series.data[rows].shape)
        return sum((np.einsum("nii->ni", source.at(rows).variance) for source in sources), zero)

    def _own(self, rows: Integers | slice) -> Floats:
        """Variance of some distances and angles as measured, 0 where not wanted, shape (m, 2)."""
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
            along = along + (0.0 if self._linear is None else self._linear[rows])
            trace = trace + self._traces[ends].sum(axis=1)
        across = np.maximum(trace - along, 0.0) / 2.0 + self._bending(rows)
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

        As predicted: those of measured poses would depend on the very errors that they are to tell the effect of.
        """
        p, R, (a, b) = self._poses.position, self._poses.rotation, self.series.ends.T
        along = _unit(p[b] - p[a]) @ self._base_in_world().T
        return along, _unit(rotation_angle(np.swapaxes(R[a], 1, 2) @ R[b])[1])

    def _base_in_world(self) -> Floats:
        """The rotation that brings the predicted points nearest to the measured ones, shape (3, 3)."""
        m = self.place.measurements
        if m.position is None or m.test.all():
            return np.eye(3)
        measured, p = m.position[~m.test], self._poses.position[~m.test]
        return nearest_rotation((measured - measured.mean(axis=0)).T @ (p - p.mean(axis=0)))

    def _of_poses(self, slopes: Floats) -> Source:
        """How the rows follow from the errors of the measured poses that the pairs were formed from.

        Of each kind a pose has three errors, along the axes, and a fourth, the square of its errors across: the latter
        lengthen all pairs of the pose. Of what the squares at both ends add to the variance of a pair half is theirs,
        a quarter at either end, and half that of their product, the pair's own.

        Args:
            slopes: Of the mean of each row, shape (n, residual_dim).
        """
        m, s, n_parts = self.place.measurements, self.series, len(self._parts)
        G = np.zeros((s.n, n_parts, 2, n_parts, 4))  # row, quantity, end, its source, (axes, square)
        sign = np.array([1.0, -1.0])[:, None]  # of predicted minus measured in the error at a, at b
        bent = np.sqrt(self._bent_variance)
        for i, k in enumerate(self._parts):
            sigma = (m.sigma_position, m.sigma_orientation)[k]
            slope = slopes[:, i, None, None]
            if sigma is not None:
                G[:, i, :, i, :3] = self._both[k] * slope * sign * self._directions[k][:, None] * sigma[s.ends]
            G[:, i, :, i, 3] = -0.5 * bent[:, i, None]
        loading = G.reshape(s.n, n_parts, 2, 4 * n_parts)
        return Source(f"poses of table {s.table}", self.place.configurations[s.ends], loading)

    def _bending(self, rows: Integers | slice) -> Floats | float:
        """Variance in each direction across that the parameters' own gives some vectors, shape (m, 2).

        Along the vector it is what is estimated; across it lengthens the vector as noise does, and bends the row. Zero
        where it does not matter.
        """
        bent, across = self._bent
        if not len(bent):
            return 0.0
        index = np.arange(*rows.indices(self.series.n)) if isinstance(rows, slice) else rows
        place = np.minimum(np.searchsorted(bent, index), len(bent) - 1)
        return np.where((bent[place] == index)[:, None], across[place], 0.0)

    @property
    def bends(self) -> bool:
        """Whether what the parameters may be off bends any row, or nearly so."""
        return len(self._bent[0]) > 0

    def _where_bent(self) -> tuple[Integers, Floats]:
        """The rows that what the parameters may be off bends, in ascending order, and `_bending` there."""
        if self._spread is None:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        rows, across = self._noticed(self._spread, LEAST_BEND)
        fitted = ~self.series.test[rows]
        across[fitted] = np.minimum(across[fitted], MOST_BEND * self._straight(rows[fitted]))
        return rows, across

    def _noticed(self, spread: Floats, sigmas: float) -> tuple[Integers, Floats]:
        """Rows that may be bent by so many sigma, in ascending order; variance across where it does so, else 0.

        Where four times the largest of some pairs would not, it is not even worked out: some evenly chosen, and those
        that little bends, which may be the only ones to see some parameters.
        """
        train = np.flatnonzero(~self.series.test)
        if not len(train):
            return train, np.zeros((0, 2))
        spread_of, some = self._spread_by(spread), train
        if len(train) > _SOME:
            some = np.union1d(_evenly(train), self._easily_bent(train))
        of_some = BEND_MARGIN * spread_of(some)[0]
        most, found, variances = 4.0 * of_some.max(axis=0), [train[:0]], [np.zeros((0, 2))]
        for start in range(0, self.series.n, SPAN):
            least = sigmas * self._straight(slice(start, start + SPAN))
            rows = start + (near := np.flatnonzero(np.any(most >= least, axis=1)))
            if not len(rows):
                continue
            place = np.minimum(np.searchsorted(some, rows), len(some) - 1)
            across, new = of_some[place], some[place] != rows
            if new.any():
                across[new] = BEND_MARGIN * spread_of(rows[new])[0]
            found.append(rows)
            variances.append(np.where(across >= least[near], across, 0.0))
        return np.concatenate(found), np.concatenate(variances)

    def _easily_bent(self, train: Integers) -> Integers:
        """Some of the train rows: those that the least variance across bends."""
        least = np.empty(self.series.n)
        for start in range(0, len(least), SPAN):
            rows = slice(start, start + SPAN)
            least[rows] = self._straight(rows).min(axis=1)
        return train[np.argpartition(least[train], _SOME)[:_SOME]]

    def _straight(self, rows: Integers | slice) -> Floats:
        """Variance across that bends a row by one sigma, shape (n, 2); infinite where there is none to bend.

        Nearer to 0 than one sigma it is that of the noise itself.
        """
        own, predicted = self._own(rows), self.predicted[rows]
        sigma = np.sqrt(own)
        return np.where((own > 0.0) & self._wanted, sigma * np.maximum(predicted, sigma), np.inf)

    def _spread_by(self, spread: Floats) -> Callable[[Integers], tuple[Floats, Floats]]:
        """Variance that the parameters' own gives vectors: in each direction across, and along, shapes (m, 2), of rows.

        With Q the rotation from a to b, R_b R_a^T, turns w_a and w_b of the tool turn Q by w_b - Q w_a: in b itself by
        R_b^T w_b - R_a^T w_a. Motions of the base, and of the tool in itself, carry vector and rotation with them and
        bend nothing: they are taken out. About an axis that all rotations have in common orientations cannot tell the
        two apart: there points do.

        Args:
            spread: A square root of the parameters' covariance, shape (n_columns, k).
        """
        some = _evenly(np.flatnonzero(~self.series.test))
        of_some = at, which = self._moved(some, spread)
        everywhere = which.ravel()
        R, p, (turn, shift) = at.rotation[everywhere], at.position[everywhere], np.split(at.jacobian[everywhere], 2, 1)
        carried = base = turning_of_base(turn, R)  # (3, k)
        axes = common_axes(R)
        if axes.any():
            carried = base + axes @ (turning_of_points(p, shift) - base)

        def spread_of(rows: Integers) -> tuple[Floats, Floats]:
            at, which = of_some if np.array_equal(rows, some) else self._moved(rows, spread)
            across, along = np.empty((len(which), 2)), np.empty((len(which), 2))
            vector_variances((at.rotation, at.position, at.jacobian), which, base, carried, across, along)
            return across, along

        return spread_of

    def _moved(self, rows: Integers, spread: Floats) -> tuple[Poses, Integers]:
        """Where some rows have their ends: poses, with what they move along `spread`; which of them, shape (m, 2)."""
        where, which = np.unique(self.series.ends[rows], return_inverse=True)
        at = forward(self.place.chain, self.place.trig, where)
        n, n_twists = at.jacobian.shape[:2]
        moved = at.jacobian.reshape(n * n_twists, -1) @ spread  # all at once
        return replace(at, jacobian=moved.reshape(n, n_twists, -1)), which.reshape(-1, 2)

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
"""Where the moments of a pair's distance and angle stand, by the code of its kind."""

_MOMENTS = (length_moments, angle_moments)


def row_noise(series: MeasurementBlock, place: Place, state: NoiseState) -> RowNoise:
    """The rows of a series and their noise."""
    return (PairNoise if _is_lengthened(series) else RowNoise)(series, place, state)


def same_everywhere(series: MeasurementBlock, sigma_joint: Floats) -> bool:
    """Whether the noise is the same at all parameters: what lengthens vectors, or comes from joint readings, is not."""
    return not _is_lengthened(series) and not (series.kind.ends and np.any(sigma_joint > 0.0))


def _is_lengthened(series: MeasurementBlock) -> bool:
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
    C, mine = (np.require(given, requirements=["C", "W"]) for given in (covariance, used))  # as the kernel takes them
    if not all(over_spans(lambda start, stop: whiten_small(C, mine, start, stop, W), len(used))):
        found = "lost in rounding beside what errors of the joint readings do"
        hint = "is noise.joint or a length of the arm or of a table far too large, or other noise far too small?"
        raise InputError("noise", found, "figures nearer to each other", hint)
    return W


def _over_rows(run: Callable[[slice], None], n: int) -> None:
    """Work out something of n rows in spans, so that what it takes on the way stays in the processor's cache."""
    for _ in over_spans(lambda start, stop: run(slice(start, stop)), n):
        pass


_SOME = 500
"""Rows that stand for many."""


def _evenly(rows: Integers) -> Integers:
    """Some of many rows, evenly chosen; all of few."""
    return rows if len(rows) <= _SOME else rows[np.linspace(0, len(rows) - 1, _SOME).astype(np.int64)]


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
