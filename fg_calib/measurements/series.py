"""Series: measurements of one kind, as estimation takes them, made of the tables that users have.

| table | series |
|---|---|
| poses, with model `pose`, `position` or `orientation` | one measurement a configuration |
| pairs, measured or formed from poses | distance and angle of each; where a distance of 0 was measured, the vector |
| touched points (a column `group`) | one touch a configuration; distances between the points |
| own | as they are given |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import Brief
from fg_calib.errors import InputError, ProblemError
from fg_calib.measurements.dataset import Measurements, Pairs, form_pairs, no_pairs
from fg_calib.measurements.kinds import (
    Distance,
    Kind,
    Orientation,
    PointDistance,
    Position,
    RotationAngle,
    SamePoint,
    TouchedPoint,
    stack,
)
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge, Model, Pairing, check, check_type

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

SAME_READING = 1e-8
"""How far readings of one configuration in two tables may be apart, [rad] or [m]: what nine digits in degrees leave."""

POINT_MODELS: tuple[Model, ...] = ("distance", "distance-rotation")
"""Models that use touched points."""


@dataclass(frozen=True)
class Series(Brief):
    """Measurements of one kind from one table.

    Attributes:
        kind: What they are.
        table: Which table they are from.
        ends: Configurations of each, rows of that table, shape (n, kind.ends).
        data: What was measured, shape (n, kind.width); any number where not measured.
        sigma: 1 sigma of each row's own noise, shape (n, kind.residual_dim); 0 where measured poses alone say it.
        measured: Which rows were measured, shape (n, kind.residual_dim).
        test: Which are predicted but never fitted, shape (n,).
        number: Number of each in its table, shape (n,).
        nuisances: Coordinates of nuisances that each depends on, in the problem's list, shape (n, kind.n_nuisances).
        formed: Whether they are pairs formed from measured poses, whose noise they have.
        excluded: Measured ones that take no part: masks by reason, shape (n,) each.
        source: File name, for messages.
    """

    kind: Kind
    table: int
    ends: Integers
    data: Floats
    sigma: Floats
    measured: Booleans
    test: Booleans
    number: Integers
    nuisances: Integers
    formed: bool = False
    excluded: dict[str, Booleans] = field(default_factory=dict)
    source: str = "measurements"

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.test)

    @property
    def used(self) -> Booleans:
        """Rows that take part in fit or prediction, shape (n, residual_dim)."""
        used = self.measured.copy()
        for mask in self.excluded.values():
            used[mask] = False
        return used

    @property
    def train(self) -> Integers:
        """Measurements with a row to fit."""
        return np.flatnonzero(self.used.any(axis=1) & ~self.test)

    def __post_init__(self) -> None:
        n, kind = len(self.test), self.kind
        shapes = {"ends": (n, kind.ends), "data": (n, kind.width), "sigma": (n, kind.residual_dim)}
        shapes |= {"measured": (n, kind.residual_dim), "nuisances": (n, kind.n_nuisances)}
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ProblemError(self.source, f"{name} of shape {found}", f"{shape} for {type(kind).__name__}")


@dataclass(frozen=True)
class Own(Brief):
    """Measurements of a kind of one's own, at the configurations of a table.

    Attributes:
        kind: What they are.
        data: What was measured, shape (n, kind.width).
        sigma: 1 sigma of each row, a figure or an array that broadcasts to (n, kind.residual_dim).
        ends: Configurations of each, shape (n, kind.ends); the table's, one after the other, if None.
        unknowns: Start of each unknown that the kind depends on, shape (n_unknowns, dimension).
        which: Unknowns of each measurement, shape (n, kind.n_nuisances / dimension); the first for all if None.
        names: Names of the unknowns; their numbers if empty.
        test: Which are predicted but never fitted, shape (n,); none if None.
    """

    kind: Kind
    data: Floats
    sigma: Floats | float
    ends: Integers | None = None
    unknowns: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    which: Integers | None = None
    names: tuple[str, ...] = ()
    test: Booleans | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.kind, Kind):
            raise InputError("own: kind", f"found {self.kind!r}", "an object of a class derived from Kind")
        data = _figures("own: data", self.data)
        n, kind = len(data), self.kind
        data = data.reshape(n, -1) if n else data
        if not n or data.shape[1] != kind.width:
            raise InputError("own: data", f"shape {np.shape(self.data)}", f"({n or 'n'}, {kind.width})")
        sigma = _own_sigma(self.sigma, n, kind.residual_dim)
        names = (self.names,) if isinstance(self.names, str) else tuple(self.names)
        starts = np.atleast_2d(_figures("own: unknowns", self.unknowns))
        if kind.n_nuisances and (not starts.size or kind.n_nuisances % starts.shape[1]):
            expected = f"a start for each unknown; {type(kind).__name__} has {kind.n_nuisances} coordinates of them"
            raise InputError("own: unknowns", f"shape {np.shape(self.unknowns)}", expected)
        if names and len(set(names)) != len(starts):
            raise InputError("own: names", f"found {names!r}", f"{len(starts)} different names")
        for name, given, top in (("ends", self.ends, None), ("which", self.which, len(starts))):
            if given is not None:
                _check_indices(f"own: {name}", given, n, top)
        if self.test is not None:
            test = np.array(self.test)
            if test.shape != (n,) or test.dtype != np.bool_:
                raise InputError("own: test", f"{test.dtype} of shape {test.shape}", f"True or False for each of {n}")
            object.__setattr__(self, "test", test)
        for name in ("ends", "which"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.array(getattr(self, name)))
        object.__setattr__(self, "unknowns", starts)
        object.__setattr__(self, "data", data)
        object.__setattr__(self, "sigma", sigma)
        object.__setattr__(self, "names", names)


def _own_sigma(given: Any, n: int, residual_dim: int) -> Floats:
    """Sigmas that broadcast to (n, residual_dim), all above 0."""
    sigma = _figures("own: sigma", given)
    if sigma.shape == (n,) and n > 1:
        if n == residual_dim:
            expected = f"({n}, 1) for one a measurement, (1, {n}) for one a row of each"
            raise InputError("own: sigma", f"shape ({n},) of {n} measurements of {n} rows", expected)
        sigma = sigma[:, None]
    try:
        np.broadcast_to(sigma, (n, residual_dim))
    except ValueError:
        expected = f"one that broadcasts to ({n}, {residual_dim})"
        raise InputError("own: sigma", f"shape {sigma.shape}", expected) from None
    if not np.all(sigma > 0.0):
        raise InputError("own: sigma", f"found {float(sigma.min())!r}", "figures above 0")
    return sigma


def _figures(name: str, given: Any) -> Floats:
    """Finite numbers, at least one-dimensional, a copy.

    Raises:
        InputError: They are something else.
    """
    try:
        values = np.atleast_1d(np.array(given, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(name, "found no array of numbers", "finite numbers") from None
    if not np.isfinite(values).all():
        raise InputError(name, "found nan or infinity", "finite numbers")
    return values


def _check_indices(name: str, given: Any, n: int, top: int | None) -> None:
    """Check indices of configurations or unknowns, a row each.

    Raises:
        InputError: They are no whole numbers, too few or out of range.
    """
    values = np.asarray(given)
    if values.dtype.kind not in "iu" or values.shape[:1] != (n,):
        raise InputError(name, f"{values.dtype} of shape {values.shape}", f"whole numbers, a row for each of {n}")
    if values.size and (values.min() < 0 or (top is not None and values.max() >= top)):
        wrong = values.min() if values.min() < 0 else values.max()
        raise InputError(name, f"found {wrong}", "0 and above" if top is None else f"0 to {top - 1}")


@dataclass(frozen=True)
class Table(Brief):
    """A table of measurements, and how it is to be understood.

    Attributes:
        measurements: What was measured.
        model: Which of it takes part; None if only `own` does.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether its measurement frame is known to be the base, or world_T_base is estimated.
        own: Measurements of other kinds at its configurations.
    """

    measurements: Measurements
    model: Model | None = "distance-rotation"
    pairing: Pairing = field(default_factory=Pairing)
    frame: FrameKnowledge = "known"
    own: tuple[Own, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.measurements, Measurements):
            raise InputError("table: measurements", f"found {type(self.measurements).__name__}", "a Measurements")
        if self.model is not None:
            check("table: model", self.model, Model)
        check("table: frame", self.frame, FrameKnowledge)
        check_type("table: pairing", self.pairing, Pairing, "Pairing('chain')")
        if not isinstance(self.own, tuple) or not all(isinstance(own, Own) for own in self.own):
            raise InputError("table: own", f"found {self.own!r}", "a tuple of Own, such as (Own(...),)")
        if self.model is None and self.frame == "unknown":
            raise InputError(
                "table: frame", "unknown, without a model", "a kind with unknowns of its own for the frame"
            )

    @property
    def uses_pairs(self) -> bool:
        """Whether its model is one of pairs."""
        return self.model in PAIR_MODELS

    @property
    def unknown_frame(self) -> bool:
        """Whether its world_T_base is estimated."""
        return self.frame == "unknown" and self.model in POSE_MODELS


class Unknowns:
    """The unknowns besides the arm that series depend on: touched points, and those of one's own.

    Attributes:
        letters: Letter of each one's key, shape (n,).
        names: What each is called.
        sizes: Number of coordinates of each.
        starts: Where each is started; nan where the measurements say.
    """

    def __init__(self) -> None:
        self.letters: list[str] = []
        self.names: list[str] = []
        self.sizes: list[int] = []
        self.starts: list[Floats] = []
        self._named: dict[tuple[str, str, int], int] = {}
        self._first: list[int] = []

    @property
    def n_coordinates(self) -> int:
        """Number of coordinates of all."""
        return sum(self.sizes)

    @property
    def owners(self) -> Integers:
        """Which unknown each coordinate is of, shape (n_coordinates,)."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def add(self, letter: str, names: Sequence[str], starts: Floats, place: str, frame: int = -1) -> Integers:
        """Add unknowns of one dimension; those of a name that is there are the same, whatever table they are from.

        Args:
            letter: Letter of their keys.
            names: What they are called; none have names of their own if empty.
            starts: Where they are started, shape (n, dimension).
            place: The table, for messages.
            frame: The table in whose own measurement frame they are, -1 for the base: elsewhere a name is another.

        Returns:
            Their coordinates' places, shape (n, dimension).

        Raises:
            ProblemError: Two of one name are started at different places.
        """
        found = np.empty(starts.shape, dtype=np.int64)
        for k, start in enumerate(starts):
            name = names[k] if names else str(k)
            i = self._named.get((letter, name, frame), len(self.names)) if names else len(self.names)
            if i == len(self.names):
                self._first.append(self._first[-1] + self.sizes[-1] if self.sizes else 0)
                self.letters.append(letter)
                self.names.append(name)
                self.sizes.append(len(start))
                self.starts.append(start)
            elif not np.array_equal(self.starts[i], start, equal_nan=True):
                expected = f"that of the other {name}: {self.starts[i].tolist()}"
                raise ProblemError(place, f"start {start.tolist()} of unknown {name}", expected)
            if names:
                self._named[letter, name, frame] = i
            found[k] = self._first[i] + np.arange(len(start))
        return found


