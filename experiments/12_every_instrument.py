"""Which instrument for how many stops: one simulated UR10, measured by every instrument the package knows.

Command: python experiments/12_every_instrument.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]
Takes five minutes on one free core; the ledger's --draws 40 twice that.

The same arm (UR10-like, errors and priors of 1 mm and 1 mrad, encoders 0.002 deg) is calibrated from 10, 20, 40 and 80
stops of each instrument, with noise as such instruments have it (`WAYS`). All that the instrument does not know is
estimated: its frame, targets, anchors, offset, planes, board, sockets. Judged by the RMS error of the tool point at 200
configurations all over the workspace, after the best rigid fit (most of these instruments cannot know where the base
is): predicted by the Cramér-Rao bound, and realised over draws of errors, places, configurations and noise.

The tool point is what the instruments see of the arm: a reflector in its place, the end of bar and wire, the tip, the
camera. Reflectors elsewhere on the tool say nothing of it unless their places are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from arms import UR10
from draws import over_draws
from matplotlib.figure import Figure
from numpy.typing import NDArray
from space_robot import arguments_of, clean, write_json

import fg_calib
from fg_calib import Camera, Noise, Pairing, Robot, Scenario
from fg_calib.baseline.comparison import real_errors
from fg_calib.robot.inverse import random_readings
from fg_calib.simulation.configurations import BoardViews, Configurations, GivenReadings, Placement, RandomReadings
from fg_calib.simulation.instruments import (
    BoardCamera,
    Corners,
    Indicator,
    Instrument,
    LengthGauge,
    PairGauge,
    Sockets,
    Spot,
    Tracker,
)
from fg_calib.simulation.scenario import Errors

Floats = NDArray[np.float64]

NAME = "12_every_instrument"
MM = 1e-3
STOPS = (10, 20, 40, 80)
N_VALIDATION = 200
TOLERANCE = dict.fromkeys(("a", "d", "alpha", "theta", "beta"), 1e-3)
ENCODER = np.deg2rad(0.002)

CAMERA = Camera(fx=1200, fy=1200, cx=960, cy=600, k1=-0.05, k2=0.01)
BOARD = Placement(np.eye(3), np.array([0.6, -0.4, -0.5]))
PLATE = {f"reflector {k + 1}": Spot(xyz, 0.02 * MM) for k, xyz in enumerate(([0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]))}
CENTRES = {f"centre {k + 1}": Spot(xyz) for k, xyz in enumerate(([0.7, 0.0, 0.2], [0.0, 0.8, 0.3], [-0.5, -0.5, 0.4]))}
BAR = (0.15, 0.6)
"""Of a telescoping ball bar, shortest and longest, [m]."""

WAYS: dict[str, tuple[Instrument, Noise]] = {
    "tracker, 1 target": (Tracker(model="position", name="tracker"), Noise(position=0.03 * MM)),
    "tracker, 3 targets": (Tracker(model="position", name="tracker", targets=PLATE), Noise(position=0.03 * MM)),
    "ball bar": (LengthGauge(name="bar", anchors=CENTRES), Noise(distance=0.005 * MM)),
    "wire": (LengthGauge(name="wire", anchors=3, offset=0.15), Noise(distance=0.05 * MM)),
    "planes": (Indicator(name="probe", planes=3, contact=True), Noise(distance=0.02 * MM)),
    "board": (BoardCamera(model="board", name="board"), Noise(0.1 * MM, np.deg2rad(0.02))),
    "pixels": (
        BoardCamera(model="pixels", name="pixels", camera=CAMERA, corners=Corners(8, 6, 0.03)),
        Noise(pixel=0.1),
    ),
    "sockets": (Sockets(name="ball", sockets=4), Noise(point=0.05 * MM, distance=0.01 * MM)),
    "pairs": (PairGauge(model="distance", name="pairs"), Noise(distance=0.03 * MM)),
}

WHAT = {
    "tracker, 1 target": "reflector in the tool's place, frame unknown; 0.03 mm an axis",
    "tracker, 3 targets": "three on a plate, known to 0.02 mm, at each stop",
    "ball bar": "0.15 to 0.6 m to three unknown centres in turn; 0.005 mm",
    "wire": "to three unknown anchors in turn, offset unknown; 0.05 mm",
    "planes": "touches of three unknown faces across each other; 0.02 mm",
    "board": "camera on the tool, pose of a board at 0.3 to 0.55 m; 0.1 mm and 0.02 deg",
    "pixels": "its 48 corners instead; 0.1 px",
    "sockets": "touches of four unknown sockets; 0.05 mm, their distances 0.01 mm",
    "pairs": "distances between random pairs of stops, as many; 0.03 mm",
}

COLOURS = ("#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#009E73", "#CC79A7", "#882255", "#555555", "#117733")


class Task(NamedTuple):
    """One draw of one instrument at so many stops."""

    way: str
    stops: int
    seed: int


@cache
def robot() -> Robot:
    """A UR10-like arm with a tool of known length."""
    rows = [(a, np.deg2rad(alpha), d, 0.0, 0.0) for alpha, a, d in UR10]
    limits = [(-np.pi, np.pi)] * 6
    return Robot.from_dh(rows, convention="mdh-hayati", tool=[0.0, 0.0, 0.1], tolerance=TOLERANCE, limits=limits)


@cache
def validation() -> Floats:
    """Where the arm is judged."""
    return random_readings(robot(), N_VALIDATION, np.random.default_rng(99))


def configurations(way: str, stops: int, seed: int) -> Configurations:
    """Where an instrument measures: in the bar's reach, in sight of the board, else anywhere."""
    if way in ("board", "pixels"):
        return BoardViews(BOARD, stops - 1, height=0.4, distance=(0.3, 0.55), cone=np.deg2rad(45.0))
    if way != "ball bar":
        return RandomReadings(stops)
    drawn = random_readings(robot(), 400 * stops, np.random.default_rng([seed, 7]))
    at, chosen = fg_calib.pose(robot(), drawn).position, []
    centres = np.array([spot.xyz for spot in CENTRES.values()])
    away = np.linalg.norm(at[:, None] - centres, axis=2)
    rows = [list(np.flatnonzero((away[:, k] > BAR[0]) & (away[:, k] < BAR[1]))) for k in range(len(centres))]
    for i in range(stops):
        chosen.append(rows[i % len(rows)].pop())
    return GivenReadings(drawn[chosen])


