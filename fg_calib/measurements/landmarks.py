"""Landmarks: what measurements depend on besides the arm, such as targets on the tool, anchors, planes and boards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.inputs import Floats, Integers, ProblemError

Estimate = tuple[Floats, Floats, tuple[str, ...]]
"""Values as reports show them, their covariance, and their units."""


@dataclass(frozen=True)
class LandmarkKind:
    """A kind of landmark; its instrument's file declares it.

    Attributes:
        letter: Letter of its GTSAM symbols, and of its name in `result.json`.
        name: What one is called: `target`, `anchor`.
        description: What all of them are called where they explain a null-space direction.
        heading: Of its table in reports, with frame and unit; empty where reports do not show it.
        units: `m` or `rad` of each coordinate.
        key: Key of a job that may say where they are; empty where none does.
        n_configurations: That must be left to say where one is, in cross-validation.
        must_be_fitted: Whether a train row must say where one is, unless the job does.
        stays: Whether it is where it was at the next calibration: a target on the tool, say.
        is_one: Whether a table has one at most, whose name says enough.
        reference: Kind of the constants that its coordinates are relative to, of the same names; None if none.
        estimate: Values as reports show them, from the reference's coordinates, its own, and their covariance; None
            where its coordinates are shown as they are.
    """

    letter: str
    name: str
    description: str
    heading: str
    units: tuple[str, ...] = ("m", "m", "m")
    key: str = ""
    n_configurations: int = 1
    must_be_fitted: bool = True
    stays: bool = False
    is_one: bool = False
    reference: LandmarkKind | None = None
    estimate: Callable[[Floats, Floats, Floats], Estimate] | None = None

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.units)

    def of(self, source: str) -> str:
        """Name of the one of a table, of a kind of which a table has one at most."""
        return f"{self.name} of {source}"

    def called(self, name: str) -> str:
        """One of them in a message: `anchor ball1`."""
        return name if self.is_one else f"{self.name} {name}"


@dataclass(frozen=True)
class Landmark:
    """A landmark.

    Attributes:
        kind: What it is.
        name: What it is called.
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
    def is_stated(self) -> bool:
        """Whether a table says where it is, or is started."""
        return not bool(np.isnan(self.start).any())

    @property
    def units(self) -> tuple[str, ...]:
        """`m` or `rad` of each coordinate."""
        return self.kind.units if len(self.start) == self.kind.size else ("m",) * len(self.start)

    def says_the_same(self, other: Landmark) -> bool:
        """Whether both say that it is at one place, equally well."""
        same = (self.tolerance, self.known) == (other.tolerance, other.known)
        return same and np.array_equal(self.start, other.start)

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
    def kinds(self) -> list[LandmarkKind]:
        """Kind of each."""
        return [item.kind for item in self.items]

    @property
    def names(self) -> list[str]:
        """Name of each."""
        return [item.name for item in self.items]

    @property
    def letters(self) -> list[str]:
        """Letter of each one's symbol."""
        return [item.kind.letter for item in self.items]

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Letter and name of each."""
        return [(item.kind.letter, item.name) for item in self.items]

    @property
    def sizes(self) -> list[int]:
        """Number of coordinates of each."""
        return [len(item.start) for item in self.items]

    @property
    def starts(self) -> list[Floats]:
        """Start of each."""
        return [item.start for item in self.items]

    @property
    def units(self) -> list[tuple[str, ...]]:
        """Units of each one's coordinates."""
        return [item.units for item in self.items]

    @property
    def tolerances(self) -> list[float | None]:
        """1 sigma of each one's start; None where it says nothing."""
        return [item.tolerance for item in self.items]

    @property
    def known(self) -> list[bool]:
        """Whether each is known exactly."""
        return [item.known for item in self.items]

    @property
    def n_coordinates(self) -> int:
        """Number of coordinates of all."""
        return self._first[-1]

    @property
    def owners(self) -> Integers:
        """Which landmark each coordinate is of, shape (n_coordinates,)."""
        return np.repeat(np.arange(len(self.items)), self.sizes)

    def span(self, index: int) -> slice:
        """Coordinates of a landmark."""
        return slice(self._first[index], self._first[index + 1])

    def coordinates_of(self, kind: LandmarkKind, names: Sequence[str]) -> Integers:
        """Coordinates of landmarks in the base or tool frame by name, shape (n, size)."""
        spans = [self.span(self._index[kind.letter, name, -1]) for name in names]
        return np.array([np.arange(span.start, span.stop) for span in spans], dtype=np.int64).reshape(-1, kind.size)

    def add(
        self,
        kind: LandmarkKind,
        names: Sequence[str],
        starts: Floats,
        source: str,
        frame: int = -1,
        *,
        tolerances: Sequence[float | None] = (),
        known: Sequence[bool] = (),
    ) -> Integers:
        """Add landmarks of a kind; one of a name that is there is the same, whatever table it is from.

        What one table says of its place holds for all: the others may say the same, or nothing.

        Args:
            kind: Their kind.
            names: What they are called; none have names if empty.
            starts: Where they are started, shape (n, size); nan where the measurements are to say it.
            source: The table, for messages.
            frame: The table in whose own measurement frame they are, -1 for the base: elsewhere a name is another.
            tolerances: 1 sigma of each one's start; None, as of all if empty, where it says nothing.
            known: Whether each start is exact; none is if empty.

        Returns:
            Their coordinates, shape (n, size).

        Raises:
            ProblemError: Two of one name are said to be at different places.
        """
        found = np.empty(starts.shape, dtype=np.int64)
        for k, start in enumerate(starts):
            name = names[k] if names else str(k)
            tolerance, exact = tolerances[k] if tolerances else None, known[k] if known else False
            new = Landmark(kind, name, start, tolerance, exact)
            key = kind.letter, name, frame
            i = self._index.get(key, len(self.items)) if names else len(self.items)
            if i == len(self.items):
                self.items.append(new)
                self._first.append(self._first[-1] + len(start))
            elif not self.items[i].is_stated:
                self.items[i] = new
            elif new.is_stated and not new.says_the_same(self.items[i]):
                expected = f"that of the other {name}: {self.items[i]}"
                raise ProblemError(source, f"start {new} of unknown {name}", expected)
            if names:
                self._index[key] = i
            span = self.span(i)
            found[k] = np.arange(span.start, span.stop)
        return found

    def start(self, coordinate: int, place: Floats) -> None:
        """Start the landmark with that first coordinate somewhere, unless a table says where it is."""
        i = self._first.index(coordinate)
        if not self.items[i].is_stated:
            self.items[i] = replace(self.items[i], start=place)

    def place(self, places: Mapping[tuple[str, str], Floats]) -> None:
        """Start landmarks at places given by letter and name, wherever a table says that they are."""
        for i, key in enumerate(self.keys):
            if key in places:
                self.items[i] = replace(self.items[i], start=places[key].copy())

    def with_start(self, coordinate: int, place: Floats) -> Landmarks:
        """The same with another start of the landmark with that first coordinate."""
        other, i = copy(self), self._first.index(coordinate)
        other.items = [*self.items[:i], replace(self.items[i], start=place), *self.items[i + 1 :]]
        return other
