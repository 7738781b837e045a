"""Real arms beyond their geometry: held-out errors with effects, in joint ranges that were not measured too.

    FG_CALIB_DATA=FOLDER python experiments/real_effects.py [--quick] [--only QUESTION ...]

| question | data | what is fitted |
|---|---|---|
| held_out | `ur10_tmac`: UR10, laser tracker, 1046 train and 449 test | poses with sets of effects, noise estimated |
| half | the same, all rows | the half of the rows with the lower, or upper, joint 2; judged on the other half |
| parts | the same, all rows, in four blocks by a joint's position | each block by itself |
| named | the same, 1046 train and 449 test | what the report names, if what it named before is modelled |
| sockets | `panda_sockets`: a ball put into two sockets 50 mm apart | touches, with sets of effects |
| cost | `ur10_tmac`, all rows | solves with given noise and prior sigma, as a multiple of the geometry's |

Masses are the manufacturer's. Three test rows of the UR10 are off by 2 mm, and count.

Takes two minutes. Without the data a question says so and is left out of the record.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from common import MM, Question, Row, Task, data_folder, rms, run
from numpy.typing import NDArray
from real_data import LEAST_EIGENVALUE, NOISE, by_name, judge_sockets, panda_job

from fg_calib import Job, Solution, Table, build_problem, calibrate_job, read_job, solve
from fg_calib.assessment import solve_job
from fg_calib.robot import Compliance, Harmonics
from fg_calib.statistics import judge_fit, spread_of
from fg_calib.statistics.residual_table import residual_table

Floats = NDArray[np.float64]

MASSES = {
    1: {"mass": 7.778, "com": [0.021, 0, 0.027]},
    2: {"mass": 12.93, "com": [0.38, 0, 0.158]},
    3: {"mass": 3.87, "com": [0.24, 0, 0.068]},
    4: {"mass": 1.96, "com": [0, 0.007, 0.018]},
    5: {"mass": 1.96, "com": [0, 0.007, 0.018]},
    6: {"mass": 1.202, "com": [0, 0, -0.026]},
}
COMPLIANCE = {"joints": [2, 3, 4, 5, 6], "masses": MASSES}
CURVE = {"knots": 144}
SETS: dict[str, Row] = {
    "geometry": {},
    "harmonics": {"harmonics": True},
    "compliance": {"compliance": COMPLIANCE},
    "error curve and compliance": {"error_curve": CURVE, "compliance": COMPLIANCE},
}
NAMED: dict[str, Row] = {
    "geometry": {},
    "error curve": {"error_curve": CURVE},
    "error curve and compliance": SETS["error curve and compliance"],
    "with tilts": {"error_curve": CURVE, "compliance": COMPLIANCE | {"lateral": True}},
}
LEFT = {"position": 4.5e-5, "orientation": 1.0e-4}
"""What error curves and compliance leave, 1 sigma, [m] and [rad]."""

PRIOR = 4.4e-4
"""1 sigma of a coefficient of the curves, by marginal likelihood, [rad]."""

GROSS = 1.0
"""Held-out errors above this are gross, [mm]."""


def ur10_job(data: Path, effects: Row, **settings: Any) -> Job:
    """The job of all rows of series B with effects."""
    robot = yaml.safe_load((data / "robot.yaml").read_text()) | {"effects": effects}
    with TemporaryDirectory() as folder:
        job = Path(folder) / "calibration.yaml"
        given = {"robot": robot, "measurements": str(data / "series_b.csv"), "model": "pose", "frame": "unknown"}
        job.write_text(yaml.safe_dump(given | {"noise": NOISE} | settings))
        return read_job(job)


def with_test(job: Job, test: NDArray[np.bool_]) -> list[Table]:
    """The job's table with other test rows."""
    (table,) = job.tables
    return [replace(table, measurements=replace(table.measurements, test=test))]


def position_errors(solution: Solution) -> Floats:
    """Lengths of the position errors of test rows, [mm]."""
    table = residual_table(solution)
    chosen = table.test & (table.family == table.families.index("position"))
    return np.linalg.norm(table.after[chosen].reshape(-1, 3), axis=1) / MM


def lag_one(solution: Solution) -> float:
    """Largest correlation of a coordinate's residual with that of the next train row."""
    table = residual_table(solution)
    rows = np.flatnonzero(table.used)
    columns = (table.after / table.sigma)[rows].reshape(-1, 6)  # positions and rotations of each pose
    return float(max(np.corrcoef(c[1:], c[:-1])[0, 1] for c in columns.T))


