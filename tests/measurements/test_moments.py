"""Means and variances of noisy lengths and angles against independent integrals and drawn noise."""

from functools import cache

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.spatial.transform import Rotation
from sparing import diagonal

from fg_calib.measurements.moments import angle_moments, length_moments

LENGTHS = (0.0, 1e-6, 0.3, 1.0, 2.0, 4.0, 8.4, 8.6, 20.0, 1e3)
"""In sigma: about 8.5 the formula changes."""


def of_length(f, along, across, own=0.0):
    found = length_moments(*(np.atleast_1d(np.float64(x)) for x in (f, along, across, own)))
    return found.excess[0], found.slope[0], found.variance[0]


def of_angle(f, along, across, own=0.0):
    found = angle_moments(*(np.atleast_1d(np.float64(x)) for x in (f, along, across, own)))
    return found.excess[0], found.slope[0], found.variance[0]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("f", LENGTHS)
def test_errors_alike_in_all_directions_give_the_noncentral_chi_distribution(f, scale):
    excess, _, variance = of_length(scale * f, scale**2, scale**2)
    mean = mean_of_root(stats.ncx2(3, max(f**2, 1e-12)), f) if f <= 20.0 else f + 1.0 / f
    assert excess / scale == pytest.approx(mean - f, abs=1e-9)  # the integral's own error, in sigma
    if f <= 20.0:
        assert variance / scale**2 == pytest.approx(f**2 + 3.0 - mean**2, abs=1e-7)


def mean_of_root(of_square, f):
    """Mean length from the distribution of its square, by numerical integration over the length."""
    low, high = max(0.0, f - 12.0), f + 12.0
    return integrate.quad(lambda m: m * of_square.pdf(m * m) * 2.0 * m, low, high, epsabs=1e-12, limit=400)[0]


SPREADS = [(1.0, 0.3, 0.0), (0.2, 1.0, 0.0), (0.05, 1.0, 0.0), (0.0, 0.0, 1.0)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("f", "spread"), diagonal([0.0, 0.5, 1.0, 3.0, 8.0, 9.0, 30.0], SPREADS, every=2))
def test_moments_are_those_of_drawn_lengths(f, spread):
    s, t, own = spread
    rng = np.random.default_rng(5)
    n = 400_000
    x, y, z, e = rng.normal(size=(4, n))
    drawn = np.abs(np.sqrt((f + s * x) ** 2 + t**2 * (y**2 + z**2)) + own * e)
    excess, _, variance = of_length(f, s**2, t**2, own**2)
    sd = drawn.std()
    # A drawn mean is off by 1 / sqrt(n) = 0.0016 sd. Beyond 8.5 t the series leaves out (t / f)^4, next to s.
    assert f + excess == pytest.approx(drawn.mean(), abs=5.0 * sd / np.sqrt(n) + 1e-3 * t)
    assert np.sqrt(variance) == pytest.approx(sd, rel=0.01, abs=3e-3 * t)


@pytest.mark.parametrize("errors", [(1.0, 1.0, 0.0), (1.0, 0.3, 0.0), (0.5, 1.0, 0.7), (0.0, 0.0, 1.0)])
@pytest.mark.parametrize("f", [0.2, 1.0, 3.0, 7.0, 12.0])
def test_the_slope_of_a_length_is_that_of_its_mean(f, errors):
    squared = [e**2 for e in errors]
    h = 1e-4
    up, down = (f + d + of_length(f + d, *squared)[0] for d in (h, -h))
    assert of_length(f, *squared)[1] == pytest.approx((up - down) / (2 * h), abs=1e-7)


@cache
def small_turns(sigma, n):
    """The same draws for every angle."""
    return Rotation.from_rotvec(sigma * np.random.default_rng(7).normal(size=(n, 3)))


ENDS = [0.0, 0.5, 1.0, 2.0, 5.0, 20.0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("from_end", "pi", "sigma"), diagonal(ENDS, [False, True], [1e-4, 0.02]))
def test_moments_are_those_of_drawn_rotations(from_end, pi, sigma):
    n = 100_000
    f = np.pi - from_end * sigma if pi else from_end * sigma
    axis = np.array([0.6, 0.0, 0.8])
    drawn = (Rotation.from_rotvec(f * axis) * small_turns(sigma, n)).magnitude()
    excess, _, variance = of_angle(f, sigma**2, sigma**2)
    assert f + excess == pytest.approx(drawn.mean(), abs=5.0 * sigma / np.sqrt(n))
    assert np.sqrt(variance) == pytest.approx(drawn.std(), rel=0.01)


@pytest.mark.parametrize("f", [0.03, 0.2, 1.0, 2.5, np.pi - 0.2, np.pi - 0.03])
def test_the_slope_of_an_angle_is_that_of_its_mean(f):
    h = 1e-5
    up, down = (f + d + of_angle(f + d, 4e-4, 4e-4)[0] for d in (h, -h))
    # Near pi the fold's own variance moves with the angle too, which the slope leaves out: 1e-5 of it.
    assert of_angle(f, 4e-4, 4e-4)[1] == pytest.approx((up - down) / (2 * h), abs=2e-5)


@pytest.mark.parametrize("moments", [length_moments, angle_moments])
@pytest.mark.parametrize(("f", "own"), [([0.0, 1e-9, 1.0, np.pi], 0.0), ([0.01, 1.0, 3.0], 1e-6)])
def test_no_noise_changes_nothing_and_that_of_the_instrument_none_far_from_0_and_half_a_turn(moments, f, own):
    zero = np.zeros(len(f))
    found = moments(np.array(f), zero, zero, zero + own)
    assert np.all(found.excess == 0.0)
    assert np.all(found.slope == 1.0)
    assert np.all(found.variance == own)
