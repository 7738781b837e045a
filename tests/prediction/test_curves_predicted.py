"""Predictions of an arm with error curves: covariances against dense sums, errors against draws, saved and loaded."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from refusals import refusal
from simulated import ROWS, TOLERANCE, arm_with, measure_points, tool_points, within_tolerance

from fg_calib import Calibration, Options, Robot, build_problem, calibrate, correct, export, predict, solve
from fg_calib.graph.problem import square_root
from fg_calib.io import read_joint_table, read_robot, read_urdf
from fg_calib.prediction import errors_at, predict_poses, workspace
from fg_calib.robot import Backlash, Compliance, ErrorCurve, Gain, Mass, Thermal, build_chain, forward, spline
from fg_calib.statistics import spread_of, with_left_out

LOAD = Compliance([Mass(3, 10.0, (0.2, 0.0, 0.1))], [2, 3])
MEASURED = 1.5
"""Joint 2 is measured within, [rad]."""


def drawn(seed=0, n=40, tolerance=TOLERANCE, **options):
    """A problem, and the true arm that it was measured on."""
    rng, effects = np.random.default_rng(seed), (ErrorCurve([2, 3], knots=8, sigma=1e-3), LOAD, Gain([2]))
    robot = arm_with(*effects, tolerance=tolerance)
    true = within_tolerance(robot, rng)
    q = rng.uniform(-2.5, 2.5, (n, 4)) * [1.0, MEASURED / 2.5, 1.0, 1.0]
    return build_problem(robot, measure_points(true, q, rng), Options(model="position", **options)), true


def position_derivative(variables, x, q):
    """Of tool points in all columns of core and curves, shape (3 n, n_columns + n_curves), by central differences."""
    robot, steps = variables.robot, 1e-6 * np.eye(variables.n_columns + variables.n_curves)
    trig = robot.trig(q, values=x)  # loads as they are

    def at(step):
        moved = variables.moved(x, step)
        return forward(build_chain(robot.with_values(moved[variables.robot_span])), trig).position.ravel()

    return np.array([(at(h) - at(-h)) / 2e-6 for h in steps]).T


@pytest.mark.parametrize(("seed", "options"), [(0, {}), (1, {"loss": "huber"})])
def test_covariance_of_predicted_poses_is_the_dense_sum(seed, options):
    solution = solve(drawn(seed, **options)[0])
    x, v = solution.parameters, solution.problem.variables
    root = solution.problem.linearize(x, with_loss=True).full_root
    q = np.random.default_rng(2).uniform(-3.0, 3.0, (12, 4))
    J = position_derivative(v, x, q).reshape(12, 3, -1)
    expected = np.einsum("nij,jk,nlk->nil", J, root @ root.T, J)
    spread = spread_of(solution)
    assert predict_poses(spread, q)[2][:, :3, :3] == pytest.approx(expected, rel=1e-5, abs=1e-14)  # of differences
    assert spread.variance(spread.curves) == pytest.approx(np.square(root).sum(axis=1)[v.n_columns :], rel=1e-9)


def test_covariance_with_parameters_left_out_is_the_dense_sum():
    """Their own errors are of their tolerances, and others, curves among them, make up for them."""
    solution = solve(drawn(gauge="keep")[0])
    problem, x = solution.problem, solution.parameters
    whole = problem.whole.variables
    A = square_root(replace(problem, variables=whole), x)[:, :-1]
    kept = np.array([*(name in problem.variables.names for name in whole.names), *[True] * whole.n_curves])
    assert 0 < np.sum(~kept)
    assert problem.variables.n_curves == 16
    tolerances = [p.tolerance for p in problem.whole.estimated if p.name not in problem.variables.names]
    noise, errors = np.linalg.pinv(A[:, kept]), -np.eye(len(kept))[:, ~kept] * tolerances
    errors[kept] = noise @ A[:, ~kept] * tolerances
    C = errors @ errors.T
    C[np.ix_(kept, kept)] += noise @ noise.T
    q = np.random.default_rng(2).uniform(-3.0, 3.0, (12, 4))
    J = position_derivative(whole, x, q).reshape(12, 3, -1)
    found = predict_poses(with_left_out(solution, spread_of(solution)), q)[2][:, :3, :3]
    assert found == pytest.approx(np.einsum("nij,jk,nlk->nil", J, C, J), rel=1e-5, abs=1e-14)  # of differences


def test_noise_of_more_variance_leaves_priors_of_curves_as_they_are():
    """Where no row is the prior stays; elsewhere the covariance is that of the same estimate from noisier rows."""
    spread = spread_of(solve(drawn()[0]))
    n, own = spread.variables.n_columns, spread.curves[:, spread.variables.n_columns :]
    found = spread.inflated(4.0).curves
    prior, C = 1e6 * np.eye(16), own @ own.T
    assert found[:, n:] @ found[:, n:].T == pytest.approx(4.0 * C - 3.0 * C @ prior @ C, abs=1e-12)
    assert np.isfinite(replace(spread, curves=2.0 * spread.curves).inflated(1e9).curves).all()  # rounding at its worst
    assert np.array_equal(found[:, :n], spread.curves[:, :n])


def test_errors_over_a_range_without_rows_are_as_expected():
    """By draws of arms: tool errors over the expected ones, where joint 2 was measured and where it was not."""
    ratios, q = [], np.random.default_rng(9).uniform(-2.5, 2.5, (60, 4))
    far = np.abs(q[:, 1]) > MEASURED + np.pi / 4.0  # no spline reaches there from the rows
    q[~far, 1] *= MEASURED / (MEASURED + np.pi / 4.0)
    for seed in range(30):
        problem, true = drawn(seed)
        solution = solve(problem)
        spread, robot = spread_of(solution), problem.robot.with_values(solution.parameters[: len(true.parameters)])
        off = tool_points(robot, q) - tool_points(true, q)
        expected = [errors_at(spread, q[rows])[0].position for rows in (~far, far)]
        rms = [np.sqrt(np.square(off[rows]).sum(axis=1).mean()) for rows in (~far, far)]
        ratios.append(np.square(rms) / np.square(expected))
        assert expected[1] > 3.0 * expected[0]
    mean, sigma = np.mean(ratios, axis=0), np.std(ratios, axis=0) / np.sqrt(len(ratios))
    assert np.all(np.abs(mean - 1.0) < 4.0 * sigma)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A calibration, its folder, and what it is when loaded."""
    problem, _ = drawn()
    found = calibrate(problem.robot, problem.data.tables[0].measurements, model="position")
    folder = tmp_path_factory.mktemp("curves")
    found.save(folder)
    return found, folder, Calibration.load(folder)


