"""A calibration job: a robot, what was measured of it, and every choice."""

from dataclasses import field, replace
from pathlib import Path
from typing import Any

from fg_calib.inputs import Brief, Floats, Options, check_fields
from fg_calib.measurements import Measurements, Table
from fg_calib.robot import Robot


class Job(Brief):
    """A calibration job with everything it refers to.

    Attributes:
        path: The job's file; None of a job that is in none.
        robot: The robot as it is before the calibration.
        measurements: One table, understood as the options say, or several.
        options: Every choice.
        truth: The robot as it truly is, known from a simulation; None where it is not.
        inputs: SHA-256 of every file read, by its path relative to the job.
        document: The job as its file has it, without its robot, and with its cameras in it.
        keep_out: Lower and upper corners in the base frame of boxes that new configurations keep out of, [m].
    """

    path: Path | None
    robot: Robot
    measurements: Measurements | tuple[Table, ...]
    options: Options
    truth: Robot | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    document: dict[str, Any] = field(default_factory=dict)
    keep_out: tuple[Floats, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, "job: ")
        if self.options.gauge == "prior" and self.robot.estimates_zeros_freely:
            # a zero that nothing determines stays nominal
            object.__setattr__(self, "options", replace(self.options, gauge="keep"))

    @property
    def tables(self) -> tuple[Table, ...]:
        """Measurements, table by table."""
        if not isinstance(self.measurements, Measurements):
            return self.measurements
        return (Table(self.measurements, self.options.model, self.options.pairing, self.options.frame),)

    @property
    def model(self) -> str:
        """The models of all tables, in words."""
        return " + ".join(dict.fromkeys(table.model or "own" for table in self.tables))
