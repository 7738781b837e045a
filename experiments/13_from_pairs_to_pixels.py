"""The paper's camera and board: what do poses, and the board's corners themselves, gain over pairs?

Command: python experiments/13_from_pairs_to_pixels.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]
Takes four minutes on one free core.

The paper's scenario (52 views of a board, encoders 0.005 deg), tolerances as priors, three calibrations of the same arm
at the same views:

- pairs: distance and rotation of a star of the measured poses (1 mm, 0.01 deg), the paper's way;
- board: the same poses as a camera has them, along its own axes; where the board is is estimated too;
- pixels: images of 8 by 6 corners, 30 mm apart, with 0.5 px of a camera of 1200 px focal length.

Judged by the RMS of the tool point's error at 500 configurations over +-180 degrees in the base frame and after the
best rigid fit, and over 52 new views of the same board after the best rigid fit; each beside its Cramér-Rao bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from draws import over_draws
from space_robot import MM, arguments_of, paper_scenario, write_json

import fg_calib
from fg_calib import Camera, Noise, Robot, Scenario
from fg_calib.baseline.comparison import real_errors
from fg_calib.simulation.instruments import BoardCamera, Corners, Instrument, Tracker

NAME = "13_from_pairs_to_pixels"
CAMERA = Camera(fx=1200, fy=1200, cx=960, cy=600)
WAYS: dict[str, Instrument] = {
    "pairs": Tracker(model="distance-rotation", name="pairs"),
    "board": BoardCamera(model="board", name="board"),
    "pixels": BoardCamera(model="pixels", name="pixels", camera=CAMERA, corners=Corners(8, 6, 0.03),
                          noise=Noise(pixel=0.5)),
}  # fmt: skip
WHERE = ("base", "fitted", "views")


class Task(NamedTuple):
    """One draw of one way."""

    way: str
    seed: int


@cache
def scenario(way: str) -> Scenario:
    """The paper's, measured in one way."""
    return replace(paper_scenario("unknown"), instruments=(WAYS[way],), job={}, validation=None)


@cache
def places(seed: int) -> dict[str, Any]:
    """Validation configurations of a draw: anywhere, and new views of the board."""
    anywhere = fg_calib.simulate(paper_scenario(), seed)
    views = fg_calib.simulate(replace(paper_scenario(), validation=None), 100_000 + seed)
    return {
        "anywhere": anywhere.measurements.readings[anywhere.measurements.test],
        "views": views.measurements.readings,
    }


def errors(estimated: Robot, true: Robot, seed: int) -> dict[str, float]:
    """Squared errors of the tool point, [m^2]."""
    at = places(seed)
    anywhere, views = (real_errors(estimated, true, at[key]) for key in ("anywhere", "views"))
    assert anywhere.fitted is not None
    assert views.fitted is not None
    return {"base": anywhere.base.rms**2, "fitted": anywhere.fitted.rms**2, "views": views.fitted.rms**2}


def one_draw(task: Task) -> dict[str, Any]:
    """Realised and predicted squares."""
    simulation = fg_calib.simulate(scenario(task.way), task.seed)
    solution = fg_calib.solve(fg_calib.build_problem(simulation.robot, simulation.tables))
    found = simulation.robot.with_values(solution.parameters[: len(simulation.robot.parameters)])
    bound, at = fg_calib.cramer_rao(simulation.true_robot, simulation.tables), places(task.seed)
    predicted = {
        "base": bound.position(at["anywhere"]).rms ** 2,
        "fitted": bound.position(at["anywhere"], fitted=True).rms ** 2,
        "views": bound.position(at["views"], fitted=True).rms ** 2,
    }
    return {
        "realised": errors(found, simulation.true_robot, task.seed),
        "predicted": predicted,
        "before": errors(simulation.robot, simulation.true_robot, task.seed),
        "converged": solution.converged,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Root mean squares over draws, [m]."""
    found: dict[str, Any] = {
        key: {where: float(np.sqrt(np.mean([row[key][where] for row in rows]))) for where in WHERE}
        for key in ("before", "realised", "predicted")
    }
    return found | {"n_draws": len(rows), "not_converged": sum(not row["converged"] for row in rows)}


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    given = arguments_of(__doc__, NAME, arguments, 200, 3)
    found: dict[str, Any] = {"seed": given.seed, "ways": {}}
    print("RMS [mm], realised / bound  over +-180 deg, base       after rigid fit     new views, fitted  not converged")
    for way in WAYS:
        tasks = [Task(way, given.seed + k) for k in range(given.draws)]
        row = found["ways"][way] = summary(over_draws(one_draw, tasks, given.workers))
        figures = [f"{row['realised'][w] / MM:12.3f} / {row['predicted'][w] / MM:.3f}" for w in WHERE]
        print(f"{way:24}" + "  ".join(figures) + f" {row['not_converged']:8d}", flush=True)
        write_json(given.file, found)
    return found


if __name__ == "__main__":
    main()
