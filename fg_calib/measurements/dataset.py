"""Measurements in [m] and [rad]: configurations, poses and pairs, and their noise; pairs formed from poses."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib import inputs
from fg_calib.inputs import Booleans, Floats, FrozenArrays, InputError, Integers, Pairing, Reader, brief, check_number
from fg_calib.robot import Robot, rotation_angle

_log = logging.getLogger(__name__)


MOST_PAIRS = 10_000_000
"""The largest number of pairs that are formed from poses."""

ANGLE_SLACK = 1e-5
"""How far a rotation angle may exceed pi, [rad]: half a turn, rounded to six figures."""

LIMIT_SLACK = 1e-3
"""How far a reading may be beyond its joint's limits, [rad] or [m]: encoders say so of a joint that stands at one."""

FAR = 0.5
"""Part of a joint's range beyond its limits from which a smaller unit is likelier than limits that are too narrow."""


class Noise(inputs.Record):
    """Measurement noise, 1 sigma; None where it is not specified.

    Attributes:
        position: Per axis, [m].
        orientation: Per axis of a rotation vector, [rad].
        joint: Of the joint readings: one figure for all joints or one a joint, [rad] (prismatic: [m]).
        distance: Of a directly measured distance, also to an anchor or a plane, [m].
        angle: Of a directly measured rotation angle, [rad].
        point: Of a contact point, per axis, [m].
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

    def updated(self, **values: Any) -> "Noise":
        """Other sigmas of some kinds, of `more` too; None leaves one of `more` as it is."""
        named = {kind: value for kind, value in values.items() if kind in _NOISE}
        others = {kind: value for kind, value in values.items() if kind not in _NOISE and value is not None}
        return replace(self, **named, more={**self.more, **others})

    def of_joints(self, n_joints: int) -> Floats:
        """Sigma of the reading of each joint, shape (n_joints,), [rad] (prismatic: [m]).

        Raises:
            InputError: It is specified for more or fewer joints.
        """
        sigma = np.atleast_1d(np.array(self.joint, dtype=np.float64))
        inputs.expect(len(sigma) in {1, n_joints}, "noise: joint", f"{len(sigma)} sigmas", f"one value, or {n_joints}")
        return np.broadcast_to(sigma, n_joints).copy()

    def __post_init__(self) -> None:
        if isinstance(self.joint, list | np.ndarray):
            object.__setattr__(self, "joint", tuple(np.atleast_1d(np.array(self.joint, dtype=object)).tolist()))
        sigmas = [(name, getattr(self, name)) for name in _NOISE if name != "joint"]
        sigmas += [("joint", sigma) for sigma in (self.joint if isinstance(self.joint, tuple) else (self.joint,))]
        for name, sigma in (*sigmas, *self.more.items()):
            if sigma is not None:
                check_number(f"noise: {name}", sigma)


_NOISE = tuple(f.name for f in fields(Noise) if f.name != "more")


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

    def select(self, rows: Booleans | Integers) -> "Pairs":
        """The pairs at `rows` only."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "source"})


class Labels(FrozenArrays):
    """Name in each row: the target that was seen, the station it was seen from.

    Attributes:
        names: The different names.
        index: Which of them each row has, -1 for none, shape (n_configurations,).
    """

    names: tuple[str, ...]
    index: Integers

    def of(self, rows: Integers) -> "Labels":
        """Labels of some rows, the same names."""
        return replace(self, index=self.index[rows])

    def only_of(self, chosen: Booleans) -> Booleans:
        """Which names have rows, all of them chosen, shape (n_names,)."""
        inside, outside = (np.isin(np.arange(len(self.names)), self.index[rows]) for rows in (chosen, ~chosen))
        return inside & ~outside


