"""Gauss-Newton steps on the reduced normal system, with GTSAM's Levenberg-Marquardt as the safeguard.

Each iteration decomposes the normal system once (error states and landmarks eliminated, columns in units of what they
may be off). That gives the Gauss-Newton step along the directions that data and priors determine, and the *decrement*:
how far, in sigma, the optimum still is along them (the square root of the cost decrease that the step promises, times
two). Where the cost does not fall by a fair share of what was promised, GTSAM takes a damped step along these
directions. Directions that nothing determines stay where they are: every step is a minimum-norm step.

Rows are whitened at the parameters that are estimated (joint noise, moments of pairs, robust weights). So near the
optimum they are whitened anew after every step, and convergence is judged by the decrement of the rows whitened at the
estimate. The fixed point solves J^T C(x)^-1 r = 0: quasi-likelihood, consistent, without the log-determinant of C.
"""

import time
from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.noise_models import NoiseState, RowNoise
from fg_calib.graph.normal_system import NormalSystem
from fg_calib.graph.problem import (
    Problem,
    frames_only,
    loaded_at,
    mahalanobis_distances,
    noises_at,
    relinearized_at,
    subsampled,
    with_user_factors,
)
from fg_calib.graph.robust import Weighting, constants, cost
from fg_calib.inputs import CalibrationError, Floats, FrozenArrays, Record, SolverError, check_number, checked
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import Robot

FAIR_SHARE = 0.25
"""Share of the promised decrease of the cost that a step must bring."""

PATIENCE = 4
"""How often rows are whitened anew where no step lowers the cost."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING, DAMPING_FACTOR = 1e-3, 1e-15, 1e12, 10.0
"""Damping of damped steps, as a share of the largest curvature: that of the first one, its bounds, and its factor."""

NEAR_ENOUGH = 1e-3
"""Largest decrement that passes when all iterations are spent, [sigma]."""

MAX_AT_ONCE, SAMPLE_SHARE = 200_000, 0.1
"""Residuals above which a share of the measurements is solved before all, and this share."""

SLOWEST = 0.9
"""Largest share of what is left to go that whitening anew is taken to leave each time, without end."""

FULL_STEPS, MIN_SHARE = 20, 0.1
"""Steps that are full ones, and the least share of later ones, where steps to rows whitened anew go in circles."""

COARSE = 1.0
"""Rows are whitened anew once the optimum with the present ones is nearer than this, [sigma]."""


class SolverOptions(Record):
    """Settings of the solver.

    Attributes:
        max_iterations: Steps after which it gives up.
        decrement: Converged when the optimum, with rows whitened at the estimate, is nearer than this, [sigma].
    """

    max_iterations: int = 200
    decrement: float = 3e-7

    def __post_init__(self) -> None:
        check_number("solver: max_iterations", self.max_iterations, least=1.0, whole=True)
        check_number("solver: decrement", self.decrement, least=0.0)


class Iteration(Record):
    """One step of the solver.

    Attributes:
        cost: Half the sum of squared whitened residuals after the step.
        damping: Of a step by Levenberg-Marquardt, as a share of the largest curvature; 0 for an undamped one.
        step: Length of the step, in changes of ordinary size (tolerances, else 1 mm and 1 mrad).
        decrement: How far from the optimum it started, [sigma].
    """

    cost: float
    damping: float
    step: float
    decrement: float


class Solution(FrozenArrays):
    """Result of the solver.

    Attributes:
        problem: The problem solved; its rows are judged at the estimate.
        parameters: The parameter vector there (see `Variables`).
        before: The parameter vector with the arm at nominal, and frame, base and tool alone fitted.
        converged: Whether the optimum was reached.
        message: Why it stopped.
        history: Its steps.
        initial_cost: Cost at `before`.
        cost: Cost at the estimate, whatever the loss.
        weighted_cost: The cost with every measurement by its robust weight.
        seconds: Time taken.
        estimated_noise: Tables and kinds whose noise was estimated; None where it was taken as specified.
        others: Parameter vectors of other optima that the data cannot distinguish from this one.
    """

    problem: Problem
    parameters: Floats
    before: Floats
    converged: bool = False
    message: str = "not solved"
    history: tuple[Iteration, ...] = ()
    initial_cost: float = np.nan
    cost: float = np.nan
    weighted_cost: float = np.nan
    seconds: float = 0.0
    estimated_noise: tuple[tuple[int, str], ...] | None = None
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
        return self.problem.variables.robot.with_values(self.parameters[self.problem.variables.robot_span])

    @cached_property
    def values(self) -> gtsam.Values:
        """GTSAM's values at the estimate of all variables of `problem.graph`, error variables too."""
        return replace(self.problem, start=self.parameters).initial

    @cached_property
    def system(self) -> NormalSystem:
        """The normal system at the estimate."""
        return self.problem.linearize(self.parameters)

    @cached_property
    def objective(self) -> float:
        """Objective at the solution: the cost, or the robust cost."""
        weights, loss = self.problem.state.weights, self.problem.options.loss
        if weights is None:
            return self.cost
        total = self.weighted_cost
        for s, w, noise in zip(self.problem.data.blocks, weights, self.noises, strict=True):
            e, residual_dim = noise.lengths()
            total += float(np.sum((cost(loss, e, constants(loss, residual_dim)) - 0.5 * w * e**2)[s.train]))
        return total

    @cached_property
    def noises(self) -> tuple[RowNoise, ...]:
        """The rows of each block and their noise at the estimate."""
        return noises_at(self.problem, self.parameters)


