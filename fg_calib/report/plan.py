"""The report of `fg-calib design`: what to measure, what to expect of it, and the job to be filled in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from rich.console import Group, RenderableType

from fg_calib.analysis.accuracy import PoseRms
from fg_calib.designs.design import Design
from fg_calib.files.csv_writer import write_csv
from fg_calib.files.disk import fill_folder, write_text
from fg_calib.files.robot_yaml import write_robot
from fg_calib.files.simulated_tables import instrument_keys, require_empty, table_columns, to_fill_in
from fg_calib.files.units import Units
from fg_calib.files.urdf import write_urdf
from fg_calib.measurements.series import Table
from fg_calib.report.figures import empty_figure
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import indented, line, plain_table, rounded, section
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "fg-calib/design/1"

_BEGINNING = f'{{\n "schema": "{SCHEMA}"'.encode()
"""How `design.json` begins."""

CONFIGURATIONS = "configurations.csv"

_MOST = 40
"""Stops that the report lists; the table has them all."""

_JOB_WORDS = "# fg-calib design\n# What to measure: fill in the tables, then `fg-calib calibrate` this file.\n"

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


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
            for name, one in design.found.items()
        },
        "stops": [
            {"id": name, "table": table or None, "readings": q}
            for name, table, q in zip(design.ids.tolist(), design.group.tolist(), design.readings.tolist(), strict=True)
        ],
        "pairs": None if design.pairs is None else design.ids[design.pairs].tolist(),
        "undetermined": [
            {"relation": cure.relation, "reason": cure.reason, "determined_by": list(cure.by)} for cure in design.cures
        ],
        "travel": design.travel,
        "travel_unordered": design.travel_before,
    }


def designs_document(designs: Mapping[str, Design]) -> dict[str, Any]:
    """Designs of several instruments for programs.

    Args:
        designs: They, by the instruments' names.
    """
    return {"schema": SCHEMA, "instruments": {name: design_document(one) for name, one in designs.items()}}


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
    parts += section("Stops and accuracy", _curve({"designed": design}))
    if design.pairings:
        parts += section("Which pairs", _pairs(design))
    parts += section("Where to measure", _stops(design))
    if design.cures:
        parts += section("Still undetermined", _cures(design))
    return Group(*parts, *section("Notes", *indented(_notes(design))))


def build_instruments_report(designs: Mapping[str, Design]) -> RenderableType:
    """Designs of several instruments beside each other.

    Args:
        designs: They, by the instruments' names.
    """
    first = next(iter(designs.values()))
    parts: list[RenderableType] = [line(f"{first.pool.robot.name}: {len(designs)} instruments", "bold")]
    parts += section("RMS error over the task in mm", _curve(designs, random=False))
    table = plain_table(("instrument", "left"), ("stops", "right"), ("expected", "right"), ("undetermined", "right"))
    for name, one in designs.items():
        reached = str(one.n) if one.reached else f"more than {one.n}"
        table.add_row(line(name), reached, _mm(one.expected.position), str(len(one.cures)))
    return Group(*parts, *section("With so many stops", table))


def _headline(design: Design) -> str:
    n, name = design.n, design.pool.robot.name
    stops = f"{n} stop{'s' * (n > 1)}"
    if design.target is None:
        return f"{name}: where to measure at {stops}"
    what = f"expected RMS error of {_mm(design.target)}"
    if design.reached:
        return f"{name}: {stops} for an {what}"
    return f"{name}: {stops} do not reach an {what}"


def _expected(design: Design) -> list[str]:
    where = "after the best rigid fit" if design.task.fitted else "in the base frame"
    lines = [f"RMS error of the tool over the task, {where}: {_pose(design.expected)}"]
    if design.before is not None:
        lines.append(f"with what there is already: {_pose(design.before)}")
    better = f"random stops, as many: {_mm(design.random)}"
    if design.expected.position:
        better += f" ({design.random / design.expected.position:.2f} times that)"
    lines.append(better)
    equal = next((p.n for p in design.curve if p.designed <= design.random), None)
    if equal is not None and equal < design.n:
        lines.append(f"{equal} designed stops do what {design.n} random ones do")
    return lines


def _curve(designs: Mapping[str, Design], *, random: bool = True) -> RenderableType:
    """Expected errors by the number of stops."""
    several = len(designs) > 1
    headings = [(f"{name} mm" if several else "designed mm", "right") for name in designs]
    headings += [("random mm", "right"), ("80 % of random", "right")] if random else []
    table = plain_table(("stops", "right"), *headings)
    numbers = sorted({p.n for one in designs.values() for p in one.curve})
    points = [{p.n: p for p in one.curve} for one in designs.values()]
    for n in numbers:
        row = [_figure(of[n].designed) if n in of else "" for of in points]
        if random and n in points[0]:
            low, middle, high = points[0][n].random
            row += [_figure(middle), f"{_figure(low)} to {_figure(high)}"]
        table.add_row(str(n), *row)
    return table


def _pairs(design: Design) -> RenderableType:
    table = plain_table(("pairs", "left"), ("expected mm", "right"), ("", "left"))
    chosen = min(design.pairings, key=lambda name: design.pairings[name]) if design.pairs is not None else None
    words = {
        "star": "each with the first",
        "chain": "each with the one before",
        "tree": "each with the best that is there",
        "free": "the best of all",
        "all": "all that can be formed",
    }
    for name, error in design.pairings.items():
        table.add_row(name, _figure(error), words[name] + (", chosen" if name == chosen else ""))
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


def _cures(design: Design) -> RenderableType:
    table = plain_table(("direction", "left"), ("why", "left"), ("would be determined by", "left"), wrap=True)
    for cure in design.cures:
        what = " ".join(f"{change:+g} {name}" for name, change in cure.relation.items())
        by = cure.by[0] if cure.by else "nothing: the arm moves the same whatever it is"
        table.add_row(line(what), line(cure.reason), by)
    return table


def _notes(design: Design) -> list[str]:
    notes = []
    for name, one in design.found.items():
        of = f" of {name}" if name else ""
        notes.append(f"candidates{of}: {one.reasons()}")
    turn = math.degrees(design.travel)
    notes.append(f"joint travel along the stops {turn:.0f} deg, {math.degrees(design.travel_before):.0f} unordered")
    if design.n > _MOST:
        notes.append(f"{design.n - _MOST} more stops: --out writes them all")
    best = min(design.pairings, key=lambda name: design.pairings[name], default="")
    if design.pairs is None and best and design.pairings[best] < 0.95 * (design.expected.position or math.inf):
        notes.append(f"pairing: {best} in the job takes more from the same measurements")
    if design.expected.position is None:
        notes.append("the error over the task depends on what nothing that is measured determines")
    if design.target is not None and not design.reached:
        notes.append(
            "more stops would not do: lower noise, other kinds of measurement or a wider range of stops would"
            if _is_flat(design)
            else "more stops may do: state them with --n"
        )
    return notes


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
    return f"{value * 1e3:.3g}" if value < 10.0 else "unknown"


# --- pictures and files ---


def draw_designs(designs: Mapping[str, Design]) -> Figure:
    """Expected errors against the number of stops, with the band of random ones.

    Args:
        designs: They, by the instruments' names.
    """
    figure = empty_figure(6.0, 3.8)
    from matplotlib.ticker import LogLocator, NullFormatter

    axes = figure.add_subplot()
    several = len(designs) > 1
    for colour, (name, one) in zip(_COLOURS * len(designs), designs.items(), strict=False):
        n = np.array([p.n for p in one.curve])
        low, middle, high = np.array([p.random for p in one.curve]).T * 1e3
        designed = np.array([p.designed for p in one.curve]) * 1e3
        label = name if several else "designed"
        axes.plot(n, designed, "o-", color=colour, markersize=4, label=label)
        axes.fill_between(n, low, high, color=colour, alpha=0.12, linewidth=0)
        axes.plot(n, middle, "--", color=colour, linewidth=1.0, label=None if several else "random, and 80 % of them")
        if one.target is not None and name == next(iter(designs)):
            axes.axhline(one.target * 1e3, color="0.5", linewidth=0.9)
            axes.annotate(f"{one.target * 1e3:g} mm", (n[0], one.target * 1e3), (0, 3), textcoords="offset points",
                          fontsize=7, color="0.4")  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=7, which="both")
    axes.set_xlabel("stops", fontsize=8)
    axes.set_ylabel("expected RMS error over the task [mm]", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=7.5)
    first = next(iter(designs.values()))
    axes.set_title(f"{first.pool.robot.name}: what to expect of how many stops", fontsize=9, loc="left")
    return figure


def write_design(folder: Path, design: Design, units: Units) -> tuple[str, ...]:
    """Write where to measure, the job to be filled in, and what to expect.

    Args:
        folder: Where to.
        design: The design.
        units: Of the tables and the job.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds files of these names that are no design's, or tables that
            were filled in.
    """
    import json

    robot = design.pool.robot if design.pool.before is None else design.pool.before.robot
    tables = design.tables if design.pool.scenario is not None else ()
    files = {
        name: to_fill_in(columns, touched=_is_touched(t))
        for t in tables
        for name, columns in table_columns(t, robot, units).items()
    }
    figure = draw_designs({"": design})
    urdf = "robot.urdf" if robot.urdf is not None and tables else None

    def write(into: Path) -> None:
        write_csv(into / CONFIGURATIONS, _configurations(design, robot, units))
        write_text(into / "design.json", json.dumps(design_document(design), indent=1) + "\n")
        figure.savefig(into / "design.png", dpi=160)
        if not tables:
            return
        for name, columns in files.items():
            write_csv(into / name, columns)
        if urdf is not None:
            write_urdf(into / urdf, robot)
        write_robot(into / "robot.yaml", robot, units=units, urdf_name=urdf)
        write_text(into / "calibration.yaml", _JOB_WORDS + _job_text(design, units))

    names = [CONFIGURATIONS, "design.json", "design.png"]
    if tables:
        names += [*files, "robot.yaml", *([urdf] if urdf else []), "calibration.yaml"]
    for name, columns in files.items():
        require_empty(folder / name, columns)
    whose = {"design.json": _BEGINNING}  # first: by that the others are this command's too
    own = whose | dict.fromkeys(names, b"") | {"calibration.yaml": _JOB_WORDS.encode()} | whose
    fill_folder(folder, write, own)
    return tuple(names)


def write_designs(folder: Path, designs: Mapping[str, Design], units: Units) -> tuple[str, ...]:
    """Write designs of several instruments, a folder each, and their picture.

    Args:
        folder: Where to.
        designs: They, by the instruments' names.
        units: Of the tables and jobs.
    """
    names = [f"{name}/{file}" for name, one in designs.items() for file in write_design(folder / name, one, units)]
    figure = draw_designs(designs)
    fill_folder(folder, lambda into: figure.savefig(into / "instruments.png", dpi=160), {"instruments.png": b"\x89PNG"})
    return (*names, "instruments.png")


def _is_touched(table: Table) -> bool:
    """Whether something is touched, so that it is the joint readings that are measured."""
    m = table.measurements
    contact = table.model in ("anchor", "plane") and not np.any(0.0 if m.length is None else m.length)
    return m.groups is not None or contact


def _configurations(design: Design, robot: Robot, units: Units) -> dict[str, Any]:
    """Where to go, in order, and where the tool then is by the arm as it is known."""
    at = pose(design.pool.robot, design.readings).position
    return {
        "id": design.ids,
        **{f"q{i + 1}": design.readings[:, i] / units.factor(joint.unit) for i, joint in enumerate(robot.joints)},
        "table": np.where(design.group == "", "all" if np.any(design.group != "") else "", design.group),
        **{f"tool_{axis}": at[:, k] / units.factor("m") for k, axis in enumerate("xyz")},
    }


def _job_text(design: Design, units: Units) -> str:
    """The job of the tables that are to be filled in."""
    scenario = design.pool.scenario
    assert scenario is not None
    robot, sigma = design.pool.robot, design.tables[0].measurements.sigma_joint
    joint = [units.from_si(s, j.unit) for s, j in zip(sigma, robot.joints, strict=True)]
    keys = {key: value for key, value in scenario.job.items() if key not in ("model", "pairing", "noise")}
    job: dict[str, Any] = {"robot": "robot.yaml", **keys, "units": asdict(units)}
    job |= {"noise": {"joint": joint[0] if len(set(joint)) == 1 else joint}}
    job |= instrument_keys(design.tables, units)
    return yaml.safe_dump(job, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf)


def names_of_files(paths: Sequence[Path]) -> list[str]:
    """A name for each file: its own without the ending, with a number where others have the same."""
    stems = [path.stem for path in paths]
    return [s if stems.count(s) == 1 else f"{s}_{stems[: k + 1].count(s)}" for k, s in enumerate(stems)]
