"""GTSAM factors: one a measurement, as in `problem.graph`, and one a block, as the solver's damped steps take them.

In `problem.graph` a pair has one `DistanceFactor` and one `RotationAngleFactor`, any other measurement one factor. What
measurements share are variables `E(k)`, the errors of configuration k in units of their sigma, each with a prior; where
the distance and the angle of one pair are correlated they share a variable `e(i)`.

GTSAM 4.3 ends the interpreter when a custom factor leaves a Jacobian unset or gets its rows wrong, and returns the
initial values without a word when it gets the columns wrong. So `CheckedFactor` alone fills its lists, after checks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from numbers import Real

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike

from fg_calib.graph.error_states import State, WhitenedBlock, WhitenedSeries
from fg_calib.graph.variables import Variable, Variables, prior_rows
from fg_calib.inputs import (
    CalibrationError,
    Floats,
    InputError,
    Integers,
    ProblemError,
    SolverError,
    as_floats,
    check_number,
    shown,
)
from fg_calib.measurements import Block, Distance, Kind, RotationAngle, unpack

Sparse = scipy.sparse.csr_array
Linearise = Callable[[gtsam.Values], tuple[Floats, Floats]]

UNCORRELATED = 1e-12
"""Correlation of a pair's distance and angle below which they share no error."""


class CheckedFactor(gtsam.CustomFactor):
    """A factor over whitened residuals whose shapes and derivatives are checked.

    Args:
        variables: The variables it depends on; their columns follow each other.
        n_rows: Number of residuals.
        linearise: Whitened residuals at some values, shape (n_rows,), and their derivatives, shape (n_rows, n_columns).
        residual: The residuals alone, where that is quicker.

    Raises:
        SolverError: On linearising, if shapes are wrong or a derivative is not finite.
    """

    def __init__(
        self,
        variables: Sequence[Variable],
        n_rows: int,
        linearise: Linearise,
        residual: Callable[[gtsam.Values], Floats] | None = None,
    ) -> None:
        spans = [v.columns for v in variables]
        n_columns = max(s.stop for s in spans)
        symbols = ", ".join(v.symbol for v in variables)

        def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
            if H is None:
                r = linearise(values)[0] if residual is None else residual(values)
                if r.shape != (n_rows,):
                    raise SolverError(f"factor on {symbols}: residual of shape {r.shape}, expected ({n_rows},)")
                return r
            r, J = linearise(values)
            if r.shape != (n_rows,) or J.shape != (n_rows, n_columns):
                expected = f"({n_rows},), ({n_rows}, {n_columns})"
                raise SolverError(f"factor on {symbols}: shapes {r.shape}, {J.shape}, expected {expected}")
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                raise SolverError(f"factor on {symbols}: a residual or derivative is not finite")
            for i, span in enumerate(spans):
                H[i] = J[:, span]
            return r

        super().__init__(gtsam.noiseModel.Unit.Create(n_rows), [v.key for v in variables], evaluate)


class MeasurementFactor(CheckedFactor):
    """The rows of one measurement, minus what the errors that it shares make of them.

    Args:
        variables: The problem's variables.
        series: The measurement's whitened rows.
        errors: The error variables that it depends on, and the rows' derivatives in them, shape (n_rows, width) each.
    """

    def __init__(
        self, variables: Variables, series: WhitenedSeries, errors: Sequence[tuple[int, str, Floats]] = ()
    ) -> None:
        local, chosen, ours = factor_columns(variables, series.nuisances, with_core=series.block.kind.ends > 0)
        start, shared = len(chosen), list[Variable]()
        for key, symbol, loading in errors:
            shared.append(Variable(key, symbol, "own", (), slice(start, start := start + loading.shape[1])))
        G = np.hstack([np.zeros((series.n_rows, 0)), *(loading for _, _, loading in errors)])

        def linearise(values: gtsam.Values) -> tuple[Floats, Floats]:
            found = np.concatenate(list(series.linearise(variables.at(variables.parameters(values, ours)))))
            z = np.concatenate([np.zeros(0), *(values.atVector(v.key) for v in shared)])
            return found[:, -1] - G @ z, np.hstack([found[:, chosen], -G])

        super().__init__([*local, *shared], series.n_rows, linearise)


class DistanceFactor(MeasurementFactor):
    """A distance that the tool point moved between two configurations.

    Args:
        variables: The variables, `problem.variables`.
        start: Joint readings of the first configuration, shape (n_joints,), [rad] (prismatic: [m]).
        end: Readings of the second.
        distance: Measured, [m].
        sigma: Its 1 sigma, [m].

    Raises:
        InputError: The readings are of other joints, or a number is impossible.
    """

    def __init__(self, variables: Variables, start: ArrayLike, end: ArrayLike, distance: float, sigma: float) -> None:
        super().__init__(variables, _of_readings(Distance(), variables, (start, end), ("distance", distance), sigma))