@checked
def solve(problem: Problem, options: SolverOptions | None = None, *, start: NDArray[Any] | None = None) -> Solution:
    """Estimate the parameters.

    First measurement frame, base and tool alone with the arm at nominal; then, of very many measurements, some, drawn
    evenly; of an arm with error curves one step of all but these; then everything. Only steps of the last are counted.
    Near the optimum rows are whitened anew after every step, and robust weights follow from the residuals there.

    Args:
        problem: The problem, with what was added to its graph.
        options: Settings of the solver; those that the problem's options ask for if None.
        start: A parameter vector to start everything from, as in multi-start, instead of the problem's own start.

    Raises:
        ProblemError: Factors of the problem's graph are missing, or an added variable has no start.
        SolverError: A residual or derivative is not finite, or measurements share too many errors.
    """
    problem = with_user_factors(problem)
    options = options or SolverOptions(problem.options.max_iterations or SolverOptions.max_iterations)
    clock = time.perf_counter()
    with one_blas_thread:
        before = _fit_frames(problem, options) if start is None else np.asarray(start, dtype=np.float64)
        problem = relinearized_at(problem, before) if before is not problem.start else problem
        run = _fit(_started_with_curves_held(_started_by_few(problem, options)), options)
        state, variables, cost = run.problem.state, run.problem.variables, run.cost
        parameters = variables.parameters(variables.values(run.parameters))  # angles in usual range
        if state.weights is not None:
            cost = relinearized_at(run.problem, parameters, replace(state, weights=None)).system.cost
        found = replace(
            run, parameters=parameters, before=before, initial_cost=problem.linearize(before, held=True).cost, cost=cost
        )
        return replace(found, seconds=time.perf_counter() - clock)


def begun_at(solution: Solution, before: Floats) -> Solution:
    """A solution as one that began at another parameter vector, with base, tool and measurement frame fitted there."""
    if solution.before is before:
        return solution
    cost = relinearized_at(solution.problem, before, replace(solution.problem.state, weights=None)).system.cost
    return replace(solution, before=before, initial_cost=cost)


def unsolved(problem: Problem) -> Solution:
    """A problem at its start as if that were its solution: what could be known there."""
    return Solution(problem, problem.start, problem.start)


def _started_by_few(problem: Problem, options: SolverOptions) -> Problem:
    """A problem of very many exchangeable rows, started at the optimum of a few of them: some ten sigma away."""
    if problem.n_residuals <= MAX_AT_ONCE or not problem.is_exchangeable:
        return problem
    few = subsampled(problem, SAMPLE_SHARE)
    try:
        options = replace(options, decrement=max(options.decrement, NEAR_ENOUGH))
        run = _fit(_started_by_few(few, options), options)
    except SolverError:
        return problem
    return relinearized_at(problem, run.parameters) if run.converged else problem


def _started_with_curves_held(problem: Problem) -> Problem:
    """A problem with error curves, started where a step of all but these leads, if that lowers the cost.

    With a robust loss it is not: least squares, without weights yet, would follow gross errors.
    """
    if not problem.curves_are_states or problem.options.loss != "none":
        return problem
    held = problem.linearize(problem.start, held=True)
    if held.decrement <= COARSE:
        return problem
    there = relinearized_at(problem, problem.variables.moved(problem.start, held.step))
    try:
        return there if _Point(there, there.start).system.cost < held.cost else problem
    except SolverError:
        return problem


