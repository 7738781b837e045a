"""Tables of configurations, of pairs, and of targets: what `columns` lists, read into measurements.

An empty cell means not measured under `distance` and `angle`, no contact point under `group`, the noise's default under
`sigma_*`, and train under `split`; elsewhere it is an error. Columns without a meaning are ignored.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fg_calib.inputs import (
    NORM_TOLERANCE,
    Booleans,
    Floats,
    FrozenArrays,
    InputError,
    Integers,
    check_number,
    checked,
    once,
)
from fg_calib.io.columns import KNOWN, OF_CONFIGURATIONS, OF_PAIRS, Column, Table, names_of
from fg_calib.io.units import Units
from fg_calib.io.yaml import shown
from fg_calib.measurements import (
    ANGLE_SLACK,
    INSTRUMENTS,
    Groups,
    Labels,
    Measurements,
    Noise,
    Pairs,
    covariances,
    limit_hint,
    no_pairs,
    outside_limits,
)
from fg_calib.measurements.kinds import Instrument
from fg_calib.options import Model
from fg_calib.robot import Robot

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_log = logging.getLogger(__name__)

_POSES = ("x", "qx", "roll", "sigma_x", "sigma_rx")
_NOT_JOINTS = names_of(OF_CONFIGURATIONS[name] for name in ("id", "split", "group", *_POSES))
"""Names of columns that a joint's readings cannot have, whatever the model."""


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
) -> Measurements:
    """Configurations and what was measured at them and, with a table of pairs, between them.

    Args:
        path: Table of configurations: a file, or a frame of polars or pandas with such columns.
        robot: Whose configurations they are: names, number and limits of the joints.
        pairs: Table of pairs, likewise.
        units: Units of both tables; default m and rad.
        noise: Sigmas where the tables state none, [m] and [rad]; also of what was not measured yet.
        points: Names of contact points of other tables: pairs may say how far apart they are.
        model: The model whose columns are read; those of all models if None.
        columns: By known name, what the table of configurations calls a column.

    Raises:
        InputError: A file is missing, is no table, lacks a column or holds a cell that cannot be used; the message
            names its line and column.
    """
    units, noise = units or Units(), noise or Noise()
    _check_noise(noise)
    table = read_table(path, robot, columns or {})
    readings = read_readings(table, find_joint_columns(table, robot), robot, units)
    instruments = tuple(INSTRUMENTS.values()) if model is None else (INSTRUMENTS[model],)
    labels = _all_labels(table, instruments)
    repeated = bool(set(labels) - {"station"}) or table.has("u", model)
    rows = _Rows(table, read_ids(table, repeated=repeated), table.test_rows(), _groups(table))
    groups, between, between_groups = rows.groups, None, no_pairs(table.name)
    if pairs is not None:
        groups = Labels(tuple(dict.fromkeys((*groups.names, *points))), groups.index)
        between, between_groups = _read_pairs(pairs, _Rows(table, rows.ids, rows.test, groups), units, noise)
        groups = groups if between_groups.n_pairs else rows.groups
    return Measurements(
        readings=readings,
        ids=rows.ids.to_numpy().astype(np.str_),
        test=rows.test,
        sigma_joint=_joint_sigma(noise.joint, robot.n_joints),
        pairs=between,
        source=table.name,
        groups=Groups(groups.names, groups.index, between_groups) if groups.names else None,
        sigma_point=_sigma_point(table, groups.index >= 0, noise.point, units) if groups.names else None,
        named="id" in table.columns,
        labels=labels,
        **_poses(table, units, noise),
        **_lengths(table, units, noise, labels, model),
        **_images(table, units, noise, model),
        **_others(table, units, noise, [name for one in instruments for name in one.generic_columns]),
    )


def _check_noise(noise: Noise) -> None:
    """Raise for a sigma that is not above 0: nothing is measured exactly but joint readings."""
    for f in fields(noise)[:-1]:
        if f.name != "joint" and (sigma := getattr(noise, f.name)) is not None:
            check_number(f"noise: {f.name}", sigma, above=True)


