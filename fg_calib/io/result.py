"""The typed result of a calibration: `result.json` is its dump, and what reads back prints the same.

Its parts are what the analysis returns. All values are in [m] and [rad]; null is unknown or infinite.

The folder of a calibration: `result.json`, the calibrated robot and its tables, written whole and read back.

| table | a row |
|---|---|
| `configurations.csv` | a configuration: readings, where the calibrated tool is (from the base), RMS of its residuals |
| `residuals.csv`, or `.parquet` | a scalar residual before and after, in [m], [rad] or [px] |
| `joints.csv` | an estimated joint position of a configuration, in [rad] (prismatic: [m]) |
"""

import json
import math
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache, partial
from hashlib import file_digest, sha256
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
import scipy
from pydantic import AliasPath, BaseModel, BeforeValidator, ConfigDict, Field, PlainValidator, ValidationError
from pydantic.functional_serializers import PlainSerializer, WrapSerializer

from fg_calib import __version__, assessment, diagnostics, measurements, monitoring, prediction, statistics
from fg_calib.graph import JOINT_NOISE, SIZE, Problem, Solution, Variables
from fg_calib.inputs import Figure, Floats, FrameKnowledge, InputError, Model, Options, Probability, checked, expect, pl
from fg_calib.io.atomic import exists, fill_folder, is_folder, read_bytes, read_text, require_own, write_text
from fg_calib.io.robot_file import as_read, has_own_zeros, read_robot, require_same_chain, write_robot, write_urdf
from fg_calib.io.yaml import Units, first_misfit, shown
from fg_calib.observability import Identifiability
from fg_calib.robot import EFFECT_KINDS, SCALES, SPAN, Robot, model, pose
from fg_calib.selection import EffectTest

SCHEMA, FORMER_SCHEMA = "fg-calib/result/2", "fg-calib/result/1"
OBSERVABILITY_SCHEMA = "fg-calib/observability/1"

KINDS = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad", "point": "m", "pixel": "px"}
"""Unit of each usual kind of residual."""


def _flat(found: Identifiability, handler: Any) -> dict[str, Any]:
    """Identifiability as `observability.json` has it: the fields of its observability among its own."""
    document = handler(found)
    o = found.observability
    classes = {name: o.named(name) for name in ("independent", "ineffective")} | {"kept": o.kept}
    head = {"schema": OBSERVABILITY_SCHEMA, "n_parameters": len(o.names)}
    return {**head, **classes, **document.pop("observability"), **document}


Observability = Annotated[
    Identifiability,
    WrapSerializer(_flat),
    BeforeValidator(lambda value: {**value, "observability": value} if isinstance(value, dict) else value),
]
"""Identifiability by the data; flat in JSON."""


class Section(BaseModel, defer_build=True, populate_by_name=True):
    """A part of a document; it may be made of any object that has its fields as attributes."""

    model_config = ConfigDict(frozen=True, from_attributes=True, protected_namespaces=(), loc_by_alias=False)


def of(path: str, default: Any = ...) -> Any:
    """A field that is made of an attribute of what was computed, and is a key of its own in a document."""
    return Field(default, validation_alias=AliasPath(*path.split(".")))


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


class Statistics(Section):
    """Of the lengths of residuals: mean (ISO 9283: accuracy), standard deviation, 95 % quantile and maximum."""

    mean: float
    std: float
    p95: float
    max: float


class Covariance(Section):
    """Covariance of the errors of parameters, nan where they are not determined."""

    names: tuple[str, ...]
    matrix: Floats = of("covariance")


def _columns_by_variable(given: Any) -> Any:
    """The names of the columns of each variable, as a document has them."""
    return {v.symbol: given.names[v.columns] for v in given.items} if isinstance(given, Variables) else given


def _read_triangle(rows: Any) -> Floats:
    """The matrix of rows of text, of which each has a figure more than the one before, zeros behind them."""
    if isinstance(rows, np.ndarray):
        return rows
    try:
        figures = [np.array(row.split(), dtype=np.float64) for row in rows]
    except (TypeError, AttributeError) as error:  # pydantic reports ValueError alone
        raise ValueError(str(error)) from None
    out = np.zeros((len(figures), len(figures[-1]) if figures else 0))
    for k, row in enumerate(figures):
        n = out.shape[1] - len(figures) + k + 1
        if len(row) != n:
            raise ValueError(f"{len(row)} figures in row {k + 1} instead of {n}")
        out[k, :n] = row
    return out


