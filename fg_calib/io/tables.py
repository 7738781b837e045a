"""Tables of configurations, of pairs, and of targets: CSV, Parquet or frames, read into measurements; one writer.

An empty cell means not measured under `distance` and `angle`, no contact point under `group`, the noise's default under
`sigma_*`, and train under `split`; in other columns it is an error. Columns without a meaning are ignored.
"""

import csv
import logging
import os
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fg_calib import inputs, measurements, parallel
from fg_calib.inputs import Booleans, Floats, FrozenArrays, InputError, Integers, Model, Record, checked, expect, pl
from fg_calib.io.atomic import decoded, read_bytes, write_text
from fg_calib.io.yaml import ANGLES, LENGTHS, Number, Schema, Units, number_hint, shown
from fg_calib.measurements import GENERIC_COLUMNS, INSTRUMENTS, Groups, Labels, Measurements, Noise, Pairs
from fg_calib.measurements import Column as ColumnSet
from fg_calib.robot import Context, Robot, outside_joints

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

LABELS = frozenset(label for instrument in INSTRUMENTS.values() for label in instrument.labels)
"""Names of those among them that say what a row is of."""


class Column(Schema):
    """A table's own name of a column, and how its values convert: (value - zero) * scale, as encoder counts do.

    Attributes:
        name: In the table's header.
        scale: One of its units, in the unit of the table.
        zero: The value that means 0.
    """

    name: str
    scale: Number = 1.0
    zero: Number = 0.0


