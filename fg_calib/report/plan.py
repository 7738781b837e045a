"""The report of `fg-calib design`: what to measure, and what to expect of it."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.designs.design import Design
from fg_calib.observability.parallel_axes import missing_motions
from fg_calib.prediction.tool_pose import PoseRms
from fg_calib.report.tables import SHOWN, indented, line, plain_table, rounded, section
from fg_calib.simulation.scenario import RandomReadings

SCHEMA = "fg-calib/design/1"

_MOST = 40
"""Stops that the report lists; the table has them all."""

UNKNOWN_ABOVE = 10.0
"""Errors [m] that are called unknown: they say how weak the weakest prior is."""

# --- for programs ---


def design_document(design: Design) -> dict[str, Any]:
    """A design for programs, in [m] and [rad]; null where it is not known.

    Args:
        design: The design.
    """
    return {
        "schema": SCHEMA,
        "robot": design.pool.robot.name,
        "criterion": design.criterion,
        "n": design.n,
        "n_given": len(design.pool.given),
        "target": design.target,
        "reached": design.reached,
        "fitted": design.task.fitted,
        "expected": asdict(design.expected),
        "before": None if design.before is None else asdict(design.before),
        "random": _finite(design.random),
        "undetermined_share": design.unknown,
        "curve": [
            {"n": p.n, "designed": _finite(p.designed), "random": [_finite(v) for v in p.random]} for p in design.curve
        ],
        "pairings": {name: _finite(error) for name, error in design.pairings.items()},
        "candidates": {
            name or "all": {"asked": one.asked, "taken": len(one.readings), "rejected": dict(one.rejected)}
            for name, one in design.pool.found.items()
        },
        "stops": [
            {"id": name, "table": table or None, "readings": q}
            for name, table, q in zip(design.ids.tolist(), design.group.tolist(), design.readings.tolist(), strict=True)
        ],
        "pairs": None if design.pairs is None else design.ids[design.pairs].tolist(),
        "undetermined": [{"relation": relation} for relation in design.observability.lost],
        "travel": design.travel,
        "travel_unordered": design.travel_before,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- for people ---


def build_design_report(design: Design) -> RenderableType:
    """A design for the terminal.

    Args:
        design: The design.
    """
    parts: list[RenderableType] = [line(_headline(design), "bold")]
    parts += section("Expected", *indented(_expected(design)))
    parts += section("Stops and accuracy", _curve(design))
    if design.pairings:
        parts += section("Which pairs", _pairs(design))
    parts += section("Where to measure", _stops(design))
    return Group(*parts, *section("Notes", *indented(_notes(design))))


def error_counts(design: Design) -> str:
    """Where a design's errors count."""
    return "after the best rigid fit" if design.task.fitted else "in the base frame"


def _headline(design: Design) -> str:
    n, name = design.n, design.pool.robot.name
    stops = f"{n} stop{'s' * (n > 1)}"
    if design.pairs is not None:
        stops += f" in {len(design.pairs)} pair{'s' * (len(design.pairs) > 1)}"
    if design.target is None:
        return f"{name}: where to measure at {stops}"
    what = f"expected RMS error of {_mm(design.target)}"
    if design.reached:
        return f"{name}: {stops} for an {what}"
    return f"{name}: {stops} do not reach an {what}"


def _expected(design: Design) -> list[str]:
    lines = [f"RMS error of the tool over the task, {error_counts(design)}: {_pose(design.expected)}"]
    if design.before is not None:
        lines.append(f"with what there is already: {_pose(design.before)}")
    last = design.curve[-1].n
    random = "random stops, as many" if design.structure in ("", "star") else f"stars of {last} random stops"
    better = f"{random}: {_mm(design.random)}"
    if design.expected.position:
        better += f" ({design.random / design.expected.position:.2f} times that)"
    lines.append(better)
    equal = next((p.n for p in design.curve if p.designed <= design.random), None)
    if equal is not None and equal < last:
        lines.append(f"{equal} designed stops do what {last} random ones do")
    return lines


def _curve(design: Design) -> RenderableType:
    """Expected errors by the number of poses."""
    headings = (("stops", "right"), ("designed mm", "right"), ("random mm", "right"), ("80 % of random", "right"))
    table = plain_table(*headings)
    for point in design.curve:
        low, middle, high = point.random
        table.add_row(str(point.n), _figure(point.designed), _figure(middle), f"{_figure(low)} to {_figure(high)}")
    return table


def _pairs(design: Design) -> RenderableType:
    table = plain_table(("pairs", "left"), ("expected mm", "right"), ("", "left"))
    words = {
        "star": "each with the first",
        "chain": "each with the one before",
        "all": "all that can be formed",
    }
    for name, error in design.pairings.items():
        table.add_row(name, _figure(error), words[name] + (", chosen" if name == design.structure else ""))
    return table