def _triangle_as_text(values: Floats) -> list[str]:
    first = values.shape[1] - len(values) + 1
    return [" ".join(f"{x:.9g}" for x in row[: first + k].tolist()) for k, row in enumerate(values)]


Triangle = Annotated[Floats, PlainValidator(_read_triangle), PlainSerializer(_triangle_as_text)]
"""A matrix whose last columns are a lower triangle, which alone is written, a text of nine digits a figure a row."""


class Posterior(Section):
    """The covariance in the tangent space of the variables, and the undetermined directions, for predictions.

    Columns are those of the variables one after the other: the parameters of a vector; of a pose, the rotation about
    its own x, y, z axes, then the translation along them. For `curves` see `TangentCovariance`.
    """

    variables: Annotated[dict[str, tuple[str, ...]], BeforeValidator(_columns_by_variable)]
    covariance: Floats = of("tangent")
    undetermined: Floats
    undetermined_at_nominal: Floats
    curves: Triangle = Field(default_factory=lambda: np.zeros((0, 0)))


class Knowledge(Section):
    """The information of the rows, linearised at the estimate, for the next calibration.

    `rows` by `columns`: those of the arm as in `posterior`, then three of each of `unknowns`. `nominal` holds the same
    rows at the nominal arm, which parameters are classed by.
    """

    columns: tuple[str, ...] = of("variables.names", ())
    unknowns: tuple[tuple[str, str], ...] = ()
    at: Floats
    rows: Floats
    right: Floats
    views: tuple[tuple[Model, FrameKnowledge], ...] = ()
    parameters: Floats = of("robot.nominal")
    nominal: "Knowledge | None" = None


class Carried(Section):
    """Prior information for the next calibration of this arm.

    `job` is the job without its robot, by which tables like its own are read; `rows` are fingerprints of the fitted
    rows, so that none counts twice; `noise` the factors on specified sigmas by table and kind, where it was estimated.
    """

    job: dict[str, Any] = {}
    rows: tuple[str, ...] = ()
    noise: dict[str, dict[str, float]] = {}
    knowledge: Knowledge | None = None


class Run(Section):
    """One run of a history.

    Attributes:
        date: When its rows were measured, as ISO 8601 has it; empty if it is unknown.
        n_residuals: Number of fitted residuals.
        chi2: Chi-square of its rows and the information before.
        dof: Its degrees of freedom.
        p_value: Probability of a larger one.
        verdict: `good` or `doubtful`.
        parameters: Estimate, sigma and unit of each estimated parameter.
        inputs: SHA-256 of the files of its rows, by path.
        rows: Fingerprints of its rows.
    """

    date: str
    n_residuals: int
    chi2: Figure
    dof: int
    p_value: Probability | None = of("chi2_p_value")
    verdict: Literal["good", "doubtful"]
    parameters: dict[str, tuple[float, float | None, str]]
    inputs: dict[str, str] = {}
    rows: tuple[str, ...] = of("carried.rows", ())


