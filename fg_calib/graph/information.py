"""What rows say of the core: their whitened Jacobian with the nuisances eliminated, and what follows from it."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.graph.error_states import SchurComplement
from fg_calib.graph.factors import Variables, dense, prior_rows, unknown_prior_rows
from fg_calib.graph.normal_system import (
    RANK_TOLERANCE,
    SIGNAL_FLOOR,
    Eliminated,
    LinearRows,
    NormalSystem,
    eliminate,
)
from fg_calib.graph.problem import Problem
from fg_calib.graph.robust import effect
from fg_calib.graph.rows import At, ErrorColumns, RowSet, correlation_of, felt_errors, whitened_rows
from fg_calib.observability.indices import Observability, observability_of_rows

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def linear_system(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> NormalSystem:
    """The normal system of a problem at a parameter vector: all train rows, priors and added factors.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
    """
    v = problem.variables
    blocks = [
        np.column_stack(rows[::-1]) for rows in (unknown_prior_rows(v, parameters), known_rows(problem, parameters))
    ]
    A, b = added_system(problem, parameters)
    blocks += [np.column_stack([A, -b]), *row_triangles(problem, parameters, with_loss=with_loss)]
    priors = np.column_stack(prior_rows(v, parameters)[::-1])
    row_sets = _with_loss(problem)[0] if with_loss else problem.rows
    return NormalSystem(
        np.vstack(blocks),
        v.n_columns,
        v.prior_scales,
        priors,
        lambda: linear_rows(problem, row_sets, v.at(parameters)),
    )


def linear_rows(problem: Problem, row_sets: Sequence[RowSet], at: At) -> LinearRows:
    """Whitened train rows one by one, those of each row set and each of its parts after the other."""
    found, counts, used, loadings = [], [], [], []
    shared = next((rows for rows in row_sets if rows.shared is not None), None)
    for rows in row_sets:
        found.append(rows.private(at))
        for part in rows.parts:
            series = problem.data.series[part.series]
            counts.append(np.full(part.block.n, part.block.residual_dim))
            used.append(series.used[series.train].ravel())
        if shared is not None and shared.shared is not None:
            none = scipy.sparse.csr_array((len(found[-1]), shared.shared.loadings.shape[1]))
            loadings.append(none if rows.shared is None else rows.shared.loadings)
    wide = np.concatenate([np.zeros((0, at.n_columns + at.n_nuisance + 1)), *found])
    measurement = np.repeat(np.arange(sum(map(len, counts))), np.concatenate([np.zeros(0, dtype=np.int64), *counts]))
    states = None
    if shared is not None and shared.shared is not None:
        alone = len(row_sets) == 1
        L = shared.shared.loadings if alone else scipy.sparse.csr_array(scipy.sparse.vstack(loadings))
        states = shared.shared if alone else SchurComplement(L, shared.shared.width)
    return LinearRows(
        r=wide[:, -1],
        A=wide[:, :-1],
        measurement=measurement,
        states=states,
        used=np.concatenate([np.zeros(0, dtype=np.bool_), *used]),
        configurations=np.zeros(0, dtype=np.int64) if shared is None else shared.configurations,
        joints=0 if shared is None else shared.joints,
    )


def eliminated(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Eliminated:
    """The whitened Jacobian of train rows, nuisances' priors and added factors, these eliminated; zero right-hand side.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
    """
    A = whitened_jacobian(problem, parameters, with_loss=with_loss)
    return eliminate(A, np.zeros(len(A)), problem.variables.n_columns)


def whitened_jacobian(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Floats:
    """A square root of what train rows, nuisances' priors and added factors say: shape (m, n_columns + n_nuisance).

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
    """
    v = problem.variables
    blocks = [unknown_prior_rows(v, parameters)[1], added_rows(problem, parameters), known_rows(problem, parameters)[1]]
    blocks += [R[:, :-1] for R in row_triangles(problem, parameters, with_loss=with_loss)]
    return np.vstack(blocks)


def row_triangles(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> list[Floats]:
    """A square root of [J r] of each set of train rows, shape (n_columns + n_nuisance + 1,) * 2 each.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
    """
    at = problem.variables.at(parameters)
    row_sets, variance = _with_loss(problem) if with_loss else (problem.rows, 1.0)
    return [rows.triangle(at) / np.sqrt(variance) for rows in row_sets]


def _with_loss(problem: Problem) -> tuple[tuple[RowSet, ...], float]:
    """The rows, and by what factor a robust loss makes the variance of the estimate larger.

    Measurements of fewer rows lose less or more than others; beside those that lose least they count by that much.
    """
    state, loss = problem.state, problem.options.loss
    if state.weights is None:
        return problem.rows, 1.0
    dims = [s.used.sum(axis=1) for s in problem.data.series]
    of_dim = np.array(
        [effect(loss, max(dim, 1)).variance for dim in range(max(int(d.max(initial=0)) for d in dims) + 1)]
    )
    of_train = np.concatenate([d[s.train] for d, s in zip(dims, problem.data.series, strict=True)])
    present = np.unique(of_train[of_train > 0])
    variance = float(of_dim[present].min(initial=np.inf)) if len(present) else 1.0
    if len(present) <= 1:
        return problem.rows, variance
    share = np.minimum(variance / of_dim, 1.0)
    weights = [w * share[d] for w, d in zip(state.weights, dims, strict=True)]
    sharing = problem.options.pair_errors == "shared"
    rows = whitened_rows(problem.noises, sharing=sharing, joint_errors=state.joint_errors, weights=weights)
    return rows, variance


def whitened_triangle(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Floats:
    """A square root of what the train rows and added factors say of the core, shape (m, n_columns)."""
    return eliminated(problem, parameters, with_loss=with_loss).A


def directions(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """Signal-to-noise ratios of data and priors at some parameters, and their unit-free directions as columns.

    Returns:
        Shapes (n_columns,) and (n_columns, n_columns); directions of which nothing is known have a ratio of 0.
    """
    n, sizes = problem.variables.n_columns, problem.variables.prior_scales
    rows = np.vstack([whitened_triangle(problem, parameters), prior_rows(problem.variables, parameters)[1]])
    _, s, Vt = np.linalg.svd(np.vstack([rows * sizes, np.zeros((n, n))]), full_matrices=False)
    return s, Vt.T


def known_rows(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """What earlier rows say, whitened, and its derivatives, shapes (n_known,), (n_known, n_columns + n_nuisance)."""
    v = problem.variables
    if problem.known is None:
        return np.zeros(0), np.zeros((0, v.n_columns + v.n_nuisance))
    return problem.known.at_parameters(v, problem.data.unknowns, parameters)


def added_rows(problem: Problem, parameters: Floats) -> Floats:
    """Derivatives of the added factors' whitened rows, shape (n_added, n_columns + n_nuisance)."""
    return added_system(problem, parameters)[0]


