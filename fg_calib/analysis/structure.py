"""Whether residuals follow the arm, as noise does not: a test for effects that are not modelled.

Were there nothing but noise, what a fit leaves could not be explained by more parameters than chance allows. The rows
are fitted again, linearly, with what real arms have beyond their model: every small motion of every link, and errors
of each joint that go once or twice round with it (eccentric encoders and gears; Z below, beside J of the model, whose
priors are rows too):

    F = (|r_J|^2 - |r_JZ|^2) / m over |r_JZ|^2 / (n - rank J - m)

with r_J and r_JZ the residuals of the two fits, m the rank that Z adds and n the residuals that noise can make differ
freely. It has an F distribution whatever the size
of the noise, so it also tells where the noise was stated too small.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.analysis.conventions import end_of_link
from fg_calib.graph.factors import build_variables, prior_rows
from fg_calib.graph.problem import Problem
from fg_calib.graph.rows import RowSet
from fg_calib.graph.solver import Solution
from fg_calib.measurements import residuals
from fg_calib.measurements.residuals import Block
from fg_calib.robot.kinematics import Chain
from fg_calib.robot.model import FRAME_KINDS, Element, Parameter, Robot

Floats = NDArray[np.float64]

MAX_ROWS = 5000
"""Rows up to which residuals are tested: more would take long, and are seldom needed to tell."""

LEAST_LEFT = 10
"""Degrees of freedom that the larger fit must leave."""

_RANK = 1e-8
"""Part of a column that counts as nothing."""

_OWN = "small motion of link "


def probability_of_noise(solution: Solution) -> float | None:
    """Probability that noise alone follows the arm as much as the residuals of a solution do.

    Returns:
        The p-value; None where it cannot be told: too few rows or too many, a robust loss, touched points, joint
        values estimated, rows that share errors but are weighted as independent.
    """
    problem, state = solution.problem, solution.problem.state
    weighted = state.weights is not None or state.joint_errors is not None
    several = problem.variables.nuisance or problem.added or weighted or problem.missing_correlation
    if several or problem.n_residuals > MAX_ROWS:
        return None
    chains, of_model = _chains(problem, solution.parameters)
    rows = [_rows(row_set, chains) for row_set in problem.rows]
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    fitted = np.concatenate([*(J[:, of_model] for J, _ in rows), J_prior])
    rest = np.concatenate([*(J[:, ~of_model] for J, _ in rows), np.zeros((len(r_prior), int(np.sum(~of_model))))])
    r = np.concatenate([*(r for _, r in rows), r_prior])
    Q = _basis(fitted, np.linalg.norm(fitted, axis=0))
    r = r - Q @ (Q.T @ r)
    more = _basis(rest - Q @ (Q.T @ rest), np.linalg.norm(rest, axis=0))
    n_left = problem.n_independent + len(r_prior) - Q.shape[1] - more.shape[1]
    if n_left < LEAST_LEFT or not more.shape[1]:
        return None
    drop = float(np.sum((more.T @ r) ** 2))
    left = float(r @ r) - drop
    return float(special.fdtrc(more.shape[1], n_left, (drop / more.shape[1]) / max(left / n_left, 1e-300)))


def _chains(problem: Problem, parameters: Floats) -> tuple[tuple[Chain, ...], NDArray[np.bool_]]:
    """The chains at a parameter vector with columns for the links' small motions too, and which of all are the model's.

    Their joints' columns give as many again for each of `_waves`.
    """
    robot = _with_link_motions(problem.robot)
    variables = build_variables(robot, [table.unknown_frame for table in problem.data.tables])
    n, n_more = len(problem.robot.parameters), len(robot.parameters) - len(problem.robot.parameters)
    values = np.concatenate([parameters[:n], np.zeros(n_more), parameters[problem.variables.frame_span]])
    of_model = np.array([not name.startswith(_OWN) for name in variables.names])
    of_joints = np.zeros(_N_WAVES * robot.n_joints, dtype=np.bool_)
    chains = tuple(chain.at(values).with_joint_columns() for chain in variables.chains)
    return chains, np.concatenate([of_model, of_joints])


def _with_link_motions(robot: Robot) -> Robot:
    """The robot with six more parameters, all zero, at the end of each link, the base's and the tool's among them."""
    elements, parameters = list(robot.elements), list(robot.parameters)
    for owner in range(robot.n_joints, -1, -1):
        place = end_of_link(robot, owner)
        for kind in FRAME_KINDS:
            more = Parameter(f"{_OWN}{owner}: {kind}", kind, owner, 0.0)
            elements.insert(place, Element(more.axis, parameter=len(parameters)))
            parameters.append(more)
    return replace(robot, elements=tuple(elements), parameters=tuple(parameters))


def _rows(row_set: RowSet, chains: tuple[Chain, ...]) -> tuple[Floats, Floats]:
    """Whitened derivatives in the chains' columns and the joints' waves, and residuals, one row a scalar."""
    rows = np.concatenate([_private_rows(part.block, chains[part.table]) for part in row_set.parts])
    if row_set.shared is not None:
        rows = row_set.shared.whiten(rows)
    return rows[:, :-1], rows[:, -1]


def _private_rows(part: Block, chain: Chain) -> Floats:
    """[J Z r] of a block before what its rows share is taken out, shape (n_rows, n_columns + n_waves + 1)."""
    r, J = residuals.linearise(part, chain)
    own, n = J[:, :, : chain.n_columns], chain.n_joints
    waves = np.zeros((*r.shape, _N_WAVES * n))
    for k, rows in enumerate(part.ends.T):
        of_end = J[:, :, chain.n_columns + k * n : chain.n_columns + (k + 1) * n]
        waves += np.concatenate([of_end * wave[:, None] for wave in _waves(part.trig[rows])], axis=2)
    return np.concatenate([own, waves, r[:, :, None]], axis=2).reshape(r.size, -1)


def _waves(trig: Floats) -> tuple[Floats, ...]:
    """What a joint's error may follow: once and twice round with it; of a slide its place and the square of that.

    Args:
        trig: Cosine and sine of readings (place and 0 of a slide), shape (n, n_joints, 2).
    """
    cos, sin = trig[:, :, 0], trig[:, :, 1]
    return cos, sin, cos * cos, cos * sin


_N_WAVES = 4


def _basis(columns: Floats, size: Floats) -> Floats:
    """An orthonormal basis of the columns, in units of their original size; what is left of nothing is nothing."""
    scaled = columns / np.maximum(size, 1e-300)
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    basis: Floats = U[:, s > _RANK * np.sqrt(len(size))]
    return basis
