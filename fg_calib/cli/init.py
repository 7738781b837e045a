"""`fg-calib init`, `simulate` and `example`: where a job comes from."""

import shlex
from pathlib import Path
from typing import Annotated

import fg_calib
from fg_calib import cli, importers, inputs, io, simulation
from fg_calib.cli.output import Json, Seed, argument, option, say, say_next, show, show_json

EXAMPLES = sorted(folder.name for folder in cli.EXAMPLES.iterdir() if folder.is_dir())


def init(
    files: Annotated[list[Path], argument("FILES...", "robot.yaml or a URDF, tables, perhaps camera.yaml.")],
    out: Annotated[Path, option("--out", "JOB", "The job to write.")] = Path("calibration.yaml"),
) -> None:
    """Write a commented job for a robot and its tables, recognised by their headers; nothing is overwritten."""
    io.require_absent(out.parent, [out.name])
    text = importers.draft_job(files, out)
    io.write_text(out, text)
    decisions = sum("DECIDE" in line for line in text.splitlines()[2:])
    say(f"wrote {out}: {decisions} lines with DECIDE are yours to look at")
    say(f"now: fg-calib inspect {shlex.quote(str(out))}")


def simulate(
    scenario: Annotated[str, argument("SCENARIO", "The scenario: a YAML file, or a shipped one: space-robot.")],
    out: Annotated[Path, option("--out", "DIR", "Folder to write the job to.")],
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Simulate a calibration job: the true robot, and what is measured of it, with noise."""
    made = fg_calib.simulate(simulation.read_scenario(scenario), seed)
    names = simulation.write_simulation(out, made)
    if as_json:
        show_json({"files": [str(out / name) for name in names], **made.summary()})
    else:
        n_train, n_test = (made.n_configurations(test=test) for test in (False, True))
        counts = f"{n_train} configurations to calibrate, {n_test} to test"
        show(inputs.printable(f"{made.scenario.name}, seed {seed}: {counts}"))
        for table in made.tables if made.scenario.instruments else ():
            m = table.measurements
            rows = f"{sum(~m.test)} rows to calibrate, {sum(m.test)} to test"
            show(inputs.printable(f"{m.source}: model {table.model}, {rows}"))
    say_next(names, out)


def example(
    name: Annotated[str, argument("NAME", f"The example: {', '.join(EXAMPLES)}.")],
    out: Annotated[Path, option("--out", "DIR", "Folder to write it to.")],
) -> None:
    """Write a ready job to try the package on: robot, measurements and calibration.yaml."""
    inputs.expect(name in EXAMPLES, "example", f"found {name!r}", f"one of {', '.join(EXAMPLES)}")
    files = {file.name: file.read_bytes() for file in sorted((cli.EXAMPLES / name).iterdir()) if file.is_file()}
    io.require_absent(out, files)
    io.fill_folder(out, files)
    say_next([*files], out)
