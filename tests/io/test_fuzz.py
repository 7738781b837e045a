"""Whatever is done to a file, only the package's own errors leave its reader, in one line."""

import copy
import json
import math
import shutil
import warnings

import numpy as np
import polars as pl
import pytest

from fg_calib import Calibration, InputError, Robot, calibrate_job, read_job, read_robot
from fg_calib.cli import EXAMPLES
from fg_calib.io import read_measurements, read_result
from fg_calib.simulation import read_scenario

URDF = """<?xml version="1.0"?><robot name="r"><link name="a"/><link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 1" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1"/></joint></robot>"""
ARM = Robot.from_dh([[0.5, 0.1, 0.2, 0.0], [0.4, 0.2, 0.1, 0.0]], convention="dh")
POSES = "id,q1,q2,x,y,z,qx,qy,qz,qw,split\nk0,0.1,0.2,1,2,3,0,0,0,1,train\nk1,0.4,0.5,4,5,6,0,0,0,1,test\n"
PAIRS = "a,b,distance,angle,sigma_distance\nk0,k1,0.5,0.25,1e-3\n"
TOKENS = [b"nan", b"1e400", b"-", b"\x00", b"\xff\xfe", b'"', b"\n", b"\r", b",", b";", b"[", b"{", b"*", b"&a", b": "]
TOKENS += [b"!!", b"<", b"&lol;", b"9" * 400, b"=", b"1_0", b"true", b"2020-01-01", b"'", b"\t", b"\xed\xa0\x80"]


def read_pairs_and_poses(folder, name):
    del name
    read_measurements(folder / "rows.csv", ARM, pairs=folder / "pairs.csv")


READERS = {
    "robot.yaml": lambda folder, name: read_robot(folder / name),
    "arm.urdf": lambda folder, name: read_robot(folder / name),
    "calibration.yaml": lambda folder, name: read_job(folder / name),
    "scenario.yaml": lambda folder, name: read_scenario(folder / name),
    "rows.csv": read_pairs_and_poses,
    "pairs.csv": read_pairs_and_poses,
    "rows.parquet": lambda folder, name: read_measurements(folder / name, ARM),
    "result.json": lambda folder, _: Calibration.load(folder),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a whole file for each reader."""
    folder = tmp_path_factory.mktemp("fuzz")
    shutil.copytree(EXAMPLES / "space-robot", folder, dirs_exist_ok=True)
    shutil.copy(folder / "robot_nominal.yaml", folder / "robot.yaml")
    shutil.copy(EXAMPLES.parent / "scenarios" / "space-robot" / "scenario.yaml", folder)
    (folder / "arm.urdf").write_text(URDF)
    calibrate_job(folder / "calibration.yaml").save(folder)
    (folder / "rows.csv").write_text(POSES)
    (folder / "pairs.csv").write_text(PAIRS)
    pl.read_csv(POSES.encode()).write_parquet(folder / "rows.parquet")
    return folder


def damage(content, rng):
    """A file with some bytes cut, doubled or replaced."""
    for _ in range(rng.integers(1, 4)):
        start = rng.integers(len(content) + 1)
        stop = rng.integers(start, min(start + 40, len(content)) + 1)
        others = [b"", content[start:stop] * 2, *TOKENS]
        content = content[:start] + others[rng.integers(len(others))] + content[stop:]
    return content


def refusal(read, *given):
    """What a reader says against a file; empty if it reads it."""
    try:
        read(*given)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_end_in_one_line_or_are_read(folder, name):
    file = folder / name
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    READERS[name](folder, name)  # what is whole is read
    try:
        for _ in range(30):
            file.write_bytes(damage(whole, rng))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                assert refusal(READERS[name], folder, name).isprintable()  # as "" is
    finally:
        file.write_bytes(whole)


WRONG = [None, True, -1, 2, 0.5, math.nan, math.inf, -1e300, "", "ab", [], {}]


def test_any_value_of_a_result_is_read_or_refused_in_one_line(folder, tmp_path):
    document, rng = json.loads((folder / "result.json").read_text()), np.random.default_rng(0)
    pick = lambda items: items[rng.integers(len(items))]  # noqa: E731
    for _ in range(100):
        damaged = part = copy.deepcopy(document)
        key = pick(sorted(damaged))
        while isinstance(part[key], dict | list) and part[key] and rng.random() < 0.7:
            part = part[key]
            key = pick(sorted(part) if isinstance(part, dict) else range(len(part)))
        part[key] = pick(WRONG)
        (tmp_path / "result.json").write_text(json.dumps(damaged))
        assert refusal(read_result, tmp_path).isprintable()
