"""What makes a result doubtful: test rows, priors and chi-square, under repetition and through the command line."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from reported import format_report
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from simulated import measure, plus, small_arm, true_robot, write_job
from sparing import as_case, diagonal
from touches import TOLERANCE as TOUCH_TOLERANCE
from touches import TOOL_POINT, corners, touch

from fg_calib.assessment import assess
from fg_calib.baseline.comparison import real_errors
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
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


@pytest.mark.slow
def test_a_robust_loss_does_not_take_all_test_rows_for_outliers(fg_calib, tmp_path):
    robot, m = drifted()
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="position", loss="huber"))
    assert ended.code == 3
    assert re.search(
        r"test rows: the loss takes \d+ of 10 measurements for outliers, of those fitted 0 of 30", ended.err
    )


@pytest.mark.slow
def test_a_robust_loss_takes_one_wrong_test_row_for_an_outlier(fg_calib, tmp_path):
    robot, m = drifted(degrees=0.0)
    m = replace(m, position=plus(m.position, (34, 0), 0.05))
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="position", loss="huber"))
    assert ended.code == 0
    assert "1 of 10 measurements count for nothing: the loss would take them for outliers" in ended.out
    assert re.search(r"Suspicious test rows\n.*\n34 ", ended.out)


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


@pytest.mark.slow
def test_without_test_rows_nothing_is_said_of_them(fg_calib, tmp_path):
    robot, m = drifted()
    m = replace(m, test=np.zeros(40, dtype=bool))
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="pose"), "--json")
    assert json.loads(ended.out)["test"] is None


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


@pytest.mark.sampled(1)
@pytest.mark.parametrize("digits", [3, 4, 5])
def test_the_exit_code_does_not_depend_on_the_digits_of_an_overstated_noise(fg_calib, tmp_path, digits):
    """Stated so that reduced chi-square is 0.5 within the last digit kept."""
    rng = np.random.default_rng(82)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 60, rng, sigma=(1e-3, 1e-3))
    reduced = assess(solve(build_problem(robot, m, model="pose", prior=False))).reduced_chi2
    noise = float(f"{1e-3 * np.sqrt(2 * reduced):.{digits}g}")
    job = write_job(tmp_path, robot, m, model="pose", prior=False, noise={"position": noise, "orientation": noise})
    assert fg_calib("calibrate", job).code == 0


# --- names of what is suspicious ------------------------------------------------------------------------------------


def with_distances(m, distance):
    return replace(m, groups=replace(m.groups, pairs=replace(m.groups.pairs, distance=distance)))


@pytest.mark.slow
@pytest.mark.usefixtures("without_mistakes")
@pytest.mark.parametrize("mistake", ["distance", "labels"])
def test_touched_points_that_do_not_fit_are_named(fg_calib, tmp_path, mistake):
    """A socket distance that is 3 mm wrong, or three touches booked to the wrong socket."""
    rng = np.random.default_rng(5)
    robot = small_arm(tolerance=TOUCH_TOLERANCE, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    m = touch(true, corners(true, 3, rng), 12, rng, distances=((0, 1, 1e-4), (0, 2, 1e-4), (1, 2, 1e-4)))
    if mistake == "distance":
        m = with_distances(m, plus(m.groups.pairs.distance, 1, 0.003))
    else:
        index = np.r_[[2, 2, 2], m.groups.index[3:]]
        m = replace(m, groups=replace(m.groups, index=index))
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="distance"), "--out", tmp_path / "result")
    assert ended.code == 3
    assert "Traceback" not in ended.err
    suspicious = ended.out.split("Suspicious rows\n")[1].split("\n\n")[0]
    assert re.search(r"g0 +g2 +distance" if mistake == "distance" else r"^[012] +point", suspicious, flags=re.M)


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


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{"a2": 0.02}, {"alpha3": -0.02}])
def test_a_correction_far_beyond_its_tolerance_is_a_finding_that_names_it(fg_calib, tmp_path, wrong):
    rng = np.random.default_rng(32)
    robot = small_arm(tolerance=TOLERANCE)
    ((name, error),) = wrong.items()
    off = np.zeros(len(robot.nominal))
    off[robot.index(name)] = error
    true = true_robot(robot, rng)
    m = measure(true.with_values(true.nominal + off), 30, rng, sigma=(1e-4, 1e-4))
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="pose"), "--json")
    assert ended.code == 3
    found = re.search(r"corrections beyond their prior sigmas \(in sigma of these: (\S+) ([+-]\S+?)[,)]", ended.err)
    assert found.group(1) == name
    assert float(found.group(2)) == pytest.approx(error / 2e-3, abs=4)  # the arm's own error is 1 sigma of it
    assert json.loads(ended.out)["priors"]["beyond_tolerance"][0]["parameter"] == name


def test_tolerances_stated_too_small_for_all_are_a_finding():
    rng = np.random.default_rng(33)
    robot, loose = (small_arm(tolerance={k: f * v for k, v in TOLERANCE.items()}) for f in (1.0, 2.5))
    m = measure(true_robot(loose, rng), 30, rng, sigma=(1e-4, 1e-4))
    found = assess(solve(build_problem(robot, m, model="pose")))
    assert found.priors.chi2 > 2 * found.priors.expected
    assert any("specified too small" in finding for finding in found.findings)


@pytest.mark.slow
def test_sockets_that_are_not_as_far_apart_as_stated_are_a_finding(fg_calib, tmp_path):
    """12 % too far apart: the arm grows until its tolerances protest, and every residual is small."""
    rng = np.random.default_rng(34)
    robot = small_arm(tolerance=TOUCH_TOLERANCE, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    m = touch(true, corners(true, 2, rng), 20, rng, distances=((0, 1, 1e-4),))
    m = with_distances(m, 1.12 * m.groups.pairs.distance)
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, model="distance"))
    assert ended.code == 3
    assert "prior sigmas" in ended.err


def test_without_priors_no_correction_is_too_large():
    rng = np.random.default_rng(35)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng)
    assert assess(solve(build_problem(robot, m, model="pose", prior=False))).priors is None


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


EVALUATIONS = (
    "pose",
    "pose gnc",
    "pose frame joint",
    "pose frame tool",
    "star",
    "star tool",
    "touched",
    "touched tool",
)


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
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize("name", ["pose joint", "pose frame tool", "star", "touched tool"])
def test_p_values_of_an_arm_evaluated_as_it_is_are_uniform(name):
    """Kolmogorov-Smirnov at 0.1 %: the fitted frame's degrees of freedom are taken off."""
    rng = np.random.default_rng(42)
    p = []
    for _ in range(60):
        robot, m, job = evaluation(name, rng, 0.0)
        job = job | ({"pairing": Pairing(job["pairing"])} if "pairing" in job else {})
        # The arm is the true one; a prior of the tool would be about a nominal value that it has not.
        p.append(assess(solve(build_problem(robot, m, prior=False, **job))).p_value)
    assert kstest(p, "uniform").pvalue > 1e-3


