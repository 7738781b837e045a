"""Tables: configurations with measured poses, and pairs, as CSV or Parquet.

| table | columns |
|---|---|
| configurations | `q1 ... qn` or joint names; `id`; `x y z`; orientation; `split`; `group`; `sigma_*` |
| pairs | `a`, `b`: ids, 0-based row numbers or groups; `distance` and/or `angle`; their `sigma_*`; `split` |

An orientation is `qx qy qz qw` or `roll pitch yaw`. Sigmas of a row: `sigma_position` or `sigma_x sigma_y sigma_z`;
`sigma_orientation` or `sigma_rx sigma_ry sigma_rz`; `sigma_point`. An empty cell means not measured under `distance`
and `angle`, no touched point under `group`, the noise's default under `sigma_*`, and train under `split`; elsewhere it
is an error. Any other column is ignored.
"""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.errors import InputError
from fg_calib.files.disk import replacing, require_file
from fg_calib.files.units import ANGLES, LENGTHS, Units
from fg_calib.measurements.dataset import Booleans, Floats, Groups, Integers, Measurements, Noise, Pairs, no_pairs
from fg_calib.options import check_number, check_type
from fg_calib.robot.model import Robot

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)

NORM_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1: more is not rounding."""

LIMIT_SLACK = 1e-3
"""How far a reading may be beyond its joint's limits, [rad] or [m]: encoders say so of a joint that stands at one."""

ANGLE_SLACK = 1e-5
"""How far a rotation angle may exceed pi, [rad]: half a turn, rounded to six figures."""

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ROLL_PITCH_YAW = ("roll", "pitch", "yaw")
_SIGMA_POSITION = ("sigma_x", "sigma_y", "sigma_z")
_SIGMA_ORIENTATION = ("sigma_rx", "sigma_ry", "sigma_rz")
_RESERVED = {*_POSITION, *_QUATERNION, *_ROLL_PITCH_YAW, *_SIGMA_POSITION, *_SIGMA_ORIENTATION, "id", "split", "group"}
_ROW, _SHORT = "row of the file", "last cell is empty"  # columns of our own beside those of the file


def read_measurements(
    path: Path | str,
    robot: Robot,
    *,
    pairs: Path | str | None = None,
    units: Units | None = None,
    noise: Noise | None = None,
) -> Measurements:
    """Configurations and what was measured at them and, with a table of pairs, between them.

    Args:
        path: Table of configurations.
        robot: Whose configurations they are: names, number and limits of the joints.
        pairs: Table of pairs.
        units: Units of both tables; default m and rad.
        noise: Sigmas where the tables state none, [m] and [rad]; also of what was not measured yet.

    Raises:
        InputError: A file is missing, is no table, lacks a column or holds a cell that cannot be used; the message
            names its line and column.
    """
    check_type("units", units, Units, "Units(length='mm')")
    check_type("noise", noise, Noise, "Noise(position=1e-3)")
    units, noise = units or Units(), noise or Noise()
    for f in fields(noise):
        if f.name != "joint" and (figure := getattr(noise, f.name)) is not None:
            check_number(f"noise: {f.name}", figure, above=True)  # nothing is measured exactly
    length, angle = units.factor("m"), units.factor("rad")
    header = _Header.read(Path(path))
    joints = _joint_columns(header, robot)
    position = header.group(_POSITION)
    orientation = _orientation_columns(header)
    sigma_position = header.sigmas("sigma_position", _SIGMA_POSITION)
    sigma_orientation = header.sigmas("sigma_orientation", _SIGMA_ORIENTATION)
    sigma_point = header.present("sigma_point") if "group" in header.columns else ()
    table = _Table.read(
        header,
        numbers=(*joints, *position, *orientation, *sigma_position, *sigma_orientation, *sigma_point),
        texts=header.present("id", "split", "group"),
    )
    readings = table.numbers(joints) * [units.factor(joint.unit) for joint in robot.joints]
    _check_limits(readings, robot, joints, table, units)
    ids, test = _ids(table), _test_rows(table)
    names, group = _groups(table)
    between, between_groups = None, no_pairs(header.name)
    if pairs is not None:
        between, between_groups = _read_pairs(Path(pairs), table, ids, test, (names, group), units, noise)
    return Measurements(
        readings=readings,
        ids=ids.to_numpy().astype(np.str_),
        test=test,
        position=table.numbers(position) * length if position else None,
        rotation=_rotation(table, orientation, angle) if orientation else None,
        sigma_position=_sigma(table, sigma_position, noise.position, length),
        sigma_orientation=_sigma(table, sigma_orientation, noise.orientation, angle),
        sigma_joint=_joint_sigma(noise.joint, robot.n_joints),
        pairs=between,
        source=header.name,
        groups=Groups(names, group, between_groups) if names else None,
        sigma_point=_sigma_point(table, sigma_point, group >= 0, noise.point, length) if names else None,
        roll_pitch_yaw=table.numbers(orientation) * angle if orientation == _ROLL_PITCH_YAW else None,
    )


