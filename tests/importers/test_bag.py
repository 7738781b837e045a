"""ROS bags of every format, written by the tests: what is read of them, and a line for each that cannot be used."""

import gc
import sys

import numpy as np
import pytest
from recordings import FORMATS, NAMES, POSE_TYPES, START, BagWriter, arm, record, write_bag
from refusals import refusal
from scipy.stats import chi2
from sparing import diagonal

from fg_calib import Robot, Table, calibrate
from fg_calib.importers.bag import average_stops, read_bag, write_stops
from fg_calib.io import read_measurements, write_robot

pytest.importorskip("rosbags", reason="the extra ros is not installed")

# rosbags leaves files open that it cannot read, of which Python warns wherever garbage is collected.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(autouse=True)
def collect_garbage():
    """Where the warning is expected, and not in another test."""
    yield
    gc.collect()


QUICK = {"n_stops": 3, "rest": 1.1, "move": 0.8, "joint_rate": 30.0, "pose_rate": 25.0}


@pytest.fixture(scope="module")
def short():
    return record(0, **QUICK)


@pytest.fixture(scope="module")
def bags(tmp_path_factory, short):
    """The same motion in each format."""
    return {form: write_bag(tmp_path_factory.mktemp(form), short, form) for form in FORMATS}


@pytest.mark.parametrize("form", FORMATS)
def test_what_was_recorded_is_read(bags, short, form):
    joints, poses = read_bag(bags[form], arm())
    assert joints.readings == pytest.approx(short.readings, abs=0)
    assert joints.time == pytest.approx(short.joint_time, abs=2e-9)
    assert poses.time == pytest.approx(short.pose_time, abs=2e-9)
    assert poses.position == pytest.approx(short.position, abs=0)
    assert poses.rotation == pytest.approx(short.rotation, abs=1e-12)
    assert joints.source.lag - poses.source.lag == pytest.approx(short.offset, abs=1e-6)
    assert (joints.source.topic, poses.source.topic) == ("/joint_states", "/pose")
    assert joints.source.notes == poses.source.notes == ()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("pose_type", "form"), diagonal(POSE_TYPES[1:], ["ros1", "mcap"]))
def test_poses_of_every_type_are_read(tmp_path, short, form, pose_type):
    _, poses = read_bag(write_bag(tmp_path, short, form, pose_type), arm())
    assert poses.position == pytest.approx(short.position, abs=0)
    assert poses.rotation == pytest.approx(short.rotation, abs=1e-12)


