"""Solve a job and assess its solution: the steps of `calibrate`."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from fg_calib import diagnostics, graph, monitoring, parallel, statistics
from fg_calib.diagnostics.multistart import multistart
from fg_calib.inputs import Floats, FrozenArrays, InputError, Record, SolverError, as_figures, checked
from fg_calib.job import Job
from fg_calib.observability import Identifiability, Observability, identifiability_of
from fg_calib.prediction import ExpectedError, expected_error
from fg_calib.robot import Robot
from fg_calib.selection import estimate_curve_sigma
from fg_calib.statistics.residual_table import residual_table


class Prediction(Record):
    """A function of the parameters at the estimate.

    Attributes:
        value: Its value, shape (m,).
        sigma: 1 sigma, shape (m,); nan where the measurements do not determine it.
        covariance: Shape (m, m), nan in rows and columns of what is not determined.
    """

    value: Floats
    sigma: Floats
    covariance: Floats


class Assessment(FrozenArrays):
    """Assessment of a solution by `assess`.

    Attributes:
        robot: The calibrated robot.
        estimates: Every estimate with its sigma.
        names: The parameters to be estimated, in the order of `covariance`, those left out to fix the gauge included.
        covariance: Covariance of their errors, [m] and [rad]; nan in rows and columns of what nothing determines. A
            parameter that was left out counts with its prior sigma.
        spread: The covariance in the tangent space of the variables that were estimated, the others taken as known.
        whole: The covariance in the tangent space of all parameters, those left out included.
        fit: Chi-square, residuals, goodness of fit and corrections against prior sigmas.
        identifiability: Identifiability by the data alone, at the nominal parameters.
        verdict: Whether the result is to be trusted, and what its reader should know.
        expected_error: Of the tool, by the covariance; None where the arm was evaluated as it is.
        acceptance: Outcome of the limits that its user set; None without any.
        cross_validation: Held-out residuals and spread of the estimates; None where it was not asked for.
    """

    robot: Robot
    estimates: statistics.Estimates
    names: tuple[str, ...]
    covariance: Floats
    spread: statistics.Spread
    whole: statistics.Spread
    fit: statistics.Fit
    identifiability: Identifiability
    verdict: diagnostics.Verdict
    expected_error: ExpectedError | None
    acceptance: statistics.Acceptance | None = None
    cross_validation: statistics.CrossValidation | None = None

    def with_held_out(self, others: Sequence[statistics.HeldOut], solution: graph.Solution) -> "Assessment":
        """The assessment with limits on kinds without test rows judged by other measurements that were predicted.

        Args:
            others: Held-out measurements, by table and kind of noise.
            solution: The assessed solution.
        """
        tested = self.fit.residuals.held_out(solution.problem.data.labels, self.fit.goodness.suspect)
        kinds = {held.kind for held in tested}
        held_out = (*tested, *(held for held in others if held.kind not in kinds))
        limits = solution.problem.options.accept
        tool = {} if self.expected_error is None else vars(self.expected_error.measured)
        return replace(self, acceptance=statistics.accept(limits, held_out, self.verdict.errors, tool))

    def __repr__(self) -> str:
        chi2, doubts = self.fit.chi_square, len(self.verdict.errors)
        return f"<Assessment: chi-square {chi2.value:.6g}, {chi2.dof} degrees of freedom, {doubts} reasons for doubt>"

    @parallel.single_threaded
    def predict(self, function: Callable[[Robot], ArrayLike]) -> Prediction:
        """Value and sigma of any function of the robot: a tool position, a distance, a sum of parameters.

        It may be determined although the parameters it depends on are not; where it is not, its sigma is nan.

        Args:
            function: From a robot to a number or an array; smooth, for it is differentiated by central differences.

        Note:
            Parameters that were left out to fix the gauge (`keep`) count with their prior sigma: what depends on one
            without is unknown.

        Raises:
            InputError: The function raised something, or returned no figures.
        """
        covariance = self.whole.covariance(self.whole.derivative(lambda robot: _figures(function, robot)))
        return Prediction(_figures(function, self.robot), np.sqrt(np.diag(covariance)), covariance)

    @property
    def observability(self) -> Observability:
        """Rank, classes and groups of `identifiability`."""
        return self.identifiability.observability

    @property
    def noise_may_be_estimated(self) -> bool:
        """Whether the residuals look like noise that is a little larger than specified."""
        fit, verdict = self.fit, self.verdict
        too_large = [kind for kind in fit.goodness.kinds if kind.verdict == "too small"]
        return (
            not fit.residuals.evaluated
            and not verdict.setup.explanations
            and verdict.change is None
            and fit.goodness.gross is None
            and not (too_large and self.identifiability.missing)
            and all(kind.typical <= diagnostics.MOST_ESTIMATED for kind in too_large)
            and (verdict.noise_like is None or verdict.noise_like > diagnostics.LIKE_NOISE)
            and (fit.goodness.test is None or fit.goodness.test.p_value > diagnostics.LIKE_NOISE)
        )

    @property
    def trustworthy(self) -> bool:
        """Whether nothing speaks against the result."""
        return not self.verdict.errors


def _figures(function: Callable[[Robot], ArrayLike], robot: Robot) -> Floats:
    """The value of a function of a robot that a user gave, shape (n,).

    Raises:
        InputError: The function raised something, or its value is no number.
    """
    try:
        value = function(robot)
    except Exception as error:
        message = f"{type(error).__name__}: {error}".rstrip(": ")
        raise InputError("function", f"raised {message}", "figures of any robot") from error
    return as_figures("function", value, "a number or an array of them").ravel()


@checked
def solve_job(job: Job, problem: graph.Problem | None = None) -> graph.Solution:
    """The solution of a job: the best optimum that is found, with noise estimated if it asks for that.

    Args:
        job: The job.
        problem: Another problem with the job's measurements; the job's own if None.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    problem = problem or graph.problem_of(job)
    try:
        solve_with = statistics.estimate_noise if job.options.estimate_noise else graph.solve
        solution = estimate_curve_sigma(problem, solve_with)
    except SolverError as error:
        for table in job.tables:
            if table.model is not None:
                given = (job.robot, table.measurements, table.model, table.frame)
                check = diagnostics.check_setup(*given, doubtful=True, table=table)
                if check.explanations:
                    raise SolverError(f"{error}; {check}") from error
        raise
    return multistart(solution)


