"""The key `effects` of robot files: read, written and read back, masses of URDFs in their places."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal

from fg_calib import Measurements, Table
from fg_calib.io import (
    Column,
    Units,
    read_joint_table,
    read_measurements,
    read_robot,
    read_urdf,
    write_csv,
    write_robot,
)
from fg_calib.robot import Backlash, Compliance, ErrorCurve, Harmonics, Mass
from fg_calib.simulation import table_columns

HEAD = """\
name: arm
convention: dh
units: {length: mm, angle: deg}
joints:
  - {a: 100, alpha: 90, d: 300, theta: 0}
  - {a: 500, alpha: 20, d: 0, theta: 0}
  - {a: 300, alpha: 70, d: 100, theta: 30}
tool: {z: 100}
"""
EFFECTS = """\
effects:
  compliance:
    joints: [2, 3]
    masses: {2: {mass: 12.0, com: [0.3, 0, 0.1]}, 3: {mass: 4.0}, 4: {mass: 1.0}}
    payload: {mass: 2.0, com: [0, 0, 0.06], column: load}
    gravity: [0, 0, 9.81]
  harmonics: {orders: [1, 2.5]}
  gain: true
  error_curve: {knots: 8, joints: [2]}
  backlash: {side: moves}
  coupling: [[2, 3]]
  thermal: {reference: 21, zeros: true}
  base_bending: true
  values: {theta2.compliance: 1.5e-5, theta2.curve: [1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 7e-4, 8e-4]}
