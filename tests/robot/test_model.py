"""Robots from a table in Python: the same as from a file, and every mistake named."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from fg_calib import InputError, Robot, read_robot
from fg_calib.io import read_urdf, write_robot
from fg_calib.robot import CONVENTIONS, RobotBuilder, pose

ROWS = [[0.0, -1.5, 0.34, 0.1, 0.01], [0.6, 0.0, 0.02, -0.2, 0.02], [0.1, 1.2, 0.0, 0.3, -0.03]]  # a alpha d theta beta


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_table_is_the_robot_of_a_file_with_its_figures(tmp_path, convention):
    kinds = ("a", "alpha", "d", "theta", "beta")[: 5 if "hayati" in convention else 4]
    rows = [dict(zip(kinds, row, strict=False)) for row in ROWS]
    rows[1] |= {"type": "prismatic", "limits": [0.0, 0.5]}
    rows[2] |= {"name": "wrist"}
    more = {"fixed": ["a1"], "estimate": ["tool.x"], "tolerance": {"a": 1e-3, "theta2": 2e-3, "tool": 1e-2}}
    file = {"convention": convention, "joints": rows, "base": {"z": 0.5}, "tool": {"x": 0.1, "yaw": 0.7}} | more
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(file))
    more |= {"types": ["revolute", "prismatic", "revolute"], "names": ["q1", "q2", "wrist"], "base": [0, 0, 0.5]}
    more |= {"limits": [None, (0.0, 0.5), None], "tool": [0.1, 0, 0, 0, 0, 0.7]}
    robot = Robot.from_dh([row[: len(kinds)] for row in ROWS], convention, name="arm", **more)
    assert robot == read_robot(tmp_path / "arm.yaml")
    write_robot(tmp_path / "again.yaml", robot)
    assert read_robot(tmp_path / "again.yaml") == robot


def test_beta_is_zero_where_no_column_states_it():
    four = [row[:4] for row in ROWS]
    assert Robot.from_dh(four, "mdh-hayati") == Robot.from_dh([[*row, 0.0] for row in four], "mdh-hayati")
    assert [p.nominal for p in Robot.from_dh(four, "mdh-hayati").parameters if p.kind == "beta"] == [0.0] * 3


@pytest.mark.parametrize("rpy", [[0.3, -0.4, 2.5], [0.0, 0.5 * np.pi, 0.7], [0.2, -0.5 * np.pi, 0.7]])
def test_a_tool_is_a_matrix_too(rpy):
    """Also where pitch is a quarter turn and only a sum of roll and yaw acts."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), [0.1, 0.2, 0.3]
    q = [[0.4, -0.3, 1.0]]
    robot = Robot.from_dh([row[:4] for row in ROWS], tool=matrix, base=matrix)
    other = Robot.from_dh([row[:4] for row in ROWS], tool=[0.1, 0.2, 0.3, *rpy], base=[0.1, 0.2, 0.3, *rpy])
    # The arctangent of a pitch whose cosine is 1e-16 is exact to a few roundings of numbers of size 1.
    assert pose(robot, q).rotation == pytest.approx(pose(other, q).rotation, abs=1e-15 * 20)
    assert pose(robot, q).position == pytest.approx(pose(other, q).position, abs=1e-15 * 20)


FOUR = [row[:4] for row in ROWS]


@pytest.mark.parametrize(("given", "message"), [
    ({"rows": [[0, 1, 2]]}, r"rows: shape \(1, 3\), expected \(n, 4\)"),
    ({"rows": []}, r"rows: shape \(0,\), expected \(n, 4\)"),
    ({"rows": np.zeros((0, 4))}, "rows: no joints, expected at least one"),
    ({"rows": [[0, 1, 2, np.nan]]}, "rows: row 0: found nan, expected a finite number"),
    ({"rows": [[0, 1, 2, "x"]]}, "rows: found .*, expected numbers of shape"),
    ({"rows": [[0, 90, 2, 0]]}, "rows: row 0: found 90, expected angles in rad, two turns at most; are they"),
    ({"rows": ROWS}, r"rows: shape \(3, 5\), expected \(n, 4\): the convention dh has no beta"),
    ({"convention": "DH"}, "convention: found 'DH', expected one of dh, .* did you mean dh?"),
    ({"types": "sliding"}, "types: joint 1: found 'sliding', expected one of revolute, prismatic"),
    ({"types": ["revolute"]}, "types: 1 for 3 joints, expected one a joint"),
    ({"limits": [[0, 1]]}, "limits: 1 for 3 joints"),
    ({"limits": [[0, 1], [1, 0], None]}, r"limits: joint 2: found \[1, 0\], expected lower below upper"),
    ({"names": ["a", "a", "b"]}, "names: joint 2: found 'a', as before, expected different names"),
    ({"tool": [1, 2]}, r"tool: shape \(2,\), expected \(3\), \(6\) or \(4, 4\)"),
    ({"base": np.ones((4, 4))}, "base: a matrix that is no pose"),
    ({"base": np.diag([1, 1, -1, 1])}, "base: a matrix that is no pose"),
    ({"tolerance": {"a": 0.0}}, "tolerance: a: found 0.0, expected a finite number above 0"),
    ({"tolerance": {"b": 1.0}}, "robot: tolerance: unknown parameter or kind 'b'"),
    ({"types": 3}, "types: found 3, expected a type, or one a joint$"),
    ({"limits": 3}, "limits: found 3, expected lower and upper of each joint$"),
    ({"limits": [1, 2, 3]}, "limits: joint 1: found 1, expected lower below upper, or None$"),
    ({"limits": [["-1", "1"]] * 3}, "limits: joint 1: found .*'-1', '1'.*, expected lower and upper$"),
    ({"limits": [[np.nan, 1]] * 3}, r"limits: joint 1: found \[nan, 1\], expected lower below upper, or None$"),
    ({"names": [1, 2, 3]}, "names: joint 1: found 1, expected a word$"),
    ({"tolerance": ["a"]}, r"tolerance: found \['a'\], expected a mapping$"),
    ({"tool": {"w": 1.0}}, "tool: unknown value 'w', expected one of x, y, z, yaw, pitch, roll$"),
    ({"tool": {"x": "far"}}, r"tool: x: found 'far', expected numbers of shape \(\)$"),
    ({"tool": [0, 0, 0.1, 90, 0, 0]}, r"tool: roll: found 90, expected angles in rad, .* most; is it in deg\?$"),
    ({"tool": {"roll": 90}}, r"tool: roll: found 90, expected angles in rad, .* most; is it in deg\?$"),
    ({"estimate": 3}, "estimate: found 3, expected a list of names$"),
    ({"fixed": [None]}, "robot: fixed: unknown parameter None, expected one of base.x"),
    ({"fixed": ["a9"]}, "robot: fixed: unknown parameter 'a9'"),
])  # fmt: skip
def test_mistakes_are_named(given, message):
    with pytest.raises(InputError, match=message):
        Robot.from_dh(**{"rows": FOUR} | given)


