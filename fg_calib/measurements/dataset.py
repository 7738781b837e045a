"""What was measured: configurations, poses, pairs, and their noise; checks of arrays; how pairs are formed from poses.

Arrays are in [m] and [rad]. The rules for them are those of the tables (see `io.tables`); messages name the array and
its row.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fg_calib.inputs import (
    LEAST_SIZE,
    NORM_TOLERANCE,
    ORDINARY,
    Booleans,
    Floats,
    FrozenArrays,
    InputError,
    Integers,
    Pairing,
    as_array,
    as_columns,
    as_figures,
    as_floats,
    as_names,
    as_rotations,
    brief,
    check_names,
    check_number,
    check_sizes,
    checked,
    listed,
    require,
    shape_of,
)
from fg_calib.robot import Robot, rotation_angle

_log = logging.getLogger(__name__)


MOST_PAIRS = 10_000_000
"""The largest number of pairs that are formed from poses."""

ANGLE_SLACK = 1e-5
"""How far a rotation angle may exceed pi, [rad]: half a turn, rounded to six figures."""

ROUNDED = 1e-9
"""Share of a covariance that may be rounding."""

LIMIT_SLACK = 1e-3
"""How far a reading may be beyond its joint's limits, [rad] or [m]: encoders say so of a joint that stands at one."""

FAR = 0.5
"""Part of a joint's range beyond its limits from which a smaller unit is likelier than limits that are too narrow."""

PAIR_KEYS = ("a", "b", "distance", "angle", "sigma_distance", "sigma_angle", "test")

ROTATIONS = ("rotation", "quaternion", "roll_pitch_yaw")

ARRAYS: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "position": ("position", (3,)),
    "distance": ("length", ()),
    "pixel": ("pixel", (2,)),
    "corner": ("corner", (2,)),
    "covariance": ("covariance", (6, 6)),
    "sigma_position": ("sigma_position", (3,)),
    "sigma_orientation": ("sigma_orientation", (3,)),
    "sigma_distance": ("sigma_length", ()),
    "sigma_point": ("sigma_point", ()),
    "sigma_pixel": ("sigma_pixel", (2,)),
}
"""Arrays that `Measurements.from_arrays` takes besides `ROTATIONS`, each with its field and the shape of a row.

- `position`: world_p_tool, [m].
- `rotation`: world_R_tool, shape (n, 3, 3); or `quaternion`: the same as x y z w, shape (n, 4); or `roll_pitch_yaw`:
  the same as Rz(yaw) Ry(pitch) Rx(roll), shape (n, 3), [rad].
- `distance`: to the row's anchor or from its plane, nan where not measured, [m].
- `pixel`: where a point of the row's board was seen, u and v, [px]; `corner`: where that point is on the board, x and
  y, [m].
- `covariance`: of camera_T_board, rotation first, about and along the camera's axes.
- `sigma_position` along the world's axes, `sigma_orientation` about the tool's, `sigma_point` on each axis.
"""

LABELS = ("target", "station", "anchor", "plane", "board")
"""Names of what each row is of, shape (n,), that `Measurements.from_arrays` takes.

- `target`: whose position was measured, None for the tool point itself.
- `station`: from which it was measured, each with a frame of its own.
- `anchor`: that `distance` is to.
- `plane`: that the tool point is on, or `distance` from.
- `board`: that a camera saw; `position` and orientation are then camera_T_board.
"""


