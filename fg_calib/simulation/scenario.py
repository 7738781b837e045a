"""Scenario to simulate: the robot's true errors, configurations, noise, instruments. A YAML file has the same fields.

```yaml
name: space-robot                     # default: the file's name
robot: robot.yaml                     # the nominal robot: a path relative to this file, or the mapping of a robot file
units: {length: m, angle: deg}        # of this file and of the job that is written; default m and rad
errors:                               # true minus nominal; one of
  uniform: {a: 0.01, alpha: 0.05}     #   within plus and minus these, by kind or by parameter name
  normal: tolerance                   #   1 sigma: the robot's tolerances, or values by kind or by parameter name
  values: {a2: 0.003, tool.x: 0.001}  #   these; only so does a fixed parameter get an error
configurations:                       # where the calibration measures; one of
  board:                              #   a camera (tool z) looks at a board's centre: see `BoardViews`
    pose: {x: 0, y: 6.5, z: 2.55}     #     base_T_board: x y z roll pitch yaw; the camera is on the side of its z
    height: 0.5                       #     of the first configuration, A, above the centre; default 0.5 m
    count: 51                         #     number of others
    radius: 0.5                       #     they are spread evenly over a half sphere about A; default 0.5 m
    distance: [0.3, 2.0]              #     or, instead of radius, drawn at such distances from the centre
    cone: 60                          #     and within this angle of the normal; default 60 degrees
    roll: random                      #     about the optical axis: random (default) or an angle
    self_motion: random               #     random (default), or held: all continue from A's configuration
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
  keep_out: [{lower: [-1, -1, -1], upper: [1, 1, 0]}]   # with any of them: boxes in the base frame that nothing of
                                      #   the arm may be inside: its joints, the lines between them, the tool point
noise: {position: 0.001, orientation: 0.01, joint: 0.005}   # 1 sigma; joint noise moves the arm, not the table
temperature: [15, 30]                 # drawn evenly for each configuration where an effect of the robot has a column
                                      #   of temperatures; so are sides of approach, -1 or 1, where it has such columns
frame: unknown                        # world_T_base: base, unknown (default, drawn), or x y z roll pitch yaw
validation: {random: {count: 500}}    # the same choice as configurations, for test rows; default: none
job: {model: distance-rotation, pairing: star}   # keys of calibration.yaml; noise: {...} specifies another noise there
instruments:                          # what measures, a table each; default: poses of the tool
  - {model: position, stations: 2, targets: {smr1: {x: 50, y: 0, z: 100}, smr2: {x: 0, y: 60, z: 90}}}
  - {model: anchor, name: wire, anchors: 3, offset: 120, noise: {distance: 0.02}}
  - {model: anchor, name: bar, anchors: {bolt: {x: 800, y: 0, z: 0, tolerance: 2}}, contact: true}
  - {model: plane, planes: {table: {normal: [0, 0, 1], distance: 300}}}
  - {model: board, configurations: {board: {pose: {x: 900}, count: 20}}}
  - {model: pixels, camera: camera.yaml, corners: {columns: 8, rows: 6, square: 30}, boards: {wall: {x: 900, z: 400}}}
  - {model: distance, name: sockets, sockets: 4}
  - {model: distance, name: caliper, pairs: {random: 30}}
```
Where `tracker`, `keep_out` or `board_size` stand, configurations are drawn until all are found; else the reasons are
reported. With `instruments` the `job` has no model or pairing of its own. A design needs no `errors`.

| key of an instrument | for | meaning |
|---|---|---|
| `model` | all | that of the table |
| `name` | all | of its file, without the ending; default: the model (`position`, then `position_2`) |
| `noise` | all | its own values, 1 sigma; others and `joint` are the scenario's |
| `configurations` | all | its own; else the scenario's. Test rows are those of the scenario's `validation` |
| `targets` | `pose position` | points of the tool by name, or how many are drawn; none: the tool point |
| `stations` | `pose position orientation` | how many measure in turn, each with a frame of its own |
| `frame` | the same; fixed cameras | world_T_base as of the scenario, whose is the default; camera_T_base |
| `pairing` | models of pairs | how pairs are formed from measured poses |
| `pairs` | the same | pairs that are measured directly: star, chain, all or {random: N, seed: S} |
| `sockets` | `distance` | contact points by name, or how many; one is touched from each configuration, in turn |
| `anchors`, `offset` | `anchor` | anchors by name, or how many; what the instrument adds, which is then estimated |
| `planes` | `plane` | planes by name, `{normal: [x, y, z], distance: d}`, or how many |
| `contact` | `anchor plane` | true: the tool point is brought there from each configuration, where it reaches |
| `boards` | `board pixels` | base_T_board by name; else the board that the configurations look at |
| `camera` | `pixels` | a path or a mapping; with `fixed: true` it stands in the room and the board is on the tool |
| `corners` | `pixels` | of the boards: `{columns: 8, rows: 6, square: 30}` |

With a number instead of names, landmarks are drawn: targets a tenth of the workspace's radius from the tool point;
anchors half to one and a half of it from the workspace's middle; planes through the workspace, the first three
orthogonal; sockets, and anchors in contact, where the nominal arm has its tool point. The workspace is that of the
nominal arm's tool point: mean, and root mean square distance from it.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar, cast, dataclass_transform

import numpy as np
import pydantic
from pydantic import AfterValidator, BeforeValidator, Field, InstanceOf, TypeAdapter, ValidationError, ValidationInfo
from scipy.spatial.transform import Rotation

from fg_calib import initialization, inputs, io
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, AngleUnit, Floats, InputError, Pairing, Record
from fg_calib.measurements import Noise
from fg_calib.robot import Robot, tolerance_kind, unit_of

MOST_DRAWN = 1_000_000
"""The largest number of configurations that are drawn."""

SCENARIOS = Path(__file__).parents[1] / "scenarios"
"""The shipped scenarios, a folder each."""

Class = TypeVar("Class")


# --- one type for Python and for the file -----------------------------------------------------------------------------


class FileContext(Record):
    """Context in which a file is read.

    Attributes:
        units: Of the file.
        folder: Where paths in it start.
        robot: The nominal robot.
    """

    units: io.Units
    folder: Path
    robot: Robot


def _convert(function: Callable[[Any, FileContext | None], Any]) -> BeforeValidator:
    """Annotation of a field that a function makes of what is given: by a file in its context, by Python without."""

    def read(given: Any, info: ValidationInfo) -> Any:
        try:
            return function(given, info.context)
        except InputError as error:
            raise ValueError(error) from None  # so that pydantic adds the place

    return BeforeValidator(read)


def _in_file(function: Callable[[Any, FileContext], Any]) -> BeforeValidator:
    """Annotation of a field that a file states in another form; Python gives its own type."""
    return _convert(lambda given, context: given if context is None else function(given, context))


def _scale(unit: str) -> AfterValidator:
    """Annotation of a field in [m] or [rad], in a file in the units of that."""
    return AfterValidator(lambda value, info: value if (at := info.context) is None else value * at.units.factor(unit))


def _fit(read: Callable[[], Any], place: str) -> Any:
    """Validate something by pydantic.

    Raises:
        InputError: The first misfit.
    """
    try:
        return read()
    except ValidationError as error:
        misfit, context = io.first_misfit(error, place), error.errors(include_url=False)[0].get("ctx", {})
        if "error" not in context:
            raise misfit from None
        of: InputError = context["error"].args[0]
        within = ": ".join(part for part in (misfit.place, of.place.removeprefix(": ")) if part)
        raise InputError(within, of.found, of.expected, of.hint) from None


def _read(kind: Any, given: object, place: str, context: FileContext | None) -> Any:
    """Read a value as a type.

    Raises:
        InputError: The value does not fit.
    """
    return _fit(lambda: TypeAdapter(kind).validate_python(given, context=context), place)


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def schema(cls: type[Class]) -> type[Class]:
    """Make a frozen dataclass whose fields are validated: from Python in SI, from a file in the file's units."""
    keys = dict.fromkeys(key for c in reversed(cls.__mro__) for key in vars(c).get("__annotations__", {}))
    in_file = ("pose" if cls.__name__ == "BoardViews" and k == "board" else k for k in keys)
    refuse: Any = io.refuse_unknown_keys(*in_file)
    unknown: Any = classmethod(lambda _, value: refuse(value))
    cls.refuse_unknown = pydantic.model_validator(mode="before")(unknown)  # type: ignore[attr-defined]
    config = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False, populate_by_name=True)
    made: Any = pydantic.dataclasses.dataclass(frozen=True, config=config)(cls)
    plain = made.__init__
    names = [f.name for f in fields(made) if not f.kw_only]

    def validate_fields(self: Any, *args: Any, **kwargs: Any) -> None:
        by_name = dict(zip(names, args, strict=False)) | kwargs
        _fit(lambda: plain(self, *args[len(names) :], **by_name), cls.__name__)

    made.__init__ = validate_fields
    return cast("type[Class]", made)


