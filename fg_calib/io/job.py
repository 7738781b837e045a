"""Calibration jobs: which robot, which measurements, which model."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, StrictBool, create_model

from fg_calib import inputs
from fg_calib.initialization import Camera
from fg_calib.inputs import LIMITED, Floats, FrameKnowledge, InputError, Limits, Model, Options, Pairing, checked
from fg_calib.io import yaml
from fg_calib.io.atomic import exists, is_folder, noting_reads
from fg_calib.io.robot_file import Names, read_robot, robot_from_mapping
from fg_calib.io.tables import Column, read_measurements
from fg_calib.io.yaml import Count, FilePath, NotNegative, Number, Positive, Schema, Units, UnitsOfFile
from fg_calib.job import Job
from fg_calib.measurements import GENERIC_COLUMNS, INSTRUMENTS, KnownPoint, Noise, Table
from fg_calib.robot import Robot, names_of

UNSPECIFIED = Noise(position=1e-3, orientation=1e-3, distance=1e-3, angle=1e-3, point=1e-3, pixel=1.0)
"""Start of the noise if it is to be estimated and nothing was specified."""

NOISE_UNITS = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad", "point": "m", "pixel": "px"}
NOISE_UNITS |= {name: column.si for name, column in GENERIC_COLUMNS.items()}
"""Units of the kinds of noise; that of joints is in the joint's unit."""


_SIGMAS: dict[str, Any] = dict.fromkeys(NOISE_UNITS, (Positive | None, None))
_Noise = create_model("_Noise", __base__=Schema, joint=(Any, 0.0), estimate=(StrictBool, False), **_SIGMAS)


class _JointNoises(Schema):
    joint: tuple[NotNegative, ...]


_Columns = dict[str, Annotated[Column, BeforeValidator(lambda one: {"name": one} if isinstance(one, str) else one)]]
"""A table's own names of columns, by the name that is known here."""


class _Point(Schema):
    x: Number
    y: Number
    z: Number
    tolerance: Positive | None = None


FAR_AWAY = 1e9
"""Where nothing is, in any unit of length."""


def corners_of(given: Any) -> Any:
    """A box as `{lower: [x, y, z], upper: [x, y, z]}`, where it is `{box: [lower, upper]}` or `{below: z}`."""
    match given:
        case {"below": z, **others} if not others:
            return {"lower": [-FAR_AWAY] * 3, "upper": [FAR_AWAY, FAR_AWAY, z]}
        case {"box": [lower, upper], **others} if not others:
            return {"lower": lower, "upper": upper}
    return given


class _KeepOut(Schema):
    lower: tuple[Number, Number, Number]
    upper: tuple[Number, Number, Number]


class _Tolerances(Schema):
    targets: Positive | None = None
    anchors: Positive | None = None


_FreeText = Annotated[str | None, BeforeValidator(lambda text: str(text) if type(text) is int else text)]


_ABOUT: dict[str, Any] = dict.fromkeys(
    ("customer", "robot_serial", "instrument", "operator", "note"), (_FreeText, None)
)
_About = create_model("_About", __base__=Schema, **_ABOUT)


class _TableKeys(Schema):
    """Keys of a table; at the top of a job they are the defaults of all its tables."""

    pairs: FilePath | None = None
    model: Model | None = None
    pairing: Any = "star"
    frame: FrameKnowledge = "known"
    units: UnitsOfFile = Units()
    noise: Any = None
    offset: Literal["estimate"] | None = None
    camera: Any = None
    columns: _Columns | None = None
    skip_lines: Annotated[int, Field(ge=0, strict=True)] = 0


class _Entry(_TableKeys):
    table: FilePath
    model: Model


_CHOICES = ("prior", "gauge", "prefer", "pair_errors", "encoder", "loss", "max_iterations", "folds")
"""Keys of a job that `Options` checks as they stand."""

_OF_THE_ROBOT = ("robot", "estimate", "truth", "prior", "gauge", "prefer", "folds")
"""Keys of a job that say nothing of how a table is read."""


