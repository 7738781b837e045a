"""Description of an instrument: columns, landmarks with their start, what it measures and sees."""

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fg_calib import measurements
from fg_calib.initialization import FrameStart
from fg_calib.inputs import Booleans, Floats, ProblemError
from fg_calib.measurements import Kind, Labels, Landmark, LandmarkKind, Landmarks, MeasurementBlock, Measurements, Table
from fg_calib.robot import Poses

Blocks = Sequence[MeasurementBlock]
Kinds = Sequence[tuple[Kind, Booleans]]
"""Kinds of measurement, each with the rows that it has, shape (n_configurations,)."""

Places = Callable[[LandmarkKind, Sequence[str]], Any]
"""Coordinates of landmarks by kind and names, shape (n, size)."""


class Column(NamedTuple):
    """Columns of a table that mean something together, or one alone.

    Attributes:
        names: Their names.
        unit: `length`, `angle`, `pixel`, or empty of names and pure numbers.
        meaning: Meaning of the cells.
        generic: Whether the reader of tables puts them into `Measurements.columns` by their first name, and what
            `sigma_...` says of them into `sigmas`, as no field of `Measurements` is theirs.
    """

    names: tuple[str, ...]
    unit: str
    meaning: str
    generic: bool = False

    @property
    def si(self) -> str:
        """Unit in which `Measurements` holds it: `m`, `rad`, `px` or none."""
        return {"length": "m", "angle": "rad", "pixel": "px"}.get(self.unit, "")


LENGTH_COLUMNS = (
    Column(("distance",), "length", "To the anchor (0: contact), or from the plane (0 without)", generic=True),
    Column(("sigma_distance",), "length", "1 sigma of that"),
)


class Quantity(NamedTuple):
    """A quantity that an instrument measures at a configuration.

    Attributes:
        field: Field of `Measurements`, or column, that holds it.
        noise: Kind of its noise.
        columns: Its columns, for messages.
        words: Name in messages.
        shape: Of one measurement.
    """

    field: str
    noise: str
    columns: str
    words: str
    shape: tuple[int, ...] = ()


