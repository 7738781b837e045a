"""Goodness of fit: by kind, by row, by configuration, under repetition; and noise estimated from the residuals."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest
from simulated import measure, small_arm, true_robot

from fg_calib.analysis import goodness as goodness_module
from fg_calib.analysis import variance_components as noise
from fg_calib.analysis.covariance import spread_of
from fg_calib.analysis.goodness import FLAGS, KindFit, kind_fits
from fg_calib.analysis.residual_table import residual_table
from fg_calib.analysis.uncertainty import assess
from fg_calib.analysis.variance_components import estimate_noise
from fg_calib.graph import problem as problem_module
from fg_calib.graph.problem import build_problem
from fg_calib.graph.solver import SolverOptions, solve
from fg_calib.graph.whitening import Adjustment
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Pairs, rotation_angle
from fg_calib.options import Pairing
from fg_calib.report.documents import result_document
from fg_calib.report.text import format_report
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}


def measured_directly(m, robot, rng, a, b, sigma=(1e-3, 5e-4), sigma_joint=0.0):
    """Pairs of the true robot measured directly, with noise; the joint errors are those of each configuration."""
    q = m.readings + sigma_joint * rng.normal(size=m.readings.shape)
    at, n = pose(robot, q), len(a)
    distance = np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma[0] * rng.normal(size=n)
    angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma[1] * rng.normal(size=n)
    pairs = Pairs(a, b, distance, angle, np.full(n, sigma[0]), np.full(n, sigma[1]), np.zeros(n, dtype=bool))
    return replace(m, position=None, rotation=None, pairs=pairs, sigma_joint=np.full(robot.n_joints, sigma_joint))


def case(name, robot, rng, n=16, stated=1.0):
    """A problem of a drawn true robot; noise stated is `stated` times the noise there is."""
    true = true_robot(robot, rng)
    if name.startswith("direct"):
        sigma_joint = 3e-4 if "joint" in name else 0.0
        a = np.concatenate([np.arange(n), np.arange(n)])
        b = np.concatenate([np.roll(np.arange(n), 1), np.roll(np.arange(n), 3)])
        m = measured_directly(measure(true, n, rng), true, rng, a, b, sigma_joint=sigma_joint)
        m = replace(
            m,
            pairs=replace(
                m.pairs, sigma_distance=m.pairs.sigma_distance * stated, sigma_angle=m.pairs.sigma_angle * stated
            ),
        )
        return build_problem(robot, m, model="distance-rotation")
    sigma_joint = 3e-4 if "joint" in name else 0.0
    m = measure(true, n, rng, sigma=(1e-3, 5e-4), sigma_joint=sigma_joint)
    m = replace(m, sigma_position=m.sigma_position * stated, sigma_orientation=m.sigma_orientation * stated)
    if name.startswith("pose"):
        return build_problem(robot, m, model="pose")
    pairing, *rest = name.split()
    errors = "independent" if "independent" in rest else "shared"
    return build_problem(robot, m, model="distance-rotation", pairing=Pairing(pairing), pair_errors=errors)


RUNS = {"pose": 200, "star": 70, "all": 40, "direct": 100, "direct joint": 60}
RUNS |= {"pose joint": 60, "star joint": 60, "star independent": 60}


@pytest.mark.parametrize(("name", "n_runs"), RUNS.items())
@pytest.mark.slow
def test_p_values_are_uniform_and_the_noise_seen_is_the_noise_there_is(name, n_runs):
    """Over calibrations of an arm drawn from its tolerances, at a fixed seed.

    Kolmogorov-Smirnov at 0.1 %: by Satterthwaite's approximation a kind's p-value is uniform only nearly. The sum of
    at least 6 n_runs squares has a relative sigma of sqrt(2 / 6 / n_runs); the root half of it.
    """
    rng = np.random.default_rng(7)
    robot = small_arm(tolerance=TOLERANCE)
    by_kind, squares, overall = {}, {}, []
    for _ in range(n_runs):
        uncertainty = assess(solve(case(name, robot, rng)))
        overall.append(uncertainty.p_value)
        for fit in uncertainty.goodness.kinds:
            by_kind.setdefault(fit.kind, []).append(fit.p_value)
            squares.setdefault(fit.kind, []).append((fit.chi2, fit.expected))
    if "independent" not in name:
        assert kstest(overall, "uniform").pvalue > 1e-3
    for kind, p in by_kind.items():
        assert kstest(p, "uniform").pvalue > 1e-3
        chi2, expected = np.sum(squares[kind], axis=0)
        assert np.sqrt(chi2 / expected) == pytest.approx(1.0, abs=4 * np.sqrt(1 / 12 / n_runs))


@pytest.mark.parametrize("max_shared", [3000, 0])
@pytest.mark.slow
def test_the_noise_seen_is_unbiased_where_rows_count_as_independent_but_are_not(max_shared, monkeypatch):
    """All pairs of 12 poses share so much that the sum of squares is far below rows less parameters.

    About 10 degrees of freedom a run and kind: 4 sigma are 4 * sqrt(2 / 10 / 60) / 2 = 0.11.
    """
    monkeypatch.setattr(problem_module, "MAX_SHARED", max_shared)
    rng = np.random.default_rng(1)
    robot = small_arm(tolerance=TOLERANCE)
    sums = np.zeros((2, 2))
    for _ in range(60):
        fits = kinds_of(solve(case("all", robot, rng, n=12)))
        sums += [(fit.chi2, fit.expected) for fit in fits]
    assert fits[0].n > 50
    ratio = np.sqrt(sums[:, 0] / sums[:, 1])
    assert ratio == pytest.approx(
        1.0, abs=0.06
    )  # about 10 degrees of freedom a run and kind: 4 * sqrt(1 / 20 / 60) / 2


def kinds_of(solution):
    return kind_fits(solution, spread_of(solution), residual_table(solution))


def test_leverages_are_those_of_the_hat_matrix():
    """Independent rows without priors: H = J (J^T W J)^+ J^T W, whose trace is the rank."""
    rng = np.random.default_rng(2)
    robot = small_arm()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 20, rng, n_test=4), model="pose"))
    uncertainty = assess(solution)
    table, goodness = uncertainty.residuals, uncertainty.goodness
    chain = solution.problem.variables.chain.at(solution.parameters)
    J = residuals.linearise(solution.problem.blocks[0], chain)[1].reshape(120, -1)
    H = J @ np.linalg.pinv(J, rcond=1e-9)
    assert goodness.leverage[table.used] == pytest.approx(np.diag(H), rel=1e-6)
    assert goodness.leverage[table.used].sum() == pytest.approx(uncertainty.spread.rank)
    expected = table.after / table.sigma / np.sqrt(1.0 + np.where(table.test, 1.0, -1.0) * goodness.leverage)
    assert goodness.studentised == pytest.approx(expected)
    assert {FLAGS[f] for f in goodness.flag[table.test]} == {"test"}


def test_studentised_residuals_of_fitted_and_predicted_rows_have_a_variance_of_one():
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=TOLERANCE)
    fitted, predicted = [], []
    for _ in range(40):
        m = measure(true_robot(robot, rng), 10, rng, sigma=(1e-3, 5e-4), n_test=10)
        uncertainty = assess(solve(build_problem(robot, m, model="pose")))
        table, z = uncertainty.residuals, uncertainty.goodness.studentised
        fitted.append(np.mean(z[table.used] ** 2))
        predicted.append(np.mean(z[table.test] ** 2))
    for values in (fitted, predicted):
        assert np.mean(values) == pytest.approx(1.0, abs=4 * np.std(values) / np.sqrt(40))


@pytest.mark.parametrize("wrong", [0, 7])
@pytest.mark.parametrize("name", ["star", "all", "pose"])
def test_a_configuration_wrong_by_50_sigma_is_the_first_suspect(name, wrong):
    rng = np.random.default_rng(4)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 25, rng, sigma=(1e-3, 5e-4))
    m.position[wrong] += 50e-3 * np.array([0.6, 0.0, 0.8])
    settings = {"model": "pose"} if name == "pose" else {"model": "distance-rotation", "pairing": Pairing(name)}
    solution = solve(build_problem(robot, m, **settings))
    uncertainty = assess(solution)
    table, goodness = uncertainty.residuals, uncertainty.goodness
    assert goodness.configurations[0].configuration == wrong
    worst = goodness.suspects[0]
    assert wrong in (table.a[worst], table.b[worst])
    text = format_report(solution, uncertainty)
    assert re.search(rf"Suspicious configurations\n +rows +chi-square +expected\n{wrong} ", text)
    assert re.search(rf"Suspicious rows\n(  pose {wrong} is in .*\n)?.*\n(\d+ +)?{wrong} ", text)


@pytest.mark.slow
def test_clean_tables_seldom_have_a_suspect():
    """1 % of tables have a suspect row, as many a suspect configuration: more than 4 of 60 are unlikely (0.1 %)."""
    rng = np.random.default_rng(5)
    robot = small_arm(tolerance=TOLERANCE)
    suspicious = np.zeros(2)
    for k in range(60):
        goodness = assess(solve(case(["pose joint", "star", "all"][k % 3], robot, rng))).goodness
        suspicious += [len(goodness.suspects) > 0, len(goodness.configurations) > 0]
    assert np.all(suspicious <= 4)


def test_verdicts_tell_outliers_from_noise_stated_wrong():
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=TOLERANCE)
    found = {}
    for what, stated in (("as stated", 1.0), ("too small", 0.5), ("too large", 2.0)):
        found[what] = {fit.verdict for fit in assess(solve(case("pose", robot, rng, 50, stated))).goodness.kinds}
    assert found == {what: {what} for what in found}
    m = measure(true_robot(robot, rng), 50, rng)
    m.position[[3, 30], 0] += 0.02
    fits = assess(solve(build_problem(robot, m, model="pose"))).goodness.kinds
    assert {fit.kind: fit.verdict for fit in fits} == {"orientation": "as stated", "position": "outliers"}


@pytest.mark.parametrize("name", ["pose", "star", "all", "direct joint"])
@pytest.mark.slow
def test_noise_stated_wrong_by_two_is_found(name):
    """The mean of its logarithm over some fits, 4 of its own sigmas about the truth."""
    rng = np.random.default_rng(8)
    robot = small_arm(tolerance=TOLERANCE)
    factors, n_fits = [], 25 if name == "pose" else 9
    for _ in range(n_fits):
        if name == "direct joint":  # a factor is on all the noise of a row, joint noise with it
            problem = case(name, robot, rng, n=24)
            truth = 1.0
        else:
            problem, truth = case(name, robot, rng, n=24, stated=2.0), 0.5
        solution = estimate_noise(problem)
        assert solution.converged
        factors.append(solution.problem.adjustment.factors)
    logs = np.log(np.array(factors) / truth)
    assert np.all(np.abs(logs.mean(axis=0)) < 4 * logs.std(axis=0) / np.sqrt(n_fits))
    assert np.all(logs.std(axis=0) < 0.35)


def test_estimated_noise_gives_each_kind_the_sum_of_squares_it_expects():
    rng = np.random.default_rng(9)
    robot = small_arm(tolerance=TOLERANCE)
    solution = estimate_noise(case("all", robot, rng, 20, 2.0))
    uncertainty = assess(solution)
    assert uncertainty.p_value is None
    for fit, factor in zip(uncertainty.goodness.kinds, solution.problem.adjustment.factors, strict=True):
        assert fit.factor == factor
        assert fit.chi2 == pytest.approx(fit.expected, rel=3e-3)  # twice SETTLED
        assert fit.p_value is None
    document = result_document(solution, uncertainty)
    assert tuple(document["noise_factors"].items()) == (
        ("distance", solution.problem.adjustment.factors[0]),
        ("angle", solution.problem.adjustment.factors[1]),
    )
    text = " ".join(format_report(solution, uncertainty).split())
    assert "distance and angle noise was estimated from these residuals: chi-square says nothing about it" in text


@pytest.mark.parametrize("name", ["pose joint", "star", "all"])
@pytest.mark.parametrize("wrong", [1 / 25, 25.0])
def test_estimated_noise_is_the_same_wherever_it_starts(name, wrong):
    """To a hundredth of the factor, whose own sigma is some ten times that: rows near kinks are judged as stated."""
    robot = small_arm(tolerance=TOLERANCE)
    found = []
    for stated in (1.0, wrong):
        problem = case(name, robot, np.random.default_rng(14), 24, stated)
        m = problem.measurements
        joint = replace(m, sigma_joint=stated * m.sigma_joint)
        solution = estimate_noise(problem_module.judged_at(replace(problem, measurements=joint), problem.start))
        assert solution.converged, solution.message
        found.append(stated * np.array(solution.problem.adjustment.factors))
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_a_solution_that_has_not_arrived_does_not_end_the_estimate_of_the_noise(monkeypatch):
    problem = case("pose", small_arm(tolerance=TOLERANCE), np.random.default_rng(15), 24, 1 / 25)
    rounds = []

    def gives_up_at_first(problem, options):
        rounds.append(solve(problem, options if rounds else SolverOptions(max_iterations=1)))
        return rounds[-1]

    expected = estimate_noise(problem).problem.adjustment.factors
    monkeypatch.setattr(noise, "solve", gives_up_at_first)
    solution = estimate_noise(problem)
    assert not rounds[0].converged
    assert solution.converged, solution.message
    assert solution.problem.adjustment.factors == pytest.approx(expected, rel=1e-4)  # 10 times SETTLED


def test_noise_that_could_not_be_estimated_is_not_called_estimated():
    problem = case("pose", small_arm(tolerance=TOLERANCE), np.random.default_rng(16), 24, 2.0)
    solution = estimate_noise(problem, SolverOptions(max_iterations=1))
    assert not solution.converged
    uncertainty = assess(solution)
    assert uncertainty.findings[0].startswith("not converged: 1 iterations, ")
    text = " ".join(format_report(solution, uncertainty).split())
    assert "not settled: the estimate has not converged" in text
    assert "was estimated from these residuals" not in text


def test_a_kind_with_too_little_left_keeps_its_stated_noise(monkeypatch):
    monkeypatch.setattr(noise, "LEAST_REDUNDANCY", 11.0)
    rng = np.random.default_rng(10)
    solution = estimate_noise(case("star", small_arm(tolerance=TOLERANCE), rng, 16, 2.0))
    assert solution.problem.adjustment.factors[0] == 1.0
    assert solution.problem.adjustment.factors[1] != 1.0
    assert solution.estimated_noise == ("angle",)
    assert "too few rows to estimate it: as stated" in " ".join(format_report(solution, assess(solution)).split())


def test_factors_that_do_not_settle_are_a_finding(monkeypatch):
    monkeypatch.setattr(noise, "MAX_ROUNDS", 1)
    rng = np.random.default_rng(11)
    solution = estimate_noise(case("pose", small_arm(tolerance=TOLERANCE), rng, 16, 2.0))
    assert not solution.converged
    assert assess(solution).findings[0].startswith("not converged: the estimated noise still moved by 0.")


def test_kept_parameters_are_estimated_with_estimated_noise_too():
    rng = np.random.default_rng(12)
    robot = small_arm()
    m = measure(true_robot(robot, rng), 40, rng)
    m = replace(m, sigma_position=2 * m.sigma_position, sigma_orientation=2 * m.sigma_orientation)
    solution = estimate_noise(build_problem(robot, m, model="pose", gauge="keep"))
    assert solution.problem.adjustment.factors == pytest.approx((0.5, 0.5), rel=0.2)
    assert solution.problem.whole.adjustment == solution.problem.adjustment


def test_a_same_point_that_is_not_is_suspect():
    """Three coordinates of 1 sigma each: their length is judged by their distribution, not by one coordinate's."""
    rng = np.random.default_rng(13)
    robot = small_arm(tolerance=TOLERANCE)
    a = np.arange(20)
    m = measured_directly(measure(robot, 40, rng), robot, rng, a, a + 20)
    m.pairs.distance[0], m.readings[20] = 0.0, m.readings[0]
    m.readings[20, 3] += 1e-9  # the same configuration twice tells nothing
    solution = solve(build_problem(robot, m, model="distance"))
    judged = assess(solution)
    assert solution.problem.judgement.same_point[0]
    assert np.isnan(judged.goodness.leverage[0])
    assert abs(judged.goodness.studentised[0]) < 1.0
    assert judged.goodness.kinds[0].n == 19


