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
        Path | None, typer.Argument(metavar="[NEW]", readable=False, help="A newer result, beside the older one.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", readable=False, help="Write comparison.json there; of results a page."),
    ] = None,
    figures: Annotated[bool, typer.Option("--figures", help="Write comparison.svg there too.")] = False,
    as_json: Json = False,
) -> None:
    """Run the factor graph beside plain least squares on the same job; or show two results side by side."""
    from fg_calib.io.atomic import require_writable

    if out is None and figures:
        raise typer.BadParameter("needs --out, the folder to write to", param_hint="--figures")
    if out is not None:
        require_writable(out)
    if new is not None:
        _compare_results(job, new, out, figures, as_json)
    else:
        _compare_estimators(job, out, figures, as_json)


def _compare_estimators(job: Path, out: Path | None, figures: bool, as_json: bool) -> None:
    from fg_calib.baseline import comparison
    from fg_calib.io.job import read_job
    from fg_calib.report.comparison import build_comparison_report
    from fg_calib.report.documents import comparison_document, write_comparison

    found = comparison.compare(read_job(job))
    try:
        if as_json:
            show_json(comparison_document(found))
        else:
            show_report(build_comparison_report(found))
    finally:  # also where nobody takes the report
        if out is not None:
            write_comparison(out, found, figures=figures)
    end(found.findings)


def _compare_results(old: Path, new: Path, out: Path | None, figures: bool, as_json: bool) -> None:
    from fg_calib.pages import load_run
    from fg_calib.report.page.two import build_text, two_document, write_two

    both = load_run(old), load_run(new)
    try:
        if as_json:
            show_json(two_document(*both))
        else:
            show_report(build_text(*both))
    finally:
        if out is not None:
            write_two(out, *both, figures=figures)
