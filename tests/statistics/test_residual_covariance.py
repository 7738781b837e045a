"""Covariances of residuals in low rank against the whole matrix."""

import numpy as np
import pytest
import scipy.sparse
from scipy.linalg import block_diag

from fg_calib.graph import PRIVATE_SHARE
from fg_calib.statistics.residual_covariance import ResidualCovariance

N = 60


def drawn(rng, private=1.0):
    """Rows with errors that pairs of them and all of them have, and parameters that add to and take from these."""
    L = np.hstack([rng.normal(size=(N, 3)), np.kron(np.eye(N // 2), np.ones((2, 1))) * rng.normal(size=(N, 1))])
    P = rng.normal(size=(N, 4)) * [1.0, 1.0, 1e-3, 1e-3]
    M = np.diag([1.0, 1.0, -1.0, -1.0])
    M[0, 2] = M[2, 0] = 0.3
    return ResidualCovariance(private * rng.uniform(0.5, 1.0, N), scipy.sparse.csr_array(L), P, M)


def dense(covariance):
    L = covariance.L.toarray()
    return np.diag(covariance.d) + L @ L.T + covariance.P @ covariance.M @ covariance.P.T


@pytest.mark.parametrize("private", [1.0, 0.0])
def test_whitened_rows_have_the_moments_of_the_whole_matrix(private):
    """Chi-square and its mean, with and without the least private noise."""
    rng = np.random.default_rng(1)
    covariance, rows = drawn(rng, private), np.arange(5, 45)
    z, A = rng.normal(size=len(rows)), dense(covariance)[np.ix_(rows, rows)]
    noise = covariance.d + np.sum(covariance.L.toarray() ** 2, axis=1)
    added = np.maximum(PRIVATE_SHARE * noise - covariance.d, 0.0)[rows]
    assert added.any() == (private == 0.0)
    inverse = np.linalg.inv(A + np.diag(added))
    np.testing.assert_allclose(covariance.whitened(z, rows), (z @ inverse @ z, np.trace(inverse @ A)), rtol=1e-9)


def test_square_is_the_trace_of_the_square_of_the_matrix():
    rng = np.random.default_rng(3)
    covariance, rows = drawn(rng), np.sort(rng.choice(N, 25, replace=False))
    A = dense(covariance)[np.ix_(rows, rows)]
    np.testing.assert_allclose(covariance.square(rows, np.diag(A)), np.sum(A * A), rtol=1e-12)
    np.testing.assert_allclose(covariance.diagonal[rows], np.diag(A), rtol=1e-12)


def test_fitted_rows_vary_by_their_noise_minus_what_the_estimate_takes_up():
    """Rows that share errors by fours, of five parameters and two landmarks' errors; the same divided by a sigma."""
    rng = np.random.default_rng(4)
    J, own = rng.normal(size=(N, 5)), 0.1 * rng.normal(size=(N, 2))
    L = scipy.sparse.csr_array(np.kron(np.eye(N // 4), np.ones((4, 1))) * rng.uniform(0.5, 1.0, (N, 1)))
    rows = ResidualCovariance(rng.uniform(0.5, 1.0, N), L, np.hstack([J, own]), np.zeros((0, 0)))
    C, sigma = np.diag(rows.d) + (L @ L.T).toarray(), rng.uniform(0.5, 2.0, N)
    T = np.linalg.inv(J.T @ np.linalg.inv(C) @ J)
    expected = C - J @ T @ J.T - own @ own.T
    fitted = rows.with_errors(-block_diag(T, np.eye(2)))
    np.testing.assert_allclose(dense(fitted), expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(dense(fitted.over(sigma)), expected / np.outer(sigma, sigma), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(dense(fitted.split()), expected, rtol=1e-10, atol=1e-12)


def test_predicted_rows_are_correlated_with_the_estimate_by_the_errors_that_they_share():
    """The first half is fitted; the second is predicted by it, and shares one error with it."""
    rng = np.random.default_rng(6)
    J, L = rng.normal(size=(N, 5)), np.hstack([np.ones((N, 1)), 0.3 * rng.normal(size=(N, 3))])
    C, fit, new = np.eye(N) + L @ L.T, np.arange(N) < N // 2, np.arange(N) >= N // 2
    W = np.linalg.inv(C[np.ix_(fit, fit)])
    T = np.linalg.inv(J[fit].T @ W @ J[fit])
    M = J[fit].T @ W @ L[fit]
    P = np.hstack([J[new], L[new] @ M.T])
    rows = ResidualCovariance(np.ones(N // 2), scipy.sparse.csr_array(L[new]), P, np.zeros((0, 0)))
    moved = np.hstack([-J[new] @ T @ J[fit].T @ W, np.eye(N // 2)])
    np.testing.assert_allclose(dense(rows.with_errors(T, T)), moved @ C @ moved.T, rtol=1e-9, atol=1e-11)
