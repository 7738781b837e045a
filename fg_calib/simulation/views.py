"""Where a camera sees a board, and how a reflector is turned towards a tracker: poses that are drawn, and reached."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.robot.inverse import Inverse, solve_inverse
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import BoardViews, TargetViews

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]


def view_board(views: BoardViews, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Poses of a camera that sees a board's centre, A first.

    Args:
        views: Where from.
        generator: Draws what is left open.

    Returns:
        base_R_tool, shape (1 + count, 3, 3), and base_p_tool, shape (1 + count, 3), [m].
    """
    from scipy.spatial.transform import Rotation

    places, rolls, turns = generator.spawn(3)
    A = np.array([[0.0, 0.0, views.height]])
    if views.distance is None:
        others = A + views.radius * _half_sphere(views.count)
    else:
        drawn = places.uniform(size=(views.count, 3))  # one row a view: more views leave the first as they are
        cosine = 1.0 - drawn[:, 0] * (1.0 - np.cos(views.cone))
        away = views.distance[0] + drawn[:, 1] * (views.distance[1] - views.distance[0])
        others = away[:, None] * _directions(cosine, 2.0 * np.pi * drawn[:, 2])
    board_p_tool = np.concatenate([A, others])  # (n, 3)
    drawn_roll = rolls.uniform(-np.pi, np.pi, len(board_p_tool))
    roll = drawn_roll if views.roll is None else np.full(len(drawn_roll), views.roll)
    # At A the camera is the board's frame turned about its x axis by half a turn; from there the shortest way.
    up, away = np.array([0.0, 0.0, 1.0]), np.linalg.norm(board_p_tool, axis=1, keepdims=True)
    axis = np.cross(up, board_p_tool / away)  # (n, 3), of length sin(tilt)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = np.arctan2(sine, board_p_tool[:, 2:] / away)
    turn = Rotation.from_rotvec(axis * np.where(sine > 0.0, tilt / np.where(sine > 0.0, sine, 1.0), 0.0))
    over = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    aimed = turn * over * Rotation.from_rotvec(roll[:, None] * up)
    board_R_tool = aimed.as_matrix()
    if views.field_of_view > 0.0:  # from the centre, by a turn that brings it to a direction in the field of view
        cosine, azimuth = _in_cone(turns, len(roll), views.field_of_view)
        about = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros(len(roll))], axis=1)
        board_R_tool = (aimed * Rotation.from_rotvec(np.arccos(cosine)[:, None] * about)).as_matrix()
    base_R_board = views.board.rotation
    return base_R_board @ board_R_tool, board_p_tool @ base_R_board.T + views.board.position


def sees_board(views: BoardViews, rotation: Floats, position: Floats) -> Booleans:
    """From which poses all corners of the board are in the field of view, shape (n,); all without a `board_size`.

    Args:
        views: Board and camera.
        rotation: base_R_tool, shape (n, 3, 3).
        position: base_p_tool, shape (n, 3), [m].
    """
    if views.board_size is None:
        return np.ones(len(position), dtype=np.bool_)
    across = 0.5 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * [*views.board_size, 0.0]
    corners = across @ views.board.rotation.T + views.board.position  # (4, 3)
    seen = (corners - position[:, None]) @ rotation  # in the tool frame, (n, 4, 3)
    inside: Booleans = (seen[:, :, 2] >= np.cos(views.field_of_view) * np.linalg.norm(seen, axis=2)).all(axis=1)
    return inside


