"""Shared errors: the whitening is that of the dense covariance, and estimates know what they know."""

from dataclasses import replace

import numpy as np
import pytest
from dense import dense
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot
from sparing import diagonal
from tolerances import rounding

from fg_calib.assessment import assess
from fg_calib.graph import error_states
from fg_calib.graph.build import build_problem
from fg_calib.graph.noise_models import JOINT_NOISE
from fg_calib.graph.problem import correlation, joint_errors, linear_system, noises_at, relinearized_at
from fg_calib.graph.solver import solve
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Groups, Measurements, Pairs
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.rotations import rotation_angle

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


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("model", "pairing", "direct"), diagonal(KINDS, ["star", "chain"], [False, True]))
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
    at = problem.variables.at(problem.start)
    (rows,), (noise,), (chain,) = problem.rows, noises_at(problem, problem.start), at.chains
    r, J = (a.reshape(wanted.sum(), -1) for a in residuals.linearise(noise.rows, chain))
    expected = np.linalg.solve(C, np.column_stack([J, r]))
    gram = np.column_stack([J, r]).T @ expected
    # A formed pair has a thousandth of its variance to itself on top; errors act to second order too: some 1e-3 of an
    # angle, over an angle, squared.
    tolerance = 1e-5 if direct else 0.02
    scale = np.sqrt(np.outer(np.diag(gram), np.diag(gram)))
    R = rows.triangle(at)
    assert np.abs(R.T @ R - gram).max() <= tolerance * scale.max()
    assert rows.squared_norm(at) == pytest.approx(gram[-1, -1], rel=tolerance, abs=rounding(10.0))


EXACT = 1e-9
"""Share of the information in any direction by which whitening may differ from that by the dense covariance."""


def measured_in(kind, robot, rng):
    """Measurements and how pairs are formed of them: every shape of graph, formed from poses or measured directly."""
    m = measure(true_robot(robot, rng), 14, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
    name, *rest = kind.split()
    if "joint" not in rest:
        m = replace(m, sigma_joint=np.zeros(4))
    if name == "random":
        return m, Pairing("random", 40, 0)
    if "direct" not in rest:
        return m, Pairing(name)
    a, b = {
        "star": (np.zeros(13, dtype=int), np.arange(1, 14)),
        "tree": (rng.integers(0, np.arange(1, 14)), np.arange(1, 14)),
        "all": np.triu_indices(14, 1),
        "mixed": (np.repeat(np.arange(5), 3), 5 + np.arange(15) % 9),
    }[name]
    m = directly_measured(m, robot, a, b)
    distance, angle = (v + 1e-3 * rng.normal(size=len(a)) for v in (m.pairs.distance, m.pairs.angle))
    distance[:: 4 if name == "mixed" else 100] = 0.0 if name == "mixed" else np.nan
    return replace(m, pairs=replace(m.pairs, distance=distance, angle=angle)), None


GRAPHS = ("star", "chain", "random", "all", "star joint", "chain joint", "random joint", "all joint")
GRAPHS += ("star direct joint", "tree direct joint", "all direct joint", "mixed direct joint")


def learned(problem, rng):
    """The problem with weights of every measurement and factors on every noise."""
    weights = tuple(rng.uniform(0.1, 1.0, s.n) for s in problem.data.series)
    kinds = {(s.table, name.split(".")[0]) for s in problem.data.series for name in s.kind.names}
    factors = dict(zip(sorted(kinds), rng.uniform(0.5, 2.0, len(kinds)), strict=True))
    factors[JOINT_NOISE] = rng.uniform(0.5, 2.0)
    return relinearized_at(problem, problem.start, replace(problem.state, weights=weights, factors=factors))


def check_rows(problem):
    """Gram matrix, triangle and cost of the whitened rows are those of the dense covariance, in any direction."""
    A, _, C = dense(problem, problem.start)
    at = problem.variables.at(problem.start)
    expected = A.T @ np.linalg.solve(C, A)
    squared = np.diag(expected)
    scale = np.where(squared > 1e-20 * squared[:-1].max(), np.sqrt(squared), np.inf)  # the others are rounding
    values, vectors = np.linalg.eigh(expected / np.outer(scale, scale))
    known = values > 1e-9
    half = vectors[:, known] / np.sqrt(values[known]) / scale[:, None]
    R = np.vstack([rows.triangle(at) for rows in problem.rows])
    of_rounding = rounding(1.0, 1.0 / values[known][0])  # of what is expected
    J = np.vstack([np.column_stack(rows.linearise(at)[::-1]) for rows in problem.rows])
    for gram in (R.T @ R, J.T @ J):
        assert np.abs(half.T @ gram @ half - np.eye(known.sum())).max() < EXACT + of_rounding
    cost = sum(rows.squared_norm(at) for rows in problem.rows)
    assert cost == pytest.approx(expected[-1, -1], rel=EXACT)


@pytest.fixture
def eliminated(monkeypatch):
    """`eliminated("dense")`: shared errors are eliminated by dense matrices, or in steps."""

    def by(way):
        most = {"dense": 2000, "steps": 0}[way]
        monkeypatch.setattr(error_states, "MAX_DENSE", most)
        monkeypatch.setattr(error_states, "MAX_FILL", min(most, error_states.MAX_FILL))

    return by


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "way", "as_stated"), diagonal(GRAPHS, ["dense", "steps"], [True, False]))
def test_rows_are_whitened_by_the_dense_covariance_of_all_errors(eliminated, kind, way, as_stated):
    """That of `dense`, which knows plain formulas of rows alone, to 1e-9."""
    eliminated(way)
    rng = np.random.default_rng(GRAPHS.index(kind))
    robot = small_arm(tolerance=TOLERANCE)
    m, pairing = measured_in(kind, robot, rng)
    problem = build_problem(robot, m, model="distance-rotation", pairing=pairing)
    if kind.startswith("mixed"):
        assert len(problem.data.series) == 2
    if "joint" in kind or "direct" not in kind:
        (rows,) = problem.rows
        assert rows.states is not None
    check_rows(problem if as_stated else learned(problem, rng))


