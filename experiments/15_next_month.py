"""Next month: is what `check` and `update` say of a calibration true?

Command: python experiments/15_next_month.py [--quick] [--seed N] [--draws N] [--workers N] [--out FOLDER]
Takes about half an hour of processor time.

A UR10-like arm (experiment 08's, tolerances 1 mm and 1 mrad), calibrated by 40 poses (0.05 mm, 0.1 mrad), or by 6
(*weak*); new rows are 8 poses, or 3 (*small*), a tracker that was moved has an unknown frame. Each draw has its own
truth, configurations and noise.

- Healthy arms: p-values of `check`, by a Kolmogorov-Smirnov test and their share below 0.05; how many pass.
- One joint's zero slips by 1, 3, 10 and 30 of the sigma with which the new rows show it: how often `check` fails, how
  often the true joint is among the changes it calls likely, how often it is the only one, how often another is.
- `update` once and three times: NEES of all parameters by the posterior, which is 1; and how far estimates are from
  those of a calibration of all rows at once, in sigma, for noise from that of the instrument down to a thousandth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from arms import Arm, build_arms
from draws import over_draws
from scipy import stats
from scipy.spatial.transform import Rotation
from space_robot import arguments_of, write_json

import fg_calib
from fg_calib import Calibration, Measurements, Robot, Table

NAME = "15_next_month"
SIGMA = (5e-5, 1e-4)
HEALTHY = ("known", "unknown", "unknown small", "unknown weak", "pairs", "pairs weak")
SLIPS = (1.0, 3.0, 10.0, 30.0)
FINER = (1.0, 0.1, 0.01, 0.001)


class Task(NamedTuple):
    """One draw."""

    case: str
    seed: int
    slip: float = 0.0
    finer: float = 1.0


def arm() -> Arm:
    """The arm."""
    return build_arms()["UR10"]


def measured(robot: Robot, q: Any, rng: np.random.Generator, case: str, name: str, finer: float = 1.0) -> Table:
    """Poses in a frame of their own."""
    at = fg_calib.pose(robot, q)
    unknown, n = "unknown" in case, len(q)
    turn = Rotation.from_rotvec(0.3 * rng.normal(size=3) * unknown)
    noise = Rotation.from_rotvec(finer * SIGMA[1] * rng.normal(size=(n, 3)))
    position = turn.apply(at.position) + rng.normal(size=3) * unknown + finer * SIGMA[0] * rng.normal(size=(n, 3))
    quaternion = (turn * Rotation.from_matrix(at.rotation) * noise).as_quat()
    rows = Measurements.from_arrays(
        q,
        position=position,
        quaternion=quaternion,
        sigma_position=finer * SIGMA[0],
        sigma_orientation=finer * SIGMA[1],
        ids=[f"{name}{i}" for i in range(n)],
    )
    model = "distance-rotation" if "pairs" in case else "pose"
    return Table(rows, model, frame="unknown" if unknown else "known")


def calibrated(task: Task) -> tuple[Calibration, Robot, Table, np.random.Generator]:
    """A calibration, the true arm and the rows of the calibration."""
    rng, given = np.random.default_rng(task.seed), arm().scaled(1.0, task.finer)
    true = given.true_robot(rng)
    q = given.readings(6 if "weak" in task.case else 40, rng)
    old = measured(true, q, rng, task.case, "old", task.finer)
    return fg_calib.calibrate(given.robot, old), true, old, rng


def healthy(task: Task) -> dict[str, Any] | None:
    """What a check says of an arm that is as it was."""
    found, true, _, rng = calibrated(task)
    if not found.trustworthy:
        return None
    check = found.check(measured(true, arm().readings(3 if "small" in task.case else 8, rng), rng, task.case, "new"))
    return {"p": check.p_value, "verdict": check.verdict, "explained": bool(check.explanations)}


def slipped(task: Task) -> dict[str, Any] | None:
    """What a check says of an arm of which one joint's zero has slipped."""
    found, true, _, rng = calibrated(task)
    if not found.trustworthy:
        return None
    joint, q = int(rng.integers(2, 7)), arm().readings(8, rng)
    name, state = f"theta{joint}", rng.bit_generator.state

    def check(by: float) -> Any:
        rng.bit_generator.state = state
        values = true.nominal.copy()
        values[true.index(name)] += by
        return found.check(measured(true.with_values(values), q, rng, task.case, "new"))

    far = next((e for e in check(0.02).explanations if name in (*e.parameters, *e.same)), None)
    if far is None or far.sigma[0] is None:
        return None
    said = check(task.slip * far.sigma[0] * (1.0 if joint % 2 else -1.0))
    likely = [e for e in said.explanations if e.likely]
    there = any(name in (*e.parameters, *e.same) for e in likely)
    return {
        "failed": said.verdict == "fail",
        "explained": bool(likely),
        "among": there,
        "alone": there and len(likely) == 1,
        "wrong": bool(likely) and not there,
        "deployed": said.verdict == "fail" and said.deploy,
        "n": len(likely),
    }


