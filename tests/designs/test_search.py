"""Few sets are all looked at, a design is no worse than random sets, and rows of a job are train rows."""

from itertools import combinations
from typing import get_args

import numpy as np
import pytest

from fg_calib import Job, Measurements, Options, Robot, design
from fg_calib.designs.chooser import Chooser
from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.search import not_worse_than_random, random_values
from fg_calib.designs.system import System
from fg_calib.robot.kinematics import pose


def system(n_candidates: int, seed: int, m: int = 8) -> System:
    """Stops of three rows in eight coordinates, the task and the core of random directions."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n_candidates, 3, m)) * np.geomspace(0.1, 3.0, m)
    task, core = rng.normal(size=(20, m)), np.linalg.qr(rng.normal(size=(m, 5)))[0].T
    return System(rows=rows, known=1e-3 * np.eye(m), task=task.T @ task, core=core, unknown=0.0, basis=np.eye(m))


@pytest.mark.slow
@pytest.mark.parametrize("criterion", get_args(Criterion))
def test_of_few_sets_the_best_is_found(criterion):
    for seed in (1, 2, 3):  # in one of these each criterion's exchange alone ends elsewhere
        some = system(12, seed)
        measure = Measure(criterion, some)
        best = min(measure.value(some.information(np.array(one))) for one in combinations(range(12), 3))
        found = not_worse_than_random(measure, Chooser(some, criterion).best(3), np.random.default_rng(0))
        assert found.value <= best + 1e-9 * abs(best)  # rounding: the same set


@pytest.mark.parametrize("criterion", ["I", "D", "O4"])
def test_no_random_set_is_better(criterion):
    some = system(60, 4)
    measure = Measure(criterion, some)
    found = not_worse_than_random(measure, Chooser(some, criterion).best(6), np.random.default_rng(0))
    values, sets = random_values(measure, 6, np.random.default_rng(1))
    assert found.value <= values.min()
    assert all(len(set(one)) == 6 for one in sets.tolist())


@pytest.mark.slow
def test_test_rows_of_a_job_are_not_chosen():
    rows = [[0.4, 0.3, 0.2, 0.0], [0.3, -1.2, 0.1, 0.0], [0.5, 0.7, 0.1, 0.0]]
    robot = Robot.from_dh(rows, convention="dh", tolerance={"a": 0.002, "d": 0.002, "alpha": 0.002, "theta": 0.002})
    rng = np.random.default_rng(0)
    q = rng.uniform(-2.0, 2.0, size=(30, 3))
    p = pose(robot, q).position + 1e-4 * rng.normal(size=(30, 3))
    names, test = np.array([f"r{k}" for k in range(30)]), np.arange(30) % 3 == 0
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4, ids=names, test=test)
    plan = design(Job(None, robot, data, Options("position", frame="unknown")), n=6, candidates="rows")
    assert plan.n == 6
    assert set(plan.ids.tolist()) <= set(names[~test].tolist())
    assert [plan.tables[0].measurements.ids.tolist()] == [plan.ids.tolist()]
