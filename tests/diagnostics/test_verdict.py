"""What makes a result doubtful: test rows, priors and chi-square, under repetition and through the command line."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from simulated import LARGE, measure, measure_drawn, plus, small_arm, true_robot
from systematic import PLACED

from fg_calib import assess, build_problem, solve
from fg_calib.diagnostics import SetupCheck
from fg_calib.diagnostics.unmodelled_effects import Change, Systematic
from fg_calib.diagnostics.verdict import Case, check_chi_square
from fg_calib.robot import pose
from fg_calib.statistics import ChiSquare, GrossErrors, estimate_noise

# --- test rows ------------------------------------------------------------------------------------------------------


def drifted(seed=3, degrees=0.03):
    """Poses of a true arm by a good tracker; its second joint has drifted where the test rows were measured."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    m = measure(true, 30, rng, sigma=(1e-4, 1e-4), n_test=10)
    drift = np.where(m.test[:, None], [0.0, np.deg2rad(degrees), 0.0, 0.0], 0.0)
    moved, at = (pose(true, m.readings + d) for d in (drift, 0.0))
    rotation = m.rotation @ np.swapaxes(at.rotation, 1, 2) @ moved.rotation
    return robot, replace(m, position=m.position + moved.position - at.position, rotation=rotation)


@pytest.mark.parametrize(("degrees", "trusted"), [(0.0, True), (0.03, False)])
def test_a_joint_that_drifted_before_the_test_rows_is_an_error(degrees, trusted):
    robot, m = drifted(degrees=degrees)
    found = assess(solve(build_problem(robot, m, model="pose")))
    assert found.trustworthy == trusted
    line = r"test rows: chi-square \S+ where \S+ is expected \(p-value < 0.001\): the arm does not predict them as well"
    assert any(re.match(line, text) for text in found.verdict.errors) != trusted
    test = found.fit.goodness.test
    assert (test.chi2 > 2 * test.expected) != trusted


@pytest.mark.parametrize("model", ["pose", "distance-rotation"])
def test_a_wrong_test_row_is_named(model):
    robot, m = drifted(degrees=0.0)
    m = replace(m, position=plus(m.position, (34, 0), 0.05))
    found = assess(solve(build_problem(robot, m, model=model)))
    (text,) = found.verdict.errors
    assert text.startswith("outliers in " * (model == "pose") + "test rows: chi-square")
    assert "; suspicious: 34" in text


def test_an_arm_that_is_its_nominal_one_is_no_error():
    """A calibration gains nothing then: half of all draws predict some test rows worse."""
    robot, found = small_arm(tolerance=LARGE), []
    for seed in range(6):
        m = measure(robot, 30, np.random.default_rng(seed), sigma=(1e-4, 1e-4), n_test=20)
        found.append(assess(solve(build_problem(robot, m, model="pose"))).verdict)
    assert sum(any("no better than by the nominal" in text for text in one.warnings) for one in found) >= 2
    assert not any("no better than by the nominal" in text for one in found for text in one.errors)


# --- chi-square -----------------------------------------------------------------------------------------------------


def chi_square(reduced, p_value=0.5, dof=40):
    return ChiSquare(reduced * dof, dof, float(dof), (0.5, 2.0), p_value)


@pytest.mark.parametrize(("chi2", "settings", "severity", "words"), [
    (chi_square(1.0, dof=0), {}, "error", "no degree of freedom is left"),
    (chi_square(1.3), {}, None, ""),
    (chi_square(1.3, 1e-4), {}, "warning", "(1.14 times), and sigmas are shown larger by as much"),
    (chi_square(1.2, 1e-4), {}, None, ""),
    (chi_square(0.4), {}, "note", "noise specified too large"),
    (chi_square(0.4), {"noise": False}, None, ""),
    (chi_square(2.1), {}, "error", "[0.50, 2.00]: noise specified too small, unmodelled effects, or outliers"),
    (chi_square(2.1), {"updated": True}, "error", "new rows contradict the earlier calibration"),
    (chi_square(2.1), {"evaluated": True}, "error", "the arm does not predict these test rows"),
    (chi_square(2.1), {"gross": GrossErrors(1, ("7",), 1.1)}, "error", "outliers: 1 (7), 1.1 without: look"),
    (chi_square(2.1), {"effect": "q2"}, "error", "[0.50, 2.00]: residuals are systematic"),
])  # fmt: skip
def test_chi_square_is_judged_by_its_size_and_its_p_value(chi2, settings, severity, words):
    found = [one for one in check_chi_square(chi2, **settings) if one.applies]
    assert [one.severity for one in found] == ([] if severity is None else [severity])
    assert all(words in one.text for one in found)
    assert all(("by as much" in one.text) == ("by as much" in words) for one in found)


