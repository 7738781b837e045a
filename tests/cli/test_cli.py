"""Commands in process: exit codes, files, messages, and what results promise."""

import csv
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from oracle import tool_pose
from scipy.spatial.transform import Rotation
from tolerances import rounding
from typer.testing import CliRunner

from fg_calib import __version__, cli, read_robot
from fg_calib.cli import entry
from fg_calib.io import read_measurements
from fg_calib.io.units import Units

JOB, POSES, ROBOT, TRUTH = "calibration.yaml", "poses.csv", "robot_nominal.yaml", "robot_true.yaml"
OUTPUTS = {"result.json", "robot_calibrated.yaml", "residuals.csv", "configurations.csv"}
NUMBER = (int, float)


# --- the bundled example, calibrated once ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder with the bundled example, calibrated into `result`, and what the command printed."""
    folder = Path(shutil.copytree(cli.EXAMPLES / "space-robot", tmp_path_factory.mktemp("cli") / "job"))
    ended = CliRunner().invoke(entry.app, ["calibrate", str(folder / JOB), "--out", str(folder / "result")])
    return folder, ended


@pytest.fixture(scope="module")
def result(calibrated):
    return json.loads((calibrated[0] / "result" / "result.json").read_text(), parse_constant=_refuse)


@pytest.fixture(scope="module")
def residuals(calibrated):
    with (calibrated[0] / "result" / "residuals.csv").open() as file:
        return list(csv.DictReader(file))


def _refuse(constant):
    raise AssertionError(f"{constant} is no JSON")


def by_name(result, field="estimate"):
    return {p["name"]: p[field] for p in result["parameters"]}


def calibrate(fg_calib, job, *arguments):
    """The result of a job that ends well."""
    ended = fg_calib("calibrate", job, "--json", *arguments)
    assert (ended.code, ended.err) == (0, "")
    return json.loads(ended.out, parse_constant=_refuse)


def test_calibrating_the_example_ends_well_and_writes_its_files(calibrated):
    folder, ended = calibrated
    assert (ended.exit_code, ended.stderr) == (0, "")
    assert ended.stdout.startswith("space-robot: distance-rotation, pairs: star\nGOOD: converged")
    assert {f.name for f in (folder / "result").iterdir()} == OUTPUTS
    assert {f.name for f in folder.iterdir()} == {JOB, POSES, ROBOT, TRUTH, "result"}


def test_a_result_has_every_key_of_its_schema(result):
    rms = {"train": dict, "test": dict}
    shape = {
        **{"schema": str, "version": str, "robot": str, "model": str, "frame": str, "pairing": str},
        **{"n_configurations": int, "n_pairs": int, "n_residuals": int, "n_priors": int, "n_excluded": dict},
        **{"solver": dict, "trustworthy": bool, "findings": list, "chi2": float, "dof": int, "reduced_chi2": float},
        **{"residual_rms": dict, "parameters": list, "covariance": dict, "frame_estimate": type(None)},
        **{"observability": dict, "inputs": dict},
    }
    assert {key: type(result[key]) for key in shape} == shape  # more may be added
    assert result["schema"] == "fg-calib/result/2"
    assert (result["version"], result["robot"]) == (__version__, "space-robot")
    assert (result["model"], result["frame"], result["pairing"]) == ("distance-rotation", "unknown", "star")
    assert {key: type(value) for key, value in result["residual_rms"].items()} == rms
    solver = {"name": str, "converged": bool, "message": str, "iterations": int, "initial_cost": float, "cost": float}
    solver |= {"seconds": float, "history": list}
    assert {key: type(result["solver"][key]) for key in solver} == solver
    assert result["solver"]["name"] == "gtsam-lm"
    assert result["solver"]["converged"] is True
    observability = {
        **{"schema": str, "model": str, "kind": str, "n_parameters": int, "rank": int, "names": list, "gap": float},
        **{"singular_values": list, "independent": list, "ineffective": list, "relative": list, "null_space": list},
        **{"indices": dict, "condition_number": float},
    }
    assert {key: type(result["observability"][key]) for key in observability} == observability
    for p in result["parameters"]:
        assert list(p) == [
            "name",
            "unit",
            "nominal",
            "estimate",
            "correction",
            "sigma",
            "prior_sigma",
            "identifiability",
            "stands_for",
            "sigma_of_combination",
        ]
        assert p["unit"] in {"m", "rad"}
        assert p["identifiability"] in {"independent", "relative", "ineffective", "fixed"}
        assert p["correction"] == p["estimate"] - p["nominal"]
        assert isinstance(p["sigma"], NUMBER)
        assert isinstance(p["prior_sigma"], NUMBER) == (p["identifiability"] != "fixed")


