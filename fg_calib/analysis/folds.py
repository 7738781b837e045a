"""Cross-validation: every configuration held out once, and how much the estimate depends on which are there.

Configurations are dealt into folds, never rows: rows of one configuration share its joint noise and what the model
lacks there, so that a row left in would tell of one left out. Each fold is predicted by a calibration of all others.
What only a few configurations know of, such as an anchor, is dealt over different folds; where one alone knows of it,
or where it is an end of most measured pairs, the configuration is never held out.

With the estimate e_k of the calibration without fold k of g, the *spread* of a parameter is its jackknife over groups

    sqrt((g - 1) / g sum_k (e_k - mean e)^2),

which is its sigma where measurements determine it and the noise is as stated, known to a share of 1 / sqrt(2 (g - 1)).
It is less where tolerances determine it, and more where what the model lacks does not average out.

References:
    Shao & Tu (1995), The Jackknife and Bootstrap, section 2.3: the jackknife that deletes groups.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.analysis.residual_table import HeldOut, residual_table
from fg_calib.analysis.variance_components import solve_job
from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays
from fg_calib.errors import CalibrationError, InputError, ProblemError
from fg_calib.graph.build import problem_of
from fg_calib.graph.solver import Solution
from fg_calib.job import Job
from fg_calib.measurements.dataset import Pairs
from fg_calib.measurements.gathering import Dataset
from fg_calib.measurements.series import Table
from fg_calib.options import check_number
from fg_calib.progress import tell

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
        kinds: Held-out residuals by kind.
        names: Every parameter of the robot.
        spread: Jackknife of each, shape (n_parameters,), [m] and [rad].
        not_converged: Number of folds without which the solver did not converge.
    """

    n: int
    fold: Integers
    kinds: dict[str, HeldOut]
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
        return ratio, wide(ratio, self.n)


def wide(ratio: Mapping[str, float], n: int) -> list[str]:
    """Parameters whose spread over sigma is larger than chance makes it, the largest first.

    Args:
        ratio: Spread over sigma by name.
        n: Number of folds.
    """
    most = np.sqrt(special.chdtri(n - 1, CHANCE / max(len(ratio), 1)) / (n - 1))
    return sorted((name for name in ratio if ratio[name] > most), key=lambda name: -ratio[name])


