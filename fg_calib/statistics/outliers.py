"""Outliers: the few gross errors in a fit, found by their studentised residuals, and the fit without them.

One gross error in a table with many unknowns makes most residuals too large, for the fit follows it. So measurements
far from the others of their kind are left out, and everything is fitted and judged anew, those left out by how they are
predicted, until the same ones are far. Far is a studentised residual, over the typical size of its kind, beyond what
any of a clean table has (Sidak). A fit that outliers led far from the truth is not linear there, so the search begins
again at the nominal arm where the fit without them is not as expected. Noise that is estimated is estimated anew
without them: they are gross errors if its variance falls below half.

References:
    Hadi, Simonoff (1993), Procedures for the identification of multiple outliers in linear models. JASA 88(424).
"""

from dataclasses import replace

import numpy as np

from fg_calib import graph, inputs
from fg_calib.statistics.covariance import Spread, spread_of
from fg_calib.statistics.goodness_of_fit import FACTOR, Goodness, GrossErrors, chi_square, judge_fit
from fg_calib.statistics.residual_table import CHANCE, MAX_OUTLIER_SHARE, ResidualTable, residual_table, suspect_level
from fg_calib.statistics.variance_components import estimate_noise

MAX_ROWS = 20_000
"""Rows up to which outliers are looked for: among more, a few do little harm."""

MAX_ROUNDS = 10
"""How often the fit is made again."""

FINE = ("as specified", "too large", "unknown")
"""Verdicts of kinds without gross errors."""

_State = tuple[graph.Solution, Spread, ResidualTable]


def judge_without_outliers(solution: graph.Solution, table: ResidualTable, fit: Goodness) -> Goodness:
    """The goodness of a fit, by kind with its cause where a few outliers make it bad.

    Args:
        solution: The solution.
        table: Its residuals.
        fit: Its goodness of fit.
    """
    problem, fine = solution.problem, _is_fine(fit) and solution.estimated_noise is None
    if problem.state.weights is not None or fine or problem.evaluated or problem.has_more:
        return fit
    if np.sum(table.used) > MAX_ROWS:
        return replace(fit, searched=False)
    found = _fit_without_outliers(solution, table, fit)
    if found is None or not _is_fine(found[2]):  # the nominal arm may be nearer to the truth
        at_nominal = replace(solution, parameters=solution.before)
        state = at_nominal, spread_of(at_nominal), residual_table(at_nominal)
        other = _fit_without_outliers(solution, table, judge_fit(*state))
        found = other if other is not None and (found is None or _is_fine(other[2])) else found
    return fit if found is None else _combined(fit, table, *found)


def _is_fine(fit: Goodness) -> bool:
    return all(kind.verdict in FINE for kind in fit.kinds)


def _far(table: ResidualTable, fit: Goodness, least: float) -> inputs.Booleans:
    """Fitted rows of measurements that are far from the others of their kind, shape (n,).

    Where most of a configuration's measurements are, all of them are: its reading or its pose is wrong.

    Args:
        table: The residuals.
        fit: Their goodness of fit.
        least: Typical size of a kind's studentised residuals that is at least assumed.
    """
    typical = {(kind.table, kind.kind): max(kind.typical, least) for kind in fit.kinds}
    scale = np.array([typical.get(group, np.nan) for group in table.groups] or [np.nan])[table.group]
    with np.errstate(invalid="ignore"):
        far = table.used & (np.abs(fit.studentised) > scale * suspect_level(int(np.sum(table.used)), CHANCE))
    far = table.used & np.isin(table.measurement_number, table.measurement_number[far])
    n_far, n_used = (table.sum_by_end(rows) for rows in (far, table.used))
    wrong = np.append(2.0 * n_far > n_used, False)  # the last for rows without an end
    return far | table.used & (wrong[table.a] | wrong[table.b])


def _fit_without_outliers(
    solution: graph.Solution, table: ResidualTable, fit: Goodness
) -> tuple[inputs.Booleans, _State, Goodness] | None:
    """Rows left out, the fit without them, and its goodness; None without any, or where many are far.

    Args:
        solution: The solution.
        table: Its residuals.
        fit: The goodness of fit to begin with.
    """
    out, found = np.zeros(table.n, dtype=np.bool_), None
    least, solve_with = (1.0, graph.solve) if solution.estimated_noise is None else (0.0, estimate_noise)
    for _ in range(MAX_ROUNDS):
        far = _far(table, fit, least)
        if np.array_equal(far, out) or np.sum(far) > MAX_OUTLIER_SHARE * np.sum(table.used):
            break
        out = far
        if not out.any():
            return None
        try:
            again = solve_with(_without(solution, table, out))
        except inputs.SolverError:
            break
        now = (again, spread_of(again), residual_table(again))
        fit = judge_fit(*now)
        found = (out, now, fit)
    return found


def _without(solution: graph.Solution, table: ResidualTable, out: inputs.Booleans) -> graph.Problem:
    """The problem whose rows left out are predicted, not fitted; from where the arm is nominal."""
    data, blocks = solution.problem.data, []
    for number, s in enumerate(data.blocks):
        test = s.test.copy()
        test[table.measurement[out & (table.block == number)]] = True
        blocks.append(replace(s, test=test))
    return graph.with_factors(solution.problem, solution.before, data=replace(data, blocks=tuple(blocks)))


def _combined(fit: Goodness, table: ResidualTable, out: inputs.Booleans, now: _State, rest: Goodness) -> Goodness:
    """The fit with what the fit without the rows left out says of its kinds, and with the gross errors."""
    size = np.where(out, np.abs(rest.studentised), 0.0)
    wrong = {table.groups[code] for code in np.unique(table.group[size > rest.level])}
    fine = {(kind.table, kind.kind) for kind in rest.kinds if kind.verdict in ("as specified", "too large")}
    causes = {group: "outliers" if group in wrong else "others" for group in fine}
    kinds = tuple(replace(kind, cause=causes.get((kind.table, kind.kind), "")) for kind in fit.kinds)
    rows = np.flatnonzero(out)
    rows = rows[np.argsort(-size[rows], kind="stable")]
    n, chi2 = len(np.unique(table.measurement_number[rows])), chi_square(now[0], now[1])
    ratio = chi2.value / max(chi2.dof, 1)
    if now[0].estimated_noise is not None:
        factors = {(kind.table, kind.kind): kind.factor for kind in rest.kinds}
        ratio = min((factors.get((kind.table, kind.kind), np.inf) / kind.factor) ** 2 for kind in fit.kinds)
        if ratio > 1.0 / FACTOR:
            return fit
    return replace(fit, kinds=kinds, gross=GrossErrors(n, table.named(rows), ratio))
