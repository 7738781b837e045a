"""The paper's tables and figures, and whether its claims hold over many draws.

    python experiments/paper.py [--quick] [--only QUESTION ...] [--workers 2]

The scenario is `space-robot`: errors uniform within Table 6's bounds (which the paper's own residuals show it means),
52 views of a board from a half sphere of 0.5 m, Table 5's noise, 500 configurations of validation within +-180 degrees.

| question | what |
|---|---|
| identifiability | Tables 3 and 4: classes of 35 parameters, ranks of six models, the same through the graph |
| residuals | Tables 7 to 9: residuals, true minus calibrated, and the sums of Eq. (57) and (58), of one draw |
| validation | Table 10, Figures 8 to 10 of the same draw, and what Table 10 is by the paper's own residuals |
| claims | Table 10 over 200 draws, by plain least squares and by the graph with priors, and the bounds |
| choices | by how much each choice that the paper leaves open changes the bound and the error |
| frames | what pairs hold of the poses that they are formed from, and what an unknown frame costs |

Traps: one draw of relative models says little, their errors differ by a factor of ten between draws. The draw shown is
the one whose mean error before calibration is nearest to the median of 200, whatever its results. Errors in the base
frame hold where the base is; errors after the best rigid fit do not.

Takes fifteen minutes with two workers, most of it `frames` and `choices`.

Reference:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import scipy.linalg
from common import COLOURS, MM, Question, Row, Task, by_cell, clean, rms, run, spread
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fg_calib import Measurements, Pairing, Robot, Scenario, build_problem, observe_structure, simulate, solve
from fg_calib.baseline import fit_least_squares, real_errors
from fg_calib.observability.cramer_rao import Bound, cramer_rao
from fg_calib.robot import pose
from fg_calib.simulation import Placement, Simulation, read_scenario

Floats = NDArray[np.float64]

MODELS = {"distance": "distance", "distance-rotation": "distance + rotation", "pose": "absolute pose"}
"""The paper's three error models."""

KINDS = ("a", "alpha", "d", "theta", "beta")
RANKS = {"pose": 29, "distance-rotation": 23, "distance": 21, "rotation": 11, "position": 25, "orientation": 15}
NO_EFFECT = "a1 alpha1 d1 theta1 beta6 theta7 beta7"
PAPER_CLASSES = {
    "pose": ("", ["beta1 theta2", "beta2 theta3", "d3 d4", "d4 d5", "beta5 theta6", "beta6 theta7"]),
    "distance-rotation": (NO_EFFECT, ["beta1 theta2", "beta2 theta3", "d3 d4", "d4 d5", "beta5 theta6"]),
}
"""Tables 3 and 4: the ineffective parameters and the relative pairs; all others are independent."""

FIXED_BY_PRIOR = {"pose": 6, "distance-rotation": 12, "distance": 14}
"""Directions of 35 that the measurements leave to the prior."""

PAPER_TABLE_10 = {
    "before": (38.0, 19.0),
    "distance": (21.0, 11.0),
    "distance-rotation": (4.8, 2.5),
    "pose": (1.1, 0.5),
}
"""Table 10: maximum and mean position error over 500 configurations of one run, [mm]."""

PAPER_RESIDUALS = {
    "distance": """
        0.00054  0.00445  0.00094  0.00038 -0.04111
        0.00063  0.01097  0.00015  0.03997  0.11269
        0.00355  0.00632 -0.00861  0.01106  0.15176
        0.00442 -0.07475  0.02887  0.05620 -0.04298
        0.00012 -0.20839 -0.00284 -0.01352 -0.02700
       -0.00194 -0.29798  0.00152 -0.00042 -0.03749""",
    "distance-rotation": """
        0.00056  0.00050  0.00051  0.00176 -0.04111
        0.00041 -0.00313  0.00015  0.03701  0.00586
        0.00081  0.00485 -0.00861  0.01164  0.01368
        0.00053 -0.00637  0.01005  0.00310 -0.04298
        0.00048 -0.01963  0.00047 -0.05903 -0.02700
       -0.00159 -0.01215  0.00045 -0.00042 -0.03749""",
    "pose": """
        0.00017  0.00140 -0.00024  0.00247 -0.04111
        0.00016  0.00262  0.00015  0.04160  0.00187
       -0.00005  0.00014 -0.00861 -0.00283  0.00287
       -0.00009  0.00569  0.00890  0.00251 -0.04298
        0.00005 -0.00458 -0.00003 -0.04436 -0.02700
       -0.00006  0.00457 -0.00003 -0.02722  0.00050""",
}
"""Tables 7 to 9, joints 2 to 7, in the order of `KINDS`: [m] and [deg]; joint 1 is known."""

