"""How well the estimate is known: covariance, chi-square, residuals before and after, what the data determine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from fg_calib.covariance import Spread, spread_of
from fg_calib.factors import pose_of
from fg_calib.goodness import OUTLIER_WEIGHT, Goodness, judge_fit
from fg_calib.identifiability import Identifiability, identify
from fg_calib.observability import IdentifiabilityClass, Observability
from fg_calib.problem import PAIR_KINDS, Problem, eliminated_terms, lengths
from fg_calib.residual_table import ResidualTable, residual_table
from fg_calib.residuals import single_threaded_blas
from fg_calib.robot import Robot
from fg_calib.robust import effect
from fg_calib.solver import Solution
from fg_calib.whitening import KINK_SIGMAS

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

CONFIDENCE = 0.999
"""A reduced chi-square outside this interval of its distribution, and outside `FACTOR`, is not to be trusted."""

MOST_OUTLIERS = 0.5
"""Share of measurements beyond which they are not outliers but the majority."""

BENDING = 2.0
"""Bending of an angle by what the parameters may be off, in its sigma, beyond which its row is not linear enough."""

MANY_NEAR_KINKS = 0.1
"""Share of measured rows near a kink beyond which noise is large for the motions that were measured."""

FACTOR = 2.0
"""A reduced chi-square between 1 / FACTOR and FACTOR is good whatever its distribution: noise is never known better."""


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of the robot after calibration.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        nominal: Nominal value.
        estimate: Estimated value; nominal if it is fixed.
        sigma: 1 sigma; 0 if fixed; None where neither data nor prior determine it.
        prior_sigma: 1 sigma of its prior; None without one.
        identifiability: What the data alone say of it: `independent`, `relative`, `ineffective`; or `fixed`.
    """

    name: str
    unit: str
    nominal: float
    estimate: float
    sigma: float | None
    prior_sigma: float | None
    identifiability: IdentifiabilityClass | str

    @property
    def correction(self) -> float:
        """Estimate minus nominal; angles of a frame by the shorter way."""
        difference = self.estimate - self.nominal
        return (difference + np.pi) % (2 * np.pi) - np.pi if "." in self.name and self.unit == "rad" else difference


@dataclass(frozen=True)
class FrameEstimate:
    """The measurement frame world_T_base.

    Attributes:
        xyz: Translation, shape (3,), [m].
        quaternion_xyzw: Rotation, shape (4,).
        sigma: 1 sigma of a small motion of the frame in itself, rotation first, shape (6,), [rad] and [m]; nan where
            nothing determines it.
    """

    xyz: Floats
    quaternion_xyzw: Floats
    sigma: Floats


@dataclass(frozen=True)
class PointEstimate:
    """A physical point that a group of configurations touched.

    Attributes:
        name: The group's name.
        n: Train rows that touched it.
        xyz: base_p of the point, [m]; of a group without train rows the mean of the predicted tool points.
        sigma: 1 sigma along the base's axes, shape (3,), [m]; nan where it is not determined, or not estimated.
    """

    name: str
    n: int
    xyz: Floats
    sigma: Floats


@dataclass(frozen=True)
class Prediction:
    """A function of the parameters at the estimate.

    Attributes:
        value: Its value, shape (m,).
        sigma: 1 sigma, shape (m,); nan where the measurements do not determine it.
        covariance: Shape (m, m), nan in rows and columns of what is not determined.
    """

    value: Floats
    sigma: Floats
    covariance: Floats


