"""What to simulate: the robot's true errors, configurations, noise, instruments. A YAML file has the same fields.

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
  keep_out: [{lower: [-1, -1, -1], upper: [1, 1, 0]}]   # with any of them: boxes in the base frame that nothing of
                                      #   the arm may be inside: its joints, the lines between them, the tool point
  apart: 5                            #   and by how much some joint must differ between two; default: nothing
noise: {position: 0.001, orientation: 0.01, joint: 0.005}   # 1 sigma; joint noise moves the arm, not the table
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
Where `tracker`, `keep_out`, `apart` or `board_size` stand, configurations are drawn until all are found; else the
reasons are reported. In `apart` a prismatic joint counts as its share of the arm's reach, in rad. With `instruments`
the `job` has no model or pairing of its own. A design needs no `errors`.

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
| `contact` | `anchor plane` | true: the tool point is brought there, from each configuration |
| `boards` | `board pixels` | base_T_board by name; else the board that the configurations look at |
| `camera` | `pixels` | a path or a mapping; with `fixed: true` it stands in the room and the board is on the tool |
| `corners` | `pixels` | of the boards: `{columns: 8, rows: 6, square: 30}` |

With a number instead of names, landmarks are drawn: targets a tenth of the workspace's radius from the tool point;
anchors half to one and a half of it from the workspace's middle; planes through the workspace, the first three
orthogonal; sockets, and anchors in contact, where the nominal arm has its tool point. The workspace is that of the
nominal arm's tool point: mean, and root mean square distance from it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar, cast, dataclass_transform

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, ValidationError, ValidationInfo, create_model
from pydantic_core import core_schema

from fg_calib.inputs import NEAR, Brief, Floats, InputError, as_floats, check, checked, did_you_mean, known_names
from fg_calib.io import (
    Bound,
    FilePath,
    FrameValues,
    NotNegative,
    Number,
    Positive,
    Schema,
    Units,
    UnitsOfFile,
    camera_in,
    check_choices,
    exists,
    first_misfit,
    is_folder,
    joint_noise,
    pairing_of,
    read_measurements,
    read_yaml,
    refuse_unknown_keys,
    robot_of,
    shown,
    unit_of_key,
    validate,
)
from fg_calib.measurements import GENERIC_COLUMNS, LIMIT_SLACK, Noise
from fg_calib.measurements.kinds import Camera
from fg_calib.options import PAIR_MODELS, POSE_MODELS, AngleUnit, FrameKnowledge, LengthUnit, Model, Pairing
from fg_calib.robot import Robot, names_of, tolerance_kind

MOST_DRAWN = 1_000_000
"""The largest number of configurations that are drawn."""

Class = TypeVar("Class")

SCENARIOS = Path(__file__).parents[1] / "scenarios"
"""The shipped scenarios, a folder each."""


# --- one type for Python and for the file -----------------------------------------------------------------------------


@dataclass(frozen=True)
class FileContext:
    """Context in which a file is read.

    Attributes:
        units: Of the file.
        folder: Where paths in it start.
        robot: The nominal robot.
    """

    units: Units
    folder: Path
    robot: Robot


@dataclass(frozen=True)
class InFile:
    """Annotation of a field that a file states in another form. A value from Python is the field's own type, in SI.

    Attributes:
        form: The form in the file.
        convert: From the form, and the context of the file, to the field's value.
        from_python: Checks a value from Python; if None it must be of the field's type.
    """

    form: Any
    convert: Callable[[Any, FileContext], Any]
    from_python: Callable[[Any], Any] | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        """The schema by which pydantic validates the field."""

        def read(given: Any, inner: Callable[[Any], Any], info: Any) -> Any:
            if info.context is not None:
                value = inner(given)
                return with_place(info.field_name or "", lambda: self.convert(value, info.context))
            if self.from_python is not None:
                return with_place(info.field_name or "", lambda: cast("Any", self.from_python)(given))
            if isinstance(source, type) and not isinstance(given, source):
                raise InputError(info.field_name or "value", f"found {shown(given)}", f"a {source.__name__}")
            return given

        return core_schema.with_info_wrap_validator_function(read, handler.generate_schema(self.form))


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def schema(*, kw_only: bool = False) -> Callable[[type[Class]], type[Class]]:
    """Make a frozen dataclass whose fields are validated: from Python in SI, from a file in the file's units."""

    def make(cls: type[Class]) -> type[Class]:
        keys = dict.fromkeys(key for c in reversed(cls.__mro__) for key in vars(c).get("__annotations__", {}))
        refuse = refuse_unknown_keys(*("pose" if cls.__name__ == "BoardViews" and k == "board" else k for k in keys))
        check_keys: Any = classmethod(lambda _, value: refuse(value))
        setattr(cls, "check_keys", pydantic.model_validator(mode="before")(check_keys))  # noqa: B010
        made = pydantic.dataclasses.dataclass(frozen=True, kw_only=kw_only, config=_CONFIG)(cls)
        plain: Any = made.__init__
        positional = [f.name for f in fields(cast("Any", made)) if not f.kw_only]

        def validate_fields(self: Any, *args: Any, **kwargs: Any) -> None:
            try:
                plain(self, *args[len(positional) :], **dict(zip(positional, args, strict=False)), **kwargs)
            except ValidationError as error:
                raise first_misfit(error, _KEYS.get(cls.__name__, cls.__name__.lower())) from None

        made.__init__ = validate_fields  # type: ignore[method-assign]
        return cast("type[Class]", made)

    return make


