"""Scenario files: every field in the units of the file, defaults, and one message a mistake."""

import math

import numpy as np
import pytest
import yaml
from refusals import refusal
from simulated import paper_robot
from tolerances import rounding

from fg_calib import Noise, Pairing, simulate
from fg_calib.simulation import RandomReadings, Spot, read_scenario, write_simulation

ROBOT = """\
convention: mdh
joints:
  - {a: 0, alpha: 0, d: 0.5, theta: 0, limits: [-2, 2]}
  - {a: 0.4, alpha: 0, d: 0, theta: 0, type: prismatic}
fixed: [a1]
tolerance: {a: 0.01, alpha: 0.02, d: 0.03, theta: 0.04}
"""
ERRORS = "errors: {uniform: {a: 0.01}}\n"
RANDOM = "configurations: {random: {count: 3}}\n"
NOISE = "noise: {position: 0.001, orientation: 0.002}\n"
SHORT = "robot: robot.yaml\n" + ERRORS + RANDOM + NOISE
REST = """\
robot: robot.yaml
errors: {normal: tolerance}
configurations: {random: {count: 20}}
noise: {position: 0.1, orientation: 0.02, distance: 0.05, angle: 0.01, point: 0.1, pixel: 0.3}
units: {length: mm, angle: deg}
"""
CAMERA = "camera: {fx: 900, fy: 905, cx: 640, cy: 480, k1: -0.1}"
CORNERS = "corners: {columns: 8, rows: 6, square: 30}"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.yaml").write_text(ROBOT)
    (tmp_path / "table.csv").write_text("q1,q2,split\n10,1,test\n20,2,train\n")
    (tmp_path / "camera.yaml").write_text("{fx: 900, fy: 905, cx: 640, cy: 480}\n")
    return tmp_path


def read(folder, text):
    (folder / "scenario.yaml").write_text(text)
    return read_scenario(folder / "scenario.yaml")


def read_instruments(folder, *entries):
    return read(folder, REST + "instruments:\n" + "".join(f"  - {e}\n" for e in entries))


def test_the_shipped_scenario_is_the_papers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "space-robot").mkdir()  # a folder of that name, such as the last simulation, is not in the way
    s = read_scenario("space-robot")
    assert s.robot.nominal == pytest.approx(paper_robot().nominal)
    assert sum(p.estimated for p in s.robot.parameters) == 30
    bound = {"m": 0.01, "rad": math.radians(0.05)}  # Table 6
    for p in s.robot.parameters:
        if 1 <= p.owner <= 7:
            assert p.tolerance == pytest.approx(bound[p.unit] / math.sqrt(3), rel=rounding(1, 10))
            assert s.errors.values[p.name] == pytest.approx(bound[p.unit])
    assert s.errors.law == "uniform"
    board = s.configurations
    assert (board.height, board.radius, board.count, board.distance) == (0.5, 0.5, 51, None)
    assert (s.noise.position, s.noise.orientation) == pytest.approx((1e-3, math.radians(0.01)))
    assert s.noise.joint == pytest.approx([math.radians(0.005)] * 7)
    assert (s.validation, s.frame, s.source, s.angle_unit) == (RandomReadings(500), "unknown", "space-robot", "deg")
    assert s.job == {"model": "distance-rotation", "pairing": "star"}


@pytest.mark.parametrize(
    ("law", "given", "expected"),
    [("uniform", "{a: 10, alpha: 2, a2: 5}", {"a1": 0.01, "a2": 0.005, "alpha1": 2, "alpha2": 2}),
     ("normal", "{d: 10, tool.yaw: 3, tool.x: 4}", {"d1": 0.01, "d2": 0.01, "tool.x": 0.004, "tool.yaw": 3})],
)  # fmt: skip
def test_errors_are_converted_and_shared_out_by_kind(folder, law, given, expected):
    """Lengths in mm and angles in degrees here; a name goes before its kind."""
    text = SHORT.replace("{uniform: {a: 0.01}}", f"{{{law}: {given}}}")
    errors = read(folder, text + "units: {length: mm, angle: deg}\n").errors
    assert errors.law == law
    in_si = {name: math.radians(v) if name in ("alpha1", "alpha2", "tool.yaw") else v for name, v in expected.items()}
    assert errors.values == pytest.approx(in_si)


