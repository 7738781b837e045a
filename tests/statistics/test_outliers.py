"""Few wrong measurements are told from noise and from what is not modelled, however far they are off."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from instruments import measured_by
from reported import format_report
from scipy.stats import beta
from simulated import measure, plus, small_arm, true_robot
from sparing import diagonal
from systematic import measured, of_joint, problem_of

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.inputs import Pairing
from fg_calib.statistics import outliers
from fg_calib.statistics.outliers import find_outliers, log_chance
from fg_calib.statistics.residual_covariance import RowErrors

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}


def linear(rng, n=40, m=6, scale=1.0, shifts=(), tied=0.5):
    """Rows of a random linear model by twos, which share errors by fours; what `find_outliers` takes of them."""
    J = rng.normal(size=(n, m))
    L = tied * scipy.linalg.block_diag(*[np.ones((4, 1))] * (n // 4))
    C = np.eye(n) + L @ L.T
    y = scale * np.linalg.cholesky(C) @ rng.normal(size=n)
    for rows, size in shifts:
        y[rows] += size
    W = np.linalg.inv(C)
    tangent = np.linalg.inv(J.T @ W @ J)
    z = y - J @ tangent @ J.T @ W @ y
    errors = RowErrors(J, np.ones(n), scipy.sparse.csr_array(L), np.zeros((n, 0)))
    units = list(np.arange(n).reshape(-1, 2))
    return (z, errors, tangent, units, float(n - m), (np.zeros(0), np.zeros((0, m)))), (y, J, C)


def test_what_is_found_is_what_refits_find():
    """The oracle: chi-square of generalised least squares without each two units, all pairs of units tried."""
    given, (y, J, C) = linear(np.random.default_rng(1), shifts=[([4, 5], 6.0), ([20, 21], [-5.0, 4.0])])
    left = {}
    for pair in combinations(range(20), 2):
        kept = ~np.isin(np.arange(40) // 2, pair)
        W = np.linalg.inv(C[np.ix_(kept, kept)])
        r = y[kept] - J[kept] @ np.linalg.solve(J[kept].T @ W @ J[kept], J[kept].T @ W @ y[kept])
        left[pair] = r @ W @ r
    assert min(left, key=left.get) == (2, 10)
    assert np.flatnonzero(find_outliers(*given)).tolist() == [4, 5, 20, 21]


def test_where_the_problem_is_linearised_is_no_matter():
    """At the optimum, and with priors far from it, where residuals are others."""
    rng = np.random.default_rng(9)
    (_, errors, _, units, dof, _), (y, J, C) = linear(rng, shifts=[([4, 5], [30.0, -20.0])])
    W, J_prior = np.linalg.inv(C), np.diag(rng.uniform(0.5, 2.0, 6))
    tangent = np.linalg.inv(J.T @ W @ J + J_prior.T @ J_prior)
    for x in (-tangent @ J.T @ W @ y, np.zeros(6), 30.0 * rng.normal(size=6)):
        given = (y + J @ x, errors, tangent, units, dof + 6.0, (J_prior @ x, J_prior))
        assert np.flatnonzero(find_outliers(*given)).tolist() == [4, 5]


@pytest.mark.slow
@pytest.mark.parametrize("swapped", [3, 4])
def test_anchors_exchanged_where_the_fit_goes_far_astray_are_outliers(swapped):
    """Half a metre, beside one row too many a parameter."""
    robot, _, table = measured_by("anchors", np.random.default_rng(10), n=45)
    m = table.measurements
    anchor = m.labels["anchor"]
    index = anchor.index.copy()
    index[[swapped, swapped + 12]] = index[[swapped + 1, swapped + 13]]
    wrong = replace(m, labels={**m.labels, "anchor": replace(anchor, index=index)})
    found = assess(solve(build_problem(robot, [replace(table, measurements=wrong)])))
    assert {fit.verdict for fit in found.fit.goodness.kinds} == {"outliers"}
    assert sorted(found.fit.goodness.gross.names) == sorted(str(m.ids[k]) for k in (swapped, swapped + 12))


@pytest.mark.parametrize("size", [30.0, 1e3, 1e6])
def test_many_equal_outliers_do_not_hide_each_other(size):
    shifts = [([2 * k, 2 * k + 1], size) for k in range(4)]
    (z, *rest), _ = linear(np.random.default_rng(2), n=80, shifts=shifts)
    assert np.flatnonzero(find_outliers(z, *rest)).tolist() == list(range(8))


def test_a_table_half_of_which_is_wrong_has_no_outliers():
    signs = np.random.default_rng(3).normal(size=20)
    shifts = [([2 * k, 2 * k + 1], 1e3 * sign) for k, sign in enumerate(signs)]
    given, _ = linear(np.random.default_rng(3), n=80, shifts=shifts)
    assert find_outliers(*given) is None


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.3, 1.0, 30.0])
def test_noise_of_any_size_has_no_gross_errors(scale):
    """CHANCE is 1e-4 for each number of rows left out: of 200 tables one at most."""
    rng = np.random.default_rng(4)
    assert sum(find_outliers(*linear(rng, scale=scale)[0]) is not None for _ in range(200)) <= 1


@pytest.mark.parametrize("dof", [3.0, 30.0, 300.0])
@pytest.mark.parametrize("m", [1.0, 2.0, 6.0])
def test_the_chance_of_a_gain_is_bounded_by_its_beta_distribution(dof, m):
    exact = beta(dof / 2.0, m / 2.0)
    for p in (1e-10, 1e-6, 1e-3, 0.1, 0.9):
        bound = log_chance(float(exact.ppf(p)), dof, m)
        assert np.log(p) <= bound + 1e-9
        assert bound <= 0.0
    left = float(exact.ppf(1e-10))
    assert log_chance(left, dof, m) < np.log(1e-10) + 1.0 - min(m / 2.0 - 1.0, 0.0) * np.log1p(-left) + 0.5 * m


def spoilt(name, by, rng):
    """A problem one measurement of which is `by` sigma off, and the name of its configuration."""
    robot = small_arm(tolerance=TOLERANCE)
    if name in ("anchors", "planes", "board", "targets"):
        robot, _, table = measured_by(name, rng)
        m = table.measurements
        if name in ("anchors", "planes"):
            m = replace(m, length=plus(m.length, 9, by * 1e-4))
        else:
            m = replace(m, position=plus(m.position, (9, 1), by * 3e-4))
        return build_problem(robot, [replace(table, measurements=m)]), str(m.ids[9])
    m = measure(true_robot(robot, rng), 16 if name == "all" else 30, rng, sigma=(1e-3, 5e-4), sigma_joint=1e-4)
    m = replace(m, position=plus(m.position, 9, by * 1e-3))
    if name == "pose":
        return build_problem(robot, m, model="pose"), "9"
    return build_problem(robot, m, model="distance-rotation", pairing=Pairing(name)), "9"


def test_too_many_rows_to_search_for_outliers_are_a_warning(monkeypatch):
    problem, _ = spoilt("star", 300.0, np.random.default_rng(5))
    monkeypatch.setattr(outliers, "MAX_ROWS", 10)
    found = assess(solve(problem))
    assert found.fit.goodness.gross is None
    assert any("outliers were not searched for: there are too many rows" in text for text in found.verdict.warnings)


SPOILT = ["pose", "star", "all", "anchors", "planes", "board", "targets"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "by"), diagonal(SPOILT, [60.0, 2000.0]))
def test_one_wrong_measurement_is_named_however_far_it_is_off(name, by):
    problem, wrong = spoilt(name, min(by, 300.0) if name == "all" else by, np.random.default_rng(5))
    found = assess(solve(problem))
    verdicts = {fit.verdict for fit in found.fit.goodness.kinds}
    assert "outliers" in verdicts <= {"outliers", "others", "as stated"}
    assert [name.removeprefix("0 and ") for name in found.fit.goodness.gross.names] == [wrong]
    assert found.fit.goodness.gross.ratio < 1.5
    assert not found.noise_may_be_estimated


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 5])
def test_a_loud_table_with_outliers_is_both(n):
    rng = np.random.default_rng(8)
    robot, m = measured("6R", rng, unit=0.5)
    m = replace(m, position=plus(m.position, rng.choice(60, n, replace=False), 0.05))
    found = assess(solve(problem_of(robot, m, "position")))
    assert [fit.verdict for fit in found.fit.goodness.kinds] == ["both"]
    assert not found.fit.goodness.spoilt


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("error", [lambda _, q: 1e-3 * q, lambda _, q: 1e-3 * np.cos(q)], ids=["gain", "eccentric"])
def test_what_is_not_modelled_is_no_outlier(error, k):
    robot, m = measured("6R", np.random.default_rng(k), effect=of_joint(k, error))
    solution = solve(problem_of(robot, m, "pose"))
    found = assess(solution)
    assert not {fit.verdict for fit in found.fit.goodness.kinds} & {"outliers", "others"}
    assert not found.fit.goodness.spoilt
    assert "loss: gnc" not in format_report(solution, found)
