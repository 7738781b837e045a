"""What can be said of a job before it is solved: counts, ranges, what looks wrong, what it can reach.

Nothing of the arm is estimated. Findings are what makes a calibration not to be trusted, and are to be looked at first;
cautions are what its reader should know, as in the verdict on a calibration.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.diagnostics.setup_check import SetupCheck
from fg_calib.diagnostics.setup_hypotheses import STILL_SLIDE, STILL_TURN
from fg_calib.diagnostics.table_setups import check_tables
from fg_calib.diagnostics.table_survey import TableSurvey, survey_of
from fg_calib.errors import escaped
from fg_calib.graph.build import problem_of
from fg_calib.graph.information import eliminated
from fg_calib.graph.problem import Problem, tables_of
from fg_calib.graph.solver import unsolved
from fg_calib.job import Job
from fg_calib.measurements.limits import outside_limits
from fg_calib.measurements.table import Table
from fg_calib.observability.identifiability import Identifiability, identifiability_of
from fg_calib.observability.reasons import NOT_EXCITED
from fg_calib.prediction.expected_error import ExpectedError, expected_error
from fg_calib.robot.model import Robot
from fg_calib.statistics.covariance import spread_of, with_left_out
from fg_calib.statistics.robust_screening import Disagreements, find_disagreements, fit_roughly
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]

LEAST_FOLDED = 0.05
"""Share of lengths and angles whose vectors tolerances let point either way, from which it is worth a word."""

_NAMED = 3
"""Configurations or joints that a statement names."""


@dataclass(frozen=True)
class JointRange:
    """The readings of a joint in all tables.

    Attributes:
        name: The joint.
        unit: `m` or `rad`.
        least: Smallest reading, [rad] (prismatic: [m]).
        most: Largest reading.
        limits: Lower and upper, infinite without.
        n_outside: Configurations in which it is outside them.
    """

    name: str
    unit: str
    least: float
    most: float
    limits: tuple[float, float]
    n_outside: int

    @property
    def range(self) -> float:
        """How far it moves."""
        return self.most - self.least

    @property
    def share(self) -> float | None:
        """Part of the range within its limits that it moves; None without limits."""
        width = self.limits[1] - self.limits[0]
        return self.range / width if 0.0 < width < np.inf else None

    @property
    def still(self) -> bool:
        """Whether it hardly moves: nobody measures so on purpose."""
        return self.range < (STILL_SLIDE if self.unit == "m" else STILL_TURN)


@dataclass(frozen=True, repr=False)
class Inspection:
    """What can be said of a job before it is solved.

    Attributes:
        robot: The robot's name.
        tables: What each table holds, table by table (a table seen from several stations is several).
        joints: The ranges of the readings.
        setups: Typical residuals of each table before calibration, and a mistake in its set-up if one explains them.
        disagreements: Rows that disagree with the arm as drawn far more than the others do.
        identifiability: What the train rows determine, at nominal.
        expected_error: How far off the calibrated tool is expected to be; None where the arm is only evaluated.
        n_residuals: Scalar residuals of the fit.
        n_priors: Scalar priors.
        n_unknowns: Scalars that are estimated, of the arm and beside it.
        dof: Residuals and priors, less the determined directions.
        n_excluded: Train pairs that take no part, by reason.
        evaluated: Whether all rows are test rows: the arm is taken as it is.
        findings: What makes a calibration not to be trusted, and is to be looked at first; empty if nothing does.
        cautions: What its reader should know although nothing speaks against it.
    """

    robot: str
    tables: tuple[TableSurvey, ...]
    joints: tuple[JointRange, ...]
    setups: tuple[SetupCheck, ...]
    disagreements: Disagreements
    identifiability: Identifiability
    expected_error: ExpectedError | None
    n_residuals: int
    n_priors: int
    n_unknowns: int
    dof: int
    n_excluded: dict[str, int]
    evaluated: bool
    findings: tuple[str, ...]
    cautions: tuple[str, ...]

    @property
    def ready(self) -> bool:
        """Whether nothing is to be looked at first."""
        return not self.findings

    def __repr__(self) -> str:
        o = self.identifiability.observability
        rows, tables = sum(t.n_rows for t in self.tables), len(self.tables)
        lines = [
            f"Inspection of {self.robot!r}: {rows} rows in {tables} table{'s' * (tables > 1)},"
            f" rank {o.rank} of {len(o.names)}",
            *(f"  LOOK AT THIS FIRST: {finding}" for finding in self.findings[:6]),
            *(["  ready"] if self.ready else []),
            *([f"  {len(self.cautions)} cautions"] if self.cautions else []),
        ]
        return "\n".join(escaped(line if len(line) <= 100 else f"{line[:96]} ...") for line in lines)


@checked
@single_threaded
def inspect_job(job: Job) -> Inspection:
    """What can be said of a job before it is solved; nothing of the arm is estimated.

    Args:
        job: The job, as `read_job` reads it.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: The measurements lack what the model needs, or do not suffice, as `calibrate` would say.
    """
    problem = problem_of(job)
    tables = tables_of(job.measurements, job.options)
    every, setups, disagreements = _of_set_up(problem, job, tables)
    at_nominal = unsolved(problem)
    spread = spread_of(at_nominal)
    expected = None if problem.evaluated else expected_error(problem, with_left_out(at_nominal, spread))
    n_directions = spread.rank + eliminated(problem, problem.start).rank
    found = Inspection(
        robot=job.robot.name,
        tables=tuple(survey_of(problem, number, table) for number, table in enumerate(tables)),
        joints=_joints(problem, job.robot),
        setups=tuple(next((s for s in setups if s.table == check.table), check) for check in every),
        disagreements=disagreements,
        identifiability=identifiability_of(problem.whole or problem, problem.start, "practical"),
        expected_error=expected,
        n_residuals=problem.n_residuals,
        n_priors=problem.n_priors,
        n_unknowns=problem.variables.n_columns + problem.variables.n_nuisance,
        dof=problem.n_independent + problem.n_priors - n_directions,
        n_excluded={reason: n for reason, n in problem.n_excluded.items() if n},
        evaluated=problem.evaluated,
        findings=(),
        cautions=(),
    )
    findings, cautions = _judged(found, job, setups)
    limits = _of_limits(found, job, {name.partition(".")[0] for s in problem.data.series for name in s.kind.names})
    return replace(found, findings=(*findings, *limits), cautions=cautions)


def _of_set_up(
    problem: Problem, job: Job, tables: Sequence[Table]
) -> tuple[list[SetupCheck], list[SetupCheck], Disagreements]:
    """The set-up of each table, those that have something to say of it, and rows that disagree with the others.

    Where a mistake in the set-up was found single rows are not looked for: all disagree.
    """
    fit = fit_roughly(job.robot, tables)
    whole = problem.whole or problem
    judged = replace(whole, robot=job.robot) if problem.evaluated else whole
    every, setups = check_tables(judged, whole.start if fit is None else fit.start(whole), placed=True)
    if fit is None or any(check.explanations for check in setups):
        return every, setups, Disagreements((), 0, 0)
    return every, setups, find_disagreements(fit, problem.data.labels if len(tables) > 1 else ("",))


def _joints(problem: Problem, robot: Robot) -> tuple[JointRange, ...]:
    """The readings of each joint in all tables."""
    q = problem.data.readings
    outside = outside_limits(q, robot).sum(axis=0)
    return tuple(
        JointRange(joint.name, joint.unit, float(q[:, j].min()), float(q[:, j].max()),
                   (float(robot.limits[j, 0]), float(robot.limits[j, 1])), int(outside[j]))
        for j, joint in enumerate(robot.joints)
    )  # fmt: skip


def _judged(found: Inspection, job: Job, setups: list[SetupCheck]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Findings and cautions, what is wrong with everything first."""
    findings, cautions = list[str](), list[str]()
    suspicious = {one.table for one in found.disagreements.found}
    for check in setups:
        if check.explanations or (check.far and check.table not in suspicious and _is_stated(job)):
            findings.append(str(check))
        elif check.far and check.table not in suspicious:
            cautions.append(str(check))
    if found.disagreements.found:
        robust = job.options.loss != "none" and not any(one.test for one in found.disagreements.found)
        (cautions if robust else findings).append(_of_disagreements(found.disagreements, job))
    findings += _of_figures(found)
    cautions += map(str, found.identifiability.missing)
    cautions += _of_readings(found, job)
    for table in found.tables:
        cautions += _of_table(table)
    cautions += _of_noise(found, job)
    return tuple(findings), tuple(cautions)


