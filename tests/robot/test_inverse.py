"""Inverse kinematics: solutions are held to 4x4 products, to the limits, and to their own poses alone."""

import numpy as np
import pytest
from oracle import random_robot, tool_pose, tool_poses
from simulated import paper_robot, planar_robot, small_arm
from tolerances import rounding

from fg_calib import InputError, Robot
from fg_calib.robot import CONVENTIONS, REACHED, pose, random_readings, solve_inverse
from fg_calib.robot.inverse import _Search


def require_reached(robot, found, T):
    """The solutions bring the tool to T within 1e-9 m and rad, and stand within the limits."""
    assert found.reached.all()
    there = tool_poses(robot, found.readings)
    assert np.abs(there[:, :3, 3] - T[:, :3, 3]).max() < REACHED
    assert np.abs(there[:, :3, :3] - T[:, :3, :3]).max() < REACHED
    lower, upper = robot.limits.T
    assert (found.readings >= lower).all()
    assert (found.readings <= upper).all()


def elbow_arm(limit):
    """A six-joint arm with an elbow and a wrist; all joints turn +-limit degrees."""
    rows = [(0, 0, 0.67), (0, -90, 0.15), (0.43, 0, 0), (0.02, -90, 0.43), (0, 90, 0), (0, -90, 0)]
    rows, limits = [(a, np.deg2rad(alpha), d, 0) for a, alpha, d in rows], [np.deg2rad([-limit, limit])] * 6
    return Robot.from_dh(rows, "mdh", limits=limits, base={"x": 0.3, "yaw": 0.4}, tool={"z": 0.1, "pitch": 0.2})


ARMS = [
    *(random_robot(convention, n, np.random.default_rng(n)) for convention in (*CONVENTIONS, "urdf") for n in (5, 7)),
    *(paper_robot(), small_arm(), elbow_arm(180), elbow_arm(100), elbow_arm(360)),
]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("robot", ARMS, ids=range(len(ARMS)))
def test_poses_that_can_be_reached_are_reached_within_the_limits(robot):
    """Any convention, revolute and prismatic, with base and tool, fewer than six joints and more."""
    rng = np.random.default_rng(1)
    T = tool_poses(robot, random_readings(robot, 15, rng))
    require_reached(robot, solve_inverse(robot, T[:, :3, 3], T[:, :3, :3], generator=rng), T)


def test_limits_that_are_no_whole_turn_about_zero_are_kept():
    robot, rng = planar_robot(limits=[np.deg2rad([200, 500])] * 2), np.random.default_rng(2)
    T = tool_poses(robot, random_readings(robot, 50, rng))
    require_reached(robot, solve_inverse(robot, T[:, :3, 3], T[:, :3, :3], generator=rng), T)


def test_random_starts_give_random_self_motion():
    robot = paper_robot()
    T = np.broadcast_to(tool_pose(robot, np.array([0.3, -0.5, 0.4, 1.0, -0.7, 0.9, 0.2])), (30, 4, 4))
    found = solve_inverse(robot, T[:, :3, 3], T[:, :3, :3], generator=np.random.default_rng(3))
    require_reached(robot, found, T)
    assert (np.ptp(found.readings, axis=0) > 0.5).sum() >= 3  # 7 joints for 6 coordinates


def test_a_solution_stays_near_where_it_started():
    robot, rng = paper_robot(), np.random.default_rng(4)
    near = np.array([0.3, -0.5, 0.4, 1.0, -0.7, 0.9, 0.2])
    T = tool_poses(robot, near + 0.05 * rng.normal(size=(20, 7)))
    found = solve_inverse(robot, T[:, :3, 3], T[:, :3, :3], generator=rng, near=near)
    require_reached(robot, found, T)
    assert np.abs(found.readings - near).max() < 0.6
    same = tool_pose(robot, near)[None]
    found = solve_inverse(robot, same[:, :3, 3], same[:, :3, :3], generator=rng, near=near)
    assert found.readings[0] == pytest.approx(near, abs=rounding(10))


def test_steps_are_of_minimum_norm():
    """A small step's change of the joints has no part in the arm's self-motion, the null space of the derivative."""
    robot = paper_robot()
    near = np.array([0.3, -0.5, 0.4, 1.0, -0.7, 0.9, 0.2])
    T = tool_pose(robot, near)
    T[:3, 3] += [1e-5, -2e-5, 1e-5]
    found = solve_inverse(robot, T[None, :3, 3], T[None, :3, :3], generator=np.random.default_rng(0), near=near)
    h = 1e-6
    J = np.stack([(tool_pose(robot, near + h * e) - tool_pose(robot, near - h * e))[:3].ravel() for e in np.eye(7)], 1)
    null = np.linalg.svd(J / (2 * h))[2][-1]
    change = found.readings[0] - near
    assert np.linalg.norm(change) > 1e-6
    assert abs(null @ change) < 1e-4 * np.linalg.norm(change)


