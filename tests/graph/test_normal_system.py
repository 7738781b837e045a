"""The normal system against the dense formulas of generalised least squares with C = D + L L^T."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse

from fg_calib import SolverError
from fg_calib.graph import NormalSystem, determined, eliminate, error_states
from fg_calib.graph.error_states import SchurComplement

WIDTH, H, N_CORE, N_LANDMARKS = 3, 2, 6, 4


class Dense:
    """A random system, whitened rows and priors, and its estimate by formulas that form C."""

    def __init__(self, ends, seed=0, n_poses=20):
        rng = np.random.default_rng(seed)
        self.k, n_all = len(ends), N_CORE + N_LANDMARKS
        L = np.zeros((self.k * H, n_poses * WIDTH))
        for i, pair in enumerate(ends):
            for end in pair:
                L[i * H : i * H + H, end * WIDTH : end * WIDTH + WIDTH] = rng.normal(size=(H, WIDTH))
        self.L, self.A = L, rng.normal(size=(self.k * H, n_all))
        self.C = np.eye(len(L)) + L @ L.T
        self.K = np.diag(rng.uniform(0.3, 1.0, N_CORE))
        truth = rng.normal(size=n_all)
        self.r = np.linalg.cholesky(self.C) @ rng.normal(size=len(L)) - self.A @ truth
        self.prior = rng.normal(size=N_CORE)
        inverse = np.linalg.inv(self.C)
        wide = np.hstack([self.K, np.zeros((N_CORE, N_LANDMARKS))])
        self.covariance = np.linalg.inv(self.A.T @ inverse @ self.A + wide.T @ wide)
        self.step = -self.covariance @ (self.A.T @ inverse @ self.r + wide.T @ self.prior)
        self.e = self.r + self.A @ self.step
        self.P = inverse - inverse @ self.A @ self.covariance @ self.A.T @ inverse
        self.chi_square = self.e @ inverse @ self.e + np.sum((self.prior + self.K @ self.step[:N_CORE]) ** 2)

    def system(self):
        states = SchurComplement(scipy.sparse.csr_array(self.L), WIDTH)
        white = states.whiten(np.column_stack([self.A, self.r]))
        priors = np.column_stack([self.K, self.prior])
        return NormalSystem(white, N_CORE, np.ones(N_CORE), priors, states, lambda: np.column_stack([self.A, self.r]))


STAR = [(0, i) for i in range(1, 20)]
CHAIN = list(pairwise(range(20)))
LOOPS = [tuple(pair) for pair in np.random.default_rng(1).integers(0, 20, (60, 2)).tolist() if pair[0] != pair[1]]
SPARSE = {"MAX_DENSE": 0, "MAX_FILL": 0}
WAYS = {
    "dense rows": (STAR, {}, True),
    "dense states": (LOOPS, {}, False),
    "trees": (CHAIN, SPARSE, False),
    "sparse states": (LOOPS, SPARSE | {"MAX_LOOP_STATES": -1}, False),
    "sparse rows": (LOOPS[:25], SPARSE | {"MAX_LOOP_STATES": -1}, True),
}


@pytest.fixture(params=WAYS)
def dense(request, monkeypatch):
    """Systems that each way of elimination is chosen for."""
    pairs, thresholds, of_rows = WAYS[request.param]
    for name, value in thresholds.items():
        monkeypatch.setattr(error_states, name, value)
    found, solvers, splu = Dense(pairs), [], error_states.splu
    monkeypatch.setattr(error_states, "splu", lambda *a, **k: solvers.append(splu(*a, **k)) or solvers[-1])
    states = SchurComplement(scipy.sparse.csr_array(found.L), WIDTH)
    assert states._factor[0] == of_rows
    assert bool(solvers) == bool(thresholds)
    return found


def close(found, wanted, tolerance=1e-9):
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance)


def test_step_covariance_and_chi_square_are_those_of_generalised_least_squares(dense):
    system = dense.system()
    assert system.rank == N_CORE
    close(system.step, dense.step)
    close(system.covariance, dense.covariance[:N_CORE, :N_CORE])
    close(system.full_root @ system.full_root.T, dense.covariance)
    close(system.chi_square, dense.chi_square)
    close(system.left.rank, N_LANDMARKS)


def test_error_states_have_their_posterior_mean_and_variance(dense):
    system = dense.system()
    close(system.z, dense.L.T @ np.linalg.solve(dense.C, dense.e))
    variance = np.diag(np.eye(dense.L.shape[1]) - dense.L.T @ dense.P @ dense.L)
    close(system.z_variance, variance)


def test_residuals_and_projections_are_those_of_generalised_least_squares(dense):
    system, roots = dense.system(), scipy.sparse.csr_array(dense.L)
    close(system.residual, dense.e)
    close(system.weighted_residual, np.linalg.solve(dense.C, dense.e))
    close(system.project(dense.L), dense.P @ dense.L, 1e-8)
    if error_states.MAX_DENSE:  # else traces are estimates
        close(system.trace(roots), np.trace(dense.L.T @ dense.P @ dense.L), 1e-8)


def test_a_null_direction_stays_where_it_is():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(30, 5))
    A[:, 4] = A[:, 3]
    system = NormalSystem(np.column_stack([A, rng.normal(size=30)]), 5, np.array([1.0, 1.0, 1.0, 1.0, 3.0]))
    assert system.rank == 4
    null = np.array([0.0, 0.0, 0.0, 1.0, -1.0])
    assert abs(null @ (system.step / np.array([1.0, 1.0, 1.0, 1.0, 9.0]))) < 1e-12  # least norm in the scales


def test_a_step_damped_in_its_coordinates_is_marquardts_in_the_scales():
    rng, scales, damping = np.random.default_rng(4), np.array([0.1, 1.0, 3.0]), 1e-2
    A, r = rng.normal(size=(20, 3)), rng.normal(size=20)
    system = NormalSystem(np.column_stack([A, r]), 3, scales)
    w = system.weights
    damped = damping * np.linalg.norm(A * scales, 2) ** 2 * np.diag(scales**-2.0)
    wanted = -np.linalg.solve(A.T @ A + damped, A.T @ r)
    close(system.full_root @ (w * w * system.coordinates / (w * w + damping)), wanted)


def test_landmarks_that_nothing_determines_are_named():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(30, 6))
    A[:, 5] = A[:, 4]
    left = eliminate(A, rng.normal(size=30), 3)
    assert left.rank == 2
    assert left.unknown.tolist() == [False, True, True]
    assert np.linalg.matrix_rank(left.A) == 3


def test_degrees_of_freedom_count_rank_by_one_rule():
    assert determined(np.array([1e3, 1.0, 1e-4])) == 2  # below the floor
    assert determined(np.array([1e12, 1e3, 1.0])) == 2  # below the share of the largest
    assert determined(np.array([1.0, 1e-5]), floor=1e-6) == 2


def test_too_many_errors_that_loops_couple_point_to_poses(monkeypatch):
    for name, value in WAYS["sparse states"][1].items() | {("MAX_SPARSE", 2)}:
        monkeypatch.setattr(error_states, name, value)
    states = SchurComplement(scipy.sparse.csr_array(Dense(LOOPS).L), WIDTH)
    with pytest.raises(SolverError, match="use model pose with frame unknown"):
        states.posterior_mean(np.ones((len(LOOPS) * H, 1)))


def test_traces_of_many_errors_are_estimated(monkeypatch):
    dense = Dense(LOOPS)
    states = SchurComplement(scipy.sparse.csr_array(dense.L), WIDTH)
    E = scipy.sparse.csr_array(dense.L)
    exact = np.trace(dense.L.T @ np.linalg.solve(dense.C, dense.L))
    assert states.trace(E) == pytest.approx(exact, rel=1e-10)
    monkeypatch.setattr(error_states, "MAX_DENSE", 0)
    assert states.trace(E) == pytest.approx(exact, rel=0.1)
