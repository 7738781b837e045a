"""The set-up of a job: some rows of its table, and what the job says of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge, Model
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

ROWS = 60
"""Train configurations that are looked at, spread over the table."""


IMAGES, CORNERS = 20, 8
"""Images that are looked at, and corners of each."""


@dataclass(frozen=True)
class Setup:
    """Some rows of a table, and what the job says of them.

    Attributes:
        robot: The nominal robot.
        measurements: The rows; pairs among them.
        model: Which measurements take part.
        frame: Whether world_T_base is fitted.
        tool_rotation: Whether the tool's rotation is.
        tool_translation: Which coordinates of the tool point are, shape (3,).
        of_base: Whether what is fitted as world_T_base is the base, which all tables share.
        table: The table itself where targets, anchors, planes or boards have to be placed; None of poses and pairs.
    """

    robot: Robot
    measurements: Measurements
    model: Model
    frame: bool
    tool_rotation: bool
    tool_translation: Booleans
    of_base: bool = False
    table: Table | None = None

    @property
    def n_free(self) -> int:
        """Unknowns of the frames."""
        return 6 * self.frame + 3 * self.tool_rotation + int(self.tool_translation.sum())


def setup_of(robot: Robot, measurements: Measurements, model: Model, frame: FrameKnowledge) -> Setup | None:
    """Some train rows of a table as the job says they are; None if the table has no train rows."""
    m = measurements
    rows = np.flatnonzero(~m.test)
    if m.groups is not None:
        rows = rows[np.argsort(m.groups.index[rows], kind="stable")]
    chosen = np.sort(rows[np.unique(np.linspace(0, len(rows) - 1, min(ROWS, len(rows))).astype(np.int64))])
    pairs = None
    if model in PAIR_MODELS and m.pairs is not None:
        train = np.flatnonzero(~m.pairs.test)
        some = m.pairs.select(train[np.unique(np.linspace(0, len(train) - 1, min(3 * ROWS, len(train))).astype(int))])
        chosen = np.unique(np.concatenate([some.a, some.b, *([] if m.groups is None else [chosen])]))
        pairs = replace(some, a=np.searchsorted(chosen, some.a), b=np.searchsorted(chosen, some.b))
    if not len(chosen):
        return None
    tool = [robot.parameters[i].estimated for i in robot.owned_by(robot.n_joints + 1)] or [False] * 6
    base = any(robot.parameters[i].estimated for i in robot.owned_by(0))
    return Setup(
        robot=robot,
        measurements=replace(_rows_of(m, chosen), pairs=pairs),
        model=model,
        frame=model in POSE_MODELS and (frame == "unknown" or base),
        tool_rotation=any(tool[3:]),
        tool_translation=np.array(tool[:3]),
        of_base=frame == "known",
    )


def has_places(measurements: Measurements, model: Model) -> bool:
    """Whether targets, anchors, planes or boards have to be placed before anything can be said of a table."""
    return model not in (*POSE_MODELS, *PAIR_MODELS) or "target" in measurements.labels


def setup_of_table(robot: Robot, table: Table) -> Setup | None:
    """Some train rows of a table with targets, anchors, planes or boards; None if there are none.

    Configurations are drawn at random, for rows in turn may be of one target or anchor.
    """
    m, rng = table.measurements, np.random.default_rng(0)
    train = np.flatnonzero(~m.test)
    if not len(train) or table.model is None:
        return None
    ids = np.unique(m.ids[train])
    most = max(10, ROWS * len(ids) // len(train)) if table.model != "pixels" else IMAGES
    rows = rng.permutation(train[np.isin(m.ids[train], rng.permutation(ids)[:most])])
    if table.model == "pixels":  # some corners of each image
        _, of = np.unique(m.ids[rows], return_inverse=True)
        order = np.argsort(of, kind="stable")
        first = np.searchsorted(of[order], np.arange(of.max() + 1))
        rows = rows[order[np.arange(len(rows)) - first[of[order]] < CORNERS]]
    setup = setup_of(robot, replace(m, pairs=None, groups=None), table.model, table.frame)
    assert setup is not None
    return replace(setup, measurements=m.select(np.sort(rows)), table=table)


def _rows_of(m: Measurements, rows: Integers) -> Measurements:
    """Some rows of a table, without its pairs."""

    def some(values: Floats | None) -> Floats | None:
        return None if values is None else values[rows]

    return replace(
        m,
        readings=m.readings[rows],
        ids=m.ids[rows],
        test=m.test[rows],
        position=some(m.position),
        rotation=some(m.rotation),
        roll_pitch_yaw=some(m.roll_pitch_yaw),
        sigma_position=some(m.sigma_position),
        sigma_orientation=some(m.sigma_orientation),
        sigma_point=some(m.sigma_point),
        pairs=None,
        groups=None if m.groups is None else replace(m.groups, index=m.groups.index[rows]),
    )
