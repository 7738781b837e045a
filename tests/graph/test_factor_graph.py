"""The factor graph: one factor a measurement, GTSAM's own optimum and marginals, and what a user adds to it."""

import gtsam
import numpy as np
import pytest
from simulated import measure, paper_robot, small_arm, true_robot
from tolerances import rounding

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.factors import DistanceFactor, RotationAngleFactor
from fg_calib.graph.problem import linear_system, reduced_graph, relinearized_at
from fg_calib.graph.solver import levenberg_marquardt_params, solve
from fg_calib.inputs import InputError, ProblemError, SolverError
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import forward
from fg_calib.robot.rotations import rotation_angle

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3, "beta": 1e-3}
ANCHOR = gtsam.symbol("a", 0)
READINGS = np.array([[0.1, -0.7, 0.3, 0.5, -0.3, 0.9, 0.2], [0.4, -0.3, 1.0, -0.5, 0.7, -0.9, 1.4]])


def problem_of(gauge="prior", model="distance", seed=0, robot=None):
    rng = np.random.default_rng(seed)
    robot = robot or paper_robot(TOLERANCE)
    return build_problem(robot, measure(true_robot(robot, rng), 40, rng), model=model, gauge=gauge)


def prior_on_k3(problem, sigma=1e-6):
    """An opinion of somebody's on the parameters of joint 3: a3 is 0.1 mm more than nominal."""
    key = gtsam.symbol("K", 3)
    mean = problem.initial.atVector(key) + np.eye(len(problem.initial.atVector(key)))[0] * 1e-4
    sigmas = np.full(len(mean), 1.0)
    sigmas[0] = sigma
    return gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def known_distance(problem, extra=2e-3, sigma=1e-5):
    """The tool moves by 2 mm more than nominal between two configurations."""
    variables, trig = problem.variables, problem.robot.trig(READINGS)
    at = forward(variables.chains[0].at(problem.start), trig).position
    length = np.linalg.norm(at[1] - at[0]) + extra

    def error(_, values, H):
        at = forward(variables.chains[0].at(variables.parameters(values, variables.items)), trig)
        step = at.position[1] - at.position[0]
        if H is not None:
            J = (step / np.linalg.norm(step) @ (at.jacobian[1, 3:] - at.jacobian[0, 3:]))[None]
            for i, v in enumerate(variables.items):
                H[i] = J[:, v.columns]
        return np.array([np.linalg.norm(step) - length])

    keys = [v.key for v in variables.items]
    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys, error)


def anchor_distances(problem, point, n=8, sigma=1e-4):
    """Distances from the tool to a fixed point that nobody knows, as seen at nominal."""
    variables = problem.variables
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (n, problem.robot.n_joints))
    trig = problem.robot.trig(q)
    measured = np.linalg.norm(forward(variables.chains[0].at(problem.start), trig).position - point, axis=1)

    def factor(k):
        def error(_, values, H):
            at = forward(variables.chains[0].at(variables.parameters(values, variables.items)), trig[k : k + 1])
            step = at.position[0] - values.atPoint3(ANCHOR)
            u = step / np.linalg.norm(step)
            if H is not None:
                J = (u @ at.jacobian[0, 3:])[None]
                for i, v in enumerate(variables.items):
                    H[i] = J[:, v.columns]
                H[len(variables.items)] = -u[None]
            return np.array([np.linalg.norm(step) - measured[k]])

        keys = [v.key for v in variables.items] + [ANCHOR]
        return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), keys, error)

    return [factor(k) for k in range(n)]


def dense_covariance(solution, n):
    """Of the first n columns, from GTSAM's linear system of the whole graph by a pseudo-inverse."""
    problem = solution.problem
    ordering = gtsam.Ordering()
    for key in problem.variables.keys:
        ordering.push_back(key)
    A, _ = reduced_graph(problem).linearize(solution.values).jacobian(ordering)
    scales = np.concatenate([problem.variables.prior_scales, np.ones(A.shape[1] - n)])
    inverse = np.linalg.pinv(A * scales, rcond=1e-10) * scales[:, None]
    return (inverse @ inverse.T)[:n, :n]


