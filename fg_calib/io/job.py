"""Calibration jobs: which robot, which measurements, which model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StrictBool

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.io.atomic import exists, is_folder, noting_reads
from fg_calib.io.columns import Column
from fg_calib.io.instruments import camera_of, read_camera
from fg_calib.io.robot_file import read_robot, robot_from_mapping
from fg_calib.io.tables import read_measurements, read_points
from fg_calib.io.units import UNITS, Units, UnitsOfFile, quantity
from fg_calib.io.yaml import (
    Count,
    FilePath,
    NotNegative,
    Number,
    Positive,
    Schema,
    Section,
    Seed,
    meaning,
    read_yaml,
    shown,
    validate,
)
from fg_calib.job import Job
from fg_calib.measurements.dataset import Measurements, Noise
from fg_calib.measurements.kinds import Camera
from fg_calib.measurements.table import KnownPoint, Table
from fg_calib.options import (
    LIMITED,
    POSE_MODELS,
    EncoderNoise,
    FrameKnowledge,
    Gauge,
    Limits,
    Loss,
    Model,
    Options,
    PairErrors,
    Pairing,
    SharedScale,
    check_names,
    did_you_mean,
)
from fg_calib.robot.model import Robot, names_of

_log = logging.getLogger(__name__)

UNSTATED = Noise(position=1e-3, orientation=1e-3, distance=1e-3, angle=1e-3, point=1e-3, pixel=1.0)
"""Where the noise starts from if it is to be estimated and nothing was stated."""


class _Noise(Schema):
    position: Positive | None = meaning("Of a measured position, on each axis", None)
    orientation: Positive | None = meaning("Of a measured orientation, about each axis", None)
    joint: Any = meaning(
        "Of the joint readings, each in its joint's unit",
        0.0,
        kind="number not below 0, or a list of them, one a joint",
    )
    distance: Positive | None = meaning("Of a directly measured distance: of pairs, to anchors, from planes", None)
    angle: Positive | None = meaning("Of a directly measured rotation angle of pairs", None)
    point: Positive | None = meaning("Of a touch of a point, on each axis", None)
    pixel: Positive | None = meaning("Of a corner's image, along u and v, in pixels", None)
    estimate: StrictBool = meaning(
        "Whether the figures are only where to start, and the noise is estimated from the residuals", False
    )


class _OneFigure(Schema):
    joint: NotNegative


class _FigureEach(Schema):
    joint: tuple[NotNegative, ...]


class _RandomPairing(Schema):
    random: Annotated[Count, Field(gt=0)] = meaning("Number of different pairs that are drawn")
    seed: Seed = meaning("What random numbers begin with", 0)


_NOISE = "mapping, or `estimate`"
_PAIRING = "star | chain | all | {random: N}"
_CAMERA = "path, or mapping"
_LIMIT = "number, or text such as 0.5 mm"

_COLUMNS = "By the name that is known here (q1, x, group, ...) what the table calls a column"


class _JobOfTables(Schema):
    robot: Any = meaning(
        "The nominal robot: a robot file, a URDF, or what would stand in a robot file", kind="path, or mapping"
    )
    measurements: Any = meaning("What was measured: a table, or a list with an entry a table", kind="path, or list")
    pairs: FilePath | None = meaning("Table of pairs that were measured directly", None)
    model: Model | None = meaning(
        "What of the measurements is compared with the arm; each entry of a list may have its own", None
    )
    pairing: Any = meaning("How pairs are formed from poses where none were measured directly", "star", kind=_PAIRING)
    frame: FrameKnowledge = meaning(
        "Whether the measurement frame is the base, or world_T_base is estimated too", "known"
    )
    units: UnitsOfFile = meaning("Of the tables and of the figures in this file", Units(), kind="mapping")
    noise: Any = meaning("1 sigma of what was measured, where the tables do not say it row by row", None, kind=_NOISE)
    prior: StrictBool | None = meaning("Older word for gauge: false is gauge: none", None)
    gauge: Gauge = meaning(
        "What holds directions that the data do not determine: tolerances; leaving parameters out; nothing", "prior"
    )
    prefer: tuple[str, ...] = meaning("With gauge keep: parameters to keep, first choice first", ())
    pair_errors: PairErrors = meaning("Whether pairs of one configuration share its errors", "shared")
    encoder: EncoderNoise = meaning(
        "Whether joint noise is added to that of the rows, or true joint values are estimated", "propagated"
    )
    loss: Loss = meaning("What becomes of gross errors: least squares, or a robust loss", "none")
    max_iterations: Annotated[Count, Field(gt=0)] | None = meaning(
        "Steps after which the solver gives up; 200 if left out", None
    )
    accept: Any = meaning(
        "The largest RMS errors, where rows are held out, with which the arm is good enough", None, kind="mapping"
    )
    folds: Annotated[Count, Field(ge=2)] | None = meaning(
        "Into how many folds configurations are dealt to hold each out once; none if left out",
        None,
        kind="whole number above 1",
    )
    truth: FilePath | None = meaning("The true robot, where a simulation knows it", None)
    targets: dict[str, Any] = meaning(
        "Where targets are on the tool, by name; others are estimated", {}, kind="mapping of points"
    )
    anchors: dict[str, Any] = meaning(
        "Where anchors are in the base frame, by name; others are estimated", {}, kind="mapping of points"
    )
    tolerance: Any = meaning(
        "1 sigma of all targets, or anchors, that are named with a place; whether the robot's tolerances are estimated",
        None,
        kind="mapping, or `estimate`",
    )
    offset: Literal["estimate"] | None = meaning("Whether an unknown length is in every distance to an anchor", None)
    camera: Any = meaning("Of model pixels: the camera that took the images", None, kind=_CAMERA)
    columns: dict[str, Any] | None = meaning(_COLUMNS, None, kind="mapping of columns")


class _Job(_JobOfTables):
    model: Model


class _Table(Schema):
    table: FilePath = meaning("The table: CSV or Parquet")
    pairs: FilePath | None = meaning("Table of pairs that were measured directly", None)
    model: Model | None = meaning("What of it is compared with the arm", None)
    pairing: Any = meaning("How pairs are formed from its poses", None, kind=_PAIRING)
    frame: FrameKnowledge | None = meaning(
        "Whether its measurement frame is the base; each unknown one is its own", None
    )
    units: UnitsOfFile | None = meaning("Of the table and of the figures in this entry", None, kind="mapping")
    noise: Any = meaning("1 sigma of what was measured", None, kind="mapping")
    offset: Literal["estimate"] | None = meaning("Whether an unknown length is in every distance to an anchor", None)
    camera: Any = meaning(
        "Of model pixels: the camera; `fixed`: that of the job, in the room", None, kind=_CAMERA + ", or `fixed`"
    )
    columns: dict[str, Any] | None = meaning(_COLUMNS, None, kind="mapping of columns")


class _Column(Schema):
    name: str = meaning("In the table's header")
    scale: Number = meaning("What one of its units is in those of the table", 1.0)
    zero: Number = meaning("The figure that means 0: a cell is (figure - zero) * scale", 0.0)


class _Point(Schema):
    x: Number = meaning("Its place")
    y: Number = meaning("Its place")
    z: Number = meaning("Its place")
    tolerance: Positive | None = meaning("1 sigma of that on each axis; exact if left out", None)


class _Accept(Schema):
    position: Any = meaning("Of the tool", None, kind=_LIMIT)
    orientation: Any = meaning("Of the tool", None, kind=_LIMIT)
    distance: Any = meaning("Of distances and lengths", None, kind=_LIMIT)
    angle: Any = meaning("Of angles between configurations", None, kind=_LIMIT)


class _CameraOfJob(Schema):
    file: FilePath | None = meaning("The camera's file: fx fy cx cy in pixels, and OpenCV's k1 k2 p1 p2 k3", None)
    fixed: StrictBool = meaning("Whether it stands in the room, and the board is on the tool", False)


class _Tolerances(Schema):
    estimate: SharedScale | None = meaning(
        "Whether the robot's tolerances are only where to start (1 mm and 1 mrad where it has none), and scaled to the"
        " corrections seen: by one factor for each kind of parameter (a, theta, ...), or for each joint",
        None,
    )
    targets: Positive | None = meaning("Of targets", None)
    anchors: Positive | None = meaning("Of anchors", None)


SECTIONS = (
    Section("", _JobOfTables, "Paths are relative to the job's folder.", required=("model",)),
    Section("measurements: each entry of a list", _Table, "What an entry leaves out is as the keys at the top say."),
    UNITS,
    Section("noise", _Noise, "1 sigma, in the file's units. `noise: estimate` is `{estimate: true}`."),
    Section(
        "pairing", _RandomPairing, "star: the first pose with each other; chain: each with the next; or a mapping."
    ),
    Section("accept", _Accept, "Judged by test rows, or else by `folds`. In the file's units, or with their own."),
    Section("targets, anchors: each point", _Point),
    Section("tolerance", _Tolerances, "`tolerance: estimate` is `{estimate: kind}`."),
    Section("camera", _CameraOfJob, "A path, or the figures of a camera's file themselves, or"),
    Section("columns: each column", _Column, "A column's name alone, or"),
)
"""The mappings of a job, for the reference."""


_CHOICES = ("model", "frame", "prior", "gauge", "prefer", "pair_errors", "encoder", "loss", "max_iterations", "folds")
"""Keys of a job that are options as they stand."""


@checked
def read_job(path: Path | str) -> Job:
    """The calibration job in a YAML file, with its robot and its measurements.

    Args:
        path: The job; the paths in it are relative to its folder.

    Raises:
        InputError: It or a file that it names is missing or cannot be used.
    """
    return read_job_by(Path(path), read_measurements)


def read_job_by(path: Path, read: Callable[..., Measurements]) -> Job:
    """The same with its tables read by a function that takes what `read_measurements` does.

    Raises:
        InputError: The job or a file that it names is missing or cannot be used.
    """
    with noting_reads() as files:
        job = _job(path, read)
    return replace(job, inputs={_relative(file, path.parent): digest for file, digest in files.items()})


@checked
def is_job(path: Path | str) -> bool:
    """Whether a file is a job, by what only jobs name: what was measured.

    Args:
        path: The file; one that is not there is none.
    """
    if not exists(Path(path)) or is_folder(Path(path)):
        return False
    given = read_yaml(Path(path))
    return isinstance(given, dict) and "measurements" in given


def units_of(job: Job) -> Units:
    """The units of a job's tables: of the first, if they have their own."""
    first = job.document.get("measurements")
    own = first[0].get("units") if isinstance(first, list) and isinstance(first[0], dict) else None
    return Units(**(own or job.document.get("units") or {}))


