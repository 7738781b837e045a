"""What do many jobs, and one huge table, cost on one process and on two, and a fleet of 100 000 arms on paper?

Command: python experiments/benchmarks/fleet.py [--quick] [--jobs N] [--pairs N] [--seed N] [--out FOLDER]
Takes two minutes on two cores.

- Jobs: the bundled space robot (51 pairs, 1000 test rows), drawn anew for each job and written to a folder each, as
  `fg-calib calibrate JOB ... --out DIR` does; a second on one process and on two, after their start.
- Bytes: a job and its result as they are pickled, and the result's folder.
- Dask: how long the scheduler takes for a job that does nothing (a LocalCluster of two processes).
- Parts: 10^6 pairs measured directly, in parts: seconds of a sum over them on one process and on two.
- The fleet: 10^5 of these jobs on 64 and on 1000 cores, by multiplication of what was measured.
"""

from __future__ import annotations

import argparse
import json
import logging
import pickle
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib import Measurements, cut, dask_executor, local_processes, map_jobs, reduce_parts
from fg_calib.batch import Order, calibrate_into, carry_out
from fg_calib.executors import Failure

ROOT = Path(__file__).resolve().parents[2]
NAME = "fleet"
ARMS = 100_000
CORES = (64, 1000)
MB = 1e6


def drawn_jobs(folder: Path, n: int, seed: int) -> list[Path]:
    """Jobs of the shipped scenario, each with errors, configurations and noise of its own."""
    scenario = fg_calib.read_scenario("space-robot")
    for k in range(n):
        fg_calib.write_simulation(folder / f"arm{k}", fg_calib.simulate(scenario, seed + k))
    return [folder / f"arm{k}" / "calibration.yaml" for k in range(n)]


