"""Many calls of one function, one after the other or on any executor of `concurrent.futures`.

A worker process that dies costs its own job: the jobs that its pool has lost are submitted once more, each to a process
of its own. Long work reports its progress to a listener, such as the command line.
"""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Any, TypeVar

from fg_calib.arguments import checked
from fg_calib.errors import CalibrationError, InputError, printable, shown
from fg_calib.options import check_number
from fg_calib.threads import MOST, limit_threads, processors

T = TypeVar("T")
R = TypeVar("R")

SCHEDULER_TIMEOUT_S = 30.0
"""Time in which a scheduler must answer."""

DIED = (
    "the process that it ran on died, twice; is there enough memory, and is a script guarded by __name__ == '__main__'?"
)

listener: ContextVar[Callable[[str, int, int], None]] = ContextVar("listener", default=lambda _what, _done, _of: None)
"""Takes what is being done, how many parts of it are done, and how many there are (0: unknown)."""


def tell(what: str, done: int = 0, of: int = 0) -> None:
    """Report progress.

    Args:
        what: What is being done, in a few words.
        done: Number of finished parts.
        of: Number of all parts; 0 where it is unknown.
    """
    listener.get()(what, done, of)


@dataclass(frozen=True)
class Failure:
    """A job without a result.

    Attributes:
        job: Its name.
        reason: Why, in one line.
        trace: The traceback of an unexpected error; else empty.
    """

    job: str
    reason: str
    trace: str = field(default="", repr=False)

    def error(self) -> CalibrationError | RuntimeError:
        """The exception to raise where all jobs are needed."""
        text = f"{self.job}: {self.reason}"
        if not self.trace:
            return CalibrationError(text)
        error = RuntimeError(text)
        error.add_note(self.trace)
        return error


@checked
def map_jobs(
    function: Callable[[T], R],
    jobs: Iterable[T],
    executor: Executor | None = None,
    *,
    names: Sequence[str] | None = None,
    what: str = "calibrating",
) -> list[R | Failure]:
    """Call a function with each job.

    Args:
        function: Takes a job; worker processes must be able to import it.
        jobs: Any number of picklable objects.
        executor: Where: `local_processes(n)`, `dask_executor(address)`, or any other; this process if None.
        names: Name of each job, for failures; `job 1`, `job 2`, ... if None.
        what: What is being done, for the listener to progress.

    Returns:
        What the function returned, or a failure, in the order of the jobs.

    Raises:
        InputError: The jobs are no list, or there are more or fewer names than jobs.
    """
    if not isinstance(jobs, Iterable):
        raise InputError("jobs", f"found {shown(jobs)}", "a list of them")
    given = list(jobs)
    named = [f"job {k + 1}" for k in range(len(given))] if names is None else list(names)
    if len(named) != len(given):
        raise InputError("names", f"found {len(named)}", f"{len(given)}, one for each job")
    results: list[Any] = [None] * len(given)
    lost = []
    futures = [_submit(executor, function, *both) for both in zip(given, named, strict=True)]
    for k, future in enumerate(futures):
        tell(what, k, len(given))
        try:
            results[k] = future() if callable(future) else future.result()
        except BrokenExecutor:
            lost.append(k)
        except Exception as error:  # of the executor, or of what cannot be pickled
            results[k] = Failure(named[k], _reason(error))
    if lost:
        with ThreadPoolExecutor(min(len(lost), processors())) as pool:
            again = pool.map(lambda k: _call_alone(function, given[k], named[k]), lost)
            for k, result in zip(lost, again, strict=True):
                results[k] = result
    return results


def _submit(executor: Executor | None, function: Callable[[T], R], job: T, name: str) -> Any:
    """A job's future; a call to be made later where there is no executor."""
    if executor is None:
        return lambda: _call(function, job, name)
    try:
        return executor.submit(_call, function, job, name)
    except Exception as error:  # the executor is broken, or was shut down
        refused: Future[Any] = Future()
        refused.set_exception(error)
        return refused


def _call(function: Callable[[T], R], job: T, name: str) -> R | Failure:
    """Call the function on a worker; an exception, which may be impossible to pickle, becomes a failure."""
    try:
        return function(job)
    except (CalibrationError, MemoryError) as error:
        return Failure(name, _reason(error))
    except (Exception, SystemExit) as error:
        return Failure(name, _reason(error), traceback.format_exc())


def _call_alone(function: Callable[[T], R], job: T, name: str) -> R | Failure:
    """Call the function on a process of its own."""
    try:
        with local_processes(1) as executor:
            return executor.submit(_call, function, job, name).result()
    except BrokenExecutor:
        return Failure(name, DIED)


def _reason(error: BaseException) -> str:
    if isinstance(error, CalibrationError):
        return str(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory for it"
    return printable(f"{type(error).__name__}: {error}".rstrip(": "))


@checked
def local_processes(n_workers: int) -> ProcessPoolExecutor:
    """An executor of worker processes on this machine, for a `with` block.

    The processes are spawned, as the threads of libraries survive no fork, and share the machine's processors. A script
    needs `if __name__ == "__main__":`, as its workers import it.

    Args:
        n_workers: Number of processes.

    Raises:
        InputError: It is no number from 1 to 1000.
    """
    check_number("workers", n_workers, above=True, whole=True, most=MOST)
    share = max(1, processors() // n_workers)
    return ProcessPoolExecutor(n_workers, get_context("spawn"), _start_worker, (share,))


def _start_worker(n_threads: int) -> None:
    """Limit a worker's threads, and end it when the process that started it ends."""
    limit_threads(n_threads)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    parent = parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=end_with_parent, daemon=True).start()


@checked
@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor of a Dask cluster, for a `with` block.

    Its workers need the same version of this package. Anyone who reaches a scheduler can run code on its workers.

    Args:
        address: Of the scheduler, such as `tcp://10.0.0.5:8786`.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        hint = "pip install 'fg-calib[distributed]'"
        raise InputError("scheduler", "Dask is not installed", "the package distributed", hint) from None
    try:
        client: Any = Client(address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        found = printable(str(error)) or "no answer"
        raise InputError(f"scheduler {address}", found, "a Dask scheduler, such as tcp://10.0.0.5:8786") from None
    with client:
        yield client.get_executor()