class Table(Record):
    """A table of named columns.

    Attributes:
        name: File name, or what a frame is called, for messages.
        columns: Names of all its columns, as they are known.
        frame: The columns, a frame of polars without blank rows. Those of a CSV are texts.
        separator: The character between the cells of a CSV; empty of others.
        lines: The line of each row of a CSV; empty of others.
        renamed: By column, its conversion, where the table has its own name for it.
    """

    name: str
    columns: tuple[str, ...]
    frame: Any
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
        skip_lines: int = 0,
    ) -> "Table":
        """Read a CSV, a Parquet file or a frame.

        Args:
            table: The file, or a frame of polars or pandas, or a mapping of columns.
            name: Name of a frame in messages.
            known: Names of columns that have a meaning, also if written in another case; None if none has.
            joints: Names that the robot gives to columns.
            columns: By known name, what the table calls a column.
            skip_lines: Lines of a CSV before its header.

        Raises:
            InputError: The table cannot be read, it has no rows, or `columns` does not fit.
        """
        parallel.require_polars(name)
        is_file = isinstance(table, os.PathLike | str)
        name = Path(table).name if is_file else name
        try:
            found = _read_file(Path(table), skip_lines) if is_file else cls(name, (), _as_polars(table, name))
            header = [column.strip() for column in found.columns or found.frame.columns]
            inputs.check_different(name, header, _SKIP * bool(found.separator))
            names = header if known is None else _understood(name, header, set(known), set(joints), columns or {})
            found.frame.columns = names
        except (InputError, MemoryError):
            raise
        except (Exception, pl.exceptions.PanicException) as error:  # of a frame's objects polars may raise anything
            first = str(error).strip().partition("\n")[0]
            raise InputError(name, f"no table: {first or type(error).__name__}") from None
        expect(found.n_rows, name, "no rows", "at least one")
        return replace(found, columns=tuple(names), renamed=dict(columns or {}))

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return int(self.frame.height)

    def present(self, *columns: str) -> tuple[str, ...]:
        """Columns among `columns` that the table has."""
        return tuple(c for c in columns if c in self.columns)

    def has(self, *columns: str) -> bool:
        """Whether the table has columns that belong together.

        Raises:
            InputError: The table has some of the columns only.
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
        values = np.empty((self.n_rows, len(columns)))
        for k, column in enumerate(columns):
            expect(column in self.columns, self.name, f"no column {column}", hint=f"it has {', '.join(self.columns)}")
            cells = self.frame[column]
            if cells.dtype == pl.String:
                texts = self.texts(column)
                if self.separator in (";", "\t"):
                    texts = texts.str.replace(r"^([^.,]*),([^.,]*)$", "$1.$2")
                cells = texts.cast(pl.Float64, strict=False)
                cells = cells.set(cells.is_null() & texts.is_not_null(), np.nan)
            elif not cells.dtype.is_numeric() and cells.dtype != pl.Null:
                raise InputError(f"{self.name}: {column}", f"type {cells.dtype}", "numbers")
            finite = (cells := cells.cast(pl.Float64)).is_finite().fill_null(optional).to_numpy()
            self.require(finite, column, "a finite number", "delete the row if nothing was measured")
            values[:, k] = cells.to_numpy()
            if (own := self.renamed.get(column)) is not None:
                values[:, k] = (values[:, k] - own.zero) * own.scale
            self.require(~(np.abs(values[:, k]) > inputs.MOST_SIZE), column, inputs.ORDINARY)
        return values

    def positive(self, columns: Sequence[str], default: float | None, factor: float) -> Floats:
        """Columns of positive numbers, times `factor`; an empty cell is `default`, an error if that is None."""
        values = self.numbers(columns, optional=default is not None)
        for column, value in zip(columns, values.T, strict=True):
            self.require(~(value <= 0.0), column, "a number above 0")
            self.require(~(value < inputs.LEAST_SIZE), column, inputs.ORDINARY)
        return values * factor if default is None else np.where(np.isnan(values), default, values * factor)

    def texts(self, column: str, expected: str = "") -> "pl.Series":
        """The column without blanks around its cells, null where they are empty: an error if something is expected.

        Whole numbers have no fraction: pandas makes floats of them where cells are empty.
        """
        cells: pl.Series = self.frame[column]
        if cells.dtype.is_nested() or cells.dtype == pl.Object:
            raise InputError(f"{self.name}: {column}", f"type {cells.dtype}", "text")
        if cells.dtype.is_float() and bool(((cells % 1 == 0) & (cells.abs() <= inputs.MOST_SIZE)).all()):
            cells = cells.cast(pl.Int64)
        texts = cells.cast(pl.String).str.strip_chars()
        texts = texts.set(texts == "", None)
        if expected:
            self.require(texts.is_not_null().to_numpy(), column, expected)
        return texts

    def names(self, column: str, expected: str, *, optional: bool = False) -> "pl.Series":
        """The column as texts, without a word such as NA that stands for nothing; null where a cell may be empty."""
        names = self.texts(column, "" if optional else expected)
        self.require(~names.str.to_lowercase().is_in(inputs.NOTHING).fill_null(False).to_numpy(), column, expected)
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
            if not row and str(cell).strip("[]() ").lower() in (*LENGTHS, *ANGLES, "degrees", "°"):
                hint = "is it a row of units? delete it: units are in the job"
            raise InputError(f"{self.place(row)}: {column}", f"found {found}", expected, number_hint(cell) or hint)

    def place(self, row: int) -> str:
        """File and line of a row of a CSV (the header is line 1); of a Parquet file or a frame the 0-based row."""
        return f"{self.name}:{self.lines[row]}" if self.separator else f"{self.name}: row {row}"


def _read_file(path: Path, skip_lines: int) -> Table:
    """The columns of a Parquet file or a CSV.

    Raises:
        InputError: The file is missing, or is no table.
    """
    ending = path.suffix.lower()
    if ending == ".csv":
        return _read_csv(path.name, decoded(read_bytes(path), path.name, "cp1252"), skip_lines)
    hint = "save the sheet as CSV" if ending in (".xlsx", ".xls", ".ods") else ""
    expect(ending in (".parquet", ".pq"), path.name, f"ending {path.suffix!r}", "one of .csv, .parquet, .pq", hint)
    return Table(path.name, (), pl.read_parquet(BytesIO(read_bytes(path))))


_SKIP = "are there lines before the header? skip_lines in the job leaves them out"


def _read_csv(name: str, text: str, skip_lines: int) -> Table:
    """The cells of a CSV as texts, without blank rows and lines before the header, which tells the separator.

    Raises:
        InputError: The file is empty, a quote is not closed on its line, or a row's cells do not match the header.
    """
    expect(text.strip(" \t\r\n,;"), f"{name}:1", "an empty file", "a header and rows")
    read = partial(pl.read_csv, has_header=False, infer_schema=False)
    content = text.replace("\r\n", "\n").replace("\r", "\n").encode()
    every = read(content, separator="\x1f", quote_char=None, new_columns=["line"]).with_row_index("number", 1)
    lines = every.filter((pl.col("line").str.strip_chars(" \t,;") != "") & (pl.col("number") > skip_lines))
    expect(len(lines), f"{name}: skip_lines", f"found {skip_lines}", f"fewer than the {every.height} lines of the file")
    unquoted = lines["line"].str.replace_all('"[^"]*"', "") if '"' in text else lines["line"]
    separator = max(",;\t", key=unquoted[0].count)
    header = next(csv.reader([lines["line"][0].removeprefix("#")], delimiter=separator))  # as numpy writes it
    n_cells = unquoted.str.count_matches(separator, literal=True) + 1
    misfits = unquoted.str.contains('"', literal=True) | (n_cells != len(header))
    if misfits.any():
        row = int(np.argmax(misfits))
        place, n = f"{name}:{lines['number'][row]}", n_cells[row]
        expect('"' not in unquoted[row], place, "a quote that is not closed", "whole cells in quotes, or none")
        found = f"{n} cell{'s' * (n != 1)}"
        raise InputError(place, found, f"{len(header)} as in the header", _SKIP * (row == 1))
    if lines.height < every.height:
        content = lines["line"].str.join("\n").item().encode()
    numbers = lines["number"].to_numpy()[1:]
    del text, every, lines, unquoted, n_cells, misfits  # of a large table each takes as much memory as its file
    return Table(name, tuple(header), read(content, separator=separator).slice(1), separator, numbers)


def _understood(
    table: str, header: Sequence[str], known: set[str], joints: set[str], columns: Mapping[str, Column]
) -> list[str]:
    """Names of columns as they are known: by `columns`, or in another case; warns of names that only look known.

    Raises:
        InputError: A key of `columns` is not known, or the table has no such column.
    """
    place = f"{table}: columns"
    inputs.check_names(place, columns, sorted(known | joints), "column")
    for name, column in columns.items():
        inputs.check_names(f"{place}: {name}", [column.name.strip()], header, "column")
    inputs.check_different(f"{place}: the table's", [column.name.strip() for column in columns.values()])
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
        elif hint := f"{lower} is" if lower in known else inputs.did_you_mean(name, known.difference(names), 0.85):
            _log.warning("%s: column %r is not used; %s", table, name, hint)
    return names


def _as_polars(table: Any, name: str) -> "pl.DataFrame":
    """A frame of polars from one of polars or pandas, or from a mapping of columns; nan is an empty cell.

    Raises:
        InputError: The frame is no table.
    """
    frame = table if isinstance(table, Mapping) else inputs.as_frame(name, table)
    if frame is None or not (isinstance(frame, Mapping | pl.DataFrame) or hasattr(frame, "to_dict")):
        raise InputError(name, f"found a {type(table).__name__}", "a path, or a frame of polars or pandas")
    if not isinstance(frame, pl.DataFrame):
        named = getattr(getattr(frame, "index", None), "name", None) is not None
        columns = frame if isinstance(frame, Mapping) else (frame.reset_index() if named else frame).to_dict("list")
        inputs.check_different(name, columns)
        frame = pl.DataFrame({str(key): _series(values) for key, values in columns.items()})
    expect(frame.columns, name, "a frame without columns", "a frame with rows")
    return frame.with_columns(pl.selectors.float().fill_nan(None))


def _series(values: Any) -> Any:
    """A column with None for what pandas has for a missing value; cells of several types become texts."""
    if not isinstance(values, list):
        return values
    missing = [v is None or type(v).__name__ == "NAType" or v != v for v in values]  # noqa: PLR0124
    found = pl.Series([None if none else value for none, value in zip(missing, values, strict=True)], strict=False)
    if found.null_count() > sum(missing):
        raise ValueError("cells of types that do not go together")
    return found


def write_csv(path: Path | str, columns: Mapping[str, ArrayLike | None]) -> None:
    """Write a CSV, whole or not at all; floats read back exactly.

    Args:
        path: The file to write.
        columns: The columns by name, all of one length; None for one that is still to be filled in.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    given = {name: np.asarray(values) for name, values in columns.items() if values is not None}
    frame = pl.DataFrame(given).with_columns(pl.lit(None).alias(name) for name in columns if name not in given)
    write_text(Path(path), frame.select(*columns).write_csv())


