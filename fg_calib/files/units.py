"""Units of files; inside the program everything is SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import BeforeValidator

from fg_calib.files.schema import Schema, Section, meaning, refuse_unknown_keys
from fg_calib.options import AngleUnit, LengthUnit, set_checked

LENGTHS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
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
        """What a figure of the file is multiplied by to be in `unit`, `m` or `rad`."""
        return LENGTHS[self.length] if unit == "m" else ANGLES[self.angle]

    def from_si(self, value: float, unit: str) -> float:
        """The figure for the file of a value in `unit`: the shorter one where that reads back the same."""
        factor = self.factor(unit)
        figure = float(value) / factor
        short = float(f"{figure:.15g}")
        return short if short * factor == value else figure


class _Units(Schema):
    length: LengthUnit = meaning("Of lengths", "m")
    angle: AngleUnit = meaning("Of angles", "rad")


UnitsOfFile = Annotated[Units, BeforeValidator(refuse_unknown_keys(*_Units.model_fields))]
"""Units under a file's key `units`."""

UNITS = Section("units", _Units)
"""The keys of `units`, for the reference."""