class _JobKeys(_TableKeys):
    robot: Any
    measurements: Any
    estimate: Names = ()
    accept: Any = None
    truth: FilePath | None = None
    targets: Mapping[str, _Point] = Field(default_factory=dict)
    anchors: Mapping[str, _Point] = Field(default_factory=dict)
    keep_out: tuple[Annotated[_KeepOut, BeforeValidator(corners_of)], ...] = ()
    tolerance: _Tolerances = _Tolerances()

    def options(self, robot: Robot, model: Model, *, estimate_noise: bool = False) -> Options:
        """The options of a calibration of a robot.

        Raises:
            InputError: One is not possible.
        """
        choices = {key: getattr(self, key) for key in (*_CHOICES, "frame") if key in self.model_fields_set}
        inputs.check_names("prefer", choices.get("prefer", ()), names_of(robot.parameters))
        choices |= {"pairing": pairing_of(self.pairing), "accept": _limits(self.accept, self.units), "model": model}
        return Options.of(**choices, estimate_noise=estimate_noise)


_CHECKED_LATER: dict[str, Any] = dict.fromkeys(_CHOICES, (Any, None))
_Job = create_model("_Job", __base__=_JobKeys, about=(_About, _About()), **_CHECKED_LATER)


@checked
def read_job(path: Path | str) -> Job:
    """The calibration job in a YAML file, with its robot and its measurements.

    Args:
        path: The job; the paths in it are relative to its folder.

    Raises:
        InputError: The file, or one that it names, is missing or cannot be used.
    """
    path = Path(path)
    with noting_reads() as files:
        job = _read_job(path)
    folder = path.parent
    read = {str(f.relative_to(folder) if f.is_relative_to(folder) else f): digest for f, digest in files.items()}
    return replace(job, inputs=read)


def _read_job(path: Path) -> Job:
    folder, given = path.parent, yaml.read_yaml(path)
    file = yaml.validate(_Job, given, path.name)
    robot = robot_of(file.robot, f"{path.name}: robot", folder, file.units, file.estimate)
    document = _with_cameras({key: value for key, value in given.items() if key not in _OF_THE_ROBOT}, folder)
    entries = _entries(document, file, path.name)
    listed = given["measurements"] if isinstance(given["measurements"], list) else []
    models = tuple(dict.fromkeys(entry.model for _, entry in entries))
    of_tables = [(place, keys, (one.model,)) for (place, one), keys in zip(entries, listed, strict=False)]
    for place, keys, users in ((path.name, given, models), *of_tables):
        used = {name for model in users for name in (*INSTRUMENTS[model].options, INSTRUMENTS[model].key)}
        for key in ("offset", "camera", "targets", "anchors"):
            if key in keys and key not in used:
                raise InputError(f"{place}: {key}", f"of no use to model {' and '.join(users)}", "no such key")
    for key in ("targets", "anchors"):
        if getattr(file.tolerance, key) is not None and key not in given:
            raise InputError(f"{path.name}: tolerance: {key}", f"of no use without the key {key}", "no such key")
    tables = [_table(entry, place, file, robot, folder) for place, entry in entries]
    _, estimate_noise = _noise(file.noise, file.units, robot, f"{path.name}: noise")
    with inputs.within(path.name):
        options = file.options(robot, tables[0].model or "", estimate_noise=estimate_noise)
    truth = None if file.truth is None else _truth(folder / file.truth, robot)
    boxes = tuple(_box(one, file.units, f"{path.name}: keep_out") for one in file.keep_out)
    return Job(path, robot, tuple(tables), options, truth, document=document, keep_out=boxes)


def _box(given: _KeepOut, units: Units, place: str) -> Floats:
    """Lower and upper corner of a box, shape (2, 3), [m]."""
    corners = np.array([given.lower, given.upper])
    expected = "{below: z}, or {box: [lower, upper]} of x, y and z each"
    inputs.expect(np.all(corners[0] < corners[1]), place, f"found {yaml.shown(given.model_dump())}", expected)
    return corners * units.factor("m")


def is_job(path: Path | str) -> bool:
    """Whether a file is a job, by a key that only jobs have: what was measured.

    Args:
        path: The file; one that does not exist is none.
    """
    path = Path(path)
    return exists(path) and not is_folder(path) and "measurements" in yaml.read_yaml(path)


