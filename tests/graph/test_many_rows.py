"""Tables of very many rows: a start from some of them, and noise that is computed on demand."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import measure, pairs_between, small_arm, true_robot

from fg_calib import InputError, Measurements, Pairing, Table, assess, build_problem, solve
from fg_calib.graph import relinearized_at, solver, subsampled, whitening_of

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}


def pairs_of(n, robot, rng, n_configurations=200):
    """Pairs measured directly, some of lengths near 0."""
    true = true_robot(robot, rng)
    q = rng.uniform(-3.0, 3.0, (n_configurations, robot.n_joints))
    a = rng.integers(0, len(q), n)
    b = (a + rng.integers(1, len(q), n)) % len(q)
    return replace(Measurements.from_arrays(q), pairs=pairs_between(true, q, (a, b), rng, sigma=(1e-3, 1e-3)))


@pytest.fixture(scope="module")
def problem():
    robot = small_arm(TOLERANCE)
    return build_problem(robot, pairs_of(3000, robot, np.random.default_rng(0)), model="distance-rotation")


def test_a_start_from_some_rows_leads_to_the_optimum_of_all(problem, monkeypatch):
    expected = solve(problem)
    monkeypatch.setattr(solver, "MAX_AT_ONCE", 1000)
    found = solve(problem)
    assert found.converged
    assert found.history[0].decrement < 0.1 * expected.history[0].decrement  # it began nearer
    assert found.initial_cost == pytest.approx(expected.initial_cost, rel=1e-12)  # the same, summed in another order
    sigma = np.sqrt(np.diag(assess(expected).covariance))
    change = (found.parameters - expected.parameters)[problem.variables.robot_span]
    estimated = [p.estimated for p in problem.robot.parameters]
    # Both are nearer to the optimum than 3e-7 sigma.
    assert np.max(np.abs(change[estimated] / sigma)) < 1e-6


@pytest.mark.parametrize("sigma_joint", [0.0, 1e-3])
@pytest.mark.parametrize("tested", [False, True])
def test_a_small_table_beside_a_large_one_of_which_no_row_is_drawn(sigma_joint, tested, monkeypatch):
    robot, rng = small_arm(TOLERANCE), np.random.default_rng(0)
    true = true_robot(robot, rng)
    large, small = (measure(true, n, rng, sigma_joint=sigma_joint) for n in (50, 4))
    small = replace(small, source="small", test=np.full(4, tested))
    tables = [Table(large, "pose"), Table(small, "distance-rotation", Pairing("chain"))]
    problem = build_problem(robot, tables)
    expected = solve(problem)
    monkeypatch.setattr(solver, "MAX_AT_ONCE", 100)
    assert any(s.n == 0 for s in subsampled(problem, solver.SAMPLE_SHARE).data.blocks)
    found = solve(problem)
    assert found.converged
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)


def test_some_rows_are_train_rows_and_as_many_as_asked_for(problem):
    (s,) = problem.data.blocks
    test = np.arange(s.n) % 3 == 0
    held_out = replace(problem, data=replace(problem.data, blocks=(replace(s, test=test),)))
    few = subsampled(held_out, 0.1)
    (drawn,) = few.data.blocks
    assert drawn.n == round(0.1 * np.sum(~test))
    assert not test[drawn.number].any()
    assert np.array_equal(drawn.data, s.data[drawn.number])
    assert len(few.start) == len(problem.start)


@pytest.mark.parametrize("change", [{"loss": "huber"}, {"loss": "gnc"}])
def test_rows_with_weights_of_their_own_are_all_taken(problem, change):
    assert problem.is_exchangeable
    assert not replace(problem, options=replace(problem.options, **change)).is_exchangeable


@pytest.mark.parametrize("d", [2, 3, 6])
def test_small_covariances_are_whitened_by_the_rows_in_use(d):
    rng = np.random.default_rng(d)
    A = rng.normal(size=(50, d, d))
    C, used = A @ np.swapaxes(A, 1, 2) + np.eye(d), rng.random((50, d)) < 0.7
    W = whitening_of(C, used)
    both = used[:, :, None] & used[:, None, :]
    assert np.array_equal(W, np.tril(W) * both)
    # W C W^T = 1 where rows are in use; condition numbers up to 1e3
    assert np.abs(W @ (C * both) @ np.swapaxes(W, 1, 2) - np.eye(d) * both).max() < 1e-12
    with pytest.raises(InputError, match="lost in rounding"):
        whitening_of(-C, np.ones_like(used))


@pytest.mark.parametrize("n_sigma", [0.2, 3.0])
def test_rows_whitened_at_the_optimum_leave_nothing_to_go(problem, n_sigma):
    """Wherever the start is: convergence is judged by rows whitened at the estimate itself."""
    expected = solve(problem)
    system = problem.linearize(expected.parameters)
    off = n_sigma * system.root @ np.ones(system.rank) / np.sqrt(system.rank)
    found = solve(problem, start=problem.variables.moved(expected.parameters, off))
    assert found.converged
    assert relinearized_at(found.problem, found.parameters).system.decrement < 3e-7
