"""The graph is the user's too: what somebody adds to a problem's graph is solved and assessed like our own.

A factor is added with `problem.graph.add(factor)`; a variable that it brings with it gets its start with
`problem.initial.insert(key, value)`. Such a variable is a *nuisance* variable (see `factors`), of any of GTSAM's types.
`expand` is the other way round: our rows as factors of one measurement each, for GTSAM's own tools.
"""

from __future__ import annotations

from itertools import chain
from numbers import Real

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import as_floats
from fg_calib.errors import CalibrationError, InputError, ProblemError, shown
from fg_calib.graph.factors import Variable, Variables, custom_factor, factor_columns, prior_factors, row_factor
from fg_calib.graph.problem import Problem, assembled, known_factors
from fg_calib.graph.rows import Part, RowSet
from fg_calib.measurements.kinds import Kind
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.measurements.residuals import Block
from fg_calib.options import check_number

Floats = NDArray[np.float64]
Sparse = scipy.sparse.csr_array


def with_added(problem: Problem) -> Problem:
    """The problem with what somebody added to its graph, and changed in its initial values, as a part of it.

    Raises:
        ProblemError: Factors were removed or replaced, an added variable has no start, or there is no factor of it.
    """
    more = _added_factors(problem)
    _check_initial(problem)
    if not more and problem.initial.equals(problem.variables.values(problem.start), 0.0):
        return problem
    if more and problem.whole is not None:
        raise ProblemError("problem.graph", "added factors with gauge keep", "gauge prior or none")
    for factor in more:
        _check_noise(factor)
    added = problem.added + more
    variables = problem.variables.without_own()
    own = gtsam.Values(problem.initial)
    for key in variables.keys:
        own.erase(key)
    theirs = set(chain.from_iterable(factor.keys() for factor in added)).difference(variables.keys)
    for key in sorted(theirs.symmetric_difference(own.keys())):
        symbol = str(gtsam.Symbol(key)).strip()
        if key in theirs:
            raise ProblemError("problem.initial", f"no value of {symbol}", "one for every variable of an added factor")
        raise ProblemError("problem.initial", f"a value of {symbol}", "none without a factor on it in problem.graph")
    for factor in more:
        _check_start(factor, problem.initial)
    variables = variables.with_own(own)
    start = variables.parameters(problem.initial)
    return assembled(problem, start, variables=variables, added=added)


def _check_initial(problem: Problem) -> None:
    """Check that every variable of the problem has an initial value, of its own type and size."""
    for v in problem.variables.without_own().items + problem.variables.without_own().nuisance:
        if not problem.initial.exists(v.key):
            raise ProblemError("problem.initial", f"no value of {v.symbol}", "one for every variable of the problem")
        expected = "a gtsam.Pose3" if v.is_pose else f"{len(v.parameters)} finite numbers"
        try:
            value = problem.initial.atPose3(v.key).matrix() if v.is_pose else problem.initial.atVector(v.key)
        except RuntimeError:
            raise ProblemError(f"problem.initial: {v.symbol}", "a value of another type", expected) from None
        if not v.is_pose and len(value) != len(v.parameters):
            raise ProblemError(f"problem.initial: {v.symbol}", f"{len(value)} numbers", expected)
        if not np.isfinite(value).all():
            raise ProblemError(f"problem.initial: {v.symbol}", "a number that is not finite", expected)


def _check_start(factor: gtsam.NonlinearFactor, initial: gtsam.Values) -> None:
    """Check that an added factor has an error where it starts, and a derivative that fits its variables."""
    symbols = ", ".join(str(gtsam.Symbol(key)).strip() for key in list(factor.keys()))
    place = f"problem.graph: added {type(factor).__name__} on {symbols}"
    try:
        error = factor.error(initial)
        factor.linearize(initial)
    except CalibrationError:
        raise
    except Exception as raised:
        raise ProblemError(place, f"raised {type(raised).__name__}: {raised}") from raised
    if not np.isfinite(error):
        raise ProblemError(place, f"an error of {error:g} at the initial values", "a finite one")


def _added_factors(problem: Problem) -> tuple[gtsam.NonlinearFactor, ...]:
    """The factors in a problem's graph that it was not made of."""
    graph, own = problem.graph, problem.factors
    n, n_own = graph.size(), own.size()
    kept = sum(graph.at(i) is own.at(i) for i in range(min(n, n_own)))
    if kept < n_own:
        raise ProblemError("problem.graph", f"{kept} of the problem's {n_own} factors", "all of them, in their places")
    return tuple(graph.at(i) for i in range(n_own, n))


def _check_noise(factor: gtsam.NonlinearFactor | None) -> None:
    """Raise for an added factor whose rows have no finite weight: nothing could be counted or whitened by them."""
    if factor is None:
        raise ProblemError("problem.graph", "None among its factors", "factors")
    model = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if model is None:
        expected = "one with a noise model, such as PriorFactorVector, BetweenFactorPose3 or CustomFactor"
        raise ProblemError("problem.graph", f"an added {type(factor).__name__}", expected)
    if model.isConstrained():
        expected = "sigmas above 0: a thousandth of what matters is as good as 0"
        raise ProblemError(
            "problem.graph", f"an added {type(factor).__name__} with a constrained noise model", expected
        )


