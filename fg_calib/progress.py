"""What long work tells of how far it is, to whoever listens (the command line shows a bar), and what it warns of."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import get_ident

Listener = Callable[[str, int, int], None]
"""Takes what is being done, how many parts of it are done, and how many there are (0: nobody knows)."""

_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


def tell(what: str, done: int = 0, of: int = 0) -> None:
    """Tell what is being done now.

    Args:
        what: A few words.
        done: Parts of it that are done.
        of: All parts; 0 where nobody knows.
    """
    listener = _LISTENER.get()
    if listener is not None:
        listener(what, done, of)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Let somebody listen meanwhile."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def keeping_warnings() -> Iterator[list[str]]:
    """What the package's log warns of in this thread, kept for whoever asks instead of the process's own streams."""
    said: list[str] = []
    thread = get_ident()

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.thread == thread:
                said.append(record.getMessage())

    log, keep = logging.getLogger("fg_calib"), Keep(logging.WARNING)
    before, log.propagate = log.propagate, False
    log.addHandler(keep)
    try:
        yield said
    finally:
        log.removeHandler(keep)
        log.propagate = before
