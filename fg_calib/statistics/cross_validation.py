"""Cross-validation: every configuration held out once, and how much the estimate depends on which are there.

Configurations are dealt into folds, never rows, and those of the same readings together: they share joint noise and
what the model lacks there, so that a row left in would tell of one left out. Each fold is predicted by a calibration of
all others. What only a few configurations know of, such as an anchor, is dealt over different folds; where too few
would be left to say where it is, and where one is an end of most measured pairs, they are never held out.

With the estimate e_k of the calibration without fold k of g, the *spread* of a parameter is its jackknife over groups

    sqrt((g - 1) / g sum_k (e_k - mean e)^2),

which is its sigma where measurements determine it and the noise is as stated, known to a share of 1 / sqrt(2 (g - 1)).
It is less where tolerances determine it, and more where what the model lacks does not average out. Of pairs it is 1.4
to 1.7 times as large: measured ones leave with either end, formed ones are formed anew.

References:
    Shao & Tu (1995), The Jackknife and Bootstrap, section 2.3: the jackknife that deletes groups.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays
from fg_calib.errors import InputError, ProblemError
from fg_calib.executors import Failure, map_jobs
from fg_calib.graph.build import problem_of
from fg_calib.job import Job
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.measurements.gathering import Dataset
from fg_calib.measurements.series import Table
from fg_calib.options import check_number
from fg_calib.statistics.residual_table import DIGITS, HeldOut, pooled, residual_table
from fg_calib.statistics.variance_components import solve_job

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

CHANCE = 1e-3
"""Probability with which noise as stated alone makes the spread of any parameter worth naming."""

_HUB = 0.5
"""Share of the measured pairs from which on a configuration that is in them is never held out."""


@dataclass(frozen=True)
class Folds(FrozenArrays):
    """What cross-validation found.

    Attributes:
        n: Number of folds.
        fold: Of each configuration that is fitted, -1 where it is never held out, shape (n_configurations,).
        by_table: Held-out residuals by table and kind.
        kinds: Those by kind.
        of_pairs: Whether pairs take part, whose spread is larger than their sigma.
        names: Every parameter of the robot.
        spread: Jackknife of each, shape (n_parameters,), [m] and [rad].
        not_converged: Number of folds without which the solver did not converge.
    """

    n: int
    fold: Integers
    by_table: dict[tuple[str, str], HeldOut]
    kinds: dict[str, HeldOut]
    of_pairs: bool
    names: tuple[str, ...]
    spread: Floats
    not_converged: int

    def beyond(self, sigma: Mapping[str, float | None]) -> tuple[dict[str, float], list[str]]:
        """Spread over sigma of each parameter that has one, and those whose spread is not that large by chance.

        Args:
            sigma: 1 sigma of parameters by name; None where it is not known.
        """
        spread = dict(zip(self.names, self.spread.tolist(), strict=True))
        ratio = {name: spread[name] / s for name, s in sigma.items() if s}
        return ratio, [] if self.of_pairs else wide(ratio, self.n)


def wide(ratio: Mapping[str, float], n: int) -> list[str]:
    """Parameters whose spread over sigma is larger than chance makes it, the largest first.

    Args:
        ratio: Spread over sigma by name.
        n: Number of folds.
    """
    most = np.sqrt(special.chdtri(n - 1, CHANCE / max(len(ratio), 1)) / (n - 1))
    return sorted((name for name in ratio if ratio[name] > most), key=lambda name: -ratio[name])


@checked
def cross_validate(job: Job, n: int = 5, seed: int = 0, *, executor: Executor | None = None) -> Folds:
    """Hold every configuration out once, and calibrate without it.

    Args:
        job: The job; its test rows take no part.
        n: Number of folds; one of all configurations is held out at a time.
        seed: What deals the configurations.
        executor: Where the folds are calibrated; one after the other in this process if None.

    Raises:
        InputError: There are more folds than configurations to hold out.
        ProblemError: The measurements of all but one fold do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    check_number("folds", n, least=2, whole=True)
    own = [table for table in job.tables if table.own]
    if own:
        raise InputError("folds", f"measurements of one's own in {own[0].measurements.source}", "tables without")
    tables = _train(job.tables)
    if not tables:
        raise InputError("folds", "test rows alone", "rows to calibrate with, and to hold out")
    whole = replace(job, measurements=tables)
    data = problem_of(whole).data  # whose tables are those of one station each
    fold = _dealt(data, n, np.random.default_rng(seed))
    if len(np.unique(fold[fold >= 0])) < n:
        raise InputError("folds", f"found {n}", f"at most {np.sum(fold >= 0)}: so many configurations can be held out")
    without = [
        tuple(_held_out(table, fold[place], k) for table, place in zip(data.tables, data.places, strict=True))
        for k in range(n)
    ]
    names = [f"without fold {k + 1} of {n}" for k in range(n)]
    jobs = [replace(whole, measurements=tables) for tables in without]
    found = map_jobs(_calibrated, jobs, executor, names=names, what="calibrating without one fold after the other")
    folds = []
    for one in found:
        if isinstance(one, Failure):
            if one.trace:
                raise one.error()
            raise ProblemError("folds", f"{one.job}: {one.reason}")
        folds.append(one)
    by_table = _by_table([fold.held for fold in folds])
    kinds = dict.fromkeys(kind for _, kind in by_table)
    return Folds(
        n=n,
        fold=fold,
        by_table=by_table,
        kinds={kind: pooled([held for (_, of), held in by_table.items() if of == kind]) for kind in kinds},
        of_pairs=any(table.uses_pairs for table in data.tables),
        names=tuple(p.name for p in job.robot.parameters),
        spread=np.sqrt((n - 1) * np.var([fold.of_arm for fold in folds], axis=0)),
        not_converged=sum(not fold.converged for fold in folds),
    )


