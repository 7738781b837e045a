"""The simulation: its truth against 4x4 products, its noise by statistics, its camera by geometry, its job by running.

Noise bounds: an empirical sigma of n normal numbers has a relative sigma of 1 / sqrt(2 n); five of them are allowed.
"""

import re
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from exported import TREE, matrix
from oracle import tool_poses
from scipy.spatial import SphericalVoronoi
from scipy.spatial.transform import Rotation
from simulated import planar_robot
from tolerances import rounding

from fg_calib import InputError, Noise, Robot, Scenario, read_job, simulate
from fg_calib.simulation import Box, Errors, GivenReadings, Placement, RandomReadings, read_scenario, write_simulation
from fg_calib.simulation.scenario import BoardViews
from fg_calib.simulation.views import view_board

FILES = ("calibration.yaml", "poses.csv", "robot_nominal.yaml", "robot_true.yaml")
BOARD = np.array([0.0, 6.5, 2.55])
PLACE = Placement(np.eye(3), BOARD)
TILTED = Placement(Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix(), BOARD)


@pytest.fixture(scope="module")
def shipped():
    return read_scenario("space-robot")


@pytest.fixture(scope="module")
def simulation(shipped):
    return simulate(shipped, 0)


def measured(simulation):
    """The true poses in the measurement frame by 4x4 products, and how the measured ones differ: position, rotation
    vector about the tool's axes."""
    world_T_base = matrix(simulation.frame.rotation, simulation.frame.position)
    T = world_T_base @ tool_poses(simulation.true_robot, simulation.true_readings)
    m = simulation.measurements
    turned = np.swapaxes(T[:, :3, :3], 1, 2) @ m.rotation
    return T, m.position - T[:, :3, 3], Rotation.from_matrix(turned).as_rotvec()


# --- noise ------------------------------------------------------------------------------------------------------------


def test_encoder_noise_moves_the_arm_and_the_table_holds_the_reading(shipped):
    """With encoder noise alone the measured pose is exactly where the noise took the arm, not where the table says."""
    noise = Noise(0.0, 0.0, tuple(0.01 * (i + 1) for i in range(7)))
    noisy = replace(shipped, noise=noise, specified_noise=Noise(1e-3, 1e-4))
    s, still = simulate(noisy, 2), simulate(noisy, 2, exact=True)
    assert s.measurements.readings.tolist() == still.measurements.readings.tolist() == still.true_readings.tolist()
    _, position, turn = measured(s)
    assert max(np.abs(position).max(), np.abs(turn).max()) < rounding(10.0)
    moved = s.true_readings - s.measurements.readings
    assert moved.std(axis=0) == pytest.approx(noise.joint, rel=5 / sqrt(2 * len(moved)))
    assert np.linalg.norm(s.measurements.position - still.measurements.position, axis=1).min() > 1e-4


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("law", "variance"), [("uniform", 1 / 3), ("normal", 1.0)])
def test_drawn_errors_have_their_size_and_spare_fixed_parameters(shipped, law, variance):
    """Mean and variance, each to five of its own sigma; uniform errors are within their bounds."""
    estimated = np.array([p.estimated for p in shipped.robot.parameters])
    bound = np.array([shipped.errors.values.get(p.name, 0.0) for p in shipped.robot.parameters])
    errors = Errors(law, shipped.errors.values)
    small = replace(shipped, configurations=RandomReadings(1), validation=None, errors=errors)
    errors = np.array([simulate(small, seed).true_robot.nominal - shipped.robot.nominal for seed in range(20)])
    assert (errors[:, ~estimated] == 0.0).all()
    scaled = errors[:, estimated] / bound[estimated]
    assert law == "normal" or np.abs(scaled).max() <= 1.0 + rounding(10)
    assert abs(scaled.mean()) < 5 * sqrt(variance / scaled.size)
    assert scaled.var() == pytest.approx(variance, rel=5 * sqrt(2 / scaled.size))


# --- configurations ---------------------------------------------------------------------------------------------------


def test_the_camera_looks_at_the_centre_from_a_and_from_the_half_sphere(simulation):
    """At the nominal robot, by 4x4 products, to 1e-9; and within the limits."""
    q, test = np.split(simulation.measurements.readings, [52])
    T = tool_poses(simulation.robot, q)
    p, z, A = T[:, :3, 3], T[:, :3, 2], np.array([0.0, 6.5, 3.05])
    assert p[0] == pytest.approx(A, abs=rounding(1, 10))
    assert np.linalg.norm(p[1:] - A, axis=1) == pytest.approx(0.5, abs=rounding(1, 1e3))
    assert (p[1:, 2] > A[2]).all()
    assert np.abs(np.cross(z, BOARD - p)).max() < 1e-9
    assert (np.sum(z * (BOARD - p), axis=1) > 0).all()
    assert test.shape == (500, 7)
    assert np.abs(q).max() <= np.pi


