"""Readings outside their limits: a smaller unit is suggested only where it explains them."""

import numpy as np
import pytest

from fg_calib import Robot
from fg_calib.measurements.dataset import _limit_hint

WIDEN = "widen the joint's limits if the reading is right; are the columns in the joints' order?"
ROBOT = Robot.from_dh(np.zeros((2, 4)), types=["prismatic", "revolute"], limits=[(0.1, 0.9), (-1.2, 2.5)])


@pytest.mark.parametrize(("joint", "unit", "readings", "said"), [
    (0, "m", np.array([150.0, 850.0]), "is it in mm?"),
    (1, "rad", np.rad2deg([-1.1, 2.4]), "is it in deg?"),
    (1, "rad", np.rad2deg([-1.1, 2.6]), WIDEN),
    (1, "rad", np.array([-1.1, 2.63]), WIDEN),  # just past the limit, within it as degrees
    (1, "deg", np.rad2deg([-1.1, 2.4]), WIDEN),
])  # fmt: skip
def test_another_unit_is_suggested_only_where_it_explains_all_rows(joint, unit, readings, said):
    assert _limit_hint(readings, ROBOT, joint, unit) == said
