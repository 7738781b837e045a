"""Arms of several conventions, nominal and a little off, and what others compute of them."""

import numpy as np

from fg_calib import Robot
from fg_calib.io import read_urdf

UR10 = [[0, np.pi / 2, 0.1273, 0, 0], [-0.612, 0, 0, 0, 0], [-0.5723, 0, 0, 0, 0],
        [0, np.pi / 2, 0.163941, 0, 0], [0, -np.pi / 2, 0.1157, 0, 0], [0, 0, 0.0922, 0, 0]]  # fmt: skip
SEVEN = [[0, 0, 0.333, 0], [0, -np.pi / 2, 0, 0], [0, np.pi / 2, 0.316, 0], [0.0825, np.pi / 2, 0, 0],
         [-0.0825, -np.pi / 2, 0.384, 0], [0, np.pi / 2, 0, 0], [0.088, np.pi / 2, 0.107, 0]]  # fmt: skip
SCARA = [[0.2, 0, 0.4, 0, 0], [0.325, 0, 0, 0, 0], [0.275, np.pi, 0, 0, 0], [0, 0, 0, 0, 0]]
"""The slide is the third: it goes down."""

TREE = """<?xml version='1.0'?>
<!-- a column, an arm on it, a hand; a gate -->
<robot name="column">
  <link name="floor"/><link name="column"/><link name="gate"/><link name="upper"/><link name="lower"/>
  <link name="plate"><visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual></link>
  <link name="wrist"/><link name="flange"/><link name="tip"/><link name="finger"/><link name="thumb"/>
  <joint name="lift" type="prismatic"><origin xyz="0.1 0.2 0.3" rpy="0.1 -0.2 0.3"/>
    <parent link="floor"/><child link="column"/><axis xyz="0.1 -0.2 1"/>
    <limit lower="-0.2" upper="0.8" effort="1" velocity="1"/></joint>
  <joint name="plate_fixed" type="fixed"><origin xyz="0 0.05 0.1" rpy="1.2 0.3 -0.4"/>
    <parent link="column"/><child link="plate"/></joint>
  <joint name="turn" type="continuous"><origin xyz="0 0 0.1"/>
    <parent link="plate"/><child link="upper"/><axis xyz="1 2 -3"/></joint>
  <joint name="swivel" type="revolute"><origin xyz="0.4 0 0" rpy="0 1.5707963267948966 0.2"/>
    <parent link="upper"/><child link="lower"/><axis xyz="0 -1 0"/>
    <limit lower="-2" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="roll" type="continuous"><!-- no axis: x --><origin rpy="0.5 0 0" xyz="0.3 0.02 0"/>
    <parent link="lower"/><child link="wrist"/></joint>
  <joint name="flange_fixed" type="fixed"><origin xyz="0 0 0.05" rpy="0 0 1"/>
    <parent link="wrist"/><child link="flange"/></joint>
  <joint name="tilt" type="revolute"><origin xyz="0.01 0 0.02"/>
    <parent link="flange"/><child link="tip"/><axis xyz="-2 0.5 0.1"/>
    <limit lower="-1.5" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="finger" type="prismatic"><parent link="tip"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.05" effort="1" velocity="1"/></joint>
  <joint name="thumb" type="prismatic"><parent link="tip"/><child link="thumb"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.05" effort="1" velocity="1"/><mimic joint="finger"/></joint>
  <joint name="gate" type="continuous">
    <parent link="floor"/><child link="gate"/><axis xyz="0 0 -1"/></joint>
</robot>
"""


def off(robot, size=5e-4, seed=0, frames=False):
    """The robot with every parameter of its joints off by some 0.5 mm and 0.5 mrad, base and tool too if wanted."""
    own = np.array([frames or 1 <= p.owner <= robot.n_joints for p in robot.parameters])
    return robot.with_values(robot.nominal + own * np.random.default_rng(seed).normal(scale=size, size=len(own)))


def ur10(convention="dh-hayati"):
    rows = [row[: 5 if "hayati" in convention else 4] for row in UR10]
    return Robot.from_dh(rows, convention, name="ur10", tool=[0.01, -0.02, 0.1, 0.1, 0.2, -0.3])


def seven():
    limits = [(-2.9, 2.9)] * 7
    return Robot.from_dh(SEVEN, "mdh", name="seven", limits=limits, tool=[0, 0, 0.2], base=[1, 2, 3, 0.1, 0.2, 0.3])


def scara(last=None):
    types = ["revolute", "revolute", "prismatic", "revolute"]
    limits = [(-2.5, 2.5), (-2.6, 2.6), (0.0, 0.2), last]
    return Robot.from_dh(SCARA, "mdh-hayati", name="scara", types=types, limits=limits, tool=[0.02, 0, 0.05])


def column(folder, backwards=False):
    path = folder / "column.urdf"
    path.write_text(TREE)
    links = {"base_link": "tip", "tip_link": "floor"} if backwards else {"base_link": "floor", "tip_link": "tip"}
    return read_urdf(path, **links)


ARMS = {
    "ur10": lambda _: ur10(),
    "ur10-dh": lambda _: ur10("dh"),
    "seven": lambda _: seven(),
    "scara": lambda _: scara(),
    "column": column,
    "backwards": lambda folder: column(folder, backwards=True),
}


def matrix(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def yourdfpy_poses(path, base, tip, names, readings, origins=None):
    """base_T_tip by yourdfpy, with other origins of some joints, shape (n, 4, 4)."""
    import yourdfpy

    model = yourdfpy.URDF.load(str(path), load_meshes=False)
    for joint in model.robot.joints:
        if joint.axis is not None:
            joint.axis = joint.axis / np.linalg.norm(joint.axis)  # which yourdfpy does not
        joint.origin = (origins or {}).get(joint.name, joint.origin)
    model = yourdfpy.URDF(model.robot, build_scene_graph=True, load_meshes=False)
    found = []
    for row in readings:
        model.update_cfg(dict(zip(names, row, strict=True)))
        found.append(model.get_transform(tip, base))
    return np.array(found)
