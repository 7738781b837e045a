"""A calibration board: what stands on it, and where its corners are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fg_calib.measurements.dataset import Floats, Integers


@dataclass(frozen=True)
class CalibrationBoard:
    """A checkerboard, or a ChArUco board, whose white squares hold markers that say which ones they are.

    The board's frame has its origin at the first corner of a checkerboard, between whose first four corners is a
    black square, or at the outer corner of a ChArUco board's first square; x runs along the rows of corners, y from
    row to row, z away from who looks at it.

    Attributes:
        type: Which of the two.
        columns: Of a checkerboard the inner corners in a row, of a ChArUco board the squares in a row, as in OpenCV.
        rows: Inner corners, or squares, in a column.
        square: Side of a square, [m].
        marker: Side of a marker, [m]; 0 for a checkerboard.
        dictionary: The markers' dictionary, such as `DICT_5X5_100`; empty for a checkerboard.
        legacy: Whether the ChArUco board was drawn by an OpenCV before 4.6, which began boards with an even number of
            rows with a white square.
        upright: Whether the camera never turned more than a quarter turn about its axis between images, seen from the
            first one: what tells apart the two ends of a checkerboard that looks the same after half a turn.
        name: What the board is called in a column `board`; without a name there is no such column.
    """

    type: Literal["checkerboard", "charuco"]
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = ""
    legacy: bool = False
    upright: bool = False
    name: str = ""

    @property
    def shape(self) -> tuple[int, int]:
        """Corners in a row, and rows of them."""
        fewer = self.type == "charuco"
        return self.columns - fewer, self.rows - fewer

    @property
    def corners(self) -> Floats:
        """Places of the corners in the board's frame, x and y, row by row, shape (n_corners, 2), [m]."""
        columns, rows = self.shape
        j, i = np.divmod(np.arange(columns * rows), columns)
        first = 1.0 if self.type == "charuco" else 0.0
        return self.square * (np.stack([i, j], axis=1) + first)

    @property
    def ambiguous(self) -> bool:
        """Whether it looks the same after half a turn: a checkerboard whose opposite end squares are of one colour."""
        return self.type == "checkerboard" and (self.columns + self.rows) % 2 == 0

    def span(self, corners: Integers) -> float:
        """Least extent of some of its corners, in squares: RMS distance from the line that they are nearest to."""
        places = self.corners[corners] / self.square
        off = places - places.mean(axis=0)
        return float(np.linalg.svd(off, compute_uv=False)[-1] / np.sqrt(len(places)))
