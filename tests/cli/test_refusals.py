"""What no command can use is refused in one line, with exit code 1, or 2 for usage; nothing is printed or written."""

import re
import shutil

import pytest

JOB, POSES, ROBOT = "calibration.yaml", "poses.csv", "robot_nominal.yaml"


def replaced(file, old, new):
    """Replace the first match of a pattern in a file."""

    def edit(folder):
        text, n = re.subn(old, new, (folder / file).read_text(), count=1, flags=re.M)
        assert n == 1
        (folder / file).write_text(text)

    return edit


def written(text, file="table.csv"):
    return lambda folder: (folder / file).write_text(text)


def without(file):
    return lambda folder: (folder / file).unlink()


CALIBRATE = ("calibrate", JOB, "--out", "out")
OBSERVE = ("observe", ROBOT, "--configurations", POSES, "--angle", "deg")
CORRECT = ("correct", "result", "table.csv")
PREDICT = ("predict", "result", "--at", "table.csv", "--out", "out")
UPDATE = ("update", "result", POSES, "--out", "out")
DESIGN = ("design", JOB, "--out", "out")
EXPORT = ("export", ROBOT, "--to", "dh")
JOINTS = "q1,q2,q3,q4,q5,q6,q7\n"
CENTRE = "0,0,0,0,0,0,0\n"


def nothing(_folder):
    pass


# Edit of the example's folder, command, what the one line holds.
INPUT = {
    "no job": (without(JOB), CALIBRATE, "calibration.yaml: no such file"),
    "no table": (without(POSES), CALIBRATE, "poses.csv: no such file"),
    "no table, over a result": (without(POSES), (*CALIBRATE[:-1], "result"), "poses.csv: no such file"),
    "an unknown key": (replaced(JOB, "^pairing", "pairng"), CALIBRATE, "unknown key 'pairng', expected one of pairs,"),
    "degrees read as radians": (replaced(JOB, "angle: deg", "angle: rad"), CALIBRATE,
                                "poses.csv:2: q1 = 75.6136 rad is outside [-3.14159, 3.14159]; is it in deg?"),
    "an unknown model": (replaced(JOB, "^model: .*", "model: distances"), CALIBRATE, "did you mean distance?"),
    "no noise": (replaced(JOB, "^noise.*", ""), CALIBRATE, "no sigma for distance, expected noise.position or a"),
    "a table as the job": (nothing, ("calibrate", POSES), "expected a mapping, key: value"),
    "an output folder that is a file": (written("mine", "out"), CALIBRATE, "out: cannot be written: "),
    "no robot to observe": (nothing, ("observe", "missing.yaml"), "missing.yaml: no such file"),
    "noise of zero": (nothing, (*OBSERVE, "--position-noise", 0),
                      "noise: position: found 0.0, expected a finite number"),
    "orientations alone": (written("qx,qy,qz,qw\n0,0,0,1\n"), CORRECT, "orientations without x y z"),
    "a table of no frame": (written("x,y,z\n1,2,3\n"), (*CORRECT, "--table", 0), "table: found 0 without world"),
    "a frame that is known": (written("x,y,z\n1,2,3\n"), (*CORRECT, "--world"),
                              "world: the measurement frame was not estimated"),
    "commands over a file": (written("mine"), (*CORRECT, "--out", "table.csv"), "table.csv: is there already"),
    "no joint columns": (written("a\n1\n"), PREDICT, "no joint columns"),
    "no configurations": (written(JOINTS), PREDICT, "table.csv"),
    "a limit that is an angle": (written(JOINTS + CENTRE), (*PREDICT, "--limit", "0.5deg"), "--limit"),
    "a prediction over a stranger's file": (written("mine", "predict.csv"), ("predict", "result", "--out", "."),
                                            "not written by this command"),
    "another table to check": (written("x,y\n1,2\n"), ("check", "result", "table.csv"), "table.csv"),
    "a name of no table": (nothing, ("check", "result", POSES, "--like", "x.csv"), "one of poses.csv"),
    "rows that were counted": (nothing, UPDATE, "in the calibration already"),
    "a bare growth": (nothing, (*UPDATE, "--growth", "theta"), "NAME=FIGURE"),
    "a date before": (nothing, (*UPDATE, "--date", "1999-01-01"), "is before the calibration"),
    "the folder of the result": (nothing, (*UPDATE[:-1], "result"), "the folder of the result"),
    "too many stops": (nothing, (*DESIGN, "--n", 100000), "n: "),
    "a target without unit": (nothing, (*DESIGN, "--target", "0.3"), "--target: 0.3; give a unit, such as 0.3mm"),
    "a folder without result": (lambda folder: (folder / "empty").mkdir(), ("export", "empty", "--to", "dh"),
                                "error: empty: no result.json, "),
    "an export over a file": (nothing, (*EXPORT, "--out", ROBOT), f"error: {ROBOT}: is there already, "),
    "an example over a file": (nothing, ("example", "space-robot", "--out", "."),
                               f"{JOB}: is there already, expected a folder without it"),
}  # fmt: skip

# Command, what is said of it.
USAGE = {
    "no command": ((), "Usage: fg-calib"),
    "an unknown command": (("recalibrate", JOB), "recalibrate"),
    "no job": (("calibrate",), "JOB"),
    "an example without folder": (("example", "space-robot"), "--out"),
    "a page without folder": (("calibrate", JOB, "--report"), "needs --out"),
    "an unknown model": (("observe", ROBOT, "--model", "poses"), "--model"),
    "noise below zero": ((*OBSERVE, "--joint-noise", -1), "--joint-noise"),
    "stops and an accuracy": ((*DESIGN, "--n", 3, "--target", "1mm"), "--n and --target"),
    "an unknown format": (("export", ROBOT, "--to", "kuka"), "'kuka' is not one of 'urdf', 'ur', 'tesseract'"),
    "a robot measured": (("export", ROBOT, "--to", "zeros", "--at", "measured"), "needs a RESULT"),
    "links of a result": (("export", "result", "--to", "dh", "--tip-link", "a"), "a RESULT knows its links"),
}


@pytest.fixture
def place(calibrated_example, tmp_path, monkeypatch):
    """A copy of the folder, which is the current one."""
    monkeypatch.chdir(shutil.copytree(calibrated_example, tmp_path / "job"))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path / "job"


def content(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("edit", "words", "message"), INPUT.values(), ids=INPUT)
def test_input_that_cannot_be_used_is_one_line_and_changes_nothing(fg_calib, place, edit, words, message):
    edit(place)
    before = content(place)
    ended = fg_calib(*words)
    assert (ended.code, ended.out) == (1, "")
    assert message in ended.err
    assert ended.err.startswith("error: ")
    assert ended.err.count("\n") == 1
    assert content(place) == before


@pytest.mark.parametrize(("words", "message"), USAGE.values(), ids=USAGE)
def test_wrong_usage_is_exit_code_2(fg_calib, place, words, message):
    before = content(place)
    ended = fg_calib(*words)
    assert ended.code == 2
    assert message in ended.err + ended.out
    assert "Traceback" not in ended.err
    assert content(place) == before
