"""Every snippet of README and `docs/` runs, the pages name all there is, and `fg-calib help` shows each of them."""

import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import month
import numpy as np
import pytest
import typer
import yaml
from oracle import tool_pose
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm, true_robot

import fg_calib as package
from fg_calib import (
    Calibration,
    Robot,
    Table,
    assess,
    build_problem,
    calibrate,
    correct,
    export,
    read_job,
    read_robot,
    simulate,
    solve,
)
from fg_calib.cli import EXAMPLES
from fg_calib.cli.entry import app
from fg_calib.importers.board import read_calibration_board
from fg_calib.robot.kinematics import pose
from fg_calib.simulation import read_scenario

ROOT = Path(__file__).resolve().parents[2]
PAGES = {"README": ROOT / "README.md"} | {path.stem: path for path in sorted((ROOT / "docs").glob("*.md"))}
GENERATED = ("job", "robot", "tables")
COMMANDS = typer.main.get_command(app).commands


@cache
def snippets(page):
    """Language and text of every fenced block of a page, in order."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", PAGES[page].read_text(), flags=re.S | re.M)


# --- what a page shows, compared with what is printed ---------------------------------------------------

FIGURE = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")


def in_words(text):
    """A text as one line with `#` for each figure, and the figures."""
    text = " ".join(text.replace("#", " ").split())
    return FIGURE.sub("#", text), [float(figure) for figure in FIGURE.findall(text)]


def assert_shows(shown, printed):
    """All that a page shows but for its dots was printed, in this order: words to the letter, figures to 5 %."""
    words, figures = in_words(printed)
    at = 0
    for part in re.split(r"^\.\.\.\n", shown, flags=re.M):
        expected, values = in_words(part)
        start = words.find(expected, at)
        assert start >= 0, f"not printed: {expected}"
        before = words[:start].count("#")
        assert figures[before : before + len(values)] == pytest.approx(values, rel=0.05, abs=2e-3)
        at = start + len(expected)


def test_other_words_and_other_figures_than_printed_would_be_seen():
    printed = "GOOD: it converged\nposition mm 0.147 0.2\nthe end\n"
    assert_shows("GOOD: it converged\n...\nposition  mm 0.148\n", printed)
    for wrong in ("BAD", "GOOD: it\n...\nposition mm 0.247", "the end\n...\nGOOD"):
        with pytest.raises(AssertionError):
            assert_shows(wrong, printed)


def run_python(folder, code):
    """What Python code prints in an interpreter of its own, in a folder."""
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    return ended.stdout


# --- snippets: one function a sort ------------------------------------------------------------------------------------

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


def files_in(folder, **others):
    """The files in a folder; a job has others of its own for a URDF's one joint."""
    for name, text in (FILES | others).items():
        (folder / name).write_text(text)
    return folder


def is_robot(text, folder, fg_calib):
    (folder / "robot.yaml").write_text(text)
    assert read_robot(folder / "robot.yaml").n_joints == 3


def is_job(text, folder, fg_calib):
    one_joint = {"poses.csv": "q1,x,y,z,qx,qy,qz,qw\n0,1,0,0,0,0,0,1\n"} if "arm.urdf" in text else {}
    files_in(folder, **one_joint)
    (folder / "calibration.yaml").write_text(text)
    assert read_job(folder / "calibration.yaml").robot.n_joints in (1, 2)


def is_key_of_a_job(text, folder, fg_calib):
    job = "robot: robot.yaml\nmeasurements: poses.csv\nmodel: position\nnoise: {position: 1}\n"
    is_job(job + "units: {length: mm, angle: deg}\n" + text, folder, fg_calib)
    job = read_job(folder / "calibration.yaml")
    if "columns" in text:
        assert np.rad2deg(job.measurements.readings[:, 0]) == pytest.approx([0, 0.0054931640625])
        assert job.measurements.position[:, 0] == pytest.approx([7e-3, 7e-3])


def is_job_of_the_readme(text, folder, fg_calib):
    for (_, other), name in zip(snippets("README")[3:5], ("robot.yaml", "poses.csv"), strict=True):
        (folder / name).write_text(other)
    (folder / "calibration.yaml").write_text(text)
    assert len(read_job(folder / "calibration.yaml").measurements.readings) == 1


def is_table(text, folder, fg_calib):
    """Of an arm with three joints."""
    (folder / "robot.yaml").write_text(snippets("README")[3][1])
    (folder / "poses.csv").write_text(text)
    robot = read_robot(folder / "robot.yaml")
    read = package.read_measurements(folder / "poses.csv", robot, units=package.Units("m", "deg"))
    assert len(read.readings) == len(text.splitlines()) - 1


