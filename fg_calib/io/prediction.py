"""What `fg-calib predict` reads, a table of configurations, and what its document holds.

`predict.schema.json` beside this file is the JSON schema of `predict.json`: [m] and [rad], None for what is not known.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from fg_calib.arguments import checked
from fg_calib.io.columns import Table
from fg_calib.io.result import Figure, Position, Row, Section, Sigma, Sigmas, Whole
from fg_calib.io.tables import find_joint_columns, header_for, read_ids, read_readings
from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Floats
from fg_calib.robot.model import Robot

SCHEMA: Literal["fg-calib/predict/1"] = "fg-calib/predict/1"


class Sizes(Section):
    """Errors over all configurations: RMS, median, 95 % quantile and largest."""

    rms: Sigma
    median: Sigma
    p95: Sigma
    largest: Sigma


class Kinds(Section):
    """Errors of the tool's position and orientation."""

    position: Sizes
    orientation: Sizes


class Expected(Section):
    """Errors in the base frame, after the best rigid fit of what was measured, and of joint readings alone.

    `total` are those that count (see `counts`) with those of joint readings; both None where their noise is not known.
    """

    base: Kinds
    fitted: Kinds
    joint_noise: Kinds | None
    total: Kinds | None


class Share(Section):
    """A parameter that errors follow: were it known, the expected square would fall by `share`.

    `change` is its error that goes with 1 sigma along the longest axis of the worst error.
    """

    name: str
    unit: str
    share: Sigma
    change: Figure = None
    identifiability: str


class Errors(Section):
    """Expected errors at one configuration."""

    position: Sigma
    orientation: Sigma


class Configuration(Section):
    """Expected errors at one configuration; `near`: something was measured near it."""

    id: str
    readings: Row
    position: Position
    base: Errors
    fitted: Errors
    joint_noise: Errors | None
    near: bool


class Worst(Configuration):
    """Where the error that counts is largest: 1 `sigma` along each of the `axes` of its ellipsoid, longest first."""

    axes: tuple[Position, Position, Position]
    sigma: Sigmas
    responsible: tuple[Share, ...]


class Prediction(Section):
    """What `fg-calib predict --json` prints, and `predict.json` holds.

    `counts` says which errors do: `fitted` where nothing was measured in the base frame. Of an error over the
    `workspace` there are `n` drawn configurations, and `configurations` is empty. `unknown`, `far` (nothing measured
    near) and `within` (the `limit`) are shares of them, 0 to 1.
    """

    schema_: Literal["fg-calib/predict/1"] = Field(alias="schema")
    version: str
    robot: str
    trustworthy: bool
    findings: tuple[str, ...]
    reservations: tuple[str, ...]
    at: Literal["workspace", "configurations"]
    n: Whole
    counts: Literal["base", "fitted"]
    expected: Expected
    unknown: float
    undetermined: tuple[str, ...]
    far: float
    limit: Sigma
    within: float | None
    worst: Worst | None
    responsible: tuple[Share, ...]
    configurations: tuple[Configuration, ...]


def prediction_schema() -> dict[str, Any]:
    """The JSON schema of `predict.json`."""
    return Prediction.model_json_schema(by_alias=True)


@checked
def read_joint_table(
    path: Path | str | Any, robot: Robot, units: Units | None = None
) -> tuple[tuple[str, ...], Floats]:
    """Names of configurations, and their joint values, shape (n, n_joints), [rad] (prismatic: [m]).

    Args:
        path: The table: a file, or a frame of polars or pandas.
        robot: Whose joints they are of: names, number and limits.
        units: Of the table; default m and rad.

    Raises:
        InputError: The file is missing, is no table, lacks columns or holds a cell that cannot be used.
    """
    header = header_for(path, robot, {})
    joints = find_joint_columns(header, robot)
    table = Table.read(header, numbers=joints, texts=header.present("id"))
    return tuple(read_ids(table, repeated=True).to_list()), read_readings(table, joints, robot, units or Units())
