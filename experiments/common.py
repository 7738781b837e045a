"""What all experiments share: questions, draws, records, the command line.

An experiment is a list of `Question`. Each has tasks (a cell and a seed), a function that works out one task, a summary
of all rows, and a sentence for the ledger. A record `results/NAME.json` holds of each question the summary, the commit
and versions that made it, and the rows of a few tasks, which `verify.py` works out again.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
MM = 1e-3
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's, which colour-blind eyes tell apart."""

Row = dict[str, Any]
Task = tuple[Any, ...]
N_SAMPLES = 3


@dataclass(frozen=True)
class Question:
    """One question that an experiment answers.

    Attributes:
        name: Key in the record, and what `--only` selects.
        words: The question as the ledger asks it.
        tasks: All tasks, given the number of draws and the first seed.
        work: The row of one task, numbers and strings.
        summarise: The summary of all tasks and their rows.
        answer: The summary in a sentence.
        draws: How many draws the record has, and a quick run.
        figure: Draws the summary into a PNG file, where a figure helps.
        timed: Whether rows are times, which no other machine repeats.
    """

    name: str
    words: str
    tasks: Callable[[int, int], Sequence[Task]]
    work: Callable[[Task], Row]
    summarise: Callable[[Sequence[Task], Sequence[Row]], Row]
    answer: Callable[[Row], str]
    draws: tuple[int, int] = (1, 1)
    figure: Callable[[Row, Path], None] | None = None
    timed: bool = False


def data_folder(name: str) -> Path | None:
    """Folder of real data below `FG_CALIB_DATA`; None where it is missing."""
    folder = Path(os.environ.get("FG_CALIB_DATA", HERE.parents[1] / "shared" / "data")) / name
    return folder if folder.is_dir() else None


def run(questions: Sequence[Question], name: str, doc: str | None, arguments: Sequence[str] | None = None) -> Row:
    """Answer questions from the command line; returns the record."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few draws of each question")
    parser.add_argument("--only", nargs="*", metavar="QUESTION", choices=[q.name for q in questions])
    parser.add_argument("--draws", type=int, help="instead of each question's own number")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the record")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / f"{name}.json"
    record: Row = json.loads(file.read_text()) if file.is_file() else {}
    for question in questions:
        if given.only and question.name not in given.only:
            continue
        n_draws = given.draws or question.draws[given.quick]
        tasks = list(question.tasks(n_draws, given.seed))
        clock = time.perf_counter()
        rows = _over(question.work, tasks, 1 if given.quick or question.timed else given.workers)
        found = rounded(question.summarise(tasks, rows))
        seconds = time.perf_counter() - clock
        command = f"python experiments/{name}.py --only {question.name}" + (
            f" --draws {n_draws}" if given.draws else ""
        )
        samples = [] if question.timed else [[task, row] for task, row in _samples(tasks, rows)]
        record[question.name] = {
            "question": question.words,
            "answer": question.answer(found),
            "command": command,
            **provenance(),
            "seconds": round(seconds, 1),
            "draws": n_draws,
            "found": found,
            "samples": rounded(samples, 10),
        }
        file.write_text(json.dumps(record, indent=1) + "\n")
        if question.figure is not None:
            question.figure(found, given.out / f"{name}_{question.name}.png")
        print(f"{question.words}\n  {record[question.name]['answer']}  ({seconds:.0f} s)")
    return record


def _samples(tasks: Sequence[Task], rows: Sequence[Row]) -> list[tuple[Task, Row]]:
    """The first task of a few cells, evenly over all."""
    chosen = sorted({round(k) for k in np.linspace(0, len(tasks) - 1, min(N_SAMPLES, len(tasks)))})
    return [(tasks[k], rows[k]) for k in chosen]


def _over(work: Callable[[Task], Row], tasks: Sequence[Task], workers: int) -> list[Row]:
    if workers <= 1:
        return [one(work, task) for task in tasks]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(one, [work] * len(tasks), tasks, chunksize=max(1, len(tasks) // (8 * workers))))


def one(work: Callable[[Task], Row], task: Task) -> Row:
    """The row of one task, with one BLAS thread."""
    with threadpool_limits(limits=1):
        return work(task)


def provenance() -> Row:
    """Commit, date and versions of what a record was made with."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=False).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":!results", ":!README.md")
    names = ("gtsam", "numba", "numpy", "scipy")
    return {
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + ("-dirty" if changed else ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in names}},
    }


def rounded(value: Any, digits: int = 6) -> Any:
    """A value for JSON: numbers to some digits, not finite ones as None."""
    if isinstance(value, Mapping):
        return {str(key): rounded(v, digits) for key, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [rounded(v, digits) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def by_cell(tasks: Sequence[Task], rows: Sequence[Row]) -> dict[str, dict[str, np.ndarray]]:
    """Arrays of every value by cell, a task's first entry."""
    cells: dict[str, list[Row]] = {}
    for (cell, *_), row in zip(tasks, rows, strict=True):
        cells.setdefault(str(cell), []).append(row)
    return {cell: {key: np.array([row[key] for row in of]) for key in of[0]} for cell, of in cells.items()}


def spread(values: ArrayLike) -> dict[str, float]:
    """Median, 5 and 95 % quantiles, and root mean square over draws; what is not finite counts as infinite."""
    x = np.asarray(values, dtype=np.float64)
    x = np.where(np.isfinite(x), x, np.inf)
    low, median, high = np.quantile(x, [0.05, 0.5, 0.95], method="nearest")
    return {"median": float(median), "p5": float(low), "p95": float(high), "rms": rms(x)}


def rms(values: ArrayLike) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.asarray(values, dtype=np.float64) ** 2)))


def clean(axes: Axes) -> None:
    """Remove the frame above and on the right."""
    axes.spines[["top", "right"]].set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() in ("log", "symlog"):
            axis.set_major_formatter("{x:g}")
