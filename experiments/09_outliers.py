"""How much do gross errors harm a calibration with each loss, and does `gnc` stay within 1.3 times of the clean fit?

Command: python experiments/09_outliers.py [--quick] [--draws N] [--seed N] [--out FOLDER]
With 20 draws 7 minutes on two cores; results are written after each arm and kind of measurement.

The paper's robot and a UR10-like 6R at 40 random configurations; poses (frame known and unknown), a star of poses (its
first pose, the hub, clean; and wrong), 80 random pairs of poses, 80 directly measured pairs. A share of 0, 0.1 and 0.3
of the configurations, or of the direct pairs one by one, is wrong: half of these by errors of up to 50 sigma in each
component, half by the pose (or pair) of another configuration. Each draw has its own truth (from the priors), noise and
outliers, the same for every loss. Figures: RMS of the tool's position error at 50 configurations that were not
measured (but for the known frame after the rigid motion that fits best: nothing tells where the base is), over that of
least squares on the same measurements without the gross errors (*clean*), and over that of least squares told which
rows are wrong (*oracle*); share of wrong rows kept and of clean ones rejected (weight below one half); NEES over its
degrees of freedom.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from arms import Arm, build_arms, random_rotations
from draws import add_workers, draws_on
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.errors import CalibrationError
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.robot.rotations import rotation_angle

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

ROOT = Path(__file__).resolve().parents[1]
NAME = "09_outliers"

N_CONFIGURATIONS, N_PAIRS, N_VALIDATION = 40, 80, 50
SIZE = 50.0
"""Of a gross error in each component, at most, [sigma]."""

LIMIT = 1.3
ARMS = ("UR10", "space robot")
SHARES = (0.0, 0.1, 0.3)
LOSSES = ("none", "huber", "cauchy", "geman-mcclure", "gnc")
SMOOTH_EVERY = 4
"""The losses that never reject take many rounds: they are tried in every fourth draw."""

WAYS: dict[str, dict[str, Any]] = {
    "pose, frame known": {"model": "pose"},
    "pose, frame unknown": {"model": "pose", "frame": "unknown"},
    "direct pairs": {"model": "distance-rotation"},
    "star, hub clean": {"model": "distance-rotation"},
    "random pairs": {"model": "distance-rotation", "pairing": Pairing("random", N_PAIRS)},
    "star, hub wrong": {"model": "distance-rotation"},
}


@cache
def setting_of(arm_name: str, seed: int) -> tuple[Arm, Floats, Floats]:
    """The arm, its configurations and those of the validation."""
    arm = build_arms()[arm_name]
    rng = np.random.default_rng([seed, len(arm_name)])
    return arm, arm.readings(N_CONFIGURATIONS, rng), arm.readings(N_VALIDATION, rng)


def poses_of(arm: Arm, q: Floats, true: fg_calib.Robot, unknown: bool, rng: np.random.Generator) -> Measurements:
    """Clean measurements of poses."""
    n, (sigma_p, sigma_r), at = len(q), arm.sigma, pose(true, q)
    turn, shift = np.eye(3), np.zeros(3)
    if unknown:
        turn, shift = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    return Measurements(
        readings=q,
        ids=np.arange(n).astype(str),
        test=np.zeros(n, dtype=bool),
        position=at.position @ turn.T + shift + sigma_p * rng.normal(size=(n, 3)),
        rotation=turn @ at.rotation @ random_rotations(n, sigma_r, rng),
        sigma_position=np.full((n, 3), sigma_p),
        sigma_orientation=np.full((n, 3), sigma_r),
        sigma_joint=np.zeros(q.shape[1]),
    )


def with_pairs(m: Measurements, arm: Arm, true: fg_calib.Robot, rng: np.random.Generator) -> Measurements:
    """The same configurations with clean pairs measured directly."""
    first, second = np.triu_indices(len(m.readings), 1)
    chosen = np.random.default_rng(0).permutation(len(first))[:N_PAIRS]
    a, b = first[chosen], second[chosen]
    at, (sigma_p, sigma_r) = pose(true, m.readings), arm.sigma
    distance = np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma_p * rng.normal(size=N_PAIRS)
    angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma_r * rng.normal(size=N_PAIRS)
    of_all = (np.full(N_PAIRS, sigma_p), np.full(N_PAIRS, sigma_r), np.zeros(N_PAIRS, dtype=bool))
    return replace(m, position=None, rotation=None, pairs=Pairs(a, b, np.abs(distance), np.abs(angle), *of_all))


def spoil(m: Measurements, share: float, hub: bool | None, rng: np.random.Generator) -> tuple[Measurements, Booleans]:
    """A share of configurations, or of direct pairs, made wrong, and which; `hub` tells of the first, None draws it."""
    n = m.n_configurations if m.pairs is None else m.pairs.n_pairs
    bad = np.zeros(n, dtype=bool)
    bad[rng.permutation(np.arange(n if hub is None else n - 1) + (hub is not None))[: round(share * n)]] = True
    if hub is not None:
        bad[0] = hub
    rows = np.flatnonzero(bad)
    swapped = rng.random(len(rows)) < 0.5
    swapped[:1] &= not hub  # the hub is off by up to 50 sigma
    other = np.where(swapped, (rows + rng.integers(1, n, len(rows))) % n, rows)
    gross = rng.uniform(-SIZE, SIZE, (len(rows), 6)) * ~swapped[:, None]
    if m.pairs is not None:
        p, distance, angle = m.pairs, m.pairs.distance.copy(), m.pairs.angle.copy()
        distance[rows] = np.abs(p.distance[other] + gross[:, 0] * p.sigma_distance[rows])
        angle[rows] = np.abs(p.angle[other] + gross[:, 1] * p.sigma_angle[rows])
        angle = np.minimum(angle, 2.0 * np.pi - angle)
        return replace(m, pairs=replace(p, distance=distance, angle=angle)), bad
    assert m.position is not None
    assert m.rotation is not None
    assert m.sigma_position is not None
    assert m.sigma_orientation is not None
    position, rotation = m.position.copy(), m.rotation.copy()
    position[rows] = m.position[other] + gross[:, :3] * m.sigma_position[rows]
    turn = Rotation.from_rotvec(gross[:, 3:] * m.sigma_orientation[rows]).as_matrix()
    rotation[rows] = m.rotation[other] @ turn
    return replace(m, position=position, rotation=rotation), bad


def squared_error(found: Floats, truth: Floats, free: bool) -> float:
    """Mean squared distance of points, [m^2]; where the base is `free`, after the rigid motion that fits best."""
    if free:
        found, truth = found - found.mean(axis=0), truth - truth.mean(axis=0)
        found = Rotation.align_vectors(truth, found)[0].apply(found)
    return float(np.mean(np.sum((found - truth) ** 2, axis=1)))


def one_draw(arm_name: str, way: str, seed: int, draw: int) -> dict[str, dict[str, float]]:
    """Figures by `share loss`, of one truth with one noise; `clean` and `oracle` by share too."""
    arm, q, unmeasured = setting_of(arm_name, seed)
    rng = np.random.default_rng([seed, draw, *f"{arm_name} {way}".encode()])
    true = arm.true_robot(rng)
    clean = poses_of(arm, q, true, WAYS[way].get("frame") == "unknown", rng)
    if way == "direct pairs":
        clean = with_pairs(clean, arm, true, rng)
    hub = {"star, hub clean": False, "star, hub wrong": True}.get(way)
    truth = pose(true, unmeasured).position

    def fit(m: Measurements, bad: Booleans, loss: Any = "none") -> dict[str, float]:
        try:
            solution = fg_calib.solve(fg_calib.build_problem(arm.robot, m, loss=loss, **WAYS[way]))
        except CalibrationError:
            return {"failed": 1.0}
        found = fg_calib.assess(solution)
        columns = [found.robot.index(name) for name in found.names]
        error = found.robot.nominal[columns] - true.nominal[columns]
        (series,), weights = solution.problem.data.series, solution.problem.state.weights
        wrong = bad[series.number] if m.pairs is not None else bad[series.ends].any(axis=1)
        kept = np.ones(len(wrong), dtype=bool) if weights is None else weights[0] >= 0.5
        used = series.used.any(axis=1)
        return {
            "squared": squared_error(pose(found.robot, unmeasured).position, truth, way != "pose, frame known"),
            "nees": float(error @ np.linalg.solve(found.covariance, error) / len(error)),
            "wrong": float(np.sum(wrong & used)),
            "wrong_kept": float(np.sum(wrong & kept & used)),
            "clean": float(np.sum(~wrong & used)),
            "clean_rejected": float(np.sum(~wrong & ~kept & used)),
            "warned": float(bool(found.findings)),
            "not_converged": float(not solution.converged),
        }

    nothing = np.zeros(N_PAIRS if way == "direct pairs" else N_CONFIGURATIONS, dtype=bool)
    out = {"clean": fit(clean, nothing)}
    for share in SHARES:
        m, bad = spoil(clean, share, hub, rng)
        for loss in ("none", "gnc") if draw % SMOOTH_EVERY else LOSSES:
            same = loss == "none" and not bad.any()
            out[f"{share} {loss}"] = out["clean"] if same else fit(m, bad, loss)
        if hub:
            continue  # without the hub nothing is left of a star
        if not bad.any():
            out[f"{share} oracle"] = out["clean"]
            continue
        told = replace(m, test=bad) if m.pairs is None else replace(m, pairs=replace(m.pairs, test=bad))
        out[f"{share} oracle"] = fit(told, bad)
    return out


def one_task(task: tuple[str, str, int, int]) -> dict[str, dict[str, float]]:
    """`one_draw` of one task."""
    return one_draw(*task)


def run(out: Path, seed: int = 0, quick: bool = False, n_draws: int | None = None, workers: int = 2) -> dict[str, Any]:
    """The whole experiment; quick takes one arm, two ways, few draws and this process alone."""
    clock = time.perf_counter()
    n_draws = n_draws or (5 if quick else 40)
    cells = [(arm, way) for arm in ARMS for way in WAYS]
    if quick:
        cells = [("UR10", "pose, frame known"), ("UR10", "direct pairs")]
    found: dict[str, Any] = {"seed": seed, "n_draws": n_draws, "cells": []}
    with draws_on(1 if quick else workers) as over:
        for arm, way in cells:
            draws = over(one_task, [(arm, way, seed, draw) for draw in range(n_draws)])
            for row in summaries(arm, way, draws):
                found["cells"].append(row)
                print(line(row), flush=True)
            found["seconds"] = round(time.perf_counter() - clock)
            write(found, out)  # after each, for the whole takes long
    return found


def write(found: dict[str, Any], out: Path) -> None:
    """The results so far, as figures and as a figure."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(found, indent=1) + "\n")
    draw_figure(found).savefig(out / f"{NAME}.png", dpi=120)


