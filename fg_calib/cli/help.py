"""`fg-calib help`."""

from __future__ import annotations

from typing import Annotated, NoReturn, get_args

import typer

from fg_calib.cli.output import say, show_report

_Topic = Annotated[str | None, typer.Argument(metavar="TOPIC", help="The page to show; all topics if none.")]
_Markdown = Annotated[bool, typer.Option("--markdown", help="As Markdown, as the files in docs/ are.")]


def help_(topic: _Topic = None, markdown: _Markdown = False) -> None:
    """Show a page of the documentation: a tutorial, what a job may hold, how to read a report, and more."""
    from fg_calib.report.guide import TOPICS

    if topic is None:
        for name, words in TOPICS.items():
            print(f"fg-calib help {name:{max(map(len, TOPICS))}}  {words}")
        print("fg-calib COMMAND --help says what a command does")
    elif topic not in TOPICS:
        _refuse(topic, list(TOPICS))
    else:
        _show(topic, markdown)


def _show(topic: str, markdown: bool) -> None:
    """Show a page: those of files come from what the readers know, the others are files themselves."""
    from fg_calib.io.reference import Topic
    from fg_calib.report.guide import build_page, read_page
    from fg_calib.report.reference import build_reference, reference_markdown

    generated: Topic | None = next((t for t in get_args(Topic) if t == topic), None)
    if markdown:
        print(reference_markdown(generated) if generated else read_page(topic), end="")
    else:
        show_report(build_reference(generated) if generated else build_page(topic))


def _refuse(topic: str, known: list[str]) -> NoReturn:
    """End with 2 where no page is of a topic."""
    from fg_calib.options import did_you_mean

    hint = did_you_mean(topic, known)
    say(f"error: TOPIC: found {topic!r}, expected one of {', '.join(known)}" + (f"; {hint}" if hint else ""))
    raise typer.Exit(2)
