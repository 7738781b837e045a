"""Are the sigmas honest: do true errors lie where the result says, and is what can be known found out?

Command: python experiments/08_honesty.py [--quick] [--draws N] [--seed N] [--only TEXT] [--out FOLDER]
Takes 45 minutes on two cores that have other work too. --only runs the cells whose arm and way hold the text, such as
"SCARA, star" or "instruments:", and puts them in the place of those of an earlier run.

Calibrations of three arms {the paper's robot, UR10-like 6R, SCARA} by {pose with known frame, pose with unknown frame,
distance + rotation of a star of poses, distance + rotation measured directly}, with encoder noise {off, on}: 24 cells.
Configurations are drawn once for an arm; true parameters (from the priors), frame and noise anew for each draw. For
each cell:

- NEES e^T C^-1 e over all estimated parameters, its mean over their number within its own 99 % bounds;
- coverage of 95 % intervals, within 93.5 to 96.5 %, of single parameters, of kept combinations (random directions, in
  tolerances, without their share in the null space of the data) and of tool positions in the base frame at
  configurations that were not measured (each coordinate, as `Uncertainty.predict` has it);
- RMSE of these tool positions over the Cramér-Rao bound with priors, at most 1.05;
- chi-square against its distribution by Kolmogorov and Smirnov: p at least 0.01 over the number of cells.

Beyond these: chains of steps of 4 to 40 sigma; stars of poses and direct pairs whose distances and angles lie 2 to 10
sigma from 0, and angles as near to half a turn; and the gauges `keep` and `none`, where what is not known is not asked.

And instruments (`simulate` draws what they measure): targets from two stations, wires with an offset, planes, a board
and its corners seen by a camera on the tool, sockets; each with encoder noise off and on.

Then where it breaks: the same with tolerances ten times as wide and noise of 1 to 100 times, for poses, for a star and
for a star of small motions, whose angles and distances come near 0.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from arms import Arm, build_arms, random_rotations
from draws import Over, add_workers, draws_on, here
from fg_calib.simulation.configurations import BoardViews, GivenReadings, Placement
from fg_calib.simulation.instruments import (
    BoardCamera,
    Corners,
    Indicator,
    Instrument,
    LengthGauge,
    Sockets,
    Tracker,
)
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.graph.build import predicted_problem
from fg_calib.graph.problem import Problem, reweighted_at, whitened_triangle
from fg_calib.graph.variables import prior_rows
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, Noise, Pairs
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.rotations import rotation_angle
from fg_calib.simulation.scenario import Errors

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
NAME = "08_honesty"

N_CONFIGURATIONS = 40
N_VIEWS = 30
WAYS: dict[str, dict[str, Any]] = {
    "pose, frame known": {"model": "pose", "frame": "known"},
    "pose, frame unknown": {"model": "pose", "frame": "unknown"},
    "star of poses": {"model": "distance-rotation"},
    "direct pairs": {"model": "distance-rotation"},
    "distances, chain": {"model": "distance", "pairing": Pairing("chain")},
    "angles, chain": {"model": "rotation", "pairing": Pairing("chain")},
    "distances, star": {"model": "distance"},
    "angles, star": {"model": "rotation"},
    "distances, direct": {"model": "distance"},
    "angles, direct": {"model": "rotation"},
    "pose, keep": {"model": "pose", "gauge": "keep"},
    "star, keep": {"model": "distance-rotation", "gauge": "keep"},
    "pose, none": {"model": "pose", "gauge": "none"},
    "star, none": {"model": "distance-rotation", "gauge": "none"},
}
LOOKED_AT = Placement(np.eye(3), np.array([0.6, -0.4, -0.5]))
"""base_T_board of the views of a camera on the tool: 0.3 to 0.55 m away, within 45 degrees of its normal."""

VIEWS = BoardViews(LOOKED_AT, count=N_VIEWS - 1, height=0.4, distance=(0.3, 0.55), cone=np.deg2rad(45.0))
CAMERA = fg_calib.Camera(fx=1200, fy=1200, cx=960, cy=600, k1=-0.05, k2=0.01)
INSTRUMENTS: dict[str, Instrument] = {
    "targets": Tracker(model="position", name="tracker", targets=3, stations=2),
    "wires": LengthGauge(name="wire", anchors=3, offset=0.12),
    "planes": Indicator(name="indicator", planes=3),
    "board": BoardCamera(model="board", name="camera", configurations=VIEWS),
    "pixels": BoardCamera(model="pixels", name="camera", configurations=VIEWS, camera=CAMERA,
                          corners=Corners(8, 6, 0.03)),
    "sockets": Sockets(name="ball", sockets=4),
}  # fmt: skip
NOISE_OF_INSTRUMENTS = Noise(5e-5, np.deg2rad(0.01), distance=5e-5, point=1e-4, pixel=0.1)
N_PAIRS = 60
N_VALIDATION = 8
N_COMBINATIONS = 12
N_STEPS = 150
N_NEAR = 120
EVERY = 5
"""The bound is computed at every so many-th truth; it hardly differs between them."""

SMALL = 0.15
"""How far each joint moves from the first configuration in a star of small motions, at most, [rad] or [m]."""

COVERAGE = (0.935, 0.965)
RMSE_LIMIT = 1.05
NOISE = (1, 3, 10, 30, 100)
WIDE = 10.0
CHUNK = 25


@dataclass(frozen=True)
class Cell:
    """One kind of calibration.

    Attributes:
        arm: A name of `build_arms`.
        way: A key of `WAYS`.
        encoder: Whether the readings have noise.
        noise: Multiple of the arm's noise, its encoders' left out.
        tolerance: Multiple of the arm's tolerances.
        small: Whether the configurations are near the first.
        where: Near what lengths and angles lie: `0` or `pi`; `steps` of a path; or empty for anywhere.
        ratio: How many sigma from there, or from one configuration to the next.
    """

    arm: str
    way: str
    encoder: bool = False
    noise: float = 1.0
    tolerance: float = 1.0
    small: bool = False
    where: str = ""
    ratio: float = 0.0


CELLS = [
    Cell(arm, way, encoder) for arm in ("space robot", "UR10", "SCARA") for way in list(WAYS)[:4] for encoder in (0, 1)
]
CHAINS = [
    Cell("UR10", way, noise=10.0, where="steps", ratio=ratio)
    for way in ("distances, chain", "angles, chain")
    for ratio in (4.0, 10.0, 20.0, 40.0)
]
KINKS = [
    Cell("UR10", f"{what}, {how}", noise=40.0, tolerance=WIDE, where=where, ratio=ratio)
    for what, where in (("distances", "0"), ("angles", "0"), ("angles", "pi"))
    for how in ("star", "direct")
    for ratio in (2.0, 4.0, 6.0, 10.0)
]
GAUGES = [Cell(arm, f"{what}, {gauge}") for arm in ("space robot", "UR10") for gauge in ("keep", "none")
          for what in ("pose", "star")]  # fmt: skip
OF_INSTRUMENTS = [Cell("UR10", way, encoder) for way in INSTRUMENTS for encoder in (False, True)]
OTHERS = {"chains": CHAINS, "kinks": KINKS, "gauges": GAUGES, "instruments": OF_INSTRUMENTS}
BREAKING = {
    "poses, frame known": [Cell("UR10", "pose, frame known", noise=n, tolerance=WIDE) for n in NOISE],
    "star": [Cell("UR10", "star of poses", noise=n, tolerance=WIDE) for n in NOISE],
    "star of small motions": [Cell("UR10", "star of poses", noise=n, tolerance=WIDE, small=True) for n in NOISE],
    "direct pairs of small motions": [Cell("UR10", "direct pairs", noise=n, tolerance=WIDE, small=True) for n in NOISE],
}


@dataclass(frozen=True)
class Setting:
    """What all draws of a cell have in common."""

    arm: Arm
    readings: Floats
    validation: Floats
    pairs: NDArray[np.int64]
    combinations: Floats
    sigma_joint: Floats


@cache
def setting_of(cell: Cell, seed: int) -> Setting:
    """Configurations, pairs and combinations: the same for every cell of an arm but for `small`."""
    arm = build_arms()[cell.arm].scaled(cell.noise, cell.tolerance)
    rng = np.random.default_rng([seed, sum(map(ord, cell.arm))])
    readings, validation = arm.readings(N_CONFIGURATIONS, rng), arm.readings(N_VALIDATION, rng)
    if cell.small:
        readings = readings[0] + rng.uniform(-SMALL, SMALL, readings.shape)
    if cell.where == "steps":
        readings = steps(arm, cell)
    elif cell.where:
        readings = near_kink(arm, cell)
    a, b = np.triu_indices(N_CONFIGURATIONS, 1)
    chosen = rng.permutation(len(a))[:N_PAIRS]
    if cell.where:
        a, b, chosen = np.zeros(len(readings) - 1, dtype=int), np.arange(1, len(readings)), np.arange(len(readings) - 1)
    sigma_joint = arm.sigma_joint * cell.encoder
    return Setting(
        arm,
        readings,
        validation,
        np.stack([a[chosen], b[chosen]]),
        rng.normal(size=(N_COMBINATIONS, sum(p.estimated for p in arm.robot.parameters))),
        sigma_joint,
    )


def moved(arm: Arm, cell: Cell, first: Floats, readings: Floats) -> Floats:
    """How far the tool moved or turned from one configuration to others, in sigma of what is measured."""
    a, b = pose(arm.robot, first[None]), pose(arm.robot, readings)
    if cell.way.startswith("distances"):
        return np.linalg.norm(b.position - a.position, axis=1) / (np.sqrt(2.0) * arm.sigma[0])
    return rotation_angle(np.swapaxes(a.rotation, 1, 2) @ b.rotation)[0] / (np.sqrt(2.0) * arm.sigma[1])


def steps(arm: Arm, cell: Cell) -> Floats:
    """Configurations along a smooth path, one each time the tool has moved or turned by so many sigma."""
    rng = np.random.default_rng(0)
    lower, upper = 0.8 * np.clip(arm.robot.limits, -np.pi, np.pi).T
    waves, phases = rng.normal(size=(3, len(lower))), rng.uniform(0.0, 6.0, (3, len(lower)))
    unit = arm.sigma[0] if cell.way.startswith("distances") else arm.sigma[1]
    time_ = np.arange(4000)[:, None, None] * 0.05 * np.sqrt(2.0) * unit * cell.ratio
    way = np.sum(waves * np.sin(np.array([1.0, 1.7, 2.3])[:, None] * time_ + phases), axis=1)
    path = 0.5 * (lower + upper) + 0.125 * (upper - lower) * way
    chosen = [0]
    while len(chosen) < N_STEPS:
        rest = np.arange(chosen[-1] + 1, min(chosen[-1] + 400, len(path)))
        far = rest[moved(arm, cell, path[chosen[-1]], path[rest]) > cell.ratio]
        if not len(far):
            break
        chosen.append(int(far[0]))
    return path[chosen]


def near_kink(arm: Arm, cell: Cell) -> Floats:
    """A configuration, and others that are the cell's number of sigma, give or take one, from 0 or pi against it."""
    rng = np.random.default_rng(0)
    first = arm.readings(1, rng)[0]
    distances, (sigma_p, sigma_r) = cell.way.startswith("distances"), arm.sigma
    found = first[None]
    while len(found) < N_NEAR:
        aside = rng.normal(size=(4000, len(first))) * (cell.ratio + 1.0) * (sigma_p if distances else 0.5 * sigma_r)
        readings = arm.readings(4000, rng) if cell.where == "pi" else first + aside
        sigmas = moved(arm, cell, first, readings)
        sigmas = np.pi / (np.sqrt(2.0) * sigma_r) - sigmas if cell.where == "pi" else sigmas
        found = np.concatenate([found, readings[np.abs(sigmas - cell.ratio) < 1.0]])
    return found[:N_NEAR]


