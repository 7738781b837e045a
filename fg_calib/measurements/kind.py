"""A kind of measurement: residual and derivatives as a function of the tool frames of its ends.

A kind gives, besides its residual, *wrench rows* D: its derivative in the tool frame of each end, in a turn w about the
base's axes through the tool point and in a shift dp of that point, as in `kinematics.Poses.jacobian`. Whatever moves
the frame, a parameter, a joint, a frame before or behind the arm, has a (w, dp), and the derivative in it is
`D . (w, dp)`, summed over the ends. Unknowns besides the arm, *nuisances* such as a contact point, have columns N.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from fg_calib.inputs import Floats, InputError, Integers, as_array, check_number, expect, require, shown
from fg_calib.robot import cross_matrix


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
        names: Names of its rows, such as `position.x`: kind of noise, then component.
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
            data: Measured values, shape (n, width).
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
    def parts(self) -> "tuple[Kind, ...]":
        """The kinds that are measured together, or the one alone."""
        return (self,)

    def predict(self, at: Frames, nuisances: Floats) -> Floats:
        """Data without noise, shape (n, width); for a kind whose data are all measured.

        Args:
            at: True tool frames of the ends.
            nuisances: True values, shape (n, n_nuisances).
        """
        return self.rows(at, np.zeros((len(nuisances), self.width)), nuisances).residual[:, : self.width]

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
        """Hash of the class, which is nearly all there is."""
        return hash(type(self))


def steps(at: Frames, landmarks: Floats) -> tuple[Floats, Floats, Floats]:
    """Vectors from the first of two points to the second: landmarks come first, then tool points.

    Args:
        at: Tool frames, of 0, 1 or 2 ends.
        landmarks: The other points, side by side, shape (n, 3 n_landmarks), [m].

    Returns:
        Vectors, shape (n, 3), [m], and their derivatives in (w, dp) of the ends that are tool points, shape (n, ends,
        3, 6), and in the landmarks, shape (n, 3, 3 n_landmarks).
    """
    n, k = len(landmarks), landmarks.shape[1] // 3
    points = np.concatenate([landmarks.reshape(n, k, 3), at.position.reshape(n, -1, 3)], axis=1)
    signs = np.array([-np.eye(3), np.eye(3)])
    D = np.zeros((n, 2 - k, 3, 6))
    D[:, :, :, 3:] = signs[k:]
    N = np.tile(signs[:k].transpose(1, 0, 2).reshape(3, 3 * k), (n, 1, 1))
    return points[:, 1] - points[:, 0], D, N


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
        step, of_ends, of_landmarks = steps(at, landmarks)
        length, u = directions(step)
        D = np.einsum("nk,nekj->nej", u, of_ends)[:, :, None]
        N = np.concatenate([np.einsum("nk,nkj->nj", u, of_landmarks), np.ones(offset.shape)], axis=1)[:, None]
        return Rows((length + offset.sum(axis=1))[:, None] - data, D, N)


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

    Data: those of the kinds, side by side. Nuisances: those of every kind that has some.
    """

    def __init__(self, *parts: Kind) -> None:
        self._parts = parts
        self.names = tuple(name for part in parts for name in part.names)
        self.units = tuple(unit for part in parts for unit in part.units)
        self.ends, self.n_nuisances = parts[0].ends, max(part.n_nuisances for part in parts)
        self.residual_dim, self.width = len(self.names), sum(part.width for part in parts)

    @property
    def parts(self) -> tuple[Kind, ...]:
        """See `Kind.parts`."""
        return self._parts

    def _each(self, data: Floats) -> Iterator[tuple[Kind, Floats]]:
        """Each part with its columns of data."""
        return zip(self.parts, np.split(data, np.cumsum([part.width for part in self.parts])[:-1], axis=1), strict=True)

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        each = [part.rows(at, own, nuisances) for part, own in self._each(data)]
        none = np.zeros((len(data), self.residual_dim, self.n_nuisances))
        N = [none[:, : r.residual.shape[1]] if r.nuisances is None else r.nuisances for r in each]
        residual, D = (np.concatenate([r[i] for r in each], axis=i + 1) for i in (0, 1))
        return Rows(residual, D, np.concatenate(N, axis=1))

    def figures(self, data: Floats) -> Floats:
        """See `Kind.figures`."""
        return np.hstack([part.figures(own) for part, own in self._each(data)])

    def predict(self, at: Frames, nuisances: Floats) -> Floats:
        """See `Kind.predict`."""
        return np.hstack([part.predict(at, nuisances) for part in self.parts])

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
    for name, example in (("names", "words, such as ('height',)"), ("units", "of m, rad and px")):
        value = getattr(kind, name, None)
        words = value if isinstance(value, tuple | list) else ()
        good = len(words) == kind.residual_dim and all(isinstance(word, str) and word for word in words)
        if not good or (name == "units" and not {"m", "rad", "px"}.issuperset(words)):
            expected = f"a tuple of residual_dim = {kind.residual_dim} {example}"
            raise InputError(f"{place}: {name}", f"found {shown(value)}", expected)
    if not is_ours(kind) and len(kind.twins()):
        found = f"found {shown(kind.code)}"
        raise InputError(f"{place}: code", found, "None: compiled code would take the place of its rows")


