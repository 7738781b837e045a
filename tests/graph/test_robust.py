"""Robust losses: their constants, GTSAM's own optimum, gross errors, honest sigmas."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot
from sparing import diagonal
from tolerances import rounding

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import mahalanobis_distances, relinearized_at
from fg_calib.graph.robust import EFFICIENCY, HALF_WEIGHT, Weighting, cost, effect, tuning, weight
from fg_calib.graph.solver import solve
from fg_calib.measurements import residuals
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
SMOOTH = ("huber", "cauchy", "geman-mcclure")
LOSSES = (*SMOOTH, "gnc")
GTSAM = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
}


def spoil(m, share, rng, size=50.0):
    """Gross errors of up to `size` sigma in position and orientation of a share of the configurations."""
    bad = rng.random(m.n_configurations) < share
    bad[0] = False  # the first is in every pair of a star
    count = (int(bad.sum()), 3)
    position, rotation = m.position.copy(), m.rotation.copy()
    position[bad] += rng.uniform(-size, size, count) * m.sigma_position[bad]
    turn = Rotation.from_rotvec(rng.uniform(-size, size, count) * m.sigma_orientation[bad]).as_matrix()
    rotation[bad] = rotation[bad] @ turn
    return replace(m, position=position, rotation=rotation), bad


def test_constants_in_one_dimension_are_those_of_the_books():
    assert tuning("huber", 1) == pytest.approx(1.345, abs=5e-4)
    assert tuning("cauchy", 1) == pytest.approx(2.385, abs=5e-4)
    assert tuning("gnc", 1) == pytest.approx(2.5758, abs=5e-5)
    assert tuning("none", 3) == np.inf


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("loss", "residual_dim"), diagonal(SMOOTH, [1, 2, 6]))
def test_clean_measurements_lose_five_percent(loss, residual_dim):
    """The location of a cloud of Gaussian vectors, by reweighting, against its mean: Monte Carlo."""
    rng = np.random.default_rng(1)
    c, n, draws = tuning(loss, residual_dim), 200, 400
    r = rng.normal(size=(draws, n, residual_dim))
    centre = np.zeros((draws, 1, residual_dim))
    for _ in range(30):
        w = weight(loss, np.linalg.norm(r - centre, axis=2), c)[:, :, None]
        centre = np.sum(w * r, axis=1, keepdims=True) / np.sum(w, axis=1, keepdims=True)
    variance = np.mean(centre**2) * n
    slack = 4.0 * np.sqrt(2.0 / (draws * residual_dim))
    assert variance == pytest.approx(1.0 / EFFICIENCY, rel=slack)
    assert effect(loss, residual_dim).variance == pytest.approx(variance * np.mean(w), rel=slack)
    e = np.linalg.norm(r - centre, axis=2)
    kept = w[:, :, 0] >= 0.5
    assert effect(loss, residual_dim).chi2 == pytest.approx(np.mean((w[:, :, 0] * e**2)[kept]) / residual_dim, rel=0.02)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("loss", LOSSES)
def test_weights_fall_with_the_residual_and_are_half_where_said(loss):
    c = tuning(loss, 2)
    e = np.linspace(0.0, 30.0, 301)
    w = weight(loss, e, c)
    assert np.all((w >= 0.0) & (w <= 1.0))
    assert w[0] == 1.0
    assert np.all(np.diff(w) <= 0.0)
    end = HALF_WEIGHT[loss] * c
    around = weight(loss, np.array([end * 0.999, end * 1.001]), c)
    assert around.tolist() == [1.0, 0.0] if loss == "gnc" else around == pytest.approx([0.5, 0.5], abs=0.01)


@pytest.mark.parametrize("loss", LOSSES)
def test_costs_have_the_weights_as_their_slopes(loss):
    """By central differences, and for GTSAM's losses by what these say themselves."""
    c, h = tuning(loss, 2), 1e-6
    e = np.linspace(0.05, 12.0, 200)
    e = e[np.abs(e - c) > 2 * h]  # where gnc has its step
    slope = (cost(loss, e + h, c) - cost(loss, e - h, c)) / (2 * h)
    assert slope == pytest.approx(weight(loss, e, c) * e, abs=1e-7)  # rounding of the cost, some 70, over the step
    if loss in GTSAM:
        theirs = GTSAM[loss].Create(c)
        assert cost(loss, e, c) == pytest.approx([theirs.loss(one) for one in e], rel=rounding(1, 10))
    else:
        assert cost(loss, e, c) == pytest.approx(0.5 * np.minimum(e**2, c**2), rel=rounding(1, 10))


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "model"), diagonal(SMOOTH, ["pose", "distance", "distance-rotation"]))
def test_the_optimum_is_that_of_gtsams_robust_noise_on_factors_of_one_measurement(loss, model):
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=TOLERANCE)
    m, _ = spoil(measure(true_robot(robot, rng), 40, rng), 0.15, rng, size=20.0)
    options = {"model": model, "pairing": Pairing("chain"), "pair_errors": "independent"}
    solution = solve(build_problem(robot, m, loss=loss, **options))
    assert solution.converged
    # One factor a measurement, its noise model robust, whitened as the plain problem whitens at this estimate.
    plain = replace(solution.problem.state, weights=None)
    problem = relinearized_at(solution.problem, solution.parameters, plain)
    (rows,), variables = problem.rows, problem.variables
    assert rows.states is None
    block = rows.parts[0].block
    graph = gtsam.NonlinearFactorGraph()
    for factor in (problem.graph.at(i) for i in range(1, problem.graph.size())):
        graph.add(factor)  # the priors
    for i in range(block.n):
        one = residuals.rows_of(block, slice(i, i + 1))
        graph.add(_robust_factor(one, variables, GTSAM[loss].Create(tuning(loss, _height(one)))))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(200)
    found = gtsam.LevenbergMarquardtOptimizer(graph, solution.values, parameters).optimize()
    away = variables.step(solution.parameters, variables.parameters(found)) / variables.scales
    sigma = np.sqrt(np.diag(assess(solution).spread.tangent)) / variables.scales
    assert np.max(np.abs(away) / sigma) < 1e-4
    assert graph.error(found) == pytest.approx(graph.error(solution.values), rel=rounding(1, 100))
    assert solution.objective == pytest.approx(graph.error(solution.values), rel=rounding(1, 1000))  # sums of 40 to 240
    gradient = graph.linearize(solution.values).gradientAtZero()
    assert all(np.all(np.isfinite(gradient.at(k))) for k in variables.keys)


