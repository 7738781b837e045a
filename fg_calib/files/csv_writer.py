"""CSV files as they are written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.errors import InputError
from fg_calib.files.disk import replacing, require_own
from fg_calib.libraries import require_polars


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
    import polars as pl

    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        for i, columns in enumerate(parts):
            frame = pl.DataFrame(
                {
                    name: pl.Series(list(values.words), dtype=pl.String).gather(values.codes)
                    if isinstance(values, Words)
                    else np.asarray(values)
                    for name, values in columns.items()
                    if values is not None
                }
            )
            frame = frame.with_columns(pl.lit(None).alias(n) for n, v in columns.items() if v is None).select(*columns)
            frame.write_csv(file, include_header=i == 0)
