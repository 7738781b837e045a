"""Models: which kinds of measurement a table's columns make, and what these depend on besides the arm."""

from __future__ import annotations

from collections.abc import Callable

from fg_calib.measurements.models.anchors import anchor_series
from fg_calib.measurements.models.boards import board_series, pixel_series
from fg_calib.measurements.models.own import own_series
from fg_calib.measurements.models.pairs import pair_series
from fg_calib.measurements.models.planes import plane_series
from fg_calib.measurements.models.poses import pose_series
from fg_calib.measurements.models.touches import touch_series
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.options import Model
from fg_calib.robot.model import Robot

SERIES_OF: dict[Model, Callable[[Robot, Table, int, Unknowns], list[Series]]] = {
    "pose": pose_series,
    "position": pose_series,
    "orientation": pose_series,
    "distance": pair_series,
    "rotation": pair_series,
    "distance-rotation": pair_series,
    "anchor": anchor_series,
    "plane": plane_series,
    "board": board_series,
    "pixels": pixel_series,
}
"""What makes the series of a table of each model: from the nominal robot, the table, its number and the unknowns."""

__all__ = ["SERIES_OF", "own_series", "touch_series"]
