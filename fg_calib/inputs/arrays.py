"""Arrays from outside, checked, and arrays that stay as they are: those of frozen types are read-only."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, dataclass_transform

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator

from fg_calib.inputs.arguments import LEAST_SIZE, MOST_SIZE, ORDINARY
from fg_calib.inputs.errors import InputError, expect, shown


def _read_as(dtype: DTypeLike) -> PlainValidator:
    """Arrays from JSON: from nested lists, null for what is not finite."""

    def read(value: Any) -> NDArray[Any]:
        try:
            return value if isinstance(value, np.ndarray) else np.array(value, dtype=dtype)
        except (TypeError, OverflowError) as error:  # pydantic reports ValueError alone
            raise ValueError(str(error)) from None

    return PlainValidator(read, json_schema_input_type=list[Any])


def _listed(values: NDArray[Any]) -> list[Any]:
    known = values.dtype.kind != "f" or np.isfinite(values)
    listed: list[Any] = (values if np.all(known) else np.where(known, values.astype(object), np.array(None))).tolist()
    return listed


_AS_LISTS = PlainSerializer(_listed, return_type=Any)

Floats = Annotated[NDArray[np.float64], _read_as(np.float64), _AS_LISTS]
Integers = Annotated[NDArray[np.int64], _read_as(np.int64), _AS_LISTS]
Booleans = Annotated[NDArray[np.bool_], _read_as(np.bool_), _AS_LISTS]
"""Arrays that a typed result writes to JSON and reads back, as fields of dataclasses too."""

Figure = Annotated[
    float,
    BeforeValidator(lambda value: np.nan if value is None else value),
    PlainSerializer(lambda value: float(value) if np.isfinite(value) else None, return_type=float | None),
]
"""A number that may be nan, for unknown, or infinite: null in JSON."""

Sigma = Annotated[float, Field(ge=0.0)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
"""Numbers that a typed result holds to their range when it is read back."""

NORM_TOLERANCE = 1e-3
"""How far a quaternion or a rotation matrix may be from length 1: more is not rounding."""


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
class Record:
    """Base of frozen dataclasses: a class that derives from it is one, with the options of `dataclass` as its own."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__()
        dataclass(frozen=True, **options)(cls)


class Brief(Record):
    """Base of dataclasses that hold arrays: a repr fits a screen, with shapes for arrays and types for long values."""

    def __init_subclass__(cls, **options: Any) -> None:
        if "__repr__" not in vars(cls):
            cls.__repr__ = lambda self: brief(self, (f.name for f in fields(self) if f.repr))  # type: ignore
        super().__init_subclass__(**options)


def brief(of: object, names: Iterable[str]) -> str:
    """`MeasurementBlock(kind=Distance, ends=int64 (12, 2), ...)`, a line each where it is long.

    Args:
        of: An object.
        names: Attributes to show.
    """
    parts = [f"{name}={_in_brief(getattr(of, name))}" for name in names]
    line = f"{type(of).__name__}({', '.join(parts)})"
    return line if len(line) <= _WIDTH else "\n  ".join([f"{type(of).__name__}:", *parts])


def _in_brief(value: object) -> str:
    if isinstance(value, np.ndarray) and value.ndim < 2 and value.size <= _FEW:
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


def once(values: NDArray[Any]) -> NDArray[Any]:
    """Values, in memory only once where all rows are the same: of a long table that is most of it."""
    same = len(values) > 0 and (is_one(values) or np.all(values == values[0]))
    return np.broadcast_to(values[:1].copy(), values.shape) if same else values


def is_one(values: NDArray[Any]) -> bool:
    """Whether all rows are the same place in memory."""
    return len(values) > 0 and values.strides[0] == 0


def _read_only(value: object) -> object:
    if not isinstance(value, np.ndarray) or not value.flags.writeable:
        return value
    view = value.view()
    view.flags.writeable = False
    return view


def as_floats(name: str, given: object, shape: str, *, missing: bool = False) -> Floats:
    """Numbers from outside as an array, a copy wherever the caller could change it.

    Args:
        name: Name in messages.
        given: Numbers, sequences or arrays of them.
        shape: The shape wanted, such as `(n, 3)`: letters are any number of rows.
        missing: Whether nan, or None, may stand for what is missing.

    Raises:
        InputError: The values are no numbers, of another shape, or not finite.
    """
    floats = as_figures(name, given, f"numbers of shape {shape}")
    wanted = [word.strip() for word in shape.strip("()").split(",") if word.strip()]
    fits = floats.ndim == len(wanted) and all(
        not word.isdigit() or int(word) == n for word, n in zip(wanted, floats.shape, strict=True)
    )
    expect(fits, name, f"shape {floats.shape}", shape)
    check_sizes(name, floats, missing=missing)
    return floats


