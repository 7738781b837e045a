"""Checks of arguments: by type hints, of choices, numbers and names.

`checked` compares the package's classes, generators, executors, sequences of them, choices, switches, text and paths.
Numbers and arrays are checked where they are used.
"""

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, wraps
from importlib import import_module
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from fg_calib.inputs.errors import InputError, shown

P = ParamSpec("P")
R = TypeVar("R")

LEAST_SIZE, MOST_SIZE = 1e-30, 1e15
"""The smallest sigma and the largest number that are accepted: beyond them squares overflow."""

ORDINARY = f"a number no larger than {MOST_SIZE:g}; sigmas and tolerances no less than {LEAST_SIZE:g}"
"""Expected size of a number, for messages."""

EXAMPLES = {
    "Generator": "numpy.random.default_rng(0)",
    "Limits": "Limits(position=5e-4)",
    "Job": "read_job('job.yaml')",
    "Measurements": "Measurements.from_arrays(...)",
    "Noise": "Noise(position=1e-3)",
    "Options": "Options(model='pose')",
    "Pairing": "Pairing('chain')",
    "Robot": "Robot.from_dh(...)",
    "SolverOptions": "SolverOptions(max_iterations=200)",
    "Units": "Units(length='mm')",
}
"""Example of an object of a class, for messages."""

_COMPARED = ("fg_calib.", "concurrent.", "numpy.random.", "pathlib")
"""Modules whose classes are compared; choices, switches, text and None are too."""

_WORDS = {str: "text", bool: "True or False", Path: "a path", Callable: "a function"}


class Reader:
    """A constructor that is a function of `fg_calib.io`, which the folder of its class does not import.

    Args:
        function: Its name.
    """

    def __init__(self, function: str) -> None:
        self._function = function

    def __get__(self, instance: object, owner: type) -> Callable[..., Any]:
        """The function."""
        found: Callable[..., Any] = getattr(import_module("fg_calib.io"), self._function)
        return found


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """A function that raises `InputError` for an argument that does not fit its type hint."""

    @wraps(function)
    def with_checked(*args: P.args, **kwargs: P.kwargs) -> R:
        hints = _hints(function)
        given: dict[str, Any] = {}
        with suppress(TypeError):  # the call below fails in Python's own words
            given = _signature(function).bind(*args, **kwargs).arguments
        for name in given.keys() & hints.keys():
            check_type(name, given[name], hints[name])
        return function(*args, **kwargs)

    return with_checked


def check_fields(of: object, place: str = "") -> None:
    """Compare the fields of a dataclass with their type hints.

    Args:
        of: The object.
        place: The words before a field's name in messages.

    Raises:
        InputError: A field does not fit.
    """
    for name, hint in _hints(type(of)).items():  # type: ignore[arg-type] # classes are hashable
        check_type(f"{place}{name}", getattr(of, name), hint)


def check_type(place: str, value: Any, hint: Any) -> None:
    """Check that a value fits a type hint.

    Raises:
        InputError: The value does not fit.
    """
    kinds = _alternatives(hint)
    if _fits(value, hint) and not (Path in kinds and isinstance(value, str) and not value):
        return
    words = [_describe(kind) for kind in kinds if kind is not NoneType and not (kind is str and Path in kinds)]
    names = (getattr(kind, "__name__", "") for kind in kinds)
    example = next((f", such as {EXAMPLES[name]}" for name in names if name in EXAMPLES), "")
    choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
    raise InputError(place, f"found {shown(value)}", f"{' or '.join(words)}{example}", did_you_mean(value, choices))


_signature = cache(signature)


@cache
def _hints(of: Any) -> dict[str, Any]:
    unknown: dict[str, Any] = {}  # names that a module imports for its hints alone
    while True:
        try:
            return {name: hint for name, hint in get_type_hints(of, localns=unknown).items() if name != "return"}
        except NameError as missing:
            unknown[str(missing.name)] = Any


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _fits(value: Any, hint: Any) -> bool:
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is Sequence or (origin is tuple and parts[1:] == (...,)):
        items = _alternatives(parts[0])
        names = Path not in items and any(kind is str or get_origin(kind) is Literal for kind in items)
        return names or (isinstance(value, list | tuple) and all(_fits(one, parts[0]) for one in value))
    if origin in (Mapping, dict):
        return isinstance(value, Mapping) and all(_fits(one, parts[1]) for one in value.values())
    if not isinstance(hint, type) or not (hint in (str, bool, NoneType) or hint.__module__.startswith(_COMPARED)):
        return origin is not Callable or callable(value)
    return isinstance(value, hint) or (hint is bool and type(value).__name__.startswith("bool"))  # numpy's


