"""Kinds of measurement, one small class a file: its few lines of numpy are the documentation of its mathematics."""

from fg_calib.measurements.kinds.anchor_contact import AnchorContact
from fg_calib.measurements.kinds.anchor_distance import AnchorDistance
from fg_calib.measurements.kinds.board_pose import BoardPose
from fg_calib.measurements.kinds.distance import Distance
from fg_calib.measurements.kinds.kind import (
    Frames,
    Kind,
    Rows,
    check_derivatives,
    check_kind,
    check_start,
    checked_figures,
    checked_rows,
    is_ours,
)
from fg_calib.measurements.kinds.orientation import Orientation
from fg_calib.measurements.kinds.pixel import Camera, Pixel, RoomPixel
from fg_calib.measurements.kinds.plane_distance import PlaneDistance
from fg_calib.measurements.kinds.point_distance import PointDistance
from fg_calib.measurements.kinds.position import Position
from fg_calib.measurements.kinds.rotation_angle import RotationAngle
from fg_calib.measurements.kinds.same_point import SamePoint
from fg_calib.measurements.kinds.stacked import Stacked, parts_of, stack
from fg_calib.measurements.kinds.target_position import TargetPosition
from fg_calib.measurements.kinds.touched_point import TouchedPoint

__all__ = [
    "AnchorContact",
    "AnchorDistance",
    "BoardPose",
    "Camera",
    "Distance",
    "Frames",
    "Kind",
    "Orientation",
    "Pixel",
    "PlaneDistance",
    "PointDistance",
    "Position",
    "RoomPixel",
    "RotationAngle",
    "Rows",
    "SamePoint",
    "Stacked",
    "TargetPosition",
    "TouchedPoint",
    "check_derivatives",
    "check_kind",
    "check_start",
    "checked_figures",
    "checked_rows",
    "is_ours",
    "parts_of",
    "stack",
]
