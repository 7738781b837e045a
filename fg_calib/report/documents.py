"""Results for programs: `result.json`, the calibrated robot and the residual table, written whole or not at all."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from fg_calib import __version__
from fg_calib.arguments import checked
from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.diagnostics.nominal_residuals import TypicalResidual
from fg_calib.diagnostics.setup_check import SetupCheck
from fg_calib.errors import InputError
from fg_calib.graph.noise import JOINT_NOISE
from fg_calib.graph.problem import Problem
from fg_calib.graph.solver import Solution
from fg_calib.io.atomic import digest_of, fill_folder, require_own, write_text
from fg_calib.io.csv_writer import Words, write_csv_parts, write_parquet_parts
from fg_calib.io.result import (
    SCHEMA,
    Acceptance,
    AtNominal,
    BeyondTolerance,
    Carried,
    Correlated,
    Covariance,
    Explanation,
    Frame,
    HeldOut,
    InFrames,
    JointScatter,
    KindGoodness,
    Knowledge,
    Lost,
    Missing,
    Observability,
    Parameter,
    Posterior,
    Previous,
    Priors,
    Relative,
    Result,
    Setup,
    Solver,
    Step,
    SuspectReading,
    TestRows,
    ToleranceScale,
    TouchedPoint,
    Typical,
    Weak,
)
from fg_calib.io.result import ExpectedError as ExpectedErrorDocument
from fg_calib.io.result import Folds as FoldsDocument
from fg_calib.io.result import JointValues as JointValuesDocument
from fg_calib.io.result import SuspectConfiguration as Suspect
from fg_calib.io.robot_file import write_robot
from fg_calib.monitoring.fingerprints import fingerprints
from fg_calib.monitoring.prior_information import knowledge_of
from fg_calib.observability.identifiability import Identifiability
from fg_calib.observability.parallel_axes import WORDS, MissingMotion
from fg_calib.options import Options, check
from fg_calib.prediction.expected_error import ExpectedError
from fg_calib.report.page.files import FIGURE_FILES, PAGE
from fg_calib.report.shown import FAMILY_UNIT
from fg_calib.robot.kinematics import SPAN, pose
from fg_calib.robot.model import Robot
from fg_calib.statistics.covariance import TangentCovariance
from fg_calib.statistics.estimates import JointErrors as JointValues
from fg_calib.statistics.estimates import ParameterEstimate
from fg_calib.statistics.goodness_of_fit import (
    FLAGS,
    PREDICTION_VERDICTS,
    VERDICTS,
    KindFit,
    OutlierCounts,
    PredictedFit,
    SuspectConfiguration,
)
from fg_calib.statistics.prior_consistency import PriorFit
from fg_calib.threads import single_threaded

if TYPE_CHECKING:  # a calibration is written without the baseline
    from fg_calib.baseline.comparison import Comparison, Estimate, RealErrors

OBSERVABILITY_SCHEMA = "fg-calib/observability/1"
COMPARISON_SCHEMA = "fg-calib/comparison/1"
KINDS = ("position", "orientation", "distance", "angle")

_ROWS_AT_ONCE = {".csv": 100_000, ".parquet": 20_000}
"""Rows of residuals that are turned into text, or into a group of rows of a Parquet file (of which several wait to be
written), at once."""

ResidualFile = Literal["csv", "parquet", "none"]
"""How single residuals are written, if at all."""


@single_threaded
def result_of(
    solution: Solution,
    uncertainty: Uncertainty,
    inputs: Mapping[str, str] | None = None,
    **origin: Any,
) -> Result:
    """What `result.json` holds: SI, full precision, None for what is unknown or infinite.

    Args:
        solution: The solution.
        uncertainty: Its assessment.
        inputs: SHA-256 of the files it came from, by path.
        origin: `job`, its document, to read tables like its own; `date` of its rows; `previous`, what it came from.
    """
    problem, settings, u = solution.problem, solution.problem.options, uncertainty
    names, goodness = problem.end_names, uncertainty.goodness
    return Result.make(
        schema_=SCHEMA,
        version=__version__,
        robot=problem.robot.name,
        model=" + ".join(dict.fromkeys(table.model or "own" for table in problem.data.tables)),
        frame="unknown" if problem.variables.frames else problem.data.tables[0].frame,
        pairing=_pairing(problem),
        pair_errors=settings.pair_errors if problem.pair_series else None,
        encoder=settings.encoder,
        loss=settings.loss,
        n_configurations=problem.n_configurations,
        n_pairs=problem.n_pairs,
        n_residuals=problem.n_residuals,
        n_priors=problem.n_priors,
        n_excluded=problem.n_excluded,
        solver=_solver(solution),
        trustworthy=u.trustworthy,
        findings=u.findings,
        cautions=u.cautions,
        reservations=u.reservations,
        setup=_setup(u.setup),
        probability_of_noise=u.noise_like,
        chi2=u.chi2,
        dof=u.dof,
        reduced_chi2=u.reduced_chi2,
        chi2_p_value=u.p_value,
        goodness=_goodness_by_kind(goodness.kinds, VERDICTS),
        evaluated_only=problem.evaluated,
        test=_test_rows(u, names),
        acceptance=None if u.acceptance is None else Acceptance.model_validate(u.acceptance),
        folds=_folds(u),
        priors=priors_of(u.priors),
        expected_error=expected_error_of(u.expected_error),
        **_noise_and_tolerances(solution, goodness.kinds),
        suspect_configurations=_suspects(goodness.configurations, names),
        residual_rms=_residual_rms(u),
        **_estimates(problem, u),
        observability=observability_of(u.identifiability),
        **_origin(solution, inputs or {}, **origin),
    )


def _estimates(problem: Problem, u: Uncertainty) -> dict[str, Any]:
    """What was estimated, and of which links of a URDF."""
    urdf, frames = problem.robot.urdf, problem.variables.frames
    return {
        "parameters": tuple(map(parameter_of, u.parameters)),
        "covariance": Covariance.make(names=u.names, matrix=u.covariance),
        "posterior": posterior_of(u.whole),
        "links": None if urdf is None else (urdf.base_link, urdf.tip_link),
        "frame_estimate": None if u.frame is None else Frame.model_validate(u.frame),
        "frames": {v.symbol: Frame.model_validate(f) for v, f in zip(frames, u.frames, strict=True)},
        "joint_values": _joint_values(u.joint_values, problem.end_names),
        "groups": tuple(map(TouchedPoint.model_validate, u.points)),
    }


def _origin(
    solution: Solution,
    inputs: Mapping[str, str],
    job: Mapping[str, Any] | None = None,
    date: str | None = None,
    previous: Previous | None = None,
) -> dict[str, Any]:
    """What a result came from, and what the next one takes over."""
    return {
        "options": choices_of(solution.problem.options),
        "versions": dict(versions()),
        "inputs": dict(inputs),
        "date": date or datetime.now(UTC).isoformat(timespec="seconds"),
        "previous": previous,
        "carried": _carried(solution, job or {}),
    }


def _carried(solution: Solution, job: Mapping[str, Any]) -> Carried:
    """What the next calibration takes over."""
    problem, known = solution.problem, knowledge_of(solution)
    noise: dict[str, dict[str, float]] = {}
    for (table, kind), factor in problem.state.factors.items():
        source = "" if table < 0 else problem.data.tables[table].measurements.source
        noise.setdefault(source.partition(", station ")[0], {})[kind] = factor
    document = None
    if known is not None:
        document = Knowledge.make(
            columns=known.variables.names,
            unknowns=known.unknowns,
            at=known.at,
            rows=known.rows,
            right=known.right,
            views=known.views,
            nominal=None
            if known.nominal is None
            else AtNominal.make(parameters=known.nominal.robot.nominal, at=known.nominal.at, rows=known.nominal.rows),
        )
    rows = fingerprints(problem.data.tables)
    return Carried.make(job=dict(job), rows=rows, noise=noise, knowledge=document)


def choices_of(options: Options) -> dict[str, Any]:
    """Every choice by name; of what is accepted the limits that were set."""
    given = {f.name: getattr(options, f.name) for f in fields(options)}
    limits = {key: limit for key, limit in asdict(options.accept).items() if limit is not None}
    words = {"pairing": str(options.pairing), "prefer": list(options.prefer), "accept": limits}
    return given | words


@cache
def versions() -> dict[str, str]:
    """What the figures were computed with."""
    libraries = {"gtsam": metadata.version("gtsam"), "numpy": np.__version__, "scipy": scipy.__version__}
    return {"fg-calib": __version__, "python": platform.python_version(), **libraries}


@checked
def result_document(
    solution: Solution, uncertainty: Uncertainty, inputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """`result_of` as it is written to `result.json`."""
    return result_of(solution, uncertainty, inputs).document()


def _pairing(problem: Problem) -> str | None:
    tables = [table for table in problem.data.tables if table.uses_pairs]
    if not tables or (tables[0].measurements.pairs is None and not problem.formed):
        return None
    return "measured" if tables[0].measurements.pairs is not None else str(tables[0].pairing)


def _solver(solution: Solution) -> Solver:
    return Solver(
        name="gtsam-lm",
        converged=solution.converged,
        message=solution.message,
        iterations=solution.iterations,
        initial_cost=solution.initial_cost,
        cost=solution.cost,
        seconds=solution.seconds,
        history=tuple(
            Step.make(cost=i.cost, damping=i.damping, step=i.step, decrement=i.decrement) for i in solution.history
        ),
    )


def _residual_rms(uncertainty: Uncertainty) -> dict[str, dict[str, Any]]:
    """RMS by split and kind, where several tables have a kind also by table; kinds of one's own with their unit."""
    table = uncertainty.residuals
    rms, kinds = table.rms(), list(dict.fromkeys((*KINDS, *table.families)))
    for number, kind in table.groups:
        if sum(other == kind for _, other in table.groups) > 1:
            kinds.append(f"{kind}, table {number + 1}")
            for split, found in table.rms(number).items():
                rms[split] |= {kinds[-1]: found[kind]} if kind in found else {}
    of_own = {kind: {"unit": table.unit(kind)} for kind in table.families if kind not in FAMILY_UNIT}

    def document(split: str, kind: str) -> dict[str, Any] | None:
        found = rms[split].get(kind)
        return None if found is None else found | of_own.get(kind.partition(", table")[0], {})

    return {split: {kind: document(split, kind) for kind in kinds} for split in ("train", "test")}


