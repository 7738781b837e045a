"""Poses of a board in the camera's frame, the camera itself, and how well corners say both.

With R, t the board and c a corner on it, `t + R c` is where it is in the camera's frame, and `Camera.image` where it is
seen. A turn w of the board about its origin and a shift dt, both along the camera's axes, move its image by
`J_image (w x R c + dt)`: these are the rows of `RoomPixel`, and the axes of `BoardPose`, so that the covariance of
(w, dt), orientation first, is what a table's columns `cov_11 ... cov_66` hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.importers.opencv import UNDETERMINED, CalibrationBoard, both_poses, camera_derivatives, first_camera
from fg_calib.inputs import Floats, InputError, Integers
from fg_calib.measurements import Frames, RoomPixel
from fg_calib.measurements.kinds import Camera

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""A camera's parameters, in the order of its covariance."""

PRIOR_RESIDUALS = 10
"""How many residuals of its own weigh as much in an image's sigma as those of all images."""

MAX_CHI2_DIFFERENCE = 10.8
"""Chi-square by which a second pose may fit worse and still be the true one: its 99.9 % point."""

MAX_RMS_RATIO = 3.0
"""RMS of an image's residuals over the median of all from which it is poor: blur, or a board that is not flat."""

MAX_RMS_SHARE = 0.002
"""RMS of all residuals, in diagonals of the image, that no lens unlike its model leaves: a camera of other images."""

MAX_FOCAL_SIGMA = 0.01
"""Sigma of a focal length over itself above which it is hardly determined: distances are wrong by as much."""


class Corners(NamedTuple):
    """Corners found in an image.

    Attributes:
        name: What the image is called.
        corners: Which corners of the board, shape (n,).
        uv: Where they are seen, shape (n, 2), [px].
    """

    name: str
    corners: Integers
    uv: Floats


@dataclass(frozen=True)
class View:
    """A board in an image.

    Attributes:
        name: What the image is called.
        corners: Which of its corners are seen, shape (n,).
        uv: Where, shape (n, 2), [px].
        rotation: Its axes in the camera's frame, camera_R_board, shape (3, 3).
        position: Its origin there, shape (3,), [m].
        rms: Of the residuals, [px].
        sigma: Of a corner along each axis of the image, [px].
        covariance: Of its pose along and about the camera's axes, orientation first, shape (6, 6), [rad] and [m], with
            the camera taken as known.
        by_camera: What the camera's own covariance adds to it, in all images together; 0 for a camera that was given.
        ambiguous: Whether a second pose, tilted the other way, explains its corners nearly as well.
        poor: Whether its residuals are much larger than those of other images.
    """

    name: str
    corners: Integers
    uv: Floats
    rotation: Floats
    position: Floats
    rms: float
    sigma: float
    covariance: Floats
    by_camera: Floats
    ambiguous: bool
    poor: bool

    @property
    def rotation_vector(self) -> Floats:
        """`rotation` as an axis times an angle, shape (3,), [rad]."""
        return Rotation.from_matrix(self.rotation.copy()).as_rotvec()


@dataclass(frozen=True)
class BoardFit:
    """A board in some images, and the camera.

    Attributes:
        board: The board.
        size: Width and height of the images, [px].
        camera: The camera.
        camera_covariance: Of its `INTRINSICS`, shape (9, 9); None for a camera that was given.
        views: The board in each image.
        without_pose: Names of images that no pose explains.
        rms: Of all residuals, [px].
        sigma: Of a corner along each axis of the image, in the mean of all images, [px].
    """

    board: CalibrationBoard
    size: tuple[int, int]
    camera: Camera
    camera_covariance: Floats | None
    views: tuple[View, ...]
    without_pose: tuple[str, ...]
    rms: float
    sigma: float

    @property
    def camera_sigma(self) -> dict[str, float] | None:
        """1 sigma of each of the camera's parameters; None for a camera that was given."""
        C = self.camera_covariance
        return None if C is None else dict(zip(INTRINSICS, np.sqrt(np.diag(C)).tolist(), strict=True))

    @property
    def moved_by_camera(self) -> float:
        """Largest 1 sigma by which the error of the camera moves boards, [m]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(view.by_camera[3:, 3:])[-1] for view in self.views)))

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


@dataclass(frozen=True)
class _Fit:
    """Least squares of one image: squared residuals, and derivatives by pose, (2 n, 6), and by the camera, (2 n, 9)."""

    pose: tuple[Floats, Floats]
    squares: float
    J: Floats
    K: Floats
    second: float = np.inf

    @property
    def information(self) -> Floats:
        """Of the pose, for corners of sigma 1 px, shape (6, 6)."""
        A: Floats = self.J.T @ self.J
        return A

    @property
    def shift(self) -> Floats:
        """What an error of the camera's parameters does to the pose, shape (6, 9)."""
        return np.asarray(np.linalg.solve(self.information, -self.J.T @ self.K), dtype=np.float64)

    @property
    def camera_information(self) -> Floats:
        """Of the camera's parameters, for corners of sigma 1 px and an unknown pose, shape (9, 9)."""
        rest = self.K + self.J @ self.shift
        return rest.T @ rest


