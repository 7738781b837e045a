"""What is to be measured at the stops that were chosen: tables, the hub of a star, and which pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.order import shortest_way
from fg_calib.designs.pairs import PairPlan, PairWork, Structure, free_pairs, plan_pairs
from fg_calib.designs.pool import HUB, Pool, pool_of
from fg_calib.designs.search import greedy
from fg_calib.designs.system import system_of
from fg_calib.designs.task import Posterior, Task
from fg_calib.measurements.series import Table
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


def of_used_points(table: Table) -> Table:
    """A table of touched points with distances between those alone that are touched, unless there are none.

    Args:
        table: It, or any other, which stays as it is.
    """
    groups = table.measurements.groups
    if groups is None:
        return table
    pairs = groups.pairs
    used = np.flatnonzero(np.isin(pairs.a, groups.index) & np.isin(pairs.b, groups.index))
    if not len(used):
        return table
    return replace(table, measurements=replace(table.measurements, groups=replace(groups, pairs=pairs.select(used))))


def plan_of_stops(pool: Pool, stops: Integers) -> Plan:
    """Some stops, in their order; a hub is visited first."""
    measured, data = stops[len(pool.given) :], pool.problem.data
    number = {stop: k for k, stop in enumerate(pool.stop.tolist())}
    order = [number[stop] for stop in measured.tolist()]
    if pool.has_hub and not len(pool.given):
        order = [number[HUB], *order]
    tables = pool.tables_of(measured)
    direct = [t.measurements.pairs for t in tables if t.measurements.pairs is not None]
    return Plan(
        tables=tables,
        readings=data.readings[order],
        names=[data.names[k] for k in order],
        group=np.array(["" if pool.stop[k] == HUB else str(pool.group[pool.stop[k]]) for k in order]),
        posterior=pool.posterior(stops),
        pairs=np.stack([direct[0].a, direct[0].b], axis=1) if direct else None,
    )


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


def other_pairs(
    pool: Pool, chosen: Integers, aim: tuple[Criterion, Task], generator: np.random.Generator
) -> Iterator[PairPlan]:
    """Other ways to measure as many pairs, where pairs are all that is measured, and by themselves."""
    table = pool.tables[0]
    alone = len(pool.tables) == 1 and not len(pool.given) and pool.before is None and pool.has_hub
    if not alone or table.measurements.pairs is None:
        return
    readings = pool.problem.data.readings
    first = int(np.flatnonzero(pool.stop == HUB)[0])
    work = PairWork(pool.robot, table, pool.problem.options, readings)
    structures: tuple[Structure, ...] = ("chain", "tree")
    for structure in structures:
        yield plan_pairs(work, first, len(chosen), structure, aim, generator)
    yield free_pairs(work, np.append(first, np.flatnonzero(np.isin(pool.stop, chosen))), len(chosen), aim)


def best_plan(
    pool: Pool, chosen: Integers, aim: tuple[Criterion, Task], generator: np.random.Generator
) -> tuple[Plan, dict[str, float]]:
    """The plan of stops that were chosen, with the best pairs of as many; and what each way of pairing would give.

    Args:
        pool: What they were chosen from.
        chosen: The stops.
        aim: What is made small, and for what.
        generator: Draws which pairs of a tree are looked at.
    """
    task = aim[1]
    stops = np.concatenate([pool.given, chosen[shortest_way(pool.robot, pool.readings[chosen])]])
    plan, pairings = plan_of_stops(pool, stops), errors_by_pairing(pool, stops, task)
    for other in other_pairs(pool, chosen, aim, generator):
        pairings[other.structure] = other.posterior.error(task).position or np.inf
        if pairings[other.structure] < (plan.posterior.error(task).position or np.inf):
            plan = plan_of_pairs(pool, other)
    return plan, pairings


def with_best_hub(pool: Pool, task: Task, n: int, criterion: Criterion, generator: np.random.Generator) -> Pool:
    """The pool of a star with the hub, of some, whose star is best."""
    scenario, found = pool.scenario, pool.found
    assert scenario is not None
    count = len(found[""].readings)
    best, least = 0, np.inf
    for hub in np.unique(np.append(0, generator.integers(count, size=N_HUBS))).tolist():
        few = generator.permutation(np.delete(np.arange(count), hub))[:N_FEW]
        some = {**found, "": replace(found[""], readings=found[""].readings[np.append(hub, few)])}
        one = pool_of(scenario, some)
        measure = Measure(criterion, system_of(one.rows, one.known, task.form(one.problem)))
        value = measure.value(measure.system.information(greedy(measure, min(n, N_HUB_STOPS))))
        if value < least:
            best, least = hub, value
    return pool_of(scenario, found, hub=best) if best else pool
