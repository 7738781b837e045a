"""What makes a result doubtful: test rows, priors and chi-square, under repetition and through the command line."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from simulated import measure, plus, small_arm, true_robot, write_job
from sparing import diagonal
from touches import TOLERANCE as TOUCH_TOLERANCE
from touches import TOOL_POINT, corners, touch

from fg_calib.assessment import assess
from fg_calib.diagnostics.verdict import check_chi_square
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.statistics.goodness_of_fit import ChiSquare, GrossErrors
from fg_calib.statistics.variance_components import estimate_noise

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
FRAME = (Rotation.from_rotvec([0.3, 0.2, -0.5]), np.array([1.0, 2.0, 3.0]))


# --- test rows ------------------------------------------------------------------------------------------------------


def touched(name, rng):
    """Touches of four points, one of them by test rows alone, some test rows among those of the others."""
    robot = small_arm(tolerance=TOUCH_TOLERANCE, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    distances = ((0, 1, 1e-4), (0, 3, 1e-4), (1, 2, 1e-4))
    m = touch(true, corners(true, 4, rng), 8, rng, distances=distances, test=(3,))
    m = replace(m, test=m.test | np.isin(np.arange(len(m.test)), [0, 1, 9, 10, 17]))
    if "joint" in name:
        readings = m.readings + 1e-4 * rng.normal(size=m.readings.shape)
        m = replace(m, sigma_joint=np.full(robot.n_joints, 1e-4), readings=readings)
    return build_problem(robot, m, model="distance")


def healthy(name, rng):
    """A problem with test rows of an arm drawn from its tolerances, whose noise is as stated."""
    if name.startswith("touched"):
        return touched(name, rng)
    robot = small_arm(tolerance=TOLERANCE)
    frame = FRAME if "frame" in name else None
    sigma_joint = 3e-4 if "joint" in name else 0.0
    m = measure(true_robot(robot, rng), 16, rng, sigma=(1e-3, 5e-4), sigma_joint=sigma_joint, frame=frame, n_test=10)
    loss = "gnc" if "gnc" in name else "none"
    if name.startswith("pose"):
        return build_problem(robot, m, model="pose", frame="unknown" if frame else "known", loss=loss)
    return build_problem(robot, m, model="distance-rotation", pairing=Pairing(name.split()[0]))


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize(
    ("name", "n_runs"),
    {
        "pose": 100,
        "pose joint": 50,
        "pose frame": 50,
        "pose estimated": 60,
        "pose gnc": 50,
        "star joint": 40,
        "all": 30,
        "touched": 40,
        "touched joint": 30,
    }.items(),
)
def test_p_values_of_healthy_test_rows_are_uniform(name, n_runs):
    """Kolmogorov-Smirnov at 0.1 %; chi-square over its mean within 4 of its own sigmas, sqrt(2 / sum of means)."""
    rng = np.random.default_rng(21)
    p, by_kind, sums = [], {}, []
    for _ in range(n_runs):
        problem = healthy(name, rng)
        fit = assess(estimate_noise(problem) if "estimated" in name else solve(problem)).goodness.test
        p.append(fit.p_value)
        sums.append((fit.chi2, fit.expected))
        for kind in fit.kinds:
            by_kind.setdefault(kind.kind, []).append(kind.p_value)
    for values in (p, *by_kind.values()):
        assert kstest(values, "uniform").pvalue > 1e-3
    chi2, expected = np.sum(sums, axis=0)
    # Where the noise was estimated its own sigma comes on top, of about 70 degrees of freedom a run.
    more = 2.0 if "estimated" in name else 1.0
    assert chi2 / expected == pytest.approx(1.0, abs=4 * np.sqrt(2 / expected) * more)


def drifted(seed=3, degrees=0.03):
    """Poses of a true arm by a good tracker; its second joint has drifted where the test rows were measured."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    m = measure(true, 30, rng, sigma=(1e-4, 1e-4), n_test=10)
    drift = np.where(m.test[:, None], [0.0, np.deg2rad(degrees), 0.0, 0.0], 0.0)
    moved, at = (pose(true, m.readings + d) for d in (drift, 0.0))
    rotation = m.rotation @ np.swapaxes(at.rotation, 1, 2) @ moved.rotation
    return robot, replace(m, position=m.position + moved.position - at.position, rotation=rotation)


