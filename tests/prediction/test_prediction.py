"""What is expected of a calibrated arm: errors, where they are largest, and what they come from."""

import numpy as np
import pytest
from oracle import central_differences
from refusals import refusal
from simulated import measure, measure_drawn, small_arm, true_robot
from tolerances import rounding

from fg_calib import Robot, build_problem, calibrate, predict, solve
from fg_calib.prediction import ToolPoseUncertainty, errors_at, predict_errors, summed_up, workspace
from fg_calib.robot import pose
from fg_calib.statistics import spread_of

LARGE = {"a": 0.01, "d": 0.01, "alpha": 0.01, "theta": 0.01}
JOINTS = np.array([1e-4, 2e-4, 5e-5, 3e-4])


@pytest.fixture(scope="module")
def calibrated():
    robot = small_arm(tolerance=LARGE)
    m = measure_drawn(robot, 40, seed=1, sigma=(1e-4, 1e-4))
    return calibrate(robot, m, model="pose"), m


@pytest.fixture(scope="module")
def in_unknown_frame():
    """Without priors: nothing says where the base is."""
    rng = np.random.default_rng(2)
    robot = small_arm()
    return calibrate(robot, measure(robot, 40, rng), model="pose", frame="unknown", gauge="none")


def derivatives(robot, names, q):
    """Of the tool's position at a configuration in some parameters, shape (3, n)."""
    every = central_differences(lambda values: pose(robot.with_values(values), [q]).position[0], robot.nominal)
    return every[:, [robot.index(name) for name in names]]


def small(monkeypatch):
    """Few configurations instead of thousands."""
    monkeypatch.setattr(workspace, "N_DRAWN", 300)


def test_given_configurations_have_the_errors_of_predicted_poses(calibrated):
    """In the base frame, position and orientation, against `Calibration.predict`."""
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (20, 4))
    found, poses = predict(calibrated[0], q), calibrated[0].predict(q)
    expected = np.column_stack([np.linalg.norm(s, axis=1) for s in (poses.sigma_position, poses.sigma_rotation)])
    assert not found.fitted
    assert found.expected == pytest.approx(expected, rel=1e-9)  # the same sums in another order
    assert found.errors.position == pytest.approx(poses.position, abs=rounding(poses.position))
    row = int(np.argmax(expected[:, 0]))
    assert found.worst.row == row
    assert found.worst.sigma**2 @ np.ones(3) == pytest.approx(expected[row, 0] ** 2, rel=1e-9)
    C = poses.covariance[row, :3, :3]
    for axis, sigma in zip(found.worst.axes, found.worst.sigma, strict=True):
        assert C @ axis == pytest.approx(sigma**2 * axis, abs=1e-9 * np.trace(C))
        assert axis[np.argmax(np.abs(axis))] > 0.0


def test_orientations_after_the_best_fit_lack_its_rotation(in_unknown_frame):
    """A turn of the whole arm about its base is no error then: with every point and every orientation it goes."""
    q = np.random.default_rng(4).uniform(-2.0, 2.0, (10, 4))
    found = predict(in_unknown_frame, q)
    assert found.fitted
    assert np.isnan(found.errors.base).all()  # the base may be anywhere: unknown, not 0
    assert np.isfinite(found.errors.fitted).all()
    assert (found.errors.fitted > 0.0).all()
    assert (found.unknown, found.undetermined) == (0.0, ())


def test_joint_noise_moves_the_tool_as_differences_say(calibrated):
    result, m = calibrated
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (6, 4))
    model = ToolPoseUncertainty.of(result.posterior, m.readings, JOINTS)
    step, squares = 1e-6, np.zeros(6)
    for j, sigma in enumerate(JOINTS):
        ahead, behind = (pose(result.robot, q + s * step * np.eye(4)[j]).position for s in (1, -1))
        squares += np.sum(((ahead - behind) / (2 * step) * sigma) ** 2, axis=1)
    found = model.at(q).joint_noise
    assert found[:, 0] == pytest.approx(np.sqrt(squares), rel=1e-7)  # differences of 1e-6: 1e-16 / 1e-6 of a metre
    turning = np.array([not joint.prismatic for joint in result.robot.joints])
    assert found[:, 1] == pytest.approx(np.sqrt(np.sum(JOINTS[turning] ** 2)), rel=1e-12)


def test_drawn_configurations_are_within_the_limits_and_the_worst_is_one_of_them(calibrated, monkeypatch):
    small(monkeypatch)
    found = predict(calibrated[0], limit=1.0)
    assert found.worst.errors.base[0, 0] == np.nanmax(found.expected[:, 0])
    assert (found.worst.row, found.within, found.far.shape) == (None, 1.0, (300,))


def test_where_nothing_was_measured_is_far(calibrated, monkeypatch):
    small(monkeypatch)
    found = predict(calibrated[0], measured=calibrated[1].readings[:1])
    points = found.errors.position
    radius = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    away = np.linalg.norm(points - found.measured[0], axis=1)
    assert np.array_equal(found.far, away > workspace.FAR * radius)
    assert found.far.any()


def test_a_slide_without_limits_is_drawn_within_a_metre():
    robot = Robot.from_dh([[0.5, 0, 0, 0]] * 2, types=["revolute", "prismatic"], limits=[(-2.0, 2.0), None])
    q = np.column_stack([np.linspace(-0.5, 1.9, 25), np.linspace(0.1, 0.9, 25)])
    result = calibrate(robot, measure(robot, 25, np.random.default_rng(0), readings=q), model="pose", gauge="none")
    slides = predict(result).errors.position[:, 2]
    assert [slides.min(), slides.max()] == pytest.approx([-1.0, 1.0], abs=1e-2)  # of 12 000, and nominal but for noise


