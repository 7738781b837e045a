"""Tables of named columns: which columns have a meaning, one reader of CSV, Parquet and frames, one writer."""

from __future__ import annotations

import csv
import logging
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fg_calib.inputs import (
    LEAST_SIZE,
    MOST_SIZE,
    NOTHING,
    ORDINARY,
    Booleans,
    Floats,
    InputError,
    Integers,
    as_frame,
    check_different,
    check_names,
    check_number,
    did_you_mean,
)
from fg_calib.io.atomic import decoded, read_bytes, require_own, write_text
from fg_calib.io.yaml import number_hint, shown
from fg_calib.measurements import INSTRUMENTS
from fg_calib.measurements import Column as ColumnSet
from fg_calib.parallel import require_polars

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)


OF_CONFIGURATIONS: Mapping[str, ColumnSet] = {
    of.names[0]: of
    for of in (
        ColumnSet(("id",), "", "Name of the configuration; the same id is the same one, in all tables"),
        ColumnSet(("split",), "", "train (or empty) or test: test rows are predicted, never fitted"),
        *(of for instrument in INSTRUMENTS.values() for of in instrument.columns),
    )
}
"""The columns of a table of configurations besides the joint readings, those that belong together by the first."""

OF_PAIRS: Mapping[str, ColumnSet] = {
    of.names[0]: of
    for of in (
        ColumnSet(("a", "b"), "", "The two configurations (ids, or 0-based rows) or contact points"),
        ColumnSet(("distance",), "length", "The distance between them; empty: not measured"),
        ColumnSet(("angle",), "angle", "The rotation angle between them, 0 to 180 degrees; empty: not measured"),
        ColumnSet(("sigma_distance",), "length", "1 sigma of the distance"),
        ColumnSet(("sigma_angle",), "angle", "1 sigma of the angle"),
        OF_CONFIGURATIONS["split"],
    )
}
"""The columns of a table of pairs, likewise."""


def names_of(sets: Iterable[ColumnSet]) -> frozenset[str]:
    """The names of columns."""
    return frozenset(name for one in sets for name in one.names)


KNOWN = names_of(OF_CONFIGURATIONS.values())
"""Names of the columns of a table of configurations, besides the joint readings."""


@dataclass(frozen=True)
class Column:
    """A table's own name of a column, and how its values convert: (value - zero) * scale, as encoder counts do.

    Attributes:
        name: In the table's header.
        scale: One of its units, in the unit of the table.
        zero: The value that means 0.

    Raises:
        InputError: The name is empty, a number is not finite, or the scale is 0.
    """

    name: str
    scale: float = 1.0
    zero: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise InputError("columns: name", f"found {shown(self.name)}", "the name of a column")
        for key in ("scale", "zero"):
            check_number(f"columns: {self.name}: {key}", getattr(self, key), least=-math.inf)
        if not self.scale:
            raise InputError(f"columns: {self.name}: scale", "found 0", "a number other than 0")