def units_of(job: Job) -> Units:
    """The units of a job's tables: of the first, if they have their own."""
    first = job.document.get("measurements")
    own = first[0].get("units") if isinstance(first, list) and isinstance(first[0], dict) else None
    return Units(**(own or job.document.get("units") or {}))


def _with_cameras(given: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A job's mapping with the keys of cameras' files in place of their paths."""

    def whole(entry: Any) -> Any:
        has_camera = isinstance(entry, dict) and "camera" in entry
        return {**entry, "camera": whole_camera(entry["camera"], folder)} if has_camera else entry

    tables = given["measurements"]
    return {**whole(given), "measurements": [whole(one) for one in tables] if isinstance(tables, list) else tables}


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
    place = "result.json: carried: job"
    file = yaml.validate(_Job, {"robot": ".", "measurements": None, **document}, place)
    entries = _entries(document, file, place)
    names = [Path(entry.table).name for _, entry in entries]
    wanted = like or path.name
    if wanted not in names and (like is not None or len(entries) > 1):
        hint = "see --like" if like is None else inputs.did_you_mean(like, names)
        found, known = f"found {yaml.shown(wanted)}", f"one of {', '.join(names)}"
        raise InputError("like" if like else path.name, found, known, hint)
    where, entry = entries[names.index(wanted) if wanted in names else 0]
    if (pairs is None) != (entry.pairs is None):
        found = "no table of pairs" if pairs is None else f"a table of pairs, {pairs.name}"
        raise InputError(path.name, found, "pairs, as its job has them" if pairs is None else "none, as in its job")
    files = {"table": str(path.absolute()), "pairs": None if pairs is None else str(pairs.absolute())}
    return _table(entry.model_copy(update=files), where, file, robot, Path())


def _entries(given: Mapping[str, Any], file: _JobKeys, place: str) -> list[tuple[str, _Entry]]:
    """The tables of a job, each with its place: its keys, or what the job says for all; its noise is its own alone.

    Args:
        given: The job's mapping.
        file: The same, checked.
        place: The job's file.

    Raises:
        InputError: There are none, or one cannot be used.
    """
    listed, entries = given.get("measurements"), list[tuple[str, _Entry]]()
    if not listed or not isinstance(listed, str | list):
        raise InputError(f"{place}: measurements", f"found {yaml.shown(listed)}", "a path, or a list of tables")
    if isinstance(listed, list) and file.pairs is not None:
        raise InputError(f"{place}: pairs", "next to a list of tables", "the key in the table's own entry")
    defaults = {key: given[key] for key in _TableKeys.model_fields if key in given and key != "noise"}
    for number, one in enumerate([{"table": listed}] if isinstance(listed, str) else listed, start=1):
        where = place if isinstance(listed, str) else f"{place}: measurement {number}"
        entries.append((where, yaml.validate(_Entry, defaults | one if isinstance(one, dict) else one, where)))
    return entries


def _table(entry: _Entry, place: str, file: _JobKeys, robot: Robot, folder: Path) -> Table:
    """The table of an entry.

    Args:
        entry: Its keys.
        place: File and entry, for messages.
        file: The job.
        robot: Its robot.
        folder: Where paths start.
    """
    model, of_job = entry.model, place.partition(": measurement")[0]
    noise, _ = _noise(file.noise, file.units, robot, f"{of_job}: noise")
    own, estimated = _noise(entry.noise, entry.units, robot, f"{place}: noise")
    inputs.expect(not estimated, f"{place}: noise", "estimate in the entry of a table", "the key noise of the job")
    pairs = None if entry.pairs is None else folder / entry.pairs
    noise = noise.updated(**{key: own.get(key) for key in entry.noise or ()})
    how: dict[str, Any] = {"units": entry.units, "columns": entry.columns, "skip_lines": entry.skip_lines}
    measurements = read_measurements(folder / entry.table, robot, pairs=pairs, noise=noise, model=model, **how)
    camera, fixed = camera_in(file.camera if entry.camera == "fixed" else entry.camera, f"{place}: camera", folder)
    options = INSTRUMENTS[model].options
    known, offset = _known_points(file, model, of_job), "offset" in options and entry.offset == "estimate"
    fixed = "camera" in options and (fixed or "fixed" in (entry.camera, file.camera))
    pairing, camera = pairing_of(entry.pairing, f"{place}: pairing"), camera if "camera" in options else None
    return Table(measurements, model, pairing, entry.frame, (), known, offset, camera, fixed)


def _known_points(file: Any, model: Model, place: str) -> dict[str, KnownPoint]:
    """Targets or anchors, whatever a model has, that the job says something of."""
    if not (key := INSTRUMENTS[model].key):
        return {}
    found, shared = {}, getattr(file.tolerance, key)
    for name, point in getattr(file, key).items():
        sigma = shared if point.tolerance is None else point.tolerance
        if sigma is not None:
            sigma = file.units.sigma(sigma, "m", f"{place}: {key}: {name}: tolerance")
        found[name] = KnownPoint(np.array([point.x, point.y, point.z]) * file.units.factor("m"), sigma)
    return found


def whole_camera(given: Any, folder: Path) -> Any:
    """A camera's mapping with the keys of its file in place of the file's path; anything else as it is.

    Args:
        given: A path, or the camera's mapping, or `file` with the path.
        folder: Where the path starts.

    Raises:
        InputError: The file is missing, or is of no camera.
    """
    given = {"file": given} if isinstance(given, str) and given not in ("", "fixed") else given
    if not isinstance(given, dict) or not isinstance(given.get("file"), str):
        return given
    path = folder / given["file"]
    read_camera(path)
    return {**yaml.read_yaml(path), **{key: value for key, value in given.items() if key != "file"}}


def camera_in(given: Any, place: str, folder: Path) -> tuple[Camera | None, bool]:
    """A camera, and whether it stands in the room.

    Args:
        given: Argument of `whole_camera`; a mapping may say `fixed: true`. Or `fixed` alone, or None.
        place: File and key, for messages.
        folder: Where a path starts.

    Raises:
        InputError: The entry is no camera.
    """
    given = whole_camera(given, folder)
    if given in (None, "fixed"):
        return None, given == "fixed"
    return _camera(given, place), bool(given.get("fixed"))


def _limits(given: Any, units: Units) -> Limits:
    """The errors that the user accepts, in [m] and [rad]."""
    given = {} if given is None else given
    inputs.expect(isinstance(given, dict), "accept", f"found {yaml.shown(given)}", "limits by name")
    inputs.check_names("accept", given, list(LIMITED), "limit")
    return Limits(**{key: yaml.quantity(one, LIMITED[key], units, f"accept: {key}") for key, one in given.items()})


def check_choices(choices: Mapping[str, Any], robot: Robot, place: str) -> None:
    """Check keys of a job for a robot before there is a job: model, pairing, gauge, ...

    Args:
        choices: The keys and their values, without `robot` and `measurements`.
        robot: The robot.
        place: File and key, for messages.

    Raises:
        InputError: A job with these keys could not be read.
    """
    file = yaml.validate(_Job, {"robot": ".", "measurements": ".", **choices}, place)
    if file.model is None:
        raise InputError(place, "missing key 'model'")
    with inputs.within(place):
        file.options(robot, file.model)


def robot_of(given: object, place: str, folder: Path, units: Units, estimate: Sequence[str] = ()) -> Robot:
    """The robot under a key `robot`.

    Args:
        given: A path relative to `folder`, or the mapping of a robot file.
        place: File and key, for messages.
        folder: The folder of the file that names it.
        units: Of that file; a URDF's `tolerance`, `base` and `tool` that stand in it are in these unless they state
            their own. A mapping of DH rows is a robot file of its own: m and rad unless it states others.
        estimate: What is estimated besides what the robot's own key says.

    Raises:
        InputError: The entry is no path or mapping, or does not describe a robot.
    """
    if isinstance(given, dict):
        return robot_from_mapping({"units": units} | given if "urdf" in given else given, place, folder, estimate)
    if not isinstance(given, str) or not given:
        raise InputError(place, f"found {yaml.shown(given)}", "a path, or the mapping of a robot file")
    return read_robot(folder / given, estimate=estimate)


def _truth(path: Path, robot: Robot) -> Robot:
    """The true robot: the nominal one with other values."""
    truth = read_robot(path)
    if names_of(truth.parameters) != names_of(robot.parameters) or truth.convention != robot.convention:
        raise InputError(path.name, "another robot", f"the parameters of {robot.name}, with their true values")
    return truth


def pairing_of(given: Any, place: str = "pairing") -> Pairing:
    """A pairing: a strategy, or how many random pairs.

    Raises:
        InputError: The entry is no pairing.
    """
    try:
        if isinstance(given, dict) and given.keys() <= {"random", "seed"}:
            return Pairing("random", given.get("random", 0), given.get("seed", 0))
        return Pairing(given)
    except InputError as error:
        expected = error.expected.replace("all, random", "all, {random: N, seed: S}")
        raise InputError(error.place.replace("pairing", place, 1), error.found, expected, error.hint) from None


def _noise(given: Any, units: Units, robot: Robot, place: str) -> tuple[Noise, bool]:
    """The noise in [m] and [rad], that of the readings joint by joint, and whether it is only where to start."""
    given = {"estimate": True} if given == "estimate" else {} if given is None else given
    file: Any = yaml.validate(_Noise, given, place)
    specified = {key: sigma for key in NOISE_UNITS if (sigma := getattr(file, key)) is not None}
    sigmas = {key: units.sigma(one, NOISE_UNITS[key], f"{place}: {key}") for key, one in specified.items()}
    start = {f.name: getattr(UNSPECIFIED, f.name) for f in fields(Noise)[:-1]} if file.estimate else {}
    return Noise(**start).updated(**sigmas, joint=joint_noise(file.joint, units, robot, place)), file.estimate


def joint_noise(given: Any, units: Units, robot: Robot, place: str) -> tuple[float, ...]:
    """Sigma of each joint's readings, [rad] (prismatic: [m]), from one number for all or one a joint.

    Raises:
        InputError: The entry is neither one number nor one a joint.
    """
    listed, n = isinstance(given, list), robot.n_joints
    sigmas = yaml.validate(_JointNoises, {"joint": given if listed else [given]}, place).joint * (1 if listed else n)
    inputs.expect(len(sigmas) == n, f"{place}: joint", f"{len(sigmas)} values", f"one for all or {n}, one a joint")
    return tuple(units.sigma(s, j.unit, f"{place}: joint") for s, j in zip(sigmas, robot.joints, strict=True))


_INTRINSICS: dict[str, Any] = {f.name: (Number, ... if f.default is MISSING else f.default) for f in fields(Camera)}
_SIZE: dict[str, Any] = dict.fromkeys(("width", "height"), (Count | None, None))
_KNOWN: dict[str, Any] = {"sigma": (dict[str, NotNegative] | None, None), "fixed": (StrictBool, False)}
_Camera = create_model("_Camera", __base__=Schema, **_INTRINSICS, **_SIZE, **_KNOWN)
"""A camera's file: its intrinsics, the size of its images, and how well it is known."""


def read_camera(path: Path, size: tuple[int, int] | None = None) -> Camera:
    """A camera's intrinsics: fx, fy, cx, cy in pixels, and the distortion k1 k2 p1 p2 k3 of OpenCV.

    Args:
        path: The file.
        size: Width and height of the images that it is for, [px].

    Raises:
        InputError: The file is missing or cannot be used, or says that it is of images of another size.
    """
    given = yaml.read_yaml(path)
    for key, found in zip(("width", "height"), size or (), strict=False):
        if given.get(key) not in (None, found):
            hint = "the intrinsics of other images would have to be scaled"
            raise InputError(f"{path.name}: {key}", f"found {given[key]}", f"{found} px as the images have", hint)
    return _camera(given, path.name)


def _camera(given: Any, place: str) -> Camera:
    file = yaml.validate(_Camera, given, place)
    try:
        return Camera(**{key: getattr(file, key) for key in _INTRINSICS})
    except InputError as error:
        raise InputError(error.place.replace("camera", place, 1), error.found, error.expected) from None
