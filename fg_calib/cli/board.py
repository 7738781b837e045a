"""`fg-calib board`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fg_calib.cli.output import Angle, Json, Length, argument, end, option, say, show_result

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fg_calib.importers import BoardTables


def board(
    images: Annotated[list[Path], argument("IMAGES...", "Images, a folder of them, or a pattern in quotes.")],
    board: Annotated[Path, option("--board", "BOARD", "The board, such as charuco.yaml.")],
    out: Annotated[Path, option("--out", "DIR", "Write board.csv, pixels.csv and camera.yaml there.")],
    camera: Annotated[Path | None, option("--camera", "CAMERA", "The camera, such as camera.yaml.")] = None,
    estimate_camera: Annotated[
        bool, option("--estimate-camera", None, "Estimate the camera from the same images.")
    ] = False,
    configurations: Annotated[
        Path | None,
        option("--configurations", "TABLE", "Joint readings; id is an image's name without its ending."),
    ] = None,
    length: Length = "m",
    angle: Angle = "rad",
    as_json: Json = False,
) -> None:
    """Make tables of images of a board: its corners, and its poses with their covariances."""
    if (camera is None) != estimate_camera:
        say("error: one of --camera and --estimate-camera is needed, and only one")
        raise typer.Exit(2)
    from fg_calib.importers import (
        BoardTables,
        fit_board,
        image_files,
        read_calibration_board,
        read_corners,
        read_readings,
        require_no_input_of_board,
        write_board_tables,
    )
    from fg_calib.importers.opencv import opencv
    from fg_calib.io import Units, read_bytes, read_camera, read_camera_of_images, require_writable

    opencv()
    require_writable(out)
    target, files = read_calibration_board(board), image_files(images)
    require_no_input_of_board(out, [board, *files, *([] if configurations is None else [configurations])])
    readings = None if configurations is None else read_readings(configurations)
    if camera is not None:
        read_camera(camera)  # before the images, which take their time
    found = read_corners(files, target)
    given = None if camera is None else read_camera_of_images(camera, found.size)
    tables = BoardTables(
        fit=fit_board(target, found.images, found.size, given),
        without=found.without,
        readings=readings,
        units=Units(length=length, angle=angle),
        camera_file=None if camera is None else read_bytes(camera),
    )
    names = write_board_tables(out, tables)
    show_result(as_json, tables.document, lambda: _report(tables))
    say(f"wrote {', '.join(names)} to {out}")
    end(tables.fit.findings)


def _report(tables: BoardTables) -> RenderableType:
    """Corners, images and the camera, then what to know of the tables."""
    import numpy as np

    from fg_calib.importers import INTRINSICS
    from fg_calib.report import figure, line, report, section, table_of

    fit, board = tables.fit, tables.fit.board
    n_images = len(fit.views) + len(fit.without_pose) + len(tables.without)
    title = f"{board.type} {board.columns} x {board.rows}, square {1e3 * board.square:g} mm"
    seen = f"seen in {len(fit.views)} of {n_images} images, {sum(len(view.corners) for view in fit.views)} corners"
    images, camera = [], []
    for view in fit.views:
        turn, shift = (np.sqrt(np.linalg.eigvalsh(C)[-1]) for C in (view.covariance[:3, :3], view.covariance[3:, 3:]))
        remark = ", ".join(["two poses"] * view.ambiguous + ["large residuals"] * view.poor)
        residuals = f"{view.rms:.3f}", f"{view.sigma:.3f}"
        pose = f"{1e3 * np.linalg.norm(view.position):.1f}", figure(shift, "m"), figure(turn, "rad")
        images.append((view.name, len(view.corners), *residuals, *pose, remark))
    for name, sigma in (fit.camera_sigma or {}).items() if fit.camera_sigma is not None else ():
        unit, decimals = ("px", 3) if name in INTRINSICS[:4] else ("", 6)
        camera.append((name, f"{getattr(fit.camera, name):.{decimals}f}", f"{sigma:.{decimals}f}", unit))
    headings = ("Image", "corners", "RMS px", "sigma px", "distance mm", "sigma mm", "sigma deg", "")
    return report(
        line(f"{title}: {seen}"),
        *(line(f"DOUBTFUL: {finding}", "bold red") for finding in fit.findings),
        line(f"RMS of residuals {fit.rms:.3f} px, sigma of a corner {fit.sigma:.3f} px"),
        table_of(headings, images, left="lrrrrrrl"),
        *(section("Camera (1 sigma)", table_of(("", "estimate", "sigma", ""), camera, left="lrrl")) if camera else []),
        *section("Notes", *_notes(tables)),
    )


def _notes(tables: BoardTables) -> Iterator[str]:
    import numpy as np

    from fg_calib.report import shortened

    fit, units = tables.fit, tables.units

    def listed(names: Sequence[str]) -> str:
        return shortened(list(names), 20)

    for name, reason in tables.without.items():
        yield f"No board in {name}: {reason}."
    poor, two = [v.name for v in fit.views if v.poor], [v.name for v in tables.used if v.ambiguous]
    for names, words in (
        (fit.without_pose, "No pose of the board explains the corners of"),
        (poor, "Residuals are far larger than in other images (blurred, or the board not flat):"),
        (two, "Only in pixels.csv, as a second pose, tilted the other way, explains the corners as well:"),
        (tables.without_row, "No row of joint readings, and so not in the tables:"),
        (tables.without_image, "Rows of joint readings without an image of the board:"),
    ):
        if names:
            yield f"{words} {listed(names)}."
    if fit.camera_covariance is not None:
        shift = max(float(np.sqrt(np.linalg.eigvalsh(view.by_camera[3:, 3:])[-1])) for view in fit.views)
        yield (
            "The covariances of poses assume an exact camera. Its error moves the board in all images together, by up"
            f" to {1e3 * shift:.3f} mm (1 sigma)."
        )
    if tables.readings is None:
        yield "The tables have no joint readings: add q1, q2 ... to each row, or give --configurations a table of ids."
    job = f"units: {{length: {units.length}, angle: {units.angle}}}"
    yield (
        "In a job take one of the two: {table: board.csv, model: board}, or {table: pixels.csv, model: pixels, camera:"
        f" camera.yaml}}; with {job}."
    )
