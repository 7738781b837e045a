"""Orientation of the tool frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot import kernels
from fg_calib.robot.rotations import inverse_right_jacobian


class Orientation(Kind):
    """`r = Log(R_measured^T R)`, the rotation vector in the tool frame, [rad]; its derivative is `Jr^-1(r) R^T w`.

    Jr is the right Jacobian of SO(3) (Sola et al. 2018, Eq. 144).

    Data: the rotation matrix in the frame that the chain starts in, row by row, 9 columns.
    """

    names, units = ("orientation.x", "orientation.y", "orientation.z"), ("rad", "rad", "rad")
    ends, residual_dim, width = 1, 3, 9
    code = kernels.ORIENTATION

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T = np.swapaxes(at.rotation[:, 0], 1, 2)
        r = -Rotation.from_matrix(R_T @ data[:, :9].reshape(-1, 3, 3)).as_rotvec()
        D = np.zeros((len(r), 1, 3, 6))
        D[:, 0, :, :3] = inverse_right_jacobian(r) @ R_T
        return Rows(r, D)
