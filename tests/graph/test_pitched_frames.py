"""Tool and base pitched by 80 to 100 degrees: nothing but their own yaw and roll depends on how they stand.

A frame's priors act on its turn from nominal about its own axes. With the same tolerance about each of them, and the
same noise, a job whose frame stands otherwise is the same job seen from another side: same cost, same arm.
"""

import json
import warnings

import gtsam
import numpy as np
import pytest
from oracle import central_differences
from reported import format_report
from scipy.spatial.transform import Rotation
from simulated import TOOL, small_arm
from sparing import diagonal

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.graph.variables import build_variables, corrections_of, frame_of, pose_of, prior_rows
from fg_calib.io.columns import write_csv
from fg_calib.io.robot_file import write_robot
from fg_calib.measurements.dataset import Measurements
from fg_calib.observability.identifiability import observe_structure
from fg_calib.robot.kinematics import pose

BASE = [name.replace("tool", "base") for name in TOOL]
TOLERANCE = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3, "tool": 5e-3, "base": 5e-3}
TOLERANCE |= {f"{frame}.{k}": 3e-3 for frame in ("tool", "base") for k in ("roll", "pitch", "yaw")}
PITCHES = [80.0, 85.0, 89.0, 89.9, 90.0 - 1e-6, 90.0, 90.0 + 1e-6, 90.1, 91.0, 95.0, 100.0]


def pitched(frame, pitch, tolerance=TOLERANCE):
    """The small arm with a frame of six unknowns, pitched by so many degrees."""
    robot = small_arm(tolerance=tolerance, estimate=TOOL if frame == "tool" else BASE)
    values = robot.nominal
    values[[robot.index(f"{frame}.{k}") for k in ("x", "y", "z", "yaw", "pitch", "roll")]] = (
        *(0.05, 0.03, 0.1),
        *(0.4, np.deg2rad(pitch), 0.2),
    )
    return robot.with_values(values)


def nominal_frame(robot, frame):
    indices = [robot.index(f"{frame}.{k}") for k in ("x", "y", "z", "yaw", "pitch", "roll")]
    return indices, Rotation.from_matrix(pose_of(robot.nominal[indices]).rotation().matrix())


def measured(robot, frame, noise):
    """Poses of an arm whose errors, and their noise, are the same whatever the pitch, as seen from the arm."""
    rng = np.random.default_rng(4)
    indices, nominal = nominal_frame(robot, frame)
    error = np.array([0.0 if p.tolerance is None or not p.estimated else p.tolerance for p in robot.parameters])
    error *= rng.normal(size=len(error))
    turn, shift = Rotation.from_rotvec(3e-3 * rng.normal(size=3)), 5e-3 * rng.normal(size=3)
    values = robot.nominal + error
    if frame == "tool":  # turn and shift in the last joint's frame
        true = turn * nominal
    else:  # in the arm's first frame
        true, shift = nominal * turn, nominal.apply(shift)
    values[indices[:3]] = robot.nominal[indices[:3]] + shift
    T = gtsam.Pose3(gtsam.Rot3(true.as_matrix()), values[indices[:3]])
    values[indices] = frame_of(T)
    q = rng.uniform(-2, 2, (40, robot.n_joints))
    at = pose(robot.with_values(values), q)
    sigma = (1e-4, 2e-4)
    of_position, of_orientation = (noise * s * rng.normal(size=(40, 3)) for s in sigma)
    if frame == "tool":
        of_orientation = nominal.inv().apply(of_orientation)
    else:
        of_position = nominal.apply(of_position)
    return Measurements(
        readings=q,
        ids=np.arange(40).astype(str),
        test=np.zeros(40, bool),
        position=at.position + of_position,
        rotation=(Rotation.from_matrix(at.rotation) * Rotation.from_rotvec(of_orientation)).as_matrix(),
        sigma_position=np.full((40, 3), sigma[0]),
        sigma_orientation=np.full((40, 3), sigma[1]),
        sigma_joint=np.zeros(robot.n_joints),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("frame", "noise"), diagonal(["tool", "base"], [1.0, 0.0]))
