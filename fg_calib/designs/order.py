"""In which order stops are visited: a short way for the joints.

The time from one configuration to the next is that of the joint which moves most, in turns of its whole range where
joints differ. From the first, the nearest one each time; then pieces of the way are turned round, and single stops
moved, as long as that makes it shorter (2-opt and Or-opt).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_IMPROVED = 400
"""Stops up to which the way is improved; of more it is that to the nearest each time."""


def travel(robot: Robot, readings: Floats) -> float:
    """Length of the way along configurations, shape (n, n_joints): the largest joint motions of all steps, [rad].

    Motions of prismatic joints count as turns that move the arm's reach by as much.
    """
    steps = np.abs(np.diff(readings * _weights(robot), axis=0))
    return float(np.sum(steps.max(axis=1, initial=0.0)))


def shortest_way(robot: Robot, readings: Floats, first: int | None = None) -> Integers:
    """An order of configurations that is short for the joints, shape (n,).

    Args:
        robot: The arm.
        readings: The configurations, shape (n, n_joints), [rad] (prismatic: [m]).
        first: Which one to start at; the one nearest to the middle of the others if None.
    """
    q = readings * _weights(robot)
    n = len(q)
    if n < 3:
        return np.arange(n)
    d = np.abs(q[:, None] - q[None]).max(axis=2)
    way = [int(np.argmin(d.sum(axis=1))) if first is None else first]
    left = set(range(n)) - set(way)
    while left:
        there = np.array(sorted(left))
        way.append(int(there[np.argmin(d[way[-1], there])]))
        left.remove(way[-1])
    order = np.array(way, dtype=np.int64)
    return _improved(order, d, first is None) if n <= MOST_IMPROVED else order


def _weights(robot: Robot) -> Floats:
    return np.array([1.0 / robot.reach if joint.prismatic else 1.0 for joint in robot.joints])


def _improved(order: Integers, d: Floats, free_start: bool) -> Integers:
    """The way with pieces turned round and stops moved, until neither makes it shorter."""
    for _ in range(len(order)):
        turned = _turn(order, d, free_start)
        moved = _move(turned, d)
        if np.array_equal(moved, order):
            break
        order = moved
    return order


def _turn(order: Integers, d: Floats, free_start: bool) -> Integers:
    """The best reversals of pieces i ... j, one for each i."""
    n = len(order)
    for i in range(0 if free_start else 1, n - 1):
        j = np.arange(i + 1, n)
        before = d[order[i - 1], order[i]] if i else 0.0
        after = np.where(j < n - 1, d[order[j], order[np.minimum(j + 1, n - 1)]], 0.0)
        new = (d[order[i - 1], order[j]] if i else 0.0) + np.where(
            j < n - 1, d[order[i], order[np.minimum(j + 1, n - 1)]], 0.0
        )
        gain = before + after - new
        k = int(np.argmax(gain))
        if gain[k] > 1e-12:
            order = np.concatenate([order[:i], order[i : j[k] + 1][::-1], order[j[k] + 1 :]])
    return order


def _move(order: Integers, d: Floats) -> Integers:
    """Single stops, but the first, put where they cost least."""
    for k in range(1, len(order)):
        rest = np.delete(order, k)
        after = d[order[k - 1], order[k + 1]] - d[order[k], order[k + 1]] if k + 1 < len(order) else 0.0
        saved = d[order[k - 1], order[k]] - after
        a, b = rest[:-1], rest[1:]
        cost = np.append(d[a, order[k]] + d[order[k], b] - d[a, b], d[rest[-1], order[k]])
        place = int(np.argmin(cost))
        if cost[place] < saved - 1e-12:
            order = np.insert(rest, place + 1, order[k])
    return order
