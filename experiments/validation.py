"""Simulated calibrations against their truth: are sigmas honest, and is what is said of the arm true?

    python experiments/validation.py [--quick] [--only QUESTION ...] [--draws N] [--workers 2]

One loop for all questions: a cell is a scenario (the format of `fg-calib simulate`) and options of a calibration; a
draw simulates it (true errors from the priors, frame, landmarks and noise anew), calibrates, and compares with
the truth.

| question | cells |
|---|---|
| honesty | three arms by {pose, frame known and unknown, star of poses, direct pairs}, encoders exact and noisy |
| short | chains of steps of 2 to 40 sigma, and stars; with priors ten times as wide too |
| landmarks | targets, wires, planes, a board, its pixels, sockets; encoders exact and noisy |
| instruments | which instrument for how many poses: error of the tool at 10 to 80 poses |
| anchors | lengths to three unknown anchors without priors, over the Cramer-Rao bound |
| outliers | 10 and 30 % of rows wrong by up to 50 sigma, by loss, over the fit without them |
| monitoring | `check` of healthy arms and of slipped joints, `update` against a calibration of all rows |

Values: NEES, e^T C^-1 e over the number of parameters, 1 where the covariance is true, with 99 % bounds by chance;
share of errors within 1.96 sigma; RMS error of the tool point after the best rigid fit over what the covariance
expects, and over the Cramer-Rao bound; Kolmogorov-Smirnov p-value of chi-square; share of draws with a warning.

Traps: seeds draw true errors by parameter name, so that another parameter does not change the others. A cell's
configurations are those of its seed, so draws differ in configurations too. In `short` honesty is lost where lengths
are of unknown sign within the priors; there a warning has to fire in every draw.

Takes two hours with two workers.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from common import COLOURS, MM, Question, Row, Task, by_cell, clean, rms, run
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from fg_calib import (
    CalibrationError,
    Measurements,
    Robot,
    Scenario,
    Table,
    assess,
    build_problem,
    calibrate,
    simulate,
    solve,
)
from fg_calib.observability.cramer_rao import cramer_rao
from fg_calib.robot import pose
from fg_calib.simulation import read_scenario

Floats = NDArray[np.float64]
Cell = Mapping[str, Any]

MRAD = float(np.rad2deg(1e-3))
ENCODERS = {"exact": {}, "noisy": {"joint": 0.005}}
"""1 sigma of joint readings, [deg]; of a prismatic joint in the unit of length."""

HAYATI = {"alpha": MRAD, "theta": MRAD, "beta": MRAD, "a": 0.001, "d": 0.001}
UR10_ROWS = [(0, 0, 0.1273), (0, 90, 0), (-0.612, 0, 0), (-0.5723, 0, 0.163941), (0, 90, 0.1157), (0, -90, 0.0922)]
SCARA_ROWS = [(0, 0, 0.35, 130), (0.325, 0, 0, 145), (0.275, 180, 0.05, 0.2), (0, 0, 0.1, 180)]
ARMS: Mapping[str, Any] = {
    "space robot": None,  # of the shipped scenario
    "UR10": {
        "name": "UR10",
        "joints": [{"a": a, "alpha": alpha, "d": d, "theta": 0, "beta": 0, "limits": [-180, 180]}
                   for a, alpha, d in UR10_ROWS],
        "tool": {"z": 0.1},
    },
    "SCARA": {
        "name": "SCARA",
        "joints": [{"a": a, "alpha": alpha, "d": d, "theta": 0, "beta": 0,
                    **({"type": "prismatic", "limits": [0, most]} if k == 2 else {"limits": [-most, most]})}
                   for k, (a, alpha, d, most) in enumerate(SCARA_ROWS)],
    },
}  # fmt: skip
"""a [m], alpha [deg], d [m]: the makers' values; modified DH with Hayati's angle."""

FAR_NOISE = {"position": 1e-4, "orientation": 0.006, "distance": 1.4e-4, "angle": 0.0085, "point": 1e-4, "pixel": 0.1}
VIEWS = {"board": {"pose": {"x": 0.6, "y": -0.4, "z": -0.5}, "height": 0.4, "distance": [0.3, 0.55], "cone": 45}}
CAMERA = {"fx": 1200, "fy": 1200, "cx": 960, "cy": 600, "k1": -0.05, "k2": 0.01}
CORNERS = {"columns": 8, "rows": 6, "square": 0.03}
N_TOOL = 40
"""Configurations at which the tool is judged, drawn once an arm."""

BOUND_EVERY = 5
"""The Cramer-Rao bound of every so-manieth draw stands for all."""

Z95 = float(stats.norm.ppf(0.975))


# --- one draw -------------------------------------------------------------------------------------------------------


@cache
def scenario_of(question: str, cell: str) -> Scenario:
    """Read the scenario of a cell, through the files that a user would write."""
    given: dict[str, Any] = dict(CELLS[question][cell])
    arm, scale = given["arm"], given.get("prior", 1.0)
    document: dict[str, Any] = {
        "units": {"length": "m", "angle": "deg"},
        "errors": {"normal": "tolerance"},
        "noise": FAR_NOISE | given.get("noise", {}),
        "configurations": given.get("configurations", {"random": {"count": 40}}),
        "instruments": given["instruments"],
    }
    with TemporaryDirectory() as folder:
        robot = Path(folder) / "robot.yaml"
        if ARMS[arm] is None:
            scenario = read_scenario("space-robot")
            document["robot"] = "space-robot"
            from fg_calib.io import write_robot

            write_robot(robot, with_priors(scenario.robot))
        else:
            tolerance = {kind: scale * sigma for kind, sigma in HAYATI.items()}
            text = {"convention": "mdh-hayati", "units": document["units"], "tolerance": tolerance}
            robot.write_text(yaml.safe_dump(text | ARMS[arm]))
        (robot.parent / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
        if "table" in document["configurations"]:
            q = document["configurations"]["table"]
            header = ",".join(f"q{k + 1}" for k in range(q.shape[1]))
            np.savetxt(robot.parent / "q.csv", np.rad2deg(q), delimiter=",", header=header, comments="")
            document["configurations"] = {"table": "q.csv"}
        file = robot.parent / "scenario.yaml"
        file.write_text(yaml.safe_dump(document | {"robot": "robot.yaml"}))
        return read_scenario(file)


def with_priors(robot: Robot) -> Robot:
    """The paper's arm with priors of 1 sigma of Table 6's uniform bounds."""
    sizes = {"m": 0.01 / np.sqrt(3.0), "rad": np.deg2rad(0.05) / np.sqrt(3.0)}
    return replace(
        robot,
        parameters=tuple(replace(p, tolerance=sizes[p.unit]) if p.estimated else p for p in robot.parameters),
    )


@cache
def judged_at(question: str, cell: str) -> Floats:
    """Configurations at which the tool is judged, shape (N_TOOL, n_joints), [rad] (prismatic: [m])."""
    robot = scenario_of(question, cell).robot
    lower, upper = np.clip(robot.limits, -np.pi, np.pi).T
    return np.random.default_rng(7).uniform(lower, upper, (N_TOOL, len(lower)))


def tool_derivative(robot: Robot, names: Sequence[str], q: Floats) -> Floats:
    """Central differences of the tool positions in some parameters, shape (n, 3, n_parameters), [m/rad or m/m]."""
    out = np.empty((len(q), 3, len(names)))
    for k, name in enumerate(names):
        ends = []
        for step in (1e-6, -1e-6):
            values = robot.nominal.copy()
            values[robot.index(name)] += step
            ends.append(pose(robot.with_values(values), q).position)
        out[:, :, k] = (ends[0] - ends[1]) / 2e-6
    return out


def without_rigid_motion(at: Floats, rows: Floats) -> Floats:
    """Vectors at points, the least-squares rigid motion of all points taken out.

    Args:
        at: Points, shape (n, 3).
        rows: Vectors, shape (n, 3, k).
    """
    x = at - at.mean(axis=0)
    turn = np.cross(np.eye(3)[None], x[:, None]).transpose(0, 2, 1)  # (n, 3, 3): w x p for unit w
    A = np.concatenate([np.broadcast_to(np.eye(3), (len(x), 3, 3)), turn], axis=2).reshape(-1, 6)
    flat = rows.reshape(len(A), -1)
    return (flat - A @ np.linalg.lstsq(A, flat, rcond=None)[0]).reshape(rows.shape)


def draw(task: Task) -> Row:
    """Simulate and calibrate one draw of a cell of a question, and compare with the truth."""
    cell, question, seed = task
    options = CELLS[question][cell].get("options", {})
    simulation = simulate(scenario_of(question, cell), seed)
    true, q = simulation.true_robot, judged_at(question, cell)
    try:
        solution = solve(build_problem(simulation.robot, simulation.tables, **options))
    except CalibrationError:
        return {"solved": False}
    found = assess(solution)
    names, C = list(found.names), found.covariance
    known = np.isfinite(np.diag(C))
    names, C = [n for n, k in zip(names, known, strict=True) if k], C[np.ix_(known, known)]
    columns = [true.index(name) for name in names]
    error, sigma = found.robot.nominal[columns] - true.nominal[columns], np.sqrt(np.diag(C))
    at = pose(true, q).position
    off = without_rigid_motion(at, (pose(found.robot, q).position - at)[:, :, None])
    J = without_rigid_motion(at, tool_derivative(found.robot, names, q)).reshape(-1, len(names))
    row: Row = {
        "solved": True,
        "converged": solution.converged,
        "n": len(names),
        "nees": float((error / sigma) @ np.linalg.solve(C / np.outer(sigma, sigma), error / sigma)),
        "covered": float(np.mean(np.abs(error) < Z95 * sigma)),
        "tool": float(3.0 * np.mean(off**2)),
        "tool expected": float(3.0 * np.mean(np.einsum("ij,jk,ik->i", J, C, J))),
        "p": float(stats.chi2.sf(found.fit.chi_square.value, found.fit.chi_square.dof)),
        "good": not found.verdict.errors,
        "warned": bool(found.verdict.errors or found.verdict.warnings),
    }
    if seed % BOUND_EVERY == 0:
        of_bound = {key: value for key, value in options.items() if key != "gauge"}
        bound = cramer_rao(true, simulation.tables, prior=options.get("gauge", "prior") == "prior", **of_bound)
        row["bound"] = bound.position(q, fitted=True) ** 2
    return row


def draws(question: str) -> Any:
    """Tasks of all cells of a question."""
    return lambda n, first: [(cell, question, first + k) for cell in CELLS[question] for k in range(n)]


def summarise(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """NEES with its bounds, coverage, tool errors, and shares of draws, by cell."""
    found: Row = {}
    cells: dict[str, list[Row]] = {}
    for (cell, *_), row in zip(tasks, rows, strict=True):
        cells.setdefault(cell, []).append(row)
    for cell, all_rows in cells.items():
        of = [row for row in all_rows if row["solved"]]
        k = sum(row["n"] for row in of)
        tool, expected = (np.array([row[key] for row in of]) for key in ("tool", "tool expected"))
        bounds = [row["bound"] for row in of if "bound" in row]
        found[cell] = {
            "draws": len(all_rows),
            "not solved": len(all_rows) - len(of),
            "not converged": sum(not row["converged"] for row in of),
            "nees": sum(row["nees"] for row in of) / k,
            "nees without warning": mean_nees([row for row in of if not row["warned"]]),
            "bounds": (stats.chi2.ppf([0.005, 0.995], k) / k).tolist(),
            "covered": float(np.mean([row["covered"] for row in of])),
            "tool mm": rms(np.sqrt(tool)) / MM,
            "tool over expected": float(np.sqrt(tool.mean() / expected.mean())),
            "tool over bound": float(np.sqrt(tool.mean() / np.mean(bounds))) if bounds else None,
            "chi-square p": float(stats.kstest([row["p"] for row in of], "uniform").pvalue),
            "good": float(np.mean([row["good"] for row in of])),
            "warned": float(np.mean([row["warned"] for row in of])),
        }
    return found


def honest(cell: Row) -> bool:
    """Whether NEES is within its bounds."""
    low, high = cell["bounds"]
    return bool(low <= cell["nees"] <= high)


def honesty_answer(found: Row) -> str:
    """How many cells are honest, and the ranges of NEES, coverage and tool errors."""
    nees, covered, tool = ([cell[key] for cell in found.values()] for key in ("nees", "covered", "tool over expected"))
    good = sum(map(honest, found.values()))
    n_draws = next(iter(found.values()))["draws"]
    return (
        f"{good} of {len(found)} cells of {n_draws} draws are within the 99 % bounds of NEES; NEES {min(nees):.2f} to "
        f"{max(nees):.2f}, coverage of 95 % intervals {min(covered):.1%} to {max(covered):.1%}, tool error over "
        f"expected {min(tool):.2f} to {max(tool):.2f}"
    )


def mean_nees(rows: Sequence[Row]) -> float | None:
    """NEES over draws, each parameter counted once; None without draws."""
    return sum(row["nees"] for row in rows) / sum(row["n"] for row in rows) if rows else None


def warned_answer(found: Row) -> str:
    """Which cells are outside the bounds, in what share of their draws a warning fires, and NEES of the other draws."""
    bad = {cell: row for cell, row in found.items() if not honest(row)}
    others = {c: f", the others {one:.2f}" if (one := row["nees without warning"]) else "" for c, row in bad.items()}
    names = "; ".join(
        f"{cell}: NEES {row['nees']:.2f}, warned {row['warned']:.0%}{others[cell]}" for cell, row in bad.items()
    )
    return f"{honesty_answer(found)}. Not within: {names or 'none'}"


# --- cells ----------------------------------------------------------------------------------------------------------


def honesty_cells() -> dict[str, Cell]:
    """Three arms by four kinds of measurement, encoders exact and noisy."""
    ways = {
        "pose, frame known": {"model": "pose", "frame": "base"},
        "pose, frame unknown": {"model": "pose", "frame": "unknown"},
        "star of poses": {"model": "distance-rotation", "pairing": "star"},
        "direct pairs": {"model": "distance-rotation", "pairs": {"random": 60}},
    }
    return {
        f"{arm}, {way}, {encoder} encoders": {"arm": arm, "noise": noise, "instruments": [instrument]}
        for arm in ARMS for way, instrument in ways.items() for encoder, noise in ENCODERS.items()
    }  # fmt: skip


def steps(ratio: float, sigma: float, turn: bool, n: int = 120) -> Floats:
    """Configurations along a smooth path, each next one `ratio` sigma of distance (or angle) away, [rad]."""
    scenario = scenario_of("honesty", "UR10, pose, frame known, exact encoders")
    time = np.linspace(0.0, 40.0, 400_000)[:, None]
    path = 0.9 * np.sin(0.05 * time * np.array([1.0, 1.3, 1.7, 2.1, 2.3, 2.9]) + np.arange(6.0))
    at = pose(scenario.robot, path)
    if turn:
        step = Rotation.from_matrix(np.swapaxes(at.rotation[:-1], 1, 2) @ at.rotation[1:]).magnitude()
    else:
        step = np.linalg.norm(np.diff(at.position, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(step)])
    chosen = np.searchsorted(length, np.arange(n) * ratio * np.sqrt(2.0) * sigma)
    return path[np.minimum(chosen, len(path) - 1)]


@cache
def short_cells() -> dict[str, Cell]:
    """Chains of short steps, and priors ten times as wide."""
    cells: dict[str, Cell] = {}
    for what, sigma in (("distance", 1e-3), ("rotation", np.deg2rad(0.06))):
        for ratio in (2.0, 4.0, 10.0, 40.0):
            for prior in (1.0, 10.0):
                cells[f"{what}, chain of {ratio:g} sigma, prior x {prior:g}"] = {
                    "arm": "UR10", "prior": prior, "noise": {"position": 1e-3, "orientation": 0.06},
                    "configurations": {"table": steps(ratio, sigma, what == "rotation")},
                    "instruments": [{"model": what, "pairing": "chain"}],
                }  # fmt: skip
    for arm in ("UR10", "SCARA"):
        for prior in (1.0, 10.0):
            cells[f"{arm}, star of poses, prior x {prior:g}"] = {
                "arm": arm, "prior": prior, "instruments": [{"model": "distance-rotation", "pairing": "star"}]
            }  # fmt: skip
    return cells


LANDMARKS: Mapping[str, Any] = {
    "targets": {"model": "position", "targets": 3, "stations": 2},
    "wires": {"model": "anchor", "anchors": 3, "offset": 0.12},
    "planes": {"model": "plane", "planes": 3},
    "board": {"model": "board", "configurations": VIEWS | {"board": VIEWS["board"] | {"count": 29}}},
    "pixels": {"model": "pixels", "camera": "camera.yaml", "corners": CORNERS,
               "configurations": VIEWS | {"board": VIEWS["board"] | {"count": 29}}},
    "sockets": {"model": "distance", "sockets": 4},
}  # fmt: skip
LANDMARK_NOISE = {"position": 5e-5, "orientation": 0.01, "distance": 5e-5, "point": 1e-4, "pixel": 0.1}


def landmark_cells() -> dict[str, Cell]:
    """Every instrument with landmarks, encoders exact and noisy."""
    return {
        f"{way}, {encoder} encoders": {"arm": "UR10", "noise": LANDMARK_NOISE | noise, "instruments": [instrument]}
        for way, instrument in LANDMARKS.items() for encoder, noise in ENCODERS.items()
    }  # fmt: skip


PLATE = {
    f"r{k}": {"x": x, "y": y, "z": 0.0, "tolerance": 2e-5} for k, (x, y) in enumerate(((0, 0), (0.1, 0), (0, 0.1)))
}
INSTRUMENTS: Mapping[str, tuple[Any, Any]] = {
    "tracker, 1 target": ({"model": "position"}, {"position": 3e-5}),
    "tracker, 3 targets": ({"model": "position", "targets": PLATE}, {"position": 3e-5}),
    "wire": ({"model": "anchor", "anchors": 3, "offset": 0.15}, {"distance": 5e-5}),
    "planes": ({"model": "plane", "planes": 3, "contact": True}, {"distance": 2e-5}),
    "board": ({"model": "board"}, {"position": 1e-4, "orientation": 0.02}),
    "pixels": ({"model": "pixels", "camera": "camera.yaml", "corners": CORNERS}, {"pixel": 0.1}),
    "sockets": ({"model": "distance", "sockets": 4}, {"point": 5e-5, "distance": 1e-5}),
}
POSES = (10, 20, 40, 80)


def instrument_cells() -> dict[str, Cell]:
    """Every instrument at some numbers of poses."""
    return {
        f"{way}, {n} poses": {
            "arm": "UR10", "noise": noise | {"joint": 0.002}, "instruments": [instrument],
            "configurations": VIEWS | {"board": VIEWS["board"] | {"count": n - 1}} if way in ("board", "pixels")
            else {"random": {"count": n}},
        }
        for way, (instrument, noise) in INSTRUMENTS.items() for n in POSES
    }  # fmt: skip


def instruments_answer(found: Row) -> str:
    """Tool errors by instrument at each number of poses, [mm]."""
    cells = [
        f"{way} " + " / ".join(f"{found[f'{way}, {n} poses']['tool mm']:.3f}" for n in POSES) for way in INSTRUMENTS
    ]
    return f"RMS tool error, mm, at {' / '.join(map(str, POSES))} poses: {', '.join(cells)}"


def draw_instruments(found: Row, path: Path) -> None:
    """Draw the tool error of every instrument over the number of poses."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.subplots()
    for way, marker, colour in zip(INSTRUMENTS, "osD^vP*", (*COLOURS, "0.3"), strict=True):
        axes.loglog(
            POSES, [found[f"{way}, {n} poses"]["tool mm"] for n in POSES], marker + "-", color=colour, label=way
        )
    axes.set(xlabel="poses measured", ylabel="tool error after calibration, RMS [mm]")
    axes.set_xticks(POSES, map(str, POSES), minor=False)
    axes.minorticks_off()
    axes.set_title("A simulated UR10: accuracy by instrument and number of poses", loc="left", fontsize=11)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    clean(axes)
    figure.savefig(path, dpi=110)


