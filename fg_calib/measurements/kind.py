"""What a kind of measurement says: residual and derivatives as a function of the tool frames of its ends.

A kind gives, beside its residual, *wrench rows* D: its derivative in the tool frame of each end, in a turn w about the
base's axes through the tool point and in a shift dp of that point, as in `kinematics.Poses.jacobian`. Whatever moves
the frame, a parameter, a joint, a frame before or behind the arm, has a (w, dp), and the derivative in it is
`D . (w, dp)`, summed over the ends. Unknowns besides the arm, *nuisances* such as a touched point, have columns N.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from fg_calib.inputs import Floats, InputError, Integers, as_array, check_number, require, shown


class Frames(NamedTuple):
    """Tool frames of n measurements' ends.

    Attributes:
        rotation: Tool axes in the base frame (or the measurement frame, if the chain starts there), shape (n, ends,
            3, 3).
        position: Tool points there, shape (n, ends, 3), [m].
    """

    rotation: Floats
    position: Floats


class Rows(NamedTuple):
    """Residuals of n measurements and their derivatives.

    Attributes:
        residual: Predicted minus measured, shape (n, residual_dim).
        wrenches: D, in (w, dp) of each end, shape (n, ends, residual_dim, 6).
        nuisances: N, shape (n, residual_dim, n_nuisances); None if there are none.
    """

    residual: Floats
    wrenches: Floats
    nuisances: Floats | None = None


class Kind(ABC):
    """One kind of measurement.

    Attributes:
        names: What its rows are called, such as `position.x`: kind of noise, then component.
        units: Unit of each row, `m`, `rad` or `px`.
        ends: Configurations of one measurement: 1, 2, or 0 if it is of nuisances alone.
        residual_dim: Rows of residual.
        width: Columns of data that it reads.
        n_nuisances: Coordinates of nuisances.
        turned_back: Whether only the length of its residual, a vector in the base frame, counts: derivatives in the
            parameters then leave out that all vectors turn with the base (see `kinematics.turning_of_base`).
        is_contact: Whether it says that points coincide, where a distance would be 0 and have no direction.
        shows_data: Whether its first columns of data are what tables show, though there are more.
        code: Of its twin in `kernels`, which computes residual and D by compiled code; None if it has none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    ends: int
    residual_dim: int
    width: int
    n_nuisances: int = 0
    turned_back: bool = False
    code: int | None = None
    is_contact: bool = False
    shows_data: bool = False

    @abstractmethod
    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """Residuals and their derivatives.

        Args:
            at: Tool frames of the ends.
            data: What was measured, shape (n, width).
            nuisances: Their values, shape (n, n_nuisances).
        """

    def figures(self, data: Floats) -> Floats:
        """Each row's measured value as tables show it, shape (n, residual_dim); nan where that is no figure."""
        shape = len(data), self.residual_dim
        return data[:, : shape[1]] if self.width == shape[1] or self.shows_data else np.full(shape, np.nan)

    @property
    def quantity(self) -> str:
        """Kind of noise of its first row: `distance`, `angle`, `position`, `orientation`, `point`, `pixel`."""
        return self.names[0].partition(".")[0]

    @property
    def parts(self) -> tuple[Kind, ...]:
        """The kinds that are measured together, or the one alone."""
        return (self,)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """Data that would be measured, shape (n, width).

        Args:
            at: True tool frames of the ends.
            data: What is given and not measured, such as a pixel's corner, shape (n, width).
            nuisances: True values, shape (n, n_nuisances).
            noise: Error of each row, shape (n, residual_dim).
        """
        if self.width == 0:  # a contact: its noise is where the arm stood
            return np.zeros((len(noise), 0))
        measured, given = np.split(data, [self.residual_dim], axis=1)
        values = self.rows(at, np.hstack([0.0 * measured, given]), nuisances).residual + noise
        return np.hstack([values, given])

    def mirrored(self, points: Floats, data: Floats, nuisances: Floats) -> Floats | None:
        """Nuisances of one landmark at its mirror image, which the same data may fit nearly as well; None of none.

        Args:
            points: Tool points of all its measurements, shape (n, 3), [m].
            data: Their data, shape (n, width).
            nuisances: Values that its measurements share, shape (n_nuisances,).
        """
        return None

    def twins(self) -> Integers:
        """Twins that compute it, part by part: code, first row, first column of data; shape (n_parts, 3)."""
        parts = [] if self.code is None else [(self.code, 0, 0)]
        return np.array(parts, dtype=np.int64).reshape(-1, 3)

    def __eq__(self, other: object) -> bool:
        """Whether both are the same kind, of the same parts."""
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        """By the class, which is nearly all there is."""
        return hash(type(self))


