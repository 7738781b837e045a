"""Corrections against their prior sigmas: of parameters and places, by dense formulas."""

import numpy as np
import pytest
from instruments import measured_by
from scipy.stats import chi2
from simulated import measure_drawn, small_arm

from fg_calib import assess, build_problem, solve
from fg_calib.graph import prior_rows, square_root, unknown_prior_rows
from fg_calib.statistics import priors as priors_module
from fg_calib.statistics import spread_of

SPECIFIED = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3}
TRUE = {"a": 3e-3, "d": 3e-4, "alpha": 8e-3, "theta": 1e-3}


def test_a_correction_varies_by_what_the_data_take_off_its_prior_variance():
    """Prior T and posterior s: the correction over T has the variance 1 - (s / T)^2."""
    m = measure_drawn(small_arm(tolerance=TRUE), 4, seed=0, sigma=(1e-4, 1e-4))
    problem = build_problem(small_arm(tolerance=SPECIFIED), m, model="pose")
    found = assess(solve(problem))
    by_name = {p.name: p for p in found.estimates.parameters}
    priors = found.fit.priors
    assert len(priors.names) == 16
    for name, z, sigma in zip(priors.names, priors.z, priors.sigma, strict=True):
        p = by_name[name]
        assert z == pytest.approx(p.correction / p.prior_sigma, rel=1e-6)
        assert sigma == pytest.approx(np.sqrt(1.0 - (p.sigma / p.prior_sigma) ** 2), rel=1e-6, abs=1e-6)
    assert priors.chi2 == pytest.approx(np.sum(priors.z**2))
    assert priors.expected == pytest.approx(np.sum(priors.sigma**2))
    P = prior_rows(problem.variables, found.spread.parameters)[1]
    A = np.eye(16) - P @ found.spread.tangent @ P.T
    nu = np.trace(A) ** 2 / np.sum(A * A)
    assert priors.p_value == pytest.approx(chi2.sf(nu * priors.chi2 / priors.expected, nu))


def test_corrections_of_places_are_in_their_prior_sigmas_on_each_axis():
    robot, _, table = measured_by("anchors nearly", np.random.default_rng(3), n=12)
    found = assess(solve(build_problem(robot, [table])))
    priors, places = found.fit.priors, [one for one in found.estimates.landmarks if one.name in table.known]
    z = np.concatenate([place.xyz - table.known[place.name].xyz for place in places]) / 1e-3
    assert priors.names[-9:] == tuple(np.repeat([f"anchor {place.name}" for place in places], 3))
    np.testing.assert_allclose(priors.z[-9:], z, rtol=1e-6)


def test_corrections_of_parameters_and_places_covary_as_the_information_on_both_says():
    robot, _, table = measured_by("anchors nearly", np.random.default_rng(3), n=12)
    solution = solve(build_problem(robot, [table]))
    v, x = solution.problem.variables, solution.parameters
    P, rows = prior_rows(v, x)[1], square_root(solution.problem, x)[:, :-1]
    P = np.pad(P, ((0, 0), (0, v.n_nuisance)))
    H = rows.T @ rows + P.T @ P  # the rows of places are among the others
    every = np.vstack([P, unknown_prior_rows(v, x)[1]])
    A = priors_module._judged_rows(solution, spread_of(solution))[2]
    np.testing.assert_allclose(A, np.eye(len(every)) - every @ np.linalg.solve(H, every.T), atol=1e-7)


def test_a_correction_beyond_its_prior_is_named_and_what_follows_it_is_not():
    """The second is 9 sigma off because the first is 10: without that prior it is met."""
    A = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 0.25]])
    found = list(priors_module._beyond(("a", "b", "c"), np.array([10.0, 9.0, 2.5]), A, 3))
    assert [(one.name, one.z, one.is_place) for one in found] == [("a", 10.0, False), ("c", 2.5, False)]
    assert found[1].sigma == 0.5
    assert not list(priors_module._beyond(("a", "b", "c"), np.array([2.5, 2.5, 1.0]), A, 3))
    # On an axis that data do not see a place is off by rounding.
    assert not list(priors_module._beyond(("a", "a", "a"), np.array([2.5, 0.0, 3e-3]), np.diag([1.0, 1.0, 0.0]), 0))


def test_a_correction_is_judged_by_what_it_varies_by_without_the_priors_before_it():
    """The second is 2.1 from what the first makes of it, 0.9 of it, and varies by 1 - 0.9^2: 4.8 sigma."""
    A = np.array([[1.0, 0.9], [0.9, 1.0]])
    assert [one.name for one in priors_module._beyond(("a", "b"), np.array([30.0, 29.1]), A, 2)] == ["a", "b"]
    assert [one.name for one in priors_module._beyond(("a", "b"), np.array([30.0, 28.3]), A, 2)] == ["a"]
