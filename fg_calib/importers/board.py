"""Calibration boards: their files, images that show them, and the tables `pixels.csv`, `board.csv` with the camera.

type: charuco            # or checkerboard
columns: 9               # squares in a row; of a checkerboard the inner corners in a row
rows: 7
square: 20
marker: 14               # charuco alone, as are dictionary and legacy
dictionary: DICT_5X5_100
units: {length: mm}

With R, t the board and c a corner on it, `t + R c` is where it is in the camera's frame, and `Camera.image` where it is
seen. A turn w of the board about its origin and a shift dt, both along the camera's axes, move its image by
`J_image (w x R c + dt)`: these are the rows of `RoomPixel`, and the axes of `BoardPose`, so that the covariance of
(w, dt), orientation first, is what a table's columns `cov_11 ... cov_66` hold.

The only module that calls OpenCV, so that nothing else needs it installed.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, StrictBool
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from fg_calib import __version__, io, measurements, parallel
from fg_calib.initialization import Camera, boards_from_image, refine_board
from fg_calib.inputs import Floats, InputError, Integers, Record, check, expect

Image = NDArray[np.uint8]

Size = tuple[int, int]
"""Width and height of images, [px]."""

_SEARCHED = 1600
"""Longest side, [px], to which an image is reduced before a checkerboard is searched in it: in 12 megapixels without a
board the search takes seconds, or minutes where there is much texture."""


MAX_COUNT = 1000
"""Columns or rows."""

MAX_SQUARE_M = 2.0
"""Side of a square, [m]: larger ones are in another unit."""

MIN_IMAGES = 3
"""Least number of views to estimate a camera: a plane gives two equations a view, and there are four unknowns and
the lens."""

MIN_CORNERS = 6
"""Corners of a ChArUco board: four determine its pose, and more its accuracy."""


class CalibrationBoard(io.Schema):
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
        name: Name of the board in a column `board`; without a name there is no such column.
        units: Of its file.
    """

    type: Literal["checkerboard", "charuco"]
    columns: Annotated[io.Count, Field(ge=3, le=MAX_COUNT)]
    rows: Annotated[io.Count, Field(ge=3, le=MAX_COUNT)]
    square: io.Positive
    marker: io.NotNegative = 0.0
    dictionary: str = ""
    legacy: StrictBool = False
    upright: StrictBool = False
    name: str = ""
    units: io.UnitsOfFile = Field(io.Units(), exclude=True)

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
        return self.square * (np.stack([i, j], axis=1) + (1.0 if self.type == "charuco" else 0.0))

    @property
    def ambiguous(self) -> bool:
        """Whether it looks the same after half a turn: a checkerboard whose opposite end squares are of one colour."""
        return self.type == "checkerboard" and (self.columns + self.rows) % 2 == 0


@cache
def load_opencv() -> Any:
    """The module `cv2`.

    Raises:
        InputError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise InputError("fg-calib board needs OpenCV", "pip install 'fg_calib[camera]'") from None
    # What it could not read is said by us; 4.11 has the logging in the module itself.
    getattr(cv2.utils, "logging", cv2).setLogLevel(0)
    return cv2


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Leave out what libraries in C, such as libpng, print of what they cannot read."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def decode(content: bytes, name: str) -> Image:
    """An image in grey levels, as the sensor saw it: no turn that its file asks viewers for is made.

    Args:
        content: The bytes of its file.
        name: The file's name, for messages.

    Raises:
        InputError: OpenCV cannot read it.
    """
    cv2, image = load_opencv(), None
    with suppress(cv2.error), _without_stderr():  # of absurd size, or of no content
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if image is None:
        raise InputError(name, "no image that OpenCV can read", "PNG, JPEG, TIFF, BMP or the like")
    return np.asarray(image, dtype=np.uint8)


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
    expect(needed <= there, f"{place}: dictionary", f"{board.dictionary} has {there} markers", f"{needed} or more")
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
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
    return np.arange(columns * rows), in_order(image, uv.reshape(rows, columns, 2)).reshape(-1, 2)


def _charuco(cv2: Any, image: Image, board: CalibrationBoard) -> tuple[Integers, Floats] | str:
    uv, corners, _, _ = cv2.aruco.CharucoDetector(charuco_board(board, "board")).detectBoard(image)
    if corners is None or len(corners) == 0:
        return "no board"
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


def estimate_camera(points: Sequence[Floats], uv: Sequence[Floats], size: Size) -> Camera:
    """The camera that explains views of a plane best (Zhang 2000, *A flexible new technique for camera calibration*).

    Args:
        points: Of each view, points of the plane, x and y, shape (n, 2), [m].
        uv: Where they are seen, [px].
        size: Width and height of the images, [px].

    Raises:
        InputError: There are too few views, or they do not determine it.
    """
    if len(points) < MIN_IMAGES:
        raise InputError("images", f"{len(points)} with a board", f"at least {MIN_IMAGES} to estimate a camera from")
    cv2 = load_opencv()
    places = [np.column_stack([p, np.zeros(len(p))]).astype(np.float32) for p in points]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    try:
        seen = [image.astype(np.float32) for image in uv]
        _, K, lens, _, _ = cv2.calibrateCamera(places, seen, size, None, None, criteria=criteria)
        return Camera(*map(float, [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:5]]))
    except (cv2.error, InputError):
        hint = "boards tilted by 30 degrees or so in several ways"
        raise InputError("images", "no camera that they determine", hint) from None


def _matrices(camera: Camera) -> tuple[Floats, Floats]:
    """The camera's matrix, and k1 k2 p1 p2 k3."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return K, np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])


INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""A camera's parameters, in OpenCV's order."""

PRIOR_RESIDUALS = 10
"""How many residuals of its own weigh as much in an image's sigma as those of all images."""

MAX_CHI2_DIFFERENCE = 10.8
"""Chi-square by which a second pose may fit worse and still be the true one: its 99.9 % point."""

MAX_RMS_SHARE = 0.002
"""RMS of all residuals, in diagonals of the image, that no lens unlike its model leaves: a camera of other images."""

MAX_FOCAL_SIGMA = 0.01
"""Sigma of a focal length over itself above which it is hardly determined: distances are wrong by as much."""


class Corners(NamedTuple):
    """Corners found in an image.

    Attributes:
        name: Name of the image.
        corners: Which corners of the board, shape (n,).
        uv: Where they are seen, shape (n, 2), [px].
    """

    name: str
    corners: Integers
    uv: Floats


class View(Record):
    """A board in an image.

    Attributes:
        name: Name of the image.
        corners: Which of its corners are seen, shape (n,).
        uv: Where, shape (n, 2), [px].
        rotation: Its axes in the camera's frame, camera_R_board, shape (3, 3).
        position: Its origin there, shape (3,), [m].
        rms: Of the residuals, [px].
        sigma: Of a corner along each axis of the image, [px].
        covariance: Of its pose along and about the camera's axes, orientation first, shape (6, 6), [rad] and [m], with
            the camera taken as known.
        ambiguous: Whether a second pose, tilted the other way, explains its corners nearly as well.
    """

    name: str
    corners: Integers
    uv: Floats
    rotation: Floats
    position: Floats
    rms: float
    sigma: float
    covariance: Floats
    ambiguous: bool

    @property
    def rotation_vector(self) -> Floats:
        """`rotation` as an axis times an angle, shape (3,), [rad]."""
        return Rotation.from_matrix(self.rotation.copy()).as_rotvec()


class BoardFit(Record):
    """A board in some images, and the camera.

    Attributes:
        board: The board.
        size: Width and height of the images, [px].
        camera: The camera.
        camera_sigma: 1 sigma of each of its `INTRINSICS`; None for a camera that was given.
        views: The board in each image.
        without_pose: Names of images that no pose explains.
        rms: Of all residuals, [px].
        sigma: Of a corner along each axis of the image, in the mean of all images, [px].
    """

    board: CalibrationBoard
    size: Size
    camera: Camera
    camera_sigma: Mapping[str, float] | None
    views: tuple[View, ...]
    without_pose: tuple[str, ...]
    rms: float
    sigma: float

    @property
    def findings(self) -> tuple[str, ...]:
        """Why the result is not to be trusted."""
        found, (width, height) = [], self.size
        for name in ("fx", "fy"):
            value, sigma = getattr(self.camera, name), (self.camera_sigma or {}).get(name, 0.0)
            if sigma > MAX_FOCAL_SIGMA * value:
                hint = "tilt the board by 30 degrees or so, in several directions, and fill the image with it"
                found.append(f"the images do not determine the camera: {name} = {value:.0f} ± {sigma:.0f} px; {hint}")
        if self.rms > MAX_RMS_SHARE * np.hypot(width, height):
            hint = f"is the camera that of these images of {width} x {height} px, is the board as its file says?"
            found.append(f"no poses explain the corners: residuals of {self.rms:.3g} px RMS; {hint}")
        return tuple(found)


