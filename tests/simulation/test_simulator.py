"""The simulation: its truth against 4x4 products, its noise by statistics, its camera by geometry, its job by running.

Noise bounds: an empirical sigma of n normal numbers has a relative sigma of 1 / sqrt(2 n); five of them are allowed.
"""

import json
import re
from dataclasses import replace
from math import sqrt

import numpy as np
import polars as pl
import pytest
from oracle import random_robot, tool_pose
from scipy.spatial import SphericalVoronoi
from scipy.spatial.transform import Rotation
from simulated import paper_robot, planar_robot
from sparing import diagonal
from tolerances import rounding

import fg_calib
from fg_calib.cli import EXAMPLES
from fg_calib.errors import InputError
from fg_calib.io.job import read_job
from fg_calib.io.robot_file import read_robot
from fg_calib.measurements.dataset import Noise
from fg_calib.robot.shape import Box, enters
from fg_calib.simulation.configurations import BoardViews, GivenReadings, Placement, RandomReadings, TargetViews
from fg_calib.simulation.measure import FARTHEST_BASE
from fg_calib.simulation.scenario import Errors, Scenario
from fg_calib.simulation.scenario_file import SCENARIOS, read_scenario
from fg_calib.simulation.simulator import simulate
from fg_calib.simulation.views import view_board
from fg_calib.simulation.write import write_simulation

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


def poses_of(robot, q):
    """base_T_tool of each row, shape (n, 4, 4), by the oracle."""
    return np.stack([tool_pose(robot, row) for row in q])


def measured(simulation):
    """The true poses in the measurement frame by 4x4 products, and how the measured ones differ: position, rotation
    vector about the tool's axes."""
    world_T_base = np.eye(4)
    world_T_base[:3, :3], world_T_base[:3, 3] = simulation.frame.rotation, simulation.frame.position
    T = world_T_base @ poses_of(simulation.true_robot, simulation.true_readings)
    m = simulation.measurements
    turned = np.swapaxes(T[:, :3, :3], 1, 2) @ m.rotation
    return T, m.position - T[:, :3, 3], Rotation.from_matrix(turned).as_rotvec()


def exact(scenario):
    """The scenario without noise; the calibration is told some."""
    return replace(scenario, noise=Noise(0.0, 0.0), stated_noise=Noise(1e-3, 1e-4))


# --- truth ------------------------------------------------------------------------------------------------------------


def test_measured_poses_without_noise_are_products_of_4x4_matrices(shipped):
    s = simulate(exact(shipped), 3)
    _, position, turn = measured(s)
    assert np.abs(position).max() < rounding(10.0)  # a dozen products of lengths up to 15 m
    assert np.abs(turn).max() < rounding(10.0)
    assert s.true_readings.tolist() == s.measurements.readings.tolist()


@pytest.mark.parametrize("convention", ["dh", "dh-hayati", "mdh", "urdf"])
def test_any_robot_is_simulated(convention):
    robot = random_robot(convention, 5, np.random.default_rng(1))
    scenario = Scenario(
        robot=robot,
        errors=Errors("values", {p.name: 0.01 * i for i, p in enumerate(robot.parameters)}),
        configurations=RandomReadings(10),
        noise=Noise(0.0, 0.0),
        stated_noise=Noise(1.0, 1.0),
    )
    s = simulate(scenario)
    _, position, turn = measured(s)
    assert np.abs(position).max() < rounding(10.0)
    assert np.abs(turn).max() < rounding(10.0)
    assert s.true_robot.nominal - robot.nominal == pytest.approx(0.01 * np.arange(len(robot.parameters)))