NOT_ESTIMATED = {
    "distance": ("beta2", "d3", "d4", "beta5", "beta6", "theta7", "beta7"),
    "distance-rotation": ("beta2", "d3", "d4", "beta5", "beta6", "theta7", "beta7"),
    "pose": ("beta2", "d3", "d4", "beta5", "beta6"),
}
"""Parameters whose residual is the same in Tables 7 to 9, or 7 and 8: those that the paper left at nominal."""

SUMS: Mapping[str, Mapping[str, float]] = {
    "beta1 + theta2": {"theta2": 1.0},
    "beta2 + theta3": {"beta2": 1.0, "theta3": 1.0},
    "d3 + d4 + d5": {"d3": 1.0, "d4": 1.0, "d5": 1.0},
    "beta5 - theta6": {"beta5": 1.0, "theta6": -1.0},
    "beta6 - theta7": {"beta6": 1.0, "theta7": -1.0},
}
"""Eq. (57) and (58); beta1 is known."""

DETERMINED = {"distance": 3, "distance-rotation": 4, "pose": 5}
"""How many of `SUMS` a model determines."""

ESTIMATORS = ("least squares", "graph")
"""Plain least squares as in the paper (metres and radians alike, its parameters), and the graph with priors."""


def paper_scenario(frame: Any = "base", **views: Any) -> Scenario:
    """Return the shipped scenario with another measurement frame or other views of the board."""
    scenario = _shipped()
    return replace(scenario, frame=frame, configurations=replace(scenario.configurations, **views))


@cache
def _shipped() -> Scenario:
    return read_scenario("space-robot")


def validation(simulation: Simulation) -> Floats:
    """Readings of the test configurations, shape (n, 7), [rad]."""
    readings: Floats = simulation.measurements.readings[simulation.measurements.test]
    return readings


def papers_names(robot: Robot, model: str) -> list[str]:
    """Names of the parameters that the paper estimated."""
    return [p.name for p in robot.parameters if p.estimated and p.name not in NOT_ESTIMATED[model]]


def paper_residuals(model: str) -> dict[str, float]:
    """The paper's residuals, true minus calibrated, by parameter name, [m] and [rad]."""
    names = [f"{kind}{joint}" for joint in range(2, 8) for kind in KINDS]
    values = [float(number) for number in PAPER_RESIDUALS[model].split()]
    return {n: v if n[:-1] in ("a", "d") else np.deg2rad(v) for n, v in zip(names, values, strict=True)}


def fit(simulation: Simulation, model: str, estimator: str) -> Robot:
    """Calibrate from a star of pairs, or from poses in the base frame, by one of the `ESTIMATORS`."""
    robot, rows = simulation.robot, simulation.measurements
    if estimator == "least squares":
        data = build_problem(robot, rows, model=model).data
        return fit_least_squares(robot, data, names=papers_names(robot, model)).robot
    return solve(build_problem(robot, rows, model=model)).robot


def bound_of(simulation: Simulation, model: str, estimator: str) -> Bound:
    """Cramer-Rao bound of one of the `ESTIMATORS`."""
    true = simulation.true_robot
    kept = papers_names(true, model) if estimator == "least squares" else None
    return cramer_rao(true, simulation.measurements, model=model, prior=kept is None, kept=kept)


def position_errors(estimated: Robot, true: Robot, readings: Floats) -> Row:
    """Maximum, mean and RMS position error in the base frame, and the last two after the best rigid fit, [m]."""
    found = real_errors(estimated, true, readings)
    return {
        **{key: getattr(found.base_frame, key) for key in ("max", "mean", "rms")},
        **{f"fitted {key}": getattr(found.best_rigid_fit, key) for key in ("mean", "rms")},
    }


# --- identifiability ------------------------------------------------------------------------------------------------


def arm_of_table_2() -> Robot:
    """The paper's arm with all 35 parameters to be estimated."""
    robot = _shipped().robot
    return robot.with_estimated([p.name for p in robot.parameters if 1 <= p.owner <= robot.n_joints])


