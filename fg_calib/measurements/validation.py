"""Measurements that come as arrays: checked, and brought to the shapes in which they are kept; all in [m] and [rad].

The rules are those of the tables (see `io.tables`); messages name the array and its row.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fg_calib.inputs import (
    LEAST_SIZE,
    NORM_TOLERANCE,
    NOTHING,
    ORDINARY,
    Booleans,
    Floats,
    InputError,
    Integers,
    as_array,
    as_columns,
    as_figures,
    as_floats,
    as_names,
    as_rotations,
    check_names,
    check_sizes,
    require,
    shape_of,
)
from fg_calib.robot import Robot

_log = logging.getLogger(__name__)


ANGLE_SLACK = 1e-5
"""How far a rotation angle may exceed pi, [rad]: half a turn, rounded to six figures."""

ROUNDED = 1e-9
"""Share of a covariance that may be rounding."""

LIMIT_SLACK = 1e-3
"""How far a reading may be beyond its joint's limits, [rad] or [m]: encoders say so of a joint that stands at one."""

FAR = 0.5
"""Part of a joint's range beyond its limits from which a smaller unit is likelier than limits that are too narrow."""

_UNITS = {"m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2}, "rad": {"rad": 1.0, "deg": np.pi / 180.0}}

PAIR_KEYS = ("a", "b", "distance", "angle", "sigma_distance", "sigma_angle", "test")


def checked_readings(given: ArrayLike) -> Floats:
    """Joint readings, shape (n, n_joints), at least one."""
    q = as_floats("readings", given, "(n, n_joints)")
    if not q.size:
        raise InputError("readings", f"shape {q.shape}", "(n, n_joints) with at least one row and joint")
    return q


COLUMNS = ("position", "rotation", "quaternion", "roll_pitch_yaw", "distance", "pixel", "corner", "covariance",
           "sigma_position", "sigma_orientation", "sigma_distance", "sigma_point", "sigma_pixel")  # fmt: skip
"""Arrays that `Measurements.from_arrays` takes, nan where an optional value was not measured.

- `position`: world_p_tool, shape (n, 3), [m].
- `rotation`: world_R_tool, shape (n, 3, 3); or `quaternion`: the same as x y z w, shape (n, 4); or `roll_pitch_yaw`:
  the same as Rz(yaw) Ry(pitch) Rx(roll), shape (n, 3), [rad].
- `distance`: to the row's anchor or from its plane, nan where not measured, shape (n,), [m].
- `pixel`: where a point of the row's board was seen, u and v, shape (n, 2), [px]; `corner`: where that point is on the
  board, x and y, shape (n, 2), [m].
- `covariance`: of camera_T_board, rotation first, about and along the camera's axes, shape (n, 6, 6).
- `sigma_position` along the world's axes and `sigma_orientation` about the tool's, shape (n, 3); `sigma_distance` and
  `sigma_point`, of a touch on each axis, shape (n,); `sigma_pixel`, shape (n, 2).
"""

LABELS = ("target", "station", "anchor", "plane", "board")
"""Names of what each row is of, shape (n,), that `Measurements.from_arrays` takes.

- `target`: whose position was measured, None for the tool point itself.
- `station`: from which it was measured, each with a frame of its own.
- `anchor`: that `distance` is to.
- `plane`: that the tool point is on, or `distance` from.
- `board`: that a camera saw; `position` and orientation are then camera_T_board.
"""


def checked_columns(given: Mapping[str, Any], n: int) -> dict[str, Any]:
    """Fields of `Measurements` from arrays of n rows by the names of `COLUMNS`."""
    rotation, angles = _checked_rotation(n, given)
    found: dict[str, Any] = {"rotation": rotation, "roll_pitch_yaw": angles, "image": _checked_image(n, given)}
    if "position" in given:
        found["position"] = as_floats("position", given["position"], f"({n}, 3)")
    if "distance" in given:
        found["length"] = as_floats("distance", given["distance"], f"({n})", missing=True)
        good = ~(found["length"] < 0.0) if "plane" not in given else np.ones(n, dtype=np.bool_)
        require(good, "distance", found["length"], "a number not below 0")
    if "covariance" in given:
        good, C = covariances(as_floats("covariance", given["covariance"], f"({n}, 6, 6)"))
        require(good, "covariance", np.einsum("nii->ni", C), "symmetric matrices with eigenvalues above 0")
        found["covariance"] = C
    for noise, axes in _AXES.items():
        if (name := f"sigma_{noise}") in given:
            sigma = np.broadcast_to(checked_sigma(name, given[name], (n, *axes)), (n, *axes))
            found["sigma_length" if noise == "distance" else name] = np.ascontiguousarray(sigma)
    return found


_AXES: Mapping[str, tuple[int, ...]] = {
    "position": (3,),
    "orientation": (3,),
    "distance": (),
    "point": (),
    "pixel": (2,),
}
"""Axes of the sigma of each kind of noise."""


def _checked_rotation(n: int, given: Mapping[str, ArrayLike]) -> tuple[Floats | None, Floats | None]:
    """Rotation matrices, shape (n, 3, 3), and roll, pitch, yaw where that is what was given, shape (n, 3)."""
    ways = [name for name in ("rotation", "quaternion", "roll_pitch_yaw") if name in given]
    if len(ways) > 1:
        raise InputError(f"{ways[0]} and {ways[1]}", "both were given", "one of the two")
    match ways:
        case ["rotation"]:
            return as_rotations("rotation", given["rotation"], n), None
        case ["quaternion"]:
            q = as_floats("quaternion", given["quaternion"], f"({n}, 4)")
            norm = np.linalg.norm(q, axis=1)
            require(np.abs(norm - 1.0) <= NORM_TOLERANCE, "quaternion", q, "x y z w of length 1")
            return Rotation.from_quat(q).as_matrix(), None
        case ["roll_pitch_yaw"]:
            angles = as_floats("roll_pitch_yaw", given["roll_pitch_yaw"], f"({n}, 3)")
            return Rotation.from_euler("xyz", angles).as_matrix(), angles
    return None, None


def checked_joint_sigma(given: ArrayLike, n_joints: int) -> Floats:
    """Sigma of the readings of each joint, shape (n_joints,), from one for all or one a joint."""
    one = shape_of("sigma_joint", given, f"one value, or {n_joints}") == ()
    sigma = as_floats("sigma_joint", given, "()" if one else f"({n_joints})")
    require(sigma >= 0.0, "sigma_joint", sigma, "a number not below 0")
    return np.ascontiguousarray(np.broadcast_to(sigma, n_joints))


def checked_numbers(name: str, given: Any) -> Floats:
    """Finite numbers of any shape, a copy."""
    values = as_figures(name, given, "finite numbers")
    check_sizes(name, values)
    return values


def checked_indices(name: str, given: Any, n: int, top: int | None) -> Integers:
    """Whole numbers from 0, a row each of n, below a top where there is one."""
    values = np.array(given)
    if values.dtype.kind not in "iu" or values.shape[:1] != (n,):
        raise InputError(name, f"{values.dtype} of shape {values.shape}", f"whole numbers, a row for each of {n}")
    good = (values >= 0) & ((values < top) if top is not None else True)
    require(good, name, values, "0 and above" if top is None else f"0 to {top - 1}")
    return values


def checked_sigma(name: str, given: Any, shape: tuple[int, ...]) -> Floats:
    """Sigmas that broadcast to (n,) or (n, k), from such, or one a row."""
    sigma = checked_numbers(name, given)
    require(sigma > 0.0, name, sigma, "a number above 0")
    require(sigma >= LEAST_SIZE, name, sigma, ORDINARY)
    if len(shape) == 2 and sigma.shape == shape[:1] != (1,):
        if shape[0] == shape[1]:
            n = shape[0]
            raise InputError(name, f"shape ({n},) of {n} rows", f"({n}, 1) for one a row, (1, {n}) for one an axis")
        sigma = sigma[:, None]
    try:
        np.broadcast_to(sigma, shape)
    except ValueError:
        raise InputError(name, f"shape {np.shape(given)}", f"one that broadcasts to {shape}, or one a row") from None
    return sigma


def checked_names(name: str, given: ArrayLike | None, n: int, expected: str, *, missing: bool) -> list[str | None]:
    """Names of n rows; None of all if None is given."""
    if given is None:
        return [None] * n
    if (found := shape_of(name, given, "names")) != (n,):
        raise InputError(name, f"shape {found}", f"({n},){expected}")
    return as_names(name, given, missing=missing)


def checked_ids(given: ArrayLike | None, n: int, *, repeated: bool = False) -> NDArray[np.str_]:
    """Names of n configurations, different ones unless `repeated`: their row numbers if None."""
    if given is None:
        return np.arange(n).astype(np.str_)
    ids = np.array(checked_names("ids", given, n, ", one a configuration", missing=False), dtype=np.str_)
    first = np.unique(ids, return_index=True)[1]
    require(repeated | np.isin(np.arange(n), first), "ids", ids, "different ids")
    return ids


def checked_mask(name: str, given: ArrayLike | None, n: int) -> Booleans:
    """A mask of n rows: nowhere true if None."""
    if given is None:
        return np.zeros(n, dtype=np.bool_)
    mask = as_array(name, given, "b", f"True or False for each of {n} rows")
    if mask.shape != (n,):
        raise InputError(name, f"shape {mask.shape}", f"({n},), one a row")
    return mask.copy()


def checked_labels(what: str, given: ArrayLike | None, n: int) -> tuple[tuple[str, ...], Integers]:
    """Different names in the order met, and which of them each row has, -1 for none, shape (n,)."""
    named = checked_names(what, given, n, ": a name, or None where there is none", missing=True)
    names = tuple(dict.fromkeys(name for name in named if name is not None))
    place = {name: i for i, name in enumerate(names)} | {None: -1}
    return names, np.array([place[name] for name in named], dtype=np.int64)


def _checked_image(n: int, given: Mapping[str, ArrayLike]) -> Floats | None:
    """u, v, [px], and the point on the board, x, y, [m], shape (n, 4); None if neither was given."""
    names = ("pixel", "corner")
    if not given.keys() & set(names):
        return None
    for name, other in (names, names[::-1]):
        if name not in given:
            raise InputError(name, f"none with {other}", "both: what was seen, and where it is on the board")
    return np.hstack([as_floats(name, given[name], f"({n}, 2)") for name in names])


def covariances(C: Floats) -> tuple[Booleans, Floats]:
    """Which matrices are covariances, shape (n,), and these with rounding taken off, shape (n, d, d)."""
    size = np.sqrt(np.maximum(np.einsum("nii->ni", C), LEAST_SIZE**2))
    scaled = C / (size[:, :, None] * size[:, None, :])
    alike = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2), initial=0.0) < ROUNDED
    C = 0.5 * (C + np.swapaxes(C, 1, 2))
    return alike & (np.linalg.eigvalsh(scaled)[:, 0] > ROUNDED), C


