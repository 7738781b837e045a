"""`fg-calib design`: what it prints and writes, and the job that it writes to be filled in."""

import json

import numpy as np
import polars as pl
import pytest
import yaml
from oracle import tool_pose
from simulated import LARGE, small_arm

from fg_calib.io import Units, write_robot

ARM = small_arm(tolerance=LARGE)
JOINTS = ["q1", "q2", "q3", "q4"]
UNITS = {"length": "mm", "angle": "deg"}
IN_SI = np.array([1e-3 if joint.prismatic else np.pi / 180.0 for joint in ARM.joints])

SCENARIO = {"robot": "robot.yaml", "units": UNITS, "frame": "unknown", "job": {"model": "pose"}}
SCENARIO |= {"errors": {"normal": "tolerance"}, "configurations": {"random": {"count": 20}}}
SCENARIO |= {"noise": {"position": 0.1, "orientation": 0.01, "joint": 0.001}}
TABLE = {"normal": [0.0, 0.0, 1.0], "distance": -100.0}

DOCUMENT = {
    "schema", "version", "robot", "criterion", "n", "n_given", "target", "reached", "fitted", "expected", "before",
    "known_tool", "random", "undetermined_share", "curve", "candidates", "stops", "undetermined", "travel",
    "travel_unordered",
}  # fmt: skip
FEW = ("--candidates", 25)


@pytest.fixture
def plan(tmp_path):
    """A scenario's file, with some keys changed."""
    write_robot(tmp_path / "robot.yaml", ARM, units=Units(**UNITS))

    def write(name="plan.yaml", **changes):
        (tmp_path / name).write_text(yaml.safe_dump(SCENARIO | changes))
        return tmp_path / name

    return write


def table_of(path, readings):
    """A table of configurations, in degrees and millimetres."""
    pl.DataFrame(dict(zip(JOINTS, (np.asarray(readings) / IN_SI).T, strict=True))).write_csv(path)
    return path


def readings_in(path):
    return pl.read_csv(path).select(JOINTS).to_numpy() * IN_SI


# --- what it prints ---------------------------------------------------------------------------------------------------


def test_the_document_has_its_keys_in_si(plan, fg_calib):
    ended = fg_calib("design", plan(), "--n", 4, *FEW, "--json")
    assert ended.code == 0, ended.err
    assert ended.err.splitlines()[-1] == "nothing is written: --out DIR writes tables and a job"
    found = json.loads(ended.out)
    assert found.keys() == DOCUMENT
    assert (found["schema"], found["robot"], found["criterion"]) == ("fg-calib/design/1", "small-arm", "I")
    assert (found["n"], found["n_given"], found["target"], found["reached"]) == (4, 0, None, True)
    assert found["before"] is None
    assert found["expected"].keys() == {"position", "orientation"}
    assert 1e-5 < found["expected"]["position"] < found["random"] < 1e-2
    assert found["candidates"] == {"all": {"asked": 25, "taken": 25, "rejected": {}}}
    assert [stop["id"] for stop in found["stops"]] == ["s1", "s2", "s3", "s4"]
    q = np.array([stop["readings"] for stop in found["stops"]])
    lower, upper = ARM.limits.T
    assert ((q >= lower) & (q <= upper)).all()
    moved = np.abs(np.diff(q, axis=0)) / [ARM.reach if joint.prismatic else 1.0 for joint in ARM.joints]
    assert found["travel"] == pytest.approx(moved.max(axis=1).sum(), rel=1e-12)
    assert found["curve"][-1]["n"] == 4
    assert all(point.keys() == {"n", "designed", "random"} for point in found["curve"])
    assert all(point["random"] == sorted(point["random"]) for point in found["curve"])


@pytest.mark.slow
def test_what_can_be_asked_for_is_done(plan, fg_calib, tmp_path):
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 4))
    some, task = table_of(tmp_path / "some.csv", q), table_of(tmp_path / "task.csv", q[:3])
    given = table_of(tmp_path / "given.csv", q[:2] + 0.1)
    ended = fg_calib("design", plan(), "--n", 3, "--candidates", some, "--given", given, "--task", task,
                     "--criterion", "D", "--error", "base", "--lever", "200mm", "--seed", 5, "--json")  # fmt: skip
    assert ended.code == 0, ended.err
    found = json.loads(ended.out)
    assert (found["criterion"], found["fitted"], found["n_given"]) == ("D", False, 2)
    assert found["before"]["position"] > found["expected"]["position"]
    assert found["candidates"]["all"]["taken"] == 12
    for stop in found["stops"]:
        assert np.abs(q - stop["readings"]).max(axis=1).min() < 1e-9


# --- what it writes, filled in ----------------------------------------------------------------------------------------


OF_ALL = {"position": 0.1, "orientation": 0.01, "distance": 0.1, "point": 0.1, "joint": 0.001}
INSTRUMENTS = {
    "plane and poses": {"instruments": [{"model": "plane", "name": "table", "planes": {"floor": TABLE}},
                                        {"model": "pose", "name": "tracker"}]},
    "sockets": {"instruments": [{"model": "distance", "name": "sockets", "sockets": 2}],},
    "formed pairs": {"job": {"model": "distance-rotation"}},
}  # fmt: skip


