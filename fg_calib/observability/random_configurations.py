"""The instruments of a problem at random configurations, which may show what the user's configurations do not.

Targets, anchors, planes and boards stay where they are, known or not as they are; the arm goes to random
configurations, and measures what it predicts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fg_calib.graph import Places, Problem, places_of, problem_at, start_of, variables_of
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, Floats, Options, Pairing
from fg_calib.measurements import INSTRUMENTS, Labels, Measurements, Table, build_dataset
from fg_calib.robot import Robot, build_chain, forward, random_readings

LEAST = 60
"""Random configurations of a table at least, where there are many tables."""


def at_random_configurations(problem: Problem, parameters: Floats) -> Problem | None:
    """The tables of a problem at random configurations, each of those that would say the same once.

    Contacts cannot be planned at random configurations: a table of contacts alone counts as one of positions in an
    unknown frame. Custom kinds are left out.

    Args:
        problem: The problem.
        parameters: Its parameter vector: where the arm and everything else is.

    Returns:
        A problem of the same parameters, noise assumed as `Robot.scale_of` says; None where nothing is left.
    """
    robot = problem.robot.with_values(parameters[problem.variables.robot_span])
    places, before = places_of(problem, parameters), () if problem.knowledge is None else problem.knowledge.views
    q = np.zeros((1, problem.robot.n_joints))
    anything = Measurements.from_arrays(q, position=np.zeros((1, 3)), rotation=np.eye(3)[None])
    earlier = [Table(anything, m, frame=frame) for m, frame in before if m in (*POSE_MODELS, *PAIR_MODELS)]
    different: dict[tuple[object, ...], Table] = {}
    for table in (*problem.data.tables, *earlier):
        if table.model is not None and (named := _named(table))[1]:
            model = INSTRUMENTS[table.model].random_model(table)
            different[model, table.frame, named[0], frozenset(named[1]), table.offset] = table
    if not different:
        return None
    n = LEAST
    generator = np.random.default_rng(0)
    tables = [
        at_configurations(robot, table, random_readings(robot, n, generator), places, f"random {i}")
        for i, table in enumerate(different.values())
    ]
    options = Options(gauge="none", pair_errors="independent")
    data = build_dataset(robot, tables)
    variables = variables_of(robot, data, options)
    return problem_at(robot, data, options, variables, start_of(robot.with_estimated([]), data, variables))


def _named(table: Table) -> tuple[str, list[str | None]]:
    """The column that names landmarks, and those of the train rows; None of rows without a name."""
    instrument = INSTRUMENTS[INSTRUMENTS[str(table.model)].random_model(table)]
    column = next(iter(instrument.labels), "")
    labels, train = table.measurements.labels.get(column), ~table.measurements.test
    if labels is None:
        return column, [column] if instrument.sees_landmarks and column not in instrument.optional_labels else [None]
    return column, [labels.names[k] if k >= 0 else None for k in np.unique(labels.index[train]).tolist()]


def at_configurations(robot: Robot, table: Table, q: Floats, places: Places, source: str) -> Table:
    """A table of what the arm predicts at configurations, landmarks in turn.

    Args:
        robot: The arm.
        table: What instrument it is; for pixels boards are seen, or the tool from the room.
        q: The configurations, shape (n, n_joints).
        places: Of the landmarks that the table names.
        source: What the table is called.
    """
    model = INSTRUMENTS[str(table.model)].random_model(table)
    poses, (column, names) = forward(build_chain(robot), robot.trig(q)), _named(table)
    real = [name for name in names if name is not None]
    index = np.array([real.index(name) if name is not None else -1 for name in names])[np.arange(len(q)) % len(names)]
    length = np.full(len(q), robot.scale_of("m"))
    m = Measurements.from_arrays(
        q,
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=robot.scale_of("m"),
        sigma_orientation=robot.scale_of("rad"),
        source=table.measurements.source,
    )
    sigmas = dict.fromkeys(INSTRUMENTS[model].generic_columns, length)
    m = replace(m, labels={column: Labels(tuple(real), index)} if real else {}, sigma_length=length, sigmas=sigmas)
    m = INSTRUMENTS[model].predict(m, poses, lambda kind, name: places[kind.letter, name])
    frame = "unknown" if model != table.model and INSTRUMENTS[model].is_pose else table.frame
    known = {name: k for name, k in table.known.items() if name in real}
    return Table(replace(m, source=source), model, Pairing("chain"), frame, known=known, offset=table.offset)
