"""A second optimum is looked for where measurements see a combination only curved, and told of."""

from dataclasses import replace

import numpy as np
import pytest
from jobs import ur5e
from scipy.stats import chi2
from simulated import measure, paper_robot, small_arm, true_robot

from fg_calib.diagnostics.multistart import _steps, multistart
from fg_calib.errors import SolverError
from fg_calib.graph import solver
from fg_calib.graph.build import build_problem, problem_of
from fg_calib.graph.solver import solve
from fg_calib.io.job import read_job
from fg_calib.io.robot_file import read_robot
from fg_calib.measurements.dataset import Measurements, rotation_angle
from fg_calib.options import Pairing
from fg_calib.robot.inverse import solve_inverse
from fg_calib.robot.kinematics import pose
from fg_calib.statistics.assessment import assess
from fg_calib.statistics.variance_components import solve_job

ROBOT = """\
name: pointer
convention: dh
joints:
  - {{a: 0.1, alpha: 1.5707963267948966, d: 0, theta: 0}}
  - {{a: 0, alpha: 0, d: {d}, theta: 0}}
fixed: [a1, alpha1, d1, theta1, a2, alpha2, theta2]
tolerance: {{d2: {tolerance}}}
"""
JOB = """\
robot: robot.yaml
measurements: poses.csv
model: distance
pairing: chain
noise: {position: 1.0e-5}
gauge: prior
"""


def pointer(folder, *, nominal, true, tolerance=0.02, job=JOB, n=40, seed=0):
    """A pointer, 100 mm long, its tip `true` aside: distances see its radius, so the square of that."""
    text = ROBOT.format(d=nominal, tolerance=tolerance)
    (folder / "robot.yaml").write_text(text)
    robot = read_robot(folder / "robot.yaml")
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (n, 2))
    values = robot.nominal
    values[robot.index("d2")] = true
    position = pose(robot.with_values(values), q).position
    position = position + 1e-5 * rng.normal(size=position.shape)
    rows = [",".join(f"{v:.12g}" for v in (*angle, *p)) for angle, p in zip(q, position, strict=True)]
    (folder / "poses.csv").write_text("\n".join(["q1,q2,x,y,z", *rows]) + "\n")
    (folder / "job.yaml").write_text(job)
    return folder / "job.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_two_mirrored_optima_are_told_of_and_not_called_good(fg_calib, tmp_path, side):
    """20 mm aside with a tolerance of 20 mm, and 1 mm at nominal: chi-square differs by 0.2."""
    path = pointer(tmp_path, nominal=1e-3, true=side * 0.02)
    run = fg_calib("calibrate", path)
    assert run.code == 3
    text = " ".join(run.out.split())
    assert "a second optimum that the data cannot tell from this one: d2 +19" in text
    assert "or -21" in text
    solution = solve_job(read_job(path))
    i = solution.problem.robot.index("d2")
    assert solution.parameters[i] == pytest.approx(0.02, abs=1e-4)  # the one nearer to nominal, by its prior
    assert [other[i] for other in solution.others] == pytest.approx([-0.02], abs=1e-4)


def test_the_best_of_two_optima_is_kept(tmp_path):
    """One start ends 21 tolerances from nominal, where the mirror image is 19 away."""
    problem = problem_of(read_job(pointer(tmp_path, nominal=1e-3, true=0.02, tolerance=1e-3)))
    i = problem.robot.index("d2")
    far = solver.solve(problem)
    wrong = solver.solve_from(far, np.where(np.arange(len(problem.start)) == i, -0.02, far.parameters), np.inf)
    assert wrong.parameters[i] < 0.0
    best = multistart(wrong)
    assert best.cost < wrong.cost - 5.0
    assert best.parameters[i] == pytest.approx(far.parameters[i], abs=1e-9)
    assert best.others == ()  # chi-square decides: the other is 80 worse


@pytest.mark.slow
def test_a_start_between_two_optima_is_left(tmp_path):
    """At nominal 0 the derivative is 0: the descent stays there, with a chi-square of tens of thousands."""
    problem = problem_of(job := read_job(pointer(tmp_path, nominal=0.0, true=0.02)))
    assert solver.solve(problem).cost > 1e4
    solution = solve_job(job)
    i = problem.robot.index("d2")
    assert abs(solution.parameters[i]) == pytest.approx(0.02, abs=1e-4)
    assert len(solution.others) == 1
    second = "a second optimum that the data cannot tell from this one: d2"
    assert any(finding.startswith(second) for finding in assess(solution).findings)


