"""Least squares of tool poses: the derivative by differences."""

import numpy as np
import pytest
from oracle import central_differences
from scipy.spatial.transform import Rotation

from fg_calib.exports.fits import log_derivative


@pytest.mark.parametrize("size", [0.0, 1e-5, 9e-4, 1.1e-3, 0.3, 1.5, 3.0])
def test_the_derivative_of_a_rotation_vector_in_a_turn_from_the_left_is_that_of_differences(size):
    v = size * np.array([0.48, -0.6, 0.64])

    def turned(w):
        return (Rotation.from_rotvec(w) * Rotation.from_rotvec(v)).as_rotvec()

    expected = central_differences(turned, np.zeros(3))
    assert log_derivative(v[None])[0] == pytest.approx(expected, abs=1e-8)  # of differences by 1e-6