class Result(Section):
    """All that `result.json` holds.

    `date` is when the rows were measured, or when they were calibrated if that is unknown. `history` are the runs
    before this one, `about` whose arm it is and who measured it, as the job says. `files` holds SHA-256 of the tables
    written with it, `links` the ends of a URDF's chain.
    """

    schema_: Literal["fg-calib/result/2"] = Field(alias="schema", default="fg-calib/result/2")
    version: str = __version__
    robot: str = of("problem.robot.name")
    model: str
    frame: str
    pairing: str | None
    pair_errors: str | None = None
    encoder: str = of("problem.options.encoder", "propagated")
    loss: str = of("problem.options.loss", "none")
    tables: tuple[tuple[str, str], ...] = ()
    n_configurations: int = of("problem.n_configurations")
    n_pairs: int = of("problem.n_pairs")
    n_residuals: int = of("problem.n_residuals")
    n_priors: int = of("problem.n_priors", 0)
    n_unknowns: int = 0
    n_determined: int = 0
    n_excluded: dict[str, int] = of("problem.n_excluded")
    solver: SolverRun = of("solution")
    trustworthy: Annotated[bool, Field(strict=True)] = of("assessed.trustworthy")
    findings: tuple[str, ...] = of("assessed.verdict.errors", ())
    cautions: tuple[str, ...] = of("assessed.verdict.cautions", ())
    reservations: tuple[str, ...] = of("assessed.verdict.warnings", ())
    notes: tuple[str, ...] = ()
    setup: diagnostics.SetupCheck | None = of("assessed.verdict.setup", None)
    probability_of_noise: Probability | None = of("assessed.verdict.noise_like", None)
    chi2: Figure = of("assessed.fit.chi_square.value")
    dof: int = of("assessed.fit.chi_square.dof")
    reduced_chi2: float | None = of("assessed.fit.chi_square.reduced")
    chi2_p_value: Probability | None = of("assessed.fit.chi_square.p_value", None)
    chi2_expected: Figure = of("assessed.fit.chi_square.expected", np.nan)
    chi2_bounds: tuple[Figure, Figure] = of("assessed.fit.chi_square.bounds", (np.nan, np.nan))
    goodness: dict[str, statistics.KindFit] = {}
    suspect_level: Figure = of("assessed.fit.goodness.level", np.nan)
    suspect_configurations: tuple[statistics.SuspectConfiguration, ...] = of("assessed.fit.goodness.configurations", ())
    evaluated_only: Annotated[bool, Field(strict=True)] = of("problem.evaluated", False)
    test: statistics.PredictedFit | None = of("assessed.fit.goodness.test", None)
    acceptance: statistics.Acceptance | None = of("assessed.acceptance", None)
    folds: statistics.CrossValidation | None = of("assessed.cross_validation", None)
    effects: tuple[EffectTest, ...] = ()
    priors: statistics.PriorFit | None = of("assessed.fit.priors", None)
    expected_error: prediction.ExpectedError | None = of("assessed.expected_error", None)
    sigma_joint: Floats = of("problem.sigma_joint", np.zeros(0))
    noise_factors: dict[str, float] | None = None
    noise_kept: tuple[str, ...] = ()
    tolerance_scales: Any = None  # of results that had them
    residual_rms: dict[str, dict[str, Rms | None]]
    residual_statistics: dict[str, dict[str, dict[str, Statistics] | None]] = Field(default_factory=dict)
    parameters: tuple[statistics.ParameterEstimate, ...] = of("assessed.estimates.parameters")
    covariance: Covariance = of("assessed")
    posterior: Posterior | None = of("assessed.whole")
    links: tuple[str, str] | None = None
    frame_estimate: statistics.FrameEstimate | None = of("assessed.estimates.frame")
    frames: dict[str, statistics.FrameEstimate] = {}
    joint_values: statistics.JointErrors | None = of("assessed.estimates.joint_errors", None)
    groups: tuple[statistics.LandmarkEstimate, ...] = of("assessed.estimates.landmarks", ())
    observability: Observability = of("assessed.identifiability")
    options: Options = of("problem.options")
    versions: dict[str, str] = {}
    files: dict[str, str] = {}
    inputs: dict[str, str]
    date: str = ""
    about: dict[str, str] = {}
    history: tuple[Run, ...] = ()
    carried: Carried = Carried()

    @classmethod
    def of(
        cls,
        solution: Solution,
        assessed: assessment.Assessment,
        *,
        inputs: Mapping[str, str] | None = None,
        job: Mapping[str, Any] | None = None,
        date: str | None = None,
        **more: Any,
    ) -> "Result":
        """The result of a solution and its assessment.

        Args:
            solution: The solution.
            assessed: Its assessment.
            inputs: SHA-256 of the files that it was read from, by path.
            job: The document of the job, to read tables like its own.
            date: When its rows were measured; now if None.
            more: Fields as they are: the runs before it (`history`), notes for a reader, a sentence each, and what was
                found of the arm's `effects`, where it was to be chosen among them.
        """
        problem = solution.problem
        data, urdf, frames = problem.data, problem.robot.urdf, problem.variables.frames
        goodness = assessed.fit.goodness
        computed = SimpleNamespace(
            problem=problem,
            solution=solution,
            assessed=assessed,
            model=" + ".join(dict.fromkeys(table.model or "own" for table in data.tables)),
            frame="unknown" if frames else data.tables[0].frame,
            pairing=_pairing(problem),
            pair_errors=problem.options.pair_errors if problem.pair_blocks else None,
            tables=tuple((label, in_words(table)) for label, table in zip(data.labels, data.tables, strict=True)),
            n_unknowns=len(problem.variables.all_scales),
            n_determined=assessed.spread.rank + solution.system.left.rank,
            goodness={key_of(kind, goodness.kinds): kind for kind in goodness.kinds},
            residual_rms=_residual_rms(assessed.fit.residuals),
            residual_statistics=_by_kind(assessed.fit.residuals, _statistics),
            frames={v.symbol: frame for v, frame in zip(frames, assessed.estimates.frames, strict=True)},
            links=None if urdf is None else (urdf.base_link, urdf.tip_link),
            versions=versions(),
            inputs=dict(inputs or {}),
            date=date or datetime.now(UTC).isoformat(timespec="seconds"),
            about={key: str(text) for key, text in ((job or {}).get("about") or {}).items() if text is not None},
            carried=_carried(solution, job or {}),
            **_noise_factors(solution, goodness.kinds) | more,
        )
        return cls.model_validate(computed)

    @property
    def free_of_frame(self) -> bool:
        """Whether nothing was measured in the base frame, so that errors count after the best rigid fit."""
        if self.expected_error is not None:
            return self.expected_error.relative
        return self.frame_estimate is not None or self.pairing is not None

    @property
    def estimated(self) -> tuple[statistics.ParameterEstimate, ...]:
        """The parameters that are not fixed."""
        return tuple(p for p in self.parameters if p.identifiability != "fixed")

    @property
    def run(self) -> Run:
        """This result as one run of a history."""
        known, verdict = set(self.covariance.names), "good" if self.trustworthy else "doubtful"
        parameters = {p.name: (p.estimate, p.sigma, p.unit) for p in self.parameters if p.name in known}
        return Run.model_validate(SimpleNamespace(**vars(self) | {"verdict": verdict, "parameters": parameters}))

    def unit_of(self, kind: str) -> str:
        """The unit of a kind of residual: `m`, `rad` or `px`."""
        units = [rms.unit for kinds in self.residual_rms.values() if (rms := kinds.get(kind)) and rms.unit]
        return units[0] if units else KINDS.get(kind.partition(",")[0], "m")

    def rms_after(self, split: str) -> dict[str, float]:
        """RMS of the residuals of `train` or `test` rows after the calibration, by kind."""
        kinds = self.residual_rms.get(split, {})
        return {kind: rms.after for kind, rms in kinds.items() if rms is not None and rms.after is not None}

    def document(self) -> dict[str, Any]:
        """The content of `result.json`."""
        return json.loads(self.model_dump_json(by_alias=True))


