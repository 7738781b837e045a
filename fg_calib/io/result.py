"""`result.json` as a typed model: what `calibrate --out` writes, and reads back.

All in [m] and [rad]; what is unknown or infinite is None. `result.schema.json` beside this file is its JSON schema.
Version 1 lacks the posterior and reads as well; keys that are not known are left alone.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from fg_calib.arguments import checked
from fg_calib.arrays import NORM_TOLERANCE, brief
from fg_calib.errors import InputError
from fg_calib.io.atomic import exists, is_folder, read_text
from fg_calib.io.yaml import first_misfit
from fg_calib.options import FrameKnowledge, Model

MOST_WHOLE = 10**15
"""The most of anything that a result counts: far more than is ever counted, and exact as a float."""

Whole = Annotated[int, Field(ge=0, le=MOST_WHOLE)]
"""A count."""

IN_PARTS = "gauss-newton in parts"
"""Name of the solver of a table in parts."""

SCHEMA: Literal["fg-calib/result/2"] = "fg-calib/result/2"


def _known(value: object) -> object:
    """A plain number; None for one that is not finite."""
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def _listed(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _of_errors(matrix: tuple[tuple[float | None, ...], ...]) -> tuple[tuple[float | None, ...], ...]:
    """The matrix, which must be one that errors can have; for what is None anything would do."""
    expected = PydanticCustomError("covariance", "a symmetric matrix of variances and covariances of errors")
    if any(len(row) != len(matrix) for row in matrix):
        raise expected
    C = np.array(matrix, float).reshape(len(matrix), len(matrix))
    variance = C.diagonal()
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(variance)
        most = np.outer(sigma, sigma)
        if (variance < 0.0).any() or (np.abs(C - C.T) > ROUNDING * most).any():
            raise expected
        if (np.abs(C) > (1.0 + ROUNDING) * most).any():
            raise expected
    return matrix


def _unit(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    if abs(math.hypot(*quaternion) - 1.0) > NORM_TOLERANCE:
        raise PydanticCustomError("quaternion", "x y z w of length 1")
    return quaternion


ROUNDING = 1e-6
"""How far a covariance may be from symmetric, in products of sigmas: a matrix summed in another order is not."""

NEAR_NOTHING = 1e-9
"""How far a correction may be from estimate less nominal, [m] and [rad]: rounding, and no error of a robot."""

MOST_FIGURE = 1e150
"""The most that a figure of a result may be: its square is a number too, and no residuals are as large."""

Bounded = Annotated[float, Field(ge=-MOST_FIGURE, le=MOST_FIGURE)]

Figure = Annotated[Bounded | None, BeforeValidator(_known)]
"""A number, None where it is unknown or infinite."""

Sigma = Annotated[Annotated[float, Field(ge=0, le=MOST_FIGURE)] | None, BeforeValidator(_known)]
"""A standard deviation, None where it is unknown or infinite."""

Row = Annotated[tuple[Figure, ...], BeforeValidator(_listed)]
Matrix = Annotated[tuple[Row, ...], BeforeValidator(_listed)]
CovarianceMatrix = Annotated[Matrix, AfterValidator(_of_errors)]
Sigmas = Annotated[tuple[Sigma, ...], BeforeValidator(_listed)]
Position = Annotated[tuple[Bounded, Bounded, Bounded], BeforeValidator(_listed)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(_listed), AfterValidator(_unit)]


Choice = str | bool | int | float | tuple[str, ...] | dict[str, float] | None
"""What an option may be."""


class Section(BaseModel):
    """A part of a result; it may be made of any object that has its fields as attributes."""

    model_config = ConfigDict(
        frozen=True,
        from_attributes=True,
        populate_by_name=True,
        protected_namespaces=(),
        allow_inf_nan=False,
        defer_build=True,  # of the sections that a result has, not of all at import
    )

    def __repr__(self) -> str:
        return brief(self, (name for name in type(self).model_fields if name in self.model_fields_set))

    def __str__(self) -> str:
        return repr(self)

    @classmethod
    def make(cls, **values: Any) -> Self:
        """The section with these values: arrays, and numbers that are not finite, become what JSON knows."""
        return cls.model_validate(values)

    def document(self) -> dict[str, Any]:
        """What is written: the keys that were set, as JSON knows them."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


class Step(Section):
    """One step of the solver."""

    cost: Figure
    damping: Figure = Field(alias="lambda")
    step: Figure
    decrement: Figure = None


