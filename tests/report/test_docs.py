"""Every snippet of README and `docs/` runs, and the pages name all there is."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import month
import numpy as np
import pytest
import typer
from simulated import measure, small_arm, true_robot, with_changes

import fg_calib as package
from fg_calib import Robot, Table, calibrate, read_job, read_robot, simulate
from fg_calib.cli import EXAMPLES
from fg_calib.cli.entry import build_app
from fg_calib.importers.board import read_calibration_board
from fg_calib.io import Units, read_measurements
from fg_calib.simulation import read_scenario

ROOT = Path(__file__).resolve().parents[2]
PAGES = {"README": ROOT / "README.md"} | {path.stem: path for path in sorted((ROOT / "docs").glob("*.md"))}
COMMANDS = typer.main.get_command(build_app()).commands


def snippets(page):
    """Language and text of every fenced block of a page, in order."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", PAGES[page].read_text(), flags=re.S | re.M)


# --- what a page shows, compared with what is printed ---------------------------------------------------

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")


def in_words(text):
    """A text as one line with `#` for each number, and the numbers."""
    text = " ".join(text.replace("#", " ").split())
    return NUMBER.sub("#", text), [float(number) for number in NUMBER.findall(text)]


def assert_shows(shown, printed):
    """All that a page shows but for its dots was printed, in this order: words to the letter, numbers to 5 %."""
    words, numbers = in_words(printed)
    at = 0
    for part in re.split(r"^\.\.\.\n", shown, flags=re.M):
        expected, values = in_words(part)
        start = words.find(expected, at)
        assert start >= 0, f"not printed: {expected}"
        before = words[:start].count("#")
        assert numbers[before : before + len(values)] == pytest.approx(values, rel=0.05, abs=2e-3)
        at = start + len(expected)


def test_other_words_and_other_numbers_than_printed_would_be_seen():
    printed = "GOOD: it converged\nposition mm 0.147 0.2\nthe end\n"
    assert_shows("GOOD: it converged\n...\nposition  mm 0.148\n", printed)
    for wrong in ("BAD", "GOOD: it\n...\nposition mm 0.247", "the end\n...\nGOOD"):
        with pytest.raises(AssertionError):
            assert_shows(wrong, printed)


# --- snippets, by their language ----------------------------------------------------------------------------

SMALL_ARM = "convention: dh\njoints: [{a: 1, alpha: 0, d: 0, theta: 0}, {a: 1, alpha: 0, d: 0, theta: 0}]\n"
URDF = """<robot name="arm"><link name="base"/><link name="flange"/><joint name="j" type="revolute">
<parent link="base"/><child link="flange"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
</joint></robot>"""
FILES = {
    "robot.yaml": SMALL_ARM,
    "arm.urdf": URDF,
    "poses.csv": "id,q1,q2,x,y,z,qx,qy,qz,qw,X [mm],C1\na,0,0,1,0,0,0,0,0,1,7,32768\nb,1,1,0,1,0,0,0,0,1,7,32769\n",
    "pairs.csv": "a,b,distance,angle\na,b,1,1\n",
    "tracker.csv": "q1,q2,target,station,x,y,z\n0,0,smr1,1,1,0,0\n1,1,,2,1,0,0\n",
    "ballbar.csv": "q1,q2,anchor,distance\n0,0,bolt,300\n0.5,1,nail,300\n",
    "bar.csv": "id,q1,q2\na,0,0\nb,1,1\n",
    "lengths.csv": "a,b,distance\na,b,1\n",
}
"""Files that snippets name, as small as can be."""

UNITS = "robot: robot.yaml\nunits: {length: mm, angle: deg}\n"
JOB = UNITS + "measurements: poses.csv\nmodel: position\nnoise: {position: 1}\n"
SCENARIO = UNITS + "errors: {values: {}}\nnoise: {position: 1, orientation: 0.01}\n"


