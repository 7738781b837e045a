"""`fg-calib check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, ResultFolder, show_json, show_report

NewTable = Annotated[
    Path,
    typer.Argument(metavar="TABLE", readable=False, help="New rows: a table like the job's, or a job with several."),
]
Pairs = Annotated[
    Path | None, typer.Option("--pairs", readable=False, help="Table of pairs, if the job has one.", metavar="TABLE")
]
Like = Annotated[
    str | None,
    typer.Option("--like", metavar="NAME", help="Which of the job's tables it is like, if there are several."),
]


def check(
    result: ResultFolder,
    table: NewTable,
    limit: Annotated[
        str | None, typer.Option("--limit", metavar="LENGTH", help="Largest RMS error of positions, such as 0.5mm.")
    ] = None,
    limit_angle: Annotated[
        str | None, typer.Option("--limit-angle", metavar="ANGLE", help="Of orientations, such as 0.05deg.")
    ] = None,
    pairs: Pairs = None,
    like: Like = None,
    as_json: Json = False,
) -> None:
    """Say whether a calibration is still good by new rows, and what changed if it is not."""
    from fg_calib.calibration import Calibration
    from fg_calib.io.units import Units, quantity
    from fg_calib.report.monitor import build_check_report, check_document

    limits = [
        None if given is None else quantity(given, unit, Units(), option)
        for given, unit, option in ((limit, "m", "--limit"), (limit_angle, "rad", "--limit-angle"))
    ]
    calibration = Calibration.load(result)
    found = calibration.check(table, limit=limits[0], limit_angle=limits[1], pairs=pairs, like=like)
    if as_json:
        show_json(check_document(found))
    else:
        show_report(build_check_report(found, [joint.unit for joint in calibration.robot.joints]))
    if not found.passed:
        raise typer.Exit(3)
