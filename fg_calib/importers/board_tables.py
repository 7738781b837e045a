"""Tables of what a camera saw of a calibration board: `pixels.csv`, `board.csv`, and the camera's file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fg_calib import __version__
from fg_calib.importers.views import BoardFit, View
from fg_calib.inputs import InputError
from fg_calib.io import KNOWN, Table, Units, fill_folder, require_own, write_csv, write_text
from fg_calib.measurements import COVARIANCE

BOARD_FILES = {
    "board.json": b'{\n "schema": "fg-calib/board/',
    "board.csv": b"id,",
    "pixels.csv": b"id,",
    "camera.yaml": b"",
}
"""What is written and how it begins."""


Readings = Mapping[str, Mapping[str, str]]
"""By the name of an image, the cells of its row by column: joint readings, and `split`, as they are written."""


def read_readings(path: Path) -> Readings:
    """Joint readings from a table of configurations whose `id` is the name of an image without its ending.

    Columns that are measurements, such as `x`, are left out; all others are taken as they are.

    Raises:
        InputError: The table cannot be used.
    """
    table = Table.read(path, "configurations")
    columns = {name.lower() if name.lower() in KNOWN else name: name for name in table.columns}
    if "id" not in columns:
        raise InputError(table.name, "no column id", "the name of each row's image without its ending")
    kept = [name for name in columns if name not in KNOWN]
    if not kept:
        raise InputError(table.name, "no columns of joint readings", "q1, q2 and so on, or the joints' names")
    ids = table.texts(columns["id"], "the name of an image without its ending")
    table.require(ids.is_first_distinct().to_numpy(), columns["id"], "one row an image")
    comma = r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$" if table.separator != "," else r"$^"  # of decimals: we write points
    kept += ["split"] if "split" in columns else []
    cells = (table.texts(columns[name]).fill_null("").str.replace(comma, "$1.$2") for name in kept)
    return {name: dict(zip(kept, row, strict=True)) for name, *row in zip(ids, *cells, strict=True)}


@dataclass(frozen=True)
class BoardTables:
    """What is written of images of a board.

    Attributes:
        fit: Poses and camera.
        without: Names of images without a board, and why.
        readings: Joint readings of the images, where there are some.
        units: Of the tables that are written, and of the readings.
        camera_file: The bytes of the camera's file; None if it was estimated.
    """

    fit: BoardFit
    without: Mapping[str, str]
    readings: Readings | None
    units: Units
    camera_file: bytes | None

    def __post_init__(self) -> None:
        if not self.used:
            rows, images = (", ".join(names[:3]) for names in (self.without_image, self.without_row))
            raise InputError("configurations", f"no id is the name of an image: {rows}", f"ids such as {images}")

    @property
    def used(self) -> tuple[View, ...]:
        """Images that stand in the tables: those with a row of readings, where there are readings."""
        return tuple(view for view in self.fit.views if self.readings is None or view.name in self.readings)

    @property
    def posed(self) -> tuple[View, ...]:
        """Those of them whose pose stands in the table of poses: it is not one of two."""
        return tuple(view for view in self.used if not view.ambiguous)

    @property
    def without_row(self) -> tuple[str, ...]:
        """Images with a board that have no row of readings."""
        return tuple(v.name for v in self.fit.views if self.readings is not None and v.name not in self.readings)

    @property
    def without_image(self) -> tuple[str, ...]:
        """Rows of readings that have no image with a board."""
        seen = {view.name for view in self.fit.views}
        return tuple(name for name in self.readings or () if name not in seen)

    def document(self) -> dict[str, Any]:
        """What `board.json` holds: SI, full precision.

        { "schema": "fg-calib/board/1", "version", "board": {keys of its file, in m}, "image_size": [width, height],
          "rms_pixel", "sigma_pixel", "images": [{"id", "n_corners", "rms_pixel", "sigma_pixel", "position",
          "rotation_vector", "covariance", "covariance_by_camera" | null, "ambiguous", "poor"}], "camera": {parameters},
          "camera_sigma": {parameters} | null, "without_board": {file: reason}, "without_pose": [ids],
          "without_readings": [ids], "without_image": [ids], "findings": [text] }

        """
        fit = self.fit
        return {
            "schema": "fg-calib/board/1",
            "version": __version__,
            "board": asdict(fit.board),
            "image_size": list(fit.size),
            "rms_pixel": fit.rms,
            "sigma_pixel": fit.sigma,
            "images": [_image_document(view, fit) for view in fit.views],
            "camera": asdict(fit.camera),
            "camera_sigma": fit.camera_sigma,
            "without_board": dict(self.without),
            "without_pose": list(fit.without_pose),
            "without_readings": list(self.without_row),
            "without_image": list(self.without_image),
            "findings": list(fit.findings),
        }


def _image_document(view: View, fit: BoardFit) -> dict[str, Any]:
    """A board in an image, as in `board.json`."""
    arrays = ("position", "rotation_vector", "covariance")
    return {
        "id": view.name,
        "n_corners": len(view.corners),
        **{f"{key}_pixel": getattr(view, key) for key in ("rms", "sigma")},
        **{key: getattr(view, key).tolist() for key in arrays},
        "covariance_by_camera": None if fit.camera_covariance is None else view.by_camera.tolist(),
        **{key: bool(getattr(view, key)) for key in ("ambiguous", "poor")},
    }


def require_no_input_of_board(folder: Path, inputs: Sequence[Path]) -> None:
    """Check that tables written to a folder would not replace what they are made of, nor a file that no board wrote.

    Raises:
        InputError: They would.
    """
    given = {path.resolve() for path in inputs}
    for name in BOARD_FILES:
        if (folder / name).resolve() in given:
            raise InputError(str(folder / name), "would be replaced by what is made of it", "another folder")
    require_own(folder, BOARD_FILES)


def write_board_tables(folder: Path, tables: BoardTables) -> tuple[str, ...]:
    """Write `pixels.csv`, `board.csv`, `camera.yaml` and `board.json`, all of them or none.

    Without an image that has one pose alone there is no `board.csv`.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds files of these names that are not of a board.
    """
    names: list[str] = []

    def write(into: Path) -> None:
        write_text(into / "board.json", json.dumps(tables.document(), indent=1, allow_nan=False) + "\n")
        write_csv(into / "pixels.csv", _pixel_columns(tables))
        if tables.posed:
            write_csv(into / "board.csv", _pose_columns(tables))
        if tables.camera_file is not None:
            (into / "camera.yaml").write_bytes(tables.camera_file)
        else:
            write_text(into / "camera.yaml", _camera_text(tables.fit))
        names.extend(sorted(file.name for file in into.iterdir()))

    fill_folder(folder, write, BOARD_FILES)
    return tuple(names)


def _row_columns(tables: BoardTables, views: Sequence[View], each: Sequence[int]) -> dict[str, Any]:
    """What rows begin with: id, readings, the board's name; those of an image stand as often as `each` says."""
    cells = [dict((tables.readings or {}).get(view.name, {})) for view in views]
    if name := tables.fit.board.name:
        cells = [of | {"board": name} for of in cells]
    rows = [{"id": view.name} | of for view, of in zip(views, cells, strict=True)]
    return {key: np.repeat([row[key] for row in rows], each) for key in rows[0]}


