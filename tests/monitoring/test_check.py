"""New rows of a calibrated arm: what is drift of a joint, and what is not."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from exported import UR10
from month import SIGMA, TOLERANCE, arm, calibrated, measured, placed, seen
from oracle import central_differences
from scipy import stats
from simulated import pairs_between, plus, specified, true_robot, with_changes
from sparing import as_case

from fg_calib import InputError, Measurements, Robot, Table, calibrate
from fg_calib.robot import pose

SMALL = 2.5e-4
"""A slip of some sigma in an unknown frame, [rad]."""


@pytest.fixture(scope="module")
def known():
    """Calibrated in a known frame; nobody changes it."""
    return calibrated(1)


@pytest.fixture(scope="module")
def unknown():
    """Calibrated in an unknown frame."""
    return calibrated(2, unknown=True)


def likely(check):
    return [e.parameters for e in check.explanations if e.likely]


def test_a_healthy_arm_passes(known):
    calibration, true, _ = known
    found = calibration.check(measured(true, 8, np.random.default_rng(0)))
    assert found.verdict == "pass"
    assert found.deploy
    assert found.explanations == ()
    assert found.dof == 48


def test_chi_square_is_that_of_the_covariance_written_out(known):
    """r^T (N + J Sigma J^T)^-1 r, with J by differences of the predicted poses."""
    calibration, true, _ = known
    rows = measured(true, 3, np.random.default_rng(3))
    alone = Measurements.from_arrays(rows.readings, position=rows.position, sigma_position=SIGMA[0])
    found = calibration.check(Table(alone, "position"))
    predicted = calibration.predict(rows.readings)
    r = (predicted.position - rows.position).ravel()
    names, robot = list(calibration.result.covariance.names), calibration.robot
    J = central_differences(lambda x: pose(robot.with_values(x), rows.readings).position.ravel(), robot.nominal, 1e-5)
    J = J[:, [robot.index(name) for name in names]]
    C = SIGMA[0] ** 2 * np.eye(9) + J @ calibration.covariance(names) @ J.T
    assert found.chi2 == pytest.approx(r @ np.linalg.solve(C, r), rel=1e-5)  # differences
    assert found.p_value == pytest.approx(stats.chi2.sf(found.chi2, 9))


LARGE, TOOL = ("theta3", 0.05, 10, 0), ("tool.y", 1e-3, 8, 9)
SLIPS = [as_case((f"theta{joint}", 2e-3, 10, joint), is_slow=joint > 2) for joint in (2, 3, 4, 5)]


@pytest.mark.parametrize(("name", "size", "n", "seed"), [*SLIPS, LARGE, TOOL])
def test_what_slipped_is_named_and_found_in_full(known, name, size, n, seed):
    """Also where it is too large to be linear, or is the tool."""
    calibration, true, _ = known
    found = calibration.check(measured(with_changes(true, **{name: size}), n, np.random.default_rng(seed)))
    assert found.verdict == "fail"
    assert likely(found) == [(name,)]
    best = found.explanations[0]
    assert abs(best.change[0] - size) < 4 * best.sigma[0]
    assert found.deploy


def test_a_slip_is_named_by_the_joint_where_an_angle_of_hayati_is_alike():
    """The update attributes it to the joint too, and the check is good again."""
    robot = Robot.from_dh(UR10, "dh-hayati", tool=[0.05, -0.03, 0.12], tolerance=TOLERANCE | {"beta": 1e-3})
    calibration, true, _ = calibrated(1, unknown=True, robot=robot, gauge="keep")
    true, rng = with_changes(true, theta4=2e-3), np.random.default_rng(50)
    rows = measured(true, 10, rng, frame=placed(rng))
    best = calibration.check(rows).explanations[0]
    assert (best.parameters, best.same) == (("theta4",), ("beta4",))
    updated = calibration.update(rows, changed="q4.zero")
    change = updated.parameters["theta4"].estimate - calibration.parameters["theta4"].estimate
    assert abs(change - best.change[0]) < best.sigma[0]
    assert updated.trustworthy
    assert updated.check(measured(true, 12, rng, frame=placed(rng))).verdict == "pass"


@pytest.mark.slow
def test_what_merely_correlates_is_said_not_to_be_told_apart():
    """In configurations in which joints 2 and 3 do nearly the same: the elbow stretched, and turned a little."""
    calibration, true, rng = calibrated(5, unknown=True)
    q = np.array([0.3, -1.0, 0.02, 0.5, 0.8, 0.2]) + 0.04 * rng.normal(size=(5, 6))
    frame, new = placed(rng), with_changes(true, theta3=4e-3)
    found = calibration.check(measured(new, len(q), np.random.default_rng(0), frame=frame, q=q))
    assert found.verdict == "fail"
    assert ("theta3",) in likely(found)
    assert len(likely(found)) > 1
    assert not found.deploy
    assert all(e.not_told_apart_from for e in found.explanations if e.likely)


def test_a_gross_row_does_not_count_against_a_limit(known):
    """The frame is fitted without it: the errors are those that the other rows have by themselves."""
    calibration, true, rng = known
    rows = measured(true, 12, np.random.default_rng(4), ids="r", frame=placed(rng))
    spoilt, limit = plus(rows.position, 6, [8e-3, -5e-3, 3e-3]), 5 * SIGMA[0]
    found = calibration.check(Table(replace(rows, position=spoilt), "pose", frame="unknown"), limit=limit)
    keep = np.flatnonzero(np.arange(12) != 6)
    without = calibration.check(Table(rows.select(keep), "pose", frame="unknown"), limit=limit)
    assert found.gross_rows == ("r6",)
    assert found.verdict == without.verdict == "pass"
    assert found.rms["position"] == pytest.approx(without.rms["position"], rel=1e-3)  # frames to convergence


def test_many_pairs_of_few_configurations_are_judged_without_a_suspect_each():
    robot, rng = arm(), np.random.default_rng(0)
    true = true_robot(robot, rng)

    def pairs_of(n, n_pairs):
        q = rng.uniform(-2.0, 2.0, (n, robot.n_joints))
        every = np.transpose(np.triu_indices(n, 1))
        ends = every[rng.permutation(len(every))[:n_pairs]].T
        return replace(Measurements.from_arrays(q), pairs=pairs_between(true, q, ends, rng, sigma=(1e-4, 0.0)))

    calibration = calibrate(robot, pairs_of(30, 200), model="distance")
    tracemalloc.start()
    found = calibration.check(pairs_of(150, 8000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.verdict == "pass"
    assert peak < 0.5 * 8 * 8000**2


@pytest.mark.parametrize("factor", [1.3, 3.0])
def test_noise_that_is_larger_than_specified_is_no_drift(known, factor):
    calibration, true, _ = known
    rows = measured(true, 30, np.random.default_rng(6), sigma=(factor * SIGMA[0], factor * SIGMA[1]))
    found = calibration.check(specified(rows, 1.0 / factor))
    assert found.explanations == ()
    assert found.verdict == ("fail" if factor > 2 else "pass")
    assert any("noise" in line or "times as large" in line for line in (*found.reasons, *found.cautions))


def test_two_joints_that_slipped_together_are_found(known):
    calibration, true, _ = known
    found = calibration.check(measured(with_changes(true, theta3=3e-3, theta5=-4e-3), 12, np.random.default_rng(10)))
    assert ("theta3", "theta5") in likely(found)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_two_small_slips_are_not_taken_for_noise_that_is_a_little_too_small(unknown, seed):
    """The better of the two alone leaves a reduced chi-square below 2, which is more than chance."""
    calibration, true, _ = unknown
    rng = np.random.default_rng(seed)
    found = calibration.check(measured(with_changes(true, theta2=SMALL, theta5=-SMALL), 8, rng, frame=placed(rng)))
    assert ("theta2", "theta5") in likely(found)


def test_few_rows_that_a_slip_explains_are_not_said_to_be_explained_by_none(known):
    """Too few to tell it from noise specified too small."""
    calibration, true, _ = known
    found = calibration.check(measured(with_changes(true, theta4=2.5e-4), 2, np.random.default_rng(1)))
    assert found.explanations == ()
    assert "too small, or a change that they are too few to name" in found.reasons[0]


def test_a_p_value_counts_that_noise_was_estimated_by_few_rows():
    """Chi-square over its degrees of freedom is then F; by chi-square 6 of 50 healthy arms had a p-value below 0.01."""
    calibration, true, rng = calibrated(4, n=10, estimate_noise=True)
    found = calibration.check(measured(true, 8, rng))
    degrees = sum(kind.expected for kind in calibration.result.goodness.values())
    assert degrees < 60 - 20  # of 60 figures all but those that the arm takes
    assert found.p_value == pytest.approx(stats.f.sf(found.chi2 / found.dof, found.dof, degrees))


def test_too_few_rows_are_not_judged(unknown):
    calibration, true, _ = unknown
    rng = np.random.default_rng(13)
    found = calibration.check(measured(true, 1, rng, frame=placed(rng)))
    assert found.verdict == "not_evaluated"
    assert "at least 3 needed" in found.reasons[0]


@pytest.mark.slow
def test_a_target_keeps_its_place_and_what_is_known_of_it():
    rng, robot, spot = np.random.default_rng(14), arm(), np.array([0.03, 0.08, 0.02])
    true = true_robot(robot, rng)
    calibration = calibrate(robot, seen(true, {"a": spot}, rng, 40, "x"))
    healthy = calibration.check(seen(true, {"a": spot}, rng, 6, "y"))
    assert healthy.verdict == "pass"
    assert healthy.dof == 18  # nothing is fitted: the target is known
    moved = {"a": spot + np.array([1e-3, 0, 0])}
    assert calibration.check(seen(true, moved, rng, 6, "z")).verdict == "fail"


def test_rows_of_another_robot_are_refused(known):
    calibration = known[0]
    other = Measurements.from_arrays(np.zeros((4, 5)), position=np.zeros((4, 3)), sigma_position=1e-4)
    with pytest.raises(InputError, match="joints"):
        calibration.check(other)


def test_zeros_are_called_by_the_parameters_that_rows_have_for_them():
    assert arm().zero_names[:2] == ("theta1", "theta2")
    sliding = Robot.from_dh([[0, 0, 0.1, 0], [0, 0, 0.2, 0]], "dh", types=["revolute", "prismatic"])
    assert sliding.zero_names == ("theta1", "d2")


MISREAD = {
    "x, y, z are in mm, not m": {"position": 1e3},
    "x, y, z are in m, not mm": {"position": 1e-3},
    "joint readings are in rad, not deg": {"readings": np.pi / 180},
    "joint 4 moves the other way": {"readings": np.array([1, 1, 1, -1, 1, 1])},
}


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["known", "unknown"])
@pytest.mark.parametrize("words", MISREAD)
def test_a_table_that_is_misread_is_told_of_before_anything_else(known, unknown, words, frame):
    """In wrong units no change of the arm is named, and the calibration is not blamed."""
    calibration, true, rng = known if frame == "known" else unknown
    rows = measured(true, 12, np.random.default_rng(1), frame=placed(rng) if frame == "unknown" else None)
    wrong = replace(rows, **{name: getattr(rows, name) * by for name, by in MISREAD[words].items()})
    found = calibration.check(Table(wrong, "pose", frame=frame))
    assert found.verdict == "not_evaluated"
    assert words in found.reasons[0]
    assert found.explanations == ()
    assert not found.deploy
