"""`check`, `update` and `history` as commands: files, exit codes, messages."""

import json

import numpy as np
import pytest
import yaml
from month import SIGMA, arm, measured, slipped
from scipy.spatial.transform import Rotation
from simulated import true_robot
from typer.testing import CliRunner

from fg_calib.cli import entry
from fg_calib.io import read_result, write_robot
from fg_calib.io.columns import write_csv


def run(*words):
    ended = CliRunner().invoke(entry.app, list(map(str, words)))
    if ended.exception is not None and not isinstance(ended.exception, SystemExit):
        return 1, str(ended.exception)
    return ended.exit_code, ended.stdout


def write_table(path, m):
    """In mm and deg, with columns of its own."""
    columns = {"id": m.ids} | {f"J{i + 1}": np.rad2deg(q) for i, q in enumerate(m.readings.T)}
    columns |= dict(zip("xyz", 1e3 * m.position.T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(m.rotation.copy()).as_quat().T, strict=True))
    write_csv(path, columns)
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a result, and tables of a healthy month, of a slip, and of a wrong kind."""
    folder, rng, robot = tmp_path_factory.mktemp("month"), np.random.default_rng(3), arm()
    true = true_robot(robot, rng)
    write_robot(folder / "robot.yaml", robot)
    write_table(folder / "first.csv", measured(true, 30, rng))
    job = {
        "robot": "robot.yaml",
        "measurements": "first.csv",
        "model": "pose",
        "units": {"length": "mm", "angle": "deg"},
        "noise": {"position": 1e3 * SIGMA[0], "orientation": float(np.rad2deg(SIGMA[1]))},
        "columns": {f"q{i}": f"J{i}" for i in range(1, 7)},
    }
    (folder / "job.yaml").write_text(yaml.safe_dump(job))
    assert run("calibrate", folder / "job.yaml", "--out", folder / "result")[0] == 0
    write_table(folder / "healthy.csv", measured(true, 8, rng))
    write_table(folder / "slipped.csv", measured(slipped(true, theta3=3e-3), 10, rng))
    write_table(folder / "after.csv", measured(slipped(true, theta3=3e-3), 8, rng))
    (folder / "wrong.csv").write_text("J1,J2,J3\n1,2,3\n")
    return folder


def test_a_table_is_read_as_the_job_read_its_own(place):
    code, out = run("check", place / "result", place / "healthy.csv", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["schema"] == "fg-calib/check/1"
    assert found["verdict"] == "pass"
    assert found["dof"] == 48
    assert found["rms"]["position"] < 3 * SIGMA[0]


@pytest.mark.slow
def test_a_slip_fails_is_named_and_is_mended_by_an_update(place):
    code, out = run("check", place / "result", place / "slipped.csv", "--limit", "0.2mm")
    assert code == 3
    assert out.startswith("FAIL")
    assert "theta3" in out
    code, _ = run("update", place / "result", place / "slipped.csv", "--changed", "theta3", "--out", place / "second",
                  "--date", "2100-01-01")  # fmt: skip
    assert code == 0
    assert run("check", place / "second", place / "after.csv", "--limit", "0.2mm")[0] == 0
    assert run("report", place / "second")[0] == 0
    assert run("compare", place / "result", place / "second")[0] == 0
    assert read_result(place / "second").options == read_result(place / "result").options


def test_a_job_may_stand_in_place_of_a_table(place):
    job = yaml.safe_load((place / "job.yaml").read_text()) | {"measurements": "healthy.csv"}
    (place / "healthy.yaml").write_text(yaml.safe_dump(job))
    code, out = run("check", place / "result", place / "healthy.yaml", "--json")
    assert (code, json.loads(out)["dof"]) == (0, 48)


BAD = {
    "a table without the columns": (["check", "result", "wrong.csv"], "wrong.csv"),
    "a limit that is none": (["check", "result", "healthy.csv", "--limit", "0.5 parsec"], "--limit"),
    "a name of no table": (["check", "result", "healthy.csv", "--like", "x.csv"], "one of first.csv"),
    "rows that are in it": (["update", "result", "first.csv", "--out", "new"], "in the calibration already"),
    "its own folder": (["update", "result", "healthy.csv", "--out", "result"], "the folder of the result"),
    "a bare growth": (["update", "result", "healthy.csv", "--growth", "theta", "--out", "new"], "NAME=FIGURE"),
    "a date before": (
        ["update", "result", "healthy.csv", "--date", "1999-01-01", "--out", "new"],
        "is before the calibration",
    ),
}  # fmt: skip


@pytest.mark.sampled(4)
@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_one_line(place, what, monkeypatch):
    monkeypatch.chdir(place)
    words, expected = BAD[what]
    code, message = run(*words)
    assert code == 1
    assert expected in message
    assert "\n" not in message
    assert not (place / "new").exists()
