"""The solver: recovery, agreement with scipy, and a status that tells the truth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm, true_robot
from tolerances import rounding

from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import relinearized_at
from fg_calib.graph.solver import SolverOptions, solve
from fg_calib.graph.variables import prior_rows
from fg_calib.inputs import SolverError
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3}
FRAME = (Rotation.from_rotvec(np.pi * np.array([0.0, 0.6, 0.8])), np.array([7.0, -30.0, 2.0]))


def cost_at(problem, parameters):
    at = problem.variables.at(parameters)
    data = sum(rows.squared_norm(at) for rows in problem.rows)
    return 0.5 * (data + np.sum(prior_rows(problem.variables, parameters)[0] ** 2))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["pose", "position", "distance", "distance-rotation"])
@pytest.mark.parametrize("prior", [True, False])
def test_the_calibrated_arm_predicts_what_it_was_not_fitted_to(model, prior):
    rng = np.random.default_rng(0)
    robot = paper_robot(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    measurements = measure(true, 150, rng, frame=FRAME, sigma=(1e-4, 2e-5))
    problem = build_problem(
        robot, measurements, model=model, frame="unknown", prior=prior, pairing=Pairing("random", 400)
    )
    solution = solve(problem)
    assert solution.converged, solution.message
    found = robot.with_values(solution.parameters[:-6])
    q = rng.uniform(-np.pi, np.pi, (2, 200, 7))

    def distances(r):
        return np.linalg.norm(pose(r, q[0]).position - pose(r, q[1]).position, axis=1)

    before, after = (np.sqrt(np.mean((distances(r) - distances(true)) ** 2)) for r in (robot, found))
    assert before > 5e-3
    assert after < 1e-3  # noise 0.1 mm: prediction error of 0.2 to 0.4 mm over the whole workspace, measured


def test_a_problem_can_be_linearised_anywhere():
    rng = np.random.default_rng(1)
    robot = small_arm(tolerance={"a": 1e-3, "theta": 1e-3})
    problem = build_problem(robot, measure(true_robot(robot, rng), 20, rng), model="pose")
    assert problem.linearize().cost == pytest.approx(cost_at(problem, problem.start), rel=1e-12)
    solution = solve(problem)
    assert problem.linearize(solution.parameters).decrement < 3e-7


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pose", "distance-rotation"])
def test_the_optimum_is_scipys(model):
    rng = np.random.default_rng(1)
    robot = paper_robot(tolerance=TOLERANCE)
    problem = build_problem(robot, measure(true_robot(robot, rng), 60, rng), model=model)
    solution = solve(problem)
    variables, (rows,) = problem.variables, solution.problem.rows  # whitened at the estimate
    columns = [robot.index(name) for name in variables.names]

    def parameters(x):
        p = variables.nominal()
        p[columns] = x
        return p

    def stacked(x):
        r = rows.linearise(variables.at(parameters(x)).without_columns())[0]
        return np.concatenate([r, prior_rows(variables, parameters(x))[0]])

    scale = np.array([robot.parameters[i].scale for i in columns])
    found = scipy.optimize.least_squares(
        stacked, robot.nominal[columns], x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert solution.cost == pytest.approx(found.cost, rel=rounding(1, 100))
    # scipy differentiates by differences: agreement to a thousandth of the tolerances
    assert (solution.parameters[columns] - found.x) / scale == pytest.approx(np.zeros(len(columns)), abs=1e-3)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("model", ["pose", "position", "orientation"])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]])
def test_a_frame_metres_and_half_a_turn_away_converges(model, axis):
    rng = np.random.default_rng(2)
    robot = small_arm(estimate=TOOL if model == "pose" else [])
    true = true_robot(robot, rng)
    frame = (Rotation.from_rotvec(np.pi * np.array(axis, dtype=float)), np.array([25.0, -8.0, 3.0]))
    problem = build_problem(robot, measure(true, 60, rng, frame=frame), model=model, frame="unknown")
    solution = solve(problem)
    assert solution.converged, solution.message
    dof = problem.n_residuals - problem.variables.n_columns
    assert 2 * solution.cost / dof == pytest.approx(1.0, abs=5 * np.sqrt(2 / dof))


def test_what_nothing_determines_stays_at_nominal():
    rng = np.random.default_rng(3)
    robot = paper_robot()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 100, rng), model="distance-rotation"))
    assert solution.converged
    found = dict(
        zip(
            [p.name for p in robot.parameters], solution.parameters - solution.problem.variables.nominal(), strict=False
        )
    )
    for name in ("a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"):
        assert found[name] == pytest.approx(0.0, abs=1e-5), name
    # of d3 + d4 + d5 the minimum-norm step gives each a third
    assert found["d3"] == pytest.approx(found["d5"], abs=1e-4)


def test_before_is_the_nominal_arm_with_frame_and_tool_fitted():
    rng = np.random.default_rng(4)
    robot = small_arm(estimate=TOOL)
    measurements = measure(true_robot(robot, rng), 40, rng, frame=FRAME)
    solution = solve(build_problem(robot, measurements, model="pose", frame="unknown"))
    joints = [i for i, p in enumerate(robot.parameters) if 1 <= p.owner <= 4]
    assert np.array_equal(solution.before[joints], robot.nominal[joints])
    assert solution.before[-6:-3] == pytest.approx(FRAME[1], abs=0.05)
    assert solution.initial_cost == pytest.approx(cost_at(solution.problem, solution.before), rel=rounding(1, 10))
    assert solution.cost < solution.initial_cost


def test_history_tells_cost_damping_and_step():
    rng = np.random.default_rng(5)
    robot = small_arm()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 40, rng), model="pose"))
    costs = [i.cost for i in solution.history]
    assert all(b <= a * (1 + rounding(10)) for a, b in pairwise(costs))
    assert solution.history[-1].decrement < 0.1 < solution.history[0].decrement
    assert solution.history[0].step > 1
    assert all(i.damping == 0.0 for i in solution.history)  # no step had to be damped
    assert solution.cost == pytest.approx(cost_at(solution.problem, solution.parameters), rel=rounding(1, 10))


def test_too_few_iterations_are_said_to_be_too_few():
    rng = np.random.default_rng(6)
    robot = small_arm()
    problem = build_problem(robot, measure(true_robot(robot, rng), 40, rng), model="pose")
    solution = solve(problem, SolverOptions(max_iterations=1))
    assert not solution.converged
    assert solution.message.startswith("not converged: 1 iterations, ")


def test_absurd_numbers_are_an_error_and_not_a_result():
    robot = small_arm()
    measurements = measure(robot, 20, np.random.default_rng(7))
    absurd = replace(measurements, position=np.full((20, 3), 1e200))
    problem = build_problem(robot, absurd, model="position")
    with pytest.raises(SolverError, match="the cost at the start is inf"):
        solve(problem)


def test_rows_are_reweighted_at_the_estimate():
    """A pair near a kink by the nominal arm only takes part again once the arm is calibrated."""
    rng = np.random.default_rng(8)
    robot = paper_robot(tolerance={"a": 5e-3, "d": 5e-3, "alpha": 0.01, "theta": 0.01, "beta": 0.01})
    true = true_robot(robot, rng)
    q = rng.uniform(-np.pi, np.pi, (101, 7))
    q[60:] = q[0] + 0.004 * rng.normal(size=(41, 7))  # small rotations against the first
    problem = build_problem(robot, measure(true, 101, rng, readings=q), model="distance-rotation")
    solution = solve(problem)
    assert solution.converged
    there = build_problem(robot.with_values(solution.parameters[:-6]), problem.measurements, model="distance-rotation")
    there = relinearized_at(there, there.start, solution.problem.state)
    for found, expected in zip(solution.problem.data.series, there.data.series, strict=True):
        assert np.array_equal(found.used, expected.used)
    (at_start,), (found,), (expected,) = problem.noises, solution.problem.noises, there.noises
    # They were whitened where the last step began: less than 3e-7 sigma from its end.
    assert found.sigma == pytest.approx(expected.sigma, rel=1e-6)
    excess = expected.figures()[1]
    assert found.figures()[1] == pytest.approx(excess, rel=1e-6, abs=1e-6 * expected.sigma.min())
    assert np.abs(at_start.sigma / expected.sigma - 1.0).max() > 1e-3


@pytest.mark.long
def test_tens_of_thousands_of_pairs_reach_the_optimum_with_weak_priors():
    """Where GTSAM's default parameters return the first step's values without a word."""
    rng = np.random.default_rng(9)
    robot = paper_robot(tolerance={"a": 0.05, "d": 0.05, "alpha": 0.05, "theta": 0.05, "beta": 0.05})
    true = paper_robot().with_values(
        robot.nominal + 5e-3 * rng.normal(size=len(robot.nominal)) * [p.estimated for p in robot.parameters]
    )
    problem = build_problem(
        robot, measure(true, 700, rng), model="distance-rotation", pairing=Pairing("random", 35_000)
    )
    solution = solve(problem)
    assert solution.converged
    # 70 000 distances and angles of 700 poses, whose errors they share, hold no more than these: 4200 figures.
    assert solution.problem.n_independent == pytest.approx(4200, rel=0.01)
    assert 2 * solution.cost == pytest.approx(4200, rel=5 * np.sqrt(2 / 4200))


def test_where_rounding_hides_the_optimum_nothing_has_converged():
    """Tolerances of 1e9 m beside noise of a tenth of a millimetre: no figure of 64 bits holds both."""
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance={"a": 2e-3, "d": 1e9, "alpha": 2e-3, "theta": 2e-3})
    measured = measure(small_arm({"a": 2e-3}), 20, rng, sigma=(1e-4, 1e-4))
    solution = solve(build_problem(robot, measured, model="position"))
    assert not solution.converged
    assert solution.message.startswith("not converged: rounding hides the optimum, by ")
