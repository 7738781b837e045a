"""Goodness of fit where a few gross errors spoil it: the fit is made again without them.

Which they are is found in the linearised problem (`gross_errors`); far off as they are they may have led the fit where
the problem is not linear, so the search goes on from the fit without those found so far. Measurements that this fit
predicts well after all are none.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import SolverError
from fg_calib.graph.problem import Problem, assembled
from fg_calib.graph.solver import Solution, solve
from fg_calib.statistics.covariance import Spread, spread_of
from fg_calib.statistics.goodness_of_fit import Goodness, GrossErrors, chi_square, gross_errors, judge_fit
from fg_calib.statistics.gross_errors import MOST_FEW
from fg_calib.statistics.residual_table import ResidualTable, residual_table

Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

MAX_ROWS = 20_000
"""Rows up to which gross errors are looked for: of more, few of them spoil little."""

ROUNDS = 3
"""How often the fit is made again."""

FINE = ("as stated", "too large", "unknown")
"""Verdicts of kinds that nothing spoils."""


def judged_without_gross_errors(solution: Solution, spread: Spread, table: ResidualTable, fit: Goodness) -> Goodness:
    """The goodness of a fit, by kind beside that of the fit without gross errors where a few spoil it.

    Args:
        solution: The solution.
        spread: Its covariance.
        table: Its residuals.
        fit: Its goodness of fit.
    """
    robust = solution.problem.state.weights is not None or solution.estimated_noise is not None
    spoilt = any(kind.verdict not in FINE for kind in fit.kinds)
    if robust or not spoilt or solution.problem.evaluated or solution.problem.has_more or table.n > MAX_ROWS:
        return fit
    found = _fit_without(solution, table, (solution, spread, table))
    if found is None or not _fits(found[2]):
        # The arm as drawn is nearer to the truth than a fit that went far astray.
        drawn = replace(solution, parameters=solution.before, values=solution.problem.variables.values(solution.before))
        at_drawn = _fit_without(solution, table, (drawn, spread_of(drawn), residual_table(drawn)))
        found = at_drawn if at_drawn is not None and (found is None or _fits(at_drawn[2])) else found
    return fit if found is None else _beside(fit, table, *found)


_State = tuple[Solution, Spread, ResidualTable]


def _fits(fit: Goodness) -> bool:
    return all(kind.verdict in FINE for kind in fit.kinds)


def _fit_without(solution: Solution, table: ResidualTable, now: _State) -> tuple[Booleans, _State, Goodness] | None:
    """Rows left out, the fit without them, and its goodness; None without any.

    Args:
        solution: The solution.
        table: Its residuals.
        now: Where the problem is linearised at first.
    """
    out, best = np.zeros(table.n, dtype=np.bool_), None
    for _ in range(ROUNDS):
        more = gross_errors(*now)
        if more is None or np.sum(out | more) > MOST_FEW * np.sum(table.used):
            break
        out = out | more
        try:
            again = solve(_without(solution, table, out))
        except SolverError:
            break
        now = (again, spread_of(again), residual_table(again))
        rest = judge_fit(*now)
        out = _missed(table, out, rest)
        if not out.any():
            break
        best = (out, now, rest)
        if _fits(rest):
            break
    return best


def _without(solution: Solution, table: ResidualTable, out: Booleans) -> Problem:
    """The problem whose rows left out are predicted, not fitted; from where the arm is nominal."""
    data, series = solution.problem.data, []
    for number, s in enumerate(solution.problem.data.series):
        test = s.test.copy()
        test[table.measurement[out & (table.series == number)]] = True
        series.append(replace(s, test=test))
    return assembled(solution.problem, solution.before, data=replace(data, series=tuple(series)))


def _missed(table: ResidualTable, out: Booleans, rest: Goodness) -> Booleans:
    """Those of the rows left out whose measurements the fit without them does not predict."""
    number = _measurement(table)
    with np.errstate(invalid="ignore"):
        missed = np.unique(number[out & (np.abs(rest.studentised) > rest.level)])
    return out & np.isin(number, missed)


def _beside(fit: Goodness, table: ResidualTable, out: Booleans, now: _State, rest: Goodness) -> Goodness:
    """The fit's kinds with those of the fit without the rows left out."""
    size = np.where(out, np.abs(rest.studentised), 0.0)
    wrong = {table.groups[code] for code in np.unique(table.group[size > rest.level])}
    left = {(kind.table, kind.kind): kind for kind in rest.kinds}
    kinds = tuple(
        replace(kind, rest=left.get((kind.table, kind.kind)), spoilt=(kind.table, kind.kind) in wrong)
        for kind in fit.kinds
    )
    rows = np.flatnonzero(out)
    rows = rows[np.argsort(-size[rows], kind="stable")]
    names = ("", *table.names)
    ends = dict.fromkeys((names[table.a[i] + 1], names[table.b[i] + 1]) for i in rows)
    n = len(np.unique(_measurement(table)[rows]))
    chi2 = chi_square(now[0], now[1])
    return replace(fit, kinds=kinds, gross=GrossErrors(n, _names(list(ends)), chi2.value / max(chi2.dof, 1)))


def _names(ends: list[tuple[str, str]]) -> tuple[str, ...]:
    """Names of measurements by what they are between: one that is an end of several is named in their place."""
    found = []
    while ends:
        count = Counter(name for both in ends for name in filter(None, both))
        worst = max(count, key=lambda name: count[name])
        alone = worst if count[worst] > 1 else " and ".join(filter(None, ends[0]))
        found.append(alone)
        ends = [both for both in ends if worst not in both] if count[worst] > 1 else ends[1:]
    return tuple(found)


def _measurement(table: ResidualTable) -> Integers:
    """A number for the measurement of each row, shape (n,)."""
    out: Integers = table.series.astype(np.int64) * 2**32 + table.measurement
    return out