def _array(given: Any, context: FileContext | None) -> Floats:
    """Three numbers; in a file those of x, y and z, or a list."""
    if context is not None and isinstance(given, Mapping):
        io.refuse_unknown_keys(*"xyz")(given)
        given = [given.get(axis, 0.0) for axis in "xyz"]
    return inputs.as_floats("", given, "(3,)")


Length = Annotated[io.Number, _scale("m")]
PositiveLength = Annotated[io.Positive, _scale("m")]
LengthFromZero = Annotated[io.NotNegative, _scale("m")]
Angle = Annotated[io.Number, _scale("rad")]
PositiveAngle = Annotated[io.Positive, _scale("rad")]
AngleFromZero = Annotated[io.NotNegative, _scale("rad")]
Count = Annotated[int, Field(ge=0, le=MOST_DRAWN, strict=True)]
CountFromOne = Annotated[int, Field(gt=0, le=MOST_DRAWN, strict=True)]
Direction = Annotated[Floats, _convert(_array)]
Point = Annotated[Direction, _scale("m")]


def _require(fits: bool, place: str, found: str, expected: str) -> None:
    """Check the fields of a type of a scenario.

    Raises:
        ValueError: The fields do not fit, for `_fit`.
    """
    if not fits:
        raise ValueError(InputError(place, found, expected))


