"""Rows that what the parameters may be off bends: the same ones from some pairs as from all of them."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import true_robot

from fg_calib import Measurements, Robot, pose
from fg_calib.graph import noise
from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import noises_at
from fg_calib.graph.solver import solve
from fg_calib.robot.inverse import solve_inverse
from fg_calib.statistics.covariance import spread_of

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


def long_pairs(short):
    """Pairs of wide motions, far from 0; the last one of another posture near the same place, for a test, or not."""
    robot = Robot.from_dh(ROWS, convention="mdh", tool=[0.1, 0, 0.2], tolerance={"a": 1e-3, "d": 1e-3, "theta": 2e-3})
    rng = np.random.default_rng(1)
    true, q = true_robot(robot, rng), rng.uniform(-2.0, 2.0, (80, 7))
    if short:
        there = pose(true, q[-2:-1]).position + np.array([2e-4, 0.0, 0.0])
        q[-1] = solve_inverse(true, there, generator=rng).readings[0]
    p, a = pose(true, q).position, np.arange(0, 80, 2)
    distance = np.linalg.norm(p[a + 1] - p[a], axis=1) + SIGMA * rng.normal(size=40)
    assert np.sort(distance)[1] > 0.1
    pairs = {"a": a, "b": a + 1, "distance": distance, "sigma_distance": SIGMA, "test": a == 78 if short else a < 0}
    return build_problem(robot, Measurements.from_arrays(q, pairs=pairs), model="distance")


def test_what_bends_no_row_is_not_worked_out_again():
    """Nothing is near to being bent: the parameters' covariance is looked at once, and is not kept."""
    solution = solve(long_pairs(short=False))
    assert solution.converged
    assert solution.problem.state.spread is None
    assert not solution.noises[0].bent_by(spread_of(solution).root, noise.LEAST_BEND).any()


def test_a_short_test_pair_is_bent_although_no_train_pair_is():
    """Its sigma has what the parameters may be off: they are kept for it."""
    solution = solve(long_pairs(short=True))
    state = solution.problem.state
    assert state.spread is not None
    bent = solution.noises[0].bent_by(state.spread, noise.LEAST_BEND)[:, 0]
    assert bent.tolist() == [False] * 39 + [True]


def test_a_test_row_is_bent_in_full_where_a_train_row_of_the_same_pair_is_not():
    """A fit bends a row by its own sigma at most; what checks it has all that the parameters may be off."""
    solution = solve(long_pairs(short=True))
    problem = solution.problem
    (series,), state = problem.data.series, problem.state

    def sigma(test, times):
        """Of the short pair, where the parameters may be off by so many times as much."""
        data = replace(problem.data, series=(replace(series, test=test),))
        wide = replace(problem, data=data, state=replace(state, spread=times * state.spread))
        return np.sqrt(noises_at(wide, solution.parameters)[0].total_at(np.array([39]))[0, 0, 0])

    # An error that is some times the vector is what is seen of it: the sigma of its length grows with it.
    assert sigma(series.test, 100.0) == pytest.approx(10.0 * sigma(series.test, 10.0), rel=0.02)
    none = np.zeros_like(series.test)
    assert sigma(none, 100.0) == pytest.approx(sigma(none, 10.0), rel=1e-9)
    assert SIGMA < sigma(none, 10.0) < 1.5 * SIGMA
