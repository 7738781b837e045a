"""Angles and Jacobians of rotations: against scipy, and against central differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tolerances import rounding

from fg_calib.robot import left_jacobian, nearest_rotation, rotation_angle, rotation_of, rotation_vector, yaw_pitch_roll
from fg_calib.robot.rotations import inverse_right_jacobian

RNG = np.random.default_rng(0)


def matrix(yaw, pitch, roll):
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


@pytest.mark.parametrize("tilt", [0.0, 1e-15, 1e-12, 1e-10, 1e-8, 1e-4, 0.1, 1.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angles_of_a_rotation_are_exact_however_near_the_pitch_is_to_a_quarter_turn(tilt, sign):
    for roll, yaw in RNG.uniform(-3.1, 3.1, (50, 2)):
        R = matrix(yaw, sign * (np.pi / 2 - tilt), roll)
        assert matrix(*yaw_pitch_roll(R)) == pytest.approx(R, abs=rounding())
        assert rotation_of(*yaw_pitch_roll(R)) == pytest.approx(R, abs=rounding())


@pytest.mark.parametrize("pitch", np.deg2rad([0.0, 30.0, 89.0, 90.0, -90.0, -120.0, 179.0]))
def test_angles_are_those_nearest_to_given_ones(pitch):
    near = np.array([RNG.uniform(-3, 3), pitch, RNG.uniform(-3, 3)])
    assert yaw_pitch_roll(matrix(*near), near) == pytest.approx(near, abs=1e-9)


def test_a_rotation_at_a_quarter_turn_of_pitch_is_shared_by_yaw_and_roll():
    near = np.array([0.3, np.pi / 2, -0.2])
    moved = yaw_pitch_roll(matrix(0.3, np.pi / 2, -0.1), near)
    assert matrix(*moved) == pytest.approx(matrix(0.3, np.pi / 2, -0.1), abs=1e-9)
    assert moved - near == pytest.approx([-0.05, 0.0, 0.05], abs=1e-9)


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.5, 2.0, 3.0])
def test_jacobians_are_central_differences(length):
    v = RNG.normal(size=3)
    v *= length / np.linalg.norm(v)
    h, R = 1e-6, Rotation.from_rotvec(v)
    for k in range(3):
        dv = h * np.eye(3)[k]
        turned = [Rotation.from_rotvec(v + s * dv) * R.inv() for s in (1, -1)]
        numeric = (turned[0].as_rotvec() - turned[1].as_rotvec()) / (2 * h)
        assert left_jacobian(v[None])[0, :, k] == pytest.approx(numeric, abs=1e-8)
        logs = [rotation_vector((R * Rotation.from_rotvec(s * dv)).as_matrix()[None])[0] for s in (1, -1)]
        assert inverse_right_jacobian(v[None])[0, :, k] == pytest.approx((logs[0] - logs[1]) / (2 * h), abs=1e-8)


def test_angle_axis_and_nearest_rotation_are_those_that_a_matrix_was_made_of():
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(20, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    angle = np.append(rng.uniform(0.0, np.pi, 17), [1e-9, np.pi - 1e-9, 0.0])
    R = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    found, of_axis = rotation_angle(R)
    assert found == pytest.approx(angle, abs=1e-15, rel=1e-12)
    assert of_axis == pytest.approx(np.sin(angle)[:, None] * axis, abs=1e-15)
    A = rng.normal(size=(20, 3, 3))
    stretch = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(3)
    assert nearest_rotation(R @ stretch) == pytest.approx(R, abs=1e-9)
    assert nearest_rotation(np.diag([2.0, 1.0, -0.5])) == pytest.approx(np.eye(3), abs=1e-12)
