"""Corrections against tolerances: do data and priors contradict each other, and what became of what data leave open?

A prior says that a parameter is nominal give or take its tolerance T. With K the covariance of the estimate, the prior
residuals `z = (estimate - nominal) / T` of a model that holds have covariance `A = 1 - P K P^T`, P their derivatives: a
correction varies by sqrt(T^2 - sigma^2), for what the data do not know of it stays at nominal. (Where rows share
errors but are weighted as independent, with K the covariance they are weighted by and C that of the estimate,
`A = 1 - P (2 K - C) P^T`.)

Places of targets and anchors that are said to be somewhere give or take a tolerance have priors too, of three rows
each, and are judged with the parameters.

The sum `z^T z` is compared with its mean tr A as sums of squares are in `goodness`. Of each parameter or place, with
rows i of z and A, `z_i^T A_i^-1 z_i` is by how much chi-square falls without its prior. The one whose fall is the least
likely is taken first, and the others judged by what is left of z without its prior: what a wrong place bends takes no
blame.

References:
    Baarda (1968), A testing procedure for use in geodetic networks. Netherlands Geodetic Commission 2(5).
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

from fg_calib.arrays import Figure, Floats, FrozenArrays
from fg_calib.graph.factors import Variables, prior_rows, unknown_prior_rows
from fg_calib.graph.information import eliminated
from fg_calib.graph.solver import Solution
from fg_calib.statistics.covariance import Spread

ALARM = 0.001
"""Probability of calling any single correction of a model that holds too large."""

LEAST = 2.0
"""A correction below this many tolerances is never too large by itself: tolerances are guesses."""


LEAST_SIGMA = 1e-3
"""Sigma of z below which data do not say more of a correction: rounding, and priors that alone hold a direction."""


@dataclass(frozen=True)
class Beyond:
    """A correction that is too large for its tolerance.

    Attributes:
        name: The parameter; of a place its kind and name: `target t1`.
        z: Correction over tolerance; of a place the length of its three.
        sigma: 1 sigma of z by what the data say, in [0, 1]; of a place on each axis, the root of the mean square.
        is_place: Whether it is of a target or an anchor.
    """

    name: str
    z: float
    sigma: float
    is_place: bool


@dataclass(frozen=True)
class PriorFit(FrozenArrays):
    """How corrections and tolerances agree.

    Attributes:
        names: The parameter or place that each prior row is of, shape (n,).
        z: Corrections over tolerances, shape (n,).
        sigma: 1 sigma of z by what the data say, in [0, 1], shape (n,).
        chi2: Sum of z^2.
        expected: Its mean, were the tolerances as stated.
        p_value: Probability of a sum as large; None where the data say nothing of what has a prior.
        beyond: Single corrections that are too large, the least likely first.
    """

    names: tuple[str, ...]
    z: Floats
    sigma: Floats
    chi2: Figure
    expected: Figure
    p_value: float | None
    beyond: tuple[Beyond, ...]


def judge_priors(solution: Solution, spread: Spread) -> PriorFit | None:
    """Corrections against tolerances; None without priors.

    Args:
        solution: The solution.
        spread: Its covariance.
    """
    return _judged(*_corrections(solution, spread))


def judge_tolerances(variables: Variables, parameters: Floats, covariance: Floats) -> PriorFit | None:
    """The same of the robot's parameters alone.

    Args:
        variables: The variables.
        parameters: The estimate.
        covariance: Its covariance in the columns, shape (n_columns, n_columns).
    """
    names, z, P = _of_parameters(variables, parameters)
    return _judged(names, z, np.eye(len(z)) - P @ covariance @ P.T, 0)


def _judged(names: tuple[str, ...], z: Floats, A: Floats, n_places: int) -> PriorFit | None:
    if not len(z):
        return None
    chi2, expected, square = float(z @ z), float(np.trace(A)), float(np.sum(A * A))
    nu = expected**2 / square if expected > 1e-9 else 0.0
    return PriorFit(
        names=names,
        z=z,
        sigma=np.sqrt(np.maximum(np.diag(A), 0.0)),
        chi2=chi2,
        expected=max(expected, 0.0),
        p_value=float(special.gammaincc(nu / 2.0, nu / 2.0 * chi2 / expected)) if nu else None,
        beyond=tuple(_beyond(names, z, A, len(z) - n_places)),
    )


def _corrections(solution: Solution, spread: Spread) -> tuple[tuple[str, ...], Floats, Floats, int]:
    """What prior rows are of, z, its covariance A, and how many rows at their end are of places."""
    problem, variables = solution.problem, solution.problem.variables
    of_parameters, z, P = _of_parameters(variables, solution.parameters)
    names = list(of_parameters)
    z_places, P_places = unknown_prior_rows(variables, solution.parameters)
    own = np.zeros((len(z) + len(z_places), 0))
    if len(z_places):
        # The places' errors follow those of the core, and what is theirs alone comes on top.
        left, unknowns = eliminated(problem, solution.parameters, with_loss=True), problem.data.unknowns
        of_core, of_places = P_places[:, : variables.n_columns], P_places[:, variables.n_columns :]
        P = np.vstack([P, of_core + of_places @ left.follow])
        own = np.vstack([np.zeros((len(z), left.rank)), of_places @ left.inverse])
        for v in variables.nuisance:
            if v.prior is not None:
                item = unknowns.items[v.number]
                names += [f"{item.kind.name} {item.name}"] * len(v.prior[0])
    A = np.eye(len(own)) - P @ (2.0 * spread.tangent - spread.actual) @ P.T - own @ own.T
    return tuple(names), np.concatenate([z, z_places]), A, len(z_places)


def _of_parameters(variables: Variables, parameters: Floats) -> tuple[tuple[str, ...], Floats, Floats]:
    """What the robot's prior rows are of, z, and its derivatives, shape (n, n_columns)."""
    z, P = prior_rows(variables, parameters)
    owned = [variables.robot.parameters[i] for v in variables.items if v.kind != "frame" for i in v.parameters]
    return tuple(p.name for p in owned if p.tolerance is not None) if len(z) else (), z, P