def _require_order(distance: tuple[float, float]) -> None:
    _require(distance[0] <= distance[1], "distance", f"found {io.shown(list(distance))}", "the smaller one first")


# --- frames and where the arm goes ------------------------------------------------------------------------------------


class Placement(Record):
    """A frame in another one, such as world_T_base or base_T_board.

    Attributes:
        rotation: Shape (3, 3).
        position: Shape (3,), [m].
    """

    rotation: Floats
    position: Floats


def _placement(given: Any, context: FileContext) -> Placement:
    si = io.validate(io.FrameValues, given, "").si(context.units, "")
    rotation = Rotation.from_euler("xyz", [si["roll"], si["pitch"], si["yaw"]])  # about fixed axes: Rz(yaw) Ry Rx
    return Placement(rotation.as_matrix(), np.array([si["x"], si["y"], si["z"]]))


def _frame(given: Any, context: FileContext | None) -> str | Placement | None:
    if isinstance(given, dict) and context is not None:
        return _placement(given, context)
    if given is None or isinstance(given, Placement):
        return given
    return str(inputs.check("", given, ("base", "unknown")))


Board = Annotated[Placement, _in_file(_placement)]
Frame = Annotated[Placement | str, _convert(_frame)]


@schema
class Box:
    """A box along the axes of the robot's base frame.

    Attributes:
        lower: Its least x, y and z, shape (3,), [m].
        upper: Its largest, shape (3,), [m].
    """

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        found = f"found {self.upper.tolist()} above a lower of {self.lower.tolist()}"
        _require(bool((self.lower < self.upper).all()), "upper", found, "more than lower in x, y and z")


InBox = Annotated[Box, _in_file(lambda given, _: io.corners_of(given))]


@schema
class Conditions:
    """Conditions on configurations of any kind.

    Attributes:
        keep_out: Boxes that nothing of the arm may be inside, see `obstacles.enters`.
    """

    keep_out: tuple[InBox, ...] = Field(default=(), kw_only=True)


