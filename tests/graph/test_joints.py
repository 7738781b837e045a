"""Encoder noise: propagated or estimated, the same to first order; estimated is the optimum over all joint values."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot

from fg_calib.analysis.uncertainty import assess
from fg_calib.errors import ProblemError
from fg_calib.graph import problem as problem_module
from fg_calib.graph.problem import build_problem
from fg_calib.graph.solver import solve
from fg_calib.measurements.dataset import Pairs, rotation_angle
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
SIGMA, SIGMA_JOINT = (1e-3, 5e-4), 2e-3


def pair_values(robot, q, a, b):
    """Distance and angle of pairs, shape (n, 2)."""
    at = pose(robot, q)
    distance = np.linalg.norm(at.position[b] - at.position[a], axis=1)
    return np.stack([distance, rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0]], axis=1)


def measured(kind, n, seed, sigma_joint=SIGMA_JOINT):
    """An arm and noisy measurements of it: poses, or pairs measured directly as a star and a chain."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    m = measure(true, n, rng, sigma=SIGMA)
    stood = m.readings
    m = replace(m, readings=stood + sigma_joint * rng.normal(size=stood.shape), sigma_joint=np.full(4, sigma_joint))
    if kind == "direct":
        first, second = np.triu_indices(n, 1)
        near = (second - first <= 2) | (first == 0)
        first, second = first[near], second[near]
        values = pair_values(true, stood, first, second) + rng.normal(size=(len(first), 2)) * SIGMA
        values[np.abs(values[:, 1] - 1.6) > 1.4, 1] = np.nan  # away from the kinks
        k = len(first)
        pairs = Pairs(first, second, *values.T, np.full(k, SIGMA[0]), np.full(k, SIGMA[1]), np.zeros(k, dtype=bool))
        m = replace(m, pairs=pairs)
    return robot, m


