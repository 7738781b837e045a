"""Configurations that are drawn until enough of them can be had, with the reasons why others cannot.

Poses that a camera or a tracker could see are drawn and brought within reach by inverse kinematics; what the arm does
not reach, what is in a box, and what is near one that was taken before is rejected, and counted by reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays, as_floats
from fg_calib.measurements.limits import outside_limits
from fg_calib.robot.inverse import Inverse, random_readings, solve_inverse
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot
from fg_calib.robot.shape import enters
from fg_calib.simulation.configurations import BoardViews, Configurations, GivenReadings, RandomReadings, TargetViews
from fg_calib.simulation.views import aim, faces, require_reached, sees_board, view_board

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Words = NDArray[np.str_]

Draw = Callable[[int], tuple[Floats, Words]]
"""Configurations, shape (n, n_joints), and why each cannot be had, "" where it can."""

REASONS = (
    *("outside the joint limits", "not seen", "out of range", "outside the region", "out of reach", "in a box"),
    "near another",
)
"""Why a configuration, or a pose, is no candidate; of several the first."""

WORD = f"<U{max(map(len, REASONS))}"

ASKED = 20
"""Configurations that are drawn at most for each that is wanted."""

HOPELESS = 1000
"""Drawn without finding any, no more are drawn."""

PATIENCE = 50
"""How many times more, of both, where a reflector is not turned but waited for: drawing alone costs next to nothing."""

ROUND = 16_384
"""Most that are drawn at once, for memory."""

N_STARTS, N_STEPS = 4, 20
"""Starts of the inverse kinematics for each view of a board, and steps from each: most of the time goes into poses that
no start reaches, and more of either find few more."""

N_STARTS_TURNED = 2
"""Starts for each turned reflector: the first is at its place already, and another place costs less than more."""


@dataclass(frozen=True)
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
        """What became of all that were drawn: `1000 drawn: 83 % out of reach, 9.1 % in a box`."""
        shares = (f"{float(f'{100.0 * n / self.asked:.2g}'):g} % {reason}" for reason, n in self.rejected.items())
        return f"{self.asked} drawn: {', '.join(shares) or 'none rejected'}"


def sifted(of: Configurations) -> bool:
    """Whether configurations have to keep to something, so that not all that are drawn are taken."""
    conditions = bool(of.keep_out) or of.apart is not None
    return conditions or (isinstance(of, BoardViews) and of.board_size is not None)


def number_of(of: Configurations) -> int:
    """How many configurations are asked for."""
    match of:
        case BoardViews():
            return 1 + of.count
        case GivenReadings():
            return len(of.readings)
    return of.count


def draw_candidates(robot: Robot, of: Configurations, generator: np.random.Generator, n: int, place: str) -> Candidates:
    """Draw configurations until enough can be had, or so many were drawn that enough are not to be hoped for.

    Args:
        robot: The robot, at its nominal values.
        of: Which configurations, and what they have to keep to.
        generator: Draws them.
        n: How many are wanted.
        place: Of the configurations, for messages.

    Returns:
        At most n: fewer of a table whose rows are used up, where `ASKED` n were drawn, or where none of the first
        `HOPELESS` could be had.

    Raises:
        InputError: Self-motion is to be held, and the first view of a board is not reached.
    """
    draw = _draw(robot, of, generator, place)
    patience = PATIENCE if isinstance(of, TargetViews) and not _can_be_turned(robot) else 1
    most, hopeless = ASKED * patience * n, HOPELESS * patience
    if isinstance(of, GivenReadings):
        most = hopeless = len(of.readings)
    thinning = Thinning(robot, of.apart)
    taken, n_taken, asked = [np.empty((0, robot.n_joints))], 0, 0
    counts: Counter[str] = Counter()
    while n_taken < n and asked < most and (n_taken or asked < hopeless):
        share = n_taken / asked if n_taken else 1.0
        k = min(int(1.1 * (n - n_taken) / share) + 10 if asked else min(n, HOPELESS), ROUND, most - asked)
        readings, reason = draw(k)
        good = np.flatnonzero(reason == "")
        if of.keep_out:
            reason[good] = np.where(enters(robot, readings[good], of.keep_out), "in a box", "")
            good = np.flatnonzero(reason == "")
        reason[good] = np.where(thinning.near(readings[good]), "near another", "")
        good = np.flatnonzero(reason == "")
        k = k if n_taken + len(good) < n else int(good[n - n_taken - 1]) + 1  # none after the last that is wanted
        taken.append(readings[:k][reason[:k] == ""])
        n_taken, asked = n_taken + len(taken[-1]), asked + k
        counts.update(reason[:k].tolist())
    rejected = {why: counts[why] for why in REASONS if counts[why]}
    return Candidates(np.concatenate(taken), asked, rejected)


def _draw(robot: Robot, of: Configurations, generator: np.random.Generator, place: str) -> Draw:
    """What draws configurations of a kind."""
    match of:
        case BoardViews():
            return _views(robot, of, generator, f"{place}: board")
        case TargetViews():
            return lambda k: _target(robot, of, generator, k)
        case RandomReadings():
            return lambda k: (random_readings(robot, k, generator), np.full(k, "", dtype=WORD))
        case GivenReadings():
            return _rows(robot, of.readings, place)


def _rows(robot: Robot, readings: Floats, place: str) -> Draw:
    """The rows of a table, one after the other."""
    rows = as_floats(f"{place}: table", readings, f"(n, {robot.n_joints})")
    outside: Booleans = np.any(outside_limits(rows, robot), axis=1)
    first = 0

    def draw(k: int) -> tuple[Floats, Words]:
        nonlocal first
        chosen = slice(first, first + k)
        first += k
        return rows[chosen], np.where(outside[chosen], "outside the joint limits", "").astype(WORD)

    return draw


def _views(robot: Robot, views: BoardViews, generator: np.random.Generator, place: str) -> Draw:
    """Views of a board: the first that is drawn is A."""
    near: Floats | None = None  # what self-motion is held to
    first = True

    def draw(k: int) -> tuple[Floats, Words]:
        nonlocal near, first
        rotation, position = view_board(replace(views, count=k - 1 if first else k), generator)
        if first and views.self_motion == "held":
            posture = None if views.posture is None else np.array(views.posture)
            found = solve_inverse(robot, position[:1], rotation[:1], generator=generator, near=posture)
            near = require_reached(found, place)[0]
        rotation, position = rotation[-k:], position[-k:]
        first = False
        seen = sees_board(views, rotation, position)
        found = _reach(robot, rotation[seen], position[seen], near, N_STARTS, generator)
        readings, reason = np.zeros((k, robot.n_joints)), np.where(seen, "", "not seen").astype(WORD)
        readings[seen], reason[seen] = found.readings, np.where(found.reached, "", "out of reach")
        return readings, reason

    return draw


def _target(robot: Robot, views: TargetViews, generator: np.random.Generator, k: int) -> tuple[Floats, Words]:
    """Configurations in which a tracker sees a reflector."""
    starts, places, turns, further = generator.spawn(4)
    readings, near = random_readings(robot, k, starts), True
    at = forward(build_chain(robot).without_columns(), robot.trig(readings))
    target, region = at.position + at.rotation @ views.target, views.region
    faced = faces(views, at.rotation, target)
    reason = np.full(k, "", dtype=WORD)
    if region is not None and _can_be_turned(robot):
        target, faced, near = places.uniform(region.lower, region.upper, (k, 3)), np.zeros(k, dtype=np.bool_), False
    elif region is not None:
        reason[~region.holds(target)] = "outside the region"
    away = np.linalg.norm(views.station - target, axis=1)
    beyond = (away < views.distance[0]) | (away > views.distance[1]) | (away == 0.0)
    reason[beyond & (reason == "")] = "out of range"
    rest = (reason == "") & ~faced
    if not _can_be_turned(robot):
        reason[rest] = "not seen"
        return readings, reason
    rotation, position = aim(views, target[rest], turns)
    found = _reach(robot, rotation, position, readings[rest] if near else None, N_STARTS_TURNED, further)
    readings[rest], reason[rest] = found.readings, np.where(found.reached, "", "out of reach")
    return readings, reason


def _can_be_turned(robot: Robot) -> bool:
    """Whether an arm may bring its tool to a place with any rotation."""
    return robot.n_joints >= 6


def _reach(
    robot: Robot,
    rotation: Floats,
    position: Floats,
    near: Floats | None,
    n_starts: int,
    generator: np.random.Generator,
) -> Inverse:
    """Configurations for poses, the inverse kinematics giving up early."""
    return solve_inverse(robot, position, rotation, near=near, generator=generator, n_starts=n_starts, n_steps=N_STEPS)


class Thinning:
    """Takes configurations one after another, each that is not near one taken before."""

    def __init__(self, robot: Robot, apart: float | None) -> None:
        """Begin with none taken.

        Args:
            robot: Whose configurations they are.
            apart: Least distance of two, as `Conditions` has it; None: any.
        """
        self._apart = apart
        self._unit = np.array([robot.reach if joint.prismatic else 1.0 for joint in robot.joints])
        self._taken = np.empty((0, robot.n_joints))

    def near(self, readings: Floats) -> Booleans:
        """Which of further configurations are near others, shape (n,); those that are not are taken."""
        near = np.zeros(len(readings), dtype=np.bool_)
        if self._apart is None:
            return near
        first = 0
        while first < len(readings):  # in parts: all pairs of very many would not fit into memory
            part = slice(first, first + max(1024, len(self._taken) // 4))
            near[part] = self._near(readings[part] / self._unit, self._apart)
            first = part.stop
        return near

    def _near(self, scaled: Floats, apart: float) -> Booleans:
        from scipy.spatial import KDTree

        near = np.zeros(len(scaled), dtype=np.bool_)
        if len(self._taken):
            distance, _ = KDTree(self._taken).query(scaled, p=np.inf, distance_upper_bound=apart)
            near = np.isfinite(distance)
        rows = np.flatnonzero(~near)
        closer = np.nextafter(apart, 0.0)  # less than `apart`, as the query above has it
        pairs = KDTree(scaled[rows]).query_pairs(closer, p=np.inf, output_type="ndarray").reshape(-1, 2)
        i, j = rows[pairs[np.argsort(pairs[:, 0], kind="stable")]].T  # i < j
        before, start, n_behind = np.unique(i, return_index=True, return_counts=True)
        for one, first, last in zip(before.tolist(), start.tolist(), (start + n_behind).tolist(), strict=True):
            if not near[one]:
                near[j[first:last]] = True
        self._taken = np.concatenate([self._taken, scaled[~near]])
        return near