@dataclass(frozen=True)
class Table:
    """A table of named columns.

    Attributes:
        name: File name, or what a frame is called, for messages.
        columns: Names of all its columns, as they are known.
        frame: The columns, without blank rows. Those of a CSV are texts.
        separator: The character between the cells of a CSV; empty of others.
        lines: The line of each row of a CSV; empty of others.
        renamed: By column, its conversion, where the table has its own name for it.
    """

    name: str
    columns: tuple[str, ...]
    frame: pl.DataFrame
    separator: str = ""
    lines: Integers | Sequence[int] = ()
    renamed: Mapping[str, Column] = field(default_factory=dict)

    @classmethod
    def read(
        cls,
        table: Path | str | Any,
        name: str,
        known: Iterable[str] | None = None,
        *,
        joints: Iterable[str] = (),
        columns: Mapping[str, Column] | None = None,
    ) -> Table:
        """Read a CSV, a Parquet file or a frame.

        Args:
            table: The file, or a frame of polars or pandas, or a mapping of columns.
            name: What a frame is called in messages.
            known: Names of columns that have a meaning, also if written in another case; None if none has.
            joints: Names that the robot gives to columns.
            columns: By known name, what the table calls a column.

        Raises:
            InputError: It cannot be read, it has no rows, or `columns` does not fit.
        """
        require_polars(name)
        is_file = isinstance(table, os.PathLike | str)
        name = Path(table).name if is_file else name
        with _one_line(name, "no table"):
            found = _read_file(Path(table)) if is_file else cls(name, (), _as_polars(table, name))
            header = [column.strip() for column in found.columns or found.frame.columns]
            check_different(name, header)
            names = header if known is None else _understood(name, header, set(known), set(joints), columns or {})
            found.frame.columns = names
        if not found.n_rows:
            raise InputError(name, "no rows", "at least one")
        return replace(found, columns=tuple(names), renamed=dict(columns or {}))

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.frame.height

    def present(self, *columns: str) -> tuple[str, ...]:
        """Those of `columns` that the table has."""
        return tuple(c for c in columns if c in self.columns)

    def has(self, *columns: str) -> bool:
        """Whether the table has columns that belong together.

        Raises:
            InputError: It has some of them only.
        """
        missing = [name for name in columns if name not in self.columns]
        if missing and len(missing) < len(columns):
            raise InputError(self.name, f"no column {missing[0]}", f"{' '.join(columns)} together")
        return not missing

    def numbers(self, columns: Sequence[str], *, optional: bool = False) -> Floats:
        """The columns as numbers, shape (n_rows, n_columns).

        Args:
            columns: Their names.
            optional: Whether a cell may be empty; it is nan then.

        Raises:
            InputError: A cell is empty, or no finite number.
        """
        import polars as pl

        values = np.empty((self.n_rows, len(columns)))
        for k, column in enumerate(columns):
            cells = self.frame[column]
            if cells.dtype == pl.String:
                texts = self.texts(column)
                if self.separator in (";", "\t"):
                    texts = texts.str.replace(r"^([^.,]*),([^.,]*)$", "$1.$2")
                cells = texts.cast(pl.Float64, strict=False)
                cells = cells.set(cells.is_null() & texts.is_not_null(), np.nan)
            elif not cells.dtype.is_numeric() and cells.dtype != pl.Null:
                raise InputError(f"{self.name}: {column}", f"type {cells.dtype}", "numbers")
            cells = cells.cast(pl.Float64)
            self.require(cells.is_finite().fill_null(optional).to_numpy(), column, "a finite number")
            values[:, k] = cells.to_numpy()
            if (own := self.renamed.get(column)) is not None:
                values[:, k] = (values[:, k] - own.zero) * own.scale
            self.require(~(np.abs(values[:, k]) > MOST_SIZE), column, ORDINARY)
        return values

    def positive(self, columns: Sequence[str], default: float | None, factor: float) -> Floats:
        """Columns of positive numbers, times `factor`; an empty cell is `default`, an error if that is None."""
        values = self.numbers(columns, optional=default is not None)
        for column, value in zip(columns, values.T, strict=True):
            self.require(~(value <= 0.0), column, "a number above 0")
            self.require(~(value < LEAST_SIZE), column, ORDINARY)
        return values * factor if default is None else np.where(np.isnan(values), default, values * factor)

    def texts(self, column: str, expected: str = "") -> pl.Series:
        """The column without blanks around its cells, null where they are empty: an error if something is expected.

        Whole numbers have no fraction: pandas makes floats of them where cells are empty.
        """
        import polars as pl

        cells = self.frame[column]
        if cells.dtype.is_nested() or cells.dtype == pl.Object:
            raise InputError(f"{self.name}: {column}", f"type {cells.dtype}", "text")
        if cells.dtype.is_float() and bool(((cells % 1 == 0) & (cells.abs() <= MOST_SIZE)).all()):
            cells = cells.cast(pl.Int64)
        texts = cells.cast(pl.String).str.strip_chars()
        texts = texts.set(texts == "", None)
        if expected:
            self.require(texts.is_not_null().to_numpy(), column, expected)
        return texts

    def names(self, column: str, expected: str, *, optional: bool = False) -> pl.Series:
        """The column as texts, without a word such as NA that stands for nothing; null where a cell may be empty."""
        names = self.texts(column, "" if optional else expected)
        self.require(~names.str.to_lowercase().is_in(NOTHING).fill_null(False).to_numpy(), column, expected)
        return names

    def test_rows(self) -> Booleans:
        """True where `split` says test, shape (n_rows,)."""
        if "split" not in self.columns:
            return np.zeros(self.n_rows, dtype=np.bool_)
        split = self.texts("split").fill_null("train")
        self.require(split.is_in(["train", "test"]).to_numpy(), "split", "train or test")
        return (split == "test").to_numpy()

    def require(self, good: Booleans, column: str, expected: str, hint: str = "") -> None:
        """Raise for the first cell of `column` that is not `good`, shape (n_rows,)."""
        if not good.all():
            row = int(np.argmin(good))
            cell = self.frame[column][row]
            cell = cell.strip() if isinstance(cell, str) else cell
            found = "an empty cell" if cell in {None, ""} else shown(cell)
            raise InputError(f"{self.place(row)}: {column}", f"found {found}", expected, hint or number_hint(cell))

    def place(self, row: int) -> str:
        """File and line of a row of a CSV (the header is line 1); of a Parquet file or a frame the 0-based row."""
        return f"{self.name}:{self.lines[row]}" if self.separator else f"{self.name}: row {row}"


