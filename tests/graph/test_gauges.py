"""Gauges that leave parameters out: what is said of the others, of combinations and of predictions is true."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import central_differences, tool_pose
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm, true_robot

from fg_calib import Measurements, assess, build_problem, solve
from fg_calib.monitoring import knowledge_of
from fg_calib.robot import pose
from fg_calib.statistics import Spread

TOLERANCE = {"a": 1e-3, "d": 2e-3, "alpha": 1e-3, "theta": 1.5e-3, "tool": 2e-3}
TOLERANCE |= {f"tool.{k}": 2e-3 for k in ("roll", "pitch", "yaw")}
HAYATI = TOLERANCE | {"beta": 1e-3}


def assessed(robot, true, rng, model, gauge="keep", n=40, **options):
    measurements = measure(true, n, rng, sigma=(2e-4, 1e-4), frame=options.pop("seen_from", None))
    return assess(solve(build_problem(robot, measurements, model=model, gauge=gauge, **options)))


def test_a_kept_parameter_is_as_uncertain_as_what_it_stands_for():
    """d3, d4 and d5 act by their sum: that of d5 is the estimate's and the tolerances of the two left at nominal."""
    rng = np.random.default_rng(3)
    robot = paper_robot(tolerance=HAYATI | {"d3": 3e-3, "d4": 4e-3})
    found = assessed(robot, true_robot(robot, rng), rng, "distance-rotation")
    by_name = {p.name: p for p in found.estimates.parameters}
    d5 = by_name["d5"]
    assert d5.stands_for == {"d5": 1.0, "d3": 1.0, "d4": 1.0}
    # the axes of the estimated arm are not quite parallel: by some mrad
    assert d5.sigma == pytest.approx(np.sqrt(3e-3**2 + 4e-3**2 + d5.sigma_of_combination**2), rel=2e-5)
    assert d5.sigma_of_combination < 0.05 * d5.sigma
    assert by_name["d3"].sigma == pytest.approx(3e-3, rel=1e-9)
    assert by_name["a1"].sigma == pytest.approx(1e-3, rel=1e-9)  # acts on nothing
    assert by_name["a2"].stands_for is None
    index = found.names.index
    covariance = found.covariance
    assert covariance[index("d5"), index("d4")] == pytest.approx(-(4e-3**2), rel=2e-5)
    ones = np.isin(found.names, ["d3", "d4", "d5"])
    assert ones @ covariance @ ones == pytest.approx(d5.sigma_of_combination**2, rel=1e-3)


def test_what_was_left_out_is_as_uncertain_as_it_was_specified_angles_of_a_tool_too():
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=TOLERANCE, estimate=TOOL)
    prefer = ("theta4", "d4", "tool.x", "tool.y", "tool.z")
    found = assessed(robot, true_robot(robot, rng), rng, "pose", prefer=prefer)
    left_out = [name for name in found.names if name not in found.spread.variables.names]
    assert left_out == ["a3", "a4", "tool.z", "tool.yaw"]
    rows = [found.names.index(name) for name in left_out]
    variance = [robot.parameters[robot.index(name)].tolerance ** 2 for name in left_out]
    assert found.covariance[np.ix_(rows, rows)] == pytest.approx(np.diag(variance), abs=1e-12)


@pytest.mark.parametrize("gauge", ["keep", "none"])
def test_without_a_tolerance_only_what_does_not_depend_on_it_is_known(gauge):
    rng = np.random.default_rng(4)
    robot = paper_robot(tolerance=None if gauge == "none" else {"theta": 1e-3, "beta": 1e-3})
    found = assessed(robot, true_robot(robot, rng), rng, "distance-rotation", gauge)
    by_name = {p.name: p for p in found.estimates.parameters}
    assert [by_name[name].sigma for name in ("d3", "d4", "d5", "a1", "alpha1")] == [None] * 5
    assert (by_name["theta3"].sigma is None) == (gauge == "none")
    assert all(p.sigma is not None for p in found.estimates.parameters if p.identifiability == "independent")

    def sums(r):
        value = dict(zip([p.name for p in r.parameters], r.nominal, strict=True))
        tools = pose(r, [[0.3] * 7, [-0.5] * 7]).position
        return [value["d3"] + value["d4"] + value["d5"], value["d5"], np.linalg.norm(tools[1] - tools[0]), tools[0, 2]]

    sigma = found.predict(sums).sigma
    assert np.isfinite(sigma).tolist() == [True, False, True, False]
    if gauge == "keep":
        assert sigma[0] == pytest.approx(by_name["d5"].sigma_of_combination, rel=1e-2)


def test_a_measurement_frame_is_as_uncertain_as_the_base_that_was_left_out():
    """The first joint's parameters move it along x and z and about them; along y and about it the frame is known."""
    rng = np.random.default_rng(5)
    frame = (Rotation.from_rotvec([0.3, -2.0, 1.0]), np.array([5.0, 1.0, -2.0]))
    for tolerance, known in ((HAYATI, [True] * 6), (None, [False, True, False] * 2)):
        robot = paper_robot(tolerance=tolerance)
        true = true_robot(paper_robot(), rng)
        found = assessed(robot, true, rng, "pose", frame="unknown", seen_from=frame)
        sigma = found.estimates.frames[0].sigma
        assert np.isfinite(sigma).tolist() == known
        if tolerance is not None:
            assert sigma[5] == pytest.approx(2e-3, rel=0.05)  # d1 along the base's z axis, left out


def test_the_derivative_behind_predictions_is_that_in_the_columns():
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=TOLERANCE, estimate=TOOL)
    q = rng.uniform(-2, 2, 4)
    found = assessed(robot, true_robot(robot, rng), rng, "pose", "prior").whole
    assert isinstance(found, Spread)
    v = found.variables

    def at(step):
        return tool_pose(v.robot.with_values(v.moved(found.parameters, step)[v.robot_span]), q)[:3, 3]

    J = found.derivative(lambda r: tool_pose(r, q)[:3, 3])
    # two step widths: their difference is that of third derivatives
    assert J == pytest.approx(central_differences(at, np.zeros(v.n_columns), 1e-4), abs=1e-7)


@pytest.mark.parametrize("loss", ["none", "huber"])
def test_rows_say_the_same_by_the_columns_of_parameters_that_were_left_out(loss):
    rng = np.random.default_rng(0)
    robot = small_arm(dict.fromkeys(("a", "d", "alpha", "theta"), 2e-3))
    q = rng.uniform(-2.0, 2.0, (80, robot.n_joints))
    p = pose(robot, q).position
    distance = np.linalg.norm(p[:40] - p[40:], axis=1) + 1e-4 * rng.normal(size=40)
    distance[0] = 0.0  # one point, reached twice: three rows, of which the loss takes more
    pairs = {"a": np.arange(40), "b": np.arange(40, 80), "distance": distance, "sigma_distance": 1e-4}
    m = Measurements.from_arrays(q, pairs=pairs)
    solution = solve(build_problem(robot, m, model="distance", gauge="keep", loss=loss))
    problem, x = solution.problem, solution.parameters
    wide = problem.whole.variables
    of_all = replace(problem, variables=wide).linearize(x, with_loss=True).left.A
    mine = problem.linearize(x, with_loss=True).left.A
    seen = of_all @ wide.columns_of(problem.variables, x)
    np.testing.assert_allclose(seen.T @ seen, mine.T @ mine, rtol=1e-9, atol=1e-9 * np.abs(mine).max() ** 2)
    assert knowledge_of(solution).n >= problem.variables.n_columns