def key_of(fit: statistics.KindFit, fits: tuple[statistics.KindFit, ...]) -> str:
    """A kind of noise, with the number of its table where several tables have that kind."""
    return f"{fit.kind}, table {fit.table + 1}" if sum(other.kind == fit.kind for other in fits) > 1 else fit.kind


def in_words(table: measurements.Table) -> str:
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


def _noise_factors(solution: Solution, fits: tuple[statistics.KindFit, ...]) -> dict[str, Any]:
    """Factors of the estimated noise by key, and the keys of those that could not be estimated."""
    if (estimated := solution.estimated_noise) is None:
        return {}
    of_noise = solution.problem.state.factors
    factors = {key_of(fit, fits): of_noise.get((fit.table, fit.kind), 1.0) for fit in fits}
    kept = [key_of(fit, fits) for fit in fits if (fit.table, fit.kind) not in estimated]
    if np.any(solution.problem.data.sigma_joint > 0.0):
        factors["joint"] = of_noise.get(JOINT_NOISE, 1.0)
        kept += ["joint"] if JOINT_NOISE not in estimated else []
    return {"noise_factors": factors, "noise_kept": tuple(kept)}


def _residual_rms(table: statistics.ResidualTable) -> dict[str, dict[str, Rms | None]]:
    def of(key: str, found: dict[str, float] | None) -> Rms | None:
        kind = key.partition(", table ")[0]
        return None if found is None else Rms(**found, unit=None if kind in KINDS else table.unit(kind))

    each = _by_kind(table, statistics.root_mean_square)
    return {split: {key: of(key, found) for key, found in kinds.items()} for split, kinds in each.items()}


