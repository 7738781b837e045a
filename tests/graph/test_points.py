"""Touched points: the same optimum as group means, nothing drifts, sigmas hold, and every misuse is one line."""

import csv
import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
import yaml
from oracle import central_differences, tool_pose
from reported import result_document
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2
from simulated import small_arm, true_robot
from tolerances import NEGLIGIBLE, rounding, sigmas_apart
from touches import SIGMA, TOLERANCE, TOOL_POINT, corners, touch

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.normal_system import eliminate
from fg_calib.graph.problem import linear_system, named_triangle
from fg_calib.graph.robust import tuning, weight
from fg_calib.graph.solver import solve
from fg_calib.graph.variables import prior_rows
from fg_calib.inputs import InputError, ProblemError
from fg_calib.io import write_robot
from fg_calib.io.tables import read_measurements
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Groups, Noise, Pairs, no_pairs
from fg_calib.observability.identifiability import observability_of
from fg_calib.robot.kinematics import pose
from fg_calib.statistics.variance_components import estimate_noise

RIGID = ("a1", "alpha1", "d1", "theta1")
"""Parameters of the small arm that move it as one body; two more motions of the base are none of its parameters."""


def all_pairs(m):
    """The same touches as pairs: every pair of a group, with sigma sqrt(n) times that of a touch."""
    index, a, b = m.groups.index, [], []
    for g in range(m.groups.n_groups):
        rows = np.flatnonzero((index == g) & ~m.test)
        i, j = np.triu_indices(len(rows), 1)
        a.append(rows[i])
        b.append(rows[j])
    a, b = np.concatenate(a), np.concatenate(b)
    n = np.bincount(index[~m.test], minlength=m.groups.n_groups)[index[a]]
    nothing = np.full(len(a), np.nan)
    sigma = np.sqrt(n) * m.sigma_point[a]
    pairs = Pairs(a, b, np.zeros(len(a)), nothing, sigma, nothing, np.zeros(len(a), dtype=bool))
    return replace(m, groups=None, sigma_point=None, pairs=pairs)


