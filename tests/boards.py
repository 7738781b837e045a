"""Images of a calibration board as a known camera sees them from known places: perspective, lens, blur and noise."""

from functools import cache

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from fg_calib.importers.board import CalibrationBoard
from fg_calib.initialization import Camera

CAMERA = Camera(fx=620.0, fy=625.0, cx=322.0, cy=237.0, k1=-0.12, k2=0.06, p1=8e-4, p2=-6e-4, k3=-0.01)
SIZE = (640, 480)
"""Width and height, [px]."""
BOARD = CalibrationBoard(type="checkerboard", columns=9, rows=6, square=0.02)

_FINE = 2
"""Points a pixel is the mean of, along each side."""
_TEXTURE = 60
"""Points of the drawing of a board along a square."""


def render(board, R, t, rng, *, camera=CAMERA, size=SIZE, noise=2.0, blur=0.7):
    """An 8-bit image of a board at camera_T_board = (R, t).

    Args:
        board: A `CalibrationBoard`.
        R: Its axes in the camera's frame.
        t: Its origin there, [m].
        rng: Draws the noise.
        camera: The camera.
        size: Width and height of the image, [px].
        noise: 1 sigma of a pixel, in grey levels.
        blur: 1 sigma of the point spread, [px].
    """
    import cv2

    drawing, origin = _drawing(board)
    scale = _TEXTURE / board.square
    image = np.full(size[::-1], 170.0, dtype=np.float32)
    part = _part(board, R, t, camera, size)
    x, y = (r[_enlarged(part)] for r in _rays(camera, size))
    # of normalised coordinates to the board's plane
    H = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t])).astype(np.float32)
    a, b, c = (H[i, 0] * x + H[i, 1] * y + H[i, 2] for i in range(3))
    fine = cv2.remap(drawing, a / c * scale + origin, b / c * scale + origin, cv2.INTER_LINEAR, borderValue=170.0)
    image[part] = fine.reshape(fine.shape[0] // _FINE, _FINE, -1, _FINE).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur) + noise * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _part(board, R, t, camera, size):
    """Rows and columns of the image within which the board is, three squares around its corners included."""
    low, high = board.corners.min(axis=0) - 3 * board.square, board.corners.max(axis=0) + 3 * board.square
    side = np.linspace(0.0, 1.0, 20)[:, None]
    a, b, c, d = low, [high[0], low[1]], high, [low[0], high[1]]
    edge = np.vstack([p + side * (np.array(q) - p) for p, q in ((a, b), (b, c), (c, d), (d, a))])
    u, v = camera.image(t + np.column_stack([edge, np.zeros(len(edge))]) @ R.T)[0].T
    first = np.clip([v.min(), u.min()], 0, size[::-1]).astype(int)
    last = np.clip([v.max() + 1, u.max() + 1], 0, size[::-1]).astype(int)
    return tuple(slice(a, b) for a, b in zip(first, last, strict=True))


def _enlarged(part):
    return tuple(slice(s.start * _FINE, s.stop * _FINE) for s in part)


@cache
def _rays(camera, size):
    """Where points of the image look, x and y over z, shape (height, width) each.

    The lens is undone by Newton's steps at every eighth point; in between, splines are exact to 1e-9.
    """
    u, v = (((np.arange(n * _FINE) + 0.5) / _FINE - 0.5) for n in size)  # pixels are centred on whole numbers
    few_u, few_v = np.append(u[::8], u[-1]), np.append(v[::8], v[-1])
    seen = np.stack(np.meshgrid(few_u, few_v), axis=-1).reshape(-1, 2)
    found = (seen - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    for _ in range(5):
        image, J = camera.image(np.column_stack([found, np.ones(len(found))]))
        found = found - np.linalg.solve(J[:, :, :2], (image - seen)[:, :, None])[:, :, 0]
    grids = found.T.reshape(2, len(few_v), len(few_u))
    return tuple(RectBivariateSpline(few_v, few_u, grid)(v, u).astype(np.float32) for grid in grids)


@cache
def _drawing(board):
    """A drawing of a board with a white margin, and where the board's origin is in it along each axis."""
    if board.type == "checkerboard":
        i, j = np.mgrid[-2 : board.rows + 2, -2 : board.columns + 2]
        inside = (i >= -1) & (j >= -1) & (i <= board.rows - 1) & (j <= board.columns - 1)
        squares = np.where((i + j) % 2 == 0, 30.0, 220.0)
        squares[~inside] = 220.0
        drawing = np.kron(squares, np.ones((_TEXTURE, _TEXTURE)))
        return drawing.astype(np.float32), 2 * _TEXTURE - 0.5
    from fg_calib.importers.board import charuco_board

    size = (board.columns * _TEXTURE, board.rows * _TEXTURE)
    drawing = 30.0 + (190.0 / 255.0) * charuco_board(board, "board").generateImage(size)
    return np.pad(drawing, _TEXTURE, constant_values=220.0).astype(np.float32), _TEXTURE - 0.5


def views(board, n, rng, *, distance=(0.35, 0.6), tilt=45.0, roll=180.0, off=0.15):
    """Places from which a camera sees a board: axes (n, 3, 3) and origins (n, 3) of the board in its frame.

    Args:
        board: A `CalibrationBoard`.
        n: Number of places.
        rng: Draws them.
        distance: Of the board's centre, least and most, [m].
        tilt: Most between the camera's axis and the board's normal, [deg].
        roll: Most about the camera's axis either way, [deg].
        off: Most that the centre is off the camera's axis, in x and y over z.
    """
    centre = np.append(board.corners.mean(axis=0), 0.0)
    rotations, origins = [], []
    for _ in range(n):
        about = rng.uniform(-np.pi, np.pi)
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        tilted = Rotation.from_rotvec(np.deg2rad(tilt) * np.sqrt(rng.uniform()) * axis)
        R = (Rotation.from_euler("z", rng.uniform(-roll, roll), degrees=True) * tilted).as_matrix()
        z = rng.uniform(*distance)
        place = z * np.append(rng.uniform(-off, off, 2), 1.0)
        rotations.append(R)
        origins.append(place - R @ centre)
    return np.array(rotations), np.array(origins)
