"""Cross-validation: every configuration held out once, and how much the estimate depends on which are there.

Configurations are divided into folds, never rows, and those of the same readings together: they share joint noise and
unmodelled effects, so that a row left in would tell of one left out. Each fold is predicted by a calibration of all
others. Configurations that see the same landmark or station are spread over different folds; where too few would be
left to locate it, and where a configuration is an end of most measured pairs, they are never held out.

With the estimate e_k of the calibration without fold k of g, the *spread* of a parameter is its jackknife over groups

    sqrt((g - 1) / g sum_k (e_k - mean e)^2),

which is its sigma where measurements determine it and the noise is as specified, known to a share of
1 / sqrt(2 (g - 1)). It is less where priors determine it, and more where unmodelled effects do not average out. Of
pairs it is 1.4 to 1.7 times as large: measured ones leave with either end, formed ones are formed anew.

A limit is judged by the RMS error of the calibrated arm at test rows, which the estimate never saw, or else at those
held out. It contains the noise of the measurements themselves: an error within the limit is within it all the more
without that noise; an error beyond the limit that would be within it without the specified noise says nothing.

References:
    Shao & Tu (1995), The Jackknife and Bootstrap, section 2.3: the jackknife that deletes groups.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import fields, replace
from functools import partial
from typing import Literal

import numpy as np
from pydantic import computed_field
from scipy import special

from fg_calib import graph, inputs, parallel, robot
from fg_calib.inputs import Figure, Floats, FrozenArrays, InputError, Integers, Limits, ProblemError, Record, checked
from fg_calib.job import Job
from fg_calib.measurements import LANDMARKS, Dataset, Labels, Table
from fg_calib.statistics.residual_table import MAX_OUTLIER_SHARE, HeldOut, pooled, residual_table, same_readings

Verdict = Literal["pass", "fail", "not evaluated"]

LEAST = 5
"""Measurements that must have been held out for a limit to be judged by them."""

NAMED = 10
"""Outliers that are named."""

CHANCE = 1e-3
"""Probability with which noise as specified alone makes the spread of any parameter worth naming."""

REFERENCE_SHARE = 0.5
"""Share of the measured pairs from which on a configuration that is in them is never held out."""

NEEDED = {"station": 3} | {kind.name: kind.n_configurations for kind in LANDMARKS.values()}
"""Configurations that must be left of those that see an anchor, a station, ...: fewer do not locate it."""


class CrossValidation(FrozenArrays):
    """Result of a cross-validation.

    Attributes:
        n: Number of folds.
        fold: Of each configuration that is fitted, -1 where it is never held out, shape (n_configurations,).
        by_table: Held-out residuals by table and kind.
        kinds: Held-out residuals by kind.
        of_pairs: Whether pairs take part, whose spread is larger than their sigma.
        spread: Jackknife of every parameter of the robot, by name, [m] and [rad].
        not_converged: Number of folds without which the solver did not converge.
    """

    n: int
    fold: Integers
    by_table: tuple[HeldOut, ...]
    kinds: dict[str, HeldOut]
    of_pairs: bool
    spread: dict[str, Figure]
    not_converged: int

    def beyond(self, sigma: Mapping[str, float | None]) -> tuple[dict[str, float], list[str]]:
        """Spread over sigma of each parameter that has one, and the parameters where it is not that large by chance.

        Args:
            sigma: 1 sigma of parameters by name; None where it is not known.
        """
        ratio = {name: self.spread[name] / s for name, s in sigma.items() if s}
        return ratio, [] if self.of_pairs else wide(ratio, self.n)


def wide(ratio: Mapping[str, float], n: int) -> list[str]:
    """Parameters whose spread over sigma is larger than chance makes it, the largest first.

    Args:
        ratio: Spread over sigma by name.
        n: Number of folds.
    """
    most = np.sqrt(special.chdtri(n - 1, CHANCE / max(len(ratio), 1)) / (n - 1))
    return sorted((name for name in ratio if ratio[name] > most), key=lambda name: -ratio[name])


@checked
def cross_validate(
    job: Job, solve: Callable[[Job], graph.Solution], n: int = 5, *, executor: Executor | None = None
) -> CrossValidation:
    """Hold every configuration out once, and calibrate without it.

    Args:
        job: The job; its test rows take no part.
        solve: Calibrates a job; other processes must be able to import it.
        n: Number of folds; as many as configurations leave one out at a time.
        executor: Where the folds are calibrated; one after the other in this process if None.

    Raises:
        InputError: There are more folds than configurations to hold out.
        ProblemError: The measurements of all but one fold do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    inputs.check_number("folds", n, least=2, whole=True)
    for table in job.tables:
        inputs.expect(not table.own, "folds", f"custom measurements in {table.measurements.source}", "tables without")
    tables = tuple(_train_tables(job.tables))
    inputs.expect(tables, "folds", "test rows alone", "rows to calibrate with, and to hold out")
    whole = replace(job, measurements=tables)
    data = graph.problem_of(whole).data  # whose tables are those of one station each
    fold = _divided(data, n, np.random.default_rng(0))
    if len(np.unique(fold[fold >= 0])) < n:
        raise InputError("folds", f"found {n}", f"at most {np.sum(fold >= 0)}: so many configurations can be held out")
    tables_of = list(zip(data.tables, data.places, strict=True))
    without = [tuple(_without_fold(table, fold[place], k) for table, place in tables_of) for k in range(n)]
    names = [f"without fold {k + 1} of {n}" for k in range(n)]
    jobs = [replace(whole, measurements=tables) for tables in without]
    found = []
    for one in parallel.map_jobs(partial(_calibrated, solve=solve), jobs, executor, names=names):
        if isinstance(one, parallel.Failure):
            raise RuntimeError(one.trace) if one.trace else ProblemError("folds", f"{one.job}: {one.reason}")
        found.append(one)
    estimates, held, converged = zip(*found, strict=True)
    parts: dict[tuple[str, str], list[HeldOut]] = {}
    for one in (one for of_fold in held for one in of_fold):
        parts.setdefault((one.table, one.kind), []).append(one)
    by_table = tuple(pooled(some, table) for (table, _), some in parts.items())
    jackknife = np.sqrt((n - 1) * np.var(estimates, axis=0)).tolist()
    kinds = {kind: pooled([one for one in by_table if one.kind == kind]) for _, kind in parts}
    of_pairs = any(table.uses_pairs for table in data.tables)
    spread = {p.name: s for p, s in zip(job.robot.parameters, jackknife, strict=True)}
    return CrossValidation(n, fold, by_table, kinds, of_pairs, spread, n - sum(converged))


