"""Columns of a CSV or Parquet file: read, checked, and named in messages by line or row."""

from __future__ import annotations

import csv
import logging
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.arrays import NOTHING, as_figures, check_different
from fg_calib.errors import InputError
from fg_calib.io.atomic import decoded, digest_of, read_bytes
from fg_calib.io.frames import as_polars, cells, of_polars, select
from fg_calib.io.parquet import parquet_columns, parquet_rows, read_parquet
from fg_calib.io.units import ANGLES, LENGTHS, Units
from fg_calib.io.yaml import number_hint, shown
from fg_calib.measurements.dataset import Booleans, Floats, Integers
from fg_calib.options import check_names, did_you_mean
from fg_calib.sizes import LEAST_SIZE, MOST_SIZE, ORDINARY

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)

PIECE = 200_000
"""Rows of a Parquet file that are read together where it is read by pieces."""

_ENDINGS = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class Column:
    """What a table calls a column, and how its figures are meant: (figure - zero) * scale, as counts of an encoder are.

    Attributes:
        name: In the table's header.
        scale: What one of its units is in those of the table.
        zero: The figure that means 0.

    Raises:
        InputError: The name is empty, or a figure is not finite; a scale of 0 is none.
    """

    name: str
    scale: float = 1.0
    zero: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise InputError("columns: name", f"found {shown(self.name)}", "the name of a column")
        for key in ("scale", "zero"):
            figure = as_figures(f"columns: {self.name}: {key}", getattr(self, key), "a number")
            if figure.shape or not np.isfinite(figure) or (key == "scale" and figure == 0.0):
                expected = "a finite number" if key == "zero" else "a finite number other than 0"
                raise InputError(f"columns: {self.name}: {key}", f"found {shown(getattr(self, key))}", expected)


