"""Information that each candidate pose adds, and what a calibration would know after some were measured.

Errors that belong to one pose (its joint readings, the measured pose that its pair is formed from) are that pose's own
noise, however many rows it has. Errors of a reference pose, which many pairs share, are further unknowns of 1 sigma. So
the information of a set of poses is exactly the sum of theirs, and a pose adds `A^T A` of as many rows as it has.

`System` holds this information in coordinates that can be determined: `M = M_0 + sum A^T A`. Directions that all
candidates together leave undetermined are left out: no choice changes anything there. In these coordinates all
candidates together leave variances of 1. A weak prior (1 rad, or the arm's reach, or what rounding can distinguish)
gives a set that does not determine everything a covariance too, a large one.

The mean square error over a task is `tr(W C)`, `W = mean v^T v`. v are the derivatives of the tool point, after the
best rigid fit where the task is *fitted*; C is the covariance of the arm's parameters.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from fg_calib import prediction, robot, statistics
from fg_calib.graph import SIGNAL_FLOOR, Problem, eliminate, prior_rows, unknown_prior_rows
from fg_calib.inputs import Brief, Floats, FrozenArrays, Integers
from fg_calib.observability import Observability, observability_of_rows

N_TASK = 500
"""Number of random configurations within the joint limits that are the default task."""

MAX_ROWS = 12
"""Rows of a pose above which they are compressed to as many as their rank."""

_LOST_SHARE = 1e-10
"""Share of the rows of a pose that compressing them may lose."""

_ROUNDING = 1e-13
"""Singular values below this share of the largest are rounding, and so is information below this share."""

_UNDETERMINED_SHARE = 1e-6
"""Share of a function in undetermined directions above which it is not determined."""


# --- rows of each pose ---


class PoseRows(FrozenArrays):
    """Whitened rows that each pose would add.

    Attributes:
        rows: Derivatives in the columns of the problem's core, its landmarks and the shared errors; zeros where a pose
            has fewer rows than others, shape (n_poses, h, n_columns).
        always: Rows that hold whatever is measured: priors, and shared errors of 1 sigma, shape (m, n_columns).
        scales: A change of ordinary size in each column, shape (n_columns,).
        n_arm: Number of columns, the first ones, that are the arm's.
    """

    rows: Floats
    always: Floats
    scales: Floats
    n_arm: int


def gather_rows(problem: Problem, pose_of: Integers, references: Integers, *, alone: bool) -> PoseRows:
    """Gather the rows of a problem by pose.

    Where nothing was measured before, error curves count as noise of each pose by their priors: a design has few poses
    for hundreds of coefficients.

    Args:
        problem: The problem, linearised at its start.
        pose_of: The pose of each configuration, shape (n_configurations,); below 0 for none and for a reference.
        references: Configurations whose errors many pairs share; no other pose's errors reach another's rows.
        alone: Whether nothing was measured before; else that says what is known of landmarks.
    """
    v = problem.variables
    n_columns, n_poses = v.n_columns + v.n_nuisance, int(pose_of.max(initial=-1)) + 1
    whole, private, which = _derivatives(problem, pose_of, references)
    n_shared, of_curves = whole.shape[1] - n_columns, slice(v.n_columns, v.n_columns + v.n_curves * alone)
    private = np.hstack([private, whole[:, of_curves] * v.all_scales[of_curves]])
    stacked = _stack(np.hstack([whole, private]), which, n_poses)
    J, L = np.split(stacked, [whole.shape[1]], axis=2)  # whitened by the covariance 1 + L L^T of a pose's rows
    rows = np.linalg.solve(np.linalg.cholesky(np.eye(J.shape[1]) + L @ np.swapaxes(L, 1, 2)), J)
    fixed = [np.pad(prior_rows(v, problem.start)[1], ((0, 0), (0, v.n_nuisance)))]
    if alone:
        fixed.append(unknown_prior_rows(v, problem.start)[1])
    of_references = whole[which < 0] if alone else whole[:0]
    wide = np.vstack([*(np.pad(one, ((0, 0), (0, n_shared))) for one in fixed), of_references])
    rows[:, :, of_curves] = wide[:, of_curves] = 0.0
    errors = np.hstack([np.zeros((n_shared, n_columns)), np.eye(n_shared)])
    return PoseRows(rows, np.vstack([wide, errors]), np.append(v.all_scales, np.ones(n_shared)), v.n_robot_columns)


def _derivatives(problem: Problem, pose_of: Integers, references: Integers) -> tuple[Floats, Floats, Integers]:
    """Derivatives of rows, with the errors of reference poses; in the errors of their own pose; and their pose."""
    rows, width = problem.rows, len(problem.rows.slots)
    J = rows.private(problem.variables.at(problem.start))[:, :-1]
    which = np.concatenate([_poses_of(problem, part.number, part.block.residual_dim, pose_of) for part in rows.parts])
    private, of_references = np.zeros((len(J), width)), np.zeros((len(J), len(references) * width))
    if width:
        L = rows.states.loadings.tocoo()
        configuration, k = rows.configurations[L.col // width], L.col % width
        for number, reference in enumerate(references.tolist()):
            mask = configuration == reference
            of_references[L.row[mask], number * width + k[mask]] = L.data[mask]
        mask = ~np.isin(configuration, references)
        private[L.row[mask], k[mask]] = L.data[mask]
    return np.hstack([J, of_references]), private, which


def _poses_of(problem: Problem, number: int, residual_dim: int, pose_of: Integers) -> Integers:
    """The pose of each row of a block; -1 of rows without a configuration."""
    s = problem.data.blocks[number]
    if not s.kind.ends:
        return np.full(len(s.train) * residual_dim, -1)
    return np.repeat(pose_of[problem.data.places[s.table][s.ends[s.train]]].max(axis=1), residual_dim)


def _stack(rows: Floats, which: Integers, n_poses: int) -> Floats:
    """Rows by pose, zeros below those of a pose that has fewer, shape (n_poses, h, n)."""
    chosen = np.flatnonzero(which >= 0)
    order = chosen[np.argsort(which[chosen], kind="stable")]
    counts = np.bincount(which[chosen], minlength=n_poses)
    parts = [_compress(rows[part]) for part in np.split(order, np.cumsum(counts)[:-1])]
    out = np.zeros((n_poses, max(1, *(len(part) for part in parts)), rows.shape[1]))
    for k, part in zip(range(n_poses), parts, strict=False):
        out[k, : len(part)] = part
    return out


def _compress(rows: Floats) -> Floats:
    """Fewer rows with the same information: an image of a board says as much as the board's pose."""
    if len(rows) <= MAX_ROWS:
        return rows
    _, s, Vt = np.linalg.svd(rows, full_matrices=False)
    kept = s > _LOST_SHARE * s.max(initial=0.0)
    return s[kept, None] * Vt[kept]


