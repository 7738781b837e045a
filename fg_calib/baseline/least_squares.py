r"""Plain least squares, the paper's own estimator: the baseline that the factor graph is compared with.

Jia et al. (2019), Eq. (54) and (55), as printed:

    dPsi_i = Psi* - f(Omega_i, Theta)               measured minus predicted, metres and radians side by side
    dOmega_{i+1} = J(Omega_i, Theta)^+ dPsi_i       the Moore-Penrose inverse: a minimum-norm step
    Omega_{i+1} = Omega_i + dOmega_{i+1}            until dOmega is small

Beside it the same with rows whitened by their noise, and `scipy.optimize.least_squares` on the same rows. Nothing here
knows of GTSAM, priors, damping or observability: of the graph's mathematics only `residuals` is shared.

A measurement frame that is unknown takes six more unknowns: world_T_base = start * Txyz Rz(yaw) Ry(pitch) Rx(roll), a
correction of the frame that the fit starts from. It starts at zero, so that its angles stay away from where they are
singular.

Note:
    Every measured train row takes part. Only a row that has no derivative at the start (a distance of exactly 0, an
    angle of exactly 0 or pi) is left out: the paper mentions these kinks and judges no further, and near one a row
    misleads. Pairs formed from poses count as independent. All rows and derivatives are held at once.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import InputError
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, form_pairs
from fg_calib.measurements.residuals import Block, PairBlock, PoseBlock
from fg_calib.options import FrameKnowledge, Model, Pairing, as_pairing, check, check_flag, check_names, check_number
from fg_calib.robot.kinematics import Chain, build_chain, precompute_trig
from fg_calib.robot.model import AXIS_OF_KIND, FRAME_KINDS, Element, Parameter, Robot, names_of
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

Method = Literal["gauss-newton", "scipy"]

RCOND = 1e-10
"""Singular values of J below this part of the largest count as zero in J^+."""

SHARE = 1e-6
"""A parameter with more than this share in a direction that J leaves open has no sigma."""

KINK = 1e-12
"""A predicted distance below this, or an angle this near to 0 or pi, is exactly there but for rounding, [m], [rad]."""

ROUNDING = 1e-8
"""A step below this that no longer shrinks is rounding: weak directions magnify it, [m] and [rad]."""

REWEIGHTED = 1e-10
"""Weights are final once a fit with them moves the parameters by less than this, [m] and [rad]."""

_ROUNDS = 20
"""Fits with new weights at most."""

_KINDS: dict[Model, tuple[bool, bool]] = {
    "distance": (True, False),
    "rotation": (False, True),
    "distance-rotation": (True, True),
    "orientation": (True, False),
    "position": (False, True),
    "pose": (True, True),
}
"""Whether a model has distances and angles, or orientations and positions."""

_OF_PAIRS: tuple[Model, ...] = ("distance", "rotation", "distance-rotation")


@dataclass(frozen=True)
class LeastSquares:
    """What plain least squares found.

    Attributes:
        robot: The robot with the estimated values.
        names: The parameters that were estimated, in the order of the covariance.
        frame: x, y, z, yaw, pitch, roll of the measurement frame world_T_base, shape (6,), [m] and [rad]; that of the
            start where it was not estimated.
        covariance: Of the estimated parameters as least squares claims it, shape (n_names, n_names), [m] and [rad]:
            (J^T W J)^-1 if weighted by noise, else s^2 (J^T J)^-1 with s^2 = |r|^2 / (n_rows - rank). nan in rows and
            columns of parameters that J leaves open, and everywhere where s^2 has no degree of freedom.
        residuals: Predicted minus measured of the rows that took part, not weighted, shape (n_rows,), [m] and [rad].
        rank: Of J at the estimate, the measurement frame's columns included.
        converged: Whether the last step was small enough.
        message: Why it stopped.
        iterations: Steps taken (scipy: derivatives asked for).
        steps: Length of each Gauss-Newton step, metres and radians side by side; empty for scipy.
        seconds: Time taken.
    """

    robot: Robot
    names: tuple[str, ...]
    frame: Floats
    covariance: Floats
    residuals: Floats
    rank: int
    converged: bool
    message: str
    iterations: int
    steps: tuple[float, ...]
    seconds: float

    @property
    def n_rows(self) -> int:
        """Number of scalar residuals."""
        return len(self.residuals)

    @property
    def sigma(self) -> dict[str, float]:
        """1 sigma of each estimated parameter, [m] or [rad]; nan where J leaves it open."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def parameters(self) -> Floats:
        """The robot's values and `frame`, shape (n_parameters + 6,), [m] and [rad]."""
        return np.concatenate([self.robot.nominal, self.frame])


