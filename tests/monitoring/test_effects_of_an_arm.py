"""An arm with effects a month later: a stiffness that changed is named, and error curves stay as they were."""

import numpy as np
import pytest
from simulated import arm_with, measure_points, with_changes, within_tolerance

from fg_calib import calibrate
from fg_calib.robot import Compliance, ErrorCurve, Mass

EFFECTS = (ErrorCurve([2, 3], knots=12, sigma=1e-3), Compliance([Mass(3, 20.0, (0.2, 0.0, 0.1))], [2, 3]))


def measured(robot, n, rng):
    return measure_points(robot, rng.uniform(-2.5, 2.5, (n, 4)), rng, sigma=5e-5)


@pytest.fixture(scope="module")
def month():
    """The calibration, the arm with joint 3 softer by 50 urad/(N m), and its measurements."""
    rng = np.random.default_rng(3)
    robot = arm_with(*EFFECTS)
    true = within_tolerance(robot, rng)
    calibration = calibrate(robot, measured(true, 80, rng), model="position", gauge="prior")
    return calibration, true, with_changes(true, **{"theta3.compliance": 5e-5}), rng


def test_a_stiffness_that_changed_is_named(month):
    calibration, true, softer, rng = month
    assert calibration.check(measured(true, 25, rng)).verdict == "pass"
    check = calibration.check(measured(softer, 25, rng))
    first = check.explanations[0]
    assert (check.verdict, first.parameters) == ("fail", ("theta3.compliance",))
    assert first.change[0] == pytest.approx(5e-5, abs=4.0 * first.sigma[0])


def test_an_update_keeps_error_curves_and_finds_the_stiffness(month):
    calibration, _, softer, rng = month
    updated = calibration.update(measured(softer, 40, rng), changed=["theta3.compliance"])
    assert updated.trustworthy
    found, before = updated.parameters, calibration.parameters
    curves = [p.name for p in before.values() if ".curve[" in p.name]
    assert [found[name].estimate for name in curves] == [before[name].estimate for name in curves]
    true = softer.nominal[softer.index("theta3.compliance")]
    assert found["theta3.compliance"].estimate == pytest.approx(true, abs=4.0 * found["theta3.compliance"].sigma)