class Solver(Section):
    """What the solver did."""

    name: str
    converged: bool
    message: str
    iterations: Whole
    initial_cost: Figure
    cost: Figure
    seconds: Figure
    history: tuple[Step, ...] = ()


class KindGoodness(Section):
    """Noise stated and noise seen of one kind of residuals."""

    n: Whole
    stated_sigma_rms: Figure
    seen_over_stated: Figure
    chi2: Figure
    expected: Figure
    p_value: Figure
    verdict: str


class SuspectConfiguration(Section):
    """A configuration whose residuals are together larger than noise."""

    id: str
    n: Whole
    chi2: Figure
    expected: Figure


class TestRows(Section):
    """How well the test rows are predicted."""

    __test__ = False  # no test of pytest's

    n_rows: Whole
    n: Whole
    n_outliers: Whole
    n_unknown: Whole
    chi2: Figure
    expected: Figure
    p_value: Figure
    goodness: dict[str, KindGoodness]
    n_suspect_rows: Whole
    suspect_configurations: tuple[SuspectConfiguration, ...]


class BeyondTolerance(Section):
    """A correction far beyond its tolerance."""

    parameter: str
    correction_over_tolerance: Figure
    sigma: Figure


class Priors(Section):
    """Corrections against tolerances."""

    n: Whole
    chi2: Figure
    expected: Figure
    p_value: Figure
    beyond_tolerance: tuple[BeyondTolerance, ...]


class Judgement(Section):
    """A limit that the user set, and what the rows held out say of it."""

    kind: Literal["position", "orientation", "distance", "angle"]
    limit: Annotated[float, Field(gt=0)]
    error: Figure
    noise: Figure
    n: Whole
    verdict: Literal["pass", "fail", "not evaluated"]
    reason: str = ""
    table: str = ""


class Acceptance(Section):
    """What became of all limits that the user set."""

    verdict: Literal["pass", "fail", "not evaluated"]
    judgements: tuple[Judgement, ...]


class HeldOut(Section):
    """Residuals of one kind that cross-validation held out: RMS with the nominal arm, the calibrated one, and noise."""

    n: Whole
    before: Figure
    after: Figure
    noise: Figure


class Folds(Section):
    """Cross-validation; `spread` is the jackknife of each parameter (see `analysis.folds`)."""

    n: Whole
    n_held_out: Whole
    n_not_converged: Whole
    of_pairs: bool = False
    kinds: dict[str, HeldOut]
    spread: dict[str, Figure]


class InFrames(Section):
    """An error in the base frame, and after the best rigid fit."""

    base: Figure
    fitted: Figure


class ExpectedError(Section):
    """Expected RMS errors of the tool; `relative`: nothing says where the base is, so only `fitted` tells of them."""

    position: InFrames
    orientation: InFrames
    at: str
    n: Whole
    of: Whole
    relative: bool | None = None


class Typical(Section):
    """A typical residual before the calibration beside the one predicted."""

    typical: Figure
    predicted: Figure


class Explanation(Section):
    """Mistakes that explain the residuals before the calibration."""

    mistakes: tuple[str, ...]
    residuals: dict[str, Typical]


class Setup(Section):
    """What residuals before the calibration say of its set-up; `table` names the one of several that they are of.

    `others` has the same of other tables that have something to say.
    """

    table: str = ""
    residuals: dict[str, Typical]
    explanations: tuple[Explanation, ...]
    others: tuple[Setup, ...] = ()


class Parameter(Section):
    """One parameter of the robot after calibration; see `analysis.uncertainty.ParameterEstimate`."""

    name: str
    unit: Literal["m", "rad"]
    nominal: Bounded
    estimate: Bounded
    correction: Bounded
    sigma: Sigma
    prior_sigma: Sigma
    identifiability: Literal["independent", "relative", "ineffective", "fixed"]
    stands_for: dict[str, float] | None = None
    sigma_of_combination: Sigma = None


class ToleranceScale(Section):
    """A factor on tolerances that was estimated, with its 95 % interval; see `graph.tolerances.ToleranceScale`."""

    group: str
    parameters: Annotated[tuple[str, ...], Field(min_length=1)]
    scale: Annotated[float, Field(gt=0.0, le=MOST_FIGURE)]
    low: Annotated[float, Field(gt=0.0, le=MOST_FIGURE)]
    high: Annotated[float, Field(gt=0.0, le=MOST_FIGURE)]
    seen: Bounded


