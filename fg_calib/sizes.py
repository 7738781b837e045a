"""Former name of `arguments`."""

from fg_calib.arguments import LEAST_SIZE, MOST_SIZE, ORDINARY

__all__ = ["LEAST_SIZE", "MOST_DRAWN", "MOST_JOINTS", "MOST_PAIRS", "MOST_SIZE", "ORDINARY"]

MOST_JOINTS = 200
"""Moving joints of a robot: the work grows with their third power."""

MOST_DRAWN = 1_000_000
"""Configurations that a simulation draws."""

MOST_PAIRS = 10_000_000
"""Pairs that are formed of poses."""
