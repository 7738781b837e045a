"""GTSAM's variables, the parameter vector, tangents of frames and priors, also at a pitch of 90 degrees."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from oracle import central_differences
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm

from fg_calib import ProblemError, SolverError, assess, build_problem, solve
from fg_calib.graph import build_variables, corrections_of, frame_of, pose_of, prior_rows
from fg_calib.graph.factors import CheckedFactor
from fg_calib.robot import forward

BASE = [name.replace("tool", "base") for name in TOOL]
KINDS = ("x", "y", "z", "yaw", "pitch", "roll")
TOLERANCE = dict.fromkeys(("a", "d", "alpha", "theta"), 1e-3) | dict.fromkeys(("tool", "base"), 5e-3)
TOLERANCE |= {f"{frame}.{k}": 3e-3 for frame in ("tool", "base") for k in KINDS[3:]}


def pitched(frame, pitch, tolerance=TOLERANCE):
    """The small arm with a frame of six unknowns at a pitch, [deg]."""
    robot = small_arm(tolerance=tolerance, estimate=TOOL if frame == "tool" else BASE)
    values = robot.nominal
    values[indices_of(robot, frame)] = 0.05, 0.03, 0.1, 0.4, np.deg2rad(pitch), 0.2
    return robot.with_values(values)


def indices_of(robot, frame):
    return [robot.index(f"{frame}.{k}") for k in KINDS]


def rotated(values, indices, rotvec):
    """Values of a frame rotated about its own axes."""
    R = Rotation.from_matrix(pose_of(values[indices]).rotation().matrix()) * Rotation.from_rotvec(rotvec)
    return frame_of(gtsam.Pose3(gtsam.Rot3(R.as_matrix()), values[indices][:3]), values[indices])


def test_keys_are_joints_tool_base_and_frames():
    variables = build_variables(small_arm(estimate=TOOL), [True])
    assert [v.symbol for v in variables.items] == ["K(1)", "K(2)", "K(3)", "K(4)", "T(0)", "X(0)"]
    assert variables.names[:4] == ("a1", "alpha1", "d1", "theta1")
    assert variables.names[-6:] == tuple(f"frame.{k}" for k in KINDS)
    both = build_variables(small_arm(estimate=[*TOOL, *BASE]), [True, False, True])
    assert [v.symbol for v in both.items] == ["B(0)", "K(1)", "K(2)", "K(3)", "K(4)", "T(0)", "X(0)", "X(2)"]
    assert both.names[-1] == "frame3.roll"
    partly = build_variables(small_arm(estimate=["tool.z"]), [False])
    assert [v.symbol for v in partly.items] == ["K(1)", "K(2)", "K(3)", "K(4)", "K(5)"]
    assert partly.names[-1] == "tool.z"
    robot = paper_robot(fixed=["a1", "alpha1", "d1", "theta1", "beta1"])
    fixed = build_variables(robot, [False])
    assert fixed.n_columns == 30
    assert "K(1)" not in [v.symbol for v in fixed.items]
    assert build_variables(replace(robot, name="other"), [False]).names == fixed.names


def test_each_of_many_unknown_frames_has_its_own_columns():
    robot = small_arm()
    variables = build_variables(robot, [True] * 4)
    nominal, trig = variables.nominal(), robot.trig(np.full((1, robot.n_joints), 0.3))
    for table, chain in enumerate(variables.chains):
        acts = np.any(forward(chain.at(nominal), trig).jacobian[0] != 0.0, axis=0)
        of_frames = acts[variables.n_robot_columns :].reshape(4, 6)
        assert np.flatnonzero(of_frames.all(axis=1)).tolist() == [table]
        assert np.flatnonzero(of_frames.any(axis=1)).tolist() == [table]


def test_names_of_a_variables_entries_and_of_no_variable():
    problem = build_problem(small_arm(), measure(small_arm(), 12, np.random.default_rng(0)), model="pose")
    assert problem.names_of(gtsam.symbol("K", 2)) == ("a2", "alpha2", "d2", "theta2")
    with pytest.raises(ProblemError, match=r"^key: no variable of the arm, "):
        problem.names_of(gtsam.symbol("q", 3))


def test_steps_values_and_parameter_vector_agree():
    """`moved` is GTSAM's retraction (of a Pose3 rotation first, in itself), `step` undoes it."""
    variables = build_variables(small_arm(estimate=[*TOOL, *BASE]), [True])
    rng = np.random.default_rng(2)
    start = variables.moved(variables.nominal(), 0.1 * rng.normal(size=variables.n_columns))
    values = variables.values(start)
    assert variables.parameters(values) == pytest.approx(start, abs=1e-12)
    step, delta = 0.2 * rng.normal(size=variables.n_columns), gtsam.VectorValues()
    for v in variables.items:
        delta.insert(v.key, step[v.columns])
    assert variables.moved(start, step) == pytest.approx(variables.parameters(values.retract(delta)), abs=1e-12)
    assert variables.step(start, variables.moved(start, step)) == pytest.approx(step, abs=1e-12)
    frame = pose_of(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 0.6]))
    after = frame.retract(np.array([0, 0, 1e-3, 1e-3, 0, 0]))
    assert after.translation() - frame.translation() == pytest.approx(frame.rotation().matrix()[:, 0] * 1e-3, abs=1e-6)
    assert gtsam.Rot3.Logmap(frame.rotation().between(after.rotation())) == pytest.approx([0, 0, 1e-3], abs=1e-9)


