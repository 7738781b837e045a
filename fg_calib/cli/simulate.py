"""`fg-calib simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fg_calib.cli.output import Json, say_next, show_json


def simulate(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="The scenario: a YAML file, or a shipped one: space-robot.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write the job to.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all that is drawn.")] = 0,
    as_json: Json = False,
) -> None:
    """Simulate a calibration job: the true robot, and what is measured of it, with noise."""
    from fg_calib.files.scenario import read_scenario
    from fg_calib.files.simulation import require_no_other_job, write_simulation
    from fg_calib.simulation import simulator

    simulation = simulator.simulate(read_scenario(scenario), seed)
    require_no_other_job(out, simulation)
    names = write_simulation(out, simulation)
    if as_json:
        show_json({"files": [str(out / name) for name in names], **simulation.summary()})
    else:
        test = simulation.measurements.test
        print(f"{simulation.scenario.name}, seed {seed}: {sum(~test)} configurations to calibrate, {sum(test)} to test")
    say_next(names, out)
