"""Other optima: where measurements see a combination only curved, a second arm may explain them as well.

Distances see a small offset across an axis by its square, so that +5 mm and -5 mm predict the same; which of the two a
descent finds depends on where it starts. A square shows itself: its derivative, and with it what is known of the
combination, grows with the distance from the vertex. So where a direction is known better at the estimate than at
nominal, the descent is repeated from the estimate's mirror image about the vertex; and where one is still weak at the
estimate, from two tolerances (two sigma if that is more) to either side. The best optimum is kept, and one that the
data cannot tell from it is told of.

Distances and angles near 0, and angles near half a turn, fold: where nominal has a pair on the other side, the descent
may end there, bending the whole arm. So it is repeated from the optimum of all rows but those that tolerances may fold,
and from arms that have the vectors of these the other way (see `other_sides`). Where the rows are explained far too
badly, nominal may be right between two sides: then it starts from both sides of that.

With a robust loss optima are compared by what the loss has measurements cost: their weights differ. Those that reject
have many, and start from that of `gnc` too.

Planes and anchors are tried at their mirror images (see `mirrored`), one after the other from the best optimum so far.

This stands behind the front door of jobs (`solve_job`) and not in `solve`: a simulation of a thousand draws asks for
the optimum that nominal leads to, and would pay for looking elsewhere a thousand times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.diagnostics.mirrored import mirror_images
from fg_calib.diagnostics.other_sides import MUCH, folds_of, other_sides, without
from fg_calib.errors import CalibrationError
from fg_calib.graph.information import directions
from fg_calib.graph.noise import NoiseState
from fg_calib.graph.normal_system import SIGNAL_FLOOR
from fg_calib.graph.problem import Problem, assembled, noises_at, reweighted_at
from fg_calib.graph.solver import Solution, SolverOptions, solve, solve_from, solve_image
from fg_calib.statistics.covariance import spread_of
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]
T = TypeVar("T")

WEAK = 2.0
"""A direction with a signal-to-noise ratio below this, priors included, is weak: sigma above half a tolerance."""

CURVED = 0.7
"""A direction whose sigma is below this share of what it is at nominal is seen by a square, or nearly so."""

FAR = 2.0
"""How far away the other starts are, in tolerances (1 mm and 1 mrad where there are none), or in sigma if that is more:
of a tool without tolerance these are metres where orientations hardly change."""

APART = 3.0
"""Optima are two if some parameter differs by more than this many sigma."""

INDISTINCT = 10.8276
"""The 99.9 % point of chi-square with one degree of freedom: a smaller difference of chi-square decides nothing."""

LEAST_GAIN = 0.01
"""Cost by which a mirror image must be better to be taken: as good ones stay on the side that the start chose."""

MAX_ROWS = 20_000
"""Beyond this many residuals only the mirror image is tried: a descent takes seconds, and so many rows see much. With a
robust loss, whose descents are many, beyond `MANY_ROWS`."""

MANY_ROWS = 2000
"""Beyond so many residuals rows that may fold are left out only where chi-square is so much above their number."""

MOST_SIDES = 8
"""Optima, as good as each other, from which mirror images and other sides are looked for, at most."""

FAR_OFF = 10.0
"""Chi-square over the number of residuals that no arm near the optimum has."""


@checked
def look_elsewhere(solution: Solution, options: SolverOptions | None = None) -> Solution:
    """The best optimum that a solution and descents from other starts find, with the others that are as good.

    Args:
        solution: What the descent from nominal found.
        options: Of the solver.

    Returns:
        The solution that costs least; in its `others` those that data and priors cannot tell from it. The same solution
        where nothing is weak or folded. One that has not converged is left only for what folds: about a fold steps
        arrive nowhere.
    """
    if solution.problem.evaluated or not (solution.converged or solution.problem.pair_series):
        return solution
    search = _Search(solution, options)
    search.from_other_starts()
    search.from_images()
    return search.outcome()


class _Search:
    """The optima of a problem that have been found.

    Args:
        solution: The first.
        options: Of the solver.
    """

    def __init__(self, solution: Solution, options: SolverOptions | None) -> None:
        self._first, self._options = solution, options
        self._found, self._seconds = [solution], solution.seconds

    @property
    def _best(self) -> Solution:
        return min(self._found, key=lambda one: one.objective)

    def outcome(self) -> Solution:
        """The best, with those that are as good."""
        best, *rest = self._told()
        return replace(best, others=tuple(one.parameters for one in rest), seconds=self._seconds)

    def _told(self) -> list[Solution]:
        """The best, and those that are as good, each once."""
        best, *rest = sorted(self._found, key=lambda one: one.objective)
        told = [best]
        for one in rest:
            as_good = 2.0 * (one.objective - best.objective) < INDISTINCT
            if as_good and _is_an_arm(one, best) and all(_apart(one, other) for other in told):
                told.append(one)
        return told

    def from_other_starts(self) -> None:
        """Descents from without what may fold, and from along directions that are weak or seen by a square."""
        with one_blas_thread:
            steps = _steps(self._first) if self._first.converged else []
            unfolded = _attempted(lambda: _without_folds(self._first, self._options))
            rejecting = _attempted(lambda: _by_gnc(self._first, self._options))
        aside = [start for start in (unfolded, rejecting) if start is not None]
        for start in (*aside, *_beside_nominal(self._first)):
            problem = _attempted(partial(reweighted_at, self._first.problem, start))
            if problem is not None:
                self._keep(self._from(replace(self._first, problem=problem), start))
        for step in steps:
            self._keep(self._from(self._first, _moved(self._first, step)))

    def from_images(self) -> None:
        """Descents from mirror images and from vectors' other sides: of the best so far, then of those as good.

        What is mirrored in two ways has four sides, and from each only some of the others may be one step away.
        """
        looked_from, n_as_good = list[Solution](), 0

        def new(one: Solution) -> bool:
            return all(was.objective - one.objective > LEAST_GAIN or _apart(one, was) for was in looked_from)

        while n_as_good < MOST_SIDES and (here := next(filter(new, self._told()), None)) is not None:
            looked_from.append(here)
            better = any(self._keep(other) for other in self._images(here))
            n_as_good = 0 if better else n_as_good + 1

    def _images(self, here: Solution) -> Iterator[Solution | None]:
        if here.problem.options.loss == "none":
            most = self._best.cost + 0.5 * INDISTINCT
            for image in mirror_images(here):
                yield _attempted(partial(solve_image, here, image.problem, image.before, most, self._options))
        with one_blas_thread:
            steps = other_sides(here)
        for step in steps:
            yield self._from(here, _moved(here, step))

    def _from(self, solution: Solution, start: Floats) -> Solution | None:
        # Twice what is asked for at last, for the rows are whitened where the first optimum is.
        return _attempted(partial(solve_from, solution, start, self._best.cost + INDISTINCT, self._options))

    def _keep(self, other: Solution | None) -> bool:
        """Keep an optimum if it is nearly as good as the best; whether it is better than all before."""
        if other is None or not other.converged:
            return False
        self._seconds += other.seconds
        gain = self._best.objective - other.objective
        if -2.0 * gain < INDISTINCT:
            self._found.append(other)
        return gain > LEAST_GAIN


def _attempted(descent: Callable[[], T]) -> T | None:
    """What a descent from elsewhere leads to; None where it cannot be made, which is no fault of the first."""
    try:
        return descent()
    except CalibrationError:
        return None


def _moved(solution: Solution, step: Floats) -> Floats:
    """The parameter vector a step of the core away from the estimate, nuisances as they are there."""
    variables = solution.problem.variables
    whole = np.concatenate([step, np.zeros(variables.n_nuisance)])
    return variables.parameters(variables.moved(solution.values, whole))


def _steps(solution: Solution) -> list[Floats]:
    """Steps from the estimate to other starts, shape (n_columns,) each."""
    problem, variables = solution.problem, solution.problem.variables
    scales, steps = variables.prior_scales, []
    nominal = _nominal(solution)
    s, V = directions(problem, solution.parameters)
    s_nominal, V_nominal = directions(problem, nominal)
    # What is seen better here than at nominal, by ratio 1 / r: as of a square, with its vertex beyond nominal.
    spread = np.linalg.norm((V.T @ V_nominal) / np.maximum(s, SIGNAL_FLOOR)[:, None], axis=0)
    ratio = spread * np.maximum(s_nominal, SIGNAL_FLOOR)
    moved = V_nominal.T @ (variables.step(variables.values(nominal), solution.values)[: len(scales)] / scales)
    curved = (ratio < CURVED) & (np.abs(moved) > SIGNAL_FLOOR)
    if curved.any():
        steps.append(-2.0 * scales * (V_nominal[:, curved] @ (moved[curved] / (1.0 - ratio[curved]))))
    weak = V[:, (s < WEAK) & (s > SIGNAL_FLOOR)]
    if weak.size and problem.n_residuals <= (MAX_ROWS if problem.options.loss == "none" else MANY_ROWS):
        signs = np.random.default_rng(0).choice([-1.0, 1.0], len(scales))
        # Two tolerances or sigma, whichever is more: the same whatever basis the weak directions have.
        far = np.minimum(FAR / np.minimum(s[(s < WEAK) & (s > SIGNAL_FLOOR)], 1.0), _reaches(problem, weak))
        aside = scales * (weak @ (far * (weak.T @ signs)))
        steps += [aside, -aside]
    return steps


def _reaches(problem: Problem, directions: Floats) -> Floats:
    """How far directions, as columns, go before a column has changed by 1 rad or by the arm's reach, shape (k,)."""
    variables = problem.variables
    most = variables.scales[: len(directions)] / SIGNAL_FLOOR / variables.prior_scales
    out: Floats = np.min(most[:, None] / np.maximum(np.abs(directions), SIGNAL_FLOOR**2), axis=0)
    return np.maximum(out, FAR)


