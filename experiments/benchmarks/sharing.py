"""What does it cost to whiten pairs by the errors that they share, exactly?

Command: python experiments/benchmarks/sharing.py [--quick] [--seed N] [--out FOLDER]
Takes about two minutes; `--quick` some seconds.

Poses of the space robot of Jia et al. (2019), Table 2, at random configurations, 30 parameters estimated; pairs formed
as a star, a chain and at random, three for a pose, whose errors in position and orientation all pairs share; and
pairs measured directly, which share nothing. Each at a quarter of its size and at its whole. Timed after a first time:

- build: the problem with its rows judged and whitened by what is theirs alone, and whatever is kept of shared errors;
- linearise: the square root of [J r]^T [J r] with shared errors taken out, and
- cost: of the residuals alone;
- alone: linearising the same pairs without taking them out, so that ratios of linearise to it tell.

Memory is the growth of the process's peak by building, linearising and the cost, in a process of its own.

Expected: a star nearly as quick as pairs alone; a chain 14 to 17 times that; random pairs, some 130 steps of
conjugate gradients, 130 to 190 times that. Memory linear in the pairs.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import fg_calib
from fg_calib.graph.problem import Problem
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.robot.kinematics import processors
from fg_calib.robot.model import Robot
from fg_calib.threads import one_blas_thread

ROOT = Path(__file__).resolve().parents[2]
NAME = "sharing"

ROBOT = """\
name: space-robot
convention: mdh-hayati
units: {length: m, angle: deg}
fixed: [a1, alpha1, d1, theta1, beta1]
joints:
  - {a: 0, alpha: 0, d: 2.3, theta: 0, beta: 0}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0}
"""
SIGMA = (1e-3, np.deg2rad(0.01))
"""1 sigma of positions and orientations (Table 5), [m] and [rad]."""

POSES = {"star": 10_000, "chain": 10_000, "random": 10_000, "direct": 2_000_000}
PART = 10_000
"""Configurations whose poses are computed at once."""

QUICK = 50
"""By how much fewer with `--quick`."""


def robot() -> Robot:
    """The space robot."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "robot.yaml").write_text(ROBOT)
        return fg_calib.read_robot(Path(folder) / "robot.yaml")


def measured(kind: str, n: int, seed: int) -> Measurements:
    """Noisy poses, or pairs of them measured directly, two configurations of their own each."""
    rng, arm = np.random.default_rng(seed), robot()
    q = rng.uniform(-np.pi, np.pi, (n, arm.n_joints))
    # In parts: poses bring their derivatives, gigabytes for all at once, beside which no peak of ours would show.
    position, rotation = np.empty((n, 3)), np.empty((n, 3, 3))
    for start in range(0, n, PART):
        at = fg_calib.pose(arm, q[start : start + PART])
        position[start : start + PART], rotation[start : start + PART] = at.position, at.rotation
    m = Measurements(readings=q, ids=np.arange(n).astype(str), test=np.zeros(n, dtype=np.bool_), position=position,
                     rotation=rotation, sigma_position=np.full((n, 3), SIGMA[0]),
                     sigma_orientation=np.full((n, 3), SIGMA[1]), sigma_joint=np.zeros(arm.n_joints))  # fmt: skip
    if kind != "direct":
        return replace(m, position=position + SIGMA[0] * rng.normal(size=(n, 3)))
    a, b = np.arange(0, n, 2), np.arange(1, n, 2)
    distance = np.linalg.norm(position[b] - position[a], axis=1)
    cosine = 0.5 * (np.einsum("nij,nij->n", rotation[a], rotation[b]) - 1.0)
    values = distance + SIGMA[0] * rng.normal(size=len(a)), np.arccos(np.clip(cosine, -1.0, 1.0))
    stated = (np.full(len(a), s) for s in SIGMA)
    return replace(m, pairs=Pairs(a, b, *values, *stated, test=np.zeros(len(a), dtype=np.bool_)))


