"""A job for files that are there: `fg-calib init` fills a template, and marks what only its user can decide."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from fg_calib.errors import InputError, printable
from fg_calib.importers.recognise import Recognised, recognise
from fg_calib.io.robot_file import read_robot
from fg_calib.io.units import ANGLES, LENGTHS
from fg_calib.io.yaml import read_yaml
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model
from fg_calib.robot.model import Robot

_TABLES = (".csv", ".parquet", ".pq")

_NOISE: dict[str, tuple[str, ...]] = {
    "pose": ("position", "orientation"),
    "position": ("position",),
    "orientation": ("orientation",),
    "anchor": ("distance",),
    "plane": ("distance",),
    "board": ("position", "orientation"),
    "pixels": ("pixel",),
}
"""Kinds of noise of a model; pairs have those of what they were measured by."""

_OTHER_MODELS = {
    "pose": "or distance-rotation, which needs no frame; position without the orientations; board if a camera on the "
    "tool measured where a board is",
    "position": "or distance, which needs no frame",
    "orientation": "or rotation, which needs no frame",
    "anchor": "offset: estimate if the instrument adds a length of its own",
}

_TEMPLATE = """\
# A calibration job, written by fg-calib init. Lines with DECIDE are yours to look at; `fg-calib inspect` says what this
# job looks like.
robot: {robot}
{robot_notes}{measurements}units: {units}
# DECIDE the noise, 1 sigma in the units above: the values are guesses, so it is estimated from residuals;
# put your instrument's in their place and leave estimate out. joint: repeatability of the joint readings.
noise: {noise}