@single_threaded
def fit_least_squares(
    robot: Robot,
    measurements: Measurements,
    *,
    model: Model,
    pairing: Pairing | None = None,
    names: Sequence[str] | None = None,
    start: Floats | None = None,
    frame: FrameKnowledge = "known",
    weighted: bool = False,
    method: Method = "gauss-newton",
    max_iterations: int = 50,
    tolerance: float = 1e-12,
) -> LeastSquares:
    """Estimate parameters by plain least squares.

    Args:
        robot: The nominal robot; its tolerances are not used.
        measurements: What was measured. Rows that are nan in its pairs take no part.
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly; a star if None.
        names: The parameters to estimate; all that the robot's file lets be estimated if None. With more than the
            measurements determine every step is a minimum-norm step.
        start: Values to start from, shape (n_parameters,), [m] or [rad], or with x, y, z, yaw, pitch, roll of the
            measurement frame, shape (n_parameters + 6,). Nominal values and the identity if None.
        frame: `unknown` estimates world_T_base with the parameters; of no meaning for models of pairs.
        weighted: Whether rows are whitened by the noise of measurements and, to first order, of joint readings. The
            weights are those at the start, then those at the estimate, until they change nothing more.
        method: `gauss-newton`, as printed; `scipy`: `scipy.optimize.least_squares` with the same derivatives.
        max_iterations: Steps (scipy: evaluations) after which it gives up.
        tolerance: Length of a Gauss-Newton step that is small enough, metres and radians side by side.

    Returns:
        The estimate; where it did not converge its message says so.

    Raises:
        InputError: An argument is not one of those possible, or the measurements lack what the model needs.
    """
    for key, option, possible in (
        ("model", model, Model),
        ("method", method, Method),
        ("frame", frame, FrameKnowledge),
    ):
        check(key, option, possible)
    check_flag("weighted", weighted)
    check_number("max_iterations", max_iterations, least=1, whole=True)
    check_number("tolerance", tolerance, finite=False)
    pairing = as_pairing(pairing)
    clock = time.perf_counter()
    values, world_T_base = _start(robot, start)
    chosen = _chosen(robot, names)
    unknown = frame == "unknown" and model not in _OF_PAIRS
    # The chain starts in the measurement frame as the fit does; a correction of it is six more parameters.
    extended = _with_frame(robot.with_values(values), world_T_base if model not in _OF_PAIRS else np.zeros(6))
    n = len(robot.parameters)
    columns = np.array([*chosen, *(range(n, n + 6) if unknown else ())], dtype=np.int64)
    chain = build_chain(extended, {int(c): k for k, c in enumerate(columns)})
    first = extended.nominal

    def parameters(x: Floats) -> Floats:
        full = first.copy()
        full[columns] = x
        return full

    rows = _rows(robot, measurements, model, pairing, weighted)
    rows = _without_kinks(rows, chain.at(first), model)
    if not rows.use.any():
        raise InputError(measurements.source, "no row left to fit", f"train rows for model {model}")

    fit = _Fit(x=first[columns], converged=False, message="", iterations=0, steps=())
    whitening = None
    for _ in range(_ROUNDS if weighted else 1):
        whitening = _whitening(rows, chain.at(parameters(fit.x)), measurements.sigma_joint) if weighted else None

        def evaluate(x: Floats, whitening: Floats | None = whitening) -> tuple[Floats, Floats]:
            return _evaluate(rows, chain.at(parameters(x)), whitening)

        solver = _gauss_newton if method == "gauss-newton" else _scipy
        again = solver(evaluate, fit.x, max_iterations, tolerance)
        moved = float(np.linalg.norm(again.x - fit.x))
        fit = replace(again, iterations=fit.iterations + again.iterations, steps=fit.steps + again.steps)
        if not fit.converged or moved <= REWEIGHTED or not np.any(measurements.sigma_joint > 0.0):
            break
    else:
        if weighted:
            fit = replace(fit, converged=False, message=f"not converged: new weights still move it by {moved:.1e}")
    r, J = _evaluate(rows, chain.at(parameters(fit.x)), whitening)
    covariance, rank = _covariance(r, J, weighted)
    full = parameters(fit.x)
    return LeastSquares(
        robot=robot.with_values(full[:n]),
        names=tuple(robot.parameters[i].name for i in chosen),
        frame=_composed(world_T_base, full[n:]) if unknown else world_T_base,
        covariance=covariance[: len(chosen), : len(chosen)],
        residuals=_evaluate(rows, chain.at(full).without_columns(), None)[0],
        rank=rank,
        converged=fit.converged,
        message=fit.message,
        iterations=fit.iterations,
        steps=fit.steps,
        seconds=time.perf_counter() - clock,
    )


