"""Configurations that bring the tool to poses, or as near as the arm gets: its point there, the tool turned least.

An arm of fewer than six joints, or one that a limit stops, reaches the point of many a pose, but not with the
orientation. There the point is kept and the tool turned as near as the remaining freedom allows: steps of Gauss and
Newton in the null space of the point's derivative Jv, q + Jv^+ p + N (Jw N)^+ (w - Jw Jv^+ p), with p and w what is
missing of position and orientation, and N a basis of that null space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.executors import tell
from fg_calib.robot.inverse import N_STARTS, REACHED, Inverse, solve_inverse
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot
from fg_calib.robot.rotations import rotation_vector

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

FAR = 0.1
"""A joint that a correction turns by more, [rad] (prismatic: [m]), is near a singularity or on another branch."""

_N_STEPS = 30
"""Steps that turn the tool; they converge in a few, linearly where the pose is far out of reach."""

_N_HALVINGS = 8
"""How often such a step is halved."""

_N_STARTS = 20
"""Starts for a pose: those after the first one are ever wider about where the arm is to stay."""

_AT_ONCE = 5000
"""Targets at once: so many fit caches and memory, and between them it is told how far it is."""

_N_AROUND = 20
"""Starts about where the arm is to stay, of poses that it reached far from there."""

_FREE = 1e-6
"""Singular values of the point's derivative below this share of the largest move it not."""


@dataclass(frozen=True, eq=False, repr=False)
class Correction(FrozenArrays):
    """Commands for targets, each of n.

    Attributes:
        readings: Joint values to command, within the limits, shape (n, n_joints), [rad] (prismatic: [m]).
        position: Where the nominal arm's tool point is with them, from the base: the pose to command where the
            controller takes poses, shape (n, 3), [m].
        rotation: Its orientation there, shape (n, 3, 3).
        nominal_readings: What the nominal arm would do for the targets, shape (n, n_joints).
        uncorrected: How far from the targets the calibrated arm is at these, position and turn, shape (n, 2), [m] and
            [rad]; nan where the nominal arm does not reach the target either.
        missed: How far from the targets it is with the correction, shape (n, 2), [m] and [rad]; 0 but for rounding
            where it reaches them.
        expected: RMS error that the calibration's uncertainty leaves, of position and turn, in the frame of the
            targets, shape (n, 2), [m] and [rad]; nan where it depends on what is not determined.
        expected_fitted: The same of positions after the one rotation and shift that fit all targets best, RMS: how
            well they fit each other, wherever the base is, [m]; nan where it is not determined.
        turns: Whether the targets state an orientation.
    """

    readings: Floats
    position: Floats
    rotation: Floats
    nominal_readings: Floats
    uncorrected: Floats
    missed: Floats
    expected: Floats
    expected_fitted: float
    turns: bool

    @cached_property
    def reached(self) -> Booleans:
        """Which targets the calibrated arm reaches, shape (n,)."""
        found: Booleans = np.logical_and.reduce(self.missed < REACHED, axis=1)
        return found

    @cached_property
    def changed(self) -> Floats:
        """The joint values to command less the nominal ones, shape (n, n_joints)."""
        return self.readings - self.nominal_readings

    @cached_property
    def far(self) -> Booleans:
        """Where a joint changes by more than a calibration alone explains, shape (n,)."""
        found: Booleans = np.logical_or.reduce(np.abs(self.changed) > FAR, axis=1)
        return found

    def __repr__(self) -> str:
        n, reached = len(self.readings), int(self.reached.sum())
        return f"Correction, {n} targets, {reached} reached"


def reach(robot: Robot, position: Floats, rotation: Floats | None, near: Floats, *, anywhere: bool = False) -> Inverse:
    """Configurations at poses, near given ones; where a pose is out of reach at its point, the tool turned nearest.

    Args:
        robot: The robot, at its nominal values.
        position: base_p_tool, shape (n, 3), [m].
        rotation: base_R_tool, shape (n, 3, 3); any if None.
        near: Configurations to stay near, shape (n, n_joints), [rad] (prismatic: [m]).
        anywhere: Whether they are where to start alone, and any configuration will do.

    Returns:
        Within the joint limits; what is missing of a point that is itself out of reach is not 0.
    """
    n = len(position)
    parts = []
    for first in range(0, max(n, 1), _AT_ONCE):
        tell("reaching targets", first, n)
        rows = slice(first, first + _AT_ONCE)
        turned = None if rotation is None else rotation[rows]
        found = _reach(robot, position[rows], turned, near[rows], anywhere)
        parts.append((found.readings, found.miss_position, found.miss_rotation))
    return Inverse(*map(np.concatenate, zip(*parts, strict=True)))