# --- the system to choose from ---


class System(FrozenArrays):
    """Candidates in coordinates that can be determined.

    Attributes:
        rows: Of each candidate, shape (n_candidates, h, n).
        known: Information that is there already, with the weak prior, shape (n, n).
        task: W, of which `tr(W C)` is the mean square error of the task, C the covariance, shape (n, n).
        core: P, functions of the arm's parameters that can be determined, orthonormal in changes of ordinary size,
            shape (p, n).
        unknown: Share of the task's mean square that no candidate determines, in [0, 1].
    """

    rows: Floats
    known: Floats
    task: Floats
    core: Floats
    unknown: float

    @property
    def n_candidates(self) -> int:
        """Number of candidates."""
        return len(self.rows)

    def with_known(self, candidates: Integers) -> "System":
        """The system with some candidates measured already."""
        return replace(self, known=self.information(candidates))

    def select(self, candidates: Integers) -> "System":
        """The system with some of the candidates."""
        return replace(self, rows=self.rows[candidates])

    def information(self, chosen: Integers) -> Floats:
        """Information with some candidates measured, shape (n, n)."""
        A = self.rows[chosen].reshape(-1, self.rows.shape[2])
        return self.known + A.T @ A


def build_system(poses: PoseRows, given: Floats, task: Floats) -> System:
    """Build the system of candidate poses.

    Args:
        poses: Their rows.
        given: Rows that were measured already, shape (m, n_columns).
        task: Mean square error of the task as a quadratic form of the first n columns, shape (n, n).
    """
    scales, n, n_arm = poses.scales, len(task), poses.n_arm
    rows, before = poses.rows * scales, np.vstack([poses.always, given]) * scales
    # By singular values: those of the information itself are lost in rounding where noise is tiny.
    _, s, Vt = np.linalg.svd(np.linalg.qr(np.vstack([before, rows.reshape(-1, len(scales))]), mode="r"))
    values, vectors = np.append(s, np.zeros(len(scales) - len(s))), Vt.T
    kept = values > max(SIGNAL_FLOOR, _ROUNDING * values[0])
    Q, lost = vectors[:, kept] / values[kept], vectors[:n, ~kept]
    weak = np.maximum((SIGNAL_FLOOR / values[kept]) ** 2, _ROUNDING)
    W = task * np.outer(scales[:n], scales[:n])
    total = float(np.trace(W))
    # Functions of the arm that no undetermined direction has a share in.
    U, s, _ = np.linalg.svd(lost[:n_arm], full_matrices=True) if lost.shape[1] else (np.eye(n_arm), np.zeros(0), None)
    determined = U[:, int(np.sum(s > _UNDETERMINED_SHARE)) :]
    known = (before @ Q).T @ (before @ Q) + np.diag(weak)
    unknown = float(np.trace(lost.T @ W @ lost)) / total if total > 0.0 else 0.0
    return System(rows @ Q, known, Q[:n].T @ W @ Q[:n], determined.T @ Q[:n_arm], unknown)


