"""The arm in three dimensions: what `arm.js` turns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.report.page.run import Run
from fg_calib.report.shown import SHOWN
from fg_calib.robot.model import Axis, Robot

Floats = NDArray[np.float64]

MOST = 300
"""Configurations that the page shows; of more, so many that are evenly spaced, and the worst."""

_WORST = 20


def scene(run: Run) -> dict[str, Any] | None:
    """The configurations measured, each with the arm's shape and its residual; None where they are not known.

        {"unit", "family", "low", "high", "items": [{"id", "test", "value": figure | null, "links": [[x, y, z], ...]}]}

    Links are points along the arm from the base to the tool, [m] to a tenth of a millimetre.
    """
    found, family = run.configurations, run.family
    if found is None or family is None or not len(found.ids):
        return None
    rms = found.rms[family]
    evenly = np.linspace(0, len(rms) - 1, min(MOST, len(rms))).astype(np.int64)
    worst = np.argsort(-np.nan_to_num(rms))[:_WORST]
    chosen = np.unique(np.concatenate([evenly, worst]))
    factor, unit, _ = SHOWN[run.unit(family)]
    values, links = rms[chosen] * factor, link_points(run.robot, found.readings[chosen])
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.quantile(known, [0.0, 0.98])) if len(known) else (0.0, 1.0)
    items = [
        {
            "id": found.ids[k],
            "test": bool(found.test[k]),
            "value": float(f"{value:.4g}") if np.isfinite(value) else None,
            "links": np.round(points, 4).tolist(),
        }
        for k, value, points in zip(chosen.tolist(), values, links, strict=True)
    ]
    return {"unit": unit, "family": family, "low": low, "high": high, "items": items}


def link_points(robot: Robot, readings: Floats) -> Floats:
    """Points along the arm from the base to the tool, shape (n, m, 3), [m]: where straight pieces begin and end.

    Args:
        robot: The robot.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
    """
    n, values = len(readings), robot.nominal
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    points, moved = [p.copy()], False
    for e in robot.elements:
        value = np.full(n, 0.0 if e.parameter is None else values[e.parameter])
        if e.basis is not None:
            continue  # what gravity and gears add is not seen at this size
        value = e.constant + e.sign * (value + (0.0 if e.joint is None else readings[:, e.joint]))
        if e.axis < Axis.RX:
            p = p + R[:, :, int(e.axis)] * value[:, None]
            moved = moved or bool(np.any(value != 0.0))
            continue
        if moved:
            points.append(p.copy())
            moved = False
        R = R @ _turns(int(e.axis) - 3, value)
    return np.stack([*points, p], axis=1)


def _turns(axis: int, angle: Floats) -> Floats:
    """Rotations about a coordinate axis, shape (n, 3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.tile(np.eye(3), (len(angle), 1, 1))
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i] = np.sin(angle)
    out[:, i, j] = -out[:, j, i]
    return out