def test_a_job_may_state_another_noise_than_the_true_one(folder):
    s = read(
        folder,
        SHORT + "units: {length: mm, angle: deg}\n"
        "job: {model: pose, gauge: keep, prefer: [d2], noise: {orientation: 0.5, joint: [1, 2]}}\n",
    )
    assert s.job == {"model": "pose", "gauge": "keep", "prefer": ["d2"]}
    assert s.noise == Noise(1e-6, math.radians(0.002), (0.0, 0.0))
    assert s.specified_noise == Noise(None, math.radians(0.5), (math.radians(1), 2e-3))


def test_a_tracker_has_every_value_in_the_units_of_the_file(folder):
    text = """configurations:
  tracker: {station: {x: 3000, z: 1500}, target: {y: 50}, axis: [0, 1, 0], acceptance: 40, distance: [1000, 8000],
            region: {lower: [0, -500, 0], upper: [1000, 500, 2000]}, count: 7}
  keep_out: [{lower: [-1000, -1000, -1000], upper: [1000, 1000, 0]}, {below: -500}, {box: [[0, 0, 0], [1, 1, 1]]}]
"""
    s = read(folder, "units: {length: mm, angle: deg}\n" + SHORT.replace(RANDOM, text))
    t = s.configurations
    assert (t.station.tolist(), t.target.tolist(), t.axis.tolist()) == ([3, 0, 1.5], [0, 0.05, 0], [0, 1, 0])
    assert (t.acceptance, t.distance, t.count) == (pytest.approx(math.radians(40)), (1, 8), 7)
    assert (t.region.lower.tolist(), t.region.upper.tolist()) == ([0, -0.5, 0], [1, 0.5, 2])
    boxes = [(box.lower.tolist(), box.upper.tolist()) for box in t.keep_out]
    assert boxes == [([-1, -1, -1], [1, 1, 0]), ([-1e6] * 3, [1e6, 1e6, -0.5]), ([0, 0, 0], [1e-3] * 3)]


def test_values_are_converted_and_instruments_named(folder):
    s = read_instruments(
        folder,
        "{model: position, stations: 2, targets: {ball: {x: 50, y: 0, z: 100, tolerance: 2}, pin: {x: 1, y: 2, z: 3}}}",
        "{model: position, name: other, targets: 3, frame: {x: 1000, yaw: 90}}",
        "{model: position, frame: base}",
        "{model: anchor, anchors: {bolt: {x: 800, y: 0, z: 0}}, offset: 120, noise: {distance: 0.02}}",
        "{model: plane, planes: {table: {normal: [0, 0, 2], distance: 300}}, contact: true}",
        "{model: distance-rotation, pairs: {random: 9, seed: 2}}",
        "{model: distance, pairing: chain}",
        "{model: distance, sockets: 4}",
    )
    tracker, other, third, wire, table, direct, formed, sockets = s.instruments
    names = "position other position_2 anchor plane distance-rotation distance distance_2"
    assert " ".join(i.name for i in s.instruments) == names
    assert s.noise == Noise(1e-4, math.radians(0.02), (0.0, 0.0), 5e-5, math.radians(0.01), 1e-4, 0.3)
    assert (s.job, tracker.stations, other.targets, third.frame, sockets.sockets) == ({}, 2, 3, "base", 4)
    assert tracker.targets["ball"].xyz == pytest.approx([0.05, 0.0, 0.1])
    assert (tracker.targets["ball"].tolerance, tracker.targets["pin"].tolerance) == (2e-3, None)
    assert other.frame.position == pytest.approx([1.0, 0.0, 0.0])
    assert wire.anchors["bolt"].xyz == pytest.approx([0.8, 0.0, 0.0])
    assert (wire.offset, wire.noise) == (pytest.approx(0.12), Noise(distance=2e-5, joint=(0.0, 0.0)))
    assert table.planes["table"].normal.tolist() == [0, 0, 1]
    assert (table.planes["table"].distance, table.contact) == (pytest.approx(0.3), True)
    assert (direct.pairs, formed.pairing) == (Pairing("random", 9, 2), Pairing("chain"))


def test_cameras_boards_and_configurations_of_their_own_are_read(folder):
    (eye, room) = read_instruments(
        folder,
        "{model: pixels, camera: camera.yaml, " + CORNERS + ", boards: {wall: {x: 900}}, "
        "configurations: {board: {pose: {x: 900, yaw: 90}, height: 300, count: 7, roll: 30}}}",
        "{model: pixels, " + CAMERA[:-1] + ", fixed: true}, " + CORNERS + ", frame: {z: 2000}}",
    ).instruments
    assert (eye.camera.fy, eye.camera.k1, eye.fixed) == (905, 0.0, False)
    assert (len(eye.corners), *np.ptp(eye.corners, axis=0)) == pytest.approx((48, 0.21, 0.15))
    assert eye.corners.mean(axis=0) == pytest.approx([0.0, 0.0])
    assert eye.boards["wall"].position == pytest.approx([0.9, 0.0, 0.0])
    views = eye.configurations
    assert views.board.rotation == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), abs=rounding(1.0))
    assert (views.height, views.radius, views.count, views.roll) == pytest.approx((0.3, 0.5, 7, math.pi / 6))
    assert (room.fixed, room.camera.k1) == (True, -0.1)
    assert room.frame.position == pytest.approx([0.0, 0.0, 2.0])


