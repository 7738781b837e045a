"""Gauss-Newton steps with GTSAM's Levenberg-Marquardt as the safeguard, and a status of our own.

The graph is GTSAM's. Each iteration linearises it and decomposes the dense system once (singular values, nuisance
columns eliminated, columns in units of the arm's geometry). That gives the Gauss-Newton step along the directions that
data and priors determine, and the *decrement*: how far, in sigma, the optimum still is along them (the square root of
the cost decrease that the step promises, times two). Where the cost does not fall by a fair share of what was promised,
GTSAM takes a damped step instead. Directions that nothing determines stay where they are: every step is a minimum-norm
step. Near the optimum, where rounding of the cost is larger than what is left to gain, the decrement judges: it must
fall.

Rows are whitened at the parameters that are estimated (joint noise, errors that pairs share, robust weights), so that
the optimum is one of frozen whitening only if whitening anew, there, leaves nothing to go. That is how convergence is
judged: by the decrement of the problem whitened at the estimate itself.

References:
    Anderson (1965), Iterative procedures for nonlinear integral equations. J. ACM 12(4): the extrapolation.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays
from fg_calib.errors import SolverError
from fg_calib.graph.extension import with_added
from fg_calib.graph.linearised import Linearised, in_one_line
from fg_calib.graph.noise import NoiseState, RowNoise
from fg_calib.graph.problem import (
    Problem,
    depends,
    frames_only,
    joint_errors,
    mahalanobis_distances,
    noises_at,
    reweighted_at,
    same_rows,
    some_rows,
    started_at,
)
from fg_calib.graph.robust import Weighting, constants, cost
from fg_calib.graph.tolerances import ToleranceScales
from fg_calib.options import Options, check_number
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

FAIR_SHARE = 0.25
"""Share of the promised decrease of the cost that an undamped step must bring."""

SHORTER = 0.5
"""Share of a step that the next one may be, where the cost does not judge."""

PATIENCE = 4
"""Undamped steps in which the cost may rise before it has fallen."""

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-15, 1e12
"""Damping of damped steps, as a share of each column's own curvature: that of the first one, and its bounds."""

SHORT = 30
"""Steps after which a descent from another start is given up: it wanders, and was only worth a try."""

SLOW = 0.3
"""Steps whose decrement falls by less than this factor are extrapolated."""

SLOWEST = 0.9
"""Largest share of what is left to go that whitening anew is taken to leave each time, without end."""

FARTHEST = 30.0
"""An extrapolated step is at most so many times as long as the Gauss-Newton step, [sigma over sigma]."""

BACK = 0.1
"""A descent from another start that ends this near to where one has been is back there, [sigma]."""

SPREAD_ROUNDS = 2
"""Times that rows of pairs are bent by what the parameters may be off there; then that stays as it is."""

NEAR_ENOUGH = 1e-3
"""What may be left to go when all iterations are spent, [sigma]."""

FOLDED_STEPS, FOLDED_TRIES = 20, 8
"""Steps after which rows of pairs are whitened anew although their optimum has not been reached, and how often. Where a
length is measured below 0 or an angle beyond half a turn, but for its noise, rows as they are whitened elsewhere have
their least cost at the kink itself, where steps arrive at nothing; whitened there they are smooth."""

