"""The report of `fg-calib design`, and the tables and the job that it writes: what to measure, and what to expect."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table as Shown

from fg_calib import inputs, measurements, observability, prediction, report, simulation
from fg_calib.designs import Design
from fg_calib.io import Units, fill_folder, require_absent, write_csv, write_robot, write_urdf
from fg_calib.report.charts import Chart, Plot, limits_of, standalone
from fg_calib.report.predict import FRAMES
from fg_calib.report.tables import in_words, line, section, table_of
from fg_calib.robot import Robot, pose

MAX_POSES_LISTED = 40
"""Poses that the report lists; the table has all."""

UNKNOWN_ABOVE = 10.0
"""Errors [m] that are called unknown: they only say how weak the weakest prior is."""


def design_document(design: Design) -> dict[str, Any]:
    """A design for programs, in [m] and [rad]; null for what is unknown."""
    return report.tables.document_of(
        "design",
        design,
        "criterion n target reached expected known_tool before random travel",
        robot=design.pool.robot.name,
        n_given=len(design.pool.given),
        fitted=design.task.fitted,
        undetermined_share=design.unknown,
        travel_unordered=design.travel_before,
        curve=[{"n": p.n, "designed": p.designed, "random": p.random} for p in design.curve],
        candidates={
            name or "all": {"asked": one.asked, "taken": len(one.readings), "rejected": one.rejected}
            for name, one in design.pool.found.items()
        },
        stops=[
            {"id": name, "table": table or None, "readings": q}
            for name, table, q in zip(design.ids, design.group, design.readings, strict=True)
        ],
        undetermined=[{"relation": relation} for relation in design.observability.lost],
    )


def build_design_report(design: Design) -> Group:
    """A design for the terminal."""
    curve = [
        (f"{p.n}", *map(_size, (p.designed, p.random[1])), " to ".join(map(_size, (p.random[0], p.random[2]))))
        for p in design.curve
    ]
    columns = ("poses|>", "designed mm|>", "random mm|>", "80 % of random|>")
    return report.tables.report(
        line(_headline(design), "bold"),
        *section("Expected", *_expected(design)),
        *section("Poses and accuracy", table_of(columns, curve)),
        *section("Where to measure", _poses(design)),
        *section("Notes", *_notes(design)),
    )


def _headline(design: Design) -> str:
    poses = f"{design.n} pose{'s' * (design.n > 1)}"
    if design.target is None:
        return f"{design.pool.robot.name}: where to measure at {poses}"
    reached = "for" if design.reached else "do not reach"
    return f"{design.pool.robot.name}: {poses} {reached} an expected RMS error of {_mm(design.target)}"


def _expected(design: Design) -> Iterator[str]:
    where = FRAMES["fitted" if design.task.fitted else "base"]
    yield f"RMS error of the tool over the task, {where}: {_pose(design.expected)}"
    if design.before is not None:
        yield f"with the present measurements: {_pose(design.before)}"
    last = design.curve[-1].n
    ratio = f" ({design.random / design.expected.position:.2f} times that)" if design.expected.position else ""
    yield f"random poses, as many: {_mm(design.random)}{ratio}"
    equal = next((p.n for p in design.curve if p.designed <= design.random), None)
    if equal is not None and equal < last:
        yield f"{equal} designed poses are as good as {last} random ones"


def _poses(design: Design) -> Shown:
    with_table = bool(np.any(design.group != ""))
    tables_of = [[group or "all others"] * with_table for group in design.group]
    rows = [(name, *q, *of) for name, q, of in zip(design.ids, design.readings, tables_of, strict=True)]
    columns = ("pose", *report.tables.joint_columns(design.pool.robot, ":z.1f"), *["table"] * with_table)
    return table_of(columns, rows, most=MAX_POSES_LISTED)


def _notes(design: Design) -> Iterator[str]:
    for name, one in design.pool.found.items():
        yield f"candidates{f' of {name}' if name else ''}: {one.reasons()}"
    for name in sorted(set(design.pool.found).difference(design.group.tolist(), [""])):
        yield f"{name}: none of its own poses was chosen, and it gets no table"
    yield from map(str, observability.missing_motions(design.pool.robot))
    travel = np.rad2deg(design.travel), np.rad2deg(design.travel_before)
    yield f"joint travel along the poses {travel[0]:.0f} deg, {travel[1]:.0f} unordered"
    if lost := len(design.observability.lost):
        yield f"not identifiable: {lost} directions; fg-calib observe says which and why"
    if design.target is not None and not design.reached:
        yield "more poses (--n, --candidates), lower noise, other measurements or a wider range of poses would reach it"
    if design.asked is not None and design.n < design.asked:
        yield f"no more than {design.n} poses were found of {design.asked}: --candidates draws more"
    if (design.known_tool.position or np.inf) < 0.5 * (design.expected.position or np.inf):
        remedy = "measure its own point (leave `target` empty), or specify a smaller prior sigma"
        yield f"most of it is the tool: were it known, {_pose(design.known_tool)}; {remedy}"
    if design.after_fit is not None and (design.after_fit.position or np.inf) < 0.5 * (design.expected.position or 0):
        best_fit = f"after the best rigid fit {_pose(design.after_fit)}"
        yield f"most of it is the position of the base: {best_fit}; --error fitted chooses for that"


def _pose(error: prediction.PoseRms) -> str:
    return f"{_mm(error.position)}, {in_words(error.orientation, 'rad', '.4f')}"


def _mm(value: float | None) -> str:
    return in_words(None if value is None or value >= UNKNOWN_ABOVE else value, "m")


def _size(value: float) -> str:
    return _mm(value).removesuffix(" mm")


CONFIGURATIONS, DESIGN = "configurations.csv", "design.json"

_JOB_BEGINS = "# fg-calib design\n# What to measure: fill in the tables, then `fg-calib "
_CALIBRATE, _UPDATE = "calibrate` this file.\n", "update RESULT` this file: RESULT is of what there was.\n"


def draw_design(design: Design) -> Chart:
    """Draw expected errors over the number of poses, with the range of 80 % of the random ones.

    Args:
        design: The design.
    """
    errors = np.array([(p.designed, *p.random) for p in design.curve]).T
    n, target = np.array([float(p.n) for p in design.curve]), np.log10((design.target or np.nan) * 1e3)
    designed, low, middle, high = np.log10(np.where(errors < UNKNOWN_ABOVE, 1e3 * errors, np.nan))
    limits = limits_of(n), limits_of(designed, low, high, target)
    plot = Plot(*limits, ("poses", "log10 of the expected RMS error over the task [mm]"))
    if design.target is not None:
        plot.line((plot.x.low, plot.x.high), float(target), "level")
    for values, kind in ((low, "b"), (high, "b"), (middle, "large b"), (designed, "large a")):
        plot.dots(n, values, kind)
    caption = f"{design.pool.robot.name}: expected error by the number of poses; blue designed, orange random"
    return plot.chart(f"{caption} (half, and 80 % of them)")


def write_design(folder: Path, design: Design, units: Units) -> tuple[str, ...]:
    """Write where to measure, the job to be filled in, and what to expect.

    Args:
        folder: Where to.
        design: The design.
        units: Of the tables and the job.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds a file of these names: its tables may have been filled in.
    """
    robot = design.pool.robot if design.pool.before is None else design.pool.before.robot
    scenario = design.pool.scenario
    measured = design.tables if scenario is not None else ()
    files: dict[str, Any] = {DESIGN: report.tables.json_text(design_document(design))}
    files |= {"design.svg": standalone([draw_design(design)])}
    files[CONFIGURATIONS] = partial(write_csv, columns=_configurations(design, robot, units))
    for t in measured:
        for name, columns in simulation.table_columns(t, robot, units).items():
            rounded = _rounded(t.measurements.readings, robot, units) if "q1" in columns else {}
            unknown = dict.fromkeys(name for name, v in t.measurements.context.items() if v.ndim == 1)
            left = simulation.to_fill_in({**columns, **rounded, **unknown}, touched=_is_touched(t))
            files[name] = partial(write_csv, columns=left)
    if scenario is not None:
        urdf = None if robot.urdf is None else "robot.urdf"
        files["robot.yaml"] = partial(write_robot, robot=robot, units=units, urdf_name=urdf)
        words = _JOB_BEGINS + (_CALIBRATE if design.pool.before is None else _UPDATE)
        keys = {"robot": "robot.yaml"} | {k: v for k, v in scenario.job.items() if k not in ("model", "pairing")}
        files["calibration.yaml"] = simulation.job_text(words, keys, measured, robot, units)
        files |= {} if urdf is None else {urdf: partial(write_urdf, robot=robot)}
    require_absent(folder, files)
    fill_folder(folder, files)
    return tuple(files)


def _is_touched(table: measurements.Table) -> bool:
    """Whether something is touched, so that it is the joint readings that are measured."""
    m = table.measurements
    return m.groups is not None or (table.model in ("anchor", "plane") and not np.any(m.columns.get("distance", 0.0)))


def _configurations(design: Design, robot: Robot, units: Units) -> dict[str, Any]:
    """Poses to measure, in order, with the tool's position by the arm as it is known."""
    at = pose(design.pool.robot, design.readings).position / units.factor("m")
    group = {"table": np.where(design.group == "", "all", design.group)} if np.any(design.group != "") else {}
    tool = {f"tool_{axis}": np.round(at[:, k], DECIMALS) for k, axis in enumerate("xyz")}
    return {"id": design.ids, **_rounded(design.readings, robot, units), **group, **tool}


def _rounded(readings: inputs.Floats, robot: Robot, units: Units) -> dict[str, inputs.Floats]:
    """The columns of joint readings, rounded, within the limits."""
    factors = np.array([units.factor(joint.unit) for joint in robot.joints])
    shown = np.clip(np.round(readings / factors, DECIMALS), *(robot.limits / factors[:, None]).T)
    return {f"q{i + 1}": column for i, column in enumerate(shown.T)}


DECIMALS = 7
"""Decimals of joint readings and positions in the tables: far below what encoders and trackers resolve."""