def series_of(table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """The series of a table.

    Args:
        table: The table.
        number: Its number.
        unknowns: What the series depend on is added here.

    Raises:
        ProblemError: The table lacks what its model needs, or a sigma.
    """
    m = table.measurements
    if m.groups is not None and table.model not in POINT_MODELS:
        raise ProblemError(m.source, f"a column group with model {table.model}", f"model {' or '.join(POINT_MODELS)}")
    for k, own in enumerate(table.own):
        if any(own is before for before in table.own[:k]):
            raise ProblemError(m.source, "the same Own twice", "every measurement once")
    found = [_own_series(own, m, number, unknowns, number if table.unknown_frame else -1) for own in table.own]
    if table.uses_pairs:
        pairs = usable_pairs(m, table)
        found += _pair_series(pairs, m, table, number)
    elif table.model is not None:
        found.append(_pose_series(m, table, number))
    if m.groups is not None:
        found += _touch_series(m, table, number, unknowns)
    return found


def _pose_series(m: Measurements, table: Table, number: int) -> Series:
    assert table.model is not None
    parts: list[tuple[Kind, Floats, Floats]] = []
    rows: tuple[tuple[bool, Kind, Floats | None, Floats | None, str, str], ...] = (
        (POSE_MODELS[table.model][0], Orientation(), m.rotation, m.sigma_orientation, _ANGLES, "orientation"),
        (POSE_MODELS[table.model][1], Position(), m.position, m.sigma_position, "x, y, z", "position"),
    )
    for wanted, kind, values, sigma, columns, noise in rows:
        if wanted and values is None:
            raise ProblemError(m.source, f"no columns {columns}", f"measured {noise}s for model {table.model}")
        if wanted and sigma is None:
            raise ProblemError(m.source, f"no sigma for {noise}", f"noise.{noise} or a column sigma_{noise}")
        if wanted and values is not None and sigma is not None:
            parts.append((kind, values.reshape(m.n_configurations, -1), sigma))
    n, kind = m.n_configurations, stack(*(kind for kind, _, _ in parts))
    return Series(
        kind=kind,
        table=number,
        ends=np.arange(n)[:, None],
        data=np.ascontiguousarray(np.hstack([values for _, values, _ in parts])),
        sigma=np.hstack([sigma for _, _, sigma in parts]),
        measured=np.ones((n, kind.residual_dim), dtype=np.bool_),
        test=m.test,
        number=np.arange(n),
        nuisances=np.zeros((n, 0), dtype=np.int64),
        source=m.source,
    )


_ANGLES = "qx, qy, qz, qw or roll, pitch, yaw"


def usable_pairs(m: Measurements, table: Table) -> Pairs:
    """The pairs of a table, nan where its model does not want a measurement; every wanted one has its sigma.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    assert table.model is not None
    wanted = PAIR_MODELS[table.model]
    lacking = [columns for use, values, columns in zip(
        wanted, (m.position, m.rotation), ("x, y, z", _ANGLES), strict=True) if use and values is None]  # fmt: skip
    if m.pairs is not None:
        pairs = m.pairs
    elif m.groups is not None and lacking:  # touched points suffice
        pairs = no_pairs(m.source)
    elif lacking:
        what = "measured positions" if lacking[0] == "x, y, z" else "orientations"
        raise ProblemError(m.source, f"no columns {lacking[0]}", f"{what} for model {table.model}")
    else:
        pairs = form_pairs(m, table.pairing)
    measured = np.zeros(pairs.n_pairs, dtype=np.bool_)
    for use, kind, source, values, sigma in (
        (wanted[0], "distance", "position", pairs.distance, pairs.sigma_distance),
        (wanted[1], "angle", "orientation", pairs.angle, pairs.sigma_angle),
    ):
        if use and np.any(np.isfinite(values) & ~np.isfinite(sigma)):
            noise = source if m.pairs is None else kind
            raise ProblemError(pairs.source, f"no sigma for {kind}", f"noise.{noise} or a column sigma_{noise}")
        measured |= use & np.isfinite(values)
    return pairs.select(measured)


def _pair_series(pairs: Pairs, m: Measurements, table: Table, number: int) -> list[Series]:
    """Distances and angles of pairs; vectors of those whose distance was measured as exactly 0.

    A directly measured 0 is not a noisy number: it says that both points are one. Where both readings are the same,
    nothing changes the prediction.
    """
    assert table.model is not None
    formed, wanted = m.pairs is None, PAIR_MODELS[table.model]
    values, sigmas = np.stack([pairs.distance, pairs.angle]), np.stack([pairs.sigma_distance, pairs.sigma_angle])
    there = np.isfinite(values) & np.array(wanted)[:, None]
    point = there[0] & (values[0] == 0.0) & (not formed)
    there[0] &= ~point
    ends = np.stack([pairs.a, pairs.b], axis=1)
    same = np.all(m.readings[pairs.a] == m.readings[pairs.b], axis=1)

    def series(kind: Kind, rows: Integers, data: Floats, sigma: Floats, measured: Booleans) -> Series:
        return Series(
            kind=kind,
            table=number,
            ends=np.ascontiguousarray(ends[rows]),
            data=data,
            sigma=sigma,
            measured=measured,
            test=pairs.test[rows],
            number=rows,
            nuisances=np.zeros((len(rows), 0), dtype=np.int64),
            formed=formed,
            excluded={"same_configuration": same[rows]},
            source=pairs.source,
        )

    found, use = [], [k for k in (0, 1) if wanted[k]]
    rows = np.flatnonzero(there.any(axis=0))
    if len(rows):
        kind = stack(*((Distance(), RotationAngle())[k] for k in use))
        data = np.ascontiguousarray(np.nan_to_num(values[use][:, rows].T))
        sigma = np.zeros_like(data) if formed else np.nan_to_num(sigmas[use][:, rows].T)
        found.append(series(kind, rows, data, sigma, there[use][:, rows].T))
    rows = np.flatnonzero(point)
    if len(rows):
        sigma = np.repeat(pairs.sigma_distance[rows, None], 3, axis=1)
        found.append(series(SamePoint(), rows, np.zeros((len(rows), 0)), sigma, np.ones((len(rows), 3), np.bool_)))
    return found


def _touch_series(m: Measurements, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    groups = m.groups
    assert groups is not None
    rows = np.flatnonzero(groups.index >= 0)
    if m.sigma_point is None or not np.isfinite(m.sigma_point[rows]).all():
        raise ProblemError(m.source, "no sigma for touched points", "noise.point or a column sigma_point")
    pairs = groups.pairs
    if not np.isfinite(pairs.sigma_distance).all():
        raise ProblemError(pairs.source, "no sigma for distance", "noise.distance or a column sigma_distance")
    place = unknowns.add("L", groups.names, np.full((groups.n_groups, 3), np.nan), m.source)
    touches = Series(
        kind=TouchedPoint(),
        table=number,
        ends=rows[:, None],
        data=np.zeros((len(rows), 0)),
        sigma=np.repeat(m.sigma_point[rows, None], 3, axis=1),
        measured=np.ones((len(rows), 3), dtype=np.bool_),
        test=m.test[rows],
        number=rows,
        nuisances=place[groups.index[rows]],
        source=m.source,
    )
    if not pairs.n_pairs:
        return [touches]
    between = Series(
        kind=PointDistance(),
        table=number,
        ends=np.zeros((pairs.n_pairs, 0), dtype=np.int64),
        data=np.ascontiguousarray(pairs.distance[:, None]),
        sigma=pairs.sigma_distance[:, None],
        measured=np.ones((pairs.n_pairs, 1), dtype=np.bool_),
        test=pairs.test,
        number=np.arange(pairs.n_pairs),
        nuisances=np.hstack([place[pairs.a], place[pairs.b]]),
        source=pairs.source,
    )
    return [touches, between]


def _own_series(own: Own, m: Measurements, number: int, unknowns: Unknowns, frame: int) -> Series:
    kind, data = own.kind, own.data
    n = len(data)
    ends = np.arange(m.n_configurations)[:, None] if own.ends is None else np.asarray(own.ends).reshape(n, -1)
    if len(ends) != n or ends.max(initial=0) >= m.n_configurations:
        found = f"{n} measurements at {len(ends)} configurations" if len(ends) != n else f"found {ends.max()}"
        raise InputError("own: ends", found, f"one a measurement, 0 to {m.n_configurations - 1}")
    nuisances = np.zeros((n, 0), dtype=np.int64)
    if kind.n_nuisances:
        starts = np.atleast_2d(np.asarray(own.unknowns, dtype=np.float64))
        place = unknowns.add("N", own.names, starts, m.source, frame)
        which = np.zeros((n, 1), dtype=np.int64) if own.which is None else np.asarray(own.which).reshape(n, -1)
        nuisances = place[which].reshape(n, -1)
    return Series(
        kind=kind,
        table=number,
        ends=ends,
        data=np.ascontiguousarray(data),
        sigma=np.broadcast_to(own.sigma, (n, kind.residual_dim)),
        measured=np.ones((n, kind.residual_dim), dtype=np.bool_),
        test=np.zeros(n, dtype=np.bool_) if own.test is None else np.asarray(own.test, dtype=np.bool_),
        number=np.arange(n),
        nuisances=nuisances,
        source=m.source,
    )


@dataclass(frozen=True)
class Dataset(Brief):
    """All tables of a calibration, as estimation takes them.

    Attributes:
        tables: The tables.
        series: Their measurements, kind by kind.
        unknowns: What the series depend on besides the arm.
        places: Of each table, its configurations among those of all tables, shape (n_configurations,) each.
        names: Name of each configuration, then of each unknown.
    """

    tables: tuple[Table, ...]
    series: tuple[Series, ...]
    unknowns: Unknowns
    places: tuple[Integers, ...]
    names: tuple[str, ...]

    @property
    def n_configurations(self) -> int:
        """Number of different configurations."""
        return len(self.names) - len(self.unknowns.names)

    @property
    def readings(self) -> Floats:
        """Joint readings of every configuration, shape (n_configurations, n_joints)."""
        out = np.empty((self.n_configurations, self.tables[0].measurements.readings.shape[1]))
        for table, place in zip(self.tables, self.places, strict=True):
            out[place] = table.measurements.readings
        return out

    @property
    def sigma_joint(self) -> Floats:
        """1 sigma of the readings, shape (n_joints,)."""
        return self.tables[0].measurements.sigma_joint

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each table: its source, with its number where others have the same."""
        sources = [table.measurements.source for table in self.tables]
        return tuple(s if sources.count(s) == 1 else f"{s} ({i})" for i, s in enumerate(sources, start=1))

    @property
    def touched(self) -> bool:
        """Whether points were touched."""
        return any(isinstance(s.kind, TouchedPoint) for s in self.series)

    def n_train(self, kind: type[Kind]) -> int:
        """Number of train measurements of a kind."""
        return sum(len(s.train) for s in self.series if isinstance(s.kind, kind))

    @property
    def source(self) -> str:
        """What the tables are called in messages."""
        return ", ".join(dict.fromkeys(table.measurements.source for table in self.tables))

    def estimated(self) -> Booleans:
        """Which unknowns a train measurement at a configuration depends on, shape (n_unknowns,)."""
        seen = np.zeros(self.unknowns.n_coordinates, dtype=np.bool_)
        for s in self.series:
            if s.kind.ends:
                seen[s.nuisances[s.train]] = True
        first = np.cumsum([0, *self.unknowns.sizes])[:-1]
        return seen[first] if len(first) else np.zeros(0, dtype=np.bool_)


def gather(tables: Sequence[Table]) -> Dataset:
    """All tables together.

    Where tables state ids, the same id is the same configuration.

    Raises:
        ProblemError: A table lacks what its model needs, or two tables contradict each other.
    """
    unknowns, series = Unknowns(), list[Series]()
    places: list[Integers] = []
    names: list[str] = []
    found: dict[str, tuple[int, int]] = {}
    for number, table in enumerate(tables):
        m = table.measurements
        for before in tables[:number]:
            _check_once(table, before)
        place = np.empty(m.n_configurations, dtype=np.int64)
        for k, name in enumerate(m.ids.tolist()):
            other = found.get(name) if m.named else None
            if other is None:
                place[k] = len(names)
                names.append(name if len(tables) == 1 or m.named else f"{name} of {m.source}")
                if m.named:
                    found[name] = (number, k)
                continue
            of_other = tables[other[0]].measurements
            if not np.allclose(m.readings[k], of_other.readings[other[1]], rtol=0.0, atol=SAME_READING):
                expected = f"those of {of_other.source}, or another id"
                raise ProblemError(m.source, f"other joint readings at id {name}", expected)
            place[k] = places[other[0]][other[1]] if other[0] < number else place[other[1]]
        if not np.array_equal(m.sigma_joint, tables[0].measurements.sigma_joint):
            source = tables[0].measurements.source
            raise ProblemError(
                m.source, "another noise.joint", f"that of {source}: the readings are of the same encoders"
            )
        places.append(place)
        series += series_of(table, number, unknowns)
    series = _without_untouched(series, unknowns.n_coordinates)
    return Dataset(tuple(tables), tuple(series), unknowns, tuple(places), (*names, *unknowns.names))


def _check_once(table: Table, other: Table) -> None:
    """Raise where two tables hold the same measurements: counted twice, they would look better than they are.

    They do where most figures of the smaller one stand in the other at the same readings, in whatever order. A few may
    do so by chance, where instruments round.
    """
    mine, others = _measured_by(table), _measured_by(other)
    for words in mine.keys() & others.keys():
        a, b = ({row.tobytes() for row in np.round(rows, 9) + 0.0} for rows in (mine[words], others[words]))
        if 2 * len(a & b) > min(len(a), len(b)):
            a_source, b_source = table.measurements.source, other.measurements.source
            raise ProblemError(a_source, f"the same {words} as in {b_source}", "every measurement once")


def _measured_by(table: Table) -> dict[str, Floats]:
    """What takes part of a table, with the readings that it is of, a row each, by what it is called."""
    m, pairs, groups = table.measurements, table.measurements.pairs, table.measurements.groups
    distance, angle = PAIR_MODELS.get(table.model, (False, False))  # type: ignore[arg-type]
    turned, placed = POSE_MODELS.get(table.model, (angle, distance))  # type: ignore[arg-type] # of which pairs are formed
    found: dict[str, tuple[Floats, ...]] = {}
    if groups is not None:
        touches = groups.index >= 0
        found["touches"] = (m.readings[touches],)
    if pairs is None or not table.uses_pairs:
        figures = {"orientations": m.rotation if turned else None, "positions": m.position if placed else None}
        for name, v in figures.items():
            if v is not None:
                found[name] = (m.readings, v.reshape(len(v), -1))
    else:
        ends = (m.readings[pairs.a], m.readings[pairs.b])
        for name, wanted, v in (("distances", distance, pairs.distance), ("angles", angle, pairs.angle)):
            if wanted and np.isfinite(v).any():
                there = np.isfinite(v)
                found[name] = (ends[0][there], ends[1][there], v[there, None])
    for own in table.own:
        ends_of = np.arange(m.n_configurations)[:, None] if own.ends is None else own.ends.reshape(len(own.data), -1)
        if len(ends_of) == len(own.data) and ends_of.max(initial=0) < m.n_configurations:
            at = m.readings[ends_of].reshape(len(own.data), -1)
            found[f"measurements of {type(own.kind).__name__}"] = (at, own.data)
    return {name: np.hstack(columns) for name, columns in found.items()}


def _without_untouched(series: Sequence[Series], n_coordinates: int) -> list[Series]:
    """The series; distances of a point that no train row touched are there to be predicted alone."""
    touched = np.zeros(n_coordinates, dtype=np.bool_)
    for s in series:
        if isinstance(s.kind, TouchedPoint):
            touched[s.nuisances[~s.test]] = True
    return [
        replace(s, test=s.test | ~touched[s.nuisances].all(axis=1)) if isinstance(s.kind, PointDistance) else s
        for s in series
    ]