def anchor_cells() -> dict[str, Cell]:
    """Forty lengths to each of three unknown anchors, without priors on the arm and with them."""
    return {
        f"{gauge}, {encoder} encoders": {
            "arm": "UR10", "noise": {"distance": 5e-5} | noise, "configurations": {"random": {"count": 120}},
            "instruments": [{"model": "anchor", "anchors": 3}], "options": {"gauge": gauge},
        }
        for gauge in ("keep", "prior") for encoder, noise in ENCODERS.items()
    }  # fmt: skip


def anchors_answer(found: Row) -> str:
    """Tool error over the Cramer-Rao bound with priors, and NEES."""
    cells = ", ".join(
        f"{cell}: NEES {row['nees']:.2f}"
        + (f", {row['tool over bound']:.2f} times the bound" if "prior" in cell else "")
        for cell, row in found.items()
    )
    return f"Lengths to three unknown anchors: {cells}"


# --- outliers, monitoring, prior scales -----------------------------------------------------------------------------

LOSSES = ("none", "huber", "cauchy", "geman-mcclure", "gnc")
OUTLIER_WAYS = {
    "pose": {"model": "pose", "frame": "unknown"},
    "star": {"model": "distance-rotation", "pairing": "star"},
    "random pairs": {"model": "distance-rotation", "pairing": {"random": 80, "seed": 0}},
}


