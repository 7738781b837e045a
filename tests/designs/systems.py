"""Random systems to choose from: candidates' rows, something known, a task, and other unknowns."""

import numpy as np

from fg_calib.designs.information import PoseRows, System, build_system


def random_system(rng, n_candidates=12, h=2, p=4, nuisances=2, floor=0.1) -> System:
    """A system whose core are the first p of its coordinates; `floor` is what is known of each beforehand."""
    n = p + nuisances
    rows = rng.normal(size=(n_candidates, h, n)) * np.exp(rng.normal(size=(n_candidates, 1, 1))) * np.geomspace(3, 1, n)
    X = rng.normal(size=(p, p))
    task = np.zeros((n, n))
    task[:p, :p] = X @ X.T
    known = floor**2 * np.eye(n)
    return System(rows, known, task, np.eye(p, n), 0.0)


def random_poses(rng, n_candidates=15, lost=True):
    """Poses of three core columns and two nuisances; what is lost is the first core column minus the second nuisance.

    Returns:
        The poses, the direction of the columns that none of them determines (None if nothing is lost), and W.
    """
    scales = np.array([1e-3, 2e-3, 1e-3, 5e-3, 1.0])
    rows = rng.normal(size=(n_candidates, 2, 5)) / scales * 10.0
    direction = None
    if lost:
        direction = np.array([1.0, 0.0, 0.0, 0.0, -1.0]) * scales
        u = direction / np.linalg.norm(direction)
        rows = rows - (rows @ u)[..., None] * u
    always = np.diag([0.0, 1.0 / 2e-3, 0.0, 0.0, 0.0])[1:2]
    v = rng.normal(size=(20, 3))
    return PoseRows(rows, always, scales, 3), direction, v.T @ v / 20


def system_with_less(rng) -> System:
    """A system of which one direction of the core is undetermined."""
    poses, _, W = random_poses(rng)
    return build_system(poses, np.zeros((0, 5)), W)