_CONFIG = pydantic.ConfigDict(extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False, populate_by_name=True)
_KEYS = {"BoardViews": "board", "TargetViews": "tracker", "RandomReadings": "random"}


def read_as(kind: Any, given: object, place: str, context: FileContext) -> Any:
    """Read a value of a file as a type.

    Raises:
        InputError: It does not fit.
    """

    def read() -> Any:
        try:
            return TypeAdapter(kind).validate_python(given, context=context)
        except ValidationError as error:
            raise first_misfit(error, place) from None

    return with_place(place, read)


def with_place(place: str, read: Callable[[], Any]) -> Any:
    """Read something; the place of what is wrong with it is within another place."""
    try:
        return read()
    except InputError as error:
        if error.place.startswith(place):
            raise
        at = ": ".join(part for part in (place, error.place.removeprefix(": ")) if part)
        raise InputError(at, error.found, error.expected, error.hint) from None


def _scaled(unit: str) -> AfterValidator:
    def convert(value: float, info: ValidationInfo) -> float:
        return value if info.context is None else value * cast("FileContext", info.context).units.factor(unit)

    return AfterValidator(convert)


def _array(unit: str | None) -> InFile:
    """Three numbers; in a file those of x, y and z, or a list."""

    def convert(given: Any, context: FileContext) -> Floats:
        if isinstance(given, Mapping):
            xyz = validate(_Xyz, given, "")
            given = (xyz.x, xyz.y, xyz.z)
        scale = 1.0 if unit is None else context.units.factor(unit)
        return frozen(as_floats("", given, "(3,)") * scale)

    return InFile(Any, convert, lambda given: frozen(as_floats("", given, "(3,)")))


def frozen(array: Floats) -> Floats:
    """A read-only copy."""
    array = np.array(array)
    array.setflags(write=False)
    return array


class _Xyz(Schema):
    x: Number = 0.0
    y: Number = 0.0
    z: Number = 0.0


Length = Annotated[Number, _scaled("m")]
PositiveLength = Annotated[Positive, _scaled("m")]
LengthFromZero = Annotated[NotNegative, _scaled("m")]
Angle = Annotated[Number, _scaled("rad")]
PositiveAngle = Annotated[Positive, _scaled("rad")]
AngleFromZero = Annotated[NotNegative, _scaled("rad")]
Count = Annotated[int, Field(ge=0, le=MOST_DRAWN, strict=True)]
CountFromOne = Annotated[int, Field(gt=0, le=MOST_DRAWN, strict=True)]
Point = Annotated[Floats, _array("m")]
Direction = Annotated[Floats, _array(None)]


