"""Plain least squares: Eq. (54) against 4x4 products, agreement with the graph, what it claims, and its messages."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import central_differences, tool_pose
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import measure, measure_drawn, pairs_between, paper_robot, planar_robot, plus, small_arm
from tolerances import NEGLIGIBLE, rounding, sigmas_apart

from fg_calib import InputError, Measurements, Pairing, SolverOptions, Table, assess, build_problem, solve
from fg_calib.baseline import least_squares
from fg_calib.measurements import build_dataset, form_pairs

PAPERS = ["distance", "distance-rotation", "pose"]
TO_THE_END = SolverOptions(decrement=1e-9)
NOISE = 1e-4
"""Of every row unless a test says otherwise, [m] and [rad]."""


def fit_least_squares(robot, measurements, *, model, frame="known", **options):
    """Plain least squares of one table."""
    data = build_dataset(robot, [Table(measurements, model, Pairing("star"), frame)])
    return least_squares.fit_least_squares(robot, data, **options)


def apart(fit, values):
    """How far a fit is from other values of the robot, in its own sigma."""
    return sigmas_apart(fit.robot.nominal, values, [fit.sigma.get(p.name, 0.0) for p in fit.robot.parameters])


def simulated(robot, model, seed=1, *, sigma=NOISE, sigma_joint=0.0, n=80):
    """Measurements whose rows all have one weight, metres and radians alike, the pairs' far from 0 and half a turn."""
    measurements = measure_drawn(robot, n, seed, sigma=(sigma, sigma), sigma_joint=sigma_joint)
    if model in ("pose", "position", "orientation"):
        return measurements
    pairs = form_pairs(measurements, Pairing("random", 150))
    pairs = pairs.select((pairs.distance > 0.05) & (pairs.angle > 0.05) & (pairs.angle < np.pi - 0.05))
    one = np.full(pairs.n_pairs, sigma)
    return replace(measurements, pairs=replace(pairs, sigma_distance=one, sigma_angle=one))


# --- agreement with the graph -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", PAPERS)
def test_with_equal_weights_and_no_priors_all_estimators_agree(model):
    """To a millionth of a sigma: three roads to one optimum."""
    robot = paper_robot()
    measurements = simulated(robot, model)
    problem = build_problem(robot, measurements, model=model, gauge="keep")
    assert not any(problem.n_excluded.values())
    graph = solve(problem, TO_THE_END).parameters[:-6]
    names = [p.name for p in problem.estimated]
    assert len(names) == {"distance": 21, "distance-rotation": 23, "pose": 29}[model]  # the paper's
    assert np.linalg.norm(graph - robot.nominal) > 1e-3
    for weighted in (False, True):
        fit = fit_least_squares(robot, measurements, model=model, names=names, weighted=weighted)
        assert fit.converged, fit.message
        assert fit.n_rows == problem.n_residuals
        assert apart(fit, graph) < NEGLIGIBLE, weighted


SECOND_ORDER = 0.01
"""Sigma by which the mean of a noisy length moves an estimate here: 0.3 mrad of joint noise over 10 m (0.004 found)."""


@pytest.mark.parametrize(("model", "lacking"), [*((model, False) for model in PAPERS[1:]), ("distance-rotation", True)])
def test_weighted_by_joint_noise_it_is_the_graph(model, lacking):
    """With the weights of the same parameters; a row that was not measured does not weigh on the other of its pair."""
    robot = paper_robot()
    measurements = simulated(robot, model, sigma=2e-4, sigma_joint=3e-4)
    if lacking:
        distance, angle = measurements.pairs.distance.copy(), measurements.pairs.angle.copy()
        distance[::3], angle[1::3] = np.nan, np.nan
        measurements = replace(measurements, pairs=replace(measurements.pairs, distance=distance, angle=angle))
    problem = build_problem(robot, measurements, model=model, gauge="keep", pair_errors="independent")
    solution = solve(problem, TO_THE_END)
    names = [p.name for p in problem.estimated]
    fit = fit_least_squares(robot, measurements, model=model, names=names, weighted=True)
    assert fit.converged, fit.message
    assert fit.n_rows == problem.n_residuals
    # The last fit of each set of weights decides. Of pairs plain least squares does not know that noise lengthens them.
    closely = SECOND_ORDER if "distance" in model or model == "rotation" else 0.0
    assert apart(fit, solution.parameters[:-6]) < max(closely, 1e-3)
    covariance = assess(solution).spread.named()  # what was left out counts as known in plain least squares
    closely = max(closely, 1e-6)
    assert fit.covariance == pytest.approx(covariance, rel=closely, abs=closely * np.abs(covariance).max())


