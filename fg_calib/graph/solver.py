"""Gauss-Newton steps on the reduced normal system, with GTSAM's Levenberg-Marquardt as the safeguard.

Each iteration decomposes the normal system once (error states and landmarks eliminated, columns in units of what they
may be off). That gives the Gauss-Newton step along the directions that data and priors determine, and the *decrement*:
how far, in sigma, the optimum still is along them (the square root of the cost decrease that the step promises, times
two). Where the cost does not fall by a fair share of what was promised, GTSAM takes a damped step on the reduced graph.
Directions that nothing determines stay where they are: every step is a minimum-norm step. Near the optimum, where
rounding of the cost exceeds what is left to gain, the decrement judges: it must fall.

Rows are whitened at the parameters that are estimated (joint noise, moments of pairs, robust weights). So near the
optimum they are whitened anew after every step, and convergence is judged by the decrement of the rows whitened at the
estimate. The fixed point solves J^T C(x)^-1 r = 0: quasi-likelihood, consistent, without the log-determinant of C.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.factors import measurement_factors
from fg_calib.graph.noise_models import NoiseState, RowNoise
from fg_calib.graph.problem import (
    Problem,
    cost_at,
    frames_only,
    joint_errors,
    linear_system,
    mahalanobis_distances,
    noises_at,
    reduced_graph,
    relinearized_at,
    subsampled,
    with_user_factors,
)
from fg_calib.graph.robust import Weighting, constants, cost
from fg_calib.graph.variables import Variables
from fg_calib.inputs import CalibrationError, Floats, FrozenArrays, Options, SolverError, check_number, checked
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import Robot

FAIR_SHARE = 0.25
"""Share of the promised decrease of the cost that an undamped step must bring."""

SHORTER = 0.5
"""Share of a step that the next one may be, where the cost does not judge."""

PATIENCE = 4
"""Undamped steps in which the cost may rise before it has fallen."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-15, 1e12
"""Damping of damped steps, as a share of each column's own curvature: that of the first one, and its bounds."""

NEAR_ENOUGH = 1e-3
"""What may be left to go when all iterations are spent, [sigma]."""

MAX_AT_ONCE, SAMPLE_SHARE = 200_000, 0.1
"""Of more residuals than the first this share of the measurements is solved before all are."""

SLOWEST = 0.9
"""Largest share of what is left to go that whitening anew is taken to leave each time, without end."""

COARSE = 0.3
"""Rows are whitened anew once the optimum with the present ones is nearer than this, [sigma]."""


@dataclass(frozen=True)
class SolverOptions:
    """Settings of the solver.

    Attributes:
        max_iterations: Steps after which it gives up.
        decrement: Converged when the optimum, with rows whitened at the estimate, is nearer than this, [sigma].
    """

    max_iterations: int = 200
    decrement: float = 3e-7

    def __post_init__(self) -> None:
        for f in fields(self):
            least, whole = float(f.name == "max_iterations"), f.name.startswith("max_")
            check_number(f"solver: {f.name}", getattr(self, f.name), least=least, whole=whole)


@dataclass(frozen=True)
class Iteration:
    """One step of the solver.

    Attributes:
        cost: Half the sum of squared whitened residuals after the step.
        damping: Of a step by Levenberg-Marquardt, as a share of each column's own curvature; 0 for an undamped one.
        step: Length of the step, in changes of ordinary size (tolerances, else 1 mm and 1 mrad).
        decrement: How far from the optimum it started, [sigma].
    """

    cost: float
    damping: float
    step: float
    decrement: float


@dataclass(frozen=True)
class ToleranceScale:
    """A factor on the tolerances stated of a group of parameters, estimated with them.

    Attributes:
        group: What shares the scale: `a`, `theta`, `tool`; or a joint's name.
        parameters: The parameters.
        scale: Tolerance estimated over tolerance stated.
        low: Lower end of its 95 % interval.
        high: Upper end.
        seen: How many of the parameters' corrections the data tell of.
    """

    group: str
    parameters: tuple[str, ...]
    scale: float
    low: float
    high: float
    seen: float


@dataclass(frozen=True)
class ToleranceScales(FrozenArrays):
    """The scales of all groups.

    Attributes:
        scales: Group by group.
        added: What not knowing them adds to the covariance of the estimate, shape (n_columns, n_columns).
    """

    scales: tuple[ToleranceScale, ...]
    added: Floats


