"""Unmodelled effects: lack of fit, a change point, a missing convention parameter, a forgotten instrument offset.

Each is a score test: the rows are fitted again, linearly, with more columns than the model has (`regress`), and what
these gain is compared with chance,

    F = |Q^T r|^2 / m over |r - Q Q^T r|^2 / (n - rank J - m)

with r the residuals of the model's fit, J its columns, those of the priors too, Q a basis of what the columns add to J,
m its rank and n the residuals that noise can make differ freely. It has an F distribution whatever the size of the
noise. The least p-value p of k tests has the p-value 1 - (1 - p)^k.

*Lack of fit* adds what real arms have beyond their model, stage by stage; the statistics of the stages are independent:

1. compliance of joints: gravity along z of the base, loads at the tool and on every link after the joint;
2. joints that are off by a part of how far the tool reaches out, every small motion of every link, and errors of each
   joint of one and two periods a turn (eccentric encoders and gears, gains of prismatic joints);
3. the same loads of an arm that is mounted otherwise, gravity along x and y.

A *change point* is a small motion of tool or base from one row of a table on, for every row tried. Other effects
explain a part of it, so it has to explain nearly all of the misfit, also next to constant small motions of all links.
A *missing convention parameter* is the same test of small motions between links. An *offset* is added to every length
of a table to anchors; it hides in the arm's parameters: 0.25 mm of a ball bar made residuals 1.1 times as large as
specified.

Loads: by virtual work the torque about joint k of a weight in direction g at the point x is g . dx / dq_k.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import special

from fg_calib.graph import Problem, Solution, build_variables, prior_rows, unknown_prior_rows
from fg_calib.inputs import Floats
from fg_calib.measurements import Block, residuals
from fg_calib.observability import MissingMotion, end_of_link
from fg_calib.robot import FRAME_KINDS, PARAMETER_KINDS, Chain, Element, Parameter, Robot, pose

MAX_ROWS = 10_000
"""Rows up to which residuals are tested: more would take long, and are seldom needed."""

LEAST_LEFT = 10
"""Degrees of freedom that a test must leave: else what it does is left to chance."""

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

LINK, OFFSET, STAGE = "small motion of link ", "offset ", "joint errors of stage "
"""How names of columns that a model does not have begin: see `regress`."""

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

    def padded(self, columns: Floats) -> Floats:
        """Columns of the rows, shape (n_rows, m), of the priors too."""
        return np.pad(columns, ((0, len(self.r) - len(columns)), (0, 0)))

    def test(self, columns: Floats) -> tuple[float, float, LinearFit]:
        """A score test of more columns of the rows, shape (n_rows, m).

        Returns:
            The p-value of what they explain, the part of the excess of chi-square that they leave, and the fit with
            them; 1, 1 and this fit where they add nothing, or leave too few degrees of freedom.
        """
        new = basis_of(self.padded(columns), self.fitted)
        after = LinearFit(self.r - new @ (new.T @ self.r), np.hstack([self.fitted, new]), self.dof - new.shape[1])
        total, rest, m = float(self.r @ self.r), float(after.r @ after.r), new.shape[1]
        if not m or after.dof < LEAST_LEFT:
            return 1.0, 1.0, self
        ratio = ((total - rest) / m) / max(rest / after.dof, 1e-300)
        left = max(rest - after.dof, 0.0) / max(total - self.dof, 1e-300)
        return float(special.fdtrc(m, after.dof, ratio)), left, after


def of_several(p: float, n: int) -> float:
    """The p-value of the least p-value of n tests."""
    return -float(np.expm1(n * np.log1p(-min(p, 1.0 - 1e-16))))


def probability_of_noise(solution: Solution) -> float | None:
    """P-value of residuals as systematic as those of a solution, were there noise alone.

    Returns:
        None where it cannot be told: too few rows or too many, a robust loss, landmarks (also known ones), joint values
        estimated, rows that share errors but are weighted as independent.
    """
    problem = solution.problem
    if problem.data.landmarks.names or not _is_plain(problem) or problem.rows.counted_as_private:
        return None
    fit, J, names = regress(solution)
    least, n = 1.0, 0
    for stage in range(1, max(_STAGES) + 1):
        links = np.char.startswith(names, LINK) & (stage == 2)
        p, _, after = fit.test(J[:, links | (names == f"{STAGE}{stage}")])
        if after is not fit:
            least, n, fit = min(least, p), n + 1, after
    return of_several(least, n) if n else None


def _is_plain(problem: Problem) -> bool:
    """Whether there are few enough rows, each of which counts as its noise says."""
    weighted = problem.state.weights is not None or problem.joints_estimated
    return not (problem.has_more or weighted or problem.n_residuals > MAX_ROWS)


def find_change(solution: Solution) -> Change | None:
    """The change point of a table: what moved between two of its rows; None without, or where it cannot be told.

    Note:
        It is looked for in one table of poses, positions or orientations, without robust losses.
    """
    problem = solution.problem
    blocks = [part.block for part in problem.rows.parts]
    several = len(problem.data.tables) > 1 or problem.rows.states.n_states > 0
    if several or not _is_plain(problem) or problem.data.landmarks.names or any(b.kind.ends != 1 for b in blocks):
        return None
    fit, J, names = regress(solution)
    links = {"tool": problem.robot.n_joints, "base": 0}
    motions = {what: J[:, np.char.startswith(names, f"{LINK}{link}.")] for what, link in links.items()}
    at = np.concatenate([np.repeat(block.ends[:, 0], block.residual_dim) for block in blocks])
    first = np.unique(at)[LEAST_SIDE : 1 - LEAST_SIDE]
    first = first[np.unique(np.linspace(0, len(first) - 1, min(MAX_TRIED, len(first))).astype(np.int64))]
    found = [(*fit.test(M * (at >= k)[:, None])[:2], what, int(k)) for k in first for what, M in motions.items()]
    if not found:
        return None
    p, left, what, k = min(found)
    moved = motions[what] * (at >= k)[:, None]
    p_with, left_with, _ = fit.test(J[:, np.char.startswith(names, LINK)])[2].test(moved)
    if max(of_several(p, len(found)), p_with) >= P_VALUE or max(left, left_with) > CHANGE_LEFT:
        return None
    return Change(what, k, float(np.sum(fit.test(moved)[2].r ** 2) / np.sum(fit.r**2)))


def explains_misfit(solution: Solution, motion: MissingMotion) -> bool:
    """Whether a motion that the convention has no parameter for explains a part of the misfit; assumed of many rows."""
    problem = solution.problem
    if problem.n_residuals > MAX_ROWS:
        return True
    kinds = {PARAMETER_KINDS[kind].axis: kind for kind in FRAME_KINDS}
    wanted = [f"{LINK}{axis}.{kinds[one]}" for axis in motion.axes[:-1] for one in motion.motions]
    fit, J, names = regress(solution)
    p, left, _ = fit.test(J[:, np.isin(names, wanted)])
    return p < P_VALUE and left <= MISSING_LEFT


def forgotten_offsets(solution: Solution) -> tuple[Offset, ...]:
    """Offsets of instruments that were not estimated and are significant; none of more rows than `MAX_ROWS`."""
    problem, found = solution.problem, list[Offset]()
    if not _offsets(problem) or problem.n_residuals > MAX_ROWS or problem.has_more:
        return ()
    fit, J, names = regress(solution)
    for table in _offsets(problem).values():
        column = fit.padded(J[:, names == f"{OFFSET}{table}"])[:, 0]
        p, _, after = fit.test(column[:, None])
        if p < P_VALUE:
            new = column - fit.fitted @ (fit.fitted.T @ column)
            sigma = np.sqrt(float(after.r @ after.r) / after.dof / float(new @ new))
            found.append(Offset(table, -float(new @ fit.r) / float(new @ new), float(sigma)))
    return tuple(found)


def _offsets(problem: Problem) -> dict[int, int]:
    """Tables with an offset that is not estimated, by the offset's place among the nuisance coordinates."""
    unknowns, columns = problem.data.landmarks, problem.variables.coordinates
    numbers = [i for i, item in enumerate(unknowns.items) if item.kind.is_one]
    return {
        place: s.table
        for place in np.flatnonzero(np.isin(unknowns.owners, numbers) & (columns < 0)).tolist()
        for s in problem.data.blocks
        if np.any(s.nuisances[s.train] == place)
    }


