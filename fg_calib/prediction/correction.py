"""Commands for a controller with the nominal model, so that the calibrated arm reaches its targets.

The controller is given joint values with which the calibrated arm is at the target; or, if it takes poses alone, the
pose for which its own model finds these joint values.

An arm of fewer than six joints, or at a limit, may reach the point of a target but not its orientation. Then the point
is kept, and the orientation is brought as near as the remaining freedom allows, by least squares in which the point
counts far more.

Controllers know nothing of effects: their model is the nominal geometry. An arm with effects is inverted from the
readings that its geometry has at the target: effects change slowly with these, so that steps by the geometry's
derivatives are a fixed point that gains some two digits each.
"""

from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike

from fg_calib.inputs import Booleans, Floats, FrozenArrays, InputError, Integers, as_floats, as_rotations, optimize
from fg_calib.measurements import check_readings
from fg_calib.prediction.tool_pose import errors_at, predict_poses
from fg_calib.robot import Context, Robot, build_chain, context_at, forward
from fg_calib.robot.inverse import N_STARTS, REACHED, Inverse, solve_inverse
from fg_calib.robot.rotations import inverse_right_jacobian, rotation_vector
from fg_calib.statistics import TangentCovariance

LARGE_CHANGE = 0.1
"""Change of a joint, [rad] (prismatic: [m]), which only a singularity or another branch of solutions explains."""

_N_NEAR = 20
"""Starts near where the arm is to stay."""

_WEIGHT = 100.0
"""Weight [1/m] of the point against a turn [rad] where the tool is turned about it."""


class Correction(FrozenArrays, eq=False):
    """Commands for n targets.

    Attributes:
        readings: Joint values to command, within the limits, shape (n, n_joints), [rad] (prismatic: [m]).
        position: Tool point of the nominal arm with them, from the base: the pose to command where the controller takes
            poses, shape (n, 3), [m].
        rotation: Its orientation there, shape (n, 3, 3).
        nominal_readings: Joint values of the nominal arm for the targets, shape (n, n_joints).
        uncorrected: Errors of the calibrated arm at these, position and orientation, shape (n, 2), [m] and [rad]; nan
            where the nominal arm does not reach the target either.
        missed: Errors with the correction, shape (n, 2), [m] and [rad]; 0 but for rounding where it reaches them.
        expected: RMS errors that the calibration's uncertainty leaves, of position and orientation, in the frame of the
            targets, shape (n, 2), [m] and [rad]; nan where they depend on what is not determined.
        expected_fitted: RMS position error after the best rigid fit of all targets, which needs no base, [m];
            nan where it is not determined.
        turns: Whether the targets have an orientation.
        context: Names of what effects depend on besides, as far as it is known.
    """

    readings: Floats
    position: Floats
    rotation: Floats
    nominal_readings: Floats
    uncorrected: Floats
    missed: Floats
    expected: Floats
    expected_fitted: float
    turns: bool
    context: tuple[str, ...]

    @cached_property
    def reached(self) -> Booleans:
        """Which targets the calibrated arm reaches, shape (n,)."""
        return np.asarray((self.missed < REACHED).all(axis=1))

    @cached_property
    def far(self) -> Booleans:
        """Joints that change by more than a calibration alone explains, shape (n,)."""
        return np.asarray((np.abs(self.readings - self.nominal_readings) > LARGE_CHANGE).any(axis=1))


