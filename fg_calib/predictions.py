"""Predictions of a calibration: expected errors of its tool, and commands that correct the nominal arm.

Expected errors are those of the covariance: of the specified noise and prior sigmas. Unmodelled effects, such as
compliance, are not part of them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fg_calib.calibration import Calibration
from fg_calib.inputs import Floats, InputError, as_floats, check_number, checked
from fg_calib.measurements import check_readings
from fg_calib.parallel import single_threaded
from fg_calib.prediction import Correction, PredictedErrors, ToolPoseUncertainty, correct_targets, predict_errors
from fg_calib.robot import Robot


@checked
@single_threaded
def predict(
    calibration: Calibration | Path | str,
    readings: ArrayLike | None = None,
    *,
    limit: float | None = None,
    measured: ArrayLike | None = None,
) -> PredictedErrors:
    """Expected errors of the tool: what `fg-calib predict` shows.

    Args:
        calibration: The calibration; or the folder that `save` or `calibrate --out` wrote, which says what was
            measured, as a calibration just made does.
        readings: Configurations, shape (n, n_joints), or (n_joints,) of one, [rad] (prismatic: [m]); drawn all over the
            workspace if None.
        limit: What position errors are held to, [m].
        measured: Readings of the measured configurations, shape (m, n_joints), of a calibration that was loaded.

    Raises:
        InputError: The calibration cannot be read, estimated nothing, or does not say what was measured; readings are
            of other joints, not finite, or outside the limits.
    """
    if limit is not None:
        check_number("limit", limit, above=True)
    folder = None if isinstance(calibration, Calibration) else Path(calibration)
    found = calibration if isinstance(calibration, Calibration) else Calibration.load(calibration)
    if found.result.evaluated_only:
        raise InputError(found.result.robot, "the arm was only evaluated: nothing was estimated", "a calibration")
    there = _readings("measured", measured, found) if measured is not None else measured_of(found, folder)
    at = None if readings is None else _readings("readings", readings, found)
    model = ToolPoseUncertainty.of(found.posterior, there, joint_noise_of(found))
    return predict_errors(found.robot, model, there, at, fitted=found.result.free_of_frame, limit=limit)


def joint_noise_of(calibration: Calibration) -> Floats | None:
    """1 sigma of joint readings as the calibration's job states it, or as it was estimated; None where nothing says.

    Shape (n_joints,), [rad] (prismatic: [m]).
    """
    sigma = calibration.result.sigma_joint
    return sigma if np.any(sigma > 0.0) else None


def measured_of(found: Calibration, folder: Path | None = None) -> Floats:
    """Readings of the measured configurations, those held out among them, shape (m, n_joints).

    Args:
        found: The calibration.
        folder: What it was loaded from: the folder, or its `result.json`.

    Raises:
        InputError: Nothing says what was measured.
    """
    if found.measured is None:
        place, expected = str(folder or "calibration"), "configurations.csv, or `measured`"
        raise InputError(place, "nothing says what was measured", expected)
    return found.measured


def _readings(name: str, given: ArrayLike, found: Calibration) -> Floats:
    """Readings that were given, checked."""
    readings = as_floats(name, np.atleast_2d(np.asarray(given)), f"(n, {found.robot.n_joints})")
    if not len(readings):
        raise InputError(name, "no configurations", "one or more")
    check_readings(readings, found.robot, name)
    return readings


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
    """Commands with which the calibrated arm reaches targets.

    Args:
        calibration: The calibration; the nominal arm, as the controller knows it, is that which it began with.
        position: Where the tool point is to be, shape (n, 3), or (3,) of one target, [m]. If None the targets are the
            poses of the nominal arm at `near`: what a program of joint values was meant to reach.
        rotation: Orientations wanted, shape (n, 3, 3), or (3, 3); any if None.
        near: Joint values to stay near, shape (n, n_joints) or (n_joints,), [rad] (prismatic: [m]): of an arm that
            reaches a target in several ways they choose one. If None that is the first that is found, searched for from
            the middle of the limits and, where that leads nowhere, from anywhere.
        world: Whether the targets are in the measurement frame, instead of the base frame.
        table: Number of the table whose measurement frame it is, from 0; there must be one if there are several.

    Raises:
        InputError: Targets or joint values are not of such a shape, not finite, or outside the limits; there is no
            measurement frame.
    """
    if world and position is None:
        raise InputError("world", "joint values reach poses in the base frame", "targets with positions")
    number = calibration.table_in_world(table) if world else None
    nominal, posterior = nominal_robot(calibration), calibration.posterior
    return correct_targets(posterior, calibration.robot, nominal, position, rotation, near=near, table=number)


def nominal_robot(calibration: Calibration) -> Robot:
    """The robot that a calibration began with."""
    return calibration.robot.with_values([p.nominal for p in calibration.result.parameters])
