"""URDF: the file the arm came from with its calibrated origins, or a new one of nothing but the chain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.exports.dh import Links, inverse, links_of, rigid, transform
from fg_calib.inputs import Floats, InputError
from fg_calib.io import ROUNDING, urdf_text
from fg_calib.robot import FRAME_KINDS, Joint, Robot, frame_of_matrix, frame_values

FARTHEST_SLIDE = 1000.0
"""Limit of a slide without one, [m]: URDF knows no slide without limits."""


@dataclass(frozen=True)
class UrdfJoint:
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


BASE_LINK, FIRST_LINK, TOOL_LINK = "base_link", "link_0", "tool"
"""Links of a new URDF: the base frame, frame 0 and the tool frame; between them stand link_1 to link_n."""


def urdf_joints(robot: Robot) -> list[UrdfJoint]:
    """The joints of a new URDF of an arm, in chain order: base frame, each joint about its z axis, tool frame.

    Raises:
        InputError: A joint's value is more than its reading plus a constant.
    """
    links: Links = links_of(robot)
    names = {joint.name for joint in robot.joints}
    joints = [UrdfJoint(_free("base_frame", names), None, FIRST_LINK, links.base)]
    for i, joint in enumerate(robot.joints):
        joints.append(UrdfJoint(joint.name, joint, f"link_{i + 1}", links.between[i]))
    return [*joints, UrdfJoint(_free("tool_frame", names), None, TOOL_LINK, links.between[-1] @ links.tool)]


def _free(name: str, taken: set[str]) -> str:
    """A name that is not taken."""
    while name in taken:
        name += "_"
    return name


def new_urdf(robot: Robot, comments: Sequence[str]) -> str:
    """A URDF of nothing but the chain, with the forward kinematics of an arm.

    Args:
        robot: The arm.
        comments: To stand at its top, a line each.

    Raises:
        InputError: A name has letters that XML cannot hold.
    """
    from lxml import etree

    def numbers(figures: Sequence[float]) -> str:
        return " ".join(repr(float(figure)) for figure in figures)

    try:
        root = etree.Element("robot", name=robot.name)
        etree.SubElement(root, "link", name=BASE_LINK)
        parent = BASE_LINK
        for joint in urdf_joints(robot):
            etree.SubElement(root, "link", name=joint.child)
            kind = "fixed" if joint.moving is None else _type(joint.moving)
            element = etree.SubElement(root, "joint", name=joint.name, type=kind)
            origin = frame_values("origin", joint.origin)
            xyz, rpy = (numbers([origin[kind] for kind in kinds]) for kinds in ("xyz", ("roll", "pitch", "yaw")))
            etree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
            etree.SubElement(element, "parent", link=parent)
            etree.SubElement(element, "child", link=joint.child)
            if joint.moving is not None:
                etree.SubElement(element, "axis", xyz="0 0 1")
                for limit in _limit(joint.moving):
                    etree.SubElement(element, "limit", limit)
            parent = joint.child
    except ValueError:
        hint = "rename robot or joint"
        raise InputError(robot.name, "a name with letters that XML cannot hold", "printable names", hint) from None
    etree.indent(root)
    lines = [f"<!-- {comment.replace('--', '- -')} -->" for comment in comments]
    return "\n".join(['<?xml version="1.0"?>', *lines, etree.tostring(root, encoding="unicode"), ""])


def _type(joint: Joint) -> str:
    if joint.prismatic:
        return "prismatic"
    return "revolute" if np.isfinite([joint.lower, joint.upper]).all() else "continuous"


def _limit(joint: Joint) -> list[dict[str, str]]:
    """The attributes of a joint's `<limit>`, where it has one; nobody has said what effort and velocity it allows."""
    if _type(joint) == "continuous":
        return []
    farthest = FARTHEST_SLIDE if joint.prismatic else np.inf
    lower, upper = (repr(float(np.clip(end, -farthest, farthest))) for end in (joint.lower, joint.upper))
    return [{"lower": lower, "upper": upper, "effort": "0", "velocity": "0"}]


def zeros_of_origins(nominal: Robot, calibrated: Robot) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """What of the corrections of a URDF's origins is one of joint zeros, and the origins with all but that.

    With C = O^-1 O' the correction of an origin, O' the calibrated one, the turn about the joint's axis in it is split
    off: O' J(q) = (O' J(zero)^-1) J(q + zero). Of a turn C with the quaternion (w, v) it is 2 atan2(v.axis, w); of a
    slide the shift along its axis.

    Args:
        nominal: The arm as drawn, of a URDF.
        calibrated: The same arm calibrated.

    Returns:
        Zeros by joint, [rad] or [m], and origins by joint and kind.
    """
    zeros: dict[str, float] = {}
    origins: dict[str, dict[str, float]] = {}
    for i, joint in enumerate(calibrated.joints):
        drawn, found = _origin(nominal, joint), _origin(calibrated, joint)
        zeros[joint.name], origins[joint.name] = 0.0, found
        if all(abs(drawn[kind] - found[kind]) <= ROUNDING for kind in drawn):
            continue
        before, after = frame_matrix(drawn), frame_matrix(found)
        axis = _axis(calibrated, i)
        C = inverse(before) @ after
        if joint.prismatic:
            zero = float(axis @ C[:3, 3])
            motion = rigid(np.eye(3), zero * axis)
        else:
            x, y, z, w = Rotation.from_matrix(C[:3, :3]).as_quat(canonical=True)
            zero = float(2.0 * np.arctan2(np.array([x, y, z]) @ axis, w))
            motion = rigid(Rotation.from_rotvec(zero * axis).as_matrix(), np.zeros(3))
        rest = after @ inverse(motion)
        zeros[joint.name] = zero
        origins[joint.name] = frame_of_matrix(rest)
    return zeros, origins


def _origin(robot: Robot, joint: Joint) -> dict[str, float]:
    """x, y, z, yaw, pitch and roll of a joint's origin."""
    values = {p.name: p.nominal for p in robot.parameters}
    return {kind: values[f"{joint.name}.{kind}"] for kind in FRAME_KINDS}


def frame_matrix(values: Mapping[str, float]) -> Floats:
    """A frame from its values by kind, shape (4, 4)."""
    return transform(**{kind: values.get(kind, 0.0) for kind in FRAME_KINDS})


def _axis(robot: Robot, index: int) -> Floats:
    """The axis of a URDF's joint in its own frame, in the sense of the URDF, shape (3,)."""
    at = next(i for i, e in enumerate(robot.elements) if e.joint == index)
    yaw, pitch = robot.elements[at - 2], robot.elements[at - 1]  # constants that turn z onto the axis
    return transform(yaw=yaw.constant, pitch=pitch.constant)[:3, 2]


def calibrated_urdf(robot: Robot, nominal: Robot | None) -> str:
    """The URDF that an arm came from, calibrated; nothing but origins differs.

    Args:
        robot: The calibrated arm.
        nominal: The arm as drawn, where corrections of joint zeros are to stand in `<calibration>`; else None.
    """
    text = "" if robot.urdf is None else robot.urdf.text
    if nominal is None:
        return urdf_text(text, {joint.name: _origin(robot, joint) for joint in robot.joints})
    zeros, origins = zeros_of_origins(nominal, robot)
    return urdf_text(text, origins, zeros)
