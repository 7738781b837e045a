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
from fg_calib.measurements.series import Table
from fg_calib.options import Pairing, check_number
from fg_calib.robot.inverse import Inverse, random_readings, solve_inverse
from fg_calib.robot.kinematics import build_chain, forward, precompute_trig
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import BoardViews, Configurations, GivenReadings, Placement, RandomReadings
from fg_calib.simulation.instruments import frame_knowledge, with_figures
from fg_calib.simulation.measuring import Scene, Stops, drawn_frame, measure, share_knowledge, together
from fg_calib.simulation.scenario import Errors, Scenario, Simulation, figures_by_name
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

_PURPOSES = ("errors", "configurations", "validation", "frame", "noise", "noise of validation")
"""Each, and each instrument, has a generator of its own: changing one thing of a scenario leaves what is drawn for the
others alone."""


@checked
@single_threaded
def simulate(scenario: Scenario, seed: int = 0) -> Simulation:
    """Run a scenario.

    Args:
        scenario: What to simulate.
        seed: Same seed, same simulation.

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
        return _by_instruments(scenario, seed, true_robot, frame, draw, children[n:])
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
    pairing = _pairing(scenario.job.get("pairing", "star"))
    table = Table(measurements, scenario.job.get("model"), pairing, frame_knowledge(scenario.frame))
    return Simulation(scenario, seed, robot, true_robot, measurements, true_readings, frame, (table,))


def _pairing(given: object) -> Pairing:
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


def _true_robot(robot: Robot, errors: Errors, generator: np.random.Generator, place: str) -> Robot:
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
    at = forward(build_chain(true_robot).without_columns(), precompute_trig(true_robot, true_readings))
    turned = Rotation.from_rotvec(sigma_orientation * orientation).as_matrix()
    world_R_tool = frame.rotation @ at.rotation @ turned
    world_p_tool = at.position @ frame.rotation.T + frame.position + sigma_position * position
    return readings, true_readings, world_R_tool, world_p_tool


def _sigmas(noise: Noise, place: str, *, stated: bool = False) -> tuple[float, float]:
    """Sigma of positions, [m], and of orientations, [rad]; above 0 where a calibration is told them (`stated`)."""
    sigmas = []
    for key, figure in (("position", noise.position), ("orientation", noise.orientation)):
        if figure is None or not np.isfinite(figure) or figure < 0.0:
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
    match configurations:
        case RandomReadings(count):
            return random_readings(robot, count, generator)
        case GivenReadings(readings):
            return np.asarray(readings, dtype=np.float64)
        case BoardViews():
            rotation, position = view_board(configurations, generator)
            return _reach(robot, configurations, rotation, position, generator, f"{place}: board")


def view_board(views: BoardViews, generator: np.random.Generator) -> tuple[Floats, Floats]:
    """Poses of a camera that looks at a board's centre, A first.

    Args:
        views: Where from.
        generator: Draws what is left open.

    Returns:
        base_R_tool, shape (1 + count, 3, 3), and base_p_tool, shape (1 + count, 3), [m].
    """
    from scipy.spatial.transform import Rotation

    places, rolls = generator.spawn(2)
    A = np.array([[0.0, 0.0, views.height]])
    if views.distance is None:
        others = A + views.radius * _half_sphere(views.count)
    else:
        drawn = places.uniform(size=(views.count, 3))  # one row a view: more views leave the first as they are
        cosine = 1.0 - drawn[:, 0] * (1.0 - np.cos(views.cone))
        away = views.distance[0] + drawn[:, 1] * (views.distance[1] - views.distance[0])
        others = away[:, None] * _directions(cosine, 2.0 * np.pi * drawn[:, 2])
    board_p_tool = np.concatenate([A, others])  # (n, 3)
    drawn_roll = rolls.uniform(-np.pi, np.pi, len(board_p_tool))
    roll = drawn_roll if views.roll is None else np.full(len(drawn_roll), views.roll)
    # At A the camera is the board's frame turned about its x axis by half a turn; from there the shortest way.
    up, away = np.array([0.0, 0.0, 1.0]), np.linalg.norm(board_p_tool, axis=1, keepdims=True)
    axis = np.cross(up, board_p_tool / away)  # (n, 3), of length sin(tilt)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    tilt = np.arctan2(sine, board_p_tool[:, 2:] / away)
    turn = Rotation.from_rotvec(axis * np.where(sine > 0.0, tilt / np.where(sine > 0.0, sine, 1.0), 0.0))
    over = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    board_R_tool = (turn * over * Rotation.from_rotvec(roll[:, None] * up)).as_matrix()
    base_R_board = views.board.rotation
    return base_R_board @ board_R_tool, board_p_tool @ base_R_board.T + views.board.position


def _half_sphere(n: int) -> Floats:
    """Unit vectors spread evenly over the half sphere z >= 0, shape (n, 3): a spiral in golden steps.

    Equal steps in z cut equal areas, and turns by the golden angle keep neighbouring turns apart.
    """
    k = np.arange(n) + 0.5
    return _directions(1.0 - k / max(n, 1), np.pi * (1.0 + np.sqrt(5.0)) * k)


def _directions(cosine: Floats, azimuth: Floats) -> Floats:
    """Unit vectors by the cosine of their angle to z and their azimuth, shape (n, 3)."""
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def _reach(
    robot: Robot, views: BoardViews, rotation: Floats, position: Floats, generator: np.random.Generator, place: str
) -> Floats:
    """Configurations that bring the camera to poses, shape (n_poses, n_joints)."""
    if views.self_motion == "random":
        return _require(solve_inverse(robot, position, rotation, generator=generator), place)
    near = None if views.posture is None else np.array(views.posture)
    first = _require(
        solve_inverse(robot, position[:1], rotation[:1], generator=generator, near=near), place, len(rotation)
    )
    others = solve_inverse(robot, position[1:], rotation[1:], generator=generator, near=first[0])
    return np.concatenate([first, _require(others, place, len(rotation), 1)])


def _require(found: Inverse, place: str, n: int | None = None, first: int = 0) -> Floats:
    """The solutions.

    Raises:
        InputError: One of the poses was not reached.
    """
    missed = np.flatnonzero(~found.reached)
    if len(missed) == 0:
        return found.readings
    n = len(found.readings) if n is None else n
    names = ["A" if first + i == 0 else f"view {first + i}" for i in range(len(found.readings))]
    listed = ", ".join([*(names[i] for i in missed[:12]), *(["..."] if len(missed) > 12 else [])])
    nearest = missed[np.argmin(found.miss_position[missed])]
    farthest = missed[np.argmax(found.miss_position[missed])]
    spans = [
        f"{names[i]} by {found.miss_position[i]:.3g} m and {np.rad2deg(found.miss_rotation[i]):.3g} deg"
        for i in dict.fromkeys([nearest, farthest])
    ]
    raise InputError(
        place,
        f"{len(missed)} of {n} views not reached within the joint limits ({listed}): "
        f"the nearest configurations found miss {' and '.join(spans)}",
        hint="move the board nearer or widen the limits",
    )
