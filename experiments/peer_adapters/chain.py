"""An arm's tool poses and their derivatives in numpy alone, for all configurations at once; nothing of fg_calib.

An arm is a list of elementary transforms, each along or about one axis of the frame that moves with it: base x y z yaw
pitch roll, of each joint a alpha d theta beta (Craig's modified DH, with Hayati's angle), tool x y z yaw pitch roll.
"""

from __future__ import annotations

import numpy as np

FRAME = ((0, "x"), (0, "y"), (0, "z"), (1, "z"), (1, "y"), (1, "x"))
JOINT = ((0, "x"), (1, "x"), (0, "z"), (1, "z"), (1, "y"))
THETA = 3
"""Turning or not, and the axis, of the transforms of a frame and of a joint; the joint's reading is added to theta."""


GRAVITY = np.array([0.0, 0.0, -9.81])
"""In the base frame, [m/s^2]."""

NO_MASSES = np.empty((0, 5))


def elements(n_joints: int) -> list[tuple[int, int, int]]:
    """Whether it turns, its axis, and the joint whose reading is added or -1, of each transform."""
    chain = [(turns, "xyz".index(axis), -1) for turns, axis in FRAME]
    for joint in range(n_joints):
        for i, (turns, axis) in enumerate(JOINT):
            chain.append((turns, "xyz".index(axis), joint if i == THETA else -1))
    return chain + [(turns, "xyz".index(axis), -1) for turns, axis in FRAME]


