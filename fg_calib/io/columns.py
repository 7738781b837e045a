"""Tables of named columns: which columns have a meaning, one reader of CSV, Parquet and frames, one writer."""

from __future__ import annotations

import csv
import logging
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO, StringIO
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
    as_figures,
    as_frame,
    check_different,
    check_names,
    did_you_mean,
)
from fg_calib.io.atomic import decoded, read_bytes, replacing, require_own
from fg_calib.io.yaml import number_hint, shown
from fg_calib.measurements import INSTRUMENTS
from fg_calib.measurements.kinds import Column as ColumnSet
from fg_calib.options import Model
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
            number = as_figures(f"columns: {self.name}: {key}", getattr(self, key), "a number")
            if number.ndim or not np.isfinite(number) or (key == "scale" and number == 0.0):
                expected = "a finite number other than 0" if key == "scale" else "a finite number"
                raise InputError(f"columns: {self.name}: {key}", f"found {shown(getattr(self, key))}", expected)
            object.__setattr__(self, key, float(number))


@dataclass(frozen=True)
class Table:
    """A table of named columns.

    Attributes:
        name: File name, or what a frame is called, for messages.
        columns: Names of all its columns, as they are known.
        frame: The columns of use as they were read, without blank rows; those of a CSV are texts.
        places: Where each row of `frame` stands: its line of a CSV, else its 0-based row, shape (n_rows,).
        separator: The character between the cells of a CSV, empty for others. Where it is no comma, numbers may have
            decimal commas.
        renamed: By column, its conversion, where the table has its own name for it.
    """

    name: str
    columns: tuple[str, ...]
    frame: pl.DataFrame
    places: Sequence[int]
    separator: str = ""
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
        """Read the columns of a CSV, a Parquet file or a frame that have a known name.

        Args:
            table: The file, or a frame of polars or pandas, or a mapping of columns.
            name: What a frame is called in messages.
            known: Names of columns that have a meaning, also if written in another case; None to read all columns.
            joints: Names that the robot gives to columns.
            columns: By known name, what the table calls a column.

        Raises:
            InputError: It cannot be read, it has no rows, or `columns` does not fit.
        """
        source = _open(table, name)
        names = list(source.columns)
        chosen = list(range(len(names)))
        if known is not None:
            known, joints = set(known), set(joints)
            names = _understood(source.name, _rename(source, columns or {}, known | joints), known, joints)
            chosen = [i for i, column in enumerate(names) if column in known or column in joints]
        frame, places = source.read(chosen)
        frame.columns = [names[i] for i in chosen]
        if len(places) == 0 and chosen:
            raise InputError(source.name, "no rows", "at least one")
        return cls(source.name, tuple(names), frame, places, source.separator, dict(columns or {}))

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.places)

    def present(self, *columns: str) -> tuple[str, ...]:
        """Those of `columns` that the table has."""
        return tuple(c for c in columns if c in self.columns)

    def has(self, first: str, model: Model | None = None) -> bool:
        """Whether the table has the columns that belong together, by the first, and the model reads them.

        Raises:
            InputError: It has some of them only.
        """
        of = OF_CONFIGURATIONS[first]
        if model is not None and of not in INSTRUMENTS[model].columns:
            return False
        if not self.present(*of.names):
            return False
        self.require_columns(of.names)
        return True

    def require_columns(self, columns: Sequence[str]) -> None:
        """Raise where the table lacks one of columns that belong together."""
        if missing := [name for name in columns if name not in self.columns]:
            raise InputError(self.name, f"no column {missing[0]}", f"{' '.join(columns)} together")

    def numbers(self, columns: Sequence[str], *, optional: bool = False) -> Floats:
        """The columns as numbers, shape (n_rows, n_columns).

        Args:
            columns: Their names.
            optional: Whether a cell may be empty; it is nan then.

        Raises:
            InputError: A cell is empty, or no finite number.
        """
        import polars as pl

        for column in columns:
            kind = self.frame[column].dtype
            if not (kind.is_numeric() or kind in (pl.String, pl.Null)):
                raise InputError(f"{self.name}: {column}", f"type {kind}", "numbers")
        # Columns are numbered, as polars takes names such as * for patterns.
        given = pl.DataFrame([self.frame[column].alias(str(k)) for k, column in enumerate(columns)])
        read = given.select(_number(name, kind, self.separator in (";", "\t")) for name, kind in given.schema.items())
        finite = read.select(pl.all().is_finite().fill_null(optional)).to_numpy()
        values: Floats = np.array(read.to_numpy(), dtype=np.float64).reshape(self.n_rows, len(columns))
        for k, column in enumerate(columns):
            self.require(finite[:, k], column, "a finite number")
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

        cells = self.frame[column].alias("cells")
        if cells.dtype.is_nested() or cells.dtype == pl.Object:
            raise InputError(f"{self.name}: {column}", f"type {cells.dtype}", "text")
        if cells.dtype.is_float() and bool(((cells % 1 == 0) & (cells.abs() <= MOST_SIZE)).all()):
            cells = cells.cast(pl.Int64)
        texts = cells.to_frame().select(_stripped(pl.col("cells").cast(pl.String)))["cells"]
        if expected:
            self.require(texts.is_not_null().to_numpy(), column, expected)
        return texts

    def names(self, column: str, expected: str) -> pl.Series:
        """The column as texts, without a word such as NA that stands for nothing."""
        names = self.texts(column)
        nothing = names.str.to_lowercase().is_in(NOTHING).fill_null(False)
        self.require(~nothing.to_numpy(), column, expected)
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
        return f"{self.name}:{' row ' * (not self.separator)}{self.places[row]}"