# --- frames and where the arm goes ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Placement:
    """A frame in another one, such as world_T_base or base_T_board.

    Attributes:
        rotation: Shape (3, 3).
        position: Shape (3,), [m].
    """

    rotation: Floats
    position: Floats

    def summary(self) -> dict[str, list[float]]:
        """For programs: position, [m], and rotation."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(self.rotation.copy()).as_quat(canonical=True)
        return {"xyz": self.position.tolist(), "quaternion_xyzw": quaternion.tolist()}


def _placement(values: FrameValues, context: FileContext) -> Placement:
    from scipy.spatial.transform import Rotation

    si = values.si(context.units, "")
    rotation = Rotation.from_euler("xyz", [si["roll"], si["pitch"], si["yaw"]])  # about fixed axes: Rz(yaw) Ry Rx
    return Placement(rotation.as_matrix(), np.array([si["x"], si["y"], si["z"]]))


def _frame_in_file(given: object, context: FileContext) -> str | Placement:
    if given in ("base", "unknown"):
        return str(given)
    if not isinstance(given, dict):
        raise InputError("", f"found {shown(given)}", "base, unknown, or a mapping of x, y, z, roll, pitch, yaw")
    return _placement(validate(FrameValues, given, ""), context)


def _as_it_is(given: Any) -> Any:
    return given


Frame = Annotated[Placement, InFile(FrameValues, _placement)]


@schema()
class Box:
    """A box along the axes of the robot's base frame.

    Attributes:
        lower: Its least x, y and z, shape (3,), [m].
        upper: Its largest, shape (3,), [m].
    """

    lower: Point
    upper: Point

    def __post_init__(self) -> None:
        if not (self.lower < self.upper).all():
            found = f"found {self.upper.tolist()} above a lower of {self.lower.tolist()}"
            raise InputError("box: upper", found, "more than lower in x, y and z")

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which points, shape (n, 3), [m], are in it or on its faces, shape (n,)."""
        inside: NDArray[np.bool_] = np.all((points >= self.lower) & (points <= self.upper), axis=1)
        return inside


@schema(kw_only=True)
class Conditions:
    """Conditions on configurations of any kind.

    Attributes:
        keep_out: Boxes that nothing of the arm may be inside, see `obstacles.enters`.
        apart: Least distance of two configurations, [rad]: the largest difference of a joint; a prismatic joint counts
            as its share of the arm's reach. None: any.
    """

    keep_out: tuple[Box, ...] = ()
    apart: PositiveAngle | None = None


def _roll(given: object) -> object:
    return None if given == "random" else given


