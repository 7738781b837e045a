"""Robots in YAML: a DH convention with a row a joint, or a URDF with what it cannot hold itself.

```yaml
name: arm                              urdf: arm.urdf        # relative to this file
convention: mdh                        base_link: base_link  # default: the root link
units: {length: mm, angle: deg}        tip_link: flange      # default: the only leaf link
joints:                                units: {length: mm, angle: deg}
  - {a: 0, alpha: 0, d: 340, theta: 0, limits: [-170, 170]}
  - {a: 0, alpha: -90, d: 0, theta: 0, type: prismatic, name: slide}
```
Rows of `convention: poe` are axes at zero readings, `{axis: [0, 0, 1], point: [0, 0, 340]}`, and `tool` the tool's pose
there; x, y, pitch and roll are how far a calibrated axis is from there, and `sigma` is for people alone.

`convention: cpc` (complete and parametrically continuous) is read as `poe`, with its parameters, effects and priors:

    base_T_tool(q) = base V0 Q1 V1 ... Qn Vn tool,   Q = Rz or Tz(sign q + offset),   V = R(b) Rz(beta) Txyz(l)

V0 is `link0`, and a row `{b: [0, 0, 1], l: [0, 0, 0], beta: 0, sign: 1, offset: 0}` is Q and the V behind it. R(b), the
least rotation, takes z to the next axis, b, drawn so that bz >= 0; `sign` is -1 if that is against the reading. Of a
link to an axis beta and lz are written as 0, of one to a slide l too; Vn has all six. Where R(b) is singular, bz = -1,
no file may be. The point of an axis is the origin of its frame.

Both take `name`, `base`, `tool`, `fixed`, `estimate` and `tolerance` too. Rows without `name` are called q1 to qn.

A URDF's chain is that between any two links. Of each joint its type, parent, child, origin, axis, limit and mimic are
read. Calibrated origins are written into the same XML, so that everything else stays as it was.

References:
    Zhuang, Roth, Hamano (1992), A complete and parametrically continuous kinematic model for robot manipulators. IEEE
    Trans. Robotics and Automation 8(4).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field

from fg_calib import inputs
from fg_calib.inputs import LEAST_SIZE, MOST_SIZE, NEAR, InputError, checked, did_you_mean, etree, expect, listed, shown
from fg_calib.io.atomic import decoded, read_bytes, write_text
from fg_calib.io.effects import effects_mapping, read_effects, select_standard, with_coefficients
from fg_calib.io.yaml import FilePath, Loader, Number, Positive, Schema, Units, UnitsOfFile, read_yaml, validate
from fg_calib.robot import Hinge, Joint, Mass, Parameter, Robot, RobotBuilder, UrdfSource, model, names_of, rotations

_ORIGIN = {"xyz": ("x", "y", "z"), "rpy": ("roll", "pitch", "yaw")}
"""The attributes of `<origin>` and the kinds of parameters that they hold."""

UNIT = 1e-6
"""How far from 1 the length of an axis of `cpc` may be, and how near to -1 its z may not."""

ROUNDING = 1e-13
"""Change of an origin's figure, [m] and [rad], that is rounding of the solution: parameters that nothing moves."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)

_NO_ENTITIES = "a URDF without entities: they are not expanded"


class _UrdfJoint(inputs.Record):
    """A joint as the file has it; its axis, limit and mimic matter only on the chain and are read there."""

    element: etree._Element
    name: str
    parent: str
    child: str
    origin: Mapping[str, float]
    """Values by kind, [m] and [rad]."""


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
    effects: Mapping[str, Any] | str | None = None,
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
        effects: As in a robot file.
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
    builder.add_frame("base", model.frame_values("base", base), 0, False)
    try:
        tree = _Tree(_read_joints(root, path.name), [link.get("name", "") for link in root.findall("link")], path.name)
        base_link = tree.root() if base_link is None else tree.known(base_link)
        tip_link = tree.leaf(base_link) if tip_link is None else tree.known(tip_link)
        chain = tree.chain(base_link, tip_link)
        n_joints = _add_chain(builder, chain, path.name, model.ZEROS in listed("estimate", estimate))
        expect(n_joints, path.name, f"no moving joint between links {base_link!r} and {tip_link!r}", "at least one")
    except InputError as error:  # elements of xacro may hold what is missing
        hint = _XACRO if any("xacro" in str(element.tag) for element in root.iter()) else error.hint
        raise InputError(error.place, error.found, error.expected, hint) from None
    builder.add_frame("tool", model.frame_values("tool", tool), n_joints + 1, False)
    choices = {"fixed": fixed, "estimate": estimate, "tolerance": tolerance}
    links, source = _links_of(tree, chain, base_link, path.name), UrdfSource(text, base_link, tip_link)
    links[None] = partial(_inertials, root, links, path.name)
    return _with_effects(builder, effects or {}, links, place or path.name, urdf=source, **choices)


