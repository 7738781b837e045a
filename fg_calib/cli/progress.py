"""A bar on the terminal for what takes long; it is gone before anything else is said."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock, Timer
from typing import TYPE_CHECKING

from fg_calib.errors import printable
from fg_calib.progress import listening

if TYPE_CHECKING:
    from rich.progress import Progress

PATIENCE = 2.0
"""Seconds that pass without a bar."""


class _Bar:
    """Shows what is being done once that has taken long, until it is hidden."""

    def __init__(self) -> None:
        self._what, self._done, self._of = "working", 0, 0
        self._bar: Progress | None = None
        self._lock, self._over = Lock(), False
        self._timer = Timer(PATIENCE, self._show)
        self._timer.daemon = True
        self._timer.start()

    def listen(self, what: str, done: int, of: int) -> None:
        """Take note of what is being done."""
        with self._lock:
            self._what, self._done, self._of = printable(what), done, of
            self._update()

    def hide(self) -> None:
        """Show nothing from now on."""
        with self._lock:
            self._over = True
            self._timer.cancel()
            if self._bar is not None:
                self._bar.stop()
                self._bar = None

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        with self._lock:
            if self._over:
                return
            columns = TextColumn("{task.description}", markup=False), BarColumn(bar_width=30), TimeElapsedColumn()
            console = Console(file=sys.stderr)
            self._bar = Progress(
                *columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False
            )
            self._bar.add_task(self._what, total=None)
            self._update()
            self._bar.start()

    def _update(self) -> None:
        if self._bar is not None:
            (task,) = self._bar.task_ids
            self._bar.update(task, description=self._what, completed=self._done, total=self._of or None)


_shown: list[_Bar] = []


@contextmanager
def progress() -> Iterator[None]:
    """Show on stderr what is being done, where that is a terminal and it takes long."""
    if not sys.stderr.isatty():
        yield
        return
    bar = _Bar()
    _shown.append(bar)
    try:
        with listening(bar.listen):
            yield
    finally:
        hide_progress()


def hide_progress() -> None:
    """End the bar, before something else is printed."""
    while _shown:
        _shown.pop().hide()