def everything(robot, m, model):
    """Optimum over parameters and all joint values at once, by scipy: the definition of the exact estimate."""
    scale = np.array([p.scale if p.estimated else 0.0 for p in robot.parameters])
    columns = np.flatnonzero(scale)

    def residuals(x):
        values = robot.nominal
        values[columns] += x[: len(columns)] * scale[columns]
        arm, z = robot.with_values(values), x[len(columns) :]
        q = m.readings + SIGMA_JOINT * z.reshape(m.readings.shape)
        if model == "pose":
            at = pose(arm, q)
            turn = Rotation.from_matrix(np.swapaxes(m.rotation, 1, 2) @ at.rotation).as_rotvec() / SIGMA[1]
            rows = np.concatenate([turn.ravel(), ((at.position - m.position) / SIGMA[0]).ravel()])
        else:
            p = m.pairs
            difference = pair_values(arm, q, p.a, p.b) - np.stack([p.distance, p.angle], axis=1)
            rows = (difference / SIGMA)[np.isfinite(difference)]
        return np.concatenate([rows, x])  # all of x is in sigmas of its prior

    start = np.zeros(len(columns) + m.readings.size)
    found = scipy.optimize.least_squares(residuals, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    values = robot.nominal
    values[columns] += found.x[: len(columns)] * scale[columns]
    return values, 2.0 * found.cost


@pytest.fixture(scope="module", params=[("poses", "pose"), ("direct", "distance-rotation")], ids="-".join)
def optimum(request):
    """A robot and measurements, a model, and its optimum over everything."""
    kind, model = request.param
    robot, m = measured(kind, 12, seed=1)
    return robot, m, model, *everything(robot, m, model)


@pytest.mark.parametrize("most", [100, 0], ids=["variables", "eliminated"])
def test_estimated_joint_values_give_the_optimum_over_everything(optimum, most, monkeypatch):
    monkeypatch.setattr(problem_module, "MAX_JOINT_VARIABLES", most)
    robot, m, model, values, chi2 = optimum
    problem = build_problem(robot, m, model=model, encoder="estimated")
    keys = {gtsam.symbol("Q", k) for k in range(12)} & set(problem.graph.keyVector())
    assert len(keys) == (12 if most else 0)
    solution = solve(problem)
    assert solution.converged
    sigma = np.array([p.sigma or 1.0 for p in assess(solution).parameters])
    away = (solution.parameters[: len(values)] - values) / sigma
    assert np.max(np.abs(away)) < 1e-4
    assert 2.0 * solution.cost == pytest.approx(chi2, rel=1e-6)
    propagated = solve(build_problem(robot, m, model=model))
    apart = np.max(np.abs(propagated.parameters[: len(values)] - values) / sigma)
    assert 1e-3 < apart < 0.5  # the same to first order only: 2 mrad of encoder noise bend the arm's paths


@pytest.mark.parametrize(
    ("kind", "model", "options"),
    [
        ("poses", "pose", {"frame": "unknown"}),
        ("poses", "distance-rotation", {"pairing": Pairing("star")}),
        ("poses", "distance-rotation", {"pairing": Pairing("all")}),
        ("poses", "distance", {"pairing": Pairing("chain"), "loss": "huber"}),
        ("direct", "distance-rotation", {"loss": "gnc"}),
    ],
)
def test_joint_values_as_variables_and_eliminated_have_one_optimum(kind, model, options, monkeypatch):
    robot, m = measured(kind, 12, 5)
    found = []
    for most in (100, 0):
        monkeypatch.setattr(problem_module, "MAX_JOINT_VARIABLES", most)
        found.append(solve(build_problem(robot, m, model=model, encoder="estimated", **options)))
    a, b = (assess(s) for s in found)
    assert all(s.converged for s in found)
    sigma = np.array([p.sigma or 1.0 for p in a.parameters])
    apart = (found[0].parameters[: len(sigma)] - found[1].parameters[: len(sigma)]) / sigma
    # With a loss the weights come from residuals at the readings as stated, or at the true joint values.
    assert np.max(np.abs(apart)) < (0.2 if "loss" in options else 1e-4)
    assert a.dof == b.dof
    if "loss" not in options:
        assert a.chi2 == pytest.approx(b.chi2, rel=1e-5)
        assert np.allclose(a.covariance, b.covariance, rtol=1e-3, atol=1e-3 * np.abs(b.covariance).max())


def test_derivatives_in_the_true_joint_values_are_those_of_the_rows():
    """Every term against central differences, away from the readings."""
    robot, m = measured("poses", 6, 6)
    rng = np.random.default_rng(0)
    for model, pairing in (("pose", "star"), ("distance-rotation", "star"), ("distance", "all")):
        problem = build_problem(robot, m, model=model, pairing=Pairing(pairing), encoder="estimated")
        v = problem.variables
        at = problem.start.copy()
        at[v.nuisance_span] += 1e-2 * rng.normal(size=v.n_nuisance)
        for term in problem.terms:
            J = term.linearise(v, at)[1]
            places = [i for k in term.nuisance for i in v.nuisance[k].parameters]
            J = J[:, len(J[0]) - len(places) :]
            for column, place in enumerate(places):
                h = np.zeros(len(at))
                h[place] = 1e-6
                numeric = (term.residual(v, at + h) - term.residual(v, at - h)) / 2e-6
                assert np.allclose(J[:, column], numeric, rtol=1e-5, atol=1e-5 * np.abs(J).max())


@pytest.mark.parametrize(
    ("kind", "model", "options"),
    [
        ("poses", "pose", {}),
        ("poses", "pose", {"frame": "unknown"}),
        ("poses", "distance-rotation", {"pairing": Pairing("star")}),
        ("poses", "distance-rotation", {"pairing": Pairing("all")}),
        ("poses", "distance-rotation", {"pairing": Pairing("star"), "pair_errors": "independent"}),
        ("direct", "distance-rotation", {}),
    ],
)
@pytest.mark.slow
def test_both_ways_agree_to_first_order(kind, model, options):
    """Ten times less encoder noise, a hundred times less apart (in sigmas that measurement noise dominates)."""
    apart = []
    for shrink in (1.0, 0.1):
        robot, m = measured(kind, 12, 2, shrink * SIGMA_JOINT)
        if options.get("pair_errors") == "independent" and shrink == 1.0:
            assert build_problem(robot, m, model=model, encoder="estimated", **options).sharing.joints
        found = [solve(build_problem(robot, m, model=model, encoder=e, **options)) for e in ("propagated", "estimated")]
        assert all(s.converged for s in found)
        if options.get("pair_errors") == "independent":
            return  # estimated joint values are shared by nature, propagated noise is not: they differ
        sigma = np.array([p.sigma or 1.0 for p in assess(found[0]).parameters])
        n = len(sigma)
        apart.append(np.max(np.abs(found[0].parameters[:n] - found[1].parameters[:n]) / sigma))
        assert assess(found[1]).dof == assess(found[0]).dof
    assert apart[0] < 0.5
    # Propagated noise is left once sigmas move by less than 0.1 %.
    assert apart[1] < max(0.05 * apart[0], 2e-3)


def test_too_many_joint_values_for_pairs_are_refused(monkeypatch):
    monkeypatch.setattr(problem_module, "MAX_SHARED", 20)
    monkeypatch.setattr(problem_module, "MAX_JOINT_VARIABLES", 10)
    robot, m = measured("direct", 12, seed=3)
    with pytest.raises(ProblemError) as error:
        build_problem(robot, m, model="distance", encoder="estimated")
    assert str(error.value) == (
        "encoder: estimated: 30 rows or errors that they share, expected at most 20 for models of pairs; propagated"
    )


def test_without_encoder_noise_there_is_nothing_to_estimate():
    robot, m = measured("poses", 12, seed=4)
    m = replace(m, sigma_joint=np.zeros(4))
    a, b = (solve(build_problem(robot, m, model="pose", encoder=e)).parameters for e in ("propagated", "estimated"))
    assert np.array_equal(a, b)


@pytest.mark.slow
def test_estimated_joint_values_keep_honest_sigmas():
    n, nees, chi2, dof = 15, [], 0.0, 0.0
    for seed in range(n):
        rng = np.random.default_rng(seed)
        robot, m = measured("poses", 20, seed=seed)
        true = true_robot(robot, rng)
        uncertainty = assess(solve(build_problem(robot, m, model="pose", encoder="estimated")))
        at = [robot.index(name) for name in uncertainty.names]
        error = uncertainty.robot.nominal[at] - true.nominal[at]
        nees.append(error @ np.linalg.solve(uncertainty.covariance, error) / len(at))
        chi2, dof = chi2 + uncertainty.chi2, dof + uncertainty.dof
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(at) / n))
    assert chi2 / dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / dof))
