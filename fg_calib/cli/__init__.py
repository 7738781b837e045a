"""The command line, one module a command: the only place that prints."""

import os
import signal
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"
"""The bundled examples, a folder each."""


def end_at_once(*_: object) -> None:
    """End this process by an interrupt; polars, which listens too, passes it on to a handler but not to the system."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGINT)


def main() -> None:
    """Run the command line.

    An interrupt (Ctrl-C) ends the process at once: an exception would be lost, or a traceback, while libraries in C
    are loaded. What it leaves half written, the next command that writes there clears away.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not where the caller has interrupts ignored
        signal.signal(signal.SIGINT, end_at_once)
    try:
        from fg_calib.cli.entry import run

        run()
    finally:
        signal.signal(signal.SIGINT, before)
