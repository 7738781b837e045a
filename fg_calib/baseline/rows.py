"""The rows that plain least squares fits: every measured train row, plain or whitened, each measurement by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.measurements import residuals
from fg_calib.measurements.gathering import Dataset
from fg_calib.measurements.kinds import Distance, RotationAngle, parts_of
from fg_calib.measurements.models.pairs import usable_pairs
from fg_calib.measurements.residuals import Block, unit_whitening
from fg_calib.measurements.series import Series
from fg_calib.robot.kinematics import Chain
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

KINK = 1e-12
"""A predicted distance below this, or an angle this near to 0 or pi, is exactly there but for rounding, [m], [rad]."""


@dataclass(frozen=True)
class Rows:
    """The train measurements of one kind from one table, with unit weights.

    Attributes:
        table: Number of their table.
        block: The measurements; its nuisances are no values yet.
        nuisances: Coordinates that each depends on, among those of the dataset, shape (n, kind.n_nuisances).
        use: Which of their scalars take part, shape (n, residual_dim).
        covariance: Of each one's own noise, shape (n, residual_dim, residual_dim), in the rows' units squared; any
            number where not used.
    """

    table: int
    block: Block
    nuisances: Integers
    use: Booleans
    covariance: Floats

    def at(self, coordinates: Floats) -> Block:
        """The measurements with the values of what they depend on."""
        return replace(self.block, nuisances=coordinates[self.nuisances])


def train_rows(robot: Robot, data: Dataset) -> tuple[Rows, ...]:
    """Every measured train row of all tables."""
    trigs = [robot.trig(table.measurements.readings) for table in data.tables]
    return tuple(_rows_of(data, s, trigs[s.table]) for s in data.series if len(s.train))


def _rows_of(data: Dataset, s: Series, trig: Floats) -> Rows:
    train, h = s.train, s.kind.residual_dim
    unit = unit_whitening(len(train), h)
    block = Block(s.kind, trig, s.ends[train], s.data[train], unit, np.zeros(s.nuisances[train].shape), s.source)
    covariance = s.sigma[train][:, :, None] ** 2 * np.eye(h)
    if s.formed:
        covariance = _formed_sigma(data, s)[train][:, :, None] ** 2 * np.eye(h)
    elif s.covariance is not None:
        covariance = s.covariance[train]
    return Rows(s.table, block, s.nuisances[train], s.used[train], covariance)


def _formed_sigma(data: Dataset, s: Series) -> Floats:
    """1 sigma of distances and angles formed from measured poses, each as if it were alone, shape (n, residual_dim)."""
    pairs = usable_pairs(data.tables[s.table])
    by_kind = {Distance: pairs.sigma_distance, RotationAngle: pairs.sigma_angle}
    return np.stack([np.nan_to_num(by_kind[type(part)][s.number], nan=1.0) for part in parts_of(s.kind)], axis=1)


def without_kinks(rows: Rows, chain: Chain) -> Rows:
    """The rows without distances and angles of pairs that have no derivative at the start."""
    parts = parts_of(rows.block.kind)
    if not all(isinstance(part, Distance | RotationAngle) for part in parts):
        return rows
    predicted = residuals.residual(rows.block, chain) + rows.block.data
    is_angle = np.array([isinstance(part, RotationAngle) for part in parts])
    kink = (predicted < KINK) | (is_angle & (predicted > np.pi - KINK))
    return replace(rows, use=rows.use & ~kink)


def evaluate(
    rows: Rows, chain: Chain, coordinates: Floats, whitening: Floats | None
) -> tuple[Floats, Floats, Integers]:
    """Residuals, shape (m,), their derivatives, shape (m, n_columns + kind.n_nuisances), and which measurement each is.

    The derivatives are those in the chain's columns, then in the measurement's own coordinates.
    """
    r, J = residuals.linearise(rows.at(coordinates), chain)
    if whitening is not None:
        r, J = (whitening @ np.where(rows.use, r, 0.0)[:, :, None])[:, :, 0], whitening @ (J * rows.use[:, :, None])
    return r[rows.use], J[rows.use], np.nonzero(rows.use)[0]


def whitening_of(rows: Rows, chain: Chain, coordinates: Floats, sigma_joint: Floats) -> Floats:
    """W with W S W^T = 1 of each measurement, lower triangular, shape (n, residual_dim, residual_dim).

    S has the covariance of the measurement and what the readings' noise adds to first order; a scalar that takes no
    part has unit variance and no correlation with the others.
    """
    S, ends = rows.covariance, rows.block.kind.ends
    if ends and np.any(sigma_joint > 0.0):
        J = residuals.linearise(rows.at(coordinates), chain.without_columns().with_joint_columns())[1]
        J = J[:, :, : ends * len(sigma_joint)] * np.tile(sigma_joint, ends)  # (n, residual_dim, ends * n_joints)
        S = S + J @ np.swapaxes(J, 1, 2)
    S = np.where(rows.use[:, :, None] & rows.use[:, None, :], S, np.eye(rows.block.residual_dim))
    try:
        W: Floats = np.tril(np.linalg.inv(np.linalg.cholesky(S)))
    except np.linalg.LinAlgError:
        raise InputError("noise", "a row without any", "noise in every row, to weight by") from None
    return W


def said_places(data: Dataset) -> Iterator[tuple[Integers, Floats, float]]:
    """Coordinates of each estimated place that is said to be somewhere, its place there and 1 sigma of that."""
    unknowns = data.unknowns
    first = np.cumsum([0, *unknowns.sizes])
    for i in np.flatnonzero(data.estimated()).tolist():
        tolerance = unknowns.tolerances[i]
        if tolerance is not None:
            yield np.arange(first[i], first[i + 1]), unknowns.starts[i], tolerance
