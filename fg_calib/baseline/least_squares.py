r"""Plain least squares: the baseline that the factor graph is compared with.

Without weights, the paper's own estimator: Jia et al. (2019), Eq. (54) and (55), as printed:

    dPsi_i = Psi* - f(Omega_i, Theta)               measured minus predicted, metres and radians side by side
    dOmega_{i+1} = J(Omega_i, Theta)^+ dPsi_i       the Moore-Penrose inverse: a minimum-norm step
    Omega_{i+1} = Omega_i + dOmega_{i+1}            until dOmega is small

With weights, `scipy.optimize.least_squares` on the same rows, whitened by their noise. Nothing here knows GTSAM,
priors, damping or observability: of the graph's mathematics only `residuals` is shared.

An unknown measurement frame takes six more unknowns: world_T_base = Txyz Rz(yaw) Ry(pitch) Rx(roll), singular at a
pitch of 90 degrees. Landmarks that are not known are unknowns as well; one with a prior is a measurement of its place.

Note:
    Every measured train row takes part, but pairs of one configuration with itself. Every measurement counts as
    independent, also pairs formed from poses and the rows of one configuration, which share its joint noise. All rows
    and derivatives are in memory at once.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fg_calib.inputs import Booleans, Brief, Floats, InputError, Integers, Record, check_names, expect, optimize
from fg_calib.measurements import Block, Dataset, residuals, unit_whitening, usable_pairs
from fg_calib.parallel import single_threaded
from fg_calib.robot import Chain, Robot, build_chain, names_of

RCOND = 1e-10
"""Singular values of J below this part of the largest count as zero in J^+."""

MAX_SHARE = 1e-6
"""A parameter with more than this share in a null-space direction of J has no sigma."""

ROUNDING = 1e-8
"""A step below this that no longer shrinks is rounding, which weak directions magnify, [m] and [rad]."""

REWEIGHTED = 1e-10
"""Weights are final once a fit with them moves the unknowns by less than this, [m] and [rad]."""

_ROUNDS, _STEPS = 20, 50
"""Fits with new weights, and steps of one fit, at most."""

_SMALL_STEP = 1e-12
"""Length of a step that ends a fit, metres and radians side by side."""


class LeastSquares(Brief):
    """The result of plain least squares.

    Attributes:
        robot: The robot with the estimated values.
        names: The parameters that were estimated, in the order of the covariance.
        parameters: Values of the robot, x, y, z, yaw, pitch, roll of each unknown measurement frame world_T_base (six
            zeros where there is none), coordinates of the estimated landmarks: as `Problem.start` has them.
        covariance: Of the estimated parameters as least squares claims it, shape (n_names, n_names), [m] and [rad]:
            (J^T W J)^-1 if weighted by noise, else s^2 (J^T J)^-1 with s^2 = |r|^2 / (n_rows - rank). nan in rows and
            columns of parameters that J does not determine, and everywhere where s^2 has no degree of freedom.
        n_rows: Number of scalar residuals.
        converged: Whether the last step was small enough.
        message: Why it stopped.
        iterations: Steps taken (scipy: derivatives asked for).
        seconds: Time taken.
    """

    robot: Robot
    names: tuple[str, ...]
    parameters: Floats
    covariance: Floats
    n_rows: int
    converged: bool
    message: str
    iterations: int
    seconds: float

    @property
    def sigma(self) -> dict[str, float]:
        """1 sigma of each estimated parameter, [m] or [rad]; nan where J does not determine it."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@single_threaded