# --- the task, and what is known after measuring ---


class Task(FrozenArrays):
    """Configurations at which the tool is to be right after calibration.

    Attributes:
        readings: The configurations, shape (n, n_joints), [rad] (prismatic: [m]).
        fitted: Whether errors count after the best rigid fit, instead of in the base frame.
        lever: Distance from the tool with which orientation errors count, [m]; 0: positions alone.
    """

    readings: Floats
    fitted: bool
    lever: float = 0.0

    def quadratic_form(self, problem: Problem, *, curves: bool = False) -> Floats:
        """W, in the columns of a problem's core and, if asked, of its error curves, shape (n, n), [m^2]."""
        v = problem.variables
        own = np.eye(v.n_columns + v.n_curves * curves)[v.n_columns :]
        none = np.zeros((0, v.n_columns))
        columns = statistics.TangentCovariance(v, problem.start, none, none, none, curves=own)
        points, motion, _ = prediction.tool_derivatives(columns, prediction.base_chain(columns), self.readings)
        rotation, position = motion[:, :3], motion[:, 3:]
        if self.fitted:
            position, rigid = robot.without_rigid_motion(points, position)
            rotation = rotation - rigid
        n = position.shape[2]
        flat = np.vstack([position.reshape(-1, n), self.lever * rotation.reshape(-1, n)])
        return flat.T @ flat / len(self.readings)


class Posterior(Brief):
    """Posterior of the arm after some rows were measured.

    Attributes:
        problem: A problem of the arm, at its start.
        rows: Whitened derivatives in all its columns, with those of earlier measurements, shape (m, n).
        n_measurements: Number of measurements that the rows are of.
    """

    problem: Problem
    rows: Floats
    n_measurements: int = 0

    @cached_property
    def covariance(self) -> statistics.TangentCovariance:
        """Covariance of the core, and of error curves."""
        v = self.problem.variables
        left = eliminate(self.rows, np.zeros(len(self.rows)), v.n_columns)
        own = left.inverse[: v.n_curves]
        curves = np.hstack([left.follow[: v.n_curves], np.transpose(np.linalg.qr(own.T, mode="r"))])
        return replace(statistics.covariance_of_rows(v, self.problem.start, left.A), curves=curves)

    def error_of_curves(self, task: Task) -> float:
        """RMS error of the tool over a task by error curves, were all else known, [m]."""
        if not self.problem.variables.n_curves:
            return 0.0
        names = ("tangent", "undetermined", "undetermined_at_nominal")
        known = {name: np.zeros_like(getattr(self.covariance, name)) for name in names}
        base, fitted = prediction.errors_at(replace(self.covariance, **known), task.readings)
        return (fitted if task.fitted else base).position or 0.0

    def error(self, task: Task) -> prediction.PoseRms:
        """Expected errors of the tool over a task."""
        base, fitted = prediction.errors_at(self.covariance, task.readings)
        return fitted if task.fitted else base

    def with_known_tool(self) -> "Posterior":
        """The posterior if the tool were known, to a millionth of a change of ordinary size."""
        v = self.problem.variables
        of_tool = [k for k, name in enumerate(v.names) if name.startswith("tool.")]
        known = np.eye(self.rows.shape[1])[of_tool] * 1e6 / v.scales[of_tool, None]
        return replace(self, rows=np.vstack([self.rows, known]))

    @cached_property
    def observability(self) -> Observability:
        """Observability of the arm by the rows, without priors."""
        p, v = self.problem, self.problem.variables
        left = eliminate(self.rows, np.zeros(len(self.rows)), v.n_robot_columns)
        A = left.A @ v.tangent_derivative(p.start)[: v.n_robot_columns, : v.n_robot_columns]
        scales = np.array([p.robot.scale_of(one.unit) for one in p.estimated])
        return observability_of_rows(A, p.estimated, scales=scales, n_measurements=self.n_measurements)


def count_measurements(problem: Problem) -> int:
    """Number of measurements of a problem's rows."""
    return sum(len(s.train) for s in problem.data.blocks)
