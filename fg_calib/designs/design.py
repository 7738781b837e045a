"""Which configurations to measure, in which order, and what accuracy to expect of how many.

    plan = design(read_scenario("scenario.yaml"), n=30)
    plan.readings, plan.expected.position, plan.curve

The criterion is worked out for all candidates at once (see `criteria`). The expected errors of a design are worked out
anew from the rows of its poses alone, by the code that assesses a calibration.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib import inputs, job, measurements, parallel, prediction
from fg_calib.designs.candidates import Pool, build_pool, draw_groups
from fg_calib.designs.criteria import Criterion
from fg_calib.designs.from_job import pool_of_rows, scenario_of, solve_for_design
from fg_calib.designs.information import N_TASK, Task, build_system
from fg_calib.designs.search import MAX_POSES, Chooser, CurvePoint, joint_travel, order_by_nearest
from fg_calib.inputs import Floats, FrozenArrays, InputError, Integers, ProblemError, check_number
from fg_calib.observability import Observability, ObservedQuantities
from fg_calib.robot import Robot, random_readings
from fg_calib.simulation import MOST_DRAWN, Box, Configurations, Scenario

N_POSES = 30
"""Default number of poses of a design."""

MIN_FITTED = 4
"""Fewest configurations of a task after a rigid fit, which makes the errors of fewer too small."""

N_CANDIDATES = 2000
"""Default number of candidates that are drawn."""

_JUST = 1.0 + 1e-6
"""A target is reached to rounding."""


class Design(FrozenArrays, repr=False):
    """Which configurations to measure.

    Attributes:
        pool: The candidates.
        tables: Tables to measure, in order. An instrument of which no pose was chosen has none.
        criterion: The criterion.
        task: Purpose of the calibration.
        readings: The configurations in the order in which to visit them, reference poses first, shape (n, n_joints),
            [rad] (prismatic: [m]).
        ids: Their names: those of chosen rows of a job, else s1, s2, ... after such names of the job, shape (n,).
        group: The one instrument that measures at each; "" for all that share their configurations.
        expected: Expected errors of the tool over the task, with these and what was given.
        after_fit: Expected errors after the best rigid fit, where `expected` is in the base frame; else None.
        known_tool: Expected errors if the tool were known.
        before: Expected errors with what was given alone; None without it.
        random: Median of the expected position errors of as many random poses, [m].
        curve: Expected errors by the number of poses.
        asked: Number of poses that was asked for; None with a target.
        target: Expected position error that was asked for, [m]; None with a number.
        reached: Whether the target is reached.
        observability: Observability of the arm by the rows; its `lost` are the directions that stay undetermined.
        unknown: Share of the task that no candidate determines.
        travel: Joint travel along the configurations, [rad].
        travel_before: Joint travel in the order in which they were chosen, [rad].
    """

    pool: Pool
    tables: tuple[measurements.Table, ...]
    criterion: Criterion
    task: Task
    readings: Floats
    ids: NDArray[np.str_]
    group: NDArray[np.str_]
    expected: prediction.PoseRms
    after_fit: prediction.PoseRms | None
    known_tool: prediction.PoseRms
    before: prediction.PoseRms | None
    random: float
    curve: tuple[CurvePoint, ...]
    asked: int | None
    target: float | None
    reached: bool
    observability: Observability
    unknown: float
    travel: float
    travel_before: float

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.readings)

    def __repr__(self) -> str:
        p = self.expected.position
        error = "unknown" if p is None else f"{p * 1e3:.3g} mm"
        return f"Design of {self.n} poses for {self.pool.robot.name!r}: expected RMS {error}, {self.criterion}"


@parallel.single_threaded
def design(
    of: Scenario | job.Job,
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
        n: Number of poses; as many as reach the target if None.
        target: Expected RMS position error over the task that is to be reached, [m].
        criterion: Minimised value: `I` the mean square error over the task, or D, A, E, O1 to O5.
        n_candidates: Number of candidates to draw; of a table all are candidates.
        candidates: Where to measure instead: configurations, or with a job `"rows"`, to choose among its train rows.
        given: With a scenario: readings of poses that were measured already, or will be anyway, shape (n, n_joints).
        task: Configurations at which the tool is to be right, shape (n, n_joints); random ones within the joint limits
            if None.
        fitted: Whether errors count after the best rigid fit, or in the base frame; if None after the fit where the
            measurements do not determine the base.
        lever: Distance from the tool with which orientation errors count, [m].
        seed: Seed of all draws.

    Raises:
        InputError: A value makes no sense, or nothing can be measured from anywhere.
        ProblemError: The measurements would determine nothing.
    """
    _check_values(n, target, n_candidates, lever, seed)
    given, task = (_check_readings(name, q, of.robot) for name, q in (("given", given), ("task", task)))
    draw = dict(zip(("candidates", "task", "random"), np.random.default_rng(seed).spawn(3), strict=True))
    if not any(p.estimated for p in of.robot.parameters):
        raise ProblemError(f"robot {of.robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    parallel.tell("looking for candidates")
    pool = _build_pool(of, candidates, given, n_candidates, draw["candidates"])
    readings = random_readings(pool.robot, N_TASK, draw["task"]) if task is None else task
    wanted = Task(readings, ObservedQuantities.of(pool.problem).blind_to_base if fitted is None else fitted, lever)
    if wanted.fitted and len(readings) < MIN_FITTED:
        found = f"{len(readings)} configuration{'s' * (len(readings) > 1)}, whose errors a rigid fit takes up"
        raise InputError("task", found, f"{MIN_FITTED} or more, or errors in the base frame")
    return design_from_pool(pool, wanted, draw["random"], n=n, target=target, criterion=criterion)


def _kept_out(scenario: Scenario, corners: Sequence[Floats]) -> Scenario:
    """A scenario that measures nowhere where the arm is inside a box, by lower and upper corners."""
    boxes = tuple(Box(lower, upper) for lower, upper in corners)

    def free(one: Any) -> Any:
        return replace(one, keep_out=(*one.keep_out, *boxes))

    instruments = tuple(replace(one, configurations=free(one.configurations)) for one in scenario.instruments)
    return replace(scenario, configurations=free(scenario.configurations), instruments=instruments)


def _build_pool(
    of: Scenario | job.Job,
    candidates: Configurations | Literal["rows"] | None,
    given: Floats | None,
    n: int,
    generator: np.random.Generator,
) -> Pool:
    """The pool of a scenario, or of a job that is solved first."""
    if isinstance(of, job.Job):
        inputs.expect(given is None, "given", "with a job", "a scenario: what a job measured counts already")
        source, problem = "job" if of.path is None else of.path.name, solve_for_design(of)
        if isinstance(candidates, str):
            return pool_of_rows(problem, source)
        scenario = _kept_out(scenario_of(problem, candidates, source), of.keep_out)
        return build_pool(scenario, draw_groups(scenario, n, generator), before=problem)
    if candidates == "rows":
        raise InputError("candidates", "rows of a scenario, which has none", "a job, or configurations")
    scenario = of if candidates is None else replace(of, configurations=candidates)
    return build_pool(scenario, draw_groups(scenario, n, generator), given=given)


def _check_values(n: int | None, target: float | None, n_candidates: int, lever: float, seed: int) -> None:
    """Check the values that a design is asked for with.

    Raises:
        InputError: One makes no sense.
    """
    inputs.expect(n is None or target is None, "target", "together with n", "one of the two")
    if n is not None:
        check_number("n", n, least=1, whole=True, most=MAX_POSES)
    if target is not None:
        check_number("target", target, above=True)
    check_number("n_candidates", n_candidates, least=2, whole=True, most=MOST_DRAWN)
    check_number("lever", lever)
    check_number("seed", seed, whole=True)


def _check_readings(name: str, given: object, robot: Robot) -> Floats | None:
    """Check configurations from outside.

    Raises:
        InputError: The array holds no readings of the arm's joints, or none.
    """
    if given is None:
        return None
    q = inputs.as_floats(name, given, f"(n, {robot.n_joints})")
    inputs.expect(len(q), name, "no configurations", "at least one")
    return q


def design_from_pool(
    pool: Pool,
    task: Task,
    generator: np.random.Generator,
    *,
    n: int | None = None,
    target: float | None = None,
    criterion: Criterion = "I",
) -> Design:
    """Choose from a pool for a task, and compare with random sets; arguments as of `design`."""
    measurable = np.setdiff1d(np.flatnonzero(np.any(pool.rows.rows, axis=(1, 2))), pool.given)
    inputs.expect(len(measurable), "candidates", "none at which anything is measured", "some")
    after = pool.before is not None
    form = task.quadratic_form(pool.problem, curves=after)
    system = build_system(pool.rows, pool.known, form).with_known(pool.given)
    chooser = Chooser(system.select(measurable), criterion, _error_of_formed_pairs(pool, task, measurable))
    chooser.of_curves = 0.0 if after else pool.posterior(pool.given).error_of_curves(task)
    parallel.tell("choosing")
    wanted = max(1, min((n or N_POSES) - len(pool.references), len(measurable)))
    found = chooser.best(wanted, generator) if target is None else chooser.reaching(target)
    parallel.tell("working out what to expect")
    chosen = measurable[found]
    ordered = chosen[order_by_nearest(pool.robot, pool.readings[chosen])]
    poses = np.concatenate([pool.given, ordered])
    posterior, tables = pool.posterior(poses), pool.select_tables(ordered)
    chooser.of_curves = 0.0 if after else posterior.error_of_curves(task)
    configurations = _configurations_of(pool, ordered, tables)
    data = pool.problem.data
    names, readings = [data.names[k] for k in configurations], data.readings[configurations]
    ids = np.array(names if pool.scenario is None else _new_names(len(names), pool))
    expected, curve = posterior.error(task), chooser.curve(found, generator, len(pool.references))
    error = np.inf if expected.position is None else expected.position
    before = pool.posterior(pool.given).error(task) if len(pool.given) or after else None
    used = [t for t in tables if t.measurements.n_configurations]
    measured = tuple(rename_configurations(t, dict(zip(names, ids, strict=True))) for t in used)
    after_fit = None if task.fitted else posterior.error(replace(task, fitted=True))
    errors = (expected, after_fit, posterior.with_known_tool().error(task), before, curve[-1].random[1])
    curve = (*curve[:-1], replace(curve[-1], designed=error))
    asked = (n if target is None else None, target, target is None or error <= target * _JUST)
    group, known = pool.groups_of(configurations), (posterior.observability, chooser.system.unknown)
    travel = (joint_travel(pool.robot, readings), joint_travel(pool.robot, pool.readings[chosen]))
    return Design(pool, measured, criterion, task, readings, ids, group, *errors, curve, *asked, *known, *travel)


def _error_of_formed_pairs(pool: Pool, task: Task, measurable: Integers) -> Callable[[Integers], float] | None:
    """Expected error of a set of candidates whose pairs are no star; None for a star.

    The search takes candidates for poses in an unknown frame, whose information bounds that of pairs (see `MEASURED`).
    A chain may have far less, so its design is compared with random ones by this error.
    """
    if not any(pairing.strategy != "star" for _, pairing in pool.formed.values()):
        return None

    def error(candidates: Integers) -> float:
        chosen = measurable[candidates]
        ordered = chosen[order_by_nearest(pool.robot, pool.readings[chosen])]
        found = pool.posterior(np.concatenate([pool.given, ordered])).error(task).position
        return np.inf if found is None else found

    return error


def _configurations_of(pool: Pool, ordered: Integers, tables: list[measurements.Table]) -> Integers:
    """Configurations of the problem to visit: references that have pairs, then one a pose."""
    last = {number: k for k, number in enumerate(pool.pose_of.tolist())}
    used = {name for table in tables for name in table.measurements.ids.tolist()}
    references = [k for k in pool.references.tolist() if pool.problem.data.names[k] in used]
    return np.array([*references, *(last[number] for number in ordered.tolist())], dtype=np.int64)


def rename_configurations(table: measurements.Table, names: Mapping[str, str]) -> measurements.Table:
    """A table with other names of its configurations."""
    ids = np.array([names[name] for name in table.measurements.ids.tolist()])
    return replace(table, measurements=replace(table.measurements, ids=ids))


def _new_names(n: int, pool: Pool) -> list[str]:
    """Names s1, s2, ... of poses, after those of earlier measurements."""
    taken = () if pool.before is None else pool.before.data.names
    first = max((int(name[1:]) for name in taken if re.fullmatch(r"s[0-9]{1,9}", name)), default=0) + 1
    return [f"s{k}" for k in range(first, first + n)]