def identify(task: Task) -> Row:
    """Classes of one model against the paper's, and the same directions through GTSAM's graph."""
    (model,) = task
    robot = arm_of_table_2()
    found = observe_structure(robot, model, n_configurations=200, seed=0).observability
    relations = [" ".join(relation) for group in found.relative for relation in group.relations]
    row: Row = {"rank": found.rank, "gap": found.gap, "entries": 0, "pairs": 0}
    if model in PAPER_CLASSES:
        ineffective, pairs = PAPER_CLASSES[model]
        relative = {name for pair in pairs for name in pair.split()}
        ours = dict(zip(found.names, found.classes, strict=True))
        expected = {n: "ineffective" if n in ineffective.split() else "relative" if n in relative else "independent"
                    for n in found.names}  # fmt: skip
        row["entries"] = sum(ours[name] != expected[name] for name in found.names)
        row["pairs"] = len(set(pairs) ^ set(relations))
    if model in FIXED_BY_PRIOR:
        row |= through_the_graph(robot, model, found.null_space)
    return row


def through_the_graph(robot: Robot, model: str, null_space: Floats) -> Row:
    """Directions that GTSAM's linearised graph leaves to weak priors, and their angle to the null space."""
    weak = replace(robot, parameters=tuple(replace(p, tolerance=1.0) for p in robot.parameters))
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, robot.n_joints))
    at = pose(robot, q)
    rows = Measurements.from_arrays(
        q, position=at.position, rotation=at.rotation, sigma_position=1e-3, sigma_orientation=1e-3
    )
    problem = build_problem(weak, rows, model=model, pairing=Pairing("star"))
    ordering = gtsam.Ordering()
    keys = problem.variables.keys
    for key in [*keys, *(key for key in problem.graph.keyVector() if key not in keys)]:
        ordering.push_back(key)
    full = problem.graph.linearize(problem.initial).hessian(ordering)[0]
    n = null_space.shape[1]  # the poses' errors, which pairs share, come last and are eliminated
    hessian = full[:n, :n] - full[:n, n:] @ np.linalg.solve(full[n:, n:], full[n:, :n])
    values, vectors = np.linalg.eigh(hessian)
    fixed = values < 2.0  # the prior's information is 1
    scales = np.array([robot.scale_of(p.unit) for p in robot.parameters if p.estimated])
    null = scipy.linalg.orth((null_space * scales).T)
    angle = float(scipy.linalg.subspace_angles(vectors[:, fixed], null).max())
    return {"left to the prior": int(fixed.sum()), "angle to the null space": angle}


def identify_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by model."""
    return {model: row for (model,), row in zip(tasks, rows, strict=True)}


def identify_answer(found: Row) -> str:
    """Ranks, and how many entries differ from the paper's tables."""
    differ = sum(row["entries"] + row["pairs"] for row in found.values())
    ranks = ", ".join(f"{model} {found[model]['rank']}" for model in RANKS)
    left = ", ".join(str(found[model]["left to the prior"]) for model in FIXED_BY_PRIOR)
    return f"{differ} entries differ from Tables 3 and 4; ranks of 35: {ranks}; through the graph {left} are left"


# --- Tables 7 to 10 of one draw -------------------------------------------------------------------------------------


@cache
def typical_seed(n_draws: int, first: int) -> int:
    """Seed of the draw whose mean error before calibration is nearest to the median."""
    means = []
    for seed in range(first, first + n_draws):
        s = simulate(paper_scenario(), seed)
        means.append(position_errors(s.robot, s.true_robot, validation(s))["mean"])
    return first + int(np.argmin(np.abs(np.array(means) - np.median(means))))


def models_of_one_draw(n_draws: int, first: int) -> list[Task]:
    """A task a model, all of the typical draw."""
    seed = typical_seed(n_draws, first)
    return [(model, seed) for model in MODELS]


def residuals_of(task: Task) -> Row:
    """Residuals of every parameter and of the sums by each estimator, and the sums' bounds, [m] and [rad]."""
    model, seed = task
    simulation = simulate(paper_scenario(), seed)
    true, names = simulation.true_robot, list(paper_residuals("pose"))
    row: Row = {"names": names, "paper": list(paper_residuals(model).values())}
    for who in ESTIMATORS:
        values = fit(simulation, model, who).nominal
        row[who] = [true.nominal[true.index(n)] - values[true.index(n)] for n in names]
        bound = bound_of(simulation, model, who)
        row[f"bound {who}"] = [_sigma_of(bound, terms) for terms in SUMS.values()]
    for who in ("paper", *ESTIMATORS):
        row[f"sums {who}"] = [sum(c * row[who][names.index(n)] for n, c in terms.items()) for terms in SUMS.values()]
    return row


