"""Rows and their dense covariance, written down anew: every error's effect by finite differences of plain formulas."""

import numpy as np
from oracle import central_differences
from scipy.spatial.transform import Rotation

from fg_calib.graph.noise_models import JOINT_NOISE
from fg_calib.measurements import Block, Frames, Length, angle_moments, length_moments, residuals, unit_whitening
from fg_calib.measurements.kinds.anchor import AnchorDistance
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.robot.kinematics import forward

STEP, WEIGHTS = 5e-4, np.array([45.0, -9.0, 1.0]) / 60.0
"""Central differences of sixth order."""

PRIVATE_SHARE = 1e-3
"""Least private share of a pair's variance."""


class SeriesRows:
    """The rows of a block at some parameters, and how they follow from errors of configurations.

    Attributes:
        r: Residuals, shape (n, residual_dim).
        J: Their derivatives in all columns, shape (n, residual_dim, n_columns + n_nuisance).
        sources: Derivatives times sigma by the error's name, shape (n, residual_dim, ends, errors), of the rows.
        own, total: Covariance of private noise, and of all noise, shape (n, residual_dim, residual_dim).
    """

    def __init__(self, problem, parameters, number):
        self.problem, self.block = problem, problem.data.blocks[number]
        s, data, state = self.block, problem.data, problem.state
        self.m, self.place = data.tables[s.table].measurements, data.places[s.table]
        at = problem.variables.at(parameters)
        self.chain = at.chains[s.table]
        self.points = at.coordinates[s.nuisances]
        self.q = self.m.readings
        names = [name.split(".")[0] for name in s.kind.names]
        self.factors = np.array([state.factors.get((s.table, name), 1.0) for name in names])
        self.r = self._rows(self._ends(self._arm(self.q)))
        trig, unit = problem.robot.trig(self.q), unit_whitening(s.n, s.kind.residual_dim)
        J = residuals.linearise(Block(s.kind, trig, s.ends, s.data, unit, self.points), self.chain)[1]
        self.J = np.zeros((*self.r.shape, at.n_columns + at.n_nuisance))
        self.J[:, :, : at.n_columns] = J[:, :, : at.n_columns]
        for k in range(s.kind.n_nuisances):
            column = at.columns[s.nuisances[:, k]]
            there = np.flatnonzero(column >= 0)
            self.J[there, :, column[there]] = J[there, :, at.n_columns + k]
        self.joint_factor = state.factors.get(JOINT_NOISE, 1.0)
        self.joints = self._sensitivity(lambda k, h: self._arm(self.q + h * np.eye(len(self.q[0]))[k]), len(self.q[0]))
        self.sources = {"joints": self.joints * self.m.sigma_joint * self.joint_factor}
        if is_pairs(s.kind):
            self._pairs()
        else:
            private = s.covariance
            self.own = self._diagonal(s.sigma**2) if private is None else private
            self.own = self.own * np.outer(self.factors, self.factors)
        self.total = self.own + sum(self._variance(G) for G in self.sources.values())

    def _pairs(self):
        """Mean, slope and variance of lengths and angles under what noise there is along and across their vectors."""
        s, m = self.block, self.m
        square, zero = (s.sigma * self.factors) ** 2, np.zeros(self.r.shape)
        of_joints = np.sum(self.sources["joints"] ** 2, axis=(2, 3))
        trace, of_poses, poses = zero.copy(), zero, None
        if s.formed:
            poses = np.zeros((s.n, s.kind.residual_dim, 2, 3 * s.kind.residual_dim))
            for i, part in enumerate(s.kind.parts):
                move = self._moved if isinstance(part, Distance) else self._turned
                sigma = m.sigma_position if isinstance(part, Distance) else m.sigma_orientation
                G = self._sensitivity(move, 3)[:, i] * self.factors[i] * sigma[s.ends]
                poses[:, i, :, 3 * i : 3 * i + 3] = -G
                trace[:, i] += self.factors[i] ** 2 * np.sum(sigma[s.ends] ** 2, axis=(1, 2))
            of_poses = np.sum(poses**2, axis=(2, 3))
        for i, part in enumerate(s.kind.parts):
            trace[:, i] += self.joint_factor**2 * self._trace_of_joints(part)
        offset = self.points[:, 3:].sum(axis=1, keepdims=True)  # what an instrument adds is no length
        value, along = self.r + s.data - offset, of_poses + of_joints
        across = np.maximum(trace - along, 0.0) / 2.0
        own = zero if s.formed else square
        moments = []
        for i, part in enumerate(s.kind.parts):
            of_part = length_moments if isinstance(part, Length) else angle_moments
            moments.append(of_part(value[:, i], along[:, i], across[:, i], own[:, i]))
        names = ("excess", "slope", "variance")
        excess, slope, variance = (np.stack([getattr(one, name) for one in moments], axis=1) for name in names)
        self.r, self.J = self.r + excess, self.J * slope[:, :, None]
        self.joints = self.joints * slope[:, :, None, None]
        self.sources["joints"] = self.sources["joints"] * slope[:, :, None, None]
        if s.formed:
            self.sources[f"poses of {s.table}"] = poses * slope[:, :, None, None]
        self.own = self._diagonal(np.maximum(variance - slope**2 * (of_joints + of_poses), 0.0))

    def _arm(self, q):
        at = forward(self.chain.without_columns(), self.problem.robot.trig(q))
        return at.rotation, at.position

    def _moved(self, k, h):
        """The predicted points moved along an axis of the frame that poses were measured in."""
        R, p = self._arm(self.q)
        train = ~self.m.test
        measured = self.m.position[train]
        to_base = Rotation.align_vectors(p[train] - p[train].mean(axis=0), measured - measured.mean(axis=0))[0]
        return R, p + to_base.apply(h * np.eye(3)[k])

    def _turned(self, k, h):
        R, p = self._arm(self.q)
        return R @ Rotation.from_rotvec(h * np.eye(3)[k]).as_matrix(), p

    def _ends(self, poses):
        return [array[self.block.ends] for array in poses]

    def _rows(self, ends):
        """Predicted minus measured by the kind's own formula in numpy, which has no compiled code."""
        return self.block.kind.rows(Frames(*ends), self.block.data, self.points).residual

    def _sensitivity(self, move, n):
        """Derivative of all rows in moves of each end, shape (n, residual_dim, ends, n)."""
        out = np.zeros((*self.r.shape, self.block.kind.ends, n))
        still = self._ends(self._arm(self.q))
        for k in range(n):
            for sign in (1.0, -1.0):
                for times, weight in enumerate(WEIGHTS, 1):
                    moved = self._ends(move(k, sign * times * STEP))
                    for end in range(self.block.kind.ends):
                        ends = [a.copy() for a in still]
                        for into, source in zip(ends, moved, strict=True):
                            into[:, end] = source[:, end]
                        out[:, :, end, k] += sign * weight * self._rows(ends) / STEP
        return out

    def _trace_of_joints(self, part):
        """Variance of the vector behind a distance or an angle from joint noise, along all axes together, (n,)."""
        total = np.zeros(len(self.q))
        R0 = Rotation.from_matrix(self._arm(self.q)[0])
        for k, sigma in enumerate(self.m.sigma_joint):
            change = np.zeros((len(self.q), 3))
            for sign in (1.0, -1.0):
                for times, weight in enumerate(WEIGHTS, 1):
                    R, p = self._arm(self.q + sign * times * STEP * np.eye(len(self.q[0]))[k])
                    vector = p if isinstance(part, Length) else (R0.inv() * Rotation.from_matrix(R)).as_rotvec()
                    change += sign * weight * vector / STEP
            total += sigma**2 * np.sum(change**2, axis=1)
        return total[self.block.ends].sum(axis=1)

    @staticmethod
    def _variance(G):
        return np.einsum("nhew,nkew->nhk", G, G)

    @staticmethod
    def _diagonal(values):
        return values[:, :, None] * np.eye(values.shape[1])


