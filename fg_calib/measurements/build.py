"""All tables of a calibration together, as estimation takes them; and what a robot predicts that one would measure."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fg_calib.initialization import Frame, FrameStart
from fg_calib.inputs import NEAR, Booleans, Brief, Floats, InputError, Integers, ProblemError, did_you_mean
from fg_calib.measurements import Kind, Labels, LandmarkKind, Landmarks, MeasurementBlock, Measurements, Table, is_ours
from fg_calib.measurements.kinds import INSTRUMENTS, LANDMARKS
from fg_calib.measurements.kinds.contact import POINT
from fg_calib.robot import Robot, build_chain, forward

_log = logging.getLogger(__name__)


SAME_READING = 1e-8
"""How far readings of one configuration in two tables may be apart, [rad] or [m]: what nine digits in degrees leave."""

MOST_LOOKED_AT = 100_000
"""Rows up to which copies are looked for."""

ASSUMED_SIGMA = 1e-3
"""1 sigma of what none is specified for, [m] and [rad]."""


@dataclass(frozen=True)
class Dataset(Brief):
    """All tables of a calibration, as estimation takes them.

    Attributes:
        tables: The tables.
        blocks: Their measurements, kind by kind.
        landmarks: What the blocks depend on besides the arm.
        places: Of each table, its configurations among those of all tables, shape (n_configurations,) each.
        names: Name of each configuration, then of each landmark.
    """

    tables: tuple[Table, ...]
    blocks: tuple[MeasurementBlock, ...]
    landmarks: Landmarks
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
        return len(self.names) - len(self.landmarks.names)

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
        for s in self.blocks:
            found[self.places[s.table][s.ends[s.train]]] = True
        return found

    @property
    def held_out(self) -> Booleans:
        """Which configurations have test rows and no train row, shape (n_configurations,)."""
        found = np.zeros(self.n_configurations, dtype=np.bool_)
        for s in self.blocks:
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

    def n_train(self, chosen: Callable[[Kind], bool]) -> int:
        """Number of train measurements of the kinds chosen."""
        return sum(len(s.train) for s in self.blocks if chosen(s.kind))

    @property
    def source(self) -> str:
        """What the tables are called in messages."""
        return ", ".join(dict.fromkeys(table.measurements.source for table in self.tables))

    def estimated(self) -> Booleans:
        """Which landmarks a train measurement at a configuration depends on, shape (n_landmarks,)."""
        seen = np.zeros(self.landmarks.n_coordinates, dtype=np.bool_)
        for s in self.blocks:
            if s.kind.ends:
                seen[s.nuisances[s.train]] = True
        first = np.cumsum([0, *self.landmarks.sizes])[:-1]
        known = np.array([item.known for item in self.landmarks.items], dtype=np.bool_)
        return seen[first] & ~known if len(first) else known


def build_dataset(robot: Robot, tables: Sequence[Table], *, predicted: bool = False) -> Dataset:
    """All tables together.

    Where tables state ids, the same id is the same configuration.

    Args:
        robot: The nominal robot: landmarks are started where it says that they are.
        tables: The tables.
        predicted: Whether nothing of them was measured: what predicts the same is no measurement counted twice.

    Raises:
        ProblemError: A table lacks what its model needs, the noise of a joint is no figure of one, or two tables
            contradict each other.
    """
    landmarks, blocks = Landmarks(), list[MeasurementBlock]()
    places, names, index = list[Integers](), list[str](), dict[str, int]()
    for number, table in enumerate(tables):
        m, first = table.measurements, tables[0].measurements
        for before in () if predicted else tables[:number]:
            _check_once(table, before)
        if m.named:
            places.append(_places_of_named(m, names, index))
        else:
            places.append(np.arange(len(names), len(names) + m.n_configurations))
            names += m.ids.tolist() if len(tables) == 1 else [f"{name} of {m.source}" for name in m.ids.tolist()]
        if not np.array_equal(m.sigma_joint, first.sigma_joint):
            expected = f"that of {first.source}: the readings are of the same encoders"
            raise ProblemError(m.source, "another noise.joint", expected)
        _check_joint_noise(robot, m)
        blocks += blocks_of(table, number, landmarks)
    _check_same_readings(tables, places, len(names))
    _check_known(tables)
    _check_fitted(blocks, landmarks)
    _start_landmarks(robot, tables, blocks, landmarks)
    blocks = _predicted_alone(blocks, landmarks.n_coordinates)
    return Dataset(tuple(tables), tuple(blocks), landmarks, tuple(places), (*names, *landmarks.names))


def _check_joint_noise(robot: Robot, m: Measurements) -> None:
    """Raise where the noise of a revolute joint's readings is so large that they say nothing."""
    for joint, sigma in zip(robot.joints, m.sigma_joint.tolist(), strict=False):  # their number is checked later
        if not joint.prismatic and sigma >= np.pi:
            found = f"noise.joint of {np.rad2deg(sigma):.4g} deg at {joint.name}"
            raise ProblemError(m.source, found, "less than half a turn", "is it in degrees?")


