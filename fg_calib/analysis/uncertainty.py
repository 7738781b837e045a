"""How well the estimate is known: covariance, chi-square, residuals before and after, what the data determine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from fg_calib.analysis.accuracy import ExpectedError, expected_error, without_rigid_motion
from fg_calib.analysis.conventions import MissingMotion
from fg_calib.analysis.corrections import PriorFit, judge_priors
from fg_calib.analysis.covariance import Spread, spread_of, with_left_out
from fg_calib.analysis.goodness import OUTLIER_WEIGHT, Goodness, judge_fit
from fg_calib.analysis.identifiability import Identifiability, identifiability_of
from fg_calib.analysis.joint_values import JointValues, joint_values
from fg_calib.analysis.mistakes import SetupCheck, check_problem
from fg_calib.analysis.residual_table import ResidualTable, residual_table
from fg_calib.analysis.structure import probability_of_noise
from fg_calib.analysis.verdict import (
    Statement,
    chi2_bounds,
    of_bent,
    of_chi2,
    of_estimated_noise,
    of_evaluation,
    of_folds,
    of_priors,
    of_test,
)
from fg_calib.arrays import FrozenArrays
from fg_calib.graph.extension import check_graph
from fg_calib.graph.factors import corrections_of, pose_of
from fg_calib.graph.information import eliminated
from fg_calib.graph.noise import PairNoise
from fg_calib.graph.observability import IdentifiabilityClass, Observability
from fg_calib.graph.problem import Problem, at_parameters, mahalanobis_distances, noises_at
from fg_calib.graph.robust import effect
from fg_calib.graph.solver import Solution
from fg_calib.robot.model import Robot
from fg_calib.threads import one_blas_thread, single_threaded

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

MOST_OUTLIERS = 0.5
"""Share of measurements beyond which they are not outliers but the majority."""

BENT = 1.0
"""Sigma by which what the parameters may still be off bends a row that is not linear enough."""

MOST_ESTIMATED = 2.0
"""Noise seen over noise stated above which it is more likely that something is not modelled."""

_WITH_FIGURES = ("distance", "angle", "orientation", "position")
"""Kinds of noise whose motions are seen in what was measured."""

LIKE_NOISE = 1e-3
"""Probability below which residuals follow the arm more than noise does."""


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of the robot after calibration.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        nominal: Nominal value.
        estimate: Estimated value; nominal if it is fixed.
        correction: Estimate minus nominal; angles of a frame by the shorter way (see `factors.corrections_of`).
        sigma: 1 sigma of estimate minus true; 0 if fixed; None where neither data nor tolerances tell. Of a parameter
            that was left out to fix the gauge its tolerance.
        prior_sigma: 1 sigma of its prior; None without one.
        identifiability: What the data alone say of it: `independent`, `relative`, `ineffective`; or `fixed`.
        stands_for: Of a relative parameter that was kept where others were left out to fix the gauge: the combination
            that it was estimated for, factors by name; else None.
        sigma_of_combination: 1 sigma of the estimate as one of that combination; None where it stands for itself.
    """

    name: str
    unit: str
    nominal: float
    estimate: float
    correction: float
    sigma: float | None
    prior_sigma: float | None
    identifiability: IdentifiabilityClass | str
    stands_for: dict[str, float] | None = None
    sigma_of_combination: float | None = None


