"""`fg-calib export`: files whole or not at all, JSON, what it says, and how it ends."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from exported import UR10, off, ur10
from month import placed
from simulated import TOOL, measure, with_changes, write_job
from sparing import as_case

from fg_calib import Calibration, Robot, calibrate, export, read_robot
from fg_calib.exports.dh import drawn, errors
from fg_calib.io import read_urdf, write_robot

DH, MDH = (as_case(one, is_slow=True) for one in ("dh", "mdh"))
TOLERANCE = {"a": 5e-4, "d": 5e-4, "alpha": 5e-4, "theta": 5e-4, "beta": 5e-4}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A UR10 calibrated from poses, and the true one."""
    folder = tmp_path_factory.mktemp("export") / "result"
    nominal = Robot.from_dh(UR10, "dh-hayati", name="ur10", tool=[0, 0, 0.1], tolerance=TOLERANCE)
    true = off(nominal)
    data = measure(true, 40, np.random.default_rng(0), readings=drawn(true, 40, 0), sigma=(1e-5, 1e-5))
    calibrate(nominal, data, model="pose").save(folder)
    return folder


@pytest.mark.sampled(2)
@pytest.mark.parametrize("to", ["urdf", DH, MDH, "hayati", "poe", "yaml"])
def test_a_file_is_the_calibrated_arm(result, to, fg_calib, tmp_path):
    out = tmp_path / ("arm.urdf" if to == "urdf" else "arm.yaml")
    ended = fg_calib("export", result, "--to", to, "--out", out)
    assert (ended.code, ended.out) == (0, "")
    assert ended.err.splitlines()[0] == f"wrote {out}"
    robot = Calibration.load(result).robot
    error = errors(read_robot(out), robot, drawn(robot, 100, 0))
    assert error.position_max < (1e-3 if to in ("dh", "mdh") else 1e-9)
    assert [file.name for file in tmp_path.iterdir()] == [out.name]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("to", ["urdf", "ur", "tesseract", DH, "hayati", "poe", "cpc", "zeros", "yaml"])
def test_stdout_is_the_file_or_the_document(result, to, fg_calib):
    text = fg_calib("export", result, "--to", to)
    document = fg_calib("export", result, "--to", to, "--json")
    assert (text.code, document.code, text.err) == (0, 0, "")
    found = json.loads(document.out)
    assert found["text"] == text.out
    assert (found["schema"], found["to"], found["robot"]) == ("fg-calib/export/1", to, "ur10")
    assert found["notes"] == document.err.splitlines()
    assert found["findings"] == found["not_accepted"] == []


@pytest.mark.parametrize("to", ["dh", MDH, "mdh-hayati", "dh-hayati", "poe", "cpc", "urdf"])
def test_a_robot_is_converted_and_what_the_other_convention_cannot_hold_is_said(to, fg_calib, tmp_path):
    robot, out = off(ur10()), tmp_path / ("out.urdf" if to == "urdf" else "out.yaml")
    write_robot(tmp_path / "arm.yaml", robot)
    ended = fg_calib("convert", tmp_path / "arm.yaml", "--to", to, "--out", out)
    miss, lost = errors(read_robot(out), robot, drawn(robot, 100, 0)).position_max, to in ("dh", "mdh")
    assert (ended.code, lost, "the same arm" in ended.err) == (0, "NOT EXACT: axes 2 and 3" in ended.err, not lost)
    assert (1e-5 < miss < 2e-3) if lost else miss < 1e-12
    again = fg_calib("convert", tmp_path / "arm.yaml", "--to", to, "--out", out)
    assert (again.code, again.err) == (1, f"error: {out}: is there already, expected a folder without it\n")


ZEROS = np.deg2rad([0.5, -0.3, 0.8, -1.0, 0.4, 6.2])