@pytest.mark.parametrize(("more", "alone"), [
    ({"systematic": Systematic(0.5)}, True),
    ({"systematic": Systematic(1e-9)}, False),
    ({"systematic": Systematic(1e-9), "setup": SetupCheck(explanations=("exchanged",))}, True),
    ({"change": Change("tool", 3, 0.1)}, False),
])  # fmt: skip
def test_gross_errors_are_not_all_that_is_wrong_beside_a_change_or_an_effect(more, alone):
    gross = GrossErrors(1, ("7",), 1.1)
    fit = SimpleNamespace(goodness=SimpleNamespace(gross_alone=True, gross=gross))
    assert Case(None, None, fit, None, **more).gross == (gross if alone else None)


# --- priors ---------------------------------------------------------------------------------------------------------


def test_tolerances_specified_too_small_for_all_are_a_finding():
    robot, loose = (small_arm(tolerance={k: f * v for k, v in LARGE.items()}) for f in (1.0, 2.5))
    m = measure_drawn(loose, 30, seed=33, sigma=(1e-4, 1e-4))
    found = assess(solve(build_problem(robot, m, model="pose")))
    assert found.fit.priors.chi2 > 2 * found.fit.priors.expected
    assert any("specified too small" in finding for finding in found.verdict.errors)


# --- tables with test rows alone ------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [0.0, 1.0])
@pytest.mark.parametrize("choices", [{"model": "pose", "frame": "unknown"}, {"model": "distance-rotation"}])
def test_a_table_of_test_rows_alone_evaluates_the_arm_as_it_is(choices, error):
    """The true arm, or an uncalibrated one."""
    rng = np.random.default_rng(41)
    nominal = small_arm(tolerance=LARGE)
    true = true_robot(nominal, rng)
    robot = nominal.with_values(true.nominal + error * (nominal.nominal - true.nominal))
    frame = PLACED if "frame" in choices else None
    m = measure(true, 0, rng, sigma=(3e-4, 2e-4), sigma_joint=1e-4, frame=frame, n_test=15)
    found = assess(solve(build_problem(robot, m, **choices)))
    assert found.robot.nominal.tolist() == robot.nominal.tolist()
    assert found.fit.residuals.evaluated
    assert (found.fit.chi_square.p_value < 1e-3) == bool(error)
    assert any("the arm does not predict these test rows" in text for text in found.verdict.errors) == bool(error)


def test_noise_estimated_as_large_as_the_motions_is_no_noise():
    """Orientations that were never measured: all are the same."""
    robot = small_arm(tolerance=LARGE)
    m = measure_drawn(robot, 40, seed=0)
    m = replace(m, rotation=np.tile(np.eye(3), (40, 1, 1)))
    found = assess(estimate_noise(build_problem(robot, m, model="pose")))
    assert any(text.startswith("the noise estimated of orientation is") for text in found.verdict.errors)


@pytest.mark.parametrize(("wrong", "words"), [
    ([], None),
    ([3, 4, 5], r"outliers: 3 \([345], [345], [345]\) make the estimated noise \S+ times as large: look at them"),
    (range(20), "the noise estimated of position is .* times that specified"),
])  # fmt: skip
def test_estimated_noise_far_above_the_specified_is_a_warning_that_names_gross_rows(wrong, words):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    m = measure(true_robot(robot, rng), 40, rng, sigma=(1e-4, 1e-4))
    m = replace(m, position=plus(m.position, list(wrong), rng.choice([-5e-3, 5e-3], (len(wrong), 3))))
    found = assess(estimate_noise(build_problem(robot, m, model="pose")))
    assert found.trustworthy
    assert [bool(re.match(words or "", text)) for text in found.verdict.warnings] == [True] * bool(words)
