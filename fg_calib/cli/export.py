"""`fg-calib export` and `convert`: an arm as others read it."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

import fg_calib
from fg_calib import exports, io
from fg_calib.cli.output import BaseLink, Json, TipLink, argument, end, option, say, show, show_json
from fg_calib.inputs import ExportFormat, InputError, ToolOfZeros, UrBase, escaped

At = Literal["workspace", "measured"]
Description = Literal["dh", "mdh", "mdh-hayati", "dh-hayati", "poe", "cpc", "urdf"]


def export(
    arm: Annotated[Path, argument("RESULT|ROBOT", "What `calibrate --out` wrote, or robot.yaml or a URDF.")],
    to: Annotated[ExportFormat, option("--to", None, "What is to read it: see the documentation of export.")],
    out: Annotated[Path | None, option("--out", "FILE", "A new file; on stdout if not given.")] = None,
    nominal: Annotated[Path | None, option("--nominal", "ROBOT", "The nominal robot; a RESULT has its own.")] = None,
    at: Annotated[At, option("--at", None, "Of zeros: fitted over the limits, or where measured.")] = "workspace",
    tool: Annotated[ToolOfZeros, option("--tool", None, "Of zeros: the controller's tool.")] = "calibrated",
    far: Annotated[bool, option("--far", None, "Of dh and mdh: be exact, however far frames are.")] = False,
    ur_base: Annotated[UrBase | None, option("--ur-base", None, "Of ur: ur_description's name of the base.")] = None,
    ur_hash: Annotated[str | None, option("--ur-hash", "HASH", "Of ur: the controller's own hash.")] = None,
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    as_json: Json = False,
) -> None:
    """Write the calibrated arm as others read it: URDF, ROS, Tesseract, tables, joint zeros."""
    is_result = io.is_folder(arm) or arm.suffix.lower() == ".json"
    if is_result and (base_link or tip_link):
        raise typer.BadParameter("a RESULT knows its links", param_hint="--base-link and --tip-link")
    if at == "measured" and not is_result:
        raise typer.BadParameter("needs a RESULT with its configurations", param_hint="--at measured")
    if out is not None:
        io.require_absent(out.parent, [out.name])
    found = fg_calib.Calibration.load(arm) if is_result else io.read_robot(arm, base_link=base_link, tip_link=tip_link)
    choices = {"far": far, "ur_base": ur_base, "ur_hash": ur_hash}
    before = None if nominal is None else io.read_robot(nominal, base_link=base_link, tip_link=tip_link)
    q = found.measured if isinstance(found, fg_calib.Calibration) and at == "measured" else None
    if at == "measured" and q is None:
        raise InputError(str(arm), "no configurations.csv", "what `fg-calib calibrate --out` wrote")
    made = fg_calib.export(found, to, nominal=before, configurations=q, tool=tool, **choices)  # type: ignore[arg-type]
    _show_export(made, out, as_json)
    end(made.findings, not_accepted=made.not_accepted)


def convert(
    robot: Annotated[Path, argument("ROBOT", "robot.yaml or a URDF.")],
    to: Annotated[Description, option("--to", None, "The convention.")],
    out: Annotated[Path | None, option("--out", "FILE", "A new file; on stdout if not given.")] = None,
    as_json: Json = False,
) -> None:
    """Describe a robot by another convention, and say how exactly."""
    _show_export(fg_calib.export(io.read_robot(robot), "hayati" if to == "dh-hayati" else to), out, as_json)


def _show_export(made: "exports.Export", out: Path | None, as_json: bool) -> None:
    """Write an export to a new file, or print it; its notes on stderr where they are not in what is printed."""
    if out is not None:
        made.write(out)
        say(f"wrote {out}")
    if as_json:
        show_json(made.document())
    elif out is None:
        lines = made.text.removesuffix("\n").split("\n")
        show("\n".join(escaped(line.expandtabs()) if sys.stdout and sys.stdout.isatty() else line for line in lines))
    for note in made.notes:
        if as_json or out is not None or note not in made.text:
            say(note if out is None else exports.with_names(note, out.stem))