@pytest.mark.parametrize("model", ["pose", "position", "orientation"])
def test_an_unknown_frame_is_the_graphs(model):
    robot = small_arm()
    frame = Rotation.from_euler("ZYX", [0.4, 1.2, 0.2]), np.array([7.0, -3.0, 2.0])
    measurements = measure_drawn(robot, 60, seed=3, sigma=(1e-4, 1e-4), frame=frame)
    problem = build_problem(robot, measurements, model=model, frame="unknown", gauge="keep")
    solution = solve(problem, TO_THE_END)
    start = {"start": np.array([*robot.nominal, 6.9, -3.1, 2.05, 0.4, 1.2, 0.25]), "frame": "unknown"}
    fit = fit_least_squares(robot, measurements, model=model, names=[p.name for p in problem.estimated], **start)
    assert fit.converged, fit.message
    assert apart(fit, solution.parameters[:-6]) < NEGLIGIBLE
    rotation, expected = (Rotation.from_euler("ZYX", f.parameters[-3:]) for f in (fit, solution))
    assert (rotation.inv() * expected).magnitude() == pytest.approx(0.0, abs=1e-7)  # arccos near 1
    if model != "orientation":
        assert fit.parameters[-6:-3] == pytest.approx(solution.parameters[-6:-3], rel=0, abs=NEGLIGIBLE * NOISE)


# --- Eq. (54) and what it claims --------------------------------------------------------------------------------------


def oracles_misfit(robot, measurements, model, values):
    """Psi* - f by 4x4 products, metres and radians side by side."""
    T = np.array([tool_pose(robot, q, values) for q in measurements.readings])
    if model == "pose":
        turned = Rotation.from_matrix(np.swapaxes(T[:, :3, :3], 1, 2) @ measurements.rotation).as_rotvec()
        return np.concatenate([turned, measurements.position - T[:, :3, 3]], axis=1).ravel()
    pairs = measurements.pairs
    A, B = T[pairs.a], T[pairs.b]
    rows = [pairs.distance - np.linalg.norm(B[:, :3, 3] - A[:, :3, 3], axis=1)]
    if model == "distance-rotation":
        relative = Rotation.from_matrix(np.swapaxes(A[:, :3, :3], 1, 2) @ B[:, :3, :3])
        rows.append(pairs.angle - relative.magnitude())
    return np.concatenate(rows)


@pytest.mark.parametrize("model", PAPERS[1:])
def test_one_step_is_the_pseudoinverse_times_what_is_left(model, monkeypatch):
    """All 35 parameters: the minimum-norm step, which leaves alone what has no effect."""
    robot = paper_robot()
    measurements = simulated(robot, model, n=30)
    monkeypatch.setattr(least_squares, "_STEPS", 1)
    fit = fit_least_squares(robot, measurements, model=model)
    columns = [robot.index(name) for name in fit.names]
    assert len(columns) == 35

    def misfit(x):
        values = robot.nominal
        values[columns] = x
        return oracles_misfit(robot, measurements, model, values)

    x = robot.nominal[columns]
    J = -central_differences(misfit, x)
    # differences leave open directions at 1e-9 of the largest singular value, the others are above 1e-3 of it
    expected = np.linalg.pinv(J, rcond=1e-6) @ misfit(x)
    step = fit.robot.nominal[columns] - x
    assert np.linalg.norm(expected) > 1e-3
    assert step == pytest.approx(expected, rel=0, abs=1e-8 * np.linalg.norm(expected) + rounding(1, 1e3))
    if model != "pose":
        for name in ("a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"):
            assert step[fit.names.index(name)] == pytest.approx(0.0, abs=rounding(10.0)), name


