"""What a calibration costs: processor time of its steps, of a process, and of a million pairs with their memory.

    python experiments/speed.py [--quick] [--only QUESTION ...]

| question | what |
|---|---|
| steps | build, solve and assess 60 poses of a UR10 and the bundled example, warm, in this process; the report page |
| process | `fg-calib calibrate` of the bundled example and `fg-calib --help`, as new processes |
| pairs | `fg-calib calibrate` of a million directly measured pairs from Parquet and CSV: seconds and peak memory |
| linearise | the Gram matrix of distance and rotation angle in 35 parameters, per pair |

Set FG_CALIB_BEFORE to the root of another checkout and `process` and `pairs` run that one in turn and give ratios.

Traps: times are of one machine; read ratios. The first run on a machine compiles the kernels and is not counted. Linux
counts a process's processor time to the tick only while a timer of processor time runs: none is used here.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl
from common import HERE, Question, Row, Task, run
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib import Measurements, Robot, assess, build_problem, calibrate_job, read_job, read_robot, solve
from fg_calib.report.html import build_page
from fg_calib.robot import pose

ROOT = HERE.parent
EXAMPLE = Path(fg_calib.__file__).parent / "examples" / "space-robot"
MDH = [(0, 0, 0.1273, 0), (0, np.pi / 2, 0, 0), (-0.612, 0, 0, 0), (-0.5723, 0, 0.163941, 0),
       (0, np.pi / 2, 0.1157, 0), (0, -np.pi / 2, 0.0922, 0)]  # fmt: skip
"""a, alpha, d, theta of a UR10, [m] and [rad]."""

_COMMAND = """
import atexit, sys
from pathlib import Path
peak = Path(sys.argv.pop(1))
def write():
    lines = Path("/proc/self/status").read_text().splitlines()
    peak.write_text(next(line.split()[1] for line in lines if "VmHWM" in line))
atexit.register(write)
from fg_calib.cli import main
main()
"""
"""`fg-calib` in a process that writes its peak memory, [kB]."""


def median_of(work: Callable[[], object], repeats: int) -> float:
    """Median processor time of a call after one that is not counted, [s]."""
    work()
    seconds = []
    for _ in range(repeats):
        clock = time.process_time()
        work()
        seconds.append(time.process_time() - clock)
    return median(seconds)


def steps(task: Task) -> Row:
    """Processor time of each step, [s]."""
    case, repeats = task
    if case == "60 UR10 poses":
        tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
        robot = Robot.from_dh(MDH, convention="mdh", tool=[0.05, 0.03, 0.1], tolerance=tolerance)
        rng = np.random.default_rng(0)
        off = np.array([(p.tolerance or 0.0) * p.estimated for p in robot.parameters]) * rng.normal(
            size=len(robot.nominal)
        )
        q = rng.uniform(-np.pi, np.pi, (60, 6))
        at, noise = pose(robot.with_values(robot.nominal + off), q), 1e-4 * rng.normal(size=(2, 60, 3))
        rotation = at.rotation @ Rotation.from_rotvec(noise[1]).as_matrix()
        rows = Measurements.from_arrays(
            q, position=at.position + noise[0], rotation=rotation, sigma_position=1e-4, sigma_orientation=1e-4
        )

        def build() -> fg_calib.Problem:
            return build_problem(robot, rows, model="pose", frame="known")
    else:
        job = read_job(EXAMPLE / "calibration.yaml")

        def build() -> fg_calib.Problem:
            return build_problem(job.robot, job.tables, job.options)

    problem = build()
    solution = solve(problem)
    row = {
        "build": median_of(build, repeats),
        "solve": median_of(lambda: solve(build()), repeats) - median_of(build, repeats),
        "assess": median_of(lambda: assess(solution), repeats),
    }
    if case != "60 UR10 poses":
        found = calibrate_job(job)
        row["page"] = median_of(lambda: build_page(found.report_data), max(repeats // 5, 1))
    return row


def steps_answer(found: Row) -> str:
    """Milliseconds of each step."""
    return "; ".join(
        f"{case}: " + ", ".join(f"{step} {1e3 * s:.0f} ms" for step, s in row.items()) for case, row in found.items()
    )


def command(*arguments: str, root: Path = ROOT) -> Row:
    """Seconds by the clock and of processors, and peak memory [MiB], of one `fg-calib` of a checkout.

    Raises:
        RuntimeError: It ended with another code than 0.
    """
    with TemporaryDirectory() as folder:
        peak = Path(folder) / "peak"
        before, clock = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-P", "-c", _COMMAND, str(peak), *arguments],
            capture_output=True, text=True, check=False,
            env=os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": ""},
        )  # fmt: skip
        seconds, after = time.perf_counter() - clock, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            raise RuntimeError(f"fg-calib {arguments[0]} ended with {done.returncode}: {done.stderr.strip()}")
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return {"seconds": seconds, "processors": used, "MiB": int(peak.read_text()) / 1024.0}


def both(*arguments: str, repeats: int) -> Row:
    """Medians of a command of this checkout, and the ratio of the other one's times if there is one."""
    other = os.environ.get("FG_CALIB_BEFORE")
    roots = [ROOT] if other is None else [ROOT, Path(other)]
    runs: dict[Path, list[Row]] = {root: [] for root in roots}
    for k in range(repeats + 1):
        for root in roots:
            found = command(*arguments, root=root)
            if k or repeats == 0:
                runs[root].append(found)
    row: Row = {key: median(found[key] for found in runs[ROOT]) for key in runs[ROOT][0]}
    if other is not None:
        for key in ("seconds", "processors", "MiB"):
            row[f"before over now, {key}"] = median(f[key] for f in runs[roots[1]]) / row[key]
    return row


