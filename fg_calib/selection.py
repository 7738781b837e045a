r"""The prior sigma of error curves by marginal likelihood.

The coefficients of error curves are Gaussian, and their sigma s, one for all joints, is estimated with them. With the
covariance C of the coefficients c, integrated over all else, and n of them, MacKay's fixed point is

    gamma = n - tr(C) / s^2,   s^2 = |c|^2 / gamma,

gamma the number of directions that the data determine. Its own sigma is about s / sqrt(2 gamma). A linearised fit gives
C and c for every s, so that the fixed point is found between fits.

References:
    MacKay (1992), Bayesian interpolation. Neural Computation 4(3).
"""

from collections.abc import Callable, Container
from dataclasses import replace

import numpy as np

from fg_calib import graph
from fg_calib.inputs import Floats
from fg_calib.parallel import single_threaded
from fg_calib.robot import ErrorCurve
from fg_calib.statistics.variance_components import settle

SETTLED = 3e-3
"""Relative change of a prior sigma below which it has settled: a tenth of what it is known to at best."""

LEAST_SIGMA = 1e-9
"""Smallest prior sigma of an error curve, [rad]."""

MAX_ROUNDS = 1000
"""Rounds of a fixed point between two fits."""

LEAST_SHARE = 1e-15
"""Share of its prior variance that a coefficient has left at least: rounding."""


@single_threaded
def estimate_curve_sigma(
    problem: graph.Problem, solve_with: Callable[[graph.Problem], graph.Solution] = graph.solve
) -> graph.Solution:
    """Estimate the parameters and, where an `ErrorCurve` does not specify it, the prior sigma of error curves.

    Args:
        problem: The problem; the tolerance of the curves' coefficients is where the sigma starts from.
        solve_with: Solver at a given prior sigma: `solve`, or `estimate_noise`.

    Returns:
        The solution; its robot's tolerances have the sigma, one for all curves, [rad]. It has not converged if the
        sigma has not settled.

    Raises:
        SolverError: GTSAM could not solve a step at all.
    """
    robot, state = problem.robot, problem.state
    free = [e for e in robot.effects if isinstance(e, ErrorCurve) and e.sigma is None]
    names = {term.name for effect in free for term in effect.terms(robot.geometry)}
    curves = [v for v in problem.variables.nuisance if v.kind == "curve"]
    curves = [v for v in curves if robot.parameters[v.parameters[0]].name in names]
    if not curves or problem.evaluated:
        return solve_with(problem)
    first, keys = robot.parameters[curves[0].parameters[0]].scale, {v.key for v in curves}

    def refit(theta: Floats) -> tuple[graph.Solution, Floats, None]:
        nonlocal state
        sigma = first * float(np.exp(theta[0]))
        solution = solve_with(_with_sigma(replace(problem, state=state), keys, sigma))
        state = replace(state, factors=solution.problem.state.factors)  # where the next fit takes the noise up
        return solution, np.array([np.log(_next_sigma(solution, keys, sigma) / sigma)]), None

    return settle(refit, 1, SETTLED, "prior sigma of error curves")[0]


def _with_sigma(problem: graph.Problem, keys: Container[int], sigma: float) -> graph.Problem:
    """The problem with the prior sigma of some error curves, by the keys of their variables, [rad]."""

    def change(p: graph.Problem) -> graph.Problem:
        parameters, nuisance = list(p.robot.parameters), list(p.variables.nuisance)
        for k, v in enumerate(nuisance):
            if v.key in keys:
                n = len(v.parameters)
                nuisance[k] = replace(v, prior=(n * (0.0,), n * (sigma,)), scales=n * (sigma,))
                for i in v.parameters:
                    parameters[i] = replace(parameters[i], tolerance=sigma)
        robot = replace(p.robot, parameters=tuple(parameters))
        return replace(p, robot=robot, variables=replace(p.variables, robot=robot, nuisance=tuple(nuisance)))

    return replace(change(problem), whole=None if problem.whole is None else change(problem.whole))


def _next_sigma(solution: graph.Solution, keys: Container[int], sigma: float) -> float:
    """The fixed point of the prior sigma of error curves by a fit with another one, [rad]."""
    curves = [v for v in solution.problem.variables.nuisance if v.key in keys]
    places = np.concatenate([v.places for v in curves])
    root = np.concatenate([solution.system.full_root[v.columns] for v in curves]) / sigma
    share, V = np.linalg.eigh(root @ root.T)  # of the prior variance, in [0, 1]
    share = np.clip(share, LEAST_SHARE, 1.0)
    information, right = 1.0 / share - 1.0, V.T @ solution.parameters[places] / sigma / share
    s = 1.0
    for _ in range(MAX_ROUNDS):
        variance = s**2 / (1.0 + information * s**2)
        gamma = float(np.sum(information * variance))
        before, s = s, max(np.sqrt(np.sum((variance * right) ** 2) / max(gamma, LEAST_SHARE)), LEAST_SIGMA / sigma)
        if abs(s / before - 1.0) < 0.1 * SETTLED:
            break
    return float(s * sigma)