def test_factors_on_our_variables_are_solved_and_assessed():
    problem = problem_of()
    own = [prior_on_k3(problem), known_distance(problem)]
    for factor in own:
        problem.graph.add(factor)
    plain, solution = solve(problem_of()), solve(problem)
    before, after = assess(plain), assess(solution)
    a3 = next(p for p in after.estimates.parameters if p.name == "a3")
    assert solution.converged
    assert a3.correction == pytest.approx(1e-4, abs=5e-6)  # five of the prior's sigma
    assert a3.sigma < 1e-6
    assert own[1].error(solution.values) < 12.5  # five sigma
    assert own[1].error(plain.values) > 1e3
    assert solution.problem.graph.size() == problem_of().graph.size() + 2
    # One row of the distance and as many of the prior as joint 3 has parameters; no direction more.
    assert after.fit.chi_square.dof == before.fit.chi_square.dof + 1 + len(
        problem.initial.atVector(gtsam.symbol("K", 3))
    )
    assert after.fit.chi_square.value == pytest.approx(2.0 * solution.problem.graph.error(solution.values), rel=1e-9)
    C = dense_covariance(solution, problem.variables.n_columns)
    sigma = np.sqrt(np.diag(after.spread.tangent))
    assert sigma == pytest.approx(np.sqrt(np.diag(C)), rel=1e-6)  # conditioning of 1e4 squared times rounding


@pytest.mark.slow
@pytest.mark.parametrize("gauge", ["prior", "none"])
def test_a_variable_of_ones_own_is_solved_and_found_again(gauge):
    point = np.array([3.0, -2.0, 1.0])
    problem = problem_of(gauge)
    plain = assess(solve(problem_of(gauge)))
    for factor in anchor_distances(problem, point):
        problem.graph.add(factor)
    problem.initial.insert(ANCHOR, point + np.array([0.3, -0.2, 0.4]))
    solution = solve(problem)
    uncertainty = assess(solution)
    assert solution.converged
    assert np.linalg.norm(solution.values.atPoint3(ANCHOR) - point) < 0.02  # the arm is off by millimetres
    gained = uncertainty.spread.rank - plain.spread.rank
    assert uncertainty.fit.chi_square.dof == plain.fit.chi_square.dof + 8 - 3 - gained
    if gauge == "prior":
        C = dense_covariance(solution, problem.variables.n_columns)
        sigma = np.sqrt(np.diag(uncertainty.spread.tangent))
        assert sigma == pytest.approx(np.sqrt(np.diag(C)), rel=1e-6)  # conditioning of 1e4 squared times rounding
    # Solving again from there, with the variable in its place, changes nothing.
    again = solve(solution.problem)
    assert again.values.atPoint3(ANCHOR) == pytest.approx(solution.values.atPoint3(ANCHOR), abs=1e-7)