def _fit_frames(problem: Problem, options: SolverOptions) -> Floats:
    """The parameter vector with measurement frame, base, tool and landmarks fitted, the arm as it is at the start."""
    frames = frames_only(problem)
    if frames is None:
        return problem.start
    options = replace(options, decrement=max(options.decrement, COARSE))
    found = _fit(_started_by_few(frames, options), options).parameters
    return np.concatenate([found, problem.start[len(found) :]])


class _Point(Record):
    """A problem linearised at a parameter vector.

    Attributes:
        problem: The problem.
        parameters: The parameter vector.
    """

    problem: Problem
    parameters: Floats

    @cached_property
    def system(self) -> NormalSystem:
        """The normal system."""
        try:
            return self.problem.linearize(self.parameters)
        except CalibrationError:
            raise
        except Exception as error:  # of LAPACK or an added factor
            raise SolverError(" ".join((str(error) or type(error).__name__).split())) from error

    @property
    def rounding(self) -> float:
        """Part of the decrement that is rounding of the residuals, [sigma]."""
        largest, angle = float(self.system.singular_values.max(initial=0.0)), self.problem.robot.scale_of("rad")
        return 10.0 * float(np.finfo(float).eps) / angle * largest

    @property
    def at_rounding(self) -> bool:
        """Whether rounding of the cost is above the decrease that the step promises."""
        return 0.5 * self.system.decrement**2 <= 10.0 * self.rounding * float(np.sqrt(2.0 * self.system.cost))

    def after(self, step: Floats) -> "_Point":
        """The point after a tangent step."""
        parameters = self.problem.variables.moved(self.parameters, step)
        return _Point(loaded_at(self.problem, parameters), parameters)

    def descend(self, damping: float) -> "tuple[_Point, float, float] | None":
        """Take the next step, undamped if that keeps what it promises: the point, its damping, and the next one.

        None if no step lowers the cost.

        Args:
            damping: Of the first damped step that is tried.
        """
        there = self.after(self.system.step)
        try:
            falls = self.system.cost - there.system.cost >= FAIR_SHARE * 0.5 * self.system.decrement**2
            if falls or (self.at_rounding and there.system.decrement < self.system.decrement):
                return there, 0.0, damping
        except SolverError:
            pass  # so far off that the rows have no derivative there
        return None if self.at_rounding else self._descend_damped(damping)

    def _descend_damped(self, damping: float) -> "tuple[_Point, float, float] | None":
        """Step by GTSAM's Levenberg-Marquardt on a graph of one factor: rows and priors in the singular directions."""
        system, key, start, graph = self.system, gtsam.symbol("S", 0), gtsam.Values(), gtsam.NonlinearFactorGraph()
        n, weights = len(system.coordinates), system.weights

        def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
            y, r = values.atVector(key), np.zeros(n + 1)
            if H is None:
                try:
                    r[0] = np.sqrt(2.0 * self._along(y).system.cost)
                except SolverError:
                    r[0] = np.sqrt(np.finfo(float).max) / 2.0
            else:  # at the start alone
                H[0], r[:n] = np.vstack([np.diag(weights), np.zeros((1, n))]), -system.coordinates
                r[n] = np.sqrt(max(system.chi_square, 0.0))
            return r

        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(n + 1), [key], evaluate))
        start.insert(key, np.zeros(n))
        params = gtsam.LevenbergMarquardtParams()  # damping of all directions alike: they are in units of what they
        params.setLinearSolverType("MULTIFRONTAL_QR")  # may be off
        params.setlambdaInitial(damping)
        params.setlambdaFactor(DAMPING_FACTOR)
        params.setlambdaUpperBound(MOST_DAMPING)
        params.setRelativeErrorTol(1e-13)  # no search for a lambda once the cost's own rounding decides
        params.setAbsoluteErrorTol(0.0)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
        optimizer.iterate()
        if not optimizer.error() < system.cost or optimizer.lambda_() >= MOST_DAMPING:
            return None
        following = max(optimizer.lambda_(), LEAST_DAMPING)
        return self._along(optimizer.values().atVector(key)), DAMPING_FACTOR * following, following

    def _along(self, y: Floats) -> "_Point":
        return self.after(self.system.spread(self.system.weights * y))


