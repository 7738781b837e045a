"""One point touched in two configurations."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot import kernels


class SamePoint(Kind):
    """`p_B - p_A` in the base frame, up to a rotation, [m]: a distance of zero, which has no direction.

    Its derivative is `dp_B - dp_A`; in a parameter less `a x (p_B - p_A)`: all vectors may be turned by one rotation a
    of each column without changing their lengths, so by one that undoes motions of the base.

    Data: none.
    """

    names, units = ("distance.x", "distance.y", "distance.z"), ("m", "m", "m")
    ends, residual_dim, width = 2, 3, 0
    turned_back = True
    code = kernels.SAME_POINT

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        D = np.zeros((len(data), 2, 3, 6))
        D[:, 0, :, 3:], D[:, 1, :, 3:] = -np.eye(3), np.eye(3)
        return Rows(at.position[:, 1] - at.position[:, 0], D)
