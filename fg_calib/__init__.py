"""fg_calib: robot-arm calibration as a factor graph.

    robot = Robot.from_dh(rows, convention="dh-hayati", tool=[0, 0, 0.1])
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4)
    result = calibrate(robot, data, model="position", frame="unknown")
    print(result)

Names are imported when they are first used, so that `fg-calib --help` need not wait for GTSAM.
"""

import logging

import lazy_loader  # type: ignore[import-untyped]

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
"""The names of most users, as the stub lists them: 40. Others are public in the folders: `fg_calib.io`, ..."""

logging.getLogger(__name__).addHandler(logging.NullHandler())
