"""The parts of a terminal report: units, headings, sentences and tables without a frame."""

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic_core import to_json
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from fg_calib import __version__, diagnostics, inputs
from fg_calib.io import fill_folder
from fg_calib.observability import LostDirection, Observability
from fg_calib.robot import SCALES, Robot, Scale, unit_of

WEAK = "sigma above a tenth of the prior sigma, or of 1 mrad at the reach"
WEAKLY = f"Weakly determined ({WEAK})"
"""The definition of a weak direction, for headings."""

BETWEEN = 2
"""Blanks between the columns of a table."""

WIDTH = 100
"""Columns of a report that is not printed to a terminal."""

POSE_KINDS = {"position": "m", "orientation": "rad"}
"""The two kinds of error of a pose, and their units."""

USUAL_KINDS = ("position", "orientation", "distance", "angle", "point", "pixel")
"""The usual kinds of residual, in the order in which reports show them."""


def in_order(kinds: Iterable[str]) -> list[str]:
    """Kinds of residual in the order in which reports show them."""
    return sorted(kinds, key=lambda kind: USUAL_KINDS.index(kind) if kind in USUAL_KINDS else len(USUAL_KINDS))


def plain_text(report: RenderableType, width: int = WIDTH) -> str:
    """A report as plain text, without blanks at the ends of lines."""
    inputs.check_number("width", width, least=1, whole=True)
    text = io.StringIO()
    Console(file=text, width=width_for(report, width), color_system=None, highlight=False).print(report)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def width_for(report: RenderableType, width: int) -> int:
    """`width`, or more where a table or the longest word of a report needs it."""
    return max(width, Console(width=10_000).measure(report).minimum)


def line(text: str, style: str = "") -> Text:
    """A line of a report: all text passes here, so that names from files neither steer nor style the terminal."""
    return Text(inputs.escaped(text), style=style)


Content = Table | Text | str
"""Content of a section: tables, lines with a style, and sentences."""


class Section(inputs.Record):
    """A part of a report, which the terminal and the page show alike.

    Attributes:
        title: Its heading.
        content: Tables, sentences (strings), and lines with a style.
    """

    title: str
    content: tuple[Content, ...] = ()

    def __rich__(self) -> Group:
        """The section for the terminal: a heading after a blank line, and its content."""
        return Group(line(""), line(self.title, "bold"), *map(_part, self.content))

    @property
    def tables(self) -> Iterator[tuple[list[str], list[tuple[str, ...]], list[str]]]:
        """Headings, rows, and justification of the columns (`left`, `right`) of its tables."""
        for table in (part for part in self.content if isinstance(part, Table)):
            cells = ([str(cell) for cell in column.cells] for column in table.columns)
            headings = [str(column.header) for column in table.columns]
            yield headings, list(zip(*cells, strict=True)), [column.justify for column in table.columns]

    @property
    def sentences(self) -> list[str]:
        """Sentences of the section, and what stands below its tables."""
        return [str(part.caption or "") if isinstance(part, Table) else str(part) for part in self.content]


class NarrowTable(Table):
    """A table that cuts no word: where room is scarce the widest columns wrap, each to its `min_width` at most."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table, its columns as wide as the room allows."""
        shown, room = copy(self), options.max_width - BETWEEN * (len(self.columns) - 1)
        sizes = [(c.min_width or 0, max(cell_len(str(cell)) for cell in (c.header, *c.cells))) for c in self.columns]
        most = max((full for _, full in sizes), default=0)
        while most and sum(min(full, max(least, most)) for least, full in sizes) > room:
            most -= 1
        widths = (min(full, max(least, most)) for least, full in sizes)
        shown.columns = [replace(c, width=width) for c, width in zip(self.columns, widths, strict=True)]
        return Table.__rich_console__(shown, console, options)


def _part(content: Content) -> RenderableType:
    return Padding(line(content), (0, 0, 0, 2)) if isinstance(content, str) else content


def section(title: str, *content: Content) -> list[Section]:
    """A section of its content without empty tables; none where nothing is left."""
    filled = tuple(part for part in content if not isinstance(part, Table) or part.row_count)
    return [Section(title, filled)] if filled else []


def report(*parts: Section | Content) -> Group:
    """A report of sections and, before the first, of lines and sentences."""
    return Group(*(part if isinstance(part, Section) else _part(part) for part in parts))


def table_of(columns: Iterable[str], rows: Iterable[Sequence[Any]], *, most: int | None = None) -> Table:
    """A table without a frame, for the terminal and the page; text in it wraps where the terminal is narrow.

    Args:
        columns: Of each column `heading|form|unknown`: how its values are shown, and what stands for one that is not
            known. The form is

            - nothing: text, to the left; `>`: text, to the right;
            - `unit`: the unit in which quantities of the row are shown, from `m`, `rad` or `px`;
            - `q`: a quantity in the unit of its row; `q:+.3g`: with a sign, in three digits; `m`, `rad`, `px`: likewise
              in that unit;
            - `p`: a probability; any other: a number in that format.

            Without any heading there is no heading row.
        rows: Values; text stands for itself in every column.
        most: Rows that are shown; a line below says how many more there are.
    """
    parts = [tuple(f"{column}||".split("|")[:3]) for column in columns]
    table = NarrowTable(box=None, pad_edge=False, padding=(0, BETWEEN, 0, 0), header_style="italic")
    table.show_header = any(heading for heading, _, _ in parts)
    for heading, form, _ in parts:
        justify: Literal["left", "right"] = "left" if form in ("", "unit") else "right"
        table.add_column(line(heading), justify=justify, overflow="fold")
    at, rows = next((k for k, (_, form, _) in enumerate(parts) if form == "unit"), 0), list(rows)
    if most is not None and len(rows) > most:
        table.caption, table.caption_justify = line(f"and {len(rows) - most} more"), "left"
    for row in rows[:most]:
        cells = zip(row, parts, strict=True)
        table.add_row(*(_cell(value, form, unknown, str(row[at])) for value, (_, form, unknown) in cells))
    for column, (_, form, _) in zip(table.columns, parts, strict=True):
        words = " ".join(map(str, column.cells)).split() if form in ("", ">") else map(str, column.cells)
        column.min_width = max(map(cell_len, (*str(column.header).split(), *words)), default=0)
    return table


