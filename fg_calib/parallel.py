"""Threads of kernels and BLAS, and many calls of a function on any executor of `concurrent.futures`.

BLAS sums in another order with every number of threads, which changes the last digits: public functions limit it to
one. Kernels spread fixed parts over all processors (`kinematics.over_spans`), so results do not depend on their number.
A worker process that dies costs its own job: the jobs that its pool has lost run once more, each on a fresh process.
"""

import logging
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import field
from functools import cache, wraps
from multiprocessing import get_context, parent_process
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController, threadpool_limits

from fg_calib.inputs import CalibrationError, InputError, Record, check_number, checked, expect, printable, shown

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

THREADS, POLARS_THREADS = "FG_CALIB_THREADS", "POLARS_MAX_THREADS"
"""The environment variables that set the number of threads of kernels, and of polars."""

MOST = 1000
"""The largest number of threads, and of processes."""

DIED = "its process died, twice; is there enough memory, and is a script guarded by __name__ == '__main__'?"

listener: ContextVar[Callable[[str, int, int], None]] = ContextVar("listener", default=lambda _what, _done, _of: None)
"""Takes what is being done, how many parts of it are done, and how many there are (0: unknown)."""


def tell(what: str, done: int = 0, of: int = 0) -> None:
    """Report progress to the listener.

    Args:
        what: Task in a few words.
        done: Number of finished parts.
        of: Number of all parts; 0 where it is unknown.
    """
    listener.get()(what, done, of)


@cache
def processors() -> int:
    """Number of processors that this process may use: as many as the system grants, or as `THREADS` says.

    Raises:
        InputError: `THREADS` is no number from 1 to `MOST`.
    """
    if given := _threads_in(THREADS):
        return given
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def _threads_in(variable: str) -> int:
    """The number in an environment variable; 0 where it is not set."""
    given = os.environ.get(variable, "")
    if given and (not given.isdecimal() or not 0.0 < float(given) <= MOST):
        raise InputError(f"{variable} in the environment", f"found {shown(given)}", f"a number from 1 to {MOST}")
    return int(given or 0)


class _OneThread:
    """A context that may be entered again inside itself and from several threads: the last to leave lifts the limit."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._limit = _controlled().limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                _controlled()
                self._limit.restore_original_limits()


one_blas_thread = _OneThread()
"""`with one_blas_thread:`"""


def single_threaded(function: Callable[P, R]) -> Callable[P, R]:
    """A function with its arguments checked and BLAS on one thread; every public function that computes is one."""

    @checked
    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_blas_thread:
            return function(*args, **kwargs)

    return limited


def _controlled() -> ThreadpoolController:
    """The loaded BLAS libraries; threadpoolctl lets one thread alone set limits, which is this one from now on."""
    libraries = _libraries()
    for library in libraries.lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)
    return libraries


@cache
def _libraries() -> ThreadpoolController:
    import numpy  # noqa: F401  only a library that is loaded can be limited,
    import scipy.linalg  # noqa: F401  and scipy has a BLAS of its own

    return ThreadpoolController()


_forked_from_polars = False


def _note_fork() -> None:
    global _forked_from_polars  # noqa: PLW0603
    _forked_from_polars = "polars" in sys.modules


os.register_at_fork(after_in_child=_note_fork)


def require_polars(place: str) -> None:
    """Check that polars works here: in a fork of a process that has loaded it, it waits for threads without end.

    Args:
        place: File that is read or written, for messages.

    Raises:
        InputError: Polars does not work here, or `POLARS_THREADS` is no number from 1 to `MOST`.
    """
    _threads_in(POLARS_THREADS)
    found = "polars does not work in a fork of a process that has loaded it"
    expect(not _forked_from_polars, place, found, hint='use multiprocessing.get_context("spawn") or "forkserver"')


class Failure(Record):
    """A job without a result.

    Attributes:
        job: Its name.
        reason: Why, in one line.
        trace: The traceback of an unexpected error; else empty.
    """

    job: str
    reason: str
    trace: str = field(default="", repr=False)


@checked
def map_jobs(
    function: Callable[[T], R],
    jobs: Iterable[T],
    executor: Executor | None = None,
    *,
    names: Sequence[str] | None = None,
) -> list[R | Failure]:
    """Call a function with each job.

    Args:
        function: Takes a job; worker processes must be able to import it.
        jobs: Any number of picklable objects.
        executor: Where: `local_processes(n)`, or any other, Dask's too; this process if None.
        names: Name of each job, for failures; `job 1`, `job 2`, ... if None.

    Returns:
        What the function returned, or a failure, in the order of the jobs.
    """
    given = list(jobs)
    named = [f"job {k + 1}" for k in range(len(given))] if names is None else list(names)
    calls = [_submit(executor, function, *both) for both in zip(given, named, strict=True)]
    results: list[R | Failure] = []
    for k, result in enumerate(calls):
        tell("calibrating", k, len(given))
        try:
            results.append(result())
        except BrokenExecutor:
            results.append(Failure(named[k], DIED))
        except Exception as error:  # of the executor, or of what cannot be pickled
            results.append(Failure(named[k], _reason(error)))
    for k in [k for k, result in enumerate(results) if isinstance(result, Failure) and result.reason == DIED]:
        with suppress(BrokenExecutor, InputError), local_processes(1) as fresh:
            results[k] = fresh.submit(_call, function, given[k], named[k]).result()
    return results


def _submit(executor: Executor | None, function: Callable[[T], R], job: T, name: str) -> Callable[[], R | Failure]:
    """Start a job: its result is a future, or a call to be made later where there is no executor."""
    if executor is None:
        return lambda: _call(function, job, name)
    try:
        return executor.submit(_call, function, job, name).result
    except Exception as error:  # the executor is broken, or was shut down
        refused: Future[R | Failure] = Future()
        refused.set_exception(error)
        return refused.result


def _call(function: Callable[[T], R], job: T, name: str) -> R | Failure:
    """Call the function on a worker; an exception, which may be impossible to pickle, becomes a failure."""
    try:
        return function(job)
    except (Exception, SystemExit) as error:
        ours = isinstance(error, CalibrationError | MemoryError)
        return Failure(name, _reason(error), "" if ours else traceback.format_exc())


def _reason(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return "there is not enough memory for it"
    return str(error) if isinstance(error, CalibrationError) else printable(f"{type(error).__name__}: {error}")


@checked
def local_processes(n_workers: int) -> ProcessPoolExecutor:
    """An executor of worker processes on this machine, for a `with` block.

    The processes are spawned, as the threads of libraries survive no fork, and share the machine's processors. A script
    needs `if __name__ == "__main__":`, as its workers import it.

    Args:
        n_workers: Number of processes.

    Raises:
        InputError: The number of processes is no number from 1 to 1000, or this machine starts none.
    """
    check_number("workers", n_workers, above=True, whole=True, most=MOST)
    n_threads = (max(1, processors() // n_workers),)
    try:
        return ProcessPoolExecutor(n_workers, get_context("spawn"), _start_worker, n_threads)
    except OSError as error:  # a broken pipe would be taken for one that the user closed
        raise InputError("workers", f"no process starts: {error}", "none, which runs the jobs here") from None


def _start_worker(n_threads: int) -> None:
    """Limit a worker's threads, and end it when the process that started it ends."""
    os.environ |= {THREADS: str(n_threads), POLARS_THREADS: str(n_threads)}
    threadpool_limits(1, user_api="blas")
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    parent = parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
