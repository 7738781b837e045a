r"""Priors: whether corrections contradict their prior sigmas, and scales of these estimated from the corrections.

A prior says that a parameter is nominal within a prior sigma T. With K the covariance of the estimate, the prior
residuals `z = (estimate - nominal) / T` of a model that holds have covariance `A = 1 - P K P^T`, P their derivatives: a
correction varies by sqrt(T^2 - sigma^2), for what the data do not determine of it stays at nominal. (Where rows share
errors but are weighted as independent, with K the covariance they are weighted by and C that of the estimate,
`A = 1 - P (2 K - C) P^T`.) Landmarks with priors have three rows each and are judged with the parameters.

The sum `z^T z` is compared with its mean tr A as sums of squares are in `goodness_of_fit`. Of each parameter or
landmark, with rows i of z and A, `z_i^T A_i^-1 z_i` is by how much chi-square falls without its prior. The one whose
fall is the least likely is taken first, and the others are judged by what is left of z without its prior.

Scales of the prior sigmas are estimated from the corrections by empirical Bayes, iterated with the fit.

Nobody knows how far an arm is from its nominal model; the corrections of all its parameters together tell. With u the
corrections in units of the specified prior sigmas, the data say of them to first order an information matrix G and a
vector g: `-(u^T G u) / 2 + g^T u` is their log-likelihood. What has no prior, such as a measurement frame, is
eliminated. Where u has the variance s^2, s the scale of its group, W = diag(s), `M = 1 + W G W` and `a = M^-1 W g`,

    L(s) = (g^T W a - log det M) / 2

is the likelihood with u integrated out. The estimate is `u = W a`, its covariance W C W with C = M^-1. In theta = log s

    dL / dtheta_k           = sum over k of (a_i^2 + C_ii - 1)
    d2L / dtheta_k dtheta_l = 4 a_k^T C_kl a_l + 2 |C_kl|^2 - delta_kl 2 sum over k of (a_i^2 + C_ii)

`sum over k of (1 - C_ii)` is how many corrections of a group the data determine.

The scales have priors themselves: all may be off by a common factor, 1 sigma of which is 5 (`COMMON_SIGMA`), and each
group by another of 3 (`GROUP_SIGMA`). So a group that the data do not determine follows the others, and one of a single
correction that happens to be nil does not collapse. The posterior of theta is integrated along the axes of its
curvature at the mode (Laplace), one by one, for it is skew where few corrections are determined. The scale taken is the
mean. What unknown scales add to the covariance of the corrections is by the law of total variance, with the same
points: the mean of W C W, minus that at the mean scales, and the covariance of W a.

At each solution the scales are estimated, then everything is solved again with their prior sigmas, until no scale
moves: two or three rounds where the arm is nearly linear. In others they may oscillate, so steps back are shortened.

References:
    Baarda (1968), A testing procedure for use in geodetic networks. Netherlands Geodetic Commission 2(5).
    Satterthwaite (1946), An approximate distribution of estimates of variance components. Biometrics Bulletin 2(6).
    Sidak (1967), Rectangular confidence regions for the means of multivariate normal distributions. JASA 62(318).
    MacKay (1992), Bayesian interpolation. Neural Computation 4(3): evidence, and number of well-determined parameters.
    Kass & Steffey (1989), Approximate Bayesian inference in conditionally independent hierarchical models. JASA 84.
    Gelman (2006), Prior distributions for variance parameters in hierarchical models. Bayesian Analysis 1(3).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy import special

from fg_calib import graph, parallel
from fg_calib.inputs import Figure, Floats, FrozenArrays, Integers, Probability, Record, SharedScale
from fg_calib.robot import Parameter, Robot, tolerance_kind
from fg_calib.statistics.covariance import Spread
from fg_calib.statistics.variance_components import settle

SETTLED = 1e-3
"""Relative change of a scale below which it has settled: a hundredth of what it is known to at best."""

COMMON_SIGMA, GROUP_SIGMA = float(np.log(5.0)), float(np.log(3.0))
"""Prior sigma of the logarithm of a scale: of all together, and of each group."""

STARTS = (0.0, float(np.log(0.1)), float(np.log(10.0)))
"""Logarithms of all scales that ascents start from: where few corrections are determined there may be two modes."""

GRID = np.linspace(-6.0, 6.0, 25)
"""Points on an axis over which the posterior is integrated, in sigma."""

LEAST_CURVATURE = 1e-2
"""Information on the logarithm of a scale, at least: the guess alone holds more."""

GTOL = 1e-6
"""Largest slope of the logarithm of the posterior at a mode."""

QUANTILE = 1.959963984540054
"""Half width of the 95 % interval, in sigma."""


@parallel.single_threaded
def estimate_tolerances(
    problem: graph.Problem, solve_with: Callable[[graph.Problem], graph.Solution] = graph.solve
) -> graph.Solution:
    """Estimate the parameters and, with them, a scale on the prior sigmas of each group.

    Args:
        problem: The problem; its options say what shares a scale, its prior sigmas are where the scales start from.
        solve_with: Solver at given prior sigmas: `solve`, or `estimate_noise`.

    Returns:
        The solution with the prior sigmas it ends with, and their scales in its `estimated_tolerances`. It has not
        converged if the scales have not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    by, specified = problem.options.estimate_tolerance, problem.variables
    parameters = _prior_parameters(specified)
    if by is None or problem.evaluated or not parameters:
        return solve_with(problem)
    names = [_group_of(problem.robot, p, by) for p in parameters]
    groups = tuple(dict.fromkeys(names))
    group = np.array([groups.index(name) for name in names], dtype=np.int64)
    members = tuple(tuple(p.name for p, k in zip(parameters, group, strict=True) if k == j) for j in range(len(groups)))

    def refit(theta: Floats) -> tuple[graph.Solution, Floats, tuple[Floats, EstimatedScales, Floats]]:
        solution = solve_with(_with_scales(problem, by, dict(zip(groups, np.exp(theta).tolist(), strict=True))))
        corrections, follow = _corrections(solution, specified, np.exp(theta)[group], group)
        found = fit_scales(corrections)
        return solution, found.mean.theta - theta, (theta, found, follow)

    solution, (theta, found, follow) = settle(refit, len(groups), SETTLED, "tolerances")
    figures = (v.tolist() for v in (*np.exp([theta, *found.interval]), found.mean.determined))
    scales = tuple(graph.ToleranceScale(*of) for of in zip(groups, members, *figures, strict=True))
    added = follow @ found.added_covariance @ follow.T
    return replace(solution, estimated_tolerances=graph.ToleranceScales(scales, added))


