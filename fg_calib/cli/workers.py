"""Options that say where many things run side by side, and the executor that they ask for."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, NoReturn

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


_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, the end that a system or a scheduler of jobs asks for, and that of the terminal."""


@contextmanager
def executor_for(workers: int | None, scheduler: str | None, left: Callable[[], str]) -> Iterator[Executor | None]:
    """What was asked for; while it works, what ends the command is an exception, which ends the workers too.

    Args:
        workers: Number of processes of this machine.
        scheduler: Address of a Dask cluster's.
        left: What is said to be left then.
    """
    from fg_calib.executors import dask_executor, local_processes

    if workers is None and scheduler is None:
        yield None
        return
    found = {number: signal.getsignal(number) for number in _ENDING}
    before = {k: handler for k, handler in found.items() if handler in (end_at_once, signal.SIG_DFL)}  # not ignored
    try:
        for number in before:
            signal.signal(number, _interrupt)
        with dask_executor(scheduler) if scheduler is not None else local_processes(workers or 1) as executor:
            yield executor
    except KeyboardInterrupt as interrupt:
        say(f"interrupted; {left()}")
        raise typer.Exit(128 + next(iter(interrupt.args), signal.SIGINT)) from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(number: int, _: object) -> NoReturn:
    raise KeyboardInterrupt(number)
