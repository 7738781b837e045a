"""Does anything but the package's own errors leave a reader, whatever the file?

Valid robots, URDFs, jobs, scenarios, tables and results are damaged, in their structure (keys, cells and elements
dropped, doubled, renamed, moved or given odd values) or as bytes (flipped, cut, inserted, encoded otherwise), and read.
A reader may accept a file, or refuse it with an `InputError` of one printable line, within seconds; anything else is
kept under `--out` with the file that caused it, and the exit code is 1.

    python experiments/fuzz.py --cases 1000000     # 20 000 take 18 s of processor time; --quick runs 300

The tests draw from the same mutations by hypothesis, which shrinks what it finds (tests/io/test_fuzz.py).
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import random
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

os.environ.setdefault("POLARS_MAX_THREADS", "1")  # tables of four rows are for one

import numpy as np
import polars as pl

from fg_calib import (
    InputError,
    Measurements,
    Robot,
    calibrate,
    pose,
    read_job,
    read_measurements,
    read_result,
    read_robot,
    read_scenario,
)

ROUND = 20_000
"""Cases after which what was found so far is written."""

SECONDS = 20.0
"""More than this is a hang: what is slowest takes a twentieth of it on a machine under other work."""


# Odd values


class Raw(str):
    """Text that stands in a YAML or JSON file as it is, without quotes."""

    def __new__(cls, text: str) -> Raw:
        """The text, marked so that it is found again among what a library has written."""
        return super().__new__(cls, _MARK + text)


_MARK = "\ue000"
_MARKED = re.compile(r'"\\ue000((?:[^"\\]|\\.)*)"')


WORDS = (
    *("", " ", "x", "Q1", "q1", "q9", "a", "a1", "tool.x", "base", "tool", "none", "true", "null", "pose", "test"),
    *("\x1b[31m\x07", "a\nb", "a\tb", "a\0b", "\u202egnp.exe", "ünïcödé", "\ud83e\udd16", "[/red]", "{0}", "%s"),
    *(
        "0,5",
        "1.234,5",
        "1e400",
        "nan",
        "inf",
        "-Infinity",
        "0x10",
        "1_000",
        "١٢",
        "\uff11",
        "1/2",
        "1 mm",
        "90°",
        "--5",
    ),
    *(".", "..", "/", "/dev/zero", "/dev/null", "nowhere.csv", "poses.csv", "robot.yaml", "~", "*", "-", "=", "<<"),
    *("x" * 5000, "9" * 400, "9" * 5000, "../" * 50, "a" * 300 + ".csv"),
)
"""Odd texts."""

NUMBERS = (
    *(0, 1, -1, 2, 3, 7, 90, 0.5, -0.0, 1e-3, 1e-31, 1e-200, 5e-324, 1e14, 1e16, 1e155, -1e300, 1.7976931348623157e308),
    *(math.nan, math.inf, -math.inf, 2**31, 2**63, 2**64, -(2**63) - 1, 10**400, math.pi, 360, 1e6),
)

VALUES: tuple[Any, ...] = (
    *NUMBERS,
    *WORDS,
    True,
    False,
    None,
    [],
    {},
    [[]],
    [1, 2],
    [[[[1]]]],
    {"a": {"b": [1]}},
    {"x": 1},
)

YAML_VALUES = tuple(
    map(
        Raw,
        (
            *(".nan", ".inf", "-.INF", "1e400", "1.0e+400", "0x" + "f" * 4000, "0o17", "1_0", "12:30:45", "2024-02-30"),
            *("2024-01-01", "2024-01-01 25:00:00", "yes", "Off", "~", "!!binary aGk=", "!!binary x", "!!set {a, b}"),
            *("!!int x", "!!float ''", "!!omap [a: 1]", "!!pairs [a: 1]", "!!python/object/apply:os.system [exit]"),
            *(
                *("!!map [a]", "!!seq {a: 1}", "!!str {a: 1}", "!!null x", "!!map a", "!!int [1]", "!x y"),
                "!!str 5",
                "&a [*a]",
                "*a",
                "*nowhere",
                "&a 1",
                "{<<: {a: 1}}",
                "{<<: [1]}",
                "{<<: *a}",
                "0,0005",
            ),
            *(
                "{? [1] : 2}",
                "{1: 2}",
                "{.5: 2}",
                "{true: 1}",
                "{null: 1}",
                "{a: 1, a: 2}",
                "'",
                '"',
                "|",
                "[",
                "]",
                "}",
            ),
            *("[" * 200, "[" * 50 + "]" * 50, "{a: " * 50 + "1" + "}" * 50, "# ", "@", "`", "%", "\t", "---", "..."),
            *(
                '"\\x1b[31m"',
                '"\\ud800"',
                '"\\0"',
                "'\x85'",
                "=",
                "<<",
                "? ",
                ": ",
                "- ",
                "0b2",
                "190:20:30",
                "1.e",
                ".",
            ),
        ),
    )
)

JSON_VALUES = tuple(
    map(
        Raw,
        (
            *("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "9" * 5000, "9" * 400, "1e-400", "-0", "01", "+1"),
            *(
                '"\\ud800"',
                '"\\u0000"',
                "[" * 2000,
                "[" * 100 + "]" * 100,
                '{"a":1,"a":2}',
                "'x'",
                "nul",
                "//",
                "{",
                "]",
            ),
        ),
    )
)

CHUNKS = (
    *(
        b"\0",
        b"\xff",
        b"\xfe\xff",
        b"\xef\xbb\xbf",
        b"\x1b[31m",
        b"\x07",
        b"\x85",
        b"\xe2\x80\xa8",
        b"\xc3",
        b"\xed\xa0\x80",
    ),
    *(
        b"\n",
        b"\r",
        b"\r\n",
        b"\t",
        b",",
        b";",
        b'"',
        b"'",
        b":",
        b": ",
        b"- ",
        b"{",
        b"}",
        b"[",
        b"]",
        b"<",
        b">",
        b"&",
    ),
    *(b"&amp;", b"&#0;", b"&#x1b;", b"&a;", b"<!--", b"-->", b"<![CDATA[", b"]]>", b"<?xml", b"<!DOCTYPE a [", b"*a"),
    *(
        b"&a ",
        b"!!",
        b"!!int ",
        b"<<: ",
        b"? ",
        b"|",
        b"#",
        b"%",
        b"@",
        b"`",
        b"nan",
        b"1e400",
        b"-",
        b"e",
        b".",
        b"0",
        b"9",
    ),
    *(b",,,,", b"[" * 500, b"9" * 500, b" " * 500, b"{a: " * 100, b'""', b'"""', b"---\n", b"...\n", b"NaN", b"PAR1"),
)


