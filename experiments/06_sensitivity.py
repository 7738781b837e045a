"""Which of the choices that the paper leaves open matters most for the accuracy it reports?

Command: python experiments/06_sensitivity.py [--quick] [--draws N] [--seed N] [--out FOLDER] [--workers N]
Takes about five minutes on two cores (12 draws: one).

One change at a time against the shipped scenario (hemisphere of 0.5 m, random roll and self-motion, 52 configurations,
encoder noise, validated over +-180 degrees): distance from the board and its place, roll, self-motion, number of
configurations, encoder noise, and where the result is judged. 50 draws each (10 of 200 configurations), the same seeds
for all; the paper's three models by plain least squares as in the paper and by the graph with tolerances as priors,
beside the bounds.

Expected: held self-motion costs most of all (a factor 2 for relative models with priors, 6 and more for absolute
poses); for relative models the distance from the board gains most, for absolute poses the number of configurations.
Roll and encoder noise hardly matter, nor the board's place but for poses.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from draws import over_draws
from matplotlib.figure import Figure
from space_robot import (
    COLOURS,
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
    spreads,
    validation,
    write_json,
)

from fg_calib import cramer_rao
from fg_calib.simulation.configurations import Placement

NAME = "06_sensitivity"


@dataclass(frozen=True)
class Variant:
    """One change of the scenario: of the views, of the encoders, or of where it is judged."""

    words: str
    views: Mapping[str, Any] = field(default_factory=dict)
    encoder_noise: bool = True
    judged: str = "+-180"
    share_of_draws: float = 1.0


NEAR = Placement(np.eye(3), np.array([0.0, 2.5, 2.55]))

VARIANTS: Mapping[str, Variant] = {
    "base": Variant("as shipped"),
    "distance": Variant("camera 0.3-2 m from the board", {"distance": (0.3, 2.0)}),
    "board": Variant("board 2.5 m from the base, not 6.5 m", {"board": NEAR}),
    "roll held": Variant("roll held", {"roll": 0.0}),
    "self-motion held": Variant("self-motion held", {"self_motion": "held"}),
    "20": Variant("20 configurations", {"count": 19}),
    "100": Variant("100 configurations", {"count": 99}),
    "200": Variant("200 configurations", {"count": 199}, share_of_draws=0.2),
    "encoders": Variant("no encoder noise", encoder_noise=False),
    "judged +-90": Variant("judged over +-90 deg", judged="+-90"),
    "judged views": Variant("judged at new views of the board", judged="views"),
}

CASES: Mapping[str, str] = {"unweighted": "kept", "graph": "prior"}
"""Estimators, and which bound is theirs."""


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment; returns what is written as JSON."""
    given = arguments_of(__doc__, NAME, arguments, 50, 2)
    clock = time.perf_counter()
    n_draws = {name: max(2, int(variant.share_of_draws * given.draws)) for name, variant in VARIANTS.items()}
    tasks = [(name, seed) for name, n in n_draws.items() for seed in range(given.seed, given.seed + n)]
    draws = iter(over_draws(draw_once, tasks, given.workers))
    found: dict[str, Any] = {"seed": given.seed, "n_draws": n_draws, "variants": {}}
    for name, n in n_draws.items():
        found["variants"][name] = summary([next(draws) for _ in range(n)])
    found["effect"] = effects(found["variants"])
    found["seconds"] = time.perf_counter() - clock
    write_json(given.file, found)
    picture(found).savefig(given.file.with_suffix(".png"), dpi=120)
    report(found)
    return found