def case(seed=0, *, n_points=4, n_each=12, tolerance=TOLERANCE, sigma=SIGMA, distances=((0, 1, 1e-4),), **more):
    """The nominal arm, the true one, the points, and touches of them."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=tolerance, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    points = corners(true, n_points, rng)
    return robot, true, points, touch(true, points, n_each, rng, sigma, distances, **more)


def build(robot, m, **more):
    return build_problem(robot, m, model="distance", **more)


# --- residuals and derivatives --------------------------------------------------------------------------------------


def test_residuals_are_those_of_4x4_products():
    robot, _, _, m = case()
    problem = build(robot, m)
    rng = np.random.default_rng(1)
    variables, parameters = problem.variables, problem.start + 0.01 * rng.normal(size=len(problem.start))
    fixed = [i for i, p in enumerate(robot.parameters) if not p.estimated]
    parameters[fixed] = robot.nominal[fixed]
    points = parameters[variables.nuisance_span].reshape(-1, 3)
    there = robot.with_values(parameters[variables.robot_span])
    touches, between = (rows.linearise(variables.at(parameters))[0] for rows in problem.rows)
    for g in range(4):
        rows = np.flatnonzero(m.groups.index == g)
        tools = [tool_pose(there, q) for q in m.readings[rows]]
        expected = [(T[:3, 3] - points[g]) / SIGMA for T in tools]
        assert touches.reshape(-1, 3)[rows] == pytest.approx(np.array(expected), abs=1e-8 / SIGMA)
    d = np.linalg.norm(points[1] - points[0])
    expected = (d - m.groups.pairs.distance[0]) / 1e-4
    assert between == pytest.approx([expected], rel=rounding(1, 10))


@pytest.mark.slow
def test_derivatives_are_central_differences_up_to_a_turn_of_the_residuals():
    robot, _, _, m = case()
    problem = build(robot, m)
    variables = problem.variables
    rng = np.random.default_rng(2)
    n = variables.n_columns + variables.n_nuisance
    parameters = variables.moved(problem.start, 1e-2 * rng.normal(size=n))
    for rows, on_core in zip(problem.rows, (True, False), strict=True):

        def residual(step, rows=rows):
            at = variables.at(variables.moved(parameters, step))
            return rows.linearise(at.without_columns())[0]

        r, J = rows.linearise(variables.at(parameters))
        assert r == pytest.approx(residual(np.zeros(n)), rel=rounding(1, 10))
        assert J.shape == (rows.n_rows, n)
        h, size = 1e-6, np.abs(J).max()
        for column in range(n):
            step = np.zeros(n)
            step[column] = h
            numeric = (residual(step) - residual(-step)) / (2 * h)
            if column >= variables.n_columns or not on_core:
                assert J[:, column] == pytest.approx(numeric, abs=1e-6 * size)
            assert r @ J[:, column] == pytest.approx(r @ numeric, abs=1e-6 * size * np.linalg.norm(r))
            turned, vectors = (v.reshape(-1, 3) for v in (numeric - J[:, column], r)) if on_core else ([[0.0] * 3],) * 2
            M = np.vstack([np.cross(np.eye(3), v).T for v in vectors])  # a x v of each, as columns of a
            left = np.ravel(turned) - M @ np.linalg.lstsq(M, np.ravel(turned), rcond=None)[0]
            assert left == pytest.approx(0.0, abs=1e-6 * size)


def test_the_graph_holds_a_point_a_group_and_has_the_cost_of_its_rows():
    robot, _, points, m = case()
    problem = build(robot, m)
    keys = set(problem.graph.keys())
    assert {gtsam.symbol("L", g) for g in range(4)} <= keys
    assert problem.variables.describe(gtsam.symbol("L", 2)) == "L(2) (point)"
    solution = solve(problem)
    # In the base frame, which the noise of the arm's own place (2 mm and mrad priors, 1 m away) blurs.
    for g in range(4):
        assert solution.values.atPoint3(gtsam.symbol("L", g)) == pytest.approx(points[g], abs=0.05)
    at = problem.variables.at(solution.parameters)
    r = [rows.linearise(at)[0] for rows in solution.problem.rows]
    r.append(prior_rows(problem.variables, solution.parameters)[0])
    assert solution.cost == pytest.approx(0.5 * np.sum(np.concatenate(r) ** 2), rel=rounding(1, 1e3))


def test_elimination_leaves_what_the_other_columns_do_not_explain():
    rng = np.random.default_rng(3)
    A, b = rng.normal(size=(30, 9)), rng.normal(size=30)
    A[:, 2] = A[:, 5:] @ [1.0, 2.0, 3.0, 4.0]
    left = eliminate(A, b, 5)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    x_core = np.linalg.lstsq(left.A, left.b, rcond=None)[0]
    assert np.all(left.A[:, 2] == 0.0)
    assert np.linalg.norm(left.A @ x_core - left.b) == pytest.approx(np.linalg.norm(A @ x - b), rel=rounding(1, 10))
    assert np.hypot(np.linalg.norm(left.own), np.linalg.norm(left.A @ x_core)) == pytest.approx(np.linalg.norm(A @ x))
    keep = [0, 1, 3, 4]
    whole = np.linalg.inv(A[:, [*keep, *range(5, 9)]].T @ A[:, [*keep, *range(5, 9)]])
    core = np.linalg.inv(left.A[:, keep].T @ left.A[:, keep])
    follow = left.follow[:, keep]
    assert core == pytest.approx(whole[:4, :4], rel=rounding(1, 10))
    assert follow @ core @ follow.T + left.inverse @ left.inverse.T == pytest.approx(whole[4:, 4:], rel=rounding(1, 10))


# --- the optimum ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_optimum_is_that_of_group_means():
    robot, _, _, m = case(distances=())
    solution = solve(build(robot, m))
    chosen = [i for i, p in enumerate(robot.parameters) if p.estimated]
    tolerance = np.array([robot.parameters[i].tolerance for i in chosen])
    index = m.groups.index

    def rows(x):
        values = robot.nominal.copy()
        values[chosen] += tolerance * x
        p = pose(robot.with_values(values), m.readings).position
        means = np.array([p[index == g].mean(axis=0) for g in range(4)])
        return np.concatenate([((p - means[index]) / SIGMA).ravel(), x])

    found = least_squares(rows, np.zeros(len(chosen)), "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert solution.converged
    # Differences by steps of 1e-5 sigma and rounding leave scipy some 1e-4 sigma from the optimum.
    assert solution.cost == pytest.approx(found.cost, rel=1e-8)
    assert solution.parameters[chosen] == pytest.approx(robot.nominal[chosen] + tolerance * found.x, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("gauge", ["prior", "none"])
def test_groups_are_all_their_pairs(gauge):
    robot, _, _, m = case(distances=())
    problem, by_pairs = build(robot, m, gauge=gauge), build(robot, all_pairs(m), gauge=gauge)
    solution, other = solve(problem), solve(by_pairs)
    assert solution.converged
    assert other.converged
    one, two = assess(solution), assess(other)
    assert one.observability.rank == two.observability.rank
    assert one.observability.classes == two.observability.classes
    assert one.names == two.names
    # Residuals of 0.1 mm at lever arms of 1 m: derivatives differ by 1e-4 of themselves where they are turned, which
    # directions that are weakly determined magnify.
    known = np.array([p.sigma is not None for p in two.estimates.parameters])
    assert [p.sigma is not None for p in one.estimates.parameters] == list(known)
    a, b = (np.array([p.estimate for p in u.estimates.parameters])[known] for u in (one, two))
    sigma = np.array([p.sigma for p in two.estimates.parameters], dtype=float)[known]
    assert np.abs(a - b).max() <= 1e-2 * sigma.max()
    assert np.array([p.sigma for p in one.estimates.parameters], dtype=float)[known] == pytest.approx(sigma, rel=1e-2)


def test_without_noise_the_information_is_that_of_all_pairs():
    robot, true, _, m = case(sigma=0.0, distances=(), tolerance=None)
    grams = []
    for measured in (m, all_pairs(m)):
        problem = build(true, measured)
        J = named_triangle(problem, problem.start)
        grams.append(J.T @ J)
    assert robot.n_joints == 4
    assert grams[0] == pytest.approx(grams[1], abs=1e-8 * np.abs(grams[1]).max())


@pytest.mark.slow
@pytest.mark.parametrize("distances", [(), ((0, 1, 1e-4), (2, 3, 1e-4))])
def test_what_moves_arm_and_points_as_one_body_stays_where_it_is(distances):
    robot, _, points, m = case(distances=distances, tolerance=None)
    problem = build(robot, m)
    solution = solve(problem)
    assert solution.converged
    uncertainty = assess(solution)
    by_name = {p.name: p for p in uncertainty.estimates.parameters}
    for name in RIGID:
        assert abs(by_name[name].correction) < rounding(1, 1e4)  # without holding it they move by 0.1 mm and more
        assert by_name[name].sigma is None
        assert by_name[name].identifiability == "ineffective"
    assert all(np.isnan(p.sigma).all() for p in uncertainty.estimates.landmarks)
    # Another place to start the points from changes nothing.
    start = problem.start.copy()
    start[problem.variables.nuisance_span] += 0.01 * np.random.default_rng(4).normal(size=12)
    again = solve(replace(problem, start=start))
    span = problem.variables.robot_span
    apart = [
        abs(again.parameters[span][i] - p.estimate) / p.sigma
        for i, p in enumerate(uncertainty.estimates.parameters)
        if p.sigma
    ]
    assert max(apart) < 1e-3  # sigma; 1e-6 are left to go along each path, which turned derivatives make another
    for name in RIGID:
        assert abs(again.parameters[robot.index(name)] - robot.nominal[robot.index(name)]) < rounding(1, 1e4)
    assert len(points) == 4


def gradient(problem):
    """Of half the cost of the rows at the start, points at their best, in the core's columns."""
    at = problem.variables.at(problem.start)
    r, J = (np.concatenate(parts) for parts in zip(*(rows.linearise(at) for rows in problem.rows), strict=True))
    left = eliminate(J, r, problem.variables.n_columns)
    return left.A.T @ left.b