@dataclass(frozen=True)
class Words:
    """A column of a few different words, as codes into them: shape (n,)."""

    words: Sequence[str]
    codes: NDArray[np.integer[Any]]


def write_csv(path: Path | str, columns: Mapping[str, ArrayLike | Words]) -> None:
    """Write a CSV, whole or not at all; floats read back exactly.

    Args:
        path: The file to write.
        columns: The columns by name, all of one length.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    write_csv_parts(path, [columns])


def write_csv_parts(path: Path | str, parts: Iterable[Mapping[str, ArrayLike | Words]]) -> None:
    """`write_csv` of a long table, some rows at a time.

    Args:
        path: The file to write.
        parts: The columns of some rows after the other, at least once.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    import polars as pl

    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        for i, columns in enumerate(parts):
            frame = pl.DataFrame(
                {
                    name: pl.Series(list(values.words), dtype=pl.String).gather(values.codes)
                    if isinstance(values, Words)
                    else np.asarray(values)
                    for name, values in columns.items()
                }
            )
            frame.write_csv(file, include_header=i == 0)


@dataclass(frozen=True)
class _Header:
    """A table's file and the names of its columns."""

    path: Path
    columns: tuple[str, ...]

    @property
    def name(self) -> str:
        """File name, for messages."""
        return self.path.name

    @property
    def is_csv(self) -> bool:
        """Whether it is a CSV, else a Parquet file."""
        return self.path.suffix.lower() == ".csv"

    @classmethod
    def read(cls, path: Path) -> _Header:
        """Read the header."""
        import polars as pl

        require_file(path)
        header = cls(path, ())
        place = header.name
        if header.is_csv:
            line, columns = next(header.csv_rows(), (1, []))
            place = f"{place}:{line}"
        elif path.suffix.lower() in {".parquet", ".pq"}:
            try:
                columns = list(pl.read_parquet_schema(path))
            except (pl.exceptions.PolarsError, OSError) as error:
                raise InputError(place, f"not a Parquet file: {_first_line(error)}") from None
        else:
            raise InputError(place, f"ending {path.suffix!r}", "one of .csv, .parquet, .pq")
        columns = [column.strip() for column in columns]
        if not columns:
            raise InputError(place, "an empty file", "a header and rows")
        for column in columns:
            if columns.count(column) > 1:
                raise InputError(place, f"two columns called {column!r}", "different names")
        return cls(path, tuple(columns))

    def csv_rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and cells of the header and of each row; blank lines count from the header on, as in polars."""
        with self.path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            reader = csv.reader(file)
            started = False
            for cells in reader:
                started = started or bool(cells)
                if started:
                    yield reader.line_num, cells

    def present(self, *columns: str) -> tuple[str, ...]:
        """Those of `columns` that the table has."""
        return tuple(c for c in columns if c in self.columns)

    def group(self, columns: tuple[str, ...]) -> tuple[str, ...]:
        """`columns` if the table has all of them, none if it has none."""
        present = self.present(*columns)
        if present and present != columns:
            missing = next(c for c in columns if c not in present)
            raise InputError(self.name, f"no column {missing}", f"{' '.join(columns)} together")
        return present

    def sigmas(self, single: str, axes: tuple[str, ...]) -> tuple[str, ...]:
        """The columns that state a sigma: one for all axes, or one an axis, or none."""
        if single in self.columns and self.present(*axes):
            raise InputError(self.name, f"both {single} and {self.present(*axes)[0]}", "one of the two")
        return self.present(single) or self.group(axes)


@dataclass(frozen=True)
class _Table:
    """The columns of use: numbers as floats, texts without blanks around them; empty cells are null."""

    header: _Header
    frame: pl.DataFrame

    @classmethod
    def read(cls, header: _Header, numbers: Sequence[str], texts: Sequence[str]) -> _Table:
        """Read the columns of `numbers` and `texts`."""
        frame = (_read_csv if header.is_csv else _read_parquet)(header, numbers, texts)
        if frame.height == 0:
            raise InputError(header.name, "no rows", "at least one")
        return cls(header, frame)

    def numbers(self, columns: Sequence[str], *, optional: bool = False) -> Floats:
        """The columns, shape (n_rows, n_columns); an empty cell is nan if `optional`, else an error."""
        for column in columns:
            good = self.frame[column].is_finite().fill_null(optional)
            self.require(good.to_numpy(), column, "a finite number")
        return self.frame.select(columns).to_numpy(order="c")

    def texts(self, column: str, expected: str) -> pl.Series:
        """The column, without an empty cell."""
        texts = self.frame[column]
        self.require(texts.is_not_null().to_numpy(), column, expected)
        return texts

    def require(self, good: Booleans, column: str, expected: str, hint: str = "") -> None:
        """Raise for the first cell of `column` that is not `good`, shape (n_rows,)."""
        if not good.all():
            place, cell = self._look_up(int(np.argmin(good)), column)
            found = "an empty cell" if cell in {None, ""} else repr(cell)
            raise InputError(f"{place}: {column}", f"found {found}", expected, hint)

    def place(self, row: int) -> str:
        """File and line of a row (the header is line 1); of a Parquet file the 0-based row."""
        return self._look_up(row, self.header.columns[0])[0]

    def _look_up(self, row: int, column: str) -> tuple[str, Any]:
        """Place and original content of a cell. Only errors look, so it may take its time."""
        import polars as pl

        wanted = self.frame[_ROW][row]
        name, columns = self.header.name, self.header.columns
        if self.header.is_csv:
            line, cells = next(found for i, found in enumerate(self.header.csv_rows()) if i == wanted + 1)
            return f"{name}:{line}", cells[columns.index(column)].strip()
        cell = pl.scan_parquet(self.header.path).select(column).slice(wanted, 1).collect().item()
        return f"{name}: row {wanted}", cell


def _read_csv(header: _Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    scan = pl.scan_csv(header.path, infer_schema=False, with_column_names=lambda _: list(header.columns))
    rows = scan.with_row_index(_ROW).filter(~pl.all_horizontal(pl.col(header.columns).is_null()))  # no blank lines
    short = pl.col(header.columns[-1]).is_null().alias(_SHORT)
    try:
        frame = rows.select(_ROW, short, *map(_number, numbers), *map(_text, texts)).collect(engine="streaming")
    except (pl.exceptions.PolarsError, OSError) as error:
        _check_lengths(header)
        raise InputError(header.name, f"not a CSV: {_first_line(error)}") from None
    if frame[_SHORT].any():  # polars takes a cell that is missing at the end for an empty one
        _check_lengths(header)
    return frame


def _read_parquet(header: _Header, numbers: Sequence[str], texts: Sequence[str]) -> pl.DataFrame:
    import polars as pl

    scan = pl.scan_parquet(header.path)
    types = scan.collect_schema()
    for column in numbers:
        if not (types[column].is_numeric() or types[column] in (pl.String, pl.Null)):
            raise InputError(f"{header.name}: {column}", f"type {types[column]}", "numbers")
    read = [_number(c) if types[c] == pl.String else pl.col(c).cast(pl.Float64) for c in numbers]
    try:
        return scan.with_row_index(_ROW).select(_ROW, *read, *map(_text, texts)).collect()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise InputError(header.name, f"not a Parquet file: {_first_line(error)}") from None


def _text(column: str) -> pl.Expr:
    """Text without blanks around it; null if nothing is left."""
    import polars as pl

    text = pl.col(column).cast(pl.String).str.strip_chars()
    return pl.when(text != "").then(text)


def _number(column: str) -> pl.Expr:
    """Text as a number: nan if it is none, null if it is empty."""
    import polars as pl

    text = pl.col(column).str.strip_chars()
    return text.cast(pl.Float64, strict=False).fill_null(pl.when(text != "").then(float("nan")))


def _check_lengths(header: _Header) -> None:
    """Raise for the first row of a CSV that has more or fewer cells than the header."""
    for line, cells in header.csv_rows():
        if cells and len(cells) != len(header.columns):
            expected = f"{len(header.columns)} as in the header"
            raise InputError(f"{header.name}:{line}", f"{len(cells)} cells", expected)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def _joint_columns(header: _Header, robot: Robot) -> tuple[str, ...]:
    """The columns of joint readings, in chain order: all by the joints' names, or all by their numbers."""
    n = robot.n_joints
    names = tuple(joint.name for joint in robot.joints)
    expected = tuple(f"q{i + 1}" for i in range(n))
    if _RESERVED.intersection(names):
        names = ()  # a slide called x, say: its column would be the tool's position
    elif names != expected and header.present(*names) == names:
        return names
    numbered = tuple(c for c in header.columns if re.fullmatch(r"q\d+", c))
    if set(numbered) == set(expected):
        return expected
    found = list(dict.fromkeys([*numbered, *header.present(*names)]))
    raise InputError(
        header.name,
        f"{len(found)} joint columns ({', '.join(found)})" if found else "no joint columns",
        f"{'q1' if n == 1 else f'q1 to q{n}'} for the robot's {n} joints"
        + (f", or their names {', '.join(names)}" if names not in {(), expected} else ""),
        f"the columns are {', '.join(header.columns)}",
    )


