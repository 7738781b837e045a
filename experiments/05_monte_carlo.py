"""Do the paper's claims hold over many draws, and how far is each estimator from what the measurements allow?

Command: python experiments/05_monte_carlo.py [--quick] [--seed N] [--draws N] [--out FOLDER] [--workers N]
Takes two minutes on two cores.

200 draws of errors (uniform within Table 6's bounds), configurations (self-motion, roll), noise and 500 validation
configurations of the shipped scenario, measured in the base frame. Each is calibrated by the paper's three error models
and four estimators; shown are medians and 5-95 % bands of the position error over the validation set, in the base
frame and after the best rigid fit, beside the Cramér-Rao bound on the same figures.

Expected: before, mean 19.8 mm (15.4 to 27.5), maximum 40.5 mm. Absolute pose near 0.6 mm; relative models about 15 mm
without priors and 4 to 5 mm with priors. Absolute poses are always best; distance and rotation is better than distance
alone in most draws, by little.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from draws import over_draws
from matplotlib.figure import Figure
from space_robot import (
    COLOURS,
    ESTIMATORS,
    MM,
    MODELS,
    PAPER_TABLE_10,
    arguments_of,
    clean,
    fit,
    one_draw,
    paper_scenario,
    papers_names,
    position_bound,
    position_errors,
    spread,
    spreads,
    validation,
    write_json,
)

from fg_calib import cramer_rao

NAME = "05_monte_carlo"


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    given = arguments_of(__doc__, NAME, arguments, 200, 4)
    clock = time.perf_counter()
    draws = over_draws(draw_once, range(given.seed, given.seed + given.draws), given.workers)
    found = summary(draws)
    found |= {"seed": given.seed, "n_draws": given.draws, "seconds": time.perf_counter() - clock}
    write_json(given.file, found)
    picture(found).savefig(given.file.with_suffix(".png"), dpi=120)
    report(found)
    return found


def draw_once(seed: int) -> dict[str, Any]:
    """Errors of every model and estimator on one draw, and their bounds, [m]."""
    simulation = one_draw(paper_scenario(), seed)
    true, robot, readings = simulation.true_robot, simulation.robot, validation(simulation)
    row: dict[str, Any] = {"before": position_errors(robot, true, readings)}
    for model in MODELS:
        of_model: dict[str, Any] = {}
        for estimator in ESTIMATORS:
            fitted = fit(simulation, model, estimator)
            errors = position_errors(fitted.robot, true, readings)
            of_model[estimator] = {"errors": errors, "converged": fitted.converged}
        for key, prior in (("kept", False), ("prior", True)):
            kept = None if prior else papers_names(robot, model)
            bound = cramer_rao(true, simulation.measurements, model=model, prior=prior, kept=kept)
            of_model[f"bound {key}"] = position_bound(bound, readings)
        row[model] = of_model
    return row


def summary(draws: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Spreads over the draws, and what becomes of the paper's claims."""
    found: dict[str, Any] = {"before": spreads([d["before"] for d in draws]), "paper": PAPER_TABLE_10, "models": {}}
    for model in MODELS:
        bounds = {key: spreads([d[model][f"bound {key}"] for d in draws]) for key in ("kept", "prior")}
        found["models"][model] = {"bounds": bounds, "estimators": {}}
        for estimator in ESTIMATORS:
            rows = [d[model][estimator] for d in draws]
            errors = spreads([r["errors"] for r in rows])
            bound = bounds["prior" if estimator == "graph" else "kept"]
            found["models"][model]["estimators"][estimator] = {
                "errors": errors,
                "not_converged": sum(not r["converged"] for r in rows),
                "rms_over_bound": errors["rms"]["rms"] / bound["rms"]["rms"],
                "fitted_rms_over_bound": errors["fitted_rms"]["rms"] / bound["fitted_rms"]["rms"],
            }
    found["mean_errors_by_draw"] = {
        f"{model} {estimator}": [d[model][estimator]["errors"]["mean"] for d in draws]
        for model in MODELS
        for estimator in ESTIMATORS
    }
    found["claims"] = {estimator: claims(draws, estimator) for estimator in ESTIMATORS}
    return found


def claims(draws: Sequence[dict[str, Any]], estimator: str) -> dict[str, Any]:
    """Order of the models, factors between them and 2.5 mm, by the mean error of each draw."""
    mean = {model: np.array([d[model][estimator]["errors"]["mean"] for d in draws]) for model in MODELS}
    before = np.array([d["before"]["mean"] for d in draws])
    distance, both, pose = mean["distance"], mean["distance-rotation"], mean["pose"]
    return {
        "share_of_draws": {
            "distance worse than distance-rotation": float(np.mean(distance > both)),
            "distance-rotation worse than pose": float(np.mean(both > pose)),
            "all three in the paper's order": float(np.mean((distance > both) & (both > pose))),
            "distance better than before": float(np.mean(distance < before)),
            "distance-rotation better than before": float(np.mean(both < before)),
            "distance-rotation at most 2.5 mm": float(np.mean(both <= 2.5 * MM)),
            "distance at least 4.4 times distance-rotation": float(np.mean(distance >= 4.4 * both)),
        },
        "factor distance over distance-rotation": spread((distance / both).tolist()),
        "factor distance-rotation over pose": spread((both / pose).tolist()),
    }


