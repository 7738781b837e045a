"""`fg-calib correct`: tables of targets in, tables of commands out."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from oracle import tool_pose
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm

from fg_calib import Calibration, calibrate, read_robot
from fg_calib.robot import Thermal

JOINTS = [f"q{i + 1}" for i in range(7)]


@pytest.fixture
def result(calibrated_example):
    return calibrated_example / "result"


def near(n):
    return np.random.default_rng(2).uniform(-1.0, 1.0, (n, 7))


def test_targets_in_their_units_become_commands_in_the_same(result, fg_calib, tmp_path):
    """In mm and degrees, with roll, pitch and yaw and names; read again and held to 4x4 products."""
    found, q = Calibration.load(result), near(5)
    nominal = read_robot(result.parent / "robot_nominal.yaml")
    T = np.array([tool_pose(nominal, row) for row in q])
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)
    columns = {"id": [f"hole {i}" for i in range(5)]}
    columns |= dict(zip("xyz", 1e3 * T[:, :3, 3].T, strict=True))
    columns |= dict(zip(("roll", "pitch", "yaw"), angles.T, strict=True))
    columns |= dict(zip(JOINTS, np.degrees(q).T, strict=True))
    pl.DataFrame(columns).write_csv(tmp_path / "targets.csv")
    out = tmp_path / "commands.csv"
    ended = fg_calib("correct", result, tmp_path / "targets.csv", "--length", "mm", "--angle", "deg", "--out", out)
    assert ended.code == 0, ended.err
    assert "5 of 5 targets can be reached" in ended.out
    written = pl.read_csv(out)
    assert written["id"].to_list() == columns["id"]
    assert written["reached"].to_list() == ["yes"] * 5
    for row, target in zip(written.iter_rows(named=True), T, strict=True):
        commanded = np.radians([row[name] for name in JOINTS])
        assert np.abs(tool_pose(found.robot, commanded)[:3] - target[:3]).max() < 1e-9
        pose = tool_pose(nominal, commanded)
        assert [row[k] for k in "xyz"] == pytest.approx(1e3 * pose[:3, 3], abs=1e-6)
        turned = Rotation.from_quat([row[f"q{k}"] for k in "xyzw"]).as_matrix()
        assert np.abs(turned - pose[:3, :3]).max() < 1e-9


def test_a_program_of_joint_values_and_json(result, fg_calib, tmp_path):
    q = near(3)
    pl.DataFrame(dict(zip(JOINTS, q.T, strict=True))).write_csv(tmp_path / "program.csv")
    ended = fg_calib("correct", result, tmp_path / "program.csv", "--json")
    assert ended.code == 0
    document = json.loads(ended.out)
    assert document["n_reached"] == document["n_targets"] == 3
    assert "nothing is written" in ended.err
    found, nominal = Calibration.load(result), read_robot(result.parent / "robot_nominal.yaml")
    for target, row in zip(document["targets"], q, strict=True):
        there = tool_pose(found.robot, target["readings"])
        assert np.abs(there - tool_pose(nominal, row)).max() < 1e-9
        away = np.linalg.norm((tool_pose(found.robot, row) - there)[:3, 3])
        assert target["uncorrected"]["position"] == pytest.approx(away, rel=1e-6)


def test_what_is_assumed_of_targets_is_said(fg_calib, tmp_path):
    robot = small_arm({"a": 1e-3, "theta": 1e-3}).with_effects(Thermal())
    m = replace(measure(robot, 20, np.random.default_rng(1)), context={"temperature": np.linspace(18.0, 25.0, 20)})
    calibrate(robot, m, model="position").save(tmp_path / "result")
    for more, at, said in (("", "", True), (",temperature", ",22", False)):
        (tmp_path / "targets.csv").write_text(f"q1,q2,q3,q4{more}\n0.1,0.2,0.1,0.3{at}\n")
        ended = fg_calib("correct", tmp_path / "result", tmp_path / "targets.csv")
        assert ("Taken for granted: temperature 20." in ended.out) == said, ended.err


@pytest.mark.slow
def test_targets_out_of_reach_are_named_and_end_with_3(result, fg_calib, tmp_path):
    (tmp_path / "targets.csv").write_text("id,x,y,z\nmoon,384e6,0,0\nhere,1,2,3\n")
    ended = fg_calib("correct", result, tmp_path / "targets.csv", "--out", tmp_path / "commands.csv")
    assert ended.code == 3
    assert "1 of 2 targets are not reached" in ended.err
    assert "Out of reach within the joint limits: moon." in " ".join(ended.out.split())
    assert pl.read_csv(tmp_path / "commands.csv")["reached"].to_list() == ["no", "yes"]