@pytest.mark.slow
def test_a_point_touched_once_tells_nothing_and_a_distance_holds_the_scale():
    robot, true, points, m = case(distances=(), tolerance=None)
    rng = np.random.default_rng(5)
    alone = touch(robot, np.vstack([points, points[0] + 0.1]), 1, rng)
    one_more = replace(
        m,
        readings=np.vstack([m.readings, alone.readings[-1:]]),
        ids=np.append(m.ids, "last"),
        test=np.append(m.test, False),
        sigma_point=np.append(m.sigma_point, SIGMA),
        groups=Groups((*m.groups.names, "once"), np.append(m.groups.index, 4), no_pairs("pairs.csv")),
    )
    # Which turn of all residuals together belongs to a column is free, and chosen by all touches: what depends on that
    # choice, the information, is compared where there are no residuals, and the gradient where there are.
    exact = replace(one_more, readings=np.vstack([case(tolerance=None, sigma=0.0)[3].readings, alone.readings[-1:]]))
    fewer = replace(exact, **{k: getattr(exact, k)[:-1] for k in ("readings", "ids", "test", "sigma_point")})
    fewer = replace(fewer, groups=m.groups)
    J, K = (named_triangle(p, p.start) for p in (build(true, x) for x in (fewer, exact)))
    assert K.T @ K == pytest.approx(J.T @ J, abs=1e-7 * np.abs(J.T @ J).max())
    f, g = (gradient(build(robot, x)) for x in (m, one_more))
    assert np.abs(f).max() > 0.0
    assert g == pytest.approx(f, abs=1e-7 * np.abs(f).max())
    assert build(robot, one_more).n_residuals == build(robot, m).n_residuals + 3
    a, b = (assess(solve(build(robot, x, prior=False))) for x in (m, one_more))
    assert a.fit.chi_square.dof == b.fit.chi_square.dof
    apart = [
        abs(p.estimate - q.estimate) / p.sigma
        for p, q in zip(a.estimates.parameters, b.estimates.parameters, strict=True)
        if p.sigma
    ]
    assert len(apart) > 5
    assert max(apart) < NEGLIGIBLE
    # Lengths of all links shrunk together satisfy any touches of one point: a direction of its own without distances.
    with_distance = replace(m, groups=replace(m.groups, pairs=case(tolerance=None)[3].groups.pairs))
    scale = observability_of(build(robot, m), build(robot, m).start)
    held = observability_of(build(robot, with_distance), build(robot, with_distance).start)
    assert held.rank >= scale.rank
    assert held.singular_values[: scale.rank].min() >= scale.singular_values[: scale.rank].min()


def test_joint_noise_widens_each_touch_to_first_order():
    robot, _, _, m = case()
    noisy = build(robot, replace(m, sigma_joint=np.full(4, 1e-3)))
    J = pose(robot.with_values(noisy.start[noisy.variables.robot_span]), m.readings[:1]).jacobian[0, 3:, -4:]
    S = SIGMA**2 * np.eye(3) + 1e-6 * J @ J.T
    W = residuals.unpack(noisy.rows[0].parts[0].block.whitening, 3)[0]
    assert W.T @ W == pytest.approx(np.linalg.inv(S), rel=rounding(1, 1e4), abs=1e-3)
    assert noisy.noises[0].sigma[0] == pytest.approx(np.sqrt(np.diag(S)), rel=rounding(1, 10), abs=0)


# --- robust losses, estimated joint values, estimated noise ---------------------------------------------------------

RHO = {
    "none": lambda e, c: e**2 / 2,
    "huber": lambda e, c: np.where(e < c, e**2 / 2, c * (e - c / 2)),
    "cauchy": lambda e, c: c**2 / 2 * np.log1p((e / c) ** 2),
    "geman-mcclure": lambda e, c: c**2 * e**2 / (c**2 + e**2) / 2,
}


