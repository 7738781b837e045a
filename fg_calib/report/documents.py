"""Results for programs: `result.json`, the calibrated robot and the residual table, written whole or not at all."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fg_calib import __version__
from fg_calib.analysis.accuracy import ExpectedError
from fg_calib.analysis.conventions import WORDS
from fg_calib.analysis.corrections import PriorFit
from fg_calib.analysis.goodness import (
    FLAGS,
    PREDICTION_VERDICTS,
    VERDICTS,
    KindFit,
    OutlierCounts,
    PredictedFit,
    SuspectConfiguration,
)
from fg_calib.analysis.identifiability import Identifiability
from fg_calib.analysis.joint_values import JointValues
from fg_calib.analysis.mistakes import SetupCheck
from fg_calib.analysis.residual_table import FAMILIES, FAMILY_OF_KIND, ROW_KINDS
from fg_calib.analysis.typical_residuals import TypicalResidual
from fg_calib.analysis.uncertainty import ParameterEstimate, Uncertainty
from fg_calib.baseline.comparison import Comparison, Estimate, RealErrors
from fg_calib.files.csv_writer import Words, write_csv_parts
from fg_calib.files.disk import fill_folder, write_text
from fg_calib.files.robot_yaml import write_robot
from fg_calib.files.urdf import write_urdf
from fg_calib.graph.solver import Solution
from fg_calib.measurements.dataset import Measurements
from fg_calib.report.figures import write_figures
from fg_calib.robot.model import Robot

RESULT_SCHEMA = "fg-calib/result/1"
OBSERVABILITY_SCHEMA = "fg-calib/observability/1"
COMPARISON_SCHEMA = "fg-calib/comparison/1"
KINDS = ("position", "orientation", "distance", "angle")

_ROWS_AT_ONCE = 200_000
"""Rows of `residuals.csv` that are turned into text at once."""


def result_document(
    solution: Solution, uncertainty: Uncertainty, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """What `result.json` holds: SI, full precision, None for what is unknown or infinite.

    Args:
        solution: The solution.
        uncertainty: Its assessment.
        inputs: SHA-256 of the files it came from, by path.
    """
    problem, settings = solution.problem, solution.problem.options
    rms = uncertainty.residuals.rms()
    pairing = None
    if settings.uses_pairs and (problem.measurements.pairs is not None or problem.formed):
        pairing = "measured" if problem.measurements.pairs is not None else str(settings.pairing)
    kinds = KINDS if problem.points is None else (*KINDS, "point")
    document = {
        "schema": RESULT_SCHEMA,
        "version": __version__,
        "robot": problem.robot.name,
        "model": settings.model,
        "frame": settings.frame,
        "pairing": pairing,
        "pair_errors": "approximate" if problem.approximate else settings.pair_errors if settings.uses_pairs else None,
        "encoder": settings.encoder,
        "loss": settings.loss,
        "n_configurations": problem.n_configurations,
        "n_pairs": problem.n_pairs,
        "n_residuals": problem.n_residuals,
        "n_priors": problem.n_priors,
        "n_excluded": problem.n_excluded,
        "solver": {
            "name": "gtsam-lm",
            "converged": solution.converged,
            "message": solution.message,
            "iterations": solution.iterations,
            "initial_cost": solution.initial_cost,
            "cost": solution.cost,
            "seconds": solution.seconds,
            "history": [
                {"cost": i.cost, "lambda": i.damping, "step": i.step, "decrement": i.decrement}
                for i in solution.history
            ],
        },
        "trustworthy": uncertainty.trustworthy,
        "findings": list(uncertainty.findings),
        "cautions": list(uncertainty.cautions),
        "setup": _setup(uncertainty.setup),
        "probability_of_noise": uncertainty.noise_like,
        "chi2": uncertainty.chi2,
        "dof": uncertainty.dof,
        "reduced_chi2": uncertainty.reduced_chi2,
        "chi2_p_value": uncertainty.p_value,
        "goodness": _goodness_by_kind(uncertainty.goodness.kinds, VERDICTS),
        "evaluated_only": problem.evaluated,
        "test": _test_document(uncertainty, problem.measurements.end_names),
        "priors": _priors_document(uncertainty.priors),
        "expected_error": _expected_error(uncertainty.expected_error),
        "noise_factors": None
        if solution.estimated_noise is None
        else {fit.kind: fit.factor for fit in uncertainty.goodness.kinds},
        "suspect_configurations": _suspects(uncertainty.goodness.configurations, problem.measurements.end_names),
        "residual_rms": {split: {kind: rms[split].get(kind) for kind in kinds} for split in ("train", "test")},
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "nominal": p.nominal,
                "estimate": p.estimate,
                "correction": p.correction,
                "sigma": p.sigma,
                "prior_sigma": p.prior_sigma,
                "identifiability": p.identifiability,
                **_combination(p),
            }
            for p in uncertainty.parameters
        ],
        "covariance": {"names": list(uncertainty.names), "matrix": uncertainty.covariance},
        "frame_estimate": None if uncertainty.frame is None else asdict(uncertainty.frame),
        "joint_values": _joint_values(uncertainty.joint_values, problem.measurements.end_names),
        "groups": [{"name": p.name, "n": p.n, "xyz": p.xyz, "sigma": p.sigma} for p in uncertainty.points],
        "observability": observability_document(uncertainty.identifiability),
        "inputs": dict(inputs or {}),
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def _combination(parameter: ParameterEstimate) -> dict[str, Any]:
    """What a kept parameter stands for, where others were left out to fix the gauge."""
    if parameter.stands_for is None:
        return {}
    return {"stands_for": parameter.stands_for, "sigma_of_combination": parameter.sigma_of_combination}


def _goodness_by_kind(fits: Sequence[KindFit], words: Mapping[str, str]) -> dict[str, Any]:
    return {
        fit.kind: {
            "n": fit.n,
            "stated_sigma_rms": fit.stated_sigma_rms,
            "seen_over_stated": fit.seen_over_stated,
            "chi2": fit.chi2,
            "expected": fit.expected,
            "p_value": fit.p_value,
            "verdict": words[fit.verdict],
        }
        for fit in fits
    }


def _suspects(found: Sequence[SuspectConfiguration], names: Sequence[str]) -> list[dict[str, Any]]:
    return [{"id": names[c.configuration + 1], "n": c.n, "chi2": c.chi2, "expected": c.expected} for c in found]


def _test_document(uncertainty: Uncertainty, names: Sequence[str]) -> dict[str, Any] | None:
    """How well the test rows are predicted; None without any."""
    goodness = uncertainty.goodness
    fit = goodness.test
    if uncertainty.residuals.evaluated:
        n = int(np.sum(uncertainty.residuals.used))
        fit = PredictedFit(
            kinds=goodness.kinds,
            n_rows=n,
            n=n,
            outliers=OutlierCounts(),
            n_unknown=0,
            chi2=uncertainty.chi2,
            expected=uncertainty.expected_chi2,
            p_value=np.nan if uncertainty.p_value is None else uncertainty.p_value,
            suspects=goodness.suspects,
            configurations=goodness.configurations,
        )
    if fit is None:
        return None
    return {
        "n_rows": fit.n_rows,
        "n": fit.n,
        "n_outliers": fit.outliers.test,
        "n_unknown": fit.n_unknown,
        "chi2": fit.chi2,
        "expected": fit.expected,
        "p_value": fit.p_value,
        "goodness": _goodness_by_kind(fit.kinds, PREDICTION_VERDICTS),
        "n_suspect_rows": len(fit.suspects),
        "suspect_configurations": _suspects(fit.configurations, names),
    }


def _expected_error(expected: ExpectedError | None) -> dict[str, Any] | None:
    """Expected RMS errors of the tool."""
    if expected is None:
        return None
    both = {"base": asdict(expected.base), "fitted": asdict(expected.fitted)}
    by_kind = {kind: {frame: rms[kind] for frame, rms in both.items()} for kind in ("position", "orientation")}
    return by_kind | {"at": expected.at, "n": expected.n, "of": expected.of}


def _joint_values(found: JointValues | None, names: Sequence[str]) -> dict[str, Any] | None:
    """How estimated joint values lie about their readings; None where these were not estimated."""
    if found is None:
        return None
    return {
        "n": len(found.configurations),
        "joints": [
            {"name": name, "sigma": sigma, "mean": mean, "scatter": scatter}
            for name, sigma, mean, scatter in zip(found.names, found.sigma, found.mean, found.scatter, strict=True)
        ],
        "suspects": [
            {
                "id": names[found.configurations[i] + 1],
                "joint": found.names[k],
                "error": found.error[i, k],
                "studentised": found.studentised[i, k],
            }
            for i, k in found.suspects
        ],
    }


def _priors_document(fit: PriorFit | None) -> dict[str, Any] | None:
    """Corrections against tolerances; None without priors."""
    if fit is None:
        return None
    return {
        "n": len(fit.names),
        "chi2": fit.chi2,
        "expected": fit.expected,
        "p_value": fit.p_value,
        "beyond_tolerance": [
            {"parameter": fit.names[i], "correction_over_tolerance": fit.z[i], "sigma": fit.sigma[i]}
            for i in fit.beyond
        ],
    }


def observability_document(found: Identifiability) -> dict[str, Any]:
    """What `observability.json` holds: sigmas, correlations and weak directions only where the noise is the user's."""
    o = found.observability
    document: dict[str, Any] = {
        "schema": OBSERVABILITY_SCHEMA,
        "robot": found.robot,
        "model": found.model,
        "kind": found.kind,
        "n_configurations": found.n_configurations,
        "n_parameters": len(o.names),
        "rank": o.rank,
        "names": list(o.names),
        "singular_values": o.singular_values,
        "gap": o.gap,
        "independent": o.named("independent"),
        "ineffective": o.named("ineffective"),
        "relative": [
            {"parameters": list(g.parameters), "lost": g.lost, "relations": list(g.relations), "keep": list(g.keep)}
            for g in o.relative
        ],
        "kept": o.kept,
        "lost": [{"relation": direction.relation, "reason": direction.reason} for direction in found.lost],
        "missing": [
            {
                "axes": list(m.axes),
                "motions": [WORDS[motion] for motion in m.motions],
                "convention": m.convention,
                "use": m.use,
                "message": str(m),
            }
            for m in found.missing
        ],
        "null_space": o.null_space,
        "indices": o.indices,
        "condition_number": o.condition_number,
    }
    if found.kind == "practical":
        document["sigma"] = o.sigma
        document["correlations"] = [{"parameters": [a, b], "correlation": rho} for a, b, rho in o.correlations]
        document["weak"] = [{"signal_to_noise": w.signal_to_noise, "members": w.members} for w in o.weak]
    if found.with_fixed_known is not None:
        document["fixed"] = list(found.fixed)
        document["with_fixed_known"] = observability_document(found.with_fixed_known)
    plain: dict[str, Any] = _plain(document)
    return plain