@schema
class BoardViews(Conditions):
    """Configurations in which the tool's z axis, a camera's optical axis, meets the centre of a board.

    The first is A, `height` above the centre. The others are spread evenly over the half sphere of `radius` about A
    on the side away from the board (Jia et al. 2019, section 5.1), or, with `distance`, drawn at such distances from
    the centre, evenly in distance and in direction within `cone` of the normal.

    Attributes:
        board: base_T_board; z is the normal on the camera's side.
        count: Number of configurations after A.
        height: Distance of A from the centre, [m].
        radius: Of the half sphere about A, [m].
        distance: Smallest and largest distance from the centre, [m]; None for the half sphere.
        cone: Largest angle between the normal and the direction from the centre to the camera, [rad].
        roll: Of the camera about its optical axis, [rad]; at 0 its x axis at A is the board's, and at other views the
            smallest rotation of the optical axis applied to that. None draws it.
        self_motion: `random`: every configuration has its own, from a random start of the inverse kinematics;
            `held`: all continue from that of A by steps of minimum norm.
        field_of_view: Half angle of the cone about the optical axis in which the camera sees, [rad]. The camera, placed
            and rolled as above, is rotated so that the board's centre is anywhere in that cone, evenly in solid angle;
            at 0 the optical axis meets the centre.
        board_size: Width along the board's x and height along its y, [m]: only views with its four corners in the
            field of view are taken. None: the centre alone is seen.
    """

    board: Annotated[Board, Field(validation_alias="pose")]
    count: Count = 51
    height: PositiveLength = 0.5
    radius: PositiveLength = 0.5
    distance: tuple[PositiveLength, PositiveLength] | None = None
    cone: PositiveAngle = np.pi / 3.0
    roll: Annotated[Angle | None, BeforeValidator(lambda given: None if given == "random" else given)] = None
    self_motion: Literal["random", "held"] = "random"
    field_of_view: AngleFromZero = 0.0
    board_size: tuple[PositiveLength, PositiveLength] | None = None

    def __post_init__(self) -> None:
        _require_order(self.distance or (0.0, 0.0))
        for key in ("cone", "field_of_view"):
            angle = getattr(self, key)
            _require(angle <= 0.5 * np.pi + 1e-9, key, f"found {angle:g} rad", "at most a quarter turn")


@schema
class TargetViews(Conditions):
    """Configurations in which a tracker sees a reflector on the tool.

    Attributes:
        station: The tracker in the base frame, shape (3,), [m].
        target: The reflector in the tool frame, shape (3,), [m].
        count: Number of configurations.
        axis: Where the reflector looks, in the tool frame, shape (3,).
        acceptance: The reflector returns light from within this angle of its axis, [rad].
        distance: Smallest and largest distance from the tracker, [m].
        region: Where the reflector may be, in the base frame; None: anywhere.
    """

    station: Point
    target: Point = Field(default_factory=lambda: np.zeros(3))
    count: CountFromOne = 50
    axis: Direction = Field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    acceptance: PositiveAngle = np.pi / 6.0
    distance: tuple[LengthFromZero, Annotated[io.Bound, _scale("m")]] = (0.0, np.inf)
    region: Box | None = None

    def __post_init__(self) -> None:
        _require(bool(self.axis.any()), "axis", "found 0, 0, 0", "a direction")
        _require(self.acceptance <= np.pi, "acceptance", f"found {self.acceptance:g} rad", "at most half a turn")
        _require_order(self.distance)


@schema
class RandomReadings(Conditions):
    """Configurations drawn evenly within the joint limits, +-180 degrees or +-1 m where there are none."""

    count: CountFromOne


@schema
class GivenReadings(Conditions):
    """Configurations of a table.

    Attributes:
        readings: Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """

    readings: Annotated[Floats, _convert(lambda given, _: inputs.as_floats("", given, "(n, m)"))]


Configurations = BoardViews | TargetViews | RandomReadings | GivenReadings


@schema
class _ConfigurationsInFile(Conditions):
    board: BoardViews | None = None
    tracker: TargetViews | None = None
    random: RandomReadings | None = None
    table: io.FilePath | None = None


