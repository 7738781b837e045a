"""`fg-calib convert`."""

from pathlib import Path
from typing import Annotated, Literal

from fg_calib.cli.export import show_export
from fg_calib.cli.output import Json, argument, option

Description = Literal["dh", "mdh", "mdh-hayati", "dh-hayati", "poe", "cpc", "urdf"]


def convert(
    robot: Annotated[Path, argument("ROBOT", "robot.yaml or a URDF.")],
    to: Annotated[Description, option("--to", None, "The convention.")],
    out: Annotated[Path | None, option("--out", "FILE", "A new file; on stdout if not given.")] = None,
    as_json: Json = False,
) -> None:
    """Describe a robot by another convention, and say how exactly."""
    from fg_calib.exports.export import export
    from fg_calib.io import read_robot

    show_export(export(read_robot(robot), "hayati" if to == "dh-hayati" else to), out, as_json)
