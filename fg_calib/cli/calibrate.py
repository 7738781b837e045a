"""`fg-calib calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, end, show_json, show_report


def calibrate(
    job: Annotated[Path, typer.Argument(metavar="JOB", help="The job, such as calibration.yaml.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Write result.json, the calibrated robot and residuals.csv there."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib.analysis.uncertainty import assess
    from fg_calib.analysis.variance_components import solve_job
    from fg_calib.files.job import read_job

    given = read_job(job)
    solution = solve_job(given)
    uncertainty = assess(solution)
    if out is not None:
        from fg_calib.report.documents import write_results

        write_results(out, solution, uncertainty, given.inputs)
    if as_json:
        from fg_calib.report.documents import result_document

        show_json(result_document(solution, uncertainty, given.inputs))
    else:
        from fg_calib.report.text import build_report

        show_report(build_report(solution, uncertainty))
    end(uncertainty.findings)
