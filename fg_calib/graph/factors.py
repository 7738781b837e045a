"""GTSAM factors: one a measurement, as in `problem.graph`.

A pair has one `DistanceFactor` and one `RotationAngleFactor`, any other measurement one factor. What measurements share
are variables `Z(k)`, the errors of configuration k in units of their sigma, each with a prior. Where private noise of a
pair has a correlation c of distance and angle (errors that count as its own, a robust weight), so is the one error
`e(i)` of pair i: both follow from it with sqrt(|c|) of their sigma, and what is left is uncorrelated.

GTSAM 4.3 ends the interpreter when a custom factor leaves a Jacobian unset or gets its rows wrong, and returns the
initial values without a word when it gets the columns wrong. So `CheckedFactor` alone fills its lists, after checks.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from numbers import Real

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike

from fg_calib.graph.error_states import State, WhitenedBlock, WhitenedRows
from fg_calib.graph.variables import Variable, Variables, prior_rows
from fg_calib.inputs import CalibrationError, Floats, InputError, ProblemError, SolverError, as_floats, check_number
from fg_calib.measurements import Block, Distance, Kind, RotationAngle, unpack

Sparse = scipy.sparse.csr_array


class CheckedFactor(gtsam.CustomFactor):
    """A factor over whitened residuals whose shapes and derivatives are checked.

    Args:
        variables: The variables it depends on; their columns follow each other.
        n_rows: Number of residuals.
        linearise: Whitened residuals at some values, shape (n_rows,), and their derivatives, shape (n_rows, n_columns).

    Raises:
        SolverError: On linearising, if shapes are wrong or a number is not finite.
    """

    def __init__(
        self, variables: Sequence[Variable], n_rows: int, linearise: Callable[[gtsam.Values], tuple[Floats, Floats]]
    ) -> None:
        spans = [v.columns for v in variables]
        n_columns = max(s.stop for s in spans)
        symbols = ", ".join(v.symbol for v in variables)

        def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
            r, J = linearise(values)
            if r.shape != (n_rows,) or J.shape != (n_rows, n_columns):
                expected = f"({n_rows},), ({n_rows}, {n_columns})"
                raise SolverError(f"factor on {symbols}: shapes {r.shape}, {J.shape}, expected {expected}")
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                raise SolverError(f"factor on {symbols}: a residual or derivative is not finite")
            for i, span in enumerate(spans if H is not None else ()):
                H[i] = J[:, span]  # type: ignore[index]
            return r

        super().__init__(gtsam.noiseModel.Unit.Create(n_rows), [v.key for v in variables], evaluate)


class MeasurementFactor(CheckedFactor):
    """The rows of one measurement, minus what the errors that it shares make of them.

    Args:
        variables: The problem's variables.
        part: The measurement's whitened rows.
        errors: The error variables that it depends on, and the rows' derivatives in them, shape (n_rows, width) each.
        k: Which measurement of them.
    """

    def __init__(
        self, variables: Variables, part: WhitenedBlock, errors: Sequence[tuple[Variable, Floats]] = (), k: int = 0
    ) -> None:
        places, h = set(variables.coordinates[part.nuisances[k]].tolist()), part.block.residual_dim
        ours = [*(variables.items if part.block.kind.ends else ())]
        ours += [v for v in variables.nuisance if v.kind == "curve" or places.intersection(v.parameters)]
        chosen = np.concatenate([np.zeros(0, np.int64), *(np.r_[v.columns] for v in ours)])
        G = np.hstack([np.zeros((h, 0)), *(loading for _, loading in errors)])
        widths = [v.columns.stop - v.columns.start for v in ours] + [loading.shape[1] for _, loading in errors]
        ends, shared = np.cumsum([0, *widths]).tolist(), [v for v, _ in errors]
        local = [replace(v, columns=slice(*ends[i : i + 2])) for i, v in enumerate([*ours, *shared])]

        def linearise(values: gtsam.Values) -> tuple[Floats, Floats]:
            found = np.concatenate(list(part.linearise(variables.at(variables.parameters(values, ours)))))[k * h :][:h]
            z = np.concatenate([np.zeros(0), *(values.atVector(v.key) for v in shared)])
            return found[:, -1] - G @ z, np.hstack([found[:, chosen], -G])

        super().__init__(local, h, linearise)


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
            raise InputError("angle", f"found {angle}", "0 to pi, in rad")
        super().__init__(variables, _of_readings(RotationAngle(), variables, (start, end), ("angle", angle), sigma))


def _of_readings(
    kind: Kind, variables: Variables, ends: tuple[ArrayLike, ArrayLike], measured: tuple[str, float], sigma: float
) -> WhitenedBlock:
    check_number(*measured)
    check_number("sigma", sigma, above=True)
    n = variables.robot.n_joints
    readings = [as_floats(name, q, f"({n})") for name, q in zip(("start", "end"), ends, strict=True)]
    trig = variables.robot.trig(np.array(readings))
    data, whitening = np.array([[float(measured[1])]]), np.array([[1.0 / float(sigma)]])
    block = Block(kind, trig, np.array([[0, 1]]), data, whitening, np.zeros((1, 0)))
    return WhitenedBlock(block, 0, 0, np.zeros((1, 0), dtype=np.int64))


def measurement_factors(
    rows: WhitenedRows, variables: Variables, at: State
) -> tuple[list[gtsam.NonlinearFactor], gtsam.Values]:
    """Factors of one measurement each with the priors of the error variables that they share, and these' estimates.

    Args:
        rows: The whitened rows.
        variables: The problem's variables.
        at: Where the error variables are estimated.
    """
    z, factors, values = rows.posterior_mean(at), list[gtsam.NonlinearFactor](), gtsam.Values()
    private = rows.private(at.without_columns())[:, -1] - rows.states.loadings @ z.ravel()
    estimates = [(_error("Z", k), of_k) for k, of_k in zip(rows.configurations.tolist(), z, strict=True)]
    first, n, measurements = 0, max(len(rows.slots), 1), ((part, k) for part in rows.parts for k in range(part.block.n))
    for number, (part, k) in enumerate(measurements):
        kind, these = part.block.kind, slice(first, first + part.block.residual_dim)
        L, first = rows.states.loadings[these], these.stop
        errors = [(estimates[i][0], L[:, i * n : (i + 1) * n].toarray()) for i in np.unique(L.indices // n).tolist()]
        if not variables.items and np.all(variables.coordinates[part.nuisances[k]] < 0):
            continue  # nothing of it is estimated
        if all(type(each) in _PAIR_FACTORS for each in kind.parts):
            found, common = _pair_factors(part.only(k), variables, errors, private[these], _error("e", number))
            factors += found
            estimates += common
        else:  # a contact is turned back by a rotation of all together
            one, place = (part, k) if kind.turned_back else (part.only(k), 0)
            factors.append(MeasurementFactor(variables, one, errors, place))
    for v, value in estimates:
        factors.append(gtsam.PriorFactorVector(v.key, np.zeros(len(value)), gtsam.noiseModel.Unit.Create(len(value))))
        values.insert(v.key, value)
    return factors, values


def _error(letter: str, number: int) -> Variable:
    return Variable(gtsam.symbol(letter, number), "own", (), slice(0))


def _pair_factors(
    one: WhitenedBlock, variables: Variables, errors: list[tuple[Variable, Floats]], private: Floats, own: Variable
) -> tuple[list[MeasurementFactor], list[tuple[Variable, Floats]]]:
    """A factor of each row of a pair that is in use, and the estimate of the error `own` where they have it in common.

    Args:
        one: The pair's whitened rows.
        variables: The problem's variables.
        errors: As of `MeasurementFactor`.
        private: Estimates of the private errors, shape (n_rows,), [sigma].
        own: The variable of the error that the rows have in common.
    """
    W, estimates, factors = unpack(one.block.whitening, one.block.residual_dim)[0], [], list[MeasurementFactor]()
    white = np.diag(W)
    if np.any(np.diag(white) != W):
        C = np.linalg.inv(W.T @ W)
        c = C[0, 1] / np.sqrt(C[0, 0] * C[1, 1])
        white, G = 1.0 / np.sqrt(np.diag(C) * (1.0 - abs(c))), np.sqrt(abs(c) / (1.0 - abs(c))) * np.sign([[1.0], [c]])
        errors = [*((v, white[:, None] * np.linalg.solve(W, of_v)) for v, of_v in errors), (own, G)]
        estimates = [(own, (G[:, 0] / white) @ W.T @ private[:, None])]
    for k in np.flatnonzero(white).tolist():
        part = one.block.kind.parts[k]
        block = replace(one.block, kind=part, data=one.block.data[:, [k]], whitening=white[None, [k]])
        factor = _PAIR_FACTORS[type(part)]
        made = factor.__new__(factor)
        MeasurementFactor.__init__(made, variables, replace(one, block=block), [(v, of_v[[k]]) for v, of_v in errors])
        factors.append(made)
    return factors, estimates


_PAIR_FACTORS: dict[type, type[MeasurementFactor]] = {Distance: DistanceFactor, RotationAngle: RotationAngleFactor}


def prior_factors(variables: Variables) -> list[gtsam.NonlinearFactor]:
    """One factor for each variable that has parameters with a prior, or that was said to be somewhere."""
    factors = [_prior_factor(variables, v) for v in variables.items if variables.prior_weights[v.key][0]]
    for v in variables.nuisance:
        if v.prior is not None:
            mean, sigma = (np.array(figures) for figures in v.prior)
            factors.append(gtsam.PriorFactorVector(v.key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    return factors


def _prior_factor(variables: Variables, variable: Variable) -> gtsam.NonlinearFactor:
    def rows(values: gtsam.Values) -> tuple[Floats, Floats]:
        r, J = prior_rows(variables, variables.parameters(values, [variable]), variable)
        return r, J[:, variable.columns]

    local = replace(variable, columns=slice(0, len(variable.parameters)))
    return CheckedFactor([local], len(variables.prior_weights[variable.key][0]), rows)


def linearize_factors(
    factors: Sequence[gtsam.NonlinearFactor], variables: Variables, values: gtsam.Values
) -> tuple[Floats, Floats]:
    """Factors' whitened residuals and derivatives at some values, shapes (n,), (n, n_columns + n_nuisance)."""
    of_key = {v.key: np.r_[v.columns] for v in variables.items + variables.nuisance}
    r, J = [np.zeros(0)], [np.zeros((0, variables.n_columns + variables.n_nuisance))]
    for factor in factors:
        linear = factor.linearize(values)
        A, b = linear.jacobian()
        wide = np.zeros((len(b), J[0].shape[1]))
        wide[:, np.concatenate([of_key[key] for key in linear.keys()])] = A  # noqa: SIM118 -- GTSAM's keys
        r.append(-b)
        J.append(wide)
    return np.concatenate(r), np.vstack(J)


