"""Estimated noise is judged by how far the arm moved what was measured, of every instrument."""

from dataclasses import replace

import numpy as np
import pytest
from dense import SeriesRows
from instruments import TOLERANCE, measured_by
from simulated import measure, small_arm, true_robot
from sparing import as_case
from touches import reach, reach_faces

from fg_calib import KnownPoint, Measurements, Table, assess, build_problem, calibrate, solve
from fg_calib.graph import JOINT_NOISE, relinearized_at
from fg_calib.robot import pose

SIGMA = 1e-4
TOUCHED = ("faces", "contacts")


def touched(what, rng, n=36, n_points=3):
    """A nominal arm and a tip on three faces, which no figure says more of, or in contact with some points."""
    robot = small_arm(tolerance=TOLERANCE)
    true, which = true_robot(robot, rng), np.arange(n) % n_points
    points = pose(true, 0.4 + 0.15 * rng.normal(size=(n_points, 4))).position
    if what == "faces":
        normals = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        heights = np.einsum("ni,ni->n", normals, points)[which] + SIGMA * rng.normal(size=n)
        q = reach_faces(true, normals[which], heights, rng)
        data = Measurements.from_arrays(q, plane=[f"p{i}" for i in which], sigma_distance=SIGMA)
        return robot, Table(data, "plane")
    q = reach(true, points[which] + SIGMA * rng.normal(size=(n, 3)), rng)
    data = Measurements.from_arrays(q, anchor=[f"p{i}" for i in which], distance=np.zeros(n), sigma_distance=SIGMA)
    return robot, Table(data, "anchor", known={"p0": KnownPoint(points[0])})


@pytest.mark.usefixtures("without_reasons", "without_mistakes")
@pytest.mark.parametrize(
    "instrument", ["faces", *(as_case(x, is_slow=True) for x in ("contacts", "board", "targets", "anchors", "planes"))]
)
def test_estimated_noise_of_a_healthy_table_is_good_and_of_another_arm_is_not(instrument):
    """All readings exchanged with those of other rows: the noise estimated is then as large as what was measured."""
    rng = np.random.default_rng(4)
    robot, table = touched(instrument, rng) if instrument in TOUCHED else measured_by(instrument, rng)[::2]
    assert not calibrate(robot, table, estimate_noise=True).findings
    m = table.measurements
    mixed = replace(m, readings=rng.permutation(m.readings), ids=np.arange(m.n_configurations).astype(str))
    wrong = calibrate(robot, replace(table, measurements=mixed), estimate_noise=True)
    about = "corrections are too large" if instrument == "contacts" else "the arm explains next to nothing"
    assert any(about in finding for finding in wrong.findings)


def test_contact_with_a_single_point_does_not_move_it():
    """Nothing that was measured moves: healthy, and no figure over 0."""
    robot, table = touched("contacts", np.random.default_rng(1), n_points=1)
    assert not calibrate(robot, table, estimate_noise=True).findings


def test_a_kinds_factor_is_that_of_all_its_noise_where_joint_noise_has_another():
    """Specified and estimated rms are those of the dense covariance without and with the factors."""
    rng, robot = np.random.default_rng(0), small_arm(dict.fromkeys(("a", "d", "alpha", "theta"), 2e-3))
    m = measure(robot, 20, rng, sigma=(1e-3, 5e-4), sigma_joint=5e-4)
    problem = build_problem(robot, m, model="position")
    state = replace(problem.state, factors={(0, "position"): 2.0, JOINT_NOISE: 0.5})
    solution = solve(relinearized_at(problem, problem.start, state))
    (kind,) = assess(solution).fit.goodness.kinds
    with_factors = replace(problem, state=solution.problem.state)
    without, estimated = (
        np.sqrt(np.mean(np.einsum("nii->ni", SeriesRows(p, solution.parameters, 0).total)))
        for p in (problem, with_factors)
    )
    assert kind.specified_sigma_rms == pytest.approx(without, rel=1e-6)
    assert kind.factor == pytest.approx(estimated / without, rel=1e-6)