def _relative(file: Path, folder: Path) -> str:
    """A file's path as a job in this folder names it."""
    return str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)


def _job(path: Path, read: Callable[..., Measurements]) -> Job:
    folder = path.parent
    given = read_yaml(path)
    several = isinstance(given, dict) and isinstance(given.get("measurements"), list)
    file: _JobOfTables = validate(_JobOfTables if several else _Job, given, path.name)
    robot = robot_of(file.robot, f"{path.name}: robot", folder, file.units)
    _check_preferred(file, robot, path.name)
    _, estimate_noise = _noise(file.noise, file.units, robot, f"{path.name}: noise")
    tables = _tables(file, robot, path, read)
    plain = isinstance(file.measurements, str) and tables[0].is_plain
    alone = tables[0].measurements if plain else tuple(tables)
    truth = None if file.truth is None else _truth(folder / file.truth, robot)
    options = _options(file, estimate_noise, path.name, tables[0])
    return Job(path, robot, alone, options, truth, document=_document(given, folder))


_OF_THE_ROBOT = ("robot", "truth", "prior", "gauge", "prefer", "folds")
"""Keys of a job that say nothing of how a table is read."""


def _document(given: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A job's mapping, for reading tables like its own elsewhere: with its cameras in it, and without its robot."""

    def whole(entry: Mapping[str, Any]) -> dict[str, Any]:
        camera = entry.get("camera")
        file = camera.get("file") if isinstance(camera, dict) else camera if camera != "fixed" else None
        if not isinstance(file, str):
            return dict(entry)
        more = {"fixed": True} if isinstance(camera, dict) and camera.get("fixed") else {}
        return {**entry, "camera": {**read_yaml(folder / file), **more}}

    found = whole({key: value for key, value in given.items() if key not in _OF_THE_ROBOT})
    if isinstance(found["measurements"], list):
        found["measurements"] = [whole(entry) for entry in found["measurements"]]
    return found


def read_table_like(
    document: Mapping[str, Any], robot: Robot, path: Path, *, pairs: Path | None = None, like: str | None = None
) -> Table:
    """A table read as a job read one of its own: with its columns, units, noise, model and frame.

    Args:
        document: The job (see `Job.document`).
        robot: Its robot.
        path: The table.
        pairs: Table of pairs that were measured directly, if the job has one.
        like: Name of the job's table that it is like; of several the one of the same file name if None.

    Raises:
        InputError: A file is missing or cannot be used, or it is not clear which table it is like.
    """
    given = document.get("measurements")
    entries = given if isinstance(given, list) else [{"table": given, "pairs": document.get("pairs")}]
    if not all(isinstance(entry, dict) and isinstance(entry.get("table"), str) for entry in entries):
        raise InputError(
            "result.json: carried: job", f"measurements {shown(given)}", "those of the job, as it was saved"
        )
    entry = _entry_like(entries, path, like)
    if (pairs is None) != (entry.get("pairs") is None):
        found = "no table of pairs" if pairs is None else f"a table of pairs, {pairs.name}"
        expected = "pairs, as its job has them" if pairs is None else "none, as in its job"
        raise InputError(path.name, found, expected)
    alone = {**entry, "table": str(path.absolute()), "pairs": None if pairs is None else str(pairs.absolute())}
    job = {key: value for key, value in document.items() if key != "pairs"} | {"robot": ".", "measurements": [alone]}
    file: _JobOfTables = validate(_JobOfTables, job, path.name)
    (table,) = _tables(file, robot, path)
    return table


def _entry_like(entries: Sequence[Mapping[str, Any]], path: Path, like: str | None) -> Mapping[str, Any]:
    names = [Path(entry["table"]).name for entry in entries]
    if like is not None and like not in names:
        raise InputError("like", f"found {shown(like)}", f"one of {', '.join(names)}", did_you_mean(like, names))
    wanted = like or path.name
    if wanted in names:
        return entries[names.index(wanted)]
    if len(entries) > 1:
        raise InputError(path.name, "of none of the names that the job's tables have", ", ".join(names), "see --like")
    return entries[0]


def _tables(
    file: _JobOfTables, robot: Robot, path: Path, read_table: Callable[..., Measurements] = read_measurements
) -> list[Table]:
    """The tables of a job; what an entry leaves out is as the job says for all."""
    given, folder = file.measurements, path.parent
    if not given or not isinstance(given, str | list):
        raise InputError(f"{path.name}: measurements", f"found {shown(given)}", "a path, or a list of tables")
    whole = isinstance(given, str)
    if not whole and file.pairs is not None:
        raise InputError(f"{path.name}: pairs", "beside a list of tables", "the key in the table's own entry")
    entries = [{"table": given, "pairs": file.pairs}] if whole else given
    places = [path.name if whole else f"{path.name}: measurement {i}" for i in range(1, len(entries) + 1)]
    read = [validate(_Table, one, place) for one, place in zip(entries, places, strict=True)]
    between = len(read) > 1 and any(entry.pairs is not None for entry in read)
    columns = [
        _columns(file.columns, f"{path.name}: columns")
        if entry.columns is None
        else _columns(entry.columns, f"{place}: columns")
        for entry, place in zip(read, places, strict=True)
    ]
    touched = [read_points(folder / entry.table, c) for entry, c in zip(read, columns, strict=True)] if between else []
    points = [name for names in touched for name in names]
    tables = []
    for entry, place, called in zip(read, places, columns, strict=True):
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
        pairing = pairing_of(file.pairing if entry.pairing is None else entry.pairing, f"{place}: pairing")
        pairs = None if entry.pairs is None else folder / entry.pairs
        measurements = read_table(
            *(folder / entry.table, robot), pairs=pairs, units=units, noise=stated, points=points, model=model,
            columns=called,
        )  # fmt: skip
        camera, fixed_camera = _camera(file.camera, entry.camera, place, folder)
        table = Table(
            *(measurements, model, pairing, entry.frame or file.frame),
            known=_known_points(file, model, path.name),
            offset=model == "anchor" and (entry.offset or file.offset) == "estimate",
            camera=camera if model == "pixels" else None,
            fixed_camera=model == "pixels" and fixed_camera,
        )
        tables.append(table)
    _tell_of_idle_keys(file, tables, path.name)
    return tables


_USED_BY: dict[str, tuple[Model, ...]] = {
    "targets": tuple(POSE_MODELS),
    "anchors": ("anchor",),
    "offset": ("anchor",),
    "camera": ("pixels",),
}


def _tell_of_idle_keys(file: _JobOfTables, tables: Sequence[Table], place: str) -> None:
    """Warn of keys that say something of instruments that no table is of."""
    for key, models in _USED_BY.items():
        if getattr(file, key) and not any(table.model in models for table in tables):
            _log.warning("%s: %s is not used: no table is of model %s", place, key, " or ".join(models))


def _columns(given: Mapping[str, Any] | None, place: str) -> dict[str, Column]:
    """What a table calls its columns: by the name that is known here."""
    found = {}
    for name, one in (given or {}).items():
        file = validate(_Column, {"name": one} if isinstance(one, str) else one, f"{place}: {name}")
        try:
            found[name] = Column(file.name, file.scale, file.zero)
        except InputError as error:
            raise InputError(f"{place}: {name}", error.found, error.expected) from None
    return found


def _known_points(file: _JobOfTables, model: Model, place: str) -> dict[str, KnownPoint]:
    """Targets or anchors, whatever a model has, that the job says something of."""
    what = {"anchor": "anchors"} | dict.fromkeys(POSE_MODELS, "targets")
    if model not in what:
        return {}
    key = what[model]
    for_all = _tolerances(file.tolerance, place)
    factor, found = file.units.factor("m"), {}
    for name, one in getattr(file, key).items():
        point = validate(_Point, one, f"{place}: {key}: {name}")
        tolerance, said_by = point.tolerance, f"{place}: {key}: {name}: tolerance"
        if tolerance is None:
            tolerance, said_by = getattr(for_all, key), f"{place}: tolerance: {key}"
        xyz = np.array([point.x, point.y, point.z]) * factor
        found[name] = KnownPoint(xyz, None if tolerance is None else file.units.sigma(tolerance, "m", said_by))
    return found


def _camera(for_all: object, own: object, place: str, folder: Path) -> tuple[Camera | None, bool]:
    """The camera of a table, and whether it stands in the room; `fixed` in an entry is the job's camera, fixed."""
    given = for_all if own in (None, "fixed") else own
    camera, fixed = camera_in(given, f"{place}: camera", folder)
    return camera, fixed or "fixed" in (own, for_all)


def camera_in(given: object, place: str, folder: Path) -> tuple[Camera | None, bool]:
    """A camera, and whether it stands in the room.

    Args:
        given: A path, or the camera's mapping, or `file` with the path; a mapping may say `fixed`.
        place: File and key, for messages.
        folder: Where the path starts.

    Raises:
        InputError: It is no camera.
    """
    fixed = False
    if isinstance(given, dict) and "fixed" in given:
        fixed = validate(_CameraOfJob, {"fixed": given["fixed"]}, place).fixed
        given = {key: value for key, value in given.items() if key != "fixed"}
        given = given["file"] if set(given) == {"file"} else given
    if given in (None, "fixed"):
        return None, fixed
    return (read_camera(folder / given) if isinstance(given, str) else camera_of(given, place)), fixed


def _options(file: _JobOfTables, estimate_noise: bool, place: str, first: Table) -> Options:
    """The choices of a job; its old key `prior: false` is `gauge: none`."""
    choices = {key: getattr(file, key) for key in _CHOICES if key in file.model_fields_set} | {"model": first.model}
    pairing = pairing_of(file.pairing, f"{place}: pairing")
    accept = _limits(file.accept, file.units, f"{place}: accept")
    scale = _tolerances(file.tolerance, place).estimate
    estimated = {"estimate_noise": estimate_noise, "estimate_tolerance": scale}
    return Options.of(**choices, **estimated, pairing=pairing, accept=accept)


def _tolerances(given: object, place: str) -> _Tolerances:
    """Tolerances of targets and anchors, and what becomes of the robot's."""
    if given == "estimate":
        return _Tolerances(estimate="kind")
    if given is not None and not isinstance(given, dict):
        raise InputError(f"{place}: tolerance", f"found {shown(given)}", "a mapping of figures, or estimate")
    return validate(_Tolerances, given or {}, f"{place}: tolerance")


def _limits(given: object, units: Units, place: str) -> Limits:
    """What errors the user accepts, in [m] and [rad]."""
    file = validate(_Accept, {} if given is None else given, place)
    stated = {key: getattr(file, key) for key in file.model_fields_set}
    return Limits(**{key: quantity(one, LIMITED[key], units, f"{place}: {key}") for key, one in stated.items()})


def check_choices(choices: Mapping[str, Any], robot: Robot, place: str) -> None:
    """Check keys of a job for a robot before there is a job: model, pairing, gauge, ...

    Args:
        choices: The keys and their values, without `robot` and `measurements`.
        robot: The robot.
        place: File and key, for messages.

    Raises:
        InputError: A job with these keys could not be read.
    """
    file = validate(_Job, {"robot": ".", "measurements": ".", **choices}, place)
    pairing_of(file.pairing, f"{place}: pairing")
    _limits(file.accept, file.units, f"{place}: accept")
    _tolerances(file.tolerance, place)
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
    if not isinstance(given, str) or not given:
        raise InputError(place, f"found {shown(given)}", "a path, or the mapping of a robot file")
    return read_robot(folder / given)


def _truth(path: Path, robot: Robot) -> Robot:
    """The true robot: the nominal one with other values."""
    truth = read_robot(path)
    if names_of(truth.parameters) != names_of(robot.parameters) or truth.convention != robot.convention:
        raise InputError(path.name, "another robot", f"the parameters of {robot.name}, with their true values")
    return truth


def pairing_of(given: object, place: str) -> Pairing:
    """A pairing: a strategy, or how many random pairs.

    Raises:
        InputError: It is neither.
    """
    match given:
        case "star" | "chain" | "all":
            return Pairing(given)
        case dict():
            file = validate(_RandomPairing, given, place)
            return Pairing("random", file.random, file.seed)
    hint = did_you_mean(given, ("star", "chain", "all"))
    raise InputError(place, f"found {shown(given)}", "one of star, chain, all, {random: N, seed: S}", hint)


def _noise(given: object, units: Units, robot: Robot, place: str) -> tuple[Noise, bool]:
    """The noise in [m] and [rad], that of the readings joint by joint, and whether it is only where to start."""
    if given == "estimate":
        return replace(UNSTATED, joint=(0.0,) * robot.n_joints), True
    if given is not None and not isinstance(given, dict):
        raise InputError(place, f"found {shown(given)}", "a mapping of figures, or estimate")
    file = validate(_Noise, given or {}, place)

    def si(key: str, unit: str) -> float | None:
        figure = getattr(file, key)
        return None if figure is None else units.sigma(figure, unit, f"{place}: {key}")

    noise = Noise(
        position=si("position", "m"),
        orientation=si("orientation", "rad"),
        joint=joint_noise(file.joint, units, robot, place),
        distance=si("distance", "m"),
        angle=si("angle", "rad"),
        point=si("point", "m"),
        pixel=file.pixel,
    )
    if not file.estimate:
        return noise, False
    missing = {f.name: getattr(UNSTATED, f.name) for f in fields(Noise)[:-1] if getattr(noise, f.name) is None}
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
    return tuple(units.sigma(f, j.unit, f"{place}: joint") for f, j in zip(figures, robot.joints, strict=True))


def joint_noise_in(document: Mapping[str, Any], robot: Robot, place: str) -> tuple[float, ...]:
    """Sigma of each joint's readings, [rad] (prismatic: [m]), as a job states it: all its tables have the same.

    Args:
        document: The job (see `Job.document`).
        robot: Its robot.
        place: Where it stands, for messages.

    Raises:
        InputError: It cannot be used.
    """
    file: _JobOfTables = validate(_JobOfTables, {**document, "robot": "."}, place)
    stated, _ = _noise(file.noise, file.units, robot, f"{place}: noise")
    if isinstance(file.measurements, list) and file.measurements:
        entry: _Table = validate(_Table, file.measurements[0], place)
        if isinstance(entry.noise, dict) and "joint" in entry.noise:
            stated, _ = _noise(entry.noise, entry.units or file.units, robot, f"{place}: noise")
    assert isinstance(stated.joint, tuple)
    return stated.joint
