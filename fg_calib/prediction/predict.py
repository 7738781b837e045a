"""What to expect of a calibrated arm's tool: errors at configurations, or all over the workspace.

It is what the covariance says: what is left of the noise and tolerances that were stated. What the model lacks, such as
joints that give way, is no part of it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import as_floats
from fg_calib.calibration import Calibration
from fg_calib.errors import InputError
from fg_calib.io.atomic import fill_folder, require_own, require_writable, write_text
from fg_calib.io.units import Units
from fg_calib.measurements.checks import check_readings
from fg_calib.options import check_number
from fg_calib.prediction.prediction import PredictedErrors, predict_errors
from fg_calib.prediction.tool_pose import ToolErrorModel
from fg_calib.report.charts import write_charts
from fg_calib.report.figures import error_slices
from fg_calib.report.predict import prediction_document, write_prediction_table
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]


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
    model = ToolErrorModel.of(found.posterior, there, joint_noise_of(found))
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


FILES = {
    "predict.json": b'{\n "schema": "fg-calib/predict/',
    "predict.csv": b"id,",
    "predict.svg": b"<svg",
}
"""What `write_prediction` may write, and how it begins."""


def require_prediction(folder: Path) -> None:
    """Check that a prediction can be written to a folder, and would not replace what is of none.

    Raises:
        InputError: It cannot, or it would.
    """
    require_writable(folder)
    require_own(folder, FILES)


@checked
def write_prediction(
    folder: Path | str,
    found: PredictedErrors,
    calibration: Calibration,
    *,
    ids: Sequence[str] = (),
    units: Units | None = None,
) -> None:
    """Write `predict.json` and `predict.csv` into a folder, all or none; over the workspace also its picture.

    Args:
        folder: Where to.
        found: The prediction.
        calibration: What it is of.
        ids: Names of the configurations, where they were given.
        units: Of joint values and positions in the table; m and rad if None.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(prediction_document(found, calibration.result, ids), indent=1, allow_nan=False) + "\n"

    def write(into: Path) -> None:
        write_text(into / "predict.json", text)
        write_prediction_table(into / "predict.csv", found, calibration.robot, units or Units(), ids)
        if not found.given:
            errors = found.errors
            write_charts(
                into, {"predict": error_slices(errors.position, errors.of(found.fitted)[:, 0], found.measured)}
            )

    fill_folder(Path(folder), write, FILES)