@dataclass(frozen=True)
class FrameEstimate(FrozenArrays):
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
class PointEstimate(FrozenArrays):
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
class Uncertainty(FrozenArrays):
    """What `assess` finds out about a solution.

    Attributes:
        names: The parameters to be estimated, those left out to fix the gauge among them, in the covariance's order.
        covariance: Of their errors, [m] and [rad]; nan in rows and columns of what nothing determines. What was left
            out counts with its tolerance.
        parameters: Every parameter of the robot.
        frame: The measurement frame; None where it was not estimated.
        chi2: Sum of squared whitened residuals, priors included.
        dof: Residuals and priors, less the determined directions.
        expected_chi2: What chi-square is on average; not `dof` where rows that share errors count as independent.
        chi2_bounds: Interval of the reduced chi-square that is taken as good.
        p_value: Probability of a chi-square as large, were the noise as stated; None where that is not known.
        residuals: Every residual, before and after.
        goodness: Goodness of fit by kind, by row and by configuration.
        priors: Corrections against tolerances; None without priors.
        expected_error: Of the tool, by the covariance; None where the arm was evaluated as it is.
        identifiability: What the data alone determine, at the nominal parameters.
        robot: The calibrated robot.
        spread: The covariance in the tangent space of the variables that were estimated, the others taken as known.
        whole: The same of all parameters, those left out to fix the gauge among them, behind `predict`.
        findings: Why the result is not to be trusted; empty if it is.
        cautions: What its reader should know although nothing speaks against it, such as sigmas somewhat too small.
        frames: Every measurement frame that was estimated, table by table.
        points: The points that groups of configurations touched, and other unknowns of the measurements.
        setup: What residuals before the calibration say of its set-up.
        noise_like: Probability that noise alone follows the arm as much as the residuals do; None where that was not
            asked, because they are as small as stated, or cannot be told.
        joint_values: Estimated joint values beside their readings; None where these were not estimated.
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
    priors: PriorFit | None
    expected_error: ExpectedError | None
    identifiability: Identifiability
    robot: Robot
    spread: Spread
    whole: Spread
    findings: tuple[str, ...]
    cautions: tuple[str, ...]
    frames: tuple[FrameEstimate, ...] = ()
    points: tuple[PointEstimate, ...] = ()
    setup: SetupCheck = field(default_factory=SetupCheck)
    noise_like: float | None = None
    joint_values: JointValues | None = None

    def __repr__(self) -> str:
        known = sum(p.sigma is not None for p in self.parameters if p.identifiability != "fixed")
        lines = [
            f"Uncertainty of {self.robot.name!r}: {known} of {len(self.names)} parameters have a known sigma",
            f"  chi-square {self.chi2:.6g}, {self.dof} degrees of freedom",
            *(f"  DOUBTFUL: {finding}" for finding in self.findings[:6]),
        ]
        return "\n".join(line if len(line) <= 100 else f"{line[:96]} ..." for line in lines)

    @single_threaded
    def predict(self, function: Callable[[Robot], ArrayLike], *, fitted: bool = False) -> Prediction:
        """Value and sigma of any function of the robot: a tool position, a distance, a sum of parameters.

        It may be determined although the parameters it depends on are not; where it is not, its sigma is nan.

        Args:
            function: From a robot to a number or an array; smooth, for it is differentiated by central differences.
            fitted: Whether sigmas are those of points after the rotation and shift that bring them nearest to the true
                ones, which the base has no part in; the function's values are points, shape (n, 3).

        Note:
            Parameters that were left out to fix the gauge (`keep`) count with their tolerance: what depends on one
            without is unknown.
        """
        value = np.atleast_1d(np.asarray(function(self.robot), dtype=np.float64)).ravel()
        G = self.whole.derivative(function)
        if fitted:
            points = value.reshape(-1, 3)
            G = without_rigid_motion(points, G.reshape(*points.shape, -1))[0].reshape(G.shape)
        covariance = self.whole.covariance(G)
        return Prediction(value, np.sqrt(np.diag(covariance)), covariance)

    @property
    def observability(self) -> Observability:
        """Rank, classes and groups of `identifiability`."""
        return self.identifiability.observability

    @property
    def noise_may_be_estimated(self) -> bool:
        """Whether the noise seen may be taken for the noise there is: a little larger than stated, and like noise."""
        too_large = [fit for fit in self.goodness.kinds if fit.verdict in ("too small", "both")]
        return (
            not self.residuals.evaluated
            and not self.setup.explanations
            and not any(fit.verdict in ("outliers", "both") for fit in self.goodness.kinds)  # they are not noise
            and not (too_large and self.identifiability.missing)
            and all(fit.typical <= MOST_ESTIMATED for fit in too_large)
            and (self.noise_like is None or self.noise_like > LIKE_NOISE)
        )

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

    Raises:
        ProblemError: The graph of the solution's problem has factors of somebody else.
    """
    check_graph(solution.problem)
    with one_blas_thread:
        return _assess(solution)


