"""Tolerances estimated with the fit: of whole arms, beside noise, in the report and the files."""

import contextlib
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from simulated import TOOL, measure, small_arm, true_robot, write_job
from tolerances import NEGLIGIBLE, sigmas_apart

from fg_calib.assessment import assess
from fg_calib.calibration import Calibration, calibrate, calibrate_job
from fg_calib.diagnostics.verdict import of_tolerances
from fg_calib.errors import InputError, SolverError
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.graph.tolerances import FIRST, ToleranceScale
from fg_calib.io.result import read_result
from fg_calib.measurements.dataset import Measurements
from fg_calib.options import Options, Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot
from fg_calib.statistics.prior_scales import estimate_tolerances
from fg_calib.statistics.variance_components import estimate_noise

STATED = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3}
TRUE = {"a": 3e-3, "d": 3e-4, "alpha": 8e-3, "theta": 1e-3}


def drawn(model="pose", n=12, seed=0, n_test=0, **choices):
    """A problem of an arm whose errors are other than stated, and its true robot."""
    rng = np.random.default_rng(seed)
    true = true_robot(small_arm(tolerance=TRUE), rng)
    m = measure(true, n, rng, sigma=(1e-4, 1e-4), n_test=n_test)
    return build_problem(small_arm(tolerance=STATED), m, model=model, **choices), true


@cache
def solved():
    return estimate_tolerances(drawn(estimate_tolerance="kind")[0])


def tolerances_of(solution):
    return {p.kind: p.tolerance for p in solution.problem.robot.parameters if p.tolerance is not None}


def test_scales_of_every_kind_are_found_within_their_intervals():
    for one in solved().estimated_tolerances.scales:
        assert one.low < TRUE[one.group] / STATED[one.group] < one.high
        assert one.low < one.scale < one.high
        assert len(one.parameters) == 4
        assert 1.5 < one.seen < 4.0 + NEGLIGIBLE


def test_the_estimate_is_that_with_the_tolerances_found_stated():
    robot = small_arm(tolerance=tolerances_of(solved()))
    again = solve(build_problem(robot, solved().problem.measurements, model="pose"))
    sigma = np.array([p.sigma or 0.0 for p in assess(again).parameters])
    n = len(sigma)
    assert sigmas_apart(solved().parameters[:n], again.parameters[:n], sigma) < NEGLIGIBLE


@pytest.mark.slow
def test_not_knowing_the_scales_makes_sigmas_larger():
    problem, _ = drawn("distance", n=14, estimate_tolerance="kind")
    solution = estimate_tolerances(problem)
    found, known = assess(solution), assess(replace(solution, estimated_tolerances=None))
    wider = [a.sigma / b.sigma for a, b in zip(found.parameters, known.parameters, strict=True) if b.sigma]
    assert min(wider) > 0.9  # that of a mean scale need not be the least
    assert np.median(wider) > 1.02


@pytest.mark.usefixtures("without_reasons", "without_mistakes")
def test_corrections_beyond_their_tolerances_are_no_finding_once_these_are_estimated():
    problem, _ = drawn()
    assert any("tolerances" in finding for finding in assess(solve(problem)).findings)
    assert not assess(solved()).findings


def test_a_joint_may_have_one_scale():
    problem, _ = drawn(estimate_tolerance="joint")
    scales = estimate_tolerances(problem).estimated_tolerances.scales
    assert [one.group for one in scales] == [joint.name for joint in problem.robot.joints]
    assert scales[1].parameters == ("a2", "alpha2", "d2", "theta2")


def test_places_and_turns_of_a_tool_have_scales_of_their_own():
    rng = np.random.default_rng(0)
    tolerance = STATED | {"tool": 1e-3} | dict.fromkeys(TOOL[3:], 1e-3)
    robot = small_arm(tolerance=tolerance, estimate=TOOL)
    problem = build_problem(robot, measure(true_robot(robot, rng), 20, rng), model="pose", estimate_tolerance="kind")
    groups = {one.group: one.parameters for one in estimate_tolerances(problem).estimated_tolerances.scales}
    assert set(groups) == {*STATED, "tool", "tool angles"}
    assert set(groups["tool"]) == set(TOOL[:3])


def test_joints_without_tolerances_start_from_a_millimetre_and_a_milliradian():
    """Base and tool do not: theirs may be anywhere."""
    rng = np.random.default_rng(0)
    m = measure(true_robot(small_arm(tolerance=TRUE), rng), 12, rng)
    bare = build_problem(small_arm(estimate=TOOL), m, model="pose", estimate_tolerance="kind")
    arm = {p.name: p.tolerance for p in bare.robot.parameters if p.estimated}
    assert {arm.pop(name) for name in TOOL} == {None}
    assert set(arm.values()) == {FIRST}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["position", "distance", "distance-rotation"])
def test_rows_of_every_model_tell_the_scales(model):
    found = estimate_tolerances(drawn(model, n=30, estimate_tolerance="kind")[0]).estimated_tolerances
    for one in found.scales:
        assert one.low / 2.0 < TRUE[one.group] / STATED[one.group] < 2.0 * one.high


@pytest.mark.slow
def test_pairs_taken_for_independent_do_not_tell_of_more_corrections():
    """All pairs of ten poses: what they share is counted in what they say of corrections, and the estimate is that."""
    choices = {"n": 10, "pairing": Pairing("all"), "estimate_tolerance": "kind"}
    shared, independent = (
        estimate_tolerances(drawn("distance", pair_errors=errors, **choices)[0]) for errors in ("shared", "independent")
    )
    for a, b in zip(shared.estimated_tolerances.scales, independent.estimated_tolerances.scales, strict=True):
        assert b.seen < a.seen + 0.05
        assert b.low < a.scale < b.high