def _links_of(tree: _Tree, chain: list[tuple[_UrdfJoint, bool]], base: str, place: str) -> dict[str | None, Any]:
    """What makes a mass on the arm of a mass on each link that hangs on the chain.

    Joints outside the chain that mimic others, and floating or planar ones, are taken at readings of zero.
    """
    on_chain, number, at = {base: (0, np.eye(4))}, 0, np.eye(4)
    for joint, backwards in chain:
        origin, moves = model.matrix_of_frame(joint.origin), joint.element.get("type") != "fixed"
        number += moves
        at = np.eye(4) if moves else at @ (np.linalg.inv(origin) if backwards else origin)
        on_chain[joint.parent if backwards else joint.child] = number, at

    def made(below: str, link: str, mass: float, com: Sequence[float]) -> Mass:
        (owner, at), hinges = on_chain[below], list[Hinge]()
        for joint, _ in tree.chain(below, link):
            at, here = at @ model.matrix_of_frame(joint.origin), f"{place}: joint {joint.name!r}"
            if joint.element.get("type") in _MOVING and joint.element.find("mimic") is None:
                axis = _axis(joint, here).tolist()
                hinges.append(Hinge(_moving_joint(joint, here), joint.child, at.tolist(), axis))
                at = np.eye(4)
        return Mass(owner, mass, tuple((at[:3, :3] @ com + at[:3, 3]).tolist()), "", tuple(hinges))

    links: dict[str | None, Any] = {str(i): partial(Mass, i) for i in range(number + 2)}
    for link in tree.links:
        if (below := next((one for one in tree.up(link) if one in on_chain), None)) is not None:
            links[link] = partial(made, below, link)
    return links


def _inertials(root: etree._Element, links: Mapping[Any, Any], place: str) -> list[Mass]:
    """The masses of the inertials of all links that hang on the chain."""
    found = list[Mass]()
    for link in root.findall("link"):
        name, inertial = link.get("name", ""), link.find("inertial")
        if name in links and inertial is not None:
            here = f"{place}: link {name!r}"
            com = _numbers(inertial, "origin", "xyz", "0 0 0", here)
            (mass,) = _numbers(inertial, "mass", "value", "0", here)
            expect(mass >= 0.0, f"{here}: mass", f"found {mass:g}", "0 or above")
            found += [links[name](mass, com)] if mass else []
    return found


def _with_effects(builder: RobotBuilder, given: Any, links: Mapping[Any, Any], place: str, **choices: Any) -> Robot:
    """The robot of a builder with the effects of a robot file."""
    inputs.check_type(f"{place}: effects", given, Mapping[str, Any] | Literal["select"])
    given = select_standard(links) if isinstance(given, str) else given
    where, coefficients = f"{place}: effects", given.get("values", {})
    robot = builder.build(effects=read_effects(given, where, links, builder.n_joints), place=place, **choices)
    robot = replace(robot, select_effects=bool(given.get("select", False)))
    return with_coefficients(robot, coefficients, f"{where}: values")


_CHILDREN = ("origin", "parent", "child", "axis", "calibration", "dynamics", "limit", "mimic", "safety_controller")
"""Elements of a joint of a URDF."""

_MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints that move by one reading."""

_ROWS = "`fg-calib export --to yaml` writes the arm as rows of dh-hayati, whose d is the zero of a slide"
_XACRO = "it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`"


def _add_chain(builder: RobotBuilder, chain: Iterable[tuple[_UrdfJoint, bool]], place: str, zeros: bool) -> int:
    """Add the joints of a chain, each with whether it is passed backwards; the number of those that move."""
    n_joints = 0
    for joint, backwards in chain:
        here = f"{place}: joint {joint.name!r}"
        tags = [child.tag for child in joint.element if isinstance(child.tag, str)]
        for tag in tags:  # of a misspelt or doubled element a default or the first would take the place
            expect(tag not in _CHILDREN or tags.count(tag) == 1, here, f"two elements <{tag}>", "one")
            if tag not in _CHILDREN and (hint := did_you_mean(tag, _CHILDREN)):
                raise InputError(here, f"element <{tag}>", hint=hint)
        if joint.element.get("type") == "fixed":
            builder.add_constant_frame(joint.origin, backwards=backwards)
            continue
        moving = _moving_joint(joint, here)
        expect(not (zeros and moving.prismatic), here, "a slide, with estimate: zeros", "joints that turn", _ROWS)
        builder.add_urdf_joint(moving, joint.origin, _axis(joint, here), backwards=backwards, zero=zeros)
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
    write_text(Path(path), urdf_text(robot))


def has_own_zeros(robot: Robot) -> bool:
    """Whether a robot from a URDF has zeros of its joints as parameters."""
    return robot.urdf is not None and robot.zero_names[0] in names_of(robot.parameters)


def as_read(robot: Robot) -> Robot:
    """A robot as its files read: a URDF holds zeros in the origins, turned about the joints' axes."""
    values = {p.name: p.nominal for p in robot.parameters}
    for place, e in enumerate(robot.elements) if has_own_zeros(robot) else ():
        if e.joint is not None and (zero := values[robot.zero_names[e.joint]]):
            yaw, pitch = (one.constant for one in robot.elements[place - 2 : place])
            kinds = [f"{robot.joints[e.joint].name}.{kind}" for kind in ("yaw", "pitch", "roll")]
            axis, before = rotations.rotation_of(yaw, pitch, 0.0), [values[kind] for kind in kinds]
            turned = rotations.rotation_of(*before) @ axis @ rotations.rotation_of(zero, 0.0, 0.0) @ axis.T
            angles = rotations.yaw_pitch_roll(turned, np.array(before)).tolist()
            values |= dict(zip(kinds, angles, strict=True)) | {robot.zero_names[e.joint]: 0.0}
    return robot.with_values(list(values.values()))


