"""Multi-start: other local optima, found by descents from other starts and from mirrored landmarks.

Measurements may see a combination of parameters only by its square: distances see a small offset across an axis so, and
+5 mm and -5 mm predict the same. A square shows itself: its sigma falls with the distance from its vertex. So
directions whose sigma is smaller at the estimate than at nominal start again from the mirror image about the vertex;
directions that stay weak start again from 2 prior sigmas to either side. Planes and anchors start again from their
mirror images, one after the other from the best optimum so far, if these explain the data nearly as well with the
nominal arm. The best optimum is kept; those that chi-square cannot distinguish from it are reported in
`Solution.others`. Error curves are taken as they were found: they have no other optima of their own.

Note:
    Pairs whose sign is ambiguous within the priors are not searched: the verdict names them (see `verdict`).
"""

from dataclasses import replace
from operator import attrgetter

import numpy as np

from fg_calib import graph
from fg_calib.graph import SIGNAL_FLOOR, Problem, Solution, SolverOptions, directions, solve
from fg_calib.inputs import CalibrationError, Floats, checked
from fg_calib.measurements import Kind
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import forward
from fg_calib.statistics import spread_of

WEAK_SIGNAL_TO_NOISE = 2.0
"""A direction of a smaller signal-to-noise ratio, priors included, is weak: its sigma is above half its prior sigma."""

SQUARE_SIGMA_RATIO = 0.7
"""Sigma at the estimate over sigma at nominal, below which a direction is seen by a square, or nearly so."""

START_SIGMAS = 2.0
"""Distance of other starts, in prior sigmas, or in posterior sigmas where these are larger."""

SEPARATE_SIGMAS = 3.0
"""Optima are two where some parameter of the robot differs by more than this many sigma."""

CHI2_INDISTINCT = 10.8276
"""The 99.9 % point of chi-square with one degree of freedom: a smaller difference of chi-square decides nothing."""

MAX_MIRROR_COST = 10.0
"""Cost of a mirrored landmark with the nominal arm, over that of the given start, beyond which it is no alternative."""

LEAST_GAIN = 0.01
"""Cost by which another optimum must be lower to count as better."""

MOST_ITERATIONS = 50
"""Of a descent from another start: a second optimum of a plausible arm is nearer."""

MAX_ROWS = 20_000
"""Residuals beyond which weak directions are not searched: a descent takes seconds, and so many rows leave few weak."""


@checked
def multistart(solution: Solution) -> Solution:
    """The best optimum that a solution and descents from other starts find.

    Args:
        solution: The solution of the descent from nominal.

    Returns:
        The solution of least cost, with `others` that data and priors cannot distinguish from it; the given solution
        where nothing is weak, seen by a square or mirrored, where it has not converged or nothing was calibrated.
    """
    if solution.problem.evaluated or not solution.converged:
        return solution
    if solution.problem.variables.n_curves:
        problem = graph.with_curves_held(solution.problem, solution.parameters)
        cost = problem.system.cost
        held = multistart(replace(solution, problem=problem, cost=cost, weighted_cost=cost))
        if np.array_equal(held.parameters, solution.parameters):
            return replace(solution, others=held.others, seconds=held.seconds)
        return min(solution, *_solve_from(solution, solution.problem, held.parameters), key=_objective)
    found = [solution]
    with one_blas_thread:
        starts = [solution.problem.variables.moved(solution.parameters, step) for step in _steps(solution)]
    for start in starts:
        found += _solve_from(solution, solution.problem, start)
    for landmark in _mirrored_landmarks(solution.problem) if solution.problem.options.loss == "none" else ():
        mirrored = _mirrored(min(found, key=_objective), landmark)
        if mirrored is not None and mirrored.system.cost < MAX_MIRROR_COST * solution.initial_cost:
            found += _solve_from(solution, mirrored)
    best, others = min(found, key=_objective), list[Solution]()
    kept = best if solution.objective - best.objective > LEAST_GAIN else solution
    for one in found:
        indistinct = 2.0 * (one.objective - kept.objective) < CHI2_INDISTINCT
        if indistinct and _is_an_arm(one, kept) and all(_apart(one, other) for other in (kept, *others)):
            others.append(one)
    return replace(kept, others=tuple(one.parameters for one in others), seconds=sum(one.seconds for one in found))


_objective = attrgetter("objective")


def _solve_from(solution: Solution, problem: Problem, start: Floats | None = None) -> list[Solution]:
    """The optimum from another start, as a later stage of a solution; none where there is no solution from there."""
    options = SolverOptions(MOST_ITERATIONS) if problem.options.loss == "none" else None  # weights take hundreds
    problem = replace(problem, state=replace(problem.state, weights=None))
    try:
        other = solve(problem, options, start=start)
    except CalibrationError:  # says nothing against the first
        return []
    other = replace(other, before=solution.before, initial_cost=solution.initial_cost) if start is not None else other
    return [replace(other, estimated_noise=solution.estimated_noise)] if other.converged else []


