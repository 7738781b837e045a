"""The pool of a job: what was measured counts, and more is chosen, anywhere or among the job's own rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.assessment import solve_job
from fg_calib.designs.candidates import Candidates
from fg_calib.designs.pool import HUB, NONE, Pool, drawn, pool_of
from fg_calib.designs.rows import stop_rows
from fg_calib.designs.scene import scenario_of
from fg_calib.errors import InputError
from fg_calib.graph.problem import Problem, reweighted_at
from fg_calib.job import Job
from fg_calib.simulation.configurations import Configurations

Integers = NDArray[np.int64]


def solved(job: Job) -> Problem:
    """The problem of a job at its solution, everything estimated.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    gauge = "prior" if job.options.gauge == "keep" else job.options.gauge
    options = replace(job.options, gauge=gauge, folds=None, encoder="propagated")
    solution = solve_job(replace(job, options=options))
    if solution.problem.evaluated:
        raise InputError(str(job.path or "job"), "test rows alone", "train rows: what was measured is what counts")
    return reweighted_at(solution.problem, solution.parameters)


def pool_of_more(
    problem: Problem,
    n_candidates: int,
    generator: np.random.Generator,
    configurations: Configurations | None,
    source: str,
) -> Pool:
    """Stops for more rows of a solved problem's tables.

    Args:
        problem: The problem, at its solution.
        n_candidates: How many are drawn for each table.
        generator: Draws them.
        configurations: Where to measure; see `scenario_of`.
        source: The job's name, for messages.

    Raises:
        InputError: A table holds measurements of a kind of one's own, or nothing can be measured from anywhere.
    """
    scenario = scenario_of(problem, configurations, source)
    return pool_of(scenario, drawn(scenario, n_candidates, generator), before=problem)


def pool_of_rows(problem: Problem, source: str) -> Pool:
    """Stops that are the configurations of a problem's train rows.

    Pairs must be of a star, whose hub they are measured against: what other pairs share is not one stop's.

    Args:
        problem: The problem, at its solution.
        source: The job's name, for messages.

    Raises:
        InputError: Pairs that are no star.
    """
    data = problem.data
    hubs, used = np.zeros(0, dtype=np.int64), np.zeros(data.n_configurations, dtype=np.bool_)
    for s in data.series:
        ends = data.places[s.table][s.ends[s.train]]
        if s.kind.ends == 2:
            if len(np.unique(ends[:, 0])) > 1:
                raise InputError(source, "pairs that are no star", "pairing star, or candidates that are no rows")
            hubs = np.union1d(hubs, ends[:, 0])
        used[ends] = True
    used[hubs] = False
    stop = np.full(data.n_configurations, NONE)  # test rows
    stop[hubs] = HUB
    stop[used] = np.arange(int(used.sum()))
    kept = np.flatnonzero(used)
    return Pool(
        scenario=None,
        tables=data.tables,
        problem=problem,
        readings=data.readings[kept],
        group=np.full(len(kept), ""),
        stop=stop,
        rows=stop_rows(problem, stop, hubs),
        given=np.zeros(0, dtype=np.int64),
        found={"": Candidates(data.readings[kept], len(kept), {})},
    )
