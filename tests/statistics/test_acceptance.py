"""Whether the arm keeps to the limits that its user set."""

import json
from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from refusals import refusal
from simulated import TOOL, measure, measure_drawn, small_arm, true_robot, write_job

from fg_calib import Limits, Options, calibrate

ROBOT = small_arm(tolerance=dict.fromkeys(("a", "d", "alpha", "theta"), 0.01), estimate=TOOL[:3])


def measured(n_test=20):
    return measure_drawn(ROBOT, 40, seed=0, sigma=(1e-4, 1e-4), n_test=n_test)


def calibrated(n_test=20, wrong=0.0, **options):
    m = measured(n_test)
    if np.any(wrong):
        m = replace(m, position=m.position + wrong * m.test[:, None])
    return calibrate(ROBOT, m, model="pose", **options)


def verdicts(result):
    return [one.verdict for one in result.result.acceptance.judgements]


def test_limits_are_judged_by_the_rms_of_the_test_rows():
    result = calibrated(accept={"position": 5e-4, "orientation": 5e-4})
    one = result.result.acceptance.judgements[0]
    table = result.assessment.fit.residuals
    rows = (table.reason_code == 0) & table.test & (table.family == table.families.index("position"))
    assert one.error == pytest.approx(np.sqrt(np.sum(table.after[rows] ** 2) / 20), rel=1e-12)
    assert one.noise == pytest.approx(np.sqrt(np.sum(table.sigma[rows] ** 2) / 20), rel=1e-12)
    lengths, found = np.linalg.norm(table.after[rows].reshape(-1, 3), axis=1), result.result.residual_statistics["test"]
    expected = [lengths.mean(), lengths.std(), np.quantile(lengths, 0.95), lengths.max()]
    assert list(vars(found["position"]["after"]).values()) == pytest.approx(expected, rel=1e-12)
    assert one.n == 20
    assert verdicts(result) == ["pass", "pass"]
    assert result.not_accepted == ()
    assert "PASS: position" in str(result)


def test_an_arm_that_is_worse_fails():
    """Of two limits one is kept: the whole fails."""
    result = calibrated(wrong=0.01, accept=Limits(position=5e-3, orientation=5e-4))
    assert verdicts(result)[0] == "fail"
    assert result.result.acceptance.verdict == "fail"
    assert result.not_accepted[0].startswith("FAIL: position 17.3 mm (RMS of 20 held-out measurements), limit 5 mm")


@pytest.mark.parametrize("loss", ["none", "gnc"])
def test_outliers_by_which_test_rows_fail_are_named(loss):
    result = calibrated(wrong=0.01 * (np.arange(60) > 57)[:, None], accept={"position": 1e-3}, loss=loss)
    fails = "FAIL: position 5.48 mm (RMS of 20 held-out measurements), limit 1 mm"
    assert result.not_accepted == (f"{fails}: outliers among them, which count here: 58, 59; look at them",)


def test_what_passes_needs_a_result_to_be_trusted():
    result = calibrated(wrong=0.002, accept={"position": 5e-3})
    assert result.findings
    assert verdicts(result) == ["not evaluated"]
    assert "not to be trusted" in result.not_accepted[0]


@pytest.mark.parametrize(("n_test", "words"), [(0, "no measurement of any"), (4, "fewer than 5 were held out")])
def test_without_rows_held_out_nothing_is_evaluated(n_test, words):
    result = calibrated(n_test=n_test, accept={"position": 1.0})
    assert verdicts(result) == ["not evaluated"]
    assert words in result.not_accepted[0]


@pytest.mark.parametrize(("accept", "message"), [
    ({"positon": 1e-3}, "accept: unknown limit 'positon', expected one of position, orientation, distance, angle"),
    ({"position": 0.0}, "accept: position: found 0.0, expected a finite number above 0"),
    ({"position": True}, "accept: position: found True, expected a finite number above 0"),
    ("0.5 mm", "accept: found '0.5 mm', expected a Limits, such as Limits(position=5e-4)"),
])  # fmt: skip
def test_wrong_limits_are_one_line(accept, message):
    assert refusal(Options.of, accept=accept).startswith(message)


