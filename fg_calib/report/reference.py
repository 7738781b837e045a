"""The reference of the files that the package reads: as text for a terminal, and as Markdown for `docs/`."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Group, RenderableType

from fg_calib.io.reference import SECTIONS, TABLE_COLUMNS, WORDS, Key, Topic, keys_of
from fg_calib.report.tables import indented, line, plain_table, section

_KEYS = ("key", "what it may be", "default", "meaning")
_COLUMNS = ("columns", "unit", "meaning")
_SHOWN = 6
"""Columns of one meaning that are all named; of more the first and the last."""


def build_reference(topic: Topic) -> RenderableType:
    """A topic for a terminal: a paragraph a key, for four columns are too many for one."""
    parts: list[RenderableType] = [line(WORDS[topic])]
    for title, words, headings, rows in _parts(topic):
        content: list[RenderableType] = [line(words)] if words else []
        if headings is _KEYS:
            for name, kind, default, meaning in rows:
                state = "required" if default == "required" else f"default {default}" if default else "optional"
                content += [line(f"{name}: {kind} ({state})", "bold"), *indented([f"{meaning}."])]
        else:
            table = plain_table(*((heading, "left") for heading in headings), wrap=True)
            for row in rows:
                table.add_row(*row)
            content.append(table)
        parts += section(title or "keys", *content)
    return Group(*parts)


def reference_markdown(topic: Topic) -> str:
    """A topic as Markdown: what `docs/<topic>.md` holds."""
    lines = [f"# `fg-calib help {topic}`", "", WORDS[topic], ""]
    lines += [f"Written by `fg-calib help {topic} --markdown`; the readers know the keys from the same place.", ""]
    for title, words, headings, rows in _parts(topic):
        lines += [f"## {title}", ""] if title else []
        lines += [words, ""] if words else []
        lines += [f"| {' | '.join(headings)} |", f"|{'---|' * len(headings)}"]
        for name, *cells in rows:
            escaped = [cell.replace("|", "\\|") for cell in cells]
            lines.append(f"| `{name}` | {' | '.join(escaped)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def _parts(topic: Topic) -> Iterator[tuple[str, str, tuple[str, ...], list[tuple[str, ...]]]]:
    """Title, words before, headings and rows of each part of a topic."""
    if topic == "tables":
        for title, columns in TABLE_COLUMNS:
            yield title, "", _COLUMNS, [(_named(c.names), c.unit or "-", c.meaning) for c in columns]
        return
    for one in SECTIONS[topic]:
        yield one.title, one.words, _KEYS, [_row(key) for key in keys_of(one)]


def _named(names: tuple[str, ...]) -> str:
    return " ".join(names) if len(names) <= _SHOWN else f"{names[0]} ... {names[-1]}"


def _row(key: Key) -> tuple[str, ...]:
    return key.name, key.kind, key.default, key.meaning