def parameter_of(p: ParameterEstimate) -> Parameter:
    """A parameter; what it stands for only where others were left out to fix the gauge."""
    own = {f.name: getattr(p, f.name) for f in fields(p)}
    if p.stands_for is None:
        del own["stands_for"], own["sigma_of_combination"]
    return Parameter(**own)


def posterior_of(found: TangentCovariance) -> Posterior:
    """The covariance in the tangent space, and what nothing determines."""
    v = found.variables
    return Posterior.make(
        variables={item.symbol: v.names[item.columns] for item in v.items},
        covariance=found.tangent,
        undetermined=found.loose,
        undetermined_at_nominal=found.loose_at_nominal,
    )


def _noise_factors(solution: Solution, fits: Sequence[KindFit]) -> dict[str, float] | None:
    if solution.estimated_noise is None:
        return None
    of_joints = {"joint": solution.problem.state.factors.get(JOINT_NOISE, 1.0)} if _joints(solution) else {}
    return {_key(fit, fits): fit.own_factor for fit in fits} | of_joints


def _noise_kept(solution: Solution, fits: Sequence[KindFit]) -> tuple[str, ...]:
    """Keys of the factors that are 1 because the noise could not be estimated."""
    estimated = solution.estimated_noise
    if estimated is None:
        return ()
    of_joints = ("joint",) if _joints(solution) and JOINT_NOISE not in estimated else ()
    return (*(_key(fit, fits) for fit in fits if (fit.table, fit.kind) not in estimated), *of_joints)


