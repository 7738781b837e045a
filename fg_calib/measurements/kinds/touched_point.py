"""A point of unknown place that the tool point touches."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows


class TouchedPoint(Kind):
    """`p - point` in the base frame, up to a rotation, [m]; its derivative is `dp - dpoint`.

    In a parameter it is less `a x (p - point)`, as that of `SamePoint`, with a column's rotation a.

    Data: none. Nuisances: the point, 3 coordinates, [m].
    """

    names, units = ("point.x", "point.y", "point.z"), ("m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 3, 0, 3
    turned_back = True

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        n = len(nuisances)
        D = np.zeros((n, 1, 3, 6))
        D[:, 0, :, 3:] = np.eye(3)
        return Rows(at.position[:, 0] - nuisances, D, np.tile(-np.eye(3), (n, 1, 1)))
