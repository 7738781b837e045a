"""`fg-calib board`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, end, say, show_json, show_report
from fg_calib.options import AngleUnit, LengthUnit

_Images = Annotated[
    list[Path], typer.Argument(metavar="IMAGES...", help="Images, a folder of them, or a pattern in quotes.")
]
_Board = Annotated[Path, typer.Option("--board", metavar="BOARD", help="The board, such as charuco.yaml.")]
_Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Write board.csv, pixels.csv and camera.yaml there.")]
_Camera = Annotated[Path | None, typer.Option("--camera", metavar="CAMERA", help="The camera, such as camera.yaml.")]
_Estimate = Annotated[bool, typer.Option("--estimate-camera", help="Estimate the camera from the same images.")]
_Configurations = Annotated[
    Path | None,
    typer.Option("--configurations", metavar="TABLE", help="Joint readings; id is an image's name without its ending."),
]
_Length = Annotated[LengthUnit, typer.Option("--length", help="Unit of lengths in the tables, readings included.")]
_Angle = Annotated[AngleUnit, typer.Option("--angle", help="Unit of angles in the tables, readings included.")]


def board(
    images: _Images,
    board: _Board,
    out: _Out,
    camera: _Camera = None,
    estimate_camera: _Estimate = False,
    configurations: _Configurations = None,
    length: _Length = "m",
    angle: _Angle = "rad",
    as_json: Json = False,
) -> None:
    """Make tables of images of a board: its corners, and its poses with their covariances."""
    if (camera is None) != estimate_camera:
        say("error: one of --camera and --estimate-camera is needed, and only one")
        raise typer.Exit(2)
    from fg_calib.importers.board import image_files, read_calibration_board, read_corners
    from fg_calib.importers.board_tables import (
        BoardTables,
        read_readings,
        require_no_input_of_board,
        write_board_tables,
    )
    from fg_calib.importers.opencv import opencv
    from fg_calib.importers.views import fit_board
    from fg_calib.io.atomic import read_bytes, require_writable
    from fg_calib.io.instruments import read_camera, read_camera_of_images
    from fg_calib.io.units import Units
    from fg_calib.report.board import build_board_report

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
    try:
        if as_json:
            show_json(tables.document())
        else:
            show_report(build_board_report(tables))
    finally:  # also where nobody takes the report
        names = write_board_tables(out, tables)
    say(f"wrote {', '.join(names)} to {out}")
    end(tables.fit.findings)
