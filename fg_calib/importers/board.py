"""Calibration boards: their files, their corners, and the images that show them.

type: charuco            # or checkerboard
columns: 9               # squares in a row; of a checkerboard the inner corners in a row
rows: 7
square: 20
marker: 14               # charuco alone, as are dictionary and legacy
dictionary: DICT_5X5_100
units: {length: mm}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StrictBool

from fg_calib.importers.opencv import (
    CalibrationBoard,
    charuco_board,
    decode,
    dictionaries,
    find_corners,
)
from fg_calib.importers.views import Corners
from fg_calib.inputs import Floats, InputError, check
from fg_calib.io import Count, Positive, Schema, Units, UnitsOfFile, read_bytes, read_yaml, shown, validate
from fg_calib.parallel import tell

MAX_COUNT = 1000
"""Columns or rows."""

MAX_SQUARE_M = 2.0
"""Side of a square, [m]: larger ones are in another unit."""

_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp", ".jp2")


# --- the file of a board ----------------------------------------------------------------------------------------------


class _Board(Schema):
    type: Literal["checkerboard", "charuco"]
    columns: Annotated[Count, Field(ge=3, le=MAX_COUNT)]
    rows: Annotated[Count, Field(ge=3, le=MAX_COUNT)]
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
    scaled = {key: (getattr(file, key) or 0.0) * file.units.factor("m") for key in ("square", "marker")}
    board = CalibrationBoard(**file.model_dump(exclude={"units"}) | scaled)
    if board.square > MAX_SQUARE_M:
        found = f"found {shown(file.square)} {file.units.length}"
        raise InputError(f"{place}: square", found, f"at most {MAX_SQUARE_M:g} m", "is it in mm? units: {length: mm}")
    if file.type == "charuco":
        for key in ("marker", "dictionary"):
            if getattr(file, key) is None:
                raise InputError(place, f"missing key {key!r}")
        if board.marker >= board.square:
            expected = f"a side shorter than a square's, {shown(file.square)}"
            raise InputError(f"{place}: marker", f"found {shown(file.marker)}", expected)
        check(f"{place}: dictionary", board.dictionary, dictionaries())
        charuco_board(board, place)
    elif board.ambiguous and (not file.upright or file.columns == file.rows):
        found = f"{file.columns} x {file.rows} inner corners look the same after half a turn"
        hint = "where the camera never turns more than a quarter about its axis, say upright: true"
        raise InputError(place, found, "columns + rows odd, or a charuco board", hint)
    return board


# --- images -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FoundCorners:
    """Corners of a board in some images.

    Attributes:
        images: Where there are any.
        without: Names of the other images, and why there are none.
        size: Width and height of the images, [px].
    """

    images: tuple[Corners, ...]
    without: Mapping[str, str]
    size: tuple[int, int]


def image_files(given: Sequence[Path]) -> list[Path]:
    """Files of images: those given, those in a folder, and those of a pattern such as `images/*.png`, in order.

    Raises:
        InputError: There are none, or two of one name: an image is known by its name without the ending.
    """
    files: list[Path] = []
    for path in given:
        found = [path]
        if path.is_dir():
            found = sorted(f for f in path.iterdir() if f.suffix.lower() in _ENDINGS and not f.name.startswith("."))
        elif not path.exists() and any(c in path.name for c in "*?["):
            found = sorted(f for f in path.parent.glob(path.name) if f.is_file())
        if not found:
            raise InputError(str(path), "no images", f"files that end in {', '.join(_ENDINGS)}")
        files += found
    names: dict[str, Path] = {}
    for file in files:
        if (other := names.setdefault(file.stem, file)) != file:
            raise InputError(str(file), f"a second image called {file.stem!r}", f"one, as {other.name} is called so")
    return list(names.values())


def read_corners(files: Sequence[Path], board: CalibrationBoard) -> FoundCorners:
    """Corners of a board in images.

    Raises:
        InputError: An image cannot be read, they have different sizes, none shows the board, or some a larger one.
    """
    found: list[Corners] = []
    without: dict[str, str] = {}
    size: tuple[int, int] | None = None
    for k, file in enumerate(files):
        tell("looking for corners", k, len(files))
        image = decode(read_bytes(file), file.name)
        width, height = image.shape[::-1]
        size = size or (width, height)
        if size != (width, height):
            expected = f"{size[0]} x {size[1]} px as {files[0].name}"
            raise InputError(file.name, f"an image of {width} x {height} px", expected, "one camera at a time")
        seen = find_corners(image, board)
        if isinstance(seen, str):
            without[file.name] = seen
        else:
            found.append(Corners(file.stem, *seen))
    if size is None or not found:
        reasons = "; ".join(dict.fromkeys(without.values()))
        hint = "are columns, rows and dictionary those of the board? older charuco boards: legacy: true"
        raise InputError("images", f"the board in none of {len(files)} ({reasons})", "at least one", hint)
    return FoundCorners(tuple(_upright(found) if board.upright else found), without, size)


def _upright(found: Sequence[Corners]) -> list[Corners]:
    """All corners in the order in which the rows run as in the first image, within a quarter turn."""
    first = _along(found[0])
    return [one if _along(one) @ first > 0.0 else one._replace(uv=one.uv[::-1].copy()) for one in found]


def _along(one: Corners) -> Floats:
    """From the first half of a board's corners to the second, in the image."""
    half = len(one.uv) // 2
    step: Floats = one.uv[-half:].mean(axis=0) - one.uv[:half].mean(axis=0)
    return step