class Corrections(Record):
    """Information of the data on the corrections in prior sigmas.

    Attributes:
        information: G, shape (n, n).
        preferred: g, shape (n,).
        group: Number of the group of each, shape (n,).
    """

    information: Floats
    preferred: Floats
    group: Integers


class ScalePosterior:
    """The corrections at given scales, and the posterior of these.

    Args:
        corrections: Information of the data on the corrections.
        theta: Logarithms of the scales, shape (n_groups,).

    Attributes:
        value: Logarithm of the posterior density.
        estimate: Of the corrections, shape (n,).
        covariance: Of the corrections, shape (n, n).
        determined: How many corrections of each group the data determine, shape (n_groups,).
        gradient: Of the logarithm of the posterior, shape (n_groups,).
        hessian: Second derivative of it, shape (n_groups, n_groups).
    """

    def __init__(self, corrections: Corrections, theta: Floats) -> None:
        self.theta, n = theta, len(theta)
        member = np.equal.outer(np.arange(n), corrections.group).astype(np.float64)  # 1 for those of a group
        prior = np.linalg.inv(COMMON_SIGMA**2 * np.ones((n, n)) + GROUP_SIGMA**2 * np.eye(n))
        s = np.exp(theta) @ member
        M = np.eye(len(s)) + s[:, None] * corrections.information * s
        C = np.linalg.inv(M)
        right = s * corrections.preferred
        a = C @ right
        self.value = float(0.5 * (right @ a - np.linalg.slogdet(M)[1] - theta @ prior @ theta))
        self.estimate: Floats = s * a
        self.covariance: Floats = s[:, None] * C * s
        self.determined: Floats = member @ (1.0 - np.diag(C))
        square = member @ (a**2 + np.diag(C))
        self.gradient: Floats = square - member.sum(axis=1) - prior @ theta
        both = member @ (4.0 * a[:, None] * C * a + 2.0 * C**2) @ member.T
        self.hessian: Floats = both - np.diag(2.0 * square) - prior


class EstimatedScales(Record):
    """The posterior of the scales.

    Attributes:
        mean: The corrections at the mean of the logarithms.
        sigma: 1 sigma of the logarithms, shape (n_groups,).
        added_covariance: Added covariance of the corrections by unknown scales, shape (n, n).
    """

    mean: ScalePosterior
    sigma: Floats
    added_covariance: Floats

    @property
    def interval(self) -> tuple[Floats, Floats]:
        """Lower and upper ends of the 95 % intervals of the logarithms, shape (n_groups,) each."""
        half = QUANTILE * self.sigma
        return self.mean.theta - half, self.mean.theta + half


