"""Inspection of a job before it is solved: counts, ranges, what looks wrong, the accuracy it can reach.

Nothing of the arm is estimated. Errors make a calibration not to be trusted, and are to be looked at first; notes are
what its reader should know, as in the verdict on a calibration.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fg_calib.arguments import checked
from fg_calib.arrays import Brief
from fg_calib.diagnostics.linearity import find_nonlinear_rows
from fg_calib.diagnostics.robust_screening import Disagreements, find_disagreements
from fg_calib.diagnostics.setup_check import SetupCheck, check_tables
from fg_calib.diagnostics.setup_hypotheses import MOTION_M, MOTION_RAD
from fg_calib.graph.build import problem_of
from fg_calib.graph.problem import Problem, eliminated, tables_of
from fg_calib.graph.solver import Solution, unsolved
from fg_calib.job import Job
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.limits import outside_limits
from fg_calib.measurements.table import Table
from fg_calib.observability.identifiability import Identifiability, identifiability_of
from fg_calib.observability.reasons import NOT_EXCITED
from fg_calib.prediction.tool_pose import ExpectedError, expected_error
from fg_calib.robot.model import Robot
from fg_calib.statistics.covariance import spread_of, with_left_out
from fg_calib.threads import single_threaded

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

AMBIGUOUS_SHARE = 0.05
"""Share of pairs of ambiguous sign, from which it is reported."""

NEAR = 1e-3
"""How far each reading of two configurations may be apart that are nearly the same, [rad] (prismatic: [m])."""

NAMED = 3
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
        """Whether it hardly moves."""
        return bool(self.range < (MOTION_M if self.unit == "m" else MOTION_RAD))


@dataclass(frozen=True)
class TableSurvey:
    """Counts of a table of measurements.

    Attributes:
        name: Its name.
        model: Which of its measurements take part; None of custom kinds alone.
        n_rows: Rows.
        n_configurations: Different configurations by name.
        n_test: Rows that are predicted, never fitted.
        n_pairs: Train pairs that take part, measured or formed.
        n_test_pairs: Test pairs.
        n_residuals: Scalar residuals of the fit, by kind.
        labels: How many stations, targets, anchors, planes, boards or contact points it names, by what they are.
        n_copies: Rows, or measured pairs, that are the same as one before them in every value.
        copy: Two that are the same; empty without.
        n_repeats: Those at the readings of one before them, with other values: they show the noise.
        n_near: Configurations within `NEAR` of another, but not the same.
        n_leaked: Test rows at, or within `NEAR` of, a configuration of train rows.
        n_near_singular: Train pairs within `linearity.NEAR_SIGMAS` of 0 or, an angle, of 180 degrees.
        n_ambiguous: Train pairs whose sign is ambiguous within the prior sigmas.
    """

    name: str
    model: str | None
    n_rows: int
    n_configurations: int
    n_test: int
    n_pairs: int
    n_test_pairs: int
    n_residuals: dict[str, int]
    labels: dict[str, int]
    n_copies: int
    copy: str
    n_repeats: int
    n_near: int
    n_leaked: int
    n_near_singular: int
    n_ambiguous: int


@dataclass(frozen=True)
class Inspection(Brief):
    """A job before it is solved.

    Attributes:
        robot: The robot's name.
        tables: Counts, table by table (a table seen from several stations is several).
        joints: The ranges of the readings.
        setups: Typical residuals of each table before calibration, and a mistake in its set-up if one explains them.
        disagreements: Rows that disagree with the nominal arm far more than the others do.
        identifiability: What the train rows determine, at nominal.
        expected_error: How far off the calibrated tool is expected to be; None where the arm is only evaluated.
        n_residuals: Scalar residuals of the fit.
        n_priors: Scalar priors.
        n_unknowns: Scalars that are estimated, of the arm and of all else.
        dof: Residuals and priors, less the determined directions.
        n_excluded: Train pairs that take no part, by reason.
        evaluated: Whether all rows are test rows: the arm is taken as it is.
        findings: Errors, which make a calibration not to be trusted; empty if there are none.
        cautions: Notes for its reader.
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


