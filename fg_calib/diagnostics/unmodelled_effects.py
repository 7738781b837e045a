"""Unmodelled effects: lack of fit, a change point, a missing convention parameter, a forgotten instrument offset.

Each is a score test: the rows are fitted again, linearly, with more columns than J of the model, whose priors are
rows too, and what these gain is compared with chance,

    F = |Q^T r|^2 / m over |r - Q Q^T r|^2 / (n - rank J - m)

with r the residuals of the model's fit, Q a basis of what the columns add to J, m its rank and n the residuals that
noise can make differ freely. It has an F distribution whatever the size of the noise.

*Lack of fit* adds what real arms have beyond their model, stage by stage; the statistics of the stages are independent,
so that the least of k p-values has the p-value 1 - (1 - p)^k:

1. compliance of joints: gravity along z of the base, loads at the tool and on every link after the joint;
2. joints that are off by a part of how far the tool reaches out, every small motion of every link, and errors of each
   joint of one and two periods a turn (eccentric encoders and gears, gains of prismatic joints);
3. the same loads of an arm that is mounted otherwise, gravity along x and y.

A *change point* is a small motion of tool or base from one row of a table on, for every row tried (Bonferroni). Other
effects explain a part of it, so it has to explain nearly all of the misfit, also next to constant small motions of all
links. A *missing convention parameter* is the same test of small motions between links. An *offset* is added to every
length of a table to anchors; it hides in the arm's parameters: 0.25 mm of a ball bar made residuals 1.1 times as large
as specified.

Loads: by virtual work the torque about joint k of a weight in direction g at the point x is g . dx / dq_k.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy import special

from fg_calib.graph import Problem, Solution, State, at_parameters, build_variables, prior_rows, unknown_prior_rows
from fg_calib.inputs import Floats
from fg_calib.measurements import LANDMARKS, Block, residuals
from fg_calib.observability import MissingMotion, end_of_link
from fg_calib.robot import AXIS_OF_KIND, FRAME_KINDS, Chain, Element, Parameter, Robot, pose

MAX_ROWS = 10_000
"""Rows up to which residuals are tested: more would take long, and are seldom needed."""

LEAST_LEFT = 10
"""Degrees of freedom that a stage must leave."""

LEAST_SIDE, MAX_TRIED = 6, 100
"""Configurations before and after a change, and rows at which one is tried, evenly spaced if there are more."""

P_VALUE = 1e-6
"""P-value below which a change, an offset and a missing parameter are significant: other effects mimic a little."""

CHANGE_LEFT, MISSING_LEFT = 0.25, 0.8
"""Part of the excess of chi-square that a change, and a missing parameter of the convention, leave at most."""

_RANK = 1e-8
"""Part of a column that counts as nothing."""

_NOTHING = 1e-10
"""Size of a column over the largest below which it is rounding errors."""

LINK = "small motion of link "
"""How names of the columns of links' small motions begin."""

_STAGES = (1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3)
"""The stages of `_joint_errors`."""


@dataclass(frozen=True)
class Change:
    """Something that moved between two rows of a table.

    Attributes:
        what: `tool` or `base`.
        configuration: The first after it, by its number among all.
        left: Part of chi-square that is left with a tool or a base of its own from there on.
    """

    what: str
    configuration: int
    left: float


@dataclass(frozen=True)
class Offset:
    """An offset that an instrument seems to add to every length.

    Attributes:
        table: Number of its table.
        size: The offset, [m].
        sigma: Its 1 sigma by the noise as estimated, [m].
    """

    table: int
    size: float
    sigma: float


