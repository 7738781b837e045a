"""Instruments of a scenario as its file states them, under the key `instruments`: a list, an entry a table.

```yaml
instruments:
  - {model: position, stations: 2, targets: {smr1: {x: 50, y: 0, z: 100}, smr2: {x: 0, y: 60, z: 90}}}
  - {model: anchor, name: wire, anchors: 3, offset: 120, noise: {distance: 0.02}}
  - {model: anchor, name: bar, anchors: {bolt: {x: 800, y: 0, z: 0, tolerance: 2}}, contact: true}
  - {model: plane, planes: {table: {normal: [0, 0, 1], distance: 300}}}
  - {model: board, configurations: {board: {pose: {x: 900}, count: 20}}}
  - {model: pixels, camera: camera.yaml, corners: {columns: 8, rows: 6, square: 30}, boards: {wall: {x: 900, z: 400}}}
  - {model: distance, name: sockets, sockets: 4}
  - {model: distance, name: caliper, pairs: {random: 30}}
```

| key | for | meaning |
|---|---|---|
| `model` | all | that of the table |
| `name` | all | of its file, without the ending; the model's if not given (`position`, then `position_2`) |
| `noise` | all | its own figures, 1 sigma; others and `joint` are the scenario's |
| `configurations` | all | its own; else the scenario's. Test rows are those of the scenario's `validation` |
| `targets` | `pose position` | points of the tool by name, or how many are drawn; none: the tool point |
| `stations` | `pose position orientation` | how many measure in turn, each with a frame of its own |
| `frame` | the same; fixed cameras | world_T_base as of the scenario, whose holds if there is none; camera_T_base |
| `pairing` | models of pairs | how pairs are formed of measured poses |
| `pairs` | the same | pairs that are measured directly: star, chain, all or {random: N, seed: S} |
| `sockets` | `distance` | touched points by name, or how many; one is touched from each configuration, in turn |
| `anchors`, `offset` | `anchor` | anchors by name, or how many; what the instrument adds, which is then estimated |
| `planes` | `plane` | planes by name, `{normal: [x, y, z], distance: d}`, or how many |
| `contact` | `anchor plane` | true: the tool point is brought there, from each configuration |
| `boards` | `board pixels` | base_T_board by name; else the board that the configurations look at |
| `camera`, `corners` | `pixels` | as in a job, `fixed: true` for one in the room; corners about the board's centre |

A point with a `tolerance` is told to the job, off by as much (1 sigma on each axis; 0: exactly), others are estimated.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, StrictBool

from fg_calib.errors import InputError
from fg_calib.io.job import camera_in, pairing_of
from fg_calib.io.robot_file import FrameValues
from fg_calib.io.units import Units
from fg_calib.io.yaml import Count, NotNegative, Number, Positive, Schema, shown, validate
from fg_calib.measurements.dataset import Noise
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model, known_names
from fg_calib.simulation.board_file import placement
from fg_calib.simulation.configurations import Configurations, Placement
from fg_calib.simulation.instruments import (
    BoardCamera,
    Corners,
    Indicator,
    Instrument,
    LengthGauge,
    PairGauge,
    Plane,
    Sockets,
    Spot,
    Tracker,
)


class _Entry(Schema):
    model: Model
    name: str | None = None
    noise: Any = None  # `_Figures`
    configurations: Any = None
    targets: Any = None  # a `_Count`, or by name a `_Spot`
    stations: Count | None = None
    frame: Any = None
    pairing: Any = None
    pairs: Any = None
    sockets: Any = None
    anchors: Any = None
    offset: Number | None = None
    planes: Any = None  # a `_Count`, or by name a `_Plane`
    contact: StrictBool | None = None
    boards: dict[str, FrameValues] | None = None
    camera: Any = None
    corners: Any = None  # `_Corners`


class _Figures(Schema):
    position: NotNegative | None = None
    orientation: NotNegative | None = None
    distance: NotNegative | None = None
    angle: NotNegative | None = None
    point: NotNegative | None = None
    pixel: NotNegative | None = None


class _StatedFigures(Schema):
    position: Positive | None = None
    orientation: Positive | None = None
    distance: Positive | None = None
    angle: Positive | None = None
    point: Positive | None = None
    pixel: Positive | None = None


class _Count(Schema):
    count: Count


class _Spot(Schema):
    x: Number
    y: Number
    z: Number
    tolerance: NotNegative | None = None


class _Plane(Schema):
    normal: tuple[Number, Number, Number]
    distance: Number


class _Corners(Schema):
    columns: Annotated[Count, Field(gt=0)]
    rows: Annotated[Count, Field(gt=0)]
    square: Positive


_OF_ALL = ("model", "name", "noise", "configurations")
_KEYS: dict[type[Instrument], tuple[str, ...]] = {
    Tracker: ("targets", "stations", "frame", "pairing"),
    PairGauge: ("pairs",),
    Sockets: ("sockets",),
    LengthGauge: ("anchors", "offset", "contact"),
    Indicator: ("planes", "contact"),
    BoardCamera: ("boards", "camera", "corners", "frame"),
}
"""The keys that an instrument has beside those of all."""


def noise_figures(given: object, units: Units, place: str, *, stated: bool = False) -> Noise:
    """Figures of noise in SI, but those of the joints.

    Args:
        given: As the file states them.
        units: Of the file.
        place: File and key, for messages.
        stated: Whether a calibration is told them: above 0 then.

    Raises:
        InputError: They are no figures.
    """
    schema = _StatedFigures if stated else _Figures
    file = validate(schema, {} if given is None else given, place)
    figures: dict[str, Any] = {name: getattr(file, name) for name in schema.model_fields}
    for name, figure in figures.items():
        if figure is not None and name != "pixel":
            unit = "rad" if name in ("orientation", "angle") else "m"
            figures[name] = units.sigma(figure, unit, f"{place}: {name}")
    return Noise(**figures)


@dataclass(frozen=True)
class InstrumentReader:
    """Reads the instruments of a scenario.

    Attributes:
        source: The scenario's file, for messages.
        folder: Where paths in it start.
        units: Of the file.
        stated: Figures of noise that the job states instead of the true ones.
        configurations: Reads configurations, given these and their place.
        frame: Reads a frame, given it and its place.
    """

    source: str
    folder: Path
    units: Units
    stated: Noise
    configurations: Callable[[Any, str], Configurations]
    frame: Callable[[Any, str], str | Placement]

    def read(self, given: object) -> tuple[Instrument, ...]:
        """The instruments.

        Raises:
            InputError: One cannot be used.
        """
        place = f"{self.source}: instruments"
        if not isinstance(given, list) or not given:
            raise InputError(place, f"found {shown(given)}", "a list of instruments, each with its model")
        found: dict[str, Instrument] = {}
        for number, one in enumerate(given, start=1):
            instrument = self._one(one, f"{place} {number}", found)
            found[instrument.name] = instrument
        return tuple(found.values())

    def _one(self, given: object, place: str, others: Mapping[str, Instrument]) -> Instrument:
        file = validate(_Entry, given, place)
        kind = _kind_of(file)
        keys = [key for key in _Entry.model_fields if getattr(file, key) is not None]
        for key in keys:
            if key not in _OF_ALL and key not in _KEYS[kind]:
                raise InputError(f"{place}: {key}", f"with model {file.model}", known_names([*_OF_ALL, *_KEYS[kind]]))
        chosen: dict[str, Any] = {
            "model": file.model,
            "name": self._name(file, place, others),
            "noise": noise_figures(file.noise, self.units, f"{place}: noise"),
            "stated_noise": self.stated,
        }
        if file.configurations is not None:
            chosen["configurations"] = self.configurations(file.configurations, f"{place}: configurations")
        for key in keys:
            if key not in _OF_ALL:
                chosen |= self._value(file, key, f"{place}: {key}")
        try:
            return kind(**chosen)
        except InputError as error:
            at = error.place.replace(f"instruments: {chosen['name']}", place)
            raise InputError(at, error.found, error.expected, error.hint) from error

    def _name(self, file: _Entry, place: str, others: Mapping[str, Instrument]) -> str:
        name = file.name
        if name is None:
            number = 1 + sum(re.fullmatch(rf"{file.model}(_\d+)?", other) is not None for other in others)
            name = file.model if number == 1 else f"{file.model}_{number}"
        if not re.fullmatch(r"[A-Za-z0-9][\w-]{0,63}", name, re.ASCII):
            raise InputError(f"{place}: name", f"found {shown(name)}", "letters, digits, - and _: a file has it")
        taken = {f"{other}{end}".lower() for other in others for end in ("", "_pairs")}
        if {name.lower(), f"{name}_pairs".lower()} & taken:
            raise InputError(f"{place}: name", f"{name} is there already", "another one")
        return name

    def _value(self, file: _Entry, key: str, place: str) -> dict[str, Any]:
        """What a key says, by the names of the instrument's fields."""
        given, length = getattr(file, key), self.units.factor("m")
        found: Any = given
        match key:
            case "targets" | "anchors" | "sockets":
                found = self._several(given, place, self._spot)
            case "planes":
                found = self._several(given, place, self._plane)
            case "offset":
                found = given * length
            case "boards":
                given = self._names(given, place)
                found = {name: placement(frame, self.units, f"{place}: {name}") for name, frame in given.items()}
            case "pairing" | "pairs":
                found = pairing_of(given, place)
            case "camera":
                camera, fixed = camera_in(given, place, self.folder)
                return {"camera": camera, "fixed": fixed}
            case "corners":
                corners = validate(_Corners, given, place)
                found = Corners(corners.columns, corners.rows, corners.square * length)
            case "frame":
                found = self.frame(given, place)
                if file.model == "pixels" and not isinstance(found, Placement):
                    raise InputError(place, f"found {shown(given)}", "a mapping of x, y, z, roll, pitch, yaw")
        return {key: found}

    def _several(self, given: object, place: str, one: Callable[[Any, str], Any]) -> Any:
        """Things by name, or how many."""
        if not isinstance(given, Mapping):
            return validate(_Count, {"count": given}, place).count
        return {name: one(value, f"{place}: {name}") for name, value in self._names(given, place).items()}

    def _names(self, given: Mapping[str, Any], place: str) -> Mapping[str, Any]:
        """Things whose names can stand in a table."""
        for name in given:
            if not name or name != name.strip() or not name.isprintable():
                raise InputError(place, f"found name {shown(name)}", "a word")
        return given

    def _spot(self, given: object, place: str) -> Spot:
        file, length = validate(_Spot, given, place), self.units.factor("m")
        tolerance = None if file.tolerance is None else self.units.sigma(file.tolerance, "m", f"{place}: tolerance")
        return Spot(np.array([file.x, file.y, file.z]) * length, tolerance)

    def _plane(self, given: object, place: str) -> Plane:
        file = validate(_Plane, given, place)
        if not any(file.normal):
            raise InputError(f"{place}: normal", "found 0, 0, 0", "a direction")
        return Plane(np.array(file.normal), file.distance * self.units.factor("m"))


def _kind_of(file: _Entry) -> type[Instrument]:
    """The kind of instrument that measures what a model needs."""
    if file.model in POSE_MODELS:
        return Tracker
    if file.model in PAIR_MODELS:
        return Sockets if file.sockets is not None else PairGauge if file.pairs is not None else Tracker
    kinds: dict[str, type[Instrument]] = {"anchor": LengthGauge, "plane": Indicator}
    return kinds.get(file.model, BoardCamera)