@pytest.mark.slow
def test_noise_and_tolerances_are_estimated_together():
    problem, _ = drawn(n=30, estimate_tolerance="kind", estimate_noise=True)
    tripled = replace(problem.measurements, sigma_position=3.0 * problem.measurements.sigma_position)
    problem = build_problem(problem.robot, tripled, problem.options)
    solution = estimate_tolerances(problem, estimate_noise)
    assert solution.converged
    assert solution.problem.state.factors[0, "position"] == pytest.approx(1.0 / 3.0, rel=0.35)
    for one in solution.estimated_tolerances.scales:
        assert one.low < TRUE[one.group] / STATED[one.group] < one.high


@pytest.mark.slow
def test_with_a_robust_loss_gross_errors_do_not_reach_the_scales():
    problem, _ = drawn(n=30, estimate_tolerance="kind", loss="cauchy")
    position = problem.measurements.position.copy()
    position[:2] += 0.05
    problem = build_problem(problem.robot, replace(problem.measurements, position=position), problem.options)
    for one in estimate_tolerances(problem).estimated_tolerances.scales:
        assert one.low < TRUE[one.group] / STATED[one.group] < one.high


def test_an_arm_that_is_only_evaluated_keeps_its_tolerances():
    problem, _ = drawn(n=0, n_test=12, frame="unknown", estimate_tolerance="kind")
    assert estimate_tolerances(problem).estimated_tolerances is None


@pytest.mark.parametrize("choices", [{"gauge": "keep"}, {"gauge": "none"}, {"prior": False}])
def test_without_priors_there_is_nothing_to_estimate(choices):
    with pytest.raises(InputError, match=r"^tolerance: to be estimated beside gauge: \w+, expected gauge: prior"):
        Options.of(estimate_tolerance="kind", **choices)


def test_an_unknown_group_is_refused():
    with pytest.raises(InputError, match=r"^estimate_tolerance: found 'kinds', expected one of kind, joint"):
        Options.of(estimate_tolerance="kinds")


@pytest.mark.slow
@pytest.mark.usefixtures("without_reasons", "without_mistakes")
def test_scales_are_in_the_report_the_result_and_the_saved_robot(tmp_path):
    rng = np.random.default_rng(0)
    true = true_robot(small_arm(tolerance=TRUE), rng)
    m: Measurements = measure(true, 12, rng, sigma=(1e-4, 1e-4))
    job = write_job(tmp_path, small_arm(tolerance=STATED), m, model="pose", tolerance="estimate")
    found = calibrate_job(job)
    same = calibrate(small_arm(tolerance=STATED), m, model="pose", estimate_tolerance="kind")
    assert [s.group for s in same.result.tolerance_scales] == [s.group for s in found.result.tolerance_scales]
    assert "Tolerances estimated" in str(found)
    found.save(tmp_path / "result")
    loaded = Calibration.load(tmp_path / "result")
    assert loaded.result.tolerance_scales == found.result.tolerance_scales
    assert "Tolerances estimated" in str(loaded)
    by_kind = {one.group: one.scale * STATED[one.group] for one in found.result.tolerance_scales}
    for p in loaded.robot.parameters:
        if p.tolerance is not None:
            assert p.tolerance == pytest.approx(by_kind[p.kind], rel=1e-9)
    np.testing.assert_allclose(loaded.covariance(), found.covariance(), rtol=1e-9)
    file = tmp_path / "result" / "result.json"
    document = json.loads(file.read_text())
    document["tolerance_scales"][1]["parameters"][0] = "elbow"
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match="tolerance_scale 2: parameters: 'elbow', which is no parameter"):
        read_result(file)


def test_scales_far_from_1_and_those_that_data_do_not_tell_are_told_of():
    scales = [ToleranceScale("a", ("a1",), 12.3, 5.0, 30.0, 0.9), ToleranceScale("d", ("d1",), 4.0, 0.1, 50.0, 0.1)]
    far, unseen = (s.text for s in of_tolerances(scales, too_large=True))
    assert far == (
        "corrections are far larger than the tolerances stated (a 12.3 times): residuals are too large as well, so"
        " corrections may take up what is not modelled"
    )
    assert unseen == (
        "the data tell next to nothing of the corrections of d: the scale of their tolerances goes with the others"
    )
    assert of_tolerances([replace(scales[0], scale=2.0)], too_large=True) == []


@pytest.mark.parametrize("seed", [1, 3])
def test_two_rows_that_tell_no_tolerance_at_all_are_one_line(seed):
    """Wide tolerances beside two exact positions: the covariance ran over."""
    rows = [[0.4, 0.3, 0.2, 0], [0.3, -1.2, 0.1, 0], [0.5, 0.7, 0.1, 0]]
    robot = Robot.from_dh(rows, convention="dh", tolerance=dict.fromkeys(("a", "d", "alpha", "theta"), 0.1))
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2, 2, (2, 3))
    position = pose(robot, q).position + 1e-4 * rng.normal(size=(2, 3))
    m = Measurements.from_arrays(q, position=position, sigma_position=1e-4)
    with contextlib.suppress(SolverError):  # or it is calibrated, where rounding falls otherwise
        found = calibrate(robot, m, model="position", frame="unknown", estimate_tolerance="kind")
        assert np.isfinite(found.result.chi2)