def test_named_scalars_of_poses_follow_their_tangents_and_the_other_way_round():
    variables = build_variables(small_arm(estimate=[*TOOL, *BASE]), [True])
    x = variables.moved(variables.nominal(), 0.3 * np.random.default_rng(3).normal(size=variables.n_columns))
    order = np.concatenate([v.places for v in variables.items])
    still = np.zeros(variables.n_columns)
    D = variables.named_derivative(x)
    assert D == pytest.approx(central_differences(lambda s: variables.moved(x, s)[order], still), abs=1e-8)

    def step_to(off):
        y = x.copy()
        y[order] += off
        return variables.step(x, y)

    assert variables.tangent_derivative(x) == pytest.approx(central_differences(step_to, still), abs=1e-8)
    singular = pitched("tool", 90.0)
    assert np.isnan(build_variables(singular, [False]).named_derivative(singular.nominal)).any()
    # All six of the tool by the columns of five: the sixth is not estimated.
    some = build_variables(small_arm(estimate=[*TOOL[:5], *BASE]), [True])
    wide = variables.columns_of(some, x)
    chosen = [variables.names.index(name) for name in some.names]
    inside = [i for i, name in enumerate(some.names) if not name.startswith(("base", "frame"))]
    assert wide[:, inside] == pytest.approx(variables.tangent_derivative(x)[:, np.array(chosen)[inside]], abs=1e-12)
    poses = [i for i, name in enumerate(some.names) if name.startswith(("base", "frame"))]
    assert wide[:, poses] == pytest.approx(np.eye(variables.n_columns)[:, np.array(chosen)[poses]], abs=1e-12)


@pytest.mark.parametrize("frame", ["tool", "base"])
@pytest.mark.parametrize("pitch", [90.0, 20.0])
def test_priors_pull_to_nominal_along_axes_and_about_a_frames_own_axes(frame, pitch):
    of_frame = {"roll": 1e-3, "pitch": 2e-3, "yaw": 4e-3, "y": 5e-3}
    tolerance = {"a": 2e-3} | {f"{frame}.{k}": t for k, t in of_frame.items()}
    variables = build_variables(pitched(frame, pitch, tolerance), [True])
    indices, x = indices_of(variables.robot, frame), variables.nominal()
    first = 0 if frame == "base" else 4  # the frame's four priors come before or after those of a1 ... a4
    for axis, sigma in enumerate((1e-3, 2e-3, 4e-3)):
        x[indices] = rotated(variables.nominal(), indices, 0.5e-3 * np.eye(3)[axis])
        expected = np.zeros(8)  # y, then yaw, pitch, roll
        expected[first + 3 - axis] = 0.5e-3 / sigma
        assert prior_rows(variables, x)[0] == pytest.approx(expected, abs=1e-9)
    x = variables.nominal()
    x[[indices[1], indices[3], variables.robot.index("a2")]] += 0.01, 2.0 * np.pi, 4e-3
    expected = np.zeros(8)
    expected[[first, 5 - first]] = 2.0
    assert prior_rows(variables, x)[0] == pytest.approx(expected, abs=1e-9)
    n = variables.n_columns
    away = variables.moved(variables.nominal(), 0.5 * np.random.default_rng(1).normal(size=n))
    numeric = central_differences(lambda s: prior_rows(variables, variables.moved(away, s))[0], np.zeros(n))
    assert prior_rows(variables, away)[1] == pytest.approx(numeric, abs=1e-6 * np.abs(numeric).max())


