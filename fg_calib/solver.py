"""Levenberg-Marquardt by GTSAM, with a status of our own.

GTSAM's optimiser takes the steps, one `iterate` at a time; whether it has arrived is judged here, because GTSAM returns
without a word when it is stuck. The judge is the *decrement*: how far, in sigma, the Gauss-Newton step still leads
along the directions that data and priors determine (the square root of the cost decrease it predicts, times two).

Directions that nothing determines are left where they are: the damping `lambda I` never falls to zero, so every step is
a minimum-norm step. Its floor is that of a direction whose signal-to-noise ratio is just too small to count as
determined: less damping lets noise carry such directions off by metres, and what is determined is hardly slowed by it.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import SolverError
from fg_calib.factors import Eliminated, Variables, eliminate
from fg_calib.observability import SIGNAL_FLOOR, determined
from fg_calib.problem import Problem, frames_only, is_settled, joint_errors, judged_at, lengths
from fg_calib.residuals import single_threaded_blas
from fg_calib.robust import Weighting
from fg_calib.whitening import Adjustment

Floats = NDArray[np.float64]


_DAMPING_FLOOR = 10.0 * (SIGNAL_FLOOR / 1e-3) ** 2
"""Least damping in [1/m^2] and [1/rad^2]: ten times the curvature at the floor, in changes of 1 mm and 1 mrad."""


@dataclass(frozen=True)
class SolverOptions:
    """Settings of the solver.

    Attributes:
        max_iterations: Steps after which it gives up.
        decrement: Converged when a step began nearer than this to the optimum, [sigma]; far less is left after it.
        lambda_ceiling: Damping beyond which it gives up, as a multiple of the largest curvature.
        lambda_floor: Least damping, as a multiple of the largest curvature (rounding), beside `_DAMPING_FLOOR` (noise).
        max_rounds: Times that rows are judged and whitened anew at the estimate.
        max_learning_rounds: The same where robust weights or joint values are learned, which takes some rounds.
    """

    max_iterations: int = 100
    decrement: float = 1e-5
    lambda_ceiling: float = 1e6
    lambda_floor: float = 1e-14
    max_rounds: int = 5
    max_learning_rounds: int = 200


@dataclass(frozen=True)
class Iteration:
    """One step of the solver.

    Attributes:
        cost: Half the sum of squared whitened residuals after the step.
        damping: Levenberg-Marquardt's lambda after the step.
        step: Length of the step, in changes of ordinary size (tolerances, else 1 mm and 1 mrad).
        decrement: How far from the optimum it started, [sigma].
    """

    cost: float
    damping: float
    step: float
    decrement: float


@dataclass(frozen=True)
class Solution:
    """What the solver found.

    Attributes:
        problem: The problem solved; its rows are judged at the estimate.
        values: GTSAM's values at the estimate.
        parameters: The parameter vector there (see `Variables`).
        before: The parameter vector with the arm at nominal, and frame, base and tool alone fitted.
        converged: Whether the optimum was reached.
        message: Why it stopped.
        history: Its steps.
        initial_cost: Cost at `before`.
        cost: Cost at the estimate, whatever the loss.
        weighted_cost: The same with every measurement by its robust weight.
        seconds: Time taken.
        estimated_noise: Kinds whose noise was estimated (see `noise`); None where it was taken as stated.
    """

    problem: Problem
    values: gtsam.Values
    parameters: Floats
    before: Floats
    converged: bool
    message: str
    history: tuple[Iteration, ...]
    initial_cost: float
    cost: float
    weighted_cost: float
    seconds: float
    estimated_noise: tuple[str, ...] | None = None

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return len(self.history)


def solve(problem: Problem, options: SolverOptions | None = None) -> Solution:
    """Estimate the parameters.

    First measurement frame, base and tool alone with the arm at nominal, then everything. Then, in rounds, the rows are
    judged and whitened at the estimate, robust weights follow from the residuals there and joint errors, where they are
    estimated, from what the rows say of them; where that changes the rows, the solver goes on with the new ones.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    options = options or SolverOptions()
    clock = time.perf_counter()
    with single_threaded_blas():
        before = problem.start
        frames = frames_only(problem)
        if frames is not None:
            before = _fit(frames, options).run.parameters
            before = np.concatenate([before, problem.start[len(before) :]])
            problem = judged_at(problem, before)
        initial_cost = problem.graph.error(problem.initial)
        fit = _fit(problem, options)
        run, cost = fit.run, fit.run.cost
        if run.problem.adjustment.weights is not None:
            stated = judged_at(problem, run.parameters, replace(run.problem.adjustment, weights=None))
            cost = stated.graph.error(run.values)
    return Solution(
        problem=run.problem,
        values=run.values,
        parameters=run.parameters,
        before=before,
        converged=fit.converged,
        message=fit.message,
        history=fit.history,
        initial_cost=initial_cost,
        cost=cost,
        weighted_cost=run.cost,
        seconds=time.perf_counter() - clock,
    )