def read_yaml(text, folder, fg_calib):
    """A robot, a board, a job or a scenario, or keys of one."""
    for name, content in FILES.items():
        (folder / name).write_text(content)
    (folder / "file.yaml").write_text(text)
    if text.startswith("effects:"):
        (folder / "file.yaml").write_text(text.replace("joints: [2, 3, 4]", "joints: [2]") + snippets("README")[3][1])
        assert read_robot(folder / "file.yaml").effects
    elif "joints:" in text:
        assert read_robot(folder / "file.yaml").n_joints == 3
    elif "square" in text:
        read_calibration_board(folder / "file.yaml")
    elif "instruments:" in text:
        (folder / "robot.yaml").write_text(snippets("tutorial")[0][1])
        assert fg_calib("simulate", folder / "file.yaml", "--out", folder / "job").code == 0
    elif "configurations:" in text:
        bundled = (EXAMPLES / "space-robot" / "robot_nominal.yaml").read_text()
        (folder / "robot.yaml").write_text(bundled if "robot:" in text else snippets("tutorial")[0][1])
        (folder / "file.yaml").write_text(text if "robot:" in text else SCENARIO + text)
        assert len(simulate(read_scenario(folder / "file.yaml"), seed=0).measurements.readings) in (50, 552)
    else:
        if "arm.urdf" in text:
            (folder / "poses.csv").write_text("q1,x,y,z,qx,qy,qz,qw\n0,1,0,0,0,0,0,1\n")
        if text.startswith("# calibration.yaml"):  # of the robot and the table before it
            for (_, other), name in zip(snippets("README")[3:5], ("robot.yaml", "poses.csv"), strict=True):
                (folder / name).write_text(other)
        (folder / "file.yaml").write_text(text if "robot:" in text else JOB + text)
        assert read_job(folder / "file.yaml").robot.n_joints in (1, 2, 3)


def read_csv(text, folder, fg_calib):
    """A table of an arm with three joints."""
    (folder / "robot.yaml").write_text(snippets("README")[3][1])
    (folder / "poses.csv").write_text(text)
    robot = read_robot(folder / "robot.yaml")
    read = read_measurements(folder / "poses.csv", robot, units=Units("m", "deg"))
    assert len(read.readings) == len(text.splitlines()) - 1


