"""Scenarios in YAML: what to simulate. `simulation` writes what comes of them.

```yaml
name: space-robot                     # default: the file's name
robot: robot.yaml                     # the nominal robot: a path relative to this file, or the mapping of a robot file
units: {length: m, angle: deg}        # of this file and of the job that is written; default m and rad
errors:                               # true minus nominal; one of
  uniform: {a: 0.01, alpha: 0.05}     #   within plus and minus these, by kind or by parameter name
  normal: tolerance                   #   1 sigma: the robot's tolerances, or figures by kind or by parameter name
  values: {a2: 0.003, tool.x: 0.001}  #   these; only so does a fixed parameter get an error
configurations:                       # where the calibration measures; one of
  board:                              #   a camera (tool z) looks at a board's centre: see `BoardViews`
    pose: {x: 0, y: 6.5, z: 2.55}     #     base_T_board: x y z roll pitch yaw; the camera is on the side of its z
    height: 0.5                       #     of the first configuration, A, above the centre; default 0.5 m
    count: 51                         #     others, beside A
    radius: 0.5                       #     they are spread evenly over a half sphere about A; default 0.5 m
    distance: [0.3, 2.0]              #     or, instead of radius, drawn at such distances from the centre
    cone: 60                          #     and within this angle of the normal; default 60 degrees
    roll: random                      #     about the optical axis: random (default) or an angle
    self_motion: random               #     random (default), or held: all continue from A's configuration
    posture: [0, 30, 0, 90, 0, 60, 0] #     where A's is sought if held; default: drawn
  random: {count: 500}                #   drawn within the joint limits, +-180 degrees or +-1 m where there are none
  table: configurations.csv           #   the joint readings of a table
noise: {position: 0.001, orientation: 0.01, joint: 0.005}   # 1 sigma; joint noise moves the arm, not the table
frame: unknown                        # world_T_base: base, unknown (default, drawn), or x y z roll pitch yaw
validation: {random: {count: 500}}    # the same choice as configurations, for test rows; default: none
job: {model: distance-rotation, pairing: star}   # keys of calibration.yaml; noise: {...} there states another noise
```
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from fg_calib.errors import InputError
from fg_calib.files.board import Board, placement, read_board
from fg_calib.files.job import check_choices, joint_noise, robot_of
from fg_calib.files.robot_yaml import FrameValues, unit_of_key
from fg_calib.files.schema import Count, NotNegative, Number, Positive, Schema, read_yaml, shown, validate
from fg_calib.files.tables import read_measurements
from fg_calib.files.units import Units, UnitsOfFile
from fg_calib.measurements.dataset import Noise
from fg_calib.options import known_names
from fg_calib.simulation.scenario import (
    Configurations,
    Errors,
    GivenReadings,
    Placement,
    RandomReadings,
    Scenario,
    figures_by_name,
)

SCENARIOS = Path(__file__).parents[1] / "scenarios"
"""The shipped scenarios, a folder each."""


class _Errors(Schema):
    uniform: dict[str, NotNegative] | None = None
    normal: Any = None  # `tolerance`, or `_Sigmas`
    values: dict[str, Number] | None = None


class _Sigmas(Schema):
    normal: dict[str, NotNegative]


class _Random(Schema):
    count: Annotated[Count, Field(gt=0)]


class _Configurations(Schema):
    board: Board | None = None
    random: _Random | None = None
    table: str | None = None


class _Noise(Schema):
    position: NotNegative
    orientation: NotNegative
    joint: Any = 0.0  # one figure, or one a joint


class _StatedNoise(Schema):
    position: Positive | None = None
    orientation: Positive | None = None
    joint: Any = None


class _Scenario(Schema):
    name: str | None = None
    robot: Any  # a path, or the mapping of a robot file
    units: UnitsOfFile = Units()
    errors: _Errors
    configurations: _Configurations
    noise: _Noise
    frame: Any = "unknown"  # `base`, or `FrameValues`
    validation: _Configurations | None = None
    job: dict[str, Any] = Field(default_factory=lambda: {"model": "distance-rotation"})


def read_scenario(path: Path | str) -> Scenario:
    """The scenario in a YAML file, or a shipped one.

    Args:
        path: The file, or the name of a shipped scenario: `space-robot`.

    Raises:
        InputError: There is neither, or it or a file that it names cannot be used.
    """
    path = Path(path)
    known = sorted(folder.name for folder in SCENARIOS.iterdir() if folder.is_dir())
    source = path.name
    if str(path) in known and not path.is_file():
        path = SCENARIOS / path / "scenario.yaml"
    elif not path.exists() and path.suffix not in {".yaml", ".yml"}:
        raise InputError("scenario", f"found {str(path)!r}", f"a file, or one of {', '.join(known)}")
    return _Reader(path, source).read()


class _Reader:
    """Reads one scenario file."""

    def __init__(self, path: Path, source: str) -> None:
        self._source = source
        self._folder = path.parent
        self._file = validate(_Scenario, read_yaml(path), source)
        self._units = self._file.units
        self._robot = robot_of(self._file.robot, f"{source}: robot", self._folder, self._units)
        self._default_name = Path(source).stem

    def read(self) -> Scenario:
        file, units, source = self._file, self._units, self._source
        noise = Noise(
            position=file.noise.position * units.factor("m"),
            orientation=file.noise.orientation * units.factor("rad"),
            joint=joint_noise(file.noise.joint, units, self._robot, f"{source}: noise"),
        )
        stated, job = self._job(noise)
        validation = file.validation
        return Scenario(
            robot=self._robot,
            errors=self._errors(),
            configurations=self._configurations(file.configurations, "configurations"),
            noise=noise,
            frame=self._frame(),
            validation=None if validation is None else self._configurations(validation, "validation"),
            stated_noise=stated,
            job=job,
            length_unit=units.length,
            angle_unit=units.angle,
            name=file.name or self._default_name,
            source=source,
        )

    def _errors(self) -> Errors:
        place, file, robot = f"{self._source}: errors", self._file.errors, self._robot
        law = _only_one(file, place)
        if law == "normal" and file.normal == "tolerance":
            for p in robot.parameters:
                if p.estimated and p.tolerance is None:
                    raise InputError(
                        f"{place}: normal", f"{p.name} of the robot has no tolerance", "one for all that is estimated"
                    )
            return Errors("normal", {p.name: p.tolerance for p in robot.parameters if p.tolerance is not None})
        if law == "normal":
            if not isinstance(file.normal, dict):
                expected = "tolerance, or figures by kind or by parameter name"
                raise InputError(f"{place}: normal", f"found {shown(file.normal)}", expected)
            given = validate(_Sigmas, {"normal": file.normal}, place).normal
        else:
            given = (file.uniform if law == "uniform" else file.values) or {}
        figures = {key: figure * self._units.factor(unit_of_key(key)) for key, figure in given.items()}
        by_name = figures_by_name(robot, figures, f"{place}: {law}")
        match law:
            case "uniform":
                return Errors("uniform", by_name)
            case "normal":
                return Errors("normal", by_name)
        return Errors("values", by_name)

    def _configurations(self, file: _Configurations, key: str) -> Configurations:
        place = f"{self._source}: {key}"
        _only_one(file, place)
        if file.board is not None:
            return read_board(file.board, self._robot, self._units, f"{place}: board")
        drawn = file.random
        if drawn is not None:
            return RandomReadings(drawn.count)
        table = read_measurements(self._folder / str(file.table), self._robot, units=self._units)
        return GivenReadings(table.readings)

    def _frame(self) -> Literal["base", "unknown"] | Placement:
        given, place = self._file.frame, f"{self._source}: frame"
        match given:
            case "base" | "unknown":
                return "base" if given == "base" else "unknown"
            case dict():
                return placement(validate(FrameValues, given, place), self._units)
        raise InputError(place, f"found {shown(given)}", "base, unknown, or a mapping of x, y, z, roll, pitch, yaw")

    def _job(self, noise: Noise) -> tuple[Noise | None, dict[str, Any]]:
        """The noise that the job states, None where it is the true one, and the job's other keys."""
        place, units = f"{self._source}: job", self._units
        given = dict(self._file.job)
        for key in ("robot", "measurements", "pairs", "frame", "units", "truth"):
            if key in given:
                hint = "it follows from the scenario" if key in {"frame", "units"} else "the simulation writes it"
                raise InputError(place, f"found key {key!r}", "none", hint)
        file = given.pop("noise", None)
        check_choices(given, self._robot, place)
        if file is None:
            return None, given
        stated = validate(_StatedNoise, file, f"{place}: noise")
        if stated.position is not None:
            noise = replace(noise, position=stated.position * units.factor("m"))
        if stated.orientation is not None:
            noise = replace(noise, orientation=stated.orientation * units.factor("rad"))
        if stated.joint is not None:
            noise = replace(noise, joint=joint_noise(stated.joint, units, self._robot, f"{place}: noise"))
        return noise, given


def _only_one(file: Schema, place: str) -> str:
    """The only key that is given.

    Raises:
        InputError: None or several are.
    """
    keys = list(type(file).model_fields)
    given = [key for key in keys if getattr(file, key) is not None]
    if len(given) != 1:
        raise InputError(place, f"found {' and '.join(given) or 'none'}", known_names(keys))
    return given[0]