@pytest.mark.slow
def test_what_cannot_be_reached_is_told_with_its_miss():
    robot, rng = elbow_arm(180), np.random.default_rng(5)
    T = tool_poses(robot, random_readings(robot, 3, rng))
    T[1, :3, 3] = 4.0, 0.0, 0.0  # the arm is 1.8 m long
    found = solve_inverse(robot, T[:, :3, 3], T[:, :3, :3], generator=rng)
    assert found.reached.tolist() == [True, False, True]
    there = tool_pose(robot, found.readings[1])
    assert found.miss_position[1] == pytest.approx(np.linalg.norm(there[:3, 3] - T[1, :3, 3]))
    cosine = 0.5 * (np.trace(there[:3, :3].T @ T[1, :3, :3]) - 1)
    assert found.miss_rotation[1] == pytest.approx(np.arccos(cosine), abs=1e-6)
    assert 4.0 - 0.3 - 1.8 < found.miss_position[1] < 4.0


def test_what_a_joint_at_its_limit_cannot_do_the_others_do():
    """In one step but for its curvature: three joints for two coordinates, the first cannot turn on."""
    robot, q = Robot.from_dh([[1.0, 0, 0, 0]] * 3, "dh", limits=[[-1.0, 1.0], None, None]), np.array([[1.0, 0.5, 0.5]])
    for way in (1.0, -1.0):
        target = pose(robot, q + way * np.array([[1e-4, 1e-4, 1e-4]])).position
        search = _Search(robot, None, target, None)
        moved = search.step(q, *search.look(q, np.array([0])))
        assert np.linalg.norm(pose(robot, moved).position - target) < 1e-6
        assert (moved[0, 0] == 1.0) == (way > 0.0)


def test_a_pose_is_solved_alike_alone_and_among_others():
    robot = paper_robot()
    T = tool_poses(robot, random_readings(robot, 10, np.random.default_rng(7)))
    R, p = T[:, :3, :3], T[:, :3, 3]
    ten = solve_inverse(robot, p, R, generator=np.random.default_rng(8)).readings
    three = solve_inverse(robot, p[:3], R[:3], generator=np.random.default_rng(8)).readings
    assert three == pytest.approx(ten[:3], abs=rounding(1, 100))  # batched linear algebra may round otherwise


def test_no_poses_are_no_work():
    found = solve_inverse(paper_robot(), np.empty((0, 3)), np.empty((0, 3, 3)))
    assert found.readings.shape == (0, 7)
    assert found.reached.shape == (0,)


def test_random_readings_fill_the_limits():
    limits = [(-0.5, 2), None, None, (3, np.inf), (-np.inf, 1)]
    types = [*["revolute"] * 2, *["prismatic"] * 2, "revolute"]
    robot = Robot.from_dh([[1, 0, 0, 0]] * 5, "mdh", types=types, limits=limits)
    q = random_readings(robot, 4000, np.random.default_rng(0))
    low, high = [-0.5, -np.pi, -1, 3, 1 - 2 * np.pi], [2, np.pi, 1, 5, 1]
    assert (q >= low).all()
    assert (q <= high).all()
    span = np.subtract(high, low)
    # The extremes of 4000 draws are within 10 / 4000 of the ends but for a chance of 5e-5 each.
    assert (q.min(axis=0) - low < span / 400).all()
    assert (high - q.max(axis=0) < span / 400).all()


# --- as a user calls it --------------------------------------------------------------------------------------------


def test_one_pose_or_position_in_one_call():
    robot, q = small_arm(), np.array([0.3, -0.5, 0.2, 0.9])
    at = pose(robot, [q])
    found = solve_inverse(robot, at.position[0].tolist(), at.rotation[0].tolist())
    assert found.reached.tolist() == [True]
    assert pose(robot, found.readings).rotation == pytest.approx(at.rotation, abs=REACHED)
    point = solve_inverse(robot, at.position[0])
    assert point.reached.tolist() == [True]
    assert pose(robot, point.readings).position == pytest.approx(at.position, abs=REACHED)
    assert np.abs(pose(robot, point.readings).rotation - at.rotation).max() > 1e-3  # any would do
    near = solve_inverse(robot, at.position[0], at.rotation[0], near=q + 0.01)
    assert near.readings[0] == pytest.approx(q, abs=1e-8)  # REACHED, by a Jacobian of size 1


@pytest.mark.parametrize(("given", "message"), [
    ({"position": [1, 2]}, r"position: shape \(1, 2\), expected \(n, 3\)"),
    ({"position": [1, 2, np.nan]}, "position: row 0: found nan"),
    ({"rotation": np.eye(4)}, r"rotation: shape \(1, 4, 4\), expected \(1, 3, 3\)"),
    ({"rotation": 2 * np.eye(3)}, "rotation: row 0: found .*, expected a rotation matrix"),
    ({"near": [0, 0]}, r"near: shape \(2,\), expected \(4\)"),
    ({"n_starts": 0}, "n_starts: found 0"),
])  # fmt: skip
def test_targets_are_checked(given, message):
    with pytest.raises(InputError, match=f"^{message}"):
        solve_inverse(small_arm(), **{"position": [0.1, 0.2, 0.3]} | given)
