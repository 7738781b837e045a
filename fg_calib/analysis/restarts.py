"""Other optima: where measurements see a combination only curved, a second arm may explain them as well.

Distances see a small offset across an axis by its square, so that +5 mm and -5 mm predict the same; which of the two a
descent finds depends on where it starts. A square shows itself: its derivative, and with it what is known of the
combination, grows with the distance from the vertex. So where a direction is known better at the estimate than at
nominal, the descent is repeated from the estimate's mirror image about the vertex; and where one is still weak at the
estimate, from two tolerances (two sigma if that is more) to either side. The best optimum is kept, and one that the
data cannot tell from it is told of.

Distances and angles near 0, and angles near half a turn, fold: where nominal has a pair on the other side, the descent
may end there, bending the whole arm. So it is repeated from the optimum of all rows but those that tolerances may fold,
and from arms that have the vectors of these the other way (see `other_sides`).

Planes and anchors are tried at their mirror images (see `mirrored`), one after the other from the best optimum so far.

This stands behind the front door of jobs (`noise.solve_job`) and not in `solve`: a simulation of a thousand draws asks
for the optimum that nominal leads to, and would pay for looking elsewhere a thousand times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.covariance import spread_of
from fg_calib.analysis.mirrored import mirror_images
from fg_calib.analysis.other_sides import folds_of, other_sides, without
from fg_calib.arguments import checked
from fg_calib.graph.information import directions
from fg_calib.graph.noise import NoiseState
from fg_calib.graph.observability import SIGNAL_FLOOR
from fg_calib.graph.problem import Problem, noises_at, reweighted_at
from fg_calib.graph.solver import Solution, SolverOptions, descend_from, solve, solve_from, solve_image
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

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
"""Beyond this many residuals only the mirror image is tried: a descent takes seconds, and so many rows see much."""


MANY_ROWS, MUCH = 2000, 1.2
"""Beyond so many residuals rows that may fold are left out only where chi-square is so much above their number."""


@checked
def look_elsewhere(solution: Solution, options: SolverOptions | None = None) -> Solution:
    """The best optimum that a solution and descents from other starts find, with the others that are as good.

    Args:
        solution: What the descent from nominal found.
        options: Of the solver.

    Returns:
        The solution with the smallest cost; in its `others` those that data and priors cannot tell from it. The same
        solution where nothing is weak, and where it has not converged; with a robust loss, whose weights differ from
        optimum to optimum, there are only those others that have vectors the other way.
    """
    if not solution.converged or solution.problem.evaluated:
        return solution
    if solution.problem.options.loss != "none":
        return replace(solution, others=_with_the_same_weights(solution, options))
    seconds = solution.seconds
    with one_blas_thread:
        steps = _steps(solution)
        unfolded = _without_folds(solution, options)
    found, starts = [solution], [(unfolded, reweighted_at(solution.problem, unfolded))] if unfolded is not None else []
    starts += [(_moved(solution, step), solution.problem) for step in steps]
    for start, rows in starts:
        least = min(one.cost for one in found)
        other = solve_from(replace(solution, problem=rows), start, least + INDISTINCT, options)
        if other is None:
            continue
        seconds += other.seconds
        if other.converged and 2.0 * (other.cost - least) < INDISTINCT and all(_apart(other, one) for one in found):
            found.append(other)
    found, seconds = _with_images(found, seconds, options)
    best, *rest = sorted(found, key=lambda one: one.cost)
    others = tuple(one.parameters for one in rest if 2.0 * (one.cost - best.cost) < INDISTINCT)
    return replace(best, others=others, seconds=seconds)


def _with_images(found: list[Solution], seconds: float, options: SolverOptions | None) -> tuple[list[Solution], float]:
    """The optima found, and those of mirror images and other sides, one after the other from the best so far.

    Returns:
        All optima, and the time taken.
    """
    best, better = min(found, key=lambda one: one.cost), True
    while better:
        better = False
        for other in _descents(best, options):
            if other is None or not other.converged:
                continue
            seconds += other.seconds
            better = other.cost < best.cost - LEAST_GAIN
            if better or all(_apart(other, one) for one in found):
                found = [*found, other]
            if better:
                best = other
                break
    return found, seconds


def _descents(best: Solution, options: SolverOptions | None) -> Iterator[Solution | None]:
    """Where descents from mirror images and from vectors' other sides lead."""
    for image in mirror_images(best):
        yield solve_image(best, image.problem, image.before, best.cost + 0.5 * INDISTINCT, options)
    with one_blas_thread:
        steps = other_sides(best)
    for step in steps:
        # Twice what is asked for, for the rows are whitened where the first optimum is.
        yield solve_from(best, _moved(best, step), best.cost + INDISTINCT, options)


def _with_the_same_weights(solution: Solution, options: SolverOptions | None) -> tuple[Floats, ...]:
    """Parameter vectors of other sides that explain the measurements as well by the weights that they have."""
    with one_blas_thread:
        steps = other_sides(solution)
    found = [solution]
    for step in steps:
        most = solution.weighted_cost + 0.5 * INDISTINCT
        other = descend_from(solution, _moved(solution, step), most, options)
        if other is not None:
            there = replace(solution, parameters=other, values=solution.problem.variables.values(other))
            found += [there] if all(_apart(there, one) for one in found) else []
    return tuple(one.parameters for one in found[1:])


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
    if weak.size and problem.n_residuals <= MAX_ROWS:
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
    many = problem.n_residuals > MANY_ROWS
    if not problem.pair_series or (many and 2.0 * solution.cost < MUCH * problem.n_residuals):
        return None
    state = NoiseState(factors=problem.state.factors)
    folds = folds_of(noises_at(replace(problem, state=state), nominal), problem.variables.prior_scales)
    n_folded = sum(int(np.sum(mine)) for mine in folds)
    if not n_folded or 2 * n_folded > problem.n_residuals:
        return None
    if problem.state.joint_errors is not None:
        state = replace(state, joint_errors=np.zeros_like(problem.state.joint_errors))
    return solve(without(problem, folds, solution.before, state), options).parameters


def _nominal(solution: Solution) -> Floats:
    """The parameter vector before the descent, with nominal values wherever a tolerance says how good they are."""
    nominal, robot = solution.before.copy(), solution.problem.robot
    for i, parameter in enumerate(robot.parameters):
        if parameter.tolerance is not None:
            nominal[i] = parameter.nominal
    return nominal


def _apart(a: Solution, b: Solution) -> bool:
    """Whether the robot of the second differs by more than what is left open at the first, in some column."""
    variables, spread = a.problem.variables, spread_of(a)
    sigma = np.sqrt(np.diag(spread.covariance(np.eye(variables.n_columns))))  # nan where nothing determines it
    apart = np.abs(variables.step(a.values, b.values)[: variables.n_columns]) > APART * sigma
    return bool(np.any(apart[: variables.n_robot_columns]))
