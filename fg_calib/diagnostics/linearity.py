"""Nonlinearity within the priors and the posterior: where covariances are optimistic and signs ambiguous.

With weak priors, nonlinearity makes the covariance optimistic in weak directions: the true arm lies on a curved
surface, the covariance on its tangent plane. Linearised a posterior sigma d away from the estimate x, at x + d and x -
d, the rows seem to have their optimum c = J^+ q off it, q the second-order part of the residuals; what is odd in d
cancels.

Norms are not differentiable at 0, nor angles at 180 degrees. A length or an angle is of *ambiguous sign* where the
prior sigma of its vector is above half the way there: the vector may as well point the other way. It is *curved* where
the spread of the posterior across the vector changes it by a second-order term that its noise does not hide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import SolverError
from fg_calib.graph.problem import at_parameters, linear_system, subsampled, with_initial
from fg_calib.graph.solver import Solution
from fg_calib.robot.kinematics import forward
from fg_calib.statistics.covariance import Spread

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

MAX_ROWS = 5_000
"""Residuals that suffice: of more, so many are drawn evenly where that is possible."""

NEGLIGIBLE = 1e-3
"""Mean square c / sigma of the first draws, below which there are no more."""

N_FIRST, N_DRAWS = 2, 8
"""Draws of d: sums of all determined directions, each a sigma one way or the other."""

NEAR_SIGMAS = 5.0
"""Noise sigmas from 0, or of an angle from 180 degrees, within which the sign of noise matters."""

CURVED_SIGMAS = 0.5
"""Second-order term of a length or angle over its noise, above which it counts as curved."""


@dataclass(frozen=True)
class Nonlinearity:
    """Mean squared errors beyond what the covariance says, over the covariance: 0 of what is linear.

    Attributes:
        directions: Of all determined directions, in the mean.
        parameter: Of the parameter of the robot or of a frame where it is largest.
        name: That parameter; empty for one of a frame.
    """

    directions: float = 0.0
    parameter: float = 0.0
    name: str = ""


def check_linearity(solution: Solution, spread: Spread) -> Nonlinearity:
    """The nonlinearity of a solution's rows a posterior sigma away; infinite where they cannot be linearised there."""
    problem, rank, n = solution.problem, spread.rank, spread.variables.n_columns
    if not rank:
        return Nonlinearity()
    if problem.n_residuals > MAX_ROWS:
        problem = subsampled(with_initial(problem, solution.parameters), MAX_ROWS / problem.n_residuals) or problem
    scales, rng = spread.variables.prior_scales, np.random.default_rng(0)
    root = spread.root[:, :rank]
    scaled = root / scales[:, None]
    in_sigma = (scaled / np.sum(scaled**2, axis=0)).T / scales  # the inverse of `root`, whose columns are orthogonal
    here, variables = linear_system(problem, solution.parameters), problem.variables
    values = variables.values(solution.parameters)
    shifts: list[Floats] = []
    try:
        while len(shifts) < N_DRAWS:
            core = root @ rng.choice([-1.0, 1.0], rank)
            step = np.concatenate([core, here.left.follow @ core])
            there = [variables.parameters(variables.moved(values, d)) for d in (step, -step)]
            plus, minus = (linear_system(problem, x).step for x in there)
            shifts.append((0.5 * (plus + minus) - here.step)[:n])
            squares = np.mean((np.array(shifts) @ in_sigma.T) ** 2)
            if len(shifts) == N_FIRST and squares < NEGLIGIBLE:
                break
    except SolverError:
        return Nonlinearity(np.inf, np.inf)
    named = np.nan_to_num(spread.variables.named_derivative(solution.parameters))
    variance = np.sum((named @ root) ** 2, axis=1)
    square = np.mean((np.array(shifts) @ named.T) ** 2, axis=0)
    of_each = np.divide(square, variance, out=np.zeros(len(variance)), where=variance > 0.0)
    worst, names = int(np.argmax(of_each)), spread.variables.names
    return Nonlinearity(float(squares), float(of_each[worst]), names[worst] if worst < len(names) else "")


@dataclass(frozen=True)
class NonlinearRows:
    """Lengths and angles between configurations that are not linear in what the parameters may be off.

    Attributes:
        n_rows: Train lengths and angles that were looked at.
        n_near: Pairs within `NEAR_SIGMAS` of their noise from 0 or 180 degrees.
        ambiguous: Names of those of ambiguous sign within the priors, `5-17`.
        curved: Names of others that are curved within the posterior.
        ambiguous_share: Part of the determined directions that rests on the ambiguous ones (sum of leverage over rank).
        curved_leverage: Directions that rest on the curved ones (sum of leverage).
    """

    n_rows: int = 0
    n_near: int = 0
    ambiguous: tuple[str, ...] = ()
    curved: tuple[str, ...] = ()
    ambiguous_share: float = 0.0
    curved_leverage: float = 0.0