class Step(NamedTuple):
    """Vectors from one point to another, and their derivatives.

    Attributes:
        vector: Shape (n, 3), [m].
        wrenches: In (w, dp) of the ends that are tool points, shape (n, ends, 3, 6).
        nuisances: In those that are landmarks, shape (n, 3, 3 n_landmarks).
    """

    vector: Floats
    wrenches: Floats
    nuisances: Floats


def steps(at: Frames, landmarks: Floats) -> Step:
    """Vectors from the first of two points to the second: landmarks come first, then tool points.

    Args:
        at: Tool frames, of 0, 1 or 2 ends.
        landmarks: The other points, side by side, shape (n, 3 n_landmarks), [m].
    """
    n, k = len(landmarks), landmarks.shape[1] // 3
    points = np.concatenate([landmarks.reshape(n, k, 3), at.position.reshape(n, -1, 3)], axis=1)
    signs = np.array([-np.eye(3), np.eye(3)])
    D = np.zeros((n, 2 - k, 3, 6))
    D[:, :, :, 3:] = signs[k:]
    N = np.tile(signs[:k].transpose(1, 0, 2).reshape(3, 3 * k), (n, 1, 1))
    return Step(points[:, 1] - points[:, 0], D, N)


def directions(vectors: Floats) -> tuple[Floats, Floats]:
    """Lengths of vectors, shape (n,), and their directions, shape (n, 3); zero has none."""
    length: Floats = np.linalg.norm(vectors, axis=1)
    return length, vectors / np.maximum(length, 1e-300)[:, None]