def _setup(check: SetupCheck) -> dict[str, Any]:
    """Residuals before the calibration beside what noise and tolerances predict, and mistakes that explain them."""

    def by_kind(residuals: Sequence[TypicalResidual]) -> dict[str, Any]:
        return {r.kind: {"typical": r.size, "predicted": r.expected} for r in residuals}

    return {
        "residuals": by_kind(check.residuals),
        "explanations": [{"mistakes": list(e.mistakes), "residuals": by_kind(e.residuals)} for e in check.explanations],
    }


def write_observability(folder: Path | str, found: Identifiability) -> None:
    """Write `observability.json` and its figures (see `write_figures`) into a folder, all of them or none.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(observability_document(found), indent=1, allow_nan=False) + "\n"

    def write(into: Path) -> None:
        write_text(into / "observability.json", text)
        write_figures(into, found)

    fill_folder(Path(folder), write)


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
    uses_pairs = job.options.model in ("distance", "rotation", "distance-rotation")
    pairing = ("measured" if job.measurements.pairs is not None else str(job.options.pairing)) if uses_pairs else None
    document = {
        "schema": COMPARISON_SCHEMA,
        "version": __version__,
        "robot": job.robot.name,
        "model": job.options.model,
        "frame": job.options.frame,
        "pairing": pairing,
        "judged_on": comparison.judged_on,
        "n_judged": comparison.n_judged,
        "truth_known": job.truth is not None,
        "trustworthy": comparison.trustworthy,
        "findings": list(comparison.findings),
        "nominal": {
            "residual_rms": _rms(first, "before"),
            "errors": _errors(comparison.errors_before),
        },
        "estimates": [
            {
                "name": e.name,
                "description": e.description,
                "ran": e.robot is not None,
                "converged": e.converged,
                "message": e.message,
                "iterations": e.iterations,
                "seconds": e.seconds,
                "n_estimated": len(e.sigma),
                "residual_rms": _rms(e, "after"),
                "predicted_position_rms": e.predicted_rms,
                "predicted_position_rms_fitted": e.predicted_fitted_rms,
                "errors": _errors(e.errors),
                "parameters": _estimated(comparison, e),
            }
            for e in comparison.estimates
        ],
        "inputs": job.inputs,
    }
    plain: dict[str, Any] = _plain(document)
    return plain


def _rms(estimate: Estimate, when: str) -> dict[str, dict[str, float | None]] | None:
    """RMS by split and kind."""
    rms = estimate.residual_rms
    if rms is None:
        return None
    return {split: {kind: rms[split].get(kind, {}).get(when) for kind in KINDS} for split in ("train", "test")}


def _errors(errors: RealErrors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    fitted = None if errors.fitted is None else asdict(errors.fitted)
    return {"base_frame": asdict(errors.base), "best_rigid_fit": fitted}


def _estimated(comparison: Comparison, estimate: Estimate) -> list[dict[str, Any]]:
    job, robot = comparison.job, estimate.robot
    if robot is None:
        return []
    return [
        {
            "name": p.name,
            "unit": p.unit,
            "nominal": p.nominal,
            "true": None if job.truth is None else job.truth.parameters[i].nominal,
            "estimate": robot.parameters[i].nominal,
            "correction": comparison.correction(robot, p.name),
            "sigma": estimate.sigma.get(p.name),
            "held": p.name not in estimate.sigma,
        }
        for i, p in enumerate(job.robot.parameters)
        if p.estimated
    ]


def write_comparison(folder: Path | str, comparison: Comparison) -> None:
    """Write `comparison.json` into a folder, whole or not at all.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(comparison_document(comparison), indent=1, allow_nan=False) + "\n"
    fill_folder(Path(folder), lambda into: write_text(into / "comparison.json", text))