def _places_of_named(m: Measurements, names: list[str], index: dict[str, int]) -> Integers:
    """Numbers of a table's configurations: by their names those of earlier ones, or new ones, which are added."""
    place = np.empty(m.n_configurations, dtype=np.int64)
    for k, name in enumerate(m.ids.tolist()):
        if name not in index:
            index[name] = len(names)
            names.append(name)
        place[k] = index[name]
    return place


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
        new, row = np.unique(place, return_index=True)
        new, row = new[there := np.isnan(readings[new, 0])], row[there]
        readings[new], origin[new] = m.readings[row], number
        off = np.abs(m.readings - readings[place]).max(axis=1) > SAME_READING
        if off.any():
            k = int(np.argmax(off))
            expected = f"those of {tables[origin[place[k]]].measurements.source}, or another id"
            raise ProblemError(m.source, f"other joint readings at id {m.ids[k]}", expected)


def warn_of_copies(table: Table) -> None:
    """Warn where measurements of a table are there twice, all figures the same.

    Honest repeats have other figures at the same readings; but what instruments round, or nothing disturbs, may repeat.
    """
    m = table.measurements
    if (m.n_configurations if m.pairs is None else m.pairs.n_pairs) > MOST_LOOKED_AT:
        return
    n, two, _ = find_copies(table)
    if n:
        found = f"{n} rows have the readings and figures of an earlier one, such as {two}"
        _log.warning("%s: %s; were they copied? They count as often", m.source, found)


def find_copies(table: Table) -> tuple[int, str, int]:
    """How many rows, or measured pairs, equal an earlier one, two names, and how many have its place but other values.

    Pairs count whichever end is a.
    """
    m, (ends, readings, figures) = table.measurements, _rows_of(table)
    of_rows = [of.index for of in m.labels.values()] + ([] if m.groups is None else [m.groups.index])
    columns = np.hstack([readings, *(index[ends] for index in of_rows)]) + 0.0  # no -0
    n_places = len(np.unique(columns, axis=0))
    if not figures:
        return 0, "", len(ends) - n_places
    test = np.any(m.test[ends], axis=1, keepdims=True)
    values = np.hstack([columns, *(np.nan_to_num(v, nan=-1e300) for v in figures.values()), test]) + 0.0
    first, of = np.unique(values, axis=0, return_index=True, return_inverse=True)[1:]
    before, two = first[of.ravel()], dict[str, None]()
    copied = np.flatnonzero(before != np.arange(len(ends)))
    for k in copied[:1]:
        two = dict.fromkeys("-".join(m.ids[ends[row]].tolist()) for row in (before[k], k))
    return len(copied), " and ".join(two), len(first) - n_places


