"""Reductions of blocks of any length, rows without weight, rows that share errors, rotations near half a turn."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import random_robot, tool_pose
from scipy.spatial.transform import Rotation
from tolerances import rounding

from fg_calib.measurements import Block, pack, residuals, stack
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.measurements.kinds.pose import Orientation
from fg_calib.robot import LANES, SPAN, build_chain


def random_pairs(n, rng):
    """Distances and angles of pairs, whitened together, and the chain with all its columns."""
    robot = random_robot("mdh-hayati", 6, rng)
    ends = np.column_stack([np.arange(n), rng.permutation(n) + 1])
    whitening = pack(np.tril(rng.uniform(0.5, 1, (n, 2, 2))))
    trig = robot.trig(rng.uniform(-3, 3, (n + 1, 6)))
    block = Block(stack(Distance(), RotationAngle()), trig, ends, rng.uniform(0, 2, (n, 2)), whitening)
    return block, build_chain(robot, {i: i for i in range(len(robot.parameters))}).with_joint_columns()


@pytest.mark.parametrize("angle", [np.pi - 1e-3, np.pi - 1e-9, np.pi])
def test_orientation_residual_is_exact_up_to_half_a_turn(angle):
    rng = np.random.default_rng(14)
    robot, axis = random_robot("mdh", 3, rng), np.array([0.6, 0.0, 0.8])
    q = rng.uniform(-3, 3, 3)
    measured = tool_pose(robot, q)[:3, :3] @ Rotation.from_rotvec(-angle * axis).as_matrix()
    trig = robot.trig(q[None])
    block = Block(Orientation(), trig, np.array([[0]]), measured.reshape(1, 9), pack(np.eye(3)[None]))
    r = residuals.residual(block, build_chain(robot))[0]
    sign = np.sign(r @ axis) if angle == np.pi else 1.0
    assert sign * r == pytest.approx(angle * axis, abs=1e-7 if angle > np.pi - 1e-8 else rounding(1, 10))


@pytest.mark.parametrize("n", [1, LANES + 1, 2 * SPAN + 5])
def test_reductions_keep_cost_gradient_and_hessian(n):
    block, chain = random_pairs(n, np.random.default_rng(n))
    r, J = residuals.linearise(block, chain)
    rows = np.column_stack([J.reshape(-1, J.shape[2]), r.ravel()])
    expected = rows.T @ rows
    size, R = np.abs(expected).max(), residuals.triangle(block, chain)
    assert R.T @ R == pytest.approx(expected, abs=rounding(size, 10))
    np.testing.assert_allclose(residuals.residual(block, chain), r, rtol=0, atol=rounding(10.0), equal_nan=False)


def test_a_row_without_weight_adds_nothing():
    block, chain = random_pairs(40, np.random.default_rng(17))
    whitening = block.whitening.copy()
    whitening[7:, :] = 0.0
    seven = {"ends": block.ends[:7], "data": block.data[:7], "nuisances": np.zeros((7, 0))}
    short = replace(block, whitening=whitening[:7], **seven)
    long = replace(block, whitening=whitening)
    with_rows, without = (residuals.triangle(each, chain) for each in (long, short))
    assert with_rows.T @ with_rows == pytest.approx(without.T @ without, abs=rounding(np.abs(without).max() ** 2, 10))


def test_the_sum_over_spans_does_not_depend_on_threads(monkeypatch):
    block, chain = random_pairs(3 * SPAN, np.random.default_rng(18))
    many = residuals.triangle(block, chain)
    monkeypatch.setattr("fg_calib.robot.kinematics.processors", lambda: 1)
    assert np.array_equal(residuals.triangle(block, chain), many)