# Mutations of structures


def mutate_value(rng: random.Random, value: Any, odd: Sequence[Any]) -> Any:
    """A copy of nested dicts and lists with one thing changed in a place of any depth."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(list(value))
        if rng.random() < 0.7:
            return {**value, key: mutate_value(rng, value[key], odd)}
        return _mutate_keys(rng, value, key, odd)
    if isinstance(value, list) and value and rng.random() < 0.85:
        i = rng.randrange(len(value))
        match rng.randrange(8):
            case 0:
                return value[:i] + value[i + 1 :]
            case 1:
                return [*value[:i], value[i], *value[i:]]
            case 2:
                return value * rng.choice((2, 3, 20))
            case _:
                return [*value[:i], mutate_value(rng, value[i], odd), *value[i + 1 :]]
    match rng.randrange(6):
        case 0:
            return [value]
        case 1:
            return {rng.choice(("a", "x", "model", "random")): value}
        case 2 if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300:
            return rng.choice((-value, value * 1e3, value / 1e3, value * 1e30, str(value), f"{value} mm", [value] * 3))
        case _:
            return rng.choice(odd)


def _mutate_keys(rng: random.Random, value: dict[str, Any], key: str, odd: Sequence[Any]) -> dict[str, Any]:
    rest = {k: v for k, v in value.items() if k != key}
    match rng.randrange(5):
        case 0:
            return rest
        case 1:
            return {**rest, str(rng.choice(WORDS)): value[key]}
        case 2:
            return {**rest, key.upper() if rng.random() < 0.5 else key[:-1] + "x": value[key]}
        case 3:
            other = rng.choice(list(value))
            return {**value, key: value[other], other: value[key]}
        case _:
            return {**value, str(rng.choice(WORDS)): rng.choice(odd)}


def yaml_text(value: Any) -> str:
    """A value as YAML in flow style; much faster than a library."""
    match value:
        case Raw():
            return value[len(_MARK) :]
        case dict():
            return "{" + ", ".join(f"{_yaml_key(k)}: {yaml_text(v)}" for k, v in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(map(yaml_text, value)) + "]"
        case float():
            return repr(value) if math.isfinite(value) else {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan")
    return json.dumps(value)


def _yaml_key(key: str) -> str:
    return key if key.replace("_", "").replace(".", "").isalnum() else json.dumps(key)


def json_text(value: Any) -> str:
    """A value as JSON, raw texts in it as they are."""
    return _MARKED.sub(lambda found: json.loads(f'"{found[1]}"'), json.dumps(value))


def mutate_bytes(rng: random.Random, content: bytes) -> bytes:
    """Bytes with some flipped, cut, doubled, moved or inserted, or in another encoding."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        i, j = sorted((rng.randrange(len(content) + 1), rng.randrange(len(content) + 1)))
        j = min(j, i + rng.choice((1, 2, 4, 16, 64, len(content))))
        match rng.randrange(9):
            case 0:
                content = content[:i]
            case 1:
                content = content[:i] + content[j:]
            case 2:
                content = content[:i] + content[i:j] * 2 + content[j:]
            case 3:
                k = rng.randrange(len(content) + 1)
                content = content[:k] + content[i:j] + content[k:]
            case 4 | 5:
                content = content[:i] + rng.choice(CHUNKS) + content[i if rng.random() < 0.5 else j :]
            case 6 | 7 if content:
                i = rng.randrange(len(content))
                content = content[:i] + bytes([content[i] ^ (1 << rng.randrange(8))]) + content[i + 1 :]
            case 8 if rng.random() < 0.1:
                encoding = rng.choice(("utf-16", "utf-16-le", "utf-32", "latin-1", "cp037", "utf-7"))
                content = content.decode("utf-8", "replace").encode(encoding, "replace")
    return content


