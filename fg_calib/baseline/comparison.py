"""The factor graph beside plain least squares on one job: what each finds, claims and costs.

| estimator | estimates | weights |
|---|---|---|
| `graph` | what the job says, with its priors | noise |
| `graph-keep` | the kept parameters alone, no priors (gauge `keep`) | noise |
| `gauss-newton` | the same parameters, by Eq. (54)-(55) of Jia et al. (2019) | none: metres, radians, pixels alike |
| `weighted-gauss-newton` | the same parameters, by the same steps | noise |
| `scipy` | the same parameters, by `scipy.optimize.least_squares` | noise |

All of them estimate the places, unknown frames and offsets that the measurements depend on as well, from where the
graph starts. Plain least squares takes every measurement for independent, whatever errors they share.

Where a job has its noise estimated, both graphs do so; plain least squares weighs by the noise stated.

All are judged on the same rows, by the same formulas, at the test configurations; at the train configurations where
there are none. Where the truth is known (a simulation) the real errors stand beside the predicted ones.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
    Umeyama (1991), Least-squares estimation of transformation parameters between two point patterns. IEEE PAMI 13(4).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import Brief
from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.assessment import assess, solve_job
from fg_calib.baseline.least_squares import LeastSquares, fit_dataset
from fg_calib.errors import CalibrationError, ProblemError
from fg_calib.graph.build import problem_of
from fg_calib.graph.factors import corrections_of
from fg_calib.graph.solver import Solution
from fg_calib.job import Job
from fg_calib.measurements.dataset import rotation_angle
from fg_calib.prediction.expected_error import errors_at, judged_configurations, pose_rms
from fg_calib.robot.kinematics import Poses, build_chain, forward
from fg_calib.robot.model import Robot
from fg_calib.statistics.residual_table import residual_table
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

ResidualRms = dict[str, dict[str, dict[str, float]]]
"""RMS by split, kind, and before or after: see `residual_table.ResidualTable.rms`."""

ESTIMATORS: Mapping[str, str] = {
    "graph": "the factor graph, as the job says",
    "graph-keep": "the factor graph, the kept parameters alone and no priors",
    "gauss-newton": "plain least squares of the kept parameters, metres beside radians: Eq. (54) of Jia et al. (2019)",
    "weighted-gauss-newton": "the same, weighted by noise, each measurement as if it were alone",
    "scipy": "scipy.optimize.least_squares of the same parameters and weights",
}
"""The estimators in the order of a comparison, in words."""


@dataclass(frozen=True)
class PoseError(Brief):
    """Estimated minus true tool poses over some configurations.

    Attributes:
        max: Largest distance between estimated and true tool point, [m].
        mean: Mean of the distances, [m].
        rms: Root of the mean square of the distances, [m].
        orientation_rms: The same of the angles between estimated and true orientation, [rad].
    """

    max: float
    mean: float
    rms: float
    orientation_rms: float


@dataclass(frozen=True)
class RealErrors(Brief):
    """Errors of an arm whose truth is known.

    Attributes:
        base: In the robot's base frame.
        fitted: After the rotation and shift that bring the estimated points nearest to the true ones: for what
            works relative to what was seen. None for fewer than three configurations.
    """

    base: PoseError
    fitted: PoseError | None


@dataclass(frozen=True)
class Estimate(Brief):
    """What one estimator made of a job.

    Attributes:
        name: A key of `ESTIMATORS`.
        robot: The calibrated robot; None if the estimator could not run at all.
        sigma: 1 sigma that it claims of each parameter that it estimated, [m] or [rad]; nan where it claims nothing.
        converged: Whether it arrived.
        message: Why it stopped, or why it could not run.
        iterations: Steps taken.
        seconds: Time of the fit itself.
        residual_rms: RMS of the residuals by split and kind, before and after, of the rows that the job's graph uses.
        predicted_rms: RMS distance between estimated and true tool point that its covariance predicts, in the base
            frame, [m]; None where the covariance does not tell. Parameters that it did not estimate count as known.
        predicted_fitted_rms: The same after the best rigid fit, [m].
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
    predicted_rms: float | None = None
    predicted_fitted_rms: float | None = None
    errors: RealErrors | None = None

    @property
    def description(self) -> str:
        """The estimator in words."""
        return ESTIMATORS[self.name]


@dataclass(frozen=True)
class Comparison(Brief):
    """Several estimators on one job.

    Attributes:
        job: The job.
        estimates: One of each estimator, in the order of `ESTIMATORS`; the job's own graph first.
        before: The nominal arm, its tool fitted where that is unknown: where the residuals `before` come from.
        errors_before: Its real errors; None where the truth is not known.
        judged_on: `test`, or `train` where there are no test rows.
        n_judged: Number of configurations judged on.
        findings: Why the graph's result is not to be trusted; empty if it is.
        units: `m`, `rad` or `px` of each kind of residual.
    """

    job: Job
    estimates: tuple[Estimate, ...]
    before: Robot
    errors_before: RealErrors | None
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


@checked
@single_threaded
def compare(job: Job) -> Comparison:
    """Run the factor graph and the plain estimators on one job.

    A plain estimator that cannot run, or does not arrive, says so in its place.

    Raises:
        CalibrationError: The job's own problem cannot be built or solved.
    """
    solution = solve_job(job)
    data = solution.problem.data
    if solution.problem.evaluated:
        raise ProblemError(data.source, "test rows alone", "train rows, for there is nothing to compare")
    there, judged_on = judged_configurations(data)
    readings = data.readings[there]
    uncertainty = assess(solution)
    judge = _Judge(job, readings, solution)
    estimates = [judge.of_graph("graph", solution, uncertainty)]

    before = job.robot.with_values(solution.before[solution.problem.variables.robot_span])
    try:
        estimates += _without_priors(job, judge)
    except CalibrationError as error:
        estimates += [_failed(name, error) for name in list(ESTIMATORS)[1:]]
    return Comparison(
        job=job,
        estimates=tuple(estimates),
        before=before,
        errors_before=judge.errors(before),
        judged_on=judged_on,
        n_judged=len(readings),
        findings=uncertainty.findings,
        units={family: uncertainty.residuals.unit(family) for family in uncertainty.residuals.families},
    )