@pytest.mark.slow
def test_a_pose_of_ones_own_is_solved():
    """Of any of GTSAM's types: a frame in which the base stands, known by a prior alone."""
    problem, key = problem_of(), gtsam.symbol("p", 7)
    mean = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, -1.2, 2.0), np.array([1.0, 2.0, 3.0]))
    problem.graph.add(gtsam.PriorFactorPose3(key, mean, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    problem.initial.insert(key, gtsam.Pose3())
    solution = solve(problem)
    assert solution.values.atPose3(key).equals(mean, 1e-9)
    assert assess(solution).fit.chi_square.dof == assess(solve(problem_of())).fit.chi_square.dof


@pytest.mark.slow
def test_what_is_added_determines_what_was_not():
    """Classes and rank count it: a length along the first axis, which no pair of positions says anything of."""
    problem, plain = problem_of("none"), assess(solve(problem_of("none")))
    key = gtsam.symbol("K", 1)
    prior = gtsam.PriorFactorVector(key, problem.initial.atVector(key), gtsam.noiseModel.Isotropic.Sigma(5, 1e-3))
    problem.graph.add(prior)
    found = assess(solve(problem))
    assert {p.identifiability for p in plain.estimates.parameters[6:11]} == {"ineffective", "relative"}
    assert {p.identifiability for p in found.estimates.parameters[6:11]} == {"independent"}
    assert found.identifiability.observability.rank == plain.identifiability.observability.rank + 5
    assert [p.sigma for p in found.estimates.parameters[6:11]] == pytest.approx([1e-3] * 5, rel=1e-9)


@pytest.mark.parametrize("change", ["removed", "replaced"])
def test_a_graph_without_one_of_its_factors_is_refused(change):
    problem, graph = problem_of(), gtsam.NonlinearFactorGraph()
    n = problem.graph.size()
    for i in range(n - (change == "removed")):
        graph.add(problem.graph.at(i))
    if change == "replaced":
        graph.replace(0, prior_on_k3(problem))
    with pytest.raises(ProblemError, match=rf"^problem\.graph: {n - 1} of the problem's {n} factors, expected all"):
        solve(with_graph(problem, graph))


def with_graph(problem, graph):
    """The problem with its graph exchanged, as a user's code might do in place."""
    problem.graph.resize(0)
    for i in range(graph.size()):
        problem.graph.add(graph.at(i))
    return problem


def test_a_variable_needs_a_start_and_a_factor():
    problem = problem_of()
    problem.graph.add(anchor_distances(problem, np.ones(3), n=1)[0])
    with pytest.raises(ProblemError, match=r"^problem\.initial: no value of a0, expected one for every variable"):
        solve(problem)
    problem = problem_of()
    problem.initial.insert(ANCHOR, np.ones(3))
    with pytest.raises(ProblemError, match=r"^problem\.initial: a value of a0, expected none without a factor on it"):
        solve(problem)


@pytest.mark.slow
def test_factors_added_to_what_was_solved_are_to_be_solved_again():
    problem = problem_of()
    solution = solve(problem)
    assess(solution)
    solution.problem.graph.add(prior_on_k3(problem))
    with pytest.raises(ProblemError, match=r"^solution\.problem\.graph: 1 factors added since it was solved"):
        assess(solution)
    assert assess(solve(solution.problem)).fit.chi_square.dof == assess(solve(problem)).fit.chi_square.dof + 5


def test_a_start_of_ones_own_is_where_the_solver_begins():
    robot = small_arm({"a": 1e-3})
    problem = problem_of(model="pose", robot=robot)
    key = problem.variables.items[0].key
    problem.initial.update(key, problem.initial.atVector(key) + 1e-3)
    moved = solve(problem, None)
    still = solve(problem_of(model="pose", robot=robot))
    assert moved.initial_cost != still.initial_cost
    assert np.abs(moved.parameters - still.parameters).max() < rounding(1, 1e4)


SHARED = {
    "poses": ({"model": "pose"}, 0.0),
    "poses, joint noise": ({"model": "pose", "frame": "unknown"}, 5e-4),
    "star": ({"model": "distance-rotation"}, 0.0),
    "star, joint noise": ({"model": "distance-rotation"}, 5e-4),
    "chain, joint noise": ({"model": "distance", "pairing": Pairing("chain")}, 5e-4),
    "all pairs as if independent": (
        {"model": "distance-rotation", "pairing": Pairing("all"), "pair_errors": "independent"},
        5e-4,
    ),
    "joint values estimated": ({"model": "distance-rotation", "encoder": "estimated"}, 0.03),
}


@pytest.mark.parametrize("name", SHARED)
def test_optimum_and_marginals_are_those_of_gtsam_on_the_graph(name):
    """One factor a measurement, error variables where measurements share errors: to 1e-6 sigma, and sigmas to 1e-6."""
    options, sigma_joint = SHARED[name]
    rng, robot = np.random.default_rng(4), paper_robot(TOLERANCE)
    m = measure(true_robot(robot, rng), 14, rng, sigma_joint=sigma_joint)
    solution = solve(build_problem(robot, m, **options))
    problem = relinearized_at(solution.problem, solution.parameters)
    graph, variables = problem.graph, problem.variables
    factors = [graph.at(i) for i in range(graph.size())]
    n_pairs = sum(isinstance(factor, DistanceFactor) for factor in factors)
    assert n_pairs == (0 if "poses" in name else problem.n_pairs)
    if options["model"] == "distance-rotation":
        assert sum(isinstance(factor, RotationAngleFactor) for factor in factors) == n_pairs
    letters = {chr(gtsam.symbolChr(key)) for key in graph.keyVector()}
    assert ("E" in letters) == (name not in ("poses", "poses, joint noise", "all pairs as if independent"))
    parameters = levenberg_marquardt_params()
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.initial, parameters).optimize()
    assert graph.error(values) == pytest.approx(solution.weighted_cost, rel=1e-9)
    assert graph.error(solution.values) == pytest.approx(solution.weighted_cost, rel=1e-6)
    system = linear_system(solution.problem, solution.parameters)
    sigma = np.sqrt(np.diag(system.covariance))
    assert np.abs(variables.step(solution.parameters, variables.parameters(values)) / sigma).max() < 1e-6
    marginals = gtsam.Marginals(graph, values)
    for v in variables.items:
        theirs = marginals.marginalCovariance(v.key)
        np.testing.assert_allclose(np.sqrt(np.diag(theirs)), sigma[v.columns], rtol=1e-6)


def test_the_graph_can_be_solved_incrementally():
    rng = np.random.default_rng(5)
    robot = paper_robot(TOLERANCE)
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 12, rng), model="distance-rotation"))
    graph, initial = solution.problem.graph, solution.problem.initial
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(1e-9)
    isam = gtsam.ISAM2(params)
    isam.update(graph, initial)
    for _ in range(8):
        isam.update()
    assert graph.error(isam.calculateBestEstimate()) == pytest.approx(solution.cost, rel=1e-6)