@pytest.mark.slow
def test_written_poses_follow_from_the_written_true_robot(simulation, tmp_path):
    """From the files alone: what is left is the noise that calibration.yaml states, encoders included."""
    write_simulation(tmp_path / "job", simulation)
    job = read_job(tmp_path / "job" / "calibration.yaml")
    m = job.measurements
    assert job.truth.nominal == pytest.approx(simulation.true_robot.nominal, abs=rounding(1.0))
    world_T_base = np.eye(4)
    world_T_base[:3, :3], world_T_base[:3, 3] = simulation.frame.rotation, simulation.frame.position
    predicted = (world_T_base @ poses_of(job.truth, m.readings))[:, :3, 3]
    arm = 12.0 * np.deg2rad(0.005) * sqrt(7)  # every joint with its noise at the longest lever
    assert 1e-3 < np.sqrt(np.mean((m.position - predicted) ** 2)) < sqrt(1e-6 + arm**2)
    assert m.position == pytest.approx(simulation.measurements.position, rel=rounding())
    assert m.rotation == pytest.approx(simulation.measurements.rotation, abs=rounding(1.0))
    assert m.readings == pytest.approx(simulation.measurements.readings, rel=rounding())
    assert m.test.tolist() == simulation.measurements.test.tolist()
    assert m.sigma_position == pytest.approx(simulation.measurements.sigma_position)
    assert m.sigma_orientation == pytest.approx(simulation.measurements.sigma_orientation)
    assert m.sigma_joint == pytest.approx(simulation.measurements.sigma_joint)


# --- noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_has_its_sigma_along_every_axis(shipped, seed):
    n = 1500
    s = simulate(replace(shipped, configurations=RandomReadings(n), validation=None), seed)
    _, position, turn = measured(s)
    joint = s.true_readings - s.measurements.readings
    for noise, sigma in ((position, 1e-3), (turn, np.deg2rad(0.01)), (joint, np.deg2rad(0.005))):
        assert noise.std(axis=0) == pytest.approx(sigma, rel=5 / sqrt(2 * n))
        assert np.abs(noise.mean(axis=0)).max() < 5 * sigma / sqrt(n)
    everything = np.concatenate([position, turn, joint], axis=1)
    correlation = np.corrcoef(everything.T) - np.eye(everything.shape[1])
    assert np.abs(correlation).max() < 5 / sqrt(n)


def test_encoder_noise_moves_the_arm_and_the_table_holds_the_reading(shipped):
    """With encoder noise alone the measured pose is exactly where the noise took the arm, not where the table says."""
    noise = Noise(0.0, 0.0, tuple(0.01 * (i + 1) for i in range(7)))
    s = simulate(replace(shipped, noise=noise, stated_noise=Noise(1e-3, 1e-4)), 2)
    still = simulate(exact(shipped), 2)
    assert s.measurements.readings.tolist() == still.measurements.readings.tolist()
    _, position, turn = measured(s)
    assert max(np.abs(position).max(), np.abs(turn).max()) < rounding(10.0)
    moved = s.true_readings - s.measurements.readings
    n = len(moved)
    assert moved.std(axis=0) == pytest.approx(noise.joint, rel=5 / sqrt(2 * n))
    assert np.linalg.norm(s.measurements.position - still.measurements.position, axis=1).min() > 1e-4


def test_another_noise_may_be_stated(shipped):
    s = simulate(replace(shipped, stated_noise=Noise(0.5, 0.25, 0.125)))
    assert np.unique(s.measurements.sigma_position).tolist() == [0.5]
    assert np.unique(s.measurements.sigma_orientation).tolist() == [0.25]
    assert s.measurements.sigma_joint.tolist() == [0.125] * 7
    assert s.measurements.position.tolist() == simulate(shipped).measurements.position.tolist()


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_uniform_errors_fill_their_bounds_and_spare_fixed_parameters(shipped):
    small = replace(shipped, configurations=RandomReadings(1), validation=None)
    errors = np.array([simulate(small, seed).true_robot.nominal - shipped.robot.nominal for seed in range(300)])
    bound = np.array([shipped.errors.figures.get(p.name, 0.0) for p in shipped.robot.parameters])
    estimated = np.array([p.estimated for p in shipped.robot.parameters])
    assert (errors[:, ~estimated] == 0.0).all()
    scaled = errors[:, estimated] / bound[estimated]
    assert np.abs(scaled).max() <= 1.0 + rounding(10)
    # Mean and variance of 9000 uniform numbers: sigmas 1 / sqrt(3 n) and 2 / sqrt(45 n).
    n = scaled.size
    assert abs(scaled.mean()) < 5 / sqrt(3 * n)
    assert scaled.var() == pytest.approx(1 / 3, abs=5 * 2 / sqrt(45 * n))
    assert np.ptp(scaled, axis=0).min() > 1.8  # every one on its own