class Covariance(Section):
    """Covariance of the errors of parameters."""

    names: tuple[str, ...]
    matrix: CovarianceMatrix


class Posterior(Section):
    """The covariance in the tangent space of the variables, and what nothing determines: all that predictions need.

    Columns are those of the variables one after the other: the parameters that a vector has; of a pose, the turn about
    its own x, y, z axes, then the shift along them.
    """

    variables: dict[str, tuple[str, ...]]
    covariance: CovarianceMatrix
    undetermined: Matrix
    undetermined_at_nominal: Matrix


class Frame(Section):
    """The measurement frame world_T_base."""

    xyz: Position
    quaternion_xyzw: Quaternion
    sigma: Sigmas


class JointScatter(Section):
    """How one joint's estimated values lie about its readings."""

    name: str
    sigma: Sigma
    mean: Figure
    scatter: Figure


class SuspectReading(Section):
    """A reading that is far from its estimate."""

    id: str
    joint: str
    error: Figure
    studentised: Figure


class JointValues(Section):
    """Estimated joint values about their readings."""

    n: Whole
    joints: tuple[JointScatter, ...]
    suspects: tuple[SuspectReading, ...]


class TouchedPoint(Section):
    """A point that a group of configurations touched, or another unknown, of any number of coordinates."""

    name: str
    n: Whole
    xyz: Annotated[tuple[float, ...], BeforeValidator(_listed)]
    sigma: Sigmas
    kind: str = "point"
    units: tuple[str, ...] = ("m", "m", "m")


class Rms(Section):
    """Root mean square of residuals before and after; of a kind of one's own with its unit."""

    before: Figure
    after: Figure
    unit: Literal["m", "rad", "px"] | None = None


class Relative(Section):
    """Parameters that are determined only together."""

    parameters: tuple[str, ...]
    lost: Whole
    relations: tuple[dict[str, float], ...]
    keep: tuple[str, ...]


class Lost(Section):
    """A direction that is not determined, and why."""

    relation: Annotated[dict[str, float], Field(min_length=1)]
    reason: str


class Missing(Section):
    """A motion that the convention has no parameter for."""

    axes: tuple[int, ...]
    motions: tuple[str, ...]
    convention: str
    use: str | None
    message: str


class Correlated(Section):
    """Two parameters that are strongly correlated."""

    parameters: tuple[str, str]
    correlation: Figure


class Weak(Section):
    """A direction that is determined badly."""

    signal_to_noise: Figure
    members: Annotated[dict[str, float], Field(min_length=1)]


class Observability(Section):
    """What `observability.json` holds; sigmas, correlations and weak directions only where the noise is the user's."""

    schema_: str = Field(alias="schema")
    robot: str = ""
    model: str
    kind: str
    n_configurations: Whole = 0
    n_parameters: Whole
    rank: Whole
    names: tuple[str, ...]
    singular_values: Row
    gap: Figure
    independent: tuple[str, ...]
    ineffective: tuple[str, ...]
    relative: tuple[Relative, ...]
    kept: tuple[str, ...] = ()
    lost: tuple[Lost, ...] = ()
    missing: tuple[Missing, ...] = ()
    null_space: Matrix
    indices: dict[str, Figure]
    condition_number: Figure
    sigma: dict[str, Figure] = {}
    correlations: tuple[Correlated, ...] = ()
    weak: tuple[Weak, ...] = ()
    fixed: tuple[str, ...] = ()
    with_fixed_known: Observability | None = None


class AtNominal(Section):
    """What rows say of the arm as drawn: its parameters, base and tool as fitted, and the places of what stays."""

    parameters: Annotated[tuple[float, ...], BeforeValidator(_listed)]
    at: Annotated[tuple[float, ...], BeforeValidator(_listed)] = ()
    rows: Annotated[tuple[Annotated[tuple[float, ...], BeforeValidator(_listed)], ...], BeforeValidator(_listed)]


class Knowledge(Section):
    """What rows say of the arm and of what stays with it, linearised at the estimate (see `graph.knowledge`).

    `rows` by the columns of `columns`, those of the arm as in `posterior`, then three of each of `unknowns`.
    `nominal` are the same rows at the arm as drawn, by which parameters are classed.
    """

    columns: tuple[str, ...]
    unknowns: tuple[tuple[str, str], ...] = ()
    at: Annotated[tuple[float, ...], BeforeValidator(_listed)] = ()
    rows: Annotated[tuple[Annotated[tuple[float, ...], BeforeValidator(_listed)], ...], BeforeValidator(_listed)]
    right: Annotated[tuple[float, ...], BeforeValidator(_listed)]
    views: tuple[tuple[Model, FrameKnowledge], ...] = ()
    nominal: AtNominal | None = None


