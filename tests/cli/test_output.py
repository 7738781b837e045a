"""What commands print: nothing from files steers a terminal, and no stream or limit ends one in a traceback."""

import csv
import os
import subprocess
import sys
from dataclasses import replace

import pytest
from scenarios import scenario
from simulated import LARGE, small_arm

from fg_calib import Calibration, Noise, calibrate_job, simulate
from fg_calib.simulation import write_simulation

STEERING = "\x1b[31m\x07\b\x9b2J\x7f\u202e\u2066[/red]"
"""What turns a terminal red, rings, goes back, clears the screen, deletes, and turns the direction of reading."""

NOISE, CHOICES = Noise(5e-4, 3e-4, 2e-4), {"model": "pose", "encoder": "estimated"}


def quoted(text):
    """As a quoted word of YAML."""
    return "".join(c if " " <= c <= "~" else f"\\\\u{ord(c):04x}"[1:] for c in text)


def clean(text):
    return all(line.isprintable() for line in text.split("\n"))


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A simulated job of two rows that are grossly wrong, all of whose names would steer a terminal, of files too."""
    folder = tmp_path_factory.mktemp("steering") / f"job{STEERING.replace('/', '')}"
    robot = small_arm(LARGE)
    joints = tuple(replace(joint, name=f"{joint.name}{STEERING}") for joint in robot.joints)
    of = scenario(robot=replace(robot, name=f"arm{STEERING}\nGOOD", joints=joints), n=25, noise=NOISE, job=CHOICES)
    write_simulation(folder, simulate(of, 1))
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
    words = [sys.executable, "-m", "fg_calib.cli", command, job, "--out", example / "out"]
    ended = subprocess.run(words, check=False, text=True, stdout=sink, stderr=subprocess.PIPE, env=buffered)
    os.close(sink)
    full = "error: the output cannot be written: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (1, full if stdout == "/dev/full" else "")
    assert list((example / "out").glob("*.json"))
