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

from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import special

from fg_calib.graph import Problem, Solution, build_variables, prior_rows, subsampled, unknown_prior_rows
from fg_calib.inputs import Floats, Record
from fg_calib.measurements import Block, residuals
from fg_calib.observability import MissingMotion, end_of_link
from fg_calib.robot import FRAME_KINDS, PARAMETER_KINDS, Chain, Element, Parameter, Robot, pose

MAX_ROWS = 10_000
"""Rows by which residuals are tested: more would take long, and are not needed."""

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

LINK, OFFSET = "2 small motion of link ", "offset "
"""How names of columns that a model does not have begin: see `regress`."""

_STAGES = ("1 ", "2 ", "3 ")
"""How names of the columns of each stage begin."""

_JOINT_ERRORS = ("1 gravity", "1 gravity", "2 reach", *["2 position"] * 4, *["3 side load"] * 4)
"""Names of the columns of `_joint_errors`, before the number of the joint."""

_WORDS = {
    "1 gravity": "yields to gravity",
    "2 reach": "errs with the reach of the tool",
    "2 position": "errs with its position (gear, encoder)",
    "3 side load": "yields to loads along x and y of the base",
}

LIKE_NOISE = 1e-4
"""P-value below which residuals are systematic."""

SECOND_ORDER = 10.0
"""Length of a column per 1 rad or 1 m, over that of the residuals, below which it is their own: points that are touched
turn by an angle times their residuals."""

LEAST_SHARE = 1e-3
"""Share of the information below which a region of joint space says nothing of a direction."""

MOST_TYPICAL = 4.0
"""Size in robust sigmas beyond which a residual is a gross error."""


class Systematic(Record):
    """How systematic residuals are.

    Attributes:
        p_value: P-value of residuals as systematic, were there noise alone.
        cause: The single effect that explains them best, in words; empty where they are like noise or none does.
        variance: Variance of differences between regions of joint space, over that by the noise alone.
    """

    p_value: float
    cause: str = ""
    variance: float = 1.0


class Change(Record):
    """Something that moved between two rows of a table.

    Attributes:
        what: `tool` or `base`.
        configuration: The first after it, by its number among all.
        left: Part of chi-square that is left with a tool or a base of its own from there on.
    """

    what: str
    configuration: int
    left: float


class Offset(Record):
    """An offset that an instrument seems to add to every length.

    Attributes:
        table: Number of its table.
        size: The offset, [m].
        sigma: Its 1 sigma by the noise as estimated, [m].
    """

    table: int
    size: float
    sigma: float


class LinearFit(Record):
    """The linearised fit of rows and priors, and its score tests.

    Attributes:
        r: Residuals of the fit, rows first, then priors, shape (n,).
        fitted: Orthonormal basis of its columns, shape (n, rank).
        dof: Degrees of freedom.
        variance: Of the noise: what a fit with all columns leaves.
    """

    r: Floats
    fitted: Floats
    dof: int
    variance: float = 1.0

    def padded(self, columns: Floats) -> Floats:
        """Columns of the rows, shape (n_rows, m), of the priors too."""
        return np.pad(columns, ((0, len(self.r) - len(columns)), (0, 0)))

    def test(self, columns: Floats) -> tuple[float, float, LinearFit]:
        """A score test of more columns of the rows, shape (n_rows, m).

        Returns:
            The p-value of what they explain, the part of what is more than noise that they leave, and the fit with
            them; 1, 1 and this fit where they add nothing, or leave too few degrees of freedom.
        """
        new = basis_of(self.padded(columns), self.fitted, SECOND_ORDER * float(np.linalg.norm(self.r)))
        r, m = self.r - new @ (new.T @ self.r), new.shape[1]
        after = replace(self, r=r, fitted=np.hstack([self.fitted, new]), dof=self.dof - m)
        total, rest = float(self.r @ self.r), float(r @ r)
        if not m or after.dof < LEAST_LEFT:
            return 1.0, 1.0, self
        ratio = ((total - rest) / m) / max(rest / after.dof, 1e-300)
        left = max(rest - after.dof * self.variance, 0.0) / max(total - self.dof * self.variance, 1e-300)
        return float(special.fdtrc(m, after.dof, ratio)), left, after

    def clipped(self) -> LinearFit:
        """The fit of residuals that are cut at `MOST_TYPICAL` robust sigmas: gross errors hide effects."""
        free = 1.0 - np.sum(self.fitted**2, axis=1)
        size, seen = np.sqrt(np.maximum(free, 0.0)), free > LEAST_SHARE
        most = MOST_TYPICAL * 1.4826 * float(np.median(np.abs(self.r[seen]) / size[seen])) * size
        r = np.clip(self.r, -most, most)
        return replace(self, r=r - self.fitted @ (self.fitted.T @ r))

    @property
    def information(self) -> float:
        """Schwarz's criterion, whose least value chooses among models."""
        return float(len(self.r) * np.log(self.r @ self.r) + self.fitted.shape[1] * np.log(len(self.r)))


