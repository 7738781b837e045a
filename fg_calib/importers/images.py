"""Images of a calibration board: which files they are, and the corners in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fg_calib.arrays import NOTHING
from fg_calib.errors import InputError
from fg_calib.executors import tell
from fg_calib.importers.board import CalibrationBoard
from fg_calib.importers.opencv import LARGER, decode, find_corners
from fg_calib.importers.views import Corners
from fg_calib.io.atomic import read_bytes
from fg_calib.measurements.dataset import Floats

_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp", ".jp2")

_ENOUGH = 3
"""Images that show the same larger board: it is another one than the file says, and parts of it may look like that."""


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
        if path.is_dir():
            found = sorted(f for f in path.iterdir() if f.suffix.lower() in _ENDINGS and not f.name.startswith("."))
        elif not path.exists() and any(c in path.name for c in "*?["):
            found = sorted(f for f in path.parent.glob(path.name) if f.is_file())
        else:
            found = [path]
        if not found:
            raise InputError(str(path), "no images", f"files that end in {', '.join(_ENDINGS)}")
        files += found
    names: dict[str, Path] = {}
    for file in files:
        name = _name(file)
        if names.setdefault(name, file) != file:
            raise InputError(str(file), f"a second image called {name!r}", f"one, as {names[name].name} is called so")
        if name.lower() in NOTHING or not name.isprintable():
            raise InputError(str(file), f"an image called {name!r}", "a name that a table can have under id")
    return list(dict.fromkeys(files))


def _name(file: Path) -> str:
    return file.stem.strip()


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
        height, width = image.shape
        if size is None:
            size = (width, height)
        if size != (width, height):
            expected = f"{size[0]} x {size[1]} px as {files[0].name}"
            raise InputError(file.name, f"an image of {width} x {height} px", expected, "one camera at a time")
        seen = find_corners(image, board)
        if isinstance(seen, str):
            without[file.name] = seen
            _check_larger(seen, without, board)
        else:
            found.append(Corners(_name(file), *seen))
    if size is None or not found:
        reasons = "; ".join(dict.fromkeys(without.values()))
        hint = "are columns, rows and dictionary those of the board? older charuco boards: legacy: true"
        raise InputError("images", f"the board in none of {len(files)} ({reasons})", "at least one", hint)
    return FoundCorners(tuple(_upright(found) if board.upright else found), without, size)


def _check_larger(reason: str, without: Mapping[str, str], board: CalibrationBoard) -> None:
    """Whether the images show a larger checkerboard, of which a part would now and then be taken for the board."""
    alike = [name for name, other in without.items() if other == reason]
    if reason.startswith(LARGER) and len(alike) >= _ENOUGH:
        expected = f"{board.columns} x {board.rows} as the board's file says"
        raise InputError(", ".join(alike), reason, expected, "columns and rows count inner corners")


def _upright(found: Sequence[Corners]) -> list[Corners]:
    """All corners in the order in which the rows run as in the first image, within a quarter turn."""
    first = _along(found[0])
    return [one if _along(one) @ first > 0.0 else one._replace(uv=one.uv[::-1].copy()) for one in found]


def _along(one: Corners) -> Floats:
    """From the first half of a board's corners to the second, in the image."""
    half = len(one.uv) // 2
    step: Floats = one.uv[-half:].mean(axis=0) - one.uv[:half].mean(axis=0)
    return step