@pytest.mark.slow
def test_normal_errors_have_their_sigma(shipped):
    small = replace(shipped, configurations=RandomReadings(1), validation=None, errors=Errors("normal", {"a": 0.01}))
    errors = np.array([simulate(small, seed).true_robot.nominal - shipped.robot.nominal for seed in range(300)])
    lengths = np.array([p.kind == "a" and p.estimated for p in shipped.robot.parameters])
    assert (errors[:, ~lengths] == 0.0).all()
    assert errors[:, lengths].std() == pytest.approx(0.01, rel=5 / sqrt(2 * 300 * 6))


def test_given_errors_reach_fixed_parameters_too(shipped):
    s = simulate(replace(shipped, errors=Errors("values", {"a2": 0.003, "alpha": -0.001, "alpha3": 0.002, "a1": 1.0})))
    errors = dict(zip([p.name for p in s.robot.parameters], s.true_robot.nominal - s.robot.nominal, strict=True))
    assert errors["a2"] == pytest.approx(0.003)
    assert errors["a1"] == 1.0
    assert [errors[f"alpha{i}"] for i in (1, 2, 3)] == pytest.approx([-0.001, -0.001, 0.002])
    assert s.true_robot.parameters[6].estimated == s.robot.parameters[6].estimated


# --- configurations ---------------------------------------------------------------------------------------------------


def test_the_camera_looks_at_the_centre_from_a_and_from_the_half_sphere(simulation):
    """At the nominal robot, by 4x4 products, to 1e-9; and within the limits."""
    q = simulation.measurements.readings[:52]
    T = poses_of(simulation.robot, q)
    p, z = T[:, :3, 3], T[:, :3, 2]
    A = np.array([0.0, 6.5, 3.05])
    assert p[0] == pytest.approx(A, abs=rounding(1, 10))
    assert np.linalg.norm(p[1:] - A, axis=1) == pytest.approx(0.5, abs=rounding(1, 1e3))
    assert (p[1:, 2] > A[2]).all()
    away = BOARD - p
    assert np.abs(np.cross(z, away)).max() < 1e-9
    assert (np.sum(z * away, axis=1) > 0).all()
    assert np.abs(q).max() <= np.pi
    test = simulation.measurements.readings[52:]
    assert test.shape == (500, 7)
    assert 0.99 * np.pi < np.abs(test).max() <= np.pi


def test_the_half_sphere_is_covered_evenly():
    """Every point with its mirror image below owns its part of the whole sphere, by Voronoi cells."""
    _, p = view_board(BoardViews(PLACE, 51), np.random.default_rng(0))
    unit = (p[1:] - p[0]) / 0.5
    cells = SphericalVoronoi(np.concatenate([unit, unit * [1, 1, -1]])).calculate_areas()[:51]
    assert cells.sum() == pytest.approx(2 * np.pi)
    assert cells.std() < 0.15 * cells.mean()  # random points have cells with half of the mean as spread
    assert cells.max() < 1.6 * cells.mean()
    assert unit[:, 2].mean() == pytest.approx(0.5, abs=0.01)  # as of the whole half sphere, down to its rim


def test_a_tilted_board_is_seen_from_its_own_side():
    R, p = view_board(BoardViews(TILTED, 20, height=0.7, radius=0.3), np.random.default_rng(0))
    normal = TILTED.rotation[:, 2]
    assert p[0] == pytest.approx(BOARD + 0.7 * normal)
    assert ((p[1:] - p[0]) @ normal > 0).all()
    assert np.abs(np.cross(R[:, :, 2], BOARD - p)).max() < rounding(10.0)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_roll_is_held_or_drawn():
    """Held at 0 the camera's x axis at A is the board's, and elsewhere the shortest turn takes it there."""
    R, _ = view_board(BoardViews(TILTED, 30, roll=0.0), np.random.default_rng(0))
    assert R[0][:, 0] == pytest.approx(TILTED.rotation[:, 0])
    for i in range(1, 31):
        turn = Rotation.from_matrix(R[i] @ R[0].T).magnitude()
        assert turn == pytest.approx(np.arccos(R[i][:, 2] @ R[0][:, 2]), abs=1e-7)
    quarter, _ = view_board(BoardViews(TILTED, 30, roll=np.pi / 2), np.random.default_rng(0))
    assert quarter[:, :, 0] == pytest.approx(R[:, :, 1])
    drawn, again = view_board(BoardViews(TILTED, 2000), np.random.default_rng(0))
    zero, same = view_board(BoardViews(TILTED, 2000, roll=0.0), np.random.default_rng(0))
    assert again.tolist() == same.tolist()
    roll = np.arctan2(np.sum(drawn[:, :, 0] * zero[:, :, 1], 1), np.sum(drawn[:, :, 0] * zero[:, :, 0], 1))
    assert np.histogram(roll, 4, (-np.pi, np.pi))[0] == pytest.approx(500, abs=5 * sqrt(375))  # binomial


