"""Instruments in scenario files: every key in any units, one message a mistake, and files that follow each other."""

import math

import numpy as np
import pytest
import yaml

from fg_calib import Noise, Pairing, read_scenario, simulate, write_simulation
from fg_calib.errors import InputError
from fg_calib.simulation.configurations import BoardViews, Placement, RandomReadings
from fg_calib.simulation.instruments import Sockets

ROBOT = """\
convention: mdh
joints:
  - {a: 0, alpha: 0, d: 0.5, theta: 0}
  - {a: 0.4, alpha: 1, d: 0.1, theta: 0}
  - {a: 0.3, alpha: 1, d: 0.1, theta: 0}
tool: {x: 0.2, z: 0.1}
tolerance: {a: 0.001, alpha: 0.002, d: 0.001, theta: 0.002}
"""
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
    (tmp_path / "camera.yaml").write_text("{fx: 900, fy: 905, cx: 640, cy: 480}\n")
    return tmp_path


def read(folder, *entries, rest=REST):
    (folder / "scenario.yaml").write_text(rest + "instruments:\n" + "".join(f"  - {e}\n" for e in entries))
    return read_scenario(folder / "scenario.yaml")


def one(folder, entry):
    (found,) = read(folder, entry).instruments
    return found


def test_figures_are_converted_and_instruments_named(folder):
    s = read(
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
    assert [i.name for i in s.instruments] == [
        *("position", "other", "position_2", "anchor", "plane", "distance-rotation", "distance", "distance_2")
    ]
    assert s.noise == Noise(1e-4, math.radians(0.02), (0.0,) * 3, 5e-5, math.radians(0.01), 1e-4, 0.3)
    assert s.job == {}
    assert tracker.stations == 2
    assert tracker.targets["ball"].xyz == pytest.approx([0.05, 0.0, 0.1])
    assert (tracker.targets["ball"].tolerance, tracker.targets["pin"].tolerance) == (2e-3, None)
    assert (other.targets, third.frame) == (3, "base")
    assert isinstance(other.frame, Placement)
    assert other.frame.position == pytest.approx([1.0, 0.0, 0.0])
    assert other.frame.rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert wire.anchors["bolt"].xyz == pytest.approx([0.8, 0.0, 0.0])
    assert (wire.offset, wire.noise) == (pytest.approx(0.12), Noise(distance=2e-5))
    assert table.planes["table"].normal.tolist() == [0, 0, 1]
    assert (table.planes["table"].distance, table.contact) == (pytest.approx(0.3), True)
    assert (direct.pairs, formed.pairing) == (Pairing("random", 9, 2), Pairing("chain"))
    assert isinstance(sockets, Sockets)
    assert sockets.sockets == 4


def test_cameras_boards_and_configurations_of_their_own_are_read(folder):
    eye = one(folder, "{model: pixels, camera: camera.yaml, " + CORNERS + ", boards: {wall: {x: 900, roll: 90}}, "
              "configurations: {board: {pose: {x: 900}, height: 300, radius: 200, count: 7}}}")  # fmt: skip
    assert (eye.camera.fy, eye.camera.k1, eye.fixed) == (905, 0.0, False)
    assert (eye.corners.columns, eye.corners.rows, eye.corners.square) == (8, 6, pytest.approx(0.03))
    assert np.ptp(eye.corners.points, axis=0) == pytest.approx([0.21, 0.15])
    assert eye.corners.points.mean(axis=0) == pytest.approx([0.0, 0.0])
    assert eye.boards["wall"].position == pytest.approx([0.9, 0.0, 0.0])
    assert isinstance(eye.configurations, BoardViews)
    assert eye.configurations.height == pytest.approx(0.3)
    room = one(folder, "{model: pixels, " + CAMERA[:-1] + ", fixed: true}, " + CORNERS + ", frame: {z: 2000}}")
    assert (room.fixed, room.camera.k1) == (True, -0.1)
    assert room.frame.position == pytest.approx([0.0, 0.0, 2.0])
    board = one(folder, "{model: board, configurations: {random: {count: 3}}, boards: {a: {x: 1}}}")
    assert board.configurations == RandomReadings(3)


def test_a_job_states_another_noise_and_other_keys(folder):
    rest = REST + "job: {loss: huber, noise: {distance: 0.2, joint: 0.01}}\n"
    s = read(folder, "{model: anchor, anchors: 2}", "{model: position}", rest=rest)
    (wire, tracker) = simulate(s).tables
    assert s.job == {"loss": "huber"}
    assert wire.measurements.sigma_length[0] == pytest.approx(2e-4)
    assert tracker.measurements.sigma_position[0, 0] == pytest.approx(1e-4)
    assert wire.measurements.sigma_joint == pytest.approx([math.radians(0.01)] * 3)
    assert simulate(s).true_readings.tolist() == wire.measurements.readings.tolist()  # the joints themselves are exact


S = "scenario.yaml: instruments"
MISTAKES = [
    ("{}", f"{S} 1: missing key 'model'"),
    ("7", f"{S} 1: found 7, expected a mapping"),
    ("{model: wire}", f"{S} 1: model: found 'wire', expected one of pose, position, orientation, distance, rotation, "
     "distance-rotation, anchor, plane, board, pixels"),
    ("{model: anchor, anchor: 3}", f"{S} 1: unknown key 'anchor', expected one of model, name, noise, configurations, "
     "targets, stations, frame, pairing, pairs, sockets, anchors, offset, planes, contact, boards, camera, corners; "
     "did you mean anchors?"),
    ("{model: anchor, planes: 3}", f"{S} 1: planes: with model anchor, expected one of model, name, noise, "
     "configurations, anchors, offset, contact"),
    ("{model: anchor, anchors: 0}", f"{S} 1: anchors: found 0, expected a whole number not below 1"),
    ("{model: anchor, anchors: {}}", f"{S} 1: anchors: found none, expected at least one"),
    ("{model: anchor, anchors: x}", f"{S} 1: anchors: count: found 'x', expected a whole number"),
    ("{model: anchor, anchors: {a: {x: 1, y: 2}}}", f"{S} 1: anchors: a: missing key 'z'"),
    ("{model: anchor, anchors: {' a': {x: 1, y: 2, z: 3}}}", f"{S} 1: anchors: found name ' a', expected a word"),
    ("{model: anchor, anchors: {a: {x: 1, y: 2, z: 3, tolerance: -1}}}",
     f"{S} 1: anchors: a: tolerance: found -1, expected a number not below 0"),
    ("{model: anchor, offset: 3, contact: true}",
     f"{S} 1: offset: with contact, expected none: there is no length"),
    ("{model: anchor, name: ../x}", f"{S} 1: name: found '../x', expected letters, digits, - and _: a file has it"),
    ("{model: anchor, noise: {distances: 1}}", f"{S} 1: noise: unknown key 'distances', expected one of position, "
     "orientation, distance, angle, point, pixel; did you mean distance?"),
    ("{model: anchor, noise: {joint: 1}}", f"{S} 1: noise: unknown key 'joint', expected one of position, "
     "orientation, distance, angle, point, pixel"),
    ("{model: anchor, noise: {distance: -1}}", f"{S} 1: noise: distance: found -1, expected a number not below 0"),
    ("{model: anchor, configurations: {}}",
     f"{S} 1: configurations: found none, expected one of board, tracker, random, table"),
    ("{model: plane, planes: {a: {normal: [0, 0, 0], distance: 1}}}",
     f"{S} 1: planes: a: normal: found 0, 0, 0, expected a direction"),
    ("{model: orientation, targets: 2}", f"{S} 1: targets: with model orientation, expected model position or pose"),
    ("{model: position, stations: 0}", f"{S} 1: stations: found 0, expected a whole number above 0"),
    ("{model: position, stations: 2, frame: base}", f"{S} 1: stations: 2 with frame base, expected 1"),
    ("{model: position, frame: room}",
     f"{S} 1: frame: found 'room', expected base, unknown, or a mapping of x, y, z, roll, pitch, yaw"),
    ("{model: distance, pairs: some}",
     f"{S} 1: pairs: found 'some', expected one of star, chain, all, {{random: N, seed: S}}"),
    ("{model: rotation, sockets: 2}", f"{S} 1: model: found 'rotation', expected one of distance"),
    ("{model: pixels}", f"{S} 1: camera: found none with model pixels, expected it with model pixels"),
    ("{model: board, " + CORNERS + "}", f"{S} 1: corners: found one with model board, expected it with model pixels"),
    ("{model: pixels, camera: {fx: 1}, " + CORNERS + "}", f"{S} 1: camera: missing keys 'fy', 'cx', 'cy'"),
    ("{model: pixels, " + CAMERA + ", corners: {columns: 0, rows: 1, square: 1}}",
     f"{S} 1: corners: columns: found 0, expected a number above 0"),
    ("{model: pixels, " + CAMERA + ", " + CORNERS + ", frame: {x: 1}}",
     f"{S} 1: frame: without a fixed camera, expected none: the camera is the tool"),
    ("{model: pixels, " + CAMERA[:-1] + ", fixed: true}, " + CORNERS + ", frame: unknown}",
     f"{S} 1: frame: found 'unknown', expected a mapping of x, y, z, roll, pitch, yaw"),
    ("{model: pixels, " + CAMERA[:-1] + ", fixed: true}, " + CORNERS + ", boards: {a: {x: 1}}}",
     f"{S} 1: boards with a fixed camera, expected model pixels, and the board on the tool"),
]  # fmt: skip


@pytest.mark.parametrize(("entry", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(folder, entry, message):
    with pytest.raises(InputError) as caught:
        read(folder, entry)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("instruments: 3\n", f"{S}: found 3, expected a list of instruments, each with its model"),
        ("instruments: []\n", f"{S}: found [], expected a list of instruments, each with its model"),
        ("instruments: [{model: anchor, name: a}, {model: plane, name: A}]\n",
         f"{S} 2: name: A is there already, expected another one"),
        ("instruments: [{model: anchor, name: a_pairs}, {model: plane, name: a}]\n",
         f"{S} 2: name: a is there already, expected another one"),
        ("instruments: [{model: anchor}]\njob: {model: anchor}\n",
         "scenario.yaml: job: found key 'model', expected none; each instrument has its own"),
        ("instruments: [{model: anchor}]\njob: {noise: {distance: 0}}\n",
         "scenario.yaml: job: noise: distance: found 0, expected a number above 0"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_list_is_named(folder, change, message):
    (folder / "scenario.yaml").write_text(REST + change)
    with pytest.raises(InputError) as caught:
        read_scenario(folder / "scenario.yaml")
    assert str(caught.value) == message


@pytest.mark.slow
def test_the_command_says_what_each_table_has_and_writes_the_truth(fg_calib, folder):
    tracker = "{model: position, name: tracker, targets: {ball: {x: 50, y: 0, z: 100}}}"
    wire = "{model: anchor, name: wire, anchors: {bolt: {x: 800, y: 0, z: 0, tolerance: 0}}, offset: 120}"
    read(folder, tracker, wire, rest=REST + "validation: {random: {count: 4}}\n")
    ended = fg_calib("simulate", folder / "scenario.yaml", "--out", folder / "job", "--seed", 2)
    assert ended.code == 0
    assert ended.out == (
        "scenario, seed 2: 20 configurations to calibrate, 4 to test\n"
        "tracker.csv: model position, 20 rows to calibrate, 4 to test\n"
        "wire.csv: model anchor, 20 rows to calibrate, 4 to test\n"
    )
    truth = yaml.safe_load((folder / "job" / "truth.yaml").read_text())
    assert truth["units"] == {"length": "mm", "angle": "deg"}
    assert truth["targets"] == {"ball": {"x": 50.0, "y": 0.0, "z": 100.0}}
    assert (truth["anchors"], truth["offsets"]) == ({"bolt": {"x": 800.0, "y": 0.0, "z": 0.0}}, {"wire": 120.0})
    assert set(truth["frames"]["tracker"]) == {"x", "y", "z", "roll", "pitch", "yaw"}
    job = yaml.safe_load((folder / "job" / "calibration.yaml").read_text())
    assert [entry["table"] for entry in job["measurements"]] == ["tracker.csv", "wire.csv"]
    assert job["anchors"] == {"bolt": {"x": 800.0, "y": 0.0, "z": 0.0}}
    ended = fg_calib("calibrate", folder / "job" / "calibration.yaml", "--out", folder / "result")
    assert ended.code == 0
    as_json = fg_calib("simulate", folder / "scenario.yaml", "--out", folder / "job", "--json")
    assert '"table": "wire.csv"' in as_json.out


def test_tables_of_an_earlier_simulation_go_and_those_of_others_stay(folder):
    """The folder is filled again by a scenario with other instruments, then by one without."""
    first = simulate(read(folder, "{model: distance, name: sockets, sockets: 2}", "{model: plane}"))
    second, plain = simulate(read(folder, "{model: anchor, name: wire}")), simulate(plain_scenario(folder))
    out = folder / "job"
    assert set(write_simulation(out, first)) == {
        *("calibration.yaml", "plane.csv", "robot_nominal.yaml", "robot_true.yaml", "sockets.csv"),
        *("sockets_pairs.csv", "truth.yaml"),
    }
    (out / "mine.csv").write_text("a\n")
    for simulation in (second, plain, first):
        names = write_simulation(out, simulation)
        assert {file.name for file in out.iterdir()} == {*names, "mine.csv"}
    stranger = folder / "stranger"
    stranger.mkdir()
    (stranger / "wire.csv").write_text("a\n")
    with pytest.raises(InputError, match=r"wire.csv: is there already, not written by this command"):
        write_simulation(stranger, second)
    assert [file.name for file in stranger.iterdir()] == ["wire.csv"]


def plain_scenario(folder):
    (folder / "plain.yaml").write_text(REST.replace(", distance: 0.05, angle: 0.01, point: 0.1, pixel: 0.3", ""))
    return read_scenario(folder / "plain.yaml")