def _all_labels(table: Table, instruments: Sequence[Instrument]) -> dict[str, Labels]:
    """The columns of names that instruments read."""
    if len(instruments) == 1 and instruments[0].uses_pairs and "target" in table.columns:
        words = "%s: column target is not used: model %s is of one point of the tool"
        _log.warning(words, table.name, instruments[0].model)
    optional = {name for one in instruments for name in one.optional_labels}
    names = dict.fromkeys(name for one in instruments for name in one.labels)
    return {name: _labels(table, name, optional=name in optional) for name in names if table.has(name)}


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
        hint = limit_hint(readings, robot, j, (columns[j], "the table"), units.name(unit))
        raise InputError(table.place(row), found, hint=hint)
    unlimited = np.array([not joint.prismatic for joint in robot.joints]) & np.isinf(robot.limits).all(axis=1)
    in_degrees = unlimited & ((np.abs(readings) > 4 * np.pi).mean(axis=0) > 0.5)
    if in_degrees.any() and units.angle == "rad":
        column = columns[int(np.argmax(in_degrees))]
        _log.warning("%s: most of %s are more than two turns; is the table in deg?", table.name, column)
    return readings


def read_ids(table: Table, *, repeated: bool) -> pl.Series:
    """The configurations' names, different ones unless `repeated`: their ids, or else their 0-based row numbers."""
    import polars as pl

    if "id" not in table.columns:
        return pl.int_range(table.n_rows, eager=True).cast(pl.String)
    table.names("id", "an id")
    ids = table.texts("id", "an id")
    commented = ids.str.starts_with("#").to_numpy()
    table.require(~commented | commented.all(), "id", "ids with # all or none", "# does not comment a row out")
    is_first = ids.is_first_distinct().to_numpy()
    if not repeated and not is_first.all():
        first = int(ids.index_of(ids[int(np.argmin(is_first))]) or 0)
        table.require(is_first, "id", "different ids", f"the same as {table.place(first)}")
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


def read_points(path: Path | str, columns: Mapping[str, Column] | None = None) -> tuple[str, ...]:
    """The names of the contact points of a table of configurations; `columns` as in `read_measurements`.

    Raises:
        InputError: The file is missing, or is no table.
    """
    own = {name: column for name, column in (columns or {}).items() if name == "group"}
    table = Table.read(path, "frame", ["group"], columns=own)
    return _groups(table).names


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
    poses = _poses(table, units, Noise())
    named = table.present(*(f"q{i + 1}" for i in range(robot.n_joints)), *(joint.name for joint in robot.joints))
    if poses["position"] is None and (poses["rotation"] is not None or not named):
        found = "neither x y z nor joint columns" if poses["rotation"] is None else "orientations without x y z"
        raise InputError(table.name, found, "x y z, or joint values alone", f"it has {', '.join(table.columns)}")
    return Targets(
        ids=tuple(read_ids(table, repeated=False).to_list()),
        position=poses["position"],
        rotation=poses["rotation"],
        readings=read_readings(table, find_joint_columns(table, robot), robot, units) if named else None,
    )


# --- columns of configurations ----------------------------------------------------------------------------------------


def _factor(units: Units, column: str) -> float:
    """What a number of a column is multiplied by to be in [m], [rad] or [px]."""
    unit = OF_CONFIGURATIONS[column].unit
    return units.factor({"length": "m", "angle": "rad"}[unit]) if unit in ("length", "angle") else 1.0


def _values(table: Table, first: str, units: Units) -> Floats | None:
    """Columns that belong together, by the first, shape (n_rows, n_columns), in SI; None where the table has none."""
    if not table.has(first):
        return None
    return table.numbers(OF_CONFIGURATIONS[first].names) * _factor(units, first)


def _sigma(table: Table, single: str, first: str, default: float | None, units: Units) -> Floats | None:
    """Sigmas along the axes, shape (n_rows, n_axes); None where neither the table nor a default states them."""
    axes = OF_CONFIGURATIONS[first].names
    if table.has(single) and table.present(*axes):
        raise InputError(table.name, f"both {single} and {table.present(*axes)[0]}", "one of the two")
    for name in (single, first):
        if table.has(name):
            sigma = table.positive(OF_CONFIGURATIONS[name].names, default, _factor(units, name))
            return np.broadcast_to(sigma, (table.n_rows, len(axes))).copy()
    return None if default is None else np.full((table.n_rows, len(axes)), default)


