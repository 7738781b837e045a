"""Options of several commands, and how they show a report, a document or progress, and end."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fg_calib.errors import printable

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import RenderableType

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else there.")]
BaseLink = Annotated[str | None, typer.Option("--base-link", metavar="LINK", help="Where the chain of a URDF starts.")]
TipLink = Annotated[str | None, typer.Option("--tip-link", metavar="LINK", help="Where the chain of a URDF ends.")]
ResultFolder = Annotated[Path, typer.Argument(metavar="RESULT", readable=False, help="What `calibrate --out` wrote.")]
Workers = Annotated[
    int | None, typer.Option("--workers", min=1, metavar="N", help="Run jobs or folds on so many processes.")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Run them on a Dask cluster: tcp://host:8786.")
]

_stop_progress: list[Any] = []


@contextmanager
def progress() -> Iterator[None]:
    """Show on stderr what is being done, if that is a terminal, until something is printed."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    from fg_calib.executors import listener

    with Console(file=sys.stderr).status("working") as status:
        listener.set(lambda what, done, of: status.update(printable(f"{what} {done} of {of}" if of else what)))
        _stop_progress.append(status.stop)
        yield


def _hide_progress() -> None:
    while _stop_progress:
        _stop_progress.pop()()


def say(text: str) -> None:
    """Print a line on stderr; names from files do not steer the terminal."""
    _hide_progress()
    print(printable(text), file=sys.stderr)


def show(text: str) -> None:
    """Print text on stdout as it is."""
    _hide_progress()
    print(text)


def show_json(document: dict[str, Any]) -> None:
    """Print a document as JSON."""
    show(json.dumps(document, allow_nan=False))


def show_report(report: RenderableType) -> None:
    """Print a report as wide as the terminal, or as `COLUMNS` says; a pipe has no width of its own."""
    from rich.console import Console

    from fg_calib.report.tables import WIDTH, width_for

    _hide_progress()
    given = Console().is_terminal or "COLUMNS" in os.environ
    width = width_for(report, Console().width if given else WIDTH)
    Console(highlight=False, width=width).print(report)


def end(findings: Sequence[str], what: str = "not to be trusted", not_accepted: Sequence[str] = ()) -> None:
    """Say on stderr why a result is not to be trusted, or not accepted, and end with 3 if there is a reason."""
    for finding in findings:
        say(f"{what}: {finding}")
    for reason in not_accepted:
        say(f"not accepted: {reason}")
    if findings or not_accepted:
        raise typer.Exit(3)


def say_next(names: Sequence[str], folder: Path) -> None:
    """Say on stderr which files of a job were written to a folder, and how to calibrate it."""
    say(f"wrote {', '.join(names)} to {folder}")
    job, result = (shlex.quote(str(folder / name)) for name in ("calibration.yaml", "result"))
    say(f"now: fg-calib calibrate {job} --out {result}")


@contextmanager
def executor_for(workers: int | None, scheduler: str | None) -> Iterator[Executor | None]:
    """The executor that `--workers` or `--scheduler` asks for; None for this process.

    Raises:
        BadParameter: Both were given.
    """
    from fg_calib.executors import dask_executor, local_processes

    if workers is not None and scheduler is not None:
        raise typer.BadParameter("is of this machine: either this or --scheduler", param_hint="--workers")
    asked = dask_executor(scheduler) if scheduler else local_processes(workers) if workers else nullcontext()
    with asked as executor:
        yield executor
