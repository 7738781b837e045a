r"""How much noise of each origin the residuals show: restricted likelihood of its components.

Noise of several origins, each known up to a factor on its sigma, reaches the rows: `C = sum over i of V_i`, with V_i
what the noise of one table and kind adds by itself, or that of the joint readings, which is one, as it is taken to be
now. With J the rows' derivatives, H their information with that of the priors and `P = C^-1 - C^-1 J H^-1 J^T C^-1`,
the derivative of the restricted log-likelihood in the logarithm of factor i, and the information in two of them, are

    r^T P V_i P r - tr(P V_i)    and    2 tr(P V_i P V_j)

(Patterson and Thompson 1971); where the former is 0 the second derivative is 2 tr(P V_i P V_j) - 4 r^T P V_i P V_j P r.
P r is C^-1 times the residuals at the estimate. Every V_i is E E^T with a sparse E, and nothing of n x n is formed
where the rows, or the errors that they share, are many.

Where rows are weighted by more than their noise (`RowSet.spare`: C = sum V_i + S), r^T P V_i P r has the mean
tr(P V_i) - tr(P V_i P S). A row with robust weight w counts as w rows. What pairs formed from poses have of noise
beyond the first order counts as that of the poses. Where measurements that share errors are asked to count as
independent, they do here too.

References:
    Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten. Allgemeine
    Vermessungs-Nachrichten 86.
    Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, 2nd ed., section 3.6. Springer.
    Patterson and Thompson (1971), Recovery of inter-block information when block sizes are unequal. Biometrika 58(3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.graph.information import eliminated
from fg_calib.graph.noise import JOINT_NOISE, NoiseName, RowNoise, Source
from fg_calib.graph.problem import Problem
from fg_calib.graph.rows import ErrorColumns, Part, RowSet, block_diagonal, whitener_of
from fg_calib.graph.solver import Solution
from fg_calib.statistics.covariance import Spread

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Sparse = scipy.sparse.csr_array


@dataclass(frozen=True)
class Components:
    """What the residuals say of the noise of each origin, as it is taken to be.

    Attributes:
        names: The origins.
        seen: r^T P V_i P r, shape (n,).
        expected: Its mean, were the noise as taken, shape (n,).
        products: tr(P V_i P V_j), shape (n, n): half of the information in the logarithms of the factors.
        products_seen: r^T P V_i P V_j P r, shape (n, n), of which the former is the mean.
    """

    names: tuple[NoiseName, ...]
    seen: Floats
    expected: Floats
    products: Floats
    products_seen: Floats


def has_joint_noise(problem: Problem) -> bool:
    """Whether the noise of joint readings reaches any fitted row."""
    return any(
        source.name == "joints" and bool(np.any(source.loading[noise.series.train]))
        for noise in problem.noises
        for source in noise.sources
    )


def noise_components(solution: Solution, spread: Spread) -> Components:
    """How much noise of each origin the residuals of a solution show.

    Args:
        solution: The solution.
        spread: Its covariance.
    """
    problem, parameters = solution.problem, solution.parameters
    names, at = _names(problem), problem.variables.at(parameters)
    half = _half(problem, parameters, spread)
    shares = ErrorColumns(
        problem.noises, problem.options.pair_errors == "shared", problem.state.joint_errors is not None
    )
    n, rank = len(names) + 1, half.shape[1]  # the last is what rows are weighted by on top
    seen, traces, of_fit = np.zeros(n), np.zeros(n), np.zeros((n, rank, rank))
    products, products_seen, taken_up = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, rank))
    for row_set in problem.rows:
        roots = _roots(problem, row_set, names, shares)
        rows = row_set.private(at)
        weighed = _weighed(row_set, np.column_stack([rows[:, :-1] @ half, rows[:, -1]]))
        Y, e = weighed[:, :-1], weighed[:, -1] / np.sqrt(_weights(problem, row_set))
        traces_here, squares = _products(row_set, roots)
        of_rows = [E.T @ Y for E in roots]
        reached = np.hstack([E @ A for E, A in zip(roots, of_rows, strict=True)])
        cross = reached.T @ (reached if row_set.shared is None else row_set.shared.roughly_weighed(reached))
        seen += [np.sum((E.T @ e) ** 2) for E in roots]
        parts = np.column_stack([E @ (E.T @ e) for E in roots])
        products_seen += parts.T @ _weighed(row_set, parts)
        taken_up += parts.T @ Y
        traces += traces_here
        of_fit += [A.T @ A for A in of_rows]
        products += squares - 2.0 * np.einsum("iaja->ij", cross.reshape(n, rank, n, rank))
    traces -= np.einsum("iaa->i", of_fit)
    products += np.einsum("iab,jba->ij", of_fit, of_fit)
    products_seen -= taken_up @ taken_up.T
    of_names = np.s_[:-1, :-1]
    return Components(names, seen[:-1], traces[:-1] - products[:-1, -1], products[of_names], products_seen[of_names])


def _names(problem: Problem) -> tuple[NoiseName, ...]:
    """The origins of noise of the fitted rows."""
    kinds = {
        (noise.series.table, family): None
        for noise in problem.noises
        if noise.series.used[noise.series.train].any()
        for family in _families(noise)
    }
    return (*kinds, JOINT_NOISE)


def _families(noise: RowNoise) -> list[str]:
    """The kind of noise of each row of a measurement."""
    return [name.partition(".")[0] for name in noise.series.kind.names]


def _half(problem: Problem, parameters: Floats, spread: Spread) -> Floats:
    """F with F F^T the covariance of all that is estimated, nuisances too, shape (n_columns + n_nuisance, rank)."""
    left = eliminated(problem, parameters)
    values, vectors = np.linalg.eigh(spread.tangent)
    core = vectors * np.sqrt(np.maximum(values, 0.0))
    own = np.vstack([np.zeros((len(core), left.inverse.shape[1])), left.inverse])
    return np.hstack([np.vstack([core, left.follow @ core]), own])


def _weighed(row_set: RowSet, rows: Floats) -> Floats:
    """C^-1 times rows whitened by their private noise."""
    if row_set.shared is None:
        return rows
    out: Floats = rows - row_set.shared.loadings @ row_set.shared.most_likely(rows)
    return out


def _products(row_set: RowSet, roots: Sequence[Sparse]) -> tuple[Floats, Floats]:
    """tr(C^-1 V_i) and tr(C^-1 V_i C^-1 V_j)."""
    if row_set.shared is not None:
        return row_set.shared.products(roots)
    squares = np.array([[(E.T @ F).power(2).sum() for F in roots] for E in roots])
    return np.array([E.power(2).sum() for E in roots]), squares


def _weights(problem: Problem, row_set: RowSet) -> Floats:
    """Robust weight of each row, shape (n_rows,)."""
    given, out = problem.state.weights, [np.zeros(0)]
    for part in row_set.parts:
        train = problem.noises[part.series].series.train
        weights = np.ones(len(train)) if given is None else np.maximum(given[part.series][train], 1e-12)
        out.append(np.repeat(weights, part.block.residual_dim))
    return np.concatenate(out)


def _roots(problem: Problem, row_set: RowSet, names: Sequence[NoiseName], shares: ErrorColumns) -> list[Sparse]:
    """E of each origin of noise, then that of what rows are weighted by on top, shapes (n_rows, k)."""
    found = []
    for name in names:
        parts = [_of_part(problem.noises[part.series], part, name, shares) for part in row_set.parts]
        private = scipy.sparse.block_diag([own for own, _ in parts], format="csr")
        found.append(Sparse(scipy.sparse.hstack([private, scipy.sparse.vstack([common for _, common in parts])])))
    n_rows = found[0].shape[0]
    return [*found, Sparse((n_rows, 0)) if row_set.spare is None else row_set.spare]


def _of_part(noise: RowNoise, part: Part, name: NoiseName, shares: ErrorColumns) -> tuple[Sparse, Sparse]:
    """How the whitened rows of a series follow from noise of one origin: what is each measurement's, and the rest."""
    train, W = noise.series.train, whitener_of(noise, part)
    n, h = W.shape[:2]
    blocks: list[Floats] = []
    if name == JOINT_NOISE:
        sources = [source for source in noise.sources if source.name == "joints"]
    else:
        mine = np.array([(noise.series.table, family) == name for family in _families(noise)])
        sources = [_of_rows(source, mine) for source in noise.sources if source.name != "joints" and mine.any()]
        blocks += [W @ _root(noise.own_at(train))[:, :, mine]]
    masks = {source.name: shares.mask(source)[train] for source in sources}
    for source in sources:
        alone = np.where(masks[source.name][:, None, :, None], 0.0, source.loading[train]).reshape(n, h, -1)
        blocks += [W @ alone] if alone.any() else []
    private = np.concatenate([np.zeros((n, h, 0)), *blocks], axis=2)
    return block_diagonal(private), shares.loading(noise, train, W, masks, sources)


def _of_rows(source: Source, mine: Booleans) -> Source:
    """A source as it reaches some of the rows of each measurement alone."""
    loading: Floats = source.loading * mine[:, None, None]
    return source._replace(loading=loading)


def _root(covariance: Floats) -> Floats:
    """Symmetric square roots of small covariances, shape (n, h, h)."""
    diagonal = np.einsum("nii->ni", covariance)
    if not np.any(covariance - diagonal[:, :, None] * np.eye(covariance.shape[1])):
        out: Floats = np.sqrt(np.maximum(diagonal, 0.0))[:, :, None] * np.eye(covariance.shape[1])
        return out
    values, vectors = np.linalg.eigh(covariance)
    root: Floats = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    return root