_NOT_JOINTS = names_of(OF_CONFIGURATIONS[k] for k in ("id", "split", "group", "x", "qx", "roll", "sigma_x", "sigma_rx"))
"""Names of columns that a joint's readings cannot have, whatever the model."""

_BY_AXIS = {"position": "sigma_x", "orientation": "sigma_rx", "pixel": "sigma_u"}
"""First of the columns that may hold sigma on each axis, by kind of noise."""

HEAVY = 0.5
"""Mass that no finger of a gripper has, [kg]."""

ROUNDED = 1e-9
"""Share of a covariance that may be rounding."""


@checked
def read_measurements(
    path: Path | str | Any,
    robot: Robot,
    *,
    pairs: Path | str | Any | None = None,
    units: Units | None = None,
    noise: Noise | None = None,
    model: Model | None = None,
    columns: Mapping[str, Column] | None = None,
    skip_lines: int = 0,
) -> Measurements:
    """Configurations and what was measured at them and, with a table of pairs, between them.

    Args:
        path: Table of configurations: a file, or a frame of polars or pandas with such columns.
        robot: Whose configurations they are: names, number and limits of the joints.
        pairs: Table of pairs, likewise.
        units: Units of both tables; default m and rad.
        noise: Sigmas where the tables specify none, [m] and [rad]; also of what was not measured yet.
        model: The model whose columns are read; those of all models if None.
        columns: By known name, what the table of configurations calls a column.
        skip_lines: Lines before its header.

    Raises:
        InputError: A file is missing, is no table, lacks a column or holds a cell that cannot be used; the message
            names its line and column.
    """
    units, noise = units or Units(), noise or Noise()
    for kind, sigma in vars(noise).items():
        if kind not in ("joint", "more") and sigma is not None:  # nothing but joint readings is measured exactly
            inputs.check_number(f"noise: {kind}", sigma, above=True)
    table = read_table(path, robot, columns or {}, skip_lines)
    _check_use(table, model)
    readings = read_readings(table, find_joint_columns(table, robot), robot, units)
    between = None if pairs is None else Table.read(pairs, "frame of pairs", names_of(OF_PAIRS.values()))
    found = measurements_of(table, readings, between, units, noise, model)
    with inputs.within(table.name):
        return replace(found, context=_read_context(table, robot, readings, units, needed=True))