class Length(Kind):
    """`|b - a| + offset - measured`, [m]: its derivative is `u . (db - da) + doffset`, u from a to b.

    Data: the length, [m]. Nuisances: those points that are landmarks, then the offset, where it has one.
    """

    names, units = ("distance",), ("m",)
    residual_dim = width = 1

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        landmarks, offset = np.split(nuisances, [3 * (2 - self.ends)], axis=1)
        step = steps(at, landmarks)
        length, u = directions(step.vector)
        D = np.einsum("nk,nekj->nej", u, step.wrenches)[:, :, None]
        N = np.concatenate([np.einsum("nk,nkj->nj", u, step.nuisances), np.ones(offset.shape)], axis=1)[:, None]
        return Rows((length + offset.sum(axis=1))[:, None] - data, D, N)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`."""
        return np.abs(super().simulate(at, data, nuisances, noise))


class Coincidence(Kind):
    """`b - a`, [m], of points that coincide: a distance of zero, which has no direction. Its derivative is `db - da`.

    Data: none. Nuisances: those points that are landmarks.
    """

    names, units = ("distance.x", "distance.y", "distance.z"), ("m", "m", "m")
    residual_dim, width, is_contact = 3, 0, True

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        return Rows(*steps(at, nuisances))


class Stacked(Kind):
    """Rows of several kinds of the same ends, one below the other: a pose is an orientation and a position.

    Data: those of the kinds, side by side. Nuisances: the same.
    """

    def __init__(self, *parts: Kind) -> None:
        self._parts = parts
        self.names = tuple(name for part in parts for name in part.names)
        self.units = tuple(unit for part in parts for unit in part.units)
        self.ends = parts[0].ends
        for name in ("residual_dim", "width", "n_nuisances"):
            setattr(self, name, sum(getattr(part, name) for part in parts))

    @property
    def parts(self) -> tuple[Kind, ...]:
        """See `Kind.parts`."""
        return self._parts

    def _split(self, of: Floats, size: str) -> list[Floats]:
        """What each part has of an array, a view of its columns; `size` says how many of them."""
        return np.split(of, np.cumsum([getattr(part, size) for part in self.parts])[:-1], axis=1)

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        of_parts = zip(self.parts, self._split(data, "width"), self._split(nuisances, "n_nuisances"), strict=True)
        residuals, wrenches, given = zip(*(part.rows(at, *arrays) for part, *arrays in of_parts), strict=True)
        N, row, column = np.zeros((len(data), self.residual_dim, self.n_nuisances)), 0, 0
        for part, own in zip(self.parts, given, strict=True):
            if part.n_nuisances:
                N[:, row : row + part.residual_dim, column : column + part.n_nuisances] = own
            row, column = row + part.residual_dim, column + part.n_nuisances
        return Rows(np.concatenate(residuals, axis=1), np.concatenate(wrenches, axis=2), N)

    def figures(self, data: Floats) -> Floats:
        """See `Kind.figures`."""
        return np.hstack([part.figures(own) for part, own in zip(self.parts, self._split(data, "width"), strict=True)])

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`."""
        sizes = ((data, "width"), (nuisances, "n_nuisances"), (noise, "residual_dim"))
        each = zip(self.parts, *(self._split(of, size) for of, size in sizes), strict=True)
        return np.hstack([part.simulate(at, *arrays) for part, *arrays in each])

    def twins(self) -> Integers:
        """See `Kind.twins`; none at all if a part has none."""
        twins, row, column = [], 0, 0
        for part in self.parts:
            twins.append(part.twins() + np.array([0, row, column]))
            row, column = row + part.residual_dim, column + part.width
        return np.concatenate(twins) if all(map(len, twins)) else np.zeros((0, 3), dtype=np.int64)


def stack(*parts: Kind) -> Kind:
    """The kinds measured together; one alone is itself."""
    return parts[0] if len(parts) == 1 else Stacked(*parts)


def is_ours(kind: Kind) -> bool:
    """Whether a kind is one of the package's, which the tests check."""
    return type(kind).__module__.startswith("fg_calib.")


def check_kind(kind: Kind) -> None:
    """Check what a custom kind says of itself.

    Raises:
        InputError: Something is missing, of another type, or contradicts the rest.
    """
    place = f"kind {type(kind).__name__}"
    for name in ("ends", "residual_dim", "width", "n_nuisances"):
        least, most = int(name == "residual_dim"), 2 if name == "ends" else 1000
        check_number(f"{place}: {name}", getattr(kind, name, None), least=least, whole=True, most=most)
    n = kind.residual_dim
    for name, example in (("names", "('height',)"), ("units", "('m',)")):
        value = getattr(kind, name, None)
        if not isinstance(value, tuple | list) or len(value) != n or not all(isinstance(v, str) and v for v in value):
            expected = f"a tuple of residual_dim = {n} words, such as {example}"
            raise InputError(f"{place}: {name}", f"found {shown(value)}", expected)
    if not set(kind.units) <= {"m", "rad", "px"}:
        raise InputError(f"{place}: units", f"found {shown(kind.units)}", "m, rad or px each")
    if not is_ours(kind) and len(kind.twins()):
        found = f"found {shown(kind.code)}"
        raise InputError(f"{place}: code", found, "None: compiled code would take the place of its rows")


def _place(kind: Kind, name: str, source: str) -> str:
    return f"{source}{': ' * bool(source)}kind {type(kind).__name__}: {name}"


