"""Tables and jobs of instruments: what is read is what stands there, and what cannot be used is named."""

import numpy as np
import pytest
import yaml
from instruments import CAMERA, measured_by
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import small_arm

from fg_calib import Noise, calibrate, calibrate_job, read_job
from fg_calib.io import read_measurements, write_csv, write_robot
from fg_calib.measurements.kinds.board import COVARIANCE

ROBOT = small_arm()
INTRINSICS = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "k1", "k2")}
KEYS = {
    "targets known": {"frame": "unknown", "targets": {"t0": {"x": 300, "y": 100, "z": -200}}},
    "targets stations": {"frame": "unknown"},
    "anchors offset": {"offset": "estimate"},
    "anchors known": {},
    "planes": {},
    "board": {},
    "pixels": {"camera": "camera.yaml"},
}


def write_files(folder, robot, table, job):
    """Robot, table in mm and degrees, and a job."""
    m = table.measurements
    columns = {f"q{i + 1}": np.rad2deg(q) if i != 2 else 1e3 * q for i, q in enumerate(m.readings.T)}
    columns |= {"id": m.ids} if m.named else {}
    for name, labels in m.labels.items():
        columns[name] = np.array(["", *labels.names])[labels.index + 1]
    columns |= {name: 1e3 * values for name, values in m.columns.items()}
    if m.image is not None:
        columns |= dict(zip(("u", "v", "corner_x", "corner_y"), (m.image * [1, 1, 1e3, 1e3]).T, strict=True))
    if m.position is not None:
        columns |= dict(zip("xyz", 1e3 * m.position.T, strict=True))
    if m.rotation is not None:
        turn = np.rad2deg(Rotation.from_matrix(m.rotation.copy()).as_rotvec())
        columns |= dict(zip(("rx", "ry", "rz"), turn.T, strict=True))
    if m.covariance is not None:
        size = np.repeat([180.0 / np.pi, 1e3], 3)
        upper = (m.covariance * np.outer(size, size))[:, *np.triu_indices(6)]
        columns |= dict(zip(COVARIANCE, upper.T, strict=True))
    write_csv(folder / "table.csv", columns)
    write_robot(folder / "robot.yaml", robot)
    (folder / "camera.yaml").write_text(yaml.safe_dump(INTRINSICS))
    given = {"robot": "robot.yaml", "measurements": "table.csv", "model": table.model}
    given |= {"units": {"length": "mm", "angle": "deg"}, "noise": {"position": 0.1, "distance": 0.1, "pixel": 0.1}}
    (folder / "job.yaml").write_text(yaml.safe_dump(given | job))
    return folder / "job.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("instrument", KEYS)
def test_a_job_is_what_python_makes_of_the_same_arrays(instrument, tmp_path):
    """Parameters within a hundredth of their sigma: what twelve digits in mm and degrees leave is far less."""
    robot, _, table = measured_by(instrument, np.random.default_rng(20))
    if instrument == "targets known":
        keep = {"t0": table.known["t0"]}
        table = type(table)(table.measurements, "position", frame="unknown", known=keep)
    if instrument == "anchors known":
        x, y, z = (1e3 * table.known["a0"].xyz).tolist()
        KEYS[instrument] = {"anchors": {"a0": {"x": x, "y": y, "z": z}}}
    path = write_files(tmp_path, robot, table, KEYS[instrument])
    found, expected = calibrate_job(path), calibrate(robot, [table])
    for name, parameter in expected.parameters.items():
        if parameter.sigma:
            assert abs(found.parameters[name].estimate - parameter.estimate) < 0.01 * parameter.sigma
            assert found.parameters[name].sigma == pytest.approx(parameter.sigma, rel=1e-3)
    assert [g.kind for g in found.result.groups] == [g.kind for g in expected.result.groups]