def _is_stated(job: Job) -> bool:
    """Whether the job says of all that it estimates of the arm how far it may be off."""
    arm = [p for p in job.robot.parameters if p.estimated and 1 <= p.owner <= job.robot.n_joints]
    return job.options.has_priors and all(p.tolerance is not None for p in arm)


def _of_disagreements(found: Disagreements, job: Job) -> str:
    several = len(found.found) > 1
    first = found.found[0]
    many_tables = len({one.table for one in found.found}) > 1
    names = [f"{'-'.join(one.ends)}{f' of {one.table}' * many_tables}" for one in found.found]
    who = _listed(list(dict.fromkeys(names)))
    count = f"{len(found.found)} measurements disagree" if several else "one measurement disagrees"
    of = "" if many_tables or not first.table else f" of {first.table}"
    what = f"{count} with the arm as drawn far more than the others do ({who}{of})"
    them = "them" if several else "it"
    tested = sum(one.test for one in found.found)
    advice = f"look at {them}"
    if tested < len(found.found) and job.options.loss == "none":
        advice += ", or let a robust loss do so (loss: gnc)"
    if tested:
        rows = "a test row" if not several else "test rows" if tested == len(found.found) else f"{tested} are test rows"
        advice += f"; {rows}: no loss acts on what is held out"
    return f"{what}: {advice}" if tested or job.options.loss == "none" else what


