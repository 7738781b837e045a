"""How the rows of measurements are judged and whitened: which take part, with what noise, and which errors they share.

Three sources of noise reach a row: that of the measurement itself; that of the two measured poses where a pair was
formed from poses; and that of the joint readings, through the row's derivatives in the joints. The last two belong to
a configuration and are the same in every pair that it takes part in. *Private* noise is a measurement's own. Shared
noise is either counted as private too (`independent`) or carried as errors that the rows have in common (see
`residuals.CorrelatedBlock`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib import residuals
from fg_calib.kinematics import SPAN, Chain
from fg_calib.measurements import Measurements, Pairs, rotation_angle
from fg_calib.residuals import AnyBlock, Block, CorrelatedBlock, PairBlock, PoseBlock, SamePointBlock, correlate

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

KINK_SIGMAS = 5.0
"""An angle nearer to 0 or pi, or a distance nearer to 0, than this many sigma gives no row of its own."""

SAME_POINT_SIGMAS = 3.0
"""A small distance that was measured as 0 within this many sigma says that both points are the same."""

MAX_SHARED = 3000
"""Rows, or errors that they share if these are fewer, beyond which the exact treatment takes too much time."""

PRIVATE_SHARE = 1e-3
"""Share of a formed pair's variance that counts as its own: what it is not to first order, and rounding."""

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
    """

    weights: Floats | None = None
    factors: tuple[float, float] = (1.0, 1.0)
    joint_errors: Floats | None = None


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

    Attributes:
        judgement: What each pair contributes.
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
    ) -> None:
        self._trig = trig
        self._chain = chain.without_columns()
        self._measurements = measurements
        self._pairs = pairs
        self._kinds = kinds
        self._formed = formed
        self._adjustment = adjustment
        self._joints = np.flatnonzero(measurements.sigma_joint > 0.0)
        self._whole = pair_block(trig, pairs, kinds)
        self._own = np.zeros((pairs.n_pairs, 3))  # of the measurement
        self._own[:, 0] = np.nan_to_num(pairs.sigma_distance) ** 2
        self._own[:, 2] = np.nan_to_num(pairs.sigma_angle) ** 2
        self._of_joints = self._joint_covariance()
        self._stated = self._own + self._of_joints
        same = np.all(measurements.readings[pairs.a] == measurements.readings[pairs.b], axis=1)
        self.judgement = self._judge(same)

    @property
    def sigma(self) -> Floats:
        """1 sigma of distance and angle, all noise together, shape (n_pairs, 2), [m], [rad]."""
        sigma: Floats = np.sqrt(self._stated[:, [0, 2]]) * self._adjustment.factors
        return sigma

    def lengths(self) -> tuple[Floats, Integers]:
        """Length of each pair's residual whitened by all its noise, and its number of rows, shapes (n_pairs,).

        For pairs that take no part 0 and 0.
        """
        n = self._pairs.n_pairs
        squared, height = np.zeros(n), np.zeros(n, dtype=np.int64)
        of_distance, of_angle = self._adjustment.factors
        rows = np.flatnonzero(self.judgement.distance | self.judgement.angle)
        W = _whiten_2x2(self._stated[rows], self.judgement.distance[rows], self.judgement.angle[rows])
        part = pair_block(self._trig, self._pairs.select(rows), self._kinds)
        part = replace(part, whitening=W / [of_distance, of_distance, of_angle])
        squared[rows] = np.sum(residuals.residual(part, self._chain) ** 2, axis=1)
        height[rows] = self.judgement.distance[rows].astype(np.int64) + self.judgement.angle[rows]
        rows = np.flatnonzero(self.judgement.same_point)
        if len(rows):
            same = self._same_points(rows, Sharing(), joint_noise=True, weighted=False)
            squared[rows] = np.sum(residuals.residual(self._scaled(same), self._chain) ** 2, axis=1)
            height[rows] = 3
        return np.sqrt(squared), height

    def size(self, sharing: Sharing) -> int:
        """Size of the dense system that carrying shared errors takes: the number of errors, or of rows if less."""
        judgement, train = self.judgement, self.judgement.used & ~self._pairs.test
        either = (judgement.distance | judgement.angle) & train
        n_rows = sum(self._kinds) * int(either.sum()) + 3 * int((judgement.same_point & train).sum())
        n = len(np.unique(np.concatenate([self._pairs.a[train], self._pairs.b[train]])))
        return min(n_rows, n * self._width(sharing))

    def blocks(self, sharing: Sharing, joint_noise: bool = True) -> list[AnyBlock]:
        """The train rows, whitened: a block of distances and angles, a block of same points, or both in one.

        Args:
            sharing: Which errors the rows are taken to share.
            joint_noise: Whether the rows are taken to have noise from the joint readings at all.
        """
        parts = self._parts(sharing, joint_noise)
        width = self._width(sharing)
        scaled = tuple(self._scaled(part) for part in parts)
        if not width or not parts:
            return list(scaled)
        loadings = [self.loadings(part, sharing) for part in parts]
        used = np.unique(np.concatenate([L.indices // width for L in loadings]))
        columns = (used[:, None] * width + np.arange(width)).ravel()
        offsets = tuple(map(self._offset, scaled)) if self._adjustment.joint_errors is not None else ()
        return [correlate(scaled, tuple(L[:, columns] for L in loadings), offsets)]

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
            scaled = self._scaled(part)
            for rows, G in self._shared_rows(part, sharing):
                J = residuals.linearise(residuals.rows_of(scaled, rows), chain)[1]  # (n, height, n_columns)
                each = np.einsum("nhew,nhp->newp", G, J)
                own += np.einsum("newp,newq->pq", each, each)
                L = self._sparse(residuals.rows_of(part, rows), G)
                common += L.T @ J.reshape(-1, chain.n_columns)
        return common.T @ common - own

    def _parts(self, sharing: Sharing, joint_noise: bool) -> list[Block]:
        """The train rows, whitened by their private noise as stated."""
        parts: list[Block] = []
        train = ~self._pairs.test
        pair_rows = np.flatnonzero((self.judgement.distance | self.judgement.angle) & train)
        if len(pair_rows):
            part = pair_block(self._trig, self._pairs.select(pair_rows), self._kinds)
            parts.append(replace(part, whitening=self._private_whitening(pair_rows, sharing, joint_noise)))
        same_rows = np.flatnonzero(self.judgement.same_point & train)
        if len(same_rows):
            parts.append(self._same_points(same_rows, sharing, joint_noise))
        return parts

    def loadings(self, part: Block, sharing: Sharing) -> scipy.sparse.csr_array:
        """How a block's whitened rows follow from shared errors, sparse, shape (n * height, n_configurations * width).

        A configuration's errors: those of its measured position and orientation, then those of its readings, each of
        1 sigma as stated.
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
        return 3 * sum(self._kinds) * (sharing.poses and self._formed) + len(self._joints) * sharing.joints

    def _joint_covariance(self) -> Floats:
        covariance = np.zeros((self._whole.n, 3))
        if len(self._joints):
            for rows, J in self._joint_rows(self._whole):
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
        """Which rows of each pair take part; none where both readings are the same: nothing changes the prediction."""
        pairs, sigma = self._pairs, self.sigma
        predicted = np.zeros((pairs.n_pairs, 2))
        predicted[:, self._kinds] = residuals.residual(self._whole, self._chain) + self._whole.measured[:, self._kinds]
        measured_distance, measured_angle = np.isfinite(pairs.distance) & ~same, np.isfinite(pairs.angle) & ~same
        smallest = np.fmin(pairs.distance, predicted[:, 0])
        small = measured_distance & (smallest < KINK_SIGMAS * sigma[:, 0])
        same_point = small & (pairs.distance <= SAME_POINT_SIGMAS * sigma[:, 0])
        margin = KINK_SIGMAS * sigma[:, 1]
        near_zero = measured_angle & (np.fmin(pairs.angle, predicted[:, 1]) < margin)
        near_pi = measured_angle & ~near_zero & (np.fmax(pairs.angle, predicted[:, 1]) > np.pi - margin)
        return PairJudgement(
            distance=measured_distance & ~small,
            angle=measured_angle & ~near_zero & ~near_pi,
            same_point=same_point,
            reasons={
                "distance_near_zero": small & ~same_point,
                "angle_near_zero": near_zero,
                "angle_near_pi": near_pi,
                "same_configuration": same,
            },
        )

    def _private_whitening(self, rows: Integers, sharing: Sharing, joint_noise: bool) -> Floats:
        """(w_dd, w_ad, w_aa) that whiten the noise that pairs do not share, shape (n, 3)."""
        if sharing.poses and self._formed:
            own = np.zeros((len(rows), 3))
            own[:, [0, 2]] = PRIVATE_SHARE * self._stated[rows][:, [0, 2]] + self._second_order(rows)
        else:
            own = self._own[rows].copy()
        if joint_noise and not sharing.joints:
            own += self._of_joints[rows]
        if self._adjustment.weights is not None:
            # A down-weighted pair has noise of its own on top, so much that it says no more than its weight.
            weight = np.maximum(self._adjustment.weights[rows], LEAST_WEIGHT)
            own += (1.0 / weight - 1.0)[:, None] * self._stated[rows]
        return _whiten_2x2(own, self.judgement.distance[rows], self.judgement.angle[rows])

    def _scaled(self, part: Block) -> Block:
        """A block whitened as stated, for the noise as it is thought to be: each row divided by its factor."""
        of_distance, of_angle = self._adjustment.factors
        if isinstance(part, PairBlock):
            return replace(part, whitening=part.whitening / [of_distance, of_distance, of_angle])
        assert isinstance(part, SamePointBlock)
        return replace(part, whitening=part.whitening / of_distance)

    def _second_order(self, rows: Integers) -> Floats:
        """Variance of what a formed pair has of its poses' errors to second order, shape (n, 2).

        Errors across the line make a distance d longer by e^2 / (2 d), across the axis an angle phi by
        e^2 cot(phi / 2) / 4, with e^2 / sigma^2 of 2 degrees of freedom.
        """
        pairs, (variance_d, _, variance_a) = self._pairs, self._stated[rows].T
        with np.errstate(divide="ignore", invalid="ignore"):
            of_distance = variance_d**2 / pairs.distance[rows] ** 2
            of_angle = variance_a**2 / (4.0 * np.tan(pairs.angle[rows] / 2.0) ** 2)
        both: Floats = np.nan_to_num(np.stack([of_distance, of_angle], axis=1), posinf=0.0)
        return both

    def _same_points(
        self, rows: Integers, sharing: Sharing, joint_noise: bool, weighted: bool = True
    ) -> SamePointBlock:
        pairs = self._pairs
        same = SamePointBlock(self._trig, pairs.a[rows], pairs.b[rows], np.tile(np.eye(3), (len(rows), 1, 1)))
        of_joints = np.zeros((len(rows), 3, 3))
        if len(self._joints):
            for chunk, J in self._joint_rows(same):
                of_joints[chunk] = J @ np.swapaxes(J, 1, 2)
        S = np.eye(3) * self._own[rows, 0][:, None, None]
        private = S + of_joints * (joint_noise and not sharing.joints)
        if weighted and self._adjustment.weights is not None:
            weight = np.maximum(self._adjustment.weights[rows], LEAST_WEIGHT)
            private = private + (1.0 / weight - 1.0)[:, None, None] * (S + of_joints)
        return replace(same, whitening=_inverse_cholesky(private))

    def _shared_rows(self, part: Block, sharing: Sharing) -> Iterator[tuple[slice, Floats]]:
        """Whitened rows per 1 sigma of each shared error, in chunks: (rows, (n, height, 2, width))."""
        joints = self._joint_rows(part) if sharing.joints and len(self._joints) else None
        for start in range(0, part.n, SPAN):
            rows = slice(start, min(start + SPAN, part.n))
            chunk = residuals.rows_of(part, rows)
            columns = []
            if sharing.poses and self._formed:
                columns.append(self._pose_errors(chunk))
            if joints is not None:
                J = next(joints)[1]
                columns.append(J.reshape(*J.shape[:2], 2, -1)[..., self._joints])
            yield rows, np.concatenate(columns, axis=3)

    def _pose_errors(self, part: Block) -> Floats:
        """Whitened rows per 1 sigma of the measured poses they were formed from, shape (n, height, 2, width)."""
        m = self._measurements
        if not isinstance(part, PairBlock):  # points that are the same share nothing worth the trouble
            return np.zeros((part.n, part.height, 2, 3 * sum(self._kinds)))
        G = np.zeros((part.n, 2, 2, 2, 3))  # row, (distance, angle), end, source, axis
        ends = np.stack([part.a, part.b], axis=1)  # (n, 2)
        sign = np.array([1.0, -1.0])[:, None]  # of predicted minus measured in the error at a, at b
        if self._kinds[0]:
            assert m.position is not None
            assert m.sigma_position is not None
            u = _unit(m.position[part.b] - m.position[part.a])
            G[:, 0, :, 0] = sign * u[:, None] * m.sigma_position[ends]
        if self._kinds[1]:
            assert m.rotation is not None
            assert m.sigma_orientation is not None
            k = _unit(rotation_angle(np.swapaxes(m.rotation[part.a], 1, 2) @ m.rotation[part.b])[1])
            G[:, 1, :, 1] = sign * k[:, None] * m.sigma_orientation[ends]
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


def _unit(vectors: Floats) -> Floats:
    """Vectors of length 1 along others (zero for zero), shape (n, 3)."""
    out: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    return out


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
