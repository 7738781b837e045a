"""Tolerances estimated from the corrections: a scale on those stated, iterated with the fit.

Nobody knows how far an arm is from its drawing; the corrections of all its parameters together tell. At each solution
the scales are what the data say of them, the parameters integrated out to first order (see `tolerance_likelihood`);
then everything is solved again with the tolerances that they say, until no scale moves. An arm is nearly linear within
its tolerances, so that takes two or three rounds; where it is not, scales may jump to and fro, and each way back is
made shorter. Where the noise is estimated too, that happens in each round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.graph.factors import Variables, eliminate, prior_rows
from fg_calib.graph.information import correlation, whitened_triangle
from fg_calib.graph.problem import Problem, reweighted_at
from fg_calib.graph.solver import Solution, solve
from fg_calib.graph.tolerances import ToleranceScale, ToleranceScales, groups_of, prior_parameters, with_scales
from fg_calib.observability.indices import RANK_TOLERANCE
from fg_calib.statistics.tolerance_likelihood import Corrections, posterior_of
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

SETTLED = 1e-3
"""Relative change of a scale below which it has settled: a hundredth of what it is known to at best."""

MAX_ROUNDS = 30


@checked
@single_threaded
def estimate_tolerances(problem: Problem, solve_with: Callable[[Problem], Solution] = solve) -> Solution:
    """Estimate the parameters and, with them, a scale on the tolerances of each group.

    Args:
        problem: The problem; its options say what shares a scale, its tolerances are where the scales start from.
        solve_with: What solves it at given tolerances: `solve`, or `estimate_noise`.

    Returns:
        The solution with the tolerances it ends with, and their scales in its `estimated_tolerances`. It has not
        converged if the scales have not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    by, stated = problem.options.estimate_tolerance, problem.variables
    parameters = prior_parameters(stated)
    if by is None or problem.evaluated or not parameters:
        return solve_with(problem)
    groups, group = groups_of(problem.robot, parameters, by)
    members = tuple(tuple(p.name for p, k in zip(parameters, group, strict=True) if k == j) for j in range(len(groups)))
    scale, step, seconds, now = np.ones(len(groups)), np.zeros(len(groups)), 0.0, problem
    for _ in range(MAX_ROUNDS):
        solution = solve_with(now)
        seconds += solution.seconds
        corrections, follow = _corrections(solution, stated, scale[group], group)
        found = posterior_of(corrections)
        step = _held(found.theta - np.log(scale), step)
        moves = float(np.abs(step).max())
        if moves < SETTLED:
            break
        scale = scale * np.exp(step)
        noise = replace(problem.state, factors=solution.problem.state.factors)
        now = with_scales(
            reweighted_at(problem, problem.start, noise), by, dict(zip(groups, scale.tolist(), strict=True))
        )
    low, high = np.exp(found.interval)
    figures = (v.tolist() for v in (scale, low, high, found.seen))
    scales = tuple(ToleranceScale(*of) for of in zip(groups, members, *figures, strict=True))
    estimated = ToleranceScales(scales, follow @ found.unsure @ follow.T)
    solution = replace(solution, estimated_tolerances=estimated, seconds=seconds)
    if moves < SETTLED or not solution.converged:
        return solution
    message = f"not converged: the estimated tolerances still moved by {moves:.1g} after {MAX_ROUNDS} rounds"
    return replace(solution, converged=False, message=message)


def _held(wanted: Floats, last: Floats) -> Floats:
    """Steps as wanted, but back no more than half of the last one: so they end where an arm is far from linear."""
    half = 0.5 * np.abs(last)
    return np.where(wanted * last < 0.0, np.clip(wanted, -half, half), wanted)


def _corrections(
    solution: Solution, stated: Variables, scale: Floats, group: NDArray[np.int64]
) -> tuple[Corrections, Floats]:
    """What the data say of the corrections in tolerances stated, to first order at a solution.

    At the optimum the data pull as hard one way as the priors do the other, so that `g = (G + 1 / scale^2) u`. Where
    rows share errors but count as independent, g varies by H = G + (what they share) instead of by G: then the data
    say `G H^-1 G` and `G H^-1 g`.

    Args:
        solution: The solution.
        stated: The variables with the tolerances stated.
        scale: Scale of each correction's tolerance in the solution, shape (n,).
        group: Number of each one's group, shape (n,).

    Returns:
        The corrections, and how the columns follow them, shape (n_columns, n).
    """
    problem, at = solution.problem, solution.parameters
    by = stated.prior_scales
    u, P = prior_rows(stated, at)
    U, s, Vt = np.linalg.svd(P * by)
    back, rest = by[:, None] * (Vt[: len(s)].T / s) @ U.T, by[:, None] * Vt[len(s) :].T
    J = whitened_triangle(problem, at)
    left = eliminate(np.hstack([J @ back, J @ rest]), np.zeros(len(J)), len(u))
    follow = back + rest @ left.follow
    G = left.A.T @ left.A
    g = G @ u + u / scale**2
    added = correlation(problem, at)
    if added is not None:
        values, V = np.linalg.eigh(G + follow.T @ added @ follow)
        kept = values > RANK_TOLERANCE * values.max(initial=0.0)
        gain = G @ (V[:, kept] / values[kept]) @ V[:, kept].T
        G, g = gain @ G, gain @ g
    return Corrections(G, g, group), follow
