"""Files for ROS and Tesseract: URDFs, kinematics for `ur_description`, and joint origins for Tesseract.

A URDF is the file that the arm came from with its calibrated origins, or a new one of nothing but the chain.

ur_description's xacro, which `kinematics` below parameterises, is this chain (ur_macro.xacro):

    base_link . Rz(pi) . O1 Rz(q1) . O2 Rz(q2) ... O6 Rz(q6) = wrist_3_link = tool0

with O1 (shoulder) to O6 (wrist_3) from the file, as x y z and Rz(yaw) Ry(pitch) Rx(roll). Its `base` is
base_link . Rz(pi), which the controller calls Base; `flange` and `tool0` follow wrist_3_link by constants that cancel.
So with the base frame at `base`,

    O1 = base . Z1,   O_i = X_(i-1) Z_i,   tool0_T_tool = X6 . tool

where Z = Rz(theta) Tz(d) and X = Tx(a) Rx(alpha) Ry(beta) are the rows of the arm in Hayati's convention (`tables`),
which holds every arm. Those of a nominal UR give the frames of ur_description's own default_kinematics.yaml, so that
meshes stand where they belong. What is behind joint 6 has no place in the file.

References:
    ros-industrial/universal_robot, UniversalRobots/Universal_Robots_ROS2_Description: ur_macro.xacro, ur_common.xacro.
    UniversalRobots/Universal_Robots_ROS2_Driver, ur_calibration: calibration.cpp, calibration_consumer.cpp.
    tesseract-robotics/tesseract, pull request 703; tesseract_common/yaml_utils.h, tesseract_srdf/configs.cpp.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from jinja2 import Template
from scipy.spatial.transform import Rotation

from fg_calib.exports.dh import Links, in_table, links_of, transform
from fg_calib.inputs import Floats, InputError, Record, UrBase, etree, expect
from fg_calib.robot import FRAME_KINDS, Joint, Robot, frame_values

FARTHEST_SLIDE = 1000.0
"""Limit of a slide without one, [m]: URDF knows no slide without limits."""


class UrdfJoint(Record):
    """A joint of a new URDF.

    Attributes:
        name: Its name.
        moving: The joint of the arm; None of a fixed one.
        child: The link behind it; the link before it is that of the joint before.
        origin: Shape (4, 4).
    """

    name: str
    moving: Joint | None
    child: str
    origin: Floats


_TEMPLATE = Path(__file__).with_name("arm.urdf.jinja")

BASE_LINK, FIRST_LINK, TOOL_LINK = "base_link", "link_0", "tool"
"""Links of a new URDF: the base frame, frame 0 and the tool frame; between them stand link_1 to link_n."""


def urdf_joints(robot: Robot) -> list[UrdfJoint]:
    """The joints of a new URDF of an arm, in chain order: base frame, each joint about its z axis, tool frame.

    Raises:
        InputError: A joint's value is more than its reading plus a constant.
    """
    links: Links = links_of(robot)
    moving = [UrdfJoint(joint.name, joint, f"link_{i + 1}", links.between[i]) for i, joint in enumerate(robot.joints)]
    tool = UrdfJoint("tool_frame", None, TOOL_LINK, links.between[-1] @ links.tool)
    return [UrdfJoint("base_frame", None, FIRST_LINK, links.base), *moving, tool]


def new_urdf(robot: Robot, comments: Sequence[str]) -> str:
    """A URDF of nothing but the chain, with the forward kinematics of an arm.

    Args:
        robot: The arm.
        comments: To stand at its top, a line each.

    Raises:
        InputError: A name has letters that XML cannot hold.
    """
    template = Template(_TEMPLATE.read_text("utf-8"), trim_blocks=True, keep_trailing_newline=True)
    functions = {"frame_values": frame_values, "type_and_limit": _type_and_limit, "quoted": quoteattr}
    text = template.render(robot=robot, joints=urdf_joints(robot), comments=comments, **functions)
    try:
        etree.fromstring(text.encode(errors="surrogatepass"))
    except etree.XMLSyntaxError:
        hint = "rename robot or joint"
        raise InputError(robot.name, "a name with letters that XML cannot hold", "printable names", hint) from None
    return text


def _type_and_limit(joint: Joint | None) -> tuple[str, tuple[float, ...]]:
    """A joint's type and its limits if it has any; nobody has said what effort and velocity it allows."""
    if joint is None:
        return "fixed", ()
    if not joint.prismatic and not np.isfinite([joint.lower, joint.upper]).all():
        return "continuous", ()
    farthest = FARTHEST_SLIDE if joint.prismatic else np.inf
    limits = np.clip([joint.lower, joint.upper], -farthest, farthest).tolist()
    return "prismatic" if joint.prismatic else "revolute", tuple(limits)


# --- ROS and Tesseract ------------------------------------------------------------------------------------------------

UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


def ur_kinematics(robot: Robot, base: UrBase) -> tuple[dict[str, dict[str, float]], Floats]:
    """The `kinematics` of ur_description, without its hash, and tool0_T_tool, shape (4, 4).

    Args:
        robot: The calibrated arm.
        base: Which frame of ur_description its base is.

    Raises:
        InputError: The arm has not six revolute joints.
    """
    slides = [joint.prismatic for joint in robot.joints]
    found = f"{robot.n_joints} joints, {sum(slides)} of which slide"
    expect(slides == [False] * len(UR_LINKS), robot.name, found, "six joints that turn, as ur_description has")
    arm = in_table(robot, "dh-hayati").robot
    kinematics = {}
    before = transform(theta=-np.pi if base == "base_link" else 0.0) @ _frame_of(arm, "base")
    for i, name in enumerate(UR_LINKS):
        row = {arm.parameters[k].kind: arm.parameters[k].nominal for k in arm.owned_by(i + 1)}
        kinematics[name] = frame_values(name, before @ transform(theta=row["theta"], d=row["d"]))
        before = transform(a=row["a"], alpha=row["alpha"], beta=row["beta"])
    return kinematics, before @ _frame_of(arm, "tool")


def _frame_of(robot: Robot, name: str) -> Floats:
    values = {p.name: p.nominal for p in robot.parameters}
    return transform(**{kind: values[f"{name}.{kind}"] for kind in FRAME_KINDS})


def tesseract_text(robot: Robot) -> tuple[str, tuple[str, ...]]:
    """Tesseract's calibration of joint origins, and the joints that it is of.

    Those of the chain in the URDF that the arm came from; of another arm those in the URDF that `export` makes of it.

    Raises:
        InputError: A joint's value is more than its reading plus a constant.
    """
    own = {joint.name: _frame_of(robot, joint.name) for joint in robot.joints} if robot.urdf is not None else {}
    origins = own or {joint.name: joint.origin for joint in urdf_joints(robot)}
    joints = {}
    for name, T in origins.items():
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
        position = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
        joints[name] = {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return dumped({"calibration": {"joints": joints}}), tuple(origins)


def dumped(document: dict[str, Any]) -> str:
    """A document as YAML, floats at full precision, in the order given."""
    return str(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=1000))