def cell_text(value: Any) -> str:
    """A value as the cell of a CSV."""
    if value is None:
        return ""
    return "[1;2]" if isinstance(value, list | dict) else str(value)


def mutate_table(rng: random.Random, columns: dict[str, list[Any]], odd: Sequence[Any]) -> dict[str, list[Any]]:
    """Columns with one dropped, renamed or moved, with other rows, or with an odd cell."""
    names = list(columns)
    name = rng.choice(names)
    if not columns[name]:
        return columns
    match rng.randrange(10):
        case 0:
            return {k: v for k, v in columns.items() if k != name}
        case 1:
            other = rng.choice(
                (*names, *WORDS, name.upper(), f" {name}", f"{name}_", "sigma_position", "group", "sigma_x")
            )
            return {other if k == name else k: v for k, v in columns.items()}
        case 2:
            other = rng.choice(names)
            return {**columns, name: columns[other], other: columns[name]}
        case 3:
            i = rng.randrange(len(columns[name]))
            return {k: v[:i] if rng.random() < 0.02 else v[:i] + v[i + 1 :] for k, v in columns.items()}
        case 4:
            return {k: v * 2 for k, v in columns.items()}
        case 5:
            return {**columns, rng.choice(WORDS): list(columns[name])}
        case _:
            cells = list(columns[name])
            cells[rng.randrange(len(cells))] = rng.choice(odd)
            return {**columns, name: cells}