@dataclass(frozen=True)
class Header:
    """A table's content and the names of its columns.

    Attributes:
        path: Its file; what it is called where it is in none.
        columns: Names of the columns.
        content: The bytes of the file; where it stands if it is read some rows at a time.
        frame: The table, where it is in no file.
        separator: What stands between the cells of a CSV. Where it is no comma, numbers may have decimal commas.
        meant: By column, how its figures are meant, where that is not as they stand.
    """

    path: Path
    columns: tuple[str, ...]
    content: bytes | Path = field(default=b"", repr=False)
    frame: pl.DataFrame | None = None
    separator: str = ","
    meant: Mapping[str, Column] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.path.name

    @property
    def is_csv(self) -> bool:
        """Whether it is a CSV, else a Parquet file or a frame."""
        return self.frame is None and self.path.suffix.lower() == ".csv"

    def parquet(self, columns: Sequence[str], span: tuple[int, int] | None = None) -> pl.DataFrame:
        """Columns of a Parquet file or a frame.

        Args:
            columns: Their names.
            span: Of a file, the first row and how many at most; all if None.

        Raises:
            InputError: It cannot be read.
        """
        if self.frame is not None:
            return select(self.frame, columns)
        chosen = sorted(self.columns.index(c) for c in columns)
        frame = read_parquet(self.content, chosen, self.name, span)
        frame.columns = [self.columns[i] for i in chosen]  # without blanks around them
        return select(frame, columns)

    @classmethod
    def read(cls, table: Path | str | Any, name: str, *, by_rows: bool = False) -> Header:
        """Read the header of a file, or of a frame by this name.

        Args:
            table: The file, or the frame.
            name: What the frame is called.
            by_rows: Whether some rows are to be read at a time, without the file as a whole: of a Parquet file.

        Raises:
            InputError: It cannot be read, or not so.
        """
        if isinstance(table, str) and not table:
            raise InputError(name, "found ''", "a path, or a frame of polars or pandas")
        if not isinstance(table, os.PathLike | str):
            frame = as_polars(table, name)
            if by_rows:
                raise InputError(name, "a frame in memory", "a Parquet file, where some rows are read at a time")
            return cls(Path(name), tuple(frame.columns), frame=frame)
        path = Path(table)
        if by_rows:
            return cls._of_rows(path)
        if path.suffix.lower() not in _ENDINGS:
            read_bytes(path)
            raise InputError(path.name, f"ending {path.suffix!r}", f"one of {', '.join(_ENDINGS)}")
        content = read_bytes(path)
        header = cls(path, (), content)
        if not header.is_csv:
            return header._named(header.name, parquet_columns(content, header.name))
        content = _with_newlines(content)
        header = replace(header, content=content, separator=_separator(decoded(content, header.name)))
        line, columns = next(header.csv_rows(), (1, []))
        return header._named(f"{header.name}:{line}", columns)

    @classmethod
    def _of_rows(cls, path: Path) -> Header:
        """The header of a Parquet file that is read some rows at a time."""
        digest_of(path)
        found = path
        if path.suffix.lower() not in _ENDINGS[1:]:
            expected = "a Parquet file, where some rows are read at a time"
            raise InputError(path.name, f"ending {path.suffix!r}", expected, "polars: scan_csv(...).sink_parquet(...)")
        return cls(path, (), found)._named(path.name, parquet_columns(found, path.name))

    def _named(self, place: str, columns: Sequence[str]) -> Header:
        """The same with the names of its columns, which stand at a place."""
        columns = [column.strip() for column in columns]
        if not any(columns):
            raise InputError(place, "no names of columns" if columns else "an empty file", "a header and rows")
        if len(columns) == 1 and "|" in columns[0]:
            raise InputError(place, f"one column {shown(columns[0])}", "columns with , ; or tab between", "not '|'")
        check_different(place, columns)
        return replace(self, columns=tuple(columns))

    @property
    def by_rows(self) -> bool:
        """Whether some rows are read at a time."""
        return isinstance(self.content, Path)

    @property
    def text(self) -> bytes:
        """The bytes of a CSV."""
        assert isinstance(self.content, bytes)
        return self.content

    def n_rows(self) -> int:
        """Number of rows of a Parquet file.

        Raises:
            InputError: It cannot be read.
        """
        return parquet_rows(self.content, self.name)

    def csv_rows(self) -> Iterator[tuple[int, list[str]]]:
        """Cells of the header and of each row, with the line where it begins.

        Blank lines count from the header on, as in polars.
        """
        file = TextIOWrapper(BytesIO(self.text), encoding="utf-8-sig", errors="replace", newline="")
        csv.field_size_limit(max(len(self.text), csv.field_size_limit()))
        reader = csv.reader(file, delimiter=self.separator)
        started, line = False, 1
        try:
            for cells in reader:
                started = started or bool(cells)
                if started:
                    yield line, cells
                line = reader.line_num + 1
        except csv.Error as error:
            raise InputError(f"{self.name}:{reader.line_num}", f"not a CSV: {error}") from None

    def renamed(self, columns: Mapping[str, Column], known: Iterable[str]) -> Header:
        """The same with columns called as they are known.

        Args:
            columns: By known name, what the table calls it; a column that has that name already is not used.
            known: Columns that mean something.

        Raises:
            InputError: A name is not known, or the table has no such column.
        """
        place = f"{self.name}: columns"
        check_names(place, columns, sorted(known), "column")
        names = list(self.columns)
        places = {}
        for name, column in columns.items():
            check_names(f"{place}: {name}", [column.name.strip()], self.columns, "column")
            places[name] = self.columns.index(column.name.strip())
        check_different(f"{place}: the table's", [column.name.strip() for column in columns.values()])
        for name, i in places.items():
            if name in names and names.index(name) not in places.values():
                names[names.index(name)] = f"{name} (the table's)"
            names[i] = name
        return replace(self._with_names(names), meant=dict(columns))

    def _with_names(self, names: Sequence[str]) -> Header:
        frame = self.frame
        if frame is not None:
            frame = frame.clone()
            frame.columns = list(names)
        return replace(self, columns=tuple(names), frame=frame)

    def understood(self, known: Iterable[str], others: Iterable[str] = ()) -> Header:
        """The same with the columns that are known by another case called as they are known.

        What looks as if it was to mean something, but does not, is warned of.

        Args:
            known: Columns that mean something.
            others: Names that somebody else has given.

        Raises:
            InputError: A known name stands behind a #, as if the header were a comment.
        """
        known, others = set(known), set(others)
        names, given = list(self.columns), set(self.columns)
        for i, name in enumerate(names):
            if name in known or name in others:
                continue
            if name.startswith("#") and (bare := name.lstrip("# ").lower()) in known:
                raise InputError(self.name, f"column {shown(name)}", f"{bare}, or another name")
            if name.lower() in known and name.lower() not in given:
                names[i] = name.lower()
            elif hint := _meaning(name, known, given):
                _log.warning("%s: column %r is not used; %s", self.name, name, hint)
        return self._with_names(names)

    def present(self, *columns: str) -> tuple[str, ...]:
        """Those of `columns` that the table has."""
        return tuple(c for c in columns if c in self.columns)

    def group(self, columns: tuple[str, ...]) -> tuple[str, ...]:
        """`columns` if the table has all of them, `()` if it has none of them."""
        present = self.present(*columns)
        if present and present != columns:
            missing = next(c for c in columns if c not in present)
            raise InputError(self.name, f"no column {missing}", f"{' '.join(columns)} together")
        return present

    def sigmas(self, single: str, axes: tuple[str, ...]) -> tuple[str, ...]:
        """The columns that state a sigma: one for all axes, or one an axis, or none."""
        if single in self.columns and self.present(*axes):
            raise InputError(self.name, f"both {single} and {self.present(*axes)[0]}", "one of the two")
        return self.present(single) or self.group(axes)