def of_job(tmp_path, fg_calib, accept, *arguments):
    return fg_calib("calibrate", write_job(tmp_path, ROBOT, measured(), model="pose", accept=accept), *arguments)


@pytest.mark.slow
def test_a_job_may_state_units_or_not(tmp_path, fg_calib):
    ended = of_job(tmp_path, fg_calib, {"position": "0.5 mm", "orientation": "0.05deg"}, "--json")
    found = json.loads(ended.out)["acceptance"]
    assert (ended.code, ended.err, found["verdict"]) == (0, "", "pass")
    assert [one["limit"] for one in found["judgements"]] == pytest.approx([5e-4, np.deg2rad(0.05)], rel=1e-12)
    ended = of_job(tmp_path, fg_calib, {"position": 5e-4}, "--json")
    assert json.loads(ended.out)["acceptance"]["judgements"][0]["limit"] == 5e-4


def test_what_is_not_accepted_ends_with_3_and_says_why(tmp_path, fg_calib):
    ended = of_job(tmp_path, fg_calib, {"position": "0.1 mm"})
    assert ended.code == 3
    assert ended.err.startswith("not accepted: NOT EVALUATED: position 0.1")


def test_an_evaluation_by_few_rows_is_not_evaluated():
    """Frame and tool are fitted to them: 9 unknowns and 15 figures."""
    rng = np.random.default_rng(0)
    for n, verdict in ((5, "not evaluated"), (40, "pass")):
        m = measure(ROBOT, n, rng, sigma=(1e-3, 1e-3))
        m = replace(m, test=np.ones(n, dtype=bool))
        result = calibrate(ROBOT, m, model="position", frame="unknown", accept={"position": 3e-3})
        assert verdicts(result) == [verdict]


def test_test_rows_at_readings_that_are_fitted_do_not_count():
    rng = np.random.default_rng(0)
    q = rng.uniform(-2.0, 2.0, (30, ROBOT.n_joints))
    m = measure(true_robot(ROBOT, rng), 30, rng, sigma=(1e-4, 1e-4), n_test=10, readings=np.vstack([q, q[:10]]))
    result = calibrate(ROBOT, m, model="pose", accept={"position": 5e-4})
    assert verdicts(result) == ["not evaluated"]
    assert "no measurement of any position was held out" in result.not_accepted[0]


def test_rows_whose_prediction_nothing_determines_are_not_held_out():
    """Joint 3 stands still while the arm is calibrated: where it moves, nothing says what the arm does."""
    rng = np.random.default_rng(0)
    robot = small_arm()
    q = rng.uniform(-2.0, 2.0, (60, robot.n_joints))
    q[:50, 2] = 0.4
    true = true_robot(small_arm(tolerance=dict.fromkeys(("a", "d", "alpha", "theta"), 0.003)), rng)
    m = measure(true, 40, rng, sigma=(1e-4, 1e-4), n_test=20, readings=q)
    result = calibrate(robot, m, model="position", gauge="none", accept={"position": 1e-3})
    table = result.assessment.fit.residuals
    reasons = np.array(table.reasons)[table.reason_code[table.test]].tolist()
    assert reasons == [""] * 30 + ["depends on what is not determined"] * 30
    (one,) = result.result.acceptance.judgements
    assert (one.n, one.verdict) == (10, "pass")
    assert one.error == pytest.approx(result.assessment.fit.residuals.rms()["test"]["position"]["after"], rel=1e-12)


def test_targets_within_a_limit_do_not_pass_a_tool_that_is_not_known():
    robot, _, table = measured_by("targets", np.random.default_rng(2), n=60, n_test=20)
    found = calibrate(robot, table, accept={"position": 5e-4})
    one = found.result.acceptance.judgements[0]
    assert one.error < 5e-4 < found.assessment.expected_error.measured.position
    assert one.verdict == "not evaluated"
    assert "the tool itself is expected to be off by" in one.reason
