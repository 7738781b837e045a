"""Reaching: held to 4x4 products and, where a pose is out of reach, to scipy's own optimum."""

import numpy as np
import pytest
from oracle import tool_pose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from simulated import small_arm

from fg_calib.robot.inverse import REACHED
from fg_calib.robot.reaching import misses, reach

NEAR = np.array([0.3, -0.4, 0.1, 0.5])


def test_a_pose_out_of_reach_is_reached_at_its_point_with_the_tool_turned_least():
    """Four joints, one to spare at a point: scipy finds no smaller turn on a curve of configurations there."""
    robot, rng = small_arm(), np.random.default_rng(3)
    T = tool_pose(robot, NEAR)
    turned = (Rotation.from_rotvec(0.05 * rng.normal(size=3)) * Rotation.from_matrix(T[:3, :3])).as_matrix()
    found = reach(robot, T[None, :3, 3], turned[None], NEAR[None])
    assert found.miss_position[0] < REACHED
    assert found.miss_rotation[0] > 1e-3

    def turn(q):
        return np.linalg.norm(Rotation.from_matrix(turned @ tool_pose(robot, q)[:3, :3].T).as_rotvec())

    held = {"type": "eq", "fun": lambda q: 1e3 * (tool_pose(robot, q)[:3, 3] - T[:3, 3])}
    best = minimize(turn, NEAR + 1e-3, constraints=held, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500})
    assert found.miss_rotation[0] == pytest.approx(turn(found.readings[0]), abs=1e-12)
    assert found.miss_rotation[0] <= best.fun + 1e-7  # SLSQP's own accuracy, by finite differences


def test_what_can_be_reached_is_reached_and_what_cannot_is_missed_by_what_is_said():
    robot = small_arm()
    T = tool_pose(robot, NEAR)
    far = np.array([30.0, 0.0, 0.0])
    found = reach(robot, np.array([T[:3, 3], far]), np.array([T[:3, :3]] * 2), np.array([NEAR + 0.05] * 2))
    assert found.reached.tolist() == [True, False]
    assert found.miss_position[1] == pytest.approx(np.linalg.norm(far - tool_pose(robot, found.readings[1])[:3, 3]))
    off, turned = misses(robot, found.readings, np.array([T[:3, 3], far]), None)
    assert off == pytest.approx(found.miss_position, abs=1e-12)
    assert (turned == 0.0).all()
