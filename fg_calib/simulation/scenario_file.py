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
    field_of_view: 20                 #     turned away, the centre within this of the axis; default 0: it is on it
    board_size: [0.4, 0.3]            #     and all four corners of the board; default: the centre alone
  tracker:                            #   a tracker sees a reflector on the tool: see `TargetViews`
    station: {x: 3, y: 0, z: 1.5}     #     where it is, in the base frame
    target: {x: 0, y: 0.05, z: 0.1}   #     the reflector in the tool frame
    axis: [0, 0, 1]                   #     where it looks, in the tool frame; default z
    acceptance: 30                    #     it returns light from within this angle of its axis; default 30 degrees
    distance: [1, 8]                  #     from the tracker; default: any
    region: {lower: [0, -1, 0], upper: [1, 1, 1]}   # where the reflector may be, in the base frame; default: anywhere
    count: 50
  random: {count: 500}                #   drawn within the joint limits, +-180 degrees or +-1 m where there are none
  table: configurations.csv           #   the joint readings of a table
  keep_out: [{lower: [-1, -1, -1], upper: [1, 1, 0]}]   # beside any of them: boxes in the base frame that nothing of
                                      #   the arm may be inside: its joints, the lines between them, the tool point
  apart: 5                            #   and by how much some joint must differ between two; default: nothing
