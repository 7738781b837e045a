"""One Parquet file, some rows at a time: their sum is what the whole job says, or one line says why not."""

import json
import os
import pickle
import re
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import yaml
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot

from fg_calib import (
    Calibration,
    CalibrationError,
    InputError,
    ProblemError,
    assess,
    build_problem,
    calibrate_parts,
    local_processes,
    read_job,
    read_measurements,
    read_parts,
    solve,
    solve_parts,
    write_robot,
)
from fg_calib.io.assessed_parts import UNJUDGED
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}
SIGMA = 1e-4
N_PAIRS = 200


def write(folder, tables, **keys):
    """A job on tables, with a robot of its own."""
    for name, columns in tables.items():
        pl.DataFrame(columns).write_parquet(folder / f"{name}.parquet", row_group_size=50)
    write_robot(folder / "robot.yaml", small_arm(TOLERANCE))
    job = {"robot": "robot.yaml", "units": {"length": "m", "angle": "rad"}} | keys
    (folder / "job.yaml").write_text(yaml.safe_dump(job))
    return folder / "job.yaml"


def pairs_job(folder, in_units=(1.0, 1.0), more=None, of_q=None, **keys):
    """Pairs of 40 configurations; figures divided by units, columns added to or replaced in either table."""
    rng = np.random.default_rng(3)
    true = true_robot(small_arm(TOLERANCE), rng)
    q = rng.uniform(-3.0, 3.0, (40, 4))
    at = pose(true, q)
    a = rng.integers(0, 40, N_PAIRS)
    b = (a + rng.integers(1, 40, N_PAIRS)) % 40
    distance = np.linalg.norm(at.position[a] - at.position[b], axis=1) + SIGMA * rng.normal(size=N_PAIRS)
    turn = Rotation.from_matrix(at.rotation[a]).inv() * Rotation.from_matrix(at.rotation[b])
    angle = np.abs(turn.magnitude() + SIGMA * rng.normal(size=N_PAIRS))
    angle = np.minimum(angle, 2.0 * np.pi - angle)
    units = [in_units[0 if joint.prismatic else 1] for joint in true.joints]
    columns = {f"q{k + 1}": q[:, k] / unit for k, unit in enumerate(units)} | (of_q or {})
    pairs = {"a": a, "b": b, "distance": distance / in_units[0], "angle": angle / in_units[1]} | (more or {})
    if "id" in columns:
        pairs |= {name: np.array(columns["id"])[pairs[name]] for name in "ab"}
    choices = {"model": "distance-rotation", "noise": {"distance": SIGMA / in_units[0], "angle": SIGMA / in_units[1]}}
    choices |= {"measurements": "q.parquet", "pairs": "pairs.parquet"}
    return write(folder, {"q": columns, "pairs": pairs}, **choices | keys)


def poses_job(folder, more=None, **keys):
    """40 poses in an unknown frame."""
    rng = np.random.default_rng(4)
    frame = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))
    m = measure(true_robot(small_arm(TOLERANCE), rng), 60, rng, frame=frame, sigma=(SIGMA, SIGMA))
    columns = {f"q{k + 1}": q for k, q in enumerate(m.readings.T)} | dict(zip("xyz", m.position.T, strict=True))
    quaternion = Rotation.from_matrix(m.rotation.copy()).as_quat()
    columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True)) | (more or {})
    choices = {"model": "pose", "frame": "unknown", "noise": {"position": SIGMA, "orientation": SIGMA, "joint": 1e-6}}
    return write(folder, {"poses": columns}, **{"measurements": "poses.parquet"} | choices | keys)