def _poses(table: Table, units: Units, noise: Noise) -> dict[str, Any]:
    """Measured positions and orientations and their sigmas, by the names of the fields of `Measurements`."""
    from scipy.spatial.transform import Rotation

    quaternion, angles = _values(table, "qx", units), _values(table, "roll", units)
    if quaternion is not None and angles is not None:
        raise InputError(table.name, "both qx qy qz qw and roll pitch yaw", "one of the two")
    rotation = None
    if quaternion is not None:
        norm = np.linalg.norm(quaternion, axis=1)
        wrong = np.abs(norm - 1.0) > NORM_TOLERANCE
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(table.place(row), f"quaternion of norm {norm[row]:.6g}", f"1 within {NORM_TOLERANCE:g}")
        rotation = Rotation.from_quat(quaternion)
    elif angles is not None:
        rotation = Rotation.from_euler("xyz", angles)  # about fixed axes: Rz(yaw) Ry(pitch) Rx(roll)
    elif (
        table.present(*OF_CONFIGURATIONS["rx"].names) == OF_CONFIGURATIONS["rx"].names
    ):  # one of them alone may be anything
        rotation = Rotation.from_rotvec(table.numbers(OF_CONFIGURATIONS["rx"].names) * units.factor("rad"))
    return {
        "position": _values(table, "x", units),
        "rotation": None if rotation is None else rotation.as_matrix(),
        "sigma_position": _sigma(table, "sigma_position", "sigma_x", noise.position, units),
        "sigma_orientation": _sigma(table, "sigma_orientation", "sigma_rx", noise.orientation, units),
        "roll_pitch_yaw": angles,
    }


def _lengths(
    table: Table, units: Units, noise: Noise, labels: Mapping[str, Labels], model: Model | None
) -> dict[str, Any]:
    """Distances to anchors or from planes and their sigmas, by the names of the fields of `Measurements`."""
    found: dict[str, Any] = {"sigma_length": None if noise.distance is None else np.full(table.n_rows, noise.distance)}
    if not {"anchor", "plane"}.intersection(labels):
        return found
    if table.has("distance"):
        values = table.numbers(["distance"], optional=True)[:, 0]
        if "plane" not in labels:
            table.require(~(values < 0.0), "distance", "a number not below 0")
        found["length"] = values * units.factor("m")
    if table.has("sigma_distance"):
        found["sigma_length"] = table.positive(["sigma_distance"], noise.distance, units.factor("m"))[:, 0]
    return found


def _images(table: Table, units: Units, noise: Noise, model: Model | None) -> dict[str, Any]:
    """Images of a board's corners, and covariances of its poses, by the names of the fields of `Measurements`."""
    found: dict[str, Any] = {"sigma_pixel": None if noise.pixel is None else np.full((table.n_rows, 2), noise.pixel)}
    if table.has("u", model) or table.has("corner_x", model):
        both = [*OF_CONFIGURATIONS["u"].names, *OF_CONFIGURATIONS["corner_x"].names]
        table.require_columns(both)
        found["image"] = table.numbers(both) * np.repeat([1.0, units.factor("m")], 2)
        found["sigma_pixel"] = _sigma(table, "sigma_pixel", "sigma_u", noise.pixel, units)
    if table.has("cov_11", model):
        C = np.zeros((table.n_rows, 6, 6))
        i, j = np.triu_indices(6)
        C[:, i, j] = C[:, j, i] = table.numbers(OF_CONFIGURATIONS["cov_11"].names)
        size = np.repeat([units.factor("rad"), units.factor("m")], 3)
        good, found["covariance"] = covariances(C * np.outer(size, size))
        table.require(good, "cov_11", "a covariance: eigenvalues above 0")
    return found


def _others(table: Table, units: Units, noise: Noise, names: Sequence[str]) -> dict[str, Any]:
    """Columns that one instrument alone has, and their sigmas, by the names of the fields of `Measurements`."""
    columns: dict[str, Floats] = {}
    sigmas: dict[str, Floats] = {}
    for name in names:
        if table.has(name):
            columns[name] = table.numbers([name], optional=True)[:, 0] * _factor(units, name)
        default = noise.more.get(name)
        if f"sigma_{name}" in table.columns:
            sigmas[name] = table.positive([f"sigma_{name}"], default, _factor(units, name))[:, 0]
        elif default is not None:
            sigmas[name] = np.full(table.n_rows, default)
    return {"columns": columns, "sigmas": sigmas}


def _labels(table: Table, column: str, *, optional: bool) -> Labels:
    """Names in the order met, and which of them each row has."""
    what = "point" if column == "group" else column
    expected = f"the name of a{'n' * (what[0] in 'aeiou')} {what}"
    cells: list[str | None] = table.names(column, expected + ", or an empty cell" * optional).to_list()
    if not optional:
        table.texts(column, expected)
    names = tuple(dict.fromkeys(cell for cell in cells if cell is not None))
    place = {name: i for i, name in enumerate(names)}
    return Labels(names, np.array([-1 if cell is None else place[cell] for cell in cells], dtype=np.int64))


