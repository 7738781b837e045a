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
from fg_calib.measurements import Measurements, Noise, Table
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot
from fg_calib.simulation.measure import Scene, Visits, draw_frame, generator_of, measure, merge_truths
from fg_calib.simulation.scenario import (
    Configurations,
    Errors,
    Placement,
    Scenario,
    Tracker,
    frame_knowledge,
    override_noise,
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
def simulate(scenario: Scenario, seed: int = 0, *, leave_out: bool = False) -> Simulation:
    """Run a scenario.

    Every parameter, every table and every kind of noise has a generator of its own, by its name: changing one leaves
    what is drawn for the others as it is.

    Args:
        scenario: What to simulate.
        seed: Same seed, same simulation.
        leave_out: Whether configurations are left out from which a point to touch is not reached, instead of an error.

    Raises:
        InputError: The scenario is impossible: poses that the robot does not reach within its joint limits, names that
            are no parameters, values that make no sense.
    """
    check_number("seed", seed, whole=True)
    robot, source = scenario.robot, scenario.source
    true_robot = _draw_robot(robot, scenario.errors, seed, f"{source}: errors")
    frame = scenario.frame
    if not isinstance(frame, Placement):
        unknown = frame == "unknown"
        frame = draw_frame(generator_of(seed, "frame")) if unknown else Placement(np.eye(3), np.zeros(3))
    common: list[Visits] = []
    for key, of in (("configurations", scenario.configurations), ("validation", scenario.validation)):
        if of is not None:
            first = sum(map(len, common))
            one = _visit(scenario, of, seed, f"{source}: {key}", key)
            names = np.array([f"p{first + i}" for i in range(len(one))])
            common.append(replace(one, ids=names, test=np.full(len(one), key == "validation")))
    specified = scenario.stated_noise or scenario.noise
    default = Tracker(model="pose", name="poses")
    tables, truths = [], []
    for instrument in scenario.instruments or (default,):
        visits = common
        if instrument.configurations is not None:
            place = f"{source}: instruments: {instrument.name}: configurations"
            own = _visit(scenario, instrument.configurations, seed, place, instrument.name)
            visits = [replace(own, ids=np.array([f"{instrument.name} p{i}" for i in range(len(own))])), *common[1:]]
        scene = Scene(
            robot=robot,
            true_robot=true_robot,
            visits=Visits.joined(visits),
            configurations=instrument.configurations or scenario.configurations,
            noise=override_noise(scenario.noise, instrument.noise),
            stated_noise=override_noise(override_noise(specified, instrument.noise), instrument.stated_noise),
            sigma_joint=_joint_sigma(specified, robot),
            frame=frame,
            known_frame=frame_knowledge(scenario.frame) == "known",
            seed=seed,
            source=source,
            leave_out=leave_out,
        )
        table, truth = measure(instrument, scene)
        if instrument is default:
            table, truth = replace(table, model=scenario.job.get("model"), pairing=scenario.pairing), {}
        tables.append(table)
        truths.append(truth)
    shared, every = merge_truths(tables, truths, source)
    return Simulation(scenario, seed, robot, true_robot, Visits.joined(common).true_readings, frame, shared, every)


def _visit(scenario: Scenario, of: Configurations, seed: int, place: str, name: str) -> Visits:
    """Configurations, and where the joints stand there."""
    robot = scenario.robot
    readings = find_readings(robot, of, generator_of(seed, name, "configurations"), place)
    n = len(readings)
    noise = generator_of(seed, name, "joint noise").normal(size=(n, robot.n_joints))
    stood = readings + _joint_sigma(scenario.noise, robot) * noise
    return Visits(readings, stood, np.full(n, ""), np.zeros(n, dtype=np.bool_))


def _draw_robot(robot: Robot, errors: Errors | None, seed: int, place: str) -> Robot:
    """Draw the robot that moves, each parameter by its name."""
    if errors is None:
        raise InputError(place, "found none", "one of uniform, normal, values: what the arm that moves has")
    values = values_by_name(robot, errors.values, f"{place}: {errors.law}")
    if errors.law == "values":
        return robot.with_values(robot.nominal + np.array([values.get(p.name, 0.0) for p in robot.parameters]))
    error = np.zeros(len(robot.parameters))
    for k, p in enumerate(robot.parameters):
        size = values.get(p.name, 0.0)
        if not np.isfinite(size) or size < 0.0:
            raise InputError(f"{place}: {errors.law}", f"found {size:g}", "numbers not below 0")
        if p.estimated:
            generator = generator_of(seed, "errors", p.name)
            error[k] = size * (generator.uniform(-1.0, 1.0) if errors.law == "uniform" else generator.normal())
    return robot.with_values(robot.nominal + error)


def _joint_sigma(noise: Noise, robot: Robot) -> Floats:
    """Sigma of the readings, shape (n_joints,), [rad] (prismatic: [m])."""
    return np.broadcast_to(np.asarray(noise.joint, dtype=np.float64), robot.n_joints).copy()
