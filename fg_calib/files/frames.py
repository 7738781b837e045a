"""Frames of polars and pandas, and other tables of named columns, as polars'."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fg_calib.errors import InputError

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

    frame = table.collect() if isinstance(table, pl.LazyFrame) else table
    if not isinstance(frame, pl.DataFrame):
        if not isinstance(table, Mapping) and not (hasattr(table, "columns") and hasattr(table, "to_dict")):
            kind = type(table).__name__
            raise InputError(name, f"found a {kind}", "a path, or a frame of polars or pandas")
        columns = table if isinstance(table, Mapping) else table.to_dict("list")
        try:
            frame = pl.DataFrame({str(key): _column(values) for key, values in columns.items()}, strict=False)
        except (pl.exceptions.PolarsError, TypeError, ValueError) as error:
            raise InputError(name, f"no table: {str(error).partition(chr(10))[0]}") from None
    if not frame.columns:
        raise InputError(name, "a frame without columns", "a frame with rows")
    return frame.rename(str.strip).fill_nan(None)


def _column(values: Any) -> Any:
    """A column with None for pandas' nan among texts."""
    return [None if _is_missing(value) else value for value in values] if isinstance(values, list) else values


def _is_missing(value: Any) -> bool:
    return (isinstance(value, float) and math.isnan(value)) or type(value).__name__ in ("NAType", "NaTType")