def _sigma_of(bound: Bound, terms: Mapping[str, float]) -> float:
    w = np.array([terms.get(name, 0.0) for name in bound.names])
    return float(np.sqrt(w @ bound.covariance @ w))


def residuals_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by model, with the largest determined sum over its bound."""
    found = {}
    for (model, _), row in zip(tasks, rows, strict=True):
        k = DETERMINED[model]
        z = {who: np.abs(row[f"sums {who}"][:k]) / np.array(row[f"bound {who}"][:k]) for who in ESTIMATORS}
        found[model] = row | {f"largest z {who}": float(z[who].max()) for who in ESTIMATORS}
    return found


def residuals_answer(found: Row) -> str:
    """The largest determined sum in units of its bound."""
    z = {who: max(row[f"largest z {who}"] for row in found.values()) for who in ESTIMATORS}
    return (
        "Yes: parameters left at nominal keep their error, and the sums that a model determines are within "
        + " and ".join(f"{value:.1f} sigma of their bound by {who}" for who, value in z.items())
    )


def draw_residuals(found: Row, path: Path) -> None:
    """Draw the residual of each parameter over its largest error before, a panel a model."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True, sharey=True)
    for axes, (model, row) in zip(panels, found.items(), strict=True):
        x = np.arange(len(row["names"]))
        largest = np.array([0.01 if name[:-1] in ("a", "d") else np.deg2rad(0.05) for name in row["names"]])
        axes.axhspan(-1.0, 1.0, color="0.94")
        styles = (("paper", "D", "k"), ("least squares", "s", "0.5"), ("graph", "o", COLOURS[0]))
        for (who, marker, colour), shift in zip(styles, (-0.22, 0.0, 0.22), strict=True):
            axes.plot(x + shift, row[who] / largest, marker, color=colour, label=who, fillstyle="none", ms=5)
        axes.set_yscale("symlog", linthresh=0.3)
        axes.set_ylabel("error left\nover its bound")
        axes.set_title(f"calibrated by {MODELS[model]}", loc="left", fontsize=10)
        clean(axes)
    figure.suptitle("Error of each parameter that is left, over its bound before (10 mm or 0.05 deg): Tables 7 to 9")
    panels[0].legend(
        *panels[0].get_legend_handles_labels(), loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False
    )
    panels[2].set_xticks(x, row["names"], rotation=60)
    figure.savefig(path, dpi=100)


def validate(task: Task) -> Row:
    """Table 10 of one model: by the paper's own residuals, and of our draw by each estimator, [m]."""
    model, seed = task
    simulation = simulate(paper_scenario(), seed)
    nominal, true, readings = simulation.robot, simulation.true_robot, validation(simulation)
    values = nominal.nominal.copy()
    for name, residual in paper_residuals(model).items():
        values[nominal.index(name)] -= residual
    row: Row = {
        "before": position_errors(nominal, true, readings),
        "from paper": position_errors(nominal.with_values(values), nominal, readings),
        "traces": {"before": _errors_of(nominal, true, readings)},
    }
    for who in ESTIMATORS:
        fitted = fit(simulation, model, who)
        row[who] = position_errors(fitted, true, readings)
        row[f"bound {who}"] = bound_of(simulation, model, who).position(readings)
        row["traces"][who] = _errors_of(fitted, true, readings)
    return row


def _errors_of(robot: Robot, true: Robot, readings: Floats) -> list[float]:
    return [float(e) for e in np.linalg.norm(pose(robot, readings).position - pose(true, readings).position, axis=1)]


def validation_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Rows by model, against the paper's Table 10."""
    return {m: row | {"paper": PAPER_TABLE_10[m]} for (m, _), row in zip(tasks, rows, strict=True)}


def validation_answer(found: Row) -> str:
    """Mean errors by the paper's residuals and of our draw, [mm]."""
    papers = ", ".join(f"{found[m]['from paper']['mean'] / MM:.2f}" for m in MODELS)
    ours = ", ".join(f"{found[m]['graph']['mean'] / MM:.2g}" for m in MODELS)
    before = next(iter(found.values()))["before"]["mean"] / MM
    return (
        f"It follows from the paper's own Tables 7 to 9: means {papers} mm (paper 11, 2.5, 0.5). In our draw "
        f"{before:.1f} mm before (19), with priors {ours} mm"
    )


