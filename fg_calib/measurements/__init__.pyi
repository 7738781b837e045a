from .build import Dataset, build_dataset, check_copies, find_copies, predict_measurements, start_frames
from .dataset import (
    ANGLE_SLACK,
    LIMIT_SLACK,
    Groups,
    Labels,
    Measurements,
    Noise,
    Pairs,
    check_limits,
    check_readings,
    form_pairs,
    no_pairs,
    outside_limits,
)
from .kind import Coincidence, Frames, Kind, Length, Rows, check_rows, directions, is_ours, stack
from .kinds import GENERIC_COLUMNS, INSTRUMENTS, LANDMARKS
from .kinds.board import COVARIANCE
from .kinds.instrument import Column, Instrument
from .kinds.pair import Distance, RotationAngle, missing_values, usable_pairs
from .kinds.pixel import RoomPixel
from .kinds.pose import TARGET
from .landmarks import Estimate, Landmark, LandmarkKind, Landmarks
from .moments import Moments, angle_moments, length_moments
from .residuals import Block, pack, squares_along, unit_whitening, unpack
from .table import UNKNOWN, CustomMeasurements, KnownPoint, MeasurementBlock, Table, Tables, by_station

__all__ = [
    "ANGLE_SLACK",
    "COVARIANCE",
    "GENERIC_COLUMNS",
    "INSTRUMENTS",
    "LANDMARKS",
    "LIMIT_SLACK",
    "TARGET",
    "UNKNOWN",
    "Block",
    "Coincidence",
    "Column",
    "CustomMeasurements",
    "Dataset",
    "Distance",
    "Estimate",
    "Frames",
    "Groups",
    "Instrument",
    "Kind",
    "KnownPoint",
    "Labels",
    "Landmark",
    "LandmarkKind",
    "Landmarks",
    "Length",
    "MeasurementBlock",
    "Measurements",
    "Moments",
    "Noise",
    "Pairs",
    "RoomPixel",
    "RotationAngle",
    "Rows",
    "Table",
    "Tables",
    "angle_moments",
    "build_dataset",
    "by_station",
    "check_copies",
    "check_limits",
    "check_readings",
    "check_rows",
    "directions",
    "find_copies",
    "form_pairs",
    "is_ours",
    "length_moments",
    "missing_values",
    "no_pairs",
    "outside_limits",
    "pack",
    "predict_measurements",
    "squares_along",
    "stack",
    "start_frames",
    "unit_whitening",
    "unpack",
    "usable_pairs",
]
