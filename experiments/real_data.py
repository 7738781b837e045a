"""Real arms: held-out errors before and after calibration, against independent references.

    FG_CALIB_DATA=FOLDER python experiments/real_data.py [--quick] [--only QUESTION ...]

| question | data | what is fitted |
|---|---|---|
| ur10 | `ur10_tmac`: UR10, laser tracker, 1046 train and 449 test poses | poses, frame and tool unknown |
| ur10_pairs | the same | distance and angle of 3000 random pairs of train poses, no frame; judged on all test pairs |
| blocks | `ur10_tmac`, all rows, in four blocks by a joint's position | each block by itself, noise estimated |
| panda | `panda_sockets`: Panda, a ball put into two sockets 50 mm apart | sockets as `group`, and as pairs tables |

*Before* has the arm at nominal, with frame, tool or ball centre fitted. References are fits by independent numpy code
(README of the data). Test rows are never fitted.

Traps: angles of less than 0.02 rad are left out of the test pairs, as measured angles near 0 are biased. The RMS of
3000 drawn test pairs scatters by 2 % with the seed, that of all test pairs does not. With every pair of a group of n
touches, a sigma sqrt(n) times that of a touch gives each touch its own weight.

Takes a minute. Without the data a question says so and is left out of the record.

References:
    Franzese, Spahn, Kober, Della Santina (2025), MUKCa: Accurate and Affordable Cobot Calibration Without External
    Measurement Devices. arXiv:2503.12584: the Panda's data.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from common import COLOURS, MM, Question, Row, Task, clean, data_folder, rms, run
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib import Calibration, Job, Robot, build_problem, calibrate_job, read_job, solve
from fg_calib.robot import pose

Floats = NDArray[np.float64]

NOISE = {"position": 3e-4, "orientation": 6e-4}
"""What a geometric model leaves of a tracker's poses, 1 sigma, [m] and [rad]."""

LEAST_EIGENVALUE = 1e-3
"""Of the correlation matrix of two blocks' difference: smaller ones are sums that priors and rounding decide."""

SMALL_ANGLE = 0.02
DEG = np.pi / 180.0
UR10_REFERENCE = {"position": 0.469e-3, "orientation": 0.0505 * DEG, "distance": 0.394e-3, "angle": 0.0426 * DEG}
PANDA_REFERENCE = {"spread": 0.210e-3, "distance": 0.026e-3}
SOCKET_DISTANCE = 0.05
SIGMA_POINT, SIGMA_DISTANCE = 1.2e-4, 6e-5
PRIOR = {"xyz": 5e-3, "rpy": 1e-2}


# --- UR10 -----------------------------------------------------------------------------------------------------------


def calibrate_ur10(data: Path, every: int = 1, **settings: Any) -> Calibration:
    """Calibrate the UR10 by a job of every so-manieth train row."""
    header, *rows = (data / "series_b.csv").read_text().splitlines()
    train, test = ([row for row in rows if row.endswith(split)] for split in (",train", ",test"))
    with TemporaryDirectory() as folder:
        job = Path(folder) / "calibration.yaml"
        (job.parent / "poses.csv").write_text("\n".join([header, *train[::every], *test]) + "\n")
        robot = str(data / "robot.yaml")
        job.write_text(yaml.safe_dump({"robot": robot, "measurements": "poses.csv", "noise": NOISE, **settings}))
        return calibrate_job(job)


def fit_result(calibration: Calibration) -> Row:
    """What the ledger shows of a fit."""
    result = calibration.result
    return {
        "reduced chi-square": result.reduced_chi2,
        "iterations": result.solver.iterations,
        "seconds": result.solver.seconds,
        "good": not calibration.assessment.verdict.errors,
    }


def ur10_poses(task: Task) -> Row:
    """Position and orientation errors of the test poses, RMS of their norms, [m] and [rad]."""
    _, every = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    found = calibrate_ur10(data, every, model="pose", frame="unknown")
    table = found.assessment.fit.residuals
    row = fit_result(found)
    for kind in ("position", "orientation"):
        chosen = table.test & (table.family == table.families.index(kind))
        for when in ("before", "after"):
            norms = np.linalg.norm(getattr(table, when)[chosen].reshape(-1, 3), axis=1)
            row |= {f"{kind} {when}": rms(norms), f"{kind} {when}, norms": norms.tolist()}
    return row