def test_the_half_sphere_is_covered_evenly():
    """Every point with its mirror image below owns its part of the whole sphere, by Voronoi cells."""
    _, p = view_board(BoardViews(TILTED, 51), np.random.default_rng(0))
    assert p[0] == pytest.approx(BOARD + 0.5 * TILTED.rotation[:, 2])
    unit = (p[1:] - p[0]) @ TILTED.rotation / 0.5
    cells = SphericalVoronoi(np.concatenate([unit, unit * [1, 1, -1]])).calculate_areas()[:51]
    assert cells.sum() == pytest.approx(2 * np.pi)
    assert cells.std() < 0.15 * cells.mean()  # random points have cells with half of the mean as spread
    assert cells.max() < 1.6 * cells.mean()
    assert unit[:, 2].mean() == pytest.approx(0.5, abs=0.01)  # as of the whole half sphere, down to its rim


def test_a_roll_is_held_or_drawn():
    """Held at 0 the camera's x axis at A is the board's; at other views the shortest rotation takes it there."""
    zero, quarter, drawn = (view_board(BoardViews(TILTED, 2000, roll=roll), np.random.default_rng(0))[0]
                            for roll in (0.0, np.pi / 2, None))  # fmt: skip
    assert zero[0][:, 0] == pytest.approx(TILTED.rotation[:, 0])
    turned = Rotation.from_matrix(zero[1:30] @ zero[0].T).magnitude()
    assert turned == pytest.approx(np.arccos(zero[1:30, :, 2] @ zero[0][:, 2]), abs=1e-7)
    assert quarter[:, :, 0] == pytest.approx(zero[:, :, 1])
    roll = np.arctan2(np.sum(drawn[:, :, 0] * zero[:, :, 1], 1), np.sum(drawn[:, :, 0] * zero[:, :, 0], 1))
    assert np.histogram(roll, 4, (-np.pi, np.pi))[0] == pytest.approx(500, abs=5 * sqrt(375))  # binomial


