"""Commands in process: exit codes, files, messages, and what results promise."""

import csv
import hashlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from exported import TREE
from oracle import tool_pose
from scipy.spatial.transform import Rotation
from simulated import measure, with_changes, write_job
from tolerances import rounding
from typer.testing import CliRunner

from fg_calib import __version__, cli, read_robot
from fg_calib.cli import entry
from fg_calib.io import Units, read_measurements

JOB, POSES, ROBOT, TRUTH = "calibration.yaml", "poses.csv", "robot_nominal.yaml", "robot_true.yaml"
OUTPUTS = {"result.json", "robot_calibrated.yaml", "residuals.csv", "configurations.csv"}
NUMBER = (int, float)
DOCUMENT = """schema version robot model frame pairing n_configurations n_pairs n_residuals n_priors n_excluded solver
trustworthy findings chi2 dof reduced_chi2 residual_rms parameters covariance frame_estimate observability inputs"""
SOLVER = "name converged message iterations initial_cost cost seconds history"
OBSERVABILITY = """schema model kind n_parameters rank names gap singular_values independent ineffective relative
null_space indices condition_number"""
PARAMETER = "name unit nominal estimate correction sigma prior_sigma identifiability stands_for sigma_of_combination"


# --- the bundled example, calibrated once ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder with the bundled example, calibrated into `result`, and what the command printed."""
    folder = Path(shutil.copytree(cli.EXAMPLES / "space-robot", tmp_path_factory.mktemp("cli") / "job"))
    ended = CliRunner().invoke(entry.build_app(), ["calibrate", str(folder / JOB), "--out", str(folder / "result")])
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


def test_calibrating_the_example_ends_well_and_writes_its_files(calibrated, result):
    folder, ended = calibrated
    assert (ended.exit_code, ended.stderr) == (0, "")
    assert ended.stdout.startswith("space-robot: distance-rotation, pairs: star\nGOOD: converged")
    assert {f.name for f in (folder / "result").iterdir()} == OUTPUTS
    assert {f.name for f in folder.iterdir()} == {JOB, POSES, ROBOT, TRUTH, "result"}
    hashes = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (JOB, ROBOT, POSES, TRUTH)}
    assert result["inputs"] == hashes


def test_a_result_has_every_key_of_its_schema(result):
    assert result.keys() >= set(DOCUMENT.split())  # more may be added
    assert result["schema"] == "fg-calib/result/2"
    assert (result["version"], result["robot"]) == (__version__, "space-robot")
    assert (result["model"], result["frame"], result["pairing"]) == ("distance-rotation", "unknown", "star")
    assert result["residual_rms"].keys() == {"train", "test"}
    assert result["solver"].keys() >= set(SOLVER.split())
    assert result["solver"]["name"] == "gtsam-lm"
    assert result["solver"]["converged"] is True
    assert result["observability"].keys() >= set(OBSERVABILITY.split())
    for p in result["parameters"]:
        assert " ".join(p) == PARAMETER
        assert p["unit"] in {"m", "rad"}
        assert p["identifiability"] in {"independent", "relative", "ineffective", "fixed"}
        assert p["correction"] == p["estimate"] - p["nominal"]
        assert isinstance(p["sigma"], NUMBER)
        assert isinstance(p["prior_sigma"], NUMBER) == (p["identifiability"] != "fixed")


def test_residuals_have_a_line_for_each_scalar_residual(result, residuals):
    with (cli.EXAMPLES / "space-robot" / POSES).open() as file:
        rows = list(csv.DictReader(file))
    n = {split: sum(r["split"] == split for r in rows) for split in ("train", "test")}
    assert sum(r["used"] == "true" for r in residuals) == result["n_residuals"]
    old = "kind a b split used excluded unit measured predicted residual_before residual sigma whitened"
    assert list(residuals[0]) == [*old.split(), "leverage", "studentised", "weight", "flag", "noise_adds", "suspect"]
    assert len(residuals) == 2 * (n["train"] - 1) + 2 * (n["test"] - 1)  # a star: distance and angle to the first
    assert {(r["kind"], r["unit"]) for r in residuals} == {("distance", "m"), ("angle", "rad")}
    for r in residuals:
        assert r["flag"] == ("excluded" if r["excluded"] else "test" if r["split"] == "test" else "")
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
        assert float(r["predicted"]) == pytest.approx(predicted, abs=1e-6)  # values are rounded to 1e-8


