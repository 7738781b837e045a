"""URDF: the chain between any two links of the file, and its calibrated origins written back.

Of each joint its type, parent, child, origin, axis, limit and mimic are read; meshes, inertias and whatever else a URDF
may hold are not. Calibrated origins are written into the same XML, so that everything else stays as it was.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.inputs import LEAST_SIZE, MOST_SIZE, NEAR, InputError, checked, did_you_mean, known_names
from fg_calib.io.atomic import decoded, read_bytes, write_text
from fg_calib.io.yaml import shown
from fg_calib.robot import FRAME_KINDS, IN_RAD, MOST_ANGLE, Joint, Robot, RobotBuilder, UrdfSource, frame_values

if TYPE_CHECKING:  # lxml is imported where it is used: `fg-calib --help` need not wait for it
    from lxml.etree import _Element as Element

_log = logging.getLogger(__name__)

_ORIGIN = {"xyz": ("x", "y", "z"), "rpy": ("roll", "pitch", "yaw")}
"""The attributes of `<origin>` and the kinds of parameters that they hold."""

ROUNDING = 1e-13
"""Change of an origin's figure, [m] and [rad], that is rounding of the solution: parameters that nothing moves."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)

_NO_ENTITIES = "a URDF without entities: they are not expanded"


@dataclass(frozen=True)
class _UrdfJoint:
    """A joint as the file has it; its axis, limit and mimic matter only on the chain and are read there."""

    element: Element
    name: str
    parent: str
    child: str
    origin: Mapping[str, float]
    """By kind, [m] and [rad]."""


@checked
def read_urdf(
    path: Path | str,
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    name: str | None = None,
    base: Mapping[str, float] | ArrayLike | None = None,
    tool: Mapping[str, float] | ArrayLike | None = None,
    fixed: Sequence[str] = (),
    estimate: Sequence[str] = (),
    tolerance: Mapping[str, float] | None = None,
    place: str | None = None,
) -> Robot:
    """The chain from one link of a URDF to another, up and down the tree.

    Fixed joints become constants. A joint that the chain passes from child to parent is inverted; its parameters and
    its reading stay those of the joint itself.

    Args:
        path: The URDF.
        base_link: Where the chain starts; default: the root link.
        tip_link: Where it ends; default: the only leaf link below the start.
        name: The robot's name; default: the URDF's.
        base: The frame before `base_link`: values by kind, or as in `Robot.from_dh`, [m] and [rad].
        tool: The frame behind `tip_link`, likewise.
        fixed: See `RobotBuilder.build`.
        estimate: See `RobotBuilder.build`.
        tolerance: See `RobotBuilder.build`, [m] or [rad].
        place: The file that `fixed`, `estimate` and `tolerance` come from, for messages.

    Raises:
        InputError: There is no such file, it is not a URDF, or the chain is not one of revolute, continuous,
            prismatic and fixed joints.
    """
    if str(path).lstrip().startswith("<"):
        raise InputError("path", "found XML text", "the path of a URDF", "write the text to a file")
    path = Path(path)
    text, root = _parse(read_bytes(path), path.name)
    builder = RobotBuilder(name or root.get("name") or path.stem, "urdf")
    builder.add_frame("base", frame_values("base", base), 0, False)
    try:
        links = [link.get("name", "") for link in root.findall("link")]
        tree = _Tree(_read_joints(root, path.name), links, path.name)
        base_link = tree.root() if base_link is None else tree.known(base_link)
        tip_link = tree.leaf(base_link) if tip_link is None else tree.known(tip_link)
        n_joints = _add_chain(builder, tree.chain(base_link, tip_link), path.name)
        if n_joints == 0:
            raise InputError(path.name, f"no moving joint between links {base_link!r} and {tip_link!r}", "at least one")
    except InputError as error:  # elements of xacro may hold what is missing
        hint = _XACRO if any("xacro" in str(element.tag) for element in root.iter()) else error.hint
        raise InputError(error.place, error.found, error.expected, hint) from None
    builder.add_frame("tool", frame_values("tool", tool), n_joints + 1, False)
    return builder.build(
        fixed=fixed,
        estimate=estimate,
        tolerance=tolerance,
        urdf=UrdfSource(text, base_link, tip_link),
        place=place or path.name,
    )


_XACRO = "it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`"


def _add_chain(builder: RobotBuilder, chain: Iterable[tuple[_UrdfJoint, bool]], place: str) -> int:
    """Add the joints of a chain, each with whether it is passed backwards; the number of those that move."""
    n_joints = 0
    for joint, backwards in chain:
        here = f"{place}: joint {joint.name!r}"
        if joint.element.get("type") == "fixed":
            builder.add_constant_frame(joint.origin, backwards=backwards)
            continue
        builder.add_urdf_joint(_moving_joint(joint, here), joint.origin, _axis(joint, here), backwards=backwards)
        n_joints += 1
    return n_joints