def _assess(solution: Solution) -> Uncertainty:
    problem = solution.problem
    variables = problem.variables
    spread = spread_of(solution)
    whole = with_left_out(solution, spread)
    identifiability = identifiability_of(problem.whole or problem, solution.before, "practical")
    covariance = whole.named()
    frames = _frame_estimates(solution, whole)
    chi2, n_rows, loss_factor = _weighted_chi2(solution)
    dof = n_rows + problem.n_priors + problem.n_added - spread.rank - eliminated(problem, solution.parameters).rank
    expected = max(0.0, dof - spread.excess - (1.0 - loss_factor) * n_rows)
    independent = _independent_dof(problem, dof, spread.rank)
    bounds = chi2_bounds(dof, expected, independent)
    p_value = _p_value(solution, chi2, expected, independent)
    table = residual_table(solution)
    goodness, priors = judge_fit(solution, spread, table), judge_priors(solution, spread)
    evaluated = problem.evaluated
    statements = [
        *_of_solver(solution),
        *of_chi2(chi2, dof, expected, bounds, p_value, evaluated),
        *of_evaluation(evaluated, solution.estimated_noise is not None),
        *of_test(goodness.test, chi2 / expected if expected > 0.0 else 1.0, problem.end_names),
        *of_priors(priors),
        *_of_bent_rows(solution, spread, table, goodness),
        *_of_noise(solution, table, goodness),
    ]
    doubts = tuple(s.text for s in statements if s.finding)
    too_large = {fit.verdict for fit in goodness.kinds} & {"too small", "both"}
    asked = not evaluated and (too_large or (identifiability.missing and solution.estimated_noise))
    noise_like = probability_of_noise(solution) if asked else None
    follow = noise_like is not None and noise_like < LIKE_NOISE
    estimated = max((fit.factor for fit in goodness.kinds), default=1.0) > MOST_ESTIMATED
    setup = SetupCheck()
    if not evaluated:
        setup = check_problem(problem, solution.before, doubtful=bool(doubts) or estimated)
    fits = not doubts and solution.estimated_noise is None
    findings, cautions = _of_model(setup, identifiability.missing, fits=fits, high=chi2 > bounds[1] * dof or follow)
    return Uncertainty(
        names=whole.variables.names[: whole.variables.n_robot_columns],
        covariance=covariance,
        parameters=_parameter_estimates(solution, np.sqrt(np.diag(covariance)), spread, identifiability.observability),
        frame=frames[0] if frames else None,
        frames=frames,
        chi2=chi2,
        dof=dof,
        expected_chi2=expected,
        chi2_bounds=bounds,
        p_value=p_value,
        residuals=table,
        goodness=goodness,
        priors=priors,
        expected_error=None if evaluated else expected_error(solution, whole),
        identifiability=identifiability,
        robot=problem.robot.with_values(solution.parameters[variables.robot_span]),
        spread=spread,
        whole=whole,
        findings=(*findings, *doubts),
        cautions=(*cautions, *(s.text for s in statements if not s.finding)),
        points=_point_estimates(solution, whole),
        joint_values=joint_values(solution, spread),
        setup=setup,
        noise_like=noise_like,
    )


def _weighted_chi2(solution: Solution) -> tuple[float, int, float]:
    """Chi-square, the independent residuals in it, and what a robust loss makes of the mean of one of them.

    With a robust loss only measurements count that keep at least half their weight.
    """
    problem = solution.problem
    weights, chi2 = problem.state.weights, 2.0 * solution.weighted_cost
    if weights is None:
        return chi2, problem.n_independent, 1.0
    n_rows = n_kept = expected = 0.0
    distances = mahalanobis_distances(problem, solution.parameters)
    for series, w, (e, residual_dim) in zip(problem.data.series, weights, distances, strict=True):
        train, outlier = (residual_dim > 0) & ~series.test, w < OUTLIER_WEIGHT
        chi2 -= float(np.sum(w[train & outlier] * e[train & outlier] ** 2))
        kept = float(residual_dim[train & ~outlier].sum())
        n_rows, n_kept = n_rows + float(residual_dim[train].sum()), n_kept + kept
        expected += kept * effect(problem.options.loss, int(residual_dim.max(initial=1))).chi2
    of_loss = expected / n_kept if n_kept else 1.0
    return max(0.0, chi2), round(problem.n_independent * n_kept / max(n_rows, 1.0)), of_loss