def test_cost_chi_square_and_degrees_of_freedom_agree(result):
    prior = [(p["correction"] / p["prior_sigma"]) ** 2 for p in result["parameters"] if p["prior_sigma"]]
    assert result["chi2"] == 2 * result["solver"]["cost"]
    assert result["reduced_chi2"] == result["chi2"] / result["dof"]
    assert result["n_priors"] == len(prior) == 30
    assert result["dof"] == result["n_residuals"] + 30 - 30  # priors make every one of the 30 unknowns determined


def test_residuals_have_a_line_for_each_scalar_residual(result, residuals):
    with (cli.EXAMPLES / "space-robot" / POSES).open() as file:
        rows = list(csv.DictReader(file))
    n = {split: sum(r["split"] == split for r in rows) for split in ("train", "test")}
    assert sum(r["used"] == "true" for r in residuals) == result["n_residuals"]
    assert len(residuals) == 2 * (n["train"] - 1) + 2 * (n["test"] - 1)  # a star: distance and angle to the first
    assert {(r["kind"], r["unit"]) for r in residuals} == {("distance", "m"), ("angle", "rad")}
    for r in residuals:
        assert float(r["predicted"]) - float(r["measured"]) == pytest.approx(float(r["residual"]), abs=rounding(1.0))
        assert float(r["residual"]) / float(r["sigma"]) == pytest.approx(float(r["whitened"]), rel=rounding(1, 10))


def test_predictions_are_those_of_the_calibrated_robot(calibrated, residuals):
    """Poses by 4x4 products from robot_calibrated.yaml give the distances and angles of residuals.csv."""
    robot = read_robot(calibrated[0] / "result" / "robot_calibrated.yaml")
    given = read_measurements(calibrated[0] / POSES, robot, units=Units(angle="deg"))
    row = {name: i for i, name in enumerate(given.ids)}
    for r in residuals[::17]:
        a, b = (tool_pose(robot, given.readings[row[r[end]]]) for end in ("a", "b"))
        turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()
        predicted = np.linalg.norm(b[:3, 3] - a[:3, 3]) if r["kind"] == "distance" else turn
        assert float(r["predicted"]) == pytest.approx(predicted, abs=rounding(10.0))  # rounding over a chain of 10 m


def test_the_calibrated_robot_holds_the_estimates(calibrated, result):
    robot = read_robot(calibrated[0] / "result" / "robot_calibrated.yaml")
    nominal = read_robot(calibrated[0] / ROBOT)
    assert {p.name: p.nominal for p in robot.parameters} == by_name(result)
    assert {p.name: p.nominal for p in nominal.parameters} == by_name(result, "nominal")
    assert [(p.name, p.estimated, p.tolerance) for p in robot.parameters] == [
        (p.name, p.estimated, pytest.approx(p.tolerance, rel=rounding()) if p.tolerance else None)
        for p in nominal.parameters
    ]
    assert robot.joints == nominal.joints


