"""Units of files; inside the program everything is SI."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import BeforeValidator

from fg_calib.inputs import LEAST_SIZE, AngleUnit, InputError, LengthUnit, did_you_mean, set_checked
from fg_calib.io.yaml import Positive, Schema, refuse_unknown_keys, shown, validate

LENGTHS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Metres in one unit of length."""

ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3}
"""Radians in one unit of angle."""


@dataclass(frozen=True)
class Units:
    """The units in which a file states lengths and angles.

    Attributes:
        length: Unit of length.
        angle: Unit of angle.
    """

    length: LengthUnit = "m"
    angle: AngleUnit = "rad"

    def __post_init__(self) -> None:
        set_checked(self, "units: ", length=LengthUnit, angle=AngleUnit)

    def name(self, unit: str) -> str:
        """The file's unit for what is in `m` or `rad` inside the program."""
        return self.length if unit == "m" else self.angle

    def factor(self, unit: str) -> float:
        """What a value of the file is multiplied by to be in `unit`: `m`, `rad`, or one that no file has another of."""
        return {"m": LENGTHS[self.length], "rad": ANGLES[self.angle]}.get(unit, 1.0)

    def sigma(self, figure: float, unit: str, place: str) -> float:
        """A sigma or tolerance of the file, 0 or above, in `unit`, `m` or `rad`.

        Args:
            figure: As the file has it.
            unit: What it is in inside the program.
            place: File and key, for messages.

        Raises:
            InputError: It is so small that nothing can be weighted by it.
        """
        value = figure * self.factor(unit)
        if 0.0 < value < LEAST_SIZE:
            raise InputError(place, f"found {figure:g} {self.name(unit)}", f"{LEAST_SIZE:g} {unit} or more")
        return value

    def from_si(self, value: float, unit: str) -> float:
        """The figure for the file of a value in `unit`: the shorter one where that reads back the same."""
        factor = self.factor(unit)
        figure = float(value) / factor
        short = float(f"{figure:.15g}")
        return short if short * factor == value else figure


def quantity(given: object, unit: str, units: Units | None, place: str) -> float:
    """A positive figure in [m] or [rad] from a number in the file's units, or from text with its own: `0.5 mm`.

    Args:
        given: What the file holds.
        unit: `m` or `rad`.
        units: Of the file; None where a figure must have its own.
        place: File and key, for messages.

    Raises:
        InputError: It is neither.
    """
    known = LENGTHS if unit == "m" else ANGLES
    number, name = given, "" if units is None else units.name(unit)
    if isinstance(given, str) and (read := _QUANTITY.fullmatch(given)):
        number, name = read["number"], read["unit"] or name
        if not name:
            raise InputError(place, number, hint=f"give a unit, such as {number}{'mm' if unit == 'm' else 'deg'}")
    if name not in known:
        expected = f"a number with one of {', '.join(known)}"
        raise InputError(place, f"found {shown(given)}", expected, did_you_mean(name, known))
    try:
        return validate(_Figure, {"figure": number}, "").figure * known[name]
    except InputError as error:
        expected = f"{error.expected}, with its unit{'' if units is None else ' or without'}"
        raise InputError(place, f"found {shown(given)}", expected, error.hint) from None


class _Figure(Schema):
    figure: Positive


_QUANTITY = re.compile(r"\s*(?P<number>[^\s]*[0-9.])\s*(?P<unit>[A-Za-z]*)\s*")


UnitsOfFile = Annotated[Units, BeforeValidator(refuse_unknown_keys("length", "angle"))]
"""Units under a file's key `units`."""
