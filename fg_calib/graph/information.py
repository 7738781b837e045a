"""What rows say of the core, by the normal system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.error_states import ErrorStates, felt_errors
from fg_calib.graph.normal_system import SIGNAL_FLOOR, Eliminated
from fg_calib.graph.problem import (
    Problem,
    _with_loss,
    correlation,
    linear_system,
    named_rows,
    square_root,
)
from fg_calib.observability.indices import Observability, observability_of_rows

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

__all__ = ["correlation", "linear_system", "named_rows"]


def eliminated(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Eliminated:
    """The rows with the landmarks eliminated."""
    return linear_system(problem, parameters, with_loss=with_loss).left


def whitened_jacobian(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Floats:
    """A square root of what train rows, landmarks' priors and added factors say: (m, n_columns + n_nuisance)."""
    return square_root(problem, parameters, with_loss=with_loss)[:, :-1]


def whitened_triangle(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Floats:
    """A square root of what the train rows and added factors say of the core, shape (m, n_columns)."""
    return linear_system(problem, parameters, with_loss=with_loss).left.A


def row_triangles(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> list[Floats]:
    """A square root of [J r] of each block, shape (n_columns + n_nuisance + 1,) * 2 each."""
    blocks, variance = _with_loss(problem) if with_loss else (problem.rows, 1.0)
    return [block.triangle(problem.variables.at(parameters)) / np.sqrt(variance) for block in blocks]


def directions(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """Signal-to-noise ratios of data and priors at some parameters, and their unit-free directions as columns."""
    system = linear_system(problem, parameters)
    return system.singular_values, (system.directions / problem.variables.prior_scales).T


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """`whitened_triangle` by named parameters, the measurement frames projected out: shape (m, n_robot_columns)."""
    return named_rows(problem.variables, parameters, whitened_triangle(problem, parameters))


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


def felt(problem: Problem, parameters: Floats, errors: ErrorStates, wanted: Integers) -> Floats:
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