@checked
@single_threaded
def inspect_job(job: Job) -> Inspection:
    """Inspect a job before it is solved; nothing of the arm is estimated.

    Args:
        job: The job, as `read_job` reads it.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: The measurements lack what the model needs, or do not suffice, as `calibrate` would say.
    """
    problem = problem_of(job)
    tables = tables_of(job.measurements, job.options)
    every, setups, disagreements = _check_set_up(problem, job, tables)
    at_nominal = unsolved(problem)
    spread = spread_of(at_nominal)
    expected = None if problem.evaluated else expected_error(problem, with_left_out(at_nominal, spread))
    n_directions = spread.rank + eliminated(problem, problem.start).rank
    found = Inspection(
        robot=job.robot.name,
        tables=tuple(_survey(at_nominal, number, table) for number, table in enumerate(tables)),
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
    kinds = {name.partition(".")[0] for s in problem.data.series for name in s.kind.names}
    errors, notes = list[str](), list[str]()
    suspicious = {one.table for one in disagreements.found}
    for check in setups:
        if check.explanations or (check.far and check.table not in suspicious):
            (errors if check.explanations or _has_priors(job) else notes).append(str(check))
    if disagreements.found:
        robust = job.options.loss != "none" and not any(one.test for one in disagreements.found)
        (notes if robust else errors).append(_in_words(disagreements, job.options.loss))
    errors += [*_check_counts(found), *_check_limits(found, job, kinds)]
    notes += [*map(str, found.identifiability.missing), *_check_coverage(found, job)]
    for survey in found.tables:
        notes += _check_table(survey)
    notes += _check_noise(found, job)
    return replace(found, findings=tuple(errors), cautions=tuple(notes))


def _check_set_up(
    problem: Problem, job: Job, tables: Sequence[Table]
) -> tuple[list[SetupCheck], list[SetupCheck], Disagreements]:
    """The set-up of each table, those that report something, and rows that disagree with the others.

    Where a mistake in the set-up was found single rows are not looked for: all disagree.
    """
    whole = problem.whole or problem
    judged = replace(whole, robot=job.robot) if problem.evaluated else whole
    every, setups = check_tables(judged, whole.start, with_landmarks=True)
    if any(check.explanations for check in setups):
        return every, setups, Disagreements()
    return every, setups, find_disagreements(job.robot, tables, problem.data.labels if len(tables) > 1 else ("",))


def _survey(at_nominal: Solution, number: int, table: Table) -> TableSurvey:
    """The counts of a table, with the test rows that it states."""
    m, problem = table.measurements, at_nominal.problem
    measured_pairs = table.uses_pairs and m.pairs is not None
    copies, copy, repeats = _same_pairs(m) if measured_pairs else _same_rows(m)
    near, leaked = _neighbours(m)
    series = [s for s in problem.data.series if s.table == number]
    pairs = find_nonlinear_rows(at_nominal, np.zeros((problem.variables.n_columns, 0)), 0, number)
    n_residuals = Counter[str]()
    for s in series:
        for name, n in zip(s.kind.names, s.used[s.train].sum(axis=0).tolist(), strict=True):
            n_residuals[name.partition(".")[0]] += int(n)
    labels = {what: len(of.names) for what, of in m.labels.items()}
    return TableSurvey(
        name=problem.data.labels[number],
        model=table.model,
        n_rows=m.n_configurations,
        n_configurations=len(np.unique(problem.data.places[number])),
        n_test=int(m.test.sum()),
        n_pairs=len({k for s in series if s.kind.ends == 2 for k in s.number[s.train].tolist()}),
        n_test_pairs=len({k for s in series if s.kind.ends == 2 for k in s.number[s.test].tolist()}),
        n_residuals=dict(n_residuals),
        labels=labels | ({} if m.groups is None else {"contact point": m.groups.n_groups}),
        n_copies=copies,
        copy=copy,
        n_repeats=repeats,
        n_near=near,
        n_leaked=leaked,
        n_near_singular=pairs.n_near,
        n_ambiguous=len(set(pairs.ambiguous)),
    )


def _same_rows(m: Measurements) -> tuple[int, str, int]:
    """See `_same`, of rows."""
    columns = [m.readings, *(of.index[:, None] for of in m.labels.values())]
    columns += [] if m.groups is None else [m.groups.index[:, None]]
    columns += [] if m.image is None else [m.image[:, 2:]]
    measured = [v.reshape(m.n_configurations, -1) for v in (m.position, m.rotation, m.length, m.image) if v is not None]
    return _same(np.hstack(columns), measured, m.ids.tolist())


def _same_pairs(m: Measurements) -> tuple[int, str, int]:
    """See `_same`, of measured pairs, whichever end is a."""
    assert m.pairs is not None
    a, b = np.sort(np.stack([m.pairs.a, m.pairs.b]), axis=0)
    names = [f"{m.ids[i]}-{m.ids[j]}" for i, j in zip(a.tolist(), b.tolist(), strict=True)]
    return _same(np.stack([a, b], axis=1), [np.stack([m.pairs.distance, m.pairs.angle], axis=1)], names)


def _same(places: Floats | Integers, measured: Sequence[Floats], names: Sequence[str]) -> tuple[int, str, int]:
    """How many rows equal an earlier one, names of two, and how many have its place but other values.

    Args:
        places: Where each row was measured, shape (n, k).
        measured: Measured values, shape (n, width) each; nan where not measured.
        names: Names of the rows.
    """
    values = np.hstack([places, *(np.nan_to_num(v, nan=-1e300) for v in measured)]) + 0.0  # no -0
    (first, of), n = np.unique(values, axis=0, return_index=True, return_inverse=True)[1:], len(places)
    same: Integers = first[of.ravel()]
    copied = np.flatnonzero(same != np.arange(n)) if measured else np.arange(0)
    two = dict.fromkeys([names[same[copied[0]]], names[copied[0]]] if len(copied) else [])
    return len(copied), " and ".join(two), n - len(np.unique(places + 0.0, axis=0)) - len(copied)


def _neighbours(m: Measurements) -> tuple[int, int]:
    """How many configurations are nearly another, and how many test rows are at or near those of train rows."""
    q, first = np.unique(m.readings, axis=0, return_index=True)
    near = 0
    if len(first) > 1:
        distance, _ = cKDTree(q).query(q, k=2, p=np.inf, distance_upper_bound=NEAR)
        near = int(np.sum(np.isfinite(np.asarray(distance)[:, 1])))
    if not m.test.any() or m.test.all():
        return near, 0
    distance, _ = cKDTree(m.readings[~m.test]).query(m.readings[m.test], p=np.inf, distance_upper_bound=NEAR)
    return near, int(np.sum(np.isfinite(distance)))


def _joints(problem: Problem, robot: Robot) -> tuple[JointRange, ...]:
    """The readings of each joint in all tables."""
    q = problem.data.readings
    outside = outside_limits(q, robot).sum(axis=0)
    return tuple(
        JointRange(joint.name, joint.unit, float(q[:, j].min()), float(q[:, j].max()),
                   (float(robot.limits[j, 0]), float(robot.limits[j, 1])), int(outside[j]))
        for j, joint in enumerate(robot.joints)
    )  # fmt: skip


def _has_priors(job: Job) -> bool:
    """Whether everything that is estimated of the arm has a prior."""
    arm = [p for p in job.robot.parameters if p.estimated and 1 <= p.owner <= job.robot.n_joints]
    return job.options.has_priors and all(p.tolerance is not None for p in arm)


def _in_words(disagreements: Disagreements, loss: str) -> str:
    """Rows that disagree with the nominal arm, and a way out."""
    found = disagreements.found
    several, first = len(found) > 1, found[0]
    many_tables = len({one.table for one in found}) > 1
    names = [f"{'-'.join(one.ends)}{f' of {one.table}' * many_tables}" for one in found]
    who = _listed(list(dict.fromkeys(names)))
    count = f"{len(found)} measurements disagree" if several else "one measurement disagrees"
    of = "" if many_tables or not first.table else f" of {first.table}"
    what = f"{count} with the nominal arm far more than the others do ({who}{of})"
    tested = sum(one.test for one in found)
    advice = f"look at {'them' if several else 'it'}"
    if tested < len(found) and loss == "none":
        advice += ", or let a robust loss do so (loss: gnc)"
    if tested:
        rows = "a test row" if not several else "test rows" if tested == len(found) else f"{tested} are test rows"
        advice += f"; {rows}: no loss acts on what is held out"
    return f"{what}: {advice}" if tested or loss == "none" else what


def _check_counts(found: Inspection) -> Iterator[str]:
    """Check what makes any result worthless: impossible readings, nothing determined, nothing to check it by."""
    for joint in found.joints:
        if joint.n_outside:
            yield f"{joint.name} is outside its limits in {joint.n_outside} configurations: is it in another unit?"
    o = found.identifiability.observability
    if o.names and not o.rank:
        yield "these rows determine none of the parameters that are estimated"
    if found.dof <= 0:
        yield "no degree of freedom is left: nothing would say whether the fit is right, or the noise; measure more"


def _check_limits(found: Inspection, job: Job, kinds: Collection[str]) -> Iterator[str]:
    """Check limits that would not be evaluated, whatever the arm is like; `kinds` is what the tables measure."""
    given = [f.name for f in fields(job.options.accept) if getattr(job.options.accept, f.name) is not None]
    for kind in given:
        if kind not in kinds:
            yield f"accept: nothing in this job measures any {kind}: its limit cannot be evaluated"
    held_out = job.options.folds is not None or _has_test_rows(found)
    if not (held_out or found.evaluated) and any(kind in kinds for kind in given):
        yield "accept: limits are judged by what is held out, and nothing is: add test rows (column split), or folds"


def _has_test_rows(found: Inspection) -> bool:
    return any(table.n_test or table.n_test_pairs for table in found.tables)


def _check_coverage(found: Inspection, job: Job) -> Iterator[str]:
    """Check joints that hardly move, directions that are not excited, and test rows."""
    still = [joint.name for joint in found.joints if joint.still]
    if still:
        what = "moves: its zero is" if len(still) == 1 else "move: their zeros are"
        yield f"{_listed(still)} hardly {what} not distinguishable from the link before"
    lost = [d for d in found.identifiability.lost if d.reason == NOT_EXCITED]
    if lost:
        what = "one direction is" if len(lost) == 1 else f"{len(lost)} directions are"
        yield f"{what} not excited by these configurations although the model sees more: move every joint more"
    if not found.evaluated and not _has_test_rows(found):
        yield "no test rows: nothing would check how well the calibration predicts (column split)"
    if job.options.gauge == "none" and found.identifiability.lost:
        yield "gauge none: what is not determined has no sigma"


def _check_table(t: TableSurvey) -> Iterator[str]:
    """Check the rows of a table: copies, leaked test rows, pairs of ambiguous sign."""
    if t.n_copies:
        what = "one row is an exact copy" if t.n_copies == 1 else f"{t.n_copies} rows are exact copies"
        yield f"{t.name}: {what} of another ({t.copy}): a copy counts as one more measurement; remove it"
    if t.n_leaked:
        what = "one test row is" if t.n_leaked == 1 else f"{t.n_leaked} test rows are"
        yield f"{t.name}: {what} at configurations of train rows: no check of a prediction"
    if t.n_pairs and t.n_ambiguous > AMBIGUOUS_SHARE * t.n_pairs:
        yield (
            f"{t.name}: the sign of {t.n_ambiguous} of {t.n_pairs} train pairs is ambiguous within the prior sigmas"
            " (near 0 or 180 deg): measure longer and wider motions, in which more joints move"
        )


def _check_noise(found: Inspection, job: Job) -> Iterator[str]:
    """Check noise and prior sigmas that are to be estimated, and tables too short to be checked."""
    if job.options.estimate_noise:
        yield "noise is to be estimated: sigmas and accuracy here are for specified noise, or 1 mm and 1 mrad"
    if job.options.estimate_tolerance:
        yield "prior sigmas are to be estimated: accuracy here is for those specified, or 1 mm and 1 mrad"
    unseen = [t.name for t, check in zip(found.tables, found.setups, strict=False) if not check.residuals]
    if unseen and len(found.setups) == len(found.tables):
        yield f"{_listed(unseen)}: too few rows to look for common mistakes (units, signs, columns) before solving"


def _listed(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