def summaries(arm: str, way: str, draws: list[dict[str, dict[str, float]]]) -> list[dict[str, Any]]:
    """A row for each share and loss."""
    rows = []
    clean = np.array([d["clean"]["squared"] for d in draws])
    for share in SHARES:
        rms = {}
        for loss in (*(("oracle",) if f"{share} oracle" in draws[0] else ()), *LOSSES):
            each = [d.get(f"{share} {loss}", {}) for d in draws]
            tried = [i for i, e in enumerate(each) if e]
            fitted = [i for i in tried if "failed" not in each[i]]
            if not fitted:
                continue
            sums = {key: float(np.sum([each[i][key] for i in fitted])) for key in each[fitted[0]]}
            squared = np.array([each[i]["squared"] for i in fitted])
            rms[loss] = float(np.sqrt(squared.mean() / clean[fitted].mean()))
            told = [draws[i].get(f"{share} oracle", {}).get("squared", np.nan) for i in fitted]
            rows.append(
                {
                    "arm": arm,
                    "way": way,
                    "share": share,
                    "loss": loss,
                    "clean_rms": float(np.sqrt(clean.mean())),
                    "over_clean": rms[loss],
                    "over_oracle": float(np.sqrt(squared.mean() / np.mean(told))) if "oracle" in rms else None,
                    "median_over_clean": float(np.median(np.sqrt(squared / clean[fitted]))),
                    "wrong_kept": sums["wrong_kept"] / sums["wrong"] if sums["wrong"] else None,
                    "clean_rejected": sums["clean_rejected"] / sums["clean"] if sums["clean"] else None,
                    "wrong_rows": sums["wrong"] / (sums["wrong"] + sums["clean"]),
                    "nees": sums["nees"] / len(fitted),
                    "warned": sums["warned"] / len(fitted),
                    "not_converged": sums["not_converged"] / len(fitted),
                    "failed": 1.0 - len(fitted) / len(tried),
                    "n_draws": len(tried),
                }
            )
    return rows


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    oracle, kept, rejected = (
        "   -" if row[k] is None else f"{row[k]:.3f}" for k in ("over_oracle", "wrong_kept", "clean_rejected")
    )
    return (
        f"{row['arm']:12} {row['way']:20} {row['share']:3} {row['loss']:13} over clean {row['over_clean']:9.3f}"
        f" (median {row['median_over_clean']:8.3f}) over oracle {oracle}, wrong kept {kept}, clean rejected {rejected},"
        f" NEES {row['nees']:10.3g}, warned {row['warned']:.2f}, not conv. {row['not_converged']:.2f}"
    )