def _read_file(path: Path) -> Table:
    """The columns of a Parquet file or a CSV.

    Raises:
        InputError: It is missing, or is no table.
    """
    import polars as pl

    content, ending = read_bytes(path), path.suffix.lower()
    if ending == ".csv":
        return _read_csv(path.name, decoded(content, path.name))
    if ending not in (".parquet", ".pq"):
        hint = "save the sheet as CSV" if ending in (".xlsx", ".xls", ".ods") else ""
        raise InputError(path.name, f"ending {path.suffix!r}", "one of .csv, .parquet, .pq", hint)
    with _one_line(path.name, "not a Parquet file"):
        return Table(path.name, (), pl.read_parquet(BytesIO(content)))


def _read_csv(name: str, text: str) -> Table:
    """The cells of a CSV as texts, without blank rows; the header tells the separator.

    Raises:
        InputError: It is empty, a quote is not closed on its line, or a row has more or fewer cells than the header.
    """
    import polars as pl

    if not text.strip(" \t\r\n,;"):
        raise InputError(f"{name}:1", "an empty file", "a header and rows")
    read = partial(pl.read_csv, has_header=False, infer_schema=False)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = read(text.encode(), separator="\x1f", quote_char=None, new_columns=["line"]).with_row_index("number", 1)
    lines = lines.filter(pl.col("line").str.strip_chars(" \t,;") != "")
    unquoted = lines["line"].str.replace_all('"[^"]*"', "") if '"' in text else lines["line"]
    separator = max(",;\t", key=unquoted[0].count)
    header = next(csv.reader([lines["line"][0].removeprefix("#")], delimiter=separator))  # as numpy writes it
    n_cells = unquoted.str.count_matches(separator, literal=True) + 1
    misfits = unquoted.str.contains('"', literal=True) | (n_cells != len(header))
    if misfits.any():
        row = int(np.argmax(misfits))
        place, n = f"{name}:{lines['number'][row]}", n_cells[row]
        if '"' in unquoted[row]:
            raise InputError(place, "a quote that is not closed", "whole cells in quotes, or none")
        raise InputError(place, f"{n} cell{'s' * (n != 1)}", f"{len(header)} as in the header")
    frame = read(lines["line"].str.join("\n").item().encode(), separator=separator).slice(1)
    return Table(name, tuple(header), frame, separator, lines["number"].to_numpy()[1:])


