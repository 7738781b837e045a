"""Is `tolerance: estimate` as good as knowing how far an arm is off, and never worse than no priors at all?

Command: python experiments/16_unknown_tolerances.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]

Four arms (UR10 in dh-hayati and as a URDF, the 7R of the paper, a SCARA) are measured as poses in an unknown frame, by
distances and angles of a star of pairs, or by lengths to three unknown anchors, at 10 or 100 stops. The true errors are
0.1, 0.3, 1, 3 and 10 times the tolerances stated, all kinds alike, or each kind one of these at random (`mixed`). Each
draw is calibrated with the scales estimated, with the true ones (`known`), with the tolerances as stated, and without
priors. Compared are the RMS errors of the tool's position over 200 other configurations, after the best rigid fit;
NEES of the parameters over their number (median); how often true scales lie in their 95 % intervals.

Takes hours with 60 draws of all 66 cells on a shared machine; what stands in `results/` is of fewer, as it says.
Expected: within 4 % of knowing the scales, and no worse than no priors, where rows determine all directions that errors
of that size show in; 10 to 30 % where there are fewer rows than parameters.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from arms import build_arms
from draws import over_draws
from matplotlib.figure import Figure
from numpy.typing import NDArray
from space_robot import arguments_of, clean, write_json

import fg_calib
from fg_calib import Noise, ProblemError, Robot, Scenario
from fg_calib.baseline.comparison import real_errors
from fg_calib.graph.solver import Solution
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.model import Joint, RobotBuilder, tolerance_kind
from fg_calib.simulation.configurations import RandomReadings
from fg_calib.simulation.instruments import LengthGauge, Tracker
from fg_calib.simulation.scenario import Errors
from fg_calib.statistics.covariance import spread_of, with_unsure_tolerances

Floats = NDArray[np.float64]

NAME = "16_unknown_tolerances"
SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
TRUE = (*map(str, SCALES), "mixed")
ESTIMATORS = ("estimated", "known", "stated", "none")
INSTRUMENTS = {
    "pose": Tracker(name="tracker", model="pose", frame="unknown"),
    "pairs": Tracker(name="pairs", model="distance-rotation"),
    "anchors": LengthGauge(name="wire", anchors=3),
}
NOISE = Noise(position=1e-4, orientation=np.deg2rad(0.01), distance=5e-5)
CELLS = (
    *(("UR10", "pose", 10), ("UR10", "pairs", 10), ("UR10", "pairs", 100), ("UR10", "anchors", 10)),
    *(("UR10", "anchors", 100), ("7R", "pairs", 10), ("7R", "pose", 100)),
    *(("URDF", "pose", 10), ("URDF", "anchors", 100), ("SCARA", "pose", 10), ("SCARA", "pairs", 100)),
)
"""Arm, model and number of stops; of anchors as many lengths to each of three."""
MARKS = {"none": ("tab:red", "x"), "stated": ("tab:orange", "s"), "estimated": ("tab:blue", "o")}
WORDS = {"none": "without priors", "stated": "tolerances as stated", "estimated": "tolerances estimated"}
MOST_SHOWN = 5.0
UR10_DH = [(0, 90, 0.1273), (-0.612, 0, 0), (-0.5723, 0, 0), (0, 90, 0.163941), (0, -90, 0.1157), (0, 0, 0.0922)]
"""a [m], alpha [deg], d [m] of each joint, standard DH."""
UR10_URDF = [
    *(((0, 0, 0.1273), (0, 0, 0)), ((0, 0.220941, 0), (0, 90, 0)), ((0, -0.1719, 0.612), (0, 0, 0))),
    *(((0, 0, 0.5723), (0, 90, 0)), ((0, 0.1149, 0), (0, 0, 0)), ((0, 0, 0.1157), (0, 0, 0))),
]
"""x, y, z [m] and roll, pitch, yaw [deg] of each joint's origin; axes are z y y y z y."""


class Task(NamedTuple):
    """One draw of a cell."""

    arm: str
    model: str
    n: int
    true: str
    seed: int