def test_parameters_hold_every_coefficient(calibrated):
    found, root = calibrated[0].parameters, calibrated[0].solution.system.full_root
    v = calibrated[0].solution.problem.variables
    for one in (one for one in (*v.items, *v.nuisance) if one.letter in "ES"):
        for place, sigma in zip(one.places, np.linalg.norm(root[one.columns], axis=1), strict=True):
            p = v.robot.parameters[place]
            estimate = found[p.name]
            assert estimate.sigma == pytest.approx(sigma, rel=1e-9)
            assert (estimate.estimate, estimate.prior_sigma, estimate.unit) == (
                calibrated[0].solution.parameters[place], p.tolerance, p.unit)  # fmt: skip
            assert estimate.identifiability != "fixed"
    # splines of joint 2 that no row within +-1.5 rad reaches: centred beyond +-(1.5 + pi / 2)
    assert [found[f"theta2.curve[{k}]"].identifiability for k in (0, 4)] == ["relative", "ineffective"]


def test_a_loaded_calibration_predicts_the_same(calibrated, monkeypatch):
    monkeypatch.setattr(workspace, "N_DRAWN", 200)
    found, _, loaded = calibrated
    q = np.random.default_rng(4).uniform(-3.0, 3.0, (40, 4))
    one, other = found.predict(q), loaded.predict(q)
    assert np.abs(other.position - one.position).max() < 1e-15
    assert other.sigma_position == pytest.approx(one.sigma_position, rel=1e-6)
    assert other.sigma_rotation == pytest.approx(one.sigma_rotation, rel=1e-6)
    everywhere = [predict(each) for each in (found, loaded)]
    assert everywhere[1].expected == pytest.approx(everywhere[0].expected, rel=1e-6)
    assert everywhere[0].worst.responsible[0].name.startswith("theta2.curve[")  # no rows there


@pytest.mark.parametrize(("change", "message"), [
    (lambda c: c[0] + " 1", "in row 1 instead of"),
    (lambda c: c[0].replace(c[0].split()[0], "x"), "could not convert string to float"),
    (lambda c: c[0].replace(c[0].split()[0], "nan"), "values that are none: found 1, expected 0"),
    (lambda c: None, "posterior: curves: found"),
])  # fmt: skip
def test_damaged_curves_are_named_in_one_line(calibrated, tmp_path, change, message):
    _, folder, _ = calibrated
    document = json.loads((folder / "result.json").read_text())
    document["posterior"]["curves"][0] = change(document["posterior"]["curves"])
    (tmp_path / "result.json").write_text(json.dumps(document))
    (tmp_path / "robot_calibrated.yaml").write_text((folder / "robot_calibrated.yaml").read_text())
    assert message in refusal(Calibration.load, tmp_path)