def csv_bytes(rng: random.Random, columns: dict[str, list[Any]]) -> bytes:
    """Columns as a CSV, now and then with a row of another length, other separators, quotes or ends of lines."""
    rows = [list(columns), *zip(*columns.values(), strict=False)]
    lines = [",".join(cell_text(cell) for cell in row) for row in rows]
    i = rng.randrange(len(lines))
    match rng.randrange(20):
        case 0:
            lines[i] += rng.choice((",", ",1", ",,,,", '"', ' "x"', "\\"))
        case 1:
            lines[i] = lines[i].rpartition(",")[0]
        case 2:
            lines[i] = lines[i].replace(",", rng.choice((";", "\t", " ", '","', '"')))
        case 3:
            lines.insert(i, rng.choice(("", " ", ",", ",,,,,", "# x", '""', "\x1b")))
        case 4:
            return "\r".join(lines).encode(errors="replace")
        case 5:
            return "\n".join(line.replace(",", ";").replace(".", ",") for line in lines).encode(errors="replace")
    return ("\n".join(lines) + "\n" * rng.randrange(3)).encode(errors="replace")


Tag = tuple[str, dict[str, str], list[Any]]


def mutate_tag(rng: random.Random, tag: Tag) -> Tag:
    """An XML element with one thing changed in a place of any depth."""
    name, attributes, children = tag
    if children and rng.random() < 0.7:
        i = rng.randrange(len(children))
        match rng.randrange(10):
            case 0:
                return name, attributes, children[:i] + children[i + 1 :]
            case 1:
                return name, attributes, [*children[:i], children[i], *children[i:]]
            case 2:
                return name, attributes, rng.sample(children, len(children))
            case 3:
                return name, attributes, [*children, rng.choice(children), *rng.choice(children)[2]]
            case _:
                return name, attributes, [*children[:i], mutate_tag(rng, children[i]), *children[i + 1 :]]
    if attributes and rng.random() < 0.85:
        key = rng.choice(list(attributes))
        rest = {k: v for k, v in attributes.items() if k != key}
        match rng.randrange(6):
            case 0:
                return name, rest, children
            case 1:
                return name, {**rest, rng.choice(("name", "link", "xyz", "type", "x")): attributes[key]}, children
            case 2:
                words = attributes[key].split() or [""]
                words[rng.randrange(len(words))] = str(rng.choice(NUMBERS))
                return name, {**rest, key: " ".join(words)}, children
            case 3:
                known = ("a", "b", "c", "j", "k", "fixed", "prismatic", "floating", "mimic", "0 0 0", "1 2", "${x}")
                return name, {**rest, key: rng.choice(known)}, children
            case _:
                return name, {**rest, key: str(rng.choice(WORDS))}, children
    return rng.choice(("link", "joint", "origin", "axis", "mimic", "xacro:macro", "robot")), attributes, children


def xml_text(tag: Tag) -> str:
    """An element as text."""
    name, attributes, children = tag
    given = "".join(f' {k}="{_escaped(v)}"' for k, v in attributes.items())
    return f"<{name}{given}>{''.join(map(xml_text, children))}</{name}>"


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


# Valid documents

