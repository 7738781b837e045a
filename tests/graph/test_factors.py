"""GTSAM's side: factors equal their residuals, blocks equal single rows, tangents are as documented."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm, true_robot
from tolerances import rounding

from fg_calib.graph.build import build_problem
from fg_calib.graph.factors import CheckedFactor, MeasurementFactor, reduced_factor
from fg_calib.graph.variables import build_variables, frame_of, pose_of, prior_rows
from fg_calib.inputs import SolverError
from fg_calib.measurements import residuals
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import forward

FRAME = (Rotation.from_rotvec([0.5, -1.0, 2.0]), np.array([3.0, -20.0, 1.0]))


def test_of_many_unknown_frames_each_chain_has_its_own_columns():
    robot = small_arm()
    variables = build_variables(robot, [True] * 4)
    here = np.concatenate([robot.nominal, np.zeros(24)])
    trig = robot.trig(np.full((1, robot.n_joints), 0.3))
    for table, chain in enumerate(variables.chains):
        moved = np.any(forward(chain.at(here), trig).jacobian[0] != 0.0, axis=0)
        of_frames = moved[variables.n_robot_columns :].reshape(4, 6)
        assert np.flatnonzero(of_frames.all(axis=1)).tolist() == [table]
        assert np.flatnonzero(of_frames.any(axis=1)).tolist() == [table]


def problem_of(model, n=8, frame="unknown", estimate=TOOL, tolerance=None, pairing=None, seed=0):
    rng = np.random.default_rng(seed)
    robot = small_arm(estimate=estimate, tolerance=tolerance)
    measurements = measure(true_robot(robot, rng), n, rng, frame=FRAME)
    pairing = pairing or Pairing("all")
    return build_problem(robot, measurements, model=model, frame=frame, pairing=pairing, pair_errors="independent")


def moved(values, variables, step):
    delta = gtsam.VectorValues()
    for v in variables.items:
        delta.insert(v.key, step[v.columns])
    return values.retract(delta)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("model", ["pose", "position", "orientation", "distance", "rotation", "distance-rotation"])
def test_derivatives_of_every_model_are_those_along_gtsams_retraction(model):
    problem = problem_of(model)
    variables, (rows,) = problem.variables, problem.rows
    rng = np.random.default_rng(1)
    values = moved(problem.initial, variables, 1e-2 * rng.normal(size=variables.n_columns))

    def residual(step):
        at = variables.at(variables.parameters(moved(values, variables, step)))
        return rows.linearise(at.without_columns())[0]

    _, J = rows.linearise(variables.at(variables.parameters(values)))
    h = 1e-6
    for k in range(variables.n_columns):
        step = np.zeros(variables.n_columns)
        step[k] = h
        numeric = (residual(step) - residual(-step)) / (2 * h)
        size = max(1.0, np.abs(J).max())
        assert J[:, k] == pytest.approx(numeric, abs=1e-6 * size), variables.names[k]


@pytest.mark.parametrize("model", ["pose", "distance-rotation"])
def test_a_reduced_block_equals_its_rows_in_cost_gradient_and_hessian(model):
    problem = problem_of(model, n=40)
    variables, (rows,), values = problem.variables, problem.rows, problem.initial
    assert rows.n_rows > variables.n_columns + 1
    factor = reduced_factor(rows, variables)
    r, J = rows.linearise(variables.at(variables.parameters(values)))
    assert factor.error(values) == pytest.approx(0.5 * r @ r, rel=rounding(1, 10))
    A, b = factor.linearize(values).jacobian()
    assert A.T @ A == pytest.approx(J.T @ J, abs=rounding(np.abs(J.T @ J).max(), 100))
    assert A.T @ b == pytest.approx(-J.T @ r, abs=rounding(np.abs(J.T @ r).max(), 100))
    assert A.shape == (variables.n_columns + 1, variables.n_columns)


def one_by_one(rows, variables):
    """A factor for each measurement of rows that share no errors."""
    graph, (part,) = gtsam.NonlinearFactorGraph(), rows.parts
    assert rows.states is None
    for i in range(part.block.n):
        one = replace(part, block=residuals.rows_of(part.block, slice(i, i + 1)), nuisances=part.nuisances[i : i + 1])
        graph.add(MeasurementFactor(variables, one))
    return graph


@pytest.mark.sampled(2)
@pytest.mark.parametrize("model", ["pose", "position", "orientation", "distance", "rotation", "distance-rotation"])
def test_single_row_factors_and_the_block_have_the_same_cost_and_gradient(model):
    problem = problem_of(model, n=15)
    (rows,), values = problem.rows, problem.initial
    whole, single = reduced_factor(rows, problem.variables), one_by_one(rows, problem.variables)
    assert single.size() == rows.parts[0].block.n
    assert single.error(values) == pytest.approx(whole.error(values), rel=rounding(1, 10))
    G = whole.linearize(values).augmentedInformation()
    H = single.linearize(values).augmentedHessian()
    assert H == pytest.approx(G, abs=rounding(np.abs(G).max(), 100))


@pytest.mark.slow
def test_single_row_factors_and_the_block_have_the_same_optimum():
    problem = problem_of(
        "distance-rotation",
        n=15,
        estimate=["tool.x"],
        tolerance={"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3, "tool": 1e-3},
    )
    single = one_by_one(problem.rows[0], problem.variables)
    for i in range(1, problem.graph.size()):  # the priors
        single.add(problem.graph.at(i))
    found = []
    for graph in (problem.graph, single):
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        parameters.setRelativeErrorTol(1e-14)
        values = gtsam.LevenbergMarquardtOptimizer(graph, problem.initial, parameters).optimize()
        found.append(problem.variables.parameters(values))
    assert found[0] == pytest.approx(found[1], abs=rounding(1, 10))


def test_keys_are_joints_tool_and_frame():
    robot = small_arm(estimate=TOOL)
    variables = build_variables(robot, [True])
    assert [v.symbol for v in variables.items] == ["K(1)", "K(2)", "K(3)", "K(4)", "T(0)", "X(0)"]
    assert variables.names[:4] == ("a1", "alpha1", "d1", "theta1")
    both = small_arm(estimate=[*TOOL, *(name.replace("tool", "base") for name in TOOL)])
    assert [v.symbol for v in build_variables(both, [False]).items][::5] == ["B(0)", "T(0)"]
    partly = build_variables(small_arm(estimate=["tool.z"]), [False])
    assert [v.symbol for v in partly.items] == ["K(1)", "K(2)", "K(3)", "K(4)", "K(5)"]
    assert partly.names[-1] == "tool.z"
    assert variables.describe(gtsam.symbol("K", 2)) == "K(2) (a2, alpha2, d2, theta2)"


def test_values_and_parameter_vector_are_two_ways_to_write_the_same():
    variables = build_variables(small_arm(estimate=TOOL), [True])
    parameters = variables.nominal() + 0.1 * np.random.default_rng(2).normal(size=len(variables.nominal()))
    assert variables.parameters(variables.values(parameters))[6:] == pytest.approx(parameters[6:], abs=rounding(1.0))


def test_pose3_steps_rotation_first_and_in_itself():
    pose = pose_of(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 0.6]))
    step = pose.retract(np.array([0, 0, 1e-3, 1e-3, 0, 0]))
    assert step.translation() - pose.translation() == pytest.approx(pose.rotation().matrix()[:, 0] * 1e-3, abs=1e-6)
    turned = pose.rotation().between(step.rotation())
    assert gtsam.Rot3.Logmap(turned) == pytest.approx([0, 0, 1e-3], abs=rounding(10.0))
    assert frame_of(pose) == pytest.approx([1, 2, 3, 0.4, -0.5, 0.6])


def test_named_scalars_of_a_pose_follow_its_tangent():
    variables = build_variables(small_arm(estimate=TOOL), [True])
    parameters = variables.nominal() + 0.3 * np.random.default_rng(3).normal(size=len(variables.nominal()))
    values = variables.values(parameters)
    columns = [list(v.parameters) for v in variables.items]
    D = variables.named_derivative(variables.parameters(values))
    h = 1e-6
    for k in range(variables.n_columns):
        step = np.zeros(variables.n_columns)
        step[k] = h
        up, down = (variables.parameters(moved(values, variables, s))[np.concatenate(columns)] for s in (step, -step))
        assert D[:, k] == pytest.approx((up - down) / (2 * h), abs=1e-8)


def test_priors_pull_to_nominal_with_their_tolerance_whatever_the_variable():
    tolerance = {"a": 2e-3, "tool": 5e-3, "tool.yaw": 0.01}
    variables = build_variables(small_arm(estimate=TOOL, tolerance=tolerance), [True])
    parameters = variables.nominal()
    names = [p.name for p in variables.robot.parameters]
    parameters[names.index("a2")] += 4e-3
    parameters[names.index("tool.yaw")] += 0.03 - 2 * np.pi  # an angle is the same a turn further
    r, J = prior_rows(variables, parameters)
    assert len(r) == 4 + 3 + 1
    # of the tool it is the turn about its own z axis that counts, which at this pitch and roll is not that of yaw
    of_yaw = 3 * np.cos(0.4) * np.cos(0.3)
    assert r == pytest.approx([0, 2, 0, 0, 0, 0, 0, of_yaw], abs=rounding(1, 100))
    assert J.shape == (8, variables.n_columns)
    assert J[1, variables.names.index("a2")] == pytest.approx(500)


def test_a_wrong_shape_or_a_number_that_is_none_is_an_error_and_not_the_end_of_the_interpreter():
    variables = build_variables(small_arm(), [False])
    values, n = variables.values(variables.nominal()), variables.n_columns
    cases = {
        "shapes": lambda _: (np.zeros(2), np.zeros((3, n))),
        "not finite": lambda _: (np.zeros(3), np.full((3, n), np.nan)),
    }
    for word, linearise in cases.items():
        factor = CheckedFactor(variables.items, 3, linearise)
        with pytest.raises(SolverError, match=word):
            factor.linearize(values)
    with pytest.raises(SolverError, match="residual of shape"):
        CheckedFactor(variables.items, 3, cases["shapes"]).error(values)


def test_fixed_parameters_have_no_column():
    robot = paper_robot(fixed=["a1", "alpha1", "d1", "theta1", "beta1"])
    variables = build_variables(robot, [False])
    assert variables.n_columns == 30
    assert "K(1)" not in [v.symbol for v in variables.items]
    changed = replace(robot, name="other")
    assert build_variables(changed, [False]).names == variables.names
