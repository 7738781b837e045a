"""The typed result of a calibration: `result.json` is its dump, and what reads back prints the same.

Its parts are what the analysis returns. All values are in [m] and [rad]; null is unknown or infinite.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import scipy
from pydantic import (
    AliasChoices,
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WrapSerializer,
)

from fg_calib import __version__
from fg_calib.assessment import Assessment
from fg_calib.diagnostics import SetupCheck
from fg_calib.graph import JOINT_NOISE, Problem, Solution, ToleranceScale
from fg_calib.inputs import NORM_TOLERANCE, Figure, Floats, FrameKnowledge, InputError, Model, Options, checked
from fg_calib.io.atomic import exists, is_folder, read_text
from fg_calib.io.yaml import first_misfit
from fg_calib.measurements import Table
from fg_calib.monitoring import fingerprints, knowledge_of
from fg_calib.observability import Identifiability
from fg_calib.prediction import ExpectedError
from fg_calib.statistics import (
    Acceptance,
    CrossValidation,
    FrameEstimate,
    JointErrors,
    KindFit,
    LandmarkEstimate,
    ParameterEstimate,
    PredictedFit,
    PriorFit,
    ResidualTable,
    TangentCovariance,
)

SCHEMA = "fg-calib/result/2"
OBSERVABILITY_SCHEMA = "fg-calib/observability/1"

KINDS = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad", "point": "m", "pixel": "px"}
"""Unit of each usual kind of residual."""


def _flat(found: Identifiability, handler: Any) -> dict[str, Any]:
    """Identifiability as `observability.json` has it: the fields of its observability among its own."""
    document = handler(found)
    o = found.observability
    classes = {name: o.named(name) for name in ("independent", "ineffective")} | {"kept": o.kept}
    return {
        "schema": OBSERVABILITY_SCHEMA,
        "n_parameters": len(o.names),
        **classes,
        **document.pop("observability"),
        **document,
    }


Observability = Annotated[
    Identifiability,
    WrapSerializer(_flat),
    BeforeValidator(lambda value: {**value, "observability": value} if isinstance(value, dict) else value),
]
"""What the data determine; flat in JSON."""


class Section(BaseModel):
    """A part of a document; it may be made of any object that has its fields as attributes."""

    model_config = ConfigDict(
        frozen=True, from_attributes=True, populate_by_name=True, protected_namespaces=(), defer_build=True
    )


class Step(Section):
    """One step of the solver."""

    cost: Figure
    damping: Figure = Field(alias="lambda")
    step: Figure
    decrement: Figure | None = None


class SolverRun(Section):
    """How the solver ended."""

    name: str = "gtsam-lm"
    converged: bool
    message: str
    iterations: int
    initial_cost: Figure
    cost: Figure
    seconds: Figure
    history: tuple[Step, ...] = ()


class Rms(Section):
    """Root mean square of residuals before and after the calibration; `unit` of a custom kind."""

    before: float | None
    after: float | None
    unit: str | None = None


class Covariance(Section):
    """Covariance of the errors of parameters, nan where they are not determined."""

    names: tuple[str, ...]
    matrix: Floats


class Posterior(Section):
    """The covariance in the tangent space of the variables, and the undetermined directions, for predictions.

    Columns are those of the variables one after the other: the parameters of a vector; of a pose, the rotation about
    its own x, y, z axes, then the translation along them.
    """

    variables: dict[str, tuple[str, ...]]
    covariance: Floats
    undetermined: Floats
    undetermined_at_nominal: Floats

    @classmethod
    def of(cls, covariance: TangentCovariance) -> Posterior:
        """The posterior of a tangent covariance."""
        v = covariance.variables
        return cls(
            variables={item.symbol: tuple(v.names[item.columns]) for item in v.items},
            covariance=covariance.tangent,
            undetermined=covariance.loose,
            undetermined_at_nominal=covariance.loose_at_nominal,
        )


class SuspectConfiguration(Section):
    """A configuration whose residuals together are larger than noise."""

    id: str
    n: int
    chi2: Figure
    expected: Figure


class Knowledge(Section):
    """The information of the rows, linearised at the estimate, for the next calibration.

    `rows` by `columns`: those of the arm as in `posterior`, then three of each of `unknowns`. `nominal` holds the same
    rows at the nominal arm, which parameters are classed by.
    """

    columns: tuple[str, ...] = Field((), validation_alias=AliasChoices("columns", AliasPath("variables", "names")))
    unknowns: tuple[tuple[str, str], ...] = ()
    at: Floats
    rows: Floats
    right: Floats
    views: tuple[tuple[Model, FrameKnowledge], ...] = ()
    parameters: Floats = Field(validation_alias=AliasChoices("parameters", AliasPath("robot", "nominal")))
    nominal: Knowledge | None = None


class Carried(Section):
    """What the next calibration of this arm takes over.

    `job` is the job without its robot, by which tables like its own are read; `rows` are fingerprints of the fitted
    rows, so that none counts twice; `noise` the factors on specified sigmas by table and kind, where it was estimated.
    """

    job: dict[str, Any] = {}
    rows: tuple[str, ...] = ()
    noise: dict[str, dict[str, float]] = {}
    knowledge: Knowledge | None = None


def _dated(date: str) -> str:
    if date:
        datetime.fromisoformat(date)
    return date


Date = Annotated[str, BeforeValidator(_dated)]
"""A date as ISO 8601 has it; empty if it is unknown."""


class Run(Section):
    """One run of a history.

    Attributes:
        date: When its rows were measured.
        n_residuals: Number of fitted residuals.
        chi2: Chi-square of its rows and the information before.
        dof: Its degrees of freedom.
        p_value: Probability of a larger one.
        verdict: `good` or `doubtful`.
        parameters: Estimate, sigma and unit of each estimated parameter.
        inputs: SHA-256 of the files of its rows, by path.
        rows: Fingerprints of its rows.
    """

    date: Date
    n_residuals: int
    chi2: Figure
    dof: int
    p_value: float | None
    verdict: Literal["good", "doubtful"]
    parameters: dict[str, tuple[float, float | None, str]]
    inputs: dict[str, str] = {}
    rows: tuple[str, ...] = ()


class Result(Section):
    """All that `result.json` holds.

    `date` is when the rows were measured, or when they were calibrated if that is unknown. `history` are the runs
    before this one. `files` holds SHA-256 of the tables written with it, `links` the ends of a URDF's chain.
    """

    schema_: Literal["fg-calib/result/2"] = Field(alias="schema", default="fg-calib/result/2")
    version: str = __version__
    robot: str
    model: str
    frame: str
    pairing: str | None
    pair_errors: str | None = None
    encoder: str = "propagated"
    loss: str = "none"
    tables: tuple[tuple[str, str], ...] = ()
    n_configurations: int
    n_pairs: int
    n_residuals: int
    n_priors: int = 0
    n_unknowns: int = 0
    n_determined: int = 0
    n_excluded: dict[str, int]
    solver: SolverRun
    trustworthy: bool
    findings: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    reservations: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    setup: SetupCheck | None = None
    probability_of_noise: float | None = None
    chi2: Figure
    dof: int
    reduced_chi2: float | None
    chi2_p_value: float | None = None
    chi2_expected: Figure = np.nan
    chi2_bounds: tuple[Figure, Figure] = (np.nan, np.nan)
    goodness: dict[str, KindFit] = {}
    suspect_level: Figure = np.nan
    suspect_configurations: tuple[SuspectConfiguration, ...] = ()
    evaluated_only: bool = False
    test: PredictedFit | None = None
    acceptance: Acceptance | None = None
    folds: CrossValidation | None = None
    priors: PriorFit | None = None
    expected_error: ExpectedError | None = None
    sigma_joint: Floats = Field(default_factory=lambda: np.zeros(0))
    noise_factors: dict[str, float] | None = None
    noise_kept: tuple[str, ...] = ()
    tolerance_scales: tuple[ToleranceScale, ...] | None = None
    residual_rms: dict[str, dict[str, Rms | None]]
    parameters: tuple[ParameterEstimate, ...]
    covariance: Covariance
    posterior: Posterior
    links: tuple[str, str] | None = None
    frame_estimate: FrameEstimate | None
    frames: dict[str, FrameEstimate] = {}
    joint_values: JointErrors | None = None
    groups: tuple[LandmarkEstimate, ...] = ()
    observability: Observability
    options: Options
    versions: dict[str, str] = {}
    files: dict[str, str] = {}
    inputs: dict[str, str]
    date: Date = ""
    history: tuple[Run, ...] = ()
    carried: Carried = Carried()

    @classmethod
    def of(
        cls,
        solution: Solution,
        assessed: Assessment,
        *,
        inputs: Mapping[str, str] | None = None,
        job: Mapping[str, Any] | None = None,
        date: str | None = None,
        history: tuple[Run, ...] = (),
        notes: tuple[str, ...] = (),
    ) -> Result:
        """The result of a solution and its assessment.

        Args:
            solution: The solution.
            assessed: Its assessment.
            inputs: SHA-256 of the files that it was read from, by path.
            job: The document of the job, to read tables like its own.
            date: When its rows were measured; now if None.
            history: The runs before it.
            notes: What a reader should know besides, a sentence each.
        """
        problem, options = solution.problem, solution.problem.options
        urdf = problem.robot.urdf
        return cls(
            **_description(problem),
            **_fit(solution, assessed),
            **_verdict(assessed),
            **_estimates(problem, assessed),
            **_noise_factors(solution, assessed.fit.goodness.kinds),
            pair_errors=options.pair_errors if problem.pair_series else None,
            encoder=options.encoder,
            loss=options.loss,
            sigma_joint=problem.sigma_joint,
            links=None if urdf is None else (urdf.base_link, urdf.tip_link),
            observability=assessed.identifiability,
            options=options,
            versions=versions(),
            inputs=dict(inputs or {}),
            date=date or datetime.now(UTC).isoformat(timespec="seconds"),
            history=history,
            notes=notes,
            carried=_carried(solution, job or {}),
        )

    @property
    def free_of_frame(self) -> bool:
        """Whether nothing was measured in the base frame, so that errors count after the best rigid fit."""
        if self.expected_error is not None:
            return self.expected_error.relative
        return self.frame_estimate is not None or self.pairing is not None

    @property
    def estimated(self) -> tuple[ParameterEstimate, ...]:
        """The parameters that are not fixed."""
        return tuple(p for p in self.parameters if p.identifiability != "fixed")

    @property
    def run(self) -> Run:
        """This result as one run of a history."""
        known = set(self.covariance.names)
        return Run(
            date=self.date,
            n_residuals=self.n_residuals,
            chi2=self.chi2,
            dof=self.dof,
            p_value=self.chi2_p_value,
            verdict="good" if self.trustworthy else "doubtful",
            parameters={p.name: (p.estimate, p.sigma, p.unit) for p in self.parameters if p.name in known},
            inputs=self.inputs,
            rows=self.carried.rows,
        )

    def unit_of(self, kind: str) -> str:
        """The unit of a kind of residual: `m`, `rad` or `px`."""
        for kinds in self.residual_rms.values():
            rms = kinds.get(kind)
            if rms is not None and rms.unit is not None:
                return rms.unit
        return KINDS.get(kind.partition(",")[0], "m")

    def rms_after(self, split: str) -> dict[str, float]:
        """RMS of the residuals of `train` or `test` rows after the calibration, by kind."""
        kinds = self.residual_rms.get(split, {})
        return {kind: rms.after for kind, rms in kinds.items() if rms is not None and rms.after is not None}

    def document(self) -> dict[str, Any]:
        """The content of `result.json`."""
        document: dict[str, Any] = json.loads(self.model_dump_json(by_alias=True))
        return document


def _description(problem: Problem) -> dict[str, Any]:
    """Robot, tables and counts."""
    data, frames = problem.data, problem.variables.frames
    return {
        "robot": problem.robot.name,
        "model": " + ".join(dict.fromkeys(table.model or "own" for table in data.tables)),
        "frame": "unknown" if frames else data.tables[0].frame,
        "pairing": _pairing(problem),
        "tables": tuple((label, in_words(table)) for label, table in zip(data.labels, data.tables, strict=True)),
        "n_configurations": problem.n_configurations,
        "n_pairs": problem.n_pairs,
        "n_residuals": problem.n_residuals,
        "n_priors": problem.n_priors,
        "n_unknowns": len(problem.variables.all_scales),
        "n_excluded": problem.n_excluded,
        "evaluated_only": problem.evaluated,
    }


def _fit(solution: Solution, assessed: Assessment) -> dict[str, Any]:
    """Solver, chi-square and goodness of fit."""
    fit, chi2, tolerances = assessed.fit, assessed.fit.chi_square, solution.estimated_tolerances
    goodness, names = fit.goodness, solution.problem.end_names
    return {
        "solver": SolverRun.model_validate(solution),
        "n_determined": assessed.spread.rank,
        "chi2": chi2.value,
        "dof": chi2.dof,
        "reduced_chi2": chi2.reduced,
        "chi2_p_value": chi2.p_value,
        "chi2_expected": chi2.expected,
        "chi2_bounds": chi2.bounds,
        "goodness": {key_of(kind, goodness.kinds): kind for kind in goodness.kinds},
        "suspect_level": goodness.level,
        "suspect_configurations": tuple(
            SuspectConfiguration(id=names[c.configuration + 1], n=c.n, chi2=c.chi2, expected=c.expected)
            for c in goodness.configurations
        ),
        "test": goodness.test,
        "priors": fit.priors,
        "tolerance_scales": None if tolerances is None else tolerances.scales,
        "residual_rms": _residual_rms(fit.residuals),
    }


def _verdict(assessed: Assessment) -> dict[str, Any]:
    """Whether the result is to be trusted and accepted, and by which errors."""
    verdict = assessed.verdict
    return {
        "trustworthy": assessed.trustworthy,
        "findings": verdict.errors,
        "cautions": verdict.cautions,
        "reservations": verdict.warnings,
        "setup": verdict.setup,
        "probability_of_noise": verdict.noise_like,
        "acceptance": assessed.acceptance,
        "folds": assessed.cross_validation,
        "expected_error": assessed.expected_error,
    }


def _estimates(problem: Problem, assessed: Assessment) -> dict[str, Any]:
    """Parameters, frames, landmarks and their covariance."""
    found = assessed.estimates
    return {
        "parameters": found.parameters,
        "covariance": Covariance(names=assessed.names, matrix=assessed.covariance),
        "posterior": Posterior.of(assessed.whole),
        "frame_estimate": found.frame,
        "frames": {v.symbol: frame for v, frame in zip(problem.variables.frames, found.frames, strict=True)},
        "joint_values": found.joint_errors,
        "groups": found.landmarks,
    }


def key_of(fit: KindFit, fits: tuple[KindFit, ...]) -> str:
    """A kind of noise, with the number of its table where several tables have that kind."""
    several = sum(other.kind == fit.kind for other in fits) > 1
    return f"{fit.kind}, table {fit.table + 1}" if several else fit.kind


def in_words(table: Table) -> str:
    """The content of a table."""
    kinds = [type(own.kind).__name__ for own in table.own]
    if table.model is None:
        return ", ".join(kinds)
    words = [table.model, *kinds]
    if table.uses_pairs and table.measurements.pairs is not None:
        words.append("measured pairs")
    elif table.uses_pairs and (table.measurements.position is not None or table.measurements.rotation is not None):
        words.append(f"pairs: {table.pairing}")
    elif table.unknown_frame:
        words.append("measurement frame unknown")
    return ", ".join(words)


def _pairing(problem: Problem) -> str | None:
    tables = [table for table in problem.data.tables if table.uses_pairs]
    if not tables or (tables[0].measurements.pairs is None and not problem.formed):
        return None
    return "measured" if tables[0].measurements.pairs is not None else str(tables[0].pairing)


def _noise_factors(solution: Solution, fits: tuple[KindFit, ...]) -> dict[str, Any]:
    """Factors of the estimated noise by key, and the keys of those that could not be estimated."""
    estimated = solution.estimated_noise
    if estimated is None:
        return {}
    factors = {key_of(fit, fits): fit.own_factor for fit in fits}
    kept = [key_of(fit, fits) for fit in fits if (fit.table, fit.kind) not in estimated]
    if np.any(solution.problem.data.sigma_joint > 0.0):
        factors["joint"] = solution.problem.state.factors.get(JOINT_NOISE, 1.0)
        kept += ["joint"] if JOINT_NOISE not in estimated else []
    return {"noise_factors": factors, "noise_kept": tuple(kept)}


def _residual_rms(table: ResidualTable) -> dict[str, dict[str, Rms | None]]:
    """RMS by split and kind, by table too where several tables have a kind."""
    rms: dict[str, dict[str, Any]] = table.rms()
    kinds = list(dict.fromkeys(("position", "orientation", "distance", "angle", *table.families)))
    for number, kind in table.groups:
        if sum(other == kind for _, other in table.groups) > 1:
            kinds.append(f"{kind}, table {number + 1}")
            for split, found in table.rms(number).items():
                rms[split] |= {kinds[-1]: found[kind]} if kind in found else {}
    units = {kind: table.unit(kind) for kind in table.families if kind not in KINDS}

    def of(split: str, kind: str) -> Rms | None:
        found = rms[split].get(kind)
        return None if found is None else Rms(**found, unit=units.get(kind.partition(", table")[0]))

    return {split: {kind: of(split, kind) for kind in kinds} for split in ("train", "test")}


def _carried(solution: Solution, job: Mapping[str, Any]) -> Carried:
    problem, known = solution.problem, knowledge_of(solution)
    noise: dict[str, dict[str, float]] = {}
    for (table, kind), factor in problem.state.factors.items():
        source = "" if table < 0 else problem.data.tables[table].measurements.source
        noise.setdefault(source.partition(", station ")[0], {})[kind] = factor
    knowledge = None if known is None else Knowledge.model_validate(known)
    return Carried(job=dict(job), rows=fingerprints(problem.data.tables), noise=noise, knowledge=knowledge)


@cache
def versions() -> dict[str, str]:
    """Versions of the package and the libraries that compute."""
    libraries = {"gtsam": metadata.version("gtsam"), "numpy": np.__version__, "scipy": scipy.__version__}
    return {"fg-calib": __version__, "python": platform.python_version(), **libraries}


@checked
def read_result(path: Path | str) -> Result:
    """The result in a folder that `calibrate --out` wrote, or in its `result.json`.

    Args:
        path: The folder, or the file.

    Raises:
        InputError: There is none, or it is damaged; the message says where.
    """
    path = Path(path)
    if not exists(path):
        raise InputError(str(path), "no such folder or file", "what `fg-calib calibrate --out` wrote")
    file = path / "result.json" if is_folder(path) else path
    if not exists(file):
        raise InputError(str(path), "no result.json in this folder", "a folder that `fg-calib calibrate --out` wrote")
    try:
        document = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise InputError(str(file), f"not JSON: {str(error).partition(';')[0]}", hint="was it cut off?") from None
    if not isinstance(document, dict) or not str(document.get("schema")).startswith("fg-calib/result/"):
        raise InputError(str(file), "no result of a calibration", f"a result.json of schema {SCHEMA}")
    if document["schema"] != SCHEMA:
        raise InputError(str(file), f"schema {document['schema']}", SCHEMA, "calibrate its job again")
    try:
        result = Result.model_validate(document)
    except ValidationError as error:
        raise first_misfit(error, str(file)) from None
    for key, found, expected in _contradictions(result):
        raise InputError(f"{file}: {key}", found, expected, "was the file changed?")
    return result


def _contradictions(result: Result) -> Iterator[tuple[str, str, str]]:
    """What in a result contradicts the rest: the key, what was found and what is expected."""
    names, of = result.covariance.names, {p.name: p for p in result.parameters}
    matrices = {"covariance": (result.covariance.matrix, len(names))}
    matrices["posterior: covariance"] = result.posterior.covariance, sum(map(len, result.posterior.variables.values()))
    for key, (matrix, n) in matrices.items():
        size = np.nanmin(np.abs(matrix.diagonal()), initial=1.0) if matrix.ndim == 2 else 0.0  # rounding is less
        with np.errstate(invalid="ignore"):
            if matrix.size != n * n or (n and matrix.shape != (n, n)):
                yield key, f"shape {matrix.shape}", f"{n} rows of {n}, one of each name"
            elif not np.allclose(matrix, matrix.T, 1e-6, 1e-9 * size, equal_nan=True) or (np.diag(matrix) < 0.0).any():
                yield key, "no covariance", "a symmetric matrix with variances from 0 on"
    if len(of) < len(result.parameters) or len(set(names)) < len(names) or not of.keys() >= set(names):
        yield "covariance: names", "a name twice or of no parameter", "different names of parameters"
    sigmas = dict(zip(names, np.sqrt(result.covariance.matrix.diagonal()).tolist() if names else (), strict=True))
    for i, p in enumerate(result.parameters, start=1):
        if p.sigma is not None and not (p.sigma >= 0.0 and np.isclose(p.sigma, sigmas.get(p.name, 0.0), 1e-9, 0.0)):
            yield f"parameter {i}: sigma", f"found {p.sigma:g}", f"{sigmas.get(p.name, 0.0):g}, as the covariance says"
        turns = (p.estimate - p.nominal - p.correction) / (2.0 * np.pi if p.unit == "rad" else np.inf)
        if not np.isclose(p.estimate - 2.0 * np.pi * np.round(turns), p.nominal + p.correction, 1e-9, 1e-12):
            yield f"parameter {i}: correction", f"found {p.correction:g}", f"{p.estimate - p.nominal:g}"
    if result.reduced_chi2 is not None and not np.isclose(result.reduced_chi2 * result.dof, result.chi2, 1e-9, 0.0):
        yield "reduced_chi2", f"found {result.reduced_chi2:g}", "chi2 / dof"
    if result.goodness and (n := sum(kind.n for kind in result.goodness.values())) != result.n_residuals:
        yield "n_residuals", f"found {result.n_residuals}", f"{n}, as goodness says"
    if result.trustworthy != (result.solver.converged and not result.findings):
        found = f"{str(result.trustworthy).lower()} with {len(result.findings)} findings"
        yield "trustworthy", found, "true where the solver converged and nothing was found"
    for frame in (*result.frames.values(), *filter(None, [result.frame_estimate])):
        good = [one.shape for one in (frame.xyz, frame.quaternion_xyzw, frame.sigma)] == [(3,), (4,), (6,)]
        good = good and np.isclose(np.linalg.norm(frame.quaternion_xyzw), 1.0, atol=NORM_TOLERANCE)
        if not good or (frame.sigma < 0.0).any():
            yield "frames", "no frame", "xyz, a quaternion of length 1, and six sigmas from 0 on"
