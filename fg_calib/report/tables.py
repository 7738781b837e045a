"""What all reports share: plain tables and sections."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.style import Style
from rich.table import Column, Table
from rich.text import Text

from fg_calib.errors import escaped
from fg_calib.options import check_number
from fg_calib.report.shown import FAMILY_UNIT

WIDTH = 100
"""Columns of the plain report."""


def in_order(families: Iterable[str]) -> list[str]:
    """Kinds of residual in the order in which reports show them."""
    there = list(families)
    return [f for f in FAMILY_UNIT if f in there] + [f for f in there if f not in FAMILY_UNIT]


INDENT = 2
"""Columns by which sentences, and rows without room, are indented."""

_WIDEST = 10_000


def plain_text(report: RenderableType, width: int) -> str:
    """A report as plain text, without blanks at the ends of lines."""
    check_number("width", width, least=1, whole=True)
    text = io.StringIO()
    console = Console(
        file=text, width=width_for(report, width), color_system=None, highlight=False, legacy_windows=False
    )
    console.print(report)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def width_for(report: RenderableType, width: int) -> int:
    """`width`, or more where the longest word of a report needs it."""
    return max(width, Console(width=_WIDEST).measure(report).minimum)


def line(text: str, style: str | Style = "") -> Text:
    """A line of a report: all of its text comes through here, so that names from files neither steer nor style it."""
    return Text(escaped(text), style=style)


def section(title: str, *content: RenderableType) -> list[RenderableType]:
    """A heading after a blank line, and what stands below it."""
    return [line(""), line(title, "bold"), *content]


def indented(lines: Iterable[str]) -> list[RenderableType]:
    """Sentences below a heading or a table."""
    return [Padding(line(text), (0, 0, 0, INDENT)) for text in lines]


def plain_table(*columns: tuple[str, str], wrap: bool = False) -> Table:
    """A table without a frame; columns as (heading, justification), which wrap at spaces with `wrap`."""
    table = _WholeWords(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="italic")
    for heading, justify in columns:
        table.add_column(line(heading), justify=justify, no_wrap=not wrap, overflow="fold")  # type: ignore[arg-type]
    return table


class _WholeWords(Table):
    """A table without a frame that breaks no word: it wraps at spaces, or gives each row a paragraph of its own."""

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """Add a row of cells; text in brackets is no markup."""
        super().add_row(*(line(cell) if isinstance(cell, str) else cell for cell in cells), **options)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        widths = self._widths(options.max_width)
        if widths is None:
            yield from self._paragraphs()
            return
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        yield from super().__rich_console__(console, options.update_width(options.max_width + 1))  # not one blank less

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        words = [_longest_word(text) for column in self.columns for text in self._texts(column)]
        return Measurement(max(words, default=0) + INDENT, options.max_width)

    def _texts(self, column: Column) -> list[str]:
        """The cells of a column, its heading first."""
        heading = str(column.header) if self.show_header else ""
        return [heading, *(str(cell) for cell in column.cells)]

    def _widths(self, most: int) -> list[int] | None:
        """Widths of the columns, the widest wrapped most; None where `most` is too narrow for their longest words."""
        texts = [self._texts(column) for column in self.columns]
        widths = [max(map(len, cells)) for cells in texts]
        least = [
            width if column.no_wrap else max(map(_longest_word, cells))
            for column, width, cells in zip(self.columns, widths, texts, strict=True)
        ]
        room = most - len(widths) + 1  # a blank between columns
        while sum(widths) > room:
            can = [i for i, width in enumerate(widths) if width > least[i]]
            if not can:
                return None
            widths[max(can, key=lambda i: widths[i])] -= 1
        return widths

    def _paragraphs(self) -> Iterable[RenderableType]:
        """The rows one below the other: the first cell if it has words, then the others behind their headings."""
        columns = [self._texts(column) for column in self.columns]
        for i, row in enumerate(self.rows, start=1):
            title, *others = (f"{cells[0]} {cells[i]}".strip() if cells[i] else "" for cells in columns)
            words = "  ".join(filter(None, others))
            style = row.style or ""
            if title or not words:
                yield line(title, style)
            if words:
                yield Padding(line(words, style), (0, 0, 0, INDENT))


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def rounded(value: float, decimals: int, sign: str = "") -> str:
    """A figure with `decimals`; one that rounds to zero has no minus, which rounding errors alone would decide on."""
    return f"{value:{sign}z.{decimals}f}"
