"""Goodness of fit: by kind, by row, by configuration, under repetition; and noise estimated from the residuals."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import central_differences
from reported import format_report
from scipy.stats import kstest
from simulated import LARGE, measure, measure_drawn, pairs_between, plus, small_arm, specified, true_robot
from touches import SIGMA, TOLERANCE, TOOL_POINT, corners, touch

from fg_calib import Pairing, Table, assess, build_problem, calibrate, solve
from fg_calib.graph import NoiseState
from fg_calib.graph import problem as problem_module
from fg_calib.robot import pose
from fg_calib.statistics import FLAGS, KindFit, estimate_noise
from fg_calib.statistics import variance_components as noise


def measured_directly(m, robot, rng, a, b, sigma=(1e-3, 5e-4), sigma_joint=0.0):
    """Pairs of the true robot measured directly, with noise; the joint errors are those of each configuration."""
    q = m.readings + sigma_joint * rng.normal(size=m.readings.shape)
    pairs = pairs_between(robot, q, (a, b), rng, sigma=sigma)
    return replace(m, position=None, rotation=None, pairs=pairs, sigma_joint=np.full(robot.n_joints, sigma_joint))


def factors_of(solution):
    """The factors that noise was estimated with, by kind, of the only table."""
    assert all(table == 0 or name == "joint" for table, name in solution.problem.state.factors)
    return {kind: factor for (_, kind), factor in solution.problem.state.factors.items()}


def test_leverages_are_those_of_the_hat_matrix():
    """Independent rows without priors: H = J (J^T W J)^+ J^T W, whose trace is the rank."""
    robot = small_arm()
    m = measure_drawn(robot, 20, seed=2, n_test=4)
    solution = solve(build_problem(robot, m, model="pose"))
    uncertainty = assess(solution)
    table, goodness = uncertainty.fit.residuals, uncertainty.fit.goodness
    rows = solution.problem.rows
    J = rows.linearise(solution.problem.variables.at(solution.parameters))[1]
    H = J @ np.linalg.pinv(J, rcond=1e-9)
    assert goodness.leverage[table.used] == pytest.approx(np.diag(H), rel=1e-6)
    assert goodness.leverage[table.used].sum() == pytest.approx(uncertainty.spread.rank)
    expected = table.after / table.sigma / np.sqrt(1.0 + np.where(table.test, 1.0, -1.0) * goodness.leverage)
    assert goodness.studentised == pytest.approx(expected)
    assert {FLAGS[f] for f in goodness.flag[table.test]} == {"test"}
    assert [kind.n_beyond for kind in goodness.kinds] == [0, 0]
    n_rows, squares, rms = table.of_configurations(solution.problem.measurements.test)
    assert n_rows.tolist() == [6] * 24
    assert squares == pytest.approx(np.bincount(table.a, (table.after / table.sigma) ** 2))
    assert rms["position"] == pytest.approx(np.linalg.norm(table.after.reshape(24, 6)[:, 3:], axis=1))
    alone = assess(solve(build_problem(robot, m, model="position"))).fit.residuals
    rms = alone.of_configurations(m.test)[2]
    assert rms["position"] == pytest.approx(np.linalg.norm(alone.after.reshape(24, 3), axis=1))


def test_a_row_beyond_noise_that_is_specified_too_large_is_suspect():
    """2 mm where the noise is 0.4 mm and 1 mm was specified: two sigma as specified, five of the others' noise."""
    robot = small_arm(tolerance=LARGE)
    m = measure_drawn(robot, 40, seed=1, sigma=(4e-4, 5e-4))
    m = replace(m, position=plus(m.position, (17, 0), 2e-3), sigma_position=2.5 * m.sigma_position)
    found = calibrate(robot, m, model="pose")
    suspects = found.residuals.filter(found.residuals["suspect"])
    assert suspects.select("a", "kind").rows() == [("17", "position.x")]
    assert "no row (|studentised" not in str(found)


def test_a_kind_with_too_little_left_keeps_its_specified_noise(monkeypatch):
    monkeypatch.setattr(noise, "LEAST_REDUNDANCY", 11.0)
    robot = small_arm(tolerance=LARGE)
    m = measure_drawn(robot, 16, seed=10, sigma=(1e-3, 5e-4))
    solution = estimate_noise(build_problem(robot, specified(m, 2.0), model="distance-rotation"))
    assert "distance" not in factors_of(solution)
    assert factors_of(solution)["angle"] != 1.0
    distance, angle = assess(solution).fit.goodness.kinds
    assert (distance.factor, angle.factor) == pytest.approx((1.0, factors_of(solution)["angle"]), rel=1e-4)
    assert solution.estimated_noise == ((0, "angle"),)
    report = " ".join(format_report(solution, assess(solution)).split())
    assert "cannot be estimated from these rows: as specified" in report


