"""Of a job's rows train rows are chosen, and test rows take no part."""

import numpy as np
import pytest

from fg_calib import Job, Measurements, Options, Robot, design
from fg_calib.robot.kinematics import pose


@pytest.mark.slow
def test_test_rows_of_a_job_are_not_chosen_nor_counted():
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
    assert plan.tables[0].measurements.ids.tolist() == plan.ids.tolist()