def _orientation_columns(header: _Header) -> tuple[str, ...]:
    """The columns of a measured orientation, if there is one."""
    quaternion, roll_pitch_yaw = header.group(_QUATERNION), header.group(_ROLL_PITCH_YAW)
    if quaternion and roll_pitch_yaw:
        raise InputError(header.name, "both qx qy qz qw and roll pitch yaw", "one of the two")
    return quaternion or roll_pitch_yaw


def _check_limits(readings: Floats, robot: Robot, columns: Sequence[str], table: _Table, units: Units) -> None:
    """Raise for a reading outside its joint's limits; warn where most of a joint without limits look like degrees."""
    lower, upper = robot.limits.T
    outside = (readings < lower - LIMIT_SLACK) | (readings > upper + LIMIT_SLACK)  # (n_configurations, n_joints)
    if outside.any():
        row, j = divmod(int(np.argmax(outside)), robot.n_joints)
        unit = robot.joints[j].unit
        reading, low, high = (v / units.factor(unit) for v in (readings[row, j], lower[j], upper[j]))
        found = f"{columns[j]} = {reading:.6g} {units.name(unit)} is outside [{low:.6g}, {high:.6g}]"
        raise InputError(table.place(row), found, hint=_unit_hint(reading, unit, units, (lower[j], upper[j])))
    turning = np.array([not joint.prismatic for joint in robot.joints]) & np.isinf(lower) & np.isinf(upper)
    suspicious = turning & ((np.abs(readings) > 4 * np.pi).mean(axis=0) > 0.5)
    if suspicious.any() and units.angle == "rad":
        column = columns[int(np.argmax(suspicious))]
        name = table.header.name
        _log.warning("%s: most of %s are more than two turns; is the table in deg?", name, column)