class Regression(Record):
    """The fit of a solution, linearised, and columns that it does not have.

    These are the six small motions of each link (`LINK`, the number of the joint before it, the kind), the offsets of
    tables that were not estimated (`OFFSET`, the number of the table), and joint errors (see `_JOINT_ERRORS`).

    Attributes:
        problem: The problem of the rows, which count as their noise says: at most `MAX_ROWS`, evenly drawn.
        fit: Their fit, whose noise is as specified.
        columns: The columns of the rows, shape (n_rows, m).
        names: Their names, shape (m,).
    """

    problem: Problem
    fit: LinearFit
    columns: Floats
    names: NDArray[np.str_]

    @cached_property
    def fit_with_noise(self) -> LinearFit:
        """The fit with the noise that one with all columns leaves, at most that specified."""
        with_all = self.fit.test(self.columns)[2]
        variance = 1.0 if with_all is self.fit else float(with_all.r @ with_all.r) / with_all.dof
        return replace(self.fit, variance=min(variance, 1.0))

    def named(self, *begin: str) -> Floats:
        """The columns whose names begin so, shape (n_rows, k)."""
        return self.columns[:, [name.startswith(begin) for name in self.names.tolist()]]


def of_several(p: float, n: int) -> float:
    """The p-value of the least p-value of n tests."""
    return -float(np.expm1(n * np.log1p(-min(p, 1.0 - 1e-16))))


def find_systematic(regression: Regression) -> Systematic | None:
    """Systematic residuals, of all rows whatever their robust weights, and the single effect that explains them best.

    Returns:
        None where it cannot be told: too few rows, or rows that share errors but are weighted as independent.
    """
    problem, whole = regression.problem, regression.fit
    if problem.rows.counted_as_private or whole.dof < 2 * LEAST_LEFT:
        return None
    clipped = fit = whole.clipped()
    least, n = 1.0, 0
    for stage in _STAGES:
        p, _, after = fit.test(regression.named(stage))
        if after is not fit:
            least, n, fit = min(least, p), n + 1, after
    if not n:
        return None
    if (p := of_several(least, n)) >= LIKE_NOISE:
        return Systematic(p)
    best, cause, gain = clipped, "", clipped.information - fit.information
    for words, name in _causes(problem.robot).items():
        after = clipped.test(regression.named(name))[2]
        if after.information < best.information:
            best, cause = after, words
    others = " and others" * (clipped.information - best.information < 0.5 * gain)
    return Systematic(p, cause and cause + others, _regional_variance(problem, whole))


def _regional_variance(problem: Problem, fit: LinearFit) -> float:
    """Variance by which fits without one region of joint space differ from that of all rows, over that by the noise.

    The regions are quarters of each joint's range, by rows. In an orthonormal basis Q of the fit's columns all rows
    have the information 1 and those of a region H = Q_b^T Q_b. With h and u its eigenvalues and vectors, the estimate
    without them differs along u by u . Q_b^T r / (1 - h), which noise alone gives the variance h / (1 - h).
    """
    none, at = np.full((1, problem.robot.n_joints), np.nan), list[Floats]()
    for part in problem.rows.parts:
        s, ends = part.block, problem.data.places[part.table][part.block.ends[:, -1:]].ravel()
        readings = problem.data.readings[ends] if s.kind.ends else none.repeat(s.n, axis=0)
        at.append(np.repeat(readings, s.residual_dim, 0))
    squares = list[float]()
    for readings in np.concatenate(at).T:
        edges = np.nanquantile(readings, [0.25, 0.5, 0.75])
        for k in range(len(edges) + 1):
            rows = np.flatnonzero((np.searchsorted(edges, readings) == k) & np.isfinite(readings))
            Q = fit.fitted[rows]
            h, U = np.linalg.eigh(Q.T @ Q)
            seen = (h > LEAST_SHARE) & (h < 1.0 - LEAST_SHARE)
            squares += ((U.T @ (Q.T @ fit.r[rows]))[seen] ** 2 / (h * (1.0 - h))[seen]).tolist()
    return float(np.mean(squares)) if squares else 1.0


