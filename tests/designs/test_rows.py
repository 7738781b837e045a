"""Rows by pose: their sum is the information of the same measurements in a calibration."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from scenarios import CAMERA, GRID, INSTRUMENTS, SIGMA, WALL, scenario
from tolerances import rounding

from fg_calib import Pairing
from fg_calib.designs.candidates import build_pool, draw_groups, rows_in_columns_of
from fg_calib.graph import build_problem, prior_rows, square_root
from fg_calib.observability import true_problem
from fg_calib.simulation.scenario import Instrument, Placement, RandomReadings

N = 20
"""Candidates; of cameras, which see few, twice as many."""

NOISE = replace(SIGMA, joint=1e-3)
"""Joint noise that moves the tool ten times as far as what measures errs: what is shared counts."""

FLOOR = {"floor": Placement(np.eye(3), np.array([0.0, 0.0, -2.5]))}
STAR = Instrument(model="distance-rotation", name="formed")
LENGTHS = Instrument(model="distance", name="lengths")
ANCHORS = Instrument(model="anchor", name="anchors")
POSES = Instrument(model="pose", name="poses")
BOARDS = Instrument(model="pixels", name="boards", boards=WALL | FLOOR, camera=CAMERA, corners=GRID)

ALONE = ("targets", "stations", "anchors", "offset", "contact", "planes", "faces", "pixels", "sockets")
KINDS = {name: (INSTRUMENTS[name],) for name in ALONE} | {
    "formed star": (STAR,),
    "formed lengths": (Instrument(model="distance", name="it", pairing=Pairing("all")),),
    "two boards": (BOARDS,),
    "poses and lengths at the same poses": (POSES, ANCHORS),
    "a star whose reference pose others measure": (LENGTHS, POSES),
    "two stars": (LENGTHS, replace(LENGTHS, name="more", configurations=RandomReadings(8))),
    "poses of its own": (replace(POSES, configurations=RandomReadings(8)), ANCHORS),
    "some that see nothing": (BOARDS, ANCHORS),
}


def pool_with(*instruments, n=N, **changes):
    n = 2 * n if any(i.model == "pixels" for i in instruments) else n
    of = scenario(*instruments, n=n, noise=NOISE, **changes)
    return build_pool(of, draw_groups(of, n, np.random.default_rng(0)))


def square(rows):
    return rows.T @ rows


def information_of(problem):
    """What the rows of a problem say, and its tolerances: shape (n_columns + n_nuisance,) * 2."""
    v = problem.variables
    priors = np.pad(prior_rows(v, problem.start)[1], ((0, 0), (0, v.n_nuisance)))
    return square(square_root(problem, problem.start)[:, :-1]) + square(priors)


def without_last(M, n):
    """Information of the first n, the others unknown; what is not determined of these says nothing."""
    d = np.sqrt(np.diag(M))
    d = np.where(d > 0.0, d, 1.0)
    C = M / np.outer(d, d)
    left = C[:n, :n] - C[:n, n:] @ np.linalg.pinv(C[n:, n:], rcond=1e-13, hermitian=True) @ C[n:, :n]
    return left * np.outer(d, d)[:n, :n]


def apart(a, b):
    """The largest difference of two informations, each column in the units of its own sigma."""
    d = np.sqrt(np.diag(a))
    d = np.where(d > 0.0, d, 1.0)
    return np.abs((a - b) / np.outer(d, d)).max()


def of_poses(rows, chosen=slice(None)):
    return square(rows.rows[chosen].reshape(-1, rows.rows.shape[2])) + square(rows.always)


@pytest.mark.parametrize("kind", KINDS)
def test_all_poses_together_hold_what_their_problem_holds(kind):
    """Column by column, nuisances too: to the rounding of sums, of a triangle, and of one Schur complement."""
    pool = pool_with(*KINDS[kind])
    expected = information_of(pool.problem)
    found = without_last(of_poses(pool.rows), len(expected))
    assert apart(expected, found) < rounding()
    assert len(pool.rows.rows) == len(pool.readings) == pool.pose_of.max() + 1


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "formed lengths"])
def test_some_poses_hold_what_a_problem_of_them_alone_holds(kind):
    """Of the arm and its frames: landmarks, which may start at other values, are eliminated."""
    pool = pool_with(*KINDS[kind])
    n = pool.problem.variables.n_columns
    some = np.random.default_rng(1).permutation(len(pool.readings))[: max(2, 3 * len(pool.readings) // 5)]
    alone = true_problem(pool.robot, pool.select_tables(some), pool.problem.options)
    assert alone.variables.n_columns == n
    expected, found = without_last(information_of(alone), n), without_last(of_poses(pool.rows, some), n)
    assert apart(expected, found) < 1e-6  # eliminating unknowns that so few poses hardly hold takes half the digits


@pytest.mark.parametrize("kind", ["pixels", "two boards"])
def test_many_rows_are_reduced_to_no_more_than_they_determine(kind):
    """An image says of a tool frame what a pose says; of two boards in sight twice that."""
    pool = pool_with(*KINDS[kind])
    data = pool.problem.data
    (block,) = data.blocks
    most = np.bincount(data.places[block.table][block.ends[block.train]].ravel()).max()
    assert most >= len(GRID) / 2
    boards = len(pool.problem.data.landmarks.names) or 1
    assert pool.rows.rows.shape[1] <= 12 * boards < 2 * most


def test_rows_of_before_say_what_they_do_with_places_that_are_not_seen_again_unknown():
    robot, _, table = measured_by("anchors", np.random.default_rng(0))
    again = table.measurements.labels["anchor"].index != 1
    before = build_problem(robot, table)
    problem = build_problem(robot, replace(table, measurements=table.measurements.select(again)))
    whole = square(square_root(before, before.start)[:, :-1])
    n = before.variables.n_columns
    order = np.concatenate([np.arange(n + 3), np.arange(n + 6, n + 9), np.arange(n + 3, n + 6)])
    wanted = without_last(whole[np.ix_(order, order)], n + 6)
    assert apart(wanted, square(rows_in_columns_of(before, problem))) < rounding()