def _unit_hint(figure: float, unit: str, units: Units, limits: tuple[float, float]) -> str:
    """A question whether a figure is in the smaller unit, where it would then lie within the limits, [m] or [rad]."""
    smaller, factor = ("mm", LENGTHS["mm"]) if unit == "m" else ("deg", ANGLES["deg"])
    large = units.name(unit) == unit
    return f"is the table in {smaller}?" if large and limits[0] <= figure * factor <= limits[1] else ""


def _ids(table: _Table) -> pl.Series:
    """The configurations' names: their ids, or else their 0-based row numbers."""
    import polars as pl

    if "id" not in table.header.columns:
        return pl.int_range(table.frame.height, eager=True).cast(pl.String)
    ids = table.texts("id", "an id")
    is_first = ids.is_first_distinct().to_numpy()
    if not is_first.all():
        first = int(ids.index_of(ids[int(np.argmin(is_first))]) or 0)
        table.require(is_first, "id", "different ids", f"the same as {table.place(first)}")
    return ids


def _test_rows(table: _Table) -> Booleans:
    """True where `split` says test, shape (n_rows,)."""
    if "split" not in table.header.columns:
        return np.zeros(table.frame.height, dtype=np.bool_)
    split = table.frame["split"].fill_null("train")
    table.require(split.is_in(["train", "test"]).to_numpy(), "split", "train or test")
    return (split == "test").to_numpy()