class _Fold(NamedTuple):
    """What a calibration without a fold found: the arm's parameters, held-out residuals, and whether it arrived."""

    of_arm: Floats
    held: dict[tuple[str, str], HeldOut]
    converged: bool


def _calibrated(job: Job) -> _Fold:
    solution = solve_job(job)
    of_arm = solution.parameters[solution.problem.variables.robot_span]
    return _Fold(of_arm, residual_table(solution).held_out(solution.problem.data.labels), solution.converged)


def _train(tables: Sequence[Table]) -> tuple[Table, ...]:
    """Tables without their test rows; those that have no others are left out."""
    touched = {name for table in tables for name in _touched(table.measurements)}
    found = (_train_rows(table, touched) for table in tables)
    return tuple(table for table in found if table.measurements.n_configurations)


def _touched(m: Measurements) -> set[str]:
    """Names of the points that train rows touch."""
    if m.groups is None:
        return set()
    there = np.unique(m.groups.index[~m.test])
    return {m.groups.names[g] for g in there[there >= 0]}


def _train_rows(table: Table, touched: set[str]) -> Table:
    m = table.measurements
    rows = np.flatnonzero(~m.test)
    place = np.full(m.n_configurations, -1)
    place[rows] = np.arange(len(rows))
    pairs, groups = m.pairs, m.groups
    if pairs is not None:
        pairs = pairs.select(~pairs.test & (place[pairs.a] >= 0) & (place[pairs.b] >= 0))
        pairs = replace(pairs, a=place[pairs.a], b=place[pairs.b])
    if groups is not None:
        known = np.array([name in touched for name in groups.names], dtype=np.bool_)
        between = groups.pairs.select(~groups.pairs.test & known[groups.pairs.a] & known[groups.pairs.b])
        groups = replace(groups, index=groups.index[rows], pairs=between)
    return replace(table, measurements=replace(m.select(rows), pairs=pairs, groups=groups))


