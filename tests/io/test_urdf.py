"""URDF: chains against yourdfpy's own forward kinematics, origins written back, and one message a mistake."""

import math
import re

import numpy as np
import pytest
import yourdfpy
from exported import TREE, yourdfpy_poses
from lxml import etree
from oracle import tool_pose
from refusals import refusal
from simulated import with_changes
from tolerances import rounding

from fg_calib.inputs import InputError
from fg_calib.io.robot_file import read_robot, read_urdf, write_robot, write_urdf
from fg_calib.robot.model import Joint


@pytest.fixture
def tree(tmp_path):
    path = tmp_path / "column.urdf"
    path.write_text(TREE)
    return path


def test_changed_parameters_of_a_reversed_chain_are_those_of_the_file(tree, tmp_path):
    robot = read_urdf(tree, base_link="tip", tip_link="gate")
    rng = np.random.default_rng(2)
    own = np.array([1 <= p.owner <= 6 for p in robot.parameters])
    changed = robot.with_values(robot.nominal + own * rng.uniform(-0.1, 0.1, len(own)))
    out = tmp_path / "calibrated.urdf"
    write_urdf(out, changed)
    q = {"tilt": 0.4, "roll": -1.1, "swivel": 0.9, "turn": -0.7, "lift": 0.3, "gate": 2.0}
    (expected,) = yourdfpy_poses(out, "tip", "gate", list(q), [list(q.values())])
    assert tool_pose(changed, list(q.values())) == pytest.approx(expected, abs=rounding(1.0))
    back = read_urdf(out, base_link="tip", tip_link="gate")
    assert back.parameters == changed.parameters  # exactly
    assert np.abs(tool_pose(robot, list(q.values())) - expected).max() > 1e-3


def test_only_origins_of_moving_joints_are_rewritten(tree, tmp_path):
    robot = read_urdf(tree, base_link="tip", tip_link="gate")
    write_urdf(tmp_path / "out.urdf", with_changes(robot, **{"gate.z": 0.1, "turn.yaw": 1 / 3}))
    expected = (
        TREE.replace('<joint name="gate" type="continuous">\n    ', '<joint name="gate" type="continuous">\n    '
                 '<origin xyz="0.0 0.0 0.1"/>\n    ')
        .replace('<origin xyz="0 0 0.1"/>', '<origin xyz="0 0 0.1" rpy="0.0 0.0 0.3333333333333333"/>')
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
        "urdf: ../column.urdf\nbase_link: floor\ntip_link: tip\ntool: {z: 100, yaw: 90}\nfixed: [lift.x]\n"
        "estimate: [tool.z]\nunits: {length: mm, angle: deg}\ntolerance: {x: 2, roll: 1, tool: 5, turn.yaw: 3}\n"
    )
    robot = read_robot(path)
    assert (robot.name, robot.urdf.tip_link) == ("column", "tip")
    by_name = {p.name: p for p in robot.parameters}
    assert by_name["tool.z"].nominal == pytest.approx(0.1)
    assert by_name["tool.yaw"].nominal == pytest.approx(math.pi / 2)
    assert not by_name["lift.x"].estimated
    assert by_name["tool.z"].estimated
    assert by_name["turn.x"].tolerance == pytest.approx(2e-3)
    assert by_name["turn.roll"].tolerance == pytest.approx(math.radians(1))
    assert by_name["turn.yaw"].tolerance == pytest.approx(math.radians(3))
    assert read_robot(path, tip_link="wrist").urdf.tip_link == "wrist"

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


ALL = "one of " + ", ".join(re.findall(r'<link name="(\w+)"', TREE))
MISTAKES = [
    ("<html/>", {}, "column.urdf: root element <html>, expected <robot>"),
    (TREE, {"base_link": "nowhere"}, f"column.urdf: no link 'nowhere', expected {ALL}"),
    (changed("</robot>", '<link name="island"/></robot>'), {"base_link": "island", "tip_link": "tip"},
     "column.urdf: links 'island' and 'tip' are not connected, expected two links of one tree"),
    (changed('<origin xyz="0 0 0.05"', '<orign xyz="0 0 0.05"'), {"tip_link": "tip"},
     "column.urdf: joint 'flange_fixed': element <orign>; did you mean origin?"),
    (changed('<origin xyz="0 0 0.05"', '<origin/><origin xyz="0 0 0.05"'), {"tip_link": "tip"},
     "column.urdf: joint 'flange_fixed': two elements <origin>, expected one"),
    (TREE, {"tip_link": "tip", "estimate": ["zeros"]},
     "column.urdf: joint 'lift': a slide, with estimate: zeros, expected joints that turn; `fg-calib export --to yaml` "
     "writes the arm as rows of dh-hayati, whose d is the zero of a slide"),
    (changed("</robot>", "<xacro:arm/></robot>"), {},
     "column.urdf:30: not XML: Namespace prefix xacro on arm is not defined, line 30, column 11; "
     "it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "links", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(tmp_path, text, links, message):
    path = tmp_path / "column.urdf"
    path.write_text(text)
    assert refusal(read_urdf, path, **links) == message


@pytest.mark.parametrize(
    ("declared", "used"),
    [('<!ENTITY a "&b;"><!ENTITY b "&a;">', '<link name="&a;"/>'), ('<!ENTITY a SYSTEM "secret">', "&a;"), ("", "&a;")],
)
def test_entities_are_refused_in_one_line(tmp_path, declared, used):
    path = tmp_path / "column.urdf"
    path.write_text(f"<!DOCTYPE robot [{declared}]>" + TREE.partition("\n")[2].replace("</robot>", f"{used}</robot>"))
    with pytest.raises(InputError, match=r"^column\.urdf:.*, expected a URDF without entities: they are not expanded$"):
        read_urdf(path, tip_link="tip")
