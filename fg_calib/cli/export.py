"""`fg-calib export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from fg_calib.cli.output import BaseLink, Json, TipLink, end, say, show, show_json
from fg_calib.errors import escaped

_Arm = Annotated[
    Path,
    typer.Argument(
        metavar="RESULT|ROBOT", readable=False, help="A folder that `calibrate --out` wrote, or robot.yaml or a URDF."
    ),
]
_To = Annotated[
    Literal["urdf", "ur", "tesseract", "dh", "mdh", "hayati", "zeros", "yaml"],
    typer.Option("--to", help="What is to read it: see the documentation of export."),
]
_Out = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", readable=False, help="A new file; on stdout if not given.")
]
_Nominal = Annotated[
    Path | None,
    typer.Option("--nominal", metavar="ROBOT", readable=False, help="The robot as drawn; a RESULT has its own."),
]
_At = Annotated[
    Literal["workspace", "measured"] | None,
    typer.Option("--at", help="Of zeros: fit them over the joint limits, or where the RESULT was measured."),
]
_Tool = Annotated[
    Literal["nominal", "calibrated"] | None,
    typer.Option("--tool", help="Of zeros: the tool that the controller works with; as calibrated if not given."),
]
_Far = Annotated[bool, typer.Option("--far", help="Of dh and mdh: be exact, however far frames are from the arm.")]
_Elements = Annotated[
    bool, typer.Option("--calibration-elements", help="Of urdf: write joint zeros into <calibration>.")
]
_UrBase = Annotated[
    Literal["base", "base_link"] | None,
    typer.Option("--ur-base", help="Of ur: which frame of ur_description the arm's base is."),
]
_UrHash = Annotated[str | None, typer.Option("--ur-hash", metavar="HASH", help="Of ur: the controller's own hash.")]


def export(
    arm: _Arm,
    to: _To,
    out: _Out = None,
    nominal: _Nominal = None,
    at: _At = None,
    tool: _Tool = None,
    far: _Far = False,
    calibration_elements: _Elements = False,
    ur_base: _UrBase = None,
    ur_hash: _UrHash = None,
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    as_json: Json = False,
) -> None:
    """Write the calibrated arm as others read it: URDF, ROS, Tesseract, tables, joint zeros."""
    from fg_calib.io.atomic import is_folder, require_absent

    is_result = is_folder(arm) or arm.suffix.lower() == ".json"
    if is_result and (base_link or tip_link):
        raise typer.BadParameter("a RESULT knows its links", param_hint="--base-link and --tip-link")
    if at is not None and to != "zeros":
        raise typer.BadParameter(f"means nothing for {to}", param_hint="--at")
    if at == "measured" and not is_result:
        raise typer.BadParameter("needs a RESULT with its configurations", param_hint="--at measured")
    from fg_calib.calibration import Calibration
    from fg_calib.exports.export import export as export_arm
    from fg_calib.exports.export import measured_configurations
    from fg_calib.io.robot_file import read_robot

    if out is not None:
        require_absent(out.parent, [out.name])
    found = Calibration.load(arm) if is_result else read_robot(arm, base_link=base_link, tip_link=tip_link)
    made = export_arm(
        found,
        to,
        nominal=None if nominal is None else read_robot(nominal, base_link=base_link, tip_link=tip_link),
        configurations=measured_configurations(arm) if at == "measured" else None,
        tool=tool or "calibrated",
        far=far,
        calibration_elements=calibration_elements,
        ur_base=ur_base,
        ur_hash=ur_hash,
    )
    if out is not None:
        made.write(out)
        say(f"wrote {out}")
    if as_json:
        show_json(made.document())
    elif out is None:
        show(_shown(made.text) if sys.stdout.isatty() else made.text.removesuffix("\n"))
    on_stdout = made.text if out is None and not as_json else ""
    for note in made.notes:
        if note not in on_stdout:
            say(note)
    end(made.findings, not_accepted=made.not_accepted)


def _shown(text: str) -> str:
    """A file's text as a terminal may get it: what names in it hold steers none."""
    return "\n".join(escaped(line.expandtabs()) for line in text.split("\n"))
