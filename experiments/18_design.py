"""Is a designed set of measurements worth what the design says, and how much fewer stops does it take than random ones?

Command: python experiments/18_design.py [--quick] [--seed N] [--draws N] [--out FOLDER] [--only PART ...] [--workers N]
Takes 35 minutes of one processor; parts of an earlier run stay where `--only` names others.

- *camera 0.3-2 m*, *hemisphere*: the paper's arm, its noise and its tolerances, poses in an unknown frame and
  distances + angles of pairs: what designs expect, for several seeds of the candidates, beside random sets of as many;
  how few designed stops equal 52 random ones; and 200 draws of true arm, frame and noise measured at the design and
  calibrated: realised over predicted RMS of the tool's position at the task's configurations after the best rigid fit.
- *formed pairs*: the paper's arm, stops chosen among 300 within the joint limits as poses in an unknown frame: expected
  error of all pairs of these stops over that of the poses, which is a bound on what other stops could gain.
- *arms*: 90 random arms of 5 to 7 joints, 10 or 20 of 500 configurations, positions in an unknown frame: the expected
  error of designs by each criterion and of random sets, for a task anywhere, within a cell, and at five places.
- *search*: on the same arms, greedy choice and exchange against the best of 100 random sets, and against exhaustive
  search on small pools, for every criterion.
- *ur10*, *ur10, drawn noise*, *panda*: rows of real tables chosen by design against random draws of as many, by the
  error at rows that are never fitted; the second with what the calibrated UR10 would measure in place of what was
  measured. The design sees the readings of rows, and the arm as all train rows have it.

Data of these: folder FG_CALIB_DATA (default: ../shared/data beside the repository); skipped where it is missing.

References:
    Jost et al. (2017), A computational method for key-performance-indicator-based parameter
    identification of industrial manipulators. Journal of Mathematics in Industry 7:9. doi 10.1186/s13362-017-0039-7.
    Franzese, Spahn, Kober, Della Santina (2025), MUKCa. arXiv:2503.12584: the Panda's data.
    Landgraf, Ernst, Schleth, Fabritius, Huber (2021), IEEE CASE: the UR10's data.
"""

from __future__ import annotations

import argparse
import json
import resource
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from arms import random_arm
from draws import add_workers, over_draws
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from space_robot import MM, ROOT, clean, paper_scenario, write_json

import fg_calib
from fg_calib import Design, Noise, Pairing, Robot, Scenario, design
from fg_calib.designs.chooser import Chooser
from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.pool import Pool, drawn, pool_of, selected
from fg_calib.designs.search import Chosen, not_worse_than_random, random_values
from fg_calib.designs.system import System, system_of
from fg_calib.designs.task import Task
from fg_calib.options import Model
from fg_calib.robot.inverse import random_readings
from fg_calib.simulation.configurations import GivenReadings, RandomReadings
from fg_calib.simulation.scenario import Errors

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NAME = "18_design"
VIEWS: Mapping[str, dict[str, Any]] = {"camera 0.3-2 m": {"distance": (0.3, 2.0)}, "hemisphere": {}}
N_VIEWS = 52
"""Configurations of the paper: A and 51 others."""

WAYS: Mapping[str, dict[str, Any]] = {
    "poses": {"model": "pose"},
    "star": {"model": "distance-rotation", "pairing": "star"},
    "all pairs": {"model": "distance-rotation", "pairing": "all"},
}
"""What is measured; the latter two are distances and angles of pairs that are formed of poses."""

CRITERIA: tuple[Criterion, ...] = ("I", "D", "A", "E", "O2", "O4", "O5")
"""Those that differ from each other: O1 is D, and O3 is E."""
OTHERS: tuple[Criterion, ...] = ("D", "A", "O5")
"""Those that came nearest to I on the first arms; E, O2 and O4 leave 20 to 30 % more."""

N_STOPS, N_CANDIDATES, CELL = (10, 20), 500, 0.25
"""Of a random arm: stops, candidates, and the radius of the cell over the arm's reach."""