def draw_validation(found: Row, path: Path) -> None:
    """Draw Figures 9 and 10: errors by configuration and their distribution, a row an estimator."""
    figure = Figure(figsize=(13, 7), layout="constrained")
    panels = figure.subplots(2, 2, width_ratios=[2, 1])
    for (line, bars), who in zip(panels, ESTIMATORS, strict=True):
        traces = {"before": next(iter(found.values()))["traces"]["before"]}
        traces |= {MODELS[model]: row["traces"][who] for model, row in found.items()}
        for (label, errors), colour in zip(traces.items(), ("0.4", *COLOURS), strict=False):
            e = np.array(errors) / MM
            line.semilogy(e, color=colour, lw=0.8, label=f"{label}: mean {e.mean():.2g} mm")
            bars.hist(e, bins=np.geomspace(0.02, 60, 50), color=colour, histtype="step")
        line.set_title(f"by {'the factor graph' if who == 'graph' else who}", loc="left", fontsize=10)
        line.set(xlabel="validation configuration", ylabel="tool error [mm]")
        line.legend(ncols=2, frameon=False, loc="upper right", bbox_to_anchor=(1.0, 1.22), fontsize=9)
        bars.set(xscale="log", xlabel="tool error [mm]", ylabel="configurations")
        clean(line)
        clean(bars)
    figure.suptitle("Tool error of the paper's arm at 500 configurations, by what was measured: Figures 9 and 10")
    figure.savefig(path, dpi=100)


# --- Table 10 over many draws, choices, frames ----------------------------------------------------------------------

NEAR_BOARD = Placement(np.eye(3), np.array([0.0, 2.5, 2.55]))
CHOICES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "base": ("as shipped", {}),
    "distance": ("camera 0.3 to 2 m from the board", {"distance": (0.3, 2.0)}),
    "board": ("board 2.5 m from the base, not 6.5 m", {"board": NEAR_BOARD}),
    "roll": ("roll held", {"roll": 0.0}),
    "self-motion": ("self-motion held", {"self_motion": "held"}),
    "20": ("20 configurations", {"count": 19}),
    "100": ("100 configurations", {"count": 99}),
    "encoders": ("no encoder noise", {}),
}


def claim(task: Task) -> Row:
    """Errors and bounds of every model and estimator on one draw of one choice, [m]."""
    choice, seed = task
    scenario = paper_scenario(**CHOICES[choice][1])
    if choice == "encoders":
        scenario = replace(scenario, noise=replace(scenario.noise, joint=0.0))
    simulation = simulate(scenario, seed)
    readings, true = validation(simulation), simulation.true_robot
    row: Row = {"before": position_errors(simulation.robot, true, readings)["mean"]}
    for model in MODELS:
        for who in ESTIMATORS:
            errors = position_errors(fit(simulation, model, who), true, readings)
            bound = bound_of(simulation, model, who).position(readings)
            row |= {f"{model} {who} {key}": errors[key] for key in ("max", "mean", "rms")}
            row[f"{model} {who} bound"] = bound
    return row


def claims_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """Spreads over the draws of each choice, error over bound, and how often the paper's order holds."""
    found: Row = {}
    for choice, values in by_cell(tasks, rows).items():
        cell: Row = {key: spread(v) for key, v in values.items()}
        for model in MODELS:
            for who in ESTIMATORS:
                key = f"{model} {who}"
                cell[f"{key} over bound"] = rms(values[f"{key} rms"]) / rms(values[f"{key} bound"])
        mean = {m: values[f"{m} least squares mean"] for m in MODELS}
        cell["at most 2.5 mm"] = float(np.mean(mean["distance-rotation"] <= 2.5 * MM))
        cell["paper's order"] = float(
            np.mean((mean["distance"] > mean["distance-rotation"]) & (mean["distance-rotation"] > mean["pose"]))
        )
        found[choice] = cell
    return found


def claims_answer(found: Row) -> str:
    """Medians of the mean errors by estimator, and the share of draws as good as Table 10."""
    cell = found["base"]
    plain, graph = ([cell[f"{m} {who} mean"]["median"] / MM for m in MODELS] for who in ESTIMATORS)
    worst = max(cell[f"{m} {who} over bound"] for m in MODELS for who in ESTIMATORS)
    return (
        f"Absolute pose {plain[2]:.2f} mm (paper 0.5): yes. Distance + rotation {plain[1]:.1f} mm, not 2.5, which "
        f"{cell['at most 2.5 mm']:.1%} of draws reach; distance {plain[0]:.1f} mm. With priors {graph[0]:.1f} and "
        f"{graph[1]:.1f} mm. RMS errors at most {worst:.2f} times the bound"
    )


