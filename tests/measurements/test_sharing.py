"""Errors that rows share: whitened as the dense covariance has it, whichever way is taken, and weak directions kept."""

from functools import cache

import numpy as np
import pytest
import scipy.sparse
from tolerances import rounding

from fg_calib.errors import SolverError
from fg_calib.measurements import sharing
from fg_calib.measurements.sharing import SharedErrors

WIDTH = 3
EXACT = 1e-9
"""Share of the information in any direction that may be missing; what one way leaves out is bounded by it."""


def graph(name, n, rng):
    """Ends of pairs of n configurations."""
    later = np.arange(1, n)
    if name == "star":
        return np.zeros(n - 1, dtype=int), later
    if name == "chain":
        return later - 1, later
    if name == "tree":
        return rng.integers(0, later), later
    if name == "ring":
        return np.arange(n), np.roll(np.arange(n), 1)
    if name == "all":
        return np.triu_indices(n, 1)
    if name == "apart":  # many graphs at once, and one configuration that no pair takes part in
        return np.arange(0, n - 2, 2), np.arange(1, n - 1, 2)
    a = rng.integers(0, n, 3 * n)
    return a, (a + rng.integers(1, n, 3 * n)) % n


def random_loadings(name, n, rng, size=30.0, residual_dim=2):
    """Rows of pairs, each of a direction of its own at either end."""
    a, b = graph(name, n, rng)
    directions = rng.normal(size=(len(a), residual_dim, 2, WIDTH)) * size / np.sqrt(2.0 * WIDTH)
    directions[..., 0, :] *= rng.random(directions[..., 0, :].shape) < 0.8  # some zeros
    columns = np.stack([a, b], axis=1)[:, None, :, None] * WIDTH + np.arange(WIDTH)
    columns = np.broadcast_to(columns, directions.shape)
    rows = np.broadcast_to(np.arange(len(a) * residual_dim).reshape(-1, residual_dim, 1, 1), directions.shape)
    where = (rows.ravel(), columns.ravel())
    return scipy.sparse.csr_array((directions.ravel(), where), shape=(len(a) * residual_dim, n * WIDTH))


def missed(found, expected):
    """The largest share of the information in any direction that two Gram matrices differ by."""
    half = np.linalg.inv(np.linalg.cholesky(expected))
    return np.abs(np.linalg.eigvalsh(half @ (found - expected) @ half.T)).max()


WAYS = {"rows": sharing._FewRows, "errors": sharing._FewErrors, "steps": lambda L: sharing._Many(L, WIDTH)}
GRAPHS = ("star", "chain", "tree", "ring", "random", "all", "apart")


@cache
def drawn(name):
    """Of a graph: loadings, some rows, the dense covariance and the inverse of its triangle."""
    rng = np.random.default_rng(GRAPHS.index(name))
    L = random_loadings(name, 24 if name == "all" else 40, rng)
    A, C = rng.normal(size=(L.shape[0], 11)), np.eye(L.shape[0]) + (L @ L.T).toarray()
    half = np.linalg.inv(np.linalg.cholesky(C))
    for array in (A, C, half):
        array.setflags(write=False)
    return L, A, C, half


@pytest.fixture(params=GRAPHS)
def case(request):
    """Loadings, some rows and the dense covariance."""
    return drawn(request.param)[:3]


@pytest.fixture(params=GRAPHS)
def halved(request):
    """Loadings, some rows and the inverse of the dense covariance's triangle."""
    L, A, _, half = drawn(request.param)
    return L, A, half


@pytest.mark.sampled(1)
@pytest.mark.parametrize("way", WAYS)
def test_rows_are_whitened_by_their_dense_covariance(case, way):
    L, A, C = case
    way = WAYS[way](L)
    W, expected = way.whiten(A), A.T @ np.linalg.solve(C, A)
    assert missed(W.T @ W, expected) < EXACT
    one = way.whiten(A[:, 2:3])
    assert one.T @ one == pytest.approx(expected[2:3, 2:3], rel=EXACT)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("way", WAYS)
def test_most_likely_errors_are_those_of_the_dense_covariance(case, way):
    """Steps end with what is left of the Gram matrix; of the errors, in their sigma, it is the root of that."""
    L, A, C = case
    way = WAYS[way](L)
    expected = L.T @ np.linalg.solve(C, A)
    size = np.sqrt(np.sum(A * np.linalg.solve(C, A), axis=0).max())
    assert np.abs(way.most_likely(A) - expected).max() < np.sqrt(EXACT) * size
    variances = 1.0 - np.einsum("ij,ij->j", L.toarray(), np.linalg.solve(C, L.toarray()))
    assert way.variances() == pytest.approx(variances, rel=EXACT, abs=rounding(1.0, 1e3))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("way", WAYS)
def test_the_trace_over_the_covariance_is_exact_or_within_its_bound(case, way):
    L, _, C = case
    rng = np.random.default_rng(5)
    E = scipy.sparse.diags_array(rng.random(L.shape[0]), format="csr")
    expected = np.trace(E.T @ np.linalg.solve(C, E.toarray()))
    off = 4.0 * np.sqrt(2.0 * L.shape[0] / sharing.N_PROBES) if way == "steps" else 1e-9 * expected
    assert abs(WAYS[way](L).energy(E) - expected) < off


