"""URDF: the chain between any two links of the file, and its calibrated origins written back.

yourdfpy reads links, axes, limits and mimics. The origins are read from the XML, because yourdfpy turns them into
matrices, from which roll, pitch and yaw cannot be told where pitch is a quarter turn; the calibrated ones are
written into the same XML, so that everything else stays as it was.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.errors import InputError
from fg_calib.files.disk import require_file, write_text
from fg_calib.options import NEAR, did_you_mean, known_names
from fg_calib.robot.model import FRAME_KINDS, Joint, Robot, RobotBuilder, UrdfSource

if TYPE_CHECKING:  # lxml is imported where it is used: `fg-calib --help` need not wait for it
    from lxml.etree import _Element as Element

_ORIGIN = {"xyz": ("x", "y", "z"), "rpy": ("roll", "pitch", "yaw")}
"""The attributes of `<origin>` and the kinds of parameters that they hold."""


def read_urdf(
    path: Path | str,
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    name: str | None = None,
    base: Mapping[str, float] | None = None,
    tool: Mapping[str, float] | None = None,
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
        base: Values of the frame before `base_link`, by kind, [m] and [rad].
        tool: Values of the frame behind `tip_link`, by kind, [m] and [rad].
        fixed: See `RobotBuilder.build`.
        estimate: See `RobotBuilder.build`.
        tolerance: See `RobotBuilder.build`, [m] or [rad].
        place: The file that `fixed`, `estimate` and `tolerance` come from, for messages.

    Raises:
        InputError: There is no such file, it is not a URDF, or the chain is not one of revolute, continuous,
            prismatic and fixed joints.
    """
    path = Path(path)
    require_file(path)
    data = path.read_bytes()
    text, root = _parse(data, path.name)
    origins = _read_origins(root, path.name)
    tree = _Tree(_load(data, path.name).joints, [link.get("name", "") for link in root.findall("link")], path.name)
    base_link = tree.root() if base_link is None else tree.known(base_link)
    tip_link = tree.leaf(base_link) if tip_link is None else tree.known(tip_link)

    builder = RobotBuilder(name or root.get("name") or path.stem, "urdf")
    builder.add_frame("base", base or {}, 0, False)
    n_joints = 0
    for joint, backwards in tree.chain(base_link, tip_link):
        here = f"{path.name}: joint {joint.name!r}"
        if joint.type == "fixed":
            builder.add_constant_frame(origins[joint.name], backwards=backwards)
            continue
        if joint.type not in {"revolute", "continuous", "prismatic"}:
            raise InputError(here, f"type {joint.type}", "revolute, continuous, prismatic or fixed on the chain")
        if joint.mimic is not None:
            raise InputError(here, f"mimics joint {joint.mimic.joint!r}", "joints on the chain that move by themselves")
        builder.add_urdf_joint(_moving_joint(joint, here), origins[joint.name], _axis(joint, here), backwards=backwards)
        n_joints += 1
    if n_joints == 0:
        raise InputError(path.name, f"no moving joint between links {base_link!r} and {tip_link!r}", "at least one")
    builder.add_frame("tool", tool or {}, n_joints + 1, False)
    return builder.build(
        fixed=fixed,
        estimate=estimate,
        tolerance=tolerance,
        urdf=UrdfSource(text, base_link, tip_link),
        place=place or path.name,
    )


def write_urdf(path: Path | str, robot: Robot) -> None:
    """Write the URDF the robot was read from with the origins of its moving joints at the nominal values.

    Everything else is kept: comments, meshes, other joints. A URDF has no place for base and tool: `write_robot`
    writes them beside it.

    Raises:
        InputError: The folder does not exist or may not be written to.
        ValueError: The robot was not read from a URDF.
    """
    from lxml import etree

    if robot.urdf is None:
        raise ValueError("the robot was not read from a URDF")
    _, root = _parse(robot.urdf.text.encode(), robot.name, encoding="utf-8")
    elements = {joint.get("name"): joint for joint in root.findall("joint")}
    values = {p.name: p.nominal for p in robot.parameters}
    for joint in robot.joints:
        _write_origin(elements[joint.name], {kind: values[f"{joint.name}.{kind}"] for kind in FRAME_KINDS})
    # lxml would put the comments before and behind the root on one line with it.
    nodes = [*reversed([*root.itersiblings(preceding=True)]), root, *root.itersiblings()]
    lines = [etree.tostring(node, encoding="unicode", with_tail=False) for node in nodes]
    declaration = ['<?xml version="1.0"?>'] * robot.urdf.text.startswith("<?xml")
    write_text(Path(path), "\n".join([*declaration, *lines, ""]))


def _parse(data: bytes, place: str, encoding: str | None = None) -> tuple[str, Element]:
    """The text and the root element of an XML file."""
    from lxml import etree

    try:
        root = etree.fromstring(data, etree.XMLParser(encoding=encoding))
    except etree.XMLSyntaxError as error:
        raise InputError(f"{place}:{error.lineno}", f"not XML: {error.msg}") from None
    if root.tag != "robot":
        raise InputError(place, f"root element <{root.tag}>", "<robot>")
    return data.decode(root.getroottree().docinfo.encoding or "utf-8").removeprefix("\ufeff"), root


