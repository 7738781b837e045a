"""`fg-calib calibrate`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, end, show_calibration


def calibrate(
    job: Annotated[Path, typer.Argument(metavar="JOB", readable=False, help="The job, such as calibration.yaml.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            readable=False,
            help="Write result.json, the calibrated robot and residuals.csv there.",
        ),
    ] = None,
    folds: Annotated[
        int | None, typer.Option("--folds", min=2, help="Hold every configuration out once, in so many folds.")
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Write report.html there too: one page to look at and to pass on.")
    ] = False,
    figures: Annotated[
        bool, typer.Option("--figures", help="Write the page's figures there too, as SVG files.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib.calibration import calibrate_job
    from fg_calib.files.disk import require_writable
    from fg_calib.files.job import read_job
    from fg_calib.report.documents import require_no_input

    if out is None and (report or figures):
        option = "--report" if report else "--figures"
        raise typer.BadParameter("needs --out, the folder to write to", param_hint=option)
    if out is not None:
        require_writable(out)
    given = read_job(job)
    if out is not None:
        require_no_input(out, given)
    if folds is not None:
        given = replace(given, options=replace(given.options, folds=folds))
    found = calibrate_job(given)
    try:
        show_calibration(found, as_json)
    finally:  # also where nobody takes the report
        if out is not None:
            found.save(out)
            if report or figures:
                from fg_calib.pages import write_report

                write_report(out, page=report, figures=figures)
    end(found.findings, not_accepted=found.not_accepted)