class Everything:
    """All unknowns of touches as one vector, in tolerances and sigmas: parameters, points, joint values.

    Points count from the means of their touches, so that they hardly depend on the parameters.
    """

    def __init__(self, robot, m):
        self.robot, self.m = robot, m
        self.chosen = [i for i, p in enumerate(robot.parameters) if p.estimated]
        self.tolerance = np.array([robot.parameters[i].tolerance for i in self.chosen])
        self.joints = np.flatnonzero(m.sigma_joint)
        sizes = [len(self.chosen), 3 * m.groups.n_groups, len(self.joints) * len(m.readings)]
        self.parts = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])

    def arm(self, x):
        """The arm's values, the points, the tool points at the touches."""
        parameters, points, joints = (x[part] for part in self.parts)
        values, q, index = self.robot.nominal.copy(), self.m.readings.copy(), self.m.groups.index
        values[self.chosen] += self.tolerance * parameters
        q[:, self.joints] += self.m.sigma_joint[self.joints] * joints.reshape(len(q), -1)
        p = pose(self.robot.with_values(values), q).position
        means = np.array([p[index == g].mean(axis=0) for g in range(self.m.groups.n_groups)])
        return values, means + SIGMA * points.reshape(-1, 3), p

    def off(self, x):
        """Of touches, shape (n, 3), and of distances, shape (n, 1), in sigma."""
        m, (_, points, p), between = self.m, self.arm(x), self.m.groups.pairs
        d = np.linalg.norm(points[between.b] - points[between.a], axis=1) - between.distance
        return (p - points[m.groups.index]) / m.sigma_point[:, None], (d / between.sigma_distance)[:, None]

    def at(self, solution):
        """The vector of a solution without joint values."""
        values = solution.parameters[solution.problem.variables.robot_span]
        x = np.zeros(sum(map(len, self.parts)))
        x[self.parts[0]] = (values - self.robot.nominal)[self.chosen] / self.tolerance
        points = solution.parameters[solution.problem.variables.nuisance_span]
        x[self.parts[1]] = (points - self.arm(x)[1].ravel()) / SIGMA
        return x

    def rows(self, x, loss="none"):
        """Residuals whose sum of squares is twice the cost, priors among them."""
        found = []
        for r in self.off(x):
            e = np.maximum(np.linalg.norm(r, axis=1), 1e-300)
            found.append((np.sqrt(2 * RHO[loss](e, tuning(loss, r.shape[1]))) / e)[:, None] * r)
        return np.concatenate([*map(np.ravel, found), x[self.parts[0]], x[self.parts[2]]])

    def optimum(self, loss="none"):
        start = np.zeros(sum(map(len, self.parts)))
        found = least_squares(self.rows, start, "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12, args=(loss,))
        return found.x, found.cost


def sigmas_from(solution, values):
    """The largest difference from other parameters, in sigma."""
    parameters = assess(solution).estimates.parameters
    return max(abs(p.estimate - v) / p.sigma for p, v in zip(parameters, values, strict=True) if p.sigma)


def knocked(m, rows, rng, size=30.0):
    """The same with gross errors of some touches: joint readings that put the tool up to `size` sigma elsewhere."""
    readings = m.readings.copy()
    readings[rows] += size * SIGMA * rng.uniform(-1, 1, (len(rows), readings.shape[1]))
    return replace(m, readings=readings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "loss", ["huber", *(pytest.param(w, marks=pytest.mark.slow) for w in ("cauchy", "geman-mcclure"))]
)
def test_the_robust_optimum_is_that_of_the_loss_over_arm_and_points(loss):
    robot, _, _, m = case(distances=((0, 1, 1e-4), (2, 3, 1e-4)))
    m = knocked(m, [1, 14, 30], np.random.default_rng(7))
    everything = Everything(robot, m)
    solution, (best, cost) = solve(build(robot, m, loss=loss)), everything.optimum(loss)
    assert solution.converged
    # Differences by steps and rounding leave scipy some 1e-4 sigma from the optimum.
    assert sigmas_from(solution, everything.arm(best)[0]) < 1e-3
    x = everything.at(solution)
    assert 0.5 * np.sum(everything.rows(x, loss) ** 2) == pytest.approx(cost, rel=1e-8)
    e = np.linalg.norm(everything.off(x)[0], axis=1)
    weights = solution.problem.state.weights
    assert [len(w) for w in weights] == [48, 2]
    assert weights[0] == pytest.approx(weight(loss, e, tuning(loss, 3)), abs=1e-5)
    assert np.max(weights[0][[1, 14, 30]]) < 0.5 < np.median(weights[0])


@pytest.mark.slow
def test_descents_end_where_rounding_alone_changes_weights_and_joint_values():
    """Rows whitened anew, again and again, came back to themselves only after three rounds, without end."""
    robot, _, _, m = case(n_points=6, n_each=8)
    noise = 1e-4 * np.random.default_rng(9).normal(size=m.readings.shape)
    m = replace(m, readings=m.readings + noise, sigma_joint=np.full(4, 1e-4))
    solution = solve(build(robot, m, encoder="estimated", loss="cauchy"))
    assert solution.converged
    assert solution.iterations < 50


@pytest.mark.slow
def test_gnc_drops_wrong_touches_and_comes_near_the_clean_fit():
    robot, true, _, m = case()
    rng, wrong = np.random.default_rng(8), np.arange(0, 48, 6)
    clean = assess(solve(build(robot, m)))
    spoiled = knocked(m, wrong, rng, 1000.0)
    solution = solve(build(robot, spoiled, loss="gnc"))
    assert solution.converged
    weights = solution.problem.state.weights[0]
    assert np.all(weights[wrong] == 0.0)
    assert np.sum(weights == 0.0) <= len(wrong) + 2
    # What is left is the clean fit of the others.
    others = np.flatnonzero(weights)
    few = replace(
        m,
        readings=m.readings[others],
        ids=m.ids[others],
        test=m.test[others],
        sigma_point=m.sigma_point[others],
        groups=replace(m.groups, index=m.groups.index[others]),
    )
    assert sigmas_from(solution, solve(build(robot, few)).parameters[solution.problem.variables.robot_span]) < 1e-4
    off = [
        (assess(s).robot.nominal - true.nominal)[[robot.index(n) for n in clean.names]]
        for s in (solution, solve(build(robot, spoiled)))
    ]
    by = np.sqrt(np.diag(clean.covariance))
    assert np.max(np.abs(off[0] / by)) < 5.0 < np.max(np.abs(off[1] / by))


@pytest.mark.slow
@pytest.mark.parametrize("distances", [(), ((0, 1, 1e-4), (2, 3, 1e-4))])
def test_estimated_joint_values_give_the_optimum_over_arm_points_and_joint_values(distances):
    robot, _, _, m = case(n_each=5, distances=distances)
    noise = 2e-3 * np.random.default_rng(9).normal(size=m.readings.shape)
    m = replace(m, readings=m.readings + noise, sigma_joint=np.full(4, 2e-3))
    everything = Everything(robot, m)
    best, cost = everything.optimum()
    values, points, _ = everything.arm(best)
    solution = solve(build(robot, m, encoder="estimated"))
    assert solution.converged
    assert sigmas_from(solution, values) < 1e-3
    assert 2.0 * solution.cost == pytest.approx(2.0 * cost, rel=1e-6)
    uncertainty = assess(solution)
    for p, xyz in zip(uncertainty.estimates.landmarks, points, strict=True):
        assert sigmas_apart(p.xyz, xyz, p.sigma) < 1e-3
    assert uncertainty.estimates.joint_errors.error.ravel() / 2e-3 == pytest.approx(best[everything.parts[2]], abs=1e-3)
    # Sigmas are those of all unknowns together; turned residuals, 0.1 mm at 1 m, have derivatives that differ by 1e-4.
    J = central_differences(everything.rows, best, 1e-3)
    sigma = everything.tolerance * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[everything.parts[0]]
    found = [uncertainty.estimates.parameters[i].sigma for i in everything.chosen]
    known = [(a, b) for a, b in zip(found, sigma, strict=True) if a]
    assert len(known) > 5
    assert [a for a, _ in known] == pytest.approx([b for _, b in known], rel=1e-2)
    propagated = solve(build(robot, m))
    assert 1e-3 < sigmas_from(propagated, values) < 0.5  # the same to first order only


@pytest.mark.slow
def test_estimated_noise_of_touches_is_the_most_likely_one():
    """Restricted maximum likelihood of both factors, by Nelder-Mead on a dense linear model."""
    pairs = tuple((a, b, 1e-4) for a in range(5) for b in range(a))
    robot, _, _, m = case(n_points=5, distances=pairs)
    between = m.groups.pairs
    m = replace(
        m,
        sigma_point=m.sigma_point / 3.0,
        groups=replace(m.groups, pairs=replace(between, sigma_distance=2.0 * between.sigma_distance)),
    )
    solution = estimate_noise(build(robot, m))
    assert solution.converged
    assert set(solution.estimated_noise) == {(0, "point"), (0, "distance")}
    found = solution.problem.state.factors
    everything = Everything(robot, m)
    x = everything.at(solution)
    J = central_differences(everything.rows, x, 1e-3)
    r = everything.rows(x)
    n = [3 * len(m.readings), between.n_pairs, len(everything.chosen)]

    def unlikely(factors):
        by = np.repeat([*factors, 0.0], n)
        A, b = J * np.exp(-by)[:, None], r * np.exp(-by)
        left = b - A @ np.linalg.lstsq(A, b, rcond=1e-12)[0]
        return 2.0 * by.sum() + np.linalg.slogdet(A.T @ A)[1] + left @ left

    likely = minimize(unlikely, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10}).x
    # Derivatives of turned residuals, 0.1 mm at 1 m, differ from those of residuals by 1e-4 of themselves.
    assert np.log([found[0, "point"], found[0, "distance"]]) == pytest.approx(likely, abs=1e-3)
    assert found[0, "point"] == pytest.approx(3.0, rel=4 / np.sqrt(2 * 3 * 60))


