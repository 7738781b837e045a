"""Distances and angles between configurations, measured or formed from measured poses; contact points."""

from typing import Any, NamedTuple

import numpy as np

from fg_calib import measurements
from fg_calib.initialization import FrameStart
from fg_calib.inputs import PAIR_MODELS, Floats, ProblemError, once
from fg_calib.measurements import Coincidence, Kind, Landmarks, Length, MeasurementBlock, Measurements, Rows, Table
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Places, Quantity
from fg_calib.measurements.kinds.pose import ORIENTATION, POSE_COLUMNS, POSITION
from fg_calib.robot import Poses, kernels, over_spans

POINT = measurements.LandmarkKind(
    "L", "point", "Contact points (in the base frame), mm", "the unknown contact points", must_be_fitted=False
)


class SamePoint(Coincidence):
    """`p_B - p_A` in the base frame, up to a rotation, [m]: a distance of zero between configurations.

    Its derivative in a parameter is `dp_B - dp_A - a x (p_B - p_A)`: a common rotation a changes no length, so each
    column has the one that cancels motions of the base.
    """

    ends, turned_back = 2, True


class TouchedPoint(Coincidence):
    """`p - point` in the base frame, up to a rotation as of `SamePoint`, [m]. Nuisances: the point, [m]."""

    names = ("point.x", "point.y", "point.z")
    ends, n_nuisances, turned_back = 1, 3, True


