"""`fg-calib help`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from fg_calib.cli.output import show_report

Topic = Literal["job", "robot", "tables"]

_Topic = Annotated[Topic | None, typer.Argument(metavar="TOPIC", help="job, robot or tables; the topics if none.")]
_Markdown = Annotated[bool, typer.Option("--markdown", help="As Markdown, as the files in docs/ are.")]


def help_(topic: _Topic = None, markdown: _Markdown = False) -> None:
    """Say what a job, a robot file or a table may hold: every key with its default, and every column."""
    if topic is None:
        print("fg-calib help job      every key of a calibration job")
        print("fg-calib help robot    every key of a robot file")
        print("fg-calib help tables   every column that means something")
        print("fg-calib COMMAND --help says what a command does")
        return
    from fg_calib.report.reference import build_reference, reference_markdown

    if markdown:
        print(reference_markdown(topic), end="")
    else:
        show_report(build_reference(topic))
