"""What a kind of measurement says: residual and derivatives as a function of the tool frames of its ends.

A kind gives, beside its residual, *wrench rows* D: its derivative in the tool frame of each end, in a turn w about the
base's axes through the tool point and in a shift dp of that point, as in `kinematics.Poses.jacobian`. Whatever moves
the frame, a parameter, a joint, a frame before or behind the arm, has a (w, dp), and the derivative in it is
`D . (w, dp)`, summed over the ends. Unknowns besides the arm, *nuisances* such as a touched point, have columns N.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from fg_calib.inputs import Floats, InputError, Integers, as_array, as_figures, require, shown


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
        return (
            data[:, : self.residual_dim]
            if self.width == self.residual_dim
            else np.full((len(data), self.residual_dim), np.nan)
        )

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
        return self.rows(at, np.zeros((len(noise), self.width)), nuisances).residual + noise

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


def is_ours(kind: Kind) -> bool:
    """Whether a kind is one of the package's, which the tests check."""
    return type(kind).__module__.startswith("fg_calib.")


def check_kind(kind: Kind) -> None:
    """Check what a kind of one's own says of itself.

    Raises:
        InputError: Something is missing, of another type, or contradicts the rest.
    """
    place = f"kind {type(kind).__name__}"
    for name, (least, most) in _COUNTS.items():
        value = getattr(kind, name, None)
        if not isinstance(value, Integral) or isinstance(value, bool) or not least <= int(value) <= most:
            found = f"found {shown(value)}" if hasattr(kind, name) else "it is missing"
            raise InputError(f"{place}: {name}", found, f"a whole number, {least} to {most}")
    n = kind.residual_dim
    for name, what in (("names", "('height',)"), ("units", "('m',)")):
        value = getattr(kind, name, None)
        if not isinstance(value, tuple | list) or len(value) != n or not all(isinstance(v, str) and v for v in value):
            found = f"found {shown(value)}" if hasattr(kind, name) else "it is missing"
            raise InputError(f"{place}: {name}", found, f"a tuple of residual_dim = {n} words, such as {what}")
    if not set(kind.units) <= {"m", "rad", "px"}:
        raise InputError(f"{place}: units", f"found {shown(kind.units)}", "m, rad or px each")
    if not is_ours(kind) and len(_called(kind, "twins")):
        found = f"found {shown(kind.code)}"
        raise InputError(f"{place}: code", found, "None: compiled code would take the place of its rows")


_COUNTS = {"ends": (0, 2), "residual_dim": (1, 1000), "width": (0, 1000), "n_nuisances": (0, 1000)}
"""Least and most of what a kind says of its sizes."""


def _called(kind: Kind, method: str, *arguments: Any, source: str = "") -> Any:
    """What a method of a kind returns; what it raises becomes one line.

    Raises:
        InputError: It raised something.
    """
    try:
        return getattr(kind, method)(*arguments)
    except MemoryError:  # which says nothing of the kind
        raise
    except Exception as error:
        message = f"{type(error).__name__}: {error}".rstrip(": ")
        raise InputError(_place(kind, method, source), f"raised {message}") from error


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
        InputError: It raised something, or one has another shape, or no numbers.
    """
    found = _called(kind, "rows", at, data.copy(), nuisances.copy(), source=source)
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


def checked_figures(kind: Kind, data: Floats, source: str) -> Floats:
    """`Kind.figures` as an array of the shape that it must have.

    Raises:
        InputError: It raised something, or has another shape, or no numbers.
    """
    place, shape = _place(kind, "figures", source), f"({len(data)}, {kind.residual_dim})"
    found = as_figures(place, _called(kind, "figures", data.copy(), source=source), f"numbers of shape {shape}")
    if found.shape != (len(data), kind.residual_dim):
        raise InputError(place, f"shape {found.shape}", shape)
    return data if np.array_equal(found, data) else found  # of a long table in memory once


def check_start(kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str) -> None:
    """Check that residuals and derivatives are finite where a kind is started, and its figures are figures.

    Raises:
        InputError: They are not.
    """
    for name, array in zip(Rows._fields, checked_rows(kind, at, data, nuisances, source), strict=True):
        place = _place(kind, name, source)
        require(np.isfinite(array), place, array, "a finite number", "at the start of the unknowns")
    checked_figures(kind, data, source)


def check_derivatives(kind: Kind, at: Frames, data: Floats, nuisances: Floats, source: str = "") -> None:
    """Compare what a kind says of its derivatives with differences.

    Args:
        kind: The kind.
        at: Tool frames of some measurements.
        data: What was measured.
        nuisances: Values of the nuisances.
        source: The table that they are from, for messages.

    Raises:
        InputError: They differ by more than differences do.
    """
    _, D, N = checked_rows(kind, at, data, nuisances, source)

    def residual(name: str, k: int, h: float) -> Floats:
        """The residual where one coordinate is another by h."""
        moved = _moved(at, *divmod(k, 6), h) if name == "wrenches" else at
        values = nuisances + h * (np.arange(kind.n_nuisances) == k) if name == "nuisances" else nuisances
        return checked_rows(kind, moved, data, values, source)[0]

    ends = np.moveaxis(D, 1, 2).reshape(len(D), kind.residual_dim, -1)
    for name, said in (("wrenches", ends), ("nuisances", N)):
        for k in range(said.shape[2]):
            difference = (residual(name, k, STEP) - residual(name, k, -STEP)) / (2.0 * STEP)
            off = np.abs(difference - said[:, :, k]) / np.maximum(1.0, np.abs(difference))
            if not np.all(off < MAX_DERIVATIVE_ERROR):
                worst = np.unravel_index(np.argmax(np.nan_to_num(off, nan=np.inf)), off.shape)
                found = f"{said[:, :, k][worst]:.6g} where a small change gives {difference[worst]:.6g}"
                raise InputError(_place(kind, name, source), found, "the derivative of its residual")


STEP = 1e-6
"""Of differences, [rad] and [m]: their error is some 1e-9 of a derivative of ordinary size."""

MAX_DERIVATIVE_ERROR = 1e-4
"""Difference of a derivative, of 1 or its size, that is a mistake."""


def _moved(at: Frames, end: int, column: int, h: float) -> Frames:
    """The frames with one end's turned or shifted."""
    rotation, position = at.rotation.copy(), at.position.copy()
    if column < 3:
        K = np.cross(np.eye(3), h * np.eye(3)[column])
        rotation[:, end] = (np.eye(3) + K + 0.5 * K @ K) @ rotation[:, end]
    else:
        position[:, end, column - 3] += h
    return Frames(rotation, position)


def between(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Lengths of the vectors from start to end, shape (n,), and their directions, shape (n, 3); zero has none."""
    vector = end - start
    length: Floats = np.linalg.norm(vector, axis=1)
    return length, vector / np.maximum(length, 1e-300)[:, None]
