"""`fg-calib export`: files whole or not at all, JSON, what it says, and how it ends."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from exported import column, off, ur10
from simulated import measure
from sparing import as_case

from fg_calib import Calibration, calibrate, read_robot, read_urdf, write_robot
from fg_calib.exports.dh import drawn, errors
from fg_calib.robot.model import Robot

TOLERANCE = {"a": 5e-4, "d": 5e-4, "alpha": 5e-4, "theta": 5e-4, "beta": 5e-4}


def calibrated(nominal, true, folder, sigma=(1e-5, 1e-5)):
    rng = np.random.default_rng(0)
    data = measure(true, 40, rng, readings=drawn(true, 40, 0), sigma=sigma)
    calibrate(nominal, data, model="pose").save(folder)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A UR10 calibrated from poses, and the true one."""
    folder = tmp_path_factory.mktemp("export") / "result"
    rows = [[*(p.nominal for p in ur10().parameters if p.owner == i + 1)] for i in range(6)]
    rows = [[a, alpha, d, theta, beta] for theta, d, a, alpha, beta in rows]
    nominal = Robot.from_dh(rows, "dh-hayati", name="ur10", tool=[0, 0, 0.1], tolerance=TOLERANCE)
    calibrated(nominal, off(nominal), folder)
    return folder


@pytest.mark.sampled(2)
@pytest.mark.parametrize("to", ["urdf", as_case("dh", is_slow=True), as_case("mdh", is_slow=True), "hayati", "yaml"])
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
@pytest.mark.parametrize("to", ["urdf", "ur", "tesseract", as_case("dh", is_slow=True), "hayati", "zeros", "yaml"])
def test_stdout_is_the_file_or_the_document(result, to, fg_calib):
    text = fg_calib("export", result, "--to", to)
    document = fg_calib("export", result, "--to", to, "--json")
    assert (text.code, document.code, text.err) == (0, 0, "")
    found = json.loads(document.out)
    assert found["text"] == text.out
    assert (found["schema"], found["to"], found["robot"]) == ("fg-calib/export/1", to, "ur10")
    assert found["notes"] == document.err.splitlines()
    assert found["findings"] == found["not_accepted"] == []


@pytest.mark.slow
def test_zeros_where_it_was_measured_are_better_there(result, fg_calib):
    ended = [json.loads(fg_calib("export", result, "--to", "zeros", *more, "--json").out)
             for more in ((), ("--at", "workspace"), ("--at", "measured"))]  # fmt: skip
    assert ended[0] == ended[1]
    anywhere, there = ended[1:]
    assert set(anywhere["after"]) == {"workspace"}
    assert there["after"]["measured"]["n"] == 40
    reach = Calibration.load(result).robot.reach

    def cost(error):
        return error["position_rms"] ** 2 + (reach * error["rotation_rms"]) ** 2

    assert cost(there["after"]["measured"]) < cost(there["before"]["measured"])
    assert cost(there["after"]["workspace"]) > cost(anywhere["after"]["workspace"])


@pytest.mark.slow
def test_a_robot_is_exported_and_compared_with_the_one_as_drawn(fg_calib, tmp_path):
    write_robot(tmp_path / "drawn.yaml", ur10())
    write_robot(tmp_path / "true.yaml", off(ur10()))
    ended = fg_calib("export", tmp_path / "true.yaml", "--to", "zeros", "--nominal", tmp_path / "drawn.yaml")
    assert ended.code == 0
    assert "# after, over the joint limits: position " in ended.out