def _groups(table: Table) -> Labels:
    """Names of the contact points in the order met, and each row's, -1 for none."""
    if not table.has("group"):
        return Labels((), np.full(table.n_rows, -1, dtype=np.int64))
    return _labels(table, "group", optional=True)


def _sigma_point(table: Table, touched: Booleans, default: float | None, units: Units) -> Floats | None:
    """Sigma of each contact, shape (n_rows,), [m], without meaning where there is none; None if not stated."""
    if not table.has("sigma_point"):
        return None if default is None else np.full(table.n_rows, default)
    values = table.numbers(["sigma_point"], optional=True)[:, 0]
    expected = "a number above 0" if default is None else "a number above 0, or an empty cell"
    table.require(~touched | np.where(np.isnan(values), default is not None, values > 0.0), "sigma_point", expected)
    return np.where(np.isnan(values), np.nan if default is None else default, values * units.factor("m"))


def _joint_sigma(joint: float | tuple[float, ...], n_joints: int) -> Floats:
    """Sigma of the readings, shape (n_joints,), [rad] or [m]."""
    sigma = np.atleast_1d(np.asarray(joint, dtype=np.float64))
    if isinstance(joint, tuple) and len(joint) != n_joints:
        raise InputError("noise: joint", f"{len(joint)} figures", f"one for all or {n_joints}, one a joint")
    return np.broadcast_to(sigma, n_joints).copy()


# --- pairs ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Rows:
    """What pairs refer to: the rows of a table of configurations.

    Attributes:
        table: The table.
        ids: Names of the configurations, shape (n_rows,).
        test: Whether each is a test row, shape (n_rows,).
        groups: The contact points.
    """

    table: Table
    ids: pl.Series
    test: Booleans
    groups: Labels


def _read_pairs(path: Path | str | Any, rows: _Rows, units: Units, noise: Noise) -> tuple[Pairs, Pairs]:
    """The pairs of configurations and those of contact points that a table lists.

    Raises:
        InputError: The file is missing, is no table, lacks a column or holds a cell that cannot be used; or several
            configurations have one id.
    """
    known = names_of(OF_PAIRS.values())
    table = Table.read(path, "frame of pairs", known)
    if missing := [name for name in OF_PAIRS["a"].names if name not in table.columns]:
        raise InputError(table.name, f"no column {missing[0]}", "a and b, the two configurations of a pair")
    if not table.present("distance", "angle"):
        raise InputError(table.name, "neither distance nor angle", "at least one of the columns")
    again = (~rows.ids.is_first_distinct()).arg_true()
    if len(again):  # no pair could say which is meant
        found = f"id = {shown(rows.ids[again[0]])} of a second row"
        raise InputError(rows.table.place(again[0]), found, "different ids where pairs name them")
    (a, of_groups), (b, b_of_groups) = (_named_rows(table, column, rows) for column in OF_PAIRS["a"].names)
    _check_ends(table, a, b, of_groups, b_of_groups)
    distance, angle = (_pair_numbers(table, column, units) for column in ("distance", "angle"))
    _check_ranges(table, distance, angle, units)
    if of_groups.any():
        _check_group_pairs(table, of_groups, distance, angle)
    pairs = Pairs(
        a=a,
        b=b,
        distance=distance,
        angle=np.minimum(angle, np.pi),
        sigma_distance=_pair_numbers(table, "sigma_distance", units, noise.distance),
        sigma_angle=_pair_numbers(table, "sigma_angle", units, noise.angle),
        test=once(table.test_rows() | _has_test_end(a, b, of_groups, rows)),
        source=table.name,
        unused=tuple(name for name in table.columns if name not in known),
    )
    return (pairs, no_pairs(table.name)) if not of_groups.any() else (pairs.select(~of_groups), pairs.select(of_groups))


def _pair_numbers(table: Table, column: str, units: Units, default: float | None = None) -> Floats:
    """Distances, angles or their sigmas, shape (n_pairs,), [m] or [rad]; `default` or nan where there is none."""
    default = np.nan if default is None else default
    if column not in table.columns:
        return once(np.full(table.n_rows, default))
    factor = units.factor("m" if OF_PAIRS[column].unit == "length" else "rad")
    if column.startswith("sigma_"):
        return once(table.positive([column], default, factor)[:, 0])
    return table.numbers([column], optional=True)[:, 0] * factor