def scenario(task: Task) -> Scenario:
    """What an instrument measures."""
    instrument, noise = WAYS[task.way]
    if isinstance(instrument, PairGauge):
        instrument = replace(instrument, pairs=Pairing("random", task.stops, task.seed))
    return Scenario(
        robot=robot(),
        errors=Errors("normal", TOLERANCE),
        configurations=configurations(task.way, task.stops, task.seed),
        noise=replace(noise, joint=ENCODER),
        instruments=(instrument,),
        job={},
    )


def one_draw(task: Task) -> dict[str, Any]:
    """Predicted and realised error of the tool point, squared, [m^2]."""
    simulation = fg_calib.simulate(scenario(task), task.seed)
    solution = fg_calib.solve(fg_calib.build_problem(simulation.robot, simulation.tables))
    n = len(simulation.robot.parameters)
    found = simulation.robot.with_values(solution.parameters[:n])
    bound = fg_calib.cramer_rao(simulation.true_robot, simulation.tables)
    errors = [real_errors(r, simulation.true_robot, validation()).fitted for r in (found, simulation.robot)]
    return {
        "predicted": bound.position(validation(), fitted=True).rms ** 2,
        "realised": errors[0].rms ** 2,
        "before": errors[1].rms ** 2,
        "rows": int(solution.problem.n_residuals),
        "converged": solution.converged,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Root mean squares over draws."""
    squares = {key: np.array([row[key] for row in rows]) for key in ("predicted", "realised", "before")}
    return {key: float(np.sqrt(v.mean())) for key, v in squares.items()} | {
        "rows": rows[0]["rows"],
        "n_draws": len(rows),
        "not_converged": sum(not row["converged"] for row in rows),
    }


def draw(found: dict[str, Any]) -> Figure:
    """Error by number of stops: predicted lines with the instrument's name beside them, realised dots."""
    figure = Figure(figsize=(8.5, 6.0), layout="constrained")
    axes = figure.subplots()
    stops = found["stops"]
    ends = {way: rows[str(stops[-1])]["predicted"] / MM for way, rows in found["ways"].items()}
    places = spread_out(ends)
    for (way, rows), colour in zip(found["ways"].items(), COLOURS, strict=True):
        each = [rows[str(n)] for n in stops]
        axes.plot(stops, [row["predicted"] / MM for row in each], "-", color=colour, lw=1.6)
        axes.plot(stops, [row["realised"] / MM for row in each], "o", color=colour, ms=5, fillstyle="none")
        axes.annotate(
            f"{way}  {ends[way]:.3f} mm", (stops[-1], ends[way]), xytext=(1.1 * stops[-1], places[way]), color=colour,
            va="center", fontsize=9, arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.5},
        )  # fmt: skip
    axes.axhline(found["before"] / MM, color="0.5", ls="--", lw=1)
    axes.text(1.1 * stops[-1], 0.97 * found["before"] / MM, "before calibration", color="0.4", va="top", fontsize=9)
    axes.set(xscale="log", yscale="log", xlabel="stops", ylabel="RMS error of the tool point after the best fit [mm]")
    axes.set_xticks(stops, [str(n) for n in stops])
    axes.minorticks_off()
    ticks = [t for t in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if 0.8 * min(ends.values()) < t]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.set_xlim(0.9 * stops[0], 2.3 * stops[-1])
    axes.set_ylim(0.8 * min(ends.values()), 1.25 * found["before"] / MM)
    axes.grid(axis="y", color="0.9")
    axes.set_title("One arm, every instrument: lines predicted, circles realised", loc="left", fontsize=11)
    clean(axes)
    return figure