@pytest.mark.slow
def test_a_urdf_is_written_as_it_was_but_for_origins(fg_calib, tmp_path):
    nominal = column(tmp_path)
    calibrated(nominal, off(nominal), tmp_path / "result")
    before = (tmp_path / "column.urdf").read_bytes()
    ended = fg_calib("export", tmp_path / "result", "--to", "urdf", "--out", tmp_path / "new.urdf")
    assert (ended.code, ended.err) == (0, f"wrote {tmp_path / 'new.urdf'}\n")
    after = (tmp_path / "new.urdf").read_bytes()
    changed = [(a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    assert len(changed) == 5
    assert all(b"<origin" in a and b"<origin" in b for a, b in changed[:-1])
    robot = Calibration.load(tmp_path / "result").robot
    assert (
        read_urdf(tmp_path / "new.urdf", base_link="floor", tip_link="tip").parameters[6:-6]
        == tuple(
            p
            for p in read_urdf(
                tmp_path / "result" / "robot_calibrated.urdf", base_link="floor", tip_link="tip"
            ).parameters
        )[6:-6]
    )
    zeros = fg_calib("export", tmp_path / "result", "--to", "urdf", "--calibration-elements")
    assert zeros.out.count("<calibration rising=") == robot.n_joints
    assert "what reads it must add `rising`" in zeros.err


FINDING = "reduced chi-square 7 -- far too large"


@pytest.fixture
def doubtful(result, tmp_path):
    """The same result with a finding."""
    folder = Path(shutil.copytree(result, tmp_path / "doubtful"))
    document = json.loads((folder / "result.json").read_text())
    (folder / "result.json").write_text(json.dumps(document | {"findings": [FINDING], "trustworthy": False}))
    return folder


def test_a_result_that_is_not_to_be_trusted_says_so_and_ends_with_3(doubtful, fg_calib, tmp_path):
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


MISTAKES = {
    "no such folder": (("{nowhere}", "--to", "dh"), 1, "error: nowhere: no such file\n"),
    "no result": (("{empty}", "--to", "dh"), 1, "error: {empty}: no result.json in this folder, "),
    "no format": (("{robot}",), 2, "Missing option '--to'"),
    "another format": (("{robot}", "--to", "kuka"), 2, "'kuka' is not one of 'urdf', 'ur', 'tesseract'"),
    "a file that is there": (("{robot}", "--to", "dh", "--out", "{robot}"), 1, "error: {robot}: is there already, "),
    "no folder": (("{robot}", "--to", "dh", "--out", "{empty}/a/b"), 1, "error: {empty}/a/b: there is no folder "),
    "a folder": (("{robot}", "--to", "dh", "--out", "{empty}"), 1, "error: {empty}: is there already, "),
    "five joints": (
        ("{robot}", "--to", "ur"),
        1,
        "error: robot: 2 joints, 0 of which slide, expected six joints that turn",
    ),
    "no drawing": (("{robot}", "--to", "zeros"), 1, "error: zeros: an arm without the one as drawn, expected a RESULT"),
    "measured nowhere": (("{robot}", "--to", "zeros", "--at", "measured"), 2, "needs a RESULT"),
    "an idle place": (("{robot}", "--to", "dh", "--at", "workspace"), 2, "means nothing for dh"),
    "an idle tool": (("{robot}", "--to", "dh", "--tool", "nominal"), 1, "error: tool: means nothing for dh, "),
    "links of no URDF": (("{robot}", "--to", "dh", "--tip-link", "a"), 1, "error: robot.yaml: a robot without links, "),
    "links of a result": (("{empty}", "--to", "dh", "--tip-link", "a"), 2, "a RESULT knows its links"),
    "no URDF": (
        ("{robot}", "--to", "urdf", "--calibration-elements"),
        1,
        "error: calibration_elements: an arm that is no",
    ),
}


@pytest.mark.sampled(6)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_a_line_and_leaves_no_file(mistake, fg_calib, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "empty").mkdir()
    (tmp_path / "robot.yaml").write_text(
        "convention: dh\njoints: [{a: 1, alpha: 0, d: 0, theta: 0}, {a: 1, alpha: 0, d: 0, theta: 0}]\n"
    )
    places = {"robot": "robot.yaml", "empty": "empty", "nowhere": "nowhere"}
    words, code, message = MISTAKES[mistake]
    ended = fg_calib("export", *(word.format(**places) for word in words))
    assert (ended.code, ended.out) == (code, "")
    assert message.format(**places) in ended.err
    assert code == 2 or ended.err.count("\n") == 1
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["empty", "robot.yaml"]
