"""Outliers: the few measurements that spoil a fit, found in the linearised problem, and the fit without them.

One wrong row of a table with many unknowns makes most residuals too large, for the fit gives way to it: how many are
too large says nothing. So measurements are left out, the worst first, until what is left fits. With e the residuals, C
the covariance of their noise and A their own (see `goodness_of_fit`), the fit without the rows S follows from this one:

    u = C^-1 e,  Q = C^-1 A C^-1;   chi-square falls by T = u_S^T Q_SS^-1 u_S,  u becomes u - Q_:S Q_SS^-1 u_S,
                                                                                Q becomes Q - Q_:S Q_SS^-1 Q_S:.

What is left out at once is a measurement, or all those of one configuration, whose reading may be wrong. The worst is
the one whose drop is least likely by chance, whatever the size of the noise: with Gaussian noise what is left of
chi-square, over what it was, has a beta distribution. After k of N, the k are taken for outliers if a drop as large by
any k of N (Bonferroni) is no chance, for the k for which that is least likely.

Far off as outliers are they may have led the fit where the problem is not linear, so the search goes on from the fit
without those found so far, or from the nominal arm. Measurements that this fit predicts well are no outliers.

References:
    Cook, Weisberg (1982), Residuals and Influence in Regression, section 2.2.
    Hadi, Simonoff (1993), Procedures for the identification of multiple outliers in linear models. JASA 88(424).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from fg_calib.graph import PRIVATE_SHARE, Problem, Solution, prior_rows, solve, with_factors
from fg_calib.inputs import Booleans, Floats, Integers, SolverError
from fg_calib.statistics.covariance import Spread, spread_of
from fg_calib.statistics.goodness_of_fit import Goodness, GrossErrors, RowStatistics, chi_square, judge_fit
from fg_calib.statistics.residual_covariance import RowErrors
from fg_calib.statistics.residual_table import CHANCE, MAX_OUTLIER_SHARE, ResidualTable, residual_table

MAX_ROWS = 3000
"""Rows up to which outliers are looked for: the inverse of their covariance is dense."""

MAX_UNIT = 200
"""Rows of one configuration up to which they may be one outlier."""

MAX_ROUNDS = 3
"""How often the fit is made again."""

BATCH_SHARE = 0.1
"""Part of those left out so far that is left out in one step: one by one at first."""

LEAST_INFORMATION = 1e-6
"""Part of a row's information below which the others say nothing of it: it is met whatever was measured."""

FINE = ("as stated", "too large", "unknown")
"""Verdicts of kinds that nothing spoils."""


def find_outliers(
    z: Floats,
    errors: RowErrors,
    tangent: Floats,
    units: Sequence[Integers],
    dof: float,
    priors: tuple[Floats, Floats],
) -> Booleans | None:
    """The few measurements that spoil a fit, shape (n,); None if there are none, or not few, or it is not known.

    Args:
        z: Residuals over the sigma of their noise, at the optimum or where the problem is linear, shape (n,).
        errors: What they follow from, over the same sigma.
        tangent: Covariance of the core, which goes with rows weighted by C^-1.
        units: Rows that may be left out together: of a measurement, of a configuration.
        dof: Degrees of freedom of rows and priors.
        priors: Whitened residuals of the core's priors there, and their derivatives.
    """
    if dof < 1.0:
        return None
    (r_prior, J_prior), T, J = priors, errors.of_all(tangent), errors.J
    J_prior = np.pad(J_prior, ((0, 0), (0, len(T) - len(tangent))))
    d = np.maximum(errors.private, PRIVATE_SHARE * errors.noise)
    W = np.linalg.inv((errors.L @ errors.L.T).toarray() + np.diag(d))
    step = -T @ (J.T @ (W @ z) + J_prior.T @ r_prior)  # to the optimum of the linearised problem
    e, WJ = z + J @ step, W @ J
    chi2 = float(e @ W @ e + np.sum((r_prior + J_prior @ step) ** 2))
    by_size = [np.array([unit for unit in units if len(unit) == size]) for size in sorted({len(u) for u in units})]
    least = [LEAST_INFORMATION * np.diag(W)[rows].mean(axis=1) for rows in by_size]
    return _search(W @ e, W - WJ @ T @ WJ.T, list(zip(by_size, least, strict=True)), chi2, dof)