def _calibrated(job: Job, solve: Callable[[Job], graph.Solution]) -> tuple[Floats, tuple[HeldOut, ...], bool]:
    """The robot's parameters without a fold, the held-out residuals, and whether the solver converged."""
    solution = solve(job)
    problem = solution.problem
    held_out = residual_table(solution).held_out(problem.data.labels)
    return solution.parameters[problem.variables.robot_span], held_out, solution.converged


def _train_tables(tables: Sequence[Table]) -> Iterator[Table]:
    """Tables without their test rows; those that have no others are left out."""
    for table in tables:
        m, pairs, groups = table.measurements, table.measurements.pairs, table.measurements.groups
        rows, place = np.flatnonzero(~m.test), np.cumsum(~m.test) - 1
        if pairs is not None:
            pairs = pairs.select(~(pairs.test | m.test[pairs.a] | m.test[pairs.b]))
            pairs = replace(pairs, a=place[pairs.a], b=place[pairs.b])
        if groups is not None:
            groups = replace(groups, index=groups.index[rows], pairs=groups.pairs.select(~groups.pairs.test))
        if len(rows):
            yield replace(table, measurements=replace(m.select(rows), pairs=pairs, groups=groups))


def _without_fold(table: Table, fold: Integers, k: int) -> Table:
    """A table with the rows of fold k to be predicted; measured pairs that they are in leave with them.

    A pair between two folds is left out with either, and predicted with the first.

    Args:
        table: The table.
        fold: Of its configurations, shape (n_configurations,).
        k: The fold.
    """
    m, pairs = table.measurements, table.measurements.pairs
    if pairs is not None:
        a, b = fold[pairs.a], fold[pairs.b]
        touches, predicted = (a == k) | (b == k), np.where(a >= 0, a, b) == k
        pairs = replace(pairs, test=touches).select(~touches | predicted)
    return replace(table, measurements=replace(m, test=fold == k, pairs=pairs))


def _divided(data: Dataset, n: int, rng: np.random.Generator) -> Integers:
    """The fold of each configuration, -1 where it is never held out, shape (n_configurations,).

    Sets of equal readings, those that see the same landmarks one after the other, go to the folds in turn.
    """
    observers, place = list(_observers(data)), same_readings(data.readings)
    n_sets = int(place.max(initial=-1)) + 1
    landmarks: list[list[int]] = [[] for _ in range(n_sets)]
    for label, (configurations, _) in enumerate(observers):
        for k in np.unique(place[configurations]).tolist():
            landmarks[k].append(label)
    fold = np.empty(n_sets, dtype=np.int64)
    fold[sorted(rng.permutation(n_sets).tolist(), key=lambda k: landmarks[k])] = np.arange(n_sets) % n
    found = fold[place]
    for configurations, needed in observers:
        if len(configurations) - np.bincount(found[configurations] + 1, minlength=n + 1)[1:].max() < needed:
            found[np.isin(place, place[configurations])] = -1
    return found


