"""Effects beyond the geometry: the prior sigma of error curves by marginal likelihood, and which of them are kept."""

from dataclasses import replace

import numpy as np
import pytest

from fg_calib import Measurements, Options, Robot, build_problem
from fg_calib.graph import solve
from fg_calib.robot import ErrorCurve, build_chain, forward
from fg_calib.selection import estimate_curve_sigma
from fg_calib.statistics import estimate_noise

ROWS = [(0.1, 1.4, 0.3, 0.2), (0.5, 0.2, 0.1, -0.3), (0.3, -1.2, 0.2, 0.1), (0.05, 0.7, 0.1, 0.4)]  # a, alpha, d, theta
TOLERANCE = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
SIGMA, N_COEFFICIENTS = 8e-4, 40


def arm(*effects):
    return Robot.from_dh(ROWS, "dh", tool=[0.1, 0, 0.2], tolerance=TOLERANCE).with_effects(*effects)


def with_prior(robot, sigma):
    """The robot with the same tolerance of all coefficients of error curves."""
    return replace(robot, parameters=tuple(
        replace(p, tolerance=sigma) if p.kind == "curve" else p for p in robot.parameters
    ))  # fmt: skip


def measured(true, seed, n=80, sigma=1e-4):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-3.1, 3.1, (n, 4))
    p = forward(build_chain(true), true.trig(q)).position + sigma * rng.normal(size=(n, 3))
    return Measurements.from_arrays(q, position=p, sigma_position=1e-4)


def drawn(robot, seed):
    rng = np.random.default_rng(seed)
    tolerance = np.array([p.tolerance or 0.0 for p in robot.parameters])
    return robot.with_values(robot.nominal + tolerance * rng.normal(size=len(tolerance)))


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("free_noise", [False, True])
def test_sigma_of_curves_is_found_from_a_tenth_and_from_ten_times_of_it(factor, free_noise):
    robot = with_prior(arm(ErrorCurve([2, 3], 20)), SIGMA)
    problem = build_problem(with_prior(robot, factor * SIGMA), measured(drawn(robot, 1), 1), Options(model="position"))
    solution = estimate_curve_sigma(problem, estimate_noise if free_noise else solve)
    found = {p.tolerance for p in solution.problem.robot.parameters if p.kind == "curve"}
    assert solution.converged
    assert found == {sigma for v in solution.problem.variables.nuisance for sigma in v.prior[1]}
    (sigma,) = found
    variance = np.sum(solution.system.full_root[-N_COEFFICIENTS:] ** 2)
    gamma = N_COEFFICIENTS - variance / sigma**2
    c = solution.parameters[[i for i, p in enumerate(robot.parameters) if p.kind == "curve"]]
    assert sigma == pytest.approx(np.sqrt(c @ c / gamma), rel=0.01)  # the fixed point
    assert sigma == pytest.approx(SIGMA, abs=4.0 * SIGMA / np.sqrt(2.0 * gamma))  # 4 sigma


def test_errors_are_within_their_sigmas_with_an_estimated_prior_of_curves():
    squares, n_draws = [], 8
    for seed in range(n_draws):
        robot = with_prior(arm(ErrorCurve([2, 3], 20)), SIGMA)
        true = drawn(robot, seed)
        solution = estimate_curve_sigma(
            build_problem(with_prior(robot, SIGMA / 10.0), measured(true, seed), Options(model="position"))
        )
        v = solution.problem.variables
        each = (*v.items, *v.nuisance)
        columns, places = np.concatenate([np.r_[i.columns] for i in each]), np.concatenate([i.places for i in each])
        e = solution.parameters[places] - true.nominal[places]
        C = solution.system.full_root[columns] @ solution.system.full_root[columns].T
        n = v.n_columns
        squares.append([e[k] @ np.linalg.solve(C[k, k], e[k]) / len(e[k]) for k in (slice(n), slice(n, None))])
    for mean, size in zip(np.mean(squares, axis=0), (n, N_COEFFICIENTS), strict=True):
        assert mean == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (n_draws * size)))  # 4 sigma


def test_a_specified_sigma_of_curves_is_kept():
    robot = arm(ErrorCurve([2, 3], 20, 3.0 * SIGMA))
    problem = build_problem(robot, measured(drawn(robot, 1), 1), Options(model="position"))
    found = estimate_curve_sigma(problem).problem.robot
    assert {p.tolerance for p in found.parameters if p.kind == "curve"} == {3.0 * SIGMA}
