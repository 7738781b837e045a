"""Comparison of the factor graph with plain least squares on one job: what each finds, claims and costs.

| estimator | estimates | weights |
|---|---|---|
| `graph` | what the job says, with its priors | noise |
| `graph-keep` | the kept parameters alone, no priors (gauge `keep`) | noise |
| `gauss-newton` | the same parameters, by Eq. (54)-(55) of Jia et al. (2019) | none: metres, radians, pixels alike |
| `scipy` | the same parameters, by `scipy.optimize.least_squares` | noise |

All of them also estimate landmarks, unknown frames and offsets, from the graph's start. Plain least squares takes
every measurement for independent, whatever errors they share. Where a job has its noise estimated, both graphs do so;
plain least squares weights by the specified noise.

All are judged on the same rows, by the same formulas, at the test configurations; at the train configurations where
there are none. Where the truth is known (a simulation) real errors are compared with the predicted ones.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.assessment import Assessment, assess, solve_job
from fg_calib.baseline.least_squares import LeastSquares, fit_least_squares
from fg_calib.graph import Problem, Solution, corrections_of, problem_of
from fg_calib.inputs import Brief, CalibrationError, Floats, ProblemError
from fg_calib.job import Job
from fg_calib.parallel import single_threaded
from fg_calib.prediction import PoseRms, errors_at, judged_configurations, pose_rms
from fg_calib.robot import Robot, build_chain, forward, rotation_vector
from fg_calib.statistics.residual_table import residual_table

ResidualRms = dict[str, dict[str, float]]
"""RMS by split and kind."""

ESTIMATORS: Mapping[str, str] = {
    "graph": "the factor graph, as the job says",
    "graph-keep": "the factor graph, the kept parameters alone and no priors",
    "gauss-newton": "plain least squares of the kept parameters without weights: Eq. (54) of Jia et al. (2019)",
    "scipy": "scipy.optimize.least_squares of the same, weighted by noise, each measurement as if it were alone",
}
"""The estimators in the order of a comparison, in words."""


class PoseError(Brief):
    """Estimated minus true tool poses over some configurations.

    Attributes:
        max: Largest distance between estimated and true tool point, [m].
        mean: Mean of the distances, [m].
        rms: Root of the mean square of the distances, [m].
        orientation_rms: RMS of the angles between estimated and true orientation, [rad].
    """

    max: float
    mean: float
    rms: float
    orientation_rms: float


class RealErrors(Brief):
    """Errors of an arm whose truth is known.

    Attributes:
        base_frame: In the robot's base frame.
        best_rigid_fit: After the rotation and shift that bring the estimated points nearest to the true ones: for what
            works relative to what was seen. None for fewer than three configurations.
    """

    base_frame: PoseError
    best_rigid_fit: PoseError | None


class Estimate(Brief):
    """Result of one estimator on a job.

    Attributes:
        name: A key of `ESTIMATORS`.
        robot: The calibrated robot; None if the estimator could not run at all.
        sigma: 1 sigma that it claims of each parameter that it estimated, [m] or [rad]; nan where it claims nothing.
        converged: Whether it arrived.
        message: Why it stopped, or why it could not run.
        iterations: Steps taken.
        seconds: Time of the fit itself.
        residual_rms: RMS of the residuals by split and kind, of the rows that the job's graph uses.
        predicted_position_rms: RMS distance between estimated and true tool point that its covariance predicts, in the
            base frame, [m]; None where it does not say. Parameters that it did not estimate count as known.
        predicted_position_rms_fitted: The same after the best rigid fit, [m].
        errors: Real errors; None where the truth is not known.
    """

    name: str
    robot: Robot | None
    sigma: Mapping[str, float]
    converged: bool
    message: str
    iterations: int = 0
    seconds: float = 0.0
    residual_rms: ResidualRms | None = None
    predicted_position_rms: float | None = None
    predicted_position_rms_fitted: float | None = None
    errors: RealErrors | None = None

    @property
    def ran(self) -> bool:
        """Whether the estimator could run."""
        return self.robot is not None

    @property
    def n_estimated(self) -> int:
        """Number of parameters that it estimated."""
        return len(self.sigma)


class Comparison(Brief):
    """Several estimators on one job.

    Attributes:
        job: The job.
        estimates: One of each estimator, in the order of `ESTIMATORS`; the job's own graph first.
        errors_before: Real errors of the nominal arm, its tool fitted where that is unknown; None without the truth.
        rms_before: RMS of the residuals of the nominal arm.
        judged_on: `test`, or `train` where there are no test rows.
        n_judged: Number of configurations judged on.
        findings: Why the graph's result is not to be trusted; empty if it is.
        units: `m`, `rad` or `px` of each kind of residual.
    """

    job: Job
    estimates: tuple[Estimate, ...]
    errors_before: RealErrors | None
    rms_before: ResidualRms
    judged_on: Literal["test", "train"]
    n_judged: int
    findings: tuple[str, ...]
    units: Mapping[str, str]

    @property
    def trustworthy(self) -> bool:
        """Whether nothing speaks against the graph's result."""
        return not self.findings

    def correction(self, robot: Robot, name: str) -> float:
        """A robot's parameter minus the job's nominal one, [m] or [rad] (see `corrections_of`)."""
        return float(corrections_of(self.job.robot, robot.nominal)[self.job.robot.index(name)])


