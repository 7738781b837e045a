"""What an instrument says of itself: columns, landmarks with their start, what it measures and sees."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np

from fg_calib.initialization import FrameStart
from fg_calib.inputs import Floats, Integers, ProblemError
from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.measurements.kind import Frames, Kind
from fg_calib.measurements.landmarks import LandmarkKind, Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table
from fg_calib.robot import Poses

Blocks = Sequence[MeasurementBlock]
Places = Callable[[LandmarkKind, str], Floats]
"""Coordinates of a landmark, by its kind and name."""


class Column(NamedTuple):
    """Columns of a table that mean something together, or one alone.

    Attributes:
        names: Their names.
        unit: `length`, `angle`, `pixel`, or empty of names and pure numbers.
        meaning: What they are.
        generic: Whether the reader of tables puts them into `Measurements.columns` (of `sigma_...` into `sigmas`) by
            their first name, as no field of `Measurements` is theirs.
    """

    names: tuple[str, ...]
    unit: str
    meaning: str
    generic: bool = False

    @property
    def si(self) -> str:
        """Unit in which `Measurements` holds it: `m`, `rad`, `px` or none."""
        return {"length": "m", "angle": "rad", "pixel": "px"}.get(self.unit, "")


class Instrument(ABC):
    """An instrument: what a table of its model holds, and what it says of the arm.

    Attributes:
        model: Model of its tables.
        columns: Columns beside those of every table.
        labels: Those of names: what a row is of.
        optional_labels: Those of `labels` whose cells may be empty.
        noise: Keys of `noise` that it needs.
        landmarks: What it depends on besides the arm.
        options: Fields of `Table` that say something to it alone.
        words: What it measures, for reports.
        uses_pairs: Whether it measures between configurations.
        is_pose: Whether it measures the tool's pose, or part of it, in a measurement frame.
        sees_position: Whether its rows depend on where the tool point is.
        sees_orientation: Whether they depend on how the tool is turned.
        sees_landmarks: Whether it measures from landmarks in the room: what it says is relative unless they are known.
        n_landmarks: Landmarks with which it shows all that it can see, where no table names them.
    """

    model: str
    words: str
    columns: ClassVar[tuple[Column, ...]] = ()
    labels: ClassVar[tuple[str, ...]] = ()
    optional_labels: ClassVar[tuple[str, ...]] = ()
    noise: tuple[str, ...] = ()
    landmarks: ClassVar[tuple[LandmarkKind, ...]] = ()
    options: ClassVar[tuple[str, ...]] = ()
    uses_pairs: ClassVar[bool] = False
    is_pose: ClassVar[bool] = False
    sees_position: bool = True
    sees_orientation: bool = False
    sees_landmarks: ClassVar[bool] = False
    n_landmarks: ClassVar[int] = 3

    @property
    def generic_columns(self) -> tuple[str, ...]:
        """Names of the columns that `Measurements.columns` holds."""
        return tuple(c.names[0] for c in self.columns if c.generic and not c.names[0].startswith("sigma_"))

    @abstractmethod
    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Blocks of a table, kind by kind.

        Args:
            table: The table.
            number: Its number.
            landmarks: What they depend on is added here.

        Raises:
            ProblemError: A column or a sigma is missing.
        """

    def start_landmarks(self, blocks: Blocks, points: Sequence[Floats], landmarks: Landmarks) -> None:  # noqa: B027
        """Start landmarks that tool points and data say, of all tables of the instrument together.

        Args:
            blocks: The train rows of all its blocks.
            points: Tool points of each block at the nominal parameters, shape (n, 3), [m].
            landmarks: Where the starts are put.
        """

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:  # noqa: B027
        """Start measurement frame, tool, and landmarks that depend on them.

        Args:
            start: Poses of the flange, and what is known so far; what is found is put there.
            table: A table of the instrument.
            blocks: Its blocks.
            landmarks: Which coordinates in `start.places` are of which.
        """

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """Measurements as tool frames and landmarks make them, without noise.

        Args:
            m: Configurations with the poses as measured, and names of landmarks.
            poses: Tool frames in the base frame.
            places: Where the landmarks are.
        """
        return m

    def random_model(self, table: Table) -> str:
        """Model of what it would measure at random configurations: contacts and points in sight are none."""
        return self.model

    def default_places(self, names: Sequence[str], middle: Floats, reach: float) -> dict[tuple[str, str], Floats]:
        """Places of landmarks where nothing is measured yet, by letter and name.

        Args:
            names: What they are called.
            middle: Of the tool points, shape (3,), [m].
            reach: How far these are from there, [m].
        """
        return {}

    def require_labels(self, table: Table, column: str) -> Labels:
        """What each row is of, by the column of that name.

        Raises:
            ProblemError: There is no such column.
        """
        labels = table.measurements.labels.get(column)
        if labels is None:
            found, expected = f"no column {column}", f"the name of a {column} for model {self.model}"
            raise ProblemError(table.measurements.source, found, expected)
        return labels

    def require(self, table: Table, values: Floats | None, columns: str, what: str) -> Floats:
        """What was measured.

        Raises:
            ProblemError: It was not.
        """
        if values is None:
            found = f"no column{'s' * (',' in columns)} {columns}"
            raise ProblemError(table.measurements.source, found, f"{what} for model {self.model}")
        return values

    def require_sigma(self, table: Table, sigma: Floats | None, noise: str, rows: Integers) -> Floats:
        """1 sigma of rows of a table.

        Raises:
            ProblemError: It is not specified.
        """
        if sigma is None or not np.isfinite(sigma[rows]).all():
            expected = f"noise.{noise} or a column sigma_{noise}"
            raise ProblemError(table.measurements.source, f"no sigma for {noise}", expected)
        return sigma[rows]


class ColumnInstrument(Instrument):
    """An instrument with one kind, one generic column and no landmarks; an empty cell is not measured.

    Attributes:
        kind: What it measures, one number of one configuration.
    """

    kind: Kind

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """See `Instrument.blocks`."""
        m, (name,) = table.measurements, self.generic_columns
        values = self.require(table, m.columns.get(name), name, self.words)
        rows = np.flatnonzero(np.isfinite(values))
        sigma = self.require_sigma(table, m.sigmas.get(name), name, rows)
        return [MeasurementBlock.of_rows(self.kind, table, number, rows, values[rows, None], sigma[:, None])]

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """See `Instrument.predict`."""
        n, (name,) = len(poses.position), self.generic_columns
        at = Frames(poses.rotation[:, None], poses.position[:, None])
        values = self.kind.simulate(at, np.zeros((n, 1)), np.zeros((n, 0)), np.zeros((n, 1)))
        return replace(m, columns={name: values[:, 0]})


def add_points(landmarks: Landmarks, kind: LandmarkKind, table: Table, names: Sequence[str]) -> Integers:
    """Add points by name, where the table says that they are; their coordinates, shape (n, 3)."""
    known, nowhere = [table.known.get(name) for name in names], np.full(3, np.nan)
    return landmarks.add(
        kind,
        names,
        np.array([nowhere if k is None else k.xyz for k in known]).reshape(-1, 3),
        table.measurements.source,
        tolerances=[None if k is None else k.tolerance for k in known],
        known=[k is not None and k.tolerance is None for k in known],
    )


def places_of_rows(places: Places, kind: LandmarkKind, labels: Labels) -> Floats:
    """Coordinates of each row's landmark, shape (n, size)."""
    return np.array([places(kind, name) for name in labels.names])[labels.index]