DRIFTED = [{"model": "pose"}, {"model": "distance-rotation", "pairing": "all"}]


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "estimate"), diagonal(DRIFTED, [False, True]))
def test_a_joint_that_drifted_before_the_test_rows_is_not_good(fg_calib, tmp_path, settings, estimate):
    robot, m = drifted()
    noise = {"position": 1e-4, "orientation": 1e-4} | ({"estimate": True} if estimate else {})
    job = write_job(tmp_path, robot, m, **settings, noise=noise)
    ended = fg_calib("calibrate", job, "--out", tmp_path / "result")
    assert ended.code == 3
    line = r"test rows: chi-square \S+ where \S+ is expected \(p-value < 0.001\)"
    assert re.search(rf"not to be trusted: {line}: the arm does not predict them as well as it claims", ended.err)
    assert re.search(rf"^{line}$", ended.out, flags=re.M)
    result = json.loads((tmp_path / "result" / "result.json").read_text())
    assert result["test"]["p_value"] < 1e-3
    assert result["test"]["chi2"] > 2 * result["test"]["expected"]
    assert not result["trustworthy"]


def test_the_same_arm_without_drift_is_good(fg_calib, tmp_path):
    robot, m = drifted(degrees=0.0)
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="pose"), "--json")
    assert ended.code == 0
    assert json.loads(ended.out)["test"]["p_value"] > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"model": "pose"}, {"model": "distance-rotation", "pairing": "star"}])
def test_a_wrong_test_row_is_named(fg_calib, tmp_path, settings):
    robot, m = drifted(degrees=0.0)
    m = replace(m, position=plus(m.position, (34, 0), 0.05))
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, **settings), "--out", tmp_path / "result")
    assert re.search(r"Suspicious test configurations\n.*\n34 ", ended.out)
    assert re.search(r"Suspicious test rows\n.*\n(\d+ +)?34 .* test *\n", ended.out)
    assert ended.code == 3
    assert "; suspicious: 34" in ended.err
    with (tmp_path / "result" / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    suspects = {row["flag"] for row in rows if row["suspect"] == "true"}
    assert suspects == {"test"}
    assert {end for row in rows if row["suspect"] == "true" for end in (row["a"], row["b"])} >= {"34"}


# --- chi-square -----------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("stated", "code", "said"),
    [
        (4.0, 0, "noise specified too large; sigmas are larger than they need be"),
        (1.0, 0, None),
        (0.8, 0, "significantly larger than the specified noise"),
        (0.5, 3, "noise specified too small, unmodelled effects, or outliers"),
    ],
)
def test_noise_stated_wrong_is_a_caution_or_a_finding_by_how_much(fg_calib, tmp_path, stated, code, said):
    rng = np.random.default_rng(81)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 200, rng)
    job = write_job(tmp_path, robot, m, model="pose", noise={"position": 1e-3 * stated, "orientation": 2e-4 * stated})
    ended = fg_calib("calibrate", job, "--json")
    result = json.loads(ended.out)
    assert ended.code == code
    texts = result["findings"] if code else result["cautions"]
    assert [text for text in texts if "chi-square" in text and said in text] if said else not texts


def chi_square(reduced, p_value=0.5, dof=40):
    return ChiSquare(reduced * dof, dof, float(dof), (0.5, 2.0), p_value)


@pytest.mark.parametrize(
    ("chi2", "settings", "severity", "words"),
    [
        (chi_square(1.0, dof=0), {}, "error", "no degree of freedom is left"),
        (chi_square(1.3), {}, None, ""),
        (chi_square(1.3, 1e-4), {}, "note", "(1.14 times); sigmas may be too small by as much or more"),
        (chi_square(1.2, 1e-4), {}, None, ""),
        (chi_square(0.4), {}, "note", "noise specified too large"),
        (
            chi_square(2.1),
            {},
            "error",
            "outside [0.50, 2.00]: noise specified too small, unmodelled effects, or outliers",
        ),
        (chi_square(2.1), {"updated": True}, "error", "new rows contradict the earlier calibration"),
        (chi_square(2.1), {"evaluated": True}, "error", "the arm does not predict these test rows"),
        (
            chi_square(2.1),
            {"gross": GrossErrors(1, ("7",), 1.1)},
            "error",
            "outliers: 1 (7), 1.1 without: look at them",
        ),
    ],
)
def test_chi_square_is_judged_by_its_size_and_its_p_value(chi2, settings, severity, words):
    found = check_chi_square(chi2, **settings)
    assert [one.severity for one in found] == ([] if severity is None else [severity])
    assert all(words in one.text for one in found)
    assert all(("by as much" in one.text) == ("by as much" in words) for one in found)


# --- priors ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize("name", ["pose frame", "star", "touched"])
def test_healthy_corrections_are_seldom_called_too_large(name):
    """Each of the two alarms at 0.1 %: more than 1 of 60 is unlikely (0.7 %). The p-value by Kolmogorov-Smirnov."""
    rng = np.random.default_rng(31)
    fits = [assess(solve(healthy(name, rng))) for _ in range(60)]
    assert sum(any("prior sigmas" in text for text in fit.findings + fit.cautions) for fit in fits) <= 1
    assert kstest([fit.priors.p_value for fit in fits], "uniform").pvalue > 1e-3
    sums = np.array([(fit.priors.chi2, fit.priors.expected) for fit in fits])
    assert sums[:, 0].sum() / sums[:, 1].sum() == pytest.approx(1.0, abs=4 * np.sqrt(2 / sums[:, 1].sum()))