def _number(name: str, kind: pl.DataType, decimal_comma: bool) -> pl.Expr:
    """A column as numbers: null where a cell is empty, nan where a text is no number."""
    import polars as pl

    column = pl.col(name)
    if kind != pl.String:
        return column.cast(pl.Float64)
    text = _stripped(column)
    digits = text.str.replace(r"^([^.,]*),([^.,]*)$", "$1.$2") if decimal_comma else text
    return pl.when(text.is_not_null()).then(digits.cast(pl.Float64, strict=False).fill_null(float("nan"))).alias(name)


def _stripped(column: pl.Expr) -> pl.Expr:
    return column.str.strip_chars().replace("", None)


_ENDINGS = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class _Source:
    """An open table: its columns, without blanks around their names, and how to read those of some numbers.

    Raises:
        InputError: It has no names of columns, or the same twice.
    """

    name: str
    place: str
    columns: Sequence[str]
    read: Callable[[list[int]], tuple[pl.DataFrame, Sequence[int]]]
    separator: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", [column.strip() for column in self.columns])
        if len(self.columns) == 1 and "|" in self.columns[0]:
            found = f"one column {shown(self.columns[0])}"
            raise InputError(self.place, found, "columns with , ; or tab between", "not '|'")
        check_different(self.place, self.columns)


def _open(table: Path | str | Any, name: str) -> _Source:
    """Open a table and read the names of its columns.

    Raises:
        InputError: It is missing, or is no table, or has the same name twice.
    """
    import polars as pl

    require_polars(name)
    if not isinstance(table, os.PathLike | str):
        with _one_line(name, "no table"):
            frame = _as_polars(table, name)
        return _Source(name, name, frame.columns, lambda chosen: (frame[:, chosen], range(frame.height)))
    path = Path(table)
    content = read_bytes(path)
    if path.suffix.lower() not in _ENDINGS:
        hint = "save the sheet as CSV" if path.suffix.lower() in (".xlsx", ".xls", ".ods") else ""
        raise InputError(path.name, f"ending {path.suffix!r}", f"one of {', '.join(_ENDINGS)}", hint)
    if path.suffix.lower() == ".csv":
        return _open_csv(path.name, decoded(content, path.name))

    def read(chosen: list[int]) -> tuple[pl.DataFrame, Sequence[int]]:
        with _one_line(path.name, "not a Parquet file"):
            found = pl.read_parquet(BytesIO(content), columns=chosen)
        return found, range(found.height)

    with _one_line(path.name, "not a Parquet file"):
        names = list(pl.read_parquet_schema(BytesIO(content)))
    return _Source(path.name, path.name, names, read)


