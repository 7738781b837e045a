"""Several results compared: estimators on one job, two calibrations, the runs of a calibration, many jobs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.text import Text

from fg_calib import __version__
from fg_calib.baseline import ESTIMATORS, Comparison, Estimate, RealErrors
from fg_calib.diagnostics import probability
from fg_calib.inputs import InputError, checked
from fg_calib.io import Result, Run, fill_folder, write_text
from fg_calib.report import tables
from fg_calib.report.tables import figure, in_words, line, quantities, section, table_of
from fg_calib.report.text import summary

HEADINGS = {"graph": "graph", "graph-keep": "graph kept", "gauss-newton": "plain GN", "scipy": "scipy"}
"""Headings of the estimators."""

POSE_ERRORS = {
    "max": ("position, max", "m"),
    "mean": ("position, mean", "m"),
    "rms": ("position, RMS", "m"),
    "orientation_rms": ("orientation, RMS", "rad"),
}
"""Name and unit of each field of `PoseError`."""

INDEPENDENT = (
    "The sigma of a change assumes independent calibrations; with common priors or measurements it is too small."
)


@checked
def format_comparison(comparison: Comparison, width: int = tables.WIDTH) -> str:
    """`build_comparison_report` as plain text."""
    return tables.plain_text(build_comparison_report(comparison), width)


def build_comparison_report(comparison: Comparison) -> Group:
    """Estimators compared: errors, residuals, effort, then the parameters of each."""
    job, names = comparison.job, [HEADINGS[e.name] for e in comparison.estimates]
    judged = f"judged at {comparison.n_judged} {comparison.judged_on} configurations"
    nominal = ("  nominal", "the arm before the calibration, tool and measurement frame fitted where unknown")
    estimators = [(f"  {HEADINGS[e.name]}", f"{ESTIMATORS[e.name]}; {e.message}") for e in comparison.estimates]
    headings = ("", "", *["truth"] * (job.truth is not None), *names)
    return tables.report(
        line(f"{job.robot.name}: {job.model}, {judged}"),
        *(line(f"DOUBTFUL: {finding}", "bold red") for finding in comparison.findings),
        line(""),
        table_of(("", "", "nominal", *names), _accuracy(comparison), left="ll"),
        *section("Corrections (± sigma)", table_of(headings, _corrections(comparison), left="ll", wrap=True)),
        *section("Estimators", table_of(("", ""), [nominal, *estimators], left="ll", wrap=True)),
        *section("Notes", *_comparison_notes(comparison)),
    )


def _accuracy(comparison: Comparison) -> Iterator[Sequence[str | Text]]:
    """Errors, residuals and effort of each estimator, a quantity a row, under headings."""
    estimates = comparison.estimates

    def heading(text: str) -> Sequence[str | Text]:
        return line(text, "bold"), *[""] * (len(estimates) + 2)

    def row(label: str, unit: str, values: Iterable[float | None]) -> tuple[str, ...]:
        return (f"  {label}", tables.unit_shown(unit), *(_large(v, unit) for v in values))

    errors = [comparison.errors_before, *(e.errors for e in estimates)]
    for key, words in (("base", "in the base frame"), ("fitted", "after the best rigid fit")):
        chosen = [getattr(e, key, None) for e in errors]
        if any(chosen):
            yield heading(f"Real error {words}")
            for field, (label, unit) in POSE_ERRORS.items():
                yield row(label, unit, [getattr(e, field, None) for e in chosen])
    yield heading("Error predicted by its sigmas")
    yield row("position, RMS", "m", [None, *(e.predicted_rms for e in estimates)])
    yield row("after best rigid fit", "m", [None, *(e.predicted_fitted_rms for e in estimates)])
    for split, before in (estimates[0].residual_rms or {}).items():
        if before:
            yield heading(f"Residuals, {split} rows (RMS)")
        for kind in tables.in_order(before):
            after = [None if e.residual_rms is None else e.residual_rms[split][kind]["after"] for e in estimates]
            yield row(kind, comparison.units[kind], [before[kind]["before"], *after])
    yield heading("Effort")
    efforts = {
        "parameters": ("", [f"{len(e.sigma)}" for e in estimates]),
        "iterations": ("", [f"{e.iterations}" for e in estimates]),
        "time": ("ms", [f"{e.seconds * 1e3:.1f}" for e in estimates]),
    }
    for label, (unit, values) in efforts.items():
        yield f"  {label}", unit, "-", *("-" if e.robot is None else v for e, v in zip(estimates, values, strict=True))
    yield "  converged", "", "-", *("yes" if e.converged else "NO" for e in estimates)


def _corrections(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """The correction of each parameter by each estimator, with its sigma."""
    truth = comparison.job.truth
    for p in (p for p in comparison.job.robot.parameters if p.estimated):
        cells = [] if truth is None else [_large(comparison.correction(truth, p.name), p.unit, "+")]
        for e in comparison.estimates:
            if e.robot is None or p.name not in e.sigma:
                cells.append("-" if e.robot is None else "fixed")
            else:
                sigma = _large(e.sigma[p.name], p.unit, none="unknown")
                cells.append(f"{_large(comparison.correction(e.robot, p.name), p.unit, '+')} ±{sigma}")
        yield p.name, tables.unit_shown(p.unit), *cells


def _large(value: float | None, unit: str, sign: str = "", none: str = "-") -> str:
    """A value with a decimal less than usual, or in powers of ten where an estimate diverged."""
    _, _, decimals = tables.SHOWN.get(unit, (1.0, unit, 6))
    large = value is not None and abs(value) * tables.factor(unit) >= 1e5
    return figure(value, unit, f"{sign}.1e" if large else f"{sign}z.{decimals - 1}f", none)


def _comparison_notes(comparison: Comparison) -> Iterator[str]:
    if comparison.judged_on == "train":
        yield "no test rows: judged at the train configurations, which is optimistic for every estimator"
    if comparison.errors_before is None:
        yield "the truth is unknown: no real errors (key truth of a job)"
    if any(e.robot is not None and len(e.sigma) < len(comparison.estimates[0].sigma) for e in comparison.estimates):
        yield "where others are fixed a parameter stands for its combination with them: compare errors, not corrections"
    yield "predicted errors assume that fixed parameters are exact, so they may be too small in the base frame"
    yield "residuals are of the rows that the graph uses"


@checked
def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """What `comparison.json` holds: SI, full precision, None for what is unknown or infinite.

        { "schema": "fg-calib/comparison/1", "version", "robot", "model", "frame", "pairing",
          "judged_on": "test" | "train", "n_judged", "truth_known", "trustworthy", "findings",
          "nominal": {"residual_rms": {split: {kind: RMS | null}}, "errors": errors | null},
          "estimates": [{"name": a key of ESTIMATORS, "description", "ran", "converged", "message", "iterations",
                         "seconds", "n_estimated", "residual_rms": as above | null, "predicted_position_rms",
                         "predicted_position_rms_fitted", "errors": errors | null,
                         "parameters": [{"name", "unit", "nominal", "true", "estimate", "correction", "sigma",
                                         "held"}]}],
          "inputs": {path: sha256} }

    with errors = {"base_frame": figures, "best_rigid_fit": figures | null} and figures = {"max", "mean", "rms",
    "orientation_rms"}. Parameters are those that the job estimates; those that an estimator held at nominal are not
    thereby known, so their sigma is None. "parameters" is empty where it did not run.
    """
    job, first = comparison.job, comparison.estimates[0]
    pairs = next((table for table in job.tables if table.uses_pairs), None)
    measured = pairs is not None and pairs.measurements.pairs is not None
    document: dict[str, Any] = tables.plain(
        {
            "schema": "fg-calib/comparison/1",
            "version": __version__,
            "robot": job.robot.name,
            "model": job.model,
            "frame": "unknown" if any(table.unknown_frame for table in job.tables) else job.tables[0].frame,
            "pairing": "measured" if measured else None if pairs is None else str(pairs.pairing),
            **{key: getattr(comparison, key) for key in ("judged_on", "n_judged", "trustworthy", "findings")},
            "truth_known": job.truth is not None,
            "nominal": {"residual_rms": _rms(first, "before"), "errors": _errors(comparison.errors_before)},
            "estimates": [_estimate(comparison, e) for e in comparison.estimates],
            "inputs": job.inputs,
        }
    )
    return document


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
    return {
        **{key: getattr(e, key) for key in ("name", "converged", "message", "iterations", "seconds")},
        "description": ESTIMATORS[e.name],
        "ran": robot is not None,
        "n_estimated": len(e.sigma),
        "residual_rms": _rms(e, "after"),
        "predicted_position_rms": e.predicted_rms,
        "predicted_position_rms_fitted": e.predicted_fitted_rms,
        "errors": _errors(e.errors),
        "parameters": parameters,
    }


def _rms(estimate: Estimate, when: str) -> dict[str, dict[str, float | None]] | None:
    """RMS by split and kind."""
    rms = estimate.residual_rms
    if rms is None:
        return None
    kinds = dict.fromkeys((*tables.USUAL_KINDS[:4], *rms["train"], *rms["test"]))
    return {split: {kind: rms[split].get(kind, {}).get(when) for kind in kinds} for split in ("train", "test")}


def _errors(errors: RealErrors | None) -> dict[str, Any] | None:
    return None if errors is None else {"base_frame": errors.base, "best_rigid_fit": errors.fitted}


@checked
def write_comparison(folder: Path | str, comparison: Comparison) -> None:
    """Write `comparison.json` into a folder.

    Raises:
        InputError: The folder cannot be written.
    """
    own = {"comparison.json": b'{\n "schema": "fg-calib/comparison/'}
    text = tables.json_text(comparison_document(comparison))
    fill_folder(Path(folder), lambda into: write_text(into / "comparison.json", text), own)


def changes(old: Result, new: Result) -> list[dict[str, Any]]:
    """The parameters that one of two calibrations estimated: old, new, change, its sigma, and both over each other.

    Raises:
        InputError: They are of different robots.
    """
    if [p.name for p in old.parameters] != [p.name for p in new.parameters]:
        raise InputError(new.robot, "other parameters", f"those of {old.robot}")
    rows = []
    for a, b in zip(old.parameters, new.parameters, strict=True):
        if a.identifiability == b.identifiability == "fixed":
            continue
        change = b.estimate - a.estimate
        if b.unit == "rad":
            change -= 2.0 * np.pi * round(change / (2.0 * np.pi))
        sigma = None if a.sigma is None or b.sigma is None else float(np.hypot(a.sigma, b.sigma))
        values = {"old": a.estimate, "new": b.estimate, "change": change, "sigma": sigma}
        rows.append({"name": b.name, "unit": b.unit, **values, "in_sigma": change / sigma if sigma else None})
    return rows


def changes_document(old: Result, new: Result, folders: tuple[Path, Path]) -> dict[str, Any]:
    """Two calibrations for programs, in [m] and [rad].

    { "schema": "fg-calib/changes/1", "old": folder, "new": folder,
      "parameters": [{"name", "unit", "old", "new", "change", "sigma", "in_sigma"}] }
    """
    named = {"old": str(folders[0]), "new": str(folders[1])}
    return {"schema": "fg-calib/changes/1", **named, "parameters": changes(old, new)}


def build_changes_report(old: Result, new: Result, folders: tuple[Path, Path]) -> Group:
    """Two calibrations for the terminal."""
    rms = [
        (kind, split, *(in_words(result.rms_after(split).get(kind), result.unit_of(kind)) for result in (old, new)))
        for split in ("test", "train")
        for kind in dict.fromkeys((*old.rms_after(split), *new.rms_after(split)))
    ]
    rows = []
    for one in changes(old, new):
        unit = one["unit"]
        change, z = figure(one["change"], unit, "+"), figure(one["in_sigma"], "", "+z.1f", none="")
        rows.append((one["name"], *quantities(unit, one["old"], one["new"]), change, figure(one["sigma"], unit), z))
    titles = (line(f"{name}  {folder}", "bold") for name, folder in zip(("OLD", "NEW"), folders, strict=True))
    first, second = titles
    headings = ("", "", "old", "new", "change", "sigma of it", "in sigma")
    return tables.report(
        first,
        *summary(old),
        line(""),
        second,
        *summary(new),
        line(""),
        *section("Residuals after the calibration (RMS)", table_of(("", "rows", "old", "new"), rms, left="ll")),
        *section("Parameters", table_of(headings, rows, left="ll"), INDEPENDENT),
    )


def _largest_change(before: Run, run: Run) -> dict[str, Any] | None:
    """The parameter that changed most from one run to the next, in the sigma that it had before."""
    found: list[dict[str, Any]] = []
    for name in (name for name in run.parameters if name in before.parameters):
        then, sigma, unit = before.parameters[name]
        change = run.parameters[name][0] - then
        found.append({"name": name, "unit": unit, "change": change, "in_sigma": abs(change) / sigma if sigma else None})
    return max(found, key=lambda one: one["in_sigma"] or -1.0, default=None)


def history_document(robot: str, runs: Sequence[Run]) -> dict[str, Any]:
    """The runs of a calibration for programs, in [m] and [rad]."""
    moved = [None, *(_largest_change(*both) for both in pairwise(runs))]
    listed = [run.model_dump(mode="json") | {"moved": most} for run, most in zip(runs, moved, strict=True)]
    return {"schema": "fg-calib/history/1", "robot": robot, "runs": listed}


def build_history(robot: str, runs: Sequence[Run]) -> Group:
    """The runs of a calibration for the terminal."""
    rows = []
    for run, one in zip(runs, history_document(robot, runs)["runs"], strict=True):
        p, moved = "" if run.p_value is None else probability(run.p_value), one["moved"]
        most = ("", "", "")
        if moved:
            change = in_words(moved["change"], moved["unit"], "+")
            most = moved["name"], change, figure(moved["in_sigma"], "", ".1f")
        rows.append((run.date[:10], run.n_residuals, f"{run.chi2:.6g}", run.dof, p, run.verdict, *most))
    headings = ("date", "residuals", "chi-square", "of", "p-value", "", "changed most", "by", "in sigma")
    title = line(f"{robot}: {len(runs)} run{'s' * (len(runs) > 1)}", "bold")
    return tables.report(title, *section("Runs", table_of(headings, rows, left="lrrrrllrr")))
