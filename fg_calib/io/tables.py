"""Tables of configurations, of pairs, and of targets: what `columns` lists, read into measurements.

An empty cell means not measured under `distance` and `angle`, no contact point under `group`, the noise's default under
`sigma_*`, and train under `split`; elsewhere it is an error. Columns without a meaning are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.inputs import (
    NORM_TOLERANCE,
    Booleans,
    Floats,
    FrozenArrays,
    InputError,
    Model,
    check_number,
    checked,
    once,
)
from fg_calib.io.columns import KNOWN, OF_CONFIGURATIONS, OF_PAIRS, Column, Table, names_of
from fg_calib.io.yaml import Units
from fg_calib.measurements import (
    GENERIC_COLUMNS,
    INSTRUMENTS,
    Groups,
    Labels,
    Measurements,
    Noise,
    Pairs,
    checked_joint_sigma,
    covariances,
    limit_hint,
    no_pairs,
    outside_limits,
    pairs_from_arrays,
)
from fg_calib.robot import Robot

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_NOT_JOINTS = names_of(
    OF_CONFIGURATIONS[name] for name in ("id", "split", "group", "x", "qx", "roll", "sigma_x", "sigma_rx")
)
"""Names of columns that a joint's readings cannot have, whatever the model."""

_SIGMAS: Mapping[str, tuple[str, tuple[str, ...], int]] = {
    "sigma_position": ("position", ("sigma_position", "sigma_x"), 3),
    "sigma_orientation": ("orientation", ("sigma_orientation", "sigma_rx"), 3),
    "sigma_length": ("distance", ("sigma_distance",), 1),
    "sigma_point": ("point", ("sigma_point",), 1),
    "sigma_pixel": ("pixel", ("sigma_pixel", "sigma_u"), 2),
}
"""By field of `Measurements`: the key of `noise`, columns of which one may hold it, and its axes."""


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

    Raises:
        InputError: A file is missing, is no table, lacks a column or holds a cell that cannot be used; the message
            names its line and column.
    """
    units, noise = units or Units(), noise or Noise()
    _check_noise(noise)
    table = read_table(path, robot, columns or {})
    instruments = tuple(INSTRUMENTS.values()) if model is None else (INSTRUMENTS[model],)
    readings = read_readings(table, find_joint_columns(table, robot), robot, units)
    labels = {
        name: _labels(table, name, optional=any(name in one.optional_labels for one in instruments))
        for name in dict.fromkeys(name for one in instruments for name in one.labels)
        if name in table.columns
    }
    measured = _measured(table, [c.names[0] for i in instruments for c in i.columns], units, noise)
    repeated = bool(set(labels) - {"station"}) or "image" in measured
    ids, test, groups = read_ids(table, repeated=repeated), table.test_rows(), _groups(table)
    names, between, of_groups = ids.to_numpy().astype(np.str_), None, no_pairs(table.name)
    if pairs is not None:
        table.require(ids.is_first_distinct().to_numpy(), "id", "different ids where pairs name them")
        between, of_groups = _read_pairs(pairs, (names, test, groups), units, noise)
    if not groups.names:
        measured["sigma_point"] = None
    return Measurements(
        readings=readings,
        ids=names,
        test=test,
        sigma_joint=checked_joint_sigma(noise.joint, robot.n_joints),
        pairs=between,
        source=table.name,
        groups=Groups(groups.names, groups.index, of_groups) if groups.names else None,
        named="id" in table.columns,
        labels=labels,
        **measured,
    )


def _check_noise(noise: Noise) -> None:
    """Raise for a sigma that is not above 0: nothing is measured exactly but joint readings."""
    for f in fields(noise)[:-1]:
        if f.name != "joint" and (sigma := getattr(noise, f.name)) is not None:
            check_number(f"noise: {f.name}", sigma, above=True)


def read_table(path: Path | str | Any, robot: Robot, columns: Mapping[str, Column] | None = None) -> Table:
    """A table of configurations of a robot; for `columns` see `read_measurements`."""
    joints = {joint.name for joint in robot.joints}
    return Table.read(
        path, "frame", {*KNOWN, *(f"q{i + 1}" for i in range(robot.n_joints))}, joints=joints, columns=columns
    )


def joint_columns(robot: Robot) -> tuple[str, ...]:
    """The columns under which a table is to hold joint readings: the joints' names, or `q1 ... qn`.

    The latter where a name means something else in a table, or would not be read as it is.
    """
    names = tuple(joint.name for joint in robot.joints)
    plain = all(name == name.strip() and re.fullmatch(r"[^\W\d][^,;\t|\"]*", name) for name in names)
    clashing = {*KNOWN, "begin", "seconds", "samples"}.intersection(name.lower() for name in names)
    return names if plain and not clashing else tuple(f"q{i + 1}" for i in range(robot.n_joints))


def find_joint_columns(table: Table, robot: Robot) -> tuple[str, ...]:
    """The columns of joint readings, in chain order: all by the joints' names, or all by their numbers."""
    n = robot.n_joints
    names = tuple(joint.name for joint in robot.joints)
    expected = tuple(f"q{i + 1}" for i in range(n))
    if _NOT_JOINTS.intersection(names):
        names = ()  # a prismatic joint called x, say: its column would be the tool's position
    elif names != expected and table.present(*names) == names:
        return names
    numbered = tuple(name for name in table.columns if re.fullmatch(r"q\d+", name))
    if set(numbered) == set(expected):
        return expected
    found = list(dict.fromkeys([*numbered, *table.present(*names)]))
    raise InputError(
        table.name,
        f"{len(found)} joint columns ({', '.join(found)})" if found else "no joint columns",
        f"{'q1' if n == 1 else f'q1 to q{n}'} for the robot's {n} joints"
        + (f", or their names {', '.join(names)}" if names not in {(), expected} else ""),
        f"the columns are {', '.join(table.columns)}",
    )