def is_pairs(kind):
    """Whether all rows are distances and angles of pairs, or lengths to anchors."""
    return all(isinstance(part, AnchorDistance | Distance | RotationAngle) for part in kind.parts)


def dense(problem, parameters):
    """[J r] of all train rows in use, what errors of 1 sigma of the joints do to them, and their covariance.

    Returns:
        Shapes (n, n_columns + n_nuisance + 1), (n, n_configurations, n_joints) and (n, n).
    """
    every = [SeriesRows(problem, parameters, i) for i in range(len(problem.data.blocks))]
    n_configurations = problem.data.n_configurations
    reached = {}
    for rows in every:
        ends = rows.place[rows.block.ends[rows.block.train]]
        for name, G in rows.sources.items():
            if G.any():
                reached[name] = reached.get(name, 0) + np.bincount(ends.ravel(), minlength=n_configurations)
    names = {name: G.shape[3] for rows in every for name, G in rows.sources.items()}
    sharing = problem.options.pair_errors == "shared"
    A, private, loadings, used = [], [], {name: [] for name in names}, []
    for i, rows in enumerate(every):
        train, residual_dim = rows.block.train, rows.block.kind.residual_dim
        ends = rows.place[rows.block.ends]
        shared = [name for name in rows.sources if name in reached and (reached[name][ends[train]] > 1).any()]
        if problem.joints_estimated and "joints" not in shared:
            shared.append("joints")
        shared = [name for name in shared if sharing or (name == "joints" and problem.joints_estimated)]
        own = rows.own.copy()
        if shared and is_pairs(rows.block.kind):
            diagonal = np.einsum("nii->ni", own)
            least = PRIVATE_SHARE * np.einsum("nii->ni", rows.total)
            if rows.block.formed:  # second-order terms of pairs that share a pose have correlations up to 1/4
                of_pose = np.sum(rows.block.ends[train][:, :, None] == np.arange(len(rows.q)), axis=(0, 1))
                fewest = of_pose[rows.block.ends].min(axis=1)
                least = np.maximum(least, diagonal * fewest[:, None] / 2.0)
            own += rows._diagonal(np.maximum(least - diagonal, 0.0))
        private_alone = [name for name in rows.sources if not sharing and name not in shared]
        own += sum((rows._variance(rows.sources[name]) for name in private_alone), 0.0)
        weights = problem.state.weights
        if weights is not None:
            own += (1.0 / np.maximum(weights[i], 1e-12) - 1.0)[:, None, None] * rows.total
        A.append(np.concatenate([rows.J, rows.r[:, :, None]], axis=2)[train].reshape(len(train) * residual_dim, -1))
        used.append(rows.block.used[train].ravel())
        private.append(own[train])
        for name, width in names.items():
            L = np.zeros((len(train), residual_dim, n_configurations, width))
            if name in rows.sources and name not in private_alone:
                for k, measurement in enumerate(train):
                    for end in range(rows.block.kind.ends):
                        L[k, :, ends[measurement, end]] += rows.sources[name][measurement, :, end]
            loadings[name].append(L.reshape(len(train) * residual_dim, n_configurations, width))
    used = np.concatenate(used)
    C = np.zeros((len(used), len(used)))
    first = 0
    for block in (b for each in private for b in each):
        C[first : first + len(block), first : first + len(block)] = block
        first += len(block)
    L = {name: np.concatenate(each) for name, each in loadings.items()}
    C += sum(G.reshape(len(used), -1) @ G.reshape(len(used), -1).T for G in L.values())
    return np.concatenate(A)[used], L["joints"][used], C[np.ix_(used, used)]


