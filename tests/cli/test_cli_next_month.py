"""`check`, `update` and `history` as commands: files, exit codes, messages."""

import json

import numpy as np
import pytest
import yaml
from month import SIGMA, arm, measured
from scipy.spatial.transform import Rotation
from simulated import true_robot, with_changes
from typer.testing import CliRunner

from fg_calib.cli import entry
from fg_calib.io import read_result, write_csv, write_robot


def run(*words):
    ended = CliRunner().invoke(entry.build_app(), list(map(str, words)))
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
    """A folder with a result, and tables of a healthy month and of a slip."""
    folder, rng, robot = tmp_path_factory.mktemp("month"), np.random.default_rng(3), arm()
    true = true_robot(robot, rng)
    write_robot(folder / "robot.yaml", robot)
    write_table(folder / "first.csv", measured(true, 30, rng))
    job = {"robot": "robot.yaml", "measurements": "first.csv", "model": "pose"}
    job |= {"noise": {"position": 1e3 * SIGMA[0], "orientation": float(np.rad2deg(SIGMA[1]))}}
    job |= {"units": {"length": "mm", "angle": "deg"}, "columns": {f"q{i}": f"J{i}" for i in range(1, 7)}}
    (folder / "job.yaml").write_text(yaml.safe_dump(job))
    assert run("calibrate", folder / "job.yaml", "--out", folder / "result")[0] == 0
    write_table(folder / "healthy.csv", measured(true, 8, rng))
    write_table(folder / "slipped.csv", measured(with_changes(true, theta3=3e-3), 10, rng))
    write_table(folder / "after.csv", measured(with_changes(true, theta3=3e-3), 8, rng))
    return folder


def test_a_table_is_read_as_the_job_read_its_own_and_a_job_may_stand_in_its_place(place):
    code, out = run("check", place / "result", place / "healthy.csv", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["schema"] == "fg-calib/check/1"
    assert found["verdict"] == "pass"
    assert found["dof"] == 48
    assert found["rms"]["position"] < 3 * SIGMA[0]
    job = yaml.safe_load((place / "job.yaml").read_text()) | {"measurements": "healthy.csv"}
    (place / "healthy.yaml").write_text(yaml.safe_dump(job))
    code, out = run("check", place / "result", place / "healthy.yaml", "--json")
    assert (code, json.loads(out)["dof"]) == (0, 48)


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
    assert read_result(place / "second").options == read_result(place / "result").options