noise: {position: 0.001, orientation: 0.01, joint: 0.005}   # 1 sigma; joint noise moves the arm, not the table
frame: unknown                        # world_T_base: base, unknown (default, drawn), or x y z roll pitch yaw
validation: {random: {count: 500}}    # the same choice as configurations, for test rows; default: none
job: {model: distance-rotation, pairing: star}   # keys of calibration.yaml; noise: {...} there states another noise
instruments: [{model: anchor, anchors: 3}]       # what measures, instead of poses: see `scenario_instruments`
```
Where `tracker`, `keep_out`, `apart` or `board_size` stand, configurations are drawn until all are found, and what is in
the way is said if they are not. In `apart` a joint that slides counts as its share of the arm's reach, in rad.
With `instruments` the figures of `noise` are those that they need, and `job` has no model or pairing of its own.
A design needs no `errors`, and of `noise` what its model measures; poses are simulated whole.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.io.atomic import exists, is_folder
from fg_calib.io.job import check_choices, joint_noise, robot_of
from fg_calib.io.robot_file import FrameValues, unit_of_key
from fg_calib.io.units import Units, UnitsOfFile
from fg_calib.io.yaml import NotNegative, Number, Positive, Schema, read_yaml, shown, validate
from fg_calib.measurements.dataset import Noise
from fg_calib.options import known_names
from fg_calib.simulation.board_file import placement
from fg_calib.simulation.configurations import Configurations, Placement
from fg_calib.simulation.configurations_file import ConfigurationsFile, only_one, read_configurations
from fg_calib.simulation.instruments import Instrument
from fg_calib.simulation.scenario import Errors, Scenario, figures_by_name
from fg_calib.simulation.scenario_instruments import InstrumentReader, noise_figures

SCENARIOS = Path(__file__).parents[1] / "scenarios"
"""The shipped scenarios, a folder each."""


class _Errors(Schema):
    uniform: dict[str, NotNegative] | None = None
    normal: Any = None  # `tolerance`, or `_Sigmas`
    values: dict[str, Number] | None = None


class _Sigmas(Schema):
    normal: dict[str, NotNegative]


class _Noise(Schema):
    position: NotNegative | None = None
    orientation: NotNegative | None = None
    joint: Any = 0.0  # one figure, or one a joint


class _JointNoise(Schema):
    joint: Any = 0.0


class _StatedNoise(Schema):
    position: Positive | None = None
    orientation: Positive | None = None
    joint: Any = None


class _Scenario(Schema):
    name: str | None = None
    robot: Any  # a path, or the mapping of a robot file
    units: UnitsOfFile = Units()
    errors: _Errors | None = None
    configurations: ConfigurationsFile
    noise: Any  # a `_Noise`; with instruments the figures that these need
    frame: Any = "unknown"  # `base`, or `FrameValues`
    validation: ConfigurationsFile | None = None
    job: dict[str, Any] | None = None
    instruments: Any = None  # see `scenario_instruments`


@checked
def read_scenario(path: Path | str, *, instruments: Path | str | None = None) -> Scenario:
    """The scenario in a YAML file, or a shipped one.

    Args:
        path: The file, or the name of a shipped scenario: `space-robot`.
        instruments: A file with some keys of a scenario (`INSTRUMENT_KEYS`) that stand in the place of its own: other
            instruments, in its units.

    Raises:
        InputError: There is neither, or it or a file that it names cannot be used.
    """
    path = Path(path)
    known = sorted(folder.name for folder in SCENARIOS.iterdir() if folder.is_dir())
    source = path.name
    if str(path) in known and (is_folder(path) or not exists(path)):
        path = SCENARIOS / path / "scenario.yaml"
    elif not exists(path) and path.suffix not in {".yaml", ".yml"}:
        raise InputError("scenario", f"found {str(path)!r}", f"a file, or one of {', '.join(known)}")
    if instruments is None:
        return _Reader(path, source, read_yaml(path)).read()
    return _Reader(path, Path(instruments).name, _with_instruments(read_yaml(path), Path(instruments))).read()


INSTRUMENT_KEYS = ("name", "instruments", "noise", "frame", "configurations", "job")
"""Keys of a scenario that say what measures, where, and how well."""


def _with_instruments(scenario: Any, path: Path) -> Any:
    """A scenario's mapping with the keys of a file of instruments in the place of its own.

    Raises:
        InputError: The file has other keys, or none.
    """
    given = read_yaml(path)
    if not isinstance(given, dict) or not isinstance(scenario, dict):
        raise InputError(path.name, f"found {shown(given)}", f"a mapping with some of {', '.join(INSTRUMENT_KEYS)}")
    for key in given:
        if key not in INSTRUMENT_KEYS:
            raise InputError(path.name, f"unknown key {key!r}", known_names(INSTRUMENT_KEYS))
    job = scenario.get("job")
    if given.get("instruments") and isinstance(job, dict):
        scenario = {**scenario, "job": {key: v for key, v in job.items() if key not in ("model", "pairing", "noise")}}
    return {**scenario, **given}


class _Reader:
    """Reads one scenario file."""

    def __init__(self, path: Path, source: str, given: Any) -> None:
        self._source = source
        self._folder = path.parent
        self._file = validate(_Scenario, given, source)
        self._units = self._file.units
        self._robot = robot_of(self._file.robot, f"{source}: robot", self._folder, self._units)
        self._default_name = Path(source).stem

    def read(self) -> Scenario:
        file, units, source = self._file, self._units, self._source
        place, instruments = f"{source}: noise", tuple[Instrument, ...]()
        if file.instruments is None:
            figures = validate(_Noise, file.noise, place)
            noise = Noise(joint=joint_noise(figures.joint, units, self._robot, place))
            if figures.position is not None:
                noise = replace(noise, position=units.sigma(figures.position, "m", f"{place}: position"))
            if figures.orientation is not None:
                orientation = units.sigma(figures.orientation, "rad", f"{place}: orientation")
                noise = replace(noise, orientation=orientation)
            stated, job = self._job(noise)
        else:
            noise, stated, job, instruments = self._instruments()
        validation = file.validation
        return Scenario(
            robot=self._robot,
            errors=None if file.errors is None else self._errors(file.errors),
            configurations=self._configurations(file.configurations, f"{source}: configurations"),
            noise=noise,
            frame=self._frame(file.frame, f"{source}: frame"),
            validation=None if validation is None else self._configurations(validation, f"{source}: validation"),
            stated_noise=stated,
            job=job,
            length_unit=units.length,
            angle_unit=units.angle,
            name=file.name or self._default_name,
            source=source,
            instruments=instruments,
        )

    def _instruments(self) -> tuple[Noise, Noise | None, dict[str, Any], tuple[Instrument, ...]]:
        """The noise and what is stated of it, the job's other keys, and the instruments."""
        file, units, place = self._file, self._units, f"{self._source}: noise"
        noise = self._noise(file.noise, place)
        job = self._job_keys()
        for key in ("model", "pairing", "targets", "anchors", "tolerance", "offset", "camera"):
            if key in job:
                raise InputError(f"{self._source}: job", f"found key {key!r}", "none", "each instrument has its own")
        stated = job.pop("noise", None)
        given = self._noise(stated, f"{self._source}: job: noise", stated=True)
        reader = InstrumentReader(
            self._source,
            self._folder,
            units,
            replace(given, joint=0.0),
            lambda one, at: self._configurations(validate(ConfigurationsFile, one, at), at),
            self._frame,
        )
        found = reader.read(file.instruments)
        check_choices({**job, "model": found[0].model}, self._robot, f"{self._source}: job")
        joint = given.joint if isinstance(stated, dict) and "joint" in stated else noise.joint
        return noise, replace(noise, joint=joint), job, found

    def _noise(self, given: object, place: str, *, stated: bool = False) -> Noise:
        """Figures of noise, those of the joints too."""
        own = {key: value for key, value in given.items() if key == "joint"} if isinstance(given, dict) else {}
        others = {key: v for key, v in given.items() if key != "joint"} if isinstance(given, dict) else given
        joint = joint_noise(validate(_JointNoise, own, place).joint, self._units, self._robot, place)
        return replace(noise_figures(others, self._units, place, stated=stated), joint=joint)

    def _errors(self, file: _Errors) -> Errors:
        place, robot = f"{self._source}: errors", self._robot
        law = only_one(file, list(_Errors.model_fields), place)
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

    def _configurations(self, file: ConfigurationsFile, place: str) -> Configurations:
        return read_configurations(file, self._robot, self._units, self._folder, place)

    def _frame(self, given: object, place: str) -> Literal["base", "unknown"] | Placement:
        match given:
            case "base" | "unknown":
                return "base" if given == "base" else "unknown"
            case dict():
                return placement(validate(FrameValues, given, place), self._units, place)
        raise InputError(place, f"found {shown(given)}", "base, unknown, or a mapping of x, y, z, roll, pitch, yaw")

    def _job(self, noise: Noise) -> tuple[Noise | None, dict[str, Any]]:
        """The noise that the job states, None where it is the true one, and the job's other keys."""
        place, units = f"{self._source}: job", self._units
        given = self._job_keys()
        file = given.pop("noise", None)
        check_choices(given, self._robot, place)
        if file is None:
            return None, given
        stated = validate(_StatedNoise, file, f"{place}: noise")
        if stated.position is not None:
            noise = replace(noise, position=units.sigma(stated.position, "m", f"{place}: noise: position"))
        if stated.orientation is not None:
            noise = replace(noise, orientation=units.sigma(stated.orientation, "rad", f"{place}: noise: orientation"))
        if stated.joint is not None:
            noise = replace(noise, joint=joint_noise(stated.joint, units, self._robot, f"{place}: noise"))
        return noise, given

    def _job_keys(self) -> dict[str, Any]:
        """The job's keys, none that the simulation writes."""
        place, by_default = f"{self._source}: job", {"model": "distance-rotation"}
        if self._file.job is not None:
            given = dict(self._file.job)
        else:
            given = by_default if self._file.instruments is None else {}
        for key in ("robot", "measurements", "pairs", "frame", "units", "truth"):
            if key in given:
                hint = "it follows from the scenario" if key in {"frame", "units"} else "the simulation writes it"
                raise InputError(place, f"found key {key!r}", "none", hint)
        return given
