"""Candidates: what is said of them is computed again from forward kinematics by 4x4 products."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from oracle import tool_poses
from simulated import paper_robot, planar_robot, small_arm

from fg_calib.robot import REACHED, Robot, random_readings
from fg_calib.simulation import BoardViews, Box, GivenReadings, Placement, TargetViews, draw_candidates, link_points
from fg_calib.simulation.obstacles import enters
from fg_calib.simulation.views import number_of

LIMIT = np.deg2rad(170.0)
ARM = Robot.from_dh(
    [(0, -np.pi / 2, 0.36, 0), (0, np.pi / 2, 0, 0), (0, np.pi / 2, 0.42, 0), (0, -np.pi / 2, 0, 0),
     (0, -np.pi / 2, 0.4, 0), (0, np.pi / 2, 0, 0), (0, 0, 0.126, 0)],
    "dh", name="arm", limits=[[-LIMIT, LIMIT]] * 7, tool=[0, 0, 0.1, 0, 0.2, 0],
)  # fmt: skip
"""Seven joints, 1.3 m from the base to the tool."""
BOARD = Placement(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T, np.array([0.7, 0.1, 0.4]))
VIEWS = BoardViews(BOARD, 99, height=0.4, distance=(0.3, 0.6), cone=0.7)  # its normal is the base's -x
TARGET = TargetViews(
    np.array([3.0, 0.5, 1.2]), np.array([0.0, 0.03, 0.05]), 100,
    axis=np.array([0.0, 1.0, 1.0]), acceptance=0.5, distance=(2.0, 3.2),
)  # fmt: skip


def draw(robot, of, n=None, **conditions):
    of = replace(of, **conditions)
    found = draw_candidates(robot, of, np.random.default_rng(0), n or number_of(of), "candidates")
    assert found.asked == len(found.readings) + sum(found.rejected.values())
    lower, upper = robot.limits.T
    assert isinstance(of, GivenReadings) or ((found.readings >= lower) & (found.readings <= upper)).all()
    return found


def angle(a, b):
    """Between vectors along the last axis."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


# --- random, and of a table -------------------------------------------------------------------------------------------


def test_rows_of_a_table_outside_the_limits_are_rejected_and_the_order_kept():
    q = np.linspace(-2.0, 2.0, 5)[:, None] * np.ones(7) * LIMIT / 1.5
    found = draw(ARM, GivenReadings(q))
    assert found.readings.tolist() == q[1:4].tolist()
    assert (found.asked, found.rejected) == (5, {"outside the joint limits": 2})
    assert draw(ARM, GivenReadings(q), n=2).readings.tolist() == q[1:3].tolist()


# --- boxes ------------------------------------------------------------------------------------------------------------

BOXES = [Box([-2.0, 0.2, -1.0], [2.0, 0.5, 2.0]), Box([0.3, -2.0, 0.1], [0.9, -0.4, 0.4])]


@pytest.mark.parametrize("robot", [ARM, small_arm()], ids=lambda robot: robot.name)
def test_boxes_are_entered_where_points_along_the_links_are_inside(robot):
    """A thousand points along each line; a cut of a corner shorter than the steps may be missed: none of these is."""
    q = random_readings(robot, 60, np.random.default_rng(1))
    size = robot.reach
    boxes = [Box(box.lower * size, box.upper * size) for box in BOXES]
    links, steps = link_points(robot, q), np.linspace(0.0, 1.0, 1000)[:, None]
    inside = np.zeros(len(q), dtype=bool)
    for row, points in enumerate(links):
        along = np.concatenate([a + steps * (b - a) for a, b in pairwise(points)])
        inside[row] = any(((along > box.lower) & (along < box.upper)).all(axis=1).any() for box in boxes)
    assert 5 < inside.sum() < 55
    assert enters(robot, q, boxes).tolist() == inside.tolist()