@dataclass(frozen=True)
class Uncertainty:
    """What `assess` finds out about a solution.

    Attributes:
        names: Estimated parameters, in the order of the covariance.
        covariance: Of the estimated parameters, [m] and [rad]; nan in rows and columns of what nothing determines.
        parameters: Every parameter of the robot.
        frame: The measurement frame; None where it was not estimated.
        chi2: Sum of squared whitened residuals, priors included.
        dof: Residuals and priors, less the determined directions.
        expected_chi2: What chi-square is on average; not `dof` where rows that share errors count as independent.
        chi2_bounds: Interval of the reduced chi-square that is taken as good.
        p_value: Probability of a chi-square as large, were the noise as stated; None where that is not known.
        residuals: Every residual, before and after.
        goodness: Goodness of fit by kind, by row and by configuration.
        identifiability: What the data alone determine, at the nominal parameters.
        robot: The calibrated robot.
        spread: The covariance in the variables' tangent space, behind `predict`.
        findings: Why the result is not to be trusted; empty if it is.
        cautions: Where its sigmas may be somewhat too small although nothing speaks against it.
        points: The points that groups of configurations touched.
    """

    names: tuple[str, ...]
    covariance: Floats
    parameters: tuple[ParameterEstimate, ...]
    frame: FrameEstimate | None
    chi2: float
    dof: int
    expected_chi2: float
    chi2_bounds: tuple[float, float]
    p_value: float | None
    residuals: ResidualTable
    goodness: Goodness
    identifiability: Identifiability
    robot: Robot
    spread: Spread
    findings: tuple[str, ...]
    cautions: tuple[str, ...]
    points: tuple[PointEstimate, ...] = ()

    def predict(self, function: Callable[[Robot], ArrayLike]) -> Prediction:
        """Value and sigma of any function of the robot: a tool position, a distance, a sum of parameters.

        It may be determined although the parameters it depends on are not; where it is not, its sigma is nan.

        Args:
            function: From a robot to a number or an array; smooth, for it is differentiated by central differences.

        Note:
            Directions that were left out to fix the gauge (`keep`) count as known.
        """
        value = np.atleast_1d(np.asarray(function(self.robot), dtype=np.float64)).ravel()
        names = self.spread.names[: self.spread.n_robot_columns]
        nominal = self.robot.nominal
        G = np.empty((len(value), len(names)))
        for k, name in enumerate(names):
            step = np.zeros(len(nominal))
            step[self.robot.index(name)] = 1e-5
            up, down = (function(self.robot.with_values(nominal + h)) for h in (step, -step))
            G[:, k] = (np.ravel(np.asarray(up)) - np.ravel(np.asarray(down))) / 2e-5
        covariance = self.spread.covariance(G @ self.spread.named_derivative[: len(names)])
        return Prediction(value, np.sqrt(np.diag(covariance)), covariance)

    @property
    def observability(self) -> Observability:
        """Rank, classes and groups of `identifiability`."""
        return self.identifiability.observability

    @property
    def reduced_chi2(self) -> float | None:
        """Chi-square over its degrees of freedom; None without any."""
        return self.chi2 / self.dof if self.dof > 0 else None

    @property
    def trustworthy(self) -> bool:
        """Whether nothing speaks against the result."""
        return not self.findings


def assess(solution: Solution) -> Uncertainty:
    """Covariance, goodness of fit, residuals and identifiability of a solution.

    The covariance comes from a singular value decomposition of the whitened Jacobian of data and priors, its
    columns scaled, at the estimate. Directions that `determined` does not count are undetermined: a parameter with a
    share in one has unknown sigma (None, nan in the covariance). It is not rescaled by chi-square.

    Note:
        Away from the nominal parameters undetermined directions turn, by about as many radians as the angles were
        corrected, and get a small share of parameters that they did not have at nominal. Unknown is what has a share
        in one both at the nominal parameters and at the estimate; the others are known given that the undetermined
        directions are near nominal.
    """
    with single_threaded_blas():
        return _assess(solution)


def _assess(solution: Solution) -> Uncertainty:
    problem = solution.problem
    variables = problem.variables
    spread = spread_of(solution)
    whole = identify(problem.whole or problem, solution.before, "practical")
    covariance = spread.named()
    frame = None
    if variables.n_robot_columns < variables.n_columns:
        world_T_base = pose_of(solution.parameters[variables.frame_span])
        frame = FrameEstimate(
            xyz=world_T_base.translation(),
            quaternion_xyzw=Rotation.from_matrix(world_T_base.rotation().matrix()).as_quat(canonical=True),
            sigma=np.sqrt(np.diag(spread.covariance(np.eye(variables.n_columns))))[variables.n_robot_columns :],
        )
    chi2, n_rows, loss_factor = _weighted_chi2(solution)
    dof = n_rows + problem.n_priors - spread.rank - variables.n_without_prior
    expected = max(0.0, dof - spread.excess - (1.0 - loss_factor) * n_rows)
    independent = _independent_dof(problem, dof, spread.rank)
    bounds = chi2_bounds(dof, expected, independent)
    table = residual_table(solution)
    return Uncertainty(
        names=variables.names[: variables.n_robot_columns],
        covariance=covariance,
        parameters=_parameter_estimates(solution, np.sqrt(np.diag(covariance)), whole.observability),
        frame=frame,
        chi2=chi2,
        dof=dof,
        expected_chi2=expected,
        chi2_bounds=bounds,
        p_value=_p_value(solution, chi2, expected, independent),
        residuals=table,
        goodness=judge_fit(solution, spread, table),
        identifiability=whole,
        robot=problem.robot.with_values(solution.parameters[variables.robot_span]),
        spread=spread,
        findings=_findings(solution, chi2, dof, bounds),
        cautions=_cautions(problem),
        points=_point_estimates(solution, spread),
    )