@pytest.mark.slow
def test_touches_and_pairs_share_the_joint_noise_of_their_configurations():
    """Their rows are whitened by the covariance of all of them together, formed densely."""
    robot, true, _, m = case(distances=())
    a, b = np.arange(0, 12), np.arange(12, 24)
    noise = SIGMA * np.random.default_rng(11).normal(size=12)
    distance = np.linalg.norm(np.subtract(*(pose(true, m.readings[k]).position for k in (b, a))), axis=1) + noise
    nothing = np.full(12, np.nan)
    pairs = Pairs(a, b, distance, nothing, np.full(12, SIGMA), nothing, np.zeros(12, dtype=bool))
    problem = build(robot, replace(m, pairs=pairs, sigma_joint=np.full(4, 2e-4)))
    variables = problem.variables
    there = robot.with_values(problem.start[variables.robot_span])
    points = problem.start[variables.nuisance_span].reshape(-1, 3)

    def rows(z):
        p = pose(there, m.readings + 2e-4 * z.reshape(-1, 4)).position
        length = np.linalg.norm(p[b] - p[a], axis=1) - distance
        return np.concatenate([length, (p - points[m.groups.index]).ravel()])

    r, L = rows(np.zeros(192)), central_differences(rows, np.zeros(192), 1e-3)
    C = SIGMA**2 * np.eye(156) + L @ L.T
    by_kind = {n.series.kind.residual_dim: n for n in problem.noises}
    assert len(problem.rows) == 1
    found = problem.rows[0].squared_norm(variables.at(problem.start))
    # Noise also lengthens pairs, which changes their residuals and, in the second order, their variance.
    r[:12] = by_kind[1].residual()[:, 0]
    assert found == pytest.approx(r @ np.linalg.solve(C, r), rel=1e-4)
    alone = [n.residual().ravel() @ np.linalg.solve(c, n.residual().ravel()) for n, c in (
        (by_kind[1], C[:12, :12]), (by_kind[3], C[12:, 12:]))]  # fmt: skip
    assert abs(sum(alone) - found) > 1e-3 * found  # as independent they would say something else


