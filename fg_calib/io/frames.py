"""Frames of polars and pandas, and other tables of named columns, as polars'."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from fg_calib.arrays import as_frame, check_different
from fg_calib.errors import InputError
from fg_calib.libraries import require_polars

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl


def as_polars(table: Any, name: str) -> pl.DataFrame:
    """A frame of polars from one of polars or pandas (which need not be installed), or from a mapping of columns.

    nan is an empty cell, as pandas has it.

    Args:
        table: The table.
        name: What it is called in messages.

    Raises:
        InputError: It is no table, or its columns are of different lengths.
    """
    import polars as pl

    frame = of_polars(name, lambda: _frame(table, name))
    if not frame.columns:
        raise InputError(name, "a frame without columns", "a frame with rows")
    names = [column.strip() for column in frame.columns]
    columns = {known: cells(frame, column) for known, column in zip(names, frame.columns, strict=True)}
    return pl.DataFrame({known: c.fill_nan(None) if c.dtype.is_float() else c for known, c in columns.items()})


def cells(frame: pl.DataFrame, column: str) -> pl.Series:
    """A column under another name: polars takes some names, such as *, for patterns wherever it meets them."""
    return frame[column].alias("cells")


def select(frame: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    """Columns of a frame by their names, which are no patterns."""
    import polars as pl

    return pl.DataFrame([frame[column] for column in columns])


def _frame(table: Any, name: str) -> pl.DataFrame:
    import polars as pl

    frame = table if isinstance(table, Mapping) else as_frame(name, table)
    if isinstance(frame, pl.DataFrame):
        return frame
    if frame is None or not (isinstance(frame, Mapping) or hasattr(frame, "to_dict")):
        raise InputError(name, f"found a {type(table).__name__}", "a path, or a frame of polars or pandas")
    columns = frame if isinstance(frame, Mapping) else frame.to_dict("list")
    check_different(name, columns)
    return pl.DataFrame({str(key): _column(values) for key, values in columns.items()})


_Found = TypeVar("_Found")


def of_polars(name: str, read: Callable[[], _Found]) -> _Found:
    """What polars makes of a table; its errors, and panics of its Rust, become one line.

    Raises:
        InputError: It makes nothing of it.
    """
    require_polars(name)
    what = "not a CSV" if name.lower().endswith(".csv") else "no table"
    try:
        return read()
    except (InputError, MemoryError):
        raise
    except Exception as error:  # of a frame's objects polars may raise anything
        first = str(error).strip().partition("\n")[0]
        raise InputError(name, f"{what}: {first or type(error).__name__}") from None
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(name, f"{what}: polars cannot read it", hint="write it anew") from None


def _column(values: Any) -> Any:
    """A column with None for pandas' nan among texts; cells of several types as texts, so that none is lost."""
    import polars as pl

    if not isinstance(values, list):
        return values
    known = [None if _is_missing(value) else value for value in values]
    try:
        return pl.Series(known)
    except (pl.exceptions.PolarsError, TypeError, OverflowError):
        return pl.Series([None if value is None else str(value) for value in known], dtype=pl.String)


def _is_missing(value: Any) -> bool:
    return (isinstance(value, float) and math.isnan(value)) or type(value).__name__ in ("NAType", "NaTType")
