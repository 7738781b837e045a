"""Encoder noise: propagated or estimated, the same to first order; estimated is the optimum over all joint values."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation
from simulated import measure, plus, small_arm, true_robot
from tolerances import sigmas_apart

from fg_calib.assessment import assess
from fg_calib.graph import error_states
from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import mahalanobis_distances, noises_at, relinearized_at
from fg_calib.graph.solver import solve
from fg_calib.graph.variables import pose_of
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Pairs
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.rotations import rotation_angle

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


@pytest.mark.slow
def test_estimated_joint_values_give_the_optimum_over_everything(optimum):
    robot, m, model, values, chi2 = optimum
    solution = solve(build_problem(robot, m, model=model, encoder="estimated"))
    assert solution.converged
    sigma = np.array([p.sigma or 1.0 for p in assess(solution).estimates.parameters])
    away = (solution.parameters[: len(values)] - values) / sigma
    assert np.max(np.abs(away)) < 1e-4
    assert 2.0 * solution.cost == pytest.approx(chi2, rel=1e-6)
    propagated = solve(build_problem(robot, m, model=model))
    apart = np.max(np.abs(propagated.parameters[: len(values)] - values) / sigma)
    assert 1e-3 < apart < 0.5  # the same to first order only: 2 mrad of encoder noise bend the arm's paths


def everything_given_the_noise(solution):
    """Optimum over parameters, frame and all joint values at once, by scipy, with weights and other noise as solved.

    Returns:
        The robot's parameters, chi-square, the covariance of those that are estimated, and the degrees of freedom: of
        what rows have to themselves for numerical safety alone, a share of none (see `WhitenedBlock.n_spare`).
    """
    problem = solution.problem
    robot, (noise,), (series,) = problem.robot, problem.noises, problem.data.series
    m, train = problem.measurements, series.train
    scale = np.array([p.scale if p.estimated else 0.0 for p in robot.parameters])
    columns = np.flatnonzero(scale)
    n, n_frame, residual_dim = len(columns), 6 * len(problem.variables.frames), series.kind.residual_dim

    private = noise.own_at(slice(None))
    carried = frozenset(source.name for source in noise.sources)
    diagonal = np.einsum("nii->ni", private)
    raised = np.maximum(diagonal + noise.more_if_redundant(carried), noise.least())
    private += (raised - diagonal)[:, :, None] * np.eye(residual_dim)
    if problem.state.weights is not None:
        (weights,) = problem.state.weights
        private += (1.0 / np.maximum(weights, 1e-12) - 1.0)[:, None, None] * noise.total
    C = np.zeros((len(train), residual_dim, len(train), residual_dim))
    for i, k in enumerate(train):
        C[i, :, i, :] = private[k]
    of_joints = np.zeros_like(C)
    for source in noise.sources:
        G = np.zeros((len(train), residual_dim, m.n_configurations, source.loading.shape[3]))
        for i, k in enumerate(train):
            for end, place in enumerate(source.ends[k]):
                G[i, :, place] += source.loading[k, :, end]
        into = of_joints if source.name == "joints" else C
        into += np.einsum("ahcw,bkcw->ahbk", G, G)
    used = series.used[train].ravel()
    C, of_joints = (S.reshape(used.size, -1)[np.ix_(used, used)] for S in (C, of_joints))
    W = np.linalg.inv(np.linalg.cholesky(C))
    spare = (raised[train] - noise.bare(train)).ravel()[used] if carried - {"joints"} else np.zeros(used.sum())
    n_independent = used.sum() - np.sum(spare * np.diag(np.linalg.inv(C + of_joints)))

    def unwhitened(arm, frame, q):
        if model_of_poses:
            at, X = pose(arm, q), pose_of(frame)
            R, p = X.rotation().matrix() @ at.rotation, at.position @ X.rotation().matrix().T + X.translation()
            turn = Rotation.from_matrix(np.swapaxes(m.rotation, 1, 2) @ R).as_rotvec()
            return np.hstack([turn, p - m.position])[train].ravel()[used]
        values = pair_values(arm, q, *series.ends.T)[:, quantities]
        slope = np.einsum("nii->ni", residuals.unpack(noise.rows.whitening, residual_dim))
        start = noise.predicted[:, quantities]
        return (start - series.data + noise.figures()[1] + slope * (values - start))[train].ravel()[used]

    model_of_poses = series.kind.ends == 1
    quantities = [("distance", "angle").index(name) for name in series.kind.names] if not model_of_poses else []
    start_frame = solution.parameters[len(scale) :][:6]

    def rows(x):
        values = robot.nominal
        values[columns] += x[:n] * scale[columns]
        z = x[n + n_frame :]
        frame = start_frame + 1e-3 * np.append(x[n : n + n_frame], np.zeros(6 - n_frame))
        q = m.readings + SIGMA_JOINT * z.reshape(m.readings.shape)
        return np.concatenate([W @ unwhitened(robot.with_values(values), frame, q), x[:n], z])

    start = np.zeros(n + n_frame + m.readings.size)
    found = scipy.optimize.least_squares(rows, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=25)
    values = robot.nominal
    values[columns] += found.x[:n] * scale[columns]
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:n, :n] * np.outer(scale[columns], scale[columns])
    return values, 2.0 * found.cost, covariance, round(n_independent) - n_frame  # a prior for each parameter


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "model", "options"),
    [
        pytest.param("poses", "pose", {"frame": "unknown"}, marks=pytest.mark.slow),
        ("poses", "distance-rotation", {"pairing": Pairing("star")}),
        pytest.param("poses", "distance-rotation", {"pairing": Pairing("all")}, marks=pytest.mark.slow),
        pytest.param("poses", "distance", {"pairing": Pairing("chain"), "loss": "huber"}, marks=pytest.mark.slow),
        pytest.param("poses", "pose", {"loss": "cauchy"}, marks=pytest.mark.slow),
        pytest.param("direct", "distance-rotation", {"loss": "gnc"}, marks=pytest.mark.slow),
    ],
)
def test_eliminated_joint_values_have_the_optimum_over_everything(kind, model, options):
    """Also in unknown frames, where pairs share the errors of poses, and with the weights of robust losses."""
    robot, m = measured(kind, 12, 5)
    solution = solve(build_problem(robot, m, model=model, encoder="estimated", **options))
    assert solution.converged
    values, chi2, covariance, dof = everything_given_the_noise(solution)
    of_solution = assess(solution)
    sigma = np.array([p.sigma or 1.0 for p in of_solution.estimates.parameters])
    assert np.max(np.abs(solution.parameters[: len(values)] - values) / sigma) < 1e-4
    assert 2.0 * solution.weighted_cost == pytest.approx(chi2, rel=1e-6)
    if "loss" in options:
        assert (
            of_solution.fit.chi_square.dof
            == assess(solve(build_problem(robot, m, model=model, **options))).fit.chi_square.dof
        )
    else:
        assert of_solution.fit.chi_square.dof == dof
        assert np.allclose(of_solution.covariance, covariance, rtol=1e-3, atol=1e-3 * np.abs(covariance).max())


@pytest.mark.parametrize(("kind", "model"), [("poses", "pose"), ("poses", "position"), ("direct", "distance-rotation")])
def test_what_joint_values_explain_is_still_part_of_how_far_off_a_measurement_is(kind, model):
    """Residuals at joint values that were estimated from them are short; weights go by those at the readings."""
    robot, m = measured(kind, 40, seed=3)
    squared = []
    for encoder in ("propagated", "estimated"):
        solution = solve(build_problem(robot, m, model=model, encoder=encoder))
        ((e, residual_dim),) = mahalanobis_distances(solution.problem, solution.parameters)
        squared.append(np.sum(e**2) / residual_dim.sum())
    assert squared[1] == pytest.approx(squared[0], rel=5e-3)
    assert squared[1] == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / residual_dim.sum()))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("loss", ["huber", "gnc"])
def test_gross_errors_are_not_taken_for_joint_errors(loss):
    robot, m = measured("poses", 40, seed=8)
    bad = np.arange(0, 40, 10)
    m = replace(m, position=plus(m.position, bad, np.array([0.03, -0.02, 0.03])))
    weights = []
    for encoder in ("propagated", "estimated"):
        problem = solve(build_problem(robot, m, model="position", encoder=encoder, loss=loss)).problem
        weights.append(problem.state.weights[0])
    assert weights[1] == pytest.approx(weights[0], abs=0.02)
    assert np.max(weights[1][bad]) < 0.6


def test_derivatives_in_the_true_joint_values_are_those_of_the_rows():
    """Of every end against central differences, away from the readings."""
    robot, m = measured("poses", 6, 6)
    rng = np.random.default_rng(0)
    for model, pairing in (("pose", "star"), ("distance-rotation", "star"), ("distance", "all")):
        problem = build_problem(robot, m, model=model, pairing=Pairing(pairing), encoder="estimated")
        errors = 1e-2 * rng.normal(size=m.readings.shape)
        problem = relinearized_at(problem, problem.start, replace(problem.state, joint_errors=errors))
        (noise,), (chain,) = noises_at(problem, problem.start), problem.variables.at(problem.start).chains
        (source,) = (s for s in noise.sources if s.name == "joints")
        J = source.loading / m.sigma_joint
        found = np.zeros((*J.shape[:2], m.n_configurations, robot.n_joints))
        for k, ends in enumerate(noise.series.ends):
            for end, place in enumerate(ends):
                found[k, :, place] += J[k, :, end]

        def at(q, noise=noise, chain=chain):
            return residuals.residual(replace(noise.rows, trig=robot.trig(q)), chain)

        for place in np.ndindex(m.readings.shape):
            h = np.zeros(m.readings.shape)
            h[place] = 1e-6
            numeric = (at(m.readings + errors + h) - at(m.readings + errors - h)) / 2e-6
            assert np.allclose(found[:, :, *place], numeric, rtol=1e-5, atol=1e-5 * np.abs(J).max())


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
            (rows,) = build_problem(robot, m, model=model, encoder="estimated", **options).rows
            carried = set((rows.states.loadings.indices % rows.states.width).tolist())
            assert carried
            assert carried <= set(range(rows.joints, rows.joints + 4))  # none of the poses
        found = [solve(build_problem(robot, m, model=model, encoder=e, **options)) for e in ("propagated", "estimated")]
        assert all(s.converged for s in found)
        if options.get("pair_errors") == "independent":
            return  # estimated joint values are shared by nature, propagated noise is not: they differ
        sigma = np.array([p.sigma or 1.0 for p in assess(found[0]).estimates.parameters])
        n = len(sigma)
        apart.append(np.max(np.abs(found[0].parameters[:n] - found[1].parameters[:n]) / sigma))
        assert assess(found[1]).fit.chi_square.dof == assess(found[0]).fit.chi_square.dof
    assert apart[0] < 0.5
    # Propagated noise is left once sigmas move by less than 0.1 %.
    assert apart[1] < max(0.05 * apart[0], 2e-3)


@pytest.mark.slow
def test_eliminated_joint_values_of_pairs_are_the_same_whichever_way_they_are_eliminated(monkeypatch):
    """Values, their sigmas, and those of the parameters: steps end 3e-5 sigma from the dense way at most."""
    robot, m = measured("direct", 12, seed=3)
    found = []
    for most, filled in ((error_states.MAX_DENSE, error_states.MAX_FILL), (0, 0)):
        monkeypatch.setattr(error_states, "MAX_DENSE", most)
        monkeypatch.setattr(error_states, "MAX_FILL", filled)
        uncertainty = assess(solve(build_problem(robot, m, model="distance-rotation", encoder="estimated")))
        values = uncertainty.estimates.joint_errors
        found.append([uncertainty.robot.nominal, uncertainty.covariance, values.error, values.sigma])
    sigma = np.sqrt(np.diag(found[0][1]))
    estimated = [robot.index(name) for name in uncertainty.names]
    assert sigmas_apart(found[1][0][estimated], found[0][0][estimated], sigma) < 3e-5
    assert found[1][1] == pytest.approx(found[0][1], rel=1e-6, abs=1e-6 * np.min(sigma) ** 2)
    assert np.abs(found[1][2] - found[0][2]).max() < 3e-5 * SIGMA_JOINT
    assert found[1][3] == pytest.approx(found[0][3], rel=1e-5)


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
        chi2, dof = chi2 + uncertainty.fit.chi_square.value, dof + uncertainty.fit.chi_square.dof
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(at) / n))
    assert chi2 / dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / dof))