def _causes(robot: Robot) -> dict[str, str]:
    """How the names of the columns of each single effect begin, by what it is in words."""
    found = {f"{joint.name} {_WORDS[e]}": f"{e} {k}," for k, joint in enumerate(robot.joints) for e in _WORDS}
    for link in range(robot.n_joints + 1):
        where = {0: "the base", robot.n_joints: "the tool"}.get(link, f"the link after {robot.joints[link - 1].name}")
        found[f"{where} has an error that no estimated parameter describes"] = f"{LINK}{link}."
    return found


def find_change(regression: Regression) -> Change | None:
    """The change point of a table: what moved between two of its rows; None without, or where it cannot be told.

    Note:
        It is looked for in one table of poses, positions or orientations.
    """
    problem = regression.problem
    blocks = [part.block for part in problem.rows.parts]
    several = len(problem.data.tables) > 1 or problem.rows.states.n_states > 0
    if several or problem.data.landmarks.names or any(b.kind.ends != 1 for b in blocks):
        return None
    fit, links = regression.fit_with_noise, {"tool": problem.robot.n_joints, "base": 0}
    motions = {what: regression.named(f"{LINK}{link}.") for what, link in links.items()}
    at = np.concatenate([np.repeat(block.ends[:, 0], block.residual_dim) for block in blocks])
    first = np.unique(at)[LEAST_SIDE : 1 - LEAST_SIDE]
    first = first[np.unique(np.linspace(0, len(first) - 1, min(MAX_TRIED, len(first))).astype(np.int64))]
    found = [(*fit.test(M * (at >= k)[:, None])[:2], what, int(k)) for k in first for what, M in motions.items()]
    if not found:
        return None
    p, left, what, k = min(found)
    moved = motions[what] * (at >= k)[:, None]
    p_with, left_with, _ = fit.test(regression.named(LINK))[2].test(moved)
    if max(of_several(p, len(found)), p_with) >= P_VALUE or max(left, left_with) > CHANGE_LEFT:
        return None
    return Change(what, k, float(np.sum(fit.test(moved)[2].r ** 2) / np.sum(fit.r**2)))


def explains_misfit(regression: Regression, motion: MissingMotion) -> bool:
    """Whether a motion that the convention has no parameter for explains a part of the misfit."""
    kinds = {PARAMETER_KINDS[kind].axis: kind for kind in FRAME_KINDS}
    wanted = [f"{LINK}{axis}.{kinds[one]}" for axis in motion.axes[:-1] for one in motion.motions]
    p, left, _ = regression.fit_with_noise.test(regression.named(*wanted))
    return p < P_VALUE and left <= MISSING_LEFT


def forgotten_offsets(regression: Regression) -> tuple[Offset, ...]:
    """Offsets of instruments that were not estimated, are significant, and smaller than the lengths' own spread."""
    fit, found, blocks = regression.fit, list[Offset](), regression.problem.data.blocks
    for table in _offsets(regression.problem).values():
        spread = np.std(np.concatenate([s.data[s.train, 0] for s in blocks if s.table == table]))
        column = fit.padded(regression.named(f"{OFFSET}{table},"))[:, 0]
        p, _, after = fit.test(1e6 * column[:, None])  # kept however short: an offset is linear
        if p < P_VALUE:
            new = column - fit.fitted @ (fit.fitted.T @ column)
            sigma = np.sqrt(float(after.r @ after.r) / after.dof / float(new @ new))
            size = -float(new @ fit.r) / float(new @ new)
            found += [Offset(table, size, float(sigma))] * int(abs(size) < spread)
    return tuple(found)


def _offsets(problem: Problem) -> dict[int, int]:
    """Tables with an offset that is not estimated, by the offset's place among the nuisance coordinates."""
    unknowns, columns = problem.data.landmarks, problem.variables.coordinates
    numbers = [i for i, item in enumerate(unknowns.items) if item.kind.is_one]
    places = np.flatnonzero(np.isin(unknowns.owners, numbers) & (columns < 0)).tolist()
    each = ((place, s) for place in places for s in problem.data.blocks)
    return {place: s.table for place, s in each if np.any(s.nuisances[s.train] == place)}


