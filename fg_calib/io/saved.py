"""The folder of a calibration: `result.json`, the calibrated robot and its tables, written whole and read back.

| table | a row |
|---|---|
| `configurations.csv` | a configuration: readings, where the calibrated tool is (from the base), RMS of its residuals |
| `residuals.csv`, or `.parquet` | a scalar residual before and after, in [m], [rad] or [px] |
| `joints.csv` | an estimated joint position of a configuration, in [rad] (prismatic: [m]) |
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fg_calib.assessment import Assessment
from fg_calib.graph import Solution
from fg_calib.inputs import InputError
from fg_calib.io.atomic import exists, fill_folder, read_bytes, require_own, write_text
from fg_calib.io.result import Result
from fg_calib.io.robot_file import read_robot, write_robot
from fg_calib.io.urdf import write_urdf
from fg_calib.robot import SPAN, Robot, pose
from fg_calib.statistics import FLAGS, JointErrors

if TYPE_CHECKING:
    import polars as pl

ResidualFile = Literal["csv", "parquet", "none"]
"""How single residuals are written, if at all."""

FIGURES = ("accuracy", "joints", "parameters", "correlations", "residuals", "workspace")

RESULT_FILES = {
    "result.json": b'{\n "schema": "fg-calib/result/',
    "residuals.csv": b"kind,a,b,split,used,excluded,",
    "residuals.parquet": b"PAR1",
    "configurations.csv": b"id,split,q1,",
    "report.html": b"<!DOCTYPE html>",
    **dict.fromkeys((f"{name}.svg" for name in FIGURES), b"<svg"),
    "joints.csv": b"id,joint,unit,reading,estimate,",
    "robot_calibrated.yaml": b"",
    "robot_calibrated.urdf": b"",
}
"""The files that a calibration may write, and how each begins."""

ROUNDING_IN_UNITS = 1e-12
"""How far the saved robot's values may be from the estimates in `result.json`, [m] and [rad]."""


def residual_frame(solution: Solution, assessed: Assessment) -> pl.DataFrame:
    """Every scalar residual, as `residuals.csv` has it."""
    import polars as pl

    table, fit = assessed.fit.residuals, assessed.fit.goodness
    suspects = np.append(fit.suspects, () if fit.test is None else fit.test.suspects)
    ends, sources = solution.problem.end_names, solution.problem.data.labels
    measured = table.measured - table.excess  # so that predicted minus measured is 0 on average
    columns = {
        "kind": _coded([kind.name for kind in table.kinds], table.kind_code),
        "a": _coded(ends, table.a + 1),
        "b": _coded(ends, table.b + 1),
        "split": _coded(("train", "test"), table.split),
        "used": table.used,
        "excluded": _coded(table.reasons, table.reason_code),
        "unit": _coded([kind.unit for kind in table.kinds], table.kind_code),
        "measured": measured,
        "predicted": measured + table.after,
        "residual_before": table.before,
        "residual": table.after,
        "sigma": table.sigma,
        "whitened": table.after / table.sigma,
        "leverage": fit.leverage,
        "studentised": fit.studentised,
        "weight": fit.weight,
        "flag": _coded(FLAGS, fit.flag),
        "noise_adds": table.excess,
        "suspect": np.isin(np.arange(table.n), suspects),
    }
    if len(sources) > 1:
        columns["table"] = _coded([sources[kind.table] for kind in table.kinds], table.kind_code)
    if len(table.labels) > 1:
        columns["of"] = _coded(table.labels, table.label_code)
        columns["row"] = pl.Series(table.table_row).replace(-1, None)
    return pl.DataFrame(columns)


def _coded(words: Sequence[str], codes: Any) -> pl.Series:
    """A column of words by their codes, empty words as null."""
    import polars as pl

    return pl.Series([word or None for word in words], dtype=pl.String)[np.asarray(codes, dtype=np.int64)]


def configuration_frame(solution: Solution, assessed: Assessment) -> pl.DataFrame:
    """Every measured configuration, as `configurations.csv` has it."""
    import polars as pl

    data, robot = solution.problem.data, assessed.robot
    readings, n = data.readings, data.n_configurations
    held_out = data.held_out | solution.problem.evaluated
    rows, chi2, rms = assessed.fit.residuals.of_configurations(held_out)
    tool = np.concatenate([pose(robot, readings[k : k + SPAN]).position for k in range(0, max(n, 1), SPAN)])
    columns = {
        "id": pl.Series(data.names[:n], dtype=pl.String),
        "split": _coded(("train", "test"), held_out),
        **{f"q{i + 1}": readings[:, i] for i in range(robot.n_joints)},
        **{f"tool_{axis}": tool[:, i] for i, axis in enumerate("xyz")},
        "rows": rows,
        "chi2": chi2,
        **{f"rms_{family}": values for family, values in rms.items()},
    }
    return pl.DataFrame(columns)


