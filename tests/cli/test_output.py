"""What commands print: nothing from files steers a terminal, and no stream or limit ends one in a traceback."""

import csv
import os
import subprocess
import sys

import pytest

from fg_calib import Calibration, calibrate_job, simulate
from fg_calib.simulation import read_scenario, write_simulation

STEERING = "\x1b[31m\x07\b\x9b2J\x7f\u202e\u2066[/red]"
"""What turns a terminal red, rings, goes back, clears the screen, deletes, and turns the direction of reading."""

"""The same as it is shown."""

ROBOT = """
name: "arm{0}\\nGOOD"
convention: mdh
units: {{length: m, angle: deg}}
joints:
- {{name: "one{0}", a: 0.0, alpha: 0.0, d: 0.33, theta: 0.0, limits: [-170.0, 170.0]}}
- {{name: "two{0}", a: 0.05, alpha: -90.0, d: 0.0, theta: 0.0, limits: [-120.0, 120.0]}}
- {{name: "three{0}", a: 0.6, alpha: 0.0, d: 0.0, theta: 0.0, limits: [-150.0, 150.0]}}
tolerance: {{a: 0.001, d: 0.001, theta: 0.05, alpha: 0.05}}
"""

SCENARIO = """
robot: robot.yaml
units: {length: m, angle: deg}
errors: {normal: tolerance}
configurations: {random: {count: 25}}
noise: {position: 0.0005, orientation: 0.02, joint: 0.01}
frame: unknown
job: {model: pose, encoder: estimated}
"""


def quoted(text):
    """As a quoted word of YAML."""
    return "".join(c if " " <= c <= "~" else f"\\\\u{ord(c):04x}"[1:] for c in text)


def clean(text):
    return all(line.isprintable() for line in text.split("\n"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A job all of whose names would steer a terminal, the folder's and those of files included."""
    folder = tmp_path_factory.mktemp("steering") / f"job{STEERING.replace('/', '')}"
    folder.mkdir()
    (folder / "robot.yaml").write_text(ROBOT.format(quoted(STEERING)))
    (folder / "scenario.yaml").write_text(SCENARIO)
    return folder


@pytest.fixture(scope="module")
def job(folder):
    """A simulated job in which two rows are grossly wrong, and ids and the table's name would steer a terminal."""
    write_simulation(folder, simulate(read_scenario(folder / "scenario.yaml"), 1))
    rows = list(csv.reader((folder / "poses.csv").read_text().splitlines()))
    for k, row in enumerate(rows[1:]):
        row[0] = f"p{k}{STEERING}"
    rows[3][rows[0].index("x")] = "3.0"
    rows[7][rows[0].index("q1")] = "0.0"
    with (folder / f"poses{STEERING.replace('/', '')}.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    text = (folder / "calibration.yaml").read_text()
    word = quoted(STEERING.replace("/", ""))
    (folder / "calibration.yaml").write_text(text.replace("poses.csv", f'"poses{word}.csv"'))
    return folder / "calibration.yaml"


@pytest.mark.slow
@pytest.mark.usefixtures("without_mistakes")
@pytest.mark.parametrize("command", ["calibrate", "compare"])
def test_no_name_steers_the_terminal(fg_calib, job, tmp_path, command):
    out = tmp_path / f"out{STEERING.replace('/', '')}"
    ended = fg_calib(command, job, "--out", out)
    assert ended.code == 3
    assert r"arm\x1b[31m" in ended.out
    assert clean(ended.out)
    assert clean(ended.err)
    assert ended.err.count("not to be trusted: ") == ended.err.count("\n")  # a name's new line is none of ours
    assert clean(fg_calib(command, job, "--json").out)


@pytest.fixture(scope="module")
def found(job):
    """Its calibration."""
    return calibrate_job(job)


def test_a_notebook_a_saved_result_and_reprs_are_clean(found, tmp_path):
    found.save(tmp_path / "result")
    loaded = Calibration.load(tmp_path / "result")
    shown = [str(found), repr(found), str(loaded), repr(loaded), found._repr_html_(), loaded._repr_html_()]
    shown += [repr(found.robot), repr(found.parameters), repr(found.assessment), repr(found.solution)]
    shown += [repr(found.solution.problem), repr(found.solution.problem.measurements)]
    assert [text for text in shown if not clean(text)] == []


def run(arguments, **options):
    """A command in a process of its own: exit code, stdout, stderr."""
    command = [sys.executable, "-m", "fg_calib.cli", *map(str, arguments)]
    ended = subprocess.run(command, check=False, text=True, **({"capture_output": True} | options))
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.long
@pytest.mark.parametrize("command", ["calibrate", "compare", "observe"])
@pytest.mark.parametrize("stdout", ["/dev/full", "closed pipe"])
def test_a_report_that_nobody_takes_loses_no_result(example, command, stdout):
    job = example / ("robot_nominal.yaml" if command == "observe" else "calibration.yaml")
    if stdout == "closed pipe":
        end, sink = os.pipe()
        os.close(end)
    else:
        sink = os.open(stdout, os.O_WRONLY)
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    streams = {"stdout": sink, "stderr": subprocess.PIPE, "capture_output": False, "env": buffered}
    code, _, err = run([command, job, "--out", example / "out"], **streams)
    os.close(sink)
    full = "error: the output cannot be written: No space left on device\n"
    assert (code, err) == ((1, full) if stdout == "/dev/full" else (1, ""))
    assert list((example / "out").glob("*.json"))
