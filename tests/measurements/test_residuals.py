"""Residuals against scipy's rotations, their derivatives against central differences, and the reductions."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from oracle import central_differences, random_robot, tool_pose
from scipy.spatial.transform import Rotation
from sparing import diagonal
from tolerances import rounding

from fg_calib.graph.error_states import SchurComplement, State, WhitenedBlock, WhitenedSeries
from fg_calib.measurements import residuals
from fg_calib.measurements.kinds import stack
from fg_calib.measurements.kinds.pair import Distance, RotationAngle, SamePoint
from fg_calib.measurements.kinds.pose import Orientation, Position
from fg_calib.measurements.residuals import Block, pack
from fg_calib.robot.kernels import LANES
from fg_calib.robot.kinematics import SPAN, build_chain

CONVENTIONS = ["dh", "mdh", "mdh-hayati", "dh-hayati", "urdf"]


ROUNDING = 1e-14
"""Of sums of some products of numbers of size 1 to 10 that cancel."""


def chain_of(robot):
    return build_chain(robot, {i: i for i in range(len(robot.parameters))}).with_joint_columns()


def pair_block(trig, a, b, measured, whitening, kinds=(True, True)):
    """Pairs with distances, angles or both, measured and whitened, shapes (n, 2) and (n, 2, 2), by rows wanted."""
    rows = np.flatnonzero(kinds)
    kind = stack(*(each for each, wanted in zip((Distance(), RotationAngle()), kinds, strict=True) if wanted))
    data, whitening = np.ascontiguousarray(measured[:, rows]), pack(whitening[:, rows][:, :, rows])
    return Block(kind, trig, np.stack([a, b], axis=1), data, whitening)


def pose_block(trig, R, p, whitening, kinds=(True, True)):
    """Orientations, positions or both, shapes (n, 3, 3) and (n, 3)."""
    chosen, n = np.flatnonzero(kinds), len(whitening)
    data = np.hstack([(R.reshape(n, 9), p)[k] for k in chosen])
    kind = stack(*((Orientation(), Position())[k] for k in chosen))
    return Block(kind, trig, np.arange(n)[:, None], np.ascontiguousarray(data), pack(whitening))


def same_point_block(trig, a, b, whitening):
    return Block(SamePoint(), trig, np.stack([a, b], axis=1), np.zeros((len(a), 0)), pack(whitening))


def pair_formula(robot, measured):
    """Distance and angle of a pair minus measured, by 4x4 products; x = parameters, q_a, q_b."""
    n, m = robot.n_joints, len(robot.parameters)

    def formula(x):
        A, B = (tool_pose(robot, q, x[:m]) for q in (x[m : m + n], x[m + n :]))
        angle = Rotation.from_matrix(A[:3, :3].T @ B[:3, :3]).magnitude()
        return np.array([np.linalg.norm(B[:3, 3] - A[:3, 3]), angle]) - measured

    return formula


@pytest.mark.slow
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_distance_and_angle_and_their_derivatives(convention):
    rng = np.random.default_rng(11)
    for n_joints in (1, 4, 7, 12):
        robot = random_robot(convention, n_joints, rng)
        q = rng.uniform(-3, 3, (2, n_joints))
        measured = rng.uniform(0, 1, 2)
        formula = pair_formula(robot, measured)
        x = np.concatenate([robot.nominal, *q])
        angle = formula(x)[1] + measured[1]
        differences = None
        if n_joints > 1:  # a single joint turns the tool by its own angle about its own axis, whatever the parameters
            assert 0.05 < angle < 3.1  # away from the kinks, where central differences mean something
            differences = central_differences(formula, x)
        for kinds in ((True, True), (True, False), (False, True)):
            W = np.array([[2.0, 0.0], [0.7 if all(kinds) else 0.0, 3.0]])
            block = pair_block(robot.trig(q), np.array([0]), np.array([1]), measured[None], W[None], kinds)
            r, J = residuals.linearise(block, chain_of(robot))
            rows = np.flatnonzero(kinds)
            assert r[0] == pytest.approx((W @ formula(x))[rows], abs=rounding(10, 1 / min(1.0, np.sin(angle) + 1e-4)))
            if differences is not None:
                assert J[0] == pytest.approx((W @ differences)[rows], abs=2e-7)


POSES = [(True, True), (True, False), (False, True)]


@pytest.mark.parametrize("angle", [np.pi - 1e-3, np.pi - 1e-9, np.pi])
def test_orientation_residual_is_exact_up_to_half_a_turn(angle):
    rng = np.random.default_rng(14)
    robot = random_robot("mdh", 3, rng)
    q = rng.uniform(-3, 3, 3)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    measured = tool_pose(robot, q)[:3, :3] @ Rotation.from_rotvec(-angle * axis).as_matrix()
    trig = robot.trig(q[None])
    block = pose_block(trig, measured[None], np.zeros((1, 3)), np.eye(3)[None], (True, False))
    r = residuals.residual(block, chain_of(robot))[0, :]
    sign = np.sign(r @ axis) if angle == np.pi else 1.0
    assert sign * r == pytest.approx(angle * axis, abs=1e-7 if angle > np.pi - 1e-8 else rounding(1, 10))


def test_residuals_are_predicted_minus_measured():
    robot = random_robot("dh", 3, np.random.default_rng(15))
    q = np.random.default_rng(16).uniform(-1, 1, (2, 3))
    trig = robot.trig(q)
    pair = pair_block(trig, np.array([0]), np.array([1]), np.zeros((1, 2)), np.eye(2)[None])
    assert np.all(residuals.residual(pair, build_chain(robot)) > 0)


def random_block(kind, n, rng):
    robot = random_robot("mdh-hayati", 6, rng)
    trig = robot.trig(rng.uniform(-3, 3, (n + 1, 6)))
    a, b = np.arange(n), rng.permutation(n) + 1
    if kind == "pairs":
        block = pair_block(trig, a, b, rng.uniform(0, 2, (n, 2)), np.tril(rng.uniform(0.5, 1, (n, 2, 2))))
    elif kind == "points":
        block = same_point_block(trig, a, b, np.tril(rng.normal(size=(n, 3, 3))))
    else:
        R = Rotation.random(n, random_state=1).as_matrix()
        block = pose_block(trig, R, rng.normal(size=(n, 3)), np.tril(rng.normal(size=(n, 6, 6))))
    return block, chain_of(robot)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("kind", "n"), diagonal(["pairs", "points", "poses"], [1, LANES + 1, 700, 2 * SPAN + 5], every=2)
)
def test_reductions_keep_cost_gradient_and_hessian(kind, n):
    block, chain = random_block(kind, n, np.random.default_rng(n))
    r, J = residuals.linearise(block, chain)
    stacked = np.concatenate([J.reshape(-1, J.shape[2]), r.reshape(-1, 1)], axis=1)
    expected = stacked.T @ stacked
    size = np.abs(expected).max()
    R = residuals.triangle(block, chain)
    assert residuals.gram(block, chain) == pytest.approx(expected, abs=rounding(size, 10))
    assert R.T @ R == pytest.approx(expected, abs=rounding(size, 10))
    assert residuals.squared_norm(block, chain) == pytest.approx(expected[-1, -1], rel=rounding(1, 10))
    np.testing.assert_allclose(residuals.residual(block, chain), r, rtol=0, atol=rounding(10.0), equal_nan=False)


def test_a_row_without_weight_adds_nothing():
    block, chain = random_block("pairs", 40, np.random.default_rng(17))
    whitening = block.whitening.copy()
    whitening[7:, :] = 0.0
    short = replace(
        block, ends=block.ends[:7], data=block.data[:7], whitening=whitening[:7], nuisances=np.zeros((7, 0))
    )
    long = replace(block, whitening=whitening)
    assert residuals.gram(long, chain) == pytest.approx(residuals.gram(short, chain), rel=rounding())


def test_the_sum_over_spans_does_not_depend_on_threads(monkeypatch):
    block, chain = random_block("pairs", 3 * SPAN, np.random.default_rng(18))
    many = residuals.gram(block, chain)
    monkeypatch.setattr("fg_calib.robot.kinematics.processors", lambda: 1)
    assert np.array_equal(residuals.gram(block, chain), many)


@pytest.mark.parametrize(("n", "n_shared"), [(6, 3), (6, 30)], ids=["few shared errors", "many"])
def test_rows_that_share_errors_are_whitened_together_and_their_parts_can_be_divided(n, n_shared):
    block, chain = random_block("pairs", n, rng := np.random.default_rng(0))
    chain = replace(chain, joint_columns=False)
    loading = scipy.sparse.csr_array(rng.normal(size=(n * block.residual_dim, n_shared)))
    correlated = WhitenedBlock(
        (WhitenedSeries(block, 0, 0, np.zeros((n, 0), dtype=np.int64)),), SchurComplement(loading)
    )
    some = residuals.residual(residuals.rows_of(correlated.parts[0].block, slice(0, 2)), chain)
    assert np.array_equal(some, residuals.residual(block, chain)[:2])
    at = State((chain,), np.zeros(0), np.zeros(0, dtype=np.int64), chain.n_columns, 0)
    r, J = correlated.linearise(at)
    assert (r.shape, J.shape) == ((correlated.n_rows,), (correlated.n_rows, chain.n_columns))
    plain = residuals.linearise(block, chain)
    rows = np.column_stack([plain[1].reshape(-1, chain.n_columns), plain[0].ravel()])
    expected = rows.T @ np.linalg.solve(np.eye(len(rows)) + (loading @ loading.T).toarray(), rows)
    of_rounding = rounding(rows.T @ rows, 10.0)
    whitened, R = np.column_stack([J, r]), correlated.triangle(at)
    for gram in (whitened.T @ whitened, R.T @ R):
        assert gram == pytest.approx(expected, abs=of_rounding)
    assert correlated.squared_norm(at) == pytest.approx(expected[-1, -1], abs=of_rounding)