def test_angles_of_a_frame_are_those_nearest_to_given_ones():
    rng = np.random.default_rng(2)
    for pitch in np.deg2rad([80.0, 89.9, 90.0 - 1e-6, 90.0, 91.0, -90.0, -120.0, 179.0]):
        near = np.array([0.1, 0.2, 0.3, rng.uniform(-3, 3), pitch, rng.uniform(-3, 3)])
        found = frame_of(pose_of(near), near)
        assert pose_of(found).matrix() == pytest.approx(pose_of(near).matrix(), abs=1e-8)
        if abs(np.cos(pitch)) < 1e-9 or abs(np.cos(pitch)) > 1e-3:
            assert found == pytest.approx(near, abs=1e-9)
    assert frame_of(pose_of(np.array([0, 0, 0, 0.3, 0.4, 0.5]))) == pytest.approx([0, 0, 0, 0.3, 0.4, 0.5])


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_a_correction_is_no_larger_than_twice_what_a_frame_was_rotated(frame):
    robot = pitched(frame, 90.0)
    values, indices = robot.nominal, indices_of(robot, frame)
    values[indices] = rotated(values, indices, [0.001, 0.002, -0.003])
    assert np.abs(values[indices] - robot.nominal[indices])[3:].max() > 0.1  # yaw and roll against each other
    assert corrections_of(robot, values)[indices] == pytest.approx([0, 0, 0, -0.003, 0.002, 0.001], abs=1e-9)
    upright = pitched(frame, 20.0)
    values = upright.nominal
    values[indices] += [0.01, 0.0, 0.0, 2.0 * np.pi + 1e-3, -2e-3, -4.0 * np.pi]
    assert corrections_of(upright, values)[indices] == pytest.approx([0.01, 0, 0, 1e-3, -2e-3, 0.0], abs=1e-12)


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_sigmas_of_the_arm_do_not_depend_on_the_pitch_of_a_frame(frame):
    """At 90 degrees yaw and roll have no sigma of their own; the gauge keeps the frame whole."""
    found = []
    for pitch in (85.0, 90.0, 95.0):
        robot, rng = pitched(frame, pitch), np.random.default_rng(4)
        q = rng.uniform(-2, 2, (40, robot.n_joints))
        m = measure(robot, 40, rng, sigma=(0.0, 0.0), readings=q)
        m = replace(m, sigma_position=np.full((40, 3), 1e-4), sigma_orientation=np.full((40, 3), 2e-4))
        solution = solve(build_problem(robot, m, model="pose"))
        estimates = assess(solution).estimates.parameters
        assert solution.converged
        found.append([p.sigma for p in estimates if "." not in p.name and p.sigma])
        sigma = {p.name: p.sigma for p in estimates if p.name.startswith(frame)}
        at_singular = pitch == 90.0
        assert (sigma[f"{frame}.yaw"] is None, sigma[f"{frame}.roll"] is None) == (at_singular, at_singular)
        assert 1e-5 < sigma[f"{frame}.pitch"] < 3e-3
        kept = build_problem(robot.with_estimated(TOOL if frame == "tool" else BASE), m, model="pose", gauge="keep")
        assert [v.symbol for v in kept.variables.items] == ["T(0)" if frame == "tool" else "B(0)"]
    assert np.array(found) == pytest.approx(np.array([found[0]] * 3), rel=1e-5)


def test_a_factors_wrong_shape_or_number_is_an_error_and_not_the_end_of_the_interpreter():
    variables = build_variables(small_arm(), [False])
    values, n = variables.values(variables.nominal()), variables.n_columns
    cases = {
        "shapes": lambda _: (np.zeros(2), np.zeros((3, n))),
        "not finite": lambda _: (np.zeros(3), np.full((3, n), np.nan)),
    }
    for word, linearise in cases.items():
        with pytest.raises(SolverError, match=word):
            CheckedFactor(variables.items, 3, linearise).linearize(values)
    with pytest.raises(SolverError, match="shapes"):
        CheckedFactor(variables.items, 3, cases["shapes"]).error(values)


def test_a_board_and_a_base_of_six_unknowns_are_two_variables():
    """Both have the letter B; only the priors say which of them moved."""
    from instruments import measured_by

    robot, _, table = measured_by("board", np.random.default_rng(3))
    names = [*(p.name for p in robot.parameters if p.estimated), *BASE]
    problem = build_problem(robot.with_estimated(names), table)
    assert {"B(0)", "B(1)"} <= {v.symbol for v in (*problem.variables.items, *problem.variables.nuisance)}
    assert solve(problem).converged
