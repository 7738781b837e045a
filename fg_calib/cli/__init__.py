"""The command line, one module a command: the only place that prints."""

import atexit
import gc
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"
"""The bundled examples, a folder each."""


def main() -> None:
    """Run the command line."""
    gc.set_threshold(100_000)  # each collection looks at all of the many modules, that at the end too
    atexit.register(gc.freeze)
    from fg_calib.cli.entry import run

    run()