def priors(problem, parameters):
    """[K k] of the priors on the arm and on landmarks, shape (n, n_columns + n_nuisance + 1)."""
    variables, unknowns = problem.variables, problem.data.landmarks

    def residual(step):
        x, out = variables.moved(parameters, step), []
        for v in variables.items:
            if v.kind == "frame" or not variables.priors:
                continue
            values, nominal = x[v.places], variables.nominal()[v.places]
            off = values - nominal
            if v.is_pose:  # x, y, z, then the rotation from nominal about the frame's own z, y and x axes
                was, now = (Rotation.from_euler("ZYX", angles) for angles in (nominal[3:], values[3:]))
                off[3:] = (was.inv() * now).as_rotvec()[::-1]
            sigma = [variables.robot.parameters[i].tolerance or np.inf for i in v.parameters]
            out += list(off / sigma)
        places = np.split(variables.at(x).coordinates, np.cumsum(unknowns.sizes)[:-1]) if unknowns.sizes else []
        for place, item in zip(places, unknowns.items, strict=True):
            start, sigma = item.start, item.tolerance
            out += list((place - start) / sigma) if sigma else []
        return np.array(out)

    still = np.zeros(variables.n_columns + variables.n_nuisance)
    return np.column_stack([central_differences(residual, still, 1e-5), residual(still)])
