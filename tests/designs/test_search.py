"""Search against trying every set there is."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from simulated import planar_robot, small_arm
from systems import random_system
from tolerances import rounding

from fg_calib.designs import search
from fg_calib.designs.criteria import Measure
from fg_calib.designs.search import Chooser, choose_greedily, exchange, joint_travel, order_by_nearest
from fg_calib.robot.inverse import random_readings

CRITERIA = ("I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5")


def value(system, criterion, chosen):
    return Measure(criterion, system).value(system.information(np.array(chosen, dtype=np.int64)))


def gap(criterion, found, best):
    """How much worse, as a share; of a logarithm of p variances, as a share of a standard deviation."""
    if criterion in ("D", "O1"):
        return np.expm1((found - best) / 8.0)
    return (found - best) / abs(best)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_best_of_all_sets_is_found_within_a_percent(criterion):
    """All that a design does: greedy and random starts, exchange."""
    n, of = 4, 12
    for seed in (0, 1, 2):
        system = random_system(np.random.default_rng(seed), of, h=1 + seed % 3)
        best = min(value(system, criterion, one) for one in combinations(range(of), n))
        found = Chooser(system, criterion).best(n, np.random.default_rng(0))
        assert gap(criterion, value(system, criterion, found), best) < 0.01, seed


@pytest.mark.parametrize("criterion", ["I", "E"])
def test_no_random_set_of_a_hundred_is_better(criterion):
    """Of a pool so large that exchange starts from the two best sets alone; of others by no more than a percent."""
    n, system = 30, random_system(np.random.default_rng(3), 700, h=1, p=6)
    found = Chooser(system, criterion).best(n, np.random.default_rng(7))
    assert len(set(found.tolist())) == n
    for seed, share in ((7, 0.0), (8, 0.01)):
        rng = np.random.default_rng(seed)
        random = min(value(system, criterion, rng.choice(700, n, replace=False)) for _ in range(100))
        assert gap(criterion, value(system, criterion, found), random) <= share


def test_no_random_set_is_better_by_an_error_that_the_system_does_not_give():
    """As of chains of pairs, for which candidates are chosen as poses; here the error is the sum of their numbers."""
    system = random_system(np.random.default_rng(2), 40)
    plain = Chooser(system, "I").best(5, np.random.default_rng(3))
    assert np.sum(Chooser(system, "I", np.sum).best(5, np.random.default_rng(3))) < np.sum(plain)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_exchange_never_makes_worse_and_ends_where_no_single_one_helps(criterion):
    """To the share that a sweep must gain for another one."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        system = random_system(rng, 14)
        start = rng.choice(14, 4, replace=False).astype(np.int64)
        found = exchange(Measure(criterion, system), start)
        now, others = value(system, criterion, found), np.setdiff1d(np.arange(14), found)
        assert now <= value(system, criterion, start)
        assert len(np.unique(found)) == 4
        swapped = [value(system, criterion, [*np.delete(found, place), k]) for place in range(4) for k in others]
        assert min(swapped) > now - 4 * search.MIN_GAIN * abs(now)


def test_greedy_takes_the_best_in_addition_to_those_before_it():
    system = random_system(np.random.default_rng(1), 12)
    for criterion in CRITERIA:
        taken = choose_greedily(Measure(criterion, system), 5, np.zeros(0, dtype=np.int64))
        for k in range(5):
            left = [j for j in range(12) if j not in taken[:k]]
            each = [value(system, criterion, [*taken[:k], j]) for j in left]
            assert value(system, criterion, taken[: k + 1]) <= min(each) + rounding(each, 1e3)
    assert choose_greedily(Measure("I", system), 5, taken[:2])[:2].tolist() == taken[:2].tolist()


def test_exchange_is_the_same_in_any_unit():
    system, start = random_system(np.random.default_rng(0), 14), np.arange(4)
    found = exchange(Measure("I", system), start)
    assert found.tolist() != start.tolist()
    assert exchange(Measure("I", replace(system, task=1e-8 * system.task)), start).tolist() == found.tolist()


# --- as few as reach a target -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_as_few_as_reach_a_target(seed):
    """The fewest that all sets of each size need, or one more; all there are of a target that none reaches."""
    system = random_system(np.random.default_rng(seed), 11)
    for n in (2, 4):
        target = 1.0001 * min(np.sqrt(value(system, "I", one)) for one in combinations(range(11), n))
        found = Chooser(system, "I").reaching(target)
        assert np.sqrt(value(system, "I", found)) <= target
        assert n <= len(found) <= n + 1
    assert [len(Chooser(system, "I").reaching(target)) for target in (1e9, 1e-9)] == [1, 11]


@pytest.mark.parametrize("criterion", ["D", "O2"])
def test_a_target_is_of_the_error_whatever_the_criterion(criterion):
    system = random_system(np.random.default_rng(5), 40)
    target = np.sqrt(value(system, "I", Chooser(system, "I").quickly(10))) * 1.1
    assert np.sqrt(value(system, "I", Chooser(system, criterion).reaching(target))) <= target


# --- the order of a visit ---------------------------------------------------------------------------------------------


def test_travel_is_the_largest_joint_motion_of_every_step():
    """A prismatic joint that moves by the arm's reach counts as a rotation of 1 rad."""
    robot = small_arm()
    q = np.zeros((3, 4))
    q[1, 2], q[2, 0] = robot.reach, 0.5
    assert joint_travel(robot, q[[0, 1]]) == pytest.approx(1.0)
    assert joint_travel(robot, q[[0, 2]]) == pytest.approx(0.5)
    assert joint_travel(robot, q) == pytest.approx(2.0)


@pytest.mark.parametrize("n", [1, 40])
def test_every_configuration_is_visited_once_and_next_is_the_nearest(n):
    robot = planar_robot()
    q = random_readings(robot, n, np.random.default_rng(n))
    order = order_by_nearest(robot, q)
    assert sorted(order.tolist()) == list(range(n))
    for k in range(n - 1 if n > 2 else 0):
        steps = [np.abs(q[order[k]] - q[j]).max() for j in order[k + 1 :]]
        assert steps[0] == min(steps)