def _stops(design: Design) -> RenderableType:
    units = [SHOWN[joint.unit] for joint in design.pool.robot.joints]
    names = [f"{j.name} {unit}" for j, (_, unit, _) in zip(design.pool.robot.joints, units, strict=True)]
    own = bool(np.any(design.group != ""))
    table = plain_table(("stop", "left"), *((name, "right") for name in names), *([("table", "left")] if own else []))
    for name, group, q in zip(design.ids[:_MOST], design.group[:_MOST], design.readings[:_MOST].tolist(), strict=True):
        figures = [rounded(v * factor, 1) for v, (factor, _, _) in zip(q, units, strict=True)]
        table.add_row(line(str(name)), *figures, *([line(str(group) or "all others")] if own else []))
    return table


def _notes(design: Design) -> list[str]:
    notes = []
    for name, one in design.pool.found.items():
        of = f" of {name}" if name else ""
        notes.append(f"candidates{of}: {one.reasons()}")
    notes += [f"{name}: none of its own stops was chosen, and it gets no table" for name in _without_stops(design)]
    notes += [f"{name}: lengths of {_mm(low)} to {_mm(high)}" for name, (low, high) in _lengths(design).items()]
    notes += [str(one) for one in missing_motions(design.pool.robot)]
    if _is_anywhere(design):
        notes.append("a job says of no boxes and no lines of sight: --candidates SCENARIO takes those of a scenario")
    turn = math.degrees(design.travel)
    notes.append(f"joint travel along the stops {turn:.0f} deg, {math.degrees(design.travel_before):.0f} unordered")
    if design.n > _MOST:
        notes.append(f"{design.n - _MOST} more stops: --out writes them all")
    best = min(design.pairings, key=lambda name: design.pairings[name], default="")
    if design.pairs is None and best and design.pairings[best] < 0.95 * (design.expected.position or math.inf):
        notes.append(f"pairing: {best} in the job takes more from the same measurements")
    if design.observability.lost:
        n = len(design.observability.lost)
        notes.append(
            f"{n} direction{'s stay' if n > 1 else ' stays'} undetermined: fg-calib observe says which and why"
        )
    if design.expected.position is None:
        notes.append("the error over the task depends on what nothing that is measured determines")
    if design.target is not None and not design.reached:
        notes.append(
            "more stops would not do: lower noise, other kinds of measurement or a wider range of stops would"
            if _is_flat(design)
            else "all candidates are taken: --candidates draws more"
            if design.n >= design.n_candidates
            else "more stops may do: state them with --n"
        )
    if design.asked is not None and design.n < design.asked and design.pairs is None:
        notes.append(f"no more than {design.n} stops were found of {design.asked}: --candidates draws more")
    after = math.inf if design.after_fit is None else design.after_fit.position or math.inf
    if design.after_fit is not None and after < 0.5 * (design.expected.position or 0.0):
        notes.append(
            f"most of it is where the base stands: after the best rigid fit {_pose(design.after_fit)}; "
            "--error fitted chooses for that"
        )
    return notes


def _lengths(design: Design) -> dict[str, tuple[float, float]]:
    """The shortest and the longest length that each instrument would measure, [m]: of bars, wires and the like."""
    found = {}
    for table in design.tables:
        m = table.measurements
        between = m.pairs if m.groups is None else m.groups.pairs
        lengths = m.length if between is None else between.distance
        if lengths is not None and table.model != "plane" and np.nan_to_num(lengths).any():
            found[Path(m.source).stem] = (float(np.nanmin(lengths)), float(np.nanmax(lengths)))
    return found


def _without_stops(design: Design) -> list[str]:
    """Instruments that have stops of their own, none of which was chosen."""
    return sorted(set(design.pool.group.tolist()).difference(design.group.tolist(), [""]))


def _is_anywhere(design: Design) -> bool:
    """Whether more rows of a job were chosen anywhere within the joint limits."""
    scenario = design.pool.scenario
    if design.pool.before is None or scenario is None:
        return False
    return isinstance(scenario.configurations, RandomReadings) and not scenario.configurations.keep_out


def _is_flat(design: Design) -> bool:
    """Whether the last half of the stops gained less than a tenth."""
    half = min(design.curve, key=lambda p: abs(p.n - design.n / 2))
    return half.designed < 1.1 * design.curve[-1].designed


def _pose(error: PoseRms) -> str:
    turn = "unknown" if error.orientation is None else f"{math.degrees(error.orientation):.4f} deg"
    return f"{_mm(error.position)}, {turn}"


def _mm(value: float | None) -> str:
    return "unknown" if value is None or not math.isfinite(value) else f"{_figure(value)} mm"


def _figure(value: float) -> str:
    if value >= UNKNOWN_ABOVE:
        return "unknown"
    return f"{value * 1e3:.3g}" if value < 0.9995 else f"{value * 1e3:.0f}"
