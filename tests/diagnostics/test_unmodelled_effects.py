"""Unmodelled effects are found, and noise, outliers and forgotten frames are not taken for them."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from reported import format_report
from scipy.spatial.transform import Rotation
from scipy.stats import binom, kstest
from simulated import measure, measure_points, plus, small_arm, true_robot
from systematic import PLACED, SIGMA, SIGMA_JOINT, arm, measured, of_joint, problem_of
from touches import corners, reach, touch

from fg_calib import Measurements, Table, assess, build_problem, calibrate, solve
from fg_calib.diagnostics import LIKE_NOISE, basis_of
from fg_calib.diagnostics.candidate_effects import LINK, widened_robot
from fg_calib.diagnostics.unmodelled_effects import find_change, find_systematic, forgotten_offsets, regress
from fg_calib.graph import prior_rows, unknown_prior_rows
from fg_calib.robot import Joint, Robot, RobotBuilder, build_chain, forward, pose
from fg_calib.robot.effects import Backlash, Bending, Compliance, Coupling, ErrorCurve, Harmonics, Mass, Thermal
from fg_calib.statistics import estimate_noise, spread_of


def gravity(true, q):
    """Joints that yield to a weight at the tool."""
    return 2e-4 * pose(true, q).jacobian[:, 5, len(true.parameters) :]


EFFECTS = {
    "gravity": gravity,
    "gain": of_joint(2, lambda _, q: 3e-4 * q),
    "backlash": of_joint(1, lambda _, q: 3e-4 * np.sign(np.sin(q))),
    "eccentricity": of_joint(1, lambda _, q: 3e-4 * np.sin(q + 0.4)),
}
"""What moves the tool of the 6R arm by 2 to 4 sigma."""

CAUSES = {"gravity": "q2 yields to gravity", "gain": "q3 errs in proportion to its position"}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_of_a_few_sigma_is_seen_whatever_noise_is_specified_and_is_no_change(effect):
    for unit in (1.0, 0.2):
        robot, m = measured("6R", np.random.default_rng(1), effect=EFFECTS[effect], unit=unit)
        solution = solve(problem_of(robot, m, "position"))
        found = find_systematic(regress(solution))
        assert found.p_value < 1e-6
        assert found.cause.startswith(CAUSES.get(effect, "q2 errs once or twice a turn"))
        assert find_change(regress(solution)) is None


@pytest.mark.long
@pytest.mark.parametrize(("name", "model"), [("6R", "position"), ("scara", "pose"), ("gantry", "pairs"), ("6R", "own")])
def test_p_values_of_noise_are_uniform_and_nothing_has_moved(name, model):
    """Kolmogorov-Smirnov at 0.1 %, and no more below 1 % than chance allows once in a thousand times."""
    rng = np.random.default_rng(3)
    solver, unit, model = (estimate_noise, 0.2, "pose") if model == "own" else (solve, 1.0, model)
    found = [regress(solver(problem_of(*measured(name, rng, unit=unit), model))) for _ in range(50)]
    p = [find_systematic(one).p_value for one in found]
    assert not any(map(find_change, found))
    assert kstest(p, "uniform").pvalue > 1e-3
    assert np.sum(np.array(p) < 0.01) <= binom.ppf(0.999, 50, 0.01)


# --- robots with effects ------------------------------------------------------------------------------------------

MASSES = [Mass(4, 10.0, (0.2, 0.0, 0.1)), Mass(2, 5.0)]


def with_curves(rng, *, harmonic=0.0, width=1.0, gravity=(0.0, 0.0, -9.81)):
    """The solution of a small arm with compliance and, but where a harmonic is missing, error curves."""
    robot = small_arm(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3})
    modelled = [Compliance(MASSES, gravity=gravity), *[ErrorCurve(knots=12, sigma=1e-3)] * (not harmonic)]
    full = robot.with_effects(*modelled, *[Harmonics((2,), [2])] * bool(harmonic))
    width = np.array([width if p.kind == "curve" else harmonic / p.scale if p.kind in ("sin", "cos") else 1.0
                      for p in full.parameters])  # fmt: skip
    error = rng.normal(size=len(width)) * [p.tolerance or 0.0 for p in full.parameters] * width
    true = full.with_values(full.nominal + error)
    q = rng.uniform(-2.5, 2.5, (120, 4)) * [1.0, 1.0, 0.2, 1.0]
    return solve(build_problem(robot.with_effects(*modelled), measure_points(true, q, rng), model="position"))


@pytest.mark.parametrize("width", [1.0, 0.0])
def test_p_values_of_noise_are_uniform_with_error_curves_even_where_their_prior_is_too_wide(width):
    rng = np.random.default_rng(7)
    p = [find_systematic(regress(with_curves(rng, width=width))).p_value for _ in range(30)]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_a_missing_harmonic_is_named_next_to_modelled_compliance():
    found = find_systematic(regress(with_curves(np.random.default_rng(1), harmonic=3e-4)))
    assert found.p_value < 1e-6
    assert found.cause == "j2 errs once or twice a turn (gear, encoder: `harmonics`)"


def test_what_a_robot_has_is_no_candidate():
    names = {name for name in regress(with_curves(np.random.default_rng(1))).names.tolist() if LINK not in name}
    others = {"3 side", "4 bending", "4 tilt", "6 backlash", "6 coupling", "7 masses", "8 drift"}
    assert {" ".join(name.split()[:2]) for name in names} == {"2 gain", *others}
    assert [name for name in names if name.startswith("2")] == ["2 gain 3.gain0_2"]  # of the joint that slides
    hung = regress(with_curves(np.random.default_rng(1), gravity=(9.81, 0.0, 0.0))).names.tolist()
    assert sum(name.startswith("3 side load") for name in hung) == 3  # along y alone, of joints that turn
    assert sum(name.startswith("1 gravity") for name in hung) == 3
    tilted = regress(with_curves(np.random.default_rng(1), gravity="estimate")).names.tolist()
    assert not any("side load" in name for name in tilted)


@pytest.mark.parametrize("convention", ["dh", "poe"])
def test_a_wider_robot_has_the_loads_of_the_robot(convention):
    """Masses are where they were, small motions of links are at their ends."""
    builder = RobotBuilder("arm", convention)
    for k, axis in enumerate(([0, 0, 1], [0, 1, 0], [0, 1, 0])):
        if convention == "poe":
            builder.add_screw_joint(Joint(f"q{k + 1}"), axis, [0.1 * k, 0.0, 0.3 * k])
        else:
            builder.add_convention_joint(Joint(f"q{k + 1}"), {"a": 0.3, "alpha": 0.5, "d": 0.1, "theta": 0.0})
    robot = builder.build().with_effects(Compliance([Mass(3, 2.0, (0.1, 0.2, 0.3)), Mass(2, 1.0)], lateral=True))
    q, wide = np.random.default_rng(1).uniform(-2.0, 2.0, (5, 3)), widened_robot(robot)
    first = 3 + 6 * 4  # after joints and small motions
    own = robot.trig(q)[:, 3:]
    assert wide.trig(q)[:, first : first + own.shape[1]] == pytest.approx(own, abs=1e-12)


WRONG = [Mass(4, 10.0, (-0.1, 0.2, 0.1)), Mass(2, 5.0)]


@pytest.mark.parametrize(
    ("effect", "name", "size", "cause"),
    [
        (Compliance(MASSES), "theta2.compliance", 2e-5, "j2 yields to gravity"),
        (Compliance(MASSES, gravity=(0.0, 9.81, 0.0)), "theta2.compliance", 2e-5, "j2 yields to loads along x and y"),
        (Compliance(MASSES, lateral=True), "theta2.compliance_x", 2e-5, "j2 tilts under gravity"),
        (Bending(MASSES), "base.bending", 1e-5, "the base gives way"),
        (Harmonics((5,)), "theta1.sin5", 5e-4, "j1 errs several times a turn"),
        (Backlash(), "theta1.backlash", 2e-4, "j1 errs with the direction of its last move"),
        (Coupling([(1, 2)]), "theta2.coupling1", 1e-3, "j2 moves with j1 (`coupling: [[1, 2]]`)"),
        (Compliance(MASSES), "theta2.compliance", 1e-4, "j2 bears another load"),
        (Thermal(lengths=False, zeros=True), "theta2.drift", 5e-5, "j2 drifts in the order of rows"),
    ],
)
@pytest.mark.parametrize(("model", "n"), [("position", 40), ("position", 100), ("pose", 100)])
def test_each_effect_that_is_missing_is_named(effect, name, size, cause, model, n):
    robot, rng = small_arm(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}), np.random.default_rng(1)
    full = robot.with_effects(effect)
    true = full.with_values(full.nominal + size * np.array([p.name == name for p in full.parameters]))
    q = rng.uniform(-2.5, 2.5, (n, 4)) * [1.0, 1.0, 0.2, 1.0]
    context = {"moves": np.sign(np.diff(q, axis=0, prepend=q[:1])), "temperature": np.linspace(15.0, 25.0, n)}
    at = forward(build_chain(true), true.trig(q, context))
    position = at.position + 1e-4 * rng.normal(size=(n, 3))
    rotation = (Rotation.from_matrix(at.rotation) * Rotation.from_rotvec(2e-4 * rng.normal(size=(n, 3)))).as_matrix()
    m = Measurements.from_arrays(q, position=position, rotation=rotation, sigma_position=1e-4, sigma_orientation=2e-4)
    fitted = robot.with_effects(Compliance(WRONG)) if "another" in cause else robot
    regression = regress(solve(build_problem(fitted, m, model=model)))
    found, quick = (find_systematic(regression, thorough=thorough) for thorough in (True, False))
    assert found.p_value < 1e-6
    assert found.cause.startswith(cause)
    if "drifts" in cause:  # the last stage: of few rows nothing is left to it
        assert (quick.p_value < 1e-6) == (n == 100)
    assert find_change(regression) is None


def test_curves_are_eliminated_as_dense_columns_with_their_priors_would_be():
    solution = with_curves(np.random.default_rng(1))
    regression, problem = regress(solution), solution.problem
    r, J = problem.rows.linearise(problem.variables.at(solution.parameters))
    (r_0, J_0), (r_1, J_1) = (rows(problem.variables, solution.parameters) for rows in (prior_rows, unknown_prior_rows))
    J_0 = np.pad(J_0, ((0, 0), (0, problem.variables.n_nuisance)))
    Q = basis_of(np.vstack([J, J_0, J_1]))
    r = np.concatenate([r, r_0, r_1])
    assert regression.fit.r @ regression.fit.r == pytest.approx(np.sum((r - Q @ (Q.T @ r)) ** 2), rel=0.05)
    of_rows = np.r_[: problem.n_residuals, len(r) - len(r_1) : len(r)]  # and of curves
    assert regression.fit.dof == pytest.approx(len(of_rows) - np.sum(Q[of_rows] ** 2), rel=1e-3)
    curves = regression.fit.r[problem.n_residuals :][: len(r_1)]  # a state is minus its coefficient
    assert np.corrcoef(curves, r_1)[0, 1] < -0.99


def test_an_arm_of_one_joint_is_looked_at():
    robot = Robot.from_dh([[0.3, 0.1, 0.2, 0.0]], "dh")
    m = measure_points(robot, np.linspace(-1.0, 1.0, 9)[:, None], np.random.default_rng(1))
    assert find_systematic(regress(solve(build_problem(robot, m, model="position")))).p_value > 1e-3


def test_rows_between_landmarks_alone_follow_no_effect_of_a_joint():
    robot, rng = small_arm(tolerance={"a": 1e-3}), np.random.default_rng(1)
    m = touch(robot, corners(robot, 4, rng), 20, rng, sigma=1e-4, distances=[(0, 1, 1e-5), (1, 2, 1e-5)])
    regression = regress(solve(build_problem(robot, Table(m, "distance"))))
    assert not np.any(regression.named("1", "2 position", "3")[-2:])


@pytest.mark.parametrize("loss", ["none", "gnc"])
def test_what_residuals_follow_is_said_first_and_a_loss_that_takes_it_for_outliers_does_harm(loss):
    sag = of_joint(1, lambda *at: 10.0 * gravity(*at))
    robot, m = measured("6R", np.random.default_rng(1), effect=sag, n=60, n_test=60)
    errors = calibrate(robot, m, model="position", frame="unknown", loss=loss).assessment.verdict.errors
    assert errors[0].startswith("systematic residuals: q2 yields to gravity (`compliance`) (p = ")
    assert not any("loss: gnc" in text or ", or outliers" in text for text in errors)
    assert any(text.startswith("least squares predicts the test rows better") for text in errors) == (loss == "gnc")


@pytest.mark.parametrize(("size", "error"), [(10.0, True), (2.0, False)])
def test_an_effect_that_noise_estimated_far_above_the_specified_would_hide_is_an_error(size, error):
    robot, m = measured("6R", np.random.default_rng(1), effect=of_joint(1, lambda *at: size * gravity(*at)), n=60)
    found = calibrate(robot, m, model="position", frame="unknown", estimate_noise=True).assessment.verdict
    assert (bool(found.errors), "times that specified" in " ".join(found.warnings)) == (error, True)
    assert (found.errors or found.warnings)[0].startswith(
        "systematic residuals: q2 yields to gravity (`compliance`) (p = "
    )


def test_an_effect_is_seen_among_outliers_that_a_loss_rejects():
    sag = of_joint(1, lambda *at: 10.0 * gravity(*at))
    robot, m = measured("6R", np.random.default_rng(1), effect=sag)
    spoiled = replace(m, position=plus(m.position, slice(0, 60, 20), 0.01))
    solution = solve(build_problem(robot, spoiled, model="position", frame="unknown", loss="huber"))
    assert find_systematic(regress(solution)).p_value < 1e-3


@pytest.mark.parametrize("instrument", ["targets", "planes", "anchors known"])
def test_noise_of_instruments_with_landmarks_is_not_systematic_and_a_gain_is(instrument):
    robot, _, table = measured_by(instrument, np.random.default_rng(1), n=80)
    m = replace(table.measurements, readings=table.measurements.readings * [1, 1.003, 1, 1])
    wrong = replace(table, measurements=m)
    healthy, spoilt = (find_systematic(regress(solve(build_problem(robot, [one])))) for one in (table, wrong))
    assert healthy.p_value > LIKE_NOISE
    assert spoilt.p_value < 1e-6
    assert spoilt.cause.startswith("j2 errs ")


def test_sigmas_grow_by_what_regions_of_joint_space_differ_by_but_not_beyond_priors():
    robot, m = measured("6R", np.random.default_rng(1), effect=EFFECTS["backlash"], n=100)
    solution = solve(problem_of(robot, m, "position"))
    found, C = assess(solution), spread_of(solution).tangent
    J = prior_rows(solution.problem.variables, solution.parameters)[1]
    of_rows, of_priors, v = np.linalg.inv(C) - J.T @ J, J.T @ J, found.verdict.variance
    assert 2.0 < v < 10.0
    assert found.whole.tangent == pytest.approx(C @ (v * of_rows + of_priors) @ C, rel=1e-6, abs=1e-6 * np.abs(C).max())


# --- change points -----------------------------------------------------------------------------------------------


def moved(what, first, rng, n=45):
    """A table from row `first` of which the target, or the tracker, is half a millimetre away from where it was."""
    robot = arm("6R")
    true = true_robot(robot, rng)
    q = rng.uniform(-2.0, 2.0, (n, 6))
    values, frame = true.nominal, PLACED
    if what == "tool":
        values[[true.index(f"tool.{k}") for k in "xyz"]] += [4e-4, -2e-4, 2e-4]
    elif what == "base":
        frame = (PLACED[0], PLACED[1] + [4e-4, -2e-4, 2e-4])
    parts = [
        measure(at, len(rows), rng, sigma=SIGMA, sigma_joint=SIGMA_JOINT, frame=place, readings=rows)
        for at, place, rows in ((true, PLACED, q[:first]), (true.with_values(values), frame, q[first:]))
    ]
    together = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("readings", "test", "position", "rotation", "sigma_position", "sigma_orientation")
    }
    return robot, replace(parts[0], ids=np.arange(n).astype(str), **together)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("what", "model"), [(w, m) for w in ("tool", "base") for m in ("position", "pose")])
def test_what_moved_is_reported_with_the_row(what, model):
    robot, m = moved(what, 22, np.random.default_rng(1))
    solution = solve(problem_of(robot, m, model))
    found = assess(solution)
    assert (found.verdict.change.what, found.verdict.change.configuration) == (what, 22)
    assert found.verdict.errors[0].startswith(f"from configuration 22 on the {what} has moved (chi-square falls to")
    assert not found.noise_may_be_estimated
    assert "systematic" not in " ".join(format_report(solution, found).split())


@pytest.mark.sampled(1)
@pytest.mark.parametrize("row", [2, 25, 43])
def test_outliers_are_no_change(row):
    robot, m = moved("nothing", 22, np.random.default_rng(1))
    for rows in (row, [row, 10]):
        spoilt = replace(m, position=plus(m.position, rows, 0.005))
        assert find_change(regress(solve(problem_of(robot, spoilt, "position")))) is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_drift_along_a_sweep_is_no_change(seed):
    robot, rng = arm("6R"), np.random.default_rng(seed)
    true, q = true_robot(robot, rng), rng.uniform(-2.0, 2.0, (60, 6))
    q = q[np.argsort(q[:, 0])]
    drifted = q + 3e-4 * np.linspace(-1.0, 1.0, 60)[:, None] * (np.arange(6) == 1)
    m = measure(true, 60, rng, sigma=SIGMA, sigma_joint=SIGMA_JOINT, frame=PLACED, readings=drifted)
    assert find_change(regress(solve(problem_of(robot, replace(m, readings=q), "position")))) is None


def test_noise_specified_too_large_is_no_effect():
    """Else the columns of effects take up the pull of the priors, as residuals are small."""
    rng, robot = np.random.default_rng(5), small_arm(tolerance={"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3})
    m = measure(true_robot(robot, rng), 60, rng, sigma=(1e-4, 1e-4))
    wide = replace(m, sigma_position=5.0 * m.sigma_position, sigma_orientation=5.0 * m.sigma_orientation)
    assert find_systematic(regress(solve(build_problem(robot, wide, model="pose")))).p_value > 1e-3


@pytest.mark.parametrize("model", ["position", "pose"])
def test_gross_rows_are_outliers_and_hide_no_effect(model):
    for effect in (None, of_joint(1, lambda *at: 4.0 * gravity(*at))):
        robot, m = measured("6R", np.random.default_rng(3), effect=effect, n=50)
        m = replace(m, position=plus(m.position, [4, 20, 33], 0.003))
        verdict = assess(solve(problem_of(robot, m, model))).verdict
        assert (verdict.systematic.p_value < LIKE_NOISE) == (effect is not None)
        assert any("outliers: 3" in text for text in verdict.errors) == (effect is None)


def test_priors_that_are_too_wide_are_no_effect():
    """Their residuals are small, and say nothing of the noise of few rows."""
    for seed in range(6):
        robot, m = measured("6R", np.random.default_rng(seed), n=20)
        wide = [replace(p, tolerance=p.tolerance and 5.0 * p.tolerance) for p in robot.parameters]
        solution = solve(problem_of(replace(robot, parameters=tuple(wide)), m, "position"))
        assert find_systematic(regress(solution)).p_value > LIKE_NOISE


def test_noise_specified_too_large_for_one_kind_is_no_effect():
    """The test takes the ratio of observed to specified noise as equal, and is given rows where it is."""
    tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3}
    robot = Robot.from_dh([[0.1, np.pi / 2 * (k % 2), 0.05, 0.0] for k in range(7)], tolerance=tolerance)
    m = measure(robot, 200, np.random.default_rng(5), sigma=(1e-4, 2e-4))
    wide = replace(m, sigma_orientation=10.0 * m.sigma_orientation)
    solution = solve(build_problem(robot, wide, model="pose", frame="unknown"))
    assert find_systematic(regress(solution)).p_value < 1e-3
    assert assess(solution).verdict.systematic.p_value > 1e-2


# --- instrument offsets ------------------------------------------------------------------------------------------


def lengths(rng, offset, n=60):
    """An arm, and lengths to anchors with an offset that the job does not mention."""
    robot, _, table = measured_by("anchors", rng, n=n, sigma_joint=3e-5)
    m = table.measurements
    return robot, replace(table, measurements=m.with_values({"distance": m.value("distance") + offset}))


def test_a_large_forgotten_offset_is_named_and_not_what_it_looks_like():
    robot, table = lengths(np.random.default_rng(1), 0.3)
    verdict = assess(solve(build_problem(robot, [table]))).verdict
    assert any("(`offset: estimate`)" in text for text in verdict.errors)
    assert not any("systematic residuals" in text for text in (*verdict.errors, *verdict.warnings))


def test_a_forgotten_offset_is_reported_with_its_size():
    robot, table = lengths(np.random.default_rng(1), 5e-3)
    solution = solve(build_problem(robot, [table]))
    (found,) = forgotten_offsets(regress(solution))
    estimated = solve(build_problem(robot, [replace(table, offset=True)]))
    unknowns = estimated.problem.data.landmarks
    place = int(np.flatnonzero(unknowns.owners == [n.startswith("offset") for n in unknowns.names].index(True))[0])
    estimate = estimated.parameters[estimated.problem.variables.nuisance_span][place]
    # As it is estimated with all others: linear to a tenth of its sigma.
    assert found.size == pytest.approx(estimate, abs=0.1 * found.sigma)
    assert abs(found.size - 5e-3) < 4.0 * found.sigma
    verdict, healthy = assess(solution).verdict, assess(estimated).verdict
    assert any("(`offset: estimate`)" in text for text in (*verdict.errors, *verdict.warnings))
    assert not any("offset: estimate" in text for text in (*healthy.errors, *healthy.warnings, *healthy.notes))


def test_a_table_of_contacts_and_lengths_has_an_offset_to_look_for():
    robot, rng = small_arm(tolerance={"a": 1e-3, "theta": 1e-3}), np.random.default_rng(1)
    true, k, far = true_robot(robot, rng), np.arange(60) % 3, np.arange(60) % 2 == 0
    points = pose(true, 0.4 + 0.15 * rng.normal(size=(3, 4))).position
    q = np.where(far[:, None], rng.uniform(-1.0, 1.0, (60, 4)), reach(true, points[k], rng))
    lengths = np.where(far, np.linalg.norm(pose(true, q).position - points[k], axis=1), 0.0)
    m = Measurements.from_arrays(q, anchor=[f"p{i}" for i in k], distance=lengths, sigma_distance=1e-4)
    assert forgotten_offsets(regress(solve(build_problem(robot, [Table(m, "anchor", frame="known")])))) == ()
