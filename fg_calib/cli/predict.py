"""`fg-calib predict` and `correct`: what a calibration is good for."""

from functools import partial
from pathlib import Path
from typing import Annotated

import fg_calib
from fg_calib import io, report
from fg_calib.cli.output import Angle, Json, Length, ResultFolder, argument, end, option, quantity, say, show_result


def predict(
    result: ResultFolder,
    at: Annotated[Path | None, option("--at", "TABLE", "Configurations; over the workspace if not given.")] = None,
    limit: Annotated[float | None, quantity("--limit", "m", "Say where errors are within it, such as 0.5mm.")] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write predict.json, predict.csv and pictures there.")] = None,
    length: Length = "m",
    angle: Angle = "rad",
    as_json: Json = False,
) -> None:
    """Say how far off the calibrated tool is expected to be: over the workspace, or at configurations."""
    units = io.Units(length, angle)
    if out is not None:
        io.require_writable(out)
    arm = fg_calib.Calibration.load(result)
    ids, readings, context = ((), None, {}) if at is None else io.read_joint_table(at, arm.robot, units)
    found = fg_calib.predict(arm, readings, context, limit=limit)
    if out is not None:
        report.write_prediction(out, found, arm.result, arm.robot, ids, units)
    document = partial(report.prediction_document, found, arm.result, ids)
    show_result(as_json, document, lambda: report.build_prediction_report(found, arm.result, arm.robot, ids))
    if out is not None:
        say(f"wrote the prediction to {out}")
    end(arm.findings)


def correct(
    result: ResultFolder,
    targets: Annotated[Path, argument("TARGETS", "Where the tool is to be: x y z, orientation, q1 ...")],
    out: Annotated[Path | None, option("--out", "CSV", "Write the table of commands there.")] = None,
    length: Length = "m",
    angle: Angle = "rad",
    world: Annotated[bool, option("--world", None, "The targets are in the measurement frame.")] = False,
    table: Annotated[int | None, option("--table", None, "Number of the table whose frame that is, from 0.")] = None,
    as_json: Json = False,
) -> None:
    """Find what to command so that the calibrated arm reaches targets: joint values, and poses for a nominal model."""
    if out is not None:
        io.require_absent(out.parent, [out.name])
    found, units = fg_calib.Calibration.load(result), io.Units(length, angle)
    wanted = io.read_targets(targets, found.robot, units)
    where, near = (wanted.position, wanted.rotation, wanted.context), wanted.readings
    commands = fg_calib.correct(found, *where, near=near, world=world, table=table)
    if out is not None:
        report.write_commands(out, wanted.ids, commands, found.robot, units)
    document = partial(report.correction_document, found.robot.name, wanted.ids, commands)
    show_result(as_json, document, lambda: report.build_correction_report(wanted.ids, commands, found.robot))
    say(f"wrote {len(wanted.ids)} commands to {out}" if out else "nothing is written: --out commands.csv writes them")
    left = int((~commands.reached).sum())
    doubts = [f"the calibration was not to be trusted: {finding}" for finding in found.findings]
    end([*doubts, *([f"{left} of {len(wanted.ids)} targets are not reached"] if left else [])], "doubtful")