def test_kept_parameters_are_estimated_with_estimated_noise_too():
    robot = small_arm()
    m = specified(measure_drawn(robot, 40, seed=12), 2.0)
    solution = estimate_noise(build_problem(robot, m, model="pose", gauge="keep"))
    assert factors_of(solution) == pytest.approx({"orientation": 0.5, "position": 0.5}, rel=0.2)
    assert solution.problem.whole.state.factors == solution.problem.state.factors
    for fit in assess(solution).fit.goodness.kinds:
        assert fit.observed_over_specified == pytest.approx(fit.factor, rel=1e-3)


def test_a_same_point_that_is_not_is_suspect():
    """Each of its three coordinates is a row of 1 sigma; two readings that are nearly the same tell it nothing."""
    rng = np.random.default_rng(13)
    robot = small_arm(tolerance=LARGE)
    a = np.arange(20)
    m = measured_directly(measure(robot, 40, rng), robot, rng, a, a + 20)
    distance, readings = m.pairs.distance.copy(), m.readings.copy()
    distance[:2], readings[20:22] = 0.0, readings[:2]
    readings[20, 3] += 1e-9  # the same configuration twice tells nothing
    apart = pose(robot, readings[1:2]).jacobian[0, 3:, -1]  # [m] per rad of the last joint
    readings[21, 3] += 10e-3 / np.linalg.norm(apart)  # 10 sigma
    m = replace(m, readings=readings, pairs=replace(m.pairs, distance=distance))
    judged = assess(solve(build_problem(robot, m, model="distance")))
    table, goodness = judged.fit.residuals, judged.fit.goodness
    (kind,) = goodness.kinds
    assert (kind.kind, kind.n) == ("distance", 18 + 2 * 3)
    same, other = (np.flatnonzero(table.a == k) for k in (0, 1))
    assert [table.kinds[code].name for code in table.kind_code[same]] == ["distance.x", "distance.y", "distance.z"]
    assert goodness.leverage[same] == pytest.approx(0.0, abs=1e-6)
    assert np.all(np.abs(goodness.studentised[same]) < 1.0)
    assert np.linalg.norm(table.after[other] / table.sigma[other]) == pytest.approx(10.0, abs=1.0)
    assert np.nanargmax(np.abs(goodness.studentised)) in np.intersect1d(np.flatnonzero(goodness.suspect), other)
    assert {one.id for one in goodness.configurations} == {table.names[1], table.names[21]}


def test_robust_weights_count_rows_and_flag_outliers():
    robot = small_arm(tolerance=LARGE)
    m = measure_drawn(robot, 30, seed=17)
    m = replace(m, position=plus(m.position, 5, 0.05))
    problem = build_problem(robot, m, model="pose")
    state = NoiseState(weights=(np.where(np.arange(30) == 5, 0.0, 1.0),))
    solution = solve(problem_module.relinearized_at(problem, problem.start, state))
    assert solution.problem.state.weights is not None
    uncertainty = assess(solution)
    table, goodness = uncertainty.fit.residuals, uncertainty.fit.goodness
    assert {FLAGS[f] for f in goodness.flag[table.a == 5]} == {"outlier"}
    assert all(fit.p_value is None for fit in goodness.kinds)
    assert [fit.observed_over_specified for fit in goodness.kinds] == pytest.approx([1.0, 1.0], abs=0.3)


VERDICTS = [
    (None, 12.0, 0.5, "as specified"), (None, 12.0, 0.45, "too large"), (None, 12.0, 1.6, "too small"),
    (None, 1e6, 0.81, "as specified"), (None, 1e6, 0.79, "too large"),
    (0.006, 12.0, 1.6, "as specified"), (0.004, 12.0, 1.6, "too small"), (0.996, 12.0, 0.5, "too large"),
    (1e-9, 1e6, 1.04, "as specified"), (1e-9, 1e6, 1.06, "too small"), (1e-9, 12.0, np.nan, "unknown"),
]  # fmt: skip