# The rest as it is by default:
# pairing: star        # of models of pairs: star | chain | all | {{random: 3000, seed: 0}}
# targets: {{smr1: {{x: 0.0, y: 0.0, z: {target}}}}}   # where targets are on the tool, if known
# anchors: {{bolt: {{x: {anchor}, y: 0.0, z: 0.0}}}}   # where anchors are from the base, if known
# loss: none           # huber | cauchy | geman-mcclure | gnc where there are gross errors
# gauge: prior         # what data do not determine: priors fix it; keep: it stays at nominal; none
# encoder: propagated  # estimated: the true joint values too
# pair_errors: shared  # independent: pairs of one configuration share no errors
# A column split with `test` in some rows keeps them out of the fit, to check the prediction.
"""

_NO_TOLERANCE = """\
# DECIDE how far off the nominal model may be: the robot file does not say it of all that is estimated;
# such as tolerance: {a: 0.001, d: 0.001, alpha: 0.1, theta: 0.1}, 1 sigma in its units. Without, nothing fixes what
# the measurements do not determine (gauge: keep, below, leaves it at nominal).
"""

_NO_TOOL = """\
# DECIDE whether exactly the robot file's tool was measured; if not: estimate: [tool.x, tool.y, tool.z]
# in it (and tool.roll, tool.pitch, tool.yaw where orientations were measured).
"""


@dataclass(frozen=True)
class _Inputs:
    """The files of a job, sorted.

    Attributes:
        robot_file: The robot's file.
        robot: The robot.
        tables: Tables of configurations.
        pairs: The table of pairs, if there is one.
        camera: The camera's file, if there is one.
    """

    robot_file: Path
    robot: Robot
    tables: tuple[Recognised, ...]
    pairs: Recognised | None
    camera: Path | None

    @property
    def every(self) -> tuple[Recognised, ...]:
        """All tables."""
        return (*self.tables, *(() if self.pairs is None else (self.pairs,)))


def draft_job(files: Sequence[Path], out: Path) -> str:
    """Draft the text of a job for some files.

    Args:
        files: A robot file, tables, perhaps a camera's file.
        out: Where the job will be; the paths in it are relative to its folder.

    Raises:
        InputError: There is no robot or no table among them, several of what there may be one, or one cannot be used.
    """
    inputs, folder = _sorted(files), out.parent
    robot, units = inputs.robot, _common_units(inputs)
    arm = [p for p in robot.parameters if p.estimated and 1 <= p.owner <= robot.n_joints]
    tool = [robot.parameters[i] for i in robot.owned_by(robot.n_joints + 1)]
    notes = _NO_TOLERANCE * any(p.tolerance is None for p in arm) + _NO_TOOL * (not any(p.estimated for p in tool))
    if len(inputs.tables) == 1:
        (one,) = inputs.tables
        lines = [f"measurements: {_path(one.path, folder)}", *_keys(one, inputs, folder)]
    else:
        lines = ["measurements:"]
        for table in inputs.tables:
            lines += [f"  - table: {_path(table.path, folder)}"]
            lines += [f"    {line}" for line in _keys(table, inputs, folder)]
            own = _units_of(table)
            lines += [f"    units: {_flow(own)}"] * (own not in ({}, units))
    guessed = sorted({key for table in inputs.every for key in table.guessed})
    why = f"DECIDE: {' and '.join(guessed)} guessed from the values' sizes" if guessed else "as the headers say"
    length = LENGTHS[units["length"]]
    return _TEMPLATE.format(
        robot=_path(inputs.robot_file, folder),
        robot_notes=notes,
        measurements="".join(f"{line}\n" for line in lines),
        units=f"{_flow(units)}  # {why}",
        noise=_flow(_noise(inputs, units)),
        target=float(f"{0.1 / length:.3g}"),
        anchor=float(f"{1.0 / length:.3g}"),
    )


def _sorted(files: Sequence[Path]) -> _Inputs:
    """The files, each by what it is.

    Raises:
        InputError: See `draft_job`.
    """
    robots, tables, cameras = list[Path](), list[Path](), list[Path]()
    for file in files:
        ending = file.suffix.lower()
        if ending in (".urdf", ".xacro"):
            robots.append(file)
        elif ending in _TABLES:
            tables.append(file)
        elif ending in (".yaml", ".yml"):
            (robots if _is_robot(file) else cameras).append(file)
        else:
            expected = f"robot.yaml, a .urdf, camera.yaml, or a table: {', '.join(_TABLES)}"
            raise InputError(str(file), f"ending {ending!r}", expected)
    for found, what in ((robots, "robot file"), (cameras, "camera")):
        if len(found) > 1:
            raise InputError("init", f"several {what}s: {', '.join(f.name for f in found)}", "one")
    if not robots or not tables:
        missing, expected = ("table", "poses.csv") if robots else ("robot", "robot.yaml or a URDF")
        raise InputError("init", f"no {missing} among the files", f"one, such as {expected}")
    twice = [table.name for k, table in enumerate(tables) if any(_same_file(table, other) for other in tables[:k])]
    if twice:
        raise InputError("init", f"the same table twice: {twice[0]}", "every table once")
    robot = read_robot(robots[0])
    recognised = [recognise(table, robot) for table in tables]
    pairs = _pairs_among(recognised)
    measured = _with_pairs([table for table in recognised if table.kind == "joints"], pairs)
    for table in measured:
        if table.model is None:
            hint = f"its other columns are {', '.join(table.unused)}" if table.unused else ""
            raise InputError(table.path.name, "joint readings alone", "what was measured at them, or pairs", hint)
        if table.model == "pixels" and not cameras:
            raise InputError(table.path.name, "images of a camera that is not among the files", "camera.yaml too")
    return _Inputs(robots[0], robot, tuple(measured), pairs, cameras[0] if cameras else None)


def _same_file(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file; one that is not there is told of when it is read."""
    return one.exists() and other.exists() and one.samefile(other)


def _pairs_among(tables: Sequence[Recognised]) -> Recognised | None:
    """The table of pairs among some.

    Raises:
        InputError: There are several, it stands alone, or it has columns of other names: a job cannot explain these.
    """
    pairs = [table for table in tables if table.kind == "pairs"]
    if len(pairs) > 1:
        raise InputError("init", f"several tables of pairs: {', '.join(t.path.name for t in pairs)}", "one")
    if not pairs:
        return None
    (one,) = pairs
    if len(tables) == 1:
        raise InputError(one.path.name, "pairs alone", "the table of the configurations that they are of too")
    for name, column in one.columns.items():
        if column.lower() != name:
            hint = "a job's key columns is of configurations: rename it in the table"
            raise InputError(one.path.name, f"column {column!r}", name, hint)
    return one


