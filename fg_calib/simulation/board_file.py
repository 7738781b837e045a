"""Views of a board, and frames, as scenarios state them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from fg_calib.errors import InputError
from fg_calib.io.robot_file import FrameValues
from fg_calib.io.units import Units
from fg_calib.io.yaml import Count, NotNegative, Number, Positive, Schema, shown, validate
from fg_calib.measurements.limits import LIMIT_SLACK
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import BoardViews, Placement
from fg_calib.sizes import MOST_DRAWN


class Board(Schema):
    """The key `board` of configurations."""

    pose: FrameValues
    height: Positive | None = None
    count: Annotated[Count, Field(le=MOST_DRAWN)]
    radius: Positive | None = None
    distance: Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = None
    cone: Positive | None = None
    roll: Any = "random"  # or an `_Angle`
    self_motion: Literal["random", "held"] = "random"
    posture: list[Number] | None = None
    field_of_view: NotNegative | None = None
    board_size: Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = None


class _Angle(Schema):
    roll: Number


def read_board(file: Board, robot: Robot, units: Units, place: str) -> BoardViews:
    """Views of a board.

    Args:
        file: As the file states them.
        robot: Whose posture they may start from.
        units: Of the file.
        place: File and key, for messages.

    Raises:
        InputError: Keys that exclude each other, or a figure that cannot be.
    """
    _check_keys(file, place)
    length = units.factor("m")
    given: dict[str, Any] = {}
    if file.height is not None:
        given["height"] = file.height * length
    if file.radius is not None:
        given["radius"] = file.radius * length
    if file.distance is not None:
        nearest, farthest = file.distance
        if nearest > farthest:
            raise InputError(f"{place}: distance", f"found {shown(file.distance)}", "the smaller one first")
        given["distance"] = (nearest * length, farthest * length)
    if file.cone is not None:
        given["cone"] = _cone(file.cone, units, place)
    if file.field_of_view is not None:
        given["field_of_view"] = _half_angle(file.field_of_view, units, f"{place}: field_of_view")
    if file.board_size is not None:
        given["board_size"] = tuple(figure * length for figure in file.board_size)
    if file.roll != "random":
        given["roll"] = _roll(file.roll, units, place)
    if file.posture is not None:
        given["posture"] = _posture(file.posture, robot, units, f"{place}: posture")
    return BoardViews(placement(file.pose, units, f"{place}: pose"), file.count, self_motion=file.self_motion, **given)


def _check_keys(file: Board, place: str) -> None:
    """Raise for the first key that has no meaning beside the others."""
    for key, idle, needs in (
        ("radius", file.radius is not None and file.distance is not None, "none beside distance"),
        ("cone", file.cone is not None and file.distance is None, "none without distance"),
        ("board_size", file.board_size is not None and not file.field_of_view, "none without field_of_view"),
        ("posture", file.posture is not None and file.self_motion != "held", "none unless self_motion is held"),
    ):
        if idle:
            raise InputError(f"{place}: {key}", f"found {shown(getattr(file, key))}", needs)


def _cone(cone: float, units: Units, place: str) -> float:
    angle = cone * units.factor("rad")
    if angle > 0.5 * math.pi + 1e-9:
        raise InputError(f"{place}: cone", f"found {shown(cone)}", "at most a quarter turn")
    return min(angle, 0.5 * math.pi)


def _half_angle(given: float, units: Units, place: str) -> float:
    angle = given * units.factor("rad")
    if angle >= 0.5 * math.pi:
        raise InputError(place, f"found {shown(given)}", "less than a quarter turn: it is half of what is seen")
    return angle


def _roll(roll: Any, units: Units, place: str) -> float:
    if isinstance(roll, str):
        raise InputError(f"{place}: roll", f"found {shown(roll)}", "random, or an angle")
    return validate(_Angle, {"roll": roll}, place).roll * units.factor("rad")


def _posture(given: list[float], robot: Robot, units: Units, place: str) -> tuple[float, ...]:
    joints = robot.joints
    if len(given) != len(joints):
        raise InputError(place, f"{len(given)} figures", f"{len(joints)}, one a joint")
    for i, (figure, joint) in enumerate(zip(given, joints, strict=True)):
        low, high = (limit / units.factor(joint.unit) for limit in (joint.lower, joint.upper))
        if not low - LIMIT_SLACK <= figure <= high + LIMIT_SLACK:
            raise InputError(f"{place} {i + 1}", f"found {shown(figure)}", f"within [{low:.6g}, {high:.6g}]")
    return tuple(f * units.factor(j.unit) for f, j in zip(given, joints, strict=True))


def placement(values: FrameValues, units: Units, place: str) -> Placement:
    """A frame in SI.

    Raises:
        InputError: An angle in rad is one in deg.
    """
    from scipy.spatial.transform import Rotation

    si = values.si(units, place)
    turn = Rotation.from_euler("xyz", [si["roll"], si["pitch"], si["yaw"]])  # about fixed axes: Rz(yaw) Ry Rx
    return Placement(turn.as_matrix(), np.array([si["x"], si["y"], si["z"]]))