JOINT = {"a": 0.1, "alpha": 0, "d": 0.2, "theta": 0.3}
ROBOT = {
    "name": "arm",
    "convention": "dh",
    "units": {"length": "m", "angle": "rad"},
    "joints": [{**JOINT, "limits": [-3, 3]}, {**JOINT, "type": "prismatic", "name": "lift"}],
    "base": {"x": 1, "yaw": 0.5},
    "tool": {"z": 0.1},
    "fixed": ["a1"],
    "estimate": ["tool.x"],
    "tolerance": {"a": 0.01, "d2": 0.02, "tool": 0.005},
}
SHORT_ROBOT = {"convention": "mdh-hayati", "joints": [JOINT, {**JOINT, "beta": 0.1}]}
WRAPPED = {"urdf": "arm.urdf", "tip_link": "c", "tool": {"x": 1}, "tolerance": {"x": 0.1}}
JOB = {
    "robot": "robot.yaml",
    "measurements": "poses.csv",
    "pairs": "pairs.csv",
    "model": "distance",
    "pairing": {"random": 3, "seed": 1},
    "frame": "known",
    "units": {"length": "m", "angle": "rad"},
    "noise": {"position": 0.001, "orientation": 0.001, "joint": [0.0, 0.001], "distance": 0.01, "angle": 0.01},
    "prior": True,
    "loss": "none",
    "prefer": ["a1"],
}
JOB_OF_TABLES = {
    "robot": SHORT_ROBOT,
    "noise": {"joint": 0.001, "position": 0.001},
    "measurements": [
        {"table": "poses.csv", "model": "position", "frame": "unknown", "noise": {"position": 0.001}},
        {"table": "poses.csv", "model": "distance", "pairs": "pairs.csv", "pairing": "star", "units": {"length": "mm"}},
    ],
}
BOARD = {
    "pose": {"x": 0, "y": 0.5, "yaw": 1},
    "height": 0.5,
    "count": 5,
    "distance": [0.3, 2.0],
    "cone": 1,
    "roll": 0.1,
}
BOARD |= {"self_motion": "held", "posture": [0.1, 0.2]}
SCENARIO = {
    "name": "s",
    "robot": SHORT_ROBOT,
    "units": {"length": "m", "angle": "rad"},
    "errors": {"uniform": {"a": 0.01, "d1": 0.02}},
    "configurations": {"random": {"count": 5}},
    "noise": {"position": 0.001, "orientation": 0.001, "joint": [0.001, 0.001]},
    "frame": {"x": 1},
    "validation": {"table": "configurations.csv"},
    "job": {"model": "pose", "gauge": "keep", "prefer": ["a1"], "noise": {"position": 0.001}},
}
BOARD_SCENARIO = {**{k: SCENARIO[k] for k in ("robot", "noise")}, "configurations": {"board": BOARD}}
BOARD_SCENARIO |= {"errors": {"values": {"a1": 0.1}}}
POSES: dict[str, list[Any]] = {
    **{"id": ["p1", "p2", "p3", "p4"], "q1": [0.1, 0.2, 0.3, -0.4], "q2": [0.1, -0.2, 0.0, 0.4]},
    **{"x": [1.0, 1.5, 2.0, 1.0], "y": [0.0, 0.1, 0.2, 0.3], "z": [0.5, 0.5, 0.6, 0.7]},
    **{"qx": [0.0, 1.0, 0.0, 0.6], "qy": [0.0] * 4, "qz": [0.0] * 4, "qw": [1.0, 0.0, 1.0, 0.8]},
    **{"split": ["train", None, "test", "train"], "sigma_position": [0.1, 0.1, 0.2, 0.1]},
}
TOUCHES: dict[str, list[Any]] = {
    **{"q1": [0, 1, 2, 3], "q2": [0.1, 0.2, 0.3, 0.4], "group": ["g", "g", "h", None]},
    **{"sigma_point": [0.1, 0.2, 0.1, None], "roll": [0.0] * 4, "pitch": [0.1] * 4, "yaw": [3.0] * 4},
}
PAIRS: dict[str, list[Any]] = {
    **{"a": ["p1", "p1", "p2"], "b": ["p2", "p3", "p4"], "distance": [0.5, None, 1.0], "angle": [3.1, 0.2, None]},
    **{"sigma_distance": [0.1, None, 0.1], "split": ["train", "test", None]},
}
_LINKS: list[Any] = [("link", {"name": name}, []) for name in "abc"]
_ORIGIN = ("origin", {"xyz": "0.1 0 0.2", "rpy": "0 0.1 -0.3"}, [])