def _describe(hint: Any) -> str:
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind is Literal:
        return f"one of {', '.join(parts)}"
    if kind in (Sequence, tuple):
        return f"a list of {' or '.join(getattr(part, '__name__', 'them') for part in _alternatives(parts[0]))}"
    if kind in (Mapping, dict):
        return "a mapping"
    return _WORDS.get(kind) or f"a{'n' * (kind.__name__[0] in 'AEIO')} {kind.__name__}"


def check(key: str, value: object, possible: Any) -> Any:
    """The option that was given, one of those possible.

    Args:
        key: Its name, for the message.
        value: The given value.
        possible: A `Literal`, or the values themselves.

    Raises:
        InputError: The option is not one of those possible.
    """
    options = get_args(possible) or tuple(possible)
    if not isinstance(value, str) or value not in options:
        raise InputError(key, f"found {shown(value)}", f"one of {', '.join(options)}", did_you_mean(value, options))
    return value


def check_number(
    key: str, value: object, *, least: float = 0.0, above: bool = False, whole: bool = False, most: int | None = None
) -> None:
    """Check that an option is a number of the right kind and size.

    Args:
        key: Its name, for the message.
        value: The given value.
        least: The smallest number possible.
        above: Whether it must be above that.
        whole: Whether it must be a whole number.
        most: The largest number possible.

    Raises:
        InputError: The option is no number, nan, or not of this kind and size.
    """
    try:
        x = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:  # a whole number beyond any float
        x = math.inf
    large = x > least if above else x >= least
    if not large or not math.isfinite(x) or (whole and not isinstance(value, Integral)):
        kind = "a whole number" if whole else "a finite number"
        raise InputError(key, f"found {shown(value)}", f"{kind} {'above' if above else 'not below'} {least:g}")
    if x > MOST_SIZE or (above and x < LEAST_SIZE):
        raise InputError(key, f"found {shown(value)}", ORDINARY)
    if most is not None and x > most:
        raise InputError(key, f"found {shown(value)}", f"at most {most}")


def check_names(key: str, names: Iterable[str], known: Sequence[str], what: str = "parameter") -> None:
    """Check that a list holds known names only.

    Args:
        key: The list's name, for the message.
        names: The names given.
        known: Possible names.
        what: Kind of the names.

    Raises:
        InputError: The list is one word, or a name is not known.
    """
    if isinstance(names, str) or not isinstance(names, Iterable) or not getattr(names, "ndim", 1):
        raise InputError(key, f"found {shown(names)}", "a list of names")
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise InputError(key, f"unknown {what} {shown(name)}", known_names(known), did_you_mean(name, known, NEAR))


NEAR = 0.87
"""Likeness of names (see `difflib`) from which one is suggested: tool.w is as like tool.x as it is like tool.z."""


def did_you_mean(value: object, options: Iterable[object], likeness: float = 0.6) -> str:
    """`did you mean shared?` if an option is nearly what was given, in any case of letters; else nothing.

    The first letter must be the same: grad does not mean rad.
    """
    if not isinstance(value, str) or not value:
        return ""
    given = value.lower()
    words = {option.lower(): option for option in options if isinstance(option, str)}
    close = difflib.get_close_matches(given, [w for w in words if w[:1] == given[0]], 1, likeness)
    return f"did you mean {words[close[0]]}?" if close else ""


def listed(key: str, names: Iterable[Any], expected: str = "a list of names") -> tuple[Any, ...]:
    """Names as a tuple: an iterator would be empty the second time.

    Raises:
        InputError: The names cannot be iterated over.
    """
    if isinstance(names, str):
        return (names,)
    try:
        return tuple(names)
    except TypeError:
        raise InputError(key, f"found {shown(names)}", expected) from None


def known_names(names: Iterable[str], limit: int = 12) -> str:
    """`one of a, b, c` for an error message, cut after `limit` names."""
    listed = list(names)
    return f"one of {', '.join(listed[:limit])}{', ...' if len(listed) > limit else ''}"
