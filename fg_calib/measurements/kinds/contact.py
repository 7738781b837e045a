"""Contact points: points of unknown place that the tool point touches, and distances measured between them."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import Floats, ProblemError
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.kind import Frames, Kind, Rows, between
from fg_calib.measurements.landmarks import LandmarkKind, Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table

POINT = LandmarkKind(
    "L", "point", "the unknown contact points", "Contact points (in the base frame), mm", must_be_fitted=False
)


class Contact(Kind):
    """`p - point`, [m]; its derivative is `dp - dpoint`."""

    units = ("m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 3, 0, 3
    is_contact = True

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        n = len(nuisances)
        D = np.zeros((n, 1, 3, 6))
        D[:, 0, :, 3:] = np.eye(3)
        return Rows(at.position[:, 0] - nuisances, D, np.tile(-np.eye(3), (n, 1, 1)))


class TouchedPoint(Contact):
    """`p - point` in the base frame, up to a rotation, [m].

    In a parameter its derivative is minus `a x (p - point)`, as that of `SamePoint`, with a column's rotation a.

    Data: none. Nuisances: the point, 3 coordinates, [m].
    """

    names = ("point.x", "point.y", "point.z")
    turned_back = True


class PointDistance(Kind):
    """`|b - a| - measured`, [m]; its derivative is `u . (db - da)`, u from a to b. No configuration takes part.

    Data: the distance, [m]. Nuisances: the points a and b, 6 coordinates, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width, n_nuisances = 0, 1, 1, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, u = between(nuisances[:, :3], nuisances[:, 3:])
        N = np.concatenate([-u, u], axis=1)[:, None]
        return Rows(length[:, None] - data[:, :1], np.zeros((len(u), 0, 1, 6)), N)


def contact_blocks(table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
    """Contacts, and distances between contact points; those of a point that no train row touched are test rows.

    Raises:
        ProblemError: A sigma is missing.
    """
    m = table.measurements
    groups = m.groups
    if groups is None:
        return []
    rows = np.flatnonzero(groups.index >= 0)
    if len(rows) and (m.sigma_point is None or not np.isfinite(m.sigma_point[rows]).all()):
        raise ProblemError(m.source, "no sigma for touched points", "noise.point or a column sigma_point")
    pairs = groups.pairs
    if not np.isfinite(pairs.sigma_distance).all():
        raise ProblemError(pairs.source, "no sigma for distance", "noise.distance or a column sigma_distance")
    place = landmarks.add(POINT, groups.names, np.full((groups.n_groups, 3), np.nan), m.source)
    found = []
    if len(rows):
        assert m.sigma_point is not None
        sigma = np.repeat(m.sigma_point[rows, None], 3, axis=1)
        of = Labels(groups.names, groups.index[rows])
        where = place[groups.index[rows]]
        found.append(
            MeasurementBlock.of_rows(
                TouchedPoint(), table, number, rows, np.zeros((len(rows), 0)), sigma, nuisances=where, of=of
            )
        )
    if pairs.n_pairs:
        found.append(
            MeasurementBlock(
                kind=PointDistance(),
                table=number,
                ends=np.zeros((pairs.n_pairs, 0), dtype=np.int64),
                data=np.ascontiguousarray(pairs.distance[:, None]),
                sigma=pairs.sigma_distance[:, None],
                measured=np.ones((pairs.n_pairs, 1), dtype=np.bool_),
                test=pairs.test,
                number=np.arange(pairs.n_pairs),
                nuisances=np.hstack([place[pairs.a], place[pairs.b]]),
                source=pairs.source,
            )
        )
    return found
