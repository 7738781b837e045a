"""What to simulate (true errors of the robot, configurations, noise), and the result of a simulation.

A `Scenario` is complete without a file: everything in it is SI. `files.scenario` reads one from YAML,
`files.simulation` writes a `Simulation` as a calibration job; `simulator` makes a `Simulation` of a `Scenario`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Measurements, Noise
from fg_calib.options import NEAR, AngleUnit, LengthUnit, check, check_number, did_you_mean, known_names
from fg_calib.robot.model import Robot, names_of, tolerance_kind

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """A frame in another one, such as world_T_base or base_T_board.

    Attributes:
        rotation: Shape (3, 3).
        position: Shape (3,), [m].
    """

    rotation: Floats
    position: Floats


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
class BoardViews:
    """Configurations in which the tool's z axis, a camera's optical axis, meets the centre of a board.

    The first is A, `height` above the centre. The others are spread evenly over the half sphere of `radius` about A
    on the side away from the board (Jia et al. 2019, section 5.1), or, with `distance`, drawn at such distances from
    the centre, evenly in distance and in direction within `cone` of the normal.

    Attributes:
        board: base_T_board; z is the normal on the camera's side.
        count: Number of configurations beside A.
        height: Distance of A from the centre, [m].
        radius: Of the half sphere about A, [m].
        distance: Smallest and largest distance from the centre, [m]; None for the half sphere.
        cone: Largest angle between the normal and the direction from the centre to the camera, [rad].
        roll: Of the camera about its optical axis, [rad]; at 0 its x axis at A is the board's, and elsewhere what
            the smallest turn of the optical axis makes of that. None draws it.
        self_motion: `random`: every configuration has its own, from a random start of the inverse kinematics;
            `held`: all continue from that of A by steps of minimum norm.
        posture: Configuration near which that of A is sought, if self-motion is held, shape (n_joints,), [rad]
            (prismatic: [m]); None draws it.
    """

    board: Placement
    count: int = 51
    height: float = 0.5
    radius: float = 0.5
    distance: tuple[float, float] | None = None
    cone: float = math.pi / 3.0
    roll: float | None = None
    self_motion: Literal["random", "held"] = "random"
    posture: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check("board: self_motion", self.self_motion, ("random", "held"))
        check_number("board: count", self.count, whole=True)
        for key in ("height", "radius", "cone"):
            check_number(f"board: {key}", getattr(self, key), above=True)


@dataclass(frozen=True)
class RandomReadings:
    """Configurations drawn evenly within the joint limits, +-180 degrees or +-1 m where there are none."""

    count: int

    def __post_init__(self) -> None:
        check_number("random: count", self.count, above=True, whole=True)


@dataclass(frozen=True)
class GivenReadings:
    """Configurations of a table.

    Attributes:
        readings: Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """

    readings: Floats


Configurations = BoardViews | RandomReadings | GivenReadings


@dataclass(frozen=True)
class Scenario:
    """A simulation to run.

    Attributes:
        robot: The nominal robot.
        errors: True minus nominal parameters.
        configurations: Where the robot is measured to be calibrated, as the nominal robot would get there.
        noise: What truly disturbs, 1 sigma; `position` and `orientation` are needed.
        frame: world_T_base, in whose world the poses are measured: `base` is the base itself, `unknown` an arbitrary
            one, drawn.
        validation: Where it is measured to test the calibration; None without test rows.
        stated_noise: The noise that the calibration is told, where that is another one.
        job: Other keys of the calibration job, such as model and pairing.
        length_unit: Unit of length of the job's files.
        angle_unit: Unit of angles of the job's files.
        name: What it is called.
        source: The file's name, or that of a shipped scenario; for messages.
    """

    robot: Robot
    errors: Errors
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

    def __post_init__(self) -> None:
        if not isinstance(self.frame, Placement):
            check(f"{self.source}: frame", self.frame, ("base", "unknown"))
        check(f"{self.source}: length_unit", self.length_unit, LengthUnit)
        check(f"{self.source}: angle_unit", self.angle_unit, AngleUnit)


@dataclass(frozen=True)
class Simulation:
    """One run of a scenario.

    Attributes:
        scenario: What was simulated.
        seed: The seed.
        robot: The nominal robot.
        true_robot: The robot that moved: the same parameters, with their true values.
        measurements: The readings and the measured poses, with the sigmas that are stated; rows of the validation
            are test rows.
        true_readings: Where the joints stood: the readings plus the encoder noise, shape (n_configurations,
            n_joints), [rad] (prismatic: [m]).
        frame: world_T_base.
    """

    scenario: Scenario
    seed: int
    robot: Robot
    true_robot: Robot
    measurements: Measurements
    true_readings: Floats
    frame: Placement

    @property
    def job(self) -> dict[str, Any]:
        """The keys of the calibration job that are not files or figures: model, pairing, frame, ..."""
        known = isinstance(self.scenario.frame, str) and self.scenario.frame == "base"
        return {**self.scenario.job, "frame": "known" if known else "unknown"}

    def summary(self) -> dict[str, Any]:
        """Seed, numbers of rows and truth, for programs: errors and frame in [m] and [rad]."""
        from scipy.spatial.transform import Rotation

        test = self.measurements.test
        errors = self.true_robot.nominal - self.robot.nominal
        return {
            "scenario": self.scenario.name,
            "seed": self.seed,
            "n_configurations": len(test),
            "n_train": int(np.sum(~test)),
            "n_test": int(np.sum(test)),
            "truth": {
                "errors": {p.name: float(e) for p, e in zip(self.robot.parameters, errors, strict=True) if e != 0.0},
                "world_T_base": {
                    "xyz": self.frame.position.tolist(),
                    "quaternion_xyzw": Rotation.from_matrix(self.frame.rotation).as_quat(canonical=True).tolist(),
                },
            },
        }


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
