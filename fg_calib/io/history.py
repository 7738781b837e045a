"""`history.json`: the runs that a calibration came from, each in a few figures that need no files of that time."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.io.atomic import exists, is_folder, read_bytes, read_text
from fg_calib.io.result import Date, Figure, Result, Section, Sigma, Whole, read_result
from fg_calib.io.yaml import first_misfit

HISTORY = "history.json"

SCHEMA: Literal["fg-calib/history/1"] = "fg-calib/history/1"

Verdict = Literal["good", "doubtful", "not judged"]


class Known(Section):
    """A parameter at the end of a run."""

    estimate: float
    sigma: Sigma
    unit: Literal["m", "rad"]


class Moved(Section):
    """The parameter that changed most from the run before, in the sigma that it had there."""

    name: str
    change: float
    in_sigma: Figure


class Run(Section):
    """One run.

    Attributes:
        sha256: Of its `result.json`.
        date: When its rows were measured.
        n_residuals: Residuals of its rows.
        chi2: Of its rows and what was known before.
        dof: Its degrees of freedom.
        p_value: Probability of one as large.
        verdict: `good`, `doubtful`, or `not judged` row by row, as of one in parts.
        moved: What changed most; None of the first run.
        parameters: What was estimated, by name.
        inputs: SHA-256 of the files of its rows, by path.
        rows: Fingerprints of its rows.
    """

    sha256: str
    date: Date
    n_residuals: Whole
    chi2: Figure
    dof: int
    p_value: Figure
    verdict: Verdict
    moved: Moved | None = None
    parameters: dict[str, Known]
    inputs: dict[str, str] = Field(default_factory=dict)
    rows: tuple[str, ...] = ()


class History(Section):
    """All runs, the first one first."""

    schema_: Literal["fg-calib/history/1"] = Field(alias="schema", default=SCHEMA)
    robot: str
    runs: Annotated[tuple[Run, ...], Field(min_length=1)]

    def text(self) -> str:
        """What is written."""
        document = {"schema": SCHEMA, **self.model_dump(mode="json", exclude={"schema_"})}
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def run_of(result: Result, digest: str, before: Run | None = None) -> Run:
    """A result as one run of a history.

    Args:
        result: It.
        digest: SHA-256 of its file.
        before: The run before.
    """
    estimated = set(result.covariance.names)
    parameters = {
        p.name: Known(estimate=p.estimate, sigma=p.sigma, unit=p.unit) for p in result.parameters if p.name in estimated
    }
    return Run(
        sha256=digest,
        date=result.date,
        n_residuals=result.n_residuals,
        chi2=result.chi2,
        dof=result.dof,
        p_value=result.chi2_p_value,
        verdict=_verdict_of(result),
        moved=None if before is None else _moved(parameters, before),
        parameters=parameters,
        inputs=result.inputs,
        rows=() if result.carried is None else result.carried.rows,
    )


def _verdict_of(result: Result) -> Verdict:
    if result.in_parts and result.trustworthy is None:
        return "not judged"
    return "good" if result.trustworthy else "doubtful"


def _moved(parameters: dict[str, Known], before: Run) -> Moved | None:
    found = []
    for name, now in parameters.items():
        then = before.parameters.get(name)
        if then is not None:
            change = now.estimate - then.estimate
            found.append(Moved(name=name, change=change, in_sigma=abs(change) / then.sigma if then.sigma else None))
    return max(found, key=lambda m: -1.0 if m.in_sigma is None else m.in_sigma, default=None)


@checked
def history_of(path: Path | str) -> History:
    """The runs that a saved calibration came from; of one that came from none it alone.

    Args:
        path: Its folder, or its `result.json`.

    Raises:
        InputError: There is no calibration, its history is damaged, or the history is that of another.
    """
    result = read_result(path)
    folder = Path(path) if is_folder(Path(path)) else Path(path).parent
    digest = sha256(read_bytes(folder / "result.json" if is_folder(Path(path)) else Path(path))).hexdigest()
    file = folder / HISTORY
    if not exists(file):
        return History(robot=result.robot, runs=(run_of(result, digest),))
    found = _read(file)
    if found.runs[-1].sha256 != digest:
        raise InputError(str(file), "the history of another result", "the files of one calibration")
    return found


def _read(file: Path) -> History:
    try:
        document: Any = json.loads(read_text(file))
    except (ValueError, RecursionError):
        raise InputError(str(file), "not JSON", f"a history of schema {SCHEMA}", "was it cut off?") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(str(file), "no history", f"one of schema {SCHEMA}")
    try:
        return History.model_validate(document)
    except ValidationError as error:
        raise first_misfit(error, str(file)) from None