def fit_least_squares(
    robot: Robot,
    data: Dataset,
    *,
    names: Sequence[str] | None = None,
    start: Floats | None = None,
    weighted: bool = False,
) -> LeastSquares:
    """Estimate parameters by plain least squares.

    Args:
        robot: The nominal robot; its prior sigmas are not used.
        data: All tables of a calibration with their landmarks (see `measurements.build_dataset`).
        names: The parameters to estimate; all that the robot's file lets be estimated if None. With more than the
            measurements determine every step is a minimum-norm step.
        start: Values to start from, as `Problem.start`: see `LeastSquares.parameters`. Nominal values, the identity and
            the landmarks' own starts if None.
        weighted: Whether rows are whitened by the noise of measurements and, to first order, of joint readings. The
            weights are those at the start, then those at the estimate, until they change nothing more.

    Raises:
        InputError: An argument is not one of those possible, there is no row to fit, or nothing to estimate.
    """
    clock = time.perf_counter()
    wanted = [p.name for p in robot.parameters if p.estimated] if names is None else list(names)
    check_names("names", wanted, names_of(robot.parameters))
    expect(wanted, "names", "nothing to estimate", "at least one parameter")
    system = _System(robot, data, [i for i, p in enumerate(robot.parameters) if p.name in wanted], start, weighted)
    fit, weights = system.solve()
    m, (r, J), parameters = len(wanted), system.evaluate(fit.x, weights), system.parameters(fit.x)
    kept = tuple(p.name for p in robot.parameters if p.name in wanted)
    arm, covariance = robot.with_values(parameters[: len(robot.parameters)]), claimed_covariance(r, J, weighted)[:m, :m]
    about = (len(r), fit.converged, fit.message, fit.iterations, time.perf_counter() - clock)
    return LeastSquares(arm, kept, parameters, covariance, *about)


Evaluate = Callable[[Floats], tuple[Floats, Floats]]
"""Residuals of the unknowns, shape (m,), and their derivatives, shape (m, n)."""

Weights = tuple[Floats, ...]
"""Whitening of each block of rows, shape (n, residual_dim, residual_dim)."""


class Fit(Record):
    """Unknowns where a method stopped, shape (n,), and why."""

    x: Floats
    converged: bool
    message: str
    iterations: int


def gauss_newton(evaluate: Evaluate, x: Floats) -> Fit:
    """Minimum by Eq. (54) and (55) of the paper."""
    last = np.inf
    for n in range(1, _STEPS + 1):
        r, J = evaluate(x)
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return Fit(x, False, f"diverged: residuals are not finite after {n - 1} steps", n - 1)
        step = np.linalg.pinv(J, rcond=RCOND) @ -r
        x, before, last = x + step, last, float(np.linalg.norm(step))
        if last <= _SMALL_STEP or before <= last <= ROUNDING:
            return Fit(x, True, f"converged: the last step was {last:.1e}", n)
    return Fit(x, False, f"not converged: {_STEPS} iterations, the last step was {last:.1e}", _STEPS)


def scipy_fit(evaluate: Evaluate, x: Floats) -> Fit:
    """Minimum by MINPACK's Levenberg-Marquardt, which needs as many rows as unknowns."""
    ends = {"ftol": 1e-15, "xtol": _SMALL_STEP, "gtol": 1e-15, "max_nfev": _STEPS}  # near the least that MINPACK takes
    both = {"fun": lambda x: evaluate(x)[0], "jac": lambda x: evaluate(x)[1]}
    options: dict[str, Any] = {**both, "x0": x, "method": "lm", "x_scale": "jac", **ends}
    try:
        found = optimize.least_squares(**options)
    except (ValueError, np.linalg.LinAlgError) as error:
        return Fit(x, False, f"no step possible: {error}", 0)
    message = f"{'not ' * (found.status <= 0)}converged: {' '.join(str(found.message).split()).rstrip('.')}"
    return Fit(np.asarray(found.x, float), bool(found.status > 0), message, int(found.njev or found.nfev))


def claimed_covariance(r: Floats, J: Floats, weighted: bool) -> Floats:
    """(J^T J)^-1, times s^2 of unweighted rows, nan where J does not determine a parameter."""
    n = J.shape[1]
    if not np.isfinite(J).all():
        return np.full((n, n), np.nan)
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    rank = int(np.sum(s > RCOND * s.max(initial=0.0)))
    sqrt_cov = Vt[:rank].T / s[:rank]
    covariance: Floats = sqrt_cov @ sqrt_cov.T
    if not weighted:
        covariance = covariance * (float(r @ r) / (len(r) - rank) if len(r) > rank else np.nan)
    undetermined = np.linalg.norm(Vt[rank:], axis=0) > MAX_SHARE
    covariance[undetermined] = covariance[:, undetermined] = np.nan
    return covariance


