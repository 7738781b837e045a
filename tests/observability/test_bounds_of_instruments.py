"""Bounds of what instruments measure: closed forms, sigmas of calibrations, and errors realised over many draws."""

import numpy as np
import pytest
from instruments import measured_by
from simulated import planar_robot
from tolerances import rounding

from fg_calib import KnownPoint, Measurements, Table, assess, build_problem, solve
from fg_calib.observability.cramer_rao import cramer_rao
from fg_calib.robot.kinematics import pose

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
    bound = cramer_rao(robot, Table(data, "anchor", known={"post": KnownPoint(anchor)}), prior=False)
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
    """Which has it at the estimate, where rows are nearly linear: some percent of a sigma."""
    robot, true, table = measured_by(instrument, np.random.default_rng(3), sigma_joint=1e-4)
    found = assess(solve(build_problem(robot, table)))
    bound = cramer_rao(true, table)
    scale = np.sqrt(np.diag(bound.covariance))
    assert bound.names == found.names
    assert (found.covariance - bound.covariance) / np.outer(scale, scale) == pytest.approx(0.0, abs=0.05)
