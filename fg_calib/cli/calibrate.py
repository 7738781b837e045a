"""`fg-calib calibrate`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fg_calib.cli.output import Json, end, say, show_calibration, show_json, show_report
from fg_calib.cli.workers import Scheduler, Workers, executor_for, require_one

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from fg_calib.batch import Order


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
    parts: Annotated[
        int | None,
        typer.Option("--parts", min=1, metavar="ROWS", help="Read one huge Parquet table in parts of so many rows."),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib.batch import Order, job_names, require_place

    if out is None and (report or figures):
        option = "--report" if report else "--figures"
        raise typer.BadParameter("needs --out, the folder to write to", param_hint=option)
    require_one(workers, scheduler)
    if parts is not None:
        _require_parts_alone(len(jobs), folds, residuals)
    if len(jobs) == 1:
        order = Order("", jobs[0], out, folds, report, figures, residuals)
        with executor_for(workers, scheduler, _written([order])) as executor:
            _calibrate_one(order, parts, executor, as_json)
        return
    names = job_names(jobs)
    if out is not None:
        require_place(out)
    if scheduler is not None:  # whose workers run elsewhere
        jobs, out = [job.absolute() for job in jobs], None if out is None else out.absolute()
    orders = [
        Order(name, job, None if out is None else out / name, folds, report, figures, residuals)
        for name, job in zip(names, jobs, strict=True)
    ]
    with executor_for(workers, scheduler, _written(orders)) as executor:
        _calibrate_many(orders, out, executor, as_json)


def _written(orders: Sequence[Order]) -> Callable[[], str]:
    """What says later of how many orders a result has been written since."""
    from fg_calib.batch import saved_in

    before = saved_in(orders)

    def said() -> str:
        n = sum(now != then for now, then in zip(saved_in(orders), before, strict=True))
        return f"results of {n} of {len(orders)} jobs have been written" if n else "nothing has been written"

    return said


def _calibrate_one(order: Order, n_rows: int | None, executor: Executor | None, as_json: bool) -> None:
    """Calibrate one job, its table in parts of so many rows unless that is None."""
    from fg_calib.batch import ordered_job, ordered_parts, save_ordered
    from fg_calib.calibration import calibrate_job, calibrate_parts

    if n_rows is None:
        found = calibrate_job(ordered_job(order), executor)
    else:
        found = calibrate_parts(ordered_parts(order, n_rows), executor)
    try:
        show_calibration(found, as_json)
    finally:  # also where nobody takes the report
        save_ordered(order, found)
    end(found.findings, not_accepted=found.not_accepted)


def _require_parts_alone(n_jobs: int, folds: int | None, residuals: str) -> None:
    """End with a line on stderr where something was asked for that a table in parts does not give."""
    for given, why in (
        (n_jobs > 1, "is of one job"),
        (folds is not None, "holds no rows out: without --folds"),
        (residuals == "parquet", "keeps no residuals: without --residuals"),
    ):
        if given:
            raise typer.BadParameter(why, param_hint="--parts")


def _calibrate_many(orders: Sequence[Order], out: Path | None, executor: Executor | None, as_json: bool) -> None:
    from fg_calib.batch import calibrate_into
    from fg_calib.report.batch import build_jobs_table, exit_code, jobs_document, write_jobs

    clock = time.perf_counter()
    found = calibrate_into(orders, executor)
    seconds = time.perf_counter() - clock
    try:
        if as_json:
            show_json(jobs_document(found, seconds))
        else:
            show_report(build_jobs_table(found, seconds))
    finally:
        if out is not None:
            write_jobs(out, found, seconds)
    for job in found:
        for warning in job.warnings:
            say(f"{job.name}: {warning}")
        for what, reason in job.reasons:
            say(f"{job.name}: {what}: {reason}")
    if code := exit_code(found):
        raise typer.Exit(code)
