"""Distance between two points of unknown place."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows, between


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