def urdf_text(robot: Robot) -> str:
    """The URDF that a robot was read from with the origins of its joints; comments and other elements stay.

    A number of `<origin>` that is the one wanted but for `ROUNDING` stays, an attribute of such numbers as written.

    Raises:
        ValueError: The robot was not read from a URDF.
    """
    if robot.urdf is None:
        raise ValueError("the robot was not read from a URDF")
    values, names = {p.name: p.nominal for p in as_read(robot).parameters}, {joint.name for joint in robot.joints}
    root = etree.fromstring(robot.urdf.text, etree.XMLParser(**_SAFE))
    for joint in root.findall("joint"):
        if (name := joint.get("name", "")) in names:
            _set_origin(joint, {kind: values[f"{name}.{kind}"] for kind in model.FRAME_KINDS})
    return f'<?xml version="1.0"?>\n{etree.tostring(root.getroottree(), encoding="unicode")}\n'


def _set_origin(joint: etree._Element, wanted: Mapping[str, float]) -> None:
    """Give a joint's `<origin>` these numbers; 0 is what a missing one means."""
    element = joint.find("origin")
    for name, kinds in _ORIGIN.items():
        numbers, read = [wanted[kind] for kind in kinds], _figures(_attribute(joint, "origin", name, "0 0 0"))
        if len(read) == len(numbers) and max(abs(a - b) for a, b in zip(read, numbers, strict=True)) <= ROUNDING:
            continue
        if element is None:
            element = joint.makeelement("origin")
            element.tail = joint.text
            joint.insert(0, element)
        element.set(name, " ".join(repr(float(number)) for number in numbers))


_SAFE: Mapping[str, Any] = {"resolve_entities": False, "load_dtd": False, "no_network": True}
"""Options of lxml's parser: neither entities nor other files are read."""


def _parse(data: bytes, place: str) -> tuple[str, etree._Element]:
    """The text, without its declaration, and the root element of an XML file without entities and other files."""
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
    expect(root.tag == "robot", place, f"root element <{root.tag}>", "<robot>")
    return etree.tostring(root.getroottree(), encoding="unicode"), root


def _read_joints(root: etree._Element, place: str) -> list[_UrdfJoint]:
    """All joints, each with a name of its own, an origin, a parent and a child."""
    joints: dict[str, _UrdfJoint] = {}
    for joint in root.findall("joint"):
        name, links = joint.get("name", ""), []
        here = f"{place}:{joint.sourceline}: joint {name!r}"
        expect(name, f"{place}:{joint.sourceline}", "a joint without a name")
        expect(name not in joints, here, "a second joint of this name", "different names")
        for end in ("parent", "child"):
            links.append(_attribute(joint, end, "link", ""))
            expect(links[-1], here, f"no <{end}>", f'<{end} link="..."/>')
        joints[name] = _UrdfJoint(joint, name, links[0], links[1], _origin(joint, here))
    return list(joints.values())


def _origin(joint: etree._Element, place: str) -> dict[str, float]:
    xyz, rpy = (_numbers(joint, "origin", name, "0 0 0", place) for name in _ORIGIN)
    if max(map(abs, rpy)) > model.MOST_ANGLE:
        raise InputError(f"{place}: origin rpy", f"found {rpy}", model.IN_RAD, "are they in deg?")
    return dict(zip((*_ORIGIN["xyz"], *_ORIGIN["rpy"]), (*xyz, *rpy), strict=True))


def _attribute(joint: etree._Element, child: str, attribute: str, default: str) -> str:
    """An attribute of a joint's first child of some name; `default` where either is missing."""
    element = joint.find(child)
    return default if element is None else element.get(attribute, default)


