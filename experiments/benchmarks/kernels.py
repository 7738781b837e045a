"""Is the one kernel for all kinds of measurement as fast as a special kernel for each kind?

Command: python experiments/benchmarks/kernels.py [--quick] [--seed N] [--out FOLDER]
Takes about half a minute.

Compared in one run on one thread, repeats taken in turn, the space robot of `linearise.py`, 35 parameters: panels of
512 measurements by `special_kernels.py` (walk, residual, derivatives and whitening written for one kind) and by
`fg_calib.robot.kernels.fill`, with derivatives in the parameters, in parameters and joints, and without any. Both
panels are first checked to agree to 1e-13 of their largest entry.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from itertools import compress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))

import special_kernels
from linearise import ROOT, build_case

from fg_calib.measurements.kinds import stack
from fg_calib.measurements.kinds.pair import Distance, RotationAngle
from fg_calib.measurements.kinds.pose import Orientation, Position
from fg_calib.measurements.residuals import _NOTHING, CHUNK, pack
from fg_calib.robot.kernels import fill
from fg_calib.robot.kinematics import Chain

NAME = "kernels"
KINDS = {
    "distance, angle": (True, (True, True)),
    "distance": (True, (True, False)),
    "angle": (True, (False, True)),
    "pose": (False, (True, True)),
    "position": (False, (False, True)),
}
"""Whether it is of pairs, and which of distance and angle, or of orientation and position, it has."""


def ways(name: str, chain: Chain, n: int, seed: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Work of the special kernel and of the one kernel on n measurements; each returns its last panel."""
    rng, arrays, (of_pairs, wanted) = np.random.default_rng(seed), chain.arrays, KINDS[name]
    block = build_case(n, seed).block
    trig, ends, columns = block.trig, block.ends if of_pairs else block.ends[:, :1].copy(), np.flatnonzero(wanted)
    a, b = np.ascontiguousarray(ends[:, 0]), np.ascontiguousarray(ends[:, -1])
    R, p = Rotation.random(n, random_state=seed).as_matrix(), rng.normal(size=(n, 3))
    if of_pairs:
        kind = stack(*compress((Distance(), RotationAngle()), wanted))
        W = np.tile([1e3, 3.0 * all(wanted), 5e3], (n, 1))
        packed = W if all(wanted) else np.ascontiguousarray(W[:, 2 * columns])
        data, special = np.ascontiguousarray(block.data[:, columns]), special_kernels.fill_pairs
        given = (trig, a, b, block.data, W, *wanted)
    else:
        kind = stack(*compress((Orientation(), Position()), wanted))
        W = np.tril(rng.normal(size=(n, kind.residual_dim, kind.residual_dim)))
        packed, data = pack(W), np.concatenate(list(compress((R.reshape(n, 9), p), wanted)), axis=1)
        given, special = (trig, a, R, p, W, *wanted), special_kernels.fill_poses
    panels = np.zeros((2, arrays.n_columns + ends.shape[1] * arrays.n_own + 1, kind.residual_dim, CHUNK))
    twins, nothing = kind.twins(), np.zeros((3, 0))

    def by_special() -> Any:
        for s in range(0, n, CHUNK):
            special(*arrays[:10], *given, s, s + CHUNK, panels[0])
        return panels[0]

    def by_one() -> Any:
        for s in range(0, n, CHUNK):
            rows = slice(s, s + CHUNK)
            fill(arrays, trig, ends[rows], data[rows], packed[rows], twins, _NOTHING, nothing, panels[1])
        return panels[1]

    return by_special, by_one


def compare(name: str, chain: Chain, n: int, seed: int, repeats: int) -> dict[str, Any]:
    """Microseconds a measurement of both, and the median of their ratios.

    Raises:
        AssertionError: Their panels differ by more than 1e-13 of the largest entry.
    """
    by_special, by_one = ways(name, chain, n, seed)
    expected = by_special()
    difference = float(np.abs(by_one() - expected).max() / np.abs(expected).max())
    if not difference <= 1e-13:
        raise AssertionError(f"{name}: the panels differ by {difference:.1e} of the largest entry")
    seconds = []
    for _ in range(repeats):
        clock = time.process_time()
        by_special()
        half = time.process_time()
        by_one()
        seconds.append((half - clock, time.process_time() - half))
    special, one = (median(s[k] for s in seconds) / n * 1e6 for k in (0, 1))
    ratio = median(after / before for before, after in seconds)
    return {"special_us": special, "one_us": one, "ratio": ratio, "difference": difference}


def run(out: Path, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    n, repeats = (CHUNK, 3) if quick else (16 * CHUNK, 61)
    case = build_case(n, seed)
    chain = case.variables.at(case.parameters[0]).chains[0]
    chains = {"parameters": chain, "and joints": chain.with_joint_columns(), "none": chain.without_columns()}
    results = {
        "seed": seed,
        "quick": quick,
        "versions": {name: version(name) for name in ("numba", "numpy")},
        "derivatives": {
            what: {name: compare(name, chain, n, seed, repeats) for name in KINDS} for what, chain in chains.items()
        },
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


def describe(results: dict[str, Any]) -> str:
    """The table for people."""
    lines = ["one kernel over special kernel (us a measurement)"]
    for what, kinds in results["derivatives"].items():
        cells = (f"{name}: {f['ratio']:.2f} ({f['one_us']:.3f} / {f['special_us']:.3f})" for name, f in kinds.items())
        lines.append(f"derivatives: {what}; " + "; ".join(cells))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one panel, three repeats")
    parser.add_argument("--seed", type=int, default=0, help="of robot errors, configurations and noise")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    print(describe(run(given.out, given.seed, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