def _check_use(table: Table, model: Model | None) -> None:
    """Warn of known columns that are of no use to a model, and of values that it needs and rows lack.

    Raises:
        InputError: A column of names has a scale, or a zero.
    """
    for name, column in table.renamed.items():
        if name in {"id", "split", "group", *LABELS} and (column.scale, column.zero) != (1.0, 0.0):
            raise InputError(f"{table.name}: columns: {name}", "scale or zero of a column of names", "name alone")
    if model is not None:
        one = INSTRUMENTS[model]
        used = {"id", "split", "group", *names_of(one.columns)} - LABELS.difference(one.labels)
        if unused := [name for name in table.columns if name in KNOWN - used]:
            _log.warning("%s: of no use to model %s: column %s", table.name, model, ", ".join(unused))
        for name in table.present(*one.generic_columns):
            if n := table.texts(name).null_count():
                _log.warning("%s: %d of %d rows have no %s and take no part", table.name, n, table.n_rows, name)


def measurements_of(
    table: Table, readings: Floats, pairs: Table | None, units: Units, noise: Noise, model: Model | None = None
) -> Measurements:
    """Measurements of the columns of a table.

    Args:
        table: The table.
        readings: Joint readings of its rows, shape (n_rows, n_joints), [rad] (prismatic: [m]).
        pairs: Table of pairs; None if none were measured directly.
        units: Of both tables.
        noise: Sigmas where they specify none.
        model: The model whose columns are read; those of all models if None.

    Raises:
        InputError: A column is missing, or a cell cannot be used.
    """
    instruments = tuple(INSTRUMENTS.values()) if model is None else (INSTRUMENTS[model],)
    optional = {name for one in instruments for name in one.optional_labels}
    columns = dict.fromkeys(name for one in instruments for name in one.labels if name in table.columns)
    labels = {name: _labels(table, name, optional=name in optional) for name in columns}
    measured = _measured(table, [c.names[0] for i in instruments for c in i.columns], units, noise)
    repeated = bool(set(labels) - {"station"}) or "image" in measured
    ids, test, between = read_ids(table, repeated=repeated and pairs is None), table.test_rows(), None
    groups, of_groups = Labels((), np.full(table.n_rows, -1)), measurements.no_pairs(table.name)
    if "group" in table.columns:
        groups = _labels(table, "group", optional=True)
    if pairs is not None:
        between, of_groups = _read_pairs(pairs, (ids, test, groups), units, noise)
    if not groups.names:
        measured["sigmas"].pop("point", None)
    sigma_joint = noise.of_joints(readings.shape[1])
    touched = Groups(groups.names, groups.index, of_groups) if groups.names else None
    more: dict[str, Any] = {"pairs": between, "source": table.name, "groups": touched, "named": "id" in table.columns}
    return Measurements(readings, ids, test, sigma_joint=sigma_joint, labels=labels, **more, **measured)


