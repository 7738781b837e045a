"""Columns of a CSV or Parquet file: read, checked, and named in messages by line or row."""

from __future__ import annotations

import csv
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fg_calib.errors import InputError
from fg_calib.files.disk import decoded, read_bytes, silent_stderr
from fg_calib.files.frames import as_polars
from fg_calib.files.schema import shown
from fg_calib.files.units import ANGLES, LENGTHS, Units
from fg_calib.measurements.dataset import Booleans, Floats
from fg_calib.options import did_you_mean
from fg_calib.sizes import LEAST_SIZE, MOST_SIZE, ORDINARY

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)

_ROW = "row of the file"  # a column of our own beside those of the file

_ENDINGS = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class Header:
    """A table's content and the names of its columns.

    Attributes:
        path: Its file; what it is called where it is in none.
        columns: Names of the columns.
        content: The bytes of the file.
        frame: The table, where it is in no file.
    """

    path: Path
    columns: tuple[str, ...]
    content: bytes = field(default=b"", repr=False)
    frame: pl.DataFrame | None = None

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.path.name

    @property
    def is_csv(self) -> bool:
        """Whether it is a CSV, else a Parquet file or a frame."""
        return self.frame is None and self.path.suffix.lower() == ".csv"

    def parquet(self, columns: Sequence[str]) -> pl.DataFrame:
        """Columns of a Parquet file or a frame.

        Raises:
            InputError: It cannot be read.
        """
        import polars as pl

        if self.frame is not None:
            return self.frame.select(columns)
        chosen = sorted(self.columns.index(c) for c in columns)
        frame = _of_polars(self.name, lambda: pl.read_parquet(BytesIO(self.content), columns=chosen))
        frame.columns = [self.columns[i] for i in chosen]  # without blanks around them
        return frame.select(columns)

    @classmethod
    def read(cls, table: Path | str | Any, name: str) -> Header:
        """Read the header of a file, or of a frame by this name."""
        import polars as pl

        if not isinstance(table, Path | str):
            frame = as_polars(table, name)
            return cls(Path(name), tuple(frame.columns), frame=frame)
        path = Path(table)
        if path.suffix.lower() not in _ENDINGS:
            read_bytes(path)
            raise InputError(path.name, f"ending {path.suffix!r}", f"one of {', '.join(_ENDINGS)}")
        header = cls(path, (), read_bytes(path))
        place = header.name
        if header.is_csv:
            header = replace(header, content=_with_newlines(header.content))
            decoded(header.content, header.name)
            line, columns = next(header.csv_rows(), (1, []))
            place = f"{place}:{line}"
        else:
            columns = list(_of_polars(place, lambda: pl.read_parquet_schema(BytesIO(header.content))))
        columns = [column.strip() for column in columns]
        if not columns:
            raise InputError(place, "an empty file", "a header and rows")
        for column, n in Counter(columns).items():
            if n > 1:
                raise InputError(place, f"two columns called {column!r}", "different names")
        return replace(header, columns=tuple(columns))

    def csv_rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and cells of the header and of each row; blank lines count from the header on, as in polars."""
        file = TextIOWrapper(BytesIO(self.content), encoding="utf-8-sig", errors="replace", newline="")
        csv.field_size_limit(max(len(self.content), csv.field_size_limit()))
        reader = csv.reader(file)
        started = False
        try:
            for cells in reader:
                started = started or bool(cells)
                if started:
                    yield reader.line_num, cells
        except csv.Error as error:
            raise InputError(f"{self.name}:{reader.line_num}", f"not a CSV: {error}") from None

    def understood(self, known: Iterable[str], others: Iterable[str] = ()) -> Header:
        """The same with the columns that are known by another case called as they are known.

        A column that is neither known nor one of the others, but nearly reads like a known one, is warned of.

        Args:
            known: Columns that mean something.
            others: Names that somebody else has given.
        """
        known, others = set(known), set(others)
        names = list(self.columns)
        for i, name in enumerate(names):
            if name in known or name in others:
                continue
            if name.lower() in known and name.lower() not in names:
                names[i] = name.lower()
            elif hint := did_you_mean(name, known - set(names), 0.85):
                _log.warning("%s: column %r is not used; %s", self.name, name, hint)
        frame = None if self.frame is None else self.frame.rename(dict(zip(self.columns, names, strict=True)))
        return replace(self, columns=tuple(names), frame=frame)

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
    """The columns of use: numbers as floats, texts without blanks around them; empty cells are null."""

    header: Header
    frame: pl.DataFrame

    @classmethod
    def read(cls, header: Header, numbers: Sequence[str], texts: Sequence[str]) -> Table:
        """Read the columns of `numbers` and `texts`."""
        frame = (_read_csv if header.is_csv else _read_parquet)(header, numbers, texts)
        if frame.height == 0:
            raise InputError(header.name, "no rows", "at least one")
        return cls(header, frame)

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.frame.height

    def numbers(self, columns: Sequence[str], *, optional: bool = False) -> Floats:
        """The columns, shape (n_rows, n_columns); an empty cell is nan if `optional`, else an error."""
        for column in columns:
            good = self.frame[column].is_finite().fill_null(optional)
            self.require(good.to_numpy(), column, "a finite number")
        values = self.frame.select(columns).to_numpy(order="c")
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
            raise InputError(f"{place}: {column}", f"found {found}", expected, hint)

    def place(self, row: int) -> str:
        """File and line of a row (the header is line 1); of a Parquet file the 0-based row."""
        return self._look_up(row, self.header.columns[0])[0]

    def _look_up(self, row: int, column: str) -> tuple[str, Any]:
        """Place and original content of a cell, for messages; slow, since it reads the file again."""
        wanted = self.frame[_ROW][row]
        name, columns = self.header.name, self.header.columns
        if self.header.is_csv:
            line, cells = next(found for i, found in enumerate(self.header.csv_rows()) if i == wanted + 1)
            return f"{name}:{line}", cells[columns.index(column)].strip()
        return f"{name}: row {wanted}", self.header.parquet([column])[column][wanted]


def _read_csv(header: Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    last = header.columns[-1]
    wanted = list(dict.fromkeys((*numbers, *texts, last)))
    chosen = sorted(header.columns.index(c) for c in wanted)
    start = _start_of_header(header.content)
    try:
        frame = _of_polars(
            header.name,
            lambda: pl.read_csv(BytesIO(header.content[start:]), columns=chosen, infer_schema=False),
        )
    except InputError:
        _check_lengths(header)
        raise
    frame.columns = [header.columns[i] for i in chosen]  # without blanks around them
    rows = frame.with_row_index(_ROW)
    nothing = rows.select(pl.all_horizontal(pl.col(wanted).is_null())).to_series().to_numpy()
    if nothing.any():  # lines that are blank, and rows whose cells of use are empty
        blank = np.array([not any(cells) for _, cells in header.csv_rows()][1:], dtype=np.bool_)
        rows = rows.filter(~(nothing & blank[: len(nothing)]))
    if rows[last].is_null().any():  # polars takes a cell that is missing at the end for an empty one
        _check_lengths(header)
    return rows.select(_ROW, *map(_number, numbers), *map(_text, texts))


def _read_parquet(header: Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    frame = header.parquet(list(dict.fromkeys((*numbers, *texts))))
    types = frame.schema
    for column in numbers:
        if not (types[column].is_numeric() or types[column] in (pl.String, pl.Null)):
            raise InputError(f"{header.name}: {column}", f"type {types[column]}", "numbers")
    read = [_number(c) if types[c] == pl.String else pl.col(c).cast(pl.Float64) for c in numbers]
    rows = frame.with_row_index(_ROW)
    return _of_polars(header.name, lambda: rows.select(_ROW, *read, *map(_text, texts)))


_Found = TypeVar("_Found")


def _of_polars(name: str, read: Callable[[], _Found]) -> _Found:
    """What polars makes of a table; its errors, and panics of its Rust, become one line.

    Raises:
        InputError: It makes nothing of it.
    """
    import polars as pl

    what = {".csv": "CSV", ".parquet": "Parquet file", ".pq": "Parquet file"}.get(Path(name).suffix.lower(), "table")
    try:
        # Only what reads Parquet panics, and says so on the process's stderr, which is everybody's.
        with silent_stderr() if what == "Parquet file" else nullcontext():
            return read()
    except (pl.exceptions.PolarsError, OSError, ValueError, TypeError) as error:
        raise InputError(name, f"not a {what}: {_first_line(error)}") from None
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(name, f"not a {what}: polars cannot read it", hint="write it anew") from None


def _with_newlines(content: bytes) -> bytes:
    """Lines end with a newline; those of old Macs with a carriage return alone."""
    return content if b"\n" in content else content.replace(b"\r", b"\n")


def _start_of_header(content: bytes) -> int:
    """Where the first line begins that is not blank, behind a byte order mark."""
    start = 3 if content.startswith(b"\xef\xbb\xbf") else 0
    while content[start : start + 1] in (b"\n", b"\r") and start < len(content):
        start += 1
    return start


def _text(column: str) -> pl.Expr:
    """Text without blanks around it; null if nothing is left."""
    import polars as pl

    text = pl.col(column).cast(pl.String).str.strip_chars()
    return pl.when(text != "").then(text)


def _number(column: str) -> pl.Expr:
    """Text as a number: nan where it is not one, null where it is empty."""
    import polars as pl

    text = pl.col(column).str.strip_chars()
    return text.cast(pl.Float64, strict=False).fill_null(pl.when(text != "").then(float("nan")))


def _check_lengths(header: Header) -> None:
    """Raise for the first row of a CSV that has more or fewer cells than the header."""
    for line, cells in header.csv_rows():
        if cells and len(cells) != len(header.columns):
            expected = f"{len(header.columns)} as in the header"
            raise InputError(f"{header.name}:{line}", f"{len(cells)} cells", expected)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def unit_hint(figure: float, unit: str, units: Units, limits: tuple[float, float]) -> str:
    """A question whether a figure is in the smaller unit, where it would then lie within the limits, [m] or [rad]."""
    smaller, factor = ("mm", LENGTHS["mm"]) if unit == "m" else ("deg", ANGLES["deg"])
    large = units.name(unit) == unit
    return f"is the table in {smaller}?" if large and limits[0] <= figure * factor <= limits[1] else ""