def measure(cell: Cell, setting: Setting, true: fg_calib.Robot, rng: np.random.Generator) -> Measurements:
    """What is measured of the true robot."""
    s, q = setting, setting.readings
    n, (sigma_p, sigma_r) = len(q), s.arm.sigma
    at = pose(true, q + s.sigma_joint * rng.normal(size=q.shape))
    given: dict[str, Any] = {
        "readings": q,
        "ids": np.arange(n).astype(str),
        "test": np.zeros(n, dtype=bool),
        "position": None,
        "rotation": None,
        "sigma_position": np.full((n, 3), sigma_p),
        "sigma_orientation": np.full((n, 3), sigma_r),
        "sigma_joint": s.sigma_joint,
    }
    if "direct" in cell.way:
        a, b = s.pairs
        if cell.where:
            sigma_p, sigma_r = np.sqrt(2.0) * sigma_p, np.sqrt(2.0) * sigma_r
        distance = np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma_p * rng.normal(size=len(a))
        angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma_r * rng.normal(
            size=len(a)
        )
        # An instrument shows no negative distance, and no angle beyond half a turn.
        distance, angle = np.abs(distance), np.pi - np.abs(np.pi - np.abs(angle))
        of_all = (np.full(len(a), sigma_p), np.full(len(a), sigma_r), np.zeros(len(a), dtype=bool))
        return Measurements(**given, pairs=Pairs(a, b, distance, angle, *of_all))
    turn, shift = np.eye(3), np.zeros(3)
    if cell.way == "pose, frame unknown":
        turn, shift = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    given["position"] = at.position @ turn.T + shift + sigma_p * rng.normal(size=(n, 3))
    given["rotation"] = turn @ at.rotation @ random_rotations(n, sigma_r, rng)
    return Measurements(**given)