def read_table(
    path: Path | str | Any, robot: Robot, columns: Mapping[str, Column] | None = None, skip_lines: int = 0
) -> Table:
    """A table of configurations of a robot; for `columns` and `skip_lines` see `read_measurements`."""
    joints, others = {joint.name for joint in robot.joints}, {*KNOWN, *(f"q{i + 1}" for i in range(robot.n_joints))}
    known, hint = set(others), "rename the effect's column, or the joint outside the chain"

    def note(names: Sequence[str]) -> Floats:
        taken = sorted((others | joints).intersection(names))
        expect(not taken, robot.name, f"effects by {', '.join(taken)}", "columns of nothing else", hint)
        known.update(names)
        return np.full((1, len(names)), np.nan)

    for effect in robot.effects:
        effect.context(robot, np.zeros((1, robot.n_joints)), note)
    return Table.read(path, "frame", known, joints=joints, columns=columns, skip_lines=skip_lines)


def joint_columns(robot: Robot) -> tuple[str, ...]:
    """The columns under which a table is to hold joint readings: the joints' names, or `q1 ... qn`.

    The latter where a name means something else in a table, or would not be read as it is.
    """
    names = tuple(joint.name for joint in robot.joints)
    plain = all(name == name.strip() and re.fullmatch(r"[^\W\d][^,;\t|\"]*", name) for name in names)
    clashing = {*KNOWN, "begin", "seconds", "samples"}.intersection(name.lower() for name in names)
    return names if plain and not clashing else tuple(f"q{i + 1}" for i in range(robot.n_joints))


def pose_columns(
    robot: Robot, readings: Floats, position: Floats, rotation: Floats | None, units: Units
) -> dict[str, Floats]:
    """Columns to be written: joint readings, positions and, if there are any, orientations.

    Args:
        robot: Whose joints they are of.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        position: Shape (n, 3), [m].
        rotation: Shape (n, 3, 3); None where there are none.
        units: Of the table.
    """
    q = readings / [units.factor(joint.unit) for joint in robot.joints]
    columns = dict(zip((*joint_columns(robot), *"xyz"), (*q.T, *position.T / units.factor("m")), strict=True))
    if rotation is not None:
        quaternions = Rotation.from_matrix(rotation.copy()).as_quat(canonical=True)
        columns |= dict(zip(OF_CONFIGURATIONS["qx"].names, quaternions.T, strict=True))
    return columns


def find_joint_columns(table: Table, robot: Robot) -> tuple[str, ...]:
    """The columns of joint readings, in chain order: all by the joints' names, or all by their numbers."""
    names = () if _NOT_JOINTS & {joint.name for joint in robot.joints} else tuple(joint.name for joint in robot.joints)
    numbered = tuple(f"q{i + 1}" for i in range(robot.n_joints))
    found = [name for name in table.columns if name in names or re.fullmatch(r"q\d+", name)]
    if names and names != numbered and set(names) <= set(found):
        return names
    if {name for name in found if re.fullmatch(r"q\d+", name)} == set(numbered):
        return numbered
    expected = "q1" if len(numbered) == 1 else f"q1 to {numbered[-1]}"
    what = f"{len(found)} joint columns ({', '.join(found)})" if found else "no joint columns"
    by_name = f", or their names {', '.join(names)}" if names not in {(), numbered} else ""
    wanted = f"{expected} for the robot's {robot.n_joints} joints{by_name}"
    raise InputError(table.name, what, wanted, f"the columns are {', '.join(table.columns)}")


def read_readings(table: Table, columns: Sequence[str], robot: Robot, units: Units) -> Floats:
    """Joint readings within the joints' limits, shape (n_rows, n_joints), [rad] or [m]."""
    readings = table.numbers(columns) * [units.factor(joint.unit) for joint in robot.joints]
    shown_in = {unit: (units.name(unit), units.factor(unit)) for unit in ("rad", "m")}
    measurements.check_limits(readings, robot, columns, table.place, shown_in)
    return readings


