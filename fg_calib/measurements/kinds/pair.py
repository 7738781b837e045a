"""Distances and angles between configurations, measured directly, or formed from measured poses."""

from __future__ import annotations

import numpy as np

from fg_calib.initialization import FrameStart
from fg_calib.inputs import Booleans, Floats, Integers, ProblemError, escaped, once
from fg_calib.measurements.dataset import Pairs, are_same, form_pairs, no_pairs
from fg_calib.measurements.kind import Frames, Kind, Rows, between
from fg_calib.measurements.kinds.contact import POINT, contact_blocks
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument
from fg_calib.measurements.kinds.pose import ANGLES, POSE_COLUMNS
from fg_calib.measurements.kinds.stacked import stack
from fg_calib.measurements.landmarks import Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table
from fg_calib.robot import kernels

_NAMED = 5
"""Columns without a meaning that a warning names."""


class Distance(Kind):
    """`|p_B - p_A| - measured`, [m]; its derivative is `u . (dp_B - dp_A)`, u from A to B (Jia et al. 2019, Eq. 5).

    Data: the distance, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width = 2, 1, 1
    code = kernels.DISTANCE

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, u = between(at.position[:, 0], at.position[:, 1])
        D = np.zeros((len(u), 2, 1, 6))
        D[:, 0, 0, 3:], D[:, 1, 0, 3:] = -u, u
        return Rows(length[:, None] - data[:, :1], D)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`."""
        return np.abs(super().simulate(at, data, nuisances, noise))


class RotationAngle(Kind):
    """`angle(R_A^T R_B) - measured`, in [0, pi], [rad]; its derivative is `k . (w_B - w_A)` (Jia et al. 2019, Eq. 21).

    k is the unit axis of R_B R_A^T: half the sum over columns of `R_A[:, c] x R_B[:, c]` is `k sin(angle)`.

    Data: the angle, [rad].
    """

    names, units = ("angle",), ("rad",)
    ends, residual_dim, width = 2, 1, 1
    code = kernels.ROTATION_ANGLE

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        A, B = at.rotation[:, 0], at.rotation[:, 1]
        twice = np.cross(A, B, axis=1).sum(axis=2)  # 2 k sin(angle), (n, 3)
        sine = np.linalg.norm(twice, axis=1)
        angle = np.arctan2(sine, np.einsum("nij,nij->n", A, B) - 1.0)
        k = twice / np.maximum(sine, 1e-300)[:, None]
        D = np.zeros((len(k), 2, 1, 6))
        D[:, 0, 0, :3], D[:, 1, 0, :3] = -k, k
        return Rows(angle[:, None] - data[:, :1], D)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """With the sign ambiguity of angles at 0 and 180 degrees. See `Kind.simulate`."""
        angle = np.abs(super().simulate(at, data, nuisances, noise))
        return np.pi - np.abs(np.pi - angle)


class SamePoint(Kind):
    """`p_B - p_A` in the base frame, up to a rotation, [m]: a distance of zero, which has no direction.

    Its derivative is `dp_B - dp_A`; in a parameter minus `a x (p_B - p_A)`: all vectors may be turned by one rotation a
    of each column without changing their lengths, so by one that undoes motions of the base.

    Data: none.
    """

    names, units = ("distance.x", "distance.y", "distance.z"), ("m", "m", "m")
    ends, residual_dim, width = 2, 3, 0
    turned_back = is_contact = True
    code = kernels.SAME_POINT

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        D = np.zeros((len(data), 2, 3, 6))
        D[:, 0, :, 3:], D[:, 1, :, 3:] = -np.eye(3), np.eye(3)
        return Rows(at.position[:, 1] - at.position[:, 0], D)