def scenario_of(cell: Cell, setting: Setting) -> fg_calib.Scenario:
    """What an instrument measures: errors drawn from the priors, its places and noise anew for each seed."""
    robot = setting.arm.robot
    return fg_calib.Scenario(
        robot=robot,
        errors=Errors("normal", {p.name: p.tolerance for p in robot.parameters if p.tolerance is not None}),
        configurations=GivenReadings(setting.readings),
        noise=replace(NOISE_OF_INSTRUMENTS, joint=tuple(setting.sigma_joint.tolist())),
        instruments=(INSTRUMENTS[cell.way],),
        job={},
    )


def run_draws(cell: Cell, seed: int, draws: Sequence[int]) -> dict[str, Any]:
    """Some draws of a cell: counts and sums."""
    setting = setting_of(cell, seed)
    rows = [one_draw(cell, setting, seed, draw) for draw in draws]
    return {key: [row[key] for row in rows if key in row] for key in rows[0] | rows[-1] | {"bound": 0.0}}


def one_draw(cell: Cell, setting: Setting, seed: int, draw: int) -> dict[str, Any]:
    """One simulated calibration and how its errors compare with what it says of them."""
    robot, key = setting.arm.robot, json.dumps(asdict(cell), sort_keys=True)
    rng = np.random.default_rng([seed, draw, *key.encode()])
    if cell.way in INSTRUMENTS:
        simulation = fg_calib.simulate(scenario_of(cell, setting), int(rng.integers(2**40)))
        true, problem = simulation.true_robot, fg_calib.build_problem(robot, simulation.tables)
    else:
        true = setting.arm.true_robot(rng)
        problem = fg_calib.build_problem(robot, measure(cell, setting, true, rng), **WAYS[cell.way])
    solution = fg_calib.solve(problem)
    found = fg_calib.assess(solution)
    columns = [robot.index(name) for name in found.names]
    error = found.robot.nominal[columns] - true.nominal[columns]
    C = found.covariance
    known = np.isfinite(np.diag(C))
    scales = np.array([robot.scale_of(robot.parameters[i].unit) for i in columns])
    null = found.observability.null_space
    kept = (setting.combinations - setting.combinations @ null.T @ null) / scales

    def tool(r: fg_calib.Robot) -> Floats:
        return pose(r, setting.validation).position

    off = (tool(found.robot) - tool(true)).ravel()
    rows = np.zeros((len(off), len(found.whole.tangent)))
    rows[:, : len(error)] = tool_derivative(setting, found.robot)
    sigma = np.sqrt(np.diag(found.whole.covariance(rows)))
    combined = np.zeros((len(kept), len(found.whole.tangent)))
    combined[:, : len(error)] = kept
    sigma_kept = np.sqrt(np.diag(found.whole.covariance(combined)))
    told = np.isfinite(sigma)
    if draw % EVERY == 0:  # `predict` takes central differences, which costs as much as the fit: it says the same
        np.testing.assert_allclose(found.predict(tool).sigma, sigma, rtol=1e-4)
    out = {
        "nees": float(error[known] @ np.linalg.solve(C[np.ix_(known, known)], error[known])),
        "n": int(known.sum()),
        "parameters": float(np.mean(np.abs(error[known]) < Z * np.sqrt(np.diag(C)[known]))),
        "kept": float(np.mean(np.abs(kept @ error) < Z * sigma_kept)),
        "tool": float(np.mean(np.abs(off[told]) < Z * sigma[told])) if told.any() else np.nan,
        "squared": float(np.mean(off**2)),
        "chi2": found.chi2,
        "dof": found.dof,
        "expected_chi2": found.expected_chi2,
        "warned": bool(found.findings),
        "not_converged": not solution.converged,
        "excluded": sum(solution.problem.n_excluded.values()),
        "residuals": solution.problem.n_residuals,
    }
    if draw % EVERY == 0 and solution.problem.options.has_priors:
        at_truth = solution.parameters.copy()
        at_truth[solution.problem.variables.robot_span] = true.nominal
        out["bound"] = bound_of_tool(problem, at_truth, setting, true)
    return out


