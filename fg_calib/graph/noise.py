"""The noise of rows at some parameters: what is a measurement's own, and what follows from errors that others share.

Three sources of noise reach a row: that of the measurement itself; that of the measured poses where a pair was formed
from poses; and that of the joint readings, through the row's derivatives in the joints. The last two belong to a
configuration and are the same in every measurement that it takes part in.

What noise does to a length or an angle is not linear: rows of pairs are `M - measured`, M the mean of what would be
measured, with its slope and variance (see `moments`). At given parameters that is an ordinary row, scaled and shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, rotation_angle
from fg_calib.measurements.frames import nearest_rotation
from fg_calib.measurements.kinds import Distance, RotationAngle
from fg_calib.measurements.moments import Moments, angle_moments, length_moments
from fg_calib.measurements.residuals import Block, unit_whitening
from fg_calib.measurements.series import Series
from fg_calib.robot.kernels import whiten_small
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
"""A row is bent by no more sigma: what is off by more than that is for the optimum to find, not to be called noise."""

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
            what they may be off bends a row; None for 0.
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
        n, residual_dim = self.loading.shape[:2]
        flat = self.loading.reshape(n, residual_dim, -1)
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
        variance: Of what is each measurement's alone, row by row, shape (n, residual_dim), [m^2] and [rad^2].
        sources: What errors of configurations add to it.
        excess: What noise adds to the measured values on average, shape (n, residual_dim), [m] and [rad].
        factors: What the stated noise of each row's own kind is multiplied by, shape (residual_dim,).
        joint_factor: What that of the joint readings is multiplied by.
    """

    def __init__(self, series: Series, place: Place, state: NoiseState) -> None:
        self.series = series
        self.place = place
        families = [name.partition(".")[0] for name in series.kind.names]
        self.factors: Floats = np.array([state.factors.get((series.table, family), 1.0) for family in families])
        self.joint_factor = state.factors.get(JOINT_NOISE, 1.0)
        self.excess: Floats = np.zeros((series.n, series.kind.residual_dim))
        self._prepare(state)

    def _prepare(self, state: NoiseState) -> None:
        self.variance: Floats = (self.series.sigma * self.factors) ** 2
        self.sources = self._of_joints(self.rows)

    @cached_property
    def rows(self) -> Block:
        """All rows, not whitened, in [m] and [rad]."""
        return self.rows_at(slice(None))

    def own_at(self, rows: Integers | slice) -> Floats:
        """Covariance of what is each measurement's alone, of some, shape (m, residual_dim, residual_dim)."""
        if self.series.covariance is not None:
            covariance: Floats = self.series.covariance[rows] * np.outer(self.factors, self.factors)
            return covariance
        variance = self.variance[rows]
        out: Floats = variance[:, :, None] * np.eye(variance.shape[1])
        return out

    def total_at(self, rows: Integers | slice) -> Floats:
        """Covariance of some measurements' rows, all noise together, shape (m, residual_dim, residual_dim)."""
        out: Floats = self.own_at(rows) + sum(source.at(rows).variance for source in self.sources)
        return out

    @cached_property
    def total(self) -> Floats:
        """Covariance of each measurement's rows, all noise together, shape (n, residual_dim, residual_dim)."""
        return self.total_at(slice(None))

    @property
    def sigma(self) -> Floats:
        """1 sigma of each row, all noise together, shape (n, residual_dim), [m] and [rad]."""
        out = np.empty(self.variance.shape)

        def run(rows: slice) -> None:
            out[rows] = np.sqrt(np.einsum("nii->ni", self.total_at(rows)))

        _over_rows(run, len(out))
        return out

    def residual(self) -> Floats:
        """Of all rows, shape (n, residual_dim), [m] and [rad]."""
        return residuals.residual(self.rows, self.place.chain)

    def lengths(self) -> tuple[Floats, Integers]:
        """Length of each measurement's residual whitened by all its noise, and its number of rows, shapes (n,).

        For measurements that take no part 0 and 0.
        """
        used = self.series.used
        r = np.where(used, self.residual(), 0.0)
        W = whitening_of(self.total, used)
        return np.linalg.norm(W @ r[:, :, None], axis=(1, 2)), used.sum(axis=1)

    def more_if_redundant(self, shared: frozenset[str]) -> Floats | float:
        """What is added to the diagonal of `own` where there are more rows than errors that they share."""
        return 0.0

    def least(self) -> Floats | float:
        """What the diagonal of private noise is at least."""
        return 0.0

    def bare(self, rows: Integers) -> Floats:
        """Diagonal of what is private to measurements, but for what is there for numerical safety alone."""
        out: Floats = self.variance[rows]
        return out

    def rows_at(self, rows: Integers | slice) -> Block:
        """Some of the rows, not whitened."""
        return residuals.rows_of(self._plain, rows)

    @property
    def _plain(self) -> Block:
        """All rows as they were measured."""
        s, p = self.series, self.place
        unit = unit_whitening(s.n, s.kind.residual_dim)
        return Block(s.kind, p.trig, s.ends, s.data, unit, p.coordinates[s.nuisances], s.source)

    def _of_joints(self, rows: Block) -> tuple[Source, ...]:
        p, s = self.place, self.series
        if not len(p.joints) or not s.kind.ends:
            return ()
        chain = p.chain.without_columns().with_joint_columns()
        J = residuals.linearise(rows, chain)[1][:, :, : s.kind.ends * p.chain.n_joints]
        J = J.reshape(s.n, s.kind.residual_dim, s.kind.ends, p.chain.n_joints)[..., p.joints]
        loading = J * p.measurements.sigma_joint[p.joints] * self.joint_factor
        return (Source("joints", p.configurations[s.ends], np.ascontiguousarray(loading)),)