def usable_pairs(table: Table, wanted: tuple[bool, bool]) -> Pairs:
    """The pairs of a table with something to use; each measurement has its sigma.

    Args:
        table: The table.
        wanted: Whether distances and angles take part.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    m = table.measurements
    needed = zip(wanted, (m.position, m.rotation), ("x, y, z", ANGLES), strict=True)
    lacking = [columns for use, values, columns in needed if use and values is None]
    if m.pairs is not None:
        pairs = m.pairs
    elif m.groups is not None and lacking:  # contact points suffice
        pairs = no_pairs(m.source)
    elif lacking:
        what = "measured positions" if lacking[0] == "x, y, z" else "orientations"
        raise ProblemError(m.source, f"no columns {lacking[0]}", f"{what} for model {table.model}")
    else:
        pairs = form_pairs(m, table.pairing)
    measured = np.zeros(pairs.n_pairs, dtype=np.bool_)
    for use, kind, source, values, sigma in (
        (wanted[0], "distance", "position", pairs.distance, pairs.sigma_distance),
        (wanted[1], "angle", "orientation", pairs.angle, pairs.sigma_angle),
    ):
        if use and np.any(np.isfinite(values) & ~np.isfinite(sigma)):
            noise = source if m.pairs is None else kind
            raise ProblemError(pairs.source, f"no sigma for {kind}", f"noise.{noise} or a column sigma_{noise}")
        measured |= use & np.isfinite(values)
    return pairs if measured.all() else pairs.select(measured)


class PairGauge(Instrument):
    """Distances and angles between configurations; contact points, where distances take part.

    Args:
        model: Which of them.
        distance: Whether distances take part.
        angle: Whether angles do.
    """

    columns = (
        *POSE_COLUMNS,
        Column(("group",), "", "Which point the configuration touched; empty: none"),
        Column(("sigma_point",), "length", "1 sigma of the touch on each axis"),
    )
    uses_pairs = True

    def __init__(self, model: str, distance: bool, angle: bool) -> None:
        self.model, self.words = model, " and ".join(["distances"] * distance + ["angles"] * angle)
        self.sees_position, self.sees_orientation = distance, angle
        self.noise = ("distance",) * distance + ("angle",) * angle
        self.landmarks = (POINT,) * distance  # type: ignore[misc]

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Distances and angles of pairs; vectors of those whose distance was measured as exactly 0; contacts.

        A directly measured 0 is not a noisy number: it says that both points are one. Where both readings are the same,
        nothing changes the prediction.

        Raises:
            ProblemError: Poses to form pairs from are missing, or a sigma is.
        """
        m, wanted = table.measurements, (self.sees_position, self.sees_orientation)
        formed, pairs = m.pairs is None, usable_pairs(table, wanted)
        values, sigmas = (pairs.distance, pairs.angle), (pairs.sigma_distance, pairs.sigma_angle)
        there = np.stack([np.isfinite(of) & is_wanted for of, is_wanted in zip(values, wanted, strict=True)], axis=1)
        point = there[:, 0] & (values[0] == 0.0) & (not formed)
        there[:, 0] &= ~point
        same = are_same(m.readings, pairs.a, pairs.b)

        def block(kind: Kind, rows: Integers, data: Floats, sigma: Floats, measured: Booleans) -> MeasurementBlock:
            return MeasurementBlock(
                kind=kind,
                table=number,
                ends=np.stack([pairs.a[rows], pairs.b[rows]], axis=1),
                data=data,
                sigma=sigma,
                measured=measured,
                test=pairs.test[rows],
                number=rows.astype(pairs.a.dtype),
                nuisances=np.zeros((len(rows), 0), dtype=np.int64),
                formed=formed,
                excluded={"same_configuration": same[rows]},
                source=pairs.source,
            )

        found, use = list[MeasurementBlock](), [k for k in (0, 1) if wanted[k]]
        rows = np.flatnonzero(there.any(axis=1))
        if len(rows):
            kind = stack(*((Distance(), RotationAngle())[k] for k in use))
            data, sigma = (np.stack([np.nan_to_num(of[k][rows]) for k in use], axis=1) for of in (values, sigmas))
            found.append(block(kind, rows, data, once(np.zeros_like(data) if formed else sigma), there[rows][:, use]))
        rows = np.flatnonzero(point)
        if len(rows):
            sigma = np.repeat(pairs.sigma_distance[rows, None], 3, axis=1)
            found.append(block(SamePoint(), rows, np.zeros((len(rows), 0)), sigma, np.ones((len(rows), 3), np.bool_)))
        return found + (contact_blocks(table, number, landmarks) if self.sees_position else [])

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """The tool point from distances of pairs, or from touches of the same points where none was measured."""
        for block in blocks:
            if block.kind.ends == 2 and block.kind.quantity == "distance" and not block.kind.is_contact:
                rows = np.flatnonzero(block.measured[:, 0] & ~block.test)
                a, b = block.ends[rows].T
                start.tool_from_distances(a, b, block.data[rows, 0])
                return
        for block in blocks:
            if block.kind.ends == 1:
                train = np.flatnonzero(~block.test)
                start.tool_from_contacts(block.ends[train, 0], block.nuisances[train, 0])
                return

    def random_model(self, table: Table) -> str:
        """Positions where contact points are all there is: they cannot be planned. See `Instrument.random_model`."""
        m = table.measurements
        return "position" if m.groups is not None and m.pairs is None and m.position is None else self.model


INSTRUMENTS = (
    PairGauge("distance", distance=True, angle=False),
    PairGauge("rotation", distance=False, angle=True),
    PairGauge("distance-rotation", distance=True, angle=True),
)


def missing_values(table: Table) -> list[str]:
    """A sentence on each quantity that the model uses and no measured pair of a table has: a misspelt column?"""
    pairs, instrument = table.measurements.pairs, next((i for i in INSTRUMENTS if i.model == table.model), None)
    sentences: list[str] = []
    if pairs is None or not pairs.n_pairs or instrument is None:
        return sentences
    for use, name, article, other, values in (
        (instrument.sees_position, "distance", "a", "rotation", pairs.distance),
        (instrument.sees_orientation, "angle", "an", "distance", pairs.angle),
    ):
        if use and np.isnan(values).all():
            unused = f" (columns {', '.join(map(escaped, pairs.unused[:_NAMED]))} are not used)" * bool(pairs.unused)
            found = f"{pairs.source}: no pair has {article} {name}, of which model {table.model} makes use"
            sentences.append(f"{found}; is a column misspelt{unused}? model: {other} says that there is none")
    return sentences
