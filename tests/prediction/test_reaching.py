"""Reaching: held to 4x4 products and, where a pose is out of reach, to scipy's own optimum."""

import numpy as np
import polars as pl
import pytest
from exported import UR10, scara, seven
from oracle import tool_pose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from simulated import small_arm

from fg_calib import Robot
from fg_calib.io import read_targets
from fg_calib.prediction import correction
from fg_calib.prediction.correction import reach
from fg_calib.robot import REACHED, Thermal, pose, random_readings

NEAR = np.array([0.3, -0.4, 0.1, 0.5])


def test_a_pose_out_of_reach_is_reached_at_its_point_with_the_tool_turned_least(monkeypatch):
    """Four joints, one to spare at a point: scipy finds no smaller turn on a curve of configurations there."""
    monkeypatch.setattr(correction, "_N_NEAR", 1)
    monkeypatch.setattr(correction, "N_STARTS", 1)  # in vain, as it is out of reach
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


UR = Robot.from_dh([row[:4] for row in UR10], "dh", limits=[[-np.pi, np.pi]] * 6)
ARMS = {"seven joints": seven(), "UR10": UR, "SCARA": scara([-np.pi, np.pi])}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ARMS)
def test_no_target_that_can_be_reached_is_missed_although_nobody_says_from_where(name):
    """Of 2000 of a UR10 nine were missed: its middle is stretched, and starts about that fold it one way."""
    robot = ARMS[name]
    q = random_readings(robot, 2000, np.random.default_rng(7))
    at = pose(robot, q)
    middle = np.tile(robot.limits.mean(axis=1), (2000, 1))
    assert reach(robot, at.position, at.rotation, middle, anywhere=True).reached.all()
    assert reach(robot, at.position, None, middle, anywhere=True).reached.all()


def test_targets_are_reached_at_the_temperature_of_their_rows():
    """By the arm whose lengths are those of that temperature, one part of a table warm, the other cold."""
    warm = UR.with_effects(Thermal())
    values = warm.nominal.copy()
    values[[p.kind.startswith("expansion") for p in warm.parameters]] = 2e-5
    q = 0.4 * random_readings(UR, 4, np.random.default_rng(3))
    at, temperature = pose(UR, q), np.array([10.0, 45.0, 45.0, 10.0])
    columns = {**dict(zip("xyz", at.position.T, strict=True)), "temperature": temperature}
    found = read_targets(pl.DataFrame(columns), warm).context
    reached = reach(warm.with_values(values), at.position, at.rotation, q, found)
    for row, T, point in zip(reached.readings, temperature, at.position, strict=True):
        grown = [[a * (1 + 2e-5 * (T - 20)), alpha, d * (1 + 2e-5 * (T - 20)), z] for a, alpha, d, z, *_ in UR10]
        assert tool_pose(Robot.from_dh(grown, "dh"), row)[:3, 3] == pytest.approx(point, abs=1e-9)
        assert np.linalg.norm(tool_pose(UR, row)[:3, 3] - point) > 1e-5