def is_board(text, folder, fg_calib):
    (folder / "board.yaml").write_text(text)
    read_calibration_board(folder / "board.yaml")


def is_scenario(text, folder, fg_calib):
    """Of the paper's robot, which is simulated; with instruments of a UR10, which is calibrated too."""
    (folder / "scenario.yaml").write_text(text)
    if "instruments" not in text:
        (folder / "robot.yaml").write_bytes((EXAMPLES / "space-robot" / "robot_nominal.yaml").read_bytes())
        assert len(simulate(read_scenario(folder / "scenario.yaml"), seed=0).measurements.readings) == 52 + 500
        return
    (folder / "robot.yaml").write_text(snippets("tutorial")[0][1])
    assert fg_calib("simulate", folder / "scenario.yaml", "--out", folder / "job").code == 0
    assert fg_calib("calibrate", folder / "job" / "calibration.yaml").code == 0


def are_configurations(text, folder, fg_calib):
    """Of a scenario of a UR10."""
    units = "units: {length: m, angle: deg}\n"
    (folder / "robot.yaml").write_text(snippets("tutorial")[0][1])
    others = "robot: robot.yaml\nerrors: {values: {}}\nnoise: {position: 0.001, orientation: 0.01}\n"
    (folder / "scenario.yaml").write_text(units + others + text)
    assert len(simulate(read_scenario(folder / "scenario.yaml"), seed=0).measurements.readings) == 50


def are_typed(text, folder, fg_calib):
    """Commands of a shell, parsed to the last option but not run; extras are those that there are."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for line in re.split(r"\n|&&", text.replace("\\\n", " ")):
        words = shlex.split(line)
        if words[:1] == ["fg-calib"]:
            COMMANDS[words[1]].make_context(words[1], words[2:])
        elif words[:2] == ["pip", "install"] and words[2] != ".":
            assert words[2].removeprefix(".[").removesuffix("]") in extras
        else:
            assert words in ([], ["python3", "-m", "venv", ".venv"], [".", ".venv/bin/activate"],
                             ["pip", "install", "."]) or words[0] == "pytest"  # fmt: skip


def are_run(text, folder, fg_calib):
    for line in text.split("&&"):
        assert fg_calib(*shlex.split(line)[1:]).code == 0


def is_printed(text, folder, fg_calib):
    """A command next to the bundled example, and what it prints."""
    assert fg_calib("example", "space-robot", "--out", "demo").code == 0
    Path("robot.yaml").write_bytes(Path("demo/robot_nominal.yaml").read_bytes())
    command, shown = text.split("\n", 1)
    ended = fg_calib(*shlex.split(command.removeprefix("$ fg-calib ")))
    assert ended.code == 0
    assert_shows(shown, ended.out)


def is_report_of_the_example(text, folder, fg_calib):
    is_printed(f"$ fg-calib calibrate demo/calibration.yaml\n{text}", folder, fg_calib)


def write_arrays(folder, robot):
    """What an arm of one's own reads, and where a tracker sees its tool, for a snippet to load."""
    rng = np.random.default_rng(3)
    frame = (Rotation.from_rotvec([0.1, 0.2, -0.7]), np.array([2.0, 1.0, 0.3]))
    m = measure(true_robot(robot, rng), 50, rng, sigma=(1e-4, 1e-4), frame=frame)
    np.save(folder / "q.npy", m.readings)
    np.save(folder / "p.npy", m.position)


def calibrates_from_arrays(text, folder, fg_calib):
    """As a user runs it, in an interpreter of its own."""
    made = {}
    exec(text[: re.search("^q.* = np.load", text, flags=re.M).start()], made)  # its robot
    write_arrays(folder, made["robot"])
    printed = run_python(folder, text)
    assert printed.startswith("robot: position, measurement frame unknown\nGOOD: ")
    headings = {"Fit statistics", "Parameters", "Notes"}
    assert [line for line in printed.splitlines() if line in headings] == ["Fit statistics", "Parameters", "Notes"]
    names = {"result.json", "residuals.csv", "robot_calibrated.yaml"}
    assert {f.name for f in (folder / "result").iterdir()} >= names
    if "Calibration.load" in text:  # it prints a sigma twice: of the result, and of the one that was saved
        sigma = re.search(r"^-0\.6\d+ (\S+)$", printed, flags=re.M).group(1)
        assert printed.splitlines()[-1] == sigma