@pytest.mark.parametrize(("p", "degrees", "ratio", "verdict"), VERDICTS)
def test_noise_is_judged_by_its_p_value_or_by_what_its_rows_vary(p, degrees, ratio, verdict):
    """At 1 % either way: 2.58 / sqrt(2 degrees) of the noise where a fifth is less, and no news below a twentieth."""
    fit = KindFit("angle", "rad", 59, 1e-4, 2.0, 2.0 * ratio, 20.0, 40.0, p, 0.7, degrees)
    assert fit.verdict == verdict


def touched(robot, rng, n_each=8, sigma_joint=0.0):
    """Five points touched: of 0, 1 and 2 some touches are test rows, of 3 and 4 all but two."""
    true = true_robot(robot, rng)
    distances = ((0, 1, 1e-4), (0, 3, 1e-4), (3, 4, 1e-4))
    m = touch(true, corners(true, 5, rng), n_each, rng, distances=distances, test=(3, 4), sigma_joint=sigma_joint)
    row = np.arange(len(m.test))
    test = m.test & (row % n_each > 1) | np.isin(row, [n_each - 2, n_each - 1, 2 * n_each - 2])
    return replace(m, test=test)


def predicted(name, rng):
    """A problem with test rows of a drawn true robot."""
    sigma_joint = 2e-4 if "joint" in name else 0.0
    if name.startswith("touches"):
        robot = small_arm(tolerance=TOLERANCE, estimate=TOOL_POINT)
        return build_problem(robot, touched(robot, rng, sigma_joint=sigma_joint), model="distance")
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    m = measure(true, 16, rng, sigma=(1e-3, 5e-4), sigma_joint=sigma_joint, n_test=10)
    if name == "poses":
        return build_problem(robot, m, model="pose")
    if name.startswith("star"):
        return build_problem(robot, m, model="distance-rotation", pairing=Pairing("star"))
    k = np.arange(14)
    a, b = np.concatenate([k, k]), np.concatenate([np.roll(k, 1), np.roll(k, 3)])
    direct = measured_directly(measure(true, 14, rng), true, rng, a, b, sigma_joint=sigma_joint)
    direct = replace(direct, pairs=replace(direct.pairs, test=np.arange(28) >= 20))
    return build_problem(robot, [Table(m, model="pose"), Table(direct, model="distance-rotation")])


@pytest.mark.parametrize("name", ["poses", "touches joint", "star joint", "tables joint"])
@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
def test_fitted_and_predicted_rows_have_the_sums_of_squares_and_p_values_that_they_are_said_to(name):
    """Of each table and kind, and all predicted rows together: means within 4 of their own sigma, p-values uniform.

    Kolmogorov-Smirnov at 0.1 %, of kinds whose every run leaves a degree of freedom.
    """
    n_runs, rng = 60 if name == "poses" else 25, np.random.default_rng(21)
    off, p_values = {}, {}
    for _ in range(n_runs):
        found = assess(solve(predicted(name, rng))).fit
        goodness = found.goodness
        p_values.setdefault("all rows", []).append(found.chi_square.p_value)
        fits = {("fitted", fit.table, fit.kind): fit for fit in goodness.kinds}
        fits |= {("predicted", fit.table, fit.kind): fit for fit in goodness.test.kinds}
        for key, fit in (fits | {"together": goodness.test}).items():
            off.setdefault(key, []).append(fit.chi2 - fit.expected)
            p_values.setdefault(key, []).append(fit.p_value)
    for key, differences in off.items():
        assert abs(np.mean(differences)) < 4 * np.std(differences) / np.sqrt(n_runs), key
    for key, p in p_values.items():
        if None not in p:
            assert kstest(p, "uniform").pvalue > 1e-3, key
    assert sum(None in p for p in p_values.values()) == name.startswith("touches")  # the one fitted distance


