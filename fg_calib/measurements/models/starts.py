"""Where anchors and planes are started: from the rows of all tables together, as the nominal arm has the tool there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import ProblemError
from fg_calib.initialization.landmarks import anchors_from_lengths, offset_from_lengths, plane_from_distances
from fg_calib.measurements.kinds import AnchorContact, AnchorDistance, PlaneDistance
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

WORDS = {"P": "target ", "A": "anchor ", "F": "plane ", "B": "board ", "O": ""}
"""What an unknown is that test rows alone do not say, by the letter of its key."""


def check_fitted(series: Sequence[Series], unknowns: Unknowns) -> None:
    """Raise where nothing but test rows says where something is.

    Args:
        series: All series.
        unknowns: What these depend on, as the tables say it.
    """
    fitted = np.zeros(unknowns.n_coordinates, dtype=np.bool_)
    for s in series:
        fitted[s.nuisances[~s.test]] = True
    for s in series:
        for i in np.unique(unknowns.owners[s.nuisances[~fitted[s.nuisances]]]).tolist():
            if unknowns.letters[i] in WORDS and not unknowns.is_stated(i):
                found = f"{WORDS[unknowns.letters[i]]}{unknowns.names[i]} has test rows alone"
                raise ProblemError(s.source, found, "train rows too, or its place as known")


def start_places(robot: Robot, tables: Sequence[Table], series: Sequence[Series], unknowns: Unknowns) -> None:
    """Fill in where anchors and planes are, and what instruments add to lengths, if nobody said it.

    Args:
        robot: The nominal robot.
        tables: All tables.
        series: All series.
        unknowns: What these depend on.
    """
    lengths = [s for s in series if isinstance(s.kind, AnchorDistance | AnchorContact) and not s.test.all()]
    if lengths:
        _start_anchors(robot, tables, lengths, unknowns)
    planes = [s for s in series if isinstance(s.kind, PlaneDistance) and not s.test.all()]
    if planes:
        points, distance, nuisances = map(
            np.concatenate, zip(*(_fitted(robot, tables, s) for s in planes), strict=True)
        )
        for behind, through in np.unique(nuisances[:, [0, 3]], axis=0).tolist():
            mine = nuisances[:, 0] == behind
            c, f = plane_from_distances(points[mine], distance[mine])
            unknowns.start(behind, c)
            unknowns.start(through, f)


def _start_anchors(robot: Robot, tables: Sequence[Table], series: Sequence[Series], unknowns: Unknowns) -> None:
    """What the instrument of each table adds, from its rows alone; then anchors from the lengths of all tables."""
    at = np.concatenate(unknowns.starts)
    every: list[tuple[Floats, Floats, Integers]] = []
    for s in series:
        points, length, nuisances = _fitted(robot, tables, s)
        if s.kind.n_nuisances > 3:  # contacts have no offset
            offset = nuisances[0, 3]
            if np.isnan(at[offset]):
                places, anchor = np.unique(nuisances[:, 0], return_inverse=True)
                known = at[places[:, None] + np.arange(3)]
                at[offset] = offset_from_lengths(points, length, anchor.ravel(), known)
                unknowns.start(offset, at[[offset]])
            length = length - at[offset]
        every.append((points, length, nuisances[:, 0]))
    points, length, nuisances = map(np.concatenate, zip(*every, strict=True))
    places, anchor = np.unique(nuisances, return_inverse=True)
    known = at[places[:, None] + np.arange(3)]
    found = anchors_from_lengths(points, length, anchor.ravel(), known)
    for coordinate, place in zip(places.tolist(), found, strict=True):
        unknowns.start(coordinate, place)


def _fitted(robot: Robot, tables: Sequence[Table], s: Series) -> tuple[Floats, Floats, Integers]:
    """Tool points at the nominal parameters, lengths, 0 of contacts, and nuisances of the train rows of a series."""
    train = np.flatnonzero(~s.test)
    trig = robot.trig(tables[s.table].measurements.readings)
    points = forward(build_chain(robot), trig, s.ends[train, 0]).position
    length = s.data[train, 0] if s.kind.width else np.zeros(len(train))
    return points, length, s.nuisances[train]