@checked
def cross_validate(job: Job, n: int = 5, seed: int = 0) -> Folds:
    """Hold every configuration out once, and calibrate without it.

    Args:
        job: The job; its test rows take no part.
        n: Number of folds; one of all configurations is held out at a time.
        seed: What deals the configurations.

    Raises:
        InputError: There are more folds than configurations to hold out.
        ProblemError: The measurements of all but one fold do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    check_number("folds", n, least=2, whole=True)
    tables = tuple(map(_train, job.tables))
    tables = tuple(table for table in tables if table.measurements.n_configurations)
    whole = replace(job, measurements=tables)
    data = problem_of(whole).data  # whose tables are those of one station each
    fold = _dealt(data, n, np.random.default_rng(seed))
    if len(np.unique(fold[fold >= 0])) < n:
        raise InputError(
            "folds", f"found {n}", f"at most {np.sum(fold >= 0)}, one a configuration that can be held out"
        )
    solutions = []
    for k in range(n):
        tell("calibrating without one fold after the other", k, n)
        held = [_held_out(table, fold[place] == k) for table, place in zip(data.tables, data.places, strict=True)]
        try:
            solutions.append(solve_job(replace(whole, measurements=tuple(held))))
        except CalibrationError as error:
            raise ProblemError("folds", f"without fold {k + 1} of {n}: {error}") from error
    of_arm = [solution.parameters[solution.problem.variables.robot_span] for solution in solutions]
    return Folds(
        n=n,
        fold=fold,
        kinds=_pooled(solutions),
        names=tuple(p.name for p in job.robot.parameters),
        spread=np.sqrt((n - 1) * np.var(of_arm, axis=0)),
        not_converged=sum(not solution.converged for solution in solutions),
    )


def _train(table: Table) -> Table:
    """A table without its test rows."""
    m = table.measurements
    rows = np.flatnonzero(~m.test)
    place = np.full(m.n_configurations, -1)
    place[rows] = np.arange(len(rows))
    pairs, groups = m.pairs, m.groups
    if pairs is not None:
        pairs = pairs.select(~pairs.test & (place[pairs.a] >= 0) & (place[pairs.b] >= 0))
        pairs = replace(pairs, a=place[pairs.a], b=place[pairs.b])
    if groups is not None:
        index = groups.index[rows]
        touched = np.isin(np.arange(groups.n_groups), index)
        between = groups.pairs
        groups = replace(
            groups, index=index, pairs=between.select(~between.test & touched[between.a] & touched[between.b])
        )
    return replace(table, measurements=replace(m.select(rows), pairs=pairs, groups=groups))


def _held_out(table: Table, held: Booleans) -> Table:
    """A table with some rows to be predicted, and the measured pairs that they are in."""
    m = table.measurements
    pairs: Pairs | None = m.pairs
    if pairs is not None:
        pairs = replace(pairs, test=held[pairs.a] | held[pairs.b])
    return replace(table, measurements=replace(m, test=held, pairs=pairs))


def _dealt(data: Dataset, n: int, rng: np.random.Generator) -> Integers:
    """The fold of each configuration, -1 where it is never held out, shape (n_configurations,).

    One after the other goes to a fold that has fewest of what it knows of, then fewest configurations.
    """
    known_by = list(_known_by(data))
    knows: list[list[int]] = [[] for _ in range(data.n_configurations)]
    for label, configurations in enumerate(known_by):
        for k in configurations:
            knows[k].append(label)
    fold, kept = np.full(data.n_configurations, -1), _kept(data, known_by)
    load, size = np.zeros((len(known_by), n)), np.zeros(n)
    for k in rng.permutation(np.flatnonzero(~kept)).tolist():
        of_labels = load[knows[k]].sum(axis=0)
        best = np.flatnonzero(of_labels == of_labels.min())
        best = best[size[best] == size[best].min()]
        fold[k] = rng.choice(best)
        load[knows[k], fold[k]] += 1.0
        size[fold[k]] += 1.0
    return fold


def _known_by(data: Dataset) -> Iterator[list[int]]:
    """The configurations that know of each unknown thing or frame besides the arm."""
    for table, place in zip(data.tables, data.places, strict=True):
        m = table.measurements
        if table.unknown_frame:
            yield np.unique(place).tolist()
        for labels in m.labels.values():
            for i in range(len(labels.names)):
                yield np.unique(place[labels.index == i]).tolist()
        if m.groups is not None:
            for g in range(m.groups.n_groups):
                yield np.unique(place[m.groups.index == g]).tolist()


def _kept(data: Dataset, known_by: list[list[int]]) -> Booleans:
    """Which configurations are never held out, shape (n_configurations,)."""
    kept = np.zeros(data.n_configurations, dtype=np.bool_)
    for configurations in known_by:
        if len(configurations) < 2:
            kept[configurations] = True
    for table, place in zip(data.tables, data.places, strict=True):
        pairs = table.measurements.pairs
        if pairs is not None and pairs.n_pairs > 1:
            n = np.bincount(np.concatenate([place[pairs.a], place[pairs.b]]), minlength=len(kept))
            kept |= n > _HUB * pairs.n_pairs
    return kept


def _pooled(solutions: Sequence[Solution]) -> dict[str, HeldOut]:
    """Held-out residuals of all folds together, by kind."""
    by_fold = [residual_table(solution).held_out() for solution in solutions]
    found = {}
    for family in dict.fromkeys(family for held in by_fold for family in held):
        parts = [held[family] for held in by_fold if family in held]
        n = np.array([part.n for part in parts])
        rms = (np.array([getattr(part, of) for part in parts]) for of in ("before", "after", "noise"))
        found[family] = HeldOut(int(n.sum()), *(float(np.sqrt(n @ v**2 / n.sum())) for v in rms))
    return found
