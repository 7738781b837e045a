"""The rows that plain least squares fits: every measured train row of a model, plain or whitened."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, form_pairs
from fg_calib.measurements.kinds import Distance, Orientation, Position, RotationAngle, stack
from fg_calib.measurements.residuals import Block, unit_whitening
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model, Pairing
from fg_calib.robot.kinematics import Chain, precompute_trig
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

KINK = 1e-12
"""A predicted distance below this, or an angle this near to 0 or pi, is exactly there but for rounding, [m], [rad]."""


@dataclass(frozen=True)
class Rows:
    """The train measurements, with unit weights.

    Attributes:
        model: Which measurements take part.
        block: The measurements.
        use: Which of their scalars take part, shape (n, residual_dim).
        variance: Of the measurement noise, shape (n, residual_dim), [m^2] and [rad^2]; any number where not used.
    """

    model: Model
    block: Block
    use: Booleans
    variance: Floats


def train_rows(robot: Robot, measurements: Measurements, model: Model, pairing: Pairing, weighted: bool) -> Rows:
    """Every measured train row of a model."""
    trig = precompute_trig(robot, measurements.readings)
    if model in PAIR_MODELS:
        return _pair_rows(trig, measurements, model, pairing, weighted)
    return _pose_rows(trig, measurements, model, weighted)


def _pair_rows(trig: Floats, measurements: Measurements, model: Model, pairing: Pairing, weighted: bool) -> Rows:
    kinds = np.array(PAIR_MODELS[model])
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
    ends, unit = np.stack([pairs.a, pairs.b], axis=1), unit_whitening(pairs.n_pairs, int(kinds.sum()))
    kind_of_pairs = stack(*compress((Distance(), RotationAngle()), kinds))
    block = Block(kind_of_pairs, trig, ends, np.nan_to_num(measured[:, kinds]), unit)
    return Rows(model, block, use, np.nan_to_num(sigma[:, kinds], nan=1.0) ** 2)


def _pose_rows(trig: Floats, measurements: Measurements, model: Model, weighted: bool) -> Rows:
    kinds = POSE_MODELS[model]
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
    kind = stack(*compress((Orientation(), Position()), kinds))
    wanted_values = [values for values, _, _ in compress(given, kinds) if values is not None]
    data = [values[train].reshape(n, int(np.prod(values.shape[1:]))) for values in wanted_values]
    block = Block(kind, trig, train[:, None], np.concatenate(data, axis=1), unit_whitening(n, kind.residual_dim))
    return Rows(model, block, np.ones((n, kind.residual_dim), dtype=np.bool_), np.concatenate(variance, axis=1))


def without_kinks(rows: Rows, chain: Chain) -> Rows:
    """The rows without those that have no derivative at the start."""
    if rows.block.kind.ends != 2:
        return rows
    kinds = list(PAIR_MODELS[rows.model])
    predicted = residuals.residual(rows.block, chain) + rows.block.data
    is_angle = np.array([False, True])[kinds]
    kink = (predicted < KINK) | (is_angle & (predicted > np.pi - KINK))
    return replace(rows, use=rows.use & ~kink)


def evaluate(rows: Rows, chain: Chain, whitening: Floats | None) -> tuple[Floats, Floats]:
    """Residuals, shape (m,), and derivatives, shape (m, n_columns), of the rows in use."""
    r, J = residuals.linearise(rows.block, chain)
    if whitening is not None:
        r, J = (whitening @ np.where(rows.use, r, 0.0)[:, :, None])[:, :, 0], whitening @ (J * rows.use[:, :, None])
    return r[rows.use], J[rows.use]


def whitening_of(rows: Rows, chain: Chain, sigma_joint: Floats) -> Floats:
    """W with W S W^T = 1 of each measurement, lower triangular, shape (n, residual_dim, residual_dim).

    S has the variances of the measurement and what the readings' noise adds to first order; a scalar that takes no part
    has unit variance and no correlation with the others.
    """
    S = rows.variance[:, :, None] * np.eye(rows.block.residual_dim)
    if np.any(sigma_joint > 0.0):
        J = residuals.linearise(rows.block, chain.without_columns().with_joint_columns())[1]
        J = J * np.tile(sigma_joint, rows.block.kind.ends)  # (n, residual_dim, n_own)
        S = S + J @ np.swapaxes(J, 1, 2)
    S = np.where(rows.use[:, :, None] & rows.use[:, None, :], S, np.eye(rows.block.residual_dim))
    try:
        W: Floats = np.tril(np.linalg.inv(np.linalg.cholesky(S)))
    except np.linalg.LinAlgError:
        raise InputError("noise", "a row without any", "noise in every row, to weight by") from None
    return W