def find_nonlinear_rows(solution: Solution, sqrt_cov: Floats, rank: int, table: int | None = None) -> NonlinearRows:
    """Lengths and angles of ambiguous sign, and curved ones; of many an even sample.

    Args:
        solution: The solution.
        sqrt_cov: A square root S of the posterior covariance S S^T of the core, shape (n_columns, k).
        rank: Number of determined directions.
        table: Number of the table whose rows are looked at; all if None.
    """
    problem, at = solution.problem, at_parameters(solution.problem, solution.parameters)
    prior = np.diag(problem.variables.prior_scales)
    n_rows, n_near, ambiguous, curved, share, resting = 0, 0, list[str](), list[str](), 0.0, 0.0
    for noise in solution.noises:
        s = noise.series
        families = [name.partition(".")[0] for name in s.kind.names]
        is_pair = s.kind.ends == 2 and set(families) <= {"distance", "angle"}
        if not is_pair or not len(s.train) or table not in (None, s.table):
            continue
        rows = s.train[:: -(-len(s.train) // MAX_ROWS)]
        trig = problem.data.trigs(problem.robot)[s.table]
        end = forward(at.chains[s.table], trig, s.ends[rows].ravel())
        p, R = end.position.reshape(-1, 2, 3), end.rotation.reshape(-1, 2, 3, 3)
        moved = np.diff(end.jacobian.reshape(len(rows), 2, 6, -1)[..., : len(prior)], axis=1)[:, 0]
        near = np.zeros(len(rows), dtype=np.bool_)
        for k, family in enumerate(families):
            used, sigma = s.used[rows, k], noise.sigma[rows, k]
            if family == "distance":
                vector, J = p[:, 1] - p[:, 0], moved[:, 3:]
            else:
                vector, J = _relative_rotation(R), moved[:, :3]
            f = np.linalg.norm(vector, axis=1)
            unit = vector / np.maximum(f, 1e-300)[:, None]
            prior_along, prior_across = _spread(unit, J @ prior)
            along, across = _spread(unit, J @ sqrt_cov)
            to_0, noisy = np.square(f) / 4.0, 4.0 * np.square(sigma)
            flips = prior_along + prior_across > np.maximum(to_0, noisy)
            slope = 1.0 / np.maximum(f, 1e-300)
            if family == "angle":
                flips |= prior_along > np.maximum(np.square(np.pi - f) / 4.0, noisy)
                slope = 0.5 / np.tan(0.5 * np.clip(f, 1e-9, np.pi))
            curves = ~flips & (0.5 * across * slope > CURVED_SIGMAS * sigma)
            names = problem.end_names
            places = problem.data.places[s.table][s.ends[rows]]
            for mask, found in ((flips & used, ambiguous), (curves & used, curved)):
                found += [f"{names[a + 1]}-{names[b + 1]}" for a, b in places[mask].tolist()]
            from_singular = np.minimum(f, np.pi - f) if family == "angle" else f
            near |= (from_singular < NEAR_SIGMAS * sigma) & used
            leverage = along / np.square(np.maximum(sigma, 1e-300)) * (len(s.train) / len(rows))
            n_rows += int(used.sum())
            share += float(leverage[flips & used].sum()) / max(rank, 1)
            resting += float(leverage[curves & used].sum())
        n_near += int(near.sum())
    return NonlinearRows(n_rows, n_near, tuple(ambiguous), tuple(curved), min(share, 1.0), resting)


def _relative_rotation(R: Floats) -> Floats:
    """Rotation vectors, shape (n, 3), in the base frame, from the first to the second of two rotations each."""
    out: Floats = Rotation.from_matrix(R[:, 1] @ np.swapaxes(R[:, 0], 1, 2)).as_rotvec()
    return out


def _spread(unit: Floats, moved: Floats) -> tuple[Floats, Floats]:
    """Variance along unit vectors and across them, shape (n,) each, of vectors that move by columns (n, 3, k)."""
    along = np.sum(np.einsum("ni,nik->nk", unit, moved) ** 2, axis=1)
    return along, np.maximum(np.sum(moved**2, axis=(1, 2)) - along, 0.0)
