"""A job for existing files: `fg-calib init` recognises tables by their headers and fills a template.

Lines marked DECIDE hold what only the user knows.
"""

import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jinja2 import Template

from fg_calib import io
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, InputError, Model, Record, expect, printable
from fg_calib.io import ANGLES, KNOWN, LENGTHS, OF_PAIRS, Table, decoded, names_of, read_bytes, read_robot, read_yaml
from fg_calib.measurements import COVARIANCE, INSTRUMENTS
from fg_calib.robot import Robot

_ENDINGS = {
    **dict.fromkeys((".csv", ".parquet", ".pq"), "table"),
    **dict.fromkeys((".urdf", ".xacro"), "robot"),
    **dict.fromkeys((".yaml", ".yml"), "yaml"),
}
"""Content of files by their ending."""

_UNIT = r"um|mm|cm|m|inch|in|mrad|rad|radians|degrees|deg|°|px"
_HEADER = re.compile(rf"^(?P<name>.*?\S)(?:\s*[\[(]\s*(?P<bracket>{_UNIT})\s*[\])]|[_\s](?P<suffix>{_UNIT}))$", re.I)
_SPELLINGS = {"inch": "in", "radians": "rad", "degrees": "deg", "°": "deg"}

_OTHER_NAMES = (
    (r"(?:actual[ _])?(?:q|j|a|axis|joint|theta|th)[ _-]?(?:pos|position|angle)?[ _-]?0*(\d+)", r"q\1"),
    (r"(?:pos_|position_|p|tcp_|t)([xyz])", r"\1"),
    (r"(?:q_|quat_|orientation_)([xyzw])", r"q\1"),
    ("reflector|reflektor|smr|marker|prism|ball", "target"),
    ("post|pole|anker|fixpoint|fixed[ _]point", "anchor"),
    ("tracker|standpunkt|setup", "station"),
    ("configuration|config|pose|point|punkt|name|number|no|nr|#", "id"),
    ("dist|length|l[aä]nge|abstand|range", "distance"),
)
"""Patterns of other names that tables have for columns, and the known name; joints may count from 0."""

_MODELS: dict[str, Model] = {
    **{"u": "pixels", "board": "board", COVARIANCE[0]: "board", "anchor": "anchor", "plane": "plane"},
    "group": "distance",
}
"""Models by a column that no other has, in order of precedence."""

_UNITS = {"length": (LENGTHS, "m", "mm", 30.0), "angle": (ANGLES, "rad", "deg", 13.0)}
"""Units of each kind, the guessed one, and the one that is guessed if a value exceeds the number."""

_TEMPLATE = Path(__file__).with_name("job.yaml.jinja")
"""The text of a job."""

_GUESSES = {"orientation": ("angle", 2e-4), "angle": ("angle", 2e-4), "pixel": ("", 0.2)}
"""Noise to start from by kind, [rad] or [px]; 1e-4 m of others."""


class _Recognised(Record):
    """A table, recognised by its header.

    Attributes:
        path: Its file.
        model: Model of its measurements; None for joint readings alone and for pairs.
        present: Known columns that it or its table of pairs has, except those of joints.
        columns: Headers of columns that have another name in the table, by the known name.
        units: Its units of `length` and `angle`, if it has such columns.
        unused: Columns without a meaning.
        skip_lines: Lines before its header.
        repeats: Whether several rows have the same joint readings, whose errors they share.
        pairs: The file of pairs of its configurations, if there is one.
    """

    path: Path
    model: Model | None
    present: tuple[str, ...]
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    skip_lines: int = 0
    repeats: bool = False
    pairs: Path | None = None

    @property
    def noise(self) -> list[str]:
        """Kinds of noise that its model needs and no column specifies."""
        kinds = INSTRUMENTS[str(self.model)].noise
        if self.model in PAIR_MODELS:  # contact points have only the pairs that were measured
            kinds = tuple(kind for kind in kinds if self.pairs is not None and kind in self.present)
            kinds = (*(("point",) if "group" in self.present else ()), *kinds)
        columns = {"position": "x", "orientation": "rx", "pixel": "u"}
        if COVARIANCE[0] in self.present:
            return []
        return [k for k in kinds if not {f"sigma_{k}", f"sigma_{columns.get(k, k)}"}.intersection(self.present)]


# --- a table ----------------------------------------------------------------------------------------------------------