def read_ids(table: Table, *, repeated: bool) -> NDArray[np.str_]:
    """The configurations' names, different ones unless `repeated`: their ids, or else their 0-based row numbers."""
    if "id" not in table.columns:
        return np.arange(table.n_rows).astype(np.str_)
    names = table.names("id", "an id")
    commented = names.str.starts_with("#").to_numpy()
    table.require(~commented | commented.all(), "id", "ids with # all or none", "# does not comment a row out")
    if not repeated:
        table.require(names.is_first_distinct().to_numpy(), "id", "different ids")
    return np.array(names.to_list(), dtype=np.str_)


def read_joint_table(
    path: Path | str | Any, robot: Robot, units: Units | None = None
) -> tuple[tuple[str, ...], Floats, Context]:
    """Names of configurations, their joint values, and what effects depend on besides where the table has it.

    Joint values have the shape (n, n_joints), [rad] (prismatic: [m]).

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    table, units = read_table(path, robot), units or Units()
    readings = read_readings(table, find_joint_columns(table, robot), robot, units)
    return tuple(read_ids(table, repeated=True).tolist()), readings, _read_context(table, robot, readings, units)


def _read_context(
    table: Table, robot: Robot, readings: Floats | None, units: Units, *, needed: bool = False
) -> Context:
    """What effects depend on besides readings, as far as a table has it.

    If it is needed, as for measurements, columns must be there, but for joints outside the chain, which are at 0 then.
    """
    outside = outside_joints(robot)

    def read(columns: Sequence[str]) -> Floats:
        joint = outside.get(columns[0])
        if not set(columns) <= set(table.frame.columns) and (joint or not needed):
            return np.full((table.n_rows, len(columns)), 0.0 if needed else np.nan)
        values = table.numbers(columns) * units.factor("" if joint is None else joint.unit)
        if joint is not None:
            good = np.clip(values[:, 0], joint.lower, joint.upper) == values[:, 0]
            table.require(good, columns[0], f"{joint.lower:g} to {joint.upper:g} {joint.unit}, its limits")
        return values

    if needed and (missing := outside_joints(robot, HEAVY).keys() - set(table.frame.columns)):
        _log.warning("%s: no column %s: joints outside the chain are at 0", table.name, ", ".join(sorted(missing)))
    context = [effect.context(robot, readings, read) for effect in robot.effects]
    return {name: values for one in context for name, values in one.items() if not np.isnan(values).all()}


class Targets(FrozenArrays):
    """Targets of the tool.

    Attributes:
        ids: The targets' names: their ids, or 0-based row numbers.
        position: Of the tool point, shape (n, 3), [m]; None where the table holds joint values alone.
        rotation: Of the tool, shape (n, 3, 3); None where the table states none.
        readings: Joint values to stay near, shape (n, n_joints), [rad] (prismatic: [m]); None where there are none.
        context: What effects depend on besides, such as temperatures, where the table has it.
    """

    ids: tuple[str, ...]
    position: Floats | None
    rotation: Floats | None
    readings: Floats | None
    context: Context


@checked
def read_targets(path: Path | str | Any, robot: Robot, units: Units | None = None) -> Targets:
    """Read a table of targets: positions, perhaps orientations, perhaps joint values to stay near.

    Joint values alone are a program whose poses, by the nominal arm, are the targets.

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    units = units or Units()
    table = read_table(path, robot)
    poses = _measured(table, ["x", *_ROTATIONS], units, Noise())
    position, rotation = poses["position"], poses["rotation"]
    named = table.present(*(f"q{i + 1}" for i in range(robot.n_joints)), *(joint.name for joint in robot.joints))
    if position is None and (rotation is not None or not named):
        found = "neither x y z nor joint columns" if rotation is None else "orientations without x y z"
        raise InputError(table.name, found, "x y z, or q1 ... qn alone", f"it has {', '.join(table.columns)}")
    readings = read_readings(table, find_joint_columns(table, robot), robot, units) if named else None
    ids = tuple(read_ids(table, repeated=False).tolist())
    return Targets(ids, position, rotation, readings, _read_context(table, robot, readings, units))


# --- columns of configurations ----------------------------------------------------------------------------------------


