"""What does `fg-calib calibrate` of a million pairs cost, as a process, and how do its parts grow?

Command: python experiments/benchmarks/million.py [--quick] [--pairs N] [--poses N] [--most N] [--before FOLDER]
Takes some four minutes on two cores; the first run on a machine compiles the kernels, which is not counted.

- Tables: pairs of configurations of the space robot, distance and angle measured directly (1 mm, 1 mrad), a hundredth
  as many configurations as pairs; and poses in an unknown frame, with joint noise. Both are written here, to a
  temporary folder, as Parquet and CSV.
- The command: seconds by the clock and of processors, and peak memory of the process by its own account (`VmHWM`);
  with another checkout's root as `--before`, the same of that one, in turn with ours.
- Parts: the command with `--parts 200000`: one Parquet file of the pairs, of which so many are read at a time; with
  `--most` also more of them.
- Growth: seconds of processors of a linearisation against pairs, joints (three arms) and estimated parameters; and of
  a whole calibration in this process against pairs and configurations; the exponent of a power law through each.
- Roofline: floating-point operations that a pair takes, counted from the kernel's loops; what this machine's matrix
  product does a second on one core, and how many bytes it copies.
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
from inspect import getsource
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.graph.variables import build_variables
from fg_calib.measurements import residuals
from fg_calib.measurements.kinds import stack
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.measurements.residuals import Block
from fg_calib.threads import one_blas_thread

sys.path.insert(0, str(Path(__file__).parent))
import linearise

ROOT = Path(__file__).resolve().parents[2]
NAME = "million"
EXAMPLE = Path(fg_calib.__file__).parent / "examples" / "space-robot"
MIB = 2.0**20

SIGMA = 1e-3
"""1 sigma of distances [m], angles [rad], positions [m] and orientations [rad]."""

PART = 200_000
"""Pairs of a part, and of a group of rows of the file."""

WARM = 101_000
"""Pairs of the first calibration, which is not counted: enough that all kernels are compiled in it."""

SIGMA_JOINT = 1e-5
"""1 sigma of joint readings where poses are measured, [rad]."""

Floats = NDArray[np.float64]


def true_robot(rng: np.random.Generator) -> fg_calib.Robot:
    """The example's arm, off nominal by half a tolerance."""
    robot = fg_calib.read_job(EXAMPLE / "calibration.yaml").robot
    tolerance = np.array([p.tolerance or 0.0 for p in robot.parameters])
    return robot.with_values(robot.nominal + 0.5 * tolerance * rng.normal(size=len(tolerance)))


