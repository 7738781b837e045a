"""The command line: the only place that prints, and the one door where errors become a line and an exit code.

Exit codes: 0 good; 1 bad input; 2 wrong usage; 3 solved, but not to be trusted.
"""

from __future__ import annotations

import io
import json
import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from fg_calib import __version__
from fg_calib.errors import CalibrationError, InputError

app = typer.Typer(
    name="fg-calib",
    help="Calibrate a robot arm's geometry, and say how well it is known.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

EXAMPLES = Path(__file__).parent / "examples"

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else there.")]


def main() -> None:
    """Run the command line."""
    logging.basicConfig(stream=sys.stderr, format="%(message)s", level=logging.WARNING)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a letter gets a question mark
            stream.reconfigure(errors="replace")
    try:
        app()
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
    from rich.console import Console

    from fg_calib.files.job import read_job
    from fg_calib.problem import build_problem
    from fg_calib.report import build_report
    from fg_calib.results import result_document, write_results
    from fg_calib.solve import solve
    from fg_calib.uncertainty import assess

    given = read_job(job)
    problem = build_problem(
        given.robot,
        given.measurements,
        model=given.model,
        pairing=given.pairing,
        frame=given.frame,
        prior=given.prior,
    )
    solution = solve(problem)
    uncertainty = assess(solution)
    if out is not None:
        write_results(out, solution, uncertainty, given.inputs)
    if as_json:
        print(json.dumps(result_document(solution, uncertainty, given.inputs), allow_nan=False))
    else:
        Console(highlight=False).print(build_report(solution, uncertainty))
    for finding in uncertainty.findings:
        print(f"not to be trusted: {finding}", file=sys.stderr)
    if not uncertainty.trustworthy:
        raise typer.Exit(3)


@app.command()
def example(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The example: space-robot.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write it to.")],
) -> None:
    """Write a ready job to try the package on: robot, measurements and calibration.yaml."""
    from fg_calib.results import fill_folder

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