def parse_commands(text, folder, fg_calib):
    """Commands of a shell, parsed to the last option but not run; extras are those that there are."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for line in re.split(r"\n|&&", text.replace("\\\n", " ")):
        words = shlex.split(line)
        if words[:1] == ["fg-calib"]:
            COMMANDS[words[1]].make_context(words[1], words[2:])
        elif words[:2] == ["pip", "install"] and words[2] != ".":
            assert words[2].removeprefix(".[").removesuffix("]") in extras
        else:
            assert words[:1] in ([], ["python3"], ["."], ["pip"], ["pytest"])


def run_console(text, folder, fg_calib, example="space-robot"):
    """A command next to a bundled example, and what it prints."""
    assert fg_calib("example", example, "--out", "demo").code == 0
    Path("robot.yaml").write_bytes(Path("demo/robot_nominal.yaml").read_bytes())
    command, shown = text.split("\n", 1)
    ended = fg_calib(*shlex.split(command.removeprefix("$ fg-calib ")))
    assert ended.code == 0
    assert_shows(shown, ended.out)


def run_python(text, folder, fg_calib):
    """Python, next to what it reads: arrays, a program, a result, jobs."""
    rng = np.random.default_rng(4)
    tolerance = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}
    three = Robot.from_dh([[0.4, 0.3, 0.2, 0], [0.3, -1.2, 0.1, 0], [0.5, 0.7, 0.1, 0]], "dh", tolerance=tolerance)
    robot, names = small_arm(tolerance), {"calibrate": calibrate, "Table": Table, "__name__": "snippet"}
    if "np.load" in text:
        if "(n, 6)" in text:
            exec(text[: text.index("q = np.load")], names)
        m = measure(true_robot(names.get("robot", three), rng), 40, rng, sigma=(1e-4, 1e-4))
        np.save(folder / "q.npy", m.readings)
        np.save(folder / "p.npy", m.position)
    if "calibration.check" in text:
        calibration, true, more = month.calibrated(1)
        names |= {"calibration": calibration, "rows": month.measured(with_changes(true, theta3=2e-3), 10, more)}
    if '"result"' in text and "save" not in text:
        calibrate(robot, measure(true_robot(robot, rng), 20, rng), model="position").save(folder / "result")
        (folder / "program.csv").write_text("q1,q2,q3,q4\n0.1,0.2,0.3,0.4\n")
    if "tracker" in text and "robot, [" in text:
        names |= {"robot": robot, "tracker": measure(robot, 30, rng), "bar": measure(robot, 30, rng)}
    if "calibrate_jobs" in text:
        assert fg_calib("example", "space-robot", "--out", folder).code == 0
        (folder / "other.yaml").write_text("robot: nowhere.yaml\nmeasurements: poses.csv\n")
        subprocess.run([sys.executable, "-W", "error", "-c", text], cwd=folder, check=True)
        return
    exec(text, names)


def show_text(text, folder, fg_calib):
    """What a calibration of a bundled example prints."""
    run_console(f"$ fg-calib calibrate demo/calibration.yaml\n{text}", folder, fg_calib, "ur10-tracker")


RUN = {"yaml": read_yaml, "csv": read_csv, "bash": parse_commands, "sh": parse_commands, "console": run_console}
RUN |= {"python": run_python, "text": show_text, "diff": lambda *_: None}  # see `measurements/test_extensions.py`
FAST = ("bash", "sh", "csv", "yaml", "diff")
EVERY_SNIPPET = [
    pytest.param(page, n, id=f"{page}-{n}", marks=() if language in FAST else pytest.mark.slow)
    for page in PAGES
    for n, (language, _) in enumerate(snippets(page))
    if page != "tutorial" and language
]


@pytest.mark.parametrize(("page", "n"), EVERY_SNIPPET)
def test_a_snippet_runs(page, n, tmp_path, fg_calib, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "98")
    language, text = snippets(page)[n]
    RUN[language](text, tmp_path, fg_calib)


@pytest.mark.slow
def test_the_tutorial_is_what_happens(tmp_path, fg_calib, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    codes = []
    for language, text in snippets("tutorial"):
        if language == "csv":
            Path("program.csv").write_text(text)
        elif language == "yaml":
            Path(re.match(r"# ([\w.]+)", text)[1]).write_text(text)
        elif language == "console":
            command, shown = text.split("\n", 1)
            ended = fg_calib(*command.removeprefix("$ fg-calib ").split())
            codes.append(ended.code)
            assert_shows(shown, ended.out or ended.err)
        else:
            exec(text, {})
    assert sorted(set(codes)) == [0, 3]
    assert (tmp_path / "result" / "report.html").stat().st_size > 0


# --- pages ------------------------------------------------------------------------------------------------------------

NAMES = {
    "functions": [name for name in package.__all__ if name.islower()],
    "options": [name for c in COMMANDS.values() for o in c.params for name in o.opts if name.startswith("--")],
    "commands": [*COMMANDS],
}


@pytest.mark.parametrize("what", NAMES)
def test_the_pages_name_all_that_a_user_may_meet(what):
    words = set(re.findall(r"[\w-]+", " ".join(path.read_text() for path in PAGES.values())))
    assert [name for name in NAMES[what] if name not in words] == []


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", PAGES[page].read_text()):
        assert (PAGES[page].parent / link).exists(), link


def test_the_commands_that_are_checked_are_the_readmes():
    """`.ci/run` takes the lines from the first that starts so, and the one of the tests."""
    lines = PAGES["README"].read_text().splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("python3 -m venv"))
    (tests,) = (line for line in lines if re.match("pip install .*test", line))
    words = [line.split()[:2] for line in lines[start + 1 : start + 3]]
    assert words == [["fg-calib", "example"], ["fg-calib", "calibrate"]]
    assert lines[start + 2].endswith("--out demo/result")
    assert tests == "pip install '.[test]' && pytest -n auto"