def ur10_pairs(task: Task) -> Row:
    """Distance and angle errors of all test pairs, and position errors after the best rigid fit, RMS, [m] and [rad]."""
    _, every = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    found = calibrate_ur10(data, every, model="distance-rotation", pairing={"random": 3000 // every, "seed": 0})
    solution = found.solution
    m = solution.problem.measurements
    row = fit_result(found)
    before = solution.problem.robot.with_values(solution.before[: len(solution.problem.robot.parameters)])
    for when, robot in (("before", before), ("after", solution.robot)):
        at = pose(robot, m.readings)
        errors = pair_errors(at, m)
        row |= {f"{kind} {when}": rms(e) for kind, e in errors.items()}
        row[f"position {when}"] = rms(after_rigid_fit(at.position, m.position, m.test))
    return row


def pair_errors(at: Any, m: Any) -> dict[str, Floats]:
    """Predicted minus measured distance and angle of every pair of test rows, [m] and [rad]."""
    a, b = np.triu_indices(int(m.test.sum()), 1)

    def between(position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        turned = Rotation.from_matrix(rotation)
        return np.linalg.norm(position[b] - position[a], axis=1), (turned[a].inv() * turned[b]).magnitude()

    d, phi = between(at.position[m.test], at.rotation[m.test])
    d_measured, phi_measured = between(m.position[m.test], m.rotation[m.test])
    return {"distance": d - d_measured, "angle": (phi - phi_measured)[phi_measured > SMALL_ANGLE]}


def after_rigid_fit(predicted: Floats, measured: Floats, test: NDArray[np.bool_]) -> Floats:
    """Errors of test positions after the rigid fit of the train rows, shape (n,), [m]."""
    here, there = predicted[~test].mean(axis=0), measured[~test].mean(axis=0)
    R, _ = Rotation.align_vectors(measured[~test] - there, predicted[~test] - here)
    miss: Floats = np.linalg.norm(there + R.apply(predicted - here) - measured, axis=1)[test]
    return miss


def ur10_answer(found: Row) -> str:
    """Errors before and after of whatever kinds there are."""
    if not found:
        return "the data are missing"
    units = {"position": (MM, "mm"), "distance": (MM, "mm"), "orientation": (DEG, "deg"), "angle": (DEG, "deg")}
    cells = []
    for kind, (unit, name) in units.items():
        if f"{kind} after" in found:
            before, after = (found[f"{kind} {when}"] / unit for when in ("before", "after"))
            cells.append(f"{kind} {before:.3g} -> {after:.3g} {name} (reference {UR10_REFERENCE[kind] / unit:.3g})")
    return f"Yes: {', '.join(cells)}; reduced chi-square {found['reduced chi-square']:.2f}"


def draw_ur10(found: Row, path: Path) -> None:
    """Draw the distribution of test errors before and after."""
    if not found:
        return
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, (kind, unit, name) in zip(
        figure.subplots(1, 2), (("position", MM, "mm"), ("orientation", DEG, "deg")), strict=True
    ):
        for when, colour in (("before", COLOURS[4]), ("after", COLOURS[0])):
            norms = np.array(found[f"{kind} {when}, norms"]) / unit
            bins = np.linspace(0.0, np.quantile(found[f"{kind} before, norms"], 0.998) / unit, 40)
            axes.hist(norms, bins, color=colour, alpha=0.6, label=f"{when}: RMS {rms(norms):.3g} {name}")
        axes.set(xlabel=f"{kind} error of test poses [{name}]", ylabel="test poses")
        axes.legend(frameon=False)
        clean(axes)
    figure.suptitle("A real UR10 by a laser tracker, poses that were not fitted: geometry before and after calibration")
    figure.savefig(path, dpi=120)


def blocks(task: Task) -> Row:
    """RMS z of the differences between four blocks of rows by a joint, in well-determined combinations of parameters.

    *Noise alone* is by the covariance before it grows by what regions of joint space disagree.
    """
    (joint,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    header, *rows = (data / "series_b.csv").read_text().splitlines()
    at = np.array([float(row.split(",")[header.split(",").index(joint)]) for row in rows])
    found = []
    for block in np.array_split(np.argsort(at), 4):
        with TemporaryDirectory() as folder:
            job = Path(folder) / "calibration.yaml"
            kept = [rows[i].replace(",test", ",train") for i in sorted(block)]
            (job.parent / "poses.csv").write_text("\n".join([header, *kept]) + "\n")
            given = {"robot": str(data / "robot.yaml"), "measurements": "poses.csv", "noise": "estimate"}
            job.write_text(yaml.safe_dump(given | {"model": "pose", "frame": "unknown"}))
            found.append(calibrate_job(job))
    squares: dict[str, list[float]] = {"noise alone": [], "said": []}
    for a, b in combinations(found, 2):
        off = np.array([a.parameters[name].estimate - b.parameters[name].estimate for name in a.assessment.names])
        for who, each in squares.items():
            shares = (1.0 if who == "said" else one.assessment.verdict.variance for one in (a, b))
            C = sum(one.covariance() / share for one, share in zip((a, b), shares, strict=True))
            scale = np.sqrt(np.diag(C))
            values, V = np.linalg.eigh(C / np.outer(scale, scale))
            known = values > LEAST_EIGENVALUE
            each.append(float(np.mean((V.T @ (off / scale))[known] ** 2 / values[known])))
    return {who: float(np.sqrt(np.mean(each))) for who, each in squares.items()}


def blocks_answer(found: Row) -> str:
    """RMS z by noise alone, and as it is said, by joint."""
    cells = [f"{joint} {row['noise alone']:.2f} -> {row['said']:.2f}" for joint, row in found.items()]
    text = (
        "As far as their sigmas say: RMS z between four blocks by a joint, by noise alone -> with systematic residuals"
    )
    return f"{text}: {', '.join(cells)}" if cells else "the data are missing"


# --- Panda ----------------------------------------------------------------------------------------------------------

WAYS = {"group": "column group", "all": "every pair of a group", "chain": "each with the next", "star": "one with each"}


def write_panda_job(data: Path, rows: list[dict[str, str]], folder: Path, way: str) -> Path:
    """Write URDF, tables and job of one way to say which configurations touch the same point."""
    nominal = yaml.safe_load((data / "nominal_panda.yaml").read_text())
    write_urdf(nominal, folder / "panda.urdf")
    kinds = {"x": "xyz", "y": "xyz", "z": "xyz", "roll": "rpy", "pitch": "rpy", "yaw": "rpy"}
    robot = {
        **{"urdf": "panda.urdf", "base_link": "base", "tip_link": "flange", "tool": {"z": 0.03}},
        "estimate": ["tool.x", "tool.y", "tool.z"],
        "tolerance": {f"{j['name']}.{k}": PRIOR[kinds[k]] for j in nominal["joints"] for k in kinds},
    }
    joints, grouped = [f"q{k}" for k in range(1, 8)], way == "group"
    with (folder / "touches.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow([*joints, "split", *(["group"] if grouped else [])])
        for row in rows:
            group = [f"{row['location']}/{row['socket']}"] if grouped else []
            out.writerow([*(row[q] for q in joints), row["split"], *group])
    with (folder / "pairs.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["a", "b", "distance", "sigma_distance"])
        out.writerows(pairs_of(groups_of(rows), way))
    job = {"robot": robot, "model": "distance", "noise": {"point": SIGMA_POINT}}
    (folder / "job.yaml").write_text(yaml.safe_dump(job | {"measurements": "touches.csv", "pairs": "pairs.csv"}))
    return folder / "job.yaml"


def panda_job(data: Path, way: str) -> tuple[Job, list[dict[str, str]]]:
    """The job of one way, and the rows of its table."""
    with (data / "panda_3.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with TemporaryDirectory() as folder:
        return read_job(write_panda_job(data, rows, Path(folder), way)), rows


def write_urdf(nominal: Row, path: Path) -> None:
    """Write the nominal arm as a URDF, which has the convention of its table."""
    end = {"name": "flange", "type": "fixed", "axis": [0, 0, 1]}
    end |= {f"origin_{k}": nominal["flange"][k] for k in ("xyz", "rpy")}
    lines, parent = ['<robot name="panda">', '  <link name="base"/>'], "base"
    for joint in (*nominal["joints"], end):
        child = "flange" if joint is end else f"{joint['name']}_link"
        kind = "continuous" if joint["type"] == "revolute" else joint["type"]
        xyz, rpy, axis = (" ".join(map(repr, map(float, joint[k]))) for k in ("origin_xyz", "origin_rpy", "axis"))
        lines += [
            f'  <link name="{child}"/>',
            f'  <joint name="{joint["name"]}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>',
            f'    <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/></joint>',
        ]
        parent = child
    path.write_text("\n".join([*lines, "</robot>"]) + "\n")


def groups_of(rows: list[dict[str, str]]) -> dict[tuple[str, str], list[int]]:
    """Row numbers by location and socket."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row["location"], row["socket"]), []).append(i)
    return groups


def pairs_of(groups: dict[tuple[str, str], list[int]], way: str) -> list[tuple[Any, Any, float, float]]:
    """Pairs (a, b, distance, sigma) of configurations, or of groups."""
    places = sorted({location for location, _ in groups})
    if way == "group":
        return [(f"{p}/0", f"{p}/1", SOCKET_DISTANCE, SIGMA_DISTANCE) for p in places]
    table: list[tuple[Any, Any, float, float]] = []
    for rows in groups.values():
        every = [(a, b) for i, a in enumerate(rows) for b in rows[i + 1 :]]
        chosen = {"all": every, "chain": list(pairwise(rows)), "star": [(rows[0], b) for b in rows[1:]]}[way]
        table += [(a, b, 0.0, SIGMA_POINT * np.sqrt(len(rows) if way == "all" else 2)) for a, b in chosen]
    for p in places:
        one, other = groups[p, "0"], groups[p, "1"]
        chosen = [(a, b) for a in one for b in other] if way == "all" else list(zip(one, other, strict=False))
        sigma = (
            SIGMA_DISTANCE * np.sqrt(len(chosen))
            if way == "all"
            else np.hypot(np.sqrt(2) * SIGMA_POINT, SIGMA_DISTANCE)
        )
        table += [(a, b, SOCKET_DISTANCE, float(sigma)) for a, b in chosen]
    return table


def judge_sockets(robot: Robot, readings: Floats, rows: list[dict[str, str]]) -> dict[str, Floats]:
    """Distances of ball centres from their group's mean, and socket distance errors, of test locations, [m]."""
    p = pose(robot, readings).position
    groups = {name: i for name, i in groups_of(rows).items() if rows[i[0]]["split"] == "test"}
    means = {name: p[i].mean(axis=0) for name, i in groups.items()}
    off = [np.linalg.norm(p[i] - means[name], axis=1) for name, i in groups.items()]
    apart = [np.linalg.norm(means[q, "0"] - means[q, "1"]) - SOCKET_DISTANCE for q in sorted({q for q, _ in groups})]
    return {"spread": np.concatenate(off), "distance": np.array(apart)}


def panda(task: Task) -> Row:
    """Spread of the ball centre and socket distance error at unseen locations, RMS, [m]."""
    (way,) = task
    data = data_folder("panda_sockets")
    if data is None:
        return {}
    job, rows = panda_job(data, way)
    solution = solve(build_problem(job.robot, job.tables, job.options))
    before = job.robot.with_values(solution.before[: len(job.robot.parameters)])
    row: Row = {"iterations": solution.iterations, "converged": solution.converged}
    for when, robot in (("before", before), ("after", solution.robot)):
        judged = judge_sockets(robot, job.tables[0].measurements.readings, rows)
        row |= {f"{kind} {when}": rms(e) for kind, e in judged.items()}
    return row


def by_name(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by the name of their task; none without the data."""
    return {name: row for (name,), row in zip(tasks, rows, strict=True) if row}


def panda_answer(found: Row) -> str:
    """Errors before and after by groups, and of the other ways after."""
    if not found:
        return "the data are missing"
    row = found["group"]
    cells = [
        f"{kind} {row[f'{kind} before'] / MM:.3g} -> {row[f'{kind} after'] / MM:.3g} mm"
        f" (reference {PANDA_REFERENCE[kind] / MM:.3g})"
        for kind in PANDA_REFERENCE
    ]
    others = ", ".join(f"{WAYS[way]} {of['spread after'] / MM:.3f}" for way, of in found.items() if way != "group")
    return f"Yes, without any instrument: {', '.join(cells)}; as pairs tables the spread is {others} mm"


QUESTIONS = (
    Question("ur10", "Does it calibrate a real UR10 by a laser tracker?", lambda n, s: [("pose", 1)], ur10_poses,
             lambda tasks, rows: rows[0], ur10_answer, figure=draw_ur10),
    Question("ur10_pairs", "And from distances and angles alone, without any frame?", lambda n, s: [("pairs", n)],
             ur10_pairs, lambda tasks, rows: rows[0], ur10_answer, (1, 3)),
    Question("blocks", "Do calibrations of parts of a real arm's rows agree?",
             lambda n, s: [("q1",), ("q2",), ("q3",)], blocks, by_name, blocks_answer),
    Question("panda", "Does a ball in two sockets calibrate a real Panda?", lambda n, s: [(way,) for way in WAYS],
             panda, by_name, panda_answer),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
