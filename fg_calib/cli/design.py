"""`fg-calib design`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import fg_calib
from fg_calib import inputs, io, report, simulation
from fg_calib.cli.output import Json, Seed, argument, end, option, quantity, say, show_result

Criterion = Literal["I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5"]
Frame = Literal["base", "fitted"]


def design(
    of: Annotated[str, argument("SCENARIO|JOB", "A scenario, or a job, whose rows count already.")],
    n: Annotated[int | None, option("--n", "N", "How many poses; 30 if neither this nor --target.")] = None,
    target: Annotated[float | None, quantity("--target", "m", "As few as reach this RMS error, such as 0.5mm.")] = None,
    given: Annotated[Path | None, option("--given", "TABLE", "Configurations that are measured in any case.")] = None,
    candidates: Annotated[str | None, option("--candidates", "N|TABLE|SCENARIO|rows", "How many, or which.")] = None,
    task: Annotated[Path | None, option("--task", "TABLE", "Where the tool is to be right; anywhere if none.")] = None,
    criterion: Annotated[Criterion, option("--criterion", None, "What is made small: I, the error.")] = "I",
    error: Annotated[Frame | None, option("--error", None, "In the base frame, or after the best fit.")] = None,
    lever: Annotated[float | None, quantity("--lever", "m", "Where orientations count by what they move.")] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write tables and a job to fill in there.")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Choose which configurations to measure, and say what accuracy to expect of how many."""
    from fg_calib.designs.design import design as designed

    if n is not None and target is not None:
        raise typer.BadParameter("one of the two", param_hint="--n and --target")
    subject, units, robot = _read(of)
    if out is not None:
        io.require_writable(out)
        io.require_absent(out, ["design.json"])  # before the search, which takes its time
    paths, fitted = {"given": given, "task": task}, None if error is None else error == "fitted"
    choices: dict[str, Any] = {"n": n, "target": target, "lever": lever or 0.0, "criterion": criterion, "seed": seed}
    for key, path in paths.items():
        choices[key] = None if path is None else io.read_joint_table(path, robot, units)[1]
    found = designed(subject, fitted=fitted, **choices, **_candidates(candidates, robot, units))
    names = report.write_design(out, found, units) if out is not None else ()
    show_result(as_json, report.design_document, report.build_design_report, found)
    say(f"wrote {', '.join(names)} to {out}" if out else "nothing is written: --out DIR writes tables and a job")
    end([] if found.reached else ["the target is not reached"], "doubtful")


def _read(of: str) -> "tuple[simulation.Scenario | fg_calib.Job, io.Units, fg_calib.Robot]":
    """Read the scenario or job, the units of its tables, and the arm."""
    if io.is_job(of):
        job = io.read_job(of)
        return job, io.units_of(job), job.robot
    if Path(of).name == "result.json" or (Path(of) / "result.json").exists():
        raise inputs.InputError(of, "a result", "a scenario, or the job that the result came from")
    scenario = simulation.read_scenario(of)
    return scenario, io.Units(scenario.length_unit, scenario.angle_unit), scenario.robot


def _candidates(given: str | None, robot: "fg_calib.Robot", units: "io.Units") -> dict[str, Any]:
    """Options that say where the candidates come from."""
    if given is None:
        return {}
    if given.isdecimal():
        return {"n_candidates": int(given)}
    if given.endswith((".yaml", ".yml")):
        return {"candidates": simulation.read_scenario(given).configurations}
    if given == "rows":
        return {"candidates": given}
    return {"candidates": simulation.GivenReadings(io.read_joint_table(given, robot, units)[1])}