class Carried(Section):
    """What the next calibration of this arm takes over.

    `job` is the job without robot, by which tables like its own are read; `rows` are fingerprints of the fitted rows,
    which are not to be counted twice; `noise` the factors on stated sigmas by table
    and kind, where noise was estimated.
    """

    job: dict[str, Any] = {}
    rows: tuple[str, ...] = ()
    noise: dict[str, dict[str, float]] = {}
    knowledge: Knowledge | None = None


def _dated(date: str) -> str:
    """Refuse what is no date; the empty one is unknown."""
    if date:
        datetime.fromisoformat(date)
    return date


Date = Annotated[str, AfterValidator(_dated)]
"""A date as ISO 8601 has it."""


class Previous(Section):
    """The result that an update came from."""

    sha256: str
    date: Date


class Result(Section):
    """What `result.json` holds; `links` are those of a URDF between which its chain runs, `files` SHA-256 of tables.

    `date` is when the rows were measured, so far as is known; when they were calibrated where nobody said.
    """

    schema_: Literal["fg-calib/result/1", "fg-calib/result/2"] = Field(alias="schema")
    version: str
    robot: str
    model: str
    frame: str
    pairing: str | None
    pair_errors: str | None = None
    encoder: str = "propagated"
    loss: str = "none"
    n_configurations: Whole
    n_pairs: Whole
    n_residuals: Whole
    n_priors: Whole = 0
    n_excluded: dict[str, Whole]
    solver: Solver
    trustworthy: bool | None = None
    findings: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    reservations: tuple[str, ...] = ()
    setup: Setup | None = None
    probability_of_noise: Figure = None
    chi2: Figure
    dof: Annotated[int, Field(ge=-MOST_WHOLE, le=MOST_WHOLE)]
    reduced_chi2: Figure
    chi2_p_value: Figure = None
    goodness: dict[str, KindGoodness] = {}
    evaluated_only: bool = False
    test: TestRows | None = None
    acceptance: Acceptance | None = None
    folds: Folds | None = None
    priors: Priors | None = None
    expected_error: ExpectedError | None = None
    noise_factors: dict[str, float] | None = None
    noise_kept: tuple[str, ...] = ()
    tolerance_scales: tuple[ToleranceScale, ...] | None = None
    suspect_configurations: tuple[SuspectConfiguration, ...] = ()
    residual_rms: dict[str, dict[str, Rms | None]]
    parameters: tuple[Parameter, ...]
    covariance: Covariance
    posterior: Posterior | None = None
    links: tuple[str, str] | None = None
    frame_estimate: Frame | None
    frames: dict[Annotated[str, Field(pattern=r"^X\(\d{1,4}\)$")], Frame] = {}
    joint_values: JointValues | None = None
    groups: tuple[TouchedPoint, ...] = ()
    observability: Observability
    options: dict[str, Choice] = {}
    versions: dict[str, str] = {}
    files: dict[str, str] = {}
    inputs: dict[str, str]
    date: Date = ""
    previous: Previous | None = None
    carried: Carried | None = None

    @property
    def in_parts(self) -> bool:
        """Whether it is of a table in parts, of which no single row was judged."""
        return self.solver.name == IN_PARTS

    @property
    def free_of_frame(self) -> bool:
        """Whether nothing was measured in the base frame, so that errors count after the best rigid fit."""
        expected = self.expected_error
        if expected is not None and expected.relative is not None:
            return expected.relative
        return self.frame_estimate is not None or self.pairing is not None


def result_schema() -> dict[str, Any]:
    """The JSON schema of `result.json`."""
    return Result.model_json_schema(by_alias=True)


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
    if is_folder(path) and not exists(file):
        raise InputError(str(path), "no result.json in this folder", "a folder that `fg-calib calibrate --out` wrote")
    try:
        document = json.loads(read_text(file), object_pairs_hook=lambda pairs: _unrepeated(pairs, str(file)))
    except RecursionError:
        raise InputError(str(file), "nested too deeply", "a result.json") from None
    except ValueError as error:
        raise InputError(str(file), f"not JSON: {str(error).partition(';')[0]}", hint="was it cut off?") from None
    if not isinstance(document, dict) or not str(document.get("schema")).startswith("fg-calib/result/"):
        raise InputError(str(file), "no result of a calibration", f"a result.json of schema {SCHEMA}")
    try:
        result = Result.model_validate(document)
    except ValidationError as error:
        raise first_misfit(error, str(file)) from None
    for key, found, expected in contradictions(result):
        raise InputError(f"{file}: {key}", found, expected, "was the file changed?")
    return result