def test_a_range_of_distances_is_kept_within_the_cone():
    n, cone = 4000, np.deg2rad(40)
    R, p = view_board(BoardViews(TILTED, n, distance=(0.3, 2.0), cone=cone), np.random.default_rng(1))
    away = p[1:] - BOARD
    distance = np.linalg.norm(away, axis=1)
    assert p[0] == pytest.approx(BOARD + 0.5 * TILTED.rotation[:, 2])
    assert distance.min() >= 0.3
    assert distance.max() <= 2.0
    assert distance.mean() == pytest.approx(1.15, abs=5 * 1.7 / sqrt(12 * n))
    cosine = away @ TILTED.rotation[:, 2] / distance
    assert cosine.min() >= np.cos(cone) - rounding(10)
    assert cosine.mean() == pytest.approx((1 + np.cos(cone)) / 2, abs=5 * (1 - np.cos(cone)) / sqrt(12 * n))
    assert np.abs(np.cross(R[:, :, 2], BOARD - p)).max() < rounding(10.0)


def test_the_arm_sees_the_board_from_03_to_2_m(shipped):
    views = BoardViews(PLACE, 51, distance=(0.3, 2.0), cone=np.pi / 2)
    s = simulate(replace(shipped, configurations=views), 1)
    T = poses_of(s.robot, s.measurements.readings[:52])
    assert np.abs(np.cross(T[:, :3, 2], BOARD - T[:, :3, 3])).max() < 1e-9


def test_held_self_motion_stays_near_the_posture(shipped):
    """With the roll held too, all 52 views are one continuous family; random starts spread over the whole range."""
    posture = simulate(exact(shipped), 5).measurements.readings[0]
    views = replace(shipped.configurations, roll=0.3, self_motion="held", posture=tuple(posture))
    q = simulate(replace(shipped, configurations=views), 0).measurements.readings[:52]
    assert simulate(replace(shipped, configurations=views), 9).measurements.readings[:52] == pytest.approx(q)
    spread = np.ptp(np.unwrap(q, axis=0), axis=0)
    free = simulate(replace(shipped, configurations=replace(views, self_motion="random", posture=None)), 0)
    assert np.median(spread) < 0.5 * np.median(np.ptp(free.measurements.readings[:52], axis=0))
    drawn = [
        simulate(replace(shipped, configurations=replace(views, posture=None)), seed).measurements.readings[0]
        for seed in (0, 1)
    ]
    assert np.abs(drawn[0] - drawn[1]).max() > 0.1


def test_a_table_is_where_the_arm_goes(shipped):
    q = np.random.default_rng(0).uniform(-1, 1, (5, 7))
    s = simulate(replace(shipped, configurations=GivenReadings(q), validation=GivenReadings(q[:2])))
    assert s.measurements.readings.tolist() == [*q.tolist(), *q[:2].tolist()]
    assert s.measurements.test.tolist() == [False] * 5 + [True] * 2


