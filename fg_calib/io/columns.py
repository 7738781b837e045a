"""Tables of named columns: which columns have a meaning, one reader of CSV, Parquet and frames, one writer."""

from __future__ import annotations

import csv
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fg_calib.arrays import NOTHING, as_figures, as_frame, check_different
from fg_calib.errors import InputError
from fg_calib.io.atomic import decoded, read_bytes, replacing, require_own
from fg_calib.io.yaml import number_hint, shown
from fg_calib.libraries import require_polars
from fg_calib.measurements.dataset import Booleans, Floats, Integers
from fg_calib.measurements.kinds import INSTRUMENTS
from fg_calib.measurements.kinds import Column as ColumnSet
from fg_calib.options import Model, check_names, did_you_mean
from fg_calib.sizes import LEAST_SIZE, MOST_SIZE, ORDINARY

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
        rows: Row of the file that each row of `frame` is, counted from 0 after the header, shape (n_rows,).
        text: The bytes of a CSV.
        separator: The character between the cells of a CSV. Where it is no comma, numbers may have decimal commas.
        renamed: By column, its conversion, where the table has its own name for it.
    """

    name: str
    columns: tuple[str, ...]
    frame: pl.DataFrame
    rows: Integers
    text: bytes = field(default=b"", repr=False)
    separator: str = ","
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
        source = _Source.of(table, name)
        names = list(source.columns)
        chosen = list(range(len(names)))
        if known is not None:
            known, joints = set(known), set(joints)
            names = _understood(source.name, _rename(source, columns or {}, known | joints), known, joints)
            chosen = [i for i, column in enumerate(names) if column in known or column in joints]
        frame, rows = source.read(chosen)
        frame.columns = [names[i] for i in chosen]
        if len(rows) == 0 and chosen:
            raise InputError(source.name, "no rows", "at least one")
        return cls(source.name, tuple(names), frame, rows, source.text, source.separator, dict(columns or {}))

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.rows)

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
        read = given.select(_number(name, kind, self.separator != ",") for name, kind in given.schema.items())
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
        """File and line of a row (the header is line 1); of a Parquet file or a frame the 0-based row."""
        k = int(self.rows[row])
        return f"{self.name}:{_records(self.text)[k + 1][0]}" if self.text else f"{self.name}: row {k}"


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
    """Where a table is read from: the text of a CSV, the content of a Parquet file, or a frame.

    Attributes:
        name: What it is called in messages.
        columns: Names of its columns, without blanks around them.
        place: Where they stand, for messages.
        text: The bytes of a CSV, whose lines end in a newline alone.
        separator: The character between its cells.
        content: The bytes of a Parquet file.
        frame: The frame.
    """

    name: str
    columns: tuple[str, ...] = ()
    place: str = ""
    text: bytes = b""
    separator: str = ","
    content: bytes = b""
    frame: pl.DataFrame | None = None

    @classmethod
    def of(cls, table: Path | str | Any, name: str) -> _Source:
        """Open a table and read the names of its columns.

        Raises:
            InputError: It is missing, or is no table, or has the same name twice.
        """
        import polars as pl

        if isinstance(table, str) and not table:
            raise InputError(name, "found ''", "a path, or a frame of polars or pandas")
        if not isinstance(table, os.PathLike | str):
            with _one_line(name, "no table"):
                frame = _as_polars(table, name)
            return cls(name, tuple(column.strip() for column in frame.columns), name, frame=frame)._checked()
        path = Path(table)
        content = read_bytes(path)
        if path.suffix.lower() not in _ENDINGS:
            hint = "save the sheet as CSV" if path.suffix.lower() in (".xlsx", ".xls", ".ods") else ""
            raise InputError(path.name, f"ending {path.suffix!r}", f"one of {', '.join(_ENDINGS)}", hint)
        if path.suffix.lower() != ".csv":
            with _one_line(path.name, "not a Parquet file"):
                names = list(pl.read_parquet_schema(BytesIO(content)))
            return cls(path.name, tuple(n.strip() for n in names), path.name, content=content)._checked()
        for end in (b"\r\r\n", b"\r\n", b"\r"):
            content = content.replace(end, b"\n")
        header = re.sub(r'"[^"]*"?', "", decoded(content, path.name).lstrip("\n").partition("\n")[0])
        separator = max(",;\t", key=header.count)
        line, record = next(iter(_records(content, 1)), (1, b""))
        _require_closed(f"{path.name}:{line}", record)
        text = record.decode(errors="replace").removeprefix("\ufeff")
        try:
            names = [cell.strip() for cell in next(csv.reader(StringIO(text, newline=""), delimiter=separator), [])]
        except csv.Error as error:
            raise InputError(f"{path.name}:{line}", f"not a CSV: {error}") from None
        return cls(path.name, tuple(names), f"{path.name}:{line}", content, separator)._checked()

    def _checked(self) -> _Source:
        names = self.columns
        if not any(names):
            found = "an empty file" if not names else "no names of columns"
            raise InputError(self.place, found, "a header and rows")
        if len(names) == 1 and "|" in names[0]:
            raise InputError(self.place, f"one column {shown(names[0])}", "columns with , ; or tab between", "not '|'")
        check_different(self.place, names)
        return self

    def read(self, chosen: Sequence[int]) -> tuple[pl.DataFrame, Integers]:
        """Columns by their numbers, in ascending order, and the rows of the file that their rows are."""
        import polars as pl

        if self.text:
            return self._read_csv(chosen)
        frame = self.frame
        if frame is None:
            with _one_line(self.name, "not a Parquet file"):
                frame = pl.read_parquet(BytesIO(self.content), columns=list(chosen))
        else:
            frame = pl.DataFrame([frame[frame.columns[i]] for i in chosen])
        return frame, np.arange(frame.height)

    def _read_csv(self, chosen: Sequence[int]) -> tuple[pl.DataFrame, Integers]:
        import polars as pl

        last = len(self.columns) - 1
        wanted = sorted({*chosen, last})
        start = len(self.text) - len(self.text.removeprefix(b"\xef\xbb\xbf").lstrip(b"\n"))
        try:
            with _one_line(self.name, "not a CSV"):
                frame = pl.read_csv(
                    BytesIO(self.text[start:]), columns=wanted, infer_schema=False, separator=self.separator
                )
        except InputError:
            self._check_lengths()
            raise
        if b'"' in self.text and len(_records(self.text)) != frame.height + 1:
            self._check_lengths()
            raise InputError(self.name, "quotes within cells", "whole cells in quotes, or none")
        rows = np.arange(frame.height)
        frame.columns = [str(i) for i in wanted]
        empty = frame.select(pl.all_horizontal(pl.all().is_null()))[:, 0].to_numpy()
        if empty.any():  # lines that are blank, and rows whose cells of use are empty
            records = _records(self.text)
            separator = self.separator.encode()
            rows = np.array([k for k in rows if not empty[k] or records[k + 1][1].replace(separator, b"").strip()])
            frame = frame[rows]
        if frame[str(last)].is_null().any():  # polars takes a cell that is missing at the end for an empty one
            self._check_lengths()
        return frame.select([str(i) for i in chosen]), rows

    def _check_lengths(self) -> None:
        """Raise for the first row of a CSV that has more or fewer cells than the header."""
        for line, record in _records(self.text):
            _require_closed(f"{self.name}:{line}", record)
            n = re.sub(rb'"[^"]*"?', b"", record).count(self.separator.encode()) + 1
            if record and n != len(self.columns):
                hint = "a quote joins it with lines below: is one missing?" if b"\n" in record else ""
                found = f"{n} cell{'s' * (n != 1)}"
                raise InputError(f"{self.name}:{line}", found, f"{len(self.columns)} as in the header", hint)


def _records(text: bytes, most: int | None = None) -> list[tuple[int, bytes]]:
    """The header and the rows of a CSV, each with the line where it begins; a line break in quotes joins lines.

    Blank lines count from the header on, as in polars.
    """
    records: list[tuple[int, bytes]] = []
    parts: list[bytes] = []
    for line, part in enumerate(text.removesuffix(b"\n").split(b"\n"), start=1):
        if not parts and not part and not records:
            continue
        parts.append(part)
        joined = b"\n".join(parts)
        if joined.count(b'"') % 2 == 0:
            records.append((line - len(parts) + 1, joined))
            parts = []
            if most is not None and len(records) == most:
                return records
    if parts:
        records.append((text.removesuffix(b"\n").count(b"\n") + 2 - len(parts), b"\n".join(parts)))
    return records


def _require_closed(place: str, record: bytes) -> None:
    if record.count(b'"') % 2:
        raise InputError(place, "a quote that is not closed", "whole cells in quotes, or none")


def _rename(source: _Source, columns: Mapping[str, Column], known: set[str]) -> list[str]:
    """The names of a table's columns, those with an own name called as they are known.

    Raises:
        InputError: A known name is not known, or the table has no such column.
    """
    place = f"{source.name}: columns"
    check_names(place, columns, sorted(known), "column")
    names, places = list(source.columns), {}
    for name, column in columns.items():
        check_names(f"{place}: {name}", [column.name.strip()], source.columns, "column")
        places[name] = names.index(column.name.strip())
    check_different(f"{place}: the table's", [column.name.strip() for column in columns.values()])
    found = list(names)
    for name, i in places.items():
        if name in names and names.index(name) not in places.values():
            found[names.index(name)] = f"{name} (the table's)"
        found[i] = name
    return found


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
        elif hint := _similar(name, known, given):
            _log.warning("%s: column %r is not used; %s", table, name, hint)
    return found


def _similar(name: str, known: set[str], given: set[str]) -> str:
    """The known column that a name may mean; else nothing."""
    if name.lower() in known:
        return f"{name.lower()} is"
    if not name.lower().startswith("sigma"):
        return did_you_mean(name, known - given, 0.85)
    sigmas = sorted(column.removeprefix("sigma_") for column in known if column.startswith("sigma_"))
    rest = name.lower().removeprefix("sigma_")  # else every sigma would be much like every other
    like = did_you_mean(rest, [column for column in sigmas if f"sigma_{column}" not in given], 0.85)
    return like.replace("mean ", "mean sigma_") or f"sigmas are {', '.join(f'sigma_{column}' for column in sigmas)}"


def _as_polars(table: Any, name: str) -> pl.DataFrame:
    """A frame of polars from one of polars or pandas, or from a mapping of columns; nan is an empty cell.

    Raises:
        InputError: It is no table.
    """
    import polars as pl

    frame = table if isinstance(table, Mapping) else as_frame(name, table)
    if frame is None or not (isinstance(frame, Mapping | pl.DataFrame) or hasattr(frame, "to_dict")):
        raise InputError(name, f"found a {type(table).__name__}", "a path, or a frame of polars or pandas")
    if not isinstance(frame, pl.DataFrame):
        columns = frame if isinstance(frame, Mapping) else frame.to_dict("list")
        check_different(name, columns)
        frame = pl.DataFrame({str(key): _series(values) for key, values in columns.items()})
    if not frame.columns:
        raise InputError(name, "a frame without columns", "a frame with rows")
    names = frame.columns
    numbered = [frame[column].alias(str(k)) for k, column in enumerate(names)]  # polars takes * for a pattern
    frame = pl.DataFrame([one.fill_nan(None) if one.dtype.is_float() else one for one in numbered])
    frame.columns = names
    return frame


def _series(values: Any) -> Any:
    """A column with None for pandas' missing values; cells of several types become texts, so that none is lost."""
    import polars as pl

    if not isinstance(values, list):
        return values
    missing = ("NAType", "NaTType")
    cells = [
        None if type(value).__name__ in missing or (isinstance(value, float) and value != value) else value  # noqa: PLR0124
        for value in values
    ]
    try:
        return pl.Series(cells)
    except (pl.exceptions.PolarsError, TypeError, OverflowError):
        return pl.Series([None if value is None else str(value) for value in cells], dtype=pl.String)


@contextmanager
def _one_line(name: str, what: str) -> Iterator[None]:
    """Errors of polars, and panics of its Rust, become one line.

    Raises:
        InputError: It makes nothing of a table.
    """
    require_polars(name)
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
    frame = pl.DataFrame(given)
    write_table(path, frame.with_columns(pl.lit(None).alias(n) for n in columns if n not in given).select(*columns))


def write_table(path: Path | str, frame: pl.DataFrame) -> None:
    """Write a frame as Parquet if the file's name ends so, else as CSV; whole or not at all, floats read back exactly.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    require_polars(str(path))
    with replacing(Path(path)) as temporary:
        if temporary.suffix == ".parquet":
            frame.write_parquet(temporary)
        else:
            frame.write_csv(temporary)