def _recognise(path: Path, robot: Robot) -> _Recognised:
    """Recognise the content of a table.

    Raises:
        InputError: The table cannot be read, is neither of configurations nor of pairs, or mixes units.
    """
    skip_lines = _lines_before_header(path)
    table = Table.read(path, "table", skip_lines=skip_lines)
    headers = [_HEADER.match(column) for column in table.columns]
    bare = [match["name"].lower() if match else c.lower() for match, c in zip(headers, table.columns, strict=True)]
    written = [(match["bracket"] or match["suffix"]).lower() if match else "" for match in headers]
    joints = _find_joints(bare, robot)
    is_pairs = not joints and {"a", "b"} <= set(bare)
    numbered = "q1" if robot.n_joints == 1 else f"q1 to q{robot.n_joints}"
    names = ", ".join(joint.name for joint in robot.joints)
    expected = f"columns {numbered}, or the joints' names {names}; or a and b of pairs"
    hint = f"the columns are {', '.join(table.columns)}"
    expect(joints or is_pairs, table.name, "neither joint readings nor pairs", expected, hint)
    sets = (OF_PAIRS if is_pairs else io.OF_CONFIGURATIONS).values()
    known, every = names_of(sets), dict(joints)
    for k in sorted(range(len(bare)), key=lambda k: table.columns[k] not in known):
        name = bare[k] if bare[k] in known else _known_name(bare[k])
        if name in known and k not in joints.values() and (name != "id" or table.frame[:, k].is_unique().all()):
            every.setdefault(name, k)
    kinds = {name: of.unit for of in sets for name in of.names}
    kinds |= {n: "length" if joint.prismatic else "angle" for n, joint in zip(joints, robot.joints, strict=False)}
    units = dict[str, str]()
    for kind, (possible, *_) in _UNITS.items():
        of_kind = {name: k for name, k in every.items() if kinds.get(name) == kind}
        there = {_SPELLINGS.get(written[k], written[k]) for k in of_kind.values() if written[k]}
        if len(there) > 1 or not there <= possible.keys():
            raise InputError(table.name, f"{kind}s in {', '.join(sorted(there))}", f"one of {', '.join(possible)}")
        if of_kind:
            units[kind] = there.pop() if there else _guess_unit(table, kind, of_kind)
    present = tuple(name for name in every if name not in joints)
    model = None if is_pairs else _find_model(set(present))
    columns = {name: table.columns[k] for name, k in every.items() if name != table.columns[k]}
    unused = tuple(c for k, c in enumerate(table.columns) if k not in every.values() and c != "id")
    repeats = bool(joints) and table.frame[:, list(joints.values())].is_duplicated().any()
    return _Recognised(path, model, present, columns, units, unused, skip_lines, repeats)