MANY_ROWS, FEW = 200_000, 0.1
"""Of more residuals than the first this share of the measurements is solved before all are."""

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
class Solution(FrozenArrays):
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
        estimated_noise: Tables and kinds whose noise was estimated (see `noise`); None where it was taken as stated.
        estimated_tolerances: Scales on the robot's tolerances; None where they are taken as stated.
        others: Parameter vectors of other optima that the data cannot tell from this one (see `restarts`).
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
    estimated_noise: tuple[tuple[int, str], ...] | None = None
    estimated_tolerances: ToleranceScales | None = None
    others: tuple[Floats, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        """All but what follows from the rest."""
        return {name: value for name, value in self.__dict__.items() if name not in ("noises", "objective")}

    def __repr__(self) -> str:
        costs = f"{self.iterations} iterations, cost {self.initial_cost:.6g} -> {self.cost:.6g}"
        return f"Solution of {self.problem.robot.name!r}: {self.message}\n  {costs}"

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return len(self.history)

    @cached_property
    def objective(self) -> float:
        """What it is an optimum of: the cost; with a robust loss by what that has each measurement cost."""
        weights, loss = self.problem.state.weights, self.problem.options.loss
        if weights is None:
            return self.cost
        total = self.weighted_cost
        distances = mahalanobis_distances(self.problem, self.parameters)
        for s, w, (e, residual_dim) in zip(self.problem.data.series, weights, distances, strict=True):
            more = cost(loss, e, constants(loss, residual_dim)) - 0.5 * w * e**2
            total += float(np.sum(more[s.train]))
        return total

    @cached_property
    def noises(self) -> tuple[RowNoise, ...]:
        """The rows of each series and their noise at the estimate, at the readings."""
        return noises_at(self.problem, self.parameters, at_readings=True)


@checked
def solve(problem: Problem, options: SolverOptions | None = None) -> Solution:
    """Estimate the parameters.

    First measurement frame, base and tool alone with the arm at nominal, then everything; of very many measurements at
    first some, drawn evenly, whose steps are not counted. Each time that the optimum is
    near, the rows are judged and whitened at the estimate, robust weights follow from the residuals there and joint
    errors, where they are estimated, from what the rows say of them; the solver goes on with the new rows until they
    leave nothing to go.

    Raises:
        ProblemError: Factors of the problem's graph are missing, or an added variable has no start.
        SolverError: GTSAM could not solve a step at all.
    """
    problem = with_added(problem)
    options = options or options_of(problem.options)
    clock = time.perf_counter()
    with one_blas_thread:
        before = _before(problem, options)
        if before is not problem.start:
            problem = reweighted_at(problem, before)
        if not problem.variables.keys:
            return _taken_as_it_is(problem, clock)
        started = _started_near(problem, options)
        run = _fit(started, options, near=started is not problem)
        initial_cost = run.initial_cost if started is problem else problem.graph.error(problem.initial)
        return _solution(run, before, initial_cost, clock)


def _started_near(problem: Problem, options: SolverOptions) -> Problem:
    """A problem of very many rows, started at the optimum of a few of them: some ten sigma away."""
    few = some_rows(problem, FEW) if problem.n_residuals > MANY_ROWS else None
    if few is None:
        return problem
    try:
        options = replace(options, decrement=max(options.decrement, NEAR_ENOUGH))
        started = _started_near(few, options)
        run = _fit(started, options, near=started is not few)
    except SolverError:
        return problem
    return reweighted_at(problem, run.parameters) if run.converged else problem


def unsolved(problem: Problem) -> Solution:
    """A problem at its start as if that were its solution: what could be known there."""
    return Solution(
        *(problem, problem.initial, problem.start, problem.start),
        converged=False,
        message="not solved",
        history=(),
        initial_cost=np.nan,
        cost=np.nan,
        weighted_cost=np.nan,
        seconds=0.0,
    )


def _before(problem: Problem, options: SolverOptions) -> Floats:
    """The parameter vector with measurement frame, base, tool and unknowns fitted, the arm as it is at the start."""
    frames = frames_only(problem)
    if frames is None:
        return problem.start
    options = replace(options, decrement=max(options.decrement, COARSE))
    started = _started_near(frames, options)
    found = _fit(started, options, near=started is not frames).parameters
    return np.concatenate([found, problem.start[len(found) :]])


def options_of(options: Options) -> SolverOptions:
    """The solver's settings that a calibration's options ask for."""
    most = options.max_iterations
    return SolverOptions() if most is None else SolverOptions(max_iterations=most)


def solve_from(solution: Solution, start: Floats, most: float, options: SolverOptions | None = None) -> Solution | None:
    """The descent on a solution's problem from another start.

    Args:
        solution: What was found before; `before` and the initial cost stay as they are.
        start: The parameter vector to start from.
        most: Cost of an optimum that is of no interest, with the rows whitened as they are in the solution. With a
            robust loss, whose weights follow from where one is, it says nothing.
        options: Settings of the solver.

    Returns:
        None if the descent leads nowhere, above `most` or back to where the solution is.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    clock, options = time.perf_counter(), options or options_of(solution.problem.options)
    with one_blas_thread:
        problem = started_at(solution.problem, start)
        if problem.options.loss == "none":
            rough = _Run(problem, replace(options, max_iterations=min(SHORT, options.max_iterations)))
            if not rough.descend(COARSE) or rough.here.cost >= most:
                return None
            if rough.here.decrement_to(solution.values) < BACK:
                return None
            problem = reweighted_at(problem, rough.parameters)
        run = _fit(problem, options)
        found = _solution(run, solution.before, solution.initial_cost, clock)
        return _estimated_as(solution, found)


def solve_image(
    solution: Solution, problem: Problem, before: Floats, most: float, options: SolverOptions | None = None
) -> Solution | None:
    """The descent on another problem of the same measurements, if its first step promises to be worth it.

    Args:
        solution: What was found before.
        problem: The other problem, started near to where that is.
        before: Its parameter vector with the arm at nominal, to fit measurement frame, base and tool from.
        most: Cost of an optimum that is of no interest.
        options: Settings of the solver.

    Returns:
        None if the descent leads nowhere, or above `most`.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    clock, options = time.perf_counter(), options or options_of(problem.options)
    with one_blas_thread:
        rough = _Run(problem, replace(options, max_iterations=min(SHORT, options.max_iterations)))
        if rough.here.cost - 0.5 * rough.here.decrement**2 >= most:
            return None
        if not rough.descend(COARSE) or rough.here.cost >= most:
            return None
        run = _fit(reweighted_at(problem, rough.parameters), options)
        first = reweighted_at(problem, before)
        before = _before(first, options)
        initial_cost = reweighted_at(first, before).graph.error(first.variables.values(before))
        return _estimated_as(solution, _solution(run, before, initial_cost, clock))


def _estimated_as(solution: Solution, other: Solution) -> Solution:
    """Another solution, with noise and tolerances that were estimated at the first."""
    return replace(other, estimated_noise=solution.estimated_noise, estimated_tolerances=solution.estimated_tolerances)


def _solution(run: _Run, before: Floats, initial_cost: float, clock: float) -> Solution:
    cost, weights = run.here.cost, run.problem.state.weights
    if weights is not None:
        stated = reweighted_at(run.problem, run.parameters, replace(run.problem.state, weights=None))
        cost = stated.graph.error(run.here.values)
    constant = _constant_cost(run.problem)
    return Solution(
        problem=run.problem,
        values=run.here.values,
        parameters=run.parameters,
        before=before,
        converged=run.converged,
        message=run.message,
        history=tuple(run.history),
        initial_cost=initial_cost + constant,
        cost=cost + constant,
        weighted_cost=run.here.cost + constant,
        seconds=time.perf_counter() - clock,
    )


def _constant_cost(problem: Problem) -> float:
    """Cost of the rows that depend on no variable, where no arm, base, tool, frame or point is fitted."""
    if problem.variables.items:
        return 0.0
    at = problem.variables.at(problem.start)
    return 0.5 * sum(rows.squared_norm(at) for rows in problem.rows if not depends(rows, problem.variables))


def _taken_as_it_is(problem: Problem, clock: float) -> Solution:
    """The "solution" of an evaluation that has nothing to fit; robust weights are those of the rows as they are."""
    weighted, final, weighting = problem, problem.options.loss == "none", Weighting(problem.options.loss)
    while not final:
        state, final = _learn(problem, problem.start, weighting)
        weighted = reweighted_at(problem, problem.start, state)
    cost = _constant_cost(problem)
    return Solution(
        problem=weighted,
        values=problem.initial,
        parameters=problem.start,
        before=problem.start,
        converged=True,
        message="nothing to fit",
        history=(),
        initial_cost=cost,
        cost=cost,
        weighted_cost=_constant_cost(weighted),
        seconds=time.perf_counter() - clock,
    )


def _fit(problem: Problem, options: SolverOptions, *, near: bool = False) -> _Run:
    """Least squares from the problem's start, to the optimum of the rows as they are whitened there.

    With a robust loss the first weights are those of the residuals at the start: gross errors would lead least squares
    astray. Where the weights of a round lead nowhere, those that follow may.

    Args:
        problem: The problem.
        options: Settings of the solver.
        near: Whether the start is so near that the rows are to be whitened anew after every step from the first on.
    """
    robust = problem.options.loss != "none"
    weighting = Weighting(problem.options.loss)
    run, goal, was = _Run(problem, options), COARSE, np.inf
    bends = SPREAD_ROUNDS if problem.pair_series and problem.state.spread is None else 0
    if near:
        bends = _stride(run, bends)
        if run.converged:
            run.judge_rounding()
            return run
    if robust:
        run.go_on_with(reweighted_at(problem, problem.start, _learn(problem, problem.start, weighting)[0]))
    tries, n_steps = FOLDED_TRIES if problem.pair_series else 0, len(run.history)
    while run.descend(goal, FOLDED_STEPS if tries else None) or robust or tries:
        tries -= not run.converged and tries > 0
        state, final = _learn(run.problem, run.parameters, weighting)
        if bends:
            state, bends = replace(state, spread=run.here.spread), bends - 1
        anew = reweighted_at(problem, run.parameters, state)
        bends = bends if anew.state.spread is not None else 0  # where nothing bends nothing will
        unchanged = same_rows(anew, run.problem)
        if unchanged:
            run.problem = anew
        else:
            run.go_on_with(anew)
            if not robust and run.here.decrement <= COARSE:
                bends = _stride(run, bends)
                if run.converged:
                    break
        # Where no step could be taken and what is left falls no more, rows whitened anew differ by rounding alone.
        moved = len(run.history) > n_steps
        stands = not moved and goal <= run.least and was <= run.here.decrement
        # Where nothing moved what whitening anew leaves tells nothing: the next goal is to be nearer than here.
        left = run.left_after(was) if moved else run.here.decrement
        was, n_steps = run.here.decrement, len(run.history)
        # Rows that steps longer than what is left have not changed will be the same there; but weights may change.
        same = goal <= run.least or (moved and run.converged and not robust)
        if final and (same if unchanged else not bends and (stands or left <= run.least)):
            run.descend(run.least)
            break
        if run.exhausted:
            run.give_up()
            break
        goal = run.least if unchanged else min(COARSE, max(run.least, 0.1 * left))
    run.judge_rounding()
    return run


def _stride(run: _Run, bends: int) -> int:
    """Steps to rows that are whitened anew where each leads, as long as each brings the optimum much nearer.

    That spares linearising rows that are whitened elsewhere, and judges all the same.

    Args:
        run: The descent, which has converged where these steps end at the optimum.
        bends: How often the rows are to be bent by what the parameters may be off.

    Returns:
        How often they still are.
    """
    left, run.converged = np.inf, False
    while (bends or left > run.least) and not run.exhausted:
        here, variables = run.here, run.problem.variables
        values = variables.moved(here.values, here.step)
        parameters = variables.parameters(values)
        state = _learn(run.problem, parameters, Weighting(run.problem.options.loss))[0]
        try:
            anew = reweighted_at(run.problem, parameters, replace(state, spread=here.spread) if bends else state)
            there = Linearised(anew, values)
        except SolverError:
            return bends
        if there.decrement > max(SHORTER * here.decrement, there.rounding):
            return bends
        run.arrive(anew, there)
        left, bends = run.left_after(here.decrement), max(bends - 1, 0) if anew.state.spread is not None else 0
    if left <= run.least:
        run.descend(run.least)
    return bends


def _learn(problem: Problem, parameters: Floats, weighting: Weighting) -> tuple[NoiseState, bool]:
    """What the residuals at some parameters say of the noise, and whether the loss has its final form."""
    state, final = problem.state, True
    if problem.options.loss != "none":
        found = mahalanobis_distances(problem, parameters)
        test = np.concatenate([s.test for s in problem.data.series])
        e, residual_dim = (np.where(test, 0, np.concatenate(each)) for each in zip(*found, strict=True))
        weights, final = weighting.update(e, residual_dim)
        ends = np.cumsum([s.n for s in problem.data.series])[:-1]
        state = replace(state, weights=tuple(np.split(weights, ends)))
    if state.joint_errors is not None:
        state = replace(state, joint_errors=joint_errors(problem, parameters))
    return state, final


class _Run:
    """A descent from a problem's start, on one set of whitened rows after the other.

    Attributes:
        problem: The problem with the rows as they are whitened now.
        here: The problem linearised where the descent has arrived.
        history: The steps taken.
        initial_cost: Cost at the start.
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
        self._last: tuple[Linearised, Floats] | None = None  # where the last step began, and that step
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                self.here = Linearised(problem, problem.initial)
            self.initial_cost = self.here.cost
        except SolverError:
            with in_one_line(problem.variables):
                self.initial_cost = problem.graph.error(problem.initial)
            if np.isfinite(self.initial_cost):
                raise
        if not np.isfinite(self.initial_cost):
            raise SolverError(
                f"the cost at the start is {self.initial_cost}: the measurements or the robot hold absurd numbers"
            )

    @property
    def parameters(self) -> Floats:
        """The parameter vector where the descent has arrived."""
        return self.problem.variables.parameters(self.here.values)

    @property
    def least(self) -> float:
        """The decrement that counts as arrived, [sigma]: what the options say, or rounding."""
        return max(self._options.decrement, self.here.rounding)

    @property
    def exhausted(self) -> bool:
        """Whether all iterations have been spent."""
        return len(self.history) >= self._options.max_iterations

    def left_after(self, was: float) -> float:
        """How far the optimum still is, [sigma], where whitening anew left `was` the last time, and goes on."""
        left = self.here.decrement
        return left if left <= self.here.rounding else left / (1.0 - min(left / was, SLOWEST))

    def arrive(self, problem: Problem, there: Linearised) -> None:
        """Take the Gauss-Newton step, to other rows."""
        length = float(np.linalg.norm(self.here.step / problem.variables.all_scales))
        self.history.append(Iteration(there.cost, 0.0, length, self.here.decrement))
        self.problem, self.here = problem, there

    def go_on_with(self, problem: Problem) -> None:
        """The same place with other rows."""
        self.problem = problem
        self.here = Linearised(problem, self.here.values)

    def descend(self, goal: float, most: int | None = None) -> bool:
        """Step until the optimum of these rows is nearer than `goal`, [sigma]; whether it is, after `most` steps."""
        self.converged, stuck, first = self.here.decrement <= goal, False, len(self.history)
        while not (self.converged or stuck or self.exhausted or len(self.history) - first >= (most or np.inf)):
            path, damping = next(filter(None, map(self._undamped, self._first_steps())), []), 0.0
            if not path:
                path, damping = self._damped(), self._damping
            stuck = not path
            for there in path:
                taken = self.problem.variables.step(self.here.values, there.values)
                length = float(np.linalg.norm(taken / self.problem.variables.all_scales))
                self.history.append(Iteration(there.cost, damping, length, self.here.decrement))
                self._last, self.here = (self.here, taken), there
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

    def _undamped(self, first: Floats) -> list[Linearised]:
        """Where Gauss-Newton steps lead after a first one; nothing if they do not keep what they promise.

        A valley that is weakly determined may be curved: a step along it leaves it, and the next ones come back. So the
        cost may rise as long as the steps that follow are ever shorter.
        """
        path: list[Linearised] = []
        here = there = self.here
        for _ in range(PATIENCE):
            last = there
            try:
                step = last.step if path else first
                there = Linearised(self.problem, self.problem.variables.moved(last.values, step))
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

    def _first_steps(self) -> list[Floats]:
        """The Gauss-Newton step; before it where steps that hardly get shorter lead together (Anderson 1965, depth 1).

        Where a direction is known by its curvature, Gauss-Newton steps are all too long or too short by the same share.
        """
        here = self.here
        if self._last is None or here.decrement < SLOW * self._last[0].decrement:
            return [here.step]
        last, taken = self._last
        change = here.step - last.step
        share = here.product(here.step, change) / max(here.product(change, change), 1e-300)
        extrapolated: Floats = here.step - share * (taken + change)
        far = here.product(extrapolated, extrapolated) >= (FARTHEST * here.decrement) ** 2
        return [here.step] if far else [extrapolated, here.step]

    def _damped(self) -> list[Linearised]:
        """Where GTSAM's next damped step leads, undetermined directions held; nothing if none lowers the cost."""
        here, graph, variables = self.here, self.problem.graph, self.problem.variables
        with in_one_line(variables):
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, here.values, levenberg_marquardt_params(self._damping))
            optimizer.iterate()
        if not optimizer.error() < here.cost or optimizer.lambda_() >= MOST_DAMPING:
            return []
        self._damping = max(optimizer.lambda_(), LEAST_DAMPING)
        step = variables.step(here.values, optimizer.values())
        held = variables.moved(here.values, here.remove_gauge_drift(step))
        with in_one_line(variables):
            lower = graph.error(held) < here.cost
        return [Linearised(self.problem, held if lower else gtsam.Values(optimizer.values()))]


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
