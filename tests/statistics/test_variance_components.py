"""Noise estimated where joint noise is specified too: a factor on the noise of each kind, and one on that of joints."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dense import dense
from simulated import measure, pairs_between, small_arm, specified, true_robot
from touches import TOLERANCE, TOOL_POINT, corners, touch

from fg_calib import Measurements, Pairing, Table, assess, build_problem, solve
from fg_calib.graph import JOINT_NOISE, prior_rows, relinearized_at, whitener_of
from fg_calib.robot import pose
from fg_calib.statistics import variance_components as estimation
from fg_calib.statistics.variance_components import NoiseComponents, estimate_noise, noise_components

SIGMA, SIGMA_JOINT = (1e-3, 5e-4), 1e-3


def tracker_and_bar(true, rng, n=30):
    """Positions, and lengths between the same configurations measured directly: their joint noise is the same."""
    q = rng.uniform(-np.pi, np.pi, (n, true.n_joints))
    stood = q + SIGMA_JOINT * rng.normal(size=q.shape)
    ends = np.tile(np.arange(n), 2), np.concatenate([np.roll(np.arange(n), 1), np.roll(np.arange(n), 3)])
    pairs = pairs_between(true, stood, ends, rng, sigma=(5e-4, 0.0))
    p, same = pose(true, stood).position, {"ids": range(n), "sigma_joint": SIGMA_JOINT}
    p = p + SIGMA[0] * rng.normal(size=(n, 3))
    tracker = Measurements.from_arrays(q, position=p, sigma_position=SIGMA[0], source="tracker.csv", **same)
    return tracker, replace(Measurements.from_arrays(q, source="bar.csv", **same), pairs=pairs)


def touched(true, rng):
    """Touches of five points and the lengths between these, with joint noise."""
    points = corners(true, 5, rng)
    between = tuple((a, b, 1e-4) for a in range(5) for b in range(a))
    return touch(true, points, 12, rng, sigma=1e-3, distances=between, sigma_joint=SIGMA_JOINT)


CHOICES = {name: {"model": "pose"} for name in ("pose", "no joint noise", "joints drowned")}
CHOICES |= {name: {"model": "distance"} for name in ("star of distances", "touches")} | {"tables": {}}
CHOICES |= {
    "frame unknown": {"model": "pose", "frame": "unknown"},
    "encoder estimated": {"model": "pose", "encoder": "estimated"},
    "all distances": {"model": "distance", "pairing": Pairing("all")},
}


def draw(name, rng, own=1 / 3, joint=2.0, n=30):
    """A problem and its true robot; noise is specified `own` and `joint` times as large as it is."""
    robot = small_arm(tolerance=TOLERANCE, estimate=TOOL_POINT if name == "touches" else ())
    true = true_robot(robot, rng)
    if name == "tables":
        tracker, bar = (specified(m, own, joint) for m in tracker_and_bar(true, rng, n))
        return build_problem(robot, [Table(tracker, "position"), Table(bar, "distance")]), true
    if name == "touches":
        return build_problem(robot, specified(touched(true, rng), own, joint), **CHOICES[name]), true
    there = 0.0 if name in ("no joint noise", "joints drowned") else SIGMA_JOINT
    m = measure(true, n, rng, sigma=SIGMA, sigma_joint=there, n_test=n // 3)
    if name == "joints drowned":
        m = replace(m, sigma_joint=np.full(4, SIGMA_JOINT))
    return build_problem(robot, specified(m, own, joint), **CHOICES[name]), true


def factors_of(solution):
    return dict(solution.problem.state.factors)


def dense_model(solution):
    """[J r] with the priors' rows, the covariance of each noise's part, and of the priors, at a solution.

    Priors are rows of variance 1; parts are by kind, then the joints'. No pairs here: own noise is diagonal.
    """
    problem, x = solution.problem, solution.parameters
    A, of_joints, C = dense(problem, x)
    J, r = A[:, :-1], A[:, -1]
    L = of_joints.reshape(len(r), -1)
    own = C - L @ L.T
    kinds = np.concatenate([
        np.tile([name.partition(".")[0] for name in s.kind.names], len(s.train)) for s in problem.data.blocks
    ])  # fmt: skip
    parts = [own * np.equal.outer(kinds, [k])[:, 0, None] for k in dict.fromkeys(kinds)]
    residual, rows = prior_rows(problem.variables, x)
    wide = np.zeros((len(rows), J.shape[1]))
    wide[:, : rows.shape[1]] = rows
    return J, r, [*parts, L @ L.T], wide, residual


def spare_of(problem):
    """Covariance that rows are weighted by on top of their noise: of distances alone."""
    rows = problem.rows
    W = whitener_of(problem.noises[0], rows.parts[0])[:, 0, 0]
    return np.diag(np.asarray(rows.spare.power(2).sum(axis=1)).ravel() / W**2)


DENSE = ["pose", "star of distances", "tables", "frame unknown", "encoder estimated", "touches", "all distances"]


@pytest.mark.parametrize("name", DENSE)
def test_components_are_those_of_the_dense_covariance(name):
    problem, _ = draw(name, np.random.default_rng(1), own=0.8, joint=1.3, n=14)
    state = replace(problem.state, factors={(0, "position"): 1.7, (0, "distance"): 0.6, JOINT_NOISE: 1.4})
    solution = solve(relinearized_at(problem, problem.start, state))
    problem = relinearized_at(solution.problem, solution.parameters, replace(solution.problem.state))
    solution = replace(solution, problem=problem)
    J, r, parts, rows, of_priors = dense_model(solution)
    F = spare_of(problem) if "distances" in name else np.zeros((len(r), len(r)))
    parts[0] = parts[0] - F
    inverse = np.linalg.inv(sum(parts) + F)
    H = J.T @ inverse @ J + rows.T @ rows
    P = inverse - inverse @ J @ np.linalg.solve(H, J.T @ inverse)
    found = noise_components(solution)
    e = inverse @ (r - J @ np.linalg.solve(H, J.T @ inverse @ r + rows.T @ of_priors))  # at the linear optimum
    assert found.names[-1] == JOINT_NOISE
    squares = np.array([e @ V @ e for V in parts])
    expected = np.array([np.trace(P @ V) - np.trace(P @ V @ P @ F) for V in parts])
    information = np.array([[e @ V @ P @ U @ e for U in parts] for V in parts])
    assert found.squares == pytest.approx(squares, rel=1e-5)
    assert found.expected == pytest.approx(expected, rel=1e-5)
    ratio = np.sqrt(squares / expected)
    assert found.information == pytest.approx(information / np.outer(ratio, ratio), rel=1e-5)


def test_without_joint_noise_the_components_are_sums_of_squares_and_redundancies_of_kinds():
    problem, _ = draw("no joint noise", np.random.default_rng(2), joint=0.0)
    solution = solve(problem)
    found, kinds = noise_components(solution), assess(solution).fit.goodness.kinds
    assert found.names == tuple((fit.table, fit.kind) for fit in kinds)
    assert found.squares == pytest.approx([fit.chi2 for fit in kinds], rel=1e-9)
    assert found.expected == pytest.approx([fit.expected for fit in kinds], rel=1e-9)
    assert JOINT_NOISE not in factors_of(estimate_noise(problem))


@pytest.mark.parametrize(("own", "joint", "wrong"), [(1.0, 1.0, ()), (0.1, 1.0, (0, 1)), (1.0, 10.0, (2,))])
def test_of_noise_that_rows_hardly_see_what_is_far_off_alone_is_estimated(own, joint, wrong, monkeypatch):
    monkeypatch.setattr(estimation, "LEAST_REDUNDANCY", 1e6)
    solution = estimate_noise(draw("pose", np.random.default_rng(4), own, joint, n=20)[0])
    names = (0, "orientation"), (0, "position"), JOINT_NOISE
    assert solution.estimated_noise == tuple(names[k] for k in wrong)
    expected = {name: (1.0 / own, 1.0 / own, 1.0 / joint)[k] for k, name in enumerate(names)}
    assert factors_of(solution) == pytest.approx(expected, rel=0.4)


def test_rows_of_no_weight_show_no_noise():
    """Components are those of the other rows alone."""
    problem, _ = draw("pose", np.random.default_rng(3), n=14)
    out = np.isin(np.arange(problem.measurements.n_configurations), [2, 5])
    state = replace(problem.state, weights=(np.where(out, 0.0, 1.0),))
    m = replace(problem.measurements, test=problem.measurements.test | out)
    others = relinearized_at(build_problem(problem.robot, m, model="pose"), problem.start)
    weighted = relinearized_at(problem, problem.start, state)
    found, expected = (noise_components(solve(one)) for one in (weighted, others))
    assert found.squares == pytest.approx(expected.squares, rel=1e-5)
    assert found.expected == pytest.approx(expected.expected, rel=1e-5)
    assert found.information == pytest.approx(expected.information, rel=1e-5)


@cache
def estimated(name, own=1 / 3, joint=2.0):
    problem, true = draw(name, np.random.default_rng(4), own, joint)
    return estimate_noise(problem), true


@pytest.mark.parametrize("name", ["pose", "tables"])
def test_own_noise_and_that_of_the_joints_are_told_apart(name):
    """Each within four of its own sigmas; its degrees of freedom are 15 at least, or 5 of lengths."""
    solution, _ = estimated(name)
    found = factors_of(solution)
    assert set(solution.estimated_noise) == set(found)
    assert found.pop(JOINT_NOISE) == pytest.approx(0.5, rel=4 / np.sqrt(2 * 15))
    for (_, kind), factor in found.items():
        sigma = 1 / np.sqrt(2 * (5 if kind == "distance" else 15))
        assert np.log(factor) == pytest.approx(np.log(3.0), abs=4 * sigma)


def test_joint_noise_that_is_not_there_goes_to_nothing():
    solution, _ = estimated("joints drowned", joint=1.0)
    found = factors_of(solution)
    assert JOINT_NOISE in solution.estimated_noise
    assert found.pop(JOINT_NOISE) < 0.3
    assert list(found.values()) == pytest.approx([3.0, 3.0], rel=4 / np.sqrt(2 * 60))


def test_factors_of_own_and_joint_noise_that_do_not_settle_are_a_finding(monkeypatch):
    monkeypatch.setattr(estimation, "MAX_ROUNDS", 1)
    solution = estimate_noise(draw("pose", np.random.default_rng(11))[0])
    assert not solution.converged
    assert assess(solution).verdict.errors[0].startswith("not converged: the estimated noise still moved by ")


def test_degrees_of_freedom_of_an_origin_are_those_that_others_leave_it():
    information = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.0], [0.5, 0.0, 2.0]])
    found = NoiseComponents(((0, "distance"), (0, "angle"), JOINT_NOISE), np.ones(3), np.ones(3), information)
    assert found.degrees(0, np.array([], dtype=np.int64)) == pytest.approx(4.0)
    assert found.degrees(0, np.array([0, 1])) == pytest.approx(4.0 - 1.0 / 9.0)
    assert found.degrees(1, np.array([0, 2])) == pytest.approx(9.0 - 1.0 / (4.0 - 0.25 / 2.0))