class PointDistance(Length):
    """The distance from one point to another; no configuration takes part.

    Data: the distance, [m]. Nuisances: the points, 6 coordinates, [m].
    """

    ends, n_nuisances = 0, 6


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

    def rows(self, at: measurements.Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        A, B = at.rotation[:, 0], at.rotation[:, 1]
        twice = np.cross(A, B, axis=1).sum(axis=2)  # 2 k sin(angle), (n, 3)
        sine, k = measurements.directions(twice)
        angle = np.arctan2(sine, np.einsum("nij,nij->n", A, B) - 1.0)
        D = np.zeros((len(k), 2, 1, 6))
        D[:, 0, 0, :3], D[:, 1, 0, :3] = -k, k
        return Rows(angle[:, None] - data[:, :1], D)


class PairQuantity(NamedTuple):
    """A quantity measured between two configurations.

    Attributes:
        name: Field of `Pairs`; with `sigma_` before it, that of its noise.
        kind: Kind of measurement.
        pose: Part of a measured pose that it is formed from.
        other: The model of pairs of the other quantity alone.
    """

    name: str
    kind: Kind
    pose: Quantity
    other: str


PAIR_QUANTITIES = (
    PairQuantity("distance", Distance(), POSITION, "rotation"),
    PairQuantity("angle", RotationAngle(), ORIENTATION, "distance"),
)


def quantities_of(model: str | None) -> list[PairQuantity]:
    """The quantities of pairs that a model uses."""
    wanted = PAIR_MODELS.get(model or "", (False, False))
    return [of for of, use in zip(PAIR_QUANTITIES, wanted, strict=True) if use]


def usable_pairs(table: Table) -> measurements.Pairs:
    """The pairs of a table with something to use; each measurement has its sigma.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    m, quantities = table.measurements, quantities_of(table.model)
    lacking = [of.pose for of in quantities if m.value(of.pose.field) is None]
    if m.pairs is not None:
        pairs = m.pairs
    elif m.groups is not None and lacking:  # contact points suffice
        pairs = measurements.no_pairs(m.source)
    elif lacking:
        raise ProblemError(m.source, f"no columns {lacking[0].columns}", f"{lacking[0].words} for model {table.model}")
    else:
        pairs = measurements.form_pairs(m, table.pairing)
    measured = np.zeros(pairs.n_pairs, dtype=np.bool_)
    for of in quantities:
        there = np.isfinite(getattr(pairs, of.name))
        if np.any(there & ~np.isfinite(getattr(pairs, f"sigma_{of.name}"))):
            noise = of.pose.noise if m.pairs is None else of.name
            raise ProblemError(pairs.source, f"no sigma for {of.name}", f"noise.{noise} or a column sigma_{noise}")
        measured |= there
    return pairs if measured.all() else pairs.select(measured)


def missing_values(table: Table) -> list[str]:
    """A sentence on each quantity that the model needs and no measured pair of a table has."""
    pairs = table.measurements.pairs
    there = pairs is not None and pairs.n_pairs > 0  # none of a table of contact points
    lacking = [of for of in quantities_of(table.model) if there and np.isnan(getattr(pairs, of.name)).all()]
    of_table = f"{table.measurements.source}: no pair has a value of"
    return [f"{of_table} {of.name}; is a column misspelt? model: {of.other} needs none" for of in lacking]


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
    labels, uses_pairs = ("station",), True

    def __init__(self, model: str, distance: bool, angle: bool) -> None:
        self.model, self.words = model, " and ".join(["distances"] * distance + ["angles"] * angle)
        self.sees_position, self.sees_orientation = distance, angle
        self.noise = tuple(of.name for of in quantities_of(model))
        self.landmarks, self.options = (POINT,) * distance, ("group",) * distance
        self.quantities = (ORIENTATION,) * angle + (POSITION,) * distance

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Distances and angles of pairs; vectors of those whose distance was measured as exactly 0; contacts.

        A distance that was measured as exactly 0 says that both points are one. Pairs of equal readings depend on no
        parameter.

        Raises:
            ProblemError: Poses to form pairs from are missing, or a sigma is.
        """
        q, formed, pairs = table.measurements.readings, table.measurements.pairs is None, usable_pairs(table)
        used, found = quantities_of(self.model), list[MeasurementBlock]()
        values, sigmas = (np.stack([getattr(pairs, s + of.name) for of in used], axis=1) for s in ("", "sigma_"))
        there = np.isfinite(values)
        point = (values[:, 0] == 0.0) & (self.sees_position and not formed)
        there[point, 0] = False
        spans = over_spans(lambda i, j: np.all(q[pairs.a[i:j]] == q[pairs.b[i:j]], axis=1), pairs.n_pairs)
        same = np.concatenate([np.zeros(0, dtype=np.bool_), *spans])
        for kind, chosen in ((measurements.stack(*(of.kind for of in used)), there.any(axis=1)), (SamePoint(), point)):
            rows = np.flatnonzero(chosen)
            if not len(rows):
                continue
            data, sigma = np.nan_to_num(values[rows, : kind.width]), sigmas[rows, : max(1, kind.width)]
            ends, excluded = np.stack([pairs.a[rows], pairs.b[rows]], axis=1), {"same_configuration": same[rows]}
            fields: dict[str, Any] = {"ends": ends, "test": pairs.test[rows], "formed": formed, "excluded": excluded}
            fields |= {"source": pairs.source} | ({"measured": there[rows]} if kind.width else {})
            sigma = once(np.zeros_like(data) if formed else sigma)
            found.append(MeasurementBlock.of_rows(kind, number, rows.astype(pairs.a.dtype), data, sigma, **fields))
        return found + (contact_blocks(table, number, landmarks) if self.sees_position else [])

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """The tool point from distances of pairs, or from touches of the same points where none was measured."""
        for block in sorted(blocks, key=lambda block: -block.kind.ends):
            train = np.flatnonzero(block.measured[:, 0] & ~block.test)
            if block.kind.ends == 2 and block.kind.quantity == "distance" and not block.kind.is_contact:
                start.tool_from_distances(block.ends[train], block.data[train, 0])
                break
            if block.kind.ends == 1:
                start.tool_from_contacts(block.ends[train, 0], block.nuisances[train, 0])
                break

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """Pairs are formed from the poses as they are. See `Instrument.predict`."""
        return m

    def random_model(self, table: Table) -> str:
        """Positions where contact points are all there is: they cannot be planned. See `Instrument.random_model`."""
        m = table.measurements
        return "position" if m.groups is not None and m.pairs is None and m.position is None else self.model


def contact_blocks(table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
    """Contacts, and distances between contact points.

    Raises:
        ProblemError: A sigma is missing.
    """
    m, groups = table.measurements, table.measurements.groups
    if groups is None:
        return []
    found, rows, pairs = list[MeasurementBlock](), np.flatnonzero(groups.index >= 0), groups.pairs
    place = landmarks.add([measurements.Landmark(POINT, name, np.full(3, np.nan)) for name in groups.names], m.source)
    if len(rows):
        if (sigma := m.sigma("point")) is None or not np.isfinite(sigma[rows]).all():
            raise ProblemError(m.source, "no sigma for contact points", "noise.point or a column sigma_point")
        touched = groups.index[rows]
        of = measurements.Labels(groups.names, touched)
        fields: dict[str, Any] = {"nuisances": place[touched], "of": of, "source": m.source}
        arrays = rows, np.zeros((len(rows), 0)), sigma[rows, None]
        found.append(MeasurementBlock.of_rows(TouchedPoint(), number, *arrays, test=m.test[rows], **fields))
    if n := pairs.n_pairs:
        if not np.isfinite(pairs.sigma_distance).all():
            raise ProblemError(pairs.source, "no sigma for distance", "noise.distance or a column sigma_distance")
        fields = {"ends": np.zeros((n, 0), dtype=np.int64), "nuisances": np.hstack([place[pairs.a], place[pairs.b]])}
        arrays = np.arange(n), pairs.distance[:, None], pairs.sigma_distance[:, None]
        fields |= {"test": pairs.test, "source": pairs.source}
        found.append(MeasurementBlock.of_rows(PointDistance(), number, *arrays, **fields))
    return found


INSTRUMENTS = tuple(PairGauge(model, *wanted) for model, wanted in PAIR_MODELS.items())