def test_the_truth_lies_within_four_sigma(calibrated, result):
    true = {p.name: p.nominal for p in read_robot(calibrated[0] / "robot_true.yaml").parameters}
    errors = [
        (p["estimate"] - true[p["name"]]) / p["sigma"] for p in result["parameters"] if p["identifiability"] != "fixed"
    ]
    assert len(errors) == 30
    assert np.max(np.abs(errors)) < 4
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6  # 30 correlated values of sigma 1: honest, not just wide


def test_inputs_are_named_with_their_hashes(calibrated, result):
    import hashlib

    expected = {
        name: hashlib.sha256((calibrated[0] / name).read_bytes()).hexdigest() for name in (JOB, ROBOT, POSES, TRUTH)
    }
    assert result["inputs"] == expected


# --- how the commands end --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_json_puts_the_result_and_nothing_else_on_stdout(fg_calib, example):
    printed = calibrate(fg_calib, example / JOB, "--out", example / "result")
    written = json.loads((example / "result" / "result.json").read_text())
    for document in (printed, written):
        assert document["solver"].pop("seconds") > 0
    assert set(written.pop("files")) == {"configurations.csv", "residuals.csv"}  # the tables that are beside it
    assert printed == written


@pytest.mark.slow
def test_without_out_nothing_is_written(fg_calib, example, monkeypatch):
    monkeypatch.chdir(example)
    before = sorted(example.iterdir())
    assert fg_calib("calibrate", JOB).code == 0
    assert sorted(example.iterdir()) == before


@pytest.mark.slow
def test_an_existing_folder_keeps_its_other_files(fg_calib, example):
    out = example / "result"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    (out / "result.json").write_text('{\n "schema": "fg-calib/result/1",\n}')
    assert fg_calib("calibrate", example / JOB, "--out", out).code == 0
    assert {f.name for f in out.iterdir()} == OUTPUTS | {"notes.txt"}
    assert (out / "notes.txt").read_text() == "mine"
    assert json.loads((out / "result.json").read_text())["schema"] == "fg-calib/result/2"


def test_a_failure_leaves_an_existing_folder_as_it_was(fg_calib, example):
    out = example / "result"
    out.mkdir()
    (out / "result.json").write_text("old")
    (example / POSES).unlink()
    assert fg_calib("calibrate", example / JOB, "--out", out).code == 1
    assert [(f.name, f.read_text()) for f in out.iterdir()] == [("result.json", "old")]


@pytest.mark.slow
def test_noise_stated_too_small_by_5_is_exit_code_3_with_the_reason_and_results(fg_calib, example):
    text = (example / JOB).read_text()
    (example / JOB).write_text(re.sub("noise: .*", "noise: {position: 0.0002, orientation: 0.002, joint: 0.001}", text))
    ended = fg_calib("calibrate", example / JOB, "--out", example / "result")
    finding = "noise specified too small, unmodelled effects, or outliers"
    assert ended.code == 3
    assert re.fullmatch(rf"not to be trusted: reduced chi-square \S+ is outside \[0.50, 2.00\]: {finding}\n", ended.err)
    assert ended.out.splitlines()[1].startswith("DOUBTFUL: reduced chi-square")
    result = json.loads((example / "result" / "result.json").read_text())
    assert (result["trustworthy"], len(result["findings"])) == (False, 1)
    assert {f.name for f in (example / "result").iterdir()} == OUTPUTS


@pytest.mark.parametrize(
    "arguments",
    [
        ("calibrate",),
        ("inspect", "job.yaml", "more.yaml"),
        ("calibrate", "job.yaml", "--out"),
        ("calibrate", "job.yaml", "--nonsense"),
        ("recalibrate", "job.yaml"),
        ("example", "space-robot"),
        (),
    ],
)
def test_wrong_usage_is_exit_code_2(fg_calib, arguments):
    ended = fg_calib(*arguments)
    assert ended.code == 2
    assert re.search("Usage: fg-calib|requires an argument", ended.err + ended.out)
    assert "Traceback" not in ended.err


def test_the_version_is_printed(fg_calib):
    assert fg_calib("--version") == (0, f"fg-calib {__version__}\n", "")


