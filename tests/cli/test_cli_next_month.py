"""`check`, `update` and `history` as commands: files, exit codes, messages."""

import json
import shutil

import numpy as np
import pytest
import yaml
from month import SIGMA, arm, measured, slipped
from scipy.spatial.transform import Rotation
from simulated import true_robot
from typer.testing import CliRunner

from fg_calib import History, history_of, read_result, write_robot
from fg_calib.cli import entry
from fg_calib.io.csv_writer import write_csv
from fg_calib.report.history import draw_history


def run(*words):
    ended = CliRunner().invoke(entry.app, list(map(str, words)))
    if ended.exception is not None and not isinstance(ended.exception, SystemExit):
        return 1, str(ended.exception)
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
    """A folder with a result, and tables of a healthy month, of a slip, and of a wrong kind."""
    folder, rng, robot = tmp_path_factory.mktemp("month"), np.random.default_rng(3), arm()
    true = true_robot(robot, rng)
    write_robot(folder / "robot.yaml", robot)
    write_table(folder / "first.csv", measured(true, 30, rng))
    job = {
        "robot": "robot.yaml",
        "measurements": "first.csv",
        "model": "pose",
        "units": {"length": "mm", "angle": "deg"},
        "noise": {"position": 1e3 * SIGMA[0], "orientation": float(np.rad2deg(SIGMA[1]))},
        "columns": {f"q{i}": f"J{i}" for i in range(1, 7)},
    }
    (folder / "job.yaml").write_text(yaml.safe_dump(job))
    assert run("calibrate", folder / "job.yaml", "--out", folder / "result")[0] == 0
    write_table(folder / "healthy.csv", measured(true, 8, rng))
    write_table(folder / "slipped.csv", measured(slipped(true, theta3=3e-3), 10, rng))
    write_table(folder / "after.csv", measured(slipped(true, theta3=3e-3), 8, rng))
    (folder / "wrong.csv").write_text("J1,J2,J3\n1,2,3\n")
    return folder


