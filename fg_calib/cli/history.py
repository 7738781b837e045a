"""`fg-calib history`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, say, show_json, show_report


def history(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", readable=False, help="A folder that `calibrate` or `update` wrote.")
    ],
    figures: Annotated[
        bool, typer.Option("--figures", help="Write history.svg and history.png there: parameters over time.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", readable=False, help="Write the figures there instead.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show the runs that a calibration came from."""
    from fg_calib.io.atomic import is_folder
    from fg_calib.io.history import history_of
    from fg_calib.report.history import build_history, history_document, write_history

    found = history_of(folder)
    if as_json:
        show_json(history_document(found))
    else:
        show_report(build_history(found))
    if figures or out is not None:
        into = out or (folder if is_folder(folder) else folder.parent)
        write_history(into, found)
        say(f"wrote history.svg and history.png to {into}")
