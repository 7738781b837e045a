"""What a table of measurements holds: counts, copies, repeats, neighbours, pairs near 0 and half a turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fg_calib.graph.noise import PairNoise
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.measurements.table import Table

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NEAR = 1e-3
"""How far each reading of two configurations may be apart that are nearly the same, [rad] (prismatic: [m])."""

NEAR_KINK = 5.0
"""Sigma from 0, or of an angle from half a turn, within which the sign of noise matters."""


@dataclass(frozen=True)
class TableSurvey:
    """What a table of measurements holds.

    Attributes:
        name: Its name.
        model: Which of its measurements take part; None of kinds of one's own alone.
        n_rows: Rows.
        n_configurations: Different configurations by name.
        n_test: Rows that are predicted, never fitted.
        n_pairs: Train pairs that take part, measured or formed.
        n_test_pairs: Test pairs.
        n_residuals: Scalar residuals of the fit, by kind.
        labels: How many stations, targets, anchors, planes, boards or touched points it names, by what they are.
        n_copies: Rows, or measured pairs, that are the same as one before them in every figure.
        copy: Two that are the same; empty without.
        n_repeats: Those at the readings of one before them, with other figures: they tell of the noise.
        n_near: Configurations within `NEAR` of another, but not the same.
        n_leaked: Test rows at, or within `NEAR` of, a configuration of train rows.
        n_near_kink: Train pairs within `NEAR_KINK` sigma of 0 or, an angle, of half a turn.
        n_folded: Train pairs so near to that that tolerances let their vectors point either way.
    """

    name: str
    model: str | None
    n_rows: int
    n_configurations: int
    n_test: int
    n_pairs: int
    n_test_pairs: int
    n_residuals: dict[str, int]
    labels: dict[str, int]
    n_copies: int
    copy: str
    n_repeats: int
    n_near: int
    n_leaked: int
    n_near_kink: int
    n_folded: int


def survey_of(problem: Problem, number: int, table: Table) -> TableSurvey:
    """What a table holds.

    Args:
        problem: The problem.
        number: Number of the table in it.
        table: The table, with the test rows that it states.
    """
    m = table.measurements
    copies, copy, repeats = _same_pairs(m, m.pairs) if table.uses_pairs and m.pairs is not None else _same_rows(m)
    near, leaked = _neighbours(m)
    kink, folded = _near_kinks(problem, number)
    series = [s for s in problem.data.series if s.table == number]
    of_pairs = [s for s in series if s.kind.ends == 2]
    n_residuals: dict[str, int] = {}
    for s in series:
        for name, n in zip(s.kind.names, s.used[s.train].sum(axis=0).tolist(), strict=True):
            family = name.partition(".")[0]
            n_residuals[family] = n_residuals.get(family, 0) + int(n)
    labels = {what: len(of.names) for what, of in m.labels.items()}
    return TableSurvey(
        name=problem.data.labels[number],
        model=table.model,
        n_rows=m.n_configurations,
        n_configurations=len(np.unique(problem.data.places[number])),
        n_test=int(m.test.sum()),
        n_pairs=len({k for s in of_pairs for k in s.number[s.train].tolist()}),
        n_test_pairs=len({k for s in of_pairs for k in s.number[s.test].tolist()}),
        n_residuals=n_residuals,
        labels=labels | ({} if m.groups is None else {"touched point": m.groups.n_groups}),
        n_copies=copies,
        copy=copy,
        n_repeats=repeats,
        n_near=near,
        n_leaked=leaked,
        n_near_kink=kink,
        n_folded=folded,
    )


def _same_rows(m: Measurements) -> tuple[int, str, int]:
    """How many rows equal an earlier one, names of two, and how many have its readings but other figures."""
    columns = [m.readings, *(of.index[:, None] for of in m.labels.values())]
    columns += [] if m.groups is None else [m.groups.index[:, None]]
    columns += [] if m.image is None else [m.image[:, 2:]]
    figures = [m.position, m.rotation, m.length, m.image]
    measured = [v.reshape(m.n_configurations, -1) for v in figures if v is not None]
    return _same(np.hstack(columns), measured, m.ids)


def _same_pairs(m: Measurements, pairs: Pairs) -> tuple[int, str, int]:
    """The same of measured pairs, whichever end is a."""
    a, b = np.sort(np.stack([pairs.a, pairs.b]), axis=0)
    names = np.array([f"{m.ids[i]}-{m.ids[j]}" for i, j in zip(a.tolist(), b.tolist(), strict=True)])
    return _same(np.stack([a, b], axis=1).astype(np.float64), [np.stack([pairs.distance, pairs.angle], axis=1)], names)


def _same(places: Floats, measured: Sequence[Floats], names: NDArray[np.str_]) -> tuple[int, str, int]:
    """How many rows equal an earlier one, names of two, and how many have its place but other figures.

    Args:
        places: Where each row was measured, shape (n, k).
        measured: What was, shape (n, width) each; nan where not.
        names: Of the rows.
    """
    rows = np.arange(len(places))
    same = _first_like(np.hstack([places, *(np.nan_to_num(v, nan=-1e300) for v in measured)]))
    copied = np.flatnonzero(same != rows) if measured else rows[:0]
    repeats = int(np.sum(_first_like(places) != rows)) - len(copied)
    two = [str(names[same[copied[0]]]), str(names[copied[0]])] if len(copied) else []
    return len(copied), " and ".join(dict.fromkeys(two)), repeats


def _first_like(rows: Floats) -> Integers:
    """Number of the first row that equals each, shape (n,)."""
    whole = np.ascontiguousarray(rows + 0.0)  # no -0
    keys = whole.view(np.dtype((np.void, whole.itemsize * whole.shape[1])))[:, 0]
    _, first, of = np.unique(keys, return_index=True, return_inverse=True)
    found: Integers = first[of.ravel()]
    return found


def _neighbours(m: Measurements) -> tuple[int, int]:
    """Configurations that are nearly another, and test rows that are at or near those of train rows."""
    q, first = np.unique(m.readings, axis=0, return_index=True)
    near = 0
    if len(first) > 1:
        distance, _ = cKDTree(q).query(q, k=2, p=np.inf, distance_upper_bound=NEAR)
        near = int(np.sum(np.isfinite(np.asarray(distance)[:, 1])))
    if not m.test.any() or m.test.all():
        return near, 0
    distance, _ = cKDTree(m.readings[~m.test]).query(m.readings[m.test], p=np.inf, distance_upper_bound=NEAR)
    return near, int(np.sum(np.isfinite(distance)))


def _near_kinks(problem: Problem, number: int) -> tuple[int, int]:
    """Train pairs near 0 or half a turn: within noise, and within tolerances."""
    near = folded = 0
    scales = np.diag(problem.variables.prior_scales)
    for noise in problem.noises:
        s = noise.series
        if s.table != number or not isinstance(noise, PairNoise):
            continue
        families = [name.partition(".")[0] for name in s.kind.names]
        from_kink = np.stack(
            [
                np.minimum(v, np.pi - v) if family == "angle" else v
                for v, family in zip(s.data.T, families, strict=True)
            ],
            axis=1,
        )
        is_near = (from_kink < NEAR_KINK * noise.sigma) & s.used
        near += int(np.sum(is_near[s.train].any(axis=1)))
        may_fold = noise.may_fold(scales) & s.used
        folded += int(np.sum(may_fold[s.train].any(axis=1)))
    return near, folded
