"""Effects beyond the geometry: the prior sigma of error curves by marginal likelihood, and which of them are kept."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import arm_with, errors_of_all, measure_points, within_tolerance

from fg_calib import Calibration, Job, Options, build_problem, calibrate, selection
from fg_calib.assessment import solve_job
from fg_calib.graph import solve
from fg_calib.robot import Compliance, ErrorCurve, Gain, Harmonics, Mass
from fg_calib.selection import EffectTest, estimate_curve_sigma, select_effects
from fg_calib.statistics import estimate_noise

SIGMA, N_COEFFICIENTS = 8e-4, 40


def with_prior(robot, sigma, kind="curve"):
    """The robot with the same tolerance of all parameters of a kind."""
    each = (replace(p, tolerance=sigma) if p.kind == kind else p for p in robot.parameters)
    return replace(robot, parameters=tuple(each))


def measured(true, seed, n=80):
    rng = np.random.default_rng(seed)
    return measure_points(true, rng.uniform(-3.1, 3.1, (n, 4)), rng)


def drawn(robot, seed):
    return within_tolerance(robot, np.random.default_rng(seed))


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("free_noise", [False, True])
def test_sigma_of_curves_is_found_from_a_tenth_and_from_ten_times_of_it(factor, free_noise):
    robot = with_prior(arm_with(ErrorCurve([2, 3], 20)), SIGMA)
    problem = build_problem(with_prior(robot, factor * SIGMA), measured(drawn(robot, 1), 1), Options(model="position"))
    solution = estimate_curve_sigma(problem, estimate_noise if free_noise else solve)
    found = {p.tolerance for p in solution.problem.robot.parameters if p.kind == "curve"}
    assert solution.converged
    assert found == {sigma for v in solution.problem.variables.nuisance for sigma in v.prior[1]}
    (sigma,) = found
    variance = np.sum(solution.system.full_root[-N_COEFFICIENTS:] ** 2)
    gamma = N_COEFFICIENTS - variance / sigma**2
    c = solution.parameters[[i for i, p in enumerate(robot.parameters) if p.kind == "curve"]]
    assert sigma == pytest.approx(np.sqrt(c @ c / gamma), rel=0.01)  # the fixed point
    assert sigma == pytest.approx(SIGMA, abs=4.0 * SIGMA / np.sqrt(2.0 * gamma))  # 4 sigma


def test_errors_are_within_their_sigmas_with_an_estimated_prior_of_curves():
    squares, n_draws = [], 8
    for seed in range(n_draws):
        robot = with_prior(arm_with(ErrorCurve([2, 3], 20)), SIGMA)
        true = drawn(robot, seed)
        problem = build_problem(with_prior(robot, SIGMA / 10.0), measured(true, seed), Options(model="position"))
        solution = estimate_curve_sigma(problem)
        e, root = errors_of_all(solution, true)
        C, n = root @ root.T, solution.problem.variables.n_columns
        squares.append([e[k] @ np.linalg.solve(C[k, k], e[k]) / len(e[k]) for k in (slice(n), slice(n, None))])
    for mean, size in zip(np.mean(squares, axis=0), (n, N_COEFFICIENTS), strict=True):
        assert mean == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (n_draws * size)))  # 4 sigma


def test_a_specified_sigma_of_curves_is_kept():
    robot = arm_with(ErrorCurve([2, 3], 20, 3.0 * SIGMA))
    problem = build_problem(robot, measured(drawn(robot, 1), 1), Options(model="position"))
    found = estimate_curve_sigma(problem).problem.robot
    assert {p.tolerance for p in found.parameters if p.kind == "curve"} == {3.0 * SIGMA}


def test_curves_next_to_another_missing_effect_stay_curves():
    """Of joints that give way by degrees; without a bound the sigma grew without end."""
    true = arm_with(Compliance(MASSES, [2, 3]))
    true = true.with_values([1e-3 if p.kind == "compliance" else p.nominal for p in true.parameters])
    problem = build_problem(arm_with(ErrorCurve([2, 3], 20)), measured(true, 1, n=20), Options(model="position"))
    (sigma,) = {p.tolerance for p in estimate_curve_sigma(problem).problem.robot.parameters if p.kind == "curve"}
    assert sigma == pytest.approx(selection.MOST_SIGMA)


MASSES = [Mass(3, 10.0, (0.2, 0.0, 0.1))]
LISTED = (Harmonics([1, 2]), Compliance(MASSES, [2, 3]), Gain(), ErrorCurve([2, 3], 20))
"""Effects that are to be chosen from, not in the order in which they are tried."""


def of(*effects):
    """What is chosen from, of some of them: each of their joints."""
    joints = {0: (1, 2, 3, 4), 1: (2, 3), 2: (1, 2, 3, 4), 3: (2, 3)}
    return frozenset((i, joint) for i in effects for joint in joints[i])


def choosing(robot):
    return robot.geometry.with_effects(*robot.effects, select=True)


def curved_and_compliant(seed):
    """An arm with error curves and compliance of 2e-5 rad/(N m)."""
    true = drawn(with_prior(arm_with(*LISTED[1::2]), SIGMA), seed)
    return true.with_values([2e-5 if p.kind == "compliance" else p.nominal for p in true.parameters])


def test_effects_that_the_arm_has_are_kept_and_others_are_left(tmp_path):
    data = measured(curved_and_compliant(1), 1, n=160)
    found = calibrate(choosing(arm_with(*LISTED)), data, model="position", estimate_noise=True)
    tests = {one.effect: one for one in found.result.effects}
    assert list(tests) == ["error_curve", "compliance", "harmonics", "gain"]
    assert [one.kept for one in tests.values()] == [True, True, False, False]
    assert found.robot.effects == LISTED[1::2]
    assert {p.kind for p in found.robot.parameters} >= {"curve", "compliance"}
    assert not {p.kind for p in found.robot.parameters} & {"sin", "cos", "gain"}
    for one in tests.values():
        assert one.kept == (one.p_value < 1e-6) == (one.folds_after < 0.99 * one.folds_before) == (not one.reason)
    assert tests["compliance"].joints == (2, 3)
    assert tests["compliance"].folds_after == tests["error_curve"].folds_after == tests["gain"].folds_before
    alone = calibrate(arm_with(*LISTED[1::2]), data, model="position", estimate_noise=True)
    assert found.robot.nominal == pytest.approx(alone.robot.nominal, abs=1e-9)
    found.save(tmp_path)
    for one in (found, Calibration.load(tmp_path)):
        lines = [line.strip() for line in str(one).splitlines()]
        assert any(line.startswith("compliance of joints 2, 3: p ") and line.endswith(" mm: kept") for line in lines)
        assert any(
            line.startswith("gain of joints 1 to 4: p ") and line.endswith(": left, no evidence") for line in lines
        )
    again = Job(None, choosing(arm_with(*LISTED)), measured(curved_and_compliant(1), 2), Options(model="position"))
    assert found.check(again).verdict == "pass"


def test_nothing_is_kept_of_an_arm_that_is_its_geometry():
    job = Job(None, choosing(arm_with(*LISTED)), measured(drawn(arm_with(), 3), 3), Options(model="position"))
    chosen, tests = select_effects(job, solve_job)
    assert chosen.robot == arm_with()
    assert [one.reason for one in tests] == ["no evidence"] * 4
    plain = replace(job, robot=arm_with(*LISTED))
    assert select_effects(plain, solve_job) == (plain, ())


def test_effects_are_tried_until_nothing_changes(monkeypatch):
    """One is of use only after another that comes later, and replaces it: the first is tried again, and one dropped."""
    of_use = {
        "error_curve": lambda kept: 1 in kept,
        "compliance": lambda kept: True,
        "harmonics": lambda kept: 3 not in kept,
    }

    class Scripted:
        def __init__(self, job, solution):
            self.effects = job.robot.effects

            self.groups = of(0, 1, 2, 3)

        def test(self, kept, added):
            name = ("harmonics", "compliance", "gain", "error_curve")[min(added)[0]]
            useful = of_use.get(name, lambda kept: False)({i for i, _ in kept})
            return EffectTest(name, (), 1.0, 1.0, 1.0, useful), added if useful else frozenset()

        def prefers(self, new, old):
            return False

    monkeypatch.setattr(selection, "_Choice", Scripted)
    job = Job(None, choosing(arm_with(*LISTED)), measured(arm_with(), 0), Options(model="position"))
    assert select_effects(job, solve_job)[0].robot.effects == LISTED[1::2]


@pytest.fixture(scope="module")
def choice():
    job = Job(None, choosing(arm_with(*LISTED)), measured(curved_and_compliant(2), 2, 60), Options(model="position"))
    return selection._Choice(job, solve_job(replace(job, robot=arm_with())))


@pytest.mark.parametrize("kept", [(), (1,), (1, 3)])
def test_evidence_is_the_density_of_the_residuals(choice, kept):
    columns, noise, prior, evidence, x, U = choice.fit(of(*kept))
    A, b = choice.rows[:, columns], choice.rows[:, -1]
    C = noise * np.eye(len(b)) + (A / prior) @ A.T
    density = -0.5 * (b @ np.linalg.solve(C, b) + np.linalg.slogdet(C)[1])
    assert evidence == pytest.approx(density, rel=1e-6)
    assert x == pytest.approx(-(A / prior).T @ np.linalg.solve(C, b), rel=1e-4, abs=1e-6)
    K = np.linalg.inv(A.T @ A / noise + np.diag(prior))
    assert U.T @ U == pytest.approx(K, rel=1e-5, abs=1e-9)


def test_noise_and_sigma_are_those_of_largest_evidence(choice):
    """Neighbours by 10 % have a smaller one."""
    columns, noise, prior, best, *_ = choice.fit(of(1, 3))
    A, b, of_curves = choice.rows[:, columns], choice.rows[:, -1], choice.is_curve[columns]

    def evidence(by_noise, by_sigma):
        C = by_noise * noise * np.eye(len(b)) + (A / np.where(of_curves, prior / by_sigma**2, prior)) @ A.T
        return -0.5 * (b @ np.linalg.solve(C, b) + np.linalg.slogdet(C)[1])

    assert best > max(evidence(1.1, 1.0), evidence(1 / 1.1, 1.0), evidence(1.0, 1.2), evidence(1.0, 1 / 1.2))


def test_blocks_are_predicted_by_the_other_rows(choice):
    columns, noise, prior, *_ = choice.fit(of(1, 3))
    A, b = choice.rows[:, columns], choice.rows[:, -1]
    found = choice.held_out(of(1, 3))
    assert [np.sum([len(rows) for j, rows, _ in choice.held if j == k]) for k in range(4)] == [len(b)] * 4
    for j, rows, _ in choice.held[1::3]:
        rest = np.setdiff1d(np.arange(len(b)), rows)
        x = -np.linalg.solve(A[rest].T @ A[rest] + noise * np.diag(prior), A[rest].T @ b[rest])
        assert found[j, rows] == pytest.approx(b[rows] + A[rows] @ x, rel=1e-4, abs=1e-4)


def test_an_effect_that_makes_a_block_worse_than_the_geometry_is_left(choice, monkeypatch):
    j, rows, _ = choice.held[5]
    with_curve = np.full((4, len(choice.rows)), 0.5)
    with_curve[j, rows] = 1.1
    monkeypatch.setattr(choice, "held_out", lambda kept: with_curve if kept & of(3) else np.ones(with_curve.shape))
    found, kept = choice.test(of(1), of(3))
    assert not kept
    assert (found.kept, found.reason) == (False, "a block of joint 2 is predicted worse than by the geometry alone")
    with_curve[j, rows] = 0.9
    assert choice.test(of(1), of(3))[1] == of(3)


def test_an_effect_of_some_joints_is_kept_on_these():
    """An eccentricity of joint 3 alone, tried on all four."""
    true = arm_with(Harmonics([1], [3]))
    true = true.with_values([1e-3 if p.kind in ("sin", "cos") else p.nominal for p in true.parameters])
    tried, kept = (Harmonics([1, 2, 3, 4], joints) for joints in ("all", [3]))
    job = Job(None, choosing(arm_with(tried)), measured(true, 4, n=24), Options(model="position"))
    chosen, (test,) = select_effects(job, solve_job)
    assert (test.kept, test.joints) == (True, (3,))
    assert chosen.robot.effects == (kept,)


@pytest.mark.parametrize(("seed", "passes", "reason"), [(0, 4, "no evidence"), (2, 1, "gain in its place")])
def test_an_effect_that_another_mimics_takes_its_place(seed, passes, reason, monkeypatch):
    """Harmonics are tried before gains."""
    monkeypatch.setattr(selection, "N_PASSES", passes)
    true = arm_with(Gain())
    true = true.with_values([3e-4 if p.kind == "gain" else p.nominal for p in true.parameters])
    job = Job(None, choosing(arm_with(*LISTED[::2])), measured(true, seed, n=40), Options(model="position"))
    chosen, tests = select_effects(job, solve_job)
    assert chosen.robot.effects == (Gain([1, 2, 3, 4]),)
    assert [(one.effect, one.kept, one.reason) for one in tests] == [("harmonics", False, reason), ("gain", True, "")]


def test_few_rows_are_no_evidence():
    """A curve explains 6 positions without noise, and then anything is significant."""
    job = Job(None, choosing(arm_with(*LISTED)), measured(arm_with(), 1, n=6), Options(model="position"))
    assert {(test.reason, test.p_value) for test in select_effects(job, solve_job)[1]} == {("no evidence", 1.0)}


@pytest.mark.parametrize(("value", "prior", "severity"), [(-3e-5, 1e-4, "warnings"), (-2e-6, 2e-7, "errors")])
def test_joints_that_rise_under_load_are_named(value, prior, severity):
    """By their sigma; of compliances that the prior holds near 0 by that of the prior."""
    arm = with_prior(arm_with(Compliance(MASSES, [2, 3])), prior, "compliance")
    true = arm.with_values([value if p.kind == "compliance" else p.nominal for p in arm.parameters])
    found = getattr(calibrate(arm, measured(true, 1), model="position").assessment.verdict, severity)
    text = "joints rise under load (compliance in sigma: theta2.compliance -"
    assert any(one.startswith(text) for one in found)


def test_a_robust_loss_does_not_take_for_outliers_what_an_effect_explains():
    """Three gross rows next to compliance; by the noise as specified a harmonic of joint 4 went with rows taken out."""
    listed, draw = (Harmonics([1, 2]), Compliance(MASSES, [2, 3]), Gain()), np.random.default_rng(101)
    nominal = drawn(arm_with(*listed[:2]), 1)
    sizes = [(p.kind, p.nominal, p.owner) for p in nominal.parameters]
    true = nominal.with_values(
        [3e-5 * draw.choice([-1, 1]) if kind == "compliance" else value if kind not in ("sin", "cos")
         else 3e-4 * draw.normal() * (owner == 4) for kind, value, owner in sizes]
    )  # fmt: skip
    data = measured(true, 1)
    gross = np.vstack([0.02 * draw.normal(size=(3, 3)), np.zeros((77, 3))])
    job = Job(None, choosing(arm_with(*listed)), replace(data, position=data.position + gross),
              Options(model="position", loss="gnc"))  # fmt: skip
    assert {one.effect for one in select_effects(job, solve_job)[1] if one.kept} == {"harmonics", "compliance"}
