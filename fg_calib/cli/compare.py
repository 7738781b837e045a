"""`fg-calib compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, end, show_json, show_report


def compare(
    job: Annotated[
        Path,
        typer.Argument(
            metavar="JOB|OLD", readable=False, help="The job, such as calibration.yaml; or an older result."
        ),
    ],
    new: Annotated[
        Path | None, typer.Argument(metavar="[NEW]", readable=False, help="A newer result, to compare with the older.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", readable=False, help="Write comparison.json there.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the factor graph with plain least squares on the same job, or a new result with an old one."""
    from fg_calib.baseline import comparison
    from fg_calib.io.job import read_job
    from fg_calib.io.result import read_result
    from fg_calib.report import compare as report

    if new is not None:
        old_and_new = read_result(job), read_result(new)
        if as_json:
            show_json(report.changes_document(*old_and_new, (job, new)))
        else:
            show_report(report.build_changes_report(*old_and_new, (job, new)))
        return
    found = comparison.compare(read_job(job))
    if out is not None:
        report.write_comparison(out, found)
    if as_json:
        show_json(report.comparison_document(found))
    else:
        show_report(report.build_comparison_report(found))
    end(found.findings)