def write_urdf(path: Path | str, robot: Robot) -> None:
    """Write the URDF the robot was read from with the origins of its moving joints at the nominal values, in UTF-8.

    Other elements and comments stay: see `urdf_text`. A URDF has no place for base and tool: `write_robot` writes
    them to a file of its own.

    Raises:
        InputError: The folder does not exist or may not be written to.
        ValueError: The robot was not read from a URDF.
    """
    if robot.urdf is None:
        raise ValueError("the robot was not read from a URDF")
    write_text(Path(path), urdf_text(robot.urdf.text, joint_origins(robot)))


def joint_origins(robot: Robot) -> dict[str, dict[str, float]]:
    """Nominal origins of the joints of a robot from a URDF, by joint and kind, [m] and [rad]."""
    values = {p.name: p.nominal for p in robot.parameters}
    return {j.name: {kind: values[f"{j.name}.{kind}"] for kind in FRAME_KINDS} for j in robot.joints}


def urdf_text(text: str, origins: Mapping[str, Mapping[str, float]]) -> str:
    """A URDF with other origins of some joints; comments and other elements stay.

    A number of `<origin>` that is the one wanted but for `ROUNDING` stays, an attribute of such numbers as written.

    Args:
        text: The URDF, as it was read.
        origins: By joint x, y, z, roll, pitch and yaw, [m] and [rad].
    """
    from lxml import etree

    root = etree.fromstring(text, etree.XMLParser(**_SAFE))
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name in origins:
            _set(joint, "origin", {key: [origins[name][kind] for kind in kinds] for key, kinds in _ORIGIN.items()})
    return f'<?xml version="1.0"?>\n{etree.tostring(root.getroottree(), encoding="unicode")}\n'


def _set(joint: Element, tag: str, wanted: Mapping[str, Sequence[float]]) -> None:
    """Give a joint's element attributes with these numbers; 0 is what a missing one means."""
    element = joint.find(tag)
    for name, numbers in wanted.items():
        given = None if element is None else element.get(name)
        read = [0.0] * len(numbers) if given is None else _figures(given)
        if len(read) == len(numbers) and max(abs(a - b) for a, b in zip(read, numbers, strict=True)) <= ROUNDING:
            continue
        if element is None:
            element = joint.makeelement(tag)
            element.tail = joint.text
            joint.insert(0, element)
        element.set(name, " ".join(repr(float(number)) for number in numbers))


_SAFE: Mapping[str, Any] = {"resolve_entities": False, "load_dtd": False, "no_network": True}
"""Options of lxml's parser: neither entities nor other files are read."""


def _parse(data: bytes, place: str) -> tuple[str, Element]:
    """The text, without its declaration, and the root element of an XML file without entities and other files."""
    from lxml import etree

    try:
        root = etree.fromstring(data, etree.XMLParser(**_SAFE))
    except etree.XMLSyntaxError as error:
        expected = _NO_ENTITIES if "entity" in error.msg.lower() else ""
        hint = _XACRO if "xacro" in error.msg else ""
        if b"encoding" not in data[:100]:
            decoded(data, place)  # says of other encodings what they are
        found = f"not XML: {error.msg.replace(', use XML_PARSE_HUGE option', '')}"
        raise InputError(f"{place}:{error.lineno}", found, expected, hint) from None
    types: Any = root.getroottree().docinfo.internalDTD
    if types is not None and (types.system_url or types.entities()):
        raise InputError(place, "a <!DOCTYPE> with entities or of another file", _NO_ENTITIES)
    if root.tag != "robot":
        raise InputError(place, f"root element <{root.tag}>", "<robot>")
    return etree.tostring(root.getroottree(), encoding="unicode"), root


def _read_joints(root: Element, place: str) -> list[_UrdfJoint]:
    """All joints, each with a name of its own, an origin, a parent and a child."""
    joints: dict[str, _UrdfJoint] = {}
    for joint in root.findall("joint"):
        name, links = joint.get("name"), []
        here = f"{place}:{joint.sourceline}: joint {name!r}"
        if not name:
            raise InputError(f"{place}:{joint.sourceline}", "a joint without a name")
        if name in joints:
            raise InputError(here, "a second joint of this name", "different names")
        for end in ("parent", "child"):
            links.append(_attribute(joint, end, "link", ""))
            if not links[-1]:
                raise InputError(here, f"no <{end}>", f'<{end} link="..."/>')
        joints[name] = _UrdfJoint(joint, name, links[0], links[1], _origin(joint, here))
    return list(joints.values())


def _origin(joint: Element, place: str) -> dict[str, float]:
    xyz, rpy = (_numbers(joint, "origin", name, "0 0 0", place) for name in _ORIGIN)
    if max(map(abs, rpy)) > MOST_ANGLE:
        raise InputError(f"{place}: origin rpy", f"found {rpy}", IN_RAD, "are they in deg?")
    return dict(zip((*_ORIGIN["xyz"], *_ORIGIN["rpy"]), (*xyz, *rpy), strict=True))


def _attribute(joint: Element, child: str, attribute: str, default: str) -> str:
    """An attribute of a joint's first child of some name; `default` where either is missing."""
    element = joint.find(child)
    return default if element is None else element.get(attribute, default)