def test_a_factor_on_an_error_variable_is_refused():
    rng, robot = np.random.default_rng(5), small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3})
    problem = build_problem(robot, measure(robot, 8, rng), model="distance")
    key = next(key for key in problem.graph.keyVector() if chr(gtsam.symbolChr(key)) == "E")
    problem.graph.add(
        gtsam.PriorFactorVector(key, problem.initial.atVector(key), UNIT(problem.initial.atVector(key).size))
    )
    with pytest.raises(ProblemError, match=r"^problem\.graph: an added factor on the error variable E\d"):
        solve(problem)


def test_pair_factors_by_name_have_the_error_of_their_measurement():
    problem = problem_of()
    variables, values = problem.variables, problem.variables.values(problem.start)
    at = forward(variables.chains[0].at(problem.start), problem.robot.trig(READINGS))
    length = np.linalg.norm(at.position[1] - at.position[0])
    angle = rotation_angle((at.rotation[0].T @ at.rotation[1])[None])[0][0]
    factor = DistanceFactor(variables, *READINGS, length - 3e-3, 1e-3)
    assert factor.error(values) == pytest.approx(0.5 * 3.0**2, rel=1e-9)
    assert RotationAngleFactor(variables, *READINGS, angle + 2e-3, 1e-3).error(values) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize("figure", [np.nan, -1.0, "far"])
def test_a_figure_of_a_factor_is_checked(figure):
    problem = problem_of()
    with pytest.raises(InputError, match=r"^distance: found "):
        DistanceFactor(problem.variables, *READINGS, figure, 1e-3)
    with pytest.raises(InputError, match=r"^sigma: found 0, "):
        RotationAngleFactor(problem.variables, *READINGS, 1.0, 0)
    with pytest.raises(InputError, match=r"^start: shape \(3,\)"):
        DistanceFactor(problem.variables, [0, 0, 0], [0, 0, 0], 1.0, 1e-3)


@pytest.mark.parametrize(
    ("factor", "found"),
    [
        (lambda p: prior_on_k3(p, sigma=0.0), "an added PriorFactorVector with a constrained noise model"),
        (
            lambda p: gtsam.PriorFactorVector(
                gtsam.symbol("K", 3), np.zeros(5), gtsam.noiseModel.Constrained.All(5, 1e8)
            ),
            "an added PriorFactorVector with a constrained noise model",
        ),
        (
            lambda p: gtsam.LinearContainerFactor(
                gtsam.HessianFactor(gtsam.symbol("K", 3), np.eye(5), np.zeros(5), 0.0)
            ),
            "an added LinearContainerFactor",
        ),
    ],
    ids=["a sigma of 0", "all exact", "no rows"],
)
def test_a_factor_whose_rows_have_no_weight_is_refused(factor, found):
    """GTSAM counts exact rows in its own optimiser; as weighted rows they would say next to nothing."""
    problem = problem_of()
    problem.graph.add(factor(problem))
    with pytest.raises(ProblemError, match=found):
        solve(problem)


