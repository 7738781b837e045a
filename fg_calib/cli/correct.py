"""`fg-calib correct`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, ResultFolder, end, say, show_json, show_report
from fg_calib.options import AngleUnit, LengthUnit

_Targets = Annotated[
    Path, typer.Argument(metavar="TARGETS", readable=False, help="Where the tool is to be: x y z, orientation, q1 ...")
]
_Out = Annotated[Path | None, typer.Option("--out", metavar="CSV", help="Write the table of commands there.")]
_Length = Annotated[LengthUnit, typer.Option("--length", help="Unit of lengths in both tables.")]
_Angle = Annotated[AngleUnit, typer.Option("--angle", help="Unit of angles in both tables, joint values included.")]
_World = Annotated[
    bool,
    typer.Option("--world", help="The targets are in the measurement frame, not from the base."),
]
_Table = Annotated[int | None, typer.Option("--table", help="Number of the table whose frame that is, from 0.")]


def correct(
    result: ResultFolder,
    targets: _Targets,
    out: _Out = None,
    length: _Length = "m",
    angle: _Angle = "rad",
    world: _World = False,
    table: _Table = None,
    as_json: Json = False,
) -> None:
    """Find what to command so that the calibrated arm reaches targets: joint values, and poses for a nominal model."""
    from fg_calib.calibration import Calibration
    from fg_calib.io.tables import read_targets
    from fg_calib.io.units import Units
    from fg_calib.predictions import correct as correct_targets
    from fg_calib.report.predict import (
        build_correction_report,
        correction_document,
        require_commands,
        write_commands,
    )

    if out is not None:
        require_commands(out)
    found, units = Calibration.load(result), Units(length, angle)
    wanted = read_targets(targets, found.robot, units)
    commands = correct_targets(found, wanted.position, wanted.rotation, near=wanted.readings, world=world, table=table)
    if out is not None:
        write_commands(out, wanted.ids, commands, found.robot, units)
    if as_json:
        show_json(correction_document(found.robot.name, wanted.ids, commands))
    else:
        show_report(build_correction_report(wanted.ids, commands, found.robot))
    say(f"wrote {len(wanted.ids)} commands to {out}" if out else "nothing is written: --out commands.csv writes them")
    left = int((~commands.reached).sum())
    doubts = [f"the calibration was not to be trusted: {finding}" for finding in found.findings]
    end([*doubts, *([f"{left} of {len(wanted.ids)} targets are not reached"] if left else [])], "doubtful")