def nees(calibration: Calibration, true: Robot) -> float:
    """Squared errors by the posterior, over their number."""
    names = list(calibration.result.covariance.names)
    error = np.array([calibration.parameters[n].estimate - true.nominal[true.index(n)] for n in names])
    C = calibration.covariance(names)
    scale = 1.0 / np.sqrt(np.diag(C))
    return float((error * scale) @ np.linalg.solve(C * np.outer(scale, scale), error * scale) / len(names))


def updated(task: Task) -> dict[str, Any] | None:
    """Errors of updates, and how far they are from a calibration of all rows."""
    found, true, old, rng = calibrated(task)
    tables, out = [old], {"nees": [nees(found, true)], "off": [], "of_sigma": []}
    if not found.trustworthy:
        return None
    for k in range(3):
        tables.append(measured(true, arm().readings(8, rng), rng, task.case, f"new{k}", task.finer))
        found = found.update(tables[-1])
        out["nees"].append(nees(found, true))
        if k in (0, 2):
            batch = fg_calib.calibrate(arm().scaled(1.0, task.finer).robot, tables)
            both = [(found.parameters[n], batch.parameters[n]) for n in batch.result.covariance.names]
            out["off"].append(max(abs(a.estimate - b.estimate) / b.sigma for a, b in both))
            out["of_sigma"].append(max(abs(a.sigma / b.sigma - 1.0) for a, b in both))
    return out


def of_healthy(rows: Sequence[dict[str, Any] | None]) -> dict[str, Any]:
    """Shares over draws."""
    there = [row for row in rows if row is not None]
    p = np.array([row["p"] for row in there])
    return {
        "n": len(p),
        "ks_p_value": float(stats.kstest(p, "uniform").pvalue) if len(p) else None,
        "below_0.05": float(np.mean(p < 0.05)),
        "verdicts": dict(Counter(row["verdict"] for row in there)),
        "explained": sum(row["explained"] for row in there),
    }


def of_slips(rows: Sequence[dict[str, Any] | None]) -> dict[str, Any]:
    """Counts over draws."""
    there = [row for row in rows if row is not None]
    keys = ("failed", "explained", "among", "alone", "wrong", "deployed")
    return {"n": len(there)} | {key: int(sum(row[key] for row in there)) for key in keys}


def of_updates(rows: Sequence[dict[str, Any] | None]) -> dict[str, Any]:
    """Means and largest values over draws."""
    there = [row for row in rows if row is not None]
    values = np.array([row["nees"] for row in there])
    return {
        "n": len(there),
        "nees": [float(v) for v in values.mean(axis=0)],
        "nees_sd_by_chance": float(values.std() / np.sqrt(len(there))),
        "off": [float(v) for v in np.max([row["off"] for row in there], axis=0)],
        "of_sigma": [float(v) for v in np.max([row["of_sigma"] for row in there], axis=0)],
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    given = arguments_of(__doc__, NAME, arguments, 80, 1)
    seeds = [given.seed + k for k in range(given.draws)]
    found: dict[str, Any] = {"seed": given.seed, "healthy": {}, "slips": {}, "updates": {}}
    for case in HEALTHY:
        found["healthy"][case] = of_healthy(over_draws(healthy, [Task(case, s) for s in seeds], given.workers))
        print("healthy", case, found["healthy"][case], flush=True)
    for case in ("known", "unknown"):
        for slip in SLIPS:
            tasks = [Task(case, s, slip) for s in seeds]
            found["slips"][f"{case} {slip:g}"] = of_slips(over_draws(slipped, tasks, given.workers))
            print("slip", case, slip, found["slips"][f"{case} {slip:g}"], flush=True)
    for case in ("known", "unknown", "pairs", "unknown weak"):
        for finer in FINER if case == "unknown" else FINER[:1]:
            few = seeds[: max(len(seeds) // (2 if finer == 1.0 else 10), 1)]
            tasks = [Task(case, s, finer=finer) for s in few]
            found["updates"][f"{case} {finer:g}"] = of_updates(over_draws(updated, tasks, given.workers))
            print("update", case, finer, found["updates"][f"{case} {finer:g}"], flush=True)
    write_json(given.file, found)
    return found


if __name__ == "__main__":
    main()
