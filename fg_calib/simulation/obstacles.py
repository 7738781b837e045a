"""The arm as lines in space: where its straight pieces begin and end, and whether they pass through a box."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fg_calib import simulation
from fg_calib.inputs import Booleans, Floats
from fg_calib.robot import Axis, Element, Robot, build_chain, forward

MAX_CONTACT_M = 1e-9
"""How deep something may be in a box and still only touch it, [m]: far above rounding, far below any clearance."""


def link_points(robot: Robot, readings: Floats) -> Floats:
    """Points along the arm from the base to the tool, where straight pieces begin and end, shape (n, m, 3), [m].

    Some points are the same: the arm turns there more than once.

    Args:
        robot: The robot.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
    """
    elements = [e for e in robot.elements if e.basis is None]  # what gravity and gears add is not visible at this size
    corners = [k for k, e in enumerate(elements) if e.axis >= Axis.RX]
    trigs, found = robot.trig(readings), []
    for k in (0, *corners, len(elements)):
        part = replace(robot, elements=(Element(Axis.TX), *elements[:k]))  # a chain has at least one
        found.append(forward(build_chain(part), trigs).position)
    return np.stack(found, axis=1)


def enters(robot: Robot, readings: Floats, boxes: "Sequence[simulation.Box]") -> Booleans:
    """Whether something of the arm is inside one of some boxes, at each configuration, shape (n,).

    The joints' origins, the straight lines between them and the tool point count; the links' thickness does not, so
    boxes should be larger by that. A line on the face of a box only touches it. What no joint moves does not count,
    such as a column up to the shoulder: no configuration keeps it out.

    Args:
        robot: The robot, at its nominal values.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        boxes: Boxes that must stay free.
    """
    if not boxes:
        return np.zeros(len(readings), dtype=np.bool_)
    probes = np.outer([0.3, 1.1], np.linspace(0.7, 1.0, robot.n_joints))  # show what stands still in all
    points = link_points(robot, np.concatenate([probes, readings]))  # (2 + n, m, 3)
    moves = np.abs(points[0] - points[1]).max(axis=1) > MAX_CONTACT_M
    lines = moves[:-1] | moves[1:]
    start, end = points[2:, :-1][:, lines], points[2:, 1:][:, lines]  # (n, n_lines, 3)
    return np.any([_cross(start, end, box).any(axis=1) for box in boxes], axis=0)


def _cross(start: Floats, end: Floats, box: "simulation.Box") -> Booleans:
    """Which straight lines pass through a box, shape (...) of ends of shape (..., 3), [m].

    On each axis a line start + t (end - start) is between the box's two planes for an interval of t. It is inside the
    box where the three intervals and [0, 1] overlap.
    """
    lower, upper, along = box.lower + MAX_CONTACT_M, box.upper - MAX_CONTACT_M, end - start
    still = along == 0.0
    step = np.where(still, 1.0, along)
    first, last = (lower - start) / step, (upper - start) / step
    between = (start > lower) & (start < upper)
    enter = np.where(still, np.where(between, -np.inf, np.inf), np.minimum(first, last)).max(axis=-1)
    leave = np.where(still, np.where(between, np.inf, -np.inf), np.maximum(first, last)).min(axis=-1)
    return np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)