def test_cost_and_the_arm_do_not_depend_on_the_pitch_of_a_frame(frame, noise):
    costs, arms, sigmas = [], [], []
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for pitch in PITCHES:
            robot = pitched(frame, pitch)
            solution = solve(build_problem(robot, measured(robot, frame, noise), model="pose"))
            assert solution.converged
            found = assess(solution)
            costs.append(solution.cost)
            arm = [p for p in found.estimates.parameters if "." not in p.name]
            arms.append([p.correction for p in arm])
            sigmas.append([p.sigma for p in arm])
            angles = [p for p in found.estimates.parameters if p.name.startswith(frame) and p.unit == "rad"]
            assert all(p.sigma is None or 1e-6 < p.sigma < 1.0 for p in angles)
            assert all(abs(p.correction) < 0.03 for p in angles)  # ten times what the frame turned
    # the optimum is found to 1e-5 sigma; the linear covariance is the same but for rounding of its decomposition
    assert costs == pytest.approx([costs[0]] * len(PITCHES), rel=1e-8)
    assert np.abs(np.array(arms) - arms[0]).max() < 1e-4 * np.min(sigmas)
    assert np.array(sigmas) == pytest.approx(np.array([sigmas[0]] * len(PITCHES)), rel=1e-6)


def test_yaw_and_roll_have_no_sigma_at_a_quarter_turn_of_pitch(tmp_path, fg_calib):
    robot = pitched("tool", 90.0)
    m = measured(robot, "tool", 0.0)
    exact = pose(robot, m.readings)
    write_robot(tmp_path / "robot.yaml", robot)
    columns = {f"q{i + 1}": m.readings[:, i] for i in range(robot.n_joints)}
    columns |= dict(zip("xyz", exact.position.T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(exact.rotation).as_quat().T, strict=True))
    write_csv(tmp_path / "poses.csv", columns)
    (tmp_path / "job.yaml").write_text(
        "robot: robot.yaml\nmeasurements: poses.csv\nmodel: pose\nnoise: {position: 0.0001, orientation: 0.0002}\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        ended = fg_calib("calibrate", tmp_path / "job.yaml", "--json")
    by_name = {p["name"]: p for p in json.loads(ended.out)["parameters"]}
    assert by_name["tool.yaw"]["sigma"] is None
    assert by_name["tool.roll"]["sigma"] is None
    assert 1e-5 < by_name["tool.pitch"]["sigma"] < 3e-3
    assert all(abs(p["correction"]) < 1e-6 for p in by_name.values())  # the data are exact


@pytest.mark.slow
def test_the_report_says_where_corrections_are_turns():
    robot = pitched("tool", 90.0)
    solution = solve(build_problem(robot, measured(robot, "tool", 1.0), model="pose"))
    note = "tool is pitched near a quarter turn: corrections of its angles are its turn about its own axes"
    assert note in format_report(solution, assess(solution))
    upright = pitched("tool", 20.0)
    solution = solve(build_problem(upright, measured(upright, "tool", 1.0), model="pose"))
    assert "quarter turn" not in format_report(solution, assess(solution))


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_priors_of_a_pose_act_about_its_own_axes(frame):
    tolerance = {
        f"{frame}.{k}": t for k, t in zip(("roll", "pitch", "yaw", "y"), (1e-3, 2e-3, 4e-3, 5e-3), strict=True)
    }
    robot = pitched(frame, 90.0, tolerance)
    variables = build_variables(robot, [False])
    indices, nominal = nominal_frame(robot, frame)
    parameters = variables.nominal()
    for axis, tolerance_of_axis in enumerate((1e-3, 2e-3, 4e-3)):
        turned = nominal * Rotation.from_rotvec(0.5e-3 * np.eye(3)[axis])
        parameters[indices] = frame_of(gtsam.Pose3(gtsam.Rot3(turned.as_matrix()), parameters[indices][:3]))
        r, _ = prior_rows(variables, parameters)
        expected = np.zeros(4)  # y, then yaw, pitch, roll
        expected[3 - axis] = 0.5e-3 / tolerance_of_axis
        assert r == pytest.approx(expected, abs=1e-9)
    parameters[indices[1]] += 0.01
    assert prior_rows(variables, parameters)[0][0] == pytest.approx(2.0)


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_derivatives_of_priors_are_those_along_the_retraction(frame):
    variables = build_variables(pitched(frame, 90.0), [False])
    rng = np.random.default_rng(1)
    away = variables.moved(variables.nominal(), 0.5 * rng.normal(size=variables.n_columns))

    def residual(step):
        return prior_rows(variables, variables.moved(away, step))[0]

    numeric = central_differences(residual, np.zeros(variables.n_columns))
    assert prior_rows(variables, away)[1] == pytest.approx(numeric, abs=1e-6 * np.abs(numeric).max())


def test_angles_of_a_pose_are_those_nearest_to_given_ones():
    rng = np.random.default_rng(2)
    for pitch in np.deg2rad([*PITCHES, -90.0, -120.0, 179.0]):
        near = np.array([0.1, 0.2, 0.3, rng.uniform(-3, 3), pitch, rng.uniform(-3, 3)])
        T = pose_of(near)
        found = frame_of(T, near)
        assert pose_of(found).matrix() == pytest.approx(T.matrix(), abs=1e-8)  # of a quarter turn the rest is dropped
        if abs(np.cos(pitch)) < 1e-9 or abs(np.cos(pitch)) > 1e-3:
            assert found == pytest.approx(near, abs=1e-9)
    assert frame_of(pose_of(np.array([0, 0, 0, 0.3, 0.4, 0.5]))) == pytest.approx([0, 0, 0, 0.3, 0.4, 0.5])


def test_a_correction_is_no_larger_than_twice_what_a_frame_turned():
    robot = pitched("tool", 90.0)
    indices, nominal = nominal_frame(robot, "tool")
    turned = nominal * Rotation.from_rotvec([0.001, 0.002, -0.003])
    values = robot.nominal
    values[indices] = frame_of(gtsam.Pose3(gtsam.Rot3(turned.as_matrix()), values[indices][:3]), values[indices])
    assert np.abs(values[indices] - robot.nominal[indices])[3:].max() > 0.1  # yaw and roll against each other
    assert corrections_of(robot, values)[indices] == pytest.approx([0, 0, 0, -0.003, 0.002, 0.001], abs=1e-9)


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_yaw_and_roll_are_relative_at_a_quarter_turn_of_pitch(frame):
    names = TOOL if frame == "tool" else BASE
    known = observe_structure(pitched(frame, 90.0).with_estimated(names), "pose").with_fixed_known
    assert known.observability.rank == 5
    assert [set(g.parameters) for g in known.observability.relative] == [{f"{frame}.yaw", f"{frame}.roll"}]
    assert [lost.reason for lost in known.lost] == ["only their sum turns about the same axis"]
    apart = observe_structure(pitched(frame, 60.0).with_estimated(names), "pose").with_fixed_known
    assert apart.observability.rank == 6


@pytest.mark.slow
def test_a_pitched_tool_is_kept_whole():
    """Yaw and roll turn it about one axis only: left to them and pitch it could not turn about the third."""
    robot = pitched("tool", 90.0).with_estimated(TOOL)
    solution = solve(build_problem(robot, measured(pitched("tool", 90.0), "tool", 0.0), model="pose", gauge="keep"))
    assert [v.symbol for v in solution.problem.variables.items] == ["T(0)"]
    assert assess(solution).spread.rank == 6