def test_every_form_of_a_known_point(tmp_path):
    robot, _, table = measured_by("anchors", np.random.default_rng(21))
    anchors = {"a0": {"x": 1, "y": 2, "z": 3}, "a1": {"x": 0, "y": 0, "z": 4, "tolerance": 50}}
    path = write_files(tmp_path, robot, table, {"anchors": anchors, "tolerance": {"anchors": 7}})
    known = read_job(path).tables[0].known
    assert known["a0"].xyz.tolist() == pytest.approx([1e-3, 2e-3, 3e-3])
    assert (known["a0"].tolerance, known["a1"].tolerance) == pytest.approx((7e-3, 50e-3))


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("top", "entry", "fixed"),
    [("camera.yaml", "fixed", True), (None, {"file": "camera.yaml", "fixed": True}, True), (None, INTRINSICS, False)],
)
def test_every_form_of_a_camera(top, entry, fixed, tmp_path):
    robot, _, table = measured_by("pixels", np.random.default_rng(22))
    one = {"table": "table.csv"} | ({} if entry is None else {"camera": entry})
    path = write_files(tmp_path, robot, table, {"measurements": [one]} | ({} if top is None else {"camera": top}))
    found = read_job(path).tables[0]
    assert (found.camera, found.fixed_camera) == (CAMERA, fixed)


def test_a_table_of_poses_takes_rotation_vectors(tmp_path):
    (tmp_path / "poses.csv").write_text("q1,q2,q3,q4,x,y,z,rx,ry,rz\n0,0,0,0,1,2,3,0.1,-0.2,0.3\n")
    found = read_measurements(tmp_path / "poses.csv", ROBOT).rotation
    assert found[0] == pytest.approx(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix())


def test_a_column_that_another_model_uses_means_nothing(tmp_path):
    (tmp_path / "poses.csv").write_text("q1,q2,q3,q4,x,y,z,anchor,distance,u\n0,0,0,0,1,2,3,,far,left\n")
    found = read_measurements(tmp_path / "poses.csv", ROBOT, model="position")
    assert found.labels == {}
    assert found.value("distance") is None


HEAD = "q1,q2,q3,q4"
CASES = [
    ("anchor", f"{HEAD},anchor,distance\n0,0,0,0,a,-1\n",
     "t.csv:2: distance: found '-1', expected a number not below 0"),
    ("anchor", f"{HEAD},anchor,distance,sigma_distance\n0,0,0,0,a,1,0\n",
     "t.csv:2: sigma_distance: found '0', expected a number above 0"),
    ("board", f"{HEAD},x,y,z,qx,qy,qz,qw,board\n0,0,0,0,1,2,3,0,0,0,1,\n",
     "t.csv:2: board: found an empty cell, expected the name of a board"),
    ("pixels", f"{HEAD},u,v,corner_x,corner_y,sigma_pixel,sigma_u\n0,0,0,0,1,2,3,4,1,1\n",
     "t.csv: no column sigma_v, expected sigma_u sigma_v together"),
    ("board", f"{HEAD},{','.join(COVARIANCE)}\n0,0,0,0,{','.join(['1'] * 21)}\n",
     "t.csv:2: cov_11: found '1', expected a covariance: eigenvalues above 0"),
]  # fmt: skip


@pytest.mark.parametrize(("model", "text", "message"), CASES)
def test_a_cell_that_cannot_be_used_is_named(model, text, message, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    assert refusal(read_measurements, tmp_path / "t.csv", ROBOT, model=model, noise=Noise(distance=1e-3)) == message


@pytest.mark.parametrize(("column", "word"), [("anchor", "NA"), ("plane", "nan"), ("station", "-"), ("target", "None")])
def test_a_word_for_nothing_is_no_name(column, word, tmp_path):
    """R writes NA where there is none, Python nan or None: an unknown of that name would take the row's error up."""
    (tmp_path / "t.csv").write_text(f"{HEAD},x,y,z,{column},distance\n0,0,0,0,1,2,3,{word},1\n")
    model = column if column in ("anchor", "plane") else "position"
    empty = ", or an empty cell" * (column != "station")
    error = refusal(read_measurements, tmp_path / "t.csv", ROBOT, model=model)
    article = "an" if column == "anchor" else "a"
    expected = f"the name of {article} {column}{empty}"
    assert error == f"t.csv:2: {column}: found {word!r}, expected {expected}"
