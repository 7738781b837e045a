"""Nonlinearity within the posterior, which makes covariances optimistic, and signs ambiguous within the priors.

With weak priors, nonlinearity makes the covariance optimistic in weak directions: the true arm lies on a curved
surface, the covariance on its tangent plane. Linearised a posterior sigma d away from the estimate x, at x + d and x -
d, the rows seem to have their optimum c = J^+ q off it, q the second-order part of the residuals; what is odd in d
cancels.

Norms are not differentiable at 0, nor angles at 180 degrees. A length or an angle is *ambiguous* where the prior sigma
of its vector is above half the way there: the vector may as well point the other way. It is also where the vector's
direction is known too badly: errors with variance t^2 in each direction across lengthen a vector of length f by t^2 / f
on average (see `measurements.moments`). Where that is near the noise, with t by priors and all other rows, the true arm
lies on a ring about the vector's axis, and the estimate may be opposite it, whatever its sigma.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.graph import Solution, subsampled
from fg_calib.inputs import Floats, Record, SolverError
from fg_calib.prediction.tool_pose import with_curve_errors
from fg_calib.robot import forward, pose, without_rigid_motion
from fg_calib.statistics import Spread

MAX_ROWS = 5_000
"""Residuals that suffice: of more, so many are drawn evenly where that is possible."""

NEGLIGIBLE, NONLINEAR, VERY_NONLINEAR = 1e-3, 0.1, 1.0
"""Mean squared errors beyond the covariance, over it: below which one draw suffices, and above which it matters: of the
tool, and of any directions."""

MAX_SECOND_ORDER = 0.4
"""Mean lengthening of a vector by errors across, over the row's noise, above which its direction is ambiguous."""

FEW = 200
"""Configurations at which the tool is looked at."""

N_DRAWS = 8
"""Draws of d: the symmetric root of the covariance times random signs."""


class Nonlinearity(Record):
    """Mean squared errors beyond what the covariance says, over the covariance: 0 of what is linear.

    Attributes:
        directions: Of all determined directions, in the mean.
        tool: Of the tool's position after the best rigid fit.
    """

    directions: float = 0.0
    tool: float = 0.0

    @property
    def matters(self) -> bool:
        """Whether the tool's errors are larger than the covariance says, or those of any directions far larger."""
        return self.tool >= NONLINEAR or self.directions >= VERY_NONLINEAR


def check_linearity(solution: Solution, spread: Spread) -> Nonlinearity:
    """The nonlinearity of a solution's rows a posterior sigma away; infinite where they cannot be linearised there."""
    problem, rank, n = solution.problem, spread.rank, spread.variables.n_columns
    if not rank:
        return Nonlinearity()
    if problem.n_residuals > MAX_ROWS and problem.is_exchangeable:
        problem = subsampled(problem, MAX_ROWS / problem.n_residuals, solution.parameters)
    scales, rng = spread.variables.prior_scales, np.random.default_rng(0)
    root = spread.root[:, :rank]
    sigma = np.linalg.norm(root / scales[:, None], axis=0)
    Q = root / scales[:, None] / sigma  # orthonormal
    here = solution.system if problem is solution.problem else problem.linearize(solution.parameters)
    steps, shifts = list[Floats](), list[Floats]()
    try:
        while len(shifts) < N_DRAWS:
            core = root @ (Q.T @ rng.choice([-1.0, 1.0], n))  # by the symmetric root: whatever basis LAPACK chose
            step = np.concatenate([core, here.left.follow @ core])
            plus, minus = (
                problem.linearize(problem.variables.moved(solution.parameters, d)).step for d in (step, -step)
            )
            steps, shifts = [*steps, step], [*shifts, 0.5 * (plus + minus) - here.step]
            squares = np.mean((np.array(shifts)[:, :n] / scales @ (Q / sigma)) ** 2)
            if len(shifts) == 1 and squares < NEGLIGIBLE:
                break
    except SolverError:
        return Nonlinearity(np.inf, np.inf)
    if squares < NONLINEAR:
        return Nonlinearity(float(squares))
    few, none = problem.data.readings[:FEW], np.zeros_like(steps[0])
    moved = [problem.variables.moved(solution.parameters, d) for d in (none, *steps, *shifts)]
    p = [pose(problem.robot.with_values(x[problem.variables.robot_span]), few).position for x in moved]
    off, beyond = np.split(without_rigid_motion(p[0], np.stack(p[1:], axis=2) - p[0][:, :, None])[0], 2, axis=2)
    tool = float(np.sum(beyond**2)) / max(float(np.sum(off**2)), 1e-300)
    return Nonlinearity(float(squares), tool)


