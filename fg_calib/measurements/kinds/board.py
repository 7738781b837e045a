"""Boards in the room as a camera on the tool sees them: camera_T_board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization import FrameStart
from fg_calib.inputs import Floats, Integers
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.kind import Frames, Kind, Rows
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Places, places_of_rows
from fg_calib.measurements.kinds.pose import POSE_COLUMNS
from fg_calib.measurements.landmarks import LandmarkKind, Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table
from fg_calib.robot import Poses, cross_matrix, inverse_right_jacobian, left_jacobian

BOARD = LandmarkKind(
    "B",
    "board",
    "the unknown boards",
    "Boards (in the base frame: rotation vector in deg, position in mm)",
    units=("rad", "rad", "rad", "m", "m", "m"),
    n_configurations=2,
)
BOARD_COLUMN = Column(("board",), "", "Which board was seen, where there are several")

COVARIANCE = tuple(f"cov_{i}{j}" for i in range(1, 7) for j in range(i, 7))
"""Upper triangle of the covariance of a board's pose, row by row: about, then along the camera's x, y and z."""


class BoardPose(Kind):
    """Camera_T_board, predicted minus measured, along and about the camera's axes, where its noise arises.

    With R, p the camera, B = Exp(v), b the board: `Log(R^T B M^T)`, [rad], and `R^T (b - p) - m`, [m]. A rotation w and
    a translation dp of the camera change the first by `-Jl^-1 R^T w`, the second by `R^T ((b - p) x w - dp)`; the
    board's coordinates by `Jl^-1 R^T Jl(v) dv` and `R^T db`.

    Data: M row by row, then m, 12 columns. Nuisances: v, [rad], and b, [m], in the frame that the chain starts in.
    """

    names = ("orientation.x", "orientation.y", "orientation.z", "position.x", "position.y", "position.z")
    units = ("rad", "rad", "rad", "m", "m", "m")
    ends, residual_dim, width, n_nuisances = 1, 6, 12, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T, v = np.swapaxes(at.rotation[:, 0], 1, 2), nuisances[:, :3]
        B, step = Rotation.from_rotvec(v).as_matrix(), nuisances[:, 3:] - at.position[:, 0]
        M = data[:, :9].reshape(-1, 3, 3)
        r = Rotation.from_matrix(R_T @ B @ np.swapaxes(M, 1, 2)).as_rotvec()
        shift = np.einsum("nij,nj->ni", R_T, step) - data[:, 9:12]
        turned = np.swapaxes(inverse_right_jacobian(r), 1, 2) @ R_T  # Jl^-1 is the transpose of Jr^-1
        D = np.zeros((len(r), 1, 6, 6))
        D[:, 0, :3, :3] = -turned
        D[:, 0, 3:, :3], D[:, 0, 3:, 3:] = R_T @ cross_matrix(step), -R_T
        N = np.zeros((len(r), 6, 6))
        N[:, :3, :3], N[:, 3:, 3:] = turned @ left_jacobian(v), R_T
        return Rows(np.concatenate([r, shift], axis=1), D, N)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """`Exp(n) R^T B` and `R^T (b - p) + n`. See `Kind.simulate`."""
        R_T = np.swapaxes(at.rotation[:, 0], 1, 2)
        error, board = (Rotation.from_rotvec(v[:, :3]).as_matrix() for v in (noise, nuisances))
        shift = np.einsum("nij,nj->ni", R_T, nuisances[:, 3:] - at.position[:, 0]) + noise[:, 3:]
        return np.hstack([(error @ R_T @ board).reshape(-1, 9), shift])


def board_coordinates(table: Table, landmarks: Landmarks) -> tuple[Integers, Integers]:
    """Which board each row is of, the only one where no column says, and the boards' coordinates, shape (n, 6)."""
    m = table.measurements
    names: tuple[str, ...] = (BOARD.name,)
    index = np.zeros(m.n_configurations, dtype=np.int64)
    if "board" in m.labels:
        names, index = m.labels["board"].names, m.labels["board"].index
    return index, landmarks.add(BOARD, names, np.full((len(names), 6), np.nan), m.source)


def start_boards(start: FrameStart, rows: Integers, first: Integers, choices: tuple[Floats, Floats]) -> None:
    """Start boards and the camera from camera_T_board: seen from a board, the camera is a tool, and the base unknown.

    Args:
        start: What is known so far; what is found is put there.
        rows: Configuration of each pose, shape (n,).
        first: First coordinate of each one's board, shape (n,).
        choices: What each may be, the likeliest first: rotations, shape (n, k, 3, 3), positions, shape (n, k, 3), [m].
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

    model, words = "board", "poses of boards"
    columns: ClassVar[tuple[Column, ...]] = (
        *POSE_COLUMNS,
        BOARD_COLUMN,
        Column(COVARIANCE, "", "Upper triangle of the covariance of a board's pose, orientation first"),
    )
    labels = ("board",)
    noise: tuple[str, ...] = ("position", "orientation")
    landmarks = (BOARD,)
    sees_orientation = True
    sees_landmarks = True
    n_landmarks = 1

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """See `Instrument.blocks`."""
        m = table.measurements
        angles = "qx, qy, qz, qw, or roll, pitch, yaw, or rx, ry, rz"
        R = self.require(table, m.rotation, angles, "measured orientations")
        p = self.require(table, m.position, "x, y, z", "measured positions")
        index, place = board_coordinates(table, landmarks)
        rows = np.arange(m.n_configurations)
        if m.covariance is None:
            turned = self.require_sigma(table, m.sigma_orientation, "orientation", rows)
            sigma = np.hstack([turned, self.require_sigma(table, m.sigma_position, "position", rows)])
        else:
            sigma = np.sqrt(np.einsum("nii->ni", m.covariance))
        return [
            MeasurementBlock.of_rows(
                BoardPose(),
                table,
                number,
                rows,
                np.hstack([R.reshape(-1, 9), p]),
                sigma,
                nuisances=place[index],
                covariance=m.covariance,
                of=m.labels.get("board"),
            )
        ]

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """See `start_boards`."""
        for block in blocks:
            if isinstance(block.kind, BoardPose):
                train = np.flatnonzero(~block.test)
                measured = block.data[train, None, :9].reshape(-1, 1, 3, 3), block.data[train, None, 9:]
                start_boards(start, block.ends[train, 0], block.nuisances[train, 0], measured)

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """See `Instrument.predict`."""
        at = Frames(poses.rotation[:, None], poses.position[:, None])
        there = places_of_rows(places, BOARD, m.labels["board"])
        seen = BoardPose().simulate(at, np.zeros((len(there), 12)), there, np.zeros((len(there), 6)))
        return replace(m, rotation=seen[:, :9].reshape(-1, 3, 3), position=seen[:, 9:])

    def default_places(self, names: Sequence[str], middle: Floats, reach: float) -> dict[tuple[str, str], Floats]:
        """See `Instrument.default_places`."""
        n = len(names)
        away = middle + 2.0 * reach * Rotation.random(n, random_state=0).as_matrix()[:, :, 2]
        turned = Rotation.random(n, random_state=np.random.default_rng(0).integers(1000)).as_rotvec()
        return {(BOARD.letter, name): np.append(turned[k], away[k]) for k, name in enumerate(names)}


INSTRUMENTS = (BoardCamera(),)
