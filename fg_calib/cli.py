"""The command line: the only place that prints, and the one door where errors become a line and an exit code.

Exit codes: 0 good; 1 bad input; 2 wrong usage; 3 solved, but not to be trusted.
"""

from __future__ import annotations

import atexit
import gc
import io
import json
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fg_calib import __version__
from fg_calib.errors import CalibrationError, InputError
from fg_calib.options import AngleUnit, FrameKnowledge, LengthUnit, Model

if TYPE_CHECKING:
    from rich.console import RenderableType

app = typer.Typer(
    name="fg-calib",
    help="Calibrate a robot arm's geometry, and say how well it is known.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_OBJECTS_BEFORE_GARBAGE = 500_000
"""New objects after which garbage is looked for: twice what a calibration and its imports make."""

EXAMPLES = Path(__file__).parent / "examples"

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else there.")]


def main() -> None:
    """Run the command line.

    Garbage is looked for seldom, and not at the end: among all that imports keep, it took a quarter of a short command.
    """
    gc.set_threshold(_OBJECTS_BEFORE_GARBAGE)
    atexit.register(gc.freeze)
    logging.basicConfig(stream=sys.stderr, format="%(message)s", level=logging.WARNING)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a letter gets a question mark
            stream.reconfigure(errors="replace")
    try:
        app(prog_name="fg-calib")
    except CalibrationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # the reader of our output has gone
        sys.stderr.close()
        sys.exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"fg-calib {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Calibrate a robot arm's geometry, and say how well it is known."""


@app.command()
def calibrate(
    job: Annotated[Path, typer.Argument(metavar="JOB", help="The job, such as calibration.yaml.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Write result.json, the calibrated robot and residuals.csv there."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Estimate a robot's parameters from measurements, with their uncertainties."""
    from fg_calib.analysis.uncertainty import assess
    from fg_calib.analysis.variance_components import solve_job
    from fg_calib.files.job import read_job

    given = read_job(job)
    solution = solve_job(given)
    uncertainty = assess(solution)
    if out is not None:
        from fg_calib.report.documents import write_results

        write_results(out, solution, uncertainty, given.inputs)
    if as_json:
        from fg_calib.report.documents import result_document

        print(json.dumps(result_document(solution, uncertainty, given.inputs), allow_nan=False))
    else:
        from fg_calib.report.text import build_report

        _show(build_report(solution, uncertainty))
    _end(uncertainty.findings)


@app.command(name="compare")
def compare_estimators(
    job: Annotated[Path, typer.Argument(metavar="JOB", help="The job, such as calibration.yaml.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write comparison.json there.")] = None,
    as_json: Json = False,
) -> None:
    """Run the factor graph beside plain least squares on the same job: errors, residuals, sigmas, time."""
    from fg_calib.baseline.comparison import compare
    from fg_calib.files.job import read_job
    from fg_calib.report.documents import comparison_document, write_comparison
    from fg_calib.report.text import build_comparison_report

    comparison = compare(read_job(job))
    if out is not None:
        write_comparison(out, comparison)
    if as_json:
        print(json.dumps(comparison_document(comparison), allow_nan=False))
    else:
        _show(build_comparison_report(comparison))
    _end(comparison.findings)


def _show(report: RenderableType) -> None:
    """Print a report as wide as the terminal, or as `COLUMNS` says; a pipe has no width of its own."""
    from rich.console import Console

    from fg_calib.report.text import WIDTH, width_for

    given = Console().is_terminal or "COLUMNS" in os.environ
    width = width_for(report, Console().width if given else WIDTH)
    Console(highlight=False, width=width).print(report)


def _end(findings: Sequence[str]) -> None:
    """Say on stderr why a result is not to be trusted, and end with 3 if there is a reason."""
    for finding in findings:
        print(f"not to be trusted: {finding}", file=sys.stderr)
    if findings:
        raise typer.Exit(3)


_OF_A_TABLE = ("pairing", "length", "angle", "position_noise", "orientation_noise", "joint_noise")
"""Options of `observe` that say something of a table of configurations."""


def _refuse_idle(context: typer.Context, names: Sequence[str], circumstance: str) -> None:
    """Refuse options that were given although they do nothing in such a circumstance."""
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            print(f"error: --{name.replace('_', '-')} has no effect {circumstance}", file=sys.stderr)
            raise typer.Exit(2)


@app.command()
def observe(
    context: typer.Context,
    robot: Annotated[Path, typer.Argument(metavar="ROBOT", help="The robot: robot.yaml or a URDF.")],
    model: Annotated[
        Model,
        typer.Option("--model", help="What is measured."),
    ] = "distance-rotation",
    configurations: Annotated[
        Path | None,
        typer.Option(
            "--configurations", metavar="TABLE", help="Your configurations; random ones within limits if none."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write observability.json and figures there.")
    ] = None,
    frame: Annotated[FrameKnowledge, typer.Option("--frame", help="Whether world_T_base is estimated too.")] = "known",
    pairing: Annotated[
        Literal["star", "chain", "all"], typer.Option("--pairing", help="Pairs of TABLE's configurations.")
    ] = "star",
    base_link: Annotated[
        str | None, typer.Option("--base-link", metavar="LINK", help="Where the chain of a URDF starts.")
    ] = None,
    tip_link: Annotated[
        str | None, typer.Option("--tip-link", metavar="LINK", help="Where the chain of a URDF ends.")
    ] = None,
    prefer: Annotated[
        str, typer.Option("--prefer", metavar="NAMES", help="Parameters to keep, first choice first: theta2,d5.")
    ] = "",
    length: Annotated[LengthUnit, typer.Option("--length", help="Unit of lengths in TABLE and of its noise.")] = "m",
    angle: Annotated[AngleUnit, typer.Option("--angle", help="Unit of angles in TABLE and of its noise.")] = "rad",
    position_noise: Annotated[
        float | None, typer.Option(help="1 sigma of a position in TABLE; 1 mm if not given.")
    ] = None,
    orientation_noise: Annotated[
        float | None, typer.Option(help="1 sigma of an orientation in TABLE; 1 mrad if not given.")
    ] = None,
    joint_noise: Annotated[float, typer.Option(help="1 sigma of a joint reading in TABLE.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the random configurations, without TABLE.")] = 0,
    as_json: Json = False,
) -> None:
    """Say which parameters measurements can determine, which only together, and why not the others."""
    from fg_calib.analysis.identifiability import observe_configurations, observe_structure
    from fg_calib.files.robot_yaml import read_robot
    from fg_calib.files.tables import read_measurements
    from fg_calib.files.units import Units
    from fg_calib.measurements.dataset import Noise
    from fg_calib.options import Pairing
    from fg_calib.report.documents import observability_document, write_observability
    from fg_calib.report.text import build_identifiability_report

    if configurations is None:
        _refuse_idle(context, _OF_A_TABLE, "without --configurations")
    else:
        _refuse_idle(context, ("seed",), "with --configurations")
    arm = read_robot(robot, base_link=base_link, tip_link=tip_link)
    names = [name.strip() for name in prefer.split(",") if name.strip()]
    for name in names:
        arm.index(name)
    if configurations is None:
        found = observe_structure(arm, model, frame=frame, prefer=names, seed=seed)
    else:
        units = Units(length=length, angle=angle)

        def si(figure: float | None, unit: str) -> float | None:
            return None if figure is None else figure * units.factor(unit)

        noise = Noise(
            position=si(position_noise, "m"),
            orientation=si(orientation_noise, "rad"),
            joint=tuple(joint_noise * units.factor(j.unit) for j in arm.joints),
        )
        table = read_measurements(configurations, arm, units=units, noise=noise)
        found = observe_configurations(arm, table, model, frame=frame, pairing=Pairing(pairing), prefer=names)
    if out is not None:
        write_observability(out, found)
    if as_json:
        print(json.dumps(observability_document(found), allow_nan=False))
    else:
        _show(build_identifiability_report(found))


@app.command()
def simulate(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="The scenario: a YAML file, or a shipped one: space-robot.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write the job to.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all that is drawn.")] = 0,
    as_json: Json = False,
) -> None:
    """Simulate a calibration job: the true robot, and what is measured of it, with noise."""
    from fg_calib.files.scenario import read_scenario, write_simulation
    from fg_calib.simulation.simulator import simulate as run

    simulation = run(read_scenario(scenario), seed)
    names = write_simulation(out, simulation)
    if as_json:
        print(json.dumps({"files": [str(out / name) for name in names], **simulation.summary()}, allow_nan=False))
    else:
        test = simulation.measurements.test
        print(f"{simulation.scenario.name}, seed {seed}: {sum(~test)} configurations to calibrate, {sum(test)} to test")
    print(f"wrote {', '.join(names)} to {out}", file=sys.stderr)
    print(f"now: fg-calib calibrate {out / 'calibration.yaml'} --out {out / 'result'}", file=sys.stderr)


@app.command()
def example(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The example: space-robot.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write it to.")],
) -> None:
    """Write a ready job to try the package on: robot, measurements and calibration.yaml."""
    from fg_calib.files.disk import fill_folder

    known = sorted(folder.name for folder in EXAMPLES.iterdir() if folder.is_dir())
    if name not in known:
        raise InputError("example", f"found {name!r}", f"one of {', '.join(known)}")
    files = sorted(file for file in (EXAMPLES / name).iterdir() if file.is_file())
    for file in files:
        if (out / file.name).exists():
            raise InputError(str(out / file.name), "is there already", "a folder without it")

    def write(folder: Path) -> None:
        for file in files:
            (folder / file.name).write_bytes(file.read_bytes())

    fill_folder(out, write)
    print(f"wrote {', '.join(file.name for file in files)} to {out}", file=sys.stderr)
    print(f"now: fg-calib calibrate {out / 'calibration.yaml'} --out {out / 'result'}", file=sys.stderr)


if __name__ == "__main__":
    main()