def _reach(robot: Robot, position: Floats, rotation: Floats | None, near: Floats, anywhere: bool) -> Inverse:
    n_starts = 1 if anywhere else _N_STARTS
    found = _else_from_anywhere(
        robot, position, rotation, solve_inverse(robot, position, rotation, near=near, n_starts=n_starts)
    )
    found = found if anywhere else _nearer(robot, position, rotation, near, found)
    rows = np.flatnonzero(~found.reached)
    if rotation is None or not len(rows):
        return found
    points = solve_inverse(robot, position[rows], near=near[rows], n_starts=_N_STARTS)
    rows, points = rows[points.reached], replace(points, readings=points.readings[points.reached])
    given = zip(points.readings, position[rows], rotation[rows], strict=True)
    turned = np.array([_turn(robot, q, p, R) for q, p, R in given])
    q = found.readings.copy()
    q[rows] = turned.reshape(-1, robot.n_joints)
    return Inverse(q, *misses(robot, q, position, rotation))


def _else_from_anywhere(robot: Robot, position: Floats, rotation: Floats | None, found: Inverse) -> Inverse:
    """The same, and what was not reached from where it was to stay reached from random starts all over the limits."""
    rows = np.flatnonzero(~found.reached)
    if not len(rows):
        return found
    turned = None if rotation is None else rotation[rows]
    others = solve_inverse(robot, position[rows], turned, n_starts=N_STARTS)
    return _exchanged(found, rows, others, others.reached)


def _exchanged(found: Inverse, rows: Integers, others: Inverse, better: Booleans) -> Inverse:
    """Some rows exchanged for others, where these are better."""
    made = [part.copy() for part in (found.readings, found.miss_position, found.miss_rotation)]
    for part, other in zip(made, (others.readings, others.miss_position, others.miss_rotation), strict=True):
        part[rows[better]] = other[better]
    return Inverse(*made)


def _nearer(robot: Robot, position: Floats, rotation: Floats | None, near: Floats, found: Inverse) -> Inverse:
    """The same, or nearer: beside a singularity the steps from where the arm is to stay may end on another branch."""
    n, n_joints = _N_AROUND, robot.n_joints
    changed = np.abs(found.readings - near).max(axis=1)
    rows = np.flatnonzero(found.reached & (changed > FAR))
    if not len(rows):
        return found
    about = np.random.default_rng(0).normal(size=(len(rows), n, n_joints))
    starts = near[rows, None] + (changed[rows, None, None] * np.linspace(0.0, 1.0, n)[:, None]) * about
    starts = np.clip(starts.reshape(-1, n_joints), *robot.limits.T)
    turned = None if rotation is None else np.repeat(rotation[rows], n, axis=0)
    others = solve_inverse(robot, np.repeat(position[rows], n, axis=0), turned, near=starts, n_starts=1)
    of_others = np.abs(others.readings.reshape(len(rows), n, n_joints) - near[rows, None]).max(axis=2)
    of_others[~others.reached.reshape(len(rows), n)] = np.inf
    best = of_others.argmin(axis=1)
    better = of_others[np.arange(len(rows)), best] < changed[rows]
    chosen = np.arange(len(rows)) * n + best
    nearest = Inverse(others.readings[chosen], others.miss_position[chosen], others.miss_rotation[chosen])
    return _exchanged(found, rows, nearest, better)


def misses(robot: Robot, readings: Floats, position: Floats, rotation: Floats | None) -> tuple[Floats, Floats]:
    """How far the tool is from poses and by what angle it is turned from them, shapes (n,), [m] and [rad].

    Args:
        robot: The robot, at its nominal values.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        position: Shape (n, 3), [m].
        rotation: Shape (n, 3, 3); if None any will do, and the angle is 0.
    """
    at = forward(build_chain(robot), robot.trig(readings))
    far = np.linalg.norm(position - at.position, axis=1)
    if rotation is None:
        return far, np.zeros(len(far))
    return far, np.linalg.norm(rotation_vector(rotation @ np.swapaxes(at.rotation, 1, 2)), axis=1)


def _turn(robot: Robot, q: Floats, position: Floats, rotation: Floats) -> Floats:
    """The configuration nearest in orientation with the tool point where it is, from one whose point is there."""
    chain = build_chain(robot).with_joint_columns()
    lower, upper = robot.limits.T

    def step(q: Floats) -> tuple[Floats, float, float]:
        at = forward(chain, robot.trig(q[None]))
        p, w = position - at.position[0], rotation_vector(rotation[None] @ np.swapaxes(at.rotation, 1, 2))[0]
        Jw, Jv = at.jacobian[0, :3], at.jacobian[0, 3:]
        _, size, Vt = np.linalg.svd(Jv)
        free = Vt[int(np.sum(size > _FREE * size[0])) :].T  # (n_joints, n_free)
        back = np.linalg.pinv(Jv, rcond=_FREE) @ p
        turn: Floats = back + free @ (np.linalg.pinv(Jw @ free, rcond=_FREE) @ (w - Jw @ back))
        return turn, float(np.linalg.norm(p)), float(np.linalg.norm(w))

    best, (dq, _, left) = q, step(q)
    for _ in range(_N_STEPS):
        for halving in range(_N_HALVINGS):
            at_point = solve_inverse(robot, position, near=np.clip(best + 0.5**halving * dq, lower, upper), n_starts=1)
            moved, (further, _, now) = at_point.readings[0], step(at_point.readings[0])
            if at_point.reached[0] and now < left - REACHED * 1e-3:
                break
        else:
            return best
        best, dq, left = moved, further, now
    return best