def _is_robot(file: Path) -> bool:
    """Whether a YAML file is a robot's, and not a camera's.

    Raises:
        InputError: It is neither.
    """
    mapping = read_yaml(file)
    if {"joints", "urdf"} & mapping.keys():
        return True
    if "fx" in mapping:
        return False
    found = "a job" if "measurements" in mapping else f"keys {', '.join(map(str, mapping))}"
    raise InputError(file.name, found, "a robot (joints, or urdf) or a camera (fx, fy, cx, cy)")


def _with_pairs(tables: Sequence[Recognised], pairs: Recognised | None) -> list[Recognised]:
    """The tables, that first which the pairs are of: at which nothing else was measured, or points were touched."""
    if pairs is None:
        return list(tables)
    distance, angle = "distance" in pairs.present, "angle" in pairs.present
    model: Model = "distance-rotation" if distance and angle else "rotation" if angle else "distance"
    ranked = sorted(tables, key=lambda t: 0 if t.model is None else 1 if "group" in t.present else 2)
    return [replace(ranked[0], model=model), *ranked[1:]]


def _path(file: Path, folder: Path) -> str:
    """A file's path as a job in the folder names it, in quotes where YAML needs them."""
    return _flow([os.path.relpath(file.absolute(), folder.absolute())])[1:-1]


def _flow(value: Any) -> str:
    """A value of YAML on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False, allow_unicode=False).strip()


def _keys(table: Recognised, inputs: _Inputs, folder: Path) -> list[str]:
    """Lines of the keys of a table, with comments."""
    lines = []
    if inputs.pairs is not None and table is inputs.tables[0]:
        which = "  # DECIDE whether they are of this table" * (len(inputs.tables) > 1)
        lines.append(f"pairs: {_path(inputs.pairs.path, folder)}{which}")
    other = _OTHER_MODELS.get(str(table.model))
    lines.append(f"model: {table.model}" + (f"  # {other}" if other else ""))
    if table.model in POSE_MODELS:
        lines.append("frame: unknown  # DECIDE: known only if the measurement frame is the robot's base frame")
    if table.model == "pixels" and inputs.camera is not None:
        room = "DECIDE: if it stands in the room, {file: ..., fixed: true}, and frame: unknown"
        lines.append(f"camera: {_path(inputs.camera, folder)}  # {room}")
    if table.columns:
        scales = table.scales
        columns = {k: {"name": c, "scale": scales[k]} if k in scales else c for k, c in table.columns.items()}
        lines.append(f"columns: {_flow(columns)}  # DECIDE whether these are what the names mean")
    if table.unused:
        lines.append(f"# not used: {printable(', '.join(table.unused))[:90]}")
    return lines


def _units_of(table: Recognised) -> dict[str, str]:
    return {key: unit for key in ("length", "angle") if (unit := getattr(table, key)) is not None}


def _common_units(inputs: _Inputs) -> dict[str, str]:
    """The units at the top: those of the first table that states them."""
    found: dict[str, str] = {"length": "m", "angle": "rad"}
    for table in reversed(inputs.every):
        found |= _units_of(table)
    return found


def _noise(inputs: _Inputs, units: dict[str, str]) -> dict[str, Any]:
    """Guesses of noise that the tables do not state: 0.1 mm, 0.2 mrad, 0.2 px."""
    guesses = dict.fromkeys(("position", "distance", "point"), 1e-4 / LENGTHS[units["length"]])
    guesses |= dict.fromkeys(("orientation", "angle"), 2e-4 / ANGLES[units["angle"]]) | {"pixel": 0.2}
    found: dict[str, Any] = {}
    for table in inputs.tables:
        if table.model not in PAIR_MODELS:
            kinds = [kind for kind in _NOISE[str(table.model)] if kind not in table.has_sigma]
        else:
            pairs = inputs.pairs if table is inputs.tables[0] else None
            kinds = ["point"] if "group" in table.present and "point" not in table.has_sigma else []
            present = () if pairs is None else set(pairs.present) - pairs.has_sigma
            kinds += [kind for kind in ("distance", "angle") if kind in present]
        found |= {kind: float(f"{guesses[kind]:.2g}") for kind in kinds}
    return {**found, "joint": 0.0, "estimate": True}