def write_results(
    folder: Path | str, solution: Solution, uncertainty: Uncertainty, inputs: Mapping[str, str] | None = None
) -> None:
    """Write `result.json`, `residuals.csv` and the calibrated robot into a folder, all of them or none.

    Where joint values were estimated there is a `joints.csv` too.

    A robot from a URDF gives `robot_calibrated.urdf`; where base or tool have values of their own, which a URDF cannot
    hold, a `robot_calibrated.yaml` beside it names them.

    Raises:
        InputError: The folder cannot be written.
    """
    robot = solution.problem.robot
    calibrated = robot.with_values(solution.parameters[solution.problem.variables.robot_span])
    document = json.dumps(result_document(solution, uncertainty, inputs), indent=1, allow_nan=False) + "\n"

    def write(into: Path) -> None:
        write_text(into / "result.json", document)
        write_calibrated_robot(into, calibrated)
        _write_residuals(into / "residuals.csv", solution, uncertainty)
        if uncertainty.joint_values is not None:
            _write_joint_values(into / "joints.csv", uncertainty.joint_values, solution.problem.measurements)

    fill_folder(Path(folder), write)


def write_calibrated_robot(folder: Path, robot: Robot) -> None:
    """Write `robot_calibrated.yaml`, or `.urdf`, into a folder."""
    if robot.urdf is None:
        write_robot(folder / "robot_calibrated.yaml", robot)
        return
    write_urdf(folder / "robot_calibrated.urdf", robot)
    if any(p.nominal != 0.0 or p.estimated for p in robot.parameters if p.owner in (0, robot.n_joints + 1)):
        write_robot(folder / "robot_calibrated.yaml", robot, urdf_name="robot_calibrated.urdf")


