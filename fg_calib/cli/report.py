"""`fg-calib report`."""

from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import ResultFolder, option, say


def report(
    result: ResultFolder,
    out: Annotated[Path | None, option("--out", "DIR", "Write there instead of to the result's folder.")] = None,
    figures: Annotated[bool, option("--figures", None, "Write its figures too, as SVG files.")] = False,
) -> None:
    """Write report.html of a calibration: one page to look at and to pass on, which needs nothing else."""
    from fg_calib.calibration import write_report

    write_report(result, out, figures=figures)
    folder = (result if result.is_dir() else result.parent) if out is None else out
    say(f"wrote {folder / 'report.html'}")
