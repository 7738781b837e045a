"""Poses, positions and orientations of the tool, or of targets on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import ProblemError
from fg_calib.measurements.kinds import Kind, Orientation, Position, TargetPosition, stack
from fg_calib.measurements.models.common import places_of, stated
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.options import POSE_MODELS
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


ANGLES = "qx, qy, qz, qw or roll, pitch, yaw"


def pose_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Poses, or part of them, of the tool; positions of targets where a row names one.

    Raises:
        ProblemError: A column or a sigma is missing.
    """
    m = table.measurements
    labels = m.labels.get("target")
    if labels is None or not _wanted(table)[1]:
        return [_of_rows(table, number, np.arange(m.n_configurations), Position(), None)]
    place = places_of(unknowns, "P", table, labels.names)[labels.index]
    found = []
    for kind, chosen in ((Position(), labels.index < 0), (TargetPosition(), labels.index >= 0)):
        rows = np.flatnonzero(chosen)
        if len(rows):
            found.append(_of_rows(table, number, rows, kind, place[rows] if kind.n_nuisances else None))
    return found


def _wanted(table: Table) -> tuple[bool, bool]:
    """Whether orientations and positions take part."""
    assert table.model is not None
    return POSE_MODELS[table.model]


def _of_rows(table: Table, number: int, rows: Integers, position: Kind, nuisances: Integers | None) -> Series:
    """Some rows of a table, with the kind of their positions and what these depend on."""
    m = table.measurements
    parts: list[tuple[Kind, Floats, Floats]] = []
    each: tuple[tuple[Kind, Floats | None, Floats | None, str, str], ...] = (
        (Orientation(), m.rotation, m.sigma_orientation, ANGLES, "orientation"),
        (position, m.position, m.sigma_position, "x, y, z", "position"),
    )
    for wanted, (kind, values, sigma, columns, noise) in zip(_wanted(table), each, strict=True):
        if not wanted:
            continue
        if values is None:
            raise ProblemError(m.source, f"no columns {columns}", f"measured {noise}s for model {table.model}")
        parts.append((kind, values.reshape(m.n_configurations, kind.width)[rows], stated(table, sigma, noise, rows)))
    n, kind = len(rows), stack(*(kind for kind, _, _ in parts))
    return Series(
        kind=kind,
        table=number,
        ends=rows[:, None],
        data=np.ascontiguousarray(np.hstack([values for _, values, _ in parts])),
        sigma=np.hstack([sigma for _, _, sigma in parts]),
        measured=np.ones((n, kind.residual_dim), dtype=np.bool_),
        test=m.test[rows],
        number=rows,
        nuisances=np.zeros((n, 0), dtype=np.int64) if nuisances is None else nuisances,
        source=m.source,
        of=m.labels["target"].of(rows) if "target" in m.labels and _wanted(table)[1] else None,
    )