def _posture(given: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
    if given is None or info.context is None:
        return given
    joints, units = info.context.robot.joints, info.context.units
    if len(given) != len(joints):
        raise InputError("posture", f"{len(given)} values", f"{len(joints)}, one a joint")
    for i, (value, joint) in enumerate(zip(given, joints, strict=True)):
        low, high = (limit / units.factor(joint.unit) for limit in (joint.lower, joint.upper))
        if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK:
            raise InputError(f"posture {i + 1}", f"found {shown(value)}", f"within [{low:.6g}, {high:.6g}]")
    return tuple(v * units.factor(j.unit) for v, j in zip(given, joints, strict=True))


@schema()
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
        posture: Configuration near which that of A is sought, if self-motion is held, shape (n_joints,), [rad]
            (prismatic: [m]); None draws it.
        field_of_view: Half angle of the cone about the optical axis in which the camera sees, [rad]. The camera, placed
            and rolled as above, is rotated so that the board's centre is anywhere in that cone, evenly in solid angle;
            at 0 the optical axis meets the centre.
        board_size: Width along the board's x and height along its y, [m]: only views with its four corners in the
            field of view are taken. None: the centre alone is seen.
    """

    board: Annotated[Frame, Field(validation_alias="pose")]
    count: Count = 51
    height: PositiveLength = 0.5
    radius: PositiveLength = 0.5
    distance: tuple[PositiveLength, PositiveLength] | None = None
    cone: PositiveAngle = math.pi / 3.0
    roll: Annotated[Angle | None, BeforeValidator(_roll)] = None
    self_motion: Literal["random", "held"] = "random"
    posture: Annotated[tuple[Number, ...] | None, AfterValidator(_posture)] = None
    field_of_view: AngleFromZero = 0.0
    board_size: tuple[PositiveLength, PositiveLength] | None = None

    def __post_init__(self) -> None:
        if self.distance is not None and self.distance[0] > self.distance[1]:
            raise InputError("board: distance", f"found {shown(list(self.distance))}", "the smaller one first")
        if max(self.cone, self.field_of_view) > 0.5 * math.pi + 1e-9:
            key = "cone" if self.cone > self.field_of_view else "field_of_view"
            raise InputError(f"board: {key}", f"found {getattr(self, key):g} rad", "at most a quarter turn")


@schema()
class TargetViews(Conditions):
    """Configurations in which a tracker sees a reflector on the tool.

    Attributes:
        station: The tracker in the base frame, shape (3,), [m].
        target: The reflector in the tool frame, shape (3,), [m].
        count: Number of configurations.
        axis: Where the reflector looks, in the tool frame, shape (3,).
        acceptance: It returns light from within this angle of its axis, [rad].
        distance: Smallest and largest distance from the tracker, [m].
        region: Where the reflector may be, in the base frame; None: anywhere.
    """

    station: Point
    target: Point = Field(default_factory=lambda: np.zeros(3))
    count: CountFromOne = 50
    axis: Direction = Field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    acceptance: PositiveAngle = math.pi / 6.0
    distance: tuple[LengthFromZero, Annotated[Bound, _scaled("m")]] = (0.0, math.inf)
    region: Box | None = None

    def __post_init__(self) -> None:
        if not self.axis.any():
            raise InputError("tracker: axis", "found 0, 0, 0", "a direction")
        if self.acceptance > math.pi:
            raise InputError("tracker: acceptance", f"found {self.acceptance:g} rad", "at most half a turn")
        if not self.distance[0] <= self.distance[1]:
            raise InputError("tracker: distance", f"found {shown(list(self.distance))}", "the smaller one first")


@schema()
class RandomReadings(Conditions):
    """Configurations drawn evenly within the joint limits, +-180 degrees or +-1 m where there are none."""

    count: CountFromOne


@schema()
class GivenReadings(Conditions):
    """Configurations of a table.

    Attributes:
        readings: Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """

    readings: Annotated[Floats, InFile(Any, lambda given, _: given, lambda given: frozen(np.asarray(given, float)))]


Configurations = BoardViews | TargetViews | RandomReadings | GivenReadings


@schema()
class _ConfigurationsInFile:
    board: BoardViews | None = None
    tracker: TargetViews | None = None
    random: RandomReadings | None = None
    table: FilePath | None = None
    keep_out: tuple[Box, ...] = ()
    apart: PositiveAngle | None = None


def _configurations(given: _ConfigurationsInFile, context: FileContext) -> Configurations:
    found: dict[str, Any] = _the_one_of({key: getattr(given, key) for key in ("board", "tracker", "random", "table")})
    ((key, value),) = found.items()
    if key == "table":
        value = GivenReadings(read_measurements(context.folder / value, context.robot, units=context.units).readings)
    return cast("Configurations", replace(value, keep_out=given.keep_out, apart=given.apart))


def _the_one_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """The only entry that is not None.

    Raises:
        InputError: None or several are.
    """
    found = {key: value for key, value in given.items() if value is not None}
    if len(found) != 1:
        raise InputError("", f"found {' and '.join(found) or 'none'}", known_names(list(given)))
    return found


ConfigurationsInFile = Annotated[Configurations, InFile(_ConfigurationsInFile, _configurations, _as_it_is)]


# --- noise and landmarks ----------------------------------------------------------------------------------------------


class _NoiseOfFields(Schema):
    position: LengthFromZero | None = None
    orientation: AngleFromZero | None = None
    joint: Any = None  # one value, or one a joint
    distance: LengthFromZero | None = None
    angle: AngleFromZero | None = None
    point: LengthFromZero | None = None
    pixel: NotNegative | None = None


_GENERIC: dict[str, Any] = {
    name: (LengthFromZero | None if column.unit == "length" else AngleFromZero | None, None)
    for name, column in GENERIC_COLUMNS.items()
}
_NoiseInFile = create_model("_NoiseInFile", __base__=_NoiseOfFields, **_GENERIC)

NOISE_KINDS = tuple(kind for kind in _NoiseInFile.model_fields if kind != "joint")


def _noise(given: Any, context: FileContext) -> Noise:
    values = {kind: getattr(given, kind) for kind in NOISE_KINDS}
    joint = 0.0 if given.joint is None else given.joint
    return Noise().updated(**values, joint=joint_noise(joint, context.units, context.robot, ""))


NoiseInFile = Annotated[Noise, InFile(_NoiseInFile, _noise)]


@schema()
class Spot:
    """The true place of a point: of a target in the tool frame, of an anchor or a contact point in the base frame.

    Attributes:
        xyz: Shape (3,), [m].
        tolerance: 1 sigma on each axis of what the calibration knows of it, [m]: 0: exactly; None: nothing.
    """

    xyz: Point
    tolerance: LengthFromZero | None = None


class _SpotInFile(Schema):
    x: Number
    y: Number
    z: Number
    tolerance: NotNegative | None = None


def _spot(given: _SpotInFile, context: FileContext) -> Spot:
    length = context.units.factor("m")
    tolerance = None if given.tolerance is None else given.tolerance * length
    return Spot(np.array([given.x, given.y, given.z]) * length, tolerance)


@schema()
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
        if length == 0.0:
            raise InputError("normal", "found 0, 0, 0", "a direction")
        object.__setattr__(self, "normal", frozen(self.normal / length))


def _landmarks(kind: Any, counted: bool = True) -> InFile:
    """Landmarks by name; or how many are drawn."""

    def convert(given: Any, context: FileContext) -> Any:
        if not isinstance(given, Mapping):
            return read_as(Count if counted else dict[str, Any], given, "", context)
        for name in given:
            if not isinstance(name, str) or not name or name != name.strip() or not name.isprintable():
                raise InputError("", f"found name {shown(name)}", "a word")
        return {name: read_as(kind, one, name, context) for name, one in given.items()}

    def check_count(given: Any) -> Any:
        return given if isinstance(given, Mapping) else TypeAdapter(Count).validate_python(given)

    return InFile(Any, convert, check_count)


Spots = Annotated[Mapping[str, Spot] | int, _landmarks(Annotated[Spot, InFile(_SpotInFile, _spot)])]
Planes = Annotated[Mapping[str, Plane] | int, _landmarks(Plane)]
Boards = Annotated[Mapping[str, Placement], _landmarks(Frame, counted=False)]
PairingInFile = Annotated[Pairing, InFile(Any, lambda given, _: pairing_of(given, "pairing"))]


@schema()
class Corners:
    """The corners of a chequered board, in rows and columns about its centre, in its plane.

    Attributes:
        columns: Along its x axis.
        rows: Along its y axis.
        square: From one to the next, [m].
    """

    columns: CountFromOne
    rows: CountFromOne
    square: PositiveLength

    @property
    def points(self) -> Floats:
        """Coordinates x and y of each, row by row, shape (rows * columns, 2), [m]."""
        x, y = (self.square * (np.arange(n) - 0.5 * (n - 1)) for n in (self.columns, self.rows))
        return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board anywhere in its plane.

    Attributes:
        points: Coordinates x and y of each, shape (n, 2), [m].
    """

    points: Floats


# --- instruments ------------------------------------------------------------------------------------------------------


_MODELS_OF: dict[str, tuple[Model, ...]] = {
    "PlainInstrument": (),
    "Sockets": ("distance",),
    "PairGauge": tuple(PAIR_MODELS),
    "Tracker": (*POSE_MODELS, *PAIR_MODELS),
    "LengthGauge": ("anchor",),
    "Indicator": ("plane",),
    "BoardCamera": ("board", "pixels"),
}
"""Models that each instrument measures; a plain one measures all that no other does."""

_LANDMARKS_OF = {"Sockets": "sockets", "LengthGauge": "anchors", "Indicator": "planes"}
"""Landmarks of which an instrument needs at least one."""


@schema(kw_only=True)
class Instrument:
    """Fields of all instruments.

    Attributes:
        model: The model of its table.
        name: The name of its table, without the ending.
        noise: Its own values, 1 sigma; the scenario's where there are none, and those of the joints always.
        stated_noise: Values that the calibration is given instead.
        configurations: Where it measures; where the scenario's instruments do if None. Test rows are those of the
            scenario's validation.
    """

    model: Model
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
    noise: NoiseInFile = Field(default_factory=Noise)
    stated_noise: NoiseInFile = Field(default_factory=Noise)
    configurations: ConfigurationsInFile | None = None

    def __post_init__(self) -> None:
        if _MODELS_OF[type(self).__name__]:
            check(f"instruments: {self.name}: model", self.model, _MODELS_OF[type(self).__name__])
        landmarks = getattr(self, _LANDMARKS_OF.get(type(self).__name__, ""), None)
        if landmarks is not None and not landmarks:
            self._refuse(_LANDMARKS_OF[type(self).__name__], "found none", "at least one")

    def _refuse(self, key: str, found: str, expected: str) -> None:
        raise InputError(f"instruments: {self.name}: {key}", found, expected)


FrameOfInstrument = Annotated[str | Placement | None, InFile(Any, _frame_in_file, _as_it_is)]


@schema(kw_only=True)
class PlainInstrument(Instrument):
    """An instrument that measures the columns of its model at every configuration, landmarks in turn."""


@schema(kw_only=True)
class Tracker(Instrument):
    """Poses, positions or orientations of the tool, or positions of targets on it; pairs formed from these.

    Every target is seen at every configuration. With several stations the configurations are measured from them in
    turn.

    Attributes:
        targets: By name, or how many; the tool point itself if 0.
        stations: How many; each has a frame of its own.
        frame: world_T_base: the base itself, unknown (drawn), or given; the scenario's if None. Of several stations
            the first has it, the others' are drawn.
        pairing: How pairs are formed, for models of pairs.
    """

    targets: Spots = 0
    stations: CountFromOne = 1
    frame: FrameOfInstrument = None
    pairing: PairingInFile = Field(default_factory=Pairing)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.targets and not POSE_MODELS.get(self.model, (True, False))[1]:
            self._refuse("targets", f"with model {self.model}", "model position or pose")
        if self.stations > 1 and (self.frame == "base" or self.model in PAIR_MODELS):
            found = "frame base" if self.frame == "base" else f"model {self.model}"
            self._refuse("stations", f"{self.stations} with {found}", "1")


@schema(kw_only=True)
class PairGauge(Instrument):
    """Distances and angles between configurations, measured directly.

    Attributes:
        pairs: Which configurations.
    """

    pairs: PairingInFile = Field(default_factory=Pairing)


@schema(kw_only=True)
class LengthGauge(Instrument):
    """Lengths from the tool point to anchors, one at a configuration, the anchors in turn.

    Attributes:
        anchors: By name, or how many.
        offset: What the instrument adds to every length, [m], which the calibration then estimates; nothing if None.
        contact: Whether the tool point is brought to the anchor, from each configuration, and the length is 0.
    """

    model: Model = "anchor"
    anchors: Spots = 3
    offset: Length | None = None
    contact: pydantic.StrictBool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.contact and self.offset is not None:
            self._refuse("offset", "with contact", "none: there is no length")


@schema(kw_only=True)
class Indicator(Instrument):
    """Distances of the tool point from planes, one at a configuration, the planes in turn.

    Attributes:
        planes: By name, or how many.
        contact: Whether the tool point is brought to the plane, along its normal from each configuration; what is out
            of reach is left out.
    """

    model: Model = "plane"
    planes: Planes = 3
    contact: pydantic.StrictBool = False


@schema(kw_only=True)
class BoardCamera(Instrument):
    """Boards as a camera on the tool sees them; or the board on the tool as a camera in the room does.

    A board is seen where its centre (pixels: the corner) is in front of the camera (pixels: and in the image, which is
    twice as wide as cx and twice as high as cy), and the camera is on the side of the board's z axis.

    Attributes:
        boards: base_T_board by name; where there are none, that which the configurations look at.
        camera: For pixels.
        corners: For pixels.
        fixed: Whether the camera stands in the room and the board is the tool.
        frame: camera_T_base of a fixed camera; if None one that looks at the workspace's middle from two and a half
            times its radius.
        from_behind: Names of boards whose z axis points away from the camera instead.
    """

    boards: Boards = Field(default_factory=dict)
    camera: Annotated[Camera | None, InFile(Any, lambda given, _: given)] = None
    corners: Annotated[Corners | BoardPoints | None, InFile(Corners, lambda given, _: given, _as_it_is)] = None
    fixed: bool = False
    frame: Frame | None = None
    from_behind: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        pixels = self.model == "pixels"
        for key in ("camera", "corners"):
            if (getattr(self, key) is not None) != pixels:
                found = f"found {'none' if pixels else 'one'} with model {self.model}"
                self._refuse(key, found, "it with model pixels")
        if self.fixed and (self.boards or not pixels):
            found = "boards" if self.boards else f"model {self.model}"
            self._refuse("camera", f"fixed, with {found}", "model pixels, and the board on the tool")


@schema(kw_only=True)
class Sockets(Instrument):
    """Contact points that the tool point touches, one from each configuration, in turn; and their distances.

    Attributes:
        sockets: By name, or how many.
    """

    model: Model = "distance"
    sockets: Spots = 2


def override_noise(noise: Noise, more: Noise) -> Noise:
    """A noise with the values of another where it has some; the joints' stay."""
    values = {kind: more.get(kind) for kind in NOISE_KINDS}
    return noise.updated(**{name: value for name, value in values.items() if value is not None})


def frame_knowledge(frame: str | Placement) -> FrameKnowledge:
    """What the calibration knows of a frame."""
    return "known" if isinstance(frame, str) and frame == "base" else "unknown"


# --- the scenario -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Errors:
    """True minus nominal values of parameters.

    Attributes:
        law: `uniform` within plus and minus the values, `normal` with the values as 1 sigma, or the values
            themselves (`values`).
        values: By parameter name or by kind (`a`, `alpha`, `tool`, ...; a name goes before its kind), [m] or [rad].
            Errors that are drawn are those of estimated parameters only; what has no value has no error.
    """

    law: Literal["uniform", "normal", "values"]
    values: Mapping[str, float]

    def __post_init__(self) -> None:
        check("errors: law", self.law, ("uniform", "normal", "values"))


class _ErrorsInFile(Schema):
    uniform: dict[str, NotNegative] | None = None
    normal: Any = None  # `tolerance`, or as `uniform`
    values: dict[str, Number] | None = None


def _errors(given: _ErrorsInFile, context: FileContext) -> Errors:
    found = _the_one_of({key: getattr(given, key) for key in _ErrorsInFile.model_fields})
    ((law, values),) = found.items()
    if values == "tolerance":
        for p in context.robot.parameters:
            if p.estimated and p.tolerance is None:
                raise InputError("normal", f"{p.name} of the robot has no tolerance", "one for all that is estimated")
        values = {p.name: p.tolerance for p in context.robot.parameters if p.tolerance is not None}
    else:
        values = read_as(dict[str, NotNegative], values, law, context) if law == "normal" else values
        values = {key: value * context.units.factor(unit_of_key(key)) for key, value in values.items()}
    return Errors(cast("Any", law), values_by_name(context.robot, values, law))


def values_by_name(robot: Robot, values: Mapping[str, float], place: str) -> dict[str, float]:
    """Turn values by parameter name or by kind into values by parameter name.

    Args:
        robot: The robot.
        values: By name or by kind, [m] or [rad].
        place: File and key, for messages.

    Raises:
        InputError: A key that is neither a parameter nor a kind of the robot.
    """
    names = names_of(robot.parameters)
    kinds = sorted({kind for p in robot.parameters if (kind := tolerance_kind(p)) is not None})
    for key in values:
        if key not in names and key not in kinds:
            hint = did_you_mean(key, [*kinds, *names], NEAR)
            raise InputError(place, f"unknown parameter or kind {key!r}", known_names(kinds), hint)
    found = {p.name: values.get(p.name, values.get(tolerance_kind(p) or "")) for p in robot.parameters}
    return {name: value for name, value in found.items() if value is not None}


@dataclass(frozen=True)
class Scenario(Brief):
    """A simulation to run, in SI.

    Attributes:
        robot: The nominal robot.
        errors: True minus nominal parameters; None where nothing is to be simulated, as for a design.
        configurations: Where the robot is measured to be calibrated, as the nominal robot would get there.
        noise: True noise, 1 sigma.
        frame: world_T_base, in whose world the poses are measured: `base` is the base itself, `unknown` an arbitrary
            one, drawn.
        validation: Where it is measured to test the calibration; None without test rows.
        stated_noise: The noise that the calibration is given, where that is another one.
        job: Other keys of the calibration job, such as model and pairing.
        length_unit: Unit of length of the job's files.
        angle_unit: Unit of angles of the job's files.
        name: What it is called.
        source: The file's name, or that of a shipped scenario; for messages.
        instruments: What measures, each a table of its own; poses of the tool are measured if empty.
    """

    robot: Robot
    errors: Errors | None
    configurations: Configurations
    noise: Noise
    frame: Literal["base", "unknown"] | Placement = "unknown"
    validation: Configurations | None = None
    stated_noise: Noise | None = None
    job: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({"model": "distance-rotation"}))
    length_unit: LengthUnit = "m"
    angle_unit: AngleUnit = "rad"
    name: str = "scenario"
    source: str = "scenario"
    instruments: tuple[Instrument, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.frame, Placement):
            check(f"{self.source}: frame", self.frame, ("base", "unknown"))
        check(f"{self.source}: length_unit", self.length_unit, LengthUnit)
        check(f"{self.source}: angle_unit", self.angle_unit, AngleUnit)
        names = [i.name for i in self.instruments]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{self.source}: instruments", f"{names.count(name)} with the name {name}", "one")

    @property
    def pairing(self) -> Pairing:
        """How pairs of the default instrument's poses are formed."""
        return pairing_of(self.job.get("pairing", "star"), f"{self.source}: job: pairing")


