"""What OpenCV does for us: it decodes images, finds corners, and gives poses and cameras to start from.

The only module that calls it, so that nothing else needs it installed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from fg_calib.inputs import Floats, InputError, Integers
from fg_calib.measurements.kinds import Camera

Image = NDArray[np.uint8]

_SEARCHED = 1600
"""Longest side, [px], to which an image is reduced before a checkerboard is searched in it: in 12 megapixels without a
board the search takes seconds, or minutes where there is much texture."""


UNDETERMINED = ("images", "no camera that they determine", "boards tilted by 30 degrees or so in several ways")

MIN_IMAGES = 3
"""From which a camera can be estimated: a plane gives two equations a view, and there are four unknowns and
the lens."""

MIN_CORNERS = 6
"""Of a ChArUco board: four determine its pose, and more its accuracy."""


@dataclass(frozen=True)
class CalibrationBoard:
    """A checkerboard, or a ChArUco board, whose white squares hold markers that say which ones they are.

    The board's frame has its origin at the first corner of a checkerboard, between whose first four corners is a
    black square, or at the outer corner of a ChArUco board's first square; x runs along the rows of corners, y from
    row to row, z away from who looks at it.

    Attributes:
        type: Which of the two.
        columns: Of a checkerboard the inner corners in a row, of a ChArUco board the squares in a row, as in OpenCV.
        rows: Inner corners, or squares, in a column.
        square: Side of a square, [m].
        marker: Side of a marker, [m]; 0 for a checkerboard.
        dictionary: The markers' dictionary, such as `DICT_5X5_100`; empty for a checkerboard.
        legacy: Whether the ChArUco board was drawn by an OpenCV before 4.6, which began boards with an even number of
            rows with a white square.
        upright: Whether the camera never turned more than a quarter turn about its axis between images, seen from the
            first one: this orients a checkerboard that looks the same after half a turn.
        name: What the board is called in a column `board`; without a name there is no such column.
    """

    type: Literal["checkerboard", "charuco"]
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = ""
    legacy: bool = False
    upright: bool = False
    name: str = ""

    @property
    def shape(self) -> tuple[int, int]:
        """Corners in a row, and rows of them."""
        fewer = self.type == "charuco"
        return self.columns - fewer, self.rows - fewer

    @property
    def corners(self) -> Floats:
        """Places of the corners in the board's frame, x and y, row by row, shape (n_corners, 2), [m]."""
        columns, rows = self.shape
        j, i = np.divmod(np.arange(columns * rows), columns)
        first = 1.0 if self.type == "charuco" else 0.0
        return self.square * (np.stack([i, j], axis=1) + first)

    @property
    def ambiguous(self) -> bool:
        """Whether it looks the same after half a turn: a checkerboard whose opposite end squares are of one colour."""
        return self.type == "checkerboard" and (self.columns + self.rows) % 2 == 0


