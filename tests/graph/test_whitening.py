"""Shared errors: the whitening is that of the dense covariance, and estimates know what they know."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot
from tolerances import rounding

from fg_calib.analysis.uncertainty import assess
from fg_calib.graph import problem as problem_module
from fg_calib.graph.problem import build_problem, correlation, whitened_triangle
from fg_calib.graph.solver import solve
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, Pairs, rotation_angle
from fg_calib.options import Pairing
from fg_calib.report.text import format_report
from fg_calib.robot.kinematics import pose

KINDS = {"distance": (True, False), "rotation": (False, True), "distance-rotation": (True, True)}
TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}


def rows(position, rotation, a, b):
    """Distances, then angles, of pairs."""
    distance = np.linalg.norm(position[b] - position[a], axis=1)
    angle = rotation_angle(np.swapaxes(rotation[a], 1, 2) @ rotation[b])[0]
    return np.stack([distance, angle], axis=1)


def dense_covariance(robot, m, a, b, step=1e-6):
    """Covariance of predicted minus measured pairs, all errors through central differences: shape (2 n, 2 n)."""
    n, columns = m.n_configurations, []

    def add(change, sigma):
        difference = (change(step) - change(-step)) / (2 * step)
        columns.append(sigma * difference.ravel())

    def measured_at(k, axis, kind):
        def change(h):
            position, rotation = m.position.copy(), m.rotation.copy()
            if kind == "position":
                position[k, axis] += h
            else:
                rotation[k] = rotation[k] @ Rotation.from_rotvec(h * np.eye(3)[axis]).as_matrix()
            return -rows(position, rotation, a, b)

        return change

    def read_at(k, joint):
        def change(h):
            q = m.readings.copy()
            q[k, joint] += h
            at = pose(robot, q)
            return rows(at.position, at.rotation, a, b)

        return change

    for k in range(n):
        for axis in range(3):
            if m.pairs is None:
                add(measured_at(k, axis, "position"), m.sigma_position[k, axis])
                add(measured_at(k, axis, "orientation"), m.sigma_orientation[k, axis])
        for j in range(robot.n_joints):
            add(read_at(k, j), m.sigma_joint[j])
    G = np.array(columns).T
    C = G @ G.T
    if m.pairs is not None:
        C += np.diag(np.stack([m.pairs.sigma_distance, m.pairs.sigma_angle], axis=1).ravel() ** 2)
    return C


def directly_measured(m, robot, a, b, sigma=(1e-3, 5e-4)):
    """The same configurations with pairs measured directly, without noise."""
    at = pose(robot, m.readings)
    values = rows(at.position, at.rotation, a, b)
    n = len(a)
    pairs = Pairs(a, b, *values.T, np.full(n, sigma[0]), np.full(n, sigma[1]), np.zeros(n, dtype=bool))
    return replace(m, pairs=pairs)


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("model", KINDS)
@pytest.mark.parametrize("pairing", ["star", "chain"])
def test_shared_errors_whiten_as_the_dense_covariance(pairing, model, direct):
    rng = np.random.default_rng(3)
    robot = small_arm()
    m = measure(robot, 12, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
    first, second = (
        (np.zeros(11, dtype=int), np.arange(1, 12)) if pairing == "star" else (np.arange(11), np.arange(1, 12))
    )
    if direct:
        m = directly_measured(m, robot, first, second)
    problem = build_problem(robot, m, model=model, pairing=Pairing(pairing), prior=False)
    kinds = np.array(KINDS[model])
    wanted = np.tile(kinds, 11)
    C = dense_covariance(robot, m, first, second)[np.ix_(wanted, wanted)]
    plain = build_problem(robot, m, model=model, pairing=Pairing(pairing), prior=False, pair_errors="independent")
    chain = problem.variables.chain
    unwhitened = residuals.linearise(problem_module.all_rows(plain, plain.start), chain)
    J, r = unwhitened[1].reshape(-1, chain.n_columns), unwhitened[0].ravel()
    R = residuals.triangle(problem.blocks[0], chain)
    expected = np.linalg.solve(C, np.column_stack([J, r]))
    gram = np.column_stack([J, r]).T @ expected
    # A formed pair has a thousandth of its variance to itself on top; errors act to second order too: some 1e-3 of an
    # angle, over an angle, squared.
    tolerance = 1e-5 if direct else 0.02
    scale = np.sqrt(np.outer(np.diag(gram), np.diag(gram)))
    assert np.abs(R.T @ R - gram).max() <= tolerance * scale.max()
    assert residuals.squared_norm(problem.blocks[0], chain) == pytest.approx(
        gram[-1, -1], rel=tolerance, abs=rounding(10.0)
    )
    assert np.allclose(
        residuals.gram(problem.blocks[0], chain),
        R.T @ R,
        rtol=rounding(1, 1e4),
        atol=rounding(np.abs(gram).max(), 1e4),
    )


def test_chunks_of_a_correlated_block_are_the_same_with_and_without_memory(monkeypatch):
    rng = np.random.default_rng(1)
    robot = small_arm()
    m = measure(robot, 20, rng, sigma_joint=1e-4)
    problem = build_problem(robot, m, model="distance-rotation", pairing=Pairing("all"))
    assert problem.blocks[0].gain is not None
    R = residuals.triangle(problem.blocks[0], problem.variables.chain)
    monkeypatch.setattr(residuals, "_KEPT", 0)
    monkeypatch.setattr(residuals, "SPAN", 7)
    again = residuals.triangle(problem.blocks[0], problem.variables.chain)
    assert np.allclose(R.T @ R, again.T @ again, rtol=rounding(1, 10), atol=rounding(np.abs(R.T @ R).max(), 1e4))


def test_too_many_shared_errors_are_accounted_for_in_the_covariance_alone(monkeypatch):
    """Weighted as independent, the covariance is (J^T J)^-1 J^T C J (J^T J)^-1 of the dense covariance."""
    rng = np.random.default_rng(5)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(robot, 15, rng, sigma=(1e-4, 5e-5), sigma_joint=3e-5)
    monkeypatch.setattr(problem_module, "MAX_SHARED", 0)
    problem = build_problem(robot, m, model="distance-rotation", pairing=Pairing("all"), prior=False)
    assert problem.approximate
    a, b = np.triu_indices(15, 1)
    used = np.stack([problem.judgement.distance, problem.judgement.angle], axis=1)
    chain = problem.variables.chain
    C = dense_covariance(robot, m, a, b)
    raw = residuals.linearise(problem_module.all_rows(problem, problem.start), chain)[1].reshape(-1, chain.n_columns)
    W = np.zeros_like(C)
    for i in range(len(a)):
        keep = np.flatnonzero(used[i]) + 2 * i
        if len(keep):
            W[np.ix_(keep, keep)] = np.linalg.inv(np.linalg.cholesky(C[np.ix_(keep, keep)]))
    J = W @ raw
    expected = J.T @ (W @ C @ W.T) @ J
    T = whitened_triangle(problem, problem.start)
    found = correlation(problem, problem.start) + T.T @ T
    assert np.abs(found - expected).max() <= 0.02 * np.abs(expected).max()
    report = format_report(solution := solve(problem), assess(solution))
    assert "105 pairs share the errors of 15 configurations, too many to carry them" in " ".join(report.split())
    assert "model pose with frame unknown" in report


def normalised_error(true, uncertainty):
    """Squared error over its covariance, per parameter."""
    at = [true.index(name) for name in uncertainty.names]
    error = uncertainty.robot.nominal[at] - true.nominal[at]
    return error @ np.linalg.solve(uncertainty.covariance, error) / len(error)


@pytest.mark.parametrize("max_shared", [3000, 0])
@pytest.mark.parametrize("pairing", ["star", "all"])
@pytest.mark.slow
def test_the_covariance_of_pairs_from_poses_is_that_of_the_errors(pairing, max_shared, monkeypatch):
    monkeypatch.setattr(problem_module, "MAX_SHARED", max_shared)
    robot = small_arm(tolerance=TOLERANCE)
    rng = np.random.default_rng(11)
    n_draws = 60 if pairing == "star" else 25
    found, chi2, dof = [], 0.0, 0.0
    for _ in range(n_draws):
        true = true_robot(robot, rng)
        m = measure(true, 20, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
        uncertainty = assess(solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing(pairing))))
        found.append(normalised_error(true, uncertainty))
        chi2, dof = chi2 + uncertainty.chi2, dof + uncertainty.expected_chi2
    n = len(uncertainty.names)
    assert np.mean(found) == pytest.approx(1.0, abs=4 * np.sqrt(2 / n / n_draws))
    assert chi2 == pytest.approx(dof, rel=0.08)


def test_all_pairs_hold_no_more_than_the_poses_in_an_unknown_frame():
    """Carried exactly, all pairs claim what the poses claim; as independent, several times more."""
    rng = np.random.default_rng(4)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 15, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)

    def claimed(model, **options):
        uncertainty = assess(solve(build_problem(robot, m, model=model, **options)))
        sigma = np.sqrt(np.diag(uncertainty.covariance))
        return sigma[:-1]  # the last joint's theta turns the tool in itself: no distance and no angle tells

    poses = claimed("pose", frame="unknown")
    shared = claimed("distance-rotation", pairing=Pairing("all"))
    independent = claimed("distance-rotation", pairing=Pairing("all"), pair_errors="independent")
    assert np.all(shared >= 0.99 * poses)
    assert np.mean(shared / poses) <= 1.1
    assert np.min(independent / poses) <= 0.7


def test_directly_measured_pairs_without_joint_noise_share_nothing():
    rng = np.random.default_rng(6)
    robot = small_arm()
    m: Measurements = directly_measured(measure(robot, 30, rng), robot, np.zeros(29, dtype=int), np.arange(1, 30))
    problem = build_problem(robot, m, model="distance")
    assert not problem.approximate
    assert isinstance(problem.blocks[0], residuals.PairBlock)


@pytest.mark.slow
def test_chi_square_of_all_pairs_of_small_motions_is_that_of_the_noise():
    """More pairs than errors have nothing but what is not linear to say of the rest: it had chi-square 1.5 here."""
    robot = small_arm(tolerance=TOLERANCE)
    sigma = np.array([6e-4, 3e-3, 1.2e-3])  # along three axes, [m] and [rad]
    found = []
    for draw in range(12):
        rng = np.random.default_rng(draw)
        q = rng.uniform(-1.0, 1.0, (1, 4)) + rng.uniform(-0.1, 0.1, (30, 4))
        m = measure(true_robot(robot, rng), 30, rng, sigma=(0.0, 0.0), readings=q)
        noise = Rotation.from_rotvec(sigma * rng.normal(size=(30, 3))).as_matrix()
        m = replace(
            m,
            position=m.position + sigma * rng.normal(size=(30, 3)),
            rotation=m.rotation @ noise,
            sigma_position=np.tile(sigma, (30, 1)),
            sigma_orientation=np.tile(sigma, (30, 1)),
        )
        uncertainty = assess(solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing("all"))))
        found.append(uncertainty.reduced_chi2)
    # Some 150 degrees of freedom: a draw's sd is 0.12 and the mean's 0.035.
    assert np.mean(found) == pytest.approx(1.0, abs=0.14)
