"""The units that figures are shown in."""

from __future__ import annotations

import numpy as np

SHOWN = {"m": (1e3, "mm", 4), "rad": (180.0 / np.pi, "deg", 5), "px": (1.0, "px", 3)}
"""Factor, unit and decimals in which a quantity is shown."""

FAMILY_UNIT = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad", "point": "m", "pixel": "px"}
"""Unit of the usual kinds of residual, in the order in which reports show them."""
