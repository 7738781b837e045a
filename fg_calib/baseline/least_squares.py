r"""Plain least squares: the baseline that the factor graph is compared with.

Without weights, the paper's own estimator: Jia et al. (2019), Eq. (54) and (55), as printed:

    dPsi_i = Psi* - f(Omega_i, Theta)               measured minus predicted, metres and radians side by side
    dOmega_{i+1} = J(Omega_i, Theta)^+ dPsi_i       the Moore-Penrose inverse: a minimum-norm step
    Omega_{i+1} = Omega_i + dOmega_{i+1}            until dOmega is small

With weights, `scipy.optimize.least_squares` on the same rows, whitened by their noise. Nothing here knows GTSAM,
priors, damping or observability: of the graph's mathematics only `residuals` is shared.

An unknown measurement frame takes six more unknowns: world_T_base = start * Txyz Rz(yaw) Ry(pitch) Rx(roll), a
correction of the frame that the fit starts from. It starts at zero, where its angles are far from singular. Landmarks
that are not known are unknowns as well; a landmark with a prior is a measurement of its place.

Note:
    Every measured train row takes part, but for distances of exactly 0 and angles of exactly 0 or pi at the start,
    where they are not differentiable. Every measurement counts as independent, also pairs formed from poses and the
    rows of one configuration, which share its joint noise. All rows and derivatives are in memory at once.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from fg_calib.inputs import Booleans, Brief, Floats, InputError, Integers, check_names, checked
from fg_calib.measurements import Block, Dataset, residuals, unit_whitening, usable_pairs
from fg_calib.parallel import single_threaded
from fg_calib.robot import (
    AXIS_OF_KIND,
    FRAME_KINDS,
    Chain,
    Element,
    Parameter,
    Robot,
    build_chain,
    names_of,
    rotation_of,
    yaw_pitch_roll,
)

RCOND = 1e-10
"""Singular values of J below this part of the largest count as zero in J^+."""

MAX_SHARE = 1e-6
"""A parameter with more than this share in a null-space direction of J has no sigma."""

ROUNDING = 1e-8
"""A step below this that no longer shrinks is rounding, which weak directions magnify, [m] and [rad]."""

REWEIGHTED = 1e-10
"""Weights are final once a fit with them moves the unknowns by less than this, [m] and [rad]."""

NOT_DIFFERENTIABLE = 1e-12
"""A predicted distance below this, or an angle this near to 0 or pi, has no derivative, [m], [rad]."""

_ROUNDS, _STEPS = 20, 50
"""Fits with new weights, and steps of one fit, at most."""

_SMALL_STEP = 1e-12
"""Length of a step that ends a fit, metres and radians side by side."""


@dataclass(frozen=True)
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


@checked
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
        data: What was measured: all tables of a calibration with their landmarks (see `measurements.build_dataset`).
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
    if not wanted:
        raise InputError("names", "nothing to estimate", "at least one parameter")
    system = _System(robot, data, [i for i, p in enumerate(robot.parameters) if p.name in wanted], start)
    fit, weights = system.solve(weighted)
    m = len(system.chosen)
    r, J = system.evaluate(fit.x, weights)
    return LeastSquares(
        robot=robot.with_values(system.values(fit.x)),
        names=tuple(robot.parameters[i].name for i in system.chosen),
        parameters=system.parameters(fit.x),
        covariance=claimed_covariance(r, J, weighted)[:m, :m],
        n_rows=len(r),
        converged=fit.converged,
        message=fit.message,
        iterations=fit.iterations,
        seconds=time.perf_counter() - clock,
    )


Evaluate = Callable[[Floats], tuple[Floats, Floats]]
"""From the unknowns to residuals, shape (m,), and their derivatives, shape (m, n)."""

Weights = tuple[Floats, ...]
"""Whitening of each block of rows, shape (n, residual_dim, residual_dim)."""


@dataclass(frozen=True)
class Fit:
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
    """Minimum by MINPACK's Levenberg-Marquardt, or scipy's trust region with fewer rows than unknowns."""
    from scipy import optimize  # here: it takes as long to import as a small calibration

    def residual(x: Floats) -> Floats:
        return evaluate(x)[0]

    def jacobian(x: Floats) -> Floats:
        return evaluate(x)[1]

    method: Literal["lm", "trf"] = "lm" if len(residual(x)) >= len(x) else "trf"
    exact = 1e-15  # near the least that MINPACK takes
    try:
        found = optimize.least_squares(
            residual,
            x,
            jacobian,
            method=method,
            x_scale="jac",
            ftol=exact,
            xtol=_SMALL_STEP,
            gtol=exact,
            max_nfev=_STEPS,
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        return Fit(x, False, f"no step possible: {error}", 0)
    message = " ".join(str(found.message).split()).rstrip(".")
    message = f"{'converged' if found.status > 0 else 'not converged'}: {message}"
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
    covariance[undetermined, :] = np.nan
    covariance[:, undetermined] = np.nan
    return covariance


@dataclass(frozen=True)
class _Rows:
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

    def at(self, coordinates: Floats) -> Block:
        """The measurements with values of their landmarks."""
        return replace(self.block, nuisances=coordinates[self.landmarks])

    def differentiable(self, chain: Chain) -> _Rows:
        """The rows without distances and angles of pairs that have no derivative at the start."""
        parts = self.block.kind.parts
        if not all(part.ends == 2 and part.quantity in ("distance", "angle") and not part.is_contact for part in parts):
            return self
        predicted = residuals.residual(self.block, chain) + self.block.data
        most = np.array([np.pi if part.quantity == "angle" else np.inf for part in parts])
        good = (predicted >= NOT_DIFFERENTIABLE) & (predicted <= most - NOT_DIFFERENTIABLE)
        return replace(self, use=self.use & good)

    def whitening(self, chain: Chain, coordinates: Floats, sigma_joint: Floats) -> Floats:
        """W with W S W^T = 1 of each measurement, lower triangular, shape (n, residual_dim, residual_dim).

        S is the private noise plus joint noise to first order; an unused scalar has unit variance by itself.
        """
        S, ends = self.covariance, self.block.kind.ends
        if ends and np.any(sigma_joint > 0.0):
            J = residuals.linearise(self.at(coordinates), chain.without_columns().with_joint_columns())[1]
            J = J[:, :, : ends * len(sigma_joint)] * np.tile(sigma_joint, ends)
            S = S + J @ np.swapaxes(J, 1, 2)
        S = np.where(self.use[:, :, None] & self.use[:, None, :], S, np.eye(self.block.residual_dim))
        try:
            W: Floats = np.tril(np.linalg.inv(np.linalg.cholesky(S)))
        except np.linalg.LinAlgError:
            raise InputError("noise", "a row without any", "noise in every row, to weight by") from None
        return W


def _train_rows(robot: Robot, data: Dataset) -> list[_Rows]:
    """Every measured train row of all tables."""
    found = []
    for s in data.series:
        train, h = s.train, s.kind.residual_dim
        if not len(train):
            continue
        trig, unit = data.trigs(robot)[s.table], unit_whitening(len(train), h)
        unset = np.zeros(s.nuisances[train].shape)
        block = Block(s.kind, trig, s.ends[train], s.data[train], unit, unset, s.source)
        sigma: Floats = s.sigma
        if s.formed:  # each pair as if it were alone
            pairs = usable_pairs(data.tables[s.table], ("distance" in s.kind.names, "angle" in s.kind.names))
            of_pairs = {"distance": pairs.sigma_distance, "angle": pairs.sigma_angle}
            columns = [np.nan_to_num(of_pairs[part.quantity][s.number], nan=1.0) for part in s.kind.parts]
            sigma = np.stack(columns, axis=1)
        covariance = sigma[train][:, :, None] ** 2 * np.eye(h)
        if s.covariance is not None and not s.formed:
            covariance = s.covariance[train]
        found.append(_Rows(s.table, block, s.nuisances[train], s.used[train], covariance))
    return found


class _System:
    """Rows as a function of the unknowns: parameters, a correction of each unknown frame, landmarks' coordinates."""

    def __init__(self, robot: Robot, data: Dataset, chosen: list[int], start: Floats | None) -> None:
        self.chosen, self._sigma_joint = chosen, data.sigma_joint
        unknown = np.array([table.unknown_frame for table in data.tables])
        self._frame_of = np.where(unknown, np.cumsum(unknown) - 1, -1).tolist()
        estimated = data.estimated()
        places = [np.arange(*ends) for ends in pairwise(np.cumsum([0, *data.unknowns.sizes]).tolist())]
        self._coordinates: Floats = np.concatenate([np.zeros(0), *data.unknowns.starts])
        self._priors = [
            (place, self._coordinates[place], sigma)
            for place, sigma, of in zip(places, data.unknowns.tolerances, estimated, strict=True)
            if of and sigma is not None
        ]
        self._estimated = np.concatenate(
            [np.zeros(0, np.int64), *(p for p, of in zip(places, estimated, strict=True) if of)]
        )
        n, m, n_frames = len(robot.parameters), len(chosen), int(unknown.sum())
        edges = [n, n + 6 * max(1, n_frames)]
        if start is None:
            start = np.concatenate([robot.nominal, np.zeros(6 * max(1, n_frames)), self._coordinates[self._estimated]])
        if start.shape != (edges[1] + len(self._estimated),) or not np.isfinite(start).all():
            raise InputError(
                "start", f"shape {start.shape}, or a value that is not finite", "values as `Problem.start`"
            )
        self._values, frames, landmarks = np.split(start, edges)
        self._frames = frames.reshape(-1, 6)[:n_frames]
        self._coordinates[self._estimated] = landmarks
        self.n_core = m + 6 * n_frames
        self._first = np.concatenate([self._values[chosen], np.zeros(6 * n_frames), landmarks])
        self._column = np.full(len(self._coordinates), -1, dtype=np.int64)  # -1: a known coordinate
        self._column[self._estimated] = self.n_core + np.arange(len(landmarks))
        self._chains = []
        for frame in self._frame_of:
            extended = _with_frame(robot.with_values(self._values), np.zeros(6) if frame < 0 else self._frames[frame])
            columns = {c: k for k, c in enumerate(chosen)}
            columns |= {n + k: m + 6 * frame + k for k in range(6) if frame >= 0}
            self._chains.append(replace(build_chain(extended, columns), n_columns=self.n_core))
        rows = (r.differentiable(self._chain(r.table, self._first)) for r in _train_rows(robot, data))
        self._rows = [r for r in rows if r.use.any()]
        if not self._rows:
            models = ", ".join(dict.fromkeys(str(table.model) for table in data.tables))
            raise InputError(data.source, "no row left to fit", f"train rows for model {models}")

    def values(self, x: Floats) -> Floats:
        """The robot's parameters at the unknowns x."""
        values = self._values.copy()
        values[self.chosen] = x[: len(self.chosen)]
        return values

    def parameters(self, x: Floats) -> Floats:
        """Values of the robot, the frames and the landmarks at the unknowns x: see `LeastSquares.parameters`."""
        frames = np.zeros((max(1, len(self._frames)), 6))
        corrections = x[len(self.chosen) : self.n_core].reshape(-1, 6)
        for out, start, correction in zip(frames, self._frames, corrections, strict=False):
            R = rotation_of(*start[3:])
            out[:3], out[3:] = start[:3] + R @ correction[:3], yaw_pitch_roll(R @ rotation_of(*correction[3:]))
        return np.concatenate([self.values(x), frames.ravel(), x[self.n_core :]])

    def _chain(self, table: int, x: Floats) -> Chain:
        """The arm in a table's measurement frame at the unknowns x."""
        frame = len(self.chosen) + 6 * self._frame_of[table]
        correction = np.zeros(6) if self._frame_of[table] < 0 else x[frame : frame + 6]
        return self._chains[table].at(np.concatenate([self.values(x), correction]))

    def _landmarks(self, x: Floats) -> Floats:
        """Coordinates of all landmarks at the unknowns x."""
        out = self._coordinates.copy()
        out[self._estimated] = x[self.n_core :]
        return out

    def evaluate(self, x: Floats, weights: Weights | None) -> tuple[Floats, Floats]:
        """Residuals, shape (m,), and derivatives, shape (m, n_unknowns); not weighted if `weights` is None."""
        coordinates, found_r, found_J = self._landmarks(x), [], []
        for i, rows in enumerate(self._rows):
            r, J = residuals.linearise(rows.at(coordinates), self._chain(rows.table, x))
            if weights is not None:
                r = (weights[i] @ np.where(rows.use, r, 0.0)[:, :, None])[:, :, 0]
                J = weights[i] @ (J * rows.use[:, :, None])
            r, J, of = r[rows.use], J[rows.use], np.nonzero(rows.use)[0]
            wide = np.zeros((len(r), len(x) + 1))  # the last column for known coordinates
            wide[:, : self.n_core] = J[:, : self.n_core]
            for k, columns in enumerate(self._column[rows.landmarks[of]].T):
                wide[np.arange(len(r)), columns] = J[:, self.n_core + k]
            found_r.append(r)
            found_J.append(wide[:, :-1])
        for place, mean, sigma in self._priors:
            weight = 1.0 if weights is None else sigma
            found_r.append((coordinates[place] - mean) / weight)
            found_J.append(np.eye(len(x) + 1)[self._column[place], :-1] / weight)
        return np.concatenate(found_r), np.concatenate(found_J)

    def _weights(self, x: Floats) -> Weights:
        coordinates = self._landmarks(x)
        return tuple(r.whitening(self._chain(r.table, x), coordinates, self._sigma_joint) for r in self._rows)

    def solve(self, weighted: bool) -> tuple[Fit, Weights | None]:
        """The fit and its weights: those at the estimate, where joint noise makes them depend on it."""
        if not weighted:
            return gauss_newton(partial(self.evaluate, weights=None), self._first), None
        x, iterations, moved = self._first, 0, np.inf
        for _ in range(_ROUNDS):
            weights = self._weights(x)
            fit = scipy_fit(partial(self.evaluate, weights=weights), x)
            moved, x, iterations = float(np.linalg.norm(fit.x - x)), fit.x, iterations + fit.iterations
            if not fit.converged or moved <= REWEIGHTED or not np.any(self._sigma_joint > 0.0):
                return replace(fit, iterations=iterations), weights
        return Fit(x, False, f"not converged: new weights still move it by {moved:.1e}", iterations), weights


def _with_frame(robot: Robot, world_T_base: Floats) -> Robot:
    """The robot after a frame and a correction of it, whose six parameters come last."""
    n = len(robot.parameters)
    fixed = [Element(AXIS_OF_KIND[kind], float(v)) for kind, v in zip(FRAME_KINDS, world_T_base, strict=True)]
    free = [Element(AXIS_OF_KIND[kind], parameter=n + i) for i, kind in enumerate(FRAME_KINDS)]
    correction = (Parameter(f"frame.{kind}", kind, 0, 0.0) for kind in FRAME_KINDS)
    return replace(robot, parameters=(*robot.parameters, *correction), elements=(*fixed, *free, *robot.elements))
