r"""Noise estimated from the residuals: factors on the specified sigmas by restricted maximum likelihood (REML).

Noise of several origins, each known up to a factor on its sigma, reaches the rows: `C = sum over i of V_i`, with V_i
what the noise of one table and kind adds, or that of the joint readings, which is one. With J the rows' derivatives, H
their information with that of the priors, and `P = C^-1 - C^-1 J H^-1 J^T C^-1`, the derivative of the restricted
log-likelihood in the logarithm of factor i is `q_i - t_i` with

    q_i = r^T P V_i P r,   t_i = tr(P V_i)

(Patterson and Thompson 1971), and the average of observed and expected information in two of them is 2 a_ij with
`a_ij = r^T P V_i P V_j P r` (Gilmour, Thompson and Cullis 1995). P r is C^-1 times the residuals at the estimate. Where
no rows share errors, q is the sum of squares of a kind and t its redundancy. Steps solve `T step = t log(q / t) / 2`
with `T_ij = a_ij / sqrt(q_i q_j / t_i t_j)`, which does not depend on the size of the noise: the root of the ratio
where there is one origin, or all are off by the same. The fit is repeated with the new factors until they settle.

What the residuals cannot distinguish keeps its specified noise: an origin that `1 / (T^-1)_ii` gives fewer than
`LEAST_REDUNDANCY` degrees of freedom next to the others, both where it is estimated and where it is as specified,
unless what was specified is then `UNLIKELY` sigma from the estimate. So noise that is specified but absent goes to
nothing, and noise too small to be determined stays.

Where rows are weighted by more than their noise (`WhitenedRows.spare`: C = sum V_i + S), t_i is tr(P V_i) -
tr(P V_i P S). A row with robust weight w counts as w rows. Noise of formed pairs beyond the first order counts as that
of the poses. Where measurements that share errors are asked to count as independent, they do here too.

References:
    Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten. Allgemeine
    Vermessungs-Nachrichten 86.
    Gilmour, Thompson and Cullis (1995), Average information REML. Biometrics 51.
    Patterson and Thompson (1971), Recovery of inter-block information when block sizes are unequal. Biometrika 58(3).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse

from fg_calib import graph, parallel
from fg_calib.inputs import Booleans, Floats, Integers, Record

Sparse = scipy.sparse.csr_array

SETTLED = 1e-5
"""Relative change of a factor below which it has settled: far below what any noise is known to."""

MAX_ROUNDS = 30

MAX_STEP = 3.0
"""A step of the logarithm of a factor is at most this long."""

LEAST_REDUNDANCY = 3.0
"""Degrees of freedom that a kind must have left for its noise to be estimated."""

UNLIKELY = 3.0
"""Sigma between estimated and specified noise that shows the latter to be wrong, however few degrees of freedom."""

NEGLIGIBLE = 0.01
"""Degrees of freedom that noise takes up, below which it need not be made smaller still."""

FLAT = 1e-9
"""Information on a combination of factors, as a share of that on each alone, below which there is none."""

MAX_EXACT, N_PROBES = 2000, 64
"""Columns up to which a squared norm is exact, and number of random vectors that estimate it beyond."""

TINY = 1e-100


class NoiseComponents(Record):
    """Noise of each origin by the residuals, with the noise as taken.

    Attributes:
        names: The origins.
        squares: q, the sum of squares that each shows, shape (n,).
        expected: t, its mean, were the noise as taken, shape (n,).
        information: T, degrees of freedom in the logarithms of the factors, shape (n, n).
    """

    names: tuple[graph.NoiseName, ...]
    squares: Floats
    expected: Floats
    information: Floats

    def degrees(self, i: int, others: Integers) -> float:
        """Degrees of freedom of one origin next to others that are estimated too, by their numbers."""
        chosen = np.append(others[others != i], i)
        return 1.0 / max(float(_solve(self.information[np.ix_(chosen, chosen)], np.eye(len(chosen))[-1])[-1]), TINY)


def has_joint_noise(problem: graph.Problem) -> bool:
    """Whether the noise of joint readings reaches any fitted row."""
    return any(bool(np.any(noise.loading[noise.block.train][:, :, : noise.n_of_joints])) for noise in problem.noises)


def noise_components(solution: graph.Solution) -> NoiseComponents:
    """How much noise of each origin the residuals of a solution show."""
    problem = solution.problem
    names = _origins(problem)
    system, roots = problem.linearize(solution.parameters), [_root(problem, name) for name in names]
    u = system.weighted_residual / np.sqrt(_robust_weights(problem))
    squares = np.array([np.sum((E.T @ u) ** 2) for E in roots])
    expected = np.array([system.trace(E) for E in roots])
    S = problem.rows.spare
    if S.nnz:
        probes, n = S.toarray(), 1
        if S.shape[1] > MAX_EXACT:
            probes, n = S @ np.random.default_rng(0).choice([-1.0, 1.0], size=(S.shape[1], N_PROBES)), N_PROBES
        P_S = system.project(probes)
        expected -= [np.sum((E.T @ P_S) ** 2) / n for E in roots]
    squares, expected = np.maximum(squares, TINY), np.maximum(expected, TINY)
    work = np.column_stack([E @ (E.T @ u) for E in roots]) / np.sqrt(squares / expected)
    return NoiseComponents(names, squares, expected, work.T @ system.project(work))


def _origins(problem: graph.Problem) -> tuple[graph.NoiseName, ...]:
    """Tables and kinds of the fitted rows, then the joint readings."""
    fitted = [noise for noise in problem.noises if noise.block.used[noise.block.train].any()]
    kinds = dict.fromkeys((noise.block.table, family) for noise in fitted for family in _families(noise))
    return (*kinds, graph.JOINT_NOISE) if has_joint_noise(problem) else tuple(kinds)


def _families(noise: graph.RowNoise) -> list[str]:
    """The kind of noise of each row of a measurement."""
    return [name.partition(".")[0] for name in noise.block.kind.names]


def _robust_weights(problem: graph.Problem) -> Floats:
    """Robust weight of each row of the linear system, shape (n_rows,)."""
    given, out = problem.state.weights, np.ones(problem.rows.states.loadings.shape[0])
    if given is None:
        return out
    parts = [(given[p.number][problem.noises[p.number].block.train], p.block.residual_dim) for p in problem.rows.parts]
    return np.concatenate([np.repeat(np.maximum(w, 1e-12), h) for w, h in parts])


def _root(problem: graph.Problem, name: graph.NoiseName) -> Sparse:
    """E with E E^T the part of the rows' covariance that noise of one origin makes, shape (n_rows, k).

    First what is private to each measurement, then what measurements share.
    """
    private, common = [], []
    for part in problem.rows.parts:
        noise = problem.noises[part.number]
        train, W = noise.block.train, graph.whitener_of(noise, part)
        of_joints = np.arange(noise.loading.shape[2]) < noise.n_of_joints
        mine = np.array([(noise.block.table, family) == name for family in _families(noise)])
        origin = of_joints[None] if name == graph.JOINT_NOISE else mine[:, None] & ~of_joints
        is_state = problem.rows.shared[noise.columns[train]][:, None]
        alone = W @ np.where(origin & ~is_state, noise.loading[train], 0.0)
        own = W @ _square_roots(noise.private_at(train))[:, :, mine]
        private.append(graph.block_diagonal(np.concatenate([own, alone] if alone.any() else [own], axis=2)))
        common.append(noise.errors_at(train, W, origin & is_state))
    return Sparse(scipy.sparse.hstack([scipy.sparse.block_diag(private), scipy.sparse.vstack(common)]))


def _square_roots(covariance: Floats) -> Floats:
    """Symmetric square roots of small covariances, shape (n, h, h)."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)