def with_added(
    variables: Variables, factors: Sequence[gtsam.NonlinearFactor], initial: gtsam.Values, errors: gtsam.Values
) -> tuple[Variables, Floats]:
    """The variables with those that added factors bring with them, and the parameter vector where all start.

    Args:
        variables: The problem's variables.
        factors: All factors that were added.
        initial: The initial values.
        errors: The problem's error variables.

    Raises:
        ProblemError: A factor has no finite weight, error or derivative, or values and variables do not match.
    """
    found, on_errors = set(chain.from_iterable(f.keys() for f in factors if f is not None)), set(errors.keys())
    if found & on_errors:
        added = f"an added factor on the error variable {_symbol(min(found & on_errors))}"
        way_out = "gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.initial) takes it"
        raise ProblemError("problem.graph", added, "factors on other variables", way_out)
    ours = variables.with_added((), initial)
    known, given = found.union(ours.keys), set(initial.keys()) - on_errors
    for key in sorted(known ^ given):
        what = f"{'no value' if key in known else 'a value'} of {_symbol(key)}"
        raise ProblemError("problem.initial", what, "one for every variable of the graph, and no others")
    for factor in factors:
        _check_factor(factor, initial)
    variables = variables.with_added(more := sorted(given.difference(ours.keys)), initial)
    for v in (*variables.items, *variables.nuisance):
        with suppress(RuntimeError, ValueError):
            if np.isfinite(variables.parameters(initial, [v])).all():
                continue
        pose = f"a {'vector or a ' * (v.key in more)}gtsam.Pose3"
        expected = pose if v.is_pose else f"{len(v.parameters)} finite numbers"
        raise ProblemError(f"problem.initial: {v.symbol}", "another value", expected)
    return variables, variables.parameters(initial)


def _symbol(key: int) -> str:
    return str(gtsam.Symbol(key)).strip()


def _check_factor(factor: gtsam.NonlinearFactor | None, initial: gtsam.Values) -> None:
    """Check that an added factor has rows of finite weight, and an error and a derivative where it starts."""
    name, model = type(factor).__name__, factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    if factor is None or model is None or model.isConstrained():
        expected = "a factor with a noise model of sigmas above 0, such as PriorFactorVector or CustomFactor"
        raise ProblemError("problem.graph", f"an added {name}", expected)
    place = f"problem.graph: added {name} on {', '.join(map(_symbol, factor.keys()))}"
    try:
        error = factor.error(initial)
        factor.linearize(initial)
    except CalibrationError:
        raise
    except Exception as raised:
        raise ProblemError(place, f"raised {type(raised).__name__}: {raised}") from raised
    if not np.isfinite(error):
        raise ProblemError(place, f"an error of {error:g} at the initial values", "a finite one")