Z = float(stats.norm.ppf(0.975))


def bound_of_tool(problem: Problem, at_truth: Floats, setting: Setting, true: fg_calib.Robot) -> float:
    """Mean variance of the tool's coordinates by the Cramér-Rao bound with priors at the truth, [m^2]."""
    there = reweighted_at(problem, at_truth)
    rows = np.vstack([whitened_triangle(there, at_truth), prior_rows(there.variables, at_truth)[1]])
    n = there.variables.n_robot_columns
    R = np.linalg.qr(rows * there.variables.scales, mode="r")
    half = (np.linalg.inv(R) * there.variables.scales[:, None])[:n]
    return float(np.mean(np.sum((tool_derivative(setting, true) @ half) ** 2, axis=1)))


def tool_derivative(setting: Setting, robot: fg_calib.Robot) -> Floats:
    """Of the tool's positions at the validation configurations in the estimated parameters, shape (m, n_parameters)."""
    unmeasured = unmeasured_problem(setting)
    (chain,), (noise,) = unmeasured.variables.at(robot.nominal).chains, unmeasured.noises
    return residuals.linearise(noise.rows, chain)[1].reshape(-1, chain.n_columns)


_UNMEASURED: dict[int, Problem] = {}


def unmeasured_problem(setting: Setting) -> Problem:
    """The problem of the validation configurations, made once for a setting."""
    if id(setting) not in _UNMEASURED:
        anywhere = Measurements.from_arrays(setting.validation)
        _UNMEASURED[id(setting)] = predicted_problem(setting.arm.robot, anywhere, "position")
    return _UNMEASURED[id(setting)]


