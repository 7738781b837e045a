"""Is the error that `predict` expects the error that calibrated arms have?

Command: python experiments/17_predict.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]

200 arms of the paper's scenario `space-robot` (distances and angles of a star of pairs near the board, predicted all
over the workspace) and 200 of a UR10 (40 poses in an unknown frame, or in the base frame) are drawn within their
tolerances, measured with noise of the instrument and of the joint readings, and calibrated. At 2000 fixed random
configurations the true errors of the calibrated arm are set against the expected ones: root mean square over draws and
configurations, all together, cell by cell of horizontal slices and of height over distance from the axis, and at the
configuration that `predict` finds to be the worst. After the best rigid fit (of the points that were measured, by
singular value decomposition, in this script) and in the base frame; with errors of joint readings added and without.

About 4 minutes of processor time with 200 draws. Expected: ratios of 1 within what 200 draws tell.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from arms import build_arms
from draws import over_draws
from matplotlib.figure import Figure
from numpy.typing import NDArray
from space_robot import arguments_of, clean, paper_scenario, write_json

import fg_calib
from fg_calib import Noise, Robot, Scenario, pose
from fg_calib.prediction.prediction import predict_errors
from fg_calib.prediction.tool_pose import ToolErrorModel
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import Poses
from fg_calib.simulation.configurations import RandomReadings
from fg_calib.simulation.instruments import Tracker
from fg_calib.simulation.scenario import Errors
from fg_calib.statistics.covariance import spread_of

Floats = NDArray[np.float64]

NAME = "17_predict"
CASES = ("space-robot", "UR10, unknown frame", "UR10, base frame")
SPAN = 5
"""Cells along each side of a slice."""
LEAST = 15
"""Configurations in a cell that is looked at."""
N_AT = 2000


class Task(NamedTuple):
    """One draw of a case."""

    case: str
    seed: int
    n_at: int


@cache
def scenario_of(case: str) -> Scenario:
    """What is simulated."""
    if case == "space-robot":
        return paper_scenario()
    arm = build_arms()["UR10"]
    return Scenario(
        robot=arm.robot,
        errors=Errors("normal", {p.name: p.tolerance for p in arm.robot.parameters if p.tolerance is not None}),
        configurations=RandomReadings(40),
        noise=Noise(position=arm.sigma[0], orientation=arm.sigma[1], joint=tuple(arm.sigma_joint)),
        instruments=(Tracker(name="tracker", model="pose", frame="unknown" if "unknown" in case else "base"),),
        job={},
    )


@cache
def places(case: str, n: int) -> tuple[Floats, dict[str, NDArray[np.int64]]]:
    """Fixed configurations, and the cell of each slice that each is in, -1 for none."""
    robot = scenario_of(case).robot
    q = random_readings(robot, n, np.random.default_rng(17))
    p = pose(robot, q).position
    low, high = p.min(axis=0), p.max(axis=0)
    side = np.clip(((p - low) / (high - low) * SPAN).astype(int), 0, SPAN - 1)
    r = np.hypot(p[:, 0], p[:, 1])
    around = np.clip((r / r.max() * SPAN).astype(int), 0, SPAN - 1)
    cells = {"r-z": around * SPAN + side[:, 2]}
    for k, height in enumerate(np.quantile(p[:, 2], (0.2, 0.5, 0.8)), start=1):
        inside = np.abs(p[:, 2] - height) < 0.06 * float((high - low).max())
        cells[f"x-y {k}"] = np.where(inside, side[:, 0] * SPAN + side[:, 1], -1)
    return q, cells


def motion_between(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Rotation and shift that bring points a nearest to points b."""
    U, _, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return R, b.mean(axis=0) - R @ a.mean(axis=0)


def errors_between(estimated: Poses, true: Poses, R: Floats, t: Floats) -> Floats:
    """Position and orientation errors of poses that were moved, shape (n, 2)."""
    off = estimated.position @ R.T + t - true.position
    turn = np.einsum("ij,njk,nlk->nil", R, estimated.rotation, true.rotation)
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return np.column_stack([np.linalg.norm(off, axis=1), np.arccos(cosine)])


def one_draw(task: Task) -> dict[str, Any]:
    """True and expected errors of one calibrated arm."""
    scenario = scenario_of(task.case)
    drawn = fg_calib.simulate(scenario, task.seed)
    solution = fg_calib.solve(fg_calib.build_problem(scenario.robot, drawn.tables))
    problem = solution.problem
    estimate: Robot = scenario.robot.with_values(solution.parameters[problem.variables.robot_span])
    measured = problem.data.readings[~problem.data.held_out]
    sigma = problem.sigma_joint
    model = ToolErrorModel.of(spread_of(solution), measured, sigma if np.any(sigma > 0.0) else None)
    q, _ = places(task.case, task.n_at)
    fit = motion_between(pose(estimate, measured).position, pose(drawn.true_robot, measured).position)
    noise = np.random.default_rng([task.seed, 5]).normal(size=q.shape) * sigma
    found: dict[str, Any] = {"converged": solution.converged}
    expected, here = model.at(q), pose(estimate, q)
    for frame, (R, t) in {"base": (np.eye(3), np.zeros(3)), "fitted": fit}.items():
        of_both = expected.of(frame == "fitted")
        found[frame] = {
            "true": errors_between(here, pose(drawn.true_robot, q), R, t) ** 2,
            "expected": of_both**2,
            "true with joints": errors_between(here, pose(drawn.true_robot, q + noise), R, t) ** 2,
            "expected with joints": of_both**2 + (0.0 if expected.joint_noise is None else expected.joint_noise**2),
        }
        worst = predict_errors(estimate, model, measured, fitted=frame == "fitted").worst
        assert worst is not None
        at = worst.errors.readings
        off = errors_between(pose(estimate, at), pose(drawn.true_robot, at), R, t)
        found[frame]["worst"] = [float(off[0, 0] ** 2), float(worst.errors.of(frame == "fitted")[0, 0] ** 2)]
    return found


