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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.baseline.methods import Fit, Solver, claimed_covariance, gauss_newton, scipy_fit
from fg_calib.baseline.rows import Rows, evaluate, train_rows, whitening_of, without_kinks
from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Measurements
from fg_calib.options import (
    PAIR_MODELS,
    POSE_MODELS,
    FrameKnowledge,
    Model,
    Pairing,
    as_pairing,
    check,
    check_flag,
    check_names,
    check_number,
)
from fg_calib.robot.kinematics import Chain, build_chain
from fg_calib.robot.model import AXIS_OF_KIND, FRAME_KINDS, Element, Parameter, Robot, names_of
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

Method = Literal["gauss-newton", "scipy"]

REWEIGHTED = 1e-10
"""Weights are final once a fit with them moves the parameters by less than this, [m] and [rad]."""

_ROUNDS = 20
"""Fits with new weights at most."""


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


@checked
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
    check("model", model, Model)
    if model not in (*POSE_MODELS, *PAIR_MODELS):
        raise InputError("model", f"found {model!r}", f"one of {', '.join((*POSE_MODELS, *PAIR_MODELS))} here")
    check("method", method, Method)
    check("frame", frame, FrameKnowledge)
    check_flag("weighted", weighted)
    check_number("max_iterations", max_iterations, least=1, whole=True)
    check_number("tolerance", tolerance, finite=False)
    pairing = as_pairing(pairing)
    clock = time.perf_counter()
    unknown = frame == "unknown" and model not in PAIR_MODELS
    system = _system(robot, measurements, (model, pairing, weighted), names, start, unknown)
    solver = partial(gauss_newton if method == "gauss-newton" else scipy_fit, limit=max_iterations, tolerance=tolerance)
    fit, whitening = _solve(system, solver, weighted)
    return system.result(fit, whitening, weighted, clock)


@dataclass(frozen=True)
class _System:
    """Rows as a function of the unknowns.

    Attributes:
        robot: The nominal robot.
        chosen: Its parameters to estimate.
        frame: x, y, z, yaw, pitch, roll of the measurement frame at the start.
        rows: What is fitted.
        chain: The arm behind its measurement frame.
        start: Its parameters at the start, shape (n_parameters,), [m] and [rad].
        columns: Which of them are unknown.
        sigma_joint: Of the joint readings, shape (n_joints,), [rad] or [m].
    """

    robot: Robot
    chosen: list[int]
    frame: Floats
    rows: Rows
    chain: Chain
    start: Floats
    columns: NDArray[np.int64]
    sigma_joint: Floats

    def parameters(self, x: Floats) -> Floats:
        """All parameters at the unknowns x."""
        full = self.start.copy()
        full[self.columns] = x
        return full

    def evaluate(self, x: Floats, whitening: Floats | None) -> tuple[Floats, Floats]:
        """Residuals, shape (m,), and derivatives, shape (m, n_unknowns)."""
        return evaluate(self.rows, self.chain.at(self.parameters(x)), whitening)

    def whitening(self, x: Floats) -> Floats:
        """`whitening_of` the rows at the unknowns x."""
        return whitening_of(self.rows, self.chain.at(self.parameters(x)), self.sigma_joint)

    def result(self, fit: Fit, whitening: Floats | None, weighted: bool, clock: float) -> LeastSquares:
        """The estimate, begun at `clock`."""
        covariance, rank = claimed_covariance(*self.evaluate(fit.x, whitening), weighted)
        full, n, m = self.parameters(fit.x), len(self.robot.parameters), len(self.chosen)
        return LeastSquares(
            robot=self.robot.with_values(full[:n]),
            names=tuple(self.robot.parameters[i].name for i in self.chosen),
            frame=self.frame if len(self.columns) == m else _composed(self.frame, full[n:]),
            covariance=covariance[:m, :m],
            residuals=evaluate(self.rows, self.chain.at(full).without_columns(), None)[0],
            rank=rank,
            converged=fit.converged,
            message=fit.message,
            iterations=fit.iterations,
            steps=fit.steps,
            seconds=time.perf_counter() - clock,
        )


def _system(
    robot: Robot,
    measurements: Measurements,
    wanted: tuple[Model, Pairing, bool],
    names: Sequence[str] | None,
    start: Floats | None,
    frame_unknown: bool,
) -> _System:
    """What is fitted, from where."""
    n = len(robot.parameters)
    values, world_T_base = _start(robot, start)
    chosen = _chosen(robot, names)
    columns = np.array([*chosen, *(range(n, n + 6) if frame_unknown else ())], dtype=np.int64)
    # The chain starts in the measurement frame as the fit does; a correction of it is six more parameters.
    extended = _with_frame(robot.with_values(values), np.zeros(6) if wanted[0] in PAIR_MODELS else world_T_base)
    chain = build_chain(extended, {int(c): k for k, c in enumerate(columns)})
    rows = without_kinks(train_rows(robot, measurements, *wanted), chain.at(extended.nominal))
    if not rows.use.any():
        raise InputError(measurements.source, "no row left to fit", f"train rows for model {rows.model}")
    return _System(
        robot=robot,
        chosen=chosen,
        frame=world_T_base,
        rows=rows,
        chain=chain,
        start=extended.nominal,
        columns=columns,
        sigma_joint=measurements.sigma_joint,
    )


def _solve(system: _System, solver: Solver, weighted: bool) -> tuple[Fit, Floats | None]:
    """The fit, and the weights that it was made with: those at the estimate, if they matter."""
    x = system.start[system.columns]
    if not weighted:
        return solver(lambda x: system.evaluate(x, None), x), None
    fit = Fit(x, converged=False, message="", iterations=0, steps=())
    for _ in range(_ROUNDS):
        whitening = system.whitening(fit.x)
        again = solver(partial(system.evaluate, whitening=whitening), fit.x)
        moved = float(np.linalg.norm(again.x - fit.x))
        fit = replace(again, iterations=fit.iterations + again.iterations, steps=fit.steps + again.steps)
        if not fit.converged or moved <= REWEIGHTED or not np.any(system.sigma_joint > 0.0):
            return fit, whitening
    message = f"not converged: new weights still move it by {moved:.1e}"
    return replace(fit, converged=False, message=message), whitening


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