@dataclass(frozen=True)
class Noise:
    """Measurement noise, 1 sigma; None where it is not specified.

    Attributes:
        position: Per axis, [m].
        orientation: Per axis of a rotation vector, [rad].
        joint: Of the joint readings: one figure for all joints or one a joint, [rad] (prismatic: [m]).
        distance: Of a directly measured distance, also to an anchor or a plane, [m].
        angle: Of a directly measured rotation angle, [rad].
        point: Of a touched point, per axis, [m].
        pixel: Of a point's image, per axis, [px].
        more: Of columns that one instrument alone has, by name.
    """

    position: float | None = None
    orientation: float | None = None
    joint: float | tuple[float, ...] = 0.0
    distance: float | None = None
    angle: float | None = None
    point: float | None = None
    pixel: float | None = None
    more: Mapping[str, float] = field(default_factory=dict)

    def get(self, kind: str) -> Any:
        """Sigma of a kind, of `more` too; None where it is not specified."""
        return self.more.get(kind) if kind not in _NOISE else getattr(self, kind)

    def updated(self, **values: Any) -> Noise:
        """Other sigmas of some kinds, of `more` too; None leaves one of `more` as it is."""
        named = {kind: value for kind, value in values.items() if kind in _NOISE}
        others = {kind: value for kind, value in values.items() if kind not in _NOISE and value is not None}
        return replace(self, **named, more={**self.more, **others})

    def __post_init__(self) -> None:
        if isinstance(self.joint, list | np.ndarray):
            object.__setattr__(self, "joint", tuple(np.atleast_1d(np.array(self.joint, dtype=object)).tolist()))
        sigmas = [(name, getattr(self, name)) for name in _NOISE if name != "joint"]
        sigmas += [("joint", sigma) for sigma in (self.joint if isinstance(self.joint, tuple) else (self.joint,))]
        for name, sigma in (*sigmas, *self.more.items()):
            if sigma is not None:
                check_number(f"noise: {name}", sigma)


_NOISE = tuple(f.name for f in fields(Noise) if f.name != "more")


