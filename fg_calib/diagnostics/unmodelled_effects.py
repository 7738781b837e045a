"""Whether residuals follow the arm, as noise does not: a test for effects that are not modelled.

Were there nothing but noise, what a fit leaves could not be explained by more parameters than chance allows. The rows
are fitted again, linearly, with what real arms have beyond their model, stage by stage (Z_1, Z_2, ... beside J of the
model, whose priors are rows too):

1. joints that give way under load, gravity along z of the base: loads at the tool and on every link after the joint;
2. joints that are off by a part of how far the tool reaches out, every small motion of every link, and errors of each
   joint that go once or twice round with it (eccentric encoders and gears, gains of slides);
3. the same loads of an arm that is mounted otherwise, gravity along x and y.

    F_s = |Q_s^T r|^2 / m_s over (|r|^2 - |Q_1^T r|^2 - ... - |Q_s^T r|^2) / (n - rank J - m_1 - ... - m_s)

with r the residuals of the model's fit, Q_s a basis of what stage s adds to J and the stages before, m_s its rank and n
the residuals that noise can make differ freely. Each has an F distribution whatever the size of the noise, so it also
tells where the noise was stated too small; and they are independent of each other, so that the least of k p-values
has the p-value 1 - (1 - p)^k.

Loads: by virtual work the torque about joint k of a weight in direction g at the point x is g . dx / dq_k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import special

from fg_calib.graph.factors import build_variables, prior_rows, unknown_prior_rows
from fg_calib.graph.problem import Problem, at_parameters
from fg_calib.graph.rows import At, RowSet
from fg_calib.graph.solver import Solution
from fg_calib.measurements import residuals
from fg_calib.measurements.residuals import Block
from fg_calib.observability.parallel_axes import MissingMotion, end_of_link
from fg_calib.robot.kinematics import Chain, pose
from fg_calib.robot.model import FRAME_KINDS, Axis, Element, Parameter, Robot

Floats = NDArray[np.float64]

MAX_ROWS = 10_000
"""Rows up to which residuals are tested: more would take long, and are seldom needed to tell."""

LEAST_LEFT = 10
"""Degrees of freedom that a stage must leave."""

_RANK = 1e-8
"""Part of a column that counts as nothing."""

_NOTHING = 1e-10
"""Size of a column over the largest below which it is rounding errors."""

LINK = "small motion of link "
"""How names of the columns of links' small motions begin."""


def probability_of_noise(solution: Solution) -> float | None:
    """Probability that noise alone follows the arm as much as the residuals of a solution do.

    Returns:
        The p-value; None where it cannot be told: too few rows or too many, a robust loss, touched points, anchors or
        targets (also where they are known), joint values estimated, rows that share errors but are weighted as
        independent.
    """
    problem, state = solution.problem, solution.problem.state
    weighted = state.weights is not None or state.joint_errors is not None
    several = problem.data.unknowns.names or problem.has_more or weighted or problem.missing_correlation
    if several or problem.n_residuals > MAX_ROWS:
        return None
    chains, names = with_link_motions(problem, solution.parameters)
    chains = tuple(chain.with_joint_columns() for chain in chains)
    of_stage = np.array([2 if name.startswith(LINK) else 0 for name in names])
    of_stage = np.concatenate([of_stage, np.repeat(_STAGES, problem.robot.n_joints)])
    errors = [_errors(problem.robot, table.measurements.readings) for table in problem.data.tables]
    rows = np.concatenate([_rows(row_set, chains, errors) for row_set in problem.rows])
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    of_priors = np.zeros((len(r_prior), rows.shape[1]))
    of_priors[:, np.flatnonzero(of_stage == 0)] = J_prior
    of_priors[:, -1] = r_prior
    return _probability(np.concatenate([rows, of_priors]), of_stage, problem.n_independent + len(r_prior))


def _probability(rows: Floats, of_stage: NDArray[np.int64], n: int) -> float | None:
    """The p-value of residuals; None where no stage leaves enough.

    Args:
        rows: Whitened derivatives in all columns, and residuals.
        of_stage: The stage of each column, 0 of the model's, shape (n_columns,).
        n: Residuals that noise can make differ freely.
    """
    r, fitted = rows[:, -1], np.zeros((len(rows), 0))
    least, stages, left, n_left = 1.0, 0, 0.0, 0
    for stage in range(of_stage.max() + 1):
        columns = rows[:, :-1][:, of_stage == stage]
        new = basis_of(columns, fitted)
        drop, m = float(np.sum((new.T @ r) ** 2)), new.shape[1]
        if stage == 0:
            left, n_left = float(r @ r) - drop, n - m
        elif m and n_left - m >= LEAST_LEFT:
            left, n_left, stages = left - drop, n_left - m, stages + 1
            least = min(least, float(special.fdtrc(m, n_left, (drop / m) / max(left / n_left, 1e-300))))
        else:
            continue  # what it does is left to chance
        fitted = np.hstack([fitted, new])
    return -float(np.expm1(stages * np.log1p(-min(least, 1.0 - 1e-16)))) if stages else None


