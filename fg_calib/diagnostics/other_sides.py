"""The other side of a fold: of lengths near 0, and angles near 0 or half a turn, vectors may point the other way.

Rows see how long a vector v is, so an arm that has -v there explains them as well. What all rows but those that may
fold, and the priors, leave open has the covariance S S^T. Within it the nearest arm with -v is, to first order,

    x - 2 |v| S u / |u|,   2 |v| / |u| sigma away,   with u = S^T g and g the derivative of |v|.

Rows that see one vector take that step together; where several vectors are open, each has its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.information import directions
from fg_calib.graph.noise import NoiseState, PairNoise, RowNoise
from fg_calib.graph.problem import Problem, assembled
from fg_calib.graph.solver import Solution
from fg_calib.robot.kinematics import SPAN

Floats = NDArray[np.float64]
Folds = tuple[NDArray[np.bool_], ...]
Places = tuple[NDArray[np.int64], NDArray[np.int64]]

TOLERANCES = 2.0
"""Tolerances within which vectors may point the other way."""

FARTHEST = 6.0
"""An arm further away than that, [sigma] of what other rows leave open, is not the true one where this one fits."""

MUCH = 1.2
"""Chi-square over the number of residuals from which it does not."""

LEAST_SHARE = 0.3
"""Part of what is known in some direction that must rest on the rows that may fold: else the others say where it is."""

ALIKE = 0.9
"""Cosine of two steps from which they are one."""

MOST = 4
"""Steps that are tried from one estimate."""

OPEN = 0.1
"""Signal-to-noise ratio below which a direction is not taken for weaker."""


def folds_of(noises: tuple[RowNoise, ...], tolerances: Floats) -> Folds:
    """The train rows that tolerances may fold, shape (n, residual_dim) of each series.

    Args:
        noises: The rows of each series.
        tolerances: Of each column, shape (n_columns,).
    """
    found, spread = [], TOLERANCES * np.diag(tolerances)
    for noise in noises:
        s = noise.series
        folds = noise.may_fold(spread) & s.used if isinstance(noise, PairNoise) else np.zeros_like(s.measured)
        folds[s.test] = False
        found.append(folds)
    return tuple(found)


def without(problem: Problem, folds: Folds, start: Floats, state: NoiseState) -> Problem:
    """A problem without the rows that may fold, whitened and started at a parameter vector."""
    kept = [replace(s, measured=s.measured & ~mine) for s, mine in zip(problem.data.series, folds, strict=True)]
    return assembled(problem, start, state, data=replace(problem.data, series=tuple(kept)))


def other_sides(solution: Solution) -> list[Floats]:
    """Steps from an estimate to arms that have vectors the other way, the nearest first, shape (n_columns,) each."""
    problem, at = solution.problem, solution.parameters
    scales = problem.variables.prior_scales
    if not problem.pair_series or problem.evaluated:
        return []
    folds = folds_of(solution.noises, scales)
    far = 2.0 * solution.objective > MUCH * problem.n_residuals
    if not any(mine.any() for mine in folds) or not (far or _share(solution, folds) >= LEAST_SHARE):
        return []
    S = wide_root(without(problem, folds, at, problem.state), at)
    nearest = np.zeros((0, S.shape[1]))
    for noise, some in _in_spans(solution, folds):
        nearest = _different(np.concatenate([nearest, noise.ways_around(some, S)]), np.inf if far else FARTHEST)
    return [S @ step for step in nearest]


def _in_spans(solution: Solution, folds: Folds) -> Iterator[tuple[PairNoise, Places]]:
    """The rows that may fold, some at a time: row and figure of each."""
    for noise, mine in zip(solution.noises, folds, strict=True):
        if isinstance(noise, PairNoise):
            rows, part = np.nonzero(mine)
            for start in range(0, len(rows), SPAN):
                yield noise, (rows[start : start + SPAN], part[start : start + SPAN])


def _share(solution: Solution, folds: Folds) -> float:
    """Largest part of what is known in any direction that rows say, as if all their noise were their own."""
    S = wide_root(solution.problem, solution.parameters)
    gram = np.zeros((S.shape[1],) * 2)
    for noise, (rows, part) in _in_spans(solution, folds):
        variance = np.einsum("nii->ni", noise.total_at(rows))[np.arange(len(rows)), part]
        along = noise.derivatives_along((rows, part), S) / np.sqrt(variance)[:, None]
        gram += along.T @ along
    return float(np.linalg.eigvalsh(gram)[-1])


def _different(steps: Floats, farthest: float) -> Floats:
    """The shortest of some steps that are not alike, the nearest first, shape (m, k)."""
    length, kept = np.linalg.norm(steps, axis=1), list[int]()
    for i in np.argsort(length, kind="stable").tolist():
        if length[i] > farthest or len(kept) == MOST:
            break
        if np.all(np.abs(steps[kept] @ steps[i]) < ALIKE * length[kept] * length[i]):
            kept.append(i)
    return steps[kept]


def wide_root(problem: Problem, parameters: Floats) -> Floats:
    """A square root of the parameters' covariance, of what nothing determines wide, shape (n_columns, n_columns)."""
    s, V = directions(problem, parameters)
    out: Floats = problem.variables.prior_scales[:, None] * V / np.maximum(s, OPEN)
    return out