def checked_rows(
    kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str = ""
) -> tuple[Floats, Floats, Floats]:
    """`Kind.rows` as arrays of the shapes that it must have.

    Args:
        kind: The kind.
        at: Tool frames of the measurements.
        data: Measured values.
        nuisances: Values of the nuisances.
        source: The table that they are from, for messages.

    Raises:
        InputError: One has another shape, or no numbers.
    """
    found, n, h = kind.rows(at, data.copy(), nuisances.copy()), len(at.position), kind.residual_dim
    place = f"{source}{': ' * bool(source)}kind {type(kind).__name__}"
    if not isinstance(found, tuple) or len(found) != len(Rows._fields):
        raise InputError(f"{place}: rows", f"returned a {type(found).__name__}", "Rows(residual, D, N)")
    each: tuple[Any, ...] = found if kind.n_nuisances else (*found[:2], np.zeros((n, h, 0)))
    arrays, shapes = [], ((n, h), (n, kind.ends, h, 6), (n, h, kind.n_nuisances))
    for name, given, shape in zip(Rows._fields, each, shapes, strict=True):
        numbers = as_array(f"{place}: {name}", given, "iuf", f"numbers of shape {shape}")
        expect(numbers.shape == shape, f"{place}: {name}", f"shape {numbers.shape}", f"{shape}")
        arrays.append(np.ascontiguousarray(numbers, dtype=np.float64))
    return arrays[0], arrays[1], arrays[2]


def check_rows(kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str) -> None:
    """Check that a custom kind's rows are finite, and compare its derivatives with central differences.

    Args:
        kind: The kind.
        at: Tool frames of some measurements.
        data: Measured values.
        nuisances: Values of the nuisances.
        source: The table that they are from, for messages.

    Raises:
        InputError: The rows are not finite, or their derivatives differ by more than differences do.
    """
    place = f"{source}: kind {type(kind).__name__}"
    for name, array in zip(Rows._fields, checked_rows(kind, at, data, nuisances, source), strict=True):
        require(np.isfinite(array), f"{place}: {name}", array, "a finite number", "at the start of the unknowns")
    at, data, nuisances = Frames(*(of[:N_COMPARED] for of in at)), data[:N_COMPARED], nuisances[:N_COMPARED]
    _, D, N = checked_rows(kind, at, data, nuisances, source)
    n_of_ends = 6 * kind.ends
    claimed = np.concatenate([np.moveaxis(D, 1, 2).reshape(*N.shape[:2], n_of_ends), N], axis=2)
    for k, step in enumerate(STEP * np.eye(claimed.shape[2])):
        up, down = (_residual_at(kind, at, data, nuisances, sign * step) for sign in (1.0, -1.0))
        difference = (up - down) / (2.0 * STEP)
        off = np.abs(difference - claimed[:, :, k]) / np.maximum(1.0, np.abs(difference))
        worst = np.unravel_index(np.argmax(off), off.shape)
        if not off[worst] < MAX_DERIVATIVE_ERROR:
            found = f"{claimed[:, :, k][worst]:.6g} where a small change gives {difference[worst]:.6g}"
            part = Rows._fields[1 + (k >= n_of_ends)]
            raise InputError(f"{place}: {part}", found, "the derivative of its residual")


N_COMPARED = 3
"""Measurements whose derivatives are compared."""

STEP = 1e-6
"""Step of differences, [rad] and [m]: their error is some 1e-9 of a derivative of ordinary size."""

MAX_DERIVATIVE_ERROR = 1e-4
"""Difference of a derivative, relative to 1 or its size, that is a mistake."""


def _residual_at(kind: Kind, at: Frames, data: Floats, nuisances: Floats, step: Floats) -> Floats:
    """Residuals after a small rotation and translation of each end, and a small change of the nuisances."""
    moves = step[: 6 * kind.ends].reshape(-1, 6)
    rotation = at.rotation + cross_matrix(moves[:, :3]) @ at.rotation
    moved = Frames(rotation, at.position + moves[:, 3:])
    return checked_rows(kind, moved, data, nuisances + step[6 * kind.ends :])[0]
