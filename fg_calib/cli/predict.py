"""`fg-calib predict`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, ResultFolder, end, say, show_json, show_report
from fg_calib.options import AngleUnit, LengthUnit

_At = Annotated[
    Path | None,
    typer.Option(
        "--at", metavar="TABLE", readable=False, help="Configurations, q1 ...; all over the workspace if none."
    ),
]
_Limit = Annotated[
    str | None, typer.Option("--limit", metavar="LENGTH", help="Say where errors are within it, such as 0.5mm.")
]
_Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", readable=False, help="Write predict.json, predict.csv and pictures there."),
]
_Length = Annotated[
    LengthUnit, typer.Option("--length", help="Unit of lengths in TABLE and predict.csv, and of positions.")
]
_Angle = Annotated[AngleUnit, typer.Option("--angle", help="Unit of joint values in TABLE and predict.csv.")]


def predict(
    result: ResultFolder,
    at: _At = None,
    limit: _Limit = None,
    out: _Out = None,
    length: _Length = "m",
    angle: _Angle = "rad",
    as_json: Json = False,
) -> None:
    """Say how far off the calibrated tool is expected to be: over the workspace, or at configurations."""
    from fg_calib.calibration import Calibration
    from fg_calib.io.tables import read_joint_table
    from fg_calib.io.units import Units, quantity
    from fg_calib.predictions import measured_of, require_prediction, write_prediction
    from fg_calib.predictions import predict as predict_tool
    from fg_calib.report.predict import build_prediction_report, prediction_document

    most = None if limit is None else quantity(limit, "m", Units(), "--limit")
    units = Units(length, angle)
    if out is not None:
        require_prediction(out)
    calibration = Calibration.load(result)
    ids, readings = ((), None) if at is None else read_joint_table(at, calibration.robot, units)
    found = predict_tool(calibration, readings, limit=most, measured=measured_of(calibration, result))
    if out is not None:
        write_prediction(out, found, calibration, ids=ids, units=units)
    if as_json:
        show_json(prediction_document(found, calibration.result, ids))
    else:
        show_report(build_prediction_report(found, calibration.result, calibration.robot, ids, length))
    if out is not None:
        say(f"wrote the prediction to {out}")
    end(calibration.findings)