def _groups(table: _Table) -> tuple[tuple[str, ...], Integers]:
    """Names of the groups in the order met, and each row's group, -1 for none, shape (n_rows,)."""
    if "group" not in table.header.columns:
        return (), np.full(table.frame.height, -1, dtype=np.int64)
    cells = table.frame["group"].to_list()
    names = list(dict.fromkeys(c for c in cells if c is not None))
    place = {name: i for i, name in enumerate(names)}
    return tuple(names), np.array([-1 if c is None else place[c] for c in cells], dtype=np.int64)


def _sigma_point(
    table: _Table, column: Sequence[str], touched: Booleans, default: float | None, factor: float
) -> Floats | None:
    """Sigma of each touch, shape (n_rows,), [m]; any in rows that touch nothing; None if nothing states it."""
    if not column:
        return None if default is None else np.full(table.frame.height, default)
    values = table.numbers(column, optional=True)[:, 0]
    expected = "a number above 0" if default is None else "a number above 0, or an empty cell"
    table.require(~touched | np.where(np.isnan(values), default is not None, values > 0.0), column[0], expected)
    return np.where(np.isnan(values), np.nan if default is None else default, values * factor)


def _rotation(table: _Table, columns: tuple[str, ...], angle: float) -> Floats:
    """Measured orientations as rotation matrices, shape (n_rows, 3, 3)."""
    from scipy.spatial.transform import Rotation

    values = table.numbers(columns)
    if columns == _ROLL_PITCH_YAW:
        return Rotation.from_euler("xyz", values * angle).as_matrix()  # about fixed axes: Rz(yaw) Ry(pitch) Rx(roll)
    norm = np.linalg.norm(values, axis=1)
    good = np.abs(norm - 1.0) <= NORM_TOLERANCE
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(table.place(row), f"quaternion of norm {norm[row]:.6g}", f"1 within {NORM_TOLERANCE:g}")
    return Rotation.from_quat(values).as_matrix()


def _sigma(table: _Table, columns: Sequence[str], default: float | None, factor: float) -> Floats | None:
    """Sigmas along three axes, shape (n_rows, 3); None if nothing states them."""
    if not columns:
        return None if default is None else np.full((table.frame.height, 3), default)
    return np.broadcast_to(_positive(table, columns, default, factor), (table.frame.height, 3)).copy()


def _positive(table: _Table, columns: Sequence[str], default: float | None, factor: float) -> Floats:
    """Columns of positive figures, times `factor`; an empty cell is `default`, an error if that is None."""
    values = table.numbers(columns, optional=default is not None)
    for column, value in zip(columns, values.T, strict=True):
        table.require(~(value <= 0.0), column, "a number above 0")
    return values * factor if default is None else np.where(np.isnan(values), default, values * factor)


def _joint_sigma(joint: float | tuple[float, ...], n_joints: int) -> Floats:
    """Sigma of the readings, shape (n_joints,), [rad] or [m]."""
    sigma = np.atleast_1d(np.asarray(joint, dtype=np.float64))
    if isinstance(joint, tuple) and len(joint) != n_joints:
        raise InputError("noise: joint", f"{len(joint)} figures", f"one for all or {n_joints}, one a joint")
    return np.broadcast_to(sigma, n_joints).copy()


