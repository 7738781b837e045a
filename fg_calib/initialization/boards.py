"""Pose of a board from one image of its points: the start of what cameras measure.

A homography takes the board to the image without its distortion. What it is at the middle of the board, and how it
changes there, leaves two poses (Collins & Bartoli 2014): a board that is small against its distance looks nearly the
same tilted either way. Both are refined on the pixels by least squares: on the half of the points that is nearest, then
on all that are not far beyond what most are off by. The better one is first.

References:
    Collins, Bartoli (2014), Infinitesimal plane-based pose estimation. IJCV 109(3).
    Hartley (1997), In defense of the eight-point algorithm. IEEE PAMI 19(6): the scaling of the points.
    Rousseeuw, Leroy (1987), Robust regression and outlier detection, ch. 5: scale from a median.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization.camera import Camera
from fg_calib.initialization.hand_eye import Frame
from fg_calib.inputs import Booleans, Floats, optimize
from fg_calib.robot import left_jacobian, rotations

LEAST_CORNERS = 4
"""Points of a board that an image must show."""

UNDISTORTED = 1e-3
"""How near the image of an undistorted point must be to where it was seen, [px]."""

FAR = 3.5
"""Points are far off beyond so many times what most are off by, as a sigma; of clean ones 0.2 % are."""

FARTHEST = 1e4
"""How far a board may be, in its own sizes: beyond that its image says nothing of it."""

MAX_ROUNDS = 10
"""Refinements of a pose on the points that are left, at most."""

HALVINGS = 3
"""The first of them are on the half of the points that is nearest (least trimmed squares)."""

LEAST_NOISE = 1e-6
"""Noise that points may have without being far off, [sigma]."""


def boards_from_image(camera: Camera, image: Floats, sigma: Floats | None = None) -> list[tuple[float, Frame]]:
    """Every camera_T_board that explains the image of a board's points, the best first.

    Args:
        camera: The camera's model.
        image: u and v, [px], and where the point is on the board, x and y, [m], shape (n, 4).
        sigma: 1 sigma of u and v, shape (n, 2), [px]; 1 pixel if None.

    Returns:
        Of each its sum of squared residuals over sigma, points far off left out. None of fewer than four points, of
        points on one line, or of an image that no board in front of the camera has.
    """
    weight = np.ones((len(image), 2)) if sigma is None else 1.0 / sigma
    seen, there = undistorted(camera, image[:, :2])
    if not _spread(image[there, 2:]) or not np.ptp(seen[there], axis=0).any():
        return []
    if (H := _homography(image[there, 2:], seen[there], weight[there] * [camera.fx, camera.fy])) is None:
        return []
    starts = _two_poses(H, image[there, 2:], seen[there])
    refined = (_refined_on_most(camera, image[there], weight[there], start) for start in starts)
    found = sorted((pose for pose in refined if pose is not None), key=lambda pose: pose[0])
    farthest = FARTHEST * np.abs(image[:, 2:]).max()
    return [(cost, frame) for cost, frame in found if np.abs(frame.translation).max() < farthest]


def _spread(points: Floats) -> bool:
    """Whether there are four points or more that are not on one line."""
    about = points - points.mean(axis=0) if len(points) else points
    return len(points) >= LEAST_CORNERS and bool(np.linalg.matrix_rank(about, 1e-3 * np.abs(about).max()) == 2)


def undistorted(camera: Camera, pixels: Floats) -> tuple[Floats, Booleans]:
    """The place x / z and y / z of what is seen at pixels, shape (n, 2), and of which of them there is such a thing.

    Newton steps from no distortion, checked: far from the axis a distortion may have an image of no point, or of two,
    of which only the one is meant up to which the image grows with the angle.
    """
    x = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    there = np.ones(len(x), dtype=np.bool_)
    for _ in range(20):
        found, J = camera.image(np.column_stack([x, np.ones(len(x))]))
        off, (a, b), (c, d) = found - pixels, J[:, 0, :2].T, J[:, 1, :2].T
        determinant = a * d - b * c
        there = (determinant > 0.0) & (a > 0.0) & np.isfinite(off).all(axis=1)
        step = np.column_stack([d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]])
        step[there] /= determinant[there, None]
        step[~there] = 0.0
        if np.abs(step).max(initial=0.0) < 1e-14:
            break
        x = x - np.clip(step, -0.5, 0.5)
    return x, there & (np.abs(off).max(axis=1, initial=0.0) < UNDISTORTED)


def _homography(points: Floats, seen: Floats, weight: Floats) -> Floats | None:
    """The homography of all points by linear least squares (DLT), of points about their middle and of size 1."""
    (p, P), (s, S) = (_scaled(v) for v in (points, seen))
    ones, zeros, w = np.ones((len(p), 1)), np.zeros((len(p), 3)), weight / weight.mean()
    p = np.hstack([p, ones])
    A = np.vstack([w[:, :1] * np.hstack([p, zeros, -s[:, :1] * p]), w[:, 1:] * np.hstack([zeros, p, -s[:, 1:] * p])])
    H = np.linalg.inv(S) @ np.linalg.svd(A, full_matrices=True)[2][-1].reshape(3, 3) @ P
    middle = H @ np.append(points.mean(axis=0), 1.0)
    return H / middle[2] if abs(middle[2]) > 1e-12 * np.abs(H).max() else None


def _scaled(points: Floats) -> tuple[Floats, Floats]:
    """Points about their middle and of size 1 (Hartley 1997), and the matrix that makes them so."""
    middle = points.mean(axis=0)
    size = np.sqrt(2.0) / max(float(np.mean(np.linalg.norm(points - middle, axis=1))), 1e-300)
    M = np.array([[size, 0.0, -size * middle[0]], [0.0, size, -size * middle[1]], [0.0, 0.0, 1.0]])
    return (points - middle) * size, M


def _two_poses(H: Floats, points: Floats, seen: Floats) -> list[Frame]:
    """The two poses of a board that a homography leaves, by what it is about its middle (Collins & Bartoli 2014).

    Args:
        H: From the board to x / z and y / z, shape (3, 3), positive ahead of the camera.
        points: On the board, shape (n, 2), [m].
        seen: x / z and y / z, shape (n, 2).
    """
    at = H @ np.append(points.mean(axis=0), 1.0)
    v = at[:2] / at[2]
    J = (H[:2, :2] - np.outer(v, H[2, :2])) / at[2]  # of x / z and y / z in the board's x and y, at its middle
    ahead = np.append(v, 1.0)
    towards = rotations.least_rotation(ahead / np.linalg.norm(ahead))
    U, s, Vt = np.linalg.svd(np.linalg.solve(towards[:2, :2] - np.outer(v, towards[2, :2]), J))
    share, found = s[1] / s[0], []
    for side in (1.0, -1.0):
        columns = np.vstack([U @ np.diag([1.0, share]) @ Vt, side * np.sqrt(1.0 - share**2) * Vt[1]])
        R = towards @ np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])
        found.append(Frame(R, _place(R, points, seen)))
    return found


def _place(R: Floats, points: Floats, seen: Floats) -> Floats:
    """Position of a board of known rotation: `(R p + t)` is along what is seen, linear in t, shape (3,), [m]."""
    p, n = points @ R[:, :2].T, len(points)
    A, right = np.zeros((2 * n, 3)), (seen * p[:, 2:] - p[:, :2]).T.ravel()
    A[:n, 0], A[n:, 1], A[:, 2] = 1.0, 1.0, -seen.T.ravel()
    return np.linalg.lstsq(A, right, rcond=1e-12)[0].astype(np.float64)


def _refined_on_most(camera: Camera, image: Floats, weight: Floats, start: Frame) -> tuple[float, Frame] | None:
    """A pose refined on the points that are not far beyond what most are off by; its cost first.

    What is left out costs as much as the farthest that is not. None where a point is not ahead of the camera.
    """
    n, frame = len(image), start
    kept, limit = np.arange(n), np.inf
    for step in range(MAX_ROUNDS):
        refined = refine_board(camera, image[kept], weight[kept], frame)
        if refined is None:
            return None
        frame = refined
        there = image[:, 2:] @ frame.rotation[:, :2].T + frame.translation
        off = np.linalg.norm((camera.image(there)[0] - image[:, :2]) * weight, axis=1)
        off[there[:, 2] <= 0.0] = np.inf
        if n <= LEAST_CORNERS + 1:  # nothing tells which one is off
            break
        sigma = (1.0 + 5.0 / (n - 3)) * float(np.median(off)) / np.sqrt(2.0 * np.log(2.0))  # Rayleigh's median
        limit = max(FAR * sigma, LEAST_NOISE)
        near = np.sort(np.argsort(off)[: n // 2 + 2]) if step < HALVINGS else np.flatnonzero(off <= limit)
        if np.array_equal(near, kept) or not _spread(image[near, 2:]):
            break
        kept = near
    return float(np.sum(np.minimum(off, limit) ** 2)), frame


def refine_board(camera: Camera, image: Floats, weight: Floats, start: Frame) -> Frame | None:
    """The pose of least squares on the pixels; None where a point is not ahead of the camera."""
    points = image[:, 2:] @ start.rotation[:, :2].T
    if np.min(points[:, 2] + start.translation[2]) <= 0.0:
        return None

    def turned(x: Floats) -> Floats:
        return points @ Rotation.from_rotvec(x[:3]).as_matrix().T

    def misses(x: Floats) -> Floats:
        return ((camera.image(turned(x) + x[3:])[0] - image[:, :2]) * weight).ravel()

    def derivatives(x: Floats) -> Floats:
        J = camera.image(turned(x) + x[3:])[1] * weight[:, :, None]
        turns = np.cross(turned(x)[:, None], J) @ left_jacobian(x[None, :3])[0]
        return np.concatenate([turns, J], axis=2).reshape(-1, 6)

    x = optimize.leastsq(misses, np.append(np.zeros(3), start.translation), Dfun=derivatives, full_output=True)[0]
    if np.min(turned(x)[:, 2] + x[5]) <= 0.0:
        return None
    return Frame(Rotation.from_rotvec(x[:3]).as_matrix() @ start.rotation, x[3:])
