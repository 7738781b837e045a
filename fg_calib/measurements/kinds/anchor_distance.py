"""Distance from the tool point to a point in the room: a ball bar, a wire."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows, between


class AnchorDistance(Kind):
    """`|p - a| + offset - measured`, [m]; its derivative is `u . (dp - da) + doffset`, u from the anchor a to p.

    Data: the length, [m]. Nuisances: the anchor in the frame that the chain starts in, and what the instrument adds to
    every length, 4 coordinates, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 4

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, u = between(nuisances[:, :3], at.position[:, 0])
        D = np.zeros((len(u), 1, 1, 6))
        D[:, 0, 0, 3:] = u
        N = np.concatenate([-u, np.ones((len(u), 1))], axis=1)[:, None]
        return Rows((length + nuisances[:, 3])[:, None] - data[:, :1], D, N)