def test_touches_of_a_point_that_is_their_mean_share_its_noise():
    """Leverages by the arm's own derivatives: those of the row less the mean's; of n touches -1 / n for the noise.

    To 1e-3 of it or of the noise: derivatives of rows are less `a x (p - point)`, the noise times an angle's error.
    """
    rng = np.random.default_rng(22)
    robot = small_arm(tolerance=TOLERANCE, estimate=TOOL_POINT)
    m = touched(robot, rng)
    m = replace(m, test=m.groups.index >= 3)
    solution = solve(build_problem(robot, m, model="distance"))
    judged = assess(solution)
    table, goodness, arm = judged.fit.residuals, judged.fit.goodness, judged.robot
    columns = [arm.index(name) for name in judged.names]
    moved = central_differences(lambda x: pose(arm.with_values(x), m.readings).position, arm.nominal)[:, :, columns]
    C, n = judged.covariance, 8
    for g in (3, 4):
        mine = np.flatnonzero(m.groups.index == g)
        J = moved[mine] - moved[mine].mean(axis=0)
        expected = np.einsum("nij,jk,nik->ni", J, C, J) / SIGMA**2 - 1 / n
        rows = np.isin(table.a, mine) & (table.family == table.families.index("point"))
        # The rows are turned; the sum over the three axes is not.
        found = goodness.leverage[rows].reshape(-1, 3).sum(axis=1)
        assert found == pytest.approx(expected.sum(axis=1), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("what", ["one table", "independent"])
def test_predicted_pairs_that_share_joint_noise_with_fitted_ones_have_their_covariance_with_the_estimate(what):
    """Against the whole covariance of all rows; to 2 % of a sigma, by which noise lengthens the shortest.

    Without the errors in common the sigmas of the predicted rows would be up to a quarter larger.
    """
    robot, rng, n, sigma_joint = small_arm(tolerance=LARGE), np.random.default_rng(5), 12, 1e-3
    i, j = np.array(np.triu_indices(n, 1))[:, rng.permutation(66)]
    true = true_robot(robot, rng)
    m = measured_directly(measure(true, n, rng), true, rng, i, j, sigma=(3e-4, 1e-4), sigma_joint=sigma_joint)
    test = np.arange(66) >= 50
    whole = replace(m, named=True, pairs=replace(m.pairs, test=test))
    errors = "independent" if what == "independent" else "shared"
    solution = solve(build_problem(robot, whole, model="distance", pair_errors=errors))
    uncertainty = assess(solution)

    def lengths(values, q):
        p = pose(robot.with_values(values), q.reshape(m.readings.shape)).position
        return np.linalg.norm(p[j] - p[i], axis=1)

    x, columns = solution.parameters[: len(robot.parameters)], [p.estimated for p in robot.parameters]
    J = central_differences(lambda values: lengths(values, m.readings), x, 1e-5)[:, columns]
    L = sigma_joint * central_differences(lambda q: lengths(x, q), m.readings.ravel(), 1e-5)
    C = 9e-8 * np.eye(66) + L @ L.T
    weighted_as = np.diag(np.diag(C)) if what == "independent" else C
    J_fit, weights = J[~test], np.linalg.inv(weighted_as[np.ix_(~test, ~test)])
    prior = np.diag([p.tolerance**-2 for p in robot.parameters if p.estimated])
    K = np.linalg.inv(J_fit.T @ weights @ J_fit + prior)
    made_of_noise = np.eye(66)[test]
    made_of_noise[:, ~test] = -J[test] @ K @ J_fit.T @ weights
    of_priors = J[test] @ K @ prior @ K @ J[test].T
    A = made_of_noise @ C @ made_of_noise.T + of_priors
    r = (lengths(x, m.readings) - m.pairs.distance)[test]
    predicted = uncertainty.fit.goodness.studentised[uncertainty.fit.residuals.test]
    apart = np.diag(J[test] @ K @ J[test].T + C[np.ix_(test, test)])
    assert np.max(apart / np.diag(A)) > 1.3
    assert predicted == pytest.approx(r / np.sqrt(np.diag(A)), abs=0.02)
    assert uncertainty.fit.goodness.test.chi2 == pytest.approx(r @ np.linalg.solve(A, r), rel=0.02)


def test_degrees_of_freedom_count_core_and_landmarks():
    """Five points touched eight times: three coordinates each come off, and every parameter, for all have priors."""
    rng = np.random.default_rng(31)
    robot = small_arm(tolerance=TOLERANCE, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    problem = build_problem(robot, touch(true, corners(true, 5, rng), 8, rng), model="distance")
    n_estimated = sum(p.estimated for p in robot.parameters)
    assert problem.n_residuals == 5 * 8 * 3
    fit = assess(solve(problem)).fit
    assert fit.chi_square.dof == 5 * 8 * 3 + n_estimated - n_estimated - 5 * 3
    (points,) = fit.goodness.kinds
    assert points.expected + fit.priors.expected == pytest.approx(fit.chi_square.dof, rel=1e-9)
