"""Whether rows are linear within what the parameters may still be off: covariances hold only there.

Where precise rows leave directions to wide tolerances, the rows bend along them by more than their noise. The true arm
is then on a bent surface, and the covariance on its tangent plane. With the rows linearised at `x + d`, a draw d of the
covariance away from the estimate x, their optimum seems to be at `x + c`, c = J^+ q, where q is what they are beyond
linear there: so to second order in d, and without second derivatives. What is odd in d (residuals times how derivatives
change, and third orders) cancels between d and -d. The arm that explains the rows as well as x + d does were they
linear is at `x + d - c`.

Along directions that the rows determine well c may be many sigma although all that the rows see of the arm at
`x + d - c`, and what single parameters are off, is as the covariance says: then only sums of parameters are affected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import SolverError
from fg_calib.graph.linearised import Linearised
from fg_calib.graph.problem import some_rows, started_at
from fg_calib.graph.solver import Solution
from fg_calib.prediction.expected_error import without_rigid_motion
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import forward
from fg_calib.robot.rotations import nearest_rotation
from fg_calib.statistics.covariance import Spread

Floats = NDArray[np.float64]

ENOUGH_ROWS = 5_000
"""Residuals that suffice: of more, so many are drawn evenly where that is possible."""

NONE = 0.01
"""Mean square that single draws find, below which there is none."""

N_DRAWS = 16
"""Draws by which it is measured where there is some, each with its opposite."""

N_CONFIGURATIONS = 100
"""Random configurations at which the tool is looked at."""


@dataclass(frozen=True)
class Curvature:
    """By how much mean squares of errors exceed what the covariance says because rows bend: 0 for linear ones.

    Attributes:
        sums: Of the estimate along all directions that are determined, in sigma, a direction.
        parameter: Of the parameter of which it is most, of the robot or of a frame's pose.
        tool: Of the tool's position after the best rigid fit.
        name: The parameter's; empty for one of a frame.
    """

    sums: float = 0.0
    parameter: float = 0.0
    tool: float = 0.0
    name: str = ""


def beyond_linear(solution: Solution, spread: Spread) -> Curvature:
    """What rows that bend make of a solution's errors; infinite where they cannot be linearised a sigma away."""
    problem, n_columns, rank = solution.problem, spread.variables.n_columns, spread.rank
    if not rank:
        return Curvature()
    if problem.n_residuals > ENOUGH_ROWS:
        problem = some_rows(started_at(problem, solution.parameters), ENOUGH_ROWS / problem.n_residuals) or problem
    scales, rng = spread.variables.prior_scales, np.random.default_rng(0)
    root = spread.root[:, :rank]
    scaled = root / scales[:, None]
    in_sigma = (scaled / np.sum(scaled**2, axis=0)).T / scales  # the inverse of `root`, whose columns are orthogonal
    here = Linearised(problem, problem.variables.values(solution.parameters))

    def moved(draw: Floats) -> Floats:
        """The shift c by a draw and its opposite, shape (n_columns,)."""
        core = root @ draw
        step = np.concatenate([core, here.follow @ core])
        both = [Linearised(problem, problem.variables.moved(here.values, move)).step for move in (step, -step)]
        out: Floats = (0.5 * (both[0] + both[1]) - here.step)[:n_columns]
        return out

    try:
        looked = [in_sigma @ moved(rng.choice([-1.0, 1.0], rank)) for _ in range(2)]  # one may cancel by chance
        if np.max(np.sum(np.square(looked), axis=1)) < NONE * rank:
            return Curvature()
        draws = rng.normal(size=(N_DRAWS, rank))
        c = np.array([moved(draw) for draw in draws])
    except SolverError:
        return Curvature(np.inf, np.inf, np.inf)
    named = np.nan_to_num(spread.variables.named_derivative(solution.parameters))
    variance = np.sum((named @ root) ** 2, axis=1)
    of_each = np.divide(np.mean((c @ named.T) ** 2, axis=0), variance, out=np.zeros(n_columns), where=variance > 0.0)
    worst, names = int(np.argmax(of_each)), spread.variables.names
    return Curvature(
        sums=float(np.mean((c @ in_sigma.T) ** 2)),
        parameter=float(of_each[worst]),
        tool=_of_tool(solution, draws @ root.T, c),
        name=names[worst] if worst < len(names) else "",
    )


def _of_tool(solution: Solution, d: Floats, c: Floats) -> float:
    """`Curvature.tool`: the tool at arms `x + d - c` and `x - d - c`, over what it does where all is linear."""
    robot, variables = solution.problem.robot, solution.problem.variables
    trig = robot.trig(random_readings(robot, N_CONFIGURATIONS, np.random.default_rng(1)))

    def tool(step: Floats) -> Floats:
        at = variables.chains[0].at(variables.stepped(solution.parameters, step)).without_columns()
        return forward(at, trig).position

    p = tool(np.zeros(d.shape[1]))
    linear = np.stack([0.5 * (tool(step) - tool(-step)) for step in d], axis=2)
    expected = float(np.mean(without_rigid_motion(p, linear)[0] ** 2))
    bent = [_fitted(tool(move), p) for step, off in zip(d, c, strict=True) for move in (step - off, -step - off)]
    return float(np.mean(np.square(bent)) / expected) - 1.0 if expected > 0.0 else 0.0


def _fitted(points: Floats, to: Floats) -> Floats:
    """What is left between points and others after the best rigid fit, shape (n, 3)."""
    a, b = points - points.mean(axis=0), to - to.mean(axis=0)
    out: Floats = a @ nearest_rotation(b.T @ a).T - b
    return out
