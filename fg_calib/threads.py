"""How many processors this process may use, and BLAS on one thread: a result does not depend on how many there are.

BLAS sums in another order with every number of threads, which changes the last digits. What is worth several
processors is spread over them in fixed parts (`kinematics.over_spans`), so more threads in BLAS would gain little.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController, threadpool_limits

from fg_calib.errors import InputError, shown

P = ParamSpec("P")
R = TypeVar("R")


class _OneThread:
    """A context that may be entered again inside itself and from several threads: the last to leave lifts the limit."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                _take_control()
                self._limit = _libraries().limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                _take_control()
                self._limit.restore_original_limits()


one_blas_thread = _OneThread()
"""`with one_blas_thread:`"""


def single_threaded(function: Callable[P, R]) -> Callable[P, R]:
    """A function that runs with BLAS on one thread; every public function that computes is one."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_blas_thread:
            return function(*args, **kwargs)

    return limited


def _take_control() -> None:
    """Let this thread set limits: some versions of threadpoolctl ignore all threads but the first that did."""
    for library in _libraries().lib_controllers:
        clear = getattr(library, "clear_controlling_thread", None)
        if clear is not None:
            clear(force=True)


THREADS = "FG_CALIB_THREADS"
"""The environment variable that says on how many threads kernels run: fewer where processes share a machine."""

MOST = 1000
"""Threads of a process at most, and processes: libraries that are asked for more start for minutes."""

_OF_LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What BLAS looks at when it is loaded."""


@cache
def processors() -> int:
    """Processors that this process may use: those that the system lets it have, or as many as `THREADS` says.

    Raises:
        InputError: `THREADS` is no number above 0, or more than `MOST`.
    """
    given = os.environ.get(THREADS, "")
    if not given:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    if not given.isdecimal() or not 0.0 < float(given) <= MOST:
        raise InputError(f"{THREADS} in the environment", f"found {shown(given)}", f"a number from 1 to {MOST}")
    return int(given)


def limit_threads(n: int) -> None:
    """Let this process, in which nothing has been computed yet, have so many threads for kernels, and one for BLAS."""
    os.environ |= dict.fromkeys(_OF_LIBRARIES, "1") | {THREADS: str(n), "POLARS_MAX_THREADS": str(n)}
    if "numpy" in sys.modules:  # whose BLAS has looked already
        threadpool_limits(1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    import numpy  # noqa: F401  only a library that is loaded can be limited,
    import scipy.linalg  # noqa: F401  and scipy has a BLAS of its own

    return ThreadpoolController()