def read_readings(table: Table, columns: Sequence[str], robot: Robot, units: Units) -> Floats:
    """Joint readings within the joints' limits, shape (n_rows, n_joints), [rad] or [m]."""
    readings = table.numbers(columns) * [units.factor(joint.unit) for joint in robot.joints]
    outside = outside_limits(readings, robot)  # (n_configurations, n_joints)
    if outside.any():
        row, j = divmod(int(np.argmax(outside)), robot.n_joints)
        unit = robot.joints[j].unit
        reading, low, high = (v / units.factor(unit) for v in (readings[row, j], *robot.limits[j]))
        found = f"{columns[j]} = {reading:.6g} {units.name(unit)} is outside [{low:.6g}, {high:.6g}]"
        hint = limit_hint(readings[:, j], robot, j, units.name(unit))
        raise InputError(table.place(row), found, hint=hint)
    return readings


def read_ids(table: Table, *, repeated: bool) -> pl.Series:
    """The configurations' names, different ones unless `repeated`: their ids, or else their 0-based row numbers."""
    import polars as pl

    if "id" not in table.columns:
        return pl.int_range(table.n_rows, eager=True).cast(pl.String)
    ids = table.names("id", "an id")
    commented = ids.str.starts_with("#").to_numpy()
    table.require(~commented | commented.all(), "id", "ids with # all or none", "# does not comment a row out")
    if not repeated:
        table.require(ids.is_first_distinct().to_numpy(), "id", "different ids")
    return ids


def read_joint_table(
    path: Path | str | Any, robot: Robot, units: Units | None = None
) -> tuple[tuple[str, ...], Floats]:
    """Names of configurations, and their joint values, shape (n, n_joints), [rad] (prismatic: [m]).

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    table = read_table(path, robot)
    readings = read_readings(table, find_joint_columns(table, robot), robot, units or Units())
    return tuple(read_ids(table, repeated=True).to_list()), readings


@dataclass(frozen=True)
class Targets(FrozenArrays):
    """What the tool is to reach.

    Attributes:
        ids: The targets' names: their ids, or 0-based row numbers.
        position: Of the tool point, shape (n, 3), [m]; None where the table holds joint values alone.
        rotation: Of the tool, shape (n, 3, 3); None where the table states none.
        readings: Joint values to stay near, shape (n, n_joints), [rad] (prismatic: [m]); None where there are none.
    """

    ids: tuple[str, ...]
    position: Floats | None
    rotation: Floats | None
    readings: Floats | None


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
        raise InputError(table.name, found, "x y z, or joint values alone", f"it has {', '.join(table.columns)}")
    readings = read_readings(table, find_joint_columns(table, robot), robot, units) if named else None
    return Targets(tuple(read_ids(table, repeated=False).to_list()), position, rotation, readings)


# --- columns of configurations ----------------------------------------------------------------------------------------


def _measured(table: Table, known: Iterable[str], units: Units, noise: Noise) -> dict[str, Any]:
    """What was measured at configurations, by the names of the fields of `Measurements`.

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

    found: dict[str, Any] = dict.fromkeys(("position", "rotation", "sigma_position", "sigma_orientation"))
    if "x" in names:
        found["position"] = values("x")
    if given := _one_of(table, _ROTATIONS, names):
        found |= _rotation(table, given, values(given))
    for name, (kind, columns, n_axes) in _SIGMAS.items():
        if (one := sigma(kind, columns)) is not None:
            found[name] = one[:, 0] if n_axes == 1 else np.broadcast_to(one, (table.n_rows, n_axes)).copy()
    if "distance" in names:
        found["length"] = values("distance", optional=True)[:, 0]
        table.require(~(found["length"] < 0.0) | ("plane" in names), "distance", "a number not below 0")
    if "u" in names or "corner_x" in names:
        table.has(*OF_CONFIGURATIONS["u"].names, *OF_CONFIGURATIONS["corner_x"].names)
        found["image"] = np.hstack([values("u"), values("corner_x")])
    if "cov_11" in names:
        found["covariance"] = _covariances(table, values("cov_11"), units)
    generic = [name for name in GENERIC_COLUMNS if name in known]
    found["columns"] = {name: values(name, optional=True)[:, 0] for name in generic if name in names}
    sigmas = {name: sigma(name, [f"sigma_{name}"]) for name in generic}
    found["sigmas"] = {name: one[:, 0] for name, one in sigmas.items() if one is not None}
    return found