class _Fit(NamedTuple):
    """Least squares of one image: pose, squares of residuals, derivatives by the pose, (2 n, 6); squares of another."""

    pose: tuple[Floats, Floats]
    squares: float
    J: Floats
    second: float = np.inf


def fit_board(board: CalibrationBoard, found: Sequence[Corners], size: Size, camera: Camera | None = None) -> BoardFit:
    """Poses of a board, each with its covariance, and with `camera` None the camera too.

    Each image's corners have a sigma of their own, from its residuals and, with the weight of some, those of all
    images: blur and slant differ from image to image.

    Args:
        board: The board.
        found: Its corners in each image.
        size: Width and height of the images, [px].
        camera: The camera; None to estimate it from these images, unweighted.

    Raises:
        InputError: There are too few images for a camera, or none that a pose explains.
    """
    given, points = camera is not None, {one.name: board.corners[one.corners] for one in found}
    if camera is None:
        camera = estimate_camera(list(points.values()), [one.uv for one in found], size)
    fits = {one.name: fit for one in found if (fit := _fit(camera, points[one.name], one.uv)) is not None}
    expect(fits, "images", "corners that no pose of the board explains", "images of this board by this camera")
    taken = 6.0 + (0.0 if given else len(INTRINSICS) / len(fits))
    squares, n = (sum(of) for of in zip(*((fit.squares, len(fit.J)) for fit in fits.values()), strict=True))
    variance = squares / (n - taken * len(fits))
    sigmas = None if given else _camera_sigmas(camera, points, fits, variance)
    views = tuple(_view(one, fits[one.name], variance, taken) for one in found if one.name in fits)
    without = tuple(one.name for one in found if one.name not in fits)
    rms, sigma = float(np.sqrt(squares / n)), float(np.sqrt(variance))
    return BoardFit(board, size, camera, sigmas, views, without, rms, sigma)


def _camera_sigmas(
    camera: Camera, points: Mapping[str, Floats], fits: Mapping[str, _Fit], variance: float
) -> dict[str, float]:
    """1 sigma of each of the camera's parameters, for corners of a variance and unknown poses.

    Those of `cv2.calibrateCameraExtended` are small where the images hardly determine the camera.
    """
    rest = []
    for name, (pose, _, J, _) in fits.items():
        in_camera = pose[1] + points[name] @ pose[0][:, :2].T
        K = load_opencv().projectPoints(in_camera, np.zeros(3), np.zeros(3), *_matrices(camera))[1][:, 6:15]
        rest.append(K - J @ np.linalg.lstsq(J, K, rcond=None)[0])
    A = np.vstack(rest)
    size = np.linalg.norm(A, axis=0)
    _, s, Vt = np.linalg.svd(A / size, full_matrices=False)
    sigmas = np.sqrt(variance) * np.linalg.norm(Vt.T / np.maximum(s, 1e-12), axis=1) / size
    return dict(zip(INTRINSICS, sigmas.tolist(), strict=True))


def _view(one: Corners, fit: _Fit, of_all: float, taken: float) -> View:
    """The board in an image, by its own variance with the weight of some residuals of all images'."""
    variance = (fit.squares + PRIOR_RESIDUALS * of_all) / (len(fit.J) - taken + PRIOR_RESIDUALS)
    rms, sigma = float(np.sqrt(fit.squares / len(fit.J))), float(np.sqrt(variance))
    covariance = np.asarray(variance * np.linalg.inv(fit.J.T @ fit.J), dtype=np.float64)
    return View(*one, *fit.pose, rms, sigma, covariance, fit.second - fit.squares < MAX_CHI2_DIFFERENCE * variance)


