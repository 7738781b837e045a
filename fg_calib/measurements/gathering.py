"""All tables of a calibration together, as estimation takes them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import Brief
from fg_calib.errors import ProblemError, shown
from fg_calib.measurements.dataset import Measurements, Pairs, are_same
from fg_calib.measurements.kinds import Kind, PointDistance, TouchedPoint
from fg_calib.measurements.models import SERIES_OF, own_series, touch_series
from fg_calib.measurements.models.starts import check_fitted, start_places
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.options import NEAR, PAIR_MODELS, POSE_MODELS, Model, did_you_mean
from fg_calib.robot.model import Robot

_log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

SAME_READING = 1e-8
"""How far readings of one configuration in two tables may be apart, [rad] or [m]: what nine digits in degrees leave."""

MOST_LOOKED_AT = 100_000
"""Rows up to which copies are looked for."""

POINT_MODELS: tuple[Model, ...] = ("distance", "distance-rotation")
"""Models that use touched points."""


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
    _trigs: dict[Any, tuple[Floats, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """All but what follows from the rest."""
        return self.__dict__ | {"_trigs": {}}

    def trigs(self, robot: Robot) -> tuple[Floats, ...]:
        """Readings of each table for the kernels, remembered, as parameters change nothing of them."""
        key = (tuple(joint.prismatic for joint in robot.joints), robot.bases)
        if key not in self._trigs:
            self._trigs[key] = tuple(robot.trig(table.measurements.readings) for table in self.tables)
        return self._trigs[key]

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
    def fitted(self) -> Booleans:
        """Which configurations the train rows are of, shape (n_configurations,)."""
        found = np.zeros(self.n_configurations, dtype=np.bool_)
        for s in self.series:
            found[self.places[s.table][s.ends[s.train]]] = True
        return found

    @property
    def held_out(self) -> Booleans:
        """Which configurations have test rows and no train row, shape (n_configurations,)."""
        found = np.zeros(self.n_configurations, dtype=np.bool_)
        for s in self.series:
            found[self.places[s.table][s.ends[s.test]]] = True
        for table, place in zip(self.tables, self.places, strict=True):
            found[place[table.measurements.test]] = True
        return found & ~self.fitted

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
        return seen[first] & ~np.array(self.unknowns.known) if len(first) else np.zeros(0, dtype=np.bool_)


def gather(robot: Robot, tables: Sequence[Table], *, predicted: bool = False) -> Dataset:
    """All tables together.

    Where tables state ids, the same id is the same configuration.

    Args:
        robot: The nominal robot: unknowns are started where it says that they are.
        tables: The tables.
        predicted: Whether nothing of them was measured: what predicts the same is no measurement counted twice.

    Raises:
        ProblemError: A table lacks what its model needs, the noise of a joint is no figure of one, or two tables
            contradict each other.
    """
    unknowns, series = Unknowns(), list[Series]()
    places: list[Integers] = []
    names: list[str] = []
    found: dict[str, tuple[int, int]] = {}
    for number, table in enumerate(tables):
        m = table.measurements
        for before in () if predicted else tables[:number]:
            _check_once(table, before)
        if m.named:
            places.append(_places_of_named(number, tables, places, names, found))
        else:
            places.append(np.arange(len(names), len(names) + m.n_configurations))
            names += m.ids.tolist() if len(tables) == 1 else [f"{name} of {m.source}" for name in m.ids.tolist()]
        if not np.array_equal(m.sigma_joint, tables[0].measurements.sigma_joint):
            source = tables[0].measurements.source
            raise ProblemError(
                m.source, "another noise.joint", f"that of {source}: the readings are of the same encoders"
            )
        _check_joint_noise(robot, m)
        series += series_of(robot, table, number, unknowns)
    _check_known(tables)
    check_fitted(series, unknowns)
    start_places(robot, tables, series, unknowns)
    series = _without_untouched(series, unknowns.n_coordinates)
    return Dataset(tuple(tables), tuple(series), unknowns, tuple(places), (*names, *unknowns.names))


def _check_joint_noise(robot: Robot, m: Measurements) -> None:
    """Raise where the noise of a revolute joint's readings is so large that they say nothing."""
    for joint, sigma in zip(robot.joints, m.sigma_joint.tolist(), strict=False):  # their number is checked later
        if not joint.prismatic and sigma >= np.pi:
            found = f"noise.joint of {np.rad2deg(sigma):.4g} deg at {joint.name}"
            raise ProblemError(m.source, found, "less than half a turn", "is it in degrees?")


def _places_of_named(
    number: int,
    tables: Sequence[Table],
    places: list[Integers],
    names: list[str],
    found: dict[str, tuple[int, int]],
) -> Integers:
    """Numbers of a table's configurations: by their names those of earlier ones, or new ones, which are added.

    Args:
        number: Which table.
        tables: All of them.
        places: What this returned for those before.
        names: Of all configurations so far.
        found: Table and row where each name stood first.

    Raises:
        ProblemError: A name stands for two configurations.
    """
    m = tables[number].measurements
    place = np.empty(m.n_configurations, dtype=np.int64)
    for k, name in enumerate(m.ids.tolist()):
        other = found.get(name)
        if other is None:
            place[k], found[name] = len(names), (number, k)
            names.append(name)
            continue
        of_other = tables[other[0]].measurements
        if not np.allclose(m.readings[k], of_other.readings[other[1]], rtol=0.0, atol=SAME_READING):
            expected = f"those of {of_other.source}, or another id"
            raise ProblemError(m.source, f"other joint readings at id {name}", expected)
        place[k] = places[other[0]][other[1]] if other[0] < number else place[other[1]]
    return place