def _height(block):
    """Rows of a block of one measurement that are in use."""
    return int(np.sum(np.diag(residuals.unpack(block.whitening, block.residual_dim)[0]) > 0.0))


def _robust_factor(block, variables, estimator):
    """A factor of one measurement with GTSAM's own robust noise model."""
    noise = gtsam.noiseModel.Robust.Create(estimator, gtsam.noiseModel.Unit.Create(block.residual_dim))

    def evaluate(_, values, H):
        chain = variables.at(variables.parameters(values)).chains[0]
        r, J = residuals.linearise(block, chain)
        if H is not None:
            for i, v in enumerate(variables.items):
                H[i] = J[0][:, v.columns]
        return r[0]

    return gtsam.CustomFactor(noise, variables.keys, evaluate)


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.parametrize(
    ("model", "options"),
    [
        ("pose", {}),
        ("pose", {"frame": "unknown"}),
        ("distance-rotation", {}),
        ("distance-rotation", {"pairing": Pairing("all")}),
    ],
    ids=["pose", "unknown frame", "star", "all"],
)
@pytest.mark.long
def test_gnc_comes_near_the_clean_fit_where_a_share_of_the_configurations_is_wrong(model, options, share):
    robot = small_arm(tolerance=TOLERANCE)
    test = np.random.default_rng(9).uniform(-np.pi, np.pi, (100, robot.n_joints))
    errors = {"clean": 0.0, "gnc": 0.0, "none": 0.0}
    for seed in range(8 if model == "pose" else 3):
        rng = np.random.default_rng(seed)
        true = true_robot(robot, rng)
        m = measure(true, 60 if model == "pose" else 40, rng, sigma=(1e-3, 5e-4), sigma_joint=1e-4)
        wrong, _ = spoil(m, share, rng)
        for name, table, loss in (("clean", m, "none"), ("gnc", wrong, "gnc"), ("none", wrong, "none")):
            solution = solve(build_problem(robot, table, model=model, loss=loss, **options))
            assert solution.converged or name == "none"
            found = robot.with_values(solution.parameters[: len(robot.parameters)])
            errors[name] += np.mean((pose(found, test).position - pose(true, test).position) ** 2)
    clean, gnc, none = (np.sqrt(errors[k]) for k in ("clean", "gnc", "none"))
    assert gnc <= 1.3 * clean
    assert none > gnc