def _search(u: Floats, Q: Floats, units: list[tuple[Integers, Floats]], chi2: float, dof: float) -> Booleans | None:
    """Rows left out, step by step, when the gain was least likely by chance, shape (n,).

    None if it may be chance, or if more should be left out than may be.

    Args:
        u: See the module's head, shape (n,).
        Q: See there, shape (n, n).
        units: Rows of units of one size, shape (n_units, size), and their least information, shape (n_units,).
        chi2: Chi-square with all of them.
        dof: Its degrees of freedom.
    """
    out, count, given, best, found = np.zeros(len(u), dtype=np.bool_), 0, (chi2, dof), float(np.log(CHANCE)), None
    n = sum(len(rows) for rows, _ in units)
    while True:
        new = np.zeros_like(out)
        for chance, unit in sorted(_chances(u, Q, units, chi2, dof))[: max(1, int(BATCH_SHARE * count))]:
            if chance < 0.0 and not new[unit].any() and not out[unit].all():
                new[unit], count = True, count + 1
        many = bool(np.sum(out | new) > MAX_OUTLIER_SHARE * len(out))
        if not new.any() or many:
            return None if many and found is out else found  # the last step was the best, and more are to follow
        chosen = np.flatnonzero(new & ~out)
        values, V = np.linalg.eigh(Q[np.ix_(chosen, chosen)])
        kept = values > LEAST_INFORMATION * float(np.mean(np.diag(Q)[chosen]))
        half = V[:, kept] / np.sqrt(values[kept])
        F, step, out = Q[:, chosen] @ half, half.T @ u[chosen], out | new
        u, Q = u - F @ step, Q - F @ F.T
        chi2, dof = max(chi2 - float(step @ step), 1e-12 * chi2), dof - float(kept.sum())
        ways = -float(special.betaln(count + 1, n - count + 1) + np.log(n + 1.0))  # log of how many to choose k of n
        chance = log_chance(chi2 / given[0], dof, given[1] - dof) + ways
        if chance < best:
            best, found = chance, out


def _chances(
    u: Floats, Q: Floats, units: list[tuple[Integers, Floats]], chi2: float, dof: float
) -> Iterator[tuple[float, list[int]]]:
    """Logarithm of the probability that leaving a unit out gains as much by chance, and its rows, unit by unit."""
    for of_size, least in units:
        values, V = np.linalg.eigh(Q[of_size[:, :, None], of_size[:, None, :]])
        kept = values > least[:, None]
        squares = np.where(kept, np.einsum("mij,mi->mj", V, u[of_size]) ** 2 / np.where(kept, values, 1.0), 0.0)
        for drop, rank, unit in zip(squares.sum(axis=1), kept.sum(axis=1).tolist(), of_size.tolist(), strict=True):
            if 0 < rank < dof and drop < chi2:
                yield log_chance(1.0 - drop / chi2, dof - rank, rank), unit


def log_chance(left: float, dof: float, m: float) -> float:
    """Logarithm of the probability that m unknowns more leave no more than a part of chi-square; at most a bound of it.

    The part has the beta distribution of (dof / 2, m / 2), whose density integrates to less than
    left^(dof / 2) / (dof / 2) / B(dof / 2, m / 2), for m = 1 times (1 - left)^(-1/2).

    Args:
        left: The part.
        dof: Degrees of freedom that are left.
        m: Unknowns more.
    """
    if m <= 0.0 or dof <= 0.0 or left >= 1.0:
        return 0.0
    a, b = 0.5 * dof, 0.5 * m
    bound = a * np.log(max(left, 1e-300)) - np.log(a) - special.betaln(a, b) + min(b - 1.0, 0.0) * np.log1p(-left)
    return min(float(bound), 0.0)


def judge_without_outliers(solution: Solution, spread: Spread, table: ResidualTable, fit: Goodness) -> Goodness:
    """The goodness of a fit, by kind with that of the fit without outliers where a few spoil it.

    Args:
        solution: The solution.
        spread: Its covariance.
        table: Its residuals.
        fit: Its goodness of fit.
    """
    robust = solution.problem.state.weights is not None or solution.estimated_noise is not None
    if robust or _is_fine(fit) or solution.problem.evaluated or solution.problem.has_more:
        return fit
    if np.sum(table.used) > MAX_ROWS:
        return replace(fit, searched=False)
    found = _fit_without_outliers(solution, table, (solution, spread, table))
    if found is None or not _is_fine(found[2]):  # the nominal arm is nearer to the truth than a fit that went astray
        nominal = replace(solution, parameters=solution.before)
        other = _fit_without_outliers(solution, table, (nominal, spread_of(nominal), residual_table(nominal)))
        found = other if other is not None and (found is None or _is_fine(other[2])) else found
    return fit if found is None else _combined(fit, table, *found)


_State = tuple[Solution, Spread, ResidualTable]


def _is_fine(fit: Goodness) -> bool:
    return all(kind.verdict in FINE for kind in fit.kinds)