def test_what_data_see_has_one_optimum_and_costs_nothing_more(tmp_path, monkeypatch):
    """Positions see which side the tip is on: nothing is weak, nothing is solved again."""
    path = pointer(tmp_path, nominal=1e-3, true=0.02, job=JOB.replace("distance", "position"))

    def never(*_):
        raise AssertionError("solved again although nothing is weak")

    monkeypatch.setattr("fg_calib.diagnostics.multistart.solve_from", never)
    solution = solve_job(read_job(path))
    assert solution.others == ()
    assert assess(solution).trustworthy


def test_a_descent_from_elsewhere_that_cannot_be_made_is_no_fault_of_the_first(tmp_path, monkeypatch):
    """Elsewhere a step may have no solution at all, or noise be lost in rounding."""

    def fail(*_):
        raise SolverError("the linear system has no unique solution near J1")

    first = solver.solve(problem_of(read_job(pointer(tmp_path, nominal=1e-3, true=0.02))))
    for name in ("solve_from", "_without_folds"):
        monkeypatch.setattr(f"fg_calib.diagnostics.multistart.{name}", fail)
    found = multistart(first)
    assert found.parameters is first.parameters
    assert found.others == ()


@pytest.mark.parametrize(("off", "told"), [(0.5, 1), (1.5, 0), (2.0 * np.pi, 0)])
def test_an_optimum_a_radian_away_is_no_other_arm(tmp_path, monkeypatch, off, told):
    """Angles half a turn or a whole one away are the same arm in other words, or one that nobody built."""
    first = solver.solve(problem_of(read_job(pointer(tmp_path, nominal=1e-3, true=0.02))))
    robot, there = first.problem.robot, first.parameters.copy()
    there[robot.index("d2")] *= -1.0
    there[robot.index("theta2")] += off
    other = replace(first, parameters=there, values=first.problem.variables.values(there))
    monkeypatch.setattr("fg_calib.diagnostics.multistart.solve_from", lambda *_: other)
    assert len(multistart(first).others) == told


@pytest.mark.slow
def test_lost_directions_have_no_second_optimum():
    """Twelve directions of the paper's arm are held by priors alone: other starts along them come back."""
    robot = paper_robot(tolerance={"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    for seed in range(4):
        rng = np.random.default_rng(seed)
        m = measure(true_robot(robot, rng), 40, rng, sigma_joint=1e-4)
        solution = solver.solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing("chain")))
        again = multistart(solution)
        assert again.others == ()
        assert 2.0 * (again.cost - solution.cost) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [158, 855, 1357])
def test_an_angle_that_nominal_has_on_the_other_side_of_half_a_turn_bends_no_arm(seed):
    """It lies 8 of its sigma or more from half a turn, but tolerances of 2 mrad put nominal on the other side."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3})
    true, n, sigma = true_robot(robot, rng), 14, 2e-4
    q, a = rng.uniform(-2, 2, (n, 4)), np.arange(n)
    b = (a + 5) % n
    at = pose(true, q)
    angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma * rng.normal(size=n)
    angle[np.pi - angle < 8 * sigma] = np.nan
    distance = np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma * rng.normal(size=n)
    pairs = {"a": a, "b": b, "distance": distance, "angle": angle, "sigma_distance": sigma, "sigma_angle": sigma}
    first = solve(build_problem(robot, Measurements.from_arrays(q, pairs=pairs), model="distance-rotation"))
    best = multistart(first)
    assert first.cost > 400.0
    assert 2.0 * best.cost < chi2.ppf(0.999, best.problem.n_residuals)
    assert not best.others
    assert best.converged


@pytest.mark.slow
def test_a_tool_point_that_constant_orientation_hardly_shows_is_looked_for_metres_away(tmp_path):
    """Rounding of the turns put its start 1e12 m away, where nothing converged; other starts were 2 mm apart."""
    robot = ur5e(tmp_path, estimate=["tool.x", "tool.y", "tool.z"])
    rng = np.random.default_rng(0)
    places = rng.uniform([0.3, -0.3, 0.1], [0.5, 0.3, 0.4], (100, 3))
    found = solve_inverse(robot, places, np.tile(np.diag([1.0, -1.0, -1.0]), (100, 1, 1)))
    m = measure(true_robot(robot, rng), 60, rng, readings=found.readings[found.reached][:60])
    solution = solve(build_problem(robot, m, model="distance"))
    assert np.abs(solution.problem.start[robot.index("tool.z")]) < 1.0
    assert solution.converged
    assert np.max(np.abs(_steps(solution)[-1])) > 0.1
    assert multistart(solution).cost <= solution.cost
