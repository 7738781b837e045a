"""Many jobs on any executor of `concurrent.futures`: this process, processes of this machine, or a Dask cluster.

A job is a function of one thing that can be pickled. Each has an outcome: what the function returns, or a `Failure`.
The failure of one is no matter to the others, be it an error or the death of the worker process that it ran on.

When a worker process dies, a `ProcessPoolExecutor` gives up all that it was given. Here at most a few jobs more than
there are workers are under way at a time, so that few come into question. Each of these runs again alone, on fresh
processes, twice at most: those that were only near are done then, and one that ends its process each time is named.
Dask does the same by itself.
"""

from __future__ import annotations

import logging
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from threading import Lock, Thread, current_thread, main_thread
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

from fg_calib.arguments import checked
from fg_calib.errors import CalibrationError, InputError, printable, shown
from fg_calib.options import check_number
from fg_calib.progress import tell
from fg_calib.threads import MOST, limit_threads, processors

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_log = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

RESUBMISSIONS = 2
"""How often a job whose worker process died runs again."""

UNDER_WAY = 1000
"""Jobs that an executor has at a time, unless it says how many workers it has."""

PATIENCE = 30.0
"""Seconds in which a scheduler must answer."""

KILLED = f"the process that it ran on died, {1 + RESUBMISSIONS} times of {1 + RESUBMISSIONS}"
HINT_KILLED = "is there enough memory for it, and can other processes read the job?"
CANCELLED = "the executor gave it up, as where a scheduler ends"
_LOOK = 1.0
"""Seconds after which one looks whether somebody else gave jobs up."""

NO_FUTURE = TypeError("submit of the executor returned no future of its own for each job")
NO_WORKERS = "worker processes died, and no others can be started"
HINT_NO_WORKERS = (
    'local_processes has fresh ones; a script must be a file, as they import it, with `if __name__ == "__main__":`'
)


@dataclass(frozen=True)
class Failure:
    """A job that has no result.

    Attributes:
        job: Its name.
        reason: Why, in one line.
        trace: Where it happened, if that was no error of the package's own kinds; else empty.
    """

    job: str
    reason: str
    trace: str = field(default="", repr=False)

    def error(self) -> CalibrationError | RuntimeError:
        """An exception to raise where all jobs are needed, with the trace as a note."""
        text = f"{self.job}: {self.reason}"
        if not self.trace:
            return CalibrationError(text)
        found = RuntimeError(text)
        found.add_note(self.trace)
        return found


@checked
def map_jobs(
    function: Callable[[T], R],
    jobs: Iterable[T],
    executor: Executor | None = None,
    *,
    names: Sequence[str] | None = None,
    what: str = "calibrating",
) -> list[R | Failure]:
    """What a function returns of each job, or why it does not, in the order of the jobs.

    Args:
        function: What is done with a job; other processes must be able to import it.
        jobs: Any number of things that can be pickled.
        executor: Where: `local_processes`, `dask_executor`, or any other; one after the other in this process if None.
        names: Of the jobs, for failures; `job 1`, `job 2`, ... if None.
        what: What is being done, in a few words, for who listens to progress.

    Raises:
        InputError: The jobs are no list, the executor is none, or there are more or fewer names than jobs.
    """
    if not isinstance(jobs, Iterable):
        raise InputError("jobs", f"found {shown(jobs)}", "a list of them, or whatever hands out one after the other")
    given = list(jobs)
    if names is not None and (isinstance(names, str) or not isinstance(names, Iterable)):
        raise InputError("names", f"found {shown(names)}", "a list of text")
    named = [f"job {k + 1}" for k in range(len(given))] if names is None else list(map(str, names))
    if len(named) != len(given):
        raise InputError("names", f"found {len(named)}", f"{len(given)}, one for each job")
    if executor is None:
        found = []
        for k, (job, name) in enumerate(zip(given, named, strict=True)):
            tell(what, k, len(given))
            found.append(_attempt(function, job, name))
        return found
    if not isinstance(executor, Executor):
        expected = "an executor of concurrent.futures, such as local_processes(4)"
        raise InputError("executor", f"found {shown(executor)}", expected)
    return _Run(function, given, named, executor, what).outcomes()