def correct_targets(
    posterior: TangentCovariance,
    robot: Robot,
    nominal: Robot,
    position: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    context: Context | None = None,
    *,
    near: ArrayLike | None = None,
    table: int | None = None,
) -> Correction:
    """Commands with which the calibrated arm reaches targets.

    Args:
        posterior: The covariance of the calibration, at its estimate.
        robot: The calibrated robot.
        nominal: The robot that the controller knows.
        position: Tool points wanted, shape (n, 3), or (3,) of one target, [m]. If None the targets are the poses of the
            nominal arm at `near`.
        rotation: Orientations wanted, shape (n, 3, 3), or (3, 3); any if None.
        context: What effects depend on besides at the targets, a row each: see `Robot.trig`.
        near: Joint values to stay near, shape (n, n_joints) or (n_joints,), [rad] (prismatic: [m]). If None the first
            solution is taken, searched for from the middle of the limits, then from anywhere.
        table: Number of the table in whose measurement frame the targets are; the base frame if None.

    Raises:
        InputError: Targets or joint values are not of such a shape, not finite, or outside the limits.
    """
    nominal = nominal.geometry
    target, turned, start = _check_targets(nominal, position, rotation, near)
    if table is not None:
        target, turned = _in_base(posterior, target, turned, table)
    uncorrected, off = start, np.zeros((len(target), 2))
    if position is not None:
        first = reach(nominal, target, turned, start, anywhere=near is None)
        uncorrected = first.readings
        off[first.miss_position >= REACHED] = np.nan
        off[first.miss_rotation >= REACHED, 1] = np.nan
    off += np.column_stack(misses(robot, uncorrected, target, turned, context))
    found = reach(robot, target, turned, uncorrected, context)
    commanded = forward(build_chain(nominal), nominal.trig(found.readings))
    covariance = predict_poses(posterior, found.readings, table, context)[2]
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2)
    fitted = errors_at(posterior, found.readings, context)[1].position
    missed, expected = np.column_stack([found.miss_position, found.miss_rotation]), np.sqrt(variance)
    at, whole = (commanded.position, commanded.rotation), np.nan if fitted is None else fitted
    names, turn = tuple(context or ()), turned is not None
    return Correction(found.readings, *at, uncorrected, off, missed, expected, whole, turn, names)


def _check_targets(
    nominal: Robot, position: ArrayLike | None, rotation: ArrayLike | None, near: ArrayLike | None
) -> tuple[Floats, Floats | None, Floats]:
    """Points, orientations and joint values to stay near, checked, a row a target."""
    n_joints = nominal.n_joints
    if near is not None:
        near = as_floats("near", np.atleast_2d(near), f"(n, {n_joints})")
        check_readings(near, nominal, "near")
    if position is None:
        if near is None or rotation is not None:
            raise InputError("position", "none are given", "where the targets are, or joint values alone")
        at = forward(build_chain(nominal), nominal.trig(near))
        return at.position, at.rotation, near
    target = as_floats("position", np.atleast_2d(position), "(n, 3)")
    if rotation is not None:
        rotation = as_rotations("rotation", rotation if np.ndim(rotation) == 3 else [rotation], len(target))
    near = _middle(nominal)[None] if near is None else near
    if len(near) not in {1, len(target)}:
        raise InputError("near", f"{len(near)} rows", f"one for all, or {len(target)}")
    return target, rotation, np.broadcast_to(near, (len(target), n_joints)).copy()


def _middle(robot: Robot) -> Floats:
    """The middle of the joints' limits, shape (n_joints,); 0, or what is nearest to it, where there are not both."""
    lower, upper = robot.limits.T
    both = np.isfinite(upper - lower)
    return np.where(both, 0.5 * (np.where(both, lower, 0.0) + np.where(both, upper, 0.0)), np.clip(0.0, lower, upper))


def _in_base(
    posterior: TangentCovariance, position: Floats, rotation: Floats | None, table: int
) -> tuple[Floats, Floats | None]:
    """Targets given in a measurement frame, in the base frame."""
    q = _middle(posterior.variables.robot)[None]
    base, world = predict_poses(posterior, q, None), predict_poses(posterior, q, table)
    R = world[1][0] @ base[1][0].T  # world_R_base
    return (position - (world[0][0] - R @ base[0][0])) @ R, None if rotation is None else R.T @ rotation