def excess_left(solution: Solution, missing: Sequence[MissingMotion]) -> float:
    """Part of the excess of chi-square that is left if links may make the small motions that a convention leaves out.

    Args:
        solution: The solution.
        missing: What the convention leaves out.

    Returns:
        0 where nothing is left, 1 where they explain nothing; 0 too where there are more rows than `MAX_ROWS`.
    """
    problem = solution.problem
    if problem.n_residuals > MAX_ROWS:
        return 0.0
    at = at_parameters(problem, solution.parameters)
    chains, names = with_link_motions(problem, solution.parameters)
    more = len(names) - at.n_columns
    columns = np.where(at.columns >= 0, at.columns + more, -1)
    wide = replace(at, chains=chains, n_columns=len(names), columns=columns)
    motions = [names.index(name) for name in _columns_of(missing, problem.robot)]
    more_columns = [i for i, name in enumerate(names) if name.startswith(LINK)]
    fit = linear_fit(solution, wide, more_columns)
    new = fit.new(motions)
    total, drop = float(fit.r @ fit.r), float(np.sum((new.T @ fit.r) ** 2))
    return float(max(total - drop - (fit.dof - new.shape[1]), 0.0) / max(total - fit.dof, 1e-300))


@dataclass(frozen=True)
class LinearFit:
    """The linearised fit of rows and priors, and the rows' derivatives in columns that it does not have.

    Attributes:
        J: Derivatives of the rows in all columns, shape (n_rows, n_columns).
        r: What the fit leaves of rows and priors, shape (n,).
        fitted: Basis of its columns, shape (n, rank).
        dof: Degrees of freedom that are left.
    """

    J: Floats
    r: Floats
    fitted: Floats
    dof: int

    def new(self, columns: Sequence[int]) -> Floats:
        """A basis of what some columns add to the fit, shape (n, m)."""
        of_rows = self.J[:, list(columns)]
        return basis_of(np.concatenate([of_rows, np.zeros((len(self.r) - len(of_rows), len(columns)))]), self.fitted)


def linear_fit(solution: Solution, wide: At, more: Sequence[int]) -> LinearFit:
    """The fit of a solution, linearised, beside columns that it does not have.

    Args:
        solution: The solution.
        wide: The arm and the unknowns at it, with more columns than were estimated.
        more: These.
    """
    problem = solution.problem
    r, J = (np.concatenate(parts) for parts in zip(*(rows.linearise(wide) for rows in problem.rows), strict=True))
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    r_unknown, J_unknown = unknown_prior_rows(problem.variables, solution.parameters)
    own = np.delete(J, list(more), axis=1)
    of_core = np.hstack([J_prior, np.zeros((len(J_prior), problem.variables.n_nuisance))])
    fitted = basis_of(np.concatenate([own, of_core, J_unknown]))
    r = np.concatenate([r, r_prior, r_unknown])
    dof = problem.n_independent + len(r_prior) + len(r_unknown) - fitted.shape[1]
    return LinearFit(J, r - fitted @ (fitted.T @ r), fitted, dof)


_KINDS = {Axis.TX: "x", Axis.TY: "y", Axis.TZ: "z", Axis.RX: "roll", Axis.RY: "pitch", Axis.RZ: "yaw"}


def _columns_of(missing: Sequence[MissingMotion], robot: Robot) -> list[str]:
    """Names of the columns (see `with_link_motions`) of motions that a convention or a frame's angles leave out."""
    found = []
    for motion in missing:
        if motion.frame:  # a tilt of the frame that it is of, whichever way
            link = min(max(motion.axes[0] - 1, 0), robot.n_joints)
            found += [f"{LINK}{link}: {kind}" for kind in ("roll", "pitch", "yaw")]
        else:
            found += [f"{LINK}{axis}: {_KINDS[axes]}" for axis in motion.axes[:-1] for axes in motion.motions]
    return list(dict.fromkeys(found))