def _understood(
    table: str, header: Sequence[str], known: set[str], joints: set[str], columns: Mapping[str, Column]
) -> list[str]:
    """Names of columns as they are known: by `columns`, or in another case; warns of names that only look known.

    Raises:
        InputError: A key of `columns` is not known, or the table has no such column.
    """
    place = f"{table}: columns"
    check_names(place, columns, sorted(known | joints), "column")
    for name, column in columns.items():
        check_names(f"{place}: {name}", [column.name.strip()], header, "column")
    check_different(f"{place}: the table's", [column.name.strip() for column in columns.values()])
    own = {column.name.strip(): name for name, column in columns.items()}
    names = [own.get(name) or f"{name} (the table's)" * (name in columns) or name for name in header]
    for i, name in enumerate(names):
        lower = name.lower()
        if name in known or name in joints:
            continue
        if lower in known and lower not in names:
            names[i] = lower
        elif lower.startswith("sigma"):
            sigmas = ", ".join(sorted(column for column in known if column.startswith("sigma_")))
            _log.warning("%s: column %r is not used; sigmas are %s", table, name, sigmas)
        elif hint := f"{lower} is" if lower in known else did_you_mean(name, known.difference(names), 0.85):
            _log.warning("%s: column %r is not used; %s", table, name, hint)
    return names


def _as_polars(table: Any, name: str) -> pl.DataFrame:
    """A frame of polars from one of polars or pandas, or from a mapping of columns; nan is an empty cell.

    Raises:
        InputError: It is no table.
    """
    import polars as pl
    import polars.selectors as cs

    frame = table if isinstance(table, Mapping) else as_frame(name, table)
    if frame is None or not (isinstance(frame, Mapping | pl.DataFrame) or hasattr(frame, "to_dict")):
        raise InputError(name, f"found a {type(table).__name__}", "a path, or a frame of polars or pandas")
    if not isinstance(frame, pl.DataFrame):
        columns = frame if isinstance(frame, Mapping) else frame.to_dict("list")
        check_different(name, columns)
        frame = pl.DataFrame({str(key): _series(values) for key, values in columns.items()})
    if not frame.columns:
        raise InputError(name, "a frame without columns", "a frame with rows")
    return frame.with_columns(cs.float().fill_nan(None))


def _series(values: Any) -> Any:
    """A column with None for pandas' missing values; cells of several types become texts, so that none is lost."""
    import polars as pl

    if not isinstance(values, list):
        return values
    cells = [None if type(value).__name__ in ("NAType", "NaTType") else value for value in values]
    try:
        return pl.Series(cells)
    except (pl.exceptions.PolarsError, TypeError, OverflowError):
        return pl.Series([None if value is None or value != value else str(value) for value in cells], dtype=pl.String)  # noqa: PLR0124


@contextmanager
def _one_line(name: str, what: str) -> Iterator[None]:
    """Errors of polars, and panics of its Rust, become one line.

    Raises:
        InputError: It makes nothing of a table.
    """
    import polars as pl

    try:
        yield
    except (InputError, MemoryError):
        raise
    except (Exception, pl.exceptions.PanicException) as error:  # of a frame's objects polars may raise anything
        first = str(error).strip().partition("\n")[0]
        raise InputError(name, f"{what}: {first or type(error).__name__}") from None


def require_own_csv(path: Path, beginning: bytes) -> None:
    """Check that a table can be written: a CSV that is not there yet, or was written as one of that kind.

    Args:
        path: Where.
        beginning: How tables of that kind begin.

    Raises:
        InputError: It cannot.
    """
    if path.suffix.lower() != ".csv":
        raise InputError(str(path), f"ending {path.suffix!r}", ".csv")
    if not path.parent.is_dir():
        raise InputError(str(path), f"there is no folder {path.parent}")
    require_own(path.parent, {path.name: beginning})


def write_csv(path: Path | str, columns: Mapping[str, ArrayLike | None]) -> None:
    """Write a CSV, whole or not at all; floats read back exactly.

    Args:
        path: The file to write.
        columns: The columns by name, all of one length; None for one that is still to be filled in.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    import polars as pl

    given = {name: np.asarray(values) for name, values in columns.items() if values is not None}
    frame = pl.DataFrame(given).with_columns(pl.lit(None).alias(name) for name in columns if name not in given)
    write_text(Path(path), frame.select(*columns).write_csv())
