from .build import Dataset, build_dataset, find_copies, predict_measurements, start_frames, warn_of_copies
from .dataset import Groups, Labels, Measurements, Noise, Pairs, are_same, form_pairs, no_pairs, pairs_from_arrays
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
from .table import UNKNOWN, CustomMeasurements, KnownPoint, MeasurementBlock, Table, by_station
from .validation import (
    ANGLE_SLACK,
    LIMIT_SLACK,
    check_readings,
    checked_joint_sigma,
    covariances,
    limit_hint,
    outside_limits,
)

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
    "angle_moments",
    "are_same",
    "build_dataset",
    "by_station",
    "check_readings",
    "check_rows",
    "checked_joint_sigma",
    "covariances",
    "directions",
    "find_copies",
    "form_pairs",
    "is_ours",
    "length_moments",
    "limit_hint",
    "missing_values",
    "no_pairs",
    "outside_limits",
    "pack",
    "pairs_from_arrays",
    "predict_measurements",
    "squares_along",
    "stack",
    "start_frames",
    "unit_whitening",
    "unpack",
    "usable_pairs",
    "warn_of_copies",
]
