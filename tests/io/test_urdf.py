"""URDF: chains against yourdfpy's own forward kinematics, origins written back, and one message a mistake."""

import math

import numpy as np
import pytest
import yourdfpy
from exported import yourdfpy_poses
from lxml import etree
from oracle import tool_pose
from refusals import refusal
from tolerances import rounding

from fg_calib.inputs import InputError
from fg_calib.io.robot_file import read_robot, read_urdf, write_robot, write_urdf
from fg_calib.robot.model import Joint

TREE = """\
<?xml version="1.0"?>
<!-- a torso with two arms -->
<robot name="torso">
  <link name="world"/>
  <link name="left_1"/>
  <link name="left_2"><visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual></link>
  <link name="left_tip"/>
  <link name="right_1"/>
  <link name="right_2"/>
  <link name="right_tip"/>
  <joint name="l1" type="revolute"><origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 0.6"/>
    <parent link="world"/><child link="left_1"/><axis xyz="1 2 -3"/>
    <limit lower="-1.5" upper="2" effort="1" velocity="1"/></joint>
  <joint name="l2" type="fixed"><origin xyz="0.3 0 0.1" rpy="-1 0.3 2"/>
    <parent link="left_1"/><child link="left_2"/></joint>
  <joint name="l3" type="prismatic"><!-- no axis: x --><origin xyz="0 0.5 0" rpy="0 1.5708 0"/>
    <parent link="left_2"/><child link="left_tip"/>
    <limit lower="0" upper="0.7" effort="1" velocity="1"/></joint>
  <joint name="r1" type="continuous">
    <parent link="world"/><child link="right_1"/><axis xyz="0 0 -1"/></joint>
  <joint name="r2" type="revolute"><origin xyz="0 0.05 0.7"/>
    <parent link="right_1"/><child link="right_2"/><axis xyz="-2 0.5 0.1"/>
    <limit effort="1" velocity="1"/></joint>
  <joint name="r3" type="fixed"><origin rpy="0.1 0.2 0.3" xyz="1 2 3"/>
    <parent link="right_2"/><child link="right_tip"/></joint>
</robot>
"""
LINKS = ["world", "left_1", "left_2", "left_tip", "right_1", "right_2", "right_tip"]


@pytest.fixture
def tree(tmp_path):
    path = tmp_path / "torso.urdf"
    path.write_text(TREE)
    return path


def test_changed_parameters_of_a_reversed_chain_are_those_of_the_file(tree, tmp_path):
    robot = read_urdf(tree, base_link="left_tip", tip_link="right_tip")
    rng = np.random.default_rng(2)
    own = np.array([1 <= p.owner <= 4 for p in robot.parameters])
    changed = robot.with_values(robot.nominal + own * rng.uniform(-0.1, 0.1, len(own)))
    out = tmp_path / "calibrated.urdf"
    write_urdf(out, changed)
    q = {"l3": 0.3, "l1": -0.7, "r1": 2.0, "r2": 0.4}
    (expected,) = yourdfpy_poses(out, "left_tip", "right_tip", list(q), [list(q.values())])
    assert tool_pose(changed, list(q.values())) == pytest.approx(expected, abs=rounding(1.0))
    back = read_urdf(out, base_link="left_tip", tip_link="right_tip")
    assert back.parameters == changed.parameters  # exactly
    assert np.abs(tool_pose(robot, list(q.values())) - expected).max() > 1e-3


def test_only_origins_of_moving_joints_are_rewritten(tree, tmp_path):
    robot = read_urdf(tree, tip_link="right_tip")
    values = robot.nominal
    values[robot.index("r1.z")] = 0.1
    values[robot.index("r2.yaw")] = 1 / 3
    write_urdf(tmp_path / "out.urdf", robot.with_values(values))
    expected = (
        TREE.replace('<joint name="r1" type="continuous">\n    ', '<joint name="r1" type="continuous">\n    '
                 '<origin xyz="0.0 0.0 0.1"/>\n    ')
        .replace('<origin xyz="0 0.05 0.7"/>', '<origin xyz="0 0.05 0.7" rpy="0.0 0.0 0.3333333333333333"/>')
    )  # fmt: skip
    assert canonical((tmp_path / "out.urdf").read_text()) == canonical(expected)