def _unrepeated(pairs: list[tuple[str, Any]], place: str) -> dict[str, Any]:
    """A mapping of JSON, where Python would silently take the last of two values of one key."""
    found = dict(pairs)
    if len(found) < len(pairs):
        (key, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise InputError(f"{place}: {key}", "the key is there twice", "once")
    return found


def contradictions(result: Result) -> Iterator[tuple[str, str, str]]:
    """What in a result contradicts the rest by definition: the key, what was found and what was expected."""
    yield from _of_names(result)
    yield from _of_parameters(result)
    if result.reduced_chi2 is not None and result.chi2 is not None:
        expected = result.chi2 / result.dof if result.dof > 0 else math.inf
        if not math.isclose(result.reduced_chi2, expected, rel_tol=ROUNDING):
            yield "reduced_chi2", f"found {result.reduced_chi2:.6g}", f"{expected:.6g}, as chi2 and dof say"
    n_rows = sum(kind.n for kind in result.goodness.values())
    if result.goodness and n_rows != result.n_residuals:
        yield "n_residuals", f"found {result.n_residuals}", f"{n_rows}, as goodness says"
    if result.trustworthy and not result.solver.converged:
        yield "trustworthy", "true of a solver that has not converged", "false"
    if result.trustworthy is not None and result.trustworthy == bool(result.findings):
        found = f"{str(result.trustworthy).lower()} with {len(result.findings)} findings"
        yield "trustworthy", found, "true without findings, else false"
    sized = {f"frames: {symbol}": (frame.sigma, 6) for symbol, frame in result.frames.items()}
    sized |= {"frame_estimate": (result.frame_estimate.sigma, 6)} if result.frame_estimate else {}
    sized |= {f"group {i}": (group.sigma, len(group.xyz)) for i, group in enumerate(result.groups, start=1)}
    for key, (sigma, n) in sized.items():
        if len(sigma) != n:
            yield f"{key}: sigma", f"{len(sigma)} figures", str(n)


def _of_names(result: Result) -> Iterator[tuple[str, str, str]]:
    names, known = result.covariance.names, [p.name for p in result.parameters]
    if len(result.covariance.matrix) != len(names):
        yield "covariance", "another size than its names", f"{len(names)} rows of {len(names)}"
    for key, given in (("parameters", known), ("covariance: names", list(names))):
        if len(set(given)) < len(given):
            yield key, f"{max(given, key=given.count)!r} twice", "different names"
    for name in set(names).difference(known):
        yield "covariance: names", f"{name!r}, which is no parameter", "names of parameters"
    for i, one in enumerate(result.tolerance_scales or (), start=1):
        for name in set(one.parameters).difference(known):
            yield f"tolerance_scale {i}: parameters", f"{name!r}, which is no parameter", "names of parameters"


def _of_parameters(result: Result) -> Iterator[tuple[str, str, str]]:
    names, matrix = result.covariance.names, result.covariance.matrix
    variances = {name: row[i] for i, (name, row) in enumerate(zip(names, matrix, strict=True))}
    for i, p in enumerate(result.parameters, start=1):
        variance = variances.get(p.name, 0.0)
        sigma = None if variance is None else math.sqrt(variance)
        if (p.sigma is None) != (sigma is None) or not math.isclose(p.sigma or 0.0, sigma or 0.0, rel_tol=ROUNDING):
            yield f"parameter {i}: sigma", f"found {p.sigma} of {p.name}", f"{sigma}, as the covariance says"
        off = p.estimate - p.nominal - p.correction
        off -= 2.0 * math.pi * round(off / (2.0 * math.pi)) if p.unit == "rad" else 0.0
        if abs(off) > NEAR_NOTHING:
            expected = f"{p.estimate - p.nominal:.6g}, estimate less nominal"
            yield f"parameter {i}: correction", f"found {p.correction:.6g} of {p.name}", expected
