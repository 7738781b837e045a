"""Comparisons: estimators on one job, the runs of a calibration, a calibration with new rows."""

from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fg_calib import monitoring
from fg_calib.baseline import ESTIMATORS, Comparison, Estimate
from fg_calib.diagnostics import probability
from fg_calib.io import NOISE_UNITS, Run
from fg_calib.report import tables
from fg_calib.report.tables import figure, in_words, line, section, table_of

ERRORS = {"max": "m", "mean": "m", "rms": "m", "orientation_rms": "rad"}
"""Units of errors in the document."""


def build_comparison_report(comparison: Comparison) -> Group:
    """Estimators compared: errors, residuals, effort, then the parameters of each."""
    job = comparison.job
    judged = f"judged at {comparison.n_judged} {comparison.judged_on} configurations"
    nominal = ("  nominal", "the arm before the calibration, tool and measurement frame fitted where unknown")
    estimators = [(f"  {e.name}", f"{ESTIMATORS[e.name]}; {e.message}") for e in comparison.estimates]
    values = [f"{e.name}|>" for e in comparison.estimates]
    columns = ("", "|unit", *["truth|>"] * (job.truth is not None), *values)
    return tables.report(
        line(f"{job.robot.name}: {job.model}, {judged}"),
        *(line(f"DOUBTFUL: {finding}", "bold red") for finding in comparison.findings),
        line(""),
        table_of(("", "|unit", "nominal|>", *values), _quantities(comparison)),
        *section("Corrections (± sigma)", table_of(columns, _corrections(comparison))),
        *section("Estimators", table_of(("", ""), [nominal, *estimators])),
        *section("Notes", *_comparison_notes(comparison)),
    )


def _quantities(comparison: Comparison) -> Iterator[Sequence[str | Text]]:
    """Errors, residuals and effort of each estimator, a quantity a row, under headings."""
    document, kinds = comparison_document(comparison), comparison.units
    estimates = [document["nominal"], *(e if e["ran"] else {} for e in document["estimates"])]
    groups: list[tuple[str, tuple[str, ...], Mapping[str, str]]] = [
        ("Real error in the base frame", ("errors", "base_frame"), ERRORS),
        ("Real error after the best rigid fit", ("errors", "best_rigid_fit"), ERRORS),
        ("Error predicted by its sigmas", (), {"predicted_position_rms": "m", "predicted_position_rms_fitted": "m"}),
        *((f"Residuals, {split} rows (RMS)", ("residual_rms", split), kinds) for split in ("train", "test")),
        ("Effort", (), {"n_estimated": "", "iterations": "", "seconds": "s"}),
    ]
    for title, path, quantities in groups:
        found = [reduce(lambda of, key: (of or {}).get(key), path, e) or {} for e in estimates]
        values = {key: [of.get(key) for of in found] for key in quantities}
        if known := {key: row for key, row in values.items() if any(value is not None for value in row)}:
            yield line(title, "bold"), *[""] * (len(estimates) + 1)
        for key, row in known.items():
            unit = quantities[key]
            yield f"  {key.replace('_', ' ')}", unit, *(_large(value, unit) for value in row)
    yield "  converged", "", "-", *("yes" if e.converged else "NO" for e in comparison.estimates)