def figures(errors: Floats) -> Row:
    """Of held-out errors, [mm]."""
    fine = errors[errors < GROSS]
    return {
        "rms": rms(errors),
        "median": float(np.median(errors)),
        "95 %": float(np.quantile(errors, 0.95)),
        "rms without gross": rms(fine),
        "gross": len(errors) - len(fine),
    }


def held_out(task: Task) -> Row:
    """Held-out figures of a set of effects, and the noise and prior sigma that are estimated."""
    (name,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    solution = solve_job(ur10_job(data, SETS[name], noise=NOISE | {"estimate": True}))
    factors = solution.problem.state.factors
    curve = [p.tolerance for p in solution.problem.robot.parameters if p.kind == "curve"]
    left = {f"{kind} left": factors[0, kind] * sigma for kind, sigma in NOISE.items()} | {"lag": lag_one(solution)}
    return figures(position_errors(solution)) | left | {"curve sigma": curve[0] if curve else 0.0}


def half(task: Task) -> Row:
    """Held-out figures where one half of joint 2's range was measured, and errors over what is expected."""
    (name,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    effects = SETS[name] | ({"error_curve": CURVE | {"sigma": PRIOR}} if "error_curve" in SETS[name] else {})
    job = ur10_job(data, effects, noise=LEFT if effects else NOISE)
    q2 = job.tables[0].measurements.readings[:, 1]
    row: Row = {}
    for which, test in (("upper", q2 > np.median(q2)), ("lower", q2 <= np.median(q2))):
        solution = solve(build_problem(job.robot, with_test(job, test), job.options))
        errors = position_errors(solution)
        z = judge_fit(solution, spread_of(solution), residual_table(solution)).studentised
        z = z[residual_table(solution).test]
        row |= {f"{which} {key}": value for key, value in (figures(errors) | {"z": rms(z[np.abs(z) < 8])}).items()}
    return row


def named(task: Task) -> Row:
    """The effect that the report names next to some effects, and held-out figures."""
    (name,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    found = calibrate_job(ur10_job(data, NAMED[name]))
    systematic = found.assessment.verdict.systematic
    cause = {} if systematic is None else {"cause": systematic.cause, "p-value": systematic.p_value}
    return figures(position_errors(found.solution)) | cause


def parts(task: Task) -> Row:
    """RMS z of the differences between four blocks of rows by a joint, with error curves and compliance."""
    (joint,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    effects = SETS["error curve and compliance"] | {"error_curve": CURVE | {"sigma": PRIOR}}
    job = ur10_job(data, effects, noise=LEFT)
    q = job.tables[0].measurements.readings[:, joint - 1]
    found = []
    for block in np.array_split(np.argsort(q), 4):
        (table,) = job.tables
        m = table.measurements.select(np.sort(block))
        rows = replace(table, measurements=replace(m, test=np.zeros(len(block), dtype=bool)))
        found.append(solve(build_problem(job.robot, [rows], job.options)))
    squares = []
    for a, b in combinations(found, 2):
        n = a.problem.variables.n_robot_columns
        places = [a.problem.robot.index(name) for name in a.problem.variables.names[:n]]
        off = (a.parameters - b.parameters)[places]
        C = sum(spread_of(one).named() for one in (a, b))
        scale = np.sqrt(np.diag(C))
        values, V = np.linalg.eigh(C / np.outer(scale, scale))
        known = values > LEAST_EIGENVALUE
        squares.append(float(np.mean((V.T @ (off / scale))[known] ** 2 / values[known])))
    return {"z": float(np.sqrt(np.mean(squares)))}


SOCKETS: dict[str, Sequence[Any]] = {
    "geometry": [],
    "harmonics": [Harmonics()],
    "free loads": [Compliance(None)],
}


def sockets(task: Task) -> Row:
    """Spread of the ball centre and error of the distance of sockets at unseen locations, RMS, [mm]."""
    (name,) = task
    data = data_folder("panda_sockets")
    if data is None:
        return {}
    job, rows = panda_job(data, "group")
    robot = job.robot.with_effects(*SOCKETS[name]) if SOCKETS[name] else job.robot
    solution = solve(build_problem(robot, job.tables, job.options))
    judged = judge_sockets(solution.robot, job.tables[0].measurements.readings, rows)
    return {kind: rms(e) / MM for kind, e in judged.items()}


def cost(task: Task) -> Row:
    """Processor time of a solve of all rows, and of the geometry's in turn with it, least of fifteen, [s]."""
    (name,) = task
    data = data_folder("ur10_tmac")
    if data is None:
        return {}
    effects = SETS[name] | ({"error_curve": CURVE | {"sigma": PRIOR}} if "error_curve" in SETS[name] else {})
    jobs = {"seconds": ur10_job(data, effects, noise=LEFT), "geometry": ur10_job(data, {}, noise=LEFT)}
    seconds: dict[str, list[float]] = {key: [] for key in jobs}
    for key, job in 15 * list(jobs.items()):
        tables = with_test(job, np.zeros(len(job.tables[0].measurements.readings), dtype=bool))
        problem, start = build_problem(job.robot, tables, job.options), time.process_time()
        solve(problem)
        seconds[key].append(time.process_time() - start)
    return {key: min(each) for key, each in seconds.items()}


def held_out_answer(found: Row) -> str:
    """Figures of each set."""
    cells = [
        f"{name} {row['median']:.3f} / {row['95 %']:.2f} / {row['rms without gross']:.3f} ({row['gross']} gross)"
        for name, row in found.items()
    ]
    if not cells:
        return "the data are missing"
    last = found["error curve and compliance"]
    left = f"{last['position left'] / MM:.3f} mm and {last['orientation left'] / MM:.3f} mrad"
    text = f"Median / 95 % / RMS without rows above {GROSS:g} mm, mm: {'; '.join(cells)}. Noise left {left}"
    return f"{text}; lag-1 correlation at most {last['lag']:.2f}; curve sigma {last['curve sigma']:.1e} rad"


def half_answer(found: Row) -> str:
    """RMS of both halves, by set."""
    each = [(name, *(f"{row[f'{half} {key}']:.2f}" for half in ("upper", "lower") for key in ("rms", "z")))
            for name, row in found.items()]  # fmt: skip
    cells = [f"{name} {upper} (z {z}), {lower} (z {other})" for name, upper, z, lower, other in each]
    return f"RMS of the half not measured, mm: {'; '.join(cells)}" if cells else "no data"


def named_answer(found: Row) -> str:
    """Median and what is named next, by set."""
    cells = [f"{name} {row['median']:.3f} mm: {row['cause'].partition(' (')[0]}" for name, row in found.items()]
    return "; ".join(cells) or "the data are missing"


def parts_answer(found: Row) -> str:
    """RMS z by joint."""
    cells = [f"joint {name} {row['z']:.2f}" for name, row in found.items()]
    return f"RMS z between four blocks: {', '.join(cells)}" if cells else "-"


def sockets_answer(found: Row) -> str:
    """Spread by set."""
    cells = [f"{name} {row['spread']:.3f}" for name, row in found.items()]
    return f"Spread at unseen locations, mm: {', '.join(cells)}" if cells else "the data are missing"


def cost_answer(found: Row) -> str:
    """Multiple of the geometry's time."""
    if not found:
        return "the data are missing"
    cells = [f"{name} {row['seconds'] / row['geometry']:.1f}" for name, row in found.items()]
    once = min(row["geometry"] for row in found.values())
    return f"1 495 poses, times the geometry's {once:.3f} s: {', '.join(cells)}"


def names(of: Row) -> Any:
    """Tasks of names."""
    return lambda n, seed: [(name,) for name in of]


QUESTIONS = (
    Question("held_out", "What do effects bring on a real UR10's held-out poses?", names(SETS), held_out, by_name,
             held_out_answer),
    Question("half", "And where joint 2 was not measured?",
             names({"geometry": 0, "error curve and compliance": 0}), half, by_name, half_answer),
    Question("parts", "Do calibrations of its parts agree?", lambda n, s: [(1,), (2,), (3,)],
             parts, by_name, parts_answer),
    Question("named", "And what does the report name?", names(NAMED), named, by_name, named_answer),
    Question("sockets", "And a real Panda's touches?", names(SOCKETS), sockets, by_name, sockets_answer),
    Question("cost", "How long does a solve take?",
             names({"compliance": 0, "error curve and compliance": 0}), cost, by_name, cost_answer, timed=True),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