@dataclass(frozen=True)
class _Fit:
    """The last of the rounds of a fit, and how they went."""

    run: _Run
    history: tuple[Iteration, ...]
    converged: bool
    message: str


def _fit(problem: Problem, options: SolverOptions) -> _Fit:
    """Least squares in rounds, from the problem's start.

    With a robust loss the first weights are those of the residuals at the start: gross errors would lead least squares
    astray. A round that does not arrive still tells which measurements are far off.
    """
    robust = problem.settings.loss != "none"
    weighting = Weighting(problem.settings.loss)
    first = problem
    if robust:
        first = judged_at(problem, problem.start, _learn(problem, problem.start, weighting)[0])
    run = _Run(first, options)
    history = run.history
    learning = robust or problem.adjustment.joint_errors is not None
    most = options.max_learning_rounds if learning else options.max_rounds
    settled, rounds = False, 0
    while (run.converged or robust) and np.isfinite(run.parameters).all() and rounds < most:
        adjustment, final = _learn(run.problem, run.parameters, weighting)
        settled = final and is_settled(run.problem, run.parameters, adjustment)
        if settled:
            break
        run = _Run(judged_at(problem, run.parameters, adjustment), options)
        history = history + run.history
        rounds += 1
    message = run.message
    if run.converged and not settled and rounds == most:
        message += "; which rows take part still changed"
    return _Fit(run, tuple(history), run.converged and (settled or not learning), message)


def _learn(problem: Problem, parameters: Floats, weighting: Weighting) -> tuple[Adjustment, bool]:
    """What the residuals at some parameters say of the noise, and whether the loss has its final form."""
    adjustment, final = problem.adjustment, True
    if problem.settings.loss != "none":
        weights, final = weighting.update(*lengths(problem, parameters))
        adjustment = replace(adjustment, weights=weights)
    if adjustment.joint_errors is not None:
        adjustment = replace(adjustment, joint_errors=joint_errors(problem, parameters))
    return adjustment, final


class _Run:
    """One optimisation of one problem, from its start to the end."""

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        self.problem = problem
        self.history: list[Iteration] = []
        self.converged = False
        variables = problem.variables
        initial = problem.initial
        try:
            self.initial_cost = problem.graph.error(initial)
            if not np.isfinite(self.initial_cost):
                raise SolverError(
                    f"the cost at the start is {self.initial_cost}: the measurements or the robot hold absurd numbers"
                )
            curvature = _largest_curvature(problem.graph.linearize(initial), variables.keys)
            self.values, self.cost = initial, self.initial_cost
            self.message = self._iterate(_parameters(options, curvature), variables, options)
        except RuntimeError as error:
            raise SolverError(_in_words(str(error), variables)) from error
        self.parameters = variables.parameters(self.values)

    def _iterate(self, settings: gtsam.LevenbergMarquardtParams, variables: Variables, options: SolverOptions) -> str:
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.problem.graph, self.values, settings)
        for _ in range(options.max_iterations):
            linear = optimizer.iterate()
            decrement = _decrement(linear, variables)
            previous, values = self.values, gtsam.Values(optimizer.values())  # a copy: GTSAM hands out its own
            last, cost = self.cost, optimizer.error()
            held = _held(linear, variables.step(previous, values), variables) if cost < last else None
            if held is not None:
                moved = variables.moved(previous, held)
                if (cost_there := self.problem.graph.error(moved)) < last:
                    values, cost = moved, cost_there
                    settings.setlambdaInitial(optimizer.lambda_())
                    optimizer = gtsam.LevenbergMarquardtOptimizer(self.problem.graph, values, settings)
            self.values, self.cost = values, cost
            step = _step_length(previous, values, variables)
            self.history.append(Iteration(cost, optimizer.lambda_(), step, decrement))
            if not np.isfinite(cost):
                return f"not converged: the cost became {cost}"
            if decrement <= options.decrement:
                self.converged = True
                return f"converged: the last step began {decrement:.1e} sigma from the optimum"
            if cost >= last:
                # The end of double precision, if hardly anything was left to gain.
                self.converged = decrement <= max(1e-3, 1e-6 * np.sqrt(2.0 * cost))
                if self.converged:
                    return f"converged to rounding: no step lowers the cost, {decrement:.1e} sigma left"
                return f"not converged: no step lowers the cost although {decrement:.1e} sigma are left to go"
        return f"not converged: {options.max_iterations} iterations, {decrement:.1e} sigma left to go"