def checked_pairs(
    given: Any, ids: NDArray[np.str_], group_names: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], Booleans]:
    """Columns of pairs by the names of `PAIR_KEYS`, ends as rows of configurations or indices of groups.

    Args:
        given: Arrays by these names; `a` and `b` hold ids, row numbers, or groups. Whole numbers are row numbers
            where no id and no group is a number.
        ids: Of the configurations.
        group_names: Of the groups.

    Returns:
        The columns, shape (n_pairs,) each, and which pairs are of groups.
    """
    expected = "a mapping of arrays by the names a, b, distance, angle, or a frame of polars or pandas"
    given = as_columns("pairs", given, expected)
    check_names("pairs", given, PAIR_KEYS, "key")
    for key in ("a", "b"):
        if key not in given:
            raise InputError("pairs", f"no {key}", "a and b, the two configurations of a pair")
    if "distance" not in given and "angle" not in given:
        raise InputError("pairs", "neither distance nor angle", "at least one of them")
    columns, of_groups = _ends(given, ids, group_names)
    n = len(of_groups)
    for key in ("distance", "angle"):
        figures = as_floats(f"pairs: {key}", given.get(key, np.full(n, np.nan)), f"({n})", missing=True)
        most, words = (np.inf, "a number not below 0") if key == "distance" else (np.pi, "0 to pi, in rad")
        require(~((figures < 0.0) | (figures > most + ANGLE_SLACK)), f"pairs: {key}", figures, words)
        columns[key] = np.minimum(figures, most)
        sigma, place = given.get(f"sigma_{key}"), f"pairs: sigma_{key}"
        columns[f"sigma_{key}"] = np.full(n, np.nan)
        if sigma is not None:
            columns[f"sigma_{key}"][:] = checked_sigma(place, sigma, (n,))
    columns["test"] = checked_mask("pairs: test", given.get("test"), n)
    angle, distance = columns["angle"], columns["distance"]
    require(~of_groups | np.isnan(angle), "pairs: angle", angle, "nan: two points have a distance, but no angle")
    require(~of_groups | (distance > 0.0), "pairs: distance", distance, "a number above 0 between two groups")
    return columns, of_groups


