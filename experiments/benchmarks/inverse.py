"""Does a solver of scipy's find configurations for given poses as well as the package's own?

Command: python experiments/benchmarks/inverse.py [--quick] [--seed N] [--out FOLDER]
Takes about a minute and a half.

On 200 poses that the paper's arm reaches (of random configurations within +-180 degrees), and on as many of a six-joint
arm with an elbow whose joints turn +-100 degrees: how many are reached to 1e-9 m and rad within the limits, by how much
the others are missed, and the time a pose, for

- *own*: `fg_calib.robot.inverse`, all poses at once, damped Newton steps on our derivatives;
- *trf*: `scipy.optimize.least_squares`, trust region reflective with the limits as bounds, one pose after another, on
  the same derivatives and from the same starts, lengths over the arm's length too; all its tolerances at 1e-15.

Each with one random start for a pose, and with up to 50.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.robot.inverse import N_STARTS, REACHED, random_readings, solve_inverse
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Joint, RobotBuilder

ROOT = Path(__file__).resolve().parents[2]
NAME = "inverse"

Solver = Callable[[fg_calib.Robot, np.ndarray, np.ndarray, int, int], np.ndarray]


def elbow_arm() -> fg_calib.Robot:
    """A six-joint arm with an elbow and a spherical wrist, joints within +-100 degrees."""
    builder = RobotBuilder("elbow, +-100 deg", "mdh")
    builder.add_frame("base", {}, 0, False)
    rows = [(0, 0, 0.67), (0, -90, 0.15), (0.43, 0, 0), (0.02, -90, 0.43), (0, 90, 0), (0, -90, 0)]
    limit = np.deg2rad(100)
    for i, (a, alpha, d) in enumerate(rows):
        values = {"a": a, "alpha": np.deg2rad(alpha), "d": d, "theta": 0.0}
        builder.add_convention_joint(Joint(f"q{i + 1}", lower=-limit, upper=limit), values)
    builder.add_frame("tool", {"z": 0.1}, 7, False)
    return builder.build()


def own(robot: fg_calib.Robot, rotation: np.ndarray, position: np.ndarray, n_starts: int, seed: int) -> np.ndarray:
    """Configurations by the package, shape (n, n_joints)."""
    return solve_inverse(robot, position, rotation, generator=np.random.default_rng(seed), n_starts=n_starts).readings


def inverse_left_jacobian(r: np.ndarray) -> np.ndarray:
    """Derivative of the rotation vector r of exp(w) exp(r) in w, shape (3, 3)."""
    angle = np.linalg.norm(r)
    K = np.cross(np.eye(3), r)  # K @ v is r x v
    if angle < 1e-4:
        return np.eye(3) - 0.5 * K + K @ K / 12.0
    return np.eye(3) - 0.5 * K + (1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))) * K @ K


def trf(robot: fg_calib.Robot, rotation: np.ndarray, position: np.ndarray, n_starts: int, seed: int) -> np.ndarray:
    """Configurations by scipy, shape (n, n_joints)."""
    n, rng = len(position), np.random.default_rng(seed)
    starts = random_readings(robot, n * n_starts, rng).reshape(n, n_starts, robot.n_joints)
    chain = build_chain(robot).with_joint_columns()
    found = np.empty((n, robot.n_joints))
    length = max(1.0, sum(abs(p.nominal) for p in robot.parameters if p.unit == "m"))
    for i in range(n):

        def residual(q: np.ndarray, i: int = i) -> np.ndarray:
            at = forward(chain, robot.trig(q[None]))
            turn = Rotation.from_matrix(at.rotation[0] @ rotation[i].T).as_rotvec()
            return np.concatenate([turn, (at.position[0] - position[i]) / length])

        def jacobian(q: np.ndarray, i: int = i) -> np.ndarray:
            J = forward(chain, robot.trig(q[None])).jacobian[0]
            J[:3] = inverse_left_jacobian(residual(q, i)[:3]) @ J[:3]
            J[3:] /= length
            return J

        smallest = np.inf
        for start in starts[i]:
            ended = least_squares(
                residual, start, jacobian, bounds=robot.limits.T, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200
            )
            if ended.cost < smallest:
                smallest, found[i] = ended.cost, ended.x
            if np.abs(ended.fun).max() < 0.5 * REACHED / length:
                break
    return found


def measure(solver: Solver, robot: fg_calib.Robot, n: int, n_starts: int, seed: int) -> dict[str, float]:
    """One way to solve n poses."""
    at = fg_calib.pose(robot, random_readings(robot, n, np.random.default_rng(seed)))
    clock = time.perf_counter()
    q = solver(robot, at.rotation, at.position, n_starts, seed + 1)
    seconds = time.perf_counter() - clock
    there = fg_calib.pose(robot, q)
    position = np.linalg.norm(there.position - at.position, axis=1)
    angle = Rotation.from_matrix(there.rotation @ np.swapaxes(at.rotation, 1, 2)).magnitude()
    lower, upper = robot.limits.T
    reached = (position < REACHED) & (angle < REACHED) & ((q >= lower) & (q <= upper)).all(axis=1)
    return {
        "n_poses": n,
        "reached": int(reached.sum()),
        "miss_of_reached_m": float(position[reached].max(initial=0.0)),
        "miss_of_reached_rad": float(angle[reached].max(initial=0.0)),
        "miss_of_others_m": float(np.median(position[~reached])) if not reached.all() else 0.0,
        "ms_a_pose": 1e3 * seconds / n,
    }


def run(out: Path, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """The benchmark; writes the numbers into `out`."""
    scenario = fg_calib.read_scenario("space-robot")
    fg_calib.simulate(scenario, seed)  # compiles, or reads the compiled kernels
    arms = {"space robot": scenario.robot, "elbow, +-100 deg": elbow_arm()}
    n = 20 if quick else 200
    repeats = 3 if quick else 20
    clock = time.perf_counter()
    for k in range(repeats):
        fg_calib.simulate(scenario, seed + k)
    results: dict[str, Any] = {
        "seed": seed,
        "quick": quick,
        "ms_a_simulation": 1e3 * (time.perf_counter() - clock) / repeats,
        "arms": {
            name: {
                f"{solver.__name__}, {n_starts} starts" if n_starts > 1 else f"{solver.__name__}, 1 start": measure(
                    solver, robot, n, n_starts, seed
                )
                for solver in (own, trf)
                for n_starts in (1, N_STARTS)
            }
            for name, robot in arms.items()
        },
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


def describe(results: dict[str, Any]) -> str:
    """The table for people."""
    lines = [f"{'':<34}{'reached':>12}{'largest miss':>24}{'others miss':>14}{'ms a pose':>11}"]
    for arm, ways in results["arms"].items():
        for way, m in ways.items():
            miss = f"{m['miss_of_reached_m']:.0e} m {m['miss_of_reached_rad']:.0e} rad"
            others = f"{m['miss_of_others_m']:.2g} m" if m["reached"] < m["n_poses"] else "-"
            reached = f"{m['reached']} of {m['n_poses']}"
            lines.append(f"{arm + ': ' + way:<34}{reached:>12}{miss:>24}{others:>14}{m['ms_a_pose']:>11.3g}")
    lines.append(f"a simulation of the shipped scenario (52 views, 500 random): {results['ms_a_simulation']:.0f} ms")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="20 poses")
    parser.add_argument("--seed", type=int, default=0, help="of poses and starts")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    print(describe(run(given.out, given.seed, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
