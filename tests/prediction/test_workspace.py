"""Expected errors over the workspace."""

import numpy as np
import pytest
from simulated import measure, small_arm, true_robot
from tolerances import rounding

from fg_calib import calibrate
from fg_calib.prediction import workspace
from fg_calib.prediction.tool_pose import ToolPoseUncertainty, errors_at
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Joint, RobotBuilder

LARGE = {"a": 0.01, "d": 0.01, "alpha": 0.01, "theta": 0.01}


@pytest.fixture(scope="module")
def calibrated():
    rng = np.random.default_rng(1)
    robot = small_arm(tolerance=LARGE, estimate=("tool.x", "tool.y", "tool.z"))
    m = measure(true_robot(robot, rng), 60, rng, sigma=(1e-4, 1e-4))
    return calibrate(robot, m, model="pose"), m


def survey_at(calibrated, readings, monkeypatch, **options):
    result, m = calibrated
    monkeypatch.setattr(workspace, "random_readings", lambda *_: readings)
    return surveyed(result, m.readings, **options)


def surveyed(result, readings, **options):
    return workspace.survey(result.robot, ToolPoseUncertainty.of(result.posterior, readings), readings, **options)


def test_errors_in_the_base_frame_are_those_of_predicted_poses(calibrated, monkeypatch):
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (20, calibrated[0].robot.n_joints))
    found = survey_at(calibrated, q, monkeypatch, fitted=False)
    predicted = calibrated[0].predict(q)
    expected = np.sqrt(np.sum(predicted.sigma_position**2, axis=1))
    assert found.error == pytest.approx(expected, rel=1e-9)  # 1e-9: the same sum in another order
    assert found.position == pytest.approx(predicted.position, abs=rounding(predicted.position))


def test_after_the_best_fit_measured_configurations_have_the_error_that_is_expected_there(calibrated, monkeypatch):
    result, m = calibrated
    found = survey_at(calibrated, m.readings, monkeypatch, fitted=True)
    _, fitted = errors_at(result.uncertainty.whole, m.readings)
    assert np.sqrt(np.mean(found.error**2)) == pytest.approx(fitted.position, rel=1e-7)
    assert np.sqrt(np.mean(found.errors.fitted[:, 1] ** 2)) == pytest.approx(fitted.orientation, rel=1e-7)


@pytest.mark.slow
def test_the_best_fit_holds_all_over_the_workspace(calibrated, monkeypatch):
    """Against drawn parameters: points of a drawn arm, brought to the estimate's by the motion of measured points."""
    result, m = calibrated
    q = np.random.default_rng(3).uniform(-3.0, 3.0, (30, result.robot.n_joints))
    found = survey_at(calibrated, q, monkeypatch, fitted=True)
    rng, squares, n = np.random.default_rng(4), np.zeros(len(q)), 1500
    names = [p.name for p in result.robot.parameters if p.estimated]
    C = result.covariance(names)
    columns = [[p.name for p in result.robot.parameters].index(name) for name in names]
    here, there = pose(result.robot, m.readings).position, pose(result.robot, q).position
    errors = rng.multivariate_normal(np.zeros(len(C)), C, n)
    for error in errors:
        values = result.robot.nominal
        values[columns] += error
        drawn = result.robot.with_values(values)
        a, b = pose(drawn, m.readings).position, pose(drawn, q).position
        U, _, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (here - here.mean(axis=0)))
        R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
        moved = (b - a.mean(axis=0)) @ R.T + here.mean(axis=0)
        squares += np.sum((moved - there) ** 2, axis=1)
    drawn_rms = np.sqrt(squares / n)
    # The RMS of 1500 draws of about 3 degrees of freedom scatters by 1 / sqrt(2 * 1500 * 1) at most: 4 sigma are 7 %.
    assert found.error == pytest.approx(drawn_rms, rel=0.075)


def test_where_nothing_was_measured_is_far(calibrated):
    result, m = calibrated
    few = m.readings[:1]
    found = surveyed(result, few, fitted=False, n=500)
    radius = np.linalg.norm(found.position - found.position.mean(axis=0), axis=1).max()
    away = np.linalg.norm(found.position - found.measured[0], axis=1)
    assert np.array_equal(found.far, away > workspace.FAR * radius)
    assert found.far.any()


def test_gaps_are_between_limits_and_readings():
    builder = RobotBuilder("gap", "dh")
    builder.add_convention_joint(
        Joint("swing", lower=-2.0, upper=2.0), {"a": 0.5, "alpha": 0.0, "d": 0.0, "theta": 0.0}
    )
    builder.add_convention_joint(Joint("slide", prismatic=True), {"a": 0.5, "alpha": 0.0, "d": 0.0, "theta": 0.0})
    robot = builder.build()
    q = np.column_stack([np.linspace(-0.5, 1.9, 25), np.linspace(0.1, 0.3, 25)])
    q[10, 1] = 0.9
    rng = np.random.default_rng(0)
    result = calibrate(robot, measure(robot, 25, rng, readings=q), model="pose", gauge="none")
    found = surveyed(result, q, fitted=False, n=200)
    assert found.joints[0].gap == (-2.0, -0.5)
    assert found.joints[1].gap == pytest.approx((0.3, 0.9))
    assert found.joints[1].range == (0.1, 0.9)
    slides = found.position[:, 2]
    assert slides.min() >= 0.1 - 1e-3  # nominal, less what its estimate is off by
    assert slides.max() <= 0.9 + 1e-3
