"""Distance of the tool point from a plane in the room."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows, between


class PlaneDistance(Kind):
    """`n . (p - f) - measured`, [m]; its derivative is `n . dp` and, in f, `(p - f) . (1 - n n^T) / |f - c| - n`.

    The plane goes through its point f across the unit normal n, which points there from a point c away from the plane:
    three coordinates that may be any, where a normal and a distance would be four that may not.

    Data: the distance on the side that n points to, [m]. Nuisances: c and f in the frame that the chain starts in, 6
    coordinates, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, n = between(nuisances[:, :3], nuisances[:, 3:])
        step = at.position[:, 0] - nuisances[:, 3:]
        height = np.einsum("ni,ni->n", n, step)
        D = np.zeros((len(n), 1, 1, 6))
        D[:, 0, 0, 3:] = n
        tilt = (step - height[:, None] * n) / length[:, None]
        N = np.concatenate([-tilt, tilt - n], axis=1)[:, None]
        return Rows(height[:, None] - data[:, :1], D, N)