SPLIT = np.where(np.arange(N_PAIRS) % 7 == 0, "test", "train")
SIGMAS = np.where(np.arange(N_PAIRS) % 3 == 0, None, SIGMA * (1 + np.arange(N_PAIRS) % 5))
JOBS = {
    "pairs": pairs_job,
    "mm and deg": lambda folder: pairs_job(folder, (1e-3, np.pi / 180.0), units={"length": "mm", "angle": "deg"}),
    "columns of sigmas": lambda folder: pairs_job(folder, more={"sigma_distance": SIGMAS.tolist()}),
    "test pairs": lambda folder: pairs_job(folder, more={"split": SPLIT}),
    "a part of test pairs alone": lambda folder: pairs_job(
        folder, more={"split": np.where(np.arange(N_PAIRS) < 100, "test", "train")}
    ),
    "ids and test configurations": lambda folder: pairs_job(
        folder, of_q={"id": [f"p{k}" for k in range(40)], "split": ["test"] * 3 + ["train"] * 37}
    ),
    "angles alone, some not measured": lambda folder: pairs_job(
        folder, more={"angle": [None if k % 4 else 0.5 for k in range(N_PAIRS)]}, model="distance"
    ),
    "other names of columns": lambda folder: pairs_job(
        folder, of_q={"A 2": np.random.default_rng(0).normal(size=40)}, columns={"q2": "q2"}
    ),
    "independent with joint noise": lambda folder: pairs_job(
        folder, noise={"distance": SIGMA, "angle": SIGMA, "joint": 1e-5}, pair_errors="independent"
    ),
    "poses": poses_job,
    "poses, some to test": lambda folder: poses_job(folder, more={"split": ["test"] * 10 + ["train"] * 50}),
    "positions with sigmas": lambda folder: poses_job(
        folder, model="position", more={"sigma_position": SIGMA * (1 + np.arange(60) % 3), "id": np.arange(60) + 7}
    ),
}


@pytest.mark.parametrize("which", JOBS)
def test_the_sum_of_spans_of_a_file_is_what_the_whole_job_says(tmp_path, which):
    job = JOBS[which](tmp_path)
    whole = read_job(job)
    expected = solve(build_problem(whole.robot, whole.measurements, whole.options))
    given = pickle.loads(pickle.dumps(read_parts(job, 37 if "pairs" in which else 23)))
    assert len(given.parts) > 1
    assert given.inputs == whole.inputs
    found = solve_parts(given.robot, given.parts, given.options)
    assert found.converged
    assert found.reduced.n_residuals == expected.problem.n_residuals
    assert 0.5 * found.chi2 == pytest.approx(expected.cost, rel=1e-9)
    uncertainty = assess(expected)
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    there = [i for i, p in enumerate(whole.robot.parameters) if p.estimated]
    assert np.abs((found.robot.nominal - uncertainty.robot.nominal)[there] / sigma).max() < 1e-6


@pytest.mark.parametrize("kind", [pairs_job, poses_job])
def test_a_result_in_parts_says_what_that_of_the_whole_job_says_of_all_rows(tmp_path, kind):
    job = kind(tmp_path)
    whole, found = Calibration.of(*_solved(job)).result, calibrate_parts(read_parts(job, 41)).result
    assert [p.identifiability for p in found.parameters] == [p.identifiability for p in whole.parameters]
    for name in ("sigma", "estimate", "correction"):
        figures = [[getattr(p, name) for p in one.parameters] for one in (found, whole)]
        assert figures[0] == pytest.approx(figures[1], rel=1e-6, abs=1e-10)
    for name in ("n_configurations", "n_pairs", "n_residuals", "n_priors", "dof", "pairing", "frame", "n_excluded"):
        assert getattr(found, name) == getattr(whole, name)
    assert found.chi2_p_value == pytest.approx(whole.chi2_p_value, rel=1e-5)
    assert found.priors.expected == pytest.approx(whole.priors.expected, rel=1e-6)
    for quantity, rms in whole.residual_rms["train"].items():
        mine = found.residual_rms["train"][quantity]
        assert (mine is None) == (rms is None)
        if rms is not None:
            assert mine.after == pytest.approx(rms.after, rel=1e-6)
            assert mine.before is None if kind is poses_job else mine.before == pytest.approx(rms.before, rel=1e-9)
    assert found.observability.lost == whole.observability.lost
    assert found.trustworthy is None
    assert found.reservations == (UNJUDGED,)


