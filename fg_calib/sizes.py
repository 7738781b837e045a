"""Sizes of figures beyond which they are mistakes, whatever their unit: they drown others, or overflow when squared."""

LEAST_SIZE, MOST_SIZE = 1e-30, 1e15
"""The least that a sigma or tolerance may be, and the most that any figure may."""

ORDINARY = f"a number no larger than {MOST_SIZE:g}; sigmas and tolerances no less than {LEAST_SIZE:g}"
"""What is expected, for messages."""

MOST_JOINTS = 200
"""Moving joints of a robot: the work grows with their third power."""

MOST_DRAWN = 1_000_000
"""Configurations that a simulation draws."""

MOST_PAIRS = 10_000_000
"""Pairs that are formed of poses."""
