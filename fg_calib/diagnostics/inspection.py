"""Inspection of a job before it is solved: counts, ranges, what looks wrong, the accuracy it can reach.

Nothing of the arm is estimated. Errors make a calibration not to be trusted, and are to be looked at first; notes are
what its reader should know, as in the verdict on a calibration.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
from scipy.spatial import cKDTree

from fg_calib.diagnostics.setup_check import MOTION_M, MOTION_RAD, SetupCheck, check_tables, reporting
from fg_calib.diagnostics.verdict import Severity, Statement, check_excitation, texts
from fg_calib.graph import Problem, problem_of, solve, tables_of, unsolved
from fg_calib.inputs import Brief, CalibrationError, Record, shorten
from fg_calib.job import Job
from fg_calib.measurements import Measurements, Table, find_copies, outside_limits
from fg_calib.observability import Identifiability, identifiability_of
from fg_calib.parallel import single_threaded
from fg_calib.prediction import ExpectedError, expected_error
from fg_calib.robot import Robot
from fg_calib.statistics import MAX_OUTLIER_SHARE, judge_fit, spread_of, with_left_out
from fg_calib.statistics.residual_table import residual_table, same_readings

FAR, MEDIAN = 10.0, 0.6745
"""Studentised residual over its typical size from which a row disagrees; the median size of what is normal."""

MAX_ROWS = 20_000
"""Rows up to which single ones that disagree are looked for."""

NEAR = 1e-3
"""How far each reading of two configurations may be apart that are nearly the same, [rad] (prismatic: [m])."""


class JointRange(Record):
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
    def share(self) -> float | None:
        """Part of the range within its limits that it moves; None without limits."""
        width = self.limits[1] - self.limits[0]
        return (self.most - self.least) / width if 0.0 < width < np.inf else None

    @property
    def still(self) -> bool:
        """Whether it hardly moves."""
        return bool(self.most - self.least < (MOTION_M if self.unit == "m" else MOTION_RAD))


class TableSurvey(Record):
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
        n_repeats: Rows at the readings of an earlier one, with other values: they show the noise.
        n_leaked: Test rows at, or within `NEAR` of, a configuration of train rows.
        n_renamed: Configurations at the readings of an earlier one of another name.
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
    n_leaked: int
    n_renamed: int


class Disagreement(Record):
    """A measurement that disagrees with the others, by the arm that a robust loss fits to all.

    Attributes:
        name: The configurations that it is of, or the landmark, and its table if there are several.
        ratio: Size of its studentised residual over the typical one of its kind of noise.
        test: Whether it is a test row.
    """

    name: str
    ratio: float
    test: bool


class Inspection(Brief):
    """A job before it is solved.

    Attributes:
        robot: The robot's name.
        tables: Counts, table by table (a table seen from several stations is several).
        joints: The ranges of the readings.
        setups: Typical residuals of each table before calibration, and a mistake in its set-up if one explains them.
        disagreements: Measurements that disagree with the others, the farthest first.
        identifiability: Identifiability by the train rows, at nominal.
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
    disagreements: tuple[Disagreement, ...]
    identifiability: Identifiability
    expected_error: ExpectedError | None
    n_residuals: int
    n_priors: int
    n_unknowns: int
    dof: int
    n_excluded: dict[str, int]
    evaluated: bool
    findings: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()


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
    whole = problem.whole or problem
    judged = replace(whole, robot=job.robot) if problem.evaluated else whole
    setups = check_tables(judged, whole.start, with_landmarks=True)
    misread = any(check.explanations for check in setups)  # then all rows disagree
    at_nominal = unsolved(problem)
    spread = spread_of(at_nominal)
    n_directions = spread.rank + problem.system.left.rank
    surveys = tuple(_survey(problem, number, table) for number, table in enumerate(tables))
    disagreements = () if misread else _disagreements(job)
    identifiability = identifiability_of(problem.whole or problem, problem.start, "practical")
    expected = None if problem.evaluated else expected_error(problem, with_left_out(at_nominal, spread))
    dof = problem.n_independent + problem.n_priors - n_directions
    counts = (problem.n_residuals, problem.n_priors, problem.variables.n_columns + problem.variables.n_nuisance, dof)
    excluded = {reason: n for reason, n in problem.n_excluded.items() if n}
    rows = (surveys, _joints(problem, job.robot), tuple(setups), disagreements)
    found = Inspection(job.robot.name, *rows, identifiability, expected, *counts, excluded, problem.evaluated)
    statements = [statement for check in CHECKS for statement in check(found, job)]
    cautions = (*texts(statements, "warning"), *texts(statements, "note"))
    return replace(found, findings=texts(statements, "error"), cautions=cautions)