@pytest.mark.parametrize("n_rows", [7, 41, 1000])
def test_configurations_that_no_fitted_pair_is_of_are_not_counted(tmp_path, n_rows):
    rng = np.random.default_rng(5)
    ends = {"a": rng.integers(0, 20, N_PAIRS), "b": rng.integers(20, 30, N_PAIRS)}
    ends["a"][100:], ends["b"][0] = rng.integers(0, 12, 100), 39
    job = pairs_job(tmp_path, more=ends | {"split": ["test"] + ["train"] * 99 + ["test"] * 100})
    whole, found = read_job(job), calibrate_parts(read_parts(job, n_rows)).result
    assert found.n_configurations == build_problem(whole.robot, whole.measurements, whole.options).n_configurations < 31


@pytest.mark.parametrize("column", ["distance", "angle"])
def test_a_table_with_either_figure_alone_may_be_cut(tmp_path, caplog, column):
    job = pairs_job(tmp_path)
    pairs = pl.read_parquet(tmp_path / "pairs.parquet")
    pairs.drop(column).write_parquet(tmp_path / "pairs.parquet")
    whole = Calibration.of(*_solved(job)).result
    (said,) = caplog.messages
    found = calibrate_parts(read_parts(job, 41)).result
    of_fitted = said.replace("no pair has", "no fitted pair has")  # others are not kept in parts
    assert caplog.messages == [said, of_fitted]
    assert of_fitted in found.cautions
    assert said in whole.cautions
    assert found.residual_rms["train"][column] is whole.residual_rms["train"][column] is None
    assert found.reduced_chi2 == pytest.approx(whole.reduced_chi2, rel=1e-9)


def test_a_figure_of_which_no_pair_has_any_is_told_of_with_the_columns_that_nothing_uses(tmp_path, caplog):
    job = pairs_job(tmp_path, more={"day": ["2026-03-01"] * N_PAIRS})
    pairs = pl.read_parquet(tmp_path / "pairs.parquet")
    pairs.rename({"distance": "separation"}).write_parquet(tmp_path / "pairs.parquet")
    whole = read_job(job)
    build_problem(whole.robot, whole.measurements, whole.options)
    assert caplog.messages == [
        "pairs.parquet: no pair has a distance, of which model distance-rotation makes use; is a column misspelt"
        " (columns separation, day are not used)? model: rotation says that there is none"
    ]
    caplog.clear()
    build_problem(whole.robot, whole.measurements, replace(whole.options, model="rotation"))
    pairs.write_parquet(tmp_path / "pairs.parquet")
    whole = read_job(job)
    build_problem(whole.robot, whole.measurements, whole.options)
    assert not caplog.messages


@pytest.mark.parametrize("estimated", ["tool.x", "base.z"])
def test_rms_before_is_unknown_where_more_than_the_joints_would_be_fitted_to_all_rows_first(tmp_path, estimated):
    job = pairs_job(tmp_path, model="distance")
    write_robot(tmp_path / "robot.yaml", small_arm(TOLERANCE, estimate=(estimated,)))
    found = calibrate_parts(read_parts(job, 41)).result
    assert found.residual_rms["train"]["distance"].before is None
    assert found.solver.initial_cost is None


def _solved(job):
    given = read_job(job)
    solution = solve(build_problem(given.robot, given.measurements, given.options))
    return solution, assess(solution)