def _fit(problem: Problem, options: SolverOptions) -> Solution:
    """Least squares from the problem's start to the fixed point of whitening.

    Rows stay as they are whitened until their optimum is near; then each step is one to rows whitened where it leads.
    With a robust loss the first weights are those of the residuals at the start: gross errors would lead least squares
    astray. Weights that the problem has are those of another optimum near by.
    """
    weighted, history, damping, tries = problem.state.weights is not None, list[Iteration](), FIRST_DAMPING, 0
    weighting = Weighting(problem.options.loss, final=weighted)
    start = problem.variables.with_held(problem.start)
    if problem.options.loss != "none" and not weighted:
        problem = relinearized_at(problem, start, _learn(problem, start, weighting)[0])
    here, converged, message, share = _Point(problem, start), False, "", 1.0
    del problem  # a million pairs once less in memory
    while not message and len(history) < options.max_iterations:
        was, near, there = here, here.system.decrement <= COARSE, here
        if not near and (found := here.descend(damping)) is not None:
            here, used, damping = found
            history.append(_iteration(was, here, used))
            continue
        stepped = near and here.system.decrement > max(options.decrement, here.rounding)
        there = here.after(share * here.system.step) if stepped else here
        state, final = _learn(here.problem, there.parameters, weighting)
        here = _Point(relinearized_at(here.problem, there.parameters, state), there.parameters)
        left = here.system.decrement
        if stepped:  # each step leaves the same share of what was left, without end
            history.append(_iteration(was, here, 0.0))
            circling = len(history) > FULL_STEPS and left > SLOWEST * was.system.decrement
            share = max(MIN_SHARE, 0.5 * share) if circling else share
            left /= 1.0 - min(left / was.system.decrement, SLOWEST)
        tries = 0 if near else tries + 1
        if final and left <= max(options.decrement, here.rounding):
            converged, goal = True, max(options.decrement, here.rounding)
            message = f"converged: less than {goal:.0e} sigma from the optimum"
        elif not near and was.at_rounding:
            converged = True
            message = f"converged to rounding: no step lowers the cost, {here.system.decrement:.1e} sigma left"
        elif tries == PATIENCE:
            message = (
                f"not converged: no step lowers the cost although {here.system.decrement:.1e} sigma are left to go"
            )
    if not message:
        converged = here.system.decrement <= NEAR_ENOUGH
        most = f"{options.max_iterations} iterations, the most allowed"
        left_to_go = f"{here.system.decrement:.1e} sigma"
        message = f"not converged: {most}, and {left_to_go} left to go"
        message = f"converged: {left_to_go} from the optimum after {most}" if converged else message
    if converged and here.rounding > NEAR_ENOUGH:
        hidden = f"rounding hides the optimum, by {here.rounding:.0e} sigma"
        converged, message = False, f"not converged: {hidden}: noise, tolerances or lengths are out of all proportion"
    message, cost = message if here.problem.variables.keys else "nothing to fit", here.system.cost
    run = Solution(here.problem, here.parameters, start, converged, message, tuple(history))
    return replace(run, cost=cost, weighted_cost=cost)


def _iteration(before: _Point, after: _Point, damping: float) -> Iteration:
    variables = before.problem.variables
    taken = variables.step(before.parameters, after.parameters) / variables.all_scales
    return Iteration(after.system.cost, damping, float(np.linalg.norm(taken)), before.system.decrement)


def take_steps(problem: Problem, most: int) -> Floats:
    """The parameter vector after some steps from the start, rows whitened as there: for a quick look.

    Args:
        problem: The problem.
        most: Steps at most; fewer where one promises less than a thousandth of the cost.
    """
    here, damping = _Point(problem, problem.start), FIRST_DAMPING
    for _ in range(most):
        found = here.descend(damping) if here.system.decrement**2 > 2e-3 * here.system.cost else None
        if found is None:
            break
        here, _, damping = found
    return here.parameters


def _learn(problem: Problem, parameters: Floats, weighting: Weighting) -> tuple[NoiseState, bool]:
    """Estimate the noise from the residuals, and whether the loss has its final form."""
    if problem.options.loss == "none":
        return problem.state, True
    blocks, found = problem.data.blocks, mahalanobis_distances(problem, parameters)
    test = np.concatenate([s.test for s in blocks])
    e, residual_dim = (np.where(test, 0, np.concatenate(each)) for each in zip(*found, strict=True))
    weights, final = weighting.update(e, residual_dim)
    each = tuple(np.split(weights, np.cumsum([s.n for s in blocks])[:-1]))
    return replace(problem.state, weights=each), final
