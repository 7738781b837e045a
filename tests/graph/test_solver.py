"""The solver: recovery from far away, few steps whatever the unit of length, and a status that tells the truth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from oracle import random_robot
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from simulated import TOOL, measure, paper_robot, small_arm, true_robot
from sparing import diagonal
from touches import TOLERANCE as TOUCH_TOLERANCE
from touches import TOOL_POINT, corners, touch

from fg_calib import InputError, Noise, Pairing, Robot, SolverError, SolverOptions, Table, assess, read_robot, solve
from fg_calib.graph import build_problem, solver
from fg_calib.io import read_measurements
from fg_calib.robot import pose, rotation_angle

TOLERANCE = {"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3}
FRAME = (Rotation.from_rotvec(np.pi * np.array([0.0, 0.6, 0.8])), np.array([7.0, -30.0, 2.0]))
MAX_STEPS = 15


@pytest.mark.parametrize("model", ["pose", "position", "distance", "distance-rotation"])
@pytest.mark.parametrize("prior", [True, False])
def test_the_calibrated_arm_predicts_what_it_was_not_fitted_to(model, prior):
    rng, robot = np.random.default_rng(0), paper_robot(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    m = measure(true, 100, rng, frame=FRAME, sigma=(1e-4, 2e-5))
    solution = solve(build_problem(robot, m, model=model, frame="unknown", prior=prior, pairing=Pairing("random", 300)))
    assert solution.converged, solution.message
    q = rng.uniform(-np.pi, np.pi, (2, 200, 7))

    def distances(r):
        return np.linalg.norm(pose(r, q[0]).position - pose(r, q[1]).position, axis=1)

    before, after = (np.sqrt(np.mean((distances(r) - distances(true)) ** 2)) for r in (robot, solution.robot))
    assert after < 1e-3 < 5e-3 < before


AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]]


@pytest.mark.parametrize(("model", "axis"), diagonal(["pose", "position", "orientation"], AXES, every=3))
def test_a_frame_metres_away_and_rotated_by_180_degrees_converges(model, axis):
    rng, robot = np.random.default_rng(2), small_arm(estimate=TOOL if model == "pose" else [])
    frame = (Rotation.from_rotvec(np.pi * np.array(axis, dtype=float)), np.array([25.0, -8.0, 3.0]))
    problem = build_problem(robot, measure(true_robot(robot, rng), 60, rng, frame=frame), model=model, frame="unknown")
    solution = solve(problem)
    assert solution.converged, solution.message
    dof = problem.n_residuals - problem.variables.n_columns
    assert 2 * solution.cost / dof == pytest.approx(1.0, abs=5 * np.sqrt(2 / dof))


def test_what_nothing_determines_stays_at_nominal():
    rng, robot = np.random.default_rng(3), paper_robot()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 60, rng), model="distance-rotation"))
    assert solution.converged
    off = dict(zip([p.name for p in robot.parameters], solution.robot.nominal - robot.nominal, strict=True))
    for name in ("a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"):
        assert off[name] == pytest.approx(0.0, abs=1e-5), name
    assert off["d3"] == pytest.approx(off["d5"], abs=1e-4)  # of d3 + d4 + d5 the minimum-norm step gives each a third


def test_before_is_the_nominal_arm_with_frame_and_tool_fitted():
    rng, robot = np.random.default_rng(4), small_arm(estimate=TOOL)
    m = measure(true_robot(robot, rng), 40, rng, frame=FRAME)
    solution = solve(build_problem(robot, m, model="pose", frame="unknown"))
    joints = [i for i, p in enumerate(robot.parameters) if 1 <= p.owner <= 4]
    assert np.array_equal(solution.before[joints], robot.nominal[joints])
    assert solution.before[-6:-3] == pytest.approx(FRAME[1], abs=0.05)
    assert solution.initial_cost == pytest.approx(solution.problem.linearize(solution.before).cost, rel=1e-9)
    fixed = solve(build_problem(robot.with_estimated(TOOL), m, model="pose", frame="unknown"))
    assert fixed.parameters == pytest.approx(solution.before, abs=1e-6)


def test_history_tells_cost_damping_and_step():
    rng, robot = np.random.default_rng(5), small_arm()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 40, rng), model="pose"))
    assert all(b.cost <= a.cost * (1 + 1e-9) for a, b in pairwise(solution.history))
    assert solution.history[-1].decrement < 0.1 < solution.history[0].decrement
    assert solution.history[0].step > 1
    assert all(i.damping == 0.0 for i in solution.history)  # no step had to be damped
    assert solution.cost == pytest.approx(solution.problem.linearize(solution.parameters).cost, rel=1e-9)


@pytest.mark.parametrize("damping", [1e-6, 1.0])
def test_a_damped_step_is_marquardts_in_the_singular_directions(damping):
    rng, robot = np.random.default_rng(5), small_arm()
    problem = build_problem(robot, measure(true_robot(robot, rng), 40, rng), model="distance")
    here = solver._Point(problem, problem.start)
    there, used, following = here._descend_damped(damping)
    assert (used, following) == pytest.approx((damping, damping / solver.DAMPING_FACTOR))
    w, y = here.system.weights, here.system.coordinates
    step = here.system.full_root @ (w * w * y / (w * w + damping))
    assert there.parameters == pytest.approx(here.after(step).parameters, abs=1e-12)
    assert there.system.cost < here.system.cost


def test_where_no_step_lowers_the_cost_the_solver_gives_up_and_says_so(monkeypatch):
    monkeypatch.setattr(solver._Point, "descend", lambda *_: None)
    rng, robot = np.random.default_rng(5), small_arm()
    solution = solve(build_problem(robot, measure(true_robot(robot, rng), 40, rng), model="pose"))
    assert (solution.converged, solution.iterations) == (False, 0)
    assert solution.message.startswith("not converged: no step lowers the cost although ")


def test_too_few_iterations_are_said_to_be_too_few():
    rng, robot = np.random.default_rng(6), paper_robot(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng, sigma_joint=1e-3)
    problem = build_problem(robot, m, model="pose", loss="huber", max_iterations=2)
    few = solve(problem)
    assert not few.converged
    assert few.message.startswith("not converged: 2 iterations, ")
    needed = solve(problem, SolverOptions()).iterations
    nearly = solve(problem, SolverOptions(max_iterations=needed - 1))
    assert nearly.converged  # less than 1e-3 sigma is left, and said
    assert nearly.message.startswith("converged: ")
    assert nearly.message.endswith(f" sigma from the optimum after {needed - 1} iterations, the most allowed")
    with pytest.raises(InputError, match=r"max_iterations: found 0, expected a whole number not below 1"):
        build_problem(robot, m, model="pose", max_iterations=0)


def test_numbers_that_no_arm_can_have_are_an_error_and_no_result():
    robot = small_arm()
    m = replace(measure(robot, 20, np.random.default_rng(7)), position=np.full((20, 3), 1e200))
    with pytest.raises(SolverError, match="absurd numbers"):
        solve(build_problem(robot, m, model="position"))


def test_where_rounding_hides_the_optimum_nothing_has_converged():
    """Prior sigmas of 1e9 m with noise of a tenth of a millimetre: no number of 64 bits holds both."""
    robot = small_arm(tolerance={"a": 2e-3, "d": 1e9, "alpha": 2e-3, "theta": 2e-3})
    m = measure(small_arm({"a": 2e-3}), 20, np.random.default_rng(0), sigma=(1e-4, 1e-4))
    solution = solve(build_problem(robot, m, model="position"))
    assert not solution.converged
    assert solution.message.startswith("not converged: rounding hides the optimum, by ")


# --- few steps --------------------------------------------------------------------------------------------------------


def arm(unit, tolerance=None):
    """A random arm with one sliding joint, its lengths times `unit`; `tolerance` in [m] and [rad] at unit 1."""
    shape, kinds = random_robot("mdh", 4, np.random.default_rng(2)), ("a", "alpha", "d", "theta")
    values = {p.name: p.nominal * (unit if p.unit == "m" else 1.0) for p in shape.parameters}
    rows = [[values[f"{kind}{i + 1}"] for kind in kinds] for i in range(4)]
    scaled = {kind: tolerance * (unit if kind in "ad" else 1.0) for kind in kinds} if tolerance else None
    tool, types = [0.1 * unit, 0, 0.2 * unit, 0.3, 0.4, 0], ["prismatic" if i == 2 else "revolute" for i in range(4)]
    return Robot.from_dh(rows, "mdh", types=types, tool=tool, tolerance=scaled)


def measured(robot, unit, n, rng, *, error, sigma_joint):
    """Poses of the arm with errors of `error` [rad] and `error * unit` [m]; noise of 1 mm at unit 1, and 0.2 mrad."""
    size = np.array([error * (unit if p.unit == "m" else 1.0) * p.estimated for p in robot.parameters])
    true = robot.with_values(robot.nominal + size * rng.normal(size=len(size)))
    slide = np.array([unit if joint.prismatic else 1.0 for joint in robot.joints])
    q = slide * rng.uniform(-np.pi, np.pi, (n, robot.n_joints))
    return replace(measure(true, n, rng, sigma=(1e-3 * unit, 2e-4), readings=q), sigma_joint=sigma_joint * slide)


@pytest.mark.parametrize(("model", "gauge"), [("position", "prior"), ("distance-rotation", "none")])
def test_the_unit_of_length_changes_nothing(model, gauge):
    """The same arm a thousand times smaller and larger."""
    found = []
    for unit in (1.0, 1e-3, 1e3):
        robot = arm(unit, tolerance=1e-3 if gauge == "prior" else None)
        m = measured(robot, unit, 40, np.random.default_rng(1), error=0.02, sigma_joint=5e-4)
        solution = solve(build_problem(robot, m, model=model, gauge=gauge))
        assert solution.converged, solution.message
        units = np.where([p.unit == "m" for p in robot.parameters], unit, 1.0)
        found.append((solution.iterations, solution.cost, solution.robot.nominal / units))
    for iterations, cost, values in found[1:]:
        assert iterations == found[0][0] <= MAX_STEPS
        assert cost == pytest.approx(found[0][1], rel=1e-9)
        assert values == pytest.approx(found[0][2], rel=0, abs=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["distance", "pose"])
def test_sixty_real_poses_without_priors_arrive_in_few_steps(model, data_folder):
    """Distances see wrist offsets in a curved valley: undamped steps leave it and come back, damped ones take 41."""
    robot = read_robot(data_folder / "ur10_tmac" / "robot.yaml")
    noise = Noise(position=3e-4, orientation=6e-4)
    m = read_measurements(data_folder / "ur10_tmac" / "series_b.csv", robot, noise=noise)
    m = replace(m, test=m.test | (np.cumsum(~m.test) > 60))
    solution = solve(build_problem(robot, m, model=model, frame="unknown", gauge="none"))
    assert solution.converged, solution.message
    assert solution.iterations <= MAX_STEPS + 1  # one more round: near 0 and 180 degrees rows change with the estimate


def test_contacts_and_positions_that_share_joint_noise_arrive_with_a_robust_loss():
    """Derivatives of contacts leave out a rotation: the cost of rows whitened once may rise by some 1e-6."""
    rng, robot = np.random.default_rng(0), small_arm(tolerance=TOUCH_TOLERANCE, estimate=TOOL_POINT)
    true, sigma_joint = true_robot(robot, rng), 3e-4
    touches = touch(true, corners(true, 6, rng), 8, rng, sigma_joint=sigma_joint)
    positions = measure(true, 24, rng, sigma=(2e-4, 1e-3), sigma_joint=sigma_joint)
    solution = solve(build_problem(robot, [Table(touches, "distance"), Table(positions, "position")], loss="huber"))
    assert solution.message == "converged: less than 3e-07 sigma from the optimum"
    assert solution.iterations < 50


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 11])
def test_angles_about_180_degrees_converge(seed):
    """The least cost of a row measured beyond it is where angles are not differentiable."""
    robot, sigma = small_arm(tolerance=dict.fromkeys(("a", "d", "alpha", "theta"), 0.01)), 7e-3
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (20000, robot.n_joints))
    R = pose(robot, q).rotation
    off = np.pi - rotation_angle(np.swapaxes(R[:1], 1, 2) @ R)[0]
    q = q[np.concatenate([[0], np.flatnonzero(off < 3.0 * np.sqrt(2.0) * sigma)[:40]])]
    rng = np.random.default_rng(seed)
    m = measure(true_robot(robot, rng), len(q), rng, sigma=(1e-3, sigma), readings=q)
    solution = solve(build_problem(robot, m, model="rotation"))
    assert solution.converged, solution.message
    assert solution.iterations <= 80
    if seed == 11:  # its least cost, which a start from the truth finds, is beyond what noise makes too
        assert assess(solution).verdict.errors
    else:
        assert 2.0 * solution.cost < chi2.ppf(0.999, 40)