def aim(views: TargetViews, target: Floats, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Poses of the tool with the reflector in given places, turned towards the tracker.

    Args:
        views: Where the tracker is, and what it sees.
        target: Places of the reflector, shape (n, 3), [m].
        generator: Draws how the reflector is turned.

    Returns:
        base_R_tool, shape (n, 3, 3), and base_p_tool, shape (n, 3), [m].
    """
    n = len(target)
    tilts, rolls = generator.spawn(2)
    cosine, azimuth = _in_cone(tilts, n, views.acceptance)
    towards = views.station - target
    axis = _frames(towards) @ _directions(cosine, azimuth)[:, :, None]  # (n, 3, 1)
    roll = rolls.uniform(-np.pi, np.pi, n)
    c, s, zero = np.cos(roll), np.sin(roll), np.zeros(n)
    about_z = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1.0], axis=1).reshape(n, 3, 3)
    rotation = _frames(axis[:, :, 0]) @ about_z @ _frames(views.axis[None])[0].T
    return rotation, target - rotation @ views.target


def faces(views: TargetViews, rotation: Floats, target: Floats) -> Booleans:
    """Whether the tracker is within the reflector's acceptance, shape (n,).

    Args:
        views: Where the tracker is, and what it sees.
        rotation: base_R_tool, shape (n, 3, 3).
        target: Places of the reflector, shape (n, 3), [m].
    """
    towards, axis = views.station - target, views.axis / np.linalg.norm(views.axis)
    along = np.einsum("ni,nij,j->n", towards, rotation, axis)
    within: Booleans = along >= np.cos(views.acceptance) * np.linalg.norm(towards, axis=1)
    return within


def _in_cone(generator: np.random.Generator, n: int, half_angle: float) -> tuple[Floats, Floats]:
    """Cosine of the angle to the axis of a cone, and azimuth, of directions spread evenly in it, shapes (n,)."""
    drawn = generator.uniform(size=(n, 2))
    return 1.0 - drawn[:, 0] * (1.0 - np.cos(half_angle)), 2.0 * np.pi * drawn[:, 1]


def _frames(z: Floats) -> Floats:
    """Rotations whose third columns point along vectors, shape (n, 3, 3)."""
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(z), axis=1)]  # the coordinate axis most across each
    x = np.cross(least, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _half_sphere(n: int) -> Floats:
    """Unit vectors spread evenly over the half sphere z >= 0, shape (n, 3): a spiral in golden steps.

    Equal steps in z cut equal areas, and turns by the golden angle keep neighbouring turns apart.
    """
    k = np.arange(n) + 0.5
    return _directions(1.0 - k / max(n, 1), np.pi * (1.0 + np.sqrt(5.0)) * k)


def _directions(cosine: Floats, azimuth: Floats) -> Floats:
    """Unit vectors by the cosine of their angle to z and their azimuth, shape (n, 3)."""
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def reach_all(
    robot: Robot, views: BoardViews, rotation: Floats, position: Floats, generator: np.random.Generator, place: str
) -> Floats:
    """Configurations that bring the camera to all poses, A first, shape (n_poses, n_joints), [rad] (prismatic: [m]).

    Raises:
        InputError: One of the poses was not reached.
    """
    if views.self_motion == "random":
        return require_reached(solve_inverse(robot, position, rotation, generator=generator), place)
    near = None if views.posture is None else np.array(views.posture)
    first = require_reached(
        solve_inverse(robot, position[:1], rotation[:1], generator=generator, near=near), place, len(rotation)
    )
    others = solve_inverse(robot, position[1:], rotation[1:], generator=generator, near=first[0])
    return np.concatenate([first, require_reached(others, place, len(rotation), 1)])


def require_reached(found: Inverse, place: str, n: int | None = None, first: int = 0) -> Floats:
    """The solutions for views of a board, or some of them.

    Args:
        found: The solutions.
        place: File and key, for messages.
        n: Number of views, where these are not all.
        first: Number of the first of these; that of A is 0.

    Raises:
        InputError: One of the poses was not reached.
    """
    missed = np.flatnonzero(~found.reached)
    if len(missed) == 0:
        return found.readings
    n = len(found.readings) if n is None else n
    names = ["A" if first + i == 0 else f"view {first + i}" for i in range(len(found.readings))]
    listed = ", ".join([*(names[i] for i in missed[:12]), *(["..."] if len(missed) > 12 else [])])
    nearest = missed[np.argmin(found.miss_position[missed])]
    farthest = missed[np.argmax(found.miss_position[missed])]
    spans = [
        f"{names[i]} by {found.miss_position[i]:.3g} m and {np.rad2deg(found.miss_rotation[i]):.3g} deg"
        for i in dict.fromkeys([nearest, farthest])
    ]
    raise InputError(
        place,
        f"{len(missed)} of {n} views not reached within the joint limits ({listed}): "
        f"the nearest configurations found miss {' and '.join(spans)}",
        hint="move the board nearer or widen the limits",
    )
