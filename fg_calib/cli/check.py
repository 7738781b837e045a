"""`fg-calib check`, `update` and `history`: a calibration and new rows."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

import fg_calib
from fg_calib import inputs, io, report, robot
from fg_calib.cli.calibrate import show_calibration
from fg_calib.cli.output import Json, ResultFolder, argument, option, quantity, show_result

NewTable = Annotated[Path, argument("TABLE", "New rows: a table like the job's, or a job with several.")]
Pairs = Annotated[Path | None, option("--pairs", "TABLE", "Table of pairs, if the job has one.")]
Like = Annotated[str | None, option("--like", "NAME", "Which of the job's tables it is like, if there are several.")]
Many = list[str] | None


def check(
    result: ResultFolder,
    table: NewTable,
    limit: Annotated[float | None, quantity("--limit", "m", "Largest RMS error of positions, such as 0.5mm.")] = None,
    limit_angle: Annotated[float | None, quantity("--limit-angle", "rad", "Of orientations, such as 0.05deg.")] = None,
    pairs: Pairs = None,
    like: Like = None,
    as_json: Json = False,
) -> None:
    """Say whether a calibration is still good by new rows, and what changed if it is not."""
    calibration = fg_calib.Calibration.load(result)
    found = calibration.check(table, limit=limit, limit_angle=limit_angle, pairs=pairs, like=like)
    joints = [joint.unit for joint in calibration.robot.joints]
    show_result(as_json, lambda: report.check_document(found), lambda: report.build_check_report(found, joints))
    if found.verdict != "pass":
        raise typer.Exit(3)


def update(
    result: ResultFolder,
    table: NewTable,
    out: Annotated[Path, option("--out", "DIR", "Write the new result there, with its history.")],
    date: Annotated[str | None, option("--date", "DATE", "When the rows were measured; now if left out.")] = None,
    growth: Annotated[Many, option("--growth", "NAME=FIGURE", "1 sigma of drift in a day: theta=0.001deg.")] = None,
    changed: Annotated[Many, option("--changed", "NAME", "What has changed since: it is estimated anew.")] = None,
    anchors_stay: Annotated[bool, option("--anchors-stay", None, "Anchors of the same name have not moved.")] = False,
    pairs: Pairs = None,
    like: Like = None,
    as_json: Json = False,
) -> None:
    """Add new rows to the information of a calibration: its own rows are not read again."""
    if out.resolve() == (result.parent if result.is_file() else result).resolve():
        raise inputs.InputError(str(out), "the folder of the result that is updated", "another one, for the new result")
    io.require_writable(out)
    io.require_no_input(out, Path("job"), {str(path): "" for path in (table, pairs) if path is not None})
    before = fg_calib.Calibration.load(result)
    units = {name: p.unit for p in before.robot.parameters for name in (robot.tolerance_kind(p), p.name) if name}
    since: dict[str, Any] = {"date": date, "growth": _growth(growth or (), units), "changed": changed or ()}
    found = before.update(table, **since, anchors_stay=anchors_stay, pairs=pairs, like=like)
    found.save(out)
    show_calibration(found, as_json)


def _growth(given: Sequence[str], units: Mapping[str, str]) -> dict[str, float]:
    """Growth by name or kind, in [m] and [rad], as the units of the parameters say.

    Raises:
        InputError: One is not `NAME=FIGURE` with a unit.
    """
    found = {}
    for one in given:
        name, equals, figure = one.partition("=")
        inputs.expect(equals, "--growth", f"found {one!r}", "NAME=FIGURE, such as theta=0.001deg")
        found[name] = io.quantity(figure, units.get(name, "rad"), None, f"--growth: {name}")
    return found


def history(result: ResultFolder, as_json: Json = False) -> None:
    """Show the runs that a calibration came from."""
    found = io.read_result(result)
    show_result(as_json, report.history_document, report.build_history, found.robot, (*found.history, found.run))
