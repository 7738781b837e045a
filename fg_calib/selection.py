r"""The prior sigma of error curves, and the choice of effects, by marginal likelihood.

The coefficients of error curves are Gaussian, and their sigma s, one for all joints, is estimated with them. With the
covariance C of the coefficients c, integrated over all else, and n of them, MacKay's fixed point is

    gamma = n - tr(C) / s^2,   s^2 = |c|^2 / gamma,

gamma the number of directions that the data determine. Its own sigma is about s / sqrt(2 gamma). A linearised fit gives
C and c for every s, so that the fixed point is found between fits.

Effects are tried one by one in the order of `EFFECTS`, each next to all that are kept, else in place of one of them,
until nothing changes: some are of use only after others, some no longer, and some mimic others. Rows are linearised
once, where the geometry alone is estimated, for effects are small; noise and s are estimated anew each time. An effect
is kept if

1. there is evidence: of error curves a ratio of marginal likelihoods, of others an F test of their coefficients;
2. rows held out by blocks, the quarters of each joint's readings in turn, are predicted better;
3. no block is predicted worse than by the geometry alone, as far as the scatter of its rows tells.

References:
    MacKay (1992), Bayesian interpolation. Neural Computation 4(3).
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache

import numpy as np
import scipy.linalg
from scipy import special

from fg_calib import graph
from fg_calib.inputs import Booleans, Figure, Floats, Integers, Probability, Record
from fg_calib.job import Job
from fg_calib.parallel import single_threaded
from fg_calib.robot import EFFECTS, Effect, ErrorCurve
from fg_calib.statistics.variance_components import settle

SETTLED = 3e-3
"""Relative change of a prior sigma below which it has settled: a tenth of what it is known to at best."""

LEAST_SIGMA, MOST_SIGMA = 1e-9, 1e-2
"""Smallest and largest prior sigma of an error curve, [rad]: a worse gear has another fault, which a curve takes up."""

MAX_ROUNDS = 1000
"""Rounds of a fixed point between two fits."""

LEAST_SHARE = 1e-15
"""Share of its prior variance that a coefficient has left at least: rounding."""

MAX_P_VALUE = 1e-6
"""Largest p-value that is evidence of an effect, 11 nats of a likelihood ratio: rows are not quite independent."""

LEAST_GAIN = 0.01
"""Share by which an effect must lower the RMS of held-out rows."""

MAX_SCORE = 3.0
"""Sigma by which the mean square of a block may be larger than by the geometry alone."""

QUANTILES = (0.25, 0.5, 0.75)
"""Shares of a joint's readings at the ends of its blocks."""

N_PASSES = 4
"""How often all effects are tried at most."""

RIDGE = 0.1
"""Information on parameters of the geometry, 1 over so many prior sigmas or mm and mrad: small."""

MAX_RESIDUALS = 40_000
"""Residuals above which some measurements, drawn evenly, are enough to choose by."""

LEAST_NOISE, LEAST_LEFT = 1e-6, 10
"""Least variance of the noise over that specified; and degrees of freedom that a fit with an effect must leave."""

FIT_ROUNDS, FIT_SETTLED = 30, 0.02
"""Rounds of a linear fit, and change of the logarithms of noise and sigma below which they have settled."""


class EffectTest(Record):
    """What the rows say of one effect.

    Attributes:
        effect: Its key in a robot file.
        joints: Numbers of its joints, from 1.
        p_value: Probability of as much by chance.
        folds_before: RMS error of the rows held out without it, in `unit`.
        folds_after: The same with it.
        kept: Whether it is part of the arm.
        reason: Why it is not; empty if it is.
        unit: `m` where positions or lengths were measured.
    """

    effect: str
    joints: tuple[int, ...]
    p_value: Probability
    folds_before: Figure
    folds_after: Figure
    kept: bool
    reason: str = ""
    unit: str = "m"