def with_link_motions(problem: Problem, parameters: Floats) -> tuple[tuple[Chain, ...], tuple[str, ...]]:
    """The chains at a parameter vector with columns for the links' small motions too, and the columns' names.

    Six columns are called `LINK` and the number of their joint: those of the base 0, those of the tool as many as there
    are joints.
    """
    robot = _with_link_motions(problem.robot)
    variables = build_variables(robot, [table.unknown_frame for table in problem.data.tables])
    n, n_more = len(problem.robot.parameters), len(robot.parameters) - len(problem.robot.parameters)
    values = np.concatenate([parameters[:n], np.zeros(n_more), parameters[problem.variables.frame_span]])
    return tuple(chain.at(values) for chain in variables.chains), variables.names


def _with_link_motions(robot: Robot) -> Robot:
    """The robot with six more parameters, all zero, at the end of each link, the base's and the tool's among them."""
    elements, parameters = list(robot.elements), list(robot.parameters)
    for owner in range(robot.n_joints, -1, -1):
        place = end_of_link(robot, owner)
        for kind in FRAME_KINDS:
            more = Parameter(f"{LINK}{owner}: {kind}", kind, owner, 0.0)
            elements.insert(place, Element(more.axis, parameter=len(parameters)))
            parameters.append(more)
    return replace(robot, elements=tuple(elements), parameters=tuple(parameters))


def _rows(row_set: RowSet, chains: tuple[Chain, ...], errors: Sequence[Floats]) -> Floats:
    """Whitened derivatives in the chains' columns and the joints' errors, and residuals, one row a scalar."""
    rows = [_private_rows(part.block, chains[part.table], errors[part.table]) for part in row_set.parts]
    together = np.concatenate(rows)
    return together if row_set.shared is None else row_set.shared.whiten(together)


def _private_rows(part: Block, chain: Chain, errors: Floats) -> Floats:
    """[J Z r] of a block before what its rows share is taken out, shape (n_rows, n_columns + n_errors * n_joints + 1).

    Args:
        part: The block.
        chain: The chain of its table.
        errors: See `_errors`.
    """
    r, J = residuals.linearise(part, chain)
    own, n = J[:, :, : chain.n_columns], chain.n_joints
    moved = np.zeros((*r.shape, errors.shape[1], n))
    for k, rows in enumerate(part.ends.T):
        of_end = J[:, :, chain.n_columns + k * n : chain.n_columns + (k + 1) * n]
        moved += of_end[:, :, None, :] * errors[rows][:, None]
    return np.concatenate([own, moved.reshape(*r.shape, -1), r[:, :, None]], axis=2).reshape(r.size, -1)


_STAGES = (1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3)
"""The stages of `_errors`."""


def _errors(robot: Robot, readings: Floats) -> Floats:
    """What a joint's error may follow, shape (n, len(_STAGES), n_joints).

    Loads along z; how far the tool reaches out; once and twice round with the joint (of a slide its place and the
    square of that); loads along x and y.
    """
    at = pose(robot, readings)
    turns, shifts = np.split(at.jacobian[:, :, len(robot.parameters) :], 2, axis=1)  # (n, 3, n_joints) each
    of_links = np.zeros_like(shifts)
    for owner in range(1, robot.n_joints):
        link = pose(replace(robot, elements=robot.elements[: end_of_link(robot, owner)]), readings)
        arm = (link.position - at.position)[:, :, None]
        of_links[:, :, :owner] += (shifts + np.cross(turns, arm, axis=1))[:, :, :owner]
    slides = np.array([joint.prismatic for joint in robot.joints])
    cos, sin = np.where(slides, readings, np.cos(readings)), np.where(slides, 0.0, np.sin(readings))
    reach = np.repeat(np.linalg.norm(at.position[:, :2], axis=1)[:, None], robot.n_joints, axis=1)
    (x, y, z), (x_links, y_links, z_links) = np.moveaxis(shifts, 1, 0), np.moveaxis(of_links, 1, 0)
    return np.stack([z, z_links, reach, cos, sin, cos * cos, cos * sin, x, x_links, y, y_links], axis=1)


def basis_of(columns: Floats, fitted: Floats | None = None) -> Floats:
    """An orthonormal basis of what columns add to an orthonormal one; what is left of nothing is nothing."""
    fitted = np.zeros((len(columns), 0)) if fitted is None else fitted
    size = np.linalg.norm(columns, axis=0)
    rest = columns - fitted @ (fitted.T @ columns)
    scaled = rest / np.maximum(size, max(_NOTHING * float(np.max(size, initial=0.0)), 1e-300))
    Q, R, _ = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
    basis: Floats = Q.astype(np.float64)[:, : int(np.sum(np.abs(np.diag(R)) > _RANK * np.sqrt(len(size))))]
    return basis
