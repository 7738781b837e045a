"""Rows that what the parameters may be off bends: the same ones from some pairs as from all of them."""

import numpy as np
import pytest
from simulated import true_robot

from fg_calib import Measurements, Robot, pose
from fg_calib.analysis.covariance import spread_of
from fg_calib.graph import noise
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve

ROWS = [
    [0, 0, 0.34, 0],
    [0, -np.pi / 2, 0, 0],
    [0, np.pi / 2, 0.4, 0],
    [0, np.pi / 2, 0, 0],
    [0, -np.pi / 2, 0.4, 0],
    [0, -np.pi / 2, 0, 0],
    [0, np.pi / 2, 0, 0],
]
SIGMA = 1e-4


@pytest.mark.parametrize("first", [506, 611])
def test_few_short_motions_among_long_ones_are_found(monkeypatch, first):
    """Six motions of the wrist alone, between those that are evenly chosen, are all that sees some parameters."""
    tolerance = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
    robot = Robot.from_dh(ROWS, convention="mdh", tool=[0.002, 0, 0], tolerance=tolerance)
    rng = np.random.default_rng(3)
    true, q = true_robot(robot, rng), rng.uniform(-2.0, 2.0, (1000, 7))
    q[:, 4:] = [0.3, 0.8, 0.4]
    for i in range(first, first + 6):
        q[i + 1, :4] = q[i, :4]
        q[i + 1, 4:] = rng.uniform(-2.0, 2.0, 3)
    p, a = pose(true, q).position, np.arange(999)
    distance = np.abs(np.linalg.norm(p[a + 1] - p[a], axis=1) + SIGMA * rng.normal(size=999))
    m = Measurements.from_arrays(q, pairs={"a": a, "b": a + 1, "distance": distance, "sigma_distance": SIGMA})
    problem = build_problem(robot, m, model="distance")
    found = solve(problem)
    monkeypatch.setattr(noise, "_SOME", 10**9)
    expected = solve(problem)
    spread = spread_of(expected)
    sigma = np.sqrt(np.diag(spread.tangent))
    chosen = [i for i, p in enumerate(robot.parameters) if p.estimated]
    # Both are nearer to the same optimum than 3e-7 sigma; what differed before was 0.1 to 0.8.
    assert np.max(np.abs(found.parameters - expected.parameters)[chosen] / sigma) < 1e-4
    bent = [at.noises[0].bent_by(spread.root, 0.1) for at in (found, expected)]
    assert bent[1].any()
    assert np.array_equal(*bent)