def _p_value(solution: Solution, chi2: float, expected: float, independent: int) -> float | None:
    """Upper p-value of chi-square, scaled to its mean; None where weights or noise came from the residuals."""
    problem = solution.problem
    if problem.state.weights is not None or solution.estimated_noise is not None or expected <= 0.0 or independent <= 0:
        return None
    return float(special.gammaincc(independent / 2.0, chi2 / expected * independent / 2.0))


def _independent_dof(problem: Problem, dof: int, rank: int) -> int:
    """Degrees of freedom of the noise behind the residuals: pairs hold no more than the poses they come from."""
    if not (problem.formed and problem.missing_correlation) or len(problem.data.series) > 1:
        return dof
    each = 3 * problem.data.series[0].kind.residual_dim
    return min(dof, each * (problem.n_configurations - 1) + problem.n_priors - rank)


def _frame_estimates(solution: Solution, whole: Spread) -> tuple[FrameEstimate, ...]:
    """Every measurement frame that was estimated."""
    found = []
    for k, v in enumerate(solution.problem.variables.frames):
        world_T_base = pose_of(solution.parameters[list(v.parameters)])
        first = whole.variables.n_robot_columns + 6 * k
        found.append(
            FrameEstimate(
                xyz=world_T_base.translation(),
                quaternion_xyzw=Rotation.from_matrix(world_T_base.rotation().matrix()).as_quat(canonical=True),
                sigma=np.sqrt(np.diag(whole.covariance(np.eye(len(whole.tangent))[first : first + 6]))),
            )
        )
    return tuple(found)


def _parameter_estimates(
    solution: Solution, sigma: Floats, spread: Spread, observability: Observability
) -> tuple[ParameterEstimate, ...]:
    """Every parameter of the robot.

    Args:
        solution: The solution.
        sigma: 1 sigma of the parameters of `observability`.
        spread: The covariance of what was estimated.
        observability: What the data alone determine.
    """
    problem, estimated = solution.problem, spread.variables.names
    classes = dict(zip(observability.names, observability.classes, strict=True))
    sigmas = dict(zip(observability.names, sigma, strict=True))
    combinations: dict[str, dict[str, float]] = {}
    for group in observability.relative if problem.whole is not None else ():
        combinations |= group.combinations([name for name in group.parameters if name in estimated])
    of_combinations = dict(zip(estimated, np.sqrt(np.diag(spread.named())), strict=False)) if combinations else {}
    corrections = corrections_of(problem.robot, solution.parameters[problem.variables.robot_span])
    found = []
    for i, p in enumerate(problem.robot.parameters):
        found.append(
            ParameterEstimate(
                name=p.name,
                unit=p.unit,
                nominal=p.nominal,
                estimate=float(solution.parameters[i]),
                correction=float(corrections[i]),
                sigma=_known(sigmas.get(p.name, 0.0)),
                prior_sigma=p.tolerance if p.estimated and problem.options.has_priors else None,
                identifiability=classes.get(p.name, "fixed"),
                stands_for=combinations.get(p.name),
                sigma_of_combination=_known(of_combinations[p.name]) if p.name in combinations else None,
            )
        )
    return tuple(found)


def _known(sigma: float) -> float | None:
    return float(sigma) if np.isfinite(sigma) else None


def _of_bent_rows(solution: Solution, spread: Spread, table: ResidualTable, goodness: Goodness) -> list[Statement]:
    """Whether the result rests on lengths and angles that are far from linear in what is still unknown."""
    values, V = np.linalg.eigh(spread.tangent)
    half, scales = V * np.sqrt(np.maximum(values, 0.0)), np.diag(solution.problem.variables.prior_scales)
    noises = noises_at(solution.problem, solution.parameters, at_readings=True)
    leverage = np.nan_to_num(goodness.leverage)
    bent, folded, lengths = (np.zeros(table.n, dtype=np.bool_) for _ in range(3))
    for number, noise in enumerate(noises):
        if isinstance(noise, PairNoise):
            rows = np.flatnonzero(table.used & (table.series == number))
            place = (table.measurement[rows], table.row[rows])
            lengths[rows] = True
            bent[rows], folded[rows] = noise.bent_by(half, BENT)[place], noise.may_fold(scales)[place]
    if not lengths.any():
        return []
    n_rows = int(lengths.sum())
    share = float(leverage[folded].sum() / max(leverage[table.used].sum(), 1e-300))
    return [
        *of_bent(int(bent.sum()), n_rows, float(leverage[bent].sum())),
        *of_folds(int(folded.sum()), n_rows, share),
    ]


