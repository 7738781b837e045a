"""Other optima: where measurements see a combination only curved, a second arm may explain them as well.

Distances see a small offset across an axis by its square, so that +5 mm and -5 mm predict the same; which of the two a
descent finds depends on where it starts. A square shows itself: its derivative, and with it what is known of the
combination, grows with the distance from the vertex. So where a direction is known better at the estimate than at
nominal, the descent is repeated from the estimate's mirror image about the vertex; and where one is still weak at the
estimate, from two tolerances (two sigma if that is more) to either side. The best optimum is kept, and one that the
data cannot tell from it is told of.

Distances and angles near 0, and angles near half a turn, fold: where nominal has a pair on the other side, the descent
may end there, bending the whole arm. So it is repeated from the optimum of all rows but those that tolerances may fold.

Planes and anchors are tried at their mirror images (see `mirrored`), one after the other from the best optimum so far.

This stands behind the front door of jobs (`noise.solve_job`) and not in `solve`: a simulation of a thousand draws asks
for the optimum that nominal leads to, and would pay for looking elsewhere a thousand times.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.covariance import spread_of
from fg_calib.analysis.mirrored import mirror_images
from fg_calib.arguments import checked
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.information import whitened_triangle
from fg_calib.graph.noise import NoiseState, PairNoise
from fg_calib.graph.observability import SIGNAL_FLOOR
from fg_calib.graph.problem import Problem, assembled, noises_at, reweighted_at
from fg_calib.graph.solver import Solution, SolverOptions, solve, solve_from, solve_image
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
        solution where nothing is weak, where it has not converged, and with a robust loss, whose weights differ from
        optimum to optimum.
    """
    settings = solution.problem.options
    if not solution.converged or settings.loss != "none" or solution.problem.evaluated:
        return solution
    variables, seconds = solution.problem.variables, solution.seconds
    with one_blas_thread:
        steps = _steps(solution)
        unfolded = _without_folds(solution, options)
    found, starts = [solution], [(unfolded, reweighted_at(solution.problem, unfolded))] if unfolded is not None else []
    for step in steps:
        whole = np.concatenate([step, np.zeros(variables.n_nuisance)])
        starts.append((variables.parameters(variables.moved(solution.values, whole)), solution.problem))
    for start, rows in starts:
        least = min(one.cost for one in found)
        # Twice what is asked for below, for the rows are whitened where the first optimum is.
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
    """The optima found, and those of mirror images, one after the other from the best so far; time taken by all."""
    best, better = min(found, key=lambda one: one.cost), True
    while better:
        better = False
        for image in mirror_images(best):
            other = solve_image(best, image.problem, image.before, best.cost + 0.5 * INDISTINCT, options)
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


def _steps(solution: Solution) -> list[Floats]:
    """Steps from the estimate to other starts, shape (n_columns,) each."""
    problem, variables = solution.problem, solution.problem.variables
    scales, steps = variables.prior_scales, []
    nominal = _nominal(solution)
    s, V = _directions(problem, solution.parameters)
    s_nominal, V_nominal = _directions(problem, nominal)
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
    spread = FAR * np.diag(problem.variables.prior_scales)
    series, n_folded = [], 0
    for noise in noises_at(replace(problem, state=state), nominal):
        s = noise.series
        folds = noise.may_fold(spread) & s.used if isinstance(noise, PairNoise) else np.zeros_like(s.measured)
        folds[s.test] = False
        n_folded += int(np.sum(folds))
        series.append(replace(s, measured=s.measured & ~folds))
    if not n_folded or 2 * n_folded > problem.n_residuals:
        return None
    if problem.state.joint_errors is not None:
        state = replace(state, joint_errors=np.zeros_like(problem.state.joint_errors))
    without = assembled(problem, solution.before, state, data=replace(problem.data, series=tuple(series)))
    return solve(without, options).parameters


def _nominal(solution: Solution) -> Floats:
    """The parameter vector before the descent, with nominal values wherever a tolerance says how good they are."""
    nominal, robot = solution.before.copy(), solution.problem.robot
    for i, parameter in enumerate(robot.parameters):
        if parameter.tolerance is not None:
            nominal[i] = parameter.nominal
    return nominal


def _directions(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """Signal-to-noise ratios of data and priors at some parameters, and their unit-free directions as columns."""
    n = problem.variables.n_columns
    rows = np.vstack([whitened_triangle(problem, parameters), prior_rows(problem.variables, parameters)[1]])
    _, s, Vt = np.linalg.svd(np.vstack([rows * problem.variables.prior_scales, np.zeros((n, n))]), full_matrices=False)
    return s, Vt.T


def _apart(a: Solution, b: Solution) -> bool:
    """Whether the robot of the second differs by more than what is left open at the first, in some column."""
    variables, spread = a.problem.variables, spread_of(a)
    sigma = np.sqrt(np.diag(spread.covariance(np.eye(variables.n_columns))))  # nan where nothing determines it
    apart = np.abs(variables.step(a.values, b.values)[: variables.n_columns]) > APART * sigma
    return bool(np.any(apart[: variables.n_robot_columns]))