def test_configurations_that_are_not_to_be_had_are_reported(shipped):
    everywhere = (Box([-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]),)
    rows = GivenReadings(np.zeros((2, 7)), keep_out=everywhere)
    hint = "ask for fewer, or relax their conditions"
    for of, message in (
        (replace(shipped, configurations=RandomReadings(2, keep_out=everywhere)),
         f"configurations: 0 of 2 found in 40 drawn: 100 % in keep_out; {hint}"),
        (replace(shipped, configurations=RandomReadings(2), validation=rows),
         f"validation: 0 of 2 found in 2 drawn: 100 % in keep_out; {hint}"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^space-robot: {message}$"):
            simulate(of)


# --- seeds ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["uniform", "normal"])
def test_every_parameter_draws_its_error_by_name(law):
    """Adding a parameter, or estimating another one, leaves the errors of the others as they are."""
    robot = planar_robot(tolerance={"a": 0.01, "theta": 0.02})
    more = replace(robot, parameters=tuple(replace(p, estimated=True) for p in robot.parameters))
    longer = Robot.from_dh([[0.5, 0.0, 0.0, 0.0]] * 3, convention="dh", tolerance={"a": 0.01, "theta": 0.02})
    sizes = Errors(law, {"a": 0.01, "theta": 0.02, "tool": 0.1})
    noise = Noise(1e-3, 1e-3)
    drawn = [simulate(Scenario(r, sizes, RandomReadings(1), noise), 5).true_robot for r in (robot, more, longer)]
    names = [p.name for p in robot.parameters if p.estimated]
    first, *others = [[(true.nominal - one.nominal)[one.index(name)] for name in names]
                      for true, one in zip(drawn, (robot, more, longer), strict=True)]  # fmt: skip
    assert np.array(others) == pytest.approx(np.stack([first] * 2), rel=rounding(1.0, 1e3))
    assert len(set(np.abs(first).round(12)) - {0.0}) == len(names)


def test_what_is_changed_leaves_the_other_draws_alone(shipped):
    few = replace(shipped, configurations=RandomReadings(20), validation=RandomReadings(10))
    s = simulate(few)
    noisier = simulate(replace(few, noise=Noise(2e-3, 1e-3, 1e-4)))
    untested = simulate(replace(few, validation=None, frame="base"))
    moved = simulate(replace(few, configurations=RandomReadings(5)))
    drawn = [of.true_robot.nominal.tolist() for of in (s, noisier, untested, moved, simulate(few, 1))]
    assert drawn[1:4] == drawn[:3]
    assert drawn[4] != drawn[0]
    assert noisier.measurements.readings.tolist() == s.measurements.readings.tolist()
    assert noisier.frame.position.tolist() == s.frame.position.tolist()
    assert measured(noisier)[1] == pytest.approx(2 * measured(s)[1], abs=rounding(10.0))
    assert untested.true_readings.tolist() == s.true_readings[:20].tolist()
    # The same noise along the axes of either frame, and about those of the tool: not about the frame's.
    for noise, same in zip(measured(untested)[1:], measured(s)[1:], strict=True):
        assert noise == pytest.approx(same[:20], abs=rounding(10.0))
    assert moved.measurements.readings[5:].tolist() == s.measurements.readings[20:].tolist()


# --- files and the command --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_a_job_that_runs(fg_calib, tmp_path):
    out = tmp_path / "deep" / "demo"
    ended = fg_calib("simulate", "space-robot", "--seed", 1, "--out", out)
    assert (ended.code, ended.out) == (0, "space-robot, seed 1: 52 configurations to calibrate, 500 to test\n")
    assert ended.err.startswith(f"wrote {', '.join(FILES)} to {out}\nnow: fg-calib calibrate ")
    assert sorted(file.name for file in out.iterdir()) == list(FILES)
    assert re.sub("; [0-9a-f]{16}", "", (out / "calibration.yaml").read_text()) == (
        "# fg-calib simulate space-robot --seed 1\nrobot: robot_nominal.yaml\ntruth: robot_true.yaml\n"
        "measurements: poses.csv\nmodel: distance-rotation\npairing: star\nframe: unknown\n"
        "units: {length: m, angle: deg}\nnoise: {position: 0.001, orientation: 0.01, joint: 0.005}\n"
    )
    assert fg_calib("calibrate", out / "calibration.yaml", "--out", out / "result").code == 0


def test_a_urdf_robot_is_written_with_its_urdf_and_given_errors_reach_fixed_parameters(tmp_path):
    (tmp_path / "arm.urdf").write_text(TREE)
    (tmp_path / "s.yaml").write_text(
        "robot: {urdf: arm.urdf, tip_link: tip, estimate: [tool.z]}\nerrors: {values: {tool.z: 0.01, base.x: 0.02}}\n"
        "configurations: {random: {count: 9}}\nnoise: {position: 0.001, orientation: 0.001, "
        "joint: [0.01, 0.002, 0, 0, 0]}\n"
    )
    s = simulate(read_scenario(tmp_path / "s.yaml"))
    names = write_simulation(tmp_path / "job", s)
    assert names == (*FILES[:2], "robot_nominal.urdf", "robot_nominal.yaml", "robot_true.urdf", "robot_true.yaml")
    job = read_job(tmp_path / "job" / "calibration.yaml")
    assert job.truth.nominal == pytest.approx(s.true_robot.nominal, abs=rounding(10.0))
    assert job.tables[0].measurements.sigma_joint == pytest.approx([0.01, 0.002, 0, 0, 0])
    errors = s.true_robot.nominal - s.robot.nominal
    assert [errors[s.robot.index(name)] for name in ("tool.z", "base.x")] == pytest.approx([0.01, 0.02])


def test_a_scenario_that_makes_no_sense_is_one_line(shipped):
    with pytest.raises(InputError, match=r"^space-robot: errors: uniform: unknown parameter or kind 'b', expected one"):
        simulate(replace(shipped, errors=Errors("uniform", {"b": 1.0})))
    with pytest.raises(InputError, match=r"poses: noise: orientation: found none, expected 1 sigma, for model pose$"):
        simulate(replace(shipped, noise=Noise(1e-3, None)))
    missed = r"1 of 1 views not reached within the joint limits: the nearest one is missed by [\d.]+ m"
    with pytest.raises(InputError, match=f"^scenario: configurations: board: {missed}"):
        simulate(Scenario(planar_robot(), Errors("values", {}), BoardViews(PLACE, 0), Noise(1e-3, 1e-3)))