def _rows_of(table: Table) -> tuple[Integers, Floats, dict[str, Floats]]:
    """Configurations of each row, or measured pair, of a table, readings there, and what takes part, by its noise."""
    m, pairs, instrument = table.measurements, table.measurements.pairs, INSTRUMENTS.get(table.model or "")
    ends = np.arange(m.n_configurations)[:, None]
    figures = {} if instrument is None else {of.noise: m.value(of.field) for of in instrument.measured}
    if instrument is not None and instrument.uses_pairs and pairs is not None:
        ends = np.sort(np.stack([pairs.a, pairs.b], axis=1), axis=1)
        figures = {name: getattr(pairs, name) for name in instrument.noise}
    found = {name: v.reshape(len(v), math.prod(v.shape[1:])) for name, v in figures.items() if v is not None}
    return ends, np.hstack([m.readings[k] for k in ends.T]), found


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
    m, (_, readings, figures) = table.measurements, _rows_of(table)
    found = {} if m.groups is None else {"touches": m.readings[m.groups.index >= 0]}
    if table.model is not None and not INSTRUMENTS[table.model].sees_landmarks:
        rows = {f"{name}s": np.hstack([readings, values]) for name, values in figures.items()}
        found |= {name: of[np.isfinite(of).all(axis=1)] for name, of in rows.items()}
    for own in table.own:
        ends = np.arange(m.n_configurations)[:, None] if own.ends is None else own.ends.reshape(len(own.data), -1)
        if len(ends) == len(own.data) and ends.max(initial=0) < m.n_configurations:
            at = m.readings[ends].reshape(len(own.data), -1)
            found[f"measurements of {type(own.kind).__name__}"] = np.hstack([at, own.data])
    return found


def _check_known(tables: Sequence[Table]) -> None:
    """Names that no table has are told of; a name that was misspelt would be of something that is estimated.

    Raises:
        ProblemError: A name is much like one that a table has and nothing is known of.
    """
    for column in (kind.name for kind in LANDMARKS.values() if kind.key):
        of_kind = [t for t in tables if t.model is not None and column in INSTRUMENTS[t.model].labels]
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


def _predicted_alone(blocks: Sequence[MeasurementBlock], n_coordinates: int) -> list[MeasurementBlock]:
    """The blocks; what is measured between landmarks of which no train row at a configuration is, is test rows."""
    touched = np.zeros(n_coordinates, dtype=np.bool_)
    for block in blocks:
        if block.kind.ends:
            touched[block.nuisances[~block.test]] = True
    return [
        block
        if block.kind.ends or not is_ours(block.kind)
        else replace(block, test=block.test | ~touched[block.nuisances].all(axis=1))
        for block in blocks
    ]


