"""Noise estimated from the residuals: a factor on the sigmas stated of each origin, iterated with the fit.

Without joint noise the sum of squared residuals over sigma of each table and kind has a known mean (see `goodness`);
where it is not met, the sigmas of that kind are multiplied by the root of their ratio and everything is solved again,
until nothing moves: iterated estimates of variance components (Helmert; Foerstner 1979). Where priors hold much of the
estimate these steps are all too short in the same proportion, so the proportion seen in the last two lengthens the next
(a secant step in the logarithm of each factor). A kind that the parameters leave too few degrees of freedom keeps its
stated noise.

With joint noise there is one more factor, on that, and rows tell of several at once. Then the factors are those of
restricted maximum likelihood (see `noise_components`). With q_i the square seen of origin i, t_i its mean and T_ij =
tr(P V_i P V_j), the steps of the logarithms solve `T step = t log(q / t) / 2`: Fisher's scoring near the end, and far
from it the root of the ratio where there is one origin, or all are off by the same.

What the residuals cannot tell apart keeps what was stated: an origin that `1 / (T^-1)_ii` gives fewer than
`LEAST_REDUNDANCY` degrees of freedom beside the others, both where it is estimated and where it is as stated with the
others estimated, unless what was stated is then `UNLIKELY` sigma from what is seen. So noise that is stated but not
there goes to nothing, and noise too small to be seen, or not to be told from other noise, stays.

References:
    Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten. Allgemeine
    Vermessungs-Nachrichten 86.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.graph.noise import NoiseName
from fg_calib.graph.problem import Problem, reweighted_at
from fg_calib.graph.solver import Solution, SolverOptions, solve
from fg_calib.statistics.covariance import spread_of
from fg_calib.statistics.goodness_of_fit import KindFit, kind_fits
from fg_calib.statistics.noise_components import has_joint_noise, noise_components
from fg_calib.statistics.residual_table import residual_table
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

SETTLED = 1e-5
"""Relative change of a factor below which it has settled: far below what any noise is known to."""

LONGEST = 10.0
"""A secant step is at most this many times as long as the step it lengthens."""

MAX_ROUNDS = 30

FARTHEST = 3.0
"""A step of the logarithm of a factor is at most this long where rows tell of several factors."""

UNLIKELY = 3.0
"""Sigma by which what is seen is off from noise as stated that shows it to be wrong, however little is seen of it."""

NEAR = 0.3
"""Steps shorter than this are Newton's, by the curvature at the residuals seen, not by its mean."""

LEAST_CURVED = 0.5
"""Curvature of the likelihood over its mean that is taken for this at least."""

NOTHING = 0.01
"""Degrees of freedom that noise takes up, below which it need not be made smaller still: it is nothing."""

FLAT = 1e-9
"""Information on a combination of factors, as a share of that on each alone, below which there is none."""

LEAST_REDUNDANCY = 3.0
"""Degrees of freedom that a kind must have left for its noise to be estimated."""

TINY = 1e-100


@checked
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
    if not has_joint_noise(problem):
        return _settled(problem, options, _of_kinds).solution
    best, asked = _settled(problem, options, _of_origins), set[NoiseName]()
    seconds = best.solution.seconds
    while weak := {name: n for name, n in best.told.degrees.items() if n < LEAST_REDUNDANCY and name not in asked}:
        name = min(weak, key=lambda name: weak[name])
        asked.add(name)
        kept = best.told.kept | {name}
        as_stated = _scaled(problem, {**best.solution.problem.state.factors, name: 1.0})
        other = _settled(as_stated, options, partial(_of_origins, kept=kept))
        seconds += other.solution.seconds
        best = other if name in other.told.cannot_tell else best
    return replace(best.solution, seconds=seconds)


@dataclass(frozen=True)
class _Told:
    """What a solution tells of its noise.

    Attributes:
        steps: Of the logarithms of the factors that are estimated.
        apart: Whether each step disregards the others.
        degrees: Degrees of freedom that each of these has beside the others.
        kept: Origins whose noise is kept as stated.
        cannot_tell: Those of them that could not be estimated.
    """

    steps: Mapping[NoiseName, float]
    apart: bool
    degrees: Mapping[NoiseName, float] = field(default_factory=dict)
    kept: frozenset[NoiseName] = frozenset()
    cannot_tell: frozenset[NoiseName] = frozenset()


@dataclass(frozen=True)
class _Settled:
    """A solution with the noise it tells of; not converged where the factors have not settled."""

    solution: Solution
    told: _Told


def _settled(problem: Problem, options: SolverOptions | None, ask: Callable[[Solution], _Told]) -> _Settled:
    """Solve and scale the noise until it is what the solution tells."""
    seconds, last = 0.0, _Steps()
    for _ in range(MAX_ROUNDS):
        solution = solve(problem, options)
        seconds += solution.seconds
        told = ask(solution)
        solution = replace(solution, estimated_noise=tuple(told.steps), seconds=seconds)
        last = last.next(told.steps) if told.apart else last.held(told.steps)
        moves = max(map(abs, last.taken.values()), default=0.0)
        if moves < SETTLED:
            return _Settled(solution, told)
        # A solution that has not arrived tells of the noise too: with better factors the next one may.
        now = problem.state.factors
        problem = _scaled(problem, {name: now.get(name, 1.0) * float(np.exp(s)) for name, s in last.taken.items()})
    message = f"not converged: the estimated noise still moved by {moves:.1g} after {MAX_ROUNDS} rounds"
    solution = replace(solution, converged=False, message=message if solution.converged else solution.message)
    return _Settled(solution, told)


