"""Whether instruments that measure lengths to anchors add something to every length that the job does not estimate.

Such an offset hides in the arm's parameters: 0.25 mm of a ball bar made residuals 1.1 times as large as stated. Its
column is added to the linearised fit, and what it gains is judged by an F test, whatever the size of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from fg_calib.diagnostics.unmodelled_effects import MAX_ROWS, linear_fit
from fg_calib.graph.problem import at_parameters
from fg_calib.graph.solver import Solution

CERTAIN = 1e-5
"""Probability below which an offset is no chance: arms that are not quite their model mimic a little of one."""


@dataclass(frozen=True)
class Offset:
    """What an instrument seems to add to every length.

    Attributes:
        table: Number of its table.
        size: How much, [m].
        sigma: Its 1 sigma, the noise as it was seen, [m].
    """

    table: int
    size: float
    sigma: float


def forgotten_offsets(solution: Solution) -> tuple[Offset, ...]:
    """Offsets that were not estimated and are no chance; none of more rows than `MAX_ROWS`.

    With a robust loss, which cuts residuals off, noise counts as stated at least.
    """
    problem = solution.problem
    tables = [k for k, table in enumerate(problem.data.tables) if table.model == "anchor" and not table.offset]
    if not tables or problem.n_residuals > MAX_ROWS or problem.has_more:
        return ()
    at, found = at_parameters(problem, solution.parameters), []
    column = at.n_columns + at.n_nuisance
    for number in tables:
        series = [s for s in problem.data.series if s.table == number and s.kind.n_nuisances == 4 and len(s.train)]
        if not series:
            continue  # contacts alone
        columns = at.columns.copy()
        columns[np.unique(series[0].nuisances[:, 3])] = column
        fit = linear_fit(solution, replace(at, columns=columns, n_nuisance=at.n_nuisance + 1), [column])
        new = fit.new([column])
        if not new.shape[1] or fit.dof < 2:
            continue
        along, left = float(new[:, 0] @ fit.r), float(fit.r @ fit.r)
        least = 1e-300 if problem.state.weights is None else 1.0
        variance = max((left - along**2) / (fit.dof - 1), least)
        if special.fdtrc(1, fit.dof - 1, along**2 / variance) < CERTAIN:
            per_metre = float(new[: len(fit.J), 0] @ fit.J[:, column])
            found.append(Offset(number, -along / per_metre, float(np.sqrt(variance)) / abs(per_metre)))
    return tuple(found)
