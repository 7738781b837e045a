"""Instruments of a scenario: which model each serves, and what is true of it. `measuring` says what they measure.

Points, planes and boards are given by name, or drawn where there is only a number of them:

| drawn | where |
|---|---|
| targets | a tenth of the workspace's radius from the tool point, in any direction |
| anchors | in and around the workspace: half to one and a half of its radius from its middle, in any direction |
| planes | through the workspace, the first three across each other, as of a cube |
| sockets, anchors in contact | where the nominal arm has its tool point at a configuration that it moves well from |

The workspace is that of the nominal arm's tool point at the configurations: their mean, and the root of their mean
squared distance from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays, as_floats
from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Noise
from fg_calib.measurements.kinds import Camera
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge, Model, Pairing, check, check_flag, check_number
from fg_calib.simulation.configurations import Configurations, Placement
from fg_calib.sizes import MOST_DRAWN

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spot:
    """The true place of a point: of a target in the tool frame, of an anchor or a socket in the base frame.

    Attributes:
        xyz: Shape (3,), [m].
        tolerance: 1 sigma on each axis of what the calibration is told of it, [m]: 0 tells it exactly; None tells
            nothing.
    """

    xyz: Floats
    tolerance: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", as_floats("spot: xyz", self.xyz, "(3)"))
        if self.tolerance is not None:
            check_number("spot: tolerance", self.tolerance)


@dataclass(frozen=True)
class Plane:
    """The true place of a plane: points x with `normal . x = distance`, distances from it positive along its normal.

    Attributes:
        normal: In the base frame, shape (3,); of any length above 0.
        distance: Of the plane from the base, along the normal, [m].
    """

    normal: Floats
    distance: float

    def __post_init__(self) -> None:
        normal = as_floats("plane: normal", self.normal, "(3)")
        length = float(np.linalg.norm(normal))
        if length == 0.0:
            raise InputError("plane: normal", "found 0, 0, 0", "a direction")
        object.__setattr__(self, "normal", normal / length)


@dataclass(frozen=True)
class Corners:
    """The corners of a chequered board, in rows and columns about its centre, in its plane.

    Attributes:
        columns: Along its x axis.
        rows: Along its y axis.
        square: From one to the next, [m].
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        for key in ("columns", "rows"):
            check_number(f"corners: {key}", getattr(self, key), above=True, whole=True, most=MOST_DRAWN)
        check_number("corners: square", self.square, above=True)

    @property
    def points(self) -> Floats:
        """Coordinates x and y of each, row by row, shape (rows * columns, 2), [m]."""
        x, y = (self.square * (np.arange(n) - 0.5 * (n - 1)) for n in (self.columns, self.rows))
        return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)


@dataclass(frozen=True)
class BoardPoints(FrozenArrays):
    """Points of a board anywhere in its plane.

    Attributes:
        points: Coordinates x and y of each, shape (n, 2), [m].
    """

    points: Floats


@dataclass(frozen=True, kw_only=True)
class Instrument:
    """What all instruments have.

    Attributes:
        model: The model of its table.
        name: The name of its table, without the ending.
        noise: Its own figures, 1 sigma; the scenario's where there are none, and those of the joints always.
        stated_noise: Figures that the calibration is told instead.
        configurations: Where it measures; where the scenario's instruments do if None. Test rows are those of the
            scenario's validation.
    """

    model: Model
    name: str
    noise: Noise = field(default_factory=Noise)
    stated_noise: Noise = field(default_factory=Noise)
    configurations: Configurations | None = None

    def _only(self, *models: Model) -> None:
        check(f"instruments: {self.name}: model", self.model, models)


@dataclass(frozen=True, kw_only=True)
class Tracker(Instrument):
    """Poses, positions or orientations of the tool, or positions of targets on it; pairs formed of these.

    Every target is seen at every configuration. With several stations the configurations are measured from them in
    turn.

    Attributes:
        targets: By name, or how many; the tool point itself if 0.
        stations: How many; each has a frame of its own.
        frame: world_T_base: the base itself, unknown (drawn), or given; the scenario's if None. Of several stations
            the first has it, the others' are drawn.
        pairing: How pairs are formed, for models of pairs.
    """

    targets: Mapping[str, Spot] | int = 0
    stations: int = 1
    frame: str | Placement | None = None
    pairing: Pairing = field(default_factory=Pairing)

    def __post_init__(self) -> None:
        self._only(*POSE_MODELS, *PAIR_MODELS)
        place = f"instruments: {self.name}"
        check_number(f"{place}: stations", self.stations, above=True, whole=True, most=MOST_DRAWN)
        check_count(f"{place}: targets", self.targets, least=0)
        if self.targets and not POSE_MODELS.get(self.model, (True, False))[1]:
            raise InputError(f"{place}: targets", f"with model {self.model}", "model position or pose")
        if self.stations > 1 and (self.frame == "base" or self.model in PAIR_MODELS):
            found = "frame base" if self.frame == "base" else f"model {self.model}"
            raise InputError(f"{place}: stations", f"{self.stations} with {found}", "1")


