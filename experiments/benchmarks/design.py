"""How long does it take to choose 50 of 10 000 configurations, by each criterion?

Command: python experiments/benchmarks/design.py [--quick] [--out FOLDER]
Takes one to three minutes.

The paper's arm, 30 parameters, and poses in an unknown frame, at 10 000 random configurations. Timed in one process are
the making of candidates' rows, and for each of the nine criteria what `design` does to choose: greedy choice from two
starts, exchange, and the comparison with 100 random sets. Seconds by the clock and of processor time, and that over D.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from fg_calib import Scenario, read_scenario
from fg_calib.designs.chooser import Chooser
from fg_calib.designs.criteria import Criterion
from fg_calib.designs.pool import drawn, pool_of
from fg_calib.designs.search import not_worse_than_random
from fg_calib.designs.system import system_of
from fg_calib.designs.task import Task
from fg_calib.robot.inverse import random_readings
from fg_calib.simulation.configurations import RandomReadings
from fg_calib.threads import single_threaded

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[2]
NAME = "design"
N, OF = 50, 10_000


def timed(work: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """What it returns, and its seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = work()
    return found, {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}


@single_threaded
def run(out: Path, quick: bool = False) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    n, of = (5, 200) if quick else (N, OF)
    shipped = read_scenario("space-robot")
    rng = np.random.default_rng(0)
    robot = shipped.robot
    scenario = Scenario(robot, shipped.errors, RandomReadings(of), shipped.noise, job={"model": "pose"})
    small = Scenario(robot, shipped.errors, RandomReadings(5), shipped.noise, job={"model": "pose"})
    pool_of(small, drawn(small, 5, rng))  # compiles, or reads the compiled kernels
    pool, of_pool = timed(lambda: pool_of(scenario, drawn(scenario, of, rng)))
    task = Task(random_readings(robot, 500, rng), True)
    system = system_of(pool.rows, pool.known, task.form(pool.problem))
    found: dict[str, Any] = {
        "n": n,
        "of": of,
        "n_parameters": sum(p.estimated for p in robot.parameters),
        "n_columns": system.rows.shape[2],
        "rows_a_stop": system.rows.shape[1],
        "processors": os.cpu_count(),
        "rows of candidates": of_pool,
        "criteria": {},
    }

    def choose(criterion: Criterion) -> float:
        chooser = Chooser(system, criterion)
        return not_worse_than_random(chooser.measure, chooser.best(n), np.random.default_rng(1)).value

    for criterion in get_args(Criterion):
        _, found["criteria"][criterion] = timed(lambda criterion=criterion: choose(criterion))  # type: ignore[misc]
    for row in found["criteria"].values():
        row["over_D"] = row["cpu_seconds"] / found["criteria"]["D"]["cpu_seconds"]
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(found, indent=1) + "\n")
    return found


def describe(found: dict[str, Any]) -> str:
    """The table for people."""
    head = f"{found['n']} of {found['of']}, {found['n_parameters']} parameters, {found['rows_a_stop']} rows a stop"
    lines = [head, f"{'':24}{'seconds':>9}{'cpu':>8}{'over D':>8}"]
    rows = {"rows of candidates": found["rows of candidates"], **found["criteria"]}
    for name, row in rows.items():
        lines.append(f"{name:24}{row['seconds']:9.1f}{row['cpu_seconds']:8.1f}{row.get('over_D', float('nan')):8.2f}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="5 of 200")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    print(describe(run(given.out, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
