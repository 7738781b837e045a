"""`fg-calib init`."""

import shlex
from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import argument, option, say


def init(
    files: Annotated[list[Path], argument("FILES...", "robot.yaml or a URDF, tables, perhaps camera.yaml.")],
    out: Annotated[Path, option("--out", "JOB", "The job to write.")] = Path("calibration.yaml"),
) -> None:
    """Write a commented job for a robot and its tables, recognised by their headers; nothing is overwritten."""
    from fg_calib import importers, io

    io.require_absent(out.parent, [out.name])
    text = importers.draft_job(files, out)
    io.write_text(out, text)
    decisions = sum("DECIDE" in line for line in text.splitlines()[2:])
    say(f"wrote {out}: {decisions} lines with DECIDE are yours to look at")
    say(f"now: fg-calib inspect {shlex.quote(str(out))}")
