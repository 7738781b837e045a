"""Tables of targets, and of what to command for them.

| table | columns |
|---|---|
| targets | `x y z`; `qx qy qz qw`, `roll pitch yaw` or `rx ry rz`; `q1 ... qn` or joint names; `id` |
| commands | `id`; joint values; the pose to command where a controller takes poses; what to expect |

Without an orientation any will do. Joint values are what to stay near; alone, they are a program whose poses, by the
nominal arm, are the targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.arrays import FrozenArrays
from fg_calib.errors import InputError
from fg_calib.io.columns import Table
from fg_calib.io.csv_writer import require_own_csv, write_csv
from fg_calib.io.poses import PoseColumns
from fg_calib.io.tables import find_joint_columns, header_for, joint_columns, read_ids, read_readings
from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Floats, Noise
from fg_calib.prediction.correction import Correction
from fg_calib.robot.model import Robot

_BEGINNING = b"id,reached,"
"""How a table of commands begins."""


@dataclass(frozen=True)
class Targets(FrozenArrays):
    """What the tool is to reach.

    Attributes:
        ids: The targets' names: their ids, or 0-based row numbers.
        position: Of the tool point, shape (n, 3), [m]; None where the table holds joint values alone.
        rotation: Of the tool, shape (n, 3, 3); None where the table states none.
        readings: Joint values to stay near, shape (n, n_joints), [rad] (prismatic: [m]); None where there are none.
    """

    ids: tuple[str, ...]
    position: Floats | None
    rotation: Floats | None
    readings: Floats | None


@checked
def read_targets(path: Path | str | Any, robot: Robot, units: Units | None = None) -> Targets:
    """Read a table of targets.

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    units = units or Units()
    header = header_for(path, robot, {})
    poses = PoseColumns.of(header)
    numbered = [f"q{i + 1}" for i in range(robot.n_joints)]
    named = header.present(*numbered, *(joint.name for joint in robot.joints))
    if not poses.position and (poses.orientation or not named):
        found = "orientations without x y z" if poses.orientation else "neither x y z nor joint columns"
        raise InputError(header.name, found, "x y z, or joint values alone", f"it has {', '.join(header.columns)}")
    joints = find_joint_columns(header, robot) if named else ()
    wanted = (*poses.position, *poses.orientation)
    table = Table.read(header, numbers=(*joints, *wanted), texts=header.present("id"))
    stated = poses.read(table, units, Noise())
    return Targets(
        ids=tuple(read_ids(table, repeated=False).to_list()),
        position=stated["position"],
        rotation=stated["rotation"],
        readings=read_readings(table, joints, robot, units) if joints else None,
    )


def require_commands(path: Path) -> None:
    """Check that a table of commands can be written: a CSV that is not there yet, or was written as one.

    Raises:
        InputError: It cannot.
    """
    require_own_csv(path, _BEGINNING)


def write_commands(path: Path, ids: tuple[str, ...], correction: Correction, robot: Robot, units: Units) -> None:
    """Write a table of commands, whole or not at all.

    Columns: `id`; `reached`: yes, or no; joint values by the joints' names (`q1 ... qn` where these mean something else
    in a table); `x y z qx qy qz qw`, the pose to command from the base; `uncorrected_position` and
    `uncorrected_orientation`, how far the nominal values miss; `missed_position` and `missed_orientation`, what is left
    where a target is out of reach; `expected_position` and `expected_orientation`, the RMS error to expect. Figures are
    in the units given; an empty cell is unknown.

    Args:
        path: The CSV; one that was written as such is replaced.
        ids: The targets' names.
        correction: What to command.
        robot: Whose joints they are of.
        units: Of the figures.

    Raises:
        InputError: It cannot be written, or is another file.
    """
    length, angle = units.factor("m"), units.factor("rad")
    quaternion = Rotation.from_matrix(correction.rotation.copy()).as_quat(canonical=True)
    readings = correction.readings / [units.factor(joint.unit) for joint in robot.joints]
    columns: dict[str, Any] = {
        "id": np.array(ids, dtype=np.str_),
        "reached": np.where(correction.reached, "yes", "no"),
        **dict(zip(joint_columns(robot), readings.T, strict=True)),
        **dict(zip("xyz", correction.position.T / length, strict=True)),
        **{f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")},
    }
    for name in ("uncorrected", "missed", "expected"):
        errors = getattr(correction, name)
        columns[f"{name}_position"] = errors[:, 0] / length
        if correction.turns or name == "expected":
            columns[f"{name}_orientation"] = errors[:, 1] / angle
    require_commands(path)
    write_csv(path, columns)