def _numbers(joint: Element, child: str, attribute: str, default: str, place: str) -> list[float]:
    """An attribute of as many numbers as its default; only limits may be infinite.

    Raises:
        InputError: It holds something else.
    """
    text, n = _attribute(joint, child, attribute, default), len(default.split())
    numbers = _figures(text)
    if len(numbers) != n or any(abs(one) > MOST_SIZE and not (child == "limit" and np.isinf(one)) for one in numbers):
        expected = f"{n} number{'s' * (n > 1)}, finite and no larger than {MOST_SIZE:g}"
        raise InputError(f"{place}: {child} {attribute}", f"found {shown(text)}", expected)
    return numbers


def _figures(text: str) -> list[float]:
    """The numbers in a text; none if a word of it is none as other readers have them (`1_000` is Python's alone)."""
    words = text.split()
    return [float(word) for word in words] if all(_NUMBER.fullmatch(word) for word in words) else []


def _moving_joint(joint: _UrdfJoint, place: str) -> Joint:
    """The joint with its limits; URDF's missing limit is 0, and two zeros are none at all."""
    kind, mimic = joint.element.get("type"), joint.element.find("mimic")
    if kind not in {"revolute", "continuous", "prismatic"}:
        raise InputError(place, f"type {shown(kind)}", "revolute, continuous, prismatic or fixed on the chain")
    if mimic is not None:
        found = f"mimics joint {shown(mimic.get('joint', ''))}"
        raise InputError(place, found, "joints on the chain that move by themselves")
    (lower,), (upper,) = (_numbers(joint.element, "limit", end, "0", place) for end in ("lower", "upper"))
    if kind == "continuous" or lower == upper == 0.0:
        return Joint(joint.name, kind == "prismatic")
    if not lower < upper:
        raise InputError(f"{place}: limit", f"lower {lower:g}, upper {upper:g}", "lower below upper")
    return Joint(joint.name, kind == "prismatic", lower, upper)


def _axis(joint: _UrdfJoint, place: str) -> NDArray[np.float64]:
    """The joint's unit axis, shape (3,); x where the file says none."""
    axis = np.array(_numbers(joint.element, "axis", "xyz", "1 0 0", place))
    length = math.hypot(*axis)
    if length < LEAST_SIZE:
        raise InputError(f"{place}: axis", f"found {axis.tolist()}", "a direction of three numbers")
    return axis / length


class _Tree:
    """The links of a URDF and the joints between them."""

    def __init__(self, joints: Sequence[_UrdfJoint], links: Sequence[str], place: str) -> None:
        self._place = place
        self._links = list(dict.fromkeys([*links, *(link for j in joints for link in (j.parent, j.child))]))
        self._above: dict[str, _UrdfJoint] = {}  # by child link
        for joint in joints:
            if (first := self._above.setdefault(joint.child, joint)) is not joint:
                found = f"link {joint.child!r} is the child of joints {first.name!r} and {joint.name!r}"
                raise InputError(place, found, "one")

    def known(self, link: str) -> str:
        """`link`, if there is such a link."""
        if link not in self._links:
            hint = did_you_mean(link, self._links, NEAR)
            raise InputError(self._place, f"no link {link!r}", known_names(self._links, 40), hint)
        return link

    def root(self) -> str:
        """The only link without a parent."""
        if not self._links:
            raise InputError(self._place, "no links and joints", "<link> and <joint> within <robot>")
        return self._only([link for link in self._links if self._up(link) == [link]], "root", "base_link")

    def leaf(self, base: str) -> str:
        """The only link without a child at or below `base`."""
        parents = {joint.parent for joint in self._above.values()}
        leaves = [link for link in self._links if link not in parents and base in self._up(link)]
        return self._only(leaves, "leaf", "tip_link")

    def chain(self, base: str, tip: str) -> list[tuple[_UrdfJoint, bool]]:
        """The joints from `base` to `tip`, with whether each is passed from child to parent."""
        up, down = self._up(base), self._up(tip)
        if up[-1] != down[-1]:
            raise InputError(self._place, f"links {base!r} and {tip!r} are not connected", "two links of one tree")
        there, back = [link for link in up if link not in down], [link for link in down if link not in up]
        return [(self._above[link], True) for link in there] + [(self._above[link], False) for link in reversed(back)]

    def _up(self, link: str) -> list[str]:
        """`link` and the links above it, up to the root."""
        links = [link]
        while links[-1] in self._above:
            links.append(self._above[links[-1]].parent)
            if links[-1] in links[:-1]:
                circle = " below ".join(links[links.index(links[-1]) :])
                raise InputError(self._place, f"links in a circle: {circle}", "a tree of links")
        return links

    def _only(self, found: list[str], what: str, key: str) -> str:
        if len(found) != 1:
            option = f"--{key.replace('_', '-')}"
            hint = f"name one as {key}: {{urdf: {self._place}, {key}: ...}} in a file, {option} of observe"
            raise InputError(self._place, f"{len(found)} {what} links ({', '.join(found)})", "one", hint)
        return found[0]