class AmbiguousRows(Record):
    """Lengths and angles between configurations whose sign or direction is ambiguous within the priors.

    Attributes:
        n_rows: Train lengths and angles that were looked at.
        names: Names of those of ambiguous sign, `5-17`.
        share: Part of the determined directions that rests on these (sum of leverage over rank).
        turned: Names of those of ambiguous direction.
    """

    n_rows: int = 0
    names: tuple[str, ...] = ()
    share: float = 0.0
    turned: tuple[str, ...] = ()


def find_ambiguous_rows(solution: Solution, spread: Spread) -> AmbiguousRows:
    """Lengths and angles of ambiguous sign or direction; of many an even sample."""
    problem, at = solution.problem, solution.problem.variables.at(solution.parameters)
    prior, n = np.diag(problem.variables.prior_scales), problem.variables.n_columns
    trigs = problem.data.trigs(problem.robot, solution.parameters)
    n_rows, names, share, turned = 0, list[str](), 0.0, list[str]()
    if not problem.pair_blocks:
        return AmbiguousRows()
    for noise in (noise for noise in solution.noises if len(noise.block.train)):
        s = noise.block
        if s.kind.ends != 2 or not set(s.kind.names) <= {"distance", "angle"}:
            continue
        rows = s.train[:: -(-len(s.train) // MAX_ROWS)]
        chain, trig = at.chains[s.table], trigs[s.table][s.ends[rows].ravel()]
        end = forward(chain, trig)
        R = end.rotation.reshape(-1, 2, 3, 3)
        motion = with_curve_errors(spread, chain, trig, end.jacobian)
        moved = np.diff(motion.reshape(len(rows), 2, 6, -1), axis=1)[:, 0]
        places = problem.data.places[s.table][s.ends[rows]]
        for k, unit in enumerate(s.kind.units):
            used, sigma, is_length = s.used[rows, k], noise.sigma[rows, k], unit == "m"
            if is_length:
                vector, J = np.diff(end.position.reshape(-1, 2, 3), axis=1)[:, 0], moved[:, 3:]
            else:
                vector, J = Rotation.from_matrix(R[:, 1] @ np.swapaxes(R[:, 0], 1, 2)).as_rotvec(), moved[:, :3]
            f = np.linalg.norm(vector, axis=1)
            to_180 = np.inf if is_length else np.pi - f
            direction = vector / np.maximum(f, 1e-300)[:, None]
            by_prior = J[..., :n] @ prior
            prior_along = np.sum((direction[:, None] @ by_prior) ** 2, axis=(1, 2))
            flips = np.sum(by_prior**2, axis=(1, 2)) > np.maximum(f / 2.0, 2.0 * sigma) ** 2
            flips |= prior_along > np.maximum(to_180 / 2.0, 2.0 * sigma) ** 2
            A = np.concatenate([J[..., :n] @ spread.root, J[..., n:]], axis=2)
            leverage, across = _without_itself(direction, A, np.maximum(sigma, 1e-300))
            half = 0.5 * np.maximum(f, 1e-300)
            turns = 0.25 * across / (half if is_length else np.tan(half)) > MAX_SECOND_ORDER * sigma
            for found, which in ((names, flips), (turned, turns)):
                found += ["-".join(problem.end_names[i + 1] for i in pair) for pair in places[which & used]]
            n_rows += int(used.sum())
            share += float(leverage[flips & used].sum()) * (len(s.train) / len(rows)) / max(spread.rank, 1)
    return AmbiguousRows(n_rows, tuple(names), min(share, 1.0), tuple(turned))


def _without_itself(direction: Floats, A: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Leverage of rows, and the variance across their vectors by all other rows and priors, shapes (n,).

    Args:
        direction: Unit vectors, shape (n, 3); a row measures along it.
        A: Derivatives of the vectors times a square root of the posterior covariance, shape (n, 3, k).
        sigma: Noise of the rows, shape (n,).
    """
    a = (direction[:, None] @ A)[:, 0]
    along = np.sum(a**2, axis=1)
    leverage = along / sigma**2
    both = (A @ a[:, :, None])[:, :, 0] - direction * along[:, None]  # covariance of what is across with the row
    returned = np.sum(both**2, axis=1) / (sigma**2 * np.maximum(1.0 - leverage, 1e-9))
    return leverage, np.sum(A**2, axis=(1, 2)) - along + returned
