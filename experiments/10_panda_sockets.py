"""Does a ball put by hand into two sockets 50 mm apart calibrate a real Franka Panda, without any instrument?

Command: python experiments/10_panda_sockets.py [--quick] [--seed N] [--out FOLDER]
Takes about a quarter of a minute; the first run on a machine compiles the kernels, which takes some more.

The configurations of one location and socket touch one point, the two sockets of a location are 50 mm apart. The arm
(six geometric errors a joint, priors 5 mm and 10 mrad) and the ball centre are fitted to four locations and judged on
two others: how far the ball centres lie from their group's mean, and how far apart the means are. Expected, on the
unseen locations, [mm]:

| | spread of the ball centre | socket distance error |
|---|---|---|
| nominal arm, ball centre fitted | 2.97 | 0.87 |
| pairs table, every pair of a group | 0.210 | 0.024 |
| column `group` | 0.210 | 0.024 |
| touches and distances as two tables | 0.210 | 0.024 |

Data: `panda_sockets` in the folder FG_CALIB_DATA (default: ../shared/data beside the repository); where it is missing,
the experiment says so and ends. Results hold summary numbers and a figure, no measured rows.

References:
    Franzese, Spahn, Kober, Della Santina (2025), MUKCa: Accurate and Affordable Cobot Calibration Without External
    Measurement Devices. arXiv:2503.12584: the data.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fg_calib

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
NAME = "10_panda_sockets"

SIGMA_POINT = 0.00012
"""Of a touch, per axis, [m]: what a geometric model of this arm leaves, 0.2 mm in norm."""

SIGMA_DISTANCE = 0.00006
"""Of the distance of two sockets, [m]: the authors' calipers agree with 50 mm within 0.1 mm."""

SOCKET_DISTANCE = 0.050
PRIOR = {"xyz": 0.005, "rpy": 0.010}
"""1 sigma of each joint's place and turn, [m] and [rad]: weak, as in the reference."""

WAYS = {
    "groups": "column group",
    "mixed": "touches and distances as two tables",
    "all": "pairs table, every pair of a group",
    "chain": "pairs table, each with the next",
    "star": "pairs table, the first with each",
}
REFERENCE = {"spread": (2.964, 0.210, 0.23), "distance": (0.871, 0.026, 0.05)}
"""Test figures before and after (an independent fit: README of the data), and the limit we hold to, [mm]."""

BEFORE, AFTER = "#E69F00", "#0072B2"  # Okabe & Ito: told apart by colour-blind eyes, and in print by their lightness


def data_folder() -> Path:
    """Where the real data are, whether or not they are there."""
    return Path(os.environ.get("FG_CALIB_DATA", ROOT.parent / "shared" / "data")) / "panda_sockets"


