"""An arm as what does not move: one rigid transform between each two joints, whatever its convention.

    base_T_tool(q) = base . L0 . J1(q1) . L1 . J2(q2) ... Jn(qn) . Ln . tool

with J(q) = Rz(q) of a joint that turns and Tz(q) of one that slides: each joint turns about, or slides along, the z
axis of its own frame, in the sense in which its reading grows. A joint that the chain passes against its own direction
has its z axis turned round, as Rz(-q) = Rx(pi) Rz(q) Rx(-pi) and Tz(-q) = Rx(pi) Tz(q) Rx(-pi).

Whatever commutes with J may stand before it or behind it: Rz and Tz for a joint that turns, and any shift for one that
slides. This freedom is all there is between two descriptions of one arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError, shown
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import AXIS_OF_KIND, CONVENTIONS, Axis, Element, Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Links:
    """The rigid transforms of an arm, matrices of shape (4, 4), lengths in [m].

    Attributes:
        base: Base frame to frame 0.
        between: L0 to Ln: to the frame of the first joint, from each joint to the next, and on to the last frame.
        tool: Last frame to tool frame.
    """

    base: Floats
    between: tuple[Floats, ...]
    tool: Floats


def links_of(robot: Robot) -> Links:
    """The rigid transforms of a robot at its nominal values.

    Raises:
        InputError: A joint's value is more than its reading plus a constant: no other format has that.
    """
    base, tool = set(robot.owned_by(0)), set(robot.owned_by(robot.n_joints + 1))
    parts: list[list[Element]] = [[], [], []]  # base, what is between joints, tool; more are put before the tool
    for element in robot.elements:
        if element.basis is not None:
            raise InputError(robot.name, f"a joint whose value is {shown(element.basis.function)}", "plain readings")
        if element.parameter in base:
            parts[0].append(element)
        elif element.parameter in tool:
            parts[-1].append(element)
        elif element.joint is None:
            parts[-2].append(element)
        else:
            turned = [Element(Axis.RX, np.pi)] if element.sign < 0 else []
            parts[-2] += [replace(element, joint=None), *turned]
            parts.insert(-1, [replace(e, constant=-e.constant) for e in turned])
    matrices = [_product(robot, part) for part in parts]
    return Links(matrices[0], tuple(matrices[1:-1]), matrices[-1])


def _product(robot: Robot, elements: Sequence[Element]) -> Floats:
    """What elements of a robot without readings do together, shape (4, 4)."""
    part = replace(robot, elements=(Element(Axis.TX), *elements))  # a chain has at least one
    at = forward(build_chain(part), part.trig(np.zeros((1, robot.n_joints))))
    return rigid(at.rotation[0], at.position[0])


def rigid(rotation: Floats, position: Floats) -> Floats:
    """A rotation and a shift as one matrix, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def inverse(T: Floats) -> Floats:
    """The inverse of a rigid transform, shape (4, 4)."""
    return rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def transform(**values: float) -> Floats:
    """Elementary transforms by kind (theta, d, a, alpha, beta), multiplied from left to right, shape (4, 4)."""
    T = np.eye(4)
    for kind, value in values.items():
        axis = AXIS_OF_KIND[kind]
        if axis < Axis.RX:
            T[:3, 3] += value * T[:3, axis]
            continue
        i, j = (axis - Axis.RX + 1) % 3, (axis - Axis.RX + 2) % 3  # it turns i towards j
        c, s = np.cos(value), np.sin(value)
        T[:3, [i, j]] = np.stack([c * T[:3, i] + s * T[:3, j], c * T[:3, j] - s * T[:3, i]], axis=1)
    return T


def row_transform(convention: str, row: dict[str, float]) -> Floats:
    """One row of a table at reading 0, in the order of its convention, shape (4, 4)."""
    return transform(**{kind: row.get(kind, 0.0) for kind in CONVENTIONS[convention]})