@dataclass(frozen=True)
class LinearFit:
    """The linearised fit of rows and priors, and its score tests.

    Attributes:
        r: Residuals of the fit, rows first, then priors, shape (n,).
        fitted: Orthonormal basis of its columns, shape (n, rank).
        dof: Degrees of freedom.
    """

    r: Floats
    fitted: Floats
    dof: int

    @classmethod
    def of(cls, columns: Floats, r: Floats, n: int) -> LinearFit:
        """The fit of columns, shape (n_rows, m), to residuals of which noise can make n differ freely."""
        fitted = basis_of(columns)
        return cls(r - fitted @ (fitted.T @ r), fitted, n - fitted.shape[1])

    def new(self, columns: Floats) -> Floats:
        """An orthonormal basis of what columns of the rows, shape (n_rows, m), add to the fit."""
        none = np.zeros((len(self.r) - len(columns), columns.shape[1]))
        return basis_of(np.concatenate([columns, none]), self.fitted)

    def extended(self, new: Floats) -> LinearFit:
        """The fit with more columns, by `new`."""
        fitted = np.hstack([self.fitted, new])
        return LinearFit(self.r - new @ (new.T @ self.r), fitted, self.dof - new.shape[1])

    def test(self, new: Floats) -> tuple[float, float]:
        """P-value of what more columns, by `new`, explain, and the part of the excess of chi-square that they leave."""
        total, drop, m = float(self.r @ self.r), float(np.sum((new.T @ self.r) ** 2)), new.shape[1]
        if not m or self.dof - m < 1:
            return 1.0, 1.0
        ratio = (drop / m) / max((total - drop) / (self.dof - m), 1e-300)
        left = max(total - drop - (self.dof - m), 0.0) / max(total - self.dof, 1e-300)
        return float(special.fdtrc(m, self.dof - m, ratio)), left