def added_system(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """The added factors' derivatives, shape (n_added, n_columns + n_nuisance), and minus their errors, (n_added,)."""
    variables, b = problem.variables, np.zeros(problem.n_added)
    wide = np.zeros((problem.n_added, variables.n_columns + variables.n_nuisance))
    if problem.added:
        graph = gtsam.NonlinearFactorGraph()
        for factor in problem.added:
            graph.add(factor)
        present = set(graph.keyVector())
        chosen = [v for v in variables.items + variables.nuisance if v.key in present]
        A, b = dense(graph.linearize(variables.values(parameters)), [v.key for v in chosen])
        wide[:, np.concatenate([np.arange(wide.shape[1])[v.columns] for v in chosen])] = A
    return wide, b


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """`whitened_triangle` by named parameters, the measurement frames projected out: shape (m, n_robot_columns).

    At a pitch of a quarter turn of base or tool the columns of yaw and roll are parallel: only their sum acts.
    """
    return named_rows(problem.variables, parameters, whitened_triangle(problem, parameters))


def named_rows(variables: Variables, parameters: Floats, J: Floats) -> Floats:
    """Whitened rows of the core, shape (m, n_columns), as `named_triangle` has them."""
    n = variables.n_robot_columns
    out: Floats = J @ variables.tangent_derivative(parameters)[:, :n]
    if n == variables.n_columns:
        return out
    length = np.linalg.norm(out, axis=0)
    U, s, _ = np.linalg.svd(J[:, n:], full_matrices=False)
    Q = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
    out = out - Q @ (Q.T @ out)
    # What projecting leaves of a column that was all frame is rounding.
    out[:, np.linalg.norm(out, axis=0) <= RANK_TOLERANCE * length] = 0.0
    return out


def observability_of(
    problem: Problem, parameters: Floats, prefer: Sequence[str] = (), floor: float = SIGNAL_FLOOR
) -> Observability:
    """What the train rows, without priors, determine of the robot's parameters around a parameter vector.

    Args:
        problem: The problem.
        parameters: The parameter vector (see `Variables`).
        prefer: Parameters to keep, first choice first, where only combinations are determined.
        floor: Signal-to-noise ratio below which a direction counts as not determined.
    """
    return observability_of_rows(
        named_triangle(problem, parameters),
        problem.estimated,
        scales=np.array([problem.robot.scale_of(p.unit) for p in problem.estimated]),
        n_measurements=sum(len(s.train) for s in problem.data.series),
        prefer=prefer,
        floor=floor,
    )


def correlation(problem: Problem, parameters: Floats) -> Floats | None:
    """J^T (C - 1) J of the train rows where they share errors but count as independent, else None.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        With J the whitened Jacobian, the nuisances eliminated, and C the covariance of the whitened rows, shape
        (n_columns, n_columns).
    """
    if not problem.missing_correlation:
        return None
    n, n_nuisance = problem.variables.n_columns, problem.variables.n_nuisance
    follow = eliminated(problem, parameters).follow if n_nuisance else np.zeros((0, n))
    return correlation_of(problem.noises, problem.rows, problem.variables.at(parameters), follow)


def felt(problem: Problem, parameters: Floats, errors: ErrorColumns, wanted: Integers) -> Floats:
    """M: the estimate is off by `-K M e` because of errors e of configurations, K its covariance.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        errors: The errors of all configurations.
        wanted: Numbers of those that are asked for.

    Returns:
        M by core and nuisance variables, these not eliminated, shape (n_columns + n_nuisance, len(wanted)).
    """
    if not len(wanted):
        return np.zeros((problem.variables.n_columns + problem.variables.n_nuisance, 0))
    row_sets, variance = _with_loss(problem)
    return felt_errors(problem.noises, row_sets, problem.variables.at(parameters), errors, wanted) / variance