def test_the_example_is_written_and_its_next_step_named(fg_calib, tmp_path):
    out = tmp_path / "new" / "demo"
    ended = fg_calib("example", "space-robot", "--out", out)
    names = [JOB, POSES, ROBOT, TRUTH]
    assert (ended.code, ended.out) == (0, "")
    assert ended.err == (
        f"wrote {', '.join(names)} to {out}\nnow: fg-calib calibrate {out / JOB} --out {out / 'result'}\n"
    )
    assert sorted(f.name for f in out.iterdir()) == names
    assert all((out / n).read_bytes() == (cli.EXAMPLES / "space-robot" / n).read_bytes() for n in names)


def test_the_example_overwrites_nothing(fg_calib, tmp_path):
    (tmp_path / POSES).write_text("mine")
    ended = fg_calib("example", "space-robot", "--out", tmp_path)
    assert ended == (1, "", f"error: {tmp_path / POSES}: is there already, expected a folder without it\n")
    assert [(f.name, f.read_text()) for f in tmp_path.iterdir()] == [(POSES, "mine")]


@pytest.mark.slow
def test_stdout_closed_by_its_reader_is_no_traceback(example):
    """As in `fg-calib calibrate job.yaml | head -1`."""
    command = [sys.executable, "-m", "fg_calib.cli", "calibrate", str(example / JOB)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()


# --- bad input: exit code 1, one line, nothing written ---------------------------------------------------------------


def sub(file, old, new):
    """Replace the first match of a pattern in a file."""

    def edit(folder):
        text, n = re.subn(old, new, (folder / file).read_text(), count=1, flags=re.M)
        assert n == 1
        (folder / file).write_text(text)

    return edit


def table(change, file=POSES):
    """Change the cells of a table, header included."""

    def edit(folder):
        rows = list(csv.reader((folder / file).read_text().splitlines()))
        rows = change(rows) or rows
        (folder / file).write_text("".join(",".join(row) + "\n" for row in rows))

    return edit


def cell(row, column, value):
    def change(rows):
        rows[row][rows[0].index(column)] = value

    return table(change)


def without(*columns):
    def change(rows):
        kept = [i for i, name in enumerate(rows[0]) if name not in columns]
        return [[row[i] for i in kept] for row in rows]

    return table(change)


def write(file, text):
    return lambda folder: (folder / file).write_text(text)


def pairs(text, *, model="distance-rotation"):
    """A table of pairs, and the job with it."""

    def edit(folder):
        (folder / "pairs.csv").write_text(text)
        sub(JOB, "^model: .*", f"model: {model}\npairs: pairs.csv")(folder)
        sub(JOB, "joint: 0.005", "joint: 0.005, distance: 0.001, angle: 0.01")(folder)

    return edit


ALL_FIXED = ", ".join(f"{kind}{i}" for i in range(1, 8) for kind in ("a", "alpha", "d", "theta", "beta"))

BAD = {
    "no job": (lambda folder: (folder / JOB).unlink(), "{folder}/calibration.yaml: no such file"),
    "no robot": (lambda folder: (folder / ROBOT).unlink(), "{folder}/robot_nominal.yaml: no such file"),
    "no table": (lambda folder: (folder / POSES).unlink(), "{folder}/poses.csv: no such file"),
    "no column": (without("y"), "poses.csv: no column y, expected x y z together"),
    "a joint too few": (
        without("q7"),
        "poses.csv: 6 joint columns (q1, q2, q3, q4, q5, q6), expected q1 to q7 for the robot's 7 joints; the columns "
        "are id, q1, q2, q3, q4, q5, q6, x, y, z, qx, qy, qz, qw, split",
    ),
    "text in a number": (cell(3, "q3", "abc"), "poses.csv:4: q3: found 'abc', expected a finite number"),
    "unknown key in the job": (
        sub(JOB, "^pairing", "pairng"),
        "calibration.yaml: unknown key 'pairng', expected one of robot, measurements, pairs, model, pairing, frame, "
        "units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, "
        "targets, anchors, tolerance, offset, camera, columns; did you mean pairing?",
    ),
    "degrees read as radians": (
        sub(JOB, "angle: deg", "angle: rad"),
        "poses.csv:2: q1 = 75.6136 rad is outside [-3.14159, 3.14159]; is the table in deg?",
    ),
    "outside the limits": (
        cell(2, "q1", "181"),
        "poses.csv:3: q1 = 181 deg is outside [-180, 180]; widen the joint's limits if the reading is right",
    ),
    "an unusable model": (
        sub(JOB, "^model: .*", "model: distances"),
        "calibration.yaml: model: found 'distances', expected one of pose, position, orientation, distance, rotation, "
        "distance-rotation, anchor, plane, board, pixels; did you mean distance?",
    ),
    "no noise": (
        sub(JOB, "^noise.*", ""),
        "pairs from poses.csv: no sigma for distance, expected noise.position or a column sigma_position",
    ),
    "one id twice": (
        cell(2, "id", "p0"),
        "poses.csv:3: id: found 'p0', expected different ids; the same as poses.csv:2",
    ),
    "a table instead of a job": (
        lambda folder: (folder / POSES).replace(folder / JOB),
        "calibration.yaml: found 'id,q1,q2,q3,q4,q5,q6,q7,x,y,z,qx,qy,qz,qw,split p0,75.61..., expected a mapping, "
        "key: value",
    ),
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("edit", "message"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_writes_nothing(fg_calib, example, edit, message):
    edit(example)
    before = sorted(example.iterdir())
    ended = fg_calib("calibrate", example / JOB, "--out", example / "result")
    assert ended == (1, "", f"error: {message.format(folder=example)}\n")
    assert sorted(example.iterdir()) == before


def test_an_output_folder_that_is_a_file_is_one_line_and_the_file_stays(fg_calib, example):
    (example / "result").write_text("mine")
    before = sorted(example.iterdir())
    for out in (example / "result", example / "result" / "below"):
        ended = fg_calib("calibrate", example / JOB, "--out", out)
        assert (ended.code, ended.out) == (1, "")
        assert re.fullmatch(rf"error: {out}: cannot be written: [^\n]+\n", ended.err)
    assert sorted(example.iterdir()) == before
    assert (example / "result").read_text() == "mine"


# --- what must not matter, and other forms of input ------------------------------------------------------------------


def simulate(robot, n, rng, *, sigma=1e-4):
    """Joint readings and measured poses of a robot by 4x4 products: q, xyz, quaternions xyzw."""
    lower, upper = np.nan_to_num(robot.limits, neginf=-2.5, posinf=2.5).T
    q = rng.uniform(lower, upper, (n, robot.n_joints))
    T = np.array([tool_pose(robot, row) for row in q])
    turn = Rotation.from_matrix(T[:, :3, :3]) * Rotation.from_rotvec(sigma * rng.normal(size=(n, 3)))
    return q, T[:, :3, 3] + sigma * rng.normal(size=(n, 3)), turn.as_quat()


def write_poses(path, q, xyz, quaternion, names=None, **more):
    names = names or [f"q{i + 1}" for i in range(q.shape[1])]
    columns = dict(zip(names, q.T, strict=True))
    columns |= dict(zip("xyz", xyz.T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
    frame = pl.DataFrame(columns | more)
    frame.write_parquet(path) if path.suffix == ".parquet" else frame.write_csv(path)


@pytest.mark.slow
def test_test_rows_never_touch_the_estimate(fg_calib, example):
    first = calibrate(fg_calib, example / JOB)
    table(
        lambda rows: [
            row if row[-1] != "test" else [*row[:8], "9", "-7", "5", "1", "0", "0", "0", "test"] for row in rows
        ]
    )(example)
    ended = fg_calib("calibrate", example / JOB, "--json")
    second = json.loads(ended.out)
    assert ended.code == 3
    assert "test rows" in ended.err
    assert second["residual_rms"]["test"] != first["residual_rms"]["test"]
    for key in ("parameters", "covariance", "chi2", "dof", "observability"):
        assert second[key] == first[key]
    assert second["residual_rms"]["train"] == first["residual_rms"]["train"]


URDF = """<?xml version="1.0"?>
<robot name="bent-arm">
  <!-- kept -->
  <link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/><link name="flange"/>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.3" rpy="0 0 0"/><parent link="base"/><child link="upper"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-2.5" upper="2.5" effort="1" velocity="1"/>
  </joint>
  <joint name="elbow" type="continuous">
    <origin xyz="0.4 0 0.1" rpy="0.2 0 0"/><parent link="upper"/><child link="fore"/><axis xyz="1 0 0"/>
  </joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0.3 0.1 0" rpy="0 0.5 0"/><parent link="fore"/><child link="hand"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.4" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed">
    <origin xyz="0.05 0 0" rpy="0 0 0.1"/><parent link="hand"/><child link="flange"/>
  </joint>
</robot>
"""

URDF_JOB = """\
robot: {robot}
measurements: poses.csv
model: pose
frame: known
noise: {{position: 0.0001, orientation: 0.0001}}
"""


def write_urdf_job(folder, robot, tool=(0.0, 0.0, 0.0)):
    """A job on a URDF arm whose elbow stands 2 mm and 3 mrad off, with a tool point 'tool' on its flange."""
    (folder / "arm.urdf").write_text(URDF)
    (folder / JOB).write_text(URDF_JOB.format(robot=robot))
    nominal = read_robot(folder / "arm.urdf")
    error = {"elbow.x": 0.002, "elbow.roll": 0.003, "slide.z": -0.001}
    error |= {f"tool.{k}": v for k, v in zip("xyz", tool, strict=True)}
    true = nominal.with_values([p.nominal + error.get(p.name, 0.0) for p in nominal.parameters])
    q, xyz, quaternion = simulate(true, 40, np.random.default_rng(5))
    write_poses(folder / POSES, q, xyz, quaternion, names=["shoulder", "elbow", "slide"])
    return true


def test_a_urdf_gives_a_calibrated_urdf_that_reads_back_to_the_estimates(fg_calib, tmp_path):
    true = write_urdf_job(tmp_path, "arm.urdf")
    result = calibrate(fg_calib, tmp_path / JOB, "--out", tmp_path / "result")
    assert {f.name for f in (tmp_path / "result").iterdir()} == {
        *(OUTPUTS - {"robot_calibrated.yaml"}),
        "robot_calibrated.urdf",
    }
    calibrated = read_robot(tmp_path / "result" / "robot_calibrated.urdf")
    assert {p.name: p.nominal for p in calibrated.parameters} == by_name(result)
    assert "<!-- kept -->" in (tmp_path / "result" / "robot_calibrated.urdf").read_text()
    q = np.array([[0.3, -1.0, 0.2], [-2.0, 2.0, 0.35]])
    for row in q:
        # 40 poses of 0.1 mm and 0.1 mrad: the fitted poses are good to some 0.1 mm / sqrt(40) times unknowns a row
        assert tool_pose(calibrated, row) == pytest.approx(tool_pose(true, row), abs=2e-4)
        assert tool_pose(read_robot(tmp_path / "arm.urdf"), row) != pytest.approx(tool_pose(true, row), abs=1e-3)


def test_residuals_have_their_columns_and_flags(residuals):
    """Existing columns keep their places; the new ones follow."""
    old = "kind a b split used excluded unit measured predicted residual_before residual sigma whitened"
    assert list(residuals[0]) == [*old.split(), "leverage", "studentised", "weight", "flag", "noise_adds", "suspect"]
    for row in residuals:
        assert row["flag"] == ("excluded" if row["excluded"] else "test" if row["split"] == "test" else "")
