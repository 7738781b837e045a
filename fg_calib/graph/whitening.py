"""How the rows of measurements are judged and whitened: which take part, with what noise, and which errors they share.

Three sources of noise reach a row: that of the measurement itself; that of the two measured poses where a pair was
formed from poses; and that of the joint readings, through the row's derivatives in the joints. The last two belong to
a configuration and are the same in every pair that it takes part in. *Private* noise is a measurement's own. Shared
noise is either counted as private too (`independent`) or carried as errors that the rows have in common (see
`residuals.CorrelatedBlock`).

What noise does to a length or an angle is not linear: rows of pairs are `M - measured`, M the mean of what would be
measured, with its slope and variance (see `moments`). At given parameters that is an ordinary row, scaled and shifted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.graph.frames import nearest_rotation
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, Pairs, rotation_angle
from fg_calib.measurements.moments import Moments, angle_moments, length_moments
from fg_calib.measurements.residuals import (
    AnyBlock,
    Block,
    CorrelatedBlock,
    PairBlock,
    PoseBlock,
    SamePointBlock,
    correlate,
)
from fg_calib.robot.kinematics import SPAN, Chain, Poses, forward, turning_of_base

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

LEAST_SLOPE = 1e-3
"""Slope of a mean, near a kink, that is taken for this at least: such a row says next to nothing."""

MAX_SHARED = 3000
"""Rows, or errors that they share if these are fewer, beyond which the exact treatment takes too much time."""

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

LEAST_WEIGHT = 1e-12
"""A robust weight below this is taken for this."""


@dataclass(frozen=True)
class Sharing:
    """Which errors pairs are taken to share through their configurations.

    Attributes:
        poses: Those of the measured poses that the pairs were formed from.
        joints: Those of the joint readings.
    """

    poses: bool = False
    joints: bool = False


@dataclass(frozen=True)
class Adjustment:
    """What has been learned of the measurements' noise on the way to a solution.

    Attributes:
        weights: Robust weight of each measurement (pair or configuration), in [0, 1]; None for 1.
        factors: What the stated sigmas are multiplied by: of distances and angles, or of orientations and positions.
        joint_errors: True joint values less their readings, where encoder noise is estimated, shape
            (n_configurations, n_joints), [rad] (prismatic: [m]); None for 0.
        spread: A square root S of the parameters' covariance S S^T in the chain's columns, shape (n_columns, k), where
            what they may be off bends a row; None for 0.
    """

    weights: Floats | None = None
    factors: tuple[float, float] = (1.0, 1.0)
    joint_errors: Floats | None = None
    spread: Floats | None = None


@dataclass(frozen=True)
class PairJudgement:
    """What each pair contributes, shapes (n_pairs,).

    Attributes:
        distance: Gives a distance row.
        angle: Gives an angle row.
        same_point: Gives the 3-vector between its points instead of a distance.
        reasons: Why measured rows take no part: masks by reason.
    """

    distance: Booleans
    angle: Booleans
    same_point: Booleans
    reasons: dict[str, Booleans]

    @property
    def used(self) -> Booleans:
        """Gives any row."""
        return self.distance | self.angle | self.same_point

    def __eq__(self, other: object) -> bool:
        """Whether both use the same rows."""
        if not isinstance(other, PairJudgement):
            return NotImplemented
        fields = ("distance", "angle", "same_point")
        return all(np.array_equal(getattr(self, f), getattr(other, f)) for f in fields)

    __hash__ = None  # type: ignore[assignment]


def pair_block(trig: Floats, pairs: Pairs, kinds: tuple[bool, bool]) -> PairBlock:
    """Pairs, not whitened: residuals in [m] and [rad]."""
    measured = np.nan_to_num(np.stack([pairs.distance, pairs.angle], axis=1))
    unit = np.ascontiguousarray(np.broadcast_to([1.0, 0.0, 1.0], (pairs.n_pairs, 3)))
    return PairBlock(trig, pairs.a, pairs.b, measured, unit, kinds)


def pose_block(trig: Floats, rows: Integers, measurements: Measurements, kinds: tuple[bool, bool]) -> PoseBlock:
    """Measured orientations and positions at `rows`, not whitened: residuals in [rad] and [m]."""
    n, height = len(rows), 3 * sum(kinds)
    rotation = np.zeros((n, 3, 3)) if measurements.rotation is None else measurements.rotation[rows]
    position = np.zeros((n, 3)) if measurements.position is None else measurements.position[rows]
    unit = np.ascontiguousarray(np.broadcast_to(np.eye(height), (n, height, height)))
    return PoseBlock(trig, rows, np.ascontiguousarray(rotation), np.ascontiguousarray(position), unit, kinds)


class PairWhitening:
    """The pairs of a problem, judged at some parameters.

    Args:
        trig: Readings, or the joint values that are estimated in their place, for the kernels.
        chain: The chain at these parameters.
        measurements: What was measured.
        pairs: The pairs, nan where a measurement is not wanted.
        kinds: Whether distances and angles are wanted at all.
        formed: Whether the pairs were formed from measured poses.
        adjustment: What has been learned of their noise.
        joints_estimated: Whether true joint values are estimated, so that their errors bend no mean.

    Attributes:
        judgement: What each pair contributes.
        moments: Mean and variance of each distance and angle under the noise of its vector, shapes (n_pairs, 2).
    """

    def __init__(
        self,
        trig: Floats,
        chain: Chain,
        measurements: Measurements,
        pairs: Pairs,
        kinds: tuple[bool, bool],
        formed: bool,
        adjustment: Adjustment,
        joints_estimated: bool = False,
    ) -> None:
        self._trig = trig
        self._chain = chain.without_columns()
        self._columns = chain
        self._measurements = measurements
        self._pairs = pairs
        self._kinds = kinds
        self._formed = formed
        self._adjustment = adjustment
        self._joints_estimated = joints_estimated
        self._joints = np.flatnonzero(measurements.sigma_joint > 0.0)
        factors = np.array(adjustment.factors)
        # Of the measurement alone, along distance and angle, shape (n_pairs, 2), as it is thought to be.
        stated = self._formed_variance() if formed else np.stack([pairs.sigma_distance, pairs.sigma_angle], axis=1) ** 2
        self._own = np.nan_to_num(stated) * factors**2
        self._of_joints = self._joint_covariance() * factors[[0, 0, 1]] * factors[[0, 1, 1]]
        self.moments = self._moments(factors)
        slope = self.moments.slope
        self._stated = np.zeros((pairs.n_pairs, 3))  # (distance, both, angle)
        self._stated[:, [0, 2]] = self.moments.variance
        self._linear = self._of_joints * np.stack(
            [slope[:, 0] ** 2, slope[:, 0] * slope[:, 1], slope[:, 1] ** 2], axis=1
        )
        self._stated += self._linear if joints_estimated else self._linear * [0.0, 1.0, 0.0]
        # 1 sigma of what a pair formed from poses has of their errors beyond the first order, shape (n_pairs, 2).
        linear = slope**2 * self._own + (0.0 if joints_estimated else self._linear[:, [0, 2]])
        self._bent = np.sqrt(np.maximum(self.moments.variance - linear, 0.0))
        same = np.all(measurements.readings[pairs.a] == measurements.readings[pairs.b], axis=1)
        self.judgement = self._judge(same)

    @cached_property
    def _poses(self) -> Poses:
        """Predicted tool poses of all configurations."""
        return forward(self._chain, self._trig)

    @property
    def sigma(self) -> Floats:
        """1 sigma of distance and angle, all noise together, shape (n_pairs, 2), [m], [rad]."""
        sigma: Floats = np.sqrt(self._stated[:, [0, 2]])
        return sigma

    def rows(self) -> PairBlock:
        """All pairs, not whitened: mean minus measured, in [m] and [rad]."""
        unit = np.broadcast_to([1.0, 0.0, 1.0], (self._pairs.n_pairs, 3))
        return self._block(np.arange(self._pairs.n_pairs), unit)

    def lengths(self) -> tuple[Floats, Integers]:
        """Length of each pair's residual whitened by all its noise, and its number of rows, shapes (n_pairs,).

        For pairs that take no part 0 and 0.
        """
        n = self._pairs.n_pairs
        squared, height = np.zeros(n), np.zeros(n, dtype=np.int64)
        rows = np.flatnonzero(self.judgement.distance | self.judgement.angle)
        W = _whiten_2x2(self._stated[rows], self.judgement.distance[rows], self.judgement.angle[rows])
        squared[rows] = np.sum(residuals.residual(self._block(rows, W), self._chain) ** 2, axis=1)
        height[rows] = self.judgement.distance[rows].astype(np.int64) + self.judgement.angle[rows]
        rows = np.flatnonzero(self.judgement.same_point)
        if len(rows):
            same = self._same_points(rows, Sharing(), joint_noise=True, weighted=False)
            squared[rows] = np.sum(residuals.residual(same, self._chain) ** 2, axis=1)
            height[rows] = 3
        return np.sqrt(squared), height

    def size(self, sharing: Sharing) -> int:
        """Size of the dense system that carrying shared errors takes: the number of errors, or of rows if less."""
        return min(self._counts(sharing))

    def _redundant(self, sharing: Sharing) -> bool:
        """Whether there are more rows than errors that they share."""
        n_rows, n_errors = self._counts(sharing)
        return n_rows > n_errors

    def _counts(self, sharing: Sharing) -> tuple[int, int]:
        """Number of train rows, and of the errors that they share."""
        judgement, train = self.judgement, self.judgement.used & ~self._pairs.test
        either = (judgement.distance | judgement.angle) & train
        n_rows = sum(self._kinds) * int(either.sum()) + 3 * int((judgement.same_point & train).sum())
        n = len(np.unique(np.concatenate([self._pairs.a[train], self._pairs.b[train]])))
        return n_rows, n * self._width(sharing)

    def blocks(self, sharing: Sharing, joint_noise: bool = True) -> list[AnyBlock]:
        """The train rows, whitened: a block of distances and angles, a block of same points, or both in one.

        Args:
            sharing: Which errors the rows are taken to share.
            joint_noise: Whether the rows are taken to have noise from the joint readings at all.
        """
        parts = self._parts(sharing, joint_noise)
        width = self._width(sharing)
        if not width or not parts:
            return list(parts)
        loadings = [self.loadings(part, sharing) for part in parts]
        used = np.unique(np.concatenate([L.indices // width for L in loadings]))
        columns = (used[:, None] * width + np.arange(width)).ravel()
        offsets = tuple(map(self._offset, parts)) if self._adjustment.joint_errors is not None else ()
        spare = tuple(map(_spare, parts)) if sharing.poses and self._formed else ()
        return [correlate(tuple(parts), tuple(L[:, columns] for L in loadings), offsets, spare)]

    def correlation(self, chain: Chain, sharing: Sharing) -> Floats:
        """What correlation adds where rows are weighted as independent: J^T (C - 1) J, shape (n_columns, n_columns).

        J are the derivatives of the rows of `blocks(Sharing())` and C is their covariance.

        Args:
            chain: The chain with the columns wanted.
            sharing: Which errors they share.
        """
        n = self._measurements.n_configurations * self._width(sharing)
        common, own = np.zeros((n, chain.n_columns)), np.zeros((chain.n_columns, chain.n_columns))
        for part in self._parts(Sharing(), joint_noise=True):
            for rows, G in self._shared_rows(part, sharing):
                J = residuals.linearise(residuals.rows_of(part, rows), chain)[1]  # (n, height, n_columns)
                each = np.einsum("nhew,nhp->newp", G, J)
                own += np.einsum("newp,newq->pq", each, each)
                L = self._sparse(residuals.rows_of(part, rows), G)
                common += L.T @ J.reshape(-1, chain.n_columns)
        return common.T @ common - own

    def _parts(self, sharing: Sharing, joint_noise: bool) -> list[Block]:
        """The train rows, whitened by their private noise."""
        parts: list[Block] = []
        train = ~self._pairs.test
        pair_rows = np.flatnonzero((self.judgement.distance | self.judgement.angle) & train)
        if len(pair_rows):
            parts.append(self._block(pair_rows, self._private_whitening(pair_rows, sharing, joint_noise)))
        same_rows = np.flatnonzero(self.judgement.same_point & train)
        if len(same_rows):
            parts.append(self._same_points(same_rows, sharing, joint_noise))
        return parts

    def loadings(self, part: Block, sharing: Sharing) -> scipy.sparse.csr_array:
        """How a block's whitened rows follow from shared errors, sparse, shape (n * height, n_configurations * width).

        A configuration's errors: those of its measured position and orientation, then those of its readings, each of
        1 sigma.
        """
        G = [chunk for _, chunk in self._shared_rows(part, sharing)]
        return self._sparse(part, np.concatenate(G))

    def _sparse(self, part: Block, G: Floats) -> scipy.sparse.csr_array:
        """`loadings` of rows per error of either end, shape (n, height, 2, width)."""
        n, height, _, width = G.shape
        ends = np.stack([part.a, part.b], axis=1)  # type: ignore[attr-defined]
        columns = np.broadcast_to(ends[:, None, :, None] * width + np.arange(width), G.shape)
        starts = np.arange(n * height + 1) * 2 * width
        shape = (n * height, self._measurements.n_configurations * width)
        return scipy.sparse.csr_array((G.ravel(), columns.ravel(), starts), shape=shape)

    def joint_errors(self, block: CorrelatedBlock, chain: Chain) -> Floats:
        """What the train rows say of the joint errors, shape (n_configurations, n_joints), [rad] (prismatic: [m]).

        Args:
            block: From `blocks`, with the joints' errors shared.
            chain: The chain at the parameters where the rows are asked.
        """
        m, width = self._measurements, self._width(Sharing(joints=True))
        found = np.zeros((m.n_configurations, len(m.sigma_joint)))
        pairs = self._pairs.select(self.judgement.used & ~self._pairs.test)
        used = np.unique(np.concatenate([pairs.a, pairs.b]))
        z = block.shared_errors(chain).reshape(len(used), -1)[:, -width:]
        found[np.ix_(used, self._joints)] = -m.sigma_joint[self._joints] * z
        return found

    def _width(self, sharing: Sharing) -> int:
        """Shared errors of one configuration."""
        return 4 * sum(self._kinds) * (sharing.poses and self._formed) + len(self._joints) * sharing.joints

    def _block(self, rows: Integers, whitening: Floats) -> PairBlock:
        """Pairs at `rows`, mean minus measured, whitened by (w_dd, w_ad, w_aa), shape (n, 3).

        Near the parameters where the moments were taken the mean is M(f0) + slope (f - f0): an ordinary row, its
        measured value shifted and its whitening multiplied by the slope.
        """
        part = pair_block(self._trig, self._pairs.select(rows), self._kinds)
        predicted, excess = self._predicted[rows], self.moments.excess[rows]
        slope = np.maximum(self.moments.slope[rows], LEAST_SLOPE)
        measured = part.measured + (predicted - part.measured) * (1.0 - 1.0 / slope) - excess / slope
        whitening = np.ascontiguousarray(whitening * slope[:, [0, 0, 1]])
        return replace(part, measured=measured, whitening=whitening, bent=self._bent[rows] / slope)

    def _moments(self, factors: Floats) -> Moments:
        """Mean and variance of each distance and angle, shapes (n_pairs, 2); of no meaning where not wanted."""
        pairs, m = self._pairs, self._measurements
        whole = pair_block(self._trig, pairs, self._kinds)
        self._predicted = np.zeros((pairs.n_pairs, 2))
        self._predicted[:, self._kinds] = residuals.residual(whole, self._chain) + whole.measured[:, self._kinds]
        along, trace = np.zeros((2, pairs.n_pairs, 2))
        own = self._own
        if self._formed:
            along, own = self._own, np.zeros_like(self._own)
            trace = np.stack([_trace(m.sigma_position, pairs), _trace(m.sigma_orientation, pairs)], axis=1) * factors**2
        if len(self._joints) and not self._joints_estimated:
            along = along + self._of_joints[:, [0, 2]]
            trace = trace + self._joint_trace() * factors**2
        across = np.maximum(trace - along, 0.0) / 2.0 + self._bending()
        f = self._predicted
        along, across, own = (np.where(self._kinds, v, 0.0) for v in (along, across, own))
        found = [
            of(f[:, k], along[:, k], across[:, k], own[:, k]) for k, of in enumerate((length_moments, angle_moments))
        ]
        return Moments(*(np.stack(pair, axis=1) for pair in zip(*map(astuple, found), strict=True)))

    def _formed_variance(self) -> Floats:
        """Variance of distances and angles between measured poses, shape (n_pairs, 2); nan where not measured."""
        m, pairs, both = self._measurements, self._pairs, np.full((self._pairs.n_pairs, 2), np.nan)
        directions = self._directions(pairs.a, pairs.b)
        for k, sigma in enumerate((m.sigma_position, m.sigma_orientation)):
            if sigma is not None:
                both[:, k] = np.sum(directions[k] ** 2 * (sigma[pairs.a] ** 2 + sigma[pairs.b] ** 2), axis=1)
        return both

    def _directions(self, a: Integers, b: Integers) -> tuple[Floats, Floats]:
        """Unit vectors from a to b in the measurement frame, and axes of the rotation from a to b in a, shapes (n, 3).

        As predicted: those of measured poses would depend on the very errors that they are to tell the effect of.
        """
        p, R = self._poses.position, self._poses.rotation
        along = _unit(p[b] - p[a]) @ self._base_in_world().T
        return along, _unit(rotation_angle(np.swapaxes(R[a], 1, 2) @ R[b])[1])

    def _base_in_world(self) -> Floats:
        """The rotation that brings the predicted points nearest to the measured ones, shape (3, 3)."""
        m = self._measurements
        if m.position is None or m.test.all():
            return np.eye(3)
        measured, p = m.position[~m.test], self._poses.position[~m.test]
        return nearest_rotation((measured - measured.mean(axis=0)).T @ (p - p.mean(axis=0)))

    def _bending(self) -> Floats:
        """Variance in each direction across that the parameters' own gives each vector, shape (n_pairs, 2).

        Along the vector it is what is estimated; across it lengthens the vector as noise does, and bends the row. Zero
        where it does not matter.
        """
        spread = self._adjustment.spread
        if spread is None:
            return np.zeros((self._pairs.n_pairs, 2))
        across = self._noticed(spread, LEAST_BEND)
        return np.minimum(across, MOST_BEND * self._straight())

    def bent_by(self, spread: Floats, sigmas: float) -> Booleans:
        """Which distances and angles some uncertainty of the parameters bends by so many sigma, shape (n_pairs, 2).

        Args:
            spread: A square root of the parameters' covariance, shape (n_columns, k).
            sigmas: By how many sigma at least.
        """
        bent: Booleans = self._noticed(spread, sigmas) > 0.0
        return bent

    def may_fold(self, spread: Floats) -> Booleans:
        """Which distances and angles some uncertainty of the parameters may fold, shape (n_pairs, 2).

        Half the way to 0, or of an angle to half a turn, is then less than that uncertainty (and this more than the
        noise): the vector may as well point the other way, and a descent may end with the wrong one.

        Args:
            spread: A square root of the parameters' covariance, shape (n_columns, k).
        """
        f, noise, train = self._predicted, 4.0 * self._own, np.flatnonzero(~self._pairs.test)
        folds = np.zeros((self._pairs.n_pairs, 2), dtype=np.bool_)
        if not len(train):
            return folds
        from_kink = np.stack([f[:, 0], np.minimum(f[:, 1], np.pi - f[:, 1])], axis=1)
        some = train[np.unique(np.linspace(0, len(train) - 1, 500).astype(np.int64))]
        largest = 4.0 * np.sum(self._spread_of(some, spread), axis=0).max(axis=0)
        near = np.flatnonzero(np.any((from_kink**2 / 4.0 < largest) & self._kinds, axis=1))
        for start in range(0, len(near), SPAN):
            rows = near[start : start + SPAN]
            across, along = self._spread_of(rows, spread)
            folds[rows] = across + along > np.maximum(f[rows] ** 2 / 4.0, noise[rows])
            folds[rows, 1] |= along[:, 1] > np.maximum((np.pi - f[rows, 1]) ** 2 / 4.0, noise[rows, 1])
        return folds & self._kinds

    def _noticed(self, spread: Floats, sigmas: float) -> Floats:
        """Variance across where it bends a row by so many sigma, else 0, shape (n_pairs, 2).

        Where four times the largest of some pairs, evenly chosen, would not, it is not even worked out.
        """
        across, train = np.zeros((self._pairs.n_pairs, 2)), np.flatnonzero(~self._pairs.test)
        if not len(train):
            return across
        least = sigmas * self._straight()
        some = train[np.unique(np.linspace(0, len(train) - 1, 500).astype(np.int64))]
        rows = np.flatnonzero(np.any(4.0 * self._spread_across(some, spread).max(axis=0) >= least, axis=1))
        for start in range(0, len(rows), SPAN):
            chunk = rows[start : start + SPAN]
            across[chunk] = self._spread_across(chunk, spread)
        return np.where(across >= least, across, 0.0)

    def _straight(self) -> Floats:
        """Variance across that bends a row by one sigma, shape (n_pairs, 2); infinite where there is none to bend.

        Nearer to 0 than one sigma it is that of the noise itself.
        """
        sigma = np.sqrt(self._own)
        return np.where((self._own > 0.0) & self._kinds, sigma * np.maximum(self._predicted, sigma), np.inf)

    def _spread_across(self, rows: Integers, spread: Floats) -> Floats:
        """What `_bending` is about at `rows`, shape (n, 2)."""
        return BEND_MARGIN * self._spread_of(rows, spread)[0]

    def _spread_of(self, rows: Integers, spread: Floats) -> tuple[Floats, Floats]:
        """Variance that the parameters' own gives vectors: in each direction across, and along, shapes (n, 2).

        With Q the rotation from a to b, R_b R_a^T, turns w_a and w_b of the tool turn Q by w_b - Q w_a. Motions of the
        base, and of the tool in itself, carry vector and rotation with them and bend nothing: they are taken out.
        """
        pairs, n = self._pairs, len(rows)
        at = forward(self._columns, self._trig, np.concatenate([pairs.a[rows], pairs.b[rows]]))
        base = turning_of_base(at.jacobian[:, :3], at.rotation) @ spread  # (3, k)
        turn, shift = np.split(at.jacobian @ spread, 2, axis=1)  # (2 n, 3, k) each
        Q = at.rotation[n:] @ np.swapaxes(at.rotation[:n], 1, 2)
        vector, turn = at.position[n:] - at.position[:n], turn - base
        change = (shift[n:] - shift[:n] - np.cross(base[None], vector[:, :, None], axis=1), turn[n:] - Q @ turn[:n])
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
        """Variance that joint noise gives each vector, all directions together, shape (n_pairs, 2)."""
        J = forward(self._chain.with_joint_columns(), self._trig).jacobian  # (n_configurations, 6, n_joints)
        J = J * self._measurements.sigma_joint
        of_each = np.stack([np.sum(J[:, 3:] ** 2, axis=(1, 2)), np.sum(J[:, :3] ** 2, axis=(1, 2))], axis=1)
        both: Floats = of_each[self._pairs.a] + of_each[self._pairs.b]
        return both

    def _joint_covariance(self) -> Floats:
        """What joint noise does to distance and angle, to first order: (distance, both, angle), shape (n_pairs, 3)."""
        covariance = np.zeros((self._pairs.n_pairs, 3))
        if len(self._joints):
            for rows, J in self._joint_rows(pair_block(self._trig, self._pairs, self._kinds)):
                wide = np.zeros((len(J), 2, J.shape[2]))
                wide[:, self._kinds] = J
                covariance[rows, 0] = np.sum(wide[:, 0] ** 2, axis=1)
                covariance[rows, 1] = np.sum(wide[:, 0] * wide[:, 1], axis=1)
                covariance[rows, 2] = np.sum(wide[:, 1] ** 2, axis=1)
        return covariance

    def _joint_rows(self, part: Block) -> Iterator[tuple[slice, Floats]]:
        """Derivatives of a block's rows in the readings times their sigma, in chunks: (rows, (n, height, n_own))."""
        return joint_rows(part, self._chain, self._measurements.sigma_joint)

    def _judge(self, same: Booleans) -> PairJudgement:
        """Which rows of each pair take part; none where both readings are the same: nothing changes the prediction.

        A directly measured distance of exactly 0 is not a noisy number: it says that both points are one.
        """
        measured_distance, measured_angle = (np.isfinite(v) & ~same for v in (self._pairs.distance, self._pairs.angle))
        same_point = measured_distance & (self._pairs.distance == 0.0) & (not self._formed)
        return PairJudgement(
            distance=measured_distance & ~same_point,
            angle=measured_angle,
            same_point=same_point,
            reasons={"same_configuration": same},
        )

    def _private_whitening(self, rows: Integers, sharing: Sharing, joint_noise: bool) -> Floats:
        """(w_dd, w_ad, w_aa) that whiten the noise that pairs do not share, shape (n, 3)."""
        stated = self._stated[rows]
        private = stated.copy()
        if sharing.joints or not joint_noise:
            private -= self._linear[rows]
        if sharing.poses and self._formed:
            kept = REDUNDANT if self._redundant(sharing) else 1.0
            linear = self.moments.slope[rows] ** 2 * self._own[rows]
            private[:, [0, 2]] += (0.5 * kept - 1.0) * self._bent[rows] ** 2 - linear
        private[:, [0, 2]] = np.maximum(private[:, [0, 2]], PRIVATE_SHARE * stated[:, [0, 2]])
        if self._adjustment.weights is not None:
            # A down-weighted pair has noise of its own on top, so much that it says no more than its weight.
            weight = np.maximum(self._adjustment.weights[rows], LEAST_WEIGHT)
            private += (1.0 / weight - 1.0)[:, None] * stated
        return _whiten_2x2(private, self.judgement.distance[rows], self.judgement.angle[rows])

    def _same_points(
        self, rows: Integers, sharing: Sharing, joint_noise: bool, weighted: bool = True
    ) -> SamePointBlock:
        pairs = self._pairs
        same = SamePointBlock(self._trig, pairs.a[rows], pairs.b[rows], np.tile(np.eye(3), (len(rows), 1, 1)))
        of_joints = np.zeros((len(rows), 3, 3))
        if len(self._joints):
            for chunk, J in self._joint_rows(same):
                of_joints[chunk] = J @ np.swapaxes(J, 1, 2) * self._adjustment.factors[0] ** 2
        S = np.eye(3) * self._own[rows, 0][:, None, None]
        private = S + of_joints * (joint_noise and not sharing.joints)
        if weighted and self._adjustment.weights is not None:
            weight = np.maximum(self._adjustment.weights[rows], LEAST_WEIGHT)
            private = private + (1.0 / weight - 1.0)[:, None, None] * (S + of_joints)
        return replace(same, whitening=_inverse_cholesky(private))

    def _shared_rows(self, part: Block, sharing: Sharing) -> Iterator[tuple[slice, Floats]]:
        """Whitened rows per 1 sigma of each shared error, in chunks: (rows, (n, height, 2, width))."""
        joints = None
        if sharing.joints and len(self._joints):
            of_distance, of_angle = self._adjustment.factors
            factors = [of_distance, of_distance, of_angle] if isinstance(part, PairBlock) else of_distance
            joints = self._joint_rows(replace(part, whitening=part.whitening * factors))  # type: ignore[attr-defined, type-var]
        for start in range(0, part.n, SPAN):
            rows = slice(start, min(start + SPAN, part.n))
            columns = []
            if sharing.poses and self._formed:
                columns.append(self._pose_errors(residuals.rows_of(part, rows)))
            if joints is not None:
                J = next(joints)[1]
                columns.append(J.reshape(*J.shape[:2], 2, -1)[..., self._joints])
            yield rows, np.concatenate(columns, axis=3)

    def _pose_errors(self, part: Block) -> Floats:
        """Whitened rows per 1 sigma of the measured poses they were formed from, shape (n, height, 2, width).

        Of each kind a pose has three errors, along the axes, and a fourth, the square of its errors across: the latter
        lengthen all pairs of the pose. Of what the squares at both ends add to the variance of a pair half is theirs,
        a quarter at either end, and half that of their product, the pair's own.
        """
        assert isinstance(part, PairBlock)
        m, factors = self._measurements, self._adjustment.factors
        G = np.zeros((part.n, 2, 2, 2, 4))  # row, (distance, angle), end, source, (axes, square)
        ends = np.stack([part.a, part.b], axis=1)  # (n, 2)
        sign = np.array([1.0, -1.0])[:, None]  # of predicted minus measured in the error at a, at b
        directions = self._directions(part.a, part.b)
        for k, sigma in enumerate((m.sigma_position, m.sigma_orientation)):
            if sigma is not None:
                G[:, k, :, k, :3] = factors[k] * sign * directions[k][:, None] * sigma[ends]
                G[:, k, :, k, 3] = -0.5 * part.bent[:, k, None]
        wanted = G[:, :, :, self._kinds].reshape(part.n, 2, 2, -1)
        return _whiten_rows(part.whitening, wanted)[:, self._kinds]

    def _offset(self, part: Block) -> Floats:
        """What the estimated joint errors alone make of a block's whitened rows, to first order, shape (rows,)."""
        assert self._adjustment.joint_errors is not None
        errors = self._adjustment.joint_errors
        ends = np.concatenate([errors[part.a], errors[part.b]], axis=1)  # type: ignore[attr-defined]
        ones = np.ones_like(self._measurements.sigma_joint)
        rows = [np.einsum("nhj,nj->nh", J, ends[chunk]) for chunk, J in joint_rows(part, self._chain, ones)]
        return np.concatenate(rows).ravel()


