"""Robot YAML: what is read, what is written back, and one message a mistake."""

import math
from dataclasses import replace

import numpy as np
import pytest
from oracle import dh_joint, frame, tool_pose
from tolerances import rounding

from fg_calib import InputError, Robot, read_robot
from fg_calib.io import Units, write_robot
from fg_calib.robot import CONVENTIONS, Axis, Element, Joint, RobotBuilder

GOOD = """\
name: two
units: {length: mm, angle: deg}
convention: mdh-hayati
joints:
- {a: 0.0, alpha: 0.0, d: 100.0, theta: 0.0, beta: 0.0, limits: [-90.0, 90.0]}
- {name: slide, a: 10.0, alpha: -90.0, d: 0.5, theta: 30.0, beta: 1.0, type: prismatic, limits: [0.0, 200.0]}
base: {x: 1.0, yaw: 90.0}
tool: {z: 50.0}
fixed: [a1, beta2]
estimate: [tool.z]
tolerance: {base.yaw: 3.0, a: 1.0, alpha: 0.5, d2: 2.0, tool: 5.0}
"""


def read(tmp_path, text, name="robot.yaml"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_robot(path)


def test_a_robot_file_is_converted_to_si(tmp_path):
    robot = read(tmp_path, GOOD.replace("a: 10.0", "a: 1e1").replace("d: 100.0", "d: 100"))
    assert (robot.name, robot.convention, robot.n_joints) == ("two", "mdh-hayati", 2)
    assert robot.joints[0] == Joint("q1", lower=-math.radians(90), upper=math.radians(90))
    assert robot.joints[1] == Joint("slide", prismatic=True, lower=0.0, upper=0.2)
    by_name = {p.name: p for p in robot.parameters}
    assert by_name["a2"].nominal == pytest.approx(0.01)  # 1e1 is text to PyYAML
    assert by_name["alpha2"].nominal == pytest.approx(-math.pi / 2)
    assert by_name["base.yaw"].nominal == pytest.approx(math.pi / 2)
    assert by_name["a1"].tolerance == pytest.approx(1e-3)
    assert by_name["alpha1"].tolerance == pytest.approx(math.radians(0.5))
    assert by_name["d1"].tolerance is None
    assert by_name["d2"].tolerance == pytest.approx(2e-3)
    assert by_name["tool.x"].tolerance == pytest.approx(5e-3)
    assert by_name["tool.roll"].tolerance is None
    assert by_name["base.yaw"].tolerance == pytest.approx(math.radians(3))
    estimated = {name for name, p in by_name.items() if p.estimated}
    assert estimated == {"alpha1", "d1", "theta1", "beta1", "a2", "alpha2", "d2", "theta2", "tool.z"}


def test_zeros_are_all_that_is_estimated_of_the_joints_by_either_name(tmp_path):
    zeros = read(tmp_path, GOOD.replace("[a1, beta2]", "[slide.zero]").replace("[tool.z]", "zeros"))
    assert [p.name for p in zeros.parameters if p.estimated] == ["theta1"]
    more = read(tmp_path, GOOD.replace("[tool.z]", "[zeros, alpha2, tool.z]"))
    assert {p.name for p in more.parameters if p.estimated} == {"theta1", "d2", "alpha2", "tool.z"}


def test_the_chain_is_base_then_joints_then_tool(tmp_path):
    robot = read(tmp_path, GOOD)
    q = np.array([0.3, 0.04])
    first = {"a": 0.0, "alpha": 0.0, "d": 0.1, "theta": 0.0, "beta": 0.0}
    second = {"a": 0.01, "alpha": -math.pi / 2, "d": 5e-4, "theta": math.pi / 6, "beta": math.radians(1)}
    expected = (
        frame(1e-3, 0, 0, 0, 0, math.pi / 2)
        @ dh_joint("mdh-hayati", first, q[0], False)
        @ dh_joint("mdh-hayati", second, q[1], True)
        @ frame(0, 0, 0.05, 0, 0, 0)
    )
    assert tool_pose(robot, q) == pytest.approx(expected, abs=rounding(1.0))  # rounding of a few products


def drawn_robot(convention, rng):
    """A robot with all that a file can hold: odd names, slides, limits of one side, what is fixed, tolerances."""
    builder = RobotBuilder("1e-3", convention)
    draw = lambda: float(rng.uniform(-12.0, 12.0) * 10.0 ** -rng.integers(0, 9))  # noqa: E731
    builder.add_frame("base", {"x": draw(), "yaw": draw()}, 0, False)
    for name, limits in {"on": (-math.inf, draw()), "null": (draw(), 13.0), "ünï": (-13.0, math.inf), "7": ()}.items():
        values = {kind: draw() for kind in CONVENTIONS[convention]}
        builder.add_convention_joint(Joint(name, bool(rng.integers(2)), *limits), values)
    builder.add_frame("tool", {"roll": draw(), "z": draw()}, 5, False)
    own = [p.name for p in builder.build().parameters if 1 <= p.owner <= 4]
    scale = {name: abs(draw()) + 1e-9 for name in ("a", "base", "tool.roll", own[0])}
    return builder.build(fixed=rng.choice(own, 3, replace=False), estimate=["base.x", "tool.z"], tolerance=scale)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("length", ["m", "cm", "mm", "um", "in"])
@pytest.mark.parametrize("angle", ["rad", "deg", "mrad"])
def test_a_robot_written_in_other_units_reads_back_to_rounding(tmp_path, convention, length, angle):
    robot = drawn_robot(convention, np.random.default_rng(0))
    write_robot(tmp_path / "robot.yaml", robot, units=Units(length=length, angle=angle))
    back = read_robot(tmp_path / "robot.yaml")
    if (length, angle) == ("m", "rad"):
        assert back == robot
    # one division and one multiplication: an ulp of each
    assert back.nominal == pytest.approx(robot.nominal, rel=4.5e-16, abs=1e-300)
    assert back.limits == pytest.approx(robot.limits, rel=4.5e-16, abs=1e-300)
    for p, p_back in zip(robot.parameters, back.parameters, strict=True):
        assert (p.name, p.estimated, p.tolerance is None) == (p_back.name, p_back.estimated, p_back.tolerance is None)
        assert p_back.tolerance == (p.tolerance and pytest.approx(p.tolerance, rel=4.5e-16))


AXES = """\
name: two
units: {length: mm, angle: deg}
convention: poe
joints:
- {axis: [0.0, 0.0, -1.0], point: [0.0, 0.0, 100.0], x: 0.5, roll: 2.0, limits: [-90.0, 90.0]}
- {name: slide, axis: [0.6, 0.0, 0.8], point: [0.0, 0.0, 0.0], type: prismatic, limits: [0.0, 200.0]}
tool: {z: 50.0, roll: 180.0}
fixed: [q1.roll]
estimate: [tool.z]
tolerance: {x: 1.0, pitch: 0.5}
"""


def test_axes_are_read_and_written(tmp_path):
    robot = read(tmp_path, AXES.replace("[0.6, 0.0, 0.8]", "[3, 0, 4]").replace("x: 0.5", "sigma: {x: 0.1}, x: 0.5"))
    by_name = {p.name: p for p in robot.parameters}
    assert [name for name in by_name if name[:4] not in ("base", "tool")] == [
        "q1.x", "q1.y", "q1.pitch", "q1.roll", "slide.pitch", "slide.roll"]  # fmt: skip
    assert (by_name["q1.x"].nominal, by_name["q1.x"].tolerance) == pytest.approx((5e-4, 1e-3))
    assert by_name["slide.pitch"].tolerance == pytest.approx(math.radians(0.5))
    assert [p.name for p in robot.parameters if p.estimated] == [
        "q1.x", "q1.y", "q1.pitch", "slide.pitch", "slide.roll", "tool.z"]  # fmt: skip
    write_robot(tmp_path / "out.yaml", robot, units=Units(length="mm", angle="deg"))
    assert (tmp_path / "out.yaml").read_text() == AXES


@pytest.mark.parametrize("axis", [[1e-17, 6e-17, -1.0], [1e-9, 2e-9, 1.0], [0.0, -1.0, 6e-17], [0.1, -0.2, 0.3]])
def test_axes_in_any_direction_read_back_with_their_parameters(tmp_path, axis):
    builder = RobotBuilder("one", "poe")
    builder.add_screw_joint(Joint("j"), axis, [0.1, 0.2, 0.3], {"x": 0.4, "y": 0.5, "pitch": 0.6, "roll": 0.7})
    robot = builder.build()
    write_robot(tmp_path / "one.yaml", robot)
    back = read_robot(tmp_path / "one.yaml")
    assert back.nominal.tolist() == robot.nominal.tolist()
    assert tool_pose(back, np.ones(1)) == pytest.approx(tool_pose(robot, np.ones(1)), abs=rounding(1.0))


def test_a_robot_that_no_file_can_hold_is_refused(tmp_path):
    """Custom elements would be lost without a word, and a result saved with them could not be loaded."""
    robot = Robot.from_dh([[0.1, 0.2, 0.3, 0.4]] * 2)
    more = replace(robot, elements=(*robot.elements, Element(Axis.TX, 0.1)))
    another = RobotBuilder("arm", "dh")
    another.add_frame("base", {}, 0, False)
    another.add_convention_joint(Joint("q1"), {"a": 0.1, "alpha": 0.2, "d": 0.3, "theta": 0.4})
    another.add_frame("flange", {"x": 0.1}, 2, False)
    turned = replace(robot, elements=(*robot.elements[:-1], replace(robot.elements[-1], axis=Axis.TX)))
    for one in (more, turned, another.build()):
        with pytest.raises(InputError, match="the robot has elements or parameters of its own, expected base, joints"):
            write_robot(tmp_path / "robot.yaml", one)
    with pytest.raises(InputError, match="convention: found 'urdf', expected one of dh"):
        write_robot(tmp_path / "robot.yaml", replace(robot, convention="urdf"))
    assert list(tmp_path.iterdir()) == []


def test_a_written_robot_is_readable_for_people(tmp_path):
    write_robot(tmp_path / "out.yaml", read(tmp_path, GOOD), units=Units(length="mm", angle="deg"))
    assert (tmp_path / "out.yaml").read_text() == GOOD
