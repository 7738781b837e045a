"""Landmarks: what measurements depend on besides the arm, such as targets on the tool, anchors, planes and boards."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Floats, Integers, ProblemError, Record

Estimate = tuple[Floats, Floats, tuple[str, ...]]
"""Values as reports show them, their covariance, and their units."""


class LandmarkKind(Record):
    """A kind of landmark; its instrument's file declares it.

    Attributes:
        letter: Letter of its GTSAM symbols, and of its name in `result.json`.
        name: Name of one: `target`, `anchor`.
        heading: Of its table in reports, with frame and unit; empty where reports do not show it.
        description: Name of all where they explain a null-space direction; "the unknown targets" if empty.
        units: `m` or `rad` of each coordinate.
        key: Key of a job that may say where they are; empty where none does.
        column: Of a table, whose names they have; that called like the kind if empty.
        away: How far they stand from the middle of the tool points where nothing is measured yet, in their reach.
        is_constant: Whether its coordinates are never estimated.
        n_configurations: Configurations that must remain to determine one, in cross-validation.
        must_be_fitted: Whether a train row must say where one is, unless the job does.
        stays: Whether it is where it was at the next calibration: a target on the tool, say.
        is_one: Whether a table has one at most, whose name says enough.
        reference: Kind of the constants that its coordinates are relative to, of the same names; None if none.
        estimate: Values as reports show them, from the reference's coordinates, its own, and their covariance; None
            where its coordinates are shown as they are.
    """

    letter: str
    name: str
    heading: str
    description: str = ""
    units: tuple[str, ...] = ("m", "m", "m")
    key: str = ""
    column: str = ""
    away: float = 0.0
    is_constant: bool = False
    n_configurations: int = 1
    must_be_fitted: bool = True
    stays: bool = False
    is_one: bool = False
    reference: "LandmarkKind | None" = None
    estimate: Callable[[Floats, Floats, Floats], Estimate] | None = None

    @property
    def label(self) -> str:
        """Column of a table whose names they have."""
        return self.column or self.name

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.units)

    def of(self, source: str) -> str:
        """Name of the one of a table, of a kind of which a table has one at most."""
        return f"{self.name} of {source}"

    def default_places(self, n: int, middle: Floats, reach: float) -> Floats:
        """Coordinates of n landmarks where nothing is measured yet, shape (n, size); 0 where that says as much.

        Args:
            n: How many there are.
            middle: Of the tool points, shape (3,), [m].
            reach: How far these are from there, [m].
        """
        if not self.away:
            return np.zeros((n, self.size))
        places = middle + self.away * reach * Rotation.random(n, random_state=0).as_matrix()[:, :, 2]
        rotated = Rotation.random(n, random_state=np.random.default_rng(0).integers(1000)).as_rotvec()
        return places[:, : self.size] if self.size <= 3 else np.hstack([rotated, places])


class Landmark(Record):
    """A landmark.

    Attributes:
        kind: Kind of landmark.
        name: Its name.
        start: Where it is started, or is said to be, shape (size,); nan where the measurements are to say it.
        tolerance: 1 sigma of where it is said to be; None where its start says nothing.
        known: Whether it is where it is said to be, and not estimated.
    """

    kind: LandmarkKind
    name: str
    start: Floats
    tolerance: float | None = None
    known: bool = False

    @property
    def is_specified(self) -> bool:
        """Whether a table says where it is, or is started."""
        return not bool(np.isnan(self.start).any())

    @property
    def units(self) -> tuple[str, ...]:
        """`m` or `rad` of each coordinate."""
        return self.kind.units if len(self.start) == self.kind.size else ("m",) * len(self.start)

    def __str__(self) -> str:
        return f"{self.start.tolist()}{'' if self.tolerance is None else f' within {self.tolerance:g}'}"


class Landmarks:
    """The landmarks that measurements depend on; their coordinates are numbered one after the other.

    Attributes:
        items: The landmarks.
    """

    def __init__(self) -> None:
        self.items: list[Landmark] = []
        self._index: dict[tuple[str, str, int], int] = {}
        self._first: list[int] = [0]

    @property
    def names(self) -> list[str]:
        """Name of each."""
        return [item.name for item in self.items]

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Letter and name of each."""
        return [(item.kind.letter, item.name) for item in self.items]

    @property
    def sizes(self) -> list[int]:
        """Number of coordinates of each."""
        return [len(item.start) for item in self.items]

    @property
    def start(self) -> Floats:
        """Start of all coordinates, shape (n_coordinates,); nan where the measurements are to say it."""
        return np.concatenate([np.zeros(0), *(item.start for item in self.items)])

    @property
    def n_coordinates(self) -> int:
        """Number of all landmarks' coordinates."""
        return self._first[-1]

    @property
    def owners(self) -> Integers:
        """Which landmark each coordinate is of, shape (n_coordinates,)."""
        return np.repeat(np.arange(len(self.items)), self.sizes)

    def by_key(self, values: NDArray[Any]) -> dict[tuple[str, str], NDArray[Any]]:
        """Values of all coordinates, shape (n_coordinates,), apart by letter and name of their landmark."""
        return dict(zip(self.keys, np.split(values, self._first[1:-1]), strict=False))

    def span(self, index: int) -> slice:
        """Coordinates of a landmark."""
        return slice(self._first[index], self._first[index + 1])

    def coordinates_of(self, kind: LandmarkKind, names: Sequence[str]) -> Integers:
        """Coordinates of landmarks in the base or tool frame by name, shape (n, size)."""
        spans = [self.span(self._index[kind.letter, name, -1]) for name in names]
        return np.array([np.arange(span.start, span.stop) for span in spans], dtype=np.int64).reshape(-1, kind.size)

    def add(self, landmarks: Sequence[Landmark], source: str, frame: int = -1, *, named: bool = True) -> Integers:
        """Add landmarks; one of a name that is there is the same, whatever table it is from.

        What one table says of its place holds for all: the others may say the same, or nothing.

        Args:
            landmarks: The landmarks, one at least.
            source: The table, for messages.
            frame: The table in whose own measurement frame they are, -1 for the base: names are of one frame.
            named: Whether they have names; all are new otherwise.

        Returns:
            Their coordinates, shape (n, size).

        Raises:
            ProblemError: Two of one name are said to be at different places.
        """
        found = []
        for new in landmarks:
            key, n = (new.kind.letter, new.name, frame), len(self.items)
            i = self._index.setdefault(key, n) if named else n
            if i == n:
                self.items.append(new)
                self._first.append(self._first[-1] + len(new.start))
            elif not self.items[i].is_specified:
                self.items[i] = new
            elif new.is_specified and str(new) != str(self.items[i]):
                expected = f"that of the other {new.name}: {self.items[i]}"
                raise ProblemError(source, f"start {new} of unknown {new.name}", expected)
            span = self.span(i)
            found.append(np.arange(span.start, span.stop))
        return np.array(found, dtype=np.int64)

    def start_at(self, coordinate: int, place: Floats) -> None:
        """Start the landmark with that first coordinate somewhere, unless a table says where it is."""
        i = self._first.index(coordinate)
        if not self.items[i].is_specified:
            self.items[i] = replace(self.items[i], start=place)

    def with_starts(self, starts: Mapping[int, Floats]) -> "Landmarks":
        """Copy with other starts of some, wherever a table says that they are.

        Args:
            starts: Coordinates by the landmark's number.
        """
        other = copy(self)
        other.items = [replace(item, start=starts.get(i, item.start).copy()) for i, item in enumerate(self.items)]
        return other
