"""Inverse kinematics: configurations that bring the tool to given poses, for any robot, many poses at once.

Each pose is solved from one start after another until one ends there within the joint limits. From a start the
steps are those of Levenberg and Marquardt with a damping that falls with the squared miss (Sugihara 2011): far from
the pose it is gentle, near it the steps are Newton's, of minimum norm where the arm is redundant. Joints that a step
would take beyond a limit stop there, turned back by whole turns where that brings them within; what is left of the
step is shared among the others.

A start is random, so that solutions of a redundant arm differ in their self-motion, or a configuration to stay near.

References:
    Sugihara (2011), Solvability-Unconcerned Inverse Kinematics by the Levenberg-Marquardt Method, IEEE Transactions
    on Robotics 27(5).
"""

import numpy as np
from numpy.typing import ArrayLike

from fg_calib.inputs import Booleans, Brief, Floats, Integers, as_floats, as_rotations, check_number, checked
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Context, Robot, context_at
from fg_calib.robot.rotations import rotation_vector

REACHED = 1e-9
"""A solution misses its pose by less, [m] and [rad]."""

N_STARTS = 50
"""Starts for each pose. Of poses that an arm can reach at least one start in three succeeded, see the benchmark."""

N_STEPS = 60
"""Steps from each start; what converges takes 10 to 30."""

LARGEST_STEP = 0.5
"""Largest change of a joint in one step, [rad] (prismatic: this share of the arm's length)."""

FINISHED = 1e-13
"""Steps go on until the miss, lengths over the arm's length, is below: rounding of poses is some 1e-16."""


class Inverse(Brief):
    """Configurations for poses.

    Attributes:
        readings: Within the joint limits, and the nearest to the pose that was found, shape (n_poses, n_joints),
            [rad] (prismatic: [m]).
        miss_position: How far the tool point is from the pose's, shape (n_poses,), [m].
        miss_rotation: Angle between tool and pose, shape (n_poses,), [rad].
    """

    readings: Floats
    miss_position: Floats
    miss_rotation: Floats

    @property
    def reached(self) -> Booleans:
        """Whether a solution was found, shape (n_poses,)."""
        return (self.miss_position < REACHED) & (self.miss_rotation < REACHED)


def random_readings(robot: Robot, n: int, generator: np.random.Generator) -> Floats:
    """Configurations drawn evenly within the joint limits, shape (n, n_joints), [rad] (prismatic: [m]).

    A revolute joint without limits turns over +-180 degrees, a prismatic one slides over +-1 m.
    """
    return generator.uniform(*_range_of_starts(robot), (n, robot.n_joints))


@checked
def solve_inverse(
    robot: Robot,
    position: ArrayLike,
    rotation: ArrayLike | None = None,
    context: Context | None = None,
    *,
    near: ArrayLike | None = None,
    generator: np.random.Generator | None = None,
    n_starts: int = N_STARTS,
    n_steps: int = N_STEPS,
) -> Inverse:
    """Configurations within the joint limits that bring the tool to poses, or its point to positions.

    Args:
        robot: The robot, at its nominal values.
        position: base_p_tool, shape (n_poses, 3), or (3,) of one pose, [m].
        rotation: base_R_tool, shape (n_poses, 3, 3), or (3, 3) of one pose; any if None.
        context: What effects depend on besides, a row a pose: see `Robot.trig`.
        near: Configuration to start from, shape (n_joints,) or (n_poses, n_joints), [rad] (prismatic: [m]), for
            solutions that stay near it; further starts are drawn ever wider about it. Random starts if None.
        generator: Draws the starts; one seeded with 0 if None.
        n_starts: How many starts are tried for each pose.
        n_steps: How many steps from each.

    Raises:
        InputError: A target, or where to start, is not of such a shape, not finite, or no rotation.

    Note:
        That no start ends at a pose does not prove that none could. Starts are drawn pose by pose.
    """
    position = as_floats("position", np.atleast_2d(position), "(n, 3)")
    if rotation is not None:
        rotation = as_rotations("rotation", rotation if np.ndim(rotation) == 3 else [rotation], len(position))
    generator = np.random.default_rng(0) if generator is None else generator
    check_number("n_starts", n_starts, least=1, whole=True)
    check_number("n_steps", n_steps, least=1, whole=True)
    n_poses = len(position)
    starts = _starts(robot, near, (n_poses, n_starts, robot.n_joints), generator)
    search = _Search(robot, rotation, position, context)
    pending = np.arange(n_poses)  # rows still to be solved, and where each of them stands
    tried, steps = np.zeros(n_poses, dtype=np.int64), np.zeros(n_poses, dtype=np.int64)
    q = starts[:, 0].copy()  # (n_poses, n_joints)
    best, smallest, missed = q.copy(), np.full(n_poses, np.inf), np.empty((n_poses, 6))
    while len(pending):
        miss, jacobian = search.look(q[pending], pending)
        size = np.linalg.norm(miss, axis=1)
        nearer = size < smallest[pending]
        best[pending[nearer]], smallest[pending[nearer]] = q[pending[nearer]], size[nearer]
        missed[pending[nearer]] = miss[nearer]
        finished = (size < FINISHED) | ((smallest[pending] < search.good_enough) & ~nearer)
        again = ~finished & (steps[pending] >= n_steps)
        tried[pending[again]] += 1
        finished |= tried[pending] >= n_starts
        again &= ~finished
        q[pending[again]] = starts[pending[again], tried[pending[again]]]
        steps[pending] = np.where(again, 0, steps[pending] + 1)
        go = ~finished & ~again
        q[pending[go]] = search.step(q[pending[go]], miss[go], jacobian[go])
        pending = pending[~finished]
    return Inverse(best, search.length * np.linalg.norm(missed[:, 3:], axis=1), np.linalg.norm(missed[:, :3], axis=1))