def _parameters(options: SolverOptions, curvature: float) -> gtsam.LevenbergMarquardtParams:
    """GTSAM's options: QR, lambda I damping, and no stopping rule of its own that could act before ours."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setDiagonalDamping(False)
    parameters.setlambdaInitial(max(1e-8 * curvature, _DAMPING_FLOOR))
    parameters.setlambdaFactor(10.0)
    floor = max(options.lambda_floor * curvature, _DAMPING_FLOOR)
    parameters.setlambdaLowerBound(floor)
    parameters.setlambdaUpperBound(options.lambda_ceiling * curvature)
    parameters.setRelativeErrorTol(1e-13)  # no search for a lambda once the cost's own rounding decides
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(options.max_iterations + 1)
    return parameters


def _dense(linear: gtsam.GaussianFactorGraph, keys: list[int]) -> tuple[Floats, Floats]:
    """The linear graph as one matrix in the order of the columns, and its right-hand side."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return linear.jacobian(ordering)


def _largest_curvature(linear: gtsam.GaussianFactorGraph, keys: list[int]) -> float:
    A, _ = _dense(linear, keys)
    return max(float(np.max(np.sum(A * A, axis=0))), 1e-12)


def _decrement(linear: gtsam.GaussianFactorGraph, variables: Variables) -> float:
    """Length of the Gauss-Newton step in sigma, along determined directions only."""
    left = _without_nuisance(linear, variables)
    U, s, _ = np.linalg.svd(left.A * variables.scales, full_matrices=False)
    return float(np.hypot(np.linalg.norm(left.own), np.linalg.norm((U.T @ left.b)[: determined(s)])))


def _without_nuisance(linear: gtsam.GaussianFactorGraph, variables: Variables) -> Eliminated:
    """The linear graph with the nuisance columns eliminated."""
    return eliminate(*_dense(linear, variables.keys), variables.n_columns)


def _held(linear: gtsam.GaussianFactorGraph, step: Floats, variables: Variables) -> Floats | None:
    """A step with the same effect on every row, but none on the core's undetermined directions; None if it is it.

    Damping makes the step short in core and nuisance columns together. That leaves undetermined directions of the core
    where they are only if no nuisance variable could follow them: points that move would drag the base along.
    """
    n = variables.n_columns
    if n == len(step):
        return None
    left = _without_nuisance(linear, variables)
    _, s, Vt = np.linalg.svd(np.vstack([left.A * variables.scales, np.zeros((n, n))]), full_matrices=False)
    loose = Vt[determined(s) :]
    if not len(loose):
        return None
    basis, _ = np.linalg.qr((loose * variables.scales).T)
    drift = basis @ (basis.T @ step[:n])
    held: Floats = step - np.concatenate([drift, left.follow @ drift])
    return held


def _step_length(previous: gtsam.Values, values: gtsam.Values, variables: Variables) -> float:
    return float(np.linalg.norm(variables.step(previous, values) / variables.all_scales))


def _in_words(message: str, variables: Variables) -> str:
    """GTSAM's message in one line, with the key it names as our variable and its parameters."""
    found = re.search(r"Symbol:\s*(\w)(\d+)", message)
    if "ndetermin" in message and found:
        key = gtsam.symbol(found.group(1), int(found.group(2)))
        return f"the linear system has no unique solution near {variables.describe(key)}"
    return " ".join(message.split())
