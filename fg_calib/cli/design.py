"""`fg-calib design`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fg_calib.cli.output import Json, end, say, show_json, show_report

if TYPE_CHECKING:
    from fg_calib.designs.design import Design
    from fg_calib.io.units import Units
    from fg_calib.job import Job
    from fg_calib.robot.model import Robot
    from fg_calib.simulation.scenario import Scenario

_Of = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO|JOB",
        help="What measures, and how well: a scenario (a file, or space-robot); or a job, whose rows count already.",
    ),
]
_N = Annotated[int | None, typer.Option("--n", metavar="N", help="How many stops; 30 if neither this nor --target.")]
_Target = Annotated[
    str | None, typer.Option("--target", metavar="LENGTH", help="As few as reach this RMS error, such as 0.5mm.")
]
_Given = Annotated[
    Path | None,
    typer.Option("--given", metavar="TABLE", readable=False, help="Configurations that are measured in any case."),
]
_Candidates = Annotated[
    str | None,
    typer.Option(
        "--candidates",
        metavar="N|TABLE|SCENARIO|rows",
        help="How many are drawn, 2000 if not given; a table; where a scenario says (.yaml); or a job's rows.",
    ),
]
_Task = Annotated[
    Path | None,
    typer.Option(
        "--task", metavar="TABLE", readable=False, help="Where the tool is to be right; anywhere within limits if none."
    ),
]
_Criterion = Annotated[
    Literal["I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5"],
    typer.Option("--criterion", help="What is made small: I, the error over the task, or one of the literature's."),
]
_Frame = Annotated[
    Literal["base", "fitted"] | None,
    typer.Option("--error", help="Errors in the base frame, or after the best rigid fit; by what is measured if none."),
]
_Lever = Annotated[
    str | None,
    typer.Option("--lever", metavar="LENGTH", help="Orientations count too, by what they move at this distance."),
]
_Out = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", readable=False, help="Write tables and a job to fill in there.")
]
_Seed = Annotated[int, typer.Option("--seed", min=0, help="Of all that is drawn.")]


def design(
    of: _Of,
    n: _N = None,
    target: _Target = None,
    given: _Given = None,
    candidates: _Candidates = None,
    task: _Task = None,
    criterion: _Criterion = "I",
    error: _Frame = None,
    lever: _Lever = None,
    out: _Out = None,
    seed: _Seed = 0,
    as_json: Json = False,
) -> None:
    """Choose which configurations to measure, and say what accuracy to expect of how many."""
    from fg_calib.designs.design import design as designed
    from fg_calib.io.atomic import require_writable
    from fg_calib.io.units import quantity

    if n is not None and target is not None:
        say("error: --n and --target: one of the two")
        raise typer.Exit(2)
    subject, units, robot = _read(of)
    if out is not None:
        require_writable(out)
    choices: dict[str, Any] = {
        "n": n,
        "target": None if target is None else quantity(target, "m", None, "--target"),
        "lever": 0.0 if lever is None else quantity(lever, "m", None, "--lever"),
        "fitted": None if error is None else error == "fitted",
        "criterion": criterion,
        "seed": seed,
        "given": None if given is None else _readings(given, robot, units),
        "task": None if task is None else _readings(task, robot, units),
        **_candidates(candidates, robot, units),
    }
    found = designed(subject, **choices)
    _show(found, units, out, as_json=as_json)
    end([] if found.reached else ["the target is not reached"], "doubtful")


def _show(found: Design, units: Units, out: Path | None, *, as_json: bool) -> None:
    """Print a design, and write it."""
    from fg_calib.report.design import build_design_report, design_document, write_design

    names = write_design(out, found, units) if out is not None else ()
    if as_json:
        show_json(design_document(found))
    else:
        show_report(build_design_report(found))
    say(f"wrote {', '.join(names)} to {out}" if out else "nothing is written: --out DIR writes tables and a job")


def _read(of: str) -> tuple[Scenario | Job, Units, Robot]:
    """What is to be designed, the units of its tables, and the arm."""
    from fg_calib.errors import InputError
    from fg_calib.io.job import is_job, read_job, units_of
    from fg_calib.io.units import Units
    from fg_calib.simulation.scenario import read_scenario

    if is_job(of):
        job = read_job(of)
        return job, units_of(job), job.robot
    if "result.json" in (Path(of).name, *(file.name for file in Path(of).glob("*.json"))):
        raise InputError(of, "a result", "a scenario, or the job that the result came from")
    scenario = read_scenario(of)
    return scenario, Units(scenario.length_unit, scenario.angle_unit), scenario.robot


def _readings(path: Path, robot: Robot, units: Units) -> Any:
    from fg_calib.io.tables import read_measurements

    return read_measurements(path, robot, units=units).readings


def _candidates(given: str | None, robot: Robot, units: Units) -> dict[str, Any]:
    """Where the candidates come from."""
    from fg_calib.simulation.scenario import GivenReadings, read_scenario

    if given is None:
        return {}
    if given.isdecimal():
        return {"n_candidates": int(given)}
    if given.endswith((".yaml", ".yml")):
        return {"candidates": read_scenario(given).configurations}
    return {"candidates": given if given == "rows" else GivenReadings(_readings(Path(given), robot, units))}
