"""Several tables, one of them with a mistake in its set-up: it is named, whatever the order of the tables."""

from dataclasses import replace

import numpy as np
import pytest
from jobs import PLACED, ur5e
from simulated import TOOL, measure, pairs_between, true_robot, with_changes
from sparing import diagonal

from fg_calib import Table, build_problem, solve
from fg_calib.diagnostics.setup_check import OTHER_TOOL, check_problem

TOLERANCE = {"a": 0.0005, "d": 0.0005, "alpha": 0.05, "theta": 0.05, "beta": 0.05, "tool": 0.001}


def tracker(true, rng, **keys):
    return replace(measure(true, 30, rng, sigma=(5e-5, 1e-4), **keys), source="tracker.csv")


def lengths(true, rng):
    """Lengths between configurations measured directly."""
    m = measure(true, 40, rng, sigma=(5e-5, 1e-4))
    pairs = pairs_between(true, m.readings, (np.arange(0, 40, 2), np.arange(1, 40, 2)), rng, sigma=(5e-5, 0.0))
    return replace(m, position=None, rotation=None, sigma_position=None, sigma_orientation=None, pairs=pairs,
                   source="bar.csv")  # fmt: skip


def said(robot, tables, order):
    problem = build_problem(robot, [tables[i] for i in order], max_iterations=1)  # only what comes before counts
    found = check_problem(problem, solve(problem).before, doubtful=True)
    return [str(check) for check in (found, *found.others)]


MISTAKES = {
    "bar.csv: distance residuals fall from": "if distances are in m, not mm",
    "cam.csv: position residuals fall from": "if x, y, z are in mm, not m",
}


def three_tables(true, rng, mistake):
    bar = lengths(true, rng)
    if "distance residuals fall" in mistake:
        bar = replace(bar, pairs=replace(bar.pairs, distance=bar.pairs.distance * 1e-3))
    cam = replace(tracker(true, rng), source="cam.csv")
    if "cam" in mistake:
        cam = replace(cam, position=cam.position * 1e3)
    first = Table(tracker(true, rng, frame=PLACED), "position", frame="unknown")
    return [first, Table(bar, "distance"), Table(cam, "pose", frame="unknown")]


@pytest.mark.slow
@pytest.mark.parametrize(("mistake", "order"), diagonal(MISTAKES, [(0, 1, 2), (2, 1, 0)]))
def test_a_mistake_in_one_of_three_tables_is_said_of_that_table(tmp_path, mistake, order):
    rng = np.random.default_rng(3)
    robot = ur5e(tmp_path, estimate=["tool.x", "tool.y", "tool.z"], tolerance=TOLERANCE)
    found = said(robot, three_tables(true_robot(robot, rng), rng, mistake), order)
    assert len(found) == 1
    assert found[0].startswith(mistake)
    assert MISTAKES[mistake] in found[0]


def test_another_tool_is_said_of_the_tables_that_disagree(tmp_path):
    rng = np.random.default_rng(5)
    robot = ur5e(tmp_path, estimate=TOOL, tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    other = with_changes(true, **{"tool.x": 0.06, "tool.y": -0.02, "tool.z": 0.03})
    arms = {"one.csv": true, "other.csv": other}
    tables = [Table(replace(tracker(arm, rng), source=name), "position") for name, arm in arms.items()]
    found = said(robot, tables, (0, 1))
    assert {text.partition(":")[0] for text in found} == set(arms)
    assert all(text.endswith(f" if {OTHER_TOOL}") for text in found)


def test_tables_without_a_mistake_have_nothing_to_say(tmp_path):
    rng = np.random.default_rng(3)
    robot = ur5e(tmp_path, estimate=["tool.x", "tool.y", "tool.z"], tolerance=TOLERANCE)
    problem = build_problem(robot, three_tables(true_robot(robot, rng), rng, "none"))
    found = check_problem(problem, solve(problem).before, doubtful=True)
    assert not found.far
    assert (found.explanations, found.others) == ((), ())
