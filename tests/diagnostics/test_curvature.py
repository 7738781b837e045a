"""Rows that bend within what they leave unknown: by second differences written out, and by true errors."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import small_arm, true_robot

from fg_calib import Measurements, Robot, calibrate, pose
from fg_calib.diagnostics import linearity as curvature
from fg_calib.diagnostics.linearity import Curvature, beyond_linear
from fg_calib.diagnostics.verdict import of_curvature
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.statistics.covariance import spread_of

WIDE = {"a": 1e-2, "d": 1e-2, "alpha": 1e-2, "theta": 1e-2}
SAID = "bend within what they leave unknown"


def measured(true, n, sigma, rng, *, rotation=False):
    q = rng.uniform(-2.0, 2.0, (n, 4))
    at = pose(true, q)
    turned = at.rotation @ Rotation.from_rotvec(sigma * rng.normal(size=(n, 3))).as_matrix()
    more = {"rotation": turned, "sigma_orientation": sigma} if rotation else {}
    return Measurements.from_arrays(
        q, position=at.position + sigma * rng.normal(size=(n, 3)), sigma_position=sigma, **more
    )


def calibrated(n, sigma, seed, *, model="position", tolerance=WIDE):
    rng, robot = np.random.default_rng(seed), small_arm(tolerance)
    true = true_robot(robot, rng)
    found = calibrate(robot, measured(true, n, sigma, rng, rotation=model == "pose"), model=model, frame="known")
    return found, true


def squared_error(found, true):
    """Squared error of the estimate in sigma, by direction of its covariance."""
    solution, assessed = found.assessed
    spread = assessed.spread
    inverse = np.linalg.pinv(spread.root[:, : spread.rank] / spread.variables.prior_scales[:, None], rcond=1e-14)
    off = true.nominal - solution.parameters[solution.problem.variables.robot_span]
    estimated = [i for i, p in enumerate(true.parameters) if p.estimated]
    return float(np.mean((inverse @ (off[estimated] / spread.variables.prior_scales)) ** 2))


def said(found):
    return [text for text in (*found.result.findings, *found.result.cautions) if SAID in text]


def by_second_differences(found, m, sigma, rng, n_draws):
    """Mean of |R^T J^T q|^2, q what positions are beyond linear at draws R z, J by differences."""
    robot, spread = found.robot, found.assessed[1].spread
    names = [i for i, p in enumerate(robot.parameters) if p.estimated]
    root = spread.root[:, : spread.rank]

    def rows(change):
        values = robot.nominal.copy()
        values[names] += change
        return pose(robot.with_values(values), m.readings).position.ravel() / sigma

    steps = 1e-6 * np.eye(len(names))
    J = np.array([(rows(h) - rows(-h)) / 2e-6 for h in steps]).T
    bent = []
    for change in rng.normal(size=(n_draws, spread.rank)) @ root.T:
        q = 0.5 * (rows(change) + rows(-change)) - rows(np.zeros(len(names)))
        bent.append(np.mean((root.T @ (J.T @ q)) ** 2))
    return np.mean(bent)


@pytest.mark.parametrize("sigma", [1e-5, 1e-4])
def test_it_is_what_second_differences_say(monkeypatch, sigma):
    """Both are means over 400 draws of a sum of squares of squares, whose own spread is some 2 of its mean."""
    monkeypatch.setattr(curvature, "N_DRAWS", 400)
    monkeypatch.setattr(curvature, "NONE", 0.0)
    found, _ = calibrated(3, sigma, 1)
    m = found.assessed[0].problem.data.tables[0].measurements
    expected = by_second_differences(found, m, sigma, np.random.default_rng(5), 400)
    assert beyond_linear(found.assessed[0], found.assessed[1].spread).sums == pytest.approx(expected, rel=0.4)


@pytest.mark.slow
def test_it_grows_as_the_square_of_the_tolerances_over_the_noise(monkeypatch):
    """Along what no row tells the spread is the tolerance whatever the noise: ten times less is a hundredfold.

    Draws are along a basis that rounding turns, so each figure scatters by 2 / sqrt(400), and their ratio by 0.14.
    """
    monkeypatch.setattr(curvature, "N_DRAWS", 400)
    of = [beyond_linear(*_judged(calibrated(3, sigma, 1)[0])).sums for sigma in (1e-5, 1e-6)]
    assert of[1] / of[0] == pytest.approx(100.0, rel=0.5)


def _judged(found):
    return found.assessed[0], found.assessed[1].spread


def test_fewer_rows_say_the_same(monkeypatch):
    """Two joints stand still, so that 400 rows leave much to tolerances; 150 of them see some 5 % else of it."""
    rng, robot = np.random.default_rng(2), small_arm(WIDE)
    true = true_robot(robot, rng)
    q = rng.uniform(-2.0, 2.0, (400, 4))
    q[:, 1:3] = 0.4
    position = pose(true, q).position + 1e-5 * rng.normal(size=(400, 3))
    m = Measurements.from_arrays(q, position=position, sigma_position=1e-5)
    judged = _judged(calibrate(robot, m, model="position", frame="known"))
    whole = beyond_linear(*judged).sums
    monkeypatch.setattr(curvature, "ENOUGH_ROWS", 450)
    assert whole > 1.0
    assert beyond_linear(*judged).sums == pytest.approx(whole, rel=0.3)


def test_sums_alone_are_a_caution_that_more_configurations_end():
    few, _ = calibrated(3, 1e-5, 1)
    assert re.search("errors of sums of parameters are some .* times what the covariance says", said(few)[0])
    assert said(few)[0] in few.result.cautions
    assert few.result.reservations == ()
    assert few.result.trustworthy
    enough, _ = calibrated(12, 1e-5, 1)
    assert not said(enough)


def test_what_rows_cannot_tell_spoils_no_result_of_many_precise_ones():
    """The tool point and the last joint stand for each other; where the tool is is known to a part of a micrometre."""
    rng, robot = np.random.default_rng(1), small_arm(WIDE, estimate=["tool.x", "tool.y", "tool.z"])
    true = true_robot(robot, rng)
    found = calibrate(robot, measured(true, 300, 1e-6, rng), model="position", frame="known")
    beyond = beyond_linear(*_judged(found))
    assert beyond.sums > 100.0
    assert beyond.parameter < 0.2
    assert abs(beyond.tool) < 0.2  # without what keeps the arm on the bent surface some 700
    assert not found.result.findings
    q = rng.uniform(-2.0, 2.0, (60, 4))
    off = pose(found.robot, q).position - pose(true, q).position
    # A mean square of some 20 directions: twice as much, or a third, is beyond three of its standard errors.
    assert 0.3 < np.mean(off**2) / np.mean(found.predict(q).sigma_position ** 2) < 2.0


@pytest.mark.parametrize(
    ("beyond", "finding", "reservation", "words"),
    [
        (Curvature(0.9, 0.1, 0.1), None, None, ""),
        (Curvature(3.0, 0.1, 0.1), False, False, "errors of sums of parameters are some 2 times"),
        (Curvature(3.0, 0.44, 0.1, "a2"), False, True, "errors of a2 are some 1.2 times what its sigma says"),
        (Curvature(3.0, 8.0, 0.1), False, True, "errors of a frame are some 3 times what its sigma says"),
        (Curvature(3.0, 0.1, 3.0), True, True, "the tool's errors are some 2 times what sigmas say"),
        (Curvature(np.inf, np.inf, np.inf), True, True, "the tool's errors are many times what sigmas say"),
    ],
)
def test_what_is_affected_makes_the_verdict(beyond, finding, reservation, words):
    found = of_curvature(beyond)
    assert [(s.finding, s.reservation) for s in found] == ([] if finding is None else [(finding, reservation)])
    assert all(words in s.text for s in found)


@pytest.mark.slow
@pytest.mark.long
def test_errors_of_the_tool_are_honest_where_those_of_sums_are_not():
    """100 arms, each by 3 positions of 0.01 mm: mean squares, within 4 standard errors."""
    q = np.random.default_rng(9).uniform(-2.0, 2.0, (60, 4))
    ratios = []
    for seed in range(100):
        found, true = calibrated(3, 1e-5, 2000 + seed)
        off = pose(found.robot, q).position - pose(true, q).position
        ratios.append(np.mean(off**2) / np.mean(found.predict(q).sigma_position ** 2))
    error = np.std(ratios) / np.sqrt(len(ratios))
    assert abs(np.mean(ratios) - 1.0) < 4.0 * error, (np.mean(ratios), error)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("n", "sigma", "model"), [(3, 1e-5, "position"), (3, 1e-4, "position"), (2, 3e-5, "pose")])
def test_true_errors_are_beyond_their_covariance_by_as_much(monkeypatch, n, sigma, model):
    """200 arms: means agree within four of their standard errors, or a quarter.

    Of 100 draws: all arms have the same ones, so that their scatter of 2 / sqrt(n) does not go with the arms.
    """
    monkeypatch.setattr(curvature, "N_DRAWS", 100)
    seen, expected = [], []
    for seed in range(200):
        found, true = calibrated(n, sigma, 1000 + seed, model=model)
        seen.append(squared_error(found, true))
        expected.append(1.0 + beyond_linear(*_judged(found)).sums)
    error = float(np.hypot(np.std(seen), np.std(expected)) / np.sqrt(len(seen)))
    assert abs(np.mean(seen) - np.mean(expected)) < max(4.0 * error, 0.25 * np.mean(expected)), (
        np.mean(seen),
        np.mean(expected),
    )


def test_what_bends_of_a_frame_is_named_as_it_is_reported():
    """A frame's columns are its turns, then its shifts; its names are x, y, z, yaw, pitch, roll. A shift bends here."""
    rows = [
        *([0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, 0.0, 0.1, 0.0]),
        *([0.0, np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.05, 0.0]),
    ]
    tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
    robot = Robot.from_dh(rows, types=["prismatic"] * 3 + ["revolute"] * 2, tolerance=tolerance)
    rng, sigma, world = np.random.default_rng(0), 1e-6, Rotation.from_euler("xyz", [0.3, 0.2, 0.5])
    true, q = true_robot(robot, rng), rng.uniform([0.0, 0.0, 0.0, -2.0, -2.0], [1.0, 1.0, 1.0, 2.0, 2.0], (400, 5))
    at = pose(true, q)
    noise = Rotation.from_rotvec(sigma * rng.normal(size=(400, 3))).as_matrix()
    position = at.position @ world.as_matrix().T + sigma * rng.normal(size=(400, 3))
    measured = {"position": position, "rotation": world.as_matrix() @ at.rotation @ noise}
    m = Measurements.from_arrays(q, **measured, sigma_position=sigma, sigma_orientation=sigma)
    solution = solve(build_problem(robot, m, model="pose", frame="unknown"))
    assert beyond_linear(solution, spread_of(solution)).name in ("frame.x", "frame.y", "frame.z")