@dataclass(frozen=True)
class _Fit:
    """Unknowns where a method stopped, and why."""

    x: Floats
    converged: bool
    message: str
    iterations: int
    steps: tuple[float, ...]


_Evaluate = Callable[[Floats], tuple[Floats, Floats]]
"""From the unknowns to residuals, shape (m,), and their derivatives, shape (m, n)."""


def _gauss_newton(evaluate: _Evaluate, x: Floats, max_iterations: int, tolerance: float) -> _Fit:
    """Eq. (54) and (55)."""
    steps: list[float] = []

    def end(converged: bool, message: str) -> _Fit:
        return _Fit(x, converged, message, len(steps), tuple(steps))

    for _ in range(max_iterations):
        with np.errstate(all="ignore"):
            r, J = evaluate(x)
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                return end(False, f"diverged: residuals are not finite after {len(steps)} steps")
            try:
                step = np.linalg.pinv(J, rcond=RCOND) @ -r
            except np.linalg.LinAlgError as error:
                return end(False, f"no step possible: {error}")
        if not np.isfinite(step).all():
            return end(False, f"diverged: step {len(steps) + 1} is not finite")
        x = x + step
        steps.append(float(np.linalg.norm(step)))
        if steps[-1] <= tolerance:
            return end(True, f"converged: the last step was {steps[-1]:.1e}")
        if steps[-1] <= ROUNDING and len(steps) > 1 and steps[-1] >= steps[-2]:
            return end(True, f"converged to rounding: steps of {steps[-1]:.1e} no longer shrink")
    return end(False, f"not converged: {max_iterations} iterations, the last step was {steps[-1]:.1e}")