def test_configurations_keep_out_of_boxes_and_apart(shipped):
    """As many as are asked for, of any kind; poses of the tool above the floor say so themselves."""
    floor, gap = (Box([-20.0, -20.0, -20.0], [20.0, 20.0, -1.0]),), 0.8
    few = replace(shipped, configurations=RandomReadings(40, keep_out=floor, apart=gap),
                  validation=TargetViews([20.0, 0.0, 5.0], [0.0, 0.0, 0.1], 10, keep_out=floor))  # fmt: skip
    s = simulate(exact(few), 3)
    q, heights = s.measurements.readings, poses_of(s.robot, s.measurements.readings)[:, 2, 3]
    assert (len(q), np.sum(s.measurements.test)) == (50, 10)
    assert heights.min() >= -1.0
    assert not enters(s.robot, q, floor).any()
    assert np.abs(q[:40, None] - q[:40])[~np.eye(40, dtype=bool)].reshape(-1, 7).max(axis=1).min() >= gap
    assert poses_of(s.robot, simulate(replace(exact(few), configurations=RandomReadings(40)), 3).measurements.readings)[
        :, 2, 3].min() < -1.0  # fmt: skip


def test_configurations_that_are_not_to_be_had_are_reported(shipped):
    everywhere = (Box([-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]),)
    with pytest.raises(InputError) as caught:
        simulate(replace(shipped, configurations=RandomReadings(2, keep_out=everywhere)))
    assert str(caught.value) == (
        "space-robot: configurations: 0 of 2 found in 40 drawn: 100 % in a box; "
        "keep_out 1 holds the foot of the moving arm, (0, 0, 2.3) m, in every configuration"
    )
    with pytest.raises(InputError, match=r"^space-robot: validation: 1 of 2 found in 2 drawn: 50 % near another; "):
        simulate(
            replace(shipped, configurations=RandomReadings(2), validation=GivenReadings(np.zeros((2, 7)), apart=1))
        )


# --- frames -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_frame_is_the_base_or_any_or_given(shipped):
    base = simulate(replace(exact(shipped), frame="base"))
    assert base.frame.rotation.tolist() == np.eye(3).tolist()
    assert base.frame.position.tolist() == [0, 0, 0]
    given = simulate(replace(exact(shipped), frame=TILTED))
    assert given.frame is TILTED
    for s in (base, given):
        assert np.abs(measured(s)[1]).max() < rounding(10.0)
    frames = [simulate(shipped, seed).frame for seed in range(20)]
    assert all(np.abs(f.rotation @ f.rotation.T - np.eye(3)).max() < rounding() for f in frames)
    assert all(np.abs(f.position).max() <= FARTHEST_BASE for f in frames)
    turns = [Rotation.from_matrix(f.rotation).magnitude() for f in frames]
    assert np.mean(turns) == pytest.approx(np.pi / 2 + 2 / np.pi, abs=5 * 0.65 / sqrt(20))  # of a uniform rotation
    assert [s.job["frame"] for s in (base, given, simulate(shipped))] == ["known", "unknown", "unknown"]


# --- seeds ------------------------------------------------------------------------------------------------------------


def test_the_same_seed_writes_the_same_bytes(shipped, tmp_path):
    for folder, seed in (("a", 7), ("b", 7), ("c", 8)):
        assert write_simulation(tmp_path / folder, simulate(shipped, seed)) == FILES
    for name in FILES:
        a, b, c = ((tmp_path / folder / name).read_bytes() for folder in "abc")
        assert a == b
        assert (a == c) == (name == "robot_nominal.yaml")


@pytest.mark.slow
def test_each_purpose_draws_for_itself(shipped):
    """Another noise, validation, frame or camera changes neither the errors nor each other's draws."""
    s = simulate(shipped)
    errors = s.true_robot.nominal.tolist()
    noisier = simulate(replace(shipped, noise=Noise(2e-3, 1e-3, 1e-4)))
    assert noisier.true_robot.nominal.tolist() == errors
    assert noisier.measurements.readings.tolist() == s.measurements.readings.tolist()
    assert noisier.frame.position.tolist() == s.frame.position.tolist()
    assert measured(noisier)[1] == pytest.approx(2 * measured(s)[1], abs=rounding(10.0))
    untested = simulate(replace(shipped, validation=None, frame="base"))
    assert untested.true_robot.nominal.tolist() == errors
    assert untested.true_readings.tolist() == s.true_readings[:52].tolist()
    # The same noise along the axes of either frame, and about those of the tool: not about the frame's.
    for noise, same in zip(measured(untested)[1:], measured(s)[1:], strict=True):
        assert noise == pytest.approx(same[:52], abs=rounding(10.0))
    elsewhere = simulate(replace(shipped, configurations=RandomReadings(52)))
    assert elsewhere.true_robot.nominal.tolist() == errors
    assert elsewhere.measurements.readings[52:].tolist() == s.measurements.readings[52:].tolist()
    freed = replace(shipped.robot, parameters=tuple(replace(p, estimated=True) for p in shipped.robot.parameters))
    more = simulate(replace(shipped, robot=freed)).true_robot.nominal
    assert [more[i] == e for i, e in enumerate(errors) if shipped.robot.parameters[i].estimated] == [True] * 30