def probability_of_noise(solution: Solution) -> float | None:
    """P-value of residuals as systematic as those of a solution, were there noise alone.

    Returns:
        None where it cannot be told: too few rows or too many, a robust loss, landmarks (also known ones), joint values
        estimated, rows that share errors but are weighted as independent.
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
    errors = [_joint_errors(problem.robot, table.measurements.readings) for table in problem.data.tables]
    found = []
    for row_set in problem.rows:
        private = [_with_joint_errors(part.block, chains[part.table], errors[part.table]) for part in row_set.parts]
        rows = np.concatenate(private)
        found.append(rows if row_set.states is None else row_set.states.whiten(rows))
    rows = np.concatenate(found)
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    model = np.concatenate([rows[:, :-1][:, of_stage == 0], J_prior])
    fit = LinearFit.of(model, np.concatenate([rows[:, -1], r_prior]), problem.n_independent + len(r_prior))
    least, stages = 1.0, 0
    for stage in range(1, max(_STAGES) + 1):
        new = fit.new(rows[:, :-1][:, of_stage == stage])
        if new.shape[1] and fit.dof - new.shape[1] >= LEAST_LEFT:  # else what it does is left to chance
            least, stages = min(least, fit.test(new)[0]), stages + 1
            fit = fit.extended(new)
    return -float(np.expm1(stages * np.log1p(-min(least, 1.0 - 1e-16)))) if stages else None


def find_change(solution: Solution) -> Change | None:
    """The change point of a table: what moved between two of its rows; None without, or where it cannot be told.

    Note:
        It is looked for in one table of poses, positions or orientations, without robust losses.
    """
    problem, state = solution.problem, solution.problem.state
    other = problem.data.unknowns.names or problem.has_more or state.weights is not None
    parts = [part.block for rows in problem.rows for part in rows.parts]
    several = len(problem.data.tables) > 1 or any(rows.states is not None for rows in problem.rows)
    pairs = any(block.kind.ends != 1 for block in parts)
    if other or several or pairs or state.joint_errors is not None or problem.n_residuals > MAX_ROWS:
        return None
    fit, of_links = _with_links(solution)
    links = {"tool": problem.robot.n_joints, "base": 0}
    motions = {what: of_links([f"{LINK}{link}: {kind}" for kind in FRAME_KINDS]) for what, link in links.items()}
    at = np.concatenate([np.repeat(block.ends[:, 0], block.residual_dim) for block in parts])
    first = np.unique(at)[LEAST_SIDE : 1 - LEAST_SIDE]
    first = first[np.unique(np.linspace(0, len(first) - 1, min(MAX_TRIED, len(first))).astype(np.int64))]
    found = [(*fit.test(fit.new(J * (at >= k)[:, None])), what, int(k)) for k in first for what, J in motions.items()]
    if not found:
        return None
    p, left, what, k = min(found)
    moved = motions[what] * (at >= k)[:, None]
    with_links, after = fit.extended(fit.new(of_links([]))), fit.extended(fit.new(moved))
    p_with, left_with = with_links.test(with_links.new(moved))
    if max(p * len(found), p_with) >= P_VALUE or max(left, left_with) > CHANGE_LEFT:
        return None
    return Change(what, k, float(np.sum(after.r**2) / np.sum(fit.r**2)))


def explains_misfit(solution: Solution, motion: MissingMotion) -> bool:
    """Whether a motion that the convention has no parameter for explains a part of the misfit; assumed of many rows."""
    problem = solution.problem
    if problem.n_residuals > MAX_ROWS:
        return True
    if motion.frame:
        link = min(max(motion.axes[0] - 1, 0), problem.robot.n_joints)
        names = [f"{LINK}{link}: {kind}" for kind in ("roll", "pitch", "yaw")]
    else:
        kinds = {AXIS_OF_KIND[kind]: kind for kind in FRAME_KINDS}
        names = [f"{LINK}{axis}: {kinds[axes]}" for axis in motion.axes[:-1] for axes in motion.motions]
    fit, of_links = _with_links(solution)
    p, left = fit.test(fit.new(of_links(names)))
    return p < P_VALUE and left <= MISSING_LEFT


def forgotten_offsets(solution: Solution) -> tuple[Offset, ...]:
    """Offsets of instruments that were not estimated and are significant; none of more rows than `MAX_ROWS`.

    With a robust loss, which cuts residuals off, noise counts as specified at least.
    """
    problem, found = solution.problem, list[Offset]()
    unknowns, series = problem.data.unknowns, [s for s in problem.data.series if len(s.train)]
    offsets = [i for i, letter in enumerate(unknowns.letters) if LANDMARKS[letter].is_one]
    if not offsets or problem.n_residuals > MAX_ROWS or problem.has_more:
        return ()
    at = at_parameters(problem, solution.parameters)
    column, columns = at.n_columns + at.n_nuisance, at.columns
    for place in np.flatnonzero(np.isin(unknowns.owners, offsets) & (columns < 0)).tolist():
        tables = [s.table for s in series if np.any(s.nuisances[s.train] == place)]
        if not tables:
            continue  # contacts alone
        wide = np.where(np.arange(len(columns)) == place, column, columns)
        fit, J = _linear_fit(solution, replace(at, columns=wide, n_nuisance=at.n_nuisance + 1), [column])
        new = fit.new(J)
        if fit.test(new)[0] < P_VALUE:
            after, per_metre = fit.extended(new), float(new[: len(J), 0] @ J[:, 0])
            least = 1e-300 if problem.state.weights is None else 1.0
            sigma = np.sqrt(max(float(after.r @ after.r) / after.dof, least))
            found.append(Offset(tables[0], -float(new[:, 0] @ fit.r) / per_metre, float(sigma) / abs(per_metre)))
    return tuple(found)


def _with_links(solution: Solution) -> tuple[LinearFit, Callable[[Sequence[str]], Floats]]:
    """The fit of a solution, and the rows' derivatives in links' small motions by name; in all where none is named."""
    at = at_parameters(solution.problem, solution.parameters)
    chains, names = with_link_motions(solution.problem, solution.parameters)
    columns = np.where(at.columns >= 0, at.columns + len(names) - at.n_columns, -1)
    wide = replace(at, chains=chains, n_columns=len(names), columns=columns)
    links = [name for name in names if name.startswith(LINK)]
    fit, J = _linear_fit(solution, wide, [names.index(name) for name in links])
    return fit, lambda named: J[:, [links.index(name) for name in named or links]]


def _linear_fit(solution: Solution, wide: State, more: Sequence[int]) -> tuple[LinearFit, Floats]:
    """The fit of a solution, linearised, and the rows' derivatives in columns that it does not have, shape (n_rows, m).

    Args:
        solution: The solution.
        wide: The arm and the landmarks at it, with more columns than were estimated.
        more: Numbers of these.
    """
    problem = solution.problem
    r, J = (np.concatenate(parts) for parts in zip(*(rows.linearise(wide) for rows in problem.rows), strict=True))
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    r_unknown, J_unknown = unknown_prior_rows(problem.variables, solution.parameters)
    of_core = np.hstack([J_prior, np.zeros((len(J_prior), problem.variables.n_nuisance))])
    columns = np.concatenate([np.delete(J, list(more), axis=1), of_core, J_unknown])
    n = problem.n_independent + len(r_prior) + len(r_unknown)
    return LinearFit.of(columns, np.concatenate([r, r_prior, r_unknown]), n), J[:, list(more)]


def with_link_motions(problem: Problem, at: Floats) -> tuple[tuple[Chain, ...], tuple[str, ...]]:
    """The chains at a parameter vector with columns for the links' small motions too, and the columns' names.

    Six columns are called `LINK` and the number of their joint: those of the base 0, those of the tool as many as there
    are joints.
    """
    robot = problem.robot
    elements, parameters = list(robot.elements), list(robot.parameters)
    for owner in range(robot.n_joints, -1, -1):
        place = end_of_link(robot, owner)
        for kind in FRAME_KINDS:
            more = Parameter(f"{LINK}{owner}: {kind}", kind, owner, 0.0)
            elements.insert(place, Element(more.axis, parameter=len(parameters)))
            parameters.append(more)
    wide = replace(robot, elements=tuple(elements), parameters=tuple(parameters))
    variables = build_variables(wide, [table.unknown_frame for table in problem.data.tables])
    none = np.zeros(len(parameters) - len(robot.parameters))
    values = np.concatenate([at[: len(robot.parameters)], none, at[problem.variables.frame_span]])
    return tuple(chain.at(values) for chain in variables.chains), variables.names


def _with_joint_errors(block: Block, chain: Chain, errors: Floats) -> Floats:
    """[J Z r] of a block before what its rows share is taken out, shape (n_rows, n_columns + n_errors * n_joints + 1).

    Args:
        block: The block.
        chain: The chain of its table, with joint columns.
        errors: See `_joint_errors`.
    """
    r, J = residuals.linearise(block, chain)
    model, n = J[:, :, : chain.n_columns], chain.n_joints
    moved = np.zeros((*r.shape, errors.shape[1], n))
    for k, rows in enumerate(block.ends.T):
        of_end = J[:, :, chain.n_columns + k * n : chain.n_columns + (k + 1) * n]
        moved += of_end[:, :, None, :] * errors[rows][:, None]
    return np.concatenate([model, moved.reshape(*r.shape, -1), r[:, :, None]], axis=2).reshape(r.size, -1)


def _joint_errors(robot: Robot, readings: Floats) -> Floats:
    """What a joint's error may follow by configuration, shape (n, len(_STAGES), n_joints).

    Loads along z; how far the tool reaches out; harmonics of one and two periods a turn (of a prismatic joint its
    position and the square of that); loads along x and y.
    """
    at = pose(robot, readings)
    rotations, shifts = np.split(at.jacobian[:, :, len(robot.parameters) :], 2, axis=1)  # (n, 3, n_joints) each
    of_links = np.zeros_like(shifts)
    for owner in range(1, robot.n_joints):
        link = pose(replace(robot, elements=robot.elements[: end_of_link(robot, owner)]), readings)
        arm = (link.position - at.position)[:, :, None]
        of_links[:, :, :owner] += (shifts + np.cross(rotations, arm, axis=1))[:, :, :owner]
    prismatic = np.array([joint.prismatic for joint in robot.joints])
    cos, sin = np.where(prismatic, readings, np.cos(readings)), np.where(prismatic, 0.0, np.sin(readings))
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