N_ROWS = {"ur10": (20, 40, 80), "panda": (20, 40, 80, 120)}
CHOSEN, RANDOM = "#0072B2", "#E69F00"


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    parts: dict[str, Callable[[argparse.Namespace], dict[str, Any]]]
    parts = {views: partial(paper, views) for views in VIEWS}
    parts |= {
        "formed pairs": formed_pairs,
        "arms": arms,
        "search": search,
        "ur10": ur10,
        "ur10, drawn noise": ur10_drawn,
        "panda": panda,
    }
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few draws, arms and seeds")
    parser.add_argument("--seed", type=int, default=0, help="of the first design, arm and draw")
    parser.add_argument("--draws", type=int, help="instead of 200 of the paper's arm")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), help="these parts")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results")
    add_workers(parser)
    given = parser.parse_args(arguments)
    given.workers = 1 if given.quick else given.workers
    given.draws = given.draws or (2 if given.quick else 200)
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / f"{NAME}.json"
    for part in given.only:
        before = processor_seconds()
        of_part = parts[part](given) | {"cpu_seconds": processor_seconds() - before, "quick": given.quick}
        found = (json.loads(file.read_text()) if file.exists() else {}) | {part: of_part}
        write_json(file, found)
        print(f"{part}\n{json.dumps(json.loads(file.read_text())[part], indent=1)}", flush=True)
    if {*VIEWS, "arms"} <= set(found):
        picture(found).savefig(file.with_suffix(".png"), dpi=120)
    return found


