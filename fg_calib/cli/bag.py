"""`fg-calib bag`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from rich.console import Group

from fg_calib import importers, io, report
from fg_calib.cli.output import BaseLink, Json, TipLink, argument, names_in, option, say, show_result

_OFFSET = "Stamp of a pose minus that of the joints at the same moment, in s; 0: as stamped."


def bag(
    recording: Annotated[Path, argument("BAG", "A ROS bag: .bag, .db3, .mcap, or a folder of ROS 2.")],
    robot: Annotated[Path, option("--robot", "ROBOT", "The robot: robot.yaml or a URDF.")],
    joints: Annotated[str | None, option("--joints", "TOPIC", "Topic of joint states.")] = None,
    pose: Annotated[str | None, option("--pose", "TOPIC", "Topic of the tool's measured poses.")] = None,
    out: Annotated[Path | None, option("--out", "CSV", "Write the table of poses there.")] = None,
    still: Annotated[float, option("--still", None, "How long the arm stands still at least, in s.")] = 1.0,
    offset: Annotated[float | None, option("--offset", None, _OFFSET)] = None,
    most_offset: Annotated[float | None, option("--most-offset", None, "Largest offset accepted, in s.")] = None,
    names: Annotated[str, option("--names", "NAMES", "The bag's names of the joints: shoulder,elbow,wrist.")] = "",
    parent: Annotated[str | None, option("--parent", "FRAME", "Frame in which poses are measured.")] = None,
    child: Annotated[str | None, option("--child", "FRAME", "Frame on the tool that is measured.")] = None,
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    as_json: Json = False,
) -> None:
    """Make a table of poses from a ROS bag: joint readings and poses while the arm stands still, with their sigmas."""
    if out is not None:
        io.require_absent(out.parent, [out.name])
    arm = io.read_robot(robot, base_link=base_link, tip_link=tip_link)
    topics = {"joints": joints, "pose": pose, "parent": parent, "child": child}
    of_joints, of_pose = importers.read_bag(recording, arm, **topics, names=names_in(names))
    stops = importers.average_stops(of_joints, of_pose, arm, still=still, offset=offset, most_offset=most_offset)
    if out is not None:
        importers.write_stops(out, stops, arm)
    found = recording.name, {"joints": _topic(of_joints), "pose": _topic(of_pose)}, stops
    show_result(as_json, _document, _report, *found)
    nothing = "nothing is written: --out poses.csv writes the table"
    say(nothing if out is None else f"wrote {len(stops.ids)} poses to {out}")


def _topic(stream: "importers.JointStream | importers.PoseStream") -> dict[str, Any]:
    return asdict(stream.source) | {"messages": len(stream.time), "period": importers.period(stream.time)}


def _document(name: str, topics: dict[str, Any], stops: "importers.Stops") -> dict[str, Any]:
    """The content of the recording for programs: [m], [rad], [s]."""
    found = {"n_found": len(stops.ids) + len(stops.skipped), "n_written": len(stops.ids)}
    offsets = {"offset": stops.offset, "applied_offset": stops.applied}
    more = {"topics": topics, **offsets, **found, "skipped": stops.skipped, "scatter": stops.scatter}
    return report.plain({"schema": "fg-calib/bag/1", "bag": name, **more})


def _report(name: str, topics: dict[str, Any], stops: "importers.Stops") -> Group:
    """The content of the recording for the terminal: topics, clocks, scatter and what is left out."""
    named, n = zip(("joints", "poses"), topics.values(), strict=True), len(stops.ids)
    streams = [(what, t["topic"], t["type"], t["messages"], 1.0 / t["period"]) for what, t in named]
    units = {"position": "mm", "joint": "mrad or mm"}
    columns, scatter, rough = ("", "of one|>", "of the mean|>", "correlated over|>"), [], []
    for what, s in stops.scatter.items():
        cells = (f"{v * 1e3:.3g} {units.get(what, 'mrad')}" for v in (s.single, s.mean))
        scatter.append((what, *cells, f"{s.correlation_samples:.3g} samples"))
        if s.slow and what != "joint":
            rough.append(f"noise of {what} is slower than the stops are long: its sigmas are rough")
    return report.report(
        report.line(f"{name}: {n + len(stops.skipped)} stops found, {n} used, {len(stops.skipped)} skipped", "bold"),
        report.table_of(("", "topic", "type", "messages|d", "Hz|.4g"), streams),
        *(f"{t['topic']}: {note}" for t in topics.values() for note in t["notes"]),
        *report.section("Clocks", *_clocks(stops)),
        *report.section("Scatter during stops", report.table_of(columns, scatter), *rough),
        *report.section("Skipped", *(f"{s.id} at {s.begin:.1f} s: {s.reason}" for s in stops.skipped)),
    )


def _clocks(stops: "importers.Stops") -> list[str]:
    if (offset := stops.offset) is None:
        return [f"offset {stops.applied:.6g} s as specified"]
    return [
        f"poses are stamped {offset.seconds:+.2f} s against the joints, which is taken out",
        f"speeds by joints and by poses correlate by {offset.correlation:.3f}",
    ]