def test_commands_count_effects_and_poses_for_the_controller_do_not(calibrated):
    found = calibrated[2]
    q = np.random.default_rng(5).uniform(-1.2, 1.2, (5, 4))
    target = tool_points(found.nominal.geometry, q)
    points = correct(found, target, near=q)
    assert points.reached.all()
    there = tool_points(found.robot, points.readings)
    assert np.linalg.norm(there - target, axis=1).max() < 1e-9
    controller = tool_points(found.nominal.geometry, points.readings)
    assert np.linalg.norm(controller - points.position, axis=1).max() < 1e-12
    assert np.linalg.norm(controller - target, axis=1).min() > 1e-5


def test_exports_without_effects_write_them_next_to_the_file(calibrated, tmp_path):
    found = calibrated[2]
    made, q = export(found, "hayati"), found.measured
    at, without = (tool_points(r, q) for r in (found.robot, found.robot.geometry))
    rms = 1e3 * np.sqrt(np.square(at - without).sum(axis=1).mean())
    assert "cannot hold error_curve, compliance, gain, without" in made.notes[0]
    assert f"off where it was measured: position {rms:.4g} mm RMS" in made.notes[0]
    made.write(tmp_path / "arm.yaml")
    geometry = read_robot(tmp_path / "arm.yaml")
    assert "next to it: arm_curves.csv, arm_effects.yaml in rad" in (tmp_path / "arm.yaml").read_text()
    assert tool_points(geometry, q) == pytest.approx(without, abs=1e-9)
    rows = [line.split(",") for line in (tmp_path / "arm_curves.csv").read_text().splitlines()]
    assert rows[0] == ["joint", "angle", "correction"]
    coefficients = np.array([found.parameters[f"theta3.curve[{k}]"].estimate for k in range(8)])
    for _, angle, turn in [row for row in rows[1:] if row[0] == '"q3"'][::90]:
        which, weights = spline(np.array([float(angle)]), 8)
        assert float(turn) == pytest.approx(weights[0] @ coefficients[which[0]], rel=1e-6, abs=1e-12)
    values = yaml.safe_load((tmp_path / "arm_effects.yaml").read_text())["effects"]["values"]
    assert values["theta2.compliance"] == found.parameters["theta2.compliance"].estimate
    assert not any("curve" in name for name in values)
    assert export(found, "yaml").effects == export(found, "zeros").effects == {}
    export(found, "urdf").write(tmp_path / "a---b.urdf")
    assert not read_robot(tmp_path / "a---b.urdf").effects


def test_tables_to_predict_at_may_have_what_effects_depend_on(tmp_path):
    robot = Robot.from_dh(ROWS, "dh").with_effects(Thermal(lengths=False, zeros=True), Backlash([2], side="side"))
    (tmp_path / "at.csv").write_text("q1,q2,q3,q4,temperature\n0,0,0,0,30\n0,1,0,0,31\n")
    _, readings, context = read_joint_table(tmp_path / "at.csv", robot)
    assert {name: values.tolist() for name, values in context.items()} == {"temperature": [30.0, 31.0]}
    assert robot.trig(readings, context)[:, robot.n_joints :, 0].T.tolist() == [[10.0, 11.0]] * 4 + [[0.0, 0.0]]


def test_lengths_that_a_calibration_finds_do_not_grow_with_temperature():
    robot = Robot.from_dh([(0.0, 1.4, 0.3, 0.2), (0.5, 0.2, 0.0, -0.3)], "dh").with_effects(Thermal())
    moved = robot.with_values(robot.nominal + 1e-4)
    found = moved.trig(np.zeros((1, 2)), {"temperature": np.array([21.0])})[0, 2:, 0]
    assert found == pytest.approx([0.3001, 0.5001])  # d1, a2


def test_a_calibrated_arm_from_a_urdf_reads_back_with_its_effects(tmp_path):
    problem, _ = drawn()
    export(problem.robot.geometry, "urdf").write(tmp_path / "arm.urdf")
    effects = {"compliance": {"masses": {"link_3": {"mass": 10.0, "com": [0.2, 0.0, 0.1]}}, "joints": [2, 3]}}
    robot = read_urdf(tmp_path / "arm.urdf", effects=effects, tolerance=dict.fromkeys(("x", "y", "z", "yaw"), 1e-3))
    found = calibrate(robot, problem.data.tables[0].measurements, model="position")
    found.save(tmp_path / "result")
    loaded, q = Calibration.load(tmp_path / "result"), problem.data.readings[:5]
    assert found.parameters["q2.compliance"].estimate != 0.0
    assert loaded.predict(q).position == pytest.approx(found.predict(q).position, abs=1e-15)