def _numbers(joint: etree._Element, child: str, attribute: str, default: str, place: str) -> list[float]:
    """An attribute of as many numbers as its default; only limits may be infinite.

    Raises:
        InputError: The attribute holds something else.
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
    expect(kind in _MOVING, place, f"type {shown(kind)}", "revolute, continuous, prismatic or fixed on the chain")
    if mimic is not None:
        found = f"mimics joint {shown(mimic.get('joint', ''))}"
        raise InputError(place, found, "joints on the chain that move by themselves")
    (lower,), (upper,) = (_numbers(joint.element, "limit", end, "0", place) for end in ("lower", "upper"))
    if kind == "continuous" or lower == upper == 0.0:
        return Joint(joint.name, kind == "prismatic")
    expect(lower < upper, f"{place}: limit", f"lower {lower:g}, upper {upper:g}", "lower below upper")
    return Joint(joint.name, kind == "prismatic", lower, upper)


def _axis(joint: _UrdfJoint, place: str) -> NDArray[np.float64]:
    """The joint's unit axis, shape (3,); x where the file says none."""
    axis = np.array(_numbers(joint.element, "axis", "xyz", "1 0 0", place))
    length = math.hypot(*axis)
    expect(length >= LEAST_SIZE, f"{place}: axis", f"found {axis.tolist()}", "a direction of three numbers")
    return axis / length


class _Tree:
    """The links of a URDF and the joints between them."""

    def __init__(self, joints: Sequence[_UrdfJoint], links: Sequence[str], place: str) -> None:
        self._place = place
        self.links = list(dict.fromkeys([*links, *(link for j in joints for link in (j.parent, j.child))]))
        self._above: dict[str, _UrdfJoint] = {}  # by child link
        for joint in joints:
            if (first := self._above.setdefault(joint.child, joint)) is not joint:
                found = f"link {joint.child!r} is the child of joints {first.name!r} and {joint.name!r}"
                raise InputError(place, found, "one")

    def known(self, link: str) -> str:
        """`link`, if there is such a link."""
        hint = did_you_mean(link, self.links, NEAR)
        expect(link in self.links, self._place, f"no link {link!r}", inputs.known_names(self.links, 40), hint)
        return link

    def root(self) -> str:
        """The only link without a parent."""
        expect(self.links, self._place, "no links and joints", "<link> and <joint> within <robot>")
        return self._only([link for link in self.links if self.up(link) == [link]], "root", "base_link")

    def leaf(self, base: str) -> str:
        """The only link without a child at or below `base`."""
        parents = {joint.parent for joint in self._above.values()}
        leaves = [link for link in self.links if link not in parents and base in self.up(link)]
        return self._only(leaves, "leaf", "tip_link")

    def chain(self, base: str, tip: str) -> list[tuple[_UrdfJoint, bool]]:
        """The joints from `base` to `tip`, with whether each is passed from child to parent."""
        up, down = self.up(base), self.up(tip)
        if up[-1] != down[-1]:
            raise InputError(self._place, f"links {base!r} and {tip!r} are not connected", "two links of one tree")
        there, back = [link for link in up if link not in down], [link for link in down if link not in up]
        return [(self._above[link], True) for link in there] + [(self._above[link], False) for link in reversed(back)]

    def up(self, link: str) -> list[str]:
        """`link` and the links above it, up to the root."""
        links = [link]
        while links[-1] in self._above:
            links.append(self._above[links[-1]].parent)
            circle = " below ".join(links[links.index(links[-1]) :])
            expect(links[-1] not in links[:-1], self._place, f"links in a circle: {circle}", "a tree of links")
        return links

    def _only(self, found: list[str], what: str, key: str) -> str:
        option = f"--{key.replace('_', '-')}"
        hint = f"name one as {key}: {{urdf: {self._place}, {key}: ...}} in a file, {option} of observe"
        expect(len(found) == 1, self._place, f"{len(found)} {what} links ({', '.join(found)})", "one", hint)
        return found[0]


class FrameValues(Schema):
    """A frame as six values, those missing 0: x, y, z and Rz(yaw) Ry(pitch) Rx(roll)."""

    x: Number = 0.0
    y: Number = 0.0
    z: Number = 0.0
    roll: Number = 0.0
    pitch: Number = 0.0
    yaw: Number = 0.0

    def si(self, units: Units, place: str) -> dict[str, float]:
        """The six values by kind, [m] and [rad].

        Raises:
            InputError: An angle in rad is one in deg.
        """
        return {kind: _si(kind, getattr(self, kind), units, place) for kind in model.FRAME_KINDS}


def _si(kind: str, value: float, units: Units, place: str) -> float:
    """A value of a kind of parameter in [m] or [rad].

    Raises:
        InputError: An angle in rad is one in deg.
    """
    unit = model.unit_of(kind)
    if units.name(unit) == "rad" and abs(value) > model.MOST_ANGLE:
        raise InputError(f"{place}: {kind}", f"found {value:g}", model.IN_RAD, "units: {angle: deg} are deg")
    return value * units.factor(unit)