def reach(
    robot: Robot,
    position: Floats,
    rotation: Floats | None,
    near: Floats,
    context: Context | None = None,
    *,
    anywhere: bool = False,
) -> Inverse:
    """Configurations at poses, near given ones; the nearest orientation where only the point is in reach.

    Args:
        robot: The robot, at its nominal values.
        position: base_p_tool, shape (n, 3), [m].
        rotation: base_R_tool, shape (n, 3, 3); any if None.
        near: Configurations to stay near, shape (n, n_joints), [rad] (prismatic: [m]).
        context: What effects depend on besides: see `Robot.trig`.
        anywhere: Whether these are starts alone, and any configuration will do.

    Returns:
        Within the joint limits; the miss of a point that is itself out of reach is not 0.
    """
    if robot.effects:
        first = reach(robot.geometry, position, rotation, near, anywhere=anywhere).readings
        found = solve_inverse(robot, position, rotation, context, near=first, n_starts=1)
        q, rows = found.readings.copy(), np.flatnonzero(~found.reached)
        points = solve_inverse(robot, position[rows], None, context_at(context, rows), near=first[rows], n_starts=1)
        q[rows] = points.readings
        if rotation is not None:
            for k in rows[points.reached]:
                q[k] = _rotate(robot, q[k], position[k], rotation[k], context_at(context, slice(k, k + 1)))
        return Inverse(q, *misses(robot, q, position, rotation, context))

    def solve(rows: Integers, near: Floats | None, n_starts: int) -> Inverse:
        turned = None if rotation is None else rotation[rows]
        return solve_inverse(robot, position[rows], turned, near=near, n_starts=n_starts)

    found = solve(np.arange(len(near)), near, 1 if anywhere else _N_NEAR)
    q, reached = found.readings.copy(), found.reached.copy()
    rows = np.flatnonzero(~reached)
    if len(rows):  # from random starts all over the limits
        others = solve(rows, None, N_STARTS)
        q[rows[others.reached]] = others.readings[others.reached]
        reached[rows] = others.reached
    rows = np.flatnonzero(~reached)
    if rotation is not None and len(rows):
        points = solve_inverse(robot, position[rows], near=near[rows], n_starts=_N_NEAR)
        for k, start in zip(rows[points.reached], points.readings[points.reached], strict=True):
            q[k] = _rotate(robot, start, position[k], rotation[k])
    return Inverse(q, *misses(robot, q, position, rotation))


def misses(
    robot: Robot, readings: Floats, position: Floats, rotation: Floats | None, context: Context | None = None
) -> tuple[Floats, Floats]:
    """Distances of the tool from points and angles from orientations, shapes (n,), [m] and [rad].

    Args:
        robot: The robot, at its nominal values.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        position: Shape (n, 3), [m].
        rotation: Shape (n, 3, 3); if None any will do, and the angle is 0.
        context: What effects depend on besides: see `Robot.trig`.
    """
    at = forward(build_chain(robot), robot.trig(readings, context))
    distance = np.linalg.norm(position - at.position, axis=1)
    if rotation is None:
        return distance, np.zeros(len(distance))
    return distance, np.linalg.norm(rotation_vector(rotation @ np.swapaxes(at.rotation, 1, 2)), axis=1)


def _rotate(robot: Robot, q: Floats, position: Floats, rotation: Floats, context: Context | None = None) -> Floats:
    """The configuration nearest in orientation with the tool point in place, from one whose point is there."""
    chain = build_chain(robot).with_joint_columns()

    @cache
    def linearise(*q: float) -> tuple[Floats, Floats]:
        """Misses of the point and of the orientation, shape (6,), and their derivative in the joints.

        Of the orientation it is a = Log(R_target R^T); R turns by w in the base frame, so da = -Jr^-1(a) w. Slopes of
        error curves and loads are left out.
        """
        at = forward(chain, robot.trig(np.array([q]), context))
        turn = rotation_vector(rotation[None] @ np.swapaxes(at.rotation, 1, 2))
        of_turn = -inverse_right_jacobian(turn)[0] @ at.jacobian[0, :3]
        miss = np.concatenate([(at.position - position)[0] * _WEIGHT, turn[0]])
        return miss, np.concatenate([at.jacobian[0, 3:] * _WEIGHT, of_turn])

    def miss(q: Floats) -> Floats:
        return linearise(*q)[0]

    def derivative(q: Floats) -> Floats:
        return linearise(*q)[1]

    best = optimize.least_squares(miss, q, derivative, tuple(robot.limits.T), xtol=1e-10, ftol=1e-10, gtol=1e-10).x
    found = solve_inverse(robot, position, None, context, near=best, n_starts=1)
    return found.readings[0] if found.reached[0] else q
