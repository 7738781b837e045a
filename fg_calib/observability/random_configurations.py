"""The instruments of a problem at other configurations: what they would see that the user's configurations do not show.

Targets, anchors, planes and boards stay where they are, known or not as they are; the arm goes to random
configurations, and measures what it predicts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.graph.factors import Variables
from fg_calib.graph.problem import Problem, problem_at, start_of, variables_of
from fg_calib.measurements.build import Dataset, build_dataset
from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model, Options, Pairing
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import Poses, build_chain, forward
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Places = Mapping[tuple[str, str], Floats]

LEAST = 60
"""Random configurations of a table at least, where there are many tables."""


def elsewhere(problem: Problem, parameters: Floats) -> Problem | None:
    """The tables of a problem at random configurations, those that would say the same once.

    Points cannot be touched at random: a table of touches alone counts as one of positions in an unknown frame. Kinds
    of one's own are left out.

    Args:
        problem: The problem.
        parameters: Its parameter vector: where the arm and everything else is.

    Returns:
        A problem of the same parameters, noise assumed as `Robot.scale_of` says; None where nothing is left.
    """
    robot = problem.robot.with_values(parameters[problem.variables.robot_span])
    places = places_of(problem, parameters)
    given = [*problem.data.tables, *_before(problem)]
    different = {_says(table): table for table in given if table.model and _named(table)[1]}
    if not different:
        return None
    n = max(LEAST, -(-max(300, 10 * len(robot.parameters)) // len(different)))
    generator = np.random.default_rng(0)
    tables = [
        at_configurations(robot, table, random_readings(robot, n, generator), places, f"elsewhere {i}")
        for i, table in enumerate(different.values())
    ]
    options = Options(gauge="none", pair_errors="independent")
    data = build_dataset(robot, tables)
    variables = variables_of(robot, data, options)
    return problem_at(robot, data, options, variables, start_of(robot.with_estimated([]), data, variables))


def _before(problem: Problem) -> list[Table]:
    """Tables such as those of earlier rows, of which but the models are known: without targets, anchors or boards."""
    if problem.knowledge is None:
        return []
    q = np.zeros((1, problem.robot.n_joints))
    nothing = Measurements.from_arrays(q, position=np.zeros((1, 3)), rotation=np.eye(3)[None])
    return [
        Table(nothing, model, frame=frame)
        for model, frame in problem.knowledge.views
        if model in (*POSE_MODELS, *PAIR_MODELS)
    ]


def _says(table: Table) -> tuple[object, ...]:
    """What tables have in common that see the same at random configurations."""
    column, names = _named(table)
    return _model(table), table.frame, column, frozenset(names), table.offset


def _model(table: Table) -> Model | None:
    """The model with which a table is measured elsewhere: boards stand for pixels, whose points must be in sight."""
    m = table.measurements
    if table.model == "pixels":
        return "pose" if table.fixed_camera else "board"
    touched_alone = m.groups is not None and m.pairs is None and m.position is None
    return "position" if touched_alone and table.uses_pairs else table.model


def _named(table: Table) -> tuple[str, list[str | None]]:
    """The column that names what rows are of, and the names of the train rows; None of those that have none."""
    model = _model(table)
    column = "target" if model in POSE_MODELS else str(model)
    labels, train = table.measurements.labels.get(column), ~table.measurements.test
    if labels is None:
        return column, ["board"] if column == "board" else [None]
    return column, [labels.names[k] if k >= 0 else None for k in np.unique(labels.index[train]).tolist()]


def places_of(problem: Problem, parameters: Floats) -> dict[tuple[str, str], Floats]:
    """Where targets, anchors, planes and boards are, by letter and name, and unknown frames, as `frame_names` says."""
    unknowns, coordinates = problem.data.unknowns, problem.variables.at(parameters).coordinates
    parts = np.split(coordinates, np.cumsum(unknowns.sizes)[:-1]) if unknowns.sizes else []
    places = dict(zip(zip(unknowns.letters, unknowns.names, strict=True), parts, strict=True))
    frames = [parameters[v.places] for v in problem.variables.frames]
    return places | dict(zip(frame_names(problem.data, problem.variables), frames, strict=True))


def frame_names(data: Dataset, variables: Variables) -> list[tuple[str, str]]:
    """Letter and name of each unknown measurement frame: it is called as its table."""
    return [("X", data.labels[int(v.symbol[2:-1])]) for v in variables.frames]


def at_configurations(robot: Robot, table: Table, q: Floats, places: Places, source: str) -> Table:
    """A table of what the arm predicts at configurations, shape (n, n_joints), named things in turn.

    Args:
        robot: The arm.
        table: What instrument it is; for pixels boards are seen, or the tool from the room.
        q: The configurations.
        places: Of what the table names.
        source: What the table is called.
    """
    poses, model = forward(build_chain(robot), robot.trig(q)), _model(table)
    column, names = _named(table)
    real = [name for name in names if name is not None]
    index = np.array([real.index(name) if name is not None else -1 for name in names])[np.arange(len(q)) % len(names)]
    m = Measurements.from_arrays(
        q,
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=robot.scale_of("m"),
        sigma_orientation=robot.scale_of("rad"),
        source=source,
    )
    m = replace(m, labels={column: Labels(tuple(real), index)} if real else {}, sigma_length=m.sigma_position[:, 0])  # type: ignore[index]
    if model not in PAIR_MODELS and real:
        m = _measured(m, column, poses, places, f"offset of {table.measurements.source}")
    frame = "unknown" if model != table.model and model == "position" else table.frame
    known = {name: k for name, k in table.known.items() if name in real}
    return Table(m, model, Pairing("chain"), frame, known=known, offset=table.offset)


def _measured(m: Measurements, column: str, poses: Poses, places: Places, offset: str) -> Measurements:
    """What is measured of targets, anchors, planes or boards at their places."""
    labels = m.labels[column]
    R, p = poses.rotation, poses.position

    def of(letter: str) -> Floats:
        """Places of one letter for each row, shape (n, size)."""
        there = np.array([places[letter, name] for name in labels.names])
        return there[labels.index]

    if column == "target":
        there = np.where(labels.index[:, None] < 0, 0.0, of("P"))
        return replace(m, position=p + np.einsum("nij,nj->ni", R, there))
    if column == "anchor":
        return replace(m, length=np.linalg.norm(p - of("A"), axis=1) + float(places["O", offset][0]))
    if column == "plane":
        behind, there = of("C"), of("F")
        normal = (there - behind) / np.linalg.norm(there - behind, axis=1, keepdims=True)
        return replace(m, length=np.einsum("ni,ni->n", normal, p - there))
    there, R_T = of("B"), np.swapaxes(R, 1, 2)
    turned = R_T @ Rotation.from_rotvec(there[:, :3]).as_matrix()
    return replace(m, rotation=turned, position=np.einsum("nij,nj->ni", R_T, there[:, 3:] - p))