def _corrections(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """The correction of each parameter by each estimator, with its sigma."""
    truth = comparison.job.truth
    for p in (p for p in comparison.job.robot.parameters if p.estimated):
        cells = [] if truth is None else [_large(comparison.correction(truth, p.name), p.unit, "+")]
        for e in comparison.estimates:
            if e.robot is None or p.name not in e.sigma:
                cells.append("-" if e.robot is None else "fixed")
            else:
                sigma = _large(e.sigma[p.name], p.unit, unknown="unknown")
                cells.append(f"{_large(comparison.correction(e.robot, p.name), p.unit, '+')} ±{sigma}")
        yield p.name, p.unit, *cells


def _large(value: float | None, unit: str, sign: str = "", unknown: str = "-") -> str:
    """A value with a decimal less than usual, or in powers of ten where an estimate diverged; a count as it is."""
    if isinstance(value, int):
        return str(value)
    large = value is not None and abs(value) * tables.shown_in(unit).factor >= 1e5
    return figure(value, unit, f"{sign}.1e" if large else f"{sign}z.{tables.shown_in(unit).decimals - 1}f", unknown)


def _comparison_notes(comparison: Comparison) -> Iterator[str]:
    if comparison.judged_on == "train":
        yield "no test rows: judged at the train configurations, which is optimistic for every estimator"
    if comparison.errors_before is None:
        yield "the truth is unknown: no real errors (key truth of a job)"
    yield "a parameter whose others are fixed stands for its combination with them: compare errors, not corrections"
    yield "predicted errors take fixed parameters as exact, so they may be too small in the base frame"


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """The document `comparison.json`: SI, full precision, None for what is unknown or infinite.

    ::

        { "schema": "fg-calib/comparison/1", "version", "robot", "model", "frame", "pairing",
          "judged_on": "test" | "train", "n_judged", "truth_known", "trustworthy", "findings",
          "nominal": {"residual_rms": {split: {kind: RMS | null}}, "errors": errors | null},
          "estimates": [{"name": a key of ESTIMATORS, "description", "ran", "converged", "message", "iterations",
                         "seconds", "n_estimated", "residual_rms": as above | null, "predicted_position_rms",
                         "predicted_position_rms_fitted", "errors": errors | null,
                         "parameters": [{"name", "unit", "nominal", "true", "estimate", "correction", "sigma",
                                         "held"}]}],
          "inputs": {path: sha256} }

    with errors = {"base_frame": values, "best_rigid_fit": values | null} and values = {"max", "mean", "rms",
    "orientation_rms"}. Parameters are those that the job estimates; those that an estimator held at nominal are not
    thereby known, so their sigma is None. "parameters" is empty where it did not run.
    """
    job = comparison.job
    pairings = ("measured" if t.measurements.pairs is not None else str(t.pairing) for t in job.tables if t.uses_pairs)
    return tables.document_of(
        "comparison",
        comparison,
        "judged_on n_judged trustworthy findings",
        robot=job.robot.name,
        model=job.model,
        frame="unknown" if any(table.unknown_frame for table in job.tables) else job.tables[0].frame,
        pairing=next(pairings, None),
        truth_known=job.truth is not None,
        nominal={"residual_rms": comparison.rms_before, "errors": comparison.errors_before},
        estimates=[_estimate(comparison, e) for e in comparison.estimates],
        inputs=job.inputs,
    )


def _estimate(comparison: Comparison, e: Estimate) -> dict[str, Any]:
    robot, truth = e.robot, comparison.job.truth
    parameters = [
        {
            "name": p.name,
            "unit": p.unit,
            "nominal": p.nominal,
            "true": None if truth is None else truth.parameters[i].nominal,
            "estimate": robot.parameters[i].nominal,
            "correction": comparison.correction(robot, p.name),
            "sigma": e.sigma.get(p.name),
            "held": p.name not in e.sigma,
        }
        for i, p in enumerate(comparison.job.robot.parameters)
        if robot is not None and p.estimated
    ]
    more = {"description": ESTIMATORS[e.name], "ran": e.ran, "n_estimated": e.n_estimated, "parameters": parameters}
    return {key: value for key, value in vars(e).items() if key not in ("robot", "sigma")} | more


def _largest_change(before: Run, run: Run) -> dict[str, Any] | None:
    """The parameter that changed most from one run to the next, in the sigma that it had before."""
    found: list[dict[str, Any]] = []
    for name in (name for name in run.parameters if name in before.parameters):
        then, sigma, unit = before.parameters[name]
        change = run.parameters[name][0] - then
        if unit == "rad":
            change -= 2.0 * np.pi * round(change / (2.0 * np.pi))
        found.append({"name": name, "unit": unit, "change": change, "in_sigma": abs(change) / sigma if sigma else None})
    return max(found, key=lambda one: one["in_sigma"] or -1.0, default=None)


def history_document(robot: str, runs: Sequence[Run]) -> dict[str, Any]:
    """The runs of a calibration for programs, in [m] and [rad]."""
    moved = [None, *(_largest_change(*both) for both in pairwise(runs))]
    listed = [run.model_dump(mode="json") | {"moved": most} for run, most in zip(runs, moved, strict=True)]
    return tables.document_of("history", robot=robot, runs=listed)


def build_history(robot: str, runs: Sequence[Run]) -> Group:
    """The runs of a calibration for the terminal."""
    rows = []
    for run, one in zip(runs, history_document(robot, runs)["runs"], strict=True):
        moved = one["moved"] or {"name": "", "unit": "", "change": "", "in_sigma": ""}
        rows.append((run.date[:10], run.n_residuals, run.chi2, run.dof, run.p_value, run.verdict, *moved.values()))
    fit = ("date", "residuals|d", "chi-square|.6g", "of|d", "p-value|p", "")
    columns = (*fit, "changed most", "|unit", "by|q:+", "in sigma|.1f|unknown")
    title = line(f"{robot}: {len(runs)} run{'s' * (len(runs) > 1)}", "bold")
    return tables.report(title, *section("Runs", table_of(columns, rows)))


WORDS = {"pass": ("PASS", "bold green"), "fail": ("FAIL", "bold red")}
"""Word and style of each verdict."""

KINDS = {
    "zero": "zero of a joint",
    "zeros": "zeros of two joints",
    "tool": "the tool",
    "frame": "frame or base",
    "row": "gross errors",
}
"""Change that each kind of explanation is."""

SHOWN_CHANGES = "Joint offset changes that these rows show in 9 of 10 cases"


def named(parameters: Sequence[str]) -> str:
    """A change by its name: for several parameters together `theta2 + theta3`."""
    return " + ".join(parameters)


def check_document(found: monitoring.Check) -> dict[str, Any]:
    """A check for programs, in [m] and [rad]."""
    document = tables.document_of("check", **vars(found))
    for e in document["explanations"]:
        e |= {key: [*map(named, e[key])] for key in ("told_apart_from", "not_told_apart_from")}
    return document


def build_check_report(found: monitoring.Check, joint_units: Sequence[str]) -> Group:
    """A check for the terminal.

    Args:
        found: The check.
        joint_units: `rad` or `m` of each joint.
    """
    p = "" if found.p_value is None else f", p-value {probability(found.p_value)}"
    chi2 = f"chi-square {found.chi2:.5g} with {found.dof} degrees of freedom{p}, {found.n} measurements"
    detectable = zip(found.detectable.items(), joint_units, strict=True)
    sizes = [f"{name} {'not seen' if of is None else in_words(of, unit, '.2g')}" for (name, of), unit in detectable]
    return tables.report(
        line(*WORDS.get(found.verdict, ("NOT EVALUATED", "bold yellow"))),
        *(*found.reasons, *found.cautions, chi2),
        *section("Errors of the calibrated arm (RMS)", _rms_errors(found)),
        *(section(SHOWN_CHANGES, ", ".join(sizes)) if found.verdict != "not_evaluated" else []),
        *section("What changed", _explanations(found.explanations), *_conclusions(found)),
    )


def _rms_errors(found: monitoring.Check) -> Table:
    kinds = ((kind, NOISE_UNITS.get(kind, "m"), rms) for kind, rms in found.rms.items())
    rows = [(kind, unit, rms, found.noise[kind], found.limits.get(kind)) for kind, unit, rms in kinds]
    return table_of(("", "|unit", "error|q| ", "specified noise|q| ", "limit|q| "), rows)


def _explanations(explanations: Sequence[monitoring.Explanation]) -> Table:
    rows = []
    for e in explanations:
        word = "may be" if e.likely and e.not_told_apart_from else "is" if e.likely else "ruled out"
        several = list(zip(e.change, e.sigma, e.units, strict=True)) if len(e.change) < 3 else []
        change = ", ".join(f"{figure(c, unit, '+')} {tables.shown_in(unit).unit}" for c, _, unit in several)
        sigma = ", ".join(figure(s, unit) for _, s, unit in several)
        rows.append((named(e.parameters), KINDS.get(e.kind, ""), change, sigma, e.chi2_drop, e.p_value, word))
    return table_of(("", "", "change|>", "sigma|>", "chi-square falls by|.4g", "p-value|p", ""), rows)


def _conclusions(found: monitoring.Check) -> Iterator[str]:
    likely = [e for e in found.explanations if e.likely]
    if likely and likely[0].same:
        others = ", ".join(name for name in likely[0].same if name != likely[0].parameters[0])
        yield f"{likely[0].parameters[0]} is equivalent to {others} for every position of the tool"
    if len(likely) > 1:
        yield f"not distinguishable by these rows: {', '.join(named(e.parameters) for e in likely)}"
        yield "do not deploy any of these changes yet: measure more configurations"
    elif likely and found.verdict == "fail" and found.deploy:
        yield f"no other single change explains the rows: update with --changed {likely[0].parameters[0]}, check others"
    elif likely and found.verdict == "fail":
        yield "do not deploy: residuals above noise remain after the most likely change"
