"""Shared by all commands: options, output of reports, JSON and progress, exit codes."""

import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from fg_calib import io, report
from fg_calib.inputs import AngleUnit, LengthUnit, printable


def argument(metavar: str, about: str) -> Any:
    """A positional argument of a command; whether a file can be read is for its reader to say."""
    return typer.Argument(metavar=metavar, readable=False, help=about)


def option(name: str, metavar: str | None, about: str, **limits: Any) -> Any:
    """An option of a command.

    Args:
        name: Such as `--out`.
        metavar: The placeholder of its value in the help; None for a switch or a choice.
        about: The line of help.
        limits: `min` of a number, `parser` of text.
    """
    return typer.Option(name, metavar=metavar, readable=False, help=about, **limits)


def quantity(name: str, unit: Literal["m", "rad"], about: str) -> Any:
    """An option that takes a number with its unit."""
    metavar = {"m": "LENGTH", "rad": "ANGLE"}[unit]
    return option(name, metavar, about, parser=lambda text: io.quantity(text, unit, None, name))


Json = Annotated[bool, option("--json", None, "Print the result as JSON on stdout, and nothing else there.")]
BaseLink = Annotated[str | None, option("--base-link", "LINK", "Where the chain of a URDF starts.")]
TipLink = Annotated[str | None, option("--tip-link", "LINK", "Where the chain of a URDF ends.")]
ResultFolder = Annotated[Path, argument("RESULT", "What `calibrate --out` wrote.")]
Length = Annotated[LengthUnit, option("--length", None, "Unit of lengths in the tables.")]
Angle = Annotated[AngleUnit, option("--angle", None, "Unit of angles in the tables, joint values included.")]
Seed = Annotated[int, option("--seed", None, "Seed of all random draws.", min=0)]

_stop_progress: list[Any] = []


@contextmanager
def progress() -> Iterator[None]:
    """Show progress on stderr, if that is a terminal, until something is printed."""
    if not sys.stderr.isatty():
        yield
        return
    from fg_calib.parallel import listener

    with Console(file=sys.stderr).status("working") as status:
        listener.set(lambda what, done, of: status.update(printable(f"{what} {done} of {of}" if of else what)))
        _stop_progress.append(status.stop)
        yield


def _hide_progress() -> None:
    while _stop_progress:
        _stop_progress.pop()()


def say(text: str) -> None:
    """Print a line on stderr, without control characters that names in files may hold."""
    _hide_progress()
    print(printable(text), file=sys.stderr)


def show(text: str) -> None:
    """Print text on stdout as it is."""
    _hide_progress()
    print(text)


def show_json(document: dict[str, Any]) -> None:
    """Print a document as JSON."""
    show(json.dumps(document, allow_nan=False))


def show_result(as_json: bool, document: Callable[..., dict[str, Any]], build: Callable[..., Any], *of: Any) -> None:
    """Print a result as JSON, or as a report as wide as the terminal or `COLUMNS` (`WIDTH` in a pipe).

    Args:
        as_json: Whether as JSON.
        document: Makes the document.
        build: Makes the report.
        of: Arguments of both.
    """
    if as_json:
        show_json(document(*of))
        return
    shown = build(*of)
    _hide_progress()
    given = Console().is_terminal or "COLUMNS" in os.environ
    Console(highlight=False, width=report.width_for(shown, Console().width if given else report.WIDTH)).print(shown)


def names_in(text: str) -> list[str]:
    """The names in a list with commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def end(findings: Sequence[str], what: str = "not to be trusted", not_accepted: Sequence[str] = ()) -> None:
    """Print on stderr why a result is not to be trusted or not accepted; exit with 3 if there is a reason."""
    for finding in findings:
        say(f"{what}: {finding}")
    for reason in not_accepted:
        say(f"not accepted: {reason}")
    if findings or not_accepted:
        raise typer.Exit(3)


def say_next(names: Sequence[str], folder: Path) -> None:
    """Print on stderr which files were written, and the command that calibrates them."""
    say(f"wrote {', '.join(names)} to {folder}")
    job, result = (shlex.quote(str(folder / name)) for name in ("calibration.yaml", "result"))
    say(f"now: fg-calib calibrate {job} --out {result}")
