"""Noise estimated from the residuals: one factor a kind on the sigmas stated, iterated with the fit.

The sum of squared residuals over sigma of a kind has a known mean (see `goodness`); where it is not met, the sigmas of
that kind are multiplied by the root of their ratio and everything is solved again, until nothing moves: iterated
estimates of variance components (Helmert; Foerstner 1979). Where priors hold much of the estimate these steps are all
too short in the same proportion, so the proportion seen in the last two lengthens the next (a secant step in the
logarithm of each factor). A kind that the parameters leave too few degrees of freedom keeps its stated noise.

Note:
    A factor multiplies all the noise of a row: that of the joint readings and of measured poses with it.

References:
    Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten. Allgemeine
    Vermessungs-Nachrichten 86.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fg_calib.analysis.covariance import spread_of
from fg_calib.analysis.goodness import KindFit, kind_fits
from fg_calib.analysis.mistakes import check_setup
from fg_calib.analysis.residual_table import residual_table
from fg_calib.analysis.restarts import look_elsewhere
from fg_calib.errors import SolverError
from fg_calib.graph.build import problem_of
from fg_calib.graph.problem import Problem, reweighted_at
from fg_calib.graph.solver import Solution, SolverOptions, solve
from fg_calib.job import Job
from fg_calib.threads import single_threaded

LEAST_REDUNDANCY = 3.0
"""Degrees of freedom that a kind must have left for its noise to be estimated."""

SETTLED = 1e-5
"""Relative change of a factor below which it has settled: far below what any noise is known to."""

LONGEST = 10.0
"""A secant step is at most this many times as long as the step it lengthens."""

MAX_ROUNDS = 30


def solve_job(job: Job, problem: Problem | None = None) -> Solution:
    """The solution of a job: the best optimum that is found, with its noise estimated if the job asks for it.

    Args:
        job: The job.
        problem: Another problem with the job's measurements; the job's own if None.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    problem = problem or problem_of(job)
    try:
        solution = estimate_noise(problem) if job.options.estimate_noise else solve(problem)
    except SolverError as error:
        for table in job.tables:
            if table.model is not None:
                check = check_setup(job.robot, table.measurements, table.model, table.frame, doubtful=True)
                if check.explanations:
                    raise SolverError(f"{error}; {check}") from error
        raise
    return look_elsewhere(solution)


@single_threaded
def estimate_noise(problem: Problem, options: SolverOptions | None = None) -> Solution:
    """Estimate the parameters and, with them, a factor on the stated noise of each kind.

    Args:
        problem: The problem; its stated noise is where the factors start from.
        options: Of the solver.

    Returns:
        The solution with the noise it ends with: the factors are in its problem's `state`, the kinds that they
        were estimated of in `estimated_noise`. It has not converged if the factors have not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    seconds, last = 0.0, _Steps()
    for _ in range(MAX_ROUNDS):
        solution = solve(problem, options)
        seconds += solution.seconds
        fits = kind_fits(solution, spread_of(solution), residual_table(solution))
        found = {(fit.table, fit.kind): fit for fit in fits if _redundant(fit)}
        solution = replace(solution, estimated_noise=tuple(found), seconds=seconds)
        last = last.next({kind: float(np.log(fit.seen_over_stated / fit.factor)) for kind, fit in found.items()})
        moves = max(map(abs, last.taken.values()), default=0.0)
        if moves < SETTLED:
            return solution
        # A solution that has not arrived tells of the noise too: with better factors the next one may.
        factors = {kind: found[kind].factor * float(np.exp(step)) for kind, step in last.taken.items()}
        problem = _scaled(problem, factors)
    message = f"not converged: the estimated noise still moved by {moves:.1g} after {MAX_ROUNDS} rounds"
    return replace(solution, converged=False, message=message if solution.converged else solution.message)


@dataclass(frozen=True)
class _Steps:
    """Steps of the logarithms of factors, by kind.

    Attributes:
        wanted: Logarithm of noise seen over noise taken.
        taken: The steps taken.
    """

    wanted: Mapping[tuple[int, str], float] = field(default_factory=dict)
    taken: Mapping[tuple[int, str], float] = field(default_factory=dict)

    def next(self, wanted: Mapping[tuple[int, str], float]) -> _Steps:
        """The next steps: secant steps, unless what was wanted grew."""
        taken: dict[tuple[int, str], float] = {}
        for kind, step in wanted.items():
            before = self.taken.get(kind, 0.0)
            kept = (self.wanted[kind] - step) / before if before else 1.0  # share of the last step that came true
            taken[kind] = step / max(kept, 1.0 / LONGEST) if kept > 0.0 else step
        return _Steps(wanted, taken)


def _redundant(fit: KindFit) -> bool:
    return fit.expected >= LEAST_REDUNDANCY and fit.chi2 > 0.0


def _scaled(problem: Problem, factors: Mapping[tuple[int, str], float]) -> Problem:
    """The problem from its start, with the stated noise of some kinds multiplied by factors."""

    def anew(p: Problem) -> Problem:
        return reweighted_at(p, p.start, replace(p.state, factors={**p.state.factors, **factors}))

    scaled = anew(problem)
    return scaled if problem.whole is None else replace(scaled, whole=anew(problem.whole))