def _attempt(function: Callable[[T], R], job: T, name: str) -> R | Failure:
    """What runs on a worker: no exception leaves it, as many cannot be pickled, but Ctrl-C where that may be."""
    try:
        return function(job)
    except (CalibrationError, MemoryError) as error:
        return Failure(name, _reason(error))
    except (Exception, SystemExit) as error:
        return Failure(name, _reason(error), traceback.format_exc())
    except KeyboardInterrupt as error:
        if current_thread() is main_thread() and parent_process() is None:
            raise
        return Failure(name, _reason(error), traceback.format_exc())


def _reason(error: BaseException) -> str:
    """An exception in one line."""
    if isinstance(error, CalibrationError):
        return str(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory for it"
    try:
        text = str(error)
    except Exception:  # one of somebody's own
        text = "it cannot say why"
    return printable(f"{type(error).__name__}: {text}".rstrip(": "))


class _Run(Generic[T, R]):
    """Jobs on their way through an executor."""

    def __init__(
        self, function: Callable[[T], R], jobs: Sequence[T], names: Sequence[str], executor: Executor, what: str
    ) -> None:
        self._function, self._jobs, self._names, self._what = function, jobs, names, what
        self._executor = executor
        self._found: dict[int, R | Failure] = {}

    def outcomes(self) -> list[R | Failure]:
        """All of them, in order."""
        tell(self._what, 0, len(self._jobs))
        waiting = deque(range(len(self._jobs)))
        while waiting:
            lost = self._side_by_side(waiting)
            if lost and not self._has_workers():
                for k in (*lost, *waiting):
                    self._found[k] = Failure(self._names[k], f"{NO_WORKERS}; {HINT_NO_WORKERS}")
                break
            for k in lost:
                self._alone(k)
        return [self._found[k] for k in range(len(self._jobs))]

    def _side_by_side(self, waiting: deque[int]) -> list[int]:
        """Run jobs until none waits or workers have died; returns those that were under way then."""
        most = getattr(self._executor, "under_way", UNDER_WAY)
        most = most if isinstance(most, int) and most > 0 else UNDER_WAY
        under_way: dict[Future[R | Failure], int] = {}
        lost: list[int] = []
        try:
            while under_way or (waiting and not lost):
                while waiting and not lost and len(under_way) < most:
                    k = waiting.popleft()
                    try:
                        future = self._submit(k)
                    except BrokenExecutor:
                        lost.append(k)
                        continue
                    under_way[future if future not in under_way else _refused(NO_FUTURE)] = k
                done = wait(under_way, timeout=_LOOK, return_when=FIRST_COMPLETED).done
                for future in done or [f for f in under_way if f.cancelled()]:  # which nobody may have told of
                    k = under_way.pop(future)
                    if not self._settled(k, future):
                        lost.append(k)
        except BaseException:  # Ctrl-C
            for future in under_way:
                future.cancel()
            raise
        return sorted(lost)

    def _alone(self, k: int) -> None:
        """Run a job that was under way when workers died, with no other beside it."""
        for _ in range(RESUBMISSIONS):
            try:
                if self._settled(k, self._submit(k)):
                    return
            except BrokenExecutor:
                pass
        self._found[k] = Failure(self._names[k], f"{KILLED}; {HINT_KILLED}")

    def _submit(self, k: int) -> Future[R | Failure]:
        try:
            future = self._executor.submit(_attempt, self._function, self._jobs[k], self._names[k])
        except BrokenExecutor:
            raise
        except Exception as error:  # it takes no more, after it was shut down say; what is done stays
            return _refused(error)
        return future if isinstance(future, Future) else _refused(NO_FUTURE)

    def _settled(self, k: int, future: Future[R | Failure]) -> bool:
        """Wait for a job's outcome; False if its worker has died."""
        try:
            self._found[k] = future.result()
        except BrokenExecutor:
            return False
        except CancelledError:
            self._found[k] = Failure(self._names[k], CANCELLED)
        except Exception as error:  # of the executor, or of what cannot be pickled
            self._found[k] = Failure(self._names[k], _reason(error))
        tell(self._what, len(self._found), len(self._jobs))
        return True

    def _has_workers(self) -> bool:
        """Whether the executor still does something."""
        for _ in range(1 + RESUBMISSIONS):
            try:
                return self._executor.submit(int).result() == 0
            except BrokenExecutor:
                pass
        return False


def _refused(error: Exception) -> Future[Any]:
    """A job that an executor did not take."""
    refused: Future[Any] = Future()
    refused.set_exception(error)
    return refused


class LocalProcesses(Executor):
    """Worker processes of this machine, and fresh ones for them when one has died.

    They are started anew (spawned), as threads of libraries survive no fork, and share the machine's processors. They
    end with the process that started them, however that ends.

    Attributes:
        n_workers: Number of processes.
    """

    def __init__(self, n_workers: int) -> None:
        check_number("workers", n_workers, above=True, whole=True, most=MOST)
        self.n_workers = n_workers
        self._context, self._lock = get_context("spawn"), Lock()
        self._start()

    @property
    def under_way(self) -> int:
        """Jobs that it has at a time: one waits for the first worker that is free."""
        return self.n_workers + 1

    def _start(self) -> None:
        self._theirs, self._lifeline = self._context.Pipe(duplex=False)
        share = max(1, processors() // self.n_workers)
        with _interrupts_later():
            self._pool = ProcessPoolExecutor(self.n_workers, self._context, _begin, (self._theirs, share))

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """See `concurrent.futures.Executor.submit`; where worker processes have died there are fresh ones."""
        with self._lock, _interrupts_later():
            try:
                return self._pool.submit(fn, *args, **kwargs)
            except BrokenExecutor:
                self._end(cancel=False)
                self._start()
                return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `concurrent.futures.Executor.shutdown`."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool | None:
        """Wait for what is under way; where an exception ends the block, Ctrl-C say, end it at once."""
        self._end(cancel=kind is not None)
        return None

    def _end(self, *, cancel: bool) -> None:
        if cancel:
            self._lifeline.close()
        self._pool.shutdown(cancel_futures=cancel)
        self._lifeline.close()
        self._theirs.close()


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Within, processes start that Ctrl-C, or a terminal that goes, does not reach: they end with who started them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@checked
def local_processes(n_workers: int) -> LocalProcesses:
    """An executor of worker processes on this machine, for a `with` block.

    A script that uses it is a file, not read from stdin, and needs the usual `if __name__ == "__main__":`, as its
    workers import it.

    Args:
        n_workers: Number of processes.

    Raises:
        InputError: That is no number from 1 to 1000.
    """
    return LocalProcesses(n_workers)


def _begin(lifeline: Connection, n_threads: int) -> None:
    """What a worker process does first.

    Args:
        lifeline: Ends when the process that started it ends, or wants it to.
        n_threads: Its share of the machine's processors.
    """
    limit_threads(n_threads)
    Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    try:
        lifeline.recv()
    except (EOFError, OSError):
        os._exit(1)


@checked
@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor of a Dask cluster, for a `with` block.

    Its workers need this package, of the same version. Whoever reaches a scheduler can run anything on its workers, and
    they send pickles: see `docs/security.md`.

    Args:
        address: Of the scheduler, such as `tcp://10.0.0.5:8786`.

    Raises:
        InputError: Dask is not installed, or no scheduler answers there.
    """
    try:
        from distributed import Client
    except ImportError:
        hint = "pip install 'fg-calib[distributed]'"
        raise InputError("scheduler", "Dask is not installed", "the package distributed", hint) from None
    try:
        client: Any = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        found = printable(str(error)) or "no answer"
        raise InputError(f"scheduler {address}", found, "a Dask scheduler, such as tcp://10.0.0.5:8786") from None
    with client:
        if not client.scheduler_info()["workers"]:
            _log.warning("scheduler %s has no workers yet: jobs wait for some", address)
        yield client.get_executor()
