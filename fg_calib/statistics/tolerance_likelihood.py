r"""How far the arm is off in tolerances: marginal likelihood of a scale for each group of them.

With u the corrections in units of the tolerances stated, what the data say of them to first order is an information
matrix G and a vector g: they prefer `G^+ g`, and `-(u^T G u) / 2 + g^T u` is their log-likelihood. What has no
tolerance, such as a measurement frame, is eliminated. Where u has the variance s^2, s the scale of its group, with
W = diag(s), `M = 1 + W G W` and `a = M^-1 W g`,

    L(s) = (g^T W a - log det M) / 2

is the likelihood with u integrated out. The estimate is `u = W a`, its covariance W C W with C = M^-1. In theta = log s

    dL / dtheta_k           = sum over k of (a_i^2 + C_ii - 1)
    d2L / dtheta_k dtheta_l = 4 a_k^T C_kl a_l + 2 |C_kl|^2 - delta_kl 2 sum over k of (a_i^2 + C_ii)

of which the mean is `-2 |(1 - C)_kl|^2`: a correction that data determine counts 2, one that they do not, nothing.
`sum over k of (1 - C_ii)` is how many corrections of a group the data tell of.

Besides there is what one knows of tolerances before: they were stated for good reason, but all may be off by a common
factor, 1 sigma of which is 5 (`TOGETHER`), and each group by another of 3 (`APART`). So a group that the data do not
tell of goes with the others, or stays as stated if there are none; one of a single correction that happens to be nil
does not collapse. A group of six corrections that the data determine is moved by these by less than a tenth of what its
scale is known to.

The posterior of theta is not normal where few corrections are seen, and its mode is too small: the scale taken is its
mean. It is integrated over points laid out by a t-distribution, first about the mode, then with the mean and covariance
found, each weighted by what the posterior is there over what that distribution is (adaptive importance sampling; the
points are the same always). They say the interval of each scale, and what not knowing the scales adds to the covariance
of the estimate:

    E[W C W + (W a - u) (W a - u)^T] - W C W at the mean.

References:
    MacKay (1992), Bayesian interpolation. Neural Computation 4(3): evidence, and number of well-determined parameters.
    Kass & Steffey (1989), Approximate Bayesian inference in conditionally independent hierarchical models. JASA 84.
    Gelman (2006), Prior distributions for variance parameters in hierarchical models. Bayesian Analysis 1(3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TOGETHER, APART = float(np.log(5.0)), float(np.log(3.0))
"""1 sigma of the logarithm of a scale before any data: of all alike, and of each beside the others."""

FARTHEST = 2.0
"""A step of the logarithm of a scale is at most this long."""

MOST_STEPS = 100

NEAR_MODE = 1e-9
"""Gain of the logarithm of the posterior that a step must promise."""

STARTS = (0.0, float(np.log(0.1)), float(np.log(10.0)))
"""Logarithms of all scales that ascents start from: where few corrections are seen there may be two modes."""

N_POINTS, HEAVY = (128, 256), 5.0
"""Points that the posterior is integrated over, first roughly, and degrees of freedom of their t-distribution."""

OLD = 0.1
"""Share of the spread of points that stays as it was where they are laid out anew: few points may bear all weight."""

LIGHT = 1e-6
"""Weight of a point below which it adds nothing to the covariance."""

INTERVAL = 0.95


@dataclass(frozen=True)
class Corrections:
    """What the data say of the corrections in tolerances.

    Attributes:
        information: G, shape (n, n).
        preferred: g, shape (n,).
        group: Number of the group of each, shape (n,).
    """

    information: Floats
    preferred: Floats
    group: Integers

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return int(self.group.max(initial=-1)) + 1

    @cached_property
    def guess(self) -> Floats:
        """Information on the logarithms of the scales before any data, shape (n_groups, n_groups)."""
        n = self.n_groups
        return np.linalg.inv(TOGETHER**2 * np.ones((n, n)) + APART**2 * np.eye(n)).astype(np.float64)


@dataclass(frozen=True)
class Posterior:
    """What is known of the scales.

    Attributes:
        corrections: What it follows from.
        theta: Mean of the logarithms, shape (n_groups,).
        points: Logarithms at the points that it is integrated over, shape (n_points, n_groups).
        weights: Of these, shape (n_points,).
    """

    corrections: Corrections
    theta: Floats
    points: Floats
    weights: Floats

    @property
    def interval(self) -> tuple[Floats, Floats]:
        """Lower and upper ends of the intervals of the logarithms, shape (n_groups,) each."""
        ends = []
        for column in self.points.T:
            order = np.argsort(column)
            share = np.cumsum(self.weights[order]) - 0.5 * self.weights[order]
            ends.append(np.interp([0.5 - INTERVAL / 2.0, 0.5 + INTERVAL / 2.0], share, column[order]))
        low, high = np.array(ends).T
        return low, high

    @property
    def seen(self) -> Floats:
        """How many corrections of each group the data tell of, shape (n_groups,)."""
        return _Point(self.corrections, self.theta).seen

    @property
    def unsure(self) -> Floats:
        """What not knowing the scales adds to the covariance of the corrections, shape (n, n)."""
        best = _Point(self.corrections, self.theta)
        added = -best.covariance
        for k in np.flatnonzero(self.weights > LIGHT).tolist():
            point = _Point(self.corrections, self.points[k])
            away = point.estimate - best.estimate
            added += self.weights[k] * (point.covariance + np.outer(away, away))
        return added


def posterior_of(corrections: Corrections) -> Posterior:
    """What data say of the scales.

    Args:
        corrections: What they say of the corrections.
    """
    starts = (_climbed(_Point(corrections, np.full(corrections.n_groups, start))) for start in STARTS)
    mode = max(starts, key=lambda point: point.value)
    middle, spread = mode.theta, np.linalg.inv(-mode.derivatives()[2]).astype(np.float64)
    for n in N_POINTS:
        points, weights = _sampled(corrections, middle, spread, n)
        middle = weights @ points
        off = points - middle
        spread = (1.0 - OLD) * (weights * off.T) @ off + OLD * spread
    return Posterior(corrections, middle, points, weights)


def _sampled(corrections: Corrections, middle: Floats, spread: Floats, n: int) -> tuple[Floats, Floats]:
    """Points of a t-distribution about the middle, and their weights by the posterior, which sum to 1."""
    from scipy.stats import qmc  # here, for it takes as long to import as a small calibration

    k = corrections.n_groups
    uniform = np.clip(qmc.Sobol(k + 1, scramble=True, rng=0).random(n), 1e-9, 1.0 - 1e-9)
    stretch = np.sqrt(HEAVY / special.chdtri(HEAVY, uniform[:, k]))
    standard = stretch[:, None] * special.ndtri(uniform[:, :k])
    points = middle + standard @ np.linalg.cholesky(spread).T
    log_weights = _values(corrections, points)
    log_weights += 0.5 * (HEAVY + k) * np.log1p(np.sum(standard**2, axis=1) / HEAVY)
    weights = np.exp(log_weights - log_weights.max())
    return points, weights / weights.sum()


def _values(corrections: Corrections, thetas: Floats) -> Floats:
    """Logarithms of the posterior at many points at once, shape (m,)."""
    s = np.exp(thetas)[:, corrections.group]
    moments = np.eye(s.shape[1]) + s[:, :, None] * corrections.information * s[:, None, :]
    right = s * corrections.preferred
    fit = np.sum(right * np.linalg.solve(moments, right[..., None])[..., 0], axis=1)
    of_guess = np.sum((thetas @ corrections.guess) * thetas, axis=1)
    out: Floats = 0.5 * (fit - np.linalg.slogdet(moments)[1] - of_guess)
    return out


@dataclass(frozen=True)
class _Point:
    """The posterior at one theta.

    Attributes:
        corrections: What the data say.
        theta: Logarithms of the scales, shape (n_groups,).
    """

    corrections: Corrections
    theta: Floats

    @cached_property
    def s(self) -> Floats:
        """Scale of each correction, shape (n,)."""
        out: Floats = np.exp(self.theta)[self.corrections.group]
        return out

    @cached_property
    def moment(self) -> Floats:
        """M, shape (n, n)."""
        out: Floats = np.eye(len(self.s)) + self.s[:, None] * self.corrections.information * self.s
        return out

    @cached_property
    def inverse(self) -> Floats:
        """C, shape (n, n)."""
        return np.linalg.inv(self.moment).astype(np.float64)

    @cached_property
    def a(self) -> Floats:
        """Shape (n,)."""
        out: Floats = self.inverse @ (self.s * self.corrections.preferred)
        return out

    @cached_property
    def value(self) -> float:
        """Logarithm of the posterior."""
        return float(_values(self.corrections, self.theta[None])[0])

    @property
    def estimate(self) -> Floats:
        """Of the corrections, shape (n,)."""
        return self.s * self.a

    @property
    def covariance(self) -> Floats:
        """Of the corrections, shape (n, n)."""
        out: Floats = self.s[:, None] * self.inverse * self.s
        return out

    @property
    def seen(self) -> Floats:
        """How many corrections of each group the data tell of, shape (n_groups,)."""
        return self._sums(1.0 - np.diag(self.inverse))

    def derivatives(self) -> tuple[Floats, Floats, Floats]:
        """Gradient and Hessian of the logarithm of the posterior, and the Hessian's mean."""
        a, C, n = self.a, self.inverse, self.corrections.n_groups
        member = np.equal.outer(np.arange(n), self.corrections.group).astype(np.float64)
        square, of_guess = self._sums(a**2 + np.diag(C)), self.corrections.guess
        gradient = square - self._sums(np.ones(len(a))) - of_guess @ self.theta
        hessian = member @ (4.0 * a[:, None] * C * a + 2.0 * C**2) @ member.T - np.diag(2.0 * square) - of_guess
        mean = -2.0 * member @ (np.eye(len(a)) - C) ** 2 @ member.T - of_guess
        return gradient, hessian, mean

    def _sums(self, of_each: Floats) -> Floats:
        """Sums by group, shape (n_groups,)."""
        out: Floats = np.bincount(self.corrections.group, of_each, self.corrections.n_groups).astype(np.float64)
        return out


def _climbed(here: _Point) -> _Point:
    """Where the posterior is largest, from a start: Newton's steps, or Fisher's where it is not concave."""
    for _ in range(MOST_STEPS):
        gradient, hessian, mean = here.derivatives()
        concave = np.linalg.eigvalsh(hessian)[-1] < 0.0
        step = np.linalg.solve(-hessian if concave else -mean, gradient)
        step *= min(1.0, FARTHEST / max(float(np.abs(step).max(initial=0.0)), NEAR_MODE))
        if float(gradient @ step) < NEAR_MODE:
            break
        there = _Point(here.corrections, here.theta + step)
        while there.value < here.value and float(np.abs(step).max()) > NEAR_MODE:
            step *= 0.5
            there = _Point(here.corrections, here.theta + step)
        here = there
    return here