def _scipy(evaluate: _Evaluate, x: Floats, max_iterations: int, tolerance: float) -> _Fit:
    """MINPACK's Levenberg-Marquardt, or scipy's trust region where there are fewer rows than unknowns."""

    def residual(x: Floats) -> Floats:
        return evaluate(x)[0]

    def derivative(x: Floats) -> Floats:
        return evaluate(x)[1]

    from scipy import optimize  # here, for it takes as long to import as a small calibration

    exact = 1e-15  # near the least that MINPACK takes
    try:
        found = optimize.least_squares(
            residual,
            x,
            jac=derivative,
            method="lm" if len(residual(x)) >= len(x) else "trf",
            x_scale="jac",
            ftol=exact,
            xtol=max(exact, tolerance),
            gtol=exact,
            max_nfev=max_iterations,
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        return _Fit(x, False, f"no step possible: {error}", 0, ())
    converged = bool(found.status > 0)
    message = " ".join(str(found.message).split()).rstrip(".")
    message = f"{'converged' if converged else 'not converged'}: {message}"
    return _Fit(np.asarray(found.x, dtype=np.float64), converged, message, int(found.njev or found.nfev), ())


@dataclass(frozen=True)
class _Rows:
    """The train measurements, with unit weights.

    Attributes:
        block: The measurements.
        use: Which of their scalars take part, shape (n, height).
        variance: Of the measurement noise, shape (n, height), [m^2] and [rad^2]; any number where not used.
    """

    block: Block
    use: Booleans
    variance: Floats


def _evaluate(rows: _Rows, chain: Chain, whitening: Floats | None) -> tuple[Floats, Floats]:
    """Residuals, shape (m,), and derivatives, shape (m, n_columns), of the rows in use."""
    r, J = residuals.linearise(rows.block, chain)
    if whitening is not None:
        r, J = (whitening @ np.where(rows.use, r, 0.0)[:, :, None])[:, :, 0], whitening @ (J * rows.use[:, :, None])
    return r[rows.use], J[rows.use]


def _whitening(rows: _Rows, chain: Chain, sigma_joint: Floats) -> Floats:
    """W with W S W^T = 1 of each measurement, lower triangular, shape (n, height, height).

    S has the variances of the measurement and what the readings' noise adds to first order; scalars that take no part
    are apart from the others.
    """
    S = rows.variance[:, :, None] * np.eye(rows.block.height)
    if np.any(sigma_joint > 0.0):
        J = residuals.linearise(rows.block, chain.without_columns().with_joint_columns())[1]
        J = J * np.tile(sigma_joint, rows.block.n_configurations)  # (n, height, n_own)
        S = S + J @ np.swapaxes(J, 1, 2)
    S = np.where(rows.use[:, :, None] & rows.use[:, None, :], S, np.eye(rows.block.height))
    try:
        W: Floats = np.tril(np.linalg.inv(np.linalg.cholesky(S)))
    except np.linalg.LinAlgError:
        raise InputError("noise", "a row without any", "noise in every row, to weight by") from None
    return W


def _covariance(r: Floats, J: Floats, weighted: bool) -> tuple[Floats, int]:
    """(J^T J)^-1, times s^2 where the rows are not weighted, nan where J leaves a parameter open; and the rank of J."""
    n = J.shape[1]
    if not np.isfinite(J).all():
        return np.full((n, n), np.nan), 0
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    rank = int(np.sum(s > RCOND * s.max(initial=0.0)))
    half = Vt[:rank].T / s[:rank]
    covariance: Floats = half @ half.T
    if not weighted:
        covariance = covariance * (float(r @ r) / (len(r) - rank) if len(r) > rank else np.nan)
    loose = np.linalg.norm(Vt[rank:], axis=0) > SHARE
    covariance[loose, :] = np.nan
    covariance[:, loose] = np.nan
    return covariance, rank


def _rows(robot: Robot, measurements: Measurements, model: Model, pairing: Pairing, weighted: bool) -> _Rows:
    """Every measured train row of a model."""
    trig = precompute_trig(robot, measurements.readings)
    if model in _OF_PAIRS:
        return _pair_rows(trig, measurements, model, pairing, weighted)
    return _pose_rows(trig, measurements, model, weighted)


def _pair_rows(trig: Floats, measurements: Measurements, model: Model, pairing: Pairing, weighted: bool) -> _Rows:
    kinds = np.array(_KINDS[model])
    if measurements.pairs is None:
        needed = (("distance", "positions", measurements.position), ("angle", "orientations", measurements.rotation))
        for wanted, (_, what, given) in zip(kinds, needed, strict=True):
            if wanted and given is None:
                raise InputError(measurements.source, f"no measured {what}", f"{what} for model {model}")
    pairs = measurements.pairs if measurements.pairs is not None else form_pairs(measurements, pairing)
    pairs = pairs.select(~pairs.test)
    measured = np.stack([pairs.distance, pairs.angle], axis=1)
    sigma = np.stack([pairs.sigma_distance, pairs.sigma_angle], axis=1)
    use = np.isfinite(measured)[:, kinds]
    if weighted:
        for k, kind in enumerate(("distance", "angle")):
            if kinds[k] and np.any(np.isfinite(measured[:, k]) & ~np.isfinite(sigma[:, k])):
                raise InputError(pairs.source, f"no sigma for {kind}", "the noise of every row, to weight by")
    unit = np.tile([1.0, 0.0, 1.0], (pairs.n_pairs, 1))
    both = (bool(kinds[0]), bool(kinds[1]))
    block = PairBlock(trig, pairs.a, pairs.b, np.nan_to_num(measured), unit, both)
    return _Rows(block, use, np.nan_to_num(sigma[:, kinds], nan=1.0) ** 2)


def _pose_rows(trig: Floats, measurements: Measurements, model: Model, weighted: bool) -> _Rows:
    kinds = _KINDS[model]
    train = np.flatnonzero(~measurements.test)
    n = len(train)
    given = (
        (measurements.rotation, measurements.sigma_orientation, "orientation"),
        (measurements.position, measurements.sigma_position, "position"),
    )
    variance = []
    for wanted, (values, sigma, what) in zip(kinds, given, strict=True):
        if wanted and values is None:
            raise InputError(measurements.source, f"no measured {what}s", f"{what}s for model {model}")
        if wanted and weighted and sigma is None:
            raise InputError(measurements.source, f"no sigma for {what}", "the noise of every row, to weight by")
        if wanted:
            variance.append(np.ones((n, 3)) if sigma is None else sigma[train] ** 2)
    rotation = np.zeros((n, 3, 3)) if measurements.rotation is None else measurements.rotation[train]
    position = np.zeros((n, 3)) if measurements.position is None else measurements.position[train]
    height = 3 * sum(kinds)
    block = PoseBlock(trig, train, rotation, position, np.tile(np.eye(height), (n, 1, 1)), kinds)
    return _Rows(block, np.ones((n, height), dtype=np.bool_), np.concatenate(variance, axis=1))


def _without_kinks(rows: _Rows, chain: Chain, model: Model) -> _Rows:
    """The rows without those that have no derivative at the start."""
    if not isinstance(rows.block, PairBlock):
        return rows
    kinds = list(_KINDS[model])
    predicted = residuals.residual(rows.block, chain) + rows.block.measured[:, kinds]
    is_angle = np.array([False, True])[kinds]
    kink = (predicted < KINK) | (is_angle & (predicted > np.pi - KINK))
    return replace(rows, use=rows.use & ~kink)


def _with_frame(robot: Robot, world_T_base: Floats) -> Robot:
    """The robot behind a frame and a correction of it, whose six parameters come last."""
    n = len(robot.parameters)
    fixed = [Element(AXIS_OF_KIND[kind], float(v)) for kind, v in zip(FRAME_KINDS, world_T_base, strict=True)]
    free = [Element(AXIS_OF_KIND[kind], parameter=n + i) for i, kind in enumerate(FRAME_KINDS)]
    correction = (Parameter(f"frame.{kind}", kind, 0, 0.0) for kind in FRAME_KINDS)
    return replace(robot, parameters=(*robot.parameters, *correction), elements=(*fixed, *free, *robot.elements))


def _composed(start: Floats, correction: Floats) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame and its correction, one after the other."""
    turn, more = (Rotation.from_euler("ZYX", frame[3:]) for frame in (start, correction))
    R = (turn * more).as_matrix()
    level = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], level)
    if level < 1e-9:  # straight up or down: yaw and roll are one, take it all as roll
        yaw, roll = 0.0, np.arctan2(-R[1, 2], R[1, 1])
    else:
        yaw, roll = np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    return np.array([*(start[:3] + turn.apply(correction[:3])), yaw, pitch, roll])


def _start(robot: Robot, start: Floats | None) -> tuple[Floats, Floats]:
    """The robot's values and the measurement frame to start from."""
    n = len(robot.parameters)
    given = robot.nominal if start is None else np.asarray(start, dtype=np.float64)
    if given.shape not in ((n,), (n + 6,)) or not np.isfinite(given).all():
        found = f"shape {given.shape}" if given.shape not in ((n,), (n + 6,)) else "a value that is not finite"
        raise InputError("start", found, f"{n} values of the robot, or {n + 6} with the measurement frame's")
    return given[:n], given[n:] if len(given) > n else np.zeros(6)


def _chosen(robot: Robot, names: Sequence[str] | None) -> list[int]:
    """Indices of the parameters to estimate, in the robot's order."""
    if names is None:
        chosen = [i for i, p in enumerate(robot.parameters) if p.estimated]
    else:
        known = names_of(robot.parameters)
        check_names("names", names, known)
        chosen = [i for i, name in enumerate(known) if name in set(names)]
        if len(chosen) < len(names):
            twice = next(name for name in names if list(names).count(name) > 1)
            raise InputError("names", f"{twice!r} twice", "each parameter once")
    if not chosen:
        raise InputError("names", "nothing to estimate", "at least one parameter")
    return chosen