def _joint(name: str, kind: str, parent: str, child: str) -> Tag:
    ends: list[Any] = [("parent", {"link": parent}, []), ("child", {"link": child}, [])]
    more: list[Any] = [_ORIGIN, ("axis", {"xyz": "0 1 0.5"}, []), ("limit", {"lower": "-2", "upper": "2"}, [])]
    return "joint", {"name": name, "type": kind}, [*ends, *more]


URDF: Tag = ("robot", {"name": "arm"}, [*_LINKS, _joint("j", "revolute", "a", "b"), _joint("k", "prismatic", "b", "c")])
ARM = Robot.from_dh([[0.1, 0.0, 0.2, 0.3]] * 2, convention="dh", limits=[[-3.2, 3.2], None])


# Readers


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        file: Name of the file that it reads.
        damaged: A damaged file's content, or another thing for it to read.
        read: Reads the file at a path (or what `damaged` made, if it is not bytes).
        share: Its part of all cases.
    """

    file: str
    damaged: Callable[[random.Random], Any]
    read: Callable[[Any], Any]
    share: float


def _damaged_text(text: Callable[[Any], str], odd: Sequence[Any], *documents: Any) -> Callable[[random.Random], bytes]:
    originals = [text(document).encode() for document in documents]

    def damaged(rng: random.Random) -> bytes:
        i = rng.randrange(len(documents))
        if rng.random() < 0.4:
            return mutate_bytes(rng, originals[i])
        value = documents[i]
        for _ in range(rng.choice((1, 1, 2))):
            value = mutate_tag(rng, value) if isinstance(value, tuple) else mutate_value(rng, value, odd)
        return text(value).encode(errors="replace")

    return damaged


def _damaged_csv(*tables: dict[str, list[Any]]) -> Callable[[random.Random], bytes]:
    originals = [csv_bytes(random.Random(0), table) for table in tables]

    def damaged(rng: random.Random) -> bytes:
        i = rng.randrange(len(tables))
        if rng.random() < 0.4:
            return mutate_bytes(rng, originals[i])
        table = tables[i]
        for _ in range(rng.choice((1, 1, 2))):
            table = mutate_table(rng, table, VALUES) or table
        return csv_bytes(rng, table)

    return damaged


ODD_CELLS = (
    *VALUES,
    *(
        date(2024, 1, 1),
        datetime(2024, 1, 1),
        Decimal("1.5"),
        b"x",
        1j,
        object,
        np.float32(1),
        np.nan,
        np.array([1, 2]),
    ),
)
TYPES = (
    *(pl.Float32, pl.Int8, pl.UInt64, pl.String, pl.Boolean, pl.Date, pl.Datetime, pl.Duration, pl.Time, pl.Binary),
    *(pl.Categorical, pl.Decimal(10, 2), pl.List(pl.Float64), pl.Array(pl.Float64, 1), pl.Struct({"a": pl.Float64})),
    *(pl.Null, pl.Object, pl.Enum(["a"])),
)


def _damaged_frame(*tables: dict[str, list[Any]]) -> Callable[[random.Random], Any]:
    def damaged(rng: random.Random) -> Any:
        table = rng.choice(tables)
        for _ in range(rng.choice((1, 1, 2))):
            table = mutate_table(rng, table, ODD_CELLS) or table
        if rng.random() < 0.3:
            return table
        try:
            frame = pl.DataFrame(table, strict=False)
            if rng.random() < 0.5:
                kind = rng.choice(TYPES)
                return frame.with_columns(pl.Series(rng.choice(frame.columns), [None] * frame.height, dtype=kind))
        except Exception:  # polars raises anything of such cells
            return table
        return rng.choice((frame, frame, frame.lazy(), frame.head(0), frame.to_dict(as_series=rng.random() < 0.5)))

    return damaged


def _damaged_parquet(*tables: dict[str, list[Any]]) -> Callable[[random.Random], bytes]:
    frames = _damaged_frame(*tables)
    buffer = io.BytesIO()
    pl.DataFrame(tables[0]).write_parquet(buffer)
    original = buffer.getvalue()

    def damaged(rng: random.Random) -> bytes:
        if rng.random() < 0.5:
            return mutate_bytes(rng, original)
        frame = frames(rng)
        if not isinstance(frame, pl.DataFrame):
            return mutate_bytes(rng, original)
        file = io.BytesIO()
        try:
            frame.write_parquet(file)
        except BaseException as error:  # polars panics on types that Parquet does not know
            if isinstance(error, KeyboardInterrupt):
                raise
            return mutate_bytes(rng, original)
        return file.getvalue()

    return damaged


def result_document() -> dict[str, Any]:
    """A small calibration's `result.json`."""
    rng = np.random.default_rng(0)
    arm = Robot.from_dh([[0.4, 0.1, 0.2, 0.3]], convention="dh", tolerance={"a": 0.01, "theta": 0.01})
    q = rng.uniform(-1.0, 1.0, (6, 1))
    data = Measurements.from_arrays(q, position=pose(arm, q).position, sigma_position=1e-3)
    return calibrate(arm, data, model="position", frame="unknown").result.document()