@cache
def robots() -> Mapping[str, Robot]:
    """The arms, with the tolerances stated."""
    arms = build_arms()
    dh, urdf = RobotBuilder("UR10", "dh-hayati"), RobotBuilder("UR10", "urdf")
    for i, (a, alpha, d) in enumerate(UR10_DH):
        values = {"a": a, "alpha": np.deg2rad(alpha), "d": d, "theta": 0.0, "beta": 0.0}
        dh.add_convention_joint(Joint(f"q{i + 1}", lower=-np.pi, upper=np.pi), values)
    for i, ((xyz, rpy), axis) in enumerate(zip(UR10_URDF, "zyyyzy", strict=True)):
        values = dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), (*xyz, *np.deg2rad(rpy)), strict=True))
        urdf.add_urdf_joint(Joint(f"q{i + 1}", lower=-np.pi, upper=np.pi), values, np.eye(3)["xyz".index(axis)])
    for builder in (dh, urdf):
        builder.add_frame("tool", {}, 7, False)
    of_dh = dict.fromkeys(("a", "alpha", "d", "theta", "beta"), 1e-3)
    of_urdf = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 1e-3)
    return {
        "UR10": dh.build(tolerance=of_dh),
        "URDF": urdf.build(tolerance=of_urdf),
        "7R": Robot.from_dh(
            [[p.nominal for p in joint_of(arms["space robot"].robot, i)] for i in range(7)],
            "mdh-hayati",
            tolerance=of_dh,
        ),
        "SCARA": arms["SCARA"].robot,
    }


def joint_of(robot: Robot, joint: int) -> list[Any]:
    """A joint's parameters in the order of `Robot.from_dh`."""
    by_kind = {robot.parameters[i].kind: robot.parameters[i] for i in robot.owned_by(joint + 1)}
    return [by_kind[kind] for kind in ("a", "alpha", "d", "theta", "beta")]


def true_scales(robot: Robot, true: str, rng: np.random.Generator) -> dict[str, float]:
    """The true scale of each kind."""
    kinds = list(dict.fromkeys(tolerance_kind(p) or "" for p in robot.parameters if p.tolerance is not None))
    chosen = rng.choice(SCALES, len(kinds)) if true == "mixed" else np.full(len(kinds), float(true))
    return dict(zip(kinds, chosen.tolist(), strict=True))


def scaled(robot: Robot, scale: Mapping[str, float]) -> Robot:
    """The robot with its tolerances multiplied kind by kind."""
    parameters = tuple(
        p if p.tolerance is None else replace(p, tolerance=p.tolerance * scale[tolerance_kind(p) or ""])
        for p in robot.parameters
    )
    return replace(robot, parameters=parameters)


def one_draw(task: Task) -> dict[str, Any]:
    """Errors and NEES of each estimator, and the scales found."""
    rng = np.random.default_rng([task.seed, *"".join(map(str, task[:4])).encode()])
    robot = robots()[task.arm]
    scale = true_scales(robot, task.true, rng)
    known = scaled(robot, scale)
    scenario = Scenario(
        robot=robot,
        errors=Errors("normal", {p.name: p.tolerance for p in known.parameters if p.tolerance is not None}),
        configurations=RandomReadings((3 if task.model == "anchors" else 1) * task.n),
        noise=NOISE,
        instruments=(INSTRUMENTS[task.model],),
        job={},
    )
    drawn = fg_calib.simulate(scenario, int(rng.integers(2**40)))
    readings = random_readings(robot, 200, rng)
    found: dict[str, Any] = {"task": task._asdict(), "true": scale}
    for name in ESTIMATORS:
        clock = time.perf_counter()
        solution = calibrated(name, known if name == "known" else robot, drawn.tables)
        if solution is None:
            continue
        seconds = time.perf_counter() - clock
        estimate = robot.with_values(solution.parameters[solution.problem.variables.robot_span])
        error = real_errors(estimate, drawn.true_robot, readings).fitted
        assert error is not None
        found[name] = {"rms": error.rms, "converged": solution.converged, "seconds": seconds}
        if name != "none":
            found[name] |= consistency(solution, drawn.true_robot)
    return found


def calibrated(name: str, robot: Robot, tables: Any) -> Solution | None:
    """The solution by one estimator; None where there are too few rows without priors."""
    gauge, by = "none" if name == "none" else "prior", "kind" if name == "estimated" else None
    try:
        problem = fg_calib.build_problem(robot, tables, gauge=gauge, estimate_tolerance=by)
    except ProblemError:
        return None
    return fg_calib.estimate_tolerances(problem)


