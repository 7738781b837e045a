"""The mean of samples whose noise is correlated, and its sigma.

Of n samples with autocorrelation rho_k the mean of samples of variance s^2 has the variance

    s^2 tau / n,    tau = 1 + 2 sum_k (1 - k / n) rho_k

(integrated autocorrelation time, in samples; Sokal 1997, *Monte Carlo Methods in Statistical Mechanics*, Sec. 3). tau
is estimated from all stops together, as one is too short. As s is estimated too, the variance is that of Student's t.
Von Neumann's ratio: von Neumann 1941, *Distribution of the Ratio of the Mean Square Successive Difference to the
Variance*.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fg_calib.arrays import Floats

LEAST_SIGMA = 1e-6
"""Of a mean, [m] or [rad]: poses without any scatter are not exact either."""

_WINDOW = 3.0
"""Autocorrelations are summed up to so many times the time itself."""


def correlation_time(residuals: Sequence[Floats]) -> float:
    """Integrated autocorrelation time of noise, in samples, at least 1.

    The autocovariance of what is left of a stop after its mean is too small by about the variance v of that mean, which
    is therefore added: v = A / (1 - B) with the sums A of the covariances and B of ones up to the lag where the sum
    ends. That lag is the first beyond three times the time itself (Sokal's window). Where there is none within half a
    stop, noise is taken as AR(1): `_time_of_ar1`.

    Args:
        residuals: Of each stop, less its mean, shape (n, k).
    """
    steps = [np.sqrt(np.mean(np.diff(r, axis=0) ** 2, axis=0)) for r in residuals]
    scaled = [r / np.where(s > 0.0, s, 1.0) for r, s in zip(residuals, steps, strict=True)]  # stops count alike
    n = int(np.median([len(r) for r in scaled]))
    longest = n // 2
    products = np.zeros(longest + 1)
    counts = np.zeros(longest + 1)
    for r in scaled:
        size = 1 << (2 * len(r)).bit_length()
        spectrum = np.abs(np.fft.rfft(r, size, axis=0)) ** 2
        here = min(longest + 1, len(r))
        products[:here] += np.fft.irfft(spectrum, size, axis=0)[:here].sum(axis=1)
        counts[:here] += (len(r) - np.arange(here)) * r.shape[1]
    if products[0] <= 0.0:
        return 1.0
    covariance = products / np.maximum(counts, 1.0)
    weight = np.append(1.0, 2.0 * (1.0 - np.arange(1, longest + 1) / n))
    total, ones = np.cumsum(weight * covariance), np.cumsum(weight) / n
    of_mean = total / n / np.maximum(1.0 - ones, 0.1)
    tau = np.maximum(n * of_mean / (covariance[0] + of_mean), 1.0)
    over = np.arange(longest + 1) >= _WINDOW * tau
    if over.any():
        return float(tau[np.argmax(over)])
    return max(_time_of_ar1(1.0 / float(covariance[0]), n), n / (2.0 * _WINDOW))


def _time_of_ar1(ratio: float, n: int) -> float:
    """Integrated time of AR(1) noise from von Neumann's ratio, squared steps over the variance about a stop's mean.

    The ratio is 2 (1 - phi) / (1 - variance of the mean), which falls as phi grows; what is slower than ten stops
    cannot be told from a walk.
    """
    grid = np.geomspace(1.0, 20.0 * n, 400)
    phi = (grid - 1.0) / (grid + 1.0)
    expected = 2.0 * (1.0 - phi) / (1.0 - _variance_of_mean(grid, n))
    return float(np.interp(-ratio, -expected, grid))


def _variance_of_mean(tau: Floats, n: int) -> Floats:
    """Variance of the mean of n samples of AR(1) noise of variance 1, by its integrated time."""
    phi = (tau - 1.0) / (tau + 1.0)
    variance: Floats = (tau - 2.0 * phi * (1.0 - phi**n) / (n * (1.0 - phi) ** 2)) / n
    return variance


def is_slow(tau: float, n: float) -> bool:
    """Whether noise is correlated over so much of a stop of n samples that averaging it is not worth counting."""
    return tau > n / (2.0 * _WINDOW)


def sigma_of_mean(residuals: Floats, tau: float) -> Floats:
    """Sigma of the mean of correlated samples, shape (k,).

    The variance of Student's t with n / tau - 1 degrees of freedom, for the scatter is estimated from the same samples.
    Of slow noise that of AR(1), from the steps from sample to sample as a stop hardly shows the scatter, and at least
    that of a single sample.

    Args:
        residuals: Less their mean, shape (n, k).
        tau: Integrated autocorrelation time, in samples.
    """
    n = len(residuals)
    square = np.mean(residuals**2, axis=0)
    if is_slow(tau, n):
        steps = np.mean(np.diff(residuals, axis=0) ** 2, axis=0)  # of AR(1): 2 (1 - phi) of a sample's variance
        single = steps * (tau + 1.0) / 4.0
        variance = np.maximum(single * _variance_of_mean(np.array(tau), n), square * n / (n - 1))
    else:
        freedom = max(n / tau - 1.0, 3.0)
        variance = square * (tau / n) / (1.0 - tau / n) * (freedom / (freedom - 2.0))
    sigma: Floats = np.maximum(np.sqrt(variance), LEAST_SIGMA)
    return sigma
