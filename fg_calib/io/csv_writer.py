"""Tables as they are written: CSV, and Parquet."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.errors import InputError
from fg_calib.io.atomic import replacing, require_own
from fg_calib.libraries import require_polars

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl


@dataclass(frozen=True)
class Words:
    """A column of a few different words, as codes into them: shape (n,)."""

    words: Sequence[str]
    codes: NDArray[np.integer[Any]]


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


def write_csv(path: Path | str, columns: Mapping[str, ArrayLike | Words | None]) -> None:
    """Write a CSV, whole or not at all; floats read back exactly.

    Args:
        path: The file to write.
        columns: The columns by name, all of one length; None for one that is still to be filled in.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    write_csv_parts(path, [columns])


def write_csv_parts(path: Path | str, parts: Iterable[Mapping[str, ArrayLike | Words | None]]) -> None:
    """`write_csv` of a long table, some rows at a time.

    Args:
        path: The file to write.
        parts: The columns of some rows after the other, at least once.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    require_polars(str(path))
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        for i, frame in enumerate(_frames(parts)):
            frame.write_csv(file, include_header=i == 0)


def write_parquet_parts(path: Path | str, parts: Iterable[Mapping[str, ArrayLike | Words | None]]) -> None:
    """The same as a Parquet file, each part a group of rows.

    Args:
        path: The file to write.
        parts: The columns of some rows after the other, at least once.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    require_polars(str(path))
    import polars as pl
    from polars.io.plugins import register_io_source

    frames = _frames(parts)
    first = next(frames)

    def source(columns: list[str] | None, *_: object) -> Iterator[pl.DataFrame]:
        for frame in chain([first], frames):
            yield frame if columns is None else frame.select(columns)

    with replacing(Path(path)) as temporary:
        rows = max(first.height, 1)
        try:
            register_io_source(source, schema=first.schema).sink_parquet(temporary, row_group_size=rows)
        except pl.exceptions.ComputeError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def _frames(parts: Iterable[Mapping[str, ArrayLike | Words | None]]) -> Iterator[pl.DataFrame]:
    import polars as pl

    for columns in parts:
        frame = pl.DataFrame(
            {
                name: pl.Series(list(values.words), dtype=pl.String).gather(values.codes)
                if isinstance(values, Words)
                else np.asarray(values)
                for name, values in columns.items()
                if values is not None
            }
        )
        yield frame.with_columns(pl.lit(None).alias(n) for n, v in columns.items() if v is None).select(*columns)
