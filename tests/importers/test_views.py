"""Poses of a board and cameras are known as well as is said, in the axes of `BoardPose`."""

from dataclasses import astuple

import numpy as np
import pytest
from boards import BOARD, CAMERA, SIZE, views
from refusals import refusal
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from fg_calib.importers.board import INTRINSICS, CalibrationBoard, Corners, fit_board
from fg_calib.measurements.kind import Frames
from fg_calib.measurements.kinds.board import BoardPose

cv2 = pytest.importorskip("cv2", reason="no OpenCV: pip install 'fg_calib[camera]'")

SIGMA = 0.05
"""Of a corner, [px]."""


def drawn(n, rng, sigma=SIGMA, board=BOARD, **of_views):
    """Corners in n images with noise, and the true poses by name."""
    R, t = views(board, n, rng, **of_views)
    seen = [CAMERA.image(p + board.corners @ A[:, :2].T)[0] for A, p in zip(R, t, strict=True)]
    every = np.arange(len(board.corners))
    found = [Corners(f"i{k}", every, uv + sigma * rng.normal(size=uv.shape)) for k, uv in enumerate(seen)]
    return found, {f"i{k}": (A, p) for k, (A, p) in enumerate(zip(R, t, strict=True))}


def residual_of(view, R, t):
    """What `BoardPose` says of a measured pose where the true one is R, t."""
    at = Frames(np.eye(3)[None, None], np.zeros((1, 1, 3)))
    board = np.append(Rotation.from_matrix(R).as_rotvec(), t)[None]
    return BoardPose().rows(at, np.append(view.rotation.ravel(), view.position)[None], board).residual[0]


def nees(fit, truth):
    """Squared errors of the poses over their covariances, shape (n,)."""
    errors = [residual_of(view, *truth[view.name]) for view in fit.views]
    return np.array([e @ np.linalg.solve(v.covariance, e) for e, v in zip(errors, fit.views, strict=True)])


def test_a_pose_is_the_optimum_of_its_corners_and_the_covariance_that_of_opencvs_projection():
    """Differences of `projectPoints`, in a turn and a shift along the camera's axes."""
    found, _ = drawn(3, np.random.default_rng(1))
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    lens = np.array(astuple(CAMERA)[4:])
    places = np.column_stack([BOARD.corners, np.zeros(len(BOARD.corners))])

    def seen(view, step):
        turned = Rotation.from_rotvec(step[:3]) * Rotation.from_matrix(view.rotation)
        return cv2.projectPoints(places, turned.as_rotvec(), view.position + step[3:], K, lens)[0].ravel()

    for view in fit_board(BOARD, found, SIZE, CAMERA).views:
        J = np.stack([(seen(view, s) - seen(view, -s)) / 2e-6 for s in 1e-6 * np.eye(6)], axis=1)
        expected = view.sigma**2 * np.linalg.inv(J.T @ J)
        size = np.sqrt(np.diag(expected))
        assert view.covariance / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), abs=1e-6)
        step = np.linalg.lstsq(J, view.uv.ravel() - seen(view, np.zeros(6)), rcond=None)[0]
        assert np.abs(step / size).max() < 1e-3


def test_errors_of_poses_are_what_their_covariances_say():
    """NEES of 50 poses within 4 of its own sigma; the sigma of corners within 4 of its own."""
    found, truth = drawn(50, np.random.default_rng(3))
    fit = fit_board(BOARD, found, SIZE, CAMERA)
    e = nees(fit, truth)
    assert abs(e.mean() / 6.0 - 1.0) < 4.0 * np.sqrt(2.0 / 6.0 / len(e))
    assert kstest(chi2.cdf(e, 6), "uniform").pvalue > 1e-3
    assert abs(fit.sigma / SIGMA - 1.0) < 4.0 / np.sqrt(2.0 * len(e) * 102)


def test_the_sigma_of_corners_allows_for_what_the_poses_take_up():
    """Of 24 residuals an image a pose takes up 6: without them sigma would be 13 % too small."""
    board = CalibrationBoard(type="checkerboard", columns=4, rows=3, square=0.04)
    found, _ = drawn(40, np.random.default_rng(12), board=board)
    fit = fit_board(board, found, SIZE, CAMERA)
    assert abs(fit.sigma / SIGMA - 1.0) < 3.0 / np.sqrt(2.0 * 40 * 18)
    assert fit.rms == pytest.approx(fit.sigma * np.sqrt(18 / 24))


@pytest.mark.slow
def test_errors_of_the_camera_are_what_its_sigmas_say():
    """20 cameras of 10 images each: mean squared error over the variance, within 4 of its own sigma."""
    squares = []
    for seed in range(20):
        fit = fit_board(BOARD, drawn(10, np.random.default_rng(seed))[0], SIZE)
        squares.append([((getattr(fit.camera, k) - getattr(CAMERA, k)) / fit.camera_sigma[k]) ** 2 for k in INTRINSICS])
    assert np.mean(squares, axis=0) == pytest.approx(np.ones(9), abs=4.0 * np.sqrt(2.0 / 20))


def test_two_images_are_too_few_for_a_camera():
    said = refusal(fit_board, BOARD, drawn(2, np.random.default_rng(9))[0], SIZE)
    assert said == "images: 2 with a board, expected at least 3 to estimate a camera from"


@pytest.mark.parametrize(("distance", "tilt", "ambiguous"), [(3.0, 10.0, True), (0.4, 40.0, False)])
def test_a_board_that_is_seen_small_and_hardly_tilted_has_two_poses(distance, tilt, ambiguous):
    R = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    uv = CAMERA.image(np.array([-0.08, -0.05, distance]) + BOARD.corners @ R[:, :2].T)[0]
    noise = np.random.default_rng(10).normal(scale=0.3, size=uv.shape)
    (view,) = fit_board(BOARD, [Corners("i", np.arange(54), uv + noise)], SIZE, CAMERA).views
    assert view.ambiguous == ambiguous
