"""What experiments 03 to 07 share: the paper's scenario and values, the estimators, errors, bounds and draws.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering. Section 5.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from draws import add_workers
from matplotlib.axes import Axes
from numpy.typing import NDArray

from fg_calib import Bound, Robot, Scenario, Simulation, build_problem, fit_least_squares, read_scenario, solve
from fg_calib.baseline.comparison import real_errors
from fg_calib.options import Model
from fg_calib.simulation.configurations import BoardViews

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
MM = 1e-3

MODELS: Mapping[Model, str] = {
    "distance": "distance",
    "distance-rotation": "distance + rotation",
    "pose": "absolute pose",
}
"""The paper's three error models."""

COLOURS: Mapping[str, str] = {
    "before": "#555555",
    "distance": "#D55E00",
    "distance-rotation": "#0072B2",
    "pose": "#009E73",
}

PAPER_TABLE_10: Mapping[str, Mapping[str, float]] = {
    "before": {"max": 38 * MM, "mean": 19 * MM},
    "distance": {"max": 21 * MM, "mean": 11 * MM},
    "distance-rotation": {"max": 4.8 * MM, "mean": 2.5 * MM},
    "pose": {"max": 1.1 * MM, "mean": 0.5 * MM},
}
"""Table 10: position errors of 500 validation configurations of one run, [m]."""

KINDS = ("a", "alpha", "d", "theta", "beta")

