"""Rows, optimum and covariance of every kind of problem: those of dense formulas and of GTSAM's own optimiser."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from custom_kinds import lengths_to_anchors
from dense import dense, priors
from instruments import measured_by
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, pairs_between, small_arm, true_robot
from sparing import as_case
from touches import TOOL_POINT, corners, touch

from fg_calib import DistanceFactor, Pairing, RotationAngleFactor, Table, build_problem, solve
from fg_calib.graph import JOINT_NOISE, joint_errors, relinearized_at
from fg_calib.measurements import Pairs
from fg_calib.robot import pose

TOLERANCE = dict.fromkeys(("a", "d", "alpha", "theta", "tool"), 2e-3)
TOLERANCE |= {f"tool.{k}": 3e-3 for k in ("roll", "pitch", "yaw")}
PLACED = (Rotation.from_euler("ZYX", [0.4, np.pi / 2, 0.2]), np.array([70.0, -30.0, 20.0]))


def poses(rng, *, n=14, joint=0.0, estimate=(), frame=None, within=np.pi):
    """Poses of an arm with joints within an angle of 0."""
    robot = small_arm(TOLERANCE, estimate)
    true, sigma, q = true_robot(robot, rng), (1e-3, 5e-4), rng.uniform(-within, within, (n, 4))
    return robot, measure(true, n, rng, sigma=sigma, sigma_joint=joint, frame=frame, readings=q)


def direct(rng, *, graph="star", joint=0.0):
    """Pairs measured directly; of a mixed graph some distances are zero, of others some are missing."""
    robot, m = poses(rng)
    a, b = {
        "apart": (np.arange(0, 14, 2), np.arange(1, 14, 2)),
        "star": (np.zeros(13, dtype=int), np.arange(1, 14)),
        "tree": (rng.integers(0, np.arange(1, 14)), np.arange(1, 14)),
        "all": np.triu_indices(14, 1),
        "mixed": (np.repeat(np.arange(5), 3), 5 + np.arange(15) % 9),
    }[graph]
    if graph == "mixed":  # points reached again from nearby
        q = m.readings.copy()
        q[b[::4]] = q[a[::4]] + 1e-3 * rng.normal(size=(4, 4))
        m = replace(m, readings=q)
    true, q = true_robot(robot, rng), m.readings + joint * rng.normal(size=m.readings.shape)
    pairs = pairs_between(true, q, (a, b), rng)
    distance, angle, n = pairs.distance.copy(), pairs.angle.copy(), len(a)
    distance[:: 4 if graph == "mixed" else 100] = 0.0 if graph == "mixed" else np.nan
    angle[: n if graph == "mixed" else 0 : 4] = np.nan
    return robot, replace(m, pairs=replace(pairs, distance=distance, angle=angle), sigma_joint=np.full(4, joint))


def touches(rng, *, joint=0.0):
    """Touches of four points with two distances between them."""
    robot = small_arm(TOLERANCE, TOOL_POINT)
    true = true_robot(robot, rng)
    lengths = ((0, 1, 1e-4), (2, 3, 1e-4))
    return robot, touch(true, corners(true, 4, rng), 6, rng, distances=lengths, sigma_joint=joint)


def two_tables(rng, *, second="pairs", joint=3e-4):
    """Poses and other measurements at some of the same configurations, whose joint errors are the same."""
    robot, m = poses(rng, n=16, joint=joint)
    m = replace(m, named=True, source="first")
    if second == "touches":
        robot, other = touches(rng, joint=joint)
        m = replace(other, groups=None, position=pose(robot, other.readings).position)
        m = replace(m, sigma_position=np.full((24, 3), 1e-3), source="first", named=True)
        return robot, [Table(m, "position"), Table(replace(other, source="second", named=True), "distance")]
    other = measure(true_robot(robot, rng), 16, rng, sigma=(1e-3, 5e-4), readings=m.readings)
    other = replace(other, source="second", named=True, sigma_joint=m.sigma_joint)
    if second == "pairs":
        a, b = np.arange(8), 4 + np.arange(8)
        distance = np.linalg.norm(np.subtract(*(m.position[k] for k in (a, b))), axis=1)
        nan = np.full(8, np.nan)
        pairs = Pairs(a, b, distance, nan, np.full(8, 1e-3), nan, nan > 0.0)
        other = replace(other, position=None, rotation=None, pairs=pairs)
    return robot, [Table(m.select(np.arange(12)), "pose"), Table(other, "distance", Pairing("chain"))]


def instrument(rng, *, name, joint=0.0):
    """What an instrument measures."""
    robot, _, table = measured_by(name, rng, n=24, sigma_joint=joint)
    return robot, table


def custom(rng, *, joint=0.0):
    """Lengths to three anchors by a kind of a user's own."""
    robot, _, table = lengths_to_anchors(int(rng.integers(100)), n=24, sigma_joint=joint)
    return robot, table


