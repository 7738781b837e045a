"""What is to be measured at the stops that were chosen: tables, the hub of a star, and which pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.order import shortest_way
from fg_calib.designs.pairs import PairPlan, PairWork, Structure, free_pairs, plan_pairs
from fg_calib.designs.pool import Pool, pool_of
from fg_calib.designs.search import greedy
from fg_calib.designs.system import system_of
from fg_calib.designs.task import Posterior, Task
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

N_HUBS = 12
"""Configurations that are tried as the hub of a star."""

N_FEW = 300
"""Candidates that each is tried with."""

N_HUB_STOPS = 20
"""Stops that each is tried with, at most."""


@dataclass(frozen=True)
class Plan:
    """What is to be measured, and what would then be known."""

    tables: list[Table]
    readings: Floats
    names: list[str]
    group: NDArray[np.str_]
    posterior: Posterior
    pairs: Integers | None


def with_names(tables: Sequence[Table], names: Mapping[str, str]) -> list[Table]:
    """Tables with other names of their configurations."""
    return [
        replace(t, measurements=replace(t.measurements, ids=np.array([names[i] for i in t.measurements.ids.tolist()])))
        for t in tables
    ]


def plan_of_stops(pool: Pool, stops: Integers) -> Plan:
    """Some stops, in their order; a hub is visited first."""
    measured, data = stops[len(pool.given) :], pool.problem.data
    number = {stop: k for k, stop in enumerate(pool.stop.tolist())}
    tables = pool.tables_of(measured)
    there = {name for table in tables for name in table.measurements.ids.tolist()}
    hubs = [k for k in pool.hubs.tolist() if data.names[k] in there]
    order = [*hubs, *(number[stop] for stop in measured.tolist())]
    names = [data.names[k] for k in order]
    return Plan(
        tables=tables,
        readings=data.readings[order],
        names=names,
        group=pool.groups_of(np.array(order, dtype=np.int64)),
        posterior=pool.posterior(stops),
        pairs=_pairs_among(names, tables),
    )


def _pairs_among(names: Sequence[str], tables: Sequence[Table]) -> Integers | None:
    """Places among some names of the ends of all pairs that tables measure directly; None without any."""
    place, found = {name: k for k, name in enumerate(names)}, []
    for table in tables:
        m = table.measurements
        if m.pairs is not None:
            where = np.array([place[name] for name in m.ids.tolist()], dtype=np.int64)
            found.append(where[np.stack([m.pairs.a, m.pairs.b], axis=1)])
    return np.concatenate(found) if found else None


def plan_of_pairs(pool: Pool, found: PairPlan) -> Plan:
    """A chain or a tree of pairs; a tree in an order that is short for the joints."""
    m = found.table.measurements
    assert m.pairs is not None
    pairs = np.stack([m.pairs.a, m.pairs.b], axis=1)
    names = m.ids.tolist()
    return Plan([found.table], m.readings, names, np.full(len(names), ""), found.posterior, pairs)


def errors_by_pairing(pool: Pool, stops: Integers, task: Task) -> dict[str, float]:
    """Expected errors by how pairs are formed, or by the star that they are measured in."""
    if not pool.formed:
        direct = any(t.measurements.pairs is not None for t in pool.tables)
        return {"star": pool.posterior(stops).error(task).position or np.inf} if direct else {}
    strategies: tuple[Literal["star", "chain", "all"], ...] = ("star", "chain", "all")
    return {one: pool.posterior(stops, Pairing(one)).error(task).position or np.inf for one in strategies}


class OtherPairs:
    """Other ways to measure as many pairs as a star has.

    Args:
        pool: Of which pairs are all that is measured, by themselves.
        most: How many pairs at most.
        aim: What is made small, and for what.
        generator: Draws which pairs of a tree are looked at.
    """

    def __init__(self, pool: Pool, most: int, aim: tuple[Criterion, Task], generator: np.random.Generator) -> None:
        self._pool, self._aim, self._hub = pool, aim, int(pool.hubs[0])
        self._work = PairWork(pool.robot, pool.tables[0], pool.problem.options, pool.problem.data.readings)
        structures: tuple[Structure, ...] = ("chain", "tree")
        self._taken = [plan_pairs(self._work, self._hub, most, one, aim, generator) for one in structures]

    def beside(self, chosen: Integers, *, quickly: bool = False) -> list[PairPlan]:
        """A chain, a tree, and the best pairs of the star's stops, of as many pairs as a star of some stops has.

        Args:
            chosen: These stops.
            quickly: Whether the best pairs may be nearly the best.
        """
        stops = np.append(self._hub, np.flatnonzero(np.isin(self._pool.stop, chosen)))
        found = [self._work.first_of(one, len(chosen)) for one in self._taken]
        return [*found, free_pairs(self._work, stops, len(chosen), self._aim, quickly=quickly)]

    def least(self, chosen: Integers, *, quickly: bool = False) -> float:
        """The least of their expected errors, [m]; inf where none is determined."""
        task = self._aim[1]
        return min(one.posterior.error(task).position or np.inf for one in self.beside(chosen, quickly=quickly))


def other_pairs(
    pool: Pool, most: int, aim: tuple[Criterion, Task], generator: np.random.Generator
) -> OtherPairs | None:
    """Other ways to measure as many pairs, where pairs are all that is measured, and by themselves; else None."""
    free = pool.scenario is not None and pool.before is None and not len(pool.given)
    alone = free and len(pool.tables) == 1 and len(pool.hubs) and pool.tables[0].measurements.pairs is not None
    return OtherPairs(pool, most, aim, generator) if alone else None


def best_plan(pool: Pool, chosen: Integers, task: Task, others: OtherPairs | None) -> tuple[Plan, dict[str, float]]:
    """The plan of stops that were chosen, with the best pairs of as many; and what each way of pairing would give.

    Args:
        pool: What they were chosen from.
        chosen: The stops.
        task: What the calibration is for.
        others: Other ways to measure as many pairs; None where there are none.
    """
    stops = np.concatenate([pool.given, chosen[shortest_way(pool.robot, pool.readings[chosen])]])
    plan, pairings = plan_of_stops(pool, stops), errors_by_pairing(pool, stops, task)
    for other in [] if others is None else others.beside(chosen):
        pairings[other.structure] = other.posterior.error(task).position or np.inf
        if pairings[other.structure] < (plan.posterior.error(task).position or np.inf):
            plan = plan_of_pairs(pool, other)
    return plan, pairings


def with_best_hubs(pool: Pool, task: Task, n: int, criterion: Criterion, generator: np.random.Generator) -> Pool:
    """The pool of stars with the hubs, each of some, whose stars are best."""
    scenario, best = pool.scenario, dict[str, int]()
    assert scenario is not None
    for name in np.unique(pool.groups_of(pool.hubs)).tolist():
        readings, least = pool.found[name].readings, np.inf
        for hub in np.unique(np.append(0, generator.integers(len(readings), size=N_HUBS))).tolist():
            few = generator.permutation(np.delete(np.arange(len(readings)), hub))[:N_FEW]
            some = {**pool.found, name: replace(pool.found[name], readings=readings[np.append(hub, few)])}
            one = pool_of(scenario, some, before=pool.before, hubs=best | {name: 0})
            measure = Measure(criterion, system_of(one.rows, one.known, task.form(one.problem)))
            value = measure.value(measure.system.information(greedy(measure, min(n, N_HUB_STOPS))))
            if value < least:
                best[name], least = hub, value
    return pool_of(scenario, pool.found, before=pool.before, hubs=best) if any(best.values()) else pool
