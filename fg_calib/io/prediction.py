"""The table of configurations that `fg-calib predict` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fg_calib.arguments import checked
from fg_calib.io.columns import Table
from fg_calib.io.tables import find_joint_columns, header_for, read_ids, read_readings
from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Floats
from fg_calib.robot.model import Robot


@checked
def read_joint_table(
    path: Path | str | Any, robot: Robot, units: Units | None = None
) -> tuple[tuple[str, ...], Floats]:
    """Names of configurations, and their joint positions, shape (n, n_joints), [rad] (prismatic: [m]).

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    header = header_for(path, robot, {})
    joints = find_joint_columns(header, robot)
    table = Table.read(header, numbers=joints, texts=header.present("id"))
    return tuple(read_ids(table, repeated=True).to_list()), read_readings(table, joints, robot, units or Units())
