"""`fg-calib board`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Group

from fg_calib import importers, inputs, io, report
from fg_calib.cli.output import Angle, Json, Length, argument, end, option, say, show_result

_READINGS = "Joint readings; id is an image's name without its ending."


def board(
    images: Annotated[list[Path], argument("IMAGES...", "Images, or a folder of them.")],
    board: Annotated[Path, option("--board", "BOARD", "The board, such as charuco.yaml.")],
    out: Annotated[Path, option("--out", "DIR", "Write board.csv, pixels.csv and camera.yaml there.")],
    camera: Annotated[Path | None, option("--camera", "CAMERA", "The camera, such as camera.yaml.")] = None,
    estimate_camera: Annotated[bool, option("--estimate-camera", None, "Estimate it from the same images.")] = False,
    configurations: Annotated[Path | None, option("--configurations", "TABLE", _READINGS)] = None,
    length: Length = "m",
    angle: Angle = "rad",
    as_json: Json = False,
) -> None:
    """Make tables of images of a board: its corners, and its poses with their covariances."""
    if (camera is None) != estimate_camera:
        raise typer.BadParameter("one of the two is needed", param_hint="--camera and --estimate-camera")
    importers.load_opencv()
    io.require_writable(out)
    target, files = importers.read_calibration_board(board), importers.image_files(images)
    io.require_own(out, importers.BOARD_FILES)
    readings = None if configurations is None else importers.read_readings(configurations)
    if camera is not None:
        io.read_camera(camera)  # before the images, which take their time
    found, without, size = importers.read_corners(files, target)
    given, content = (None, None) if camera is None else (io.read_camera(camera, size), io.read_bytes(camera))
    fit = importers.fit_board(target, found, size, given)
    tables = importers.BoardTables(fit, without, readings, io.Units(length, angle), content)
    names = importers.write_board_tables(out, tables)
    show_result(as_json, tables.document, lambda: _report(tables))
    say(f"wrote {', '.join(names)} to {out}")
    end(tables.fit.findings)


def _report(tables: "importers.BoardTables") -> Group:
    """Corners, images and the camera, then what to know of the tables."""
    import numpy as np

    fit, board = tables.fit, tables.fit.board
    n_images = len(fit.views) + len(fit.without_pose) + len(tables.without)
    size = f"{board.columns} x {board.rows}, square {1e3 * board.square:g} mm"
    seen = f"seen in {len(fit.views)} of {n_images} images, {sum(len(view.corners) for view in fit.views)} corners"
    images, camera = [], []
    for view in fit.views:
        turn, shift = (np.sqrt(np.linalg.eigvalsh(C)[-1]) for C in (view.covariance[:3, :3], view.covariance[3:, 3:]))
        values = view.rms, view.sigma, float(np.linalg.norm(view.position)), shift, turn
        images.append((view.name, len(view.corners), *values, "two poses" if view.ambiguous else ""))
    for name, sigma in (fit.camera_sigma or {}).items():
        unit, decimals = ("px", 3) if name in importers.INTRINSICS[:4] else ("", 6)
        camera.append((name, f"{getattr(fit.camera, name):.{decimals}f}", f"{sigma:.{decimals}f}", unit))
    pose = ("distance mm|m:.1f", "sigma mm|m", "sigma deg|rad")
    return report.report(
        report.line(f"{board.type} {size}: {seen}"),
        *(report.line(f"DOUBTFUL: {finding}", "bold red") for finding in fit.findings),
        report.line(f"RMS of residuals {fit.rms:.3f} px, sigma of a corner {fit.sigma:.3f} px"),
        report.table_of(("Image", "corners|d", "RMS px|.3f", "sigma px|.3f", *pose, ""), images),
        *report.section("Camera (1 sigma)", report.table_of(("", "estimate|>", "sigma|>", ""), camera)),
        *report.section("Notes", *_notes(tables)),
    )


def _notes(tables: "importers.BoardTables") -> Iterator[str]:
    fit, units = tables.fit, tables.units
    for name, reason in tables.without.items():
        yield f"No board in {name}: {reason}."
    two = "Only in pixels.csv, as a second pose, tilted the other way, explains the corners as well:"
    for words, names in (
        ("No pose of the board explains the corners of", fit.without_pose),
        (two, [v.name for v in tables.used if v.ambiguous]),
        ("No row of joint readings, and so not in the tables:", tables.without_row),
        ("Rows of joint readings without an image of the board:", tables.without_image),
    ):
        if names:
            yield f"{words} {inputs.shorten(list(names), 20)}."
    if fit.camera_sigma is not None:
        yield "The covariances of poses assume an exact camera; its error moves all boards together."
    if tables.readings is None:
        yield "The tables have no joint readings: add q1, q2 ... to each row, or give --configurations a table of ids."
    one = "{table: board.csv, model: board}, or {table: pixels.csv, model: pixels, camera: camera.yaml}"
    yield f"In a job take one of the two: {one}; with units: {{length: {units.length}, angle: {units.angle}}}."
