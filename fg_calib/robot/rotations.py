"""Rotations: vectors, yaw-pitch-roll angles, and the Jacobians of SO(3).

References:
    Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics, arXiv:1812.01537.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Floats

UPRIGHT = 1e-14
"""Cosine of a pitch below which roll and yaw rotate about one axis, and the roll counts as a part of the yaw."""

QUARTER_TURN = 1e-9
"""Cosine of a pitch below which angles near given ones share a rotation: what is missed by that is rounding."""


def rotation_vector(rotation: Floats) -> Floats:
    """Rotation vectors of rotation matrices, shape (n, 3), exact near 0, [rad]."""
    return Rotation.from_matrix(rotation).as_rotvec()


def yaw_pitch_roll(rotation: Floats, near: Floats | None = None) -> Floats:
    """Angles with Rz(yaw) Ry(pitch) Rx(roll) = R, exact for every pitch, shape (3,), [rad].

    Near a pitch of a quarter turn roll and yaw rotate about nearly one axis: each is badly determined, and their sum
    well. Whatever the yaw is, the roll is therefore taken from the remainder Rz(-yaw) R = Ry(pitch) Rx(roll).

    Args:
        rotation: R, shape (3, 3).
        near: Of the angles of the same rotation those nearest to these are taken, shape (3,); if None, those with a
            pitch within a quarter turn.
    """
    R = rotation
    level = np.hypot(R[0, 0], R[1, 0])  # cosine of the pitch
    pitch = np.arctan2(-R[2, 0], level)
    if near is not None and level < QUARTER_TURN:  # only the sum or difference of yaw and roll acts: each takes half
        sign = np.sign(R[2, 0])
        off = np.arctan2(-sign * R[0, 1], R[1, 1]) - (near[2] + sign * near[0])
        half = 0.5 * np.remainder(off + np.pi, 2.0 * np.pi) - 0.5 * np.pi
        return np.array([near[0] + sign * half, pitch, near[2] + half])
    yaw = np.arctan2(-R[0, 1], R[1, 1]) if level < UPRIGHT else np.arctan2(R[1, 0], R[0, 0])
    rest = np.cos(yaw) * R[1] - np.sin(yaw) * R[0]  # the second row of the remainder: 0, cos(roll), -sin(roll)
    roll = 0.0 if level < UPRIGHT else np.arctan2(-rest[2], rest[1])
    angles = np.array([yaw, pitch, roll]) + 0.0  # no negative zeros
    if near is None:
        return angles
    same = np.array([angles, [yaw + np.pi, np.pi - pitch, roll + np.pi]])
    same += 2.0 * np.pi * np.round((near - same) / (2.0 * np.pi))
    return np.asarray(same[np.argmin(np.sum((same - near) ** 2, axis=1))])


def rotation_of(yaw: float, pitch: float, roll: float) -> Floats:
    """The matrix Rz(yaw) Ry(pitch) Rx(roll), shape (3, 3); angles in [rad]."""
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


def least_rotation(direction: Floats) -> Floats:
    """The rotation of the least angle that takes z to a unit vector b, shape (3, 3): about an axis square to both.

        1 - bx^2 / (1 + bz)    -bx by / (1 + bz)      bx
        -bx by / (1 + bz)      1 - by^2 / (1 + bz)    by
        -bx                    -by                    bz

    Of b = -z there are many: it is singular there alone, and rounding grows as 1 / (1 + bz).

    Args:
        direction: b, shape (3,).
    """
    x, y, z = direction
    R = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [-x, -y, z]])
    R[:2, :2] -= np.outer((x, y), (x, y)) / (1.0 + z)
    return R


def nearest_rotation(M: Floats) -> Floats:
    """The rotations R nearest to matrices M, shape (..., 3, 3): they maximise trace(R^T M)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def rotation_angle(rotation: Floats) -> tuple[Floats, Floats]:
    """Angle in [0, pi] and axis times its sine of rotation matrices, shapes (n,) and (n, 3)."""
    R = rotation
    axis = 0.5 * np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)
    return np.arctan2(np.linalg.norm(axis, axis=1), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)), axis


def cross_matrix(v: Floats) -> Floats:
    """[v]x with `[v]x w = v x w`, shape (n, 3, 3)."""
    return np.cross(np.eye(3), v[:, None])


def left_jacobian(v: Floats) -> Floats:
    """Jl with `Exp(v + dv) = Exp(Jl dv) Exp(v)` to first order, at vectors of shape (n, 3): shape (n, 3, 3).

    Eq. 145 of Sola et al. (2018); the right Jacobian is its transpose.
    """
    angle = np.maximum(np.linalg.norm(v, axis=1), 1e-8)[:, None, None]
    K = cross_matrix(v) / angle
    out: Floats = np.eye(3) + np.sin(0.5 * angle) ** 2 / (0.5 * angle) * K + (1.0 - np.sinc(angle / np.pi)) * (K @ K)
    return out


def inverse_right_jacobian(v: Floats) -> Floats:
    """`1 + [v]x / 2 + g [v]x^2` at rotation vectors, shape (n, 3): shape (n, 3, 3).

    Eq. 144 of Sola et al. (2018); its transpose is the inverse of the left Jacobian.
    """
    angle = np.linalg.norm(v, axis=1)
    half = 0.5 * np.maximum(angle, 1e-4)
    g = np.where(angle < 1e-4, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    cross = cross_matrix(v)
    return np.asarray(np.eye(3) + 0.5 * cross + g[:, None, None] * (cross @ cross))
