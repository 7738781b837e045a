"""Many jobs together: a line of each, as a table for the terminal, as a document and as a CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rich.console import Group, RenderableType

from fg_calib.io.atomic import fill_folder, write_text
from fg_calib.io.result import Result, Rms
from fg_calib.report.shown import FAMILY_UNIT, SHOWN
from fg_calib.report.tables import in_order, indented, line, plain_table

SCHEMA = "fg-calib/jobs/1"

JOBS_FILES = {"jobs.json": b'{\n "schema": "fg-calib/jobs/', "jobs.csv": b"name,job,verdict,"}
"""What is written of many jobs together, and how it begins."""

Verdict = Literal["good", "not accepted", "doubtful", "failed"]

_STYLES = {"good": "", "not accepted": "red", "doubtful": "yellow", "failed": "bold red"}


@dataclass(frozen=True)
class JobSummary:
    """What became of a job among many.

    Attributes:
        name: Its name among them, and of its folder.
        job: The job's file.
        verdict: `good`; `not accepted`: it misses a limit of `accept`; `doubtful`: not to be trusted; `failed`: there
            is no result.
        error: Why there is none; None where there is one.
        findings: Why it is not to be trusted, a line each.
        not_accepted: Limits that it misses, a line each.
        robot: The robot's name; None where it failed, as all below.
        n_configurations: Number of configurations that it was calibrated from.
        rms: Root mean square of residuals after, by kind, of test rows where there are any, [m], [rad] or [px].
        of_test: Whether they are of test rows.
        units: Unit of each kind.
        reduced_chi2: Chi-square over degrees of freedom.
        seconds: What it took, reading and writing included, [s].
        warnings: What was said of it meanwhile, a line each.
    """

    name: str
    job: str
    verdict: Verdict
    error: str | None = None
    findings: tuple[str, ...] = ()
    not_accepted: tuple[str, ...] = ()
    robot: str | None = None
    n_configurations: int | None = None
    rms: dict[str, float] | None = None
    of_test: bool | None = None
    units: dict[str, str] | None = None
    reduced_chi2: float | None = None
    seconds: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """With which `fg-calib calibrate` would end for this job alone."""
        return {"good": 0, "failed": 1}.get(self.verdict, 3)

    @property
    def reasons(self) -> list[tuple[str, str]]:
        """Why it is not good: what is wrong, in the words of the command for a job alone, and why."""
        failed = [] if self.error is None else [("error", self.error)]
        doubtful = [("not to be trusted", finding) for finding in self.findings]
        return [*failed, *doubtful, *(("not accepted", reason) for reason in self.not_accepted)]


def summary_of(
    name: str, job: Path, result: Result, not_accepted: Sequence[str], seconds: float, warnings: Sequence[str]
) -> JobSummary:
    """The line of a job that has a result.

    Args:
        name: Its name among the jobs.
        job: Its file.
        result: Its result.
        not_accepted: Limits that it misses, a line each.
        seconds: What it took.
        warnings: What was said of it meanwhile.
    """
    found = {split: _after(kinds) for split, kinds in result.residual_rms.items()}
    split = "test" if found.get("test") else "train"
    rms = found.get(split, {})
    verdict: Verdict = "doubtful" if result.findings else "not accepted" if not_accepted else "good"
    return JobSummary(
        name=name,
        job=str(job),
        verdict=verdict,
        findings=tuple(result.findings),
        not_accepted=tuple(not_accepted),
        robot=result.robot,
        n_configurations=result.n_configurations,
        rms={kind: after for kind, (after, _) in rms.items()},
        of_test=split == "test",
        units={kind: unit for kind, (_, unit) in rms.items()},
        reduced_chi2=result.reduced_chi2,
        seconds=seconds,
        warnings=tuple(warnings),
    )


def _after(kinds: dict[str, Rms | None]) -> dict[str, tuple[float, str]]:
    """What is left of each kind, and its unit."""
    unit = {kind: FAMILY_UNIT.get(kind.partition(",")[0], "m") for kind in kinds}
    return {
        kind: (rms.after, rms.unit or unit[kind])
        for kind, rms in kinds.items()
        if rms is not None and rms.after is not None
    }


def exit_code(jobs: Sequence[JobSummary]) -> int:
    """The worst of the jobs': 1 if one has no result, else 3 if one is not to be trusted or not accepted, else 0."""
    codes = {job.exit_code for job in jobs}
    return next((code for code in (1, 3) if code in codes), 0)


