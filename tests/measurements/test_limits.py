"""Readings outside their limits: another unit is asked about only where it explains them."""

import numpy as np
import pytest

from fg_calib import Robot
from fg_calib.measurements.validation import limit_hint

WIDEN = "widen the joint's limits if the reading is right"
GANTRY = Robot.from_dh(
    np.zeros((4, 4)),
    types=["prismatic", "prismatic", "revolute", "revolute"],
    limits=[(0.0, 2.5), (0.1, 0.9), (-1.2, 2.5), (-3.0, 3.0)],
)
SLIDES, ANGLES = np.linspace([0.2, 0.15], [2.4, 0.85], 9), np.linspace([-1.1, -2.9], [2.4, 2.9], 9)


def hint(joint, stated, slides=SLIDES, angles=ANGLES):
    return limit_hint(np.hstack([slides, angles]), GANTRY, joint, (f"q{joint + 1}", "the table"), stated)


@pytest.mark.parametrize(
    ("joint", "stated", "changes", "said"),
    [
        (1, "mm", {"slides": SLIDES * [1, 1e-3]}, "is q2 in m?"),
        (1, "mm", {"slides": SLIDES * [1, 0.1]}, "is q2 in cm?"),
        (1, "mm", {"slides": SLIDES * [1, 0.5]}, WIDEN),
        (1, "m", {"slides": SLIDES * [1, 1e3]}, "is q2 in mm?"),
        (0, "m", {"slides": SLIDES * 1e3}, "is the table in mm?"),
        (2, "rad", {"angles": np.rad2deg(ANGLES)}, "is the table in deg?"),
        (2, "rad", {"angles": np.rad2deg(ANGLES) * [1, 0.01]}, "is q3 in deg?"),
        (2, "rad", {"angles": np.add(ANGLES, [0.13, 0.0])}, WIDEN),  # just past the limit, within it as degrees
        (2, "mrad", {"angles": np.add(ANGLES, [0.13, 0.0])}, WIDEN),
    ],
)
def test_another_unit_is_asked_about_only_where_it_explains_all_rows(joint, stated, changes, said):
    assert hint(joint, stated, **changes) == said