def _write_residuals(path: Path, solution: Solution, uncertainty: Uncertainty) -> None:
    """One line a scalar residual: what it is of, whether it was used, before and after, in [m] and [rad]."""
    table, fit = uncertainty.residuals, uncertainty.goodness
    ends = solution.problem.measurements.end_names
    suspect = np.zeros(table.n, dtype=np.bool_)
    suspect[fit.suspects] = True
    if fit.test is not None:
        suspect[fit.test.suspects] = True
    kind_in_metres = np.array([FAMILIES[f] not in ("angle", "orientation") for f in FAMILY_OF_KIND])

    def columns(rows: slice) -> dict[str, Any]:
        kind = table.kind_code[rows]
        excess, after, sigma = table.excess[rows], table.after[rows], table.sigma[rows]
        measured = table.measured[rows] - excess  # so that predicted minus measured is 0 on average
        return {
            "kind": Words(ROW_KINDS, kind),
            "a": Words(ends, table.a[rows] + 1),
            "b": Words(ends, table.b[rows] + 1),
            "split": Words(("train", "test"), table.split[rows]),
            "used": table.used[rows],
            "excluded": Words(table.reasons, table.reason_code[rows]),
            "unit": Words(("rad", "m"), kind_in_metres[kind].astype(np.int8)),
            "measured": measured,
            "predicted": measured + after,
            "residual_before": table.before[rows],
            "residual": after,
            "sigma": sigma,
            "whitened": after / sigma,
            "leverage": fit.leverage[rows],
            "studentised": fit.studentised[rows],
            "weight": fit.weight[rows],
            "flag": Words(FLAGS, fit.flag[rows]),
            "noise_adds": excess,
            "suspect": suspect[rows],
        }

    starts = range(0, max(table.n, 1), _ROWS_AT_ONCE)
    write_csv_parts(path, (columns(slice(start, start + _ROWS_AT_ONCE)) for start in starts))


def _write_joint_values(path: Path, found: JointValues, measurements: Measurements) -> None:
    """One line a configuration and joint: reading and estimate, in [rad] (prismatic: [m])."""
    n, k = found.error.shape
    suspect = np.zeros((n, k), dtype=np.bool_)
    for place in found.suspects:
        suspect[place] = True
    columns: dict[str, Any] = {
        "id": Words(measurements.end_names, np.repeat(found.configurations + 1, k)),
        "joint": Words(found.names, np.tile(np.arange(k), n)),
        "reading": found.reading.ravel(),
        "estimate": (found.reading + found.error).ravel(),
        "error": found.error.ravel(),
        "sigma": np.tile(found.sigma, n),
        "error_over_sigma": (found.error / found.sigma).ravel(),
        "studentised": found.studentised.ravel(),
        "suspect": suspect.ravel(),
    }
    write_csv_parts(path, [columns])


def _plain(value: Any) -> Any:
    """Arrays as lists, numpy numbers as Python's, and None for what is not finite."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