def replaced(old, new):
    return SHORT.replace(old, new)


def with_instrument(entry):
    return REST + f"instruments:\n  - {entry}\n"


IN = "instrument 1: "
FOLLOWS = "expected none; it follows from the scenario or its instruments"
MISTAKES = [
    ("robot: robot.yaml\n", "missing keys 'configurations', 'noise'"),
    (replaced("{uniform: {a: 0.01}}", "{uniform: {a: 1}, values: {a: 1}}"),
     "errors: found uniform and values, expected one of uniform, normal, values"),
    (replaced("{random: {count: 3}}", "{board: {pose: {x: 1}, distance: [2, 1]}}"),
     "configurations: board: distance: found [2.0, 1.0], expected the smaller one first"),
    (replaced("{random: {count: 3}}", "{}"),
     "configurations: found none, expected one of board, tracker, random, table"),
    (SHORT + "job: {frame: known}\n", f"job: found key 'frame', {FOLLOWS}"),
    (with_instrument("{model: anchor, targets: 3}"),
     f"{IN}targets: with model anchor, expected model pose or position"),
    (with_instrument("{model: anchor, anchors: {a: {x: 1, w: 2}}}"),
     f"{IN}anchors: a: xyz: unknown key 'w', expected one of x, y, z"),
    (with_instrument("{model: position, stations: 2, frame: base}"), f"{IN}stations: 2 with frame base, expected 1"),
    (with_instrument("{model: pixels}"), f"{IN}camera: found none with model pixels, expected it with model pixels"),
    (with_instrument("{model: anchor, name: a}\n  - {model: plane, name: A}"),
     "instrument 2: name: A is there already, expected another one"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(folder, text, message):
    assert refusal(read, folder, text) == f"scenario.yaml: {message}"


def test_the_truth_is_written_in_the_units_of_the_scenario(folder):
    tracker = "{model: position, name: tracker, targets: {ball: {x: 50, y: 0, z: 100}}}"
    wire = "{model: anchor, name: wire, anchors: {bolt: {x: 800, y: 0, z: 0, tolerance: 0}}, offset: 120}"
    simulation = simulate(read_instruments(folder, tracker, wire), 2)
    counts = {"n_train": 20, "n_test": 0}
    tables = [{"table": "tracker.csv", "model": "position"} | counts, {"table": "wire.csv", "model": "anchor"} | counts]
    assert simulation.summary()["tables"] == tables
    write_simulation(folder / "job", simulation)
    truth = yaml.safe_load((folder / "job" / "truth.yaml").read_text())
    assert truth["units"] == {"length": "mm", "angle": "deg"}
    assert (truth["anchors"], truth["offsets"]) == ({"bolt": {"x": 800.0, "y": 0.0, "z": 0.0}}, {"wire": 120.0})
    assert set(truth["frames"]["tracker"]) == {"x", "y", "z", "roll", "pitch", "yaw"}


@pytest.mark.parametrize("changed", [".csv", "robot_nominal.yaml"])
def test_another_simulation_is_replaced_and_another_job_is_not(folder, changed):
    simulation = simulate(read(folder, REST))
    names = write_simulation(folder / "job", simulation)
    assert write_simulation(folder / "job", simulation) == names
    file = next(folder / "job" / name for name in names if name.endswith(changed))
    file.write_text(file.read_text() + "# filled in")
    assert "changed since they were simulated" in refusal(write_simulation, folder / "job", simulation)
    (folder / "job" / "calibration.yaml").write_text("robot: mine.yaml\n")
    assert "is there already" in refusal(write_simulation, folder / "job", simulation)


def test_types_refuse_from_python_what_they_refuse_from_a_file():
    assert refusal(RandomReadings, 0) == "RandomReadings: count: found 0, expected a number above 0"
    assert refusal(Spot, [0.0, np.nan, 0.0]) == "Spot: xyz: row 1: found nan, expected a finite number"