class RotationAngleFactor(MeasurementFactor):
    """An angle in [0, pi] that the tool rotated by between two configurations, [rad]; else as `DistanceFactor`."""

    def __init__(self, variables: Variables, start: ArrayLike, end: ArrayLike, angle: float, sigma: float) -> None:
        if isinstance(angle, Real) and angle > np.pi:
            raise InputError("angle", f"found {shown(angle)}", "0 to pi, in rad")
        super().__init__(variables, _of_readings(RotationAngle(), variables, (start, end), ("angle", angle), sigma))


def _of_readings(
    kind: Kind, variables: Variables, ends: tuple[ArrayLike, ArrayLike], measured: tuple[str, float], sigma: float
) -> WhitenedSeries:
    if not isinstance(variables, Variables):
        raise InputError("variables", f"found {shown(variables)}", "the variables of a problem")
    check_number(*measured)
    check_number("sigma", sigma, above=True)
    n = variables.robot.n_joints
    readings = [as_floats(name, q, f"({n})") for name, q in zip(("start", "end"), ends, strict=True)]
    trig = variables.robot.trig(np.array(readings))
    data, whitening = np.array([[float(measured[1])]]), np.array([[1.0 / float(sigma)]])
    block = Block(kind, trig, np.array([[0, 1]]), data, whitening, np.zeros((1, 0)))
    return WhitenedSeries(block, 0, 0, np.zeros((1, 0), dtype=np.int64))


def measurement_factors(
    blocks: Sequence[WhitenedBlock], variables: Variables, at: State
) -> tuple[list[gtsam.NonlinearFactor], gtsam.Values]:
    """Factors of one measurement each with the priors of the error variables that they share, and these' estimates.

    Args:
        blocks: The whitened rows.
        variables: The problem's variables.
        at: Where the error variables are estimated.
    """
    factors, values, number = list[gtsam.NonlinearFactor](), gtsam.Values(), 0

    def add_error(key: int, z: Floats) -> None:
        factors.append(gtsam.PriorFactorVector(key, np.zeros(len(z)), gtsam.noiseModel.Unit.Create(len(z))))
        values.insert(key, z)

    for block in blocks:
        z, first = block.posterior_mean(at), 0
        u = block.private(at.without_columns())[:, -1]
        if block.states is not None:
            u = u - block.states.loadings @ z.ravel()
        for part in block.parts:
            h = part.block.residual_dim
            for k in range(part.block.n):
                one, rows = part.only(k), slice(first, first := first + h)
                errors = [] if block.states is None else _errors_of(block, block.states.loadings[rows])
                number += 1
                if not (variables.items or np.any(variables.coordinates[one.nuisances] >= 0)):
                    continue  # nothing that it depends on is estimated
                if all(type(kind) in _PAIR_FACTORS for kind in one.block.kind.parts):
                    made, shared = _pair_factors(one, variables, errors, number)
                    factors += made
                    if shared.any():
                        add_error(gtsam.symbol("e", number), np.array([shared @ u[rows]]))
                else:
                    factors.append(MeasurementFactor(variables, one, errors))
        for k, of_k in zip(block.configurations.tolist(), z, strict=True):
            add_error(gtsam.symbol("E", k), of_k)
    return factors, values


Errors = list[tuple[int, str, Floats]]


