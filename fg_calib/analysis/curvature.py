"""Whether rows are linear within what the parameters may still be off: covariances hold only there.

Where few rows of little noise leave directions to wide tolerances, the rows bend along them by more than their noise.
The true arm is then on a bent surface, and the covariance on its tangent plane: along directions that the rows
determine well they are apart by `g`, many sigma. With the rows linearised at `x + d`, one draw d away from the
estimate x, the optimum seems to be `g` from x, to second order in d: that needs no second derivatives. What is odd in d
(residuals times how derivatives change, and third orders) cancels between d and -d.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.covariance import Spread
from fg_calib.errors import SolverError
from fg_calib.graph.linearised import Linearised
from fg_calib.graph.problem import some_rows, started_at
from fg_calib.graph.solver import Solution

Floats = NDArray[np.float64]

ENOUGH_ROWS = 5_000
"""Residuals that suffice: of more, so many are drawn evenly where that is possible."""

NONE = 0.01
"""What a single draw finds, below which there is none."""

N_DRAWS = 8
"""Draws by which it is measured where there is some, each with its opposite."""


def beyond_linear(solution: Solution, spread: Spread) -> float:
    """By how much the mean square of an estimate's error, in sigma, exceeds one a direction because rows bend.

    Returns:
        0 for linear rows; infinite where they cannot be linearised a sigma away.
    """
    problem, n_columns, rank = solution.problem, spread.variables.n_columns, spread.rank
    if not rank:
        return 0.0
    if problem.n_residuals > ENOUGH_ROWS:
        problem = some_rows(started_at(problem, solution.parameters), ENOUGH_ROWS / problem.n_residuals) or problem
    scales, rng = spread.variables.prior_scales, np.random.default_rng(0)
    root = spread.root[:, :rank]
    scaled = root / scales[:, None]
    in_sigma = (scaled / np.sum(scaled**2, axis=0)).T / scales  # the inverse of `root`, whose columns are orthogonal
    here = Linearised(problem, problem.variables.values(solution.parameters))

    def apart(draw: Floats) -> float:
        """Square of how far the optimum seems to be from the estimate, seen from a draw away, by direction, [sigma]."""
        core = root @ draw
        step = np.concatenate([core, here.follow @ core])
        both = [Linearised(problem, problem.variables.moved(here.values, move)).step for move in (step, -step)]
        g = in_sigma @ (0.5 * (both[0] + both[1]) - here.step)[:n_columns]
        return float(g @ g) / rank

    try:
        if apart(rng.choice([-1.0, 1.0], rank)) < NONE:
            return 0.0
        return float(np.mean([apart(draw) for draw in rng.normal(size=(N_DRAWS, rank))]))
    except SolverError:
        return np.inf