@dataclass(frozen=True)
class Pairs(FrozenArrays):
    """Pairs of configurations measured against each other; nan where not measured.

    Attributes:
        a: Row of the first configuration, shape (n_pairs,).
        b: Row of the second configuration, shape (n_pairs,).
        distance: How far the tool moved from a to b, shape (n_pairs,), [m].
        angle: How far it turned, in [0, pi], shape (n_pairs,), [rad].
        sigma_distance: Shape (n_pairs,), [m].
        sigma_angle: Shape (n_pairs,), [rad].
        test: True for pairs that are predicted but never fitted, shape (n_pairs,).
        source: File name, for messages.
    """

    a: Integers
    b: Integers
    distance: Floats
    angle: Floats
    sigma_distance: Floats
    sigma_angle: Floats
    test: Booleans
    source: str = "pairs"

    _left_open = ("a", "b")

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return len(self.a)

    def select(self, rows: Booleans | Integers) -> Pairs:
        """The pairs at `rows` only."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "source"})


@dataclass(frozen=True)
class Labels(FrozenArrays):
    """What each row is of, by name: the target that was seen, the station it was seen from.

    Attributes:
        names: The different names.
        index: Which of them each row has, -1 for none, shape (n_configurations,).
    """

    names: tuple[str, ...]
    index: Integers

    def of(self, rows: Integers) -> Labels:
        """Those of some rows, the same names."""
        return replace(self, index=self.index[rows])


@dataclass(frozen=True)
class Groups(Labels):
    """Configurations in which the tool point touched the same physical point, whose position is unknown.

    Attributes:
        pairs: Distances measured between the points of two groups (a and b are groups, angles nan).
    """

    pairs: Pairs


@dataclass(frozen=True)
class Measurements(FrozenArrays):
    """Configurations, and what was measured at them or between them.

    Attributes:
        readings: Joint readings q, shape (n_configurations, n_joints), [rad] (prismatic: [m]).
        ids: Name of each configuration, shape (n_configurations,).
        test: True for rows that are predicted but never fitted, shape (n_configurations,).
        position: world_p_tool, shape (n_configurations, 3), [m]; None where not measured.
        rotation: world_R_tool, shape (n_configurations, 3, 3); None where not measured.
        sigma_position: Along the world's axes, shape (n_configurations, 3), [m]; None where unknown. It may be
            stated without a measurement: what one would be like.
        sigma_orientation: The same of the rotation vector about the tool's axes, shape (n_configurations, 3), [rad].
        sigma_joint: Of the readings, shape (n_joints,), [rad] (prismatic: [m]).
        pairs: Directly measured pairs; None if pairs are to be formed from the poses.
        source: File name, for messages.
        groups: Which configurations touched the same point; None if none did.
        sigma_point: Of a touch, per axis, shape (n_configurations,), [m]; nan where it is not specified.
        named: Whether the names were given, so that another table may have the same configurations.
        roll_pitch_yaw: What `rotation` was read from, shape (n_configurations, 3), [rad]; None for quaternions.
        labels: What the rows are of, by `target`, `station`, `anchor`, `plane` or `board`, where that was said.
        length: Distance to the row's anchor, or from its plane, shape (n_configurations,), [m]; None where not
            measured.
        sigma_length: Shape (n_configurations,), [m]; None where it is not specified.
        image: Where a point of the row's board was seen, u and v, [px], and where it is on the board, x and y, [m],
            shape (n_configurations, 4); None where nothing was.
        sigma_pixel: Along u and v, shape (n_configurations, 2), [px]; None where it is not specified.
        covariance: Of a board's measured pose, about and along the camera's axes, shape (n_configurations, 6, 6), [rad]
            and [m]; None where sigmas say it.
        part: Which rows of a table these are, shape (n_configurations,); None where they are all.
        columns: What instruments with columns of their own measured, by column, shape (n_configurations,) each.
        sigmas: 1 sigma of these, by the same names.
    """

    readings: Floats
    ids: NDArray[np.str_]
    test: Booleans
    position: Floats | None = None
    rotation: Floats | None = None
    sigma_position: Floats | None = None
    sigma_orientation: Floats | None = None
    sigma_joint: Floats = field(default_factory=lambda: np.zeros(0))
    pairs: Pairs | None = None
    source: str = "measurements"
    groups: Groups | None = None
    sigma_point: Floats | None = None
    roll_pitch_yaw: Floats | None = None
    named: bool = False
    labels: Mapping[str, Labels] = field(default_factory=dict)
    length: Floats | None = None
    sigma_length: Floats | None = None
    image: Floats | None = None
    sigma_pixel: Floats | None = None
    covariance: Floats | None = None
    part: Integers | None = None
    columns: Mapping[str, Floats] = field(default_factory=dict)
    sigmas: Mapping[str, Floats] = field(default_factory=dict)

    from_frame: ClassVar[Callable[..., Measurements]]
    """`io.read_measurements`, attached by the package: this folder knows nothing of tables."""

    @classmethod
    @checked
    def from_arrays(
        cls,
        readings: ArrayLike,
        *,
        ids: ArrayLike | None = None,
        test: ArrayLike | None = None,
        group: ArrayLike | None = None,
        points: Sequence[str] = (),
        pairs: Mapping[str, ArrayLike] | Any | None = None,
        sigma_joint: ArrayLike = 0.0,
        source: str = "measurements",
        **columns: ArrayLike | None,
    ) -> Measurements:
        """Measurements from arrays in [m] and [rad], which are copied; n is the number of configurations.

        Args:
            readings: Joint readings q, shape (n, n_joints), [rad] (prismatic: [m]).
            ids: Name of each configuration, shape (n,); its row number if None.
            test: True for rows that are predicted but never fitted, shape (n,).
            group: Name of the point that a configuration touched, None where it touched none, shape (n,).
            points: Names of points that other tables touch: pairs may say how far apart they are.
            pairs: Between configurations or touched points, arrays of shape (n_pairs,), or a frame of polars or pandas:
                `a` and `b` (ids or groups; row numbers where none of these is a number); `distance`, `angle` (nan: not
                measured), `sigma_...` each, `test`.
            sigma_joint: 1 sigma of the readings: one for all, or one a joint.
            source: Name of the measurements, for messages.
            columns: What was measured, its 1 sigma (one for all, an axis each, a row each, or all), and what it is of:
                see `ARRAYS`, `ROTATIONS` and `LABELS`.

        Raises:
            InputError: An array cannot be used; the message names it and its row.
        """
        q = as_floats("readings", readings, "(n, n_joints)")
        if not q.size:
            raise InputError("readings", f"shape {q.shape}", "(n, n_joints) with at least one row and joint")
        n, given = len(q), {name: values for name, values in columns.items() if values is not None}
        check_names("Measurements.from_arrays", given, (*ROTATIONS, *ARRAYS, *LABELS), "argument")
        labels = {name: Labels(*checked_labels(name, given[name], n)) for name in LABELS if name in given}
        repeated = "pixel" in given or bool(labels.keys() - {"station"})
        known, rows = checked_ids(ids, n, repeated=repeated), checked_mask("test", test, n)
        names, index = checked_labels("group", group, n)
        every, between, of_groups = (*dict.fromkeys([*names, *listed("points", points)]),), None, no_pairs(source)
        if pairs is not None:
            between, which = pairs_from_arrays(pairs, known, rows, Labels(every, index))
            between, of_groups = between.select(~which), between.select(which)
            names = every if of_groups.n_pairs else names
        return cls(
            q,
            known,
            rows,
            sigma_joint=checked_joint_sigma(sigma_joint, q.shape[1]),
            pairs=between,
            source=source,
            groups=Groups(names, index, of_groups) if names else None,
            named=ids is not None,
            labels=labels,
            **checked_columns(given, n),
        )

    def __repr__(self) -> str:
        """What was measured, without its sigmas."""
        names = [f.name for f in fields(self) if not f.name.startswith(("sigma", "ids", "test", "named", "part"))]
        return brief(self, (name for name in names if getattr(self, name) is not None))

    @property
    def n_configurations(self) -> int:
        """Number of configurations, train and test."""
        return len(self.readings)

    def select(self, rows: Integers) -> Measurements:
        """Some rows, with what was measured at them; nothing that was measured between configurations."""
        rows_of: dict[str, Any] = {
            name: v[rows] for name, v in vars(self).items() if isinstance(v, np.ndarray) and name != "sigma_joint"
        }
        named: dict[str, Any] = {
            name: {key: v[rows] for key, v in getattr(self, name).items()} for name in ("columns", "sigmas")
        }
        labels = {name: of.of(rows) for name, of in self.labels.items()}
        return replace(self, **rows_of, **named, labels=labels, pairs=None, groups=None)

    def value(self, name: str) -> Floats | None:
        """What was measured, by a field or a column that one instrument alone has; None where it was not."""
        found: Floats | None = self.columns.get(name, getattr(self, name, None))
        return found

    def sigma(self, noise: str) -> Floats | None:
        """1 sigma by kind of noise; None where it is not specified."""
        name = "sigma_length" if noise == "distance" else f"sigma_{noise}"
        found: Floats | None = self.sigmas.get(noise, getattr(self, name, None))
        return found

    def with_values(self, values: Mapping[str, Floats]) -> Measurements:
        """The same with other measured values, by the names that `value` takes."""
        own: dict[str, Any] = {name: v for name, v in values.items() if hasattr(self, name)}
        return replace(self, **own, columns={**self.columns, **{k: v for k, v in values.items() if k not in own}})


def checked_columns(given: Mapping[str, Any], n: int) -> dict[str, Any]:
    """Fields of `Measurements` from arrays of n rows by the names of `ARRAYS` and `ROTATIONS`."""
    ways, found = [name for name in ROTATIONS if name in given], dict[str, Any]()
    if len(ways) > 1:
        raise InputError(f"{ways[0]} and {ways[1]}", "both were given", "one of the two")
    for way in ways:
        found |= _checked_rotation(way, given[way], n)
    for name, (kept, axes) in ((name, ARRAYS[name]) for name in ARRAYS if name in given):
        shape = (n, *axes)
        if name.startswith("sigma_"):
            found[kept] = np.ascontiguousarray(np.broadcast_to(checked_sigma(name, given[name], shape), shape))
        else:
            expected = f"({', '.join(map(str, shape))})"
            found[kept] = as_floats(name, given[name], expected, missing=name == "distance")
    if "length" in found and "plane" not in given:
        require(~(found["length"] < 0.0), "distance", found["length"], "a number not below 0")
    if "covariance" in found:
        good, found["covariance"] = covariances(found["covariance"])
        require(good, "covariance", given["covariance"], "symmetric matrices with eigenvalues above 0")
    for name, other in (("pixel", "corner"), ("corner", "pixel")):
        if other in found and name not in found:
            raise InputError(name, f"none with {other}", "both: what was seen, and where it is on the board")
    if "pixel" in found:
        found["image"] = np.hstack([found.pop("pixel"), found.pop("corner")])
    return found


def _checked_rotation(way: str, given: ArrayLike, n: int) -> dict[str, Floats]:
    """Rotation matrices, shape (n, 3, 3), and roll, pitch, yaw where those were given, shape (n, 3)."""
    if way == "rotation":
        return {way: as_rotations(way, given, n)}
    if way == "roll_pitch_yaw":
        angles = as_floats(way, given, f"({n}, 3)")
        return {"rotation": Rotation.from_euler("xyz", angles).as_matrix(), way: angles}
    q = as_floats(way, given, f"({n}, 4)")
    require(np.abs(np.linalg.norm(q, axis=1) - 1.0) <= NORM_TOLERANCE, way, q, "x y z w of length 1")
    return {"rotation": Rotation.from_quat(q).as_matrix()}


def checked_joint_sigma(given: ArrayLike, n_joints: int) -> Floats:
    """Sigma of the readings of each joint, shape (n_joints,), from one for all or one a joint."""
    one = shape_of("sigma_joint", given, f"one value, or {n_joints}") == ()
    sigma = as_floats("sigma_joint", given, "()" if one else f"({n_joints})")
    require(sigma >= 0.0, "sigma_joint", sigma, "a number not below 0")
    return np.ascontiguousarray(np.broadcast_to(sigma, n_joints))


def checked_indices(name: str, given: Any, n: int, most: int | None) -> Integers:
    """Whole numbers from 0, a row each of n, up to `most` where there is such."""
    values = as_array(name, given, "iu", f"whole numbers, a row for each of {n}").copy()
    if values.shape[:1] != (n,):
        raise InputError(name, f"shape {values.shape}", f"a row for each of {n}")
    good = (values >= 0) & ((values <= most) if most is not None else True)
    require(good, name, values, "0 and above" if most is None else f"0 to {most}")
    return values


def checked_sigma(name: str, given: Any, shape: tuple[int, ...]) -> Floats:
    """Sigmas that broadcast to (n,) or (n, k), from such, or one a row."""
    sigma = as_figures(name, given, "finite numbers")
    check_sizes(name, sigma)
    require(sigma > 0.0, name, sigma, "a number above 0")
    require(sigma >= LEAST_SIZE, name, sigma, ORDINARY)
    if len(shape) == 2 and sigma.shape == shape[:1] != (1,):
        if (n := shape[0]) == shape[1]:
            raise InputError(name, f"shape ({n},) of {n} rows", f"({n}, 1) for one a row, (1, {n}) for one an axis")
        sigma = sigma[:, None]
    try:
        np.broadcast_to(sigma, shape)
    except ValueError:
        raise InputError(name, f"shape {np.shape(given)}", f"one that broadcasts to {shape}, or one a row") from None
    return sigma


def checked_names(name: str, given: ArrayLike, n: int, *, missing: bool) -> list[str | None]:
    """Names of n rows, of which some may be missing: None."""
    if (found := shape_of(name, given, "names")) != (n,):
        expected = "a name, or None where there is none" if missing else "one a configuration"
        raise InputError(name, f"shape {found}", f"({n},): {expected}")
    return as_names(name, given, missing=missing)


def checked_ids(given: ArrayLike | None, n: int, *, repeated: bool) -> NDArray[np.str_]:
    """Names of n configurations, different ones unless `repeated`: their row numbers if None."""
    if given is None:
        return np.arange(n).astype(np.str_)
    ids = np.array(checked_names("ids", given, n, missing=False), dtype=np.str_)
    first = np.unique(ids, return_index=True)[1]
    require(repeated | np.isin(np.arange(n), first), "ids", ids, "different ids")
    return ids


def checked_mask(name: str, given: ArrayLike | None, n: int) -> Booleans:
    """A mask of n rows: nowhere true if None."""
    mask = as_array(
        name, np.zeros(n, dtype=np.bool_) if given is None else given, "b", f"True or False for each of {n} rows"
    )
    if mask.shape != (n,):
        raise InputError(name, f"shape {mask.shape}", f"({n},), one a row")
    return mask.copy()


def checked_labels(what: str, given: ArrayLike | None, n: int) -> tuple[tuple[str, ...], Integers]:
    """Different names in the order met, and which of them each row has, -1 for none, shape (n,)."""
    named = [None] * n if given is None else checked_names(what, given, n, missing=True)
    names = tuple(dict.fromkeys(name for name in named if name is not None))
    place = {name: i for i, name in enumerate(names)} | {None: -1}
    return names, np.array([place[name] for name in named], dtype=np.int64)


def covariances(C: Floats) -> tuple[Booleans, Floats]:
    """Which matrices are covariances, shape (n,), and these with rounding taken off, shape (n, d, d)."""
    size = np.sqrt(np.maximum(np.einsum("nii->ni", C), LEAST_SIZE**2))
    scaled = C / (size[:, :, None] * size[:, None, :])
    alike = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2), initial=0.0) < ROUNDED
    C = 0.5 * (C + np.swapaxes(C, 1, 2))
    return alike & (np.linalg.eigvalsh(scaled)[:, 0] > ROUNDED), C


def pairs_from_arrays(given: Any, ids: NDArray[np.str_], test: Booleans, groups: Labels) -> tuple[Pairs, Booleans]:
    """Pairs, and which of them are of groups; those of a test row, or of a group of test rows alone, are test pairs.

    Args:
        given: Columns by the names of `PAIR_KEYS`; `a` and `b` hold ids, row numbers, or groups. Whole numbers are row
            numbers where no id and no group is a number.
        ids: Names of the configurations.
        test: Which configurations are test rows.
        groups: The contact points.

    Raises:
        InputError: A column is missing or holds values that cannot be used.
    """
    given = as_columns("pairs", given, "a mapping of arrays by the names a, b, distance, angle, or a frame")
    check_names("pairs", given, PAIR_KEYS, "key")
    lacking = [key for key in ("a", "b") if key not in given]
    if lacking or not given.keys() & {"distance", "angle"}:
        found = f"no {lacking[0]}" if lacking else "neither distance nor angle"
        raise InputError("pairs", found, "a and b, the two configurations of a pair, and distance or angle")
    columns, of_groups = _ends(given, ids, groups.names)
    n = len(of_groups)
    for key, most, words in (("distance", np.inf, "a number not below 0"), ("angle", np.pi, "0 to pi, in rad")):
        figures = as_floats(f"pairs: {key}", given.get(key, np.full(n, np.nan)), f"({n})", missing=True)
        require(~((figures < 0.0) | (figures > most + ANGLE_SLACK)), f"pairs: {key}", figures, words)
        sigma, columns[key] = given.get(f"sigma_{key}"), np.minimum(figures, most)
        columns[f"sigma_{key}"] = np.full(n, np.nan)
        if sigma is not None:
            columns[f"sigma_{key}"][:] = checked_sigma(f"pairs: sigma_{key}", sigma, (n,))
    columns["test"] = checked_mask("pairs: test", given.get("test"), n)
    angle, distance = columns["angle"], columns["distance"]
    require(~of_groups | np.isnan(angle), "pairs: angle", angle, "nan: two points have a distance, but no angle")
    require(~of_groups | (distance > 0.0), "pairs: distance", distance, "a number above 0 between two groups")
    for flags, chosen in ((test, ~of_groups), (only_of(test, groups.index, len(groups.names)), of_groups)):
        columns["test"][chosen] |= flags[columns["a"][chosen]] | flags[columns["b"][chosen]]
    return Pairs(**columns), of_groups  # type: ignore[arg-type]


def _ends(
    given: Mapping[str, ArrayLike], ids: NDArray[np.str_], groups: Sequence[str]
) -> tuple[dict[str, NDArray[Any]], Booleans]:
    """Rows of configurations or indices of groups that `a` and `b` name, and whether they are groups."""
    n = len(ids)
    by_row = bool(np.array_equal(ids, np.arange(n).astype(np.str_)))  # no ids were given
    place = {name: i for i, name in enumerate([*ids.tolist(), *groups])}
    both = set(groups).intersection(ids.tolist())
    place |= dict.fromkeys(both, -1)
    expected = "an id or a group" if groups else "an id (the row number where no ids were given)"
    numbers = not any(word.isdigit() for word in (groups if by_row else place))
    found, names = dict[str, Integers](), dict[str, NDArray[Any]]()
    for key in ("a", "b"):
        names[key] = as_array(f"pairs: {key}", given[key], "iuUO", "ids")
        if names[key].shape != (np.size(given["a"]),):
            raise InputError(f"pairs: {key}", f"shape {names[key].shape}", "(n_pairs,), as many of a as of b")
        if numbers and names[key].dtype.kind in "iu":
            found[key] = np.where(names[key] < n, names[key], -1).astype(np.int64)
        else:
            words: Any = names[key].tolist() if names[key].dtype.kind != "O" else as_names(f"pairs: {key}", given[key])
            found[key] = np.array([place.get(str(word), -1) for word in words], dtype=np.int64)
        require(found[key] >= 0, f"pairs: {key}", names[key], expected, "names of both stand for neither" * bool(both))
    a, b = found["a"], found["b"]
    require((a < n) == (b < n), "pairs: b", names["b"], "two configurations or two groups")
    require(a != b, "pairs: b", names["b"], "another than a")
    return {key: np.where(i < n, i, i - n) for key, i in found.items()}, a >= n


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
        hint = limit_hint(readings[:, j], robot, j, joint.unit)
        raise InputError(f"{name}: row {row}", found, hint=hint)
    for joint, limits, q in zip(robot.joints, robot.limits, readings.T, strict=True):
        if not joint.prismatic and np.isinf(limits).all() and np.mean(np.abs(q) > 4 * np.pi) > 0.5:
            _log.warning("%s: most readings of %s are more than two turns; are they in deg?", name, joint.name)


def outside_limits(readings: Floats, robot: Robot) -> Booleans:
    """Which readings, shape (n, n_joints), [rad] (prismatic: [m]), are beyond their joints' limits."""
    lower, upper = robot.limits.T
    outside: Booleans = (readings < lower - LIMIT_SLACK) | (readings > upper + LIMIT_SLACK)
    return outside


