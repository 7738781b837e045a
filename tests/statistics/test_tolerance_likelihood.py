"""Scales of corrections by their marginal likelihood, against formulas written down anew."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from tolerances import rounding

from fg_calib.statistics.tolerance_likelihood import APART, TOGETHER, Corrections, _Point, posterior_of

GROUP = np.array([0, 0, 0, 1, 1, 2])


def drawn(rng, scale, rows=9, noise=0.3, group=GROUP, unseen=()):
    """Rows of unit noise of corrections that are so many tolerances large, and what they say of these."""
    R = rng.normal(size=(rows, len(group))) / noise
    R[:, list(unseen)] = 0.0
    z = R @ (np.asarray(scale)[group] * rng.normal(size=len(group))) + rng.normal(size=rows)
    return R, z, Corrections(R.T @ R, R.T @ z, group)


def guess(n):
    """The covariance of the logarithms of scales before any data."""
    return TOGETHER**2 * np.ones((n, n)) + APART**2 * np.eye(n)


def test_the_posterior_is_the_density_of_the_rows_with_the_corrections_integrated_out():
    rng = np.random.default_rng(0)
    R, z, corrections = drawn(rng, [1.0, 3.0, 0.2])

    def dense(theta):
        covariance = np.eye(len(z)) + R @ np.diag(np.exp(2.0 * theta[GROUP])) @ R.T
        return multivariate_normal(cov=covariance).logpdf(z) + multivariate_normal(cov=guess(3)).logpdf(theta)

    a, b = rng.normal(size=(2, 3))
    found = _Point(corrections, a).value - _Point(corrections, b).value
    assert found == pytest.approx(dense(a) - dense(b), abs=rounding(z @ z))


def test_gradient_and_curvature_of_the_posterior_are_its_differences():
    rng = np.random.default_rng(1)
    _, _, corrections = drawn(rng, [1.0, 3.0, 0.2])
    theta, h = 0.5 * rng.normal(size=3), 1e-4
    gradient, hessian, _ = _Point(corrections, theta).derivatives()
    steps = h * np.eye(3)
    values = [_Point(corrections, theta + s).value - _Point(corrections, theta - s).value for s in steps]
    np.testing.assert_allclose(np.array(values) / (2.0 * h), gradient, rtol=1e-6)  # h^2 of the third derivative
    ends = [[_Point(corrections, theta + way * s).derivatives()[0] for way in (1.0, -1.0)] for s in steps]
    slopes = [up - down for up, down in ends]
    np.testing.assert_allclose(np.array(slopes) / (2.0 * h), hessian, rtol=1e-6)


def test_the_mean_curvature_is_that_over_draws_of_corrections():
    rng = np.random.default_rng(2)
    theta = np.log([1.0, 3.0, 0.2])
    R, _, corrections = drawn(rng, np.exp(theta))
    found = []
    for _ in range(400):
        z = R @ (np.exp(theta)[GROUP] * rng.normal(size=len(GROUP))) + rng.normal(size=len(R))
        found.append(_Point(Corrections(corrections.information, R.T @ z, GROUP), theta).derivatives()[1])
    mean = _Point(corrections, theta).derivatives()[2]
    off = (np.mean(found, axis=0) - mean) / np.maximum(np.std(found, axis=0) / np.sqrt(400), rounding())
    assert np.abs(off).max() < 4.0


def test_points_integrate_a_skew_posterior_as_a_fine_grid_does():
    """Three corrections, two of them seen badly: mean, interval, and what not knowing the scale adds."""
    *_, corrections = drawn(np.random.default_rng(3), [2.0], rows=3, noise=1.5, group=np.zeros(3, dtype=np.int64))
    found = posterior_of(corrections)
    grid = np.linspace(-12.0, 8.0, 1001)
    points = [_Point(corrections, np.array([t])) for t in grid]
    density = np.exp([p.value - max(q.value for q in points[::50]) for p in points])
    density /= density.sum()
    mean = density @ grid
    sd = np.sqrt(density @ (grid - mean) ** 2)
    assert abs(found.theta[0] - mean) < 0.05 * sd  # 256 points that repeat themselves less than chance
    ends = np.interp([0.025, 0.975], np.cumsum(density), grid)
    np.testing.assert_allclose(np.ravel(found.interval), ends, atol=0.2 * sd)
    at = _Point(corrections, found.theta)
    away = [p.estimate - at.estimate for p in points]
    whole = sum(d * (p.covariance + np.outer(o, o)) for d, p, o in zip(density, points, away, strict=True))
    np.testing.assert_allclose(np.diag(found.unsure + at.covariance), np.diag(whole), rtol=0.1)


def test_a_group_that_rows_do_not_tell_of_goes_with_the_others():
    """As far as a common factor explains these, and it is known no better than a group is beside the others."""
    *_, corrections = drawn(np.random.default_rng(4), [10.0, 10.0, 1.0], rows=200, noise=1e-3, unseen=[5])
    found = posterior_of(corrections)
    assert found.seen[2] == pytest.approx(0.0, abs=rounding())
    share = guess(3)[2, :2] @ np.linalg.inv(guess(3)[:2, :2])
    assert found.theta[2] == pytest.approx(share @ found.theta[:2], abs=0.1)
    low, high = found.interval
    assert high[2] - low[2] > 3.0 * APART


def test_tolerances_that_rows_do_not_tell_of_stay_as_stated():
    corrections = Corrections(np.zeros((6, 6)), np.zeros(6), GROUP)
    found = posterior_of(corrections)
    half = norm.ppf(0.975) * np.sqrt(guess(1)[0, 0])
    np.testing.assert_allclose(found.theta, 0.0, atol=0.1 * half)
    low, high = found.interval
    np.testing.assert_allclose(high, half, rtol=0.15)
    np.testing.assert_allclose(low, -half, rtol=0.15)


def test_one_correction_that_is_nil_does_not_make_its_tolerance_nothing():
    found = posterior_of(Corrections(np.array([[1e8]]), np.zeros(1), np.zeros(1, dtype=np.int64)))
    assert 1e-3 < np.exp(found.theta[0]) < 1.0


def test_many_good_rows_leave_what_the_corrections_themselves_say():
    """Six corrections known exactly: the scale is their RMS but for its guess, known to 1 / sqrt(12)."""
    rng, group = np.random.default_rng(5), np.zeros(6, dtype=np.int64)
    u = 7.0 * rng.normal(size=6)
    found = posterior_of(Corrections(1e10 * np.eye(6), 1e10 * u, group))
    assert found.theta[0] == pytest.approx(np.log(np.sqrt(np.mean(u**2))), abs=0.15)
    assert np.ptp(found.interval) == pytest.approx(2.0 * 1.96 / np.sqrt(12.0), rel=0.15)
    assert found.seen[0] == pytest.approx(6.0, abs=1e-6)


@pytest.mark.slow
def test_intervals_of_scales_hold_the_true_ones_as_often_as_they_say():
    """True scales drawn as the guess has them; 95 % of 240 within four sigma."""
    rng = np.random.default_rng(6)
    held = []
    for _ in range(80):
        theta = rng.multivariate_normal(np.zeros(3), guess(3))
        low, high = posterior_of(drawn(rng, np.exp(theta))[2]).interval
        held += ((low <= theta) & (theta <= high)).tolist()
    assert abs(np.mean(held) - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 80)