def canonical(text):
    """XML without the freedom of quotes, of blanks within tags, and of the order of attributes."""
    return etree.tostring(etree.fromstring(text), method="c14n")


def test_a_yaml_gives_a_urdf_links_a_tool_and_tolerances(tree, tmp_path):
    folder = tmp_path / "robots"
    folder.mkdir()
    path = folder / "robot.yaml"
    path.write_text(
        "urdf: ../torso.urdf\nbase_link: world\ntip_link: right_tip\nunits: {length: mm, angle: deg}\n"
        "tool: {z: 100, yaw: 90}\nfixed: [r1.x]\nestimate: [tool.z]\ntolerance: {x: 2, roll: 1, tool: 5, r2.yaw: 3}\n"
    )
    robot = read_robot(path)
    assert (robot.name, robot.urdf.tip_link) == ("torso", "right_tip")
    by_name = {p.name: p for p in robot.parameters}
    assert by_name["tool.z"].nominal == pytest.approx(0.1)
    assert by_name["tool.yaw"].nominal == pytest.approx(math.pi / 2)
    assert not by_name["r1.x"].estimated
    assert by_name["tool.z"].estimated
    assert by_name["r2.x"].tolerance == pytest.approx(2e-3)
    assert by_name["r2.roll"].tolerance == pytest.approx(math.radians(1))
    assert by_name["r2.yaw"].tolerance == pytest.approx(math.radians(3))
    assert read_robot(path, tip_link="right_2").urdf.tip_link == "right_2"

    write_urdf(tmp_path / "calibrated.urdf", robot)
    write_robot(tmp_path / "calibrated.yaml", robot, urdf_name="calibrated.urdf")
    back = read_robot(tmp_path / "calibrated.yaml")
    for name in ("name", "joints", "parameters", "elements"):
        assert getattr(back, name) == getattr(robot, name)


def random_urdf(rng):
    """A tree of 3 to 12 links in any order, with all that a joint may leave out or state in an odd way."""

    def numbers(scale):
        return rng.choice(["  ", " \n\t", " "]).join(map(repr, rng.uniform(-scale, scale, 3).tolist()))

    def element(tag, **attributes):
        given = [f"{name}='{value}'" for name, value in attributes.items() if rng.random() < 0.7]
        return f"<{tag} {' '.join(given)}/>" if rng.random() < 0.8 else ""

    def joint(child):
        low, high = np.sort(rng.uniform(-3, 3, 2))
        mimic = f"<mimic joint='j1' multiplier='{low}'/>" if rng.random() < 0.1 and child > 1 else "<!-- itself -->"
        parts = [
            element("origin", xyz=numbers(1), rpy=numbers(4)),
            element("axis", xyz=numbers(2)),
            element("limit", lower=min(low, 0.0), upper=max(high, 0.0), effort=1),
            f"<parent link='L{rng.integers(child)}'/>",
            f"<child link='L{child}'/>",
            mimic,
        ]
        kind = rng.choice(["revolute", "continuous", "prismatic", "fixed"])
        return f"<joint name='j{child}' type='{kind}'>{''.join(rng.permutation(parts))}</joint>"

    n = int(rng.integers(3, 13))
    parts = [*(f"<link name='L{i}'/>" for i in range(n)), *(joint(i) for i in range(1, n))]
    return n, f"<robot name='r'>{''.join(rng.permutation(parts))}</robot>"


def yourdfpy_chain(model, base, tip):
    """Names of the joints from `base` to `tip` by what yourdfpy says are their parents and children."""
    above = {joint.child: joint for joint in model.robot.joints}

    def up(link):
        return [above[link].name, *up(above[link].parent)] if link in above else []

    there, back = up(base), up(tip)
    return [*(j for j in there if j not in back), *reversed([j for j in back if j not in there])]