def _lines_before_header(path: Path) -> int:
    """Lines of a CSV before the first with as many cells as most have, and all different: units repeat."""
    if path.suffix.lower() != ".csv":
        return 0
    lines = decoded(read_bytes(path), path.name, "cp1252").rstrip().splitlines() or [""]
    separator = next((one for one in ";\t," if one in lines[len(lines) // 2]), ",")  # commas may be of decimals
    rows = [line.split(separator) for line in lines]
    usual = Counter(map(len, rows)).most_common(1)[0][0]
    different = [len(set(row)) * (len(row) == usual) for row in rows]
    return different.index(max(different))


def _known_name(header: str) -> str:
    """The known name of a column by another one; empty if there is none."""
    matches = ((re.fullmatch(pattern, header), name) for pattern, name in _OTHER_NAMES)
    return next((match.expand(name) for match, name in matches if match), "")


def _find_joints(bare: Sequence[str], robot: Robot) -> dict[str, int]:
    """Columns of joint readings by the names under which they are read; empty where not all are there."""
    place = {name: k for k, name in reversed(list(enumerate(bare)))}
    names = [joint.name for joint in robot.joints]
    if not KNOWN & set(names) and all(name.lower() in place for name in names):
        return {name: place[name.lower()] for name in names}
    numbered = {name: k for header, k in place.items() if re.fullmatch(r"q\d+", name := _known_name(header))}
    first = 0 if "q0" in numbered else 1
    wanted = [f"q{first + i}" for i in range(robot.n_joints)]
    return {f"q{i + 1}": numbered[n] for i, n in enumerate(wanted)} if set(numbered) == set(wanted) else {}


def _guess_unit(table: Table, kind: str, columns: Mapping[str, int]) -> str:
    """The unit of columns without one in their headers, by their largest value."""
    given = [table.columns[k] for name, k in columns.items() if not name.startswith("sigma_")]
    _, usual, other, limit = _UNITS[kind]
    return other if given and np.nanmax(np.abs(table.numbers(given, optional=True)), initial=0.0) > limit else usual


def _find_model(present: set[str]) -> Model | None:
    """The model whose columns a table of configurations has."""
    models = [model for column, model in _MODELS.items() if column in present]
    needed = {model: {*i.generic_columns, *i.labels} for model, i in INSTRUMENTS.items() if i.generic_columns}
    models += [model for model, columns in needed.items() if columns <= present]
    position, orientation = {"x", "y", "z"} <= present, bool({"qw", "roll", "rx"} & present)
    models += [model for model, of in POSE_MODELS.items() if of == (orientation, position)]
    return next(iter(models), None)


# --- the job ----------------------------------------------------------------------------------------------------------


def draft_job(files: Sequence[Path], out: Path) -> str:
    """Draft the text of a job for some files.

    Args:
        files: A robot file, tables, perhaps a camera's file.
        out: Where the job will be; the paths in it are relative to its folder.

    Raises:
        InputError: Robot or table are missing, there are several robots or cameras, or a file cannot be used.
    """
    found = _sort(files)
    robot = read_robot(found["robot"][0])
    tables = _with_pairs([_recognise(path, robot) for path in found["table"]])
    for table in tables:
        if table.model is None:
            hint = f"its other columns are {', '.join(table.unused)}" if table.unused else ""
            raise InputError(table.path.name, "joint readings alone", "what was measured at them, or pairs", hint)
        if "camera" in INSTRUMENTS[table.model].options and not found["camera"]:
            raise InputError(table.path.name, "images of a camera that is not among the files", "camera.yaml too")
    units = {"length": "m", "angle": "rad"}
    for one in reversed(tables):  # those of the first table
        units |= one.units
    factors = {"": 1.0, "length": LENGTHS[units["length"]], "angle": ANGLES[units["angle"]]}
    sigmas = {kind: _GUESSES.get(kind, ("length", 1e-4)) for table in tables for kind in table.noise}
    noise = {kind: float(f"{sigma / factors[of]:.2g}") for kind, (of, sigma) in sigmas.items()}
    joint = float(f"{1e-4 / factors['angle']:.2g}") if any(table.repeats for table in tables) else 0.0
    arm = [p for p in robot.parameters if p.estimated and 1 <= p.owner <= robot.n_joints]
    tool = [robot.parameters[i] for i in robot.owned_by(robot.n_joints + 1)]
    template = Template(_TEMPLATE.read_text("utf-8"), trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    return template.render(
        robot=_path(found["robot"][0], out.parent),
        without_tolerance=any(p.tolerance is None for p in arm),
        without_tool=not any(p.estimated for p in tool),
        tables=tables,
        path=lambda file: _path(file, out.parent),
        camera=next(iter(found["camera"]), None),
        units=units,
        noise={**noise, "joint": joint, "estimate": True},
        **{"INSTRUMENTS": INSTRUMENTS, "POSE_MODELS": POSE_MODELS, "flow": _flow, "printable": printable},
    )


def _sort(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Files of the robot, of tables and of the camera.

    Raises:
        InputError: See `draft_job`.
    """
    found: dict[str, list[Path]] = {"robot": [], "table": [], "camera": []}
    for file in files:
        kind = _ENDINGS.get(file.suffix.lower(), "")
        if kind == "yaml":
            keys = read_yaml(file).keys()
            kind = "camera" if "fx" in keys else "robot" if {"joints", "urdf"} & keys else ""
        expected = "robot.yaml (joints, or urdf), a .urdf, camera.yaml (fx), or a table: .csv, .parquet"
        expect(kind, file.name, "neither robot, camera nor table", expected)
        found[kind].append(file)
    for kind, example in (("robot", "robot.yaml or a URDF"), ("table", "poses.csv")):
        expect(found[kind], "init", f"no {kind} among the files", f"one, such as {example}")
    for kind in ("robot", "camera"):
        expect(len(found[kind]) <= 1, "init", f"several {kind}s: {', '.join(f.name for f in found[kind])}", "one")
    return found


def _with_pairs(recognised: Sequence[_Recognised]) -> list[_Recognised]:
    """Tables of configurations, first that of the pairs: one without other measurements, if there is any.

    Raises:
        InputError: There are several tables of pairs, or one alone.
    """
    pairs, tables = ([one for one in recognised if ("a" in one.present) == which] for which in (True, False))
    expect(len(pairs) <= 1, "init", f"several tables of pairs: {', '.join(t.path.name for t in pairs)}", "one")
    if not pairs:
        return tables
    expect(tables, pairs[0].path.name, "pairs alone", "the table of the configurations that they are of too")
    first, *others = sorted(tables, key=lambda t: 0 if t.model is None else 1 if "group" in t.present else 2)
    measured = ("distance" in pairs[0].present, "angle" in pairs[0].present)
    model = {of: model for model, of in PAIR_MODELS.items()}.get(measured, "distance")
    present, units = (*first.present, *pairs[0].present), {**pairs[0].units, **first.units}
    return [replace(first, model=model, pairs=pairs[0].path, present=present, units=units), *others]


def _path(file: Path, folder: Path) -> str:
    """A file's path as a job in the folder names it, in quotes where YAML needs them."""
    return _flow([os.path.relpath(file.absolute(), folder.absolute())])[1:-1]


def _flow(value: Any) -> str:
    """A value of YAML on one line."""
    plain = str(value).isprintable()  # not those that turn or hide text
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False, allow_unicode=plain).strip()