def _of_noise(solution: Solution, table: ResidualTable, goodness: Goodness) -> list[Statement]:
    """Whether noise that was estimated is small beside the motions it was estimated of."""
    found: list[Statement] = []
    for fit in goodness.kinds:
        if (fit.table, fit.kind) in (solution.estimated_noise or ()) and fit.kind in _WITH_FIGURES:
            rows = table.used & (table.group == table.groups.index((fit.table, fit.kind)))
            predicted = (table.measured + table.after)[rows]
            about = 0.0 if fit.kind in ("distance", "angle") else float(np.mean(predicted))
            motion = 1.0 if fit.kind == "orientation" else float(np.sqrt(np.mean((predicted - about) ** 2)))
            found += of_estimated_noise(fit.kind, fit.factor * fit.stated_sigma_rms, max(motion, 1e-300))
    return found


def _of_solver(solution: Solution) -> list[Statement]:
    """Whether it arrived, and whether a robust loss left enough."""
    statements = []
    if not solution.converged:
        statements.append(Statement(solution.message, finding=True))
    statements += [Statement(text, finding=True) for text in _other_optima(solution)]
    weights, series = solution.problem.state.weights, solution.problem.data.series
    if weights is not None:
        n = sum(len(s.train) for s in series)
        lost = sum(int(np.sum(w[s.train] < OUTLIER_WEIGHT)) for s, w in zip(series, weights, strict=True))
        if lost > MOST_OUTLIERS * n:
            loss = solution.problem.options.loss
            text = f"loss {loss} takes {lost} of {n} measurements for outliers: more than it can tell from noise"
            statements.append(Statement(text, finding=True))
    return statements


def _of_model(
    setup: SetupCheck, missing: Sequence[MissingMotion], *, fits: bool, high: bool
) -> tuple[list[str], list[str]]:
    """Findings and cautions that come before all others: the set-up or the model is wrong, so no figure can be right.

    Args:
        setup: What residuals before the calibration say of the set-up.
        missing: What the robot's convention has no parameter for.
        fits: Whether nothing speaks against the calibration although the noise was as stated.
        high: Whether the residuals are larger than the noise, or follow the arm.
    """
    findings: list[str] = []
    cautions: list[str] = []
    if setup.explanations:
        (cautions if fits else findings).append(str(setup))
    elif setup.far and high:
        findings.append(str(setup))
    for motion in missing:
        (findings if high and not setup.explanations else cautions).append(str(motion))
    return findings, cautions


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
    """Where touched points and other unknowns are; sigma from the core, which they follow, and from their own rows.

    Args:
        solution: The solution.
        spread: The covariance of all parameters.
    """
    problem = solution.problem
    data, unknowns = problem.data, problem.data.unknowns
    if not unknowns.names:
        return ()
    at = at_parameters(problem, solution.parameters)
    left = eliminated(replace(problem, variables=spread.variables), solution.parameters)
    variance = np.diag(spread.covariance(left.follow)) + np.sum(left.inverse**2, axis=1)
    variance[left.unknown] = np.nan
    columns = at.columns - problem.variables.n_columns
    sigma = np.where(columns >= 0, np.sqrt(np.append(variance, np.nan))[np.maximum(columns, -1)], np.nan)
    counts = np.zeros(len(unknowns.names), dtype=np.int64)
    for s in data.series:
        if s.kind.ends and s.kind.n_nuisances:
            counts += np.bincount(unknowns.owners[s.nuisances[s.train][:, 0]], minlength=len(counts))
    ends = np.cumsum(unknowns.sizes)[:-1]
    values, sigmas = np.split(at.coordinates, ends), np.split(sigma, ends)
    return tuple(map(PointEstimate, unknowns.names, counts.tolist(), values, sigmas))


def marginals(solution: Solution) -> gtsam.Marginals:
    """GTSAM's own marginals at the solution, where it grants them.

    Raises:
        RuntimeError: GTSAM finds the system indeterminate, which it also does to correct ones (condition above 1e4).
    """
    return gtsam.Marginals(solution.problem.graph, solution.values)