def _of_kinds(solution: Solution) -> _Told:
    """Steps to the factors that give each kind the sum of squares that it expects."""
    fits = kind_fits(solution, spread_of(solution), residual_table(solution))
    found = {(fit.table, fit.kind): fit for fit in fits if _redundant(fit)}
    return _Told({name: float(np.log(fit.seen_over_stated / fit.factor)) for name, fit in found.items()}, apart=True)


def _of_origins(solution: Solution, kept: frozenset[NoiseName] = frozenset()) -> _Told:
    """Steps to the factors of restricted maximum likelihood.

    Args:
        solution: The solution.
        kept: Origins whose noise is kept as stated.
    """
    found = noise_components(solution, spread_of(solution))
    seen, expected = np.maximum(found.seen, TINY), np.maximum(found.expected, TINY)
    there = np.array([name not in kept for name in found.names])
    gone = there & (seen < expected) & (expected < NOTHING)
    free = np.flatnonzero(there & ~gone)
    T = found.products
    step = np.zeros(len(there))
    wanted = 0.5 * expected * np.log(seen / expected)
    of_free = np.ix_(free, free)
    step[free] = np.clip(_solved(T[of_free], wanted[free]), -FARTHEST, FARTHEST)
    if np.abs(step).max(initial=0.0) < NEAR:
        step[free] = _solved(_curvature(T[of_free], found.products_seen[of_free]), wanted[free])
    degrees, cannot = np.zeros(len(there)), set[NoiseName]()
    for i, name in enumerate(found.names):
        beside = np.append(free[free != i], i)
        degrees[i] = 1.0 / max(_solved(T[np.ix_(beside, beside)], np.eye(len(beside))[-1])[-1], TINY)
        off = abs(seen[i] - expected[i]) / np.sqrt(2.0 * degrees[i])
        if name in kept and degrees[i] < LEAST_REDUNDANCY and off < UNLIKELY:
            cannot.add(name)
    of = {name: i for i, name in enumerate(found.names) if there[i]}
    return _Told(
        {name: float(step[i]) for name, i in of.items()},
        False,
        {name: float(degrees[i]) for name, i in of.items()},
        kept,
        frozenset(cannot),
    )


def _curvature(T: Floats, seen: Floats) -> Floats:
    """`2 seen - T`, T its mean: half the curvature of the likelihood, in no direction less than `LEAST_CURVED` T.

    T counts degrees of freedom; where noise has next to none it may be singular, and by rounding less than that.
    """
    by = np.sqrt(np.maximum(np.diag(T), FLAT))
    values, vectors = np.linalg.eigh(T / by[:, None] / by)
    length = np.sqrt(np.maximum(values, FLAT))
    inverse = vectors / length / by[:, None]  # of the root of T
    curved, turned = np.linalg.eigh(inverse.T @ (2.0 * seen - T) @ inverse)
    root = by[:, None] * (vectors * length) @ turned
    out: Floats = (root * np.maximum(curved, LEAST_CURVED)) @ root.T
    return out


def _solved(T: Floats, b: Floats) -> Floats:
    """T^-1 b, of least length where T is singular; T symmetric, scaled to a diagonal of 1."""
    by = 1.0 / np.sqrt(np.maximum(np.diag(T), TINY))
    values, vectors = np.linalg.eigh(T * by[:, None] * by)
    kept = values > FLAT
    out: Floats = by * (vectors[:, kept] @ ((vectors[:, kept].T @ (by * b)) / values[kept]))
    return out


@dataclass(frozen=True)
class _Steps:
    """Steps of the logarithms of factors, by origin.

    Attributes:
        wanted: Logarithm of noise seen over noise taken.
        taken: The steps taken.
    """

    wanted: Mapping[NoiseName, float] = field(default_factory=dict)
    taken: Mapping[NoiseName, float] = field(default_factory=dict)

    def next(self, wanted: Mapping[NoiseName, float]) -> _Steps:
        """The next steps: secant steps, unless what was wanted grew."""
        taken: dict[NoiseName, float] = {}
        for kind, step in wanted.items():
            before = self.taken.get(kind, 0.0)
            kept = (self.wanted[kind] - step) / before if before else 1.0  # share of the last step that came true
            taken[kind] = step / max(kept, 1.0 / LONGEST) if kept > 0.0 else step
        return _Steps(wanted, taken)

    def held(self, wanted: Mapping[NoiseName, float]) -> _Steps:
        """Steps as wanted, but back no more than half of the last one: so they end where steps jump to and fro."""
        taken: dict[NoiseName, float] = {}
        for name, step in wanted.items():
            before = self.taken.get(name, 0.0)
            taken[name] = float(np.clip(step, -abs(before) / 2.0, abs(before) / 2.0)) if step * before < 0.0 else step
        return _Steps(wanted, taken)


def _redundant(fit: KindFit) -> bool:
    return fit.expected >= LEAST_REDUNDANCY and fit.chi2 > 0.0


def _scaled(problem: Problem, factors: Mapping[NoiseName, float]) -> Problem:
    """The problem from its start, with the stated noise of some kinds multiplied by factors."""

    def anew(p: Problem) -> Problem:
        return reweighted_at(p, p.start, replace(p.state, factors={**p.state.factors, **factors}))

    scaled = anew(problem)
    return scaled if problem.whole is None else replace(scaled, whole=anew(problem.whole))