def two_tables(kind, robot, rng, *, named=True):
    """Poses, and pairs or touches at the same configurations and at some more, all read with joint noise."""
    m = measure(true_robot(robot, rng), 16, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
    m = replace(m, named=named, source="first")
    poses = replace(m, **{f: getattr(m, f)[:12] for f in ("readings", "ids", "test", "position", "rotation")})
    poses = replace(poses, sigma_position=m.sigma_position[:12], sigma_orientation=m.sigma_orientation[:12])
    if kind == "touches":
        one, nan = np.ones(2), np.full(2, np.nan)
        between = Pairs(np.array([0, 1]), np.array([2, 3]), 2.0 * one, nan, 1e-3 * one, nan, nan > 0.0)
        index = np.where(np.arange(16) % 5 == 4, -1, np.arange(16) % 4)  # some at no point
        groups = Groups(("A", "B", "C", "D"), index, between)
        other = replace(m, groups=groups, sigma_point=np.full(16, 2e-4), position=None, rotation=None)
        return [Table(poses, model="pose"), Table(replace(other, source="second"), model="distance")]
    other = measure(true_robot(robot, rng), 16, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4, readings=m.readings)
    if kind == "pairs":
        a, b = np.repeat(np.arange(8), 2), 4 + np.arange(16) % 12
        other = directly_measured(other, robot, a[a != b], b[a != b])
        noise = 1e-3 * rng.normal(size=other.pairs.n_pairs)
        other = replace(other, pairs=replace(other.pairs, distance=other.pairs.distance + noise))
    other = replace(other, named=named, source="second")
    return [Table(poses, model="pose"), Table(other, model="distance", pairing=Pairing("chain"))]


TABLES = ["pairs", "chain", "touches"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("kind", "way", "as_stated"), diagonal(TABLES, ["dense", "steps"], [True, False]))
def test_tables_share_the_joint_errors_of_configurations_of_one_name(eliminated, kind, way, as_stated):
    """Poses and what another table has of the same configurations: one covariance of all their rows."""
    eliminated(way)
    robot, rng = small_arm(tolerance=TOLERANCE), np.random.default_rng(7)
    problem = build_problem(robot, two_tables(kind, robot, rng))
    assert problem.data.n_configurations == 16
    *alone, rows = problem.rows  # distances between points are of no configuration
    assert {part.table for part in rows.parts} == {0, 1}
    assert len(alone) == (kind == "touches")
    check_rows(problem if as_stated else learned(problem, rng))


def test_tables_whose_names_are_made_up_share_nothing():
    robot, rng = small_arm(tolerance=TOLERANCE), np.random.default_rng(8)
    problem = build_problem(robot, two_tables("pairs", robot, rng, named=False))
    assert problem.data.n_configurations == 28
    poses, pairs = problem.rows
    assert poses.states is None
    assert {part.table for part in pairs.parts} == {1}
    check_rows(problem)


ENCODERS = ["star joint", "mixed direct joint", "poses", "two tables"]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "way", "as_stated"), diagonal(ENCODERS, ["dense", "steps"], [True, False]))
def test_estimated_joint_values_are_those_that_the_dense_covariance_says(eliminated, kind, way, as_stated):
    """About joint values already taken the rows are still those of the readings, and say the same to first order."""
    eliminated(way)
    robot, rng = small_arm(tolerance=TOLERANCE), np.random.default_rng(9)
    if kind == "two tables":
        problem = build_problem(robot, two_tables("pairs", robot, rng), encoder="estimated")
    else:
        m, pairing = measured_in("star joint" if kind == "poses" else kind, robot, rng)
        model = "pose" if kind == "poses" else "distance-rotation"
        problem = build_problem(robot, m, model=model, pairing=pairing, encoder="estimated")
    taken = 1e-4 * rng.normal(size=problem.data.readings.shape)
    state = replace(problem.state, joint_errors=taken)
    problem = relinearized_at(problem, problem.start, state)
    problem = problem if as_stated else learned(problem, rng)
    check_rows(problem)
    A, L, C = dense(problem, problem.start)
    z = np.einsum("ncj,n->cj", L, np.linalg.solve(C, A[:, -1]))
    found = joint_errors(problem, problem.start) / problem.sigma_joint
    seen = np.flatnonzero(L.any(axis=(0, 2)))
    # Steps end with 1e-9 of the Gram matrix left: of the errors, in their sigma, the root of that.
    assert np.abs(found[seen] + z[seen]).max() < np.sqrt(EXACT) * np.sqrt(A[:, -1] @ np.linalg.solve(C, A[:, -1]))