def _noise_and_tolerances(solution: Solution, fits: Sequence[KindFit]) -> dict[str, Any]:
    """What noise and tolerances were estimated, by key."""
    found = solution.estimated_tolerances
    scales = None if found is None else tuple(map(ToleranceScale.model_validate, found.scales))
    factors, kept = _noise_factors(solution, fits), _noise_kept(solution, fits)
    return {"noise_factors": factors, "noise_kept": kept, "tolerance_scales": scales}


def _joints(solution: Solution) -> bool:
    """Whether noise of the joint readings is stated."""
    return bool(np.any(solution.problem.data.sigma_joint > 0.0))


def _key(fit: KindFit, fits: Sequence[KindFit]) -> str:
    """The kind of noise, with the number of its table where several have that kind."""
    alone = sum(other.kind == fit.kind for other in fits) == 1
    return fit.kind if alone else f"{fit.kind}, table {fit.table + 1}"


def _goodness_by_kind(fits: Sequence[KindFit], words: Mapping[str, str]) -> dict[str, KindGoodness]:
    return {
        _key(fit, fits): KindGoodness(
            n=fit.n,
            stated_sigma_rms=fit.stated_sigma_rms,
            seen_over_stated=fit.seen_over_stated,
            chi2=fit.chi2,
            expected=fit.expected,
            p_value=fit.p_value,
            verdict=words[fit.verdict],
        )
        for fit in fits
    }