def _outlier_rows(state: _State) -> Booleans | None:
    """Rows of a table that spoil a fit, shape (n,); None if there are none, or it is not known."""
    solution, spread, table = state
    problem, statistics = solution.problem, RowStatistics(*state)
    rows, errors = statistics.fitted.rows, statistics.errors
    if errors is None:
        return None
    dof = problem.n_independent + problem.n_priors + problem.n_added + problem.n_known
    dof -= spread.rank + errors.J.shape[1] - len(spread.tangent)
    z, priors = table.after[rows] / table.sigma[rows], prior_rows(problem.variables, solution.parameters)
    found = find_outliers(z, errors, spread.tangent, _units(table, rows), dof, priors)
    if found is None:
        return None
    out = np.zeros(table.n, dtype=np.bool_)
    out[rows[found]] = True
    return out


def _units(table: ResidualTable, rows: Integers) -> list[Integers]:
    """Places among the fitted rows of what may be one outlier: a measurement, all of one configuration."""
    _, of = np.unique(table.measurement_number[rows], return_inverse=True)
    place, end = table.row_ends(rows)
    most = min(MAX_UNIT, MAX_OUTLIER_SHARE * len(rows))
    several = (np.unique(unit) for unit in _grouped(place, end) if len(unit) <= most)
    return [*_grouped(np.arange(len(rows)), of), *(unit for unit in several if len(np.unique(of[unit])) > 1)]


def _grouped(values: Integers, key: Integers) -> list[Integers]:
    """Values with the same key together, shape (n,) each."""
    order = np.argsort(key, kind="stable")
    return np.split(values[order], np.flatnonzero(np.diff(key[order])) + 1)


def _fit_without_outliers(
    solution: Solution, table: ResidualTable, now: _State
) -> tuple[Booleans, _State, Goodness] | None:
    """Rows left out, the fit without them, and its goodness; None without any.

    Args:
        solution: The solution.
        table: Its residuals.
        now: Where the problem is linearised at first.
    """
    out, best = np.zeros(table.n, dtype=np.bool_), None
    for _ in range(MAX_ROUNDS):
        more = _outlier_rows(now)
        if more is None or np.sum(out | more) > MAX_OUTLIER_SHARE * np.sum(table.used):
            break
        out = out | more
        try:
            again = solve(_without(solution, table, out))
        except SolverError:
            break
        now = (again, spread_of(again), residual_table(again))
        rest, number = judge_fit(*now), table.measurement_number
        with np.errstate(invalid="ignore"):  # those are no outliers that the fit without them predicts
            out = out & np.isin(number, number[out & (np.abs(rest.studentised) > rest.level)])
        if not out.any():
            break
        best = (out, now, rest)
        if _is_fine(rest):
            break
    return best


def _without(solution: Solution, table: ResidualTable, out: Booleans) -> Problem:
    """The problem whose rows left out are predicted, not fitted; from where the arm is nominal."""
    data, blocks = solution.problem.data, []
    for number, s in enumerate(data.series):
        test = s.test.copy()
        test[table.measurement[out & (table.series == number)]] = True
        blocks.append(replace(s, test=test))
    return with_factors(solution.problem, solution.before, data=replace(data, series=tuple(blocks)))


def _combined(fit: Goodness, table: ResidualTable, out: Booleans, now: _State, rest: Goodness) -> Goodness:
    """The fit's kinds with those of the fit without the rows left out."""
    size = np.where(out, np.abs(rest.studentised), 0.0)
    wrong = {table.groups[code] for code in np.unique(table.group[size > rest.level])}
    left = {(kind.table, kind.kind): kind for kind in rest.kinds}
    kinds = tuple(
        replace(kind, rest=left.get((kind.table, kind.kind)), spoilt=(kind.table, kind.kind) in wrong)
        for kind in fit.kinds
    )
    rows = np.flatnonzero(out)
    rows, names = rows[np.argsort(-size[rows], kind="stable")], ("", *table.names)
    ends = dict.fromkeys((names[table.a[i] + 1], names[table.b[i] + 1]) for i in rows)
    n, chi2 = len(np.unique(table.measurement_number[rows])), chi_square(now[0], now[1])
    return replace(fit, kinds=kinds, gross=GrossErrors(n, _names(list(ends)), chi2.value / max(chi2.dof, 1)))


def _names(ends: list[tuple[str, str]]) -> tuple[str, ...]:
    """Names of measurements by what they are between: one that is an end of several is named in their place."""
    found = []
    while ends:
        count = Counter(name for both in ends for name in filter(None, both))
        worst = max(count, key=lambda name: count[name])
        if count[worst] > 1:
            found.append(worst)
            ends = [both for both in ends if worst not in both]
        else:
            found.append(" and ".join(filter(None, ends.pop(0))))
    return tuple(found)