@pytest.mark.slow
def test_what_was_solved_with_pairs_and_a_tool_can_be_solved_again():
    """Noise that was learned of all columns is not that of frames and tool alone, which are fitted first."""
    rng = np.random.default_rng(0)
    robot = small_arm({"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3, "tool": 2e-3}, estimate=("tool.x",))
    m = measure(true_robot(robot, rng), 40, rng, sigma=(1e-3, 1e-3))
    first = solve(build_problem(robot, m, model="distance"))
    again = solve(first.problem)
    sigma = np.array([p.sigma or np.inf for p in assess(first).estimates.parameters])
    assert np.abs((again.parameters - first.parameters)[: len(sigma)] / sigma).max() < 1e-6


K1, T0 = gtsam.symbol("K", 1), gtsam.symbol("T", 0)
TIPS = [f"tool.{kind}" for kind in ("x", "y", "z", "roll", "pitch", "yaw")]


def damaged(damage):
    """A small problem, with something done to its graph or its initial values."""
    rng = np.random.default_rng(1)
    robot = small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3, "tool": 1e-3}, TIPS)
    problem = build_problem(robot, measure(true_robot(robot, rng), 12, rng), model="pose")
    damage(problem)
    return problem


def with_value(key, value):
    def damage(problem):
        problem.initial.erase(key)
        problem.initial.insert(key, value)

    return damage


def with_factor(factor):
    return lambda problem: problem.graph.add(factor)


def custom(error):
    return with_factor(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [K1], error))


def fails(*_):
    raise ZeroDivisionError("mine")


UNIT = gtsam.noiseModel.Unit.Create
DAMAGES = {
    "emptied": (lambda p: p.graph.resize(0), "problem.graph: 0 of the problem's 17 factors, expected all of them, in "
                "their places"),
    "longer": (lambda p: p.graph.resize(20), "problem.graph: None among its factors, expected factors"),
    "no start": (lambda p: p.initial.erase(K1), "problem.initial: no value of K(1), expected one for every variable of "
                 "the problem"),
    "no starts": (lambda p: p.initial.clear(), "problem.initial: no value of K(1), expected one for every variable of "
                  "the problem"),
    "a longer start": (with_value(K1, np.zeros(7)), "problem.initial: K(1): 7 numbers, expected 4 finite numbers"),
    "a start of another type": (with_value(T0, np.zeros(6)), "problem.initial: T(0): a value of another type, expected "
                                "a gtsam.Pose3"),
    "a start that is nan": (with_value(K1, np.full(4, np.nan)), "problem.initial: K(1): a number that is not finite, "
                            "expected 4 finite numbers"),
    "a factor of other size": (with_factor(gtsam.PriorFactorVector(K1, np.zeros(3), UNIT(3))), "problem.graph: added "
                               "PriorFactorVector on K1: raised ValueError: NoiseModelFactor: NoiseModel has dimension "
                               "3 instead of 4."),
    "a factor at nan": (with_factor(gtsam.PriorFactorVector(K1, np.full(4, np.nan), UNIT(4))), "problem.graph: added "
                        "PriorFactorVector on K1: an error of nan at the initial values, expected a finite one"),
    "a factor that raises": (custom(fails), "problem.graph: added CustomFactor on K1: raised ZeroDivisionError: mine"),
    "a factor of no numbers": (custom(lambda *_: None), "problem.graph: added CustomFactor on K1: raised RuntimeError: "
                               "None is only valid for an optional Matrix pointer"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_wrong_with_a_graph_is_said_in_one_line(name):
    damage, said = DAMAGES[name]
    problem = damaged(damage)
    with pytest.raises(ProblemError) as found:
        solve(problem)
    assert str(found.value) == said


def test_what_a_factor_raises_on_the_way_is_one_line():
    calls = []

    def error(_, values, H):
        calls.append(0)
        if len(calls) > 3:
            raise ValueError("out of\nreach")
        if H is not None:
            H[0] = np.ones((1, 4), order="F")
        return np.array([float(np.sum(values.atVector(K1)))])

    with pytest.raises(SolverError, match=r"^out of reach$") as found:
        solve(damaged(custom(error)))
    assert isinstance(found.value.__cause__, ValueError)


def test_a_derivative_that_is_nan_is_named():
    def error(_, values, H):
        if H is not None:
            H[0] = np.full((1, 4), np.nan, order="F")
        return np.array([float(np.sum(values.atVector(K1)))])

    with pytest.raises(SolverError, match=r"^a residual or derivative is not finite$"):
        solve(damaged(custom(error)))


def test_an_angle_is_at_most_half_a_turn():
    variables = damaged(lambda _: None).variables
    with pytest.raises(InputError, match=r"^angle: found 4\.0, expected 0 to pi, in rad$"):
        RotationAngleFactor(variables, np.zeros(4), np.ones(4), 4.0, 1e-3)
