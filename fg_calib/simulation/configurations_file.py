"""Configurations as scenarios state them: where a robot is sent, and what it has to keep to there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from fg_calib.errors import InputError
from fg_calib.io.tables import read_measurements
from fg_calib.io.units import Units
from fg_calib.io.yaml import Count, FilePath, NotNegative, Number, Positive, Schema, shown
from fg_calib.options import known_names
from fg_calib.robot.model import Robot
from fg_calib.robot.shape import Box
from fg_calib.simulation.board_file import Board, read_board
from fg_calib.simulation.configurations import Configurations, GivenReadings, RandomReadings, TargetViews
from fg_calib.sizes import MOST_DRAWN

KINDS = ("board", "tracker", "random", "table")
"""The keys one of which says where the configurations come from."""


class _Random(Schema):
    count: Annotated[Count, Field(gt=0, le=MOST_DRAWN)]


class _Place(Schema):
    x: Number = 0.0
    y: Number = 0.0
    z: Number = 0.0


class _Box(Schema):
    lower: tuple[Number, Number, Number]
    upper: tuple[Number, Number, Number]


class _Tracker(Schema):
    station: _Place
    target: _Place = _Place()
    axis: tuple[Number, Number, Number] = (0.0, 0.0, 1.0)
    acceptance: Positive | None = None
    distance: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None = None
    region: _Box | None = None
    count: Annotated[Count, Field(gt=0, le=MOST_DRAWN)]


class ConfigurationsFile(Schema):
    """The key `configurations`: one of `KINDS`, and conditions."""

    board: Board | None = None
    tracker: _Tracker | None = None
    random: _Random | None = None
    table: FilePath | None = None
    keep_out: tuple[_Box, ...] = ()
    apart: Positive | None = None


def read_configurations(
    file: ConfigurationsFile, robot: Robot, units: Units, folder: Path, place: str
) -> Configurations:
    """Configurations.

    Args:
        file: As the file states them.
        robot: Whose they are.
        units: Of the file.
        folder: Where paths in it start.
        place: File and key, for messages.

    Raises:
        InputError: None or several kinds, keys that exclude each other, or a figure that cannot be.
    """
    found = _of_a_kind(file, robot, units, folder, place)
    keep_out = tuple(_box(box, units, f"{place}: keep_out {i}") for i, box in enumerate(file.keep_out, start=1))
    return replace(found, keep_out=keep_out, apart=None if file.apart is None else file.apart * units.factor("rad"))


def _of_a_kind(file: ConfigurationsFile, robot: Robot, units: Units, folder: Path, place: str) -> Configurations:
    only_one(file, KINDS, place)
    if file.board is not None:
        return read_board(file.board, robot, units, f"{place}: board")
    if file.tracker is not None:
        return _tracker(file.tracker, units, f"{place}: tracker")
    drawn = file.random
    if drawn is not None:
        return RandomReadings(drawn.count)
    return GivenReadings(read_measurements(folder / str(file.table), robot, units=units).readings)


def only_one(file: Schema, keys: Sequence[str], place: str) -> str:
    """The only one of some keys that is given.

    Raises:
        InputError: None or several are.
    """
    given = [key for key in keys if getattr(file, key) is not None]
    if len(given) != 1:
        raise InputError(place, f"found {' and '.join(given) or 'none'}", known_names(keys))
    return given[0]


def _tracker(file: _Tracker, units: Units, place: str) -> TargetViews:
    length, chosen = units.factor("m"), dict[str, Any]()
    if file.acceptance is not None:
        chosen["acceptance"] = file.acceptance * units.factor("rad")
        if chosen["acceptance"] > math.pi:
            raise InputError(f"{place}: acceptance", f"found {shown(file.acceptance)}", "at most half a turn")
    if file.distance is not None:
        nearest, farthest = file.distance
        if nearest > farthest:
            raise InputError(f"{place}: distance", f"found {shown(file.distance)}", "the smaller one first")
        chosen["distance"] = (nearest * length, farthest * length)
    if file.region is not None:
        chosen["region"] = _box(file.region, units, f"{place}: region")
    if not any(file.axis):
        raise InputError(f"{place}: axis", "found 0, 0, 0", "a direction")
    return TargetViews(
        station=_point(file.station, length),
        target=_point(file.target, length),
        count=file.count,
        axis=np.array(file.axis),
        **chosen,
    )


def _point(file: _Place, length: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([file.x, file.y, file.z]) * length


def _box(file: _Box, units: Units, place: str) -> Box:
    lower, upper = list(file.lower), list(file.upper)
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise InputError(f"{place}: upper", f"found {shown(upper)}", f"more than lower, {shown(lower)}, in x, y and z")
    return Box(np.array(lower) * units.factor("m"), np.array(upper) * units.factor("m"))
