"""What `fg-calib design --out` writes: where to go, the tables and the job to be filled in, and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from fg_calib.designs.design import Design
from fg_calib.errors import InputError
from fg_calib.io.atomic import exists, fill_folder, read_bytes, read_text, write_text
from fg_calib.io.csv_writer import write_csv
from fg_calib.io.robot_file import write_robot
from fg_calib.io.units import Units
from fg_calib.io.urdf import write_urdf
from fg_calib.measurements.table import Table
from fg_calib.report.charts import Chart, Plot, limits_of, write_charts
from fg_calib.report.plan import SCHEMA, UNKNOWN_ABOVE, design_document
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot
from fg_calib.simulation.write import instrument_keys, is_filled_in, table_columns, to_fill_in

if TYPE_CHECKING:
    pass

Floats = NDArray[np.float64]

CONFIGURATIONS, _DOCUMENT = "configurations.csv", "design.json"

_BEGINS = f'{{\n "schema": "{SCHEMA}"'.encode()
"""How the document of a plan begins."""

_JOB_BEGINS = "# fg-calib design\n# What to measure: fill in the tables, then `fg-calib "
_CALIBRATE, _UPDATE = "calibrate` this file.\n", "update RESULT` this file: RESULT is of what there was.\n"


def draw_design(design: Design) -> Chart:
    """Draw expected errors over the number of poses, with the range of 80 % of the random ones.

    Args:
        design: The design.
    """
    n = np.array([float(p.n) for p in design.curve])
    designed = np.log10(_shown([p.designed for p in design.curve]))
    low, middle, high = np.log10(_shown([p.random for p in design.curve])).T
    target = np.nan if design.target is None else np.log10(design.target * 1e3)
    names = "poses", "expected RMS error over the task [mm]"
    plot = Plot(limits_of(n), limits_of(designed, low, high, target), names, powers=True)
    if np.isfinite(target):
        plot.level(float(target))
    for values, kind in ((low, "b"), (high, "b"), (middle, "large b"), (designed, "large a")):
        plot.dots(n, values, kind)
    caption = f"{design.pool.robot.name}: expected error by the number of poses; blue designed, orange random"
    return plot.chart(f"{caption} (half, and 80 % of them)")


def _shown(errors: Sequence[object]) -> Floats:
    """Errors [mm] for a picture, NaN where they are unknown."""
    found: Floats = np.array(errors, dtype=np.float64)
    return np.where(found < UNKNOWN_ABOVE, 1e3 * found, np.nan)


def write_design(folder: Path, design: Design, units: Units) -> tuple[str, ...]:
    """Write where to measure, the job to be filled in, and what to expect.

    Files of an earlier plan that this one has not are removed.

    Args:
        folder: Where to.
        design: The design.
        units: Of the tables and the job.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds files of these names that are no design's, or tables that
            have been filled in.
    """
    names, write, own = _filling(folder, design, units)
    fill_folder(folder, write, own)
    return names


def _filling(
    folder: Path, design: Design, units: Units
) -> tuple[tuple[str, ...], Callable[[Path], None], Mapping[str, bytes]]:
    """The names of a plan's files, and what writes them.

    Raises:
        InputError: A table of this or an earlier plan has been filled in, or has the name of another file.
    """
    import json

    robot = design.pool.robot if design.pool.before is None else design.pool.before.robot
    tables = design.tables if design.pool.scenario is not None else ()
    files = {
        name: to_fill_in(dict(columns) | _told(t.measurements.readings, robot, units, columns), touched=_is_touched(t))
        for t in tables
        for name, columns in table_columns(t, robot, units).items()
    }
    urdf = "robot.urdf" if robot.urdf is not None and tables else None
    names = [CONFIGURATIONS, _DOCUMENT, "design.svg"]
    if tables:
        names += [*files, "robot.yaml", *([urdf] if urdf else []), "calibration.yaml"]

    def write(into: Path) -> None:
        write_csv(into / CONFIGURATIONS, _configurations(design, robot, units))
        write_text(into / _DOCUMENT, json.dumps(design_document(design) | {"files": names}, indent=1) + "\n")
        write_charts(into, {"design": [draw_design(design)]})
        if not tables:
            return
        for name, columns in files.items():
            write_csv(into / name, columns)
        if urdf is not None:
            write_urdf(into / urdf, robot)
        write_robot(into / "robot.yaml", robot, units=units, urdf_name=urdf)
        then = _CALIBRATE if design.pool.before is None else _UPDATE
        write_text(into / "calibration.yaml", _JOB_BEGINS + then + _job_text(design, tables, units))

    for name in files:
        if name in (CONFIGURATIONS, "robot.yaml", "calibration.yaml"):
            raise InputError(f"instruments: {Path(name).stem}", "the name of a file of the plan", "another name")
    before = _files_before(folder)
    for name in (*files, *before):
        if name.endswith(".csv") and name != CONFIGURATIONS and is_filled_in(folder / name):
            raise InputError(str(folder / name), "a table that has been filled in", "another folder")
    whose = {_DOCUMENT: _BEGINS}  # first: it says of the others whose they are
    own = whose | dict.fromkeys([*before, *names], b"") | {"calibration.yaml": _JOB_BEGINS.encode()} | whose
    return tuple(names), write, own


def _files_before(folder: Path) -> list[str]:
    """Names of the files of an earlier plan in a folder; none where there was none."""
    import json

    path = folder / _DOCUMENT
    if not exists(path) or not read_bytes(path).startswith(_BEGINS):
        return []
    with suppress(ValueError, TypeError, AttributeError):  # changed by hand
        return [name for name in json.loads(read_text(path)).get("files", ()) if Path(name).name == name]
    return []


def _is_touched(table: Table) -> bool:
    """Whether something is touched, so that it is the joint readings that are measured."""
    m = table.measurements
    contact = table.model in ("anchor", "plane") and not np.any(0.0 if m.length is None else m.length)
    return m.groups is not None or contact


def _configurations(design: Design, robot: Robot, units: Units) -> dict[str, Any]:
    """Where to go, in order, and where the tool then is by the arm as it is known."""
    at = pose(design.pool.robot, design.readings).position
    names = [f"q{i + 1}" for i in range(robot.n_joints)]
    tables = {"table": np.where(design.group == "", "all", design.group)} if np.any(design.group != "") else {}
    tool = {f"tool_{axis}": _shortened(at[:, k], units.factor("m"), "m") for k, axis in enumerate("xyz")}
    return {"id": design.ids, **_told(design.readings, robot, units, names), **tables, **tool}


def _told(readings: Floats, robot: Robot, units: Units, names: Collection[str]) -> dict[str, Floats]:
    """The columns of joint readings among these names, shortened; such as would be beyond a limit then are whole."""
    found = {}
    for i, (joint, (lower, upper)) in enumerate(zip(robot.joints, robot.limits, strict=True)):
        q, factor = readings[:, i], units.factor(joint.unit)
        short = _shortened(q, factor, joint.unit)
        found[f"q{i + 1}"] = np.where((short < lower / factor) | (short > upper / factor), q / factor, short)
    return {name: column for name, column in found.items() if name in names}


def _shortened(values: Floats, factor: float, unit: str) -> Floats:
    """Values in another unit, in as many decimals as `FINEST` needs."""
    out: Floats = np.round(values / factor, round(math.log10(factor / FINEST[unit])))
    return out


FINEST = {"rad": 1e-8, "m": 1e-9}
"""What a figure that an arm is to be moved by is rounded to: far below what encoders and trackers tell apart."""


def _job_text(design: Design, tables: Sequence[Table], units: Units) -> str:
    """The job of the tables that are to be filled in."""
    scenario = design.pool.scenario
    assert scenario is not None
    robot, sigma = design.pool.robot, tables[0].measurements.sigma_joint
    joint = [units.from_si(s, j.unit) for s, j in zip(sigma, robot.joints, strict=True)]
    keys = {key: value for key, value in scenario.job.items() if key not in ("model", "pairing", "noise")}
    job: dict[str, Any] = {"robot": "robot.yaml", **keys, "units": asdict(units)}
    job |= {"noise": {"joint": joint[0] if len(set(joint)) == 1 else joint}}
    job |= instrument_keys(tables, units)
    return yaml.safe_dump(job, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf)