def robot_of(code, end):
    """The robot that a snippet makes."""
    made = {"Robot": Robot}
    exec(code[code.index("tolerance = ") : code.index(end)], made)
    return made["robot"]


def is_a_kind_of_ones_own(code, folder, fg_calib):
    rng, post = np.random.default_rng(4), np.array([1.1, 0.4, -0.2])
    q = rng.uniform(-np.pi, np.pi, (40, 3))
    p = pose(true_robot(robot_of(code, "result = "), rng), q).position
    np.save(folder / "q.npy", q)
    np.save(folder / "lengths.npy", np.linalg.norm(p - post, axis=1) + 2e-4 * rng.normal(size=40))
    (line,) = run_python(folder, code).splitlines()
    found = np.array([float(x) for x in re.findall(r"[-+.e\d]+", line)]).reshape(2, 3)
    assert np.all(np.abs(found[0] - post) < 6 * found[1])
    assert np.all(found[1] < 0.01)


def extends_the_graph(code, folder, fg_calib):
    rng, robot = np.random.default_rng(5), robot_of(code, "data = ")
    m = measure(true_robot(robot, rng), 30, rng, sigma=(1e-4, 1e-4))
    np.save(folder / "q.npy", m.readings)
    np.save(folder / "p.npy", m.position)
    message, expanded = run_python(folder, code).splitlines()
    assert message.startswith("converged: ")
    plain = assess(solve(build_problem(robot, replace(m, rotation=None), model="position")))
    assert int(message.split()[-1]) == plain.fit.chi_square.dof + 4 + 1  # the prior's rows, and the distance
    size, error, cost = map(float, expanded.split())
    assert size == 30 + 3 + 2  # measurements, priors of three joints, what was added
    assert error == pytest.approx(cost, rel=1e-9)


def calibrates_two_tables(code, folder, fg_calib):
    rng, robot = np.random.default_rng(1), small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3})
    true = true_robot(robot, rng)
    made = {"calibrate": calibrate, "Table": Table, "robot": robot}
    exec(code, made | {"tracker": measure(true, 30, rng), "bar": measure(true, 30, rng)})


def corrects_a_program(code, folder, fg_calib):
    rng, robot = np.random.default_rng(1), small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3})
    calibrate(robot, measure(true_robot(robot, rng), 20, rng), model="position").save(folder / "result")
    (folder / "program.csv").write_text("q1,q2,q3,q4\n0.1,0.2,0.3,0.4\n")
    exec(code, {})


def predicts_an_arm(code, folder, fg_calib):
    rng, robot = np.random.default_rng(1), small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3})
    calibrate(robot, measure(true_robot(robot, rng), 20, rng), model="position").save(folder / "result")
    exec(code, made := {})
    assert made["found"].within is not None


def exports_an_arm(code, folder, fg_calib):
    exec(code, {})
    assert read_robot(folder / "arm_hayati.yaml").n_joints == 2


def designs_a_calibration(code, folder, fg_calib):
    exec(code, made := {})
    assert made["plan"].expected.position < made["plan"].random


def checks_and_updates(code, folder, fg_calib):
    calibration, true, rng = month.calibrated(1)
    rows = month.measured(month.slipped(true, theta3=2e-3), 10, rng)
    exec(code, made := {"calibration": calibration, "rows": rows})
    assert made["found"].verdict == "fail"
    assert [e.parameters for e in made["found"].explanations if e.likely] == [("theta3",)]
    assert len(made["updated"].runs) == 2


def calibrates_many(code, folder, fg_calib):
    assert fg_calib("example", "space-robot", "--out", folder).code == 0
    (folder / "other.yaml").write_text("robot: nowhere.yaml\nmeasurements: poses.csv\n")
    figure, reason = run_python(folder, code).splitlines()
    assert float(figure) == pytest.approx(0.863, rel=0.01)
    assert reason == "other.yaml: missing key 'model'"


def is_a_drawing(text, folder, fg_calib):
    assert "build_problem" in text


def slow(function, mark=pytest.mark.slow):
    return pytest.param(function, marks=mark)