# --- what is claimed ------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize("options", [{}, {"encoder": "estimated"}, {"loss": "huber"}], ids=str)
def test_errors_are_as_large_as_the_sigmas_say(options):
    runs, nees, z, z_points, fits = 40, [], [], [], []
    for seed in range(runs):
        robot, true, points, m = case(seed + 100, n_points=3, n_each=8)
        if options.get("encoder"):
            noise = 1e-3 * np.random.default_rng(seed).normal(size=m.readings.shape)
            m = replace(m, readings=m.readings + noise, sigma_joint=np.full(4, 1e-3))
        solution = solve(build(robot, m, **options))
        uncertainty = assess(solution)
        assert solution.converged
        error = np.array(
            [uncertainty.robot.nominal[robot.index(n)] - true.nominal[robot.index(n)] for n in uncertainty.names]
        )
        nees.append(error @ np.linalg.solve(uncertainty.covariance, error))
        z.append(error / np.sqrt(np.diag(uncertainty.covariance)))
        z_points.append(
            [(p.xyz - truth) / p.sigma for p, truth in zip(uncertainty.estimates.landmarks, points, strict=True)]
        )
        fits.append((uncertainty.fit.chi_square.value, uncertainty.fit.chi_square.expected))
    n = len(uncertainty.names)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs * n) / runs
    assert low <= np.mean(nees) <= high
    # 760 and 360 figures, those of one run correlated: 68.3 % within 1 sigma, give or take four times 2 and 3 %.
    assert np.mean(np.abs(z) < 1.0) == pytest.approx(0.683, abs=0.08)
    assert np.mean(np.abs(z_points) < 1.0) == pytest.approx(0.683, abs=0.12)
    total, dof = np.sum(fits, axis=0)
    if options.get("loss"):  # its mean is known roughly only, as with other measurements
        assert total / dof == pytest.approx(1.0, abs=0.2)
    else:
        assert chi2.ppf(1e-4, dof) <= total <= chi2.ppf(1 - 1e-4, dof)


@pytest.mark.slow
def test_degrees_of_freedom_count_the_points():
    robot, _, _, m = case()
    problem = build(robot, m)
    uncertainty = assess(solve(problem))
    assert problem.n_residuals == 3 * 48 + 1
    assert uncertainty.fit.chi_square.dof == 145 + problem.n_priors - problem.variables.n_columns - 12
    assert linear_system(problem, problem.start).left.A.shape[1] == problem.variables.n_columns


@pytest.mark.slow
def test_test_groups_are_predicted_and_of_mixed_ones_the_train_rows_fitted():
    robot, _, _, m = case(distances=((0, 1, 1e-4), (0, 3, 1e-4)), test=(3,))
    m = replace(m, test=m.test | (np.arange(len(m.test)) == 0))  # a row of group 0
    problem = build(robot, m)
    solution = solve(problem)
    uncertainty = assess(solution)
    assert problem.n_residuals == 3 * 35 + 1
    assert [v.symbol for v in problem.variables.nuisance] == ["L(0)", "L(1)", "L(2)"]
    assert [(p.name, p.n) for p in uncertainty.estimates.landmarks] == [("g0", 11), ("g1", 12), ("g2", 12), ("g3", 0)]
    assert np.isnan(uncertainty.estimates.landmarks[3].sigma).all()
    table = uncertainty.fit.residuals
    touches = np.char.startswith(table.kind, "point")
    assert np.sum(table.test & touches) == 3 * 13
    distances = np.flatnonzero(table.kind == "distance")
    assert table.test[distances].tolist() == [False, True]
    p = pose(uncertainty.robot, m.readings).position
    d = m.groups.pairs.distance
    means = [p[1:12].mean(axis=0), *(p[12 * g : 12 * (g + 1)].mean(axis=0) for g in (1, 2, 3))]
    # The distance draws its two points along their line, against the pull of 11 and 12 touches.
    along, pull = means[1] - means[0], (SIGMA / 1e-4) ** 2
    off = pull * (1.0 - d[0] / np.linalg.norm(along)) / (1.0 + pull * (1 / 11 + 1 / 12))
    means[0], means[1] = means[0] + off / 11 * along, means[1] - off / 12 * along
    expected = np.array([p[k] - means[g] for k, g in enumerate(m.groups.index)])
    assert table.after[touches] == pytest.approx(expected.ravel(), abs=rounding(1, 1e3))
    miss = [np.linalg.norm(means[g] - means[0]) - d[i] for i, g in enumerate((1, 3))]
    assert table.after[distances] == pytest.approx(miss, abs=rounding(1, 1e3))
    rms = table.rms()
    assert rms["test"]["point"]["after"] == pytest.approx(
        np.sqrt(np.mean(np.sum(expected[m.test] ** 2, axis=1))), rel=1e-6
    )
    assert rms["train"]["point"]["after"] < 0.2 * rms["train"]["point"]["before"]
    groups = result_document(solution, uncertainty)["groups"]
    assert groups[3]["sigma"] == [None, None, None]
    assert [g["n"] for g in groups] == [11, 12, 12, 0]


@pytest.mark.slow
def test_a_distance_to_a_point_of_test_rows_alone_is_a_test_row_whatever_is_said():
    robot, _, _, m = case(distances=((0, 1, 1e-4), (0, 3, 1e-4)), test=(3,))
    stated = replace(m, groups=replace(m.groups, pairs=replace(m.groups.pairs, test=np.zeros(2, dtype=bool))))
    a, b = (solve(build(robot, x)) for x in (m, stated))
    assert np.array_equal(a.parameters, b.parameters)
    assert np.array_equal(assess(a).fit.residuals.after, assess(b).fit.residuals.after)
    assert assess(b).fit.residuals.test[-2:].tolist() == [False, True]


@pytest.mark.slow
def test_groups_and_pairs_work_side_by_side():
    robot, true, _, m = case(distances=())
    rng = np.random.default_rng(6)
    a, b = np.arange(0, 12), np.arange(12, 24)
    p = pose(true, m.readings).position
    distance = np.linalg.norm(p[b] - p[a], axis=1) + 1e-4 * rng.normal(size=12)
    nothing = np.full(12, np.nan)
    pairs = Pairs(a, b, distance, nothing, np.full(12, 1e-4), nothing, np.zeros(12, dtype=bool))
    both = assess(solve(build(robot, replace(m, pairs=pairs))))
    alone = assess(solve(build(robot, m)))
    assert both.fit.chi_square.dof == alone.fit.chi_square.dof + 12
    assert both.trustworthy
    assert np.linalg.slogdet(both.covariance)[1] < np.linalg.slogdet(alone.covariance)[1]


