"""Measurements that come as arrays: checked, and brought to the shapes in which they are kept; all in [m] and [rad].

The rules are those of the tables (see `files.tables`); messages name the array and its row.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    as_floats,
    as_names,
    as_rotations,
    check_names,
    require,
    shape_of,
)
from fg_calib.measurements.limits import limit_hint, outside_limits
from fg_calib.robot import Robot

_log = logging.getLogger(__name__)


ANGLE_SLACK = 1e-5
"""How far a rotation angle may exceed pi, [rad]: half a turn, rounded to six figures."""

ROUNDED = 1e-9
"""Share of a covariance that may be rounding."""

PAIR_KEYS = ("a", "b", "distance", "angle", "sigma_distance", "sigma_angle", "test")


def checked_readings(given: ArrayLike) -> Floats:
    """Joint readings, shape (n, n_joints), at least one."""
    q = as_floats("readings", given, "(n, n_joints)")
    if not q.size:
        raise InputError("readings", f"shape {q.shape}", "(n, n_joints) with at least one row and joint")
    return q


def checked_rotation(
    n: int, rotation: ArrayLike | None, quaternion: ArrayLike | None, roll_pitch_yaw: ArrayLike | None
) -> tuple[Floats | None, Floats | None]:
    """Rotation matrices, shape (n, 3, 3), and roll, pitch, yaw where that is what was given, shape (n, 3)."""
    ways = {"rotation": rotation, "quaternion": quaternion, "roll_pitch_yaw": roll_pitch_yaw}
    given = [name for name, value in ways.items() if value is not None]
    if len(given) > 1:
        raise InputError(f"{given[0]} and {given[1]}", "both were given", "one of the two")
    if rotation is not None:
        return as_rotations("rotation", rotation, n), None
    if not given:
        return None, None
    from scipy.spatial.transform import Rotation

    if roll_pitch_yaw is not None:
        angles = as_floats("roll_pitch_yaw", roll_pitch_yaw, f"({n}, 3)")
        return Rotation.from_euler("xyz", angles).as_matrix(), angles
    q = as_floats("quaternion", quaternion, f"({n}, 4)")
    norm = np.linalg.norm(q, axis=1)
    require(np.abs(norm - 1.0) <= NORM_TOLERANCE, "quaternion", q, "x y z w of length 1")
    return Rotation.from_quat(q).as_matrix(), None


def checked_sigma(name: str, given: ArrayLike | None, shape: tuple[int, ...]) -> Floats | None:
    """Sigmas of n rows, shape (n,) or (n, 3), from one figure, one an axis, one a row, or all; None if None."""
    if given is None:
        return None
    possible = ((), *({shape[1:]} - {()}), shape[:1], *([(shape[0], 1), (1, *shape[1:])] if shape[1:] else []), shape)
    expected = f"one of {', '.join(map(str, dict.fromkeys(possible)))}"
    found = shape_of(name, given, f"figures of shape {expected}")
    if found not in possible:
        raise InputError(name, f"shape {found}", expected)
    if len(shape) == 2 and shape[0] == shape[1] > 1 and found == shape[:1]:
        expected = f"({shape[0]}, 1) for one a row, (1, {shape[0]}) for one an axis"
        raise InputError(name, f"shape {shape[:1]} of {shape[0]} rows", expected)
    sigma = as_floats(name, given, str(found))
    require(sigma > 0.0, name, sigma, "a number above 0")
    require(sigma >= LEAST_SIZE, name, sigma, ORDINARY)
    if sigma.shape == shape[:1] != shape[1:]:
        sigma = sigma.reshape(shape[:1] + (1,) * (len(shape) - 1))
    return np.ascontiguousarray(np.broadcast_to(sigma, shape))


def checked_joint_sigma(given: ArrayLike, n_joints: int) -> Floats:
    """Sigma of the readings of each joint, shape (n_joints,), from one figure for all or one a joint."""
    one = shape_of("sigma_joint", given, f"one figure, or {n_joints}") == ()
    sigma = as_floats("sigma_joint", given, "()" if one else f"({n_joints})")
    require(sigma >= 0.0, "sigma_joint", sigma, "a number not below 0")
    return np.ascontiguousarray(np.broadcast_to(sigma, n_joints))


def checked_ids(given: ArrayLike | None, n: int, *, repeated: bool = False) -> NDArray[np.str_]:
    """Names of n configurations, different ones unless `repeated`: their row numbers if None."""
    if given is None:
        return np.arange(n).astype(np.str_)
    if (found := shape_of("ids", given, "names")) != (n,):
        raise InputError("ids", f"shape {found}", f"({n},), one a configuration")
    ids = np.array(as_names("ids", given), dtype=np.str_)
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
    if given is not None and (found := shape_of(what, given, "names")) != (n,):
        raise InputError(what, f"shape {found}", f"({n},): a name, or None where there is none")
    named = [] if given is None else as_names(what, given, missing=True)
    names = tuple(dict.fromkeys(name for name in named if name is not None))
    place = {name: i for i, name in enumerate(names)}
    index = [-1 if name is None else place[name] for name in named] or [-1] * n
    return names, np.array(index, dtype=np.int64)


def checked_lengths(name: str, given: ArrayLike | None, n: int, *, signed: bool) -> Floats | None:
    """Lengths of n rows, or heights over a plane, nan where not measured, shape (n,); None if None."""
    if given is None:
        return None
    lengths = as_floats(name, given, f"({n})", missing=True)
    require(signed | ~(lengths < 0.0), name, lengths, "a number not below 0")
    return lengths


def checked_image(pixel: ArrayLike | None, corner: ArrayLike | None, n: int) -> Floats | None:
    """u, v, [px], and the point on the board, x, y, [m], shape (n, 4); None if neither was given."""
    if pixel is None and corner is None:
        return None
    for name, other, given in (("pixel", "corner", pixel), ("corner", "pixel", corner)):
        if given is None:
            raise InputError(name, f"none beside {other}", "both: what was seen, and where it is on the board")
    return np.hstack([as_floats("pixel", pixel, f"({n}, 2)"), as_floats("corner", corner, f"({n}, 2)")])


def checked_covariance(given: ArrayLike | None, n: int) -> Floats | None:
    """Covariances of n poses, shape (n, 6, 6); None if None."""
    if given is None:
        return None
    good, C = covariances(as_floats("covariance", given, f"({n}, 6, 6)"))
    require(good, "covariance", np.einsum("nii->ni", C), "symmetric matrices with eigenvalues above 0")
    return C


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
        sigma = checked_sigma(f"pairs: sigma_{key}", given.get(f"sigma_{key}"), (n,))
        columns[f"sigma_{key}"] = np.full(n, np.nan) if sigma is None else sigma
    columns["test"] = checked_mask("pairs: test", given.get("test"), n)
    angle, distance = columns["angle"], columns["distance"]
    require(~of_groups | np.isnan(angle), "pairs: angle", angle, "nan: two points have a distance, but no angle")
    require(~of_groups | (distance > 0.0), "pairs: distance", distance, "a number above 0 between two groups")
    return columns, of_groups


def _ends(
    given: Mapping[str, ArrayLike], ids: NDArray[np.str_], group_names: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], Booleans]:
    """Rows of configurations or indices of groups that `a` and `b` name, and whether they are groups."""
    named = {key: _names_of_ends(f"pairs: {key}", given[key]) for key in ("a", "b")}
    for key, names in named.items():
        if names.ndim != 1 or len(names) != len(named["a"]):
            raise InputError(f"pairs: {key}", f"shape {names.shape}", "(n_pairs,), as many of a as of b")
    known = np.concatenate([ids, np.array(group_names, dtype=np.str_)])
    twice = np.intersect1d(ids, known[len(ids) :]) if group_names else ids[:0]
    what = "an id or a group" if group_names else "an id (the row number where no ids were given)"
    by_row = not any(word.isdigit() for word in known.tolist())
    index = {}
    for key, names in named.items():
        if by_row and names.dtype.kind in "iu":
            index[key] = np.where((names >= 0) & (names < len(ids)), names, -1).astype(np.int64)
            require(index[key] >= 0, f"pairs: {key}", names, f"{what}, or a row number, 0 to {len(ids) - 1}")
            continue
        if len(twice):
            only = ~np.isin(names.astype(np.str_), twice)
            require(only, f"pairs: {key}", names, "different names of ids and groups")
        index[key] = _index_of(names, known)
        numbers = "row numbers are understood where no id or group is a number" * (names.dtype.kind in "iu")
        require(index[key] >= 0, f"pairs: {key}", names, what, numbers)
    a, b = index.values()
    require((a < len(ids)) == (b < len(ids)), "pairs: b", named["b"], "two configurations or two groups")
    require(a != b, "pairs: b", named["b"], "another than a")
    of_groups = a >= len(ids)
    return {key: np.where(of_groups, i - len(ids), i) for key, i in index.items()}, of_groups


def _names_of_ends(name: str, given: ArrayLike) -> NDArray[Any]:
    """Names, or whole numbers as they are, for these are looked up faster."""
    array = as_array(name, given, "iuUO", "ids")
    if array.ndim != 1 or array.dtype.kind in "iu":
        return array
    if array.dtype.kind == "U" and not {"", *NOTHING}.intersection(map(str.lower, set(array.tolist()))):
        return array
    return np.array(as_names(name, given), dtype=np.str_)


def _index_of(names: NDArray[Any], known: NDArray[np.str_]) -> Integers:
    """Where each of the names stands among those that are known, -1 where nowhere."""
    if names.dtype.kind in "iu" and np.array_equal(known, np.arange(len(known)).astype(known.dtype)):
        return np.where((names >= 0) & (names < len(known)), names, -1).astype(np.int64)
    place = {name: i for i, name in enumerate(known.tolist())}
    return np.array([place.get(name, -1) for name in names.astype(np.str_).tolist()], dtype=np.int64)


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
