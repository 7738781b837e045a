"""`fg-calib init`, `simulate` and `example`: where a job comes from."""

import shlex
from pathlib import Path
from typing import Annotated

from fg_calib import cli, inputs
from fg_calib.cli.output import Json, Seed, argument, option, say, say_next, show, show_json

EXAMPLES = sorted(folder.name for folder in cli.EXAMPLES.iterdir() if folder.is_dir())


def init(
    files: Annotated[list[Path], argument("FILES...", "robot.yaml or a URDF, tables, perhaps camera.yaml.")],
    out: Annotated[Path, option("--out", "JOB", "The job to write.")] = Path("calibration.yaml"),
) -> None:
    """Write a commented job for a robot and its tables, recognised by their headers; nothing is overwritten."""
    from fg_calib import importers, io

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
    from fg_calib.simulation import read_scenario, simulator, write_simulation

    simulation = simulator.simulate(read_scenario(scenario), seed)
    names = write_simulation(out, simulation)
    if as_json:
        show_json({"files": [str(out / name) for name in names], **simulation.summary()})
    else:
        n_train, n_test = (simulation.n_configurations(test=test) for test in (False, True))
        counts = f"{n_train} configurations to calibrate, {n_test} to test"
        show(inputs.printable(f"{simulation.scenario.name}, seed {seed}: {counts}"))
        for table in simulation.tables if simulation.scenario.instruments else ():
            m = table.measurements
            rows = f"{sum(~m.test)} rows to calibrate, {sum(m.test)} to test"
            show(inputs.printable(f"{m.source}: model {table.model}, {rows}"))
    say_next(names, out)


def example(
    name: Annotated[str, argument("NAME", f"The example: {', '.join(EXAMPLES)}.")],
    out: Annotated[Path, option("--out", "DIR", "Folder to write it to.")],
) -> None:
    """Write a ready job to try the package on: robot, measurements and calibration.yaml."""
    from fg_calib.io import fill_folder, require_absent

    if name not in EXAMPLES:
        raise inputs.InputError("example", f"found {name!r}", f"one of {', '.join(EXAMPLES)}")
    files = {file.name: file.read_bytes() for file in sorted((cli.EXAMPLES / name).iterdir()) if file.is_file()}
    require_absent(out, files)
    fill_folder(out, files)
    say_next([*files], out)