def gross(rng, **how):
    """Poses of which some are off by many sigma."""
    robot, m = poses(rng, n=16, **how)
    off = np.zeros((16, 3))
    off[::8] = 0.02 * rng.normal(size=(2, 3))
    return robot, replace(m, position=m.position + off)


NOISE = 3e-4
PAIRS = {"model": "distance-rotation"}
CASES = {
    "poses": (poses, {}, {"model": "pose"}),
    "poses, frame, tool, joint noise": (poses, {"joint": NOISE, "estimate": TOOL, "frame": PLACED},
                                        {"model": "pose", "frame": "unknown"}),
    "positions, frame, tool point": (poses, {"estimate": TOOL_POINT, "frame": PLACED},
                                     {"model": "position", "frame": "unknown"}),
    "orientations, joint noise": (poses, {"joint": NOISE}, {"model": "orientation"}),
    "star": (poses, {}, PAIRS),
    "star, joint noise": (poses, {"joint": NOISE}, PAIRS),
    "chain of distances, joint noise": (poses, {"joint": NOISE}, {"model": "distance", "pairing": Pairing("chain")}),
    "angles, random pairs": (poses, {}, {"model": "rotation", "pairing": Pairing("random", 40, 0)}),
    "all pairs, joint noise": (poses, {"joint": NOISE}, PAIRS | {"pairing": Pairing("all")}),
    "all pairs as if independent": (poses, {"joint": NOISE},
                                    PAIRS | {"pairing": Pairing("all"), "pair_errors": "independent"}),
    "direct pairs apart, joint noise": (direct, {"graph": "apart", "joint": NOISE}, PAIRS),
    "direct star, joint noise": (direct, {"graph": "star", "joint": NOISE}, PAIRS),
    "direct tree, joint noise": (direct, {"graph": "tree", "joint": NOISE}, PAIRS),
    "all direct pairs, joint noise": (direct, {"graph": "all", "joint": NOISE}, PAIRS),
    "direct pairs and equal points, joint noise": (direct, {"graph": "mixed", "joint": NOISE}, PAIRS),
    "touches": (touches, {}, {"model": "distance"}),
    "touches, joint noise": (touches, {"joint": NOISE}, {"model": "distance"}),
    "poses and pairs": (two_tables, {"second": "pairs"}, {}),
    "poses and a chain": (two_tables, {"second": "chain"}, {}),
    "positions and touches": (two_tables, {"second": "touches"}, {}),
    **{f"{name}, joint noise": (instrument, {"name": name, "joint": NOISE}, {}) for name in ("targets known",
       "targets stations", "anchors offset", "anchors nearly", "planes", "board")},
    "pixels": (instrument, {"name": "pixels"}, {}),
    "room, joint noise": (instrument, {"name": "room", "joint": 2e-4}, {}),
    "a custom kind, joint noise": (custom, {"joint": NOISE}, {}),
    "joint values of poses": (poses, {"joint": NOISE}, {"model": "pose", "encoder": "estimated"}),
    "joint values of a star": (poses, {"joint": NOISE}, PAIRS | {"encoder": "estimated"}),
    "joint values of direct pairs": (direct, {"graph": "tree", "joint": NOISE}, PAIRS | {"encoder": "estimated"}),
    "joint values of touches": (touches, {"joint": NOISE}, {"model": "distance", "encoder": "estimated"}),
    "joint values of two tables": (two_tables, {"second": "pairs"}, {"encoder": "estimated"}),
    "huber": (gross, {}, {"model": "pose", "loss": "huber"}),
    "cauchy, joint noise": (gross, {"joint": NOISE}, {"model": "position", "loss": "cauchy"}),
    "geman-mcclure, joint values": (gross, {"joint": NOISE},
                                    {"model": "pose", "loss": "geman-mcclure", "encoder": "estimated"}),
    "gnc of a star": (gross, {}, PAIRS | {"loss": "gnc"}),
    "gauge keep": (poses, {}, PAIRS | {"gauge": "keep"}),
    "gauge none": (poses, {"frame": PLACED}, {"model": "pose", "frame": "unknown", "gauge": "none"}),
    "all pairs of small motions": (poses, {"within": 0.1}, PAIRS | {"pairing": Pairing("all")}),
}  # fmt: skip