class _ScenarioInFile(Schema):
    name: str | None = None
    robot: Any  # a path, or the mapping of a robot file
    units: UnitsOfFile = Units()
    errors: Any = None
    configurations: Any
    noise: Any
    frame: Any = "unknown"
    validation: Any = None
    job: dict[str, Any] | None = None
    instruments: Any = None


@checked
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
    if str(path) in known and (is_folder(path) or not exists(path)):
        path = SCENARIOS / path / "scenario.yaml"
    elif not exists(path) and path.suffix not in {".yaml", ".yml"}:
        raise InputError("scenario", f"found {str(path)!r}", f"a file, or one of {', '.join(known)}")
    file = validate(_ScenarioInFile, read_yaml(path), source)
    robot = robot_of(file.robot, f"{source}: robot", path.parent, file.units)
    context = FileContext(file.units, path.parent, robot)

    def read(kind: Any, key: str, given: Any = None) -> Any:
        given = getattr(file, key) if given is None else given
        return None if given is None else read_as(kind, given, f"{source}: {key}", context)

    noise = read(NoiseInFile, "noise")
    job, stated = _job(file, noise, source, context)
    instruments = () if file.instruments is None else _read_instruments(file.instruments, stated, source, context)
    check_choices({**job, **({"model": instruments[0].model} if instruments else {})}, robot, f"{source}: job")
    return Scenario(
        robot=robot,
        errors=read(Annotated[Errors, InFile(_ErrorsInFile, _errors)], "errors"),
        configurations=read(ConfigurationsInFile, "configurations"),
        noise=noise,
        frame=cast("Any", with_place(f"{source}: frame", lambda: _frame_in_file(file.frame, context))),
        validation=read(ConfigurationsInFile, "validation"),
        stated_noise=None if stated is None else override_noise(replace(noise, joint=stated.joint), stated),
        job=job,
        length_unit=file.units.length,
        angle_unit=file.units.angle,
        name=file.name or Path(source).stem,
        source=source,
        instruments=instruments,
    )