def test_the_command_writes_a_result_that_others_read(tmp_path, fg_calib):
    job = pairs_job(tmp_path)
    out = tmp_path / "out"
    ended = fg_calib("calibrate", job, "--parts", 50, "--out", out, "--report")
    assert (ended.code, ended.err) == (0, "")
    assert "\nNOT JUDGED ROW BY ROW: converged" in ended.out
    assert UNJUDGED in ended.out
    assert {file.name for file in out.iterdir()} == {
        *("result.json", "robot_calibrated.yaml", "configurations.csv", "report.html")
    }
    page = (out / "report.html").read_text()
    assert "NOT JUDGED ROW BY ROW" in page
    assert "figures may be trusted" not in page
    assert "--parts" in page
    assert page.count("Not of a calibration in parts") == 3  # folds, errors over joints, residuals
    assert "calibrate again" not in page
    assert "--folds" not in page
    assert "accept:" not in page
    assert "none were held out" not in page
    loaded = Calibration.load(out)
    assert loaded.result.trustworthy is None
    assert loaded.result.goodness == {}
    assert str(loaded) == ended.out.rstrip("\n")
    for arguments in (["export", out, "--to", "hayati"], ["predict", out]):
        assert fg_calib(*arguments).code == 0
    ended = fg_calib("update", out, job, "--out", tmp_path / "next")
    assert (ended.code, ended.err.count("\n")) == (1, 1)
    assert "a calibration in parts, which does not hold what its rows say" in ended.err
    ended = fg_calib("history", out)
    assert "not judged" in ended.out
    assert ": 1 run\n" in ended.out
    assert "doubtful" not in ended.out


def test_a_fit_that_is_bad_as_a_whole_is_doubtful(tmp_path, fg_calib):
    job = pairs_job(tmp_path, noise={"distance": SIGMA / 3.0, "angle": SIGMA / 3.0})
    ended = fg_calib("calibrate", job, "--parts", 50, "--json")
    assert ended.code == 3
    assert json.loads(ended.out)["trustworthy"] is False
    assert calibrate_parts(job).trustworthy is False
    assert "not to be trusted: reduced chi-square" in ended.err


def test_findings_are_told_to_their_end(tmp_path, fg_calib):
    job = pairs_job(tmp_path, noise={"distance": SIGMA / 3.0, "angle": SIGMA / 3.0})
    ended = fg_calib("calibrate", job, "--parts", 50)
    lines = ended.out.splitlines()
    findings = calibrate_parts(read_parts(job, 50)).result.findings
    assert max(map(len, findings)) > 100 >= max(len(line) for line in lines[: lines.index("Parameters")])
    assert all(f"DOUBTFUL: {finding}" in " ".join(ended.out.split()) for finding in findings)


def test_what_was_calibrated_in_parts_has_no_residuals(tmp_path):
    found = calibrate_parts(pairs_job(tmp_path))
    assert found.trustworthy is None
    with pytest.raises(InputError, match="calibrated in parts, without assessment or residual table"):
        _ = found.residuals
    found.save(tmp_path / "out")
    assert Calibration.load(tmp_path / "out").parameters["a2"] == found.parameters["a2"]


@pytest.mark.slow
def test_processes_reduce_spans_to_the_same_bits(tmp_path):
    given = read_parts(pairs_job(tmp_path), 50)
    here = calibrate_parts(given)
    with local_processes(2) as executor:
        there = calibrate_parts(given, executor)
    assert there.posterior.tangent.tobytes() == here.posterior.tangent.tobytes()
    assert there.robot.nominal.tobytes() == here.robot.nominal.tobytes()


REFUSED = {
    "folds": (lambda f: pairs_job(f, folds=3), "folds: given for a table in parts, expected none"),
    "accept": (lambda f: pairs_job(f, accept={"distance": 1.0}), "accept: given for a table in parts, expected none"),
    "loss": (lambda f: pairs_job(f, loss="gnc"), "loss: found 'gnc', expected none: parts are reduced once each"),
    "joint": (
        lambda f: pairs_job(f, noise={"distance": 1e-4, "angle": 1e-4, "joint": 1e-5}),
        r"part 1: q.parquet: joint noise, which pairs of one",
    ),
    "formed": (lambda f: poses_job(f, model="distance", frame="known"), "pairs formed of poses"),
    "stations": (lambda f: poses_job(f, more={"station": ["s"] * 30 + ["t"] * 30}), "targets, stations, anchors or"),
    "ids": (
        lambda f: poses_job(f, more={"id": ["p"] * 60}),
        r"poses.parquet: row 1: id: found 'p', expected different ids",
    ),
    "tables": (lambda f: poses_job(f, measurements=[{"table": "poses.parquet"}] * 2), "several tables, expected one"),
    "pairs": (lambda f: pairs_job(f, model="position"), "pairs: given with model position, expected none"),
    "cell": (
        lambda f: pairs_job(f, more={"distance": [1.0] * 150 + [-1.0] * 50}),
        r"part 4: pairs.parquet: row 150: distance: found -1.0, expected a number not below 0",
    ),
    "test": (lambda f: pairs_job(f, more={"split": ["test"] * N_PAIRS}), "no train row, expected at least one"),
    "empty": (
        lambda f: pairs_job(f, more=dict.fromkeys(("distance", "angle"), [None] * N_PAIRS)),
        "no train row, expected at least one; test rows and empty cells are never fitted",
    ),
}