def _disagreements(job: Job) -> tuple[Disagreement, ...]:
    """The measurements that disagree with the others; none where these are many, or the rows."""
    problem = problem_of(job, loss="cauchy")
    if problem.n_residuals > MAX_ROWS:
        return ()
    try:
        solution = solve(problem)
        table = residual_table(solution)
        size = np.abs(judge_fit(solution, spread_of(solution), table).studentised)
    except CalibrationError:
        return ()
    judged, found = (table.reason_code == 0) & np.isfinite(size), dict[int, Disagreement]()
    for k in np.unique(table.group[judged]).tolist():
        rows = np.flatnonzero(judged & (table.group == k))
        ratio = size[rows] / max(1.0, np.median(size[rows]) / MEDIAN)
        of = f" of {problem.data.labels[table.groups[k][0]]}" * (len(problem.data.labels) > 1)
        for far, i in sorted(zip(ratio[ratio > FAR].tolist(), rows[ratio > FAR].tolist(), strict=True)):
            name = "-".join(table.names[end] for end in (table.a[i], table.b[i]) if end >= 0)
            found[int(table.measurement_number[i])] = Disagreement(name + of, far, bool(table.test[i]))
    worst = tuple(sorted(found.values(), key=lambda one: -one.ratio))
    return worst if len(found) <= MAX_OUTLIER_SHARE * table.begins.sum() else ()


def _survey(problem: Problem, number: int, table: Table) -> TableSurvey:
    """The counts of a table, with the test rows that it states."""
    m = table.measurements
    copies, copy, repeats = find_copies(table)
    blocks = [s for s in problem.data.blocks if s.table == number]
    n_residuals = Counter[str]()
    for s in blocks:
        for name, n in zip(s.kind.names, s.used[s.train].sum(axis=0).tolist(), strict=True):
            n_residuals[name.partition(".")[0]] += int(n)
    labels = {what: len(of.names) for what, of in m.labels.items()}
    places = np.unique(problem.data.places[number])
    with_pairs = [s for s in blocks if s.kind.ends == 2]
    n_pairs = len({k for s in with_pairs for k in s.number[s.train].tolist()})
    n_test_pairs = len({k for s in with_pairs for k in s.number[s.test].tolist()})
    labels |= {} if m.groups is None else {"contact point": len(m.groups.names)}
    n_renamed = len(places) - len(np.unique(same_readings(problem.data.readings[places])))
    counts = (m.n_configurations, len(places), int(m.test.sum()), n_pairs, n_test_pairs, dict(n_residuals), labels)
    copied = (copies, copy, repeats, _n_leaked(m), n_renamed)
    return TableSurvey(problem.data.labels[number], table.model, *counts, *copied)


def _n_leaked(m: Measurements) -> int:
    """How many test rows are at, or within `NEAR` of, a configuration of train rows."""
    if not m.test.any() or m.test.all():
        return 0
    distance, _ = cKDTree(m.readings[~m.test]).query(m.readings[m.test], p=np.inf, distance_upper_bound=NEAR)
    return int(np.sum(np.isfinite(distance)))


def _joints(problem: Problem, robot: Robot) -> tuple[JointRange, ...]:
    """The readings of each joint in all tables."""
    q = problem.data.readings
    limits, outside = map(tuple, robot.limits.tolist()), outside_limits(q, robot).sum(axis=0).tolist()
    columns = zip(robot.joints, q.min(axis=0).tolist(), q.max(axis=0).tolist(), limits, outside, strict=True)
    return tuple(JointRange(joint.name, joint.unit, *values) for joint, *values in columns)


