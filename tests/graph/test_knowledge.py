"""What earlier rows say, kept as a square root of their information: dense formulas, and all rows at once."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from oracle import central_differences
from simulated import TOOL, small_arm

from fg_calib import build_problem, calibrate
from fg_calib.graph.knowledge import Knowledge

UNKNOWNS = [("A", "a0"), ("A", "a1")]
PLACES = np.array([1.0, 2.0, 3.0, -1.0, 0.5, 2.5])


@pytest.fixture
def dense():
    """Knowledge of random rows of an arm with a tool and two anchors, their information and what they say."""
    rng, robot = np.random.default_rng(0), small_arm(estimate=TOOL)
    n = 16 + 6 + len(PLACES)
    A, b = 1e3 * rng.normal(size=(60, n)), rng.normal(size=60)
    return Knowledge.of_rows(robot, UNKNOWNS, PLACES, A, b), A.T @ A, A.T @ b


def check(known, information, gradient):
    """The rows have this information, and their optimum where it says."""
    assert known.rows.T @ known.rows == pytest.approx(information, rel=1e-9, abs=1e-9 * np.abs(information).max())
    assert known.rows.T @ known.right == pytest.approx(gradient, rel=1e-9, abs=1e-9 * np.abs(gradient).max())


def test_rows_are_kept_by_their_information_and_what_is_not_asked_is_eliminated(dense):
    known, H, g = dense
    check(known, H, g)
    kept, gone = np.r_[:22, 25:28], np.r_[22:25]
    gain = H[np.ix_(kept, gone)] @ np.linalg.inv(H[np.ix_(gone, gone)])
    about = known.about([UNKNOWNS[1]])
    check(about, H[np.ix_(kept, kept)] - gain @ H[np.ix_(gone, kept)], g[kept] - gain @ g[gone])
    assert about.place(UNKNOWNS[1]).tolist() == PLACES[3:].tolist()
    assert known.about(UNKNOWNS) is known
    A, b = np.random.default_rng(1).normal(size=(3, 28)), np.ones(3)
    check(known.with_rows(A, b), H + A.T @ A, g + A.T @ b)
    follow, root, unknown = known.follow()
    landmarks = np.linalg.inv(H[22:, 22:])
    assert follow == pytest.approx(-landmarks @ H[22:, :22], rel=1e-6)
    assert root @ root.T == pytest.approx(landmarks, rel=1e-9)
    assert not unknown.any()


def test_changes_since_are_added_to_the_covariance_and_free_ones_are_forgotten(dense):
    known, H, g = dense
    G = np.random.default_rng(2).normal(size=(28, 3)) * 1e-3
    grown = known.grown(G, np.array([False, True, False]))
    limited = np.linalg.inv(H) + G[:, [0, 2]] @ G[:, [0, 2]].T
    information = np.linalg.inv(limited)
    free = information @ G[:, [1]]
    information = information - free @ free.T / (G[:, [1]].T @ free)
    check(grown, information, information @ np.linalg.solve(H, g))
    assert known.grown(np.zeros((28, 0)), np.zeros(0, dtype=bool)) is known


def test_rows_at_other_parameters_follow_the_tangent_of_frames():
    """Their derivatives in a problem's columns are central differences, and the factor has half their squares."""
    robot, _, table = measured_by("anchors", np.random.default_rng(3), n=24)
    robot = robot.with_estimated([*(p.name for p in robot.parameters if p.estimated), *TOOL])
    problem = build_problem(robot, table)
    variables, unknowns = problem.variables, problem.data.landmarks
    rng, names = np.random.default_rng(4), [name for name in unknowns.keys if name[0] == "A"]
    A, at = rng.normal(size=(50, 22 + 3 * len(names))), rng.normal(size=3 * len(names))
    known = Knowledge.of_rows(robot.with_values(robot.nominal + 0.01), names, at, A, rng.normal(size=50))
    known = known.seen_by(variables, unknowns)
    x = variables.moved(problem.start, 0.1 * rng.normal(size=variables.n_columns + variables.n_nuisance))

    def rows(step):
        return known.at_parameters(variables, unknowns, variables.moved(x, step))[0]

    numeric = central_differences(rows, np.zeros(variables.n_columns + variables.n_nuisance))
    r, D = known.at_parameters(variables, unknowns, x)
    assert numeric == pytest.approx(D, abs=1e-6 * np.abs(D).max())
    assert known.factor(variables, unknowns).error(variables.values(x)) == pytest.approx(0.5 * r @ r, rel=1e-9)


def test_an_update_is_a_calibration_of_all_rows():
    """Anchors stay where they are; what is not linear between two estimates is a twentieth of a sigma."""
    robot, _, table = measured_by("anchors nearly", np.random.default_rng(5), n=48)
    m = table.measurements
    first, second = (replace(table, measurements=replace(m.select(rows), source=source))
                     for rows, source in ((np.arange(30), "first"), (np.arange(30, 48), "second")))  # fmt: skip
    both, before, second = calibrate(robot, [first, second]), calibrate(robot, [first]), replace(second, known={})
    updated, moved = (before.update([second], anchors_stay=stay) for stay in (True, False))
    assert moved.parameters["a2"].sigma > 1.02 * updated.parameters["a2"].sigma
    for name in both.result.covariance.names:
        a, b = updated.parameters[name], both.parameters[name]
        assert abs(a.estimate - b.estimate) < 0.05 * b.sigma
        assert a.sigma == pytest.approx(b.sigma, rel=0.01)