def _without_folds(solution: Solution, options: SolverOptions | None) -> Floats | None:
    """The optimum of all rows but those that tolerances may fold at nominal; None if there are none, or no others.

    Of very many rows no single one bends an arm: then only where chi-square is too large.
    """
    problem, nominal = solution.problem, _nominal(solution)
    if not problem.pair_series or (problem.n_residuals > MANY_ROWS and not _is_far(solution, MUCH)):
        return None
    state = NoiseState(factors=problem.state.factors)
    folds = folds_of(noises_at(replace(problem, state=state), nominal), problem.variables.prior_scales)
    n_folded = sum(int(np.sum(mine)) for mine in folds)
    if not 0 < n_folded < problem.n_residuals:
        return None
    if problem.state.joint_errors is not None:
        state = replace(state, joint_errors=np.zeros_like(problem.state.joint_errors))
    return solve(without(problem, folds, solution.before, state), options).parameters


def _by_gnc(solution: Solution, options: SolverOptions | None) -> Floats | None:
    """The optimum by `gnc`, of losses that have many: these may take good rows for outliers from the start on."""
    problem = solution.problem
    if problem.options.loss not in ("cauchy", "geman-mcclure") or problem.n_residuals > MANY_ROWS:
        return None
    state = replace(problem.state, weights=None, spread=None)
    return solve(
        assembled(problem, solution.before, state, options=replace(problem.options, loss="gnc")), options
    ).parameters


