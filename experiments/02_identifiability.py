"""Which parameters can the paper's robot identify, entry by entry, and does the factor graph say the same?

Command: python experiments/02_identifiability.py [--quick] [--seed N] [--out FOLDER]
Takes some seconds.

1. Tables 3 and 4 of Jia et al. (2019) beside `fg-calib observe`: the class of each of 35 parameters and the relative
   pairs. Expected: every entry the same; ranks 29 (pose), 23 (distance-rotation), 21, 11, 25, 15.
2. Through GTSAM: a prior of 1 m and 1 rad on everything, so weak that it decides nothing the data decide. The
   directions in which the posterior of the linearised graph keeps the prior's variance are those that no data
   determine. Expected: 6 for pose, 12 for distance-rotation, 14 for distance, spanning the null space found without
   the graph.
3. With the kept parameters alone GTSAM's own Marginals exist and agree with the package's covariance to 1e-6.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import scipy.linalg
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fg_calib
from fg_calib.graph.build import random_problem
from fg_calib.measurements.dataset import Measurements
from fg_calib.observability.identifiability import observe_structure
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Model
from fg_calib.robot.model import CONVENTIONS, Joint, RobotBuilder

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
NAME = "02_identifiability"

PAPER: dict[Model, tuple[str, list[str]]] = {
    "pose": ("", ["beta1 theta2", "beta2 theta3", "d3 d4", "d4 d5", "beta5 theta6", "beta6 theta7"]),
    "distance-rotation": (
        "a1 alpha1 d1 theta1 beta6 theta7 beta7",
        ["beta1 theta2", "beta2 theta3", "d3 d4", "d4 d5", "beta5 theta6"],
    ),
}
"""Tables 3 and 4: the ineffective parameters, and the relative pairs; all others are independent."""

RANKS = {"pose": 29, "distance-rotation": 23, "distance": 21, "rotation": 11, "position": 25, "orientation": 15}
KEPT_PRIOR = {"pose": 6, "distance-rotation": 12, "distance": 14}


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer configurations")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results")
    given = parser.parse_args(arguments)
    n = 100 if given.quick else 500
    file = ROOT / "fg_calib" / "examples" / "space-robot" / "robot_nominal.yaml"
    robot = fg_calib.read_robot(file)
    names = [p.name for p in robot.parameters if 1 <= p.owner <= robot.n_joints]
    robot = robot.with_estimated(names)

    found: dict[str, Any] = {"seed": given.seed, "n_configurations": n, "tables": {}, "graph": {}}
    for model in (*POSE_MODELS, *PAIR_MODELS):
        found["tables"][model] = table(robot, model, n, given.seed)
    found["seconds"] = {str(n): structural_seconds(n, given.seed) for n in (7, 12)}
    spectra = {}
    for model in KEPT_PRIOR:
        found["graph"][model], spectra[model] = through_the_graph(robot, model, n, given.seed)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / f"{NAME}.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(spectra, names).savefig(given.out / f"{NAME}.png", dpi=120)
    report(found)
    return found


def table(robot: fg_calib.Robot, model: Model, n: int, seed: int) -> dict[str, Any]:
    """Our classes and groups for one model, and for the paper's two the comparison entry by entry."""
    o = observe_structure(robot, model, n_configurations=n, seed=seed).observability
    relations = [" ".join(relation) for group in o.relative for relation in group.relations]
    row: dict[str, Any] = {
        "rank": o.rank,
        "rank_expected": RANKS[model],
        "gap": o.gap,
        "ineffective": o.named("ineffective"),
        "relative": relations,
    }
    if model in PAPER:
        ineffective, pairs = PAPER[model]
        relative = {name for pair in pairs for name in pair.split()}
        paper = {
            name: "ineffective" if name in ineffective.split() else "relative" if name in relative else "independent"
            for name in o.names
        }
        ours = dict(zip(o.names, o.classes, strict=True))
        row["entries_that_differ"] = [name for name in o.names if paper[name] != ours[name]]
        row["pairs_that_differ"] = sorted(set(pairs) ^ set(relations))
    return row


def structural_seconds(n_joints: int, seed: int) -> float:
    """Time of the structural analysis of a random arm, once the kernels are loaded: the median of 5."""
    rng = np.random.default_rng(seed)
    builder = RobotBuilder(f"{n_joints} joints", "mdh-hayati")
    for i in range(n_joints):
        values = {kind: float(rng.uniform(0.2, 1.0)) for kind in CONVENTIONS["mdh-hayati"]}
        builder.add_convention_joint(Joint(f"q{i + 1}"), values)
    robot = builder.build()
    seconds = []
    for _ in range(5):
        clock = time.perf_counter()
        observe_structure(robot, "distance-rotation", seed=seed)
        seconds.append(time.perf_counter() - clock)
    return float(np.median(seconds))