def joint_frame(found: JointErrors, solution: Solution) -> pl.DataFrame:
    """Every estimated joint position, as `joints.csv` has it."""
    import polars as pl

    n, k = found.error.shape
    joint, units = np.tile(np.arange(k), n), [solution.problem.robot.joints[j].unit for j in found.joints]
    columns = {
        "id": _coded(solution.problem.end_names, np.repeat(found.configurations + 1, k)),
        "joint": _coded(found.names, joint),
        "unit": _coded(units, joint),
        "reading": found.reading.ravel(),
        "estimate": (found.reading + found.error).ravel(),
        "error": found.error.ravel(),
        "sigma": np.tile(found.sigma, n),
        "error_over_sigma": (found.error / found.sigma).ravel(),
        "studentised": found.studentised.ravel(),
        "suspect": [place in found.suspects for place in np.ndindex(n, k)],
    }
    return pl.DataFrame(columns)


def write_calibration(
    folder: Path, result: Result, robot: Robot, tables: Mapping[str, pl.DataFrame], pages: Mapping[str, str]
) -> None:
    """Write the files of a calibration into a folder, all or none.

    Args:
        folder: Where to.
        result: The result.
        robot: The calibrated robot; base and tool of a robot from a URDF, which cannot hold them, go to a
            `robot_calibrated.yaml` beside `robot_calibrated.urdf`.
        tables: Tables by file name.
        pages: Text of other files by name.

    Raises:
        InputError: The folder cannot be written.
    """

    def write(into: Path) -> None:
        _write_robot(into, robot)
        for name, table in tables.items():
            table.write_parquet(into / name) if name.endswith(".parquet") else table.write_csv(into / name)
        digests = {name: sha256(read_bytes(into / name)).hexdigest() for name in tables}
        document = result.model_copy(update={"files": digests}).document()
        texts = {**pages, "result.json": json.dumps(document, indent=1, allow_nan=False) + "\n"}
        for name, text in texts.items():
            write_text(into / name, text)

    fill_folder(folder, write, RESULT_FILES)


def _write_robot(folder: Path, robot: Robot) -> None:
    if robot.urdf is None:
        write_robot(folder / "robot_calibrated.yaml", robot)
        return
    write_urdf(folder / "robot_calibrated.urdf", robot)
    if any(p.nominal != 0.0 or p.estimated for p in robot.parameters if p.owner in (0, robot.n_joints + 1)):
        write_robot(folder / "robot_calibrated.yaml", robot, urdf_name="robot_calibrated.urdf")


def read_calibrated_robot(folder: Path, result: Result) -> Robot:
    """The calibrated robot in the folder of a result.

    Raises:
        InputError: There is none, or it is that of another result.
    """
    files = [folder / f"robot_calibrated.{ending}" for ending in ("yaml", "urdf")]
    file = next(filter(exists, files), None)
    if file is None:
        raise InputError(str(folder), "neither robot_calibrated.yaml nor robot_calibrated.urdf beside its result.json")
    links = result.links or (None, None)
    robot = read_robot(file, base_link=links[0], tip_link=links[1])
    names, estimates = [p.name for p in result.parameters], [p.estimate for p in result.parameters]
    same = [p.name for p in robot.parameters] == names
    if not same or not np.allclose(robot.nominal, estimates, 0.0, ROUNDING_IN_UNITS):
        found = "other values" if same else "other parameters"
        raise InputError(str(file), f"{found} than in result.json", "the files of one calibration")
    return robot


def read_table(folder: Path, name: str, result: Result) -> pl.DataFrame | None:
    """A table of a calibration; None where there is no such file.

    Args:
        folder: Of the calibration.
        name: `configurations` or `residuals`.
        result: The result in the folder.

    Raises:
        InputError: The table is damaged, or that of another result.
    """
    import polars as pl

    file = next((folder / f"{name}.{e}" for e in ("csv", "parquet") if exists(folder / f"{name}.{e}")), None)
    if file is None:
        return None
    content = read_bytes(file)
    if sha256(content).hexdigest() != result.files.get(file.name):
        raise InputError(str(file), "changed, or of another calibration", "the files of one calibration")
    words = dict.fromkeys(("id", "kind", "a", "b", "split", "excluded", "unit", "flag", "table", "of"), pl.String)
    return pl.read_parquet(content) if file.suffix == ".parquet" else pl.read_csv(content, schema_overrides=words)


def require_no_input(folder: Path, path: Path | None, inputs: Mapping[str, str]) -> None:
    """Check that results would replace neither the files of their job nor files that are of no result.

    Args:
        folder: Where to.
        path: The job's file, if there is one.
        inputs: What it was read from, by path relative to the job.

    Raises:
        InputError: They would.
    """
    files = set() if path is None else {(path.parent / name).resolve() for name in inputs}
    for name in RESULT_FILES:
        if (folder / name).resolve() in files:
            raise InputError(str(folder / name), "the job was read from it", "another folder for the results")
    require_own(folder, RESULT_FILES)