@dataclass(frozen=True)
class Solution(FrozenArrays):
    """What the solver found.

    Attributes:
        problem: The problem solved; its rows are judged at the estimate.
        parameters: The parameter vector there (see `Variables`).
        before: The parameter vector with the arm at nominal, and frame, base and tool alone fitted.
        converged: Whether the optimum was reached.
        message: Why it stopped.
        history: Its steps.
        initial_cost: Cost at `before`.
        cost: Cost at the estimate, whatever the loss.
        weighted_cost: The same with every measurement by its robust weight.
        seconds: Time taken.
        estimated_noise: Tables and kinds whose noise was estimated; None where it was taken as specified.
        estimated_tolerances: Scales on the robot's tolerances; None where they are taken as specified.
        others: Parameter vectors of other optima that the data cannot distinguish from this one.
    """

    problem: Problem
    parameters: Floats
    before: Floats
    converged: bool
    message: str
    history: tuple[Iteration, ...]
    initial_cost: float
    cost: float
    weighted_cost: float
    seconds: float
    estimated_noise: tuple[tuple[int, str], ...] | None = None
    estimated_tolerances: ToleranceScales | None = None
    others: tuple[Floats, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        """All but what follows from the rest."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __repr__(self) -> str:
        costs = f"{self.iterations} iterations, cost {self.initial_cost:.6g} -> {self.cost:.6g}"
        return f"Solution of {self.problem.robot.name!r}: {self.message}\n  {costs}"

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return len(self.history)

    @property
    def robot(self) -> Robot:
        """The calibrated robot: nominal, with the estimate's values."""
        variables = self.problem.variables
        return variables.robot.with_values(self.parameters[variables.robot_span])

    @cached_property
    def values(self) -> gtsam.Values:
        """GTSAM's values at the estimate of all variables of `problem.graph`, error variables too."""
        problem, variables = self.problem, self.problem.variables
        values = variables.values(self.parameters)
        values.insert(measurement_factors(problem.rows, variables, variables.at(self.parameters))[1])
        return values

    @cached_property
    def objective(self) -> float:
        """What it is an optimum of: the cost; with a robust loss by what that has each measurement cost."""
        weights, loss = self.problem.state.weights, self.problem.options.loss
        if weights is None:
            return self.cost
        total = self.weighted_cost
        distances = mahalanobis_distances(self.problem, self.parameters)
        for s, w, (e, residual_dim) in zip(self.problem.data.blocks, weights, distances, strict=True):
            more = cost(loss, e, constants(loss, residual_dim)) - 0.5 * w * e**2
            total += float(np.sum(more[s.train]))
        return total

    @cached_property
    def noises(self) -> tuple[RowNoise, ...]:
        """The rows of each series and their noise at the estimate, at the readings."""
        return noises_at(self.problem, self.parameters, at_readings=True)


@checked
def solve(problem: Problem, options: SolverOptions | None = None, *, start: NDArray[Any] | None = None) -> Solution:
    """Estimate the parameters.

    First measurement frame, base and tool alone with the arm at nominal, then everything; of very many measurements at
    first some, drawn evenly, whose steps are not counted. Near the optimum rows are whitened anew after every step,
    robust weights follow from the residuals there, and estimated joint errors from the posterior of the error states.

    Args:
        problem: The problem, with what was added to its graph.
        options: Settings of the solver; those that the problem's options ask for if None.
        start: A parameter vector to start everything from, as in multi-start, instead of the problem's own start.

    Raises:
        ProblemError: Factors of the problem's graph are missing, or an added variable has no start.
        SolverError: GTSAM could not solve a step at all.
    """
    problem = with_user_factors(problem)
    options = options or options_of(problem.options)
    clock = time.perf_counter()
    with one_blas_thread:
        before = _fit_frames(problem, options) if start is None else np.asarray(start, dtype=np.float64)
        if before is not problem.start:
            problem = relinearized_at(problem, before)
        if not problem.variables.keys:
            return _taken_as_it_is(problem, clock)
        run = _fit(_started_by_few(problem, options), options)
        initial_cost = cost_at(problem, problem.start)
        return _solution(run, before, initial_cost, clock)


def unsolved(problem: Problem) -> Solution:
    """A problem at its start as if that were its solution: what could be known there."""
    return Solution(
        *(problem, problem.start, problem.start),
        converged=False,
        message="not solved",
        history=(),
        initial_cost=np.nan,
        cost=np.nan,
        weighted_cost=np.nan,
        seconds=0.0,
    )


def options_of(options: Options) -> SolverOptions:
    """The solver's settings that a calibration's options ask for."""
    most = options.max_iterations
    return SolverOptions() if most is None else SolverOptions(max_iterations=most)


def _started_by_few(problem: Problem, options: SolverOptions) -> Problem:
    """A problem of very many rows, started at the optimum of a few of them: some ten sigma away."""
    few = subsampled(problem, SAMPLE_SHARE) if problem.n_residuals > MAX_AT_ONCE else None
    if few is None:
        return problem
    try:
        options = replace(options, decrement=max(options.decrement, NEAR_ENOUGH))
        run = _fit(_started_by_few(few, options), options)
    except SolverError:
        return problem
    return relinearized_at(problem, run.parameters) if run.converged else problem


def _fit_frames(problem: Problem, options: SolverOptions) -> Floats:
    """The parameter vector with measurement frame, base, tool and landmarks fitted, the arm as it is at the start."""
    frames = frames_only(problem)
    if frames is None:
        return problem.start
    options = replace(options, decrement=max(options.decrement, COARSE))
    found = _fit(_started_by_few(frames, options), options).parameters
    return np.concatenate([found, problem.start[len(found) :]])


def _fit(problem: Problem, options: SolverOptions) -> _Descent:
    """Least squares from the problem's start to the fixed point of whitening.

    Rows stay as they are whitened until their optimum is near; then each step is one to rows whitened
    where it leads. With a robust loss the first weights are those of the residuals at the start: gross errors would
    lead least squares astray.
    """
    weighting = Weighting(problem.options.loss)
    if problem.options.loss != "none":
        problem = relinearized_at(problem, problem.start, _learn(problem, problem.start, weighting)[0])
    run, tries = _Descent(problem, options), 0
    while tries < PATIENCE:
        arrived, was = run.descend(COARSE), run.here.decrement
        if run.exhausted:
            run.give_up()
            break
        step = run.here.system.step if arrived and was > run.least else None
        parameters = run.parameters_after(step)
        state, final = _learn(run.problem, parameters, weighting)
        run.go_on_with(relinearized_at(run.problem, parameters, state), step)
        left = run.here.decrement
        if step is not None:  # each step leaves the same share of what was left, without end
            left /= 1.0 - min(left / was, SLOWEST)
        if final and left <= run.least:
            run.descend(run.least)
            break
        tries = 0 if arrived else tries + 1
    run.judge_rounding()
    return run


def _learn(problem: Problem, parameters: Floats, weighting: Weighting) -> tuple[NoiseState, bool]:
    """What the residuals at some parameters say of the noise, and whether the loss has its final form."""
    state, final = problem.state, True
    if problem.options.loss != "none":
        found = mahalanobis_distances(problem, parameters)
        test = np.concatenate([s.test for s in problem.data.blocks])
        e, residual_dim = (np.where(test, 0, np.concatenate(each)) for each in zip(*found, strict=True))
        weights, final = weighting.update(e, residual_dim)
        ends = np.cumsum([s.n for s in problem.data.blocks])[:-1]
        state = replace(state, weights=tuple(np.split(weights, ends)))
    if state.joint_errors is not None:
        state = replace(state, joint_errors=joint_errors(problem, parameters))
    return state, final


class _Point:
    """A problem linearised at a parameter vector.

    Attributes:
        parameters: The parameter vector.
        system: The normal system.
        cost: Half the sum of squared whitened residuals.
        decrement: How far the optimum still is, [sigma].
        rounding: What rounding of the residuals makes of the decrement, [sigma].
        at_rounding: Whether rounding of the cost is above the decrease that the step promises.
    """

    def __init__(self, problem: Problem, parameters: Floats) -> None:
        self.parameters = parameters
        with _in_one_line(problem.variables):
            self.system = linear_system(problem, parameters)
        self.cost, self.decrement = self.system.cost, self.system.decrement
        largest, angle = float(self.system.singular_values.max(initial=0.0)), problem.robot.scale_of("rad")
        self.rounding = 10.0 * float(np.finfo(float).eps) / angle * largest
        self.at_rounding = 0.5 * self.decrement**2 <= 10.0 * self.rounding * np.sqrt(2.0 * self.cost)


class _Descent:
    """A descent from a problem's start, on one set of whitened rows after the other.

    Attributes:
        problem: The problem with the rows as they are whitened now.
        here: Where the descent has arrived.
        history: The steps taken.
        converged: Whether the last descent arrived.
        message: Why it stopped.
    """

    def __init__(self, problem: Problem, options: SolverOptions) -> None:
        self.problem = problem
        self.history: list[Iteration] = []
        self.converged = False
        self.message = ""
        self._options = options
        self._damping = FIRST_DAMPING
        at, cost = problem.variables.at(problem.start), np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                start = problem.variables.values(problem.start)  # what is held is at nominal, wherever the start has it
                self.here = _Point(problem, problem.variables.parameters(start))
                cost = self.here.cost
            except SolverError:
                cost = sum(rows.squared_norm(at) for rows in problem.rows)
                if np.isfinite(cost):
                    raise
        if not np.isfinite(cost):
            raise SolverError(f"the cost at the start is {cost}: the measurements or the robot hold absurd numbers")

    @property
    def parameters(self) -> Floats:
        """The parameter vector where the descent has arrived."""
        return self.here.parameters

    @property
    def least(self) -> float:
        """The decrement that counts as arrived, [sigma]: what the options say, or rounding."""
        return max(self._options.decrement, self.here.rounding)

    @property
    def exhausted(self) -> bool:
        """Whether all iterations have been spent."""
        return len(self.history) >= self._options.max_iterations

    def parameters_after(self, step: Floats | None) -> Floats:
        """The parameter vector after a step, or where the descent has arrived."""
        return self.parameters if step is None else self.problem.variables.moved(self.parameters, step)

    def go_on_with(self, problem: Problem, step: Floats | None) -> None:
        """Take other rows, after a step or at the same place."""
        there = _Point(problem, self.parameters_after(step))
        self.problem = problem
        if step is None:
            self.here = there
        else:
            self._take(there, 0.0)

    def descend(self, goal: float) -> bool:
        """Step until the optimum of these rows is nearer than `goal`, [sigma]; whether it is."""
        self.converged, stuck = self.here.decrement <= goal, False
        while not (self.converged or stuck or self.exhausted):
            path, damping = self._undamped(), 0.0
            if not path:
                path, damping = self._damped(), self._damping
            stuck = not path
            for there in path:
                self._take(there, damping)
            self.converged = self.here.at_rounding if stuck else self.here.decrement <= goal
        if self.converged and not stuck:
            self.message = f"converged: less than {goal:.0e} sigma from the optimum"
        elif self.converged:
            self.message = f"converged to rounding: no step lowers the cost, {self._left} left"
        elif stuck:
            self.message = f"not converged: no step lowers the cost although {self._left} are left to go"
        else:
            self.give_up()
        return self.converged

    def _take(self, there: _Point, damping: float) -> None:
        variables = self.problem.variables
        taken = variables.step(self.parameters, there.parameters)
        length = float(np.linalg.norm(taken / variables.all_scales))
        self.history.append(Iteration(there.cost, damping, length, self.here.decrement))
        self.here = there

    def judge_rounding(self) -> None:
        """Not converged is also where rounding hides the optimum by more than may be left."""
        if self.converged and self.here.rounding > NEAR_ENOUGH:
            self.converged = False
            hidden = f"rounding hides the optimum, by {self.here.rounding:.0e} sigma"
            self.message = f"not converged: {hidden}: noise, tolerances or lengths are out of all proportion"

    def give_up(self) -> None:
        """Say that all iterations have been spent, and whether that matters."""
        self.converged = self.here.decrement <= NEAR_ENOUGH
        arrived = "converged" if self.converged else "not converged"
        self.message = f"{arrived}: {self._options.max_iterations} iterations, {self._left} left to go"

    @property
    def _left(self) -> str:
        return f"{self.here.decrement:.1e} sigma"

    def _undamped(self) -> list[_Point]:
        """Where Gauss-Newton steps lead; nothing if they do not keep what they promise.

        A valley that is weakly determined may be curved: a step along it leaves it, and the next ones come back. So the
        cost may rise as long as the steps that follow are ever shorter.
        """
        path: list[_Point] = []
        here = there = self.here
        for _ in range(PATIENCE):
            last = there
            try:
                there = _Point(self.problem, self.problem.variables.moved(last.parameters, last.system.step))
            except SolverError:
                return []  # so far off that the rows have no derivative there
            path.append(there)
            if here.at_rounding:
                return path if there.decrement < here.decrement else []
            if here.cost - there.cost >= FAIR_SHARE * 0.5 * here.decrement**2:
                return path
            if here.decrement <= COARSE and there.decrement <= SHORTER * here.decrement:
                return path  # so near, the whitening of these rows is not exact enough for the cost to judge
            if len(path) > 1 and there.decrement >= SHORTER * last.decrement:
                return []
        return []

    def _damped(self) -> list[_Point]:
        """Where GTSAM's next damped step leads, undetermined directions held; nothing if none lowers the cost."""
        here, graph, variables = self.here, reduced_graph(self.problem), self.problem.variables
        start, params = variables.values(here.parameters), levenberg_marquardt_params(self._damping)
        with _in_one_line(variables):
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
            cost = optimizer.error()
            optimizer.iterate()
        if not optimizer.error() < cost or optimizer.lambda_() >= MOST_DAMPING:
            return []
        self._damping = max(optimizer.lambda_(), LEAST_DAMPING)
        there = variables.parameters(optimizer.values())
        held = variables.moved(here.parameters, here.system.without_null_space(variables.step(here.parameters, there)))
        with _in_one_line(variables):
            lower = graph.error(variables.values(held)) < cost
        return [_Point(self.problem, held if lower else there)]


def _solution(run: _Descent, before: Floats, initial_cost: float, clock: float) -> Solution:
    cost, problem, variables = run.here.cost, run.problem, run.problem.variables
    parameters = variables.parameters(variables.values(run.parameters))  # angles of poses in their usual range
    if problem.state.weights is not None:
        unweighted = relinearized_at(problem, parameters, replace(problem.state, weights=None))
        cost = cost_at(unweighted, parameters)
    return Solution(
        problem=problem,
        parameters=parameters,
        before=before,
        converged=run.converged,
        message=run.message,
        history=tuple(run.history),
        initial_cost=initial_cost,
        cost=cost,
        weighted_cost=run.here.cost,
        seconds=time.perf_counter() - clock,
    )


def _taken_as_it_is(problem: Problem, clock: float) -> Solution:
    """The "solution" of an evaluation that has nothing to fit; robust weights are those of the rows as they are."""
    weighted, final, weighting = problem, problem.options.loss == "none", Weighting(problem.options.loss)
    while not final:
        state, final = _learn(problem, problem.start, weighting)
        weighted = relinearized_at(problem, problem.start, state)
    at = problem.variables.at(problem.start)
    cost, weighted_cost = (0.5 * sum(rows.squared_norm(at) for rows in p.rows) for p in (problem, weighted))
    return Solution(
        problem=weighted,
        parameters=problem.start,
        before=problem.start,
        converged=True,
        message="nothing to fit",
        history=(),
        initial_cost=cost,
        cost=cost,
        weighted_cost=weighted_cost,
        seconds=time.perf_counter() - clock,
    )


@contextmanager
def _in_one_line(variables: Variables) -> Iterator[None]:
    """What GTSAM, LAPACK or an added factor raises in the block becomes a `SolverError`."""
    try:
        yield
    except CalibrationError:
        raise
    except Exception as error:
        raise SolverError(_in_words(str(error) or type(error).__name__, variables)) from error


def _in_words(message: str, variables: Variables) -> str:
    """GTSAM's message in one line, with the key it names as our variable and its parameters."""
    found = re.search(r"Symbol:\s*(\w)(\d+)", message)
    if "ndetermin" in message and found:
        key = gtsam.symbol(found.group(1), int(found.group(2)))
        return f"the linear system has no unique solution near {variables.describe(key)}"
    return " ".join(message.split())


def levenberg_marquardt_params(damping: float = FIRST_DAMPING) -> gtsam.LevenbergMarquardtParams:
    """Options for GTSAM's own optimiser that work on these graphs: QR, and damping in each column's own unit.

    With its defaults GTSAM returns the start without a word where weak priors hold directions.

    Args:
        damping: Of the first step, as a share of each column's own curvature.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setDiagonalDamping(True)
    parameters.setlambdaInitial(damping)
    parameters.setlambdaFactor(10.0)
    parameters.setlambdaUpperBound(MOST_DAMPING)
    parameters.setRelativeErrorTol(1e-13)  # no search for a lambda once the cost's own rounding decides
    parameters.setAbsoluteErrorTol(0.0)
    return parameters