@pytest.mark.parametrize("seed", range(20))
def test_random_trees_are_the_chains_limits_and_poses_of_yourdfpy(tmp_path, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path / "random.urdf"
    n, text = random_urdf(rng)
    path.write_text(text)
    base, tip = (f"L{i}" for i in rng.choice(n, 2, replace=False))
    model = yourdfpy.URDF.load(str(path), load_meshes=False)
    chain = [model.joint_map[name] for name in yourdfpy_chain(model, base, tip)]
    moving = [joint for joint in chain if joint.type != "fixed"]
    if not moving or any(joint.mimic for joint in moving):
        with pytest.raises(InputError, match="mimics joint 'j1'" if moving else "no moving joint"):
            read_urdf(path, base_link=base, tip_link=tip)
        return
    robot = read_urdf(path, base_link=base, tip_link=tip)
    limits = [
        (j.limit.lower or 0.0, j.limit.upper or 0.0) if j.limit and j.type != "continuous" else (0.0, 0.0)
        for j in moving
    ]
    assert robot.joints == tuple(
        Joint(joint.name, joint.type == "prismatic", *(limit if any(limit) else ()))
        for joint, limit in zip(moving, limits, strict=True)
    )
    q = rng.uniform(-2, 2, len(moving))
    (expected,) = yourdfpy_poses(path, base, tip, [j.name for j in moving], [q])
    assert tool_pose(robot, q) == pytest.approx(expected, abs=rounding(float(n)))


def changed(old, new):
    assert old in TREE
    return TREE.replace(old, new)


ALL = "one of " + ", ".join(LINKS)
MISTAKES = [
    ("<html/>", {}, "torso.urdf: root element <html>, expected <robot>"),
    (TREE, {"base_link": "nowhere"}, f"torso.urdf: no link 'nowhere', expected {ALL}"),
    (changed("</robot>", '<link name="island"/></robot>'), {"base_link": "island", "tip_link": "left_tip"},
     "torso.urdf: links 'island' and 'left_tip' are not connected, expected two links of one tree"),
    (changed('<origin xyz="0.3 0 0.1"', '<orign xyz="0.3 0 0.1"'), {"tip_link": "left_tip"},
     "torso.urdf: joint 'l2': element <orign>; did you mean origin?"),
    (changed('<origin xyz="0.3 0 0.1"', '<origin/><origin xyz="0.3 0 0.1"'), {"tip_link": "left_tip"},
     "torso.urdf: joint 'l2': two elements <origin>, expected one"),
    (TREE, {"tip_link": "left_tip", "estimate": ["zeros"]},
     "torso.urdf: joint 'l3': a slide, with estimate: zeros, expected joints that turn; `fg-calib export --to yaml` "
     "writes the arm as rows of dh-hayati, whose d is the zero of a slide"),
    (changed("</robot>", "<xacro:arm/></robot>"), {},
     "torso.urdf:26: not XML: Namespace prefix xacro on arm is not defined, line 26, column 11; "
     "it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "links", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(tmp_path, text, links, message):
    path = tmp_path / "torso.urdf"
    path.write_text(text)
    assert refusal(read_urdf, path, **links) == message


@pytest.mark.parametrize(
    ("declared", "used"),
    [('<!ENTITY a "&b;"><!ENTITY b "&a;">', '<link name="&a;"/>'), ('<!ENTITY a SYSTEM "secret">', "&a;"), ("", "&a;")],
)
def test_entities_are_refused_in_one_line(tmp_path, declared, used):
    path = tmp_path / "torso.urdf"
    path.write_text(f"<!DOCTYPE robot [{declared}]>" + TREE.partition("\n")[2].replace("</robot>", f"{used}</robot>"))
    with pytest.raises(InputError, match=r"^torso\.urdf:.*, expected a URDF without entities: they are not expanded$"):
        read_urdf(path, tip_link="left_tip")
