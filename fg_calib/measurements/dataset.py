"""What was measured: configurations, poses, pairs, and their noise; and how pairs are formed from poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.inputs import (
    Booleans,
    Floats,
    FrozenArrays,
    InputError,
    Integers,
    Pairing,
    brief,
    check_names,
    check_number,
    checked,
    listed,
)
from fg_calib.measurements.validation import (
    COLUMNS,
    LABELS,
    checked_columns,
    checked_ids,
    checked_joint_sigma,
    checked_labels,
    checked_mask,
    checked_pairs,
    checked_readings,
)
from fg_calib.robot import over_spans, rotation_angle

MOST_PAIRS = 10_000_000
"""The largest number of pairs that are formed from poses."""


@dataclass(frozen=True)
class Noise:
    """Measurement noise, 1 sigma; None where it is not stated.

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
        unused: Columns of the file that mean nothing.
    """

    a: Integers
    b: Integers
    distance: Floats
    angle: Floats
    sigma_distance: Floats
    sigma_angle: Floats
    test: Booleans
    source: str = "pairs"
    unused: tuple[str, ...] = ()

    _left_open = ("a", "b")

    @property
    def n_pairs(self) -> int:
        """Number of pairs."""
        return len(self.a)

    def select(self, rows: Booleans | Integers) -> Pairs:
        """The pairs at `rows` only."""
        columns = [f.name for f in fields(self) if f.name not in ("source", "unused")]
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def are_same(places: Integers | Floats, a: Integers, b: Integers) -> Booleans:
    """Which pairs have both ends at the same place, shape (n_pairs,).

    Args:
        places: Of all that they may be between, shape (n, width).
        a: The first of each, shape (n_pairs,).
        b: The second.
    """
    spans = over_spans(lambda start, stop: np.all(places[a[start:stop]] == places[b[start:stop]], axis=1), len(a))
    return np.concatenate([np.zeros(0, dtype=np.bool_), *spans])


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
class Groups(FrozenArrays):
    """Configurations in which the tool point touched the same physical point, whose position is unknown.

    Attributes:
        names: Name of each group, shape (n_groups,).
        index: Group of each configuration, -1 for none, shape (n_configurations,).
        pairs: Distances measured between the points of two groups (a and b are groups, angles nan).
    """

    names: tuple[str, ...]
    index: Integers
    pairs: Pairs

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return len(self.names)


@dataclass(frozen=True)
class Measurements(FrozenArrays):
    """Configurations, and what was measured at them or between them.

    Attributes:
        readings: Joint readings q, shape (n_configurations, n_joints), [rad] (prismatic: [m]).
        ids: Name of each configuration, shape (n_configurations,).
        test: True for rows that are predicted but never fitted, shape (n_configurations,).
        position: world_p_tool, shape (n_configurations, 3), [m]; None where not measured.
        rotation: world_R_tool, shape (n_configurations, 3, 3); None where not measured.
        sigma_position: Along the world's axes, shape (n_configurations, 3), [m]; None where it is not stated. It may be
            stated without a measurement: what one would be like.
        sigma_orientation: The same of the rotation vector about the tool's axes, shape (n_configurations, 3), [rad].
        sigma_joint: Of the readings, shape (n_joints,), [rad] (prismatic: [m]).
        pairs: Directly measured pairs; None if pairs are to be formed from the poses.
        source: File name, for messages.
        groups: Which configurations touched the same point; None if none did.
        sigma_point: Of a touch, per axis, shape (n_configurations,), [m]; nan where it is not stated.
        named: Whether the names were given, so that another table may have the same configurations.
        roll_pitch_yaw: What `rotation` was read from, shape (n_configurations, 3), [rad]; None for quaternions.
        labels: What the rows are of, by `target`, `station`, `anchor`, `plane` or `board`, where that was said.
        length: Distance to the row's anchor, or from its plane, shape (n_configurations,), [m]; None where not
            measured.
        sigma_length: Shape (n_configurations,), [m]; None where it is not stated.
        image: Where a point of the row's board was seen, u and v, [px], and where it is on the board, x and y, [m],
            shape (n_configurations, 4); None where nothing was.
        sigma_pixel: Along u and v, shape (n_configurations, 2), [px]; None where it is not stated.
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
                see `validation.COLUMNS` and `LABELS`.

        Raises:
            InputError: An array cannot be used; the message names it and its row.
        """
        n = len(q := checked_readings(readings))
        given = {name: values for name, values in columns.items() if values is not None}
        check_names("Measurements.from_arrays", given, (*COLUMNS, *LABELS), "argument")
        names, index = checked_labels("group", group, n)
        labels = {what: Labels(*checked_labels(what, given[what], n)) for what in LABELS if what in given}
        repeated = "pixel" in given or bool(labels.keys() - {"station"})
        known, rows = checked_ids(ids, n, repeated=repeated), checked_mask("test", test, n)
        every = tuple(dict.fromkeys((*names, *listed("points", points))))
        between, of_groups = None, no_pairs(source)
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
        n, changes = self.n_configurations, dict[str, Any]()
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray) and f.name != "sigma_joint" and len(value) == n:
                changes[f.name] = value[rows]
        for name in ("labels", "columns", "sigmas"):
            changes[name] = {key: v.of(rows) if name == "labels" else v[rows] for key, v in getattr(self, name).items()}
        return replace(self, **changes, pairs=None, groups=None)

    def value(self, name: str) -> Floats | None:
        """What was measured, by a field or a column that one instrument alone has; None where it was not."""
        found: Floats | None = self.columns.get(name, getattr(self, name, None))
        return found

    def sigma(self, noise: str) -> Floats | None:
        """1 sigma by kind of noise; None where it is not stated."""
        name = "sigma_length" if noise == "distance" else f"sigma_{noise}"
        found: Floats | None = self.sigmas.get(noise, getattr(self, name, None))
        return found

    def with_values(self, values: Mapping[str, Floats]) -> Measurements:
        """The same with other measured values, by the names that `value` takes."""
        own: dict[str, Any] = {name: v for name, v in values.items() if hasattr(self, name)}
        return replace(self, **own, columns={**self.columns, **{k: v for k, v in values.items() if k not in own}})


def pairs_from_arrays(given: Any, ids: NDArray[np.str_], test: Booleans, groups: Labels) -> tuple[Pairs, Booleans]:
    """Pairs, and which of them are of groups; those of a test row, or of a group of test rows alone, are test pairs.

    Args:
        given: Columns by name: see `Measurements.from_arrays`.
        ids: Names of the configurations.
        test: Which configurations are test rows.
        groups: The contact points.
    """
    columns, of_groups = checked_pairs(given, ids, groups.names)
    for flags, chosen in ((test, ~of_groups), (only_of(test, groups.index, len(groups.names)), of_groups)):
        columns["test"][chosen] |= flags[columns["a"][chosen]] | flags[columns["b"][chosen]]
    return Pairs(**columns), of_groups  # type: ignore[arg-type]


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
    names = ("distance", "angle", "sigma_distance", "sigma_angle")
    found: dict[str, Any] = {name: np.full(n, np.nan) for name in names}
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
