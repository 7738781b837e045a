"""`check` and `update` of rows of every instrument: p-values, slips, updates, and what to measure next."""

from dataclasses import replace

import numpy as np
import pytest
from month import OF_INSTRUMENTS, months_of
from scenarios import SIGMA, TOLERANCE
from scipy import stats
from simulated import small_arm

from fg_calib import calibrate
from fg_calib.measurements.dataset import Noise
from fg_calib.monitoring import candidates
from fg_calib.monitoring.new_data import linear, linearised, placed
from fg_calib.simulation.scenario import Errors

UNADVISED = ("contact", "faces", "sockets")
"""Nobody touches anything at random configurations."""


def likely(check):
    return [e for e in check.explanations if e.likely]


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kind", OF_INSTRUMENTS)
def test_p_values_of_healthy_arms_are_uniform(kind):
    """25 draws: a Kolmogorov-Smirnov test is below 1e-3 once in 1000 test runs; nor may more than 1 be said to have
    changed, which is 1 of 1000 draws by `CERTAIN`."""
    p, changed = [], 0
    for seed in range(25):
        robot, _, old, new = months_of(kind, seed)
        found = calibrate(robot, old).check(new)
        p.append(found.p_value)
        changed += bool(likely(found))
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert changed <= 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", OF_INSTRUMENTS)
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


def candidates_of(kind):
    """The calibrated arm's rows of a month, and the candidates for them."""
    robot, _, old, new = months_of(kind, 2)
    calibration = calibrate(robot, old)
    rows, _ = calibration._rows(new, None, None)
    at = linear(calibration.calibrated, placed(calibration.calibrated, rows, calibration.calibrated.values))
    return at, candidates.candidates(at)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(OF_INSTRUMENTS.keys() - set(UNADVISED)))
def test_columns_of_candidates_are_differences_of_their_residuals(kind):
    """With the arm, frame and whatever else the rows have fitted moved by a little, at the same measured values."""
    at, found = candidates_of(kind)
    whole = at.placed.problem
    v = whole.variables
    q, table = candidates._drawn(whole, 0)
    step = 1e-7 * np.random.default_rng(0).normal(size=v.n_columns + v.n_nuisance)

    def residuals(sign):
        x = v.stepped(whole.start, sign * step)
        x[v.nuisance_span] += sign * step[v.n_columns :]
        _, _, r = linearised(candidates._alone(replace(whole, start=x), 0, table))
        return r

    of = candidates._candidate_of_rows(candidates._alone(whole, 0, table))
    difference = 0.5 * (residuals(1.0) - residuals(-1.0))
    rows = {tuple(np.round(reading, 12)): k for k, reading in enumerate(q)}
    assert len(found.readings) >= candidates.LEAST_CANDIDATES
    for reading, columns in zip(found.readings, found.columns, strict=True):
        expected = difference[of == rows[tuple(np.round(reading, 12))]]
        assert columns @ step == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(difference).max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", UNADVISED)
def test_contacts_have_no_candidates(kind):
    assert candidates_of(kind)[1] is None


@pytest.mark.slow
def test_where_lengths_leave_a_change_open_configurations_are_advised():
    """Of wires to three anchors a slip of joint 4 looks like a change of the tool."""
    robot, _, old, new = months_of("anchors", 3, n_new=14, slip={"theta4": 2e-2})
    found = calibrate(robot, old).check(new)
    assert len(likely(found)) > 1
    assert found.advice is not None
    assert len(found.advice.readings) > 0