def _errors_of(block: WhitenedBlock, L: Sparse) -> Errors:
    """The error variables that some rows depend on, and their derivatives."""
    assert block.states is not None
    width = block.states.width
    used = np.unique(L.indices // width)
    G = L[:, (used[:, None] * width + np.arange(width)).ravel()].toarray()
    keys = block.configurations[used].tolist()
    return [(gtsam.symbol("E", k), f"E({k})", G[:, i * width : (i + 1) * width]) for i, k in enumerate(keys)]


def _pair_factors(
    pair: WhitenedSeries, variables: Variables, errors: Errors, number: int
) -> tuple[list[MeasurementFactor], Floats]:
    """The factors of one pair's distance and angle, with a variable `e(number)` for what correlates them.

    Their private covariance is `diag(private) + common common^T`, with the same share of either variance in common.

    Returns:
        The factors, and the posterior mean of `e(number)` per private whitened residual, zeros where there is none.
    """
    kinds, found = pair.block.kind.parts, list[MeasurementFactor]()
    W = unpack(pair.block.whitening, len(kinds))[0]
    used = np.flatnonzero(np.diag(W))
    inverse = np.linalg.inv(W[np.ix_(used, used)])
    C = inverse @ inverse.T
    private, common, mean = np.diag(C).copy(), np.zeros(len(used)), np.zeros(len(kinds))
    if len(used) == 2 and abs(C[0, 1]) > UNCORRELATED * np.sqrt(C[0, 0] * C[1, 1]):
        common = np.sqrt(abs(C[0, 1])) * np.array([1.0, np.sign(C[0, 1])]) * (private / private[::-1]) ** 0.25
        private -= common**2
        mean = W @ common
    for i, k in enumerate(used.tolist()):
        weight = 1.0 / np.sqrt(private[i])
        row = inverse[i] * weight
        of_errors = [(key, symbol, (row @ G[used])[None]) for key, symbol, G in errors]
        if common[i]:
            of_errors.append((gtsam.symbol("e", number), f"e({number})", np.array([[common[i] * weight]])))
        block = replace(pair.block, kind=kinds[k], data=pair.block.data[:, k : k + 1], whitening=np.array([[weight]]))
        offset = None if pair.offset is None else (pair.offset[:, used] @ row)[:, None]
        factor = _PAIR_FACTORS[type(kinds[k])]
        found.append(factor.__new__(factor))
        MeasurementFactor.__init__(found[-1], variables, replace(pair, block=block, offset=offset), of_errors)
    return found, mean


_PAIR_FACTORS: dict[type, type[MeasurementFactor]] = {Distance: DistanceFactor, RotationAngle: RotationAngleFactor}


def reduced_factor(block: WhitenedBlock, variables: Variables) -> CheckedFactor:
    """A block as one factor: the triangular factor of [J r] has the same cost, gradient and Gauss-Newton Hessian.

    With `[J r] = Q [[R, z], [0, rho]]` the residual is (z, rho) and the Jacobian (R, 0): n_columns + 1 rows.
    """
    with_core = any(part.block.kind.ends for part in block.parts)
    local, chosen, ours = factor_columns(variables, block.coordinates, with_core=with_core)
    n_rows = len(chosen) + 1
    with_right = np.append(chosen, variables.n_columns + variables.n_nuisance)

    def at(values: gtsam.Values) -> State:
        return variables.at(variables.parameters(values, ours))

    def residual(values: gtsam.Values) -> Floats:
        r = np.zeros(n_rows)
        r[0] = np.sqrt(block.squared_norm(at(values)))
        return r

    def linearise(values: gtsam.Values) -> tuple[Floats, Floats]:
        R = block.triangle(at(values))[:, with_right]
        if len(R) > n_rows:
            R = np.linalg.qr(R, mode="r")  # type: ignore[assignment]
        return R[:, -1], R[:, :-1]

    return CheckedFactor(local, n_rows, linearise, residual)


def factor_columns(
    variables: Variables, coordinates: Integers, *, with_core: bool
) -> tuple[list[Variable], Integers, tuple[Variable, ...]]:
    """The variables of a factor on the core and some landmark coordinates.

    Returns:
        Its variables with columns of their own, one after the other; which of all columns these are; the variables.
    """
    there = set(variables.coordinates[coordinates.ravel()].tolist())
    nuisance = tuple(v for v in variables.nuisance if there.intersection(v.parameters))
    core = variables.items if with_core else ()
    column = variables.n_columns if with_core else 0
    local, chosen = list(core), [np.arange(column)]  # the core's columns come first
    for v in nuisance:
        width = v.columns.stop - v.columns.start
        local.append(replace(v, columns=slice(column, column + width)))
        chosen.append(np.arange(v.columns.start, v.columns.stop))
        column += width
    return local, np.concatenate(chosen), core + nuisance


def prior_factors(variables: Variables) -> list[gtsam.NonlinearFactor]:
    """One factor for each variable that has parameters with a prior, or that was said to be somewhere."""
    factors: list[gtsam.NonlinearFactor] = []
    for v in variables.items:
        n_rows = len(variables.stated[v.symbol][0])
        if n_rows:
            factors.append(_prior_factor(variables, v, n_rows))
    for v in variables.nuisance:
        if v.prior is not None:
            mean, sigma = (np.array(figures) for figures in v.prior)
            factors.append(gtsam.PriorFactorVector(v.key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    return factors


def _prior_factor(variables: Variables, variable: Variable, n_rows: int) -> gtsam.NonlinearFactor:
    """GTSAM's own, which calls no Python, of a vector all of which has a prior; of poses, and of parts, ours."""
    if not variable.is_pose and n_rows == len(variable.parameters):
        mean, sigma = variables.nominal()[variable.places], 1.0 / variables.stated[variable.symbol][1]
        return gtsam.PriorFactorVector(variable.key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigma))

    def rows(values: gtsam.Values) -> tuple[Floats, Floats]:
        r, J = prior_rows(variables, variables.parameters(values, [variable]), variable)
        return r, J[:, variable.columns]

    return CheckedFactor([replace(variable, columns=slice(0, len(variable.parameters)))], n_rows, rows)


def linearize_factors(
    factors: Sequence[gtsam.NonlinearFactor], variables: Variables, values: gtsam.Values
) -> tuple[Floats, Floats]:
    """Factors' whitened residuals and derivatives at some values, shapes (n,), (n, n_columns + n_nuisance)."""
    n = variables.n_columns + variables.n_nuisance
    if not factors:
        return np.zeros(0), np.zeros((0, n))
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    present, ordering = set(graph.keyVector()), gtsam.Ordering()
    chosen = [v for v in variables.items + variables.nuisance if v.key in present]
    for v in chosen:
        ordering.push_back(v.key)
    A, b = graph.linearize(values).jacobian(ordering)
    wide = np.zeros((len(b), n))
    wide[:, np.concatenate([np.arange(n)[v.columns] for v in chosen])] = A
    return -b, wide


def check_added(
    factors: Sequence[gtsam.NonlinearFactor], initial: gtsam.Values, variables: Variables, errors: gtsam.Values
) -> gtsam.Values:
    """Check factors that a user added to a problem's graph, and the initial values.

    Args:
        factors: All that were added.
        initial: The initial values.
        variables: The problem's own variables.
        errors: Its error variables.

    Returns:
        The start of the variables that the factors bring with them.

    Raises:
        ProblemError: A factor has no finite weight, error or derivative, or values and variables do not match.
    """
    for factor in factors:
        _check_noise(factor)
    _check_initial(initial, variables)
    added = gtsam.Values(initial)
    keys_of_errors = list(errors.keys())
    for key in [*variables.keys, *filter(initial.exists, keys_of_errors)]:
        added.erase(key)
    found = set(chain.from_iterable(factor.keys() for factor in factors))
    on_errors = found.intersection(keys_of_errors)
    if on_errors:
        place, symbol = "problem.graph", str(gtsam.Symbol(min(on_errors))).strip()
        raise ProblemError(place, f"an added factor on the error variable {symbol}", "factors on other variables")
    for key in sorted(found.difference(variables.keys).symmetric_difference(added.keys())):
        symbol = str(gtsam.Symbol(key)).strip()
        if key in found:
            raise ProblemError("problem.initial", f"no value of {symbol}", "one for every variable of an added factor")
        raise ProblemError("problem.initial", f"a value of {symbol}", "none without a factor on it in problem.graph")
    for factor in factors:
        _check_start(factor, initial)
    return added


def _check_initial(initial: gtsam.Values, variables: Variables) -> None:
    """Check that every variable of the problem has an initial value, of its own type and size."""
    for v in variables.items + variables.nuisance:
        if not initial.exists(v.key):
            raise ProblemError("problem.initial", f"no value of {v.symbol}", "one for every variable of the problem")
        expected = "a gtsam.Pose3" if v.is_pose else f"{len(v.parameters)} finite numbers"
        try:
            value = initial.atPose3(v.key).matrix() if v.is_pose else initial.atVector(v.key)
        except RuntimeError:
            raise ProblemError(f"problem.initial: {v.symbol}", "a value of another type", expected) from None
        if not v.is_pose and len(value) != len(v.parameters):
            raise ProblemError(f"problem.initial: {v.symbol}", f"{len(value)} numbers", expected)
        if not np.isfinite(value).all():
            raise ProblemError(f"problem.initial: {v.symbol}", "a number that is not finite", expected)


def _check_noise(factor: gtsam.NonlinearFactor | None) -> None:
    """Check that the rows of an added factor have finite weights: else nothing could be counted or whitened."""
    if factor is None:
        raise ProblemError("problem.graph", "None among its factors", "factors")
    name, model = type(factor).__name__, factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if model is None:
        expected = "one with a noise model, such as PriorFactorVector, BetweenFactorPose3 or CustomFactor"
        raise ProblemError("problem.graph", f"an added {name}", expected)
    if model.isConstrained():
        expected = "sigmas above 0: a thousandth of what matters is as good as 0"
        raise ProblemError("problem.graph", f"an added {name} with a constrained noise model", expected)


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