def process(task: Task) -> Row:
    """One command as a process."""
    what, repeats = task
    if what == "--help":
        return both("--help", repeats=repeats)
    with TemporaryDirectory() as folder:
        return both("calibrate", str(EXAMPLE / "calibration.yaml"), "--out", str(Path(folder) / "out"), repeats=repeats)


def costs_answer(found: Row) -> str:
    """Seconds and memory of each case."""
    parts = []
    for case, row in found.items():
        ratios = [f"{key} {value:.2f}" for key, value in row.items() if key.startswith("before")]
        parts.append(
            f"{case}: {row['seconds']:.2f} s, {row['MiB']:.0f} MiB" + (f" ({', '.join(ratios)})" if ratios else "")
        )
    return "; ".join(parts)


def write_pairs(folder: Path, n: int, ending: str) -> Path:
    """Write a job of `n` directly measured pairs of a hundredth as many configurations."""
    rng, sigma = np.random.default_rng(0), 1e-3
    nominal = read_robot(EXAMPLE / "robot_nominal.yaml")
    tolerance = np.array([p.tolerance or 0.0 for p in nominal.parameters])
    robot = nominal.with_values(nominal.nominal + 0.5 * tolerance * rng.normal(size=len(tolerance)))
    q = rng.uniform(-np.pi, np.pi, (max(50, n // 100), robot.n_joints))
    at = pose(robot, q)
    a = rng.integers(0, len(q), n)
    b = (a + rng.integers(1, len(q), n)) % len(q)
    distance = np.linalg.norm(at.position[a] - at.position[b], axis=1) + sigma * rng.normal(size=n)
    turn = Rotation.from_matrix(at.rotation[a]).inv() * Rotation.from_matrix(at.rotation[b])
    angle = np.abs(turn.magnitude() + sigma * rng.normal(size=n))
    tables = {
        "q": pl.DataFrame({f"q{k + 1}": q[:, k] for k in range(q.shape[1])}),
        "pairs": pl.DataFrame({"a": a, "b": b, "distance": distance, "angle": np.minimum(angle, 2 * np.pi - angle)}),
    }
    for name, frame in tables.items():
        (frame.write_parquet if ending == "parquet" else frame.write_csv)(folder / f"{name}.{ending}")
    (folder / "robot.yaml").write_bytes((EXAMPLE / "robot_nominal.yaml").read_bytes())
    job = folder / "job.yaml"
    job.write_text(
        f"robot: robot.yaml\nunits: {{length: m, angle: rad}}\nmeasurements: q.{ending}\npairs: pairs.{ending}\n"
        f"model: distance-rotation\nnoise: {{distance: {sigma}, angle: {sigma}}}\n"
    )
    return job


def pairs(task: Task) -> Row:
    """One calibration of many pairs as a process."""
    ending, n = task
    with TemporaryDirectory() as name:
        job = write_pairs(Path(name), n, ending)
        return both("calibrate", str(job), "--out", str(Path(name) / "out"), repeats=0)


def linearise(task: Task) -> Row:
    """Processor time of a linearisation of many pairs, by the difference of two numbers of pairs, per pair [us]."""
    (n,) = task
    with TemporaryDirectory() as name:
        job = read_job(write_pairs(Path(name), n, "parquet"))
    problem = build_problem(job.robot, job.tables, job.options)
    places = (problem.start * (1.0 + 1e-9 * k) for k in count())  # the system of a place is remembered
    seconds = min(median_of(lambda: problem.linearize(next(places)), 1) for _ in range(3))
    return {"us a pair": 1e6 * seconds / n}


def by_first(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by the task's first entry."""
    return {str(task[0]): row for task, row in zip(tasks, rows, strict=True)}


QUESTIONS = (
    Question("steps", "What do the steps of a calibration cost?",
             lambda n, s: [("60 UR10 poses", n), ("bundled example", n)], steps, by_first, steps_answer, (21, 3),
             timed=True),
    Question("process", "What does a calibration cost as a process?",
             lambda n, s: [("bundled example", n), ("--help", n)], process, by_first, costs_answer, (5, 1), timed=True),
    Question("pairs", "What do a million pairs cost?", lambda n, s: [("parquet", n), ("csv", n)], pairs, by_first,
             costs_answer, (1_000_000, 5_000), timed=True),
    Question("linearise", "What does a linearisation cost?", lambda n, s: [(n,)], linearise, by_first,
             lambda found: ", ".join(f"{row['us a pair']:.2f} us a pair of {n}" for n, row in found.items()),
             (200_000, 5_000), timed=True),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
