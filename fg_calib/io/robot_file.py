"""Robots in YAML: a DH convention with a row a joint, or a URDF with what it cannot hold itself.

```yaml
name: arm                              urdf: arm.urdf        # relative to this file
convention: mdh                        base_link: base_link  # default: the root link
units: {length: mm, angle: deg}        tip_link: flange      # default: the only leaf link
joints:                                units: {length: mm, angle: deg}
  - {a: 0, alpha: 0, d: 340, theta: 0, limits: [-170, 170]}
  - {a: 0, alpha: -90, d: 0, theta: 0, type: prismatic, name: slide}
```
Both take `name`, `base`, `tool`, `fixed`, `estimate` and `tolerance` too. Rows without `name` are called q1 to qn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from fg_calib.inputs import InputError, checked
from fg_calib.io.atomic import write_text
from fg_calib.io.urdf import read_urdf
from fg_calib.io.yaml import (
    Bound,
    FilePath,
    Loader,
    Number,
    Positive,
    Schema,
    Units,
    UnitsOfFile,
    read_yaml,
    shown,
    validate,
)
from fg_calib.robot import (
    AXIS_OF_KIND,
    CONVENTIONS,
    FRAME_KINDS,
    IN_RAD,
    MOST_ANGLE,
    Axis,
    Joint,
    Parameter,
    Robot,
    RobotBuilder,
    names_of,
    tolerance_kind,
)


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
        return {kind: _si(kind, getattr(self, kind), units, place) for kind in FRAME_KINDS}


def _si(kind: str, value: float, units: Units, place: str) -> float:
    """A value of a kind of parameter in [m] or [rad].

    Raises:
        InputError: An angle in rad is one in deg.
    """
    unit = unit_of_key(kind)
    if units.name(unit) == "rad" and abs(value) > MOST_ANGLE:
        raise InputError(f"{place}: {kind}", f"found {value:g}", IN_RAD, "units: {angle: deg} are deg")
    return value * units.factor(unit)


class _Robot(Schema):
    """The keys that both forms of a robot file have.

    Attributes:
        name: The robot's name.
        units: Of the values in this file.
        base: Base frame to frame 0, or to the first link of a URDF.
        tool: Last frame to tool frame.
        fixed: Parameters of the joints that are known exactly, never estimated.
        estimate: Parameters of base and tool that are estimated, which others are not: tool.x.
        tolerance: 1 sigma of true minus nominal, by kind (a, theta, tool, ...) or by name: used as priors.
    """

    name: str | None = None
    units: UnitsOfFile = Units()
    base: FrameValues = FrameValues()
    tool: FrameValues = FrameValues()
    fixed: tuple[str, ...] = ()
    estimate: tuple[str, ...] = ()
    tolerance: dict[str, Positive] = Field(default_factory=dict)

    def choices(self, place: str) -> dict[str, Any]:
        """What `RobotBuilder.build` wants to know, [m] and [rad].

        Raises:
            InputError: A tolerance is too small.
        """
        sigma, where = self.units.sigma, f"{place}: tolerance"
        tolerance = {key: sigma(value, unit_of_key(key), f"{where}: {key}") for key, value in self.tolerance.items()}
        return {"fixed": self.fixed, "estimate": self.estimate, "tolerance": tolerance}


class _Row(Schema):
    type: Literal["revolute", "prismatic"] = "revolute"
    name: str | None = None
    a: Number | None = None
    alpha: Number | None = None
    d: Number | None = None
    theta: Number | None = None
    beta: Number = 0.0
    limits: tuple[Bound, Bound] = (-math.inf, math.inf)


class _DhRobot(_Robot):
    convention: Literal["dh", "mdh", "mdh-hayati", "dh-hayati"]
    joints: Annotated[list[_Row], Field(min_length=1)]


class _UrdfRobot(_Robot):
    urdf: FilePath
    base_link: str | None = None
    tip_link: str | None = None


@checked
def read_robot(path: Path | str, *, base_link: str | None = None, tip_link: str | None = None) -> Robot:
    """The robot in a YAML file or a URDF, told apart by the ending `.urdf`.

    Args:
        path: The file.
        base_link: Link of the URDF where the chain starts, instead of the one the file names.
        tip_link: Link of the URDF where the chain ends, instead of the one the file names.

    Raises:
        InputError: There is no such file, or it does not describe a robot.
    """
    path = Path(path)
    if path.suffix.lower() == ".urdf":
        return read_urdf(path, base_link=base_link, tip_link=tip_link)
    if path.suffix.lower() == ".xacro":
        hint = f"`xacro {path.name} > {path.name.removesuffix(path.suffix).removesuffix('.urdf')}.urdf` writes one"
        raise InputError(path.name, "a file of xacro", "a URDF", hint)
    mapping, links = read_yaml(path), {"base_link": base_link, "tip_link": tip_link}
    name = {} if "urdf" in mapping else {"name": path.stem}
    given = name | mapping | {key: link for key, link in links.items() if link is not None}
    return robot_from_mapping(given, path.name, path.parent)


def robot_from_mapping(mapping: Mapping[str, Any], place: str, folder: Path) -> Robot:
    """The robot that a mapping of a YAML file describes.

    Args:
        mapping: The mapping: with `urdf`, or with `convention` and `joints`.
        place: Its file, and its key there if it is not the whole file.
        folder: What the path of a URDF is relative to.

    Raises:
        InputError: It does not describe a robot.
    """
    if "urdf" in mapping:
        return _build_urdf(validate(_UrdfRobot, dict(mapping), place), place, folder)
    return _build_dh(validate(_DhRobot, dict(mapping), place), place)


def _build_urdf(file: _UrdfRobot, place: str, folder: Path) -> Robot:
    return read_urdf(
        folder / file.urdf,
        base_link=file.base_link,
        tip_link=file.tip_link,
        name=file.name,
        base=file.base.si(file.units, f"{place}: base"),
        tool=file.tool.si(file.units, f"{place}: tool"),
        place=place,
        **file.choices(place),
    )


def _build_dh(file: _DhRobot, place: str) -> Robot:
    builder = RobotBuilder(file.name or "robot", file.convention)
    builder.add_frame("base", file.base.si(file.units, f"{place}: base"), 0, False)
    names = [row.name or f"q{i}" for i, row in enumerate(file.joints, start=1)]
    for i, (row, name) in enumerate(zip(file.joints, names, strict=True)):
        here, kinds = f"{place}: joint {i + 1}", CONVENTIONS[file.convention]
        if name in names[:i]:
            raise InputError(f"{here}: name", f"found {name!r}, the name of joint {names.index(name) + 1}", "another")
        if row.beta and "beta" not in kinds:
            found, expected = f"found {row.beta!r}", f"none: the convention {file.convention} has no beta"
            raise InputError(f"{here}: beta", found, expected, f"{file.convention}-hayati has")
        if missing := [kind for kind in kinds if getattr(row, kind) is None]:
            raise InputError(here, f"missing key {missing[0]!r}")
        lower, upper = row.limits
        if not lower < upper:
            raise InputError(f"{here}: limits", f"found {shown([lower, upper])}", "lower below upper")
        factor = file.units.factor("m" if row.type == "prismatic" else "rad")
        joint = Joint(name, row.type == "prismatic", lower * factor, upper * factor)
        values = {kind: _si(kind, getattr(row, kind), file.units, here) for kind in kinds}
        builder.add_convention_joint(joint, values)
    builder.add_frame("tool", file.tool.si(file.units, f"{place}: tool"), len(names) + 1, False)
    return builder.build(place=place, **file.choices(place))


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
    robot: Robot, *, units: Units | None = None, urdf_name: str | None = None, place: str | None = None
) -> str:
    """The text that `write_robot` writes.

    Args:
        robot: The robot.
        units: Of the text; default m and rad.
        urdf_name: See `write_robot`.
        place: The file, for messages; the robot's name if None.

    Raises:
        InputError: The robot has what no such file can say.
        ValueError: A URDF robot without `urdf_name`, or the other way round.
    """
    if (robot.urdf is None) != (urdf_name is None):
        raise ValueError("a URDF robot, and no other, is written with urdf_name")
    units, base, tool = units or Units(), robot.owned_by(0), robot.owned_by(robot.n_joints + 1)
    mapping: dict[str, Any] = {"name": robot.name}
    if robot.urdf is None:
        mapping |= {"convention": robot.convention, "units": asdict(units)}
        mapping |= {"joints": [_row(robot, i, units) for i in range(robot.n_joints)]}
    else:
        mapping |= {"urdf": urdf_name, "base_link": robot.urdf.base_link, "tip_link": robot.urdf.tip_link}
        mapping |= {"units": asdict(units)}
    for key, owned in (("base", base), ("tool", tool)):
        frame = [robot.parameters[i] for i in owned]
        mapping |= {key: {p.kind: units.from_si(p.nominal, p.unit) for p in frame if p.nominal != 0.0}}
    of_frames = [robot.parameters[i] for i in (*base, *tool)]
    mapping |= {
        "fixed": [p.name for p in robot.parameters if p not in of_frames and not p.estimated],
        "estimate": [p.name for p in of_frames if p.estimated],
        "tolerance": _tolerances(robot, units),
    }
    mapping = {key: value for key, value in mapping.items() if value or key == "joints"}
    if robot.urdf is None:
        place = place or robot.name
        written = robot_from_mapping(mapping, place, Path())
        if names_of(robot.parameters) != names_of(written.parameters) or len(robot.elements) != len(written.elements):
            expected = "base, joints of one convention, tool: all that a robot file can say"
            raise InputError(place, "the robot has elements or parameters of its own", expected)
    text = yaml.dump(
        mapping, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf
    )
    return str(text)


def unit_of_key(key: str) -> str:
    """The unit, `m` or `rad`, of a kind of parameter (`a`, `tool`) or of one by its name (`alpha3`, `elbow.yaw`)."""
    kind = re.sub(r".*\.|\d+$", "", key)
    return "rad" if kind in AXIS_OF_KIND and AXIS_OF_KIND[kind] >= Axis.RX else "m"


def _row(robot: Robot, index: int, units: Units) -> dict[str, Any]:
    joint = robot.joints[index]
    row: dict[str, Any] = {} if joint.name == f"q{index + 1}" else {"name": joint.name}
    owned: list[Parameter] = [robot.parameters[i] for i in robot.owned_by(index + 1)]
    row |= {p.kind: units.from_si(p.nominal, p.unit) for p in owned}
    if joint.prismatic:
        row["type"] = "prismatic"
    if (joint.lower, joint.upper) != (-math.inf, math.inf):
        row["limits"] = [units.from_si(limit, joint.unit) for limit in (joint.lower, joint.upper)]
    return _Flow(row)


def _tolerances(robot: Robot, units: Units) -> dict[str, float]:
    """Tolerances by kind where all parameters of the kind share one, by name elsewhere."""
    kinds, tolerances = [tolerance_kind(p) for p in robot.parameters], {}
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


_Dumper.add_representer(
    _Flow, lambda dumper, row: dumper.represent_mapping("tag:yaml.org,2002:map", row, flow_style=True)
)