def _pixel_columns(tables: BoardTables) -> dict[str, Any]:
    views, length = tables.used, tables.units.factor("m")
    each = [len(view.corners) for view in views]
    uv = np.concatenate([view.uv for view in views])
    corner = np.concatenate([tables.fit.board.corners[view.corners] for view in views]) / length
    columns = _row_columns(tables, views, each)
    columns |= {"u": uv[:, 0], "v": uv[:, 1], "corner_x": corner[:, 0], "corner_y": corner[:, 1]}
    return columns | {"sigma_pixel": np.repeat([view.sigma for view in views], each)}


def _pose_columns(tables: BoardTables) -> dict[str, Any]:
    views, length, angle = tables.posed, tables.units.factor("m"), tables.units.factor("rad")
    columns = _row_columns(tables, views, [1] * len(views))
    columns |= dict(zip("xyz", np.array([view.position for view in views]).T / length, strict=True))
    turns = np.array([view.rotation_vector for view in views]) / angle
    columns |= dict(zip(("rx", "ry", "rz"), turns.T, strict=True))
    size = np.repeat([angle, length], 3)
    upper = (np.array([view.covariance for view in views]) / np.outer(size, size))[:, *np.triu_indices(6)]
    return columns | dict(zip(COVARIANCE, upper.T, strict=True))


def _camera_text(fit: BoardFit) -> str:
    """The file of a camera that was estimated."""
    values = asdict(fit.camera) | {"width": fit.size[0], "height": fit.size[1], "sigma": fit.camera_sigma}
    words = f"# fg-calib board: estimated from {len(fit.views)} images, in px; sigma: 1 sigma of each value\n"
    return words + yaml.safe_dump(values, sort_keys=False)
