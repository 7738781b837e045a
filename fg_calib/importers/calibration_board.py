"""Calibration boards, as files state them.

type: charuco            # or checkerboard
columns: 9               # squares in a row; of a checkerboard the inner corners in a row
rows: 7
square: 20
marker: 14               # charuco alone, as are dictionary and legacy
dictionary: DICT_5X5_100
units: {length: mm}
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StrictBool

from fg_calib.errors import InputError
from fg_calib.importers.board import CalibrationBoard
from fg_calib.importers.opencv import charuco_board, dictionaries
from fg_calib.io.units import Units, UnitsOfFile
from fg_calib.io.yaml import Count, Positive, Schema, read_yaml, shown, validate
from fg_calib.options import did_you_mean

_MOST = 1000
"""Columns or rows."""
_LARGEST = 2.0
"""Side of a square, [m]: larger ones are in another unit."""


class _Board(Schema):
    type: Literal["checkerboard", "charuco"]
    columns: Annotated[Count, Field(ge=3, le=_MOST)]
    rows: Annotated[Count, Field(ge=3, le=_MOST)]
    square: Positive
    marker: Positive | None = None
    dictionary: str | None = None
    legacy: StrictBool = False
    upright: StrictBool = False
    name: str = ""
    units: UnitsOfFile = Units()


def read_calibration_board(path: Path) -> CalibrationBoard:
    """A calibration board.

    Raises:
        InputError: The file is missing or cannot be used, or the board looks the same after half a turn and the file
            does not say `upright: true`.
    """
    place = path.name
    file = validate(_Board, read_yaml(path), place)
    length = file.units.factor("m")
    if file.square * length > _LARGEST:
        found = f"found {shown(file.square)} {file.units.length}"
        raise InputError(f"{place}: square", found, f"at most {_LARGEST:g} m", "is it in mm? units: {length: mm}")
    return (_checkerboard if file.type == "checkerboard" else _charuco)(file, length, place)


def _checkerboard(file: _Board, length: float, place: str) -> CalibrationBoard:
    for key in ("marker", "dictionary", "legacy"):
        if getattr(file, key):
            raise InputError(f"{place}: {key}", f"found {shown(getattr(file, key))}", "none with a checkerboard")
    upright = file.upright
    board = CalibrationBoard(
        "checkerboard", file.columns, file.rows, file.square * length, upright=upright, name=file.name
    )
    if not board.ambiguous and upright:
        expected = f"none with {file.columns} x {file.rows} inner corners, whose ends differ"
        raise InputError(f"{place}: upright", "found true", expected)
    if file.columns == file.rows:
        found = f"{file.columns} x {file.rows} inner corners look the same from several sides"
        raise InputError(place, found, "columns + rows odd, or a charuco board")
    if board.ambiguous and not file.upright:
        found = f"{file.columns} x {file.rows} inner corners look the same after half a turn"
        hint = "where the camera never turns more than a quarter about its axis, say upright: true"
        raise InputError(place, found, "columns + rows odd, or a charuco board", hint)
    return board


def _charuco(file: _Board, length: float, place: str) -> CalibrationBoard:
    if file.upright:
        raise InputError(f"{place}: upright", "found true", "none with a charuco board")
    if file.marker is None or file.dictionary is None:
        raise InputError(place, f"missing key {'marker' if file.marker is None else 'dictionary'!r}")
    if file.marker >= file.square:
        found = f"found {shown(file.marker)}"
        raise InputError(f"{place}: marker", found, f"a side shorter than a square's, {shown(file.square)}")
    known = dictionaries()
    if file.dictionary not in known:
        found, hint = f"found {shown(file.dictionary)}", did_you_mean(file.dictionary, known)
        raise InputError(f"{place}: dictionary", found, "one of OpenCV's, such as DICT_5X5_100", hint)
    board = CalibrationBoard(
        *("charuco", file.columns, file.rows, file.square * length, file.marker * length, file.dictionary),
        legacy=file.legacy,
        name=file.name,
    )
    charuco_board(board, place)
    return board