def _measured(table: Table, known: Iterable[str], units: Units, noise: Noise) -> dict[str, Any]:
    """Measurements at configurations, by the names of the fields of `Measurements`.

    Args:
        table: The table.
        known: Columns that are read, those that belong together by the first.
        units: Of the table.
        noise: Sigmas where the table specifies none.
    """
    sets = [OF_CONFIGURATIONS[first] for first in dict.fromkeys(known)]
    names = {one.names[0]: one.names for one in sets if table.has(*one.names)}
    factors = {first: units.factor(OF_CONFIGURATIONS[first].si) for first in names}

    def values(first: str, *, optional: bool = False) -> Floats:
        return table.numbers(names[first], optional=optional) * factors[first]

    def sigma(kind: str, columns: Sequence[str]) -> Floats | None:
        default = noise.get(kind)
        if given := _one_of(table, columns, names):
            default = np.nan if default is None and kind == "point" else default  # some rows touch none
            return table.positive(names[given], default, factors[given])
        return None if default is None else np.full((table.n_rows, 1), default)

    found: dict[str, Any] = dict.fromkeys(("position", "rotation"))
    if "x" in names:
        found["position"] = values("x")
    if given := _one_of(table, _ROTATIONS, names):
        found |= _rotation(table, given, values(given))
    if "u" in names or "corner_x" in names:
        table.has(*OF_CONFIGURATIONS["u"].names, *OF_CONFIGURATIONS["corner_x"].names)
        found["image"] = np.hstack([values("u"), values("corner_x")])
    if "cov_11" in names:
        found["covariance"] = _covariances(table, values("cov_11"), units)
    found["columns"] = {name: values(name, optional=True)[:, 0] for name in GENERIC_COLUMNS if name in names}
    if "distance" in names:
        table.require(~(found["columns"]["distance"] < 0.0) | ("plane" in names), "distance", "a number not below 0")
    sigmas: dict[str, Floats | None] = dict.fromkeys(("position", "orientation"))
    for kind in (*_BY_AXIS, "point", *(name for name in GENERIC_COLUMNS if name in known)):
        each = _BY_AXIS.get(kind, "")
        if (one := sigma(kind, (f"sigma_{kind}", each))) is not None:
            shape = table.n_rows, len(OF_CONFIGURATIONS[each].names) if each else 1
            sigmas[kind] = np.broadcast_to(one, shape).copy() if each else one[:, 0]
    found |= {f"sigma_{kind}": sigmas.pop(kind) for kind in ("position", "orientation")}
    return found | {"sigmas": sigmas}


def _one_of(table: Table, columns: Iterable[str], present: Container[str]) -> str | None:
    """The column that is present of several that say the same; None of none."""
    given = [name for name in columns if name in present]
    both = " and ".join(" ".join(OF_CONFIGURATIONS[name].names) for name in given[:2])
    expect(len(given) < 2, table.name, f"both {both}", "one of the two")
    return given[0] if given else None


def _rotation(table: Table, first: str, values: Floats) -> dict[str, Floats]:
    """Orientations of the rows, from quaternions, angles or rotation vectors, as the first column says."""
    if first == "roll":  # about fixed axes: Rz(yaw) Ry(pitch) Rx(roll)
        return {"rotation": Rotation.from_euler("xyz", values).as_matrix(), "roll_pitch_yaw": values}
    if first == "rx":
        return {"rotation": Rotation.from_rotvec(values).as_matrix()}
    norm = np.linalg.norm(values, axis=1)
    wrong = np.abs(norm - 1.0) > inputs.NORM_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(table.place(row), f"quaternion of norm {norm[row]:.6g}", f"1 within {inputs.NORM_TOLERANCE:g}")
    return {"rotation": Rotation.from_quat(values).as_matrix()}


_ROTATIONS = ("qx", "roll", "rx")
"""Columns that say a rotation."""


def _covariances(table: Table, values: Floats, units: Units) -> Floats:
    """Covariances of poses of a board from their upper triangles, shape (n_rows, 6, 6), [rad] and [m]."""
    C, size = np.zeros((table.n_rows, 6, 6)), np.repeat([units.factor("rad"), units.factor("m")], 3)
    i, j = np.triu_indices(6)
    C[:, i, j] = C[:, j, i] = values
    C *= np.outer(size, size)
    size = np.sqrt(np.maximum(np.einsum("nii->ni", C), inputs.LEAST_SIZE**2))
    scaled = C / (size[:, :, None] * size[:, None, :])
    table.require(np.linalg.eigvalsh(scaled)[:, 0] > ROUNDED, "cov_11", "a covariance: eigenvalues above 0")
    return C