def _fit(camera: Camera, points: Floats, uv: Floats) -> _Fit | None:
    """The better of the poses that explain some corners, and how well the other one does; None if there is none."""
    image, one = np.hstack([uv, points]), np.ones(uv.shape)
    poses = (refine_board(camera, image, one, start) for _, start in boards_from_image(camera, image))
    fits = [_rows(camera, points, uv, at.rotation, at.translation) for at in poses if at is not None]
    fits = [fit for fit in fits if np.isfinite(fit.squares) and np.linalg.matrix_rank(fit.J) == 6]
    if not fits:
        return None
    best, *others = sorted(fits, key=lambda fit: fit.squares)
    apart = (fit for fit in others if not np.allclose(fit.pose[0], best.pose[0], rtol=0.0, atol=1e-4))
    return best._replace(second=min((fit.squares for fit in apart), default=np.inf))


def _rows(camera: Camera, points: Floats, uv: Floats, R: Floats, t: Floats) -> _Fit:
    """Residuals at a pose, and their derivatives."""
    n = len(points)
    at = measurements.Frames(np.broadcast_to(R, (n, 1, 3, 3)), np.broadcast_to(t, (n, 1, 3)))
    rows = measurements.RoomPixel(camera).rows(at, np.column_stack([uv, points]), np.empty((n, 0)))
    return _Fit((R, t), float(np.sum(rows.residual**2)), rows.wrenches.reshape(2 * n, 6))


_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp", ".jp2")


# --- the file of a board ----------------------------------------------------------------------------------------------


def read_calibration_board(path: Path) -> CalibrationBoard:
    """A calibration board.

    Raises:
        InputError: The file is missing or cannot be used, or the board looks the same after half a turn and the file
            does not say `upright: true`.
    """
    place = path.name
    file = io.validate(CalibrationBoard, io.read_yaml(path), place)
    board = file.model_copy(update={key: getattr(file, key) * file.units.factor("m") for key in ("square", "marker")})
    if board.square > MAX_SQUARE_M:
        found = f"found {io.shown(file.square)} {file.units.length}"
        raise InputError(f"{place}: square", found, f"at most {MAX_SQUARE_M:g} m", "is it in mm? units: {length: mm}")
    if file.type == "charuco":
        for key in ("marker", "dictionary"):
            expect(getattr(file, key), place, f"missing key {key!r}")
        expected = f"a side shorter than a square's, {io.shown(file.square)}"
        expect(board.marker < board.square, f"{place}: marker", f"found {io.shown(file.marker)}", expected)
        known = [name for name in dir(load_opencv().aruco) if name.startswith("DICT_")]
        check(f"{place}: dictionary", board.dictionary, known)
        charuco_board(board, place)
    elif board.ambiguous and (not file.upright or file.columns == file.rows):
        found = f"{file.columns} x {file.rows} inner corners look the same after half a turn"
        hint = "where the camera never turns more than a quarter about its axis, say upright: true"
        raise InputError(place, found, "columns + rows odd, or a charuco board", hint)
    return board


# --- images -----------------------------------------------------------------------------------------------------------


def image_files(given: Sequence[Path]) -> list[Path]:
    """Files of images: those given, and those in a folder, in order.

    Raises:
        InputError: There are none, or two of one name: an image is known by its name without the ending.
    """
    names: dict[str, Path] = {}
    for path in given:
        found = [path]
        if path.is_dir():
            found = sorted(f for f in path.iterdir() if f.suffix.lower() in _ENDINGS and not f.name.startswith("."))
        expect(found, str(path), "no images", f"files that end in {', '.join(_ENDINGS)}")
        for file in found:
            if (other := names.setdefault(file.stem, file)) != file:
                second = f"a second image called {file.stem!r}"
                raise InputError(str(file), second, f"one, as {other.name} is called so")
    return list(names.values())