def test_what_no_joint_moves_and_what_touches_is_not_in_the_way():
    """The column up to the shoulder stands in one box, and on the floor."""
    q = np.zeros((1, 7))
    assert not enters(ARM, q, [Box([-0.1, -0.1, -0.1], [0.1, 0.1, 0.35])]).any()
    assert enters(ARM, q, [Box([-0.1, -0.1, -0.1], [0.1, 0.1, 0.37])]).all()
    flat = planar_robot()
    on_the_floor = random_readings(flat, 10, np.random.default_rng(0))
    assert not enters(flat, on_the_floor, [Box([-9, -9, -1], [9, 9, 0])]).any()
    assert enters(flat, on_the_floor, [Box([-9, -9, -1], [9, 9, 1e-6])]).all()


# --- what a camera sees -----------------------------------------------------------------------------------------------


def test_a_camera_looks_at_the_board_from_within_the_range_and_the_cone():
    found = draw(ARM, VIEWS)
    T = tool_poses(ARM, found.readings)
    assert (len(T), set(found.rejected)) == (100, {"out of reach"})
    away = T[:, :3, 3] - BOARD.position
    length = np.linalg.norm(away, axis=1)
    assert length.min() >= 0.3 - REACHED
    assert length.max() <= 0.6 + REACHED
    assert angle(away, BOARD.rotation[:, 2]).max() <= 0.7 + 1e-8  # REACHED over the least distance
    assert angle(-away, T[:, :3, 2]).max() < 1e-8
    assert draw(ARM, VIEWS).readings.tolist() == found.readings.tolist()


def test_the_centre_is_anywhere_in_the_field_of_view_evenly():
    """1 - cosine of the angle to the axis, and the azimuth, are even: of 200 numbers the mean is 0.5 +- 0.0204."""
    board = Placement(np.eye(3), np.array([6.0, 0.0, 3.0]))
    robot = paper_robot()  # reaches nearly any of these, so that reach does not favour some
    views = BoardViews(board, 199, distance=(0.3, 0.6), cone=0.7, field_of_view=0.4)
    T = tool_poses(robot, draw(robot, views).readings)
    seen = np.einsum("nji,nj->ni", T[:, :3, :3], board.position - T[:, :3, 3])
    even = (1.0 - np.cos(angle(seen, np.array([0.0, 0.0, 1.0])))) / (1.0 - np.cos(0.4))
    around = np.arctan2(seen[:, 1], seen[:, 0]) / (2 * np.pi) + 0.5
    assert even.max() <= 1.0 + 1e-7
    assert [even.mean(), around.mean()] == pytest.approx([0.5, 0.5], abs=4 * 0.0204)


def test_the_whole_board_is_in_the_field_of_view():
    views = replace(VIEWS, field_of_view=0.4, board_size=(0.2, 0.1))
    found = draw(ARM, views, n=60)
    T = tool_poses(ARM, found.readings)
    corners = [BOARD.position + BOARD.rotation @ (x, y, 0.0) for x in (-0.1, 0.1) for y in (-0.05, 0.05)]
    off = np.array([angle(corner - T[:, :3, 3], T[:, :3, 2]) for corner in corners])
    assert off.max() <= 0.4 + 1e-8
    assert off.max(axis=0).min() < 0.35  # not only those with the board in a corner
    assert set(found.rejected) == {"not seen", "out of reach"}


# --- what a tracker sees ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("robot", "far"), [(ARM, 3.2), (small_arm(), 4.2)], ids=["arm", "small-arm"])
def test_the_tracker_sees_the_reflector(robot, far):
    """Within its range and the reflector's acceptance; an arm of four joints is not turned, but drawn until it is."""
    region = Box([-2.0, -0.6, -0.9], [1.0, 1.0, 1.0])
    views = replace(TARGET, distance=(2.0, far), region=region)
    T = tool_poses(robot, draw(robot, views).readings)
    target = np.einsum("nij,j->ni", T[:, :3, :3], views.target) + T[:, :3, 3]
    away, off = np.linalg.norm(views.station - target, axis=1), angle(views.station - target, T[:, :3, :3] @ views.axis)
    assert len(T) == 100
    assert away.min() >= 2.0 - REACHED
    assert away.max() <= far + REACHED
    assert 0.4 < off.max() <= 0.5 + 1e-8  # to the edge of what it accepts
    assert ((target >= region.lower - REACHED) & (target <= region.upper + REACHED)).all()
