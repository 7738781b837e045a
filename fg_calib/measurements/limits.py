"""Readings outside their joint's limits: whether another unit would bring them there."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import Booleans, Floats
from fg_calib.robot import Robot

LIMIT_SLACK = 1e-3
"""How far a reading may be beyond its joint's limits, [rad] or [m]: encoders say so of a joint that stands at one."""

FAR = 0.5
"""Part of a joint's range beyond its limits from which a smaller unit is likelier than limits that are too narrow."""

_UNITS = {"m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2}, "rad": {"rad": 1.0, "deg": np.pi / 180.0}}


def outside_limits(readings: Floats, robot: Robot) -> Booleans:
    """Which readings, shape (n, n_joints), [rad] (prismatic: [m]), are beyond their joints' limits."""
    lower, upper = robot.limits.T
    outside: Booleans = (readings < lower - LIMIT_SLACK) | (readings > upper + LIMIT_SLACK)
    return outside


def limit_hint(readings: Floats, robot: Robot, joint: int, names: tuple[str, str], stated: str) -> str:
    """What to do about a joint that has a reading outside its limits.

    Another unit is asked about where it brings all rows within the limits, and where that is no accident: a smaller one
    where the reading is far outside, a larger one where every row is outside as it stands.

    Args:
        readings: As understood so far, shape (n, n_joints), [rad] (prismatic: [m]).
        robot: The robot.
        joint: 0-based number of the joint.
        names: What its readings and those of all joints are called.
        stated: Name of the unit that they are taken to be in.
    """
    low, high = robot.limits[joint]
    q, outside = readings[:, joint], outside_limits(readings, robot)
    kind = [other.unit == robot.joints[joint].unit for other in robot.joints]
    alone = sum(kind) > 1 and not np.delete(outside, joint, axis=1)[:, np.delete(kind, joint)].any()
    sizes = _UNITS[robot.joints[joint].unit]
    for name, size in sizes.items() if stated in sizes else ():
        factor = size / sizes[stated]
        within = np.all((q * factor >= low - LIMIT_SLACK) & (q * factor <= high + LIMIT_SLACK))
        far = max(low - q.min(), q.max() - high) > FAR * (high - low)
        if within and (far if factor < 1.0 else outside[:, joint].all()):
            return f"is {names[0] if alone else names[1]} in {name}?"
    return "widen the joint's limits if the reading is right"