def _ends(
    given: Mapping[str, ArrayLike], ids: NDArray[np.str_], group_names: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], Booleans]:
    """Rows of configurations or indices of groups that `a` and `b` name, and whether they are groups."""
    known = np.concatenate([ids, np.array(group_names, dtype=np.str_)])
    twice = np.intersect1d(ids, known[len(ids) :]) if group_names else ids[:0]
    what = "an id or a group" if group_names else "an id (the row number where no ids were given)"
    by_row = not any(word.isdigit() for word in known.tolist())
    by_row_too = not group_names and np.array_equal(ids, np.arange(len(ids)).astype(np.str_))
    place = {name: i for i, name in enumerate(known.tolist())}
    index, named = dict[str, Integers](), dict[str, NDArray[Any]]()
    for key in ("a", "b"):
        names = as_array(f"pairs: {key}", given[key], "iuUO", "ids")
        if names.ndim != 1 or len(names) != np.size(given["a"]):
            raise InputError(f"pairs: {key}", f"shape {names.shape}", "(n_pairs,), as many of a as of b")
        whole, hint, expected = names.dtype.kind in "iu", "", what
        if whole and (by_row or by_row_too):
            index[key] = np.where((names >= 0) & (names < len(ids)), names, -1).astype(np.int64)
            expected = f"{what}, or a row number, 0 to {len(ids) - 1}" if by_row else what
        else:
            clean = names.dtype.kind == "U" and not {"", *NOTHING}.intersection(map(str.lower, set(names.tolist())))
            words: list[Any] = names.tolist() if clean else as_names(f"pairs: {key}", given[key])
            require(
                ~np.isin(np.array(words, dtype=np.str_), twice),
                f"pairs: {key}",
                names,
                "different names of ids and groups",
            )
            index[key] = np.array([place.get(str(word), -1) for word in words], dtype=np.int64)
            hint = "row numbers are understood where no id or group is a number" * whole
        require(index[key] >= 0, f"pairs: {key}", names, expected, hint)
        named[key] = names
    a, b = index.values()
    require((a < len(ids)) == (b < len(ids)), "pairs: b", named["b"], "two configurations or two groups")
    require(a != b, "pairs: b", named["b"], "another than a")
    of_groups = a >= len(ids)
    return {key: np.where(of_groups, i - len(ids), i) for key, i in index.items()}, of_groups


