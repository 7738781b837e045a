"""How well the estimate is known: covariance, chi-square, residuals before and after, what the data determine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays, as_figures
from fg_calib.diagnostics.changes import Change
from fg_calib.diagnostics.findings import MOST_ESTIMATED, Fit, judge
from fg_calib.diagnostics.setup_check import SetupCheck
from fg_calib.diagnostics.verdict import LIKE_NOISE
from fg_calib.errors import InputError, escaped
from fg_calib.graph.extension import check_graph
from fg_calib.graph.factors import Variables, corrections_of, pose_of
from fg_calib.graph.solver import Solution
from fg_calib.monitoring.prior_information import at_nominal
from fg_calib.observability.identifiability import Identifiability, identifiability_of
from fg_calib.observability.indices import IdentifiabilityClass, Observability
from fg_calib.prediction.expected_error import ExpectedError, expected_error, without_rigid_motion
from fg_calib.robot.model import Robot
from fg_calib.statistics.acceptance import Acceptance, Kinds, accept
from fg_calib.statistics.chi_square import chi_square
from fg_calib.statistics.covariance import Spread, TangentCovariance, spread_of, with_left_out, with_unsure_tolerances
from fg_calib.statistics.goodness_of_fit import Goodness, judge_fit
from fg_calib.statistics.joint_values import JointValues, joint_values
from fg_calib.statistics.landmark_estimates import PointEstimate, point_estimates
from fg_calib.statistics.outliers import judged_without_gross_errors
from fg_calib.statistics.prior_consistency import PriorFit, judge_priors
from fg_calib.statistics.residual_table import ResidualTable, residual_table
from fg_calib.threads import one_blas_thread, single_threaded

if TYPE_CHECKING:
    from fg_calib.statistics.cross_validation import Folds

Floats = NDArray[np.float64]


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
        reservations: Those of the cautions that say that sigmas are too small.
        change: What moved while a table was measured; None if nothing did.
        acceptance: What became of the limits that its user set; None without any.
        folds: What cross-validation found; None where it was not asked for.
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
    reservations: tuple[str, ...] = ()
    change: Change | None = None
    acceptance: Acceptance | None = None
    folds: Folds | None = None

    def with_folds(self, folds: Folds, solution: Solution) -> Uncertainty:
        """The same with cross-validation, by which limits are judged that no test rows speak of.

        Args:
            folds: What cross-validation found.
            solution: What was assessed.
        """
        return replace(self.with_held_out(folds.by_table, solution), folds=folds)

    def with_held_out(self, others: Kinds, solution: Solution) -> Uncertainty:
        """The same with limits that no test rows speak of judged by other measurements that were predicted.

        Args:
            others: They, by table and kind of noise.
            solution: What was assessed.
        """
        tested = self.residuals.held_out(solution.problem.data.labels)
        kinds = {kind for _, kind in tested}
        held_out = tested | {key: held for key, held in others.items() if key[1] not in kinds}
        return replace(self, acceptance=accept(solution.problem.options.accept, held_out, self.findings))

    def __repr__(self) -> str:
        known = sum(p.sigma is not None for p in self.parameters if p.identifiability != "fixed")
        lines = [
            f"Uncertainty of {self.robot.name!r}: {known} of {len(self.names)} parameters have a known sigma",
            f"  chi-square {self.chi2:.6g}, {self.dof} degrees of freedom",
            *(f"  DOUBTFUL: {finding}" for finding in self.findings[:6]),
        ]
        return "\n".join(escaped(line if len(line) <= 100 else f"{line[:96]} ...") for line in lines)

    @checked
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

        Raises:
            InputError: The function raised something, or returned no figures, or not as many of every robot.
        """
        figures = _Figures(function)
        value = figures(self.robot)
        G = self.whole.derivative(figures)
        if fitted:
            if len(value) % 3:
                raise InputError("function", f"{len(value)} figures", "points, shape (n, 3), where errors are fitted")
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
        too_large = [fit for fit in self.goodness.kinds if fit.verdict in ("too small", "both", "many")]
        return (
            not self.residuals.evaluated
            and not self.setup.explanations
            and self.change is None
            and not any(
                fit.verdict in ("outliers", "others", "both", "many") for fit in self.goodness.kinds
            )  # they are not noise
            and not (too_large and self.identifiability.missing)
            and all(fit.typical <= MOST_ESTIMATED for fit in too_large)
            and (self.noise_like is None or self.noise_like > LIKE_NOISE)
            and (self.goodness.test is None or self.goodness.test.p_value > LIKE_NOISE)
        )

    @property
    def reduced_chi2(self) -> float | None:
        """Chi-square over its degrees of freedom; None without any."""
        return self.chi2 / self.dof if self.dof > 0 else None

    @property
    def trustworthy(self) -> bool:
        """Whether nothing speaks against the result."""
        return not self.findings