def _configurations(given: Any, context: FileContext) -> Configurations:
    file = _read(_ConfigurationsInFile, given, "", context)
    key, found = _the_one_of({key: getattr(file, key) for key in ("board", "tracker", "random", "table")})
    if key == "table":
        found = GivenReadings(io.read_measurements(context.folder / found, context.robot, units=context.units).readings)
    return cast("Configurations", replace(found, keep_out=file.keep_out))


def _the_one_of(given: Mapping[str, Any]) -> tuple[str, Any]:
    """The only entry that is not None.

    Raises:
        InputError: None or several are.
    """
    found = {key: value for key, value in given.items() if value is not None}
    inputs.expect(len(found) == 1, "", f"found {' and '.join(found) or 'none'}", f"one of {', '.join(given)}")
    return next(iter(found.items()))


InPairing = Annotated[Pairing, _in_file(lambda given, _: io.pairing_of(given, ""))]
InConfigurations = Annotated[Configurations, _in_file(_configurations)]


# --- noise and landmarks ----------------------------------------------------------------------------------------------

_SIGMAS: dict[str, Any] = dict.fromkeys(io.NOISE_UNITS, (io.NotNegative | None, None))
_NoiseInFile: Any = pydantic.create_model("_NoiseInFile", __base__=io.Schema, joint=(Any, 0.0), **_SIGMAS)


def _noise(given: Any, context: FileContext) -> Noise:
    file = io.validate(_NoiseInFile, given, "")
    specified = {kind: (getattr(file, kind), context.units.factor(unit)) for kind, unit in io.NOISE_UNITS.items()}
    values = {kind: sigma * factor for kind, (sigma, factor) in specified.items() if sigma is not None}
    return Noise(joint=io.joint_noise(file.joint, context.units, context.robot, "")).updated(**values)


InNoise = Annotated[Noise, _in_file(_noise)]


@schema
class Spot:
    """The true place of a point: of a target in the tool frame, of an anchor or a contact point in the base frame.

    Attributes:
        xyz: Shape (3,), [m].
        tolerance: 1 sigma on each axis of what the calibration knows of it, [m]: 0: exactly; None: nothing.
    """

    xyz: Point
    tolerance: LengthFromZero | None = None


def _spot(given: Any, _: FileContext) -> dict[str, Any]:
    """A point as its coordinates, those missing 0, with what is known of it."""
    xyz = given if not isinstance(given, Mapping) else {key: v for key, v in given.items() if key != "tolerance"}
    return {"xyz": xyz} | ({"tolerance": given["tolerance"]} if xyz is not given and "tolerance" in given else {})


@schema
class Plane:
    """The true place of a plane: points x with `normal . x = distance`, distances from it positive along its normal.

    Attributes:
        normal: In the base frame, shape (3,); of any length above 0.
        distance: Of the plane from the base, along the normal, [m].
    """

    normal: Direction
    distance: Length

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.normal))
        _require(length > 0.0, "normal", "found 0, 0, 0", "a direction")
        object.__setattr__(self, "normal", self.normal / length)


Name = Annotated[str, Field(pattern=r"^\S(.*\S)?$")]


def _by_name(kind: Any, number: bool = True) -> BeforeValidator:
    """Annotation of landmarks by name; or of how many are drawn."""

    def read(given: Any, context: FileContext | None) -> Any:
        counted = number and not isinstance(given, Mapping)
        every = Annotated[dict[Name, kind], Field(min_length=1)]
        return _read(CountFromOne if counted else every, given, "", context)

    return _convert(read)


Spots = Annotated[Mapping[str, Spot] | int, _by_name(Annotated[Spot, _in_file(_spot)])]
Planes = Annotated[Mapping[str, Plane] | int, _by_name(Plane)]
Boards = Annotated[Mapping[str, Placement], _by_name(Board, number=False)]


class _CornersInFile(io.Schema):
    columns: CountFromOne
    rows: CountFromOne
    square: io.Positive


def board_corners(columns: int, rows: int, square: float) -> Floats:
    """Corners of a chequered board about its centre, row by row, x and y in its plane, shape (rows * columns, 2), [m].

    Args:
        columns: Along its x axis.
        rows: Along its y axis.
        square: From one to the next, [m].
    """
    x, y = (square * (np.arange(n) - 0.5 * (n - 1)) for n in (columns, rows))
    return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)