@pytest.mark.slow
@pytest.mark.parametrize("gauge", ["keep", "none"])
def test_other_gauges_predict_the_same(gauge):
    # Tool and arm of ordinary errors; the rows between touches alone are predicted, whatever holds the rest.
    robot, _, _, m = case(tolerance=None, test=(3,))
    found = assess(solve(build(robot, m, gauge=gauge)))
    after = found.fit.residuals.rms()["test"]["point"]["after"]
    other = assess(solve(build(robot, m, gauge="keep" if gauge == "none" else "none")))
    assert after == pytest.approx(other.fit.residuals.rms()["test"]["point"]["after"], rel=1e-2)


# --- files ----------------------------------------------------------------------------------------------------------


POSES = "id,q1,q2,q3,q4,group,split\n"


def tables(folder, poses, pairs=None):
    (folder / "poses.csv").write_text(poses)
    if pairs is not None:
        (folder / "pairs.csv").write_text(pairs)
    return {"pairs": None if pairs is None else folder / "pairs.csv"}


ROWS = POSES + "p0,0,0,0,0,left,\np1,1,0,0,0,left,\np2,0,1,0,0,right,\np3,0,0,1,0,right,test\np4,0,0,1,1,,\n"


def test_the_column_group_and_pairs_of_groups_are_read(tmp_path):
    given = tables(tmp_path, ROWS, "a,b,distance\nleft,right,0.05\np0,p4,0.7\n")
    noise = Noise(distance=1e-3, point=2e-4)
    m = read_measurements(tmp_path / "poses.csv", small_arm(), noise=noise, **given)
    assert m.groups.names == ("left", "right")
    assert m.groups.index.tolist() == [0, 0, 1, 1, -1]
    assert m.sigma_point.tolist() == [2e-4] * 5
    assert (m.groups.pairs.a.tolist(), m.groups.pairs.b.tolist()) == ([0], [1])
    assert m.groups.pairs.distance.tolist() == [0.05]
    assert not m.groups.pairs.test.any()
    assert (m.pairs.a.tolist(), m.pairs.b.tolist(), m.pairs.distance.tolist()) == ([0], [4], [0.7])


def test_a_distance_to_a_group_of_test_rows_is_a_test_row(tmp_path):
    rows = ROWS.replace("p2,0,1,0,0,right,", "p2,0,1,0,0,right,test")
    given = tables(tmp_path, rows, "a,b,distance\nleft,right,0.05\n")
    m = read_measurements(tmp_path / "poses.csv", small_arm(), noise=Noise(distance=1e-3), **given)
    assert m.groups.pairs.test.tolist() == [True]


def test_sigmas_of_touches_are_read_and_needed_only_of_touches(tmp_path):
    rows = "q1,q2,q3,q4,group,sigma_point\n0,0,0,0,a,0.1\n1,0,0,0,a,0.2\n1,1,0,0,,\n"
    tables(tmp_path, rows)
    m = read_measurements(tmp_path / "poses.csv", small_arm())
    assert m.sigma_point[:2].tolist() == [0.1, 0.2]
    m = read_measurements(tmp_path / "poses.csv", small_arm(), noise=Noise(point=0.5))
    assert m.sigma_point.tolist() == [0.1, 0.2, 0.5]


def test_a_table_without_groups_has_none(tmp_path):
    tables(tmp_path, "q1,q2,q3,q4,group\n0,0,0,0,\n1,0,0,0,\n")
    m = read_measurements(tmp_path / "poses.csv", small_arm(), noise=Noise(point=1e-3))
    assert m.groups is None
    assert m.sigma_point is None


@pytest.mark.parametrize(
    ("rows", "pairs", "message"),
    [
        (
            ROWS.replace("p4", "left"),
            "a,b,distance\np0,left,0.1\n",
            "pairs.csv:2: b = 'left' is both an id and a group of poses.csv, expected different names",
        ),
        (
            ROWS.replace("id,", "name,").replace("right", "1"),
            "a,b,distance\n1,0,0.1\n",
            "pairs.csv:2: a = '1' is both a row and a group of poses.csv, expected different names",
        ),
        (
            ROWS,
            "a,b,distance\nleft,p0,0.1\n",
            "pairs.csv:2: a is a group and b a configuration, expected two configurations or two groups",
        ),
        (
            ROWS,
            "a,b,distance\np1,p0,0.1\np0,left,0.1\n",
            "pairs.csv:3: b is a group and a a configuration, expected two configurations or two groups",
        ),
        (ROWS, "a,b,distance\nleft,left,0.1\n", "pairs.csv:2: a and b are both 'left', expected two different groups"),
        (ROWS, "a,b,distance\nleft,middle,0.1\n", "pairs.csv:2: b = 'middle' is not an id or a group of poses.csv"),
        (
            ROWS,
            "a,b,distance,angle\nleft,right,0.1,0.2\n",
            "pairs.csv:2: angle: found '0.2', expected an empty cell: two points have a distance, but no angle",
        ),
        (ROWS, "a,b,angle\nleft,right,\n", "pairs.csv:2: two groups without a distance, expected a column distance"),
        (
            ROWS,
            "a,b,distance\nleft,right,\n",
            "pairs.csv:2: distance: found an empty cell, expected a number above 0 between two groups;"
            " one point is one group",
        ),
        (
            ROWS,
            "a,b,distance\nleft,right,0\n",
            "pairs.csv:2: distance: found '0', expected a number above 0 between two groups; one point is one group",
        ),
        (
            "q1,q2,q3,q4,group,sigma_point\n0,0,0,0,a,0.1\n1,0,0,0,a,\n",
            None,
            "poses.csv:3: sigma_point: found an empty cell, expected a number above 0",
        ),
        (
            "q1,q2,q3,q4,group,sigma_point\n0,0,0,0,a,0.1\n1,0,0,0,a,-1\n",
            None,
            "poses.csv:3: sigma_point: found '-1', expected a number above 0",
        ),
    ],
)
def test_misuse_in_a_table_is_one_line(tmp_path, rows, pairs, message):
    given = tables(tmp_path, rows, pairs)
    with pytest.raises(InputError) as error:
        read_measurements(tmp_path / "poses.csv", small_arm(), **given)
    assert str(error.value) == message


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("change", "model", "message"),
    [
        (
            {},
            "pose",
            "poses.csv: a column group with model pose, expected model distance or distance-rotation",
        ),
        (
            {},
            "rotation",
            "poses.csv: a column group with model rotation, expected model distance or distance-rotation",
        ),
        (
            {"sigma_point": None},
            "distance",
            "poses.csv: no sigma for touched points, expected noise.point or a column sigma_point",
        ),
    ],
)
def test_misuse_of_a_model_is_one_line(change, model, message):
    robot, _, _, m = case()
    with pytest.raises(ProblemError) as error:
        build_problem(robot, replace(m, **change), model=model)
    assert str(error.value) == message