def read_corners(files: Sequence[Path], board: CalibrationBoard) -> tuple[list[Corners], dict[str, str], Size]:
    """Corners of a board in images.

    Returns:
        Corners of the images that have any; names of the others, and why they have none; width and height of the
        images, [px].

    Raises:
        InputError: An image cannot be read, they have different sizes, none shows the board, or some a larger one.
    """
    found, without, size = list[Corners](), dict[str, str](), (0, 0)
    for k, file in enumerate(files):
        parallel.tell("looking for corners", k, len(files))
        image = decode(io.read_bytes(file), file.name)
        height, width = image.shape
        if k and size != (width, height):
            expected = f"{size[0]} x {size[1]} px as {files[0].name}"
            raise InputError(file.name, f"an image of {width} x {height} px", expected, "one camera at a time")
        size = width, height
        seen = find_corners(image, board)
        if isinstance(seen, str):
            without[file.name] = seen
        else:
            found.append(Corners(file.stem, *seen))
    reasons = "; ".join(dict.fromkeys(without.values()))
    hint = "are columns, rows and dictionary those of the board? older charuco boards: legacy: true"
    expect(found, "images", f"the board in none of {len(files)} ({reasons})", "at least one", hint)
    half = len(found[0].uv) // 2
    along = [one.uv[-half:].mean(axis=0) - one.uv[:half].mean(axis=0) for one in found]
    for k, step in enumerate(along):
        if board.upright and step @ along[0] <= 0.0:  # in the order in which rows run as in the first image
            found[k] = found[k]._replace(uv=found[k].uv[::-1].copy())
    return found, without, size


BOARD_FILES = {
    "board.json": b'{\n "schema": "fg-calib/board/',
    "board.csv": b"id,",
    "pixels.csv": b"id,",
    "camera.yaml": b"",
}
"""Files to write, and how each begins."""


Readings = Mapping[str, Mapping[str, str]]
"""Cells of a row by column, by the name of its image: joint readings, and `split`, as they are written."""


def read_readings(path: Path) -> Readings:
    """Joint readings from a table of configurations whose `id` is the name of an image without its ending.

    Columns that are measurements, such as `x`, are left out; all others are taken as they are.

    Raises:
        InputError: The table cannot be used.
    """
    table = io.Table.read(path, "configurations")
    columns = {name.lower() if name.lower() in io.KNOWN else name: name for name in table.columns}
    expect("id" in columns, table.name, "no column id", "the name of each row's image without its ending")
    kept = [name for name in columns if name not in io.KNOWN]
    expect(kept, table.name, "no columns of joint readings", "q1, q2 and so on, or the joints' names")
    ids = table.texts(columns["id"], "the name of an image without its ending")
    table.require(ids.is_first_distinct().to_numpy(), columns["id"], "one row an image")
    comma = r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$" if table.separator != "," else r"$^"  # of decimals: we write points
    kept += ["split"] if "split" in columns else []
    cells = (table.texts(columns[name]).fill_null("").str.replace(comma, "$1.$2") for name in kept)
    return {name: dict(zip(kept, row, strict=True)) for name, *row in zip(ids, *cells, strict=True)}


class BoardTables(Record):
    """Tables of a board's images.

    Attributes:
        fit: Poses and camera.
        without: Names of images without a board, and why.
        readings: Joint readings of the images, where there are some.
        units: Of the tables that are written, and of the readings.
        camera_file: The bytes of the camera's file; None if it was estimated.
    """

    fit: BoardFit
    without: Mapping[str, str]
    readings: Readings | None
    units: io.Units
    camera_file: bytes | None

    def __post_init__(self) -> None:
        rows, images = (", ".join(names[:3]) for names in (self.without_image, self.without_row))
        expect(self.used, "configurations", f"no id is the name of an image: {rows}", f"ids such as {images}")

    @property
    def used(self) -> tuple[View, ...]:
        """Images that stand in the tables: those with a row of readings, where there are readings."""
        return tuple(view for view in self.fit.views if self.readings is None or view.name in self.readings)

    @property
    def posed(self) -> tuple[View, ...]:
        """Used images whose pose stands in the table of poses: it is not one of two."""
        return tuple(view for view in self.used if not view.ambiguous)

    @property
    def without_row(self) -> tuple[str, ...]:
        """Images with a board that have no row of readings."""
        return tuple(v.name for v in self.fit.views if self.readings is not None and v.name not in self.readings)

    @property
    def without_image(self) -> tuple[str, ...]:
        """Rows of readings that have no image with a board."""
        seen = {view.name for view in self.fit.views}
        return tuple(name for name in self.readings or () if name not in seen)

    def document(self) -> dict[str, Any]:
        """The document `board.json`: SI, full precision.

        { "schema": "fg-calib/board/1", "version", "board": {keys of its file, in m}, "image_size": [width, height],
          "rms_pixel", "sigma_pixel", "images": [{"id", "n_corners", "rms_pixel", "sigma_pixel", "position",
          "rotation_vector", "covariance", "ambiguous"}], "camera": {parameters},
          "camera_sigma": {parameters} | null, "without_board": {file: reason}, "without_pose": [ids],
          "without_readings": [ids], "without_image": [ids], "findings": [text] }

        """
        fit, arrays = self.fit, ("position", "rotation_vector", "covariance")
        images = [
            {"id": view.name, "n_corners": len(view.corners), "rms_pixel": view.rms, "sigma_pixel": view.sigma}
            | {key: getattr(view, key).tolist() for key in arrays}
            | {"ambiguous": bool(view.ambiguous)}
            for view in fit.views
        ]
        return {
            **{"schema": "fg-calib/board/1", "version": __version__, "board": fit.board.model_dump()},
            **{"image_size": list(fit.size), "rms_pixel": fit.rms, "sigma_pixel": fit.sigma, "images": images},
            **{"camera": asdict(fit.camera), "camera_sigma": fit.camera_sigma, "without_board": dict(self.without)},
            **{"without_pose": list(fit.without_pose), "without_readings": list(self.without_row)},
            **{"without_image": list(self.without_image), "findings": list(fit.findings)},
        }