def outlier_cells() -> dict[str, Cell]:
    """Poses and formed pairs of a UR10, by share of wrong configurations."""
    return {
        f"{way}, {share:.0%} wrong": {"arm": "UR10", "instruments": [instrument], "share": share}
        for way, instrument in OUTLIER_WAYS.items() for share in (0.1, 0.3)
    }  # fmt: skip


def spoil(rows: Measurements, share: float, rng: np.random.Generator) -> tuple[Measurements, Floats]:
    """Make a share of the poses wrong by up to 50 sigma in each component, never the first; and which are right."""
    bad = 1 + rng.permutation(rows.n_configurations - 1)[: round(share * rows.n_configurations)]
    position, rotation = rows.position.copy(), rows.rotation.copy()
    position[bad] += rng.uniform(-50.0, 50.0, (len(bad), 3)) * rows.sigma_position[bad]
    turn = rng.uniform(-50.0, 50.0, (len(bad), 3)) * rows.sigma_orientation[bad]
    rotation[bad] = rotation[bad] @ Rotation.from_rotvec(turn).as_matrix()
    right = np.setdiff1d(np.arange(rows.n_configurations), bad)
    return replace(rows, position=position, rotation=rotation), right


def outlier_draw(task: Task) -> Row:
    """Squared tool error of every loss over that of least squares without the wrong rows."""
    cell, seed = task
    simulation = simulate(scenario_of("outliers", cell), seed)
    table, q = simulation.tables[0], judged_at("outliers", cell)
    wrong, right = spoil(table.measurements, CELLS["outliers"][cell]["share"], np.random.default_rng([seed, 9]))
    at = pose(simulation.true_robot, q).position

    def error(rows: Measurements, loss: str) -> float:
        solution = solve(build_problem(simulation.robot, replace(table, measurements=rows), loss=loss))
        off = (pose(solution.robot, q).position - at)[:, :, None]
        return float(3.0 * np.mean(without_rigid_motion(at, off) ** 2))

    return {"clean": error(table.measurements.select(right), "none")} | {loss: error(wrong, loss) for loss in LOSSES}