def _corners(given: Any, context: FileContext) -> Floats:
    file = io.validate(_CornersInFile, given, "")
    return board_corners(file.columns, file.rows, file.square * context.units.factor("m"))


# --- instruments ------------------------------------------------------------------------------------------------------

_MODELS_WITH: Mapping[str, tuple[str, ...]] = {
    "targets": ("pose", "position"),
    "stations": tuple(POSE_MODELS),
    "frame": (*POSE_MODELS, "pixels"),
    **dict.fromkeys(("pairing", "pairs"), tuple(PAIR_MODELS)),
    "sockets": ("distance",),
    **dict.fromkeys(("anchors", "offset"), ("anchor",)),
    "planes": ("plane",),
    "contact": ("anchor", "plane"),
    **dict.fromkeys(("boards", "from_behind"), ("board", "pixels")),
    **dict.fromkeys(("camera", "fixed", "corners"), ("pixels",)),
}
"""Models that take each field of an instrument which not all take."""


@schema
class Instrument:
    """Instrument of a scenario's table; a table at the top of the module says which models take which fields.

    Every target is seen at every configuration; anchors, planes and contact points are measured in turn. A board is
    seen where its centre (pixels: the corner) is in front of the camera (pixels: and in the image, which is twice as
    wide as cx and twice as high as cy), and the camera is on the side of the board's z axis.

    Attributes:
        model: The model of its table.
        name: The name of its table, without the ending.
        noise: Its own values, 1 sigma; the scenario's where there are none, and those of the joints always.
        configurations: Where it measures; where the scenario's instruments do if None. Test rows are those of the
            scenario's validation.
        targets: Points of the tool by name, or how many; the tool point itself if None.
        tool_too: Whether the tool point is measured as well as targets.
        stations: How many measure in turn; each has a frame of its own.
        frame: world_T_base: the base itself, unknown (drawn), or given; the scenario's if None. Of several stations
            the first has it, the others' are drawn. camera_T_base of a fixed camera; if None it looks at the
            workspace's middle from two and a half times its radius.
        pairing: How pairs are formed from measured poses; a star if None.
        pairs: Pairs of configurations that are measured directly.
        sockets: Contact points by name, or how many: the tool point touches one from each configuration.
        anchors: By name, or how many; three if None.
        offset: Offset of every length, [m], which the calibration then estimates; nothing if None.
        planes: By name, or how many; three if None.
        contact: Whether the tool point is brought to the anchor, or along the normal to the plane, from each
            configuration. What is out of reach is left out.
        boards: base_T_board by name; that which the configurations look at if None.
        camera: The camera.
        fixed: Whether the camera stands in the room, and the board is the tool.
        corners: Points of the boards, x and y in their planes, shape (n, 2), [m].
        from_behind: Names of boards whose z axis points away from the camera.
    """

    model: inputs.Model
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
    noise: InNoise = Noise()
    configurations: InConfigurations | None = None
    targets: Spots | None = None
    tool_too: bool = False
    stations: CountFromOne = 1
    frame: Frame | None = None
    pairing: InPairing | None = None
    pairs: InPairing | None = None
    sockets: Spots | None = None
    anchors: Spots | None = None
    offset: Length | None = None
    planes: Planes | None = None
    contact: pydantic.StrictBool = False
    boards: Boards | None = None
    camera: initialization.Camera | None = None
    fixed: pydantic.StrictBool = False
    corners: Annotated[Floats | None, _in_file(_corners)] = None
    from_behind: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        defaults = {f.name: f.default for f in fields(cast("Any", self))}
        for key, models in _MODELS_WITH.items():
            given = getattr(self, key) is not defaults[key]
            _require(not given or self.model in models, key, f"with model {self.model}", f"model {' or '.join(models)}")
        _require(not self.contact or self.offset is None, "offset", "with contact", "none: there is no length")
        for key in ("camera", "corners"):
            given = getattr(self, key) is not None
            _require(given or self.model != "pixels", key, "found none with model pixels", "it with model pixels")
        _require(not self.fixed or not self.boards, "camera", "fixed, with boards", "the board on the tool")