def _check_setups(found: Inspection, job: Job) -> Iterator[Statement]:
    """Check the set-up of each table, and the range of the readings."""
    arm = [p for p in job.robot.parameters if p.estimated and 1 <= p.owner <= job.robot.n_joints]
    has_priors = job.options.has_priors and all(p.tolerance is not None for p in arm)
    for check in reporting(found.setups):
        severity: Severity = "error" if check.explanations or has_priors else "note"
        yield Statement(severity, str(check), check.explanations or not found.disagreements)  # else these are why
    wrong, loss, tested = found.disagreements, job.options.loss, sum(one.test for one in found.disagreements)
    text = f"measurements that disagree with the others: {len(wrong)} ({shorten([one.name for one in wrong])})"
    text += ": look at them" * bool(tested or loss == "none")
    text += ", or let a robust loss do so (loss: gnc)" * (loss == "none" and tested < len(wrong))
    text += f"; no loss acts on test rows, of which these are {tested}" * bool(tested)
    yield Statement("error" if tested or loss == "none" else "note", text, wrong)
    for joint in found.joints:
        text = f"{joint.name} is outside its limits in {joint.n_outside} configurations: is it in another unit?"
        yield Statement("error", text, joint.n_outside)


def _check_result(found: Inspection, job: Job) -> Iterator[Statement]:
    """Check what makes any result worthless: nothing determined, nothing to check it by; and what it will lack."""
    seen, options = found.identifiability.observability, job.options
    tested = any(table.n_test or table.n_test_pairs for table in found.tables)
    measured = {kind for table in found.tables for kind in table.n_residuals}
    limited = [f.name for f in fields(options.accept) if getattr(options.accept, f.name) is not None]
    text = "these rows determine none of the parameters that are estimated"
    yield Statement("error", text, seen.names and not seen.rank)
    text = "no degree of freedom is left: nothing would say whether the fit is right, or the noise; measure more"
    yield Statement("error", text, found.dof <= 0)
    for kind in limited:
        text = f"accept: nothing in this job measures any {kind}: its limit cannot be evaluated"
        yield Statement("error", text, kind not in measured)
    text = "accept: limits are judged by what is held out, and nothing is: add test rows (column split), or folds"
    held_out = tested or options.folds is not None or found.evaluated
    yield Statement("error", text, measured.intersection(limited) and not held_out)
    for motion in found.identifiability.missing:
        yield Statement("note", str(motion))
    still = [joint.name for joint in found.joints if joint.still]
    what = "moves: its zero is" if len(still) == 1 else "move: their zeros are"
    yield Statement("note", f"{shorten(still)} hardly {what} not distinguishable from the link before", still)
    yield from check_excitation(found.identifiability)
    text = "no test rows: nothing would check how well the calibration predicts (column split)"
    yield Statement("note", text, not held_out)


def _check_tables(found: Inspection, job: Job) -> Iterator[Statement]:
    """Check each table for copies, leaked test rows; noise and priors to be estimated."""
    for t in found.tables:
        text = f"{t.name}: rows that are exact copies of others: {t.n_copies} ({t.copy}); each counts as one more"
        yield Statement("note", f"{text} measurement: remove it", t.n_copies)
        shares = t.model == "pixels" or set(t.labels).difference(["station", "contact point"])
        text = f"{t.name}: readings repeated under another id: {t.n_renamed}; their joint errors count as independent:"
        text += f" where the arm stood still, {'give one id' if shares else 'average the rows'}"
        yield Statement("note", text, t.n_renamed and not t.n_copies)
        text = f"{t.name}: test rows at configurations of train rows, no check of a prediction: {t.n_leaked}"
        yield Statement("note", text, t.n_leaked)
    text = "is to be estimated: sigmas and accuracy here are for what is specified, or 1 mm and 1 mrad"
    yield Statement("note", f"noise {text}", job.options.estimate_noise)


CHECKS = (_check_setups, _check_result, _check_tables)
"""The checks of a job, in the order of their statements."""
