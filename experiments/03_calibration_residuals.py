"""Which parameters does each error model find, and do the residuals of relative parameters cancel in their sums?

Command: python experiments/03_calibration_residuals.py [--quick] [--seed N] [--out FOLDER]
Takes ten seconds.

Tables 7 to 9 of Jia et al. (2019): residuals, true minus calibrated (Eq. 56), of every parameter after calibration by
distance, by distance + rotation, by absolute pose; and the sums of Eq. (57) and (58). The paper's own values stand
beside plain least squares as in the paper (unweighted, its parameters, Moore-Penrose steps), and beside the graph with
tolerances as priors.

The paper shows one run. Ours is chosen by a rule that does not look at results: of 200 draws from `--seed` on, the one
whose mean error before calibration is nearest to the median.

Expected: as in the paper, parameters left at nominal keep their error while the determined sums are small, each of the
size of its bound: 0.002 to 0.005 deg, and for d3 + d4 + d5 0.2 mm by absolute pose, 4 mm by distance + rotation and
7 mm by distance. The paper's are of that size too but for its distances' d3 + d4 + d5, 20 mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from space_robot import (
    COLOURS,
    KINDS,
    MODELS,
    Floats,
    arguments_of,
    clean,
    fit,
    one_draw,
    paper_residuals,
    paper_scenario,
    papers_names,
    typical_seed,
    write_json,
)

from fg_calib import Bound, Simulation, cramer_rao
from fg_calib.options import Model

NAME = "03_calibration_residuals"

SUMS: Mapping[str, Mapping[str, float]] = {
    "beta1 + theta2": {"theta2": 1.0},
    "beta2 + theta3": {"beta2": 1.0, "theta3": 1.0},
    "d3 + d4 + d5": {"d3": 1.0, "d4": 1.0, "d5": 1.0},
    "beta5 - theta6": {"beta5": 1.0, "theta6": -1.0},
    "beta6 - theta7": {"beta6": 1.0, "theta7": -1.0},
}
"""Eq. (57) and (58); beta1 is known."""

DETERMINED: Mapping[Model, tuple[str, ...]] = {
    "distance": tuple(SUMS)[:3],
    "distance-rotation": tuple(SUMS)[:4],
    "pose": tuple(SUMS),
}
"""The sums that a model can know at all: pairs say nothing of the last, distances mix beta5 - theta6 with a7."""


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    given = arguments_of(__doc__, NAME, arguments, 200, 20)
    seed, before = typical_seed(given.seed, given.draws)
    simulation = one_draw(paper_scenario(), seed)
    names = list(paper_residuals("pose"))
    found: dict[str, Any] = {
        "seed": seed,
        "chosen_of": given.draws,
        "mean_error_before": before,
        "names": names,
        "errors_before": residuals(simulation, simulation.robot.nominal, names),
        "models": {model: of_model(simulation, model, names) for model in MODELS},
    }
    write_json(given.file, found)
    picture(found).savefig(given.file.with_suffix(".png"), dpi=120)
    report(found)
    return found


def residuals(simulation: Simulation, values: Floats, names: Sequence[str]) -> list[float]:
    """True minus other values of parameters, [m] and [rad]."""
    true = simulation.true_robot
    return [float(true.nominal[true.index(name)] - values[true.index(name)]) for name in names]


def of_model(simulation: Simulation, model: Model, names: Sequence[str]) -> dict[str, Any]:
    """Residuals and sums of one model: the paper's, plain least squares, the graph; [m] and [rad]."""
    paper = paper_residuals(model)
    found: dict[str, Any] = {"residuals": {"paper": [paper[name] for name in names]}, "sums": {}, "converged": {}}
    for estimator in ("unweighted", "graph"):
        fitted = fit(simulation, model, estimator)
        found["residuals"][estimator] = residuals(simulation, fitted.robot.nominal, names)
        found["converged"][estimator] = fitted.converged
    kept = papers_names(simulation.robot, model)
    options: dict[str, Any] = {"model": model}
    bounds = {
        "unweighted": cramer_rao(simulation.true_robot, simulation.measurements, prior=False, kept=kept, **options),
        "graph": cramer_rao(simulation.true_robot, simulation.measurements, **options),
    }
    for label, terms in SUMS.items():
        row: dict[str, Any] = {
            who: sum(sign * values[names.index(name)] for name, sign in terms.items())
            for who, values in found["residuals"].items()
        }
        row["bound"] = {who: sigma_of(bound, terms) for who, bound in bounds.items()}
        row["determined"] = label in DETERMINED[model]
        found["sums"][label] = row
    return found