def checked_rows(
    kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str = ""
) -> tuple[Floats, Floats, Floats]:
    """`Kind.rows` as arrays of the shapes that it must have.

    Args:
        kind: The kind.
        at: Tool frames of the measurements.
        data: What was measured.
        nuisances: Values of the nuisances.
        source: The table that they are from, for messages.

    Raises:
        InputError: One has another shape, or no numbers.
    """
    found = kind.rows(at, data.copy(), nuisances.copy())
    if not isinstance(found, tuple) or len(found) != len(Rows._fields):
        raise InputError(_place(kind, "rows", source), f"returned a {type(found).__name__}", "Rows(residual, D, N)")
    n = len(at.position)
    none = np.zeros((n, kind.residual_dim, 0)) if kind.n_nuisances == 0 else np.zeros(0)
    shapes = ((n, kind.residual_dim), (n, kind.ends, kind.residual_dim, 6), (n, kind.residual_dim, kind.n_nuisances))
    arrays = []
    for name, given, shape in zip(Rows._fields, found, shapes, strict=True):
        place = _place(kind, name, source)
        numbers = as_array(place, none if given is None else given, "iuf", f"numbers of shape {shape}")
        array = np.ascontiguousarray(numbers, dtype=np.float64)
        if array.shape != shape:
            raise InputError(place, f"shape {array.shape}", f"{shape}")
        arrays.append(array)
    return arrays[0], arrays[1], arrays[2]


def check_rows(kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str = "") -> None:
    """Check that a custom kind's rows are finite, and compare what it says of its derivatives with differences.

    Args:
        kind: The kind.
        at: Tool frames of some measurements.
        data: What was measured.
        nuisances: Values of the nuisances.
        source: The table that they are from, for messages.

    Raises:
        InputError: They are not, or differ by more than differences do.
    """
    for name, array in zip(Rows._fields, checked_rows(kind, at, data, nuisances, source), strict=True):
        place = _place(kind, name, source)
        require(np.isfinite(array), place, array, "a finite number", "at the start of the unknowns")
    (rotation, position), data, nuisances = (of[:N_COMPARED] for of in at), data[:N_COMPARED], nuisances[:N_COMPARED]
    at = Frames(rotation, position)
    _, D, N = checked_rows(kind, at, data, nuisances, source)
    n_of_ends = 6 * kind.ends
    said = np.concatenate([np.moveaxis(D, 1, 2).reshape(*N.shape[:2], n_of_ends), N], axis=2)
    for k in range(said.shape[2]):
        up, down = (_moved(at, nuisances, k, h) for h in (STEP, -STEP))
        r_up, r_down = (checked_rows(kind, frames, data, values, source)[0] for frames, values in (up, down))
        difference = (r_up - r_down) / (2.0 * STEP)
        off = np.abs(difference - said[:, :, k]) / np.maximum(1.0, np.abs(difference))
        if not np.all(off < MAX_DERIVATIVE_ERROR):
            worst = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
            found = f"{said[:, :, k][worst]:.6g} where a small change gives {difference[worst]:.6g}"
            place = _place(kind, "wrenches" if k < n_of_ends else "nuisances", source)
            raise InputError(place, found, "the derivative of its residual")


N_COMPARED = 3
"""Measurements whose derivatives are compared."""

STEP = 1e-6
"""Of differences, [rad] and [m]: their error is some 1e-9 of a derivative of ordinary size."""

MAX_DERIVATIVE_ERROR = 1e-4
"""Difference of a derivative, of 1 or its size, that is a mistake."""


def _moved(at: Frames, nuisances: Floats, k: int, h: float) -> tuple[Frames, Floats]:
    """Frames and nuisances with one coordinate changed: of a rotation or a translation of an end, or a nuisance."""
    (rotation, position), (end, column) = (of.copy() for of in at), divmod(k, 6)
    if end >= position.shape[1]:
        k -= 6 * position.shape[1]
        return at, nuisances + h * (np.arange(nuisances.shape[1]) == k)
    if column < 3:
        K = np.cross(np.eye(3), h * np.eye(3)[column])
        rotation[:, end] = (np.eye(3) + K + 0.5 * K @ K) @ rotation[:, end]
    else:
        position[:, end, column - 3] += h
    return Frames(rotation, position), nuisances