def test_a_table_is_read_as_the_job_read_its_own(place):
    code, out = run("check", place / "result", place / "healthy.csv", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["schema"] == "fg-calib/check/1"
    assert found["verdict"] == "pass"
    assert found["dof"] == 48
    assert found["rms"]["position"] < 3 * SIGMA[0]


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
    assert run("compare", place / "result", place / "second")[0] == 0
    assert read_result(place / "second").options == read_result(place / "result").options


@pytest.mark.slow
def test_a_history_outlives_the_older_folders(place, tmp_path):
    first = shutil.copytree(place / "result", tmp_path / "first")
    assert run("update", first, place / "healthy.csv", "--out", tmp_path / "second")[0] == 0
    shutil.rmtree(first)
    assert run("update", tmp_path / "second", place / "slipped.csv", "--changed", "theta3", "--out",
               tmp_path / "third")[0] == 0  # fmt: skip
    shutil.rmtree(tmp_path / "second")
    code, out = run("history", tmp_path / "third", "--figures", "--json")
    runs = json.loads(out)["runs"]
    assert code == 0
    assert [one["n_residuals"] for one in runs] == [180, 48, 60]
    assert runs[2]["moved"]["name"] == "theta3"
    assert (tmp_path / "third" / "history.svg").read_text().startswith("<?xml")
    assert (tmp_path / "third" / "history.png").stat().st_size > 0
    assert "3 runs" in run("history", tmp_path / "third")[1]


@pytest.mark.slow
def test_runs_whose_dates_say_no_order_are_numbered(place):
    """Of one date, or of one that is earlier: whole numbers from 1, as nothing is between runs."""
    (run,) = history_of(place / "result").runs
    later = run.model_copy(update={"date": "2000-01-01"})
    axes = draw_history(History(robot="arm", runs=[run, later, run])).axes[0]
    assert axes.get_xlabel() == "run"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2", "3"]


def test_a_job_may_stand_in_place_of_a_table(place):
    job = yaml.safe_load((place / "job.yaml").read_text()) | {"measurements": "healthy.csv"}
    (place / "healthy.yaml").write_text(yaml.safe_dump(job))
    code, out = run("check", place / "result", place / "healthy.yaml", "--json")
    assert (code, json.loads(out)["dof"]) == (0, 48)


BAD = {
    "a table without the columns": (["check", "result", "wrong.csv"], "wrong.csv"),
    "no table": (["check", "result", "none.csv"], "none.csv"),
    "no result": (["check", "nowhere", "healthy.csv"], "no such folder or file"),
    "a limit that is none": (["check", "result", "healthy.csv", "--limit", "0.5 parsec"], "--limit"),
    "a name of no table": (["check", "result", "healthy.csv", "--like", "x.csv"], "one of first.csv"),
    "pairs for poses": (["check", "result", "healthy.csv", "--pairs", "healthy.csv"], "a table of pairs"),
    "rows that are in it": (["update", "result", "first.csv", "--out", "new"], "in the calibration already"),
    "its own folder": (["update", "result", "healthy.csv", "--out", "result"], "the folder of the result"),
    "no parameter": (["update", "result", "healthy.csv", "--changed", "theta9", "--out", "new"], "theta9"),
    "a bare growth": (["update", "result", "healthy.csv", "--growth", "theta", "--out", "new"], "NAME=FIGURE"),
    "a date before": (
        ["update", "result", "healthy.csv", "--date", "1999-01-01", "--out", "new"],
        "is before the calibration",
    ),
    "a date that is none": (["update", "result", "healthy.csv", "--date", "May", "--out", "new"], "a date such as"),
}  # fmt: skip


@pytest.mark.sampled(4)
@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_one_line(place, what, monkeypatch):
    monkeypatch.chdir(place)
    words, expected = BAD[what]
    code, message = run(*words)
    assert code == 1
    assert expected in message
    assert "\n" not in message
    assert not (place / "new").exists()


def changed_result(place, tmp_path, change):
    folder = shutil.copytree(place / "result", tmp_path / "changed")
    document = json.loads((folder / "result.json").read_text())
    change(document)
    (folder / "result.json").write_text(json.dumps(document))
    return folder


def test_a_result_that_is_not_to_be_trusted_is_refused(place, tmp_path):
    folder = changed_result(place, tmp_path, lambda d: d.update(trustworthy=False, findings=["it wobbles"]))
    code, message = run("check", folder, place / "healthy.csv")
    assert code == 1
    assert "it wobbles" in message


@pytest.mark.slow
def test_an_older_result_is_checked_by_a_job_and_not_updated(place, tmp_path):
    folder = changed_result(place, tmp_path, lambda d: d.pop("carried"))
    assert "a job that names the table" in run("check", folder, place / "healthy.csv")[1]
    job = yaml.safe_load((place / "job.yaml").read_text()) | {"measurements": "healthy.csv"}
    (place / "by job.yaml").write_text(yaml.safe_dump(job))
    assert run("check", folder, place / "by job.yaml")[0] == 0
    code, message = run("update", folder, place / "by job.yaml", "--out", tmp_path / "new")
    assert code == 1
    assert "does not hold what its rows say" in message


@pytest.mark.parametrize("job", [{"units": 5}, {"measurements": 5}, {"measurements": [{"model": "pose"}]}], ids=str)
def test_a_damaged_job_is_told_of(place, tmp_path, job):
    folder = changed_result(place, tmp_path, lambda d: d["carried"].update(job=job))
    code, message = run("check", folder, place / "healthy.csv")
    assert (code, message.count("\n")) == (1, 0)
    assert "carried: job" in message


def test_a_damaged_history_is_told_of(place, tmp_path):
    folder = shutil.copytree(place / "result", tmp_path / "copy")
    for text, expected in (
        ("{", "not JSON"),
        ("{}", "no history"),
        ('{"schema": "fg-calib/history/1"}', "history.json"),
    ):
        (folder / "history.json").write_text(text)
        code, message = run("history", folder)
        assert (code, expected in message) == (1, True)


def test_a_result_whose_date_is_none_is_refused(place, tmp_path):
    folder = changed_result(place, tmp_path, lambda d: d.update(date="last May"))
    code, message = run("update", folder, place / "healthy.csv", "--out", tmp_path / "new")
    assert code == 1
    assert "result.json: date" in message
    assert "\n" not in message


@pytest.mark.slow
def test_no_probability_is_said_to_be_0(place):
    """Of a slip so large that its probability is below what numbers hold."""
    out = run("check", place / "result", place / "slipped.csv")[1]
    assert json.loads(run("check", place / "result", place / "slipped.csv", "--json")[1])["p_value"] == 0.0
    assert "p-value < 0.001" in out
    assert not any(line.split()[-2:-1] == ["0"] for line in out.splitlines())


def test_another_robots_job_is_refused(place, tmp_path):
    rows = [[0, 0, 0.1, 0], [0.3, 0, 0, 0], [0.2, 0, 0, 0], [0.1, 0, 0, 0], [0.1, 0, 0, 0], [0, 0, 0, 0]]
    write_robot(tmp_path / "robot.yaml", type(arm()).from_dh(rows, "mdh", name="other"))
    shutil.copy(place / "healthy.csv", tmp_path)
    job = yaml.safe_load((place / "job.yaml").read_text()) | {"measurements": "healthy.csv"}
    (tmp_path / "job.yaml").write_text(yaml.safe_dump(job))
    code, message = run("check", place / "result", tmp_path / "job.yaml")
    assert code == 1
    assert "that of the result, ur5e" in message


def test_a_posterior_that_is_infinite_is_refused(place, tmp_path):
    """Check ended in a traceback, and update went on."""
    folder = changed_result(place, tmp_path, lambda d: d["posterior"]["covariance"][0].__setitem__(0, float("inf")))
    for words in (["check"], ["update", "--out", tmp_path / "new"]):
        code, message = run(words[0], folder, place / "healthy.csv", *words[1:])
        assert code == 1
        assert "posterior: figures that are not finite" in message
