"""Lengths near 0 and angles near half a turn: the arm with their vectors the other way is looked for and told of."""

import numpy as np
import pytest

from fg_calib import Measurements, Robot, calibrate, pose
from fg_calib.analysis.restarts import look_elsewhere
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve, solve_from

SIGMA, TOLERANCE = 1e-4, 5e-3


def wrists(lengths, *, seed, n=60, k=6, tilt=0.0, gross=0, nominal=0.0):
    """Two parallel axes, and across them wrists of which few pairs turn one each: they see its length alone.

    Of `lengths` one each; the other pairs have the wrists upright, where their lengths act along the axes, unseen, but
    for `tilt`. Returns the robot, the true parameters and the measurements.
    """
    rng = np.random.default_rng(seed)
    rows = [[0.5, 0.0, 0.3, 0.0], [0.4, np.pi / 2, 0.0, 0.0], *([nominal, 0.0, 0.0, 0.0] for _ in lengths)]
    robot = Robot.from_dh(rows, convention="dh", tolerance={"a": TOLERANCE, "d": 1e-3, "alpha": 5e-4, "theta": 5e-4})
    true = robot.nominal + rng.normal(size=len(robot.nominal)) * [
        (p.tolerance or 0) * p.estimated for p in robot.parameters
    ]
    for i, length in enumerate(lengths):
        true[robot.index(f"a{3 + i}")] = length
    n_all = n + k * len(lengths)
    a, b = (np.zeros((n_all, robot.n_joints)) for _ in range(2))
    a[:, :2], b[:, :2] = rng.uniform(-2.5, 2.5, (2, n_all, 2))
    a[:, 2], b[:, 2] = np.pi / 2 + tilt * rng.normal(size=(2, n_all))
    b[n:] = a[n:]
    for i in range(len(lengths)):
        mine = slice(n + k * i, n + k * (i + 1))
        b[mine, 2 + i] += rng.uniform(1.0, 3.0, k)
    arm = robot.with_values(true)
    p, q = pose(arm, a).position, pose(arm, b).position
    distance = np.abs(np.linalg.norm(q - p, axis=1) + SIGMA * rng.normal(size=n_all))
    distance[:gross] += 0.05
    ends = np.arange(n_all)
    pairs = {"a": ends, "b": n_all + ends, "distance": distance, "sigma_distance": SIGMA}
    return robot, true, Measurements.from_arrays(np.concatenate([a, b]), pairs=pairs)


@pytest.mark.parametrize("length", [2.7e-3, -2.7e-3, 9e-3])
def test_a_length_that_folded_pairs_alone_see_is_told_of_with_its_other_side(length):
    """Six pairs see 2 |a3| sin(turn / 2): nothing says on which side it is, and one side was called good."""
    robot, _, m = wrists([length], seed=1)
    found = calibrate(robot, m, model="distance")
    assert not found.result.trustworthy
    said = [text for text in found.result.findings if text.startswith("a second optimum that the data cannot tell")]
    assert len(said) == 1
    assert "a3 " in said[0]
    a3, (other,) = found.parameters["a3"], found.assessed[0].others
    sides = sorted([a3.estimate, other[robot.index("a3")]])
    assert np.abs(sides) == pytest.approx(abs(length), abs=5 * a3.sigma)
    assert sides[0] < 0.0 < sides[1]


@pytest.mark.parametrize("seed", [0, 3, 4])
@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_of_two_lengths_the_true_sides_are_among_those_told_of(seed, tilt):
    """Four arms explain the pairs, but for what tilted wrists of the other pairs say; from the truth none is better."""
    lengths = TOLERANCE * np.random.default_rng(100 + seed).normal(size=2)
    robot, true, m = wrists(lengths, seed=seed, tilt=tilt)
    solution = look_elsewhere(solve(build_problem(robot, m, model="distance")))
    both = [robot.index("a3"), robot.index("a4")]
    told = np.array([x[both] for x in (solution.parameters, *solution.others)])
    assert len(told) > 1
    assert np.min(np.max(np.abs(told - lengths), axis=1)) < 5 * SIGMA  # some two sigma of single lengths
    from_truth = solve_from(solution, true, np.inf)
    assert from_truth is None or from_truth.cost >= solution.cost - 0.01


def test_a_length_that_others_see_has_no_other_side():
    """With wrists tilted by half a radian the other pairs say on which side it is: nothing is told of."""
    robot, _, m = wrists([3e-3], seed=1, tilt=0.5, n=200)
    found = calibrate(robot, m, model="distance")
    assert found.assessed[0].others == ()
    assert not [text for text in found.result.findings if "second optimum" in text]


def test_with_a_robust_loss_the_other_side_is_told_of_too():
    """Where the loss leaves the folded pairs in: they show the length from a nominal one far from 0 on."""
    robot, _, m = wrists([6e-3], seed=1, nominal=5e-3, gross=3)
    found = calibrate(robot, m, model="distance", loss="huber")
    assert found.parameters["a3"].estimate == pytest.approx(6e-3, abs=5 * found.parameters["a3"].sigma)
    assert [round(1e3 * other[robot.index("a3")]) for other in found.assessed[0].others] == [-6]
