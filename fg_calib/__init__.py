"""fg_calib: robot-arm calibration as a factor graph.

    robot = Robot.from_dh(rows, convention="dh-hayati", tool=[0, 0, 0.1])
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4)
    result = calibrate(robot, data, model="position", frame="unknown")
    print(result)

Names are imported when they are first used, so that `fg-calib --help` need not wait for GTSAM.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import Any

import lazy_loader  # type: ignore[import-untyped]

__version__ = "0.1.0"

_import, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
"""The names of most users, as the stub lists them: 40. Others are public in the folders: `fg_calib.io`, ..."""

_READERS = {
    "Robot": {"from_urdf": "read_urdf"},
    "Measurements": {"from_arrays": "read_arrays", "from_frame": "read_measurements"},
}
"""Constructors that read files, which the folders of these classes do not import: they are attached here."""


def __getattr__(name: str) -> Any:
    """Import a public name from the module that has it."""
    found = _import(name)
    for constructor, reader in _READERS.get(name, {}).items():
        setattr(found, constructor, staticmethod(getattr(import_module("fg_calib.io"), reader)))
    return found


logging.getLogger(__name__).addHandler(logging.NullHandler())
