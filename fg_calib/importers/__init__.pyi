from .bag import JointStream, PoseStream, Stops, average_stops, period, read_bag, write_stops
from .board import (
    BOARD_FILES,
    INTRINSICS,
    BoardTables,
    fit_board,
    image_files,
    load_opencv,
    read_calibration_board,
    read_corners,
    read_readings,
    write_board_tables,
)
from .draft import draft_job

__all__ = [
    "BOARD_FILES",
    "INTRINSICS",
    "BoardTables",
    "JointStream",
    "PoseStream",
    "Stops",
    "average_stops",
    "draft_job",
    "fit_board",
    "image_files",
    "load_opencv",
    "period",
    "read_bag",
    "read_calibration_board",
    "read_corners",
    "read_readings",
    "write_board_tables",
    "write_stops",
]