def test_what_was_evaluated_only_cannot_be_compared(fg_calib, tmp_path):
    robot, m, job = evaluation("pose", np.random.default_rng(43))
    ended = fg_calib("compare", write_job(tmp_path, robot, m, **job))
    assert ended.code == 1
    expected = "test rows alone, expected train rows, for there is nothing to compare"
    assert ended.err == f"error: {tmp_path / 'poses.csv'}: {expected}\n" or ended.err.endswith(f"{expected}\n")


# --- what the data leave open ---------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("robot", "settings", "said"),
    [
        (small_arm(tolerance=TOLERANCE), {}, {"is held by their priors"}),
        (small_arm(), {"gauge": "keep"}, {"leave open of", "stand for their combinations with what stays at nominal"}),
        (small_arm(), {"gauge": "none"}, {"which is not nominal"}),
        (
            small_arm(tolerance=TOLERANCE, estimate=TOOL_POINT),
            {},
            {"is held by their priors", "is held by the priors of others that act with them"},
        ),
    ],
)
def test_the_notes_say_what_became_of_what_the_data_leave_open(robot, settings, said):
    """Nothing is said to stay at nominal that has a correction, and every other one has its value beside it."""
    rng = np.random.default_rng(51)
    m = measure(true_robot(robot, rng), 25, rng, frame=FRAME)
    solution = solve(build_problem(robot, m, model="pose", frame="unknown", **settings))
    found = assess(solution)
    notes = format_report(solution, found, width=10_000).split("\nNotes\n")[1].splitlines()
    open_notes = [n for n in notes if "open of" in n or "nothing holds" in n or "stand for" in n]
    assert {words for words in said for note in open_notes if words in note} == said
    assert len(open_notes) == len(said)
    corrections = {p.name: p.correction for p in found.parameters}
    for note in open_notes:
        if note.endswith(" stays at nominal") and "open of" in note:
            names = re.findall(r"[a-z.]+\d?(?=,| stays)", note.split("open of ")[1])
            assert all(corrections[name] == 0.0 for name in names)
        for name, value, unit in re.findall(r"(\S+) \(([+-]\S+) (mm|deg)\)", note):
            assert float(value) == pytest.approx(corrections[name] * (1e3 if unit == "mm" else 180 / np.pi), abs=1e-4)