def _open_csv(name: str, text: str) -> _Source:
    """Open a CSV, whose separator its header tells."""
    if text.count('"') % 2:
        line = next(i for i, one in enumerate(text.splitlines(), start=1) if one.count('"') % 2)
        raise InputError(f"{name}:{line}", "a quote that is not closed", "whole cells in quotes, or none")
    separator = max(",;\t", key=re.sub(r'"[^"]*"', "", text.lstrip("\r\n")).partition("\n")[0].count)
    places, rows = _csv_rows(name, text, separator)
    if not len(rows):
        raise InputError(f"{name}:1", "an empty file", "a header and rows")
    header = rows[0].split(_BETWEEN)

    def read(chosen: list[int]) -> tuple[pl.DataFrame, Sequence[int]]:
        wrong = (rows.str.count_matches(_BETWEEN, literal=True) != len(header) - 1).arg_true()
        if len(wrong):
            row = wrong[0]
            n, expected = len(rows[row].split(_BETWEEN)), f"{len(header)} as in the header"
            hint = "a quote joins it with lines below: is one missing?" if "\n" in rows[row] else ""
            raise InputError(f"{name}:{places[row]}", f"{n} cell{'s' * (n != 1)}", expected, hint)
        cells = rows[1:].str.split_exact(_BETWEEN, len(header) - 1).struct.unnest()
        return cells[:, chosen], places[1:].tolist()

    return _Source(name, f"{name}:{places[0]}", header, read, separator)


_BETWEEN = "\x1f"
"""What stands between cells once quotes are resolved: ASCII's own separator of units."""


def _csv_rows(name: str, text: str, separator: str) -> tuple[Integers, pl.Series]:
    """The line where each row of a CSV begins, and its cells with `_BETWEEN` between; rows of empty cells are left out.

    Raises:
        InputError: A cell in quotes is longer than any cell is.
    """
    import polars as pl

    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    places = np.arange(1, len(lines) + 1)
    rows = pl.Series(lines).str.replace_all(separator, _BETWEEN, literal=True)
    if '"' in text:
        reader = csv.reader(StringIO("\n".join(lines), newline=""), delimiter=separator)
        begin, joined = [1], list[str]()
        try:
            for cells in reader:
                joined.append(_BETWEEN.join(cells))
                begin.append(reader.line_num + 1)
        except csv.Error as error:
            raise InputError(f"{name}:{begin[-1]}", f"not a CSV: {error}") from None
        places, rows = np.array(begin[:-1]), pl.Series(joined, dtype=pl.String)
    filled = rows.str.strip_chars(f" \t{_BETWEEN}") != ""
    return places[filled.to_numpy()], rows.filter(filled)


def _rename(source: _Source, columns: Mapping[str, Column], known: set[str]) -> list[str]:
    """The names of a table's columns, those with an own name called as they are known.

    Raises:
        InputError: A known name is not known, or the table has no such column.
    """
    place = f"{source.name}: columns"
    check_names(place, columns, sorted(known), "column")
    own = {name: column.name.strip() for name, column in columns.items()}
    for name, given in own.items():
        check_names(f"{place}: {name}", [given], source.columns, "column")
    check_different(f"{place}: the table's", own.values())
    meant = {given: name for name, given in own.items()}
    return [meant.get(name) or f"{name} (the table's)" * (name in own) or name for name in source.columns]


def _understood(table: str, names: Sequence[str], known: set[str], joints: set[str]) -> list[str]:
    """Names of columns, those of another case called as they are known; warns of names that only look known.

    Raises:
        InputError: A known name stands behind a #, as if the header were a comment.
    """
    found, given = list(names), set(names)
    for i, name in enumerate(names):
        if name in known or name in joints:
            continue
        if name.startswith("#") and (bare := name.lstrip("# ").lower()) in known:
            raise InputError(table, f"column {shown(name)}", f"{bare}, or another name")
        if name.lower() in known and name.lower() not in given:
            found[i] = name.lower()
        elif name.lower().startswith("sigma"):
            sigmas = ", ".join(sorted(column for column in known if column.startswith("sigma_")))
            _log.warning("%s: column %r is not used; sigmas are %s", table, name, sigmas)
        elif hint := f"{name.lower()} is" if name.lower() in known else did_you_mean(name, known - given, 0.85):
            _log.warning("%s: column %r is not used; %s", table, name, hint)
    return found


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
    try:
        yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:  # of a frame's objects polars may raise anything
        if type(error).__name__ == "PanicException":
            raise InputError(name, f"{what}: polars cannot read it", hint="write it anew") from None
        if not isinstance(error, Exception):
            raise
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
    with replacing(Path(path)) as temporary:
        frame.select(*columns).write_csv(temporary)
