r"""Mean and variance of measured lengths and rotation angles: what noise does to them beyond the first order.

A length is measured as `m = |v + e|`, v the true vector of length f, e its error with variance s^2 along v and t^2 in
each of the two directions across. Errors across lengthen it, whatever their sign. With x what v + e is along v,

    E[m | x] = |x| + t sqrt(pi / 2) erfcx(|x| / (t sqrt 2)),

and x is normal with mean f and variance s^2. The mean of |x| alone is

    fold(f, s) = s sqrt(2 / pi) exp(-f^2 / (2 s^2)) + f erf(f / (s sqrt 2)),

what becomes of a number that cannot be negative; that of the rest is integrated numerically. The variance follows with
E m^2 = f^2 + s^2 + 2 t^2. Far from 0, and for s = t exactly but for exp(-f^2 / (2 s^2)),

    E m = f + t^2 / f,   var m = s^2 + (t^4 - 2 s^2 t^2) / f^2.

A rotation angle is the length of a rotation vector near 0. Away from there errors across the axis make it larger by
`t^2 cot(f / 2) / 2` on average; near pi, where the angles pi - x and pi + x are the same rotation, it folds:
pi - m = |pi - f + e|.

An instrument that measures a length or an angle directly has an error of its own, which acts along v alone: fold.

The mean M is smooth and even in f, so that it has a slope everywhere, 0 at 0 and pi: a row `M(f) - m` of variance V has
mean 0 wherever f is. Weighted least squares of such rows is a quasi-likelihood (Wedderburn 1974): no row need be
chosen by its distance from an end, which by the measured value would bias the estimate.

References:
    Johnson, Kotz, Balakrishnan (1995), Continuous Univariate Distributions 2, ch. 29: noncentral chi.
    Wedderburn (1974), Quasi-likelihood functions, generalized linear models, and the Gauss-Newton method.
    Biometrika 61.
"""

from typing import NamedTuple

import numpy as np
from scipy import special

from fg_calib.inputs import Floats

FAR = 8.5
"""Distance from an end of the range, in sigma, beyond which the exponentials are rounding."""

WIDE = 0.25
"""Variance of a rotation error, [rad^2], beyond which it is taken for this: angles go no further than half a turn."""

LEAST_VARIANCE = 0.1
"""Share of a variance that is left at least, where series for small errors would leave less."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


class Moments(NamedTuple):
    """Mean and variance of what is measured, as functions of what is true.

    Attributes:
        excess: Mean minus the true value, any shape, [m] or [rad].
        slope: Derivative of the mean in the true value.
        variance: [m^2] or [rad^2].
    """

    excess: Floats
    slope: Floats
    variance: Floats


def length_moments(f: Floats, along: Floats, across: Floats, own: Floats) -> Moments:
    """Moments of measured lengths.

    Args:
        f: True lengths, >= 0, any shape, [m].
        along: Variance of the vector's error along it, of the same shape, [m^2].
        across: Variance in each direction across.
        own: Variance of the length's own error.
    """
    return _folded(f, _vector_length(f, along, across), own)


def angle_moments(f: Floats, along: Floats, across: Floats, own: Floats) -> Moments:
    """Moments of measured rotation angles.

    Args:
        f: True angles in [0, pi], any shape, [rad].
        along: Variance of the rotation error about the axis, of the same shape, [rad^2].
        across: Variance about each axis across.
        own: Variance of the angle's own error.
    """
    along, across, own = (np.minimum(v, WIDE) for v in (along, across, own))
    vector = _vector_length(f, along, across)
    if across.any():
        half = np.clip(0.5 * f, 1e-4, 0.5 * np.pi)
        # What cot(f / 2) / 2 is less than 1 / f: -f / 12 to first order.
        more = across**2 * (0.25 / np.tan(half) ** 2 - 0.25 / half**2)
        vector = Moments(
            vector.excess + across * (0.5 / np.tan(half) - 0.5 / half),
            vector.slope + across * (0.5 / half**2 - 0.5 / np.sin(half) ** 2) / 2.0,
            np.maximum(vector.variance + more, LEAST_VARIANCE * vector.variance),
        )
    near_zero = _folded(f, vector, own)
    x = np.pi - f - near_zero.excess
    fold = _fold(np.maximum(x, 0.0), near_zero.variance)
    variance = np.maximum(fold.variance, LEAST_VARIANCE * near_zero.slope**2 * (along + own))
    return Moments(near_zero.excess - fold.excess, near_zero.slope * fold.slope, variance)


def _vector_length(f: Floats, along: Floats, across: Floats) -> Moments:
    """Moments of the length of a vector with a random error."""
    near = (f < FAR * np.sqrt(np.maximum(along, across))) & (across > 0.0)
    relative = np.divide(across, f**2, out=np.zeros_like(f), where=(f > 0.0) & ~near)
    excess, slope, variance = relative * f, 1.0 - relative, along + (across - 2.0 * along) * relative
    folds = (across == 0.0) & (along > 0.0)
    for rows, of in ((near, _near_length), (folds, lambda f, along, _: _fold(f, along))):
        if rows.any():
            excess[rows], slope[rows], variance[rows] = of(f[rows], along[rows], across[rows])
    return Moments(excess, slope, variance)


def _near_length(f: Floats, along: Floats, across: Floats) -> Moments:
    """Moments near length 0, shape (n,): `across` above 0."""
    t = np.sqrt(across)[:, None]
    s = np.maximum(np.sqrt(along)[:, None], 0.05 * t)  # what errors across add is as good as constant over less
    first, last = np.maximum(f[:, None] - FAR * s, 0.0), f[:, None] + FAR * s
    x = first + (last - first) * (0.5 + 0.5 * _NODES)  # (n, nodes), none below 0: the rest is even in x
    rest = t * np.sqrt(0.5 * np.pi) * special.erfcx(x / (t * np.sqrt(2.0))) * (0.5 * (last - first) * _WEIGHTS)
    right, left = (x - f[:, None]) / s, (x + f[:, None]) / s
    density = [np.exp(-0.5 * z * z) / (s * np.sqrt(2.0 * np.pi)) for z in (right, left)]
    fold = _fold(f, s[:, 0] ** 2)
    excess = fold.excess + np.sum(rest * (density[0] + density[1]), axis=1)
    slope = fold.slope + np.sum(rest * (right * density[0] - left * density[1]) / s, axis=1)
    return Moments(excess, slope, f**2 + along + 2.0 * across - (f + excess) ** 2)


def _folded(f: Floats, inner: Moments, own: Floats) -> Moments:
    """Moments of |n + e|, n a length with moments `inner` at f, e its private error."""
    fold = _fold(f + inner.excess, own)
    variance = fold.variance + inner.variance * fold.slope**2
    return Moments(inner.excess + fold.excess, inner.slope * fold.slope, variance)


def _fold(x: Floats, variance: Floats) -> Moments:
    """Moments of |x + e|, x >= 0 and e of that variance."""
    s = np.sqrt(variance)
    excess, slope, left = np.zeros_like(x), np.ones_like(x), variance.astype(np.float64).copy()
    near = (x <= FAR * s) & (s > 0.0)
    a = x[near] / s[near]
    erf = special.erf(a / np.sqrt(2.0))
    mean = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * a * a) + a * erf
    excess[near], slope[near] = s[near] * (mean - a), erf
    left[near] = variance[near] * np.maximum(a * a + 1.0 - mean**2, 0.0)
    return Moments(excess, slope, left)