class Groups(Labels):
    """Configurations in which the tool point touched the same physical point, whose position is unknown.

    Attributes:
        pairs: Distances measured between the points of two groups (a and b are groups, angles nan).
    """

    pairs: Pairs


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
        named: Whether the names were given, so that another table may have the same configurations.
        roll_pitch_yaw: Angles that `rotation` was read from, shape (n_configurations, 3), [rad]; None for quaternions.
        labels: Names in the rows, by `target`, `station`, `anchor`, `plane` or `board`, where that was said.
        image: Where a point of the row's board was seen, u and v, [px], and where it is on the board, x and y, [m],
            shape (n_configurations, 4); None where nothing was.
        covariance: Of a board's measured pose, about and along the camera's axes, shape (n_configurations, 6, 6), [rad]
            and [m]; None where sigmas say it.
        part: Which rows of a table these are, shape (n_configurations,); None where they are all.
        columns: Other measured values, by column, shape (n_configurations,) each, nan where it was not: `distance` to
            the row's anchor, or from its plane, [m].
        sigmas: 1 sigma of these, by the same names, and of `point`, a touch, per axis, [m], nan where it is not
            specified; and of `pixel`, along u and v, shape (n_configurations, 2), [px].
        context: What effects of the arm depend on besides readings, by name, shape (n_configurations, ...) each.
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
    roll_pitch_yaw: Floats | None = None
    named: bool = False
    labels: Mapping[str, Labels] = field(default_factory=dict)
    image: Floats | None = None
    covariance: Floats | None = None
    part: Integers | None = None
    columns: Mapping[str, Floats] = field(default_factory=dict)
    sigmas: Mapping[str, Floats] = field(default_factory=dict)
    context: Mapping[str, Floats] = field(default_factory=dict)

    from_arrays, from_frame = Reader("read_arrays"), Reader("read_measurements")

    @classmethod
    def at(cls, robot: Robot, readings: Floats) -> "Measurements":
        """Configurations without names, all of them train rows; noise of poses as `Robot.scale_of` says."""
        n = len(readings)
        rows = np.arange(n).astype(np.str_), np.zeros(n, dtype=np.bool_)
        position, orientation = (np.full((n, 3), robot.scale_of(unit)) for unit in ("m", "rad"))
        return cls(readings, *rows, None, None, position, orientation, np.zeros(robot.n_joints))

    def __repr__(self) -> str:
        """Measurements without their sigmas."""
        names = [f.name for f in fields(self) if not f.name.startswith(("sigma", "ids", "test", "named", "part"))]
        return brief(self, (name for name in names if getattr(self, name) is not None))

    @property
    def n_configurations(self) -> int:
        """Number of configurations, train and test."""
        return len(self.readings)

    def select(self, rows: Integers) -> "Measurements":
        """Some rows, with what was measured at them; nothing that was measured between configurations."""
        arrays = {name: v for name, v in vars(self).items() if isinstance(v, np.ndarray) and name != "sigma_joint"}
        rows_of: dict[str, Any] = {name: v[rows] for name, v in arrays.items()}
        names = "columns", "sigmas", "context"
        named: dict[str, Any] = {of: {k: v[rows] for k, v in getattr(self, of).items()} for of in names}
        labels = {name: of.of(rows) for name, of in self.labels.items()}
        return replace(self, **rows_of, **named, labels=labels, pairs=None, groups=None)

    def value(self, name: str) -> Floats | None:
        """Measured values, by a field or a column that one instrument alone has; None where there are none."""
        return self.columns.get(name, getattr(self, name, None))

    def sigma(self, noise: str) -> Floats | None:
        """1 sigma by kind of noise; None where it is not specified."""
        return self.sigmas.get(noise, getattr(self, f"sigma_{noise}", None))

    def with_values(self, values: Mapping[str, Floats]) -> "Measurements":
        """Copy with other measured values, by the names that `value` takes."""
        own: dict[str, Any] = {name: v for name, v in values.items() if hasattr(self, name)}
        return replace(self, **own, columns={**self.columns, **{k: v for k, v in values.items() if k not in own}})


def check_readings(readings: Floats, robot: Robot, name: str) -> None:
    """Check that readings are of a robot's joints and within their limits; warn where they look like degrees.

    Args:
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        robot: The robot.
        name: Name in messages.

    Raises:
        InputError: The readings are of more or fewer joints, or outside limits.
    """
    if readings.shape[1] != robot.n_joints:
        raise InputError(name, f"readings of {readings.shape[1]} joints", f"{robot.n_joints}, as {robot.name} has")
    names, si = [joint.name for joint in robot.joints], {"rad": ("rad", 1.0), "m": ("m", 1.0)}
    check_limits(readings, robot, names, lambda row: f"{name}: row {row}", si)
    for joint, limits, q in zip(robot.joints, robot.limits, readings.T, strict=True):
        if not joint.prismatic and np.isinf(limits).all() and np.mean(np.abs(q) > 4 * np.pi) > 0.5:
            _log.warning("%s: most readings of %s are more than two turns; are they in deg?", name, joint.name)


def check_limits(
    readings: Floats, robot: Robot, names: Sequence[str], place: Callable[[int], str], shown: Mapping[str, Any]
) -> None:
    """Check that readings are within their joints' limits.

    Args:
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        robot: The robot.
        names: Names of the joints.
        place: Name of a row in messages.
        shown: Units that rad and m are shown in, with their sizes.

    Raises:
        InputError: One is outside.
    """
    outside = outside_limits(readings, robot)
    if outside.any():
        row, j = divmod(int(np.argmax(outside)), robot.n_joints)
        unit, size = shown[robot.joints[j].unit]
        reading, low, high = (v / size for v in (readings[row, j], *robot.limits[j]))
        found = f"{names[j]} = {reading:.6g} {unit} is outside [{low:.6g}, {high:.6g}]"
        raise InputError(place(row), found, hint=_limit_hint(readings[:, j], robot, j, unit))


def outside_limits(readings: Floats, robot: Robot) -> Booleans:
    """Which readings, shape (n, n_joints), [rad] (prismatic: [m]), are beyond their joints' limits."""
    lower, upper = robot.limits.T
    return np.asarray((readings < lower - LIMIT_SLACK) | (readings > upper + LIMIT_SLACK))


def _limit_hint(readings: Floats, robot: Robot, joint: int, unit: str) -> str:
    """Advice on a joint that has a reading outside its limits.

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
    return "widen the joint's limits if the reading is right; are the columns in the joints' order?"


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
    hint = "a random part will do, such as {random: 100000}"
    inputs.expect(wanted <= MOST_PAIRS, "pairing", f"{pairing} forms {wanted} pairs", f"at most {MOST_PAIRS}", hint)
    second = np.arange(1, n)
    first = second - 1 if pairing.strategy == "chain" else np.zeros_like(second)
    if pairing.strategy == "all":
        first, second = np.triu_indices(n, 1)
    elif pairing.strategy == "random":
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
    return np.sqrt(np.sum(unit**2 * (sigma[a] ** 2 + sigma[b] ** 2), axis=1))