def write_pairs(
    folder: Path, n: int, seed: int, n_configurations: int = 0, formats: Sequence[str] = ("parquet", "csv")
) -> None:
    """A table of `n` pairs, of a hundredth as many configurations unless said, and a job of it in each format."""
    rng = np.random.default_rng(seed)
    robot = true_robot(rng)
    q = rng.uniform(-np.pi, np.pi, (n_configurations or max(50, n // 100), robot.n_joints))
    at = fg_calib.pose(robot, q)
    a = rng.integers(0, len(q), n)
    b = (a + rng.integers(1, len(q), n)) % len(q)
    distance = np.linalg.norm(at.position[a] - at.position[b], axis=1) + SIGMA * rng.normal(size=n)
    turn = Rotation.from_matrix(at.rotation[a]).inv() * Rotation.from_matrix(at.rotation[b])
    angle = np.abs(turn.magnitude() + SIGMA * rng.normal(size=n))
    pairs = {"a": a, "b": b, "distance": np.abs(distance), "angle": np.minimum(angle, 2.0 * np.pi - angle)}
    tables = {"q": {f"q{k + 1}": q[:, k] for k in range(q.shape[1])}, "pairs": pairs}
    job = "measurements: q.{0}\npairs: pairs.{0}\nmodel: distance-rotation\nnoise: {{distance: {1}, angle: {1}}}\n"
    _write(folder, tables, job, formats)


def write_poses(folder: Path, n: int, seed: int) -> None:
    """A table of `n` full poses in an unknown frame, and a job of it in either format."""
    rng = np.random.default_rng(seed)
    robot = true_robot(rng)
    q = rng.uniform(-np.pi, np.pi, (n, robot.n_joints))
    at = fg_calib.pose(robot, q + SIGMA_JOINT * rng.normal(size=q.shape))
    world = Rotation.from_rotvec([0.3, -0.2, 0.9])
    p = world.apply(at.position) + [1.0, 2.0, 0.5] + SIGMA * rng.normal(size=(n, 3))
    turned = world * Rotation.from_matrix(at.rotation) * Rotation.from_rotvec(SIGMA * rng.normal(size=(n, 3)))
    x, y, z, w = turned.as_quat().T
    poses = {f"q{k + 1}": q[:, k] for k in range(q.shape[1])} | dict(zip("xyz", p.T, strict=True))
    job = (
        "measurements: poses.{0}\nmodel: pose\nframe: unknown\n"
        f"noise: {{{{position: {{1}}, orientation: {{1}}, joint: {SIGMA_JOINT}}}}}\n"
    )
    _write(folder, {"poses": poses | {"qx": x, "qy": y, "qz": z, "qw": w}}, job)


_COMMAND = """
import atexit, resource, sys
from pathlib import Path
peak = Path(sys.argv.pop(1))
{peak_of_this}
atexit.register(lambda: peak.write_text(str(_peak_of_this())))
from fg_calib.cli import main
main()
"""
"""What a process does that is told where to write its peak memory: `fg-calib`."""


def _peak_of_this() -> float:
    """Bytes that this process took at most; on Linux `ru_maxrss` starts at that of the process that started it."""
    status = Path("/proc/self/status")
    if status.exists():
        return next(1024.0 * float(line.split()[1]) for line in status.read_text().splitlines() if "VmHWM" in line)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def in_parts(n: int, seed: int) -> dict[str, float]:
    """What the command takes with so many pairs of 10 000 configurations in one file, read in parts."""
    with TemporaryDirectory() as name:
        folder = Path(name) / "pairs"
        write_pairs(folder, n, seed, 10_000, ("parquet",))
        return {"pairs": n, **command(folder / "parquet.yaml", "--parts", str(PART))}


def _write(
    folder: Path, tables: dict[str, dict[str, Any]], job: str, formats: Sequence[str] = ("parquet", "csv")
) -> None:
    folder.mkdir(parents=True)
    (folder / "robot.yaml").write_bytes((EXAMPLE / "robot_nominal.yaml").read_bytes())
    for name, columns in tables.items():
        frame = pl.DataFrame(columns)
        frame.write_parquet(folder / f"{name}.parquet", row_group_size=PART)
        if "csv" in formats:
            frame.write_csv(folder / f"{name}.csv")
    for ending in formats:
        head = "robot: robot.yaml\nunits: {length: m, angle: rad}\n"
        (folder / f"{ending}.yaml").write_text(head + job.format(ending, SIGMA))


def command(job: Path, *options: str, root: Path = ROOT) -> dict[str, float]:
    """Seconds by the clock and of processors, and peak memory, of one run of a checkout's command line.

    Raises:
        RuntimeError: It did not end with 0.
    """
    with TemporaryDirectory() as folder:
        peak, out = Path(folder) / "peak", Path(folder) / "out"
        given = [str(peak), "calibrate", str(job), "--out", str(out), *options]
        arguments = [sys.executable, "-P", "-c", _COMMAND.format(peak_of_this=getsource(_peak_of_this)), *given]
        clock = time.perf_counter()
        child = subprocess.Popen(
            arguments,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(root)},
        )
        _, status, used = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - clock
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise RuntimeError(f"fg-calib calibrate {job.name} ended with {child.returncode}: {child.stderr.read()}")
        child.stderr.close()
        found = float(peak.read_text()) / MIB
    return {"seconds": seconds, "processor_seconds": used.ru_utime + used.ru_stime, "peak_MiB": found}


def growth(quick: bool, seed: int) -> dict[str, Any]:
    """Processor seconds against what a problem has, and the power law through each."""
    found: dict[str, Any] = {}
    sizes = (2_000, 8_000) if quick else (25_000, 50_000, 100_000, 200_000, 400_000)
    found["pairs, linearise"] = [(n, _linearising(linearise.build_case(n, seed))) for n in sizes]
    with TemporaryDirectory() as folder:
        for n in sizes:
            write_pairs(Path(folder) / str(n), n, seed)
        found["pairs, calibrate"] = [(n, _calibrating(Path(folder) / str(n))) for n in sizes]
        of = sizes[0]
        counts = (50, 200) if quick else (50, 500, 5_000, 50_000)
        for k in counts:
            write_pairs(Path(folder) / f"of {k}", of, seed, k)
        found["configurations, calibrate"] = [(k, _calibrating(Path(folder) / f"of {k}")) for k in counts]
    n = sizes[0 if quick else 2]
    arms = [_arm(joints, n, seed) for joints in ((3, 6) if quick else (2, 3, 4, 6, 8, 12))]
    found["joints, linearise"] = [(case.variables.robot.n_joints, _linearising(case)) for case in arms]
    widths = [_arm(7, n, seed, kinds) for kinds in range(1, 6)]
    found["parameters, linearise"] = [(case.variables.n_columns, _linearising(case)) for case in widths]
    laws = {what: exponent(points) for what, points in found.items()}
    return {"seconds of processors": found, "exponents": laws}


def exponent(points: Sequence[tuple[float, float]]) -> float:
    """The slope of a straight line through the logarithms."""
    x, y = np.log(np.array(points, dtype=np.float64)).T
    return float(np.polyfit(x, y, 1)[0])


def _linearising(case: linearise.Case) -> float:
    """Least processor seconds of a Gram matrix."""
    at = [case.variables.at(parameters).chains[0] for parameters in case.parameters]
    return min(_busy(lambda k=k: residuals.gram(case.block, at[k % 2])) for k in range(4))


def _calibrating(folder: Path) -> float:
    """Least processor seconds of a calibration in this process, its file read before."""
    job = fg_calib.read_job(folder / "parquet.yaml")
    return min(_busy(lambda: fg_calib.calibrate_job(job)) for _ in range(2))


def _busy(work: Callable[[], object]) -> float:
    clock = time.process_time()
    work()
    return time.process_time() - clock


def _arm(n_joints: int, n: int, seed: int, kinds: int = 5) -> linearise.Case:
    """Pairs of an arm with so many joints and so many parameters estimated of each."""
    rng, names = np.random.default_rng(seed), ("a", "alpha", "d", "theta", "beta")
    rows = [[0.1 * (k % 3), np.pi / 2 * (-1) ** k, 0.2, 0.0, 0.0] for k in range(n_joints)]
    robot = fg_calib.Robot.from_dh(rows, convention="mdh-hayati")
    robot = robot.with_estimated([p.name for p in robot.parameters if p.name.rstrip("0123456789") in names[:kinds]])
    q = rng.uniform(-np.pi, np.pi, (2 * n, n_joints))
    ends = np.arange(2 * n).reshape(n, 2)
    whitening = np.tile([1e3, 0.0, 1e3], (n, 1))
    kind = stack(Distance(), RotationAngle())
    block = Block(kind, robot.trig(q), ends, rng.uniform(0.1, 1.0, (n, 2)), whitening)
    shifts = 1e-3 * rng.normal(size=(2, len(robot.nominal)))
    variables = build_variables(robot, [False])
    here, there = (np.append(robot.nominal + shift, np.zeros(6)) for shift in shifts)
    return linearise.Case(block, variables, (here, there))


def operations_a_pair(case: linearise.Case) -> dict[str, float]:
    """Floating-point operations of a pair, as the kernel's loops have them, a fused multiply-add counting as two.

    Of each end: an element that turns combines two columns of R (18; 6 more where a reading's angle is added) and its
    axis moves the origin (p x w, 9); one that shifts adds a column to p (6). Of the pair: direction and length of the
    step, axis and angle of the turn (some 100), its wrench rows about the origin (36 a row and end); then each column,
    end and row takes 11 if it turns, 5 if it only shifts, and 1 more to sum the ends. The Gram matrix takes
    2 (n + 1)^2 a row.
    """
    chain = case.variables.at(case.parameters[0]).chains[0]
    turns, reads = chain.axis >= 3, chain.joint >= 0
    walk = 2.0 * float(np.sum(np.where(turns, 18 + 6 * reads, 6)) + 9 * np.sum(turns & (chain.column >= 0)))
    n, rows = chain.n_columns, case.block.residual_dim
    of_column = chain.arrays.turns[:n]
    contract = rows * float(np.sum(np.where(of_column, 2 * 11 + 1, 2 * 5 + 1)))
    panel = walk + 100.0 + 36.0 * 2 * rows + contract
    return {"panel": panel, "gram": 2.0 * rows * (n + 1) ** 2, "bytes": _bytes_a_pair(case)}


def _bytes_a_pair(case: linearise.Case) -> float:
    """Bytes that come from memory: ends, data, whitening, and the readings of both ends, each read once."""
    block = case.block
    readings = 2 * block.trig[0].nbytes
    return float(block.ends[0].nbytes + block.data[0].nbytes + block.whitening[0].nbytes + readings)


def roofline(quick: bool, seed: int) -> dict[str, Any]:
    """What a pair takes on one core beside what this machine could do at best."""
    n = 5_000 if quick else 200_000
    case = linearise.build_case(n, seed)
    count = operations_a_pair(case)
    chain = case.variables.at(case.parameters[0]).chains[0]
    with one_blas_thread:
        size = 300 if quick else 1500
        A = np.random.default_rng(seed).normal(size=(size, size))
        product = min(_busy(lambda: A @ A) for _ in range(5))
        P = np.random.default_rng(seed).normal(size=(chain.n_columns + 1, 1024))
        repeats = 20 if quick else 500
        narrow = min(_busy(lambda: [P @ P.T for _ in range(repeats)]) for _ in range(5)) / repeats
        stream = np.zeros(1_000_000 if quick else 20_000_000)
        into = np.ones_like(stream)
        copying = min(_busy(lambda: np.copyto(into, stream)) for _ in range(5))
    peak, of_panel = 2.0 * size**3 / product, 2.0 * P.shape[1] * len(P) ** 2 / narrow
    whole = min(_busy(lambda: residuals.gram(case.block, chain)) for _ in range(5)) / n
    walking = min(_busy(lambda: residuals.squared_norm(case.block, chain)) for _ in range(5)) / n
    reduced = min(_busy(lambda: residuals.triangle(case.block, chain)) for _ in range(5)) / n
    gram = count["gram"] / of_panel
    return {
        "operations a pair": count,
        "vector bits": _vector_bits(),
        "matrix product, Gflop/s": peak / 1e9,
        "panel times its transpose, Gflop/s": of_panel / 1e9,
        "copy, GB/s": 2.0 * stream.nbytes / copying / 1e9,
        "us a pair, one core": {
            "at the rate of matrix products": (count["panel"] + count["gram"]) / peak * 1e6,
            "at the rate of memory": count["bytes"] / (2.0 * stream.nbytes / copying) * 1e6,
            "measured, Gram matrix": whole * 1e6,
            "of it: BLAS at the rate of panels": gram * 1e6,
            "of it: panel": (whole - gram) * 1e6,
            "residuals alone": walking * 1e6,
            "measured, triangle": reduced * 1e6,
        },
        "panel, Gflop/s": count["panel"] / (whole - gram) / 1e9,
    }


def _vector_bits() -> int:
    """Width of the processor's vector instructions, by what numba's compiler sees."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    return 512 if features.get("avx512f") else 256 if features.get("avx2") else 128


def draw(results: dict[str, Any], path: Path) -> None:
    """Seconds against what grows, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for what, points in results["growth"]["seconds of processors"].items():
        x, y = np.array(points, dtype=np.float64).T
        axes.loglog(x, y, "o-", label=f"{what}: exponent {results['growth']['exponents'][what]:.2f}")
    axes.set_xlabel("pairs, configurations, joints or parameters")
    axes.set_ylabel("seconds of processors")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def run(
    out: Path, quick: bool, n_pairs: int, n_poses: int, seed: int, other: Path | None = None, most: int = 0
) -> dict[str, Any]:
    """The benchmark; writes numbers and picture into `out`."""
    roots = {"now": ROOT} if other is None else {"before": other, "now": ROOT}
    results: dict[str, Any] = {"quick": quick, "seed": seed, "pairs": n_pairs, "poses": n_poses}
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_pairs(folder / "warm", min(n_pairs, WARM), seed)
        write_poses(folder / "warm poses", min(n_poses, 1000), seed)
        write_pairs(folder / "pairs", n_pairs, seed)
        write_poses(folder / "poses", n_poses, seed)
        for root in roots.values():
            for warm in ("warm", "warm poses"):
                command(folder / warm / "parquet.yaml", root=root)  # the kernels
        jobs = [(f"pairs, {ending}", folder / "pairs" / f"{ending}.yaml") for ending in ("parquet", "csv")]
        jobs.append(("poses, parquet", folder / "poses" / "parquet.yaml"))
        runs: list[dict[str, Any]] = []
        for what, job in jobs:
            runs += [{"what": what, "of": of, **command(job, root=root)} for of, root in roots.items()]
        for how in ("parquet", "none"):
            found = command(jobs[0][1], "--residuals", how)
            runs.append({"what": f"pairs, parquet, residuals {how}", "of": "now", **found})
    results["commands"] = runs
    results["parts"] = [in_parts(n, seed) for n in ((n_pairs,) if not most else (n_pairs, most))]
    results["growth"] = growth(quick, seed)
    results["roofline"] = roofline(quick, seed)
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    draw(results, out / f"{NAME}.png")
    return results


def describe(results: dict[str, Any]) -> str:
    """The tables for people."""
    lines = [f"{results['pairs']} pairs, {results['poses']} poses: seconds by the clock, of processors, peak MiB"]
    for r in results["commands"]:
        figures = f"{r['seconds']:8.2f}{r['processor_seconds']:8.2f}{r['peak_MiB']:8.0f}"
        lines.append(f"{r['what']:42}{r['of']:8}{figures}")
    for p in results["parts"]:
        figures = f"{p['seconds']:8.2f}{p['processor_seconds']:8.2f}{p['peak_MiB']:8.0f}"
        lines.append(f"{p['pairs']} pairs, --parts {PART}".ljust(50) + figures)
    lines += [f"{what:28} exponent {law:.2f}" for what, law in results["growth"]["exponents"].items()]
    for what, figure in results["roofline"].items():
        parts = figure.items() if isinstance(figure, dict) else [("", figure)]
        lines += [f"{what}{': ' * bool(part)}{part} {value:.4g}" for part, value in parts]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few pairs and poses")
    parser.add_argument("--pairs", type=int, help="instead of a million")
    parser.add_argument("--poses", type=int, help="instead of 100 000")
    parser.add_argument("--most", type=int, default=0, help="pairs of one more table in parts, such as ten million")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--before", type=Path, help="root of another checkout, to be timed in turn")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    n_pairs, n_poses = (
        given.pairs or (2_000 if given.quick else 1_000_000),
        given.poses or (500 if given.quick else 100_000),
    )
    found = run(given.out, given.quick, n_pairs, n_poses, given.seed, given.before, given.most)
    print(describe(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
