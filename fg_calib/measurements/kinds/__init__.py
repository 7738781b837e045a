"""Instruments, one a file: columns, landmarks with their start, residual, simulation, and words.

`options.MODELS` registers each model with its file; here they come together.
"""

from importlib import import_module

from fg_calib.inputs import MODELS
from fg_calib.measurements import UNKNOWN, LandmarkKind
from fg_calib.measurements.kinds.instrument import Column, Instrument

_MODULES = [import_module(f"fg_calib.measurements.kinds.{module}") for module in dict.fromkeys(MODELS.values())]
INSTRUMENTS: dict[str, Instrument] = {one.model: one for module in _MODULES for one in module.INSTRUMENTS}
"""The instrument of each model."""

_KINDS = dict.fromkeys((UNKNOWN, *(kind for one in INSTRUMENTS.values() for kind in one.landmarks)))
LANDMARKS: dict[str, LandmarkKind] = {kind.letter: kind for kind in _KINDS}
"""Kinds of landmarks, by the letter of their symbols."""

if len(LANDMARKS) < len(_KINDS):
    raise ValueError(f"two kinds of landmarks have one letter: {' '.join(sorted(kind.letter for kind in _KINDS))}")

_COLUMNS = [column for one in INSTRUMENTS.values() for column in one.columns if column.generic]
GENERIC_COLUMNS: dict[str, Column] = {column.names[0]: column for column in _COLUMNS}
"""Columns that `Measurements.columns` holds, which are kinds of noise too."""
