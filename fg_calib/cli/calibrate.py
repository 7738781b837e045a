"""`fg-calib calibrate`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fg_calib.cli.output import Json, Scheduler, Workers, end, executor_for, say, show_json, show_report

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import RenderableType

    from fg_calib.batch import JobSummary, Order
    from fg_calib.calibration import Calibration


def calibrate(
    jobs: Annotated[
        list[Path],
        typer.Argument(metavar="JOB", readable=False, help="The job, such as calibration.yaml; or many."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            readable=False,
            help="Write result.json, the calibrated robot and all residuals there; of many jobs to a folder each.",
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
    residuals: Annotated[
        Literal["csv", "parquet", "none"],
        typer.Option("--residuals", help="How single residuals are written: of millions of rows a CSV is large."),
    ] = "csv",
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib.batch import Order, job_names
    from fg_calib.calibration import calibrate_job
    from fg_calib.io.atomic import require_writable

    if out is None and (report or figures):
        raise typer.BadParameter(
            "needs --out, the folder to write to", param_hint="--report" if report else "--figures"
        )
    several = len(jobs) > 1
    names = job_names(jobs) if several else [""]
    if out is not None and several:
        require_writable(out)
    if scheduler is not None:  # its workers run elsewhere
        jobs, out = [job.absolute() for job in jobs], None if out is None else out.absolute()
    orders = [
        Order(name, job, None if out is None else out / name, folds, report, figures, residuals)
        for name, job in zip(names, jobs, strict=True)
    ]
    with executor_for(workers, scheduler) as executor:
        if several:
            _calibrate_many(orders, out, executor, as_json)
        else:
            found = calibrate_job(orders[0].read(), executor)
            orders[0].save(found)
            show_calibration(found, as_json)


def show_calibration(found: Calibration, as_json: bool) -> None:
    """Print a calibration, and end with 3 where it is not to be trusted or not accepted."""
    from fg_calib.report.text import build_report

    if as_json:
        show_json(found.result.document())
    else:
        show_report(build_report(found))
    end(found.findings, not_accepted=found.not_accepted)


def _calibrate_many(orders: Sequence[Order], out: Path | None, executor: Executor | None, as_json: bool) -> None:
    from fg_calib.batch import calibrate_into, exit_code, jobs_document, write_jobs

    clock = time.perf_counter()
    found = calibrate_into(orders, executor)
    seconds = time.perf_counter() - clock
    if out is not None:
        write_jobs(out, found, seconds)
    if as_json:
        show_json(jobs_document(found, seconds))
    else:
        show_report(_jobs_table(found, seconds))
    for job in found:
        for what, reason in job.reasons:
            say(f"{job.name}: {what}: {reason}")
    if code := exit_code(found):
        raise typer.Exit(code)


def _jobs_table(jobs: Sequence[JobSummary], seconds: float) -> RenderableType:
    """Many jobs for the terminal: a line of each, then how many are good; `seconds` is the duration of all together."""
    from rich.console import Group

    from fg_calib.report.tables import SHOWN, figure, in_order, line, table_of

    units = {kind: unit for job in jobs for kind, unit in (job.units or {}).items()}
    kinds, rows = in_order(units), []
    for job in jobs:
        values = [figure((job.rms or {}).get(kind), units[kind], none="") for kind in kinds]
        chi2 = "" if job.reduced_chi2 is None else f"{job.reduced_chi2:.3g}"
        more = f" (and {len(job.reasons) - 1} more)" if len(job.reasons) > 1 else ""
        reason = job.reasons[0][1] + more if job.reasons else ""
        took = "" if job.seconds is None else f"{job.seconds:.1f}"
        rows.append((job.name, job.verdict, job.rows, *values, chi2, took, reason))
    headings = ("job", "verdict", "rows", *(f"{kind} {SHOWN[units[kind]][1]}" for kind in kinds))
    table = table_of((*headings, "chi2/dof", "s", "reason"), rows, left=f"lll{'r' * (len(kinds) + 2)}l", wrap=True)
    verdicts = Counter(job.verdict for job in jobs)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    return Group(table, line(f"{len(jobs)} jobs in {seconds:.1f} s: {counts}; RMS after the calibration", "bold"))