def check_repeats(table: Table) -> None:
    """Warn where measurements of a table are there twice, all figures the same.

    Honest repeats have other figures at the same readings; but what instruments round, or nothing disturbs, may repeat.
    """
    m, groups = table.measurements, table.measurements.groups
    if m.pairs is None or not table.uses_pairs:
        figures = [v.reshape(-1, n) for v, n in ((m.position, 3), (m.rotation, 9)) if v is not None]
        if figures:
            labels = [of.index[:, None] for of in m.labels.values()]
            rows = np.hstack([m.readings, *figures, m.test[:, None], *labels])
            _check_different(m.source, "poses", rows, lambda i: str(m.ids[i]))
    if m.pairs is not None and table.uses_pairs:
        _check_pairs_different(m.pairs, m.readings, m.ids)
    if groups is not None and table.uses_pairs:
        _check_pairs_different(groups.pairs, np.arange(groups.n_groups)[:, None], groups.names)


def _check_pairs_different(pairs: Pairs, places: Integers | Floats, names: Sequence[str] | NDArray[np.str_]) -> None:
    """Check that pairs differ, whichever end is a; one of the same place tells nothing and takes no part."""
    if pairs.n_pairs - np.sum(are_same(places, pairs.a, pairs.b)) > MOST_LOOKED_AT:
        return
    ends = np.stack([places[pairs.a], places[pairs.b]], axis=1).astype(np.float64)
    step = ends[:, 1] - ends[:, 0]
    first = np.argmax(step != 0.0, axis=1)[:, None]  # the figure that tells the ends apart
    sign = np.take_along_axis(step, first, axis=1)[:, 0]
    ends[sign < 0.0] = ends[sign < 0.0][:, ::-1]
    rows = np.hstack([ends[:, 0], ends[:, 1], np.stack([pairs.distance, pairs.angle, pairs.test], axis=1)])
    chosen = np.flatnonzero(sign != 0.0)
    ends_of = np.stack([pairs.a, pairs.b], axis=1)[chosen]
    _check_different(pairs.source, "pairs", rows[chosen], lambda i: "-".join(names[k] for k in ends_of[i]))


def _check_different(source: str, what: str, rows: Floats, called: Callable[[int], str]) -> None:
    """Warn where rows stand more than once; of very many that is not looked for."""
    if not 1 < len(rows) <= MOST_LOOKED_AT:
        return
    whole = np.ascontiguousarray(rows + 0.0)  # no -0
    keys = whole.view(np.dtype((np.void, whole.itemsize * whole.shape[1])))[:, 0]
    _, of, counts = np.unique(keys, return_inverse=True, return_counts=True)
    repeated = counts[of] > 1
    if not repeated.any():
        return
    row = int(np.argmax(repeated))
    first, second = (called(i) for i in np.flatnonzero(of == of[row])[:2].tolist())
    found = f"{int(np.sum(repeated))} of {len(rows)} {what} have the readings and figures of another"
    _log.warning(
        "%s: %s, as %s and %s; were they copied? They count as often", source, found, shown(first), shown(second)
    )


def _check_once(table: Table, other: Table) -> None:
    """Raise where two tables hold the same measurements: counted twice, they would look better than they are.

    They do where most figures of the smaller one stand in the other at the same readings, in whatever order. A few may
    do so by chance, where instruments round.
    """
    mine, others = _measured_by(table), _measured_by(other)
    for words in sorted(mine.keys() & others.keys()):
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
                found[name] = (m.readings, v.reshape(len(v), math.prod(v.shape[1:])))
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


def _check_known(tables: Sequence[Table]) -> None:
    """Names that no table has are told of; a name that was misspelt would be of something that is estimated.

    Raises:
        ProblemError: A name is much like one that a table has and nothing is known of.
    """
    for column, models in (("target", tuple(POSE_MODELS)), ("anchor", ("anchor",))):
        of_kind = [table for table in tables if table.model in models]
        seen = {name for t in of_kind if (labels := t.measurements.labels.get(column)) for name in labels.names}
        said = dict.fromkeys(name for table in of_kind for name in table.known)
        for name in said:
            if name in seen:
                continue
            hint = did_you_mean(name, seen - set(said), NEAR)
            found = f"no row is of {name!r}"
            if hint:
                raise ProblemError(f"{column}s", found, f"one of {', '.join(sorted(seen))}", hint)
            _log.warning("%ss: %s; it is not used", column, found)


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


def series_of(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """The series of a table.

    Args:
        robot: The nominal robot.
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
    found = [own_series(own, table, number, unknowns) for own in table.own]
    if table.model is not None:
        found += SERIES_OF[table.model](robot, table, number, unknowns)
    return found + touch_series(table, number, unknowns)