class PairNoise(RowNoise):
    """The same of distances and angles of pairs, whose vectors noise lengthens (see `moments`).

    Attributes:
        predicted: Distance and angle as the arm predicts them, shape (n, 2).
        slope: Derivative of each row's mean in what is predicted, shape (n, residual_dim).
    """

    def _prepare(self, state: NoiseState) -> None:
        s = self.series
        self._parts = [_QUANTITY[type(part)] for part in getattr(s.kind, "parts", (s.kind,))]
        self._wanted = np.isin([0, 1], self._parts)
        self._spread = state.spread
        wide = np.ones(2)
        wide[self._parts] = self.factors
        self._both = wide  # factors of distance and angle
        self.predicted = self._predict()
        self._formed = np.nan_to_num(self._formed_variance()) * wide**2 if s.formed else None
        joints = self._of_joints(self._plain)
        linear = self._wide(sum((source.variance for source in joints), np.zeros((s.n, 1, 1)))) if joints else None
        bending, of_joints = self._bending(), self._joint_trace()
        self.slope, self.variance = np.empty(s.data.shape), np.empty(s.data.shape)
        self._bent_variance = np.zeros(s.data.shape if s.formed else (0, s.kind.residual_dim))

        def bend(rows: slice) -> None:
            moments = self._moments(rows, linear, bending, of_joints)
            slope, left = moments.slope[:, self._parts], moments.variance[:, self._parts].copy()
            self.slope[rows], self.excess[rows] = slope, moments.excess[:, self._parts]
            if not self.place.joints_estimated:
                left -= slope**2 * self._diagonals(joints, rows)
            if s.formed:
                of_measured = slope**2 * self._own(rows)[:, self._parts]
                self._bent_variance[rows] = np.maximum(left - of_measured, 0.0)
                left -= of_measured + 0.5 * self._bent_variance[rows]
            self.variance[rows] = left

        _over_rows(bend, s.n)
        slope = self.slope[:, :, None, None]
        self.sources = tuple(source._replace(loading=source.loading * slope) for source in joints)
        if s.formed:
            self.sources += (self._of_poses(self.slope),)

    def _predict(self) -> Floats:
        """Distance and angle as the arm predicts them, 0 where not wanted, shape (n, 2)."""
        s, predicted = self.series, np.zeros((self.series.n, 2))
        r = residuals.residual(self._plain, self.place.chain)

        def predict(rows: slice) -> None:
            predicted[rows, self._parts] = r[rows] + s.data[rows]

        _over_rows(predict, s.n)
        return predicted

    def rows_at(self, rows: Integers | slice) -> Block:
        """Some of the rows, not whitened, but scaled and shifted as their means are."""
        plain = residuals.rows_of(self._plain, rows)
        predicted, excess, slopes = self.predicted[rows], self.excess[rows], self.slope[rows]
        data, whitening = np.empty_like(plain.data), np.zeros(plain.whitening.shape)
        diagonal = np.cumsum(np.arange(1, 1 + self.series.kind.residual_dim)) - 1

        def shift(some: slice) -> None:
            slope, measured = np.maximum(slopes[some], LEAST_SLOPE), plain.data[some]
            off = predicted[some][:, self._parts] - measured
            data[some] = measured + off * (1.0 - 1.0 / slope) - excess[some] / slope
            whitening[some, diagonal] = slope

        _over_rows(shift, plain.n)
        return replace(plain, data=data, whitening=whitening)

    def residual(self) -> Floats:
        """Of all rows, shape (n, residual_dim), [m] and [rad]."""
        return self._narrow(self.predicted) - self.series.data + self.excess

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
        bent: Booleans = self._noticed(spread, sigmas)[:, self._parts] > 0.0
        return bent

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
        largest = 4.0 * np.sum(self._spread_of(_evenly(train), spread), axis=0).max(axis=0)

        def look(rows: slice) -> None:
            from_kink = np.stack([f[rows, 0], np.minimum(f[rows, 1], np.pi - f[rows, 1])], axis=1)
            is_near[rows] = np.any((from_kink**2 / 4.0 < largest) & self._wanted, axis=1)

        _over_rows(look, len(f))
        near = np.flatnonzero(is_near)
        for start in range(0, len(near), SPAN):
            rows = near[start : start + SPAN]
            across, along = self._spread_of(rows, spread)
            noise = 4.0 * self._own(rows)
            folds[rows] = across + along > np.maximum(f[rows] ** 2 / 4.0, noise)
            folds[rows, 1] |= along[:, 1] > np.maximum((np.pi - f[rows, 1]) ** 2 / 4.0, noise[:, 1])
        return folds[:, self._parts]

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

    def _diagonals(self, sources: tuple[Source, ...], rows: slice) -> Floats:
        """What sources add to the variance of some rows, shape (n, residual_dim)."""
        zero = np.zeros(self.series.data[rows].shape)
        return sum((np.einsum("nii->ni", source.at(rows).variance) for source in sources), zero)

    def _own(self, rows: Integers | slice) -> Floats:
        """Variance of some distances and angles as measured, 0 where not wanted, shape (m, 2)."""
        if self._formed is not None:
            return self._formed[rows]
        sigma = np.nan_to_num(self.series.sigma[rows])
        own = np.zeros((len(sigma), 2))
        own[:, self._parts] = sigma**2 * self.factors**2
        return own

    def _moments(self, rows: slice, linear: Floats | None, bending: Floats | None, of_joints: Floats) -> Moments:
        """Mean and variance of each distance and angle, shapes (n, 2); of no meaning where not wanted.

        Args:
            rows: The pairs.
            linear: Variance of each distance and angle by joint noise, to first order, shape (n, 2); None for 0.
            bending: From `_bending`, shape (n, 2); None for 0.
            of_joints: From `_joint_trace`.
        """
        s, m, factors = self.series, self.place.measurements, self._both**2
        ends, own = s.ends[rows], self._own(rows)
        along, trace = np.zeros_like(own), np.zeros_like(own)
        if s.formed:
            along, own = own, np.zeros_like(own)
            trace = np.stack([_trace(m.sigma_position, ends), _trace(m.sigma_orientation, ends)], axis=1) * factors
        if len(of_joints):
            along = along + (0.0 if linear is None else linear[rows])
            trace = trace + of_joints[ends].sum(axis=1)
        across = np.maximum(trace - along, 0.0) / 2.0 + (0.0 if bending is None else bending[rows])
        along, across, own = (np.where(self._wanted, v, 0.0) for v in (along, across, own))
        found = [
            of(self.predicted[rows, k], along[:, k], across[:, k], own[:, k])
            for k, of in enumerate((length_moments, angle_moments))
        ]
        return Moments(*(np.stack(pair, axis=1) for pair in zip(*map(astuple, found), strict=True)))

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
        return Source(f"poses of table {s.table}", self.place.configurations[s.ends], G.reshape(s.n, n_parts, 2, -1))

    def _bending(self) -> Floats | None:
        """Variance in each direction across that the parameters' own gives each vector, shape (n, 2); None for 0.

        Along the vector it is what is estimated; across it lengthens the vector as noise does, and bends the row. Zero
        where it does not matter.
        """
        if self._spread is None:
            return None
        return np.minimum(self._noticed(self._spread, LEAST_BEND), MOST_BEND * self._straight(slice(None)))

    def _noticed(self, spread: Floats, sigmas: float) -> Floats:
        """Variance across where it bends a row by so many sigma, else 0, shape (n, 2).

        Where four times the largest of some pairs, evenly chosen, would not, it is not even worked out.
        """
        across, train = np.zeros((self.series.n, 2)), np.flatnonzero(~self.series.test)
        if not len(train):
            return across
        most = 4.0 * self._spread_across(_evenly(train), spread).max(axis=0)
        for start in range(0, self.series.n, SPAN):
            rows = slice(start, start + SPAN)
            least = sigmas * self._straight(rows)
            near = np.flatnonzero(np.any(most >= least, axis=1))
            if len(near):
                found = self._spread_across(start + near, spread)
                across[start + near] = np.where(found >= least[near], found, 0.0)
        return across

    def _straight(self, rows: slice) -> Floats:
        """Variance across that bends a row by one sigma, shape (n, 2); infinite where there is none to bend.

        Nearer to 0 than one sigma it is that of the noise itself.
        """
        own, predicted = self._own(rows), self.predicted[rows]
        sigma = np.sqrt(own)
        return np.where((own > 0.0) & self._wanted, sigma * np.maximum(predicted, sigma), np.inf)

    def _spread_across(self, rows: Integers, spread: Floats) -> Floats:
        """What `_bending` is about at `rows`, shape (n, 2)."""
        return BEND_MARGIN * self._spread_of(rows, spread)[0]

    def _spread_of(self, rows: Integers, spread: Floats) -> tuple[Floats, Floats]:
        """Variance that the parameters' own gives vectors: in each direction across, and along, shapes (n, 2).

        With Q the rotation from a to b, R_b R_a^T, turns w_a and w_b of the tool turn Q by w_b - Q w_a. Motions of the
        base, and of the tool in itself, carry vector and rotation with them and bend nothing: they are taken out. About
        an axis that all rotations have in common orientations cannot tell the two apart: there points do.
        """
        n, ends = len(rows), self.series.ends[rows]
        at = forward(self.place.chain, self.place.trig, np.concatenate([ends[:, 0], ends[:, 1]]))
        base = turning_of_base(at.jacobian[:, :3], at.rotation) @ spread  # (3, k)
        of_points = turning_of_points(at.position, at.jacobian[:, 3:]) @ spread
        carried = base + common_axes(at.rotation) @ (of_points - base)
        turn, shift = np.split(at.jacobian @ spread, 2, axis=1)  # (2 n, 3, k) each
        Q = at.rotation[n:] @ np.swapaxes(at.rotation[:n], 1, 2)
        vector, turn = at.position[n:] - at.position[:n], turn - base
        change = (shift[n:] - shift[:n] - np.cross(carried[None], vector[:, :, None], axis=1), turn[n:] - Q @ turn[:n])
        directions = (vector, rotation_angle(Q)[1])
        along = np.stack(
            [
                np.sum(np.einsum("nc,nck->nk", _unit(u), D) ** 2, axis=1)
                for u, D in zip(directions, change, strict=True)
            ],
            axis=1,
        )
        everything = np.stack([np.sum(D**2, axis=(1, 2)) for D in change], axis=1)
        return np.maximum(everything - along, 0.0) / 2.0, along

    def _joint_trace(self) -> Floats:
        """Variance that joint noise gives each vector at one end, all directions together, shape (n_configurations, 2).

        No rows where there is none, or where true joint values are estimated.
        """
        if self.place.joints_estimated or not len(self.place.joints):
            return np.zeros((0, 2))
        J = forward(self.place.chain.without_columns().with_joint_columns(), self.place.trig).jacobian
        J = J * self.place.measurements.sigma_joint * self.joint_factor
        return np.stack([np.sum(J[:, 3:] ** 2, axis=(1, 2)), np.sum(J[:, :3] ** 2, axis=(1, 2))], axis=1)


