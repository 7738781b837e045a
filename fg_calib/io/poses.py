"""Columns of measured poses, positions and orientations in a table of configurations, and of their sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fg_calib.arrays import NORM_TOLERANCE
from fg_calib.errors import InputError
from fg_calib.io.columns import Header, Table
from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Floats, Noise

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ROLL_PITCH_YAW = ("roll", "pitch", "yaw")
_ROTATION_VECTOR = ("rx", "ry", "rz")
_SIGMA_POSITION = ("sigma_x", "sigma_y", "sigma_z")
_SIGMA_ORIENTATION = ("sigma_rx", "sigma_ry", "sigma_rz")

OF_POSES = (*_POSITION, *_QUATERNION, *_ROLL_PITCH_YAW, *_SIGMA_POSITION, *_SIGMA_ORIENTATION)
"""Columns that mean something of a pose wherever they are; `rx ry rz` only do so together."""


@dataclass(frozen=True)
class PoseColumns:
    """Which columns a table has of measured poses; none of what it does not hold.

    Attributes:
        position: Those of positions.
        orientation: Those of orientations: quaternions, roll, pitch and yaw, or rotation vectors.
        sigma_position: Those of the positions' sigmas.
        sigma_orientation: Those of the orientations'.
    """

    position: tuple[str, ...]
    orientation: tuple[str, ...]
    sigma_position: tuple[str, ...]
    sigma_orientation: tuple[str, ...]

    @classmethod
    def of(cls, header: Header) -> PoseColumns:
        """Those that are there.

        Raises:
            InputError: Some of those that belong together are missing, or there are two orientations.
        """
        return cls(
            position=header.group(_POSITION),
            orientation=_orientation_columns(header),
            sigma_position=header.sigmas("sigma_position", _SIGMA_POSITION),
            sigma_orientation=header.sigmas("sigma_orientation", _SIGMA_ORIENTATION),
        )

    @property
    def numbers(self) -> tuple[str, ...]:
        """Columns of numbers: all of them."""
        return (*self.position, *self.orientation, *self.sigma_position, *self.sigma_orientation)

    def read(self, table: Table, units: Units, noise: Noise) -> dict[str, Any]:
        """What `Measurements` has of them, by the names of its fields.

        Raises:
            InputError: A cell cannot be used.
        """
        length, angle, turned = units.factor("m"), units.factor("rad"), self.orientation
        return {
            "position": table.numbers(self.position) * length if self.position else None,
            "rotation": _rotation(table, turned, angle) if turned else None,
            "sigma_position": _sigma(table, self.sigma_position, noise.position, length),
            "sigma_orientation": _sigma(table, self.sigma_orientation, noise.orientation, angle),
            "roll_pitch_yaw": table.numbers(turned) * angle if turned == _ROLL_PITCH_YAW else None,
        }


def _orientation_columns(header: Header) -> tuple[str, ...]:
    """The columns of a measured orientation, if there is one."""
    quaternion, roll_pitch_yaw = header.group(_QUATERNION), header.group(_ROLL_PITCH_YAW)
    if quaternion and roll_pitch_yaw:
        raise InputError(header.name, "both qx qy qz qw and roll pitch yaw", "one of the two")
    rotation_vector = header.present(*_ROTATION_VECTOR) == _ROTATION_VECTOR
    return quaternion or roll_pitch_yaw or (_ROTATION_VECTOR if rotation_vector else ())


def _rotation(table: Table, columns: tuple[str, ...], angle: float) -> Floats:
    """Measured orientations as rotation matrices, shape (n_rows, 3, 3)."""
    from scipy.spatial.transform import Rotation

    values = table.numbers(columns)
    if columns == _ROLL_PITCH_YAW:
        return Rotation.from_euler("xyz", values * angle).as_matrix()  # about fixed axes: Rz(yaw) Ry(pitch) Rx(roll)
    if columns == _ROTATION_VECTOR:
        return Rotation.from_rotvec(values * angle).as_matrix()
    norm = np.linalg.norm(values, axis=1)
    good = np.abs(norm - 1.0) <= NORM_TOLERANCE
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(table.place(row), f"quaternion of norm {norm[row]:.6g}", f"1 within {NORM_TOLERANCE:g}")
    return Rotation.from_quat(values).as_matrix()


def _sigma(table: Table, columns: Sequence[str], default: float | None, factor: float) -> Floats | None:
    """Sigmas along three axes, shape (n_rows, 3); None where neither table nor default states them."""
    if not columns:
        return None if default is None else np.full((table.n_rows, 3), default)
    return np.broadcast_to(table.positive(columns, default, factor), (table.n_rows, 3)).copy()
