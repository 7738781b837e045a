"""The arm as lines in space: where its straight pieces begin and end, and whether they pass through a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays, as_floats
from fg_calib.errors import InputError
from fg_calib.robot.model import Axis, Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

TOUCHING = 1e-9
"""How deep something may be in a box and still only touch it, [m]: far above rounding, far below any clearance."""


@dataclass(frozen=True)
class Box(FrozenArrays):
    """A box along the axes of the robot's base frame.

    Attributes:
        lower: Its least x, y and z, shape (3,), [m].
        upper: Its largest, shape (3,), [m].
    """

    lower: Floats
    upper: Floats

    def __post_init__(self) -> None:
        for key in ("lower", "upper"):
            object.__setattr__(self, key, as_floats(f"box: {key}", getattr(self, key), "(3,)"))
        if not (self.lower < self.upper).all():
            found = f"found {self.upper.tolist()} above a lower of {self.lower.tolist()}"
            raise InputError("box: upper", found, "more than lower in x, y and z")
        super().__post_init__()

    def holds(self, points: Floats) -> Booleans:
        """Which points, shape (n, 3), [m], are in it or on its faces, shape (n,)."""
        inside: Booleans = np.all((points >= self.lower) & (points <= self.upper), axis=1)
        return inside


def link_points(robot: Robot, readings: Floats) -> Floats:
    """Points along the arm from the base to the tool, shape (n, m, 3), [m]: where straight pieces begin and end.

    Args:
        robot: The robot.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
    """
    n, values = len(readings), robot.nominal
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    points, moved = [p.copy()], False
    for e in robot.elements:
        value = np.full(n, 0.0 if e.parameter is None else values[e.parameter])
        if e.basis is not None:
            continue  # what gravity and gears add is not seen at this size
        value = e.constant + e.sign * (value + (0.0 if e.joint is None else readings[:, e.joint]))
        if e.axis < Axis.RX:
            p = p + R[:, :, int(e.axis)] * value[:, None]
            moved = moved or bool(np.any(value != 0.0))
            continue
        if moved:
            points.append(p.copy())
            moved = False
        R = R @ _turns(int(e.axis) - 3, value)
    return np.stack([*points, p], axis=1)


def _turns(axis: int, angle: Floats) -> Floats:
    """Rotations about a coordinate axis, shape (n, 3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.tile(np.eye(3), (len(angle), 1, 1))
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i] = np.sin(angle)
    out[:, i, j] = -out[:, j, i]
    return out


def enters(robot: Robot, readings: Floats, boxes: Sequence[Box]) -> Booleans:
    """In which configurations something of the arm is inside one of some boxes, shape (n,).

    What is looked at are the joints' origins, the straight lines between them and the tool point; not how thick the
    links are, so boxes want to be larger by that. A line on the face of a box only touches it. What no joint moves,
    such as a column up to the shoulder, is not looked at: no configuration keeps it out.

    Args:
        robot: The robot, at its nominal values.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        boxes: What must stay free.
    """
    points = link_points(robot, np.concatenate([_probes(robot), readings]))  # (2 + n, m, 3)
    moves = _moves(points)
    lines = moves[:-1] | moves[1:]
    start, end = points[2:, :-1][:, lines], points[2:, 1:][:, lines]  # (n, n_lines, 3)
    hit = np.zeros(len(readings), dtype=np.bool_)
    for box in boxes:
        hit |= _pass(start, end, box).any(axis=1)
    return hit


def foot_in(robot: Robot, boxes: Sequence[Box]) -> str:
    """Which of some boxes keeps every configuration out, as the moving arm begins inside it; empty if none does.

    Args:
        robot: The robot, at its nominal values.
        boxes: What must stay free.
    """
    points = link_points(robot, _probes(robot))
    moves = _moves(points)
    begins = np.flatnonzero(~moves[:-1] & moves[1:])
    for number, box in enumerate(boxes, start=1):
        for k in begins.tolist():
            p = points[0, k]
            if np.all((p > box.lower + TOUCHING) & (p < box.upper - TOUCHING)):
                at = ", ".join(f"{v:.4g}" for v in p.tolist())
                return f"keep_out {number} holds the foot of the moving arm, ({at}) m, in every configuration"
    return ""


def _probes(robot: Robot) -> Floats:
    """Two configurations that show what stands still in all of them."""
    return np.outer([0.3, 1.1], np.linspace(0.7, 1.0, robot.n_joints))


def _moves(points: Floats) -> Booleans:
    """Which points, shape (n, m, 3), of which the first two are of probes, some joint moves: shape (m,)."""
    found: Booleans = np.abs(points[0] - points[1]).max(axis=1) > TOUCHING
    return found


def _pass(start: Floats, end: Floats, box: Box) -> Booleans:
    """Which straight lines pass through a box, shape (...) of ends of shape (..., 3), [m].

    On each axis a line start + t (end - start) is between the box's two planes for an interval of t. It is inside the
    box where the three intervals and [0, 1] overlap.
    """
    lower, upper, along = box.lower + TOUCHING, box.upper - TOUCHING, end - start
    still = along == 0.0
    step = np.where(still, 1.0, along)
    first, last = (lower - start) / step, (upper - start) / step
    enter, leave = np.minimum(first, last), np.maximum(first, last)
    between = (start > lower) & (start < upper)
    enter = np.where(still, np.where(between, -np.inf, np.inf), enter).max(axis=-1)
    leave = np.where(still, np.where(between, np.inf, -np.inf), leave).min(axis=-1)
    passes: Booleans = np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)
    return passes
