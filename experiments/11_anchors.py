"""Do lengths to three anchors of unknown place calibrate a 6R arm as well as they can?

Command: python experiments/11_anchors.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]
Takes a minute on two free cores.

A UR10-like arm (experiment 08's, tolerances 1 mm and 1 mrad), 120 random configurations, 40 lengths to each of three
anchors that nobody knows, 0.05 mm; encoders exact, or with 0.005 deg. The kept parameters alone are estimated, without
priors, as a wire or a ball bar is used in practice. Over 200 draws of errors, anchors, configurations and noise their
errors are compared with the Cramér-Rao bound at the truth: root of the mean of e^T C^-1 e over its expectation, and the
largest and smallest RMS over bound of single parameters. Expected: within 5 %, single parameters within what 200 draws
leave (15 %).

*Finer*: lengths to 0.01 mm, as of a ball bar, with errors of the arm that are as large, or 0.3 and 0.1 times, and with
priors in place of parameters that are left at nominal. The bound is linear: what is left at nominal by 1 mm and 1 mrad
bends what is estimated by their products, 1 um, which is much beside 0.01 mm over as many lengths, and nothing once all
parameters are estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from arms import ENCODER, build_arms
from draws import over_draws
from space_robot import arguments_of, write_json

import fg_calib
from fg_calib import Noise, Scenario
from fg_calib.options import Gauge
from fg_calib.simulation.configurations import RandomReadings
from fg_calib.simulation.instruments import LengthGauge
from fg_calib.simulation.scenario import Errors

NAME = "11_anchors"
N_EACH = 40
SIGMA = 5e-5
ENCODERS = {"exact": 0.0, "noisy": ENCODER}
FINE = 1e-5
"""Of a ball bar, [m]."""
FINER: tuple[tuple[Gauge, float], ...] = (("keep", 1.0), ("keep", 0.3), ("keep", 0.1), ("prior", 1.0))
"""What holds what the lengths do not determine, and how large the arm's errors are in tolerances."""


class Task(NamedTuple):
    """One draw."""

    encoders: str
    seed: int
    sigma: float = SIGMA
    gauge: Gauge = "keep"
    errors: float = 1.0


@cache
def scenario(encoders: str, sigma: float, errors: float) -> Scenario:
    """Forty lengths to each of three anchors, drawn in and around the workspace."""
    nominal = build_arms()["UR10"].robot
    size = {p.name: errors * p.tolerance for p in nominal.parameters if p.tolerance is not None}
    parameters = tuple(replace(p, tolerance=size.get(p.name)) for p in nominal.parameters)
    return Scenario(
        robot=replace(nominal, parameters=parameters),
        errors=Errors("normal", size),
        configurations=RandomReadings(3 * N_EACH),
        noise=Noise(distance=sigma, joint=ENCODERS[encoders]),
        instruments=(LengthGauge(name="wire", anchors=3),),
        job={},
    )


def one_draw(task: Task) -> dict[str, Any]:
    """Errors of the estimated parameters beside their bound."""
    simulation = fg_calib.simulate(scenario(task.encoders, task.sigma, task.errors), task.seed)
    problem = fg_calib.build_problem(simulation.robot, simulation.tables, gauge=task.gauge)
    solution = fg_calib.solve(problem)
    kept = problem.variables.names[: problem.variables.n_robot_columns]
    prior = task.gauge == "prior"
    bound = fg_calib.cramer_rao(simulation.true_robot, simulation.tables, prior=prior, kept=None if prior else kept)
    rows = [bound.names.index(name) for name in kept]
    C = bound.covariance[np.ix_(rows, rows)]
    columns = [simulation.robot.index(name) for name in kept]
    error = solution.parameters[columns] - simulation.true_robot.nominal[columns]
    return {
        "kept": kept,
        "error": error,
        "variance": np.diag(C),
        "squared": float(error @ np.linalg.solve(C, error)),
        "converged": solution.converged,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Realised errors over the bound."""
    kept = list(rows[0]["kept"])
    same = [row for row in rows if list(row["kept"]) == kept]
    error, variance = (np.array([row[key] for row in same]) for key in ("error", "variance"))
    single = np.sqrt(np.mean(error**2, axis=0) / np.mean(variance, axis=0))
    lengths = [i for i, name in enumerate(kept) if name[0] in "ad" and not name.startswith("alpha")]
    angles = [i for i in range(len(kept)) if i not in lengths]
    count = sum(len(row["kept"]) for row in rows)
    return {
        "n_draws": len(rows),
        "not_converged": sum(not row["converged"] for row in rows),
        "kept": kept,
        "rms_over_bound": float(np.sqrt(sum(row["squared"] for row in rows) / count)),
        "sd_by_chance": float(0.5 * np.sqrt(2.0 / count)),
        "single": {"from": float(single.min()), "to": float(single.max()), "draws": len(same)},
        "rms_mm": float(1e3 * np.sqrt(np.mean(error[:, lengths] ** 2))),
        "rms_mrad": float(1e3 * np.sqrt(np.mean(error[:, angles] ** 2))),
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    given = arguments_of(__doc__, NAME, arguments, 200, 5)
    found: dict[str, Any] = {"seed": given.seed, "n_lengths": 3 * N_EACH, "sigma": SIGMA, "encoders": {}}
    print(f"{'encoders':8} kept  RMS/bound (sd by chance)  single parameters     mm    mrad  not converged")
    for encoders in ENCODERS:
        tasks = [Task(encoders, given.seed + k) for k in range(given.draws)]
        row = summary(over_draws(one_draw, tasks, given.workers))
        found["encoders"][encoders] = row
        print(
            f"{encoders:8} {len(row['kept']):4d} {row['rms_over_bound']:10.3f} ({row['sd_by_chance']:.3f})"
            f" {row['single']['from']:16.2f} to {row['single']['to']:.2f}"
            f" {row['rms_mm']:12.4f} {row['rms_mrad']:7.4f} {row['not_converged']:6d}",
            flush=True,
        )
    found["finer"] = []
    for gauge, errors in FINER:
        tasks = [Task("exact", given.seed + k, FINE, gauge, errors) for k in range(max(given.draws // 2, 2))]
        row = summary(over_draws(one_draw, tasks, given.workers))
        keys = ("n_draws", "not_converged", "rms_over_bound", "sd_by_chance")
        found["finer"].append({"gauge": gauge, "errors": errors, "sigma": FINE} | {key: row[key] for key in keys})
        print(f"finer, {gauge:5}, errors times {errors:<4g} {row['rms_over_bound']:.3f} ({row['sd_by_chance']:.3f})")
    write_json(given.file, found)
    return found


if __name__ == "__main__":
    main()