@single_threaded
def estimate_curve_sigma(
    problem: graph.Problem, solve_with: Callable[[graph.Problem], graph.Solution] = graph.solve
) -> graph.Solution:
    """Estimate the parameters and, where an `ErrorCurve` does not specify it, the prior sigma of error curves.

    Args:
        problem: The problem; the tolerance of the curves' coefficients is where the sigma starts from.
        solve_with: Solver at a given prior sigma: `solve`, or `estimate_noise`.

    Returns:
        The solution; its robot's tolerances have the sigma, one for all curves, [rad]. It has not converged if the
        sigma has not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    specified = [e.sigma for e in problem.robot.effects if isinstance(e, ErrorCurve)]
    first = [sigma for v in problem.variables.nuisance if v.kind == "curve" and v.prior for sigma in v.prior[1]]
    if problem.evaluated or not first or any(specified):
        return solve_with(problem)

    known = list[graph.Solution]()

    def refit(theta: Floats) -> tuple[graph.Solution, Floats, None]:
        sigma, begun = first[0] * float(np.exp(theta[0])), problem
        if known:  # the next fit takes arm and noise up where the last one left them
            begun = replace(problem, start=known[-1].parameters, state=known[-1].problem.state)
        known.append(solve_with(_with_sigma(begun, sigma)))
        return known[-1], np.array([np.log(_next_sigma(known[-1], sigma) / sigma)]), None

    solution = settle(refit, 1, SETTLED, "prior sigma of error curves")[0]
    return graph.begun_at(solution, known[0].before)


def _with_sigma(problem: graph.Problem, sigma: float) -> graph.Problem:
    """The problem with a prior sigma of error curves, [rad]."""
    parameters = (replace(p, tolerance=sigma) if p.kind == "curve" else p for p in problem.robot.parameters)
    robot = replace(problem.robot, parameters=tuple(parameters))
    whole = None if problem.whole is None else _with_sigma(problem.whole, sigma)
    variables = graph.variables_of(robot, problem.data, problem.options)
    return replace(problem, robot=robot, variables=variables, whole=whole)


def _next_sigma(solution: graph.Solution, sigma: float) -> float:
    """The fixed point of the prior sigma of error curves by a fit with another one, [rad]."""
    curves = [v for v in solution.problem.variables.nuisance if v.kind == "curve"]
    places = np.concatenate([v.places for v in curves])
    root = np.concatenate([solution.system.full_root[v.columns] for v in curves]) / sigma
    share, V = np.linalg.eigh(root @ root.T)  # of the prior variance, in [0, 1]
    share = np.clip(share, LEAST_SHARE, 1.0)
    information, right = 1.0 / share - 1.0, V.T @ solution.parameters[places] / sigma / share
    s = 1.0
    for _ in range(MAX_ROUNDS):
        variance = s**2 / (1.0 + information * s**2)
        gamma = float(np.sum(information * variance))
        found = np.sqrt(np.sum((variance * right) ** 2) / max(gamma, LEAST_SHARE))
        before, s = s, float(np.clip(found, LEAST_SIGMA / sigma, MOST_SIGMA / sigma))
        if abs(s / before - 1.0) < 0.1 * SETTLED:
            break
    return float(s * sigma)


@single_threaded
def select_effects(job: Job, solve: Callable[[Job], graph.Solution]) -> tuple[Job, tuple[EffectTest, ...]]:
    """The job with those effects of its robot that the rows speak for, and what they say of each.

    Args:
        job: The job; the same is returned where its robot does not ask for a choice, or all rows are test rows.
        solve: Calibrates a job.

    Raises:
        ProblemError: The measurements do not suffice for the geometry.
        SolverError: GTSAM could not solve a step at all.
    """
    effects, kept, of = job.robot.effects, frozenset[_Group](), job.options
    # By the noise as specified a robust loss would take for outliers what effects explain.
    bare = replace(job, options=replace(of, estimate_noise=of.estimate_noise or of.loss != "none"))
    solution = solve(_with_effects(bare, kept)) if job.robot.select_effects and effects else None
    if solution is None or solution.problem.evaluated:
        return job, ()
    choice, found, order = _Choice(job, solution), dict[int, EffectTest](), list(EFFECTS.values())
    for _ in range(N_PASSES):
        before = kept
        for i in sorted({i for i, _ in choice.groups}, key=lambda i: order.index(type(effects[i]))):
            mine = frozenset(group for group in choice.groups if group[0] == i)
            others = kept - mine
            found[i], more = choice.test(others, mine)
            kept = others | more
            for j in {j for j, _ in others} if not more else ():
                fewer = frozenset(group for group in others if group[0] != j)
                test, more = choice.test(fewer, mine)
                if more and choice.prefers(fewer | more, kept):
                    found[i], kept = test, fewer | more
                    found[j] = replace(found[j], kept=False, reason=f"{test.effect} in its place")
        if kept == before:
            break
    return _with_effects(job, kept), tuple(found.values())


_Group = tuple[int, int]
"""Number of an effect, and of the joint that it acts on, from 1; 0 where it has no choice of joints."""


def _with_effects(job: Job, kept: Collection[_Group]) -> Job:
    """The job with some of its robot's effects on some joints; their parameters stay as specified."""
    robot, effects = job.robot, list[Effect]()
    for i, effect in enumerate(robot.effects):
        joints = [joint for of, joint in sorted(kept) if of == i]
        effects += [replace(effect, **({"joints": joints} if any(joints) else {}))] if joints else []  # type: ignore[type-var]
    found = replace(robot.geometry, select_effects=False).with_effects(*effects)
    as_specified = tuple(robot.parameters[robot.index(p.name)] for p in found.parameters)
    return replace(job, robot=replace(found, parameters=as_specified))


