"""Compilation of the kernels by numba, cached between processes where a folder can be written."""

import logging
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
from numba.core import config, event
from numba.core.runtime import rtsys as runtime

from fg_calib.inputs import InputError

logger = logging.getLogger("fg_calib.robot.kernels")

if config.DISABLE_JIT:  # integers of numpy overflow where those of the compiled kernels have 64 bits
    raise InputError("NUMBA_DISABLE_JIT in the environment", f"found {os.environ.get('NUMBA_DISABLE_JIT')!r}", "none")

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
"""Options of all kernels: without the GIL, with fused multiply-adds."""


class _CompileNotice(event.Listener):  # type: ignore[misc]
    """A warning, once, when numba starts to compile: why the program is silent for some seconds."""

    said, cached = False, True

    def on_start(self, event: object) -> None:
        """Numba begins to compile; a kernel found in its cache does not come here."""
        if not _CompileNotice.said:
            _CompileNotice.said = True
            each_time = "each time, unless NUMBA_CACHE_DIR is a folder that can be written"
            often = "once an installation" if _CompileNotice.cached else each_time
            logger.warning("compiling the kernels: some seconds, %s", often)

    def on_end(self, event: object) -> None:
        """Numba is done with one function."""


event.register("numba:compile", _CompileNotice())


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel with numba, cached where a folder can be written."""
    try:
        kernel: Any = numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        _CompileNotice.cached = False
        return numba.njit(**_OPTIONS)(function)
    if hasattr(kernel._cache, "_load_overload"):
        kernel._cache.load_overload = partial(_load_overload, kernel._cache)
    return kernel


def _load_overload(cache: Any, signature: object, target_context: Any) -> Any:
    """A cached kernel, loaded with numba's runtime alone: all that compiling needs takes 0.5 s longer.

    None where the cache does not have the signature.
    """
    runtime.initialize(target_context)
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target_context)


def part(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a part that kernels call, and Python does not: it is kept in their caches, without a Python wrapper."""
    options = _OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True} | options
    return numba.njit(**options)(function)


inlined = partial(part, forceinline=True)
"""A `part` inlined where it must see its caller's constants, or is faster in its place."""
