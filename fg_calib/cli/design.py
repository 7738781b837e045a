"""`fg-calib design`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fg_calib.cli.output import Json, end, say, show_json, show_report
from fg_calib.cli.workers import Scheduler, Workers, executor_for, require_one

if TYPE_CHECKING:
    from fg_calib.designs.design import Design
    from fg_calib.executors import Failure
    from fg_calib.io.units import Units
    from fg_calib.job import Job
    from fg_calib.robot.model import Robot
    from fg_calib.simulation.scenario import Scenario

_Of = Annotated[
    list[str],
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
_Instruments = Annotated[
    list[Path] | None,
    typer.Option(
        "--instruments",
        metavar="FILE ...",
        readable=False,
        help="Instruments to compare: files with keys of a scenario that stand in the place of its own.",
    ),
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
    instruments: _Instruments = None,
    out: _Out = None,
    seed: _Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Choose which configurations to measure, and say what accuracy to expect of how many."""
    from fg_calib.io.atomic import require_writable
    from fg_calib.io.units import quantity

    if n is not None and target is not None:
        say("error: --n and --target: one of the two")
        raise typer.Exit(2)
    several = _of_instruments(of, instruments)
    require_one(workers, scheduler)
    _require_several(several, workers, scheduler)
    subjects, units, robot = _read(of[0], several)
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
    found, failed = _found(subjects, choices, workers, scheduler, several=bool(several))
    if found:
        _show(found, units, out, failed, several=bool(several), as_json=as_json)
    for failure in failed:
        say(f"{failure.job}: error: {failure.reason}")
    missed = [name for name, one in found.items() if not one.reached]
    if failed:
        raise typer.Exit(1)
    end([f"the target is not reached{f' with {name}' if several else ''}" for name in missed], "doubtful")


def _require_several(instruments: Sequence[Path], workers: int | None, scheduler: str | None) -> None:
    """End with a line on stderr where nothing could run side by side."""
    for option, asked in (("--workers", workers), ("--scheduler", scheduler)):
        if asked is not None and len(instruments) < 2:
            say(f"error: {option} has no effect without several --instruments: it is they that run side by side")
            raise typer.Exit(2)


def _found(
    subjects: Mapping[str, Scenario | Job],
    choices: Mapping[str, Any],
    workers: int | None,
    scheduler: str | None,
    *,
    several: bool,
) -> tuple[dict[str, Design], list[Failure]]:
    """The designs, and why others of several are missing; what is wrong with the only one is raised."""
    from fg_calib.designs.comparison import compare_designs
    from fg_calib.designs.design import design as designed
    from fg_calib.executors import Failure

    if not several:
        return {name: designed(one, **choices) for name, one in subjects.items()}, []
    with executor_for(workers, scheduler, lambda: "nothing has been written") as executor:
        outcomes = compare_designs(subjects, executor, **choices)
    found = {name: one for name, one in outcomes.items() if not isinstance(one, Failure)}
    return found, [one for one in outcomes.values() if isinstance(one, Failure)]


def _show(
    found: Mapping[str, Design],
    units: Units,
    out: Path | None,
    failed: Sequence[Failure],
    *,
    several: bool,
    as_json: bool,
) -> None:
    """Print designs, and write them."""
    from fg_calib.report.plan import (
        build_design_report,
        build_instruments_report,
        design_document,
        designs_document,
    )
    from fg_calib.report.plan_files import write_design, write_designs

    first, names = next(iter(found.values())), tuple[str, ...]()
    try:
        if as_json:
            show_json(designs_document(found, failed) if several else design_document(first))
        else:
            show_report(build_instruments_report(found, failed) if several else build_design_report(first))
    finally:  # also where nobody takes the report
        if out is not None:
            names = write_designs(out, found, units) if several else write_design(out, first, units)
    say(f"wrote {', '.join(names)} to {out}" if out else "nothing is written: --out DIR writes tables and a job")


def _of_instruments(of: Sequence[str], instruments: Sequence[Path] | None) -> list[Path]:
    """The files of instruments to compare: those after the option too that typer takes for arguments."""
    if len(of) > 1 and not instruments:
        say(f"error: {of[1]}: one SCENARIO or JOB")
        raise typer.Exit(2)
    return [*(instruments or []), *map(Path, of[1:])] if instruments else []


def _read(of: str, instruments: Sequence[Path]) -> tuple[dict[str, Scenario | Job], Units, Robot]:
    """What is to be designed, by the instruments' names, the units of its tables, and the arm."""
    from fg_calib.errors import InputError
    from fg_calib.io.job import is_job, read_job, units_of
    from fg_calib.io.units import Units
    from fg_calib.report.plan_files import names_of_files
    from fg_calib.simulation.scenario_file import read_scenario

    if is_job(of):
        if instruments:
            say("error: --instruments has no effect with a job: they stand in the place of a scenario's")
            raise typer.Exit(2)
        job = read_job(of)
        return {"": job}, units_of(job), job.robot
    if "result.json" in (Path(of).name, *(file.name for file in Path(of).glob("*.json"))):
        raise InputError(of, "a result", "a scenario, or the job that the result came from")
    scenarios: dict[str, Scenario | Job] = {}
    for name, path in zip(names_of_files(instruments), instruments, strict=True):
        scenarios[name] = read_scenario(of, instruments=path)
    scenario = read_scenario(of)
    return scenarios or {"": scenario}, Units(scenario.length_unit, scenario.angle_unit), scenario.robot


def _readings(path: Path, robot: Robot, units: Units) -> Any:
    from fg_calib.io.tables import read_measurements

    return read_measurements(path, robot, units=units).readings


def _candidates(given: str | None, robot: Robot, units: Units) -> dict[str, Any]:
    """Where the candidates come from."""
    from fg_calib.simulation.configurations import GivenReadings
    from fg_calib.simulation.scenario_file import read_scenario

    if given is None:
        return {}
    if given.isdecimal():
        return {"n_candidates": int(given)}
    if given.endswith((".yaml", ".yml")):
        return {"candidates": read_scenario(given).configurations}
    return {"candidates": given if given == "rows" else GivenReadings(_readings(Path(given), robot, units))}