@pytest.mark.parametrize("form", ["dh", "urdf"])
def test_zeros_that_cannot_be_told_stay_0_and_what_takes_them_up_is_named(form, fg_calib, tmp_path):
    """Joint 1 from the unknown frame and joint 6 from the tool; the others are found, and nothing else moves."""
    nominal, rng = ur10("dh"), np.random.default_rng(1)
    true = with_changes(nominal, **dict(zip(nominal.zero_names, ZEROS, strict=True)))
    data = measure(true, 30, rng, frame=placed(rng))
    robot = {}
    if form == "urdf":
        export(nominal, "urdf").write(tmp_path / "arm.urdf")
        nominal, robot = read_urdf(tmp_path / "arm.urdf"), {"robot": {"urdf": "arm.urdf"}}
    job = write_job(tmp_path, nominal, data, model="pose", frame="unknown", estimate=["zeros", *TOOL], **robot)
    assert fg_calib("calibrate", job, "--out", tmp_path / "result").code == 0
    rows = yaml.safe_load(fg_calib("export", tmp_path / "result", "--to", "zeros").out)["zeros"]
    blind = "the measurement is blind to the base: the whole arm moves as one body"
    assert rows["q1"] == {"zero": 0.0, "unit": "deg", "sigma": "not determined", "note": blind}
    tilted = ", tool.pitch, tool.roll" * (form == "urdf")  # its tool is seen from the flange's fixed joint
    assert rows["q6"] == rows["q1"] | {"note": f"taken up by tool.x, tool.y, tool.yaw{tilted}"}
    for name, zero in zip(["q2", "q3", "q4", "q5"], np.rad2deg(ZEROS[1:5]), strict=True):
        assert abs(rows[name]["zero"] - zero) < 4.0 * rows[name]["sigma"] < 0.2
    found = Calibration.load(tmp_path / "result")
    assert {name for name, p in found.parameters.items() if p.correction} <= {*nominal.zero_names[1:5], *TOOL}
    written = errors(read_robot(tmp_path / "result" / "robot_calibrated.yaml"), found.robot, drawn(found.robot, 100, 0))
    assert max(written.position_max, written.rotation_max) < 1e-7  # its values are rounded


FINDING = "reduced chi-square 7 -- far too large"


def test_a_result_that_is_not_to_be_trusted_says_so_and_ends_with_3(result, fg_calib, tmp_path):
    doubtful = Path(shutil.copytree(result, tmp_path / "doubtful"))
    document = json.loads((doubtful / "result.json").read_text())
    (doubtful / "result.json").write_text(json.dumps(document | {"findings": [FINDING], "trustworthy": False}))
    for to in ("hayati", "tesseract"):
        ended = fg_calib("export", doubtful, "--to", to)
        assert ended.code == 3
        assert ended.err.splitlines()[-1] == f"not to be trusted: {FINDING}"
        assert ended.out.splitlines()[1] == f"# NOT TO BE TRUSTED: {FINDING}"
    ended = fg_calib("export", doubtful, "--to", "urdf", "--out", tmp_path / "arm.urdf", "--json")
    assert ended.code == 3
    assert json.loads(ended.out)["findings"] == [FINDING]
    assert "<!-- NOT TO BE TRUSTED: reduced chi-square 7 - - far too large -->" in (tmp_path / "arm.urdf").read_text()
    assert read_urdf(tmp_path / "arm.urdf").n_joints == 6


def test_names_steer_no_terminal(fg_calib, tmp_path, monkeypatch):
    write_robot(tmp_path / "arm.yaml", Robot.from_dh([[0.1, 0, 0.2, 0]], names=["\u202eone"], name="\u2066arm"))
    piped = fg_calib("export", tmp_path / "arm.yaml", "--to", "urdf")
    assert "\u202eone" in piped.out
    monkeypatch.setattr("fg_calib.cli.export.sys.stdout.isatty", lambda: True)
    shown = fg_calib("export", tmp_path / "arm.yaml", "--to", "urdf")
    assert r'name="\u202eone"' in shown.out
    assert all(line.isprintable() for line in shown.out.split("\n"))