def _cell(value: Any, form: str, unknown: str, unit: str) -> Text:
    kind, _, digits = form.partition(":")
    if isinstance(value, Text):
        return value
    if form == "unit":
        return line(shown_in(value).unit)
    if isinstance(value, str) or form in ("", ">"):
        return line(str(value))
    if kind == "q" or kind in SCALES:
        return line(figure(value, unit if kind == "q" else kind, digits, unknown or "unknown"))
    if value is None or not np.isfinite(value):
        return line(unknown or "-")
    return line(diagnostics.probability(value) if form == "p" else f"{value:{form}}")


def shown_in(unit: str) -> Scale:
    """How a quantity in an SI unit is shown; in that unit itself where `SCALES` has none."""
    return SCALES.get(unit, Scale(unit, 1.0, 6))


def figure(value: float | None, unit: str, form: str = "", unknown: str = "unknown") -> str:
    """A value in the unit that is shown, without the unit's name.

    Args:
        value: The value, [m], [rad] or [px]; None or not finite if it is unknown.
        unit: Its unit.
        form: `+` for a sign, and digits such as `.3g` instead of the decimals of the unit.
        unknown: Text of an unknown value.
    """
    if value is None or not np.isfinite(value):
        return unknown
    return f"{value * shown_in(unit).factor:{form if '.' in form else f'{form}z.{shown_in(unit).decimals}f'}}"


def in_words(value: float | None, unit: str, form: str = ".3g") -> str:
    """A value with its unit, in three digits."""
    shown = figure(value, unit, form)
    return shown if shown == "unknown" else f"{shown} {shown_in(unit).unit}"


def lost_directions(lost: Sequence[LostDirection]) -> Table:
    """Each reason once, after the directions that have it."""
    by_reason: dict[str, list[str]] = {}
    for direction in lost:
        by_reason.setdefault(direction.reason, []).append(format_relation(direction.relation))
    return table_of(("", "because"), [(", ".join(relations), reason) for reason, relations in by_reason.items()])


def format_sum(factors: Mapping[str, float]) -> str:
    """`d5 + d3 - d4`, `a7 + 0.5 beta5`: parameters, each with its factor."""
    sizes = {name: "" if abs(f) == 1.0 else f"{abs(f):.4g} " for name, f in factors.items()}
    terms = (f"{'-' if f < 0.0 else '+'} {sizes[name]}{name}" for name, f in factors.items())
    return " ".join(terms).removeprefix("+ ")


def format_relation(relation: Mapping[str, float]) -> str:
    """`d3 - d4` where sizes are equal, else `d6 by +0.5 m with alpha7 by +1 rad`."""
    if all(abs(v) == 1.0 for v in relation.values()):
        return format_sum(relation)
    large = {n: v for n, v in relation.items() if abs(v) >= 0.01}  # the largest is 1
    text = " with ".join(f"{n} by {v:+.4g} {unit_of(n)}" for n, v in large.items())
    n_small = len(relation) - len(large)
    return text + (f" and a little of {n_small} other parameter{'s' * (n_small > 1)}" if n_small else "")


def weak_directions(observability: Observability, most: int = 5) -> Table:
    """Weak directions: their sigma over the prior sigma, and their largest members."""
    rows = []
    for weak in observability.weak:
        members = ", ".join(f"{name} {share:+.2f}" for name, share in list(weak.members.items())[:6])
        rows.append((1.0 / weak.signal_to_noise if weak.signal_to_noise > 0.0 else None, members))
    return table_of(("sigma / prior|.3g|unknown", "largest members"), rows, most=most)


def joint_columns(robot: Robot, form: str = "") -> list[str]:
    """Columns of joint readings for `table_of`."""
    return [f"{joint.name.replace('|', '/')} {shown_in(joint.unit).unit}|{joint.unit}{form}" for joint in robot.joints]


def plain(document: Any) -> Any:
    """A document as JSON has it: dataclasses as mappings, arrays as lists, null for what is not finite."""
    return json.loads(to_json(document, fallback=lambda value: value.tolist(), inf_nan_mode="null"))


def document_of(name: str, source: object = None, keys: str = "", **more: Any) -> dict[str, Any]:
    """A document for programs, as JSON has it.

    Args:
        name: Of its schema.
        source: An object whose attributes it holds.
        keys: Names of these attributes.
        more: Other keys and their values.
    """
    head = {"schema": f"fg-calib/{name}/1", "version": __version__}
    return plain(head | {key: getattr(source, key) for key in keys.split()} | more)


def write_document(folder: Path | str, name: str, document: dict[str, Any]) -> None:
    """Write a JSON file into a folder, over an earlier one of its schema.

    Raises:
        InputError: The folder cannot be written, or holds another file of that name.
    """
    begins = json_text({"schema": document["schema"]}).rpartition("/")[0].encode()
    fill_folder(Path(folder), {name: json_text(document)}, {name: begins})


def json_text(document: Any) -> str:
    """The text of a JSON file."""
    return json.dumps(plain(document), indent=1, allow_nan=False) + "\n"