def fit_scales(corrections: Corrections) -> EstimatedScales:
    """The posterior of the scales, about its highest mode.

    Args:
        corrections: Information of the data on the corrections.
    """

    def cost(theta: Floats) -> tuple[float, Floats]:
        at = ScalePosterior(corrections, theta)
        return -at.value, -at.gradient

    n = int(corrections.group.max(initial=-1)) + 1
    from scipy.optimize import minimize  # here, for it takes as long to import as a small calibration

    modes = (minimize(cost, np.full(n, start), jac=True, method="BFGS", options={"gtol": GTOL}).x for start in STARTS)
    mode = max((ScalePosterior(corrections, theta) for theta in modes), key=lambda at: at.value)
    theta, variance, added = mode.theta, np.zeros(n), mode.covariance
    curvature, V = np.linalg.eigh(-mode.hessian)
    for axis in np.linalg.cholesky((V / np.maximum(curvature, LEAST_CURVATURE)) @ V.T).T:
        points = [ScalePosterior(corrections, mode.theta + t * axis) for t in GRID]
        density: Floats = np.exp([point.value - mode.value for point in points])
        w = density / density.sum()
        mean = float(GRID @ w)
        theta, variance = theta + mean * axis, variance + axis**2 * ((GRID - mean) ** 2 @ w)
        estimates, covariance = np.array([point.estimate for point in points]), np.array([p.covariance for p in points])
        away = estimates - w @ estimates
        added = added + np.tensordot(w, covariance, 1) - mode.covariance + (w * away.T) @ away
    at_mean = ScalePosterior(corrections, theta)
    return EstimatedScales(at_mean, np.sqrt(variance), added - at_mean.covariance)


def _corrections(
    solution: graph.Solution, specified: graph.Variables, scale: Floats, group: Integers
) -> tuple[Corrections, Floats]:
    """Information of the data on the corrections in specified prior sigmas, to first order at a solution.

    At the optimum the data pull as hard one way as the priors do the other, so that `g = (G + 1 / scale^2) u`. Where
    rows share errors but count as independent, g varies by H = G + (what they share) instead of by G: then the data
    say `G H^-1 G` and `G H^-1 g`.

    Args:
        solution: The solution.
        specified: The variables with the specified prior sigmas.
        scale: Scale of each correction's prior sigma in the solution, shape (n,).
        group: Number of each one's group, shape (n,).

    Returns:
        The corrections, and how the columns follow them, shape (n_columns, n).
    """
    problem, at = solution.problem, solution.parameters
    by = specified.prior_scales
    u, P = graph.prior_rows(specified, at)
    U, s, Vt = np.linalg.svd(P * by)
    back, rest = by[:, None] * (Vt[: len(s)].T / s) @ U.T, by[:, None] * Vt[len(s) :].T
    J = problem.linearize(at).left.A
    left = graph.eliminate(np.hstack([J @ back, J @ rest]), np.zeros(len(J)), len(u))
    follow = back + rest @ left.follow
    G = left.A.T @ left.A
    g = G @ u + u / scale**2
    added = graph.correlation(problem, at)
    if added is not None:
        values, V = np.linalg.eigh(G + follow.T @ added @ follow)
        kept = values > graph.RANK_TOLERANCE * values.max(initial=0.0)
        gain = G @ (V[:, kept] / values[kept]) @ V[:, kept].T
        G, g = gain @ G, gain @ g
    return Corrections(G, g, group), follow


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


def _group_of(robot: Robot, parameter: Parameter, by: SharedScale) -> str:
    owner = ("base", *(joint.name for joint in robot.joints), "tool")[parameter.owner]
    return owner if by == "joint" else tolerance_kind(parameter) or f"{owner} angles"


def _with_scales(problem: graph.Problem, by: SharedScale, scales: Mapping[str, float]) -> graph.Problem:
    """The problem from its start, with the tolerances of each group multiplied, those of fixed parameters too.

    Args:
        problem: The problem.
        by: Grouping of parameters that share a scale.
        scales: Factor on the tolerances of each group.
    """
    factors = [scales.get(_group_of(problem.robot, p, by), 1.0) for p in problem.robot.parameters]
    each = zip(problem.robot.parameters, factors, strict=True)
    parameters = tuple(p if p.tolerance is None else replace(p, tolerance=p.tolerance * f) for p, f in each)
    robot = replace(problem.robot, parameters=parameters)
    return graph.with_factors(problem, problem.start, robot=robot, variables=replace(problem.variables, robot=robot))