def limit_hint(readings: Floats, robot: Robot, joint: int, unit: str) -> str:
    """What to do about a joint that has a reading outside its limits.

    A smaller unit is suggested where a reading is far outside and all are within the limits in that unit.

    Args:
        readings: Of the joint, as understood so far, shape (n,), [rad] (prismatic: [m]).
        robot: The robot.
        joint: 0-based number of the joint.
        unit: Unit that they are taken to be in.
    """
    smaller, size = {"rad": ("deg", np.pi / 180.0), "m": ("mm", 1e-3)}.get(unit, ("", 1.0))
    low, high = robot.limits[joint]
    far = max(low - readings.min(), readings.max() - high) > FAR * (high - low)
    if far and smaller and low <= size * readings.min() and size * readings.max() <= high:
        return f"is it in {smaller}?"
    return "widen the joint's limits if the reading is right"


def only_of(chosen: Booleans, group: Integers, n_groups: int) -> Booleans:
    """Which groups have rows, all of them chosen, shape (n_groups,)."""
    counts = [np.bincount(group[rows & (group >= 0)], minlength=n_groups) for rows in (chosen, chosen | True)]
    only: Booleans = (counts[1] > 0) & (counts[0] == counts[1])
    return only


def no_pairs(source: str) -> Pairs:
    """A table of pairs without any."""
    rows, figures = np.empty(0, dtype=np.int64), np.empty(0)
    return Pairs(rows, rows, figures, figures, figures, figures, np.empty(0, dtype=np.bool_), source)


