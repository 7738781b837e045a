"""Scales of prior sigmas: their posterior against dense formulas, and estimated with the fit of whole arms."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from instruments import measured_by
from oracle import central_differences
from scipy.stats import chi2, multivariate_normal, norm
from simulated import TOOL, measure, small_arm, true_robot
from tolerances import NEGLIGIBLE, rounding, sigmas_apart

from fg_calib import InputError, Options, assess, build_problem, solve
from fg_calib.graph import prior_rows, square_root, unknown_prior_rows
from fg_calib.graph.build import FIRST_TOLERANCE
from fg_calib.statistics import estimate_noise, estimate_tolerances, spread_of
from fg_calib.statistics import priors as priors_module
from fg_calib.statistics.priors import COMMON_SIGMA, GROUP_SIGMA, Corrections, ScalePosterior, fit_scales

GROUP = np.array([0, 0, 0, 1, 1, 2])


def drawn(rng, scale, rows=9, noise=0.3, group=GROUP, unseen=()):
    """Rows of unit noise of corrections that are so many tolerances large, and what they say of these."""
    R = rng.normal(size=(rows, len(group))) / noise
    R[:, list(unseen)] = 0.0
    z = R @ (np.asarray(scale)[group] * rng.normal(size=len(group))) + rng.normal(size=rows)
    return R, z, Corrections(R.T @ R, R.T @ z, group)


def guess(n):
    """The covariance of the logarithms of scales before any data."""
    return COMMON_SIGMA**2 * np.ones((n, n)) + GROUP_SIGMA**2 * np.eye(n)


def test_the_scale_posterior_is_the_density_of_the_rows_with_the_corrections_integrated_out():
    rng = np.random.default_rng(0)
    R, z, corrections = drawn(rng, [1.0, 3.0, 0.2])

    def dense(theta):
        covariance = np.eye(len(z)) + R @ np.diag(np.exp(2.0 * theta[GROUP])) @ R.T
        return multivariate_normal(cov=covariance).logpdf(z) + multivariate_normal(cov=guess(3)).logpdf(theta)

    a, b = rng.normal(size=(2, 3))
    found = ScalePosterior(corrections, a).value - ScalePosterior(corrections, b).value
    assert found == pytest.approx(dense(a) - dense(b), abs=rounding(z @ z))


def test_gradient_and_curvature_of_the_posterior_are_its_differences():
    rng = np.random.default_rng(1)
    _, _, corrections = drawn(rng, [1.0, 3.0, 0.2])
    theta, h = 0.5 * rng.normal(size=3), 1e-4
    at = ScalePosterior(corrections, theta)
    slope = central_differences(lambda x: ScalePosterior(corrections, x).value, theta, h)
    np.testing.assert_allclose(slope, at.gradient, rtol=1e-6)  # h^2 of the third derivative
    curvature = central_differences(lambda x: ScalePosterior(corrections, x).gradient, theta, h)
    np.testing.assert_allclose(curvature, at.hessian, rtol=1e-6)


def test_the_normal_approximation_is_near_a_skew_posterior_on_a_fine_grid():
    """Three corrections, two of them determined badly: mean, interval, and what an unknown scale adds."""
    *_, corrections = drawn(np.random.default_rng(3), [2.0], rows=3, noise=1.5, group=np.zeros(3, dtype=np.int64))
    found = fit_scales(corrections)
    grid = np.linspace(-12.0, 8.0, 1001)
    points = [ScalePosterior(corrections, np.array([t])) for t in grid]
    density = np.exp([p.value - max(q.value for q in points[::50]) for p in points])
    density /= density.sum()
    mean = density @ grid
    sd = np.sqrt(density @ (grid - mean) ** 2)
    assert abs(found.mean.theta[0] - mean) < 0.1 * sd
    np.testing.assert_allclose(np.ptp(found.interval), 2.0 * 1.96 * sd, rtol=0.05)
    away = [p.estimate - found.mean.estimate for p in points]
    whole = sum(d * (p.covariance + np.outer(o, o)) for d, p, o in zip(density, points, away, strict=True))
    np.testing.assert_allclose(np.diag(found.added_covariance + found.mean.covariance), np.diag(whole), rtol=0.3)


def test_a_group_that_rows_do_not_determine_goes_with_the_others():
    """As far as a common factor explains these, and it is known no better than a group is against the others."""
    *_, corrections = drawn(np.random.default_rng(4), [10.0, 10.0, 1.0], rows=200, noise=1e-3, unseen=[5])
    found = fit_scales(corrections)
    assert found.mean.determined[2] == pytest.approx(0.0, abs=rounding())
    share = guess(3)[2, :2] @ np.linalg.inv(guess(3)[:2, :2])
    assert found.mean.theta[2] == pytest.approx(share @ found.mean.theta[:2], abs=0.1)
    low, high = found.interval
    assert high[2] - low[2] > 3.0 * GROUP_SIGMA


def test_tolerances_that_rows_do_not_determine_stay_as_specified():
    corrections = Corrections(np.zeros((6, 6)), np.zeros(6), GROUP)
    found = fit_scales(corrections)
    half = norm.ppf(0.975) * np.sqrt(guess(1)[0, 0])
    np.testing.assert_allclose(found.mean.theta, 0.0, atol=0.1 * half)
    low, high = found.interval
    np.testing.assert_allclose(high, half, rtol=0.15)
    np.testing.assert_allclose(low, -half, rtol=0.15)


def test_one_correction_that_is_nil_does_not_make_its_tolerance_nothing():
    found = fit_scales(Corrections(np.array([[1e8]]), np.zeros(1), np.zeros(1, dtype=np.int64)))
    assert 1e-3 < np.exp(found.mean.theta[0]) < 1.0


def test_many_good_rows_leave_what_the_corrections_themselves_say():
    """Six corrections known exactly: the scale is their RMS but for its guess, known to 1 / sqrt(12)."""
    rng, group = np.random.default_rng(5), np.zeros(6, dtype=np.int64)
    u = 7.0 * rng.normal(size=6)
    found = fit_scales(Corrections(1e10 * np.eye(6), 1e10 * u, group))
    assert found.mean.theta[0] == pytest.approx(np.log(np.sqrt(np.mean(u**2))), abs=0.15)
    assert np.ptp(found.interval) == pytest.approx(2.0 * 1.96 / np.sqrt(12.0), rel=0.15)
    assert found.mean.determined[0] == pytest.approx(6.0, abs=1e-6)


SPECIFIED = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3}
TRUE = {"a": 3e-3, "d": 3e-4, "alpha": 8e-3, "theta": 1e-3}


def drawn_problem(model="pose", n=12, seed=0, n_test=0, **choices):
    """A problem of an arm whose errors are other than specified, and its true robot."""
    rng = np.random.default_rng(seed)
    true = true_robot(small_arm(tolerance=TRUE), rng)
    m = measure(true, n, rng, sigma=(1e-4, 1e-4), n_test=n_test)
    return build_problem(small_arm(tolerance=SPECIFIED), m, model=model, **choices), true


@cache
def solved():
    return estimate_tolerances(drawn_problem(estimate_tolerance="kind")[0])


def tolerances_of(solution):
    return {p.kind: p.tolerance for p in solution.problem.robot.parameters if p.tolerance is not None}


def test_scales_of_every_kind_are_found_within_their_intervals():
    for one in solved().estimated_tolerances.scales:
        assert one.low < TRUE[one.group] / SPECIFIED[one.group] < one.high
        assert one.low < one.scale < one.high
        assert len(one.parameters) == 4
        assert 1.5 < one.seen < 4.0 + NEGLIGIBLE


def test_the_estimate_is_that_with_the_tolerances_found_specified():
    robot = small_arm(tolerance=tolerances_of(solved()))
    again = solve(build_problem(robot, solved().problem.measurements, model="pose"))
    sigma = np.array([p.sigma or 0.0 for p in assess(again).estimates.parameters])
    n = len(sigma)
    assert sigmas_apart(solved().parameters[:n], again.parameters[:n], sigma) < NEGLIGIBLE


def test_not_knowing_the_scales_makes_sigmas_larger():
    problem, _ = drawn_problem("distance", n=14, estimate_tolerance="kind")
    solution = estimate_tolerances(problem)
    found, known = assess(solution), assess(replace(solution, estimated_tolerances=None))
    assert (found.fit.chi_square.p_value, known.fit.chi_square.p_value is None) == (None, False)
    both = zip(found.estimates.parameters, known.estimates.parameters, strict=True)
    wider = [a.sigma / b.sigma for a, b in both if b.sigma]
    assert min(wider) > 0.9  # that of a mean scale need not be the least
    assert np.median(wider) > 1.02


@pytest.mark.usefixtures("without_reasons", "without_mistakes")
def test_corrections_beyond_their_tolerances_are_no_finding_once_these_are_estimated():
    problem, _ = drawn_problem()
    assert any("corrections" in finding for finding in assess(solve(problem)).verdict.errors)
    assert not assess(solved()).verdict.errors


def test_joints_without_tolerances_start_from_a_millimetre_and_a_milliradian():
    """Base and tool do not: theirs may be anywhere."""
    rng = np.random.default_rng(0)
    m = measure(true_robot(small_arm(tolerance=TRUE), rng), 12, rng)
    bare = build_problem(small_arm(estimate=TOOL), m, model="pose", estimate_tolerance="kind")
    arm = {p.name: p.tolerance for p in bare.robot.parameters if p.estimated}
    assert {arm.pop(name) for name in TOOL} == {None}
    assert set(arm.values()) == {FIRST_TOLERANCE}


def test_noise_and_tolerances_are_estimated_together():
    problem, _ = drawn_problem(n=30, estimate_tolerance="kind", estimate_noise=True)
    tripled = replace(problem.measurements, sigma_position=3.0 * problem.measurements.sigma_position)
    problem = build_problem(problem.robot, tripled, problem.options)
    solution = estimate_tolerances(problem, estimate_noise)
    assert solution.converged
    assert solution.problem.state.factors[0, "position"] == pytest.approx(1.0 / 3.0, rel=0.35)
    for one in solution.estimated_tolerances.scales:
        assert one.low < TRUE[one.group] / SPECIFIED[one.group] < one.high


def test_an_arm_that_is_only_evaluated_keeps_its_tolerances():
    problem, _ = drawn_problem(n=0, n_test=12, frame="unknown", estimate_tolerance="kind")
    assert estimate_tolerances(problem).estimated_tolerances is None


@pytest.mark.parametrize("choices", [{"gauge": "keep"}, {"gauge": "none"}, {"prior": False}])
def test_without_priors_there_is_nothing_to_estimate(choices):
    with pytest.raises(InputError, match=r"^tolerance: to be estimated with gauge: \w+, expected gauge: prior"):
        Options.of(estimate_tolerance="kind", **choices)


def test_a_correction_varies_by_what_the_data_take_off_its_prior_variance():
    """Prior T and posterior s: the correction over T has the variance 1 - (s / T)^2."""
    problem, _ = drawn_problem("pose", n=4)
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


def test_what_has_no_prior_follows_the_corrections():
    """The information on the corrections is that of the rows, the measurement frame moved along."""
    problem, _ = drawn_problem(frame="unknown")
    solution, n = solve(problem), len(prior_rows(problem.variables, problem.start)[0])
    sizes, groups = np.ones(n), np.zeros(n, dtype=np.int64)
    corrections, follow = priors_module._corrections(solution, problem.variables, sizes, groups)
    rows = solution.problem.linearize(solution.parameters).left.A @ follow
    np.testing.assert_allclose(rows.T @ rows, corrections.information, rtol=1e-6, atol=1e-6 * np.max(rows**2))