POSE = ["x", "y", "z", "qx", "qy", "qz", "qw"]
EMPTY = {
    "plane and poses": {"table.csv": ["distance"], "tracker.csv": POSE},
    "sockets": {"sockets.csv": JOINTS, "sockets_pairs.csv": ["distance"]},
    "formed pairs": {"poses.csv": POSE},
}
POSE_NOISE = {"noise": {"position": 0.1, "orientation": 0.01}}
ENTRIES = {
    "plane and poses": [{"table": "table.csv", "model": "plane", "noise": {"distance": 0.1}},
                        {"table": "tracker.csv", "model": "pose", "frame": "unknown"} | POSE_NOISE],
    "sockets": [{"table": "sockets.csv", "model": "distance", "pairs": "sockets_pairs.csv",
                 "noise": {"distance": 0.1, "point": 0.1}}],
    "formed pairs": [{"table": "poses.csv", "model": "distance-rotation", "pairing": "star"} | POSE_NOISE],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", INSTRUMENTS)
def test_a_job_is_written_with_tables_to_fill_in(kind, plan, fg_calib, tmp_path):
    out = tmp_path / "out"
    changes = INSTRUMENTS[kind]
    changes = changes | {"job": {}, "noise": OF_ALL} if "instruments" in changes else changes
    ended = fg_calib("design", plan(**changes), "--n", 16, "--candidates", 40, "--out", out)
    assert ended.code == 0, ended.err
    assert f"to {out}" in ended.err
    document = json.loads((out / "design.json").read_text())
    assert (out / "design.svg").read_text().startswith("<svg")
    stops = pl.read_csv(out / "configurations.csv")
    assert stops["id"].to_list() == [stop["id"] for stop in document["stops"]]
    q = readings_in(out / "configurations.csv")
    assert q == pytest.approx(np.array([stop["readings"] for stop in document["stops"]]), abs=1e-8)
    at = np.array([1e3 * tool_pose(ARM, one)[:3, 3] for one in q])
    moved = 1e3 * (4 * ARM.reach * 1e-8 + 1e-9)  # by readings and by itself
    assert stops.select("tool_x", "tool_y", "tool_z").to_numpy() == pytest.approx(at, abs=moved)
    tables = {path.name: pl.read_csv(path) for path in out.glob("*.csv")}
    empty = {name: [c for c in table.columns if table[c].null_count() == len(table)] for name, table in tables.items()}
    assert {name: columns for name, columns in empty.items() if columns} == EMPTY[kind]
    job = yaml.safe_load((out / "calibration.yaml").read_text())
    assert job == {"robot": "robot.yaml", "units": UNITS, "noise": {"joint": 0.001}, "measurements": ENTRIES[kind]}
    assert all(set(tables[one["table"]]["id"]) == set(stops["id"]) for one in ENTRIES[kind])
    if kind == "sockets":
        assert set(tables["sockets_pairs.csv"].row(0)[:2]) == set(tables["sockets.csv"]["group"])


@pytest.mark.slow
def test_more_of_a_job_is_written_as_a_table_to_fill_in(plan, fg_calib, tmp_path):
    """Of a job made by `simulate`; rows of its own are a table of configurations alone."""
    fg_calib("simulate", plan(), "--out", tmp_path / "demo")
    job = tmp_path / "demo" / "calibration.yaml"
    more = fg_calib("design", job, "--n", 5, *FEW, "--out", tmp_path / "more", "--json")
    assert more.code == 0, more.err
    found = json.loads(more.out)
    assert found["before"]["position"] > found["expected"]["position"]
    table = pl.read_csv(tmp_path / "more" / "poses.csv")
    assert len(table) == 5
    assert table["x"].null_count() == table["qw"].null_count() == 5
    rows = fg_calib("design", job, "--n", 5, "--candidates", "rows", "--out", tmp_path / "rows", "--json")
    assert rows.code == 0, rows.err
    ids = pl.read_csv(tmp_path / "demo" / "poses.csv")["id"].to_list()
    assert {stop["id"] for stop in json.loads(rows.out)["stops"]} <= set(ids)
    assert sorted(f.name for f in (tmp_path / "rows").iterdir()) == ["configurations.csv", "design.json", "design.svg"]


# --- what it refuses --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_second_design_in_a_folder_is_refused(plan, fg_calib, tmp_path):
    """It would lose what was measured."""
    out = tmp_path / "out"
    fg_calib("design", plan(), "--n", 4, *FEW, "--out", out)
    for name in ("design.json", "poses.csv"):
        ended = fg_calib("design", plan(), "--n", 3, *FEW, "--out", out)
        assert ended.code == 1
        assert ended.err.splitlines()[-1].endswith(f"{name}: is there already, expected a folder without it")
        for other in ("design.json", "design.svg", "configurations.csv"):
            (out / other).unlink(missing_ok=True)