def _without_priors(job: Job, judge: _Judge) -> list[Estimate]:
    """The estimates of the kept parameters: by the graph, and by plain least squares from the same start."""
    problem = problem_of(job, gauge="keep")
    kept = [p.name for p in problem.estimated]
    held = [i for i, p in enumerate(job.robot.parameters) if p.name not in kept]
    start = problem.start.copy()
    start[held] = job.robot.nominal[held]  # of an unknown tool too, as in the graph
    plain = partial(fit_dataset, job.robot, problem.data, names=kept, start=start)

    def graph() -> Estimate:
        solution = solve_job(job, problem)
        return judge.of_graph("graph-keep", solution, assess(solution))

    runs: dict[str, Callable[[], Estimate]] = {
        "graph-keep": graph,
        "gauss-newton": lambda: judge.of_baseline("gauss-newton", plain()),
        "weighted-gauss-newton": lambda: judge.of_baseline("weighted-gauss-newton", plain(weighted=True)),
        "scipy": lambda: judge.of_baseline("scipy", plain(weighted=True, method="scipy")),
    }
    estimates = []
    for name, run in runs.items():
        try:
            estimates.append(run())
        except CalibrationError as error:
            estimates.append(_failed(name, error))
    return estimates


@single_threaded
def real_errors(estimated: Robot, true: Robot, readings: Floats) -> RealErrors:
    """Errors of an estimated arm at joint readings, shape (n, n_joints), [rad] (prismatic: [m])."""
    here, there = (forward(build_chain(r), r.trig(readings)) for r in (estimated, true))
    fitted = None
    if len(readings) >= 3:
        R, t = best_rigid_fit(here.position, there.position)
        fitted = _pose_error(here.rotation, here.position, there, R, t)
    return RealErrors(_pose_error(here.rotation, here.position, there, np.eye(3), np.zeros(3)), fitted)


def best_rigid_fit(points: Floats, onto: Floats) -> tuple[Floats, Floats]:
    """Rotation R and shift t that minimise the sum of |R p + t - q|^2 (Umeyama 1991, without scale).

    Args:
        points: The points p, shape (n, 3), [m].
        onto: The points q, shape (n, 3), [m].
    """
    p, q = points.mean(axis=0), onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((onto - q).T @ (points - p))
    R: Floats = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, q - R @ p


def _pose_error(rotation: Floats, position: Floats, true: Poses, R: Floats, t: Floats) -> PoseError:
    distance = np.linalg.norm(position @ R.T + t - true.position, axis=1)
    angle, _ = rotation_angle(np.swapaxes(R @ rotation, 1, 2) @ true.rotation)
    return PoseError(
        max=float(distance.max()),
        mean=float(distance.mean()),
        rms=float(np.sqrt(np.mean(distance**2))),
        orientation_rms=float(np.sqrt(np.mean(angle**2))),
    )


def _failed(name: str, error: CalibrationError) -> Estimate:
    return Estimate(name, None, {}, False, f"could not run: {error}")


class _Judge:
    """Judges every estimate on the same rows and configurations, by the same formulas."""

    def __init__(self, job: Job, readings: Floats, solution: Solution) -> None:
        self._truth = job.truth
        self._readings = readings
        self._solution = solution  # its rows are those that residuals are shown of

    def of_graph(self, name: str, solution: Solution, uncertainty: Uncertainty) -> Estimate:
        """The graph's estimate; like plain least squares it takes here what was held at nominal for known."""
        spread = uncertainty.spread
        base, fitted = errors_at(spread, self._readings)
        return Estimate(
            name=name,
            robot=uncertainty.robot,
            sigma=dict(zip(spread.variables.names, np.sqrt(np.diag(spread.named())).tolist(), strict=False)),
            converged=solution.converged,
            message=solution.message,
            iterations=solution.iterations,
            seconds=solution.seconds,
            residual_rms=self.residual_rms(solution.parameters),
            predicted_rms=base.position,
            predicted_fitted_rms=fitted.position,
            errors=self.errors(uncertainty.robot),
        )

    def of_baseline(self, name: str, fit: LeastSquares) -> Estimate:
        """The estimate of plain least squares."""
        chain = build_chain(fit.robot, {fit.robot.index(p): k for k, p in enumerate(fit.names)})
        at = forward(chain, fit.robot.trig(self._readings))
        base, fitted = pose_rms(at.position, at.jacobian, lambda rows: np.sum((rows @ fit.covariance) * rows, axis=1))
        return Estimate(
            name=name,
            robot=fit.robot,
            sigma=fit.sigma,
            converged=fit.converged,
            message=fit.message,
            iterations=fit.iterations,
            seconds=fit.seconds,
            residual_rms=self.residual_rms(fit.parameters),
            predicted_rms=base.position,
            predicted_fitted_rms=fitted.position,
            errors=self.errors(fit.robot),
        )

    def residual_rms(self, parameters: Floats) -> ResidualRms:
        """RMS by split and kind at a parameter vector, on the rows of the job's graph."""
        return residual_table(replace(self._solution, parameters=parameters)).rms()

    def errors(self, robot: Robot) -> RealErrors | None:
        """Real errors of an arm, where the truth is known."""
        return None if self._truth is None else real_errors(robot, self._truth, self._readings)
