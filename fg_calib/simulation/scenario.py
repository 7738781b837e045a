"""What to simulate (true errors of the robot, configurations, noise), and the result of a simulation.

A `Scenario` is complete without a file: everything in it is SI. `files.scenario` reads one from YAML,
`files.simulation` writes a `Simulation` as a calibration job; `simulator` makes a `Simulation` of a `Scenario`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import Brief
from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Measurements, Noise
from fg_calib.measurements.table import Table
from fg_calib.options import NEAR, AngleUnit, LengthUnit, check, did_you_mean, known_names
from fg_calib.robot.model import Robot, names_of, tolerance_kind
from fg_calib.simulation.configurations import Configurations, Placement
from fg_calib.simulation.instruments import Instrument, frame_knowledge

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """True minus nominal values of parameters.

    Attributes:
        law: `uniform` within plus and minus the figures, `normal` with the figures as 1 sigma, or the figures
            themselves (`values`).
        figures: By parameter name or by kind (`a`, `alpha`, `tool`, ...; a name goes before its kind), [m] or [rad].
            Errors that are drawn are those of estimated parameters only; what has no figure has no error.
    """

    law: Literal["uniform", "normal", "values"]
    figures: Mapping[str, float]

    def __post_init__(self) -> None:
        check("errors: law", self.law, ("uniform", "normal", "values"))


@dataclass(frozen=True)
class Scenario(Brief):
    """A simulation to run.

    Attributes:
        robot: The nominal robot.
        errors: True minus nominal parameters; None where nothing is to be simulated, as for a design.
        configurations: Where the robot is measured to be calibrated, as the nominal robot would get there.
        noise: What truly disturbs, 1 sigma; to simulate, `position` and `orientation` are needed where there are no
            instruments.
        frame: world_T_base, in whose world the poses are measured: `base` is the base itself, `unknown` an arbitrary
            one, drawn.
        validation: Where it is measured to test the calibration; None without test rows.
        stated_noise: The noise that the calibration is told, where that is another one.
        job: Other keys of the calibration job, such as model and pairing.
        length_unit: Unit of length of the job's files.
        angle_unit: Unit of angles of the job's files.
        name: What it is called.
        source: The file's name, or that of a shipped scenario; for messages.
        instruments: What measures, each a table of its own; poses of the tool are measured if empty.
    """

    robot: Robot
    errors: Errors | None
    configurations: Configurations
    noise: Noise
    frame: Literal["base", "unknown"] | Placement = "unknown"
    validation: Configurations | None = None
    stated_noise: Noise | None = None
    job: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({"model": "distance-rotation"}))
    length_unit: LengthUnit = "m"
    angle_unit: AngleUnit = "rad"
    name: str = "scenario"
    source: str = "scenario"
    instruments: tuple[Instrument, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.frame, Placement):
            check(f"{self.source}: frame", self.frame, ("base", "unknown"))
        check(f"{self.source}: length_unit", self.length_unit, LengthUnit)
        check(f"{self.source}: angle_unit", self.angle_unit, AngleUnit)
        names = [i.name for i in self.instruments]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{self.source}: instruments", f"{names.count(name)} with the name {name}", "one")


@dataclass(frozen=True)
class Simulation(Brief):
    """One run of a scenario.

    Attributes:
        scenario: What was simulated.
        seed: The seed.
        robot: The nominal robot.
        true_robot: The robot that moved: the same parameters, with their true values.
        measurements: The readings and the measured poses, with the sigmas that are stated; rows of the validation
            are test rows. Of several instruments those of the first.
        true_readings: Where the joints stood at the scenario's configurations: the readings plus the encoder noise,
            shape (n_configurations, n_joints), [rad] (prismatic: [m]).
        frame: world_T_base.
        tables: What was measured, as `calibrate` takes it: a table for each instrument.
        truth: Where targets, anchors, planes, boards, sockets and frames truly are, by kind and name: `Spot`, `Plane`,
            `Placement` (base_T_board, world_T_base); offsets in [m].
    """

    scenario: Scenario
    seed: int
    robot: Robot
    true_robot: Robot
    measurements: Measurements
    true_readings: Floats
    frame: Placement
    tables: tuple[Table, ...]
    truth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def job(self) -> dict[str, Any]:
        """The keys of the calibration job that are not files or figures: model, pairing, frame, ..."""
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
            found["tables"] = [
                {
                    "table": t.measurements.source,
                    "model": t.model,
                    "n_train": int(np.sum(~t.measurements.test)),
                    "n_test": int(np.sum(t.measurements.test)),
                }
                for t in self.tables
            ]
        return found


def figures_by_name(robot: Robot, figures: Mapping[str, float], place: str) -> dict[str, float]:
    """Turn figures by parameter name or by kind into figures by parameter name.

    Args:
        robot: The robot.
        figures: By name or by kind, [m] or [rad].
        place: File and key, for messages.

    Raises:
        InputError: A key that is neither a parameter nor a kind of the robot.
    """
    names = names_of(robot.parameters)
    kinds = sorted({kind for p in robot.parameters if (kind := tolerance_kind(p)) is not None})
    for key in figures:
        if key not in names and key not in kinds:
            hint = did_you_mean(key, [*kinds, *names], NEAR)
            raise InputError(place, f"unknown parameter or kind {key!r}", known_names(kinds), hint)
    found = {p.name: figures.get(p.name, figures.get(tolerance_kind(p) or "")) for p in robot.parameters}
    return {name: figure for name, figure in found.items() if figure is not None}
