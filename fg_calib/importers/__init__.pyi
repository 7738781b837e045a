from .bag import read_bag
from .board import image_files, read_calibration_board, read_corners
from .board_tables import BoardTables, read_readings, require_no_input_of_board, write_board_tables
from .draft import draft_job
from .opencv import load_opencv
from .recording import JointStream, PoseStream, period
from .standstill import TABLE_BEGINNING, Stops, average_stops, write_stops
from .views import INTRINSICS, fit_board

__all__ = [
    "INTRINSICS",
    "TABLE_BEGINNING",
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
    "require_no_input_of_board",
    "write_board_tables",
    "write_stops",
]
