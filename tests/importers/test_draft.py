"""`fg-calib init`: the job that it writes is read as the files are meant, and asks for what only its user knows."""

from dataclasses import asdict

import numpy as np
import polars as pl
import pytest
import yaml
from jobs import UR5E
from scenarios import CAMERA, INSTRUMENTS, scenario
from simulated import true_robot

from fg_calib import read_job, read_robot, simulate
from fg_calib.io.tables import write_csv
from fg_calib.robot.kinematics import pose
from fg_calib.simulation import write_simulation

JOB = "calibration.yaml"


@pytest.fixture
def folder(tmp_path):
    """A folder with a robot."""
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(UR5E))
    return tmp_path


@pytest.fixture
def write(folder):
    """Positions of 40 configurations as a table, with other names or units of some columns."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-2.0, 2.0, (40, 6))
    p = pose(true_robot(read_robot(folder / "robot.yaml"), rng), q).position
    columns = {f"q{i + 1}": q[:, i] for i in range(6)} | dict(zip("xyz", p.T, strict=True))

    def write(names=None, factors=None, name="poses.csv"):
        names, factors = names or {}, factors or {}
        write_csv(folder / name, {names.get(c, c): v * factors.get(c, 1.0) for c, v in columns.items()})
        return folder / name

    return write


def drafted(fg_calib, folder, *files):
    """The job that is written for files, as YAML holds it."""
    ended = fg_calib("init", *files, "--out", folder / JOB)
    assert (ended.code, ended.out) == (0, "")
    return yaml.safe_load((folder / JOB).read_text())


CASES = ("pose", "targets", "formed pairs", "pairs", "anchors", "planes", "board", "pixels", "sockets")


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in CASES[:6])) for n in CASES])
def test_a_job_for_the_tables_of_every_instrument_is_ready(fg_calib, tmp_path, name):
    simulation = simulate(scenario(INSTRUMENTS[name], n=40), seed=0)
    write_simulation(tmp_path / "simulated", simulation)
    files = [file for file in (tmp_path / "simulated").iterdir() if file.suffix == ".csv"]
    if name == "pixels":
        files.append(tmp_path / "camera.yaml")
        files[-1].write_text(yaml.safe_dump(asdict(CAMERA)))
    given = drafted(fg_calib, tmp_path, tmp_path / "simulated" / "robot_nominal.yaml", *files)
    assert given["measurements"][0]["model"] == ("pose" if name == "formed pairs" else simulation.tables[0].model)
    assert given["units"] == {"length": "m", "angle": "rad"}
    assert given["noise"]["estimate"] is True
    read = read_job(tmp_path / JOB).tables[0].measurements
    assert np.allclose(read.readings, simulation.tables[0].measurements.readings, atol=1e-9)
    if name not in CASES[:6]:
        assert fg_calib("inspect", tmp_path / JOB).code == 0


DEGREES = {f"q{i}": 180 / np.pi for i in range(1, 7)} | dict.fromkeys("xyz", 1e3)


def test_columns_of_other_names_and_units_are_explained(fg_calib, folder, write):
    names = {f"q{i}": f"J{i} [°]" for i in range(1, 7)} | {"x": "X (mm)", "y": "Y_mm", "z": "pos_z [mm]"}
    given = drafted(fg_calib, folder, folder / "robot.yaml", write(names, DEGREES))
    assert given["units"] == {"length": "mm", "angle": "deg"}
    assert given["measurements"][0]["columns"] == names
    assert "DECIDE whether these are what the names mean" in (folder / JOB).read_text().split("'J6 [°]'")[1]
    write(name="plain.csv")
    (folder / "plain.yaml").write_text("{robot: robot.yaml, measurements: plain.csv, model: position}")
    mine, plain = (read_job(folder / f).tables[0].measurements for f in (JOB, "plain.yaml"))
    assert mine.position == pytest.approx(plain.position, abs=1e-12)
    assert mine.readings == pytest.approx(plain.readings, abs=1e-12)


def test_a_protocol_of_an_instrument_is_read_as_it_is(fg_calib, folder, write):
    """A preamble, a row of units, semicolons with decimal commas, other words, bytes of Windows."""
    text = pl.read_csv(write()).with_row_index("Punkt", 1).with_columns(Reflektor=pl.lit("groß"))
    text = text.write_csv(separator=";", decimal_comma=True)
    (folder / "poses.csv").write_bytes(f"Gerät 7;,\n2026-11-28;14:05\nmm{';mm' * 10}\n{text}".encode("cp1252"))
    given = drafted(fg_calib, folder, folder / "robot.yaml", folder / "poses.csv")["measurements"][0]
    assert (given["skip_lines"], given["columns"]) == (3, {"id": "Punkt", "target": "Reflektor"})
    read = read_job(folder / JOB).tables[0].measurements
    assert [*read.ids[:2], *read.labels["target"].names] == ["1", "2", "groß"]
    (folder / JOB).write_text((folder / JOB).read_text().replace("skip_lines: 3", "skip_lines: 99"))
    ended = fg_calib("inspect", folder / JOB)
    assert (ended.code, ended.err.count("\n")) == (1, 1)
    assert "poses.csv: skip_lines: found 99, expected fewer than the 44 lines of the file" in ended.err
    (folder / "tail.csv").write_text(write().read_text() + "Ende\n")
    ended = fg_calib("init", folder / "robot.yaml", folder / "tail.csv", "--out", folder / "tail.yaml")
    assert "tail.csv:42: 1 cell, expected 9 as in the header" in ended.err


def test_units_that_no_header_specifies_are_guessed_from_the_values(fg_calib, folder, write):
    given = drafted(fg_calib, folder, folder / "robot.yaml", write(factors=DEGREES))
    assert given["units"] == {"length": "mm", "angle": "deg"}
    assert "# DECIDE where headers do not say: they are guessed from the values' sizes" in (folder / JOB).read_text()
    assert given["noise"]["position"] == 0.1


def test_several_tables_have_entries_and_units_of_their_own(fg_calib, folder, write):
    mm = write({"x": "x [mm]", "y": "y [mm]", "z": "z [mm]"}, dict.fromkeys("xyz", 1e3), "monday.csv")
    header = ",".join(["anchor", "distance [m]", *(f"q{i}" for i in range(1, 7))])
    (folder / "tuesday.csv").write_text(f"{header}\n" + "bolt,1,0,0,0,0,0,1\n" * 3)
    given = drafted(fg_calib, folder, mm, folder / "tuesday.csv", folder / "robot.yaml")
    first, second = given["measurements"]
    assert (first["table"], first["model"], first["frame"]) == ("monday.csv", "position", "unknown")
    assert (second["table"], second["model"]) == ("tuesday.csv", "anchor")
    assert (second["units"], given["units"]) == ({"length": "m", "angle": "rad"}, {"length": "mm", "angle": "rad"})
    assert set(given["noise"]) == {"position", "distance", "joint", "estimate"}
    assert (folder / JOB).read_text().count("# offset: estimate  # DECIDE whether the instrument adds a constant") == 1


def test_sigmas_in_a_table_need_no_value_of_noise(fg_calib, folder, write):
    table = pl.read_csv(write()).with_columns(pl.lit(5e-5).alias("sigma_position"))
    table.write_parquet(folder / "poses.parquet")
    given = drafted(fg_calib, folder, folder / "robot.yaml", folder / "poses.parquet")
    assert given["measurements"][0]["table"] == "poses.parquet"
    assert given["noise"] == {"joint": 0.0, "estimate": True}
    pl.concat([table, table]).write_parquet(folder / "poses.parquet")  # rows that share errors of the joints
    (folder / JOB).unlink()
    assert drafted(fg_calib, folder, folder / "robot.yaml", folder / "poses.parquet")["noise"]["joint"] == 1e-4


def test_what_only_the_user_knows_is_asked_for(fg_calib, folder, write):
    robot = {key: value for key, value in UR5E.items() if key != "tolerance"}
    (folder / "robot.yaml").write_text(yaml.safe_dump(robot))
    drafted(fg_calib, folder, folder / "robot.yaml", write())
    text = (folder / JOB).read_text()
    for question in ("how far off the nominal model may be", "whether exactly the robot file's tool", "the noise"):
        assert text.count(f"DECIDE {question}") == 1
    ended = fg_calib("init", folder / "robot.yaml", folder / "poses.csv", "--out", folder / JOB)
    assert (ended.code, ended.err) == (1, f"error: {folder / JOB}: is there already, expected a folder without it\n")


def test_a_job_of_a_urdf_has_prior_sigmas_as_the_draft_says(fg_calib, folder, write):
    fg_calib("export", folder / "robot.yaml", "--to", "urdf", "--out", folder / "arm.urdf")
    drafted(fg_calib, folder, folder / "arm.urdf", write())
    text = (folder / JOB).read_text()
    advice = text.partition("# robot: ")[2].partition(", in this job's units")[0]
    (folder / JOB).write_text(text.replace("robot: arm.urdf", f"robot: {advice}", 1))
    assert not any(p.tolerance is None for p in read_job(folder / JOB).robot.parameters if p.estimated)


REFUSED = {
    "no robot": (["poses.csv"], "init: no robot among the files, expected one, such as robot.yaml or a URDF"),
    "no table": (["robot.yaml"], "init: no table among the files, expected one, such as poses.csv"),
    "a picture": (["robot.yaml", "poses.png"],
                  "poses.png: neither robot, camera nor table, expected robot.yaml (joints"),
    "joints alone": (["robot.yaml", "alone.csv"], "alone.csv: joint readings alone, expected what was measured"),
    "pairs alone": (["robot.yaml", "pairs.csv"], "pairs.csv: pairs alone, expected the table of the configurations"),
    "two units": (["robot.yaml", "mixed.csv"], "mixed.csv: lengths in cm, mm, expected one of m, cm, mm, um, in"),
    "two robots": (["robot.yaml", "other.yaml", "poses.csv"], "init: several robots: robot.yaml, other.yaml"),
    "a job": (["job.yaml", "poses.csv"], "job.yaml: neither robot, camera nor table, expected robot.yaml"),
    "no camera": (["robot.yaml", "seen.csv"], "seen.csv: images of a camera that is not among the files"),
    "two joints": (["robot.yaml", "few.csv"], "few.csv: neither joint readings nor pairs, expected columns q1 to q6"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(fg_calib, folder, write, case):
    write()
    q, zeros = ",".join(f"q{i}" for i in range(1, 7)), ",".join("0" * 6)
    (folder / "other.yaml").write_text((folder / "robot.yaml").read_text())
    (folder / "job.yaml").write_text("{robot: robot.yaml, measurements: poses.csv, model: pose}")
    (folder / "alone.csv").write_text(f"{q}\n{zeros}\n")
    (folder / "few.csv").write_text("q1,q2,x,y,z\n0,0,0,0,0\n")
    (folder / "pairs.csv").write_text("a,b,distance\n0,1,0.5\n")
    (folder / "mixed.csv").write_text(f"{q},x_mm,y_cm,z_mm\n{zeros},0,0,0\n")
    (folder / "seen.csv").write_text(f"{q},u,v,corner_x,corner_y\n{zeros},1,2,0,0\n")
    files, message = REFUSED[case]
    ended = fg_calib("init", *(folder / file for file in files), "--out", folder / JOB)
    assert (ended.code, ended.out, ended.err.count("\n")) == (1, "", 1)
    assert ended.err.startswith(f"error: {message.format(folder)}")
    assert not (folder / JOB).exists()