def choices_answer(found: Row) -> str:
    """By what factor each choice changes the bound of the graph, largest first."""
    text = []
    for model in ("distance-rotation", "pose"):
        of = {c: row[f"{model} graph bound"]["rms"] for c, row in found.items()}
        factors = sorted(
            ((of[c] / of["base"], CHOICES[c][0]) for c in of if c != "base"), key=lambda f: -abs(np.log(f[0]))
        )
        text.append(f"{MODELS[model]}: " + ", ".join(f"{words} {f:.2f}" for f, words in factors[:4]))
    return "Factors on the bound with priors; " + "; ".join(text)


CASES: Mapping[str, dict[str, Any]] = {
    "distance, star": {"model": "distance"},
    "distance + rotation, star": {"model": "distance-rotation"},
    "distance + rotation, all pairs": {"model": "distance-rotation", "pairing": Pairing("all")},
    "all pairs as independent": {
        "model": "distance-rotation", "pairing": Pairing("all"), "pair_errors": "independent"
    },
    "poses, unknown frame": {"model": "pose", "frame": "unknown"},
    "poses, known frame": {"model": "pose"},
}  # fmt: skip
VIEWS: Mapping[str, Row] = {"half sphere": {}, "0.3 to 2 m": {"distance": (0.3, 2.0)}}


def frame(task: Task) -> Row:
    """RMS error, its bound and the claim of every case on one draw, [m]."""
    views, seed = task
    row: Row = {}
    for case, options in CASES.items():
        known = case == "poses, known frame"
        s = simulate(paper_scenario("base" if known else "unknown", **VIEWS[views]), seed)
        readings, fitted = validation(s), s.measurements.select(np.flatnonzero(~s.measurements.test))
        bound = cramer_rao(s.true_robot, fitted, **options)
        robot = solve(build_problem(s.robot, fitted, **options)).robot
        row |= {
            case: position_errors(robot, s.true_robot, readings)["rms"],
            f"{case}: bound": bound.position(readings),
            f"{case}: claimed": bound.position(readings, claimed=True),
        }
    return row


def frames_summary(tasks: Sequence[Task], rows: Sequence[Row]) -> Row:
    """RMS over draws by views."""
    return {views: {key: rms(v) for key, v in values.items()} for views, values in by_cell(tasks, rows).items()}


def frames_answer(found: Row) -> str:
    """RMS errors of the cases, [mm]."""
    parts = []
    for views, row in found.items():
        cells = {case: row[case] / MM for case in CASES}
        claimed = row["all pairs as independent: claimed"] / MM
        parts.append(
            f"{views}: " + ", ".join(f"{case} {v:.2g}" for case, v in cells.items()) + f" (claims {claimed:.2g})"
        )
    return "RMS over +-180 deg, mm; " + "; ".join(parts)


def seeds_of(*cells: str) -> Any:
    """Tasks of all draws of some cells."""
    return lambda n, first: [(cell, seed) for cell in cells for seed in range(first, first + n)]


QUESTIONS = (
    Question("identifiability", "What can the paper's robot identify?", lambda n, s: [(m,) for m in RANKS],
             identify, identify_summary, identify_answer),
    Question("residuals", "Do residuals cancel as in Tables 7 to 9?", models_of_one_draw, residuals_of,
             residuals_summary, residuals_answer, (200, 5), draw_residuals),
    Question("validation", "Is Table 10 right?", models_of_one_draw, validate, validation_summary, validation_answer,
             (200, 5), draw_validation),
    Question("claims", "Do the paper's claims hold over many draws?", seeds_of("base"), claim, claims_summary,
             claims_answer, (200, 2)),
    Question("choices", "Which open choice matters most?", seeds_of(*CHOICES), claim, claims_summary, choices_answer,
             (20, 1)),
    Question("frames", "What does an unknown frame cost, and what do pairs hold of poses?", seeds_of(*VIEWS), frame,
             frames_summary, frames_answer, (40, 1)),
)  # fmt: skip

if __name__ == "__main__":
    run(QUESTIONS, Path(__file__).stem, __doc__, sys.argv[1:])
