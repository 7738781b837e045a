"""Where a board is, from one image of its points: the start of what cameras measure.

A homography takes the board to the image without its distortion. What it is at the middle of the board, and how it
changes there, leaves two poses (Collins & Bartoli 2014): a board that is small beside its distance looks nearly the
same tilted either way. Both are refined on the pixels by damped Gauss-Newton steps, in front of the camera, and the
better one is first.

A few corners that are far off do not spoil it: the homography is the one of many through four points each that most
points lie near to (least median of squares), and points far beyond what most are off by take no part in the rest.

References:
    Collins, Bartoli (2014), Infinitesimal plane-based pose estimation. IJCV 109(3).
    Hartley (1997), In defense of the eight-point algorithm. IEEE PAMI 19(6): the scaling of the points.
    Rousseeuw, Leroy (1987), Robust regression and outlier detection, ch. 5: least median of squares, its scale.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.initialization.camera import Camera
from fg_calib.initialization.hand_eye import Frame

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

LEAST_CORNERS = 4
"""Points of a board that an image must show."""

STEPS = 30
"""Steps on the pixels, at most."""

UNDISTORTED = 1e-3
"""How near the image of an undistorted point must be to where it was seen, [px]."""

SUBSETS = 60
"""Homographies through four points each that are tried."""

FLAT = 0.02
"""Area of a triangle of points, in squares of the board's size, below which they lie on one line."""

FAR = 3.5
"""Points are far off beyond so many times what most are off by, as a sigma; of clean ones 0.2 % are."""

FARTHEST = 1e4
"""How far a board may be, in its own sizes: beyond that its image says nothing of it."""

LEAST_NOISE = 1e-6
"""What points may be off by without being far off, [sigma]."""


