"""Robust losses: constants, weights and costs against GTSAM's estimators and Monte Carlo; outliers; numbers kept."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from dense import SeriesRows, dense, priors
from simulated import LARGE, measure, plus, small_arm, true_robot
from sparing import diagonal

from fg_calib import assess, build_problem, solve
from fg_calib.graph import effect, relinearized_at, tuning, weight
from fg_calib.graph.robust import EFFICIENCY, HALF_WEIGHT, Weighting, cost

SMOOTH = ("huber", "cauchy", "geman-mcclure")
LOSSES = (*SMOOTH, "gnc")
GTSAM = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
}


def test_constants_in_one_dimension_are_those_of_the_books():
    assert tuning("huber", 1) == pytest.approx(1.345, abs=5e-4)
    assert tuning("cauchy", 1) == pytest.approx(2.385, abs=5e-4)
    assert tuning("gnc", 1) == pytest.approx(2.5758, abs=5e-5)
    assert tuning("none", 3) == np.inf


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize(("loss", "residual_dim"), diagonal(SMOOTH, [1, 2, 6]))
def test_clean_measurements_lose_five_percent_and_outliers_more(loss, residual_dim, share):
    """The location of a cloud of Gaussian vectors, by reweighting, against its mean: Monte Carlo."""
    rng = np.random.default_rng(1)
    c, n, draws = tuning(loss, residual_dim), 200, 200
    r = rng.normal(size=(draws, n, residual_dim)) * np.where(rng.random((draws, n, 1)) < share, 50.0, 1.0)
    centre = np.zeros((draws, 1, residual_dim))
    for _ in range(30):
        w = weight(loss, np.linalg.norm(r - centre, axis=2), c)[:, :, None]
        centre = np.sum(w * r, axis=1, keepdims=True) / np.sum(w, axis=1, keepdims=True)
    variance = np.mean(centre**2) * n
    slack = 4.0 * np.sqrt(2.0 / (draws * residual_dim))
    kept = w[:, :, 0] >= 0.5
    expected = effect(loss, residual_dim, np.mean(~kept))
    assert expected.variance == pytest.approx(variance * np.mean(w), rel=slack)
    if share:
        return
    assert variance == pytest.approx(1.0 / EFFICIENCY, rel=slack)
    e = np.linalg.norm(r - centre, axis=2)
    assert expected.chi2 == pytest.approx(np.mean((w[:, :, 0] * e**2)[kept]) / residual_dim, rel=0.02)


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
        assert cost(loss, e, c) == pytest.approx([theirs.loss(one) for one in e], rel=1e-12)
    else:
        assert cost(loss, e, c) == pytest.approx(0.5 * np.minimum(e**2, c**2), rel=1e-12)


def test_gnc_starts_convex_and_ends_truncated():
    weighting = Weighting("gnc")
    e, residual_dim = np.array([0.5, 2.0, 2.7, 100.0]), np.ones(4, dtype=np.int64)  # the third is hardly beyond
    first, final = weighting.update(e, residual_dim)
    assert not final
    assert np.all(first[:2] == 1.0)
    while not final:
        last, final = weighting.update(e, residual_dim)
    assert last.tolist() == [1.0, 1.0, 0.0, 0.0]
    assert Weighting("gnc").update(np.array([0.5, 1.0]), np.array([1, 1]))[1]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("loss", LOSSES)
def test_a_measurement_that_takes_no_part_keeps_its_weight(loss):
    weights, _ = Weighting(loss).update(np.array([0.1, 50.0, 0.0, np.nan]), np.array([2, 2, 0, 0]))
    assert weights[[2, 3]].tolist() == [1.0, 1.0]
    assert 0.0 <= weights[1] < weights[0] <= 1.0


@pytest.mark.parametrize("encoder", ["propagated", "estimated"])
@pytest.mark.parametrize(("loss", "model"), diagonal(LOSSES, ["pose", "distance"], every=2))
def test_weights_are_those_of_the_residuals_at_the_estimate(loss, model, encoder):
    """Residuals are those at the readings, whitened by all noise: joint values estimated from outliers hide none."""
    rng, robot = np.random.default_rng(8), small_arm(tolerance=LARGE)
    m, wrong = measure(true_robot(robot, rng), 24, rng, sigma_joint=1e-3, n_test=4), np.arange(1, 24, 6)
    m = replace(m, position=plus(m.position, wrong, np.array([0.03, -0.02, 0.03])))
    solution = solve(build_problem(robot, m, model=model, loss=loss, encoder=encoder))
    assert solution.converged, solution.message
    problem = build_problem(robot, m, model=model, loss=loss)
    rows = SeriesRows(replace(problem, state=replace(problem.state, weights=None)), solution.parameters, 0)
    e = np.sqrt(np.einsum("nh,nh->n", rows.r, np.linalg.solve(rows.total, rows.r[:, :, None])[:, :, 0]))
    h, (found,) = rows.r.shape[1], solution.problem.state.weights
    train = rows.block.train
    assert found[train] == pytest.approx(weight(loss, e[train], tuning(loss, h)), abs=1e-3)
    assert model != "pose" or np.max(found[wrong]) < 0.6
    if encoder == "propagated":
        assessed = assess(solution)
        of_priors = solution.weighted_cost - 0.5 * np.sum((found * e**2)[train])
        if model == "pose":  # pairs share errors
            of_rows = np.sum(cost(loss, e[train], tuning(loss, h)))
            assert solution.objective == pytest.approx(of_priors + of_rows, rel=1e-6)
            assert solution.cost == pytest.approx(of_priors + 0.5 * np.sum(e[train] ** 2), rel=1e-6)
            kept, fit = train[found[train] >= 0.5], assessed.fit.chi_square  # outliers are not in chi-square
            assert fit.dof == h * len(kept)  # as many parameters as priors
            assert fit.value == pytest.approx(2.0 * of_priors + np.sum((found * e**2)[kept]), rel=1e-6)
            of_loss = (1.0 - effect(loss, h).chi2) * h * len(kept)
            assert fit.expected == pytest.approx(fit.dof - assessed.spread.excess - of_loss, rel=1e-9)
    else:
        return
    there = relinearized_at(solution.problem, solution.parameters)
    A, _, C = dense(there, solution.parameters)
    A, K = A[:, :-1], priors(there, solution.parameters)[:, :-1]
    information = A.T @ np.linalg.solve(C, A) / effect(loss, h, np.mean(found[train] < 0.5)).variance + K.T @ K
    expected = dict(zip(there.variables.names, np.sqrt(np.diag(np.linalg.inv(information))), strict=True))
    sigma = np.sqrt(np.diag(assessed.covariance))
    assert sigma == pytest.approx([expected[name] for name in assessed.names], rel=1e-6)