# --- joint values ---------------------------------------------------------------------------------------------------


def encoders(kind, n, rng, wrong=0.0, sigma_joint=2e-3):
    """A job with encoder noise of `sigma_joint`, estimated; joint 2 read wrong by `wrong` sigma in configuration 5."""
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), n, rng, sigma=(3e-4, 2e-4))
    readings = m.readings + sigma_joint * rng.normal(size=m.readings.shape)
    readings[5, 1] += wrong * sigma_joint
    m = replace(m, readings=readings, sigma_joint=np.full(4, sigma_joint))
    settings = {"model": "pose"} if kind == "pose" else {"model": "distance-rotation", "pairing": {"random": 600}}
    if kind == "pairs" and n < 100:
        settings["pairing"] = "all"
    return robot, m, settings | {"encoder": "estimated"}


ENCODERS = [(kind, n, wrong) for kind, n in (("pose", 30), ("pose", 120), ("pairs", 30), ("pairs", 101))
            for wrong in (0.0, 15.0)]  # fmt: skip
QUICK = {("pose", 30, 0.0), ("pose", 120, 15.0), ("pairs", 30, 0.0)}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "n", "wrong"), [as_case(case, is_slow=case not in QUICK) for case in ENCODERS])
def test_a_wrong_encoder_reading_is_written_and_suspect(fg_calib, tmp_path, kind, n, wrong):
    """Up to 100 configurations joint values are variables, beyond that they are eliminated."""
    robot, m, job = encoders(kind, n, np.random.default_rng(61), wrong)
    ended = fg_calib("calibrate", write_job(tmp_path, robot, m, **job), "--out", tmp_path / "result")
    with (tmp_path / "result" / "joints.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["id"], r["joint"]) for r in rows] == [(str(i), f"j{j}") for i in range(n) for j in range(1, 5)]
    for row in rows:
        reading, error = float(row["reading"]), float(row["error"])
        assert float(row["estimate"]) == pytest.approx(reading + error, abs=1e-12)
        assert float(row["error_over_sigma"]) == pytest.approx(error / 2e-3)
    suspects = [(r["id"], r["joint"]) for r in rows if r["suspect"] == "true"]
    found = json.loads((tmp_path / "result" / "result.json").read_text())["joint_values"]
    if wrong:
        assert (found["suspects"][0]["id"], found["suspects"][0]["joint"]) == ("5", "j2")
        assert found["suspects"][0]["error"] == pytest.approx(-wrong * 2e-3, abs=5 * 2e-3)
        assert ("5", "j2") in suspects
        assert re.search(r"Suspicious joint readings\n.*\n5 +j2 ", ended.out)
    else:
        assert suspects == []
        # A scatter of n studentised errors, correlated within a configuration: four times 1 / sqrt(n).
        assert [j["scatter"] for j in found["joints"]] == pytest.approx([1.0] * 4, abs=4 / np.sqrt(n))
        assert [j["mean"] for j in found["joints"]] == pytest.approx([0.0] * 4, abs=4 / np.sqrt(n))
    assert "Joint readings (estimate minus reading" in ended.out
    assert "too many to carry" not in ended.out


@pytest.mark.slow
def test_without_estimated_joint_values_there_is_no_table_of_them(fg_calib, tmp_path):
    robot, m, job = encoders("pose", 30, np.random.default_rng(62))
    path = write_job(tmp_path, robot, m, **job | {"encoder": "propagated"})
    fg_calib("calibrate", path, "--out", tmp_path / "result")
    assert not (tmp_path / "result" / "joints.csv").exists()
    assert json.loads((tmp_path / "result" / "result.json").read_text())["joint_values"] is None


# --- expected error of the tool -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize(
    ("model", "frame"), [("pose", "known"), ("position", "unknown"), ("distance-rotation", "known")]
)
def test_the_expected_tool_error_is_the_real_one(model, frame):
    """RMS over arms drawn from their tolerances; of n_runs runs with at least 2 effective degrees of freedom each."""
    rng, n_runs = np.random.default_rng(71), 40
    robot = small_arm(tolerance=TOLERANCE)
    real, expected = [], []
    for _ in range(n_runs):
        true = true_robot(robot, rng)
        m = measure(true, 16, rng, sigma=(1e-3, 5e-4), frame=FRAME if frame == "unknown" else None, n_test=20)
        found = assess(solve(build_problem(robot, m, model=model, frame=frame)))
        errors, said = real_errors(found.robot, true, m.readings[m.test]), found.expected_error
        assert (said.at, said.n, said.of) == ("test", 20, 20)
        real.append(
            [f(e) for e in (errors.base, errors.fitted) for f in (lambda e: e.rms, lambda e: e.orientation_rms)]
        )
        expected.append([x for e in (said.base, said.fitted) for x in (e.position, e.orientation)])
    ratio = np.sqrt(np.mean(np.square(real), axis=0) / np.mean(np.square(expected), axis=0))
    assert ratio == pytest.approx(np.ones(4), abs=4 * 0.5 / np.sqrt(n_runs))


