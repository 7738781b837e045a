"""What a table holds, told by its header: its model, what its columns mean, and the units of its figures."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from fg_calib.errors import InputError
from fg_calib.io.columns import KNOWN, OF_CONFIGURATIONS, OF_PAIRS, Table, names_of
from fg_calib.io.units import ANGLES, LENGTHS
from fg_calib.measurements.kinds.board import COVARIANCE
from fg_calib.options import Model
from fg_calib.robot.model import Robot

Kind = Literal["joints", "pairs"]

UNITS = {"°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "µm": "um", "μm": "um"}
UNITS |= {unit: unit for unit in (*LENGTHS, *ANGLES)} | {"px": "px", "pixel": "px", "pixels": "px"}
UNITS |= {"inch": "in", "inches": "in", '"': "in"}
"""Units as headers write them."""

_BRACKETED = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]$")
_SUFFIXED = re.compile(r"^(?P<name>.*?)[_\s](?P<unit>um|mm|cm|m|in|deg|rad|mrad|px)$", re.IGNORECASE)
_JOINT = re.compile(r"^(?:actual[ _])?(?:q|j|a|axis|joint|theta|th)[ _-]?(?:pos|position|angle)?[ _-]?0*(\d+)$", re.I)
_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    **{axis: (f"pos_{axis}", f"position_{axis}", f"p{axis}", f"tcp_{axis}", f"t{axis}") for axis in "xyz"},
    **{f"q{axis}": (f"q_{axis}", f"quat_{axis}", f"orientation_{axis}") for axis in "xyzw"},
    **{name: (name[0].upper() + name[1:],) for name in ("roll", "pitch", "yaw")},
    "id": ("configuration", "config"),
    "target": ("reflector", "smr", "marker"),
    "distance": ("dist", "length"),
}
"""Names that tables have for columns that are known by another."""

_BIG_ANGLE, _BIG_LENGTH = 13.0, 30.0
"""A joint reading beyond two turns in rad is one in deg; a place farther than this in m is one in mm."""


@dataclass(frozen=True)
class Recognised:
    """A table, recognised by its table.

    Attributes:
        path: Its file.
        kind: Whether it is of configurations or of pairs.
        model: What is measured in it; None of configurations at which nothing is.
        columns: By the name that is known, what the table calls a column where that is another.
        present: Names of the known columns that it has, joints apart.
        length: Unit of its lengths; None where it has none, or nothing says.
        angle: Unit of its angles; the same.
        scales: Of columns whose header states another unit: what one is in those of the table.
        guessed: Which of the units are guesses from the figures.
        unused: Columns that mean nothing.
    """

    path: Path
    kind: Kind
    model: Model | None
    columns: Mapping[str, str]
    present: tuple[str, ...]
    length: str | None
    angle: str | None
    scales: Mapping[str, float] = field(default_factory=dict)
    guessed: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()

    @property
    def has_sigma(self) -> frozenset[str]:
        """Kinds of noise that its columns state."""
        of = {"sigma_x": "position", "sigma_rx": "orientation", "sigma_u": "pixel", COVARIANCE[0]: "position"}
        found = {of.get(c, c.removeprefix("sigma_")) for c in self.present if c.startswith("sigma_") or c in of}
        return frozenset(found | ({"orientation"} if COVARIANCE[0] in self.present else set()))


def recognise(path: Path, robot: Robot) -> Recognised:
    """What a table holds.

    Args:
        path: The table.
        robot: Whose joints it may be of.

    Raises:
        InputError: It cannot be read, or is neither of configurations nor of pairs.
    """
    table = Table.read(path, "table")
    joints = _joints(table.columns, robot)
    ends = {"a", "b"} <= {name.lower() for name in table.columns}
    if not joints and not ends:
        raise _unknown(table, robot)
    known = names_of(OF_PAIRS.values()) if not joints else KNOWN
    called = _called([c for c in table.columns if c not in joints.values()], known)
    columns = {**joints, **called}
    present = tuple(called)
    units = {name: _unit(table.columns, column) for name, column in columns.items()}
    lengths, angles = _of_units(present, robot, joints)
    length, angle = (_most([units[name] for name in names], of) for names, of in ((lengths, LENGTHS), (angles, ANGLES)))
    guessed: list[str] = []
    unused = tuple(c for c in table.columns if c not in columns.values())
    figures = _figures(table, columns, [*lengths, *angles])
    if length is None and lengths:
        length = "mm" if _largest(figures, lengths) > _BIG_LENGTH else "m"
        guessed.append("length")
    if angle is None and angles:
        angle = "deg" if _largest(figures, angles) > _BIG_ANGLE else "rad"
        guessed.append("angle")
    sizes = {**LENGTHS, **ANGLES}
    scales = {
        name: sizes[unit] / sizes[of or unit]
        for names, of in ((lengths, length), (angles, angle))
        for name in names
        if (unit := units[name]) is not None and unit != of
    }
    return Recognised(
        path=path,
        kind="joints" if joints else "pairs",
        model=_model(present) if joints else None,
        columns={name: column for name, column in columns.items() if name != column},
        present=present,
        length=length,
        angle=angle,
        scales=scales,
        guessed=tuple(guessed),
        unused=unused,
    )


def _unknown(table: Table, robot: Robot) -> InputError:
    n, names = robot.n_joints, ", ".join(joint.name for joint in robot.joints)
    expected = f"columns {'q1' if n == 1 else f'q1 to q{n}'}, or the joints' names {names}; or a and b of pairs"
    hint = f"the columns are {', '.join(table.columns)}"
    return InputError(table.name, "neither joint readings nor pairs", expected, hint)


def _joints(columns: Sequence[str], robot: Robot) -> dict[str, str]:
    """The columns of joint readings, by the names under which the reader takes them; empty where not all are there."""
    bare = {_bare(c).lower(): c for c in reversed(columns)}
    names = [joint.name for joint in robot.joints]
    numbers = [f"q{i + 1}" for i in range(robot.n_joints)]
    for wanted in (names, numbers):
        if all(name.lower() in bare for name in wanted) and not KNOWN & set(wanted):
            return {name: bare[name.lower()] for name in wanted}
    return _numbered(columns, robot)


def _numbered(columns: Sequence[str], robot: Robot) -> dict[str, str]:
    """Columns with a number for each joint, from 0 or 1, by `q1`, ...; empty where not all are there."""
    found: dict[int, str] = {}
    for c in columns:
        if match := _JOINT.match(_bare(c)):
            found.setdefault(int(match[1]), c)
    for first in (1, 0):
        if set(found) == set(range(first, first + robot.n_joints)):
            return {f"q{i - first + 1}": found[i] for i in sorted(found)}
    return {}


def _bare(column: str) -> str:
    """A column's name without its unit."""
    match = _BRACKETED.match(column) or _SUFFIXED.match(column)
    return match["name"].strip() if match and match["name"].strip() else column


