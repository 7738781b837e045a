"""Columns of a CSV or Parquet file: read, checked, and named in messages by line or row."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.errors import InputError
from fg_calib.files.disk import require_file
from fg_calib.files.frames import as_polars
from fg_calib.files.units import ANGLES, LENGTHS, Units
from fg_calib.measurements.dataset import Booleans, Floats

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_ROW, _SHORT = "row of the file", "last cell is empty"  # columns of our own beside those of the file


@dataclass(frozen=True)
class Header:
    """A table's file and the names of its columns."""

    path: Path
    columns: tuple[str, ...]
    frame: pl.DataFrame | None = None  # what the path only names, where the table is in no file

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.path.name

    @property
    def is_csv(self) -> bool:
        """Whether it is a CSV, else a Parquet file or a frame."""
        return self.frame is None and self.path.suffix.lower() == ".csv"

    def scan(self) -> pl.LazyFrame:
        """The rows of a Parquet file or a frame."""
        import polars as pl

        return pl.scan_parquet(self.path) if self.frame is None else self.frame.lazy()

    @classmethod
    def read(cls, table: Path | str | Any, name: str) -> Header:
        """Read the header of a file, or of a frame by this name."""
        import polars as pl

        if not isinstance(table, Path | str):
            frame = as_polars(table, name)
            return cls(Path(name), tuple(frame.columns), frame)
        path = Path(table)
        require_file(path)
        header = cls(path, ())
        place = header.name
        if header.is_csv:
            line, columns = next(header.csv_rows(), (1, []))
            place = f"{place}:{line}"
        elif path.suffix.lower() in {".parquet", ".pq"}:
            try:
                columns = list(pl.read_parquet_schema(path))
            except (pl.exceptions.PolarsError, OSError) as error:
                raise InputError(place, f"not a Parquet file: {_first_line(error)}") from None
        else:
            raise InputError(place, f"ending {path.suffix!r}", "one of .csv, .parquet, .pq")
        columns = [column.strip() for column in columns]
        if not columns:
            raise InputError(place, "an empty file", "a header and rows")
        for column in columns:
            if columns.count(column) > 1:
                raise InputError(place, f"two columns called {column!r}", "different names")
        return cls(path, tuple(columns))

    def csv_rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and cells of the header and of each row; blank lines count from the header on, as in polars."""
        with self.path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            reader = csv.reader(file)
            started = False
            for cells in reader:
                started = started or bool(cells)
                if started:
                    yield reader.line_num, cells

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
        return self.frame.select(columns).to_numpy(order="c")

    def positive(self, columns: Sequence[str], default: float | None, factor: float) -> Floats:
        """Columns of positive figures, times `factor`; an empty cell is `default`, an error if that is None."""
        values = self.numbers(columns, optional=default is not None)
        for column, value in zip(columns, values.T, strict=True):
            self.require(~(value <= 0.0), column, "a number above 0")
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
            found = "an empty cell" if cell in {None, ""} else repr(cell)
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
        cell = self.header.scan().select(column).slice(wanted, 1).collect().item()
        return f"{name}: row {wanted}", cell


def _read_csv(header: Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    scan = pl.scan_csv(header.path, infer_schema=False, with_column_names=lambda _: list(header.columns))
    rows = scan.with_row_index(_ROW).filter(~pl.all_horizontal(pl.col(header.columns).is_null()))  # no blank lines
    short = pl.col(header.columns[-1]).is_null().alias(_SHORT)
    try:
        frame = rows.select(_ROW, short, *map(_number, numbers), *map(_text, texts)).collect(engine="streaming")
    except (pl.exceptions.PolarsError, OSError) as error:
        _check_lengths(header)
        raise InputError(header.name, f"not a CSV: {_first_line(error)}") from None
    if frame[_SHORT].any():  # polars takes a cell that is missing at the end for an empty one
        _check_lengths(header)
    return frame


def _read_parquet(header: Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    scan = header.scan()
    types = scan.collect_schema()
    for column in numbers:
        if not (types[column].is_numeric() or types[column] in (pl.String, pl.Null)):
            raise InputError(f"{header.name}: {column}", f"type {types[column]}", "numbers")
    read = [_number(c) if types[c] == pl.String else pl.col(c).cast(pl.Float64) for c in numbers]
    try:
        return scan.with_row_index(_ROW).select(_ROW, *read, *map(_text, texts)).collect()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise InputError(header.name, f"not a Parquet file: {_first_line(error)}") from None


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
