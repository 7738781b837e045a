r"""Robust losses: the weight of a measurement by how far off it is, and what that does to sigmas and to chi-square.

`e` is the length of a measurement's whitened residual, a vector of h rows (1 for a distance, 2 for a distance with its
angle, 6 for a pose), so that e^2 of a clean one is chi-square of h degrees of freedom.

| loss | weight | optimum of |
|---|---|---|
| `none` | 1 | sum of e^2 / 2 |
| `huber` | 1 below c, c / e above | sum of e^2 / 2 below, c (e - c / 2) above |
| `cauchy` | c^2 / (c^2 + e^2) | sum of c^2 / 2 log(1 + e^2 / c^2) |
| `geman-mcclure` | c^4 / (c^2 + e^2)^2 | sum of c^2 e^2 / (c^2 + e^2) / 2 |
| `gnc` | 1 below c, 0 above | sum of min(e^2, c^2) / 2, found by graduated non-convexity (Yang et al. 2020) |

The first four are those of GTSAM's robust noise models on a factor of one measurement. c is such that clean Gaussian
measurements lose 5 % of their efficiency (1.345 and 2.385 for Huber and Cauchy in one dimension); for `gnc` it is what
99 % of clean measurements stay below.

The surrogates of `gnc` are those of Yang et al. scaled so that a measurement below c always has the weight 1: else the
priors would outweigh all measurements in the first rounds.

Weights go with least squares in turns: each solution gives new weights until they stay. A weight acts by noise of its
measurement's own: (1 / weight - 1) times its covariance is added, so that also where measurements share errors one of
weight 0 says nothing.

References:
    Holland & Welsch (1977), Robust regression using iteratively reweighted least-squares. Comm. Statistics A 6(9).
    Huber & Ronchetti (2009), Robust Statistics, 2nd ed., ch. 7: asymptotic covariance of M-estimates.
    Yang, Antonante, Tzoumas, Carlone (2020), Graduated non-convexity for robust spatial perception. IEEE RA-L 5(2).
"""

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.inputs import Floats, Loss, Record, optimize

EFFICIENCY = 0.95
"""Efficiency on clean Gaussian measurements of losses that do not reject."""

INLIERS = 0.99
"""Share of clean measurements that `gnc` keeps."""

HALF_WEIGHT: dict[Loss, float] = {"huber": 2.0, "cauchy": 1.0, "geman-mcclure": (2.0**0.5 - 1.0) ** 0.5, "gnc": 1.0}
"""Residual, in the constant c, where a loss has the weight 1/2: larger ones are outliers."""

FAR = 1e6
"""Residual of an outlier, in the constant c."""

SCHEDULE = 1.4
"""Factor by which `gnc` makes its surrogate less convex in each round (Yang et al. 2020)."""


def weight(loss: Loss, e: Floats, c: Floats | float) -> Floats:
    """Weight of measurements, in [0, 1].

    Args:
        loss: The loss.
        e: Length of the whitened residual, any shape.
        c: The loss's constant, of a shape that goes with `e`.
    """
    return _LOSSES[loss][0](e, c)


def cost(loss: Loss, e: Floats, c: Floats | float) -> Floats:
    """Cost of measurements under a loss: its derivative in `e` is `e` times their `weight`, whose arguments it has."""
    return _LOSSES[loss][1](e, c)


_LOSSES: dict[Loss, tuple[Callable[..., Floats], Callable[..., Floats]]] = {
    "none": (lambda e, _: np.ones_like(e), lambda e, _: 0.5 * e**2),
    "huber": (
        lambda e, c: np.minimum(1.0, c / np.maximum(e, 1e-300)),
        lambda e, c: np.where(e <= c, 0.5 * e**2, c * (e - 0.5 * c)),
    ),
    "cauchy": (lambda e, c: c**2 / (c**2 + e**2), lambda e, c: 0.5 * c**2 * np.log1p((e / c) ** 2)),
    "geman-mcclure": (lambda e, c: (c**2 / (c**2 + e**2)) ** 2, lambda e, c: 0.5 * c**2 * e**2 / (c**2 + e**2)),
    "gnc": (lambda e, c: (e <= c).astype(np.float64), lambda e, c: 0.5 * np.minimum(e, c) ** 2),
}
"""Weight and cost of each loss."""


@cache
def tuning(loss: Loss, dim: int) -> float:
    """The constant c of a loss for measurements of `dim` rows; infinite for `none`."""
    if loss == "none":
        return np.inf
    if loss == "gnc":
        return float(np.sqrt(2.0 * special.gammaincinv(dim / 2.0, INLIERS)))

    def excess(c: float) -> float:
        _, squared, slope = _moments(loss, c, dim)
        return float(slope**2 / squared) - EFFICIENCY

    return float(optimize.brentq(excess, 0.2, 50.0))