@pytest.mark.sampled(1)
@pytest.mark.parametrize("exact", [True, False])
def test_products_of_covariances_are_exact_or_within_their_bounds(case, exact, monkeypatch):
    """Estimates to four of their sigmas, at most sqrt(2 / 64) of each; the others to rounding of what cancels.

    Squares of sums of some 24 loadings of 30, of which 1e-9 is left.
    """
    L, _, C = case
    rng = np.random.default_rng(6)
    roots = [
        scipy.sparse.diags_array(rng.random(L.shape[0]), format="csr"),
        scipy.sparse.csr_array(L[:, ::2]),
        scipy.sparse.csr_array((L.shape[0], 0)),
    ]
    if not exact:
        for name in ("MAX_EXACT", "MAX_DENSE", "FILLED"):
            monkeypatch.setattr(sharing, name, 0)
    traces, squares = SharedErrors(L, WIDTH).products(roots)
    between = [[(E.T @ np.linalg.solve(C, F.toarray())) for F in roots] for E in roots]
    rel = 4.0 * np.sqrt(2.0 / sharing.N_PROBES) if not exact else 1e-6
    assert traces == pytest.approx([np.trace(row[i]) for i, row in enumerate(between)], rel=rel)
    assert squares == pytest.approx(np.array([[np.sum(N**2) for N in row] for row in between]), rel=rel)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("weak", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("way", WAYS)
def test_weak_directions_survive(halved, way, weak):
    """Singular values down to 1e-9 of the largest are those of a dense QR within 1 %."""
    L, A, half = halved
    U, _, Vt = np.linalg.svd(A, full_matrices=False)
    A = (U * np.geomspace(1.0, weak, len(Vt))) @ Vt
    expected = np.linalg.svd(np.linalg.qr(half @ A, mode="r"), compute_uv=False)
    found = np.linalg.svd(np.linalg.qr(WAYS[way](L).whiten(A), mode="r"), compute_uv=False)
    assert found == pytest.approx(expected, rel=0.01, abs=0.0)
    if weak == 1e-9:  # and a Gram matrix would not do
        gram = A.T @ (half.T @ (half @ A))
        assert np.linalg.eigvalsh(gram)[0] != pytest.approx(expected[-1] ** 2, rel=0.1, abs=0.0)


@pytest.mark.slow
def test_without_loops_one_step_is_all_it_takes(monkeypatch):
    monkeypatch.setattr(sharing, "_MOST_STEPS", 1)
    monkeypatch.setattr(sharing, "_MOST_PASSES", 2)  # the second for what is rounding
    rng = np.random.default_rng(8)
    for name in ("star", "chain", "tree", "apart"):
        L = random_loadings(name, 300, rng)
        A = rng.normal(size=(L.shape[0], 3))
        W = sharing._Many(L, WIDTH).whiten(A)
        assert missed(W.T @ W, A.T @ np.linalg.solve(np.eye(len(A)) + (L @ L.T).toarray(), A)) < EXACT


def test_rows_without_any_size_or_columns_stay_so():
    L = random_loadings("random", 30, np.random.default_rng(9))
    many = sharing._Many(L, WIDTH)
    assert np.array_equal(many.whiten(np.zeros((L.shape[0], 2))), np.zeros((sum(L.shape), 2)))
    assert many.whiten(np.zeros((L.shape[0], 0))).shape == (sum(L.shape), 0)


def test_parallel_columns_are_whitened_alike():
    rng = np.random.default_rng(10)
    L = random_loadings("random", 30, rng)
    column = rng.normal(size=L.shape[0])
    W = sharing._Many(L, WIDTH).whiten(np.stack([column, 0.0 * column, -1e6 * column], axis=1))
    assert np.allclose(W[:, 2], -1e6 * W[:, 0], rtol=0.0, atol=rounding(1e6 * np.abs(W[:, 0]).max(), 10.0))


def test_errors_out_of_all_proportion_to_the_noise_are_refused():
    L = random_loadings("random", 30, np.random.default_rng(11), size=1e12)
    with pytest.raises(SolverError, match=r"errors that rows share: .* expected 1e-09"):
        sharing._Many(L, WIDTH).whiten(np.random.default_rng(0).normal(size=(L.shape[0], 2)))


def test_the_way_is_that_of_the_smaller_matrix_and_not_part_of_what_is_compared(monkeypatch):
    rng = np.random.default_rng(12)
    chain, everything = (random_loadings(name, 20, rng) for name in ("chain", "all"))
    assert isinstance(SharedErrors(chain, WIDTH)._way, sharing._FewRows)
    assert isinstance(SharedErrors(everything, WIDTH)._way, sharing._FewErrors)
    assert SharedErrors(chain, WIDTH).n == chain.shape[0]
    monkeypatch.setattr(sharing, "MAX_DENSE", 30)
    assert isinstance(SharedErrors(chain, WIDTH)._way, sharing._Many)
    assert isinstance(SharedErrors(everything, WIDTH)._way, sharing._FewErrors)  # filled anyway
    monkeypatch.setattr(sharing, "FILLED", 0)
    assert isinstance(SharedErrors(everything, WIDTH)._way, sharing._Many)
    assert SharedErrors(chain, WIDTH).n == sum(chain.shape)


def test_steps_do_not_depend_on_processors(monkeypatch):
    rng = np.random.default_rng(13)
    L = random_loadings("random", 50, rng)
    A = rng.normal(size=(L.shape[0], 20))
    many = sharing._Many(L, WIDTH).whiten(A)
    monkeypatch.setattr("fg_calib.robot.kinematics.processors", lambda: 1)
    assert np.array_equal(sharing._Many(L, WIDTH).whiten(A), many)