def _suspects(found: Sequence[SuspectConfiguration], names: Sequence[str]) -> tuple[Suspect, ...]:
    return tuple(Suspect(id=names[c.configuration + 1], n=c.n, chi2=c.chi2, expected=c.expected) for c in found)


def _test_rows(uncertainty: Uncertainty, names: Sequence[str]) -> TestRows | None:
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
    return TestRows(
        n_rows=fit.n_rows,
        n=fit.n,
        n_outliers=fit.outliers.test,
        n_unknown=fit.n_unknown,
        chi2=fit.chi2,
        expected=fit.expected,
        p_value=fit.p_value,
        goodness=_goodness_by_kind(fit.kinds, PREDICTION_VERDICTS),
        n_suspect_rows=len(fit.suspects),
        suspect_configurations=_suspects(fit.configurations, names),
    )


def _folds(uncertainty: Uncertainty) -> FoldsDocument | None:
    """What cross-validation found; None without it."""
    found = uncertainty.folds
    if found is None:
        return None
    estimated = {p.name for p in uncertainty.parameters if p.identifiability != "fixed"}
    spread = {name: s for name, s in found.spread.items() if name in estimated}
    return FoldsDocument.make(
        n=found.n,
        n_held_out=int(np.sum(found.fold >= 0)),
        n_not_converged=found.not_converged,
        of_pairs=found.of_pairs,
        kinds={kind: HeldOut.model_validate(held) for kind, held in found.kinds.items()},
        spread=spread,
    )


def expected_error_of(expected: ExpectedError | None) -> ExpectedErrorDocument | None:
    """Expected RMS errors of the tool."""
    if expected is None:
        return None
    base, fitted = expected.base, expected.fitted
    return ExpectedErrorDocument(
        position=InFrames(base=base.position, fitted=fitted.position),
        orientation=InFrames(base=base.orientation, fitted=fitted.orientation),
        at=expected.at,
        n=expected.n,
        of=expected.of,
        relative=expected.relative,
    )


def _joint_values(found: JointValues | None, names: Sequence[str]) -> JointValuesDocument | None:
    """How estimated joint values lie about their readings; None where these were not estimated."""
    if found is None:
        return None
    return JointValuesDocument(
        n=len(found.configurations),
        joints=tuple(
            JointScatter(name=name, sigma=sigma, mean=mean, scatter=scatter)
            for name, sigma, mean, scatter in zip(found.names, found.sigma, found.mean, found.scatter, strict=True)
        ),
        suspects=tuple(
            SuspectReading(
                id=names[found.configurations[i] + 1],
                joint=found.names[k],
                error=found.error[i, k],
                studentised=found.studentised[i, k],
            )
            for i, k in found.suspects
        ),
    )


def priors_of(fit: PriorFit | None) -> Priors | None:
    """Corrections against tolerances; None without priors."""
    if fit is None:
        return None
    return Priors(
        n=len(fit.names),
        chi2=fit.chi2,
        expected=fit.expected,
        p_value=fit.p_value,
        beyond_tolerance=tuple(
            BeyondTolerance(parameter=one.name, correction_over_tolerance=one.z, sigma=one.sigma) for one in fit.beyond
        ),
    )


def _setup(check: SetupCheck) -> Setup:
    """Residuals before the calibration beside what noise and tolerances predict, and mistakes that explain them."""

    def by_kind(residuals: Sequence[TypicalResidual]) -> dict[str, Typical]:
        return {r.kind: Typical(typical=r.size, predicted=r.expected) for r in residuals}

    more = dict[str, Any](table=check.table) if check.table else {}
    if check.others:
        more["others"] = tuple(map(_setup, check.others))
    return Setup(
        **more,
        residuals=by_kind(check.residuals),
        explanations=tuple(
            Explanation(mistakes=e.mistakes, residuals=by_kind(e.residuals)) for e in check.explanations
        ),
    )