def as_figures(name: str, given: object, expected: str) -> Floats:
    """Numbers from outside as an array of any shape, a copy; text that reads as a number is none.

    Raises:
        InputError: The values are no numbers.
    """
    array = as_array(name, given, "iufO", expected)
    words = array.dtype.kind == "O" and any(isinstance(value, str | bytes | bool | np.bool_) for value in array.ravel())
    try:
        figures = None if words else np.array(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        figures = None
    if figures is None:
        raise InputError(name, f"found {_shown(given)}", expected)
    return figures


def check_sizes(name: str, floats: Floats, *, missing: bool = False) -> None:
    """Check that numbers are finite and of a size that arithmetic holds.

    Raises:
        InputError: One is not.
    """
    require(np.isfinite(floats) | (missing & np.isnan(floats)), name, floats, "a finite number")
    require(~(np.abs(floats) > MOST_SIZE), name, floats, ORDINARY)


def as_rotations(name: str, given: object, n: int) -> Floats:
    """N rotation matrices from outside, rounding taken off them, shape (n, 3, 3).

    Raises:
        InputError: The values are of another shape, or no rotations.
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


def as_indices(name: str, given: Any, n: int, most: int | None) -> Integers:
    """Whole numbers from 0, a row each of n, up to `most` where there is such."""
    values = as_array(name, given, "iu", f"whole numbers, a row for each of {n}").copy()
    expect(values.shape[:1] == (n,), name, f"shape {values.shape}", f"a row for each of {n}")
    good = (values >= 0) & ((values <= most) if most is not None else True)
    require(good, name, values, "0 and above" if most is None else f"0 to {most}")
    return values


def as_sigmas(name: str, given: Any, shape: tuple[int, ...]) -> Floats:
    """Sigmas that broadcast to (n,) or (n, k), from such, or one a row."""
    sigma = as_figures(name, given, "finite numbers")
    check_sizes(name, sigma)
    require(sigma > 0.0, name, sigma, "a number above 0")
    require(sigma >= LEAST_SIZE, name, sigma, ORDINARY)
    if len(shape) == 2 and sigma.shape == shape[:1] != (1,):
        if (n := shape[0]) == shape[1]:
            raise InputError(name, f"shape ({n},) of {n} rows", f"({n}, 1) for one a row, (1, {n}) for one an axis")
        sigma = sigma[:, None]
    try:
        np.broadcast_to(sigma, shape)
    except ValueError:
        raise InputError(name, f"shape {np.shape(given)}", f"one that broadcasts to {shape}, or one a row") from None
    return sigma


def as_mask(name: str, given: object, n: int) -> Booleans:
    """A mask of n rows."""
    mask = as_array(name, given, "b", f"True or False for each of {n} rows").astype(np.bool_)
    expect(mask.shape == (n,), name, f"shape {mask.shape}", f"({n},), one a row")
    return mask


def as_array(name: str, given: object, kinds: str, expected: str) -> NDArray[Any]:
    """Anything as an array of one of numpy's `kinds`.

    Raises:
        InputError: The value is no such array.
    """
    if isinstance(given, np.ma.MaskedArray):
        raise InputError(name, "found a masked array", f"{expected}; nan where something was not measured")
    if isinstance(given, Iterator):
        raise InputError(name, f"found a {type(given).__name__}", expected, "list(...) makes a list of it")
    try:
        array = np.asarray(given)
    except (ValueError, TypeError, RecursionError):  # rows of different lengths, objects that are no arrays
        raise InputError(name, f"found {_shown(given)}", expected) from None
    if array.dtype.kind not in kinds and array.size:
        kind = f", {array.dtype}" if isinstance(given, np.ndarray) else ""
        raise InputError(name, f"found {_shown(given)}{kind}", expected)
    return array


def as_frame(name: str, given: Any) -> Any | None:
    """A frame of polars or pandas whose names are different without blanks around them; None of what is no frame.

    Raises:
        InputError: A name stands there twice.
    """
    frame = given.collect() if hasattr(type(given), "collect") else given
    if not hasattr(frame, "columns"):
        return None
    check_different(name, list(frame.columns))
    return frame


def check_different(name: str, columns: Iterable[object], hint: str = "") -> None:
    """Check that names of columns differ without the blanks around them.

    Raises:
        InputError: Two are the same.
    """
    for column, n in Counter(str(column).strip() for column in columns).items():
        found = f"two columns called {column!r}" if column else "two columns without a name"
        expect(n == 1, name, found, "different names", hint)


NOTHING = ("na", "n/a", "<na>", "nan", "none", "null", "-", "--")
"""Words that stand for nothing and are no names, in small letters: R writes NA, Python nan or None."""


def as_names(name: str, given: object, *, missing: bool = False) -> list[str | None]:
    """Names from outside: words, or whole numbers as words.

    Args:
        name: Name in messages.
        given: The names.
        missing: Whether None, nan or an empty word may stand for none, which is None then.

    Raises:
        InputError: The values are neither words nor whole numbers.
    """
    found: list[str | None] = []
    listed = given if isinstance(given, list | tuple) else as_array(name, given, "iufUO", "names").tolist()
    for row, one in enumerate(listed):  # numpy would make words of what shares a list with words, even of None
        whole = missing and isinstance(one, float) and one.is_integer()  # so pandas has whole numbers with nan
        cell: Any = int(one) if whole else one
        none = missing and (cell is None or type(cell).__name__ == "NAType" or cell == "" or cell != cell)  # noqa: PLR0124
        word = isinstance(cell, str | int | np.integer) and not isinstance(cell, bool)
        if not none and (not word or str(cell).strip().lower() in ("", *NOTHING)):
            expected = f"a name{', or None for none' * missing}: a word or a whole number"
            raise InputError(f"{name}: row {row}", f"found {_shown(cell)}", expected)
        found.append(None if none else str(cell))
    return found


def shape_of(name: str, given: object, expected: str) -> tuple[int, ...]:
    """The shape of something from outside.

    Raises:
        InputError: The array has no shape: its rows are of different lengths.
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
    plain = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
    return f"{plain:g}" if isinstance(plain, float) else shown(plain)