def through_the_graph(
    robot: fg_calib.Robot, model: Model, n: int, seed: int
) -> tuple[dict[str, Any], dict[str, Floats]]:
    """What GTSAM's linearised graph says with weak priors on everything, and with the kept parameters alone."""
    weak = replace(robot, parameters=tuple(replace(p, tolerance=1.0) for p in robot.parameters))
    predicted = random_problem(robot, model, n_configurations=n, seed=seed)
    m: Measurements = predicted.measurements
    measurements = replace(m, sigma_position=np.full_like(m.sigma_position, 1e-3))
    options: dict[str, Any] = {"model": model, "pairing": predicted.options.pairing}
    problem = fg_calib.build_problem(weak, measurements, **options)
    ordering = gtsam.Ordering()
    for key in problem.variables.keys:
        ordering.push_back(key)
    A, _ = problem.graph.linearize(problem.initial).jacobian(ordering)
    # Priors of sigma 1: eigenvalues of the posterior covariance are those of posterior over prior variance.
    _, s, Vt = np.linalg.svd(A, full_matrices=False)
    ratio = 1.0 / s**2
    held = ratio > 0.5
    scales = np.array([robot.scale_of(p.unit) for p in robot.parameters if p.estimated])
    null = observe_structure(robot, model, n_configurations=n, seed=seed).observability.null_space * scales
    angle = float(scipy.linalg.subspace_angles(Vt[held].T, null.T).max())
    posterior = np.sqrt(np.sum((Vt.T / s) ** 2, axis=1))

    kept = fg_calib.solve(fg_calib.build_problem(robot, measurements, gauge="keep", **options))
    ours = fg_calib.assess(kept).spread.tangent
    joint = gtsam.Marginals(kept.problem.graph, kept.values)
    worst = max(
        float(np.abs(joint.marginalCovariance(v.key) / ours[v.columns, v.columns] - 1.0).max())
        for v in kept.problem.variables.items
    )
    row = {
        "directions_with_the_priors_variance": int(held.sum()),
        "expected": KEPT_PRIOR[model],
        "largest_ratio_of_the_others": float(ratio[~held].max()),
        "largest_angle_to_the_null_space": angle,
        "kept_parameters": len(kept.problem.variables.names),
        "marginals_against_our_covariance": worst,
    }
    return row, {"ratio": ratio, "posterior": posterior}


def draw(spectra: dict[str, dict[str, Floats]], names: Sequence[str]) -> Figure:
    """Eigenvalues of posterior over prior variance, and posterior over prior sigma of each parameter."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.6])
    for (model, values), colour, marker in zip(spectra.items(), ("#0072B2", "#D55E00", "#009E73"), "os^", strict=True):
        ratio = np.sort(values["ratio"])[::-1]
        label = f"{model}: {int(np.sum(ratio > 0.5))} kept by the prior alone"
        left.semilogy(np.arange(1, len(ratio) + 1), ratio, marker, color=colour, label=label, fillstyle="none")
        right.semilogx(values["posterior"], np.arange(len(names)), marker, color=colour, label=model, fillstyle="none")
    left.set(
        xlabel="number of the combination of parameters",
        ylabel="variance left by the measurements (1: they say nothing)",
        title="What measurements say of combinations",
    )
    left.legend(loc="center left", bbox_to_anchor=(0.0, 0.75), frameon=False)
    right.set_yticks(np.arange(len(names)), names, fontsize=8)
    right.invert_yaxis()
    right.grid(axis="y", color="0.9")
    right.set(
        xlabel="sigma left by the measurements, over the tolerance",
        title="... and of parameters: at 1 they say nothing",
    )
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the tables."""
    print("model              rank  expected  entries and pairs that differ from the paper's table")
    for model, row in found["tables"].items():
        compared = f"{row['entries_that_differ']} {row['pairs_that_differ']}" if model in PAPER else "no table"
        print(f"{model:18} {row['rank']:4} {row['rank_expected']:9}  {compared}")
        print(f"{'':18} ineffective: {', '.join(row['ineffective']) or 'none'}; relative: {row['relative']}")
    print("\nstructural analysis: " + ", ".join(f"{n} joints {s:.3f} s" for n, s in found["seconds"].items()))
    print("\nthrough the graph  prior's variance kept  expected  angle to null space  Marginals against ours")
    for model, row in found["graph"].items():
        print(
            f"{model:18} {row['directions_with_the_priors_variance']:21} {row['expected']:9}"
            f" {row['largest_angle_to_the_null_space']:20.1e} {row['marginals_against_our_covariance']:23.1e}"
        )


if __name__ == "__main__":
    main()