SLOW = {
    *("star", "angles, random pairs", "direct pairs apart, joint noise", "direct star, joint noise", "touches"),
    *("all direct pairs, joint noise", "poses and a chain", "pixels", "positions and touches", "poses"),
    *("targets known, joint noise", "anchors nearly, joint noise", "planes, joint noise", "joint values of poses"),
    *("joint values of a star", "joint values of two tables", "huber"),
}


def problem_of(name):
    make, how, options = CASES[name]
    robot, measurements = make(np.random.default_rng(list(CASES).index(name)), **how)
    return build_problem(robot, measurements, **options)


@cache
def solved(name):
    return solve(problem_of(name))


def whitened(problem, x):
    """Rows [A r] of measurements and priors, whitened by the dense covariance, and errors' effect on the first."""
    A, L, C = dense(problem, x)
    W = np.linalg.inv(np.linalg.cholesky(C))
    return np.vstack([W @ A, priors(problem, x)]), np.einsum("ncj,nk->cjk", L, W.T @ W @ A)


def check_system(problem, x):
    """The normal system is that of the dense rows: cost, step, rank and, in any direction, information."""
    rows, _ = whitened(problem, x)
    system, n = problem.linearize(x), problem.variables.n_columns
    A, r = rows[:, :-1], rows[:, -1]
    assert system.cost == pytest.approx(0.5 * r @ r, rel=1e-9)
    root = system.full_root
    assert np.abs(root.T @ A.T @ A @ root - np.eye(root.shape[1])).max() < 1e-6
    assert np.linalg.matrix_rank(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300), 1e-9) == root.shape[1]
    off = root.T @ (A.T @ r)  # the step in sigma, to where the rows have their optimum
    assert np.linalg.norm(off) == pytest.approx(system.decrement, rel=1e-6, abs=1e-6)
    assert np.max(np.abs(system.step + root @ off)[:n] / np.sqrt(np.diag(system.covariance) + 1e-300)) < 1e-6
    return system


@pytest.mark.parametrize("name", [as_case(name, is_slow=name in SLOW) for name in CASES])
def test_rows_optimum_and_covariance_are_those_of_dense_formulas(name):
    """At the estimate, and with other weights and factors on every noise at the start."""
    problem, solution = problem_of(name), solved(name)
    assert solution.converged, solution.message
    x, there = solution.parameters, relinearized_at(solution.problem, solution.parameters)
    assert check_system(there, x).decrement < 1e-6
    rows, effect = whitened(there, x)
    assert 2.0 * solution.weighted_cost == pytest.approx(rows[:, -1] @ rows[:, -1], rel=1e-6)
    if problem.options.encoder == "estimated":
        found = joint_errors(there, x) / there.sigma_joint
        assert np.abs(found + effect[:, :, -1])[np.any(effect, axis=(1, 2))].max() < 1e-4
    rng = np.random.default_rng(1)
    weights = tuple(rng.uniform(0.1, 1.0, s.n) for s in problem.data.blocks)
    kinds = {(s.table, part.split(".")[0]) for s in problem.data.blocks for part in s.kind.names}
    factors = dict(zip(sorted(kinds), rng.uniform(0.5, 2.0, len(kinds)), strict=True)) | {JOINT_NOISE: 1.3}
    check_system(relinearized_at(problem, problem.start, replace(problem.state, weights=weights, factors=factors)),
                 problem.start)  # fmt: skip