Names = Annotated[tuple[str, ...], BeforeValidator(lambda one: (one,) if isinstance(one, str) else one)]
"""A list of names, or one name."""


class _Robot(Schema):
    """The keys that both forms of a robot file have.

    Attributes:
        name: The robot's name.
        units: Of the values in this file.
        base: Base frame to frame 0, or to the first link of a URDF.
        tool: Last frame to tool frame.
        fixed: Parameters of the joints that are known exactly, never estimated.
        estimate: Parameters of base and tool that are estimated, which others are not: tool.x; `zeros`: of the joints
            their zeros alone.
        tolerance: 1 sigma of true minus nominal, by kind (a, theta, tool, ...) or by name: used as priors.
        effects: What the arm does beyond its geometry: see `io.effects`.
    """

    name: str | None = None
    units: UnitsOfFile = Units()
    base: FrameValues = FrameValues()
    tool: FrameValues = FrameValues()
    fixed: tuple[str, ...] = ()
    estimate: Names = ()
    tolerance: dict[str, Positive] = Field(default_factory=dict)
    effects: Any = Field(default_factory=dict)

    def choices(self, place: str, estimate: Sequence[str]) -> dict[str, Any]:
        """Arguments of `RobotBuilder.build`, [m] and [rad]; `estimate` is estimated too.

        Raises:
            InputError: A tolerance is too small.
        """
        sigma, where = self.units.sigma, f"{place}: tolerance"
        tolerance = {key: sigma(value, model.unit_of(key), f"{where}: {key}") for key, value in self.tolerance.items()}
        return {"fixed": self.fixed, "estimate": (*self.estimate, *estimate), "tolerance": tolerance}


Bound = Annotated[float, Field(strict=True, allow_inf_nan=True)]
"""A number, or infinity."""


class _JointRow(Schema):
    type: Literal["revolute", "prismatic"] = "revolute"
    name: str | None = None
    limits: tuple[Bound, Bound] = (-math.inf, math.inf)


class _Row(_JointRow):
    a: Number | None = None
    alpha: Number | None = None
    d: Number | None = None
    theta: Number | None = None
    beta: Number = 0.0


class _ScrewRow(_JointRow):
    axis: tuple[Number, Number, Number]
    point: tuple[Number, Number, Number] | None = None
    x: Number = 0.0
    y: Number = 0.0
    pitch: Number = 0.0
    roll: Number = 0.0
    sigma: dict[str, Any] = Field(default_factory=dict)


class _Link(Schema):
    b: tuple[Number, Number, Number]
    l: tuple[Number, Number, Number]  # noqa: E741 - the figures of CPC are b, l and beta
    beta: Number = 0.0

    def matrix(self, units: Units, place: str) -> inputs.Floats:
        """R(b) Rz(beta) Txyz(l), shape (4, 4), [m].

        Raises:
            InputError: b is no unit vector, or too near to -z.
        """
        length, found = math.hypot(*self.b), f"found {list(self.b)}, for which R(b) is any"
        expect(abs(length - 1.0) <= UNIT, f"{place}: b", f"length {length:.9g}", f"1 within {UNIT:g}")
        hint = "take the next axis the other way, bz >= 0 with `sign: -1`; behind the last joint turn `tool`"
        expect(self.b[2] >= UNIT - 1.0, f"{place}: b", found, "bz above -1", hint)
        beta = rotations.rotation_of(_si("beta", self.beta, units, place), 0.0, 0.0)
        R = rotations.least_rotation(np.array(self.b) / length) @ beta
        return np.vstack([np.column_stack([R, R @ self.l * units.factor("m")]), np.eye(4)[3]])


class _CpcRow(_JointRow, _Link):
    sign: Literal[-1, 1] = 1
    offset: Number = 0.0


class _CpcRobot(_Robot):
    convention: Literal["cpc"]
    link0: _Link = _Link(b=(0.0, 0.0, 1.0), l=(0.0, 0.0, 0.0))
    joints: Annotated[list[_CpcRow], Field(min_length=1)]


class _DhRobot(_Robot):
    convention: Literal["dh", "mdh", "mdh-hayati", "dh-hayati", "poe", "cpc"]
    joints: Annotated[list[_Row], Field(min_length=1)]


class _PoeRobot(_Robot):
    convention: Literal["poe"]
    joints: Annotated[list[_ScrewRow], Field(min_length=1)]


class _UrdfRobot(_Robot):
    urdf: FilePath
    base_link: str | None = None
    tip_link: str | None = None


