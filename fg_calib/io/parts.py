"""A job whose table is read some rows at a time, never the file as a whole: what `analysis.parts` adds up."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fg_calib.arguments import checked
from fg_calib.arrays import Brief
from fg_calib.errors import InputError
from fg_calib.io.columns import PIECE, Header, Table
from fg_calib.io.job import read_job_by
from fg_calib.io.tables import header_for, read_ids, read_measurements
from fg_calib.measurements.dataset import Measurements
from fg_calib.options import Options, check_number
from fg_calib.progress import keeping_warnings
from fg_calib.robot.model import Robot


@dataclass(frozen=True)
class Span:
    """Some rows of a table in a file: a function that reads them, wherever it is called, its test rows left out.

    Attributes:
        read: Reads the table, of which it is told the rows.
        rows: The first row, and how many at most.
        files: Size in bytes and time of the last change, in ns, of the files that it reads, as they were first found.
    """

    read: Callable[..., Measurements]
    rows: tuple[int, int]
    files: dict[Path, tuple[int, int]]

    def __call__(self) -> Measurements:
        """The train rows.

        Raises:
            InputError: They cannot be read, or a file was changed.
        """
        for path, before in self.files.items():
            if _stamp(path) != before:
                raise InputError(path.name, "changed while it was read in parts", "one file for all parts")
        with keeping_warnings():  # they were said of the first rows
            m = self.read(rows=self.rows)
        if m.pairs is not None:
            return replace(m, pairs=m.pairs.select(~m.pairs.test)) if m.pairs.test.any() else m
        return m.select(np.flatnonzero(~m.test)) if m.test.any() and m.groups is None else m


@dataclass(frozen=True)
class JobInParts(Brief):
    """A calibration job whose measurements are read where they are reduced.

    Attributes:
        path: The job's file.
        robot: The robot as it is before the calibration.
        parts: Functions that read some train rows of the table each, for `solve_parts`; they can be pickled.
        options: Every choice.
        inputs: SHA-256 of every file read, by its path relative to the job.
        document: The job as its file has it, without its robot.
    """

    path: Path
    robot: Robot
    parts: tuple[Span, ...]
    options: Options
    inputs: dict[str, str] = field(default_factory=dict)
    document: dict[str, Any] = field(default_factory=dict)


_MOST_AT_ONCE = 2**32 - 1
"""Rows of a part at most: polars counts no further."""


@checked
def read_parts(path: Path | str, n_rows: int = PIECE) -> JobInParts:
    """A calibration job in a YAML file, its table cut into spans of rows: those of its pairs, else those of its poses.

    The table must be one Parquet file; of it the rows of a part alone are read at a time.

    Args:
        path: The job; the paths in it are relative to its folder.
        n_rows: Rows of a part, but for the last.

    Raises:
        InputError: The job or a file that it names is missing or cannot be used, or its table cannot be cut.
    """
    path = Path(path).absolute()
    check_number("n_rows", n_rows, above=True, whole=True)
    n_rows = min(int(n_rows), _MOST_AT_ONCE)
    tables: list[_Table] = []

    def first_rows(table: Path, robot: Robot, **how: Any) -> Measurements:
        tables.append(_Table(table, robot, how))
        if len(tables) > 1:
            raise InputError(f"{path.name}: measurements", "several tables", "one, to be read in parts")
        return tables[0].first(n_rows)

    job = read_job_by(path, first_rows)
    if not isinstance(job.measurements, Measurements):
        found = "targets, anchors, a camera or a list of tables"
        raise InputError(f"{path.name}: measurements", found, "one plain table, to be read in parts")
    table = tables[0]
    if table.pairs is not None and not job.options.uses_pairs:
        raise InputError(f"{path.name}: pairs", f"given with model {job.options.model}", "none: it is one of poses")
    with keeping_warnings():  # they were said of the first rows
        n = table.count(repeated=bool(job.measurements.labels))
    spans = [(k, n_rows) for k in range(0, n, n_rows)]
    parts = tuple(Span(table.read, rows, table.files) for rows in spans)
    return JobInParts(path, job.robot, parts, job.options, job.inputs, job.document)


class _Table:
    """A table, and how a job has it read.

    Args:
        path: Of configurations.
        robot: Whose they are.
        how: What else `read_measurements` is told.
    """

    def __init__(self, path: Path, robot: Robot, how: dict[str, Any]) -> None:
        self._path, self._robot, self._how = path, robot, how
        self.pairs: Path | None = how["pairs"]
        self.read = partial(read_measurements, path, robot, **how)
        self.files: dict[Path, tuple[int, int]] = {}

    def first(self, n_rows: int) -> Measurements:
        """Its first rows."""
        there = [self._path] if self.pairs is None else [self._path, self.pairs]
        self.files = {path: _stamp(path) for path in there}
        return self.read(rows=(0, n_rows))

    def count(self, *, repeated: bool) -> int:
        """Number of rows that are cut.

        Args:
            repeated: Whether several rows may have the same id.

        Raises:
            InputError: Several have, and may not.
        """
        header = header_for(self._path, self._robot, self._how["columns"] or {}, by_rows=self.pairs is None)
        if header.present("id"):
            read_ids(Table.read(header, (), ("id",)), repeated=repeated)
        return (header if self.pairs is None else Header.read(self.pairs, "", by_rows=True)).n_rows()


def _stamp(path: Path) -> tuple[int, int]:
    """Size and time of the last change of a file; -1 each of one that is gone."""
    try:
        found = os.stat(path)
    except OSError:
        return -1, -1
    return found.st_size, found.st_mtime_ns