@single_threaded
def compare(job: Job) -> Comparison:
    """Run the factor graph and the plain estimators on one job.

    A plain estimator that cannot run, or does not converge, says so in its place.

    Raises:
        CalibrationError: The job's own problem cannot be built or solved.
    """
    solution = solve_job(job)
    data = solution.problem.data
    if solution.problem.evaluated:
        raise ProblemError(data.source, "test rows alone", "train rows, for there is nothing to compare")
    configurations, judged_on = judged_configurations(data)
    readings, assessed = data.readings[configurations], assess(solution)

    def errors(robot: Robot) -> RealErrors | None:
        return None if job.truth is None else real_errors(robot, job.truth, readings)

    def rms(fit: Solution | LeastSquares, when: str) -> ResidualRms:
        found = residual_table(replace(solution, parameters=fit.parameters)).rms()
        return {split: {kind: both[when] for kind, both in kinds.items()} for split, kinds in found.items()}

    def judged(name: str, fit: Solution | LeastSquares, assessed: Assessment | None = None) -> Estimate:
        """An estimate on the same rows and configurations, by the same formulas."""
        if isinstance(fit, LeastSquares):
            robot, sigma, predicted = fit.robot, fit.sigma, _predicted(fit, readings)
        else:
            assessed = assessed or assess(fit)
            robot, spread = assessed.robot, assessed.spread
            values = np.sqrt(np.diag(spread.named())).tolist()
            sigma, predicted = dict(zip(spread.variables.names, values, strict=False)), errors_at(spread, readings)
        base, fitted = (error.position for error in predicted)
        about = (fit.converged, fit.message, fit.iterations, fit.seconds, rms(fit, "after"))
        return Estimate(name, robot, sigma, *about, base, fitted, errors(robot))

    def without_priors(name: str) -> Estimate:
        try:
            problem = problem_of(job, gauge="keep")
            return judged(name, solve_job(job, problem) if name == "graph-keep" else _fit_kept(job, problem, name))
        except CalibrationError as error:
            return Estimate(name, None, {}, False, f"could not run: {error}")

    estimates = (judged("graph", solution, assessed), *map(without_priors, list(ESTIMATORS)[1:]))
    before = errors(job.robot.with_values(solution.before[solution.problem.variables.robot_span]))
    units = {family: assessed.fit.residuals.unit(family) for family in assessed.fit.residuals.families}
    about = (judged_on, len(readings), assessed.verdict.errors, units)
    return Comparison(job, estimates, before, rms(solution, "before"), *about)


def _predicted(fit: LeastSquares, readings: Floats) -> tuple[PoseRms, PoseRms]:
    """Errors of the tool that the covariance predicts, in the base frame and after the best rigid fit."""
    chain = build_chain(fit.robot, {fit.robot.index(p): k for k, p in enumerate(fit.names)})
    at = forward(chain, fit.robot.trig(readings))
    return pose_rms(at.position, at.jacobian, lambda rows: np.sum((rows @ fit.covariance) * rows, axis=1))


def _fit_kept(job: Job, problem: Problem, name: str) -> LeastSquares:
    """Plain least squares of the kept parameters, from the graph's start."""
    kept = [p.name for p in problem.estimated]
    held = [i for i, p in enumerate(job.robot.parameters) if p.name not in kept]
    start = problem.start.copy()
    start[held] = job.robot.nominal[held]  # of an unknown tool too, as in the graph
    return fit_least_squares(job.robot, problem.data, names=kept, start=start, weighted=name == "scipy")


@single_threaded
def real_errors(estimated: Robot, true: Robot, readings: Floats) -> RealErrors:
    """Errors of an estimated arm at joint readings, shape (n, n_joints), [rad] (prismatic: [m])."""
    at, truth = (forward(build_chain(r), r.trig(readings)) for r in (estimated, true))

    def error(points: Floats, onto: Floats, R: Floats) -> PoseError:
        distance = np.linalg.norm(points @ R.T - onto, axis=1)
        rotation = rotation_vector(np.swapaxes(R @ at.rotation, 1, 2) @ truth.rotation)
        rms, turn = (float(np.sqrt(np.mean(square))) for square in (distance**2, np.sum(rotation**2, axis=1)))
        return PoseError(float(distance.max()), float(distance.mean()), rms, turn)

    base, fitted = error(at.position, truth.position, np.eye(3)), None
    if len(readings) >= 3:
        points, onto = (p - p.mean(axis=0) for p in (at.position, truth.position))
        fitted = error(points, onto, Rotation.align_vectors(onto, points)[0].as_matrix())
    return RealErrors(base, fitted)