@checked
def read_robot(
    path: Path | str, *, base_link: str | None = None, tip_link: str | None = None, estimate: Sequence[str] = ()
) -> Robot:
    """The robot in a YAML file or a URDF, recognised by the ending `.urdf`.

    Args:
        path: The file.
        base_link: Link of the URDF where the chain starts, instead of the one the file names.
        tip_link: Link of the URDF where the chain ends, instead of the one the file names.
        estimate: What is estimated besides what the file says (see `RobotBuilder.build`).

    Raises:
        InputError: There is no such file, or it does not describe a robot.
    """
    path = Path(path)
    if path.suffix.lower() == ".urdf":
        return read_urdf(path, base_link=base_link, tip_link=tip_link, estimate=estimate)
    hint = f"`xacro {path.name} > {path.name.removesuffix(path.suffix).removesuffix('.urdf')}.urdf` writes one"
    expect(path.suffix.lower() != ".xacro", path.name, "a file of xacro", "a URDF", hint)
    mapping, links = read_yaml(path), {"base_link": base_link, "tip_link": tip_link}
    name = {} if "urdf" in mapping else {"name": path.stem}
    given = name | mapping | {key: link for key, link in links.items() if link is not None}
    return robot_from_mapping(given, path.name, path.parent, estimate)


def robot_from_mapping(mapping: Mapping[str, Any], place: str, folder: Path, estimate: Sequence[str] = ()) -> Robot:
    """The robot that a mapping of a YAML file describes.

    Args:
        mapping: The mapping: with `urdf`, or with `convention` and `joints`.
        place: Its file, and its key there if it is not the whole file.
        folder: Folder that the path of a URDF is relative to.
        estimate: What is estimated besides what the mapping says.

    Raises:
        InputError: The mapping does not describe a robot.
    """
    if "urdf" not in mapping:
        mapping = _in_screws(mapping, place) if mapping.get("convention") == "cpc" else mapping
        of: type[_DhRobot | _PoeRobot] = _PoeRobot if mapping.get("convention") == model.POE else _DhRobot
        return _build_rows(validate(of, dict(mapping), place), place, estimate)
    file = validate(_UrdfRobot, dict(mapping), place)
    robot = read_urdf(
        folder / file.urdf,
        effects=file.effects,
        base_link=file.base_link,
        tip_link=file.tip_link,
        name=file.name,
        base=file.base.si(file.units, f"{place}: base"),
        tool=file.tool.si(file.units, f"{place}: tool"),
        place=place,
        **file.choices(place, estimate),
    )
    return replace(robot, units=(file.units.length, file.units.angle))


def _build_rows(file: _DhRobot | _PoeRobot, place: str, estimate: Sequence[str]) -> Robot:
    builder = RobotBuilder(file.name or "robot", file.convention)
    builder.add_frame("base", file.base.si(file.units, f"{place}: base"), 0, False)
    rows: Sequence[_Row | _ScrewRow] = file.joints
    names = [row.name or f"q{i}" for i, row in enumerate(rows, start=1)]
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        here = f"{place}: joint {i + 1}"
        if name in names[:i]:
            raise InputError(f"{here}: name", f"found {name!r}, the name of joint {names.index(name) + 1}", "another")
        lower, upper = row.limits
        expect(lower < upper, f"{here}: limits", f"found {shown([lower, upper])}", "lower below upper")
        factor = file.units.factor("m" if row.type == "prismatic" else "rad")
        joint = Joint(name, row.type == "prismatic", lower * factor, upper * factor)
        if isinstance(row, _ScrewRow):
            _add_screw(builder, joint, row, file.units, here)
        else:
            builder.add_convention_joint(joint, _values(row, file.convention, file.units, here))
    builder.add_frame("tool", file.tool.si(file.units, f"{place}: tool"), len(names) + 1, False)
    links = {str(i): partial(Mass, i) for i in range(len(names) + 2)}
    robot = _with_effects(builder, file.effects, links, place, **file.choices(place, estimate))
    return replace(robot, units=(file.units.length, file.units.angle))


def _values(row: _Row, convention: str, units: Units, place: str) -> dict[str, float]:
    """The values of a row by kind, [m] and [rad]."""
    kinds = model.CONVENTIONS[convention]
    found, expected = f"found {row.beta!r}", f"none: the convention {convention} has no beta"
    expect("beta" in kinds or not row.beta, f"{place}: beta", found, expected, f"{convention}-hayati has")
    if missing := [kind for kind in kinds if getattr(row, kind) is None]:
        raise InputError(place, f"missing key {missing[0]!r}")
    return {kind: _si(kind, getattr(row, kind), units, place) for kind in kinds}


def _add_screw(builder: RobotBuilder, joint: Joint, row: _ScrewRow, units: Units, place: str) -> None:
    expect(row.point or joint.prismatic, place, "missing key 'point'")
    point = [one * units.factor("m") for one in row.point or (0.0, 0.0, 0.0)]
    if joint.prismatic and (row.x or row.y):
        raise InputError(place, "x or y of a slide", "pitch and roll: it has a direction alone")
    values = {kind: _si(kind, getattr(row, kind), units, place) for kind in model.SCREW_KINDS}
    with inputs.within(place):
        builder.add_screw_joint(joint, row.axis, point, values)


