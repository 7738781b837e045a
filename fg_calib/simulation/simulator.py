"""Simulation: a true robot, where it stands, and what is measured there.

Truth comes from forward kinematics alone; nothing here knows how a calibration works. With the true robot's pose
base_T_tool at the readings plus encoder noise, and the measurement frame world_T_base, what is measured is

    world_p_tool = world_R_base base_p_tool + world_p_base + n_position
    world_R_tool = world_R_base base_R_tool exp(n_orientation)

with independent normal noise along the world's axes and about the tool's axes. The table holds the readings without
the noise: the arm is not where its encoders say. `measuring` says what other instruments measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Measurements, Noise
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing, check_number
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot
from fg_calib.robot.shape import foot_in
from fg_calib.simulation.candidates import draw_candidates, number_of, sifted
from fg_calib.simulation.configurations import (
    BoardViews,
    Configurations,
    GivenReadings,
    Placement,
    RandomReadings,
    TargetViews,
)
from fg_calib.simulation.instruments import frame_knowledge, with_figures
from fg_calib.simulation.measure import Scene, Stops, drawn_frame, measure, share_knowledge, together
from fg_calib.simulation.scenario import Errors, Scenario, Simulation, figures_by_name
from fg_calib.simulation.views import reach_all, view_board
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

_PURPOSES = ("errors", "configurations", "validation", "frame", "noise", "noise of validation")
"""Each, and each instrument, has a generator of its own: changing one thing of a scenario leaves what is drawn for the
others alone."""


@checked
@single_threaded
def simulate(scenario: Scenario, seed: int = 0, *, leave_out: bool = False) -> Simulation:
    """Run a scenario.

    Args:
        scenario: What to simulate.
        seed: Same seed, same simulation.
        leave_out: Whether stops are left out from which a point to touch is not reached, instead of an error.

    Raises:
        InputError: The scenario cannot be: poses that the robot does not reach within its joint limits, names that
            are no parameters, figures that make no sense.
    """
    check_number("seed", seed, whole=True)
    n = len(_PURPOSES)
    children = np.random.default_rng(seed).spawn(n + len(scenario.instruments))
    draw = dict(zip(_PURPOSES, children, strict=False))
    true_robot = _true_robot(scenario.robot, scenario.errors, draw["errors"], f"{scenario.source}: errors")
    frame = _frame(scenario, draw["frame"])
    if scenario.instruments:
        return _by_instruments(scenario, seed, true_robot, frame, draw, children[n:], leave_out)
    return _poses(scenario, seed, true_robot, frame, draw)


def _sets(scenario: Scenario) -> list[tuple[str, Configurations, str]]:
    """Key, configurations, and the purpose of their noise: to calibrate, and to test where that is wanted."""
    sets = (
        ("configurations", scenario.configurations, "noise"),
        ("validation", scenario.validation, "noise of validation"),
    )
    return [(key, configurations, noise) for key, configurations, noise in sets if configurations is not None]


def _poses(
    scenario: Scenario, seed: int, true_robot: Robot, frame: Placement, draw: Mapping[str, np.random.Generator]
) -> Simulation:
    """Poses of the tool at all configurations."""
    robot = scenario.robot
    sets = [
        _measure(scenario, key, configurations, true_robot, frame, (draw[key], draw[noise]))
        for key, configurations, noise in _sets(scenario)
    ]
    readings, true_readings, rotation, position = (np.concatenate(parts) for parts in zip(*sets, strict=True))
    n = len(readings)
    stated = scenario.stated_noise or scenario.noise
    sigmas = _sigmas(stated, f"{scenario.source}: noise", stated=True)
    measurements = Measurements(
        readings=readings,
        ids=_names(n),
        test=np.arange(n) >= len(sets[0][0]),
        position=position,
        rotation=rotation,
        sigma_position=np.full((n, 3), sigmas[0]),
        sigma_orientation=np.full((n, 3), sigmas[1]),
        sigma_joint=_joint_sigma(stated, robot),
        source="poses.csv",
    )
    pairing = pairing_of(scenario.job.get("pairing", "star"))
    table = Table(measurements, scenario.job.get("model"), pairing, frame_knowledge(scenario.frame))
    return Simulation(scenario, seed, robot, true_robot, measurements, true_readings, frame, (table,))


def pairing_of(given: object) -> Pairing:
    """A pairing as a job states it."""
    if isinstance(given, Mapping):
        return Pairing("random", given["random"], given.get("seed", 0))
    return Pairing(given)  # type: ignore[arg-type] # checks it


def _by_instruments(
    scenario: Scenario,
    seed: int,
    true_robot: Robot,
    frame: Placement,
    draw: Mapping[str, np.random.Generator],
    own: Sequence[np.random.Generator],
    leave_out: bool,
) -> Simulation:
    """What each instrument measures, where it goes itself or where all go."""
    common: list[Stops] = []
    for key, configurations, noise in _sets(scenario):
        first = sum(map(len, common))
        place = f"{scenario.source}: {key}"
        common.append(_stops(scenario, configurations, (draw[key], draw[noise]), place, "p", first, bool(common)))
    stated = scenario.stated_noise or scenario.noise
    tables, truths = [], []
    for instrument, generator in zip(scenario.instruments, own, strict=True):
        reached, joint, places, noise_draws = generator.spawn(4)
        stops, configurations = common, instrument.configurations or scenario.configurations
        if instrument.configurations is not None:
            place = f"{scenario.source}: instruments: {instrument.name}: configurations"
            mine = _stops(scenario, configurations, (reached, joint), place, f"{instrument.name} p", 0, False)
            stops = [mine, *common[1:]]
        scene = Scene(
            robot=scenario.robot,
            true_robot=true_robot,
            stops=together(stops),
            configurations=configurations,
            noise=with_figures(scenario.noise, instrument.noise),
            stated_noise=with_figures(with_figures(stated, instrument.noise), instrument.stated_noise),
            sigma_joint=_joint_sigma(stated, scenario.robot),
            frame=frame,
            known_frame=frame_knowledge(scenario.frame) == "known",
            places=places,
            draws=noise_draws,
            source=scenario.source,
            leave_out=leave_out,
        )
        table, truth = measure(instrument, scene)
        tables.append(table)
        truths.append(truth)
    shared, every = share_knowledge(tables, truths, scenario.source)
    true_readings = together(common).true_readings
    return Simulation(
        scenario, seed, scenario.robot, true_robot, shared[0].measurements, true_readings, frame, shared, every
    )


def _stops(
    scenario: Scenario,
    configurations: Configurations,
    generators: tuple[np.random.Generator, np.random.Generator],
    place: str,
    prefix: str,
    first: int,
    test: bool,
) -> Stops:
    """Configurations, and where the joints stand there."""
    robot = scenario.robot
    readings = _readings(robot, configurations, generators[0], place)
    n = len(readings)
    off = _joint_sigma(scenario.noise, robot) * generators[1].normal(size=(n, robot.n_joints))
    return Stops(readings, readings + off, _names(n, prefix, first), np.full(n, test))


def _names(n: int, prefix: str = "p", first: int = 0) -> NDArray[np.str_]:
    return np.array([f"{prefix}{first + i}" for i in range(n)])


def _true_robot(robot: Robot, errors: Errors | None, generator: np.random.Generator, place: str) -> Robot:
    if errors is None:
        raise InputError(place, "found none", "one of uniform, normal, values: what the arm that moves has")
    figures = figures_by_name(robot, errors.figures, f"{place}: {errors.law}")
    figure = np.array([figures.get(p.name, 0.0) for p in robot.parameters])
    n = len(figure)
    if errors.law == "values":
        return robot.with_values(robot.nominal + figure)
    if not (np.isfinite(figure) & (figure >= 0.0)).all():
        raise InputError(f"{place}: {errors.law}", f"found {figure.min():g}", "numbers not below 0")
    # One for each parameter, needed or not: fixing one leaves the errors of the others as they are.
    drawn = generator.uniform(-1.0, 1.0, n) if errors.law == "uniform" else generator.normal(size=n)
    estimated = np.array([p.estimated for p in robot.parameters])
    return robot.with_values(robot.nominal + np.where(estimated, figure * drawn, 0.0))


def _frame(scenario: Scenario, generator: np.random.Generator) -> Placement:
    if isinstance(scenario.frame, Placement):
        return scenario.frame
    if scenario.frame == "base":
        return Placement(np.eye(3), np.zeros(3))
    return drawn_frame(generator)


def _measure(
    scenario: Scenario,
    key: str,
    configurations: Configurations,
    true_robot: Robot,
    frame: Placement,
    generators: tuple[np.random.Generator, np.random.Generator],
) -> tuple[Floats, Floats, Floats, Floats]:
    """Readings, where the joints stood, and the measured rotation and position, one row a configuration."""
    from scipy.spatial.transform import Rotation

    robot = scenario.robot
    sigma_position, sigma_orientation = _sigmas(scenario.noise, f"{scenario.source}: noise")
    readings = _readings(robot, configurations, generators[0], f"{scenario.source}: {key}")
    n = len(readings)
    # Standard normal numbers first: another sigma scales the same noise.
    joint, position, orientation = (generators[1].normal(size=(n, m)) for m in (robot.n_joints, 3, 3))
    true_readings = readings + _joint_sigma(scenario.noise, robot) * joint
    at = forward(build_chain(true_robot).without_columns(), true_robot.trig(true_readings))
    turned = Rotation.from_rotvec(sigma_orientation * orientation).as_matrix()
    world_R_tool = frame.rotation @ at.rotation @ turned
    world_p_tool = at.position @ frame.rotation.T + frame.position + sigma_position * position
    return readings, true_readings, world_R_tool, world_p_tool


def _sigmas(noise: Noise, place: str, *, stated: bool = False) -> tuple[float, float]:
    """Sigma of positions, [m], and of orientations, [rad]; above 0 where a calibration is told them (`stated`)."""
    sigmas = []
    for key, figure in (("position", noise.position), ("orientation", noise.orientation)):
        if figure is None:
            raise InputError(f"{place}: {key}", "found none", "1 sigma: poses are simulated whole")
        if not np.isfinite(figure) or figure < 0.0:
            raise InputError(f"{place}: {key}", f"found {figure}", "a number not below 0")
        if stated and figure == 0.0:
            hint = f"a calibration takes nothing for exact: tell it what to assume under job: noise: {key}"
            raise InputError(f"{place}: {key}", "found 0", "a number above 0", hint)
        sigmas.append(figure)
    return sigmas[0], sigmas[1]


def _joint_sigma(noise: Noise, robot: Robot) -> Floats:
    """Sigma of the readings, shape (n_joints,), [rad] (prismatic: [m])."""
    return np.broadcast_to(np.asarray(noise.joint, dtype=np.float64), robot.n_joints).copy()


def _readings(robot: Robot, configurations: Configurations, generator: np.random.Generator, place: str) -> Floats:
    """The configurations, shape (n, n_joints), [rad] (prismatic: [m])."""
    if isinstance(configurations, TargetViews) or sifted(configurations):
        return _sifted(robot, configurations, generator, place)
    match configurations:
        case RandomReadings(count):
            return random_readings(robot, count, generator)
        case GivenReadings(readings):
            return np.asarray(readings, dtype=np.float64)
        case BoardViews():
            rotation, position = view_board(configurations, generator)
            return reach_all(robot, configurations, rotation, position, generator, f"{place}: board")


def _sifted(robot: Robot, configurations: Configurations, generator: np.random.Generator, place: str) -> Floats:
    """As many configurations as are asked for, all of which keep to their conditions.

    Raises:
        InputError: There are not so many.
    """
    n = number_of(configurations)
    found = draw_candidates(robot, configurations, generator, n, place)
    if len(found.readings) < n:
        hint = foot_in(robot, configurations.keep_out) or "ask for fewer, or relax what they have to keep to"
        raise InputError(place, f"{len(found.readings)} of {n} found in {found.reasons()}", hint=hint)
    return found.readings