# --- what cannot be ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_board_out_of_reach_is_reported_with_what_misses(shipped):
    far = replace(shipped.configurations, board=Placement(np.eye(3), np.array([0.0, 50.0, 2.55])), count=2)
    with pytest.raises(InputError) as caught:
        simulate(replace(shipped, configurations=far, source="far.yaml"))
    found = re.fullmatch(
        r"far\.yaml: configurations: board: 3 of 3 views not reached within the joint limits \(A, view 1, view 2\): "
        r"the nearest configurations found miss (?:A|view [12]) by ([\d.]+) m and [\d.]+ deg "
        r"and (?:A|view [12]) by ([\d.]+) m and [\d.]+ deg; move the board nearer or widen the limits",
        str(caught.value),
    )
    assert found
    # The arm reaches 10 m and some joint offsets from its shoulder, 2.3 m above the base.
    assert 35.0 < float(found[1]) <= float(found[2]) < 42.0


@pytest.mark.slow
def test_one_pose_out_of_reach_is_named_and_no_other(shipped):
    """A is where the paper has it, and the only other view 30 m away."""
    views = BoardViews(PLACE, 1, radius=30.0)
    missed = r"board: 1 of 2 views not reached within the joint limits \(view 1\): the nearest .* found miss view 1 by"
    for scenario, key in (
        (replace(shipped, configurations=views), "configurations"),
        (replace(shipped, configurations=replace(views, self_motion="held", roll=0.0)), "configurations"),
        (replace(shipped, validation=views), "validation"),
    ):
        with pytest.raises(InputError, match=f"^space-robot: {key}: {missed} "):
            simulate(scenario)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"errors": Errors("uniform", {"b": 1.0})}, "space-robot: errors: uniform: unknown parameter or kind 'b', "
         "expected one of a, alpha, base, beta, d, theta, tool"),
        ({"errors": Errors("normal", {"a": -1.0})}, "space-robot: errors: normal: found -1, "
         "expected numbers not below 0"),
        ({"noise": Noise(1e-3, None)}, "space-robot: noise: orientation: found none, expected 1 sigma: poses are "
         "simulated whole"),
        ({"noise": Noise(0.0, 1e-4)}, "space-robot: noise: position: found 0, expected a number above 0; a "
         "calibration takes nothing for exact: tell it what to assume under job: noise: position"),
    ],
)  # fmt: skip
def test_a_scenario_that_makes_no_sense_is_one_line(shipped, change, message):
    with pytest.raises(InputError) as caught:
        simulate(replace(shipped, **change))
    assert str(caught.value) == message


def test_a_seed_is_not_negative(shipped):
    with pytest.raises(InputError) as caught:
        simulate(shipped, -1)
    assert str(caught.value) == "seed: found -1, expected a whole number not below 0"