COLOURS = {"oracle": "0.5", "none": "#000000", "huber": "#E69F00", "cauchy": "#56B4E9"}  # Okabe & Ito
COLOURS |= {"geman-mcclure": "#D55E00", "gnc": "#0072B2"}
MARKERS = dict(zip(COLOURS, "|xs^Do", strict=True))


def draw_figure(found: dict[str, Any]) -> Figure:
    """Tool error over that of the clean fit, by arm, share, way and loss."""
    arms = list(dict.fromkeys(row["arm"] for row in found["cells"]))
    figure = Figure(figsize=(12, 2.2 + 3.0 * len(arms)), layout="constrained")
    panels = figure.subplots(len(arms), len(SHARES), sharey=True, sharex=True, squeeze=False)
    ways = list(dict.fromkeys(row["way"] for row in found["cells"]))[::-1]
    for of_arm, arm in zip(panels, arms, strict=True):
        for axes, share in zip(of_arm, SHARES, strict=True):
            axes.axvline(LIMIT, color="0.7", ls="--", lw=1, label=f"limit {LIMIT}")
            for loss, colour in COLOURS.items():
                rows = [r for r in found["cells"] if (r["arm"], r["share"], r["loss"]) == (arm, share, loss)]
                x, y = [r["over_clean"] for r in rows], [ways.index(r["way"]) for r in rows]
                axes.plot(
                    x, y, MARKERS[loss], color=colour, label=loss, fillstyle="none", ms=10 if loss == "oracle" else 6
                )
            axes.set(xscale="log", title=f"{arm}: {100 * share:.0f} % wrong")
            axes.set_yticks(range(len(ways)), ways)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", color="0.92")
    for axes in panels[-1]:
        axes.set_xlabel("tool error over that of the clean fit")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one arm, two ways, 5 draws")
    parser.add_argument("--draws", type=int, help="draws a cell; default 40")
    parser.add_argument("--seed", type=int, default=0)
    add_workers(parser)
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    run(given.out, given.seed, given.quick, given.draws, given.workers)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