def picture(found: dict[str, Any]) -> Figure:
    """Median and band of mean and maximum for each model and estimator, with bound and paper."""
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    labels, place = ["before"], {"before": 0.0}
    for m, model in enumerate(MODELS):
        for e, (estimator, words) in enumerate(ESTIMATORS.items()):
            place[f"{model} {estimator}"] = 1.5 + 4.6 * m + e
            short = words.split(",")[0] if e == 0 else words
            labels.append(f"{MODELS[model]}: {short}" if e == 0 else short)
    for axes, key in zip(panels, ("mean", "max"), strict=True):
        before = found["before"][key]
        axes.plot(before["median"] / MM, 0.0, "o", color=COLOURS["before"])
        axes.plot([before["p5"] / MM, before["p95"] / MM], [0.0, 0.0], color=COLOURS["before"], lw=2)
        axes.plot(PAPER_TABLE_10["before"][key] / MM, 0.0, "D", color="k", fillstyle="none", ms=8)
        for model, of_model in found["models"].items():
            for estimator, row in of_model["estimators"].items():
                y, e, colour = place[f"{model} {estimator}"], row["errors"][key], COLOURS[model]
                bound = of_model["bounds"]["prior" if estimator == "graph" else "kept"][key]["median"]
                axes.plot(e["median"] / MM, y, "o", color=colour)
                axes.plot([e["p5"] / MM, e["p95"] / MM], [y, y], color=colour, lw=2)
                axes.plot(bound / MM, y, "|", color="k", ms=15, mew=2)
            y = place[f"{model} unweighted"]
            axes.plot(PAPER_TABLE_10[model][key] / MM, y, "D", color="k", fillstyle="none", ms=8)
        axes.plot([], [], "o-", color="0.3", lw=2, label=f"median and 5-95 % of {found['n_draws']} draws")
        axes.plot([], [], "|", color="k", ms=15, mew=2, ls="", label="Cramér-Rao bound")
        axes.plot([], [], "D", color="k", fillstyle="none", ms=8, ls="", label="the paper's one run")
        axes.set_xscale("log")
        axes.set_xticks([0.5, 1, 2, 5, 10, 20, 50], ["0.5", "1", "2", "5", "10", "20", "50"])
        axes.minorticks_off()
        axes.grid(axis="x", color="0.9")
        what = "Mean" if key == "mean" else "Maximum"
        axes.set(xlabel=f"{what} position error [mm]")
        clean(axes)
    panels[0].set_yticks(list(place.values()), labels)
    panels[0].invert_yaxis()
    panels[1].legend(loc="lower right", framealpha=1.0)
    figure.suptitle(
        "All estimators are at their bounds: what separates the models is what the measurements hold, and priors"
        "\n(500 validation configurations, base frame)"
    )
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"{found['n_draws']} draws, {found['seconds']:.0f} s; mm; median (5 % to 95 %)")
    print(f"{'':43} mean                 bound  max                  bound  mean, fitted  rms/bound  not conv.")

    def band(e: dict[str, float]) -> str:
        return f"{e['median'] / MM:5.2f} ({e['p5'] / MM:5.2f} to {e['p95'] / MM:5.2f})"

    before = found["before"]
    print(f"{'before':43} {band(before['mean'])}        {band(before['max'])}")
    for model, of_model in found["models"].items():
        paper = PAPER_TABLE_10[model]
        print(f"{model} (paper: mean {paper['mean'] / MM:g}, max {paper['max'] / MM:g})")
        for estimator, row in of_model["estimators"].items():
            e = row["errors"]
            bound = of_model["bounds"]["prior" if estimator == "graph" else "kept"]
            print(
                f"  {estimator:41} {band(e['mean'])} {bound['mean']['median'] / MM:6.2f} {band(e['max'])}"
                f" {bound['max']['median'] / MM:6.2f} {e['fitted_mean']['median'] / MM:13.2f}"
                f" {row['rms_over_bound']:10.3f} {row['not_converged']:10d}"
            )
    for estimator, row in found["claims"].items():
        print(f"\n{estimator}")
        for claim, share in row["share_of_draws"].items():
            print(f"  {claim:46} {100 * share:5.1f} % of draws")
        for factor in ("factor distance over distance-rotation", "factor distance-rotation over pose"):
            e = row[factor]
            print(f"  {factor:46} {e['median']:5.2f} ({e['p5']:.2f} to {e['p95']:.2f})")


if __name__ == "__main__":
    main()
