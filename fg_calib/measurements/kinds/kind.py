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
from numpy.typing import NDArray

from fg_calib.errors import InputError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


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
        units: Unit of each row, `m` or `rad`.
        ends: Configurations of one measurement: 1, 2, or 0 if it is of nuisances alone.
        residual_dim: Rows of residual.
        width: Columns of data that it reads.
        n_nuisances: Coordinates of nuisances.
        turned_back: Whether only the length of its residual, a vector in the base frame, counts: derivatives in the
            parameters then leave out that all vectors turn with the base (see `kinematics.turning_of_base`).
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


def checked_rows(kind: Kind, at: Frames, data: Floats, nuisances: Floats) -> tuple[Floats, Floats, Floats]:
    """`Kind.rows` as arrays of the shapes that it must have.

    Raises:
        InputError: One has another shape, or no numbers.
    """
    n = len(at.position)
    found = kind.rows(at, data.copy(), nuisances)
    if not isinstance(found, tuple) or len(found) != len(Rows._fields):
        raise InputError(
            f"kind {type(kind).__name__}: rows", f"returned a {type(found).__name__}", "Rows(residual, D, N)"
        )
    none = np.zeros((n, kind.residual_dim, 0)) if kind.n_nuisances == 0 else np.zeros(0)
    shapes = ((n, kind.residual_dim), (n, kind.ends, kind.residual_dim, 6), (n, kind.residual_dim, kind.n_nuisances))
    arrays = []
    for name, given, shape in zip(Rows._fields, found, shapes, strict=True):
        array = np.ascontiguousarray(none if given is None else given, dtype=np.float64)
        if array.shape != shape:
            raise InputError(f"kind {type(kind).__name__}: {name}", f"shape {array.shape}", f"{shape}")
        arrays.append(array)
    return arrays[0], arrays[1], arrays[2]


def check_derivatives(kind: Kind, at: Frames, data: Floats, nuisances: Floats) -> None:
    """Compare what a kind says of its derivatives with differences.

    Args:
        kind: The kind.
        at: Tool frames of some measurements.
        data: What was measured.
        nuisances: Values of the nuisances.

    Raises:
        InputError: They differ by more than differences do.
    """
    _, D, N = checked_rows(kind, at, data, nuisances)
    for end in range(kind.ends):
        for column in range(6):
            difference = (_moved(kind, at, data, nuisances, end, column, h) for h in (_STEP, -_STEP))
            _compare(kind, "wrenches", (next(difference) - next(difference)) / (2.0 * _STEP), D[:, end, :, column])
    for column in range(kind.n_nuisances):
        ahead, behind = nuisances.copy(), nuisances.copy()
        ahead[:, column] += _STEP
        behind[:, column] -= _STEP
        both = (checked_rows(kind, at, data, z)[0] for z in (ahead, behind))
        _compare(kind, "nuisances", (next(both) - next(both)) / (2.0 * _STEP), N[:, :, column])


_STEP = 1e-6
"""Of differences, [rad] and [m]: their error is some 1e-9 of a derivative of ordinary size."""

_ALIKE = 1e-4
"""Difference of a derivative, of 1 or its size, that is a mistake."""


def _moved(kind: Kind, at: Frames, data: Floats, nuisances: Floats, end: int, column: int, h: float) -> Floats:
    """Residuals with one end's frame turned or shifted."""
    rotation, position = at.rotation.copy(), at.position.copy()
    if column < 3:
        K = np.cross(np.eye(3), h * np.eye(3)[column])
        rotation[:, end] = (np.eye(3) + K + 0.5 * K @ K) @ rotation[:, end]
    else:
        position[:, end, column - 3] += h
    return checked_rows(kind, Frames(rotation, position), data, nuisances)[0]


def _compare(kind: Kind, name: str, difference: Floats, said: Floats) -> None:
    off = np.abs(difference - said) / np.maximum(1.0, np.abs(difference))
    if not np.all(off < _ALIKE):
        worst = np.unravel_index(np.nanargmax(off), off.shape)
        found = f"{said[worst]:.6g} where a small change gives {difference[worst]:.6g}"
        raise InputError(f"kind {type(kind).__name__}: {name}", found, "the derivative of its residual")


def between(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Lengths of the vectors from start to end, shape (n,), and their directions, shape (n, 3); zero has none."""
    vector = end - start
    length: Floats = np.linalg.norm(vector, axis=1)
    return length, vector / np.maximum(length, 1e-300)[:, None]
