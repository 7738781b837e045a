"""The entry point: the commands, and the one door where errors become a line and an exit code.

Exit codes: 0 good; 1 bad input; 2 wrong usage; 3 solved, or to be solved, but not to be trusted; 141 nobody reads what
is printed, as of other commands before `head`.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import io
import logging
import os
import re
import resource
import signal
import sys
from collections.abc import Sequence
from typing import Annotated, NoReturn

import typer

from fg_calib import __version__
from fg_calib.cli.bag import bag
from fg_calib.cli.board import board
from fg_calib.cli.calibrate import calibrate
from fg_calib.cli.check import check
from fg_calib.cli.compare import compare
from fg_calib.cli.correct import correct
from fg_calib.cli.design import design
from fg_calib.cli.example import example
from fg_calib.cli.export import export
from fg_calib.cli.help import help_
from fg_calib.cli.history import history
from fg_calib.cli.init import init
from fg_calib.cli.inspect import inspect
from fg_calib.cli.observe import observe
from fg_calib.cli.output import say
from fg_calib.cli.predict import predict
from fg_calib.cli.progress import hide_progress, progress
from fg_calib.cli.report import report
from fg_calib.cli.simulate import simulate
from fg_calib.cli.update import update
from fg_calib.errors import CalibrationError, InputError, printable
from fg_calib.threads import processors

app = typer.Typer(
    name="fg-calib",
    help="Calibrate a robot arm's geometry, and say how well it is known.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (
    init,
    inspect,
    calibrate,
    report,
    export,
    correct,
    predict,
    compare,
    check,
    update,
    history,
    observe,
    design,
    simulate,
    example,
    bag,
    board,
):
    app.command()(command)
app.command(name="help")(help_)


_OBJECTS_BEFORE_GARBAGE = 500_000
"""New objects after which garbage is looked for: twice what a calibration and its imports make."""


_LARGE_ARRAY = 2**23
"""Bytes of an array from which on its memory is the system's again when it goes."""

_M_MMAP_THRESHOLD = -3
"""What glibc calls that setting."""


def _return_memory() -> None:
    """Have glibc give back the memory of large arrays: what it keeps between others made a tenth of a million rows'."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # elsewhere it is not there to be asked
        mallopt(_M_MMAP_THRESHOLD, _LARGE_ARRAY)


def run() -> None:
    """Run the command line.

    Garbage is looked for seldom, and not at the end: among all that imports keep, it took a quarter of a short command.
    """
    gc.set_threshold(_OBJECTS_BEFORE_GARBAGE)
    _return_memory()
    atexit.register(gc.freeze)
    os.environ["MPLBACKEND"] = "agg"  # figures are only written, and what Jupyter asks for need not be installed here
    os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"  # of all that is installed here; finding them takes a while
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # all that it is asked for (`threads`): starting more takes CPU
    _open_streams()
    _show_log()
    _limit_widths()
    try:
        try:
            _require_words(sys.argv[1:])
            _require_resources()
            with progress():
                app(prog_name="fg-calib")
        finally:
            sys.stdout.flush()
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # typer has taken it for a failure
            _close_stdout()
            sys.exit(_READER_GONE)
        raise
    except CalibrationError as error:
        _fail(str(error))
    except MemoryError:
        _fail("there is not enough memory for this")
    except BrokenPipeError:  # the reader of our output has gone
        _close_stdout()
        sys.exit(_READER_GONE)
    except OSError as error:
        _close_stdout()
        what = "the output cannot be written" if error.filename is None else error.filename
        _fail(f"{what}: {error.strerror or error}")


def _open_streams() -> None:
    """Give streams that the caller closed to nobody: files that are opened would take their places.

    A terminal that cannot show a letter gets a question mark.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


class _Line(logging.Formatter):
    """A message of the log as the one line it is."""

    def format(self, record: logging.LogRecord) -> str:
        hide_progress()
        return printable(super().format(record))


def _show_log() -> None:
    """Show warnings of the package on stderr; that matplotlib has no folder for its cache is none of them."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    shown = logging.StreamHandler(sys.stderr)
    shown.setFormatter(_Line())
    logging.basicConfig(handlers=[shown], level=logging.WARNING)


def _require_words(arguments: Sequence[str]) -> None:
    """End with 2 where an argument is empty, as a shell's unset variable is: a path would be the current folder."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        if not argument or re.fullmatch("--[a-z-]+=", argument):
            what = argument[:-1] or (before if before.startswith("--") else "an argument")
            say(f"error: {what} is empty; is a variable of the shell not set?")
            sys.exit(2)


def _limit_widths() -> None:
    """Keep what the environment says of the terminal's size within what a page can have; words say nothing."""
    for name in ("COLUMNS", "LINES", "TERMINAL_WIDTH"):  # the last is typer's, for its help
        given = os.environ.get(name)
        if given is None:
            continue
        if given.isdecimal():
            os.environ[name] = str(min(max(int(given[:9]), _WIDTHS[0]), _WIDTHS[1]))
        else:
            del os.environ[name]


_READER_GONE = 128 + signal.SIGPIPE
"""How shells report a command that ended because nobody reads its output, as `head` does to the one before it."""

_WIDTHS = (20, 1000)
"""Narrowest and widest page."""

_LEAST_FILES = 32
"""Files that are open at once, at most: numba, polars and GTSAM bring libraries."""

_LEAST_ADDRESS_SPACE = 2 * 1024**3
"""Bytes with which a small job can be calibrated: libraries of whom one finds no memory abort instead of saying so."""


def _require_resources() -> None:
    """Check limits on the process's memory (`ulimit -v` or `-d`), its open files and its threads, if there are any.

    Raises:
        InputError: One is so low that libraries could not even be loaded, or no number.
    """
    processors()
    for kind, option in ((resource.RLIMIT_AS, "-v"), (resource.RLIMIT_DATA, "-d")):
        limit, _ = resource.getrlimit(kind)
        if limit != resource.RLIM_INFINITY and limit < _LEAST_ADDRESS_SPACE:
            least = f"at least {_LEAST_ADDRESS_SPACE // 1024**2} MB"
            raise InputError("memory", f"limited to {limit // 1024**2} MB", least, f"see `ulimit {option}`")
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and files < _LEAST_FILES:
        raise InputError("open files", f"limited to {files}", f"at least {_LEAST_FILES}", "see `ulimit -n`")


def _close_stdout() -> None:
    """Give up what could not be printed: it is not tried again at exit."""
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115


def _fail(message: str) -> NoReturn:
    """Say in one line why there is no result."""
    say(f"error: {message}")
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