def readers(folder: Path) -> dict[str, Reader]:
    """Every reader, with files beside that which is damaged in a folder."""
    (folder / "robot.yaml").write_text(yaml_text(ROBOT))
    (folder / "arm.urdf").write_text(xml_text(URDF))
    for name, table in (("poses", POSES), ("pairs", PAIRS), ("configurations", POSES)):
        (folder / f"{name}.csv").write_bytes(csv_bytes(random.Random(0), table))
    poses = folder / "poses.csv"
    yamls = (*VALUES, *YAML_VALUES)
    result = result_document()
    robots = _damaged_text(yaml_text, yamls, ROBOT, SHORT_ROBOT, WRAPPED)
    return {
        "urdf": Reader("damaged.urdf", _damaged_text(xml_text, (), URDF), read_robot, 0.45),
        "result": Reader("damaged.json", _damaged_text(json_text, (*VALUES, *JSON_VALUES), result), read_result, 0.25),
        "robot yaml": Reader("damaged.yaml", robots, read_robot, 0.12),
        "from_frame": Reader("", _damaged_frame(POSES, TOUCHES), _read_poses, 0.06),
        "poses csv": Reader("damaged.csv", _damaged_csv(POSES, TOUCHES), _read_poses, 0.04),
        "scenario": Reader(
            "damaged.yaml", _damaged_text(yaml_text, yamls, SCENARIO, BOARD_SCENARIO), read_scenario, 0.03
        ),
        "poses parquet": Reader("damaged.parquet", _damaged_parquet(POSES, TOUCHES), _read_poses, 0.02),
        "job": Reader("damaged.yaml", _damaged_text(yaml_text, yamls, JOB, JOB_OF_TABLES), read_job, 0.015),
        "pairs csv": Reader(
            "damaged.csv", _damaged_csv(PAIRS), lambda f: read_measurements(poses, ARM, pairs=f), 0.015
        ),
    }


def _read_poses(table: Any) -> Measurements:
    return read_measurements(table, ARM)


# The run


@dataclass
class Found:
    """What a reader did.

    Attributes:
        accepted: Files that it took.
        refused: Files that it refused with an error of the package.
        slowest: Seconds of the slowest.
        seconds: Of all of them.
        others: What else left it: a line each.
    """

    accepted: int = 0
    refused: int = 0
    slowest: float = 0.0
    seconds: float = 0.0
    others: list[str] = field(default_factory=list)

    @property
    def cases(self) -> int:
        """How many there were."""
        return self.accepted + self.refused + len(self.others)

    def document(self) -> dict[str, Any]:
        """As JSON knows it."""
        counts = {"cases": self.cases, "accepted": self.accepted, "refused": self.refused, "others": len(self.others)}
        return {**counts, "slowest_seconds": round(self.slowest, 4), "seconds": round(self.seconds, 1)}


class _HangError(BaseException):
    """A reader took too long; no reader may catch it."""


def _hangs(*_: object) -> None:
    raise _HangError(f"more than {SECONDS:g} s")


