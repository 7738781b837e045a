"""`fg-calib check`."""

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, ResultFolder, angle_option, argument, length_option, option, show_result

NewTable = Annotated[Path, argument("TABLE", "New rows: a table like the job's, or a job with several.")]
Pairs = Annotated[Path | None, option("--pairs", "TABLE", "Table of pairs, if the job has one.")]
Like = Annotated[str | None, option("--like", "NAME", "Which of the job's tables it is like, if there are several.")]


def check(
    result: ResultFolder,
    table: NewTable,
    limit: Annotated[float | None, length_option("--limit", "Largest RMS error of positions, such as 0.5mm.")] = None,
    limit_angle: Annotated[float | None, angle_option("--limit-angle", "Of orientations, such as 0.05deg.")] = None,
    pairs: Pairs = None,
    like: Like = None,
    as_json: Json = False,
) -> None:
    """Say whether a calibration is still good by new rows, and what changed if it is not."""
    from fg_calib.calibration import Calibration
    from fg_calib.report import build_check_report, check_document

    calibration = Calibration.load(result)
    found = calibration.check(table, limit=limit, limit_angle=limit_angle, pairs=pairs, like=like)
    joints = [joint.unit for joint in calibration.robot.joints]
    show_result(as_json, lambda: check_document(found), lambda: build_check_report(found, joints))
    if found.verdict != "pass":
        raise typer.Exit(3)
