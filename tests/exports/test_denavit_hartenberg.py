"""From axes to tables: lines by vector algebra, and axes that are nearly parallel, that meet, that point back."""

import numpy as np
import pytest
from exported import matrix
from scipy.spatial.transform import Rotation

from fg_calib import Robot
from fg_calib.exports import dh
from fg_calib.robot.model import CONVENTIONS

EXACT = 1e-9
TILTS = [0.0, 1e-12, 5e-12, 2e-11, 1e-10, 1e-9, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3]


def lines(M):
    """Distance and angle of the z axes of two frames, by vector algebra."""
    z, p = M[:3, 2], M[:3, 3]
    n = np.cross([0, 0, 1], z)
    return abs(p @ n) / np.linalg.norm(n), np.arctan2(np.linalg.norm(n), z[2])


@pytest.mark.parametrize("seed", range(5))
def test_a_and_alpha_are_distance_and_angle_of_the_axes(seed):
    rng = np.random.default_rng(seed)
    M = matrix(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-1, 1, 3))
    row = dh.common_normal(M)
    distance, angle = lines(M)
    assert abs(row["a"]) == pytest.approx(distance)
    assert abs(row["alpha"]) == pytest.approx(angle)
    assert abs(row["theta"]) <= np.pi / 2 + 1e-9
    rest = dh.left_over(M, row)  # a turn about z and a shift along it
    assert rest[2] == pytest.approx([0, 0, 1, rest[2, 3]], abs=1e-12)
    assert rest[:2, 3] == pytest.approx([0, 0], abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_hayatis_row_ends_on_the_next_axis_within_the_plane_of_the_frame(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3, 3)]).as_matrix()
    M = matrix(R @ np.diag([1, -1, -1]) if seed % 2 else R, rng.uniform(-1, 1, 3))
    row = dh.plane_crossing(M)
    at = dh.transform(**{kind: row.get(kind, 0.0) for kind in CONVENTIONS["dh-hayati"]})
    assert at[2, 3] == 0.0
    assert np.cross(at[:3, 3] - M[:3, 3], M[:3, 2]) == pytest.approx(np.zeros(3), abs=1e-12)
    assert at[:3, 2] == pytest.approx(M[:3, 2], abs=1e-12)


def nearly(tilt, direction, a, turn):
    """Axes 2 and 3 nearly parallel, tilted about an axis at some angle to their distance."""
    rows = [[0.0, 0.0, 0.3, 0.1, 0.0], [a, turn + tilt * np.cos(direction), 0.1, 0.2, tilt * np.sin(direction)]]
    rows += [[0.2, 1.2, 0.3, -0.5, 0.0]]
    return Robot.from_dh(rows, "dh-hayati", tool=[0.1, 0.2, 0.3], base=[0, 0, 0.5, 0.3, 0, 0])


CASES = [(direction, a, turn) for direction in (0.0, np.pi / 2, 1.0) for a in (0.4, 0.0) for turn in (0.0, np.pi)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("convention", ["dh", "mdh", "dh-hayati", "mdh-hayati"])
def test_nearly_parallel_axes_have_the_table_that_is_claimed(convention, tilt):
    """Side by side or on one line, the same way or back: exact, or said to be parallel."""
    said = 0
    for case in CASES:
        robot = nearly(tilt, *case)
        table = dh.in_table(robot, convention)
        q = dh.drawn(robot, 20, 0)
        error = dh.errors(table.robot, robot, q)
        lengths = [abs(p.nominal) for p in table.robot.parameters if p.kind in ("a", "d")]
        assert max(lengths) <= (dh.FARTHEST + 1) * robot.reach
        if table.nearly:
            said += 1
            (one,) = table.nearly
            assert one.axes == (2, 3)
            assert one.angle == pytest.approx(tilt, rel=1e-3, abs=1e-11)
            assert error.rotation_max == pytest.approx(tilt, rel=1e-3, abs=1e-11)
            assert error.position_max <= 2.0 * tilt * robot.reach + EXACT
        else:
            assert max(error.position_max, error.rotation_max) < EXACT, case
    assert (said == 0) == (convention.endswith("hayati") or tilt <= dh.PARALLEL)


@pytest.mark.sampled(8)
@pytest.mark.parametrize("there", CONVENTIONS)
@pytest.mark.parametrize("back", ["dh", "mdh", "dh-hayati", "mdh-hayati"])
def test_there_and_back_is_the_same_arm(there, back):
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (5, 5 if "hayati" in there else 4))
    types = ["revolute", "prismatic", "revolute", "prismatic", "revolute"]
    robot = Robot.from_dh(rows, there, types=types, tool=rng.uniform(-1, 1, 6), base=rng.uniform(-1, 1, 6))
    other = dh.in_table(robot, back).robot
    again = dh.in_table(other, "dh").robot
    q = dh.drawn(robot, 1000, 0)
    for found in (other, again):
        assert found.joints == robot.joints
        error = dh.errors(found, robot, q)
        assert max(error.position_max, error.rotation_max) < EXACT
