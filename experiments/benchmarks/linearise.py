"""What does one linearisation of distances and rotation angles cost, a pair, with 35 parameters?

Command: python experiments/benchmarks/linearise.py [--quick] [--seed N] [--out FOLDER]
Takes about three minutes, most of it plain numpy on 10^6 pairs; `--quick` some seconds.

Compared in one run, repeats taken in turn, on the space robot of Jia et al. (2019), Table 2, random configurations, two
of their own for each pair:

- block: one factor for all pairs, linearised by GTSAM (`row_factor`, `factor.linearize`) after a first time;
  up to 20 000 rows the factor reduces by QR, beyond by the Gram matrix if the conditioning that it met at the first
  linearisation allows it;
- QR, Gram: the two reductions behind it, without GTSAM;
- single: one factor a pair, as in the paper, on at most 1000 of the pairs;
- plain: the same mathematics in numpy as one writes it first, arrays shaped (pairs, 3, 3), `@`, `np.cross`, `einsum`,
  down to the Gram matrix, on one thread;
- tuned: numpy as one writes it for speed, see `tuned_panel`; `tuned, pool`: its chunks on a pool of threads.

Both numpys are first checked to give the kernel's Gram matrix to 1e-9.

Memory is the growth of the process's peak while the block is linearised twice, in a process of its own a size.

Expected, on two shared cores: block 0.35 to 0.65 us a pair from 10^5 pairs on; plain numpy 20 to 41 times that, tuned
numpy 3 to 7 times, single factors 260 to 500 times; memory that does not grow with the pairs.

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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import gtsam
import numpy as np
from fg_calib.graph.rows import Part, RowSet
from numpy.typing import NDArray

import fg_calib
from fg_calib.graph.factors import row_factor
from fg_calib.graph.variables import Variables, build_variables
from fg_calib.measurements import residuals
from fg_calib.measurements.kinds import stack
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.measurements.residuals import Block
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.threads import one_blas_thread, processors

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]
NAME = "linearise"

ROBOT = """\
name: space-robot
convention: mdh-hayati
units: {length: m, angle: deg}
joints:
  - {a: 0, alpha: 0, d: 2.3, theta: 0, beta: 0}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0}
"""
ERROR = {"m": 0.01, "rad": np.deg2rad(0.05)}
"""Bounds of the true parameters' errors (Jia et al. 2019, Table 6), [m] and [rad]."""

SIGMA = np.array([1e-3, np.deg2rad(0.01)]) * np.sqrt(2.0)
"""1 sigma of distance and angle (Table 5), [m] and [rad]."""

SIZES = (1_000, 100_000, 1_000_000)
QUICK_SIZES = (1_000, 10_000)
N_SINGLE = 1_000
"""Factors of one pair that are timed at most."""

CHUNK = 1_000
"""Pairs that the tuned numpy takes at once: the fastest of 50 to 10 000, its arrays then stay in the cache."""

PLAIN_CHUNK = 10_000
"""Pairs that the plain numpy takes at once."""


@dataclass(frozen=True)
class Case:
    """Pairs to linearise and where.

    Attributes:
        block: The pairs.
        variables: 35 estimated parameters.
        parameters: Two parameter vectors to take in turn, so that nothing can be remembered.
    """

    block: Block
    variables: Variables
    parameters: tuple[Floats, Floats]


def build_case(n: int, seed: int) -> Case:
    """A case of n pairs.

    Data are made span by span, so that the process's peak holds them and little else.
    """
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        (Path(folder) / "robot.yaml").write_text(ROBOT)
        robot = fg_calib.read_robot(Path(folder) / "robot.yaml")
    bounds = np.array([ERROR[p.unit] * p.estimated for p in robot.parameters])
    truth, *estimates = (robot.nominal + rng.uniform(-bounds, bounds) for _ in range(3))
    true_chain = build_chain(robot.with_values(truth))
    trig, measured = np.empty((2 * n, robot.n_joints, 2)), np.empty((n, 2))
    for first in range(0, n, 10_000):
        pairs = slice(first, min(first + 10_000, n))
        rows = slice(2 * pairs.start, 2 * pairs.stop)
        q = rng.uniform(-np.pi, np.pi, (rows.stop - rows.start, robot.n_joints))
        trig[rows] = robot.trig(q)
        poses = forward(true_chain, trig[rows])
        a_R_b = np.swapaxes(poses.rotation[::2], 1, 2) @ poses.rotation[1::2]
        distance = np.linalg.norm(poses.position[1::2] - poses.position[::2], axis=1)
        cosine = np.clip(0.5 * (np.trace(a_R_b, axis1=1, axis2=2) - 1.0), -1.0, 1.0)
        exact = np.stack([distance, np.arccos(cosine)], axis=1)  # (pairs, 2)
        measured[pairs] = exact + rng.normal(size=exact.shape) * SIGMA
    whitening = np.tile([1.0 / SIGMA[0], 0.0, 1.0 / SIGMA[1]], (n, 1))
    first_of_pair = np.arange(0, 2 * n, 2)
    ends = np.stack([first_of_pair, first_of_pair + 1], axis=1)
    block = Block(stack(Distance(), RotationAngle()), trig, ends, measured, whitening)
    return Case(block, build_variables(robot, [False]), (estimates[0], estimates[1]))