def run_cells(cells: Sequence[Cell], n_draws: int, seed: int, over: Over = here) -> Iterator[dict]:
    """Every cell's figures."""
    chunks = [range(i, min(i + CHUNK, n_draws)) for i in range(0, n_draws, CHUNK)]
    for cell in cells:
        parts = over(run_chunk, [(cell, seed, chunk) for chunk in chunks])
        yield summary(cell, {key: np.concatenate([part[key] for part in parts]) for key in parts[0]})


def run_chunk(task: tuple[Cell, int, range]) -> dict[str, Floats]:
    """`run_draws` of one task."""
    return run_draws(*task)


def summary(cell: Cell, d: dict[str, Floats]) -> dict[str, Any]:
    """A cell's figures from its draws."""
    n_draws, n = len(d["nees"]), int(d["n"][0])
    k = float(np.sum(d["n"]))
    ks = stats.kstest(stats.chi2.cdf(d["chi2"], d["dof"]), "uniform")
    reduced = d["chi2"] / d["dof"]
    return {
        **asdict(cell),
        "n_draws": n_draws,
        "n_parameters": n,
        "nees": float(d["nees"].sum() / k),
        "nees_bounds": (stats.chi2.ppf([0.005, 0.995], k) / k).tolist(),
        "coverage": {of: mean_of(d[of]) for of in ("parameters", "kept", "tool")},
        "rmse": float(np.sqrt(d["squared"].mean())),
        "rmse_over_bound": float(np.sqrt(d["squared"].mean() / d["bound"].mean())) if len(d["bound"]) else None,
        "dof": float(d["dof"].mean()),
        "reduced_chi2": float(reduced.mean()),
        "reduced_chi2_sd": float(reduced.std(ddof=1)) if n_draws > 1 else 0.0,
        "reduced_chi2_sd_expected": float(np.sqrt(np.mean(2.0 / d["dof"]))),
        "ks": float(ks.statistic),
        "ks_p": float(ks.pvalue),
        "warned": float(d["warned"].mean()),
        "not_converged": float(d["not_converged"].mean()),
        "excluded": float(np.mean(d["excluded"] / (d["excluded"] + d["residuals"]))),
    }