def test_the_calibrated_robot_holds_the_estimates(calibrated, result):
    robot = read_robot(calibrated[0] / "result" / "robot_calibrated.yaml")
    nominal = read_robot(calibrated[0] / ROBOT)
    assert robot.units == ("m", "deg")  # as the nominal one, rounded to 10 nm and 10 nrad
    assert {p.name: p.nominal for p in robot.parameters} == pytest.approx(by_name(result), rel=0.0, abs=5.1e-9)
    assert {p.name: p.nominal for p in nominal.parameters} == by_name(result, "nominal")
    assert [(p.name, p.estimated, p.tolerance) for p in robot.parameters] == [
        (p.name, p.estimated, pytest.approx(p.tolerance, rel=rounding()) if p.tolerance else None)
        for p in nominal.parameters
    ]
    assert robot.joints == nominal.joints


# --- how the commands end --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_json_puts_the_result_and_nothing_else_on_stdout(fg_calib, example):
    printed = calibrate(fg_calib, example / JOB, "--out", example / "result")
    written = json.loads((example / "result" / "result.json").read_text())
    for document in (printed, written):
        assert document["solver"].pop("seconds") > 0
    assert printed.pop("files") == {}
    assert set(written.pop("files")) == {"configurations.csv", "residuals.csv"}  # the tables next to it
    assert printed == written


def test_noise_specified_too_small_by_5_is_exit_code_3_with_the_reason_and_results(fg_calib, example):
    text = (example / JOB).read_text()
    (example / JOB).write_text(re.sub("noise: .*", "noise: {position: 0.0002, orientation: 0.002, joint: 0.001}", text))
    ended = fg_calib("calibrate", example / JOB, "--out", example / "result")
    finding = "noise specified too small, unmodelled effects, or outliers"
    assert ended.code == 3
    too_small, no_gain = ended.err.splitlines()
    assert re.fullmatch(rf"not to be trusted: reduced chi-square \S+ is outside \[0.50, 2.00\]: {finding}", too_small)
    assert "test rows are predicted no better than by the nominal arm" in no_gain
    assert ended.out.splitlines()[1].startswith("DOUBTFUL: reduced chi-square")
    result = json.loads((example / "result" / "result.json").read_text())
    assert (result["trustworthy"], len(result["findings"])) == (False, 2)
    assert {f.name for f in (example / "result").iterdir()} == OUTPUTS


def test_the_version_is_printed(fg_calib):
    assert fg_calib("--version") == (0, f"fg-calib {__version__}\n", "")


def test_the_example_is_written_and_its_next_step_named(fg_calib, tmp_path):
    out = tmp_path / "new" / "demo"
    ended = fg_calib("example", "space-robot", "--out", out)
    names = [JOB, POSES, ROBOT, TRUTH]
    assert (ended.code, ended.out) == (0, "")
    next_step = f"now: fg-calib calibrate {out / JOB} --out {out / 'result'}\n"
    assert ended.err == f"wrote {', '.join(names)} to {out}\n{next_step}"
    assert sorted(f.name for f in out.iterdir()) == names
    assert all((out / n).read_bytes() == (cli.EXAMPLES / "space-robot" / n).read_bytes() for n in names)


# --- what must not matter, and other forms of input ------------------------------------------------------------------


def test_a_urdf_gives_a_calibrated_urdf_that_reads_back_to_the_estimates(fg_calib, tmp_path):
    """40 poses of 0.1 mm and 0.1 mrad determine a pose to some 0.1 mm / sqrt(40) times the parameters of a row."""
    (tmp_path / "arm.urdf").write_text(TREE)
    nominal = read_robot(tmp_path / "arm.urdf", tip_link="tip")
    rng = np.random.default_rng(5)
    true = with_changes(nominal, **{"swivel.x": 0.002, "swivel.roll": 0.003, "turn.z": -0.001})
    lower, upper = np.nan_to_num(nominal.limits, neginf=-2.5, posinf=2.5).T
    q = rng.uniform(lower, upper, (42, nominal.n_joints))
    rows = measure(true, 40, rng, readings=q[:40], sigma=(1e-4, 1e-4))
    job = write_job(tmp_path, nominal, rows, robot={"urdf": "arm.urdf", "tip_link": "tip"}, model="pose")
    result = calibrate(fg_calib, job, "--out", tmp_path / "result")
    written = tmp_path / "result" / "robot_calibrated.urdf"
    assert {f.name for f in written.parent.iterdir()} == {*OUTPUTS - {"robot_calibrated.yaml"}, written.name}
    calibrated = read_robot(written, tip_link="tip")
    assert {p.name: p.nominal for p in calibrated.parameters} == by_name(result)
    assert "<!-- no axis: x -->" in written.read_text()
    for row in q[40:]:
        assert tool_pose(calibrated, row) == pytest.approx(tool_pose(true, row), abs=2e-4)
        assert tool_pose(nominal, row) != pytest.approx(tool_pose(true, row), abs=1e-3)
