"""What ROS and Tesseract read: kinematics for `ur_description`, and joint origins for Tesseract.

ur_description's xacro, which `kinematics` below parameterises, is this chain (ur_macro.xacro):

    base_link . Rz(pi) . O1 Rz(q1) . O2 Rz(q2) ... O6 Rz(q6) = wrist_3_link = tool0

with O1 (shoulder) to O6 (wrist_3) from the file, as x y z and Rz(yaw) Ry(pitch) Rx(roll). Its `base` is
base_link . Rz(pi), which the controller calls Base; `flange` and `tool0` follow wrist_3_link by constants that cancel.
So with the base frame at `base`,

    O1 = base . Z1,   O_i = X_(i-1) Z_i,   tool0_T_tool = X6 . tool

where Z = Rz(theta) Tz(d) and X = Tx(a) Rx(alpha) Ry(beta) are the rows of the arm in Hayati's convention (`tables`),
which holds every arm. Those of a UR as drawn give the frames of ur_description's own default_kinematics.yaml, so that
meshes stand where they belong. What is behind joint 6 has no place in the file.

References:
    ros-industrial/universal_robot, UniversalRobots/Universal_Robots_ROS2_Description: ur_macro.xacro, ur_common.xacro.
    UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration: calibration.cpp, calibration_consumer.cpp.
    tesseract-robotics/tesseract, pull request 703; tesseract_common/yaml_utils.h, tesseract_srdf/configs.cpp.
"""

from __future__ import annotations

from hashlib import sha256
from typing import Any, Literal

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from fg_calib.exports.dh import in_table, row_transform, transform
from fg_calib.exports.urdf import frame_matrix, urdf_joints
from fg_calib.inputs import Floats, InputError
from fg_calib.robot import FRAME_KINDS, Robot, frame_values

UrBase = Literal["base", "base_link"]

UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


def ur_base_of(robot: Robot) -> UrBase:
    """Which frame of ur_description an arm's base is: that of its URDF if this is called base_link, else `base`."""
    return "base_link" if robot.urdf is not None and robot.urdf.base_link.endswith("base_link") else "base"


def ur_kinematics(robot: Robot, base: UrBase) -> tuple[dict[str, dict[str, float]], Floats]:
    """The `kinematics` of ur_description, without its hash, and tool0_T_tool, shape (4, 4).

    Args:
        robot: The calibrated arm.
        base: Which frame of ur_description its base is.

    Raises:
        InputError: It has not six joints that turn.
    """
    slides = sum(joint.prismatic for joint in robot.joints)
    if robot.n_joints != len(UR_LINKS) or slides:
        found = f"{robot.n_joints} joints, {slides} of which slide"
        raise InputError(robot.name, found, "six joints that turn, as ur_description has")
    arm = in_table(robot, "dh-hayati").robot
    kinematics = {}
    before = _frame_of(arm, "base")
    if base == "base_link":
        before = transform(theta=-np.pi) @ before
    for i, name in enumerate(UR_LINKS):
        row = {arm.parameters[k].kind: arm.parameters[k].nominal for k in arm.owned_by(i + 1)}
        origin = frame_values(name, before @ transform(theta=row["theta"], d=row["d"]))
        kinematics[name] = {kind: float(origin[kind]) for kind in ("x", "y", "z", "roll", "pitch", "yaw")}
        before = row_transform("dh-hayati", row | {"theta": 0.0, "d": 0.0})
    return kinematics, before @ _frame_of(arm, "tool")


def _frame_of(robot: Robot, name: str) -> Floats:
    values = {p.name: p.nominal for p in robot.parameters}
    return frame_matrix({kind: values[f"{name}.{kind}"] for kind in FRAME_KINDS})


def hash_of(kinematics: dict[str, dict[str, float]]) -> str:
    """A word for kinematics that no controller says of its own: the driver then says that they differ."""
    return f"fg_calib_{sha256(repr(kinematics).encode()).hexdigest()[:16]}"


def ur_text(kinematics: dict[str, dict[str, float]], word: str) -> str:
    """What ur_description's `kinematics_parameters_file` holds."""
    return dumped({"kinematics": {**kinematics, "hash": word}})


def tesseract_text(robot: Robot) -> tuple[str, tuple[str, ...]]:
    """Tesseract's calibration of joint origins, and the joints that it is of.

    Those of the chain in the URDF that the arm came from; of another arm those in the URDF that `export` makes of it.

    Raises:
        InputError: A joint's value is more than its reading plus a constant.
    """
    if robot.urdf is not None:
        origins = {joint.name: _frame_of(robot, joint.name) for joint in robot.joints}
    else:
        origins = {joint.name: joint.origin for joint in urdf_joints(robot)}
    joints = {}
    for name, T in origins.items():
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
        position = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
        joints[name] = {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return dumped({"calibration": {"joints": joints}}), tuple(origins)


def dumped(document: dict[str, Any]) -> str:
    """A document as YAML, floats at full precision, in the order given."""
    return str(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=1000))
