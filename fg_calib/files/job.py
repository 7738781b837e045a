"""Calibration jobs: which robot, which measurements, which model."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StrictBool

from fg_calib.errors import InputError
from fg_calib.files.disk import noting_reads
from fg_calib.files.robot_yaml import read_robot, robot_from_mapping
from fg_calib.files.schema import Count, NotNegative, Positive, Schema, read_yaml, shown, validate
from fg_calib.files.tables import read_measurements
from fg_calib.files.units import Units, UnitsOfFile
from fg_calib.job import Job
from fg_calib.measurements.dataset import Noise
from fg_calib.measurements.series import Table
from fg_calib.options import EncoderNoise, FrameKnowledge, Gauge, Loss, Model, Options, PairErrors, Pairing, check_names
from fg_calib.robot.model import Robot, names_of

_log = logging.getLogger(__name__)

UNSTATED = Noise(position=1e-3, orientation=1e-3, distance=1e-3, angle=1e-3, point=1e-3)
"""Where the noise starts from if it is to be estimated and nothing was stated."""


class _Noise(Schema):
    position: Positive | None = None
    orientation: Positive | None = None
    joint: Any = 0.0  # an `_OneFigure` or a `_FigureEach`
    distance: Positive | None = None
    angle: Positive | None = None
    point: Positive | None = None
    estimate: StrictBool = False


class _OneFigure(Schema):
    joint: NotNegative


class _FigureEach(Schema):
    joint: tuple[NotNegative, ...]


class _RandomPairing(Schema):
    random: Annotated[Count, Field(gt=0)]
    seed: Count = 0


class _JobOfTables(Schema):
    robot: Any  # a path, or the mapping of a robot file
    measurements: Any  # the path of a table, or a list of `_Table`
    pairs: str | None = None
    model: Model | None = None
    pairing: Any = "star"  # a strategy's name, or a `_RandomPairing`
    frame: FrameKnowledge = "known"
    units: UnitsOfFile = Units()
    noise: Any = None  # a `_Noise`, or `estimate`
    prior: StrictBool | None = None
    gauge: Gauge = "prior"
    prefer: tuple[str, ...] = ()
    pair_errors: PairErrors = "shared"
    encoder: EncoderNoise = "propagated"
    loss: Loss = "none"
    max_iterations: Annotated[Count, Field(gt=0)] | None = None
    truth: str | None = None


class _Job(_JobOfTables):
    model: Model


class _Table(Schema):
    table: str
    pairs: str | None = None
    model: Model | None = None
    pairing: Any = None
    frame: FrameKnowledge | None = None
    units: UnitsOfFile | None = None
    noise: Any = None


_CHOICES = ("model", "frame", "prior", "gauge", "prefer", "pair_errors", "encoder", "loss", "max_iterations")
"""Keys of a job that are options as they stand."""


def read_job(path: Path | str) -> Job:
    """The calibration job in a YAML file, with its robot and its measurements.

    Args:
        path: The job; the paths in it are relative to its folder.

    Raises:
        InputError: It or a file that it names is missing or cannot be used.
    """
    path = Path(path)
    with noting_reads() as files:
        job = _job(path)
    return replace(job, inputs={_relative(file, path.parent): digest for file, digest in files.items()})


def _relative(file: Path, folder: Path) -> str:
    """A file's path as a job in this folder names it."""
    return str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)


def _job(path: Path) -> Job:
    folder = path.parent
    given = read_yaml(path)
    several = isinstance(given, dict) and isinstance(given.get("measurements"), list)
    file: _JobOfTables = validate(_JobOfTables if several else _Job, given, path.name)
    robot = robot_of(file.robot, f"{path.name}: robot", folder, file.units)
    _check_preferred(file, robot, path.name)
    _, estimate_noise = _noise(file.noise, file.units, robot, f"{path.name}: noise")
    tables = _tables(file, robot, path)
    alone = tables[0].measurements if isinstance(file.measurements, str) else tuple(tables)
    truth = None if file.truth is None else _truth(folder / file.truth, robot)
    return Job(path, robot, alone, _options(file, estimate_noise, path.name, tables[0]), truth)


def _tables(file: _JobOfTables, robot: Robot, path: Path) -> list[Table]:
    """The tables of a job; what an entry leaves out is as the job says for all."""
    given, folder = file.measurements, path.parent
    if not isinstance(given, str) and not (isinstance(given, list) and given):
        raise InputError(f"{path.name}: measurements", f"found {shown(given)}", "a path, or a list of tables")
    whole = isinstance(given, str)
    if not whole and file.pairs is not None:
        raise InputError(f"{path.name}: pairs", "beside a list of tables", "the key in the table's own entry")
    entries = [{"table": given, "pairs": file.pairs}] if whole else given
    tables = []
    for number, one in enumerate(entries):
        place = path.name if whole else f"{path.name}: measurements[{number}]"
        entry = validate(_Table, one, place)
        model = entry.model or file.model
        if model is None:
            raise InputError(place, "missing key 'model'")
        units = entry.units or file.units
        stated, _ = _noise(file.noise, file.units, robot, f"{path.name}: noise")
        if entry.noise is not None:
            own, estimate = _noise(entry.noise, units, robot, f"{place}: noise")
            if estimate or "estimate" in entry.noise:
                raise InputError(
                    f"{place}: noise", "estimate in the entry of a table", "the key noise of the whole job"
                )
            figures = {key: getattr(own, key) for key in entry.noise}
            stated = replace(stated, **figures)
        pairing = _pairing(file.pairing if entry.pairing is None else entry.pairing, f"{place}: pairing")
        pairs = None if entry.pairs is None else folder / entry.pairs
        measurements = read_measurements(folder / entry.table, robot, pairs=pairs, units=units, noise=stated)
        tables.append(Table(measurements, model, pairing, entry.frame or file.frame))
    return tables