def mean_of(values: Floats) -> float | None:
    """Mean of what is known; None where nothing is."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else None


def judge(row: dict[str, Any], n_cells: int) -> dict[str, bool]:
    """Which criteria a cell meets."""
    low, high = row["nees_bounds"]
    return {
        "nees": low <= row["nees"] <= high,
        **{f"coverage of {of}": v is None or COVERAGE[0] <= v <= COVERAGE[1] for of, v in row["coverage"].items()},
        "rmse": (row["rmse_over_bound"] or 0.0) <= RMSE_LIMIT,
        "chi2": row["ks_p"] >= 0.01 / n_cells,
    }


def run(out: Path, seed: int = 0, quick: bool = False, n_draws: int | None = None, workers: int = 2) -> dict[str, Any]:
    """The whole experiment; quick takes a few cells, few draws and this process alone."""
    clock = time.perf_counter()
    n_draws = n_draws or (20 if quick else 500)
    cells = [CELLS[i] for i in (1, 13, 22)] if quick else CELLS
    breaking = {"direct pairs of small motions": BREAKING["direct pairs of small motions"][::4]} if quick else BREAKING
    found: dict[str, Any] = {"seed": seed, "n_draws": n_draws, "n_configurations": N_CONFIGURATIONS, "cells": []}
    with draws_on(1 if quick else workers) as over:
        print(HEADER)
        for row in run_cells(cells, n_draws, seed, over):
            row["meets"] = judge(row, len(cells))
            found["cells"].append(row)
            print(line(row), flush=True)
        for name, more in OTHERS.items():
            found[name] = []
            for row in run_cells([] if quick else more, max(10, (2 * n_draws) // 5), seed, over):
                row["meets"] = judge(row, len(more))
                found[name].append(row)
                print(line(row), flush=True)
        found["breaking"] = {}
        print()
        for name, of_name in breaking.items():
            found["breaking"][name] = []
            for row in run_cells(of_name, max(10, n_draws // 5), seed, over):
                found["breaking"][name].append(row)
                print(
                    f"{name:30} noise x{row['noise']:3}: NEES {row['nees']:6.3f},"
                    f" tool covered {row['coverage']['tool']:.3f},"
                    f" RMSE/bound {row['rmse_over_bound']:.3f}, chi2/dof {row['reduced_chi2']:.3f},"
                    f" warned {row['warned']:.2f}, excluded {row['excluded']:.2f},"
                    f" not conv. {row['not_converged']:.2f}",
                    flush=True,
                )
    found["seconds"] = round(time.perf_counter() - clock)
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(found).savefig(out / f"{NAME}.png", dpi=120)
    return found


def run_only(out: Path, text: str, seed: int = 0, n_draws: int = 500, workers: int = 2) -> dict[str, Any]:
    """Some cells again, in the place of those of an earlier run."""
    file = out / f"{NAME}.json"
    found = json.loads(file.read_text())
    chosen = {name: [c for c in of_name if text in f"{name}: {c.arm}, {c.way}"] for name, of_name in
              {"cells": CELLS, **OTHERS}.items()}  # fmt: skip
    print(HEADER)
    with draws_on(workers) as over:
        for name, cells in chosen.items():
            found.setdefault(name, [])
            draws = n_draws if name == "cells" else max(10, (2 * n_draws) // 5)
            for cell, row in zip(cells, run_cells(cells, draws, seed, over), strict=True):
                row["meets"] = judge(row, len({"cells": CELLS, **OTHERS}[name]))
                print(line(row), flush=True)
                same = [{**asdict(cell), **old} == {**old, **asdict(cell)} for old in found[name]]
                if any(same):
                    found[name][same.index(True)] = row
                else:
                    found[name].append(row)
    file.write_text(json.dumps(found, indent=1) + "\n")
    draw(found).savefig(out / f"{NAME}.png", dpi=120)
    return found


HEADER = (
    f"{'arm':12} {'measured':20} encoder   NEES  (99 % bounds)  covered: param.  kept   tool"
    "  RMSE/bound  chi2/dof    sd (theory)    KS p  misses"
)


def line(row: dict[str, Any]) -> str:
    """A cell as a line of the table."""
    low, high = row["nees_bounds"]
    c = {of: np.nan if v is None else v for of, v in row["coverage"].items()}
    bound = np.nan if row["rmse_over_bound"] is None else row["rmse_over_bound"]
    near = f"{row['where']} {row['ratio']:g}" if row["where"] else "noisy" if row["encoder"] else "exact"
    missed = ", ".join(name for name, met in row["meets"].items() if not met) or "nothing"
    return (
        f"{row['arm']:12} {row['way']:20} {near:7} {row['nees']:6.3f}"
        f"  ({low:.3f}-{high:.3f}) {c['parameters']:15.3f} {c['kept']:6.3f} {c['tool']:6.3f}"
        f" {bound:11.3f} {row['reduced_chi2']:9.3f} {row['reduced_chi2_sd']:6.3f}"
        f" ({row['reduced_chi2_sd_expected']:.3f}) {row['ks_p']:7.4f}  {missed}"
    )


COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00")  # Okabe & Ito


def draw(found: dict[str, Any]) -> Figure:
    """NEES and coverage of every cell with their limits, and both against noise."""
    figure = Figure(figsize=(13, 8.5), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[1.5, 1])
    nees, coverage = top.subplots(1, 2, sharey=True)
    cells = found["cells"]
    y = np.arange(len(cells))
    low, high = np.array([row["nees_bounds"] for row in cells]).T
    nees.margins(x=0.08)
    nees.barh(y, high - low, left=low, height=0.7, color="0.85", label="what chance allows (99 %)")
    nees.plot([row["nees"] for row in cells], y, "o", color=COLOURS[0], label="found")
    nees.axvline(1.0, color="0.5", lw=0.8)
    nees.set_yticks(
        y, [f"{r['arm']}, {r['way']}{', encoder noise' if r['encoder'] else ''}" for r in cells], fontsize=8
    )
    nees.invert_yaxis()
    nees.set_title(f"Squared error over that claimed (1 is honest), {found['n_draws']} draws")
    coverage.axvspan(*(100 * np.array(COVERAGE)), color="0.85", label="accepted")
    for of, colour, marker in zip(("parameters", "kept", "tool"), COLOURS, "os^", strict=False):
        label = {"kept": "kept combinations", "tool": "tool positions"}.get(of, of)
        values = [100 * row["coverage"][of] for row in cells]
        coverage.plot(values, y, marker, color=colour, label=label, fillstyle="none")
    coverage.set_title("How often 95 % intervals hold the truth [%]")
    for axes in (nees, coverage):
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, frameon=False)
    panels = bottom.subplots(1, 3)
    shown = (
        ("nees", "The same with larger noise (UR10)"),
        ("tool", "How often 95 % intervals hold the true tool [%]"),
        ("warned", "Results that warn [%]"),
    )
    for axes, (what, title) in zip(panels, shown, strict=True):
        for (name, rows), colour, marker in zip(found["breaking"].items(), COLOURS, "os^D", strict=False):
            values = [100 * r["coverage"]["tool"] if what == "tool" else r[what] * (1 if what == "nees" else 100)
                      for r in rows]  # fmt: skip
            axes.plot([r["noise"] for r in rows], values, f"{marker}-", color=colour, label=name, fillstyle="none")
        axes.set(xscale="log", xlabel="noise, times the ordinary", title=title)
        axes.set_xticks(NOISE, [str(n) for n in NOISE])
        axes.minorticks_off()
    panels[0].axhline(1.0, color="0.5", lw=0.8)
    panels[1].axhspan(*(100 * np.array(COVERAGE)), color="0.85")
    panels[2].set_ylim(-5, 105)
    panels[0].legend(fontsize=8, frameon=False)
    for axes in (nees, coverage, *panels):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three cells, 20 draws")
    parser.add_argument("--draws", type=int, help="calibrations a cell; default 500")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="TEXT", help="run these cells again, such as 'SCARA, star'")
    add_workers(parser)
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    if given.only is not None:
        run_only(given.out, given.only, given.seed, given.draws or 500, given.workers)
    else:
        run(given.out, given.seed, given.quick, given.draws, given.workers)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