@parallel.single_threaded
def assess(solution: graph.Solution) -> Assessment:
    """Covariance, goodness of fit, residuals, identifiability and verdict of a solution.

    The covariance comes from a singular value decomposition of the whitened Jacobian of data and priors, its
    columns scaled, at the estimate. Directions that `determined` does not count are undetermined: a parameter with a
    share in one has unknown sigma (None, nan in the covariance). It is by the noise as specified, but for what the
    verdict inflates it by where residuals are systematic or significantly larger (`Verdict.variance`).

    Note:
        Away from the nominal parameters undetermined directions turn, by about as many radians as the angles were
        corrected, and get a small share of parameters that they did not have at nominal. Unknown is what has a share
        in one both at the nominal parameters and at the estimate; the others are known given that the undetermined
        directions are near nominal. Frames have no nominal value: what follows them may be off by as much as they are.
    """
    problem = solution.problem
    spread = statistics.spread_of(solution)
    identifiability = identifiability_of(*monitoring.at_nominal(problem.whole or problem, solution.before), "practical")
    table = residual_table(solution)
    goodness = statistics.judge_without_outliers(solution, table, statistics.judge_fit(solution, spread, table))
    table = table.without(goodness.unknown(table))
    chi_square, priors = statistics.chi_square(solution, spread), statistics.judge_priors(solution, spread)
    fit = statistics.Fit(chi_square, table, goodness, priors)
    verdict = diagnostics.judge(solution, spread, fit, identifiability)
    spread = spread.inflated(verdict.variance)
    whole = statistics.with_left_out(solution, spread)
    robot = problem.robot.with_values(solution.parameters[problem.variables.robot_span])
    estimates = statistics.estimates_at(solution, spread, whole, identifiability.observability)
    names = whole.variables.names[: whole.variables.n_robot_columns]
    expected = None if problem.evaluated else expected_error(problem, whole)
    found = (spread, whole, fit, identifiability, verdict, expected)
    return Assessment(robot, estimates, names, whole.named(), *found).with_held_out((), solution)
