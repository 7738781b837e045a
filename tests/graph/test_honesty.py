"""Errors are as large as sigmas say: NEES and chi-square over many draws."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from scipy.spatial.transform import Rotation
from simulated import measure, nees, paper_robot, small_arm, true_robot
from touches import TOLERANCE as TOUCH_TOLERANCE
from touches import TOOL_POINT, corners, reach, touch

from fg_calib import KnownPoint, Measurements, Pairing, Table, assess, build_problem, calibrate, solve
from fg_calib.robot.kinematics import pose

TOLERANCE = dict.fromkeys(("a", "d", "alpha", "theta"), 2e-3)


def poses(rng, *, joint=3e-4, n=20, wrong=0):
    robot = small_arm(TOLERANCE)
    true = true_robot(robot, rng)
    m = measure(true, n, rng, sigma=(1e-3, 5e-4), sigma_joint=joint)
    off = np.zeros((n, 3))
    off[1 : wrong + 1] = 0.05
    return robot, true, replace(m, position=m.position + off)


def left_out(rng):
    """An arm of parallel axes, of whose parameters the gauge leaves some at nominal."""
    robot = paper_robot(dict.fromkeys(("a", "d", "alpha", "theta", "beta"), 1e-3))
    true = true_robot(robot, rng)
    return robot, true, measure(true, 30, rng, sigma=(2e-4, 1e-4))


def small_motions(rng):
    """Poses near each other, whose noise is another one along each axis: lengths and angles are nonlinear in it."""
    robot, sigma = small_arm(TOLERANCE), np.array([6e-4, 3e-3, 1.2e-3])
    true = true_robot(robot, rng)
    q = rng.uniform(-1.0, 1.0, (1, 4)) + rng.uniform(-0.1, 0.1, (30, 4))
    m = measure(true, 30, rng, sigma=(0.0, 0.0), readings=q)
    noise = Rotation.from_rotvec(sigma * rng.normal(size=(30, 3))).as_matrix()
    sigmas = {"sigma_position": np.tile(sigma, (30, 1)), "sigma_orientation": np.tile(sigma, (30, 1))}
    position = m.position + sigma * rng.normal(size=(30, 3))
    return robot, true, replace(m, position=position, rotation=m.rotation @ noise, **sigmas)


def touches(rng):
    robot = small_arm(TOUCH_TOLERANCE, TOOL_POINT)
    true = true_robot(robot, rng)
    return robot, true, touch(true, corners(true, 3, rng), 6, rng, distances=((0, 1, 1e-4),), sigma_joint=3e-4)


PAIRS = {"model": "distance-rotation"}
CASES = {
    "poses, joint values": (poses, {"joint": 2e-3}, {"model": "pose", "encoder": "estimated"}),
    "poses": (poses, {}, {"model": "pose"}),
    "star": (poses, {}, PAIRS),
    "all pairs": (poses, {}, PAIRS | {"pairing": Pairing("all")}),
    "all pairs of small motions": (small_motions, {}, PAIRS | {"pairing": Pairing("all")}),
    "gauge keep": (left_out, {}, PAIRS | {"gauge": "keep"}),
    "touches": (touches, {}, {"model": "distance"}),
    "gnc with outliers": (poses, {"n": 40, "wrong": 4, "joint": 0.0}, {"model": "pose", "loss": "gnc"}),
    **{name: (lambda rng, name=name: measured_by(name, rng, sigma_joint=5e-4), {}, {})
       for name in ("targets", "anchors", "planes", "board")},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize("name", CASES)
def test_errors_and_residuals_are_as_large_as_said(name):
    """The mean of 20 draws, each within four of its own sigmas."""
    make, how, options = CASES[name]
    squares, value, expected = [], 0.0, 0.0
    for seed in range(20):
        robot, true, measurements = make(np.random.default_rng(100 + seed), **how)
        found = assess(solve(build_problem(robot, measurements, **options)))
        square, n = nees(found, true)
        squares.append(square / n)
        value, expected = value + found.fit.chi_square.value, expected + found.fit.chi_square.expected
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n / len(squares)))
    assert value / expected == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / expected) + 0.05)


def test_short_lengths_to_an_anchor_leave_the_offset_unbiased():
    """Joint noise of a tenth of the length lengthens it by a hundredth: 1.6 sigma of the offset of 100 rows.

    A mean of 6 draws has a sigma of 0.4 of that of one.
    """
    robot, off = small_arm(tolerance=dict.fromkeys(("a", "d", "alpha", "theta"), 1e-5)), []
    anchor = pose(robot, np.array([[0.3, 0.4, 0.2, 0.5]])).position[0]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        q = reach(robot, anchor + 0.05 * Rotation.random(100, random_state=seed).as_matrix()[:, 0], rng)
        sigma = 0.005 * np.sqrt(3.0 / np.mean(np.sum(pose(robot, q).jacobian[:, 3:, -4:] ** 2, axis=(1, 2))))
        at = pose(robot, q + sigma * rng.normal(size=q.shape)).position
        lengths = np.linalg.norm(at - anchor, axis=1) + 1e-5 * rng.normal(size=100)
        m = Measurements.from_arrays(q, anchor=["a"] * 100, distance=lengths, sigma_distance=1e-5, sigma_joint=sigma)
        found = calibrate(robot, Table(m, "anchor", known={"a": KnownPoint(anchor)}, offset=True))
        off += [one.xyz[0] / one.sigma[0] for one in found.result.groups if one.kind == "offset"]
    assert abs(np.mean(off)) < 0.9
