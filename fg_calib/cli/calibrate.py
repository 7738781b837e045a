"""`fg-calib calibrate` and `report`."""

import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Group

import fg_calib
from fg_calib import io
from fg_calib import report as reports
from fg_calib.cli.output import Json, ResultFolder, argument, end, option, say, show_result

Residuals = Literal["csv", "parquet", "none"]


def calibrate(
    jobs: Annotated[list[Path], argument("JOB", "The job, such as calibration.yaml; or many.")],
    out: Annotated[Path | None, option("--out", "DIR", "Write the result there; of many jobs, folders.")] = None,
    folds: Annotated[int | None, option("--folds", None, "Cross-validate, in so many folds.", min=2)] = None,
    report: Annotated[bool, option("--report", None, "Write report.html there too: one page to pass on.")] = False,
    figures: Annotated[bool, option("--figures", None, "Write the page's figures there too, as SVG files.")] = False,
    residuals: Annotated[Residuals, option("--residuals", None, "How single residuals are written.")] = "csv",
    workers: Annotated[int | None, option("--workers", "N", "Run jobs or folds on so many processes.", min=1)] = None,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib import batch, parallel

    if out is None and (report or figures):
        raise typer.BadParameter("needs --out, the folder to write to", param_hint="--report and --figures")
    several = len(jobs) > 1
    names = batch.job_names(jobs) if several else [""]
    if out is not None and several:
        io.require_writable(out)
    saved = {"report": report, "figures": figures, "residuals": residuals}
    folders = [None if out is None else out / name for name in names]
    orders = [batch.Order(*one, folds, saved) for one in zip(names, jobs, folders, strict=True)]
    with parallel.local_processes(workers) if workers else nullcontext() as executor:
        if several:
            _calibrate_many(orders, out, executor, as_json)
        else:
            show_calibration(orders[0].carry_out(executor), as_json)


def show_calibration(found: "fg_calib.Calibration", as_json: bool) -> None:
    """Print a calibration, and end with 3 where it is not to be trusted or not accepted."""
    show_result(as_json, found.result.document, lambda: reports.build_report(found.report_data))
    end(found.findings, not_accepted=found.not_accepted)


def _calibrate_many(
    orders: "Sequence[fg_calib.batch.Order]", out: Path | None, executor: Executor | None, as_json: bool
) -> None:
    from fg_calib.batch import calibrate_into, exit_code, jobs_document, write_jobs

    clock = time.perf_counter()
    found = calibrate_into(orders, executor)
    seconds = time.perf_counter() - clock
    if out is not None:
        write_jobs(out, found, seconds)
    show_result(as_json, jobs_document, _jobs_table, found, seconds)
    for job in found:
        for reason in job.reasons:
            say(f"{job.name}: {reason}")
    if code := exit_code(found):
        raise typer.Exit(code)


def _jobs_table(jobs: "Sequence[fg_calib.batch.JobSummary]", seconds: float) -> Group:
    """Many jobs for the terminal: a line of each, then how many are good; `seconds` is the duration of all together."""
    units = {kind: unit for job in jobs for kind, unit in job.units.items()}
    kinds, rows = reports.in_order(units), []
    for job in jobs:
        values = [job.rms.get(kind) for kind in kinds]
        reason = "; ".join(job.reasons[:1])
        rows.append((job.name, job.verdict, job.rows, *values, job.reduced_chi2, job.seconds, reason))
    columns = [f"{kind} {reports.shown_in(units[kind]).unit}|{units[kind]}| " for kind in kinds]
    table = reports.table_of(("job", "verdict", "rows", *columns, "chi2/dof|.3g| ", "s|.3g| ", "reason"), rows)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(job.verdict for job in jobs).items())
    total = f"{len(jobs)} jobs in {seconds:.1f} s: {counts}; RMS after the calibration"
    return Group(table, reports.line(total, "bold"))


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
