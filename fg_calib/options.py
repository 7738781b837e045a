"""What a user can choose among, and the checks of it; light enough for the command line's help."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any, Literal, get_args

from fg_calib.errors import InputError

Model = Literal["pose", "position", "orientation", "distance", "rotation", "distance-rotation"]
"""What a calibration compares with the measurements: each pose, or part of it, or what lies between two poses."""

FrameKnowledge = Literal["known", "unknown"]
"""Whether the measurement frame is the base, or world_T_base is estimated too."""

Gauge = Literal["prior", "keep", "none"]
"""What holds the directions that data do not determine: tolerances as priors; leaving parameters out; nothing."""

Strategy = Literal["star", "chain", "all", "random"]
"""How pairs are formed from poses."""

PairErrors = Literal["shared", "independent"]
"""Whether pairs of one configuration are taken to share its errors, or to be independent as in the paper."""

EncoderNoise = Literal["propagated", "estimated"]
"""Whether the noise of joint readings is added to that of the rows, or each true joint vector is estimated too."""

Loss = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"]
"""What becomes of large residuals: least squares, or a robust loss."""

LengthUnit = Literal["m", "cm", "mm", "um"]
AngleUnit = Literal["rad", "deg", "mrad"]

MODELS: tuple[Model, ...] = get_args(Model)


def check(key: str, value: object, possible: Any) -> None:
    """Check that an option is one of those possible.

    Args:
        key: Its name, for the message.
        value: What was given.
        possible: A `Literal`, or the values themselves.

    Raises:
        InputError: It is none of them.
    """
    options = get_args(possible) or tuple(possible)
    if not any(value is option or (type(value) is type(option) and value == option) for option in options):
        words = ", ".join(map(str, options))
        raise InputError(key, f"found {value!r}", f"one of {words}", did_you_mean(value, options))


def check_flag(key: str, value: object) -> None:
    """Check that a switch is True or False, and no word that happens to count as True.

    Raises:
        InputError: It is neither.
    """
    if type(value).__name__ not in ("bool", "bool_"):  # Python's and numpy's
        raise InputError(key, f"found {value!r}", "True or False")


def check_type(key: str, value: object, kind: type, example: str) -> None:
    """Check that an option is an object of a class, such as `Pairing` and no strategy's bare name; None is left alone.

    Raises:
        InputError: It is something else.
    """
    if value is not None and not isinstance(value, kind):
        raise InputError(key, f"found {value!r}", f"a {kind.__name__}, such as {example}")


def check_number(
    key: str, value: object, *, least: float = 0.0, above: bool = False, whole: bool = False, finite: bool = True
) -> None:
    """Check that an option is a number of the right kind and size.

    Args:
        key: Its name, for the message.
        value: What was given.
        least: The smallest number possible.
        above: Whether it must be above that.
        whole: Whether it must be a whole number.
        finite: Whether it must be finite.

    Raises:
        InputError: It is no number, nan, or not of this kind and size.
    """
    good = isinstance(value, Real) and not isinstance(value, bool)
    if good:
        try:
            x = float(value)  # type: ignore[arg-type]
        except OverflowError:  # a whole number beyond any float
            x = math.inf
        good = (x > least if above else x >= least) and (math.isfinite(x) or not finite)
        good = good and not (whole and not isinstance(value, Integral))
    if not good:
        kind = "a whole number" if whole else "a finite number" if finite else "a number"
        raise InputError(key, f"found {value!r}", f"{kind} {'above' if above else 'not below'} {least:g}")


def check_names(key: str, names: Iterable[str], known: Sequence[str], what: str = "parameter") -> None:
    """Check that a list holds known names only.

    Args:
        key: The list's name, for the message.
        names: The names given.
        known: Those possible.
        what: What they are names of.

    Raises:
        InputError: It is one word instead of a list, or a name is not known.
    """
    if isinstance(names, str) or not isinstance(names, Iterable) or not getattr(names, "ndim", 1):
        raise InputError(key, f"found {names!r}", "a list of names")
    for name in names:
        if name not in known:
            raise InputError(key, f"unknown {what} {name!r}", known_names(known), did_you_mean(name, known, NEAR))


NEAR = 0.87
"""Likeness of names (see `difflib`) that is a slip of the pen: tool.w is as like tool.x as it is like tool.z."""


def did_you_mean(value: object, options: Iterable[object], likeness: float = 0.6) -> str:
    """`did you mean shared?` where an option reads nearly like what was given, whatever its case; else nothing.

    The first letter must be the same: whoever writes grad does not mean rad.
    """
    if not isinstance(value, str) or not value:
        return ""
    given = value.lower()
    words = {option.lower(): option for option in options if isinstance(option, str)}
    close = difflib.get_close_matches(given, [w for w in words if w[:1] == given[0]], 1, likeness)
    return f"did you mean {words[close[0]]}?" if close else ""


def known_names(names: Iterable[str], limit: int = 12) -> str:
    """`one of a, b, c` for an error message, cut after `limit` names."""
    listed = list(names)
    shown = ", ".join(listed[:limit])
    return f"one of {shown}{', ...' if len(listed) > limit else ''}"