def write_board_tables(folder: Path, tables: BoardTables) -> tuple[str, ...]:
    """Write `pixels.csv`, `board.csv`, `camera.yaml` and `board.json`, all of them or none.

    Without an image that has one pose alone there is no `board.csv`.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds files of these names that are not of a board.
    """
    fit, words = tables.fit, "# fg-calib board: estimated from the images, in px; 1 sigma\n"
    values = asdict(fit.camera) | {"width": fit.size[0], "height": fit.size[1], "sigma": fit.camera_sigma}
    files: dict[str, Any] = {"board.json": json.dumps(tables.document(), indent=1, allow_nan=False) + "\n"}
    files["pixels.csv"] = partial(io.write_csv, columns=_pixel_columns(tables))
    if tables.posed:
        files["board.csv"] = partial(io.write_csv, columns=_pose_columns(tables))
    files["camera.yaml"] = tables.camera_file or words + yaml.safe_dump(values, sort_keys=False)
    io.fill_folder(folder, files, BOARD_FILES)
    return tuple(sorted(files))


def _row_columns(tables: BoardTables, views: Sequence[View], each: Sequence[int]) -> dict[str, Any]:
    """First columns: id, readings, the board's name; rows of an image repeat as often as `each` says."""
    board = {"board": tables.fit.board.name} if tables.fit.board.name else {}
    rows = [{"id": view.name, **(tables.readings or {}).get(view.name, {}), **board} for view in views]
    return {key: np.repeat([row[key] for row in rows], each) for key in rows[0]}


def _pixel_columns(tables: BoardTables) -> dict[str, Any]:
    views, each = tables.used, [len(view.corners) for view in tables.used]
    uv = np.concatenate([view.uv for view in views])
    corner = np.concatenate([tables.fit.board.corners[view.corners] for view in views]) / tables.units.factor("m")
    columns = _row_columns(tables, views, each)
    columns |= dict(zip(("u", "v", "corner_x", "corner_y"), np.hstack([uv, corner]).T, strict=True))
    return columns | {"sigma_pixel": np.repeat([view.sigma for view in views], each)}


def _pose_columns(tables: BoardTables) -> dict[str, Any]:
    views, length, angle = tables.posed, tables.units.factor("m"), tables.units.factor("rad")
    size = np.repeat([angle, length], 3)
    poses = np.array([[*view.position / length, *view.rotation_vector / angle] for view in views])
    upper = (np.array([view.covariance for view in views]) / np.outer(size, size))[:, *np.triu_indices(6)]
    columns = _row_columns(tables, views, [1] * len(views))
    columns |= dict(zip((*"xyz", "rx", "ry", "rz"), poses.T, strict=True))
    return columns | dict(zip(measurements.COVARIANCE, upper.T, strict=True))