def ratio(true: Floats, expected: Floats) -> tuple[float, float]:
    """RMS error over the expected one, and 1 sigma of it by the scatter between draws, of sums a draw."""
    value = float(np.sqrt(true.sum() / expected.sum()))
    scatter = np.std(true - value**2 * expected) / np.sqrt(len(true)) / expected.mean()
    return value, float(scatter / (2.0 * value))


def summary(case: str, rows: Sequence[dict[str, Any]], n_at: int) -> dict[str, Any]:
    """Ratios of one case."""
    _, cells = places(case, n_at)
    found: dict[str, Any] = {"n_draws": len(rows), "not_converged": sum(not row["converged"] for row in rows)}
    for frame in ("fitted", "base"):
        true, expected, with_joints, both = (
            np.array([row[frame][key] for row in rows])  # (draws, configurations, 2)
            for key in ("true", "expected", "true with joints", "expected with joints")
        )
        of_cells = []
        for name, cell in cells.items():
            for k in range(SPAN**2):
                inside = cell == k
                if inside.sum() >= LEAST:
                    value = ratio(true[:, inside, 0].sum(axis=1), expected[:, inside, 0].sum(axis=1))
                    of_cells.append(
                        {"slice": name, "cell": k, "n": int(inside.sum()), "ratio": value[0], "sigma": value[1]}
                    )
        worst = np.array([row[frame]["worst"] for row in rows])
        found[frame] = {
            "expected_rms": [float(np.sqrt(expected[:, :, k].mean())) for k in (0, 1)],
            "position": ratio(true[:, :, 0].sum(axis=1), expected[:, :, 0].sum(axis=1)),
            "orientation": ratio(true[:, :, 1].sum(axis=1), expected[:, :, 1].sum(axis=1)),
            "position with joint noise": ratio(with_joints[:, :, 0].sum(axis=1), both[:, :, 0].sum(axis=1)),
            "worst": ratio(worst[:, 0], worst[:, 1]),
            "worst_expected": float(np.sqrt(worst[:, 1].mean())),
            "cells": of_cells,
        }
    return found


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    given = arguments_of(__doc__, NAME, arguments, 200, 2)
    n_at = 300 if given.quick else N_AT
    clock = time.perf_counter()
    found: dict[str, Any] = {"seed": given.seed, "cases": {}}
    for case in CASES:
        tasks = [Task(case, seed, n_at) for seed in range(given.seed, given.seed + given.draws)]
        found["cases"][case] = summary(case, over_draws(one_draw, tasks, given.workers), n_at)
        found["seconds"] = time.perf_counter() - clock
        write_json(given.file, found)
    if not given.quick:
        picture(found).savefig(given.file.with_suffix(".png"), dpi=120)
    report(found)
    return found


def picture(found: dict[str, Any]) -> Figure:
    """Ratios cell by cell with 1 sigma, case by case."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    for axes, (case, of_case) in zip(figure.subplots(1, len(CASES), sharey=True), found["cases"].items(), strict=True):
        frame = "base" if "base" in case else "fitted"
        cells = sorted(of_case[frame]["cells"], key=lambda cell: cell["ratio"])
        axes.axhspan(0.9, 1.1, color="0.92", zorder=0)
        axes.axhline(1.0, color="0.6", linewidth=0.8)
        values, sigma = ([cell[key] for cell in cells] for key in ("ratio", "sigma"))
        axes.errorbar(range(len(cells)), values, yerr=sigma, fmt="o", markersize=3, linewidth=0.8, color="tab:blue")
        axes.set(title=f"{case}: all {of_case[frame]['position'][0]:.3f}", xlabel="cell of a slice, in order")
        clean(axes)
    figure.axes[0].set_ylabel("true over expected RMS position error, 1 sigma")
    figure.suptitle("Errors of calibrated arms over those that predict expects, cell by cell of its slices")
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the table."""
    for case, of_case in found["cases"].items():
        print(f"{case}: {of_case['n_draws']} draws, {of_case['not_converged']} did not converge")
        for frame in ("fitted", "base"):
            f = of_case[frame]
            cells = np.array([[cell["ratio"], (cell["ratio"] - 1.0) / cell["sigma"]] for cell in f["cells"]])
            figures = ", ".join(
                f"{key} {f[key][0]:.3f} ± {f[key][1]:.3f}"
                for key in ("position", "orientation", "position with joint noise", "worst")
            )
            size, worst = f["expected_rms"][0] * 1e3, f["worst_expected"] * 1e3
            print(f"  {frame:6} {size:.3f} mm expected (worst {worst:.3f}): {figures}")
            if len(cells):
                print(
                    f"         {len(cells)} cells from {cells[:, 0].min():.3f} to {cells[:, 0].max():.3f},"
                    f" {np.abs(cells[:, 1]).max():.1f} sigma at most from 1"
                )
    print(f"{found['seconds']:.0f} s")


if __name__ == "__main__":
    main()
