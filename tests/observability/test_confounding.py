"""Directions that unknowns of the measurements take up: said only where giving these would show them."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import TARGETS, measured_by
from touches import corners, touch

from fg_calib import KnownPoint, Measurements, Robot, Table, build_problem
from fg_calib.graph import named_triangle
from fg_calib.observability import NOT_EXCITED, identifiability_of
from fg_calib.observability.reasons import BASE, NO_CAUSE, find_confounding

TARGETS_DO = "confounded with the unknown places of the targets on the tool"


def looked_at(robot, tables):
    """The problem of some tables, and what it determines."""
    problem = build_problem(robot, tables)
    return problem, identifiability_of(problem, problem.start, "practical")


def by_reason(found):
    """Lost directions by their reason."""
    reasons = {}
    for lost in found.lost:
        reasons.setdefault(lost.reason, []).append(lost.relation)
    return reasons


def seen(problem, relation):
    """Signal-to-noise ratio of a direction: how many sigma it moves the measurements."""
    direction = np.array([relation.get(p.name, 0.0) for p in problem.estimated])
    return float(np.linalg.norm(named_triangle(problem, problem.start) @ direction))


def given(table, names):
    """The same with the places of some targets known."""
    return replace(table, known={name: KnownPoint(TARGETS[int(name[1:])]) for name in names})


@pytest.mark.parametrize("instrument", ["targets", "targets stations"])
def test_unknown_targets_take_up_what_a_known_one_shows(instrument):
    robot, _, table = measured_by(instrument, np.random.default_rng(0))
    _, found = looked_at(robot, table)
    reasons = by_reason(found)
    help_ = ": to see it, give places of targets (key `targets`)"
    assert set(reasons) == {BASE, TARGETS_DO + help_}
    with_one, _ = looked_at(robot, given(table, ["t0"]))
    without, _ = looked_at(robot, table)
    for relation in reasons[TARGETS_DO + help_]:
        assert seen(without, relation) < 1e-6 * seen(with_one, relation)


def test_what_an_instrument_adds_takes_up_a_length():
    """A slide that only moves towards its anchor."""
    robot = Robot.from_dh([[0.0, 0.0, 0.3, 0.0]], convention="dh", types="prismatic", tolerance={"d": 1e-3})
    robot = replace(robot, parameters=tuple(replace(p, estimated=p.name == "d1") for p in robot.parameters))
    q = np.linspace(0.0, 0.5, 9)[:, None]
    data = Measurements.from_arrays(q, anchor=["end"] * 9, distance=1.7 - q[:, 0], sigma_distance=1e-5)
    table = Table(data, "anchor", known={"end": KnownPoint([0, 0, 2.0])})
    assert not looked_at(robot, table)[1].lost
    _, found = looked_at(robot, replace(table, offset=True))
    assert by_reason(found) == {"confounded with what the instrument adds to every length": [{"d1": 1.0}]}


def test_touched_points_take_up_the_size_of_the_arm():
    """Without a distance between two points nothing is said of what other configurations would show."""
    rows = [[0.1, 1.5, 0.4, 0.1], [0.5, 0.2, 0.1, 0.0], [0.4, -1.4, 0.05, 0.3], [0.3, 0.9, 0.2, -0.2]]
    robot, rng = Robot.from_dh(rows, tolerance={"a": 1e-3}), np.random.default_rng(1)
    points = corners(robot, 4, rng)
    m = replace(touch(robot, points, 20, rng, sigma=1e-12), sigmas={"point": np.full(80, 1e-4)})
    problem, found = looked_at(robot, Table(m, "distance"))
    reasons = by_reason(found)
    assert "confounded with the unknown contact points" in reasons
    assert NOT_EXCITED not in reasons
    assert NO_CAUSE not in reasons
    directions = np.array([[lost.relation.get(p.name, 0.0) for lost in found.lost] for p in problem.estimated])
    for way in (1.0, -1.0):  # the third turns the last link about the tool's point, which nothing sees
        assert find_confounding(problem, problem.start, way * directions) == [("L",), ("L",), (), ("L",)]
    m = touch(robot, points, 20, rng, sigma=1e-12, distances=[(0, 1, 1e-5), (1, 2, 1e-5)])
    problem, _ = looked_at(robot, Table(replace(m, sigmas={"point": np.full(80, 1e-4)}), "distance"))
    assert max(seen(problem, relation) for relation in reasons["confounded with the unknown contact points"]) > 1.0
