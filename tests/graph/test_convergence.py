"""The solver arrives: in few steps, whatever the unit of length, and at the optimum of the rows whitened there."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import random_robot
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from simulated import measure, paper_robot, small_arm, true_robot
from sparing import diagonal
from touches import TOLERANCE as TOUCH_TOLERANCE
from touches import TOOL_POINT, corners, touch

from fg_calib import assess
from fg_calib.baseline.least_squares import fit_least_squares
from fg_calib.graph.build import build_problem
from fg_calib.graph.problem import relinearized_at
from fg_calib.graph.solver import SolverOptions, solve
from fg_calib.inputs import Pairing
from fg_calib.io.robot_file import read_robot
from fg_calib.io.tables import read_measurements
from fg_calib.measurements.dataset import Noise
from fg_calib.measurements.table import Table
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Axis, Element, Joint, RobotBuilder
from fg_calib.robot.rotations import rotation_angle
from fg_calib.statistics.covariance import spread_of

MOST = 15
"""Steps within which everything here arrives; scipy takes as many."""


def arm(unit, *, convention="mdh", n=4, seed=2, tolerance=None):
    """A random arm with one sliding joint, its lengths times `unit`; `tolerance` in [m] and [rad] at unit 1."""
    builder, shape = RobotBuilder("arm", convention), random_robot(convention, n, np.random.default_rng(seed))
    builder.add_frame("base", {}, 0, False)
    for i, joint in enumerate(shape.joints):
        own = [p for p in shape.parameters if p.owner == i + 1]
        values = {p.kind: p.nominal * (unit if p.unit == "m" else 1.0) for p in own}
        builder.add_convention_joint(Joint(joint.name, prismatic=i == 2), values)
    builder.add_frame("tool", {"x": 0.1 * unit, "z": 0.2 * unit, "roll": 0.3, "pitch": 0.4}, n + 1, False)
    kinds = {p.kind: p.unit for p in shape.parameters if 1 <= p.owner <= n}
    scaled = {kind: tolerance * (unit if u == "m" else 1.0) for kind, u in kinds.items()} if tolerance else None
    return builder.build(tolerance=scaled)


def measured(robot, unit, n, rng, *, error=1e-3, sigma=1.0, sigma_joint=0.0):
    """Poses of the arm with errors of `error` [rad] and `error * unit` [m]; noise of 1 mm at unit 1, and 0.2 mrad."""
    size = np.array([error * (unit if p.unit == "m" else 1.0) * p.estimated for p in robot.parameters])
    true = robot.with_values(robot.nominal + size * rng.normal(size=len(size)))
    slide = np.array([unit if joint.prismatic else 1.0 for joint in robot.joints])
    q = slide * rng.uniform(-np.pi, np.pi, (n, robot.n_joints))
    m = measure(true, n, rng, sigma=(sigma * 1e-3 * unit, sigma * 2e-4), readings=q)
    return replace(m, sigma_joint=sigma_joint * slide)


FITS = [("pose", "unknown"), ("position", "unknown"), ("distance", "known"), ("distance-rotation", "known")]
SETTINGS = diagonal(FITS, ["prior", "none"], [5e-4, 0.0], every=4)


@pytest.mark.slow
@pytest.mark.parametrize(("fit", "gauge", "sigma_joint"), SETTINGS)
def test_the_unit_of_length_changes_nothing(fit, gauge, sigma_joint):
    """The same arm a thousand times smaller, a hundred (a crane) and a thousand times larger."""
    model, frame = fit
    found = []
    for unit in (1.0, 1e-3, 1e2, 1e3):
        robot = arm(unit, tolerance=1e-3 if gauge == "prior" else None)
        m = measured(robot, unit, 40, np.random.default_rng(1), error=0.02, sigma_joint=sigma_joint)
        solution = solve(build_problem(robot, m, model=model, frame=frame, gauge=gauge))
        assert solution.converged, solution.message
        lengths = [p.unit == "m" for p in robot.parameters]
        units = np.where(np.array([*lengths, True, True, True, False, False, False]), unit, 1.0)
        found.append((solution.iterations, solution.cost, solution.parameters / units))
    robot = arm(1.0)
    m = measured(robot, 1.0, 40, np.random.default_rng(1))
    sigma = assess(solve(build_problem(robot, m, model=model, frame=frame, gauge="keep"))).covariance
    least = np.sqrt(np.nanmin(np.diag(sigma)))  # of the best known parameter, [m] or [rad]
    for iterations, cost, parameters in found[1:]:
        assert iterations == found[0][0] <= MOST
        assert cost == pytest.approx(found[0][1], rel=1e-9)  # rounding of the rows themselves
        assert parameters == pytest.approx(found[0][2], rel=0, abs=1e-5 * least)


CASES = {
    "poses": ({"model": "pose", "frame": "unknown"}, 0.0),
    "poses, joint noise": ({"model": "pose"}, 5e-4),
    "positions, joint noise": ({"model": "position", "frame": "unknown"}, 1e-3),
    "star, joint noise": ({"model": "distance-rotation"}, 1e-4),
    "all pairs": ({"model": "distance-rotation", "pairing": Pairing("all")}, 0.0),
    "all pairs, joint noise": ({"model": "distance-rotation", "pairing": Pairing("all")}, 1e-3),
    "chain, as if independent": (
        {"model": "distance", "pairing": Pairing("chain"), "pair_errors": "independent"},
        1e-3,
    ),
    "estimated joint values": ({"model": "pose", "encoder": "estimated"}, 1e-3),
    "estimated joint values of pairs": ({"model": "distance-rotation", "encoder": "estimated"}, 1e-3),
    **{f"loss {loss}": ({"model": "pose", "loss": loss}, 2e-4) for loss in ("huber", "cauchy", "geman-mcclure", "gnc")},
}


DRAWS = [(gauge, draws) for gauge in ("prior", "none") for draws in (range(1), range(1, 6))]
"""The first draw, with priors, is in the default run."""


@pytest.mark.slow
@pytest.mark.parametrize(("gauge", "draws"), DRAWS)
@pytest.mark.parametrize("name", CASES)
def test_solving_again_from_the_answer_moves_nothing(name, gauge, draws):
    """Rows whitened at the answer have their optimum there: within 1e-6 sigma in any direction."""
    options, sigma_joint = CASES[name]
    robot = paper_robot(tolerance={"a": 5.8e-3, "d": 5.8e-3, "alpha": 5e-4, "theta": 5e-4, "beta": 5e-4})
    for seed in draws[: 0 if draws[0] and "pairs" in name else 5 if "loss" in name else 2]:
        rng = np.random.default_rng(seed)
        m = measure(true_robot(robot, rng), 40, rng, sigma=(1e-3, 1.7e-4), sigma_joint=sigma_joint)
        solution = solve(build_problem(robot, m, gauge=gauge, **options))
        assert solution.converged, solution.message
        if options.get("loss", "none") == "none":
            assert solution.iterations <= MOST
        again = solve(relinearized_at(solution.problem, solution.parameters))
        assert again.converged, again.message
        spread, scales = spread_of(solution), solution.problem.variables.prior_scales
        variables = solution.problem.variables
        step = variables.step(solution.parameters, again.parameters)[: variables.n_columns]
        variance, direction = np.linalg.eigh(spread.tangent / np.outer(scales, scales))
        known = variance > 1e-12 * variance.max()  # of the others nothing is known
        assert np.linalg.norm((direction.T @ (step / scales))[known] / np.sqrt(variance[known])) < 1e-6


@pytest.mark.sampled(1)
@pytest.mark.parametrize("shift", [[0, 0, 0], [70, -30, 20]])
def test_the_last_step_is_taken_although_the_cost_no_longer_shows_it(shift):
    """Plain least squares, which asks no cost, is as near as rounding of metres over sigmas lets it be."""
    turn = Rotation.from_euler("ZYX", [0.4, np.pi / 2, 0.2])
    for seed in range(3, 7):
        robot, rng = small_arm(), np.random.default_rng(seed)
        m = measure(true_robot(robot, rng), 60, rng, sigma=(1e-4, 1e-4), frame=(turn, np.array(shift, float)))
        problem = build_problem(robot, m, model="position", frame="unknown", gauge="keep")
        solution = solve(problem)
        names = [p.name for p in problem.estimated]
        plain = fit_least_squares(robot, problem.data, names=names, start=problem.start)
        sigma = np.sqrt(np.diag(spread_of(solution).named()))
        apart = (plain.robot.nominal - solution.parameters[:-6])[[robot.index(name) for name in names]] / sigma
        assert np.abs(apart).max() < 3e-7  # 1e-5 when the cost had the last word


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["dh", "mdh", "mdh-hayati", "dh-hayati"])
@pytest.mark.parametrize("tolerance", [None, 1e-3, 0.05])
def test_random_arms_arrive_in_few_steps(convention, tolerance):
    """Errors of 30 mm and 30 mrad, few configurations and many, with and without priors and joint noise."""
    for seed in range(4):
        for model in ("pose", "position", "distance", "distance-rotation"):
            robot = arm(1.0, convention=convention, n=3 + 3 * (seed % 2), seed=seed, tolerance=tolerance)
            rng, joint = np.random.default_rng(seed), 5e-4 * (seed > 1)
            n = 40 if seed > 1 or tolerance is None else 16
            m = measured(robot, 1.0, n, rng, error=0.03, sigma_joint=joint)
            gauge = "prior" if tolerance else "none"
            problem = build_problem(robot, m, model=model, frame="unknown" if seed > 1 else "known", gauge=gauge)
            solution = solve(problem)
            assert solution.converged, solution.message
            assert solution.iterations <= MOST


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["pose", "distance-rotation", "distance"])
def test_sixty_real_poses_without_priors_arrive_in_few_steps(model, data_folder):
    """Distances see wrist offsets in a curved valley: undamped steps leave it and come back, damped ones take 41."""
    robot = read_robot(data_folder / "ur10_tmac" / "robot.yaml")
    noise = Noise(position=3e-4, orientation=6e-4)
    m = read_measurements(data_folder / "ur10_tmac" / "series_b.csv", robot, noise=noise)
    sixty = np.cumsum(~m.test) <= 60
    m = replace(m, test=m.test | ~sixty)
    solution = solve(build_problem(robot, m, model=model, frame="unknown", gauge="none"))
    assert solution.converged, solution.message
    assert solution.iterations <= MOST + 1  # one more round: near their kinks rows change with the estimate


@pytest.mark.slow
@pytest.mark.parametrize(("allowed", "code"), [(1, 3), (50, 0)])
def test_the_job_says_how_many_iterations(fg_calib, example, allowed, code):
    job = example / "calibration.yaml"
    job.write_text(job.read_text() + f"\nmax_iterations: {allowed}\n")
    for command in ("calibrate", "compare"):
        run = fg_calib(command, job)
        assert run.code == code
        assert ("not converged: 1 iterations" in " ".join(run.out.split())) == (allowed == 1)


def test_no_iterations_are_too_few(fg_calib, example):
    job = example / "calibration.yaml"
    job.write_text(job.read_text() + "\nmax_iterations: 0\n")
    run = fg_calib("calibrate", job)
    assert (run.code, run.out) == (1, "")
    assert run.err == "error: calibration.yaml: max_iterations: found 0, expected a number above 0\n"


@pytest.mark.slow
def test_the_limit_holds_for_all_rounds_together():
    """Rows weighted anew again and again: with one step fewer than it takes it has not arrived, and says so."""
    robot = paper_robot(tolerance={"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    rng = np.random.default_rng(6)
    m = measure(true_robot(robot, rng), 30, rng, sigma_joint=1e-3)
    problem = build_problem(robot, m, model="pose", loss="huber")
    needed = solve(problem).iterations
    assert solve(problem, SolverOptions(max_iterations=needed)).converged
    few = solve(problem, SolverOptions(max_iterations=2))
    assert not few.converged
    assert few.message.startswith("not converged: 2 iterations, ")
    nearly = solve(problem, SolverOptions(max_iterations=needed - 1))
    assert nearly.converged  # less than 1e-3 sigma is left, and said
    assert nearly.message.startswith(f"converged: {needed - 1} iterations, ")


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "seed"), diagonal(["huber", "cauchy"], [0, 7]))
def test_touches_and_positions_that_share_joint_noise_arrive_with_robust_losses(loss, seed):
    """Derivatives of touches leave out a turn that moves no length, but acts on noise that is not the same all round.

    So the cost of rows whitened once may rise, by some 1e-6, on the way to the optimum of those whitened there.
    """
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=TOUCH_TOLERANCE, estimate=TOOL_POINT)
    true, sigma_joint = true_robot(robot, rng), 3e-4
    touches = touch(true, corners(true, 6, rng), 8, rng)
    noise = sigma_joint * rng.normal(size=touches.readings.shape)
    touches = replace(touches, readings=touches.readings + noise, sigma_joint=np.full(4, sigma_joint))
    positions = measure(true, 24, rng, sigma=(2e-4, 1e-3), sigma_joint=sigma_joint)
    problem = build_problem(robot, [Table(touches, "distance"), Table(positions, "position")], loss=loss)
    solution = solve(problem)
    assert solution.message == "converged: less than 3e-07 sigma from the optimum"
    assert solution.iterations < 50


@pytest.mark.slow
def test_angles_about_half_a_turn_converge():
    """Rows measured beyond it, but for the fold, have their least cost at the kink: there they are whitened anew."""
    robot, sigma = small_arm(tolerance={"a": 0.01, "d": 0.01, "alpha": 0.01, "theta": 0.01}), 7e-3
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (20000, robot.n_joints))
    R = pose(robot, q).rotation
    off = np.pi - rotation_angle(np.swapaxes(R[:1], 1, 2) @ R)[0]
    q = q[np.concatenate([[0], np.flatnonzero(off < 3.0 * np.sqrt(2.0) * sigma)[:40]])]
    for seed in (2, 11, 38):
        rng = np.random.default_rng(seed)
        m = measure(true_robot(robot, rng), len(q), rng, sigma=(1e-3, sigma), readings=q)
        solution = solve(build_problem(robot, m, model="rotation"))
        assert solution.converged, solution.message
        assert solution.iterations <= 80
        if seed == 11:  # its least cost, which a start from the truth finds, is beyond what noise makes too
            assert assess(solution).verdict.errors
        else:
            assert 2.0 * solution.cost < chi2.ppf(0.999, 40)


def test_a_parameter_of_two_elements_is_calibrated_with_both():
    """Twists add up: one length along two axes, whose derivative is that of both."""
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3})
    shared = robot.index("a2")
    again = Element(Axis.TY, parameter=shared)
    place = next(i for i, e in enumerate(robot.elements) if e.joint == 2)
    robot = replace(robot, elements=(*robot.elements[:place], again, *robot.elements[place:]))
    true = true_robot(robot, rng)
    found = assess(solve(build_problem(robot, measure(true, 60, rng, sigma=(1e-5, 1e-5)), model="pose")))
    columns = [robot.index(name) for name in found.names]
    error = (found.robot.nominal - true.nominal)[columns]
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.9999, len(error))
    assert found.covariance[columns.index(shared), columns.index(shared)] < 1e-10
