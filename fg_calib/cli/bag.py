"""`fg-calib bag`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import BaseLink, Json, TipLink, say, show_json, show_report

_Bag = Annotated[Path, typer.Argument(metavar="BAG", help="A ROS bag: .bag, .db3, .mcap, or a folder of ROS 2.")]
_Robot = Annotated[Path, typer.Option("--robot", metavar="ROBOT", help="The robot: robot.yaml or a URDF.")]
_Joints = Annotated[str | None, typer.Option("--joints", metavar="TOPIC", help="Topic of joint states.")]
_Pose = Annotated[str | None, typer.Option("--pose", metavar="TOPIC", help="Topic of the tool's measured poses.")]
_Out = Annotated[Path | None, typer.Option("--out", metavar="CSV", help="Write the table of poses there.")]
_Still = Annotated[float, typer.Option("--still", help="How long the arm stands still at least, in s.")]
_Offset = Annotated[
    float | None,
    typer.Option("--offset", help="Stamp of a pose less that of the joints at the same moment, in s; 0: as stamped."),
]
_MostOffset = Annotated[
    float | None, typer.Option("--most-offset", help="Refuse the bag where the estimated offset is larger, in s.")
]
_Names = Annotated[
    str, typer.Option("--names", metavar="NAMES", help="The bag's names of the robot's joints: shoulder,elbow,wrist.")
]
_Parent = Annotated[str | None, typer.Option("--parent", metavar="FRAME", help="Frame in which poses are measured.")]
_Child = Annotated[str | None, typer.Option("--child", metavar="FRAME", help="Frame on the tool that is measured.")]


def bag(
    recording: _Bag,
    robot: _Robot,
    joints: _Joints = None,
    pose: _Pose = None,
    out: _Out = None,
    still: _Still = 1.0,
    offset: _Offset = None,
    most_offset: _MostOffset = None,
    names: _Names = "",
    parent: _Parent = None,
    child: _Child = None,
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    as_json: Json = False,
) -> None:
    """Make a table of poses from a ROS bag: joint readings and poses while the arm stands still, with their sigmas."""
    from fg_calib.importers.bag import read_bag
    from fg_calib.importers.standstill import average_stops, require_replaceable, write_stops
    from fg_calib.io.robot_file import read_robot
    from fg_calib.report.bag import bag_document, build_bag_report

    if out is not None:
        require_replaceable(out)
    arm = read_robot(robot, base_link=base_link, tip_link=tip_link)
    called = [name.strip() for name in names.split(",") if name.strip()]
    of_joints, of_pose = read_bag(recording, arm, joints=joints, pose=pose, parent=parent, child=child, names=called)
    stops = average_stops(of_joints, of_pose, arm, still=still, offset=offset, most_offset=most_offset)
    try:
        if as_json:
            show_json(bag_document(recording.name, of_joints, of_pose, stops))
        else:
            show_report(build_bag_report(recording.name, of_joints, of_pose, stops))
    finally:  # also where nobody takes the report
        if out is not None:
            write_stops(out, stops, arm)
    if out is None:
        say("nothing is written: --out poses.csv writes the table")
    else:
        say(f"wrote {len(stops.ids)} poses to {out}")