def test_pairs_that_a_model_of_poses_does_not_use_are_named(caplog):
    rng = np.random.default_rng(14)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(robot, 20, rng)
    direct = measured_directly(m, robot, rng, np.arange(10), np.arange(10, 20))
    solution = solve(build_problem(robot, replace(m, pairs=direct.pairs), model="pose"))
    assert caplog.messages == ["pairs: not used, model pose is of poses"]
    assert "pairs is not used: model pose is of poses, not of pairs" in format_report(solution, assess(solution))


def test_leverage_in_chunks_is_leverage_at_once(monkeypatch):
    rng = np.random.default_rng(15)
    robot = small_arm(tolerance=TOLERANCE)
    solution = solve(case("star joint", robot, rng, 20))
    at_once = assess(solution).goodness
    monkeypatch.setattr(goodness_module, "_CHUNK", 7)
    in_chunks = assess(solution).goodness
    assert in_chunks.studentised == pytest.approx(at_once.studentised)
    p = [fit.p_value for fit in at_once.kinds]
    assert [fit.p_value for fit in in_chunks.kinds] == pytest.approx(p)


def test_a_table_too_long_to_keep_is_judged_nearly_the_same(monkeypatch):
    """Without derivatives kept, independent rows are judged by their variances alone."""
    rng = np.random.default_rng(16)
    robot = small_arm(tolerance=TOLERANCE)
    solution = solve(case("direct", robot, rng, 100))
    kept = assess(solution).goodness.kinds
    monkeypatch.setattr(goodness_module, "MAX_DENSE", 0)
    for fit, exact in zip(assess(solution).goodness.kinds, kept, strict=True):
        assert fit.expected == pytest.approx(exact.expected)
        assert fit.p_value == pytest.approx(exact.p_value, abs=0.02)