def outlier_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """RMS errors over the clean fit's by cell and loss."""
    return {
        cell: {loss: float(np.sqrt(np.mean(of[loss]) / np.mean(of["clean"]))) for loss in LOSSES}
        for cell, of in by_cell(tasks, rows).items()
    }


def outlier_answer(found: Row) -> str:
    """Error over the clean fit without a loss, with huber and with gnc."""
    cells = [f"{cell}: {row['none']:.1f} / {row['huber']:.2f} / {row['gnc']:.2f}" for cell, row in found.items()]
    return f"Tool error over the fit without the wrong rows, least squares / huber / gnc: {', '.join(cells)}"


MONITORED = {"pose": "pose", "pairs": "distance-rotation"}
SLIPS = (0.0, 3.0, 10.0, 30.0)
"""Slip of a joint's zero, in sigma with which eight new poses show it."""


def poses_of(robot: Robot, q: Floats, model: str, rng: np.random.Generator) -> Table:
    """Poses in the base frame by a tracker of 0.05 mm and 0.1 mrad."""
    at, n = pose(robot, q), len(q)
    turn = Rotation.from_rotvec(1e-4 * rng.normal(size=(n, 3)))
    rows = Measurements.from_arrays(
        q,
        position=at.position + 5e-5 * rng.normal(size=(n, 3)),
        quaternion=(Rotation.from_matrix(at.rotation) * turn).as_quat(),
        sigma_position=5e-5,
        sigma_orientation=1e-4,
        ids=[f"p{rng.integers(2**40)}" for _ in range(n)],
    )
    return Table(rows, model)


