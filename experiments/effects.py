"""What can distances and rotation angles say of an arm beyond its geometry, and what does it cost not to ask?

    python experiments/effects.py [--quick] [--only QUESTION ...] [--draws N] [--workers 2]

No measurement frame is known or estimated: the data are how far the tool moved and turned between configurations.

| question | what |
|---|---|
| ranks | how many coefficients of an effect add to the rank of the geometry, next to poses in an unknown frame |
| arm | the paper's arm with gravity and eccentricities, calibrated with and without them in the model |
| honesty | squared errors over covariance (NEES) and coverage of 95 % intervals, of a 5-joint arm with effects |
| named | which effect the report names, of one that the same arm has and its model lacks |

`ranks` has 500 random configurations, chained. In `arm` compliances are 2e-7 rad/(N m), links weigh 15 to 60 kg, first
and second harmonics are 0.02 deg (1 sigma, every joint); errors of the geometry and noise are the paper's, and a star
of random configurations is measured. The tool is judged at 200 others after the best rigid fit: realised and expected.

The even tilt of joint 1 of a UR10 is what equal compliances of joint 2, its own and lateral, do too.

Traps: a rank says nothing of accuracy. Masses are known and lie off the joints' axes. Sides of backlash are columns: as
a function of the configuration some other term might equal them. Priors are as the truth was drawn. What geometry alone
expects is by the noise as specified; its chi-square says that it is not to be trusted. Of 800 configurations there is
one draw in five.

In `honesty` coefficients are drawn by their priors, in 90 configurations with 0.1 mm and 0.2 mrad; the prior sigma of
error curves starts ten times too small, or too large, and is estimated. Draws that chi-square refuses, at another
optimum, are counted apart. The uncertainty of the estimated sigma is part of no other: where pairs alone tell curves
from harmonics NEES is above 1, and 0.98 with the sigma known.

Takes two minutes with two workers.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from common import MM, Question, Row, Task, by_cell, rms, run
from paper import paper_scenario
from scipy.spatial.transform import Rotation
from validation import scenario_of, with_priors

from fg_calib import Measurements, Noise, Options, Pairing, Scenario, build_problem, simulate, solve
from fg_calib.baseline import real_errors
from fg_calib.diagnostics import LIKE_NOISE
from fg_calib.diagnostics.unmodelled_effects import find_systematic, regress
from fg_calib.observability import identifiability_of, true_problem
from fg_calib.prediction import errors_at
from fg_calib.robot import Robot, build_chain, forward
from fg_calib.robot.effects import (
    Backlash,
    Bending,
    Compliance,
    Coupling,
    ErrorCurve,
    Gain,
    Harmonics,
    Mass,
    Thermal,
    last_moves,
)
from fg_calib.robot.model import Effect
from fg_calib.selection import estimate_curve_sigma
from fg_calib.simulation import Errors, RandomReadings
from fg_calib.statistics import spread_of, with_left_out

# --- ranks ------------------------------------------------------------------------------------------------------------

ARMS = {"7R": "the paper's arm", "6R": "a UR10"}
MODELS = ("distance-rotation", "pose")
EFFECTS = ("gain", "harmonics", "orders 3 to 6", "compliance", "lateral", "backlash", "coupling", "together")


def effects_of(name: str, n: int) -> list[Effect]:
    """The effects of one of `EFFECTS` on an arm of n joints; none for another name."""
    masses = [Mass(link, 10.0, (0.2, 0.05, 0.1)) for link in range(2, n + 1)]
    coupling = Coupling([(joint, joint + 1) for joint in range(1, n)])
    every = [Gain(), Harmonics(range(1, 7)), Compliance(masses, lateral=True), Backlash(side="side"), coupling]
    return {
        "gain": every[:1],
        "harmonics": [Harmonics()],
        "orders 3 to 6": [Harmonics(range(3, 7))],
        "compliance": [Compliance(masses)],
        "lateral": every[2:3],
        "backlash": every[3:4],
        "coupling": every[4:],
        "together": every,
    }.get(name, [])


@cache
def arm_of(arm: str) -> Robot:
    """One of `ARMS`, without effects."""
    shipped = paper_scenario().robot
    return shipped if arm == "7R" else scenario_of("honesty", "UR10, pose, frame known, exact encoders").robot


@cache
def rank_of(arm: str, model: str, effect: str) -> tuple[int, int]:
    """Rank and number of all parameters of an arm with an effect, at random configurations."""
    robot = arm_of(arm).with_effects(*effects_of(effect, arm_of(arm).n_joints))
    robot = robot.with_estimated([p.name for p in robot.parameters if 1 <= p.owner <= robot.n_joints])
    noise, job = Noise(robot.scale_of("m"), robot.scale_of("rad")), {"model": model, "pairing": "chain"}
    scenario = Scenario(robot, Errors("values", {}), RandomReadings(500), noise, job=job)
    frame = "unknown" if model == "pose" else "known"
    options = Options(model, Pairing("chain"), frame, gauge="none")
    problem = true_problem(robot, simulate(scenario, exact=True).tables, options)
    found = identifiability_of(problem, problem.start, "structural").observability
    return found.rank, len(found.names)


def ranks(task: Task) -> Row:
    """How many coefficients of an effect add to the rank, and how many there are."""
    arm, model, effect = task
    before = rank_of(arm, model, "compliance" if effect == "lateral" else "geometry")
    rank, n = rank_of(arm, model, effect)
    return {"geometry": rank_of(arm, model, "geometry")[0], "gained": rank - before[0], "of": n - before[1]}


def ranks_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by arm and model, then by effect."""
    found: Row = {}
    for (arm, model, effect), row in zip(tasks, rows, strict=True):
        found.setdefault(f"{arm} {model}", {})[effect] = row
    return found