def constants(loss: Loss, residual_dim: NDArray[np.int64]) -> Floats:
    """The constant of a loss for measurements of so many rows each, shape (n,)."""
    return np.array([tuning(loss, max(h, 1)) for h in range(residual_dim.max(initial=0) + 1)])[residual_dim]


class Effect(Record):
    """Efficiency of a robust loss on Gaussian residuals, with some outliers among them.

    Attributes:
        variance: Factor from the covariance by weighted rows to that of the estimate.
        chi2: Mean of weight * e^2 over h of a measurement that keeps at least half its weight.
    """

    variance: float
    chi2: float


@cache
def effect(loss: Loss, dim: int, low: float = 0.0) -> Effect:
    """Efficiency of a loss on measurements of `dim` rows, a share `low` of which keeps less than half its weight.

    What is more than of Gaussian ones is outliers, which are far off: they have the loss's last psi, weight, and slope.
    """
    if loss == "none":
        return Effect(1.0, 1.0)
    c = tuning(loss, dim)
    mean, squared, slope = _moments(loss, c, dim)
    end = HALF_WEIGHT[loss] * c

    def terms(e: Floats) -> Floats:
        return np.stack([np.ones_like(e), weight(loss, e, c) * e**2])

    kept, chi2 = _means(terms, dim, (0.0, min(c, end), end))
    outliers = max(0.0, 1.0 - (1.0 - low) / kept)
    squared += outliers / max(1.0 - outliers, 0.5) * (FAR * c * float(weight(loss, np.array(FAR * c), c))) ** 2 / dim
    return Effect(float(mean * squared / slope**2), float(chi2 / (dim * kept)))


def _moments(loss: Loss, c: float, dim: int) -> Floats:
    """Means of the weight w, of psi^2 / h and of the slope div(psi) / h of psi = w r, over clean residuals r.

    By parts the mean of div(psi) is that of r . psi.
    """

    def terms(e: Floats) -> Floats:
        w = weight(loss, e, c)
        return np.stack([w, w**2 * e**2 / dim, w * e**2 / dim])

    return _means(terms, dim, (0.0, c, max(c, np.sqrt(dim)) + 12.0))


def _means(terms: Callable[[Floats], Floats], dim: int, ends: tuple[float, ...]) -> Floats:
    """Integrals over the chi density from the first end to the last, smooth in between, shape (n_terms,)."""
    x, w = np.polynomial.legendre.leggauss(100)
    total = np.zeros(())
    for low, high in pairwise(ends):
        e = low + (high - low) * (x + 1.0) / 2.0
        density = e ** (dim - 1) * np.exp(-(e**2) / 2.0) / (2.0 ** (dim / 2 - 1) * special.gamma(dim / 2))
        total = total + terms(e) @ (w * density) * (high - low) / 2.0
    return total


_LAST = 1e9
"""Last constant of gnc: weights are 0 or 1 but for what lies on the line to nine figures."""


class Weighting:
    """The weights of measurements from round to round.

    Args:
        loss: The loss.
        final: Whether the loss has its final form from the first round.
    """

    def __init__(self, loss: Loss, *, final: bool = False) -> None:
        self._loss = loss
        self._mu = _LAST if final else None  # of gnc: from near 0, convex, upwards

    def update(self, e: Floats, residual_dim: NDArray[np.int64]) -> tuple[Floats, bool]:
        """Weights by the residuals of the last solution, and whether the loss has its final form.

        Args:
            e: Length of each measurement's whitened residual, shape (n,).
            residual_dim: Its number of rows, shape (n,); 0 for one that takes no part.
        """
        c = constants(self._loss, residual_dim)
        e = np.where(residual_dim > 0, e, 0.0)  # what takes no part keeps its weight
        if self._loss != "gnc":
            return weight(self._loss, e, c), True
        ratio = (e / c) ** 2  # in units of what is still taken for clean
        if self._mu is None:
            worst = float(ratio.max(initial=0.0))
            if worst <= 1.0:
                return np.ones_like(e), True
            self._mu = 1.0 / max(2.0 * worst - 1.0, 1e-12)
        else:
            self._mu = min(self._mu * SCHEDULE, _LAST)
        low, high = self._mu / (self._mu + 1.0), (self._mu + 1.0) / self._mu
        with np.errstate(divide="ignore"):
            between = np.sqrt(self._mu * (self._mu + 1.0) / ratio) - self._mu
        at_c = 1.0 / (np.sqrt(1.0 + 1.0 / self._mu) + 1.0)  # sqrt(mu (mu + 1)) - mu
        weights = np.where(ratio >= high, 0.0, np.clip(between / at_c, 0.0, 1.0))
        return weights, bool(np.all((ratio <= low) | (ratio >= high))) or self._mu >= _LAST
