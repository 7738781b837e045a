"""How long does a whole calibration take, from the shell and in process?

Command: python experiments/benchmarks/calibrate.py [--quick] [--out FOLDER] [--before FOLDER]
Takes about 20 s; the first run on a machine compiles the kernels, which takes some more and is not counted. Nothing
here is random, so there is no seed.

- `fg-calib calibrate` on the bundled space robot (51 pairs), a new process each time, median of 5: 2.5 to 3 s;
- `fg-calib --help` in the same way: 0.2 to 0.3 s;
- in process, on the same job: building the problem, 2 ms; solving it, with covariance and identifiability, 30 to 50 ms;
- the same of 60 poses of a UR10, frame and tool known, in processor time, and of the whole `calibrate()`;
- with another checkout's root as `--before`, the same process of that one, in turn with ours, and the ratio of both.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import fg_calib

ROOT = Path(__file__).resolve().parents[2]
NAME = "calibrate"
JOB = Path(fg_calib.__file__).parent / "examples" / "space-robot" / "calibration.yaml"


def in_a_process(*arguments: str, root: Path = ROOT) -> tuple[float, float]:
    """Seconds of one run of a checkout's command line, from start to exit: by the clock, and of processors.

    Raises:
        RuntimeError: It did not end with 0.
    """
    before, clock = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-P", "-m", "fg_calib.cli", *arguments]  # -P: the package that is timed here too
    env = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=env)
    seconds, after = time.perf_counter() - clock, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        raise RuntimeError(f"fg-calib {arguments[0]} ended with {done.returncode}: {done.stderr.strip()}")
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


MDH = [
    [0, 0, 0.1273, 0],
    [0, np.pi / 2, 0, 0],
    [-0.612, 0, 0, 0],
    [-0.5723, 0, 0.163941, 0],
    [0, np.pi / 2, 0.1157, 0],
    [0, -np.pi / 2, 0.0922, 0],
]
"""a, alpha, d, theta of a UR10, [m] and [rad]."""


def ur10_poses(n: int = 60) -> tuple[fg_calib.Robot, fg_calib.Measurements]:
    """A UR10 off by 1 mm and 2 mrad, measured with 0.1 mm and 0.1 mrad."""
    tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
    robot = fg_calib.Robot.from_dh(MDH, convention="mdh", tool=[0.05, 0.03, 0.1], tolerance=tolerance)
    rng = np.random.default_rng(0)
    off = np.array([(p.tolerance or 0.0) * p.estimated for p in robot.parameters]) * rng.normal(size=len(robot.nominal))
    q = rng.uniform(-np.pi, np.pi, (n, 6))
    at, noise = fg_calib.pose(robot.with_values(robot.nominal + off), q), 1e-4 * rng.normal(size=(2, n, 3))
    rotation = at.rotation @ Rotation.from_rotvec(noise[1]).as_matrix()
    figures = {"position": at.position + noise[0], "sigma_position": 1e-4, "sigma_orientation": 1e-4}
    return robot, fg_calib.Measurements.from_arrays(q, rotation=rotation, **figures)


def of_poses(repeats: int) -> dict[str, Any]:
    """Processor seconds of each step of 60 poses, and of all that `calibrate` does."""
    robot, m = ur10_poses()
    clocks: list[list[float]] = []
    for _ in range(repeats + 1):
        clock = [time.process_time()]
        problem = fg_calib.build_problem(robot, m, model="pose", frame="known")  # anew: linearised rows are remembered
        clock.append(time.process_time())
        solution = fg_calib.solve(problem)
        clock.append(time.process_time())
        fg_calib.assess(solution)
        clock.append(time.process_time())
        fg_calib.calibrate(robot, m, model="pose", frame="known")
        clocks.append([*clock, time.process_time()])
    seconds = np.diff(clocks[1:], axis=1).T.tolist()  # the first compiles, or reads kernels
    return {step: summary(s) for step, s in zip(("build", "solve", "assess", "calibrate()"), seconds, strict=True)}


def timed(work: Callable[[], object]) -> float:
    """Seconds of one call."""
    clock = time.perf_counter()
    work()
    return time.perf_counter() - clock


def summary(seconds: list[float]) -> dict[str, Any]:
    return {"median": median(seconds), "min": min(seconds), "max": max(seconds), "repeats": len(seconds)}


def run(out: Path, quick: bool = False, other: Path | None = None) -> dict[str, Any]:
    """The benchmark, beside another checkout if one is given; writes the numbers into `out`."""
    job = fg_calib.read_job(JOB)

    def build() -> fg_calib.Problem:
        return fg_calib.problem_of(job)

    problem = build()
    fg_calib.assess(fg_calib.solve(problem))  # compiles, or reads the compiled kernels
    repeats, n_processes = (5, 1) if quick else (51, 5)
    building, solving, assessing = [], [], []
    for _ in range(repeats):
        building.append(timed(build))
        problem = build()  # linearised rows are remembered
        clock = time.perf_counter()
        solution = fg_calib.solve(problem)
        solving.append(time.perf_counter() - clock)
        assessing.append(timed(lambda solution=solution: fg_calib.assess(solution)))
    with TemporaryDirectory() as folder:
        command = ("calibrate", str(JOB), "--out", folder)
        roots = [ROOT] if other is None else [ROOT, other]
        found: dict[Path, list[tuple[float, float]]] = {root: [] for root in roots}
        for root in roots:
            in_a_process(*command, root=root)  # the system's file cache, and the kernels
        helping = []
        for _ in range(n_processes):
            for root in roots:
                found[root].append(in_a_process(*command, root=root))
            helping.append(in_a_process("--help")[0])
        calibrating, of_processors = (list(seconds) for seconds in zip(*found[ROOT], strict=True))
    results = {
        "quick": quick,
        "n_pairs": solution.problem.n_pairs,
        "n_parameters": solution.problem.variables.n_columns,
        "iterations": solution.iterations,
        "seconds": {
            "fg-calib calibrate": summary(calibrating),
            "its processor time": summary(of_processors),
            "fg-calib --help": summary(helping),
            "build_problem": summary(building),
            "solve": summary(solving),
            "assess": summary(assessing),
            "solve and assess": summary([s + a for s, a in zip(solving, assessing, strict=True)]),
            **{f"60 poses: {step}": seconds for step, seconds in of_poses(repeats).items()},
        },
    }
    if other is not None:
        least = {root: [min(seconds) for seconds in zip(*found[root], strict=True)] for root in roots}
        clock, processors = (before / now for now, before in zip(least[ROOT], least[other], strict=True))
        results["before over now, least"] = {"clock": clock, "processors": processors}
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


def describe(results: dict[str, Any]) -> str:
    """The table for people."""
    lines = [
        f"{results['n_pairs']} pairs, {results['n_parameters']} parameters, {results['iterations']} iterations",
        f"{'milliseconds':24}{'median':>10}{'min':>10}{'max':>10}{'runs':>6}",
    ]
    for what, s in results["seconds"].items():
        cells = "".join(f"{s[key] * 1e3:10.1f}" for key in ("median", "min", "max"))
        lines.append(f"{what:24}{cells}{s['repeats']:6}")
    if ratios := results.get("before over now, least"):
        lines.append(f"before over now, least of each: {ratios['clock']:.2f}, of processors {ratios['processors']:.2f}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one process each, few repeats")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    parser.add_argument("--before", type=Path, help="another checkout's root, to compare with")
    given = parser.parse_args(arguments)
    print(describe(run(given.out, given.quick, given.before)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