def monitor_draw(task: Task) -> Row:
    """What `check` says of a healthy arm or of one whose joint zero has slipped, and how far `update` is off."""
    way, slip, seed = task
    robot = scenario_of("honesty", "UR10, pose, frame known, exact encoders").robot
    rng = np.random.default_rng([seed, 3])
    sigma = np.array([p.tolerance or 0.0 for p in robot.parameters])
    true = robot.with_values(robot.nominal + sigma * rng.normal(size=len(sigma)))
    old = poses_of(true, rng.uniform(-np.pi, np.pi, (40, 6)), MONITORED[way], rng)
    found = calibrate(robot, old)
    name = f"theta{int(rng.integers(2, 7))}"
    values = true.nominal.copy()
    values[true.index(name)] += slip * 1e-4 / np.sqrt(8.0)
    new = poses_of(true.with_values(values), rng.uniform(-np.pi, np.pi, (8, 6)), MONITORED[way], rng)
    check = found.check(new)
    likely = [e for e in check.explanations if e.likely]
    named = any(name in (*e.parameters, *e.same) for e in likely)
    row: Row = {
        "p": check.p_value,
        "fail": check.verdict == "fail",
        "named": named,
        "other": bool(likely) and not named,
    }
    if slip == 0.0:
        batch, updated = calibrate(robot, [old, new]), found.update(new)
        both = [(updated.parameters[n], batch.parameters[n]) for n in batch.result.covariance.names]
        row["update"] = max(abs(a.estimate - b.estimate) / b.sigma for a, b in both)
    return row