def check_graph(problem: Problem) -> None:
    """Check that nothing was added to the graph of a problem that has been solved.

    Raises:
        ProblemError: Its graph has other factors than it was solved with.
    """
    n = len(_added_factors(problem))
    if n:
        raise ProblemError("solution.problem.graph", f"{n} factors added since it was solved", "to be solved again")


@checked
def DistanceFactor(  # noqa: N802 -- a factor of GTSAM's, by the name of one
    variables: Variables, start: ArrayLike, end: ArrayLike, distance: float, sigma: float
) -> gtsam.CustomFactor:
    """A distance that the tool point moved between two configurations, on a problem's variables.

    Args:
        variables: The variables, `problem.variables`.
        start: Joint readings of the first configuration, shape (n_joints,), [rad] (prismatic: [m]).
        end: Those of the second.
        distance: Measured, [m].
        sigma: Its 1 sigma, [m].

    Raises:
        InputError: The readings are of other joints, or a figure is none.
    """
    return _pair_factor(Distance(), variables, start, end, ("distance", distance), sigma)


@checked
def RotationAngleFactor(  # noqa: N802 -- a factor of GTSAM's, by the name of one
    variables: Variables, start: ArrayLike, end: ArrayLike, angle: float, sigma: float
) -> gtsam.CustomFactor:
    """An angle in [0, pi] that the tool turned between two configurations, [rad]; otherwise as `DistanceFactor`."""
    if isinstance(angle, Real) and angle > np.pi:
        raise InputError("angle", f"found {shown(angle)}", "0 to pi, in rad")
    return _pair_factor(RotationAngle(), variables, start, end, ("angle", angle), sigma)


def _pair_factor(
    kind: Kind, variables: Variables, start: ArrayLike, end: ArrayLike, measured: tuple[str, float], sigma: float
) -> gtsam.CustomFactor:
    check_number(*measured)
    check_number("sigma", sigma, above=True)
    n = variables.robot.n_joints
    readings = [as_floats(name, q, f"({n})") for name, q in (("start", start), ("end", end))]
    trig = variables.robot.trig(np.array(readings))
    data, whitening = np.array([[float(measured[1])]]), np.array([[1.0 / float(sigma)]])
    block = Block(kind, trig, np.array([[0, 1]]), data, whitening, np.zeros((1, 0)))
    return row_factor(RowSet((Part(block, 0, 0, np.zeros((1, 0), dtype=np.int64)),)), variables)


@checked
def expand(problem: Problem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A problem's graph with one factor a measurement, for inspection and for incremental optimisers, and its start.

    Measurements that share errors depend on these: variables `E(k)`, errors of configuration k in units of their
    sigma, with a prior of their own each. What somebody added to the graph is there.

    Note:
        Rows keep the weights that they have in the problem. Those of `solution.problem` are of the solution, so that
        the optimum is the solution; those of a problem that was not solved are of its start.

    Raises:
        ProblemError: Factors of the problem's graph are missing, or a variable has no start.
    """
    problem = with_added(problem)
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values(problem.initial)
    for rows in problem.rows:
        first = 0
        for part in rows.parts:
            residual_dim = part.block.residual_dim
            for k in range(part.block.n):
                place = first + k * residual_dim
                L = None if rows.shared is None else rows.shared.loadings[place : place + residual_dim]
                graph.add(_measurement_factor(problem, rows, part.only(k), L))
            first += part.n_rows
        width = 0 if rows.shared is None else rows.shared.width
        for k in rows.configurations.tolist():
            unit = gtsam.noiseModel.Unit.Create(width)
            graph.add(gtsam.PriorFactorVector(gtsam.symbol("E", k), np.zeros(width), unit))
            initial.insert(gtsam.symbol("E", k), np.zeros(width))
    for factor in (*prior_factors(problem.variables), *known_factors(problem), *problem.added):
        graph.add(factor)
    return graph, initial


def _measurement_factor(problem: Problem, rows: RowSet, part: Part, L: Sparse | None) -> gtsam.CustomFactor:
    """One measurement's rows, less what the errors that it shares make of them."""
    if L is None or not L.nnz:
        return row_factor(RowSet((part,)), problem.variables)
    assert rows.shared is not None
    width, variables = rows.shared.width, problem.variables
    used = np.unique(L.indices // width)
    G = L[:, (used[:, None] * width + np.arange(width)).ravel()].toarray()
    local, chosen, ours = factor_columns(variables, part.nuisances, with_core=part.block.kind.ends > 0)
    errors = []
    for i, k in enumerate(rows.configurations[used].tolist()):
        columns = slice(len(chosen) + i * width, len(chosen) + (i + 1) * width)
        errors.append(Variable(gtsam.symbol("E", k), f"E({k})", "own", (), columns))

    def linearise(values: gtsam.Values) -> tuple[Floats, Floats]:
        chunks = list(part.linearise(variables.at(variables.parameters(values, ours))))
        found = np.concatenate(chunks)
        z = np.concatenate([values.atVector(v.key) for v in errors])
        return found[:, -1] - G @ z, np.hstack([found[:, chosen], -G])

    return custom_factor([*local, *errors], part.n_rows, lambda values: linearise(values)[0], linearise)