def _held_out(table: Table, fold: Integers, k: int) -> Table:
    """A table with the rows of fold k to be predicted; measured pairs that they are in leave with them.

    A pair between two folds is fitted without neither, and predicted with the first that it has.

    Args:
        table: The table.
        fold: Of its configurations, shape (n_configurations,).
        k: The fold.
    """
    m, held = table.measurements, fold == k
    pairs: Pairs | None = m.pairs
    if pairs is not None:
        a, b = fold[pairs.a], fold[pairs.b]
        touches, predicted = (a == k) | (b == k), np.where(a >= 0, a, b) == k
        pairs = replace(pairs, test=touches).select(~touches | predicted)
    return replace(table, measurements=replace(m, test=held, pairs=pairs))


def _dealt(data: Dataset, n: int, rng: np.random.Generator) -> Integers:
    """The fold of each configuration, -1 where it is never held out, shape (n_configurations,).

    Configurations of the same readings go together: one of them tells of the others. One place after the other goes to
    a fold that has fewest of what it knows of, then fewest of all.
    """
    known_by = list(_known_by(data))
    _, place = np.unique(np.round(data.readings, DIGITS), axis=0, return_inverse=True)
    place = place.ravel()
    knows: list[set[int]] = [set() for _ in range(place.max() + 1)]
    for label, (configurations, _) in enumerate(known_by):
        for k in configurations:
            knows[place[k]].add(label)
    kept = np.zeros(len(knows), dtype=np.bool_)
    kept[place[_hubs(data)]] = True
    fold = np.full(len(knows), -1)
    load, size = np.zeros((len(known_by), n)), np.zeros(n)
    for k in rng.permutation(np.flatnonzero(~kept)).tolist():
        of_labels = load[list(knows[k])].sum(axis=0)
        best = np.flatnonzero(of_labels == of_labels.min())
        best = best[size[best] == size[best].min()]
        fold[k] = rng.choice(best)
        load[list(knows[k]), fold[k]] += 1.0
        size[fold[k]] += 1.0
    found = fold[place]
    for configurations, needed in known_by:  # who would be missed
        left = len(configurations) - np.bincount(found[configurations] + 1, minlength=n + 1)[1:].max()
        if left < needed:
            found[np.isin(place, place[configurations])] = -1
    return found


NEEDED = {"anchor": 4, "plane": 4, "station": 3, "target": 2, "board": 2}
"""Configurations that must be left of those that know of an anchor, a station, ...: fewer do not say where it is."""


def _known_by(data: Dataset) -> Iterator[tuple[list[int], int]]:
    """The configurations that know of each unknown thing or frame besides the arm, and how many of them are needed."""
    by_name: dict[tuple[str, str], list[int]] = {}
    for number, (table, place) in enumerate(zip(data.tables, data.places, strict=True)):
        m = table.measurements
        if table.unknown_frame:
            by_name["station", str(number)] = place.tolist()
        named = [(what, labels.names, labels.index) for what, labels in m.labels.items()]
        named += [] if m.groups is None else [("group", m.groups.names, m.groups.index)]
        for what, names, index in named:
            for i, name in enumerate(names):
                by_name.setdefault((what, name), []).extend(place[index == i].tolist())
    for (what, _), configurations in by_name.items():
        yield sorted(set(configurations)), NEEDED.get(what, 1)


def _hubs(data: Dataset) -> Booleans:
    """Which configurations are an end of most measured pairs of a table, shape (n_configurations,)."""
    found = np.zeros(data.n_configurations, dtype=np.bool_)
    for table, place in zip(data.tables, data.places, strict=True):
        pairs = table.measurements.pairs
        if pairs is not None and pairs.n_pairs > 1:
            n = np.bincount(np.concatenate([place[pairs.a], place[pairs.b]]), minlength=len(found))
            found |= n > _HUB * pairs.n_pairs
    return found


def _by_table(by_fold: Sequence[dict[tuple[str, str], HeldOut]]) -> dict[tuple[str, str], HeldOut]:
    """Held-out residuals of all folds together, by table and kind."""
    keys = dict.fromkeys(key for held in by_fold for key in held)
    return {key: pooled([held[key] for held in by_fold if key in held]) for key in keys}