def check(read: Callable[[], Any]) -> bool:
    """Whether a reader accepts what it reads.

    Raises:
        BaseException: Whatever else than an `InputError` of one printable line leaves it, or a hang.
    """
    before = signal.signal(signal.SIGALRM, _hangs)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        found = read()
    except InputError as error:
        message = str(error)
        if not message.isprintable() or len(message) > 1000:
            raise ValueError(f"a message that is no line: {message!r}") from None
        return False
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    for array in (getattr(found, "nominal", None), getattr(found, "readings", None), getattr(found, "position", None)):
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"accepted, with figures that are not finite: {array}")
    return True


def fuzz(reader: Reader, rng: random.Random, n: int, folder: Path, found: Found, keep: Path | None = None) -> None:
    """Let a reader read n damaged files.

    Args:
        reader: The reader.
        rng: What the damage is drawn from.
        n: Number of cases.
        folder: Where the files are.
        found: What it did so far, to be continued.
        keep: Where to put files that something else than an error of the package came of.
    """
    path = folder / reader.file
    for _ in range(n):
        damaged = reader.damaged(rng)
        if isinstance(damaged, bytes):
            path.write_bytes(damaged)
        start = time.perf_counter()
        try:
            accepted = check(lambda: reader.read(path if isinstance(damaged, bytes) else damaged))  # noqa: B023
            found.accepted += accepted
            found.refused += not accepted
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            found.others.append(_kept(error, damaged, path, keep, len(found.others)))
        seconds = time.perf_counter() - start
        found.seconds += seconds
        found.slowest = max(found.slowest, seconds)


def _kept(error: BaseException, damaged: Any, path: Path, keep: Path | None, number: int) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    line = f"{type(error).__name__}: {str(error)[:200]!r} at {Path(last.filename).name}:{last.lineno}"
    if keep is not None and number < 200:
        keep.mkdir(parents=True, exist_ok=True)
        file = keep / f"{number}-{path.name or 'frame'}"
        file.write_bytes(damaged if isinstance(damaged, bytes) else repr(damaged).encode(errors="replace"))
        file.with_suffix(".txt").write_text("".join(traceback.format_exception(error)), errors="replace")
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; 0 if nothing else than the package's own errors left a reader."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--reader", action="append", help="only this one; may be repeated")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="300 cases")
    given = parser.parse_args(arguments)
    cases = 300 if given.quick else given.cases
    warnings.simplefilter("error")
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        known = readers(Path(name))
        chosen = {what: known[what] for what in given.reader or known}
        found = {what: Found() for what in chosen}
        rounds = math.ceil(cases / ROUND)
        for i in range(rounds):
            for what, reader in chosen.items():
                rng, n = random.Random(f"{given.seed} {i} {what}"), math.ceil(cases / rounds * reader.share)
                fuzz(reader, rng, n, Path(name), found[what], given.out / "fuzz" / what.replace(" ", "_"))
            document = {"seed": given.seed, "readers": {what: one.document() for what, one in found.items()}}
            (given.out / "fuzz.json").write_text(json.dumps(document, indent=1) + "\n")
    _show(found)
    return int(any(one.others for one in found.values()))


def _show(found: dict[str, Found]) -> None:
    print(f"{'reader':14}{'cases':>9}{'accepted':>10}{'refused':>9}{'others':>8}{'slowest':>9}{'mean':>9}")
    for what, one in found.items():
        slowest, mean = 1e3 * one.slowest, 1e3 * one.seconds / max(one.cases, 1)
        counts = f"{one.cases:9}{one.accepted:10}{one.refused:9}{len(one.others):8}"
        print(f"{what:14}{counts}{slowest:6.0f} ms{mean:6.2f} ms")
        for line in sorted(set(one.others), key=one.others.index)[:20]:
            print(f"    {line} ({one.others.count(line)})")
    print(f"{'all':14}{sum(one.cases for one in found.values()):9}")


if __name__ == "__main__":
    sys.exit(main())