@pytest.mark.parametrize("which", REFUSED)
def test_what_cannot_be_cut_is_one_line(tmp_path, which):
    job, message = REFUSED[which]
    with pytest.raises(CalibrationError, match=message) as caught:
        calibrate_parts(read_parts(job(tmp_path), 50))
    assert "\n" not in str(caught.value)


def test_a_csv_and_a_frame_cannot_be_read_by_rows(tmp_path):
    job = pairs_job(tmp_path)
    robot = read_parts(job).robot
    pl.read_parquet(tmp_path / "pairs.parquet").write_csv(tmp_path / "pairs.csv")
    with pytest.raises(InputError, match=r"pairs.csv: ending '.csv', expected a Parquet file, .*sink_parquet"):
        read_measurements(tmp_path / "q.parquet", robot, pairs=tmp_path / "pairs.csv", rows=(0, 3))
    with pytest.raises(InputError, match="a frame in memory, expected a Parquet file"):
        read_measurements(pl.read_parquet(tmp_path / "q.parquet"), robot, rows=(0, 3))
    for rows in ((-1, 3), (0, 0)):
        with pytest.raises(InputError, match="rows: "):
            read_measurements(tmp_path / "q.parquet", robot, rows=rows)


def test_a_file_that_is_changed_between_two_parts_is_named(tmp_path):
    given = read_parts(pairs_job(tmp_path), 50)
    os.utime(tmp_path / "pairs.parquet", ns=(1, 1))
    with pytest.raises(ProblemError, match=r"part 1: pairs.parquet: changed while it was read in parts"):
        solve_parts(given.robot, given.parts, given.options)


def test_what_a_table_warns_of_is_said_once(tmp_path, fg_calib):
    job = pairs_job(tmp_path, more={"Distanc": np.ones(N_PAIRS)})
    ended = fg_calib("calibrate", job, "--parts", 20)
    assert ended.code == 0
    assert len(re.findall("'Distanc' is not used", ended.err)) <= 1


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["job.yaml"], "is of one job"),
        (["--folds", 3], "without --folds"),
        (["--residuals", "parquet"], "no residuals"),
    ],
)
def test_options_without_meaning_for_parts_are_refused(tmp_path, fg_calib, more, why):
    ended = fg_calib("calibrate", tmp_path / "job.yaml", "--parts", 20, *more)
    assert ended.code == 2
    assert why in " ".join(ended.err.replace("│", " ").split())


@pytest.mark.parametrize("n_rows", [10**12, np.int64(7)])
def test_parts_may_have_any_number_of_rows_of_any_kind(tmp_path, n_rows):
    parts = read_parts(poses_job(tmp_path), n_rows).parts
    assert sum(len(part().readings) for part in parts) == 60


def test_predictions_of_poses_in_parts_have_their_line(tmp_path, fg_calib):
    fg_calib("calibrate", poses_job(tmp_path), "--out", tmp_path / "out", "--parts", "30")
    done = fg_calib("predict", tmp_path / "out")
    assert done.code == 1
    assert "of poses in parts, which keep no configurations, expected pairs, or a table whole" in done.err