_QUANTITY: dict[type, int] = {Distance: 0, RotationAngle: 1}


def row_noise(series: Series, place: Place, state: NoiseState) -> RowNoise:
    """The rows of a series and their noise."""
    return (PairNoise if _is_lengthened(series) else RowNoise)(series, place, state)


def same_everywhere(series: Series, sigma_joint: Floats) -> bool:
    """Whether the noise is the same at all parameters: what lengthens vectors, or comes from joint readings, is not."""
    return not _is_lengthened(series) and not (series.kind.ends and np.any(sigma_joint > 0.0))


def _is_lengthened(series: Series) -> bool:
    """Whether all its rows are distances and angles of pairs."""
    return all(type(part) in _QUANTITY for part in getattr(series.kind, "parts", (series.kind,)))


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
        hint = "is a length of the arm or of a table far too large, or that noise far too small?"
        raise InputError("noise", found, "figures nearer to each other", hint)
    return W


def _over_rows(run: Callable[[slice], None], n: int) -> None:
    """Work out something of n rows in spans, so that what it takes on the way stays in the processor's cache."""
    for _ in over_spans(lambda start, stop: run(slice(start, stop)), n):
        pass


def _evenly(rows: Integers) -> Integers:
    """Some of many rows, evenly chosen."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 500).astype(np.int64))]


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
