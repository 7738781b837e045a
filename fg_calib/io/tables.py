"""Tables: configurations with measured poses, and pairs, as CSV or Parquet.

| table | columns |
|---|---|
| configurations | `q1 ... qn` or joint names; `id`; `x y z`; orientation; `split`; `group`; `sigma_*` |
| pairs | `a`, `b`: ids, 0-based row numbers or groups; `distance` and/or `angle`; their `sigma_*`; `split` |

An orientation is `qx qy qz qw` or `roll pitch yaw`. Sigmas of a row: `sigma_position` or `sigma_x sigma_y sigma_z`;
`sigma_orientation` or `sigma_rx sigma_ry sigma_rz`; `sigma_point`. An empty cell means not measured under `distance`
and `angle`, no touched point under `group`, the noise's default under `sigma_*`, and train under `split`; elsewhere it
is an error. Any other column is ignored. Cells of a CSV have commas, semicolons or tabs between them, and with the
last two numbers may have decimal commas.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.io.columns import Column, Header, Table
from fg_calib.io.instruments import COLUMNS, InstrumentColumns
from fg_calib.io.pairs import Configurations, read_pairs
from fg_calib.io.poses import OF_POSES, PoseColumns
from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Booleans, Floats, Groups, Integers, Measurements, Noise, no_pairs
from fg_calib.measurements.limits import limit_hint, outside_limits
from fg_calib.options import Model, check_number
from fg_calib.robot.model import Robot

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)

_RESERVED = {*OF_POSES, "id", "split", "group"}

_POINT = "the name of a point, or an empty cell"

KNOWN = {*_RESERVED, *COLUMNS, "sigma_position", "sigma_orientation", "sigma_point"}
"""Columns that mean something, beside the joints'."""


@checked
def read_measurements(
    path: Path | str | Any,
    robot: Robot,
    *,
    pairs: Path | str | Any | None = None,
    units: Units | None = None,
    noise: Noise | None = None,
    points: Sequence[str] = (),
    model: Model | None = None,
    columns: Mapping[str, Column] | None = None,
    rows: tuple[int, int] | None = None,
) -> Measurements:
    """Configurations and what was measured at them and, with a table of pairs, between them.

    Args:
        path: Table of configurations: a file, or a frame of polars or pandas with such columns.
        robot: Whose configurations they are: names, number and limits of the joints.
        pairs: Table of pairs, likewise.
        units: Units of both tables; default m and rad.
        noise: Sigmas where the tables state none, [m] and [rad]; also of what was not measured yet.
        points: Names of points that other tables touch: pairs may say how far apart they are.
        model: The model whose columns are read; those of all models if None.
        columns: By name as above, what the table of configurations calls a column.
        rows: Of the pairs, or of the configurations without such, the first row to read and how many: of Parquet alone.

    Raises:
        InputError: A file is missing, is no table, lacks a column or holds a cell that cannot be used; the message
            names its line and column.
    """
    units, noise = units or Units(), noise or Noise()
    _check_given(noise, rows)
    header = header_for(path, robot, columns or {}, by_rows=rows is not None and pairs is None)
    joints, of_poses = find_joint_columns(header, robot), PoseColumns.of(header)
    sigma_point = header.present("sigma_point") if "group" in header.columns else ()
    of_instrument = InstrumentColumns.of(header, model)
    table = Table.read(
        header,
        numbers=(*joints, *of_poses.numbers, *sigma_point, *of_instrument.numbers),
        texts=(*header.present("id", "split", "group"), *of_instrument.labels),
        span=rows if header.by_rows else None,
    )
    ids, test = read_ids(table, repeated=of_instrument.several_rows), table.test_rows()
    (names, group), between, between_groups = _groups(table), None, no_pairs(header.name)
    if pairs is not None:
        every = Configurations(table, ids, test, tuple(dict.fromkeys((*names, *points))), group)
        between, between_groups = read_pairs(pairs, every, units, noise, rows)
        names = every.group_names if between_groups.n_pairs else names
    return Measurements(
        readings=read_readings(table, joints, robot, units),
        ids=ids.to_numpy().astype(np.str_),
        test=test,
        sigma_joint=_joint_sigma(noise.joint, robot.n_joints),
        pairs=between,
        source=header.name,
        groups=Groups(names, group, between_groups) if names else None,
        sigma_point=_sigma_point(table, sigma_point, group >= 0, noise.point, units.factor("m")) if names else None,
        named="id" in header.columns,
        **of_poses.read(table, units, noise),
        **of_instrument.read(table, units, noise),
    )


def header_for(path: Path | str | Any, robot: Robot, columns: Mapping[str, Column], *, by_rows: bool = False) -> Header:
    """The header of a table, its columns called as they are known; for `by_rows` see `Header.read`."""
    meant = {*KNOWN, *(f"q{i + 1}" for i in range(robot.n_joints))}
    called = {joint.name for joint in robot.joints}
    return Header.read(path, "frame", by_rows=by_rows).renamed(columns, meant | called).understood(meant, called)


def _check_given(noise: Noise, rows: tuple[int, int] | None) -> None:
    """Raise for a sigma that is not above 0, as nothing is measured exactly but joint readings; and for no rows."""
    for name, number in zip(("first", "how many"), rows or (), strict=False):
        check_number(f"rows: {name}", number, above=name == "how many", whole=True)
    for f in fields(noise)[:-1]:
        if f.name != "joint" and (figure := getattr(noise, f.name)) is not None:
            check_number(f"noise: {f.name}", figure, above=True)


