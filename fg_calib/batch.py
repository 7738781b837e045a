"""Many jobs, one after the other or on any executor: in Python, and each with a folder of its own.

with local_processes(4) as executor:
found = calibrate_jobs(["arm1.yaml", "arm2.yaml"], executor)
"""

import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from fg_calib.calibration import Calibration, calibrate_job
from fg_calib.inputs import InputError, Record, checked, escaped, pl, shown
from fg_calib.io import fill_folder, read_job, require_no_input, require_writable
from fg_calib.job import Job
from fg_calib.parallel import Failure, map_jobs

JOBS_FILES = {"jobs.json": b'{\n "schema": "fg-calib/jobs/', "jobs.csv": b"name,job,verdict,"}
"""The files that are written about many jobs together, and how each begins."""

Verdict = Literal["good", "not accepted", "doubtful", "failed"]


@checked
def calibrate_jobs(jobs: Sequence[Job | Path | str], executor: Executor | None = None) -> list[Calibration | Failure]:
    """`calibrate_job` of many jobs; the results do not depend on the executor.

    Args:
        jobs: The jobs, or the paths of their files, which are read where the job runs.
        executor: Where they run, such as `local_processes(4)`; one after the other in this process if None.

    Returns:
        A calibration, or a failure that says why there is none, in the order of the jobs.

    Raises:
        InputError: The jobs are no list of them.
    """
    paths = [job.path if isinstance(job, Job) else job for job in jobs]
    names = [f"job {k + 1}" if path is None else str(path) for k, path in enumerate(paths)]
    return map_jobs(calibrate_job, list(jobs), executor, names=names)


class Order(Record):
    """A job whose result is written to a folder.

    Attributes:
        name: Its name among others.
        job: The job's file.
        folder: Where the result is written; nowhere if None.
        folds: Number of folds instead of the job's; None for those.
        saved: Arguments of `Calibration.save`.
    """

    name: str
    job: Path
    folder: Path | None
    folds: int | None = None
    saved: dict[str, Any] = field(default_factory=dict)

    def carry_out(self, executor: Executor | None = None) -> Calibration:
        """Read and calibrate the job, and write its result.

        Args:
            executor: Where folds are calibrated; in this process if None.

        Raises:
            CalibrationError: There is no result, or it cannot be written.
        """
        if self.folder is not None:
            require_writable(self.folder)
        job = read_job(self.job)
        if self.folder is not None:
            require_no_input(self.folder, job.path, job.inputs)
        if self.folds is not None:
            job = replace(job, options=replace(job.options, folds=self.folds))
        found = calibrate_job(job, executor)
        if self.folder is not None:
            found.save(self.folder, **self.saved)
        return found


class JobSummary(Record):
    """One row of the table of many jobs.

    Attributes:
        name: The job's name among them, and that of its folder.
        job: The job's file.
        verdict: `good`; `not accepted`: a limit of `accept` is exceeded; `doubtful`: not to be trusted; `failed`: there
            is no result.
        error: Why there is none; None where there is one.
        findings: Why it is not to be trusted, a line each.
        not_accepted: Limits that are exceeded, a line each.
        robot: The robot's name; None where the job failed.
        n_configurations: Number of fitted configurations; None where the job failed.
        rms: Root mean square of residuals after the calibration by kind, of test rows if there are any, [m], [rad] or
            [px].
        rows: The rows that `rms` is of: `test`, `train`, or empty.
        units: Unit of each kind.
        reduced_chi2: Chi-square over degrees of freedom.
        seconds: Duration with reading and writing, [s].
    """

    name: str
    job: str
    verdict: Verdict
    error: str | None = None
    findings: tuple[str, ...] = ()
    not_accepted: tuple[str, ...] = ()
    robot: str | None = None
    n_configurations: int | None = None
    rms: dict[str, float] = field(default_factory=dict)
    rows: str = ""
    units: dict[str, str] = field(default_factory=dict)
    reduced_chi2: float | None = None
    seconds: float | None = None

    @property
    def reasons(self) -> list[str]:
        """Why the job is not good, a line each."""
        failed = [] if self.error is None else [f"error: {self.error}"]
        doubtful = [f"not to be trusted: {finding}" for finding in self.findings]
        return [*failed, *doubtful, *(f"not accepted: {reason}" for reason in self.not_accepted)]