@parallel.single_threaded
def estimate_noise(problem: graph.Problem) -> graph.Solution:
    """Estimate the parameters and, with them, a factor on the specified noise of each kind.

    Args:
        problem: The problem; its specified noise is where the factors start from.

    Returns:
        The solution with the noise it ends with: the factors are in its problem's `state`, the kinds that they
        were estimated of in `estimated_noise`. It has not converged if the factors have not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    kept, seconds, asked = frozenset[graph.NoiseName](), 0.0, set[graph.NoiseName]()
    while True:
        solution, degrees = _settle(problem, kept)
        seconds += solution.seconds
        weak = {name: n for name, n in degrees.items() if n < LEAST_REDUNDANCY and name not in asked}
        if not weak:
            return replace(solution, seconds=seconds)
        name = min(weak, key=lambda name: weak[name])
        asked.add(name)
        as_specified = _scaled(problem, {**solution.problem.state.factors, name: 1.0})
        if _is_indeterminate(noise_components(graph.solve(as_specified)), name, tuple(degrees)):
            problem, kept = as_specified, kept | {name}
            asked = set(kept)


def _is_indeterminate(found: NoiseComponents, name: graph.NoiseName, estimated: Sequence[graph.NoiseName]) -> bool:
    """Whether the residuals say next to nothing of noise of one origin that is as specified."""
    i = found.names.index(name)
    degrees = found.degrees(i, np.array([found.names.index(other) for other in estimated]))
    off = abs(found.squares[i] - found.expected[i]) / np.sqrt(2.0 * degrees)
    return bool(degrees < LEAST_REDUNDANCY and off < UNLIKELY)


def _settle(
    problem: graph.Problem, kept: frozenset[graph.NoiseName]
) -> tuple[graph.Solution, dict[graph.NoiseName, float]]:
    """Solve and scale the noise until its components are as expected.

    Returns:
        The solution, not converged where the factors have not settled, and the degrees of freedom of each origin that
        was estimated, next to the others.
    """
    names, factors, known = _origins(problem), problem.state.factors, list[graph.Solution]()

    def refit(theta: Floats) -> tuple[graph.Solution, Floats, NoiseComponents]:
        moved = {name: float(np.exp(t)) for name, t in zip(names, theta, strict=True) if t}
        now = {name: factors.get(name, 1.0) * factor for name, factor in moved.items()}
        start, weights = (known[-1].parameters, known[-1].problem.state.weights) if known else (None, None)
        begun = replace(problem, state=replace(problem.state, weights=weights)) if weights else problem
        known.append(graph.solve(_scaled(begun, now), start=start))
        found = noise_components(known[-1])
        return known[-1], _steps(found, kept), found

    solution, found = settle(refit, len(names), SETTLED, "noise")
    solution = graph.begun_at(solution, known[0].before)
    free = np.flatnonzero(_is_estimated(found, kept)).tolist()
    degrees = {names[i]: found.degrees(i, np.array(free)) for i in free}
    return replace(solution, estimated_noise=tuple(degrees)), degrees


def settle(
    refit: Callable[[Floats], tuple[graph.Solution, Floats, Any]], n: int, settled: float, what: str
) -> tuple[graph.Solution, Any]:
    """Refit with other factors until they settle; steps back are at most half of the last one.

    Args:
        refit: Returns the solution by the logarithms of the factors, their step, and what else is asked of the last.
        n: Number of factors.
        settled: Step of the logarithms from which on they have settled.
        what: The factors are on, for the message where they do not settle.
    """
    theta, step, seconds = np.zeros(n), np.zeros(n), 0.0
    for _ in range(MAX_ROUNDS):
        solution, wanted, rest = refit(theta)
        seconds += solution.seconds
        half = 0.5 * np.abs(step)
        step = np.where(wanted * step < 0.0, np.clip(wanted, -half, half), wanted)
        moves = float(np.abs(step).max(initial=0.0))
        if moves < settled:
            break
        theta = theta + step
    else:
        message = f"not converged: the estimated {what} still moved by {moves:.1g} after {MAX_ROUNDS} rounds"
        solution = replace(solution, converged=False, message=message if solution.converged else solution.message)
    return replace(solution, seconds=seconds), rest


def _is_estimated(found: NoiseComponents, kept: frozenset[graph.NoiseName]) -> Booleans:
    """Whose noise is estimated: without joint noise what has redundancy enough."""
    enough = (graph.JOINT_NOISE in found.names) | (found.expected >= LEAST_REDUNDANCY)
    return enough & np.array([name not in kept for name in found.names], dtype=np.bool_)


def _steps(found: NoiseComponents, kept: frozenset[graph.NoiseName]) -> Floats:
    """Steps of the logarithms of the factors; 0 of those that are not estimated."""
    q, t = found.squares, found.expected
    free = np.flatnonzero(_is_estimated(found, kept) & ~((q < t) & (t < NEGLIGIBLE)))
    step = np.zeros(len(t))
    step[free] = _solve(found.information[np.ix_(free, free)], (0.5 * t * np.log(q / t))[free])
    return np.clip(step, -MAX_STEP, MAX_STEP)


def _solve(T: Floats, b: Floats) -> Floats:
    """T^-1 b, of least length where T is singular; T symmetric, scaled to a diagonal of 1."""
    by = 1.0 / np.sqrt(np.maximum(np.diag(T), TINY))
    return by * (np.linalg.pinv(T * by[:, None] * by, rcond=FLAT, hermitian=True) @ (by * b))


def _scaled(problem: graph.Problem, factors: Mapping[graph.NoiseName, float]) -> graph.Problem:
    """The problem from its start, with the specified noise of some kinds multiplied by factors."""

    def scale(p: graph.Problem) -> graph.Problem:
        return graph.relinearized_at(p, p.start, replace(p.state, factors={**p.state.factors, **factors}))

    return replace(scale(problem), whole=None if problem.whole is None else scale(problem.whole))