_Fit = tuple[Integers, float, Floats, float, Floats, Floats]
"""A linear fit: columns, factor on the variance of the noise, prior information of each column, log evidence, estimate
x, and U with U^T U its covariance."""


class _Choice:
    """The rows of a job with all its effects, linearised at a solution for the geometry alone.

    Columns are in prior sigmas; the last one has the residuals.
    """

    def __init__(self, job: Job, solution: graph.Solution) -> None:
        robot, x, n = job.robot, solution.parameters, len(solution.problem.robot.parameters)
        options = replace(job.options, encoder="propagated", pair_errors="independent", gauge="none")
        full = graph.problem_of_tables(robot, graph.tables_of(job.measurements, options), options)
        start = np.concatenate([x[:n], np.zeros(len(robot.parameters) - n), x[n:]])
        problem = graph.with_factors(full, start, solution.problem.state)
        if problem.n_residuals > MAX_RESIDUALS:
            problem = graph.subsampled(problem, MAX_RESIDUALS / problem.n_residuals)
        self.robot, self.n, v, parts = robot, problem.n_residuals, problem.variables, problem.rows.parts
        of_curves = (robot.parameters[i].name for one in v.nuisance if one.kind == "curve" for i in one.parameters)
        names = [*v.names, *of_curves, *(v.n_nuisance - v.n_curves) * ("landmark",)]
        effect_of = {
            t.name: (i, t.owner if hasattr(e, "joints") else 0)
            for i, e in enumerate(robot.effects)
            for t in e.terms(robot.geometry)
        }
        self.groups = sorted(set(effect_of.values()))
        scale_of = {p.name: p.scale for p in robot.parameters}
        group = {name: self.groups.index(of) for name, of in effect_of.items()}
        self.group = np.array([group.get(name, -1) for name in names])
        self.is_curve = np.char.find(names, ".curve[") > 0
        self.rows = problem.rows.private(v.at(start)) * [*(scale_of.get(name, 1e-3) for name in names), 1.0]
        units = np.concatenate([p.block.n * p.block.kind.units for p in parts])
        self.unit = "m" if "m" in units else str(units[0])
        self.n_lengths = sum(p.block.n for p in parts if self.unit in p.block.kind.units)
        noises = [problem.noises[p.number] for p in parts]
        self.sigma = np.concatenate([one.sigma[one.block.train].ravel() for one in noises]) * (units == self.unit)
        every = [t.measurements.readings for t in problem.data.tables]
        of_parts = [every[p.table][p.block.ends].sum(axis=1).repeat(p.block.residual_dim, axis=0) for p in parts]
        blocks = [np.searchsorted(np.quantile(q, QUANTILES), q) for q in np.concatenate(of_parts).T]
        held = [(j, np.flatnonzero(block == k)) for j, block in enumerate(blocks) for k in np.unique(block)]
        self.held = [(j, rows, self.rows[rows].T @ self.rows[rows]) for j, rows in held]
        self.gram = self.rows.T @ self.rows
        self.fit, self.held_out = cache(self._fit), cache(self._held_out)

    def prefers(self, new: frozenset[_Group], old: frozenset[_Group]) -> bool:
        """Whether there is more evidence for some effects than for others, and held-out rows are predicted better."""
        return self.fit(new)[3] > self.fit(old)[3] and self.error(new) < self.error(old)

    def error(self, kept: frozenset[_Group]) -> float:
        """Sum of the squares of `_held_out`."""
        return float(np.sum(self.held_out(kept) ** 2))

    def _columns(self, kept: Collection[_Group]) -> Booleans:
        """Columns of some groups."""
        return np.isin(self.group, [self.groups.index(group) for group in kept])

    def _fit(self, kept: frozenset[_Group]) -> _Fit:
        """The fit with some effects, noise and prior sigma of curves at their maximum likelihood."""
        c = np.flatnonzero((self.group < 0) | self._columns(kept))
        curve, base, noise, sigma = self.is_curve[c], self.group[c] < 0, 1.0, 1.0
        G, h = self.gram[np.ix_(c, c)], self.gram[c, -1]
        for _ in range(FIT_ROUNDS):
            prior = np.where(base, RIDGE**2, np.where(curve, sigma**-2.0, 1.0))
            U = scipy.linalg.lapack.dtrtri(np.linalg.cholesky(G / noise + np.diag(prior)), lower=1)[0]
            x = -U.T @ (U @ h) / noise
            square = float(self.gram[-1, -1] + h @ x)
            determinant = 2.0 * np.log(np.diag(U)).sum() + np.log(prior).sum()
            found = c, noise, prior, 0.5 * float(determinant - self.n * np.log(noise) - square / noise), x, U
            before, noise = np.array([noise, sigma]), max(square / max(self.n - int(base.sum()), 1), LEAST_NOISE)
            gamma = float(np.sum(1.0 - prior[curve] * np.sum(U[:, curve] ** 2, axis=0)))
            sigma = max(float(np.linalg.norm(x[curve])) / np.sqrt(max(gamma, LEAST_SHARE)), 1e-3)
            if np.abs(np.log([noise, sigma] / before)).max() < FIT_SETTLED:
                break
        return found

    def _held_out(self, kept: frozenset[_Group]) -> Floats:
        """Whitened residuals of all rows, each predicted without its block of a joint, shape (n_joints, n)."""
        c, noise, prior, *_ = self.fit(kept)
        ix, out = np.ix_(c, c), np.tile(self.rows[:, -1], (self.robot.n_joints, 1))
        whole = self.gram[ix] + noise * np.diag(prior)
        for j, rows, gram in self.held:
            x = scipy.linalg.cho_solve(scipy.linalg.cho_factor(whole - gram[ix]), gram[c, -1] - self.gram[c, -1])
            out[j, rows] += self.rows[np.ix_(rows, c)] @ x
        return out

    def test(self, kept: frozenset[_Group], added: frozenset[_Group]) -> tuple[EffectTest, frozenset[_Group]]:
        """Whether an effect is to be added to some that are kept, and on which joints.

        Where it is of no use on all its joints, it is tried on those for which there is evidence.
        """
        effect = self.robot.effects[min(added)[0]]
        found = self._test(kept, added, effect)
        if found.kept or isinstance(effect, ErrorCurve):
            return found, added if found.kept else frozenset()
        fewer = frozenset(group for group in added if self._p_value(kept | added, {group}) < MAX_P_VALUE)
        again = self._test(kept, fewer, effect) if fewer and fewer != added else found
        return (again, fewer) if again.kept else (found, frozenset())

    def _p_value(self, kept: frozenset[_Group], of: Collection[_Group]) -> float:
        """Of an F test of some of the groups that are kept; 1 where their fit leaves few degrees of freedom."""
        c, _, prior, _, x, U = self.fit(kept)
        left = self.n - float(np.sum(1.0 - prior * np.sum(U**2, axis=0)))
        if left < LEAST_LEFT:
            return 1.0
        own = self._columns(of)[c]
        square, k = float(x[own] @ np.linalg.solve(U[:, own].T @ U[:, own], x[own])), max(int(own.sum()), 1)
        return float(special.fdtrc(k, left, square / k))

    def _test(self, kept: frozenset[_Group], added: frozenset[_Group], effect: Effect) -> EffectTest:
        p_value = self._p_value(kept | added, added)
        if isinstance(effect, ErrorCurve) and p_value < 1.0:  # sigma is on the boundary where there is no curve
            gain = self.fit(kept | added)[3] - self.fit(kept)[3]
            p_value = 0.5 * float(special.chdtrc(1, 2.0 * max(gain, 0.0)))
        old, new, bare = map(self.held_out, (kept, kept | added, frozenset[_Group]()))
        change = new**2 - bare**2
        blocks = ((j + 1, change[j, rows]) for j, rows, _ in self.held)
        worse = [j for j, d in blocks if d.mean() > MAX_SCORE * d.std() / np.sqrt(len(d))]
        reason = f"a block of joint {worse[0]} is predicted worse than by the geometry alone" if worse else ""
        if self.error(kept | added) > (1.0 - LEAST_GAIN) ** 2 * self.error(kept):
            reason = "held-out blocks are not predicted better"
        reason = reason if p_value < MAX_P_VALUE else "no evidence"
        name = next(key for key, of in EFFECTS.items() if of is type(effect))
        joints = tuple(sorted({joint for _, joint in added} - {0}))
        rms, new_rms = (float(np.linalg.norm(e * self.sigma)) / np.sqrt(len(e) * self.n_lengths) for e in (old, new))
        return EffectTest(name, joints, p_value, rms, new_rms, not reason, reason, self.unit)
