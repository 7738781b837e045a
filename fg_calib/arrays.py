"""Arrays from outside, checked, and arrays that stay as they are: those of frozen types are read-only."""

from __future__ import annotations

from collections.abc import Sized
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.sizes import MOST_SIZE, ORDINARY

Floats = NDArray[np.float64]

NORM_TOLERANCE = 1e-3
"""How far a quaternion or a rotation matrix may be from length 1: more is not rounding."""


class Brief:
    """Base of dataclasses that hold arrays: a repr fits a screen, with shapes for arrays and types for long values."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = _brief  # type: ignore[method-assign] # dataclass makes none where there is one


def _brief(of: object) -> str:
    """`Series(kind=Distance, ends=int64 (12, 2), ...)`, a line each where it is long."""
    parts = [f"{f.name}={_in_brief(getattr(of, f.name))}" for f in fields(of) if f.repr]  # type: ignore[arg-type]
    line = f"{type(of).__name__}({', '.join(parts)})"
    return line if len(line) <= _WIDTH else "\n  ".join([f"{type(of).__name__}:", *parts])


def _in_brief(value: object) -> str:
    if isinstance(value, np.ndarray) and value.size <= _FEW:
        return np.array2string(value, precision=6, separator=", ")
    if hasattr(value, "dtype") and hasattr(value, "shape"):  # scipy's sparse arrays too
        return f"{value.dtype} {value.shape}"
    text = repr(value)
    if len(text) <= _WIDTH - 40 and "\n" not in text:
        return text
    return f"{type(value).__name__} of {len(value)}" if isinstance(value, Sized) else type(value).__name__


_WIDTH, _FEW = 100, 4


class FrozenArrays(Brief):
    """Base of frozen dataclasses: arrays among their fields are read-only views.

    Nothing is copied, and an array that was passed in stays as writable as it was. It is for types that others are
    made of; what a call hands back for the caller's own use alone, such as a prediction, is the caller's to change.
    """

    _left_open: ClassVar[tuple[str, ...]] = ()
    """Arrays for the kernels, which would be compiled a second time for read-only ones."""

    def __post_init__(self) -> None:
        frozen = {name: _read_only(value) for name, value in self.__dict__.items() if name not in self._left_open}
        self.__dict__.update(frozen)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        FrozenArrays.__post_init__(self)  # arrays come writable out of a pickle


def _read_only(value: object) -> object:
    if not isinstance(value, np.ndarray) or not value.flags.writeable:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def as_floats(name: str, given: object, shape: str, *, missing: bool = False) -> Floats:
    """Numbers from outside as an array, a copy wherever somebody else could change it.

    Args:
        name: What they are, for messages.
        given: Numbers, sequences or arrays of them.
        shape: The shape wanted, such as `(n, 3)`: letters are any number of rows.
        missing: Whether nan, or None, may stand for what is missing.

    Raises:
        InputError: They are no numbers, of another shape, or not finite.
    """
    array = as_array(name, given, "iufO", f"numbers of shape {shape}")
    try:
        floats = np.array(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, f"found {_shown(given)}", f"numbers of shape {shape}") from None
    wanted = [word.strip() for word in shape.strip("()").split(",") if word.strip()]
    fits = floats.ndim == len(wanted) and all(
        not word.isdigit() or int(word) == n for word, n in zip(wanted, floats.shape, strict=True)
    )
    if not fits:
        raise InputError(name, f"shape {floats.shape}", shape)
    good = np.isfinite(floats) | (missing & np.isnan(floats))
    require(good, name, floats, "a finite number")
    require(~(np.abs(floats) > MOST_SIZE), name, floats, ORDINARY)
    return floats


def as_rotations(name: str, given: object, n: int) -> Floats:
    """N rotation matrices from outside, rounding taken off them, shape (n, 3, 3).

    Raises:
        InputError: They are of another shape, or no rotations.
    """
    R = as_floats(name, given, f"({n}, 3, 3)")
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    good = (off <= NORM_TOLERANCE) & (np.linalg.det(R) > 0.0)
    require(good, name, R, "a rotation matrix: orthonormal, of determinant 1")
    rounded = off > 1e-12
    if rounded.any():
        U, _, Vt = np.linalg.svd(R[rounded])
        R[rounded] = U @ Vt  # the nearest rotation
    return R


def as_array(name: str, given: object, kinds: str, expected: str) -> NDArray[Any]:
    """Anything as an array of one of numpy's `kinds`.

    Raises:
        InputError: It is none.
    """
    if isinstance(given, np.ma.MaskedArray):
        raise InputError(name, "found a masked array", f"{expected}; nan where something was not measured")
    try:
        array = np.asarray(given)
    except ValueError:  # rows of different lengths
        raise InputError(name, f"found {_shown(given)}", expected) from None
    if array.dtype.kind not in kinds and array.size:
        raise InputError(name, f"found {_shown(given)}", expected)
    return array


def shape_of(name: str, given: object, expected: str) -> tuple[int, ...]:
    """The shape of something from outside.

    Raises:
        InputError: It has none: its rows are of different lengths.
    """
    return as_array(name, given, "iufObUS", expected).shape


def require(good: NDArray[np.bool_], name: str, values: NDArray[Any], expected: str, hint: str = "") -> None:
    """Raise for the first of the values that is not good, named by its row.

    Raises:
        InputError: One is not.
    """
    if not np.all(good):
        place = np.unravel_index(int(np.argmin(good)), np.shape(good))
        row = f": row {place[0]}" if place else ""
        raise InputError(f"{name}{row}", f"found {_shown(values[place])}", expected, hint)


def _shown(value: object) -> str:
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    text = f"{plain:g}" if isinstance(plain, float) else " ".join(repr(plain).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