PAPER_RESIDUALS: Mapping[Model, str] = {
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

ESTIMATORS: Mapping[str, str] = {
    "unweighted": "plain least squares, metres beside radians (the paper's)",
    "weighted": "plain least squares, weighted by noise",
    "graph-keep": "graph without priors",
    "graph": "graph, tolerances as priors",
}

NOT_ESTIMATED: Mapping[Model, tuple[str, ...]] = {
    "distance": ("beta2", "d3", "d4", "beta5", "beta6", "theta7", "beta7"),
    "distance-rotation": ("beta2", "d3", "d4", "beta5", "beta6", "theta7", "beta7"),
    "pose": ("beta2", "d3", "d4", "beta5", "beta6"),
}
"""Parameters 2 to 7 whose residual is the same in Tables 7 to 9, or 7 and 8: those that the paper left at nominal."""

PREFER = ("theta2", "theta3", "d5", "theta6", "theta7", "beta7", "a7", "alpha7")
"""What is kept of relative groups, as in the paper."""

FIGURES = ("max", "mean", "rms")


def paper_scenario(frame: str = "base", **views: Any) -> Scenario:
    """The shipped scenario; the measurement frame as given, and the views of the board changed."""
    scenario = _shipped()
    assert isinstance(scenario.configurations, BoardViews)
    changed = replace(scenario.configurations, **views)
    return replace(scenario, frame=frame, configurations=changed)  # type: ignore[arg-type]


@cache
def _shipped() -> Scenario:
    return read_scenario("space-robot")


def validation(simulation: Simulation) -> Floats:
    """Readings of the test configurations, shape (n, 7), [rad]."""
    return simulation.measurements.readings[simulation.measurements.test]


def papers_names(robot: Robot, model: Model) -> list[str]:
    """The parameters that the paper estimated, by its Tables 7 to 9."""
    return [p.name for p in robot.parameters if p.estimated and p.name not in NOT_ESTIMATED[model]]


def paper_residuals(model: Model) -> dict[str, float]:
    """The paper's residuals, true minus calibrated, by parameter name, [m] and [rad]."""
    names = [f"{kind}{joint}" for joint in range(2, 8) for kind in KINDS]
    numbers = [float(number) for number in PAPER_RESIDUALS[model].split()]
    units = [1.0 if name[:-1] in ("a", "d") else np.pi / 180.0 for name in names]
    return {name: number * unit for name, number, unit in zip(names, numbers, units, strict=True)}


@dataclass(frozen=True)
class Fit:
    """What an estimator made of a simulation: the robot, and whether it arrived."""

    robot: Robot
    converged: bool


def fit(simulation: Simulation, model: Model, estimator: str) -> Fit:
    """Calibrate from a star of pairs, or from poses in the base frame, by one of the `ESTIMATORS`."""
    robot, measurements = simulation.robot, simulation.measurements
    if estimator in ("unweighted", "weighted"):
        plain = fit_least_squares(
            robot, measurements, model=model, names=papers_names(robot, model), weighted=estimator == "weighted"
        )
        return Fit(plain.robot, plain.converged)
    gauge: Any = {"gauge": "keep", "prefer": PREFER} if estimator == "graph-keep" else {}
    solution = solve(build_problem(robot, measurements, model=model, **gauge))
    return Fit(robot.with_values(solution.parameters[:-6]), solution.converged)


def position_errors(estimated: Robot, true: Robot, readings: Floats) -> dict[str, float]:
    """Position errors over configurations, in the base frame and (`fitted_`) after the best rigid fit, [m]."""
    real = real_errors(estimated, true, readings)
    assert real.fitted is not None
    return {key: getattr(real.base, key) for key in FIGURES} | {
        f"fitted_{key}": getattr(real.fitted, key) for key in FIGURES
    }


def position_bound(bound: Bound, readings: Floats) -> dict[str, float]:
    """The same figures as an efficient estimator would have them: see `fg_calib.Bound.position`, [m]."""
    base, fitted = bound.position(readings), bound.position(readings, fitted=True)
    return {key: getattr(base, key) for key in FIGURES} | {f"fitted_{key}": getattr(fitted, key) for key in FIGURES}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, 5 and 95 % quantiles, and root mean square over draws; what is not finite counts as infinite."""
    x = np.asarray(values, dtype=np.float64)
    x = np.where(np.isfinite(x), x, np.inf)
    low, median, high = np.quantile(x, [0.05, 0.5, 0.95], method="nearest")
    return {"median": float(median), "p5": float(low), "p95": float(high), "rms": float(np.sqrt(np.mean(x**2)))}


def spreads(rows: Sequence[Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """`spread` of every figure of many draws."""
    return {key: spread([row[key] for row in rows]) for key in rows[0]}


def typical_seed(first: int, n: int) -> tuple[int, dict[str, float]]:
    """The draw whose mean error before calibration is nearest the median of `n` draws, and that median's spread."""
    scenario = paper_scenario()
    means = []
    for seed in range(first, first + n):
        simulation = one_draw(scenario, seed)
        means.append(position_errors(simulation.robot, simulation.true_robot, validation(simulation))["mean"])
    found = spread(means)
    return first + int(np.argmin(np.abs(np.array(means) - np.median(means)))), found


def one_draw(scenario: Scenario, seed: int) -> Simulation:
    """`fg_calib.simulate`."""
    from fg_calib import simulate

    return simulate(scenario, seed)


def arguments_of(
    docstring: str | None, name: str, given: Sequence[str] | None, n_draws: int, n_quick: int
) -> argparse.Namespace:
    """Quick, seed (the first), draws, workers and output folder, which is made; `file` is results without suffix."""
    parser = argparse.ArgumentParser(description=(docstring or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=f"{n_quick} draws instead of {n_draws}")
    parser.add_argument("--seed", type=int, default=0, help="of the first draw")
    parser.add_argument("--draws", type=int, help=f"instead of {n_draws}")
    add_workers(parser)
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results")
    found = parser.parse_args(given)
    found.draws = found.draws or (n_quick if found.quick else n_draws)
    found.workers = 1 if found.quick else found.workers
    found.out.mkdir(parents=True, exist_ok=True)
    found.file = found.out / name
    return found


def write_json(file: Path, found: Mapping[str, Any]) -> None:
    """Write results beside the figure; numbers to six digits."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.6g}")
        if isinstance(value, Mapping):
            return {key: short(v) for key, v in value.items()}
        return [short(v) for v in value] if isinstance(value, list | tuple) else value

    file.with_suffix(".json").write_text(json.dumps(short(found), indent=1) + "\n")


def clean(axes: Axes) -> None:
    """No frame but the axes."""
    axes.spines[["top", "right"]].set_visible(False)
