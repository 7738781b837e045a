r"""Priors: whether corrections contradict their prior sigmas.

A prior says that a parameter is nominal within a prior sigma T. With K the covariance of the estimate, the prior
residuals `z = (estimate - nominal) / T` of a model that holds have covariance `A = 1 - P K P^T`, P their derivatives: a
correction varies by sqrt(T^2 - sigma^2), for what the data do not determine of it stays at nominal. (Where rows share
errors but are weighted as independent, with K the covariance they are weighted by and C that of the estimate,
`A = 1 - P (2 K - C) P^T`.) Landmarks with priors have three rows each and are judged with the parameters.

The sum `z^T z` is compared with its mean tr A as sums of squares are in `goodness_of_fit`. Of each parameter or
landmark, with rows i of z and A, `z_i^T A_i^-1 z_i` is by how much chi-square falls without its prior. The one whose
fall is the least likely is taken first, and the others are judged by what is left of z without its prior.

References:
    Baarda (1968), A testing procedure for use in geodetic networks. Netherlands Geodetic Commission 2(5).
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
    MacKay (1992), Bayesian interpolation. Neural Computation 4(3): evidence, and number of well-determined parameters.
    Kass & Steffey (1989), Approximate Bayesian inference in conditionally independent hierarchical models. JASA 84.
    Gelman (2006), Prior distributions for variance parameters in hierarchical models. Bayesian Analysis 1(3).
"""

from collections.abc import Iterator

import numpy as np
from scipy import special

from fg_calib import graph
from fg_calib.inputs import Figure, Floats, FrozenArrays, Integers, Probability, Record
from fg_calib.robot import Parameter
from fg_calib.statistics.covariance import Spread

PRIOR_ALARM = 0.001
"""Probability of calling any single correction of a model that holds too large."""

MIN_CORRECTION = 2.0
"""A correction below this many prior sigmas is never too large by itself: these are guesses."""


MIN_SIGMA = 1e-3
"""Sigma of z below which data do not say more of a correction: rounding, and priors that alone hold a direction."""


class Beyond(Record):
    """A correction that is too large for its prior sigma.

    Attributes:
        name: The parameter; of a place its kind and name: `target t1`.
        z: Correction over prior sigma; of a place the length of its three.
        sigma: 1 sigma of z by what the data say, in [0, 1]; of a place on each axis, the root of the mean square.
        is_place: Whether it is of a target or an anchor.
    """

    name: str
    z: float
    sigma: float
    is_place: bool


class PriorFit(FrozenArrays):
    """How corrections and prior sigmas agree.

    Attributes:
        names: The parameter or place that each prior row is of, shape (n,).
        z: Corrections over prior sigmas, shape (n,).
        sigma: 1 sigma of z by what the data say, in [0, 1], shape (n,).
        chi2: Sum of z^2.
        expected: Its mean, were the prior sigmas right.
        p_value: Probability of a sum as large; None where the data say nothing of what has a prior.
        beyond: Single corrections that are too large, the least likely first.
    """

    names: tuple[str, ...]
    z: Floats
    sigma: Floats
    chi2: Figure
    expected: Figure
    p_value: Probability | None
    beyond: tuple[Beyond, ...]


def judge_priors(solution: graph.Solution, spread: Spread) -> PriorFit | None:
    """Judge corrections against prior sigmas; None without priors.

    Args:
        solution: The solution.
        spread: Its covariance.
    """
    names, z, A = _judged_rows(solution, spread)
    if not len(z):
        return None
    chi2, expected, square = float(z @ z), float(np.trace(A)), float(np.sum(A * A))
    nu = expected**2 / square if expected > 1e-9 else 0.0
    p_value = float(special.gammaincc(nu / 2.0, nu / 2.0 * chi2 / expected)) if nu else None
    beyond = tuple(_beyond(names, z, A, len(_prior_parameters(solution.problem.variables))))
    return PriorFit(names, z, np.sqrt(np.maximum(np.diag(A), 0.0)), chi2, max(expected, 0.0), p_value, beyond)


def _judged_rows(solution: graph.Solution, spread: Spread) -> tuple[tuple[str, ...], Floats, Floats]:
    """Names of prior rows, those of landmarks last; z, and its covariance A."""
    problem, variables = solution.problem, solution.problem.variables
    z, P = graph.prior_rows(variables, solution.parameters)
    names = [p.name for p in _prior_parameters(variables)]
    places = graph.unknown_prior_rows(variables, solution.parameters)
    z_places, P_places = (rows[variables.n_curves :] for rows in places)
    own = np.zeros((len(z) + len(z_places), 0))
    if len(z_places):
        # The places' errors follow those of the core, and what is theirs alone comes on top.
        left, unknowns = problem.linearize(solution.parameters, with_loss=True).left, problem.data.landmarks
        of_core, of_places = P_places[:, : variables.n_columns], P_places[:, variables.n_columns :]
        P = np.vstack([P, of_core + of_places @ left.follow])
        own = np.vstack([np.zeros((len(z), left.rank)), of_places @ left.inverse])
        for v in variables.nuisance:
            if v.prior is not None and v.kind != "curve":
                item = unknowns.items[v.number]
                names += [f"{item.kind.name} {item.name}"] * len(v.prior[0])
    A = np.eye(len(own)) - P @ (2.0 * spread.tangent - spread.actual) @ P.T - own @ own.T
    return tuple(names), np.concatenate([z, z_places]), A


MAX_CORRECTION = 1e50
"""Corrections in prior sigmas beyond which nothing is left but the rounding of a fit that went far astray."""


def _beyond(names: tuple[str, ...], z: Floats, A: Floats, n_parameters: int) -> Iterator[Beyond]:
    """Corrections that are too large, each without the priors of those before it."""
    left = {name: np.array([i for i, other in enumerate(names) if other == name]) for name in names}
    level = -np.expm1(np.log1p(-PRIOR_ALARM) / len(left))
    rest, C = z, A
    while left and np.abs(rest).max() < MAX_CORRECTION:
        found = []
        for name, rows in left.items():
            if np.linalg.norm(rest[rows]) > MIN_CORRECTION:
                square = float(rest[rows] @ _inverse(C, rows) @ rest[rows])
                found.append((float(special.chdtrc(len(rows), square)), -square, name))
        if not found or min(found)[0] >= level:
            return
        name = min(found)[2]
        rows = left.pop(name)
        place = bool(rows[0] >= n_parameters)
        size = float(np.linalg.norm(z[rows])) if place else float(z[rows[0]])
        yield Beyond(name, size, float(np.sqrt(np.maximum(np.mean(np.diag(A)[rows]), 0.0))), place)
        gain = C[:, rows] @ _inverse(C, rows)
        rest, C = rest - gain @ rest[rows], C - gain @ C[rows]


def _inverse(C: Floats, rows: Integers) -> Floats:
    """The inverse of a part of a covariance, whose variances are `MIN_SIGMA` squared at least."""
    values, V = np.linalg.eigh(C[np.ix_(rows, rows)])
    return (V / np.maximum(values, MIN_SIGMA**2)) @ V.T


def _prior_parameters(variables: graph.Variables) -> list[Parameter]:
    """The parameter of each row of `prior_rows`, in their order."""
    owned = [variables.robot.parameters[i] for v in variables.items if v.kind != "frame" for i in v.parameters]
    return [p for p in owned if p.tolerance is not None] if variables.priors else []