def spread_out(ends: dict[str, float], factor: float = 1.13) -> dict[str, float]:
    """Heights of labels, each by a factor above the one below, as near to their lines as that allows."""
    names = sorted(ends, key=lambda name: ends[name])
    heights = np.log([ends[name] for name in names])
    step = np.log(factor)
    for _ in range(200):
        for i in range(len(heights) - 1):
            lacking = step - (heights[i + 1] - heights[i])
            if lacking > 0.0:
                heights[i] -= 0.5 * lacking
                heights[i + 1] += 0.5 * lacking
    return dict(zip(names, np.exp(heights).tolist(), strict=True))


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    given = arguments_of(__doc__, NAME, arguments, 20, 3)
    stops = STOPS[1:3] if given.quick else STOPS
    found: dict[str, Any] = {"seed": given.seed, "stops": list(stops), "ways": {}, "what": WHAT}
    print(f"{'RMS [mm], predicted / realised':32}" + "".join(f"{n:>18} stops" for n in stops))
    for way in WAYS:
        found["ways"][way] = {}
        for n in stops:
            tasks = [Task(way, n, given.seed + k) for k in range(given.draws)]
            found["ways"][way][str(n)] = summary(over_draws(one_draw, tasks, given.workers))
        rows = found["ways"][way].values()
        print(
            f"{way:32}" + "".join(f"{r['predicted'] / MM:15.4f} / {r['realised'] / MM:.4f}" for r in rows), flush=True
        )
    found["before"] = float(
        np.sqrt(np.mean([r["before"] ** 2 for rows in found["ways"].values() for r in rows.values()]))
    )
    write_json(given.file, found)
    draw(found).savefig(given.file.with_suffix(".png"), dpi=130)
    return found


if __name__ == "__main__":
    main()