def regress(solution: Solution) -> Regression:
    """Linearise the fit of a solution, and what it does not have."""
    problem, parameters = solution.problem, solution.parameters
    if problem.state.weights is not None or problem.n_residuals > MAX_ROWS:
        problem = subsampled(problem, min(1.0, MAX_ROWS / problem.n_residuals), parameters)
    at = problem.variables.at(parameters)
    (chains, core), offsets = with_link_motions(problem, parameters), _offsets(problem)
    errors = list[Floats]()
    for table, place in zip(problem.data.tables, problem.data.places, strict=True):
        fitted, n = problem.data.fitted[place], problem.robot.n_joints
        errors.append(np.zeros((len(place), len(_JOINT_ERRORS), n)))
        errors[-1][fitted] = _joint_errors(problem.robot, table.measurements.readings[fitted])
    columns = np.where(at.columns >= 0, at.columns + len(core) - at.n_columns, -1)
    columns[list(offsets)] = len(core) + at.n_nuisance + np.arange(len(offsets))
    wide = replace(at, chains=chains, n_columns=len(core), columns=columns, n_nuisance=at.n_nuisance + len(offsets))
    rows = problem.rows
    of_joints = [_by_joint_errors(part.at(wide), chains[part.table], errors[part.table]) for part in rows.parts]
    private = np.hstack([np.concatenate(of_joints), rows.private(wide)])
    J, r = np.split(rows.states.whiten(private), [-1], axis=1)
    names = [f"{effect} {k}," for effect in _JOINT_ERRORS for k in range(problem.robot.n_joints)]
    names += [name if name.startswith(LINK) else "" for name in core] + [""] * at.n_nuisance
    all_names = np.array(names + [f"{OFFSET}{table}," for table in offsets.values()])
    more = all_names != ""
    r_prior, J_prior = prior_rows(problem.variables, parameters)
    r_unknown, J_unknown = unknown_prior_rows(problem.variables, parameters)
    J_prior = np.pad(J_prior, ((0, 0), (0, problem.variables.n_nuisance)))
    own = basis_of(J[:, ~more])
    left, dof = r[:, 0] - own @ (own.T @ r[:, 0]), problem.n_independent - own.shape[1]
    scale = np.clip(np.sqrt(float(left @ left) / dof), 0.1, 1.0) if dof >= LEAST_LEFT else 1.0
    J, r = J / scale, r / scale  # of noise specified too large: else columns take up the pull of the priors
    n = problem.n_independent + len(r_prior) + len(r_unknown)
    basis = basis_of(np.concatenate([J[:, ~more], J_prior, J_unknown]))
    r = np.concatenate([r[:, 0], r_prior, r_unknown])
    if solution.problem.state.weights is not None:
        most = MOST_TYPICAL * 1.4826 * float(np.median(np.abs(r)))
        r = np.clip(r, -most, most)  # before outliers spread over all rows
    fit = LinearFit(r - basis @ (basis.T @ r), basis, n - basis.shape[1])
    return Regression(problem, fit, J[:, more], all_names[more])


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
    """Effects that a joint's error may follow, shape (n, len(_JOINT_ERRORS), n_joints).

    Loads along z; how far the tool reaches out; harmonics of one and two periods a turn (of a prismatic joint its
    position and the square of that); loads along x and y.
    """
    robot = robot.geometry
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


def basis_of(columns: Floats, fitted: Floats | None = None, least: float = 0.0) -> Floats:
    """An orthonormal basis of what columns add to an orthonormal one; what is left of nothing is nothing.

    Args:
        columns: The columns, shape (n, m).
        fitted: The basis that they add to, shape (n, k); none if None.
        least: Length below which a part of a column is none.
    """
    fitted = np.zeros((len(columns), 0)) if fitted is None else fitted
    size = np.linalg.norm(columns, axis=0)
    rest = columns - fitted @ (fitted.T @ columns)
    scale = np.maximum(size, max(_NOTHING * float(np.max(size, initial=0.0)), 1e-300))
    Q, R, order = scipy.linalg.qr(rest / scale, mode="economic", pivoting=True)
    left = np.abs(np.diag(R))
    return np.asarray(Q[:, (left > _RANK * np.sqrt(len(size))) & (left * scale[order[: len(left)]] > least)])