def forward(values: np.ndarray, q: np.ndarray, wanted: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Tool positions (n, 3) [m] and rotations (n, 3, 3); with `wanted` also derivatives of both in these values.

    Args:
        values: Of all transforms, shape (12 + 5 n_joints,), [m] and [rad].
        q: Joint readings, shape (n, n_joints), [rad].
        wanted: Which values to differentiate in, shape (12 + 5 n_joints,), bool.

    Returns:
        Position, rotation, and with `wanted` the shift of the tool point and the turn of the tool, both along axes of
        the frame that `values` starts from, shape (n, 3, n_wanted) each.
    """
    n = len(q)
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    axes, origins = [], []
    for k, (turns, axis, joint) in enumerate(elements(q.shape[1])):
        if wanted is not None and wanted[k]:
            axes.append((turns, R[:, :, axis].copy()))
            origins.append(p)
        if not turns:
            p = p + values[k] * R[:, :, axis]
            continue
        angle = values[k] + (q[:, joint] if joint >= 0 else 0.0)
        c, s = np.cos(angle), np.sin(angle)
        b, d = (axis + 1) % 3, (axis + 2) % 3
        x, y = R[:, :, b], R[:, :, d]
        turned = R.copy()
        turned[:, :, b] = np.reshape(c, (-1, 1)) * x + np.reshape(s, (-1, 1)) * y
        turned[:, :, d] = np.reshape(c, (-1, 1)) * y - np.reshape(s, (-1, 1)) * x
        R = turned
    if wanted is None:
        return p, R
    shift, turn = np.zeros((n, 3, len(axes))), np.zeros((n, 3, len(axes)))
    for k, ((turns, u), o) in enumerate(zip(axes, origins, strict=True)):
        shift[:, :, k] = np.cross(u, p - o) if turns else u
        if turns:
            turn[:, :, k] = u
    return p, R, shift, turn


def gravity_torques(values: np.ndarray, q: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Torque of gravity about each joint, the sum of m g . dx/dq_i, shape (n, n_joints), [N m].

    Args:
        values: See `forward`.
        q: Joint positions, shape (n, n_joints), [rad].
        masses: Joint that moves it from 1, mass [kg], x, y, z in that joint's frame [m], shape (n_masses, 5).
    """
    torques = np.zeros(q.shape)
    for joint, mass, *at in masses:
        n = int(joint)
        wanted = np.array([joint >= 0 for _, _, joint in elements(n)])
        shift = forward(np.concatenate([values[: 6 + 5 * n], at, np.zeros(3)]), q[:, :n], wanted)[2]
        torques[:, :n] += mass * GRAVITY @ shift
    return torques


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Of rotations by less than half a turn, shape (n, 3), [rad]."""
    w = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    s = np.linalg.norm(w, axis=1)
    angle = np.arctan2(s, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    return w * np.where(s > 1e-9, angle / np.maximum(s, 1e-9), 1.0)[:, None]


def residuals(values: np.ndarray, work: dict, wanted: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Predicted minus measured over sigma, and with `wanted` its derivatives.

    Poses: position along the axes of the measurement frame, then the small turn from the measured to the predicted
    orientation about the tool's axes (its derivative to first order in that turn). Pairs: the signed distance.

    Args:
        values: See `forward`.
        work: One draw of a work (see `works`).
        wanted: See `forward`.

    Returns:
        Shape (n_rows,), and with `wanted` (n_rows, n_wanted).
    """
    p, R, *derivatives = forward(values, work["q"], wanted)
    sigma = work["sigma"]
    if work["kind"] == "distance":
        a, b = work["a"], work["b"]
        step = p[b] - p[a]
        length = np.linalg.norm(step, axis=1)
        r = (length - work["distance"]) / sigma[0]
        if wanted is None:
            return (r,)
        shift = derivatives[0]
        return r, np.einsum("ni,nik->nk", step / length[:, None], shift[b] - shift[a]) / sigma[0]
    turned = rotation_vector(np.swapaxes(work["rotation"], 1, 2) @ R)
    r = np.concatenate([((p - work["position"]) / sigma[0]).ravel(), (turned / sigma[1]).ravel()])
    if wanted is None:
        return (r,)
    shift, turn = derivatives
    about_tool = np.swapaxes(R, 1, 2) @ turn
    about_tool += 0.5 * np.cross(turned[:, :, None], about_tool, axis=1)
    k = shift.shape[2]
    return r, np.concatenate([shift.reshape(-1, k) / sigma[0], about_tool.reshape(-1, k) / sigma[1]])


def frame_matrix(values: np.ndarray) -> np.ndarray:
    """A frame from its x y z yaw pitch roll, shape (4, 4)."""
    p, R = forward(np.concatenate([values, np.zeros(6)]), np.zeros((1, 0)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R[0], p[0]
    return T


def urdf(values: np.ndarray, masses: np.ndarray = NO_MASSES) -> str:
    """The arm as a URDF: joint i turns about z of its origin; base before the first joint, tool as a fixed last one.

    Its links have inertials where there are `masses` (see `gravity_torques`).
    """
    n_joints = (len(values) - 12) // 5
    rows = values[6:-6].reshape(n_joints, 5)
    before = frame_matrix(values[:6])
    lines = ['<robot name="arm">', '<link name="base"/>']
    for i, row in enumerate(rows):
        link = {"a": row[0], "alpha": row[1], "d": row[2], "theta": row[3]}
        x, y = np.eye(4), np.eye(4)
        x[0, 3], y[2, 3] = link["a"], link["d"]
        x[1:3, 1:3] = _turn(link["alpha"])
        y[:2, :2] = _turn(link["theta"])
        parent = f"link{i}" if i else "base"
        lines.append(f'<link name="link{i + 1}">{_inertial(masses[masses[:, 0] == i + 1])}</link>')
        lines.append(_joint(f"q{i + 1}", "revolute", parent, f"link{i + 1}", before @ x @ y))
        before = np.eye(4)
        before[0, 0] = before[2, 2] = np.cos(row[4])
        before[0, 2], before[2, 0] = np.sin(row[4]), -np.sin(row[4])
    tool = before @ frame_matrix(values[-6:])
    lines += ['<link name="tool"/>', _joint("tool_joint", "fixed", f"link{n_joints}", "tool", tool), "</robot>"]
    return "\n".join(lines) + "\n"


def _turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _inertial(masses: np.ndarray) -> str:
    if not len(masses):
        return ""
    at = " ".join(f"{x:.17g}" for x in np.average(masses[:, 2:], axis=0, weights=masses[:, 1]))
    inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'  # poses at rest do not feel it
    return f'<inertial><origin xyz="{at}"/><mass value="{masses[:, 1].sum():.17g}"/>{inertia}</inertial>'


def _joint(name: str, kind: str, parent: str, child: str, T: np.ndarray) -> str:
    xyz = " ".join(f"{x:.17g}" for x in T[:3, 3])
    rpy = " ".join(f"{x:.17g}" for x in roll_pitch_yaw(T[None, :3, :3])[0])
    turning = '<axis xyz="0 0 1"/><limit lower="-7" upper="7" effort="1" velocity="1"/>' if kind == "revolute" else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{turning}</joint>'
    )


def roll_pitch_yaw(R: np.ndarray) -> np.ndarray:
    """Of Rz(yaw) Ry(pitch) Rx(roll), shape (n, 3), [rad]."""
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 0, 0], R[:, 1, 0]))
    return np.stack([np.arctan2(R[:, 2, 1], R[:, 2, 2]), pitch, np.arctan2(R[:, 1, 0], R[:, 0, 0])], axis=1)