def _one_of(table: Table, columns: Iterable[str], present: Container[str]) -> str | None:
    """The column that is present of several that say the same; None of none."""
    given = [name for name in columns if name in present]
    if len(given) > 1:
        both = [" ".join(OF_CONFIGURATIONS[name].names) for name in given]
        raise InputError(table.name, f"both {both[0]} and {both[1]}", "one of the two")
    return given[0] if given else None


def _rotation(table: Table, first: str, values: Floats) -> dict[str, Floats]:
    """Orientations of the rows, from quaternions, angles or rotation vectors, as the first column says."""
    from scipy.spatial.transform import Rotation

    if first == "roll":  # about fixed axes: Rz(yaw) Ry(pitch) Rx(roll)
        return {"rotation": Rotation.from_euler("xyz", values).as_matrix(), "roll_pitch_yaw": values}
    if first == "rx":
        return {"rotation": Rotation.from_rotvec(values).as_matrix()}
    norm = np.linalg.norm(values, axis=1)
    wrong = np.abs(norm - 1.0) > NORM_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(table.place(row), f"quaternion of norm {norm[row]:.6g}", f"1 within {NORM_TOLERANCE:g}")
    return {"rotation": Rotation.from_quat(values).as_matrix()}


_ROTATIONS = ("qx", "roll", "rx")
"""Columns that say a rotation."""


def _covariances(table: Table, values: Floats, units: Units) -> Floats:
    """Covariances of poses of a board from their upper triangles, shape (n_rows, 6, 6), [rad] and [m]."""
    C, size = np.zeros((table.n_rows, 6, 6)), np.repeat([units.factor("rad"), units.factor("m")], 3)
    i, j = np.triu_indices(6)
    C[:, i, j] = C[:, j, i] = values
    good, C = covariances(C * np.outer(size, size))
    table.require(good, "cov_11", "a covariance: eigenvalues above 0")
    return C


def _labels(table: Table, column: str, *, optional: bool) -> Labels:
    """Names in the order met, and which of them each row has, -1 for none."""
    what = "point" if column == "group" else column
    expected = f"the name of a{'n' * (what[0] in 'aeiou')} {what}"
    cells: list[str | None] = table.names(
        column, expected + ", or an empty cell" * optional, optional=optional
    ).to_list()
    names = tuple(dict.fromkeys(cell for cell in cells if cell is not None))
    place = {name: i for i, name in enumerate(names)}
    return Labels(names, np.array([-1 if cell is None else place[cell] for cell in cells], dtype=np.int64))


def _groups(table: Table) -> Labels:
    """The contact point of each row."""
    if "group" not in table.columns:
        return Labels((), np.full(table.n_rows, -1, dtype=np.int64))
    return _labels(table, "group", optional=True)


# --- pairs ------------------------------------------------------------------------------------------------------------


def _read_pairs(
    path: Path | str | Any, of: tuple[NDArray[np.str_], Booleans, Labels], units: Units, noise: Noise
) -> tuple[Pairs, Pairs]:
    """The pairs of configurations and those of contact points that a table lists.

    Args:
        path: The table.
        of: Names of the configurations, which are test rows, and the contact points.
        units: Of the table.
        noise: Sigmas where the table specifies none.

    Raises:
        InputError: The file is missing, is no table, lacks a column or holds a cell that cannot be used.
    """
    known = names_of(OF_PAIRS.values())
    table = Table.read(path, "frame of pairs", known)
    given: dict[str, Any] = {key: table.names(key, "a configuration").to_list() for key in table.present("a", "b")}
    given["test"] = table.test_rows()
    sigmas = {}
    for key in ("distance", "angle"):
        factor, default = units.factor(OF_PAIRS[key].si), noise.get(key) or np.nan
        if key in table.columns:
            given[key] = table.numbers([key], optional=True)[:, 0] * factor
        sigma = np.full(table.n_rows, default)
        if f"sigma_{key}" in table.columns:
            sigma = table.positive([f"sigma_{key}"], default, factor)[:, 0]
        sigmas[f"sigma_{key}"] = once(sigma)
    try:
        pairs, of_groups = pairs_from_arrays(given, *of)
    except InputError as error:
        if place := re.fullmatch(r"pairs: (\w+): row (\d+)", error.place):
            hint = error.hint or f"angles of the table are in {units.angle}" * ("in rad" in error.expected)
            table.require(np.arange(table.n_rows) != int(place[2]), place[1], error.expected, hint)
        raise InputError(table.name, error.found, error.expected, error.hint) from None
    pairs = replace(pairs, **sigmas, test=once(pairs.test), source=table.name)
    return (pairs, no_pairs(table.name)) if not of_groups.any() else (pairs.select(~of_groups), pairs.select(of_groups))