def test_tolerances_stated_too_small_for_all_are_a_finding():
    rng = np.random.default_rng(33)
    robot, loose = (small_arm(tolerance={k: f * v for k, v in TOLERANCE.items()}) for f in (1.0, 2.5))
    m = measure(true_robot(loose, rng), 30, rng, sigma=(1e-4, 1e-4))
    found = assess(solve(build_problem(robot, m, model="pose")))
    assert found.priors.chi2 > 2 * found.priors.expected
    assert any("specified too small" in finding for finding in found.findings)


# --- tables with test rows alone ------------------------------------------------------------------------------------


def evaluation(name, rng, error=1.0):
    """The true arm, or one with `error` times the errors of an uncalibrated one, and a table of test rows of it."""
    frame = FRAME if "frame" in name else None
    nominal = small_arm(tolerance=TOLERANCE | {"tool": 5e-3}, estimate=TOOL_POINT if "tool" in name else ())
    true = true_robot(nominal, rng)
    robot = nominal.with_values(true.nominal + error * (nominal.nominal - true.nominal))
    if name.startswith("touched"):
        m = touch(true, corners(true, 3, rng), 8, rng, distances=((0, 1, 1e-4),), test=(0, 1, 2))
        return robot, m, {"model": "distance"}
    m = measure(true, 0, rng, sigma=(3e-4, 2e-4), sigma_joint=1e-4 if "joint" in name else 0.0, frame=frame, n_test=15)
    loss = {"loss": "gnc"} if "gnc" in name else {}
    if name.startswith("star"):
        return robot, m, {"model": "distance-rotation", "pairing": "star"} | loss
    return robot, m, {"model": "pose", "frame": "unknown" if frame else "known"} | loss


EVALUATIONS = ("pose frame joint", "pose frame tool", "star", "touched tool")


@pytest.mark.slow
@pytest.mark.parametrize("name", EVALUATIONS)
@pytest.mark.filterwarnings("error")
def test_a_table_of_test_rows_alone_evaluates_the_arm_as_it_is(fg_calib, tmp_path, name):
    for error in (0.0, 1.0):
        robot, m, job = evaluation(name, np.random.default_rng(41), error)
        path = write_job(tmp_path, robot, m, **job)
        ended = fg_calib("calibrate", path, "--out", tmp_path / "result")
        result = json.loads((tmp_path / "result" / "result.json").read_text())
        assert "EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated" in ended.out
        assert result["evaluated_only"]
        assert "no test rows" not in ended.out
        assert result["residual_rms"]["train"] == dict.fromkeys(result["residual_rms"]["train"])
        moved = [p["name"] for p in result["parameters"] if p["correction"] != 0.0]
        assert set(moved) <= (set(TOOL_POINT) if "tool" in name else set())
        with (tmp_path / "result" / "residuals.csv").open() as file:
            assert {row["split"] for row in csv.DictReader(file)} == {"test"}
        test = result["test"]
        assert (test["chi2"], test["n"]) == (pytest.approx(result["chi2"]), result["n_residuals"])
        # Chi-square of about 30 to 90 degrees of freedom, at a fixed seed.
        assert ended.code == (3 if error else 0)
        if "gnc" not in name:
            assert re.search(r"^test rows: chi-square \S+ where \S+ is expected", ended.out, flags=re.M)
            assert (test["p_value"] < 1e-3) == bool(error)
            assert test["p_value"] == pytest.approx(result["chi2_p_value"])


@pytest.mark.long
def test_noise_estimated_as_large_as_the_motions_is_no_noise(fg_calib, example):
    """Orientations that were never measured, all 0 0 0 1, made 80 degrees of noise and GOOD."""
    file = example / "calibration.yaml"
    lines = (example / "poses.csv").read_text().splitlines()
    header = lines[0].split(",")
    first = header.index("qx")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[first : first + 4] = ["0", "0", "0", "1"]
    (example / "poses.csv").write_text("\n".join([lines[0], *map(",".join, rows)]) + "\n")
    job = yaml.safe_load(file.read_text()) | {"model": "pose", "noise": "estimate"}
    job.pop("pairing", None)
    file.write_text(yaml.safe_dump(job))
    ended = fg_calib("calibrate", file, "--json")
    assert ended.code == 3
    assert any("the noise estimated of orientation is" in text for text in json.loads(ended.out)["findings"])
