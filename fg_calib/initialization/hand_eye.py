"""Closed-form starting values of the frames: where the robot stands in the measurement frame, where its tool is.

With X = world_T_base, F = base_T_flange and T = flange_T_tool every measured pose says X F T = measured. The rotations
come first, from the largest singular vectors of a Kronecker sum (Shah 2013) or by averaging where one of the two is
known; the translations are then a linear least-squares problem. Positions alone, and distances alone, are made
linear by lifting. What the data leave open stays at nominal (minimum-norm least squares).

References:
    Shah (2013), Solving the robot-world/hand-eye calibration problem using the Kronecker product. J. Mechanisms
    and Robotics 5(3).
    Umeyama (1991), Least-squares estimation of transformation parameters between two point patterns. IEEE PAMI 13(4).
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Booleans, Floats, Integers, Record
from fg_calib.robot import nearest_rotation, rotation_angle

LEAST_TURN = 1e-6
"""Turns of the tool that show nothing of where its point is, [rad]: rounding would put that 1e12 m away."""

MAX_ROWS = 2000
"""Poses used for a start: more do not make it better."""

FAR_OFF = 6.0
"""A pose is wrong if it is off by so many times what half of them are."""

LEAST_OFF = 1e-6
"""Error that poses may have without being wrong, [m] and [rad]."""

MOST_ROUNDS = 10
"""Times that poses are chosen and left out."""


class Frame(Record):
    """A rotation, shape (3, 3), and a translation, shape (3,), [m]."""

    rotation: Floats
    translation: Floats


Poses = tuple[Floats, Floats]
"""Rotations, shape (n, 3, 3), and translations, shape (n, 3), [m]."""

Frames = tuple[Frame, Frame]
"""World_T_base and flange_T_tool."""


class Unknown(Record):
    """Parts of the two frames to be found.

    Attributes:
        frame: Whether world_T_base is.
        tool_rotation: Whether the tool's rotation is.
        tool_translation: Which coordinates of the tool point are, shape (3,).
    """

    frame: bool
    tool_rotation: bool
    tool_translation: Booleans

    @property
    def anything(self) -> bool:
        """Whether there is something to find."""
        return self.frame or self.tool_rotation or bool(self.tool_translation.any())


def start_from_poses(
    flange: Poses, measured: tuple[Floats | None, Floats | None], nominal: Frames, unknown: Unknown
) -> Frames:
    """World_T_base and flange_T_tool from measured poses, positions or orientations.

    Args:
        flange: base_T_flange at the nominal parameters: rotations (n, 3, 3), translations (n, 3), [m].
        measured: world_T_tool: rotations (n, 3, 3) and positions (n, 3), either None where not measured.
        nominal: world_T_base and flange_T_tool as they are known so far.
        unknown: Unknowns to find.
    """
    X, T = nominal
    R_F, p_F = (v[:MAX_ROWS] for v in flange)
    R_M, p_M = (None if v is None else v[:MAX_ROWS] for v in measured)
    candidates = [(X.rotation, T.rotation)]
    if R_M is not None:
        candidates = _rotations(R_F, R_M, X.rotation, T.rotation, unknown)
        if len(candidates) > 1 and p_M is not None:
            aligned = _frame_rotations(R_F, p_F, p_M, T.translation, unknown)
            candidates += [(R, _tool_rotation(R_F, R_M, R)) for R in aligned]
    elif unknown.frame and p_M is not None:
        candidates = [(R, T.rotation) for R in _frame_rotations(R_F, p_F, p_M, T.translation, unknown)]
    return _with_translations((R_F, p_F), p_M, candidates, nominal, unknown)


def start_from_most_poses(flange: Poses, choices: Poses, nominal: Frames, unknown: Unknown) -> Frames:
    """`start_from_poses` of poses that may each be one of several, or wrong.

    In turns each is taken as what frame and tool say that it is, and those that are far beyond what most are off by
    are left out, until nothing changes.

    Args:
        flange: base_T_flange at the nominal parameters: rotations (n, 3, 3), translations (n, 3), [m].
        choices: world_T_tool: rotations (n, k, 3, 3) and positions (n, k, 3), the likeliest of each first.
        nominal: world_T_base and flange_T_tool as they are known so far.
        unknown: Unknowns to find.
    """
    (R_F, p_F), (R_M, p_M) = ((v[:MAX_ROWS] for v in each) for each in (flange, choices))
    n = np.arange(len(R_F))
    chosen, kept = np.zeros(len(n), dtype=np.int64), np.ones(len(n), dtype=np.bool_)
    for _ in range(MOST_ROUNDS):
        measured = R_M[n, chosen][kept], p_M[n, chosen][kept]
        X, T = start_from_poses((R_F[kept], p_F[kept]), measured, nominal, unknown)
        R, p = X.rotation @ R_F @ T.rotation, (p_F + R_F @ T.translation) @ X.rotation.T + X.translation
        off = np.stack([np.linalg.norm(R_M - R[:, None], axis=(2, 3)), np.linalg.norm(p_M - p[:, None], axis=2)])
        typical = np.maximum(np.median(off[:, n, chosen], axis=1), LEAST_OFF)
        score = (off / typical[:, None, None]).max(axis=0)
        last = chosen, kept
        chosen = np.argmin(score, axis=1)
        kept = score[n, chosen] <= FAR_OFF
        if 2 * np.sum(kept) < len(n) or all(map(np.array_equal, last, (chosen, kept))):
            break
    return X, T


def start_from_distances(flange: Poses, ends: Integers, distance: Floats, tool: Frame, free: Booleans) -> Frame:
    """The tool point from distances alone.

    `|dp + dR t|^2 = d^2` is linear in t and the six products of its coordinates; a few Gauss-Newton steps on the
    distances themselves follow, from there and from the nominal tool point, and the better one is taken.

    Args:
        flange: base_T_flange at the nominal parameters: rotations (n, 3, 3), translations (n, 3), [m].
        ends: Configurations of each pair, shape (m, 2).
        distance: Measured distances, shape (m,), [m].
        tool: The nominal tool frame.
        free: Which coordinates of the tool point are unknown, shape (3,).
    """
    a, b = ends[:MAX_ROWS].T
    distance = distance[:MAX_ROWS]
    dR, dp = flange[0][b] - flange[0][a], flange[1][b] - flange[1][a]  # (m, 3, 3), (m, 3)
    starts = [tool.translation]
    if free.all() and len(a) >= 9:
        Q = np.einsum("mki,mkj->mij", dR, dR)
        i, j = np.triu_indices(3)
        A = np.hstack([2.0 * np.einsum("mk,mki->mi", dp, dR), Q[:, i, j] * np.where(i == j, 1.0, 2.0)])
        starts.append(_seen(A, distance**2 - np.sum(dp**2, axis=1))[:3])
    fits = [_tool_point_by_distances(dR, dp, distance, t, free) for t in starts]
    return Frame(tool.rotation, min(fits, key=lambda fit: fit[1])[0])


def start_from_touches(flange: Poses, touched: Integers, nominal: Floats, free: Booleans) -> Floats:
    """The tool point that brings touches of each point nearest together, from the nominal one, shape (3,), [m].

    Args:
        flange: base_T_flange: rotations (n, 3, 3), translations (n, 3), [m].
        touched: Which point each touched, shape (n,).
        nominal: The nominal tool point, [m].
        free: Which of its coordinates are unknown, shape (3,).
    """
    A, b = [np.zeros((0, 3))], [np.zeros(0)]
    for point in np.unique(touched):
        R, p = (v[touched == point] for v in flange)
        at = p + R @ nominal
        A.append((R - R.mean(axis=0)).reshape(-1, 3))
        b.append(-(at - at.mean(axis=0)).ravel())
    found = nominal.copy()
    found[free] += _seen(np.vstack(A)[:, free], np.concatenate(b))
    return found


def _seen(A: Floats, b: Floats) -> Floats:
    """The least-squares solution of A x = b of least length, nothing of it along what turns of the tool do not show.

    Args:
        A: Rows of differences of rotations, shape (m, k).
        b: Shape (m,), [m].
    """
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    kept = s > max(1e-10 * s.max(initial=0.0), LEAST_TURN * np.sqrt(max(len(A), 1)))
    return np.asarray(Vt[kept].T @ ((U[:, kept].T @ b) / s[kept]))


def _tool_point_by_distances(
    dR: Floats, dp: Floats, distance: Floats, t: Floats, free: Booleans
) -> tuple[Floats, float]:
    """Gauss-Newton on the distances; the tool point with the least cost met, and that cost."""
    best, least = t, np.inf
    for _ in range(11):
        v = dp + dR @ t
        length = np.linalg.norm(v, axis=1)
        r = length - distance
        cost = float(r @ r)
        if cost < least:
            best, least = t, cost
        J = np.einsum("mk,mki->mi", v / np.maximum(length, 1e-12)[:, None], dR)[:, free]
        t = t.copy()
        t[free] -= _seen(J, r)
    return best, least


def _rotations(R_F: Floats, R_M: Floats, R_X: Floats, R_T: Floats, unknown: Unknown) -> list[tuple[Floats, Floats]]:
    """Rotations X and T with X F T = M in the least-squares sense; several where the rotations alone leave a choice."""
    if not unknown.frame:
        return [(R_X, _tool_rotation(R_F, R_M, R_X) if unknown.tool_rotation else R_T)]
    if not unknown.tool_rotation:
        return [(_frame_rotation(R_F, R_M, R_T), R_T)]
    # trace(M^T X F T) = x^T (sum of Kronecker products) y: the largest singular vectors.
    K = np.einsum("nab,ncd->acbd", R_M, R_F).reshape(9, 9)
    U, s, Vt = np.linalg.svd(K)
    if s[1] < 0.99 * s[0]:
        u, v = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3).T
        R_X = _frame_rotation(R_F, R_M, nearest_rotation(np.sign(np.linalg.det(u)) * v))
        return [(R_X, _tool_rotation(R_F, R_M, R_X))]
    # Every rotation is about one axis: X and T may turn about it against each other. Find one solution, from the
    # nominal tool or any quarter turn of it, and leave the choice of the turn to the positions.
    starts = np.concatenate([R_T[None], R_T @ Rotation.create_group("O").as_matrix().round()])
    all_X, all_T, reached = _alternate(R_F, R_M, starts, steps=20)
    best = int(np.argmax(np.round(reached, 9)))
    R_X, R_T = all_X[best], all_T[best]
    axis = np.linalg.svd(rotation_angle(R_F @ R_F[0].T)[1], full_matrices=False)[2][0]  # in the base frame
    turns = Rotation.from_rotvec(np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)[:, None] * axis).as_matrix()
    return [(R_X @ turn, turn.T @ R_T) for turn in turns]


def _frame_rotation(R_F: Floats, R_M: Floats, R_T: Floats) -> Floats:
    """The best X for a T."""
    return nearest_rotation(np.einsum("nab,cb,ndc->ad", R_M, R_T, R_F))


def _tool_rotation(R_F: Floats, R_M: Floats, R_X: Floats) -> Floats:
    """The best T for an X."""
    return nearest_rotation(np.einsum("nba,cb,ncd->ad", R_F, R_X, R_M))


def _alternate(R_F: Floats, R_M: Floats, R_T: Floats, steps: int) -> tuple[Floats, Floats, Floats]:
    """Best X for a T, then best T for that X, and so on; and the mean of trace(M^T X F T) reached.

    Args:
        R_F: base_R_flange, shape (n, 3, 3).
        R_M: world_R_tool, shape (n, 3, 3).
        R_T: Where to start from, shape (k, 3, 3).
        steps: How often.
    """
    K = np.einsum("nab,ncd->acbd", R_M, R_F)
    for _ in range(steps):
        R_X = nearest_rotation(np.einsum("acbd,kdb->kac", K, R_T))
        R_T = nearest_rotation(np.einsum("acbd,kac->kdb", K, R_X))
    return R_X, R_T, np.einsum("acbd,kac,kdb->k", K, R_X, R_T, optimize=True) / len(R_F)


def _frame_rotations(R_F: Floats, p_F: Floats, p_M: Floats, t: Floats, unknown: Unknown) -> list[Floats]:
    """Candidates for the frame's rotation from positions alone."""
    candidates = [align_points(p_M, p_F + R_F @ t)]
    if unknown.tool_translation.any():
        # X^T (p_M - t_X) = p_F + R_F t is linear in X^T, X^T t_X and t.
        A = np.concatenate([lifted(p_M), -R_F], axis=2)
        solution: Floats = np.linalg.lstsq(A.reshape(-1, 15), p_F.ravel(), rcond=1e-10)[0].astype(np.float64)
        candidates += [nearest_rotation(solution[:9].reshape(3, 3).T), align_points(p_M, p_F + R_F @ solution[12:])]
    return candidates