def test_a_star_shares_the_errors_of_its_hub_alone():
    """Those of the other poses reach one pair each and are this pair's own."""
    m = measure(small_arm(), 30, np.random.default_rng(1))
    (rows,) = build_problem(small_arm(), m, model="distance-rotation", pairing=Pairing("star")).rows
    assert rows.states.loadings.shape == (58, 8)


def test_pairs_of_configurations_of_their_own_share_nothing():
    rng = np.random.default_rng(2)
    robot = small_arm()
    m = directly_measured(measure(robot, 20, rng, sigma_joint=1e-4), robot, np.arange(0, 20, 2), np.arange(1, 20, 2))
    (rows,) = build_problem(robot, m, model="distance-rotation").rows
    assert rows.states is None


def test_what_rows_have_to_themselves_for_safety_is_no_degree_of_freedom():
    """All pairs of poses hold no more than the poses in an unknown frame with an unknown tool: 6 n less 12."""
    m = measure(small_arm(), 12, np.random.default_rng(3))
    problem = build_problem(small_arm(tolerance=TOLERANCE), m, model="distance-rotation", pairing=Pairing("all"))
    assert problem.n_residuals == 132
    assert problem.n_independent == pytest.approx(6 * 12 - 12, abs=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["chain", "random joint"])
def test_a_calibration_in_steps_is_the_dense_one(kind, monkeypatch):
    """Estimates, sigmas and goodness of fit: what steps leave out of the rows is less than 1e-9 of what they say."""
    robot = small_arm(tolerance=TOLERANCE)
    m, pairing = measured_in(kind, robot, np.random.default_rng(6))
    found = []
    for most in (2000, 0):
        monkeypatch.setattr(error_states, "MAX_DENSE", most)
        monkeypatch.setattr(error_states, "MAX_FILL", min(most, error_states.MAX_FILL))
        solution = solve(build_problem(robot, m, model="distance-rotation", pairing=pairing))
        found.append((solution, assess(solution)))
    (dense, of_dense), (steps, of_steps) = found
    sigma = np.sqrt(np.diag(of_dense.covariance))
    apart = of_steps.robot.nominal - of_dense.robot.nominal
    estimated = [robot.index(name) for name in of_dense.names]
    assert np.abs(apart[estimated] / sigma).max() < np.sqrt(1e-9)
    assert np.sqrt(np.diag(of_steps.covariance)) == pytest.approx(sigma, rel=1e-9 + rounding(1.0, 1e3))
    assert steps.cost == pytest.approx(dense.cost, rel=1e-8)
    assert of_steps.fit.goodness.studentised == pytest.approx(of_dense.fit.goodness.studentised, rel=1e-4, nan_ok=True)
    for a, b in zip(of_steps.fit.goodness.kinds, of_dense.fit.goodness.kinds, strict=True):
        assert a.p_value == pytest.approx(b.p_value, rel=1e-4)
        assert a.expected == pytest.approx(b.expected, rel=1e-6)
    bound = 4.0 * np.sqrt(2.0 * dense.problem.n_residuals / error_states.N_PROBES)
    assert abs(steps.problem.n_independent - dense.problem.n_independent) <= bound


