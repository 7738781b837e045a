"""Contact points: points of unknown place that the tool point touches, and distances measured between them."""

from __future__ import annotations

from typing import Any

import numpy as np

from fg_calib.inputs import ProblemError
from fg_calib.measurements import (
    Coincidence,
    Labels,
    Landmark,
    LandmarkKind,
    Landmarks,
    Length,
    MeasurementBlock,
    Table,
)
from fg_calib.robot import kernels

POINT = LandmarkKind("L", "point", "the unknown contact points", "Contact points (in the base frame), mm")


class SamePoint(Coincidence):
    """`p_B - p_A` in the base frame, up to a rotation, [m]: a distance of zero between configurations.

    Its derivative in a parameter is `dp_B - dp_A` minus `a x (p_B - p_A)`: all vectors may be rotated by one rotation a
    of each column without changing their lengths, so by one that undoes motions of the base.
    """

    ends, turned_back = 2, True
    code = kernels.SAME_POINT


class TouchedPoint(Coincidence):
    """`p - point` in the base frame, up to a rotation as of `SamePoint`, [m]. Nuisances: the point, [m]."""

    names = ("point.x", "point.y", "point.z")
    ends, n_nuisances, turned_back = 1, 3, True


class PointDistance(Length):
    """The distance from one point to another; no configuration takes part.

    Data: the distance, [m]. Nuisances: the points, 6 coordinates, [m].
    """

    ends, n_nuisances = 0, 6


def contact_blocks(table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
    """Contacts, and distances between contact points; those of a point that no train row touched are test rows.

    Raises:
        ProblemError: A sigma is missing.
    """
    m, groups = table.measurements, table.measurements.groups
    if groups is None:
        return []
    rows, pairs = np.flatnonzero(groups.index >= 0), groups.pairs
    sigma = m.sigma_point
    if len(rows) and (sigma is None or not np.isfinite(sigma[rows]).all()):
        raise ProblemError(m.source, "no sigma for touched points", "noise.point or a column sigma_point")
    if not np.isfinite(pairs.sigma_distance).all():
        raise ProblemError(pairs.source, "no sigma for distance", "noise.distance or a column sigma_distance")
    place = landmarks.add([Landmark(POINT, name, np.full(3, np.nan)) for name in groups.names], m.source)
    found = []
    if sigma is not None and len(rows):
        touched, of = groups.index[rows], Labels(groups.names, groups.index[rows])
        arrays = np.zeros((len(rows), 0)), sigma[rows, None], place[touched]
        found.append(MeasurementBlock.of_rows(TouchedPoint(), table, number, rows, *arrays, of=of))
    if pairs.n_pairs:
        between = np.arange(pairs.n_pairs)
        arrays = pairs.distance[:, None], pairs.sigma_distance[:, None], np.hstack([place[pairs.a], place[pairs.b]])
        fields: dict[str, Any] = {
            "ends": np.zeros((pairs.n_pairs, 0), dtype=np.int64),
            "test": pairs.test,
            "source": pairs.source,
        }
        found.append(MeasurementBlock.of_rows(PointDistance(), table, number, between, *arrays, **fields))
    return found
