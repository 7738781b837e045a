"""Factors and variables that a user adds to `problem.graph`: solved, counted and assessed, or refused in one line."""

import pickle

import gtsam
import numpy as np
import pytest
from refusals import refusal
from simulated import TOOL, measure, small_arm, true_robot

from fg_calib import DistanceFactor, InputError, ProblemError, RotationAngleFactor, SolverError, build_problem, solve
from fg_calib.assessment import assess
from fg_calib.robot import pose, rotation_angle

TOLERANCE = dict.fromkeys(("a", "d", "theta", "alpha", "tool"), 1e-3)
TOLERANCE |= {f"tool.{k}": 2e-3 for k in ("roll", "pitch", "yaw")}
READINGS = np.array([[0.1, -0.7, 0.3, 0.5], [0.4, -0.3, 1.0, -0.5]])
K1, K3, T0, ADDED = (gtsam.symbol(letter, i) for letter, i in (("K", 1), ("K", 3), ("T", 0), ("p", 7)))
UNIT, SIGMA = gtsam.noiseModel.Unit.Create, gtsam.noiseModel.Isotropic.Sigma


def problem_of(model="pose", **options):
    rng = np.random.default_rng(1)
    robot = small_arm(TOLERANCE, TOOL if model == "pose" else ())
    return build_problem(robot, measure(true_robot(robot, rng), 12, rng), model=model, **options)


def prior(problem, key=K3, sigma=1e-6):
    """The first parameter of a joint is 0.1 mm more than nominal."""
    mean = problem.initial.atVector(key)
    sigmas = np.where(np.arange(len(mean)) == 0, sigma, 1.0)
    return gtsam.PriorFactorVector(key, mean + 1e-4 * (sigmas == sigma), gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def moved(robot):
    """Distance and angle between two configurations."""
    at = pose(robot, READINGS)
    return np.linalg.norm(at.position[1] - at.position[0]), rotation_angle(at.rotation[:1].mT @ at.rotation[1:])[0][0]


def test_added_factors_and_variables_are_solved_and_assessed_as_gtsam_does():
    """A prior, a length, an angle, and a pose that the tool holds within a micrometre and something else loosely."""
    problem, plain = problem_of(), solve(problem_of())
    length, angle = moved(problem.robot)
    mean = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, -1.2, 2.0), np.array([1.0, 2.0, 3.0]))
    added = [
        prior(problem),
        DistanceFactor(problem.variables, *READINGS, length + 1e-3, 1e-4),
        RotationAngleFactor(problem.variables, *READINGS, angle + 1e-3, 1e-4),
        gtsam.PriorFactorPose3(ADDED, mean, SIGMA(6, 0.1)),
        gtsam.BetweenFactorPose3(T0, ADDED, gtsam.Pose3(), SIGMA(6, 1e-6)),
    ]
    for factor in added:
        problem.graph.add(factor)
    problem.initial.insert(ADDED, gtsam.Pose3())
    solution = solve(problem)
    found, before = assess(solution), assess(plain).fit.chi_square
    graph = solution.problem.graph
    assert solution.converged
    assert graph.size() == plain.problem.graph.size() + 5
    assert found.fit.chi_square.dof == before.dof + 4 + 1 + 1 + 6 + 6 - 6  # rows minus the added unknowns
    assert found.fit.chi_square.value == pytest.approx(2.0 * graph.error(solution.values), rel=1e-9)
    assert added[1].error(solution.values) < 0.1 * added[1].error(plain.values)
    a3 = next(p for p in found.estimates.parameters if p.name == "a3")
    assert (a3.correction, a3.sigma) == (pytest.approx(1e-4, abs=5e-6), pytest.approx(1e-6, rel=1e-3))
    values = gtsam.LevenbergMarquardtOptimizer(graph, solution.values).optimize()
    assert graph.error(values) == pytest.approx(graph.error(solution.values), rel=1e-9)
    marginals, sigma = gtsam.Marginals(graph, values), np.sqrt(np.diag(found.spread.tangent))
    for v in solution.problem.variables.items:
        theirs = marginals.marginalCovariance(v.key)
        assert sigma[v.columns] == pytest.approx(np.sqrt(np.diag(theirs)), rel=1e-5)
    again = solve(solution.problem)
    assert again.values.atPose3(ADDED).equals(solution.values.atPose3(ADDED), 1e-7)
    with pytest.raises(ProblemError, match=r"problem\.graph: added factors, expected none: GTSAM's factors cannot"):
        pickle.dumps(solution)


