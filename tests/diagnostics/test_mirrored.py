"""A plane's normal the wrong way round and an anchor on the wrong side are found out after the calibration."""

import numpy as np
import pytest
from instruments import TOLERANCE
from scipy.stats import chi2
from simulated import small_arm, true_robot
from touches import reach_faces

from fg_calib import calibrate
from fg_calib.diagnostics.mirrored import mirror_images
from fg_calib.diagnostics.multistart import multistart
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import Table
from fg_calib.robot.kinematics import pose
from fg_calib.statistics.residual_table import residual_table

SIGMA = 1e-5


def on_planes(rng, reading, n=48, n_planes=3):
    """A nominal arm, the true one, unit normals, and signed readings of an indicator on faces, 1 mm by the arm."""
    robot = small_arm(tolerance=TOLERANCE)
    true, which = true_robot(robot, rng), np.arange(n) % n_planes
    normals = rng.normal(size=(n_planes, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    readings = reading * rng.uniform(-1.0, 1.0, n)
    heights = np.einsum("ni,ni->n", normals, pose(true, rng.uniform(-1, 1, (n_planes, 4))).position)
    q = reach_faces(true, normals[which], heights[which] + readings, rng)
    data = Measurements.from_arrays(
        q,
        plane=[f"p{i}" for i in which],
        distance=readings + SIGMA * rng.normal(size=n) * (reading > 0.0),
        sigma_distance=SIGMA,
    )
    return robot, true, normals, Table(data, "plane")


def around_an_anchor(rng, height, n=48):
    """Lengths to an anchor 0.6 m above a patch that is flat but for `height`."""
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    at = pose(true, rng.uniform(-1, 1, (1, 4))).position[0]
    q = reach_faces(true, np.tile([0.0, 0.0, 1.0], (n, 1)), at[2] + height * rng.uniform(-1, 1, n), rng)
    anchor = at + np.array([0.1, -0.2, 0.6])
    length = np.linalg.norm(pose(true, q).position - anchor, axis=1) + SIGMA * rng.normal(size=n)
    data = Measurements.from_arrays(q, anchor=["a"] * n, distance=length, sigma_distance=SIGMA)
    return robot, true, anchor, Table(data, "anchor")


def error_of(found, true):
    """Squared error of the arm over its covariance, as a probability."""
    names = [p.name for p in found.robot.parameters if p.estimated]
    places = [found.robot.index(name) for name in names]
    e = found.robot.nominal[places] - true.nominal[places]
    return chi2.cdf(e @ np.linalg.solve(found.covariance(names), e), len(names))


def sides(problem, parameters, normals):
    """Sign of each normal along the true one; every unknown has three coordinates."""
    unknowns, at = problem.data.unknowns, problem.variables.at(parameters).coordinates.reshape(-1, 3)
    place = dict(zip(zip(unknowns.letters, unknowns.names, strict=True), at, strict=True))
    return [np.sign((place["F", f"p{i}"] - place["C", f"p{i}"]) @ n) for i, n in enumerate(normals)]


@pytest.mark.slow
@pytest.mark.parametrize("reading", [1e-4, 1e-3])
def test_planes_with_readings_below_what_the_arm_is_off_by_get_their_normals_right(reading):
    """Some are wrong after the descent from nominal; chi-square and the arm's error within 99.9 %."""
    wrong = 0
    for seed in range(3):
        robot, true, normals, table = on_planes(np.random.default_rng(seed), reading)
        first = solve(build_problem(robot, table))
        wrong += sides(first.problem, first.parameters, normals).count(-1.0)
        found = calibrate(robot, table)
        assert not found.findings
        assert sides(found.solution.problem, found.solution.parameters, normals) == [1.0] * 3
        assert chi2.cdf(found.uncertainty.chi2, found.uncertainty.dof) < 0.999
        assert error_of(found, true) < 0.999
        before = residual_table(found.solution).before
        assert 1e-4 < np.sqrt(np.mean(before**2)) < 5e-3  # what the nominal arm is off by, planes fitted
    assert wrong > 0


def test_planes_whose_side_nothing_tells_stay_as_they_were_started():
    robot, _, _, table = on_planes(np.random.default_rng(3), 0.0)
    solution = solve(build_problem(robot, table))
    assert not list(mirror_images(solution))
    again = multistart(solution)
    assert again.parameters == pytest.approx(solution.parameters, abs=0.0)
    assert not again.others


@pytest.mark.slow
@pytest.mark.parametrize("height", [5e-4, 2e-3])
def test_an_anchor_above_a_nearly_flat_patch_is_on_its_side(height):
    """The descent from nominal ends on the wrong side for seed 8."""
    wrong = 0
    for seed in (0, 8):
        robot, true, anchor, table = around_an_anchor(np.random.default_rng(seed), height)
        first = solve(build_problem(robot, table))
        place = first.problem.variables.coordinates[:3]
        wrong += np.linalg.norm(first.parameters[place] - anchor) > 0.5
        found = calibrate(robot, table)
        assert not found.findings
        (point,) = [p for p in found.uncertainty.points if p.kind == "anchor"]
        assert np.linalg.norm(point.xyz - anchor) < 0.05
        assert error_of(found, true) < 0.999
    assert wrong > 0