def _load(data: bytes, place: str) -> Any:
    """The robot as yourdfpy reads it, without meshes."""
    import yourdfpy

    try:
        return yourdfpy.URDF.load(io.BytesIO(data), build_scene_graph=False, load_meshes=False).robot
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(place, f"not a URDF: {type(error).__name__}: {error}") from None


def _read_origins(root: Element, place: str) -> dict[str, dict[str, float]]:
    """Each joint's origin by kind, [m] and [rad]; and that each has a name, a parent and a child."""
    origins: dict[str, dict[str, float]] = {}
    for joint in root.findall("joint"):
        name = joint.get("name")
        here = f"{place}:{joint.sourceline}: joint {name!r}"
        if not name:
            raise InputError(f"{place}:{joint.sourceline}", "a joint without a name")
        if name in origins:
            raise InputError(here, "a second joint of this name", "different names")
        for end in ("parent", "child"):
            element = joint.find(end)
            if element is None or not element.get("link"):
                raise InputError(here, f"no <{end}>", f'<{end} link="..."/>')
        origins[name] = _origin(joint, here)
    return origins


def _origin(joint: Element, place: str) -> dict[str, float]:
    element = joint.find("origin")
    values: dict[str, float] = {}
    for attribute, kinds in _ORIGIN.items():
        text = "0 0 0" if element is None else element.get(attribute, "0 0 0")
        try:
            figures = [float(word) for word in text.split()]
        except ValueError:
            figures = []
        if len(figures) != len(kinds) or not np.isfinite(figures).all():
            raise InputError(f"{place}: origin {attribute}", f"found {text!r}", "three finite numbers")
        values |= zip(kinds, figures, strict=True)
    return values


def _write_origin(joint: Element, values: Mapping[str, float]) -> None:
    """Set the origin of a joint, unless it has these values already."""
    from lxml import etree

    if _origin(joint, "") == values:
        return
    element = joint.find("origin")
    if element is None:
        element = etree.Element("origin")
        element.tail = joint.text  # the indentation of the elements that follow
        joint.insert(0, element)
    for attribute, kinds in _ORIGIN.items():
        element.set(attribute, " ".join(repr(float(values[kind])) for kind in kinds))


def _moving_joint(joint: Any, place: str) -> Joint:
    """The joint with its limits; URDF's missing limit is 0, and two zeros are none at all."""
    prismatic = joint.type == "prismatic"
    if joint.type == "continuous" or joint.limit is None:
        return Joint(joint.name, prismatic)
    lower, upper = joint.limit.lower or 0.0, joint.limit.upper or 0.0
    if lower == upper == 0.0:
        return Joint(joint.name, prismatic)
    if not lower < upper:
        raise InputError(f"{place}: limit", f"lower {lower:g}, upper {upper:g}", "lower below upper")
    return Joint(joint.name, prismatic, lower, upper)


def _axis(joint: Any, place: str) -> Any:
    """The joint's unit axis, shape (3,)."""
    axis = np.asarray(joint.axis, dtype=float)
    length = np.linalg.norm(axis)
    if axis.shape != (3,) or not 0.0 < length < np.inf:
        raise InputError(
            f"{place}: axis", f"found {' '.join(f'{v:g}' for v in axis)!r}", "a direction of three numbers"
        )
    return axis / length


class _Tree:
    """The links of a URDF and the joints between them."""

    def __init__(self, joints: Sequence[Any], links: Sequence[str], place: str) -> None:
        self._place = place
        self._links = dict.fromkeys([*links, *(link for j in joints for link in (j.parent, j.child))])
        self._joint_above: dict[str, Any] = {}  # by child link
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
        roots = [link for link in self._links if link not in self._joint_above]
        return self._only(roots, "root", "base_link")

    def leaf(self, base: str) -> str:
        """The only link without a child at or below `base`."""
        parents = {joint.parent for joint in self._joint_above.values()}
        leaves = [link for link in self._links if link not in parents]
        return self._only([leaf for leaf in leaves if base in self._links_up(leaf)], "leaf", "tip_link")

    def chain(self, base: str, tip: str) -> list[tuple[Any, bool]]:
        """The joints from `base` to `tip`, with whether each is passed from child to parent."""
        up, down = self._links_up(base), self._links_up(tip)
        common = next((link for link in up if link in down), None)
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
                raise InputError(self._place, f"link {links[-1]!r} is above itself", "a tree of links")
        return links

    def _only(self, found: list[str], what: str, argument: str) -> str:
        if len(found) != 1:
            listed = ", ".join(found) or "none"
            where = f"{{urdf: {self._place}, {argument}: ...}} in a file, --{argument.replace('_', '-')} of observe"
            raise InputError(
                self._place, f"{len(found)} {what} links ({listed})", "one", f"name one as {argument}: {where}"
            )
        return found[0]
