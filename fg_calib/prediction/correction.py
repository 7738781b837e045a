"""What to command so that the calibrated arm reaches its targets.

A controller that cannot be told the true geometry goes wherever its nominal model says. It is given joint values with
which the true arm is at the target; or, where it only takes poses, the pose for which its own model finds just these
joint values: a wrong pose for the right place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import as_floats, as_rotations
from fg_calib.errors import InputError
from fg_calib.measurements.checks import check_readings
from fg_calib.prediction.expected_error import errors_at
from fg_calib.robot.inverse import REACHED
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot
from fg_calib.robot.reaching import Correction, misses, reach

if TYPE_CHECKING:
    from fg_calib.calibration import Calibration

Floats = NDArray[np.float64]


@checked
def correct(
    calibration: Calibration,
    position: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    *,
    near: ArrayLike | None = None,
    world: bool = False,
    table: int | None = None,
) -> Correction:
    """What to command so that the calibrated arm reaches targets.

    Args:
        calibration: The calibration; the nominal arm, as the controller knows it, is that which it began with.
        position: Where the tool point is to be, shape (n, 3), or (3,) of one target, [m]. If None the targets are the
            poses of the nominal arm at `near`: what a program of joint values was meant to reach.
        rotation: How the tool is to be turned, shape (n, 3, 3), or (3, 3); any if None.
        near: Joint values to stay near, shape (n, n_joints) or (n_joints,), [rad] (prismatic: [m]): of an arm that
            reaches a target in several ways they choose one. If None that is the first that is found, searched for from
            the middle of the limits and, where that leads nowhere, from anywhere.
        world: Whether the targets are in the measurement frame, instead of the base frame.
        table: Number of the table whose measurement frame it is, from 0; there must be one if there are several.

    Raises:
        InputError: Targets or joint values are not of such a shape, not finite, or outside the limits; there is no
            measurement frame.
    """
    robot, nominal = calibration.robot, nominal_robot(calibration)
    target, turned, start = _targets(nominal, position, rotation, near)
    if world and position is None:
        raise InputError("world", "joint values reach poses in the base frame", "targets with positions")
    if world:
        target, turned = _from_base(calibration, target, turned, table)
    first = reach(nominal, target, turned, start, anywhere=near is None) if position is not None else None
    uncorrected = start if first is None else first.readings
    off = np.column_stack(misses(robot, uncorrected, target, turned))
    if first is not None:
        off[first.miss_position >= REACHED] = np.nan
        off[first.miss_rotation >= REACHED, 1] = np.nan
    found = reach(robot, target, turned, uncorrected)
    commanded = forward(build_chain(nominal), nominal.trig(found.readings))
    expected = calibration.predict(found.readings, world=world, table=table)
    _, fitted = errors_at(calibration.posterior, found.readings)
    sigmas = (expected.sigma_position, expected.sigma_rotation)
    return Correction(
        readings=found.readings,
        position=commanded.position,
        rotation=commanded.rotation,
        nominal_readings=uncorrected,
        uncorrected=off,
        missed=np.column_stack([found.miss_position, found.miss_rotation]),
        expected=np.column_stack([np.linalg.norm(sigma, axis=1) for sigma in sigmas]),
        expected_fitted=np.nan if fitted.position is None else fitted.position,
        turns=turned is not None,
    )


def nominal_robot(calibration: Calibration) -> Robot:
    """The robot that a calibration began with."""
    return calibration.robot.with_values([p.nominal for p in calibration.result.parameters])


def _targets(
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
    if near is None:
        near = _middle(nominal)[None]
    if len(near) not in {1, len(target)}:
        raise InputError("near", f"{len(near)} rows", f"one for all, or {len(target)}")
    return target, rotation, np.broadcast_to(near, (len(target), n_joints)).copy()


def _middle(robot: Robot) -> Floats:
    """The middle of the joints' limits, shape (n_joints,); 0, or what is nearest to it, where there are not both."""
    lower, upper = robot.limits.T
    both = np.isfinite(upper - lower)
    return np.where(both, 0.5 * (np.where(both, lower, 0.0) + np.where(both, upper, 0.0)), np.clip(0.0, lower, upper))


def _from_base(
    calibration: Calibration, position: Floats, rotation: Floats | None, table: int | None
) -> tuple[Floats, Floats | None]:
    """Targets in the measurement frame as they are from the base."""
    somewhere = _middle(calibration.robot)
    here, there = calibration.predict(somewhere), calibration.predict(somewhere, world=True, table=table)
    turn = there.rotation[0] @ here.rotation[0].T  # world_R_base
    shift = there.position[0] - turn @ here.position[0]
    return (position - shift) @ turn, None if rotation is None else turn.T @ rotation