@dataclass(frozen=True, kw_only=True)
class PairGauge(Instrument):
    """Distances and angles between configurations, measured directly.

    Attributes:
        pairs: Which configurations.
    """

    pairs: Pairing = field(default_factory=Pairing)

    def __post_init__(self) -> None:
        self._only(*PAIR_MODELS)


@dataclass(frozen=True, kw_only=True)
class LengthGauge(Instrument):
    """Lengths from the tool point to anchors, one at a configuration, the anchors in turn.

    Attributes:
        anchors: By name, or how many.
        offset: What the instrument adds to every length, [m], which the calibration then estimates; nothing if None.
        contact: Whether the tool point is brought to the anchor, from each configuration, and the length is 0.
    """

    model: Model = "anchor"
    anchors: Mapping[str, Spot] | int = 3
    offset: float | None = None
    contact: bool = False

    def __post_init__(self) -> None:
        self._only("anchor")
        check_count(f"instruments: {self.name}: anchors", self.anchors)
        check_flag(f"instruments: {self.name}: contact", self.contact)
        if self.contact and self.offset is not None:
            raise InputError(f"instruments: {self.name}: offset", "with contact", "none: there is no length")


@dataclass(frozen=True, kw_only=True)
class Indicator(Instrument):
    """Distances of the tool point from planes, one at a configuration, the planes in turn.

    Attributes:
        planes: By name, or how many.
        contact: Whether the tool point is brought to the plane, across it from each configuration; what is out of
            reach is left out.
    """

    model: Model = "plane"
    planes: Mapping[str, Plane] | int = 3
    contact: bool = False

    def __post_init__(self) -> None:
        self._only("plane")
        check_count(f"instruments: {self.name}: planes", self.planes)
        check_flag(f"instruments: {self.name}: contact", self.contact)


@dataclass(frozen=True, kw_only=True)
class BoardCamera(Instrument):
    """Boards as a camera on the tool sees them; or the board on the tool as a camera in the room does.

    A board is seen where its centre (pixels: the corner) is before the camera (pixels: and in the image, which is twice
    as wide as cx and twice as high as cy), and the camera is on the side of the board's z axis.

    Attributes:
        boards: base_T_board by name; where there are none, that which the configurations look at.
        camera: For pixels.
        corners: For pixels.
        fixed: Whether the camera stands in the room and the board is the tool.
        frame: camera_T_base of a fixed camera; if None one that looks at the workspace's middle from two and a half
            times its radius.
    """

    boards: Mapping[str, Placement] = field(default_factory=dict)
    camera: Camera | None = None
    corners: Corners | BoardPoints | None = None
    fixed: bool = False
    frame: Placement | None = None

    def __post_init__(self) -> None:
        self._only("board", "pixels")
        place, pixels = f"instruments: {self.name}", self.model == "pixels"
        for key in ("camera", "corners"):
            if (getattr(self, key) is not None) != pixels:
                found = "none" if pixels else "one"
                raise InputError(f"{place}: {key}", f"found {found} with model {self.model}", "it with model pixels")
        if self.fixed and (self.boards or not pixels):
            found = "boards with a fixed camera" if self.boards else f"a fixed camera with model {self.model}"
            raise InputError(place, found, "model pixels, and the board on the tool")
        if self.frame is not None and not self.fixed:
            raise InputError(f"{place}: frame", "without a fixed camera", "none: the camera is the tool")


@dataclass(frozen=True, kw_only=True)
class Sockets(Instrument):
    """Points that the tool point touches, one from each configuration, in turn; and how far they are from each other.

    Attributes:
        sockets: By name, or how many.
    """

    model: Model = "distance"
    sockets: Mapping[str, Spot] | int = 2

    def __post_init__(self) -> None:
        self._only("distance")
        check_count(f"instruments: {self.name}: sockets", self.sockets)


def check_count(place: str, given: object, least: int = 1) -> None:
    """Check a number of things to draw, or that there are any by name.

    Raises:
        InputError: There are none, or too many to draw.
    """
    if not isinstance(given, Mapping):
        check_number(place, given, least=least, whole=True, most=MOST_DRAWN)
    elif len(given) < least:
        raise InputError(place, "found none", "at least one")


def with_figures(noise: Noise, more: Noise) -> Noise:
    """A noise with the figures of another where it has some; the joints' stay."""
    figures = {f.name: getattr(more, f.name) for f in fields(Noise)[:-1] if f.name != "joint"}
    own = {f.name: getattr(noise, f.name) for f in fields(Noise)}
    return Noise(**own | {name: figure for name, figure in figures.items() if figure is not None})


def frame_knowledge(frame: str | Placement) -> FrameKnowledge:
    """What the calibration knows of a frame."""
    return "known" if isinstance(frame, str) and frame == "base" else "unknown"