def summarise(order: Order) -> JobSummary:
    """Carry out an order on a worker that can read and write the files.

    Raises:
        CalibrationError: There is no result, or it cannot be written.
    """
    clock = time.perf_counter()
    found = order.carry_out()
    result, not_accepted = found.result, found.not_accepted
    rows = "test" if result.rms_after("test") else "train"
    rms = result.rms_after(rows)
    verdict: Verdict = "doubtful" if result.findings else "not accepted" if not_accepted else "good"
    units = {kind: result.unit_of(kind) for kind in rms}
    about = (None, result.findings, not_accepted, result.robot, result.n_configurations, rms, rows, units)
    return JobSummary(order.name, str(order.job), verdict, *about, result.reduced_chi2, time.perf_counter() - clock)


def calibrate_into(orders: Sequence[Order], executor: Executor | None = None) -> list[JobSummary]:
    """Carry out many orders; a failure of one does not affect the others.

    Args:
        orders: The orders.
        executor: Where they run; one after the other in this process if None.
    """
    found = map_jobs(summarise, list(orders), executor, names=[order.name for order in orders])
    return [
        JobSummary(order.name, str(order.job), "failed", one.reason) if isinstance(one, Failure) else one
        for order, one in zip(orders, found, strict=True)
    ]


def exit_code(jobs: Sequence[JobSummary]) -> int:
    """1 if a job has no result, else 3 if one is not to be trusted or not accepted, else 0."""
    codes = {{"good": 0, "failed": 1}.get(job.verdict, 3) for job in jobs}
    return next((code for code in (1, 3) if code in codes), 0)


def jobs_document(jobs: Sequence[JobSummary], seconds: float) -> dict[str, Any]:
    """The content of `jobs.json`, in [m], [rad] and [px].

    Args:
        jobs: The summary of each job.
        seconds: Duration of all of them together, [s].
    """
    counts = {verdict: sum(job.verdict == verdict for job in jobs) for verdict in get_args(Verdict)}
    head = {"schema": "fg-calib/jobs/1", "n": counts, "exit_code": exit_code(jobs), "seconds": seconds}
    return {**head, "jobs": [asdict(job) for job in jobs]}


def write_jobs(folder: Path, jobs: Sequence[JobSummary], seconds: float) -> None:
    """Write `jobs.json` and `jobs.csv` to the folder that has the jobs' folders.

    Args:
        folder: Where to.
        jobs: The summary of each job.
        seconds: Duration of all of them together, [s].

    Raises:
        InputError: The folder cannot be written.
    """
    heads = ("name", "job", "verdict", "robot", "n_configurations", "reduced_chi2", "seconds")
    kinds = {kind: unit for job in jobs for kind, unit in job.units.items()}
    columns = {head: [getattr(job, head) for job in jobs] for head in heads}
    columns |= {f"rms {kind} [{unit}]": [job.rms.get(kind) for job in jobs] for kind, unit in kinds.items()}
    columns |= {"rows": [job.rows for job in jobs], "reason": ["; ".join(job.reasons) for job in jobs]}
    document = json.dumps(jobs_document(jobs, seconds), indent=1, allow_nan=False) + "\n"
    fill_folder(folder, {"jobs.json": document, "jobs.csv": pl.DataFrame(columns).write_csv}, JOBS_FILES)


def job_names(jobs: Sequence[Path]) -> list[str]:
    """A different name for each of many jobs, which its folder gets.

    The names of the files without their ending, if these all differ (`a.yaml b.yaml`); else the names of the folders
    that the files are in (`a/job.yaml b/job.yaml`); else both (`a-cold b-cold a-warm` of `a/cold.yaml ...`).

    Args:
        jobs: The jobs' files.

    Raises:
        InputError: Two have the same name nevertheless.
    """
    paths = [Path(os.path.abspath(path)) for path in jobs]
    stems, folders = [path.stem for path in paths], [path.parent.name for path in paths]
    names = [f"{folder}-{stem}" for folder, stem in zip(folders, stems, strict=True)]
    for rule in (stems, folders, names):
        if len({*(name.casefold() for name in rule), "", *JOBS_FILES}) == len(rule) + 1 + len(JOBS_FILES):
            return rule
    same = max(names, key=names.count)
    found = [escaped(str(path)) for path, name in zip(jobs, names, strict=True) if name == same]
    raise InputError("JOB", f"{', '.join(found[:3])} would be written to the folder {shown(same)}", "different names")
