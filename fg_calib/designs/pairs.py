"""Which pairs of configurations: all against a hub, each against the one before, each against the best that is there.

Where distances or angles are measured directly every pair costs a measurement, so n stops give n - 1 pairs by a *star*
(each with the hub), a *chain* (each with the one before) or a *tree* (each with whichever is best). These are taken one
after the other, each with the stop that it brings, the best of many. *Free* are the best n - 1 of all pairs of the
stops of the star. In choosing, an error of the readings that pairs share counts as each pair's own; what is then
reported of each is worked out with what they share.

Of pairs formed from measured poses any may be formed, and all of them hold the most.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.pool import selected
from fg_calib.designs.rows import StopRows
from fg_calib.designs.search import choose, not_worse_than_random
from fg_calib.designs.system import system_of
from fg_calib.designs.task import Posterior, Task
from fg_calib.graph.build import true_problem
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.information import whitened_jacobian
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, Options
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot
from fg_calib.robot.rotations import rotation_angle

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

Structure = Literal["star", "chain", "tree", "free"]

AT_ONCE = 2000
"""Pairs that are looked at for each that is taken."""


@dataclass(frozen=True)
class PairPlan(FrozenArrays):
    """Pairs to measure.

    Attributes:
        structure: Which stops are paired.
        table: What would be measured, in the order in which stops were taken.
        posterior: What would be known.
    """

    structure: Structure
    table: Table
    posterior: Posterior

    @property
    def readings(self) -> Floats:
        """The configurations, shape (n, n_joints)."""
        return self.table.measurements.readings


def plan_pairs(
    work: PairWork,
    first: int,
    n: int,
    structure: Structure,
    aim: tuple[Criterion, Task],
    generator: np.random.Generator,
) -> PairPlan:
    """The stops and pairs of a chain or a tree.

    Args:
        work: What would be measured between any two candidates.
        first: That with which it begins.
        n: How many stops beside that.
        structure: Which.
        aim: What is made small, and for what.
        generator: Draws which pairs of a tree are looked at.
    """
    readings = work.readings
    at_random = generator.integers(len(readings), size=(AT_ONCE, 2))
    criterion, task = aim
    base = work.problem(at_random)
    v = base.variables
    system = system_of(_stops(base, AT_ONCE), np.zeros((0, v.n_columns + v.n_nuisance)), task.form(base))
    chosen, pairs = [first], list[tuple[int, int]]()
    information = system.known
    while len(pairs) < min(n, len(readings) - 1):
        ends = [chosen[-1]] if structure == "chain" else chosen
        new = np.setdiff1d(np.arange(len(readings)), chosen)
        some = generator.permutation(new)[: max(1, AT_ONCE // len(ends))]
        asked = np.array([(a, b) for a in ends for b in some.tolist()])
        one = replace(system, rows=_rows(work.problem(asked), len(asked)) @ system.basis)
        k, _ = Measure(criterion, one).best(information, np.ones(len(asked), dtype=np.bool_))
        information = information + one.rows[k].T @ one.rows[k]
        pairs.append((int(asked[k, 0]), int(asked[k, 1])))
        chosen.append(int(asked[k, 1]))
    order = {stop: place for place, stop in enumerate(chosen)}
    found = work.table_of(np.array(chosen), np.array([(order[a], order[b]) for a, b in pairs]))
    return PairPlan(structure, found, work.posterior(found))


def free_pairs(work: PairWork, stops: Integers, n: int, aim: tuple[Criterion, Task], *, quickly: bool) -> PairPlan:
    """The best n of all pairs of some stops.

    Args:
        work: What would be measured between any two candidates.
        stops: Numbers of candidates.
        n: How many pairs.
        aim: What is made small, and for what.
        quickly: Whether they are not held to random sets.
    """
    asked = np.column_stack([stops[ends] for ends in np.triu_indices(len(stops), 1)])
    base, (criterion, task) = work.problem(asked), aim
    v = base.variables
    system = system_of(_stops(base, len(asked)), np.zeros((0, v.n_columns + v.n_nuisance)), task.form(base))
    best = choose(system, n, criterion)
    if not quickly:
        best = not_worse_than_random(Measure(criterion, system), best, np.random.default_rng(0))
    pairs = asked[best.candidates]
    used = np.array([k for k in stops.tolist() if (pairs == k).any()])
    place = {k: i for i, k in enumerate(used.tolist())}
    found = work.table_of(used, np.array([(place[a], place[b]) for a, b in pairs.tolist()]))
    return PairPlan("free", found, work.posterior(found))


class PairWork:
    """What would be measured between configurations.

    Args:
        robot: The arm.
        table: A table of directly measured pairs, for its model and noise.
        options: Of the problem.
        readings: The configurations.
    """

    def __init__(self, robot: Robot, table: Table, options: Options, readings: Floats) -> None:
        self._robot, self._table, self.readings, self._own = robot, table, readings, options
        self._options = replace(options, pair_errors="independent")
        assert table.measurements.pairs is not None
        pairs = table.measurements.pairs
        self._source = pairs.source
        self._sigma = float(np.nanmean(pairs.sigma_distance)) if np.isfinite(pairs.sigma_distance).any() else np.nan
        self._sigma_angle = float(np.nanmean(pairs.sigma_angle)) if np.isfinite(pairs.sigma_angle).any() else np.nan

    def problem(self, pairs: Integers) -> Problem:
        """The problem of some pairs, each with errors of its own."""
        return true_problem(self._robot, self.table_of(np.arange(len(self.readings)), pairs), self._options)

    def posterior(self, table: Table) -> Posterior:
        """What would be known of pairs, with the errors that they share."""
        problem = true_problem(self._robot, table, self._own)
        return Posterior(problem, whitened_jacobian(problem, problem.start))

    def first_of(self, plan: PairPlan, n: int) -> PairPlan:
        """The first n pairs of a chain or a tree, in the order in which they were taken, and their stops."""
        order = {name: k for k, name in enumerate(plan.table.measurements.ids[: n + 1].tolist())}
        found = selected(plan.table, order)
        return PairPlan(plan.structure, found, self.posterior(found))

    def table_of(self, chosen: Integers, pairs: Integers) -> Table:
        """A table of pairs, numbers of the chosen configurations, shape (n, 2)."""
        m, q = self._table.measurements, self.readings[chosen]
        at, n = pose(self._robot, q), len(pairs)
        bare = Measurements(
            readings=q,
            ids=np.array([f"p{k}" for k in chosen.tolist()]),
            test=np.zeros(len(q), dtype=np.bool_),
            position=None,
            rotation=None,
            sigma_position=None,
            sigma_orientation=None,
            sigma_joint=m.sigma_joint,
            source=m.source,
            named=True,
        )
        assert self._table.model is not None
        (wanted, wanted_angle), nothing = PAIR_MODELS[self._table.model], np.full(n, np.nan)
        a, b = pairs.T
        turned = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0]
        found = Pairs(
            a,
            b,
            distance=np.linalg.norm(at.position[b] - at.position[a], axis=1) if wanted else nothing,
            angle=turned if wanted_angle else nothing,
            sigma_distance=np.full(n, self._sigma),
            sigma_angle=np.full(n, self._sigma_angle),
            test=np.zeros(n, dtype=np.bool_),
            source=self._source,
        )
        return replace(self._table, measurements=replace(bare, pairs=found))


def _rows(problem: Problem, n: int) -> Floats:
    """Whitened rows of each of n pairs, zeros of those that take no part, shape (n, h, n_columns)."""
    at, v = problem.variables.at(problem.start), problem.variables
    h = max((rows.parts[0].block.residual_dim for rows in problem.rows), default=1)
    out = np.zeros((n, h, v.n_columns + v.n_nuisance))
    for rows in problem.rows:
        part = rows.parts[0]
        s = problem.data.series[part.series]
        out[s.number[s.train], : part.block.residual_dim] = rows.private(at)[:, :-1].reshape(
            len(s.train), part.block.residual_dim, -1
        )
    return out


def _stops(problem: Problem, n: int) -> StopRows:
    """Pairs as stops."""
    v = problem.variables
    known = np.pad(prior_rows(v, problem.start)[1], ((0, 0), (0, v.n_nuisance)))
    return StopRows(_rows(problem, n), known, v.all_scales, v.n_columns, v.n_robot_columns)