def test_what_a_parameter_is_responsible_for_goes_when_it_is_known(calibrated):
    """The covariance conditioned on one parameter, by its own formula."""
    result, _ = calibrated
    q = np.random.default_rng(6).uniform(-2.0, 2.0, (1, 4))
    worst = predict(result, q).worst
    names = [p.name for p in result.robot.parameters if p.estimated]
    C, v = result.covariance(names), derivatives(result.robot, names, q[0])
    before = np.trace(v @ C @ v.T)
    assert worst.responsible
    for one in worst.responsible:
        i = names.index(one.name)
        known = C - np.outer(C[i], C[i]) / C[i, i]
        assert one.share == pytest.approx(1.0 - np.trace(v @ known @ v.T) / before, abs=1e-6)
        along = worst.axes[0] @ v
        assert one.change == pytest.approx(C[i] @ along / np.sqrt(along @ C @ along), rel=1e-5)
    shares = [1.0 - np.trace(v @ (C - np.outer(c, c) / c[i]) @ v.T) / before for i, c in enumerate(C)]
    assert worst.responsible[0].name == names[int(np.argmax(shares))]


def test_errors_over_two_configurations_are_roots_of_mean_squares_and_half_the_length_between(calibrated):
    """The best rigid fit of two points leaves half of what the length between them is off, at each."""
    result, _ = calibrated
    q = np.random.default_rng(8).uniform(-2.0, 2.0, (2, 4))
    names = [p.name for p in result.robot.parameters if p.estimated]
    v, C = [derivatives(result.robot, names, row) for row in q], result.covariance(names)
    between = np.diff(pose(result.robot, q).position, axis=0)[0]
    length = between / np.linalg.norm(between) @ (v[1] - v[0])
    base, fitted = errors_at(result.posterior, q)
    assert base.position == pytest.approx(np.sqrt(np.mean([np.trace(one @ C @ one.T) for one in v])), rel=1e-5)
    assert fitted.position == pytest.approx(0.5 * np.sqrt(length @ C @ length), rel=1e-5)


def test_what_nothing_determines_is_unknown_and_named(monkeypatch):
    """Orientations say nothing of lengths, and no tolerance does."""
    small(monkeypatch)
    rng = np.random.default_rng(7)
    robot = small_arm()
    result = calibrate(robot, measure(robot, 40, rng), model="orientation", gauge="none")
    found = predict(result, limit=1.0)
    assert (found.unknown, found.within, found.worst) == (1.0, 0.0, None)
    assert "a2" in found.undetermined
    assert np.isnan(found.expected[:, 0]).all()
    assert np.isfinite(found.expected[:, 1]).all()


def test_unknown_errors_count_as_larger_than_all_known_ones():
    errors = np.array([1.0, 2.0, np.nan, 1.5, 1.2])
    assert summed_up(errors) == {"rms": None, "median": 1.5, "p95": None, "largest": None}
    assert summed_up(errors[[0, 1]]) == {"rms": np.sqrt(2.5), "median": 2.0, "p95": 2.0, "largest": 2.0}


@pytest.mark.parametrize(("given", "message"), [
    ({"readings": np.zeros((2, 3))}, "readings: shape"),
    ({"readings": np.zeros((0, 4))}, "readings"),
    ({"readings": [[np.nan] * 4]}, "readings"),
    ({"limit": 0.0}, "limit"),
    ({"measured": np.zeros((0, 4))}, "measured"),
])  # fmt: skip
def test_what_cannot_be_used_is_one_line(calibrated, given, message):
    assert message in refusal(predict, calibrated[0], **given)


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["known", "unknown"])
def test_arms_that_were_calibrated_are_as_far_off_as_expected(frame):
    """RMS over drawn arms at fixed configurations and at the worst one; scatter of about two effective degrees each."""
    rng, n = np.random.default_rng(9), 60
    robot = small_arm(tolerance={"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3})
    q = rng.uniform(-2.0, 2.0, (200, 4))
    real, expected = np.zeros((n, 2)), np.zeros((n, 2))
    for k in range(n):
        true = true_robot(robot, rng)
        m = measure(true, 25, rng, sigma=(2e-4, 2e-4))
        solution = solve(build_problem(robot, m, model="pose", frame=frame))
        estimate = robot.with_values(solution.parameters[solution.problem.variables.robot_span])
        found = predict_errors(estimate, spread_of(solution), m.readings, q, fitted=frame == "unknown")
        errors, worst = found.expected[:, 0], found.worst
        off = pose(estimate, q).position - pose(true, q).position
        if frame == "unknown":
            a, b = pose(estimate, m.readings).position, pose(true, m.readings).position
            U, _, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
            R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
            off = (pose(estimate, q).position - a.mean(axis=0)) @ R.T + b.mean(axis=0) - pose(true, q).position
        size = np.sum(off**2, axis=1)
        real[k], expected[k] = (size.mean(), size[worst.row]), (np.mean(errors**2), errors[worst.row] ** 2)
    ratio = np.sqrt(real.mean(axis=0) / expected.mean(axis=0))
    # The square of an error with two degrees of freedom scatters by its mean: half of that over sqrt(n), 4 sigma.
    assert ratio == pytest.approx(np.ones(2), abs=4 * 0.5 / np.sqrt(n))
