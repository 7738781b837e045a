"""Checks of what public functions are given, by their own type hints, and the range of ordinary numbers.

Only the package's classes, generators, executors, sequences of them, text and paths are compared. Numbers, arrays and
words of a choice are checked where they are used (`arrays`, `options`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from fg_calib.errors import InputError, shown

P = ParamSpec("P")
R = TypeVar("R")

LEAST_SIZE, MOST_SIZE = 1e-30, 1e15
"""The smallest sigma and the largest number that are accepted: beyond them squares overflow."""

ORDINARY = f"a number no larger than {MOST_SIZE:g}; sigmas and tolerances no less than {LEAST_SIZE:g}"
"""What is expected, for messages."""

EXAMPLES = {
    "Generator": "numpy.random.default_rng(0)",
    "Job": "read_job('job.yaml')",
    "Measurements": "Measurements.from_arrays(...)",
    "Noise": "Noise(position=1e-3)",
    "Options": "Options(model='pose')",
    "Pairing": "Pairing('chain')",
    "Robot": "Robot.from_dh(...)",
    "SolverOptions": "SolverOptions(max_iterations=200)",
    "Units": "Units(length='mm')",
}
"""Where an object of a class comes from, for messages."""

_COMPARED = ("fg_calib.", "concurrent.", "numpy.random.", "pathlib")
"""Modules whose classes are compared; text and None are too."""


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """A function that raises `InputError` for an argument that does not fit its type hint."""

    @wraps(function)
    def with_checked(*args: P.args, **kwargs: P.kwargs) -> R:
        takes, hints = _signature(function), _hints(function)
        try:
            given = takes.bind(*args, **kwargs)
        except TypeError:  # in Python's own words
            return function(*args, **kwargs)
        for name in given.arguments.keys() & hints.keys():
            if takes.parameters[name].kind not in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD):
                given.arguments[name] = as_hinted(name, given.arguments[name], hints[name])
        return function(*given.args, **given.kwargs)

    return with_checked


def check_fields(of: object, place: str = "") -> None:
    """Compare the fields of a dataclass with their type hints.

    Args:
        of: The object.
        place: What stands before a field's name in messages.

    Raises:
        InputError: A field does not fit.
    """
    hints = _hints(type(of))  # type: ignore[arg-type] # classes are hashable
    for f in fields(of):  # type: ignore[arg-type] # a dataclass
        as_hinted(f"{place}: {f.name}" if place else f.name, getattr(of, f.name), hints[f.name])


def as_hinted(place: str, value: Any, hint: Any) -> Any:
    """A value that fits a type hint; a path of another class as a `Path`.

    Raises:
        InputError: The value does not fit.
    """
    kinds = _alternatives(hint)
    if _fits(value, hint) and not (Path in kinds and isinstance(value, str) and not value):
        return value
    if Path in kinds and isinstance(value, os.PathLike):
        return Path(os.fspath(value))
    words = [_describe(kind) for kind in kinds if kind is not NoneType and not (kind is str and Path in kinds)]
    example = next(
        (f", such as {EXAMPLES[n]}" for n in (getattr(k, "__name__", "") for k in kinds) if n in EXAMPLES), ""
    )
    listed = " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    raise InputError(place, f"found {shown(value)}", f"{listed}{example}")


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
    if origin is Sequence or (origin is tuple and parts[1:] == (...,)):
        names = str in _alternatives(parts[0]) and Path not in _alternatives(parts[0])  # checked where they are known
        return names or (isinstance(value, list | tuple) and all(_fits(one, parts[0]) for one in value))
    if origin in (Mapping, dict):
        return isinstance(value, Mapping) and all(_fits(one, parts[1]) for one in value.values())
    if origin is Callable:
        return callable(value)
    is_compared = isinstance(hint, type) and origin is None
    is_compared = is_compared and (hint in (str, NoneType) or hint.__module__.startswith(_COMPARED))
    return not is_compared or isinstance(value, hint)


def _describe(hint: Any) -> str:
    words = {str: "text", Path: "a path", Mapping: "a mapping", dict: "a mapping", Callable: "a function"}
    kind = get_origin(hint) or hint
    if kind in (Sequence, tuple):
        return f"a list of {getattr(get_args(hint)[0], '__name__', 'them')}"
    return words.get(kind) or f"a{'n' * (kind.__name__[0] in 'AEIO')} {kind.__name__}"
