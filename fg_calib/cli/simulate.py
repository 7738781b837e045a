"""`fg-calib simulate`."""

from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import Json, Seed, argument, option, say_next, show, show_json
from fg_calib.inputs import printable


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
        show(printable(f"{simulation.scenario.name}, seed {seed}: {counts}"))
        for table in simulation.tables if simulation.scenario.instruments else ():
            m = table.measurements
            rows = f"{sum(~m.test)} rows to calibrate, {sum(m.test)} to test"
            show(printable(f"{m.source}: model {table.model}, {rows}"))
    say_next(names, out)
