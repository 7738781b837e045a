"""What to command: the true arm, by 4x4 products, is then where it was sent."""

import numpy as np
import pytest
from oracle import tool_pose
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import measure, true_robot

from fg_calib import Robot, calibrate, correct
from fg_calib.prediction import correction
from fg_calib.robot.inverse import random_readings

ROWS = [[0, 90, 118, 0], [-613, 0, 0, 0], [-572, 0, 0, 0], [0, 90, 164, 0], [0, -90, 116, 0], [0, 0, 92, 0]]
TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 2e-3, "alpha": 1e-3, "beta": 1e-3}
FRAME = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))


def six_axes():
    """An arm with parallel axes and a wrist, all joints within +-170 degrees."""
    rows = [[a / 1e3, np.deg2rad(alpha), d / 1e3, theta] for a, alpha, d, theta in ROWS]
    limits = [(-np.deg2rad(170), np.deg2rad(170))] * 6
    return Robot.from_dh(rows, convention="dh-hayati", tool=[0.02, -0.01, 0.15], limits=limits, tolerance=TOLERANCE)


@pytest.fixture(scope="module")
def calibrated():
    """The true arm, its calibration in a known frame, and targets: poses of the nominal arm."""
    robot, rng = six_axes(), np.random.default_rng(5)
    true = true_robot(robot, rng)
    q = random_readings(robot, 40, rng)
    found = calibrate(robot, measure(true, 40, rng, readings=q, sigma=(1e-5, 1e-5)), model="pose")
    return robot, true, found


def some(robot, n=12):
    """Joint values away from limits, and the nominal poses there."""
    q = 0.8 * random_readings(robot, n, np.random.default_rng(9))
    return q, np.array([tool_pose(robot, row) for row in q])


def test_the_calibrated_arm_reaches_the_targets_and_the_true_one_by_what_is_expected(calibrated):
    robot, true, found = calibrated
    q, T = some(robot)
    given = correct(found, T[:, :3, 3], T[:, :3, :3], near=q)
    assert given.reached.all()
    there = np.array([tool_pose(found.robot, row) for row in given.readings])
    assert np.abs(there[:, :3] - T[:, :3]).max() < 1e-9
    hit = np.array([tool_pose(true, row) for row in given.readings])
    error = np.linalg.norm(hit[:, :3, 3] - T[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 2.0 * np.sqrt(np.mean(given.expected[:, 0] ** 2))
    missed = np.linalg.norm([tool_pose(true, row)[:3, 3] for row in q] - T[:, :3, 3], axis=1)
    assert error.max() < 0.05 * missed.min()
    assert given.uncorrected[:, 0] == pytest.approx(missed, rel=0.05)  # by the calibrated arm


def test_the_pose_to_command_is_where_the_nominal_arm_finds_these_joint_values(calibrated):
    robot, _, found = calibrated
    q, T = some(robot)
    given = correct(found, T[:, :3, 3], T[:, :3, :3], near=q)
    nominal = np.array([tool_pose(robot, row) for row in given.readings])
    assert np.abs(nominal[:, :3, 3] - given.position).max() < 1e-12
    assert np.abs(nominal[:, :3, :3] - given.rotation).max() < 1e-12
    assert given.nominal_readings == pytest.approx(q, abs=1e-7)
    changed = np.abs(given.readings - given.nominal_readings)
    assert np.median(changed) < 0.01
    assert changed.max() < 0.3  # no other branch, though one is near the wrist's singularity
    assert given.far.tolist() == (np.abs(given.readings - q) > 0.1).any(axis=1).tolist()


def test_positions_alone_take_any_orientation_and_stay_near(calibrated):
    robot, _, found = calibrated
    q, T = some(robot)
    given = correct(found, T[:, :3, 3], near=q)
    assert given.reached.all()
    assert not given.turns
    assert np.abs(given.readings - q).max() < 0.1
    there = np.array([tool_pose(found.robot, row)[:3, 3] for row in given.readings])
    assert np.abs(there - T[:, :3, 3]).max() < 1e-9


def test_limits_are_kept_and_what_is_out_of_reach_is_said(calibrated, monkeypatch):
    monkeypatch.setattr(correction, "N_STARTS", 2)
    robot, _, found = calibrated
    lower, upper = robot.limits.T
    edge = np.array([upper, lower, 0.5 * upper])
    given = correct(found, near=edge)
    assert (given.readings >= lower).all()
    assert (given.readings <= upper).all()
    far = correct(found, [[9.0, 0.0, 0.0], [0.3, 0.3, 0.5]])
    assert far.reached.tolist() == [False, True]
    assert np.isnan(far.uncorrected[0, 0])
    assert far.missed[0, 0] > 1.0


def test_targets_in_the_measurement_frame_are_reached_there():
    robot, rng = six_axes(), np.random.default_rng(6)
    true = true_robot(robot, rng)
    data = measure(true, 30, rng, readings=random_readings(robot, 30, rng), sigma=(1e-5, 1e-5), frame=FRAME)
    found = calibrate(robot, data, model="pose", frame="unknown")
    turn, shift = FRAME
    q, T = some(robot, 6)
    target = turn.apply(T[:, :3, 3]) + shift
    rotation = turn.as_matrix() @ T[:, :3, :3]
    given = correct(found, target, rotation, near=q, world=True)
    hit = turn.apply([tool_pose(true, row)[:3, 3] for row in given.readings]) + shift
    assert np.linalg.norm(hit - target, axis=1).max() < 3.0 * given.expected[:, 0].max()
    assert given.expected[:, 0].max() < 5e-5
    by_base = correct(found, T[:, :3, 3], T[:, :3, :3], near=q)
    assert by_base.expected_fitted < 5e-5 < by_base.expected[:, 0].max()  # where the base is, priors alone say


@pytest.mark.parametrize(("arguments", "message"), [
    ({}, "position: none are given, expected where the targets are, or joint values alone"),
    ({"position": [[0.0, 0.1]]}, "position"),
    ({"position": [0.1, 0.2, 0.3], "rotation": np.ones((3, 3))}, "rotation"),
    ({"position": [0.1, 0.2, 0.3], "near": np.zeros((2, 6))}, "near: 2 rows, expected one for all, or 1"),
    ({"near": np.full(6, 9.0)}, "near"),
    ({"position": [0.1, 0.2, 0.3], "world": True}, "world: the measurement frame was not estimated"),
    ({"near": np.zeros(6), "world": True}, "world: joint values reach poses in the base frame"),
])  # fmt: skip
def test_what_cannot_be_corrected_is_one_line(calibrated, arguments, message):
    assert message in refusal(correct, calibrated[2], **arguments)
