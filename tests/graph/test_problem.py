"""What takes part in a problem, how it is whitened, and what is refused."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, planar_robot, small_arm, true_robot

from fg_calib import Measurements, Pairing, ProblemError, build_problem, solve
from fg_calib.graph.problem import named_rows
from fg_calib.measurements import Pairs
from fg_calib.robot import build_chain, pose


def direct_pairs(distance, angle, sigma=(1e-3, 1e-3), test=None):
    n, rows = len(distance), np.arange(len(distance))
    measured, sigmas = np.array([distance, angle], dtype=float), (np.full(n, one) for one in sigma)
    return Pairs(2 * rows, 2 * rows + 1, *measured, *sigmas, np.array(test or [False] * n), "pairs.csv")


def bare(robot, q, pairs=None, sigma_joint=0.0):
    n = len(q)
    sigma, nothing = np.full(robot.n_joints, sigma_joint), [None] * 4
    return Measurements(q, np.arange(n).astype(str), np.zeros(n, bool), *nothing, sigma, pairs)


def planar_pairs(angles, measured=None, distance=None, sigma=(1e-3, 1e-3)):
    """Pairs of the planar arm that differ by `angles` in the first joint: the tool turns by just that."""
    q = np.array([[x, 0.5] for angle in angles for x in (0.0, angle)])
    p = pose(planar_robot(), q).position
    d = np.linalg.norm(p[1::2] - p[::2], axis=1)
    turned = np.abs((np.array(angles) + np.pi) % (2 * np.pi) - np.pi)
    measured = turned if measured is None else measured
    return bare(planar_robot(), q, direct_pairs(d if distance is None else distance, measured, sigma))


def test_angles_near_0_and_180_degrees_have_the_moments_of_drawn_ones():
    """Of a noisy angle of sigma s near 0 or pi the absolute value is measured: its mean and its variance."""
    s, off = 1e-3, np.array([0.0, 1.0, 2.0, 30.0, 30.0, 2.0, 1.0])
    angles = np.where(np.arange(7) < 4, s * np.maximum(off, 1e-9), np.pi - s * off)
    problem = build_problem(planar_robot(), planar_pairs(angles, sigma=(1e-5, s)), model="rotation")
    (block,), (noise,) = problem.data.blocks, problem.noises
    assert block.kind.names == ("angle",)
    assert block.used.all()
    assert problem.n_excluded == {"same_configuration": 0}
    z = np.random.default_rng(0).normal(size=(200_000, 1))
    seen = np.abs(off + z)  # from 0 or pi, in sigma; 0.0016 and 0.0022 are 1 sigma of the mean's and sd's errors
    sign = np.where(np.arange(7) < 4, 1.0, -1.0)
    residual = noise.residual()[:, 0]
    assert residual / s == pytest.approx(sign * (seen.mean(axis=0) - off), abs=0.01)
    assert noise.sigma[:, 0] / s == pytest.approx(seen.std(axis=0), abs=0.01)


@pytest.mark.parametrize(("measured", "predicted"), [(0.0, 1.0), (np.pi, 1.0), (1.0, 1e-6), (1.0, np.pi)])
def test_an_angle_of_0_or_180_degrees_that_contradicts_the_arm_is_in_chi_square(measured, predicted):
    robot, m = planar_robot({"a": 0.01, "theta": 0.01}), planar_pairs([predicted, 1.5], [measured, 1.5])
    problem = build_problem(robot, m, model="rotation")
    assert problem.n_residuals == 2
    assert problem.graph.error(problem.initial) > 0.49 * (1.0 / 1e-3) ** 2


def test_only_a_directly_measured_distance_of_zero_becomes_three_coordinates():
    distance = [0.0, 1e-12, 0.0031, 0.6]
    problem = build_problem(planar_robot(), planar_pairs([0.2] * 4, distance=distance), model="distance-rotation")
    pairs, same = problem.data.blocks
    assert same.kind.names == ("distance.x", "distance.y", "distance.z")
    assert same.number.tolist() == [0]
    assert pairs.kind.names == ("distance", "angle")
    assert pairs.number.tolist() == [0, 1, 2, 3]
    assert pairs.used[:, 0].tolist() == [False, True, True, True]
    assert problem.n_residuals == 3 + 3 + 4
    assert problem.n_pairs == 4


def test_a_distance_of_zero_between_measured_poses_is_a_number_like_others():
    robot = small_arm()
    m = measure(robot, 10, np.random.default_rng(0))
    position = m.position.copy()
    position[3] = position[0]
    problem = build_problem(robot, replace(m, position=position), model="distance", pairing=Pairing("all"))
    assert [s.kind.names for s in problem.data.blocks] == [("distance",)]
    assert problem.n_residuals == 45


def test_a_pair_that_lacks_a_measurement_gives_the_other_row_only():
    measurements = planar_pairs([0.5, 1.0, 1.5])
    pairs = replace(measurements.pairs, distance=np.array([np.nan, 1.0, np.nan]), angle=np.array([0.5, np.nan, np.nan]))
    robot = planar_robot({"a": 0.01, "theta": 0.01})
    problem = build_problem(robot, replace(measurements, pairs=pairs), model="distance-rotation")
    assert problem.n_residuals == 2
    assert problem.n_pairs == 2
    assert all(v == 0 for v in problem.n_excluded.values())


refused = partial(refusal, build_problem, error=ProblemError)


def test_what_cannot_be_solved_is_refused_in_one_line():
    rng = np.random.default_rng(3)
    robot = small_arm()
    poses = replace(measure(robot, 30, rng), source="poses.csv")
    fixed = replace(robot, parameters=tuple(replace(p, estimated=False) for p in robot.parameters))
    assert "nothing to estimate" in refused(fixed, poses, model="pose")
    lost, still = replace(poses, sigma_joint=np.array([1e-4, 1e8, 1e-4, 1e-4])), planar_pairs([0.0, 0.0])
    for measurements, model, said in (
        (replace(poses, position=None), "position",
         "poses.csv: no columns x, y, z, expected measured positions for model position"),
        (replace(poses, sigma_orientation=None), "pose",
         "poses.csv: no sigma for orientation, expected noise.orientation or a column sigma_orientation"),
        (replace(poses, rotation=None), "rotation", "poses.csv: no columns qx, qy, qz, qw or roll, pitch, yaw, "
         "expected measured orientations for model rotation"),
        (replace(poses, sigma_position=None), "distance",
         "pairs from poses.csv: no sigma for distance, expected noise.position or a column sigma_position"),
        (lost, "distance",
         "poses.csv: noise.joint of 5.73e+09 deg at j2, expected less than half a turn; is it in degrees?"),
        (still, "rotation", "measurements: no row left to fit, 2 excluded for same configuration, expected train rows "
         "that the model uses"),
    ):  # fmt: skip
        assert refused(planar_robot() if measurements is still else robot, measurements, model=model) == said


def test_priors_count_as_rows_when_there_are_few():
    rng = np.random.default_rng(4)
    robot = paper_robot(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    problem = build_problem(robot, measure(robot, 3, rng), model="distance")
    assert (problem.n_residuals, problem.n_priors) == (2, 35)
    assert build_problem(robot, measure(robot, 60, rng), model="distance", prior=False).n_priors == 0


def test_frame_of_a_pair_model_does_not_matter():
    robot = true_robot(small_arm(), np.random.default_rng(6))
    measurements = measure(robot, 12, np.random.default_rng(7))
    both = (build_problem(robot, measurements, model="distance", frame=f) for f in ("known", "unknown"))
    assert len({problem.variables.names for problem in both}) == 1
    assert build_chain(robot).n_columns == 0


def test_a_configuration_against_itself_says_nothing_of_the_arm():
    robot = planar_robot({"a": 0.01, "theta": 0.01})
    problem = build_problem(robot, planar_pairs([0.0, 1.0]), model="distance-rotation")
    assert problem.n_excluded["same_configuration"] == 1
    assert problem.n_residuals == 2


def test_a_frame_takes_no_more_of_rows_than_it_explains():
    """Two positions leave its turn about the line between them open: five of its six columns are told apart."""
    robot = small_arm(tolerance={"a": 1e-3})
    problem = build_problem(robot, measure(robot, 2, np.random.default_rng(0)), model="position", frame="unknown")
    v, J = problem.variables, problem.linearize(problem.start).left.A
    rows, frame = (J @ v.tangent_derivative(problem.start))[:, : v.n_robot_columns], J[:, v.n_robot_columns :]
    assert np.linalg.matrix_rank(frame, rtol=1e-9) == 5
    expected = rows - frame @ np.linalg.pinv(frame, rcond=1e-9) @ rows
    assert named_rows(v, problem.start, J) == pytest.approx(expected, abs=1e-9 * np.abs(rows).max())


def test_numbers_of_rows_pairs_and_priors():
    """Of all pairs of n poses only 6 n - 12 numbers differ freely: frame and tool are unknown to them."""
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance={"a": 1e-3, "theta": 1e-3})
    m = measure(robot, 17, rng, n_test=5)
    poses = build_problem(robot, m, model="pose", frame="unknown")
    assert (poses.n_configurations, poses.n_residuals, poses.n_priors, poses.n_pairs) == (17, 102, 8, 0)
    assert (poses.n_independent, poses.n_added, poses.known, poses.has_more) == (102, 0, None, False)
    assert "17 configurations\n  102 residuals and 8 priors on 22 unknowns in 5 variables" in repr(poses)
    star = build_problem(robot, m, model="distance-rotation")
    assert (star.n_configurations, star.n_residuals, star.n_pairs, star.n_independent) == (17, 32, 16, 32)
    assert star.formed
    assert not star.rows.counted_as_private
    every = {"model": "distance-rotation", "pairing": Pairing("all")}
    both = [build_problem(robot, m, **every, pair_errors=errors) for errors in ("shared", "independent")]
    assert [p.n_residuals for p in both] == [2 * 136] * 2
    assert [p.rows.counted_as_private for p in both] == [False, True]
    assert both[0].n_independent == pytest.approx(6 * 17 - 12, abs=1)


def test_test_rows_alone_evaluate_the_arm_as_it_is():
    """Frame and tool are fitted, the arm is not: chi-square is that of an arm without estimated joints."""
    rng, robot = np.random.default_rng(4), small_arm({"a": 1e-3, "tool": 1e-2}, TOOL)
    frame = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))
    m = measure(true_robot(robot, rng), 20, rng, frame=frame)
    held_out = replace(m, test=np.ones(20, dtype=bool))
    options = {"model": "pose", "frame": "unknown"}
    evaluated = build_problem(robot, held_out, **options, gauge="keep", encoder="estimated")
    assert evaluated.evaluated
    assert [v.symbol for v in evaluated.variables.items] == ["T(0)", "X(0)"]
    expected = solve(build_problem(robot.with_estimated(TOOL), m, **options, gauge="none"))
    assert solve(evaluated).cost == pytest.approx(expected.cost, rel=1e-9)
    fixed = small_arm({"a": 1e-3})
    as_it_is = solve(build_problem(fixed, replace(m, test=held_out.test), model="distance"))
    assert (as_it_is.parameters[: len(fixed.nominal)] == fixed.nominal).all()
    assert as_it_is.message == "nothing to fit"