def ranks_answer(found: Row) -> str:
    """What pairs gain by arm and effect, and whether poses gain the same."""
    same = all(
        row["gained"] == found[f"{arm} pose"][effect]["gained"]
        for arm in ARMS for effect, row in found[f"{arm} distance-rotation"].items()
    )  # fmt: skip
    gained = []
    for arm, name in ARMS.items():
        every = found[f"{arm} distance-rotation"].items()
        each = [(e, row) for e, row in every if arm == "7R" or row["gained"] < row["of"]]
        gained.append(
            f"of {name} {'all but ' * (arm != '7R')}"
            + ", ".join(f"{e} {row['gained']} of {row['of']}" for e, row in each)
        )
    words = "As many coefficients as poses" if same else "Fewer coefficients than poses"
    return (
        f"{words} in an unknown frame: {'; '.join(gained)}. Lost: compliances about vertical axes, and in the UR10 an "
        "even tilt of joint 1"
    )


# --- the arm with compliances and eccentricities ----------------------------------------------------------------------

MASSES = (
    Mass(2, 20.0, (0.0, 0.0, 0.1)), Mass(3, 15.0, (0.05, 0.0, 0.0)), Mass(4, 60.0, (2.5, 0.0, 0.1)),
    Mass(5, 60.0, (2.5, 0.0, 0.1)), Mass(6, 15.0, (0.0, 0.05, 0.1)), Mass(7, 30.0, (0.1, 0.05, 0.2)),
)  # fmt: skip
"""Two links of 5 m, their motors, and what the arm holds, in the frames behind the joints."""

SIZES = {"compliance": 2e-7, "sin": float(np.deg2rad(0.02)), "cos": float(np.deg2rad(0.02))}
COUNTS = (52, 200, 800)


@cache
def with_effects() -> Robot:
    """The paper's arm with priors, compliances and harmonics."""
    robot = with_priors(arm_of("7R")).with_effects(Compliance(MASSES), Harmonics())
    sized = tuple(replace(p, tolerance=SIZES.get(p.kind, p.tolerance)) for p in robot.parameters)
    return replace(robot, parameters=sized)