def observability_of(found: Identifiability) -> Observability:
    """What `observability.json` holds: sigmas, correlations and weak directions only where the noise is the user's."""
    o, more = found.observability, dict[str, Any]()
    if found.kind == "practical":
        more["sigma"] = o.sigma
        more["correlations"] = tuple(Correlated(parameters=(a, b), correlation=rho) for a, b, rho in o.correlations)
        more["weak"] = tuple(map(Weak.model_validate, o.weak))
    if found.with_fixed_known is not None:
        more["fixed"] = found.fixed
        more["with_fixed_known"] = observability_of(found.with_fixed_known)
    return Observability.make(
        schema_=OBSERVABILITY_SCHEMA,
        robot=found.robot,
        model=found.model,
        kind=found.kind,
        n_configurations=found.n_configurations,
        n_parameters=len(o.names),
        rank=o.rank,
        names=o.names,
        singular_values=o.singular_values,
        gap=o.gap,
        independent=o.named("independent"),
        ineffective=o.named("ineffective"),
        relative=tuple(map(Relative.model_validate, o.relative)),
        kept=o.kept,
        lost=tuple(map(Lost.model_validate, found.lost)),
        missing=tuple(_missing(m) for m in found.missing),
        null_space=o.null_space,
        indices=o.indices,
        condition_number=o.condition_number,
        **more,
    )


def _missing(m: MissingMotion) -> Missing:
    return Missing(
        axes=m.axes,
        motions=tuple(WORDS[motion] for motion in m.motions),
        convention=m.convention,
        use=m.use,
        message=str(m),
    )


@checked
def observability_document(found: Identifiability) -> dict[str, Any]:
    """`observability_of` as it is written to `observability.json`."""
    return observability_of(found).document()


