"""Bounds of what instruments measure: closed forms, sigmas of calibrations, and errors realised over many draws."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from scenarios import INSTRUMENTS, scenario
from simulated import planar_robot
from tolerances import rounding

from fg_calib import Measurements, Table, assess, build_problem, cramer_rao, simulate, solve
from fg_calib.robot.kinematics import pose
from fg_calib.simulation.scenario import LengthGauge, Tracker

SIGMA = 1e-4


def test_a_length_seen_by_a_wire_has_the_share_of_its_direction():
    """The tool moves by cos of the angle to the wire along it when the first link grows by 1."""
    robot = planar_robot().with_estimated(["a1"])
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (9, 2))
    at, anchor = pose(robot, q).position, np.array([3.0, 2.0, 1.0])
    away = at - anchor
    length = np.linalg.norm(away, axis=1)
    data = Measurements.from_arrays(q, anchor=["post"] * 9, distance=length, sigma_distance=SIGMA)
    along = np.column_stack([np.cos(q[:, 0]), np.sin(q[:, 0]), np.zeros(9)])
    share = np.sum(along * away, axis=1) / length
    bound = cramer_rao(robot, Table(data, "anchor", known={"post": anchor}), prior=False)
    assert bound.covariance[0, 0] == pytest.approx(SIGMA**2 / np.sum(share**2), rel=rounding(1, 10), abs=0)
    # Of an anchor that nobody knows less is left: its three coordinates are projected out.
    J = np.column_stack([share, -away / length[:, None]])
    expected = SIGMA**2 * np.linalg.inv(J.T @ J)[0, 0]
    unknown = cramer_rao(robot, Table(data, "anchor"), prior=False)
    assert unknown.covariance[0, 0] == pytest.approx(expected, rel=1e-6)


MEASURED = ["targets known", "targets stations", "anchors offset", "targets", "board", "planes", "pixels"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("instrument", MEASURED)
def test_the_bound_is_what_a_calibration_of_the_table_says(instrument):
    """Which has it at the estimate, where noise bends little: some percent of a sigma."""
    robot, true, table = measured_by(instrument, np.random.default_rng(3), sigma_joint=1e-4)
    found = assess(solve(build_problem(robot, table)))
    bound = cramer_rao(true, table)
    scale = np.sqrt(np.diag(bound.covariance))
    assert bound.names == found.names
    assert (found.covariance - bound.covariance) / np.outer(scale, scale) == pytest.approx(0.0, abs=0.05)


WAYS = {
    "targets from two stations": [replace(INSTRUMENTS["targets"], stations=2)],
    "three wires with an offset": [LengthGauge(name="it", offset=0.1)],
    "planes": [INSTRUMENTS["planes"]],
    "faces": [INSTRUMENTS["faces"]],
    "a board": [INSTRUMENTS["board"]],
    "pixels": [INSTRUMENTS["pixels"]],
    "sockets": [INSTRUMENTS["sockets"]],
    "pairs": [INSTRUMENTS["pairs"]],
    "a tracker and a wire": [Tracker(model="position", name="tracker", targets=2), LengthGauge(name="wire")],
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.long
def test_realised_errors_are_those_of_the_bound(way):
    """Root of the mean of e^T C^-1 e over its expectation, within 3.3 sigma; 120 draws of each kept within 5 %."""
    base = scenario(*WAYS[way], n=60 if way in ("a board", "pixels") else 30)
    squares, n = [], 0
    for seed in range(30):
        s = simulate(replace(base, noise=replace(base.noise, joint=1e-4)), seed)
        bound = cramer_rao(s.true_robot, s.tables)
        rows = [s.robot.index(name) for name in bound.names]
        error = solve(build_problem(s.robot, s.tables)).parameters[rows] - s.true_robot.nominal[rows]
        squares.append(error @ np.linalg.solve(bound.covariance, error))
        n = len(rows)
    assert np.sqrt(np.mean(squares) / n) == pytest.approx(1.0, abs=3.3 * 0.5 * np.sqrt(2.0 / (n * len(squares))))