def form_pairs(measurements: Measurements, pairing: Pairing) -> Pairs:
    """Pairs formed from measured poses, within the train rows and, by the same rule, within the test rows.

    A distance between two measured points has variance u^T (S_a + S_b) u along their direction u, a rotation
    angle k^T (S_a + S_b) k about its axis k, which has the same coordinates in both tool frames. The pairs are
    treated as independent although pairs that share a configuration share its error.

    Raises:
        InputError: Neither positions nor orientations were measured.
    """
    if measurements.position is None and measurements.rotation is None:
        raise InputError(measurements.source, "neither positions nor orientations", "measured poses to form pairs from")
    generator = np.random.default_rng(pairing.seed)
    chosen = [_choose(np.flatnonzero(measurements.test == test), pairing, generator) for test in (False, True)]
    a, b = np.concatenate(chosen).T
    n = len(a)
    found: dict[str, Any] = dict.fromkeys(("distance", "angle", "sigma_distance", "sigma_angle"), np.full(n, np.nan))
    if measurements.position is not None:
        step = measurements.position[b] - measurements.position[a]  # (n, 3)
        found["distance"] = np.linalg.norm(step, axis=1)
        if measurements.sigma_position is not None:
            found["sigma_distance"] = _sigma_along(measurements.sigma_position, a, b, step)
    if measurements.rotation is not None:
        a_R_b = np.swapaxes(measurements.rotation[a], 1, 2) @ measurements.rotation[b]  # (n, 3, 3)
        found["angle"], axis = rotation_angle(a_R_b)
        if measurements.sigma_orientation is not None:
            found["sigma_angle"] = _sigma_along(measurements.sigma_orientation, a, b, axis)
    return Pairs(a, b, test=measurements.test[a], source=f"pairs from {measurements.source}", **found)


