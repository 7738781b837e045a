"""Plain least squares: Eq. (54) against 4x4 products, agreement with the graph, what it claims, and its messages."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import central_differences, tool_pose
from scipy.spatial.transform import Rotation
from simulated import measure, paper_robot, planar_robot, small_arm, true_robot
from sparing import diagonal
from tolerances import NEGLIGIBLE, rounding, sigmas_apart

from fg_calib.assessment import assess
from fg_calib.baseline import least_squares
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import SolverOptions, solve
from fg_calib.inputs import InputError
from fg_calib.measurements.build import build_dataset
from fg_calib.measurements.dataset import Measurements, Pairs, form_pairs
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.rotations import rotation_angle

PAPERS = ["distance", "distance-rotation", "pose"]
TO_THE_END = SolverOptions(decrement=1e-9)
NOISE = 1e-4
"""Of every row unless a test says otherwise, [m] and [rad]."""

CREPT = 1e-7
"""Of a row's noise: what damping may leave of the way where nothing holds some directions; 2e-9 was measured."""


def fit_least_squares(robot, measurements, *, model, frame="known", **options):
    """Plain least squares of one table."""
    data = build_dataset(robot, [Table(measurements, model, Pairing("star"), frame)])
    return least_squares.fit_least_squares(robot, data, **options)


def apart(fit, values):
    """How far a fit is from other values of the robot, in its own sigma."""
    return sigmas_apart(fit.robot.nominal, values, [fit.sigma.get(p.name, 0.0) for p in fit.robot.parameters])


def simulated(robot, model, seed=1, *, sigma=NOISE, sigma_joint=0.0, n=80):
    """Measurements whose rows all have one weight, metres and radians alike, the pairs' away from kinks."""
    rng = np.random.default_rng(seed)
    measurements = measure(true_robot(robot, rng), n, rng, sigma=(sigma, sigma), sigma_joint=sigma_joint)
    if model in ("pose", "position", "orientation"):
        return measurements
    pairs = form_pairs(measurements, Pairing("random", 150))
    pairs = pairs.select((pairs.distance > 0.05) & (pairs.angle > 0.05) & (pairs.angle < np.pi - 0.05))
    one = np.full(pairs.n_pairs, sigma)
    return replace(measurements, pairs=replace(pairs, sigma_distance=one, sigma_angle=one))


def predicted(robot, model, q):
    """What a model could measure at configurations q, [m] and [rad]."""
    at = pose(robot, q)
    turned, _ = rotation_angle(np.swapaxes(at.rotation[:-1], 1, 2) @ at.rotation[1:])
    parts = {
        "distance": [np.linalg.norm(np.diff(at.position, axis=0), axis=1)],
        "rotation": [turned],
        "position": [at.position],
        "orientation": [at.rotation],
    }
    parts |= {
        "distance-rotation": parts["distance"] + parts["rotation"],
        "pose": parts["position"] + parts["orientation"],
    }
    return np.concatenate([part.ravel() for part in parts[model]])


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
    assert (
        len(names) == {"distance": 21, "distance-rotation": 23, "pose": 29}[model]
    )  # the paper's, see identifiability
    assert np.linalg.norm(graph - robot.nominal) > 1e-3
    for weighted in (False, True):
        for method in ("gauss-newton", "scipy"):
            fit = fit_least_squares(robot, measurements, model=model, names=names, weighted=weighted, method=method)
            assert fit.converged, fit.message
            assert (fit.n_rows, fit.rank) == (problem.n_residuals, len(names))
            assert apart(fit, graph) < NEGLIGIBLE, (method, weighted)


@pytest.mark.slow
@pytest.mark.parametrize("model", PAPERS)
def test_with_everything_estimated_they_agree_in_what_the_measurements_determine(model):
    """Estimates with and without parameters held end apart on one surface of equal predictions."""
    robot = paper_robot()
    measurements = simulated(robot, model)
    problem = build_problem(robot, measurements, model=model, gauge="none")
    graph = robot.with_values(solve(problem, TO_THE_END).parameters[:-6])
    kept = [p.name for p in build_problem(robot, measurements, model=model, gauge="keep").estimated]
    everything = fit_least_squares(robot, measurements, model=model)
    few = fit_least_squares(robot, measurements, model=model, names=kept)
    assert everything.converged
    assert everything.rank == few.rank == len(kept)
    q = np.random.default_rng(9).uniform(-np.pi, np.pi, (100, 7))
    expected = predicted(everything.robot, model, q)
    for other in (graph, few.robot):
        assert predicted(other, model, q) == pytest.approx(expected, rel=0, abs=CREPT * NOISE)
    # By parameters: seen from halfway between, two points of a curved surface differ along it up to third order.
    for other in (graph, few.robot):
        difference = other.nominal - everything.robot.nominal
        halfway = everything.robot.nominal + 0.5 * difference
        J = central_differences(lambda x: predicted(robot.with_values(x), model, q), halfway, step=1e-5)
        J[:, [i for i, p in enumerate(robot.parameters) if not p.estimated]] = 0.0
        determined = np.linalg.svd(J, full_matrices=False)[2][: len(kept)] @ difference
        size = np.linalg.norm(difference)
        assert np.linalg.norm(determined) < max(1e-12, 0.1 * size**3)
    assert size > 1e-3