def draw_once(task: tuple[str, int]) -> dict[str, Any]:
    """Errors and bounds of every model on one draw of one variant, [m]."""
    variant, seed = VARIANTS[task[0]], task[1]
    scenario = paper_scenario(**variant.views)
    if not variant.encoder_noise:
        scenario = replace(scenario, noise=replace(scenario.noise, joint=0.0))
    if variant.judged == "views":
        scenario = replace(scenario, validation=scenario.configurations)
    simulation = one_draw(scenario, seed)
    readings = validation(simulation) * (0.5 if variant.judged == "+-90" else 1.0)
    true, robot = simulation.true_robot, simulation.robot
    row: dict[str, Any] = {"before": position_errors(robot, true, readings)}
    for model in MODELS:
        row[model] = {}
        for estimator, key in CASES.items():
            fitted = fit(simulation, model, estimator)
            kept = papers_names(robot, model) if key == "kept" else None
            bound = cramer_rao(true, simulation.measurements, model=model, prior=kept is None, kept=kept)
            row[model][estimator] = {
                "errors": position_errors(fitted.robot, true, readings),
                "bound": position_bound(bound, readings),
                "converged": fitted.converged,
            }
    return row


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Spreads over the draws of one variant."""
    found: dict[str, Any] = {"before": spreads([r["before"] for r in rows])}
    for model in MODELS:
        found[model] = {}
        for estimator in CASES:
            of = [r[model][estimator] for r in rows]
            found[model][estimator] = {
                "errors": spreads([r["errors"] for r in of]),
                "bound": spreads([r["bound"] for r in of]),
                "not_converged": sum(not r["converged"] for r in of),
            }
    return found


def effects(variants: Mapping[str, Any]) -> dict[str, Any]:
    """By what factor each change multiplies the bound on the RMS error (RMS over draws), largest effect first."""
    found: dict[str, Any] = {}
    for model in MODELS:
        for estimator in CASES:
            rms = {v: row[model][estimator]["bound"]["rms"]["rms"] for v, row in variants.items()}
            factors = {v: rms[v] / rms["base"] for v in variants if v != "base"}
            ordered = sorted(factors, key=lambda v: -abs(np.log(factors[v])))
            found[f"{model} {estimator}"] = {v: factors[v] for v in ordered}
    return found


def picture(found: dict[str, Any]) -> Figure:
    """Median and band of the mean error for each change, a panel a model."""
    figure = Figure(figsize=(13, 6.2), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    y = np.arange(len(VARIANTS))
    for axes, model in zip(panels, MODELS, strict=True):
        axes.axvline(PAPER_TABLE_10[model]["mean"] / MM, color="0.6", ls="--", label="the paper's mean")
        for estimator, shift, marker in (("unweighted", -0.17, "s"), ("graph", 0.17, "o")):
            colour = COLOURS[model] if estimator == "graph" else "0.45"
            for k, row in enumerate(found["variants"].values()):
                e, bound = row[model][estimator]["errors"]["mean"], row[model][estimator]["bound"]["mean"]
                axes.plot([e["p5"] / MM, e["p95"] / MM], [k + shift] * 2, color=colour, lw=2)
                axes.plot(e["median"] / MM, k + shift, marker, color=colour)
                axes.plot(bound["median"] / MM, k + shift, "|", color="k", ms=11, mew=2)
        axes.plot([], [], "s-", color="0.45", lw=2, label="plain least squares, as in the paper")
        axes.plot([], [], "o-", color=COLOURS[model], lw=2, label="graph with priors")
        axes.plot([], [], "|", color="k", ms=11, mew=2, ls="", label="Cramér-Rao bound")
        axes.set(title=MODELS[model], xlabel="mean position error [mm]", xscale="log")
        ticks = [0.2, 0.5, 1, 2, 5, 10] if model == "pose" else [0.5, 1, 2, 5, 10, 20, 50, 100]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
        axes.grid(axis="x", color="0.9")
        axes.axhline(0.5, color="0.8", lw=1)
        clean(axes)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), fontsize=8, frameon=False)
    panels[0].set_yticks(y, [v.words for v in VARIANTS.values()])
    panels[0].invert_yaxis()
    figure.suptitle(
        "Self-motion and, for pairs, the distance from the board matter most; roll and encoder noise hardly"
        f" (median, 5-95 % of {found['n_draws']['base']} draws)"
    )
    return figure


def report(found: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"draws: {found['n_draws']}; {found['seconds']:.0f} s; mean position error, mm; median (5 % to 95 %) bound")
    for estimator in CASES:
        print(f"\n{estimator:34}{'before':>8}" + "".join(f"{words:>30}" for words in MODELS.values()))
        for variant, row in found["variants"].items():
            cells = []
            for model in MODELS:
                e, bound = row[model][estimator]["errors"]["mean"], row[model][estimator]["bound"]["mean"]
                band = f"{e['median'] / MM:.2f} ({e['p5'] / MM:.2f} to {e['p95'] / MM:.2f})"
                cells.append(f"{band:>23}{bound['median'] / MM:7.2f}")
            print(f"{VARIANTS[variant].words:34}{row['before']['mean']['median'] / MM:8.1f}" + "".join(cells))
    print("\nfactor on the bound of the RMS error")
    for case, factors in found["effect"].items():
        print(f"  {case:30} " + ", ".join(f"{v} {f:.2f}" for v, f in factors.items()))
    stuck = sum(r[m][e]["not_converged"] for r in found["variants"].values() for m in MODELS for e in CASES)
    print(f"fits that did not converge: {stuck}")


if __name__ == "__main__":
    main()
