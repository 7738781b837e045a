"""A kind of parameter is data: a gain of joints added to the table is calibrated, observed and shown in its unit."""

import re

import numpy as np
import pytest

from fg_calib import InputError, Measurements, Options, calibrate, observe_structure
from fg_calib.io import Units, quantity
from fg_calib.robot import PARAMETER_KINDS, Joint, Parameter, RobotBuilder, pose
from fg_calib.robot.model import BASES, ParameterKind

ROWS = {"q1": (0.0, 0.5, 0.4), "q2": (0.5, 0.1, 0.0), "q3": (0.3, 0.2, 0.0)}  # a, alpha, d


@pytest.mark.parametrize("name", BASES)
def test_slopes_of_functions_of_a_reading_are_their_differences(name):
    (function, slope), q, h = BASES[name], np.linspace(-3.0, 3.0, 8), 1e-6
    assert slope(q) == pytest.approx((function(q + h) - function(q - h)) / (2.0 * h), abs=1e-8)


@pytest.fixture
def arm(monkeypatch):
    """An arm whose joints have gains, the second joint sliding."""
    monkeypatch.setitem(PARAMETER_KINDS, "gain", ParameterKind("1"))
    builder = RobotBuilder("arm", "mdh-hayati")
    for name, (a, alpha, d) in ROWS.items():
        joint = Joint(name, name == "q2", -1.0, 1.0)
        builder.add_convention_joint(joint, {"a": a, "alpha": alpha, "d": d, "theta": 0.1, "beta": 0.2})
        builder.add_effect("gain", "reading")
    builder.add_frame("tool", {"x": 0.2}, 4, False)
    return builder.build(tolerance={"a": 1e-3, "gain": 1e-3})


def with_gains(arm, gains):
    """The same arm with other gains."""
    values = arm.nominal
    values[[p.kind == "gain" for p in arm.parameters]] = gains
    return arm.with_values(values)


def test_a_gain_multiplies_its_joints_reading(arm):
    q, gains = np.array([[0.7, -0.4, 0.9]]), np.array([0.1, 0.2, -0.3])
    found, expected = pose(with_gains(arm, gains), q), pose(arm, (1.0 + gains) * q)
    assert found.position == pytest.approx(expected.position, abs=1e-14)  # rounding of lengths of 1 m
    assert found.rotation == pytest.approx(expected.rotation, abs=1e-14)


def test_a_gain_is_calibrated_and_shown_in_parts_in_a_million(arm):
    gains = np.array([2e-3, -1e-3, 5e-4])
    arm = arm.with_estimated(["q1.gain", "q2.gain", "q3.gain", "a2"])
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    at = pose(with_gains(arm, gains), q)
    measured = Measurements.from_arrays(q, position=at.position, sigma_position=1e-6)
    calibration = calibrate(arm, measured, Options(model="position"))
    found = calibration.parameters
    assert [found[f"{name}.gain"].estimate for name in ROWS] == pytest.approx(gains, abs=1e-6)  # priors pull by less
    assert (found["q1.gain"].unit, found["a2"].unit) == ("1", "m")
    assert re.search(r"q1\.gain +2000\.0 .* ppm ", str(calibration))
    assert observe_structure(arm, model="position").with_fixed_known.observability.rank == 4


def test_units_of_a_gain_in_files_and_options():
    assert quantity("100 ppm", "1", None, "growth") == pytest.approx(1e-4)
    assert (Units("mm", "deg").name("1"), Units("mm", "deg").factor("1")) == ("1", 1.0)
    with pytest.raises(InputError, match=r"growth: 3; give a unit, such as 3ppm"):
        quantity("3", "1", None, "growth")


@pytest.mark.parametrize(("name", "kind"), [("q1.spring", "spring"), ("q1.shift", "yaw")])
def test_an_unknown_kind_and_a_name_that_hides_it_are_one_line(name, kind):
    with pytest.raises(InputError, match=rf"parameter '{name}': kind '{kind}', expected a name that ends in its kind"):
        Parameter(name, kind, 1, 0.0)