SECOND_ORDER = 0.01
"""Sigma by which the mean of a noisy length moves an estimate here: 0.3 mrad of joint noise over 10 m (0.004 found)."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("model", "method"), diagonal(PAPERS, ["gauss-newton", "scipy"]))
def test_weighted_by_joint_noise_it_is_the_graph(model, method):
    """With the weights of the same parameters."""
    robot = paper_robot()
    measurements = simulated(robot, model, sigma=2e-4, sigma_joint=3e-4)
    problem = build_problem(robot, measurements, model=model, gauge="keep", pair_errors="independent")
    solution = solve(problem, TO_THE_END)
    names = [p.name for p in problem.estimated]
    fit = fit_least_squares(robot, measurements, model=model, names=names, weighted=True, method=method)
    assert fit.converged, fit.message
    # The last fit of each set of weights decides. Of pairs plain least squares does not know that noise lengthens them.
    closely = SECOND_ORDER if "distance" in model or model == "rotation" else 0.0
    assert apart(fit, solution.parameters[:-6]) < max(closely, 1e-5 if method == "gauss-newton" else 1e-3)
    covariance = assess(solution).spread.named()  # what was left out counts as known in plain least squares
    closely = max(closely, 1e-6)
    assert fit.covariance == pytest.approx(covariance, rel=closely, abs=closely * np.abs(covariance).max())
    plain = fit_least_squares(robot, measurements, model=model, names=names)
    assert np.abs(plain.robot.nominal - fit.robot.nominal).max() > 1e-5


def test_a_row_that_was_not_measured_does_not_weigh_on_the_other_of_its_pair():
    robot = paper_robot()
    measurements = simulated(robot, "distance-rotation", sigma=2e-4, sigma_joint=3e-4)
    distance, angle = measurements.pairs.distance.copy(), measurements.pairs.angle.copy()
    distance[::3], angle[1::3] = np.nan, np.nan
    measurements = replace(measurements, pairs=replace(measurements.pairs, distance=distance, angle=angle))
    problem = build_problem(robot, measurements, model="distance-rotation", gauge="keep", pair_errors="independent")
    solution = solve(problem, TO_THE_END)
    names = [p.name for p in problem.estimated]
    fit = fit_least_squares(robot, measurements, model="distance-rotation", names=names, weighted=True)
    assert fit.n_rows == problem.n_residuals == np.isfinite(distance).sum() + np.isfinite(angle).sum()
    assert apart(fit, solution.parameters[:-6]) < SECOND_ORDER


@pytest.mark.parametrize("start", ["graph", "near"])
@pytest.mark.parametrize("model", ["pose", "position", "orientation"])
def test_an_unknown_frame_is_the_graphs(model, start):
    robot = small_arm()
    rng = np.random.default_rng(3)
    turn, shift = Rotation.from_euler("ZYX", [0.4, np.pi / 2, 0.2]), np.array([7.0, -3.0, 2.0])  # yaw, roll undefined
    measurements = measure(true_robot(robot, rng), 60, rng, sigma=(1e-4, 1e-4), frame=(turn, shift))
    problem = build_problem(robot, measurements, model=model, frame="unknown", gauge="keep")
    solution = solve(problem, TO_THE_END)
    near = np.array([*robot.nominal, 6.9, -3.1, 2.05, 0.4, np.pi / 2, 0.25])
    fit = fit_least_squares(
        robot,
        measurements,
        model=model,
        frame="unknown",
        names=[p.name for p in problem.estimated],
        start=problem.start if start == "graph" else near,
    )
    assert fit.converged, fit.message
    assert apart(fit, solution.parameters[:-6]) < NEGLIGIBLE
    rotation, expected = (Rotation.from_euler("ZYX", f[3:]) for f in (fit.frame, solution.parameters[-6:]))
    assert (rotation.inv() * expected).magnitude() == pytest.approx(0.0, abs=1e-7)  # arccos near 1
    if model != "orientation":
        assert fit.frame[:3] == pytest.approx(solution.parameters[-6:-3], rel=0, abs=NEGLIGIBLE * NOISE)
    assert np.array_equal(fit.parameters[-6:], fit.frame)


@pytest.mark.parametrize("upright", [np.pi / 2, -np.pi / 2, 0.3])
def test_the_frame_is_one_frame_whatever_its_pitch(upright):
    robot = planar_robot()
    turn = Rotation.from_euler("ZYX", [0.7, upright, -0.4])
    measurements = measure(
        robot, 10, np.random.default_rng(0), sigma=(0.0, 0.0), frame=(turn, np.array([1.0, 2.0, 3.0]))
    )
    start = np.array([*robot.nominal, 1.1, 1.9, 3.1, 0.7, upright, -0.4])
    fit = fit_least_squares(robot, measurements, model="pose", frame="unknown", names=["a1"], start=start)
    assert fit.frame[:3] == pytest.approx([1.0, 2.0, 3.0], abs=rounding(10.0))
    assert Rotation.from_euler("ZYX", fit.frame[3:]).as_matrix() == pytest.approx(turn.as_matrix(), abs=rounding(10.0))


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


@pytest.mark.slow
@pytest.mark.parametrize("model", PAPERS)
def test_one_step_is_the_pseudoinverse_times_what_is_left(model):
    """All 35 parameters: the minimum-norm step, which leaves alone what has no effect."""
    robot = paper_robot()
    measurements = simulated(robot, model, n=30)
    fit = fit_least_squares(robot, measurements, model=model, max_iterations=1)
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
    assert fit.steps == pytest.approx([np.linalg.norm(expected)], rel=1e-6)
    if model != "pose":
        for name in ("a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"):
            assert step[fit.names.index(name)] == pytest.approx(0.0, abs=rounding(10.0)), name


def planar_measurements(offsets):
    """Positions of the planar arm, stretched (q2 = 0) and folded by turns, off by `offsets` along the links."""
    n = len(offsets)
    q = np.array([[0.0, 0.0], [0.0, np.pi]] * (n // 2))
    reach = np.where(q[:, 1] == 0.0, 3.0, 1.0)
    position = np.stack([reach + offsets, np.zeros(n), np.zeros(n)], axis=1)
    sigma = np.full((n, 3), 2e-3)
    return Measurements(q, np.arange(n).astype(str), np.zeros(n, bool), position, None, sigma, None, np.zeros(2))


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
    assert weighted.residuals == pytest.approx(plain.residuals, abs=rounding(1.0))
    assert np.linalg.norm(plain.residuals) == pytest.approx(np.sqrt(20) * 1e-3, rel=rounding(1, 10), abs=0)


def test_what_the_measurements_leave_open_has_no_sigma():
    robot = replace(planar_robot(), parameters=planar_robot().with_estimated(["a1", "a2", "alpha2"]).parameters)
    fit = fit_least_squares(robot, planar_measurements(np.zeros(20)), model="position", weighted=True)
    assert fit.rank == 2
    assert np.isnan(fit.sigma["alpha2"])
    assert fit.sigma["a1"] == pytest.approx(2e-3 / np.sqrt(20))
    stretched = planar_measurements(np.zeros(20))
    stretched = replace(stretched, test=stretched.readings[:, 1] != 0.0)  # a1 + a2 alone
    fit = fit_least_squares(robot, stretched, model="position", names=["a1", "a2"], weighted=True)
    assert fit.rank == 1
    assert np.all(np.isnan(fit.covariance))


def test_without_a_row_too_many_the_residuals_say_nothing():
    two = planar_measurements(np.array([1e-3, 1e-3]))
    pairs = Pairs(*(np.array([v]) for v in (0, 1, 2.001, np.nan, 1e-3, np.nan, False)))
    robot = planar_robot()
    fit = fit_least_squares(robot, replace(two, pairs=pairs), model="distance", names=["a2"])
    assert (fit.converged, fit.n_rows) == (True, 1)
    assert fit.robot.nominal[robot.index("a2")] == pytest.approx(1.0005)
    assert np.isnan(fit.sigma["a2"])
    assert np.isfinite(
        fit_least_squares(robot, replace(two, pairs=pairs), model="distance", names=["a2"], weighted=True).sigma["a2"]
    )


# --- rows, ends, messages ---------------------------------------------------------------------------------------------


def test_rows_without_a_derivative_and_test_rows_take_no_part():
    robot = planar_robot()
    q = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, np.pi], [0.3, 0.5], [1.0, -2.0], [2.0, 1.0]])
    at = pose(robot, q)
    a, b = np.array([0, 0, 0, 3, 3]), np.array([1, 2, 3, 4, 5])
    relative = np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b]
    pairs = Pairs(
        a=a,
        b=b,
        distance=np.linalg.norm(at.position[b] - at.position[a], axis=1),
        angle=rotation_angle(relative)[0],
        sigma_distance=np.full(5, 1e-3),
        sigma_angle=np.full(5, 1e-3),
        test=np.array([False, False, False, False, True]),
    )
    measurements = replace(measure(robot, 6, np.random.default_rng(0), readings=q), pairs=pairs)
    # pair 0: one configuration twice, neither; pair 1: half a turn, its distance only; pairs 2 and 3: both; 4: test
    fit = fit_least_squares(robot, measurements, model="distance-rotation", names=["a2"])
    assert fit.n_rows == 5
    unmeasured = replace(pairs, angle=np.array([1.0, np.nan, np.nan, 1.0, 1.0]))
    fit = fit_least_squares(
        robot, replace(measurements, pairs=unmeasured), model="distance-rotation", names=["a2"], weighted=True
    )
    assert fit.n_rows == 4


def test_it_says_when_it_has_not_arrived():
    robot = paper_robot()
    measurements = simulated(robot, "pose")
    fit = fit_least_squares(robot, measurements, model="pose", max_iterations=2)
    assert not fit.converged
    assert fit.message.startswith("not converged: 2 iterations, the last step was ")
    assert fit.iterations == len(fit.steps) == 2
    fit = fit_least_squares(robot, measurements, model="pose", max_iterations=2, method="scipy")
    assert not fit.converged
    assert fit.message == "not converged: The maximum number of function evaluations is exceeded"


def test_it_says_when_it_went_astray():
    robot = small_arm()
    measurements = measure(robot, 20, np.random.default_rng(7))
    absurd = replace(measurements, position=np.full((20, 3), np.inf))
    fit = fit_least_squares(robot, absurd, model="position")
    assert (fit.converged, fit.message) == (False, "diverged: residuals are not finite after 0 steps")
    assert np.isfinite(fit.robot.nominal).all()
    fit = fit_least_squares(robot, absurd, model="position", method="scipy")
    assert (fit.converged, fit.message[:18]) == (False, "no step possible: ")


def test_scipy_takes_fewer_rows_than_unknowns():
    robot = paper_robot()
    measurements = replace(simulated(robot, "pose"), test=np.arange(80) >= 4)
    fit = fit_least_squares(robot, measurements, model="pose", method="scipy", max_iterations=200)
    assert np.abs(fit.residuals).max() < 1e-8
    assert fit.n_rows == 24


ROBOT = planar_robot()
MISTAKES = [
    ({"method": "newton"}, "method: found 'newton', expected one of gauss-newton, scipy"),
    ({"max_iterations": 0}, "max_iterations: found 0, expected a whole number not below 1"),
    ({"tolerance": float("nan")}, "tolerance: found nan, expected a number not below 0"),
    ({"start": np.zeros(3)}, "start: shape (3,), expected 20 values of the robot, or 26 with the measurement frame's"),
    ({"start": np.full(20, np.nan)},
     "start: a value that is not finite, expected 20 values of the robot, or 26 with the measurement frame's"),
    ({"names": ["a3"]}, "names: unknown parameter 'a3', expected one of base.x, base.y, base.z, base.yaw, base.pitch, "
     "base.roll, theta1, d1, a1, alpha1, theta2, d2, ..."),
    ({"names": []}, "names: nothing to estimate, expected at least one parameter"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(arguments, message):
    with pytest.raises(InputError) as caught:
        fit_least_squares(ROBOT, planar_measurements(np.zeros(4)), model="position", **arguments)
    assert str(caught.value) == message


def test_no_train_row_and_no_noise_are_named():
    whole = planar_measurements(np.zeros(4))
    with pytest.raises(InputError, match="no row left to fit, expected train rows for model position"):
        fit_least_squares(ROBOT, replace(whole, test=np.ones(4, bool)), model="position")
    with pytest.raises(InputError, match="noise: a row without any, expected noise in every row, to weight by"):
        fit_least_squares(ROBOT, replace(whole, sigma_position=np.zeros((4, 3))), model="position", weighted=True)