# --- the scenario -----------------------------------------------------------------------------------------------------


@schema
class Errors:
    """True minus nominal values of parameters.

    Attributes:
        law: `uniform` within plus and minus the values, `normal` with the values as 1 sigma, or the values
            themselves (`values`).
        values: By parameter name or by kind (`a`, `alpha`, `tool`, ...; a name goes before its kind), [m] or [rad].
            Errors that are drawn are those of estimated parameters only; what has no value has no error.
    """

    law: Literal["uniform", "normal", "values"]
    values: Mapping[str, io.Number]

    def by_name(self, robot: Robot, place: str) -> dict[str, float]:
        """The values by parameter name, [m] and [rad].

        Args:
            robot: The robot.
            place: File and key, for messages.

        Raises:
            InputError: A key that is neither a parameter nor a kind of the robot.
        """
        kind_of = {p.name: tolerance_kind(p) or "" for p in robot.parameters}
        inputs.check_names(place, self.values, [*sorted({*kind_of.values()} - {""}), *kind_of], "parameter or kind")
        found = {name: self.values.get(name, self.values.get(kind)) for name, kind in kind_of.items()}
        return {name: value for name, value in found.items() if value is not None}


def _errors(given: Any, context: FileContext) -> Errors:
    if given == {"normal": "tolerance"}:
        for p in context.robot.parameters:
            if p.estimated and p.tolerance is None:
                raise InputError("normal", f"{p.name} of the robot has no tolerance", "one for all that is estimated")
        return Errors("normal", {p.name: p.tolerance for p in context.robot.parameters if p.tolerance is not None})
    laws = ("uniform", "normal", "values")
    given = io.refuse_unknown_keys(*laws)(_read(dict[str, Any], given, "", context))
    law, values = _the_one_of({key: given.get(key) for key in laws})
    values = _read(dict[str, io.Number], values, law, context)
    values = {key: value * context.units.factor(unit_of(key)) for key, value in values.items()}
    return Errors(cast("Any", law), Errors(cast("Any", law), values).by_name(context.robot, law))


@schema
class Scenario:
    """A simulation to run, in SI.

    Attributes:
        robot: The nominal robot.
        errors: True minus nominal parameters; None where nothing is to be simulated, as for a design.
        configurations: Where the robot is measured to be calibrated, as the nominal robot would get there.
        noise: True noise, 1 sigma.
        frame: world_T_base, in whose world the poses are measured: `base` is the base itself, `unknown` an arbitrary
            one, drawn.
        validation: Where it is measured to test the calibration; None without test rows.
        specified_noise: Values that the calibration is given instead of the true ones; None where these are given.
        job: Other keys of the calibration job, such as model and pairing.
        length_unit: Unit of length of the job's files.
        angle_unit: Unit of angles of the job's files.
        name: Its name.
        source: The file's name, or that of a shipped scenario; for messages.
        instruments: Instruments, each with a table of its own; poses of the tool are measured if empty.
        temperature: Lowest and highest, in the unit of an effect's column of temperatures.
    """

    robot: InstanceOf[Robot]
    errors: Annotated[Errors, _in_file(_errors)] | None
    configurations: InConfigurations
    noise: InNoise
    frame: Frame = "unknown"
    validation: InConfigurations | None = None
    specified_noise: Noise | None = None
    job: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({"model": "distance-rotation"}))
    length_unit: inputs.LengthUnit = "m"
    angle_unit: AngleUnit = "rad"
    name: str = "scenario"
    source: str = "scenario"
    instruments: tuple[Instrument, ...] = ()
    temperature: tuple[io.Number, io.Number] = (15.0, 30.0)

    def __repr__(self) -> str:
        return inputs.brief(self, (f.name for f in fields(cast("Any", self))))

    def __post_init__(self) -> None:
        files: set[str] = set()
        cold, warm = self.temperature
        _require(cold <= warm, "temperature", f"found {io.shown([cold, warm])}", "the lower one first")
        for number, i in enumerate(self.instruments, start=1):
            place, own = f"instrument {number}", {i.name.lower(), f"{i.name}_pairs".lower()}
            _require(not own & files, f"{place}: name", f"{i.name} is there already", "another one")
            known = (self.frame if i.frame is None else i.frame) == "base"
            _require(not known or i.stations == 1, f"{place}: stations", f"{i.stations} with frame base", "1")
            files |= own

    @property
    def pairing(self) -> Pairing:
        """How pairs of the default instrument's poses are formed."""
        return io.pairing_of(self.job.get("pairing", "star"), f"{self.source}: job: pairing")