def calibrate_both(task: Task) -> Row:
    """RMS tool errors of one draw before, and with and without effects in the model, realised and expected, [m]."""
    count, seed = task
    robot = with_effects()
    errors = Errors("normal", {p.name: p.tolerance for p in robot.parameters if p.tolerance})
    test, job = RandomReadings(200), {"model": "distance-rotation", "pairing": "star"}
    noise = paper_scenario().noise
    s = simulate(Scenario(robot, errors, RandomReadings(count), noise, validation=test, job=job), seed)
    q, true = s.measurements.readings[s.measurements.test], s.true_robot
    row: Row = {"before": real_errors(robot, true, q).best_rigid_fit.rms}
    for name, model in (("geometry", with_priors(arm_of("7R"))), ("effects", robot)):
        solution = solve(build_problem(model, s.tables))
        values = robot.nominal
        values[: len(model.parameters)] = solution.robot.nominal
        row[name] = real_errors(robot.with_values(values), true, q).best_rigid_fit.rms
        row[f"{name} expected"] = errors_at(with_left_out(solution, spread_of(solution)), q)[1].position
    return row


def arm_tasks(n: int, first: int) -> list[Task]:
    """All draws, of the most configurations a fifth."""
    return [(c, first + k) for c in COUNTS for k in range(n if c < COUNTS[-1] else -(-n // 5))]


def arm_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """RMS of each error over the draws by number of configurations, [m], and realised over expected."""
    found: Row = {}
    for count, values in by_cell(tasks, rows).items():
        cell: Row = {key: rms(v) for key, v in values.items()} | {"draws": len(values["before"])}
        found[count] = cell | {f"{k} ratio": cell[k] / cell[f"{k} expected"] for k in ("geometry", "effects")}
    return found


def arm_answer(found: Row) -> str:
    """Errors with and without effects, and realised over expected."""
    errors = "; ".join(
        f"{count} poses {cell['geometry'] / MM:.1f} -> {cell['effects'] / MM:.2g}" for count, cell in found.items()
    )
    ratios = {k: ", ".join(f"{cell[f'{k} ratio']:.2f}" for cell in found.values()) for k in ("geometry", "effects")}
    before = rms([cell["before"] for cell in found.values()]) / MM
    return (
        f"Half of the nominal error stays without them, however much is measured. RMS tool error, mm, {before:.1f} "
        f"nominal, geometry alone -> with effects: {errors}. Realised over expected: with effects {ratios['effects']}, "
        f"geometry alone {ratios['geometry']}"
    )


# --- honesty ----------------------------------------------------------------------------------------------------------

LOADS = (Mass(2, 10.0, (0.3, 0.0, 0.1)), Mass(4, 4.0, (0.05, 0.02, 0.1)), Mass(5, 2.0, (0.0, 0.05, 0.1)))
CURVE = ErrorCurve([2, 3, 4], knots=24)
SETS: dict[str, tuple[float, list[Effect]]] = {
    "compliance": (1.0, [Compliance(LOADS)]),
    "lateral": (1.0, [Compliance(LOADS, lateral=True)]),
    "free loads": (1.0, [Compliance(None)]),
    "harmonics": (1.0, [Harmonics(), Gain()]),
    "backlash": (1.0, [Backlash(side="load", masses=LOADS)]),
    "curve, prior / 10": (0.1, [CURVE]),
    "curve, prior x 10": (10.0, [CURVE]),
    "curve and compliance, prior x 10": (10.0, [CURVE, Compliance(LOADS)]),
    "curve and harmonics, prior x 10": (10.0, [CURVE, Harmonics()]),
}
VIEWS: dict[str, Literal["known", "unknown"]] = {"pose": "unknown", "position": "unknown", "distance-rotation": "known"}
ROWS = (
    (0.1, 1.4, 0.3, 0.2),
    (0.5, 0.2, 0.1, -0.3),
    (0.3, -1.2, 0.2, 0.1),
    (0.05, 0.7, 0.1, 0.4),
    (0.02, 1.2, 0.1, 0.3),
)
TOLERANCE = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
MAX_RATIO = 2.0
"""Reduced chi-square above which a calibration is DOUBTFUL, and counts as refused."""

N, SIGMA_POSITION, SIGMA_ORIENTATION = 90, 1e-4, 2e-4


def measured(true: Robot, rng: np.random.Generator) -> Measurements:
    """Poses of a true arm with noise, while it warms up by 10 K."""
    q = rng.uniform(-2.5, 2.5, (N, true.n_joints))
    context = {"moves": last_moves(q), "temperature": np.linspace(15.0, 25.0, N)}
    at, turns = forward(build_chain(true), true.trig(q, context)), SIGMA_ORIENTATION * rng.normal(size=(N, 3))
    return Measurements.from_arrays(
        q,
        position=at.position + SIGMA_POSITION * rng.normal(size=(N, 3)),
        rotation=at.rotation @ Rotation.from_rotvec(turns).as_matrix(),
        sigma_position=SIGMA_POSITION,
        sigma_orientation=SIGMA_ORIENTATION,
    )


def honesty(task: Task) -> Row:
    """NEES of geometry and effects, and coverage, of one draw."""
    name, _, model = task[0].rpartition(", ")
    rng, (wrong, effects) = np.random.default_rng(task[1]), SETS[name]
    robot = Robot.from_dh(ROWS, "dh", tool=[0.1, 0, 0.2], tolerance=TOLERANCE).with_effects(*effects)
    sigma = np.array([p.tolerance or 0.0 for p in robot.parameters])
    true = robot.with_values(robot.nominal + sigma * rng.normal(size=len(sigma)))
    data = measured(true, rng)
    told = [replace(p, tolerance=wrong * p.tolerance) if p.kind == "curve" else p for p in robot.parameters]
    options = Options(model=model, frame=VIEWS[model], gauge="prior")
    solution = estimate_curve_sigma(build_problem(replace(robot, parameters=tuple(told)), data, options))
    v = solution.problem.variables
    items = [one for one in (*v.items, *v.nuisance) if one.kind in ("vector", "curve")]
    root = solution.system.full_root[np.concatenate([np.r_[one.columns] for one in items])]
    places = np.concatenate([one.places for one in items])
    z = (solution.parameters[places] - true.nominal[places]) / np.linalg.norm(root, axis=1)
    R = root / np.linalg.norm(root, axis=1)[:, None]
    values, V = np.linalg.eigh(R @ R.T)
    known = values > 1e-10
    squares = (V.T @ z)[known] ** 2 / values[known]
    ratio = solution.system.chi_square / solution.problem.n_residuals
    row = {"nees": float(np.mean(squares)), "n": int(known.sum()), "coverage": float(np.mean(np.abs(z) < 1.96))}
    return row | {"refused": bool(ratio > MAX_RATIO)}


def honesty_answer(found: Row) -> str:
    """Cells within bounds, and the range of NEES and coverage."""
    nees, coverage = ([row[key] for row in found.values()] for key in ("nees", "coverage"))
    good = sum(row["within"] for row in found.values())
    text = f"{good} of {len(found)} cells within 99 % bounds; NEES {min(nees):.2f} to {max(nees):.2f}"
    refused = sum(row["refused"] for row in found.values())
    return f"{text}, coverage {100 * min(coverage):.0f} to {100 * max(coverage):.0f} %; {refused} draws refused"


def honesty_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Means by cell, and whether the NEES is within its 99 % bounds by chance, each cell by itself."""
    found: Row = {}
    for name, every in by_cell(tasks, rows).items():
        of = {key: values[~every["refused"]] for key, values in every.items()}
        nees, bound = float(np.mean(of["nees"])), 2.576 * np.sqrt(2.0 / np.sum(of["n"]))
        cell = {"nees": nees, "coverage": float(np.mean(of["coverage"])), "refused": int(np.sum(every["refused"]))}
        found[name] = cell | {"within": bool(abs(nees - 1.0) < bound)}
    return found


# --- named ------------------------------------------------------------------------------------------------------------

MISSING: dict[str, tuple[str, float, Effect, str]] = {
    "compliance": ("theta3.compliance", 2e-5, Compliance(LOADS), "q3 yields to gravity"),
    "lateral": ("theta3.compliance_x", 2e-5, Compliance(LOADS, lateral=True), "q3 tilts"),
    "bending": ("base.bending", 1e-5, Bending(LOADS), "the base gives way"),
    "gain": ("theta3.gain", 5e-4, Gain(), "q3 errs in proportion"),
    "harmonic 2": ("theta3.sin2", 3e-4, Harmonics(), "q3 errs once or twice a turn"),
    "harmonic 5": ("theta3.sin5", 3e-4, Harmonics([5]), "q3 errs several times a turn"),
    "backlash": ("theta3.backlash", 2e-4, Backlash(), "q3 errs with the direction"),
    "coupling": ("theta3.coupling2", 5e-4, Coupling([(2, 3)]), "q3 moves with q2"),
    "drift": ("theta3.drift", 5e-5, Thermal(lengths=False, zeros=True), "q3 drifts"),
    "nothing": ("", 0.0, Gain(), ""),
}


def named(task: Task) -> Row:
    """Whether the effect that an arm has, and its model lacks, is found in residuals, and named."""
    name, _, model = task[0].rpartition(", ")
    rng, (coefficient, size, effect, cause) = np.random.default_rng(task[1]), MISSING[name]
    robot = Robot.from_dh(ROWS, "dh", tool=[0.1, 0, 0.2], tolerance=TOLERANCE)
    full = robot.with_effects(effect)
    errors = [
        size if p.name == coefficient else p.scale * rng.normal() * (p.kind in TOLERANCE) for p in full.parameters
    ]
    data = measured(full.with_values(full.nominal + errors), rng)
    solution = solve(build_problem(robot, data, Options(model=model, frame=VIEWS[model], gauge="prior")))
    found = find_systematic(regress(solution))
    systematic = found is not None and found.p_value < LIKE_NOISE
    right = systematic and found is not None and found.cause.startswith(cause)
    return {"found": systematic, "right": right if cause else not systematic}


def named_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Counts by cell."""
    cells = by_cell(tasks, rows).items()
    return {
        name: {key: int(np.sum(of)) for key, of in every.items()} | {"n": len(every["right"])} for name, every in cells
    }


def named_answer(found: Row) -> str:
    """Counts by effect, of each kind of measurements."""
    each = {name: " ".join(str(found[f"{name}, {view}"]["right"]) for view in VIEWS) for name in MISSING}
    n = next(iter(found.values()))["n"]
    cells = ", ".join(f"{name} {counts}" for name, counts in each.items())
    return f"Named right by poses, positions, pairs, of {n} each ({N} configurations): {cells}"


QUESTIONS = (
    Question("ranks", "What of an arm's effects do distances and rotation angles see, without any frame?",
             lambda n, s: [(a, m, e) for a in ARMS for m in MODELS for e in EFFECTS], ranks, ranks_summary,
             ranks_answer),
    Question("arm", "What do compliances and eccentricities cost the paper's arm?", arm_tasks,
             calibrate_both, arm_summary, arm_answer, (200, 1)),
    Question("honesty", "Are sigmas true?",
             lambda n, s: [(f"{name}, {view}", s + k) for name in SETS for view in VIEWS for k in range(n)], honesty,
             honesty_summary, honesty_answer, (40, 2)),
    Question("named", "What does a model lack?",
             lambda n, s: [(f"{name}, {view}", s + k) for name in MISSING for view in VIEWS for k in range(n)], named,
             named_summary, named_answer, (20, 2)),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