# --- files and the command --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_a_job_that_runs(fg_calib, tmp_path):
    out = tmp_path / "deep" / "demo"
    ended = fg_calib("simulate", "space-robot", "--seed", 1, "--out", out)
    assert ended == (
        0,
        "space-robot, seed 1: 52 configurations to calibrate, 500 to test\n",
        f"wrote {', '.join(FILES)} to {out}\n"
        f"now: fg-calib calibrate {out / 'calibration.yaml'} --out {out / 'result'}\n",
    )
    assert sorted(file.name for file in out.iterdir()) == list(FILES)
    assert (out / "calibration.yaml").read_text() == (
        "# fg-calib simulate space-robot --seed 1\nrobot: robot_nominal.yaml\nmeasurements: poses.csv\n"
        "truth: robot_true.yaml\nmodel: distance-rotation\npairing: star\nframe: unknown\n"
        "units: {length: m, angle: deg}\nnoise: {position: 0.001, orientation: 0.01, joint: 0.005}\n"
    )
    table = pl.read_csv(out / "poses.csv")
    assert table.columns == ["id", *(f"q{i}" for i in range(1, 8)), "x", "y", "z", "qx", "qy", "qz", "qw", "split"]
    assert (table.height, table["split"].to_list().count("test")) == (552, 500)
    nominal, true = (read_robot(out / f"robot_{name}.yaml") for name in ("nominal", "true"))
    assert [replace(p, nominal=0.0) for p in true.parameters] == [replace(p, nominal=0.0) for p in nominal.parameters]
    assert (true.name, true.joints) == (nominal.name, nominal.joints)
    assert fg_calib("calibrate", out / "calibration.yaml", "--out", out / "result").code == 0


def test_the_bundled_example_is_the_shipped_scenario_with_seed_0(simulation, tmp_path):
    """There is one implementation. Other machines may round otherwise, so the poses are compared to 1e-6 of a unit."""
    write_simulation(tmp_path / "job", simulation)
    for name in ("calibration.yaml", "robot_nominal.yaml"):
        assert (EXAMPLES / "space-robot" / name).read_text() == (tmp_path / "job" / name).read_text()
    written, bundled = (pl.read_csv(folder / "poses.csv") for folder in (tmp_path / "job", EXAMPLES / "space-robot"))
    assert written.columns == bundled.columns
    assert written.select("id", "split").equals(bundled.select("id", "split"))
    numbers = [name for name in written.columns if name not in {"id", "split"}]
    assert written.select(numbers).to_numpy() == pytest.approx(bundled.select(numbers).to_numpy(), abs=1e-6)
    truth = read_robot(EXAMPLES / "space-robot" / "robot_true.yaml")
    assert truth.nominal == pytest.approx(simulation.true_robot.nominal, abs=rounding(10.0))


def test_json_is_all_there_is_on_stdout(fg_calib, tmp_path):
    ended = fg_calib("simulate", "space-robot", "--out", tmp_path / "demo", "--json")
    assert ended.code == 0
    summary = json.loads(ended.out)
    s = simulate(read_scenario("space-robot"))
    assert summary["files"] == [str(tmp_path / "demo" / name) for name in FILES]
    assert (summary["scenario"], summary["seed"]) == ("space-robot", 0)
    assert (summary["n_configurations"], summary["n_train"], summary["n_test"]) == (552, 52, 500)
    errors = s.true_robot.nominal - s.robot.nominal
    assert summary["truth"]["errors"] == {
        p.name: e for p, e in zip(s.robot.parameters, errors.tolist(), strict=True) if p.estimated
    }
    frame = summary["truth"]["world_T_base"]
    assert frame["xyz"] == s.frame.position.tolist()
    assert Rotation.from_quat(frame["quaternion_xyzw"]).as_matrix() == pytest.approx(s.frame.rotation)


MODELS = ["pose", "position", "orientation", "distance", "rotation"]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "frame"), diagonal(MODELS, ["unknown", "base"]))
def test_every_model_runs_as_it_is_written(fg_calib, tmp_path, model, frame):
    """Stated noise is true noise, so the fit is good: 0, and never the 3 of a doubtful one."""
    text = f"""\
name: every
robot: {SCENARIOS / "space-robot" / "robot.yaml"}
units: {{length: mm, angle: deg}}
errors: {{normal: tolerance}}
configurations: {{random: {{count: 60}}}}
noise: {{position: 1, orientation: 0.01, joint: 0.005}}
frame: {frame}
job: {{model: {model}}}
"""
    (tmp_path / "every.yaml").write_text(text)
    out = tmp_path / "job"
    assert fg_calib("simulate", tmp_path / "every.yaml", "--out", out, "--seed", 3).code == 0
    assert "units: {length: mm, angle: deg}\nnoise: {position: 1.0, " in (out / "calibration.yaml").read_text()
    ended = fg_calib("calibrate", out / "calibration.yaml", "--out", out / "result")
    assert (ended.code, ended.err) == (0, "")