def _in_screws(mapping: Mapping[str, Any], place: str) -> dict[str, Any]:
    """The mapping of an arm of `cpc` as one of `poe`."""
    file = validate(_CpcRobot, dict(mapping), place)
    units, rows, T = file.units, list[dict[str, Any]](), file.link0.matrix(file.units, f"{place}: link0")
    for i, row in enumerate(file.joints, start=1):
        here, moving = f"{place}: joint {i}", "z" if row.type == "prismatic" else "yaw"
        axis, point = (row.sign * T[:3, 2]).tolist(), [units.from_si(one, "m") for one in T[:3, 3].tolist()]
        rows.append(row.model_dump(include={"type", "name", "limits"}) | {"axis": axis, "point": point})
        moved = model.matrix_of_frame({moving: _si(moving, row.offset, units, f"{here}: offset")})
        T = T @ moved @ row.matrix(units, here)
    T = T @ model.matrix_of_frame(file.tool.si(units, f"{place}: tool"))
    tool = {kind: units.from_si(value, model.unit_of(kind)) for kind, value in model.frame_of_matrix(T).items()}
    others = {key: value for key, value in mapping.items() if key != "link0"}
    return others | {"convention": model.POE, "joints": rows, "tool": tool}


def cpc_text(robot: Robot, frames: Sequence[inputs.Floats], units: Units) -> tuple[str, Robot]:
    """The text of an arm in links of `cpc`, and the robot that it reads back as.

    Args:
        robot: The arm, whose name, joints and limits are taken.
        frames: At zero readings in the base frame, shape (4, 4) each: the joints' axes as their z, then the tool's.
        units: Of the text.
    """
    links, at, sign = list[_Flow](), np.eye(4), 1
    for i, frame in enumerate(frames):
        M, own = np.linalg.inv(at) @ frame, _row(robot, i - 1, units) if i else {}
        row = {key: own[key] for key in _JointRow.model_fields if key in own} | {"sign": sign}
        sign = -1 if M[2, 2] < -model.STRAIGHT else 1
        b = np.round(sign * M[:3, 2], 15) + 0.0
        M = rotations.least_rotation(b).T @ M[:3] @ np.diag([1.0, sign, sign, 1.0])  # Rz(beta) Txyz(l)
        beta = float(np.arctan2(M[1, 0], M[0, 0])) if i == robot.n_joints else 0.0
        shift = np.round(rotations.rotation_of(-beta, 0.0, 0.0) @ M[:, 3], 15) + 0.0
        if i < robot.n_joints:
            shift[0 if robot.joints[i].prismatic else 2 :] = 0.0
        row |= {"b": b.tolist(), "l": [units.from_si(one, "m") for one in shift.tolist()]}
        link = validate(_CpcRow, row | {"beta": units.from_si(beta, "rad")}, robot.name)
        links.append(_Flow(link.model_dump(exclude_defaults=True)))
        at = at @ link.matrix(units, robot.name)
    mapping = {"name": robot.name, "units": asdict(units), "convention": "cpc", "link0": links[0], "joints": links[1:]}
    mapping |= {"tool": {"roll": units.from_si(np.pi, "rad")}} if sign < 0 else {}
    return _dumped(mapping), robot_from_mapping(mapping, robot.name, Path())


@checked
def write_robot(path: Path | str, robot: Robot, *, units: Units | None = None, urdf_name: str | None = None) -> None:
    """Write a robot YAML that `read_robot` reads back to the same robot.

    Args:
        path: The file to write.
        robot: The robot; its nominal values are written.
        units: The file's units; default m and rad, in which every value reads back exactly.
        urdf_name: For a URDF robot the path of its URDF, relative to `path`: the file refers to it and holds
            what it cannot. The joints' own values are those of the URDF: see `write_urdf`.

    Raises:
        InputError: The folder does not exist or may not be written to, or the robot has what no such file can say.
        ValueError: A URDF robot without `urdf_name`, or the other way round.
    """
    write_text(Path(path), robot_text(robot, units=units, urdf_name=urdf_name, place=str(path)))


