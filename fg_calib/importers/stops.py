"""The table of stops in a recording: configurations with measured poses, which a job uses as it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.importers.standstill import Stops
from fg_calib.io.csv_writer import require_own_csv, write_csv
from fg_calib.io.tables import joint_columns
from fg_calib.robot.model import Robot

_BEGINNING = b"id,begin,seconds,samples,"
"""How such a table begins."""


def require_replaceable(path: Path) -> None:
    """Check that a table of stops can be written: a CSV that is not there yet, or was written as one.

    Raises:
        InputError: It cannot.
    """
    require_own_csv(path, _BEGINNING)


@checked
def write_stops(path: Path | str, stops: Stops, robot: Robot) -> None:
    """Write the table of configurations and poses, in m and rad, whole or not at all.

    Columns: `id`; `begin` and `seconds` of what was averaged, from the first joint reading on, and `samples`, which
    nothing reads; the joints' names (`q1 ... qn` where these mean something else in a table); `x y z`; `qx qy qz qw`
    where orientations were measured; `sigma_x ...` and `sigma_rx ...`.

    Args:
        path: The CSV; one that was written as such is replaced.
        stops: The stops.
        robot: Whose joints they are of.

    Raises:
        InputError: It cannot be written, or is another file.
    """
    path = Path(path)
    require_replaceable(path)
    columns: dict[str, Any] = {
        "id": np.array(stops.ids),
        "begin": np.round(stops.interval[:, 0], 3),
        "seconds": np.round(np.diff(stops.interval, axis=1)[:, 0], 3),
        "samples": stops.samples.astype(np.int64),
        **dict(zip(joint_columns(robot), stops.readings.T, strict=True)),
        **dict(zip("xyz", stops.position.T, strict=True)),
    }
    if stops.rotation is not None:
        quaternion = Rotation.from_matrix(stops.rotation.copy()).as_quat(canonical=True)
        columns |= {f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")}
    columns |= {f"sigma_{axis}": stops.sigma_position[:, k] for k, axis in enumerate("xyz")}
    if stops.sigma_orientation is not None:
        columns |= {f"sigma_r{axis}": stops.sigma_orientation[:, k] for k, axis in enumerate("xyz")}
    write_csv(path, columns)
