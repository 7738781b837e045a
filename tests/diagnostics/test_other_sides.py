"""Lengths near 0 and angles near half a turn: the arm with their vectors the other way is looked for and told of."""

from dataclasses import replace

import numpy as np
import pytest

from fg_calib import Measurements, Robot, calibrate, pose
from fg_calib.diagnostics.multistart import multistart
from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import reweighted_at
from fg_calib.graph.solver import solve, solve_from
from fg_calib.measurements.dataset import rotation_angle
from fg_calib.statistics.assessment import assess

SIGMA, TOLERANCE = 1e-4, 5e-3


def wrists(lengths, *, seed, n=60, k=6, tilt=0.0, gross=0, nominal=0.0, wide=0):
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
    a[n - wide : n, 2:], b[n - wide : n, 2:] = rng.uniform(-2.5, 2.5, (2, wide, len(lengths)))
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
    solution = multistart(solve(build_problem(robot, m, model="distance")))
    both = [robot.index("a3"), robot.index("a4")]
    told = np.array([x[both] for x in (solution.parameters, *solution.others)])
    assert len(told) > 1
    assert np.min(np.max(np.abs(told - lengths), axis=1)) < 5 * SIGMA  # some two sigma of single lengths
    if tilt == 0.0:  # then the mirror image of an arm explains all as well, whichever of them rounding calls the best
        mirrored = np.max(np.abs(told[:, None] + told[None]), axis=2).min(axis=1)
        assert np.all(mirrored < SIGMA)
    from_truth = solve_from(solution, true, np.inf)
    assert from_truth is None or from_truth.cost >= solution.cost - 0.01


def test_a_length_that_others_see_has_no_other_side():
    """With wrists tilted by half a radian the other pairs say on which side it is: nothing is told of."""
    robot, _, m = wrists([3e-3], seed=1, tilt=0.5, n=200)
    found = calibrate(robot, m, model="distance")
    assert found.assessed[0].others == ()
    assert not [text for text in found.result.findings if "second optimum" in text]


@pytest.mark.parametrize("seed", range(4))
def test_the_advice_helps(seed):
    """Five pairs between which all joints move say on which side it is: the true one is found, and no other."""
    robot, _, m = wrists([3e-3], seed=seed, wide=5)
    found = calibrate(robot, m, model="distance")
    assert found.assessed[0].others == ()
    assert not [text for text in found.result.findings if "second optimum" in text]
    assert found.parameters["a3"].estimate == pytest.approx(3e-3, abs=5 * found.parameters["a3"].sigma)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loss", "nominal"),
    [(loss, 5e-3) for loss in ("huber", "cauchy", "geman-mcclure", "gnc")]
    + [(loss, 0.0) for loss in ("huber", "cauchy", "gnc")],
)
def test_with_a_robust_loss_the_other_side_is_told_of_too(loss, nominal):
    """From nominal 0 the loss took all that sees the length for outliers, and the arm was called good."""
    robot, _, m = wrists([6e-3], seed=1, nominal=nominal, gross=3)
    found = calibrate(robot, m, model="distance", loss=loss)
    sides = [x[robot.index("a3")] for x in (found.assessed[0].parameters, *found.assessed[0].others)]
    assert sorted(np.round(1e3 * np.array(sides))) == [-6.0, 6.0]
    assert not found.result.trustworthy


