"""Calibration jobs: defaults, units, what they refer to, and one message a mistake."""

import hashlib
import math

import numpy as np
import pytest

from fg_calib import Options, Pairing, read_job

ROBOT = """\
convention: mdh
joints:
  - {a: 0, alpha: 0, d: 0, theta: 0}
  - {a: 0, alpha: 0, d: 0, theta: 0, type: prismatic}
"""
URDF = (
    '<robot name="one"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
    '<parent link="a"/><child link="b"/></joint></robot>'
)
JOB = """\
robot: robots/robot.yaml
measurements: poses.csv
model: pose
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "robot.yaml").write_text(ROBOT)
    (tmp_path / "robots" / "arm.urdf").write_text(URDF)
    (tmp_path / "robots" / "wrapped.yaml").write_text("urdf: arm.urdf\ntool: {z: 1}\n")
    (tmp_path / "poses.csv").write_text("q1,q2,x,y,z\n0,0,0,0,0\n10,20,1000,0,0\n")
    (tmp_path / "one.csv").write_text("j\n0\n1\n")
    (tmp_path / "q.csv").write_text("q1\n0\n1\n")
    (tmp_path / "pairs.csv").write_text("a,b,distance,angle\n0,1,2000,90\n")
    return tmp_path


def read(folder, text):
    (folder / "calibration.yaml").write_text(text)
    return read_job(folder / "calibration.yaml")


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("units", ["{length: mm, angle: deg}", "{length: um}", "{angle: mrad}", "{}"])
def test_a_urdf_in_a_job_has_the_jobs_units(folder, units):
    """Its tolerances, base and tool, unless it states units of its own; as a file with a line `units` reads."""
    rest = "tool: {x: 3}, estimate: [tool.yaw], tolerance: {x: 0.5, yaw: 0.01, tool: 2}"
    (folder / "arm.yaml").write_text(f"urdf: robots/arm.urdf\nunits: {units}\n" + rest.replace(", est", "\nest")
                                     .replace(", tol", "\ntol"))  # fmt: skip
    job = "measurements: one.csv\nmodel: pose\n"
    in_the_job = read(folder, job + f"units: {units}\nrobot: {{urdf: robots/arm.urdf, {rest}}}\n").robot
    assert in_the_job.parameters == read(folder, job + "robot: arm.yaml\n").robot.parameters
    own = f"{{urdf: robots/arm.urdf, units: {{length: cm}}, {rest}}}"
    stated = read(folder, job + f"units: {units}\nrobot: {own}\n").robot
    tolerance = {p.name: p.tolerance for p in stated.parameters}
    assert (tolerance["j.x"], tolerance["j.yaw"], tolerance["tool.x"]) == (0.005, 0.01, 0.02)


def test_a_short_job_has_the_defaults(folder):
    job = read(folder, JOB)
    assert job.path == folder / "calibration.yaml"
    assert (job.robot.name, job.robot.n_joints) == ("robot", 2)
    (table,) = job.tables
    assert table.measurements.position[1].tolist() == [1000, 0, 0]
    assert job.options == Options("pose")
    assert table.measurements.sigma_position is None
    names = ("calibration.yaml", "robots/robot.yaml", "poses.csv")
    assert job.inputs == {name: sha256(folder / name) for name in names}


def test_a_full_job_is_converted_to_si(folder):
    job = read(
        folder,
        JOB + "pairs: pairs.csv\npairing: {random: 30, seed: 4}\nframe: unknown\nunits: {length: mm, angle: deg}\n"
        "noise: {position: 1, orientation: 2, joint: 3, distance: 4, angle: 5}\nprior: false\nloss: none\n",
    )
    m = job.tables[0].measurements
    assert m.readings[1] == pytest.approx([math.radians(10), 0.02])
    assert m.sigma_position == pytest.approx(np.full((2, 3), 1e-3))
    assert m.sigma_joint == pytest.approx([math.radians(3), 3e-3])  # the second joint slides
    assert (m.pairs.distance[0], m.pairs.angle[0]) == pytest.approx((2.0, math.pi / 2))
    assert (m.pairs.sigma_distance[0], m.pairs.sigma_angle[0]) == pytest.approx((4e-3, math.radians(5)))
    assert job.options.pairing == Pairing("random", 30, 4)
    assert (job.options.frame, job.options.gauge) == ("unknown", "none")
    assert job.inputs["pairs.csv"] == sha256(folder / "pairs.csv")


def test_boxes_to_keep_out_of_are_read_in_every_form(folder):
    forms = "{lower: [0, 0, 0], upper: [1, 1, 2]}, {box: [[0, 0, 0], [1, 1, 2]]}, {below: 3}"
    boxes = read(folder, f"{JOB}units: {{length: mm}}\nkeep_out: [{forms}]\n").keep_out
    both, below = [[[0, 0, 0], [1e-3, 1e-3, 2e-3]]] * 2, [[-1e6] * 3, [1e6, 1e6, 3e-3]]
    assert [box.tolist() for box in boxes] == [*both, below]


def test_tables_have_columns_of_their_own_names(folder):
    """For all tables at the top, or in a table's own entry; figures are in the table's units after their scale."""
    (folder / "robots" / "robot.yaml").write_text(ROBOT.replace("joints", "units: {angle: deg}\njoints"))
    (folder / "counts.csv").write_text("C1;C2;X;Y;Z\n180;20;1000,5;0;0\n0;10;0;0;0\n")
    own = "{q1: {name: C1, scale: 0.5, zero: 160}, q2: C2, x: X, y: Y, z: Z}"
    units = "units: {length: mm, angle: deg}\n"
    job = JOB.replace("model: pose", "model: position").replace("poses.csv", "counts.csv") + units
    data = read(folder, f"{job}columns: {own}\n").tables[0].measurements
    assert data.readings[0].tolist() == pytest.approx([np.deg2rad(10.0), 0.02], rel=1e-15)
    assert data.position[0].tolist() == [1.0005, 0.0, 0.0]
    entry = f"\n  - {{table: counts.csv, columns: {own}}}"
    (table,) = read(folder, job.replace(" counts.csv", entry)).measurements
    assert table.measurements.readings.tolist() == data.readings.tolist()


@pytest.mark.parametrize(("robot", "files"), [
    ("robots/arm.urdf", ["robots/arm.urdf"]),
    ("robots/wrapped.yaml", ["robots/wrapped.yaml", "robots/arm.urdf"]),
    ("{urdf: robots/arm.urdf, base_link: a, tip_link: b}", ["robots/arm.urdf"]),
    ("{convention: dh, joints: [{a: 0, alpha: 0, d: 0, theta: 0, name: j}]}", []),
])  # fmt: skip
def test_a_robot_may_be_a_file_or_stand_in_the_job(folder, robot, files):
    job = read(folder, f"robot: {robot}\nmeasurements: one.csv\nmodel: pose\n")
    assert [joint.name for joint in job.robot.joints] == ["j"]
    assert list(job.inputs) == ["calibration.yaml", *files, "one.csv"]


def test_a_simulated_job_knows_the_truth(folder):
    assert read(folder, JOB).truth is None
    (folder / "true.yaml").write_text(ROBOT.replace("a: 0, alpha", "a: 0.25, alpha"))
    job = read(folder, JOB + "truth: true.yaml\n")
    assert job.truth.nominal[job.truth.index("a1")] == 0.25
    assert job.robot.nominal[job.robot.index("a1")] == 0.0
    assert "true.yaml" in job.inputs


def test_noise_may_be_left_to_the_data(folder):
    poses = "q1,q2,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0,0\n10,20,1000,0,0,0,0,0\n"
    (folder / "poses.csv").write_text(poses)
    given = read(folder, JOB + "noise: {position: 0.5, estimate: true}\n")
    assert given.options.estimate_noise
    m = given.tables[0].measurements
    assert (m.sigma_position[0, 0], m.sigma_orientation[0, 0]) == (0.5, 1e-3)
    start = read(folder, JOB + "noise: estimate\n")
    assert start.options.estimate_noise
    m = start.tables[0].measurements
    assert (m.sigma_position[0, 0], m.sigma_orientation[0, 0]) == (1e-3, 1e-3)
    assert not read(folder, JOB + "noise: {position: 0.5}\n").options.estimate_noise