@checked
def write_observability(folder: Path | str, found: Identifiability) -> None:
    """Write `observability.json` and its figures (see `write_figures`) into a folder, all of them or none.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(observability_document(found), indent=1, allow_nan=False) + "\n"

    from fg_calib.report.figures import FIGURES, write_figures

    def write(into: Path) -> None:
        write_text(into / "observability.json", text)
        write_figures(into, found)

    figures = dict.fromkeys(FIGURES, b"\x89PNG")
    fill_folder(Path(folder), write, {"observability.json": b'{\n "schema": "fg-calib/observability/', **figures})


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
    of_pairs = next((table for table in job.tables if table.uses_pairs), None)
    measured = of_pairs is not None and of_pairs.measurements.pairs is not None
    pairing = "measured" if measured else None if of_pairs is None else str(of_pairs.pairing)
    unknown = any(table.unknown_frame for table in job.tables)
    document = {
        "schema": COMPARISON_SCHEMA,
        "version": __version__,
        "robot": job.robot.name,
        "model": job.model,
        "frame": "unknown" if unknown else job.tables[0].frame,
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
    kinds = list(dict.fromkeys((*KINDS, *rms["train"], *rms["test"])))
    return {split: {kind: rms[split].get(kind, {}).get(when) for kind in kinds} for split in ("train", "test")}


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


@checked
def write_comparison(folder: Path | str, comparison: Comparison, *, figures: bool = False) -> None:
    """Write `comparison.json`, and `comparison.svg` if figures are wanted, into a folder, all of them or none.

    Raises:
        InputError: The folder cannot be written.
    """
    text = json.dumps(comparison_document(comparison), indent=1, allow_nan=False) + "\n"
    texts = {"comparison.json": text}
    if figures:
        from fg_calib.report.page.estimators import draw_estimators

        texts["comparison.svg"] = draw_estimators(comparison)

    def write(into: Path) -> None:
        for name, content in texts.items():
            write_text(into / name, content)

    own = {"comparison.json": b'{\n "schema": "fg-calib/comparison/', "comparison.svg": b"<svg"}
    fill_folder(Path(folder), write, own)


RESULT_FILES = {
    "result.json": b'{\n "schema": "fg-calib/result/',
    "residuals.csv": b"kind,a,b,split,used,excluded,",
    "residuals.parquet": b"PAR1",
    "configurations.csv": b"id,split,q1,",
    **PAGE,
    **FIGURE_FILES,
    "joints.csv": b"id,joint,unit,reading,estimate,",
    "history.json": b'{\n "schema": "fg-calib/history/',
    "robot_calibrated.yaml": b"",
    "robot_calibrated.urdf": b"",
}
"""What a calibration may write and how it begins; of one result all are of the same calibration."""


@checked
def write_results(
    folder: Path | str,
    solution: Solution,
    uncertainty: Uncertainty,
    inputs: Mapping[str, str] | None = None,
    residuals: ResidualFile = "csv",
) -> None:
    """Write `result.json`, the calibrated robot, `residuals.csv` and `configurations.csv` into a folder, all or none.

    Where joint values were estimated there is a `joints.csv` too.

    A robot from a URDF gives `robot_calibrated.urdf`; where base or tool have values of their own, which a URDF cannot
    hold, a `robot_calibrated.yaml` beside it names them.

    Args:
        folder: Where to.
        solution: The solution.
        uncertainty: Its assessment.
        inputs: SHA-256 of the files it came from, by path.
        residuals: How single residuals are written, if at all: `residuals.csv` or `residuals.parquet`.

    Raises:
        InputError: The folder cannot be written.
    """
    write_result(folder, result_of(solution, uncertainty, inputs), solution, uncertainty, residuals=residuals)


def write_result(
    folder: Path | str,
    result: Result,
    solution: Solution,
    uncertainty: Uncertainty,
    more: Callable[[str], dict[str, str]] | None = None,
    residuals: ResidualFile = "csv",
) -> None:
    """`write_results` of a result that has been made.

    Args:
        folder: Where to.
        result: What `result.json` holds.
        solution: The solution.
        uncertainty: Its assessment.
        more: Text of other files by name, of the SHA-256 of `result.json`.
        residuals: See `write_results`.

    Raises:
        InputError: The folder cannot be written.
    """
    check("residuals", residuals, ResidualFile)
    robot = solution.problem.robot
    calibrated = robot.with_values(solution.parameters[solution.problem.variables.robot_span])
    document = result.document()

    def write(into: Path) -> None:
        write_calibrated_robot(into, calibrated)
        _write_configurations(into / "configurations.csv", solution, uncertainty)
        tables = ["configurations.csv"]
        if residuals != "none":
            tables.append(f"residuals.{residuals}")
            _write_residuals(into / tables[-1], solution, uncertainty)
        if uncertainty.joint_values is not None:
            units = [robot.joints[j].unit for j in uncertainty.joint_values.joints]
            _write_joint_values(into / "joints.csv", uncertainty.joint_values, solution.problem.end_names, units)
        digests = {name: digest_of(into / name) for name in tables}
        text = json.dumps(document | {"files": digests}, indent=1, allow_nan=False) + "\n"
        write_text(into / "result.json", text)
        for name, content in ({} if more is None else more(sha256(text.encode()).hexdigest())).items():
            write_text(into / name, content)

    fill_folder(Path(folder), write, RESULT_FILES)


def require_no_input(folder: Path, path: Path | None, inputs: Mapping[str, str]) -> None:
    """Check that results written to a folder would not replace what a job was read from, nor what is of no result.

    Args:
        folder: Where to.
        path: The job's file, if it is in one.
        inputs: What it was read from, by path relative to the job.

    Raises:
        InputError: They would.
    """
    files = set() if path is None else {(path.parent / name).resolve() for name in inputs}
    for name in RESULT_FILES:
        if (folder / name).resolve() in files:
            raise InputError(str(folder / name), "the job was read from it", "another folder for the results")
    require_own(folder, RESULT_FILES)


def require_apart(folder: Path, results: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Check that an update written to a folder would replace neither what it comes from nor what is of no result.

    Args:
        folder: Where to.
        results: Folders that are read.
        inputs: Files that are read.

    Raises:
        InputError: It would.
    """
    if any(folder.resolve() == result.resolve() for result in results):
        raise InputError(str(folder), "the folder of the result that is updated", "another one, for the new result")
    for name in RESULT_FILES:
        if (folder / name).resolve() in {path.resolve() for path in inputs}:
            raise InputError(str(folder / name), "it is read", "another folder for the results")
    require_own(folder, RESULT_FILES)