@dataclass(frozen=True)
class Table:
    """The columns of use: numbers as floats, texts without blanks around them; empty cells are null.

    Attributes:
        header: The table's content.
        frame: Its columns of use, without blank rows.
        rows: Where each row stands in the table, 0-based, shape (n_rows,).
    """

    header: Header
    frame: pl.DataFrame
    rows: Integers

    @classmethod
    def read(
        cls, header: Header, numbers: Sequence[str], texts: Sequence[str], span: tuple[int, int] | None = None
    ) -> Table:
        """Read the columns of `numbers` and `texts`.

        Args:
            header: Of the table.
            numbers: Columns of numbers.
            texts: Columns of words.
            span: Of a Parquet file, the first row and how many at most; all if None.

        Raises:
            InputError: It cannot be read, or there is no row.
        """
        frame, rows = (
            _read_csv(header, numbers, texts) if header.is_csv else _read_parquet(header, numbers, texts, span)
        )
        if frame.height == 0:
            raise InputError(header.name, "no rows", "at least one")
        return cls(header, frame, rows)

    @classmethod
    def pieces(
        cls, header: Header, numbers: Sequence[str], texts: Sequence[str], span: tuple[int, int] | None = None
    ) -> Iterator[Table]:
        """The same some rows at a time, as polars keeps the memory that it once took for all."""
        if header.is_csv or header.frame is not None:
            yield cls.read(header, numbers, texts)
            return
        first, left = span or (0, sys.maxsize)
        begun = False
        while left > 0:
            wanted = min(PIECE, left)
            frame, rows = _read_parquet(header, numbers, texts, (first, wanted))
            if frame.height == 0 and not begun:
                raise InputError(header.name, "no rows", "at least one")
            if frame.height:
                yield cls(header, frame, rows)
            if frame.height < wanted:
                return
            first, left, begun = first + wanted, left - wanted, True

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.frame.height

    def numbers(self, columns: Sequence[str], *, optional: bool = False) -> Floats:
        """The columns, shape (n_rows, n_columns); an empty cell is nan if `optional`, else an error."""
        for column in columns:
            good = cells(self.frame, column).is_finite().fill_null(optional)
            self.require(good.to_numpy(), column, "a finite number")
        values = np.empty((self.n_rows, len(columns)))
        for i, name in enumerate(columns):
            values[:, i] = self.frame[name].to_numpy()
            if (meant := self.header.meant.get(name)) is not None:
                values[:, i] = (values[:, i] - meant.zero) * meant.scale
        size = np.abs(values)
        for column, good in zip(columns, ((size <= MOST_SIZE) | np.isnan(values)).T, strict=True):
            self.require(good, column, ORDINARY)
        return values

    def positive(self, columns: Sequence[str], default: float | None, factor: float) -> Floats:
        """Columns of positive figures, times `factor`; an empty cell is `default`, an error if that is None."""
        values = self.numbers(columns, optional=default is not None)
        for column, value in zip(columns, values.T, strict=True):
            self.require(~(value <= 0.0), column, "a number above 0")
            self.require(~(value < LEAST_SIZE), column, ORDINARY)
        return values * factor if default is None else np.where(np.isnan(values), default, values * factor)

    def texts(self, column: str, expected: str) -> pl.Series:
        """The column, without an empty cell."""
        texts = self.frame[column]
        self.require(texts.is_not_null().to_numpy(), column, expected)
        return texts

    def names(self, column: str, expected: str) -> pl.Series:
        """The column, null where it is empty, without a word that stands for nothing elsewhere."""
        names = self.frame[column]
        nothing = names.str.to_lowercase().is_in(NOTHING).fill_null(False)
        self.require(~nothing.to_numpy(), column, expected)
        return names

    def test_rows(self) -> Booleans:
        """True where `split` says test, shape (n_rows,)."""
        if "split" not in self.header.columns:
            return np.zeros(self.n_rows, dtype=np.bool_)
        split = self.frame["split"].fill_null("train")
        self.require(split.is_in(["train", "test"]).to_numpy(), "split", "train or test")
        return (split == "test").to_numpy()

    def require(self, good: Booleans, column: str, expected: str, hint: str = "") -> None:
        """Raise for the first cell of `column` that is not `good`, shape (n_rows,)."""
        if not good.all():
            place, cell = self._look_up(int(np.argmin(good)), column)
            found = "an empty cell" if cell in {None, ""} else shown(cell)
            raise InputError(f"{place}: {column}", f"found {found}", expected, hint or number_hint(cell))

    def place(self, row: int) -> str:
        """File and line of a row (the header is line 1); of a Parquet file the 0-based row."""
        return self._look_up(row, self.header.columns[0])[0]

    def _look_up(self, row: int, column: str) -> tuple[str, Any]:
        """Place and original content of a cell, for messages; slow, since it reads the file again."""
        wanted = int(self.rows[row])
        name, columns = self.header.name, self.header.columns
        if self.header.is_csv:
            line, row_of_file = next(found for i, found in enumerate(self.header.csv_rows()) if i == wanted + 1)
            return f"{name}:{line}", row_of_file[columns.index(column)].strip()
        span = (wanted, 1) if self.header.by_rows else None
        return f"{name}: row {wanted}", self.header.parquet([column], span)[column][0 if span else wanted]


