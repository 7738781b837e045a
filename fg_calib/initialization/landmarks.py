"""Closed-form starting values of what measurements depend on besides the arm: targets, anchors, planes.

From the nominal arm, wherever these are: metres away, or turned by half a turn.

References:
    Gander (1981), Least squares with a quadratic constraint. Numerische Mathematik 36.
"""

import numpy as np

from fg_calib.initialization.hand_eye import Frame, align_points, lifted
from fg_calib.inputs import Floats, Integers, optimize
from fg_calib.robot import nearest_rotation


def targets_from_positions(
    tool: tuple[Floats, Floats], measured: Floats, target: Integers, known: Floats, unknown_frame: bool
) -> tuple[Frame, Floats]:
    """Positions of targets on the tool and, where it is unknown, the measurement frame.

    `X^T (m - x) = p + R t` is linear in X^T, X^T x and every t: the frame's rotation comes from there, then all
    translations together from `m = x + X (p + R t)`.

    Args:
        tool: base_T_tool at the nominal parameters: rotations (n, 3, 3), positions (n, 3), [m].
        measured: Positions of the targets in the measurement frame, shape (n, 3), [m].
        target: Which target each is of, shape (n,).
        known: Places of the targets on the tool, nan where they are to be found, shape (k, 3), [m].
        unknown_frame: Whether world_T_base is to be found; the base is the world otherwise.

    Returns:
        world_T_base, and the targets' places, shape (k, 3); the tool point of those that nothing says.
    """
    R, p = tool
    places = np.where(np.isnan(known), 0.0, known)
    lacking = np.array(np.isnan(known).any(axis=1))
    free = np.unique(target[lacking[target]])
    of = np.full(len(known), -1)
    of[free] = np.arange(len(free))
    n, chosen = len(p), np.flatnonzero(of[target] >= 0)
    lever = np.zeros((n, 3, 3 * len(free)))
    for axis in range(3):
        lever[chosen, :, 3 * of[target[chosen]] + axis] = R[chosen, :, axis]
    at = p + np.einsum("nij,nj->ni", R, places[target])  # with the unknown targets at the tool point
    rotations = [np.eye(3)]
    if unknown_frame:
        A = np.concatenate([lifted(measured), -lever], axis=2).reshape(3 * n, -1)
        found = np.linalg.lstsq(A, at.ravel(), rcond=1e-10)[0]
        by_lift = at + np.einsum("nij,j->ni", lever, found[12:])
        rotations = [align_points(measured, predicted) for predicted in (at, by_lift)]
        rotations.append(nearest_rotation(found[:9].reshape(3, 3).T))
    fits: list[tuple[float, int, Floats, Floats]] = []
    for rotation in rotations:
        rest = measured - at @ rotation.T
        moves = np.tile(np.eye(3), (n, 1, 1)) if unknown_frame else np.zeros((n, 3, 0))
        A = np.concatenate([moves, rotation @ lever], axis=2).reshape(3 * n, -1)
        step = np.linalg.lstsq(A, rest.ravel(), rcond=1e-10)[0] if A.shape[1] else np.zeros(0)
        left = rest.ravel() - A @ step
        fits.append((float(left @ left), len(fits), rotation, step))
    _, _, rotation, step = min(fits)
    shift, moved = np.split(step, [3 if unknown_frame else 0])
    places[free] = moved.reshape(-1, 3)
    return Frame(rotation, shift if unknown_frame else np.zeros(3)), places


MOST_STEPS = 50
"""Of least squares of lengths from a start; lengths that are no lengths would take thousands."""


def anchors_from_lengths(points: Floats, length: Floats, anchor: Integers, at: Floats) -> list[tuple[Integers, Floats]]:
    """Anchors of unknown place from the lengths to tool points.

    `|p|^2 - d^2 = 2 p a - |a|^2` is linear in the anchor a and the last term. Least squares of the lengths follow,
    from there, from its mirror image across the plane that the points are nearest to, and from the points' middle on
    all sides.

    Args:
        points: Tool points at the nominal parameters, shape (n, 3), [m].
        length: Measured, minus what the instrument adds, shape (n,), [m].
        anchor: Coordinates of the anchor that each is to, indices into `at`, shape (n, 3).
        at: Values of all coordinates, nan where they are to be found, [m].

    Returns:
        Coordinates and place of each anchor of unknown place.
    """
    each = [(coordinates, np.all(anchor == coordinates, axis=1)) for coordinates in np.unique(anchor, axis=0)]
    return [(of, _trilaterated(points[rows], length[rows])) for of, rows in each if np.isnan(at[of]).any()]