class _Figures:
    """A function of somebody else's, of a robot: what it raises, or returns that are no figures, becomes one line."""

    def __init__(self, function: Callable[[Robot], ArrayLike]) -> None:
        self._function = function
        self._n: int | None = None

    def __call__(self, robot: Robot) -> Floats:
        """Its value, shape (n,).

        Raises:
            InputError: It raised something, or its value is no figures, or more or fewer than before.
        """
        try:
            found = self._function(robot)
        except Exception as error:
            message = f"{type(error).__name__}: {error}".rstrip(": ")
            raise InputError("function", f"raised {message}", "figures of any robot") from error
        figures = as_figures("function", found, "a number or an array of them").ravel()
        self._n = figures.size if self._n is None else self._n
        if figures.size != self._n:
            raise InputError("function", f"{figures.size} figures, {self._n} before", "as many of every robot")
        return figures


@checked
def assess(solution: Solution) -> Uncertainty:
    """Covariance, goodness of fit, residuals and identifiability of a solution.

    The covariance comes from a singular value decomposition of the whitened Jacobian of data and priors, its
    columns scaled, at the estimate. Directions that `determined` does not count are undetermined: a parameter with a
    share in one has unknown sigma (None, nan in the covariance). It is not rescaled by chi-square.

    Note:
        Away from the nominal parameters undetermined directions turn, by about as many radians as the angles were
        corrected, and get a small share of parameters that they did not have at nominal. Unknown is what has a share
        in one both at the nominal parameters and at the estimate; the others are known given that the undetermined
        directions are near nominal. Frames have no nominal value: what follows them may be off by as much as they are.

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
    whole = with_unsure_tolerances(solution, with_left_out(solution, spread))
    identifiability = identifiability_of(*at_nominal(problem.whole or problem, solution.before), "practical")
    covariance = whole.named()
    frames = frame_estimates(variables, solution.parameters, whole)
    chi2, table = chi_square(solution, spread), residual_table(solution)
    goodness = judged_without_gross_errors(solution, spread, table, judge_fit(solution, spread, table))
    table = table.without(goodness.unknown(table))
    fit = Fit(chi2, table, goodness, judge_priors(solution, spread))
    verdict = judge(solution, spread, fit, identifiability.missing)
    return Uncertainty(
        names=whole.variables.names[: whole.variables.n_robot_columns],
        covariance=covariance,
        parameters=_parameter_estimates(solution, np.sqrt(np.diag(covariance)), spread, identifiability.observability),
        frame=frames[0] if frames else None,
        frames=frames,
        chi2=chi2.value,
        dof=chi2.dof,
        expected_chi2=chi2.expected,
        chi2_bounds=chi2.bounds,
        p_value=chi2.p_value,
        residuals=table,
        goodness=fit.goodness,
        priors=fit.priors,
        expected_error=None if problem.evaluated else expected_error(problem, whole),
        identifiability=identifiability,
        robot=problem.robot.with_values(solution.parameters[variables.robot_span]),
        spread=spread,
        whole=whole,
        findings=verdict.findings,
        cautions=verdict.cautions,
        points=point_estimates(solution, whole),
        joint_values=joint_values(solution, spread),
        setup=verdict.setup,
        noise_like=verdict.noise_like,
        reservations=verdict.reservations,
        change=verdict.change,
        acceptance=accept(problem.options.accept, table.held_out(problem.data.labels), verdict.findings),
    )


def frame_estimates(variables: Variables, parameters: Floats, whole: TangentCovariance) -> tuple[FrameEstimate, ...]:
    """Every measurement frame that was estimated.

    Args:
        variables: The variables.
        parameters: The estimate.
        whole: The covariance of all parameters.
    """
    found = []
    for k, v in enumerate(variables.frames):
        world_T_base = pose_of(parameters[v.places])
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
                sigma=known(sigmas.get(p.name, 0.0)),
                prior_sigma=p.tolerance if p.estimated and problem.options.has_priors else None,
                identifiability=classes.get(p.name, "fixed"),
                stands_for=combinations.get(p.name),
                sigma_of_combination=known(of_combinations[p.name]) if p.name in combinations else None,
            )
        )
    return tuple(found)


def known(sigma: float) -> float | None:
    """A sigma; None for one that nothing tells."""
    return float(sigma) if np.isfinite(sigma) else None


def marginals(solution: Solution) -> gtsam.Marginals:
    """GTSAM's own marginals at the solution, where it grants them.

    Raises:
        RuntimeError: GTSAM finds the system indeterminate, which it also does to correct ones (condition above 1e4).
    """
    return gtsam.Marginals(solution.problem.graph, solution.values)
