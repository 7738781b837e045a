"""Distance between the tool points of two configurations."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows, between
from fg_calib.robot import kernels


class Distance(Kind):
    """`|p_B - p_A| - measured`, [m]; its derivative is `u . (dp_B - dp_A)`, u from A to B (Jia et al. 2019, Eq. 5).

    Data: the distance, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width = 2, 1, 1
    code = kernels.DISTANCE

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, u = between(at.position[:, 0], at.position[:, 1])
        D = np.zeros((len(u), 2, 1, 6))
        D[:, 0, 0, 3:], D[:, 1, 0, 3:] = -u, u
        return Rows(length[:, None] - data[:, :1], D)