def _labels(table: Table, column: str, *, optional: bool) -> Labels:
    """Names in the order met, and which of them each row has, -1 for none."""
    what = "point" if column == "group" else column
    expected = f"the name of a{'n' * (what[0] in 'aeiou')} {what}"
    cells = table.names(column, expected + ", or an empty cell" * optional, optional=optional)
    names = tuple(cells.drop_nulls().unique(maintain_order=True))
    return Labels(names, _places(cells, {name: i for i, name in enumerate(names)}))


def _places(names: "pl.Series", place: dict[str, int]) -> Integers:
    """The place of each name, -1 for others and for none."""
    return np.asarray(names.replace_strict(place, default=-1, return_dtype=pl.Int64).to_numpy(), dtype=np.int64)


# --- pairs ------------------------------------------------------------------------------------------------------------


def _read_pairs(
    table: Table, of: tuple[NDArray[np.str_], Booleans, Labels], units: Units, noise: Noise
) -> tuple[Pairs, Pairs]:
    """The pairs of configurations and those of contact points that a table lists.

    Those of a test row, or of a contact point of test rows alone, are test pairs.

    Args:
        table: The table of pairs.
        of: Names of the configurations, which are test rows, and the contact points.
        units: Of the table.
        noise: Sigmas where the table specifies none.

    Raises:
        InputError: The table lacks a column or holds a cell that cannot be used.
    """
    lacking = [key for key in ("a", "b") if key not in table.columns]
    if lacking or not table.present("distance", "angle"):
        found = f"no {lacking[0]}" if lacking else "neither distance nor angle"
        raise InputError(table.name, found, "a and b, the two configurations of a pair, and distance or angle")
    (ids, rows, groups), fields = of, dict[str, Any]()
    a, b, of_groups = _ends(table, ids, groups.names)
    in_rad = f"0 to pi, in rad; angles of the table are in {units.angle}"
    for key, most, expected in (("distance", np.inf, "a number not below 0"), ("angle", np.pi, in_rad)):
        factor, default = units.factor(OF_PAIRS[key].si), noise.get(key) or np.nan
        values, sigma = np.full((2, table.n_rows), [[np.nan], [default]])
        if key in table.columns:
            values = table.numbers([key], optional=True)[:, 0] * factor
        if f"sigma_{key}" in table.columns:
            sigma = table.positive([f"sigma_{key}"], default, factor)[:, 0]
        table.require(~((values < 0.0) | (values > most + measurements.ANGLE_SLACK)), key, expected)
        fields |= {key: np.minimum(values, most), f"sigma_{key}": inputs.once(sigma)}
    table.require(~of_groups | np.isnan(fields["angle"]), "angle", "none: two points have a distance, but no angle")
    table.require(~of_groups | (fields["distance"] > 0.0), "distance", "a number above 0 between two groups")
    test = table.test_rows()
    for flags, chosen in ((rows, ~of_groups), (groups.only_of(rows), of_groups)):
        test[chosen] |= flags[a[chosen]] | flags[b[chosen]]
    pairs = Pairs(a, b, test=inputs.once(test), source=table.name, **fields)
    if not of_groups.any():
        return pairs, measurements.no_pairs(table.name)
    return pairs.select(~of_groups), pairs.select(of_groups)


def _ends(table: Table, ids: NDArray[np.str_], groups: Sequence[str]) -> tuple[Integers, Integers, Booleans]:
    """Rows of configurations or indices of groups that `a` and `b` name, and whether they are groups.

    Whole numbers in arrays are row numbers where no id and no group is a number.
    """
    n, names = len(ids), ids.tolist()
    by_row = bool(np.array_equal(ids, np.arange(n).astype(np.str_)))  # no ids were given
    place = {name: i for i, name in enumerate([*names, *groups])}
    both = set(groups).intersection(names)
    place |= dict.fromkeys(both, -1)
    expected = "an id or a group" if groups else "an id (the row number where no ids were given)"
    numbers = not any(word.isdigit() for word in (groups if by_row else place))
    found = []
    for key in ("a", "b"):
        if numbers and table.frame[key].dtype.is_integer():
            end = table.frame[key].to_numpy()
            end = np.where(end < n, end, -1).astype(np.int64)
        else:
            end = _places(table.names(key, "a configuration"), place)
        table.require(end >= 0, key, expected, "names of both stand for neither" * bool(both))
        found.append(end)
    a, b = found
    table.require((a < n) == (b < n), "b", "two configurations or two groups")
    table.require(a != b, "b", "another than a")
    return np.where(a < n, a, a - n), np.where(b < n, b, b - n), a >= n