HOW = {
    "README": [slow(is_report_of_the_example), are_typed, are_typed, is_robot, is_table, is_job_of_the_readme,
               slow(calibrates_from_arrays)],
    "robot": [is_robot],
    "job": [is_job, is_key_of_a_job],
    "instruments": [is_job, is_table, is_job, calibrates_two_tables],
    "from-bags-and-images": [are_typed, is_job, are_typed, is_board, is_board],
    "validation": [is_key_of_a_job],
    "correct": [are_typed, corrects_a_program],
    "design": [are_typed, slow(designs_a_calibration)],
    "predict": [are_typed, slow(predicts_an_arm)],
    "export": [are_typed, exports_an_arm],
    "monitoring": [are_typed, slow(checks_and_updates)],
    "observability": [is_printed],
    "many-jobs": [are_typed, slow(calibrates_many)],
    "simulate": [slow(are_run), is_scenario, are_configurations, slow(is_scenario, pytest.mark.long)],
    "python": [slow(calibrates_from_arrays), slow(is_a_kind_of_ones_own), slow(extends_the_graph)],
    "architecture": [is_a_drawing, are_typed],
}  # fmt: skip
"""How each snippet of a page is run, in their order; the tutorial's are run in one."""


def test_every_snippet_of_every_page_runs():
    count = {page: len(how) for page, how in HOW.items()}
    assert count == {page: len(snippets(page)) for page in PAGES if snippets(page) and page != "tutorial"}


EVERY_SNIPPET = [(page, n, how) for page, hows in HOW.items() for n, how in enumerate(hows)]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("page", "n", "run"),
    [pytest.param(page, n, *getattr(how, "values", [how]), marks=getattr(how, "marks", ()), id=f"{page}-{n}")
     for page, n, how in EVERY_SNIPPET],
)  # fmt: skip
def test_a_snippet_runs(page, n, run, tmp_path, fg_calib, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "98")
    run(snippets(page)[n][1], tmp_path, fg_calib)


def missed(robot, readings, targets):
    """RMS of how far a robot's tool is from targets with joint readings, after the best rigid fit, [mm]."""
    points = np.array([tool_pose(robot, q)[:3, 3] for q in readings])
    turn, _ = Rotation.align_vectors(targets - targets.mean(axis=0), points - points.mean(axis=0))
    left = turn.apply(points - points.mean(axis=0)) - (targets - targets.mean(axis=0))
    return 1e3 * np.sqrt(np.mean(np.sum(left**2, axis=1)))


def errors_at_targets():
    """Of the tutorial's true arm at 20 targets, in mm: nominal, with joint zeros alone, and corrected.

    Its base was never seen, so the best rigid fit of the targets is taken away.
    """
    result, true, drawn = Calibration.load("result"), read_robot("measured/robot_true.yaml"), read_robot("ur10.yaml")
    q = np.random.default_rng(4).uniform([-1.5, -2.2, 0.4, -1.0, 1.0, -1.5], [1.5, -1.0, 1.6, 1.0, 1.9, 1.5], (20, 6))
    targets = np.array([tool_pose(drawn, row)[:3, 3] for row in q])
    zeros = np.array([zero["zero"] for zero in yaml.safe_load(export(result, "zeros").text)["zeros"].values()])
    commanded = (q, q - np.deg2rad(zeros), correct(result, near=q).readings)
    return [missed(true, readings, targets) for readings in commanded]


@pytest.mark.slow
def test_the_tutorial_is_what_happens(tmp_path, fg_calib, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    printed, codes = "", []
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
        elif language == "python":
            printed = run_python(tmp_path, text)
        else:
            assert_shows(text, printed)
    assert codes == [0, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0]
    assert errors_at_targets() == pytest.approx([5.8, 5.2, 0.018], rel=0.05)  # as the page says
    a2 = Calibration.load("result").parameters["a2"]
    (true,) = (p.nominal for p in read_robot("measured/robot_true.yaml").parameters if p.name == "a2")
    assert abs(a2.estimate - true) < a2.sigma  # as the page says
    assert (tmp_path / "result" / "report.html").stat().st_size > 0


# --- pages ------------------------------------------------------------------------------------------------------------


def names_of_commands():
    """Options of all commands as they are typed."""
    for command in COMMANDS.values():
        for option in command.params:
            yield from (name for name in option.opts if name.startswith("--"))


NAMES = {
    "functions": [name for name in package.__all__ if name.islower()],
    "options": [*names_of_commands()],
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
    """`.ci/run` takes the first lines that start so."""
    lines = PAGES["README"].read_text().splitlines()
    (install,) = (line for line in lines if line.startswith("python3 -m venv"))
    (tests,) = (line for line in lines if re.match("pip install .*test", line))
    assert install.endswith("--out demo/result")
    assert tests == "pip install '.[test]' && pytest -n auto"
