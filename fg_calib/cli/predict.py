"""`fg-calib predict`."""

from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import Angle, Json, Length, ResultFolder, end, length_option, option, say, show_result


def predict(
    result: ResultFolder,
    at: Annotated[Path | None, option("--at", "TABLE", "Configurations; over the workspace if not given.")] = None,
    limit: Annotated[float | None, length_option("--limit", "Say where errors are within it, such as 0.5mm.")] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write predict.json, predict.csv and pictures there.")] = None,
    length: Length = "m",
    angle: Angle = "rad",
    as_json: Json = False,
) -> None:
    """Say how far off the calibrated tool is expected to be: over the workspace, or at configurations."""
    from fg_calib import calibration, io, report
    from fg_calib.calibration import predict as predict_tool

    units = io.Units(length, angle)
    if out is not None:
        io.require_writable(out)
    arm = calibration.Calibration.load(result)
    ids, readings = ((), None) if at is None else io.read_joint_table(at, arm.robot, units)
    found = predict_tool(arm, readings, limit=limit)
    if out is not None:
        report.write_prediction(out, found, arm.result, arm.robot, ids, units)
    show_result(
        as_json,
        lambda: report.prediction_document(found, arm.result, ids),
        lambda: report.build_prediction_report(found, arm.result, arm.robot, ids),
    )
    if out is not None:
        say(f"wrote the prediction to {out}")
    end(arm.findings)
