"""The entry point: the commands, and the one door where errors become a line and an exit code.

Exit codes: 0 good; 1 bad input, or the reader of the output has gone; 2 wrong usage; 3 solved, or to be solved, but not
to be trusted; 130 interrupted.
"""

import logging
import os
import sys
from collections.abc import Iterable
from importlib import import_module
from typing import Annotated, NoReturn

import typer

from fg_calib import __version__, inputs
from fg_calib.cli.output import progress, say

COMMANDS = (
    *("init", "inspect", "calibrate", "report", "export", "convert", "correct", "predict", "compare", "check"),
    *("update", "history", "observe", "design", "simulate", "example", "bag", "board"),
)
"""The commands in the order of the help: each is the function of that name."""

MODULES = {
    **{"report": "calibrate", "convert": "export", "correct": "predict", "compare": "inspect", "observe": "inspect"},
    **{"update": "check", "history": "check", "simulate": "init", "example": "init"},
}
"""The modules of commands that are not in that of their name."""


def build_app(commands: Iterable[str] = COMMANDS) -> typer.Typer:
    """The command line with these commands."""
    app = typer.Typer(
        name="fg-calib",
        help="Calibrate a robot arm's geometry, and say how well it is known.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        callback=_options,
    )
    for command in commands:
        app.command()(getattr(import_module(f"fg_calib.cli.{MODULES.get(command, command)}"), command))
    return app


class _Line(logging.Formatter):
    """A logged message as one line."""

    def format(self, record: logging.LogRecord) -> str:
        return inputs.printable(super().format(record))


def run() -> None:
    """Run the command line."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # kernels have threads of their own
    os.environ["PYTHONSAFEPATH"] = "1"  # worker processes import no file of the folder that they are started in
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Line())
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    asked = [command for command in COMMANDS if command in sys.argv[1:2]]  # the others need not be looked at
    try:
        with progress():
            build_app(asked or COMMANDS)(prog_name="fg-calib")
    except inputs.CalibrationError as error:
        _fail(str(error))
    except MemoryError:
        _fail("there is not enough memory for this")
    except OSError as error:
        if error.filename is None:  # of stdout, which Python would flush once more at its end, and fail again
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        _fail(f"{error.filename or 'the output cannot be written'}: {error.strerror or error}")


def _fail(message: str) -> NoReturn:
    """Say in one line why there is no result."""
    say(f"error: {message}")
    sys.exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"fg-calib {__version__}")
        raise typer.Exit


_Version = Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")]


def _options(version: _Version = False) -> None:
    """Calibrate a robot arm's geometry, and say how well it is known."""