def _check_ends(table: Table, a: Integers, b: Integers, of_groups: Booleans, b_of_groups: Booleans) -> None:
    """Raise for the first pair of a configuration and a contact point, or of one twice."""
    mixed = of_groups != b_of_groups
    if mixed.any():
        row = int(np.argmax(mixed))
        which = ("a is a group and b" if of_groups[row] else "b is a group and a") + " a configuration"
        raise InputError(table.place(row), which, "two configurations or two groups")
    if (a == b).any():
        row = int(np.argmax(a == b))
        what = "groups" if of_groups[row] else "configurations"
        raise InputError(table.place(row), f"a and b are both {shown(table.texts('a')[row])}", f"two different {what}")


def _check_ranges(table: Table, distance: Floats, angle: Floats, units: Units) -> None:
    """Raise for the first distance below 0, and the first angle outside 0 to pi."""
    if "distance" in table.columns:
        table.require(~(distance < 0.0), "distance", "a number not below 0")
    if "angle" in table.columns:
        factor = units.factor("rad")
        good = ~((angle < 0.0) | (angle > np.pi + ANGLE_SLACK))
        in_degrees = units.angle == "rad" and 0.0 <= np.deg2rad(angle[np.argmin(good)]) <= np.pi
        hint = "is the table in deg?" if in_degrees else ""
        table.require(good, "angle", f"0 to {np.pi / factor:.6g} {units.angle}", hint)


def _check_group_pairs(table: Table, of_groups: Booleans, distance: Floats, angle: Floats) -> None:
    """Raise for the first pair of contact points that has an angle, or no distance above 0."""
    if "angle" in table.columns:
        table.require(~of_groups | np.isnan(angle), "angle", "an empty cell: two points have a distance, but no angle")
    if "distance" not in table.columns:
        raise InputError(table.place(int(np.argmax(of_groups))), "two groups without a distance", "a column distance")
    expected = "a number above 0 between two groups; one point is one group"
    table.require(~of_groups | (distance > 0.0), "distance", expected)


def _has_test_end(a: Integers, b: Integers, of_groups: Booleans, rows: _Rows) -> Booleans:
    """Pairs of a test row, or of a contact point that has test rows only, shape (n_pairs,)."""
    contacts = [rows.test[rows.groups.index == g] for g in range(len(rows.groups.names))]
    only_test = np.array([len(of) > 0 and of.all() for of in contacts], dtype=np.bool_)
    found = np.zeros(len(a), dtype=np.bool_)
    for flags, chosen in ((rows.test, ~of_groups), (only_test, of_groups)):
        found[chosen] = flags[a[chosen]] | flags[b[chosen]]
    return found


def _named_rows(table: Table, column: str, rows: _Rows) -> tuple[Integers, Booleans]:
    """Rows of configurations or indices of contact points that a column names, and whether these; shapes (n_pairs,)."""
    import polars as pl

    by_id, known = "id" in rows.table.columns, rows.groups.names
    kind = "an id" if by_id else "a row"
    names = table.texts(column, "a configuration")
    if not by_id and names.str.contains(".", literal=True).any():
        names = names.str.replace(r"^(\d+)\.0+$", "$1")  # so pandas writes whole numbers next to an empty cell
    row_of, group_of = (
        names.cast(pl.Enum(of), strict=False).to_physical() for of in (rows.ids, pl.Series(known, dtype=pl.String))
    )
    both, neither = row_of.is_not_null() & group_of.is_not_null(), row_of.is_null() & group_of.is_null()
    if both.any():
        row = both.arg_true()[0]
        found = f"{column} = {shown(names[row])} is both {kind} and a group of {rows.table.name}"
        raise InputError(table.place(row), found, "different names")
    if neither.any():
        row = neither.arg_true()[0]
        either = f"{kind} or a group" if known else kind
        found = f"{column} = {shown(names[row])} is not {either} of {rows.table.name}"
        raise InputError(table.place(row), found, "" if by_id else f"a number from 0 to {len(rows.ids) - 1}")
    is_group = group_of.is_not_null().to_numpy()
    return np.where(is_group, group_of.fill_null(-1).to_numpy(), row_of.fill_null(-1).to_numpy()), is_group