def blocks_of(table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
    """The blocks of a table.

    Args:
        table: The table.
        number: Its number.
        landmarks: What they depend on is added here.

    Raises:
        ProblemError: The table lacks what its model needs, or a sigma.
    """
    m, instrument = table.measurements, None if table.model is None else INSTRUMENTS[table.model]
    for name in ("offset", "camera", "fixed_camera"):
        if getattr(table, name) and (instrument is None or name not in instrument.options):
            models = " or ".join(model for model, other in INSTRUMENTS.items() if name in other.options)
            raise InputError(f"table: {name}", f"given with model {table.model}", f"model {models}")
    if m.groups is not None and (instrument is None or POINT not in instrument.landmarks):
        models = " or ".join(model for model, other in INSTRUMENTS.items() if POINT in other.landmarks)
        raise ProblemError(m.source, f"a column group with model {table.model}", f"model {models}")
    for k, own in enumerate(table.own):
        if any(own is before for before in table.own[:k]):
            raise ProblemError(m.source, "the same CustomMeasurements twice", "every measurement once")
    found = [own.block(table, number, landmarks) for own in table.own]
    return found + ([] if instrument is None else instrument.blocks(table, number, landmarks))


def _check_fitted(blocks: Sequence[MeasurementBlock], landmarks: Landmarks) -> None:
    """Raise where nothing but test rows says where something is.

    Args:
        blocks: All blocks.
        landmarks: What these depend on, as the tables say it.
    """
    fitted = np.zeros(landmarks.n_coordinates, dtype=np.bool_)
    for block in blocks:
        fitted[block.nuisances[~block.test]] = True
    for block in blocks:
        for i in np.unique(landmarks.owners[block.nuisances[~fitted[block.nuisances]]]).tolist():
            item = landmarks.items[i]
            if item.kind.must_be_fitted and not item.is_stated:
                name = item.name if item.kind.is_one else f"{item.kind.name} {item.name}"
                raise ProblemError(block.source, f"{name} has test rows alone", "train rows too, or its place as known")


def _start_landmarks(
    robot: Robot, tables: Sequence[Table], blocks: Sequence[MeasurementBlock], landmarks: Landmarks
) -> None:
    """Start landmarks that tool points of the nominal arm say, by the instrument that measured them."""
    for instrument in INSTRUMENTS.values():
        train = [b.select(np.flatnonzero(~b.test)) for b in blocks if tables[b.table].model == instrument.model
                 and b.kind.n_nuisances and is_ours(b.kind) and not b.test.all()]  # fmt: skip
        if train and instrument.sees_landmarks:
            chain = build_chain(robot)
            trigs = [robot.trig(tables[block.table].measurements.readings) for block in train]
            ends = [block.ends[:, 0] for block in train]
            points = [forward(chain, trig, rows).position for trig, rows in zip(trigs, ends, strict=True)]
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
    instruments = [None if table.model is None else INSTRUMENTS[table.model] for table in data.tables]
    says = [0 if i is None or not i.is_pose else i.sees_position + i.sees_orientation for i in instruments]
    for number in sorted(range(len(says)), key=lambda k: -says[k]):
        instrument, table = instruments[number], data.tables[number]
        if instrument is not None:
            flange = forward(chain, trigs[number])
            start.begin(number, table.unknown_frame, (flange.rotation, flange.position))
            blocks = [block for block in data.blocks if block.table == number]
            instrument.start_frames(start, table, blocks, data.landmarks)
    return start


def predict_measurements(robot: Robot, m: Measurements, model: str) -> Measurements:
    """Measurements of a model at configurations, without noise, all of them train rows.

    Landmarks stand where they say something, at some distance from what the arm reaches.

    Args:
        robot: The robot.
        m: The configurations, the noise, and the names of landmarks; measured values are not looked at.
        model: Which measurements take part.
    """
    train = np.flatnonzero(~m.test)
    poses, n = forward(build_chain(robot), robot.trig(m.readings[train])), len(train)
    instrument = INSTRUMENTS[model]

    def specified(noise: str, *axes: int) -> Floats:
        sigma = m.sigma(noise)
        return np.full((n, *axes), ASSUMED_SIGMA) if sigma is None else sigma[train]

    labels = {}
    for column in instrument.labels if instrument.sees_landmarks else ():
        names = tuple(f"{column} {i + 1}" for i in range(instrument.n_landmarks))
        found = m.labels.get(column)
        labels[column] = Labels(names, np.arange(n) % len(names)) if found is None else found.of(train)
    exact = Measurements(
        readings=m.readings[train],
        ids=np.arange(n).astype(str),
        test=np.zeros(n, dtype=np.bool_),
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=specified("position", 3),
        sigma_orientation=specified("orientation", 3),
        sigma_joint=m.sigma_joint,
        source="predictions",
        labels=labels,
        sigma_length=specified("distance"),
        sigmas={name: specified(name) for name in instrument.generic_columns},
    )
    if not n:
        return exact
    middle = poses.position.mean(axis=0)
    reach = max(1e-3, float(np.linalg.norm(poses.position - middle, axis=1).max()))

    def place(kind: LandmarkKind, name: str) -> Floats:
        names = instrument.names(exact, kind).names
        found: Floats = kind.default_places(len(names), middle, reach)[names.index(name)]
        return found

    return instrument.predict(exact, poses, place)