def _of_figures(found: Inspection) -> Iterator[str]:
    """What makes any result worth nothing: readings that cannot be, nothing determined, nothing to check it by."""
    for joint in found.joints:
        if joint.n_outside:
            yield f"{joint.name} is outside its limits in {joint.n_outside} configurations: is it in another unit?"
    o = found.identifiability.observability
    if o.names and not o.rank:
        yield "these rows determine none of the parameters that are estimated"
    if found.dof <= 0:
        yield "no degree of freedom is left: nothing would say whether the fit is right, or the noise; measure more"


def _of_limits(found: Inspection, job: Job, kinds: Collection[str]) -> Iterator[str]:
    """Limits that would not be evaluated, whatever the arm is like.

    Args:
        found: What was found of the tables.
        job: The job.
        kinds: What its tables measure.
    """
    stated = [f.name for f in fields(job.options.accept) if getattr(job.options.accept, f.name) is not None]
    for kind in stated:
        if kind not in kinds:
            yield f"accept: nothing in this job measures any {kind}: its limit cannot be evaluated"
    held_out = job.options.folds is not None or any(table.n_test or table.n_test_pairs for table in found.tables)
    if not (held_out or found.evaluated) and any(kind in kinds for kind in stated):
        yield "accept: limits are judged by what is held out, and nothing is: add test rows (column split), or folds"


def _of_readings(found: Inspection, job: Job) -> Iterator[str]:
    still = [joint.name for joint in found.joints if joint.still]
    if still:
        what = "moves: its zero is" if len(still) == 1 else "move: their zeros are"
        yield f"{_listed(still)} hardly {what} not told from what stands before it"
    lost = [d for d in found.identifiability.lost if d.reason == NOT_EXCITED]
    if lost:
        what = "one direction is" if len(lost) == 1 else f"{len(lost)} directions are"
        yield f"{what} not excited by these configurations although the model sees more: move every joint more"
    if not found.evaluated and not any(table.n_test or table.n_test_pairs for table in found.tables):
        yield "no test rows: nothing would check how well the calibration predicts (column split)"
    if job.options.gauge == "none" and found.identifiability.lost:
        yield "gauge none: what is not determined has no sigma"


def _of_table(t: TableSurvey) -> Iterator[str]:
    """What the rows of a table give reason to say."""
    if t.n_copies:
        what = "one row is an exact copy" if t.n_copies == 1 else f"{t.n_copies} rows are exact copies"
        yield f"{t.name}: {what} of another ({t.copy}): what was copied counts as often as it stands there"
    if t.n_leaked:
        what = "one test row is" if t.n_leaked == 1 else f"{t.n_leaked} test rows are"
        yield f"{t.name}: {what} at configurations of train rows: no check of a prediction"
    if t.n_pairs and t.n_folded > LEAST_FOLDED * t.n_pairs:
        yield (
            f"{t.name}: {t.n_folded} of {t.n_pairs} train pairs are so near 0 or half a turn that tolerances let their"
            " vectors point either way: longer and wider motions, in which more joints move, tell more"
        )


def _of_noise(found: Inspection, job: Job) -> Iterator[str]:
    if job.options.estimate_noise:
        yield "noise is to be estimated: sigmas and accuracy here are for noise as stated, or 1 mm and 1 mrad"
    if job.options.estimate_tolerance:
        yield "tolerances are to be estimated: accuracy here is for those stated, or 1 mm and 1 mrad"
    unseen = [t.name for t, check in zip(found.tables, found.setups, strict=False) if not check.residuals]
    if unseen and len(found.setups) == len(found.tables):
        yield f"{_listed(unseen)}: too few rows to look for the usual mistakes (units, signs, columns) before solving"


def _listed(names: list[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
