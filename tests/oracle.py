"""Independent formulas that the tests hold the package to: 4x4 products, central differences, random robots."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.robot.model import CONVENTIONS, Joint, Robot, RobotBuilder

Floats = NDArray[np.float64]


_IDENTITY = np.eye(4)


def translation(axis: int, value: float) -> Floats:
    T = _IDENTITY.copy()
    T[axis, 3] = value
    return T


def rotation(axis: int, value: float) -> Floats:
    T = _IDENTITY.copy()
    i, j = (axis + 1) % 3, (axis + 2) % 3  # it turns i towards j
    T[i, i] = T[j, j] = math.cos(value)
    T[j, i] = math.sin(value)
    T[i, j] = -T[j, i]
    return T


def frame(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Floats:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()  # fixed axes: Rz Ry Rx
    T[:3, 3] = x, y, z
    return T


def dh_joint(convention: str, p: dict[str, float], q: float, prismatic: bool) -> Floats:
    """One joint by the table of conventions, written out product by product."""
    theta, d = (p["theta"], p["d"] + q) if prismatic else (p["theta"] + q, p["d"])
    a, alpha, beta = p["a"], p["alpha"], p.get("beta", 0.0)
    if convention.startswith("mdh"):
        T = translation(0, a) @ rotation(0, alpha) @ translation(2, d) @ rotation(2, theta)
    else:
        T = rotation(2, theta) @ translation(2, d) @ translation(0, a) @ rotation(0, alpha)
    return T @ rotation(1, beta) if convention.endswith("hayati") else T


def random_robot(convention: str, n_joints: int, rng: np.random.Generator) -> Robot:
    """A robot with every value away from zero and large angles; about a third of its joints slide."""
    builder = RobotBuilder("random", convention)
    builder.add_frame("base", _random_frame(rng), 0, True)
    for i in range(n_joints):
        joint = Joint(f"j{i + 1}", prismatic=bool(rng.random() < 0.3))
        if convention == "urdf":
            axis = rng.normal(size=3)
            builder.add_urdf_joint(joint, _random_frame(rng), axis / np.linalg.norm(axis))
        elif convention == "poe":
            builder.add_screw_joint(joint, rng.normal(size=3), rng.uniform(-1, 1, 3), _random_frame(rng))
        else:
            values = {
                k: rng.uniform(-3, 3) if k in ("alpha", "theta", "beta") else rng.uniform(-1, 1)
                for k in CONVENTIONS[convention]
            }
            builder.add_convention_joint(joint, values)
    builder.add_frame("tool", _random_frame(rng), n_joints + 1, True)
    estimate = [f"{f}.{k}" for f in ("base", "tool") for k in ("x", "y", "z", "roll", "pitch", "yaw")]
    return builder.build(estimate=estimate)


def _random_frame(rng: np.random.Generator) -> dict[str, float]:
    return {k: rng.uniform(-1, 1) for k in ("x", "y", "z")} | {k: rng.uniform(-3, 3) for k in ("roll", "pitch", "yaw")}


def tool_pose(robot: Robot, q: Floats, values: Floats | None = None) -> Floats:
    """base_T_tool as a product of 4x4 matrices, one an element; at other values of the parameters than nominal ones."""
    if values is None:
        values = robot.nominal
    T = np.eye(4)
    for e in robot.elements:
        free = (0.0 if e.parameter is None else values[e.parameter]) + (0.0 if e.joint is None else q[e.joint])
        value = e.constant + e.sign * free
        T = T @ (translation(e.axis, value) if e.axis < 3 else rotation(e.axis - 3, value))
    return T


def tool_poses(robot: Robot, q: Floats) -> Floats:
    """base_T_tool of each row, shape (n, 4, 4)."""
    return np.stack([tool_pose(robot, row) for row in q])


def central_differences(function: Callable[[Floats], Floats], x: Floats, step: float = 1e-6) -> Floats:
    """Derivative of function at x: the values' shape, then x's."""
    columns = []
    for i in range(len(x)):
        h = np.zeros(len(x))
        h[i] = step
        columns.append((function(x + h) - function(x - h)) / (2 * step))
    return np.stack(columns, axis=-1)