def joint_rows(part: Block, chain: Chain, scale: Floats) -> Iterator[tuple[slice, Floats]]:
    """Derivatives of a block's rows in the readings times `scale`, in chunks: (rows, (n, height, n_own))."""
    wide = np.tile(scale, part.n_configurations)
    chain = chain.without_columns().with_joint_columns()
    for start in range(0, part.n, SPAN):
        rows = slice(start, min(start + SPAN, part.n))
        yield rows, residuals.linearise(residuals.rows_of(part, rows), chain)[1] * wide


class PoseWhitening:
    """The measured poses of a problem, whitened at some parameters.

    Args:
        trig: Readings, or the joint values that are estimated in their place, for the kernels.
        chain: The chain at these parameters.
        measurements: What was measured.
        kinds: Whether orientations and positions are wanted.
        adjustment: What has been learned of their noise.
    """

    def __init__(
        self,
        trig: Floats,
        chain: Chain,
        measurements: Measurements,
        kinds: tuple[bool, bool],
        adjustment: Adjustment,
    ) -> None:
        m = measurements
        self._measurements = m
        self._chain = chain.without_columns()
        self._kinds = kinds
        self._adjustment = adjustment
        self._whole = pose_block(trig, np.arange(m.n_configurations), m, kinds)
        sigmas = [m.sigma_orientation if kinds[0] else None, m.sigma_position if kinds[1] else None]
        wanted = [s for s in sigmas if s is not None]
        self._factors = np.repeat(np.array(adjustment.factors)[list(kinds)], 3)
        self._own = np.concatenate(wanted, axis=1)[:, :, None] ** 2 * np.eye(self._whole.height)
        self._of_joints = np.zeros_like(self._own)
        if np.any(m.sigma_joint > 0.0):
            for rows, J in joint_rows(self._whole, self._chain, m.sigma_joint):
                self._of_joints[rows] = J @ np.swapaxes(J, 1, 2)

    @property
    def sigma(self) -> Floats:
        """1 sigma of orientation and position components, all noise together, shape (n, 6); nan where not wanted."""
        sigma = np.full((self._whole.n, 6), np.nan)
        stated = np.sqrt(np.einsum("nii->ni", self._own + self._of_joints))
        sigma[:, np.repeat(self._kinds, 3)] = stated * self._factors
        return sigma

    def blocks(self, joint_noise: bool = True) -> list[AnyBlock]:
        """The train rows, whitened.

        Args:
            joint_noise: Whether the rows are taken to have noise from the joint readings.
        """
        train = np.flatnonzero(~self._measurements.test)
        if not len(train):
            return []
        W = self._whitening(joint_noise)
        m, block = self._measurements, pose_block(self._whole.trig, train, self._measurements, self._kinds)
        block = replace(block, whitening=W[train])
        if self._adjustment.joint_errors is None:
            return [block]
        errors, ones = self._adjustment.joint_errors[train], np.ones_like(m.sigma_joint)
        rows = [np.einsum("nhj,nj->nh", J, errors[chunk]) for chunk, J in joint_rows(block, self._chain, ones)]
        return [CorrelatedBlock((block,), offsets=(np.concatenate(rows).ravel(),))]

    def lengths(self) -> tuple[Floats, Integers]:
        """Length of each pose's residual whitened by all its noise, and its number of rows, shapes (n,)."""
        W = _inverse_cholesky(self._own + self._of_joints) / self._factors
        r = residuals.residual(replace(self._whole, whitening=W), self._chain)
        return np.linalg.norm(r, axis=1), np.full(len(r), self._whole.height)

    def joint_errors(self, chain: Chain) -> Floats:
        """What each pose says of the errors of its readings, shape (n_configurations, n_joints).

        Args:
            chain: The chain at the parameters where the poses are asked.
        """
        m = self._measurements
        W = self._whitening(True)
        whole = replace(self._whole, whitening=W)
        r = residuals.residual(whole, chain.without_columns())
        found = np.zeros((m.n_configurations, len(m.sigma_joint)))
        for rows, J in joint_rows(whole, self._chain, np.ones_like(m.sigma_joint)):
            left = r[rows]
            if self._adjustment.joint_errors is not None:
                left = left - np.einsum("nhj,nj->nh", J, self._adjustment.joint_errors[rows])
            found[rows] = -(m.sigma_joint**2) * np.einsum("nhj,nh->nj", J, left)
        found[m.test] = 0.0
        return found

    def _whitening(self, joint_noise: bool) -> Floats:
        private = self._own + self._of_joints * joint_noise
        if self._adjustment.weights is not None:
            weight = np.maximum(self._adjustment.weights, LEAST_WEIGHT)
            private = private + (1.0 / weight - 1.0)[:, None, None] * (self._own + self._of_joints)
        W: Floats = _inverse_cholesky(private) / self._factors
        return W