def fit_board(
    board: CalibrationBoard, found: Sequence[Corners], size: tuple[int, int], camera: Camera | None = None
) -> BoardFit:
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
    given = camera is not None
    points = {one.name: board.corners[one.corners] for one in found}
    if camera is None:
        camera = first_camera(list(points.values()), [one.uv for one in found], size)
    fits = {one.name: fit for one in found if (fit := _fit(camera, points[one.name], one.uv)) is not None}
    if not fits:
        raise InputError("images", "corners that no pose of the board explains", "images of this board by this camera")
    seen = np.array([fit.camera_information for fit in fits.values()])  # (n_images, 9, 9)
    C = np.zeros((9, 9)) if given else _scaled_inverse(seen.sum(axis=0))
    taken = {name: 6.0 + float(np.sum(fit.camera_information * C)) for name, fit in fits.items()}
    squares = sum(fit.squares for fit in fits.values())
    variance = squares / sum(len(fit.J) - taken[name] for name, fit in fits.items())
    own = {name: (fit.squares + PRIOR_RESIDUALS * variance) / (len(fit.J) - taken[name] + PRIOR_RESIDUALS)
           for name, fit in fits.items()}  # fmt: skip
    C = C @ sum(own[name] * fit.camera_information for name, fit in fits.items()) @ C
    typical = float(np.median([np.sqrt(fit.squares / len(fit.J)) for fit in fits.values()]))
    kept = [one for one in found if one.name in fits]
    return BoardFit(
        board=board,
        size=size,
        camera=camera,
        camera_covariance=None if given else C,
        views=tuple(_view(one, fits[one.name], own[one.name], C, typical) for one in kept),
        without_pose=tuple(one.name for one in found if one.name not in fits),
        rms=float(np.sqrt(squares / sum(len(fit.J) for fit in fits.values()))),
        sigma=float(np.sqrt(variance)),
    )


def _view(one: Corners, fit: _Fit, variance: float, C: Floats, typical: float) -> View:
    rms = float(np.sqrt(fit.squares / len(fit.J)))
    return View(
        *one,
        *fit.pose,
        rms=rms,
        sigma=float(np.sqrt(variance)),
        covariance=variance * _scaled_inverse(fit.information),
        by_camera=fit.shift @ C @ fit.shift.T,
        ambiguous=fit.second - fit.squares < MAX_CHI2_DIFFERENCE * variance,
        poor=rms > MAX_RMS_RATIO * typical,
    )


def _fit(camera: Camera, points: Floats, uv: Floats) -> _Fit | None:
    """The better of the poses that explain some corners, and how well the other one does; None if there is none."""
    fits = [_rows(camera, points, uv, R, t) for R, t in both_poses(points, uv, camera)]
    fits = [fit for fit in fits if np.isfinite(fit.squares) and np.linalg.matrix_rank(fit.J) == 6]
    if not fits:
        return None
    best, *others = sorted(fits, key=lambda fit: fit.squares)
    apart = (fit for fit in others if not np.allclose(fit.pose[0], best.pose[0], rtol=0.0, atol=1e-4))
    return replace(best, second=min((fit.squares for fit in apart), default=np.inf))


def _rows(camera: Camera, points: Floats, uv: Floats, R: Floats, t: Floats) -> _Fit:
    """Residuals at a pose, and their derivatives."""
    n = len(points)
    at = Frames(np.broadcast_to(R, (n, 1, 3, 3)), np.broadcast_to(t, (n, 1, 3)))
    rows = RoomPixel(camera).rows(at, np.column_stack([uv, points]), np.empty((n, 0)))
    K = camera_derivatives(camera, t + points @ R[:, :2].T)
    return _Fit((R, t), float(np.sum(rows.residual**2)), rows.wrenches.reshape(2 * n, 6), K.reshape(2 * n, 9))


def _scaled_inverse(A: Floats) -> Floats:
    """The inverse of an information matrix whose unknowns have different units.

    Raises:
        InputError: It has none.
    """
    size = np.sqrt(np.diag(A))
    try:
        L = np.linalg.inv(np.linalg.cholesky(A / np.outer(size, size))) / size
    except np.linalg.LinAlgError:
        raise InputError(*UNDETERMINED) from None
    C: Floats = L.T @ L
    return C
