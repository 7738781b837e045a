"""Touched points: what a true arm measures of them."""

import numpy as np

from fg_calib.measurements import Groups, Measurements, Pairs, no_pairs
from fg_calib.robot import pose, solve_inverse

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3, "tool": 5e-3}


TOOL_POINT = ["tool.x", "tool.y", "tool.z"]


SIGMA = 1e-4


def reach(robot, targets, rng):
    """Readings that bring the tool point to targets, from random ones."""
    found = solve_inverse(robot, targets, generator=rng)
    assert found.reached.all()
    return found.readings


def reach_faces(robot, normals, heights, rng):
    """Readings that bring the tool point to `n . p = height`: along the normal from where random ones have it."""
    n, often = len(normals), 10
    at = pose(robot, rng.uniform(-2.0, 2.0, (often * n, robot.n_joints))).position
    off = np.tile(heights, often) - np.einsum("ni,ni->n", np.tile(normals, (often, 1)), at)
    found = solve_inverse(robot, at + off[:, None] * np.tile(normals, (often, 1)), generator=rng, n_starts=3)
    first = found.reached.reshape(often, n).argmax(axis=0)
    return found.readings.reshape(often, n, -1)[first, np.arange(n)]


def corners(robot, n, rng):
    """Points that the nominal arm reaches far from its limits of reach, some decimetres from each other."""
    return pose(robot, 0.4 + 0.15 * rng.normal(size=(n, robot.n_joints))).position


def touch(true, points, n_each, rng, sigma=SIGMA, distances=(), test=(), sigma_joint=0.0):
    """Touches of points with noise, of joints too; `distances` (a, b, sigma) have noise, `test` names test groups."""
    index = np.repeat(np.arange(len(points)), n_each)
    q = reach(true, points[index] + sigma * rng.normal(size=(len(index), 3)), rng)
    pairs = no_pairs("pairs.csv")
    if distances:
        a, b = (np.array([d[i] for d in distances]) for i in (0, 1))
        s = np.array([d[2] for d in distances])
        d = np.linalg.norm(points[b] - points[a], axis=1) + s * rng.normal(size=len(a))
        nothing = np.full(len(a), np.nan)
        pairs = Pairs(a, b, d, nothing, s, nothing, np.isin(a, test) | np.isin(b, test), "pairs.csv")
    groups = Groups(tuple(f"g{g}" for g in range(len(points))), index, pairs)
    ids, more = np.arange(len(q)).astype(str), {"sigmas": {"point": np.full(len(q), sigma or SIGMA)}}
    q, joint = q + sigma_joint * rng.normal(size=q.shape), np.full(true.n_joints, sigma_joint)
    more |= {"groups": groups, "source": "poses.csv"}
    return Measurements(q, ids, np.isin(index, test), *4 * (None,), joint, **more)