def _steps(solution: Solution) -> list[Floats]:
    """Steps from the estimate to other starts, shape (n_columns,) each."""
    problem, variables = solution.problem, solution.problem.variables
    scales, steps = variables.prior_scales, list[Floats]()
    nominal, robot = solution.before.copy(), problem.robot
    known = np.array([p.tolerance is not None for p in robot.parameters])
    nominal[variables.robot_span][known] = robot.nominal[known]
    s, V = directions(problem, solution.parameters)
    s_nominal, V_nominal = directions(problem, nominal)
    ratio = np.linalg.norm((V.T @ V_nominal) / np.maximum(s, SIGNAL_FLOOR)[:, None], axis=0)
    ratio *= np.maximum(s_nominal, SIGNAL_FLOOR)  # 1 of what is linear, less the farther a square is from its vertex
    moved = V_nominal.T @ (variables.step(nominal, solution.parameters)[: len(scales)] / scales)
    square = (ratio < SQUARE_SIGMA_RATIO) & (np.abs(moved) > SIGNAL_FLOOR)
    if square.any():
        steps.append(-2.0 * scales * (V_nominal[:, square] @ (moved[square] / (1.0 - ratio[square]))))
    weak = (s < WEAK_SIGNAL_TO_NOISE) & (s > SIGNAL_FLOOR)
    if weak.any() and problem.n_residuals <= MAX_ROWS:
        # The same signs and lengths whatever basis the weak directions have.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], len(scales))
        step = scales * (V[:, weak] @ (START_SIGMAS / np.minimum(s[weak], 1.0) * (V[:, weak].T @ signs)))
        longest = variables.scales[: len(scales)] / SIGNAL_FLOOR  # 1 rad, or the reach of the arm
        step /= max(1.0, float(np.max(np.abs(step) / longest)))
        steps += [step, -step]
    return steps


def _is_an_arm(other: Solution, best: Solution) -> bool:
    """Whether an optimum is a possible arm: with angles a radian away it is the same arm in other words, or none."""
    angles = [p.unit == "rad" for p in best.problem.robot.parameters]
    return bool(np.all(np.abs((other.parameters - best.parameters)[best.problem.variables.robot_span][angles]) < 1.0))


def _apart(a: Solution, b: Solution) -> bool:
    """Whether the robots of two solutions differ by more than the sigma at either, in some column."""
    variables, eye = a.problem.variables, np.eye(a.problem.variables.n_columns)
    step = np.abs(variables.step(a.parameters, b.parameters)[: len(eye)])
    variance = np.maximum(*(spread_of(one).variance(eye) for one in (a, b)))  # nan where nothing determines it
    return bool(np.any((step > SEPARATE_SIGMAS * np.sqrt(variance))[: variables.n_robot_columns]))


def _mirrored_landmarks(problem: Problem) -> list[tuple[int, ...]]:
    """Coordinates of the landmarks that may have mirror images: estimated ones that nothing was in contact with."""
    found, touched = dict[tuple[int, ...], None](), set[int]()
    for s in problem.data.blocks:
        each = np.unique(s.nuisances[s.train], axis=0)
        if s.kind.is_contact:
            touched |= set(each.ravel().tolist())
        elif type(s.kind).mirrored is not Kind.mirrored:
            found |= dict.fromkeys(map(tuple, each.tolist()))
    estimated = problem.variables.coordinates >= 0
    return [key for key in found if estimated[list(key)].any() and not touched & set(key)]


def _mirrored(solution: Solution, landmark: tuple[int, ...]) -> Problem | None:
    """The problem with one landmark mirrored and the arm at nominal; None where it has no mirror image."""
    problem, at, key = solution.problem, solution.problem.variables.at(solution.parameters), np.array(landmark)
    points, data, variables = list[Floats](), list[Floats](), problem.variables
    for s in problem.data.blocks:
        if s.nuisances.shape[1] == len(key) and type(s.kind).mirrored is not Kind.mirrored:
            kind, rows = s.kind, s.train[np.all(s.nuisances[s.train] == key, axis=1)]
            trig = problem.data.trigs(problem.robot)[s.table]
            points.append(forward(at.chains[s.table].without_columns(), trig, s.ends[rows, 0]).position)
            data.append(s.data[rows])
    image = kind.mirrored(np.concatenate(points), np.concatenate(data), at.coordinates[key])
    if image is None:
        return None
    places, start, others = variables.coordinates[key], solution.before.copy(), variables.others.copy()
    start[places[places >= 0]], others[key[places < 0]] = image[places >= 0], image[places < 0]
    unknowns = problem.data.landmarks
    known = np.unique(unknowns.owners[key[places < 0]]).tolist()  # what is not estimated of it
    unknowns = unknowns.with_starts({i: others[unknowns.span(i)] for i in known})
    there, whole = replace(problem.data, landmarks=unknowns), problem.whole
    if whole is not None:
        whole = replace(whole, data=there, variables=replace(whole.variables, others=others))
    return graph.with_factors(problem, start, data=there, variables=replace(variables, others=others), whole=whole)
