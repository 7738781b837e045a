from .build import Dataset, build_dataset, find_copies, start_frames, warn_of_copies
from .checks import ANGLE_SLACK, check_readings, covariances
from .dataset import Groups, Labels, Measurements, Noise, Pairs, form_pairs, no_pairs, pairs_from_arrays
from .kind import Frames, Kind
from .kinds import GENERIC_COLUMNS, INSTRUMENTS, LANDMARKS, Camera
from .kinds.board import COVARIANCE
from .kinds.pair import Distance, RotationAngle, missing_values, usable_pairs
from .kinds.pixel import RoomPixel
from .kinds.pose import TARGET
from .landmarks import Landmarks
from .limits import LIMIT_SLACK, limit_hint, outside_limits
from .moments import Moments, angle_moments, length_moments
from .predictions import predict_measurements
from .residuals import Block, pack, squares_along, unit_whitening, unpack
from .table import CustomMeasurements, KnownPoint, MeasurementBlock, Table, by_station

__all__ = [
    "ANGLE_SLACK",
    "COVARIANCE",
    "GENERIC_COLUMNS",
    "INSTRUMENTS",
    "LANDMARKS",
    "LIMIT_SLACK",
    "TARGET",
    "Block",
    "Camera",
    "CustomMeasurements",
    "Dataset",
    "Distance",
    "Frames",
    "Groups",
    "Kind",
    "KnownPoint",
    "Labels",
    "Landmarks",
    "MeasurementBlock",
    "Measurements",
    "Moments",
    "Noise",
    "Pairs",
    "RoomPixel",
    "RotationAngle",
    "Table",
    "angle_moments",
    "build_dataset",
    "by_station",
    "check_readings",
    "covariances",
    "find_copies",
    "form_pairs",
    "length_moments",
    "limit_hint",
    "missing_values",
    "no_pairs",
    "outside_limits",
    "pack",
    "pairs_from_arrays",
    "predict_measurements",
    "squares_along",
    "start_frames",
    "unit_whitening",
    "unpack",
    "usable_pairs",
    "warn_of_copies",
]
