"""Where nonlinearity or an ambiguous sign makes sigmas dishonest a warning names the rows and the remedy."""

import re
from dataclasses import replace

import numpy as np
import pytest
from simulated import measure, pairs_between, small_arm, true_robot

from fg_calib import Measurements, Pairing, Robot, assess, build_problem, solve
from fg_calib.diagnostics import linearity, verdict
from fg_calib.diagnostics.linearity import AmbiguousRows, Nonlinearity, check_linearity, find_ambiguous_rows
from fg_calib.graph import unsolved
from fg_calib.robot import ErrorCurve, pose
from fg_calib.statistics import spread_of

WIDE = {"a": 1e-2, "d": 1e-2, "alpha": 1e-2, "theta": 1e-2}
SIGMA = 1e-5
AMBIGUOUS, NONLINEAR = "is ambiguous within the prior sigmas", "nonlinear within the posterior sigmas"


def check_linear(*found):
    """The statements that apply."""
    return [one for one in verdict.check_linear(*found) if one.applies]


def positions(n, sigma, seed):
    """A wide arm by few positions: the assessed solution, and the true arm."""
    rng, robot = np.random.default_rng(seed), small_arm(WIDE)
    true, q = true_robot(robot, rng), rng.uniform(-2.0, 2.0, (n, 4))
    position = pose(true, q).position + sigma * rng.normal(size=(n, 3))
    m = Measurements.from_arrays(q, position=position, sigma_position=sigma)
    solution = solve(build_problem(robot, m, model="position"))
    return solution, assess(solution), true


def by_second_differences(solution, spread, n_draws):
    """Mean of |R^T J^T q|^2 over directions, q what positions are beyond linear at draws d, J by differences.

    d are Gaussian, with the covariance: independent of the draws that are tested, which have its symmetric root.
    """
    m = solution.problem.data.tables[0].measurements
    robot = solution.problem.robot.with_values(solution.parameters[solution.problem.variables.robot_span])
    names = [i for i, p in enumerate(robot.parameters) if p.estimated]
    root = spread.root[:, : spread.rank]

    def rows(change):
        values = robot.nominal.copy()
        values[names] += change
        return pose(robot.with_values(values), m.readings).position.ravel() / m.sigma_position[0, 0]

    J = np.array([(rows(h) - rows(-h)) / 2e-6 for h in 1e-6 * np.eye(len(names))]).T
    curved = []
    for z in np.random.default_rng(5).normal(size=(n_draws, spread.rank)):
        change = root @ z
        q = 0.5 * (rows(change) + rows(-change)) - rows(np.zeros(len(names)))
        curved.append(np.mean((root.T @ (J.T @ q)) ** 2))
    return np.mean(curved)


@pytest.mark.parametrize("sigma", [pytest.param(1e-5, marks=pytest.mark.slow), 1e-4])
def test_nonlinearity_agrees_with_second_differences(monkeypatch, sigma):
    """Both are means over 200 draws of a square whose own spread is about its mean."""
    monkeypatch.setattr(linearity, "N_DRAWS", 200)
    solution, found, _ = positions(3, sigma, 1)
    expected = by_second_differences(solution, found.spread, 200)
    assert check_linearity(solution, found.spread).directions == pytest.approx(expected, rel=0.3)


def test_few_positions_of_a_wide_arm_are_warned_of_and_more_end_it():
    few, enough = (positions(n, 1e-5, 1)[1].verdict for n in (3, 12))
    assert any(NONLINEAR in text and "measure at more configurations" in text for text in few.warnings)
    assert few.errors == ()
    assert not any(NONLINEAR in text for text in enough.warnings)


def test_nonlinearity_is_reported_with_its_size_and_rows():
    none = AmbiguousRows()
    assert check_linear(none, Nonlinearity(0.09)) == []
    (some,), (lost,) = (check_linear(none, Nonlinearity(*of)) for of in ((3.0, 1.0), (np.inf, np.inf)))
    assert "errors there are some 2 times what it says; measure at more" in some.text
    assert "sigmas, so the covariance" in lost.text
    assert "many times" in lost.text
    assert some.severity == lost.severity == "warning"
    (note,) = check_linear(none, Nonlinearity(0.9, 0.05))
    assert (note.severity, note.text.endswith("what it says; not those of the tool")) == ("note", True)