def test_an_initial_value_of_ones_own_is_where_the_solver_begins():
    problem = problem_of("position")
    problem.initial.update(K1, problem.initial.atVector(K1) + 1e-3)
    moved, still = solve(problem), solve(problem_of("position"))
    assert moved.initial_cost != pytest.approx(still.initial_cost, rel=1e-6)
    assert moved.parameters == pytest.approx(still.parameters, abs=1e-9)


def test_factors_added_after_solving_need_another_solution():
    solution = solve(problem_of())
    solution.problem.graph.add(prior(solution.problem))
    assert solve(solution.problem).problem.graph.size() == problem_of().graph.size() + 1


def test_the_graph_can_be_solved_incrementally():
    solution = solve(problem_of("distance-rotation"))
    graph, parameters = solution.problem.graph, gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.setRelinearizeThreshold(1e-9)
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, solution.problem.initial)
    for _ in range(8):
        isam.update()
    assert graph.error(isam.calculateBestEstimate()) == pytest.approx(solution.cost, rel=1e-6)


def test_pair_factors_by_name_have_the_error_and_derivative_of_their_measurement():
    problem = problem_of()
    variables, values = problem.variables, problem.variables.values(problem.start)
    length, angle = moved(problem.robot.with_values(problem.start[variables.robot_span]))
    for factor, error in (
        (DistanceFactor(variables, *READINGS, length - 3e-3, 1e-3), 3.0),
        (RotationAngleFactor(variables, *READINGS, angle + 2e-3, 1e-3), -2.0),
    ):
        assert factor.error(values) == pytest.approx(0.5 * error**2, rel=1e-9)
        A, b = factor.linearize(values).jacobian()
        assert b == pytest.approx([-error], rel=1e-9)
        step = 1e-6 * np.random.default_rng(0).normal(size=variables.n_columns)
        numeric = [-factor.linearize(variables.values(variables.moved(problem.start, s))).jacobian()[1]
                   for s in (step, -step)]  # fmt: skip
        order = np.concatenate([np.arange(variables.n_columns)[v.columns] for k in list(factor.keys())
                                for v in variables.items if v.key == k])  # fmt: skip
        assert A @ step[order] == pytest.approx((numeric[0] - numeric[1]) / 2.0, rel=1e-5)


@pytest.mark.parametrize("figure", [np.nan, -1.0, "far"])
def test_numbers_of_a_pair_factor_are_checked(figure):
    variables = problem_of().variables
    with pytest.raises(InputError, match=r"^distance: found "):
        DistanceFactor(variables, *READINGS, figure, 1e-3)
    with pytest.raises(InputError, match=r"^sigma: found 0, "):
        RotationAngleFactor(variables, *READINGS, 1.0, 0)
    with pytest.raises(InputError, match=r"^start: shape \(3,\)"):
        DistanceFactor(variables, [0, 0, 0], [0, 0, 0], 1.0, 1e-3)
    with pytest.raises(InputError, match=r"^angle: found 4\.0, expected 0 to pi, in rad$"):
        RotationAngleFactor(variables, *READINGS, 4.0, 1e-3)


def with_value(key, value):
    def damage(problem):
        problem.initial.erase(key)
        problem.initial.insert(key, value)

    return damage


def with_factor(factor):
    return lambda problem: problem.graph.add(factor)


def custom(error):
    return with_factor(gtsam.CustomFactor(UNIT(1), [K1], error))


def fails(*_):
    raise ZeroDivisionError("mine")


def without_last(problem):
    problem.graph.resize(problem.graph.size() - 1)


