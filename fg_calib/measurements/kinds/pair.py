"""Distances and angles between configurations, measured directly, or formed from measured poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fg_calib.initialization import FrameStart
from fg_calib.inputs import Floats, ProblemError, escaped, once
from fg_calib.measurements import (
    Frames,
    Kind,
    Landmarks,
    Length,
    MeasurementBlock,
    Measurements,
    Pairs,
    Rows,
    Table,
    are_same,
    directions,
    form_pairs,
    no_pairs,
    stack,
)
from fg_calib.measurements.kinds.contact import POINT, SamePoint, contact_blocks
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Places, Quantity
from fg_calib.measurements.kinds.pose import ORIENTATION, POSE_COLUMNS, POSITION
from fg_calib.robot import Poses, kernels

MAX_NAMED = 5
"""Columns without a meaning that a warning names."""


class Distance(Length):
    """The distance between two configurations' tool points, `u . (dp_B - dp_A)` (Jia et al. 2019, Eq. 5).

    Data: the distance, [m].
    """

    ends = 2
    code = kernels.DISTANCE


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
        sine, k = directions(twice)
        angle = np.arctan2(sine, np.einsum("nij,nij->n", A, B) - 1.0)
        D = np.zeros((len(k), 2, 1, 6))
        D[:, 0, 0, :3], D[:, 1, 0, :3] = -k, k
        return Rows(angle[:, None] - data[:, :1], D)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """With the sign ambiguity of angles at 0 and 180 degrees. See `Kind.simulate`."""
        angle = np.abs(super().simulate(at, data, nuisances, noise))
        return np.pi - np.abs(np.pi - angle)


class PairQuantity(NamedTuple):
    """What is measured between two configurations.

    Attributes:
        name: Field of `Pairs`; with `sigma_` before it, that of its noise.
        kind: What it is.
        pose: What of a measured pose it is formed from.
        other: Model of pairs without it.
    """

    name: str
    kind: Kind
    pose: Quantity
    other: str


PAIR_QUANTITIES = (
    PairQuantity("distance", Distance(), POSITION, "rotation"),
    PairQuantity("angle", RotationAngle(), ORIENTATION, "distance"),
)


def usable_pairs(table: Table, wanted: tuple[bool, bool]) -> Pairs:
    """The pairs of a table with something to use; each measurement has its sigma.

    Args:
        table: The table.
        wanted: Whether distances and angles take part.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    m, quantities = table.measurements, [of for of, use in zip(PAIR_QUANTITIES, wanted, strict=True) if use]
    lacking = [of.pose for of in quantities if m.value(of.pose.field) is None]
    if m.pairs is not None:
        pairs = m.pairs
    elif m.groups is not None and lacking:  # contact points suffice
        pairs = no_pairs(m.source)
    elif lacking:
        raise ProblemError(m.source, f"no columns {lacking[0].columns}", f"{lacking[0].words} for model {table.model}")
    else:
        pairs = form_pairs(m, table.pairing)
    measured = np.zeros(pairs.n_pairs, dtype=np.bool_)
    for of in quantities:
        there = np.isfinite(getattr(pairs, of.name))
        if np.any(there & ~np.isfinite(getattr(pairs, f"sigma_{of.name}"))):
            noise = of.pose.noise if m.pairs is None else of.name
            raise ProblemError(pairs.source, f"no sigma for {of.name}", f"noise.{noise} or a column sigma_{noise}")
        measured |= there
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
        self.landmarks = (POINT,) * distance
        self.quantities = (ORIENTATION,) * angle + (POSITION,) * distance

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Distances and angles of pairs; vectors of those whose distance was measured as exactly 0; contacts.

        A directly measured 0 is not a noisy number: it says that both points are one. Where both readings are the same,
        nothing changes the prediction.

        Raises:
            ProblemError: Poses to form pairs from are missing, or a sigma is.
        """
        m, wanted = table.measurements, (self.sees_position, self.sees_orientation)
        formed, pairs = m.pairs is None, usable_pairs(table, wanted)
        used = [of for of, use in zip(PAIR_QUANTITIES, wanted, strict=True) if use]
        values, sigmas = (np.stack([getattr(pairs, s + of.name) for of in used], axis=1) for s in ("", "sigma_"))
        there = np.isfinite(values)
        point = np.zeros(pairs.n_pairs, dtype=np.bool_)
        if self.sees_position and not formed:
            point = values[:, 0] == 0.0
            there[point, 0] = False
        same, found = are_same(m.readings, pairs.a, pairs.b), list[MeasurementBlock]()
        pair_kind = stack(*(of.kind for of in used))
        for kind, rows in ((pair_kind, np.flatnonzero(there.any(axis=1))), (SamePoint(), np.flatnonzero(point))):
            if not len(rows):
                continue
            of_pairs = kind is pair_kind
            data, sigma = np.nan_to_num(values[rows, : kind.width]), sigmas[rows, : None if of_pairs else 1]
            fields: dict[str, Any] = {
                "ends": np.stack([pairs.a[rows], pairs.b[rows]], axis=1),
                "test": pairs.test[rows],
                "formed": formed,
                "excluded": {"same_configuration": same[rows]},
                "source": pairs.source,
            } | ({"measured": there[rows]} if of_pairs else {})
            sigma = once(np.zeros_like(data) if formed else sigma)
            numbers = rows.astype(pairs.a.dtype)
            found.append(MeasurementBlock.of_rows(kind, table, number, numbers, data, sigma, **fields))
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

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """Pairs are formed from the poses as they are. See `Instrument.predict`."""
        return m

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
    for of in PAIR_QUANTITIES:
        if of.name in instrument.noise and np.isnan(getattr(pairs, of.name)).all():
            unused = ", ".join(map(escaped, pairs.unused[:MAX_NAMED]))
            article, unused = "an" if of.name == "angle" else "a", f" (columns {unused} are not used)" * bool(unused)
            found = f"{pairs.source}: no pair has {article} {of.name}, of which model {table.model} makes use"
            sentences.append(f"{found}; is a column misspelt{unused}? model: {of.other} says that there is none")
    return sentences
