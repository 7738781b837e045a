"""A UR5e, and what is measured of it."""

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from simulated import measure_drawn

from fg_calib.io import read_robot

SIGMA = (5e-5, 1e-4)
"""1 sigma of a position, [m], and of an orientation, [rad]."""

PLACED = (Rotation.from_euler("xyz", [0.3, -0.7, 1.9]), np.array([1.0, -2.0, 0.5]))
"""World_T_base of a tracker next to the robot."""

ROWS = [(0.1625, 0, 90), (0, -0.425, 0), (0, -0.3922, 0), (0.1333, 0, 90), (0.0997, 0, -90), (0.0996, 0, 0)]
"""d and a, [m], and alpha, [deg], of each joint of a UR5e."""

UR5E = {
    "name": "ur5e",
    "convention": "dh-hayati",
    "units": {"length": "m", "angle": "deg"},
    "joints": [{"theta": 0, "d": d, "a": a, "alpha": alpha, "beta": 0} for d, a, alpha in ROWS],
    "tool": {"x": 0.05, "y": -0.03, "z": 0.12, "roll": 20},
    "tolerance": {"a": 0.0005, "d": 0.0005, "alpha": 0.05, "theta": 0.1, "beta": 0.05},
}


def ur5e(folder, **changes):
    """The robot in a file of its own, with some keys changed."""
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(UR5E | changes))
    return read_robot(path)


def measured(robot, seed=0, *, placed=None, n=50, n_test=0, readings=None):
    """What is measured of a robot whose errors are those its tolerances say."""
    return measure_drawn(robot, n, seed, sigma=SIGMA, frame=placed, n_test=n_test, readings=readings)


def only(joint, figure, other=0.0):
    """A figure for one joint of six, numbered from 1, and another for the rest."""
    return np.where(np.arange(6) == joint - 1, figure, other)