_NO_CORRECTION = 1e50
"""Corrections in tolerances beyond which nothing is left but the rounding of a fit that went far astray."""


def _beyond(names: tuple[str, ...], z: Floats, A: Floats, n_parameters: int) -> Iterator[Beyond]:
    """Corrections that are too large, each without the priors of those before it."""
    left = {name: np.array([i for i, other in enumerate(names) if other == name]) for name in names}
    level = -np.expm1(np.log1p(-ALARM) / len(left))
    rest, C = z, A
    while left and np.abs(rest).max() < _NO_CORRECTION:
        found = []
        for name, rows in left.items():
            if np.linalg.norm(rest[rows]) > LEAST:
                values, V = np.linalg.eigh(C[np.ix_(rows, rows)])
                square = float(np.sum((V.T @ rest[rows]) ** 2 / np.maximum(values, LEAST_SIGMA**2)))
                found.append((float(special.gammaincc(len(rows) / 2.0, square / 2.0)), -square, name))
        if not found or min(found)[0] >= level:
            return
        name = min(found)[2]
        rows = left.pop(name)
        place = bool(rows[0] >= n_parameters)
        size = float(np.linalg.norm(z[rows])) if place else float(z[rows[0]])
        yield Beyond(name, size, float(np.sqrt(np.maximum(np.mean(np.diag(A)[rows]), 0.0))), place)
        values, V = np.linalg.eigh(C[np.ix_(rows, rows)])
        gain = C[:, rows] @ (V / np.maximum(values, LEAST_SIGMA**2)) @ V.T
        rest, C = rest - gain @ rest[rows], C - gain @ C[rows]
