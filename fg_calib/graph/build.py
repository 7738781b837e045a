"""Build a problem from a robot and its tables: checks, the start, and what is left out to fix the gauge."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fg_calib.graph.normal_system import identifiable_subset
from fg_calib.graph.problem import Problem, named_rows, problem_at, start_of, tables_of, variables_of
from fg_calib.graph.variables import Variables
from fg_calib.inputs import Floats, Options, ProblemError, check_names, checked
from fg_calib.job import Job
from fg_calib.measurements import Table, Tables, build, check_rows, is_ours, missing_values, residuals
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot, names_of

_log = logging.getLogger(__name__)

QUARTER_TURN = 1e-3
"""Cosine of a pitch at which yaw and roll of a frame are no longer distinct."""


@single_threaded
def build_problem(robot: Robot, measurements: Tables, options: Options | None = None, **choices: Any) -> Problem:
    """The calibration problem of a robot and its measurements.

    Measurements that are all test rows make a problem of evaluation (see `Problem.evaluated`): their rows are those of
    the fit, of which the arm has no part.

    Args:
        robot: The nominal robot.
        measurements: A table, or several; those that are no `Table` are understood as `options` say.
        options: The options.
        choices: Instead of `options`, any of theirs as keywords.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    options = Options.of(options, **choices)
    tables = tables_of(measurements, options)
    for table in tables:
        if not table.uses_pairs and table.measurements.pairs is not None:
            _log.warning("%s: not used, model %s is of poses", table.measurements.pairs.source, table.model)
        for text in missing_values(table):
            _log.warning("%s", text)
    build.check_copies(tables)
    return problem_of_tables(robot, tables, options)


def problem_of_tables(robot: Robot, tables: Sequence[Table], options: Options) -> Problem:
    """`build_problem` without warnings of what tables hold twice or in vain.

    Args:
        robot: The nominal robot.
        tables: The tables.
        options: The options.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    check_names("prefer", options.prefer, names_of(robot.parameters))
    if not any(p.estimated for p in robot.parameters):
        raise ProblemError(f"robot {robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    evaluated = all(map(_all_test, tables))
    if evaluated:
        free = [p.name for p in robot.parameters if p.estimated and not 1 <= p.owner <= robot.n_joints]
        robot, tables = robot.with_estimated(free), [table.all_train() for table in tables]
        options = replace(options, gauge="none" if options.gauge == "keep" else options.gauge, encoder="propagated")
    data = build.build_dataset(robot, tables)
    variables = variables_of(robot, data, options)
    start = start_of(robot, data, variables)
    _check_own_kinds(robot, data, variables, start)
    problem = problem_at(robot, data, options, variables, start, evaluated=evaluated)
    if problem.n_residuals == 0:
        reasons = [f"{n} excluded for {reason.replace('_', ' ')}" for reason, n in problem.n_excluded.items() if n]
        found = ", ".join(["no row left to fit", *reasons])
        raise ProblemError(problem.data.source, found, "train rows that the model uses")
    if options.gauge != "keep":
        return problem
    kept = kept_of(problem, options.prefer)
    if not kept:
        found = "the rows determine none of the parameters to estimate"
        raise ProblemError(problem.data.source, found, "rows that some of them act on")
    reduced = robot.with_estimated([*kept, *(p.name for p in robot.parameters if p.kind == "curve" and p.estimated)])
    variables = variables_of(reduced, data, options)
    return problem_at(reduced, data, options, variables, start, whole=problem, evaluated=evaluated)


def kept_of(problem: Problem, prefer: Sequence[str]) -> list[str]:
    """The parameters that gauge `keep` estimates.

    At a pitch of 90 degrees yaw and roll of a frame are relative for want of coordinates, not of data: a frame that
    lacks nothing else is kept whole, as a pose.
    """
    v, estimated = problem.variables, problem.estimated
    rows = named_rows(v, problem.start, problem.system.left.A)
    ranks = [p.preference(prefer) for p in estimated]
    found = identifiable_subset(rows, np.array([problem.robot.scale_of(p.unit) for p in estimated]), ranks)
    kept = [v.names[i] for i in found]
    for item in v.items:
        if item.kind in ("base", "tool") and abs(np.cos(problem.start[item.parameters[4]])) < QUARTER_TURN:
            lacking = set(v.names[item.columns]).difference(kept)
            if len(lacking) == 1 and lacking <= {v.names[item.columns][k] for k in (3, 5)}:
                kept += lacking
    return kept


def _all_test(table: Table) -> bool:
    """Whether all rows of a table that take part are test rows."""
    m, pairs, none = table.measurements, table.measurements.pairs, np.zeros(0, np.bool_)
    rows = [np.zeros(len(own.data), np.bool_) if own.test is None else np.asarray(own.test) for own in table.own]
    if table.model is not None and table.uses_pairs and pairs is not None:
        rows += [pairs.test, none if m.groups is None else m.test[m.groups.index >= 0]]
    elif table.model is not None:
        rows.append(m.test)
    every = np.concatenate([none, *rows])
    return bool(every.all()) and len(every) > 0


@checked
def problem_of(job: Job, **changes: Any) -> Problem:
    """The calibration problem of a job.

    Args:
        job: The job.
        changes: Options that shall differ from the job's.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    return build_problem(job.robot, job.measurements, replace(job.options, **changes))


def _check_own_kinds(robot: Robot, data: build.Dataset, variables: Variables, start: Floats) -> None:
    """Compare the derivatives of custom kinds with differences at some measurements, where they are started."""
    at = variables.at(start)
    for s in (s for s in data.blocks if not is_ours(s.kind)):
        frames = residuals.frames_at(at.chains[s.table], data.trigs(robot)[s.table], s.ends)
        check_rows(s.kind, frames, s.data, at.coordinates[s.nuisances], s.source)
