"""The exceptions of the package: each message is one line that a user can act on."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from reprlib import Repr


def escaped(text: str) -> str:
    """Text from files as a terminal may get it: what would steer it, end the line or turn the reading is escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def printable(text: str) -> str:
    """`escaped` as one line in which blanks are single."""
    return escaped(" ".join(text.split()))


_LONGEST = 400


def _part(text: str) -> str:
    """A part of a message, cut where it would fill the screen."""
    line = printable(text)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


class CalibrationError(Exception):
    """Base of every error the package raises on purpose."""


class InputError(CalibrationError):
    """Input of the user that cannot be used as it is.

    The message is one line in a fixed order, so that every module words it alike:
    `place: found, expected; hint`. It is printable whatever stands in the file.

    Args:
        place: File, with row or key where there is one: `poses.csv:17`, `robot.yaml: joints[2].a`.
        found: Value found there.
        expected: Value expected there.
        hint: A likely cause or remedy, where there is one.
    """

    def __init__(self, place: str, found: str, expected: str = "", hint: str = "") -> None:
        self.place, self.found, self.expected, self.hint = place, found, expected, hint
        message = f"{_part(place)}: {_part(found)}"
        message += f", expected {_part(expected)}" if expected else ""
        message += f"; {_part(hint)}" if hint else ""
        super().__init__(message)

    def __reduce__(self) -> "tuple[type[InputError], tuple[str, str, str, str]]":
        """How it is pickled: it is made of more than its message, and comes back from a worker process."""
        return type(self), (self.place, self.found, self.expected, self.hint)


def expect(fits: object, place: str, found: str, expected: str = "", hint: str = "") -> None:
    """Raise `InputError` of these words where something does not fit."""
    if not fits:
        raise InputError(place, found, expected, hint)


@contextmanager
def within(place: str) -> Iterator[None]:
    """The place of what is refused in the block is within another place, unless it is already."""
    try:
        yield
    except InputError as error:
        of = "" if error.place.startswith(place) else f"{place}: "
        raise InputError(f"{of}{error.place}", error.found, error.expected, error.hint) from None


class ProblemError(InputError):
    """Readable input that does not make a solvable calibration problem."""


class SolverError(CalibrationError):
    """The solver could not do its work at all (a doubtful result is no error)."""


def shown(value: object) -> str:
    """Something that was found, for a message: its repr, cut to 60 characters; of an array its type and shape."""
    shape = getattr(value, "shape", None)
    plain = value.tolist() if isinstance(shape, tuple) and len(shape) < 2 and hasattr(value, "tolist") else value
    if plain is value and isinstance(shape, tuple):
        return f"{type(value).__name__} of shape {shape}"
    text = " ".join(_REPR.repr(plain).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def shorten(names: Sequence[str], most: int = 3) -> str:
    """`a, b, c and 4 more`."""
    return ", ".join(names[:most]) + f" and {len(names) - most} more" * (len(names) > most)


_REPR = Repr()
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 100