@cache
def load_opencv() -> Any:
    """The module `cv2`.

    Raises:
        InputError: It is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise InputError("fg-calib board needs OpenCV", "pip install 'fg_calib[camera]'") from None
    logging = getattr(cv2.utils, "logging", cv2)  # 4.11 has it in the module itself
    logging.setLogLevel(0)  # what it could not read is said by us
    return cv2


def decode(content: bytes, name: str) -> Image:
    """An image in grey levels, as the sensor saw it: no turn that its file asks viewers for is made.

    Args:
        content: The bytes of its file.
        name: The file's name, for messages.

    Raises:
        InputError: OpenCV cannot read it.
    """
    cv2 = load_opencv()
    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        image: Image | None = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error:  # of absurd size, or of no content
        image = None
    if image is None:
        raise InputError(name, "no image that OpenCV can read", "PNG, JPEG, TIFF, BMP or the like")
    return image


def dictionaries() -> list[str]:
    """Names of the dictionaries of markers."""
    return sorted(name for name in dir(load_opencv().aruco) if name.startswith("DICT_"))


def charuco_board(board: CalibrationBoard, place: str) -> Any:
    """A ChArUco board as OpenCV has it.

    Args:
        board: The board.
        place: Its file, for messages.

    Raises:
        InputError: Its dictionary has fewer markers than it has white squares.
    """
    cv2 = load_opencv()
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    needed, there = board.columns * board.rows // 2, len(dictionary.bytesList)
    if needed > there:
        raise InputError(f"{place}: dictionary", f"{board.dictionary} has {there} markers", f"{needed} or more")
    shape = (board.columns, board.rows)
    made = cv2.aruco.CharucoBoard(shape, float(board.square), float(board.marker), dictionary)
    made.setLegacyPattern(board.legacy)
    return made


def find_corners(image: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | str:
    """Corners of a board in an image.

    Each is moved to where the gradients around it say it is (`cornerSubPix`), within a window of its own size: all
    that is in it are the four squares that meet there.

    Args:
        image: The image.
        board: The board.

    Returns:
        Which corners, numbered row by row, shape (n,), and where they are, (n, 2), [px]; or why there are none.
    """
    cv2 = load_opencv()
    try:
        found = _charuco(cv2, image, board) if board.type == "charuco" else _checkerboard(cv2, image, board)
    except cv2.error:
        return "OpenCV cannot search it"
    if isinstance(found, str):
        return found
    corners, uv = found
    if len(corners) < MIN_CORNERS:
        return f"no more than {len(corners)} corners"
    free = 0.45 if board.type == "checkerboard" else min(0.45, (board.square - board.marker) / board.square / 2)
    half = int(np.clip(free * pdist(uv).min(), 2, 20))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    exact = cv2.cornerSubPix(image, np.ascontiguousarray(uv[:, None], np.float32), (half, half), (-1, -1), criteria)
    return corners, exact[:, 0].astype(np.float64)


def _checkerboard(cv2: Any, image: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | str:
    scale = max(1.0, max(image.shape) / _SEARCHED)
    small = cv2.resize(image, None, fx=1.0 / scale, fy=1.0 / scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, uv = cv2.findChessboardCorners(small, board.shape, flags=flags)
    if not found:  # slower, and sees more: blur, reflections, a narrow margin
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, uv = cv2.findChessboardCornersSB(small, board.shape, flags=flags)
    if not found:
        return "no board"
    columns, rows = board.shape
    uv = (uv.astype(np.float64) + 0.5) * scale - 0.5
    grid = in_order(image, uv.reshape(rows, columns, 2))
    return np.arange(columns * rows), grid.reshape(-1, 2)


def _charuco(cv2: Any, image: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | str:
    detector = cv2.aruco.CharucoDetector(charuco_board(board, "board"))
    uv, corners, _, markers = detector.detectBoard(image)
    if corners is None or len(corners) == 0:
        seen = 0 if markers is None else len(markers)
        return f"{seen} markers, but no corners" if seen else "no board"
    return corners.ravel().astype(np.int64), uv.reshape(-1, 2).astype(np.float64)


def in_order(image: Image, grid: Floats) -> Floats:
    """Corners of a checkerboard in its own order: turning right from rows to columns, a black square first.

    Where the board looks the same after half a turn, both orders begin with a black square, or both with a white one:
    then the order stays as it is.

    Args:
        image: The image.
        grid: Corners row by row, shape (rows, columns, 2), [px].
    """
    along, down = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if along[0] * down[1] - along[1] * down[0] < 0.0:  # as if seen from behind
        grid = grid[:, ::-1]
    centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    u, v = np.rint(centres).astype(int).reshape(-1, 2).T
    height, width = image.shape
    grey = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].reshape(centres.shape[0], -1).astype(np.float64)
    i, j = np.indices(grey.shape)
    like_first = (i + j) % 2 == 0
    if (sum(grid.shape[:2]) % 2) and grey[like_first].mean() > grey[~like_first].mean():
        grid = grid[::-1, ::-1]
    return grid


def both_poses(points: Floats, uv: Floats, camera: Camera) -> list[tuple[Floats, Floats]]:
    """Poses of a plane from which its points would be seen there, nearest first.

    A plane that is seen small has two: tilted one way or the other (Collins and Bartoli 2014, *Infinitesimal
    plane-based pose estimation*). Each is refined to least squares of the distances in the image.

    Args:
        points: Points of the plane, x and y, shape (n, 2), [m].
        uv: Where they are seen, shape (n, 2), [px].
        camera: The camera.

    Returns:
        Axes of the plane in the camera's frame, (3, 3), and its origin, (3,), [m]; one or two poses, or none.
    """
    cv2 = load_opencv()
    K, lens = _matrices(camera)
    places = np.column_stack([points, np.zeros(len(points))])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    found = []
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(places, uv, K, lens, flags=cv2.SOLVEPNP_IPPE)
        for turn, shift in zip(turns, shifts, strict=True):
            v, t = cv2.solvePnPRefineLM(places, uv, K, lens, turn.copy(), shift.copy(), criteria)
            if np.isfinite(v).all() and np.isfinite(t).all():
                found.append((cv2.Rodrigues(v)[0], t.ravel()))
    except cv2.error:
        return []
    return found


def first_camera(points: Sequence[Floats], uv: Sequence[Floats], size: tuple[int, int]) -> Camera:
    """The camera that explains views of a plane best (Zhang 2000, *A flexible new technique for camera calibration*).

    Args:
        points: Of each view, points of the plane, x and y, shape (n, 2), [m].
        uv: Where they are seen, [px].
        size: Width and height of the images, [px].

    Raises:
        InputError: There are too few views, or they do not determine it.
    """
    if len(points) < MIN_IMAGES:
        expected = f"at least {MIN_IMAGES} to estimate a camera from"
        raise InputError("images", f"{len(points)} with a board", expected)
    cv2 = load_opencv()
    places = [np.column_stack([p, np.zeros(len(p))]).astype(np.float32) for p in points]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    try:
        seen = [image.astype(np.float32) for image in uv]
        _, K, lens, _, _ = cv2.calibrateCamera(places, seen, size, None, None, criteria=criteria)
        return Camera(*map(float, [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:5]]))
    except (cv2.error, InputError):
        raise InputError(*UNDETERMINED) from None


def _matrices(camera: Camera) -> tuple[Floats, Floats]:
    """The camera's matrix, and k1 k2 p1 p2 k3."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return K, np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])


def camera_derivatives(camera: Camera, points: Floats) -> Floats:
    """Derivatives of image points in the camera's parameters, in the order of its fields, shape (n, 2, 9).

    Args:
        camera: The camera.
        points: Points in its frame, in front of it, shape (n, 3), [m].
    """
    K, lens = _matrices(camera)
    J = load_opencv().projectPoints(points, np.zeros(3), np.zeros(3), K, lens)[1]
    return np.asarray(J[:, 6:15].reshape(len(points), 2, 9), dtype=np.float64)