def lifted(points: Floats) -> Floats:
    """`X^T (p - t)` of points p as linear in X^T, column by column of X, and -X^T t: shape (n, 3, 12)."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([(eye[..., None] * points[:, None, None]).reshape(-1, 3, 9), eye], axis=2)


def align_points(measured: Floats, predicted: Floats) -> Floats:
    """The rotation that takes predicted points to measured ones, both about their means (Umeyama 1991)."""
    return nearest_rotation((measured - measured.mean(axis=0)).T @ (predicted - predicted.mean(axis=0)))


def _with_translations(
    flange: Poses, p_M: Floats | None, candidates: Sequence[tuple[Floats, Floats]], nominal: Frames, unknown: Unknown
) -> Frames:
    """The candidates' rotations that fit best, with their translations; the first where positions say nothing.

    Translations are linear, from the nominal ones in the minimum-norm sense. Where frame and tool act together the
    frame takes it all: the tool is near nominal, the frame may be anywhere. Seen from the base, with R_X^T t_X in place
    of t_X, all candidates have one matrix.
    """
    (R_F, p_F), (X, T) = flange, nominal
    if p_M is None:
        R_X, R_T = candidates[0]
        return Frame(R_X, X.translation), Frame(R_T, T.translation)
    turned = np.array([R_X for R_X, _ in candidates])
    # What is left to explain, of each candidate, (k, n, 3).
    rest = (p_M - X.translation) @ turned - (p_F + R_F @ T.translation)
    A = np.concatenate([np.broadcast_to(np.eye(3), R_F.shape), R_F], axis=2).reshape(-1, 6)  # (3 n, 6)
    rest = rest.reshape(len(candidates), -1).T
    free = np.concatenate([np.full(3, unknown.frame), unknown.tool_translation])
    steps = np.zeros((6, len(candidates)))
    if free.any():
        reluctance = np.where(np.arange(6) < 3, 1.0, 1e-3)[free]
        steps[free] = reluctance[:, None] * np.linalg.lstsq(A[:, free] * reluctance, rest, rcond=1e-10)[0]
    best = int(np.argmin(np.sum((rest - A @ steps) ** 2, axis=0)))
    (R_X, R_T), step = candidates[best], steps[:, best]
    return Frame(R_X, X.translation + R_X @ step[:3]), Frame(R_T, T.translation + step[3:])