def _starts(robot: Robot, near: ArrayLike | None, shape: tuple[int, ...], generator: np.random.Generator) -> Floats:
    """Configurations to start from, random or ever wider about one, shape (n_poses, n_starts, n_joints)."""
    n_poses, n_starts, n_joints = shape
    if near is None:
        return random_readings(robot, n_poses * n_starts, generator).reshape(shape)
    middle = as_floats("near", near, f"({n_joints})" if np.ndim(near) == 1 else f"({n_poses}, {n_joints})")
    spread = np.linspace(0.0, 1.0, n_starts)[:, None]  # [rad] (prismatic: [m]), 0 for the first start
    return np.clip(np.atleast_2d(middle)[:, None, :] + spread * generator.normal(size=shape), *robot.limits.T)


class _Search:
    """Misses and steps towards poses, lengths over the arm's length so that they weigh like angles."""

    def __init__(self, robot: Robot, rotation: Floats | None, position: Floats, context: Context | None) -> None:
        self._chain = build_chain(robot).with_joint_columns()
        self._robot, self._context = robot, context
        self._rotation, self._position = rotation, position
        self._lower, self._upper = robot.limits.T
        self._low, self._high = _range_of_starts(robot)
        self._middle = 0.5 * (self._low + self._high)
        self._turning = np.array([not joint.prismatic for joint in robot.joints])
        self.length = robot.reach
        self._unit = np.where(self._turning, 1.0, self.length)  # of a step, (n_joints,)
        self.good_enough = 0.1 * REACHED / max(1.0, self.length)

    def look(self, q: Floats, rows: Integers) -> tuple[Floats, Floats]:
        """Errors of the tool poses, and the derivative of where the tool is in the joints.

        Returns:
            Pose minus tool, shape (n, 6), rotation vector first, about and along the base's axes; and the
            derivative, each joint in its own unit of step, shape (n, 6, n_joints).
        """
        at = forward(self._chain, self._robot.trig(q, context_at(self._context, rows)))
        shift = (self._position[rows] - at.position) / self.length
        jacobian = at.jacobian * self._unit
        jacobian[:, 3:] /= self.length
        if self._rotation is None:  # any will do
            jacobian[:, :3] = 0.0
            return np.concatenate([np.zeros_like(shift), shift], axis=1), jacobian
        turn = self._rotation[rows] @ np.swapaxes(at.rotation, 1, 2)  # (n, 3, 3)
        return np.concatenate([rotation_vector(turn), shift], axis=1), jacobian

    def step(self, q: Floats, miss: Floats, jacobian: Floats) -> Floats:
        """The next configurations, within the limits, shape (n, n_joints)."""
        damping = 0.5 * np.sum(miss**2, axis=1) + 1e-15  # (n,)
        free = np.ones(q.shape, dtype=np.bool_)
        moved = self._moved(q, miss, jacobian, damping, free)
        within = self._within(moved)
        stopped = within != self._turned(moved)
        rows = np.flatnonzero(stopped.any(axis=1))
        if len(rows):  # once more without the joints that stand at a limit and would go on
            free = ~(stopped[rows] & (within[rows] == q[rows]))
            within[rows] = self._within(self._moved(q[rows], miss[rows], jacobian[rows], damping[rows], free))
        return within

    def _moved(self, q: Floats, miss: Floats, jacobian: Floats, damping: Floats, free: Booleans) -> Floats:
        J = jacobian * free[:, None, :]  # (n, 6, n_joints)
        gram = J @ np.swapaxes(J, 1, 2) + damping[:, None, None] * np.eye(6)
        step = (np.swapaxes(J, 1, 2) @ np.linalg.solve(gram, miss[:, :, None]))[:, :, 0]
        largest = np.abs(step).max(axis=1, keepdims=True)
        return np.asarray(q + step * np.minimum(1.0, LARGEST_STEP / np.maximum(largest, LARGEST_STEP)) * self._unit)

    def _turned(self, q: Floats) -> Floats:
        """Revolute joints that are outside their limits, or +-180 degrees, turned back by whole turns."""
        turned = q - 2.0 * np.pi * np.round((q - self._middle) / (2.0 * np.pi))
        return np.where((q < self._low) | (q > self._high), np.where(self._turning, turned, q), q)

    def _within(self, q: Floats) -> Floats:
        return np.clip(self._turned(q), self._lower, self._upper)


def _range_of_starts(robot: Robot) -> tuple[Floats, Floats]:
    """Limits, or +-180 degrees and +-1 m where there are none, shapes (n_joints,)."""
    span = np.array([1.0 if joint.prismatic else np.pi for joint in robot.joints])
    lower, upper = robot.limits.T
    # A joint with one limit gets a range of twice the span from there.
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2.0 * span, -span))
    high = np.where(np.isfinite(upper), upper, np.where(np.isfinite(lower), lower + 2.0 * span, span))
    return low, high
