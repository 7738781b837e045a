"""All tables of a calibration together, as estimation takes them; and what a robot predicts that one would measure."""

import logging
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from fg_calib.initialization import Frame, FrameStart
from fg_calib.inputs import NEAR, Booleans, Brief, Floats, Integers, ProblemError, did_you_mean
from fg_calib.measurements import Labels, Landmarks, MeasurementBlock, Measurements, Table, is_ours
from fg_calib.measurements.kinds import INSTRUMENTS, LANDMARKS
from fg_calib.robot import Context, Robot, build_chain, forward

_log = logging.getLogger(__name__)


SAME_READING = 1e-8
"""How far readings of one configuration in two tables may be apart, [rad] or [m]: what nine digits in degrees leave."""

MOST_LOOKED_AT = 100_000
"""Rows up to which copies are looked for."""

ASSUMED_SIGMA = 1e-3
"""1 sigma of what none is specified for, [m] and [rad]."""


class Dataset(Brief):
    """All tables of a calibration, as estimation takes them.

    Attributes:
        tables: The tables.
        blocks: Their measurements, kind by kind.
        landmarks: Landmarks that the blocks depend on.
        places: Of each table, its configurations among those of all tables, shape (n_configurations,) each.
        names: Name of each configuration, then of each landmark.
    """

    tables: tuple[Table, ...]
    blocks: tuple[MeasurementBlock, ...]
    landmarks: Landmarks
    places: tuple[Integers, ...]
    names: tuple[str, ...]
    _trigs: dict[Any, tuple[Floats, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def trigs(self, robot: Robot, values: Floats | None = None) -> tuple[Floats, ...]:
        """Readings of each table for the kernels, remembered.

        Args:
            robot: The robot.
            values: A vector that begins with values of its parameters, by which loads are found; nominal if None.
        """
        at = robot.nominal if values is None else values[: len(robot.parameters)]
        key = (tuple(joint.prismatic for joint in robot.joints), robot.effects, at[robot.loads].tobytes())
        if (found := self._trigs.get(key)) is None:  # of several threads each returns what it found or made itself
            if robot.loads:
                self._trigs.clear()
            each = [table.measurements for table in self.tables]
            found = self._trigs[key] = tuple(robot.trig(m.readings, m.context, values) for m in each)
        return found

    @property
    def n_configurations(self) -> int:
        """Number of different configurations."""
        return len(self.names) - len(self.landmarks.names)

    @property
    def readings(self) -> Floats:
        """Joint readings of every configuration, shape (n_configurations, n_joints)."""
        out = np.empty((self.n_configurations, self.tables[0].measurements.readings.shape[1]))
        for table, place in zip(self.tables, self.places, strict=True):
            out[place] = table.measurements.readings
        return out

    @property
    def context(self) -> Context:
        """What effects depend on besides readings, of every configuration."""
        out = dict[str, Floats]()
        for table, place in zip(self.tables, self.places, strict=True):
            for name, values in table.measurements.context.items():
                out.setdefault(name, np.full((self.n_configurations, *values.shape[1:]), np.nan))[place] = values
        return out

    def _at(self, rows: Callable[[MeasurementBlock], Integers | Booleans]) -> Booleans:
        """Which configurations some rows of the blocks are of, shape (n_configurations,)."""
        found = np.zeros(self.n_configurations, dtype=np.bool_)
        for s in self.blocks:
            found[self.places[s.table][s.ends[rows(s)]]] = True
        return found

    @property
    def fitted(self) -> Booleans:
        """Which configurations the train rows are of, shape (n_configurations,)."""
        return self._at(lambda s: s.train)

    @property
    def held_out(self) -> Booleans:
        """Which configurations have test rows and no train row, shape (n_configurations,)."""
        found = self._at(lambda s: s.test)
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
    def source(self) -> str:
        """Name of the tables in messages."""
        return ", ".join(dict.fromkeys(table.measurements.source for table in self.tables))

    def estimated(self) -> Booleans:
        """Which landmarks a train measurement at a configuration depends on, shape (n_landmarks,)."""
        first = np.cumsum([0, *self.landmarks.sizes])[:-1].astype(np.int64)
        known = np.array([item.known for item in self.landmarks.items], dtype=np.bool_)
        return _touched(self.blocks, self.landmarks)[first] & ~known


def build_dataset(robot: Robot, tables: Sequence[Table]) -> Dataset:
    """All tables together.

    Where tables state ids, the same id is the same configuration.

    Args:
        robot: The nominal robot: landmarks are started where it says that they are.
        tables: The tables.

    Raises:
        ProblemError: A table lacks what its model needs, the noise of a joint is no figure of one, or two tables
            contradict each other.
    """
    landmarks, blocks, first = Landmarks(), list[MeasurementBlock](), tables[0].measurements
    places, names, index = list[Integers](), list[str](), dict[str, int]()
    for number, table in enumerate(tables):
        m = table.measurements
        if m.named:
            new = [name for name in dict.fromkeys(m.ids.tolist()) if name not in index]
            index |= {name: len(names) + k for k, name in enumerate(new)}
            names += new
            places.append(np.array([index[name] for name in m.ids.tolist()], dtype=np.int64))
        else:
            places.append(np.arange(len(names), len(names) + m.n_configurations))
            names += m.ids.tolist() if len(tables) == 1 else [f"{name} of {m.source}" for name in m.ids.tolist()]
        if not np.array_equal(m.sigma_joint, first.sigma_joint):
            expected = f"that of {first.source}: the readings are of the same encoders"
            raise ProblemError(m.source, "another noise.joint", expected)
        for joint, sigma in zip(robot.joints, m.sigma_joint.tolist(), strict=False):  # their number is checked later
            if not joint.prismatic and sigma >= np.pi:
                found = f"noise.joint of {np.rad2deg(sigma):.4g} deg at {joint.name}"
                raise ProblemError(m.source, found, "less than half a turn", "is it in degrees?")
        blocks += blocks_of(table, number, landmarks)
    _check_same_readings(tables, places, len(names))
    _check_known(tables)
    touched = _touched(blocks, landmarks)  # what is between landmarks that no train row is of is a test row
    blocks = [
        b if b.kind.ends or not is_ours(b.kind) else replace(b, test=b.test | ~touched[b.nuisances].all(axis=1))
        for b in blocks
    ]
    _check_fitted(blocks, landmarks)
    _start_landmarks(robot, tables, blocks, landmarks)
    return Dataset(tuple(tables), tuple(blocks), landmarks, tuple(places), (*names, *landmarks.names))


def _check_same_readings(tables: Sequence[Table], places: Sequence[Integers], n: int) -> None:
    """Raise where a name stands for two configurations.

    Args:
        tables: The tables.
        places: Number of each row's configuration, by table.
        n: Number of configurations.
    """
    readings, origin = np.full((n, tables[0].measurements.readings.shape[1]), np.nan), np.zeros(n, dtype=np.int64)
    for number, (table, place) in enumerate(zip(tables, places, strict=True)):
        m = table.measurements
        new = np.isnan(readings[place, 0])
        readings[place[new]], origin[place[new]] = m.readings[new], number
        off = np.abs(m.readings - readings[place]).max(axis=1) > SAME_READING
        if off.any():
            k = int(np.argmax(off))
            expected = f"those of {tables[origin[place[k]]].measurements.source}, or another id"
            raise ProblemError(m.source, f"other joint readings at id {m.ids[k]}", expected)


def check_copies(tables: Sequence[Table]) -> None:
    """Warn of rows of a table that repeat others, and raise where two tables, or targets, have the same measurements.

    Honest repeats have other values at the same readings; but what instruments round, or nothing disturbs, may repeat:
    two are the same where most values of the smaller one stand in the other at the same readings.
    """
    for table in tables:
        m = table.measurements
        if (m.n_configurations if m.pairs is None else m.pairs.n_pairs) > MOST_LOOKED_AT:
            continue
        n, two, _ = find_copies(table)
        if n:
            found = f"{n} rows have the readings and figures of an earlier one, such as {two}"
            _log.warning("%s: %s; were they copied? They count as often", m.source, found)
        ends, values = _rows_of(table)
        for column, of in m.labels.items() if ends.shape[1] == 1 else ():
            each = [(f"{m.source}: {column} {name}", of.index == k) for k, name in enumerate(of.names)]
            vary = [of for of in values.items() if np.ptp(of[1][:, m.readings.shape[1] :])]  # not of a ball in a corner
            _check_different([(name, noise, rows[mine]) for name, mine in each for noise, rows in vary])
    if len(tables) > 1:
        _check_different([(t.measurements.source, *of) for t in tables for of in _rows_of(t)[1].items()])


def _check_different(sets: Sequence[tuple[str, str, Floats]]) -> None:
    """Raise where most rows of a set stand in an earlier one; each has a name and a kind of noise."""
    met, sizes = dict[tuple[str, bytes], int](), list[int]()
    for name, noise, rows in sets:
        mine = {(noise, row.tobytes()) for row in np.round(rows[np.isfinite(rows).all(axis=1)], 9) + 0.0}
        for k, n in Counter(met.get(row, -1) for row in mine).items():
            if k >= 0 and 2 * n > min(len(mine), sizes[k]):
                raise ProblemError(name, f"the same {noise}s as in {sets[k][0]}", "every measurement once")
        for row in mine:
            met.setdefault(row, len(sizes))
        sizes.append(len(mine))


def find_copies(table: Table) -> tuple[int, str, int]:
    """How many rows, or measured pairs, equal an earlier one, two names, and how many have its place but other values.

    Pairs count whichever end is a.
    """
    m, (ends, figures) = table.measurements, _rows_of(table)
    own = [of.index for of in (*m.labels.values(), m.groups) if of] + ([] if m.image is None else [*m.image[:, 2:].T])
    at = np.hstack([*(m.readings[k] for k in ends.T), *(index[ends] for index in own)]) + 0.0  # no -0
    n_places = len({row.tobytes() for row in at})
    if not figures or n_places == len(ends):
        return 0, "", len(ends) - n_places
    rows = np.hstack([at, *figures.values(), np.any(m.test[ends], axis=1, keepdims=True)]) + 0.0
    first: dict[bytes, int] = {}
    before = [first.setdefault(row.tobytes(), k) for k, row in enumerate(rows)]
    copied = [k for k, earlier in enumerate(before) if earlier != k]
    two = dict.fromkeys("-".join(m.ids[ends[row]].tolist()) for k in copied[:1] for row in (before[k], k))
    return len(copied), " and ".join(two), len(first) - n_places


def _rows_of(table: Table) -> tuple[Integers, dict[str, Floats]]:
    """Configurations of each row, or measured pair, of a table; by noise, readings there and what was measured."""
    m, pairs, instrument = table.measurements, table.measurements.pairs, INSTRUMENTS.get(table.model or "")
    ends = np.arange(m.n_configurations)[:, None]
    values = {} if instrument is None else {of.noise: m.value(of.field) for of in instrument.measured}
    if instrument is not None and instrument.uses_pairs and pairs is not None:
        ends = np.sort(np.stack([pairs.a, pairs.b], axis=1), axis=1)
        values = {name: getattr(pairs, name) for name in instrument.noise}
    at = np.hstack([m.readings[k] for k in ends.T])
    rows = {name: v.reshape(len(at), math.prod(v.shape[1:])) for name, v in values.items() if v is not None}
    return ends, {name: np.hstack([at, v]) for name, v in rows.items()}


def _check_known(tables: Sequence[Table]) -> None:
    """Warn of known places of names that no table has.

    Raises:
        ProblemError: A name is much like one that a table has and nothing is known of.
    """
    for column in (kind.name for kind in LANDMARKS.values() if kind.key):
        of_kind = [t for t in tables if t.model is not None and column in INSTRUMENTS[t.model].labels]
        seen = {name for t in of_kind if (labels := t.measurements.labels.get(column)) for name in labels.names}
        known = dict.fromkeys(name for table in of_kind for name in table.known)
        for name in (name for name in known if name not in seen):
            found = f"no row is of {name!r}"
            if hint := did_you_mean(name, seen - set(known), NEAR):
                raise ProblemError(f"{column}s", found, f"one of {', '.join(sorted(seen))}", hint)
            _log.warning("%ss: %s; it is not used", column, found)


def blocks_of(table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
    """The blocks of a table.

    Args:
        table: The table.
        number: Its number.
        landmarks: Landmarks, to which those of the blocks are added.

    Raises:
        ProblemError: The table lacks what its model needs, or a sigma.
    """
    m, instrument = table.measurements, INSTRUMENTS.get(table.model or "")
    given = {"offset": table.offset, "camera": table.camera, "fixed_camera": table.fixed_camera, "group": m.groups}
    for name in (name for name, value in given.items() if value not in (None, False)):
        if instrument is None or name not in instrument.options:
            models = " or ".join(model for model, other in INSTRUMENTS.items() if name in other.options)
            raise ProblemError(m.source, f"{name} with model {table.model}", f"model {models}")
    if len({id(own) for own in table.own}) < len(table.own):
        raise ProblemError(m.source, "the same CustomMeasurements twice", "every measurement once")
    found = [own.block(table, number, landmarks) for own in table.own]
    return found + ([] if instrument is None else instrument.blocks(table, number, landmarks))


def _touched(blocks: Sequence[MeasurementBlock], landmarks: Landmarks) -> Booleans:
    """Coordinates of landmarks on which a train measurement at a configuration depends, shape (n_coordinates,)."""
    touched = np.zeros(landmarks.n_coordinates, dtype=np.bool_)
    for block in blocks:
        if block.kind.ends:
            touched[block.nuisances[block.train]] = True
    return touched


def _check_fitted(blocks: Sequence[MeasurementBlock], landmarks: Landmarks) -> None:
    """Raise where nothing but test rows depends on a landmark of unknown place."""
    touched = _touched(blocks, landmarks)
    for block in blocks:
        coordinates = block.nuisances[~touched[block.nuisances]]
        for item in (landmarks.items[i] for i in np.unique(landmarks.owners[coordinates]).tolist()):
            if item.kind.must_be_fitted and not item.is_specified:
                name = item.name if item.kind.is_one else f"{item.kind.name} {item.name}"
                raise ProblemError(block.source, f"{name} has test rows alone", "train rows too, or its place as known")


def _start_landmarks(
    robot: Robot, tables: Sequence[Table], blocks: Sequence[MeasurementBlock], landmarks: Landmarks
) -> None:
    """Start landmarks that tool points of the nominal arm say, by the instrument that measured them."""
    for instrument in (one for one in INSTRUMENTS.values() if one.sees_landmarks):
        train = [b.select(np.flatnonzero(~b.test)) for b in blocks if tables[b.table].model == instrument.model
                 and b.kind.n_nuisances and is_ours(b.kind) and not b.test.all()]  # fmt: skip
        readings = [tables[b.table].measurements.readings[b.ends[:, 0]] for b in train]
        points = [forward(build_chain(robot), robot.trig(q)).position for q in readings]
        if train:
            instrument.start_landmarks(train, points, landmarks)


def start_frames(robot: Robot, data: Dataset, tool: Frame, free: Booleans) -> FrameStart:
    """Start frames, tool and landmarks by closed forms, table by table, poses first.

    Args:
        robot: The robot, without its tool.
        data: The tables.
        tool: flange_T_tool at the nominal parameters.
        free: Which of its parameters are estimated, translation first, shape (6,).

    Raises:
        ProblemError: No image shows enough of a board.
    """
    start = FrameStart(tool, free, data.landmarks.start)
    chain, trigs = build_chain(robot), data.trigs(robot)
    of_model = [(n, table, INSTRUMENTS[table.model]) for n, table in enumerate(data.tables) if table.model is not None]
    of_model = sorted(of_model, key=lambda of: -of[2].is_pose * (of[2].sees_position + of[2].sees_orientation))
    for number, table, one in of_model:
        flange = forward(chain, trigs[number])
        start.begin(number, table.unknown_frame, (flange.rotation, flange.position))
        one.start_frames(start, table, [block for block in data.blocks if block.table == number], data.landmarks)
    return start


def predict_measurements(robot: Robot, m: Measurements, model: str) -> Measurements:
    """Measurements of a model at configurations, without noise, all of them train rows.

    Landmarks stand where they say something, at some distance from what the arm reaches.

    Args:
        robot: The robot.
        m: The configurations, the noise, and the names of landmarks; measured values are not looked at.
        model: Which measurements take part.
    """
    instrument, train = INSTRUMENTS[model], np.flatnonzero(~m.test)
    poses, n = forward(build_chain(robot), robot.trig(m.readings[train])), len(train)

    def specified(noise: str, *axes: int) -> Floats:
        sigma = m.sigma(noise)
        return np.full((n, *axes), ASSUMED_SIGMA) if sigma is None else sigma[train]

    labels = {}
    for column in instrument.labels if instrument.sees_landmarks else ():
        names = tuple(f"{column} {i + 1}" for i in range(instrument.n_landmarks))
        found = m.labels.get(column)
        labels[column] = Labels(names, np.arange(n) % len(names)) if found is None else found.of(train)
    sigmas = {name: specified(name) for name in instrument.generic_columns}
    exact = replace(m.select(train), position=poses.position, rotation=poses.rotation, labels=labels, sigmas=sigmas)
    exact = replace(exact, sigma_position=specified("position", 3), sigma_orientation=specified("orientation", 3))
    exact = replace(exact, covariance=None, source="predictions")
    if not n:
        return exact
    middle = poses.position.mean(axis=0)
    reach = max(1e-3, float(np.linalg.norm(poses.position - middle, axis=1).max()))
    return instrument.predict(exact, poses, lambda kind, names: kind.default_places(len(names), middle, reach))
