"""The tool point on flat faces, or at measured distances from them."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds import PlaneDistance
from fg_calib.measurements.models.common import labels_of, stated
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.robot.model import Robot


def plane_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Distances from planes; 0, on the plane, where no column says them.

    Raises:
        ProblemError: A column or a sigma is missing.
    """
    m = table.measurements
    labels = labels_of(table, "plane")
    distance = np.zeros(m.n_configurations) if m.length is None else m.length
    rows = np.flatnonzero((labels.index >= 0) & np.isfinite(distance))
    sigma = stated(table, m.sigma_length, "distance", rows)
    nowhere = np.full((len(labels.names), 3), np.nan)  # see `starts`
    behind = unknowns.add("C", labels.names, nowhere, m.source, known=[True] * len(labels.names))
    place = unknowns.add("F", labels.names, nowhere, m.source)
    index = labels.index[rows]
    return [
        Series(
            kind=PlaneDistance(),
            table=number,
            ends=rows[:, None],
            data=np.ascontiguousarray(distance[rows, None]),
            sigma=sigma[:, None],
            measured=np.ones((len(rows), 1), dtype=np.bool_),
            test=m.test[rows],
            number=rows,
            nuisances=np.hstack([behind[index], place[index]]),
            source=m.source,
            of=labels.of(rows),
        )
    ]
