"""Kinds of measurement, one small class a file: its few lines of numpy are the documentation of its mathematics."""

from fg_calib.measurements.kinds.distance import Distance
from fg_calib.measurements.kinds.kind import Frames, Kind, Rows, check_derivatives, checked_rows
from fg_calib.measurements.kinds.orientation import Orientation
from fg_calib.measurements.kinds.point_distance import PointDistance
from fg_calib.measurements.kinds.position import Position
from fg_calib.measurements.kinds.rotation_angle import RotationAngle
from fg_calib.measurements.kinds.same_point import SamePoint
from fg_calib.measurements.kinds.stacked import Stacked, stack
from fg_calib.measurements.kinds.touched_point import TouchedPoint

__all__ = [
    "Distance",
    "Frames",
    "Kind",
    "Orientation",
    "PointDistance",
    "Position",
    "RotationAngle",
    "Rows",
    "SamePoint",
    "Stacked",
    "TouchedPoint",
    "check_derivatives",
    "checked_rows",
    "stack",
]