def chi2_bounds(dof: int, expected: float | None = None, independent: int | None = None) -> tuple[float, float]:
    """Interval of the reduced chi-square taken as good: its central `CONFIDENCE`, widened to `FACTOR` either way.

    Args:
        dof: Degrees of freedom that chi-square is divided by.
        expected: Mean of chi-square; `dof` if None.
        independent: Degrees of freedom of the noise behind it; `dof` if None.
    """
    if dof <= 0:
        return 0.0, np.inf
    k = max(1, min(dof, independent or dof))
    ratio = 1.0 if expected is None else expected / dof
    low, high = (2.0 * special.gammaincinv(k / 2.0, p) / k for p in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return ratio * min(float(low), 1.0 / FACTOR), max(1.0, ratio) * max(float(high), FACTOR)


def _weighted_chi2(solution: Solution) -> tuple[float, int, float]:
    """Chi-square, the independent residuals in it, and what a robust loss makes of the mean of one of them.

    With a robust loss only measurements count that keep at least half their weight.
    """
    problem = solution.problem
    weights, chi2 = problem.adjustment.weights, 2.0 * solution.weighted_cost
    if weights is None:
        return chi2, problem.n_independent, 1.0
    e, height = lengths(problem, solution.parameters)
    outlier = weights < OUTLIER_WEIGHT
    chi2 -= float(np.sum(weights[outlier] * e[outlier] ** 2))
    share = float(np.mean(~outlier[height > 0]))
    of_loss = effect(problem.settings.loss, problem.height)
    return max(0.0, chi2), round(problem.n_independent * share), of_loss.chi2


def _p_value(solution: Solution, chi2: float, expected: float, independent: int) -> float | None:
    """Upper p-value of chi-square, scaled to its mean; None where weights or noise came from the residuals."""
    problem = solution.problem
    if (
        problem.adjustment.weights is not None
        or solution.estimated_noise is not None
        or expected <= 0.0
        or independent <= 0
    ):
        return None
    return float(special.gammaincc(independent / 2.0, chi2 / expected * independent / 2.0))


def _independent_dof(problem: Problem, dof: int, rank: int) -> int:
    """Degrees of freedom of the noise behind the residuals: pairs hold no more than the poses they come from."""
    if not problem.formed or problem.sharing.poses:
        return dof
    each = 3 * sum(PAIR_KINDS[problem.settings.model])
    return min(dof, each * (problem.n_configurations - 1) + problem.n_priors - rank)


def _parameter_estimates(
    solution: Solution, sigma: Floats, observability: Observability
) -> tuple[ParameterEstimate, ...]:
    problem = solution.problem
    classes = dict(zip(observability.names, observability.classes, strict=True))
    sigmas = dict(zip(problem.variables.names, sigma, strict=False))
    found = []
    for i, p in enumerate(problem.robot.parameters):
        s = sigmas.get(p.name, np.nan if p.name in classes else 0.0)  # nan: left out, but not known
        found.append(
            ParameterEstimate(
                name=p.name,
                unit=p.unit,
                nominal=p.nominal,
                estimate=float(solution.parameters[i]),
                sigma=float(s) if np.isfinite(s) else None,
                prior_sigma=p.tolerance if p.estimated and problem.settings.prior else None,
                identifiability=classes.get(p.name, "fixed"),
            )
        )
    return tuple(found)


def _cautions(problem: Problem) -> tuple[str, ...]:
    """Where the linear covariance may claim too much: near the kinks of angles and distances.

    Near 0 an angle is the length of a vector of which the row sees one component. The others, d across, bend it by
    d^2 / (2 angle); they are unknown to about what all rotation parameters together may be off.
    """
    pairs, judgement = problem.pairs, problem.judgement
    if pairs is None or judgement is None:
        return ()
    train, cautions = ~pairs.test, []
    across = 2.0 * sum(p.scale**2 for p in problem.estimated if p.unit == "rad")
    used = judgement.angle & train
    from_kink = np.minimum(pairs.angle[used], np.pi - pairs.angle[used])
    bent = int(np.sum(across / (2.0 * from_kink) > BENDING * problem.sigma[used, 1]))
    if bent:
        cautions.append(
            f"{bent} of {int(used.sum())} angles are so near 0 or half a turn that what the parameters may be off bends"
            " them by up to more than two sigma: sigmas of tilts may be 10 % too small"
        )
    near = sum(np.sum(mask & train) for reason, mask in judgement.reasons.items() if "near" in reason)
    rows = problem.n_residuals + int(near)
    if near > MANY_NEAR_KINKS * rows:
        cautions.append(
            f"{near} of {rows} rows lie within {KINK_SIGMAS:g} sigma of 0 or half a turn: the noise is large for these"
            " motions, and sigmas may be 10 % too small"
        )
    return tuple(cautions)


def _findings(solution: Solution, chi2: float, dof: int, bounds: tuple[float, float]) -> tuple[str, ...]:
    findings = []
    if not solution.converged:
        findings.append(solution.message)
    findings += _other_optima(solution)
    weights = solution.problem.adjustment.weights
    if weights is not None:
        _, height = lengths(solution.problem, solution.parameters)
        n, lost = int(np.sum(height > 0)), int(np.sum(weights[height > 0] < OUTLIER_WEIGHT))
        if lost > MOST_OUTLIERS * n:
            loss = solution.problem.settings.loss
            findings.append(
                f"loss {loss} takes {lost} of {n} measurements for outliers: more than it can tell from noise"
            )
    if dof > 0 and not bounds[0] <= chi2 / dof <= bounds[1]:
        high = chi2 / dof > 1.0
        cause = "noise stated too small, effects not modelled, or outliers" if high else "noise stated too large"
        findings.append(f"reduced chi-square {chi2 / dof:.3g} is outside [{bounds[0]:.2f}, {bounds[1]:.2f}]: {cause}")
    return tuple(findings)


def _other_optima(solution: Solution, most: int = 4) -> list[str]:
    """A line for each other optimum: the parameters that differ most, in their tolerances, with both corrections."""
    robot, found = solution.problem.robot, []
    for other in solution.others:
        apart = {p.name: abs(other[i] - solution.parameters[i]) / p.scale for i, p in enumerate(robot.parameters)}
        largest = max(apart.values())
        named = sorted((name for name in apart if apart[name] > 0.3 * largest), key=lambda name: -apart[name])[:most]
        words = []
        for i in map(robot.index, named):
            p = robot.parameters[i]
            factor, unit = (1e3, "mm") if p.unit == "m" else (180.0 / np.pi, "deg")
            here, there = (factor * (at[i] - p.nominal) for at in (solution.parameters, other))
            words.append(f"{p.name} {here:+.3g} or {there:+.3g} {unit}")
        found.append(f"a second optimum that the data cannot tell from this one: {', '.join(words)} from nominal")
    return found


def _point_estimates(solution: Solution, spread: Spread) -> tuple[PointEstimate, ...]:
    """Where the groups' points are; sigma from that of the core, which they follow, and from their own touches."""
    problem = solution.problem
    points, variables = problem.points, problem.variables
    if points is None:
        return ()
    xyz = points.means(variables.chain.at(solution.parameters), problem.trig)
    n = variables.n_without_prior  # the points come first among the nuisance variables
    xyz[points.estimated] = solution.parameters[variables.nuisance_span][:n].reshape(-1, 3)
    sigma = np.full_like(xyz, np.nan)
    left = eliminated_terms(problem, solution.parameters)
    variance = np.diag(spread.covariance(left.follow)) + np.sum(left.inverse**2, axis=1)
    sigma[points.estimated] = np.sqrt(variance[:n]).reshape(-1, 3)
    index = points.groups.index
    return tuple(
        PointEstimate(name, int(np.sum(points.train & (index == g))), xyz[g], sigma[g])
        for g, name in enumerate(points.groups.names)
    )


def marginals(solution: Solution) -> gtsam.Marginals:
    """GTSAM's own marginals at the solution, where it grants them.

    Raises:
        RuntimeError: GTSAM finds the system indeterminate, which it also does to correct ones (condition above 1e4).
    """
    return gtsam.Marginals(solution.problem.graph, solution.values)
