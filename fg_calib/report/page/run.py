"""A calibration as its folder holds it: all that the page shows."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fg_calib.io.columns import PIECE
from fg_calib.io.result import Result
from fg_calib.io.saved import SavedConfigurations, SavedResiduals
from fg_calib.prediction.tool_pose import ToolErrorModel
from fg_calib.prediction.workspace import Workspace, survey
from fg_calib.report.shown import FAMILY_UNIT
from fg_calib.robot.model import Robot
from fg_calib.statistics.covariance import TangentCovariance

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """One calibration.

    Attributes:
        folder: Where it is.
        result: What `result.json` holds.
        robot: The calibrated robot.
        posterior: The covariance of its parameters.
        configurations: What was measured where; None where the folder lacks it.
        residuals: Row by row; None where the folder lacks them.
        written: When `result.json` was written.
    """

    folder: Path
    result: Result
    robot: Robot
    posterior: TangentCovariance
    configurations: SavedConfigurations | None
    residuals: SavedResiduals | None
    written: datetime

    @property
    def held_out(self) -> bool:
        """Whether test rows were held out, by which the arm may be judged."""
        return any(rms is not None for rms in self.result.residual_rms.get("test", {}).values())

    @property
    def judged_on(self) -> str:
        """The rows that accuracy is shown of: test rows where there are any."""
        return "test" if self.held_out else "train"

    @property
    def command(self) -> str | None:
        """The command that repeats the calibration from the folder of its job; None where it had no job."""
        job = next(iter(self.result.inputs), None)
        if job is None:
            return None
        folds = [] if self.result.folds is None else ["--folds", f"{self.result.folds.n}"]
        parts = ["--parts", str(PIECE)] if self.result.in_parts else []
        return shlex.join(["fg-calib", "calibrate", job, "--out", self.folder.name or "result", *folds, *parts])

    @property
    def free_of_frame(self) -> bool:
        """Whether nothing was measured in the base frame, so that errors count after the best rigid fit."""
        return self.result.free_of_frame

    @cached_property
    def workspace(self) -> Workspace | None:
        """Expected errors over the workspace; None where nothing says what was measured."""
        if self.configurations is None or not len(self.configurations.ids):
            return None
        measured = self.configurations.readings
        model = ToolErrorModel.of(self.posterior, measured)
        return survey(self.robot, model, measured, fitted=self.free_of_frame)

    @property
    def family(self) -> str | None:
        """The kind of residual that configurations are coloured by: the one nearest to where the tool is."""
        there: Mapping[str, Floats] = {} if self.configurations is None else self.configurations.rms
        order = [f for f in ("position", "distance", "point", "pixel") if f in there] + list(there)
        return next((f for f in order if np.isfinite(there[f]).any()), None)

    def unit(self, family: str) -> str:
        """`m`, `rad` or `px`."""
        for kinds in self.result.residual_rms.values():
            rms = kinds.get(family)
            if rms is not None and rms.unit is not None:
                return rms.unit
        return FAMILY_UNIT.get(family, "m")


def written_at(path: Path) -> datetime:
    """When a file was written last."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC)