@pytest.mark.slow
def test_a_bag_calibrates_the_arm(tmp_path, fg_calib):
    """The whole way: bag, table, calibration; clocks 137 ms apart. Errors of the arm are what noise explains."""
    true = arm(1e-3)
    motion = record(5, robot=true, n_stops=40, rest=1.3, move=1.0, joint_rate=40.0, pose_rate=30.0)
    nominal = arm(tolerance={"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3})
    write_robot(tmp_path / "robot.yaml", nominal)
    bag, table = write_bag(tmp_path, motion, "mcap"), tmp_path / "poses.csv"
    ended = fg_calib("bag", bag, "--robot", tmp_path / "robot.yaml", "--out", table)
    assert ended.code == 0
    assert "40 stops found, 40 used, 0 skipped" in ended.out
    assert ended.err.endswith(f"wrote 40 poses to {table}\n")
    found = calibrate(nominal, [Table(read_measurements(table, nominal), "pose", frame="unknown")]).assessment
    error = (found.robot.nominal - true.nominal)[[nominal.index(name) for name in found.names]]
    assert chi2.cdf(error @ np.linalg.solve(found.covariance, error), len(error)) < 0.999
    assert np.abs(error).max() < 0.2 * np.abs(nominal.nominal - true.nominal).max()


def test_the_table_is_read_as_it_was_averaged(tmp_path):
    stops = average_stops(*record(2, n_stops=4).streams(), arm())
    write_stops(tmp_path / "poses.csv", stops, arm())
    m = read_measurements(tmp_path / "poses.csv", arm())
    assert tuple(m.ids) == stops.ids
    for kind, values, sigma in (("joint", m.readings, None), ("position", m.position, m.sigma_position),
                                ("orientation", m.rotation, m.sigma_orientation)):  # fmt: skip
        assert values == pytest.approx(stops.means[kind], abs=1e-12)
        assert sigma is None or sigma == pytest.approx(stops.sigmas[kind], abs=0)
    said = refusal(write_stops, tmp_path / "poses.csv", stops, arm())
    assert "is there already, expected a folder without it" in said


# Topics, frames, stamps and names


@pytest.fixture
def bag(tmp_path):
    """An open bag with two joint messages."""
    bag = BagWriter(tmp_path, "mcap")
    for k in range(2):
        bag.joints(START + k, NAMES, np.zeros(6))
    return bag


def poses(bag, n=2, **more):
    for k in range(n):
        bag.pose(START + k, [k, 0, 0], [0, 0, np.sin(0.1 * k), np.cos(0.1 * k)], **more)


def test_transforms_of_one_frame_are_chosen(bag):
    poses(bag, form="TFMessage", topic="/tf", frames=("/map", "base"))
    poses(bag, n=3, form="TFMessage", topic="/tf", frames=("camera", "marker"))
    path = bag.close()
    assert len(read_bag(path, arm(), child="marker")[1].time) == 3
    assert len(read_bag(path, arm(), parent="map")[1].time) == 2
    assert error(path) == (
        f"{path.name}: topic /tf: poses of 2 frames, expected one: --parent FRAME --child FRAME; "
        "it has map -> base, camera -> marker"
    )
    assert error(path, child="hand").startswith(f"{path.name}: topic /tf: no poses of these frames, expected one:")


def test_what_is_left_out_or_put_in_order_is_reported(bag):
    for k, (late, x) in enumerate(((5, 5.0), (3, 3.0), (3, 4.0), (7, np.nan))):
        bag.pose(START + late * 10**6, [x, 0, 0], [0, 0, 0, 1], received=START + 10**9 + k)
    bag.joints(START + 10**7, ["gripper"], [0.1])
    joints, found = read_bag(bag.close(), arm())
    assert found.position[:, 0].tolist() == [3.0, 5.0]
    assert joints.source.notes == ("1 message without the robot's joints left out",)
    assert found.source.notes == (
        "1 message with nan left out", "2 messages out of order put in order",
        "1 message with the stamp of another left out", "all orientations are the same: taken as not measured"
    )  # fmt: skip
    assert found.rotation is None


# A line each for what cannot be used


def error(path, robot=None, **more):
    return refusal(read_bag, path, robot or arm(), **more)


def test_topics_and_joints_that_are_missing(bag):
    poses(bag)
    path = bag.close()
    has = "the bag has /joint_states (sensor_msgs/msg/JointState), /pose (geometry_msgs/msg/PoseStamped)"
    assert error(path, pose="/tool") == f"{path.name}: no topic /tool for --pose; {has}"
    assert error(path, joints="/pose") == f"{path.name}: no topic /pose for --joints; {has}"
    assert error(path, Robot.from_dh([[0, 0, 0, 0]] * 2, names=["pan", "tilt"])) == (
        f"{path.name}: topic /joint_states: no joint tilt, expected the robot's joints among {', '.join(NAMES)}; "
        "name the bag's joints in chain order: --names, or `name` in the robot file"
    )
    robot = Robot.from_dh(np.zeros((6, 4)))
    assert read_bag(path, robot, names=NAMES)[0].readings.shape == (2, 6)
    assert error(path, robot, names=["pan"]) == "joint names: found pan, expected 6 different ones"


def test_a_clock_that_was_set_back(bag):
    for k in (2, 60, 3):
        bag.pose(START + k * 10**9, [k, 0, 0], [0, 0, 0, 1], received=START + 100)
    path = bag.close()
    expected = "stamps go back by 57 s at message 3, expected a clock that runs on"
    assert error(path) == f"{path.name}: topic /pose: {expected}"


def test_files_that_are_no_bag(tmp_path):
    (tmp_path / "run.txt").write_text("x")
    (tmp_path / "cut.bag").write_bytes(b"#ROSBAG V2.0")
    assert error(tmp_path / "none.bag") == f"{tmp_path / 'none.bag'}: no such bag"
    for name in ("run.txt", "cut.bag"):
        assert error(tmp_path / name).startswith(f"{name}: a bag that cannot be read: ")
    assert error(tmp_path / "cut.bag").endswith("; was the recording cut off? `rosbag reindex` repairs a .bag")


def test_without_rosbags_a_line_says_what_to_install(tmp_path, fg_calib, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    write_robot(tmp_path / "robot.yaml", arm())
    ended = fg_calib("bag", tmp_path / "run.bag", "--robot", tmp_path / "robot.yaml")
    assert ended == (1, "", "error: fg-calib bag needs rosbags: pip install 'fg_calib[ros]'\n")
