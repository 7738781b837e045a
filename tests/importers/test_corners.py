"""Corners that are found are where they are, in the board's own order, however the camera is turned."""

import numpy as np
import pytest
from boards import BOARD, CAMERA, render
from refusals import refusal
from scipy.spatial.transform import Rotation

from fg_calib.importers.board import CalibrationBoard, charuco_board, find_corners, in_order

pytest.importorskip("cv2", reason="no OpenCV: pip install 'fg_calib[camera]'")

CHARUCO = CalibrationBoard(type="charuco", columns=9, rows=7, square=0.02, marker=0.014, dictionary="DICT_5X5_100")
BOARDS = [BOARD, CalibrationBoard(type="checkerboard", columns=6, rows=9, square=0.02), CHARUCO]
EVERY = pytest.mark.parametrize("board", BOARDS, ids=["9 x 6", "6 x 9", "charuco"])


def seen_from(board, roll, tilt=20.0, distance=0.45):
    """The board's axes and origin in a camera that looks at its centre."""
    R = Rotation.from_euler("ZX", [roll, tilt], degrees=True).as_matrix()
    return R, np.array([0.01, -0.01, distance]) - R[:, :2] @ board.corners.mean(axis=0)


def images_of(board, R, t, camera=CAMERA):
    return camera.image(t + board.corners @ R[:, :2].T)[0]


@pytest.mark.sampled(4)
@EVERY
@pytest.mark.parametrize("roll", [0, 100, 180, 260])
def test_corners_are_where_they_are_seen(board, roll):
    """Within 0.3 px each, and 0.06 px on average: a neighbour is 20 px away."""
    R, t = seen_from(board, roll)
    corners, uv = find_corners(render(board, R, t, np.random.default_rng(roll)), board)
    assert len(corners) >= (40 if board.type == "charuco" else 54)  # a marker may be missed
    error = uv - images_of(board, R, t)[corners]
    assert np.abs(error).max() < 0.3
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_a_charuco_board_is_known_by_what_is_seen_of_it():
    R, t = seen_from(CHARUCO, 30)
    t = t + np.array([0.2, 0.0, 0.0])
    corners, uv = find_corners(render(CHARUCO, R, t, np.random.default_rng(1)), CHARUCO)
    assert 6 <= len(corners) < 36
    assert np.abs(uv - images_of(CHARUCO, R, t)[corners]).max() < 0.3


@pytest.mark.parametrize("turn", [np.s_[:, :], np.s_[::-1, ::-1], np.s_[:, ::-1], np.s_[::-1]], ids=str)
def test_a_checkerboard_begins_with_a_black_square_and_is_seen_from_the_front(turn):
    R, t = seen_from(BOARD, 40)
    grid = images_of(BOARD, R, t).reshape(6, 9, 2)
    assert in_order(render(BOARD, R, t, np.random.default_rng(3)), grid[turn]) == pytest.approx(grid, abs=0.0)


def test_corners_of_a_charuco_board_are_opencvs():
    theirs = np.asarray(charuco_board(CHARUCO, "board").getChessboardCorners())
    assert np.column_stack([CHARUCO.corners, np.zeros(48)]) == pytest.approx(theirs, abs=1e-8)


@EVERY
def test_an_image_without_the_board_has_none(board):
    grey = np.random.default_rng(5).normal(128, 20, (240, 320)).clip(0, 255).astype(np.uint8)
    assert find_corners(grey, board) == "no board"


def test_a_dictionary_with_too_few_markers_is_refused():
    board = CHARUCO.model_copy(update={"columns": 15, "rows": 11, "dictionary": "DICT_4X4_50"})
    said = "board.yaml: dictionary: DICT_4X4_50 has 50 markers, expected 82 or more"
    assert refusal(charuco_board, board, "board.yaml") == said
