"""Tables of pairs: of configurations, or of groups of touches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.errors import InputError
from fg_calib.io.columns import Header, Table, unit_hint
from fg_calib.io.units import Units
from fg_calib.io.yaml import shown
from fg_calib.measurements.checks import ANGLE_SLACK
from fg_calib.measurements.dataset import Booleans, Floats, Integers, Noise, Pairs, joined

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl


PAIR_COLUMNS = ("a", "b", "distance", "angle", "sigma_distance", "sigma_angle", "split")
"""Columns that mean something."""


@dataclass(frozen=True)
class Configurations:
    """What pairs refer to: the rows of a table of configurations.

    Attributes:
        table: The table.
        ids: Names of the configurations, shape (n_rows,).
        test: Whether each is a test row, shape (n_rows,).
        group_names: Names of the groups of touches.
        group: Each row's group, -1 for none, shape (n_rows,).
    """

    table: Table
    ids: pl.Series
    test: Booleans
    group_names: tuple[str, ...]
    group: Integers


@dataclass(frozen=True)
class _Ends:
    """Rows of configurations, or indices of groups where `of_groups`: shapes (n_pairs,)."""

    a: Integers
    b: Integers
    of_groups: Booleans


def read_pairs(
    path: Path | str | Any,
    configurations: Configurations,
    units: Units,
    noise: Noise,
    rows: tuple[int, int] | None = None,
) -> tuple[Pairs, Pairs]:
    """Read a table of pairs.

    Args:
        path: The table.
        configurations: What it refers to.
        units: Of the table.
        noise: Sigmas where the table states none, [m] and [rad].
        rows: Of a Parquet file, the first row that is read and how many at most; all if None.

    Returns:
        The pairs of configurations and those of groups.

    Raises:
        InputError: The file is missing, is no table, lacks a column or holds a cell that cannot be used; or several
            configurations have one id.
    """
    header = Header.read(path, "frame of pairs", by_rows=rows is not None).understood(PAIR_COLUMNS)
    for column in ("a", "b"):
        if column not in header.columns:
            raise InputError(header.name, f"no column {column}", "a and b, the two configurations of a pair")
    measured = header.present("distance", "angle")
    if not measured:
        raise InputError(header.name, "neither distance nor angle", "at least one of the columns")
    sigmas = header.present("sigma_distance", "sigma_angle")
    _check_different(configurations)
    texts = ("a", "b", *header.present("split"))
    pieces = Table.pieces(header, (*measured, *sigmas), texts, rows)
    found = [_read_piece(piece, configurations, units, noise) for piece in pieces]
    return joined([of_configurations for of_configurations, _ in found]), joined([of_groups for _, of_groups in found])


def _check_different(configurations: Configurations) -> None:
    """Raise for the first configuration that has an id of one before it: no pair could say which is meant."""
    again = (~configurations.ids.is_first_distinct()).arg_true()
    if len(again):
        row = again[0]
        found = f"id = {shown(configurations.ids[row])} of a second row"
        raise InputError(configurations.table.place(row), found, "different ids where pairs name them")


def _read_piece(table: Table, configurations: Configurations, units: Units, noise: Noise) -> tuple[Pairs, Pairs]:
    """The pairs of configurations and those of groups among the rows of a table."""
    ends = _ends(table, configurations)
    length, turn = units.factor("m"), units.factor("rad")
    distance, angle = _measured(table, "distance", length), _measured(table, "angle", turn)
    _check_ranges(table, distance, angle, units)
    if ends.of_groups.any():
        _check_group_pairs(table, ends.of_groups, distance, angle)
    pairs = Pairs(
        a=ends.a,
        b=ends.b,
        distance=distance,
        angle=np.minimum(angle, np.pi),
        sigma_distance=_sigma(table, "sigma_distance", noise.distance, length),
        sigma_angle=_sigma(table, "sigma_angle", noise.angle, turn),
        test=table.test_rows() | _has_test_end(ends, configurations),
        source=table.header.name,
        unused=tuple(name for name in table.header.columns if name not in PAIR_COLUMNS),
    )
    return pairs.select(~ends.of_groups), pairs.select(ends.of_groups)


def _measured(table: Table, column: str, factor: float) -> Floats:
    """Distances or angles, nan where there is none, shape (n_pairs,), [m] or [rad]."""
    if column not in table.header.columns:
        return np.full(table.n_rows, np.nan)
    return table.numbers([column], optional=True)[:, 0] * factor


def _check_ranges(table: Table, distance: Floats, angle: Floats, units: Units) -> None:
    """Raise for the first distance below 0, and the first angle outside 0 to pi."""
    if "distance" in table.header.columns:
        table.require(~(distance < 0.0), "distance", "a number not below 0")
    if "angle" in table.header.columns:
        factor = units.factor("rad")
        good = ~((angle < 0.0) | (angle > np.pi + ANGLE_SLACK))
        hint = unit_hint(angle[np.argmin(good)] / factor, "rad", units, (0.0, np.pi))
        table.require(good, "angle", f"0 to {np.pi / factor:.6g} {units.angle}", hint)


def _sigma(table: Table, column: str, default: float | None, factor: float) -> Floats:
    """Sigma of each pair, shape (n_pairs,); nan where nothing states it."""
    default = np.nan if default is None else default
    if column not in table.header.columns:
        return np.full(table.n_rows, default)
    return table.positive([column], default, factor)[:, 0]


def _has_test_end(ends: _Ends, configurations: Configurations) -> Booleans:
    """Pairs of a test row, or of a group that was touched in test rows only, shape (n_pairs,)."""
    test, group = configurations.test, configurations.group
    touches = [test[group == g] for g in range(len(configurations.group_names))]
    only_test = np.array([len(here) > 0 and here.all() for here in touches], dtype=np.bool_)
    found = np.zeros(len(ends.a), dtype=np.bool_)
    for flags, chosen in ((test, ~ends.of_groups), (only_test, ends.of_groups)):
        found[chosen] = flags[ends.a[chosen]] | flags[ends.b[chosen]]
    return found


def _ends(table: Table, configurations: Configurations) -> _Ends:
    """What `a` and `b` name.

    Raises:
        InputError: Neither a configuration nor a group, both, one of each, or one twice.
    """
    (a, a_is_group), (b, b_is_group) = (_rows_named(table, column, configurations) for column in ("a", "b"))
    mixed = a_is_group != b_is_group
    if mixed.any():
        row = int(np.argmax(mixed))
        which = ("a is a group and b" if a_is_group[row] else "b is a group and a") + " a configuration"
        raise InputError(table.place(row), which, "two configurations or two groups")
    if (a == b).any():
        row = int(np.argmax(a == b))
        what = "groups" if a_is_group[row] else "configurations"
        raise InputError(table.place(row), f"a and b are both {shown(table.frame['a'][row])}", f"two different {what}")
    return _Ends(a, b, a_is_group)


def _rows_named(table: Table, column: str, configurations: Configurations) -> tuple[Integers, Booleans]:
    """Rows of configurations or indices of groups that a column names, and whether groups; shapes (n_pairs,)."""
    import polars as pl

    ids, group_names, place = configurations.ids, configurations.group_names, configurations.table.header
    by_id = "id" in place.columns
    kind = "an id" if by_id else "a row"

    def look_up(known: pl.Series) -> pl.Series:
        return names.cast(pl.Enum(known), strict=False).to_physical()

    names = table.texts(column, "a configuration")
    if not by_id and names.str.contains(".", literal=True).any():
        names = names.str.replace(r"^(\d+)\.0+$", "$1")  # so pandas writes whole numbers that were beside an empty cell
    row_of, group_of = look_up(ids), look_up(pl.Series(group_names, dtype=pl.String))
    both, neither = row_of.is_not_null() & group_of.is_not_null(), row_of.is_null() & group_of.is_null()
    if both.any():
        row = both.arg_true()[0]
        found = f"{column} = {shown(names[row])} is both {kind} and a group of {place.name}"
        raise InputError(table.place(row), found, "different names")
    if neither.any():
        row = neither.arg_true()[0]
        either = f"{kind} or a group" if group_names else kind
        found = f"{column} = {shown(names[row])} is not {either} of {place.name}"
        raise InputError(table.place(row), found, "" if by_id else f"a number from 0 to {len(ids) - 1}")
    is_group = group_of.is_not_null().to_numpy()
    return np.where(is_group, group_of.fill_null(-1).to_numpy(), row_of.fill_null(-1).to_numpy()), is_group


def _check_group_pairs(table: Table, of_groups: Booleans, distance: Floats, angle: Floats) -> None:
    """Raise for the first pair of groups that has an angle, or no distance above 0."""
    if "angle" in table.header.columns:
        table.require(~of_groups | np.isnan(angle), "angle", "an empty cell: two points have a distance, but no angle")
    if "distance" not in table.header.columns:
        row = int(np.argmax(of_groups))
        raise InputError(table.place(row), "two groups without a distance", "a column distance")
    expected = "a number above 0 between two groups; one point is one group"
    table.require(~of_groups | (distance > 0.0), "distance", expected)