def monitor_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Uniformity of p-values, shares of failed checks and of named joints, by way and slip."""
    found: Row = {}
    for way in MONITORED:
        for slip in SLIPS:
            of = [row for task, row in zip(tasks, rows, strict=True) if task[:2] == (way, slip)]
            cell: Row = {key: float(np.mean([row[key] for row in of])) for key in ("fail", "named", "other")}
            if slip == 0.0:
                cell["uniform p"] = float(stats.kstest([row["p"] for row in of], "uniform").pvalue)
                cell["update off"] = max(row["update"] for row in of)
            found[f"{way}, slip {slip:g} sigma"] = cell
    return found


def monitor_answer(found: Row) -> str:
    """Shares by slip, and how far updates are off."""
    healthy = [found[f"{way}, slip 0 sigma"] for way in MONITORED]
    parts = [
        "p-values of healthy arms are uniform (p " + ", ".join(f"{h['uniform p']:.2f}" for h in healthy) + ")",
        f"updates are within {max(h['update off'] for h in healthy):.1g} sigma of a calibration of all rows",
    ]
    for cell, row in found.items():
        if "slip 0" not in cell:
            parts.append(f"{cell}: {row['fail']:.0%} fail, {row['named']:.0%} named, {row['other']:.0%} another")
    return "; ".join(parts)


SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)


class _Cells(dict[str, Any]):
    """Cells by question, made when they are asked for: some need another question's scenario."""

    def __missing__(self, question: str) -> dict[str, Cell]:
        self[question] = _MAKERS[question]()
        return self[question]


