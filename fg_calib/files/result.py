"""`result.json` as a typed model: what `calibrate --out` writes, and reads back.

All in [m] and [rad]; what is unknown or infinite is None. `result.schema.json` beside this file is its JSON schema.
Version 1 lacks the posterior and reads as well; keys that are not known are left alone.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from fg_calib.arrays import NORM_TOLERANCE
from fg_calib.errors import InputError
from fg_calib.files.disk import finish, read_text
from fg_calib.files.schema import first_misfit

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

Figure = Annotated[float | None, BeforeValidator(_known)]
"""A number, None where it is unknown or infinite."""

Sigma = Annotated[Annotated[float, Field(ge=0)] | None, BeforeValidator(_known)]
"""A standard deviation, None where it is unknown or infinite."""

Row = Annotated[tuple[Figure, ...], BeforeValidator(_listed)]
Matrix = Annotated[tuple[Row, ...], BeforeValidator(_listed)]
CovarianceMatrix = Annotated[Matrix, AfterValidator(_of_errors)]
Sigmas = Annotated[tuple[Sigma, ...], BeforeValidator(_listed)]
Position = Annotated[tuple[float, float, float], BeforeValidator(_listed)]
Quaternion = Annotated[tuple[float, float, float, float], BeforeValidator(_listed), AfterValidator(_unit)]


class Section(BaseModel):
    """A part of a result; it may be made of any object that has its fields as attributes."""

    model_config = ConfigDict(
        frozen=True, from_attributes=True, populate_by_name=True, protected_namespaces=(), allow_inf_nan=False
    )

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
    iterations: int
    initial_cost: Figure
    cost: Figure
    seconds: Figure
    history: tuple[Step, ...] = ()


class KindGoodness(Section):
    """Noise stated and noise seen of one kind of residuals."""

    n: int
    stated_sigma_rms: Figure
    seen_over_stated: Figure
    chi2: Figure
    expected: Figure
    p_value: Figure
    verdict: str


class SuspectConfiguration(Section):
    """A configuration whose residuals are together larger than noise."""

    id: str
    n: int
    chi2: Figure
    expected: Figure


class TestRows(Section):
    """How well the test rows are predicted."""

    __test__ = False  # no test of pytest's

    n_rows: int
    n: int
    n_outliers: int
    n_unknown: int
    chi2: Figure
    expected: Figure
    p_value: Figure
    goodness: dict[str, KindGoodness]
    n_suspect_rows: int
    suspect_configurations: tuple[SuspectConfiguration, ...]


class BeyondTolerance(Section):
    """A correction far beyond its tolerance."""

    parameter: str
    correction_over_tolerance: Figure
    sigma: Figure


class Priors(Section):
    """Corrections against tolerances."""

    n: int
    chi2: Figure
    expected: Figure
    p_value: Figure
    beyond_tolerance: tuple[BeyondTolerance, ...]


class InFrames(Section):
    """An error in the base frame, and after the best rigid fit."""

    base: Figure
    fitted: Figure


class ExpectedError(Section):
    """Expected RMS errors of the tool."""

    position: InFrames
    orientation: InFrames
    at: str
    n: int
    of: int


class Typical(Section):
    """A typical residual before the calibration beside the one predicted."""

    typical: Figure
    predicted: Figure


class Explanation(Section):
    """Mistakes that explain the residuals before the calibration."""

    mistakes: tuple[str, ...]
    residuals: dict[str, Typical]


class Setup(Section):
    """What residuals before the calibration say of its set-up; `table` names the one of several that they are of."""

    table: str = ""
    residuals: dict[str, Typical]
    explanations: tuple[Explanation, ...]


class Parameter(Section):
    """One parameter of the robot after calibration; see `analysis.uncertainty.ParameterEstimate`."""

    name: str
    unit: Literal["m", "rad"]
    nominal: float
    estimate: float
    correction: float
    sigma: Sigma
    prior_sigma: Sigma
    identifiability: str
    stands_for: dict[str, float] | None = None
    sigma_of_combination: Sigma = None


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

    n: int
    joints: tuple[JointScatter, ...]
    suspects: tuple[SuspectReading, ...]


class TouchedPoint(Section):
    """A point that a group of configurations touched, or another unknown, of any number of coordinates."""

    name: str
    n: int
    xyz: Annotated[tuple[float, ...], BeforeValidator(_listed)]
    sigma: Sigmas


class Rms(Section):
    """Root mean square of residuals before and after."""

    before: Figure
    after: Figure


class Relative(Section):
    """Parameters that are determined only together."""

    parameters: tuple[str, ...]
    lost: int
    relations: tuple[dict[str, float], ...]
    keep: tuple[str, ...]


class Lost(Section):
    """A direction that is not determined, and why."""

    relation: dict[str, float]
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
    members: dict[str, float]


class Observability(Section):
    """What `observability.json` holds; sigmas, correlations and weak directions only where the noise is the user's."""

    schema_: str = Field(alias="schema")
    robot: str = ""
    model: str
    kind: str
    n_configurations: int = 0
    n_parameters: int
    rank: int
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


class Result(Section):
    """What `result.json` holds; `links` are those of a URDF between which its chain runs."""

    schema_: Literal["fg-calib/result/1", "fg-calib/result/2"] = Field(alias="schema")
    version: str
    robot: str
    model: str
    frame: str
    pairing: str | None
    pair_errors: str | None = None
    encoder: str = "propagated"
    loss: str = "none"
    n_configurations: int
    n_pairs: int
    n_residuals: int
    n_priors: int = 0
    n_excluded: dict[str, int]
    solver: Solver
    trustworthy: bool | None = None
    findings: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    setup: Setup | None = None
    probability_of_noise: Figure = None
    chi2: Figure
    dof: int
    reduced_chi2: Figure
    chi2_p_value: Figure = None
    goodness: dict[str, KindGoodness] = {}
    evaluated_only: bool = False
    test: TestRows | None = None
    priors: Priors | None = None
    expected_error: ExpectedError | None = None
    noise_factors: dict[str, float] | None = None
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
    inputs: dict[str, str]


def result_schema() -> dict[str, Any]:
    """The JSON schema of `result.json`."""
    return Result.model_json_schema(by_alias=True)


def read_result(path: Path | str) -> Result:
    """The result in a folder that `calibrate --out` wrote, or in its `result.json`.

    Args:
        path: The folder, or the file.

    Raises:
        InputError: There is none, or it is damaged; the message says where.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(str(path), "no such folder or file", "what `fg-calib calibrate --out` wrote")
    finish(path if path.is_dir() else path.parent)
    file = path / "result.json" if path.is_dir() else path
    if path.is_dir() and not file.exists():
        raise InputError(str(path), "no result.json in this folder", "a folder that `fg-calib calibrate --out` wrote")
    try:
        document = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise InputError(str(file), f"not JSON: {error}", hint="was it cut off?") from None
    if not isinstance(document, dict) or not str(document.get("schema")).startswith("fg-calib/result/"):
        raise InputError(str(file), "no result of a calibration", f"a result.json of schema {SCHEMA}")
    try:
        result = Result.model_validate(document)
    except ValidationError as error:
        raise first_misfit(error, str(file)) from None
    n = len(result.covariance.names)
    if len(result.covariance.matrix) != n or any(len(row) != n for row in result.covariance.matrix):
        raise InputError(f"{file}: covariance", "another size than its names", f"{n} rows of {n}")
    return result