@pytest.mark.slow
def test_rows_asked_to_count_as_independent_are_accounted_for_in_the_actual_covariance():
    """Weighted as independent, the covariance is (J^T J)^-1 J^T C J (J^T J)^-1 of the dense covariance."""
    rng = np.random.default_rng(5)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(robot, 15, rng, sigma=(1e-4, 5e-5), sigma_joint=3e-5)
    options = {"model": "distance-rotation", "pairing": Pairing("all"), "prior": False}
    problem = build_problem(robot, m, **options, pair_errors="independent")
    a, b = np.triu_indices(15, 1)
    (series,), (noise,) = problem.data.series, noises_at(problem, problem.start)
    used, (chain,) = series.used, problem.variables.at(problem.start).chains
    C = dense_covariance(robot, m, a, b)
    raw = residuals.linearise(noise.rows, chain)[1].reshape(-1, chain.n_columns)
    W = np.zeros_like(C)
    for i in range(len(a)):
        keep = np.flatnonzero(used[i]) + 2 * i
        if len(keep):
            W[np.ix_(keep, keep)] = np.linalg.inv(np.linalg.cholesky(C[np.ix_(keep, keep)]))
    J = W @ raw
    expected = J.T @ (W @ C @ W.T) @ J
    T = linear_system(problem, problem.start).left.A
    found = correlation(problem, problem.start) + T.T @ T
    assert np.abs(found - expected).max() <= 0.02 * np.abs(expected).max()


def normalised_error(true, uncertainty):
    """Squared error over its covariance, per parameter."""
    at = [true.index(name) for name in uncertainty.names]
    error = uncertainty.robot.nominal[at] - true.nominal[at]
    return error @ np.linalg.solve(uncertainty.covariance, error) / len(error)


@pytest.mark.parametrize("pairing", ["star", "all"])
@pytest.mark.slow
def test_the_covariance_of_pairs_from_poses_is_that_of_the_errors(pairing):
    robot = small_arm(tolerance=TOLERANCE)
    rng = np.random.default_rng(11)
    n_draws = 60 if pairing == "star" else 25
    found, chi2, dof = [], 0.0, 0.0
    for _ in range(n_draws):
        true = true_robot(robot, rng)
        m = measure(true, 20, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
        uncertainty = assess(solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing(pairing))))
        found.append(normalised_error(true, uncertainty))
        chi2, dof = chi2 + uncertainty.fit.chi_square.value, dof + uncertainty.fit.chi_square.expected
    n = len(uncertainty.names)
    assert np.mean(found) == pytest.approx(1.0, abs=4 * np.sqrt(2 / n / n_draws))
    assert chi2 == pytest.approx(dof, rel=0.08)


@pytest.mark.slow
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
    (rows,) = build_problem(robot, m, model="distance").rows
    assert rows.states is None


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
        found.append(uncertainty.fit.chi_square.reduced)
    # Some 150 degrees of freedom: a draw's sd is 0.12 and the mean's 0.035.
    assert np.mean(found) == pytest.approx(1.0, abs=0.14)