def joint_columns(robot: Robot) -> tuple[str, ...]:
    """The columns under which a table is to hold joint readings: the joints' names, or `q1 ... qn`.

    The latter where a name means something else in a table, or would not be read as it is.
    """
    names = tuple(joint.name for joint in robot.joints)
    plain = all(name == name.strip() and re.fullmatch(r"[^\W\d][^,;\t|\"]*", name) for name in names)
    clashing = {*KNOWN, "begin", "seconds", "samples"}.intersection(name.lower() for name in names)
    return names if plain and not clashing else tuple(f"q{i + 1}" for i in range(robot.n_joints))


def find_joint_columns(header: Header, robot: Robot) -> tuple[str, ...]:
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


def read_readings(table: Table, columns: Sequence[str], robot: Robot, units: Units) -> Floats:
    """Joint readings within the joints' limits, shape (n_rows, n_joints), [rad] or [m]."""
    readings = table.numbers(columns) * [units.factor(joint.unit) for joint in robot.joints]
    lower, upper = robot.limits.T
    outside = outside_limits(readings, robot)  # (n_configurations, n_joints)
    if outside.any():
        row, j = divmod(int(np.argmax(outside)), robot.n_joints)
        unit = robot.joints[j].unit
        reading, low, high = (v / units.factor(unit) for v in (readings[row, j], lower[j], upper[j]))
        found = f"{columns[j]} = {reading:.6g} {units.name(unit)} is outside [{low:.6g}, {high:.6g}]"
        raise InputError(
            table.place(row), found, hint=limit_hint(readings, robot, j, (columns[j], "the table"), units.name(unit))
        )
    _warn_of_degrees(table, columns, robot, units, readings)
    return readings


def _warn_of_degrees(table: Table, columns: Sequence[str], robot: Robot, units: Units, readings: Floats) -> None:
    """Warn where most readings of a joint without limits look like degrees."""
    turning = np.array([not joint.prismatic for joint in robot.joints]) & np.isinf(robot.limits).all(axis=1)
    suspicious = turning & ((np.abs(readings) > 4 * np.pi).mean(axis=0) > 0.5)
    if suspicious.any() and units.angle == "rad":
        column = columns[int(np.argmax(suspicious))]
        name = table.header.name
        _log.warning("%s: most of %s are more than two turns; is the table in deg?", name, column)


def read_ids(table: Table, *, repeated: bool) -> pl.Series:
    """The configurations' names, different ones unless `repeated`: their ids, or else their 0-based row numbers."""
    import polars as pl

    if "id" not in table.header.columns:
        first = int(table.rows[0]) if table.header.by_rows else 0
        return pl.int_range(first, first + table.n_rows, eager=True).cast(pl.String)
    table.names("id", "an id")
    ids = table.texts("id", "an id")
    commented = ids.str.starts_with("#").to_numpy()
    table.require(~commented | commented.all(), "id", "ids with # all or none", "# does not comment a row out")
    is_first = ids.is_first_distinct().to_numpy()
    if not repeated and not is_first.all():
        first = int(ids.index_of(ids[int(np.argmin(is_first))]) or 0)
        table.require(is_first, "id", "different ids", f"the same as {table.place(first)}")
    return ids


def _groups(table: Table) -> tuple[tuple[str, ...], Integers]:
    """Names of the groups in the order met, and each row's group, -1 for none, shape (n_rows,)."""
    if "group" not in table.header.columns:
        return (), np.full(table.n_rows, -1, dtype=np.int64)
    cells = table.names("group", _POINT).to_list()
    names = list(dict.fromkeys(c for c in cells if c is not None))
    place = {name: i for i, name in enumerate(names)}
    return tuple(names), np.array([-1 if c is None else place[c] for c in cells], dtype=np.int64)


def read_points(path: Path | str, columns: Mapping[str, Column] | None = None) -> tuple[str, ...]:
    """The names of the points that a table of configurations touches; `columns` as in `read_measurements`.

    Raises:
        InputError: The file is missing, or is no table.
    """
    header = Header.read(path, "frame")
    if columns and "group" in columns:
        header = header.renamed({"group": columns["group"]}, {"group"})
    column = next((c for c in header.columns if c.lower() == "group"), None)
    if column is None:
        return ()
    return tuple(Table.read(header, (), (column,)).names(column, _POINT).drop_nulls().unique(maintain_order=True))


def _sigma_point(
    table: Table, column: Sequence[str], touched: Booleans, default: float | None, factor: float
) -> Floats | None:
    """Sigma of each touch, shape (n_rows,), [m], without meaning where nothing is touched; None if not stated."""
    if not column:
        return None if default is None else np.full(table.n_rows, default)
    values = table.numbers(column, optional=True)[:, 0]
    expected = "a number above 0" if default is None else "a number above 0, or an empty cell"
    table.require(~touched | np.where(np.isnan(values), default is not None, values > 0.0), column[0], expected)
    return np.where(np.isnan(values), np.nan if default is None else default, values * factor)


def _joint_sigma(joint: float | tuple[float, ...], n_joints: int) -> Floats:
    """Sigma of the readings, shape (n_joints,), [rad] or [m]."""
    sigma = np.atleast_1d(np.asarray(joint, dtype=np.float64))
    if isinstance(joint, tuple) and len(joint) != n_joints:
        raise InputError("noise: joint", f"{len(joint)} figures", f"one for all or {n_joints}, one a joint")
    return np.broadcast_to(sigma, n_joints).copy()