LEFT_OUT = ("gauge", "equal", "pixels", "room", "positions and")
GRAPHS = [name for name in CASES if not any(word in name for word in LEFT_OUT)]
FEW = {
    *("poses, frame, tool, joint noise", "star, joint noise", "direct tree, joint noise", "touches", "gnc of a star"),
    *("anchors nearly, joint noise", "joint values of two tables", "all pairs as if independent"),
}


@pytest.mark.parametrize("name", [as_case(name, is_slow=name not in FEW) for name in GRAPHS])
def test_the_graph_has_one_factor_a_measurement_and_the_same_optimum_and_marginals(name):
    """By GTSAM's own Levenberg-Marquardt and `Marginals`, to 1e-6 sigma; its derivatives are those of its errors."""
    solution = solved(name)
    problem = relinearized_at(solution.problem, solution.parameters)
    graph, variables = problem.graph, problem.variables
    factors = [graph.at(i) for i in range(graph.size())]
    for kind, of in ((DistanceFactor, "distance"), (RotationAngleFactor, "angle")):
        blocks = [s for s in problem.pair_blocks if of in s.kind.names]
        wanted = sum(s.used[s.train, s.kind.names.index(of)].sum() for s in blocks)
        assert sum(isinstance(factor, kind) for factor in factors) == wanted
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.initial, parameters).optimize()
    assert graph.error(values) == pytest.approx(solution.weighted_cost, rel=1e-9)
    assert graph.error(solution.values) == pytest.approx(solution.weighted_cost, rel=1e-6)
    system = problem.linearize(solution.parameters)
    sigma = np.linalg.norm(system.full_root, axis=1)
    step = variables.step(solution.parameters, variables.parameters(values))
    assert np.abs(step / sigma)[sigma > 0.0].max() < 1e-6
    marginals = gtsam.Marginals(graph, values)
    for v in (*variables.items, *variables.nuisance):
        theirs = np.sqrt(np.diag(marginals.marginalCovariance(v.key)))
        np.testing.assert_allclose(theirs, sigma[v.columns], rtol=1e-6)
    check_derivatives(problem, solution.values)


def check_derivatives(problem, values):
    """Rows have the derivatives of central differences along GTSAM's retraction, in a random direction of all unknowns.

    Contacts leave out a rotation of all residuals together, which changes no length: there landmarks alone are moved.
    """
    graph, rng, ordering, variables = problem.graph, np.random.default_rng(3), gtsam.Ordering(), problem.variables
    scales = {v.key: variables.all_scales[v.columns] for v in (*variables.items, *variables.nuisance)}
    if any(part.turned_back for s in problem.data.blocks for part in s.kind.parts):
        scales |= {v.key: 0.0 * scales[v.key] for v in variables.items}
    step, sizes = gtsam.VectorValues(), values.zeroVectors()
    for key in graph.keyVector():
        ordering.push_back(key)
        step.insert(key, scales.get(key, 1.0) * rng.normal(size=len(sizes.at(key))))

    def rows(h):
        return graph.linearize(values.retract(step.scale(h))).jacobian(ordering)

    numeric = (rows(-1e-3)[1] - rows(1e-3)[1]) / 2e-3
    found = rows(0.0)[0] @ step.vector(graph.keyVector())
    assert found == pytest.approx(numeric, abs=1e-5 * np.abs(found).max())