def robot_text(
    robot: Robot,
    *,
    units: Units | None = None,
    urdf_name: str | None = None,
    place: str | None = None,
    sigmas: Sequence[Mapping[str, float]] = (),
) -> str:
    """The text that `write_robot` writes.

    Args:
        robot: The robot.
        units: Of the text; default m and rad.
        urdf_name: See `write_robot`.
        place: The file, for messages; the robot's name if None.
        sigmas: For people, `sigma` of each row of `poe`.

    Raises:
        InputError: The robot has what no such file can say.
        ValueError: A URDF robot without `urdf_name`, or the other way round.
    """
    if (robot.urdf is None) != (urdf_name is None):
        raise ValueError("a URDF robot, and no other, is written with urdf_name")
    units, base, tool = units or Units(), robot.owned_by(0), robot.owned_by(robot.n_joints + 1)
    mapping: dict[str, Any] = {"name": robot.name, "units": asdict(units)}
    if robot.urdf is None:
        rows = [_row(robot, i, units) for i in range(robot.n_joints)]
        for row, sigma in zip(rows, sigmas, strict=False):
            row |= {"sigma": dict(sigma)}
        mapping |= {"convention": robot.convention, "joints": rows}
    else:
        mapping |= {"urdf": urdf_name, "base_link": robot.urdf.base_link, "tip_link": robot.urdf.tip_link}
    for key, owned in (("base", base), ("tool", tool)):
        frame = [robot.parameters[i] for i in owned]
        mapping |= {key: {p.kind: units.from_si(p.nominal, p.unit) for p in frame if p.nominal != 0.0}}
    of_frames, zeros = [robot.parameters[i] for i in (*base, *tool)], has_own_zeros(robot)
    of_joints = [p for p in robot.parameters if p not in of_frames and (not zeros or p.name in robot.zero_names)]
    mapping |= {
        "fixed": [p.name for p in of_joints if not p.estimated],
        "estimate": [model.ZEROS] * zeros + [p.name for p in of_frames if p.estimated],
        "tolerance": _tolerances(robot, units),
    }
    mapping["effects"] = effects_mapping(robot)
    mapping = {key: value for key, value in mapping.items() if value or key == "joints"}
    if robot.urdf is None:
        place = place or robot.name
        require_same_chain(robot, robot_from_mapping(mapping, place, Path()), place)
    return _dumped(mapping)


def _dumped(mapping: Mapping[str, Any]) -> str:
    style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "allow_unicode": True, "width": math.inf}
    return str(yaml.dump(mapping, Dumper=_Dumper, **style))


def require_same_chain(robot: Robot, written: Robot, place: str) -> None:
    """Check that what was written of a robot is all of it: one made by hand may have elements of its own.

    Raises:
        InputError: The robots have other elements, or parameters.
    """
    same = names_of(robot.parameters) == names_of(written.parameters) and len(robot.elements) == len(written.elements)
    for one, other in zip(robot.elements, written.elements, strict=same):
        same &= replace(one, constant=other.constant) == other and abs(one.constant - other.constant) <= ROUNDING
    expected = "base, joints of one convention or a URDF's, tool: all that a robot file can say"
    expect(same, place, "the robot has elements or parameters of its own", expected)


def _row(robot: Robot, index: int, units: Units) -> dict[str, Any]:
    joint = robot.joints[index]
    row: dict[str, Any] = {} if joint.name == f"q{index + 1}" else {"name": joint.name}
    owned: list[Parameter] = [robot.parameters[i] for i in robot.owned_by(index + 1)]
    if robot.convention == model.POE:
        row |= _screw(robot, index, units)
        owned = [p for p in owned if p.nominal != 0.0]
    row |= {p.kind: units.from_si(p.nominal, p.unit) for p in owned}
    if joint.prismatic:
        row["type"] = "prismatic"
    if (joint.lower, joint.upper) != (-math.inf, math.inf):
        row["limits"] = [units.from_si(limit, joint.unit) for limit in (joint.lower, joint.upper)]
    return _Flow(row)


def _screw(robot: Robot, index: int, units: Units) -> dict[str, Any]:
    """Axis and point of a joint at the values 0 of its parameters."""
    elements, n = robot.geometry.elements, len(robot.owned_by(index + 1))
    end = next(i for i, e in enumerate(elements) if e.joint == index) - n
    *point, yaw, pitch = (e.constant for e in elements[end - 5 : end])
    axis = rotations.rotation_of(yaw, pitch, 0.0)[:, 2].tolist()
    rounded = [float(f"{one:.15g}") if abs(one) > ROUNDING else 0.0 for one in axis]
    return {"axis": rounded, "point": [units.from_si(one, "m") for one in point]}


def _tolerances(robot: Robot, units: Units) -> dict[str, float]:
    """Tolerances by kind where all parameters of the kind share one, by name of the others."""
    kinds, tolerances = [model.tolerance_kind(p) for p in robot.parameters], {}
    for p, kind in zip(robot.parameters, kinds, strict=True):
        if p.tolerance is not None:
            alike = {other.tolerance for other, its in zip(robot.parameters, kinds, strict=True) if its == kind}
            tolerances[kind if kind and len(alike) == 1 else p.name] = units.from_si(p.tolerance, p.unit)
    return tolerances


class _Flow(dict[str, Any]):
    """A mapping to be written on one line."""


class _Dumper(yaml.SafeDumper):
    """The safe dumper, with a row of joints on one line."""

    yaml_implicit_resolvers = Loader.yaml_implicit_resolvers  # quotes what reads as a number


_Dumper.add_representer(_Flow, lambda to, row: to.represent_mapping("tag:yaml.org,2002:map", row, flow_style=True))
