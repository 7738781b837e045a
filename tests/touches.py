"""Touched points: what a true arm measures of them."""

import numpy as np

from fg_calib.measurements.dataset import Groups, Measurements, Pairs, no_pairs
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3, "tool": 5e-3}


TOOL_POINT = ["tool.x", "tool.y", "tool.z"]


SIGMA = 1e-4


def reach(robot, targets, rng):
    """Readings that bring the tool point to targets, from random ones: Newton's method, anew where it fails."""
    q = np.zeros((len(targets), robot.n_joints))
    left = np.arange(len(targets))
    for _ in range(50):
        x = rng.uniform(-np.pi, np.pi, (len(left), robot.n_joints))
        for _ in range(30):
            at = pose(robot, x)
            off = targets[left] - at.position
            step = np.linalg.pinv(at.jacobian[:, 3:, -robot.n_joints :], rcond=1e-3) @ off[:, :, None]
            length = np.linalg.norm(step, axis=1)
            x = x + step[:, :, 0] * np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
        q[left] = x
        left = left[np.linalg.norm(targets[left] - pose(robot, x).position, axis=1) > 1e-11]
        if not len(left):
            return q
    raise AssertionError("points out of reach")


def reach_faces(robot, normals, heights, rng):
    """Readings that bring the tool point to `n . p = height`, from random ones: the shortest Newton steps."""
    q = np.zeros((len(normals), robot.n_joints))
    left = np.arange(len(normals))
    for _ in range(50):
        x = rng.uniform(-2.0, 2.0, (len(left), robot.n_joints))
        for _ in range(30):
            at = pose(robot, x)
            off = heights[left] - np.einsum("ni,ni->n", normals[left], at.position)
            slope = np.einsum("ni,nij->nj", normals[left], at.jacobian[:, 3:, -robot.n_joints :])
            step = slope * (off / np.maximum(np.sum(slope**2, axis=1), 1e-6))[:, None]
            x = x + np.clip(step, -0.5, 0.5)
        q[left] = x
        left = left[np.abs(np.einsum("ni,ni->n", normals[left], pose(robot, x).position) - heights[left]) > 1e-11]
        if not len(left):
            return q
    raise AssertionError("faces out of reach")


def corners(robot, n, rng):
    """Points that the nominal arm reaches far from its limits of reach, some decimetres from each other."""
    return pose(robot, 0.4 + 0.15 * rng.normal(size=(n, robot.n_joints))).position


def touch(true, points, n_each, rng, sigma=SIGMA, distances=(), test=()):
    """Touches of points with noise; `distances` are (a, b, sigma), measured with noise; `test` names test groups."""
    index = np.repeat(np.arange(len(points)), n_each)
    q = reach(true, points[index] + sigma * rng.normal(size=(len(index), 3)), rng)
    pairs = no_pairs("pairs.csv")
    if distances:
        a, b = (np.array([d[i] for d in distances]) for i in (0, 1))
        s = np.array([d[2] for d in distances])
        d = np.linalg.norm(points[b] - points[a], axis=1) + s * rng.normal(size=len(a))
        nothing = np.full(len(a), np.nan)
        pairs = Pairs(a, b, d, nothing, s, nothing, np.isin(a, test) | np.isin(b, test), "pairs.csv")
    n = len(q)
    return Measurements(
        readings=q,
        ids=np.arange(n).astype(str),
        test=np.isin(index, test),
        position=None,
        rotation=None,
        sigma_position=None,
        sigma_orientation=None,
        sigma_joint=np.zeros(true.n_joints),
        groups=Groups(tuple(f"g{g}" for g in range(len(points))), index, pairs),
        sigmas={"point": np.full(n, sigma or SIGMA)},
        source="poses.csv",
    )