def test_a_urdf_robot_is_written_with_its_urdf(tmp_path):
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="a"/><link name="b"/><link name="c"/>'
        '<joint name="j1" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.3"/>'
        '<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        '<joint name="j2" type="prismatic"><parent link="b"/><child link="c"/><origin xyz="0.2 0 0" rpy="1.5 0 0"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    (tmp_path / "s.yaml").write_text(
        "robot: {urdf: arm.urdf, tool: {z: 0.1}, estimate: [tool.z]}\nerrors: {uniform: {x: 0.01, tool: 0.02}}\n"
        "configurations: {random: {count: 9}}\nnoise: {position: 0.001, orientation: 0.001, joint: [0.01, 0.002]}\n"
    )
    s = simulate(read_scenario(tmp_path / "s.yaml"))
    names = write_simulation(tmp_path / "job", s)
    assert names == (*FILES[:2], "robot_nominal.urdf", "robot_nominal.yaml", "robot_true.urdf", "robot_true.yaml")
    job = read_job(tmp_path / "job" / "calibration.yaml")
    assert job.robot.nominal == pytest.approx(s.robot.nominal, abs=rounding(10.0))
    assert job.truth.nominal == pytest.approx(s.true_robot.nominal, abs=rounding(10.0))
    assert job.measurements.sigma_joint == pytest.approx([0.01, 0.002])
    assert s.true_robot.nominal[s.robot.index("tool.z")] != 0.1


@pytest.mark.slow
def test_a_failure_leaves_an_existing_folder_as_it_was(fg_calib, tmp_path):
    assert fg_calib("simulate", "space-robot", "--out", tmp_path / "demo").code == 0
    (tmp_path / "demo" / "mine.txt").write_text("mine")
    before = {file.name: file.read_bytes() for file in (tmp_path / "demo").iterdir()}
    scenario = (SCENARIOS / "space-robot" / "scenario.yaml").read_text()
    robot = SCENARIOS / "space-robot" / "robot.yaml"
    (tmp_path / "far.yaml").write_text(scenario.replace("robot.yaml", str(robot)).replace("y: 6.5", "y: 65"))
    ended = fg_calib("simulate", tmp_path / "far.yaml", "--out", tmp_path / "demo")
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.startswith("error: far.yaml: configurations: board: 52 of 52 views not reached within the ")
    assert ended.err.count("\n") == 1
    assert {file.name: file.read_bytes() for file in (tmp_path / "demo").iterdir()} == before
    assert fg_calib("simulate", "space-robot", "--out", tmp_path / "demo", "--seed", 2).code == 0
    after = {file.name: file.read_bytes() for file in (tmp_path / "demo").iterdir()}
    assert {name for name in after if after[name] != before[name]} == {*FILES} - {"robot_nominal.yaml"}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["puma"], 1, "error: scenario: found 'puma', expected a file, or one of space-robot\n"),
        (["space-robot", "--seed", "-1"], 2, None),
    ],
)
def test_wrong_use_is_an_exit_code(fg_calib, tmp_path, arguments, code, message):
    ended = fg_calib("simulate", *arguments, "--out", tmp_path / "demo")
    assert (ended.code, ended.out) == (code, "")
    assert message is None or ended.err == message
    assert not (tmp_path / "demo").exists()


def test_out_is_needed(fg_calib):
    assert fg_calib("simulate", "space-robot").code == 2


def test_the_public_names_are_these():
    assert fg_calib.simulate is simulate
    assert fg_calib.read_scenario is read_scenario
    assert fg_calib.write_simulation is write_simulation
    assert fg_calib.Scenario is Scenario
    assert isinstance(simulate(Scenario(planar_robot(), Errors("values", {}), RandomReadings(2), Noise(1, 1))),
                      fg_calib.Simulation)  # fmt: skip


def test_the_shipped_arm_is_the_one_of_the_tests(shipped):
    q = np.random.default_rng(0).uniform(-3, 3, (3, 7))
    assert poses_of(shipped.robot, q) == pytest.approx(poses_of(paper_robot(), q), abs=rounding(10.0))