# --- rows --------------------------------------------------------------------------------------------------------


ROWS = [[0.5, 0, 0, 0], [2e-3, 0, 0, 0]]


def test_what_zeros_and_error_curves_share_makes_no_direction_ambiguous():
    """A zero is known no better than its curve's prior, but what the joint turns is."""
    robot = small_arm({"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3})
    robot, rng = robot.with_effects(ErrorCurve([1, 2], knots=36, sigma=1e-3)), np.random.default_rng(1)
    true = robot.with_values(robot.nominal + 1e-3 * rng.normal(size=len(robot.parameters)))
    m = measure(true, 60, rng, sigma=(5e-5, 1e-4))
    solution = solve(build_problem(robot, m, model="distance-rotation", pairing=Pairing("star")))
    assert not find_ambiguous_rows(solution, spread_of(solution)).turned


def test_rows_of_ambiguous_sign_are_those_that_the_prior_lets_pass_zero_or_half_a_turn():
    """A wrist of radius 2 mm, by hand: the vector of pair k has the prior sigma 2 |sin(turn / 2)| of a2."""
    robot = Robot.from_dh(ROWS, "dh")
    turns = np.array([1e-3, 0.2, 1.5, 3.0])
    q = np.concatenate([np.zeros((4, 2)), np.stack([np.zeros(4), turns], axis=1)])
    ends, at = np.arange(4), pose(robot, q).position
    pairs = {"a": ends, "b": ends + 4, "distance": np.linalg.norm(at[4:] - at[:4], axis=1), "sigma_distance": 1e-5}

    def rows(tolerance):
        a2 = Robot.from_dh(ROWS, "dh", tolerance={"a": tolerance}).with_estimated(["a2"])
        problem = build_problem(a2, Measurements.from_arrays(q, pairs=pairs), model="distance")
        solution, root = unsolved(problem), np.array([[1e-5 / np.linalg.norm(moved)]])
        return find_ambiguous_rows(solution, replace(spread_of(solution), root=root, rank=1))

    # At 1 mrad the vector moves by 0.01 mm, below twice the noise; from 0.2 rad on by more than half its length.
    moved = 2.0 * np.sin(turns / 2.0)
    assert set(rows(1e-2).names) == {"1-5", "2-6", "3-7"}
    assert rows(1e-2).share == pytest.approx(np.sum(moved[1:] ** 2) / np.sum(moved**2), rel=1e-6)
    assert (rows(9e-4).names, rows(9e-4).share) == ((), 0.0)


def test_variance_across_a_row_is_that_of_all_other_rows():
    """Against the inverse of the information without the row."""
    rng = np.random.default_rng(0)
    J, direction, sigma = rng.normal(size=(4, 3, 6)), rng.normal(size=(4, 3)), rng.uniform(0.1, 0.3, 4)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    rows = np.einsum("ni,nij->nj", direction, J) / sigma[:, None]
    priors = np.diag(rng.uniform(1.0, 4.0, 6))
    S = np.linalg.cholesky(np.linalg.inv(priors + rows.T @ rows))
    leverage, across = linearity._without_itself(direction, J @ S, sigma)
    for k in range(4):
        assert leverage[k] == pytest.approx(rows[k] @ S @ S.T @ rows[k])
        others = np.delete(rows, k, axis=0)
        C, P = np.linalg.inv(priors + others.T @ others), np.eye(3) - np.outer(direction[k], direction[k])
        assert across[k] == pytest.approx(np.trace(P @ J[k] @ C @ J[k].T @ P))


def test_one_statement_names_the_rows_and_the_remedy():
    names, linear = ("0-1", "0-2", "0-3", "0-4"), Nonlinearity()
    assert check_linear(AmbiguousRows(60, names, 0.04), linear) == []
    (few,) = check_linear(AmbiguousRows(60, names, 0.06), Nonlinearity(3.0))
    assert few.severity == "warning"
    assert few.text.startswith(f"the sign of 4 of 60 lengths and angles {AMBIGUOUS} (0-1, 0-2, 0-3 and 1 more near 0")
    assert few.text.endswith("leave these out, or measure longer and wider motions, in which more joints move")
    (turned,) = check_linear(AmbiguousRows(60, turned=names[:1]), linear)
    assert turned.text.startswith(f"the direction of 1 of 60 lengths and angles {AMBIGUOUS} (0-1 near 0 or 180 deg):")
    (many,) = check_linear(AmbiguousRows(60, names, 0.31), linear)
    assert many.severity == "error"
    for high, nonlinear in ((True, 0.0), (False, 0.1)):
        (spoilt,) = check_linear(AmbiguousRows(60, names[:1], 0.0), Nonlinearity(nonlinear), high)
        assert "(0-1 near 0 or 180 deg" in spoilt.text


# --- cells where covariances are not honest ------------------------------------------------------------------------


def wrists(lengths, *, seed, n=60, k=6):
    """Two parallel axes, and across them wrists of which few pairs rotate one each: they see its length alone.

    Of `lengths` one each, 0 at nominal; the other pairs have the wrists upright, where their lengths act along the
    axes, unseen.
    """
    rng = np.random.default_rng(seed)
    rows = [[0.5, 0.0, 0.3, 0.0], [0.4, np.pi / 2, 0.0, 0.0], *([0.0, 0.0, 0.0, 0.0] for _ in lengths)]
    robot = Robot.from_dh(rows, convention="dh", tolerance={"a": 5e-3, "d": 1e-3, "alpha": 5e-4, "theta": 5e-4})
    values = true_robot(robot, rng).nominal
    for i, length in enumerate(lengths):
        values[robot.index(f"a{3 + i}")] = length
    n_all = n + k * len(lengths)
    a, b = (np.zeros((n_all, robot.n_joints)) for _ in range(2))
    a[:, :2], b[:, :2] = rng.uniform(-2.5, 2.5, (2, n_all, 2))
    a[:, 2] = b[:, 2] = np.pi / 2
    b[n:] = a[n:]
    for i in range(len(lengths)):
        b[n + k * i : n + k * (i + 1), 2 + i] += rng.uniform(1.0, 3.0, k)
    return robot, pairs_of(robot.with_values(values), a, b, 1e-4, rng)


def pairs_of(true, a, b, sigma, rng, *, angles=False):
    """Measured lengths, and angles, between configurations."""
    q, ends = np.concatenate([a, b]), np.arange(len(a))
    pairs = pairs_between(true, q, (ends, len(a) + ends), rng, sigma=(sigma, sigma * angles))
    return replace(Measurements.from_arrays(q), pairs=pairs)


GANTRY = [
    *([0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, -np.pi / 2, 0.1, -np.pi / 2], [0.0, 0.0, 0.1, 0.0]),
    *([0.0, np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
]


def gantry(seed, n=40, tolerance=1e-2):
    """A gantry of which each pair moves one joint: many a length that nominal has at 0 is the radius of a circle."""
    rng = np.random.default_rng(seed)
    sigmas = dict.fromkeys(("a", "d", "tool", "alpha", "theta"), tolerance)
    types = ["prismatic"] * 3 + ["revolute"] * 2
    robot = Robot.from_dh(GANTRY, types=types, estimate=["tool.x", "tool.z"], tolerance=sigmas)
    low, high = np.array([0.0] * 3 + [-2.5] * 2), np.array([0.4] * 3 + [2.5] * 2)
    a, joint, each = rng.uniform(low, high, (n, 5)), rng.integers(0, 5, n), np.arange(n)
    b = a.copy()
    b[each, joint] = rng.uniform(low, high, (n, 5))[each, joint]
    return robot, pairs_of(true_robot(robot, rng), a, b, SIGMA, rng, angles=True)


QUARTER = np.pi / 2
ARMS = {
    "SCARA": [(0, 0, 0.35), (0, 0.325, 0), (np.pi, 0.275, 0.05), (0, 0, 0.1)],
    "UR10": [(0, 0, 0.1273), (QUARTER, 0, 0), (0, -0.612, 0), (0, -0.5723, 0.163941), (QUARTER, 0, 0.1157),
             (-QUARTER, 0, 0.0922)],
}  # fmt: skip
"""alpha, a and d of each joint, modified DH; the SCARA's third is prismatic."""


def star(name, wider, seed, model, configurations=3):
    """A star of poses of an arm whose prior sigmas are 1 mm and 1 mrad times `wider`; its problem, and the true arm."""
    rng, rows = np.random.default_rng(seed), [(a, alpha, d, 0.0, 0.0) for alpha, a, d in ARMS[name]]
    types = ["prismatic" if name == "SCARA" and i == 2 else "revolute" for i in range(len(rows))]
    tolerance = dict.fromkeys(("a", "d", "alpha", "theta", "beta"), 1e-3 * wider)
    robot = Robot.from_dh(rows, "mdh-hayati", types=types, tolerance=tolerance)
    most = [0.1 if kind == "prismatic" else 2.4 for kind in types]
    q = np.random.default_rng(configurations).uniform(-1.0, 1.0, (40, len(rows))) * most
    true = true_robot(robot, rng)
    m = measure(true, 40, rng, sigma=(5e-5, 1.7e-4), readings=q)
    return build_problem(robot, m, model=model, pairing=Pairing("star")), true


CELLS = {
    "a length of unknown sign": lambda seed: (*wrists([2.7e-3], seed=seed), "distance"),
    "two lengths of unknown sign": lambda seed: (*wrists([3e-3, -4e-3], seed=seed), "distance"),
    "a gantry at wide priors": lambda seed: (*gantry(100 + seed), "distance-rotation"),
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("cell", CELLS)
def test_pairs_of_ambiguous_sign_that_a_result_rests_on_are_named(cell, seed):
    """Half of such draws end at the arm with the other sign, and their chi-square may be as good."""
    robot, m, model = CELLS[cell](seed)
    found = assess(solve(build_problem(robot, m, model=model))).verdict
    (said,) = [text for text in (*found.errors, *found.warnings) if AMBIGUOUS in text or NONLINEAR in text]
    assert re.search(r"ambiguous within the prior sigmas \(\d+-\d+", said)
    assert "leave these out, or measure longer and wider motions" in said


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("name", "wider", "model"),
    [("SCARA", 10.0, "distance-rotation"), ("SCARA", 10.0, "distance"), ("UR10", 30.0, "distance")],
)
def test_stars_at_wide_priors_are_warned_of(name, wider, model, seed):
    """Mean NEES of 10 draws 2.4 for the SCARA at tolerances times 10, of single draws up to 14."""
    found = assess(solve(star(name, wider, seed, model)[0])).verdict
    (said,) = [text for text in (*found.errors, *found.warnings) if AMBIGUOUS in text or NONLINEAR in text]
    assert NONLINEAR in said
    assert said.endswith("measure at more configurations, or specify smaller prior sigmas")


@pytest.mark.parametrize("name", ARMS)
def test_stars_at_usual_priors_are_not_warned_of(name):
    found = assess(solve(star(name, 1.0, 0, "distance-rotation")[0])).verdict
    assert not any(words in text for text in (*found.errors, *found.warnings) for words in (AMBIGUOUS, NONLINEAR))


@pytest.mark.slow
def test_a_scara_whose_tilts_rest_on_short_turns_is_warned_of():
    """Of 60 stars of random poses errors are as large as said where no warning is, and far larger where one is."""
    found = {False: [], True: []}
    for seed in range(60):
        problem, true = star("SCARA", 1.0, seed, "distance-rotation", configurations=100 + seed)
        assessed = assess(solve(problem))
        known = np.isfinite(np.diag(assessed.covariance))
        e = np.array([assessed.robot.nominal[true.index(n)] - true.nominal[true.index(n)] for n in assessed.names])
        C, e = assessed.covariance[np.ix_(known, known)], e[known]
        warned = any(AMBIGUOUS in text for text in assessed.verdict.warnings)
        found[warned].append(e @ np.linalg.solve(C, e) / len(e))
    healthy, warned = (np.array(found[which]) for which in (False, True))
    assert len(healthy) > len(warned) > 0
    assert 0.85 < np.mean(healthy) < 1.1
    assert healthy.max() < warned.max()