def build(kind: str, m: Measurements) -> Problem:
    """The problem, with everything made that linearising needs once."""
    pairing = fg_calib.Pairing("random", 3 * m.n_configurations, 0) if kind == "random" else None
    pairing = fg_calib.Pairing("chain") if kind == "chain" else pairing
    problem = fg_calib.build_problem(robot(), m, model="distance-rotation", pairing=pairing)
    cost(problem)
    return problem


def linearise(problem: Problem) -> None:
    """As the graph's factor does it."""
    for rows in problem.rows:
        rows.triangle(problem.variables.at(problem.start))


def cost(problem: Problem) -> None:
    """Of the measurements."""
    for rows in problem.rows:
        rows.squared_norm(problem.variables.at(problem.start))


def alone(problem: Problem) -> None:
    """Linearise the rows as if each had its errors to itself."""
    at = problem.variables.at(problem.start)
    for rows in problem.rows:
        for part in rows.parts:
            residuals.triangle(part.block, at.chains[part.table])


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds of one call, by the clock and of all processors."""
    clock, of_processors = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - clock, time.process_time() - of_processors


def peak_memory() -> int:
    """The process's peak resident memory so far, [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure(kind: str, n: int, seed: int, repeats: int) -> dict[str, Any]:
    """Times and memory of one case, in this process."""
    small = build(kind, measured(kind, 200, seed))  # loads what any size needs
    linearise(small)
    m = measured(kind, n, seed)
    before = peak_memory()
    with one_blas_thread:
        times = {"build": [timed(lambda: build(kind, m))]}
        problem = build(kind, m)
        linearise(problem)
        growth = peak_memory() - before
        for name, work in (("linearise", linearise), ("cost", cost), ("alone", alone)):
            times[name] = [timed(lambda work=work: work(problem)) for _ in range(repeats)]
    least = {name: [min(t[k] for t in found) for k in range(2)] for name, found in times.items()}
    return {
        "kind": kind,
        "n_poses": n,
        "n_pairs": problem.n_pairs,
        "seconds": {name: found[0] for name, found in least.items()},
        "processor_seconds": {name: found[1] for name, found in least.items()},
        "times_alone": least["linearise"][1] / least["alone"][1],
        "growth": growth,
        "growth_a_pair": growth / problem.n_pairs,
    }


def in_a_process(kind: str, n: int, seed: int, repeats: int) -> dict[str, Any]:
    """`measure` in a fresh process."""
    command = [sys.executable, __file__, "--case", kind, str(n), str(repeats), "--seed", str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def run(out: Path, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    sizes = [(kind, n // part // (QUICK if quick else 1)) for kind, n in POSES.items() for part in (4, 1)]
    results: dict[str, Any] = {
        "seed": seed,
        "quick": quick,
        "processors": processors(),
        "versions": {name: version(name) for name in ("numba", "numpy", "scipy")},
        "cases": [in_a_process(kind, n, seed, 2 if quick else 3) for kind, n in sizes],
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


def describe(results: dict[str, Any]) -> str:
    """The table for people."""
    head = (
        "kind",
        "poses",
        "pairs",
        "build",
        "linearise",
        "(processors)",
        "cost",
        "times alone",
        "MiB",
        "bytes a pair",
    )
    lines = ["seconds, least", "".join(f"{name:>13}" for name in head)]
    for case in results["cases"]:
        s, p = case["seconds"], case["processor_seconds"]
        cells = (case["kind"], case["n_poses"], case["n_pairs"], f"{s['build']:.3g}", f"{s['linearise']:.3g}",
                 f"{p['linearise']:.3g}", f"{s['cost']:.3g}", f"{case['times_alone']:.3g}",
                 f"{case['growth'] / 2**20:.1f}", f"{case['growth_a_pair']:.0f}")  # fmt: skip
        lines.append("".join(f"{cell:>13}" for cell in cells))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} times fewer poses")
    parser.add_argument("--seed", type=int, default=0, help="of configurations and noise")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    parser.add_argument("--case", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.case is not None:
        kind, n, repeats = given.case
        print(json.dumps(measure(kind, int(n), given.seed, int(repeats))))
        return 0
    print(describe(run(given.out, given.seed, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
