"""Scenario files: the shipped one, every way to say a thing, units, and one message a mistake."""

import importlib.resources
import math
import re

import numpy as np
import pytest
from simulated import paper_robot
from tolerances import rounding

from fg_calib.designs.design import design
from fg_calib.errors import InputError
from fg_calib.io.robot_file import read_robot
from fg_calib.measurements.dataset import Noise
from fg_calib.simulation.configurations import BoardViews, GivenReadings, Placement, RandomReadings, TargetViews
from fg_calib.simulation.scenario import Errors
from fg_calib.simulation.scenario_file import SCENARIOS, read_scenario
from fg_calib.simulation.simulator import simulate

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
BOARD = "configurations: {board: {pose: {x: 1, z: 2}, count: 5"
SHORT = "robot: robot.yaml\n" + ERRORS + RANDOM + NOISE


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.yaml").write_text(ROBOT)
    (tmp_path / "table.csv").write_text("q1,q2,split\n10,1,test\n20,2,train\n")
    return tmp_path


def read(folder, text):
    (folder / "scenario.yaml").write_text(text)
    return read_scenario(folder / "scenario.yaml")


def test_the_shipped_scenario_is_the_papers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "space-robot").mkdir()  # a folder of that name, such as the last simulation, is not in the way
    s = read_scenario("space-robot")
    paper = paper_robot()
    assert s.robot.nominal == pytest.approx(paper.nominal)
    assert [p.name for p in s.robot.parameters if not p.estimated and p.owner == 1] == [
        *("a1", "alpha1", "d1", "theta1", "beta1")
    ]
    assert sum(p.estimated for p in s.robot.parameters) == 30
    assert s.robot.limits == pytest.approx(np.tile([-math.pi, math.pi], (7, 1)))
    bound = {"m": 0.01, "rad": math.radians(0.05)}  # Table 6
    for p in s.robot.parameters:
        if 1 <= p.owner <= 7:
            assert p.tolerance == pytest.approx(bound[p.unit] / math.sqrt(3), rel=rounding(1, 10))
            assert s.errors.figures[p.name] == pytest.approx(bound[p.unit])
    assert s.errors.law == "uniform"
    board = s.configurations
    assert (board.height, board.radius, board.count, board.distance) == (0.5, 0.5, 51, None)
    assert (board.roll, board.self_motion, board.posture) == (None, "random", None)
    assert board.board.position.tolist() == [0, 6.5, 2.55]
    assert board.board.rotation.tolist() == np.eye(3).tolist()
    assert (s.noise.position, s.noise.orientation) == pytest.approx((1e-3, math.radians(0.01)))
    assert s.noise.joint == pytest.approx([math.radians(0.005)] * 7)
    assert s.validation == RandomReadings(500)
    assert (s.frame, s.job) == ("unknown", {"model": "distance-rotation", "pairing": "star"})
    assert (s.name, s.source) == ("space-robot", "space-robot")
    assert (s.length_unit, s.angle_unit) == ("m", "deg")


def test_the_shipped_files_come_with_the_installed_package():
    shipped = importlib.resources.files("fg_calib") / "scenarios" / "space-robot"
    assert (shipped / "scenario.yaml").read_text(encoding="utf-8").startswith("# The simulation of section 5")
    assert (shipped / "robot.yaml").is_file()
    assert [folder.name for folder in SCENARIOS.iterdir()] == ["space-robot"]


def test_a_short_scenario_has_the_defaults(folder):
    s = read(folder, SHORT)
    assert s.robot.name == "robot"
    assert s.errors == Errors("uniform", {"a1": 0.01, "a2": 0.01})
    assert s.configurations == RandomReadings(3)
    assert s.noise == Noise(1e-3, 2e-3, (0.0, 0.0))
    assert (s.frame, s.validation, s.stated_noise) == ("unknown", None, None)
    assert s.job == {"model": "distance-rotation"}
    assert (s.name, s.source, s.length_unit, s.angle_unit) == ("scenario", "scenario.yaml", "m", "rad")
    assert read(folder, SHORT + "name: mine\n").name == "mine"