def planar_measurements(offsets):
    """Positions of the planar arm, stretched (q2 = 0) and folded by turns, off by `offsets` along the links."""
    n = len(offsets)
    q = np.array([[0.0, 0.0], [0.0, np.pi]] * (n // 2))
    reach = np.where(q[:, 1] == 0.0, 3.0, 1.0)
    position = np.stack([reach + offsets, np.zeros(n), np.zeros(n)], axis=1)
    return Measurements.from_arrays(q, position=position, sigma_position=2e-3)


def test_unweighted_it_claims_what_the_residuals_say_and_weighted_what_the_noise_says():
    """By hand: a1 + a2 and a1 - a2 are means of 10 values each, a2 theta2 of 20; residuals of 1 mm, 60 rows."""
    measurements = planar_measurements(1e-3 * np.tile([1.0, 1.0, -1.0, -1.0], 5))
    plain = fit_least_squares(planar_robot(), measurements, model="position")
    s = np.sqrt(20 * 1e-6 / (60 - 3))
    assert plain.names == ("a1", "theta2", "a2")
    assert plain.n_rows == 60
    # mean of the sum and of the difference of the two: sqrt((s^2 + s^2) / 10) / 2
    expected = {"a1": s / np.sqrt(20), "a2": s / np.sqrt(20), "theta2": s / np.sqrt(20)}
    assert plain.sigma == pytest.approx(expected, rel=rounding(1, 10), abs=0)
    weighted = fit_least_squares(planar_robot(), measurements, model="position", weighted=True)
    assert weighted.sigma == pytest.approx(dict.fromkeys(expected, 2e-3 / np.sqrt(20)), rel=rounding(1, 10), abs=0)


def test_what_the_measurements_leave_open_has_no_sigma():
    robot = replace(planar_robot(), parameters=planar_robot().with_estimated(["a1", "a2", "alpha2"]).parameters)
    fit = fit_least_squares(robot, planar_measurements(np.zeros(20)), model="position", weighted=True)
    assert np.isnan(fit.sigma["alpha2"])
    assert fit.sigma["a1"] == pytest.approx(2e-3 / np.sqrt(20))
    stretched = planar_measurements(np.zeros(20))
    stretched = replace(stretched, test=stretched.readings[:, 1] != 0.0)  # a1 + a2 alone
    fit = fit_least_squares(robot, stretched, model="position", names=["a1", "a2"], weighted=True)
    assert np.all(np.isnan(fit.covariance))


# --- rows, ends, messages ---------------------------------------------------------------------------------------------


def test_pairs_of_one_configuration_and_test_rows_take_no_part():
    robot, rng = planar_robot(), np.random.default_rng(0)
    q = np.array([[0.0, 0.0], [0.0, 0.0], [0.3, 0.5], [1.0, -2.0], [2.0, 1.0]])
    pairs = pairs_between(robot, q, (np.array([0, 0, 2, 2]), np.array([1, 2, 3, 4])), rng)
    pairs = replace(pairs, angle=plus(pairs.angle, 2, np.nan), test=np.arange(4) == 3)
    measurements = replace(measure(robot, 5, rng, readings=q), pairs=pairs)
    fit = fit_least_squares(robot, measurements, model="distance-rotation", names=["a2"], weighted=True)
    assert fit.n_rows == 3


@pytest.mark.parametrize("weighted", [False, True])
def test_a_fit_says_when_it_has_not_converged(weighted, monkeypatch):
    robot = paper_robot()
    monkeypatch.setattr(least_squares, "_STEPS", 2)
    fit = fit_least_squares(robot, simulated(robot, "pose"), model="pose", weighted=weighted)
    assert not fit.converged
    said = ("2 iterations, the last step was ", "The maximum number of function evaluations is exceeded")[weighted]
    assert fit.message.startswith(f"not converged: {said}")


@pytest.mark.parametrize("weighted", [False, True])
def test_a_fit_says_when_no_step_is_possible(weighted):
    robot = small_arm()
    absurd = replace(measure(robot, 20, np.random.default_rng(7)), position=np.full((20, 3), np.inf))
    fit = fit_least_squares(robot, absurd, model="position", weighted=weighted)
    said = ("diverged: residuals are not finite after 0 steps", "no step possible: ")[weighted]
    assert (fit.converged, fit.message[: len(said)]) == (False, said)
    assert np.isfinite(fit.robot.nominal).all()


ROBOT = planar_robot()
MISTAKES = [
    ({"start": np.zeros(3)}, "start: shape (3,), expected finite values as `Problem.start`"),
    ({"names": ["a3"]}, "names: unknown parameter 'a3', expected one of base.x, base.y, base.z, base.yaw, base.pitch, "
     "base.roll, theta1, d1, a1, alpha1, theta2, d2, ..."),
    ({"names": []}, "names: nothing to estimate, expected at least one parameter"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(arguments, message):
    assert refusal(fit_least_squares, ROBOT, planar_measurements(np.zeros(4)), model="position", **arguments) == message


def test_no_train_row_and_no_noise_are_named():
    whole = planar_measurements(np.zeros(4))
    with pytest.raises(InputError, match="no row left to fit, expected train rows for model position"):
        fit_least_squares(ROBOT, replace(whole, test=np.ones(4, bool)), model="position")
    with pytest.raises(InputError, match="noise: a row without any, expected noise in every row, to weight by"):
        fit_least_squares(ROBOT, replace(whole, sigma_position=np.zeros((4, 3))), model="position", weighted=True)
