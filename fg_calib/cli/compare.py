"""`fg-calib compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, end, show_json, show_report


def compare(
    job: Annotated[Path, typer.Argument(metavar="JOB", readable=False, help="The job, such as calibration.yaml.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", readable=False, help="Write comparison.json there.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run the factor graph beside plain least squares on the same job: errors, residuals, sigmas, time."""
    from fg_calib.baseline import comparison
    from fg_calib.files.disk import require_writable
    from fg_calib.files.job import read_job
    from fg_calib.report.comparison import build_comparison_report
    from fg_calib.report.documents import comparison_document, write_comparison

    if out is not None:
        require_writable(out)
    found = comparison.compare(read_job(job))
    try:
        if as_json:
            show_json(comparison_document(found))
        else:
            show_report(build_comparison_report(found))
    finally:  # also where nobody takes the report
        if out is not None:
            write_comparison(out, found)
    end(found.findings)