def test_a_robot_may_stand_in_the_scenario(folder):
    robot = "robot: {convention: dh, joints: [{a: 1, alpha: 0, d: 0, theta: 0}]}\n"
    assert read(folder, robot + ERRORS + RANDOM + NOISE).robot.nominal[6] == 0.0
    assert read(folder, robot + ERRORS + RANDOM + NOISE).robot.convention == "dh"


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ("{uniform: {a: 10, alpha: 2, a2: 5}}", Errors("uniform", {"a1": 0.01, "a2": 0.005, "alpha1": 2, "alpha2": 2})),
        ("{uniform: {}}", Errors("uniform", {})),
        ("{normal: {d: 10, tool.yaw: 3, tool.x: 4}}",
         Errors("normal", {"d1": 0.01, "d2": 0.01, "tool.x": 0.004, "tool.yaw": 3})),
        ("{values: {a2: -3, theta1: -1}}", Errors("values", {"a2": -0.003, "theta1": -1})),
    ],
)  # fmt: skip
def test_errors_are_converted_and_shared_out_by_kind(folder, errors, expected):
    """Lengths in mm and angles in degrees here; a name goes before its kind."""
    s = read(folder, SHORT.replace(ERRORS, f"errors: {errors}\n") + "units: {length: mm, angle: deg}\n")
    angles = {"alpha1", "alpha2", "theta1", "tool.yaw"}
    figures = {name: math.radians(f) if name in angles else f for name, f in expected.figures.items()}
    assert s.errors.law == expected.law
    assert s.errors.figures == pytest.approx(figures)


def test_normal_errors_may_be_those_of_the_tolerances(folder):
    s = read(folder, SHORT.replace(ERRORS, "errors: {normal: tolerance}\n") + "units: {length: mm}\n")
    assert s.errors.law == "normal"
    assert s.errors.figures == {
        **{"a1": 0.01, "alpha1": 0.02, "d1": 0.03, "theta1": 0.04},
        **{"a2": 0.01, "alpha2": 0.02, "d2": 0.03, "theta2": 0.04},
    }


def test_a_board_is_converted_to_si(folder):
    views = read(
        folder,
        SHORT.replace(RANDOM, BOARD.replace("z: 2", "z: 2, yaw: 90") + ", height: 300, radius: 200, roll: 30, "
        "self_motion: held, posture: [20, 100]}}\n") + "units: {length: mm, angle: deg}\n",
    ).configurations  # fmt: skip
    assert views.board.position == pytest.approx([1e-3, 0, 2e-3])
    assert views.board.rotation == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), abs=rounding(1.0))
    assert (views.height, views.radius, views.count) == pytest.approx((0.3, 0.2, 5))
    assert views.roll == pytest.approx(math.radians(30))
    assert views.self_motion == "held"
    assert views.posture == pytest.approx((math.radians(20), 0.1))  # the second joint slides


def test_a_board_has_defaults_in_any_units(folder):
    views = read(folder, SHORT.replace(RANDOM, BOARD + "}}\n") + "units: {length: mm, angle: deg}\n").configurations
    assert isinstance(views, BoardViews)
    assert (views.height, views.radius, views.distance, views.cone) == (0.5, 0.5, None, math.pi / 3)
    assert (views.roll, views.self_motion, views.posture) == (None, "random", None)


def test_a_range_of_distances_is_converted(folder):
    views = read(
        folder,
        SHORT.replace(RANDOM, BOARD + ", distance: [300, 2000], cone: 90}}\n") + "units: {length: mm, angle: deg}\n",
    ).configurations
    assert views.distance == pytest.approx((0.3, 2.0))
    assert views.cone == pytest.approx(math.pi / 2)