def check_readings(readings: Floats, robot: Robot, name: str) -> None:
    """Check that readings are of a robot's joints and within their limits; warn where they look like degrees.

    Args:
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        robot: The robot.
        name: What they are, for messages.

    Raises:
        InputError: They are of more or fewer joints, or outside limits.
    """
    if readings.shape[1] != robot.n_joints:
        raise InputError(name, f"readings of {readings.shape[1]} joints", f"{robot.n_joints}, as {robot.name} has")
    lower, upper = robot.limits.T
    outside = outside_limits(readings, robot)
    if outside.any():
        row, j = divmod(int(np.argmax(outside)), robot.n_joints)
        joint, reading = robot.joints[j], readings[row, j]
        found = f"{joint.name} = {reading:.6g} {joint.unit} is outside [{lower[j]:.6g}, {upper[j]:.6g}]"
        hint = limit_hint(readings, robot, j, (joint.name, "it"), joint.unit)
        raise InputError(f"{name}: row {row}", found, hint=hint)
    turning = np.array([not joint.prismatic for joint in robot.joints]) & np.isinf(lower) & np.isinf(upper)
    suspicious = turning & ((np.abs(readings) > 4 * np.pi).mean(axis=0) > 0.5)
    if suspicious.any():
        joint = robot.joints[int(np.argmax(suspicious))]
        _log.warning("%s: most readings of %s are more than two turns; are they in deg?", name, joint.name)


def outside_limits(readings: Floats, robot: Robot) -> Booleans:
    """Which readings, shape (n, n_joints), [rad] (prismatic: [m]), are beyond their joints' limits."""
    lower, upper = robot.limits.T
    outside: Booleans = (readings < lower - LIMIT_SLACK) | (readings > upper + LIMIT_SLACK)
    return outside


def limit_hint(readings: Floats, robot: Robot, joint: int, names: tuple[str, str], stated: str) -> str:
    """What to do about a joint that has a reading outside its limits.

    Another unit is asked about where it brings all rows within the limits, and where that is no accident: a smaller one
    where the reading is far outside, a larger one where every row is outside as it stands.

    Args:
        readings: As understood so far, shape (n, n_joints), [rad] (prismatic: [m]).
        robot: The robot.
        joint: 0-based number of the joint.
        names: What its readings and those of all joints are called.
        stated: Name of the unit that they are taken to be in.
    """
    low, high = robot.limits[joint]
    q, outside = readings[:, joint], outside_limits(readings, robot)
    kind = [other.unit == robot.joints[joint].unit for other in robot.joints]
    alone = sum(kind) > 1 and not np.delete(outside, joint, axis=1)[:, np.delete(kind, joint)].any()
    sizes = _UNITS[robot.joints[joint].unit]
    for name, size in sizes.items() if stated in sizes else ():
        factor = size / sizes[stated]
        within = np.all((q * factor >= low - LIMIT_SLACK) & (q * factor <= high + LIMIT_SLACK))
        far = max(low - q.min(), q.max() - high) > FAR * (high - low)
        if within and (far if factor < 1.0 else outside[:, joint].all()):
            return f"is {names[0] if alone else names[1]} in {name}?"
    return "widen the joint's limits if the reading is right"
