"""Configurations: poses that a camera or a tracker could see, or random ones, with the reasons why others are rejected.

Poses are drawn and brought within reach by inverse kinematics. A pose that the arm does not reach, and a configuration
that is in a box, are rejected, and counted by reason.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Booleans, Floats, FrozenArrays, InputError, as_floats, expect
from fg_calib.measurements import outside_limits
from fg_calib.robot import Inverse, Robot, build_chain, forward, random_readings, solve_inverse
from fg_calib.simulation.obstacles import enters
from fg_calib.simulation.scenario import BoardViews, Configurations, GivenReadings, RandomReadings, TargetViews

Words = NDArray[np.str_]

Draw = Callable[[int, int], tuple[Floats, Words]]
"""Draws n configurations after m others, shape (n, n_joints), with why each is rejected, "" where it is not."""

REASONS = ("outside the joint limits", "not seen", "out of range", "outside the region", "out of reach", "in keep_out")
"""Why a configuration, or a pose, is rejected; of several reasons the first."""

WORD = f"<U{max(map(len, REASONS))}"

MAX_DRAWN_EACH = 20
"""Configurations that are drawn at most for each that is wanted."""

MAX_DRAWN_IN_VAIN = 1000
"""Without finding any, no more are drawn."""

DRAWN_MORE = 50
"""How many times more, of both, for trackers: no inverse kinematics is needed."""

MAX_DRAWN_AT_ONCE = 16_384
"""Most that are drawn at once, for memory."""

N_STARTS, N_STEPS = 4, 20
"""Starts of the inverse kinematics for each view of a board, and steps from each: most of the time is spent on poses
that no start reaches."""


class Candidates(FrozenArrays):
    """Configurations that can be had.

    Attributes:
        readings: In the order in which they were drawn, shape (n, n_joints), [rad] (prismatic: [m]).
        asked: Number of poses or configurations that were drawn.
        rejected: How many of them were not taken, by reason (`REASONS`).
    """

    readings: Floats
    asked: int
    rejected: Mapping[str, int]

    def reasons(self) -> str:
        """Reasons of rejection, of all that were drawn: `1000 drawn: 83 % out of reach, 9.1 % in keep_out`."""
        shares = (f"{float(f'{100.0 * n / self.asked:.2g}'):g} % {reason}" for reason, n in self.rejected.items())
        return f"{self.asked} drawn: {', '.join(shares) or 'none rejected'}"


def number_of(of: Configurations) -> int:
    """How many configurations are asked for."""
    return len(of.readings) if isinstance(of, GivenReadings) else of.count + isinstance(of, BoardViews)


def draw_candidates(robot: Robot, of: Configurations, generator: np.random.Generator, n: int, place: str) -> Candidates:
    """Draw configurations until enough are found, or too many were rejected.

    Args:
        robot: The robot, at its nominal values.
        of: Which configurations, and what they have to keep to.
        generator: Draws them.
        n: How many are wanted.
        place: Of the configurations, for messages.

    Returns:
        At most n: fewer of a table whose rows are used up, where `MAX_DRAWN_EACH` n were drawn, or where the first
        `MAX_DRAWN_IN_VAIN` were all rejected.

    Raises:
        InputError: Self-motion is to be held, and the first view of a board is not reached.
    """
    draw = _draw(robot, of, generator, place)
    patience = DRAWN_MORE if isinstance(of, TargetViews) else 1
    most, hopeless = MAX_DRAWN_EACH * patience * n, MAX_DRAWN_IN_VAIN * patience
    if isinstance(of, GivenReadings):
        most = hopeless = len(of.readings)
    taken, asked, counts = np.empty((0, robot.n_joints)), 0, Counter[str]()
    while len(taken) < n and asked < most and (len(taken) or asked < hopeless):
        share = len(taken) / asked if len(taken) else 1.0
        k = int(1.1 * (n - len(taken)) / share) + 10 if asked else min(n, MAX_DRAWN_IN_VAIN)
        readings, reason = draw(min(k, MAX_DRAWN_AT_ONCE, most - asked), asked)
        good = np.flatnonzero(reason == "")
        reason[good[enters(robot, readings[good], of.keep_out)]] = "in keep_out"
        good = np.flatnonzero(reason == "")[: n - len(taken)]
        k = int(good[-1]) + 1 if len(taken) + len(good) == n else len(reason)  # none after the last that is wanted
        taken, asked = np.concatenate([taken, readings[good]]), asked + k
        counts.update(reason[:k].tolist())
    return Candidates(taken, asked, {why: counts[why] for why in REASONS if counts[why]})


def _draw(robot: Robot, of: Configurations, generator: np.random.Generator, place: str) -> Draw:
    """Choose how configurations are drawn."""
    match of:
        case BoardViews():
            return _views(robot, of, generator, f"{place}: board")
        case TargetViews():
            return lambda k, _: _target(robot, of, generator, k)
        case RandomReadings():
            return lambda k, _: (random_readings(robot, k, generator), np.full(k, "", dtype=WORD))
        case GivenReadings():
            rows = as_floats(f"{place}: table", of.readings, f"(n, {robot.n_joints})")
            outside = np.any(outside_limits(rows, robot), axis=1)
            reason = np.where(outside, "outside the joint limits", "").astype(WORD)
            return lambda k, asked: (rows[asked : asked + k], reason[asked : asked + k].copy())


def _views(robot: Robot, views: BoardViews, generator: np.random.Generator, place: str) -> Draw:
    """Views of a board: the first that is drawn is A."""
    near: Floats | None = None  # the configuration that self-motion stays near

    def draw(k: int, asked: int) -> tuple[Floats, Words]:
        nonlocal near
        first = asked == 0
        rotation, position = view_board(replace(views, count=k - 1 if first else k), generator)
        if first and views.self_motion == "held":
            near = _require_reached(solve_inverse(robot, position[:1], rotation[:1], generator=generator), place)[0]
        rotation, position = rotation[-k:], position[-k:]
        seen = sees_board(views, rotation, position)
        R, p = rotation[seen], position[seen]
        found = solve_inverse(robot, p, R, near=near, generator=generator, n_starts=N_STARTS, n_steps=N_STEPS)
        readings, reason = np.zeros((k, robot.n_joints)), np.where(seen, "", "not seen").astype(WORD)
        readings[seen], reason[seen] = found.readings, np.where(found.reached, "", "out of reach")
        return readings, reason

    return draw


def _target(robot: Robot, views: TargetViews, generator: np.random.Generator, k: int) -> tuple[Floats, Words]:
    """Configurations, and why a tracker does not see the reflector in each."""
    readings = random_readings(robot, k, generator)
    at = forward(build_chain(robot).without_columns(), robot.trig(readings))
    target = at.position + at.rotation @ views.target
    towards, axis = views.station - target, at.rotation @ (views.axis / np.linalg.norm(views.axis))
    away = np.linalg.norm(towards, axis=1)
    reason = np.full(k, "", dtype=WORD)
    reason[np.sum(towards * axis, axis=1) < np.cos(views.acceptance) * away] = "not seen"
    reason[(away < views.distance[0]) | (away > views.distance[1]) | (away == 0.0)] = "out of range"
    if views.region is not None:
        inside = (target >= views.region.lower) & (target <= views.region.upper)
        reason[~inside.all(axis=1)] = "outside the region"
    return readings, reason


# --- views ------------------------------------------------------------------------------------------------------------


def view_board(views: BoardViews, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Poses of a camera that sees a board's centre, A first.

    Args:
        views: Where from.
        generator: Draws what is left open.

    Returns:
        base_R_tool, shape (1 + count, 3, 3), and base_p_tool, shape (1 + count, 3), [m].
    """
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
    x, y, z = board_p_tool.T
    azimuth, tilt = np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
    turn = Rotation.from_euler("ZYZ", np.stack([azimuth, tilt, -azimuth], axis=1))
    aimed = turn * Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", roll[:, None])
    board_R_tool = aimed.as_matrix()
    if views.field_of_view > 0.0:  # from the centre, by a turn that brings it to a direction in the field of view
        drawn = turns.uniform(size=(len(roll), 2))
        cosine, azimuth = 1.0 - drawn[:, 0] * (1.0 - np.cos(views.field_of_view)), 2.0 * np.pi * drawn[:, 1]
        about = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros(len(roll))], axis=1)
        board_R_tool = (aimed * Rotation.from_rotvec(np.arccos(cosine)[:, None] * about)).as_matrix()
    base_R_board = views.board.rotation
    return base_R_board @ board_R_tool, board_p_tool @ base_R_board.T + views.board.position