def test_robust_weights_count_rows_and_flag_outliers():
    rng = np.random.default_rng(17)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng)
    m.position[5] += 0.05
    problem = build_problem(robot, m, model="pose")
    weights = np.where(np.arange(30) == 5, 0.0, 1.0)
    adjusted = replace(problem, adjustment=Adjustment(weights=weights))
    solution = solve(problem_module.judged_at(adjusted, problem.start))
    if solution.problem.adjustment.weights is None:
        pytest.skip("the solver chose weights of its own")
    uncertainty = assess(solution)
    table, goodness = uncertainty.residuals, uncertainty.goodness
    assert {FLAGS[f] for f in goodness.flag[table.a == 5]} == {"outlier"}
    assert all(fit.p_value is None for fit in goodness.kinds)
    assert [fit.seen_over_stated for fit in goodness.kinds] == pytest.approx([1.0, 1.0], abs=0.3)


def test_noise_too_small_is_not_called_outliers():
    """The median of few rows varies: only where some row is far from the others may it speak of outliers."""
    clean = {"seen_over_stated": 1.8, "factor": 1.0, "p_value": 1e-4, "n": 45, "kind": "position", "unit": "m"}
    fit = {**clean, "stated_sigma_rms": 1e-4, "chi2": 146.0, "expected": 45.0, "degrees": 45.0}
    assert KindFit(**fit, typical=1.3, largest=4.9).verdict == "too small"
    assert KindFit(**fit, typical=1.1, largest=20.0).verdict == "outliers"


def test_without_a_p_value_noise_is_judged_by_what_its_rows_vary():
    """Some 12 degrees of freedom see noise within a fifth: 0.75 times the noise stated is no news, 0.3 times is."""
    fit = {
        "kind": "angle",
        "unit": "rad",
        "n": 59,
        "stated_sigma_rms": 1e-4,
        "factor": 1.0,
        "chi2": 20.0,
        "largest": 2.0,
    }
    known = {**fit, "expected": 40.0, "p_value": None, "typical": 0.7, "degrees": 12.0}
    assert KindFit(**known, seen_over_stated=0.75).verdict == "as stated"
    assert KindFit(**known, seen_over_stated=0.3).verdict == "too large"