class Instrument:
    """An instrument: what a table of its model holds, and what it says of the arm.

    Attributes:
        model: Model of its tables.
        kind: Kind of its measurements, of one configuration; those with several kinds override `kinds`.
        quantities: The data of its kinds, in their order; its generic columns if empty.
        columns: Columns besides those of every table.
        labels: Columns of names: what a row is of.
        optional_labels: Columns among `labels` whose cells may be empty.
        noise: Keys of `noise` that it needs.
        landmarks: Kinds of landmarks that it depends on, in the order of its kinds' nuisances.
        options: Fields of `Table` that say something to it alone.
        words: Name of its measurements in reports.
        uses_pairs: Whether it measures between configurations.
        is_pose: Whether it measures the tool's pose, or part of it, in a measurement frame.
        sees_position: Whether its rows depend on where the tool point is.
        sees_orientation: Whether they depend on how the tool is rotated.
        sees_landmarks: Whether it measures from landmarks in the room: what it says is relative unless they are known.
        n_landmarks: Landmarks with which it shows all that it can see, where no table names them.
    """

    model: str
    words: str
    kind: ClassVar[Kind]
    quantities: tuple[Quantity, ...] = ()
    columns: ClassVar[tuple[Column, ...]] = ()
    labels: tuple[str, ...] = ()
    optional_labels: ClassVar[tuple[str, ...]] = ()
    noise: tuple[str, ...] = ()
    landmarks: tuple[LandmarkKind, ...] = ()
    options: tuple[str, ...] = ()
    uses_pairs: ClassVar[bool] = False
    is_pose: ClassVar[bool] = False
    sees_position: bool = True
    sees_orientation: bool = False
    sees_landmarks: ClassVar[bool] = False
    n_landmarks: ClassVar[int] = 3

    @property
    def generic_columns(self) -> tuple[str, ...]:
        """Names of the columns that `Measurements.columns` holds."""
        return tuple(column.names[0] for column in self.columns if column.generic)

    @property
    def key(self) -> str:
        """Key of a job that may say where its landmarks are; empty where none does."""
        return next((kind.key for kind in self.landmarks if kind.key), "")

    @property
    def measured(self) -> tuple[Quantity, ...]:
        """Measured quantities, or those of generic columns."""
        return self.quantities or tuple(Quantity(name, name, name, self.words) for name in self.generic_columns)

    def kinds(self, table: Table) -> Kinds:
        """Kinds of measurement, each with the rows that it has, shape (n_configurations,): those with a landmark.

        Raises:
            ProblemError: The table lacks something.
        """
        of = [self.names(table.measurements, kind).index >= 0 for kind in self.landmarks]
        return [(self.kind, np.all([np.ones(table.measurements.n_configurations, dtype=np.bool_), *of], axis=0))]

    def names(self, m: Measurements, kind: LandmarkKind) -> Labels:
        """Names of the landmarks of a kind, and which of them each row is of.

        Raises:
            ProblemError: A column that must say so is missing.
        """
        column, every = kind.label, np.zeros(m.n_configurations, dtype=np.int64)
        if column in m.labels and not kind.is_one:
            return m.labels[column]
        if kind.is_one or column not in self.optional_labels:
            return Labels((kind.of(m.source) if kind.is_one else kind.name,), every)
        if self.sees_landmarks:
            found, expected = f"no column {column}", f"the name of a {column} for model {self.model}"
            raise ProblemError(m.source, found, expected)
        return Labels((), every - 1)

    def landmark(self, table: Table, kind: LandmarkKind, name: str) -> Landmark:
        """A landmark as a table has it."""
        known = table.known.get(name) if kind.key else None
        if known is None:
            return Landmark(kind, name, np.full(kind.size, np.nan), known=kind.is_constant)
        return Landmark(kind, name, known.xyz, known.tolerance, known.tolerance is None)

    def values(self, table: Table) -> Floats:
        """Measured values, in the order of `measured`, shape (n_configurations, width).

        Raises:
            ProblemError: A column is missing.
        """
        m, found = table.measurements, []
        for of in self.measured:
            values = m.value(of.field)
            if values is None:
                words = f"no column{'s' * (',' in of.columns)} {of.columns}"
                raise ProblemError(m.source, words, f"{of.words} for model {self.model}")
            found.append(values.reshape(m.n_configurations, -1))
        return np.hstack(found)

    def sigma(self, m: Measurements, rows: Any) -> Floats:
        """1 sigma of rows, in the order of `measured`.

        Raises:
            ProblemError: The sigma is not specified.
        """
        found = []
        for of in self.measured:
            sigma = m.sigma(of.noise)
            if sigma is None or not np.isfinite(sigma[rows]).all():
                expected = f"noise.{of.noise} or a column sigma_{of.noise}"
                raise ProblemError(m.source, f"no sigma for {of.noise}", expected)
            found.append(sigma[rows].reshape(len(rows), -1))
        return np.hstack(found)

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Blocks of a table, kind by kind.

        Args:
            table: The table.
            number: Its number.
            landmarks: Landmarks, to which those of the blocks are added.

        Raises:
            ProblemError: A column or a sigma is missing.
        """
        m, found = table.measurements, []
        data, kinds = self.values(table), self.kinds(table)

        def add(kind: LandmarkKind, names: Sequence[str]) -> Any:
            new = [self.landmark(table, kind, name) for name in names]
            return landmarks.add(new, m.source, number if kind.is_one else -1)

        nuisances = self._nuisances(m, kinds, add).astype(np.int64)
        for kind, chosen in kinds:
            rows = np.flatnonzero(chosen & ~np.isnan(data).any(axis=1))
            if len(rows):
                fields: dict[str, Any] = {"test": m.test[rows], "source": m.source, **self.more(table, rows)}
                fields["nuisances"] = np.ascontiguousarray(nuisances[rows, : kind.n_nuisances])
                arrays = data[rows, : kind.width], self.sigma(m, rows)
                found.append(MeasurementBlock.of_rows(kind, number, rows, *arrays, **fields))
        return found

    def more(self, table: Table, rows: Any) -> dict[str, Any]:
        """Other fields of a block of rows of a table: what each is of, by name."""
        labels = table.measurements.labels.get(self.landmarks[0].label) if self.landmarks else None
        return {} if labels is None else {"of": labels.of(rows)}

    def _nuisances(self, m: Measurements, kinds: Kinds, of: Places) -> Floats:
        """Landmark coordinates of each row, by kind and names, shape (n_configurations, n_nuisances)."""
        found = [np.zeros((m.n_configurations, 0))]
        for kind in self.landmarks if any(kind.n_nuisances for kind, _ in kinds) else ():
            labels = self.names(m, kind)
            each = np.zeros((len(labels.names) + 1, kind.size))  # the last is of rows that are of none
            if labels.names:
                each[:-1] = of(kind, labels.names)
            found.append(each[labels.index])
        return np.hstack(found)

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """Measurements as tool frames and landmarks make them, without noise.

        Args:
            m: Configurations, and names of landmarks.
            poses: Tool frames in the base frame.
            places: Where the landmarks are.
        """
        kinds, n = self.kinds(Table(m, self.model)), m.n_configurations
        nuisances = self._nuisances(m, kinds, places)
        sizes = [math.prod(of.shape) for of in self.measured]
        data = np.zeros((n, sum(sizes)))
        for kind, chosen in (each for each in kinds if each[1].any()):
            rows = np.flatnonzero(chosen)
            at = measurements.Frames(poses.rotation[rows, None], poses.position[rows, None])
            data[rows, : kind.width] = kind.predict(at, nuisances[rows, : kind.n_nuisances])
        parts = np.split(data, np.cumsum(sizes)[:-1], axis=1) if sizes else []
        return m.with_values({of.field: v.reshape(n, *of.shape) for of, v in zip(self.measured, parts, strict=True)})

    def start_landmarks(self, blocks: Blocks, points: Sequence[Floats], landmarks: Landmarks) -> None:
        """Start landmarks that tool points and data say, of all tables of the instrument together.

        Args:
            blocks: The train rows of all its blocks.
            points: Tool points of each block at the nominal parameters, shape (n, 3), [m].
            landmarks: Where the starts are put.
        """

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """Start measurement frame, tool, and landmarks that depend on them.

        Args:
            start: Poses of the flange, and what is known so far; what is found is put there.
            table: A table of the instrument.
            blocks: Its blocks.
            landmarks: Which coordinates in `start.places` are of which.
        """

    def random_model(self, table: Table) -> str:
        """Model of what it would measure at random configurations: contacts and points in sight are none."""
        return self.model