def regress(solution: Solution) -> tuple[LinearFit, Floats, NDArray[np.str_]]:
    """The fit of a solution, linearised, and columns that it does not have, by name.

    These are the six small motions of each link (`LINK`, the number of the joint before it, the kind), the offsets of
    tables that were not estimated (`OFFSET`, the number of the table), and joint errors (`STAGE` and the stage).

    Returns:
        The fit, the columns of the rows, shape (n_rows, m), and their names, shape (m,).
    """
    problem, at = solution.problem, solution.problem.variables.at(solution.parameters)
    (chains, core), offsets = with_link_motions(problem, solution.parameters), _offsets(problem)
    errors = [_joint_errors(problem.robot, t.measurements.readings) for t in problem.data.tables]
    columns = np.where(at.columns >= 0, at.columns + len(core) - at.n_columns, -1)
    columns[list(offsets)] = len(core) + at.n_nuisance + np.arange(len(offsets))
    wide = replace(at, chains=chains, n_columns=len(core), columns=columns, n_nuisance=at.n_nuisance + len(offsets))
    rows = problem.rows
    of_joints = [_by_joint_errors(part.at(wide), chains[part.table], errors[part.table]) for part in rows.parts]
    private = np.hstack([np.concatenate(of_joints), rows.private(wide)])
    J, r = np.split(rows.states.whiten(private), [-1], axis=1)
    names = [f"{STAGE}{stage}" for stage in np.repeat(_STAGES, problem.robot.n_joints)]
    names += [name if name.startswith(LINK) else "" for name in core] + [""] * at.n_nuisance
    all_names = np.array(names + [f"{OFFSET}{table}" for table in offsets.values()])
    more = all_names != ""
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    r_unknown, J_unknown = unknown_prior_rows(problem.variables, solution.parameters)
    J_prior = np.pad(J_prior, ((0, 0), (0, problem.variables.n_nuisance)))
    n = problem.n_independent + len(r_prior) + len(r_unknown)
    columns = np.concatenate([J[:, ~more], J_prior, J_unknown])
    fitted, r = basis_of(columns), np.concatenate([r[:, 0], r_prior, r_unknown])
    return LinearFit(r - fitted @ (fitted.T @ r), fitted, n - fitted.shape[1]), J[:, more], all_names[more]


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
            more = Parameter(f"{LINK}{owner}.{kind}", kind, owner, 0.0)
            elements.insert(place, Element(PARAMETER_KINDS[kind].axis, parameter=len(parameters)))
            parameters.append(more)
    wide = replace(robot, elements=tuple(elements), parameters=tuple(parameters))
    variables = build_variables(wide, [table.unknown_frame for table in problem.data.tables])
    none = np.zeros(len(parameters) - len(robot.parameters))
    values = np.concatenate([at[: len(robot.parameters)], none, at[problem.variables.frame_span]])
    return tuple(chain.at(values) for chain in variables.chains), variables.names


def _by_joint_errors(block: Block, chain: Chain, errors: Floats) -> Floats:
    """Derivatives of a block in joint errors, before what its rows share is taken out, shape (n_rows, m).

    Args:
        block: The block.
        chain: The chain of its table.
        errors: See `_joint_errors`.
    """
    r, J = residuals.linearise(block, chain.with_joint_columns())
    moved, n = np.zeros((*r.shape, *errors.shape[1:])), chain.n_joints
    for k, rows in enumerate(block.ends.T):
        first = chain.n_columns + k * n
        moved += J[:, :, None, first : first + n] * errors[rows][:, None]
    return moved.reshape(r.size, -1)


def _joint_errors(robot: Robot, readings: Floats) -> Floats:
    """Effects that a joint's error may follow, shape (n, len(_STAGES), n_joints).

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