class _ScenarioInFile(io.Schema):
    name: str | None = None
    robot: Any  # a path, or the mapping of a robot file
    units: io.UnitsOfFile = io.Units()
    errors: Any = None
    configurations: Any
    noise: Any
    frame: Any = "unknown"
    validation: Any = None
    job: dict[str, Any] | None = None
    instruments: list[dict[str, Any]] | None = Field(None, min_length=1)
    temperature: Any = (15.0, 30.0)


@inputs.checked
def read_scenario(path: Path | str) -> Scenario:
    """Read the scenario in a YAML file, or a shipped one.

    Args:
        path: The file, or the name of a shipped scenario: `space-robot`.

    Raises:
        InputError: There is neither, or it or a file that it names cannot be used.
    """
    path = Path(path)
    known = sorted(folder.name for folder in SCENARIOS.iterdir() if folder.is_dir())
    source = path.name
    if str(path) in known and (io.is_folder(path) or not io.exists(path)):
        path = SCENARIOS / path / "scenario.yaml"
    elif not io.exists(path) and path.suffix not in {".yaml", ".yml"}:
        raise InputError("scenario", f"found {str(path)!r}", f"a file, or one of {', '.join(known)}")
    file = io.validate(_ScenarioInFile, io.read_yaml(path), source)
    robot = io.robot_of(file.robot, f"{source}: robot", path.parent, file.units)
    context = FileContext(file.units, path.parent, robot)
    job, specified = _read_job(file, source, context)
    given = {
        **{key: getattr(file, key) for key in ("errors", "configurations", "noise", "frame", "validation")},
        **{"robot": robot, "job": job, "specified_noise": specified, "source": source, "temperature": file.temperature},
        **{"length_unit": file.units.length, "angle_unit": file.units.angle, "name": file.name or Path(source).stem},
        "instruments": _complete(file.instruments or (), source, path.parent),
    }
    scenario: Scenario = _read(Scenario, given, source, context)
    model = {"model": scenario.instruments[0].model} if scenario.instruments else {}
    io.check_choices({**job, **model}, robot, f"{source}: job")
    return scenario


def _read_job(file: _ScenarioInFile, source: str, context: FileContext) -> tuple[dict[str, Any], Noise | None]:
    """Keys of the job that the simulation does not write, and the noise that it specifies instead of the true one."""
    alone = file.instruments is None
    given = dict(file.job) if file.job is not None else {"model": "distance-rotation"} if alone else {}
    written = {"robot", "measurements", "pairs", "frame", "units", "truth"}
    written |= set() if alone else {"model", "pairing", "targets", "anchors", "tolerance", "offset", "camera"}
    hint = "it follows from the scenario or its instruments"
    for key in given:
        inputs.expect(key not in written, f"{source}: job", f"found key {key!r}", "none", hint)
    noise = given.pop("noise", None)
    if isinstance(noise, dict) and isinstance(file.noise, dict) and "joint" in file.noise:
        noise = {"joint": file.noise["joint"]} | noise
    return given, None if noise is None else _read(InNoise, noise, f"{source}: job: noise", context)


def _complete(entries: Sequence[dict[str, Any]], source: str, folder: Path) -> list[dict[str, Any]]:
    """The entries of instruments with names, and with cameras as they are read."""
    found, unnamed = [], Counter[str]()
    for number, entry in enumerate(entries, start=1):
        model = str(entry.get("model"))
        unnamed[model] += "name" not in entry
        name = model if unnamed[model] == 1 else f"{model}_{unnamed[model]}"
        found.append({"name": name} | entry)
        if "camera" in entry:
            place = f"{source}: instrument {number}: camera"
            found[-1]["camera"], found[-1]["fixed"] = io.camera_in(entry["camera"], place, folder)
    return found