_SIGMA = "sigma_"


def _meaning(name: str, known: set[str], given: set[str]) -> str:
    """What a column may have been meant to be, by its name; else nothing."""
    if name.lower() in known:
        return f"{name.lower()} is"
    sigmas = sorted(column for column in known if column.startswith(_SIGMA))
    if not name.lower().startswith("sigma"):
        return did_you_mean(name, known - given, 0.85)
    rest = name.lower().removeprefix(_SIGMA)  # else every sigma would be much like every other
    like = did_you_mean(rest, [column.removeprefix(_SIGMA) for column in sigmas if column not in given], 0.85)
    return like.replace("mean ", f"mean {_SIGMA}") or f"sigmas are {', '.join(sigmas)}"


def _read_csv(header: Header, numbers: Sequence[str], texts: Sequence[str]) -> tuple[pl.DataFrame, Integers]:
    import polars as pl

    last = header.columns[-1]
    wanted = list(dict.fromkeys((*numbers, *texts, last)))
    chosen = sorted(header.columns.index(c) for c in wanted)
    start = _start_of_header(header.text)
    try:
        frame = of_polars(
            header.name,
            lambda: pl.read_csv(
                BytesIO(header.text[start:]), columns=chosen, infer_schema=False, separator=header.separator
            ),
        )
    except InputError:
        _check_lengths(header)
        _check_quotes(header)
        raise
    frame.columns = [header.columns[i] for i in chosen]  # without blanks around them
    _check_same_rows(header, frame.height)
    rows = np.arange(frame.height)
    nothing = np.logical_and.reduce([cells(frame, column).is_null().to_numpy() for column in wanted])
    if nothing.any():  # lines that are blank, and rows whose cells of use are empty
        blank = np.array([not any(cells) for _, cells in header.csv_rows()][1:], dtype=np.bool_)
        rows = rows[~(nothing & blank)]
        frame = frame[rows]
    if cells(frame, last).is_null().any():  # polars takes a cell that is missing at the end for an empty one
        _check_lengths(header)
    return _columns(frame, numbers, texts, decimal_comma=header.separator != ","), rows


def _read_parquet(
    header: Header, numbers: Sequence[str], texts: Sequence[str], span: tuple[int, int] | None = None
) -> tuple[pl.DataFrame, Integers]:
    frame, first = header.parquet(list(dict.fromkeys((*numbers, *texts))), span), 0 if span is None else span[0]
    for column, kind in frame.schema.items():
        if column in numbers and not (kind.is_numeric() or str(kind) in ("String", "Null")):
            raise InputError(f"{header.name}: {column}", f"type {kind}", "numbers")
        if kind.is_nested() or str(kind) == "Object":
            raise InputError(f"{header.name}: {column}", f"type {kind}", "text")
    return of_polars(header.name, lambda: _columns(frame, numbers, texts)), np.arange(first, first + frame.height)