def _trace(sigma: Floats | None, pairs: Pairs) -> Floats:
    """Variance of a difference between two configurations, all directions together, shape (n_pairs,)."""
    if sigma is None:
        return np.zeros(pairs.n_pairs)
    of_each = np.sum(sigma**2, axis=1)
    both: Floats = of_each[pairs.a] + of_each[pairs.b]
    return both


def _unit(vectors: Floats) -> Floats:
    """Vectors of length 1 along others (zero for zero), shape (n, 3)."""
    out: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return out


def _spare(part: Block) -> Floats:
    """Share of the own noise of pairs formed from poses that is beyond what they have, shape (n * height,)."""
    assert isinstance(part, PairBlock)
    whitening = part.whitening[:, [0, 2]]
    share: Floats = np.where(whitening > 0.0, np.maximum(0.0, 1.0 - 0.5 * (part.bent * whitening) ** 2), 0.0)
    return share[:, list(part.kinds)].ravel()


def _whiten_rows(whitening: Floats, rows: Floats) -> Floats:
    """(w_dd, w_ad, w_aa) times (distance, angle) rows, shape (n, 2, ...)."""
    w_dd, w_ad, w_aa = whitening.T.reshape(3, -1, *[1] * (rows.ndim - 2))
    return np.stack([w_dd * rows[:, 0], w_ad * rows[:, 0] + w_aa * rows[:, 1]], axis=1)


def _whiten_2x2(covariance: Floats, distance: Booleans, angle: Booleans) -> Floats:
    """(w_dd, w_ad, w_aa) that whiten the rows in use, shape (n, 3)."""
    d, c, a = covariance.T
    both = distance & angle
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.sqrt(np.where(both, a - c * c / d, a))
        w_dd = np.where(distance, 1.0 / np.sqrt(d), 0.0)
        w_aa = np.where(angle, 1.0 / rest, 0.0)
        w_ad = np.where(both, -c / d / rest, 0.0)
    return np.stack([w_dd, w_ad, w_aa], axis=1)


def _inverse_cholesky(S: Floats) -> Floats:
    """W with W S W^T = 1, lower triangular, for each of many small covariances."""
    W: Floats = np.linalg.inv(np.linalg.cholesky(S))
    return np.tril(W)