class _Rows(Record):
    """Train measurements of one kind from one table.

    Attributes:
        table: Number of their table.
        block: The measurements with unit weights.
        landmarks: Coordinates that each depends on, among those of the dataset, shape (n, kind.n_nuisances).
        use: Which of their scalars take part, shape (n, residual_dim).
        covariance: Private noise of each, shape (n, residual_dim, residual_dim); any number where not used.
    """

    table: int
    block: Block
    landmarks: Integers
    use: Booleans
    covariance: Floats

    def whitening(self, chain: Chain, coordinates: Floats, sigma_joint: Floats) -> Floats:
        """W with W S W^T = 1 of each measurement, lower triangular, shape (n, residual_dim, residual_dim).

        S is the private noise plus joint noise to first order; an unused scalar has unit variance by itself.
        """
        S, ends = self.covariance, self.block.kind.ends
        if ends and np.any(sigma_joint > 0.0):
            block = replace(self.block, nuisances=coordinates[self.landmarks])
            J = residuals.linearise(block, chain.without_columns().with_joint_columns())[1]
            J = J[:, :, : ends * len(sigma_joint)] * np.tile(sigma_joint, ends)
            S = S + J @ np.swapaxes(J, 1, 2)
        S = np.where(self.use[:, :, None] & self.use[:, None, :], S, np.eye(self.block.residual_dim))
        if np.any(np.diagonal(S, axis1=1, axis2=2) <= 0.0):
            raise InputError("noise", "a row without any", "noise in every row, to weight by")
        return np.asarray(np.linalg.inv(np.linalg.cholesky(S)))


def _train_rows(robot: Robot, data: Dataset, weighted: bool) -> list[_Rows]:
    """Every measured train row of all tables, without weights of unit variance."""
    found = []
    for s in data.blocks:
        train, h = s.train, s.kind.residual_dim
        if not len(train):
            continue
        unit, unset, sigma = unit_whitening(len(train), h), np.zeros(s.nuisances[train].shape), s.sigma
        block = Block(s.kind, data.trigs(robot)[s.table], s.ends[train], s.data[train], unit, unset, s.source)
        if s.formed:  # each pair as if it were alone
            pairs = usable_pairs(data.tables[s.table])
            of_pairs = {"distance": pairs.sigma_distance, "angle": pairs.sigma_angle}
            sigma = np.stack([of_pairs[part.quantity][s.number] for part in s.kind.parts], axis=1)
            sigma = np.where(np.isnan(sigma), 1.0, sigma)
        specified = None if s.formed else s.covariance
        covariance = sigma[:, :, None] ** 2 * np.eye(h) if specified is None else specified
        private = covariance[train] if weighted else np.broadcast_to(np.eye(h), (len(train), h, h))
        found.append(_Rows(s.table, block, s.nuisances[train], s.used[train], private))
    models = ", ".join(dict.fromkeys(str(table.model) for table in data.tables))
    expect(found, data.source, "no row left to fit", f"train rows for model {models}")
    return found


