"""Which configurations to measure, in which order, and what is to be expected of how many.

    plan = design(read_scenario("scenario.yaml"), n=30)
    plan.readings, plan.expected.position, plan.curve

The criterion is worked out for all candidates at once (see `criteria`); what is reported of a design is worked out anew
from the rows of its stops alone, by the very code that assesses a calibration.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays, as_floats
from fg_calib.designs.candidates import Candidates
from fg_calib.designs.chooser import MOST_STOPS, Chooser, CurvePoint
from fg_calib.designs.criteria import Criterion
from fg_calib.designs.cures import Cure, cures_of
from fg_calib.designs.of_job import pool_of_more, pool_of_rows, solved
from fg_calib.designs.order import shortest_way, travel
from fg_calib.designs.plans import OtherPairs, best_plan, other_pairs, with_best_hubs, with_names
from fg_calib.designs.pool import Pool, drawn, pool_of
from fg_calib.designs.search import Chosen
from fg_calib.designs.system import system_of
from fg_calib.designs.task import N_TASK, Task, is_fitted
from fg_calib.errors import InputError, ProblemError
from fg_calib.graph.problem import Problem
from fg_calib.job import Job
from fg_calib.measurements.table import Table
from fg_calib.observability.indices import Observability
from fg_calib.options import check, check_flag, check_number
from fg_calib.prediction.expected_error import PoseRms
from fg_calib.progress import tell
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import Configurations
from fg_calib.simulation.scenario import Scenario
from fg_calib.sizes import MOST_DRAWN
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

N_STOPS = 30
"""Stops of a design where nobody says how many, or how good it has to be."""

LEAST_FITTED = 4
"""Configurations of a task that a rigid fit does not bring on top of each other, wherever they are."""

N_CANDIDATES = 2000
"""Candidates that are drawn where nobody says how many."""


@dataclass(frozen=True, repr=False)
class Design(FrozenArrays):
    """Which configurations to measure.

    Attributes:
        pool: What was chosen from.
        tables: What is to be measured, in order; none of an instrument none of whose own stops was chosen.
        criterion: By which criterion.
        task: What the calibration is for.
        readings: The configurations in the order in which to visit them, that of a hub first, shape (n, n_joints),
            [rad] (prismatic: [m]).
        ids: Their names: those of rows of a job that were chosen, else s1, s2, ... in that order, behind such names
            that a job has already, shape (n,).
        group: The instrument that alone measures at each; "" where all others do.
        expected: Expected errors of the tool over the task, with these and what was given.
        after_fit: The same after the best rigid fit, where they are in the base frame; None where they are fitted.
        before: The same with what was given alone; None where nothing was.
        pairs: Which pairs are measured, of configurations in their order, shape (n_pairs, 2); None where none are, or
            where they are formed from what is measured.
        pairings: Expected position errors by which pairs are measured, or formed, [m].
        random: Median of the expected position errors of as many random stops, [m].
        curve: What is to be expected of how many.
        asked: How many stops were asked for; None where a target was stated.
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
    after_fit: PoseRms | None
    before: PoseRms | None
    pairs: Integers | None
    pairings: Mapping[str, float]
    random: float
    curve: tuple[CurvePoint, ...]
    asked: int | None
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
    def structure(self) -> str:
        """Which pairs are measured directly: star, chain, tree or free; empty where none are."""
        return "" if self.pairs is None else min(self.pairings, key=lambda name: self.pairings[name])

    @property
    def n_candidates(self) -> int:
        """Number of stops to choose from."""
        return len(self.pool.readings)

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
    _check_figures(n, target, n_candidates, lever, seed, fitted)
    given, task = (_readings(name, q, of.robot) for name, q in (("given", given), ("task", task)))
    draw = dict(zip(("candidates", "task", "random"), np.random.default_rng(seed).spawn(3), strict=True))
    if not any(p.estimated for p in of.robot.parameters):
        raise ProblemError(f"robot {of.robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
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
    if wanted.fitted and len(there) < LEAST_FITTED:
        found = f"{len(there)} configuration{'s' * (len(there) > 1)}, of which a rigid fit leaves next to nothing"
        raise InputError("task", found, f"{LEAST_FITTED} or more, or errors in the base frame")
    if len(pool.hubs) and pool.scenario is not None and given is None:
        pool = with_best_hubs(pool, wanted, n or N_STOPS, criterion, draw["random"])
    return design_from(pool, wanted, draw["random"], n=n, target=target, criterion=criterion)


def _check_figures(
    n: int | None, target: float | None, n_candidates: int, lever: float, seed: int, fitted: bool | None
) -> None:
    """Check the figures of a design.

    Raises:
        InputError: One makes no sense.
    """
    if n is not None and target is not None:
        raise InputError("target", "beside n", "one of the two")
    if n is not None:
        check_number("n", n, least=1, whole=True, most=MOST_STOPS)
    if target is not None:
        check_number("target", target, above=True)
    check_number("n_candidates", n_candidates, least=2, whole=True, most=MOST_DRAWN)
    check_number("lever", lever)
    check_number("seed", seed, whole=True)
    if fitted is not None:
        check_flag("fitted", fitted)


def _readings(name: str, given: object, robot: Robot) -> Floats | None:
    """Configurations from outside.

    Raises:
        InputError: They are no readings of the arm's joints, or none.
    """
    if given is None:
        return None
    q = as_floats(name, given, f"(n, {robot.n_joints})")
    if not len(q):
        raise InputError(name, "no configurations", "at least one")
    return q


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
    choice = _choose(pool, task, generator, n, target, criterion)
    tell("working out what to expect")
    plan, pairings = best_plan(pool, choice.stops, task, choice.others)
    expected, curve = plan.posterior.error(task), choice.curve(generator, len(pool.hubs))
    before = pool.posterior(pool.given) if len(pool.given) or pool.before is not None else None
    ids = plan.names if pool.scenario is None else _new_names(len(plan.readings), pool.before)
    return Design(
        pool=pool,
        tables=tuple(
            table
            for table in with_names(plan.tables, dict(zip(plan.names, ids, strict=True)))
            if table.measurements.n_configurations
        ),
        criterion=criterion,
        task=task,
        readings=plan.readings,
        ids=np.array(ids),
        group=plan.group,
        expected=expected,
        after_fit=None if task.fitted else plan.posterior.error(replace(task, fitted=True)),
        before=None if before is None else before.error(task),
        pairs=plan.pairs,
        pairings=pairings,
        random=curve[-1].random[1],
        curve=curve,
        asked=n if target is None else None,
        target=target,
        reached=target is None or (expected.position is not None and expected.position <= target * _JUST),
        observability=plan.posterior.observability,
        cures=cures_of(plan.posterior),
        unknown=choice.chooser.system.unknown,
        travel=travel(pool.robot, plan.readings),
        travel_before=travel(pool.robot, pool.readings[choice.stops]),
    )


def _new_names(n: int, before: Problem | None) -> list[str]:
    """Names s1, s2, ... of stops: those that configurations have already are left out."""
    taken = () if before is None else before.data.names
    first = max((int(name[1:]) for name in taken if _OURS.fullmatch(name)), default=0) + 1
    return [f"s{k}" for k in range(first, first + n)]


_OURS = re.compile(r"s[0-9]{1,9}")

_JUST = 1.0 + 1e-6
"""A target is reached to rounding."""


@dataclass(frozen=True)
class _Choice:
    """What was chosen.

    Attributes:
        chooser: What chose it.
        found: Its candidates.
        able: Which stop of the pool each of its candidates is.
        others: Other ways to measure as many pairs; None where there are none.
    """

    chooser: Chooser
    found: Chosen
    able: Integers
    others: OtherPairs | None

    @property
    def stops(self) -> Integers:
        """The stops that were chosen."""
        return self.able[self.found.candidates]

    def of_others(self, candidates: Integers) -> float:
        """Expected error of other pairs beside those of a star of some candidates, [m]; inf if there are none."""
        if self.others is None:
            return np.inf
        return self.others.least(self.able[candidates], quickly=len(candidates) < len(self.found.candidates))

    def curve(self, generator: np.random.Generator, hubs: int) -> tuple[CurvePoint, ...]:
        """What to expect of fewer stops, and of as many; hubs count."""
        return self.chooser.curve(self.found, generator, hubs, self.of_others)


def _choose(
    pool: Pool, task: Task, generator: np.random.Generator, n: int | None, target: float | None, criterion: Criterion
) -> _Choice:
    """So many stops, or as few as reach a target."""
    system = system_of(pool.rows, pool.known, task.form(pool.problem)).with_known(pool.given)
    able = np.setdiff1d(np.flatnonzero(np.any(pool.rows.rows, axis=(1, 2))), pool.given)
    if not len(able):
        raise InputError("candidates", "none at which anything is measured", "some")
    chooser = Chooser(system.select(able), criterion, _exactly(pool, task, able))
    tell("choosing")
    if target is None:
        of = max(1, min((N_STOPS if n is None else n) - len(pool.hubs), len(able)))
        found = chooser.thoroughly(of, generator)
    else:
        found = chooser.reaching(target, generator)
    others = other_pairs(pool, len(found.candidates), (criterion, task), generator)
    choice = _Choice(chooser, found, able, others)
    if target is None or others is None:
        return choice
    return replace(choice, found=chooser.fewer(found, target, choice.of_others, generator))


def _exactly(pool: Pool, task: Task, able: Integers) -> Callable[[Integers], float] | None:
    """The error with some candidates where pairs are formed otherwise than in a star; None elsewhere.

    There candidates are chosen as poses in an unknown frame, which hold at least as much (see `MEASURED`), and held to
    random ones by this error: a chain of pairs may hold far less, and of other stops more.
    """
    if not any(pairing.strategy != "star" for _, pairing in pool.formed.values()):
        return None

    def error(candidates: Integers) -> float:
        chosen = able[candidates]
        stops = chosen[shortest_way(pool.robot, pool.readings[chosen])]
        found = pool.posterior(np.concatenate([pool.given, stops])).error(task).position
        return np.inf if found is None else found

    return error