def test_a_robot_of_a_urdf(tmp_path):
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    of_class, of_reader = (read(tmp_path / "arm.urdf", estimate=["tool.x"]) for read in (Robot.from_urdf, read_urdf))
    assert of_class == of_reader


def test_a_robot_of_many_joints_fits_a_screen():
    lines = repr(Robot.from_dh(FOUR * 10, "dh")).splitlines()
    assert len(lines) <= 10
    assert max(map(len, lines)) <= 100
    assert lines[0].startswith("Robot 'robot', dh, 30 joints: q1, q2")


def test_a_frame_may_be_given_by_kind():
    assert Robot.from_dh(FOUR, tool={"z": 0.1, "yaw": 0.2}) == Robot.from_dh(FOUR, tool=[0, 0, 0.1, 0, 0, 0.2])


def test_the_text_of_a_urdf_is_no_path():
    with pytest.raises(InputError, match=r"^path: found XML text, expected the path of a URDF; write the text to a f"):
        Robot.from_urdf('<?xml version="1.0"?>\n<robot name="arm"/>')


@pytest.mark.parametrize(("values", "message"), [
    (None, r"robot: shape \(\), expected 24, one a parameter$"),
    ([1.0], "robot: 1 values, expected 24, one a parameter$"),
    ([[1.0]], r"robot: shape \(1, 1\), expected 24, one a parameter$"),
    ([0.0, 0.0, 0.0, np.nan, *np.zeros(20)], "robot: row 3: found nan, expected a finite number$"),
])  # fmt: skip
def test_values_are_finite_and_one_a_parameter(values, message):
    with pytest.raises(InputError, match=message):
        Robot.from_dh(FOUR).with_values(values)


@pytest.mark.parametrize(
    ("limits", "slide"), [([-0.5, 0.2], 0.4), ([0.1, 0.3], 0.4), (None, 0.1), ([0.2, np.inf], 0.3)]
)
def test_an_arm_reaches_as_far_as_its_lengths_and_what_slides_go(limits, slide):
    """From its base, wherever that stands; what slides is 0.1 m long at 0."""
    rows = [[-0.3, 1.0, 0.2, 0.5], [0.0, 1.0, 0.1, 0.5]]
    more = {"types": ["revolute", "prismatic"], "limits": [[-1.0, 2.0], limits]}
    robot = Robot.from_dh(rows, base=[0, 0, 5], tool=[0, 0, -0.7], **more)
    assert robot.reach == pytest.approx(0.3 + 0.2 + slide + 0.7)
    assert Robot.from_dh(np.zeros((2, 4))).reach == 1.0


@pytest.mark.parametrize(("limit", "told"), [(170.0, True), (20.0, False)])
def test_limits_of_many_turns_are_told_of(caplog, limit, told):
    """Limits in deg refuse no reading, so nothing else would say that their unit is wrong."""
    Robot.from_dh([[1.0, 0.0, 0.0, 0.0]], convention="dh", limits=[[-limit, limit]])
    expected = ["robot: joint q1 has limits of -170 to 170 rad; are they in deg?"] if told else []
    assert caplog.messages == expected


@pytest.mark.parametrize(("call", "message"), [
    (lambda b: b.build(tolerance=0.003), "tolerance: found 0.003, expected a mapping"),
    (lambda b: b.add_frame("x", 3, 0, False), "values: found 3, expected a mapping"),
    (lambda b: b.add_convention_joint(3, {}), "joint: found 3, expected a Joint"),
    (lambda _: RobotBuilder(3, "dh"), "name: found 3, expected text"),
])  # fmt: skip
def test_a_builder_given_something_else_says_so(call, message):
    with pytest.raises(InputError, match=message):
        call(RobotBuilder("arm", "dh"))
