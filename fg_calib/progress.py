"""What long work tells of how far it is, to whoever listens: the command line, which shows a bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

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
