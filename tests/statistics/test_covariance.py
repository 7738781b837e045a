"""Covariance, chi-square and findings: closed forms, GTSAM's marginals, Monte Carlo."""

import numpy as np
import pytest
from scipy.stats import chi2
from simulated import measure_drawn, paper_robot, small_arm, with_changes
from tolerances import rounding

from fg_calib import Measurements, Pairing, Robot, assess, build_problem, solve
from fg_calib.graph import SIGNAL_FLOOR
from fg_calib.robot import pose
from fg_calib.statistics.covariance import held_frames
from fg_calib.statistics.goodness_of_fit import chi2_bounds


def sigma_of(uncertainty):
    return {p.name: p.sigma for p in uncertainty.estimates.parameters}


def test_without_priors_only_determined_parameters_have_a_sigma():
    robot = paper_robot()
    m = measure_drawn(robot, 100, seed=1)
    uncertainty = assess(solve(build_problem(robot, m, model="distance-rotation")))
    # Table 4 of Jia et al. (2019)
    ineffective = ["a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"]
    relative = ["beta1", "theta2", "beta2", "d3", "theta3", "d4", "d5", "beta5", "theta6"]
    sigma = sigma_of(uncertainty)
    for p in uncertainty.estimates.parameters:
        if "." in p.name:
            assert (p.identifiability, p.sigma) == ("fixed", 0.0)
            continue
        expected = "ineffective" if p.name in ineffective else "relative" if p.name in relative else "independent"
        assert p.identifiability == expected, p.name
        assert (sigma[p.name] is None) == (expected != "independent"), p.name
    known = np.isfinite(np.diag(uncertainty.covariance))
    assert known.sum() == 19
    assert np.all(np.isnan(uncertainty.covariance[~known]))
    assert uncertainty.fit.chi_square.dof == 2 * 99 - 23
    assert uncertainty.trustworthy


def test_a_direction_held_by_its_prior_has_the_priors_sigma():
    robot = paper_robot(tolerance={"theta": 0.002, "beta": 0.002, "a": 1e-3, "d": 1e-3, "alpha": 0.002})
    measurements = measure_drawn(robot, 100, seed=2, sigma=(1e-5, 1e-6))
    uncertainty = assess(solve(build_problem(robot, measurements, model="distance-rotation")))
    sigma = sigma_of(uncertainty)
    for name in ("theta1", "beta6", "theta7", "beta7"):
        assert sigma[name] == pytest.approx(0.002, rel=1e-4)
    assert sigma["a1"] == pytest.approx(1e-3, rel=1e-4)
    # beta2 - theta3 is open, their sum is not: half the prior's variance each
    assert sigma["theta3"] == pytest.approx(0.002 / np.sqrt(2), rel=1e-2)


def test_bounds_of_chi_square_hold_its_distribution_and_a_factor_of_two():
    low, high = chi2_bounds(10)
    assert (low * 10, high * 10) == pytest.approx(chi2.ppf([0.0005, 0.9995], 10))
    assert chi2_bounds(10_000) == (0.5, 2.0)
    assert chi2_bounds(0) == (0.0, np.inf)


@pytest.mark.parametrize("model", ["pose", "distance-rotation"])
def test_residual_table_holds_every_row_before_and_after(model):
    robot = small_arm()
    m = measure_drawn(robot, 20, seed=7, n_test=10)
    solution = solve(build_problem(robot, m, model=model, pairing=Pairing("chain")))
    table = assess(solution).fit.residuals
    assert table.n == (30 * 6 if model == "pose" else 2 * (19 + 9))
    assert table.test.sum() == (10 * 6 if model == "pose" else 2 * 9)
    rms = table.rms()
    for split in ("train", "test"):
        for kind in ("position", "orientation") if model == "pose" else ("distance", "angle"):
            assert rms[split][kind]["after"] < rms[split][kind]["before"]
    whitened = (table.after / table.sigma)[~table.test]
    if model == "pose":  # pairs of a chain share the errors of their poses
        assert whitened @ whitened == pytest.approx(2 * solution.cost, rel=rounding(1, 10))


@pytest.mark.slow
def test_the_height_of_a_scaras_targets_is_in_the_sigmas_of_what_follows_it():
    """Monte Carlo: 12 draws, targets 0.8 m below the flange where the fit starts at it; theta2 was 4.8 sigma off."""
    rows = [[0.35, 0.0, 0.4, 0.0], [0.3, np.pi, 0.02, 0.1], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.05, 0.3]]
    types = ["revolute", "revolute", "prismatic", "revolute"]
    arm = Robot.from_dh(rows, types=types, tolerance={"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3})
    errors = {"alpha1": 1.6e-3, "alpha2": 9e-4, "alpha3": 6e-4, "theta2": 1e-3, "a1": 4e-4}
    at = [arm.index(name) for name in errors]
    true, z = with_changes(arm, **errors), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.8, 1.8, (40, 4)) * [1.0, 1.0, 0.17, 1.0]
        there = pose(true, q)
        targets = np.add(rng.uniform(-0.3, 0.3, (3, 3)), [0.0, 0.0, 0.8])
        seen = (there.position[:, None] + np.einsum("nij,kj->nki", there.rotation, targets)).reshape(-1, 3)
        measured = Measurements.from_arrays(
            np.repeat(q, 3, axis=0), position=seen + 5e-5 * rng.standard_normal(seen.shape), sigma_position=5e-5,
            target=["a", "b", "c"] * 40, ids=np.repeat([f"k{i}" for i in range(40)], 3),
        )  # fmt: skip
        solution = solve(build_problem(arm, measured, model="position", frame="unknown"))
        sigma = sigma_of(assess(solution))
        z.append((solution.parameters[at] - true.nominal[at]) / [sigma[name] for name in errors])
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all(rms < 1.0 + 3.0 / np.sqrt(24.0))  # three standard errors of 12 draws
    assert np.all(rms > 0.4)


def test_a_frame_that_nothing_determines_takes_its_part_of_what_turned_along():
    scales, at_nominal, here = np.array([2.0, 0.5, 3.0]), np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.8, 0.0])
    (found,) = SIGNAL_FLOOR * held_frames((here * scales)[None], (at_nominal * scales)[None], scales, 1).T
    assert np.abs(found) == pytest.approx(0.8 * here * scales, rel=1e-12)