def boards_from_image(camera: Camera, image: Floats, sigma: Floats | None = None) -> list[tuple[float, Frame]]:
    """Every camera_T_board that explains the image of a board's points, the best first.

    Args:
        camera: What the camera does to what it sees.
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
    focal = np.array([camera.fx, camera.fy])
    H, near = _homography(image[there, 2:], seen[there], focal * weight[there])
    kept = np.flatnonzero(there)[near]
    if H is None or not _spread(image[kept, 2:]):
        return []
    found: list[tuple[float, int, Frame]] = []
    for start in _two_poses(H, image[kept, 2:], seen[kept]):
        one = _refined_on_most(camera, image, weight, start, kept)
        if one is not None:
            found.append((one[0], len(found), one[1]))
    farthest = FARTHEST * np.abs(image[:, 2:]).max()
    return [(cost, frame) for cost, _, frame in sorted(found) if np.abs(frame.translation).max() < farthest]


def _spread(points: Floats) -> bool:
    """Whether there are four points or more that are not on one line."""
    about = points - points.mean(axis=0) if len(points) else points
    return len(points) >= LEAST_CORNERS and bool(
        np.linalg.svd(about, compute_uv=False)[1] > 1e-3 * np.abs(about).max(initial=0.0)
    )


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


def _homography(points: Floats, seen: Floats, weight: Floats) -> tuple[Floats | None, Booleans]:
    """The homography that most points lie near to, shape (3, 3), and which these are; None if there is none.

    Args:
        points: On the board, shape (n, 2), [m].
        seen: x / z and y / z, shape (n, 2).
        weight: One over sigma of these, shape (n, 2).
    """
    n, every = len(points), np.ones(len(points), dtype=np.bool_)
    if n <= LEAST_CORNERS + 1:  # nothing tells which one is off
        return _by_lines(points, seen, weight), every
    fours = _fours(points)
    tried = _through_four(points[fours], seen[fours])
    if len(tried):
        off = _misses(tried, points, seen, weight)
        rank = n // 2 + LEAST_CORNERS // 2 - 1  # half of those that four points do not decide
        typical = np.sort(off, axis=1)[:, rank]
        best = int(np.argmin(typical))
        scale = _SIGMAS * (1.0 + 5.0 / (n - LEAST_CORNERS)) * typical[best]
        every = off[best] <= max(FAR * scale, LEAST_NOISE)
    return _by_lines(points[every], seen[every], weight[every]), every


_SIGMAS = 1.0 / np.sqrt(2.0 * np.log(2.0))
"""A sigma in medians of the length of two coordinates' noise (Rayleigh's)."""


def _fours(points: Floats) -> NDArray[np.int64]:
    """Sets of four points, no three of them on one line, shape (n, 4): all, or a fixed choice of them."""
    n = len(points)
    if n <= 9:
        fours = np.array(list(combinations(range(n), LEAST_CORNERS)))
    else:
        fours = np.argsort(np.random.default_rng(0).random((3 * SUBSETS, n)), axis=1)[:, :LEAST_CORNERS]
    size = np.ptp(points, axis=0).max()
    areas = []
    for three in combinations(range(LEAST_CORNERS), 3):
        a, b, c = (points[fours[:, k]] for k in three)
        (x1, y1), (x2, y2) = (b - a).T, (c - a).T
        areas.append(np.abs(x1 * y2 - x2 * y1))
    chosen: NDArray[np.int64] = fours[np.min(areas, axis=0) > FLAT * size**2][:SUBSETS]
    return chosen


def _through_four(points: Floats, seen: Floats) -> Floats:
    """The homographies through four points each, the entry at their end being 1, shape (k, 3, 3).

    Args:
        points: On the board, shape (k, 4, 2), [m].
        seen: x / z and y / z, shape (k, 4, 2).
    """
    k = len(points)
    A, right = np.zeros((k, 8, 8)), seen.transpose(0, 2, 1).reshape(k, 8)
    for axis, rows in enumerate((slice(0, 4), slice(4, 8))):
        A[:, rows, 3 * axis : 3 * axis + 2], A[:, rows, 3 * axis + 2] = points, 1.0
        A[:, rows, 6:] = -seen[:, :, axis, None] * points
    size = np.abs(A).max(axis=1, initial=1e-300)
    whole = np.linalg.svd(A / size[:, None], compute_uv=False)
    sound = whole[:, -1] > 1e-12 * whole[:, 0]
    found = np.linalg.solve(A[sound] / size[sound, None], right[sound, :, None])[:, :, 0] / size[sound]
    return np.concatenate([found, np.ones((len(found), 1))], axis=1).reshape(-1, 3, 3)


def _misses(H: Floats, points: Floats, seen: Floats, weight: Floats) -> Floats:
    """How far off points are by homographies, in sigma, shape (k, n); infinite of those behind the camera."""
    p = np.column_stack([points, np.ones(len(points))]) @ H.transpose(0, 2, 1)
    ahead = p[:, :, 2] > 1e-12
    off = (p[:, :, :2] / np.where(ahead, p[:, :, 2], 1.0)[:, :, None] - seen) * weight
    miss: Floats = np.where(ahead, np.sqrt(np.sum(off * off, axis=2)), np.inf)
    return miss


def _by_lines(points: Floats, seen: Floats, weight: Floats) -> Floats | None:
    """The homography of all points by linear least squares (DLT), of points about their middle and of size 1."""
    (p, P), (s, S) = (_scaled(v) for v in (points, seen))
    ones, zeros, w = np.ones((len(p), 1)), np.zeros((len(p), 3)), weight / weight.mean()
    p = np.hstack([p, ones])
    A = np.vstack(
        [
            w[:, :1] * np.hstack([p, zeros, -s[:, :1] * p]),
            w[:, 1:] * np.hstack([zeros, p, -s[:, 1:] * p]),
        ]
    )
    H = np.linalg.inv(S) @ np.linalg.svd(A, full_matrices=True)[2][-1].reshape(3, 3) @ P
    middle = H @ np.append(points.mean(axis=0), 1.0)
    return H / middle[2] if abs(middle[2]) > 1e-12 * np.abs(H).max() else None


def _scaled(points: Floats) -> tuple[Floats, Floats]:
    """Points about their middle and of size 1 (Hartley 1997), and the matrix that makes them so."""
    middle = points.mean(axis=0)
    size = np.sqrt(2.0) / max(float(np.mean(np.linalg.norm(points - middle, axis=1))), 1e-300)
    return (points - middle) * size, np.array(
        [[size, 0.0, -size * middle[0]], [0.0, size, -size * middle[1]], [0.0, 0.0, 1.0]]
    )


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
    towards = _turned_towards(np.append(v, 1.0))
    U, s, Vt = np.linalg.svd(np.linalg.solve(towards[:2, :2] - np.outer(v, towards[2, :2]), J))
    share, found = s[1] / s[0], []
    for side in (1.0, -1.0):
        columns = np.vstack([U @ np.diag([1.0, share]) @ Vt, side * np.sqrt(1.0 - share**2) * Vt[1]])
        R = towards @ np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])
        found.append(Frame(R, _place(R, points, seen)))
    return found


def _turned_towards(direction: Floats) -> Floats:
    """The rotation that takes z to a direction ahead, shape (3, 3)."""
    angle = np.arctan2(np.linalg.norm(direction[:2]), direction[2])
    axis = np.array([-direction[1], direction[0], 0.0]) / max(float(np.linalg.norm(direction[:2])), 1e-300)
    rotation: Floats = Rotation.from_rotvec(angle * axis).as_matrix()
    return rotation


def _place(R: Floats, points: Floats, seen: Floats) -> Floats:
    """Where a board with a known rotation is: `(R p + t)` is along what is seen, linear in t, shape (3,), [m]."""
    p, n = points @ R[:, :2].T, len(points)
    A, right = np.zeros((2 * n, 3)), (seen * p[:, 2:] - p[:, :2]).T.ravel()
    A[:n, 0], A[n:, 1], A[:, 2] = 1.0, 1.0, -seen.T.ravel()
    return np.linalg.lstsq(A, right, rcond=1e-12)[0].astype(np.float64)


def _refined_on_most(
    camera: Camera, image: Floats, weight: Floats, start: Frame, kept: NDArray[np.int64]
) -> tuple[float, Frame] | None:
    """A pose refined on some points, then on all that are not far beyond what most are off by; its cost first.

    What is left out costs as much as the farthest that is not. Three points decide a pose.
    """
    n, limit = len(image), np.inf
    found = _refined(camera, image[kept], weight[kept], start)
    if found is not None and n > LEAST_CORNERS + 1:
        there = image[:, 2:] @ found[1].rotation[:, :2].T + found[1].translation
        off = np.linalg.norm((camera.image(there)[0] - image[:, :2]) * weight, axis=1)
        off[there[:, 2] <= 0.0] = np.inf
        limit = max(FAR * _SIGMAS * (1.0 + 5.0 / (n - 3)) * float(np.partition(off, n // 2)[n // 2]), LEAST_NOISE)
        near = np.flatnonzero(off <= limit)
        if not np.array_equal(near, kept):
            kept = near
            found = _refined(camera, image[kept], weight[kept], found[1]) if _spread(image[kept, 2:]) else None
    if found is None:
        return None
    left_out = n - len(kept)
    return found[0] + (left_out * limit**2 if left_out and np.isfinite(limit) else 0.0), found[1]


def _refined(camera: Camera, image: Floats, weight: Floats, start: Frame) -> tuple[float, Frame] | None:
    """Damped Gauss-Newton steps on the pixels, every point ahead of the camera; the cost and the pose.

    None where a point is not ahead at the start.
    """
    points = np.column_stack([image[:, 2:], np.zeros(len(image))])

    def misses(frame: Frame) -> tuple[float, Floats, Floats]:
        turned = points @ frame.rotation.T
        there = turned + frame.translation
        if there[:, 2].min() <= 0.0:
            return np.inf, there, there
        found, J = camera.image(there)
        r = ((found - image[:, :2]) * weight).ravel()
        of_turn = np.cross(turned[:, None], J)  # -J [turned]x
        moves = np.concatenate([of_turn, J], axis=2) * weight[:, :, None]
        return float(r @ r), r, moves.reshape(-1, 6)

    frame, damping = start, 1e-6
    cost, r, J = misses(frame)
    if not np.isfinite(cost):
        return None
    for _ in range(STEPS):
        A = J.T @ J
        step = -np.linalg.solve(A + damping * np.diag(np.diag(A)) + 1e-300 * np.eye(6), J.T @ r)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        tried = Frame(turn @ frame.rotation, frame.translation + step[3:])
        least, r_new, J_new = misses(tried)
        if least < cost:
            gain, frame, cost, r, J, damping = cost - least, tried, least, r_new, J_new, 0.1 * damping
            if gain < 1e-9 * cost:
                break
        elif damping > 1e6 or np.abs(step).max() < 1e-13:
            break
        else:
            damping = max(10.0 * damping, 1e-6)
    return cost, frame
