"""Whatever is done to a file, only the package's own errors leave its reader, in one line."""

import shutil
import warnings
from pathlib import Path

import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fg_calib
from fg_calib import Calibration, InputError, Robot, calibrate_job, read_job, read_robot
from fg_calib.io import read_measurements
from fg_calib.simulation import read_scenario

BUNDLED = Path(fg_calib.__file__).parent / "examples"
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
    example = next(BUNDLED.rglob("calibration.yaml")).parent
    for file in example.iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    shutil.copy(example / "robot_nominal.yaml", folder / "robot.yaml")
    shutil.copy(BUNDLED.parent / "scenarios" / "space-robot" / "scenario.yaml", folder)
    (folder / "arm.urdf").write_text(URDF)
    calibrate_job(folder / "calibration.yaml").save(folder)
    (folder / "rows.csv").write_text(POSES)
    (folder / "pairs.csv").write_text(PAIRS)
    pl.read_csv(POSES.encode()).write_parquet(folder / "rows.parquet")
    return folder


@st.composite
def damages(draw, content):
    """A file with some bytes cut, doubled, moved, flipped or replaced."""
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(content)))
        stop = draw(st.integers(start, min(start + 40, len(content))))
        content = content[:start] + draw(st.sampled_from([b"", content[start:stop] * 2, *TOKENS])) + content[stop:]
    return content


@pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisWarning")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_end_in_one_line_or_are_read(folder, name):
    whole = (folder / name).read_bytes()

    @settings(max_examples=30, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(content=damages(whole))
    def check(content):
        (folder / name).write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                READERS[name](folder, name)
            except InputError as error:
                message = str(error)
                assert message.isprintable()

    try:
        READERS[name](folder, name)  # what is whole is read
        check()
    finally:
        (folder / name).write_bytes(whole)