def processor_seconds() -> float:
    """Of this process and of workers that have ended."""
    return sum(sum(resource.getrusage(whose)[:2]) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


# ---- the paper's arm


def paper(views: str, given: argparse.Namespace) -> dict[str, Any]:
    """What designs expect of the paper's arm that looks at its board so, and what comes of them."""
    seeds = range(given.seed, given.seed + (1 if given.quick else 3))
    here = paper_scenario("unknown", **VIEWS[views])
    scenarios = {way: replace(here, job=job) for way, job in WAYS.items()}
    found: dict[str, Any] = {"n_draws": given.draws, "seeds": list(seeds)}
    plans: dict[str, list[Design]] = {}
    for way, scenario in scenarios.items():
        some = seeds[:1] if way == "all pairs" else seeds  # the design is that of poses
        plans[way] = [design(scenario, n=N_VIEWS, seed=seed) for seed in some]
        found[way] = {
            "designed": [plan.expected.position for plan in plans[way]],
            "random": [plan.random for plan in plans[way]],
            "designed stops that equal 52 random ones": [
                design(scenario, target=plan.random, seed=seed).n for plan, seed in zip(plans[way], some, strict=True)
            ],
            "curve": [[p.n, p.designed, *p.random] for p in plans[way][0].curve],
        }
    first = plans["poses"][0]
    by_volume = design(scenarios["poses"], n=N_VIEWS, seed=given.seed, criterion="D")
    found["poses, by D"] = by_volume.expected.position
    few = design(scenarios["poses"], target=first.random, seed=given.seed)
    rng = np.random.default_rng([given.seed, 1])
    random = first.pool.readings[rng.choice(len(first.pool.readings), N_VIEWS, replace=False)]
    sets: dict[str, tuple[str, Design, Floats]] = {
        "poses, designed": ("poses", first, first.readings),
        "poses, random": ("poses", first, random),
        "poses, as few designed as equal 52 random": ("poses", few, few.readings),
        "star, designed": ("star", plans["star"][0], plans["star"][0].readings),
    }
    if views != "hemisphere":  # all pairs hold what poses hold, and take ten times as long
        sets["all pairs, designed"] = ("all pairs", plans["all pairs"][0], plans["all pairs"][0].readings)
    found["realised"] = {
        name: realised(scenarios[way], plan, readings, given) for name, (way, plan, readings) in sets.items()
    }
    return found


def formed_pairs(given: argparse.Namespace) -> dict[str, Any]:
    """How much less all pairs hold than the poses that they are formed of, at stops chosen by the latter."""
    here = replace(paper_scenario("unknown"), configurations=RandomReadings(300))
    models = {"distance": "position", "distance-rotation": "pose"}
    found: dict[str, Any] = {}
    for n in (8, 20) if given.quick else (8, 12, 20, 30):
        found[f"{n} stops"] = {}
        for model, measured in models.items():
            pairs, poses = (
                design(replace(here, job=job), n=n, n_candidates=300, seed=given.seed)
                for job in ({"model": model, "pairing": "all"}, {"model": measured})
            )
            assert np.isin(pairs.readings, poses.readings).all(), "held to random sets, other stops were taken"
            found[f"{n} stops"][f"all pairs over poses, {model}"] = error(pairs) / error(poses)
    return found


def error(plan: Design) -> float:
    """Expected position error of a design [m], which must be known."""
    found = plan.expected.position
    assert found is not None
    return found


def realised(scenario: Scenario, plan: Design, readings: Floats, given: argparse.Namespace) -> dict[str, Any]:
    """Predicted RMS error of a set, [m], and that of calibrations of drawn arms, frames and noise."""
    there = replace(scenario, configurations=GivenReadings(readings), validation=None)
    pairing, model = Pairing(scenario.job.get("pairing", "star")), scenario.job["model"]
    pool = pool_of(there, drawn(there, len(readings), np.random.default_rng(0)))
    predicted = pool.posterior(np.arange(len(pool.readings)), pairing).error(plan.task).position
    draw = partial(drawn_square, there, plan.task.readings, model, pairing)
    seeds = range(1000 + given.seed, 1000 + given.seed + given.draws)
    squares, converged = zip(*over_draws(draw, seeds, given.workers), strict=True)
    rms = float(np.sqrt(np.mean(squares)))
    return {
        "n": len(readings),
        "predicted": predicted,
        "realised": rms,
        "ratio": rms / predicted,
        "sigma of ratio": float(0.5 * np.std(squares) / np.mean(squares) / np.sqrt(len(squares)) * rms / predicted),
        "not_converged": len(converged) - sum(converged),
    }


def drawn_square(scenario: Scenario, readings: Floats, model: Model, pairing: Pairing, seed: int) -> tuple[float, bool]:
    """Mean square error of one drawn arm's calibration, [m^2], and whether it converged."""
    simulation = fg_calib.simulate(scenario, seed)
    m = simulation.measurements
    problem = fg_calib.build_problem(simulation.robot, m, model=model, frame="unknown", pairing=pairing)
    solution = fg_calib.solve(problem)
    robot = simulation.robot.with_values(solution.parameters[problem.variables.robot_span])
    return fitted_square(robot, simulation.true_robot, readings), solution.converged


def fitted_square(robot: Robot, true_robot: Robot, readings: Floats) -> float:
    """Mean square of the tool's position error after the best rigid fit, [m^2]."""
    found, there = (fg_calib.pose(one, readings).position for one in (robot, true_robot))
    a, b = found - found.mean(axis=0), there - there.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt  # a @ turn is nearest to b
    return float(np.mean(np.sum((a @ turn - b) ** 2, axis=1)))


# ---- random arms


def pool_of_arm(robot: Robot, n_candidates: int, generator: np.random.Generator) -> Pool:
    """Positions by a tracker of 0.1 mm somewhere, at random configurations."""
    noise = Noise(position=1e-4, orientation=1e-4, joint=(np.deg2rad(0.003),) * robot.n_joints)
    configurations = RandomReadings(n_candidates)
    scenario = Scenario(robot, Errors("values", {}), configurations, noise, job={"model": "position"})
    return pool_of(scenario, drawn(scenario, n_candidates, generator))


def tasks_of(pool: Pool, generator: np.random.Generator) -> dict[str, Task]:
    """Anywhere within the limits, where the tool is in a ball about one of its places, and five configurations."""
    anywhere = random_readings(pool.robot, 20000, generator)
    p = fg_calib.pose(pool.robot, anywhere).position
    distance = np.linalg.norm(p - p[0], axis=1)
    near = np.argsort(distance, kind="stable")[: max(100, int(np.sum(distance < CELL * pool.robot.reach)))]
    cell = anywhere[generator.permutation(near)[:500]]
    return {"anywhere": Task(anywhere[:500], True), "cell": Task(cell, True), "five places": Task(anywhere[:5], True)}


def system_for(pool: Pool, task: Task) -> System:
    """What is chosen from."""
    return system_of(pool.rows, pool.known, task.form(pool.problem))


def best_of(system: System, n: int, criterion: Criterion) -> Chosen:
    """What `design` chooses."""
    chooser = Chooser(system, criterion)
    return not_worse_than_random(chooser.measure, chooser.best(n), np.random.default_rng(1))


def error_of(system: System, chosen: Integers) -> float:
    """Expected RMS error over the task, [m]."""
    return float(np.sqrt(Measure("I", system).value(system.information(chosen))))


def arms(given: argparse.Namespace) -> dict[str, Any]:
    """Expected errors of designs by each criterion on random arms, and of random sets."""
    n_arms = 3 if given.quick else 90
    rows = over_draws(partial(errors_of_arm, given.seed), range(n_arms), given.workers)
    return {"n_arms": n_arms, "of": N_CANDIDATES} | {of: gains([row[of] for row in rows]) for of in rows[0]}


def errors_of_arm(seed: int, k: int) -> dict[str, dict[str, float]]:
    """Expected errors of designs of one arm, [m], by criterion, and the median of random sets; by stops and task."""
    rng = np.random.default_rng([seed, k])
    pool = pool_of_arm(random_arm(5 + k % 3, rng), N_CANDIDATES, rng)
    systems = {where: system_for(pool, task) for where, task in tasks_of(pool, rng).items()}
    found = {}
    for n in N_STOPS:
        chosen = {c: best_of(systems["anywhere"], n, c).candidates for c in OTHERS}  # they know no task
        for where, system in systems.items():
            values, _ = random_values(Measure("I", system), n, rng)
            errors = {c: error_of(system, stops) for c, stops in chosen.items()}
            errors |= {"I": error_of(system, best_of(system, n, "I").candidates)}
            found[f"{n} stops, {where}"] = errors | {"random": float(np.sqrt(np.median(values)))}
    return found


def gains(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """By how much the I-design's error is below those of the others, shares of 1: 5 %, 50 %, 95 % of arms, and mean."""
    best = np.array([row["I"] for row in rows])
    others = {name: np.array([row[name] for row in rows]) for name in (*OTHERS, "random")}
    others["best other"] = np.min([others[name] for name in OTHERS], axis=0)
    found: dict[str, Any] = {"I, median [m]": float(np.median(best))}
    for name, error in others.items():
        gain = 1.0 - best / error
        p5, median, p95 = np.quantile(gain, [0.05, 0.5, 0.95]).tolist()
        found[name] = {"p5": p5, "median": median, "p95": p95, "mean": float(gain.mean()), "min": float(gain.min())}
    found["share of arms 10 % below D"] = float(np.mean(best <= 0.9 * others["D"]))
    found["share of arms 40 % below random"] = float(np.mean(best <= 0.6 * others["random"]))
    return found


# ---- the search


def search(given: argparse.Namespace) -> dict[str, Any]:
    """Greedy choice and exchange beside random sets and exhaustive search."""
    over: dict[str, list[float]] = {criterion: [] for criterion in CRITERIA}
    keys = [*CRITERIA, *(f"{c} exchange alone" for c in CRITERIA)]
    small: dict[str, dict[str, list[float]]] = {
        pool: {c: [] for c in keys} for pool in ("4 of 12", "3 of 15", "5 of 16")
    }
    for k in range(2 if given.quick else 30):
        rng = np.random.default_rng([given.seed, 100 + k])
        pool = pool_of_arm(random_arm(5 + k % 3, rng), 200, rng)
        system = system_for(pool, tasks_of(pool, rng)["anywhere"])
        for criterion in CRITERIA:
            measure = Measure(criterion, system)
            found = best_of(system, 12, criterion)
            values, _ = random_values(measure, 12, rng)
            over[criterion].append(index(criterion, system, found.value) / index(criterion, system, values.min()))
            for name, of_pool in small.items():
                n, of = (int(word) for word in name.split(" of "))
                part = system.select(np.arange(of))
                least = Measure(criterion, part)
                sets = [np.array(one) for one in combinations(range(of), n)]
                best = min(least.value(part.information(one)) for one in sets)
                for key, ours in (
                    ("", best_of(part, n, criterion)),
                    ("exchange alone", Chooser(part, criterion).best(n)),
                ):
                    ratio = index(criterion, part, ours.value) / index(criterion, part, best)
                    of_pool[f"{criterion} {key}".strip()].append(ratio)
    return {
        "n_systems": len(over["I"]),
        "12 of 200 over the best of 100 random sets": {
            c: {"largest": max(r), "median": float(np.median(r)), "worse": int(np.sum(np.array(r) > 1.0 + 1e-9))}
            for c, r in over.items()
        },
        "over the best of all sets": {
            name: {
                c: {
                    "largest": max(r),
                    "within 1 %": float(np.mean(np.array(r) <= 1.01)),
                    "the best": float(np.mean(np.array(r) <= 1.0 + 1e-9)),
                }
                for c, r in of_pool.items()
            }
            for name, of_pool in small.items()
        },
    }


def index(criterion: Criterion, system: System, value: float) -> float:
    """A positive figure of which less is better, in the unit of the criterion: of D the volume's root."""
    if criterion in ("D", "O1"):
        return float(np.exp(value / (2.0 * len(system.core))))
    return value if criterion in ("I", "A", "O5") else -1.0 / value


# ---- real rows


def loaded(file: str) -> ModuleType:
    """Another experiment, whose name is no name of a module."""
    spec = spec_from_file_location(file.removesuffix(".py"), ROOT / "experiments" / file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def of_rows(
    job: fg_calib.Job, given: argparse.Namespace, counts: Sequence[int], judge: Callable[[Any], float]
) -> dict[str, Any]:
    """Errors of calibrations from rows by design and from random rows, by their number, and from all."""
    table = job.tables[0]
    m = table.measurements
    train, test = m.ids[~m.test], m.ids[m.test].tolist()
    n_random = 3 if given.quick else 50
    rng = np.random.default_rng(given.seed)

    def error(ids: Sequence[str]) -> float:
        order = {name: k for k, name in enumerate([*ids, *test])}
        part = replace(job, measurements=(selected(table, order),), path=None)
        return judge(fg_calib.solve(fg_calib.problem_of(part)))

    tasks = {"train rows": m.readings[~m.test][:: max(1, int(np.sum(~m.test)) // 300)], "anywhere": None}
    found: dict[str, Any] = {"all": error(train.tolist()), "n_all": len(train), "n_random": n_random}
    for n in counts[:1] if given.quick else counts:
        random = [error(rng.choice(train, n, replace=False).tolist()) for _ in range(n_random)]
        low, middle, high = np.quantile(random, [0.1, 0.5, 0.9]).tolist()
        found[str(n)] = {"random": {"p10": low, "median": middle, "p90": high, "best": min(random)}}
        for name, task in tasks.items():
            plan = design(job, n=n, candidates="rows", task=task, seed=given.seed)
            designed = error(plan.ids.tolist())
            found[str(n)][f"task {name}"] = {
                "designed": designed,
                "share of random ones that are better": float(np.mean(np.array(random) < designed)),
                "expected": plan.expected.position,
                "expected of random": plan.random,
            }
    return found


def ur10_job(quick: bool) -> fg_calib.Job | None:
    """The UR10's job of poses; None where the data are missing."""
    first = loaded("01_ur10_real_data.py")
    if not first.data_folder().is_dir():
        return None
    with TemporaryDirectory() as folder:
        return fg_calib.read_job(first.write_jobs(first.data_folder(), Path(folder), 0, quick)["pose"])


def ur10(given: argparse.Namespace) -> dict[str, Any]:
    """Position error of the UR10's test rows, [m], by the rows fitted."""
    job = ur10_job(given.quick)
    if job is None:
        return {"skipped": True}

    def judge(solution: fg_calib.Solution) -> float:
        rms = fg_calib.assess(solution).residuals.rms()["test"]["position"]["after"]
        assert rms is not None
        return float(rms)

    return of_rows(job, given, N_ROWS["ur10"], judge)


def ur10_drawn(given: argparse.Namespace) -> dict[str, Any]:
    """The same rows with what the calibrated arm would measure there, with drawn noise: nothing that no model has.

    RMS over draws of the tool's error at the test rows after the best rigid fit, beside what is expected of the train
    rows, [m]; and the measured rows' residuals of the fit of all, at the train rows and at those that were chosen.
    """
    job = ur10_job(given.quick)
    if job is None:
        return {"skipped": True}
    m, solution = job.tables[0].measurements, fg_calib.solve(fg_calib.problem_of(job))
    true_robot = job.robot.with_values(solution.parameters[solution.problem.variables.robot_span])
    at, sigma = fg_calib.pose(true_robot, m.readings), loaded("01_ur10_real_data.py").NOISE
    train = np.flatnonzero(~m.test)
    table = fg_calib.assess(solution).residuals
    off = table.after[~table.test & np.char.startswith(table.kind, "position")].reshape(-1, 3)
    found: dict[str, Any] = {"residual of all": float(np.sqrt(np.mean(np.sum(off**2, axis=1))))}

    def square(rows: Integers, seed: int) -> float:
        noise = np.random.default_rng([given.seed, seed]).normal(size=(len(rows), 6))
        turned = Rotation.from_matrix(at.rotation[rows]) * Rotation.from_rotvec(sigma["orientation"] * noise[:, :3])
        position = at.position[rows] + sigma["position"] * noise[:, 3:]
        part = replace(job, measurements=replace(m.select(rows), position=position, rotation=turned.as_matrix()))
        fitted = fg_calib.solve(fg_calib.problem_of(part))
        robot = job.robot.with_values(fitted.parameters[fitted.problem.variables.robot_span])
        return fitted_square(robot, true_robot, m.readings[m.test])

    rng, n_draws = np.random.default_rng(given.seed), 2 if given.quick else 50
    for n in N_ROWS["ur10"][:1] if given.quick else N_ROWS["ur10"]:
        task = m.readings[train[:: max(1, len(train) // 300)]]
        plan = design(job, n=n, candidates="rows", task=task, seed=given.seed)
        chosen = np.flatnonzero(np.isin(m.ids, plan.ids))
        designed = [square(chosen, k) for k in range(n_draws)]
        random = [square(rng.choice(train, n, replace=False), k) for k in range(n_draws)]
        found[str(n)] = {
            "designed": float(np.sqrt(np.mean(designed))),
            "random": float(np.sqrt(np.mean(random))),
            "expected": plan.expected.position,
            "expected of random": plan.random,
            "residual of all at chosen": float(
                np.sqrt(np.mean(np.sum(off[np.searchsorted(train, chosen)] ** 2, axis=1)))
            ),
        }
    return found


def panda(given: argparse.Namespace) -> dict[str, Any]:
    """Spread of the ball centre at unseen locations, [m], by the touches fitted."""
    tenth = loaded("10_panda_sockets.py")
    if not tenth.data_folder().is_dir():
        return {"skipped": True}
    rows = tenth.read_rows(tenth.data_folder(), 0, False)
    readings = np.array([[float(row[f"q{k}"]) for k in range(1, 8)] for row in rows])
    with TemporaryDirectory() as folder:
        job = fg_calib.read_job(tenth.write_job(tenth.data_folder(), rows, Path(folder), "groups"))

    def judge(solution: fg_calib.Solution) -> float:
        p = solution.problem
        robot = p.robot.with_values(solution.parameters[p.variables.robot_span])
        return float(tenth.rms(tenth.judge(robot, readings, rows)["test"]["spread"]))

    return of_rows(job, given, N_ROWS["panda"], judge)


def picture(found: dict[str, Any]) -> Figure:
    """Expected error by the number of stops, and gains on random arms."""
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for views, line in zip(VIEWS, ("-", "--"), strict=True):
        curve = np.array(found[views]["poses"]["curve"])
        left.fill_between(curve[:, 0], curve[:, 2] / MM, curve[:, 4] / MM, color=RANDOM, alpha=0.3, lw=0)
        left.plot(curve[:, 0], curve[:, 3] / MM, line, color=RANDOM, label=f"random, {views} (10 to 90 %)")
        left.plot(curve[:, 0], curve[:, 1] / MM, line, color=CHOSEN, lw=2, label=f"designed, {views}")
        for name, row in found[views]["realised"].items():
            if name.startswith("poses"):
                colour = RANDOM if name == "poses, random" else CHOSEN
                left.plot(row["n"], row["realised"] / MM, "o", color=colour, mec="k", ms=7, zorder=3)
    left.plot([], [], "o", color="w", mec="k", ms=7, label=f"realised, {found[next(iter(VIEWS))]['n_draws']} draws")
    left.set(xscale="log", yscale="log", xlabel="configurations measured", ylabel="RMS tool position error [mm]")
    left.set_xticks([5, 10, 20, 52], ["5", "10", "20", "52"])
    left.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    left.minorticks_off()
    left.set_title("The paper's arm, poses in an unknown frame")
    left.legend(frameon=False, fontsize=8)
    names = (*OTHERS, "best other", "random")
    tasks = (("anywhere", CHOSEN), ("cell", "#009E73"), ("five places", "#CC79A7"))
    for j, (where, colour) in enumerate(tasks):
        for k, name in enumerate(names):
            g, y = found["arms"][f"{N_STOPS[0]} stops, {where}"][name], k + 0.22 * (j - 1)
            right.plot([100 * g["p5"], 100 * g["p95"]], [y, y], color=colour, lw=2)
            right.plot(100 * g["median"], y, "o", color=colour, label=f"task: {where}" if k == 0 else None)
    right.axvline(0.0, color="0.7", lw=0.8)
    right.set_yticks(range(len(names)), names)
    right.invert_yaxis()
    right.set(xlabel="I-design's error below the other's [%], 5 to 95 % of arms")
    right.set_title(f"{found['arms']['n_arms']} random arms, {N_STOPS[0]} of {N_CANDIDATES} stops")
    right.legend(frameon=False, fontsize=8)
    for axes in (left, right):
        clean(axes)
    return figure


if __name__ == "__main__":
    main()
