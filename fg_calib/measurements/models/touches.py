"""Points of unknown place that the tool point touched, and distances between them."""

from __future__ import annotations

import numpy as np

from fg_calib.errors import ProblemError
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.kinds import PointDistance, TouchedPoint
from fg_calib.measurements.series import Series, Table, Unknowns


def touch_series(table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Touches, and distances between the points that they touched.

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
    place = unknowns.add("L", groups.names, np.full((groups.n_groups, 3), np.nan), m.source)
    sigma = np.zeros(0) if m.sigma_point is None else m.sigma_point[rows]
    touches = Series(
        kind=TouchedPoint(),
        table=number,
        ends=rows[:, None],
        data=np.zeros((len(rows), 0)),
        sigma=np.repeat(sigma[:, None], 3, axis=1),
        measured=np.ones((len(rows), 3), dtype=np.bool_),
        test=m.test[rows],
        number=rows,
        nuisances=place[groups.index[rows]],
        source=m.source,
        of=Labels(groups.names, groups.index[rows]),
    )
    found = [touches] if len(rows) else []
    if not pairs.n_pairs:
        return found
    between = Series(
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
    return [*found, between]