def write_calibrated_robot(folder: Path, robot: Robot) -> None:
    """Write `robot_calibrated.yaml`, or `.urdf`, into a folder."""
    if robot.urdf is None:
        write_robot(folder / "robot_calibrated.yaml", robot)
        return
    from fg_calib.io.urdf import write_urdf

    write_urdf(folder / "robot_calibrated.urdf", robot)
    if any(p.nominal != 0.0 or p.estimated for p in robot.parameters if p.owner in (0, robot.n_joints + 1)):
        write_robot(folder / "robot_calibrated.yaml", robot, urdf_name="robot_calibrated.urdf")


def _write_residuals(path: Path, solution: Solution, uncertainty: Uncertainty) -> None:
    """One line a scalar residual: what it is of, whether it was used, before and after, in [m], [rad] or [px]."""
    table, fit = uncertainty.residuals, uncertainty.goodness
    ends = solution.problem.end_names
    suspect = np.zeros(table.n, dtype=np.bool_)
    suspect[fit.suspects] = True
    if fit.test is not None:
        suspect[fit.test.suspects] = True
    sources = solution.problem.data.labels
    tables = [kind.table for kind in table.kinds]
    labelled = len(table.labels) > 1

    def columns(rows: slice) -> dict[str, Any]:
        kind = table.kind_code[rows]
        excess, after, sigma = table.excess[rows], table.after[rows], table.sigma[rows]
        measured = table.measured[rows] - excess  # so that predicted minus measured is 0 on average
        return {
            "kind": Words([kind.name for kind in table.kinds], kind),
            "a": Words(ends, table.a[rows] + 1),
            "b": Words(ends, table.b[rows] + 1),
            "split": Words(("train", "test"), table.split[rows]),
            "used": table.used[rows],
            "excluded": Words(table.reasons, table.reason_code[rows]),
            "unit": Words([kind.unit for kind in table.kinds], kind),
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
            **({} if len(sources) == 1 else {"table": Words(sources, np.array(tables, dtype=np.int16)[kind])}),
            **({"of": Words(table.labels, table.label_code[rows])} if labelled else {}),
            **({"row": _numbers(table.table_row[rows])} if labelled else {}),
        }

    n = _ROWS_AT_ONCE[path.suffix]
    write = write_csv_parts if path.suffix == ".csv" else write_parquet_parts
    write(path, (columns(slice(start, start + n)) for start in range(0, max(table.n, 1), n)))


def _write_configurations(path: Path, solution: Solution, uncertainty: Uncertainty) -> None:
    """One line a configuration: its readings, where the calibrated tool is (from the base), how large residuals are."""
    data, robot = solution.problem.data, uncertainty.robot
    readings, n = data.readings, data.n_configurations
    held_out = data.held_out | solution.problem.evaluated
    rows, chi2, rms = uncertainty.residuals.of_configurations(held_out)
    tool = np.concatenate([pose(robot, readings[k : k + SPAN]).position for k in range(0, max(n, 1), SPAN)])
    columns: dict[str, Any] = {
        "id": Words(data.names[:n], np.arange(n)),
        "split": Words(("train", "test"), held_out.astype(np.int64)),
        **{f"q{i + 1}": readings[:, i] for i in range(robot.n_joints)},
        **{f"tool_{axis}": tool[:, i] for i, axis in enumerate("xyz")},
        "rows": rows,
        "chi2": chi2,
        **{f"rms_{family}": figures for family, figures in rms.items()},
    }
    write_csv_parts(path, [columns])


def _numbers(rows: NDArray[np.int32]) -> Words:
    """Numbers of rows as words, those below 0 empty."""
    different, codes = np.unique(rows, return_inverse=True)
    return Words(["" if row < 0 else str(row) for row in different.tolist()], codes)


def _write_joint_values(path: Path, found: JointValues, names: Sequence[str], units: Sequence[str]) -> None:
    """One line a configuration and joint: reading and estimate, in [rad] (prismatic: [m])."""
    n, k = found.error.shape
    suspect = np.zeros((n, k), dtype=np.bool_)
    for place in found.suspects:
        suspect[place] = True
    columns: dict[str, Any] = {
        "id": Words(names, np.repeat(found.configurations + 1, k)),
        "joint": Words(found.names, np.tile(np.arange(k), n)),
        "unit": Words(units, np.tile(np.arange(k), n)),
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