def _choose(rows: Integers, pairing: Pairing, generator: np.random.Generator) -> Integers:
    """Pairs of `rows` by the strategy, shape (n_pairs, 2)."""
    n = len(rows)
    if n < 2:
        return np.empty((0, 2), dtype=np.int64)
    possible = n * (n - 1) // 2
    wanted = {"all": possible, "random": min(pairing.count, possible)}.get(pairing.strategy, n - 1)
    if wanted > MOST_PAIRS:
        hint = "a random part will do, such as {random: 100000}"
        raise InputError("pairing", f"{pairing} forms {wanted} pairs", f"at most {MOST_PAIRS}", hint)
    match pairing.strategy:
        case "star":
            first, second = np.zeros(n - 1, dtype=np.int64), np.arange(1, n)
        case "chain":
            first, second = np.arange(n - 1), np.arange(1, n)
        case "all":
            first, second = np.triu_indices(n, 1)
        case "random":
            first, second = _draw_pairs(n, pairing.count, generator)
    return np.stack([rows[first], rows[second]], axis=1)


def _draw_pairs(n: int, count: int, generator: np.random.Generator) -> tuple[Integers, Integers]:
    """`count` different pairs a < b of n rows (all, if there are no more), each row about equally often.

    A row in many pairs would have its own errors count many times. So the pairs are rounds of a tournament in
    which each row meets every other once (the circle method), rows and rounds in random order.
    """
    m = n - 1 + n % 2  # rounds of the whole tournament; row n - 1 sits in the middle if n is even
    per_round = n // 2
    rounds = generator.permutation(m)[: -(-count // per_round), None]
    step = np.arange(1, (m - 1) // 2 + 1)
    meetings = np.stack([(rounds + step) % m, (rounds - step) % m], axis=2)  # (rounds, meetings, 2)
    if n % 2 == 0:
        middle = np.stack([rounds, np.full_like(rounds, n - 1)], axis=2)
        meetings = np.concatenate([meetings, middle], axis=1)
    pairs = np.sort(generator.permutation(n)[meetings.reshape(-1, 2)[:count]], axis=1)
    first, second = pairs[np.lexsort(pairs.T[::-1])].T
    return first, second


def _sigma_along(sigma: Floats, a: Integers, b: Integers, direction: Floats) -> Floats:
    """Sigma of a difference along `direction` (any direction where it has none), shape (n,)."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    unit = np.where(length > 0.0, direction / np.where(length > 0.0, length, 1.0), np.sqrt(1.0 / 3.0))
    variance: Floats = np.sum(unit**2 * (sigma[a] ** 2 + sigma[b] ** 2), axis=1)
    return np.sqrt(variance)