HESSIAN = gtsam.LinearContainerFactor(gtsam.HessianFactor(K3, np.eye(4), np.zeros(4), 0.0))
EXACT = gtsam.PriorFactorVector(K3, np.zeros(4), gtsam.noiseModel.Constrained.All(4, 1e8))
REMOVED = "problem.graph: factors removed or replaced, expected all 17 of the problem, in their places"
WANTED = "expected a factor with a noise model of sigmas above 0, such as PriorFactorVector or CustomFactor"
EVERY = "expected one for every variable of the graph, and no others"
PRIOR = "problem.graph: added PriorFactorVector on K1"
OTHER = "another value, expected"
DAMAGES = {
    "emptied": (lambda p: p.graph.resize(0), REMOVED),
    "one removed": (without_last, REMOVED),
    "one replaced": (lambda p: p.graph.replace(0, prior(p)), REMOVED),
    "longer": (lambda p: p.graph.resize(20), f"problem.graph: an added NoneType, {WANTED}"),
    "no start": (lambda p: p.initial.erase(K1), f"problem.initial: no value of K1, {EVERY}"),
    "a longer start": (with_value(K1, np.zeros(7)), f"problem.initial: K(1): {OTHER} 4 finite numbers"),
    "a start of another type": (with_value(T0, np.zeros(6)), f"problem.initial: T(0): {OTHER} a gtsam.Pose3"),
    "a start that is nan": (with_value(K1, np.full(4, np.nan)), f"problem.initial: K(1): {OTHER} 4 finite numbers"),
    "an added variable without a start": (with_factor(gtsam.PriorFactorPose3(ADDED, gtsam.Pose3(), UNIT(6))),
                                          f"problem.initial: no value of p7, {EVERY}"),
    "a start without factor": (lambda p: p.initial.insert(ADDED, np.ones(3)),
                               f"problem.initial: a value of p7, {EVERY}"),
    "a factor of other size": (with_factor(gtsam.PriorFactorVector(K1, np.zeros(3), UNIT(3))), f"{PRIOR}: raised "
                               "ValueError: NoiseModelFactor: NoiseModel has dimension 3 instead of 4."),
    "a factor at nan": (with_factor(gtsam.PriorFactorVector(K1, np.full(4, np.nan), UNIT(4))),
                        f"{PRIOR}: an error of nan at the initial values, expected a finite one"),
    "a factor that raises": (custom(fails), "problem.graph: added CustomFactor on K1: raised ZeroDivisionError: mine"),
    "a factor of no numbers": (custom(lambda *_: None), "problem.graph: added CustomFactor on K1: raised RuntimeError: "
                               "None is only valid for an optional Matrix pointer"),
    "a factor without rows": (with_factor(HESSIAN), f"problem.graph: an added LinearContainerFactor, {WANTED}"),
    "an exact factor": (with_factor(EXACT), f"problem.graph: an added PriorFactorVector, {WANTED}"),
    "sigma of 0": (lambda p: p.graph.add(prior(p, sigma=0.0)), f"problem.graph: an added PriorFactorVector, {WANTED}"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_wrong_with_a_graph_is_said_in_one_line(name):
    damage, said = DAMAGES[name]
    problem = problem_of()
    damage(problem)
    assert refusal(solve, problem, error=ProblemError) == said


def test_a_factor_on_an_error_variable_is_refused_with_gtsams_optimizer_as_the_way_out():
    problem = problem_of("distance")
    keys = [key for key in problem.graph.keyVector() if chr(gtsam.symbolChr(key)) == "Z"]
    graph, mean = problem.graph, problem.initial.atVector(keys[0]) + 0.5
    graph.add(gtsam.PriorFactorVector(keys[0], mean, SIGMA(len(mean), 1e-4)))
    assert refusal(solve, problem, error=ProblemError) == (
        f"problem.graph: an added factor on the error variable {str(gtsam.Symbol(keys[0])).strip()}, expected "
        "factors on other variables; gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.initial) takes it"
    )
    values = gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.initial).optimize()
    assert values.atVector(keys[0]) == pytest.approx(mean, abs=1e-4)  # the sigma of the added factor
    assert graph.error(values) < 0.1 * graph.error(problem.initial)


@pytest.mark.parametrize("of_third", ["raises", "is nan"])
def test_what_a_factor_does_while_it_is_solved_is_one_line(of_third):
    calls = []

    def error(_, values, H):
        calls.append(0)
        if of_third == "raises" and len(calls) > 3:
            raise ValueError("out of\nreach")
        if H is not None:
            H[0] = np.full((1, 4), np.nan if of_third == "is nan" else 1.0, order="F")
        return np.array([float(np.sum(values.atVector(K1)))])

    problem = problem_of()
    custom(error)(problem)
    absurd = "a residual is not finite: the measurements or the robot hold absurd numbers"
    said = "out of reach" if of_third == "raises" else absurd
    with pytest.raises(SolverError, match=f"^{said}$") as found:
        solve(problem)
    assert isinstance(found.value.__cause__, ValueError) == (of_third == "raises")


def test_added_factors_with_gauge_keep_are_refused():
    problem = problem_of("distance", gauge="keep")
    problem.graph.add(prior(problem, key=problem.variables.items[0].key))
    with pytest.raises(ProblemError, match=r"added factors with gauge keep, expected gauge prior or none"):
        solve(problem)