def offset_from_lengths(points: Floats, length: Floats, anchor: Integers, at: Floats) -> float:
    """Offset that an instrument adds to every length: common to all, explained by no anchors.

    `|p|^2 - d^2 = 2 p a - 2 d c - (|a|^2 - c^2)` is linear in the anchor a, the offset c and the last bracket: with one
    offset for all anchors, a bracket each. Arguments are as of `anchors_from_lengths`.

    Returns:
        The offset, [m].
    """
    columns = [-2.0 * length]
    right = np.sum(points**2, axis=1) - length**2
    for coordinates in np.unique(anchor, axis=0):
        rows, known = np.all(anchor == coordinates, axis=1).astype(np.float64), at[coordinates]
        if np.isnan(known).any():
            columns += [2.0 * rows * points[:, axis] for axis in range(3)]
        else:
            right = right - rows * 2.0 * (points @ known)
        columns.append(-rows)
    A = np.stack(columns, axis=1)
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)  # 0 of an arm that never leaves a plane
    return float((np.linalg.lstsq(A / size, right, rcond=1e-10)[0] / size)[0])


def _trilaterated(points: Floats, length: Floats) -> Floats:
    """The point at measured lengths from others, shape (3,), [m]."""
    middle = points.mean(axis=0)
    about, reach = points - middle, float(np.mean(length))
    A = np.hstack([2.0 * about, -np.ones((len(about), 1))])
    lifted = np.linalg.lstsq(A, np.sum(about**2, axis=1) - length**2, rcond=1e-10)[0][:3]
    across = np.linalg.svd(np.vstack([about, np.zeros((3, 3))]), full_matrices=False)[2][-1]
    mirrored = lifted - 2.0 * (lifted @ across) * across
    starts = np.vstack([lifted, mirrored, reach * np.eye(3), -reach * np.eye(3)])
    return np.asarray(middle + _by_lengths(about, length, starts))


def _by_lengths(points: Floats, length: Floats, starts: Floats) -> Floats:
    """The point of least squares of the lengths that is best of those from some starts, shape (k, 3)."""

    def misses(a: Floats) -> Floats:
        return np.append(np.linalg.norm(a - points, axis=1) - length, np.zeros(3))  # no fewer than coordinates

    def slopes(a: Floats) -> Floats:
        away = a - points
        return np.vstack([away / np.maximum(np.linalg.norm(away, axis=1), 1e-300)[:, None], np.zeros((3, 3))])

    found = [optimize.leastsq(misses, start, Dfun=slopes, full_output=True, maxfev=MOST_STEPS)[0] for start in starts]
    return min(found, key=lambda a: float(np.sum(misses(a) ** 2)))


def plane_from_distances(points: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """A plane from points at given distances from it, as `PlaneDistance` has it: c, and f, shapes (3,), [m].

    Where all distances are the same, such as 0, they do not tell which side of the plane the points are on: the normal
    then points away from the base.

    Args:
        points: Tool points at the nominal parameters, shape (n, 3), [m].
        distance: Measured distances, shape (n,), [m].
    """
    middle, height = points.mean(axis=0), float(distance.mean())
    about = points - middle
    n = _unit_solution(about, distance - height)
    if np.ptp(distance) == 0.0 and n @ middle < 0.0:
        n = -n
    f = middle - height * n
    reach = max(float(np.sqrt(np.max(np.sum(about**2, axis=1)))), 1e-3)
    return f - reach * n, f


def _unit_solution(A: Floats, b: Floats) -> Floats:
    """The unit vector n of the least |A n - b|, of all there are, shape (3,) (Gander 1981).

    It solves (A^T A + m) n = A^T b for the largest m with which |n| = 1, which is no less than minus the least
    eigenvalue of A^T A. With the eigenvectors as axes, and m counted from there, the length falls steadily with m.

    Args:
        A: Shape (n, 3).
        b: Shape (n,).
    """
    values, V = np.linalg.svd(np.vstack([A, np.zeros((3, 3))]), full_matrices=False)[1:]
    above = values**2 - values[2] ** 2
    g = V @ (A.T @ b)
    least = 1e-15 * max(values[0] ** 2, 1e-60)  # rounding: where b says nothing along the third axis n is along it
    g[2] = np.copysign(max(abs(g[2]), least), g[2])
    bounds = 0.5 * abs(g[2]), 2.0 * float(np.linalg.norm(g))
    m = optimize.brentq(lambda m: 1 / np.linalg.norm(g / (above + m)) - 1, *bounds, xtol=1e-14 * least, maxiter=1000)
    n: Floats = V.T @ (g / (above + m))
    return n / np.linalg.norm(n)
