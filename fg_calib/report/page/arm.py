"""The arm in three dimensions: what `arm.js` turns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.report.page.run import Run
from fg_calib.report.shown import SHOWN
from fg_calib.simulation.obstacles import link_points

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