def _columns(
    frame: pl.DataFrame, numbers: Sequence[str], texts: Sequence[str], *, decimal_comma: bool = False
) -> pl.DataFrame:
    """Columns of numbers, and of texts: all at once, as polars takes a while for every question."""
    import polars as pl

    given = {c: cells(frame, c) for c in (*numbers, *texts)}
    numbered = pl.DataFrame({str(k): column for k, column in enumerate(given.values())})  # no name means more
    read = [
        _text(column, pl.col(name)) if c in texts else _number(column, pl.col(name), decimal_comma)
        for (c, column), name in zip(given.items(), numbered.columns, strict=True)
    ]
    found = numbered.select(read)
    found.columns = list(given)
    return found


def _with_newlines(content: bytes) -> bytes:
    """Every line ends with a newline alone, whatever mixture of ends it had: readers do not take others alike."""
    for end in (b"\r\r\n", b"\r\n", b"\r"):
        content = content.replace(end, b"\n")
    return content


def _separator(text: str) -> str:
    """What stands between the cells of a CSV: a comma, unless its header has more semicolons or tabs."""
    header = re.sub(r'"[^"]*"?', "", text.lstrip("\n").partition("\n")[0])
    return max(",;\t", key=header.count)


def _start_of_header(content: bytes) -> int:
    """Where the first line begins that is not blank, behind a byte order mark."""
    start = 3 if content.startswith(b"\xef\xbb\xbf") else 0
    while content[start : start + 1] in (b"\n", b"\r") and start < len(content):
        start += 1
    return start


def _text(cells: pl.Series, column: pl.Expr) -> pl.Expr:
    """Text without blanks around it, whole numbers without a fraction; null if nothing is left.

    Args:
        cells: The cells.
        column: What stands for them.
    """
    import polars as pl

    if cells.dtype.is_float() and bool(((cells % 1 == 0) & (cells.abs() <= MOST_SIZE)).all()):
        column = column.cast(pl.Int64)  # pandas has floats beside nan
    if cells.dtype.is_integer():
        return column.cast(pl.String)
    return column.cast(pl.String).str.strip_chars().replace("", None)


def _number(cells: pl.Series, column: pl.Expr, decimal_comma: bool) -> pl.Expr:
    """Numbers, also from text: nan where it is none, null where it is empty."""
    import polars as pl

    if cells.dtype != pl.String:
        return column.cast(pl.Float64)
    texts = _text(cells, column)
    if decimal_comma:  # in a text with a point too one of them groups thousands, or it is no number
        texts = texts.str.replace(r"^([^.,]*),([^.,]*)$", "$1.$2")
    numbers = texts.cast(pl.Float64, strict=False).fill_null(float("nan"))
    return pl.when(texts.is_not_null()).then(numbers)


def _check_same_rows(header: Header, n_rows: int) -> None:
    """Raise where polars and the standard library do not read the same rows, which only quotes can make them do."""
    if b'"' in header.text and sum(1 for _ in header.csv_rows()) != n_rows + 1:
        _check_lengths(header)
        _check_quotes(header)
        raise InputError(header.name, "quotes within cells", "whole cells in quotes, or none")


def _check_lengths(header: Header) -> None:
    """Raise for the first row of a CSV that has more or fewer cells than the header."""
    for line, row in header.csv_rows():
        if row and len(row) != len(header.columns):
            goes_on = any("\n" in cell for cell in row)
            hint = "a quote joins it with lines below: is one missing?" if goes_on else ""
            found = f"{len(row)} cell{'s' * (len(row) != 1)}"
            raise InputError(f"{header.name}:{line}", found, f"{len(header.columns)} as in the header", hint)


def _check_quotes(header: Header) -> None:
    """Raise for the first line of a CSV with a quote that is not closed in it."""
    for line, text in enumerate(header.text.split(b"\n"), start=1):
        if text.count(b'"') % 2:
            raise InputError(f"{header.name}:{line}", "a quote that is not closed", "whole cells in quotes, or none")


def unit_hint(figure: float, unit: str, units: Units, limits: tuple[float, float]) -> str:
    """A question whether a figure is in the smaller unit, where it would then lie within the limits, [m] or [rad]."""
    smaller, factor = ("mm", LENGTHS["mm"]) if unit == "m" else ("deg", ANGLES["deg"])
    large = units.name(unit) == unit
    return f"is the table in {smaller}?" if large and limits[0] <= figure * factor <= limits[1] else ""
