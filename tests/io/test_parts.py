"""A table in parts: their sum says what the whole table says, whoever reduces them."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm, true_robot

from fg_calib import (
    CalibrationError,
    InputError,
    Measurements,
    Pairing,
    ProblemError,
    assess,
    build_problem,
    cut,
    local_processes,
    reduce_parts,
    solve,
    solve_parts,
)
from fg_calib.graph.information import row_triangles
from fg_calib.graph.problem import assembled
from fg_calib.graph.solver import SolverOptions
from fg_calib.robot.kinematics import pose

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}
ROUNDING = 1e-13
"""Of Gram matrices, relative to their largest entry: some thousand sums of rows, each to 1e-16."""

FRAME = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))
MODELS = [("pose", "unknown"), ("position", "known"), ("distance", "known"), ("distance-rotation", "known")]


def table(model, robot, n=60, frame="known", **noise):
    """Poses, or pairs that were measured directly, some of them to be predicted."""
    rng = np.random.default_rng(3)
    true = true_robot(robot, rng)
    if "distance" not in model:
        return measure(true, n, rng, frame=FRAME if frame == "unknown" else None, n_test=5, **noise)
    q = rng.uniform(-3.0, 3.0, (40, 4))
    at = pose(true, q)
    a, b = (ends.ravel() for ends in np.triu_indices(40, 1))
    distance = np.linalg.norm(at.position[a] - at.position[b], axis=1)
    angle = Rotation.from_matrix(np.einsum("nji,njk->nik", at.rotation[a], at.rotation[b])).magnitude()
    pairs = {"a": a, "b": b, "distance": distance + 1e-4 * rng.normal(size=len(a))}
    pairs |= {"angle": np.abs(angle + 1e-4 * rng.normal(size=len(a))), "sigma_distance": 1e-4, "sigma_angle": 1e-4}
    return Measurements.from_arrays(q, pairs=pairs | {"test": np.arange(len(a)) % 7 == 0}, **noise)


@pytest.mark.parametrize(("model", "frame"), MODELS)
def test_the_sum_of_all_parts_is_what_the_whole_table_says(model, frame):
    robot = small_arm(TOLERANCE)
    m = table(model, robot, frame=frame)
    whole = build_problem(robot, m, model=model, frame=frame)
    parts = cut(m, 17)
    assert len(parts) > 3
    assert max(len(part.readings) for part in parts) < len(m.readings)
    at = whole.variables.stepped(whole.start, 1e-3 * np.random.default_rng(0).normal(size=whole.variables.n_columns))
    found = reduce_parts(robot, parts, at, model=model, frame=frame)
    expected = sum(R.T @ R for R in row_triangles(assembled(whole, at), at))
    assert found.n_residuals == whole.n_residuals
    assert found.triangle.shape == (whole.variables.n_columns + 1,) * 2
    assert np.abs(found.triangle.T @ found.triangle - expected).max() < ROUNDING * np.abs(expected).max()


@pytest.mark.parametrize(("model", "frame"), MODELS)
def test_a_table_in_parts_is_calibrated_as_the_whole_one(model, frame):
    robot = small_arm(TOLERANCE)
    m = table(model, robot, frame=frame)
    whole = solve(build_problem(robot, m, model=model, frame=frame))
    found = solve_parts(robot, cut(m, 17), model=model, frame=frame)
    assert found.converged
    assert found.decrement < 3e-7
    uncertainty = assess(whole)
    sigma = np.sqrt(np.diag(uncertainty.covariance))
    there = [i for i, p in enumerate(robot.parameters) if p.estimated]
    off = (found.robot.nominal - uncertainty.robot.nominal)[there] / sigma
    assert np.abs(off).max() < 1e-6  # sigma: what both solvers leave to go
    assert [found.sigma[name] for name in uncertainty.names] == pytest.approx(sigma.tolist(), rel=1e-6)
    assert 0.5 * found.chi2 == pytest.approx(whole.cost, rel=1e-9)


def test_what_nothing_determines_stays_and_has_no_sigma():
    robot = small_arm()  # without tolerances
    m = table("distance", robot)
    found = solve_parts(robot, cut(m, 100), model="distance", gauge="none")
    lost = [name for name, sigma in found.sigma.items() if np.isnan(sigma)]
    assert "theta1" in lost  # turns the whole arm
    first = next(i for i, p in enumerate(robot.parameters) if p.name == "theta1")
    assert found.robot.nominal[first] == robot.nominal[first]
    assert len(lost) < len(found.sigma)


def test_all_pairs_of_poses_hold_what_parts_of_the_poses_hold():
    """So a table of formed pairs is cut as poses; the last theta turns the tool in itself, which no pair tells."""
    robot = small_arm(TOLERANCE)
    rng = np.random.default_rng(4)
    m = measure(true_robot(robot, rng), 15, rng, sigma=(1e-3, 5e-4), sigma_joint=3e-4)
    found = solve_parts(robot, cut(m, 4), model="pose", frame="unknown")
    pairs = assess(solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing("all"))))
    ratio = np.sqrt(np.diag(pairs.covariance)) / [found.sigma[name] for name in pairs.names]
    assert np.all(ratio[:-1] >= 0.99)
    assert np.mean(ratio[:-1]) <= 1.1


def test_a_part_may_be_a_function_that_reads_it():
    robot = small_arm(TOLERANCE)
    parts = cut(table("pose", robot), 20)
    given = [partial(pickle.loads, pickle.dumps(part)) for part in parts]
    here, there = (solve_parts(robot, some, model="pose") for some in (parts, given))
    assert here.parameters.tobytes() == there.parameters.tobytes()


@pytest.mark.slow
def test_any_number_of_processes_gives_the_same_bits():
    robot = small_arm(TOLERANCE)
    parts = cut(table("distance-rotation", robot), 50)
    here = solve_parts(robot, parts, model="distance-rotation")
    for n in (1, 2):
        with local_processes(n) as executor:
            there = solve_parts(robot, parts, model="distance-rotation", executor=executor)
        assert there.parameters.tobytes() == here.parameters.tobytes()
        assert there.reduced.triangle.tobytes() == here.reduced.triangle.tobytes()


@pytest.mark.parametrize(
    ("model", "changes", "options", "message"),
    [
        ("pose", {}, {"model": "distance"}, r"part 1: .*: pairs formed of poses, .* model: pose with frame: unknown"),
        ("distance", {"sigma_joint": 1e-4}, {"model": "distance"}, r"part 1: .*: joint noise, which pairs of one"),
        ("pose", {}, {"model": "pose", "loss": "huber"}, r"^loss: found 'huber', expected none: parts are reduced"),
        ("pose", {}, {"model": "pose", "gauge": "keep"}, r"^gauge: keep, or estimated tolerances, expected prior or"),
        ("pose", {}, {"model": "anchor"}, r"^model: found anchor, expected one of poses or pairs"),
    ],
)
def test_what_parts_cannot_say_is_refused(model, changes, options, message):
    robot = small_arm(TOLERANCE)
    with pytest.raises(CalibrationError, match=message):
        solve_parts(robot, cut(table(model, robot, **changes), 20), **options)


def test_parts_are_tables_and_there_is_one():
    robot = small_arm(TOLERANCE)
    with pytest.raises(InputError, match=r"^parts: none, expected at least one"):
        solve_parts(robot, [], model="pose")
    with pytest.raises(InputError, match=r"^parts: found Measurements.*, expected a list of a Measurements or a f"):
        solve_parts(robot, table("pose", robot), model="pose")
    with pytest.raises(InputError, match=r"^parts\[0\]: found 3, expected a Measurements or a function"):
        solve_parts(robot, [3], model="pose")
    with pytest.raises(ProblemError, match=r"^parts: part 1: part: found 3, expected measurements, or a function that"):
        solve_parts(robot, [partial(int, 3)], model="pose")
    with pytest.raises(InputError, match=r"^n_rows: found 0"):
        cut(table("pose", robot), 0)
    labelled = Measurements.from_arrays(np.zeros((3, 4)), position=np.zeros((3, 3)), target=["a", "b", "a"])
    other = Measurements.from_arrays(np.zeros((1, 5)), position=np.zeros((1, 3)), sigma_position=1e-3)
    for frame in ("known", "unknown"):
        with pytest.raises(ProblemError, match=r"^parts: part 2: readings: shape \(1, 5\), expected \(n, 4\) for the"):
            solve_parts(robot, [*cut(table("pose", robot), 60), other], model="position", frame=frame)
    with pytest.raises(ProblemError, match="targets, stations, anchors or touched points, which rows of all parts"):
        solve_parts(robot, [labelled], model="position")


def test_independent_pairs_with_joint_noise_may_be_cut():
    robot = small_arm(TOLERANCE)
    m = table("distance", robot, sigma_joint=1e-4)
    choices = {"model": "distance", "pair_errors": "independent"}
    found = solve_parts(robot, cut(m, 100), **choices)
    whole = solve(build_problem(robot, m, **choices))
    assert 0.5 * found.chi2 == pytest.approx(whole.cost, rel=1e-9)


def test_pairs_beside_poses_that_are_solved_are_refused_as_cut_parts_hold_a_pose_many_times():
    robot = small_arm(TOLERANCE)
    m = table("pose", robot)
    rows = np.arange(60)
    both = replace(m, pairs=table("distance", robot).pairs.select(rows))
    with pytest.raises(ProblemError, match=r"^parts: part 1: measurements: pairs beside the poses, which model pose"):
        solve_parts(robot, cut(both, 7), model="pose")
    assert solve_parts(robot, cut(replace(both, pairs=None), 7), model="pose").reduced.n_residuals == 360


@pytest.mark.parametrize("n_rows", [2, 10])
def test_a_frame_is_started_by_all_parts_as_one_may_not_tell_where_it_is(n_rows):
    robot, rng = small_arm(TOLERANCE), np.random.default_rng(6)
    frame = (Rotation.random(random_state=6), np.array([0.5, 1.0, -0.3]))
    m = measure(true_robot(robot, rng), 20, rng, frame=frame)
    choices = {"model": "position", "frame": "unknown"}
    parts = cut(m, n_rows)
    tested = replace(parts[0], test=np.ones(n_rows, dtype=np.bool_))
    expected = solve(build_problem(robot, m, **choices)).cost
    for given in (parts, (tested, *parts), (m.select(np.arange(0)), *parts)):
        found = solve_parts(robot, given, **choices)
        assert found.converged
        assert 0.5 * found.chi2 == pytest.approx(expected, rel=1e-9)


def test_a_tool_far_from_nominal_is_started_from_distances():
    robot = small_arm(TOLERANCE, estimate=TOOL)
    off = -1.5 * np.isin([p.name for p in robot.parameters], TOOL[:2])
    m = table("distance", robot.with_values(robot.nominal + off))
    found = solve_parts(robot, cut(m, 50), model="distance")
    assert found.converged
    assert 0.5 * found.chi2 == pytest.approx(solve(build_problem(robot, m, model="distance")).cost, rel=1e-9)


def test_the_same_parameters_have_a_sigma_as_in_a_calibration():
    """Undetermined directions turn a little away from nominal: that makes nothing unknown that was known there."""
    robot, rng = paper_robot(), np.random.default_rng(1)
    m = measure(true_robot(robot, rng), 80, rng, sigma=(1e-4, 1e-4), frame=FRAME)
    choices = {"model": "pose", "frame": "unknown", "gauge": "none"}
    uncertainty = assess(solve(build_problem(robot, m, **choices)))
    sigma = solve_parts(robot, cut(m, 30), **choices).sigma
    expected = np.sqrt(np.diag(uncertainty.covariance))
    assert np.isnan(expected).any()
    assert [sigma[name] for name in uncertainty.names] == pytest.approx(expected.tolist(), rel=1e-4, nan_ok=True)


def test_test_rows_alone_are_no_calibration():
    robot = small_arm(TOLERANCE)
    m = table("pose", robot)
    with pytest.raises(ProblemError, match=r"^parts: no train row, expected at least one"):
        solve_parts(robot, [replace(m, test=np.ones(len(m.readings), dtype=np.bool_))], model="pose")


def test_the_options_say_after_how_many_steps_to_give_up():
    robot = small_arm(TOLERANCE)
    parts = cut(table("pose", robot), 20)
    found = solve_parts(robot, parts, model="pose", max_iterations=1)
    assert found.iterations == 1
    same = solve_parts(robot, parts, solver=SolverOptions(max_iterations=1), model="pose")
    assert found.parameters.tobytes() == same.parameters.tobytes()


def test_a_parameter_vector_of_another_size_is_refused_in_one_line():
    robot = small_arm()
    with pytest.raises(InputError, match=r"parameters: shape \(3,\), expected \(\d+\)"):
        reduce_parts(robot, [table("pose", robot)], np.zeros(3), model="pose")