def _by_kind(table: statistics.ResidualTable, figure: Callable[[Floats], Any]) -> dict[str, dict[str, Any]]:
    """A figure of lengths by split and kind, by table too where several tables have a kind."""
    found: dict[str, dict[str, Any]] = {**table.by_kind(figure)}
    keys = [*("position", "orientation", "distance", "angle"), *table.families]
    for number, kind in table.groups:
        if [other for _, other in table.groups].count(kind) > 1:
            keys.append(f"{kind}, table {number + 1}")
            for split, of_table in table.by_kind(figure, number).items():
                found[split][keys[-1]] = of_table.get(kind)
    return {split: {key: found[split].get(key) for key in keys} for split in ("train", "test")}


def _statistics(lengths: Floats) -> Statistics:
    p95, most = np.quantile(lengths, [0.95, 1.0])
    return Statistics(mean=float(np.mean(lengths)), std=float(np.std(lengths)), p95=p95, max=most)


def _carried(solution: Solution, job: Mapping[str, Any]) -> Carried:
    problem, known = solution.problem, monitoring.knowledge_of(solution)
    noise: dict[str, dict[str, float]] = {}
    for (table, kind), factor in problem.state.factors.items():
        source = "" if table < 0 else problem.data.tables[table].measurements.source
        noise.setdefault(source.partition(", station ")[0], {})[kind] = factor
    knowledge = None if known is None else Knowledge.model_validate(known)
    return Carried(job=dict(job), rows=monitoring.fingerprints(problem.data.tables), noise=noise, knowledge=knowledge)


@cache
def versions() -> dict[str, str]:
    """Versions of the package and the libraries that compute."""
    libraries = {"gtsam": metadata.version("gtsam"), "numpy": np.__version__, "scipy": scipy.__version__}
    return {"fg-calib": __version__, "python": platform.python_version(), **libraries}


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number")


