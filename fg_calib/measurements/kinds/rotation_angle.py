"""Rotation angle between the tool frames of two configurations."""

from __future__ import annotations

import numpy as np

from fg_calib.measurements.kinds.kind import Floats, Frames, Kind, Rows
from fg_calib.robot import kernels


class RotationAngle(Kind):
    """`angle(R_A^T R_B) - measured`, in [0, pi], [rad]; its derivative is `k . (w_B - w_A)` (Jia et al. 2019, Eq. 21).

    k is the unit axis of R_B R_A^T: half the sum over columns of `R_A[:, c] x R_B[:, c]` is `k sin(angle)`.

    Data: the angle, [rad].
    """

    names, units = ("angle",), ("rad",)
    ends, residual_dim, width = 2, 1, 1
    code = kernels.ROTATION_ANGLE

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        A, B = at.rotation[:, 0], at.rotation[:, 1]
        twice = np.cross(A, B, axis=1).sum(axis=2)  # 2 k sin(angle), (n, 3)
        sine = np.linalg.norm(twice, axis=1)
        angle = np.arctan2(sine, np.einsum("nij,nij->n", A, B) - 1.0)
        k = twice / np.maximum(sine, 1e-300)[:, None]
        D = np.zeros((len(k), 2, 1, 6))
        D[:, 0, 0, :3], D[:, 1, 0, :3] = -k, k
        return Rows(angle[:, None] - data[:, :1], D)
