"""Simulation: a true robot, where it is sent, and what is measured there.

Truth comes from forward kinematics alone; nothing here knows how a calibration works. Encoder noise moves the arm: it
stands where the readings plus that noise say, and the table holds the readings. `measure` says what instruments
measure; without instruments a tracker measures poses of the tool.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fg_calib.inputs import Brief, Floats, InputError, check_number, checked
from fg_calib.measurements import Measurements, Table
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot
from fg_calib.simulation.measure import Measuring, Visits, choose_frame, generator_of, joint_sigma, merge_truths
from fg_calib.simulation.scenario import (
    Configurations,
    Errors,
    Instrument,
    Placement,
    Scenario,
    frame_knowledge,
    values_by_name,
)
from fg_calib.simulation.views import find_readings


@dataclass(frozen=True)
class Simulation(Brief):
    """One run of a scenario.

    Attributes:
        scenario: What was simulated.
        seed: The seed.
        robot: The nominal robot.
        true_robot: The robot that moved: the same parameters, with their true values.
        true_readings: Where the joints stood at the scenario's configurations: the readings plus the encoder noise,
            shape (n_configurations, n_joints), [rad] (prismatic: [m]).
        frame: world_T_base.
        tables: What was measured, as `calibrate` takes it: a table for each instrument. Rows of the validation are
            test rows.
        truth: Where targets, anchors, planes, boards, sockets and frames truly are, by kind and name: `Spot`, `Plane`,
            `Placement` (base_T_board, world_T_base); offsets in [m].
    """

    scenario: Scenario
    seed: int
    robot: Robot
    true_robot: Robot
    true_readings: Floats
    frame: Placement
    tables: tuple[Table, ...]
    truth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def measurements(self) -> Measurements:
        """What the first instrument measured."""
        return self.tables[0].measurements

    @property
    def job(self) -> dict[str, Any]:
        """The keys of the calibration job that are not files or values: model, pairing, frame, ..."""
        return {**self.scenario.job, "frame": frame_knowledge(self.scenario.frame)}

    def n_configurations(self, *, test: bool) -> int:
        """Number of different configurations of train or of test rows."""
        tables = [table.measurements for table in self.tables]
        return len(set(np.concatenate([m.ids[m.test == test] for m in tables]).tolist()))

    def summary(self) -> dict[str, Any]:
        """Seed, numbers of rows and truth, for programs: errors and frame in [m] and [rad]."""
        n_train, n_test = (self.n_configurations(test=test) for test in (False, True))
        errors = self.true_robot.nominal - self.robot.nominal
        found = {
            "scenario": self.scenario.name,
            "seed": self.seed,
            "n_configurations": n_train + n_test,
            "n_train": n_train,
            "n_test": n_test,
            "truth": {
                "errors": {p.name: float(e) for p, e in zip(self.robot.parameters, errors, strict=True) if e != 0.0},
                "world_T_base": self.frame.summary(),
            },
        }
        if self.scenario.instruments:
            rows = [(t, t.measurements.source, int(np.sum(t.measurements.test))) for t in self.tables]
            found["tables"] = [
                {"table": name, "model": t.model, "n_train": len(t.measurements.test) - n, "n_test": n}
                for t, name, n in rows
            ]
        return found


@checked
@single_threaded
def simulate(scenario: Scenario, seed: int = 0, *, exact: bool = False) -> Simulation:
    """Run a scenario.

    Every parameter, every table and every kind of noise has a generator of its own, by its name: changing one leaves
    what is drawn for the others as it is.

    Args:
        scenario: What to simulate.
        seed: Same seed, same simulation.
        exact: Whether nothing has noise, and known points are where the calibration takes them to be.

    Raises:
        InputError: The scenario is impossible: poses that the robot does not reach within its joint limits, names that
            are no parameters, values that make no sense.
    """
    check_number("seed", seed, whole=True)
    source = scenario.source
    true_robot = _draw_robot(scenario.robot, scenario.errors, seed, f"{source}: errors")
    frame = choose_frame(scenario.frame, generator_of(seed, "frame"))
    common = [_visit(scenario, scenario.configurations, seed, "configurations", exact)]
    if scenario.validation is not None:
        common.append(_visit(scenario, scenario.validation, seed, "validation", exact, len(common[0].ids)))
    default = Instrument(model="pose", name="poses")
    tables, truths = [], []
    for instrument in scenario.instruments or (default,):
        visits = common
        if instrument.configurations is not None:
            own = _visit(scenario, instrument.configurations, seed, f"instruments: {instrument.name}", exact)
            visits = [own._replace(ids=np.array([f"{instrument.name} {name}" for name in own.ids])), *common[1:]]
        measuring = Measuring(scenario, instrument, true_robot, Visits.joined(visits), frame, seed, exact)
        table, truth = measuring.measure()
        if instrument is default:
            table, truth = replace(table, model=scenario.job.get("model"), pairing=scenario.pairing), {}
        tables.append(table)
        truths.append(truth)
    shared, every = merge_truths(tables, truths, source)
    true_readings = Visits.joined(common).true_readings
    return Simulation(scenario, seed, scenario.robot, true_robot, true_readings, frame, shared, every)


def _visit(scenario: Scenario, of: Configurations, seed: int, what: str, exact: bool, first: int = 0) -> Visits:
    """Configurations, and where the joints stand there.

    Args:
        scenario: What is simulated.
        of: Which configurations.
        seed: Seed of all draws.
        what: The key that says so: `configurations`, `validation`, or `instruments: name`.
        exact: Whether the encoders have no noise.
        first: Number of the first.
    """
    robot, name = scenario.robot, what.removeprefix("instruments: ")
    place = f"{scenario.source}: {what}" + ": configurations" * (name != what)
    readings = find_readings(robot, of, generator_of(seed, name, "configurations"), place)
    noise = generator_of(seed, name, "joint noise").normal(size=readings.shape)
    stood = readings + (0.0 if exact else joint_sigma(scenario.noise, robot)) * noise
    ids = np.array([f"p{first + k}" for k in range(len(readings))])
    return Visits(readings, stood, ids, np.full(len(readings), what == "validation"))


def _draw_robot(robot: Robot, errors: Errors | None, seed: int, place: str) -> Robot:
    """Draw the robot that moves, each parameter by its name."""
    if errors is None:
        raise InputError(place, "found none", "one of uniform, normal, values: what the arm that moves has")
    values = values_by_name(robot, errors.values, f"{place}: {errors.law}")
    error = np.zeros(len(robot.parameters))
    for k, p in enumerate(robot.parameters):
        size = values.get(p.name, 0.0)
        if errors.law == "values":
            error[k] = size
        elif size < 0.0:
            raise InputError(f"{place}: {errors.law}", f"found {size:g}", "numbers not below 0")
        elif p.estimated:
            generator = generator_of(seed, "errors", p.name)
            error[k] = size * (generator.uniform(-1.0, 1.0) if errors.law == "uniform" else generator.normal())
    return robot.with_values(robot.nominal + error)
