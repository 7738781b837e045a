"""`check` and `update` of rows of every instrument: p-values, slips and updates."""

import pytest
from month import OF_INSTRUMENTS, months_of
from scenarios import SIGMA, TOLERANCE
from scipy import stats
from simulated import small_arm

from fg_calib import Noise, calibrate
from fg_calib.diagnostics import LIKE_NOISE
from fg_calib.simulation.scenario import Errors

FEW = ("anchors", "stations", "offset")
"""Instruments of which months are drawn quickly."""


def likely(check):
    return [e for e in check.explanations if e.likely]


@pytest.mark.slow
@pytest.mark.parametrize("kind", FEW)
def test_p_values_of_healthy_arms_are_uniform(kind):
    """12 draws: a Kolmogorov-Smirnov test is below 1e-3 once in 1000 test runs; nor is any said to have changed."""
    p = []
    for seed in range(12):
        robot, _, old, new = months_of(kind, seed)
        found = calibrate(robot, old).check(new)
        p.append(found.p_value)
        assert not likely(found)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", FEW)
def test_a_slip_is_found_and_the_joint_is_among_what_may_have_changed(kind):
    robot, _, old, new = months_of(kind, 1, slip={"theta2": 5e-3})
    found = calibrate(robot, old).check(new)
    assert found.verdict == "fail"
    assert any("theta2" in (*e.parameters, *e.same) for e in likely(found))


def finer(by):
    """Scenarios with noise, tolerances and errors that are smaller."""
    sigma = {name: by * getattr(SIGMA, name) for name in ("distance", "angle", "point", "pixel")}
    tolerance = {kind: by * size for kind, size in TOLERANCE.items()}
    return {
        "robot": small_arm(tolerance=tolerance),
        "noise": Noise(by * SIGMA.position, by * SIGMA.orientation, 0.0, **sigma),
        "errors": Errors("normal", {kind: size for kind, size in tolerance.items() if kind != "tool"}),
    }


def test_touches_of_an_update_are_no_effect():
    """Touched points turn by an angle times their residuals, and effects by multiples of that."""
    robot, _, old, new = months_of("contact", 0, **finer(1e-3))
    assert calibrate(robot, old).update(new).assessed[1].verdict.systematic.p_value > LIKE_NOISE


@pytest.mark.slow
@pytest.mark.parametrize("kind", OF_INSTRUMENTS)
def test_an_update_is_a_calibration_of_all_rows_whatever_the_instrument(kind):
    """A thousandth of an instrument's noise: what linearising loses is up to 3e-2 sigma at its noise (planes), in
    proportion to it."""
    robot, _, old, new = months_of(kind, 0, **finer(1e-3))
    updated, batch = calibrate(robot, old).update(new), calibrate(robot, [*old, *new])
    for name in batch.result.covariance.names:
        one, other = updated.parameters[name], batch.parameters[name]
        assert one.identifiability == other.identifiability
        assert abs(one.estimate - other.estimate) < 1e-4 * other.sigma
        assert one.sigma == pytest.approx(other.sigma, rel=1e-5)
