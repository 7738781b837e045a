"""Covariances of residuals in low rank against the whole matrix."""

import numpy as np
import pytest
import scipy.sparse

from fg_calib.graph.noise_models import PRIVATE_SHARE
from fg_calib.statistics.residual_covariance import ResidualCovariance, RowErrors, square_root

N = 60


def star(rng, private=1.0):
    """Pairs of rows with two errors of their own, and three errors and four parameters that all of them have.

    Returns:
        The covariance, and the variances by noise alone.
    """
    own = scipy.sparse.block_diag([scipy.sparse.coo_array(rng.normal(size=(2, 2))) for _ in range(N // 2)])
    L = scipy.sparse.csr_array(scipy.sparse.hstack([rng.normal(size=(N, 3)), own]))
    P = np.hstack([rng.normal(size=(N, 2)), 1e-3 * rng.normal(size=(N, 2))])
    d = private * rng.uniform(0.5, 1.0, N)
    noise = d + np.sum(L.toarray() ** 2, axis=1)
    return ResidualCovariance.build(P, L, d, np.array([1.0, 1.0, -1.0, -1.0])), noise


def dense(covariance):
    L = covariance.L.toarray()
    return np.diag(covariance.d) + L @ L.T + (covariance.P * covariance.sign) @ covariance.P.T


@pytest.mark.parametrize("private", [1.0, 0.0])
def test_whitened_rows_have_the_moments_of_the_whole_matrix(private):
    """Chi-square, its mean and its degrees of freedom, with and without the least private noise."""
    rng = np.random.default_rng(1)
    (covariance, noise), z = star(rng, private), rng.normal(size=N)
    added = np.maximum(PRIVATE_SHARE * noise - covariance.d, 0.0)
    assert added.any() == (private == 0.0)
    inverse = np.linalg.inv(dense(covariance) + np.diag(added))
    B = np.eye(N) - inverse @ np.diag(added)
    expected = z @ inverse @ z, np.trace(B), np.trace(B) ** 2 / np.trace(B @ B)
    np.testing.assert_allclose(covariance.whitened(z), expected, rtol=1e-9)


def test_moments_are_the_traces_of_the_matrix_and_of_its_square():
    rng = np.random.default_rng(3)
    (covariance, _), rows = star(rng), np.sort(rng.choice(N, 25, replace=False))
    A = dense(covariance)[np.ix_(rows, rows)]
    np.testing.assert_allclose(covariance.moments(rows), (np.trace(A), np.sum(A * A)), rtol=1e-12)
    np.testing.assert_allclose(covariance.diagonal[rows], np.diag(A), rtol=1e-12)
    scale = rng.uniform(0.5, 2.0, N)
    np.testing.assert_allclose(dense(covariance.over(scale)), dense(covariance) / np.outer(scale, scale), rtol=1e-12)


def row_errors(rng, m=5):
    """Rows of a linear model that share errors by fours, with landmark errors; `felt` of the estimate by all rows."""
    J, own = rng.normal(size=(N, m)), 0.1 * rng.normal(size=(N, 2))
    L = scipy.sparse.csr_array(np.kron(np.eye(N // 4), np.ones((4, 1))) * rng.uniform(0.5, 1.0, (N, 1)))
    return RowErrors(J, own, rng.uniform(0.5, 1.0, N), L, np.zeros((N, 0)))


def test_fitted_rows_vary_by_their_noise_minus_what_the_estimate_takes_up():
    rng = np.random.default_rng(4)
    errors = row_errors(rng)
    C = np.diag(errors.private) + (errors.L @ errors.L.T).toarray()
    T = np.linalg.inv(errors.J.T @ np.linalg.inv(C) @ errors.J)
    expected = C - errors.J @ T @ errors.J.T - errors.own @ errors.own.T
    np.testing.assert_allclose(dense(errors.fitted(T)), expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(errors.noise, np.diag(C))


def test_rows_weighted_as_independent_have_the_sandwich_covariance():
    """(1 - H) C (1 - H)^T with H = J T J^T W, and what the priors add: J T prior T J^T."""
    rng = np.random.default_rng(5)
    errors = row_errors(rng)
    errors = RowErrors(errors.J, np.zeros((N, 0)), errors.private, errors.L, errors.felt)
    C = np.diag(errors.private) + (errors.L @ errors.L.T).toarray()
    measurement = np.arange(N) // 2
    W = np.linalg.inv(np.where(measurement[:, None] == measurement, C, 0.0))
    prior = np.diag(rng.uniform(0.5, 2.0, 5))
    T = np.linalg.inv(errors.J.T @ W @ errors.J + prior)
    left = np.eye(N) - errors.J @ T @ errors.J.T @ W
    expected = left @ C @ left.T + errors.J @ T @ prior @ T @ errors.J.T
    np.testing.assert_allclose(dense(errors.fitted_as_independent(T, measurement)), expected, rtol=1e-9, atol=1e-11)


def test_predicted_rows_are_correlated_with_the_estimate_by_the_errors_that_they_share():
    """The first half is fitted; the second is predicted by it, and shares one error with it."""
    rng = np.random.default_rng(6)
    J, L = rng.normal(size=(N, 5)), np.hstack([np.ones((N, 1)), 0.3 * rng.normal(size=(N, 3))])
    C, fit, new = np.eye(N) + L @ L.T, np.arange(N) < N // 2, np.arange(N) >= N // 2
    W = np.linalg.inv(C[np.ix_(fit, fit)])
    T = np.linalg.inv(J[fit].T @ W @ J[fit])
    M = J[fit].T @ W @ L[fit]
    nothing = np.zeros((N // 2, 0))
    errors = RowErrors(J[new], nothing, np.ones(N // 2), scipy.sparse.csr_array(L[new]), L[new] @ M.T)
    moved = np.hstack([-J[new] @ T @ J[fit].T @ W, np.eye(N // 2)])
    order = np.concatenate([np.flatnonzero(fit), np.flatnonzero(new)])
    expected = moved @ C[np.ix_(order, order)] @ moved.T
    np.testing.assert_allclose(dense(errors.predicted(T, T)), expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(square_root(T) @ square_root(T).T, T, rtol=1e-10)
