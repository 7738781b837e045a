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

_KINDS = dict.fromkeys((UNKNOWN, *(kind for one in INSTRUMENTS.values() for kind in one.landmarks)))
LANDMARKS: dict[str, LandmarkKind] = {kind.letter: kind for kind in _KINDS}
"""Kinds of landmarks, by the letter of their symbols."""

if len(LANDMARKS) < len(_KINDS):
    raise ValueError(f"two kinds of landmarks have one letter: {' '.join(sorted(kind.letter for kind in _KINDS))}")

GENERIC_COLUMNS: dict[str, Column] = {
    column.names[0]: column for one in INSTRUMENTS.values() for column in one.columns if column.generic
}
"""Columns that `Measurements.columns` holds, which are kinds of noise too."""
