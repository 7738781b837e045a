"""Many jobs, one after the other or on any executor: in Python, and each with a folder of its own.

with local_processes(4) as executor:
found = calibrate_jobs(["arm1.yaml", "arm2.yaml"], executor)
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

from fg_calib.arguments import checked
from fg_calib.calibration import Calibration, calibrate_job
from fg_calib.errors import InputError, escaped, shown
from fg_calib.executors import Failure, map_jobs
from fg_calib.io.atomic import require_own, require_writable
from fg_calib.io.job import read_job
from fg_calib.io.parts import JobInParts, read_parts
from fg_calib.job import Job
from fg_calib.progress import keeping_warnings
from fg_calib.report.batch import JOBS_FILES, JobSummary, summary_of
from fg_calib.report.documents import ResidualFile, require_no_input


@checked
def calibrate_jobs(jobs: Sequence[Job | Path | str], executor: Executor | None = None) -> list[Calibration | Failure]:
    """`calibrate_job` of many jobs; one that fails is no matter to the others.

    Each is the same to the last bit wherever it runs. A job that is a path is read where it runs.

    Args:
        jobs: The jobs, or the paths of their files.
        executor: Where they run, such as `local_processes(4)`; one after the other in this process if None.

    Returns:
        In the order of the jobs a calibration, or a failure that says why there is none.

    Raises:
        InputError: The jobs are no list of them, or the executor is none.
    """
    expected = "a list of jobs, such as ['job.yaml', read_job('other.yaml')]"
    if isinstance(jobs, str | bytes | os.PathLike | Job) or not hasattr(jobs, "__iter__"):
        raise InputError("jobs", f"found {shown(jobs)}", expected)
    given = list(jobs)
    for k, job in enumerate(given):
        if not isinstance(job, Job | str | os.PathLike):
            raise InputError(f"jobs[{k}]", f"found {shown(job)}", "a job, or the path of its file")
    paths = [job.path if isinstance(job, Job) else job for job in given]
    names = [f"job {k + 1}" if path is None else str(path) for k, path in enumerate(paths)]
    return map_jobs(calibrate_job, given, executor, names=names)


@dataclass(frozen=True)
class Order:
    """A job whose result is written to a folder.

    Attributes:
        name: Its name among others.
        job: The job's file.
        folder: Where the result is written; nowhere if None.
        folds: Number of folds instead of the job's; None for those.
        report: Whether `report.html` is written too.
        figures: Whether the page's figures are written as files too.
        residuals: How single residuals are written.
    """

    name: str
    job: Path
    folder: Path | None
    folds: int | None = None
    report: bool = False
    figures: bool = False
    residuals: ResidualFile = "csv"


def ordered_job(order: Order) -> Job:
    """The job of an order, read and checked, before anything is calculated.

    Raises:
        InputError: It cannot be read, or its result cannot be written.
    """
    if order.folder is not None:
        require_writable(order.folder)
    given = read_job(order.job)
    if order.folder is not None:
        require_no_input(order.folder, given.path, given.inputs)
    return given if order.folds is None else replace(given, options=replace(given.options, folds=order.folds))


def ordered_parts(order: Order, n_rows: int) -> JobInParts:
    """The job of an order, its table in parts, read and checked as far as its first rows.

    Args:
        order: The order.
        n_rows: Rows of a part.

    Raises:
        InputError: It cannot be read, or not in parts, or its result cannot be written.
    """
    if order.folder is not None:
        require_writable(order.folder)
    given = read_parts(order.job, n_rows)
    if order.folder is not None:
        require_no_input(order.folder, given.path, given.inputs)
    return given


def save_ordered(order: Order, found: Calibration) -> None:
    """Write what an order asks for to its folder, if it has one.

    Raises:
        InputError: The folder cannot be written.
    """
    if order.folder is None:
        return
    found.save(order.folder, residuals=order.residuals)
    if order.report or order.figures:
        from fg_calib.pages import write_report

        write_report(order.folder, page=order.report, figures=order.figures)


def carry_out(order: Order) -> JobSummary:
    """Calibrate and save one of many jobs: what runs on a worker, which sees the files.

    Raises:
        InputError: The job cannot be read, or its folder not be written.
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    clock = time.perf_counter()
    with keeping_warnings() as said:
        found = calibrate_job(ordered_job(order))
        save_ordered(order, found)
    seconds = time.perf_counter() - clock
    return summary_of(order.name, order.job, found.result, found.not_accepted, seconds, said)


