"""Orientation of the tool frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows, cross_matrix
from fg_calib.robot import kernels


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


def inverse_right_jacobian(r: Floats) -> Floats:
    """`1 + [r]x / 2 + g [r]x^2` at rotation vectors, shape (n, 3): shape (n, 3, 3)."""
    angle = np.linalg.norm(r, axis=1)
    half = 0.5 * np.maximum(angle, 1e-4)
    g = np.where(angle < 1e-4, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    cross = cross_matrix(r)
    out: Floats = np.eye(3) + 0.5 * cross + g[:, None, None] * (cross @ cross)
    return out
