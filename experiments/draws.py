"""What experiments that repeat something over many draws share: the option `--workers`, and the draws in order."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits

from fg_calib import Failure, local_processes, map_jobs

Over = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Results of some work on many tasks, in order."""


def add_workers(parser: argparse.ArgumentParser) -> None:
    """The option `--workers`."""
    parser.add_argument("--workers", "--processes", type=int, default=2, metavar="N", help="processes; 1: this one")


@contextmanager
def draws_on(workers: int) -> Iterator[Over]:
    """Work on worker processes that are kept, or with 1 in this process; BLAS has one thread in each."""
    if workers <= 1:
        yield here
    else:
        with local_processes(workers) as executor:
            yield lambda work, tasks: _results(work, tasks, executor)


def here(work: Callable[[Any], Any], tasks: Iterable[Any]) -> list[Any]:
    """Results of some work on many tasks in this process."""
    with threadpool_limits(limits=1):
        return _results(work, tasks, None)


def over_draws(work: Callable[[Any], Any], tasks: Iterable[Any], workers: int) -> list[Any]:
    """Results of many draws in order, on so many processes; a draw that fails ends the experiment."""
    with draws_on(workers) as over:
        return over(work, tasks)


def _results(work: Callable[[Any], Any], tasks: Iterable[Any], executor: Executor | None) -> list[Any]:
    found = map_jobs(work, tasks, executor, what="drawing")
    for one in found:
        if isinstance(one, Failure):
            raise one.error()
    return found