def factor_of(block: Block, variables: Variables) -> gtsam.NoiseModelFactor:
    """The pairs as one factor."""
    return row_factor(RowSet((Part(block, 0, 0, np.zeros((block.n, 0), dtype=np.int64)),)), variables)


def tuned_panel(elements: Floats, cs: Floats, measured: Floats) -> Floats:
    """[J r]^T of some pairs, shape (36, 2 n): distances, then angles, whitened.

    Written for mdh-hayati, Tx(a) Rx(alpha) Tz(d) Rz(theta + q) Ry(beta), as one would who wants it fast: both
    configurations of all pairs in one walk, component by component in contiguous arrays, translations without
    the rotation part that they do not have, no trigonometry of readings, one product for all derivatives of a kind.

    Args:
        elements: a, alpha, d, theta, beta of each joint, shape (n_joints, 5), [m] and [rad].
        cs: Cosine and sine of the readings, first configurations, then second ones, shape (2, n_joints, 2 n).
        measured: Distance and angle, shape (2, n), [m] and [rad].
    """
    n_joints, n_both = len(elements), cs.shape[2]
    n = n_both // 2
    R = np.zeros((3, 3, n_both))  # [column, component, configuration]
    R[0, 0] = R[1, 1] = R[2, 2] = 1.0
    p = np.zeros((3, n_both))
    slide = np.empty((n_joints, 2, 3, n_both))  # axis of a and d: v
    turn_w = np.empty((n_joints, 3, 3, n_both))  # axis of alpha, theta and beta: w
    turn_o = np.empty((n_joints, 3, 3, n_both))  # and a point on it

    def turn(i: int, j: int, c: Floats | float, s: Floats | float) -> None:
        """Combine columns i and j of R."""
        old = R[i].copy()
        R[i] = c * old + s * R[j]
        R[j] = c * R[j] - s * old

    for j, (a, alpha, d, theta, beta) in enumerate(elements):
        slide[j, 0] = R[0]
        p += a * R[0]
        turn_w[j, 0], turn_o[j, 0] = R[0], p
        turn(1, 2, np.cos(alpha), np.sin(alpha))
        slide[j, 1] = R[2]
        p += d * R[2]
        turn_w[j, 1], turn_o[j, 1] = R[2], p
        c, s = np.cos(theta), np.sin(theta)
        turn(0, 1, c * cs[0, j] - s * cs[1, j], s * cs[0, j] + c * cs[1, j])
        turn_w[j, 2], turn_o[j, 2] = R[1], p
        turn(2, 0, np.cos(beta), np.sin(beta))

    step = p[:, n:] - p[:, :n]  # p_B - p_A, (3, n)
    distance = np.sqrt(np.einsum("cn,cn->n", step, step))
    u = step / distance
    R_A, R_B = R[:, :, :n], R[:, :, n:]
    # k sin(angle): half the sum over columns of R_A[:, c] x R_B[:, c]
    k = 0.5 * sum(_cross(R_A[c], R_B[c]) for c in range(3))  # (3, n)
    sine = np.sqrt(np.einsum("cn,cn->n", k, k))
    angle = np.arctan2(sine, 0.5 * (np.einsum("abn,abn->n", R_A, R_B) - 1.0))
    k /= sine

    panel = np.empty((5 * n_joints + 1, 2, n))  # [column, distance or angle, pair]
    J = panel[:-1].reshape(n_joints, 5, 2, n)
    u_both = np.concatenate([u, u], axis=1)
    moved = np.einsum("jtcn,cn->jtn", slide, u_both)  # u . v
    J[:, 0:3:2, 0] = moved[..., n:] - moved[..., :n]
    # u . (w x (p - o)) = w . ((p - o) x u)
    arm = _cross(np.moveaxis(p - turn_o, 2, 0), u_both[:, None, None, :])  # (3, n_joints, 3, 2 n)
    moved = np.einsum("jtcn,cjtn->jtn", turn_w, arm)
    turned = moved[..., n:] - moved[..., :n]
    J[:, 1, 0], J[:, 3, 0], J[:, 4, 0] = turned[:, 0], turned[:, 1], turned[:, 2]
    # k . (w_B - w_A)
    turned = np.einsum("jtcn,cn->jtn", turn_w[..., n:] - turn_w[..., :n], k)
    J[:, 1, 1], J[:, 3, 1], J[:, 4, 1] = turned[:, 0], turned[:, 1], turned[:, 2]
    J[:, 0, 1] = J[:, 2, 1] = 0.0
    panel[-1, 0], panel[-1, 1] = distance - measured[0], angle - measured[1]
    panel /= SIGMA[:, None]
    return panel.reshape(len(panel), 2 * n)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product over the first axis."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def plain_panel(elements: Floats, cs: Floats, measured: Floats) -> Floats:
    """The same as `tuned_panel`, with arrays shaped (pairs, 3, 3) and whole rotation matrices multiplied."""
    n = measured.shape[1]
    R_A, p_A, W_A, V_A = _plain_walk(elements, cs[:, :, :n])
    R_B, p_B, W_B, V_B = _plain_walk(elements, cs[:, :, n:])
    distance = np.linalg.norm(p_B - p_A, axis=1)
    u = (p_B - p_A) / distance[:, None]
    B_R_A = R_B @ np.swapaxes(R_A, 1, 2)  # turns A's axes into B's, in the base frame, (n, 3, 3)
    k = 0.5 * np.stack(
        [B_R_A[:, 2, 1] - B_R_A[:, 1, 2], B_R_A[:, 0, 2] - B_R_A[:, 2, 0], B_R_A[:, 1, 0] - B_R_A[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(k, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(B_R_A, axis1=1, axis2=2) - 1.0))
    k /= sine[:, None]
    dp = (np.cross(W_B, p_B[:, None]) + V_B) - (np.cross(W_A, p_A[:, None]) + V_A)  # (n, 35, 3)
    J_distance = np.einsum("nc,ntc->tn", u, dp)
    J_angle = np.einsum("nc,ntc->tn", k, W_B - W_A)
    rows = (
        np.vstack([J_distance, distance - measured[0]]) / SIGMA[0],
        np.vstack([J_angle, angle - measured[1]]) / SIGMA[1],
    )
    return np.hstack(rows)


def _plain_walk(elements: Floats, cs: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Rotation (n, 3, 3), point (n, 3) and twists w and v, each (n, 35, 3), of n configurations."""
    n = cs.shape[2]
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    W, V = np.zeros((n, elements.size, 3)), np.zeros((n, elements.size, 3))
    for j, values in enumerate(elements):
        for e, (axis, turns) in enumerate(((0, False), (0, True), (2, False), (2, True), (1, True))):
            direction, t = R[:, :, axis], elements.shape[1] * j + e
            if not turns:
                V[:, t] = direction
                p = p + values[e] * direction
                continue
            W[:, t] = direction
            V[:, t] = np.cross(p, direction)
            c, s = np.cos(values[e]), np.sin(values[e])
            if e == 3:
                c, s = c * cs[0, j] - s * cs[1, j], s * cs[0, j] + c * cs[1, j]
            a, b = (axis + 1) % 3, (axis + 2) % 3
            turn = np.tile(np.eye(3), (n, 1, 1))
            turn[:, a, a], turn[:, a, b], turn[:, b, a], turn[:, b, b] = c, -s, s, c
            R = R @ turn
    return R, p, W, V


Chunks = list[tuple[Floats, Floats]]
Panel = Callable[[Floats, Floats, Floats], Floats]


def lay_out(block: Block, size: int) -> Chunks:
    """Chunks of a block's data as numpy wants them, `cs` and `measured` of `tuned_panel`: prepared once."""
    chunks = []
    for first in range(0, block.n, size):
        rows = slice(first, first + size)
        both = np.concatenate([block.trig[end] for end in block.ends[rows].T])  # (2 n, n_joints, 2)
        chunks.append((np.ascontiguousarray(both.transpose(2, 1, 0)), np.ascontiguousarray(block.data[rows].T)))
    return chunks


def gram_by_numpy(panel: Panel, chunks: Chunks, elements: Floats, pool: ThreadPoolExecutor | None = None) -> Floats:
    """[J r]^T [J r], shape (36, 36)."""

    def gram_of(chunk: tuple[Floats, Floats]) -> Floats:
        rows = panel(elements, *chunk)
        return rows @ rows.T

    grams: Iterator[Floats] = map(gram_of, chunks) if pool is None else pool.map(gram_of, chunks)
    return sum(grams, np.zeros((elements.size + 1,) * 2))


def elements_at(case: Case, parameters: Floats) -> Floats:
    """A, alpha, d, theta, beta of each joint, shape (n_joints, 5), [m] and [rad]."""
    names = [p.name for p in case.variables.robot.parameters]
    kinds = ("a", "alpha", "d", "theta", "beta")
    joints = range(1, case.variables.robot.n_joints + 1)
    return np.array([[parameters[names.index(f"{kind}{j}")] for kind in kinds] for j in joints])


def check_equal(case: Case, panel: Panel, chunks: Chunks) -> float:
    """Largest difference between numpy's Gram matrix and the kernel's, relative to the columns' lengths.

    Raises:
        AssertionError: It is above 1e-9.
    """
    ours = gram_by_numpy(panel, chunks, elements_at(case, case.parameters[0]))
    kernel = residuals.gram(case.block, case.variables.at(case.parameters[0]).chains[0])
    lengths = np.sqrt(np.diag(kernel))
    lengths[lengths < 1e-9 * lengths.max()] = lengths.max()  # what moves no measurement is rounding in both
    difference = float(np.max(np.abs(ours - kernel) / np.outer(lengths, lengths)))
    if not difference <= 1e-9:
        raise AssertionError(f"numpy and the kernel differ by {difference:.1e} of the columns' lengths")
    return difference


def time_in_turn(work: dict[str, Callable[[int], object]], repeats: dict[str, int]) -> dict[str, list[float]]:
    """Seconds of each repeat; the works take turns, so that a slow spell of the machine hits all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for i in range(max(repeats.values())):
        for name, do in work.items():
            if i < repeats[name]:
                clock = time.perf_counter()
                do(i)
                seconds[name].append(time.perf_counter() - clock)
    return seconds


def measure(n: int, seed: int, quick: bool) -> dict[str, Any]:
    """Microseconds a pair of each way, on n pairs."""
    case = build_case(n, seed)
    variables = case.variables
    values = [variables.values(p) for p in case.parameters]
    chains = [variables.at(p).chains[0] for p in case.parameters]
    elements = [elements_at(case, p) for p in case.parameters]
    factor = factor_of(case.block, variables)
    n_single = min(n, N_SINGLE)
    singles = [factor_of(residuals.rows_of(case.block, slice(i, i + 1)), variables) for i in range(n_single)]
    tuned, plain = lay_out(case.block, CHUNK), lay_out(case.block, PLAIN_CHUNK)
    # One thread of BLAS for all: chunks of this size gain nothing from more, and the block's kernels ask for it too.
    with ThreadPoolExecutor(processors()) as pool, one_blas_thread:
        difference = max(check_equal(case, tuned_panel, tuned), check_equal(case, plain_panel, plain))
        clock = time.perf_counter()
        factor.linearize(values[0])
        first = time.perf_counter() - clock
        work: dict[str, Callable[[int], object]] = {
            "block": lambda i: factor.linearize(values[i % 2]),
            "QR": lambda i: residuals.triangle(case.block, chains[i % 2]),
            "Gram": lambda i: residuals.gram(case.block, chains[i % 2]),
            "single": lambda i: [f.linearize(values[i % 2]) for f in singles],
            "plain": lambda i: gram_by_numpy(plain_panel, plain, elements[i % 2]),
            "tuned": lambda i: gram_by_numpy(tuned_panel, tuned, elements[i % 2]),
            "tuned, pool": lambda i: gram_by_numpy(tuned_panel, tuned, elements[i % 2], pool),
        }
        repeats = dict.fromkeys(work, 3 if quick else 7)
        if n >= 1_000_000:
            repeats["plain"] = 3
        else:
            time_in_turn(work, dict.fromkeys(work, 1))
        seconds = time_in_turn(work, repeats)
    pairs = dict.fromkeys(work, n) | {"single": n_single}
    return {
        "n_pairs": n,
        "numpy_difference": difference,
        "block_first_us": first / n * 1e6,
        "us_a_pair": {
            name: {"median": median(s) / pairs[name] * 1e6, "min": min(s) / pairs[name] * 1e6, "repeats": len(s)}
            for name, s in seconds.items()
        },
        "single_measured_on": n_single,
    }


def peak_memory() -> int:
    """The process's peak resident memory so far, [bytes]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def memory_of(n: int, seed: int) -> dict[str, float]:
    """Peak memory before and after linearising a block of n pairs twice, in this process, [bytes]."""
    small = build_case(1_000, seed)  # loads what any size needs: kernels, BLAS, threads
    values = small.variables.values(small.parameters[0])
    for reduce in (residuals.gram, residuals.triangle):
        reduce(small.block, small.variables.at(small.parameters[0]).chains[0])
    factor_of(small.block, small.variables).linearize(values)
    loaded = peak_memory()
    case = build_case(n, seed)
    factor = factor_of(case.block, case.variables)
    before = peak_memory()
    for parameters in case.parameters:
        factor.linearize(case.variables.values(parameters))
    block = case.block
    arrays = (block.trig, block.ends, block.data, block.whitening)
    return {"loaded": loaded, "before": before, "after": peak_memory(), "input": sum(a.nbytes for a in arrays)}


def measure_memory(n: int, seed: int) -> dict[str, float]:
    """`memory_of` in a fresh process."""
    command = [sys.executable, __file__, "--memory", str(n), "--seed", str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    memory: dict[str, float] = json.loads(done.stdout)
    growth = memory["after"] - memory["before"]
    return {
        **memory,
        "growth": growth,
        "growth_a_pair": growth / n,
        "input_a_pair": memory["input"] / n,
        "whole_jacobian_a_pair": 2 * 36 * 8,
    }


def describe(results: dict[str, Any]) -> str:
    """The table for people."""
    names = ("block", "QR", "Gram", "single", "plain", "tuned", "tuned, pool")
    lines = ["us a pair, median (min)", f"{'pairs':>9}" + "".join(f"{name:>15}" for name in names)]
    for run in results["sizes"]:
        times = run["us_a_pair"]
        cells = (f"{times[name]['median']:.3g} ({times[name]['min']:.3g})" for name in names)
        lines.append(f"{run['n_pairs']:>9}" + "".join(f"{cell:>15}" for cell in cells))
    lines += ["", "times the block's median", f"{'pairs':>9}" + "".join(f"{name:>15}" for name in names[1:])]
    for run in results["sizes"]:
        times = run["us_a_pair"]
        cells = (f"{times[name]['median'] / times['block']['median']:.3g}" for name in names[1:])
        lines.append(f"{run['n_pairs']:>9}" + "".join(f"{cell:>15}" for cell in cells))
    lines.append("")
    for run in results["sizes"]:
        lines.append(
            f"{run['n_pairs']} pairs: the block's first linearisation took {run['block_first_us']:.3g} us a pair; "
            f"single factors timed on {run['single_measured_on']}; numpy's Gram matrices differ from the kernel's by "
            f"{run['numpy_difference']:.0e}"
        )
    lines.append("")
    for m in results["memory"]:
        lines.append(
            f"{m['n_pairs']} pairs: input {m['input'] / 2**20:.1f} MiB; linearising it raised the peak by "
            f"{m['growth'] / 2**20:.1f} MiB, {m['growth_a_pair']:.0f} bytes a pair (a stored [J r]: "
            f"{m['whole_jacobian_a_pair']})"
        )
    return "\n".join(lines)


def run(out: Path, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    sizes = QUICK_SIZES if quick else SIZES
    # Memory first: on Linux a process's peak starts at that of the one which started it.
    memory = [{"n_pairs": n, **measure_memory(n, seed)} for n in sizes]
    results: dict[str, Any] = {
        "seed": seed,
        "quick": quick,
        "processors": processors(),
        "versions": {name: version(name) for name in ("gtsam", "numba", "numpy")},
        "sizes": [measure(n, seed, quick) for n in sizes],
        "memory": memory,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="10^3 and 10^4 pairs only")
    parser.add_argument("--seed", type=int, default=0, help="of robot errors, configurations and noise")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.memory is not None:
        print(json.dumps(memory_of(given.memory, given.seed)))
        return 0
    print(describe(run(given.out, given.seed, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
