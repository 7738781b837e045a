"""A board in the room as a camera on the tool sees it, as poses or corner by corner; or one on the tool."""

from __future__ import annotations

import numpy as np

from fg_calib.errors import ProblemError
from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.measurements.kinds import BoardPose, Pixel, RoomPixel
from fg_calib.measurements.models.common import Floats, Integers, labels_of, needed, stated
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.robot.model import Robot

UNITS = ("rad", "rad", "rad", "m", "m", "m")


def board_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Poses of boards in the camera's frame, whose noise is along and about its axes.

    Raises:
        ProblemError: A column or a sigma is missing.
    """
    m = table.measurements
    R = needed(table, m.rotation, "qx, qy, qz, qw, or roll, pitch, yaw, or rx, ry, rz", "measured orientations")
    p = needed(table, m.position, "x, y, z", "measured positions")
    index, place = _boards(table, unknowns)
    rows = np.arange(m.n_configurations)
    if m.covariance is None:
        sigmas = (
            stated(table, m.sigma_orientation, "orientation", rows),
            stated(table, m.sigma_position, "position", rows),
        )
        sigma = np.hstack(sigmas)
    else:
        sigma = np.sqrt(np.einsum("nii->ni", m.covariance))
    return [
        Series(
            kind=BoardPose(),
            table=number,
            ends=rows[:, None],
            data=np.hstack([R.reshape(-1, 9), p]),
            sigma=sigma,
            measured=np.ones((len(rows), 6), dtype=np.bool_),
            test=m.test,
            number=rows,
            nuisances=place[index],
            covariance=m.covariance,
            source=m.source,
            of=m.labels.get("board"),
        )
    ]


def pixel_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Images of the boards' points.

    Raises:
        ProblemError: A column, a sigma or the camera is missing.
    """
    m = table.measurements
    image = needed(table, m.image, "u, v, corner_x, corner_y", "images of a board's points")
    if table.camera is None:
        raise ProblemError(m.source, "no camera", f"the key camera for model {table.model}")
    rows = np.arange(m.n_configurations)
    kind: Pixel | RoomPixel = RoomPixel(table.camera) if table.fixed_camera else Pixel(table.camera)
    nuisances = np.zeros((len(rows), 0), dtype=np.int64)
    if kind.n_nuisances:
        index, place = _boards(table, unknowns)
        nuisances = place[index]
    return [
        Series(
            kind=kind,
            table=number,
            ends=rows[:, None],
            data=np.ascontiguousarray(image),
            sigma=stated(table, m.sigma_pixel, "pixel", rows),
            measured=np.ones((len(rows), 2), dtype=np.bool_),
            test=m.test,
            number=rows,
            nuisances=nuisances,
            source=m.source,
            of=_corners(m, image),
        )
    ]


def _corners(m: Measurements, image: Floats) -> Labels:
    """The point of a board that each row is of, with the board's name where a column says it."""
    board = m.labels.get("board")
    which = np.zeros(len(image)) if board is None else board.index
    places = np.column_stack([which, image[:, 2:] * 1e3]) + 0.0  # no -0
    different, index = np.unique(places, axis=0, return_inverse=True)
    of_board = [""] if board is None else [*(f"{name} " for name in board.names), ""]
    names = tuple(f"{of_board[int(k)]}corner {x:.6g} {y:.6g} mm" for k, x, y in different.tolist())
    return Labels(names, index.ravel())


def _boards(table: Table, unknowns: Unknowns) -> tuple[Integers, Integers]:
    """Which board each row is of, the only one where no column says, and the places of the boards' coordinates."""
    m = table.measurements
    names: tuple[str, ...] = ("board",)
    index = np.zeros(m.n_configurations, dtype=np.int64)
    if "board" in m.labels:
        labels = labels_of(table, "board")
        names, index = labels.names, labels.index
    return index, unknowns.add("B", names, np.full((len(names), 6), np.nan), m.source, units=UNITS)
