"""Distances and angles of pairs of configurations, measured, or formed from measured poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import once
from fg_calib.errors import ProblemError, escaped
from fg_calib.measurements.dataset import Pairs, are_same, form_pairs, no_pairs
from fg_calib.measurements.kinds import Distance, Kind, RotationAngle, SamePoint, stack
from fg_calib.measurements.models.poses import ANGLES
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.options import PAIR_MODELS
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

_NAMED = 5
"""Columns without a meaning that a warning names."""


def usable_pairs(table: Table) -> Pairs:
    """The pairs of a table, nan where its model does not want a measurement; every wanted one has its sigma.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    assert table.model is not None
    m, wanted = table.measurements, PAIR_MODELS[table.model]
    lacking = [columns for use, values, columns in zip(
        wanted, (m.position, m.rotation), ("x, y, z", ANGLES), strict=True) if use and values is None]  # fmt: skip
    if m.pairs is not None:
        pairs = m.pairs
    elif m.groups is not None and lacking:  # touched points suffice
        pairs = no_pairs(m.source)
    elif lacking:
        what = "measured positions" if lacking[0] == "x, y, z" else "orientations"
        raise ProblemError(m.source, f"no columns {lacking[0]}", f"{what} for model {table.model}")
    else:
        pairs = form_pairs(m, table.pairing)
    measured = np.zeros(pairs.n_pairs, dtype=np.bool_)
    for use, kind, source, values, sigma in (
        (wanted[0], "distance", "position", pairs.distance, pairs.sigma_distance),
        (wanted[1], "angle", "orientation", pairs.angle, pairs.sigma_angle),
    ):
        if use and np.any(np.isfinite(values) & ~np.isfinite(sigma)):
            noise = source if m.pairs is None else kind
            raise ProblemError(pairs.source, f"no sigma for {kind}", f"noise.{noise} or a column sigma_{noise}")
        measured |= use & np.isfinite(values)
    return pairs if measured.all() else pairs.select(measured)


def missing_figures(table: Table) -> list[str]:
    """A sentence on each figure that the model uses and no measured pair of a table has."""
    pairs = table.measurements.pairs
    if pairs is None or not pairs.n_pairs or table.model not in PAIR_MODELS:
        return []
    there = {"distance": pairs.distance, "angle": pairs.angle}
    wanted = zip(there, PAIR_MODELS[table.model], strict=True)
    return [no_figure(pairs, table.model, name) for name, use in wanted if use and np.isnan(there[name]).all()]


def no_figure(pairs: Pairs, model: str, name: str, who: str = "no pair") -> str:
    """That no pair has a figure that the model uses: its column may be misspelt."""
    article, other = {"distance": ("a", "rotation"), "angle": ("an", "distance")}[name]
    unused = f"columns {', '.join(map(escaped, pairs.unused[:_NAMED]))} are not used" if pairs.unused else ""
    asked = f"is a column misspelt ({unused})?" if unused else "is a column misspelt?"
    found = f"{pairs.source}: {who} has {article} {name}, of which model {model} makes use"
    return f"{found}; {asked} model: {other} says that there is none"


def pair_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Distances and angles of pairs; vectors of those whose distance was measured as exactly 0.

    A directly measured 0 is not a noisy number: it says that both points are one. Where both readings are the same,
    nothing changes the prediction.

    Raises:
        ProblemError: Poses to form pairs from are missing, or a sigma is.
    """
    m, pairs = table.measurements, usable_pairs(table)
    assert table.model is not None
    formed, wanted = m.pairs is None, PAIR_MODELS[table.model]
    values, sigmas = (pairs.distance, pairs.angle), (pairs.sigma_distance, pairs.sigma_angle)
    there = np.stack([np.isfinite(of) & is_wanted for of, is_wanted in zip(values, wanted, strict=True)], axis=1)
    point = there[:, 0] & (values[0] == 0.0) & (not formed)
    there[:, 0] &= ~point
    same = are_same(m.readings, pairs.a, pairs.b)

    def series(kind: Kind, rows: Integers, data: Floats, sigma: Floats, measured: Booleans) -> Series:
        return Series(
            kind=kind,
            table=number,
            ends=np.stack([pairs.a[rows], pairs.b[rows]], axis=1),
            data=data,
            sigma=sigma,
            measured=measured,
            test=pairs.test[rows],
            number=rows.astype(pairs.a.dtype),
            nuisances=np.zeros((len(rows), 0), dtype=np.int64),
            formed=formed,
            excluded={"same_configuration": same[rows]},
            source=pairs.source,
        )

    found, use = [], [k for k in (0, 1) if wanted[k]]
    rows = np.flatnonzero(there.any(axis=1))
    if len(rows):
        kind = stack(*((Distance(), RotationAngle())[k] for k in use))
        data, sigma = (np.stack([np.nan_to_num(of[k][rows]) for k in use], axis=1) for of in (values, sigmas))
        found.append(series(kind, rows, data, once(np.zeros_like(data) if formed else sigma), there[rows][:, use]))
    rows = np.flatnonzero(point)
    if len(rows):
        sigma = np.repeat(pairs.sigma_distance[rows, None], 3, axis=1)
        found.append(series(SamePoint(), rows, np.zeros((len(rows), 0)), sigma, np.ones((len(rows), 3), np.bool_)))
    return found
