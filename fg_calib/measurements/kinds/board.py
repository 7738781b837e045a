"""Boards in the room as a camera on the tool sees them: camera_T_board."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization import FrameStart
from fg_calib.inputs import Floats, Integers
from fg_calib.measurements import Frames, Kind, LandmarkKind, Landmarks, Measurements, Rows, Table
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument
from fg_calib.measurements.kinds.pose import ORIENTATION, POSE_COLUMNS, POSITION
from fg_calib.robot import cross_matrix, inverse_right_jacobian, left_jacobian

_BOARDS = "Boards (in the base frame: rotation vector in deg, position in mm)"
_UNITS = ("rad", "rad", "rad", "m", "m", "m")
BOARD: LandmarkKind = LandmarkKind("B", "board", _BOARDS, units=_UNITS, away=2.0, n_configurations=2)
BOARD_COLUMN: Column = Column(("board",), "", "Which board was seen, where there are several")

COVARIANCE = tuple(f"cov_{i}{j}" for i in range(1, 7) for j in range(i, 7))
"""Upper triangle of the covariance of a board's pose, row by row: about, then along the camera's x, y and z."""


def point_in_camera(at: Frames, boards: Floats, corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Points of boards in the camera's frame, shape (n, 3), with the derivatives in camera and board.

    With R, p the camera, B = Exp(v), b the board and c the point on it, `R^T (B c + b - p)` is where it is. A rotation
    w and a translation dp of the camera move it by `R^T ((B c + b - p) x w - dp)`, shape (n, 3, 6), the board's
    coordinates by `R^T (Jl(v) dv x B c + db)`, shape (n, 3, 6).

    Args:
        at: The camera.
        boards: v, [rad], and b, [m], in the frame that the chain starts in, shape (n, 6).
        corners: c, shape (n, 3), [m].
    """
    R_T, v = np.swapaxes(at.rotation[:, 0], 1, 2), boards[:, :3]
    corner = Rotation.from_rotvec(v).apply(corners)
    step = corner + boards[:, 3:] - at.position[:, 0]
    D = np.concatenate([R_T @ cross_matrix(step), -R_T], axis=2)
    N = np.concatenate([-R_T @ cross_matrix(corner) @ left_jacobian(v), R_T], axis=2)
    return np.einsum("nij,nj->ni", R_T, step), D, N


class BoardPose(Kind):
    """Camera_T_board, predicted minus measured, along and about the camera's axes, where its noise arises.

    With R, p the camera, B = Exp(v), b the board: `Log(R^T B M^T)`, [rad], and `R^T (b - p) - m`, [m]. A rotation w of
    the camera changes the first by `-Jl^-1 R^T w`, the board's coordinates by `Jl^-1 R^T Jl(v) dv`; for the second see
    `point_in_camera`.

    Data: M row by row, then m, 12 columns. Nuisances: v, [rad], and b, [m], in the frame that the chain starts in.
    """

    names = ("orientation.x", "orientation.y", "orientation.z", "position.x", "position.y", "position.z")
    units = ("rad", "rad", "rad", "m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 6, 12, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T, v = np.swapaxes(at.rotation[:, 0], 1, 2), nuisances[:, :3]
        M_T = np.swapaxes(data[:, :9].reshape(-1, 3, 3), 1, 2)
        r = Rotation.from_matrix(R_T @ Rotation.from_rotvec(v).as_matrix() @ M_T).as_rotvec()
        rotated = np.swapaxes(inverse_right_jacobian(r), 1, 2) @ R_T  # Jl^-1 is the transpose of Jr^-1
        D, N = np.zeros((len(r), 1, 6, 6)), np.zeros((len(r), 6, 6))
        place, D[:, 0, 3:], N[:, 3:] = point_in_camera(at, nuisances, np.zeros((len(r), 3)))
        D[:, 0, :3, :3], N[:, :3, :3] = -rotated, rotated @ left_jacobian(v)
        return Rows(np.concatenate([r, place - data[:, 9:]], axis=1), D, N)

    def predict(self, at: Frames, nuisances: Floats) -> Floats:
        """See `Kind.predict`."""
        R = np.swapaxes(at.rotation[:, 0], 1, 2) @ Rotation.from_rotvec(nuisances[:, :3]).as_matrix()
        return np.hstack([R.reshape(-1, 9), point_in_camera(at, nuisances, np.zeros((len(R), 3)))[0]])


def start_boards(start: FrameStart, rows: Integers, first: Integers, choices: tuple[Floats, Floats]) -> None:
    """Start boards and the camera from camera_T_board: seen from a board, the camera is a tool, and the base unknown.

    Args:
        start: Known coordinates so far; found ones are put there.
        rows: Configuration of each pose, shape (n,).
        first: First coordinate of each one's board, shape (n,).
        choices: Possible poses, the likeliest first: rotations, shape (n, k, 3, 3), positions, shape (n, k, 3), [m].
    """
    boards, count = np.unique(first, return_counts=True)
    for board in boards[np.argsort(-count, kind="stable")].tolist():
        chosen = first == board
        R_T = np.swapaxes(choices[0][chosen], 2, 3)
        seen = R_T, -np.einsum("nkij,nkj->nki", R_T, choices[1][chosen])
        X = start.align_choices(rows[chosen], seen, unknown_frame=True)
        place = [Rotation.from_matrix(X.rotation.T).as_rotvec(), -X.rotation.T @ X.translation]
        start.places[board : board + 6] = np.concatenate(place)


class BoardCamera(Instrument):
    """Poses of boards in the camera's frame, whose noise is along and about its axes."""

    model, words, kind = "board", "poses of boards", BoardPose()
    quantities = (ORIENTATION, POSITION)
    columns = (
        *POSE_COLUMNS,
        BOARD_COLUMN,
        Column(COVARIANCE, "", "Upper triangle of the covariance of a board's pose, orientation first"),
    )
    labels, landmarks, n_landmarks = ("board",), (BOARD,), 1
    noise = ("position", "orientation")
    sees_orientation = sees_landmarks = True

    def sigma(self, m: Measurements, rows: Integers) -> Floats:
        """See `Instrument.sigma`; that of covariances where they are there."""
        return super().sigma(m, rows) if m.covariance is None else np.sqrt(np.einsum("nii->ni", m.covariance[rows]))

    def more(self, table: Table, rows: Integers) -> dict[str, Any]:
        """See `Instrument.more`."""
        C = table.measurements.covariance
        return super().more(table, rows) | ({} if C is None else {"covariance": C[rows]})

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """See `start_boards`."""
        for block in blocks:
            if isinstance(block.kind, BoardPose):
                train = np.flatnonzero(~block.test)
                measured = block.data[train, None, :9].reshape(-1, 1, 3, 3), block.data[train, None, 9:]
                start_boards(start, block.ends[train, 0], block.nuisances[train, 0], measured)


INSTRUMENTS = (BoardCamera(),)
