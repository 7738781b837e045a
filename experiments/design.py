"""Is a designed set of configurations worth what the design expects?

    python experiments/design.py [--quick] [--only QUESTION ...] [--workers 2]

The paper's arm, its noise and priors, poses of the board in an unknown frame, 52 views chosen among candidates; next to
them 52 random candidates, and the smallest designed set that is as good as these. Each set is then measured and
calibrated with true arms, frames and noise drawn anew: RMS error of the tool at the task's configurations after the
best rigid fit, realised over what the design predicted.

| question | what |
|---|---|
| views | the half sphere of the paper, and a camera 0.3 to 2 m from the board |
| criteria | 24 positions of a UR10 by each criterion, over random sets |

Traps: the design minimises the error that the covariance expects; a real arm whose residuals are systematic gains
nothing by it (on rows of the real UR10 designed sets are no better than random ones).

Takes ten minutes with two workers.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from common import MM, Question, Row, Task, rms, run
from numpy.typing import NDArray
from paper import paper_scenario
from validation import scenario_of, without_rigid_motion

from fg_calib import Scenario, build_problem, design, simulate, solve
from fg_calib.robot import pose
from fg_calib.simulation import GivenReadings

Floats = NDArray[np.float64]

N_VIEWS = 52
VIEWS: dict[str, Row] = {"half sphere": {}, "0.3 to 2 m": {"distance": (0.3, 2.0)}}
SETS = ("designed", "random", "fewest")
CRITERIA = ("I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5")


@cache
def plans(views: str) -> Row:
    """Configurations of each set, and what the design expects of them."""
    scenario = views_scenario(views)
    plan = design(scenario, n=N_VIEWS, seed=0)
    few = design(scenario, target=plan.random, seed=0)
    drawn = np.random.default_rng(1).choice(len(plan.pool.readings), N_VIEWS, replace=False)
    return {
        "scenario": scenario,
        "task": plan.task.readings,
        "designed": (plan.readings, plan.expected.position),
        "fewest": (few.readings, few.expected.position),
        "random": (plan.pool.readings[drawn], plan.random),
    }


def views_scenario(views: str) -> Scenario:
    """The paper's scenario measured as poses in an unknown frame."""
    job: dict[str, Any] = {"model": "pose"}
    return replace(paper_scenario("unknown", **VIEWS[views]), job=job, validation=None)


def realise(task: Task) -> Row:
    """Squared tool error of one drawn arm measured at one set and calibrated, and the number of configurations."""
    views, chosen, seed = task
    plan = plans(views)
    readings, predicted = plan[chosen]
    there = replace(plan["scenario"], configurations=GivenReadings(readings))
    simulation = simulate(there, 1000 + seed)
    solution = solve(build_problem(simulation.robot, simulation.tables))
    at = pose(simulation.true_robot, plan["task"]).position
    off = (pose(solution.robot, plan["task"]).position - at)[:, :, None]
    square = float(3.0 * np.mean(without_rigid_motion(at, off) ** 2))
    return {"square": square, "predicted": predicted, "n": len(readings)}


def views_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Predicted and realised errors by views and set, [m]."""
    found: Row = {}
    for views in VIEWS:
        for chosen in SETS:
            of = [row for task, row in zip(tasks, rows, strict=True) if task[:2] == (views, chosen)]
            realised, predicted = rms([np.sqrt(row["square"]) for row in of]), of[0]["predicted"]
            cell = {"n": of[0]["n"], "predicted": predicted, "realised": realised, "ratio": realised / predicted}
            found[f"{views}, {chosen}"] = cell
    return found


def views_answer(found: Row) -> str:
    """Designed, random and fewest, with realised over predicted."""
    parts = []
    for views in VIEWS:
        designed, random, few = (found[f"{views}, {chosen}"] for chosen in SETS)
        parts.append(
            f"{views}: {N_VIEWS} designed views expect {designed['predicted'] / MM:.2f} mm, random ones "
            f"{random['predicted'] / MM:.2f}, as do {few['n']} designed ones"
        )
    ratios = [row["ratio"] for cell, row in found.items() if "random" not in cell]
    return f"{'; '.join(parts)}; realised over predicted {min(ratios):.2f} to {max(ratios):.2f}"


def by_criterion(task: Task) -> Row:
    """Expected error of a set chosen by one criterion over that of the median random set."""
    (criterion,) = task
    scenario = scenario_of("honesty", "UR10, pose, frame unknown, exact encoders")
    plan = design(scenario, n=12, seed=0, criterion=criterion)
    return {"over random": plan.expected.position / plan.random}


QUESTIONS = (
    Question("views", "Is a designed set of configurations worth what it says?",
             lambda n, first: [(v, s, first + k) for v in VIEWS for s in SETS for k in range(n)], realise,
             views_summary, views_answer, (60, 1)),
    Question("criteria", "Which criterion chooses best?", lambda n, s: [(c,) for c in CRITERIA], by_criterion,
             lambda tasks, rows: {c: row["over random"] for (c,), row in zip(tasks, rows, strict=True)},
             lambda f: "Expected tool error over random sets: " + ", ".join(f"{c} {v:.2f}" for c, v in f.items())),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
