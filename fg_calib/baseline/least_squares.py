r"""Plain least squares, the paper's own estimator: the baseline that the factor graph is compared with.

Jia et al. (2019), Eq. (54) and (55), as printed:

    dPsi_i = Psi* - f(Omega_i, Theta)               measured minus predicted, metres and radians side by side
    dOmega_{i+1} = J(Omega_i, Theta)^+ dPsi_i       the Moore-Penrose inverse: a minimum-norm step
    Omega_{i+1} = Omega_i + dOmega_{i+1}            until dOmega is small

Beside it the same with rows whitened by their noise, and `scipy.optimize.least_squares` on the same rows. Nothing here
knows of GTSAM, priors, damping or observability: of the graph's mathematics only `residuals` is shared.

A measurement frame that is unknown takes six more unknowns: world_T_base = start * Txyz Rz(yaw) Ry(pitch) Rx(roll), a
correction of the frame that the fit starts from. It starts at zero, so that its angles stay away from where they are
singular. Targets, anchors, planes, boards and touched points whose places are not known are unknowns as well; one that
is nearly known is a measurement of its place.

Note:
    Every measured train row takes part. Only a row that has no derivative at the start (a distance of exactly 0, an
    angle of exactly 0 or pi) is left out: the paper mentions these kinks and judges no further, and near one a row
    misleads. Every measurement counts as independent, pairs formed from poses and the rows of one configuration, which
    share its joint noise, among them. All rows and derivatives are held at once.

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

from fg_calib.arguments import checked
from fg_calib.arrays import Brief
from fg_calib.baseline.methods import claimed_covariance, gauss_newton, scipy_fit
from fg_calib.baseline.system import build_system, start_at
from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.measurements.gathering import Dataset, gather
from fg_calib.measurements.series import Table
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
from fg_calib.robot.model import Robot, names_of
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

Method = Literal["gauss-newton", "scipy"]


@dataclass(frozen=True)
class LeastSquares(Brief):
    """What plain least squares found.

    Attributes:
        robot: The robot with the estimated values.
        names: The parameters that were estimated, in the order of the covariance.
        frames: x, y, z, yaw, pitch, roll of each unknown measurement frame world_T_base, shape (n_frames, 6), [m] and
            [rad].
        places: Coordinates of the estimated targets, anchors, planes, boards and points, shape (n_coordinates,).
        covariance: Of the estimated parameters as least squares claims it, shape (n_names, n_names), [m] and [rad]:
            (J^T W J)^-1 if weighted by noise, else s^2 (J^T J)^-1 with s^2 = |r|^2 / (n_rows - rank). nan in rows and
            columns of parameters that J leaves open, and everywhere where s^2 has no degree of freedom.
        residuals: Predicted minus measured of the rows that took part, not weighted, shape (n_rows,), [m], [rad] and
            pixels.
        rank: Of J at the estimate, the columns of frames and places included.
        converged: Whether the last step was small enough.
        message: Why it stopped.
        iterations: Steps taken (scipy: derivatives asked for).
        steps: Length of each Gauss-Newton step, metres and radians side by side; empty for scipy.
        seconds: Time taken.
    """

    robot: Robot
    names: tuple[str, ...]
    frames: Floats
    places: Floats
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
    def frame(self) -> Floats:
        """The first of `frames`, zero where none was estimated, shape (6,), [m] and [rad]."""
        return self.frames[0] if len(self.frames) else np.zeros(6)

    @property
    def parameters(self) -> Floats:
        """The robot's values, `frames` (six values where there is none), and `places`: as `Problem.start` has them."""
        frames = self.frames if len(self.frames) else np.zeros(6)
        return np.concatenate([self.robot.nominal, frames.ravel(), self.places])


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
    known: FrameKnowledge = "known" if model in PAIR_MODELS else frame
    table = Table(measurements if weighted else _with_any_noise(measurements), model, as_pairing(pairing), known)
    return fit_dataset(
        robot,
        gather(robot, [table]),
        names=names,
        start=start,
        weighted=weighted,
        method=method,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )


def fit_dataset(
    robot: Robot,
    data: Dataset,
    *,
    names: Sequence[str] | None,
    start: Floats | None,
    weighted: bool = False,
    method: Method = "gauss-newton",
    max_iterations: int = 50,
    tolerance: float = 1e-12,
) -> LeastSquares:
    """`fit_least_squares` of all tables of a calibration, with the places that they depend on; arguments as there.

    Raises:
        InputError: There is no row to fit, nothing to estimate or no start of that length.
    """
    clock = time.perf_counter()
    system = build_system(robot, data, _chosen(robot, names), start_at(robot, data, start))
    solver = partial(gauss_newton if method == "gauss-newton" else scipy_fit, limit=max_iterations, tolerance=tolerance)
    fit, weights = system.solve(solver, weighted)
    covariance, rank = claimed_covariance(*system.evaluate(fit.x, weights), weighted)
    m, n_core = len(system.chosen), system.n_core
    values = system.start.values.copy()
    values[system.chosen] = fit.x[:m]
    return LeastSquares(
        robot=robot.with_values(values),
        names=tuple(robot.parameters[i].name for i in system.chosen),
        frames=system.frames(fit.x),
        places=fit.x[n_core:],
        covariance=covariance[:m, :m],
        residuals=system.evaluate(fit.x, None)[0],
        rank=rank,
        converged=fit.converged,
        message=fit.message,
        iterations=fit.iterations,
        steps=fit.steps,
        seconds=time.perf_counter() - clock,
    )


def _with_any_noise(m: Measurements) -> Measurements:
    """Measurements with a sigma of 1 m or 1 rad where none is stated, for fits that weigh nothing."""

    def of_poses(sigma: Floats | None, values: Floats | None) -> Floats | None:
        return np.ones((len(values), 3)) if sigma is None and values is not None else sigma

    def of_pairs(pairs: Pairs) -> Pairs:
        figures = {name: np.nan_to_num(getattr(pairs, name), nan=1.0) for name in ("sigma_distance", "sigma_angle")}
        return replace(pairs, **figures)

    return replace(
        m,
        sigma_position=of_poses(m.sigma_position, m.position),
        sigma_orientation=of_poses(m.sigma_orientation, m.rotation),
        pairs=None if m.pairs is None else of_pairs(m.pairs),
    )


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