def _observers(data: Dataset) -> Iterator[tuple[list[int], int]]:
    """The configurations that see each landmark or station, and how many of them are needed.

    The reference pose of measured pairs is one that is needed itself.
    """
    by_name: dict[tuple[str, str], list[int]] = {}
    for number, (table, place) in enumerate(zip(data.tables, data.places, strict=True)):
        m = table.measurements
        if table.unknown_frame:
            by_name["station", str(number)] = place.tolist()
        if m.pairs is not None and m.pairs.n_pairs > 1:
            n = np.bincount(place[np.concatenate([m.pairs.a, m.pairs.b])])
            reference = np.flatnonzero(n > REFERENCE_SHARE * m.pairs.n_pairs).tolist()
            by_name |= {("reference", str(k)): [k] for k in reference}
        groups = {} if m.groups is None else {"group": Labels(m.groups.names, m.groups.index)}
        for kind, labels in {**m.labels, **groups}.items():
            for i, name in enumerate(labels.names):
                by_name.setdefault((kind, name), []).extend(place[labels.index == i].tolist())
    for (kind, _), configurations in by_name.items():
        yield sorted(set(configurations)), NEEDED.get(kind, 1)


class Judgement(Record):
    """One limit, and what the held-out rows say of it.

    Attributes:
        kind: Limited quantity: `position`, `orientation`, `distance` or `angle`.
        limit: Its value, [m] or [rad].
        error: RMS error of the calibrated arm at the held-out rows; None without any.
        noise: RMS of the specified noise of these rows.
        n: Number of measurements held out.
        verdict: Whether the arm keeps to it.
        reason: Why that was not evaluated; outliers, where it failed; which arm it was that passed, if not the
            calibrated one.
        table: Name of the table; empty where there is one alone.
    """

    kind: str
    limit: float
    error: float | None
    noise: float | None
    n: int
    verdict: Verdict
    reason: str = ""
    table: str = ""


class Acceptance(Record):
    """Outcome of all limits.

    Attributes:
        judgements: Limit by limit.
    """

    judgements: tuple[Judgement, ...]

    @computed_field  # type: ignore[prop-decorator]
    @property
    def verdict(self) -> Verdict:
        """`pass` where all limits are kept, `fail` where one is not."""
        found = [one.verdict for one in self.judgements]
        return "fail" if "fail" in found else "not evaluated" if "not evaluated" in found else "pass"


def accept(
    limits: Limits, held_out: Sequence[HeldOut], findings: Sequence[str], tool: Mapping[str, float | None]
) -> Acceptance | None:
    """Judge the limits of a job by what was held out; None without limits.

    Tables with enough rows are judged one by one: many rows of one do not make up for those of another. Where none has
    enough, all together are.

    Args:
        limits: The limits.
        held_out: Measurements held out, by table and kind: test rows, or those of cross-validation.
        findings: Why the result is not to be trusted: it then passes nothing.
        tool: Expected error of the tool, `position` [m] and `orientation` [rad].
    """
    judged = []
    for kind, limit in ((f.name, getattr(limits, f.name)) for f in fields(limits)):
        if limit is not None:
            parts = [held for held in held_out if held.kind == kind]
            enough = [held for held in parts if held.n >= LEAST] or ([pooled(parts)] if parts else [])
            judged += [_judge(kind, limit, held, findings, tool.get(kind)) for held in enough or (None,)]
    return Acceptance(tuple(judged)) if judged else None


def _judge(kind: str, limit: float, held: HeldOut | None, findings: Sequence[str], tool: float | None) -> Judgement:
    if held is None:
        return Judgement(kind, limit, None, None, 0, "not evaluated", f"no measurement of any {kind} was held out")

    exceeds, scale = held.after > limit, robot.SCALES["m" if kind == "position" else "rad"]
    expected = f"{scale.factor * (tool or 0.0):.3g} {scale.unit}"
    doubts = {
        f"fewer than {LEAST} were held out": held.n < LEAST,
        "frame, base or tool were fitted to these rows, which are too few for that": held.few,
        "the noise of the measurements hides it": exceeds and held.after**2 - held.noise**2 <= limit**2,
        f"{held.by} misses it: mark some rows as test": exceeds and bool(held.by),
        "within the limit, but the result is not to be trusted": not exceeds and bool(findings),
        f"within the limit, but the tool itself is expected to be off by {expected}: measure it (of targets make one"
        " the tool: leave its `target` empty; or state the places of two)": not exceeds and (tool or 0.0) > limit,
        "the error is not known": not np.isfinite(held.after),
    }
    verdict: Verdict = "not evaluated" if any(doubts.values()) else "fail" if exceeds else "pass"
    explained = f"new rows, by {held.by}" if held.by else ""
    if verdict == "fail" and 0 < len(held.outliers) <= MAX_OUTLIER_SHARE * held.n:
        more = len(held.outliers) - NAMED
        named = ", ".join(held.outliers[:NAMED]) + f" and {more} more" * (more > 0)
        explained = f"outliers among them, which count here: {named}; look at them"
    reason = next((doubt for doubt, applies in doubts.items() if applies), explained)
    return Judgement(kind, limit, held.after, held.noise, held.n, verdict, reason, held.table)
