"""Measurements from arrays in Python: the columns of a table, without a file."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fg_calib import inputs, measurements
from fg_calib.inputs import InputError, checked, shown
from fg_calib.io.tables import OF_CONFIGURATIONS, OF_PAIRS, ROUNDED, Table, measurements_of
from fg_calib.io.yaml import Units

COLUMNS: Mapping[str, str] = {
    **{"ids": "id", "test": "split", "position": "x", "quaternion": "qx", "roll_pitch_yaw": "roll"},
    **{"pixel": "u", "corner": "corner_x", "covariance": "cov_11"},
    **{"sigma_position": "sigma_x", "sigma_orientation": "sigma_rx", "sigma_pixel": "sigma_u"},
}
"""First column of each array that holds several, or whose name is not that of its column."""

_SINGLE = [name for name, of in OF_CONFIGURATIONS.items() if len(of.names) == 1 and name not in ("id", "split")]

NAMES = (*COLUMNS, "rotation", *_SINGLE)
"""Arrays that `read_arrays` takes: those of `COLUMNS`, rotation matrices, and every single column."""


@checked
def read_arrays(
    readings: ArrayLike,
    *,
    pairs: Mapping[str, ArrayLike] | Any | None = None,
    sigma_joint: Any = 0.0,
    source: str = "measurements",
    **arrays: ArrayLike | None,
) -> measurements.Measurements:
    """Measurements from arrays in [m] and [rad], which are copied; n is the number of configurations.

    Args:
        readings: Joint readings q, shape (n, n_joints), [rad] (prismatic: [m]).
        pairs: Between configurations or contact points, arrays of shape (n_pairs,), or a frame of polars or pandas:
            `a` and `b` (ids or groups; row numbers where none of these is a number); `distance`, `angle` (nan: not
            measured), `sigma_...` each, `test`.
        sigma_joint: 1 sigma of the readings: one for all, or one a joint.
        source: Name of the measurements, for messages.
        arrays: Measured values, their 1 sigma (one for all, an axis each, a row each, or all), and what it is of.

    These are the columns of a table, under their names, and

    - `ids`: name of each configuration; its row number without.
    - `test`: True for rows that are predicted but never fitted.
    - `position`: world_p_tool, shape (n, 3), [m]; with `board` that of the board in the camera's frame.
    - `rotation`: world_R_tool, shape (n, 3, 3); or `quaternion`: the same as x y z w, shape (n, 4); or
      `roll_pitch_yaw`: the same as Rz(yaw) Ry(pitch) Rx(roll), shape (n, 3), [rad].
    - `distance`: to the row's `anchor` or from its `plane`, nan where not measured, [m].
    - `pixel`: where a point of the row's board was seen, u and v, [px]; `corner`: where that point is on the board, x
      and y, [m].
    - `covariance`: of camera_T_board, rotation first, about and along the camera's axes, shape (n, 6, 6).
    - `sigma_position` along the world's axes, `sigma_orientation` about the tool's, `sigma_point` on each axis.
    - `group`: name of the point that a configuration touched; `target`, `station`, `anchor`, `plane`, `board`: what a
      row is of; None where it is of none.

    Raises:
        InputError: An array cannot be used; the message names it and its row.
    """
    q = inputs.as_floats("readings", readings, "(n, n_joints)")
    inputs.expect(q.size, "readings", f"shape {q.shape}", "(n, n_joints) with at least one row and joint")
    given = {name: values for name, values in arrays.items() if values is not None}
    inputs.check_names("Measurements.from_arrays", given, NAMES, "argument")
    rotation = given.pop("rotation", None)
    if rotation is not None and (other := given.keys() & {"quaternion", "roll_pitch_yaw"}):
        raise InputError(f"rotation and {min(other)}", "both were given", "one of the two")
    each = {name: (OF_CONFIGURATIONS[COLUMNS.get(name, name)], values) for name, values in given.items()}
    table = _table_of(source, each, len(q), **{f"q{i + 1}": joint for i, joint in enumerate(q.T)})
    between = None if pairs is None else _pairs_of(pairs)
    found = measurements_of(table, q, between, Units(), measurements.Noise(joint=sigma_joint))
    if rotation is None:
        return found
    return found.with_values({"rotation": inputs.as_rotations("rotation", rotation, len(q))})


def _columns_of(place: str, column: measurements.Column, given: Any, n: int) -> dict[str, Any]:
    """Columns of n rows that an array holds.

    Raises:
        InputError: The array has another shape, or holds something else.
    """
    first, shape = column.names[0], (n,) if len(column.names) == 1 else (n, len(column.names))
    if first == "cov_11":
        C = inputs.as_floats(place, given, f"({n}, 6, 6)")
        off = np.abs(C - np.swapaxes(C, 1, 2)).max(axis=(1, 2))
        inputs.require(off <= ROUNDED * np.abs(C).max(axis=(1, 2)), place, C, "symmetric matrices")
        values: Any = C[:, *np.triu_indices(6)]
    elif first == "split":
        values = np.where(inputs.as_mask(place, given, n), "test", "train")
    elif first.startswith("sigma_"):
        values = np.broadcast_to(inputs.as_sigmas(place, given, shape), shape)
    elif column.unit or column.generic or len(shape) == 2:
        expected = f"({', '.join(map(str, shape))})"
        values = inputs.as_floats(place, given, expected, missing=column.generic or first in ("distance", "angle"))
    elif (found := inputs.shape_of(place, given, "names")) != shape:
        raise InputError(place, f"shape {found}", f"({n},), one a row")
    else:  # whole numbers, of a million pairs, stay as they are
        whole = isinstance(given, np.ndarray) and given.dtype.kind in "iu"
        return {first: given if whole else inputs.as_names(place, given, missing=True)}
    return dict(zip(column.names, values.reshape(n, -1).T, strict=True))


def _pairs_of(given: Any) -> Table:
    """A table of pairs.

    Raises:
        InputError: An array is no column of one, has another number of rows than the longest, or holds something else.
    """
    frame = given if isinstance(given, Mapping) else inputs.as_frame("pairs", given)
    if frame is None:
        expected = "a mapping of arrays by the names a, b, distance, angle, or a frame"
        raise InputError("pairs", f"found {shown(given)}", expected)
    arrays = {key: frame[key] for key in (frame if isinstance(frame, Mapping) else frame.columns)}
    known = {"test" if name == "split" else name: of for name, of in OF_PAIRS.items()}
    known |= {key: measurements.Column((key,), "", "") for key in ("a", "b")}
    inputs.check_names("pairs", arrays, list(known), "key")
    arrays |= {key: inputs.as_array(f"pairs: {key}", arrays[key], "iuUO", "ids") for key in ("a", "b") if key in arrays}
    n = max((np.size(values) for values in arrays.values()), default=0)
    return _table_of("pairs", {f"pairs: {key}": (known[key], values) for key, values in arrays.items()}, n)


def _table_of(name: str, arrays: Mapping[str, tuple[measurements.Column, Any]], n: int, **more: Any) -> Table:
    """A table of arrays of n rows, each with the columns that it holds, and of more columns."""
    each = [_columns_of(place, column, values, n) for place, (column, values) in arrays.items()]
    return Table.read({column: values for of in (more, *each) for column, values in of.items()}, name)