def read_rows(data: Path, seed: int, quick: bool) -> list[dict[str, str]]:
    """The rows of the table; quick takes half of the train rows, drawn by `seed`."""
    with (data / "panda_3.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not quick:
        return rows
    keep = np.random.default_rng(seed).random(len(rows)) < 0.5
    return [row for row, kept in zip(rows, keep, strict=True) if kept or row["split"] == "test"]


def write_urdf(nominal: dict[str, Any], path: Path) -> None:
    """The nominal arm as a URDF, which has the very convention of its table."""

    def figures(values: Sequence[float]) -> str:
        return " ".join(repr(float(v)) for v in values)

    lines = ['<?xml version="1.0"?>', '<robot name="panda">', '  <link name="base"/>']
    parent = "base"
    end = {"name": "flange", "type": "fixed", "origin_xyz": nominal["flange"]["xyz"]}
    end |= {"origin_rpy": nominal["flange"]["rpy"], "axis": [0, 0, 1]}
    for joint in (*nominal["joints"], end):
        child = "flange" if joint is end else f"{joint['name']}_link"
        kind = "continuous" if joint["type"] == "revolute" else joint["type"]
        lines += [
            f'  <link name="{child}"/>',
            f'  <joint name="{joint["name"]}" type="{kind}">',
            f'    <parent link="{parent}"/><child link="{child}"/>',
            f'    <origin xyz="{figures(joint["origin_xyz"])}" rpy="{figures(joint["origin_rpy"])}"/>',
            f'    <axis xyz="{figures(joint["axis"])}"/>',
            "  </joint>",
        ]
        parent = child
    path.write_text("\n".join([*lines, "</robot>"]) + "\n")


def groups_of(rows: list[dict[str, str]]) -> dict[tuple[str, str], list[int]]:
    """Rows of each location and socket."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row["location"], row["socket"]), []).append(i)
    return groups


def pairs_of(groups: dict[tuple[str, str], list[int]], way: str) -> list[tuple[object, object, float, float]]:
    """(a, b, distance, sigma) of a pairs table, in configurations; in groups if `way` has these.

    With every pair of a group of n, sum over pairs of |p_i - p_j|^2 = n sum |p_i - mean|^2: a sigma sqrt(n) times that
    of a touch gives each touch its own weight. The pairs of two sockets, n by m, likewise share one measured distance.
    """
    locations = sorted({location for location, _ in groups})
    if way in ("groups", "mixed"):
        return [(f"{p}/0", f"{p}/1", SOCKET_DISTANCE, SIGMA_DISTANCE) for p in locations]
    table: list[tuple[object, object, float, float]] = []
    for rows in groups.values():
        n = len(rows)
        found = {
            "all": [(a, b) for i, a in enumerate(rows) for b in rows[i + 1 :]],
            "chain": list(pairwise(rows)),
            "star": [(rows[0], b) for b in rows[1:]],
        }[way]
        sigma = SIGMA_POINT * np.sqrt(n if way == "all" else 2)
        table += [(a, b, 0.0, sigma) for a, b in found]
    for location in locations:
        one, other = groups[location, "0"], groups[location, "1"]
        if way == "all":
            found = [(a, b) for a in one for b in other]
            sigma = SIGMA_DISTANCE * np.sqrt(len(found))
        else:
            found = list(zip(one, other, strict=False))
            sigma = np.hypot(np.sqrt(2) * SIGMA_POINT, SIGMA_DISTANCE)
        table += [(a, b, SOCKET_DISTANCE, sigma) for a, b in found]
    return table


def write_job(data: Path, rows: list[dict[str, str]], folder: Path, way: str) -> Path:
    """Robot, tables and job of one way to say which configurations touch the same point."""
    nominal = yaml.safe_load((data / "nominal_panda.yaml").read_text())
    write_urdf(nominal, folder / "panda.urdf")
    kinds = {"x": "xyz", "y": "xyz", "z": "xyz", "roll": "rpy", "pitch": "rpy", "yaw": "rpy"}
    robot = {
        "urdf": "panda.urdf",
        "base_link": "base",
        "tip_link": "flange",
        "tool": {"z": 0.03},
        "estimate": ["tool.x", "tool.y", "tool.z"],
        "tolerance": {f"{j['name']}.{k}": PRIOR[kinds[k]] for j in nominal["joints"] for k in kinds},
    }
    joints, grouped = [f"q{k}" for k in range(1, 8)], way in ("groups", "mixed")
    with (folder / f"{way}.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*joints, "split", *(["group"] if grouped else [])])
        for row in rows:
            group = [f"{row['location']}/{row['socket']}"] if grouped else []
            out.writerow([*(row[q] for q in joints), row["split"], *group])
    with (folder / f"{way}_pairs.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["a", "b", "distance", "sigma_distance"])
        out.writerows(pairs_of(groups_of(rows), way))
    job = {"robot": robot, "model": "distance", "noise": {"point": SIGMA_POINT}, "measurements": f"{way}.csv"}
    if way == "mixed":  # the calipers' table has a stop of its own, at which nothing was touched
        with (folder / "calipers.csv").open("w", newline="") as file:
            csv.writer(file).writerows([joints, [rows[0][q] for q in joints]])
        job["measurements"] = [{"table": "mixed.csv"}, {"table": "calipers.csv", "pairs": "mixed_pairs.csv"}]
    else:
        job["pairs"] = f"{way}_pairs.csv"
    (folder / f"{way}.yaml").write_text(yaml.safe_dump(job))
    return folder / f"{way}.yaml"


def judge(robot: fg_calib.Robot, readings: Floats, rows: list[dict[str, str]]) -> dict[str, dict[str, Floats]]:
    """Distances of ball centres from their group's mean, and socket distance errors, by split, [m]."""
    p = fg_calib.pose(robot, readings).position
    found: dict[str, dict[str, Floats]] = {}
    for split in ("train", "test"):
        groups = {name: i for name, i in groups_of(rows).items() if rows[i[0]]["split"] == split}
        means = {name: p[i].mean(axis=0) for name, i in groups.items()}
        off = [np.linalg.norm(p[i] - means[name], axis=1) for name, i in groups.items()]
        locations = sorted({location for location, _ in groups})
        apart = [np.linalg.norm(means[q, "0"] - means[q, "1"]) - SOCKET_DISTANCE for q in locations]
        found[split] = {"spread": np.concatenate(off), "distance": np.array(apart)}
    return found


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def run(data: Path, out: Path, seed: int = 0, quick: bool = False) -> dict[str, Any]:
    """The experiment; writes the numbers and the figure into `out`.

    Args:
        data: Folder with nominal_panda.yaml and panda_3.csv.
        out: Folder for the results.
        seed: Of the train rows that `quick` takes.
        quick: Half of the train rows.
    """
    rows = read_rows(data, seed, quick)
    results: dict[str, Any] = {"seed": seed, "quick": quick, "n_rows": len(rows), "ways": {}}
    results |= {"sigma_point": SIGMA_POINT, "sigma_distance": SIGMA_DISTANCE}
    shown: dict[str, dict[str, Floats]] = {}
    for way, words in WAYS.items():
        with TemporaryDirectory() as folder:
            job = fg_calib.read_job(write_job(data, rows, Path(folder), way))
        problem = fg_calib.build_problem(job.robot, job.measurements, model=job.options.model, gauge=job.options.gauge)
        fg_calib.solve(problem)  # once unseen, so that the seconds below are not those of compiling
        solution = fg_calib.solve(problem)
        uncertainty = fg_calib.assess(solution)
        document = fg_calib.result_document(solution, uncertainty)
        n = len(job.robot.parameters)
        robots = {"before": job.robot.with_values(solution.before[:n]), "after": uncertainty.robot}
        judged = {when: judge(robot, job.tables[0].measurements.readings, rows) for when, robot in robots.items()}
        keys = ("n_configurations", "n_pairs", "n_residuals", "dof", "reduced_chi2", "trustworthy", "findings")
        tool = [p["estimate"] for p in document["parameters"] if p["name"] in ("tool.x", "tool.y", "tool.z")]
        results["ways"][way] = {
            "words": words,
            **{key: document[key] for key in keys},
            "rank": document["observability"]["rank"],
            "iterations": document["solver"]["iterations"],
            "seconds": document["solver"]["seconds"],
            "tool": dict(zip("xyz", tool, strict=True)),
            "rms": {
                split: {
                    kind: {when: rms(judged[when][split][kind]) for when in robots} for kind in ("spread", "distance")
                }
                for split in ("train", "test")
            },
        }
        if way == "groups":
            shown = {when: judged[when]["test"] for when in robots}
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{NAME}.json").write_text(json.dumps(results, indent=1) + "\n")
    draw(shown).savefig(out / f"{NAME}.png", dpi=200)
    return results


def draw(shown: dict[str, dict[str, Floats]]) -> Figure:
    """How far the ball centres of unseen locations lie from their group's mean, and the socket distance errors."""
    style = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6}
    with rc_context(style):
        figure = Figure(figsize=(7.0, 2.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        for when, colour in (("before", BEFORE), ("after", AFTER)):
            off = np.sort(shown[when]["spread"]) * 1e3
            share = np.linspace(0.0, 100.0, len(off))
            left.plot(off, share, color=colour, label=f"{when}: RMS {rms(off):.3g} mm")
            apart = shown[when]["distance"] * 1e3
            where = np.arange(len(apart)) + (0.0 if when == "before" else 0.35)
            right.bar(where, apart, 0.33, color=colour, label=f"{when}: RMS {rms(apart):.2g} mm")
        left.set_xscale("log")
        left.set_xlabel("distance of a ball centre from its group's mean [mm]")
        left.set_ylabel("share of unseen touches below [%]")
        left.set_title("(a) Spread of the ball centre", loc="left", fontsize=8, fontweight="bold")
        left.legend(frameon=False)
        right.axhline(0.0, color="black", linewidth=0.6)
        right.set_xticks(np.arange(len(shown["after"]["distance"])) + 0.17, ["back center", "front center"])
        right.set_ylabel("socket distance error [mm]")
        right.set_title("(b) Distance of two sockets", loc="left", fontsize=8, fontweight="bold")
        right.set_ylim(top=1.45 * right.get_ylim()[1])
        right.legend(frameon=False, loc="upper left")
    return figure


def table_of(results: dict[str, Any]) -> str:
    """The table for people: [mm], beside the reference figures."""
    heads = ("spread before", "after", "distance before", "after")
    lines = [f"{'unseen locations, RMS [mm]':36}" + "".join(f"{h:>17}" for h in heads)]
    for way in results["ways"].values():
        kinds = way["rms"]["test"]
        cells = [kinds[kind][when] * 1e3 for kind in ("spread", "distance") for when in ("before", "after")]
        above = cells[1] > REFERENCE["spread"][2] or cells[3] > REFERENCE["distance"][2]
        figures = "".join(f"{c:17.3f}" for c in cells)
        lines.append(f"{way['words']:36}{figures}{'  ABOVE THE LIMIT' if above else ''}")
        lines.append(
            f"    {way['n_configurations']} rows, {way['n_residuals']} residuals, rank {way['rank']},"
            f" reduced chi-square {way['reduced_chi2']:.3f}, {way['iterations']} iterations, {way['seconds']:.2f} s"
        )
    reference = [v for kind in ("spread", "distance") for v in REFERENCE[kind][:2]]
    lines.append(f"{'reference':36}" + "".join(f"{v:17.3f}" for v in reference))
    limits = [v for kind in ("spread", "distance") for v in (None, REFERENCE[kind][2])]
    lines.append(f"{'limit':36}" + "".join(f"{'' if v is None else format(v, '.3f'):>17}" for v in limits))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line; 0 also where the data are missing."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="half of the train rows")
    parser.add_argument("--seed", type=int, default=0, help="of the rows that --quick takes")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the results")
    given = parser.parse_args(arguments)
    data = data_folder()
    if not data.is_dir():
        print("skipped: no folder panda_sockets in FG_CALIB_DATA, which names where the real data are")
        return 0
    print(table_of(run(data, given.out, given.seed, given.quick)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