def test_a_table_gives_its_readings(folder):
    s = read(folder, SHORT.replace(RANDOM, "configurations: {table: table.csv}\n") + "units: {angle: deg}\n"
             "validation: {table: table.csv}\n")  # fmt: skip
    for given in (s.configurations, s.validation):
        assert isinstance(given, GivenReadings)
        assert given.readings == pytest.approx(np.array([[math.radians(10), 1], [math.radians(20), 2]]))


def test_frames_are_the_base_unknown_or_given(folder):
    assert read(folder, SHORT + "frame: base\n").frame == "base"
    assert read(folder, SHORT + "frame: unknown\n").frame == "unknown"
    given = read(folder, SHORT + "frame: {x: 1000, roll: 90}\nunits: {length: mm, angle: deg}\n").frame
    assert isinstance(given, Placement)
    assert given.position.tolist() == [1, 0, 0]
    assert given.rotation @ [0, 1, 0] == pytest.approx([0, 0, 1])


def test_a_job_may_state_another_noise_than_the_true_one(folder):
    s = read(
        folder,
        SHORT + "units: {length: mm, angle: deg}\n"
        "job: {model: pose, gauge: keep, prefer: [d2], noise: {orientation: 0.5, joint: [1, 2]}}\n",
    )
    assert s.job == {"model": "pose", "gauge": "keep", "prefer": ["d2"]}
    assert (s.noise.position, s.noise.joint) == (1e-6, (0.0, 0.0))
    assert s.noise.orientation == pytest.approx(math.radians(0.002))
    assert s.stated_noise.position == 1e-6
    assert s.stated_noise.orientation == pytest.approx(math.radians(0.5))
    assert s.stated_noise.joint == pytest.approx((math.radians(1), 2e-3))


def test_a_tracker_has_every_figure_in_the_units_of_the_file(folder):
    text = """
configurations:
  tracker:
    station: {x: 3000, z: 1500}
    target: {y: 50}
    axis: [0, 1, 0]
    acceptance: 40
    distance: [1000, 8000]
    region: {lower: [0, -500, 0], upper: [1000, 500, 2000]}
    count: 7
  keep_out: [{lower: [-1000, -1000, -1000], upper: [1000, 1000, 0]}]
  apart: 5
validation: {tracker: {station: {x: 3000}, count: 8}}
"""
    s = read(folder, "units: {length: mm, angle: deg}\n" + SHORT.replace(RANDOM, text))
    t = s.configurations
    assert isinstance(t, TargetViews)
    assert (t.station.tolist(), t.target.tolist(), t.axis.tolist()) == ([3, 0, 1.5], [0, 0.05, 0], [0, 1, 0])
    assert (t.acceptance, t.distance, t.count) == (pytest.approx(math.radians(40)), (1, 8), 7)
    assert (t.region.lower.tolist(), t.region.upper.tolist()) == ([0, -0.5, 0], [1, 0.5, 2])
    assert [(box.lower.tolist(), box.upper.tolist()) for box in t.keep_out] == [([-1, -1, -1], [1, 1, 0])]
    assert t.apart == pytest.approx(math.radians(5))
    t = s.validation
    assert (t.target.tolist(), t.axis.tolist(), t.acceptance) == ([0, 0, 0], [0, 0, 1], math.pi / 6)
    assert (t.distance, t.region, t.keep_out, t.apart, t.count) == ((0.0, math.inf), None, (), None, 8)


def test_a_board_may_be_anywhere_in_a_field_of_view(folder):
    more = "field_of_view: 20, board_size: [400, 300]"
    views = read(folder, "units: {length: mm, angle: deg}\n" + with_board(more)).configurations
    assert views.field_of_view == pytest.approx(math.radians(20))
    assert views.board_size == pytest.approx((0.4, 0.3))
    views = read(folder, with_board("roll: 0")).configurations
    assert (views.field_of_view, views.board_size) == (0.0, None)


KEYS = "one of name, robot, units, errors, configurations, noise, frame, validation, job, instruments"
KINDS = "one of a, alpha, base, d, theta, tool"
S = "scenario.yaml: "


def with_errors(errors):
    return SHORT.replace(ERRORS, f"errors: {errors}\n")


