"""The tables that `calibrate --out` writes, read back: its configurations and its residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.errors import InputError
from fg_calib.io.atomic import digest_of, exists
from fg_calib.io.columns import Header, Table

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

_RMS = "rms_"


@dataclass(frozen=True)
class SavedConfigurations(FrozenArrays):
    """What `configurations.csv` holds.

    Attributes:
        ids: Name of each configuration.
        test: Which were held out, shape (n,): they have test rows, and no fitted one.
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
        tool: Where the calibrated tool is, from the base, shape (n, 3), [m].
        rms: By kind of residual the RMS at the estimate, shape (n,); nan where there is none.
    """

    ids: tuple[str, ...]
    test: Booleans
    readings: Floats
    tool: Floats
    rms: dict[str, Floats]


@dataclass(frozen=True)
class SavedResiduals(FrozenArrays):
    """What `residuals.csv` or `residuals.parquet` holds of the rows that count.

    Attributes:
        file: Which of the two it is.
        kinds: What rows are of, by code.
        kind: Of each row, in `kinds`, shape (n,).
        row: Row of the file that each is, counted from 0, shape (n,).
        a: Name of the (first) configuration.
        b: Name of the second, empty where there is none.
        of: What a row is of by name, such as a target; empty where nothing says.
        test: Which were predicted only, shape (n,).
        residual: At the estimate, shape (n,), in `unit`.
        studentised: The same in its own sigma, shape (n,); nan where it is not known.
        suspect: Which are larger than noise, shape (n,).
        units: Of each kind.
    """

    file: str
    kinds: tuple[str, ...]
    kind: Integers
    row: Integers
    a: tuple[str, ...]
    b: tuple[str, ...]
    of: tuple[str, ...]
    test: Booleans
    residual: Floats
    studentised: Floats
    suspect: Booleans
    units: tuple[str, ...]

    def place(self, k: int) -> str:
        """Where a row stands: in a CSV its line, the header being line 1; in a Parquet file its row, from 0."""
        return f"{self.file}:{self.row[k] + 2}" if self.file.endswith(".csv") else f"{self.file}: row {self.row[k]}"


def require_unchanged(folder: Path, digests: Mapping[str, str]) -> None:
    """Check that files of a saved result are those that were written with it; what is not there is not missed.

    Args:
        folder: What `calibrate --out` wrote.
        digests: SHA-256 by name, as its `result.json` has them.

    Raises:
        InputError: One is another.
    """
    for name, digest in digests.items():
        if exists(folder / name) and digest_of(folder / name) != digest:
            raise InputError(str(folder / name), "changed, or of another calibration", "the files of one calibration")


def read_configurations(folder: Path, n_joints: int) -> SavedConfigurations | None:
    """The configurations of a saved result; None where there is no such file.

    Args:
        folder: What `calibrate --out` wrote.
        n_joints: Of the result's robot.

    Raises:
        InputError: The file is damaged.
    """
    header = _header(folder / "configurations.csv")
    if header is None:
        return None
    joints, tool = [f"q{i + 1}" for i in range(n_joints)], [f"tool_{axis}" for axis in "xyz"]
    rms = [name for name in header.columns if name.startswith(_RMS)]
    _require(header, ["id", "split", *joints, *tool])
    table = _with_unknown(Table.read(header, [*joints, *tool, *rms], ["id", "split"]), rms)
    figures = table.numbers(rms, optional=True)
    return SavedConfigurations(
        ids=tuple(table.frame["id"].fill_null("").to_list()),
        test=table.test_rows(),
        readings=table.numbers(joints),
        tool=table.numbers(tool),
        rms={name.removeprefix(_RMS): figures[:, i] for i, name in enumerate(rms)},
    )


def read_residuals(folder: Path) -> SavedResiduals | None:
    """The residuals of a saved result that count; None where there is no such file.

    Raises:
        InputError: The file is damaged.
    """
    files = [folder / f"residuals.{ending}" for ending in ("csv", "parquet")]
    header = next(filter(None, map(_header, files)), None)
    if header is None:
        return None
    texts = ["kind", "a", "b", "split", "excluded", "unit", "suspect", *header.present("of")]
    _require(header, [*texts, "residual", "studentised"])
    table = _with_unknown(Table.read(header, ["residual", "studentised"], texts), ["residual", "studentised"])
    counts = table.frame["excluded"].is_null().to_numpy()

    def words(column: str) -> tuple[str, ...]:
        return tuple(table.frame[column].filter(counts).fill_null("").to_list())

    kinds, kind = np.unique(np.array(words("kind") or ("",)), return_inverse=True)
    units = dict(zip(words("kind"), words("unit"), strict=True))
    return SavedResiduals(
        file=header.name,
        kinds=tuple(kinds.tolist()),
        kind=kind[: int(counts.sum())],
        row=table.rows[counts],
        a=words("a"),
        b=words("b"),
        of=words("of") if "of" in texts else ("",) * int(counts.sum()),
        test=table.test_rows()[counts],
        residual=table.numbers(["residual"], optional=True)[counts, 0],
        studentised=table.numbers(["studentised"], optional=True)[counts, 0],
        suspect=np.array(words("suspect")) == "true",
        units=tuple(units.get(str(name), "") for name in kinds),
    )


def _with_unknown(table: Table, columns: Sequence[str]) -> Table:
    """A table of ours, where NaN is what is not known, as an empty cell is."""
    import polars as pl

    return replace(table, frame=table.frame.with_columns(pl.col(name).fill_nan(None) for name in columns))


def _header(file: Path) -> Header | None:
    return Header.read(file, file.name) if exists(file) else None


def _require(header: Header, columns: Sequence[str]) -> None:
    """Check that a file has its columns.

    Raises:
        InputError: It lacks one.
    """
    missing = [name for name in columns if name not in header.columns]
    if missing:
        raise InputError(header.name, f"no column {missing[0]}", "what `fg-calib calibrate --out` wrote")
