"""The command line, one module a command: the only place that prints."""

import atexit
import gc
import os
import signal
from pathlib import Path
from types import FrameType

EXAMPLES = Path(__file__).parents[1] / "examples"
"""The bundled examples, a folder each."""


def _interrupt(_signal: int, frame: FrameType | None) -> None:
    """End at once while modules are imported, of which some turn an interruption into another error."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            os._exit(130)
        frame = frame.f_back
    raise KeyboardInterrupt


def main() -> None:
    """Run the command line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a shell ignores interruptions
        signal.signal(signal.SIGINT, _interrupt)
    gc.set_threshold(100_000)  # each collection looks at all of the many modules, that at the end too
    atexit.register(gc.freeze)
    from fg_calib.cli.entry import run

    run()
