"""`fg-calib predict`: what to expect of a calibration that was done."""

import json

import numpy as np
import polars as pl
import pytest
from simulated import LARGE, measure_drawn, small_arm

from fg_calib import Calibration, calibrate
from fg_calib.prediction import workspace

JOINTS = ["q1", "q2", "q3", "q4"]


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder of a small arm's result."""
    folder, robot = tmp_path_factory.mktemp("result"), small_arm(tolerance=LARGE)
    calibrate(robot, measure_drawn(robot, 20, seed=1, sigma=(1e-4, 1e-4)), model="pose").save(folder)
    return folder


@pytest.fixture
def few(monkeypatch):
    """Few configurations all over the workspace."""
    monkeypatch.setattr(workspace, "N_DRAWN", 400)


def test_configurations_in_their_units_get_a_row_each(result, fg_calib, tmp_path):
    found = Calibration.load(result)
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (3, 4))
    in_degrees = q * [1.0 if joint.prismatic else 180.0 / np.pi for joint in found.robot.joints]
    columns = {"id": ["a", "b", "b"]} | dict(zip(JOINTS, in_degrees.T, strict=True))
    pl.DataFrame(columns).write_csv(tmp_path / "program.csv")
    out = tmp_path / "out"
    ended = fg_calib("predict", result, "--at", tmp_path / "program.csv", "--angle", "deg", "--out", out, "--json")
    assert ended.code == 0, ended.err
    document = json.loads(ended.out)
    given = tuple(document[key] for key in ("schema", "at", "n", "counts"))
    assert given == ("fg-calib/predict/1", "configurations", 3, "base")
    poses = found.predict(q)
    for k, one in enumerate(document["configurations"]):
        assert one["readings"] == pytest.approx(q[k], rel=1e-12)
        assert one["base"]["position"] == pytest.approx(np.linalg.norm(poses.sigma_position[k]), rel=1e-9)
        assert one["base"]["orientation"] == pytest.approx(np.linalg.norm(poses.sigma_rotation[k]), rel=1e-9)
    written = pl.read_csv(out / "predict.csv")
    assert written["id"].to_list() == ["a", "b", "b"]
    in_mm = [1e3 * one["base"]["position"] for one in document["configurations"]]
    assert written["base_position_mm"].to_list() == pytest.approx(in_mm, rel=1e-12)
    assert written.select("x", "y", "z").to_numpy() == pytest.approx(poses.position, abs=1e-12)
    assert sorted(file.name for file in out.iterdir()) == ["predict.csv", "predict.json"]
    assert json.loads((out / "predict.json").read_text())["n"] == 3


@pytest.mark.slow
def test_the_workspace_is_drawn_and_written(result, fg_calib, tmp_path, few):
    ended = fg_calib("predict", result, "--limit", "0.5mm", "--out", tmp_path / "out", "--json")
    assert ended.code == 0, ended.err
    document = json.loads(ended.out)
    assert (document["at"], document["n"], document["configurations"]) == ("workspace", 400, [])
    assert document["limit"] == pytest.approx(5e-4)
    written = pl.read_csv(tmp_path / "out" / "predict.csv")
    error = written["base_position_mm"].to_numpy()
    assert document["within"] == pytest.approx(np.mean(error <= 0.5))
    assert document["expected"]["base"]["position"]["rms"] == pytest.approx(np.sqrt(np.mean(error**2)) / 1e3)
    worst = document["worst"]
    assert worst["base"]["position"] == pytest.approx(np.linalg.norm(worst["sigma"]), rel=1e-9)
    assert worst["base"]["position"] * 1e3 == pytest.approx(error.max(), rel=1e-6)
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"predict.csv", "predict.json", "predict.svg"}


def test_a_calibration_that_is_not_to_be_trusted_ends_with_3(result, fg_calib, tmp_path):
    document = json.loads((result / "result.json").read_text())
    document |= {"trustworthy": False, "findings": ["rows do not fit"]}
    for file in result.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "result.json").write_text(json.dumps(document))
    (tmp_path / "program.csv").write_text("q1,q2,q3,q4\n0,0,0,0\n")
    ended = fg_calib("predict", tmp_path, "--at", tmp_path / "program.csv")
    assert ended.code == 3
    assert ended.err.splitlines() == ["not to be trusted: rows do not fit"]
    assert "DOUBTFUL" in ended.out