def _read_pairs(
    path: Path,
    configurations: _Table,
    ids: pl.Series,
    test: Booleans,
    groups: tuple[tuple[str, ...], Integers],
    units: Units,
    noise: Noise,
) -> tuple[Pairs, Pairs]:
    """The pairs of a table: those of configurations, by `ids`, shape (n_configurations,), and those of groups."""
    header = _Header.read(path)
    for column in ("a", "b"):
        if column not in header.columns:
            raise InputError(header.name, f"no column {column}", "a and b, the two configurations of a pair")
    measured = header.present("distance", "angle")
    if not measured:
        raise InputError(header.name, "neither distance nor angle", "at least one of the columns")
    sigmas = header.present("sigma_distance", "sigma_angle")
    table = _Table.read(header, (*measured, *sigmas), ("a", "b", *header.present("split")))

    a, b, between_groups = _ends(table, configurations, ids, groups[0])

    def column_of(name: str, default: float, *, positive: bool = False) -> Floats:
        if name not in header.columns:
            return np.full(len(a), default)
        factor = units.factor("m" if name.endswith("distance") else "rad")
        if positive:
            return _positive(table, [name], default, factor)[:, 0]
        return table.numbers([name], optional=True)[:, 0] * factor

    def default_of(figure: float | None) -> float:
        return np.nan if figure is None else figure

    distance, angle = column_of("distance", np.nan), column_of("angle", np.nan)
    if "distance" in measured:
        table.require(~(distance < 0.0), "distance", "a number not below 0")
    if "angle" in measured:
        good = ~((angle < 0.0) | (angle > np.pi + ANGLE_SLACK))
        figure = angle[np.argmin(good)] / units.factor("rad")
        hint = _unit_hint(figure, "rad", units, (0.0, np.pi))
        table.require(good, "angle", f"0 to {np.pi / units.factor('rad'):.6g} {units.angle}", hint)
    if between_groups.any():
        _check_group_pairs(table, between_groups, distance, angle)
    only_test = np.array([bool(test[groups[1] == g].all()) for g in range(len(groups[0]))], dtype=np.bool_)
    of_rows = np.zeros(len(a), dtype=np.bool_)
    for flags, chosen in ((test, ~between_groups), (only_test, between_groups)):
        of_rows[chosen] = flags[a[chosen]] | flags[b[chosen]]
    pairs = Pairs(
        a=a,
        b=b,
        distance=distance,
        angle=np.minimum(angle, np.pi),
        sigma_distance=column_of("sigma_distance", default_of(noise.distance), positive=True),
        sigma_angle=column_of("sigma_angle", default_of(noise.angle), positive=True),
        test=_test_rows(table) | of_rows,
        source=header.name,
    )
    return pairs.select(~between_groups), pairs.select(between_groups)


def _ends(
    table: _Table, configurations: _Table, ids: pl.Series, group_names: tuple[str, ...]
) -> tuple[Integers, Integers, Booleans]:
    """What `a` and `b` name: rows of configurations or indices of groups, and whether groups; shapes (n_pairs,)."""
    import polars as pl

    rows = pl.int_range(len(ids), eager=True)
    group_ids, group_rows = pl.Series(group_names, dtype=pl.String), pl.int_range(len(group_names), eager=True)
    by_id = "id" in configurations.header.columns
    kind = "an id" if by_id else "a row"
    ends, of_groups = [], []
    for column in ("a", "b"):
        names = table.texts(column, "a configuration")
        end = names.replace_strict(ids, rows, default=None, return_dtype=pl.Int64)
        group = names.replace_strict(group_ids, group_rows, default=None, return_dtype=pl.Int64)
        both, none = (end.is_not_null() & group.is_not_null()), (end.is_null() & group.is_null())
        if both.any():
            row = both.arg_true()[0]
            found = f"{column} = {names[row]!r} is both {kind} and a group of {configurations.header.name}"
            raise InputError(table.place(row), found, "different names")
        if none.any():
            row = none.arg_true()[0]
            either = f"{kind} or a group" if len(group_names) else kind
            found = f"{column} = {names[row]!r} is not {either} of {configurations.header.name}"
            raise InputError(table.place(row), found, "" if by_id else f"a number from 0 to {len(ids) - 1}")
        is_group = group.is_not_null().to_numpy()
        of_groups.append(is_group)
        ends.append(np.where(is_group, group.fill_null(-1).to_numpy(), end.fill_null(-1).to_numpy()))
    a, b = ends
    between_groups = of_groups[0]
    mixed = of_groups[0] != of_groups[1]
    if mixed.any():
        row = int(np.argmax(mixed))
        which = ("a is a group and b" if of_groups[0][row] else "b is a group and a") + " a configuration"
        raise InputError(table.place(row), which, "two configurations or two groups")
    if (a == b).any():
        row = int(np.argmax(a == b))
        what = "groups" if between_groups[row] else "configurations"
        raise InputError(table.place(row), f"a and b are both {table.frame['a'][row]!r}", f"two different {what}")
    return a, b, between_groups


def _check_group_pairs(table: _Table, chosen: Booleans, distance: Floats, angle: Floats) -> None:
    """Raise for the first pair of groups that has an angle, or no distance above 0."""
    if "angle" in table.header.columns:
        table.require(~chosen | np.isnan(angle), "angle", "an empty cell: two points have a distance, but no angle")
    if "distance" not in table.header.columns:
        row = int(np.argmax(chosen))
        raise InputError(table.place(row), "two groups without a distance", "a column distance")
    expected = "a number above 0 between two groups; one point is one group"
    table.require(~chosen | (distance > 0.0), "distance", expected)