_MAKERS = {
    "honesty": honesty_cells,
    "short": short_cells,
    "landmarks": landmark_cells,
    "instruments": instrument_cells,
    "anchors": anchor_cells,
    "outliers": outlier_cells,
}
CELLS = _Cells()


def cells_and_seeds(question: str) -> Any:
    """Tasks of all cells of a question that has draws of its own."""
    return lambda n, first: [(cell, first + k) for cell in CELLS[question] for k in range(n)]


QUESTIONS = (
    Question("honesty", "Are the sigmas honest?", draws("honesty"), draw, summarise, warned_answer, (100, 1)),
    Question("short", "And where lengths and angles are near 0, or priors wide?", draws("short"), draw, summarise,
             warned_answer, (50, 1)),
    Question("landmarks", "And with every instrument's unknown places?", draws("landmarks"), draw, summarise,
             warned_answer, (50, 1)),
    Question("instruments", "Which instrument for how many poses?", draws("instruments"), draw, summarise,
             instruments_answer, (10, 1), draw_instruments),
    Question("anchors", "Is a calibration by lengths to unknown anchors as good as it can be?", draws("anchors"), draw,
             summarise, anchors_answer, (100, 1)),
    Question("outliers", "Does gnc survive gross errors?", cells_and_seeds("outliers"), outlier_draw, outlier_summary,
             outlier_answer, (20, 1)),
    Question("monitoring", "Is what check and update say next month true?",
             lambda n, first: [(way, slip, first + k) for way in MONITORED for slip in SLIPS for k in range(n)],
             monitor_draw, monitor_summary, monitor_answer, (40, 1)),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