def _options(file: _JobOfTables, estimate_noise: bool, place: str, first: Table) -> Options:
    """The choices of a job; its old key `prior: false` is `gauge: none`."""
    choices = {key: getattr(file, key) for key in _CHOICES} | {"model": first.model}
    pairing = _pairing(file.pairing, f"{place}: pairing")
    return Options.of(**choices, pairing=pairing, estimate_noise=estimate_noise)


def check_choices(choices: Mapping[str, Any], robot: Robot, place: str) -> None:
    """Check keys of a job for a robot before there is a job: model, pairing, gauge, ...

    Args:
        choices: The keys and their values, without `robot` and `measurements`.
        robot: The robot.
        place: File and key, for messages.

    Raises:
        InputError: A job with these keys could not be read.
    """
    file = validate(_Job, {"robot": "", "measurements": "", **choices}, place)
    _pairing(file.pairing, f"{place}: pairing")
    _check_preferred(file, robot, place)


def _check_preferred(file: _JobOfTables, robot: Robot, place: str) -> None:
    check_names(f"{place}: prefer", file.prefer, names_of(robot.parameters))


def robot_of(given: object, place: str, folder: Path, units: Units) -> Robot:
    """The robot under a key `robot`.

    Args:
        given: A path relative to `folder`, or the mapping of a robot file.
        place: File and key, for messages.
        folder: The folder of the file that names it.
        units: Of that file; a URDF's `tolerance`, `base` and `tool` that stand in it are in these unless they state
            their own. A mapping of DH rows is a robot file of its own: m and rad unless it states others.

    Raises:
        InputError: It is neither, or does not describe a robot.
    """
    if isinstance(given, dict):
        if "urdf" in given and "units" not in given:
            if units != Units() and (given.get("base") or given.get("tool")):
                _log.warning("%s: base and tool are in %s and %s, as the file's units say", place, *astuple(units))
            given = {**given, "units": units}
        return robot_from_mapping(given, place, folder)
    if not isinstance(given, str):
        raise InputError(place, f"found {shown(given)}", "a path, or the mapping of a robot file")
    return read_robot(folder / given)


def _truth(path: Path, robot: Robot) -> Robot:
    """The true robot: the nominal one with other values."""
    truth = read_robot(path)
    if names_of(truth.parameters) != names_of(robot.parameters) or truth.convention != robot.convention:
        raise InputError(path.name, "another robot", f"the parameters of {robot.name}, with their true values")
    return truth


def _pairing(given: object, place: str) -> Pairing:
    match given:
        case "star" | "chain" | "all":
            return Pairing(given)
        case dict():
            file = validate(_RandomPairing, given, place)
            return Pairing("random", file.random, file.seed)
    raise InputError(place, f"found {shown(given)}", "one of star, chain, all, {random: N, seed: S}")


def _noise(given: object, units: Units, robot: Robot, place: str) -> tuple[Noise, bool]:
    """The noise in [m] and [rad], that of the readings joint by joint, and whether it is only where to start."""
    if given == "estimate":
        return replace(UNSTATED, joint=(0.0,) * robot.n_joints), True
    if given is not None and not isinstance(given, dict):
        raise InputError(place, f"found {shown(given)}", "a mapping of figures, or estimate")
    file = validate(_Noise, given or {}, place)

    def si(figure: float | None, unit: str) -> float | None:
        return None if figure is None else figure * units.factor(unit)

    noise = Noise(
        position=si(file.position, "m"),
        orientation=si(file.orientation, "rad"),
        joint=joint_noise(file.joint, units, robot, place),
        distance=si(file.distance, "m"),
        angle=si(file.angle, "rad"),
        point=si(file.point, "m"),
    )
    if not file.estimate:
        return noise, False
    missing = {f.name: getattr(UNSTATED, f.name) for f in fields(Noise) if getattr(noise, f.name) is None}
    return replace(noise, **missing), True


def joint_noise(given: object, units: Units, robot: Robot, place: str) -> tuple[float, ...]:
    """Sigma of each joint's readings, [rad] (prismatic: [m]), from one figure for all or one a joint.

    Raises:
        InputError: It is neither.
    """
    if isinstance(given, list):
        figures = validate(_FigureEach, {"joint": given}, place).joint
        if len(figures) != robot.n_joints:
            expected = f"one for all or {robot.n_joints}, one a joint"
            raise InputError(f"{place}: joint", f"{len(figures)} figures", expected)
    else:
        figures = (validate(_OneFigure, {"joint": given}, place).joint,) * robot.n_joints
        kinds = {joint.unit: joint.name for joint in reversed(robot.joints)}
        if figures[0] > 0.0 and len(kinds) > 1:
            words = " and ".join(f"{given} {units.name(unit)} for {name}" for unit, name in sorted(kinds.items()))
            _log.warning("%s: joint: %s is %s; a list has one figure a joint", place, given, words)
    return tuple(f * units.factor(j.unit) for f, j in zip(figures, robot.joints, strict=True))