def timed(order: Order) -> tuple[float, float]:
    """Seconds of a job where it runs, by the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    carry_out(order)
    return time.perf_counter() - clock, time.process_time() - processor


def time_jobs(jobs: Sequence[Path], out: Path, n_workers: int) -> dict[str, Any]:
    """Jobs a second on warm worker processes, and what their start took."""
    orders = [Order(job.parent.name, job, out / job.parent.name) for job in jobs]
    with local_processes(n_workers) as executor:
        clock = time.perf_counter()
        map_jobs(timed, orders[: 2 * n_workers], executor)  # imports, and loads the kernels
        start, clock = time.perf_counter() - clock, time.perf_counter()
        found = map_jobs(timed, orders, executor)
        seconds = time.perf_counter() - clock
    each, busy = [], []
    for one in found:
        if isinstance(one, Failure):
            raise one.error()
        each.append(one[0])
        busy.append(one[1])
    return {
        "workers": n_workers,
        "start_seconds": start,
        "jobs": len(jobs),
        "seconds": seconds,
        "jobs_a_second": len(jobs) / seconds,
        "seconds_a_job": statistics.median(each),
        "slowest": max(each),
        "processor_seconds_a_job": statistics.median(busy),
    }


def time_here(job: Path, out: Path, repeats: int) -> dict[str, float]:
    """Seconds of a job in this process, by the clock and of the processor; and bytes of what is sent and written."""
    calibrate_into([Order("arm", job, out)])
    clock, processor = time.perf_counter(), time.process_time()
    calibrate_into([Order("arm", job, out)] * repeats)
    seconds, busy = (time.perf_counter() - clock) / repeats, (time.process_time() - processor) / repeats
    given = fg_calib.read_job(job)
    found = fg_calib.calibrate_job(given)
    files = sum(file.stat().st_size for file in out.iterdir())
    sizes = {"job_pickled": len(pickle.dumps(given)), "result_pickled": len(pickle.dumps(found))}
    return {"seconds": seconds, "processor_seconds": busy, **sizes, "result_written": files}


def time_dask(n: int) -> float | None:
    """Seconds that a Dask scheduler takes for a job that does nothing; None without Dask."""
    try:
        from distributed import LocalCluster
    except ImportError:
        return None
    given: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with (
        LocalCluster(**given, silence_logs=logging.CRITICAL) as cluster,
        dask_executor(cluster.scheduler_address) as executor,
    ):
        map_jobs(abs, range(n // 10), executor)
        clock = time.perf_counter()
        found = map_jobs(abs, range(n), executor)
        seconds = time.perf_counter() - clock
    if any(isinstance(one, Failure) for one in found):
        raise RuntimeError(str(found[0]))
    return seconds / n


def direct_pairs(n: int, seed: int) -> tuple[fg_calib.Robot, Measurements]:
    """Pairs measured directly between configurations of the space robot, 1 sigma of 1 mm and 1 mrad."""
    rng = np.random.default_rng(seed)
    robot = fg_calib.read_job(Path(fg_calib.__file__).parent / "examples/space-robot/calibration.yaml").robot
    q = rng.uniform(-np.pi, np.pi, (max(1000, n // 100), robot.n_joints))
    at = fg_calib.pose(robot, q)
    a = rng.integers(0, len(q), n)
    b = (a + rng.integers(1, len(q), n)) % len(q)
    distance = np.linalg.norm(at.position[a] - at.position[b], axis=1) + 1e-3 * rng.normal(size=n)
    turn = Rotation.from_matrix(at.rotation[a]).inv() * Rotation.from_matrix(at.rotation[b])
    angle = np.clip(turn.magnitude() + 1e-3 * rng.normal(size=n), 0.0, np.pi)
    pairs = {"a": a, "b": b, "distance": np.abs(distance), "angle": angle}
    return robot, Measurements.from_arrays(q, pairs=pairs | {"sigma_distance": 1e-3, "sigma_angle": 1e-3})


def time_parts(n_pairs: int, seed: int) -> dict[str, Any]:
    """Seconds of the sum over parts, and bytes that go to a worker and come back."""
    robot, table = direct_pairs(n_pairs, seed)
    parts = cut(table, max(1, n_pairs // 10))
    at, found = np.append(robot.nominal, np.zeros(6)), {}
    choices: dict[str, Any] = {"model": "distance-rotation"}
    here = reduce_parts(robot, parts[:1], at, **choices)  # loads the kernels
    clock, processor = time.perf_counter(), time.process_time()
    here = reduce_parts(robot, parts, at, **choices)
    found["this process"] = time.perf_counter() - clock
    found["of the processor there"] = time.process_time() - processor
    for n in (1, 2):
        with local_processes(n) as executor:
            reduce_parts(robot, parts[: 2 * n], at, executor=executor, **choices)
            clock = time.perf_counter()
            there = reduce_parts(robot, parts, at, executor=executor, **choices)
            found[f"{n} worker{'s' * (n > 1)}"] = time.perf_counter() - clock
        if there.triangle.tobytes() != here.triangle.tobytes():
            raise RuntimeError("other bits on other processes")
    sent, back = len(pickle.dumps(parts[0])), len(pickle.dumps(here))
    return {"pairs": n_pairs, "parts": len(parts), "seconds": found, "bytes_a_part": sent, "bytes_back": back}


def fleet(here: dict[str, float], start: float, dask: float | None) -> list[dict[str, float]]:
    """What 100 000 arms take on so many cores, by what one takes.

    Args:
        here: Of one job.
        start: Seconds that a worker takes until it has done its first jobs.
        dask: Seconds of the scheduler for each job.
    """
    rows = []
    for cores in CORES:
        work = ARMS * here["processor_seconds"] / cores + start
        scheduler = ARMS * (dask or 0.0)
        rows.append(
            {
                "cores": cores,
                "core_hours": ARMS * here["processor_seconds"] / 3600.0,
                "hours": max(work, scheduler) / 3600.0,
                "scheduler_hours": scheduler / 3600.0,
                "written_GB": ARMS * here["result_written"] / 1e9,
                "pickled_to_workers_GB": ARMS * here["job_pickled"] / 1e9,
                "pickled_back_GB": ARMS * here["result_pickled"] / 1e9,
                "run_again_if_each_core_dies_once_a_day": cores * (work / 86400.0) * 2.0,
            }
        )
    return rows


def run(out: Path, quick: bool, n_jobs: int, n_pairs: int, seed: int) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    found: dict[str, Any] = {"quick": quick, "seed": seed}
    with TemporaryDirectory() as folder:
        jobs = drawn_jobs(Path(folder), n_jobs, seed)
        found["here"] = time_here(jobs[0], Path(folder) / "here", 2 if quick else 20)
        found["processes"] = [time_jobs(jobs, Path(folder) / f"out{n}", n) for n in ((2,) if quick else (1, 2))]
    found["dask_seconds_a_job"] = None if quick else time_dask(2000)
    found["parts"] = time_parts(2000 if quick else n_pairs, seed)
    start = max(row["start_seconds"] for row in found["processes"])
    found["fleet"] = fleet(found["here"], start, found["dask_seconds_a_job"])
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(found, indent=1) + "\n")
    return found


def describe(found: dict[str, Any]) -> str:
    """The tables for people."""
    h = found["here"]
    lines = [
        f"a job here: {h['seconds']:.2f} s, {h['processor_seconds']:.2f} s of the processor;"
        f" pickled {h['job_pickled'] / MB:.2f} MB there, {h['result_pickled'] / MB:.2f} MB back;"
        f" {h['result_written'] / MB:.2f} MB written"
    ]
    lines += [
        f"{row['workers']} processes: {row['jobs_a_second']:.2f} jobs a second, {row['seconds_a_job']:.2f} s a job"
        f" (slowest {row['slowest']:.2f}), start {row['start_seconds']:.1f} s,"
        f" {row['processor_seconds_a_job']:.2f} s of the processor a job"
        for row in found["processes"]
    ]
    if found["dask_seconds_a_job"] is not None:
        lines.append(f"Dask's scheduler: {found['dask_seconds_a_job'] * 1e3:.2f} ms a job")
    if found["parts"] is not None:
        p = found["parts"]
        times = ", ".join(f"{where} {seconds:.1f} s" for where, seconds in p["seconds"].items())
        sizes = f"{p['bytes_a_part'] / MB:.1f} MB there, {p['bytes_back'] / 1e3:.1f} kB back"
        lines.append(f"{p['pairs']} pairs in {p['parts']} parts: {times}; a part {sizes}")
    lines += [
        f"{ARMS} arms on {row['cores']} cores: {row['core_hours']:.1f} core hours, {row['hours']:.2f} h;"
        f" {row['written_GB']:.0f} GB written; jobs run again {row['run_again_if_each_core_dies_once_a_day']:.1f}"
        for row in found["fleet"]
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two jobs, two processes, no Dask, a small table")
    parser.add_argument("--jobs", type=int, help="instead of 60")
    parser.add_argument("--pairs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    found = run(given.out, given.quick, given.jobs or (2 if given.quick else 60), given.pairs, given.seed)
    print(describe(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