@pytest.mark.parametrize("loss", ["huber", "gnc"])
@pytest.mark.parametrize("share", [0.0, 0.2])
@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
def test_sigmas_and_chi_square_hold_with_a_robust_loss(loss, share):
    robot = small_arm(tolerance=TOLERANCE)
    rng = np.random.default_rng(2)
    nees, chi2, expected = [], 0.0, 0.0
    for _ in range(20):
        true = true_robot(robot, rng)
        m, _ = spoil(measure(true, 40, rng, sigma=(1e-3, 5e-4)), share, rng)
        uncertainty = assess(solve(build_problem(robot, m, model="pose", loss=loss)))
        error = uncertainty.robot.nominal - true.nominal
        error = error[[robot.index(name) for name in uncertainty.names]]
        nees.append(error @ np.linalg.solve(uncertainty.covariance, error) / len(error))
        chi2, expected = chi2 + uncertainty.fit.chi_square.value, expected + uncertainty.fit.chi_square.expected
        assert uncertainty.trustworthy
    assert np.mean(nees) == pytest.approx(1.0, abs=0.5 if (loss, share) == ("huber", 0.2) else 0.15)
    assert chi2 / expected == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
def test_the_cost_is_that_before_any_weight():
    rng = np.random.default_rng(4)
    robot = small_arm(tolerance=TOLERANCE)
    m, bad = spoil(measure(true_robot(robot, rng), 40, rng), 0.2, rng)
    solution = solve(build_problem(robot, m, model="pose", loss="gnc"))
    (weights,) = solution.problem.state.weights
    assert np.all(weights[bad] == 0.0)
    assert np.sum(weights[~bad] == 0.0) <= 3
    assert set(np.unique(weights)) <= {0.0, 1.0}
    table = assess(solution).fit.residuals
    prior = [(p.correction / p.prior_sigma) ** 2 for p in assess(solution).estimates.parameters if p.prior_sigma]
    assert 2 * solution.cost == pytest.approx(
        np.sum((table.after / table.sigma) ** 2) + sum(prior), rel=rounding(1, 10)
    )
    assert solution.weighted_cost < 0.1 * solution.cost


@pytest.mark.slow
def test_clean_measurements_keep_their_weight_under_gnc_up_to_the_one_percent():
    rng = np.random.default_rng(5)
    robot = small_arm(tolerance=TOLERANCE)
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 300, rng), model="pose", loss="gnc"))
    assert 0.95 <= np.mean(solution.problem.state.weights[0]) <= 1.0


def test_gnc_starts_convex_and_ends_truncated():
    weighting = Weighting("gnc")
    e, residual_dim = np.array([0.5, 2.0, 100.0]), np.array([1, 1, 1])
    first, final = weighting.update(e, residual_dim)
    assert not final
    assert np.all(first[:2] == 1.0)
    while not final:
        last, final = weighting.update(e, residual_dim)
    assert last.tolist() == [1.0, 1.0, 0.0]
    assert Weighting("gnc").update(np.array([0.5, 1.0]), np.array([1, 1]))[1]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("loss", LOSSES)
def test_a_measurement_that_takes_no_part_keeps_its_weight(loss):
    weights, _ = Weighting(loss).update(np.array([0.1, 50.0, 0.0, np.nan]), np.array([2, 2, 0, 0]))
    assert weights[[2, 3]].tolist() == [1.0, 1.0]
    assert 0.0 <= weights[1] < weights[0] <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_weights_settle_where_rows_are_excluded(loss):
    """Pairs at a kink take no part; the others' weights are those of the residuals at the estimate all the same."""
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=TOLERANCE)
    m, _ = spoil(measure(true_robot(robot, rng), 40, rng), 0.15, rng, size=20.0)
    readings = m.readings.copy()
    readings[20] = readings[0]  # the same configuration twice: its pair with the hub says nothing
    m = replace(m, readings=readings)
    solution = solve(build_problem(robot, m, model="distance-rotation", loss=loss))
    assert solution.converged
    ((e, residual_dim),) = mahalanobis_distances(solution.problem, solution.parameters)
    assert np.sum(residual_dim == 0) >= 1
    (weights,) = solution.problem.state.weights
    assert np.all(np.isfinite(weights))
    used = residual_dim > 0
    c = np.array([tuning(loss, int(h)) for h in residual_dim[used]])
    assert weights[used] == pytest.approx(weight(loss, e[used], c), abs=1e-5)
