"""Options that say where many things run side by side, and the executor that they ask for."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from fg_calib.cli import end_at_once
from fg_calib.cli.output import say

if TYPE_CHECKING:
    from concurrent.futures import Executor

Workers = Annotated[
    int | None,
    typer.Option("--workers", min=1, metavar="N", help="Run jobs, folds or instruments on so many processes."),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Run them on a Dask cluster: tcp://host:8786.")
]


def require_one(workers: int | None, scheduler: str | None) -> None:
    """End with a line on stderr where both were asked for."""
    if workers is not None and scheduler is not None:
        raise typer.BadParameter("is of this machine: either this or --scheduler", param_hint="--workers")


@contextmanager
def executor_for(workers: int | None, scheduler: str | None, left: str) -> Iterator[Executor | None]:
    """What was asked for; while it works, Ctrl-C is an exception, which ends the workers too.

    Args:
        workers: Number of processes of this machine.
        scheduler: Address of a Dask cluster's.
        left: What is said to be left after Ctrl-C.
    """
    from fg_calib.executors import dask_executor, local_processes

    if workers is None and scheduler is None:
        yield None
        return
    before = signal.getsignal(signal.SIGINT)
    try:
        if before is end_at_once:  # what `main` has made of it
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with dask_executor(scheduler) if scheduler is not None else local_processes(workers or 1) as executor:
            yield executor
    except KeyboardInterrupt:
        say(f"interrupted; {left}")
        raise typer.Exit(128 + signal.SIGINT) from None
    finally:
        signal.signal(signal.SIGINT, before)