@checked
def read_result(path: Path | str) -> Result:
    """The result in a folder that `calibrate --out` wrote, or in its `result.json`.

    Args:
        path: The folder, or the file.

    Raises:
        InputError: There is none, or it is damaged; the message says where.
    """
    path = Path(path)
    file = path / "result.json" if is_folder(path) else path
    expect(exists(file), str(path), "no result.json", "what `fg-calib calibrate --out` wrote")
    try:
        document = json.loads(read_text(file), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(str(file), f"not JSON: {str(error).partition(';')[0]}", hint="was it cut off?") from None
    schema = document.get("schema") if isinstance(document, dict) else None
    expect(schema in (SCHEMA, FORMER_SCHEMA), str(file), f"schema {shown(schema)}", SCHEMA, "calibrate its job again")
    document = _upgraded(document) if schema == FORMER_SCHEMA else document
    try:
        result = Result.model_validate(document)
    except ValidationError as error:
        raise first_misfit(error, str(file)) from None
    for key, found, expected in _shapes(result):
        expect(found == expected, f"{file}: {key}", f"found {found}", str(expected), "was the file changed?")
    return result


def _upgraded(document: dict[str, Any]) -> dict[str, Any]:
    """A document of version 1: the posterior is the parameters' covariance, what version 2 added is unknown."""
    solver, found = document.get("solver"), document.get("observability")
    more = {key: document.get(key) for key in ("robot", "n_configurations")}
    return {
        "trustworthy": isinstance(solver, dict) and solver.get("converged"),
        "options": {},
        "posterior": None,
        **document,
        "schema": SCHEMA,
        "observability": more | found if isinstance(found, dict) else found,
    }


def _shapes(result: Result) -> Iterator[tuple[str, Any, Any]]:
    """Quantities that a result holds twice: the key, the shape or number there, and that by the rest of it."""
    names, sigmas = result.covariance.names, {p.name: p.sigma for p in result.parameters}
    matrices = [("covariance", result.covariance.matrix, len(names))]
    if (posterior := result.posterior) is not None:
        n, C = sum(map(len, posterior.variables.values())), posterior.curves
        matrices.append(("posterior: covariance", posterior.covariance, n))
        yield "posterior: curves: shape", C.shape if C.size else (0, 0), (len(C), n + len(C)) if C.size else (0, 0)
        yield "posterior: curves: values that are none", int(np.sum(~(np.abs(C) < MOST_VALUE))), 0
    for key, M, n in matrices:
        yield f"{key}: shape", M.shape if M.size else (0, 0), (n, n)
        yield f"{key}: negative variances", int(np.sum(np.diag(M) < 0.0)) if n else 0, 0
    yield "covariance: names", len(sigmas.keys() & names), len(names)
    sigma = np.array([sigmas[name] for name in names], dtype=np.float64)
    M = result.covariance.matrix.reshape(sigma.size, sigma.size)
    same = np.isclose(np.diag(M), sigma**2, 1e-6, 0.0, equal_nan=True)
    yield "covariance: variances that are not the squares of sigmas", int(np.sum(~same)), 0
    seen = result.observability.observability
    yield "observability: classes", len(seen.classes), len(seen.names)
    of_groups = {name for one in seen.relative for name in (*one.parameters, *one.keep)}
    yield "observability: unknown names", sorted(of_groups.union(seen.sigma, *seen.lost).difference(seen.names)), []
    yield "observability: directions lost", len(seen.lost), len(seen.names) - seen.rank
    if result.posterior is not None:  # version 1 did not list them
        yield "observability: lost", len(result.observability.lost), len(seen.lost)
    knowledge = result.carried.knowledge
    for one in () if knowledge is None else filter(None, (knowledge, knowledge.nominal)):
        arrays, n, m = (one.rows, one.right, one.at), SIZE * len(one.unknowns), one.right.size
        shapes = [M.shape if M.size else (0,) for M in arrays]
        yield "carried: knowledge: shapes", shapes, [(m, len(one.columns) + n) if m else (0,), (m,), (n,)]
        huge = sum(int(np.sum(~(np.abs(M) < MOST_VALUE))) for M in (*arrays, one.parameters))
        yield "carried: knowledge: values that are none", huge, 0
    for frame in (*result.frames.values(), *filter(None, [result.frame_estimate])):
        yield "frames: shape", [*frame.xyz.shape, *frame.quaternion_xyzw.shape, *frame.sigma.shape], [3, 4, 6]


MOST_VALUE = 1e100
"""Size beyond which a saved value is none: its square is no number."""

ResidualFile = Literal["csv", "parquet", "none"]
"""How single residuals are written, if at all."""

FIGURES = ("accuracy", "joints", "parameters", "correlations", "residuals", "workspace", "curves", "compliances")

RESULT_FILES = {
    "result.json": b'{\n "schema": "fg-calib/result/',
    "residuals.csv": b"kind,a,b,split,used,excluded,",
    "residuals.parquet": b"PAR1",
    "configurations.csv": b"id,split,q1,",
    "report.html": b"<!DOCTYPE html>",
    **dict.fromkeys((f"{name}.svg" for name in FIGURES), b"<svg"),
    "joints.csv": b"id,joint,unit,reading,estimate,",
    "robot_calibrated.yaml": b"",
    "robot_calibrated.urdf": b"",
}
"""The files that a calibration may write, and how each begins."""

RESOLUTION = 1e-8
"""How far the saved robot's values may be from the estimates in `result.json`, [m] and [rad]: ten nanometres."""


def residual_frame(solution: Solution, assessed: assessment.Assessment) -> "pl.DataFrame":
    """Every scalar residual, as `residuals.csv` has it."""
    table, fit = assessed.fit.residuals, assessed.fit.goodness
    ends, sources = solution.problem.end_names, solution.problem.data.labels
    measured = table.measured - table.excess  # so that predicted minus measured is 0 on average
    kinds, units = [kind.name for kind in table.kinds], [kind.unit for kind in table.kinds]
    columns: dict[str, Any] = {"kind": _coded(kinds, table.kind_code), "a": _coded(ends, table.a + 1)}
    columns |= {"b": _coded(ends, table.b + 1), "split": _coded(("train", "test"), table.split), "used": table.used}
    columns |= {"excluded": _coded(table.reasons, table.reason_code), "unit": _coded(units, table.kind_code)}
    columns |= {"measured": measured, "predicted": measured + table.after, "residual_before": table.before}
    columns |= {"residual": table.after, "sigma": table.sigma, "whitened": table.after / table.sigma}
    columns |= {"leverage": fit.leverage, "studentised": fit.studentised, "weight": fit.weight}
    columns |= {"flag": _coded(statistics.FLAGS, fit.flag), "noise_adds": table.excess, "suspect": fit.suspect}
    if len(sources) > 1:
        columns["table"] = _coded([sources[kind.table] for kind in table.kinds], table.kind_code)
    if len(table.labels) > 1:
        columns["of"] = _coded(table.labels, table.label_code)
        columns["row"] = pl.Series(table.table_row).replace(-1, None)
    return pl.DataFrame(columns)


def _coded(words: Sequence[str], codes: Any) -> "pl.Series":
    """A column of words by their codes, four bytes a row, empty words as null."""
    kept = pl.Enum(list(dict.fromkeys(filter(None, words))))
    return pl.Series([word or None for word in words], dtype=kept)[np.asarray(codes, dtype=np.uint32)]


def configuration_frame(solution: Solution, assessed: assessment.Assessment) -> "pl.DataFrame":
    """Every measured configuration, as `configurations.csv` has it."""
    data, robot = solution.problem.data, assessed.robot
    readings, n = data.readings, data.n_configurations
    held_out = data.held_out | solution.problem.evaluated
    rows, chi2, rms = assessed.fit.residuals.of_configurations(held_out)
    tool = np.concatenate([pose(robot, readings[k : k + SPAN]).position for k in range(0, max(n, 1), SPAN)])
    columns = {
        "id": pl.Series(data.names[:n], dtype=pl.String),
        "split": _coded(("train", "test"), held_out),
        **{f"q{i + 1}": readings[:, i] for i in range(robot.n_joints)},
        **{f"tool_{axis}": tool[:, i] for i, axis in enumerate("xyz")},
        "rows": rows,
        "chi2": chi2,
        **{f"rms_{family}": values for family, values in rms.items()},
    }
    return pl.DataFrame(columns)


def joint_frame(found: statistics.JointErrors, solution: Solution) -> "pl.DataFrame":
    """Every estimated joint position, as `joints.csv` has it."""
    n, k = found.error.shape
    joint, units = np.tile(np.arange(k), n), [solution.problem.robot.joints[j].unit for j in found.joints]
    configurations = _coded(solution.problem.end_names, np.repeat(found.configurations + 1, k))
    columns: dict[str, Any] = {"id": configurations, "joint": _coded(found.names, joint), "unit": _coded(units, joint)}
    columns |= {"reading": found.reading.ravel(), "estimate": (found.reading + found.error).ravel()}
    columns |= {"error": found.error.ravel(), "sigma": np.tile(found.sigma, n)}
    columns |= {"error_over_sigma": (found.error / found.sigma).ravel(), "studentised": found.studentised.ravel()}
    columns |= {"suspect": [place in found.suspects for place in np.ndindex(n, k)]}
    return pl.DataFrame(columns)


def write_calibration(
    folder: Path, result: Result, robot: Robot, tables: "Mapping[str, pl.DataFrame]", pages: dict[str, str]
) -> None:
    """Write the files of a calibration into a folder, all or none.

    Args:
        folder: Where to.
        result: The result.
        robot: The calibrated robot; base and tool of a robot from a URDF, which cannot hold them, go to a
            `robot_calibrated.yaml` next to `robot_calibrated.urdf`.
        tables: Tables by file name.
        pages: Text of other files by name.

    Raises:
        InputError: The folder cannot be written.
    """
    files: dict[str, Any] = {"robot_calibrated.yaml": partial(_write_robot, robot=robot)}
    files |= {name: t.write_parquet if name.endswith(".parquet") else t.write_csv for name, t in tables.items()}

    def write_result(path: Path) -> None:
        digests = {name: _digest(path.with_name(name)) for name in tables}
        document = result.model_copy(update={"files": digests}).document()
        write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")

    fill_folder(folder, files | pages | {"result.json": write_result}, RESULT_FILES)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def _write_robot(path: Path, robot: Robot) -> None:
    """The YAML of a robot; next to it its URDF, alone where that says all."""
    units = Units(*robot.units)
    if robot.urdf is not None:
        file, own = path.with_suffix(".urdf"), has_own_zeros(robot)
        write_urdf(file, robot)
        links = {"base_link": robot.urdf.base_link, "tip_link": robot.urdf.tip_link}
        require_same_chain(robot.geometry, read_robot(file, **links, estimate=[model.ZEROS] * own), str(file))
        ends = [p for p in robot.parameters if p.owner in (0, robot.n_joints + 1)]
        if not own and not robot.effects and not any(p.nominal != 0.0 or p.estimated for p in ends):
            return
    rounded = []
    for p, resolution in zip(robot.parameters, _resolutions(robot), strict=True):
        factor = 1.0 if p.kind in EFFECT_KINDS else units.factor(p.unit)  # effects are written in SI
        digits = math.ceil(math.log10(factor / resolution))
        rounded.append(round(p.nominal / factor, digits) * factor if p.estimated else p.nominal)
    name = None if robot.urdf is None else "robot_calibrated.urdf"
    write_robot(path, robot.with_values(rounded), units=units, urdf_name=name)


def _resolutions(robot: Robot) -> list[float]:
    """`RESOLUTION` of each parameter in its unit: by its ordinary change over those of m and rad."""
    return [RESOLUTION * SCALES[p.unit].ordinary / SCALES["m"].ordinary for p in robot.parameters]


def read_calibrated_robot(folder: Path, result: Result) -> Robot:
    """The calibrated robot in the folder of a result.

    Raises:
        InputError: There is none, or it is that of another result.
    """
    file = next(filter(exists, [folder / f"robot_calibrated.{ending}" for ending in ("yaml", "urdf")]), None)
    if file is None:
        raise InputError(str(folder), "neither robot_calibrated.yaml nor robot_calibrated.urdf next to its result.json")
    links = result.links or (None, None)
    robot = read_robot(file, base_link=links[0], tip_link=links[1])
    names, estimates = [p.name for p in result.parameters], [p.estimate for p in result.parameters]
    same = [p.name for p in robot.parameters] == names
    calibrated = robot.with_values(estimates) if same else robot
    if not same or not np.allclose(robot.nominal, as_read(calibrated).nominal, 0.0, _resolutions(robot)):
        found = "other values" if same else "other parameters"
        raise InputError(str(file), f"{found} than in result.json", "the files of one calibration")
    return calibrated


def read_table(folder: Path, name: str, result: Result) -> "pl.DataFrame | None":
    """A table of a calibration; None where there is no such file.

    Args:
        folder: Of the calibration.
        name: `configurations` or `residuals`.
        result: The result in the folder.

    Raises:
        InputError: The table is damaged, or that of another result.
    """
    file = next((folder / f"{name}.{e}" for e in ("csv", "parquet") if exists(folder / f"{name}.{e}")), None)
    if file is None:
        return None
    content = read_bytes(file)
    if sha256(content).hexdigest() != result.files.get(file.name):
        raise InputError(str(file), "changed, or of another calibration", "the files of one calibration")
    words = dict.fromkeys(("id", "kind", "a", "b", "split", "excluded", "unit", "flag", "table", "of"), pl.String)
    return pl.read_parquet(content) if file.suffix == ".parquet" else pl.read_csv(content, schema_overrides=words)


def require_no_input(folder: Path, path: Path | None, inputs: Mapping[str, str]) -> None:
    """Check that results would replace neither the files of their job nor files that are of no result.

    Args:
        folder: Where to.
        path: The job's file, if there is one.
        inputs: Files that it was read from, by path relative to the job.

    Raises:
        InputError: A file would be replaced.
    """
    files = set() if path is None else {(path.parent / name).resolve() for name in inputs}
    for name in RESULT_FILES:
        if (folder / name).resolve() in files:
            raise InputError(str(folder / name), "the job was read from it", "another folder for the results")
    require_own(folder, RESULT_FILES)