@pytest.mark.slow
def test_calibrate_and_compare_say_the_expected_error_in_both_frames(fg_calib, tmp_path):
    """In an unknown frame priors of the base rule the one in the base frame: millimetres beside tenths."""
    rng = np.random.default_rng(72)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 40, rng, sigma=(1e-4, 1e-4), frame=FRAME, n_test=10)
    job = write_job(tmp_path, robot, m, model="pose", frame="unknown")
    ended = fg_calib("calibrate", job, "--json")
    said = json.loads(ended.out)["expected_error"]
    assert (said["at"], said["n"]) == ("test", 10)
    assert said["position"]["fitted"] < 1e-4 < 1e-3 < said["position"]["base"]
    assert said["orientation"]["fitted"] < said["orientation"]["base"]
    compared = json.loads(fg_calib("compare", job, "--json").out)["estimates"][0]
    assert compared["predicted_position_rms"] == pytest.approx(said["position"]["base"], rel=1e-9)
    assert compared["predicted_position_rms_fitted"] == pytest.approx(said["position"]["fitted"], rel=1e-9)
    row = re.search(r"position +mm +(\S+) +(\S+)\n", fg_calib("calibrate", job).out.split("Expected tool error")[1])
    assert [float(figure) for figure in row.groups()] == pytest.approx(
        [1e3 * said["position"][frame] for frame in ("base", "fitted")], abs=5e-5
    )


def test_predicted_points_after_the_best_fit_are_the_expected_error():
    rng = np.random.default_rng(73)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng, frame=FRAME, n_test=12)
    found = assess(solve(build_problem(robot, m, model="pose", frame="unknown")))
    for fitted, said in ((False, found.expected_error.base), (True, found.expected_error.fitted)):
        points = found.predict(lambda arm: pose(arm, m.readings[m.test]).position, fitted=fitted)
        assert np.sqrt(np.sum(points.sigma**2) / 12) == pytest.approx(said.position, rel=1e-6)


def test_an_error_that_is_not_determined_is_unknown():
    """Without priors nothing holds the base; after the best fit it plays no part."""
    rng = np.random.default_rng(74)
    robot = small_arm()
    m = measure(true_robot(robot, rng), 40, rng, frame=FRAME)
    said = assess(solve(build_problem(robot, m, model="pose", frame="unknown", gauge="none"))).expected_error
    assert (said.base.position, said.base.orientation, said.at) == (None, None, "train")
    assert 0.0 < said.fitted.position < 1e-3


def test_many_configurations_are_looked_at_in_part():
    rng = np.random.default_rng(75)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 20, rng, n_test=1500)
    said = assess(solve(build_problem(robot, m, model="position"))).expected_error
    assert (said.n, said.of) == (1000, 1500)


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


@pytest.mark.slow
def test_lengths_that_tolerances_let_point_either_way_are_a_finding():
    """Stops at one point: every distance is some millimetres, as are the tolerances at the tool."""
    robot = small_arm(tolerance={"a": 3e-3, "d": 3e-3, "alpha": 3e-3, "theta": 3e-3})
    rng = np.random.default_rng(2)
    q = touch(
        robot, corners(robot, 1, rng), 30, rng, 0.0, ()
    ).readings  # the nominal arm is at one point in all of them
    true = true_robot(robot, rng)
    near = measure(true, 30, rng, sigma=(1e-5, 1e-5), readings=q)
    wide = measure(true, 30, rng, sigma=(1e-5, 1e-5))
    beside_poses = (Table(wide, "pose"), Table(near, "distance"))
    told = [
        any("is ambiguous within the prior sigmas" in text for text in found.findings)
        for found in (
            assess(solve(build_problem(robot, given, model="distance"))) for given in (near, wide, beside_poses)
        )
    ]
    assert told == [True, False, False]  # poses say nearly all where there are some
