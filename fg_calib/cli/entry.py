"""The entry point: the commands, and the one door where errors become a line and an exit code.

Exit codes: 0 good; 1 bad input; 2 wrong usage; 3 solved, but not to be trusted.
"""

from __future__ import annotations

import atexit
import errno
import gc
import io
import logging
import os
import sys
from typing import Annotated, NoReturn

import typer

from fg_calib import __version__
from fg_calib.cli.calibrate import calibrate
from fg_calib.cli.compare import compare
from fg_calib.cli.example import example
from fg_calib.cli.observe import observe
from fg_calib.cli.simulate import simulate
from fg_calib.errors import CalibrationError

app = typer.Typer(
    name="fg-calib",
    help="Calibrate a robot arm's geometry, and say how well it is known.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (calibrate, compare, observe, simulate, example):
    app.command()(command)


_OBJECTS_BEFORE_GARBAGE = 500_000
"""New objects after which garbage is looked for: twice what a calibration and its imports make."""


def main() -> None:
    """Run the command line.

    Garbage is looked for seldom, and not at the end: among all that imports keep, it took a quarter of a short command.
    """
    gc.set_threshold(_OBJECTS_BEFORE_GARBAGE)
    atexit.register(gc.freeze)
    logging.basicConfig(stream=sys.stderr, format="%(message)s", level=logging.WARNING)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a letter gets a question mark
            stream.reconfigure(errors="replace")
    try:
        try:
            app(prog_name="fg-calib")
        finally:
            sys.stdout.flush()
    except CalibrationError as error:
        _fail(str(error))
    except BrokenPipeError:  # the reader of our output has gone
        sys.stderr.close()
        sys.exit(1)
    except MemoryError:
        _fail("there is not enough memory for this")
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - what could not be printed is not tried again at exit
        _fail(f"the output cannot be written: {error.strerror}")


def _fail(message: str) -> NoReturn:
    """Say in one line why there is no result; control characters from files are none of the terminal's."""
    print("error: " + "".join(c if c.isprintable() else "?" for c in message), file=sys.stderr)
    sys.exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"fg-calib {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Calibrate a robot arm's geometry, and say how well it is known."""
