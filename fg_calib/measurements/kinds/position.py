"""Position of the tool point."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot import kernels


class Position(Kind):
    """`p - measured` in the frame that the chain starts in, [m]; its derivative is `dp`.

    Data: the position, 3 columns, [m].
    """

    names, units = ("position.x", "position.y", "position.z"), ("m", "m", "m")
    ends, residual_dim, width = 1, 3, 3
    code = kernels.POSITION

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        D = np.zeros((len(data), 1, 3, 6))
        D[:, 0, :, 3:] = np.eye(3)
        return Rows(at.position[:, 0] - data[:, :3], D)
