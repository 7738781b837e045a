"""Pose of a board in the room, as a camera on the tool sees it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot.rotations import cross_matrix, inverse_right_jacobian, left_jacobian


class BoardPose(Kind):
    """Camera_T_board, predicted less measured, along and about the camera's axes, where its noise arises.

    With R, p the camera, B = Exp(v), b the board: `Log(R^T B M^T)`, [rad], and `R^T (b - p) - m`, [m]. A turn w and a
    shift dp of the camera change the first by `-Jl^-1 R^T w`, the second by `R^T ((b - p) x w - dp)`; the board's
    coordinates by `Jl^-1 R^T Jl(v) dv` and `R^T db`.

    Data: M row by row, then m, 12 columns. Nuisances: v, [rad], and b, [m], in the frame that the chain starts in.
    """

    names = ("orientation.x", "orientation.y", "orientation.z", "position.x", "position.y", "position.z")
    units = ("rad", "rad", "rad", "m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 6, 12, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T, v = np.swapaxes(at.rotation[:, 0], 1, 2), nuisances[:, :3]
        B, step = Rotation.from_rotvec(v).as_matrix(), nuisances[:, 3:] - at.position[:, 0]
        M = data[:, :9].reshape(-1, 3, 3)
        r = Rotation.from_matrix(R_T @ B @ np.swapaxes(M, 1, 2)).as_rotvec()
        shift = np.einsum("nij,nj->ni", R_T, step) - data[:, 9:12]
        turned = np.swapaxes(inverse_right_jacobian(r), 1, 2) @ R_T  # Jl^-1 is the transpose of Jr^-1
        D = np.zeros((len(r), 1, 6, 6))
        D[:, 0, :3, :3] = -turned
        D[:, 0, 3:, :3], D[:, 0, 3:, 3:] = R_T @ cross_matrix(step), -R_T
        N = np.zeros((len(r), 6, 6))
        N[:, :3, :3], N[:, 3:, 3:] = turned @ left_jacobian(v), R_T
        return Rows(np.concatenate([r, shift], axis=1), D, N)
