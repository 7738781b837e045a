"""Position of a target somewhere on the tool."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot.rotations import cross_matrix


class TargetPosition(Kind):
    """`p + R t - measured` in the frame that the chain starts in, [m]; its derivative is `dp + w x R t + R dt`.

    Data: the position, 3 columns, [m]. Nuisances: the target t in the tool frame, 3 coordinates, [m].
    """

    names, units = ("position.x", "position.y", "position.z"), ("m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 3, 3, 3

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R = at.rotation[:, 0]
        arm = np.einsum("nij,nj->ni", R, nuisances)
        D = np.zeros((len(data), 1, 3, 6))
        D[:, 0, :, :3], D[:, 0, :, 3:] = -cross_matrix(arm), np.eye(3)
        return Rows(at.position[:, 0] + arm - data[:, :3], D, R)
