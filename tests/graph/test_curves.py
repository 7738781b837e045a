"""Error curves in the graph: eliminated as sparse states they give what a dense system, and GTSAM, give."""

import gtsam
import numpy as np
import pytest
from simulated import arm_with, errors_of_all, measure_points, small_arm, within_tolerance
from touches import corners, touch

from fg_calib import Options, build_problem, solve
from fg_calib.graph import NormalSystem, prior_rows, unknown_prior_rows
from fg_calib.graph.normal_system import eliminate_more
from fg_calib.graph.problem import loaded_at, with_factors
from fg_calib.robot import Compliance, ErrorCurve, Mass

EFFECTS = (ErrorCurve([2, 3], knots=8, sigma=1e-3), Compliance([Mass(3, 10.0, (0.2, 0.0, 0.1))], [2, 3]))


def problem_of(model="position", n=40, seed=0, reach=2.5, **options):
    """An arm with error curves and compliance, measured where joints are within some angle of zero."""
    rng = np.random.default_rng(seed)
    robot = arm_with(*EFFECTS)
    true = within_tolerance(robot, rng)
    data = measure_points(true, rng.uniform(-reach, reach, (n, 4)), rng)
    return build_problem(robot, data, Options(model=model, gauge="prior", **options)), true


@pytest.mark.parametrize(("model", "reach", "var"), [("position", 2.5, 1), ("position", 0.6, 2), ("distance", 0.6, 2)])
def test_sparse_elimination_gives_the_dense_system(model, reach, var):
    problem, _ = problem_of(model, reach=reach, pair_errors="independent")  # some knots are out of reach
    v, x = problem.variables, problem.start.copy()
    x[: len(problem.robot.parameters)] += 1e-4 * np.random.default_rng(1).normal(size=len(problem.robot.parameters))
    priors, own = (np.column_stack(of(v, x)[::-1]) for of in (prior_rows, unknown_prior_rows))
    rows = np.vstack([own, problem.rows.square_root(v.at(x)) / np.sqrt(var)])
    left = eliminate_more(problem.rows.without_curves(v.at(x), var), np.zeros((0, v.n_columns + 1)), v.n_columns)
    found, expected = (NormalSystem(of, v.n_columns, v.prior_scales, priors) for of in (left, rows))
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    sigma = np.linalg.norm(expected.full_root, axis=1)
    assert found.step / sigma == pytest.approx(expected.step / sigma, abs=1e-6)  # [sigma]
    C, D = (s.full_root @ s.full_root.T / np.outer(sigma, sigma) for s in (found, expected))
    assert pytest.approx(D, abs=1e-8) == C
    held = problem.linearize(x, held=True)
    assert held.cost == pytest.approx(problem.linearize(x).cost, rel=1e-9)
    assert not held.step[v.n_columns :].any()


def test_a_point_has_the_loads_of_its_parameters():
    problem, true = problem_of()
    x = np.concatenate([true.nominal, problem.start[len(true.nominal) :]])
    cost = with_factors(problem, x).system.cost
    assert loaded_at(problem, x).system.cost == pytest.approx(cost, rel=1e-12)
    assert problem.linearize(x).cost != pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize("model", ["position", "distance"])
def test_gtsam_agrees_on_optimum_and_covariance_of_curves(model):
    problem, _ = problem_of(model)
    solution = solve(problem)
    problem = solution.problem
    values = gtsam.LevenbergMarquardtOptimizer(problem.graph, solution.values).optimize()
    marginals = gtsam.Marginals(problem.graph.linearize(values), values)
    root = solution.system.full_root
    curves = [v for v in problem.variables.nuisance if v.kind == "curve"]
    assert [v.symbol for v in curves] == ["S(2)", "S(3)"]
    assert {v.symbol for v in problem.variables.items} >= {"E(2)", "E(3)"}
    for v in [*curves, *(v for v in problem.variables.items if v.letter == "E")]:
        sigma = np.linalg.norm(root[v.columns], axis=1)
        found, C = values.atVector(v.key), marginals.marginalCovariance(v.key)
        assert solution.parameters[v.places] / sigma == pytest.approx(found / sigma, abs=2e-3)  # of GTSAM's stop
        assert np.sqrt(np.diag(C)) == pytest.approx(sigma, rel=1e-4)


def test_curves_and_compliance_are_within_their_sigmas():
    squares = []
    for seed in range(6):
        problem, true = problem_of(seed=seed)
        e, root = errors_of_all(solve(problem), true)
        squares.append(e @ np.linalg.pinv(root @ root.T, rcond=1e-12) @ e / root.shape[1])
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (6 * root.shape[1])))  # 4 sigma of the mean


def test_points_in_contact_and_distances_between_them_tell_curves():
    rng = np.random.default_rng(4)
    robot = small_arm({"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3}).with_effects(ErrorCurve([2, 4], knots=8))
    true = within_tolerance(robot, rng)
    apart = [(0, k, 1e-4) for k in range(1, 8)]
    data = touch(true, corners(robot, 8, rng), 10, rng, distances=apart)
    solution = solve(build_problem(robot, data, Options(model="distance")))
    curves = np.concatenate([v.places for v in solution.problem.variables.nuisance if v.kind == "curve"])
    root = solution.system.full_root[solution.problem.variables.n_columns :][: len(curves)]
    z = np.linalg.solve(np.linalg.cholesky(root @ root.T), solution.parameters[curves] - true.nominal[curves])
    assert z @ z / len(z) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / len(z)))