def test_a_parameter_that_outliers_alone_see_is_named():
    """Where all six pairs that see the length have weight 0 its sigma is that of the tolerance."""
    robot, _, m = wrists([5.5e-3], seed=1, nominal=5e-3)
    solution = solve(build_problem(robot, m, model="distance", loss="gnc"))
    weights = np.concatenate([np.ones(60), np.zeros(6)])
    state = replace(solution.problem.state, weights=(weights,))
    spoilt = replace(solution, problem=reweighted_at(solution.problem, solution.parameters, state))
    said = "nearly all measurements that see a3 are taken for outliers by loss gnc: look at them;"
    assert [text for text in assess(spoilt).reservations if text.startswith("nearly all")] == [
        f"{said} calibrate without a loss to see what they say"
    ]
    assert not [text for text in assess(solution).reservations if text.startswith("nearly all")]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_rejecting_loss_leaves_good_rows_in(seed):
    """Of 40 distances some are gross: geman-mcclure alone took up to half of all for outliers, and called it good."""
    rng = np.random.default_rng(seed)
    rows = [[0.0, np.pi / 2, 0.3, 0.0], [0.4, 0.0, 0.0, 0.0], [0.3, 0.0, 0.1, 0.0]]
    robot = Robot.from_dh(rows, tolerance={"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3})
    off = np.array([(p.tolerance or 0.0) * p.estimated for p in robot.parameters])
    true, q = robot.nominal + off * rng.normal(size=len(off)), rng.uniform(-2.0, 2.0, (80, 3))
    p, gross = pose(robot.with_values(true), q).position, rng.random(40) < 0.1
    distance = np.linalg.norm(p[:40] - p[40:], axis=1) + SIGMA * rng.normal(size=40) + 5e-3 * gross
    pairs = {"a": np.arange(40), "b": np.arange(40, 80), "distance": distance, "sigma_distance": SIGMA}
    problem = build_problem(robot, Measurements.from_arrays(q, pairs=pairs), model="distance", loss="geman-mcclure")
    solution = multistart(solve(problem))
    assert solution.objective <= solve_from(solution, true, np.inf).objective + 0.01
    assert np.array_equal(solution.problem.state.weights[0] < 0.2, gross)


def short_and_wide(*, seed, n_wide, n_short=40, nominal=1e-4):
    """An arm of which 40 pairs turn the last joint alone, its radius 0.1 mm to one side by nominal; others are wide."""
    rng, sigma = np.random.default_rng(seed), 1e-5
    rows = [[0.3, np.pi / 2, 0.3, 0.0], [0.4, 0.0, 0.0, 0.0], [nominal, np.pi / 2, 0.0, 0.0]]
    robot = Robot.from_dh(rows, tolerance={"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3})
    off = np.array([(p.tolerance or 0.0) * p.estimated for p in robot.parameters])
    true = robot.nominal + off * rng.normal(size=len(off))
    n = n_wide + n_short
    a, b = rng.uniform(-2.5, 2.5, (2, n, 3))
    b[n_wide:, :2] = a[n_wide:, :2]
    arm, ends = robot.with_values(true), np.arange(n)
    distance = np.linalg.norm(pose(arm, b).position - pose(arm, a).position, axis=1)
    distance = np.abs(distance + sigma * rng.normal(size=n))
    pairs = {"a": ends, "b": n + ends, "distance": distance, "sigma_distance": sigma}
    return robot, true, Measurements.from_arrays(np.concatenate([a, b]), pairs=pairs)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("n_wide", "loss"), [(20, "none"), (40, "none"), (20, "huber"), (40, "cauchy"), (20, "gnc")])
def test_the_side_that_wide_pairs_see_is_found_from_the_other(seed, n_wide, loss):
    """Half of the draws have the radius on the side that nominal is not on: descents ended there, good by losses."""
    robot, true, m = short_and_wide(seed=seed, n_wide=n_wide)
    found = calibrate(robot, m, model="distance", loss=loss)
    a3 = found.parameters["a3"]
    assert a3.estimate == pytest.approx(true[robot.index("a3")], abs=5 * a3.sigma)
    assert found.assessed[0].others == ()


WRIST = [
    *([0.0, np.pi / 2, 0.3, 0.0], [0.4, 0.0, 0.0, 0.0], [0.03, np.pi / 2, 0.0, 0.0]),
    *([0.0, -np.pi / 2, 0.4, 0.0], [0.0, np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
]
GANTRY = [
    *([0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, 0.0, 0.1, 0.0]),
    *([0.0, np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
]


def one_joint_a_pair(rows, n_prismatic, *, seed, n, length, angle, model):
    """An arm of which each pair moves one joint: many a length that nominal has at 0 is the radius of a circle."""
    rng, sigma, turning = np.random.default_rng(seed), 1e-5, len(rows) - n_prismatic
    types = ["prismatic"] * n_prismatic + ["revolute"] * turning
    tolerance = {"a": length, "d": length, "tool": length, "alpha": angle, "theta": angle}
    robot = Robot.from_dh(rows, types=types, estimate=["tool.x", "tool.z"], tolerance=tolerance)
    off = np.array([(p.tolerance or 0.0) * p.estimated for p in robot.parameters])
    true = robot.nominal + off * rng.normal(size=len(off))
    low, high = np.array([0.0] * n_prismatic + [-2.5] * turning), np.array([0.4] * n_prismatic + [2.5] * turning)
    a, moved, each = rng.uniform(low, high, (n, len(rows))), rng.integers(0, len(rows), n), np.arange(n)
    b = a.copy()
    b[each, moved] = rng.uniform(low, high, (n, len(rows)))[each, moved]
    at = [pose(robot.with_values(true), q) for q in (a, b)]
    distance = np.abs(np.linalg.norm(at[1].position - at[0].position, axis=1) + sigma * rng.normal(size=n))
    pairs = {"a": each, "b": n + each, "distance": distance, "sigma_distance": sigma}
    if model == "distance-rotation":
        turn = rotation_angle(np.swapaxes(at[0].rotation, 1, 2) @ at[1].rotation)[0]
        pairs |= {"angle": np.abs(turn + sigma * rng.normal(size=n)), "sigma_angle": sigma}
    return robot, Measurements.from_arrays(np.concatenate([a, b]), pairs=pairs)


@pytest.mark.parametrize("seed", [7, 56, 67])
def test_a_start_without_what_may_fold_is_needed(seed):
    """Of 20 distances: without it chi-square is 750 to 27 000, and 7 of 200 such arms end at another optimum."""
    robot, m = one_joint_a_pair(WRIST, 0, seed=seed, n=20, length=1e-3, angle=1e-3, model="distance")
    solution = multistart(solve(build_problem(robot, m, model="distance")))
    assert solution.converged
    assert 2.0 * solution.objective < 60.0


@pytest.mark.parametrize("seed", [100, 108, 110])
def test_starts_beside_nominal_are_needed(seed):
    """Of a gantry whose head has its lengths at 0: without them a third of 120 such arms has a chi-square above 1e5."""
    given = {"seed": seed, "n": 40, "length": 1e-2, "angle": 1e-2, "model": "distance-rotation"}
    robot, m = one_joint_a_pair(GANTRY, 3, **given)
    solution = multistart(solve(build_problem(robot, m, model="distance-rotation")))
    assert solution.converged
    assert 2.0 * solution.objective < 160.0  # of 80 rows