def _job(file: _ScenarioInFile, noise: Noise, source: str, context: FileContext) -> tuple[dict[str, Any], Noise | None]:
    """Keys of the job that the simulation does not write, and the noise that it specifies instead of the true one."""
    place, alone = f"{source}: job", file.instruments is None
    given = dict(file.job) if file.job is not None else {"model": "distance-rotation"} if alone else {}
    written = {"robot", "measurements", "pairs", "frame", "units", "truth"}
    of_instruments = {"model", "pairing", "targets", "anchors", "tolerance", "offset", "camera"}
    for key in given:
        if key in written or (key in of_instruments and not alone):
            raise InputError(place, f"found key {key!r}", "none", "it follows from the scenario or its instruments")
    specified = given.pop("noise", None)
    if specified is None:
        return given, None
    found: Noise = read_as(NoiseInFile, specified, f"{place}: noise", context)
    for kind in NOISE_KINDS:
        if found.get(kind) == 0.0:
            raise InputError(f"{place}: noise: {kind}", "found 0", "a number above 0")
    return given, found if "joint" in specified else replace(found, joint=noise.joint)


def _read_instruments(given: object, stated: Noise | None, source: str, context: FileContext) -> tuple[Instrument, ...]:
    """The instruments of a file.

    Raises:
        InputError: One cannot be used.
    """
    place = f"{source}: instruments"
    if not isinstance(given, list) or not given:
        raise InputError(place, f"found {shown(given)}", "a list of instruments, each with its model")
    found: list[Instrument] = []
    for number, one in enumerate(given, start=1):
        at = f"{place} {number}"
        if not isinstance(one, dict) or "model" not in one:
            raise InputError(at, f"found {shown(one)}", "a mapping with a model")
        model = one["model"]
        check(f"{at}: model", model, Model)
        taken = [i.name for i in found]
        count = 1 + sum(re.fullmatch(rf"{model}(_\d+)?", other) is not None for other in taken)
        entry = {"name": model if count == 1 else f"{model}_{count}"} | one
        files = {f"{other}{end}".lower() for other in taken for end in ("", "_pairs")}
        if {f"{entry['name']}{end}".lower() for end in ("", "_pairs")} & files:
            raise InputError(f"{at}: name", f"{entry['name']} is there already", "another one")
        if "camera" in entry:
            camera, fixed = camera_in(entry["camera"], f"{at}: camera", context.folder)
            entry |= {"camera": camera, "fixed": fixed}
        try:
            instrument = read_as(_class_for(entry), entry, at, context)
        except InputError as error:
            within = error.place.replace(f"instruments: {entry['name']}: ", "")
            raise InputError(within, error.found, error.expected, error.hint) from None
        found.append(instrument if stated is None else replace(instrument, stated_noise=replace(stated, joint=0.0)))
    return tuple(found)


def _class_for(entry: Mapping[str, Any]) -> type[Instrument]:
    """The instrument that measures what the model of a file's entry needs."""
    if entry["model"] in PAIR_MODELS:
        return Sockets if "sockets" in entry else PairGauge if "pairs" in entry else Tracker
    kinds: tuple[type[Instrument], ...] = (Tracker, LengthGauge, Indicator, BoardCamera)
    return next((kind for kind in kinds if entry["model"] in _MODELS_OF[kind.__name__]), PlainInstrument)