class _System:
    """Rows as a function of the unknowns: parameters, unknown frames, landmarks' coordinates.

    Unknowns are some of the values that `LeastSquares.parameters` lists; derivatives are taken in all of these.
    """

    def __init__(self, robot: Robot, data: Dataset, chosen: list[int], start: Floats | None, weighted: bool) -> None:
        unknown = np.array([table.unknown_frame for table in data.tables])
        n, n_frames, marks, owners = len(robot.parameters), int(unknown.sum()), data.landmarks, data.landmarks.owners
        self._weighted, self._sigma_joint = weighted, data.sigma_joint if weighted else 0.0 * data.sigma_joint
        self._n, self._edge = n, n + 6 * max(1, n_frames)
        self._free = np.flatnonzero(data.estimated()[owners])
        self._column = np.full(len(marks.start), -1, dtype=np.int64)  # -1: a known coordinate
        self._column[self._free] = self._edge + np.arange(len(self._free))
        self._coordinates: Floats = marks.start
        tolerances = np.array([np.nan if item.tolerance is None else item.tolerance for item in marks.items])
        sigma = tolerances[owners[self._free]]
        self._held = np.flatnonzero(np.isfinite(sigma))  # by priors
        self._prior_sigma = sigma[self._held] if weighted else np.ones(len(self._held))
        own = np.concatenate([robot.nominal, np.zeros(self._edge - n), marks.start[self._free]])
        start = own if start is None else start
        if start.shape != own.shape or not np.isfinite(start).all():
            raise InputError("start", f"shape {start.shape}", "finite values as `Problem.start`")
        self._start, frames = start, np.arange(n, n + 6 * n_frames)
        self._index = np.concatenate([chosen, frames, np.arange(self._edge, len(start))]).astype(np.int64)
        first = n + 6 * (np.cumsum(unknown) - 1)
        self._frames = [slice(k, k + 6) if own else slice(0) for k, own in zip(first.tolist(), unknown, strict=True)]
        columns = (dict(enumerate([*range(n), *range(len(start))[frame]])) for frame in self._frames)
        chains = (build_chain(robot, of, frame=own) for of, own in zip(columns, unknown.tolist(), strict=True))
        self._chains = [replace(chain, n_columns=self._edge) for chain in chains]
        self._rows = _train_rows(robot, data, weighted)

    def parameters(self, x: Floats) -> Floats:
        """Values of the robot, the frames and the landmarks at the unknowns x: see `LeastSquares.parameters`."""
        out = self._start.copy()
        out[self._index] = x
        return out

    def _at(self, x: Floats) -> tuple[list[Chain], Floats]:
        """The arm in each table's measurement frame, and coordinates of all landmarks, at the unknowns x."""
        values, coordinates = self.parameters(x), self._coordinates.copy()
        coordinates[self._free] = values[self._edge :]
        pairs = zip(self._chains, self._frames, strict=True)
        return [chain.at(np.append(values[: self._n], values[frame])) for chain, frame in pairs], coordinates

    def evaluate(self, x: Floats, weights: Weights) -> tuple[Floats, Floats]:
        """Whitened residuals, shape (m,), and their derivatives, shape (m, n_unknowns)."""
        (chains, coordinates), found_r, found_J = self._at(x), [], []
        for W, rows in zip(weights, self._rows, strict=True):
            r, J = residuals.linearise(replace(rows.block, nuisances=coordinates[rows.landmarks]), chains[rows.table])
            wide = np.zeros((*r.shape, len(self._start) + 1))  # the last column for known coordinates
            wide[:, :, : self._edge] = J[:, :, : self._edge]
            for k, columns in enumerate(self._column[rows.landmarks].T):
                wide[np.arange(len(r)), :, columns] = J[:, :, self._edge + k]
            found_r.append((W @ np.where(rows.use, r, 0.0)[:, :, None])[:, :, 0][rows.use])
            found_J.append((W @ (wide[:, :, self._index] * rows.use[:, :, None]))[rows.use])
        held = self._edge + self._held
        found_r.append((coordinates - self._coordinates)[self._free[self._held]] / self._prior_sigma)
        found_J.append(np.eye(len(self._start))[held][:, self._index] / self._prior_sigma[:, None])
        return np.concatenate(found_r), np.concatenate(found_J)

    def solve(self) -> tuple[Fit, Weights]:
        """The fit and its weights: those at the estimate, where joint noise makes them depend on it."""
        x, iterations, moved = self._start[self._index], 0, np.inf
        for _ in range(_ROUNDS):
            chains, coordinates = self._at(x)
            weights = tuple(r.whitening(chains[r.table], coordinates, self._sigma_joint) for r in self._rows)
            fit = (scipy_fit if self._weighted else gauss_newton)(partial(self.evaluate, weights=weights), x)
            moved, x, iterations = float(np.linalg.norm(fit.x - x)), fit.x, iterations + fit.iterations
            if not fit.converged or moved <= REWEIGHTED or not np.any(self._sigma_joint > 0.0):
                return replace(fit, iterations=iterations), weights
        return Fit(x, False, f"not converged: new weights still move it by {moved:.1e}", iterations), weights