def jobs_document(jobs: Sequence[JobSummary], seconds: float) -> dict[str, Any]:
    """Many jobs for programs, in [m], [rad] and [px].

    Args:
        jobs: What became of each.
        seconds: What all of them took together, by the clock.
    """
    verdicts: tuple[Verdict, ...] = ("good", "not accepted", "doubtful", "failed")
    return {
        "schema": SCHEMA,
        "n": {verdict: sum(job.verdict == verdict for job in jobs) for verdict in verdicts},
        "exit_code": exit_code(jobs),
        "seconds": seconds,
        "jobs": [asdict(job) for job in jobs],
    }


def write_jobs(folder: Path, jobs: Sequence[JobSummary], seconds: float) -> None:
    """Write `jobs.json` and `jobs.csv` to the folder that has the jobs' folders.

    Args:
        folder: Where to.
        jobs: What became of each.
        seconds: What all of them took together, by the clock.

    Raises:
        InputError: The folder cannot be written.
    """

    def write(into: Path) -> None:
        write_text(into / "jobs.json", json.dumps(jobs_document(jobs, seconds), indent=1, allow_nan=False) + "\n")
        write_text(into / "jobs.csv", _csv(jobs))

    fill_folder(folder, write, JOBS_FILES)


def _csv(jobs: Sequence[JobSummary]) -> str:
    """A row for each job; its RMS by kind, and of which rows it is, in columns of their own."""
    kinds, units = _kinds(jobs), _units(jobs)
    heads = ["name", "job", "verdict", "robot", "n_configurations", "reduced_chi2", "seconds"]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*heads, *(f"rms {kind} [{units[kind]}]" for kind in kinds), "rows", "reason", "warnings"])
    for job in jobs:
        figures = [getattr(job, head) for head in heads]
        said = ["; ".join(why for _, why in job.reasons), "; ".join(job.warnings)]
        table.writerow([*figures, *map((job.rms or {}).get, kinds), _rows(job), *said])
    return text.getvalue()


def _rows(job: JobSummary) -> str:
    """Of which rows a job's RMS is; empty where there is none."""
    return "" if job.of_test is None else "test" if job.of_test else "train"


def _units(jobs: Sequence[JobSummary]) -> dict[str, str]:
    """Unit of each kind of residual."""
    return {kind: unit for job in jobs for kind, unit in (job.units or {}).items()}


def _kinds(jobs: Sequence[JobSummary]) -> list[str]:
    return in_order(dict.fromkeys(kind for job in jobs for kind in job.rms or ()))


def build_jobs_table(jobs: Sequence[JobSummary], seconds: float) -> RenderableType:
    """Many jobs for the terminal: a line of each, then how many are good.

    Args:
        jobs: What became of each.
        seconds: What all of them took together, by the clock.
    """
    kinds, units = _kinds(jobs), _units(jobs)
    heads = [f"{kind} {SHOWN[units[kind]][1]}" for kind in kinds]
    figures = [(head, "right") for head in (*heads, "chi2/dof", "s")]
    of = sorted(set(filter(None, map(_rows, jobs))))
    split = [("rows", "left")] if len(of) > 1 else []
    table = plain_table(("job", "left"), ("verdict", "left"), *split, *figures, ("reason", "left"), wrap=True)
    for job in jobs:
        cells = [_rms(job, kind, units[kind]) for kind in kinds]
        chi2 = "" if job.reduced_chi2 is None else f"{job.reduced_chi2:.3g}"
        took = "" if job.seconds is None else f"{job.seconds:.1f}"
        more = f" (and {len(job.reasons) - 1} more)" if len(job.reasons) > 1 else ""
        reason = job.reasons[0][1] + more if job.reasons else ""
        rows = [_rows(job)] if split else []
        table.add_row(job.name, job.verdict, *rows, *cells, chi2, took, reason, style=_STYLES[job.verdict])
    n = jobs_document(jobs, seconds)["n"]
    counts = ", ".join(f"{count} {verdict}" for verdict, count in n.items() if count)
    notes = [f"RMS after the calibration, of {' or '.join(of)} rows"] if of else []
    return Group(table, *indented(notes), line(f"{len(jobs)} jobs in {seconds:.1f} s: {counts}", "bold"))


def _rms(job: JobSummary, kind: str, unit: str) -> str:
    factor, _, decimals = SHOWN[unit]
    value = (job.rms or {}).get(kind)
    return "" if value is None else f"{value * factor:.{decimals}f}"
