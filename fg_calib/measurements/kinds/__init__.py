"""Instruments, one a file: columns, landmarks with their start, residual, simulation, and words.

`options.MODELS` registers each model with its file; here they come together.
"""

from importlib import import_module

from fg_calib.inputs import MODELS
from fg_calib.measurements import UNKNOWN, LandmarkKind
from fg_calib.measurements.kinds.instrument import Column, Instrument

INSTRUMENTS: dict[str, Instrument] = {
    instrument.model: instrument
    for module in dict.fromkeys(MODELS.values())
    for instrument in import_module(f"fg_calib.measurements.kinds.{module}").INSTRUMENTS
}
"""The instrument of each model."""

LANDMARKS: dict[str, LandmarkKind] = {
    kind.letter: kind for kinds in ((UNKNOWN,), *(i.landmarks for i in INSTRUMENTS.values())) for kind in kinds
}
"""Kinds of landmarks, by the letter of their symbols."""

GENERIC_COLUMNS: dict[str, Column] = {
    column.names[0]: column for one in INSTRUMENTS.values() for column in one.columns if column.generic
}
"""Columns that `Measurements.columns` holds, which are kinds of noise too."""
