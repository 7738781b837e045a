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

from fg_calib.inputs import LEAST_SIZE, MOST_SIZE, NEAR, ORDINARY, InputError, checked, did_you_mean, known_names
from fg_calib.io.atomic import decoded, read_bytes, replacing
from fg_calib.io.yaml import shown, shown_word
from fg_calib.robot import FRAME_KINDS, IN_RAD, MOST_ANGLE, Joint, Robot, RobotBuilder, UrdfSource, frame_values

if TYPE_CHECKING:  # lxml is imported where it is used: `fg-calib --help` need not wait for it
    from lxml.etree import _Element as Element

_log = logging.getLogger(__name__)

_ORIGIN = {"xyz": ("x", "y", "z"), "rpy": ("roll", "pitch", "yaw")}
"""The attributes of `<origin>` and the kinds of parameters that they hold."""

ROUNDING = 1e-13
"""Change of an origin's figure, [m] and [rad], that is rounding of the solution: parameters that nothing moves."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)

_CHILDREN = ("origin", "parent", "child", "axis", "calibration", "dynamics", "limit", "mimic", "safety_controller")
"""Elements of a joint."""

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
    data = read_bytes(path)
    text, root = _parse(data, path.name)
    builder = RobotBuilder(name or root.get("name") or path.stem, "urdf")
    builder.add_frame("base", frame_values("base", base), 0, False)
    try:
        tree = _Tree(_read_joints(root, path.name), _read_links(root, path.name), path.name)
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


def _check_children(joint: _UrdfJoint, place: str) -> None:
    """Raise for a misspelt or doubled element, which a default or the first one would take the place of."""
    tags = [child.tag for child in joint.element if isinstance(child.tag, str)]
    for tag in tags:
        if tag in _CHILDREN and tags.count(tag) > 1:
            raise InputError(place, f"two elements <{tag}>", "one")
        if tag not in _CHILDREN and (hint := did_you_mean(tag, _CHILDREN)):
            raise InputError(place, f"element <{tag}>", hint=hint)


def _add_chain(builder: RobotBuilder, chain: Iterable[tuple[_UrdfJoint, bool]], place: str) -> int:
    """Add the joints of a chain, each with whether it is passed backwards; the number of those that move."""
    n_joints = 0
    for joint, backwards in chain:
        here = f"{place}: joint {joint.name!r}"
        _check_children(joint, here)
        if joint.element.get("type") == "fixed":
            builder.add_constant_frame(joint.origin, backwards=backwards)
            continue
        builder.add_urdf_joint(_moving_joint(joint, here), joint.origin, _axis(joint, here), backwards=backwards)
        n_joints += 1
    return n_joints


def write_urdf(path: Path | str, robot: Robot) -> None:
    """Write the URDF the robot was read from with the origins of its moving joints at the nominal values.

    Other elements and comments stay: see `urdf_text`. A URDF has no place for base and tool: `write_robot` writes
    them beside it.

    Raises:
        InputError: The folder does not exist or may not be written to.
        ValueError: The robot was not read from a URDF.
    """
    if robot.urdf is None:
        raise ValueError("the robot was not read from a URDF")
    values = {p.name: p.nominal for p in robot.parameters}
    origins = {j.name: {kind: values[f"{j.name}.{kind}"] for kind in FRAME_KINDS} for j in robot.joints}
    text = urdf_text(robot.urdf.text, origins)
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(text.encode(encoding_of(text)))


def encoding_of(text: str) -> str:
    """The encoding that an XML text declares; UTF-8 if it declares none."""
    declared = _DECLARATION.match(text)
    return declared[1] if declared and declared[1] else "utf-8"


_DECLARATION = re.compile(r"""\ufeff?<\?xml(?:[^>]*?\sencoding\s*=\s*["']([\w.-]+)["'])?.*?\?>""", re.DOTALL)


def urdf_text(text: str, origins: Mapping[str, Mapping[str, float]], zeros: Mapping[str, float] | None = None) -> str:
    """A URDF with other origins of some joints; comments and other elements stay.

    A number of `<origin>` that is the one wanted but for `ROUNDING` stays, an attribute of such numbers as written.

    Args:
        text: The URDF, as it was read.
        origins: By joint x, y, z, roll, pitch and yaw, [m] and [rad].
        zeros: By joint what is to be added to its reading, [rad] or [m]: it is added to `rising` of the joint's
            `<calibration>`, which it gets if it has none.
    """
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, load_dtd=False, no_network=True)
    root = etree.fromstring(text.encode(encoding_of(text)), parser)
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name in origins:
            _set(joint, "origin", {key: [origins[name][kind] for kind in kinds] for key, kinds in _ORIGIN.items()})
        if zeros is not None and abs(zeros.get(name, 0.0)) > ROUNDING:
            rising = sum(_figures(_attribute(joint, "calibration", "rising", "0")))
            _set(joint, "calibration", {"rising": [rising + zeros[name]]})
    declared = _DECLARATION.match(text)
    return (f"{declared[0]}\n" if declared else "") + str(etree.tostring(root.getroottree(), encoding="unicode")) + "\n"


def _set(joint: Element, tag: str, wanted: Mapping[str, Sequence[float]]) -> None:
    """Give a joint's element attributes with these numbers; 0 is what a missing one means."""
    element = joint.find(tag)
    words, changed = {}, []
    for name, numbers in wanted.items():
        given = None if element is None else element.get(name)
        read = [0.0] * len(numbers) if given is None else _figures(given)
        pairs = zip(read or [math.nan] * len(numbers), numbers, strict=True)
        kept = [was if abs(was - number) <= ROUNDING else float(number) for was, number in pairs]
        words[name] = " ".join(map(repr, kept))
        if kept != read:
            changed.append(name)
    if element is None and changed:
        element = joint.makeelement(tag, dict(words))
        element.tail = joint.text
        joint.insert(0, element)
    for name in changed:
        if element is not None:
            element.set(name, words[name])


def _parse(data: bytes, place: str) -> tuple[str, Element]:
    """The text and the root element of an XML file, which may neither refer to other files nor hold entities."""
    from lxml import etree

    safe = etree.XMLParser(resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False)
    try:
        root = etree.fromstring(data, safe)
    except etree.XMLSyntaxError as error:
        expected = _NO_ENTITIES if "entity" in error.msg.lower() else ""
        hint = _XACRO if "xacro" in error.msg else ""
        if b"encoding" not in data[:100]:
            decoded(data, place)  # says of other encodings what they are
        found = f"not XML: {error.msg.replace(', use XML_PARSE_HUGE option', '')}"
        raise InputError(f"{place}:{error.lineno}", found, expected, hint) from None
    document = root.getroottree().docinfo
    types: Any = document.internalDTD
    if types is not None and (types.system_url or types.entities()):
        raise InputError(place, "a <!DOCTYPE> with entities or of another file", _NO_ENTITIES)
    if root.tag != "robot":
        raise InputError(place, f"root element <{root.tag}>", "<robot>")
    try:
        return data.decode(document.encoding or "utf-8"), root
    except (UnicodeDecodeError, LookupError):  # libxml2 knows more encodings than Python
        raise InputError(place, f"text in {document.encoding}", "text in UTF-8", "save it as UTF-8") from None


def _read_links(root: Element, place: str) -> list[str]:
    links = []
    for link in root.findall("link"):
        if not link.get("name"):
            raise InputError(f"{place}:{link.sourceline}", "a link without a name")
        links.append(link.get("name", ""))
    return links


def _read_joints(root: Element, place: str) -> list[_UrdfJoint]:
    """All joints, each with a name of its own, an origin, a parent and a child."""
    joints: dict[str, _UrdfJoint] = {}
    for joint in root.findall("joint"):
        name = joint.get("name")
        here = f"{place}:{joint.sourceline}: joint {name!r}"
        if not name:
            raise InputError(f"{place}:{joint.sourceline}", "a joint without a name")
        if name in joints:
            raise InputError(here, "a second joint of this name", "different names")
        parent, child = (_link_at(joint, end, here) for end in ("parent", "child"))
        joints[name] = _UrdfJoint(joint, name, parent, child, _origin(joint, here))
    return list(joints.values())


def _link_at(joint: Element, end: str, place: str) -> str:
    """The link that a joint has as `end`: parent or child."""
    element = joint.find(end)
    link = None if element is None else element.get("link")
    if not link:
        raise InputError(place, f"no <{end}>", f'<{end} link="..."/>')
    return link


def _origin(joint: Element, place: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for attribute, kinds in _ORIGIN.items():
        text = _attribute(joint, "origin", attribute, "0 0 0")
        figures = _figures(text)
        if len(figures) != len(kinds) or not np.isfinite(figures).all():
            raise InputError(f"{place}: origin {attribute}", f"found {shown(text)}", "three finite numbers")
        if max(map(abs, figures)) > MOST_SIZE:
            raise InputError(f"{place}: origin {attribute}", f"found {shown(text)}", ORDINARY)
        if attribute == "rpy" and max(map(abs, figures)) > MOST_ANGLE:
            raise InputError(f"{place}: origin rpy", f"found {shown(text)}", IN_RAD, "are they in deg?")
        values |= zip(kinds, figures, strict=True)
    return values


def _attribute(joint: Element, child: str, attribute: str, default: str) -> str:
    """An attribute of a joint's first child of some name; `default` where either is missing."""
    element = joint.find(child)
    return default if element is None else element.get(attribute, default)


def _figures(text: str) -> list[float]:
    """The numbers in a text; none if a word of it is none as other readers have them (`1_000` is Python's alone)."""
    words = text.split()
    return [float(word) for word in words] if all(_NUMBER.fullmatch(word) for word in words) else []


def _moving_joint(joint: _UrdfJoint, place: str) -> Joint:
    """The joint with its limits; URDF's missing limit is 0, and two zeros are none at all."""
    kind, mimic = joint.element.get("type"), joint.element.find("mimic")
    if kind not in {"revolute", "continuous", "prismatic"}:
        found = f"type {shown_word(kind)}" if kind else "no type"
        raise InputError(place, found, "revolute, continuous, prismatic or fixed on the chain")
    if mimic is not None:
        found = f"mimics joint {shown(mimic.get('joint', ''))}"
        raise InputError(place, found, "joints on the chain that move by themselves")
    lower, upper = (0.0, 0.0) if kind == "continuous" else (_limit(joint, end, place) for end in ("lower", "upper"))
    if lower == upper == 0.0:
        return Joint(joint.name, kind == "prismatic")
    if not lower < upper:
        raise InputError(f"{place}: limit", f"lower {lower:g}, upper {upper:g}", "lower below upper")
    return Joint(joint.name, kind == "prismatic", lower, upper)


def _limit(joint: _UrdfJoint, end: str, place: str) -> float:
    text = _attribute(joint.element, "limit", end, "0")
    figures = _figures(text)
    if len(figures) != 1:
        raise InputError(f"{place}: limit {end}", f"found {shown(text)}", "a number")
    if MOST_SIZE < abs(figures[0]) < np.inf:
        raise InputError(f"{place}: limit {end}", f"found {shown(text)}", ORDINARY)
    return figures[0]


def _axis(joint: _UrdfJoint, place: str) -> NDArray[np.float64]:
    """The joint's unit axis, shape (3,); x where the file says none."""
    text = _attribute(joint.element, "axis", "xyz", "1 0 0")
    axis = np.array(_figures(text))
    length = math.hypot(*axis)
    if axis.shape != (3,) or not LEAST_SIZE <= length <= MOST_SIZE:
        raise InputError(f"{place}: axis", f"found {shown(text)}", "a direction of three numbers")
    return axis / length


class _Tree:
    """The links of a URDF and the joints between them."""

    def __init__(self, joints: Sequence[_UrdfJoint], links: Sequence[str], place: str) -> None:
        self._place = place
        self._links = dict.fromkeys([*links, *(link for j in joints for link in (j.parent, j.child))])
        self._joint_above: dict[str, _UrdfJoint] = {}  # by child link
        for joint in joints:
            if joint.child in self._joint_above:
                first = self._joint_above[joint.child].name
                raise InputError(
                    place, f"link {joint.child!r} is the child of joints {first!r} and {joint.name!r}", "one"
                )
            self._joint_above[joint.child] = joint

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
        roots = dict.fromkeys(self._links_up(link)[-1] for link in self._links)
        return self._only(list(roots), "root", "base_link")

    def leaf(self, base: str) -> str:
        """The only link without a child at or below `base`."""
        below: dict[str, list[str]] = {}
        for joint in self._joint_above.values():
            below.setdefault(joint.parent, []).append(joint.child)
        self._links_up(base)  # without end where links are in a circle
        reached = [base]
        for link in reached:
            reached += below.get(link, ())
        return self._only([link for link in reached if link not in below], "leaf", "tip_link")

    def chain(self, base: str, tip: str) -> list[tuple[_UrdfJoint, bool]]:
        """The joints from `base` to `tip`, with whether each is passed from child to parent."""
        up, down = self._links_up(base), self._links_up(tip)
        all_down = set(down)
        common = next((link for link in up if link in all_down), None)
        if common is None:
            raise InputError(self._place, f"links {base!r} and {tip!r} are not connected", "two links of one tree")
        above = self._joint_above
        return [
            *((above[link], True) for link in up[: up.index(common)]),
            *((above[link], False) for link in reversed(down[: down.index(common)])),
        ]

    def _links_up(self, link: str) -> list[str]:
        """`link` and the links above it, up to the root."""
        links = [link]
        while links[-1] in self._joint_above:
            links.append(self._joint_above[links[-1]].parent)
            if links[-1] in links[:-1]:
                circle = " below ".join(map(shown_word, links[links.index(links[-1]) :]))
                raise InputError(self._place, f"links in a circle: {circle}", "a tree of links")
        return links

    def _only(self, found: list[str], what: str, argument: str) -> str:
        if len(found) != 1:
            listed = ", ".join(shown_word(link) for link in found[:12]) + ", ..." * (len(found) > 12)
            where = f"{{urdf: {self._place}, {argument}: ...}} in a file, --{argument.replace('_', '-')} of observe"
            raise InputError(
                self._place, f"{len(found)} {what} links ({listed})", "one", f"name one as {argument}: {where}"
            )
        return found[0]
