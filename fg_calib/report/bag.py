"""The report on what a recording held: topics, clocks, stops."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType

from fg_calib.importers.recording import JointStream, PoseStream, period
from fg_calib.importers.standstill import Stops
from fg_calib.report.tables import indented, line, plain_table, section


def bag_document(name: str, joints: JointStream, poses: PoseStream, stops: Stops) -> dict[str, Any]:
    """What was found, as JSON: [m], [rad], [s]."""
    offset = stops.offset
    return {
        "schema": "fg-calib/bag/1",
        "bag": name,
        "topics": {
            what: {
                "topic": stream.source.topic,
                "type": stream.source.kind,
                "messages": len(stream.time),
                "period": period(stream.time),
                "notes": list(stream.source.notes),
            }
            for what, stream in (("joints", joints), ("pose", poses))
        },
        "offset": None
        if offset is None
        else {
            "seconds": offset.seconds,
            "sigma": offset.sigma,
            "n_moves": offset.n_moves,
            "correlation": offset.correlation,
            "others": list(offset.others),
        },
        "applied_offset": stops.applied,
        "n_found": len(stops.ids) + len(stops.skipped),
        "n_written": len(stops.ids),
        "skipped": [{"id": s.id, "begin": s.begin, "reason": s.reason} for s in stops.skipped],
        "scatter": {
            what: {"single": s.single, "mean": s.mean, "correlation_samples": s.correlation, "slow": s.slow}
            for what, s in stops.scatter.items()
        },
    }


def build_bag_report(name: str, joints: JointStream, poses: PoseStream, stops: Stops) -> RenderableType:
    """What was found, for people."""
    n, skipped = len(stops.ids), len(stops.skipped)
    title = f"{name}: {n + skipped} stops found, {n} used, {skipped} skipped"
    parts: list[RenderableType] = [line(title, "bold"), line(""), _streams(joints, poses)]
    notes = [f"{s.source.topic}: {note}" for s in (joints, poses) for note in s.source.notes]
    parts += indented(notes)
    parts += section("Clocks", *indented(_clocks(stops)))
    parts += section("Scatter during stops", _scatter(stops), *indented(_slow(stops)))
    if skipped:
        parts += section("Skipped", *indented(f"{s.id} at {s.begin:.1f} s: {s.reason}" for s in stops.skipped))
    return Group(*parts)


def _streams(joints: JointStream, poses: PoseStream) -> RenderableType:
    table = plain_table(("", "left"), ("topic", "left"), ("type", "left"), ("messages", "right"), ("Hz", "right"))
    for what, stream in (("joints", joints), ("poses", poses)):
        rate = f"{1.0 / period(stream.time):.4g}"
        table.add_row(what, line(stream.source.topic), line(stream.source.kind), str(len(stream.time)), rate)
    return table


def _clocks(stops: Stops) -> list[str]:
    offset = stops.offset
    if offset is None:
        return [f"offset {stops.applied:.6g} s as stated; it could not be estimated"]
    lines = [
        f"poses are stamped {offset.seconds:+.6f} +- {offset.sigma:.6f} s against the joints",
        f"from {offset.n_moves} moves; speeds by joints and by poses correlate by {offset.correlation:.3f}",
    ]
    applied = stops.applied
    lines.append("this offset is taken out" if applied == offset.seconds else f"stated and used: {applied:.6g} s")
    if offset.others:
        listed = ", ".join(f"{other:+.2f}" for other in offset.others[:3])
        lines.append(f"motions repeat themselves: offsets of {listed} s fit nearly as well; --offset states it")
    return lines


def _scatter(stops: Stops) -> RenderableType:
    table = plain_table(("", "left"), ("of one", "right"), ("of the mean", "right"), ("correlated over", "right"))
    for what, s in stops.scatter.items():
        unit, factor = ("mm", 1e3) if what == "position" else ("mrad", 1e3)
        if what == "joint":
            unit = "mrad or mm"
        over = f"{s.correlation:.3g} samples"
        table.add_row(what, f"{s.single * factor:.3g} {unit}", f"{s.mean * factor:.3g} {unit}", over)
    return table


def _slow(stops: Stops) -> list[str]:
    """What to know of sigmas where noise is slower than stops are long."""
    slow = [what for what, s in stops.scatter.items() if s.slow and what != "joint"]
    if not slow:
        return []
    what = " and ".join(slow)
    return [
        f"noise of {what} is slow beside the stops: they show it in part, and sigmas are rough; longer ones tell more"
    ]
