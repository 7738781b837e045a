"""Order of stops: against all orders there are, with the lengths of ways worked out anew."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from fg_calib.design import order
from simulated import paper_robot, planar_robot, small_arm
from tolerances import rounding

from fg_calib.designs.order import shortest_way, travel
from fg_calib.robot.inverse import random_readings

ARMS = [paper_robot(), planar_robot(), small_arm()]


def length(robot, readings):
    """The largest joint motion of each step; a joint that slides by the reach counts as one that turns by 1 rad."""
    size = [robot.reach if joint.prismatic else 1.0 for joint in robot.joints]
    return sum(max(abs(b - a) / s for a, b, s in zip(p, q, size, strict=True)) for p, q in pairwise(readings))


def some(robot, n, seed):
    return random_readings(robot, n, np.random.default_rng(seed))


@pytest.mark.parametrize("robot", ARMS, ids=lambda robot: robot.name)
def test_travel_is_the_largest_motion_of_every_step(robot):
    q = some(robot, 20, 0)
    assert travel(robot, q) == pytest.approx(length(robot, q), rel=rounding())
    assert travel(robot, q[:1]) == 0.0


@pytest.mark.parametrize("first", [None, 0, 3])
@pytest.mark.parametrize("robot", ARMS, ids=lambda robot: robot.name)
def test_every_stop_is_visited_once_and_no_way_round_is_gone(robot, first):
    for n in (4, 9, 40):
        q = some(robot, n, n)
        way = shortest_way(robot, q, first)
        assert sorted(way.tolist()) == list(range(n))
        assert first is None or way[0] == first
        given = np.append(first, np.delete(np.arange(n), first)) if first is not None else np.arange(n)
        assert travel(robot, q[way]) <= travel(robot, q[given]) + rounding()


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_stops_are_all_visited(n):
    q = some(ARMS[1], n, 1)
    assert sorted(shortest_way(ARMS[1], q).tolist()) == list(range(n))


@pytest.mark.slow
@pytest.mark.parametrize("robot", ARMS, ids=lambda robot: robot.name)
def test_a_way_of_six_stops_is_within_some_percent_of_the_shortest(robot):
    """A tenth at most, two percent in the mean; reversals and moves of one stop do not find everything."""
    ratios = []
    for seed in range(20):
        q = some(robot, 6, seed)
        best = min(length(robot, q[list(way)]) for way in permutations(range(6)))
        ratios.append(length(robot, q[shortest_way(robot, q)]) / best)
    assert min(ratios) >= 1.0 - rounding()
    assert np.mean(ratios) < 1.02
    assert max(ratios) < 1.1


def test_stops_on_a_line_are_visited_along_it():
    q = np.random.default_rng(1).permutation(np.linspace(-1.0, 1.0, 30))[:, None] * np.array([1.0, 0.5])
    assert travel(ARMS[1], q[shortest_way(ARMS[1], q)]) == pytest.approx(2.0, rel=1e-12)


def test_a_way_is_better_than_that_to_the_nearest_each_time(monkeypatch):
    q = some(ARMS[0], 60, 2)
    improved = travel(ARMS[0], q[shortest_way(ARMS[0], q)])
    monkeypatch.setattr(order, "MOST_IMPROVED", 0)
    assert improved < travel(ARMS[0], q[shortest_way(ARMS[0], q)])


def test_the_same_place_twice_is_no_way():
    q = np.repeat(some(ARMS[1], 5, 3), 3, axis=0)
    way = shortest_way(ARMS[1], q)
    assert sorted(way.tolist()) == list(range(15))
    assert travel(ARMS[1], q[way]) <= travel(ARMS[1], q)


def test_a_slide_is_worth_its_share_of_the_reach():
    """Of one joint that slides and one that turns: the same way in other units would be visited in another order."""
    robot = small_arm()
    q = np.zeros((3, 4))
    q[1, 2], q[2, 0] = robot.reach, 0.5  # a slide that counts as 1 rad, a turn of half
    assert travel(robot, q[[0, 1]]) == pytest.approx(1.0)
    assert travel(robot, q[[0, 2]]) == pytest.approx(0.5)
    assert travel(robot, q[[2, 1]]) == pytest.approx(1.0)
