"""Covariances of residuals in low rank against the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from fg_calib.graph.noise import PRIVATE_SHARE
from fg_calib.statistics import low_rank
from fg_calib.statistics.low_rank import LowRank

N = 120


def star(rng, private=1.0):
    """Pairs of rows with two errors of their own, and three errors and four parameters that all of them have."""
    own = scipy.sparse.block_diag([scipy.sparse.coo_array(rng.normal(size=(2, 2))) for _ in range(N // 2)])
    L = scipy.sparse.csr_array(scipy.sparse.hstack([rng.normal(size=(N, 3)), own]))
    P = np.hstack([rng.normal(size=(N, 2)), 0.1 * rng.normal(size=(N, 2))])
    return LowRank(P, L, private * rng.uniform(0.5, 1.0, N), np.array([1.0, 1.0, -1.0, -1.0]))


def whole(covariance):
    """The matrix itself, and the floor of its diagonal."""
    P, L, d, sign = covariance._P, covariance._L.toarray(), covariance._d, covariance._sign
    noise = d + np.sum(L**2, axis=1)
    return np.diag(d) + L @ L.T + P @ np.diag(sign) @ P.T, np.maximum(PRIVATE_SHARE * noise - d, 0.0)


@pytest.mark.parametrize("private", [1.0, 0.0])
def test_rows_whitened_in_blocks_are_those_whitened_together(private):
    """Chi-square, its mean and its degrees of freedom, with and without the floor of private noise."""
    rng = np.random.default_rng(1)
    covariance, z = star(rng, private), rng.normal(size=N)
    assert covariance._blocks() is not None
    A, floor = whole(covariance)
    assert floor.any() == (private == 0.0)
    inverse = np.linalg.inv(A + np.diag(floor))
    B = np.eye(N) - inverse @ np.diag(floor)
    mean = np.trace(B)
    expected = z @ inverse @ z, mean, mean**2 / np.trace(B @ B)
    # Rounding: 1e-16 times the condition of A, 1e5 where its own noise is a thousandth of the rest, and some margin.
    np.testing.assert_allclose(covariance.whitened(z), expected, rtol=1e-9)


def test_rows_in_one_long_chain_are_whitened_as_a_whole(monkeypatch):
    """Each row shares an error with the next: there are no blocks, and no few errors that hold all together."""
    rng = np.random.default_rng(2)
    L = scipy.sparse.csr_array(scipy.sparse.diags_array([np.ones(N), np.ones(N - 1)], offsets=[0, 1], shape=(N, N)))
    covariance, z = LowRank(np.zeros((N, 0)), L, np.full(N, 0.5), np.zeros(0)), rng.normal(size=N)
    assert covariance._blocks() is None
    A, _ = whole(covariance)
    np.testing.assert_allclose(covariance.whitened(z), (z @ np.linalg.solve(A, z), N, N), rtol=1e-12)
    monkeypatch.setattr(low_rank, "FEW", N)  # as one block
    assert covariance._blocks() is not None
    np.testing.assert_allclose(covariance.whitened(z)[0], z @ np.linalg.solve(A, z), rtol=1e-12)


@pytest.mark.parametrize(("small", "most"), [(0, 0), (0, low_rank.MOST_WIDE), (N, 0)])
def test_moments_are_the_traces_of_the_matrix_and_of_its_square(monkeypatch, small, most):
    """Of some of the rows: as it stands, or with errors of many rows set apart or not."""
    monkeypatch.setattr(low_rank, "SMALL", small)
    monkeypatch.setattr(low_rank, "MOST_WIDE", most)
    rng = np.random.default_rng(3)
    covariance, rows = star(rng), np.sort(rng.choice(N, 50, replace=False))
    A = whole(covariance)[0][np.ix_(rows, rows)]
    np.testing.assert_allclose(covariance.moments(rows), (np.trace(A), np.sum(A * A)), rtol=1e-12)
    np.testing.assert_allclose(covariance.diagonal[rows], np.diag(A), rtol=1e-12)