def _unit(columns: Sequence[str], column: str) -> str | None:
    """The unit that a column's name states; None where it states none."""
    match = _BRACKETED.match(column) or _SUFFIXED.match(column)
    return None if match is None else UNITS.get(match["unit"].strip().lower())


def _called(columns: Sequence[str], known: Collection[str]) -> dict[str, str]:
    """By known name, what the table calls it: the same, in another case or with a unit, a synonym, nearly the same."""
    found = {c: c for c in columns if c in known}
    left = [c for c in columns if c not in known]
    steps = (
        lambda c: c.lower(),
        lambda c: _bare(c).lower(),
        lambda c: next((name for name, others in _SYNONYMS.items() if _bare(c).lower() in others), ""),
    )
    for step in steps:
        for c in tuple(left):
            name = step(c)
            if name in known and name not in found:
                found[name] = c
                left.remove(c)
    return dict(sorted(found.items(), key=lambda item: columns.index(item[1])))


def _of_units(present: Sequence[str], robot: Robot, joints: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Names of the columns of lengths, and of those of angles."""
    kinds = {name: one.unit for one in (*OF_CONFIGURATIONS.values(), *OF_PAIRS.values()) for name in one.names}
    lengths = [name for name in present if kinds.get(name) == "length"]
    angles = [name for name in present if kinds.get(name) == "angle"]
    for name, joint in zip(joints, robot.joints, strict=False):
        (lengths if joint.prismatic else angles).append(name)
    return lengths, angles


def _most(stated: Sequence[str | None], of: Mapping[str, float]) -> str | None:
    """The unit that most columns state; None where none does."""
    found = [unit for unit in stated if unit in of]
    return max(dict.fromkeys(found), key=found.count) if found else None


def _figures(table: Table, columns: Mapping[str, str], names: Sequence[str]) -> dict[str, float]:
    """The largest size of the figures of some columns, by known name."""
    given = [columns[name] for name in names]
    sizes = np.nanmax(np.abs(table.numbers(given, optional=True)), axis=0, initial=0.0) if given else np.zeros(0)
    return dict(zip(names, sizes.tolist(), strict=True))


def _largest(figures: Mapping[str, float], names: Sequence[str]) -> float:
    """The largest figure of what is no sigma."""
    return max((figures[name] for name in names if not name.startswith("sigma_")), default=0.0)


def _model(present: Sequence[str]) -> Model | None:
    """The model whose columns a table of configurations has."""
    there = set(present)
    turned = bool({"qw", "roll", "rx"} & there)
    placed = {"x", "y", "z"} <= there
    for column, model in (("u", "pixels"), ("board", "board"), (COVARIANCE[0], "board"), ("anchor", "anchor")):
        if column in there:
            return model
    if "plane" in there or "group" in there:
        return "plane" if "plane" in there else "distance"
    return "pose" if placed and turned else "position" if placed else "orientation" if turned else None