def test_a_distance_between_groups_needs_a_sigma():
    robot, _, _, m = case()
    pairs = replace(m.groups.pairs, sigma_distance=np.array([np.nan]))
    with pytest.raises(ProblemError) as error:
        build(robot, replace(m, groups=replace(m.groups, pairs=pairs)))
    assert str(error.value) == "pairs.csv: no sigma for distance, expected noise.distance or a column sigma_distance"


def write_job(folder, seed=0, **job):
    """The small arm's case as files."""
    robot, _, _, m = case(seed, distances=((0, 1, 1e-4), (0, 3, 1e-4)), test=(3,))
    write_robot(folder / "robot.yaml", robot)
    names = ("q1", "q2", "q3", "q4")
    with (folder / "poses.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["id", *names, "group", "split"])
        for k, (q, g, t) in enumerate(zip(m.readings, m.groups.index, m.test, strict=True)):
            out.writerow([f"p{k}", *map(repr, q.tolist()), f"g{g}", "test" if t else "train"])
    d = m.groups.pairs.distance
    (folder / "pairs.csv").write_text(f"a,b,distance\ng0,g1,{d[0]}\ng0,g3,{d[1]}\n")
    content = {
        "robot": "robot.yaml",
        "measurements": "poses.csv",
        "pairs": "pairs.csv",
        "model": "distance",
        "noise": {"point": SIGMA, "distance": 1e-4},
    }
    (folder / "job.yaml").write_text(yaml.safe_dump({k: v for k, v in (content | job).items() if v is not None}))
    return folder / "job.yaml"


@pytest.mark.slow
def test_a_job_with_groups_runs_from_the_command_line(fg_calib, tmp_path):
    ended = fg_calib("calibrate", write_job(tmp_path), "--out", tmp_path / "out")
    assert (ended.code, ended.err) == (0, "")
    assert "ontact points" in ended.out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [g["name"] for g in result["groups"]] == ["g0", "g1", "g2", "g3"]
    assert all(s > 0 for g in result["groups"][:3] for s in g["sigma"])
    assert result["residual_rms"]["test"]["point"]["after"] < 4 * SIGMA
    assert (result["n_pairs"], result["n_configurations"]) == (0, 36)
    with (tmp_path / "out" / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["kind"] for r in rows[:3]] == ["point.x", "point.y", "point.z"]
    assert (rows[0]["a"], rows[0]["b"], rows[0]["unit"]) == ("p0", "", "m")
    last = rows[-1]
    assert (last["kind"], last["a"], last["b"], last["split"], last["unit"]) == ("distance", "g0", "g3", "test", "m")


@pytest.mark.slow
def test_a_job_of_touches_alone_needs_no_pairs_and_no_poses(fg_calib, tmp_path):
    ended = fg_calib("calibrate", write_job(tmp_path, pairs=None), "--json")
    assert ended.code == 0
    assert json.loads(ended.out)["pairing"] is None


@pytest.mark.slow
def test_compare_runs_every_estimator_on_touches(fg_calib, tmp_path):
    ended = fg_calib("compare", write_job(tmp_path), "--json")
    estimates = json.loads(ended.out)["estimates"]
    assert ended.code == 0
    assert [e["ran"] for e in estimates] == [True] * 5
    before = estimates[0]["residual_rms"]["train"]
    assert before["distance"] is not None


def test_a_job_without_the_noise_of_touches_is_one_line(fg_calib, tmp_path):
    ended = fg_calib("calibrate", write_job(tmp_path, noise={"distance": 1e-4}))
    assert ended.code == 1
    expected = "poses.csv: no sigma for touched points, expected noise.point or a column sigma_point"
    assert ended.err.splitlines() == [f"error: {expected}"] or ended.err.splitlines() == [expected]


@pytest.mark.slow
@pytest.mark.parametrize(
    "job",
    [
        {"loss": "gnc"},
        {"encoder": "estimated", "noise": {"point": SIGMA, "distance": 1e-4, "joint": 1e-4}},
        {"noise": "estimate"},
    ],
    ids=["loss", "encoder", "noise"],
)
def test_touched_points_take_losses_joint_values_and_estimated_noise_from_a_job(fg_calib, tmp_path, job):
    ended = fg_calib("calibrate", write_job(tmp_path, **job), "--json")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads(ended.out)
    assert result["solver"]["converged"]
    assert result["residual_rms"]["test"]["point"]["after"] < 4 * SIGMA
