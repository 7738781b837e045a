"""What public functions are given, compared with their own type hints before anything is done with it.

Only what a hint says by itself is looked at: the package's classes, sequences of them, text, paths, mappings and
functions. Figures, arrays and words of a choice have checks of their own where they are used (`arrays`, `options`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from fg_calib.errors import InputError, shown

P = ParamSpec("P")
R = TypeVar("R")

EXAMPLES = {
    "Column": "Column('J1')",
    "Comparison": "compare(read_job('job.yaml'))",
    "Generator": "numpy.random.default_rng(0)",
    "Identifiability": "observe_structure(robot, 'pose')",
    "Job": "read_job('job.yaml')",
    "Measurements": "Measurements.from_arrays(...)",
    "Noise": "Noise(position=1e-3)",
    "Options": "Options(model='pose')",
    "Own": "Own(kind, data, sigma)",
    "Pairing": "Pairing('chain')",
    "Problem": "build_problem(robot, measurements)",
    "Robot": "Robot.from_dh(...)",
    "Scenario": "read_scenario('space-robot')",
    "Simulation": "simulate(scenario)",
    "Solution": "solve(problem)",
    "SolverOptions": "SolverOptions(max_iterations=200)",
    "Table": "Table(measurements, 'pose')",
    "Assessment": "assess(solution)",
    "Units": "Units(length='mm')",
    "Variables": "problem.variables",
}
"""Where an object of a class comes from, for messages."""


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """A function whose arguments are compared with its type hints first; paths of any kind become `Path`.

    It raises `InputError` for an argument that is something else, and named as the parameter is.
    """

    @wraps(function)
    def with_checked(*args: P.args, **kwargs: P.kwargs) -> R:
        takes = _signature(function)
        try:
            given = takes.bind(*args, **kwargs)
        except TypeError:  # as Python itself says it
            return function(*args, **kwargs)
        hints = _hints(function)
        for name, p in takes.parameters.items():
            if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
                continue
            if name in given.arguments and name in hints:
                given.arguments[name] = as_hinted(name, given.arguments[name], hints[name])
        return function(*given.args, **given.kwargs)

    return with_checked


def check_fields(of: object, place: str = "") -> None:
    """Compare the fields of a dataclass with their type hints.

    Args:
        of: The object.
        place: What stands before a field's name in messages.

    Raises:
        InputError: One is something else.
    """
    hints: dict[str, Any] = _hints(type(of))  # type: ignore[arg-type] # classes are hashable
    for f in fields(of):  # type: ignore[arg-type] # a dataclass
        as_hinted(f"{place}: {f.name}" if place else f.name, getattr(of, f.name), hints[f.name])


def as_hinted(name: str, value: Any, hint: Any) -> Any:
    """A value that fits a type hint; a path of another kind as a `Path`.

    Raises:
        InputError: It does not fit.
    """
    if isinstance(value, str) and not value and Path in (kinds := _alternatives(hint)) and Any not in kinds:
        raise InputError(name, "found ''", _expected(hint))
    if _fits(value, hint):
        return value
    if Path in _alternatives(hint) and isinstance(value, os.PathLike) and isinstance(os.fspath(value), str):
        return Path(os.fspath(value))
    for one in filter(_is_mapping, _alternatives(hint)):
        for key, entry in value.items() if isinstance(value, Mapping) else ():
            as_hinted(f"{name}: {key}", entry, get_args(one)[1])
    for one in filter(_is_list, _alternatives(hint)):
        for i, entry in enumerate(value if isinstance(value, list | tuple) else ()):
            as_hinted(f"{name}[{i}]", entry, get_args(one)[0])
    raise InputError(name, f"found {shown(value)}", _expected(hint))


_signature = cache(signature)
"""Of a function when it is first called: those of all functions would be a twentieth of a small calibration."""


@cache
def _hints(of: Any) -> dict[str, Any]:
    later: dict[str, Any] = {}  # what a module imports for its hints alone, because it is seldom needed
    while True:
        try:
            return {name: hint for name, hint in get_type_hints(of, localns=later).items() if name != "return"}
        except NameError as missing:
            name = str(missing.name)
            later[name] = getattr(import_module("fg_calib"), name)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _fits(value: Any, hint: Any) -> bool:
    return any(_fits_one(value, one) for one in _alternatives(hint))


def _fits_one(value: Any, hint: Any) -> bool:
    """Whether a value fits one alternative of a hint; True of all that is checked elsewhere."""
    origin, parts = get_origin(hint), get_args(hint)
    if _is_list(hint):
        return isinstance(value, list | tuple) and all(_fits(one, parts[0]) for one in value)
    if origin in (Mapping, dict):
        if not _is_mapping(hint):
            return isinstance(value, Mapping)
        return isinstance(value, Mapping) and all(_fits(one, parts[1]) for one in value.values())
    if origin is Callable:
        return callable(value)
    return isinstance(value, hint) if _is_class(hint) else True


def _is_list(hint: Any) -> bool:
    """Whether a hint is one of a sequence of objects of the package."""
    parts = get_args(hint)
    if get_origin(hint) is not Sequence and not (get_origin(hint) is tuple and parts[1:] == (...,)):
        return False
    return all((_is_class(one) and one is not str) or get_origin(one) is Callable for one in _alternatives(parts[0]))


def _is_mapping(hint: Any) -> bool:
    """Whether a hint is one of a mapping to objects of the package."""
    return get_origin(hint) in (Mapping, dict) and _is_class(get_args(hint)[1]) and get_args(hint)[1] is not str


def _is_class(hint: Any) -> bool:
    if not isinstance(hint, type) or get_origin(hint) is not None:
        return False
    return hint in (str, Path, NoneType) or hint.__module__.startswith("fg_calib.") or hint.__name__ in EXAMPLES


def _expected(hint: Any) -> str:
    """`a Robot, such as Robot.from_dh(...)`."""
    words: list[str] = []
    example = ""
    for one in _alternatives(hint):
        if one is NoneType or (one is str and Path in _alternatives(hint)):
            continue
        if _is_list(one):
            words.append(f"a list of {'them' if words else _expected(get_args(one)[0])}")
            continue
        kind = get_origin(one) or one
        words.append(_WORDS.get(kind) or f"a{'n' * (kind.__name__[0] in 'AEIO')} {kind.__name__}")
        example = example or EXAMPLES.get(kind.__name__, "")
    listed = " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    return f"{listed}, such as {example}" if example else listed


_WORDS = {str: "text", Path: "a path", Mapping: "a mapping", dict: "a mapping", Callable: "a function"}
