"""The tool point at a point in the room."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows


class AnchorContact(Kind):
    """`p - a` in the frame that the chain starts in, [m]: a distance of zero, which has no direction.

    Data: none. Nuisances: the anchor a, 3 coordinates, [m].
    """

    names, units = ("distance.x", "distance.y", "distance.z"), ("m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 3, 0, 3

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        n = len(nuisances)
        D = np.zeros((n, 1, 3, 6))
        D[:, 0, :, 3:] = np.eye(3)
        return Rows(at.position[:, 0] - nuisances, D, np.tile(-np.eye(3), (n, 1, 1)))
