"""Which configurations to measure, in which order, and what is to be expected of how many.

    plan = design(read_scenario("scenario.yaml"), n=30)
    plan.readings, plan.expected.position, plan.curve

The criterion is worked out for all candidates at once (see `criteria`); what is reported of a design is worked out anew
from the rows of its stops alone, by the very code that assesses a calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.accuracy import PoseRms
from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays
from fg_calib.designs.candidates import Candidates
from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.cures import Cure, cures_of
from fg_calib.designs.of_job import pool_of_more, pool_of_rows, solved
from fg_calib.designs.order import shortest_way, travel
from fg_calib.designs.pairs import PairPlan, PairWork, Structure, free_pairs, plan_pairs
from fg_calib.designs.pool import Pool, drawn, pool_of
from fg_calib.designs.search import Chosen, exchanged, greedy, not_worse_than_random, random_values
from fg_calib.designs.system import System, system_of
from fg_calib.designs.task import N_TASK, Posterior, Task, is_fitted
from fg_calib.errors import InputError
from fg_calib.graph.observability import Observability
from fg_calib.job import Job
from fg_calib.measurements.series import Table
from fg_calib.options import Pairing, check, check_flag, check_number
from fg_calib.progress import tell
from fg_calib.robot.inverse import random_readings
from fg_calib.simulation.configurations import Configurations
from fg_calib.simulation.scenario import Scenario
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

N_STOPS = 30
"""Stops of a design where nobody says how many, or how good it has to be."""

N_CANDIDATES = 2000
"""Candidates that are drawn where nobody says how many."""

MOST_STOPS = 500
"""Stops up to which a design is sought that reaches a target."""

N_HUBS = 12
"""Configurations that are tried as the hub of a star."""

N_FEW = 300
"""Candidates that each is tried with."""

N_HUB_STOPS = 20
"""Stops that each is tried with, at most."""

LEAST_CURVE = 4
"""Stops with which the curve begins."""

N_CURVE = 10
"""Numbers of stops at which the curve is worked out, about."""


@dataclass(frozen=True)
class CurvePoint:
    """What is to be expected of a number of stops.

    Attributes:
        n: How many.
        designed: RMS error over the task with as many designed ones, [m].
        random: The same of random ones: a tenth of them is better than the first, half than the second, a tenth worse
            than the third, [m].
    """

    n: int
    designed: float
    random: tuple[float, float, float]


@dataclass(frozen=True, repr=False)
class Design(FrozenArrays):
    """Which configurations to measure.

    Attributes:
        pool: What was chosen from.
        tables: What is to be measured, in order.
        criterion: By which criterion.
        task: What the calibration is for.
        readings: The configurations in the order in which to visit them, that of a hub first, shape (n, n_joints),
            [rad] (prismatic: [m]).
        ids: Their names: those of rows of a job that were chosen, else s1, s2, ... in that order, shape (n,).
        group: The instrument that alone measures at each; "" where all others do.
        expected: Expected errors of the tool over the task, with these and what was given.
        before: The same with what was given alone; None where nothing was.
        pairs: Which pairs are measured, of configurations in their order, shape (n_pairs, 2); None where none are, or
            where they are formed from what is measured.
        pairings: Expected position errors by which pairs are measured, or formed, [m].
        random: Median of the expected position errors of as many random stops, [m].
        curve: What is to be expected of how many.
        target: What was to be reached, [m]; None where a number was stated.
        reached: Whether it is.
        observability: What the rows determine of the arm.
        cures: Directions that stay undetermined, with the measurements that would determine them.
        unknown: Share of the task that no candidate determines.
        travel: Joint travel along the stops, [rad].
        travel_before: The same in the order in which they were chosen.
    """

    pool: Pool
    tables: tuple[Table, ...]
    criterion: Criterion
    task: Task
    readings: Floats
    ids: NDArray[np.str_]
    group: NDArray[np.str_]
    expected: PoseRms
    before: PoseRms | None
    pairs: Integers | None
    pairings: Mapping[str, float]
    random: float
    curve: tuple[CurvePoint, ...]
    target: float | None
    reached: bool
    observability: Observability
    cures: tuple[Cure, ...]
    unknown: float
    travel: float
    travel_before: float

    @property
    def n(self) -> int:
        """Number of stops."""
        return len(self.readings)

    @property
    def found(self) -> Mapping[str, Candidates]:
        """How the candidates came about, by the instrument whose own they are."""
        return self.pool.found

    def __repr__(self) -> str:
        p = self.expected.position
        error = "unknown" if p is None else f"{p * 1e3:.3g} mm"
        return f"Design of {self.n} stops for {self.pool.robot.name!r}: expected RMS {error}, {self.criterion}"


@checked
@single_threaded
def design(
    of: Scenario | Job,
    *,
    n: int | None = None,
    target: float | None = None,
    criterion: Criterion = "I",
    n_candidates: int = N_CANDIDATES,
    candidates: Configurations | Literal["rows"] | None = None,
    given: Floats | None = None,
    task: Floats | None = None,
    fitted: bool | None = None,
    lever: float = 0.0,
    seed: int = 0,
) -> Design:
    """Choose the configurations to measure.

    Args:
        of: A scenario: the arm with its tolerances, the instruments with their noise, and where they may measure. Or a
            job: what was measured counts already, and more is to be measured by the same instruments.
        n: How many stops; as many as reach the target if None.
        target: Expected RMS position error over the task that is to be reached, [m].
        criterion: What is made small: `I` the mean square error over the task, or D, A, E, O1 to O5.
        n_candidates: How many configurations are drawn to choose from; of a table all are taken.
        candidates: Where to measure instead: configurations, or with a job `"rows"`, to choose among its train rows.
        given: With a scenario: readings of stops that were measured already, or will be anyway, shape (n, n_joints).
        task: Configurations at which the tool is to be right, shape (n, n_joints); random ones within the joint limits
            if None.
        fitted: Whether errors count after the best rigid fit, or in the base frame; the former if None where nothing
            that is measured says where the base is.
        lever: Length with which orientations count too, [m].
        seed: Of all that is drawn.

    Raises:
        InputError: A figure makes no sense, or nothing can be measured from anywhere.
        ProblemError: What would be measured determines nothing.
    """
    check("criterion", criterion, Criterion)
    if n is not None and target is not None:
        raise InputError("target", "beside n", "one of the two")
    if n is not None:
        check_number("n", n, least=1, whole=True, most=MOST_STOPS)
    if target is not None:
        check_number("target", target, above=True)
    check_number("n_candidates", n_candidates, least=2, whole=True)
    check_number("lever", lever)
    check_number("seed", seed, whole=True)
    if fitted is not None:
        check_flag("fitted", fitted)
    draw = dict(zip(("candidates", "task", "random"), np.random.default_rng(seed).spawn(3), strict=True))
    tell("looking for candidates")
    if isinstance(of, Job):
        pool = _pool_of_job(of, n_candidates, draw["candidates"], candidates, given)
    elif candidates == "rows":
        raise InputError("candidates", "rows of a scenario, which has none", "a job, or configurations")
    else:
        scenario = of if candidates is None else replace(of, configurations=candidates)
        pool = pool_of(scenario, drawn(scenario, n_candidates, draw["candidates"]), given=given)
    there = random_readings(pool.robot, N_TASK, draw["task"]) if task is None else task
    wanted = Task(there, is_fitted(pool.problem) if fitted is None else fitted, lever)
    if pool.has_hub and pool.scenario is not None and not len(pool.given) and pool.before is None:
        pool = _with_best_hub(pool, wanted, n or N_STOPS, criterion, draw["random"])
    return design_from(pool, wanted, draw["random"], n=n, target=target, criterion=criterion)


def _pool_of_job(
    job: Job,
    n_candidates: int,
    generator: np.random.Generator,
    candidates: Configurations | Literal["rows"] | None,
    given: Floats | None,
) -> Pool:
    """The pool of a job."""
    if given is not None:
        raise InputError("given", "with a job", "a scenario: what a job measured counts already")
    source = "job" if job.path is None else job.path.name
    problem = solved(job)
    if isinstance(candidates, str):
        return pool_of_rows(problem, source)
    return pool_of_more(problem, n_candidates, generator, candidates, source)


def _with_best_hub(pool: Pool, task: Task, n: int, criterion: Criterion, generator: np.random.Generator) -> Pool:
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


def design_from(
    pool: Pool,
    task: Task,
    generator: np.random.Generator,
    *,
    n: int | None = None,
    target: float | None = None,
    criterion: Criterion = "I",
) -> Design:
    """The design from a pool: see `design`.

    Args:
        pool: What to choose from.
        task: What the calibration is for.
        generator: Draws the random sets that a design is held to.
        n: How many stops.
        target: What is to be reached, [m].
        criterion: What is made small.
    """
    system = system_of(pool.rows, pool.known, task.form(pool.problem)).with_known(pool.given)
    able = np.setdiff1d(np.flatnonzero(np.any(pool.rows.rows, axis=(1, 2))), pool.given)
    if not len(able):
        raise InputError("candidates", "none at which anything is measured", "some")
    hubs = int(pool.has_hub)
    chooser = _Chooser(system.select(able), criterion)
    tell("choosing")
    if target is None:
        found = chooser.best(max(1, min((N_STOPS if n is None else n) - hubs, len(able))))
    else:
        found = chooser.reaching(target)
    found = not_worse_than_random(chooser.measure, found, generator)
    chosen = able[found.candidates]
    tell("working out what to expect")
    way = shortest_way(pool.robot, pool.readings[chosen])
    stops = np.concatenate([pool.given, chosen[way]])
    plan = _of_stops(pool, stops)
    pairings = _pairings(pool, stops, task)
    for other in _other_pairs(pool, chosen, (criterion, task), generator):
        pairings[other.structure] = other.posterior.error(task).position or np.inf
        if pairings[other.structure] < (plan.posterior.error(task).position or np.inf):
            plan = _of_pairs(pool, other)
    expected, curve = plan.posterior.error(task), chooser.curve(found, generator, hubs)
    before = pool.posterior(pool.given) if len(pool.given) or pool.before is not None else None
    ids = plan.names if pool.scenario is None else [f"s{k + 1}" for k in range(len(plan.readings))]
    return Design(
        pool=pool,
        tables=tuple(_named(plan.tables, dict(zip(plan.names, ids, strict=True)))),
        criterion=criterion,
        task=task,
        readings=plan.readings,
        ids=np.array(ids),
        group=plan.group,
        expected=expected,
        before=None if before is None else before.error(task),
        pairs=plan.pairs,
        pairings=pairings,
        random=curve[-1].random[1],
        curve=curve,
        target=target,
        reached=target is None or (expected.position is not None and expected.position <= target * _JUST),
        observability=plan.posterior.observability,
        cures=cures_of(plan.posterior),
        unknown=system.unknown,
        travel=travel(pool.robot, plan.readings),
        travel_before=travel(pool.robot, pool.readings[chosen]),
    )


_JUST = 1.0 + 1e-6
"""A target is reached to rounding."""


@dataclass(frozen=True)
class _Plan:
    """What is to be measured, and what would then be known."""

    tables: list[Table]
    readings: Floats
    names: list[str]
    group: NDArray[np.str_]
    posterior: Posterior
    pairs: Integers | None


def _named(tables: Sequence[Table], names: Mapping[str, str]) -> list[Table]:
    """Tables with other names of their configurations."""
    return [
        replace(t, measurements=replace(t.measurements, ids=np.array([names[i] for i in t.measurements.ids.tolist()])))
        for t in tables
    ]


def _of_stops(pool: Pool, stops: Integers) -> _Plan:
    """Some stops, in their order; a hub is visited first."""
    measured, data = stops[len(pool.given) :], pool.problem.data
    number = {stop: k for k, stop in enumerate(pool.stop.tolist())}
    order = [number[stop] for stop in measured.tolist()]
    if pool.has_hub and not len(pool.given):
        order = [number[-1], *order]
    tables = pool.tables_of(measured)
    direct = [t.measurements.pairs for t in tables if t.measurements.pairs is not None]
    return _Plan(
        tables=tables,
        readings=data.readings[order],
        names=[data.names[k] for k in order],
        group=np.array(["" if pool.stop[k] < 0 else str(pool.group[pool.stop[k]]) for k in order]),
        posterior=pool.posterior(stops),
        pairs=np.stack([direct[0].a, direct[0].b], axis=1) if direct else None,
    )


def _of_pairs(pool: Pool, found: PairPlan) -> _Plan:
    """A chain or a tree of pairs; a tree in an order that is short for the joints."""
    m = found.table.measurements
    assert m.pairs is not None
    pairs = np.stack([m.pairs.a, m.pairs.b], axis=1)
    names = m.ids.tolist()
    return _Plan([found.table], m.readings, names, np.full(len(names), ""), found.posterior, pairs)


def _pairings(pool: Pool, stops: Integers, task: Task) -> dict[str, float]:
    """Expected errors by how pairs are formed, or by the star that they are measured in."""
    if not pool.formed:
        direct = any(t.measurements.pairs is not None for t in pool.tables)
        return {"star": pool.posterior(stops).error(task).position or np.inf} if direct else {}
    strategies: tuple[Literal["star", "chain", "all"], ...] = ("star", "chain", "all")
    return {one: pool.posterior(stops, Pairing(one)).error(task).position or np.inf for one in strategies}


def _other_pairs(
    pool: Pool, chosen: Integers, aim: tuple[Criterion, Task], generator: np.random.Generator
) -> Iterator[PairPlan]:
    """Other ways to measure as many pairs, where pairs are all that is measured, and by themselves."""
    table = pool.tables[0]
    alone = len(pool.tables) == 1 and not len(pool.given) and pool.before is None and pool.has_hub
    if not alone or table.measurements.pairs is None:
        return
    readings = pool.problem.data.readings
    first = int(np.flatnonzero(pool.stop < 0)[0])
    work = PairWork(pool.robot, table, pool.problem.options, readings)
    structures: tuple[Structure, ...] = ("chain", "tree")
    for structure in structures:
        yield plan_pairs(work, first, len(chosen), structure, aim, generator)
    yield free_pairs(work, np.append(first, np.flatnonzero(np.isin(pool.stop, chosen))), len(chosen), aim)


class _Chooser:
    """Chooses from a system; the error is always that over the task.

    Greedy choice does not see that some stops help only together, as the first lengths to an anchor that is unknown do:
    that by the volume of everything unknown, what is beside the arm too, is another start.

    Args:
        system: What is chosen from.
        criterion: By which criterion.
    """

    def __init__(self, system: System, criterion: Criterion) -> None:
        self.system, self.criterion = system, criterion
        self.measure = Measure(criterion, system)
        self._error = Measure("I", system)
        of_all = Measure("D", replace(system, core=np.eye(system.rows.shape[2])))
        self._orders = [(measure, np.zeros(0, dtype=np.int64)) for measure in (self.measure, of_all)]

    def error(self, chosen: Integers) -> float:
        """Expected RMS error with some candidates, [m]."""
        return float(np.sqrt(self._error.value(self.system.information(chosen))))

    def starts(self, n: int) -> list[Integers]:
        """What greedy choice takes first, the best start first."""
        self._orders = [(m, greedy(m, n, order) if len(order) < n else order) for m, order in self._orders]
        found = [order[:n] for _, order in self._orders]
        return sorted(found, key=lambda one: self.measure.value(self.system.information(one)))

    def best(self, n: int) -> Chosen:
        """The best n that exchange finds."""
        return min((exchanged(self.measure, one) for one in self.starts(n)), key=lambda chosen: chosen.value)

    def quickly(self, n: int) -> Chosen:
        """Nearly as good ones, in a small part of the time."""
        return exchanged(self.measure, self.starts(n)[0], quickly=True)

    def reaching(self, target: float) -> Chosen:
        """As few as reach a target, [m]; as many as may be where none do."""
        most = min(MOST_STOPS, self.system.n_candidates)
        enough = 1
        while min(map(self.error, self.starts(enough))) > target:
            if enough == most:
                return Chosen(self.starts(most)[0], np.inf)
            enough = min(most, enough + max(1, enough // 10))
        low, high, found = 0, enough, self.quickly(enough)
        while high - low > 1:
            middle = max(low + 1, high - max(1, (high - low) // 4))
            better = self.quickly(middle)
            if self.error(better.candidates) <= target:
                high, found = middle, better
            else:
                low = middle
        return exchanged(self.measure, found.candidates)

    def curve(self, found: Chosen, generator: np.random.Generator, hubs: int) -> tuple[CurvePoint, ...]:
        """What to expect of fewer stops, and of as many; hubs count."""
        most = len(found.candidates)
        numbers = np.round(np.geomspace(LEAST_CURVE, max(most + hubs, LEAST_CURVE), N_CURVE)).astype(np.int64)
        points = []
        for k in sorted({n - hubs for n in numbers.tolist() if 0 < n - hubs < most} | {most}):
            chosen = found.candidates if k == most else self.quickly(k).candidates
            values, _ = random_values(self._error, k, generator)
            low, middle, high = np.sqrt(np.quantile(values, [0.1, 0.5, 0.9])).tolist()
            points.append(CurvePoint(k + hubs, self.error(chosen), (low, middle, high)))
        return tuple(points)