def calibrate_into(orders: Sequence[Order], executor: Executor | None = None) -> list[JobSummary]:
    """Carry out many orders; one that fails is no matter to the others.

    Args:
        orders: The orders.
        executor: Where they run; one after the other in this process if None.
    """
    before = saved_in(orders)
    found = map_jobs(carry_out, orders, executor, names=[order.name for order in orders])
    return [
        _failed(order, one, earlier) if isinstance(one, Failure) else one
        for order, one, earlier in zip(orders, found, before, strict=True)
    ]


def _failed(order: Order, failure: Failure, earlier: tuple[int, int] | None) -> JobSummary:
    """The line of an order that has no result.

    Args:
        order: The order.
        failure: Why.
        earlier: What was saved in its folder before, see `saved_in`.
    """
    is_earlier = earlier is not None and saved_in([order]) == [earlier]
    reason = f"{failure.reason}; {EARLIER}" if is_earlier else failure.reason
    return JobSummary(order.name, str(order.job), "failed", reason)


EARLIER = "the result in its folder is of an earlier run"


def saved_in(orders: Sequence[Order]) -> list[tuple[int, int] | None]:
    """Which result is in each order's folder: its inode and time of modification; None where there is none."""
    files = [None if order.folder is None else order.folder / "result.json" for order in orders]
    found = [file.stat() if file is not None and file.exists() else None for file in files]
    return [None if one is None else (one.st_ino, one.st_mtime_ns) for one in found]


def job_names(jobs: Sequence[Path]) -> list[str]:
    """A name for each of many jobs, of which no two are alike: what their folders are called.

    The names of the files without their ending, if these all differ (`a.yaml b.yaml`); else the names of the folders
    that the files are in (`a/job.yaml b/job.yaml`); else both (`a-cold b-cold a-warm` of `a/cold.yaml ...`).

    Args:
        jobs: The jobs' files.

    Raises:
        InputError: Two have the same name nevertheless, or one has a name that no folder of results can have.
    """
    paths = [Path(os.path.abspath(path)) for path in jobs]  # without `..`, which would lead elsewhere
    rules: tuple[Callable[[Path], str], ...] = (
        lambda path: path.stem,
        lambda path: path.parent.name,
        lambda path: f"{path.parent.name}-{path.stem}",
    )
    for rule in rules:
        names = [rule(path) for path in paths]
        if _usable(names):
            return names
    times = Counter(name.casefold() for name in names)
    name = next(name for name in names if times[name.casefold()] > 1 or not _is_folder_name(name))
    alike = [escaped(str(path)) for path, other in zip(jobs, names, strict=True) if other.casefold() == name.casefold()]
    if len(alike) > 1:
        found = f"{', '.join(alike[:3])} would be written to the same folder {name}"
        raise InputError("JOB", found, "files, or folders, of different names")
    raise InputError("JOB", f"{alike[0]} would be written to a folder {name}", "a name that a folder can have")


def _usable(names: Sequence[str]) -> bool:
    """Whether folders beside the files of all jobs can have these names; some file systems tell no capitals apart."""
    different = {name.casefold() for name in (*names, *JOBS_FILES)}
    return len(different) == len(names) + len(JOBS_FILES) and all(map(_is_folder_name, names))


def _is_folder_name(name: str) -> bool:
    """Whether a folder of results can have a name: it leads nowhere else."""
    return name not in ("", ".", "..")


def require_place(folder: Path) -> None:
    """Check that results of many jobs can be written to a folder.

    Raises:
        InputError: They cannot, or files would be replaced that are not of many jobs.
    """
    require_writable(folder)
    require_own(folder, JOBS_FILES)