def _beside_nominal(solution: Solution) -> list[Floats]:
    """Parameter vectors a tolerance to either side of nominal, where the rows are explained far too badly.

    Nominal may be where two sides of a fold meet: no derivative leads away from there.
    """
    problem, variables = solution.problem, solution.problem.variables
    if not problem.pair_series or problem.n_residuals > MAX_ROWS or not _is_far(solution, FAR_OFF):
        return []
    signs = np.random.default_rng(0).choice([-1.0, 1.0], variables.n_columns)
    there = replace(solution, parameters=(nominal := _nominal(solution)), values=variables.values(nominal))
    return [_moved(there, sign * signs * variables.prior_scales) for sign in (1.0, -1.0)]


def _is_far(solution: Solution, factor: float) -> bool:
    """Whether chi-square is so many times the number of rows."""
    return 2.0 * solution.objective > factor * solution.problem.n_residuals


def _nominal(solution: Solution) -> Floats:
    """The parameter vector before the descent, with nominal values wherever a tolerance says how good they are."""
    nominal, robot = solution.before.copy(), solution.problem.robot
    for i, parameter in enumerate(robot.parameters):
        if parameter.tolerance is not None:
            nominal[i] = parameter.nominal
    return nominal


def _is_an_arm(other: Solution, best: Solution) -> bool:
    """Whether another optimum is another arm: angles a radian away are the same in other words, or of none at all."""
    angles = [p.unit == "rad" for p in best.problem.robot.parameters]
    off = (other.parameters - best.parameters)[best.problem.variables.robot_span]
    return bool(np.all(np.abs(off[angles]) < 1.0))


def _apart(a: Solution, b: Solution) -> bool:
    """Whether the robots of two differ by more than what is left open at either, in some column."""
    variables, eye = a.problem.variables, np.eye(a.problem.variables.n_columns)
    step = np.abs(variables.step(a.values, b.values)[: len(eye)])
    variance = np.maximum(*(spread_of(one).variance(eye) for one in (a, b)))  # nan where nothing determines it
    return bool(np.any((step > APART * np.sqrt(variance))[: variables.n_robot_columns]))