def consistency(solution: Solution, true: Robot) -> dict[str, Any]:
    """NEES over its number of parameters, share of parameters in their 95 % intervals, and the scales."""
    v = solution.problem.variables
    C = with_unsure_tolerances(solution, spread_of(solution)).named()
    columns = [true.index(name) for name in v.names[: v.n_robot_columns]]
    e = solution.parameters[columns] - true.nominal[columns]
    sigma = np.sqrt(np.diag(C))
    nees = (e / sigma) @ np.linalg.solve(C / np.outer(sigma, sigma), e / sigma) / len(e)
    found: dict[str, Any] = {"nees": float(nees), "covered": float(np.mean(np.abs(e) < 1.96 * sigma))}
    found_scales = solution.estimated_tolerances
    if found_scales is not None:
        found["scales"] = {one.group: [one.scale, one.low, one.high, one.seen] for one in found_scales.scales}
    return found


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    given = arguments_of(__doc__, NAME, arguments, 60, 1)
    cells = CELLS[:2] if given.quick else CELLS
    tasks = [
        Task(*cell, true, seed)
        for cell in cells
        for true in (TRUE[-1:] if given.quick else TRUE)
        for seed in range(given.seed, given.seed + given.draws)
    ]
    clock = time.perf_counter()
    rows = over_draws(one_draw, tasks, given.workers)
    found: dict[str, Any] = {"cells": [], "seed": given.seed}
    for first in range(0, len(rows), given.draws):
        found["cells"].append(summary(rows[first : first + given.draws]))
    found["seconds"] = time.perf_counter() - clock
    write_json(given.file, found)
    if not given.quick:
        picture(found).savefig(given.file.with_suffix(".png"), dpi=120)
    report(found)
    return found


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Ratios of errors, consistency and coverage of one cell."""
    rms = {
        name: float(np.sqrt(np.mean([row[name]["rms"] ** 2 for row in rows])))
        for name in ESTIMATORS
        if all(name in row for row in rows)
    }
    scales = [(row["true"][name], *of) for row in rows for name, of in row["estimated"]["scales"].items()]
    true, scale, low, high, _ = np.array(scales).T
    cell = {key: value for key, value in rows[0]["task"].items() if key != "seed"}
    return cell | {
        "n_draws": len(rows),
        "rms": rms,
        "over_known": rms["estimated"] / rms["known"],
        "over_none": rms["estimated"] / rms["none"] if "none" in rms else None,
        "stated_over_known": rms["stated"] / rms["known"],
        "nees": {name: float(np.median([row[name]["nees"] for row in rows])) for name in ESTIMATORS[:3]},
        "covered": {name: float(np.mean([row[name]["covered"] for row in rows])) for name in ESTIMATORS[:3]},
        "scales_covered": float(np.mean((low <= true) & (true <= high))),
        "log_scale_error": {"mean": float(np.mean(np.log(scale / true))), "sd": float(np.std(np.log(scale / true)))},
        "not_converged": {name: sum(not row[name]["converged"] for row in rows if name in row) for name in ESTIMATORS},
        "seconds": {name: float(np.median([row[name]["seconds"] for row in rows])) for name in rms},
    }


def picture(found: dict[str, Any]) -> Figure:
    """Errors over those of who knows the scales: estimated, as stated, and without priors, cell by cell."""
    cells = list(dict.fromkeys((c["arm"], c["model"], c["n"]) for c in found["cells"]))
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    panels = figure.subplots(1, len(TRUE), sharey=True)
    for axes, true in zip(panels, TRUE, strict=True):
        for y, cell in enumerate(cells):
            there = [c["rms"] for c in found["cells"] if (c["arm"], c["model"], c["n"], c["true"]) == (*cell, true)]
            rms = there[0] if there else {}
            for name, (colour, mark) in MARKS.items():
                if name in rms:
                    axes.plot(min(rms[name] / rms["known"], MOST_SHOWN), y, mark, color=colour, ms=8)
        axes.axvspan(0.9, 1.1, color="0.92", zorder=0)
        axes.set_xscale("log")
        axes.set(xlim=(0.85, MOST_SHOWN * 1.1), title=true if true == "mixed" else f"{true} times")
        axes.set_xticks([1, 2, 4], ["1", "2", "4"])
        axes.minorticks_off()
        clean(axes)
    panels[0].set_yticks(range(len(cells)), [f"{arm}, {model}, {n} stops" for arm, model, n in cells])
    panels[0].invert_yaxis()
    for name, (colour, mark) in MARKS.items():
        panels[-1].plot([], [], mark, color=colour, ms=8, label=WORDS[name])
    figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(
        "Tool error, over that of who knows how far the arm is off. True errors over the tolerances stated:"
    )
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{found['cells'][0]['n_draws']} draws a cell, {found['seconds']:.0f} s; RMS tool error, ratios")
    print(f"{'':34} est/known  est/none  stated/known  NEES/n (known)  covered  scales covered  log error  not conv.")
    for c in found["cells"]:
        cell = f"{c['arm']}, {c['model']}, {c['n']} stops, {c['true']}"
        none = "-" if c["over_none"] is None else f"{c['over_none']:.3f}"
        nees, off = c["nees"], c["log_scale_error"]
        print(
            f"{cell:34} {c['over_known']:9.3f} {none:>9} {c['stated_over_known']:13.2f}"
            f" {nees['estimated']:8.2f} ({nees['known']:.2f}) {c['covered']['estimated']:8.3f}"
            f" {c['scales_covered']:15.3f} {off['mean']:+6.2f}±{off['sd']:.2f} {sum(c['not_converged'].values()):6d}"
        )


if __name__ == "__main__":
    main()