def sees_board(views: BoardViews, rotation: Floats, position: Floats) -> Booleans:
    """Poses from which all corners of the board are in the field of view, shape (n,); all without a `board_size`.

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
    return (seen[:, :, 2] >= np.cos(views.field_of_view) * np.linalg.norm(seen, axis=2)).all(axis=1)


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


# --- configurations of a scenario -------------------------------------------------------------------------------------


def find_readings(robot: Robot, of: Configurations, generator: np.random.Generator, place: str) -> Floats:
    """Find as many configurations as are asked for, shape (n, n_joints), [rad] (prismatic: [m]).

    Raises:
        InputError: There are not so many that meet their conditions.
    """
    conditions = bool(of.keep_out) or isinstance(of, TargetViews)
    if isinstance(of, BoardViews) and not conditions and of.board_size is None:
        return _reach_views(robot, of, generator, f"{place}: board")
    if isinstance(of, GivenReadings) and not conditions:
        return np.asarray(of.readings, dtype=np.float64)
    n = number_of(of)
    found = draw_candidates(robot, of, generator, n, place)
    hint = "ask for fewer, or relax their conditions"
    expect(len(found.readings) >= n, place, f"{len(found.readings)} of {n} found in {found.reasons()}", hint=hint)
    return found.readings


def _reach_views(robot: Robot, views: BoardViews, generator: np.random.Generator, place: str) -> Floats:
    """Configurations that bring the camera to all views of a board, A first.

    Raises:
        InputError: One of the poses was not reached.
    """
    rotation, position = view_board(views, generator)
    near: Floats | None = None
    if views.self_motion == "held":
        near = _require_reached(solve_inverse(robot, position[:1], rotation[:1], generator=generator), place)[0]
    return _require_reached(solve_inverse(robot, position, rotation, generator=generator, near=near), place)


def _require_reached(found: Inverse, place: str) -> Floats:
    """The solutions for views of a board.

    Raises:
        InputError: One of the poses was not reached.
    """
    missed = np.flatnonzero(~found.reached)
    if len(missed) == 0:
        return found.readings
    nearest = missed[np.argmin(found.miss_position[missed])]
    by = f"{found.miss_position[nearest]:.3g} m and {np.rad2deg(found.miss_rotation[nearest]):.3g} deg"
    reason = f"{len(missed)} of {len(found.readings)} views not reached within the joint limits"
    hint = "move the board nearer or widen the limits"
    raise InputError(place, f"{reason}: the nearest one is missed by {by}", hint=hint)