def sigma_of(bound: Bound, terms: Mapping[str, float]) -> float:
    """1 sigma of the residual of a sum of parameters, [m] or [rad]."""
    w = np.array([terms.get(name, 0.0) for name in bound.names])
    return float(np.sqrt(w @ bound.covariance @ w))


def picture(found: dict[str, Any]) -> Figure:
    """Residual of each parameter as a part of the largest error before, a panel a model."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True, sharey=True)
    names, x = found["names"], np.arange(len(found["names"]))
    largest = np.array([0.01 if name[:-1] in ("a", "d") else np.deg2rad(0.05) for name in names])
    styles = (("paper", "D", "k", "the paper's tables"), ("unweighted", "s", "0.5", "plain least squares"))
    for axes, (model, row) in zip(panels, found["models"].items(), strict=True):
        axes.axhspan(-1.0, 1.0, color="0.94", label="errors before, by their bounds")
        graph = ("graph", "o", COLOURS[model], "graph with priors")
        for (who, marker, colour, label), shift in zip((*styles, graph), (-0.22, 0.0, 0.22), strict=True):
            values = np.array(row["residuals"][who]) / largest
            axes.plot(x + shift, values, marker, color=colour, label=label, fillstyle="none", ms=5)
        axes.axhline(0.0, color="0.6", lw=0.8)
        axes.set_yscale("symlog", linthresh=0.3)
        axes.set_yticks([-10, -1, -0.1, 0, 0.1, 1, 10], ["-10", "-1", "-0.1", "0", "0.1", "1", "10"])
        axes.set_ylabel("residual / 10 mm\nor / 0.05 deg")
        axes.set_title(MODELS[model], loc="left", fontsize=10)
        clean(axes)
        for edge in range(5, 30, 5):
            axes.axvline(edge - 0.5, color="0.85", lw=0.8)
    panels[0].legend(ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)
    panels[2].set_xticks(x, names, rotation=60)
    panels[2].set_xlabel("parameter")
    figure.suptitle(
        "Absolute poses find what they can; relative models without priors leave more than there was at first"
    )
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the tables, in metres and degrees as in the paper."""
    print(f"seed {found['seed']}: mean error before nearest the median of {found['chosen_of']} draws")
    names = found["names"]
    for model, row in found["models"].items():
        print(f"\nresiduals by {MODELS[model]}: m, deg" + " " * 30 + "(the paper's)")
        print("joint" + "".join(f"{kind:>10}" for kind in KINDS) + "   |" + "".join(f"{kind:>10}" for kind in KINDS))
        for who in ("unweighted", "graph"):
            print(f"  {who}")
            for joint in range(2, 8):
                cells = []
                for of in (who, "paper"):
                    values = [row["residuals"][of][names.index(f"{kind}{joint}")] for kind in KINDS]
                    units = [1.0 if kind in ("a", "d") else 180.0 / np.pi for kind in KINDS]
                    cells.append("".join(f"{v * u:10.5f}" for v, u in zip(values, units, strict=True)))
                print(f"{joint:5}{cells[0]}   |{cells[1] if who == 'unweighted' else ''}")
        print(f"{'sum':18}{'paper':>10}{'unweighted':>12}{'bound':>10}{'graph':>10}{'bound':>10}")
        for label, cells in row["sums"].items():
            u = 1.0 if label.startswith("d") else 180.0 / np.pi
            note = "" if cells["determined"] else "  not determined by this model"
            print(
                f"{label:18}{cells['paper'] * u:10.5f}{cells['unweighted'] * u:12.5f}"
                f"{cells['bound']['unweighted'] * u:10.5f}{cells['graph'] * u:10.5f}{cells['bound']['graph'] * u:10.5f}"
                f"{note}"
            )


if __name__ == "__main__":
    main()
