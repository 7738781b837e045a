"""Corrections against tolerances: do data and priors contradict each other, and what became of what data leave open?

A prior says that a parameter is nominal give or take its tolerance T. With K the covariance of the estimate, the prior
residuals `z = (estimate - nominal) / T` of a model that holds have covariance `A = 1 - P K P^T`, P their derivatives: a
correction varies by sqrt(T^2 - sigma^2), for what the data do not know of it stays at nominal. (Where rows share
errors but are weighted as independent, with K the covariance they are weighted by and C that of the estimate,
`A = 1 - P (2 K - C) P^T`.)

`z^T z` is compared with its mean tr A as sums of squares are in `goodness`, and each z with its own sigma.

References:
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.analysis.covariance import Spread
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.solver import Solution

Floats = NDArray[np.float64]

ALARM = 0.001
"""Probability of calling any single correction of a model that holds too large."""

LEAST = 2.0
"""A correction below this many tolerances is never too large by itself: tolerances are guesses."""


@dataclass(frozen=True)
class PriorFit:
    """How corrections and tolerances agree.

    Attributes:
        names: The parameters with priors, shape (n,).
        z: Corrections over tolerances, shape (n,).
        sigma: 1 sigma of z by what the data say, in [0, 1], shape (n,).
        chi2: Sum of z^2.
        expected: Its mean, were the tolerances as stated.
        p_value: Probability of a sum as large; None where the data say nothing of what has a prior.
        beyond: Indices of single corrections that are too large, the worst first.
    """

    names: tuple[str, ...]
    z: Floats
    sigma: Floats
    chi2: float
    expected: float
    p_value: float | None
    beyond: tuple[int, ...]


def judge_priors(solution: Solution, spread: Spread) -> PriorFit | None:
    """Corrections against tolerances; None without priors.

    Args:
        solution: The solution.
        spread: Its covariance.
    """
    variables = solution.problem.variables
    z, P = prior_rows(variables, solution.parameters)
    if not len(z):
        return None
    owned = [variables.robot.parameters[i] for v in variables.items if v.kind != "frame" for i in v.parameters]
    names = tuple(p.name for p in owned if p.tolerance is not None)
    A = np.eye(len(z)) - P @ (2.0 * spread.tangent - spread.actual) @ P.T
    sigma = np.sqrt(np.maximum(np.diag(A), 0.0))
    chi2, expected, square = float(z @ z), float(np.trace(A)), float(np.sum(A * A))
    level = special.ndtri(0.5 + 0.5 * (1.0 - ALARM) ** (1.0 / len(z)))
    size = np.abs(z)
    beyond = np.flatnonzero((size > LEAST) & (size > level * sigma))
    nu = expected**2 / square if expected > 1e-9 else 0.0
    return PriorFit(
        names=names,
        z=z,
        sigma=sigma,
        chi2=chi2,
        expected=max(expected, 0.0),
        p_value=float(special.gammaincc(nu / 2.0, nu / 2.0 * chi2 / expected)) if nu else None,
        beyond=tuple(int(i) for i in beyond[np.argsort(-size[beyond] / np.maximum(sigma[beyond], 1e-3))]),
    )
