"""Libraries that are not to be trusted as they come: with the folder where a program runs, and with a fork.

Some take settings from that folder; they are imported without. Such a folder may be a stranger's, and settings are more
than looks: numba's name the folder of machine code that it runs, matplotlib's start LaTeX.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from fg_calib.errors import InputError


@contextmanager
def without_settings(name: str, variables: str) -> Iterator[None]:
    """Within, a library is imported that would read a file of this name in the current folder; it does not.

    Only where there is such a file is it done from another folder, as that is one for all threads.

    Args:
        name: The file.
        variables: The environment variables that the library reads, for messages.

    Raises:
        InputError: The library refuses a value of one of its variables.
    """
    here = os.open(".", getattr(os, "O_PATH", os.O_RDONLY)) if os.path.lexists(name) else None
    try:
        if here is not None:
            os.chdir(os.path.abspath(os.sep))
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            yield
    except (ValueError, RuntimeError, RuntimeWarning) as error:
        found = str(error).partition("\n")[0].rstrip(".")
        raise InputError(f"{variables} in the environment", found, "values that it takes") from None
    finally:
        if here is not None:
            os.fchdir(here)
            os.close(here)


_forked_from_polars = False


def _note_fork() -> None:
    global _forked_from_polars  # noqa: PLW0603
    _forked_from_polars = "polars" in sys.modules


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def require_polars(place: str) -> None:
    """Check that polars works here: in a fork of a process that has loaded it it waits for threads without end.

    Args:
        place: What is read or written, for messages.

    Raises:
        InputError: It does not.
    """
    if _forked_from_polars:
        found = "polars does not work in a fork of a process that has loaded it"
        raise InputError(place, found, hint='use multiprocessing.get_context("spawn") or "forkserver"')
    threads = os.environ.get("POLARS_MAX_THREADS", "")
    if threads.isdigit() and not int(threads):
        raise InputError("POLARS_MAX_THREADS in the environment", f"found {threads!r}", "a number above 0")
