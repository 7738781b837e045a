"""What each stop would add: the whitened rows of a problem, gathered by the stop that they are measured at.

Errors that belong to a stop (its joint readings, the pose that its pair was formed from) are that stop's own noise, of
whatever many rows it is; those of stops that others are measured against (the hub of a star) are further unknowns of
1 sigma each. So the information of a set of stops is the sum of theirs, exactly, and a stop adds `A^T A` of as many
rows as it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.errors import InputError
from fg_calib.graph.factors import prior_rows, unknown_prior_rows
from fg_calib.graph.problem import Problem
from fg_calib.graph.rows import RowSet

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FEW = 12
"""Rows of a stop up to which they are taken as they are; more are reduced to as many as they say."""

_NOTHING = 1e-10
"""Share of the rows of a stop that reducing them may lose."""


@dataclass(frozen=True)
class StopRows(FrozenArrays):
    """What stops would add to what is known.

    Attributes:
        rows: Whitened derivatives of each stop in the columns of the problem's core, its nuisances and the shared
            errors, zeros where a stop has fewer rows than others, shape (n_stops, h, n_columns).
        always: Rows that are there whatever is measured: priors, and shared errors of 1 sigma, shape (m, n_columns).
        scales: A change of ordinary size in each column, shape (n_columns,).
        n_core: How many columns, the first ones, are the core's.
        n_arm: How many of these, the first ones, are the arm's; the others are those of measurement frames.
    """

    rows: Floats
    always: Floats
    scales: Floats
    n_core: int
    n_arm: int


def stop_rows(problem: Problem, of: Integers, hubs: Integers | None = None, *, alone: bool = True) -> StopRows:
    """The rows of a problem by stop.

    Args:
        problem: The problem, linearised at its start.
        of: The stop of each configuration, shape (n_configurations,); below 0 for a hub, and where it is none.
        hubs: Configurations whose errors others share; none if None.
        alone: Whether nothing was measured before; else what is known of unknowns beside the arm is known from that.

    Raises:
        InputError: Errors of one stop reach the rows of another that is no hub.
    """
    v = problem.variables
    hubs = np.zeros(0, dtype=np.int64) if hubs is None else hubs
    n_columns, n_stops = v.n_columns + v.n_nuisance, int(of.max(initial=-1)) + 1
    width = max((rows.shared.width for rows in problem.rows if rows.shared is not None), default=0)
    A, loadings, stop = [], [], []
    for rows in problem.rows:
        J, L, hub, which = _of_set(problem, rows, of, hubs, width)
        A.append(np.hstack([J, hub]))
        loadings.append(L)
        stop.append(which)
    whole, own, which = np.concatenate(A), np.concatenate(loadings), np.concatenate(stop)
    stacked = _stacked(np.hstack([whole, own]), which, n_stops)
    of_stops = _whitened(stacked[:, :, : whole.shape[1]], stacked[:, :, whole.shape[1] :])
    fixed = [np.pad(prior_rows(v, problem.start)[1], ((0, 0), (0, v.n_nuisance)))]
    if alone:
        fixed.append(unknown_prior_rows(v, problem.start)[1])
    n_shared = whole.shape[1] - n_columns
    of_hubs = whole[which < 0] if alone else whole[:0]  # with the errors of hubs, which their pairs share
    wide = np.vstack([*(np.pad(rows, ((0, 0), (0, n_shared))) for rows in fixed), of_hubs])
    errors = np.hstack([np.zeros((n_shared, n_columns)), np.eye(n_shared)])
    scales = np.append(v.all_scales, np.ones(n_shared))
    return StopRows(of_stops, np.vstack([wide, errors]), scales, v.n_columns, v.n_robot_columns)


def _of_set(
    problem: Problem, rows: RowSet, of: Integers, hubs: Integers, width: int
) -> tuple[Floats, Floats, Floats, Integers]:
    """The rows of a set: derivatives, in the errors of their own stop, in those of hubs, and the stop of each."""
    J = rows.private(problem.variables.at(problem.start))[:, :-1]
    stop = np.concatenate([_stops_of(problem, part.series, part.block.residual_dim, of) for part in rows.parts])
    own, of_hubs = np.zeros((len(J), width)), np.zeros((len(J), len(hubs) * width))
    if rows.shared is not None:
        L = rows.shared.loadings.tocoo()
        configuration = rows.configurations[L.col // rows.shared.width]
        k = L.col % rows.shared.width
        for number, hub in enumerate(hubs.tolist()):
            there = configuration == hub
            of_hubs[L.row[there], number * width + k[there]] = L.data[there]
        there = ~np.isin(configuration, hubs)
        if np.any(of[configuration[there]] != stop[L.row[there]]):
            found = "pairs of which each shares an end with others, and its errors"
            raise InputError(problem.data.source, found, "pairing star")
        own[L.row[there], k[there]] = L.data[there]
    return J, own, of_hubs, stop


def _stops_of(problem: Problem, series: int, residual_dim: int, of: Integers) -> Integers:
    """The stop of each row of a series; -1 of those that no configuration is in."""
    s = problem.data.series[series]
    if not s.kind.ends:
        return np.full(len(s.train) * residual_dim, -1)
    found: Integers = np.repeat(of[problem.data.places[s.table][s.ends[s.train]]].max(axis=1), residual_dim)
    return found


def _stacked(rows: Floats, stop: Integers, n_stops: int) -> Floats:
    """Rows by stop, zeros below those of a stop that has fewer, shape (n_stops, h, n)."""
    chosen = np.flatnonzero(stop >= 0)
    order = chosen[np.argsort(stop[chosen], kind="stable")]
    counts = np.bincount(stop[chosen], minlength=n_stops)
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    if counts.max(initial=0) <= FEW:
        out = np.zeros((n_stops, max(1, int(counts.max(initial=0))), rows.shape[1]))
        out[stop[order], place] = rows[order]
        return out
    first = np.cumsum(counts) - counts
    few = [_reduced(rows[order[a : a + n]]) for a, n in zip(first.tolist(), counts.tolist(), strict=True)]
    out = np.zeros((n_stops, max(1, *(len(r) for r in few)), rows.shape[1]))
    for k, r in enumerate(few):
        out[k, : len(r)] = r
    return out


def _reduced(rows: Floats) -> Floats:
    """As few rows as say the same: those of the image of a board say what its pose would."""
    if len(rows) <= FEW:
        return rows
    _, s, Vt = np.linalg.svd(rows, full_matrices=False)
    kept = s > _NOTHING * s.max(initial=0.0)
    out: Floats = s[kept, None] * Vt[kept]
    return out


def _whitened(rows: Floats, loadings: Floats) -> Floats:
    """Rows less what errors of their own make of them, shapes (n, h, m) and (n, h, k): covariance 1 + L L^T."""
    if not loadings.any():
        return rows
    C = np.eye(rows.shape[1]) + loadings @ np.swapaxes(loadings, 1, 2)
    return np.linalg.solve(np.linalg.cholesky(C), rows)
