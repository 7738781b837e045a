"""Problems of what could be measured: the rows that a robot's own predictions make."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fg_calib import inputs
from fg_calib.graph import Problem, problem_at, start_of, tables_of, variables_of
from fg_calib.inputs import Floats, Options, Pairing
from fg_calib.measurements import INSTRUMENTS, Measurements, Table, build_dataset, predict_measurements
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot, random_readings

Places = Mapping[tuple[str, str], Floats]
"""Coordinates of landmarks, and unknown frames as X, by letter and name."""

STRUCTURAL_FLOOR = 1e-6
"""Signal-to-noise ratio that counts as nothing on random configurations with an assumed noise: rounding alone."""


@single_threaded
def predicted_problem(
    robot: Robot,
    measurements: Measurements,
    model: inputs.Model,
    *,
    frame: inputs.FrameKnowledge = "known",
    pairing: Pairing | None = None,
    pair_errors: inputs.PairErrors = "shared",
) -> Problem:
    """The problem that a robot's own predictions at some configurations make: what could be measured there.

    Args:
        robot: The robot.
        measurements: The configurations (train rows) and their noise, 1 mm and 1 mrad where unknown; measured
            values are not looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is estimated too.
        pairing: How pairs are formed; a star if None.
        pair_errors: Whether pairs of one configuration share its errors or count as independent.
    """
    options = Options(model, pairing or Pairing(), frame, gauge="none", pair_errors=pair_errors)
    options = replace(options, model=INSTRUMENTS[options.model].random_model(Table(measurements)))
    m = predict_measurements(robot, measurements, options.model)
    return true_problem(robot, Table(m, options.model, options.pairing, options.frame), options)


@single_threaded
def true_problem(
    robot: Robot, tables: Table | Sequence[Table], options: Options, places: Places | None = None
) -> Problem:
    """The problem of tables at a robot that is the true one: what else is unknown is where the tables put it.

    Args:
        robot: The robot.
        tables: Tables that it would measure, without noise.
        options: Whether pairs share errors; the tables' own choices count for the rest.
        places: Where frames and unknowns are, of which a few rows may not tell (see `places_of`).
    """
    data, places = build_dataset(robot, tables_of(tables, options)), places or {}
    starts = {i: places[key] for i, key in enumerate(data.landmarks.keys) if key in places}
    data = replace(data, landmarks=data.landmarks.with_starts(starts))
    variables = variables_of(robot, data, options)
    start = start_of(robot.with_estimated([]), data, variables)  # the arm as it is, what it measures where it is
    where_of = data.landmarks.by_key(variables.coordinates)  # in a parameter vector; -1 where not estimated
    where_of |= {("X", data.labels[v.number]): v.places for v in variables.frames}
    for name, where in where_of.items():
        if name in places and np.all(where >= 0):
            start[where] = places[name]
    return problem_at(robot, data, options, variables, start)


def places_of(problem: Problem, parameters: Floats) -> dict[tuple[str, str], Floats]:
    """Coordinates of landmarks by letter and name, and unknown measurement frames by X and their table's label."""
    places = problem.data.landmarks.by_key(problem.variables.at(parameters).coordinates)
    return places | {("X", problem.data.labels[v.number]): parameters[v.places] for v in problem.variables.frames}


@single_threaded
def random_problem(
    robot: Robot, model: inputs.Model, frame: inputs.FrameKnowledge, *, n_configurations: int, seed: int
) -> Problem:
    """`predicted_problem` at random configurations: what a model can determine at all.

    Args:
        robot: The robot; its joints move as `random_readings` says.
        model: Which measurements take part; pairs are chained. Noise is assumed as `Robot.scale_of` says.
        frame: Whether the measurement frame is estimated too.
        n_configurations: How many; 0 for ten for every parameter but those of error curves, 300 at least.
        seed: Of the random configurations.
    """
    n = n_configurations or max(300, 10 * sum(p.kind != "curve" for p in robot.parameters))
    somewhere = Measurements.at(robot, random_readings(robot, n, np.random.default_rng(seed)))
    return predicted_problem(robot, somewhere, model, frame=frame, pairing=Pairing("chain"), pair_errors="independent")
