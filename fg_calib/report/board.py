"""The report of `fg-calib board`: images, poses, the camera, and what to do with the tables."""

from __future__ import annotations

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.importers.board_tables import BoardTables
from fg_calib.importers.views import FIGURES, View
from fg_calib.report.tables import SHOWN, WIDTH, indented, line, plain_table, plain_text, section

_MOST_NAMES = 20
"""Names of images in one note."""


def format_board(tables: BoardTables, width: int = WIDTH) -> str:
    """`build_board_report` as plain text."""
    return plain_text(build_board_report(tables), width)


def build_board_report(tables: BoardTables) -> RenderableType:
    """What was seen of a board: corners, images, the camera, then what is to be known of the tables."""
    fit = tables.fit
    board, n_images = fit.board, len(fit.views) + len(fit.without_pose) + len(tables.without)
    title = f"{board.type} {board.columns} x {board.rows}, square {1e3 * board.square:g} mm"
    n_corners = sum(len(view.corners) for view in fit.views)
    parts: list[RenderableType] = [
        line(f"{title}: seen in {len(fit.views)} of {n_images} images, {n_corners} corners"),
        *(line(f"DOUBTFUL: {finding}", "bold red") for finding in fit.findings),
        line(f"RMS of residuals {fit.rms:.3f} px, sigma of a corner {fit.sigma:.3f} px"),
        line(""),
        _images(tables),
    ]
    if fit.camera_sigma is not None:
        parts += section("Camera (1 sigma)", _camera(tables))
    return Group(*parts, *section("Notes", *indented(_notes(tables))))


def _images(tables: BoardTables) -> RenderableType:
    table = plain_table(
        *(("Image", "left"), ("corners", "right"), ("RMS px", "right"), ("sigma px", "right")),
        *(("distance mm", "right"), ("sigma mm", "right"), ("sigma deg", "right"), ("", "left")),
    )
    for view in tables.fit.views:
        table.add_row(
            *(view.name, f"{len(view.corners)}", f"{view.rms:.3f}", f"{view.sigma:.3f}"),
            *(f"{1e3 * np.linalg.norm(view.position):.1f}", *_sigmas(view), _remark(view)),
        )
    return table


def _sigmas(view: View) -> tuple[str, str]:
    """1 sigma of the board's position and orientation, the largest of any direction."""
    (mm, _, _), (deg, _, _) = SHOWN["m"], SHOWN["rad"]
    turn, shift = (np.sqrt(np.linalg.eigvalsh(C)[-1]) for C in (view.covariance[:3, :3], view.covariance[3:, 3:]))
    return f"{mm * shift:.3f}", f"{deg * turn:.4f}"


def _remark(view: View) -> str:
    return ", ".join(["two poses"] * view.ambiguous + ["large residuals"] * view.poor)


def _camera(tables: BoardTables) -> RenderableType:
    table = plain_table(("", "left"), ("estimate", "right"), ("sigma", "right"), ("", "left"))
    sigmas = tables.fit.camera_sigma or {}
    for name in FIGURES:
        unit, decimals = ("px", 3) if name in FIGURES[:4] else ("", 6)
        table.add_row(name, f"{getattr(tables.fit.camera, name):.{decimals}f}", f"{sigmas[name]:.{decimals}f}", unit)
    return table


def _notes(tables: BoardTables) -> list[str]:
    fit, units = tables.fit, tables.units
    notes = [f"No board in {name}: {reason}." for name, reason in tables.without.items()]
    if fit.without_pose:
        notes.append(f"No pose of the board explains the corners of {_listed(fit.without_pose)}.")
    if poor := [view.name for view in fit.views if view.poor]:
        notes.append(f"Residuals are far larger than in other images: {_listed(poor)}. Blurred, or the board bent?")
    if two := [view.name for view in tables.used if view.ambiguous]:
        words = "Only in pixels.csv, as a second pose, tilted the other way, explains the corners as well"
        notes.append(f"{words}: {_listed(two)}.")
    if fit.camera_covariance is not None:
        shift = max(float(np.sqrt(np.linalg.eigvalsh(view.by_camera[3:, 3:])[-1])) for view in fit.views)
        words = "The covariances of poses take the camera as known. What it may be off moves the board, in all images"
        notes.append(f"{words} together, by up to {1e3 * shift:.3f} mm (1 sigma).")
    if tables.without_row:
        notes.append(f"No row of joint readings, and so not in the tables: {_listed(tables.without_row)}.")
    if tables.without_image:
        notes.append(f"Rows of joint readings without an image of the board: {_listed(tables.without_image)}.")
    if tables.readings is None:
        words = "The tables have no joint readings: add q1, q2 and so on to each row, or give --configurations a table"
        notes.append(f"{words} whose id is the image's name.")
    words = (
        "In a job take one of the two: {table: board.csv, model: board}, or {table: pixels.csv, model: pixels, camera:"
    )
    return [*notes, f"{words} camera.yaml}}; with units: {{length: {units.length}, angle: {units.angle}}}."]


def _listed(names: tuple[str, ...] | list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more
