"""What the commands share: options of several of them, and how a report or document is shown and a command ends."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fg_calib.cli.progress import hide_progress
from fg_calib.errors import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fg_calib.calibration import Calibration

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else there.")]

BaseLink = Annotated[str | None, typer.Option("--base-link", metavar="LINK", help="Where the chain of a URDF starts.")]
TipLink = Annotated[str | None, typer.Option("--tip-link", metavar="LINK", help="Where the chain of a URDF ends.")]


def say(text: str) -> None:
    """Print a line on stderr; what names from files and of folders hold steers no terminal."""
    hide_progress()
    print(printable(text), file=sys.stderr)


def show_json(document: dict[str, Any]) -> None:
    """Print a document as JSON."""
    hide_progress()
    print(json.dumps(document, allow_nan=False))


def show_report(report: RenderableType) -> None:
    """Print a report as wide as the terminal, or as `COLUMNS` says; a pipe has no width of its own."""
    from rich.console import Console

    from fg_calib.report.tables import WIDTH, width_for

    hide_progress()
    given = Console().is_terminal or "COLUMNS" in os.environ
    width = width_for(report, Console().width if given else WIDTH)
    Console(highlight=False, width=width).print(report)


def show_calibration(found: Calibration, as_json: bool) -> None:
    """Print a calibration that was just made: its report, or its result as JSON."""
    if as_json:
        show_json(found.result.document())
    elif found.result.in_parts:
        hide_progress()
        print(found)
    else:
        from fg_calib.report.text import build_report

        show_report(build_report(found.solution, found.uncertainty))


def end(findings: Sequence[str], what: str = "not to be trusted", not_accepted: Sequence[str] = ()) -> None:
    """Say on stderr why a result is not to be trusted, or not accepted, and end with 3 if there is a reason."""
    for finding in findings:
        say(f"{what}: {finding}")
    for reason in not_accepted:
        say(f"not accepted: {reason}")
    if findings or not_accepted:
        raise typer.Exit(3)


def say_next(names: Sequence[str], folder: Path) -> None:
    """Say on stderr which files of a job were written to a folder, and how to calibrate it."""
    say(f"wrote {', '.join(names)} to {folder}")
    job, result = (shlex.quote(str(folder / name)) for name in ("calibration.yaml", "result"))
    say(f"now: fg-calib calibrate {job} --out {result}")