"""
LINK = '<link name="{}"><inertial><origin xyz="{}"/><mass value="{}"/></inertial></link>'
ENDS = '<parent link="{}"/><child link="{}"/><origin xyz="{}" rpy="{}"/><axis xyz="{}"/><limit lower="-2" upper="2"/>'
JOINT = f'<joint name="{{}}" type="{{}}">{ENDS}</joint>'


@pytest.fixture
def read(tmp_path):
    def of(text):
        (tmp_path / "robot.yaml").write_text(text)
        return read_robot(tmp_path / "robot.yaml")

    return of


def test_effects_are_read_with_their_options(read):
    robot = read(HEAD + EFFECTS)
    compliance, harmonics = robot.effects[:2]
    masses = [Mass(2, 12.0, (0.3, 0.0, 0.1)), Mass(3, 4.0), Mass(4, 1.0), Mass(3, 2.0, (0, 0, 0.06), "load")]
    assert compliance == Compliance(masses, [2, 3], gravity=[0.0, 0.0, 9.81])
    assert robot.effects[-1].gravity == compliance.gravity
    assert read(HEAD + "effects: {backlash: true}\n").effects == (Backlash(),)
    assert harmonics == Harmonics([1, 2.5])
    assert robot.effects[3] == ErrorCurve([2], knots=8)
    values = {p.name: p.nominal for p in robot.parameters}
    assert (values["theta2.compliance"], values["theta2.curve[6]"], values["theta3.sin2_5"]) == (1.5e-5, 7e-4, 0.0)


def test_a_robot_with_effects_is_written_and_read_back(read, tmp_path):
    robot = read(HEAD + EFFECTS + "  select: true\n")
    write_robot(tmp_path / "again.yaml", robot)
    again, loaded = read_robot(tmp_path / "again.yaml"), {"load": np.full(5, 3.0)}
    assert again.select_effects
    q = np.random.default_rng(0).uniform(-2, 2, (5, 3))
    assert again.nominal == pytest.approx(robot.nominal, abs=1e-15)
    assert again.trig(q, loaded) == pytest.approx(robot.trig(q, loaded), abs=1e-12)  # masses on one link are one


def test_gravity_is_estimated_by_two_angles(read):
    robot = read(f"{HEAD}effects: {{compliance: {{masses: {{2: {{mass: 5}}}}, gravity: estimate}}}}\n")
    assert [p.name for p in robot.parameters if p.kind == "tilt"] == ["base.tilt_x", "base.tilt_y"]


def test_columns_that_effects_need_are_known_and_missed_by_name(read, tmp_path):
    robot = read(HEAD + "effects: {thermal: true, backlash: {joints: [3], side: side}}\n")
    table = tmp_path / "t.csv"
    table.write_text("q1,q2,q3,x,y,z,T,side3\n0,0,0,1,2,3,25,-1\n")
    assert refusal(lambda: read_measurements(table, robot)).startswith("t.csv: no column temperature")
    found = read_measurements(table, robot, columns={"temperature": Column(name="T")}).context
    assert (found["temperature"].tolist(), found["side"][:, 2].tolist()) == ([25.0], [-1.0])


def test_select_stands_for_the_standard_effects(read):
    robot = read(HEAD + "effects: select\n")
    assert robot.select_effects
    assert [type(e).__name__ for e in robot.effects] == ["ErrorCurve", "Compliance", "Harmonics", "Gain"]


@pytest.mark.parametrize(("effects", "said"), [
    ("backlash: {side: q}", "arm: effects by q1, q2, q3, expected columns of nothing else"),
    ("compliance: {payload: {mass: 1, column: load}}", "t.csv: load: found -2, expected masses, 0 or above"),
])  # fmt: skip
def test_columns_of_what_cannot_be_are_refused(read, tmp_path, effects, said):
    (tmp_path / "t.csv").write_text("q1,q2,q3,x,y,z,load\n0.5,0,0,1,2,3,-2\n")
    assert said in refusal(read_measurements, tmp_path / "t.csv", read(HEAD + f"effects: {{{effects}}}\n"))


def test_a_temperature_far_from_its_reference_is_asked_for_its_unit(read, tmp_path, caplog):
    (tmp_path / "t.csv").write_text("q1,q2,q3,x,y,z,temperature\n0.5,0,0,1,2,3,294\n")
    read_measurements(tmp_path / "t.csv", read(HEAD + "effects: {thermal: true}\n"))
    assert [r.getMessage().split(";")[1] for r in caplog.records] == [" are they in one unit?"]


# a fixed joint and axes that are not z; the other arm has a shoulder that turns, and a slide
COM = {"base": "0 0 0.1", "upper": "0.1 0.02 0.3", "bracket": "0.01 0 0.05", "fore": "0.2 0.1 0", "other": "0 0.3 0.1"}
COM |= {"rail": "0.1 0 0", "hand": "0 0.1 0.2"}
MASSES = {"base": 9.0, "upper": 5.0, "bracket": 0.7, "fore": 2.0, "other": 3.0, "rail": 0.5, "hand": 1.5}
OUTSIDE = ["other_shoulder", "other_slide"]
JOINTS = [
    ("shoulder", "revolute", "base", "upper", "0 0 0.4", "0.3 0.2 0.1", "0 1 0"),
    ("mount", "fixed", "upper", "bracket", "0.1 0.2 0.3", "0.5 0.1 -0.4", "1 0 0"),
    ("elbow", "revolute", "upper", "fore", "0.5 0 0.1", "-0.2 0.7 0.1", "0.6 0 0.8"),
    ("other_shoulder", "revolute", "bracket", "other", "0.2 0.1 0.3", "0.1 -0.4 0.3", "0 0.8 0.6"),
    ("other_slide", "prismatic", "other", "rail", "0.1 0.3 0", "0.2 0.1 0.5", "0.6 0.8 0"),
    ("wrist", "fixed", "rail", "hand", "0 0.1 0.1", "0.3 0.2 0.1", "1 0 0"),
]


def two_arms(folder, base, tip):
    """The robot between two links, written and read."""
    text = "".join([LINK.format(n, COM[n], MASSES[n]) for n in COM] + [JOINT.format(*joint) for joint in JOINTS])
    (folder / "arm.urdf").write_text(f'<robot name="arm">{text}</robot>')
    ends = f"base_link: {base}\ntip_link: {tip}\n"
    (folder / "robot.yaml").write_text("urdf: arm.urdf\neffects: {compliance: true}\n" + ends)
    return read_robot(folder / "robot.yaml")


@pytest.mark.parametrize("ends", [("base", "fore"), ("fore", "base"), ("hand", "base")])
def test_masses_of_a_urdf_are_where_its_links_are(ends, tmp_path):
    """Torques by the potential of all links, those of the other arm where its joints stand; written and read back."""
    from yourdfpy import URDF

    robot, q = two_arms(tmp_path, *ends), np.array([[0.4, -0.9, 0.7, 0.2], [1.0, 0.3, -1.1, 0.4]])
    moving, n = [joint.name for joint in robot.joints], robot.n_joints
    outside = [name for name, kind, *_ in JOINTS if kind != "fixed" and name not in moving]
    turning = [k for k, joint in enumerate(robot.joints) if not joint.prismatic]
    assert [p.name for p in robot.parameters if p.kind == "compliance"] == [f"{moving[k]}.compliance" for k in turning]
    urdf = URDF.load(str(tmp_path / "arm.urdf"), load_meshes=False, build_scene_graph=True)

    def potential(readings):
        urdf.update_cfg(dict(zip(moving + outside, readings, strict=True)))
        points = {n: urdf.get_transform(n, ends[0]) @ [*map(float, COM[n].split()), 1.0] for n in COM}
        return -9.81 * sum(MASSES[n] * points[n][2] for n in COM)

    context = dict(zip(outside, q.T[n:], strict=True))
    write_robot(tmp_path / "again.yaml", robot, urdf_name="arm.urdf")
    again, at_zero = read_robot(tmp_path / "again.yaml"), np.where(np.arange(4) < n, q, 0.0)
    for arm, known, at in ((again, context, q), (robot, {}, at_zero)):
        found = arm.effects[0].values(arm.geometry, q[:, :n], known, np.zeros(len(turning)))[:, :, 0]
        for row, torque in zip(at, found, strict=True):
            expected = [(potential(row + h) - potential(row - h)) / 2e-5 for h in 1e-5 * np.eye(4)[turning]]
            assert torque == pytest.approx(expected, abs=1e-7)


def test_joints_outside_the_chain_are_columns_that_a_table_may_have(tmp_path, caplog):
    robot, table = two_arms(tmp_path, "base", "fore"), tmp_path / "t.csv"
    table.write_text("shoulder,elbow,x,y,z,other_shoulder\n1,2,1,2,3,30\n")
    assert "other_shoulder: found '30', expected -2 to 2 rad" in refusal(read_measurements, table, robot)
    found = read_measurements(table, robot, units=Units("mm", "deg")).context
    assert {name: q.item() for name, q in found.items()} == pytest.approx({OUTSIDE[0]: np.pi / 6, OUTSIDE[1]: 0.0})
    assert caplog.messages[-1] == "t.csv: no column other_slide: joints outside the chain are at 0"
    assert robot.effects[0].assumed(found) == []
    (tmp_path / "q.csv").write_text("shoulder,elbow,other_slide\n10,20,300\n")
    found = read_joint_table(tmp_path / "q.csv", robot, Units("mm", "deg"))[2]
    assert found == {"other_slide": pytest.approx([0.3])}
    assert robot.effects[0].assumed(found) == ["joints outside the chain at 0"]


def test_joints_outside_the_chain_are_written_in_the_units_of_a_table(tmp_path):
    robot = two_arms(tmp_path, "base", "fore")
    context = dict(zip(OUTSIDE, np.array([[0.5, -0.4], [0.1, 0.2]]), strict=True))
    m = replace(Measurements.from_arrays(np.zeros((2, 2)), position=np.zeros((2, 3))), source="t.csv", context=context)
    units = Units("mm", "deg")
    write_csv(tmp_path / "t.csv", table_columns(Table(m, None), robot, units)["t.csv"])
    found = read_measurements(tmp_path / "t.csv", robot, units=units).context
    assert np.array([found[name] for name in OUTSIDE]) == pytest.approx(np.array([context[name] for name in OUTSIDE]))


@pytest.mark.parametrize(("before", "broken", "said"), [
    ("0.6 0.8 0", "0 0 0", "joint 'other_slide': axis: found [0.0, 0.0, 0.0]"),
    ("0 0.1 0.2", "0 .1", "link 'hand': origin xyz: found '0 .1'"),
])  # fmt: skip
def test_what_is_broken_outside_the_chain_matters_where_its_mass_does(before, broken, said, tmp_path):
    two_arms(tmp_path, "base", "fore")
    (tmp_path / "arm.urdf").write_text((tmp_path / "arm.urdf").read_text().replace(before, broken))
    assert said in refusal(lambda: read_robot(tmp_path / "robot.yaml"))
    assert read_urdf(tmp_path / "arm.urdf", base_link="base", tip_link="fore", effects={"harmonics": True}).effects


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ("{gain: true, harmonic: true}", "effects: unknown key 'harmonic'"),
        ("{compliance: true}", "effects: compliance: no masses, expected `masses: free`, or the mass and com"),
        ("{compliance: {masses: {7: {mass: 1}}}}", "masses: 7: no link '7', expected one of 0, 1, 2, 3"),
        ("{compliance: {masses: {2: {mass: -1}}}}", "effects: compliance: masses: 2: mass: found -1"),
        ("{harmonics: {joints: [4]}}", "harmonics: joints: found 4, expected joints that turn, of 1, 2, 3"),
        ("{harmonics: {order: [1]}}", "effects: harmonics: unknown key 'order', expected one of orders, joints"),
        ("{error_curve: {knots: 2}}", "effects: error_curve: knots: found 2"),
        ("{gain: true, values: {theta9.gain: 1}}", "effects: values: arm: unknown parameter 'theta9.gain'"),
        ("{gain: true, values: {theta1.gain: [1, 2]}}", "effects: values: theta1.gain: 2 figures, expected one"),
        ("gain", "robot.yaml: effects: found 'gain', expected a mapping or one of select"),
        ("Select", "one of select; did you mean select?"),
        ("{gain: {joints: elbow}}", "robot.yaml: effects: gain: joints: found 'elbow', expected one of all or a list"),
        ("{gain: {joints: [2, 2]}}", "robot.yaml: effects: gain: joints: found (2, 2), expected different joints"),
        ("{gain: {joints: []}}", "gain: joints: found (), expected different joints"),
        ("{gain: {masses: free}}", "effects: gain: unknown key 'masses', expected one of joints"),
        ("{compliance: {masses: free, payloads: 1}}", "gravity, payload; did you mean payload?"),
        ("{harmonics: {orders: [1, 1]}}", "harmonics: orders: found (1, 1), expected different numbers"),
        ("{error_curve: {knots: 1000000}}", "error_curve: knots: found 1000000, expected at most 1000"),
        ("{error_curve: {sigma: -1e-3}}", "error_curve: sigma: found -0.001, expected a finite number above 0"),
        ("{compliance: {masses: {2: {mass: 1}}, gravity: [0, 9]}}", "compliance: gravity: shape (2,), expected (3)"),
        ("{compliance: {masses: {2: {mass: 1}}, gravity: [0, 0, 0]}}", "gravity: found (0, 0, 0), expected m/s^2"),
        ("{compliance: {masses: {2: {mass: 1, com: [300, 0, 0]}}}}", "masses: 2: com: found (300.0, 0.0, 0.0), "),
        ("{coupling: [[2, 2]]}", "effects: coupling: joints: found (2, 2), expected different joints"),
        ("{coupling: [2, 3]}", "effects: coupling: pairs: found (2, 3), expected different pairs of joints"),
        ("{thermal: {reference: .nan}}", "effects: thermal: reference: found nan, expected a finite number"),
        ("{thermal: {lengths: [a7]}}", "thermal: lengths: unknown length 'a7', expected one of d1, a1"),
        ("{gain: true, select: 'no'}", "robot.yaml: effects: select: found 'no', expected True or False"),
        ("{gain: true, values: [1]}", "robot.yaml: effects: values: found [1], expected a mapping"),
        ("{gain: true, values: {theta1.gain: big}}", "robot.yaml: effects: values: theta1.gain: "),
    ],
)  # fmt: skip
def test_what_is_wrong_with_effects_is_said_in_one_line(read, effects, said):
    assert said in refusal(read, f"{HEAD}effects: {effects}\n")