def with_board(more):
    return SHORT.replace(RANDOM, f"{BOARD}, {more}}}}}\n")


def with_tracker(more):
    return SHORT.replace(RANDOM, f"configurations: {{tracker: {{station: {{x: 3}}, count: 5, {more}}}}}\n")


def with_conditions(more):
    return SHORT.replace(RANDOM, f"configurations: {{random: {{count: 3}}, {more}}}\n")


MISTAKES = [
    ("", S + "an empty file, expected a mapping, key: value"),
    ("robot: robot.yaml\n", S + "missing keys 'configurations', 'noise'"),
    (SHORT + "eror: 1\n", S + f"unknown key 'eror', expected {KEYS}; did you mean errors?"),
    (SHORT.replace("robot.yaml", "[]"), S + "robot: found [], expected a path, or the mapping of a robot file"),
    (with_errors("{}"), S + "errors: found none, expected one of uniform, normal, values"),
    (with_errors("{uniform: {a: 1}, values: {a: 1}}"),
     S + "errors: found uniform and values, expected one of uniform, normal, values"),
    (with_errors("{uniform: {a: -1}}"), S + "errors: uniform: a: found -1, expected a number not below 0"),
    (with_errors("{uniform: {a: .inf}}"), S + "errors: uniform: a: found inf, expected a finite number"),
    (with_errors("{uniform: 1}"), S + "errors: uniform: found 1, expected a mapping"),
    (with_errors("{uniform: {a9: 1}}"), S + f"errors: uniform: unknown parameter or kind 'a9', expected {KINDS}"),
    (with_errors("{normal: {beta: 1}}"), S + f"errors: normal: unknown parameter or kind 'beta', expected {KINDS}"),
    (with_errors("{normal: {a: x}}"), S + "errors: normal: a: found 'x', expected a finite number"),
    (with_errors("{normal: tolerances}"),
     S + "errors: normal: found 'tolerances', expected tolerance, or figures by kind or by parameter name"),
    (with_errors("{values: {b2: 1}}"), S + f"errors: values: unknown parameter or kind 'b2', expected {KINDS}"),
    (SHORT.replace("{random: {count: 3}}", "{}"),
     S + "configurations: found none, expected one of board, tracker, random, table"),
    (SHORT.replace("{count: 3}}", "{count: 3}, table: t.csv}"),
     S + "configurations: found random and table, expected one of board, tracker, random, table"),
    (SHORT.replace("count: 3", "count: -3"),
     S + "configurations: random: count: found -3, expected a number not below 0"),
    (SHORT.replace("count: 3", "count: 0"), S + "configurations: random: count: found 0, expected a number above 0"),
    (SHORT.replace("count: 3", "count: 2.5"), S + "configurations: random: count: found 2.5, expected a whole number"),
    (SHORT.replace("count: 3", "n: 3"), S + "configurations: random: unknown key 'n', expected one of count"),
    (SHORT + "validation: {}\n", S + "validation: found none, expected one of board, tracker, random, table"),
    (SHORT + "validation: none\n", S + "validation: found 'none', expected a mapping"),
    (SHORT.replace(RANDOM, "configurations: {board: {pose: {}}}\n"),
     S + "configurations: board: missing key 'count'"),
    (SHORT.replace(RANDOM, "configurations: {board: {pose: {q: 1}, count: 1}}\n"),
     S + "configurations: board: pose: unknown key 'q', expected one of x, y, z, roll, pitch, yaw"),
    (with_board("radius: 0"), S + "configurations: board: radius: found 0, expected a number above 0"),
    (with_board("height: -1"), S + "configurations: board: height: found -1, expected a number above 0"),
    (with_board("radius: 1, distance: [1, 2]"),
     S + "configurations: board: radius: found 1.0, expected none beside distance"),
    (with_board("distance: [2, 1]"),
     S + "configurations: board: distance: found [2.0, 1.0], expected the smaller one first"),
    (with_board("distance: [0, 1]"), S + "configurations: board: distance 1: found 0, expected a number above 0"),
    (with_board("distance: [1]"), S + "configurations: board: distance: found [1], expected at least 2 in the list"),
    (with_board("cone: 1"), S + "configurations: board: cone: found 1.0, expected none without distance"),
    (with_board("distance: [1, 2], cone: 1.6"),
     S + "configurations: board: cone: found 1.6, expected at most a quarter turn"),
    (with_board("roll: free"), S + "configurations: board: roll: found 'free', expected random, or an angle"),
    (with_board("roll: []"), S + "configurations: board: roll: found [], expected a finite number"),
    (with_board("self_motion: free"),
     S + "configurations: board: self_motion: found 'free', expected one of random, held"),
    (with_board("posture: [0, 0]"),
     S + "configurations: board: posture: found [0.0, 0.0], expected none unless self_motion is held"),
    (with_board("self_motion: held, posture: [0]"),
     S + "configurations: board: posture: 1 figures, expected 2, one a joint"),
    (with_board("self_motion: held, posture: [3, 0]"),
     S + "configurations: board: posture 1: found 3.0, expected within [-2, 2]"),
    (with_board("field_of_view: 1.6"), S + "configurations: board: field_of_view: found 1.6, expected less than a "
     "quarter turn: it is half of what is seen"),
    (with_board("board_size: [1, 1]"),
     S + "configurations: board: board_size: found [1.0, 1.0], expected none without field_of_view"),
    (with_tracker("axis: [0, 0, 0]"), S + "configurations: tracker: axis: found 0, 0, 0, expected a direction"),
    (with_tracker("acceptance: 4"),
     S + "configurations: tracker: acceptance: found 4.0, expected at most half a turn"),
    (with_tracker("distance: [2, 1]"),
     S + "configurations: tracker: distance: found [2.0, 1.0], expected the smaller one first"),
    (with_tracker("region: {lower: [0, 0, 0]}"), S + "configurations: tracker: region: missing key 'upper'"),
    (SHORT.replace(RANDOM, "configurations: {tracker: {count: 1}}\n"),
     S + "configurations: tracker: missing key 'station'"),
    (with_conditions("keep_out: [{lower: [0, 0, 0], upper: [1, 1, -1]}]"), S + "configurations: keep_out 1: upper: "
     "found [1.0, 1.0, -1.0], expected more than lower, [0.0, 0.0, 0.0], in x, y and z"),
    (with_conditions("keep_out: {lower: [0, 0, 0], upper: [1, 1, 1]}"),
     S + "configurations: keep_out: found {'lower': [0, 0, 0], 'upper': [1, 1, 1]}, expected a list"),
    (with_conditions("apart: 0"), S + "configurations: apart: found 0, expected a number above 0"),
    (SHORT.replace(RANDOM, "configurations: {apart: 1}\n"),
     S + "configurations: found none, expected one of board, tracker, random, table"),
    (SHORT.replace("position: 0.001", "position: -1"), S + "noise: position: found -1, expected a number not below 0"),
    (SHORT.replace("orientation: 0.002", "orientation: 0, joint: [1]"),
     S + "noise: joint: 1 figures, expected one for all or 2, one a joint"),
    (SHORT + "frame: free\n",
     S + "frame: found 'free', expected base, unknown, or a mapping of x, y, z, roll, pitch, yaw"),
    (SHORT + "frame: {w: 1}\n", S + "frame: unknown key 'w', expected one of x, y, z, roll, pitch, yaw"),
    (SHORT + "units: {length: km}\n", S + "units: length: found 'km', expected one of m, cm, mm, um, in"),
    (SHORT + "job: {model: poses}\n", S + "job: model: found 'poses', expected one of pose, position, orientation, "
     "distance, rotation, distance-rotation, anchor, plane, board, pixels; did you mean pose?"),
    (SHORT + "job: {pairing: star}\n", S + "job: missing key 'model'"),
    (SHORT + "job: {model: pose, pairing: stars}\n",
     S + "job: pairing: found 'stars', expected one of star, chain, all, {random: N, seed: S}; "
     "did you mean star?"),
    (SHORT + "job: {model: pose, prefer: [x1]}\n", S + "job: prefer: unknown parameter 'x1', expected one of base.x, "
     "base.y, base.z, base.yaw, base.pitch, base.roll, a1, alpha1, d1, theta1, a2, alpha2, ..."),
    (SHORT + "job: {model: pose, robot: r.yaml}\n",
     S + "job: found key 'robot', expected none; the simulation writes it"),
    (SHORT + "job: {model: pose, frame: known}\n",
     S + "job: found key 'frame', expected none; it follows from the scenario"),
    (SHORT + "job: {model: pose, noise: {position: 0}}\n",
     S + "job: noise: position: found 0, expected a number above 0"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(folder, text, message):
    with pytest.raises(InputError) as caught:
        read(folder, text)
    assert str(caught.value) == message


def test_a_robot_without_tolerances_has_no_errors_of_their_size(folder):
    (folder / "robot.yaml").write_text(ROBOT.replace(", theta: 0.04}", "}"))
    with pytest.raises(InputError) as caught:
        read(folder, with_errors("{normal: tolerance}"))
    assert str(caught.value) == (
        S + "errors: normal: theta1 of the robot has no tolerance, expected one for all that is estimated"
    )


def test_a_missing_file_of_a_scenario_is_named(folder):
    for old, new, name in (
        ("robot.yaml", "nowhere.yaml", "nowhere.yaml"),
        ("{random: {count: 3}}", "{table: nowhere.csv}", "nowhere.csv"),
    ):
        with pytest.raises(InputError) as caught:
            read(folder, SHORT.replace(old, new))
        assert str(caught.value) == f"{folder / name}: no such file"


@pytest.mark.parametrize("kind", ["name", "file", "folder"])
def test_what_is_no_scenario_is_one_line(folder, kind):
    wrong, message = {
        "name": ("puma", "scenario: found 'puma', expected a file, or one of space-robot"),
        "file": (folder / "nowhere.yaml", f"{folder / 'nowhere.yaml'}: no such file"),
        "folder": (folder, f"{folder}: is a folder, expected a file"),
    }[kind]
    with pytest.raises(InputError) as caught:
        read_scenario(wrong)
    assert str(caught.value) == message


def test_the_shipped_robot_can_be_read_alone():
    assert read_robot(SCENARIOS / "space-robot" / "robot.yaml").name == "space-robot"


@pytest.mark.parametrize(
    ("text", "job", "lacks"),
    [
        (SHORT.replace(ERRORS, ""), "",
         "errors: found none, expected one of uniform, normal, values: what the arm that moves has"),
        (SHORT.replace(NOISE, "noise: {position: 0.001}\n"), "job: {model: position}\n",
         "noise: orientation: found none, expected 1 sigma: poses are simulated whole"),
        (SHORT.replace(NOISE, "noise: {orientation: 0.002}\n"), "job: {model: rotation}\n",
         "noise: position: found none, expected 1 sigma: poses are simulated whole"),
    ],
    ids=["errors", "orientation", "position"],
)  # fmt: skip
def test_a_design_needs_what_it_uses_and_a_simulation_the_rest(text, job, lacks, folder):
    """Its stops are those of a scenario that has what a simulation needs too."""
    whole = read(folder, SHORT + job)
    found = read(folder, text + job)
    assert np.array_equal(design(found, n=3, n_candidates=20).readings, design(whole, n=3, n_candidates=20).readings)
    with pytest.raises(InputError, match=f"^{re.escape(S + lacks)}$"):
        simulate(found)


def test_a_design_says_which_noise_it_misses(folder):
    found = read(folder, SHORT.replace(NOISE, "noise: {orientation: 0.002}\n") + "job: {model: position}\n")
    with pytest.raises(InputError, match=r"noise: position: found none, expected 1 sigma, for model position$"):
        design(found, n=3, n_candidates=20)
